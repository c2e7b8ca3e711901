"""Which joint is the knee: roles of a humanoid's joints, by the tree and the lengths of its bones; names break ties."""

import re
from itertools import combinations, pairwise

import numpy as np

_ARM = ("shoulder", "elbow", "wrist")
_LEG = ("hip", "knee", "ankle", "toe")
# "Left" in any case; or a letter that stands alone (L_Hip, thigh.l, Bip01 L Thigh; not L5, a vertebra) or before a
# capital (lThigh, LTHIGH; not ROOT); never in what stands before a colon.
_SIDE = re.compile(
    r"(?:(?i:left|right)|(?<![A-Za-z])[LRlr](?:(?![A-Za-z0-9])|(?=[A-Z][A-Za-z])(?!OOT|OWER|IB|UMBAR)))(?!.*:)"
)
_TWINS = {"L": "R", "l": "r", "Left": "Right", "left": "right", "LEFT": "RIGHT"}
_TWINS |= {right: left for left, right in _TWINS.items()}
ROLES = {"hips", "neck", "head"} | {f"{side}_{part}" for side in ("left", "right") for part in ("collar", *_ARM, *_LEG)}
"""What a joint can be called by, beside spine_1, spine_2, ...; a joint of such a name plays that role."""

_NO_JOINT = re.compile(r"(?i)twist|roll|nub|_end$|effector|ik|pole")
_UPPER_ARM = re.compile(r"(?i)(?<!fore)(?<!lower)(?<!fore_)(?<!lower_)arm")
_LIMB = re.compile(r"(?i)leg|thigh|knee|foot|ankle|arm|hand|wrist|elbow")
_BY_NAME = {"hip": "hip|thigh|up(per)?_?leg", "toe": "toe|ball", "wrist": "wrist|hand"}


def side_of(name: str) -> str:
    """Return "left", "right" or "" for a joint's name, by the marks in use: LeftLeg, thigh.L, Bip01 L Thigh, lThigh."""
    marks = _SIDE.findall(name)
    return {"l": "left", "r": "right"}[marks[0][0].lower()] if marks else ""


def twin_name(name: str) -> str:
    """Return a joint's name with its first mark of a side swapped; a middle joint's name as it is."""
    return _SIDE.sub(lambda found: _TWINS.get(found[0], _TWINS[found[0].lower()]), name, count=1)


def joint_chain(skeleton, joint: int, top: int) -> list[int]:
    """Return the joints from `top` down to `joint`; only `joint` itself where it does not hang on `top`."""
    chain = [joint]
    while chain[0] != top and chain[0] >= 0:
        chain.insert(0, skeleton.parents[chain[0]])
    return chain if chain[0] == top else [joint]


def joint_roles(skeleton) -> dict[str, int]:
    """Name the joints of a humanoid by what they do (`Skeleton.roles` keeps them).

    Legs and arms are pairs of limbs that hang on one joint, as long as each other: the pair nearest to the root is the
    legs. Of a limb the two longest bones in a row are thigh and shin, or upper arm and forearm. What goes on from where
    the arms hang are neck and head. A joint that is called by a role plays it, and no other.

    Args:
      skeleton: any; what is not found is left out. Of one without legs of three joints, hips, toes, wrists and head are
        those whose names say so.

    Returns:
      Role -> joint: hips, spine_1, spine_2, ..., neck, head and, with left_ or right_ before it, collar, shoulder,
      elbow, wrist, hip, knee, ankle, toe.
    """
    ways = _longest_ways(skeleton)
    limbs = _limb_pairs(skeleton, ways)
    # A left_shoulder that carries a left_arm is a collar bone, though.
    upper_arm = lambda joint: any(_UPPER_ARM.search(skeleton.names[child]) for child in skeleton.children[joint])
    called = {name: joint for joint, name in enumerate(skeleton.names) if name in ROLES}
    called = {role: joint for role, joint in called.items() if part_of(role) != "shoulder" or not upper_arm(joint)}
    if not limbs:
        return {"hips": 0} | _by_names_alone(skeleton) | called
    hips, *legs = limbs[0]
    way = np.linalg.norm(skeleton.offsets[joint_chain(skeleton, hips, 0)[1:]], axis=-1).sum()
    root = 0 if way < 0.05 * ways[legs[0]][0] else hips
    above = [pair for pair in limbs[1:] if pair[0] != hips and len(joint_chain(skeleton, pair[0], root)) > 1]
    chest, *arms = max(above, key=lambda pair: ways[pair[1]][0], default=(hips,))
    roles = {"hips": root} | _upwards(skeleton, ways, root, chest, [*legs, *arms])
    for number, side in enumerate(("left", "right")):
        collar = {}
        if arms:
            roles |= _limb(skeleton, ways[arms[number]][1], side, _ARM)
            shoulder = roles[f"{side}_shoulder"]
            collar = {f"{side}_collar": skeleton.parents[shoulder]} if shoulder != arms[number] else {}
        roles |= _limb(skeleton, ways[legs[number]][1], side, _LEG) | collar
    free = set(roles.values()) - set(called.values())
    return {role: joint for role, joint in (roles | called).items() if role in called or joint in free}


def leg_length(skeleton, roles: dict[str, int]) -> float:
    """Return the length of thigh and shank, metres, of a skeleton with these `joint_roles`."""
    return float(np.linalg.norm(skeleton.offsets[[roles["left_knee"], roles["left_ankle"]]], axis=-1).sum())


def part_of(role: str) -> str:
    """Return a role without its side and number: knee, spine."""
    return role.removeprefix("left_").removeprefix("right_").split("_")[0]


def _longest_ways(skeleton) -> list[tuple[float, list[int]]]:
    """Return (length, joints) of the longest way down from each joint."""
    bones, ways = np.linalg.norm(skeleton.offsets, axis=-1).tolist(), [(0.0, [])] * skeleton.num_joints
    for joint in reversed(range(skeleton.num_joints)):
        below = [(bones[child] + ways[child][0], ways[child][1]) for child in skeleton.children[joint]]
        length, chain = max(below, key=lambda way: way[0], default=(0.0, []))
        ways[joint] = length, [joint, *chain]
    return ways


def _below(skeleton, top: int) -> list[int]:
    """Return a joint and all that hang on it."""
    found = [top]
    for joint in found:
        found += skeleton.children[joint]
    return found


def _limb_pairs(skeleton, ways) -> list[tuple[int, int, int]]:
    """Return (where they hang, left, right) of limbs of three joints or more, those nearest to the root first."""
    pairs, size = [], lambda joint: len(_below(skeleton, joint))
    for parent, children in enumerate(skeleton.children):
        for one, other in combinations([joint for joint in children if len(ways[joint][1]) >= 3], 2):
            lengths = ways[one][0], ways[other][0]
            alike = size(one) == size(other) and abs(lengths[0] - lengths[1]) < 0.05 * max(lengths)
            if alike or skeleton.names[other] == twin_name(skeleton.names[one]):
                pairs.append((parent, *_left_first(skeleton, ways, one, other)))
    known = [pair for pair in pairs if any(_LIMB.search(skeleton.names[joint]) for joint in _below(skeleton, pair[1]))]
    return sorted(known or pairs, key=lambda pair: len(joint_chain(skeleton, pair[0], 0)))


def _left_first(skeleton, ways, *limbs: int) -> list[int]:
    """Return two limbs, the left one first: by their names, or by +X where nothing is turned."""
    sides = [side_of(skeleton.names[joint]) for joint in limbs]
    if sorted(sides) == ["left", "right"]:
        return sorted(limbs, key=lambda joint: side_of(skeleton.names[joint]))
    return sorted(limbs, key=lambda joint: -skeleton.rest_positions[ways[joint][1], 0].mean())


def _limb(skeleton, chain: list[int], side: str, parts: tuple[str, ...]) -> dict[str, int]:
    """Return roles of a limb: its two longest bones in a row, and the joint after them."""
    chain = [joint for joint in chain if not _NO_JOINT.search(skeleton.names[joint])]
    place = {joint: skeleton.rest_positions[joint] for joint in chain}
    bones = [float(np.linalg.norm(place[below] - place[above])) for above, below in pairwise(chain)]
    pairs = [one + other for one, other in pairwise(bones)]
    # From a collar bone that begins at the chest, the upper arm comes second: the last of the pairs about as long.
    long = [number for number, length in enumerate(pairs) if length > 0.85 * max(pairs)]
    first = long[-1 if parts is _ARM else 0] if long else 0
    return {f"{side}_{part}": joint for part, joint in zip(parts, chain[first:], strict=False)}


def _upwards(skeleton, ways, hips: int, chest: int, limbs: list[int]) -> dict[str, int]:
    """Return spine, neck and head: the way from the hips to the chest, and what goes on from there."""
    spine, above, head = joint_chain(skeleton, chest, hips)[1:], [], None
    named = lambda joint, words: [k for k in _below(skeleton, joint) if re.search(f"(?i){words}", skeleton.names[k])]
    if free := [joint for joint in skeleton.children[chest] if joint not in limbs]:
        way = max(free, key=lambda joint: (bool(named(joint, "neck|head")), ways[joint][0], -joint))
        if heads := named(way, "head"):
            above = joint_chain(skeleton, heads[0], way)
        else:  # upwards for as long as each has one child
            above = [way]
            while len(skeleton.children[above[-1]]) == 1:
                above += skeleton.children[above[-1]]
        if heads or not re.search("(?i)neck", skeleton.names[above[-1]]):
            head = above.pop()
    neck = {"neck": above.pop()} if above else {}
    roles = neck | {f"spine_{number}": joint for number, joint in enumerate([*spine, *above], start=1)}
    return roles if head is None else roles | {"head": head}


def _by_names_alone(skeleton) -> dict[str, int]:
    """Return wrists, hips, toes and a head, by names."""
    roles = {name.lower(): joint for joint, name in enumerate(skeleton.names) if name.lower() == "head"}
    for joint, name in reversed([*enumerate(skeleton.names)]):
        roles |= {f"{side_of(name)}_{part}": joint for part, words in _BY_NAME.items() if re.search(words, name, re.I)}
    return {role: joint for role, joint in roles.items() if role in ROLES}
