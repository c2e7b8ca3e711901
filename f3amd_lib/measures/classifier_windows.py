"""What the style classifier sees of motion: two seconds of posture, without place and direction.

Source: CAMDM's released evaluation code (its feature extraction).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from f3amd_lib.ground.files import read_toml
from f3amd_lib.motion.curves import unit
from f3amd_lib.motion.rotations import matrix_from_yaw, yaw_from_direction
from f3amd_lib.motion.skeleton import Skeleton

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
    own facing is +Z. Facing here is cross(a, +Y) with a = unit(left - right clavicle) + unit(left -
    right hip): it takes in the shoulders, unlike `facing_yaw`, which serves paths and sees the hips
    only. (CAMDM's code turns to +X, which is the same up to the order and sign of channels.)

    Args:
      positions: global joint positions, [..., T, J, 3], metres.
      skeleton: J joints.

    Returns:
      [..., T, 45], metres, float64: x, y, z of each of `CLASSIFIER_JOINTS`.

    Raises:
      ValueError: for shapes that do not fit the skeleton, numbers that are not finite, or a
        skeleton without one of the joints.

    Source: CAMDM's evaluation code (its feature extraction).
    """
    positions = np.asarray(positions, np.float64)
    if positions.ndim < 3 or positions.shape[-2:] != (skeleton.num_joints, 3):
        raise ValueError(
            f"positions must be [..., T, {skeleton.num_joints}, 3] in metres for this skeleton, got {positions.shape}"
        )
    if not np.all(np.isfinite(positions)):
        place = [int(index) for index in np.argwhere(~np.isfinite(positions))[0]]
        raise ValueError(
            f"positions are not finite at frame {place[-3]}, joint {skeleton.names[place[-2]]!r}"
            + (f" of motion {place[:-3]}" if len(place) > 3 else "")
        )
    body = positions[..., list(classifier_joints(skeleton)), :]
    body = body - body[..., :1, :]
    at = {joint: body[..., index, :] for index, joint in enumerate(CLASSIFIER_JOINTS)}
    across = unit(at["left clavicle"] - at["right clavicle"])
    across = across + unit(at["left hip"] - at["right hip"])
    # cross(a, +Y) = (-a_z, 0, a_x)
    forward = np.stack([-across[..., 2], np.zeros(across.shape[:-1]), across[..., 0]], axis=-1)
    turned = body @ np.swapaxes(matrix_from_yaw(-yaw_from_direction(forward)), -1, -2)
    return turned.reshape(*body.shape[:-2], NUM_CHANNELS)


def classifier_windows(positions, skeleton: Skeleton, *, window: int = 60) -> np.ndarray:
    """Cut motion into windows side by side; what is left at the end is not used.

    Args:
      positions: global joint positions, [..., T, J, 3], metres, at 30 fps.
      skeleton: J joints.
      window: frames of each.

    Returns:
      [..., T // window, window, 45], metres, float32.

    Raises:
      ValueError: as `classifier_frames`, or if the motion is shorter than a window.
    """
    frames = classifier_frames(positions, skeleton)
    count = frames.shape[-2] // window
    if count == 0:
        raise ValueError(
            f"{frames.shape[-2]} frames do not fill a window of the style classifier; it needs "
            f"{window} ({window / 30:g} s)"
        )
    whole = frames[..., : count * window, :]
    return whole.reshape(*whole.shape[:-2], count, window, NUM_CHANNELS).astype(np.float32)


def mirror_channels() -> tuple[np.ndarray, np.ndarray]:
    """Return (which channel to take, its sign), each [45], that show a frame in the mirror."""
    twin = {"left": "right", "right": "left"}
    mirrored = [" ".join(twin.get(word, word) for word in joint.split()) for joint in CLASSIFIER_JOINTS]
    twins = [CLASSIFIER_JOINTS.index(joint) for joint in mirrored]
    order = 3 * np.repeat(twins, 3) + np.tile(np.arange(3), len(twins))
    return order, np.tile(np.array([-1.0, 1.0, 1.0], np.float32), len(twins))
