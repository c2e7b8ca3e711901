"""Figures of training and rollout: what they show, and stored results."""

import numpy as np
import pandas as pd
import pytest

from f3amd_lib.report import plots_training as draw
from f3amd_lib.report.records import run_record, write_table

SYSTEMS = ("F3AMD-FNO-32-plus, 8 steps", "F3AMD-FNO-32-plus, 1 step", "F3AMD-FNO-32, 8 steps")


def looks(line):
    return line.get_color(), line.get_linestyle()


def test_systems_beside_each_other_look_different():
    rows = [
        {"label": label, "place": place, "step_cm": 4.0, "acceleration_cm": 1.0}
        for label in ("real", *SYSTEMS)
        for place in range(8)
    ]
    figure = draw.inside_a_window(pd.DataFrame(rows))
    for axis in figure.axes:
        assert len({looks(line) for line in axis.lines}) == len(axis.lines) == 4


def test_a_column_that_a_system_lacks_is_not_drawn():
    rows = [{"label": "real", "round": r, "acceleration_cm": 0.7} for r in (1, 2)]
    rows += [
        {"label": SYSTEMS[0], "round": r, "acceleration_cm": 0.8, "gap_m": 0.1} for r in (1, 2)
    ]
    gap, acceleration = draw.along_a_rollout(pd.DataFrame(rows)).axes
    assert len(gap.lines) == 1 and len(acceleration.lines) == 2


def test_loss_curves_skip_steps_without_a_held_out_figure():
    history = pd.DataFrame(
        {
            "model": "F3AMD-FNO-32",
            "step": [50, 100, 150],
            "sample": [0.3, 0.2, 0.1],
            "position": [0.3, 0.2, 0.1],
            "held_out_sample": [np.nan, 0.4, 0.3],
            "held_out_position": [np.nan, 0.4, 0.3],
        }
    )
    for axis in draw.loss_curves(history).axes:
        training, held_out = axis.lines
        assert training.get_xdata().tolist() == [50, 100, 150]
        assert held_out.get_xdata().tolist() == [100, 150]


def test_error_figure_shows_the_input_as_it_is():
    table = pd.DataFrame(
        {
            "model": "F3AMD-FNO-32",
            "sigma": [0.1, 1.0],
            "x0_error": [0.05, 0.3],
            "joint_error_cm": [1.0, 3.0],
            "input_error": [0.1, 1.0],
        }
    )
    line = draw.error_against_sigma(table).axes[0].lines[0]
    np.testing.assert_array_equal(line.get_xdata(), line.get_ydata())


def test_zero_loss_terms_are_drawn_on_the_edge():
    table = pd.DataFrame(
        {"term": ["a", "b"] * 2, "guess": ["x"] * 2 + ["y"] * 2, "value": [0.0, 1.0, 0.5, 0.2]}
    )
    first, second = draw.loss_terms_by_guess(table, smallest=1e-3).axes[0].lines
    assert first.get_ydata().tolist() == [1e-3, 1.0]
    assert second.get_ydata().tolist() == [0.5, 0.2]


def test_stored_result_says_where_it_comes_from(tmp_path, monkeypatch):
    monkeypatch.setattr(draw, "repository_root", lambda: tmp_path)
    assert "make figures" in draw.stored_result("synthetic", "04_some")
    path = tmp_path / "paper_figures/synthetic/laptop/tables/04_some.csv"
    record = run_record(profile="laptop", dataset="synthetic", seed=0)
    write_table(path, pd.DataFrame({"model": ["m"], "value": [0.5]}), record)
    text = draw.stored_result("synthetic", "04_some")
    assert "profile laptop" in text and "data synthetic" in text and "0.50" in text
    path.write_text(path.read_text().replace("0.5", "0.4"))
    with pytest.raises(ValueError, match="not the table"):
        draw.stored_result("synthetic", "04_some")
