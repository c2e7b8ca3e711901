"""Skeletons and motions: forward kinematics, facing, contacts, mirroring, resampling.

A `Skeleton` is a tree of joints with fixed bones; a `Motion` is a root path plus local rotations
on it. Units are metres, frames per second and radians; +Y is up and the character's left is +X
when it faces +Z. The root's rotation is global.
"""

from __future__ import annotations

import dataclasses
import functools
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

from f3amd_lib.ground.arrays import array_module, finite_array
from f3amd_lib.ground.names import checked_value
from f3amd_lib.motion.anatomy import joint_roles, side_of, twin_name
from f3amd_lib.motion.rotations import matrix_from_yaw, slerp_matrices

CONTACT_SPEED = 0.01
"""A toe that moves less than this, metres in a frame at 30 fps, is in contact (CAMDM's rule)."""


@dataclass(frozen=True, eq=False)
class Skeleton:
    """A tree of joints with rigid bones.

    Attributes:
      names: joint names, the root first, every parent before its children.
      parents: index of each joint's parent, -1 for the root.
      offsets: position of each joint in its parent's frame, [J, 3], metres (root: zeros).
      end_sites: (joint index, offset in metres) of BVH "End Site" tips; drawn and written, never
        part of the features.

    Raises:
      ValueError: for lists of unlike length, a parent after its child, or non-finite offsets.
    """

    names: tuple[str, ...]
    parents: tuple[int, ...]
    offsets: np.ndarray
    end_sites: tuple[tuple[int, tuple[float, float, float]], ...] = ()

    def __post_init__(self):
        offsets = finite_array("skeleton offsets", self.offsets, (len(self.names), 3)).copy()
        offsets.setflags(write=False)
        object.__setattr__(self, "names", tuple(self.names))
        object.__setattr__(self, "parents", tuple(int(parent) for parent in self.parents))
        object.__setattr__(self, "offsets", offsets)
        object.__setattr__(self, "end_sites", tuple((joint, tuple(tip)) for joint, tip in self.end_sites))
        if not len(set(self.names)) == len(self.names) == len(self.parents):
            raise ValueError(f"skeleton joint names must be unique, with a parent each; got {', '.join(self.names)}")
        if self.parents[:1] != (-1,) or any(not 0 <= parent <= k for k, parent in enumerate(self.parents[1:])):
            raise ValueError("skeleton needs the root first and every parent before its children")

    def __eq__(self, other):
        alike = isinstance(other, Skeleton) and (self.names, self.parents) == (other.names, other.parents)
        return alike and np.allclose(self.offsets, other.offsets, atol=1e-3)

    def __hash__(self):
        return hash((self.names, self.parents))

    @property
    def num_joints(self) -> int:
        """Number of joints, J."""
        return len(self.names)

    def index(self, name: str) -> int:
        """Return a joint's index by name; ValueError lists the names if there is none."""
        if name not in self.names:
            raise ValueError(f"skeleton has no joint {name!r}; it has {', '.join(self.names)}")
        return self.names.index(name)

    @functools.cached_property
    def roles(self) -> dict[str, int]:
        """The joint that plays each role (see `anatomy.joint_roles`)."""
        return joint_roles(self)

    def role(self, role: str) -> int:
        """Return the joint that plays a role, such as head or left_toe; ValueError if none does."""
        if role not in self.roles:
            raise ValueError(f"no joint has the role {role}; give one of them this name: {', '.join(self.names)}")
        return self.roles[role]

    @property
    def toes(self) -> tuple[int, int]:
        """Indices of the left and the right toe joint."""
        return self.role("left_toe"), self.role("right_toe")

    @functools.cached_property
    def children(self) -> tuple[list[int], ...]:
        """The joints that hang on each joint."""
        return tuple(np.flatnonzero(np.equal(self.parents, joint)).tolist() for joint in range(self.num_joints))

    @functools.cached_property
    def rest_positions(self) -> np.ndarray:
        """Joint positions [J, 3], metres, of the root at the origin and all rotations the identity."""
        return forward_kinematics(self, np.zeros(3), np.broadcast_to(np.eye(3), (self.num_joints, 3, 3)))

    @functools.cached_property
    def levels(self) -> tuple[tuple[int, ...], ...]:
        """Joints by depth: level 0 is the root. Kinematics walks levels, not joints."""
        depth = []
        for parent in self.parents:
            depth.append(depth[parent] + 1 if parent >= 0 else 0)
        return tuple(tuple(np.flatnonzero(np.equal(depth, level)).tolist()) for level in range(max(depth) + 1))

    @functools.cached_property
    def mirror_permutation(self) -> tuple[int, ...]:
        """For each joint the index of its left-right twin (itself for middle joints)."""
        labels = self.names
        if not any(map(side_of, labels)):
            played = {joint: role for role, joint in self.roles.items()}
            labels = [played.get(joint, name) for joint, name in enumerate(labels)]
        for name in labels:
            if twin_name(name) not in labels:
                raise ValueError(f"joint {name!r} has no twin {twin_name(name)!r}: the skeleton cannot be mirrored")
        twins = [labels.index(twin_name(name)) for name in labels]
        for joint, parent in enumerate(self.parents[1:], start=1):
            if self.parents[twins[joint]] != twins[parent]:
                raise ValueError(f"the twin of joint {self.names[joint]!r} has another parent: no mirroring")
        return tuple(twins)

    @functools.cached_property
    def mirror_frames(self) -> np.ndarray:
        """Reflection D_j, as a diagonal [J, 3], that carries each joint's frame over in a mirror.

        A mirrored pose has global rotations G'_j = S G_twin(j) D_j with S = diag(-1, 1, 1). It
        shows the mirrored positions exactly when D_j maps each child's offset to that of the
        child's twin, which fixes D_j up to ties along single bones; ties follow the parent, and
        else take -I, the convention of rigs whose right side points its bone axes backwards.
        """
        candidates = np.array([[-1.0, 1.0, 1.0], [1.0, -1.0, 1.0], [1.0, 1.0, -1.0], [-1.0, -1.0, -1.0]])
        twin = self.mirror_permutation
        frames = np.zeros((self.num_joints, 3))
        for joint in range(self.num_joints):
            error = np.zeros(4)
            for child in self.children[joint]:
                error += np.abs(candidates * self.offsets[child] - self.offsets[twin[child]]).sum(1)
            if error.min() > 2e-3 * max(len(self.children[joint]), 1):
                what = f"are no mirror images of their twins (off by {1000 * error.min():.1f} mm)"
                raise ValueError(f"bones below {self.names[joint]!r} {what}: skeleton cannot be mirrored")
            tied = [k for k in range(4) if error[k] <= error.min() + 1e-3]
            parent = self.parents[joint]
            inherited = [k for k in tied if parent >= 0 and np.array_equal(candidates[k], frames[parent])]
            backwards = [3] if 3 in tied and parent >= 0 else []
            frames[joint] = candidates[[*inherited, *backwards, *tied][0]]
        return frames


def describe_skeleton(skeleton: Skeleton) -> dict:
    """Return a skeleton's names and tree as JSON-ready values; offsets go with the arrays."""
    return {
        "joints": list(skeleton.names),
        "parents": list(skeleton.parents),
        "end_sites": [[joint, list(offset)] for joint, offset in skeleton.end_sites],
    }


def described_skeleton(metadata: dict, offsets) -> Skeleton:
    """Return the skeleton that `describe_skeleton` described, with its offsets [J, 3]."""
    return Skeleton(metadata["joints"], metadata["parents"], np.asarray(offsets), metadata["end_sites"])


@dataclass(frozen=True, eq=False)
class Motion:
    """A skeleton in motion: where all joints are, and how they are turned where that is known.

    Motion with rotations is made of these and the root's path, and `positions` follow from them. Motion
    without (`Motion.from_positions`) is made of positions alone; what needs rotations refuses it.

    Attributes:
      skeleton: the joints.
      root_position: [T, 3], metres, global.
      rotations: [T, J, 3, 3], local rotation matrices; the root's is global. None for positions alone.
      fps: frames per second.
      name: where it came from, for messages and titles.
      joint_positions: [T, J, 3], metres, global, for positions alone; None where there are rotations.

    Raises:
      ValueError: for shapes that do not agree, no frames, a bad fps, numbers not finite, or not exactly
        one of rotations and joint_positions.
    """

    skeleton: Skeleton
    root_position: np.ndarray
    rotations: np.ndarray | None
    fps: float = 30.0
    name: str = ""
    joint_positions: np.ndarray | None = None

    def __post_init__(self):
        label = f"motion {self.name!r}"
        if (self.rotations is None) == (self.joint_positions is None):
            raise ValueError(f"{label} needs either rotations or joint_positions")
        frames, joints = len(self.root_position), self.skeleton.num_joints
        shapes = {
            "root_position": ("frame", 3),
            "rotations": (frames, joints, 3, 3),
            "joint_positions": (frames, joints, 3),
        }
        for what, array in self._arrays().items():
            object.__setattr__(self, what, finite_array(f"{label}: {what}", array, shapes[what], dtype=None))
        checked_value(f"{label}: fps", self.fps, "float")

    @classmethod
    def from_positions(cls, skeleton: Skeleton, positions, fps: float = 30.0, name: str = "") -> Motion:
        """Return motion of positions alone, [T, J, 3] in metres, the root's first; end sites need rotations, and go."""
        positions, skeleton = np.asarray(positions), dataclasses.replace(skeleton, end_sites=())
        return cls(skeleton, positions[..., 0, :], None, fps, name, positions)

    def _arrays(self) -> dict[str, np.ndarray]:
        """Return the arrays that this motion is made of, by name."""
        return {name: getattr(self, name) for name in _ARRAYS if getattr(self, name) is not None}

    def needed_rotations(self, why: str) -> np.ndarray:
        """Return the rotations; ValueError says `why` they are needed where there are none."""
        if self.rotations is None:
            raise ValueError(f"motion {self.name!r} has only positions: {why} needs rotations, so fit some first")
        return self.rotations

    @property
    def num_frames(self) -> int:
        """Number of frames, T."""
        return self.root_position.shape[0]

    @functools.cached_property
    def positions(self) -> np.ndarray:
        """Global joint positions, [T, J, 3], metres."""
        if self.rotations is None:
            return self.joint_positions
        return forward_kinematics(self.skeleton, self.root_position, self.rotations)

    @functools.cached_property
    def yaw(self) -> np.ndarray:
        """Facing angle of the hips per frame, [T], radians (see `facing_yaw`)."""
        return facing_yaw(self.skeleton, self.positions)

    @functools.cached_property
    def contacts(self) -> np.ndarray:
        """Toe contact per frame, [T, 2] of bool, left then right (see `contact_labels`)."""
        return contact_labels(self.skeleton, self.positions, self.fps)

    def slice(self, start: int, stop: int) -> Motion:
        """Return frames start (included) to stop (excluded)."""
        return self.replace(**{name: array[start:stop] for name, array in self._arrays().items()})

    def replace(self, **changes) -> Motion:
        """Return a copy with some attributes changed."""
        return dataclasses.replace(self, **changes)


_ARRAYS = ("root_position", "rotations", "joint_positions")


def compose(first, second):
    """Multiply stacks of 3 x 3 matrices [..., 3, 3].

    In JAX as a sum of three outer products, which fuses with its neighbours; XLA's batched product
    of such small matrices is slower on a CPU, and jax 0.10 refuses some of them inside a scan.
    """
    if array_module(first, second) is np:
        return first @ second
    return sum(first[..., :, k, None] * second[..., None, k, :] for k in range(3))


def walk_tree(skeleton: Skeleton, root_position, rotations):
    """Carry rotations and positions down the tree, one level at a time."""
    xp = array_module(root_position, rotations)
    offsets = skeleton.offsets.astype(rotations.dtype)
    level_rotations = [rotations[..., 0:1, :, :]]
    level_positions = [root_position[..., None, :]]
    for previous, level in zip(skeleton.levels[:-1], skeleton.levels[1:], strict=True):
        slot = np.array([previous.index(skeleton.parents[joint]) for joint in level])
        joints = np.array(level)
        above = level_rotations[-1][..., slot, :, :]
        bones = sum(above[..., k] * offsets[joints, k, None] for k in range(3))
        level_positions.append(level_positions[-1][..., slot, :] + bones)
        level_rotations.append(compose(above, rotations[..., joints, :, :]))
    order = np.argsort(np.array([joint for level in skeleton.levels for joint in level]))
    positions = xp.concatenate(level_positions, axis=-2)[..., order, :]
    turned = xp.concatenate(level_rotations, axis=-3)[..., order, :, :]
    return positions, turned


def forward_kinematics(skeleton: Skeleton, root_position, rotations):
    """Turn local rotations into global joint positions (FK of Eqs 10, 12, 13).

    Args:
      skeleton: J joints.
      root_position: [..., 3], metres.
      rotations: local rotation matrices, [..., J, 3, 3], the root's global.

    Returns:
      Global positions, [..., J, 3], metres; numpy in, numpy out, JAX in, JAX out.
    """
    return walk_tree(skeleton, root_position, rotations)[0]


def global_rotations(skeleton: Skeleton, rotations):
    """Turn local rotation matrices [..., J, 3, 3] into global ones of the same shape."""
    xp = array_module(rotations)
    return walk_tree(skeleton, xp.zeros_like(rotations[..., 0, :, 0]), rotations)[1]


def local_rotations(skeleton: Skeleton, turned: np.ndarray) -> np.ndarray:
    """Turn global rotation matrices [T, J, 3, 3] into local ones: the inverse of `global_rotations` (numpy only)."""
    above = turned[:, list(skeleton.parents[1:])]
    return np.concatenate([turned[:, :1], np.swapaxes(above, -1, -2) @ turned[:, 1:]], axis=1)


def check_joints(skeleton: Skeleton, positions) -> None:
    """Raise ValueError unless positions are [..., J, 3] of a skeleton's J joints."""
    if positions.shape[-2:] != (skeleton.num_joints, 3):
        raise ValueError(f"positions must be [..., {skeleton.num_joints}, 3] for this skeleton, got {positions.shape}")


def facing_yaw(skeleton: Skeleton, positions, *, shoulders: bool = False):
    """Return the yaw of cross(a, +Y), a = left hip - right hip.

    Args:
      skeleton: the joints.
      positions: global positions, [..., J, 3].
      shoulders: take a = unit(left collar - right collar) + unit(left hip - right hip), as CAMDM's
        evaluation does; a skeleton without these joints faces where its hips do.

    Returns:
      Radians, [...]; 0 faces +Z, positive turns left.

    Raises:
      ValueError: for another number of joints, or a skeleton without hips.
    """
    check_joints(skeleton, positions)
    xp = array_module(positions)

    def between(part):
        return positions[..., skeleton.role(f"left_{part}"), :] - positions[..., skeleton.role(f"right_{part}"), :]

    across = between("hip")
    if shoulders and {"left_collar", "right_collar"} <= set(skeleton.roles):
        unit = lambda vector: vector / xp.maximum(xp.linalg.norm(vector, axis=-1, keepdims=True), 1e-9)
        across = unit(across) + unit(between("collar"))
    # The direction is cross(a, +Y) = (-a_z, 0, a_x).
    return xp.arctan2(-across[..., 2], across[..., 0])


def contact_labels(skeleton: Skeleton, positions, fps: float = 30.0):
    """Mark toes that hardly move: 3D speed under `CONTACT_SPEED` metres per 1/30 s.

    Args:
      skeleton: the joints.
      positions: global positions, [..., T, J, 3], metres.
      fps: frames per second of `positions`.

    Returns:
      Boolean [..., T, 2], left and right. Frame t is judged by the step t -> t + 1, the last frame
      repeats its predecessor; a single frame counts as in contact.
    """
    xp = array_module(positions)
    toes = positions[..., np.array(skeleton.toes), :]
    if toes.shape[-3] < 2:
        return xp.ones(toes.shape[:-1], dtype=bool)
    step = toes[..., 1:, :, :] - toes[..., :-1, :, :]
    moving = xp.sqrt(xp.sum(step * step, axis=-1)) * (fps / 30.0)
    moving = xp.concatenate([moving, moving[..., -1:, :]], axis=-2)
    return moving < CONTACT_SPEED


def mirror(motion: Motion) -> Motion:
    """Reflect a motion in the plane x = 0, left limbs becoming right ones.

    Works for rigs whose left and right frames are plain mirror images (100STYLE) and for those
    whose right-side bone axes point backwards (Bandai); see `Skeleton.mirror_frames`.

    Returns:
      A motion whose joint positions are the mirrored ones of the twin joints, to the accuracy with
      which the skeleton itself is symmetric.
    """
    skeleton = motion.skeleton
    twin = np.array(skeleton.mirror_permutation)
    name = f"{motion.name} (mirrored)" if motion.name else ""
    flip = np.array([-1.0, 1.0, 1.0])
    if motion.rotations is None:
        return Motion.from_positions(skeleton, motion.positions[:, twin] * flip, motion.fps, name)
    turned = global_rotations(skeleton, np.asarray(motion.rotations, dtype=np.float64))
    turned = np.diag(flip) @ turned[:, twin] * skeleton.mirror_frames[None, :, None, :]
    local = local_rotations(skeleton, turned).astype(motion.rotations.dtype)
    return motion.replace(root_position=motion.root_position * flip, rotations=local, name=name)


def resample(motion: Motion, fps: float = 30.0, *, smooth: bool = False) -> Motion:
    """Change the frame rate; whole ratios take every k-th frame, others interpolate.

    Source: paper section 4 ("resample to 30 FPS"); CAMDM drops every second frame of 60.

    Args:
      motion: any motion.
      fps: wanted rate, frames per second.
      smooth: interpolate by cubic splines (a walk from 24 to 30 fps: within 0.1 mm, where straight lines are 2 mm off);
        else positions linearly and rotations on the shortest arc, as the captioned clips of the shipped weights were.

    Returns:
      A motion at exactly `fps`.
    """
    checked_value("fps", fps, "float")
    ratio = motion.fps / fps
    if abs(ratio - round(ratio)) < 1e-3 and round(ratio) >= 1:
        every = {name: array[:: round(ratio)] for name, array in motion._arrays().items()}
        return motion.replace(**every, fps=float(fps))
    duration = (motion.num_frames - 1) / motion.fps
    times = np.arange(int(np.floor(duration * fps + 1e-6)) + 1) / fps * motion.fps
    low = np.minimum(np.floor(times).astype(int), motion.num_frames - 1)
    high = np.minimum(low + 1, motion.num_frames - 1)
    weight, known = (times - low)[:, None], np.arange(motion.num_frames)

    smooth &= len(known) > 1  # one frame has no curve

    def between(name, array):
        if smooth and name == "rotations":
            joints = (RotationSpline(known, Rotation.from_matrix(of_joint)) for of_joint in np.moveaxis(array, 1, 0))
            return np.stack([joint(times).as_matrix() for joint in joints], axis=1)
        if name == "rotations":
            return slerp_matrices(array[low], array[high], weight)
        if smooth:
            return CubicSpline(known, array)(times)
        across = weight.reshape(-1, *[1] * (array.ndim - 1))
        return (1 - across) * array[low] + across * array[high]

    changes = {name: between(name, array) for name, array in motion._arrays().items()}
    return motion.replace(**changes, fps=float(fps))


def turn(motion: Motion, yaw: float) -> Motion:
    """Turn a whole motion about the world's +Y axis through the origin by `yaw` radians."""
    matrix = matrix_from_yaw(np.float64(yaw))
    if motion.rotations is None:
        return Motion.from_positions(motion.skeleton, motion.positions @ matrix.T, motion.fps, motion.name)
    rotations = np.array(motion.rotations, copy=True)
    rotations[:, 0] = matrix @ rotations[:, 0]
    return motion.replace(root_position=motion.root_position @ matrix.T, rotations=rotations)
