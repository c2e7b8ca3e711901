"""Feet that are held while somebody steers: the oracle of the steer page's JavaScript (`serving/web/motion.js`).

Who steers cannot wait for the frames ahead. Each frame is settled when it is made, from itself and a few numbers that
are kept of those before:

- A foot begins to carry when its toe is low and slow, or clearly lower and slower than the other one; it goes on
  until it is clearly neither. These are the rules of `plan_contacts` with its medians replaced by running means.
- The toe of a foot that begins to carry runs out within a tenth of a second and then stands. Where it goes over from
  one goal (its own path) to another (a point on the floor) or back, it keeps place and velocity: the difference dies
  away like a critically damped spring. So nothing pops.
- A foot lets go where the point is farther than `FARTHEST` from where the network has the toe, or farther than the
  leg reaches, and then carries again after `PAUSE` at the earliest. The hips stay where they are.

The leg follows as in a plan. The network never hears of it: its history is what it made, so that locking changes no
later frame. The running-out is inertialisation (D. Bollo, GDC 2018), the spring that of games.
"""

import dataclasses
from typing import NamedTuple

import numpy as np

from f3amd_companion.serving.foot_locking import FARTHEST, bend_leg, knee_axes, leg_chains, leg_reach
from f3amd_lib.data.features import split_frames
from f3amd_lib.ground.arrays import finite_array
from f3amd_lib.motion.curves import unit
from f3amd_lib.motion.rotations import matrix_from_rotation_6d, rotation_6d_from_matrix
from f3amd_lib.motion.skeleton import Skeleton, forward_kinematics, global_rotations
from f3amd_lib.rollout.generated import Rollout

FPS = 30.0
RUN_OUT, LET_GO = 30.0, 12.0
"""Rates of the springs that end in a standing toe and in a free one, 1/s; of feet that are settled frame by frame."""

PAUSE, SLACK = 6, 0.02
"""Frames for which a foot that had to let go carries nothing; how much farther than a leg reaches its ankle may be
asked to be, metres."""


class Feet(NamedTuple):
    """What is kept of the frames before; arrays have a row for the left and one for the right foot.

    Attributes:
      floor: height of a resting toe, metres.
      locking: whether feet were asked to stand.
      carries: whether a foot stands, [2].
      pause: frames for which it may not, [2].
      anchor: x, z where it stands, [2, 2].
      shown, pace: place and velocity of the toe as shown, [2, 3], metres and metres a second.
      off, off_pace: what is left of the way to the toe's goal, and its velocity, [2, 3].
      toe: where the network had it, [2, 3].
      calm: its running speed over the ground, [2], metres a second.
      lowest: a running minimum of its height, [2], metres.
      usual: running speed of the slower foot, metres a second.
      axis: running axis of the knee's bend, as the thigh sees it, [2, 3].
    """

    floor: float
    locking: bool
    carries: np.ndarray
    pause: np.ndarray
    anchor: np.ndarray
    shown: np.ndarray
    pace: np.ndarray
    off: np.ndarray
    off_pace: np.ndarray
    toe: np.ndarray
    calm: np.ndarray
    lowest: np.ndarray
    usual: float
    axis: np.ndarray


def start_feet(skeleton: Skeleton, history) -> Feet:
    """Begin after a history, whose feet are left as they are.

    Args:
      skeleton: its legs must be hip, knee, ankle and toe.
      history: world frames [H, C]; the floor is where its lowest toe is.

    Raises:
      ValueError: for other legs, or frames that do not fit.
    """
    toes = leg_chains(skeleton)[:, 3]
    history = finite_array("history", history, ("frame", 3 + 6 * skeleton.num_joints))
    root, turns = split_frames(history)
    path = forward_kinematics(skeleton, root, matrix_from_rotation_6d(turns))[:, toes]
    floor = float(path[..., 1].min())
    zero = np.zeros((2, 3))
    feet = Feet(
        floor, False, np.zeros(2, bool), np.zeros(2, int), path[0][:, [0, 2]], path[0], zero, zero, zero,
        path[0], np.zeros(2), path[0, :, 1], 0.0, zero,
    )  # fmt: skip
    return lock_frames(skeleton, feet, history, locking=False)[0]


def lock_frame(skeleton: Skeleton, feet: Feet, frame, *, locking: bool = True) -> tuple[Feet, np.ndarray]:
    """Settle the feet of one frame.

    Args:
      skeleton: as in `start_feet`.
      feet: kept of the frames before.
      frame: as the network made it, world frame [C].
      locking: whether feet shall stand; when that changes, they go over smoothly.

    Returns:
      (what is kept now, the frame with hips, knees and ankles turned).
    """
    frame = np.asarray(frame, np.float64)
    chains, (root, turns) = leg_chains(skeleton), split_frames(frame)
    rotations = matrix_from_rotation_6d(turns)
    turned = global_rotations(skeleton, rotations[None])
    points = forward_kinematics(skeleton, root, rotations)
    legs = points[chains][:, None]  # [2, 1, 4, 3]: a frame each
    hips, ankle, toe = legs[:, 0, 0], legs[:, 0, 2], legs[:, 0, 3]

    # How unlike a carrying foot each one is.
    velocity = FPS * (toe - feet.toe)
    calm = feet.calm + 0.7 * (np.linalg.norm(velocity[:, [0, 2]], axis=-1) - feet.calm)
    usual = feet.usual + (calm.min() - feet.usual) / FPS
    lowest = np.minimum(toe[:, 1], feet.lowest + 0.03 / FPS)
    above = np.maximum(toe[:, 1] - np.minimum(lowest, feet.floor + 0.04), 0.0)
    unrest = above / 0.03 + calm / max(3.0 * usual, 0.45)
    other = unrest[::-1]
    begins = (unrest < 0.8) | ((unrest < 0.6 * other) & (above < 0.06))
    goes_on = (unrest < 1.0) | ((unrest < 0.8 * other) & (above < 0.08))
    pause = np.maximum(feet.pause - 1, 0)
    carries = locking & (pause == 0) & np.where(feet.carries, goes_on, begins)

    foot = toe - ankle
    level = feet.floor + np.maximum(foot[:, 1], 0.0)  # neither toe nor ankle under the floor
    going = feet.shown + feet.pace / FPS  # where each toe would be without a change of mind
    reaches = np.array([leg_reach(leg) for leg in legs])
    run_out = going[:, [0, 2]] + feet.pace[:, [0, 2]] / RUN_OUT
    anchor = np.where((carries & ~feet.carries)[:, None], run_out, feet.anchor)
    point = np.stack([anchor[:, 0], level, anchor[:, 1]], axis=-1)
    away = np.linalg.norm(anchor - toe[:, [0, 2]], axis=-1)
    let_go = carries & ((away > FARTHEST) | (np.linalg.norm(point - foot - hips, axis=-1) > reaches[:, 0, 1] + SLACK))
    carries, pause = carries & ~let_go, np.where(let_go, PAUSE, pause)

    free = np.stack([toe[:, 0], np.maximum(toe[:, 1], level) if locking else toe[:, 1], toe[:, 2]], axis=-1)
    goal = np.where(carries[:, None], point, free)
    changed = (carries != feet.carries) | (locking != feet.locking)
    rate = np.where(carries, RUN_OUT, LET_GO)[:, None]
    push = (feet.off_pace + rate * feet.off) / FPS
    fade = np.exp(-rate / FPS)
    off, off_pace = fade * (feet.off + push), fade * (feet.off_pace - rate * push)
    goal_pace = np.where(carries[:, None], 0.0, velocity)
    off = np.where(changed[:, None], going - goal, off)
    off_pace = np.where(changed[:, None], feet.pace - goal_pace, off_pace)
    shown = goal + off
    if locking:
        shown[:, 1] = np.maximum(shown[:, 1], level)

    settled, axis = frame.copy(), feet.axis.copy()
    for k, chain in enumerate(chains):
        axis[k] = 0.97 * axis[k] + knee_axes(legs[k], turned[:, chain[0]], hips[0] - hips[1])[0]
        line = shown[k] - foot[k] - hips[k]
        bent = bend_leg(skeleton, chain, legs[k], turned, unit(axis[k]), line[None], reaches[k])
        settled[3:].reshape(-1, 6)[chain[:3]] = rotation_6d_from_matrix(bent[:, 0])
    kept = Feet(
        feet.floor, locking, carries, pause, anchor, shown, FPS * (shown - feet.shown), off, off_pace,
        toe, calm, lowest, usual, axis,
    )  # fmt: skip
    return kept, settled


def lock_frames(skeleton: Skeleton, feet: Feet, frames, *, locking: bool = True) -> tuple[Feet, np.ndarray]:
    """Settle frames [T, C] one after the other: `lock_frame` for each.

    Returns:
      (what is kept after them, frames [T, C]).
    """
    settled = []
    for frame in frames:
        feet, one = lock_frame(skeleton, feet, frame, locking=locking)
        settled.append(one)
    return feet, np.array(settled)


def lock_rollout_online(rollout: Rollout) -> Rollout:
    """Settle the feet of a rollout frame by frame, as the steer page does; blend it before, if at all, not after.

    Returns:
      The rollout with other frames; its `feet_locked` says so.

    Raises:
      ValueError: as `start_feet`.
    """
    pairs = zip(rollout.history, rollout.frames, strict=True)
    frames = [lock_frames(rollout.skeleton, start_feet(rollout.skeleton, past), made)[1] for past, made in pairs]
    return dataclasses.replace(rollout, frames=np.asarray(frames, rollout.frames.dtype), feet_locked=True)
