"""Motion of one humanoid on the skeleton of another: directions of its bones, lengths and twists of ours.

Joints are matched by role (`Skeleton.roles`), a spine of another number of joints by its length. Each bone of
ours is turned, from where a reference pose of our skeleton has it, to where the other one's bone points; hips and
chest, from which several bones go, by the rotation that fits them best. Where collar bones have no length, as CMU's, or
are missing, the chest is turned by the shoulders. What bones do not show, the twist of head and hands, stays as in the
reference. The root's path is scaled by the length of the legs, and the lowest toe put where
the reference has it.

Source: ours.
"""

import numpy as np
from scipy.interpolate import make_interp_spline

from f3amd_lib.ground import log
from f3amd_lib.motion.anatomy import leg_length
from f3amd_lib.motion.curves import unit
from f3amd_lib.motion.inverse_kinematics import aimed
from f3amd_lib.motion.skeleton import Motion, Skeleton, global_rotations, local_rotations

_SIDES = ("hip", "knee", "ankle", "toe", "shoulder", "elbow", "wrist")
NEEDED = ("neck", "head", *(f"{side}_{part}" for side in ("left", "right") for part in _SIDES))
"""Roles that both skeletons must have, beside the hips."""

SHORTEST = 0.005
"""Metres; a shorter bone shows no direction."""

DOUBTFUL, WRONG = 20.0, 40.0
"""Centimetres that joints are off on average: more than the first is warned of, more than the second refused. A walk on
bones of other proportions is off by 5 to 16."""


def retarget(motion: Motion, reference: Motion) -> tuple[Motion, float, np.ndarray]:
    """Put a motion on another skeleton.

    Args:
      motion: of any humanoid whose joints we can name.
      reference: an everyday pose of the wanted skeleton, with rotations: its first frame gives the twists, its lowest
        toe the floor.

    Returns:
      The motion on the reference's skeleton, at its own frame rate; the length of our legs beside theirs; and how far
      joints of shared roles are from theirs, times that and seen from the hips, centimetres, [T].

    Raises:
      ValueError: naming the roles for which either skeleton has no joint; for joints that are too far off (`WRONG`).
    """
    skeleton = reference.skeleton
    theirs, ours = motion.skeleton.roles, skeleton.roles
    for whose, roles in ((motion, theirs), (reference, ours)):
        missing = [role for role in NEEDED if role not in roles]
        if missing:
            what = f"no joint has the role {', '.join(missing)}; it has {', '.join(whose.skeleton.names)}"
            raise ValueError(f"motion {whose.name!r}: {what}; --joint-map says which is which")
    wanted = _wanted_points(motion, theirs, skeleton, ours)
    above = np.asarray(reference.needed_rotations("retargeting"), np.float64)[:1]
    rest, bones = global_rotations(skeleton, above)[0], _aimed_bones(skeleton, above[0], wanted)
    turned = np.tile(np.eye(3), (motion.num_frames, skeleton.num_joints, 1, 1))
    for joint, parent in enumerate(skeleton.parents):
        before = turned[:, parent] if parent >= 0 else turned[:, 0]
        aims = {child: wanted[child] - wanted[joint] for child in bones.get(joint, ())}
        aims = {child: aim for child, aim in aims.items() if np.linalg.norm(aim, axis=-1).min() > SHORTEST}
        if not aims:
            turned[:, joint] = before
            continue
        was = unit(np.array([bones[joint][child] for child in aims]) @ rest[joint].T)
        shall = unit(np.stack([*aims.values()], axis=1))
        turned[:, joint] = before @ aimed(was, shall @ before)
    local = local_rotations(skeleton, turned @ rest)
    scale = leg_length(skeleton, ours) / leg_length(motion.skeleton, theirs)
    made = Motion(skeleton, scale * motion.positions[:, theirs["hips"]], local, motion.fps, motion.name)
    floor = reference.positions[:, list(skeleton.toes), 1].min() - made.positions[:, list(skeleton.toes), 1].min()
    made = made.replace(root_position=made.root_position + [0.0, floor, 0.0])
    shared = [role for role in theirs if role in ours and "spine" not in role]
    there = motion.positions[:, [theirs[role] for role in shared]]
    here = made.positions[:, [ours[role] for role in shared]]
    apart = (here - here[:, :1]) - scale * (there - there[:, :1])
    error = 100.0 * np.linalg.norm(apart, axis=-1).mean(axis=-1)
    if error.mean() > DOUBTFUL:
        what = f"motion {motion.name!r}: joints would be {error.mean():.0f} cm off on average"
        if error.mean() > WRONG:
            raise ValueError(f"{what}, more than {WRONG:g}; is this a person? see f3amd joints FILE")
        log.warning("%s: look at the result, and at f3amd joints FILE", what)
    return made, float(scale), error


def _aimed_bones(skeleton: Skeleton, above: np.ndarray, wanted) -> dict[int, dict[int, np.ndarray]]:
    """Return for each joint the wanted joints at whose places it is aimed, and where it sees them in the reference.

    These are its children; beyond one that has no length, or is not wanted, what hangs on that.
    """
    bones = {}
    for child in wanted:
        offset, joint = skeleton.offsets[child], skeleton.parents[child]
        while joint >= 0:
            seen = np.linalg.norm(offset) > SHORTEST
            if joint in wanted and seen:
                bones.setdefault(joint, {})[child] = offset
            if joint in wanted and (not seen or np.linalg.norm(skeleton.offsets[joint]) > SHORTEST):
                break
            offset, joint = skeleton.offsets[joint] + above[joint] @ offset, skeleton.parents[joint]
    return bones


def _wanted_points(motion: Motion, theirs, skeleton: Skeleton, ours) -> dict[int, np.ndarray]:
    """Return for each joint of ours that has a role where the other one has it, [T, 3], in their lengths."""
    bones = np.linalg.norm(motion.skeleton.offsets, axis=-1)
    known = {role: joint for role, joint in theirs.items() if bones[joint] > SHORTEST or not role.endswith("collar")}
    place = {role: motion.positions[:, joint] for role, joint in known.items()}
    spine = sorted((role for role in theirs if role.startswith("spine_")), key=lambda role: int(role[6:]))
    line = np.stack([place[role] for role in ("hips", *spine, "neck")])
    walked = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=-1).mean(axis=-1))])
    own = sorted((role for role in ours if role.startswith("spine_")), key=lambda role: int(role[6:]))
    lengths = np.cumsum([np.linalg.norm(skeleton.offsets[ours[role]]) for role in (*own, "neck")])
    walked += 1e-9 * np.arange(len(walked))  # bones of no length, too
    along = make_interp_spline(walked, line, k=1)(walked[-1] * lengths / lengths[-1])
    place |= dict(zip(own, along, strict=False))
    return {joint: place[role] for role, joint in ours.items() if role in place}
