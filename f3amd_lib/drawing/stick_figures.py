"""Stick figures: one camera, and the lines and colours of a skeleton, wherever it is drawn.

Left limbs are light orange, right limbs dark blue, the trunk dark grey (they differ in lightness,
so they survive grey print); a toe in contact gets green.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from f3amd_lib.ground.arrays import finite_array
from f3amd_lib.motion.anatomy import side_of
from f3amd_lib.motion.skeleton import Motion, Skeleton, global_rotations

LIMB_COLORS = {"left": "#EF9A26", "right": "#1B4F8F", "middle": "#3A3A3A"}
"""Colours of limbs, the character's own left and right."""

CONTACT_COLOR = "#0B9E64"
TARGET_COLOR = "#C2649A"
TRAIL_COLOR = "#6F6F6F"


@dataclass(frozen=True)
class Camera:
    """Looks at a target from a side.

    Attributes:
      yaw: where it stands, radians: 0 on the side of +Z, pi/2 on that of +X.
      elevation: above the horizon, radians.
      target: the point it looks at, metres.
      distance: from there, metres; infinity makes all rays parallel.
    """

    yaw: float = 0.0
    elevation: float = 0.0
    target: Sequence[float] = (0.0, 0.0, 0.0)
    distance: float = np.inf

    @property
    def view(self) -> np.ndarray:
        """Rows right, up and towards the viewer, [3, 3]."""
        level, height = np.cos(self.elevation), np.sin(self.elevation)
        towards = np.array([np.sin(self.yaw) * level, height, np.cos(self.yaw) * level])
        right = np.array([np.cos(self.yaw), 0.0, -np.sin(self.yaw)])
        return np.stack([right, np.cross(towards, right), towards])

    def project(self, points) -> np.ndarray:
        """Map metres [..., 3] to right, up and towards the viewer, [..., 3].

        The first two shrink with the distance; at the target's they are metres.
        """
        seen = (np.asarray(points, np.float64) - self.target) @ self.view.T
        shrink = np.maximum(1.0 - seen[..., 2:] / self.distance, 1e-6)
        return np.concatenate([seen[..., :2] / shrink, seen[..., 2:]], axis=-1)


def limb_side(name: str) -> str:
    """Return "left", "right" or "middle" for a joint name of the usual conventions."""
    return side_of(name) or "middle"


def bones_of(skeleton: Skeleton) -> list[tuple[int, int, str]]:
    """List (parent, child, side); end sites are numbered on from the joints."""
    bones = [
        (parent, joint, limb_side(skeleton.names[joint]))
        for joint, parent in enumerate(skeleton.parents)
        if parent >= 0
    ]
    for tip, (joint, offset) in enumerate(skeleton.end_sites):
        # A tip on the head would stick out of the disc that is drawn for it.
        if np.linalg.norm(offset) > 1e-3 and joint != skeleton.roles.get("head"):
            bones.append((joint, skeleton.num_joints + tip, limb_side(skeleton.names[joint])))
    return bones


def head_and_parent(skeleton: Skeleton) -> list[int] | None:
    """Return the head joint and its parent; None where none is known, or the root is."""
    head = skeleton.roles.get("head", 0)
    return [head, skeleton.parents[head]] if head > 0 else None


def toes_of(skeleton: Skeleton) -> list[int]:
    """Return the left and the right toe, or none where they are not known."""
    return list(skeleton.toes) if {"left_toe", "right_toe"} <= set(skeleton.roles) else []


def yaw_of(motion: Motion) -> np.ndarray | None:
    """Return where a motion faces, [T], radians, or None where the skeleton's hips are not known."""
    return motion.yaw if {"left_hip", "right_hip"} <= set(motion.skeleton.roles) else None


def drawn_points(motion: Motion, frames: np.ndarray) -> np.ndarray:
    """Positions of joints and end sites at some frames, [len(frames), J + tips, 3]."""
    positions = np.asarray(motion.positions, dtype=np.float64)[frames]
    if not motion.skeleton.end_sites:
        return positions
    turned = global_rotations(motion.skeleton, np.asarray(motion.rotations)[frames])
    tips = [
        positions[:, joint] + turned[:, joint] @ np.asarray(offset, dtype=np.float64)
        for joint, offset in motion.skeleton.end_sites
    ]
    return np.concatenate([positions, np.stack(tips, axis=1)], axis=1)


def body_lines(skeleton: Skeleton, points: np.ndarray) -> tuple[np.ndarray, list[str]]:
    """Lines of a body in one frame.

    The head is one of a millimetre, which a round cap makes a disc, a little beyond its joint, away from the parent.

    Args:
      points: [J + tips, 3], a frame of `drawn_points`.

    Returns:
      (ends [N, 2, 3], and for each line "left", "right", "middle" or "head").
    """
    bones = bones_of(skeleton)
    lines, sides = [points[[parent, child]] for parent, child, _ in bones], [side for *_, side in bones]
    if (joints := head_and_parent(skeleton)) is not None:
        head, neck = points[joints]
        along = head - neck
        middle = head + 0.07 * along / max(np.linalg.norm(along, axis=-1), 1e-6)
        lines, sides = [*lines, middle + [[0.0, 0.0, 0.0], [0.0, 0.001, 0.0]]], [*sides, "head"]
    return np.array(lines), sides


def path_on_ground(path) -> np.ndarray:
    """Accept a RootPath or an array [T, 2] of x and z."""
    return finite_array("target path", getattr(path, "position", path), ("frame", 2))
