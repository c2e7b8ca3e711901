"""Tables of walks as notebooks show them: held against real motion, inside a window, blended, and their paths."""

from collections.abc import Iterable, Mapping, Sequence

import numpy as np
import pandas as pd
from f3amd_lib.data.packed import PackedMotion
from f3amd_lib.ground.names import row_label
from f3amd_lib.measures.real_clips import STANDING, clip_floors, motion_figures, own_path, sideways_share
from f3amd_lib.measures.registry import METRICS
from f3amd_lib.measures.walking import CHECKS, walking_figures
from f3amd_lib.motion.root_paths import RootPath
from f3amd_lib.motion.rotations import wrap_angle
from f3amd_lib.motion.skeleton import Motion
from f3amd_lib.rollout.blending import blend_rollout
from f3amd_lib.rollout.generated import Rollout

FACTORS = {"joint_acceleration": 1.5, "foot_alternation": 1.5, "bone_swing": 1.5, "contact_share": 2.0}
"""Metric -> the factor within which a generated walker must come to the real one, above and below,
to count as a walking person (our choice)."""


def measure_clips(packed: PackedMotion, clips: Sequence[int], *, window: int) -> pd.DataFrame:
    """Measure real clips as if each were a rollout that follows its own smoothed path.

    Args:
      packed: the data set.
      clips: clip numbers, at least one.
      window: where the seams of a rollout would lie, frames.

    Returns:
      A row a clip, with the columns of `motion_figures`.
    """
    motions = zip(map(packed.motion, clips), clip_floors(packed, clips), strict=True)
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


def walking_checks(real: Mapping, measured: Mapping[tuple[str, int], Mapping]) -> pd.DataFrame:
    """Compare walkers with real ones, measure by measure.

    Args:
      real: keys of `walking_measures` -> figures of real clips.
      measured: (model, steps) -> the same of generated motion.

    Returns:
      One row per system and measure: label, measure, unit, real and value (means over characters),
      ratio, factor, within (whether the ratio lies between 1 / factor and factor).
    """
    rows = []
    for (model, steps), values in measured.items():
        for name, factor in FACTORS.items():
            metric = METRICS[name]
            wanted, value = (float(np.mean(np.asarray(side[metric.key]))) for side in (real, values))
            ratio = value / wanted if wanted > 0 else float("nan")
            row = {"label": row_label(model, steps), "measure": metric.heading, "unit": metric.unit}
            row |= {"real": wanted, "value": value, "ratio": ratio, "factor": factor}
            rows.append(row | {"within": bool(1.0 / factor <= ratio <= factor)})
    return pd.DataFrame(rows)


def check_walks(
    walks: Mapping[str, Motion], sources: Mapping[str, Motion], window: int, floors: Mapping = {}
) -> pd.DataFrame:
    """Hold generated walks against the motion that they were learnt from, style by style.

    Args:
      walks: style -> generated motion.
      sources: style -> motion of the source, best along the same path.
      window: frames.
      floors: style -> height of the floor, metres; 0 where a style is not named.

    Returns:
      One row per style and check: style, check, unit, source, value, wanted, holds.
    """
    rows = []
    for style, motion in walks.items():
        if style not in sources:
            raise ValueError(f"no source motion of style {style!r} to hold the walk against")
        floor = float(floors.get(style, 0.0))
        figures, source = walking_figures(motion, window, floor), walking_figures(sources[style], window, floor)
        for name, (wanted, holds) in CHECKS.items():
            row = {"style": style, "check": METRICS[name].heading, "unit": METRICS[name].shown_unit}
            row |= {"source": source[name], "value": figures[name], "wanted": wanted}
            rows.append(row | {"holds": bool(holds(figures[name], source[name]))})
    return pd.DataFrame(rows)


def steps_by_frame_in_window(positions, window: int) -> pd.DataFrame:
    """Average joint step and acceleration by the place of the newest frame in its window.

    Place 0 is the seam: its step is `metrics.ird`, its acceleration `metrics.ird_excess`. Motion
    that does not know of windows gives level lines.

    Args:
      positions: [..., T, J, 3], metres, at 30 fps; window k starts at frame k * window.
      window: frames.

    Returns:
      Columns place, step_cm, acceleration_cm; `window` rows.

    Raises:
      ValueError: for fewer than window + 2 frames, which would leave a place without a figure.
    """
    positions = np.asarray(positions, np.float64)
    if positions.shape[-3] < window + 2:
        raise ValueError(f"{positions.shape[-3]} frames do not show every place of a window; at least {window + 2} do")
    columns = {"place": np.arange(window)}
    for order, name in ((1, "step_cm"), (2, "acceleration_cm")):
        change = np.linalg.norm(np.diff(positions, n=order, axis=-3), axis=-1).mean(axis=-1)
        change = 100.0 * change.reshape(-1, change.shape[-1]).mean(axis=0)
        place = np.arange(order, positions.shape[-3]) % window
        columns[name] = np.bincount(place, change) / np.bincount(place)
    return pd.DataFrame(columns)


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


def path_statistics(paths: Iterable[RootPath]) -> dict:
    """Describe paths, or the tracks of real clips, by how they move and turn.

    Args:
      paths: any number of them.

    Returns:
      speed_m_s and its 5th and 95th percentiles, turn_deg_s (mean turn of the direction of travel,
      counted over a second, so that the sway of a stride is not) and its 95th percentile,
      sideways_share, standing_share; over all moving frames of all paths.
    """
    speeds, turns, shares = [], [], []
    for path in paths:
        speeds.append(np.linalg.norm(np.diff(path.position, axis=0) * path.fps, axis=-1))
        shares.append(sideways_share(path))
        span = round(path.fps)
        legs = path.position[span:] - path.position[:-span]
        moved = np.linalg.norm(legs, axis=-1) > STANDING
        heading = np.arctan2(legs[:, 0], legs[:, 1])
        turned = np.rad2deg(np.abs(wrap_angle(heading[span:] - heading[:-span])))
        turns.append(turned[moved[span:] & moved[:-span]])
    weights = [np.sum(speed > STANDING) for speed in speeds]
    sideways = np.average(shares, weights=weights) if any(weights) else np.nan
    speeds, turns = np.concatenate(speeds), np.concatenate(turns)
    moving = speeds[speeds > STANDING]
    figures = {"speed_m_s": moving.mean(), "speed_p5": np.percentile(moving, 5), "speed_p95": np.percentile(moving, 95)}
    figures |= {"turn_deg_s": turns.mean(), "turn_p95": np.percentile(turns, 95)}
    figures |= {"sideways_share": sideways, "standing_share": 1.0 - len(moving) / len(speeds)}
    return {name: float(value) for name, value in figures.items()}
