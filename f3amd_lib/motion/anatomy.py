"""Which joint is the knee: roles of joints by the few names we know and by the tree between them."""

import numpy as np

from f3amd_lib.motion.skeleton import Skeleton

_ARM = ("shoulder", "elbow", "wrist")
_LEG = ("hip", "knee", "ankle", "toe")


def joint_chain(skeleton: Skeleton, joint: int, top: int) -> list[int]:
    """Return the joints from `top` down to `joint`; only `joint` itself where it does not hang on `top`."""
    chain = [joint]
    while chain[0] != top and chain[0] >= 0:
        chain.insert(0, skeleton.parents[chain[0]])
    return chain if chain[0] == top else [joint]


def joint_roles(skeleton: Skeleton) -> dict[str, int]:
    """Name the joints of a humanoid by what they do.

    Names give head, hips, toes, shoulders and wrists (`Skeleton.role`); the tree gives what lies between.

    Args:
      skeleton: any; what is not found is left out.

    Returns:
      Role -> joint: hips (the root), spine_1, spine_2, ..., neck, head and, with left_ or right_ before it, collar,
      shoulder, elbow, wrist, hip, knee, ankle, toe.
    """
    roles = {"hips": 0}
    if skeleton.has_role("head"):
        *spine, head = joint_chain(skeleton, skeleton.role("head"), 0)[1:] or [0]
        if spine:
            roles["neck"] = spine.pop()
        roles |= {f"spine_{number}": joint for number, joint in enumerate(spine, start=1)} | {"head": head}
    for side in ("left", "right"):
        for parts in (_ARM, _LEG):
            first, last = f"{side}_{parts[0]}", f"{side}_{parts[-1]}"
            if not (skeleton.has_role(first) and skeleton.has_role(last)):
                continue
            chain = joint_chain(skeleton, skeleton.role(last), skeleton.role(first))
            if len(chain) == len(parts):
                roles |= {f"{side}_{part}": joint for part, joint in zip(parts, chain, strict=True)}
        above = skeleton.parents[roles[f"{side}_shoulder"]] if f"{side}_shoulder" in roles else 0
        if above not in roles.values():
            roles[f"{side}_collar"] = above
    return roles


def leg_length(skeleton: Skeleton, roles: dict[str, int]) -> float:
    """Return the length of thigh and shank, metres, of a skeleton with these `joint_roles`."""
    return float(np.linalg.norm(skeleton.offsets[[roles["left_knee"], roles["left_ankle"]]], axis=-1).sum())


def part_of(role: str) -> str:
    """Return a role without its side and number: knee, spine."""
    return role.removeprefix("left_").removeprefix("right_").split("_")[0]
