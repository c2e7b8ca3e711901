"""Inverse kinematics: rotations of a skeleton with fixed bones that bring its joints to where they should be.

Bone by bone from the root down, each in closed form, so that positions that come from the skeleton are met exactly.
"""

import numpy as np

from f3amd_lib.ground.arrays import array_module
from f3amd_lib.motion.rotations import shortest_turn
from f3amd_lib.motion.skeleton import Motion, Skeleton, compose, forward_kinematics

_NO_LENGTH = 1e-9
"""Metres under which a bone has no direction."""

_PULL = 1e-9
"""Weight, m^2, by which a joint whose children leave its twist open follows its parent."""


def fit_rotations(skeleton: Skeleton, positions):
    """Return (root positions [T, 3], local rotations [T, J, 3, 3]) that bring joints near positions.

    A joint aims its bones from where it came to stand at where its children should be: several bones by the rotation of
    least squares (Kabsch 1976), a single one by the smallest turn from the parent's frame, which leaves it without
    twist. In the end the whole body moves by the mean of what is left. A joint without children keeps its parent's
    frame: positions do not tell how it is turned.

    Args:
      skeleton: J joints.
      positions: [T, J, 3], metres; bones may have any lengths. JAX in, JAX out; all else is reckoned in numpy, float64.
    """
    xp = array_module(positions)
    positions = xp.asarray(positions, np.float64 if xp is np else None)
    start = xp.broadcast_to(xp.eye(3, dtype=positions.dtype), (len(positions), 3, 3))
    turned, local, placed = [], [], []
    for joint, parent in enumerate(skeleton.parents):
        above = start if parent < 0 else turned[parent]
        offset = skeleton.offsets[joint].astype(positions.dtype)
        placed.append(positions[:, 0] if parent < 0 else placed[parent] + xp.sum(above * offset, axis=-1))
        children = np.array(skeleton.children[joint], int)
        bones = children[np.linalg.norm(skeleton.offsets[children], axis=-1) > _NO_LENGTH]
        wanted = positions[:, bones] - placed[joint][:, None]
        wanted = xp.sum(wanted[..., None] * above[:, None], axis=-2)  # in the parent's frame
        local.append(aimed(skeleton.offsets[bones].astype(positions.dtype), wanted) if len(bones) else start)
        turned.append(compose(above, local[joint]))
    local = xp.stack(local, axis=1)
    left = xp.mean(positions - forward_kinematics(skeleton, positions[:, 0], local), axis=1)
    return positions[:, 0] + left, local


def aimed(was: np.ndarray, shall):
    """Return the rotations [T, 3, 3] that bring vectors [K, 3] nearest to others, [T, K, 3] (Kabsch 1976).

    A single one takes the smallest turn; where several leave a rotation open, none at all is preferred.
    """
    xp = array_module(shall)
    if len(was) == 1:
        nowhere = xp.linalg.norm(shall[:, 0], axis=-1, keepdims=True) < _NO_LENGTH
        return shortest_turn(was, xp.where(nowhere, was, shall[:, 0]))
    spread = xp.sum(shall[..., :, None] * was[:, None, :], axis=1)
    left, _, right = xp.linalg.svd(spread + _PULL * np.eye(3, dtype=was.dtype))
    sign = xp.linalg.det(left) * xp.linalg.det(right)
    left = left * xp.stack([xp.ones_like(sign), xp.ones_like(sign), sign], axis=-1)[:, None]
    return compose(left, right)


def fitted(motion: Motion) -> tuple[Motion, np.ndarray]:
    """Return (a motion with rotations, how far its joints are from those given, [T, J], metres)."""
    root_position, rotations = fit_rotations(motion.skeleton, motion.positions)
    made = Motion(motion.skeleton, root_position, rotations, motion.fps, motion.name)
    return made, np.linalg.norm(made.positions - motion.positions, axis=-1)
