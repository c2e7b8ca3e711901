"""Is this a person? Units, the axis that is up, and a T-pose before the take, as a skeleton's legs show them.

Files say neither their unit nor their axis. A reader takes centimetres and +Y up; here, at the one door for the motions
of others, legs and hips are measured: a unit in use or Z up is corrected and said, what fits no unit is refused.

Source: ours.
"""

import dataclasses
from collections.abc import Mapping

import numpy as np

from f3amd_lib.ground.names import check_known, checked_value
from f3amd_lib.motion.anatomy import leg_length
from f3amd_lib.motion.curves import unit
from f3amd_lib.motion.skeleton import Motion, Skeleton

LEGS = (0.45, 1.25)
"""Shortest and longest leg of a person, hip to ankle, metres."""

USUAL_LEG = 0.82
"""Metres; of several units that fit, the one whose leg is nearest to this."""

UNITS = {"metres": 1.0, "millimetres": 0.001, "inches": 0.0254, "CMU's unit": 0.0254 / 0.45}
"""Metres in a unit, beside centimetres. CMU's clips count in inches, at a scale of 0.45."""

JUMP = 0.2
"""Metres by which wrists move from hips in one frame, on average, where a T-pose ends and the take begins."""

_Z_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])


def as_person(
    motion: Motion, *, joint_map: Mapping[str, str] | None = None, scale: float | None = None, up: str | None = None,
    keep_first: bool = False,
) -> tuple[Motion, list[str]]:  # fmt: skip
    """Correct a stranger's motion that was read as centimetres with +Y up.

    Args:
      motion: with rotations or of positions alone.
      joint_map: as `call_by_roles` takes it.
      scale: metres in the file's unit, instead of what the legs say.
      up: "Y" or "Z", instead of what legs and hips say.
      keep_first: keep a T-pose before the take.

    Returns:
      (motion, notes): what had to be corrected, a sentence each. Motion without two legs is left as it is.

    Raises:
      ValueError: for legs that are a person's in no unit, where it names the option that overrules it, or of no
        walker's size at the scale told.
    """
    if joint_map:
        motion = call_by_roles(motion, joint_map)
    if up is not None:
        check_known(up, ("Y", "Z"), "axis that is up")
    if scale is not None:
        checked_value("scale", scale, "float")
    notes, roles = [], motion.skeleton.roles
    legs = {"left_ankle", "right_ankle"} <= set(roles)
    if not legs and (scale is None or up is None):
        notes.append("no two legs were found, so it is read in centimetres with Y up")
    told = f"units of {scale} m", 100.0 * (scale or 0.01)
    measure, factor = _unit(motion, roles) if scale is None and legs else told
    if factor != 1.0:
        motion = _mapped(motion, factor * np.eye(3), np.eye(3))
        long = f": its legs are {(leg := leg_length(motion.skeleton, roles)):.3g} m" if legs else ""
        if legs and not 0.01 < leg < 100.0:
            raise ValueError(f"{motion.name}: {measure} are no scale of a walker{long}")
        notes.append(f"read in {measure}{long}")
    if up == "Z" or (up is None and legs and _lies(motion, roles)):
        motion = _mapped(motion, _Z_UP, _Z_UP)
        notes.append("read with Z up")
    if motion.rotations is not None and legs:
        motion = _completed(motion, notes)
    roles = motion.skeleton.roles
    if not keep_first and {"left_wrist", "right_wrist"} <= set(roles) and motion.num_frames > 2:
        wrists = motion.positions[:, [roles["left_wrist"], roles["right_wrist"]]] - motion.positions[:, [roles["hips"]]]
        steps = np.linalg.norm(np.diff(wrists, axis=0), axis=-1).mean(axis=-1)
        if steps[0] > JUMP and steps[0] > 5 * np.median(steps[1:]):
            motion = motion.slice(1, motion.num_frames)
            notes.append(f"its first frame is left out: wrists jump {100 * steps[0]:.0f} cm after it, as from a T-pose")
    return motion, notes


def call_by_roles(motion: Motion, joint_map: Mapping[str, str]) -> Motion:
    """Return a motion whose joints are called by the roles that a map, role -> joint's name, gives them."""
    skeleton = motion.skeleton
    roles = {skeleton.index(name): role for role, name in joint_map.items()}
    if len(roles) < len(joint_map):
        raise ValueError(f"a joint can play one role; two are given to one of {', '.join(joint_map.values())}")
    others = {name: f"{name} of the file" for name in joint_map}  # a name that now is another joint's
    names = [roles.get(joint, others.get(name, name)) for joint, name in enumerate(skeleton.names)]
    return motion.replace(skeleton=dataclasses.replace(skeleton, names=names))


def _completed(motion: Motion, notes: list[str]) -> Motion:
    """Add toes and a head from End Sites, or as people have them, and a neck, where they are missing."""
    skeleton, roles = motion.skeleton, motion.skeleton.roles
    tips, size = dict(skeleton.end_sites), leg_length(skeleton, roles) / USUAL_LEG
    across = skeleton.rest_positions[roles["left_hip"]] - skeleton.rest_positions[roles["right_hip"]]
    ahead = unit(np.cross(across, [0.0, 1.0, 0.0]))

    def ended(motion: Motion, role: str, parent: int, guess) -> Motion:
        tip = np.array(tips.get(parent, np.zeros(3)))
        found = np.linalg.norm(tip) > 0.02 * size
        notes.append(f"{role.replace('_', ' ')} {'taken from an End Site' if found else 'guessed'}")
        return _with_joint(motion, motion.skeleton.num_joints, role, parent, tip if found else size * guess)

    for side in ("left", "right"):
        if f"{side}_toe" not in roles:
            motion = ended(motion, f"{side}_toe", roles[f"{side}_ankle"], 0.13 * ahead - [0.0, 0.06, 0.0])
    if "neck" in roles and "head" not in roles:
        motion = ended(motion, "head", roles["neck"], 0.1 * unit(skeleton.offsets[roles["neck"]]))
    elif "head" in roles and "neck" not in roles:
        head = roles["head"]
        motion = _with_joint(motion, head, "neck", skeleton.parents[head], 2 / 3 * skeleton.offsets[head], head)
        notes.append("neck guessed below the head")
    return motion


def _with_joint(motion: Motion, at: int, name: str, parent: int, offset, child: int | None = None) -> Motion:
    """Return a motion with one more joint at a place in the order; a child hangs on it from then on, where it was."""
    old = motion.skeleton
    moved = lambda joint: joint + (joint >= at)
    parents = [moved(joint) for joint in old.parents]
    offsets = old.offsets.copy()
    if child is not None:
        parents[child], offsets[child] = at, offsets[child] - offset
    names = (*old.names[:at], name, *old.names[at:])
    parents = (*parents[:at], parent, *parents[at:])
    tips = tuple((moved(joint), tip) for joint, tip in old.end_sites if joint != parent or child is not None)
    skeleton = Skeleton(names, parents, np.insert(offsets, at, offset, axis=0), tips)
    return motion.replace(skeleton=skeleton, rotations=np.insert(motion.rotations, at, np.eye(3), axis=1))


def _unit(motion: Motion, roles) -> tuple[str, float]:
    """Return the unit that makes a person of the legs, and its centimetres."""
    leg = leg_length(motion.skeleton, roles)
    if LEGS[0] <= leg <= LEGS[1]:
        return "centimetres", 1.0
    fits = {name: 100 * metres for name, metres in UNITS.items() if LEGS[0] <= 100 * metres * leg <= LEGS[1]}
    if not fits:
        what = f"its legs are {100 * leg:.3g} units long, a person's in no unit known here"
        raise ValueError(f"{motion.name}: {what}; name it with --scale METRES_IN_A_UNIT")
    return min(fits.items(), key=lambda item: abs(np.log(item[1] * leg / USUAL_LEG)))


def _lies(motion: Motion, roles) -> bool:
    """Say whether the left hip is over its ankle along Z on average, and not along Y in a skeleton at rest: Z is up."""
    places = motion.skeleton.rest_positions, motion.positions.mean(axis=0)
    rest, moving = (place[roles["left_hip"]] - place[roles["left_ankle"]] for place in places)
    return np.abs(rest).argmax() != 1 and np.abs(moving).argmax() == 2 and moving[2] > 0


def _mapped(motion: Motion, move: np.ndarray, axes: np.ndarray) -> Motion:
    """Return a motion in other units or axes: joints' own frames change with the world's."""
    old = motion.skeleton
    tips = tuple((joint, tuple((move @ tip).tolist())) for joint, tip in old.end_sites)
    skeleton = Skeleton(old.names, old.parents, old.offsets @ move.T, tips)
    if motion.rotations is None:
        return Motion.from_positions(skeleton, motion.positions @ move.T, motion.fps, motion.name)
    turned = axes @ motion.rotations @ axes.T
    return motion.replace(skeleton=skeleton, root_position=motion.root_position @ move.T, rotations=turned)
