"""What the style classifier sees of motion: two seconds of posture, without place and direction.

Source: CAMDM's released evaluation code (its feature extraction).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from f3amd_lib.ground.files import read_toml
from f3amd_lib.measures.metrics import checked_positions
from f3amd_lib.motion.rotations import matrix_from_yaw
from f3amd_lib.motion.skeleton import Skeleton, check_joints, facing_yaw

_JOINTS = read_toml(Path(__file__).with_name("classifier_joints.toml"))
_CONVENTIONS = _JOINTS["conventions"]

CLASSIFIER_JOINTS = tuple(_JOINTS["joints"])
"""The 15 joints that the classifier sees."""

NUM_CHANNELS = 3 * len(CLASSIFIER_JOINTS)
"""Numbers a frame: x, y, z of each of `CLASSIFIER_JOINTS`."""


def classifier_joints(skeleton: Skeleton) -> tuple[int, ...]:
    """Find the joints of `CLASSIFIER_JOINTS` in a skeleton.

    Args:
      skeleton: with the joint names of 100STYLE (and our synthetic walker), Bandai Namco or Mixamo.

    Returns:
      15 joint indices, in the order of `CLASSIFIER_JOINTS`.

    Raises:
      ValueError: naming the joints that are missing.
    """
    names = [name.removeprefix("mixamorig:") for name in skeleton.names]
    missing = {
        convention: [
            f"{name!r} ({joint})" for joint, name in zip(CLASSIFIER_JOINTS, wanted, strict=True) if name not in names
        ]
        for convention, wanted in _CONVENTIONS.items()
    }
    nearest = min(missing, key=lambda convention: len(missing[convention]))
    if missing[nearest]:
        raise ValueError(
            f"the style classifier finds no {', '.join(missing[nearest])} in this skeleton; by "
            f"the names of {nearest}, the nearest convention, it has {', '.join(skeleton.names)}"
        )
    return tuple(names.index(name) for name in _CONVENTIONS[nearest])


def classifier_frames(positions, skeleton: Skeleton) -> np.ndarray:
    """Reduce joint positions to what the classifier sees: posture, without place and direction.

    Each frame is moved so that its hips are the origin and turned about the vertical so that its
    own facing, shoulders among it (`facing_yaw`), is +Z. (CAMDM's code turns to +X, which is the
    same up to the order and sign of channels.)

    Args:
      positions: global joint positions, [..., T, J, 3], metres.
      skeleton: J joints.

    Returns:
      [..., T, 45], metres, float64: x, y, z of each of `CLASSIFIER_JOINTS`.

    Raises:
      ValueError: for a wrong shape, numbers that are not finite, or a skeleton without one of the
        joints.

    Source: CAMDM's evaluation code (its feature extraction).
    """
    positions = checked_positions(positions)
    check_joints(skeleton, positions)
    seen = list(classifier_joints(skeleton))
    body = positions - positions[..., seen[:1], :]
    turned = body[..., seen, :] @ np.swapaxes(matrix_from_yaw(-facing_yaw(skeleton, body, shoulders=True)), -1, -2)
    return turned.reshape(*turned.shape[:-2], NUM_CHANNELS)


def side_by_side(frames: np.ndarray, window: int) -> np.ndarray:
    """Cut frames [..., T, 45] into windows side by side, [..., T // window, window, 45], float32; the rest is left."""
    count = frames.shape[-2] // window
    whole = frames[..., : count * window, :].astype(np.float32)
    return whole.reshape(*whole.shape[:-2], count, window, NUM_CHANNELS)


def mirror_channels() -> tuple[np.ndarray, np.ndarray]:
    """Return (which channel to take, its sign), each [45], that show a frame in the mirror."""
    twin = {"left": "right", "right": "left"}
    mirrored = [" ".join(twin.get(word, word) for word in joint.split()) for joint in CLASSIFIER_JOINTS]
    twins = [CLASSIFIER_JOINTS.index(joint) for joint in mirrored]
    order = 3 * np.repeat(twins, 3) + np.tile(np.arange(3), len(twins))
    return order, np.tile(np.array([-1.0, 1.0, 1.0], np.float32), len(twins))
