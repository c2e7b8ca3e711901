"""Real clips beside rollouts: which ones, how fast they walk, where their floor lies; both measured alike.

No figure of motion quality means much alone. Everything that is measured on a rollout is therefore
measured on real held-out clips too, in the same way and as if they had window seams where a rollout
has them: the IRD of a real walker is a step, not zero, and "a walking person" is a set of numbers.
"""

import functools
from collections.abc import Sequence

import numpy as np
import pandas as pd

from f3amd_lib.data.packed import PackedMotion
from f3amd_lib.data.sources import SPLITS
from f3amd_lib.ground.names import check_known
from f3amd_lib.measures.metrics import first_metrics, joint_acceleration
from f3amd_lib.measures.walking import walking_measures
from f3amd_lib.motion.root_paths import RootPath, path_from_motion
from f3amd_lib.motion.rotations import wrap_angle
from f3amd_lib.motion.skeleton import Motion
from f3amd_lib.rollout.generated import Rollout

STANDING = 0.1
"""Metres a second up to which somebody stands."""

_SPEEDS = (0.4, 1.6)
"""Mean speeds of `reference_clips` in units of `style_pace`: those between which `named_path("complex", speed=pace)`
varies. A run would be no yardstick for a walk."""


def training_clips(packed: PackedMotion, style: str) -> np.ndarray:
    """Return the clip numbers of a style's training split, or of all splits if that has none.

    Raises:
      ValueError: for an unknown style.
    """
    check_known(style, packed.styles, f"style of data set {packed.name!r}:")
    of_style = np.asarray(packed.clip_style) == packed.styles.index(style)
    training = of_style & (np.asarray(packed.clip_split) == SPLITS.index("train"))
    return np.flatnonzero(training if training.any() else of_style)


def _speeds(packed: PackedMotion, clip: int) -> np.ndarray:
    """Ground speed of a clip's root from frame to frame, [T - 1], m/s."""
    start, stop = packed.clip_start[clip], packed.clip_start[clip + 1]
    ground = np.asarray(packed.root_position[start:stop, [0, 2]], np.float64)
    return 30.0 * np.linalg.norm(np.diff(ground, axis=0), axis=-1)


def style_pace(packed: PackedMotion, style: str) -> float:
    """Return how fast a style usually moves: median speed of its moving training frames, m/s.

    A path should not make an exhausted walker run, which no data shows.

    Returns:
      Metres a second, at least 0.1: slower frames count as standing.

    Raises:
      ValueError: for an unknown style.
    """
    speeds = np.concatenate([_speeds(packed, clip) for clip in training_clips(packed, style)])
    moving = speeds[speeds > STANDING]
    return float(np.median(moving)) if len(moving) else STANDING


def style_floor(packed: PackedMotion, style: str) -> float:
    """Return the height of a resting toe in a style: mean over its training clips, metres; unknown: ValueError."""
    return float(np.mean(packed.floor_shift[training_clips(packed, style)]))


def clip_floors(packed: PackedMotion, clips) -> list[float]:
    """Return the `style_floor` of each clip's style, as rollouts in that style are measured."""
    floor_of = functools.cache(functools.partial(style_floor, packed))
    return [floor_of(packed.styles[packed.clip_style[clip]]) for clip in clips]


def sideways_share(path: RootPath) -> float:
    """Return the share of moving frames that go more than 45 degrees off the facing, in [0, 1].

    A path should not need sideways steps where the data has none.

    Args:
      path: of a target or, from `path_from_motion`, of a clip.
    """
    step = np.diff(path.position, axis=0)
    moving = np.linalg.norm(step, axis=-1) * path.fps > STANDING
    off = wrap_angle(np.arctan2(step[:, 0], step[:, 1]) - path.yaw[:-1])
    return float(np.mean(np.abs(off[moving]) > np.pi / 4)) if moving.any() else 0.0


def own_path(motion: Motion, frames: int = 41) -> RootPath:
    """Return the line that a real motion may be said to follow: its own path without the sway.

    A root sways with every step, so that even a real walker does not follow a smooth line exactly.
    Against this line it gets the trajectory and direction error of somebody who walks well.

    Args:
      frames: span of the local parabolas that are fitted to position and yaw; 41 is more than a
        stride. Shorter motions take what they have.
    """
    from scipy.signal import savgol_filter  # here: half a second that few callers need

    path = path_from_motion(motion)
    span = (min(frames, path.num_frames) - 1) // 2 * 2 + 1  # the filter wants an odd number
    if span < 5:
        return path
    return RootPath(savgol_filter(path.position, span, 2, axis=0), savgol_filter(path.yaw, span, 2), path.fps)


def reference_clips(packed: PackedMotion, styles: Sequence[str], *, window: int, split: str = "test") -> list[int]:
    """List the real clips to compare with a rollout: held out, same styles, same speeds.

    Args:
      packed: the data set.
      styles: labels to take.
      window: clips that hold no boundary between windows of this many frames are left out.
      split: "test", or another.

    Returns:
      Clip numbers, by style and then in the order of the data. A style with no clip of such speeds
      (`_SPEEDS`) gives the one that comes nearest.

    Raises:
      ValueError: for an unknown style or split, or if no clip is left.
    """
    check_known(split, SPLITS, "split")
    held_out = np.asarray(packed.clip_split) == SPLITS.index(split)
    long_enough = np.diff(packed.clip_start) > window + 1
    clips = []
    for style in styles:
        pace = style_pace(packed, style)
        of_style = np.asarray(packed.clip_style) == packed.styles.index(style)
        available = np.flatnonzero(of_style & held_out & long_enough)
        ratio = np.array([_speeds(packed, clip).mean() / pace for clip in available])
        fitting = available[(_SPEEDS[0] <= ratio) & (ratio <= _SPEEDS[1])]
        if len(available) and not len(fitting):
            fitting = available[[np.argmin(np.abs(ratio - 1.0))]]
        clips += fitting.tolist()
    if not clips:
        raise ValueError(
            f"data set {packed.name!r} has no {split} clip of {', '.join(styles)} with more than {window + 1} frames"
        )
    return clips


# ------------------------------------------------------------------- measured alike: clips and rollouts


def motion_figures(motion: Motion, path: RootPath, window: int, floor: float) -> dict[str, float]:
    """Measure one motion against a path: `metrics.first_metrics` and `walking.walking_measures`."""
    positions, skeleton = np.asarray(motion.positions), motion.skeleton
    return first_metrics(positions, path, window, skeleton, floor_shift=floor) | walking_measures(
        positions, skeleton, floor_shift=floor
    )


def by_round(rollout: Rollout) -> pd.DataFrame:
    """Follow a rollout round by round: does it lose the path, does it fall apart?

    Args:
      rollout: what was generated; an unfinished last round is left out.

    Returns:
      Columns round (1, 2, ...), gap_m and worst_gap_m (distance of root and target on the ground
      at the end of the round, mean and largest over characters), acceleration_cm (mean joint
      acceleration in the round, cm per frame squared).
    """
    window = rollout.window
    rounds = rollout.frames.shape[1] // window
    gaps, accelerations = [], []
    for character, path in enumerate(rollout.paths):
        positions = np.asarray(rollout.motion(character).positions)[: rounds * window]
        gap = np.linalg.norm(positions[:, 0, [0, 2]] - path.position[: rounds * window], axis=-1)
        gaps.append(gap[window - 1 :: window])
        each = positions.reshape(rounds, window, *positions.shape[1:])
        accelerations.append(joint_acceleration(each))
    gaps = np.stack(gaps)
    table = {"round": np.arange(1, rounds + 1), "gap_m": gaps.mean(axis=0), "worst_gap_m": gaps.max(axis=0)}
    return pd.DataFrame(table | {"acceleration_cm": np.mean(accelerations, axis=0)})
