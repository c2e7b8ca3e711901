"""Figures of the notebook on one step: lines hold the numbers given, colours tell what happened."""

import numpy as np
import pandas as pd
import pytest
from matplotlib.colors import to_hex

from f3amd_lib.report import plots_one_step as draw
from f3amd_lib.report.figures import PALETTE
from f3amd_lib.training.fork import Fork


def points(line):
    return np.stack([line.get_xdata(), line.get_ydata()])


def labelled(axis):
    return {line.get_label(): line for line in axis.lines if not line.get_label().startswith("_")}


def test_distances_have_a_line_for_each_number_of_steps():
    table = pd.DataFrame(
        [(half, steps, half / steps) for steps in (8, 1) for half in (0.1, 1.0, 10.0)],
        columns=["half_distance", "steps", "distance"],
    )
    (axis,) = draw.distance_from_data(table, 0.1).axes
    lines = labelled(axis)
    np.testing.assert_allclose(points(lines["1 step"]), [[0.1, 1, 10], [0.1, 1, 10]])
    np.testing.assert_allclose(points(lines["8 steps"])[1], np.array([0.1, 1, 10]) / 8)
    np.testing.assert_allclose(points(lines["all in the middle"]), [[0.1, 10], [0.1, 10]])
    assert axis.get_xscale() == axis.get_yscale() == "log"
    assert lines["1 step"].get_marker() != lines["8 steps"].get_marker()


def test_spread_curves_mark_where_half_is_left():
    sigma = np.array([0.1, 1.0, 10.0])
    table = pd.concat(
        pd.DataFrame(
            {
                "half_distance": half,
                "sigma": sigma,
                "posterior_spread": half * np.array([0.2, 0.5, 1.0]),
                "answer_spread": half * np.array([0.1, 0.3, 0.2]),
            }
        )
        for half in (1.0, 4.0)
    )
    left, right = draw.spread_curves(table, {1.0: 1.0, 4.0: np.sqrt(10.0)}).axes
    curve, mark, _, far = left.lines
    np.testing.assert_allclose(points(curve), [sigma, [0.2, 0.5, 1.0]])
    np.testing.assert_allclose(points(mark).ravel(), [1.0, 0.5])
    np.testing.assert_allclose(points(far).ravel(), [np.sqrt(10.0), 4 * 0.75])
    lines = labelled(right)
    np.testing.assert_allclose(points(lines["±4"])[1], [0.4, 1.2, 0.8])
    assert curve.get_color() == lines["±1"].get_color() != lines["±4"].get_color()
    assert left.get_ylim() == right.get_ylim()


def continuations(scale=1.0):
    return pd.DataFrame(
        {
            "given": ["style", "style, path", "style, path, history"],
            "value": scale * np.array([12.0, 9.0, 3.0]),
            "low": scale * np.array([11.0, 8.0, np.nan]),
            "high": scale * np.array([13.0, 10.0, np.nan]),
            "history_apart": [20.0, 18.0, 4.0],
        }
    )


def test_bars_of_continuations_are_as_long_as_their_spread():
    figure = draw.continuation_bars({"one": continuations(), "other": continuations(2.0)})
    for axis, scale, title in zip(figure.axes, (1.0, 2.0), ("one", "other"), strict=True):
        widths = [bar.get_width() for bar in axis.patches]
        np.testing.assert_allclose(widths, scale * np.array([12.0, 9.0, 3.0]))
        texts = [text.get_text() for text in axis.texts]
        assert texts[2] == f"{3 * scale:.1f}  (histories 4 apart)"
        assert axis.get_title(loc="left") == title and "cm" in axis.get_xlabel()
        assert axis.get_xlim()[1] > 1.3 * 13 * scale
    names = [text.get_text() for text in figure.axes[0].get_yticklabels()]
    assert names == list(continuations()["given"])
    assert figure.axes[0].yaxis_inverted()  # the first row on top


def test_models_have_a_panel_each_beside_the_last_row_of_real_motion():
    rows = [
        {"model": model, "quantity": quantity, "sigma": sigma, "value": value, "low": 0.9 * value,
         "high": 1.1 * value, "given": "style, path, history"}
        for model, shift in (("F3AMD-FNO-96", 1.0), ("F3AMD-FNO-96-plus", 2.0))
        for quantity, size in (("error", 3.0), ("answer spread", 1.0))
        for sigma, value in ((0.1, shift * size), (10.0, 2 * shift * size))
    ]  # fmt: skip
    real = continuations().assign(model="real", quantity="continuations")
    table = pd.concat([real.fillna({"low": 2.5, "high": 3.5}), pd.DataFrame(rows)])
    figure = draw.answers_against_sigma(table)
    assert [axis.get_title(loc="left") for axis in figure.axes] == [
        "F3AMD-FNO-96",
        "F3AMD-FNO-96-plus",
    ]
    for axis, shift in zip(figure.axes, (1.0, 2.0), strict=True):
        lines = labelled(axis)
        np.testing.assert_allclose(points(lines["error"]), [[0.1, 10], [3 * shift, 6 * shift]])
        np.testing.assert_allclose(points(lines["answer spread"])[1], [shift, 2 * shift])
        assert set(lines["real continuations"].get_ydata()) == {3.0}
        assert axis.get_ylim()[0] == 0


# ------------------------------------------------------------------------------------ the fork

FORK = Fork()
AHEAD = np.linspace(-2, 2, 5)


def straight(at):
    return np.stack([np.full(5, float(at)), AHEAD], axis=-1)


def drawn(axis):
    """Colour of every path on an axis by where it starts, and whether it is dashed."""
    return {
        line.get_xdata()[0]: (to_hex(line.get_color()).upper(), line.get_linestyle())
        for line in axis.lines
        if len(line.get_xdata()) == 5
    }


def test_paths_have_the_colour_of_what_becomes_of_them():
    short = np.stack([np.full(5, -1.1), AHEAD - 3.0], axis=-1)
    paths = np.stack([straight(1.2), straight(-1.3), straight(0.2), short])
    figure = draw.outcome_grid(FORK, {"exact": {"1 step": paths, "8 steps": paths[:1]}})
    first, second = figure.axes
    colours = drawn(first)
    assert colours[1.2] == (PALETTE["purple"], "-")
    assert colours[-1.3] == (PALETTE["orange"], "-")
    assert colours[0.2] == (PALETTE["vermilion"], "--") == colours[-1.1]
    assert list(drawn(second)) == [1.2]
    # The walker's left is on the left of the page, and the wall is drawn to scale.
    assert first.get_xlim()[0] > 0 > first.get_xlim()[1] and first.get_aspect() == 1.0
    wall = next(line for line in first.lines if line.get_linewidth() == 5)
    assert list(wall.get_xdata()) == [-FORK.wall, FORK.wall] and set(wall.get_ydata()) == {0}


def test_the_grid_has_a_row_for_each_model_and_a_column_for_each_way():
    rows = {name: {"1 step": straight(1)[None], "told": straight(-1)[None]} for name in "ab"}
    figure = draw.outcome_grid(FORK, rows)
    assert len(figure.axes) == 4
    assert [axis.get_title(loc="left") for axis in figure.axes] == ["1 step", "told", "", ""]
    assert figure.axes[2].get_ylabel().startswith("b")


def test_the_plan_shows_the_mean_of_all_paths():
    (axis,) = draw.fork_plan(FORK, np.stack([straight(1.2), straight(-1.2)])).axes
    middle = next(line for line in axis.lines if len(line.get_xdata()) == FORK.num_frames)
    np.testing.assert_allclose(points(middle).T, FORK.mean_paths.mean(axis=0))
    entries = [text.get_text() for text in axis.get_legend().get_texts()]
    assert entries == ["passes left", "passes right", "mean of all paths", "wall"]


def outcomes():
    rows = [
        {"noise": noise, "input": name, "steps": steps, "told": told, "wall": wall}
        for noise, shift in (("VE", 0.0), ("VP", 0.1))
        for name, worst in (("exact", 0.5), ("c_in", 0.6), ("raw", 0.7))
        for steps, told, wall in (
            (1, False, 1.0), (8, False, worst - shift), (1, True, 0.0), (8, True, worst / 100)
        )
    ]  # fmt: skip
    return pd.DataFrame(rows)


def test_wall_shares_are_drawn_in_per_cent_and_the_worst_of_those_told():
    figure = draw.wall_shares(outcomes())
    for axis, shift in zip(figure.axes, (0.0, 0.1), strict=True):
        lines = labelled(axis)
        np.testing.assert_allclose(
            points(lines["exact denoiser"]), [[1, 8], [100, 50 - 100 * shift]]
        )
        np.testing.assert_allclose(points(lines["trained, raw"])[1], [100, 70 - 100 * shift])
        np.testing.assert_allclose(points(lines["side told, worst of all"])[1], [0, 0.7])
    colours = {line.get_color() for line in labelled(figure.axes[0]).values()}
    assert len(colours) == 4


def test_errors_lie_beside_the_exact_one_and_the_blind_one():
    table = pd.DataFrame(
        [
            (noise, name, sigma, size * sigma)
            for noise in ("VE", "VP")
            for name, size in (("exact", 0.1), ("c_in", 0.2))
            for sigma in (1.0, 2.0)
        ],
        columns=["noise", "input", "sigma", "x0_error"],
    )
    figure = draw.errors_beside_exact(table, 0.6)
    for axis in figure.axes:
        lines = labelled(axis)
        np.testing.assert_allclose(points(lines["exact denoiser"]), [[1, 2], [0.1, 0.2]])
        np.testing.assert_allclose(points(lines["trained, c_in"]), [[1, 2], [0.2, 0.4]])
        assert set(lines["ignores its input"].get_ydata()) == {0.6}
        assert axis.get_ylim()[0] == 0 and axis.get_ylim()[1] == pytest.approx(0.81)
