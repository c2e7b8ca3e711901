"""The paper's quality tables with ours under each row, on made-up figures."""

import numpy as np
import pandas as pd
import pytest
from f3amd_notebooks import quality_tables

from f3amd_lib.ground.papers import load_paper_table
from f3amd_lib.networks import presets

UNITS = {"style_coverage": "%", "trajectory_error": "m", "direction_error": "deg", "diversity": "cm", "IRD": "cm"}


def figures(model="F3AMD-FNO-96", steps=8, window_frames=32, value=10.0, half=1.0, metrics=None):
    """Rows of one system, as `protocol.summarise` makes them."""
    shared = {"model": model, "window_frames": window_frames, "steps": steps, "better": "near real", "repeats": 5}
    rows = [
        shared | {"metric": metric, "unit": UNITS.get(metric, "")}
        | {"value": value + number, "low": value + number - half, "high": value + number + half}
        for number, metric in enumerate(metrics or quality_tables.FIGURES)
    ]  # fmt: skip
    return pd.DataFrame(rows)


def table_of(*parts):
    return pd.concat(parts, ignore_index=True)


LABEL = "tiny, smoke"
REAL = figures("real", 0, metrics=[metric for metric in quality_tables.FIGURES if metric != "diversity"])
QUALITY = table_of(
    REAL, figures("frozen pose", 0, value=3.0), figures(), figures(steps=1, value=20.0),
    figures("CAMDM-code", value=30.0), figures("F3AMD-FNO-96-steady", value=77.0),
)  # fmt: skip


def line_of(rows, source, **where):
    for column, wanted in where.items():
        rows = rows[rows[column] == wanted]
    return rows[rows["source"] == source].set_index("metric")


@pytest.mark.parametrize("number", quality_tables.QUALITY_TABLES)
def test_every_row_of_the_paper_is_there_as_printed_with_ours_below(number):
    printed = load_paper_table(number)
    printed = printed[printed["metric"].isin(quality_tables.FIGURES)]
    rows = quality_tables.beside_paper(number, QUALITY, LABEL)
    assert (rows.groupby("line").size() == 9).all()
    papers = rows[rows["source"] == quality_tables.PAPER_SOURCE]
    columns = ["model", "window_frames", "steps", "metric", "unit", "better", "printed", "value"]
    pd.testing.assert_frame_equal(papers[columns].reset_index(drop=True), printed[columns].reset_index(drop=True))
    for line, cells in papers.groupby("line"):
        ours = rows[rows["line"] == line + 1]
        assert set(ours["source"]) == {LABEL}
        assert set(ours["model"]) == {presets.find_preset(cells["model"].iloc[0]).name}
        assert set(ours["steps"]) == set(cells["steps"])
        assert set(ours["window_frames"]) == set(cells["window_frames"])


def test_table_5_ours_are_means_with_intervals_and_the_rest_is_not_measured():
    rows = quality_tables.beside_paper(5, QUALITY, LABEL)
    one_step = line_of(rows, LABEL, model="F3AMD-FNO-96", steps=1)
    assert one_step.loc["EMD", ["value", "low", "high"]].tolist() == [21.0, 20.0, 22.0]
    assert one_step.loc["EMD", "printed"] == "21.00 ± 1.00"
    assert one_step.loc["IRD", "better"] == "down"  # the paper's arrow, not ours
    assert (line_of(rows, LABEL, model="F3AMD-FNO-96", steps=4)["printed"] == quality_tables.NOT_MEASURED).all()
    assert line_of(rows, LABEL, model="CAMDM", steps=8)["value"].isna().all()


def test_the_papers_names_are_ours_by_find_preset_and_ours_alone_are_in_no_row_of_the_paper():
    pytorch = line_of(quality_tables.beside_paper(6, QUALITY, LABEL), LABEL, model="CAMDM-code")
    assert pytorch.loc["FID", "value"] == 30.0
    many = quality_tables.beside_paper(10, QUALITY, LABEL)
    assert line_of(many, LABEL, model="F3AMD-FNO-96").loc["FID", "value"] == 10.0
    for number in quality_tables.QUALITY_TABLES:
        assert "F3AMD-FNO-96-steady" not in set(quality_tables.beside_paper(number, QUALITY, LABEL)["model"])


def test_rows_of_the_queue_are_means_over_trainings():
    def trained(seed, value, model="F3AMD-FNO-96", recipe="paper", windows=1000):
        rows = figures(model, value=value).drop(columns=["low", "high", "repeats", "better"])
        return rows.assign(seed=seed, recipe=recipe, windows=windows)

    campaign = table_of(
        trained(0, 10.0), trained(0, 50.0, "F3AMD-FNO-96-m4"), trained(1, 14.0),
        trained(0, 900.0, recipe="mixed-noise"), trained(0, 900.0, windows=2000),
    )  # fmt: skip
    rows = quality_tables.of_queue(campaign, 1000).set_index(["model", "metric"])
    assert set(rows.index.get_level_values(0)) == {"F3AMD-FNO-96", "F3AMD-FNO-96-m4"}
    seen = rows.loc[("F3AMD-FNO-96", "FID")]  # of two trainings: mean, and Student's interval, 12.7 s / sqrt 2
    assert seen["value"] == 12.0 and seen["repeats"] == 2
    assert seen["high"] - seen["value"] == pytest.approx(12.706 * np.std([10, 14], ddof=1) / np.sqrt(2), rel=1e-3)
