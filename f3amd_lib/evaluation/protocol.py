"""The evaluation protocol: long rollouts of every style, repeated, beside real and broken motion.

Paper section 4.4: each model makes 2,560 frames (80 rounds of 32, or 40 of 64) on a complex path
with varied speeds, turns and directions, in every style. Here each style is walked several times
with noise and starting pose of its own, so that every figure has an interval; held-out real clips
and three deliberately bad generators are scored by the same code.

Rows are tidy: model, window_frames, steps, seed, metric, unit, better, value. A seed's figure is
the mean over styles; `summarise` turns seeds into means with 95 % intervals.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd

from f3amd_lib.data.packed import PackedMotion
from f3amd_lib.data.windows import WindowSet
from f3amd_lib.evaluation import distributions
from f3amd_lib.evaluation.classifier import StyleClassifier, require_telling_styles
from f3amd_lib.evaluation.corruptions import CORRUPTIONS, corrupt
from f3amd_lib.evaluation.denoising import noise_use
from f3amd_lib.evaluation.metrics import CAMDM_METRICS, METRICS, camdm_metrics, first_metrics
from f3amd_lib.evaluation.paths import RootPath, named_path, path_from_motion
from f3amd_lib.evaluation.quality import (
    WALKING,
    by_round,
    facing_ahead,
    own_path,
    reference_clips,
    sideways_share,
    style_floor,
    style_pace,
    training_clips,
    walking_measures,
)
from f3amd_lib.evaluation.rollout import MotionGenerator, Rollout
from f3amd_lib.motion.skeleton import Motion

__all__ = [
    "PROTOCOL_METRICS",
    "REFERENCE_MODELS",
    "Protocol",
    "evaluation_paths",
    "path_statistics",
    "measure_model",
    "measure_real",
    "summarise",
]

REFERENCE_MODELS = ("real", *CORRUPTIONS)
"""Rows that no network made: held-out clips, and the three bad generators."""

_DISTRIBUTION = {
    "FID": ("", "down"),
    "FID_per_dimension": ("", "down"),
    "CAMDM_FID": ("", "down"),
    "EMD": ("", "down"),
    "style_coverage": ("%", "up"),
    "style_accuracy": ("%", "up"),
}

_NOISE = {
    "diversity": ("cm", "near real"),
    "rollout_diversity": ("cm", "near real"),
    "x0_error_ratio": ("", "down"),
    "seed_spread": ("cm", "up"),
}

PROTOCOL_METRICS = (
    {name: (unit, better) for name, unit, better in (METRICS | CAMDM_METRICS).values()}
    | {name.replace(" ", "_"): (unit, "near real") for name, unit, _ in WALKING.values()}
    | _DISTRIBUTION
    | _NOISE
)
"""Metric -> (unit, which way is better). The paper's nine bear the names of `report.papers`."""

_KEYS = {key: name for key, (name, _, _) in (METRICS | CAMDM_METRICS).items()} | {
    key: name.replace(" ", "_") for key, (name, _, _) in WALKING.items()
}


@dataclass(frozen=True)
class Protocol:
    """How much is measured.

    Attributes:
      styles: labels that are walked and scored; the classes of the classifier.
      num_frames: length of each rollout (paper: 2,560).
      num_seeds: rollouts of each style, each with noise and starting pose of its own.
      num_diversity_seeds: samples of one fixed condition.
      num_windows: windows of 60 frames on either side of FID and EMD; the same for all rows, since
        both fall as windows are added.
      path_seed: of the complex path, the same for all.

    Raises:
      ValueError: for no style or numbers that are too small.
    """

    styles: tuple[str, ...]
    num_frames: int = 2560
    num_seeds: int = 5
    num_diversity_seeds: int = 10
    num_windows: int = 150
    path_seed: int = 0

    def __post_init__(self):
        if not self.styles:
            raise ValueError("a protocol needs at least one style")
        limits = {"num_frames": 66, "num_seeds": 1, "num_diversity_seeds": 2, "num_windows": 2}
        for name, least in limits.items():
            if getattr(self, name) < least:
                raise ValueError(f"{name} must be at least {least}, got {getattr(self, name)}")


def evaluation_paths(
    packed: PackedMotion, styles: Sequence[str], num_frames: int, *, seed: int = 0
) -> list[RootPath]:
    """Make the path that each style walks: one complex path, at the usual pace of the style.

    All get the same turns at the same times. Where the training clips hold (almost) no sideways or
    backward steps, everybody faces where the path goes: anything else would test the data.

    Args:
      packed: the data set.
      styles: labels of it.
      num_frames: length.
      seed: of the path.

    Returns:
      One path a style, each of `num_frames`.

    Raises:
      ValueError: for an unknown style.

    Source: paper section 4.4, which describes the trajectory but does not print it; ours.
    """
    paths = [
        named_path("complex", num_frames, speed=style_pace(packed, style), seed=seed)
        for style in styles
    ]
    clips = [clip for style in styles for clip in training_clips(packed, style)]
    known = np.mean([sideways_share(path_from_motion(packed.motion(clip))) for clip in clips])
    asked = np.mean([sideways_share(path) for path in paths])
    return [facing_ahead(path) for path in paths] if known < 0.02 < asked else paths


def path_statistics(paths: Iterable[RootPath], *, seconds: float = 1.0) -> dict:
    """Describe paths, or the tracks of real clips, by how they move and turn.

    Args:
      paths: any number of them.
      seconds: span over which a turn is counted, so that the sway of a stride is not.

    Returns:
      speed_m_s and its 5th and 95th percentiles, turn_deg_s (mean turn of the direction of travel)
      and its 95th percentile, sideways_share, standing_share; over all moving frames of all paths.
    """
    speeds, turns, sideways = [], [], []
    for path in paths:
        step = np.diff(path.position, axis=0) * path.fps
        speed = np.linalg.norm(step, axis=-1)
        speeds.append(speed)
        sideways.append((sideways_share(path), len(speed)))
        span = max(1, round(seconds * path.fps))
        if path.num_frames > 2 * span:
            legs = path.position[span:] - path.position[:-span]
            moved = np.linalg.norm(legs, axis=-1) > 0.1 * seconds
            heading = np.unwrap(np.arctan2(legs[:, 0], legs[:, 1]))
            turn = np.abs(heading[span:] - heading[:-span]) / seconds
            turns.append(np.rad2deg(turn[moved[span:] & moved[:-span]]))
    speeds = np.concatenate(speeds)
    turns = np.concatenate(turns) if turns else np.array([np.nan])
    moving = speeds[speeds > 0.1]
    weights = np.array([frames for _, frames in sideways], float)
    return {
        "speed_m_s": float(moving.mean()),
        "speed_p5": float(np.percentile(moving, 5)),
        "speed_p95": float(np.percentile(moving, 95)),
        "turn_deg_s": float(np.mean(turns)),
        "turn_p95": float(np.percentile(turns, 95)),
        "sideways_share": float(np.average([share for share, _ in sideways], weights=weights)),
        "standing_share": float(1.0 - len(moving) / len(speeds)),
    }


def _motion_figures(motion: Motion, path: RootPath, window: int, floor: float) -> dict:
    """Measure one motion against a path with everything that needs no classifier."""
    positions, skeleton = np.asarray(motion.positions), motion.skeleton
    values = first_metrics(positions, None, path, window, skeleton, floor_shift=floor)
    values |= camdm_metrics(positions, None, path, skeleton)
    values |= walking_measures(positions, skeleton, floor_shift=floor)
    return {_KEYS[key]: float(value) for key, value in values.items()}


def _style_means(figures: list[dict], styles: Sequence[str]) -> dict:
    """Average figures over the motions of each style, then over styles; undefined ones left out."""
    table = pd.DataFrame(figures)
    return table.groupby(np.asarray(styles)).mean().mean().to_dict()


def _distribution_figures(
    classifier: StyleClassifier, windows: np.ndarray, asked: np.ndarray, count: int, seed: int
) -> dict:
    """Score windows [N, 60, 45] of known styles [N] against the real training windows.

    FID and EMD compare `count` windows with as many real ones.
    """
    features, predicted = classifier.features(windows), classifier.predict(windows)
    reference = classifier.reference("train")
    drawn = distributions.draw_windows(features, count, seed)
    real = distributions.draw_windows(reference, count, seed + 1)
    number = len(classifier.styles)
    moments = {
        index: distributions.moments(classifier.reference("train", classifier.styles[index]))
        for index in np.unique(asked)
    }
    return {
        "FID": distributions.frechet_distance(drawn, real),
        "FID_per_dimension": distributions.frechet_distance_per_dimension(drawn, real),
        "CAMDM_FID": distributions.camdm_frechet_distance(features, asked, moments),
        "EMD": distributions.earth_movers_distance(drawn, real),
        "style_coverage": distributions.style_coverage(
            distributions.style_counts(predicted, number),
            distributions.style_counts(asked, number),
        ),
        "style_accuracy": distributions.style_accuracy(predicted, asked),
    }


def _rows(figures: dict, **columns) -> list[dict]:
    rows = []
    for name, value in figures.items():
        unit, better = PROTOCOL_METRICS[name]
        row = {"metric": name, "unit": unit, "better": better, "value": float(value)}
        rows.append({**columns, **row})
    return rows


def measure_model(
    generator: MotionGenerator,
    packed: PackedMotion,
    classifier: StyleClassifier,
    protocol: Protocol,
    held_out: WindowSet,
    *,
    name: str | None = None,
) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Run the whole protocol for one model and number of steps.

    All styles and seeds are walked in one batch; seed k takes the k-th starting pose and noise.

    Args:
      generator: the model and its sampler.
      packed: the data set it was trained on.
      classifier: for FID, EMD and coverage; its classes must hold the protocol's styles.
      protocol: how much.
      held_out: windows on which the use of noise is measured.
      name: of the model in the rows; by default the trained model's.

    Returns:
      (rows, rounds). Rows: model, window_frames, steps, seed, metric, unit, better, value. Figures
      that are not of one seed (diversity, use of noise) stand once, with seed 0. Rounds: model,
      window_frames, steps, metric, round, value.

    Raises:
      ValueError: if the classifier cannot tell styles apart, or does not know one of them.
    """
    require_telling_styles(classifier)
    trained, seeds = generator.trained, protocol.num_seeds
    columns = {
        "model": name or trained.name,
        "window_frames": trained.config.window,
        "steps": generator.num_steps,
    }
    styles = list(protocol.styles)
    paths = evaluation_paths(packed, styles, protocol.num_frames, seed=protocol.path_seed)
    floors = {style: style_floor(packed, style) for style in styles}
    rollout = generator.rollout(paths * seeds, styles * seeds, seed=protocol.path_seed)
    rows, positions = [], []
    for seed in range(seeds):
        mine = range(seed * len(styles), (seed + 1) * len(styles))
        motions = [rollout.motion(character) for character in mine]
        figures = _style_means(
            [
                _motion_figures(motion, path, rollout.window, floors[style])
                for motion, path, style in zip(motions, paths, styles, strict=True)
            ],
            styles,
        )
        positions.append(np.stack([np.asarray(motion.positions) for motion in motions]))
        windows = classifier.windows_of(positions[-1], trained.skeleton)
        asked = np.repeat([classifier.style_index(style) for style in styles], windows.shape[1])
        windows = windows.reshape(-1, *windows.shape[2:])
        figures |= _distribution_figures(classifier, windows, asked, protocol.num_windows, seed)
        rows += _rows(figures, **columns, seed=seed)
    once = noise_use(generator, held_out)
    once = {
        "x0_error_ratio": once["x0_error_ratio"],
        "seed_spread": once["seed_spread_cm"],
        "diversity": _first_round_diversity(generator, paths, styles, protocol),
    }
    if seeds > 1:
        # [style, seed, frame, joint, 3]
        once["rollout_diversity"] = distributions.diversity(np.stack(positions, axis=1))
    rows += _rows(once, **columns, seed=0)
    return pd.DataFrame(rows), _rounds(rollout, columns)


def _first_round_diversity(
    generator: MotionGenerator, paths: Sequence[RootPath], styles: Sequence[str], protocol: Protocol
) -> float:
    """Diversity of Appendix C: noise seeds under one fixed condition a style, first round."""
    window, repeats = generator.trained.config.window, protocol.num_diversity_seeds
    short = [path.slice(0, window) for path in paths]
    poses = generator.rollout(short, styles, seed=protocol.path_seed).history
    made = generator.rollout(
        [path for path in short for _ in range(repeats)],
        [style for style in styles for _ in range(repeats)],
        seed=protocol.path_seed + 1,
        history=np.repeat(poses, repeats, axis=0),
    )
    samples = np.stack([made.motion(k).positions for k in range(len(made.styles))])
    return distributions.diversity(samples.reshape(len(styles), repeats, *samples.shape[1:]))


def _rounds(rollout: Rollout, columns: dict) -> pd.DataFrame:
    """Follow a rollout round by round (claim Q16: long rollouts drift)."""
    table = by_round(rollout).melt(id_vars="round", var_name="metric")
    return table.assign(**columns)[[*columns, "metric", "round", "value"]]


def measure_real(
    packed: PackedMotion,
    classifier: StyleClassifier,
    protocol: Protocol,
    *,
    window: int,
    model: str = "real",
    split: str = "test",
) -> pd.DataFrame:
    """Score held-out clips, as they are or broken by a recipe, as if they were rollouts.

    A clip follows the smoothed path of the motion that it came from. Every seed draws the noise of
    a recipe anew, averages over clips drawn with replacement (a bootstrap, so that an interval
    tells what other clips would have given), and compares other windows in FID and EMD.

    Args:
      packed: the data set.
      classifier: as for `measure_model`.
      protocol: its styles and number of seeds.
      window: where the seams of a rollout would lie, frames.
      model: one of `REFERENCE_MODELS`.
      split: the clips' split.

    Returns:
      Rows as from `measure_model`, with steps 0; without diversity and use of noise, which real
      motion does not have.

    Raises:
      ValueError: for an unknown model, or as `measure_model`.
    """
    if model not in REFERENCE_MODELS:
        raise ValueError(f"unknown reference {model!r}: use one of {', '.join(REFERENCE_MODELS)}")
    require_telling_styles(classifier)
    clips = reference_clips(packed, protocol.styles, window=window, split=split)
    labels = np.array([packed.styles[packed.clip_style[clip]] for clip in clips])
    columns = {"model": model, "window_frames": window, "steps": 0}
    rows = []
    for seed in range(protocol.num_seeds):
        rng = np.random.default_rng([protocol.path_seed, seed])
        figures, windows, asked = [], [], []
        for clip, style in zip(clips, labels, strict=True):
            whole = packed.motion(clip)
            seen = whole
            if model != "real":
                seen = corrupt(model, whole, seed=int(rng.integers(2**31)))
            floor = float(packed.floor_shift[clip])
            figures.append(_motion_figures(seen, own_path(whole), window, floor))
            if seen.num_frames >= classifier.config.window:
                windows.append(classifier.windows_of(seen.positions, packed.skeleton))
                asked += [classifier.style_index(style)] * len(windows[-1])
        if not windows:
            raise ValueError(
                f"no {split} clip of {', '.join(protocol.styles)} holds the "
                f"{classifier.config.window} frames that the classifier looks at"
            )
        drawn = np.concatenate(
            [rng.choice(mine, len(mine)) for style in protocol.styles
             if len(mine := np.flatnonzero(labels == style))]
        )  # fmt: skip
        means = _style_means([figures[place] for place in drawn], labels[drawn])
        windows, asked = np.concatenate(windows), np.array(asked)
        means |= _distribution_figures(classifier, windows, asked, protocol.num_windows, seed)
        rows += _rows(means, **columns, seed=seed)
    return pd.DataFrame(rows)


def summarise(rows: pd.DataFrame) -> pd.DataFrame:
    """Turn figures of single seeds into means with 95 % intervals.

    Args:
      rows: from `measure_model` and `measure_real`.

    Returns:
      Columns model, window_frames, steps, metric, unit, better, value, low, high, repeats, in the
      order of the rows; a figure without repeats has NaN for bounds.
    """
    keys = ["model", "window_frames", "steps", "metric", "unit", "better"]
    out = []
    for key, group in rows.groupby(keys, sort=False):
        interval = distributions.mean_and_interval(group["value"].to_numpy())
        out.append(dict(zip(keys, key, strict=True)) | interval)
    return pd.DataFrame(out)
