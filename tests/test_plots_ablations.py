"""Figures of the ablations, and the committed tables that they are drawn from."""

import numpy as np
import pandas as pd
import pytest

from f3amd_lib.report import plots_ablations as draw
from f3amd_lib.report.records import run_record, write_table


def test_committed_tables_are_found_checked_or_absent(tmp_path, monkeypatch):
    monkeypatch.setattr(draw, "repository_root", lambda: tmp_path)
    assert draw.committed_table("synthetic", "learning") is None
    path = tmp_path / "paper_figures/synthetic/laptop/records/learning.csv"
    record = run_record(profile="laptop", dataset="synthetic", seed=3)
    write_table(path, pd.DataFrame({"model": ["m"], "loss": [0.5]}), record)
    table, read = draw.committed_table("synthetic", "learning")
    assert table["loss"].tolist() == [0.5] and read["seed"] == 3
    assert draw.committed_table("bandai", "learning") is None
    path.write_text(path.read_text().replace("0.5", "0.4"))
    with pytest.raises(ValueError, match="not the table"):
        draw.committed_table("synthetic", "learning")


LEARNED = pd.DataFrame(
    {
        "model": ["F3AMD-FNO-96", "CAMDM", "F3AMD-FNO-96-raw"],
        "held_out_before": [2.0, 3.0, 900.0],
        "held_out_after": [1.0, 0.5, 0.4],
    }
)


def test_learning_goes_from_the_open_dot_to_the_filled_one():
    groups = {"one": ["F3AMD-FNO-96", "not measured"], "two": ["CAMDM"], "none": ["nobody"]}
    axes = draw.learning_dots(LEARNED, groups).axes
    assert [axis.get_title(loc="left") for axis in axes] == ["one", "two"]
    for axis, before, after in zip(axes, (2.0, 3.0), (1.0, 0.5), strict=True):
        line, open_dot, filled = axis.lines
        assert line.get_xdata().tolist() == [before, after]
        assert list(open_dot.get_xdata()) == [before]
        assert open_dot.get_markerfacecolor() == "white"
        assert list(filled.get_xdata()) == [after]
        assert [label.get_text() for label in axis.get_yticklabels()][0] in LEARNED["model"].values
    with pytest.raises(ValueError, match="none of the models"):
        draw.learning_dots(LEARNED, {"none": ["nobody"]})


@pytest.mark.parametrize(
    ("names", "first", "last"), [(["CAMDM"], 0.5, 3.0), (["F3AMD-FNO-96-raw"], 0.5, 1000.0)]
)
def test_learning_ticks_fit_the_values(names, first, last):
    ticks = draw.learning_dots(LEARNED, {"group": names}).axes[0].get_xticks()
    assert (ticks[0], ticks[-1]) == pytest.approx((first, last))
    assert len(ticks) >= 5


def test_sizes_are_coloured_by_family():
    table = pd.DataFrame(
        {
            "model": ["F3AMD-FNO-96", "F3AMD-FNO-96-m4", "F3AMD-Transformer-64-linear", "CAMDM-96"],
            "parameters": [4_000_000, 1_000_000, 500_000, 500_000],
            "mflop_per_evaluation": [60.0, 50.0, 27.0, 78.0],
        }
    )
    axis = draw.size_scatter(table, {"CAMDM-96": ("small CAMDM", 8, 0)}).axes[0]
    points = axis.lines
    assert [float(point.get_xdata()[0]) for point in points] == [4.0, 1.0, 0.5, 0.5]
    assert len({point.get_color() for point in points}) == 4
    assert [text.get_text() for text in axis.texts] == ["small CAMDM"]


def test_parameter_bars_add_up():
    table = pd.DataFrame(
        {
            "model": ["a", "a", "b", "b"],
            "part": ["encoder", "blocks"] * 2,
            "parameters": [1_000_000, 2_000_000, 500_000, 0],
        }
    )
    axis = draw.parameter_bars(table).axes[0]
    ends = sorted(bar.get_x() + bar.get_width() for bar in axis.patches)
    assert ends == [0.5, 0.5, 1.0, 3.0]
    # The first model stands at the top.
    assert [text.get_text() for text in axis.texts] == ["0.50", "3.00"]


def test_ratios_and_savings_are_drawn_as_they_are():
    ratios = pd.DataFrame(
        {
            "variant": ["FiLM", "other"] * 2,
            "kind": ["ours"] * 2 + ["paper"] * 2,
            "ratio": [1.0, 1.5, 1.0, 2.0],
        }
    )
    axis = draw.cost_ratios(ratios).axes[0]
    ours, paper, _ = axis.lines
    assert ours.get_xdata().tolist() == [1.0, 1.5] and paper.get_xdata().tolist() == [1.0, 2.0]
    assert list(ours.get_ydata()) == [1, 0]
    savings = pd.DataFrame({"modes": [17, 4], "parameters": [1, 0.4], "operations": [1, 0.8]})
    reported = pd.DataFrame({"modes": [4], "label": ["many"], "time": [0.9]})
    axis = draw.mode_costs(savings, reported).axes[0]
    assert [list(line.get_ydata()) for line in axis.lines] == [[1, 0.8], [1, 0.4], [0.9]]


def test_levels_that_were_trained_on_are_marks_or_a_line():
    levels = {"CAMDM, 1 step": np.array([163.0]), "F3AMD, 1 step": np.array([128.0])}
    axis = draw.visited_levels(levels, {"CAMDM, 1 step": np.array([0.2, 163.0])}).axes[0]
    line, visited, marks, chosen = axis.lines
    assert line.get_xdata().tolist() == [0.01, 128] and visited.get_xdata().tolist() == [128.0]
    assert marks.get_marker() == "|" and marks.get_xdata().tolist() == [0.2, 163.0]
    assert chosen.get_xdata().tolist() == [163.0] and list(chosen.get_ydata()) == [1]


def test_spectral_variants_show_each_line_once():
    lines = {"a": np.arange(3.0), "b": np.ones(3)}
    figure = draw.spectral_variants(np.ones(3), lines, lines, lines)
    for axis in figure.axes:
        assert [line.get_label() for line in axis.lines] == ["a", "b"]
        assert len({line.get_color() for line in axis.lines}) == 2
