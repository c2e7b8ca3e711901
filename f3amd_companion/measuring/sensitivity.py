"""Measuring the measures: do distances order motion that is broken more and more, how many windows
do they need, and what do they not see of the feet?

FID and EMD look at motion through a classifier (`measures.classifier`). Nothing here says what
people would prefer; it says whether a distance knows the order in which we broke the motion.
"""

import itertools
from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd
from scipy.signal import welch
from tqdm import tqdm

from f3amd_lib.data.packed import PackedMotion
from f3amd_lib.measures import distributions
from f3amd_lib.measures.classifier import StyleClassifier, require_telling_styles
from f3amd_lib.measures.corruptions import CORRUPTIONS, corrupt
from f3amd_lib.measures.protocol import Protocol, classify_windows, real_features
from f3amd_lib.measures.real_clips import reference_clips
from f3amd_lib.motion.skeleton import Motion

STRENGTHS = (0.0, 0.05, 0.1, 0.2, 0.4, 0.7, 1.0)
"""Shares of each recipe of `corruptions`: 0 is real motion, 1 the bad generator of our tables."""

FOOT_BANDS = {"0.5-2 Hz": (0.5, 2.0), "2-5 Hz": (2.0, 5.0), "5-15 Hz": (5.0, 15.0)}
"""Bands of toe motion, Hz: strides; lift, swing and strike; what is finer, up to half of 30 fps."""

_SEGMENT = 64
"""Frames of a spectrum's segment: bins of 0.47 Hz, and clips of 2.1 s are long enough."""


# ------------------------------------------------------------------------------ graded corruptions


def graded_corruptions(
    packed: PackedMotion, classifier: StyleClassifier, protocol: Protocol, strengths: Sequence[float] = STRENGTHS,
    *, corruptions: Sequence[str] = tuple(CORRUPTIONS), splits: Sequence[str] = ("validation", "test"),
    progress: bool = False,
) -> pd.DataFrame:  # fmt: skip
    """Break held-out clips more and more and measure the distance to real training windows.

    Each strength and seed draws windows of its own, so that the order is that of independent
    measurements, as of two models. Both sides hold as many windows of each style, at the speeds
    of the protocol's paths.

    Args:
      packed: the data set.
      classifier: whose features are compared.
      protocol: its styles, num_seeds, windows_per_style and path_seed.
      strengths: shares of each recipe, 0 to 1.
      corruptions: names of `corruptions.CORRUPTIONS`.
      splits: of the clips that are broken.
      progress: show a progress bar.

    Returns:
      Columns corruption, strength, seed, metric ("FID", "EMD", "style_accuracy" in %), value.

    Raises:
      ValueError: for a classifier that cannot tell styles apart, a strength out of range, an
        unknown corruption, style or split, or a style with too few windows.

    Source: ours, for claim Q18 (paper section 4.4: "EMD values showed better consistency with
    perceived motion quality than FID in our experiments").
    """
    require_telling_styles(classifier)
    window = classifier.config.window
    clips = [clip for split in splits for clip in reference_clips(packed, protocol.styles, window=window, split=split)]
    motions = [packed.motion(clip) for clip in clips]
    names = [packed.styles[packed.clip_style[clip]] for clip in clips]
    by_class = real_features(packed, classifier, protocol.styles, window)
    real = {classifier.styles[number]: cloud for number, cloud in by_class.items()}
    todo = list(itertools.product(corruptions, strengths, range(protocol.num_seeds)))
    rows = []
    for name, strength, seed in tqdm(todo, unit="set", disable=not progress):
        rng = np.random.default_rng([protocol.path_seed, seed, round(1e6 * strength)])
        broken = [corrupt(name, motion, strength=strength, seed=int(rng.integers(2**31))) for motion in motions]
        seen = classify_windows(classifier, broken, names)
        made = {style: seen.features[seen.style == classifier.style_index(style)] for style in real}
        drawn = [distributions.draw_per_style(side, protocol.windows_per_style, rng) for side in (made, real)]
        figures = {metric: distance(*drawn) for metric, distance in distributions.DISTANCES.items()}
        figures["style_accuracy"] = distributions.style_accuracy(seen.predicted, seen.style)
        named = {"corruption": name, "strength": float(strength), "seed": seed}
        rows += [{**named, "metric": metric, "value": value} for metric, value in figures.items()]
    return pd.DataFrame(rows)


def summarise_corruptions(rows: pd.DataFrame) -> pd.DataFrame:
    """Turn figures of single seeds into means with 95 % intervals.

    Args:
      rows: from `graded_corruptions`.

    Returns:
      Columns corruption, strength, metric, value, low, high, repeats. The intervals are over draws
      of windows and noise, not over people or clips.
    """
    return distributions.intervals_over_repeats(rows, ("corruption", "strength", "metric"))


# ---------------------------------------------------------------------------------------- settling


def most_windows(classifier: StyleClassifier) -> int:
    """Return how many windows of a style `settling` may draw: half of what the poorest has on either side."""
    clouds = (classifier.reference(split, style) for split in ("held_out", "train") for style in classifier.styles)
    return min(map(len, clouds)) // 2


def settling(classifier: StyleClassifier) -> pd.DataFrame:
    """Follow FID and EMD of real held-out motion against real training motion over the windows.

    Both sides are real, so what is measured is other clips of the same people, and the number of
    windows. (`distributions.settling_curve` does it for any two clouds.)

    Args:
      classifier: its reference features are the two clouds. From each at most half of what the poorest style has is
        drawn, lest draws share too many windows for their interval, and halvings of that.

    Returns:
      Columns metric, windows (of all styles together), value, low, high (95 % over draws), repeats.

    Raises:
      ValueError: for a classifier that cannot tell styles apart, or has too few windows to halve.

    Source: ours.
    """
    require_telling_styles(classifier)
    if not (most := most_windows(classifier)):
        raise ValueError("a style of the classifier has fewer than two windows on a side: take more data")
    sides = [
        {style: classifier.reference(split, style) for style in classifier.styles} for split in ("held_out", "train")
    ]
    return distributions.settling_curve(*sides, [most >> k for k in range(10, -1, -1) if most >> k])


# ------------------------------------------------------------------------------------ foot spectra


def _toe_power(motion: Motion) -> dict[str, float]:
    """Return the power of toe velocity in each of `FOOT_BANDS`, whose last frequency is not in it.

    In (m/s)^2: mean over toes, sum over x, y, z.
    """
    velocity = motion.fps * np.diff(motion.positions[:, list(motion.skeleton.toes)], axis=0)
    frequency, density = welch(velocity, motion.fps, nperseg=_SEGMENT, axis=0, detrend="constant")
    density = density.sum(axis=-1).mean(axis=-1)
    width = frequency[1] - frequency[0]
    return {
        band: float(density[(frequency >= low) & (frequency < high)].sum() * width)
        for band, (low, high) in FOOT_BANDS.items()
    }


def foot_spectrum(systems: Mapping[tuple[str, int, int], Sequence[tuple[str, Motion]]]) -> pd.DataFrame:
    """Compare the power of toe motion by frequency with that of real feet (claim Q15).

    Power is that of the toes' velocity in the world, where a resting foot reads 0. Fine foot motion
    that is lost lowers the upper bands; trembling raises them. The lowest band follows the pace:
    on a path with stops it is low for that alone.

    Args:
      systems: (model, window_frames, steps) -> (style, motion) pairs, such as
        `zip(rollout.styles, map(rollout.motion, range(len(rollout.styles))))`. Real clips stand
        under a key whose model is "real". Motions under 65 frames are left out.

    Returns:
      Columns model, window_frames, steps, band, metric, value, low, high, repeats. Metric
      "toe_power" in (m/s)^2 is the mean over styles; "toe_power_over_real" the geometric mean over
      styles of the quotient with real clips of the same style, 1 where feet are as lively as real
      ones. Intervals (95 %) are over styles.

    Raises:
      ValueError: for a system none of whose motions is long enough, or a style without a real clip that is.

    Source: paper section 6 ("may lose fine foot motion" of FNO variants); the measure is ours.
    """
    rows, keys = [], ["model", "window_frames", "steps"]
    for key, pairs in systems.items():
        long = [(style, motion) for style, motion in pairs if motion.num_frames > _SEGMENT]
        if not long:
            raise ValueError(f"{key[0]}: no motion of more than {_SEGMENT} frames")
        rows += [(*key, style, *each) for style, motion in long for each in _toe_power(motion).items()]
    power = pd.DataFrame(rows, columns=[*keys, "style", "band", "value"])
    power = power.groupby([*keys, "style", "band"], sort=False)["value"].mean().reset_index()
    real = power[power["model"] == "real"].set_index(["style", "band"])["value"].rename("real")
    power = power.join(real, on=["style", "band"])
    for style in power.loc[power["real"].isna(), "style"]:
        raise ValueError(f"no real clip of style {style!r} is long enough to compare with")
    tables = {"toe_power": power, "toe_power_over_real": power.assign(value=np.log(power["value"] / power["real"]))}
    tables = {name: distributions.intervals_over_repeats(one, [*keys, "band"]) for name, one in tables.items()}
    bounds = ["value", "low", "high"]
    tables["toe_power_over_real"][bounds] = np.exp(tables["toe_power_over_real"][bounds])
    table = pd.concat([one.assign(metric=name) for name, one in tables.items()], ignore_index=True)
    return table[[*keys, "band", "metric", *bounds, "repeats"]]
