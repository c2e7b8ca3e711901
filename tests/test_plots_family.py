"""Figures of the trained family draw the numbers they are given."""

import numpy as np
import pandas as pd
import pytest

from f3amd_lib.drawing import plots_family
from f3amd_lib.drawing.style import model_style


def lines(axis) -> dict:
    return {line.get_label(): line for line in axis.lines}


def test_held_out_curves_leave_out_what_was_not_measured():
    history = pd.DataFrame(
        {
            "windows": [100, 200, 300],
            "held_out_position": [4.0, np.nan, 1.0],
            "held_out_joint_velocity": [0.4, np.nan, 0.1],
        }
    )
    figure = plots_family.held_out_curves({"CAMDM": history})
    line = lines(figure.axes[0])["CAMDM"]
    np.testing.assert_array_equal(line.get_xdata(), [100, 300])
    np.testing.assert_array_equal(line.get_ydata(), [4.0, 1.0])
    assert line.get_color() == model_style("CAMDM").color
    assert figure.axes[1].get_yscale() == "log"
    figure.draw_without_rendering()
    assert {"100", "200"} <= {label.get_text() for label in figure.axes[0].get_xticklabels()}
    with pytest.raises(ValueError, match="CAMDM has no column 'windows'"):
        plots_family.held_out_curves({"CAMDM": history.drop(columns="windows")})


def test_error_by_noise_draws_a_line_per_model_in_order_of_sigma():
    table = pd.DataFrame(
        {"model": ["a", "a", "b", "b"], "sigma": [128.0, 0.1, 0.1, 128.0],
         "x0_error": [0.4, 0.1, 0.3, 0.3]}
    )  # fmt: skip
    axis = plots_family.error_by_noise(table).axes[0]
    found = lines(axis)
    np.testing.assert_array_equal(found["a"].get_xdata(), [0.1, 128.0])
    np.testing.assert_array_equal(found["a"].get_ydata(), [0.1, 0.4])
    own = found["the input's own"]
    np.testing.assert_array_equal(own.get_xdata(), own.get_ydata())
    assert axis.get_ylim()[1] < 1.0


def test_steps_beside_real_marks_eight_and_one():
    rows = [
        ("real", 0, 2.0), ("CAMDM", 8, 3.0), ("CAMDM", 1, 4.0), ("CAMDM", 2, 9.0),
    ]  # fmt: skip
    table = pd.DataFrame(rows, columns=["model", "steps", "value"]).assign(
        metric="FID", low=lambda frame: frame["value"] - 0.5, high=lambda frame: frame["value"] + 0.5
    )
    axis = plots_family.steps_beside_real(table, {"FID": "FID"}).axes[0]
    points = [(c.lines[0].get_xdata()[0], c.lines[0].get_markerfacecolor()) for c in axis.containers]
    assert [value for value, _ in points] == [3.0, 4.0]
    assert points[0][1] != "white" and points[1][1] == "white"
    assert [text.get_text() for text in axis.get_yticklabels()] == ["CAMDM"]
    dashed = [line for line in axis.lines if line.get_linestyle() == "--"]
    assert dashed and dashed[0].get_xdata()[0] == 2.0
    with pytest.raises(ValueError, match="no metric 'EMD'"):
        plots_family.steps_beside_real(table, {"EMD": "EMD"})
