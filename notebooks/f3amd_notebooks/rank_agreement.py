"""Do distances order motion that is broken more and more? Rank correlations, as notebook 07 shows them."""

import numpy as np
import pandas as pd
from f3amd_lib.measures import distributions
from scipy.stats import spearmanr


def rank_agreement(rows: pd.DataFrame) -> pd.DataFrame:
    """Say how well each distance orders the strengths of a corruption (claim Q18).

    Spearman's rank correlation between strength and distance within a seed; its mean over seeds.
    1 is the right order throughout, 0 none.

    Args:
      rows: from `graded_corruptions`, at least two strengths.

    Returns:
      Columns corruption, metric, value, low, high (95 %, cut to [-1, 1]; for the difference to
      [-2, 2]), repeats. Metrics are "FID", "EMD" and "EMD minus FID", the paired difference, which
      lies above 0 where EMD knows the order better.

    Raises:
      ValueError: for a single strength.

    Source: ours.
    """
    if rows["strength"].nunique() < 2:
        raise ValueError("one strength has no order; give `graded_corruptions` at least two")
    rows_of_seeds = []
    for (name, _), group in rows.groupby(["corruption", "seed"], sort=False):
        ranks = {}
        for metric in distributions.DISTANCES:
            graded = group[group["metric"] == metric]
            ranks[metric] = float(spearmanr(graded["strength"], graded["value"]).statistic)
        ranks["EMD minus FID"] = ranks["EMD"] - ranks["FID"]
        rows_of_seeds += [{"corruption": name, "metric": metric, "value": value} for metric, value in ranks.items()]
    table = distributions.intervals_over_repeats(pd.DataFrame(rows_of_seeds), ("corruption", "metric"))
    most = np.where(table["metric"] == "EMD minus FID", 2.0, 1.0)
    return table.assign(low=np.maximum(table["low"], -most), high=np.minimum(table["high"], most))
