"""The table of first metrics: rollouts of many styles beside real clips of the same styles.

No figure of motion quality means much alone. Everything that is measured on a rollout is therefore
measured on real held-out clips too, in the same way and as if they had window seams where a rollout
has them: the IRD of a real walker is a step, not zero, and "a walking person" is a set of numbers.

Dicts of measures have one number a character or clip, [B]; tables are tidy (`ground.tables`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import groupby

import numpy as np
import pandas as pd
from scipy.signal import savgol_filter

from f3amd_lib.data.features import world_frames
from f3amd_lib.data.packed import PackedMotion
from f3amd_lib.data.sources import SPLITS
from f3amd_lib.generation.blending import blend_rollout
from f3amd_lib.generation.generated import Rollout
from f3amd_lib.ground.papers import load_paper_table
from f3amd_lib.ground.tables import metric_heading
from f3amd_lib.measures.metrics import METRICS, first_metrics, foot_sliding, joint_acceleration, tidy_metrics
from f3amd_lib.motion.root_paths import RootPath, path_from_motion, tangent_yaw
from f3amd_lib.motion.rotations import matrix_from_yaw, wrap_angle
from f3amd_lib.motion.skeleton import Motion, Skeleton, contact_labels, facing_yaw

CM = 100.0

WALKING = {
    "joint_acceleration_cm": ("joint acceleration", "cm/frame^2", 1.5),
    "foot_alternation_hz": ("foot alternation", "1/s", 1.5),
    "bone_swing_deg": ("bone swing", "deg", 1.5),
    "contact_share": ("contact share", "", 2.0),
}
"""For each key of `walking_measures`: name, unit, and the factor within which a generated walker
must come to the real one, above and below, to count as a walking person (our choice)."""

_STANDING = 0.1  # m/s

_STEADY = 3
"""Frames that a foot must carry alone to count as a support phase (0.1 s at 30 fps)."""


def row_label(model: str, steps: int) -> str:
    """Return how a system is called in tables and legends: "F3AMD-FNO-96, 8 steps"."""
    return f"{model}, {steps} step{'s' if steps > 1 else ''}"


def training_clips(packed: PackedMotion, style: str) -> np.ndarray:
    """Return the clip numbers of a style's training split, or of all splits if that has none.

    Raises:
      ValueError: for an unknown style.
    """
    if style not in packed.styles:
        raise ValueError(f"unknown style {style!r}; this data has {', '.join(packed.styles)}")
    mine = np.asarray(packed.clip_style) == packed.styles.index(style)
    training = mine & (np.asarray(packed.clip_split) == SPLITS.index("train"))
    return np.flatnonzero(training if training.any() else mine)


def _speeds(packed: PackedMotion, clip: int) -> np.ndarray:
    """Ground speed of a clip's root from frame to frame, [T - 1], m/s."""
    start, stop = packed.clip_start[clip], packed.clip_start[clip + 1]
    ground = np.asarray(packed.root_position[start:stop, [0, 2]], np.float64)
    return 30.0 * np.linalg.norm(np.diff(ground, axis=0), axis=-1)


def style_pace(packed: PackedMotion, style: str) -> float:
    """Return how fast a style usually moves: median speed of its moving training frames, m/s.

    A path that asks an exhausted walker to run asks for what no data shows.

    Args:
      packed: the data set.
      style: a label of it.

    Returns:
      Metres a second, at least 0.1: slower frames count as standing.

    Raises:
      ValueError: for an unknown style.
    """
    speeds = np.concatenate([_speeds(packed, clip) for clip in training_clips(packed, style)])
    moving = speeds[speeds > _STANDING]
    return float(np.median(moving)) if len(moving) else _STANDING


def sideways_share(path: RootPath) -> float:
    """Return the share of moving frames that go more than 45 degrees off the facing, in [0, 1].

    A path that asks for sideways steps where the data has none asks for what nobody has shown.

    Args:
      path: of a target or, from `path_from_motion`, of a clip.
    """
    step = np.diff(path.position, axis=0)
    moving = np.linalg.norm(step, axis=-1) * path.fps > _STANDING
    if not moving.any():
        return 0.0
    off = wrap_angle(np.arctan2(step[:, 0], step[:, 1]) - path.yaw[:-1])
    return float(np.mean(np.abs(off[moving]) > np.pi / 4))


def facing_ahead(path: RootPath) -> RootPath:
    """Return the same line, walked facing where it goes.

    Args:
      path: any path; while it stands still it keeps the last direction.
    """
    return replace(path, yaw=tangent_yaw(path.position))


def style_floor(packed: PackedMotion, style: str) -> float:
    """Return the height of a resting toe in a style: mean over its training clips, metres.

    Args:
      packed: the data set.
      style: a label of it.

    Raises:
      ValueError: for an unknown style.
    """
    return float(np.mean(packed.floor_shift[training_clips(packed, style)]))


def own_path(motion: Motion, frames: int = 41) -> RootPath:
    """Return the line that a real motion may be said to follow: its own path without the sway.

    A root sways with every step, so that even a real walker does not follow a smooth line exactly.
    Against this line it gets the trajectory and direction error of somebody who walks well.

    Args:
      motion: any motion.
      frames: span of the local parabolas that are fitted to position and yaw; 41 is more than a
        stride. Shorter motions take what they have.

    Returns:
      The path, [T].
    """
    path = path_from_motion(motion)
    span = min(frames, path.num_frames)
    span -= 1 - span % 2  # the filter wants an odd number
    if span < 5:
        return path
    return RootPath(savgol_filter(path.position, span, 2, axis=0), savgol_filter(path.yaw, span, 2), path.fps)


def follow_clip(
    packed: PackedMotion, clip: int, *, num_history: int, num_frames: int
) -> tuple[np.ndarray, RootPath, Motion]:
    """Return what a model needs to walk where a real clip walked, and what that clip did.

    Args:
      packed: the data set.
      clip: its number.
      num_history: frames that the model is given, the clip's first.
      num_frames: frames that it is to make after them.

    Returns:
      (history, path, motion): world frames [1, num_history, C]; the clip's own line (`own_path`)
      and its motion over the frames that follow, num_frames each.

    Raises:
      ValueError: if there is no such clip, or it is too short.
    """
    whole = packed.motion(clip)
    end = num_history + num_frames
    if whole.num_frames < end:
        raise ValueError(
            f"clip {whole.name!r} has {whole.num_frames} frames, {end} are needed: ask for at most "
            f"{max(0, whole.num_frames - num_history)} frames after the history"
        )
    line = own_path(whole)
    part = slice(num_history, end)
    return (
        world_frames(whole)[None, :num_history].astype(np.float32),
        RootPath(line.position[part], line.yaw[part], line.fps),
        whole.slice(num_history, end),
    )


def reference_clips(
    packed: PackedMotion,
    styles: Sequence[str],
    *,
    window: int,
    split: str = "test",
    slowest: float = 0.4,
    fastest: float = 1.6,
) -> list[int]:
    """List the real clips that stand beside a rollout: held out, same styles, same speeds.

    Args:
      packed: the data set.
      styles: labels to take.
      window: clips that hold no boundary between windows of this many frames are left out.
      split: "test", or another.
      slowest, fastest: mean speeds to take, in units of `style_pace`; by default those between
        which `named_path("complex", speed=pace)` varies. A run would be no yardstick for a walk. A
        style with no clip in between gives the one that comes nearest.

    Returns:
      Clip numbers, by style and then in the order of the data.

    Raises:
      ValueError: for an unknown style or split, or if no clip is left.
    """
    if split not in SPLITS:
        raise ValueError(f"unknown split {split!r}: use one of {', '.join(SPLITS)}")
    held_out = np.asarray(packed.clip_split) == SPLITS.index(split)
    long_enough = np.diff(packed.clip_start) > window + 1
    clips = []
    for style in styles:
        pace = style_pace(packed, style)
        mine = np.asarray(packed.clip_style) == packed.styles.index(style)
        available = np.flatnonzero(mine & held_out & long_enough)
        ratio = np.array([_speeds(packed, clip).mean() / pace for clip in available])
        fitting = available[(slowest <= ratio) & (ratio <= fastest)]
        if len(available) and not len(fitting):
            fitting = available[[np.argmin(np.abs(ratio - 1.0))]]
        clips += fitting.tolist()
    if not clips:
        raise ValueError(
            f"data set {packed.dataset!r} has no {split} clip of {', '.join(styles)} with more than {window + 1} frames"
        )
    return clips


def _stacked(rows: list[dict]) -> dict:
    return {key: np.array([row[key] for row in rows]) for key in rows[0]}


def measure_clips(packed: PackedMotion, clips: Sequence[int], *, window: int) -> dict:
    """Measure real clips as if each were a rollout that follows its own smoothed path.

    Args:
      packed: the data set.
      clips: clip numbers, at least one.
      window: where the seams of a rollout would lie, frames.

    Returns:
      Keys of `metrics.METRICS` and of `WALKING` -> [K].
    """
    rows = []
    for clip in clips:
        motion = packed.motion(clip)
        floor = float(packed.floor_shift[clip])
        positions = np.asarray(motion.positions)
        rows.append(
            first_metrics(positions, None, own_path(motion), window, packed.skeleton, floor_shift=floor)
            | walking_measures(positions, packed.skeleton, floor_shift=floor)
        )
    return _stacked(rows)


def measure_rollout(rollout: Rollout, floor_shift) -> dict:
    """Measure every character of a rollout against the path it was given.

    Args:
      rollout: what was generated.
      floor_shift: height of a resting toe of each character's style, [B], metres.

    Returns:
      Keys of `metrics.METRICS` and of `WALKING` -> [B].
    """
    floor_shift = np.broadcast_to(np.asarray(floor_shift, np.float64), (len(rollout.styles),))
    rows = []
    for character, path in enumerate(rollout.paths):
        positions = np.asarray(rollout.motion(character).positions)
        floor = float(floor_shift[character])
        rows.append(
            first_metrics(positions, None, path, rollout.window, rollout.skeleton, floor_shift=floor)
            | walking_measures(positions, rollout.skeleton, floor_shift=floor)
        )
    return _stacked(rows)


def foot_alternation(positions, skeleton: Skeleton, fps: float = 30.0):
    """Count how often the body's weight passes from one foot to the other, per second.

    A foot carries alone while its toe rests (3D speed under 1 cm a frame) and the other's does
    not, for at least 0.1 s. A walker who takes two steps a second reads 2; one who slides, floats,
    hops on one leg or stands reads about 0.

    Args:
      positions: [..., T, J, 3], metres.
      skeleton: for the toes.
      fps: frame rate of `positions`.

    Returns:
      Passings per second, one a character.

    Source: ours.
    """
    contact = np.asarray(contact_labels(skeleton, np.asarray(positions, np.float64), fps))
    alone = contact[..., 0].astype(int) - contact[..., 1].astype(int)
    flat = alone.reshape(-1, alone.shape[-1])
    counts = []
    for sides in flat:
        runs = [(side, len(list(run))) for side, run in groupby(sides)]
        steady = np.array([side for side, length in runs if side and length >= _STEADY])
        counts.append(np.count_nonzero(np.diff(steady)))
    return (np.array(counts) * fps / flat.shape[-1]).reshape(alone.shape[:-1])[()]


def bone_swing(positions, skeleton: Skeleton):
    """Say how far bones swing about their mean direction, seen by the character itself, degrees.

    Directions are turned by the facing, so that walking a curve moves nothing. Per bone it is
    sqrt(2 (1 - R)) with R the length of the mean unit vector, the root mean square angle where that
    is small; then the mean over bones. A frozen pose reads 0, shuffled frames read as real ones do
    (their acceleration gives them away).

    Args:
      positions: [..., T, J, 3], metres.
      skeleton: J joints.

    Returns:
      Degrees, one a character.

    Source: ours.
    """
    positions = np.asarray(positions, np.float64)
    child = np.arange(1, skeleton.num_joints)
    bones = positions[..., child, :] - positions[..., np.array(skeleton.parents[1:]), :]
    length = np.linalg.norm(bones, axis=-1, keepdims=True)
    real = length.reshape(-1, len(child)).max(axis=0) > 1e-6  # two joints in one place: no bone
    turn = matrix_from_yaw(-facing_yaw(skeleton, positions))
    unit = np.einsum("...ab,...jb->...ja", turn, bones / np.maximum(length, 1e-9))
    together = np.linalg.norm(unit.mean(axis=-3), axis=-1)[..., real]
    return np.rad2deg(np.sqrt(np.maximum(2.0 * (1.0 - together), 0.0))).mean(axis=-1)


def walking_measures(positions, skeleton: Skeleton, *, floor_shift=None, fps: float = 30.0) -> dict:
    """Measure what tells a walking person from a floating, frozen or shaking one.

    Args:
      positions: [..., T, J, 3], metres.
      skeleton: J joints.
      floor_shift: see `metrics.foot_sliding`.
      fps: frame rate of `positions`.

    Returns:
      Keys of `WALKING` -> one number a character.
    """
    return {
        "joint_acceleration_cm": joint_acceleration(positions, fps=fps),
        "foot_alternation_hz": foot_alternation(positions, skeleton, fps),
        "bone_swing_deg": bone_swing(positions, skeleton),
        "contact_share": foot_sliding(positions, skeleton, floor_shift=floor_shift)[1],
    }


def quality_table(real: Mapping, measured: Mapping[tuple[str, int], Mapping]) -> pd.DataFrame:
    """Collect the first metrics of several systems, real motion first.

    Args:
      real: from `measure_clips`.
      measured: (model, steps) -> what `measure_rollout` returned.

    Returns:
      Tidy rows: label, model, steps (0 for real motion), then as from `metrics.tidy_metrics`.
    """
    rows = []
    for (model, steps), values in {("real", 0): real, **measured}.items():
        label = row_label(model, steps) if steps else "real"
        known = {key: values[key] for key in METRICS}
        rows += tidy_metrics(known, label=label, model=model, steps=steps)
    return pd.DataFrame(rows)


def walking_checks(real: Mapping, measured: Mapping[tuple[str, int], Mapping]) -> pd.DataFrame:
    """Compare walkers with real ones, measure by measure.

    Args:
      real: measures of real clips with the keys of `WALKING`.
      measured: (model, steps) -> the same of generated motion.

    Returns:
      One row per system and measure: label, measure, unit, real and value (means over characters),
      ratio, factor, within (whether the ratio lies between 1 / factor and factor).
    """
    rows = []
    for (model, steps), values in measured.items():
        for key, (name, unit, factor) in WALKING.items():
            wanted, found = float(np.mean(real[key])), float(np.mean(values[key]))
            ratio = found / wanted if wanted > 0 else float("nan")
            rows.append(
                {
                    "label": row_label(model, steps),
                    "measure": name,
                    "unit": unit,
                    "real": wanted,
                    "value": found,
                    "ratio": ratio,
                    "factor": factor,
                    "within": bool(1.0 / factor <= ratio <= factor),
                }
            )
    return pd.DataFrame(rows)


def by_place_in_window(positions, window: int, fps: float = 30.0) -> pd.DataFrame:
    """Average joint step and acceleration by the place of the newest frame in its window.

    Place 0 is the seam: its step is `metrics.ird`, its acceleration `metrics.ird_excess`. Motion
    that does not know of windows gives level lines.

    Args:
      positions: [..., T, J, 3], metres; window k starts at frame k * window.
      window: frames.
      fps: frame rate; figures are for 1/30 s.

    Returns:
      Columns place, step_cm, acceleration_cm; `window` rows.

    Raises:
      ValueError: for fewer than window + 2 frames, which would leave a place without a figure.
    """
    positions = np.asarray(positions, np.float64)
    if positions.shape[-3] < window + 2:
        raise ValueError(
            f"{positions.shape[-3]} frames do not show every place of a window of {window}; "
            f"at least {window + 2} are needed"
        )
    rate = fps / 30.0
    columns = {"place": np.arange(window)}
    for order, name in ((1, "step_cm"), (2, "acceleration_cm")):
        change = np.linalg.norm(np.diff(positions, n=order, axis=-3), axis=-1).mean(axis=-1)
        change = CM * rate**order * change.reshape(-1, change.shape[-1]).mean(axis=0)
        place = np.arange(order, positions.shape[-3]) % window
        columns[name] = np.bincount(place, change) / np.bincount(place)
    return pd.DataFrame(columns)


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
    return pd.DataFrame(
        {
            "round": np.arange(1, rounds + 1),
            "gap_m": gaps.mean(axis=0),
            "worst_gap_m": gaps.max(axis=0),
            "acceleration_cm": np.mean(accelerations, axis=0),
        }
    )


def paper_rows(models: Sequence[str] = ("F3AMD-FNO-96", "CAMDM"), *, table: int = 3, window: int = 32) -> pd.DataFrame:
    """Return printed rows of the paper with the labels that `side_by_side` wants.

    Args:
      models: names as printed.
      table: number of a quality table (3, 5, 6, 8 to 12).
      window: frames.

    Returns:
      Tidy rows of the paper's table, with `label` naming paper, model and steps.

    Raises:
      ValueError: if the table has no such row.
    """
    printed = load_paper_table(table)
    kept = printed[printed["model"].isin(models) & (printed["window_frames"] == window)]
    missing = sorted(set(models) - set(kept["model"]))
    if missing:
        raise ValueError(f"Table {table} has no row {missing[0]!r} for {window} frames")
    labels = [f"paper, {m}, {s} steps" for m, s in zip(kept["model"], kept["steps"], strict=True)]
    return kept.assign(label=labels)


def side_by_side(ours: pd.DataFrame, paper: pd.DataFrame | None = None) -> pd.DataFrame:
    """Spread a tidy table to one row a metric and one column a label, the paper's last.

    Args:
      ours: columns label, metric, unit, better, value.
      paper: from `paper_rows`; metrics that ours lacks are left out.

    Returns:
      A DataFrame: metric (with its unit), then the labels; a figure that is not there is NaN.
    """
    headings = {
        metric: metric_heading(metric, unit, better)
        for metric, unit, better in zip(ours["metric"], ours["unit"], ours["better"], strict=True)
    }
    table = pd.DataFrame({"metric": list(headings.values())})
    for part in (ours, paper):
        if part is None:
            continue
        for label, rows in part.groupby("label", sort=False):
            values = dict(zip(rows["metric"], rows["value"], strict=True))
            table[label] = [float(values.get(metric, np.nan)) for metric in headings]
    return table


def blending_table(rollout: Rollout, floor_shift, blend_frames: Sequence[int]) -> pd.DataFrame:
    """Measure a rollout as it is and blended over several numbers of frames.

    Args:
      rollout: as the network made it.
      floor_shift: as for `measure_rollout`, metres.
      blend_frames: numbers of frames; 0 is the rollout itself.

    Returns:
      A row each: blend_frames, then the means over characters of IRD and its excess (cm), step
      between any two frames (cm), joint acceleration (cm/frame^2), foot sliding and trajectory
      error (m), under the keys of `metrics.METRICS`.
    """
    keys = (
        "ird_cm",
        "ird_excess_cm",
        "inter_frame_step_cm",
        "joint_acceleration_cm",
        "foot_sliding",
        "trajectory_error_m",
    )
    rows = []
    for count in blend_frames:
        measured = measure_rollout(blend_rollout(rollout, count), floor_shift)
        rows.append({"blend_frames": count} | {key: np.nanmean(measured[key]) for key in keys})
    return pd.DataFrame(rows)
