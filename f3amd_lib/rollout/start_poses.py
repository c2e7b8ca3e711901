"""Where rollouts begin: in a stored starting pose, or where a motion of the user's ends (`f3amd rollout --start`)."""

from collections.abc import Callable

import numpy as np

from f3amd_lib.data.features import (
    center_window,
    frame_yaw,
    motion_from_frames,
    num_channels,
    turn_frames,
    world_frames,
)
from f3amd_lib.motion.retarget import retarget
from f3amd_lib.motion.root_paths import RootPath
from f3amd_lib.motion.skeleton import Motion, resample
from f3amd_lib.training.checkpoints import TrainedModel


def path_start(position):
    """Return where a path [..., F, 2] would have been one frame before its first, [..., 2]."""
    return 2.0 * position[..., 0, :] - position[..., 1, :]


def pose_speed(poses: np.ndarray) -> np.ndarray:
    """Return how fast starting poses [K, H, C] move over the ground, [K], metres a frame."""
    travelled = np.linalg.norm(poses[:, -1, [0, 2]] - poses[:, 0, [0, 2]], axis=-1)
    return travelled / max(1, poses.shape[1] - 1)


def starting_poses(trained: TrainedModel, style_index, start, yaw, speed, pick: Callable) -> np.ndarray:
    """Pick a stored starting pose for each character, and move it to where its path begins.

    Args:
      trained: the model; it has to have poses of all the styles.
      style_index: places in `trained.styles`, [B].
      start: x, z of the last frame, [B, 2], metres.
      yaw: facing there, [B], radians.
      speed: of the path, [B], metres a frame.
      pick: chooses among the poses about as fast as the paths: `pick(style, members, counts)` returns a number from 0
        for each of the characters `members` of a style, who have `counts` poses to choose from.

    Returns:
      World frames, [B, H, C], float64.
    """
    poses = np.empty((len(style_index), trained.config.num_history, num_channels(trained.skeleton)))
    for style in np.unique(style_index):
        members = np.flatnonzero(np.asarray(style_index) == style)
        choices = trained.start_poses[trained.styles[style]]
        gap = np.abs(pose_speed(choices) - speed[members, None])
        fitting = gap <= gap.min(axis=-1, keepdims=True) + 0.1 / 30.0
        number = pick(style, members, fitting.sum(axis=1))
        # The first place where more than `number` fitting poses have been passed.
        poses[members] = choices[np.argmax(fitting.cumsum(axis=1) > number[:, None], axis=1)]
    return center_window(turn_frames(poses, yaw), -start)


def start_history(trained: TrainedModel, motion: Motion, path: RootPath) -> tuple[np.ndarray, str]:
    """Make a motion's last frames the history of a rollout along a path.

    A motion of the model's own skeleton is taken as it is; one of another humanoid is retargeted.

    Args:
      trained: the model.
      motion: at any frame rate.
      path: what is to be followed; the history is moved to its start and turned to face as it does.

    Returns:
      World frames, [1, H, C], for `MotionGenerator.rollout(history=...)`, and a sentence that says what was done.

    Raises:
      ValueError: for a motion shorter than the history, or a skeleton whose joints we cannot name.
    """
    motion, frames = resample(motion, 30.0, smooth=True), trained.config.num_history
    if motion.num_frames < frames:
        needed = f"{frames}, {frames / 30.0:.1f} s"
        raise ValueError(f"{motion.name}: {motion.num_frames} frames at 30 fps; a start needs {needed}")
    motion = motion.slice(motion.num_frames - frames, motion.num_frames)
    if motion.skeleton == trained.skeleton:
        note = f"{motion.name}: the model's own skeleton, taken as it is"
    else:
        pose = next(iter(trained.start_poses.values()))[0]
        made, scale, error = retarget(motion, motion_from_frames(trained.skeleton, pose))
        joints = f"{motion.skeleton.num_joints} joints, the model's has {trained.skeleton.num_joints}"
        off = f"legs scaled by {scale:.2f}, joints off by {error.mean():.1f} cm on average"
        note = f"{motion.name}: another skeleton ({joints}), retargeted by role; {off}"
        motion = made
    world = world_frames(motion)
    turn = path.yaw[0] - frame_yaw(trained.skeleton, world)[-1]
    turned = turn_frames(center_window(world, world[-1, [0, 2]]), turn)
    return center_window(turned, -path_start(path.position))[None].astype(np.float32), note
