"""Windows of history and future, cut on the device (paper sections 3.2, 3.3, 4.5).

The whole training set is one array of world frames plus the list of frames at which a window may
start. A batch is a gather, a random turn and a subtraction, all inside the jitted step: there is no
Python loop over samples.
"""

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.ndimage import gaussian_filter1d

from f3amd_lib.data import features
from f3amd_lib.data.packed import PackedMotion
from f3amd_lib.data.sources import SPLITS
from f3amd_lib.ground.names import check_known
from f3amd_lib.motion.rotations import wrap_angle
from f3amd_lib.motion.skeleton import Skeleton, mirror

_SMOOTHING = (0.0, 5.0, 10.0)
"""Widths in frames of the Gaussians that smooth the path condition (0: as captured)."""

_POSE_RECOVERY = 8
"""Frames over which a training target leads from a generated pose back to the captured one."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False)
class WindowSet:
    """All windows of one split, on the device.

    Attributes:
      window, num_history: the frames T and H that every start has room for.
      frames: world frames of all clips end to end, [N, C].
      paths: root x, z, sin(yaw), cos(yaw) per frame, raw and smoothed, [3, N, 4].
      starts: first frame of each window, [W].
      room: frames of the same clip before each window, [W].
      styles: style index of each window, [W].
      one_hot: the one-hot vector of each style of the data, [S, styles that the model knows].
    """

    window: int = field(metadata={"static": True})
    num_history: int = field(metadata={"static": True})
    frames: jax.Array
    paths: jax.Array
    starts: jax.Array
    room: jax.Array
    styles: jax.Array
    one_hot: jax.Array

    @property
    def num_windows(self) -> int:
        """Number of windows, W."""
        return self.starts.shape[0]


class Batch(NamedTuple):
    """What a training step sees, in metres and 6D numbers; x, z relative to the last history frame.

    Attributes:
      history: [B, H, C].
      future: clean features x0, [B, T, C].
      path: path condition, [B, T, 8].
      style: one-hot, [B, S].
    """

    history: jax.Array
    future: jax.Array
    path: jax.Array
    style: jax.Array


def _smooth(signal: np.ndarray, width: float, of: Callable = np.asarray) -> np.ndarray:
    """Smooth a function of a signal along axis 0; odd reflection at the ends lets a straight path stay straight."""
    if width == 0.0 or len(signal) < 2:
        return of(signal)
    pad = int(4 * width) + 1
    # numpy reflects as often as it takes where a clip is shorter than the kernel.
    padded = np.pad(signal, ((pad, pad), (0, 0)), mode="reflect", reflect_type="odd")
    return gaussian_filter1d(of(padded), width, axis=0)[pad : pad + len(signal)]


def _path_variants(skeleton: Skeleton, frames: np.ndarray) -> np.ndarray:
    """Return x, z, sin yaw, cos yaw under each smoothing, [3, T, 4]."""
    yaw = np.unwrap(features.frame_yaw(skeleton, frames))[:, None]
    # The facing is smoothed as a direction, as in CAMDM: the mean of two angles may lie the long way round.
    facing = lambda angle: np.concatenate([np.sin(angle), np.cos(angle)], axis=1)
    variants = []
    for width in _SMOOTHING:
        direction = _smooth(yaw, width, facing)
        direction = direction / np.maximum(np.linalg.norm(direction, axis=1, keepdims=True), 1e-9)
        variants.append(np.concatenate([_smooth(frames[:, [0, 2]], width), direction], axis=1))
    return np.stack(variants)


def build_windows(
    packed: PackedMotion, split: str, *, window: int = 32, num_history: int = 10, stride: int = 1,
    mirrored: bool | None = None, styles: Sequence[str] = (),
) -> WindowSet:  # fmt: skip
    """Lay all windows of a split out on the device.

    Args:
      packed: a packed data set.
      split: "train", "validation" or "test".
      window: future frames T.
      num_history: history frames H.
      stride: frames between window starts.
      mirrored: add the mirror image of every clip whose style may be mirrored; by default in
        training only.
      styles: the names that a model's one-hot vector stands for, if it knows more of them, or in
        another order, than this data set.

    Returns:
      The window set.

    Raises:
      ValueError: for an unknown split, a style that `styles` lacks, or if no clip is long enough.
    """
    names = tuple(styles) or packed.styles
    if missing := set(packed.styles) - set(names):
        raise ValueError(f"the model does not know the style {min(missing)!r} of this data set")
    check_known(split, SPLITS, "split")
    mirrored = split == "train" if mirrored is None else mirrored
    frames, paths, columns, offset = [], [], [], 0
    for clip in np.flatnonzero(np.asarray(packed.clip_split) == SPLITS.index(split)):
        motion = packed.motion(int(clip))
        style = int(packed.clip_style[clip])
        takes = [motion]
        if mirrored and packed.styles[style] in packed.mirror_styles:
            takes.append(mirror(motion))
        for take in takes:
            world = features.world_frames(take)
            first = np.arange(0, len(world) - (num_history + window) + 1, stride)
            columns.append([offset + first, first, np.full(len(first), style)])
            frames.append(world.astype(np.float32))
            paths.append(_path_variants(take.skeleton, world).astype(np.float32))
            offset += len(world)
    if not any(len(first) for first, _, _ in columns):
        raise ValueError(f"data set {packed.name!r} has no {split} clip of at least {num_history + window} frames")
    starts_room_styles = (jnp.asarray(column, jnp.int32) for column in np.concatenate(columns, axis=1))
    one_hot = jnp.eye(len(names), dtype=jnp.float32)[jnp.array([names.index(style) for style in packed.styles])]
    frames, paths = jnp.asarray(np.concatenate(frames)), jnp.asarray(np.concatenate(paths, axis=1))
    return WindowSet(window, num_history, frames, paths, *starts_room_styles, one_hot)


@functools.partial(jax.jit, static_argnames="earlier")
def gather_windows(windows: WindowSet, index, yaw, smoothing, *, earlier: int = 0) -> Batch:
    """Cut chosen windows, turned and made relative.

    Args:
      windows: from `build_windows`.
      index: which windows, [B].
      yaw: turn of each, [B], radians (the random facing of section 3.2).
      smoothing: which path to show as condition, [B] of 0, 1, 2: as captured, or smoothed with a
        Gaussian of 5 or 10 frames.
      earlier: cut the windows that start so many frames before; where `windows.room` has fewer,
        the answer is a window of other frames and not to be used.

    Returns:
      The batch.
    """
    num_history = windows.num_history
    start = jnp.maximum(windows.starts[index] - earlier, 0)
    span = start[:, None] + jnp.arange(num_history + windows.window)[None, :]
    frames = windows.frames[span]
    last = num_history - 1
    frames = features.turn_frames(features.center_window(frames, frames[:, last, jnp.array([0, 2])]), yaw)
    track = windows.paths[smoothing[:, None], span]
    shift = track[..., :2] - track[:, last : last + 1, :2]
    # (x, z) turned by yaw: x' = x cos + z sin, z' = z cos - x sin
    cosine, sine = jnp.cos(yaw)[:, None], jnp.sin(yaw)[:, None]
    x, z = shift[..., 0], shift[..., 1]
    position = jnp.stack([x * cosine + z * sine, z * cosine - x * sine], axis=-1)
    facing = wrap_angle(jnp.arctan2(track[..., 2], track[..., 3]) + yaw[:, None])
    path = features.path_condition(position, facing)[:, num_history:]
    style = windows.one_hot[windows.styles[index]]
    return Batch(frames[:, :num_history], frames[:, num_history:], path, style)


def draw_windows(windows: WindowSet, key, batch_size: int, captured_path_share: float = 0.5):
    """Draw which windows to cut, how far to turn them and which path to show.

    A captured path sways with every step and gives the gait away, while the paths that users draw
    are smooth: a share of the paths is shown as captured, the rest under one of two smoothings.

    Args:
      windows: from `build_windows`.
      key: JAX random key.
      batch_size: B.
      captured_path_share: CAMDM's training takes 0.5; F3AMD's text does not mention smoothing.

    Returns:
      (index, yaw, smoothing), each [B], for `gather_windows`.
    """
    key_index, key_yaw, key_captured, key_width = jax.random.split(key, 4)
    index = jax.random.randint(key_index, (batch_size,), 0, windows.num_windows)
    yaw = jax.random.uniform(key_yaw, (batch_size,), minval=-jnp.pi, maxval=jnp.pi)
    captured = jax.random.bernoulli(key_captured, captured_path_share, (batch_size,))
    width = jax.random.randint(key_width, (batch_size,), 1, len(_SMOOTHING))
    return index, yaw, jnp.where(captured, 0, width)


def sample_windows(windows: WindowSet, key, batch_size: int) -> Batch:
    """Draw random windows with random facing and random path smoothing (see `draw_windows`).

    Source: paper section 3.2 (facing); CAMDM's training recipe (smoothing).
    """
    return gather_windows(windows, *draw_windows(windows, key, batch_size))


def spread_windows(windows: WindowSet, num_samples: int) -> Batch:
    """Return windows spread evenly over a set, unturned, with the path as captured.

    Args:
      windows: from `build_windows`.
      num_samples: how many, at most as many as there are.

    Returns:
      The batch; the same every time, so that measurements compare.
    """
    count = min(num_samples, windows.num_windows)
    index = jnp.asarray(np.linspace(0, windows.num_windows - 1, count).astype(np.int32))
    return gather_windows(windows, index, jnp.zeros(count), jnp.zeros(count, jnp.int32))


def restart_from(batch: Batch, history) -> Batch:
    """Put other histories in the place of captured ones, as a rollout meets them.

    The character stands and is posed a little off the captured motion. The future is measured from
    where it stands, and what is asked for leads back without a jump: the path bends to the captured
    line over the window, exactly as in a rollout (`bend_path`), and the pose over a quarter second.

    Args:
      batch: captured windows, [B, ...].
      history: other frames to start from, [B, H, C], in the batch's coordinates; where they are the
        captured ones, nothing changes.

    Returns:
      The batch with new `history`, `future` and `path`.
    """
    plane = jnp.array([0, 2])
    error = history[:, -1] - batch.history[:, -1]
    num_frames, channels = batch.future.shape[1:]
    frame = jnp.arange(1, num_frames + 1)[:, None]
    remains = jnp.maximum(1.0 - frame / _POSE_RECOVERY, 0.0) * jnp.ones(channels)
    remains = remains.at[:, plane].set(1.0 - frame / num_frames)
    drift = error[:, plane]
    future = features.center_window(batch.future, drift) + remains * error[:, None, :]
    position = features.bend_path(batch.path[..., :2], -drift)
    return batch._replace(
        history=features.center_window(history, history[:, -1, plane]),
        future=features.orthonormalise(future),
        path=jnp.concatenate([position, batch.path[..., 2:]], axis=-1),
    )


def mean_poses(windows: WindowSet) -> jax.Array:
    """Return the mean pose of each style, [S, C - 9]: 6D local rotations without the root's."""
    num_styles = windows.one_hot.shape[0]
    poses = windows.frames[windows.starts, 9:]
    total = jax.ops.segment_sum(poses, windows.styles, num_styles)
    count = jax.ops.segment_sum(jnp.ones(len(poses)), windows.styles, num_styles)
    return total / jnp.maximum(count, 1.0)[:, None]


@jax.jit
def fit_normaliser(windows: WindowSet, key) -> features.Normaliser:
    """Measure mean and deviation of each channel over randomly turned training windows.

    Deviations are kept above 0.02, so that a joint which hardly moves does not turn rounding of the
    packed rotations into signal.
    """
    batch = sample_windows(windows, key, min(8192, 4 * windows.num_windows))
    flat = batch.future.reshape(-1, batch.future.shape[-1])
    mean, deviation = flat.mean(axis=0), flat.std(axis=0)
    # A random turn makes x and z alike, of the root and of its rotation: measure
    # them as one, around zero, so that turning commutes with normalising.
    for first in (0, 3, 6):
        pair = jnp.array([first, first + 2])
        mean = mean.at[pair].set(0.0)
        deviation = deviation.at[pair].set(jnp.sqrt(jnp.mean(flat[:, pair] ** 2)))
    deviation = jnp.maximum(deviation, 0.02)
    return features.Normaliser(mean, deviation, deviation[0])


def starting_poses(packed: PackedMotion, *, num_history: int = 10, num_poses: int = 8) -> dict:
    """Cut a few starting poses per style out of a packed data set: of its first split that has the style.

    Args:
      packed: the data.
      num_history: frames H of each.
      num_poses: most per style; each comes from the middle of another clip.

    Returns:
      Style name -> [K, H, C] world frames, the last one at x = z = 0 and facing +Z.
    """
    starts = {}
    for style, name in enumerate(packed.styles):
        known = np.flatnonzero(packed.clip_style == style)
        if not len(known):
            continue
        chosen = known[packed.clip_split[known] == packed.clip_split[known].min()]
        cuts = []
        spread = np.linspace(0, len(chosen) - 1, min(num_poses, len(chosen))).astype(int)
        for clip in chosen[spread]:
            motion = packed.motion(int(clip))
            start = max(0, motion.num_frames // 2 - num_history)
            frames = features.world_frames(motion.slice(start, start + num_history))
            frames = features.center_window(frames, frames[-1, [0, 2]])
            cuts.append(features.turn_frames(frames, -features.frame_yaw(motion.skeleton, frames[-1])))
        starts[name] = np.stack(cuts).astype(np.float32)
    return starts
