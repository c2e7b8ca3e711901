"""Bad generators on purpose: real motion, broken by fixed recipes, to see what each metric sees.

A metric that calls broken motion good is not to be trusted with generated motion. Each recipe has
a strength in [0, 1]: 0 gives the motion back, 1 is the recipe of our tables, and what lies between
breaks it in part, so that a distance can be asked whether it orders them.
"""

from collections.abc import Callable

import numpy as np

from f3amd_lib.data.features import motion_from_frames, split_frames, world_frames
from f3amd_lib.ground.names import check_known
from f3amd_lib.motion.rotations import matrix_from_yaw, slerp_matrices
from f3amd_lib.motion.skeleton import Motion

ROTATION_NOISE = 0.05
"""Deviation of the noise on each of a joint's six rotation numbers: turns it by about 5 degrees."""

ROOT_NOISE = 0.02
"""Deviation of the noise on each coordinate of the root, metres."""


def frozen_pose(motion: Motion, seed: int = 0, strength: float = 1.0) -> Motion:
    """Hold the pose of the first frame while the root goes its way: a figurine pushed along.

    The local rotations, the height of the root and the tilt of the hips are those of frame 0; the
    ground track and the facing are the motion's own. (A statue that stays in its place would be
    the easier case: every path metric sees it, and the ratios to the root's step are undefined. A
    pushed figurine follows the path perfectly and is as smooth as its root; only feet, pose and
    style give it away, and to a classifier that looks at each frame from the hips the two are
    one.)

    Args:
      motion: any motion of T frames.
      seed: nothing is random here; all recipes take one.
      strength: share of the way from each frame's own pose to that of frame 0, along the shortest
        arc in every joint.

    Returns:
      The motion, T frames.

    Source: ours.
    """
    held = np.repeat(np.asarray(motion.rotations[:1], np.float64), motion.num_frames, axis=0)
    held[:, 0] = matrix_from_yaw(motion.yaw - motion.yaw[0]) @ held[:, 0]
    root = np.array(motion.root_position, dtype=np.float64)
    root[:, 1] += strength * (root[0, 1] - root[:, 1])
    return motion.replace(root_position=root, rotations=slerp_matrices(motion.rotations, held, strength))


def shuffled_frames(motion: Motion, seed: int = 0, strength: float = 1.0) -> Motion:
    """Put whole frames, root and pose, in a random order: every pose is real, the motion is gone.

    Args:
      motion: any motion of T frames.
      seed: of the order. With the same seed, frames moved at a low strength are among those moved
        at a higher one.
      strength: share of frames that change places, in one random ring, so that each of them moves;
        the others stay.

    Returns:
      The motion, T frames.

    Raises:
      ValueError: for a single frame.

    Source: ours.
    """
    if motion.num_frames < 2:
        raise ValueError("a single frame cannot be shuffled")
    ring = np.random.default_rng(seed).permutation(motion.num_frames)
    ring = ring[: round(strength * motion.num_frames)]
    order = np.arange(motion.num_frames)
    order[ring] = np.roll(ring, 1)
    return motion.replace(root_position=motion.root_position[order], rotations=motion.rotations[order])


def noisy_motion(motion: Motion, seed: int = 0, strength: float = 1.0) -> Motion:
    """Add Gaussian noise to every frame by itself: the right motion, shaking.

    Args:
      motion: any motion of T frames.
      seed: of the noise; one draw for all strengths.
      strength: factor on both deviations, `ROOT_NOISE` and `ROTATION_NOISE`; a joint's six numbers are made a rotation
        again.

    Returns:
      The motion, T frames.

    Source: ours.
    """
    frames = world_frames(motion)
    noise = np.random.default_rng(seed).normal(size=frames.shape)
    root_noise, rotation_noise = split_frames(noise)
    root_noise *= ROOT_NOISE
    rotation_noise *= ROTATION_NOISE
    noisy = motion_from_frames(motion.skeleton, frames + strength * noise)
    return motion.replace(root_position=noisy.root_position, rotations=noisy.rotations)


CORRUPTIONS: dict[str, Callable[[Motion, int, float], Motion]] = {
    "frozen pose": frozen_pose, "shuffled frames": shuffled_frames, "noisy motion": noisy_motion,
}  # fmt: skip
"""The bad generators of our tables by name, as functions of (motion, seed, strength)."""


def corrupt(name: str, motion: Motion, *, strength: float = 1.0, seed: int = 0) -> Motion:
    """Break a motion by the recipe of a name.

    Args:
      name: one of `CORRUPTIONS`.
      motion: any motion.
      strength: 0 for the motion as it was, 1 for the recipe of our tables.
      seed: of what is random in the recipe.

    Returns:
      The broken motion, as many frames on the same skeleton.

    Raises:
      ValueError: for an unknown name, a strength out of range, motion of positions alone, or a single frame to shuffle.
    """
    check_known(name, CORRUPTIONS, "corruption")
    motion.needed_rotations(f"the corruption {name!r}")
    if not 0.0 <= strength <= 1.0:
        raise ValueError(f"strength must lie between 0 (as it was) and 1, got {strength}")
    return CORRUPTIONS[name](motion, seed, float(strength))
