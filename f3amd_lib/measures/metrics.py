"""Motion quality from joint positions: path following, smoothness, feet, seams.

Every function takes global joint positions `[..., T, J, 3]` in metres (one character `[T, J, 3]`,
or many `[B, T, J, 3]`), joint 0 being the root, and answers with one number a character: a scalar
for one, `[B]` for many. All arithmetic is float64 numpy. Names, units and which way is better stand
in `registry`.

Window k starts at frame `k * window`. A *seam* is the step into a window's first frame from the
frame before it, for k = 1, 2, ... After the last whole window a remainder counts for smoothness,
feet and seams, but not for the two window errors, whose size grows along a window.

A figure whose denominator vanishes (a root that does not move or accelerate) is NaN: undefined
for that character, and no reason to lose the others. Average with `numpy.nanmean`, and count.
"""

import numpy as np

from f3amd_lib.ground.arrays import finite_array
from f3amd_lib.motion.root_paths import RootPath
from f3amd_lib.motion.rotations import wrap_angle
from f3amd_lib.motion.skeleton import Skeleton, facing_yaw

CONTACT_HEIGHT = 0.01
"""A toe under this height above the floor is in contact, metres (Appendix C: 1 cm)."""

_STILL = 1e-6  # metres; a mean root step or acceleration under a micrometre is none


def checked_positions(positions, least: int = 1) -> np.ndarray:
    """Return positions as float64, or say what is wrong with them."""
    positions = finite_array("positions", positions, (*np.shape(positions)[:-3], "frame", "joint", 3))
    if positions.shape[-3] < least:
        raise ValueError(f"{positions.shape[-3]} frames; at least {least} needed")
    return positions


def _since_window_start(signal: np.ndarray, window: int) -> np.ndarray:
    """Return the change of [..., T, C] since each whole window's first frame, [..., K, window, C]."""
    count = signal.shape[-2] // window
    if count < 1:
        raise ValueError(f"{signal.shape[-2]} frames do not fill a window of {window}")
    whole = signal[..., : count * window, :]
    windows = whole.reshape(*whole.shape[:-2], count, window, whole.shape[-1])
    return windows - windows[..., :1, :]


def _root_and_target(positions, path, least: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Return the root on the ground and where it was wanted, [..., T, 2] each."""
    root, target = checked_positions(positions, least)[..., 0, [0, 2]], np.asarray(getattr(path, "position", path))
    return root, finite_array("path", target, (*target.shape[:-2], root.shape[-2], 2))


def _shown_and_wanted_yaw(yaw, path) -> tuple[np.ndarray, np.ndarray]:
    """Return the facing and the wanted facing, [..., T, 1] each."""
    shown, wanted = np.asarray(yaw)[..., None], np.asarray(getattr(path, "yaw", path))[..., None]
    checked = lambda name, signal: finite_array(name, signal, (*signal.shape[:-2], shown.shape[-2], 1))
    return checked("yaw", shown), checked("path", wanted)


def _ratio(numerator: np.ndarray, denominator: np.ndarray):
    """Divide, with NaN where the root is still."""
    moving = denominator > _STILL
    return np.where(moving, numerator / np.where(moving, denominator, 1.0), np.nan)[()]


def _joint_and_root_change(positions, order: int) -> tuple[np.ndarray, np.ndarray]:
    """Return mean lengths of the order-th differences: of all joints, and of the root's x and z."""
    change = np.diff(checked_positions(positions, least=order + 1), n=order, axis=-3)
    joints = np.linalg.norm(change, axis=-1).mean(axis=(-2, -1))
    return joints, np.linalg.norm(change[..., 0, [0, 2]], axis=-1).mean(axis=-1)


def _toes_and_root_step(positions, skeleton: Skeleton) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return toe positions [..., T, 2, 3], their steps on the ground [..., T - 1, 2] and the root's mean one."""
    positions = checked_positions(positions, least=2)
    toe = positions[..., list(skeleton.toes), :]
    step = np.linalg.norm(np.diff(toe, axis=-3)[..., [0, 2]], axis=-1)
    root = np.linalg.norm(np.diff(positions[..., 0, [0, 2]], axis=-2), axis=-1).mean(axis=-1)
    return toe, step, root


def seam_frames(num_frames: int, window: int) -> np.ndarray:
    """List the first frames of windows 1, 2, ... in a rollout.

    Args:
      num_frames: frames in all.
      window: frames a window.

    Returns:
      Frame numbers, [K]; each is compared with the frame before it.

    Raises:
      ValueError: if there is no boundary between two windows.
    """
    frames = np.arange(window, num_frames, window)
    if len(frames) == 0:
        raise ValueError(
            f"{num_frames} frames hold no boundary between windows of {window} frames: take more than that"
        )
    return frames


def trajectory_error(positions, path, window: int):
    """Distance between walked and wanted root position, reckoned from each window's first frame.

        mean over frames of || (p_t - p_first) - (p*_t - p*_first) ||,  on the ground plane.

    Args:
      positions: [..., T, J, 3], metres.
      path: the target, a `RootPath` or [..., T, 2] (x, z).
      window: frames.

    Returns:
      Metres, one a character.

    Raises:
      ValueError: for NaN, shapes that do not fit, or less than one whole window.

    Source: paper section 4.4 (Traj.). Our reading: "first" is the window's own first generated
    frame on both sides, and that frame, which is 0 by construction, is one of those averaged.
    """
    walked, wanted = _root_and_target(positions, path)
    gap = _since_window_start(walked, window) - _since_window_start(wanted, window)
    return np.linalg.norm(gap, axis=-1).mean(axis=(-2, -1))


def direction_error(yaw, path, window: int):
    """Difference of the turns made since each window's first frame.

        mean over frames of | wrap((yaw_t - yaw_first) - (yaw*_t - yaw*_first)) |.

    A constant wrong facing therefore reads 0; so does the paper's.

    Args:
      yaw: facing of the character, [..., T], radians.
      path: a `RootPath`, or the wanted facing [..., T], radians.
      window: frames.

    Returns:
      Degrees in [0, 180], one a character.

    Raises:
      ValueError: for NaN, shapes that do not fit, or less than one whole window.

    Source: paper section 4.4 (Dir.). Our reading: differences are wrapped to half a turn, and the
    first frame, 0 by construction, is one of those averaged.
    """
    shown, wanted = _shown_and_wanted_yaw(yaw, path)
    gap = wrap_angle(_since_window_start(shown, window) - _since_window_start(wanted, window))
    return np.rad2deg(np.abs(gap)).mean(axis=(-3, -2, -1))


def smoothness(positions):
    """Mean joint acceleration over the root's mean acceleration on the ground.

        mean_{t, j} || p_{t+1} - 2 p_t + p_{t-1} ||  /  mean_t || the same of root x, z ||.

    Lower is smoother in the paper's sense; real motion has its own value, and a figure below it is
    not better motion. Without unit; both parts scale alike with size and frame rate.

    Args:
      positions: [..., T, J, 3], metres, T >= 3.

    Returns:
      One ratio a character; NaN where the root never accelerates.

    Raises:
      ValueError: for NaN, a wrong shape, or fewer than 3 frames.

    Source: paper Appendix C (Temporal Smoothness). Our reading: magnitudes are averaged over
    frames and joints (root included) before the division, over the whole rollout. CAMDM's released
    code takes first differences instead: see `coherence`.
    """
    return _ratio(*_joint_and_root_change(positions, 2))


def coherence(positions):
    """Mean joint step over the root's mean horizontal step: CAMDM's smoothness.

        mean_{t, j} || p_{t+1} - p_t ||  /  mean_t || the same of root x, z ||.

    Args:
      positions: [..., T, J, 3], metres, T >= 2.

    Returns:
      One ratio a character; 1 for a figure that glides without moving a limb, NaN where the root
      stands still.

    Raises:
      ValueError: for NaN, a wrong shape, or fewer than 2 frames.

    Source: the released CAMDM code, which names it "coherence" (first, not second, differences).
    Not comparable with `smoothness`, the F3AMD text's definition. Where the root stands still the
    code divides by 1 in its own unit, so that its figure depends on the unit: here that is NaN.
    """
    return _ratio(*_joint_and_root_change(positions, 1))


def foot_sliding(positions, skeleton: Skeleton, floor_shift=None, contact_height: float = CONTACT_HEIGHT):
    """Horizontal toe step while in contact over the root's horizontal step, and the contact share.

        mean over toe-frames in contact of || toe_{t+1} - toe_t ||_xz
            /  mean_t || root_{t+1} - root_t ||_xz

    A toe is in contact at t if it is less than `contact_height` above the floor there.

    Args:
      positions: [..., T, J, 3], metres, T >= 2.
      skeleton: whose toes are looked at.
      floor_shift: height of a resting toe, metres, one number or one a character. None takes each
        character's own lowest toe, so that the lowest toe counts as 0. Give it where that is
        known (from real motion of the style), lest a single dip lift the floor's reference.
      contact_height: metres.

    Returns:
      (value, contact_share), one pair of numbers a character. The share is over toe-frames, in
      [0, 1]. Without any contact the value is 0, as in CAMDM's code: a floating figure slides
      nowhere, so read the share beside it. NaN where the root stands still.

    Raises:
      ValueError: for NaN, a wrong shape, or fewer than 2 frames.

    Source: paper Appendix C (Foot Sliding, 1 cm). The text does not mention a lowering of the
    clip; CAMDM's code does it, and without it a toe joint that rests at 4 cm would never touch.
    """
    toe, step, root = _toes_and_root_step(positions, skeleton)
    if floor_shift is None:
        floor = toe[..., 1].min(axis=(-2, -1))
    else:
        floor = np.broadcast_to(np.asarray(floor_shift, dtype=np.float64), toe.shape[:-3])
        if not np.all(np.isfinite(floor)):  # nothing touches a floor that is nowhere, so that nothing would slide
            raise ValueError("floor_shift is not finite")
    contact = (toe[..., :-1, :, 1] - floor[..., None, None]) < contact_height
    slide = (step * contact).sum(axis=(-2, -1)) / np.maximum(contact.sum(axis=(-2, -1)), 1)
    return _ratio(slide, root), contact.mean(axis=(-2, -1))


def ird(positions, window: int):
    """Inter-round discontinuity, to the letter: how far joints move across a seam.

        100 * mean_{seams k, joints j} || p_{t_k + 1, j} - p_{t_k, j} ||.

    Real motion does not read 0 here but a walker's ordinary step (some 4 cm at 30 fps): set
    `inter_frame_step` beside it. Well below its own ordinary step, a character sticks at the seam.

    Args:
      positions: [..., T, J, 3], metres.
      window: frames.

    Returns:
      Centimetres, one a character.

    Raises:
      ValueError: for NaN, a wrong shape, or no boundary between windows.

    Source: paper section 4.4 (IRD), Eq. 10 as a metric. Our reading: the norm is that of each
    joint's displacement, averaged over joints ("mean Euclidean distance"), not of all stacked.
    """
    positions = checked_positions(positions)
    seams = seam_frames(positions.shape[-3], window)
    jump = positions[..., seams, :, :] - positions[..., seams - 1, :, :]
    return 100.0 * np.linalg.norm(jump, axis=-1).mean(axis=(-2, -1))


def ird_excess(positions, window: int):
    """How far a seam's step is from the step that the velocity before the seam would take.

        100 * mean_{k, j} || (p_{t_k + 1} - p_{t_k}) - (p_{t_k} - p_{t_k - 1}) ||.

    0 for motion that goes on as it went. Real motion accelerates a little in every frame, so its
    own value is the yardstick: the same formula at all frames is `joint_acceleration`.

    Args:
      positions: [..., T, J, 3], metres.
      window: frames, at least 2, so that the velocity before a seam is its own.

    Returns:
      Centimetres, one a character.

    Raises:
      ValueError: for NaN, a wrong shape, a window under 2, or no boundary between windows.

    Source: ours. Eq. 10 compares with standing still; this compares with going on.
    """
    positions = checked_positions(positions)
    if window < 2:
        raise ValueError(f"window must be 2 frames or more, got {window}")
    seams = seam_frames(positions.shape[-3], window)
    before, last, first = (positions[..., seams - back, :, :] for back in (2, 1, 0))
    return 100.0 * np.linalg.norm(first - 2.0 * last + before, axis=-1).mean(axis=(-2, -1))


def inter_frame_step(positions, spacing: int = 1):
    """How far joints move between adjacent frames: what `ird` reads on motion without seams.

    Args:
      positions: [..., T, J, 3], metres; for the "real row", real clips.
      spacing: take the steps into frames spacing, 2 * spacing, ...; 1 takes all of them, the
        window length takes those at which `ird` would look.

    Returns:
      Centimetres, one a character.

    Raises:
      ValueError: for NaN, a wrong shape, or too few frames for one step.

    Source: ours (the row of real motion beside Eq. 10).
    """
    return ird(positions, spacing)


def joint_acceleration(positions, fps: float = 30.0):
    """Mean magnitude of joint accelerations, not normalised by anything.

        100 * mean_{t, j} || p_{t+1} - 2 p_t + p_{t-1} || * (fps / 30)^2.

    Args:
      positions: [..., T, J, 3], metres, T >= 3.
      fps: frame rate of `positions`; the result is always for 1/30 s.

    Returns:
      Centimetres per frame squared at 30 fps (1 is 9 m/s^2), one a character.

    Raises:
      ValueError: for NaN, a wrong shape, or fewer than 3 frames.

    Source: ours; the numerator of `smoothness`, which a jerky root cannot flatter.
    """
    return 100.0 * (fps / 30.0) ** 2 * _joint_and_root_change(positions, 2)[0]


def path_drift(positions, path):
    """How far off the end is, over the length of the path: whole rollout, no windows.

        || (p_end - p_start) - (p*_end - p*_start) ||  /  length of p*.

    Args:
      positions: [..., T, J, 3], metres.
      path: the target, a `RootPath` or [..., T, 2] (x, z).

    Returns:
      Metres of error at the end per metre of path, one a character; NaN for a path of no length.

    Raises:
      ValueError: for NaN or shapes that do not fit.

    Source: ours, beside Traj., which by design does not see drift between windows.
    """
    root, target = _root_and_target(positions, path, least=2)
    gap = (root[..., -1, :] - root[..., 0, :]) - (target[..., -1, :] - target[..., 0, :])
    length = np.linalg.norm(np.diff(target, axis=-2), axis=-1).sum(axis=-1)
    return _ratio(np.linalg.norm(gap, axis=-1), length)


def _angle_error(angle: np.ndarray, wanted: np.ndarray, counts: np.ndarray):
    """Return | mean of wanted - angle |, degrees, over the frames that count; NaN for none."""
    number = counts.sum(axis=-1)
    total = np.sum(np.where(counts, wanted - angle, 0.0), axis=-1)
    return np.where(number > 0, np.rad2deg(np.abs(total)) / np.maximum(number, 1), np.nan)[()]


def camdm_trajectory_error(positions, path):
    """CAMDM's trajectory error: mean angle between wanted and walked steps, over the whole rollout.

        | mean_t(a*_t - a_t) |,  a_t = angle of the root's step on the ground from t to t + 1.

    The absolute value is taken after the mean. Errors to the left and to the right cancel, so that
    a zigzag about the path reads 0, as does a root at any distance beside it. The differences are
    not wrapped: a step that lies across the cut at +-180 degrees from its target counts as nearly
    360 degrees off. The cut lies at steps along +X, so that the figure is not the same for the
    same motion turned about +Y.

    Args:
      positions: [..., T, J, 3], metres, T >= 2.
      path: the target, a `RootPath` or [..., T, 2] (x, z).

    Returns:
      Degrees, one a character.

    Raises:
      ValueError: for NaN, shapes that do not fit, or fewer than 2 frames.

    Source: the released CAMDM code ("traj_error"), angles and cut as there. Our reading: the wanted
    direction is that of the path's own step (the code's comes from a list of commands), and frames
    in which path or root stand still have no direction and are left out; NaN if all are. (Section
    4.4 of the F3AMD text describes it with vectors from the first frame to the current one.)
    """
    steps = [np.diff(line, axis=-2) for line in _root_and_target(positions, path, least=2)]
    angle, wanted = (np.arctan2(step[..., 1], -step[..., 0]) for step in steps)
    lengths = [np.linalg.norm(step, axis=-1) for step in steps]
    return _angle_error(angle, wanted, np.minimum(*lengths) > _STILL)


def camdm_orientation_error(yaw, path):
    """CAMDM's orientation error: mean angle between wanted and shown facing, whole rollout.

        | mean_t(f*_t - f_t) |,  f_t = angle of the facing on the ground.

    As in `camdm_trajectory_error` signed errors cancel before the absolute value, and differences
    are not wrapped; here the cut lies at facing -X.

    Args:
      yaw: facing of the character, [..., T], radians.
      path: a `RootPath`, or the wanted facing [..., T], radians.

    Returns:
      Degrees, one a character.

    Raises:
      ValueError: for NaN or shapes that do not fit.

    Source: the released CAMDM code ("orien_error"), angles and cut as there. It takes the facing
    from shoulders and hips together, and so does `camdm_metrics` (`facing_yaw` with `shoulders`).
    """
    angle, wanted = (np.arctan2(np.cos(each), np.sin(each))[..., 0] for each in _shown_and_wanted_yaw(yaw, path))
    return _angle_error(angle, wanted, np.ones(angle.shape, dtype=bool))


def camdm_foot_sliding(positions, skeleton: Skeleton):
    """CAMDM's foot sliding: as `foot_sliding` with the clip lowered, but for its last frame.

        mean over toe-frames in contact of s_t  /  mean_t || root_{t+1} - root_t ||_xz,
        s_t = || toe_{t+1} - toe_t ||_xz,  and 0 for the last frame.

    Contact is a toe under 1 cm above the clip's lowest toe. A toe that touches in the last frame
    adds a step of 0, which lowers the figure by about 1 / T.

    Args:
      positions: [..., T, J, 3], metres, T >= 2.
      skeleton: whose toes are looked at.

    Returns:
      One ratio a character; 0 without any contact. NaN where the root stands still, where the code
      divides by 1 in its own unit.

    Raises:
      ValueError: for NaN, a wrong shape, or fewer than 2 frames.

    Source: the released CAMDM code.
    """
    toe, step, root = _toes_and_root_step(positions, skeleton)
    contact = toe[..., 1] - toe[..., 1].min(axis=(-2, -1), keepdims=True) < CONTACT_HEIGHT
    slide = (step * contact[..., :-1, :]).sum(axis=(-2, -1)) / np.maximum(contact.sum(axis=(-2, -1)), 1)
    return _ratio(slide, root)


def first_metrics(
    positions, path: RootPath, window: int, skeleton: Skeleton, *, floor_shift=None, fps: float = 30.0
) -> dict[str, float]:
    """Measure a rollout, or real motion, with everything that needs no classifier.

    Args:
      positions: of one character, [T, J, 3], metres.
      path: the target, T frames; the facing is compared with that of the hips.
      window: frames a window.
      skeleton: J joints, for toes and hips.
      floor_shift: see `foot_sliding`.
      fps: frame rate of `positions`.

    Returns:
      Key of `registry.METRICS` -> number.

    Raises:
      ValueError: for NaN, shapes that do not fit, or no boundary between windows.

    Source: paper section 4.4 and Appendix C, and the additions marked "ours" above.
    """
    yaw = facing_yaw(skeleton, np.asarray(positions, dtype=np.float64))
    slide, contact_share = foot_sliding(positions, skeleton, floor_shift)
    values = {
        "trajectory_error_m": trajectory_error(positions, path, window),
        "direction_error_deg": direction_error(yaw, path, window),
        "smoothness": smoothness(positions), "coherence": coherence(positions),
        "foot_sliding": slide, "contact_share": contact_share,
        "ird_cm": ird(positions, window), "ird_excess_cm": ird_excess(positions, window),
        "inter_frame_step_cm": inter_frame_step(positions),
        "joint_acceleration_cm": joint_acceleration(positions, fps),
        "path_drift": path_drift(positions, path),
    }  # fmt: skip
    return {key: float(value) for key, value in values.items()}


def camdm_metrics(positions, path: RootPath, skeleton: Skeleton) -> dict[str, float]:
    """Measure a rollout, or real motion, as the released CAMDM code does.

    Its definitions are not those of the F3AMD text, though some bear the same names there. Never
    set a figure of one beside a figure of the other.

    Args:
      positions, path, skeleton: as for `first_metrics`.

    Returns:
      Key of `registry.METRICS` -> number.

    Raises:
      ValueError: for NaN or shapes that do not fit.

    Source: the released CAMDM code.
    """
    yaw = facing_yaw(skeleton, np.asarray(positions, dtype=np.float64), shoulders=True)
    values = {
        "camdm_trajectory_error_deg": camdm_trajectory_error(positions, path),
        "camdm_orientation_error_deg": camdm_orientation_error(yaw, path),
        "camdm_foot_sliding": camdm_foot_sliding(positions, skeleton),
        "coherence": coherence(positions),
    }
    return {key: float(value) for key, value in values.items()}
