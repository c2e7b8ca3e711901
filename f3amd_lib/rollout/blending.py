"""Blending at window boundaries, an optional post-process (paper section 6).

The paper leaves its rollouts as they come, and so does every figure of this project unless it says
"blended": what is seen at a seam is what the network made of it. Products blend. We do it by
inertialisation: both sides of a seam are extended to the moment half way between the last frame of
the one window and the first of the next. There they differ by an offset in value and in velocity.
The later side gets this offset added, and lets it die away over the next frames by a polynomial:

    x(u) = offset (1 - 10 u^3 + 15 u^4 - 6 u^5) + N velocity (u - 6 u^3 + 8 u^4 - 3 u^5),

u = tau / N, tau frames after the seam, 0 <= u <= 1; x has the offset and its velocity at the seam,
and value, velocity and acceleration 0 after N frames. Frames before the seam are not touched, so
that nothing has to be known ahead and a running character could be blended as well. What is blended
is not given back to the network as history.

Source: ours, after D. Bollo, "Inertialization: High-Performance Animation Transitions in Gears of
War", GDC 2018 (offsets instead of cross-fades, a quintic in time), without its clamps, so that the
result is linear in the offset.
"""

import dataclasses
import itertools
from collections.abc import Callable

import numpy as np
from scipy.spatial.transform import Rotation

from f3amd_lib.data.features import split_frames
from f3amd_lib.ground.arrays import finite_array
from f3amd_lib.motion.rotations import matrix_from_rotation_6d, rotation_6d_from_matrix
from f3amd_lib.rollout.generated import Rollout


def dying_offset(offset, velocity, num_frames: int) -> np.ndarray:
    """Let an offset die away: the quintic of this module's text at tau = 1/2, 3/2, ..., N - 1/2.

    Args:
      offset: at the seam, [...].
      velocity: of the offset at the seam, per frame, [...].
      num_frames: N, at least 1.

    Returns:
      [N, ...], float64.
    """
    offset, velocity = np.asarray(offset, np.float64), np.asarray(velocity, np.float64)
    u = (np.arange(num_frames) + 0.5) / num_frames
    u = u.reshape(-1, *[1] * offset.ndim)
    value = 1.0 + u**3 * (-10.0 + u * (15.0 - 6.0 * u))
    slope = u + u**3 * (-6.0 + u * (8.0 - 3.0 * u))
    return value * offset + num_frames * slope * velocity


def blend_seams(frames, window: int, blend_frames: int, *, history=None) -> np.ndarray:
    """Blend world frames at the boundaries between windows.

    Root positions are blended as vectors, rotations as rotation vectors of the turn from the later
    side to the earlier one, applied from the left: what comes out is a rotation whatever happens.
    Value at the seam is continuous; velocity too, for rotations up to second order in the offset.

    Args:
      frames: [..., F, C], metres and 6D; window k starts at frame k * window.
      window: T.
      blend_frames: N, frames after a seam that are changed, 0 to T; 0 changes nothing.
      history: the frames before window 0, [..., H, C]; with them the step into window 0 is a seam
        as well.

    Returns:
      [..., F, C], float64.

    Raises:
      ValueError: for blend_frames out of range, frames that are not finite, or a history that does not fit.
    """
    frames = np.asarray(frames, np.float64)
    shape = (*frames.shape[:-2], "frame", frames.shape[-1])
    finite_array("frames", frames, shape)
    if int(blend_frames) != blend_frames or not 0 <= blend_frames <= window:
        raise ValueError(f"blend_frames must be a whole number from 0 to {window}, the window, got {blend_frames}")
    before = frames[..., :0, :] if history is None else finite_array("history", history, shape)
    if blend_frames == 0:
        return frames.copy()
    # Time first: seams are walked one after the other, as a blended window is the next one's past.
    whole = np.moveaxis(np.concatenate([before, frames], axis=-2), -2, 0)
    root, rotation_6d = split_frames(whole)
    root, turns = root.copy(), matrix_from_rotation_6d(rotation_6d)
    start = before.shape[-2]
    for seam in range(start or window, len(whole), window):
        after = slice(seam, seam + int(blend_frames))
        for values, between, add in ((root, np.subtract, np.add), (turns, _turn_between, _turned)):
            added = _offsets(values, between, add, seam, int(blend_frames))
            values[after] = add(added[: len(values[after])], values[after])
    flat = rotation_6d_from_matrix(turns).reshape(*whole.shape[:-1], -1)
    return np.moveaxis(np.concatenate([root, flat], axis=-1)[start:], 0, -2)


def _turn_between(second, first):
    """Return the rotation vectors [..., 3] that turn rotations [..., 3, 3] into others, the second, from the left."""
    turn = second @ np.swapaxes(first, -1, -2)
    return Rotation.from_matrix(turn.reshape(-1, 3, 3)).as_rotvec().reshape(turn.shape[:-1])


def _turned(vectors, rotations):
    """Return rotations [..., 3, 3], turned by rotation vectors [..., 3] from the left."""
    vectors = np.array(np.broadcast_to(vectors, rotations.shape[:-1]))
    return Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix().reshape(rotations.shape) @ rotations


def _offsets(values, between: Callable, add: Callable, seam: int, num_frames: int) -> np.ndarray:
    """Return what has to be added to the frames after a seam, [N, ..., 3].

    Args:
      values: positions or rotations by frame; `between(second, first)` is the step from first to second, [..., 3], and
        `add(step, first)` takes it.
    """
    earlier = values[max(0, seam - 3) : seam][::-1]
    later = values[seam : seam + 3]
    steps = [[between(towards, away) for towards, away in itertools.pairwise(side)] for side in (earlier, later)]
    # A side of one frame goes on as the other does; one of two frames keeps its step.
    still = np.zeros_like(between(values[seam], values[seam]))
    toward = [own or [-other[0] if other else still] for own, other in (steps, steps[::-1])]
    (left, left_before), (right, right_before) = ((own[0], own[-1]) for own in toward)
    # Towards the seam: linear in value (equal accelerations of both sides cancel), and with its own
    # acceleration in velocity. The later side runs backwards in time.
    offset = between(add(0.5 * left, earlier[0]), add(0.5 * right, later[0]))
    velocity = (2.0 * left - left_before) + (2.0 * right - right_before)
    return dying_offset(offset, velocity, num_frames)


def blend_rollout(rollout: Rollout, blend_frames: int) -> Rollout:
    """Blend all characters of a rollout, the step from their history included.

    Args:
      rollout: as the network made it.
      blend_frames: N, 0 to the rollout's window.

    Returns:
      The rollout with blended frames; its `blend_frames` says so.

    Raises:
      ValueError: for a rollout that is blended already, or N out of range.
    """
    if rollout.blend_frames:
        raise ValueError(f"already blended over {rollout.blend_frames} frames; blend the rollout that the network made")
    frames = blend_seams(rollout.frames, rollout.window, blend_frames, history=rollout.history)
    if blend_frames == 0:
        return rollout
    frames = frames.astype(rollout.frames.dtype)
    return dataclasses.replace(rollout, frames=frames, blend_frames=int(blend_frames))
