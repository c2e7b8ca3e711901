"""Stick figures: which lines and colours a skeleton is drawn with, wherever it is drawn.

Left limbs are light orange, right limbs dark blue, the trunk dark grey (they differ in lightness,
so they survive grey print); a toe in contact gets green.
"""

from __future__ import annotations

import numpy as np

from f3amd_lib.motion.skeleton import Motion, Skeleton, global_rotations

LIMB_COLORS = {"left": "#EF9A26", "right": "#1B4F8F", "middle": "#3A3A3A"}
"""Colours of limbs, the character's own left and right."""

CONTACT_COLOR = "#0B9E64"
TARGET_COLOR = "#C2649A"
TRAIL_COLOR = "#6F6F6F"


def limb_side(name: str) -> str:
    """Return "left", "right" or "middle" for a joint name of the usual conventions."""
    lowered = name.lower()
    if "left" in lowered or lowered.endswith("_l"):
        return "left"
    if "right" in lowered or lowered.endswith("_r"):
        return "right"
    return "middle"


def bones_of(skeleton: Skeleton) -> list[tuple[int, int, str]]:
    """List (parent, child, side); end sites are numbered on from the joints."""
    bones = [
        (parent, joint, limb_side(skeleton.names[joint]))
        for joint, parent in enumerate(skeleton.parents)
        if parent >= 0
    ]
    for tip, (joint, offset) in enumerate(skeleton.end_sites):
        # A tip on the head would stick out of the disc that is drawn for it.
        if np.linalg.norm(offset) > 1e-3 and not is_head(skeleton.names[joint]):
            bones.append((joint, skeleton.num_joints + tip, limb_side(skeleton.names[joint])))
    return bones


def is_head(name: str) -> bool:
    """Return whether a joint is called head, whatever stands before a colon."""
    return name.lower().split(":")[-1] == "head"


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


def head_center(skeleton: Skeleton, points: np.ndarray) -> np.ndarray | None:
    """Where to draw a head: a little beyond the head joint, away from its parent, [F, 3]."""
    heads = [joint for joint, name in enumerate(skeleton.names) if is_head(name)]
    if not heads or skeleton.parents[heads[0]] < 0:
        return None
    head, neck = points[:, heads[0]], points[:, skeleton.parents[heads[0]]]
    along = head - neck
    length = np.maximum(np.linalg.norm(along, axis=-1, keepdims=True), 1e-6)
    return head + 0.07 * along / length


def path_on_ground(path) -> np.ndarray:
    """Accept a RootPath or an array [T, 2] of x and z."""
    points = np.asarray(getattr(path, "position", path), dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 2 or not np.all(np.isfinite(points)):
        raise ValueError(f"a target path must be [T, 2] (x, z) and finite, got {points.shape}")
    return points
