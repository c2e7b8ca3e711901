"""The figures of rollouts and of real clips, measured alike: a row a character, and round by round."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd

from f3amd_lib.data.packed import PackedMotion
from f3amd_lib.measures.metrics import first_metrics, joint_acceleration
from f3amd_lib.measures.real_clips import own_path
from f3amd_lib.measures.walking import walking_measures
from f3amd_lib.motion.root_paths import RootPath
from f3amd_lib.motion.skeleton import Motion
from f3amd_lib.rollout.blending import blend_rollout
from f3amd_lib.rollout.generated import Rollout


def motion_figures(motion: Motion, path: RootPath, window: int, floor: float) -> dict[str, float]:
    """Measure one motion against a path: `metrics.first_metrics` and `walking.walking_measures`."""
    positions, skeleton = np.asarray(motion.positions), motion.skeleton
    return first_metrics(positions, path, window, skeleton, floor_shift=floor) | walking_measures(
        positions, skeleton, floor_shift=floor
    )


def measure_clips(packed: PackedMotion, clips: Sequence[int], *, window: int) -> pd.DataFrame:
    """Measure real clips as if each were a rollout that follows its own smoothed path.

    Args:
      packed: the data set.
      clips: clip numbers, at least one.
      window: where the seams of a rollout would lie, frames.

    Returns:
      A row a clip, with the columns of `motion_figures`.
    """
    motions = [(packed.motion(clip), float(packed.floor_shift[clip])) for clip in clips]
    return pd.DataFrame([motion_figures(motion, own_path(motion), window, floor) for motion, floor in motions])


def measure_rollout(rollout: Rollout, floor_shift) -> pd.DataFrame:
    """Measure every character of a rollout against the path it was given.

    Args:
      rollout: what was generated.
      floor_shift: height of a resting toe of each character's style, [B], metres.

    Returns:
      A row a character, with the columns of `motion_figures`.
    """
    floors = np.broadcast_to(np.asarray(floor_shift, np.float64), (len(rollout.styles),))
    walks = [(rollout.motion(place), path, float(floors[place])) for place, path in enumerate(rollout.paths)]
    return pd.DataFrame([motion_figures(motion, path, rollout.window, floor) for motion, path, floor in walks])


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


def blending_table(rollout: Rollout, floor_shift, blend_frames: Sequence[int]) -> pd.DataFrame:
    """Measure a rollout as it is and blended over several numbers of frames.

    Args:
      rollout: as the network made it.
      floor_shift: as for `measure_rollout`, metres.
      blend_frames: numbers of frames; 0 is the rollout itself.

    Returns:
      A row each: blend_frames, then the means over characters of IRD and its excess (cm), step
      between any two frames (cm), joint acceleration (cm/frame^2), foot sliding and trajectory
      error (m), under their keys (`registry.Metric.key`).
    """
    keys = "ird_cm ird_excess_cm inter_frame_step_cm joint_acceleration_cm foot_sliding trajectory_error_m".split()
    rows = []
    for count in blend_frames:
        measured = measure_rollout(blend_rollout(rollout, count), floor_shift)
        rows.append({"blend_frames": count} | {key: np.nanmean(measured[key]) for key in keys})
    return pd.DataFrame(rows)
