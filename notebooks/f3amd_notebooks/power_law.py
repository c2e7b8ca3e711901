"""A power law through a learning curve, and how far it can be followed."""

import numpy as np
import pandas as pd
from scipy import stats


def power_law(windows, values, reach) -> pd.DataFrame:
    """Fit c windows^exponent through a learning curve, and follow it.

    Args:
      windows, values: positive, at least 3 points [N].
      reach: numbers of windows to follow it to, [M].

    Returns:
      A row for each of `reach`: windows, value, low and high: the 95 % interval of the fitted line, which knows of
      scatter about a power law and not of a curve that is none; and exponent, the same in all rows.

    Raises:
      ValueError: for fewer points, or what has no logarithm.
    """
    windows, values, reach = (np.asarray(each, float) for each in (windows, values, reach))
    if len(windows) < 3 or windows.shape != values.shape:
        raise ValueError(f"a power law needs 3 points of windows and values, got {windows.shape} and {values.shape}")
    if not all((np.isfinite(each) & (each > 0)).all() for each in (windows, values, reach)):
        raise ValueError("a power law needs positive, finite windows and values")
    x, y, ahead = np.log(windows), np.log(values), np.log(reach)
    fit = stats.linregress(x, y)
    line, spare = fit.slope * ahead + fit.intercept, len(x) - 2
    scatter = np.sqrt(np.sum((y - fit.slope * x - fit.intercept) ** 2) / spare)
    leverage = 1 / len(x) + (ahead - x.mean()) ** 2 / np.sum((x - x.mean()) ** 2)
    half = stats.t.ppf(0.975, spare) * scatter * np.sqrt(leverage)
    rows = {"windows": reach, "value": np.exp(line), "low": np.exp(line - half), "high": np.exp(line + half)}
    return pd.DataFrame(rows | {"exponent": fit.slope})
