"""What this project asks of its own models' motion, and whether a record meets it.

The bars are ours, not the paper's: real motion of the same protocol is the measure. They stand in
`quality_bars.csv`: what is compared is written in the figures of `made` motion, of `real` motion, the least distance to
a bad generator (`gap`) and the `accuracy` of the classifier.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd

BAR_MODELS = ("F3AMD-FNO-96", "F3AMD-FNO-96-steady")
"""Models that are asked; the bar on noise is the second's."""


def quality_bars(quality: pd.DataFrame, classifier_accuracy: float) -> pd.DataFrame:
    """Compare measured motion, one denoising step, with what is asked of it.

    Args:
      quality: from `protocol.summarise`, with real motion and the bad generators.
      classifier_accuracy: held-out share of the style classifier, 0 to 1.

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
    fixed = {"accuracy": 100.0 * classifier_accuracy}
    rows = []
    for bar in bars.itertuples():
        column, found = value[bar.metric], {}
        real, broken = column[0, "real"], column[0].drop(index="real")
        for model in BAR_MODELS:
            made = column.get((1, model), np.nan)
            figures = fixed | {"made": made, "real": real, "gap": (made - broken).abs().min()}
            found[model] = pd.eval(bar.compared, local_dict=figures)
        met = [name for name, one in found.items() if pd.eval(f"one {bar.sign} {bar.limit}", local_dict={"one": one})]
        answer = "both" if len(met) == len(found) else ", ".join(met) or "neither"
        known = pd.notna(list(found.values())).any()
        asked = {"bar": bar.bar, "unit": bar.unit, "asked": f"{bar.sign} {bar.limit:g}"}
        rows.append(asked | found | {"met_by": answer if known else "not measured"})
    return pd.DataFrame(rows)
