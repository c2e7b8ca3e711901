"""What this project asks of its own models' motion, and whether a record meets it.

The bars are ours, not the paper's: real motion of the same protocol is the measure. They stand in
`quality_bars.csv`.
"""

from __future__ import annotations

import operator
from pathlib import Path

import numpy as np
import pandas as pd

BAR_MODELS = ("F3AMD-FNO-96", "F3AMD-FNO-96-steady")
"""Models that are asked; the two bars on noise are the second's."""

_MEETS = {">=": operator.ge, "<=": operator.le, "<": operator.lt}


def quality_bars(
    quality: pd.DataFrame, classifier_accuracy: float, continuation_spread: float | None = None
) -> pd.DataFrame:
    """Compare measured motion, one denoising step, with what is asked of it.

    Args:
      quality: from `protocol.summarise`, with real motion and the bad generators.
      classifier_accuracy: held-out share of the style classifier, 0 to 1.
      continuation_spread: spread of real continuations of like history, path and style, cm (see
        `measuring.posterior`); None if it was not measured.

    Returns:
      Columns bar, unit, asked, a figure for each of `BAR_MODELS` (NaN where not measured), and
      met_by: "both", the name of one, "neither", or "not measured" where neither was.

    Raises:
      ValueError: if the table lacks real motion.
    """
    bars = pd.read_csv(Path(__file__).with_suffix(".csv"), keep_default_na=False)
    value = quality.pivot_table(index=["steps", "model"], columns="metric", values="value")
    value = value.reindex(columns=bars["metric"])
    if (0, "real") not in value.index:
        raise ValueError("the quality table has no rows of real motion: nothing to compare with")
    real, broken = value.loc[0].loc["real"], value.loc[0].drop(index="real")
    spread = np.nan if continuation_spread is None else continuation_spread
    accuracy = {"bar": "Classifier, held-out accuracy", "unit": "%", "asked": ">= 85"}
    rows = [accuracy | _answers(dict.fromkeys(BAR_MODELS, 100.0 * classifier_accuracy), ">=", 85.0)]
    for bar in bars.itertuples():
        made = value[bar.metric].reindex([(1, model) for model in BAR_MODELS])
        found = {
            model: _compare(bar.compared, figure, real[bar.metric], broken[bar.metric], spread)
            for (_, model), figure in made.items()
        }
        asked = {"bar": bar.bar, "unit": bar.unit, "asked": f"{bar.sign} {bar.limit:g}"}
        rows.append(asked | _answers(found, bar.sign, bar.limit))
    return pd.DataFrame(rows)


def _compare(how: str, made: float, real: float, broken: pd.Series, spread: float) -> float:
    """Say how a figure of a model stands beside those of real and of broken motion."""
    if how == "nearness to real":
        return abs(made - real) / (made - broken).abs().min()
    figure = abs(made - real) if how in ("distance to real", "distance over real") else made
    wholes = {"share of continuations": spread, "share of real": real, "distance over real": real}
    return 100.0 * made if how == "percent" else figure / wholes.get(how, 1.0)


def _answers(found: dict, sign: str, limit: float) -> dict:
    """Figures of models, and who meets the bar."""
    met = [name for name, value in found.items() if _MEETS[sign](value, limit)]
    answer = "both" if len(met) == len(found) else ", ".join(met) or "neither"
    return found | {"met_by": answer if pd.notna(list(found.values())).any() else "not measured"}
