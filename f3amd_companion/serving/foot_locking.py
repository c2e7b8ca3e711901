"""Foot locking, an optional post-process: feet that carry the body stay in place.

Ours, and never used where a row of the paper is measured: there, feet slide as the network lets
them. Here each toe gets a new path p beside its old one o. While its foot carries, p is one point
on the floor, and which point is left open; else p stays as near to o as a smooth path can:

    sum |d'' |^2 + a^-2 sum |d'|^2 + l^-4 sum |d|^2  least,   d = p - o,

with differences between frames for d' and d''. On the ground a is infinite and l 0.15 s; in height
a is 0.07 s and l 0.2 s, which keeps a swing as high as it was. So a foot stands where that asks
least of the leg, and corrections fade by themselves, without a jump in value or velocity. A contact
that would move a toe by more than `FARTHEST` is cut in two with a small step between, and where a
leg is too short a contact is let go.

The leg follows by rotations of hip, knee and ankle; bones keep their lengths, knees their side and
feet their orientation. The root keeps its path over the ground and is lowered, by `DEEPEST` at
most, where a leg is too short.

Source: ours, in the order of L. Kovar, J. Schreiner and M. Gleicher, "Footskate Cleanup for Motion
Capture Editing", SCA 2002 (plan, root, legs), with least squares in place of their blends, and no
stretched bones.

Who steers cannot wait for the frames ahead: the steer page settles each frame as it comes (`serving/web/motion.js`;
`tests/feet_oracle.py` is the same in Python). Measured (docs/results.md): planned feet slide by 0.0 cm/s, those settled
frame by frame by 0.2 to 0.7, and of `CAMDM` nearly three times as many of their frames slide fast.
"""

import dataclasses
import itertools

import numpy as np
from scipy import ndimage, sparse
from scipy.sparse.linalg import splu

from f3amd_lib.data.features import frame_positions, world_frames
from f3amd_lib.ground.arrays import finite_array
from f3amd_lib.measures.walking import STEP_PROMINENCE, toe_positions
from f3amd_lib.motion.anatomy import joint_chain
from f3amd_lib.motion.curves import smooth_above, unit
from f3amd_lib.motion.rotations import shortest_turn
from f3amd_lib.motion.skeleton import Motion, Skeleton, contact_labels, global_rotations
from f3amd_lib.rollout.generated import Rollout

FARTHEST = 0.25
"""How far a standing toe is moved over the ground at most, metres."""

DEEPEST = 0.04
"""How far the root is lowered at most where a leg is too short, metres."""

_SHORTEST, _GAP = 0.1, 0.07  # seconds: shorter contacts are none, shorter gaps are closed
_STRAIGHT = 0.985  # share of a leg's length beyond which the root gives way
_STEP_SECONDS, _STEP_HEIGHT = 0.27, 0.009  # of the step between two halves of a contact; metres
_HELD = 1e4  # weight of a height that is given, beside 1 for an acceleration


def leg_chains(skeleton: Skeleton) -> np.ndarray:
    """Return the joints hip, knee, ankle and toe of the left and the right leg, [2, 4].

    Raises:
      ValueError: where toes or hips are not known, or legs are not made of these four.
    """
    chains = []
    for side in ("left", "right"):
        chain = joint_chain(skeleton, skeleton.role(f"{side}_toe"), skeleton.role(f"{side}_hip"))
        if len(chain) != 4:
            there = ", ".join(skeleton.names[joint] for joint in chain)
            raise ValueError(f"the {side} leg must be hip, knee, ankle, toe; this skeleton has {there}")
        chains.append(chain)
    return np.array(chains)


def _runs(mask) -> list[tuple[int, int]]:
    """Return start and stop of each stretch of true values."""
    return [(run.start, run.stop) for (run,) in ndimage.find_objects(ndimage.label(mask)[0])]


def _without_short(mask, seconds: float, fps: float, ends: bool = False) -> np.ndarray:
    """Drop stretches of true values that are shorter than so many seconds; with `ends`, not the first and the last."""
    frames = int(np.ceil(seconds * fps))
    return ndimage.binary_opening(np.pad(mask, frames, constant_values=ends), np.ones(frames))[frames:-frames]


# ------------------------------------------------------------------------------- when feet stand


def plan_contacts(positions, skeleton: Skeleton, fps: float = 30.0, floor=None) -> np.ndarray:
    """Decide when each foot should support, of motion whose feet may slide, sink and float.

    A foot stands while its toe is low, slow, or clearly lower and slower than the other one. Low is
    meant over the lowest the toe gets within a second or so; slow, beside how fast the motion's
    slower foot usually is, as speeds in a contact are what is wrong with the motion. Steps that
    `walking.stepping_rate` would count are never contacts. At its ends a contact is cut to frames
    as high and as fast as the rest of it.

    Args:
      positions: [T, J, 3], metres.
      skeleton: the joints.
      fps: frames per second.
      floor: height of a resting toe, metres; a toe 4 cm above it and more is never low. By default
        a low percentile of the toes' heights.

    Returns:
      Boolean [T, 2], left and right as in `Skeleton.toes`; of 3 frames and more.

    Raises:
      ValueError: for positions that do not fit, or a number that is not finite.
    """
    positions = finite_array("positions", positions, ("frame", skeleton.num_joints, 3))
    toes = toe_positions(positions, skeleton)
    height = toes[..., 1]
    contacts = np.zeros(height.shape, dtype=bool)

    def frames(seconds):  # an odd number of them
        return 2 * round(0.5 * seconds * fps) + 1

    floor = np.percentile(height, 12) if floor is None else floor
    lowest = ndimage.percentile_filter(height, 12, size=(frames(1.2), 1), mode="nearest")
    above = height - np.minimum(lowest, floor + 0.04)
    speed = fps * np.linalg.norm(np.gradient(toes[..., [0, 2]], axis=0), axis=-1)
    calm = ndimage.median_filter(speed, size=(frames(0.15), 1), mode="nearest")
    usual = ndimage.median_filter(calm.min(axis=-1), size=frames(2.0), mode="nearest")
    unrest = np.maximum(above, 0.0) / 0.03 + calm / np.maximum(3.0 * usual, 0.45)[:, None]
    other = unrest[:, ::-1]
    sure = (unrest < 0.8) | ((unrest < 0.6 * other) & (above < 0.06))
    likely = (unrest < 1.5) | ((unrest < 0.8 * other) & (above < 0.08))
    for foot in range(2):
        for start, stop in _steps(ndimage.uniform_filter1d(height[:, foot], frames(0.1), mode="nearest")):
            likely[start:stop, foot] = False
        contact = contacts[:, foot]
        for start, stop in _runs(likely[:, foot]):
            if not sure[start:stop, foot].any():
                continue
            differs = speed[:, foot] > 1.5 * np.median(speed[start:stop, foot]) + 0.3
            differs |= height[:, foot] > np.median(height[start:stop, foot]) + 0.02
            if (alike := np.flatnonzero(~differs[start:stop])).size:
                contact[start + alike[0] : start + alike[-1] + 1] = True
        contacts[:, foot] = _without_short(~_without_short(~contact, _GAP, fps, ends=True), _SHORTEST, fps)
    return contacts


def _steps(height):
    """Yield the upper half, [start, stop), of each peak of a height [T] that stands out by `STEP_PROMINENCE`."""
    for peak in 1 + np.flatnonzero((height[1:-1] > height[:-2]) & (height[1:-1] >= height[2:])):
        higher = np.flatnonzero(height > height[peak])  # it stands out over the deeper valley before a higher one
        k = np.searchsorted(higher, peak)
        start, stop = higher[k - 1] + 1 if k else 0, higher[k] if k < len(higher) else len(height)
        depth = height[peak] - max(height[start : peak + 1].min(), height[peak:stop].min())
        if depth >= STEP_PROMINENCE:
            low = np.flatnonzero(height < height[peak] - 0.5 * depth)
            k = np.searchsorted(low, peak)
            yield low[k - 1] + 1, low[k]


# ------------------------------------------------------------------------------ where feet stand


def _settle(toe, contact, heights, fps: float) -> np.ndarray:
    """Return the path of this module's text, [T, 3], never under `heights` [T]."""
    frames = len(toe)
    slope = sparse.diags_array([-1.0, 1.0], offsets=[0, 1], shape=(frames - 1, frames))
    bend = sparse.diags_array([1.0, -2.0, 1.0], offsets=[0, 1, 2], shape=(frames - 2, frames))
    bend, slope, same = bend.T @ bend, slope.T @ slope, sparse.eye_array(frames)
    path = toe.copy()

    cost = bend + same / (0.15 * fps) ** 4
    # Frames of one contact share one unknown.
    first = np.concatenate([[True], ~(contact[1:] & contact[:-1])])
    share = sparse.csr_array((np.ones(frames), (np.arange(frames), np.cumsum(first) - 1)))
    path[:, [0, 2]] = share @ splu((share.T @ cost @ share).tocsc()).solve(share.T @ (cost @ toe[:, [0, 2]]))

    cost = bend + slope / (0.07 * fps) ** 2 + same / (0.2 * fps) ** 4
    # Toes may roll off the floor in the first and the last frames of a contact.
    held = ~ndimage.maximum_filter1d(~contact, 2 * round(0.07 * fps) + 1, mode="nearest")
    for _ in range(20):  # frames that end up under the floor are held there in their turn
        weight = sparse.diags_array(_HELD * held)
        path[:, 1] = splu((cost + weight).tocsc()).solve(cost @ toe[:, 1] + weight @ heights)
        sunk = ~held & (path[:, 1] < heights - 1e-4)
        if not sunk.any():
            break
        held |= sunk
    path[:, 1] = np.maximum(path[:, 1], heights)
    return path


def _plan_toe(leg, contact, floor: float, limit, fps: float):
    """Settle a toe, with contacts cut where they ask too much.

    Args:
      leg: hip, knee, ankle and toe as they were, [T, 4, 3].
      contact: [T].
      floor: height of a resting toe.
      limit: how far an ankle may be from its hip, [T].
      fps: frames per second.

    Returns:
      Where the ankle shall be, [T, 3], and how far the hip has to come down for it, [T].
    """
    hip, _, ankle, toe = np.moveaxis(leg, 1, 0)
    foot, contact, wanted = toe - ankle, contact.copy(), toe.copy()
    heights = floor + np.maximum(foot[:, 1], 0.0)  # neither toe nor ankle under the floor
    gap = max(3, round(_STEP_SECONDS * fps))
    while True:
        target = _settle(wanted, contact, heights, fps) - foot
        across = np.square((target - hip)[:, [0, 2]]).sum(axis=-1)
        lack = (hip - target)[:, 1] - np.sqrt(np.maximum(limit**2 - across, 0.0))
        moved = np.linalg.norm((target - ankle)[:, [0, 2]], axis=-1)
        release = np.zeros(len(contact), dtype=bool)
        for start, stop in _runs(contact):
            if moved[start:stop].max() > FARTHEST:
                middle = max(start, (start + stop - gap) // 2)
                step = np.arange(middle, min(middle + gap, stop))
                wanted[step, 1] += _STEP_HEIGHT * np.sin(np.pi * (step - middle + 0.5) / gap) ** 2
                release[step] = True
            else:  # where a foot would have to stand too far away, a lack says nothing yet
                release[start:stop] = lack[start:stop] > DEEPEST
        if not release.any():
            return target, np.where(contact, np.maximum(lack, 0.0), 0.0)
        # A foot that stood again a frame or two later would hop.
        for start, stop in _runs(release):
            if start > 0 and stop < len(contact) and contact[start - 1] and contact[stop]:
                apart = max(0, gap + 1 - (stop - start)) // 2
                release[max(0, start - apart) : stop + apart] = True
        contact = _without_short(contact & ~release, _SHORTEST, fps)


# -------------------------------------------------------------------------------------- the legs


def knee_axes(leg, thigh_turn, across) -> np.ndarray:
    """Return the axis of each knee's bend, as the thigh sees it, [T, 3]; the longer, the more it bends.

    Args:
      leg: hip, knee, ankle and toe, [T, 4, 3].
      thigh_turn: the thigh's global rotations, [T, 3, 3].
      across: from the right hip to the left one, [T, 3]: the axis of a leg that is straight throughout.
    """
    axis = np.cross(unit(leg[:, 1] - leg[:, 0]), unit(leg[:, 2] - leg[:, 1]))
    return np.einsum("tba,tb->ta", thigh_turn, axis + 1e-3 * across)


def leg_reach(leg) -> np.ndarray:
    """Return how long the line from hip to ankle may become, [T, 2]: what `bend_leg` takes.

    A leg yields from the first length on and never gets longer than the second; one that is straighter already stays.
    """
    hip, knee, ankle, _ = np.moveaxis(leg, 1, 0)
    length = np.linalg.norm(knee - hip, axis=-1) + np.linalg.norm(ankle - knee, axis=-1)
    before = np.linalg.norm(ankle - hip, axis=-1)
    return np.stack([np.maximum(before, share * length) for share in (_STRAIGHT, 0.9995)], axis=-1)


def bend_leg(skeleton: Skeleton, chain, leg, turned, usual, line, reach) -> np.ndarray:
    """Bend a knee and turn a hip until the ankle lies where it shall; the foot keeps its orientation.

    Args:
      skeleton: of all joints.
      chain: hip, knee, ankle and toe of the leg, numbers.
      leg: where they were, [T, 4, 3].
      turned: global rotations of all joints, [T, J, 3, 3].
      usual: the axis about which this knee usually bends, of length 1, as the thigh sees it, [3].
      line: from hip to ankle as it shall be, [T, 3].
      reach: how long that line may be, [T, 2]: yields from the first length on, to the second.

    Returns:
      Local rotations of hip, knee and ankle, [3, T, 3, 3].
    """
    hip, knee, ankle, _ = np.moveaxis(leg, 1, 0)
    thigh, shank, usual = unit(knee - hip), unit(ankle - knee), turned[:, chain[0]] @ usual
    upper, lower = np.linalg.norm(knee - hip, axis=-1), np.linalg.norm(ankle - knee, axis=-1)
    near, far = reach.T
    length, room = np.linalg.norm(line, axis=-1), np.maximum(far - near, 1e-9)
    length = np.minimum(length, near) - room * np.expm1(-np.maximum(length - near, 0.0) / room)
    angle = np.arccos(np.clip((length**2 - upper**2 - lower**2) / (2.0 * upper * lower), -1.0, 1.0))[:, None]
    # The knee's axis; in a straight leg the usual one of this motion, which keeps the knee's side.
    axis = np.cross(thigh, shank)
    axis = axis + np.maximum(0.03 - (axis * usual).sum(axis=-1, keepdims=True), 0.0) * usual
    axis = unit(axis - (axis * thigh).sum(axis=-1, keepdims=True) * thigh)
    bent = np.cos(angle) * thigh + np.sin(angle) * np.cross(axis, thigh)
    knee_turn = shortest_turn(shank, bent)
    hip_turn = shortest_turn(upper[:, None] * thigh + lower[:, None] * bent, line)
    parent, *own = (turned[:, joint] for joint in (skeleton.parents[chain[0]], *chain[:3]))
    frames = [parent, hip_turn @ own[0], hip_turn @ knee_turn @ own[1], own[2]]
    return np.stack([np.swapaxes(above, -1, -2) @ below for above, below in itertools.pairwise(frames)])


def lock_feet(motion: Motion, floor: float | None = None) -> Motion:
    """Hold feet in place while they carry, and never under the floor.

    Args:
      motion: any motion of a skeleton whose legs are hip, knee, ankle, toe.
      floor: height of a resting toe, metres; by default the median of toes in contact.

    Returns:
      The motion, float64: hips, knees and ankles turned, the root's height lowered here and there.
      Toes stand still in the contacts of `plan_contacts`, as far as `FARTHEST`, `DEEPEST` and the legs allow. Fewer
      than 3 frames stay as they are.

    Raises:
      ValueError: for a skeleton with other legs, or numbers that are not finite.
    """
    skeleton, fps = motion.skeleton, motion.fps
    chains = leg_chains(skeleton)
    positions = np.asarray(motion.positions, np.float64)
    if motion.num_frames < 3:
        return motion
    contacts = plan_contacts(positions, skeleton, fps, floor)
    if floor is None:
        height = toe_positions(positions, skeleton)[..., 1]
        floor = np.median(height[contacts]) if contacts.any() else height.min()
    legs = np.moveaxis(positions[:, chains], 1, 0)  # [2, T, 4, 3]
    reaches = [leg_reach(leg) for leg in legs]
    planned = [
        _plan_toe(leg, contact, floor, reach[:, 0], fps)
        for leg, contact, reach in zip(legs, contacts.T, reaches, strict=True)
    ]
    drop = smooth_above(np.maximum(*(lack for _, lack in planned)), fps)[:, None] * np.array([0.0, -1.0, 0.0])

    rotations = np.array(motion.needed_rotations("locking feet"), np.float64)
    turned, across = global_rotations(skeleton, rotations), legs[0, :, 0] - legs[1, :, 0]
    for chain, leg, (target, _), reach in zip(chains, legs, planned, reaches, strict=True):
        usual = unit(knee_axes(leg, turned[:, chain[0]], across).sum(axis=0))
        bent = bend_leg(skeleton, chain, leg, turned, usual, target - leg[:, 0] - drop, reach)
        rotations[:, chain[:3]] = np.moveaxis(bent, 0, 1)
    return motion.replace(root_position=np.asarray(motion.root_position, np.float64) + drop, rotations=rotations)


def lock_rollout(rollout: Rollout) -> Rollout:
    """Lock the feet of all characters of a rollout by a plan; blend it before, if at all, not after.

    The floor is where the lowest toe rests in a character's history, which is real motion, and where none does, as for
    `lock_feet`.

    Args:
      rollout: as the network made it, or blended.

    Returns:
      The rollout with other frames; its `feet_locked` says so. The history, which counts as the past of
      contacts, is as it was.

    Raises:
      ValueError: for a rollout whose feet are locked already, or as `lock_feet`.
    """
    if rollout.feet_locked:
        raise ValueError("the feet of this rollout are locked already")
    past = frame_positions(rollout.skeleton, np.asarray(rollout.history, np.float64))
    height, resting = toe_positions(past, rollout.skeleton)[..., 1], contact_labels(rollout.skeleton, past)
    frames = []
    for character, (toes, rests) in enumerate(zip(height, resting, strict=True)):
        floor = toes[rests].min() if rests.any() else None
        locked = lock_feet(rollout.motion(character, with_history=True), floor=floor)
        frames.append(world_frames(locked)[rollout.history.shape[1] :])
    return dataclasses.replace(rollout, frames=np.asarray(frames, rollout.frames.dtype), feet_locked=True)
