"""Motion quality from joint positions: path following, smoothness, feet, seams.

Every function takes global joint positions `[..., T, J, 3]` in metres (one character `[T, J, 3]`,
or many `[B, T, J, 3]`), joint 0 being the root, and answers with one number a character: a scalar
for one, `[B]` for many. All arithmetic is float64 numpy.

Windows: a rollout may begin with `history` frames that were given, not generated. Generated frame
0 is frame `history`, and window k starts at generated frame `k * window`. The history is left out
of every figure. A *seam* is the step into a window's first frame from the frame before it, for
k = 1, 2, ...; the step from the given history into window 0 is not counted, since the paper speaks
of the boundaries between diffusion windows. After the last whole window a remainder counts for
smoothness, feet and seams, but not for the two window errors, whose size grows along a window.

A figure whose denominator vanishes (a root that does not move or accelerate) is NaN: undefined
for that character, and no reason to lose the others. Average with `numpy.nanmean`, and count.
"""

from __future__ import annotations

import numpy as np

from f3amd_lib.ground.names import nearest_hint
from f3amd_lib.motion.root_paths import RootPath
from f3amd_lib.motion.rotations import wrap_angle
from f3amd_lib.motion.skeleton import Skeleton, facing_yaw

CONTACT_HEIGHT = 0.01
"""A toe under this height above the floor is in contact, metres (Appendix C: 1 cm)."""

METRICS = {
    "trajectory_error_m": ("trajectory_error", "m", "down"),
    "direction_error_deg": ("direction_error", "deg", "down"),
    "smoothness": ("smoothness", "", "near real"),
    "coherence": ("coherence", "", "near real"),
    "foot_sliding": ("foot_sliding", "", "down"),
    "contact_share": ("contact_share", "", "near real"),
    "ird_cm": ("IRD", "cm", "near real"),
    "ird_excess_cm": ("IRD_excess", "cm", "near real"),
    "inter_frame_step_cm": ("inter_frame_step", "cm", "near real"),
    "joint_acceleration_cm": ("joint_acceleration", "cm/frame^2", "near real"),
    "path_drift": ("path_drift", "", "down"),
}
"""For each key of `first_metrics`: name in the paper's tables (or ours), unit, which way is better.

The paper marks IRD "down". We say "near real": real motion itself takes a step at every seam.
"""

CAMDM_METRICS = {
    "camdm_trajectory_error_deg": ("CAMDM_trajectory_error", "deg", "down"),
    "camdm_orientation_error_deg": ("CAMDM_orientation_error", "deg", "down"),
    "camdm_foot_sliding": ("CAMDM_foot_sliding", "", "down"),
    "coherence": METRICS["coherence"],
}
"""The same for each key of `camdm_metrics`: definitions of the released CAMDM code.

They are not those of the F3AMD text, though some bear the same names there. Never set a figure of
one column beside a figure of the other. Its FID is `distributions.camdm_frechet_distance`.
"""

_STILL = 1e-6  # metres; a mean root step or acceleration under a micrometre is none


def _checked_positions(positions, history: int = 0, least: int = 1) -> np.ndarray:
    """Return the generated part as float64, or say what is wrong with it."""
    positions = np.asarray(positions, dtype=np.float64)
    if positions.ndim < 3 or positions.shape[-1] != 3:
        raise ValueError(f"positions must be [..., T, J, 3] in metres, got {positions.shape}")
    if int(history) != history or history < 0:
        raise ValueError(f"history must be a whole number of frames, 0 or more, got {history}")
    if not np.all(np.isfinite(positions)):
        place = [int(i) for i in np.argwhere(~np.isfinite(positions))[0]]
        character = f" of character {place[:-3]}" if len(place) > 3 else ""
        raise ValueError(f"positions are not finite at frame {place[-3]}, joint {place[-2]}{character}")
    generated = positions[..., int(history) :, :, :]
    if generated.shape[-3] < least:
        raise ValueError(f"{generated.shape[-3]} frames after a history of {history}; at least {least} needed")
    return generated


def _checked_window(window: int, least: int = 1) -> int:
    if int(window) != window or window < least:
        raise ValueError(f"window must be a whole number of frames, {least} or more, got {window}")
    return int(window)


def _by_window(signal: np.ndarray, window: int) -> np.ndarray:
    """Cut [..., T, C] into whole windows, [..., K, window, C]; the remainder is left out."""
    count = signal.shape[-2] // window
    if count < 1:
        raise ValueError(f"{signal.shape[-2]} generated frames do not fill a window of {window}")
    whole = signal[..., : count * window, :]
    return whole.reshape(*whole.shape[:-2], count, window, whole.shape[-1])


def _reference(reference, num_frames: int, history: int, batch: tuple, what: str) -> np.ndarray:
    """Fit a reference [..., T or T - history, C] to the generated frames of a batch."""
    reference = np.asarray(reference, dtype=np.float64)
    if not np.all(np.isfinite(reference)):
        raise ValueError(f"{what} is not finite at index {np.argwhere(~np.isfinite(reference))[0]}")
    length = reference.shape[-2]
    if length == num_frames + history:
        reference = reference[..., history:, :]
    elif length != num_frames:
        raise ValueError(
            f"{what} has {length} frames; it needs {num_frames} (the generated ones) or, with the "
            f"history, {num_frames + history}"
        )
    try:
        return np.broadcast_to(reference, (*batch, *reference.shape[-2:]))
    except ValueError:
        raise ValueError(f"{what} of shape {reference.shape[:-1]} does not fit a batch of {batch}") from None


def _path_positions(path) -> np.ndarray:
    position = path.position if isinstance(path, RootPath) else np.asarray(path, dtype=np.float64)
    if position.ndim < 2 or position.shape[-1] != 2:
        raise ValueError(f"path must be a RootPath or [..., T, 2] (x, z), got {position.shape}")
    return position


def _checked_toes(toes, num_joints: int) -> np.ndarray:
    """Return the toes' joint indices, of a skeleton or as given."""
    indices = np.array(toes.toes if isinstance(toes, Skeleton) else toes, dtype=int)
    if indices.ndim != 1 or not indices.size or not 0 <= indices.min() <= indices.max() < num_joints:
        raise ValueError(f"toes must be joint indices from 0 to {num_joints - 1}, got {indices.tolist()}")
    return indices


def _checked_yaws(yaw, path, history: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the generated part of the facing and the wanted facing, [..., T] each."""
    yaw = np.asarray(yaw, dtype=np.float64)
    if yaw.ndim < 1 or yaw.shape[-1] <= history:
        raise ValueError(f"yaw must be [..., T] with more than {history} frames, got {yaw.shape}")
    if not np.all(np.isfinite(yaw)):
        raise ValueError(f"yaw is not finite at frame {np.argwhere(~np.isfinite(yaw))[0][-1]}")
    generated = yaw[..., history:]
    wanted = path.yaw if isinstance(path, RootPath) else np.asarray(path, dtype=np.float64)
    if wanted.ndim < 1:
        raise ValueError("path must be a RootPath or the wanted yaw [..., T]")
    target = _reference(wanted[..., None], generated.shape[-1], history, generated.shape[:-1], "path yaw")
    return generated, target[..., 0]


def _ratio(numerator: np.ndarray, denominator: np.ndarray):
    """Divide, with NaN where the root is still."""
    moving = denominator > _STILL
    return np.where(moving, numerator / np.where(moving, denominator, 1.0), np.nan)[()]


def seam_frames(num_frames: int, window: int, history: int = 0) -> np.ndarray:
    """List the first frames of windows 1, 2, ... in a rollout.

    Args:
      num_frames: frames in all, history included.
      window: frames a window.
      history: given frames before the first window.

    Returns:
      Frame numbers, [K]; each is compared with the frame before it.

    Raises:
      ValueError: if there is no boundary between two windows.
    """
    window = _checked_window(window)
    frames = np.arange(history + window, num_frames, window)
    if len(frames) == 0:
        raise ValueError(
            f"{num_frames} frames with a history of {history} hold no boundary between windows of "
            f"{window} frames; at least {history + window + 1} frames are needed"
        )
    return frames


def trajectory_error(positions, path, window: int, history: int = 0):
    """Distance between walked and wanted root position, reckoned from each window's first frame.

        mean over frames of || (p_t - p_first) - (p*_t - p*_first) ||,  on the ground plane.

    Args:
      positions: [..., T, J, 3], metres.
      path: the target, a `RootPath` or [..., T, 2] (x, z); T or T - history frames.
      window, history: frames, see the module's text.

    Returns:
      Metres, one a character.

    Raises:
      ValueError: for NaN, shapes that do not fit, or less than one whole window.

    Source: paper section 4.4 (Traj.). Our reading: "first" is the window's own first generated
    frame on both sides, and that frame, which is 0 by construction, is one of those averaged.
    """
    generated = _checked_positions(positions, history)
    window = _checked_window(window)
    root = generated[..., 0, [0, 2]]
    target = _reference(_path_positions(path), root.shape[-2], history, root.shape[:-2], "path")
    walked, wanted = _by_window(root, window), _by_window(target, window)
    gap = (walked - walked[..., :1, :]) - (wanted - wanted[..., :1, :])
    return np.linalg.norm(gap, axis=-1).mean(axis=(-2, -1))


def direction_error(yaw, path, window: int, history: int = 0):
    """Difference of the turns made since each window's first frame.

        mean over frames of | wrap((yaw_t - yaw_first) - (yaw*_t - yaw*_first)) |.

    A constant wrong facing therefore reads 0; so does the paper's.

    Args:
      yaw: facing of the character, [..., T], radians.
      path: a `RootPath`, or the wanted facing [..., T], radians; T or T - history frames.
      window, history: frames, see the module's text.

    Returns:
      Degrees in [0, 180], one a character.

    Raises:
      ValueError: for NaN, shapes that do not fit, or less than one whole window.

    Source: paper section 4.4 (Dir.). Our reading: differences are wrapped to half a turn, and the
    first frame, 0 by construction, is one of those averaged.
    """
    shown, wanted = _checked_yaws(yaw, path, history)
    window = _checked_window(window)
    turned, asked = _by_window(shown[..., None], window), _by_window(wanted[..., None], window)
    gap = wrap_angle((turned - turned[..., :1, :]) - (asked - asked[..., :1, :]))
    return np.rad2deg(np.abs(gap)).mean(axis=(-3, -2, -1))


def smoothness(positions, history: int = 0):
    """Mean joint acceleration over the root's mean acceleration on the ground.

        mean_{t, j} || p_{t+1} - 2 p_t + p_{t-1} ||  /  mean_t || the same of root x, z ||.

    Lower is smoother in the paper's sense; real motion has its own value, and a figure below it is
    not better motion. Without unit; both parts scale alike with size and frame rate.

    Args:
      positions: [..., T, J, 3], metres, T >= 3 after the history.
      history: given frames to leave out.

    Returns:
      One ratio a character; NaN where the root never accelerates.

    Raises:
      ValueError: for NaN, a wrong shape, or fewer than 3 frames.

    Source: paper Appendix C (Temporal Smoothness). Our reading: magnitudes are averaged over
    frames and joints (root included) before the division, over the whole rollout. CAMDM's released
    code takes first differences instead: see `coherence`.
    """
    generated = _checked_positions(positions, history, least=3)
    second = np.diff(generated, n=2, axis=-3)
    joints = np.linalg.norm(second, axis=-1).mean(axis=(-2, -1))
    root = np.linalg.norm(second[..., 0, [0, 2]], axis=-1).mean(axis=-1)
    return _ratio(joints, root)


def coherence(positions, history: int = 0):
    """Mean joint step over the root's mean horizontal step: CAMDM's smoothness.

        mean_{t, j} || p_{t+1} - p_t ||  /  mean_t || the same of root x, z ||.

    Args:
      positions: [..., T, J, 3], metres, T >= 2 after the history.
      history: given frames to leave out.

    Returns:
      One ratio a character; 1 for a figure that glides without moving a limb, NaN where the root
      stands still.

    Raises:
      ValueError: for NaN, a wrong shape, or fewer than 2 frames.

    Source: the released CAMDM code, which names it "coherence" (first, not second, differences).
    Not comparable with `smoothness`, the F3AMD text's definition. Where the root stands still the
    code divides by 1 in its own unit, so that its figure depends on the unit: here that is NaN.
    """
    generated = _checked_positions(positions, history, least=2)
    first = np.diff(generated, axis=-3)
    joints = np.linalg.norm(first, axis=-1).mean(axis=(-2, -1))
    root = np.linalg.norm(first[..., 0, [0, 2]], axis=-1).mean(axis=-1)
    return _ratio(joints, root)


def foot_sliding(positions, toes, history: int = 0, floor_shift=None, contact_height: float = CONTACT_HEIGHT):
    """Horizontal toe step while in contact over the root's horizontal step, and the contact share.

        mean over toe-frames in contact of || toe_{t+1} - toe_t ||_xz
            /  mean_t || root_{t+1} - root_t ||_xz

    A toe is in contact at t if it is less than `contact_height` above the floor there.

    Args:
      positions: [..., T, J, 3], metres, T >= 2 after the history.
      toes: joint indices of the two toes (`skeleton.toes`), or a `Skeleton`.
      history: given frames to leave out.
      floor_shift: height of a resting toe, metres, one number or one a character. None takes each
        character's own lowest toe, so that the lowest toe counts as 0. Give it where that is
        known (from real motion of the style), lest a single dip lift the floor's reference.
      contact_height: metres.

    Returns:
      (value, contact_share), one pair of numbers a character. The share is over toe-frames, in
      [0, 1]. Without any contact the value is 0, as in CAMDM's code: a floating figure slides
      nowhere, which is why the share stands beside it. NaN where the root stands still.

    Raises:
      ValueError: for NaN, a wrong shape, toe indices out of range, or fewer than 2 frames.

    Source: paper Appendix C (Foot Sliding, 1 cm). The text does not mention a lowering of the
    clip; CAMDM's code does it, and without it a toe joint that rests at 4 cm would never touch.
    """
    generated = _checked_positions(positions, history, least=2)
    foot = generated[..., _checked_toes(toes, generated.shape[-2]), :]
    if floor_shift is None:
        floor = foot[..., 1].min(axis=(-2, -1))
    else:
        floor = np.broadcast_to(np.asarray(floor_shift, dtype=np.float64), foot.shape[:-3])
        if not np.all(np.isfinite(floor)):
            raise ValueError("floor_shift must be finite, in metres")
    contact = (foot[..., :-1, :, 1] - floor[..., None, None]) < contact_height
    step = np.linalg.norm(np.diff(foot, axis=-3)[..., [0, 2]], axis=-1)
    count = contact.sum(axis=(-2, -1))
    slide = (step * contact).sum(axis=(-2, -1)) / np.maximum(count, 1)
    root = np.linalg.norm(np.diff(generated[..., 0, [0, 2]], axis=-2), axis=-1).mean(axis=-1)
    return _ratio(slide, root), contact.mean(axis=(-2, -1))


def ird(positions, window: int, history: int = 0):
    """Inter-round discontinuity, to the letter: how far joints move across a seam.

        100 * mean_{seams k, joints j} || p_{t_k + 1, j} - p_{t_k, j} ||.

    Real motion does not read 0 here but a walker's ordinary step (4 to 6 cm at 30 fps): set
    `inter_frame_step` of real clips beside it. Below that, the character sticks at the seam.

    Args:
      positions: [..., T, J, 3], metres.
      window, history: frames, see the module's text.

    Returns:
      Centimetres, one a character.

    Raises:
      ValueError: for NaN, a wrong shape, or no boundary between windows.

    Source: paper section 4.4 (IRD), Eq. 10 as a metric. Our reading: the norm is that of each
    joint's displacement, averaged over joints ("mean Euclidean distance"), not of all stacked.
    """
    generated = _checked_positions(positions, history)
    seams = seam_frames(generated.shape[-3], window)
    jump = generated[..., seams, :, :] - generated[..., seams - 1, :, :]
    return 100.0 * np.linalg.norm(jump, axis=-1).mean(axis=(-2, -1))


def ird_excess(positions, window: int, history: int = 0):
    """How far a seam's step is from the step that the velocity before the seam would take.

        100 * mean_{k, j} || (p_{t_k + 1} - p_{t_k}) - (p_{t_k} - p_{t_k - 1}) ||.

    0 for motion that goes on as it went. Real motion accelerates a little in every frame, so its
    own value is the yardstick: the same formula at all frames is `joint_acceleration`.

    Args:
      positions: [..., T, J, 3], metres.
      window, history: frames; a window needs 2, so that the velocity before a seam is its own.

    Returns:
      Centimetres, one a character.

    Raises:
      ValueError: for NaN, a wrong shape, a window under 2, or no boundary between windows.

    Source: ours. Eq. 10 compares with standing still; this compares with going on.
    """
    generated = _checked_positions(positions, history)
    seams = seam_frames(generated.shape[-3], _checked_window(window, least=2))
    before, last, first = (generated[..., seams - back, :, :] for back in (2, 1, 0))
    return 100.0 * np.linalg.norm(first - 2.0 * last + before, axis=-1).mean(axis=(-2, -1))


def inter_frame_step(positions, spacing: int = 1, history: int = 0):
    """How far joints move between adjacent frames: what `ird` reads on motion without seams.

    Args:
      positions: [..., T, J, 3], metres; for the "real row", real clips.
      spacing: take the steps into frames spacing, 2 * spacing, ...; 1 takes all of them, the
        window length takes those at which `ird` would look.
      history: given frames to leave out.

    Returns:
      Centimetres, one a character.

    Raises:
      ValueError: for NaN, a wrong shape, or too few frames for one step.

    Source: ours (the row of real motion beside Eq. 10).
    """
    return ird(positions, spacing, history)


def joint_acceleration(positions, history: int = 0, fps: float = 30.0):
    """Mean magnitude of joint accelerations, not normalised by anything.

        100 * mean_{t, j} || p_{t+1} - 2 p_t + p_{t-1} || * (fps / 30)^2.

    Args:
      positions: [..., T, J, 3], metres, T >= 3 after the history.
      history: given frames to leave out.
      fps: frame rate of `positions`; the result is always for 1/30 s.

    Returns:
      Centimetres per frame squared at 30 fps (1 is 9 m/s^2), one a character.

    Raises:
      ValueError: for NaN, a wrong shape, or fewer than 3 frames.

    Source: ours; the numerator of `smoothness`, which a jerky root cannot flatter.
    """
    generated = _checked_positions(positions, history, least=3)
    second = np.linalg.norm(np.diff(generated, n=2, axis=-3), axis=-1)
    return 100.0 * (fps / 30.0) ** 2 * second.mean(axis=(-2, -1))


def path_drift(positions, path, history: int = 0):
    """How far off the end is, over the length of the path: whole rollout, no windows.

        || (p_end - p_start) - (p*_end - p*_start) ||  /  length of p*.

    Args:
      positions: [..., T, J, 3], metres.
      path: the target, a `RootPath` or [..., T, 2] (x, z); T or T - history frames.
      history: given frames to leave out.

    Returns:
      Metres of error at the end per metre of path, one a character; NaN for a path of no length.

    Raises:
      ValueError: for NaN or shapes that do not fit.

    Source: ours, beside Traj., which by design does not see drift between windows.
    """
    generated = _checked_positions(positions, history, least=2)
    root = generated[..., 0, [0, 2]]
    target = _reference(_path_positions(path), root.shape[-2], history, root.shape[:-2], "path")
    gap = (root[..., -1, :] - root[..., 0, :]) - (target[..., -1, :] - target[..., 0, :])
    length = np.linalg.norm(np.diff(target, axis=-2), axis=-1).sum(axis=-1)
    return _ratio(np.linalg.norm(gap, axis=-1), length)


def _angle_error(angle: np.ndarray, wanted: np.ndarray, counts: np.ndarray):
    """Return | mean of wanted - angle |, degrees, over the frames that count; NaN for none."""
    number = counts.sum(axis=-1)
    total = np.sum(np.where(counts, wanted - angle, 0.0), axis=-1)
    return np.where(number > 0, np.rad2deg(np.abs(total)) / np.maximum(number, 1), np.nan)[()]


def camdm_trajectory_error(positions, path, history: int = 0):
    """CAMDM's trajectory error: mean angle between wanted and walked steps, over the whole rollout.

        | mean_t(a*_t - a_t) |,  a_t = angle of the root's step on the ground from t to t + 1.

    The absolute value is taken after the mean. Errors to the left and to the right cancel, so that
    a zigzag about the path reads 0, as does a root at any distance beside it. The differences are
    not wrapped: a step that lies across the cut at +-180 degrees from its target counts as nearly
    360 degrees off. The cut lies at steps along +X, so that the figure is not the same for the
    same motion turned about +Y.

    Args:
      positions: [..., T, J, 3], metres, T >= 2 after the history.
      path: the target, a `RootPath` or [..., T, 2] (x, z); T or T - history frames.
      history: given frames to leave out.

    Returns:
      Degrees, one a character.

    Raises:
      ValueError: for NaN, shapes that do not fit, or fewer than 2 frames.

    Source: the released CAMDM code ("traj_error"), angles and cut as there. Our reading: the wanted
    direction is that of the path's own step (the code's comes from a list of commands), and frames
    in which path or root stand still have no direction and are left out; NaN if all are. (Section
    4.4 of the F3AMD text describes it with vectors from the first frame to the current one.)
    """
    generated = _checked_positions(positions, history, least=2)
    root = generated[..., 0, [0, 2]]
    target = _reference(_path_positions(path), root.shape[-2], history, root.shape[:-2], "path")
    steps = [np.diff(line, axis=-2) for line in (root, target)]
    angle, wanted = (np.arctan2(step[..., 1], -step[..., 0]) for step in steps)
    lengths = [np.linalg.norm(step, axis=-1) for step in steps]
    return _angle_error(angle, wanted, np.minimum(*lengths) > _STILL)


def camdm_orientation_error(yaw, path, history: int = 0):
    """CAMDM's orientation error: mean angle between wanted and shown facing, whole rollout.

        | mean_t(f*_t - f_t) |,  f_t = angle of the facing on the ground.

    As in `camdm_trajectory_error` signed errors cancel before the absolute value, and differences
    are not wrapped; here the cut lies at facing -X.

    Args:
      yaw: facing of the character, [..., T], radians.
      path: a `RootPath`, or the wanted facing [..., T], radians; T or T - history frames.
      history: given frames to leave out.

    Returns:
      Degrees, one a character.

    Raises:
      ValueError: for NaN or shapes that do not fit.

    Source: the released CAMDM code ("orien_error"), angles and cut as there. It takes the facing
    from shoulders and hips together; use the `yaw` you mean (`facing_yaw` takes the hips).
    """
    shown, wanted = _checked_yaws(yaw, path, history)
    angle, target = (np.arctan2(np.cos(each), np.sin(each)) for each in (shown, wanted))
    return _angle_error(angle, target, np.ones(angle.shape, dtype=bool))


def camdm_foot_sliding(positions, toes, history: int = 0):
    """CAMDM's foot sliding: as `foot_sliding` with the clip lowered, but for its last frame.

        mean over toe-frames in contact of s_t  /  mean_t || root_{t+1} - root_t ||_xz,
        s_t = || toe_{t+1} - toe_t ||_xz,  and 0 for the last frame.

    Contact is a toe under 1 cm above the clip's lowest toe. A toe that touches in the last frame
    adds a step of 0, which lowers the figure by about 1 / T.

    Args:
      positions: [..., T, J, 3], metres, T >= 2 after the history.
      toes: joint indices of the two toes (`skeleton.toes`), or a `Skeleton`.
      history: given frames to leave out.

    Returns:
      One ratio a character; 0 without any contact. NaN where the root stands still, where the code
      divides by 1 in its own unit.

    Raises:
      ValueError: for NaN, a wrong shape, toe indices out of range, or fewer than 2 frames.

    Source: the released CAMDM code.
    """
    generated = _checked_positions(positions, history, least=2)
    foot = generated[..., _checked_toes(toes, generated.shape[-2]), :]
    height = foot[..., 1] - foot[..., 1].min(axis=(-2, -1), keepdims=True)
    contact = height < CONTACT_HEIGHT
    step = np.linalg.norm(np.diff(foot, axis=-3)[..., [0, 2]], axis=-1)
    slide = (step * contact[..., :-1, :]).sum(axis=(-2, -1)) / np.maximum(contact.sum(axis=(-2, -1)), 1)
    root = np.linalg.norm(np.diff(generated[..., 0, [0, 2]], axis=-2), axis=-1).mean(axis=-1)
    return _ratio(slide, root)


def _position_and_yaw(path) -> tuple[np.ndarray, np.ndarray]:
    """Unpack one RootPath, or stack several, into [..., T, 2] and [..., T]."""
    if isinstance(path, RootPath):
        return path.position, path.yaw
    paths = list(path)
    if not paths or not all(isinstance(item, RootPath) for item in paths):
        raise ValueError("path must be a RootPath, or a list of one a character")
    if len({item.num_frames for item in paths}) > 1:
        raise ValueError("all paths of a batch must have the same number of frames")
    return np.stack([item.position for item in paths]), np.stack([item.yaw for item in paths])


def _checked_measurands(positions, yaw, path, skeleton: Skeleton):
    """Return the facing and (wanted positions, wanted yaws), or None and None without a path."""
    shape = np.shape(positions)
    if len(shape) < 3 or shape[-2] != skeleton.num_joints:
        raise ValueError(f"positions must be [..., T, {skeleton.num_joints}, 3] for this skeleton, got {shape}")
    if path is None:
        return None, None
    if yaw is None:
        yaw = facing_yaw(skeleton, np.asarray(positions, dtype=np.float64))
    if np.shape(yaw) != shape[:-2]:
        raise ValueError(f"yaw must be {shape[:-2]} for these positions, got {np.shape(yaw)}")
    return yaw, _position_and_yaw(path)


def _plain(values: dict) -> dict:
    return {key: float(value) if np.ndim(value) == 0 else np.asarray(value) for key, value in values.items()}


def first_metrics(
    positions, yaw, path, window: int, skeleton: Skeleton, *, history: int = 0, floor_shift=None, fps: float = 30.0
) -> dict:
    """Measure a rollout, or real motion, with everything that needs no classifier.

    Args:
      positions: [..., T, J, 3], metres, history included.
      yaw: facing, [..., T], radians; None takes it from the hips.
      path: the target, one `RootPath` for all or a list of one a character; T or T - history
        frames. None for real motion, which follows no target: then trajectory, direction and
        drift are left out.
      window: frames a window.
      skeleton: for the toes, and the hips if `yaw` is None.
      history: given frames before the first window.
      floor_shift: see `foot_sliding`.
      fps: frame rate of `positions`.

    Returns:
      Key -> number (float for one character, [B] for many); keys, names and units are in `METRICS`.

    Raises:
      ValueError: for NaN, shapes that do not fit, or no boundary between windows.

    Source: paper section 4.4 and Appendix C, and the additions marked "ours" above.
    """
    yaw, wanted = _checked_measurands(positions, yaw, path, skeleton)
    values = {}
    if wanted is not None:
        wanted_position, wanted_yaw = wanted
        values["trajectory_error_m"] = trajectory_error(positions, wanted_position, window, history)
        values["direction_error_deg"] = direction_error(yaw, wanted_yaw, window, history)
    values["smoothness"] = smoothness(positions, history)
    values["coherence"] = coherence(positions, history)
    values["foot_sliding"], values["contact_share"] = foot_sliding(positions, skeleton, history, floor_shift)
    values["ird_cm"] = ird(positions, window, history)
    values["ird_excess_cm"] = ird_excess(positions, window, history)
    values["inter_frame_step_cm"] = inter_frame_step(positions, 1, history)
    values["joint_acceleration_cm"] = joint_acceleration(positions, history, fps)
    if wanted is not None:
        values["path_drift"] = path_drift(positions, wanted_position, history)
    return _plain(values)


def camdm_metrics(positions, yaw, path, skeleton: Skeleton, *, history: int = 0) -> dict:
    """Measure a rollout, or real motion, as the released CAMDM code does.

    Args:
      positions, yaw, path, skeleton, history: as for `first_metrics`.

    Returns:
      Key -> number (float for one character, [B] for many); keys, names and units are in
      `CAMDM_METRICS`. Without a path the two angles are left out.

    Raises:
      ValueError: for NaN or shapes that do not fit.

    Source: the released CAMDM code.
    """
    yaw, wanted = _checked_measurands(positions, yaw, path, skeleton)
    values = {}
    if wanted is not None:
        wanted_position, wanted_yaw = wanted
        values["camdm_trajectory_error_deg"] = camdm_trajectory_error(positions, wanted_position, history)
        values["camdm_orientation_error_deg"] = camdm_orientation_error(yaw, wanted_yaw, history)
    values["camdm_foot_sliding"] = camdm_foot_sliding(positions, skeleton, history)
    values["coherence"] = coherence(positions, history)
    return _plain(values)


def tidy_metrics(values: dict, **columns) -> list[dict]:
    """Turn a dict of metrics into the rows of a tidy table, averaged over characters.

    Args:
      values: what `first_metrics` or `camdm_metrics` returned, or both together.
      columns: what the rows are about, such as model="F3AMD-FNO-96", steps=8.

    Returns:
      One dict a metric: the columns, then metric, unit, better, value (mean over characters),
      spread (standard deviation over characters, NaN for one), characters (those with a number).

    Raises:
      ValueError: for a key that is neither in `METRICS` nor in `CAMDM_METRICS`.
    """
    known = METRICS | CAMDM_METRICS
    rows = []
    for key, value in values.items():
        if key not in known:
            raise ValueError(f"unknown metric {key!r}{nearest_hint(key, known)}")
        name, unit, better = known[key]
        numbers = np.ravel(value)
        numbers = numbers[np.isfinite(numbers)]
        count = len(numbers)
        rows.append(
            {
                **columns,
                "metric": name,
                "unit": unit,
                "better": better,
                "value": float(numbers.mean()) if count else float("nan"),
                "spread": float(numbers.std(ddof=1)) if count > 1 else float("nan"),
                "characters": count,
            }
        )
    return rows
