"""Motion quality from many windows or many seeds: FID, EMD, style coverage, diversity, intervals.

Where `metrics` looks at one character at a time, these functions compare sets. A *feature cloud*
is an array [N, D]: N windows of motion, each described by the D features of a style classifier.
What a figure means depends on that classifier, on the number of windows and on the definition, so
that numbers of different sources can be compared in order only, if at all. Equal counts on both
sides are the caller's to see to (`draw_windows`); `earth_movers_distance` insists on them.

All arithmetic is float64 numpy.
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
import ot
import pandas as pd
from scipy.spatial.distance import cdist
from scipy.stats import t as student_t

_MOST_PIVOTS = 10_000_000  # of the network simplex; POT's own 100,000 stops short of 2,000 windows

_NEGATIVE = 1e-4  # an eigenvalue below minus this share of the largest is no rounding


class Moments(NamedTuple):
    """Mean and covariance of a feature cloud.

    Attributes:
      mean: [D].
      covariance: [D, D], unbiased (divided by N - 1); of rank N - 1 at most.
      count: N, the windows it was made of.
    """

    mean: np.ndarray
    covariance: np.ndarray
    count: int


def _cloud(features, what: str) -> np.ndarray:
    """Return a feature cloud as float64, or say what is wrong with it."""
    features = np.asarray(features, dtype=np.float64)
    if features.ndim != 2 or features.shape[1] == 0:
        raise ValueError(f"{what} must be [N, D], one row of features a window, got {features.shape}")
    if len(features) < 2:
        raise ValueError(
            f"{what} holds {len(features)} window{'s' * (len(features) != 1)}; a distribution "
            "needs at least 2: generate more, or pool styles"
        )
    if not np.all(np.isfinite(features)):
        window, feature = (int(i) for i in np.argwhere(~np.isfinite(features))[0])
        raise ValueError(f"{what} is not finite at window {window}, feature {feature}")
    return features


def _two_clouds(features, reference) -> tuple[np.ndarray, np.ndarray]:
    features, reference = _cloud(features, "features"), _cloud(reference, "reference")
    if features.shape[1] != reference.shape[1]:
        raise ValueError(
            f"features have {features.shape[1]} dimensions and the reference "
            f"{reference.shape[1]}: both must come from the same classifier"
        )
    return features, reference


def moments(features) -> Moments:
    """Return mean, unbiased covariance and count of a feature cloud.

    Args:
      features: [N, D].

    Returns:
      The moments, as `frechet_distance_from_moments` takes them.

    Raises:
      ValueError: for fewer than 2 windows, a wrong shape, or NaN.
    """
    features = _cloud(features, "features")
    centred = features - features.mean(axis=0)
    return Moments(features.mean(axis=0), centred.T @ centred / (len(features) - 1), len(features))


def draw_windows(features, count: int, seed: int | np.random.Generator) -> np.ndarray:
    """Draw windows without replacement, so that both sides of a distance have as many.

    Args:
      features: [N, D].
      count: how many to keep, 2 to N.
      seed: a seed, or a numpy Generator.

    Returns:
      [count, D], in random order.

    Raises:
      ValueError: for a count that the cloud does not hold, or a cloud that is none.
    """
    features = _cloud(features, "features")
    if int(count) != count or not 2 <= count <= len(features):
        raise ValueError(
            f"cannot draw {count} windows of {len(features)}: give a whole number from 2 to {len(features)}"
        )
    generator = np.random.default_rng(seed)
    return features[generator.choice(len(features), int(count), replace=False)]


# -------------------------------------------------------------------------------------------- FID
#
# A covariance is kept as a factor F with F' F = covariance. Then the trace of the square root of a
# product of two covariances is the sum of the singular values of F G', and nothing has to be
# rooted that rounding may have made negative. Matrix square roots of the product lose half of the
# digits, and all of them where the covariances are singular, which they are for N <= D.


def _factor_of_cloud(features: np.ndarray) -> np.ndarray:
    """Return F with F' F = covariance, [min(N, D), D]."""
    centred = (features - features.mean(axis=0)) / np.sqrt(len(features) - 1)
    return np.linalg.qr(centred, mode="r") if len(features) > features.shape[1] else centred


def _mean_and_factor(mean, covariance, what: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean and F with F' F = covariance, [D, D], or say what is wrong with them."""
    mean, covariance = np.asarray(mean, np.float64), np.asarray(covariance, np.float64)
    if mean.ndim != 1 or covariance.shape != (len(mean), len(mean)):
        raise ValueError(f"{what} needs a mean [D] and a covariance [D, D], got {mean.shape} and {covariance.shape}")
    if not (np.all(np.isfinite(mean)) and np.all(np.isfinite(covariance))):
        raise ValueError(f"{what} holds a mean or covariance that is not finite")
    size = np.abs(covariance).max()
    if np.abs(covariance - covariance.T).max() > 1e-5 * size:
        raise ValueError(f"the covariance of {what} is not symmetric")
    values, vectors = np.linalg.eigh(0.5 * (covariance + covariance.T))
    if values[0] < -_NEGATIVE * size:
        raise ValueError(f"the covariance of {what} has a negative eigenvalue, {values[0]:.3g}: it is none")
    return mean, np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T


def _distance(mean, factor, mean_ref, factor_ref) -> float:
    shared = np.linalg.svd(factor @ factor_ref.T, compute_uv=False).sum()
    spread = np.sum(factor**2) + np.sum(factor_ref**2) - 2.0 * shared
    return max(0.0, float(np.sum((mean - mean_ref) ** 2) + spread))


def frechet_distance(features, reference) -> float:
    """Fréchet distance of two feature clouds, each taken for a Gaussian: the standard FID.

        || mu - mu_r ||^2 + tr(S + S_r - 2 (S S_r)^(1/2)).

    FID falls with the number of windows on either side, also between clouds of one distribution:
    compare figures of equal counts only, and see `settling_curve`.

    Args:
      features, reference: [N, D] and [M, D], from the same classifier.

    Returns:
      The distance, in squared units of the features (no unit); 0 for a cloud with itself.

    Raises:
      ValueError: for fewer than 2 windows, unlike dimensions, a wrong shape, or NaN.

    Source: paper Appendix C (FID), after Heusel et al. 2017. Our reading: windows of all styles
    are pooled, and nothing is divided. The values that the paper prints (0.14 to 0.27) look like
    `camdm_frechet_distance`.
    """
    features, reference = _two_clouds(features, reference)
    return _distance(
        features.mean(axis=0), _factor_of_cloud(features), reference.mean(axis=0), _factor_of_cloud(reference)
    )


def frechet_distance_from_moments(mean, covariance, mean_ref, covariance_ref) -> float:
    """Fréchet distance of two Gaussians: `frechet_distance` where only the moments are at hand.

    Args:
      mean, mean_ref: [D].
      covariance, covariance_ref: [D, D], symmetric and positive semi-definite, of any rank.

    Returns:
      The distance, in squared units of the features.

    Raises:
      ValueError: for shapes that do not agree, NaN, or a matrix that is no covariance.

    Source: as for `frechet_distance`.
    """
    mean, factor = _mean_and_factor(mean, covariance, "the first side")
    mean_ref, factor_ref = _mean_and_factor(mean_ref, covariance_ref, "the reference")
    if len(mean) != len(mean_ref):
        raise ValueError(
            f"moments have {len(mean)} dimensions and the reference {len(mean_ref)}: both must "
            "come from the same classifier"
        )
    return _distance(mean, factor, mean_ref, factor_ref)


def frechet_distance_per_dimension(features, reference) -> float:
    """Fréchet distance over the number of features: the scale of the released CAMDM code.

        FID / D;  D = 512 there.

    Args:
      features, reference: [N, D] and [M, D], from the same classifier.

    Returns:
      The distance; not comparable with a FID that is not divided.

    Raises:
      ValueError: as `frechet_distance`.

    Source: the released CAMDM code, which divides by 512; pooled over styles as ours is. Its own
    figure is `camdm_frechet_distance`.
    """
    return frechet_distance(features, reference) / np.shape(features)[1]


def camdm_style_frechet_distances(features, styles, reference: Mapping[Hashable, Moments]) -> dict[Hashable, float]:
    """Fréchet distance over the number of features, of each style with the same style's reference.

    Args:
      features: [N, D], windows of generated motion.
      styles: the style that was asked for in each window, [N].
      reference: moments of the real windows of each style; styles that `features` has not are left
        out.

    Returns:
      Style -> FID / D, in the order of `reference`.

    Raises:
      ValueError: for a style without a reference or with one window only, unlike lengths or
        dimensions, or NaN.

    Source: the released CAMDM code. One rollout a style gives some 40 windows of 60 frames, so
    that a covariance has a rank of about 40 in 512 dimensions: that alone keeps the figure from 0.
    """
    features = _cloud(features, "features")
    styles = np.asarray(styles)
    if styles.shape != features.shape[:1]:
        raise ValueError(f"styles must name one style a window, [{len(features)}], got {styles.shape}")
    present = set(styles.tolist())
    missing = [style for style in present if style not in reference]
    if missing:
        raise ValueError(f"no reference moments for style {sorted(missing, key=str)[0]!r}")
    distances = {}
    for style in reference:
        if style not in present:
            continue
        mine = _cloud(features[styles == style], f"features of style {style!r}")
        mean_ref, factor_ref = _mean_and_factor(
            reference[style].mean, reference[style].covariance, f"the reference of {style!r}"
        )
        if len(mean_ref) != features.shape[1]:
            raise ValueError(
                f"features have {features.shape[1]} dimensions and the reference of {style!r} "
                f"{len(mean_ref)}: both must come from the same classifier"
            )
        distance = _distance(mine.mean(axis=0), _factor_of_cloud(mine), mean_ref, factor_ref)
        distances[style] = distance / features.shape[1]
    return distances


def camdm_frechet_distance(features, styles, reference: Mapping[Hashable, Moments]) -> float:
    """Mean over styles of FID / D against the style's own reference: CAMDM's published FID.

        mean_s FID(windows of style s, reference of style s) / D;  D = 512 there.

    Args:
      features, styles, reference: see `camdm_style_frechet_distances`.

    Returns:
      The mean; not comparable with a pooled FID, divided or not.

    Raises:
      ValueError: as `camdm_style_frechet_distances`.

    Source: the released CAMDM code, where each file holds one style.
    """
    return float(np.mean(list(camdm_style_frechet_distances(features, styles, reference).values())))


# -------------------------------------------------------------------------------------------- EMD


def earth_movers_distance(
    features, reference, *, most: int | None = None, seed: int | np.random.Generator = 0
) -> float:
    """Earth mover's distance of two feature clouds of equal size: no Gaussian is assumed.

        min over pairings pi of  mean_i || f_i - r_pi(i) ||.

    Args:
      features, reference: [N, D] each, from the same classifier; every window weighs 1 / N.
      most: with more windows than this on a side, that many are drawn there. Exact transport costs
        about N^3 (2,000 windows: about one second).
      seed: of that draw, or a numpy Generator; nothing else is random.

    Returns:
      The distance, in units of the features (no unit); 0 for a cloud with itself in any order.

    Raises:
      ValueError: for unlike counts or dimensions, fewer than 2 windows, a wrong shape, or NaN.
      RuntimeError: if the solver did not reach the optimum.

    Source: paper section 4.4 (EMD), which gives neither the features nor the solver. Our reading:
    the classifier's features as for FID, Euclidean ground distance, equal weights and equal counts,
    and the exact solution, by POT's network simplex. Like FID it falls with the number of windows.
    """
    features, reference = _two_clouds(features, reference)
    if most is not None:
        generator = np.random.default_rng(seed)
        features, reference = (
            draw_windows(side, most, generator) if len(side) > most else side for side in (features, reference)
        )
    if len(features) != len(reference):
        raise ValueError(
            f"{len(features)} windows against {len(reference)}: the earth mover's distance needs "
            "as many on both sides (see `draw_windows`, or give `most`)"
        )
    weights = np.full(len(features), 1.0 / len(features))
    cost, log = ot.emd2(weights, weights, cdist(features, reference), numItermax=_MOST_PIVOTS, log=True)
    if log["warning"] is not None:
        raise RuntimeError(f"optimal transport was not solved: {log['warning']}")
    return float(cost)


# ----------------------------------------------------------------------------------------- styles


def _style_indices(styles, what: str) -> np.ndarray:
    styles = np.asarray(styles)
    if styles.ndim != 1 or not np.issubdtype(styles.dtype, np.integer):
        raise ValueError(f"{what} must be style indices, [N] of int, got {styles.dtype} of shape {styles.shape}")
    return styles


def style_counts(predicted, num_styles: int) -> np.ndarray:
    """Count the windows of each style.

    Args:
      predicted: style index of each window, [N].
      num_styles: S.

    Returns:
      Counts, [S] of int.

    Raises:
      ValueError: for anything that is no index below `num_styles`.
    """
    predicted = _style_indices(predicted, "predicted")
    if len(predicted) and not 0 <= predicted.min() <= predicted.max() < num_styles:
        raise ValueError(
            f"predicted styles run from {predicted.min()} to {predicted.max()}; {num_styles} "
            f"styles are numbered 0 to {num_styles - 1}"
        )
    return np.bincount(predicted, minlength=num_styles)


def style_coverage(generated_counts, target_counts) -> float:
    """Share of the wanted windows that the generated ones supply, style by style.

        100 * sum_s min(n_s^gen, n_s^tgt) / sum_s n_s^tgt.

    It looks at how often each style comes up, not at where: two styles that are mixed up with each
    other cover in full (`style_accuracy` sees it). With more windows generated than wanted it can
    only rise, so generate as many.

    Args:
      generated_counts: windows that the classifier takes for each style, [S].
      target_counts: windows that were asked of each style, [S].

    Returns:
      Percent, 0 to 100.

    Raises:
      ValueError: for unlike lengths, negative or non-finite counts, or no wanted window at all.

    Source: paper section 4.4 (Style Coverage). Our reading: counts are of 60-frame windows, and
    the wanted ones are those of the rollout's own length.
    """
    generated = np.asarray(generated_counts, np.float64)
    target = np.asarray(target_counts, np.float64)
    if generated.ndim != 1 or generated.shape != target.shape:
        raise ValueError(f"counts must be [S] on both sides, got {generated.shape} and {target.shape}")
    for what, counts in (("generated_counts", generated), ("target_counts", target)):
        if not np.all(np.isfinite(counts)) or np.any(counts < 0):
            raise ValueError(f"{what} must be finite and not negative")
    if target.sum() == 0:
        raise ValueError("target_counts are all 0: there is nothing to cover")
    return float(100.0 * np.minimum(generated, target).sum() / target.sum())


def style_accuracy(predicted, asked) -> float:
    """Share of windows that the classifier takes for the style that was asked for.

        100 * mean_i [predicted_i = asked_i].

    Args:
      predicted, asked: style indices, [N] each.

    Returns:
      Percent, 0 to 100. It cannot tell more than the classifier: set its accuracy on held-out real
      windows beside it.

    Raises:
      ValueError: for unlike lengths, no window, or anything that is no index.

    Source: CAMDM's paper; its released code stores the predictions, but holds no script for the
    figure.
    """
    predicted, asked = _style_indices(predicted, "predicted"), _style_indices(asked, "asked")
    if len(predicted) != len(asked) or len(asked) == 0:
        raise ValueError(f"{len(predicted)} predicted styles and {len(asked)} asked: give one of each a window")
    return float(100.0 * np.mean(predicted == asked))


# -------------------------------------------------------------------------------------- diversity


def diversity_variance(positions) -> float:
    """Variance, over noise seeds, of joint positions relative to the root.

        mean_{conditions, t, j} sum_{x, y, z} var_seeds(p_{t, j} - p_{t, root}).

    Args:
      positions: global joint positions of samples under identical conditions,
        [num_seeds, T, J, 3], or of several such sets, [num_conditions, num_seeds, T, J, 3];
        metres, joint 0 being the root.

    Returns:
      Square metres.

    Raises:
      ValueError: for fewer than 2 seeds, a wrong shape, or NaN.

    Source: paper Appendix C (Diversity), to the letter. Our reading: the variance is unbiased and
    that of the three coordinates together; frames and all joints are averaged (the root, 0 by
    construction, among them); the root's place is taken off but not its facing, which the path
    fixes.
    """
    positions = np.asarray(positions, dtype=np.float64)
    if positions.ndim not in (4, 5) or positions.shape[-1] != 3 or 0 in positions.shape:
        raise ValueError(
            f"positions must be [num_seeds, T, J, 3] or [num_conditions, num_seeds, T, J, 3], got {positions.shape}"
        )
    if positions.shape[-4] < 2:
        raise ValueError("diversity needs samples of at least 2 seeds, got 1")
    if not np.all(np.isfinite(positions)):
        place = [int(i) for i in np.argwhere(~np.isfinite(positions))[0]]
        raise ValueError(f"positions are not finite at seed {place[-4]}, frame {place[-3]}, joint {place[-2]}")
    relative = positions - positions[..., :1, :]
    return float(relative.var(axis=-4, ddof=1).sum(axis=-1).mean())


def diversity(positions) -> float:
    """How far samples under identical conditions differ: the root of `diversity_variance`, in cm.

    Args:
      positions: see `diversity_variance`.

    Returns:
      Centimetres; 0 if every seed gives the same motion.

    Raises:
      ValueError: as `diversity_variance`.

    Source: paper Appendix C (Diversity). The text says variance, the tables print cm: we take the
    root. High is not good by itself: noise is diverse. Read it beside the real row's figures.
    """
    return 100.0 * float(np.sqrt(diversity_variance(positions)))


# -------------------------------------------------------------------------------------- intervals


def mean_and_interval(values, level: float = 0.95) -> dict:
    """Mean over repeats, and the interval that Student's t gives it.

        mean +- t_{level, n - 1} * s / sqrt(n).

    Args:
      values: one figure a repeat (such as a seed), [n]; undefined ones (NaN) are left out.
      level: of the interval, between 0 and 1.

    Returns:
      value, low, high, and repeats (the figures that counted), ready for a row of a tidy table.
      One figure alone has NaN for bounds, none has NaN throughout.

    Raises:
      ValueError: for values that are infinite or no list, or a level out of range.
    """
    values = np.asarray(values, dtype=np.float64)
    if values.ndim != 1 or np.any(np.isinf(values)):
        raise ValueError(f"values must be [n], finite or NaN, got an array of {values.shape}")
    if not 0.0 < level < 1.0:
        raise ValueError(f"level must lie between 0 and 1, got {level}")
    values = values[~np.isnan(values)]
    count = len(values)
    mean, half = float("nan"), float("nan")
    if count:
        mean = float(values.mean())
    if count > 1:
        quantile = float(student_t.ppf(0.5 + 0.5 * level, count - 1))
        half = quantile * float(values.std(ddof=1)) / np.sqrt(count)
    return {"value": mean, "low": mean - half, "high": mean + half, "repeats": count}


def settling_curve(features, reference, sizes: Sequence[int], repeats: int = 5, seed: int = 0) -> pd.DataFrame:
    """Follow FID and EMD over the number of windows: how many are needed before they settle?

    Args:
      features, reference: [N, D] and [M, D], from the same classifier.
      sizes: numbers of windows to draw on each side, each 2 to min(N, M).
      repeats: draws a size.
      seed: of the draws; those of one size do not depend on the other sizes.

    Returns:
      Columns metric (FID, EMD), windows, value, low, high (95 % interval over draws), repeats; one
      row for each metric and size. Draws share windows, the more the nearer a size comes to the
      whole cloud, so that there the intervals are too narrow: keep to half of it or less.

    Raises:
      ValueError: for a size that a cloud does not hold, no size or repeat, and as
        `frechet_distance`.

    Source: ours.
    """
    features, reference = _two_clouds(features, reference)
    smallest = min(len(features), len(reference))
    sizes = list(sizes)
    if not sizes or any(int(size) != size or not 2 <= size <= smallest for size in sizes):
        raise ValueError(f"sizes must be whole numbers from 2 to {smallest}, the smaller cloud; got {sizes}")
    if int(repeats) != repeats or repeats < 1:
        raise ValueError(f"repeats must be 1 or more, got {repeats}")
    rows = {"FID": [], "EMD": []}
    for size in sizes:
        drawn = {"FID": [], "EMD": []}
        for repeat in range(int(repeats)):
            generator = np.random.default_rng([seed, int(size), repeat])
            mine = draw_windows(features, size, generator)
            theirs = draw_windows(reference, size, generator)
            drawn["FID"].append(frechet_distance(mine, theirs))
            drawn["EMD"].append(earth_movers_distance(mine, theirs))
        for metric, values in drawn.items():
            row = {"metric": metric, "windows": int(size), **mean_and_interval(values)}
            rows[metric].append(row)
    return pd.DataFrame(rows["FID"] + rows["EMD"])
