"""A procedural body for any skeleton: capsules of about 1,000 vertices, each of which moves with one joint.

One capsule goes along each bone and one beyond each head, hand and toe. Its two radii come from `body.toml`, by the
role of the joint at the bone's end, in metres for legs of `LEG` metres. `wide` stretches it from left to right, which
is the axis that a middle joint's frame turns round in a mirror (`Skeleton.mirror_frames`). `tip` is a length, for rigs
without end sites.

Source: ours.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from f3amd_lib.ground.arrays import array_module, exact_products
from f3amd_lib.ground.files import read_toml
from f3amd_lib.motion.anatomy import leg_length, part_of
from f3amd_lib.motion.curves import unit
from f3amd_lib.motion.skeleton import Skeleton, walk_tree

LEG = 0.85
"""Length of thigh and shank that the radii of `body.toml` are for, metres."""

SIDES = 8
"""Corners of a capsule's rings."""

_LATITUDES = np.array([-1.0, -0.5, 0.0])  # of a half sphere's pole and rings, in quarter turns


_TABLE = read_toml(Path(__file__).with_name("body.toml"))


@dataclass(frozen=True, eq=False)
class Body:
    """A mesh that hangs on a skeleton.

    Attributes:
      vertices: [V, 3], metres, of the skeleton whose root stands at the origin with all rotations the identity.
      faces: [F, 3], vertices, anticlockwise as seen from outside.
      joints: [V, K], the joints that move a vertex; here K = 1.
      weights: [V, K], how much; each row sums to 1.
    """

    vertices: np.ndarray
    faces: np.ndarray
    joints: np.ndarray
    weights: np.ndarray


@dataclass(frozen=True, eq=False)
class Capsule:
    """A limb: two half spheres and what lies between.

    Attributes:
      joint: that carries it.
      start, end: of its axis, in the joint's frame, metres.
      radii: at its start and end, metres.
      wide: direction in which it is stretched, in the joint's frame, as long as the stretch; zeros if not known.
    """

    joint: int
    start: np.ndarray
    end: np.ndarray
    radii: tuple[float, float]
    wide: np.ndarray


def body_capsules(skeleton: Skeleton) -> list[Capsule]:
    """Return the limbs of a body: those of each right bone are the mirror images of the left one's.

    Args:
      skeleton: any. A joint whose role is not known gets a thin limb; a skeleton that cannot be mirrored, round ones.
    """
    roles = skeleton.roles
    parts = {joint: part_of(role) for role, joint in roles.items()} if "left_knee" in roles else {}
    try:
        twins, frames = skeleton.mirror_permutation, skeleton.mirror_frames
    except ValueError:
        twins, frames = range(skeleton.num_joints), np.ones((skeleton.num_joints, 3))
    scale = leg_length(skeleton, roles) / LEG if "left_ankle" in roles else 1.0
    tips = {joint: np.array(offset) for joint, offset in skeleton.end_sites if np.linalg.norm(offset) > 0.01}
    capsules = {}
    for joint in range(skeleton.num_joints):
        part, parent = parts.get(joint, ""), skeleton.parents[joint]
        if parent >= 0 and np.linalg.norm(skeleton.offsets[joint]) > 1e-4:
            capsules[joint, "bone"] = _capsule(parent, skeleton.offsets[joint], part, scale, frames)
        row = _TABLE.get(f"{part} tip")
        tip = tips.get(joint)
        if tip is None and row and joint not in skeleton.parents:
            tip = unit(skeleton.offsets[joint]) * row["tip"] * scale
        if tip is not None:
            tip = tip * (0.55 if part == "head" else 1.0)  # the half sphere goes on beyond it
            capsules[joint, "tip"] = _capsule(joint, tip, f"{part} tip", scale, frames)
    for (joint, kind), one in list(capsules.items()):
        twin = twins[joint]
        if twin > joint and (twin, kind) in capsules:
            turned = {name: frames[one.joint] * getattr(one, name) for name in ("start", "end", "wide")}
            capsules[twin, kind] = Capsule(twins[one.joint], radii=one.radii, **turned)
    return list(capsules.values())


def _capsule(joint: int, offset, part: str, scale: float, frames) -> Capsule:
    row = _TABLE.get(part, _TABLE[""])
    limit = np.inf if part in _TABLE and part else 0.3 * np.linalg.norm(offset)
    radii = tuple(float(min(scale * row[name], limit)) for name in ("start", "end"))
    lateral = frames[joint] < 0
    return Capsule(joint, np.zeros(3), offset, radii, row["wide"] * lateral * (lateral.sum() == 1))


def capsule_mesh(capsule: Capsule) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices [5 SIDES + 2, 3] in the joint's frame, and faces."""
    start, end, wide = capsule.start, capsule.end, capsule.wide
    axis = unit(end - start)
    stretch = np.linalg.norm(wide) or 1.0
    across = wide - (wide @ axis) * axis
    if np.linalg.norm(across) <= 1e-6:
        across = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])  # any direction square to the axis
    across = unit(across)
    other = np.cross(axis, across)
    first, last = capsule.radii
    latitude = 0.5 * np.pi * np.concatenate([_LATITUDES, [0.0], -_LATITUDES[::-1]])
    middles = np.concatenate([[start] * 3, [(start + end) / 2], [end] * 3])
    radii = np.array([first] * 3 + [(first + last) / 2] + [last] * 3)
    turn = 2.0 * np.pi * np.arange(SIDES) / SIDES
    circle = stretch * np.cos(turn)[:, None] * across + np.sin(turn)[:, None] * other
    centres = middles + (radii * np.sin(latitude))[:, None] * axis
    rings = centres[1:-1, None] + (radii * np.cos(latitude))[1:-1, None, None] * circle
    vertices = np.concatenate([centres[:1], rings.reshape(-1, 3), centres[-1:]])
    number = 1 + np.arange(len(rings) * SIDES).reshape(-1, SIDES)
    after = np.roll(number, -1, axis=1)
    pole = np.full(SIDES, len(vertices) - 1)
    faces = [
        np.stack([0 * pole, after[0], number[0]], axis=-1),
        np.stack([number[:-1], after[:-1], after[1:]], axis=-1).reshape(-1, 3),
        np.stack([number[:-1], after[1:], number[1:]], axis=-1).reshape(-1, 3),
        np.stack([number[-1], after[-1], pole], axis=-1),
    ]
    return vertices, np.concatenate(faces)


def make_body(skeleton: Skeleton) -> Body:
    """Return the body of a skeleton: 42 vertices a limb, 1,050 for Bandai's 21 joints, 1,134 for the walker's 23."""
    vertices, faces, joints, count = [], [], [], 0
    for capsule in body_capsules(skeleton):
        own, triangles = capsule_mesh(capsule)
        vertices.append(skeleton.rest_positions[capsule.joint] + own)
        faces.append(count + triangles)
        joints += [capsule.joint] * len(own)
        count += len(own)
    joints = np.array(joints)[:, None]
    return Body(np.concatenate(vertices), np.concatenate(faces), joints, np.ones(joints.shape))


def pose_body(body: Body, skeleton: Skeleton, root_position, rotations):
    """Move a body with its skeleton (linear blend skinning).

    Args:
      body: of the skeleton.
      skeleton: J joints.
      root_position: [..., 3], metres.
      rotations: local ones, the root's global, [..., J, 3, 3].

    Returns:
      Vertices, [..., V, 3], metres; numpy in, numpy out, JAX in, JAX out.
    """
    xp = array_module(root_position, rotations)
    positions, turned = walk_tree(skeleton, root_position, rotations)
    local = body.vertices[:, None] - skeleton.rest_positions[body.joints]  # [V, K, 3]
    with exact_products():
        moved = xp.einsum("...vkab,vkb->...vka", turned[..., body.joints, :, :], local) + positions[..., body.joints, :]
    return xp.sum(body.weights[..., None] * moved, axis=-2)
