"""The redundant vector of HumanML3D and KIT-ML: 12 J - 1 numbers a frame, forward and back.

| numbers | part | what |
|---|---|---|
| 1 | turn | half the turn of the facing to the next frame, radians; positive to the character's right |
| 2 | velocity | step of the root on the ground to the next frame, seen from there, metres |
| 1 | height | of the root, metres |
| 3 (J - 1) | positions | of all other joints, from the root's place on the ground, seen from the root |
| 6 (J - 1) | rotations | of the bones that lead to them, 6D, each against the bone before it |
| 3 J | steps | of every joint to the next frame, seen from the root |
| 4 | contacts | of the left ankle and toe, then of the right ones, 0 or 1 |

263 numbers for the 22 joints of HumanML3D, 251 for the 21 of KIT-ML. "Seen from the root" is turned
so that the facing is +Z. The facing is a smoothed one, so that it does not sway with each step; in the
first frame it is +Z. The released processing lets hips count against shoulders (`smoothed_yaw`), and so do we;
weights of earlier versions know vectors in which they count together.

Rotations are those of the released processing, to the letter, so that vectors of both kinds can be
mixed: a chain of bones begins against the facing turned backwards, so that the rotations of its first
bone tell where the body faces in the world.

Source: Guo et al. 2022 (HumanML3D), section 3 and its released processing.
"""

import itertools

import numpy as np
from scipy.ndimage import gaussian_filter1d

from f3amd_lib.ground.arrays import array_module, exact_products, finite_array
from f3amd_lib.motion import rotations
from f3amd_lib.motion.skeleton import Skeleton

FACING_SMOOTHING = 20.0
"""Deviation of the Gaussian that smooths the facing, frames."""

CONTACT_STEP = 0.002
"""A foot whose squared step is smaller is in contact, square metres a frame at 20 fps."""


NUM_JOINT_FEATURES = 10
"""Numbers that InterGen's representation has of each joint beside its position."""


def vector_parts(num_joints: int) -> dict[str, slice]:
    """Return where each part of the vector lies, by its name in the table above."""
    others = num_joints - 1
    sizes = {"turn": 1, "velocity": 2, "height": 1, "positions": 3 * others, "rotations": 6 * others}
    sizes |= {"steps": 3 * num_joints, "contacts": 4}
    ends = itertools.accumulate(sizes.values())
    return {name: slice(end - size, end) for (name, size), end in zip(sizes.items(), ends, strict=True)}


def count_joints(width: int) -> int:
    """Return J of vectors of 12 J - 1 numbers; ValueError for another width."""
    if width < 23 or (width + 1) % 12:
        raise ValueError(f"a redundant vector of J joints has 12 J - 1 numbers (22: 263, 21: 251), got {width}")
    return (width + 1) // 12


def smoothed_yaw(
    skeleton: Skeleton, positions, smoothing: float = FACING_SMOOTHING, *, released: bool = False
) -> np.ndarray:
    """Return the facing of hips and shoulders together, [L], radians, smoothed over frames.

    Args:
      skeleton: one whose hips are known; its shoulders count where they are.
      positions: [L, J, 3], metres.
      smoothing: deviation of the Gaussian, frames; 0 for none.
      released: the facing of HumanML3D's vectors, in which hips count against shoulders: the inverse kinematics of the
        released code takes the left hip for the right one.
    """
    across = positions[:, skeleton.role("left_hip")] - positions[:, skeleton.role("right_hip")]
    if {"left_shoulder", "right_shoulder"} <= set(skeleton.roles):
        shoulders = positions[:, skeleton.role("left_shoulder")] - positions[:, skeleton.role("right_shoulder")]
        across = shoulders + (-across if released else across)
    forward = np.stack([-across[:, 2], 0 * across[:, 0], across[:, 0]], axis=-1)
    forward = forward / np.linalg.norm(across if released else forward, axis=-1, keepdims=True)
    if smoothing:
        forward = gaussian_filter1d(forward, smoothing, axis=0, mode="nearest")
    return np.arctan2(forward[:, 0], forward[:, 2])


def canonical_start(skeleton: Skeleton, positions) -> np.ndarray:
    """Move and turn a clip so that it starts at the origin, facing +Z, its lowest joint on the floor.

    Args:
      skeleton: J joints.
      positions: [L, J, 3], metres.

    Returns:
      [L, J, 3], float64, metres.

    Raises:
      ValueError: for another shape, or positions that are not finite.
    """
    positions = finite_array("positions", positions, ("frame", skeleton.num_joints, 3))
    start = positions[0, 0] * [1.0, 0.0, 1.0] + [0.0, positions[..., 1].min(), 0.0]
    return (positions - start) @ rotations.matrix_from_yaw(smoothed_yaw(skeleton, positions[:1], 0.0)[0])


def essential_features(skeleton: Skeleton, positions, *, released: bool = True) -> np.ndarray:
    """Return the first four parts of redundant vectors, which tell the whole motion: what a judge looks at.

    Args, errors: as `redundant_from_positions`.

    Returns:
      [L - 1, 4 + 3 (J - 1)], float64; 67 numbers for 22 joints.

    Source: ACMDM's released evaluation code ("essential" features).
    """
    return _first_parts(skeleton, positions, released)[0]


def _first_parts(skeleton: Skeleton, positions, released: bool):
    """Return (turn, velocity, height and local positions; matrices from the root's view into the world, [L, 3, 3])."""
    positions = finite_array("positions", positions, ("frame", skeleton.num_joints, 3))
    if len(positions) < 2:
        raise ValueError("redundant vectors need at least 2 frames: a step leads to the next one")
    yaw = smoothed_yaw(skeleton, positions, FACING_SMOOTHING, released=released)
    yaw[0] = 0.0
    turned = rotations.matrix_from_yaw(yaw)  # `rows @ turned` is the way from the world to the root's view
    velocity = (np.diff(positions[:, :1], axis=0) @ turned[1:])[:, 0, ::2]
    local = (positions[:-1, 1:] - positions[:-1, :1] * [1.0, 0.0, 1.0]) @ turned[:-1]
    turn = -0.5 * rotations.wrap_angle(np.diff(yaw))[:, None]
    parts = [turn, velocity, positions[:-1, 0, 1:2], local.reshape(len(local), -1)]
    return np.concatenate(parts, axis=-1), turned


def redundant_from_positions(
    skeleton: Skeleton, positions, *, contact_step: float = CONTACT_STEP, released: bool = True
) -> np.ndarray:
    """Turn positions into redundant vectors.

    Args:
      skeleton: J joints; its offsets are the rest pose that rotations start from, in any length.
      positions: [L, J, 3], metres, from `canonical_start`.
      contact_step: squared step below which a foot is in contact.
      released: by the facing of HumanML3D's vectors; else, as in earlier versions, hips count as shoulders do.

    Returns:
      [L - 1, 12 J - 1], float64: a frame's steps need the next one.

    Raises:
      ValueError: for fewer than 2 frames, another shape, or positions that are not finite.
    """
    first, turned = _first_parts(skeleton, positions, released)
    step = np.diff(np.asarray(positions, np.float64), axis=0)
    parts = [
        first,
        rotations.rotation_6d_from_matrix(_bone_rotations(skeleton, positions[:-1], turned[:-1])),
        step @ turned[:-1],
        np.sum(step[:, _feet(skeleton)] ** 2, axis=-1) < contact_step,
    ]
    return np.concatenate([part.reshape(len(step), -1) for part in parts], axis=-1)


def joint_features(skeleton: Skeleton, positions, vectors) -> np.ndarray:
    """Return what InterGen's representation adds to each joint's position.

    Args:
      skeleton, positions: as in `redundant_from_positions`.
      vectors: what that returns.

    Returns:
      [L - 1, J, 10], float64: step to the next frame in the world, metres; 6D rotation of the bone that leads to the
      joint, as in the redundant vector of the facing of hips and shoulders together; contact, 0 or 1. What a joint
      lacks is 0: the root's bone, contact but of feet.

    Source: ACMDM section 4.2; Liang et al. 2024 (InterGen), its non-canonical representation.
    """
    parts = vector_parts(skeleton.num_joints)
    features = np.zeros((len(vectors), skeleton.num_joints, NUM_JOINT_FEATURES))
    features[..., :3] = np.diff(np.asarray(positions, np.float64), axis=0)
    features[:, 1:, 3:9] = vectors[:, parts["rotations"]].reshape(len(vectors), -1, 6)
    features[:, _feet(skeleton), 9] = vectors[:, parts["contacts"]]
    return features


def _feet(skeleton: Skeleton) -> list[int]:
    """Return left ankle and toe, then the right ones."""
    return [joint for toe in skeleton.toes for joint in (skeleton.parents[toe], toe)]


def _bone_rotations(skeleton: Skeleton, positions, turned) -> np.ndarray:
    """Return each bone's rotation against the bone before it in its chain, [L, J - 1, 3, 3].

    A bone is named by the joint that it leads to. A joint's first child goes on with its chain; other
    children begin one, as a child of the root does.
    """
    parents = np.array(skeleton.parents[1:])
    bones, rest = positions[:, 1:] - positions[:, parents], skeleton.offsets[1:]
    point = (np.linalg.norm(rest, axis=-1) < 1e-9) | (np.linalg.norm(bones, axis=-1).min(axis=0) < 1e-9)
    straight = np.eye(3)[1]  # a bone without length counts as upright
    in_world = rotations.shortest_turn(*(np.where(point[:, None], straight, vectors) for vectors in (rest, bones)))
    goes_on = np.array([parent > 0 and parent not in parents[:bone] for bone, parent in enumerate(parents)])
    begin = np.swapaxes(turned, -1, -2)[:, None]
    before = np.where(goes_on[:, None, None], in_world[:, parents - 1], begin)
    return np.swapaxes(before, -1, -2) @ in_world


def positions_from_redundant(vectors):
    """Turn redundant vectors back into positions, by turn, velocity, height and local positions.

    Args:
      vectors: [..., L, 12 J - 1]; numpy or JAX.

    Returns:
      [..., L, J, 3], metres: starts over the origin, facing +Z. Exact but for rounding.

    Raises:
      ValueError: for another width.
    """
    xp = array_module(vectors)
    parts = vector_parts(count_joints(vectors.shape[-1]))
    turn, velocity, height, local = (vectors[..., parts[name]] for name in ("turn", "velocity", "height", "positions"))

    def summed(steps):  # the first frame stands where it is, each other one a step further
        return xp.cumsum(xp.concatenate([xp.zeros_like(steps[..., :1, :]), steps[..., :-1, :]], axis=-2), axis=-2)

    turned = xp.swapaxes(rotations.matrix_from_yaw(-2.0 * summed(turn)[..., 0]), -1, -2)
    arriving = xp.concatenate([turned[..., 1:, :, :], turned[..., :1, :, :]], axis=-3)
    flat = xp.concatenate([velocity[..., :1], 0.0 * height, velocity[..., 1:]], axis=-1)
    local = local.reshape(*local.shape[:-1], -1, 3)
    with exact_products():
        ground, standing = summed((flat[..., None, :] @ arriving)[..., 0, :]), local @ turned
    root = xp.concatenate([ground[..., :1], height, ground[..., 2:]], axis=-1)
    return xp.concatenate([root[..., None, :], standing + ground[..., None, :]], axis=-2)


def grouped_statistics(vectors) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and deviation of vectors as HumanML3D's `Mean.npy` and `Std.npy` have them.

    Args:
      vectors: [N, 12 J - 1].

    Returns:
      (mean, deviation), float32, [12 J - 1] each; a part's deviations are averaged over the part.
    """
    deviation = np.std(vectors, axis=0, dtype=np.float64)
    for part in vector_parts(count_joints(deviation.shape[-1])).values():
        deviation[part] = deviation[part].mean()
    return np.mean(vectors, axis=0, dtype=np.float64).astype(np.float32), deviation.astype(np.float32)
