"""Figures of the sampler notebook: lines hold the numbers given, labels lie where they belong."""

import numpy as np
import pandas as pd
import pytest

from f3amd_lib.diffusion import schedules
from f3amd_lib.report import plots_diffusion as draw


def tick_labels(axis):
    """Number on each tick of a vertical axis -> where it lies."""
    texts = [text.get_text().replace("−", "-") for text in axis.get_yticklabels()]
    return dict(zip(map(float, texts), axis.get_yticks(), strict=True))


def points(line):
    return np.stack([line.get_xdata(), line.get_ydata()])


def test_three_labels_name_the_same_noise_level():
    cosine = schedules.VariancePreservingCosine(4)
    time = np.array([0.75, 0.5, 0.25, 0.0])
    many = np.linspace(0.0, 1.0, 50)
    exploding = schedules.VarianceExploding().sigma(many)
    figure = draw.schedule_lines({"VE": (many, exploding), "VP": (time, cosine.sigmas)})
    axis, share, ratio = figure.axes
    np.testing.assert_array_equal(points(axis.lines[0]), [many, exploding])
    np.testing.assert_array_equal(points(axis.lines[1]), [time, cosine.sigmas])
    # Levels that a network knows one by one are marks, a continuum is a line.
    assert [line.get_marker() != "" for line in axis.lines[:2]] == [False, True]
    for other in (share, ratio):
        assert other.get_ylim() == axis.get_ylim() and other.get_yscale() == "log"
    for label, sigma in tick_labels(share).items():
        assert schedules.alpha_bar_from_sigma(sigma) == pytest.approx(label, rel=1e-9)
    for label, sigma in tick_labels(ratio).items():
        assert schedules.log_snr_from_sigma(sigma) == pytest.approx(label, abs=1e-9)
    assert tick_labels(share)[0.5] == tick_labels(ratio)[0.0] == pytest.approx(1.0)


def test_step_positions_are_rows_of_noise_levels():
    cosine = schedules.VariancePreservingCosine(8)
    grids = {"VE": {2: [128.0, 0.01], 1: [128.0]}, "VP": {2: cosine.grid(2)[:-1], 1: [163.4]}}
    exploding, preserving = draw.step_positions(grids, {"VP": cosine.sigmas}).axes
    np.testing.assert_array_equal(points(exploding.lines[0]), [[128.0, 0.01], [0, 0]])
    np.testing.assert_array_equal(points(exploding.lines[1]), [[128.0], [1]])
    assert [text.get_text() for text in exploding.get_yticklabels()] == ["N = 2", "N = 1"]
    # All levels of the schedule are shown behind those that are visited.
    (levels,) = preserving.collections
    np.testing.assert_array_equal([line[0, 0] for line in levels.get_segments()], cosine.sigmas)
    assert not exploding.collections


def test_paths_lie_over_each_other_only_after_rescaling():
    sigmas, z = np.array([10.0, 1.0, 0.1]), np.array([[0.3], [0.2], [1.0]])
    x = z * np.sqrt(1.0 + sigmas**2)[:, None]
    raw, preserving, both = draw.sample_paths(sigmas, x, z).axes
    np.testing.assert_array_equal(raw.lines[0].get_ydata(), x[:, 0])
    np.testing.assert_array_equal(preserving.lines[0].get_ydata(), z[:, 0])
    np.testing.assert_allclose(both.lines[0].get_ydata(), both.lines[1].get_ydata(), rtol=1e-15)


def convergence_table():
    rows = [
        (sampler, data, steps, steps if sampler == "Euler" else 2 * steps - 1, scale / steps)
        for data, scale in (("wide", 1.0), ("narrow", 0.1))
        for sampler in ("Euler", "Heun")
        for steps in (4, 8, 16)
    ]
    return pd.DataFrame(rows, columns=["sampler", "data", "steps", "evaluations", "error"])


def test_convergence_is_drawn_against_steps_and_against_evaluations():
    orders = {
        (sampler, data): order
        for sampler, order in (("Euler", 1.0), ("Heun", 2.04))
        for data in ("wide", "narrow")
    }
    figure = draw.convergence_figure(convergence_table(), orders)
    by_steps, by_evaluations = ({line.get_label(): line for line in a.lines} for a in figure.axes)
    heun = "Heun, wide: order 2.04"
    np.testing.assert_allclose(points(by_steps[heun]), [[4, 8, 16], [1 / 4, 1 / 8, 1 / 16]])
    np.testing.assert_allclose(points(by_evaluations[heun]), [[7, 15, 31], [1 / 4, 1 / 8, 1 / 16]])
    euler = "Euler, narrow: order 1.00"
    np.testing.assert_array_equal(points(by_steps[euler]), points(by_evaluations[euler]))
    assert by_steps[heun].get_color() != by_steps[euler].get_color()
    assert by_steps[heun].get_linestyle() != by_steps[euler].get_linestyle()


def test_walks_are_drawn_in_the_preserving_state_with_the_last_level_at_zero():
    sigmas, modes = np.array([np.sqrt(99.0), np.sqrt(3.0), 0.0]), [-1.0, 1.0]
    states = np.array([[5.0, 5.0], [1.0, -4.0], [0.9, -1.1]])
    (axis,) = draw.fresh_noise_walks(sigmas, {"DDPM": states}, modes, 0.3).axes
    up, _, down, _, first = axis.lines
    np.testing.assert_allclose(points(up), [[0, 1, 2], [0.5, 0.5, 0.9]])
    np.testing.assert_allclose(points(down), [[0, 1, 2], [0.5, -2.0, -1.1]])
    np.testing.assert_allclose(points(first), [[0], [0.5]])
    assert up.get_color() != down.get_color()
    assert [text.get_text() for text in axis.get_xticklabels()] == ["9.9", "1.7", "0"]


def test_spread_lines_are_the_recursion_and_marks_the_samples():
    table = pd.DataFrame(
        {
            "sampler": ["DDIM"] * 2 + ["DDPM"] * 2,
            "steps": [4, 8] * 2,
            "exact": [0.44, 0.55, 0.34, 0.46],
            "measured": [0.45, 0.54, 0.33, 0.47],
        }
    )
    axes = draw.spread_left_figure({"one": table, "other": table.assign(exact=0.5)}).axes
    for axis, exact in zip(axes, ([0.34, 0.46], [0.5, 0.5]), strict=True):
        # For each sampler: a line, marks, an entry of the legend.
        line, marks = axis.lines[3:5]
        np.testing.assert_array_equal(points(line), [[4, 8], exact])
        np.testing.assert_array_equal(points(marks), [[4, 8], [0.33, 0.47]])
        assert marks.get_linestyle() == "None" and line.get_linestyle() == "-"
        assert axis.lines[6].get_ydata() == [1.0, 1.0]


def test_collapse_has_a_line_for_each_form_and_one_for_the_data():
    table = pd.DataFrame(
        {
            "form": ["rescaled"] * 2 + ["to the letter"] * 2,
            "steps": [1, 8] * 2,
            "mean_abs": [0.0, 0.7, 0.01, 0.02],
        }
    )
    rescaled, literal, truth = draw.collapse_figure(table, 1.02).axes[0].lines
    np.testing.assert_array_equal(points(rescaled), [[1, 8], [0.0, 0.7]])
    np.testing.assert_array_equal(points(literal), [[1, 8], [0.01, 0.02]])
    assert set(truth.get_ydata()) == {1.02}


def test_histograms_of_samples_and_data_have_the_same_bins_and_lose_nobody():
    data, far = np.array([-1.0, 1.0, 1.0, 1.0]), np.array([-9.0, 9.0])
    (axis,) = draw.sample_histograms(data, {"one step": far}).axes
    *bars, outline = axis.patches
    assert sum(bar.get_height() for bar in bars) == pytest.approx(1.0)
    assert max(bar.get_height() for bar in bars) == pytest.approx(0.75)
    # Samples beyond the axis are put into its outermost bins.
    heights = outline.get_xy()
    assert heights[:, 1].max() == pytest.approx(0.5)
    assert heights[:, 0].min() == pytest.approx(-1.6) and heights[:, 0].max() == pytest.approx(1.6)
