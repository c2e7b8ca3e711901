"""Does somebody walk? Feet, floor and seams, measured from joint positions alone.

Every function takes positions `[..., T, J, 3]` in metres, +Y up, and answers with one number a
character. A toe is the joint that `Skeleton.toes` names; its height is that of the joint, above a
floor at y = `floor`. All of this is ours: the paper has the foot-sliding ratio of section 4.4.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pandas as pd
from scipy.ndimage import uniform_filter1d
from scipy.signal import find_peaks

from f3amd_lib.measures.metrics import joint_acceleration
from f3amd_lib.motion.skeleton import Motion, Skeleton

STEP_PROMINENCE = 0.015
"""How far a toe must rise over its surroundings to have taken a step, metres."""

SHORTEST_STEP = 0.4
"""Seconds between two steps of one foot, at least: a toe raised before it lands is no step."""

FAST_SLIDE = 30.0
"""cm/s over which anybody sees a foot slide."""


def toe_positions(positions, skeleton: Skeleton) -> np.ndarray:
    """Return the toes' positions, [..., T, 2, 3], left and right as in `Skeleton.toes`."""
    return np.asarray(positions, np.float64)[..., list(skeleton.toes), :]


def stepping_rate(positions, skeleton: Skeleton, fps: float = 30.0):
    """Count steps by toe height, of both feet together, per second.

    A step is a peak of one toe's height that stands out by 1.5 cm, at least 0.4 s after
    that foot's last one; heights are averaged over 0.1 s first, so that shaking is no step. A foot
    that skates while its leg swings counts here: `slide_speed` is what sees it.
    """
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
    """Median speed of the lower toe over the ground, cm/s: 0 for feet that stand."""
    return np.median(lower_toe_speed(positions, skeleton, fps), axis=-1)


def sliding_share(positions, skeleton: Skeleton, fps: float = 30.0):
    """Share of frames in which the lower toe moves faster than 30 cm/s over the ground."""
    return (lower_toe_speed(positions, skeleton, fps) > FAST_SLIDE).mean(axis=-1)


def floor_penetration(positions, skeleton: Skeleton, floor=0.0):
    """How deep the deepest toe sinks under the floor, cm; 0 for feet that stay on it."""
    height = toe_positions(positions, skeleton)[..., 1].min(axis=(-2, -1))
    return 100.0 * np.maximum(np.asarray(floor) - height, 0.0)


def seam_kick(positions, window: int):
    """Acceleration at the seams over that of all other frames; motion without seams reads 1.

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


CHECKS = {
    "stepping_rate": ("steps by toe height", "1/s", "within a fifth"),
    "joint_acceleration": ("joint acceleration", "cm/frame²", "within a factor of 1.5"),
    "slide_speed": ("slide of the lower toe", "cm/s", "at most 12"),
    "floor_penetration": ("deepest toe under the floor", "cm", "at most 1"),
}
"""Key -> name, unit, and what a walking person's figure must be (our choice): the first two beside
those of the motion that was learnt, the last two as they are."""

_HOLDS = {
    "stepping_rate": lambda value, source: abs(value - source) <= 0.2 * source,
    "joint_acceleration": lambda value, source: source / 1.5 <= value <= 1.5 * source,
    "slide_speed": lambda value, source: value <= 12.0,
    "floor_penetration": lambda value, source: value <= 1.0,
}


def walking_figures(motion: Motion, window: int, floor: float = 0.0) -> dict[str, float]:
    """Measure what tells somebody who walks from somebody who skates, sinks, shakes or stands.

    Args:
      motion: at least two windows long.
      window: frames; see `seam_kick`.
      floor: height of the floor, metres.

    Returns:
      The keys of `CHECKS`, sliding_share and seam_kick -> one number each.
    """
    positions, skeleton, fps = motion.positions, motion.skeleton, motion.fps
    return {
        "stepping_rate": float(stepping_rate(positions, skeleton, fps)),
        "joint_acceleration": float(joint_acceleration(positions, fps=fps)),
        "slide_speed": float(slide_speed(positions, skeleton, fps)),
        "sliding_share": float(sliding_share(positions, skeleton, fps)),
        "floor_penetration": float(floor_penetration(positions, skeleton, floor)),
        "seam_kick": float(seam_kick(positions, window)),
    }


def check_walks(
    walks: Mapping[str, Motion], sources: Mapping[str, Motion], window: int, floors: Mapping = {}
) -> pd.DataFrame:
    """Hold generated walks against the motion that they were learnt from, style by style.

    Args:
      walks: style -> generated motion.
      sources: style -> motion of the source, best along the same path.
      window: frames.
      floors: style -> height of the floor, metres; 0 where a style is not named.

    Returns:
      One row per style and check: style, check, unit, source, value, wanted, holds.

    Raises:
      ValueError: for a style without a source.
    """
    rows = []
    for style, motion in walks.items():
        if style not in sources:
            raise ValueError(f"no source motion of style {style!r} to hold the walk against")
        floor = float(floors.get(style, 0.0))
        found = walking_figures(motion, window, floor)
        source = walking_figures(sources[style], window, floor)
        for key, (name, unit, wanted) in CHECKS.items():
            holds = bool(_HOLDS[key](found[key], source[key]))
            given = {"style": style, "check": name, "unit": unit, "source": source[key]}
            rows.append(given | {"value": found[key], "wanted": wanted, "holds": holds})
    return pd.DataFrame(rows)
