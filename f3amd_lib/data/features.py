"""Motion as numbers for the network, and back (paper sections 3.2 and 3.3).

One frame is x = [root x, root y, root z, 6D of joint 0, 6D of joint 1, ...], C = 6 J + 3 channels:
metres, and the first two columns of each joint's local rotation matrix, the root's being global.
"World" frames keep the root where it is; a window is made relative by `center_window`. Functions
take numpy or JAX arrays alike.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from f3amd_lib.ground.arrays import array_module, exact_products, finite_array
from f3amd_lib.motion import rotations
from f3amd_lib.motion.skeleton import Motion, Skeleton, forward_kinematics


def num_channels(skeleton: Skeleton) -> int:
    """Return C = 6 J + 3."""
    return 6 * skeleton.num_joints + 3


def world_frames(motion: Motion) -> np.ndarray:
    """Turn a motion into world frames, [T, C], float64."""
    matrices = np.asarray(motion.needed_rotations("a frame of features"), np.float64)
    flat = rotations.rotation_6d_from_matrix(matrices).reshape(motion.num_frames, -1)
    return np.concatenate([np.asarray(motion.root_position, np.float64), flat], axis=-1)


def split_frames(frames):
    """Split frames [..., C] into root positions [..., 3] and 6D rotations [..., J, 6]."""
    joints = (frames.shape[-1] - 3) // 6
    return frames[..., :3], frames[..., 3:].reshape(*frames.shape[:-1], joints, 6)


def motion_from_frames(skeleton: Skeleton, frames, fps: float = 30.0, name: str = "") -> Motion:
    """Turn world frames [T, C] back into a motion; the inverse of `world_frames`.

    Rotations are made orthonormal on the way, which leaves true rotations as they are.

    Raises:
      ValueError: if the channel count does not fit the skeleton, or a number is not finite.
    """
    label = f"frames of {skeleton.num_joints} joints"
    root_position, rotation_6d = split_frames(finite_array(label, frames, ("frame", num_channels(skeleton))))
    return Motion(skeleton, root_position, rotations.matrix_from_rotation_6d(rotation_6d), fps, name)


def frame_positions(skeleton: Skeleton, frames):
    """Return global joint positions [..., J, 3] of frames [..., C]; FK of Eqs 10, 12, 13."""
    root_position, rotation_6d = split_frames(frames)
    return forward_kinematics(skeleton, root_position, rotations.matrix_from_rotation_6d(rotation_6d))


def frame_yaw(skeleton: Skeleton, frames):
    """Return the hips' facing angle of frames [..., C], radians, [...].

    Equals `facing_yaw` of the full kinematics; only the root's rotation is needed, because the hip
    joints hang from the root.

    Raises:
      ValueError: if the skeleton's hip joints are not children of the root.
    """
    xp = array_module(frames)
    left, right = skeleton.role("left_hip"), skeleton.role("right_hip")
    if skeleton.parents[left] != 0 or skeleton.parents[right] != 0:
        raise ValueError("facing needs hip joints that are children of the root joint")
    across_local = (skeleton.offsets[left] - skeleton.offsets[right]).astype(frames.dtype)
    root = rotations.matrix_from_rotation_6d(frames[..., 3:9])
    with exact_products():
        across = xp.einsum("...ab,b->...a", root, across_local)
    return xp.arctan2(-across[..., 2], across[..., 0])


def orthonormalise(frames):
    """Return frames with every 6D block pulled back onto a rotation, [..., C]."""
    xp = array_module(frames)
    root_position, rotation_6d = split_frames(frames)
    clean = rotations.rotation_6d_from_matrix(rotations.matrix_from_rotation_6d(rotation_6d))
    return xp.concatenate([root_position, clean.reshape(*frames.shape[:-1], -1)], axis=-1)


def center_window(frames, origin):
    """Move frames [..., T, C] so that `origin` [..., 2] (x, z) becomes the plane's origin.

    Height stays absolute (section 3.2; our origin is the last history frame).
    """
    xp = array_module(frames)
    x = frames[..., 0:1] - origin[..., None, 0:1]
    z = frames[..., 2:3] - origin[..., None, 1:2]
    return xp.concatenate([x, frames[..., 1:2], z, frames[..., 3:]], axis=-1)


def turn_frames(frames, yaw):
    """Turn frames [..., T, C] about the origin's +Y axis by yaw [...] radians (section 3.2)."""
    xp = array_module(frames)
    matrix = rotations.matrix_from_yaw(yaw)
    # Root position and the two columns of the root's rotation are three vectors to turn.
    vectors = frames[..., :9].reshape(*frames.shape[:-1], 3, 3)
    with exact_products():
        turned = xp.einsum("...ab,...tvb->...tva", matrix, vectors)
    return xp.concatenate([turned.reshape(*frames.shape[:-1], 9), frames[..., 9:]], axis=-1)


def path_condition(position, yaw):
    """Build the path condition of section 3.3.

    Args:
      position: root x, z relative to the last history frame, [..., T, 2], metres.
      yaw: facing, [..., T], radians.

    Returns:
      [..., T, 8]: displacement, then yaw in 6D.
    """
    xp = array_module(position, yaw)
    facing = rotations.rotation_6d_from_matrix(rotations.matrix_from_yaw(yaw))
    return xp.concatenate([position, facing], axis=-1)


def bend_path(displacement, drift):
    """Add a drift to a path little by little over the window, all of it at the last frame.

    A target that jumped by the drift at once would ask for a jump.

    Args:
      displacement: [..., T, 2], metres.
      drift: [..., 2], from where the character is to where the path wants it, metres.

    Returns:
      [..., T, 2].
    """
    xp = array_module(displacement, drift)
    frames = displacement.shape[-2]
    ramp = xp.arange(1, frames + 1, dtype=displacement.dtype)[:, None] / frames
    return displacement + ramp * drift[..., None, :]


class Normaliser(NamedTuple):
    """Per-channel mean and deviation of the training windows.

    Attributes:
      mean, deviation: [C], for features.
      path_scale: metres that count as 1 in the path condition (a scalar).
    """

    mean: jax.Array
    deviation: jax.Array
    path_scale: jax.Array

    @classmethod
    def identity(cls, channels: int) -> Normaliser:
        """Return the normaliser that changes nothing (the `-raw` presets)."""
        return cls(jnp.zeros(channels), jnp.ones(channels), jnp.ones(()))

    def normalise(self, x):
        """Map features [..., C] to network units."""
        return (x - self.mean) / self.deviation

    def denormalise(self, x):
        """Map network units [..., C] back to metres and 6D numbers."""
        return x * self.deviation + self.mean

    def normalise_path(self, path):
        """Scale the displacement of a path condition [..., 8]; its yaw stays."""
        return jnp.concatenate([path[..., :2] / self.path_scale, path[..., 2:]], axis=-1)


def lowest_toe_height(motion: Motion) -> float:
    """Return the lowest height of either toe joint over a clip, metres."""
    return float(motion.positions[:, list(motion.skeleton.toes), 1].min())
