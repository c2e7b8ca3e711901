"""Does somebody walk? Feet, floor and seams, measured from joint positions alone.

Every function takes positions `[..., T, J, 3]` in metres, +Y up, and answers with one number a
character. A toe is the joint that `Skeleton.toes` names; its height is that of the joint, above a
floor at y = `floor`. All of this is ours: the paper has the foot-sliding ratio of section 4.4.
"""

from itertools import groupby

import numpy as np
from scipy.ndimage import uniform_filter1d

from f3amd_lib.measures.metrics import checked_positions, foot_sliding, joint_acceleration
from f3amd_lib.motion.rotations import matrix_from_yaw
from f3amd_lib.motion.skeleton import Motion, Skeleton, contact_labels, facing_yaw

STEP_PROMINENCE = 0.015
"""How far a toe must rise over its surroundings to have taken a step, metres."""

SHORTEST_STEP = 0.4
"""Seconds between two steps of one foot, at least: a toe raised before it lands is no step."""

FAST_SLIDE = 30.0
"""cm/s over which anybody sees a foot slide."""

SHORTEST_SUPPORT = 3
"""Frames that a foot must carry alone to count as planted (0.1 s at 30 fps)."""


def toe_positions(positions, skeleton: Skeleton) -> np.ndarray:
    """Return the toes' positions, [..., T, 2, 3], left and right as in `Skeleton.toes`; ValueError for NaN."""
    return checked_positions(positions)[..., list(skeleton.toes), :]


def stepping_rate(positions, skeleton: Skeleton, fps: float = 30.0):
    """Count steps by toe height, of both feet together, per second.

    A step is a peak of one toe's height that stands out by 1.5 cm, at least 0.4 s after
    that foot's last one; heights are averaged over 0.1 s first, so that shaking is no step. A foot
    that skates while its leg swings counts here: `slide_speed` is what sees it.
    """
    from scipy.signal import find_peaks  # here: half a second that few callers need

    height = toe_positions(positions, skeleton)[..., 1]
    height = uniform_filter1d(height, max(1, round(0.1 * fps)), axis=-2, mode="nearest")
    series = np.moveaxis(height, -1, -2).reshape(-1, height.shape[-2])
    apart = max(1, round(SHORTEST_STEP * fps))
    counts = np.array([len(find_peaks(one, prominence=STEP_PROMINENCE, distance=apart)[0]) for one in series])
    per_character = counts.reshape(*height.shape[:-2], 2).sum(axis=-1)
    return per_character * fps / height.shape[-2]


def lower_toe_speed(positions, skeleton: Skeleton, fps: float = 30.0) -> np.ndarray:
    """Return how fast the lower toe moves over the ground, cm/s, [..., T - 1]."""
    toes = toe_positions(positions, skeleton)
    step = np.diff(toes, axis=-3)
    height = toes[..., 1]
    # The lower one over the step, so that a foot which just lands is not charged with its flight.
    lower = np.argmin(np.maximum(height[..., 1:, :], height[..., :-1, :]), axis=-1)
    speed = 100.0 * fps * np.linalg.norm(step[..., [0, 2]], axis=-1)
    return np.take_along_axis(speed, lower[..., None], axis=-1)[..., 0]


def slide_speed(positions, skeleton: Skeleton, fps: float = 30.0):
    """Median speed of the lower toe over the ground, cm/s: 0 for supporting feet."""
    return np.median(lower_toe_speed(positions, skeleton, fps), axis=-1)


def sliding_share(positions, skeleton: Skeleton, fps: float = 30.0):
    """Share of frames in which the lower toe moves faster than 30 cm/s over the ground."""
    return (lower_toe_speed(positions, skeleton, fps) > FAST_SLIDE).mean(axis=-1)


def floor_penetration(positions, skeleton: Skeleton, floor=0.0):
    """How deep the deepest toe sinks under the floor, cm; 0 for feet that stay on it."""
    height = toe_positions(positions, skeleton)[..., 1].min(axis=(-2, -1))
    return 100.0 * np.maximum(np.asarray(floor) - height, 0.0)


def seam_kick(positions, window: int):
    """Acceleration at the seams over acceleration elsewhere; motion without seams has 1.

    Args:
      positions: [..., T, J, 3], metres; window k starts at frame k * window.
      window: frames.

    Raises:
      ValueError: for fewer frames than two windows.
    """
    positions = np.asarray(positions, np.float64)
    frames = positions.shape[-3]
    if frames < 2 * window:
        raise ValueError(f"{frames} frames hold no seam between windows of {window} frames")
    acceleration = np.linalg.norm(np.diff(positions, n=2, axis=-3), axis=-1).mean(axis=-1)
    # Second difference k is about frame k + 1; a jump into frame s shows in those about s - 1, s.
    about = np.arange(1, frames - 1)
    seam = ((about % window == 0) | (about % window == window - 1)) & (about >= window - 1)
    return acceleration[..., seam].mean(axis=-1) / acceleration[..., ~seam].mean(axis=-1)


def support_changes_per_s(positions, skeleton: Skeleton, fps: float = 30.0):
    """Count how often the planted foot changes, per second.

    A foot carries alone while its toe rests (3D speed under 1 cm a frame) and the other's does
    not, for at least 0.1 s. A walker who takes two steps a second reads 2; one who slides, floats,
    hops on one leg or stands reads about 0.

    Args:
      positions: [..., T, J, 3], metres.
      skeleton: for the toes.
      fps: frame rate of `positions`.

    Returns:
      Changes per second, one a character: a foot that skates never rests and reads 0, so that this
      is no stepping rate. In records it keeps its first name, foot_alternation.

    Source: ours.
    """
    contact = np.asarray(contact_labels(skeleton, np.asarray(positions, np.float64), fps))
    alone = contact[..., 0].astype(int) - contact[..., 1].astype(int)
    flat = alone.reshape(-1, alone.shape[-1])
    counts = []
    for sides in flat:
        runs = [(side, len(list(run))) for side, run in groupby(sides)]
        steady = np.array([side for side, length in runs if side and length >= SHORTEST_SUPPORT])
        counts.append(np.count_nonzero(np.diff(steady)))
    return (np.array(counts) * fps / flat.shape[-1]).reshape(alone.shape[:-1])[()]


def bone_swing(positions, skeleton: Skeleton):
    """Say how far bones swing about their mean direction, seen by the character itself, degrees.

    Directions are turned by the facing, so that walking a curve moves nothing. Per bone it is
    sqrt(2 (1 - R)) with R the length of the mean unit vector, the root mean square angle where that
    is small; then the mean over bones. A frozen pose reads 0, shuffled frames read as real ones do
    (their acceleration gives them away).

    Args:
      positions: [..., T, J, 3], metres.
      skeleton: J joints.

    Returns:
      Degrees, one a character.

    Source: ours.
    """
    positions = np.asarray(positions, np.float64)
    child = np.arange(1, skeleton.num_joints)
    bones = positions[..., child, :] - positions[..., np.array(skeleton.parents[1:]), :]
    length = np.linalg.norm(bones, axis=-1, keepdims=True)
    real = length.reshape(-1, len(child)).max(axis=0) > 1e-6  # two joints in one place: no bone
    turn = matrix_from_yaw(-facing_yaw(skeleton, positions))
    unit = np.einsum("...ab,...jb->...ja", turn, bones / np.maximum(length, 1e-9))
    together = np.linalg.norm(unit.mean(axis=-3), axis=-1)[..., real]
    return np.rad2deg(np.sqrt(np.maximum(2.0 * (1.0 - together), 0.0))).mean(axis=-1)


# ----------------------------------------------------------------------------- held against real motion


def walking_measures(positions, skeleton: Skeleton, *, floor_shift=None) -> dict:
    """Measure what tells a walking person from a floating, frozen or shaking one.

    Args:
      positions: [..., T, J, 3], metres, at 30 fps.
      skeleton: J joints.
      floor_shift: see `metrics.foot_sliding`.

    Returns:
      Keys of dicts of figures (`registry.Metric.key`) -> one number a character.
    """
    return {
        "joint_acceleration_cm": joint_acceleration(positions),
        "foot_alternation_hz": support_changes_per_s(positions, skeleton),
        "bone_swing_deg": bone_swing(positions, skeleton),
        "contact_share": foot_sliding(positions, skeleton, floor_shift)[1],
    }


CHECKS = {
    "stepping_rate": ("within a fifth", lambda value, source: abs(value - source) <= 0.2 * source),
    "joint_acceleration": ("within a factor of 1.5", lambda value, source: source / 1.5 <= value <= 1.5 * source),
    "slide_speed": ("at most 12", lambda value, source: value <= 12.0),
    "floor_penetration": ("at most 1", lambda value, source: value <= 1.0),
}
"""Metric -> what a walking person's figure must be (our choice), in words and as a test: the first
two beside those of the motion that was learnt, the last two as they are."""


def walking_figures(motion: Motion, window: int, floor: float = 0.0) -> dict[str, float]:
    """Measure what tells somebody who walks from somebody who skates, sinks, shakes or stands.

    Args:
      motion: at least two windows long.
      window: frames; see `seam_kick`.
      floor: height of the floor, metres.

    Returns:
      Names of `CHECKS`, sliding_share and seam_kick -> one number each.
    """
    positions, skeleton, fps = motion.positions, motion.skeleton, motion.fps
    figures = {
        "stepping_rate": stepping_rate(positions, skeleton, fps),
        "joint_acceleration": joint_acceleration(positions, fps),
        "slide_speed": slide_speed(positions, skeleton, fps),
        "sliding_share": sliding_share(positions, skeleton, fps),
        "floor_penetration": floor_penetration(positions, skeleton, floor),
        "seam_kick": seam_kick(positions, window),
    }
    return {name: float(value) for name, value in figures.items()}
