"""Inverse kinematics: rotations of a skeleton with fixed bones that bring its joints to where they should be.

Bone by bone from the root down, each in closed form, so that positions that come from the skeleton are met exactly.
"""

from __future__ import annotations

import numpy as np

from f3amd_lib.motion.rotations import shortest_turn
from f3amd_lib.motion.skeleton import Motion, Skeleton, forward_kinematics

_NO_LENGTH = 1e-9
"""Metres under which a bone has no direction."""

_PULL = 1e-9
"""Weight, m^2, by which a joint whose children leave its twist open follows its parent."""


def fit_rotations(skeleton: Skeleton, positions) -> tuple[np.ndarray, np.ndarray]:
    """Return (root positions [T, 3], local rotations [T, J, 3, 3]) that bring joints near positions.

    A joint aims its bones from where it came to stand at where its children should be: several bones by the rotation of
    least squares (Kabsch 1976), a single one by the smallest turn from the parent's frame, which leaves it without
    twist. In the end the whole body moves by the mean of what is left. A joint without children keeps its parent's
    frame: positions do not tell how it is turned.

    Args:
      skeleton: J joints.
      positions: [T, J, 3], metres; bones may have any lengths.
    """
    positions = np.asarray(positions, np.float64)
    frames, joints = positions.shape[:2]
    turned = np.broadcast_to(np.eye(3), (frames, joints, 3, 3)).copy()
    local, placed = turned.copy(), positions.copy()
    for joint, parent in enumerate(skeleton.parents):
        above = np.broadcast_to(np.eye(3), (frames, 3, 3))
        if parent >= 0:
            above = turned[:, parent]
            placed[:, joint] = placed[:, parent] + above @ skeleton.offsets[joint]
        children = [child for child, its in enumerate(skeleton.parents) if its == joint]
        bones = [child for child in children if np.linalg.norm(skeleton.offsets[child]) > _NO_LENGTH]
        wanted = positions[:, bones] - placed[:, joint, None]
        local[:, joint] = _aimed(skeleton.offsets[bones], wanted @ above)
        turned[:, joint] = above @ local[:, joint]
    left = np.mean(positions - forward_kinematics(skeleton, positions[:, 0], local), axis=1)
    return positions[:, 0] + left, local


def _aimed(offsets: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Return rotations [T, 3, 3] that turn offsets [K, 3] towards wanted [T, K, 3], both in the parent's frame."""
    if len(offsets) == 1:
        direction = wanted[:, 0]
        nowhere = np.linalg.norm(direction, axis=-1, keepdims=True) < _NO_LENGTH
        return shortest_turn(offsets, np.where(nowhere, offsets, direction))
    # For no bone at all the sum is the pull alone: no turn.
    left, _, right = np.linalg.svd(np.einsum("tki,kj->tij", wanted, offsets) + _PULL * np.eye(3))
    left[..., -1] *= np.linalg.det(left @ right)[:, None]
    return left @ right


def fitted(motion: Motion) -> tuple[Motion, np.ndarray]:
    """Return (a motion with rotations, how far its joints are from those given, [T, J], metres)."""
    root_position, rotations = fit_rotations(motion.skeleton, motion.positions)
    made = Motion(motion.skeleton, root_position, rotations, motion.fps, motion.name)
    return made, np.linalg.norm(made.positions - motion.positions, axis=-1)
