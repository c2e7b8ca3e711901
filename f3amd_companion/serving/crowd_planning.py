"""Paths for a crowd whose characters keep apart.

Everybody brings a path that knows nothing of the others, such as those of `crowd.crowd_paths`. Two
who would come too close at time t* step aside: each path is bent away from the other by a smooth
bump around t*, along the line that joins them at their closest, which is square to their relative
motion. That is repeated until no two are too close at any frame. Bumps change how fast somebody
walks. Who would have to hurry or dawdle out of bounds gets the old path back, and from then on is
moved aside as a whole. Starting places of a crowd that has to be untangled are moved apart before
that, by 1.44, and again as long as it is too dense even so. So it ends: places that lie farther
apart than two paths are long need no bump at all.

Nothing is left to chance or to a proof: `keep_apart` measures every frame of what it returns.
Networks follow paths to a few centimetres, so that generated characters keep a little less distance
than their paths; `closest_approach` measures that as well.

Source: ours. The paper does not say how the characters of its Figure 1 keep apart.
"""

import numpy as np
from scipy.ndimage import convolve1d, gaussian_filter1d
from scipy.spatial import cKDTree

from f3amd_lib.ground.arrays import finite_array
from f3amd_lib.motion.root_paths import tangent_yaw
from f3amd_lib.motion.rotations import wrap_angle

FPS = 30.0
MIN_DISTANCE = 0.8
"""Metres between two roots by default: shoulders of 0.45 m and a swinging arm."""

SPEED_BOUNDS = (0.5, 1.5)
"""A bent path is walked at this share of its own greatest speed and its own speed at that frame."""

_SHAPE = ("character", "frame", 2)
_MARGIN = 0.03  # metres more than asked for, so that rounds of bumps end
_PASSING = 0.01  # metres a frame; who moves faster relative to another passes by
_HALF_WIDTH = 2.5  # seconds from the middle of a bump to its end
_ROUNDS = 60
_EVERY = 5  # frames looked at until the last rounds; two pass each other more slowly than that
_SPREADS = 1.2 ** np.arange(2, 40)  # ends at a factor of 1000
_LARGE = 256  # characters; larger crowds begin farther apart, as a round takes them seconds
_SMOOTH_TURN = 0.15  # seconds; what is turned by a bump is smoothed so far


def closest_approach(position) -> np.ndarray:
    """Return the smallest distance between any two characters at each frame.

    Args:
      position: of all roots on the ground, [B, F, 2], metres.

    Returns:
      Metres, [F]; infinite for one character.

    Raises:
      ValueError: for another shape, or a number that is not finite.
    """
    position = finite_array("position", position, _SHAPE)
    if len(position) == 1:
        return np.full(position.shape[1], np.inf)
    frames = np.moveaxis(position, 1, 0)
    return np.array([cKDTree(frame).query(frame, k=2)[0][:, 1].min() for frame in frames])


def keep_apart(position, yaw, *, min_distance: float = MIN_DISTANCE) -> tuple[np.ndarray, np.ndarray]:
    """Bend and spread paths until all characters keep a distance at every frame.

    Args:
      position: paths that know nothing of each other, [B, F, 2], metres, 30 frames a second.
      yaw: their facing, [B, F], radians; turned with the line.
      min_distance: metres between any two roots at any frame.

    Returns:
      (position [B, F, 2], yaw [B, F]), float64; the same for the same input. Every character's
      speed lies within `SPEED_BOUNDS` of its own. Paths that keep apart already come back
      unchanged.

    Raises:
      ValueError: for arrays that do not fit, a distance that is not above 0, or characters that find no
        paths however far they are spread.
    """
    position = finite_array("position", position, _SHAPE)
    yaw = finite_array("yaw", yaw, position.shape[:2])
    if not (np.isfinite(min_distance) and min_distance > 0):
        raise ValueError(f"min_distance must be above 0 metres, got {min_distance}")
    if closest_approach(position).min() >= min_distance:
        return position.copy(), yaw.copy()
    start = position[:, 0]
    middle = 0.5 * (start.min(axis=0) + start.max(axis=0))
    places, walked = start - middle, position - position[:, :1]
    for spread in _SPREADS[2 if len(position) > _LARGE else 0 :]:
        wanted = middle + spread * places[:, None] + walked
        bent = _untangle(wanted, min_distance)
        if bent is not None:
            return bent, _turned(wanted, bent, yaw)
    what = f"{len(position)} characters found no paths {min_distance:g} m apart"
    raise ValueError(f"{what} however far they were spread; do some of them start in the same place?")


def _untangle(wanted: np.ndarray, min_distance: float) -> np.ndarray | None:
    """Bend paths until they keep apart at every frame and speeds fit; None if that does not end."""
    bent = wanted.copy()
    as_a_whole = np.zeros(len(wanted), bool)
    half = max(2, round(_HALF_WIDTH * FPS))
    bump = np.cos(0.5 * np.pi * np.arange(-half, half + 1) / (half + 1)) ** 2
    for _ in range(_ROUNDS):
        pairs, frames = _conflicts(bent, min_distance, _EVERY)
        if not len(pairs):
            pairs, frames = _conflicts(bent, min_distance)
        if not len(pairs):
            outside = ~_speeds_fit(wanted, bent) & ~as_a_whole
            if not outside.any():
                return bent
            bent[outside] = wanted[outside]
            as_a_whole |= outside
            continue
        one, other = pairs.T
        push = 0.6 * _ways_aside(bent, one, other, frames, min_distance + _MARGIN)
        pushes = np.zeros_like(bent)
        np.add.at(pushes, (one, frames), push)
        np.add.at(pushes, (other, frames), -push)
        smooth = convolve1d(pushes, bump, axis=1, mode="constant")
        whole = np.broadcast_to(pushes.sum(axis=1, keepdims=True), pushes.shape)
        bent = bent + np.where(as_a_whole[:, None, None], whole, smooth)
    return None


def _ways_aside(position: np.ndarray, one, other, frames, distance: float) -> np.ndarray:
    """Return what the first of each pair should move, relative to the second, [K, 2].

    Those who pass each other move square to their relative motion, to the side on which they are
    already, and to the left if they would meet head on. Those who stand, walk side by side, or are
    closest at the first or last frame move straight apart.
    """
    last = position.shape[1] - 1
    before, after = np.maximum(frames - 1, 0), np.minimum(frames + 1, last)
    gap = position[one] - position[other]
    pair = np.arange(len(one))
    apart = gap[pair, frames]
    motion = gap[pair, after] - gap[pair, before]
    speed = np.linalg.norm(motion, axis=-1)
    left = np.stack([motion[:, 1], -motion[:, 0]], axis=-1) / np.maximum(speed, 1e-12)[:, None]
    aside = np.sum(apart * left, axis=-1)
    passing = (speed > _PASSING * (after - before)) & (frames > 0) & (frames < last)
    side = np.where(passing, np.abs(aside), np.linalg.norm(apart, axis=-1))
    length = np.maximum(np.linalg.norm(apart, axis=-1, keepdims=True), 1e-12)
    straight = np.where(length > 1e-6, apart / length, np.where(speed[:, None] > 0, left, [1.0, 0.0]))
    way = np.where(passing[:, None], np.where(aside < 0, -1.0, 1.0)[:, None] * left, straight)
    return np.maximum(distance - side, 0.0)[:, None] * way


def _conflicts(position: np.ndarray, min_distance: float, every: int = 1):
    """List pairs that come too close, each at its own closest frame.

    Returns:
      (pairs [K, 2], frames [K]).
    """
    count, num_frames = position.shape[:2]
    looked_at = np.arange(0, num_frames, every)
    # One tree for all frames: a third coordinate holds them too far apart to meet.
    height = np.broadcast_to(2.0 * min_distance * looked_at[None, :], (count, len(looked_at)))
    points = np.concatenate([position[:, looked_at], height[..., None]], axis=-1)
    tree = cKDTree(points.reshape(-1, 3), balanced_tree=False, compact_nodes=False)
    close = tree.query_pairs(min_distance, output_type="ndarray")
    one, other = np.sort(close // len(looked_at), axis=1).T
    frames = looked_at[close[:, 0] % len(looked_at)]
    distances = np.linalg.norm(position[one, frames] - position[other, frames], axis=-1)
    # The closest frame of each pair: sort by pair, then distance, then keep the first.
    order = np.lexsort((frames, distances, other, one))
    key = (one * count + other)[order]
    first = order[np.diff(key, prepend=-1) > 0]
    return np.column_stack([one, other])[first], frames[first]


def _speeds_fit(wanted: np.ndarray, bent: np.ndarray) -> np.ndarray:
    """Tell whose bent path is walked within `SPEED_BOUNDS` of the speeds that were wanted, [B]."""
    asked = FPS * np.linalg.norm(np.diff(wanted, axis=1), axis=-1)
    walked = FPS * np.linalg.norm(np.diff(bent, axis=1), axis=-1)
    slowest, fastest = SPEED_BOUNDS
    greatest = asked.max(axis=1, keepdims=True, initial=0.0)
    tolerance = 1e-9
    slow = (walked < slowest * asked - tolerance).any(axis=1)
    return ~(slow | (walked > fastest * greatest + tolerance).any(axis=1))


def _turned(wanted: np.ndarray, bent: np.ndarray, yaw: np.ndarray) -> np.ndarray:
    """Turn the facing as the line was turned; paths that were not bent keep theirs."""
    turned = yaw.copy()
    for character in np.flatnonzero((wanted != bent).any(axis=(1, 2))):
        change = tangent_yaw(bent[character]) - tangent_yaw(wanted[character])
        change = np.unwrap(wrap_angle(change))
        turned[character] += gaussian_filter1d(change, _SMOOTH_TURN * FPS, mode="nearest")
    return turned
