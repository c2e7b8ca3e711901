"""What this project asks of its own models' motion, and whether a record meets it.

The bars are ours, not the paper's: real motion of the same protocol is the measure.
"""

from __future__ import annotations

import operator

import pandas as pd

BAR_MODELS = ("F3AMD-FNO-96", "F3AMD-FNO-96-plus")
"""Models that are asked; the two bars on noise are the second's."""

_KEYS = ["model", "steps", "metric"]
_MEETS = {">=": operator.ge, "<=": operator.le, "<": operator.lt}


def _nearer_to_real(value: float, real: float, bad: list[float]) -> float:
    """Return the distance to real motion over that to the nearest bad generator."""
    nearest = min(abs(value - other) for other in bad)
    return abs(value - real) / nearest if nearest != 0 else float("inf")


def quality_bars(
    quality: pd.DataFrame, classifier_accuracy: float, continuation_spread: float | None = None
) -> pd.DataFrame:
    """Compare measured motion, one denoising step, with what is asked of it.

    Args:
      quality: from `protocol.summarise`, with real motion and the bad generators.
      classifier_accuracy: held-out share of the style classifier, 0 to 1.
      continuation_spread: spread of real continuations of like history, path and style, cm (see
        `experiments.posterior`); None if it was not measured.

    Returns:
      Columns bar, unit, asked, a figure for each of `BAR_MODELS` (NaN where not measured), and
      met_by: "both", the name of one, "neither", or "not measured" where neither was.

    Raises:
      ValueError: if the table lacks real motion.
    """
    value = quality.set_index(_KEYS)["value"].sort_index()
    models = quality["model"].unique()
    if "real" not in models:
        raise ValueError("the quality table has no rows of real motion: nothing to compare with")
    unlearnt = set(quality[quality["steps"] == 0]["model"])
    bad = [name for name in models if name in unlearnt and name != "real"]

    def of(model: str, metric: str) -> float:
        steps = 0 if model == "real" or model in bad else 1
        return float(value.get((model, steps, metric), float("nan")))

    def share(metric):
        return lambda model: of(model, metric) / of("real", metric)

    def apart(metric):
        return lambda model: abs(of(model, metric) - of("real", metric))

    def nearness(metric):
        others = [of(name, metric) for name in bad]
        return lambda model: _nearer_to_real(of(model, metric), of("real", metric), others)

    def plain(metric, factor=1.0):
        return lambda model: factor * of(model, metric)

    spread = float("nan") if continuation_spread is None else continuation_spread
    rows = (
        ("Style coverage", "%", plain("style_coverage"), ">=", 85.0),
        ("FID: distance to real over that to a bad one", "", nearness("FID"), "<", 1.0),
        ("EMD: distance to real over that to a bad one", "", nearness("EMD"), "<", 1.0),
        ("IRD: distance to real", "cm", apart("IRD"), "<=", 1.5),
        ("IRD excess", "cm", plain("IRD_excess"), "<", 2.0),
        ("Traj. per window", "m", plain("trajectory_error"), "<", 0.10),
        ("Dir. per window", "degrees", plain("direction_error"), "<", 6.0),
        ("Drift over the rollout", "% of the path", plain("path_drift", 100.0), "<", 5.0),
        ("Foot over real", "", share("foot_sliding"), "<=", 1.5),
        (
            "Contact share: distance to real over real",
            "",
            lambda model: apart("contact_share")(model) / of("real", "contact_share"),
            "<=",
            0.2,
        ),
        ("Joint acceleration over real", "", share("joint_acceleration"), "<=", 1.5),
        ("x0 error at sigma 0.1 over that at 128", "", plain("x0_error_ratio"), "<=", 0.5),
        (
            "Seed spread over that of real continuations",
            "",
            lambda model: of(model, "seed_spread") / spread,
            ">=",
            0.25,
        ),
    )
    accuracy = 100.0 * classifier_accuracy
    table = [
        {
            "bar": "Classifier, held-out accuracy",
            "unit": "%",
            "asked": ">= 85",
            **dict.fromkeys(BAR_MODELS, accuracy),
            "met_by": "both" if accuracy >= 85.0 else "neither",
        }
    ]
    for bar, unit, figure, sign, limit in rows:
        found = {model: figure(model) for model in BAR_MODELS}
        known = {model: value for model, value in found.items() if value == value}
        met = [name for name, value in known.items() if _MEETS[sign](value, limit)]
        answer = "both" if len(met) == len(BAR_MODELS) else ", ".join(met) or "neither"
        table.append(
            {
                "bar": bar,
                "unit": unit,
                "asked": f"{sign} {limit:g}",
                **found,
                "met_by": answer if known else "not measured",
            }
        )
    return pd.DataFrame(table)
