"""Motion quality from many windows or many seeds: FID, EMD, style coverage, diversity, intervals.

Where `metrics` looks at one character at a time, these functions compare sets. A *feature cloud*
is an array [N, D]: N windows of motion, each described by the D features of a style classifier.
What a figure means depends on that classifier, on the number of windows and on the definition, so
that numbers of different sources can be compared in order only, if at all. Equal counts on both
sides are the caller's to see to (`draw_per_style`); `earth_movers_distance` insists on them.

All arithmetic is float64 numpy.
"""

from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd
from scipy.spatial.distance import cdist
from scipy.special import stdtrit

from f3amd_lib.ground.arrays import finite_array

_MOST_PIVOTS = 10_000_000  # of the network simplex; POT's own 100,000 stops short of 2,000 windows


def _two_clouds(features, reference) -> list[np.ndarray]:
    """Return feature clouds as float64, or say what is wrong with them."""
    named = {"features": features, "reference": reference}
    clouds = [finite_array(name, cloud, ("window", "feature")) for name, cloud in named.items()]
    if min(map(len, clouds)) < 2 or clouds[0].shape[1] != clouds[1].shape[1]:
        raise ValueError(
            f"features {clouds[0].shape} and reference {clouds[1].shape} must be of the same classifier, with at "
            "least 2 windows each: generate more, or pool styles"
        )
    return clouds


def draw_per_style(clouds: Mapping, count: int, generator: np.random.Generator) -> np.ndarray:
    """Draw as many windows of each style without replacement, so that both sides of a distance have as many.

    Args:
      clouds: style -> features, [N, D].
      count: how many to keep of each.
      generator: what draws.

    Returns:
      [S * count, D], style by style.

    Raises:
      ValueError: for a style that holds fewer.
    """
    for style, cloud in clouds.items():
        if len(cloud) < count:
            raise ValueError(f"style {style!r} has {len(cloud)} windows, {count} are needed")
    return np.concatenate([cloud[generator.choice(len(cloud), count, replace=False)] for cloud in clouds.values()])


# -------------------------------------------------------------------------------------------- FID
#
# A covariance is kept as a factor F with F' F = covariance. Then the trace of the square root of a
# product of two covariances is the sum of the singular values of F G', and nothing has to be
# rooted that rounding may have made negative. Matrix square roots of the product lose half of the
# digits, and all of them where the covariances are singular, which they are for N <= D.


def _covariance_factor(features: np.ndarray) -> np.ndarray:
    """Return F with F' F = covariance, [min(N, D), D]."""
    centred = (features - features.mean(axis=0)) / np.sqrt(len(features) - 1)
    return np.linalg.qr(centred, mode="r") if len(features) > features.shape[1] else centred


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
    those of the released CAMDM code: see `frechet_distance_per_dimension`.
    """
    features, reference = _two_clouds(features, reference)
    factor, factor_ref = _covariance_factor(features), _covariance_factor(reference)
    shared = np.linalg.svd(factor @ factor_ref.T, compute_uv=False).sum()
    spread = np.sum(factor**2) + np.sum(factor_ref**2) - 2.0 * shared
    return max(0.0, float(np.sum((features.mean(axis=0) - reference.mean(axis=0)) ** 2) + spread))


def frechet_distance_per_dimension(features, reference) -> float:
    """Fréchet distance over the number of features: the scale of the released CAMDM code.

        FID / D;  D = 512 there.

    Args:
      features, reference: [N, D] and [M, D], from the same classifier.

    Returns:
      The distance; not comparable with a FID that is not divided.

    Raises:
      ValueError: as `frechet_distance`.

    Source: the released CAMDM code, which divides by 512 and takes the mean over styles, each with
    the real windows of the same style. One rollout a style gives some 40 windows of 60 frames, so
    that a covariance has a rank of about 40 in 512 dimensions: that alone keeps it from 0.
    """
    return frechet_distance(features, reference) / np.shape(features)[1]


# -------------------------------------------------------------------------------------------- EMD


def earth_movers_distance(features, reference) -> float:
    """Earth mover's distance of two feature clouds of equal size: no Gaussian is assumed.

        min over pairings pi of  mean_i || f_i - r_pi(i) ||.

    Args:
      features, reference: [N, D] each, from the same classifier; every window weighs 1 / N. Exact
        transport costs about N^3 (2,000 windows: about one second).

    Returns:
      The distance, in units of the features (no unit); 0 for a cloud with itself in any order.

    Raises:
      ValueError: for unlike counts or dimensions, fewer than 2 windows, a wrong shape, or NaN.
      RuntimeError: if the solver did not reach the optimum.

    Source: paper section 4.4 (EMD), which gives neither the features nor the solver. Our reading:
    the classifier's features as for FID, Euclidean ground distance, equal weights and equal counts,
    and the exact solution, by POT's network simplex. Like FID it falls with the number of windows.
    """
    import ot  # here: it brings every array library there is, up to seconds that few callers need

    features, reference = _two_clouds(features, reference)
    if len(features) != len(reference):
        raise ValueError(
            f"{len(features)} windows against {len(reference)}: the earth mover's distance needs "
            "as many on both sides (see `draw_per_style`)"
        )
    weights = np.full(len(features), 1.0 / len(features))
    cost, log = ot.emd2(weights, weights, cdist(features, reference), numItermax=_MOST_PIVOTS, log=True)
    if log["warning"] is not None:
        raise RuntimeError(f"optimal transport was not solved: {log['warning']}")
    return float(cost)


# ----------------------------------------------------------------------------------------- styles


def style_coverage(generated_counts, target_counts) -> float:
    """Share of the wanted windows that the generated ones supply, style by style.

        100 * sum_s min(n_s^gen, n_s^tgt) / sum_s n_s^tgt.

    It looks at how often each style comes up, not at where: two styles that are mixed up with each
    other cover in full (`style_accuracy` sees it). With more windows generated than wanted it can
    only rise, so generate as many.

    Args:
      generated_counts: windows that the classifier takes for each style, [S].
      target_counts: windows wanted of each style, [S].

    Returns:
      Percent, 0 to 100.

    Raises:
      ValueError: for unlike lengths, or no wanted window at all.

    Source: paper section 4.4 (Style Coverage). Our reading: counts are of 60-frame windows, and
    the wanted ones are those of the rollout's own length.
    """
    generated, target = (np.asarray(counts, np.float64) for counts in (generated_counts, target_counts))
    if generated.shape != target.shape or not target.sum() > 0:
        raise ValueError(f"counts must be [S] on both sides, some wanted, got {generated} and {target}")
    return float(100.0 * np.minimum(generated, target).sum() / target.sum())


def style_accuracy(predicted, asked) -> float:
    """Share of windows that the classifier takes for the wanted style.

        100 * mean_i [predicted_i = asked_i].

    Args:
      predicted, asked: style indices, [N] each.

    Returns:
      Percent, 0 to 100. It cannot tell more than the classifier: set its accuracy on held-out real
      windows beside it.

    Raises:
      ValueError: for unlike lengths, or no window.

    Source: CAMDM's paper; its released code stores the predictions, but holds no script for the
    figure.
    """
    predicted, asked = np.asarray(predicted), np.asarray(asked)
    if predicted.shape != asked.shape or not asked.size:
        raise ValueError(f"{predicted.shape} predicted styles and {asked.shape} wanted: give one of each a window")
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
    if positions.ndim < 4 or positions.shape[-4] < 2 or not np.all(np.isfinite(positions)):
        raise ValueError(f"diversity needs finite [..., num_seeds, T, J, 3] of at least 2 seeds, got {positions.shape}")
    return float((positions - positions[..., :1, :]).var(axis=-4, ddof=1).sum(axis=-1).mean())


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


def mean_and_interval(values) -> dict:
    """Mean over repeats, and the 95 % interval that Student's t gives it.

        mean +- t_{0.95, n - 1} * s / sqrt(n).

    Args:
      values: one figure a repeat (such as a seed), [n]; undefined ones (NaN) are left out.

    Returns:
      value, low, high, and repeats (the figures that counted), ready for a row of a tidy table.
      One figure alone has NaN for bounds, none has NaN throughout.

    Raises:
      ValueError: for values that are infinite or no list.
    """
    values = np.asarray(values, dtype=np.float64)
    if values.ndim != 1 or np.any(np.isinf(values)):
        raise ValueError(f"values must be [n], finite or NaN, got an array of {values.shape}")
    values = values[~np.isnan(values)]
    count = len(values)
    mean = float(values.mean()) if count else np.nan
    half = float(stdtrit(count - 1, 0.975)) * float(values.std(ddof=1)) / np.sqrt(count) if count > 1 else np.nan
    return {"value": mean, "low": mean - half, "high": mean + half, "repeats": count}


def intervals_over_repeats(rows: pd.DataFrame, columns: Sequence[str]) -> pd.DataFrame:
    """Turn the values of repeats into means with 95 % intervals, in the order of the rows.

    Args:
      rows: tidy, with a column "value".
      columns: what they are about; rows that agree in all of them are repeats.

    Returns:
      The columns, then those of `mean_and_interval`.
    """
    groups = rows.groupby(list(columns), sort=False)["value"]
    made = [dict(zip(columns, key, strict=True)) | mean_and_interval(values.to_numpy()) for key, values in groups]
    return pd.DataFrame(made)


def of_seeds(table: pd.DataFrame, keys: Sequence[str], length: float = 1.0) -> pd.DataFrame:
    """Return a table after so much of the usual length, 0 of which has no training: means over `seeds` of each row.

    `trainings` has the figure of each, by the digest of its weights where the table has them.

    An interval is that of the seeds, or of the repeats of one, where that is the wider. A table without lengths and
    seeds has one.
    """
    if not {"seed", "length"} <= {*table}:
        return table.assign(seeds=1) if length == 1.0 else table[:0]
    found = []
    for _, rows in table[table["length"].isin([0.0, length])].groupby(list(keys), sort=False, dropna=False):
        over, repeats = mean_and_interval(rows["value"]), rows[["low", "high"]].mean()
        bounds = {"low": np.fmin(over["low"], repeats["low"]), "high": np.fmax(over["high"], repeats["high"])}
        each = dict(zip(rows.get("weights", ()), rows["value"], strict=False))
        bounds |= {"seeds": rows["seed"].nunique(), "trainings": each}
        found.append({**rows.iloc[0], "value": over["value"], **bounds})
    return pd.DataFrame(found, columns=[*table, "seeds", "trainings"])


# --------------------------------------------------------------------------------------- settling

DISTANCES = {"FID": frechet_distance, "EMD": earth_movers_distance}


def settling_curve(features, reference, sizes: Sequence[int], *, repeats: int = 5, seed: int = 0) -> pd.DataFrame:
    """Follow FID and EMD over the number of windows: how many are needed before they settle?

    Args:
      features, reference: [N, D] and [M, D], from the same classifier; or such clouds by style, of
        which as many windows are drawn each.
      sizes: numbers of windows to draw on each side, of each style.
      repeats: draws a size.
      seed: of the draws; those of one size do not depend on the other sizes.

    Returns:
      Columns metric (FID, EMD), windows (of all styles together), value, low, high (95 % interval
      over draws), repeats; one row for each metric and size. Draws share windows, the more the
      nearer a size comes to the whole cloud, so that there the intervals are too narrow: keep to
      half of it or less.

    Raises:
      ValueError: for a size that a cloud does not hold, and as `frechet_distance`.

    Source: ours.
    """
    sides = [side if isinstance(side, Mapping) else {"": np.asarray(side)} for side in (features, reference)]
    rows = []
    for size in sizes:
        for repeat in range(repeats):
            generator = np.random.default_rng([seed, size, repeat])
            drawn = [draw_per_style(side, size, generator) for side in sides]
            figures = {metric: distance(*drawn) for metric, distance in DISTANCES.items()}
            rows += [{"metric": name, "windows": len(drawn[0]), "value": value} for name, value in figures.items()]
    return intervals_over_repeats(pd.DataFrame(rows), ("metric", "windows"))
