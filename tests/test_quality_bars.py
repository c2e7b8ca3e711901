"""Bars of our own: figures that meet them, figures that miss them, figures that are not there."""

import pandas as pd
import pytest
from builders import refused
from f3amd_notebooks.quality_tables import BAR_MODELS, quality_bars

REAL = {
    "style_coverage": 99.0, "FID": 10.0, "EMD": 5.0, "IRD": 4.0, "IRD_excess": 0.7,
    "trajectory_error": 0.03, "direction_error": 4.0, "foot_sliding": 0.1, "contact_share": 0.4,
    "joint_acceleration": 0.6,
}  # fmt: skip
MADE = REAL | {
    "path_drift": 0.01, "x0_error_ratio": 0.2, "FID": 12.0, "EMD": 5.5,
    "foot_sliding": 0.14, "contact_share": 0.45,
}  # fmt: skip


def table(**figures) -> pd.DataFrame:
    rows = {("real", 0): REAL, ("frozen pose", 0): REAL | {"FID": 100.0, "EMD": 11.0}}
    rows |= {(model, 1): MADE | figures for model in BAR_MODELS}
    rows[BAR_MODELS[1], 8] = dict.fromkeys(MADE, 1e6)  # eight steps are not asked
    cells = [(*row, *cell) for row, values in rows.items() for cell in values.items()]
    return pd.DataFrame(cells, columns=["model", "steps", "metric", "value"])


def met_by(frame: pd.DataFrame) -> dict:
    return frame.set_index("bar")["met_by"].to_dict()


def test_good_figures_meet_every_bar():
    bars = quality_bars(table(), 0.9)
    assert set(bars["met_by"]) == {"both"} and len(bars) == 13
    steady = bars.set_index("bar")["F3AMD-FNO-96-steady"]
    assert steady["Classifier, held-out accuracy"] == pytest.approx(90.0)
    assert steady["FID: distance to real over a bad one's"] == pytest.approx(2.0 / 90.0)
    assert steady["Foot over real"] == pytest.approx(1.4)
    assert steady["Drift over the rollout"] == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("metric", "value", "bar"),
    [
        ("style_coverage", 80.0, "Style coverage"),
        ("FID", 70.0, "FID: distance to real over a bad one's"),
        ("IRD", 6.0, "IRD: distance to real"),
        ("path_drift", 0.06, "Drift over the rollout"),
        ("foot_sliding", 0.16, "Foot over real"),
        ("contact_share", 0.5, "Contact share: distance to real over real"),
    ],
)
def test_a_bad_figure_misses_its_bar_and_no_other(metric, value, bar):
    found = met_by(quality_bars(table(**{metric: value}), 0.9))
    assert [name for name, answer in found.items() if answer != "both"] == [bar]
    assert found[bar] == "neither"


def test_what_was_not_measured_is_said():
    bars = met_by(quality_bars(table(), 0.5))
    assert bars["Classifier, held-out accuracy"] == "neither"
    frame = table()
    alone = met_by(quality_bars(frame[~frame["model"].isin(BAR_MODELS)], 0.9))
    assert alone.pop("Classifier, held-out accuracy") == "both"
    assert set(alone.values()) == {"not measured"}
    refused("no rows of real motion", quality_bars, frame[frame["model"] != "real"], 0.9)
