"""The evaluation protocol: long rollouts of every style, repeated, beside real and broken motion.

Paper section 4.4: each model makes 2,560 frames (80 rounds of 32, or 40 of 64) on a complex path
with varied speeds, turns and directions, in every style. Here that is repeated over seeds, each
with a path, noise and starting poses of its own; held-out real clips and three deliberately bad
generators are scored by the same code.

Rows are tidy: model, window_frames, steps, varies, seed, metric, unit, better, value. A row's value
is a mean over styles. `varies` says what the repeats differ in: "seed" for models, "clips" for real
motion, where every repeat takes another half of the clips. `summarise` turns repeats into means
with 95 % intervals. One training of each model is behind its rows: what another training would have
given is not in the interval.

FID, EMD and coverage see posture and style through one classifier. They say little of whether
somebody walks or glides: read them beside changes of the planted foot, acceleration and contact.
"""

import dataclasses
import functools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Self

import numpy as np
import pandas as pd

from f3amd_lib.data.packed import PackedMotion
from f3amd_lib.data.sources import SPLITS
from f3amd_lib.data.windows import WindowSet
from f3amd_lib.ground.names import check_known
from f3amd_lib.measures import distributions, real_clips
from f3amd_lib.measures.classifier import StyleClassifier, require_telling_styles
from f3amd_lib.measures.corruptions import CORRUPTIONS, corrupt
from f3amd_lib.measures.denoising import noise_use
from f3amd_lib.measures.metrics import camdm_metrics
from f3amd_lib.measures.real_clips import by_round, motion_figures
from f3amd_lib.measures.registry import BY_KEY, METRICS
from f3amd_lib.motion.root_paths import RootPath, named_path, path_from_motion, tangent_yaw
from f3amd_lib.motion.skeleton import Motion
from f3amd_lib.rollout.rollout import MotionGenerator, Rollout

REFERENCE_MODELS = ("real", *CORRUPTIONS)
"""Rows that no network made: held-out clips, and the three bad generators."""

_DIVERSITY_ROUNDS = 4
"""Rounds after which samples of one start are compared once more (`rollout_diversity`)."""

_GROWS_WITH_LENGTH = ("path_drift", "CAMDM_trajectory_error", "CAMDM_orientation_error")
"""Figures whose size hangs on the length of a motion: no yardstick between clips and rollouts."""


@dataclass(frozen=True)
class Protocol:
    """How much is measured.

    Attributes:
      styles: labels that are walked and scored; the classes of the classifier.
      num_frames: length of each rollout (paper: 2,560).
      num_seeds: rollouts of each style, each with noise and starting pose of its own.
      num_diversity_seeds: samples of one fixed condition.
      windows_per_style: windows of 60 frames of each style on either side of FID and EMD; the same
        for all rows, since both fall as windows are added (see `windows_that_fit`).
      path_seed: seed k walks the complex path of seed path_seed + k.
    """

    styles: tuple[str, ...]
    num_frames: int = 2560
    num_seeds: int = 5
    num_diversity_seeds: int = 10
    windows_per_style: int = 12
    path_seed: int = 0

    def __post_init__(self):
        # What is scored is spread over styles and seeds; fewer would leave intervals and distances without meaning.
        least = {"styles": 1, "num_seeds": 1, "num_diversity_seeds": 2, "windows_per_style": 1 + (len(self.styles) < 2)}
        for name, number in (dataclasses.asdict(self) | {"styles": len(self.styles)}).items():
            if number < least.get(name, 0):
                raise ValueError(f"{name} must be at least {least[name]}, got {number}")


def evaluation_paths(packed: PackedMotion, styles: Sequence[str], num_frames: int, *, seed: int = 0) -> list[RootPath]:
    """Make the path that each style walks: one complex path, at the usual pace of the style.

    All get the same turns at the same times. Where the training clips hold (almost) no sideways or
    backward steps, everybody faces where the path goes: anything else would test the data. An unknown style is a
    ValueError.

    Source: paper section 4.4, which describes the trajectory but does not print it; ours.
    """
    paths = [
        named_path("complex", num_frames, speed=real_clips.style_pace(packed, style), seed=seed) for style in styles
    ]
    known = _sideways_in_training(packed, tuple(styles))
    asked = np.mean([real_clips.sideways_share(path) for path in paths])
    if known < 0.02 < asked:
        paths = [dataclasses.replace(path, yaw=tangent_yaw(path.position)) for path in paths]
    return paths


@functools.lru_cache(maxsize=8)
def _sideways_in_training(packed: PackedMotion, styles: tuple[str, ...]) -> float:
    """Return the share of sideways steps in the training clips; every seed's paths ask for it."""
    clips = [clip for style in styles for clip in real_clips.training_clips(packed, style)]
    return float(np.mean([real_clips.sideways_share(path_from_motion(packed.motion(clip))) for clip in clips]))


def _figures_without_classifier(motion: Motion, path: RootPath, window: int, floor: float) -> dict[str, float]:
    """Measure one motion against a path; the names are those of records."""
    figures = motion_figures(motion, path, window, floor)
    figures |= camdm_metrics(np.asarray(motion.positions), path, motion.skeleton)
    return {BY_KEY[key].name: float(value) for key, value in figures.items()}


def _style_means(figures: list[dict], styles: Sequence[str]) -> dict:
    """Average figures over the motions of each style, then over styles; undefined ones left out."""
    return pd.DataFrame(figures).groupby(np.asarray(styles)).mean().mean().to_dict()


class ClassifiedWindows(NamedTuple):
    """What the classifier says of the windows of some motions.

    Attributes:
      features: [N, D].
      predicted: class of each window, [N].
      style: wanted class, [N].
      source: number of the motion that a window was cut from, [N].
    """

    features: np.ndarray
    predicted: np.ndarray
    style: np.ndarray
    source: np.ndarray

    def of(self, sources: Iterable[int]) -> Self:
        """Return the windows of some of the motions, motion by motion in that order."""
        order = np.concatenate([np.flatnonzero(self.source == source) for source in sources])
        return ClassifiedWindows(*(part[order] for part in self))


def classify_windows(
    classifier: StyleClassifier, motions: Sequence[Motion], styles: Sequence[str]
) -> ClassifiedWindows:
    """Cut motions into the classifier's windows and classify them; one that is shorter holds none.

    Args:
      classifier: whose features and classes are wanted.
      motions: of the classifier's skeleton.
      styles: the wanted style of each.

    Raises:
      ValueError: if no motion is long enough, or for an unknown style.
    """
    windows = {
        number: classifier.windows_of(motion.positions, motion.skeleton)
        for number, motion in enumerate(motions)
        if motion.num_frames >= classifier.config.window
    }
    if not windows:
        raise ValueError(f"no motion has the {classifier.config.window} frames that the style classifier looks at")
    features, predicted = classifier.features_and_classes(np.concatenate(list(windows.values())))
    source = np.repeat(list(windows), [len(cut) for cut in windows.values()])
    asked = np.array([classifier.style_index(style) for style in styles])
    return ClassifiedWindows(features, predicted, asked[source], source)


def real_features(
    packed: PackedMotion, classifier: StyleClassifier, styles: Sequence[str], window: int
) -> dict[int, np.ndarray]:
    """Return features of real training windows by class, at the speeds that are asked for.

    Args:
      packed: the data set.
      classifier: holds the features.
      styles: labels of it.
      window: see `real_clips.reference_clips`.

    Returns:
      Class number -> [N, D], in the order of `styles`.
    """
    clips = real_clips.reference_clips(packed, styles, window=window, split="train")
    known = classifier.references["train"]
    wanted = np.isin(known.clips, clips)
    return {number: known.features[wanted & (known.styles == number)] for number in map(classifier.style_index, styles)}


def windows_that_fit(packed: PackedMotion, classifier: StyleClassifier, protocol: Protocol, *, window: int) -> int:
    """Return how many windows of each style every row of a table can have in FID and EMD.

    Args:
      packed: the data set.
      classifier: cuts windows and holds those of the training clips.
      protocol: its styles and length; at most its `windows_per_style` is returned.
      window: frames of a round.

    Returns:
      The smallest number, over styles, of windows in the training clips, in half of the held-out
      clips and in one rollout.

    Raises:
      ValueError: if some style has none.
    """
    span = classifier.config.window
    counts = [protocol.windows_per_style, protocol.num_frames // span]
    real = real_features(packed, classifier, protocol.styles, window)
    counts += [len(features) for features in real.values()]
    clips, labels = held_out_clips(packed, protocol.styles, window)
    lengths = np.diff(packed.clip_start)[clips] // span
    counts += [int(lengths[labels == style].sum()) // 2 for style in protocol.styles]
    if min(counts) < 1:
        raise ValueError(
            f"some style has no window of {span} frames for FID and EMD: make longer rollouts, take more data"
        )
    return min(counts)


def held_out_clips(packed: PackedMotion, styles: Sequence[str], window: int) -> tuple[np.ndarray, np.ndarray]:
    """Return clips of both held-out splits at the speeds that are asked for, and their styles."""
    splits = [split for split in ("test", "validation") if SPLITS.index(split) in np.asarray(packed.clip_split)]
    clips = sum((real_clips.reference_clips(packed, styles, window=window, split=split) for split in splits), [])
    return np.array(clips), np.array([packed.styles[packed.clip_style[clip]] for clip in clips])


def distribution_figures(
    seen: ClassifiedWindows, real: Mapping[int, np.ndarray], count: int, rng: np.random.Generator
) -> dict[str, float]:
    """Score windows against real ones of the same styles, `count` of each style on either side."""
    drawn, wanted, by_style = [], [], []
    for number, reference in real.items():
        of_style = seen.features[seen.style == number]
        for cloud, part in ((of_style, drawn), (reference, wanted)):
            part.append(distributions.draw_per_style({number: cloud}, count, rng))
        if len(of_style) > 1 and len(reference) > 1:
            by_style.append(distributions.frechet_distance_per_dimension(of_style, reference))
    features, reference = np.concatenate(drawn), np.concatenate(wanted)
    distance = distributions.frechet_distance(features, reference)
    counts = [np.bincount(styles, minlength=max(real) + 1)[list(real)] for styles in (seen.predicted, seen.style)]
    return {
        "FID": distance,
        "FID_per_dimension": distance / features.shape[1],
        # The mean over styles of CAMDM's code, with all windows of the motion.
        "CAMDM_FID": float(np.mean(by_style)) if len(by_style) == len(real) else float("nan"),
        "EMD": distributions.earth_movers_distance(features, reference),
        "style_coverage": distributions.style_coverage(*counts),
        "style_accuracy": distributions.style_accuracy(seen.predicted, seen.style),
    }


def _rows(figures: Mapping[str, float], **columns) -> list[dict]:
    """Give each figure a row with its unit and which way is better."""
    return [
        {**columns, "metric": name, "unit": METRICS[name].unit, "better": METRICS[name].better, "value": float(value)}
        for name, value in figures.items()
    ]


def walk_protocol(generator: MotionGenerator, packed: PackedMotion, protocol: Protocol) -> Rollout:
    """Walk every style with every seed of a protocol in one batch, seed after seed.

    Seeds differ in path, noise and, as far as there are enough stored ones, starting pose.
    """
    seeds, styles = range(protocol.num_seeds), list(protocol.styles)
    walks = [evaluation_paths(packed, styles, protocol.num_frames, seed=protocol.path_seed + seed) for seed in seeds]
    return generator.rollout(sum(walks, []), styles * len(seeds), seed=protocol.path_seed)


def rollout_figures(
    rollout: Rollout, packed: PackedMotion, classifier: StyleClassifier, protocol: Protocol
) -> list[dict[str, float]]:
    """Measure the walks of a protocol: a dict a seed, name in records -> mean over styles.

    Args:
      rollout: from `walk_protocol`.
      packed, classifier, protocol: as for `measure_model`.
    """
    styles = list(protocol.styles)
    floors = [real_clips.style_floor(packed, style) for style in styles]
    real = real_features(packed, classifier, styles, rollout.window)
    seeds = []
    for seed in range(protocol.num_seeds):
        places = range(seed * len(styles), (seed + 1) * len(styles))
        motions = [rollout.motion(place) for place in places]
        walks = zip(motions, [rollout.paths[place] for place in places], floors, strict=True)
        figures = [_figures_without_classifier(motion, path, rollout.window, floor) for motion, path, floor in walks]
        rng, seen = np.random.default_rng([protocol.path_seed, seed]), classify_windows(classifier, motions, styles)
        scores = distribution_figures(seen, real, protocol.windows_per_style, rng)
        seeds.append(_style_means(figures, styles) | scores)
    return seeds


def _samples_of_one_start(generator: MotionGenerator, paths, styles, repeats: int, seeds) -> np.ndarray:
    """Walk each style several times from one starting pose, with noise of its own each time.

    Args:
      generator: the model and its sampler.
      paths, styles: one a style.
      repeats: walks of each style.
      seeds: of the starting poses, and of the noise.

    Returns:
      Joints, [styles, repeats, T, J, 3], metres.
    """
    poses = generator.rollout(paths, styles, seed=seeds[0]).history
    again = lambda each: [one for one in each for _ in range(repeats)]
    made = generator.rollout(again(paths), again(styles), seed=seeds[1], history=np.repeat(poses, repeats, axis=0))
    joints = np.stack([made.motion(place).positions for place in range(len(made.styles))])
    return joints.reshape(len(styles), repeats, *joints.shape[1:])


def measure_model(
    generator: MotionGenerator, packed: PackedMotion, classifier: StyleClassifier, protocol: Protocol,
    held_out: WindowSet, *, name: str | None = None,
) -> tuple[pd.DataFrame, pd.DataFrame]:  # fmt: skip
    """Run the whole protocol for one model and number of steps.

    Args:
      generator: the model and its sampler.
      packed: the data set it was trained on.
      classifier: for FID, EMD and coverage; its classes must hold the protocol's styles.
      protocol: how much.
      held_out: windows on which the use of noise is measured.
      name: of the model in the rows; by default the trained model's.

    Returns:
      (rows, rounds). Rows: model, window_frames, steps, varies, seed, metric, unit, better, value.
      Rounds: model, window_frames, steps, metric, round, value, means over styles and seeds.

    Raises:
      ValueError: if the classifier cannot tell styles apart, or does not know one of them.
    """
    require_telling_styles(classifier)
    window, styles, rows = generator.trained.config.window, list(protocol.styles), []
    columns = {"model": name or generator.trained.name, "window_frames": window, "steps": generator.num_steps}
    rollout = walk_protocol(generator, packed, protocol)
    for seed, figures in enumerate(rollout_figures(rollout, packed, classifier, protocol)):
        walked = rollout.paths[seed * len(styles) : (seed + 1) * len(styles)]
        paths = [path.slice(0, min(_DIVERSITY_ROUNDS * window, protocol.num_frames)) for path in walked]
        seeds = protocol.path_seed + seed, protocol.path_seed + seed + protocol.num_seeds
        samples = _samples_of_one_start(generator, paths, styles, protocol.num_diversity_seeds, seeds)
        use = noise_use(generator, held_out, seed=seed)
        use = {name: use[METRICS[name].key] for name in ("x0_error_ratio", "seed_spread")}
        # Of the first round, and of some rounds, each walked from the sample's own history: differences of phase.
        figures["diversity"] = distributions.diversity(samples[:, :, :window])
        figures["rollout_diversity"] = distributions.diversity(samples)
        rows += _rows(figures | use, **columns, varies="seed", seed=seed)
    # Long rollouts drift (claim Q16): the same walks round by round.
    rounds = by_round(rollout).melt(id_vars="round", var_name="metric").assign(**columns)
    return pd.DataFrame(rows), rounds[[*columns, "metric", "round", "value"]]


def measure_real(
    packed: PackedMotion, classifier: StyleClassifier, protocol: Protocol, *, window: int, model: str = "real",
    repeats: int = 20,
) -> pd.DataFrame:  # fmt: skip
    """Score held-out clips, as they are or broken by a recipe, as if they were rollouts.

    A clip follows the smoothed path of the motion that it came from. Every repeat takes another
    half of each style's clips, drawn without replacement: figures of halves scatter about as much
    as figures of all clips would between one recording and another (half-sampling), and no window
    counts twice.

    Args:
      packed: the data set.
      classifier: as for `measure_model`.
      protocol: its styles and windows.
      window: where the seams of a rollout would lie, frames.
      model: one of `REFERENCE_MODELS`.
      repeats: halves to draw.

    Returns:
      Rows as from `measure_model`, with steps 0 and varies "clips"; without diversity and use of
      noise, which real motion does not have, and without figures whose size hangs on length.

    Raises:
      ValueError: for an unknown model, or as `measure_model`.
    """
    check_known(model, REFERENCE_MODELS, "reference")
    require_telling_styles(classifier)
    clips, labels = held_out_clips(packed, protocol.styles, window)
    motions, figures = [], []
    for clip, floor in zip(clips, real_clips.clip_floors(packed, clips), strict=True):
        whole = packed.motion(int(clip))
        motion = whole if model == "real" else corrupt(model, whole, seed=int(clip))
        motions.append(motion)
        values = _figures_without_classifier(motion, real_clips.own_path(whole), window, floor)
        figures.append({name: value for name, value in values.items() if name not in _GROWS_WITH_LENGTH})
    seen = classify_windows(classifier, motions, labels)
    real = real_features(packed, classifier, protocol.styles, window)
    columns = {"model": model, "window_frames": window, "steps": 0, "varies": "clips"}
    rows = []
    for repeat in range(repeats):
        rng = np.random.default_rng([protocol.path_seed, repeat])
        half, classified = [], []
        for style in protocol.styles:
            order = rng.permutation(np.flatnonzero(labels == style))
            half += order[: max(1, len(order) // 2)].tolist()
            # Halves of few clips may hold too few windows: then one clip more is looked at.
            held = np.cumsum([np.count_nonzero(seen.source == clip) for clip in order])
            enough = 1 + int(np.searchsorted(held, protocol.windows_per_style))
            classified += order[: max(len(order) // 2, enough)].tolist()
        means = _style_means([figures[place] for place in half], labels[half])
        means |= distribution_figures(seen.of(classified), real, protocol.windows_per_style, rng)
        rows += _rows(means, **columns, seed=repeat)
    return pd.DataFrame(rows)


def summarise(rows: pd.DataFrame) -> pd.DataFrame:
    """Turn the figures of single repeats into means with 95 % intervals.

    Repeats over seeds are draws of their own: the interval is that of their mean. Repeats over
    halves of the clips scatter as the figure itself does: the interval is that of one of them.

    Args:
      rows: from `measure_model` and `measure_real`.

    Returns:
      Columns model, window_frames, steps, metric, unit, better, varies, value, low, high, repeats,
      in the order of the rows; a figure without repeats has NaN for bounds.
    """
    table = distributions.intervals_over_repeats(
        rows, ["model", "window_frames", "steps", "metric", "unit", "better", "varies"]
    )
    halves = table["varies"] == "clips"
    for bound in ("low", "high"):
        away = table[bound] - table["value"]
        table.loc[halves, bound] = table["value"] + np.sqrt(table["repeats"]) * away
    return table
