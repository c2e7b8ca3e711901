"""Figures of the sampler notebook: lines hold the numbers given, labels lie where they belong."""

import matplotlib
import numpy as np
import pandas as pd
import pytest
from PIL import Image

from f3amd_lib.diffusion import schedules
from f3amd_lib.profiles import load_profile
from f3amd_lib.report import plots_ablations
from f3amd_lib.report import plots_diffusion as draw
from f3amd_lib.report.records import run_record, write_table


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


def test_flow_lines_lie_over_the_density_of_noisy_data():
    fine, coarse, places = np.array([9.0, 3.0, 1.0]), np.array([9.0, 1.0]), np.linspace(-2, 2, 5)
    exact, steps = np.array([[9.0], [3.0], [1.0]]), np.array([[18.0], [1.0]])
    density = np.array([[1.0, 2, 4, 2, 1], [0, 1, 2, 1, 0], [0, 0, 1, 0, 0]])
    title, behind = "flow", {"places": places, "density": density}
    (axis,) = draw.flow_and_steps(fine, exact, coarse, steps, title, **behind).axes
    scale = np.sqrt(1.0 + fine**2)
    np.testing.assert_allclose(points(axis.lines[0]), [fine, exact[:, 0] / scale])
    np.testing.assert_allclose(points(axis.lines[1]), [coarse, steps[:, 0] / scale[[0, 2]]])
    (contours,) = axis.collections
    # Every level is drawn by its own highest density, so that all of them reach the darkest shade.
    assert contours.get_clim() == (0.0, 1.0)
    (bare,) = draw.flow_and_steps(fine, exact, coarse, steps, title).axes
    assert not bare.collections


MODES = np.array([[-1.0, 0.0], [1.0, 0.0]])
WAY = np.array([[[30.0, 0.0], [-30.0, 3.0]], [[-0.9, 0.0], [0.8, 0.1]]])


def test_film_shows_samples_in_preserving_units_by_where_they_end():
    first, last = draw.film_frames([10.0, 0.0], WAY, MODES)
    for figure, states, sigma in ((first, WAY[0], 10.0), (last, WAY[1], 0.0)):
        (dots,) = figure.axes[0].collections
        np.testing.assert_allclose(dots.get_offsets(), states / np.sqrt(1.0 + sigma**2))
        colors = [matplotlib.colors.to_hex(color) for color in dots.get_facecolors()]
        assert colors == [matplotlib.colors.to_hex(draw.PALETTE[c]) for c in ("purple", "orange")]
    assert [f.axes[0].get_title(loc="left") for f in (first, last)] == ["σ = 10", "σ = 0"]


def test_film_is_an_animated_image_that_opens_on_its_end(tmp_path):
    frames = draw.film_frames([10.0, 1.0, 0.0], WAY[[0, 1, 1]], MODES)
    shown = draw.keep_film(frames, tmp_path, "walk", milliseconds=80)
    path = tmp_path / "media" / "walk.png"
    assert path.read_bytes() == shown.data
    film = Image.open(path)
    pictures, durations = [], []
    for frame in range(film.n_frames):
        film.seek(frame)
        pictures.append(np.asarray(film.convert("RGB")).astype(int))
        durations.append(film.info["duration"])
    assert len(pictures) == 4 and durations[0] > 1000 and set(durations[1:]) == {80.0}
    np.testing.assert_array_equal(pictures[0], pictures[-1])
    assert np.abs(pictures[0] - pictures[1]).max() > 100
    again = draw.keep_film(draw.film_frames([10.0, 1.0, 0.0], WAY[[0, 1, 1]], MODES), tmp_path, "b",
                           milliseconds=80)  # fmt: skip
    assert again.data == shown.data
    with pytest.raises(ValueError, match="at least 2 figures, got 1"):
        draw.keep_film(frames[:1], tmp_path, "short")


def test_what_both_updates_show_is_drawn_in_preserving_units():
    sigmas = np.array([np.sqrt(99.0), np.sqrt(3.0)])
    shown = {"rescaled": np.array([[20.0], [3.0]]), "literal": np.array([[20.0], [0.5]])}
    left = {2: np.array([1.0, 0.9]), 3: np.array([1.0, 0.1, 0.01])}
    right, literal, noise = draw.two_updates(sigmas, shown, left).axes
    np.testing.assert_allclose(points(right.lines[0]), [sigmas, [2.0, 1.5]])
    np.testing.assert_allclose(points(literal.lines[0]), [sigmas, [2.0, 0.25]])
    np.testing.assert_array_equal(points(noise.lines[0]), [[1, 2], left[2]])
    np.testing.assert_array_equal(points(noise.lines[1]), [[1, 2, 3], left[3]])
    assert set(noise.lines[2].get_ydata()) == {1.0} and noise.get_yscale() == "log"
    assert right.lines[0].get_marker() != literal.lines[0].get_marker()


def test_collapse_has_a_line_for_each_update_and_one_for_the_data():
    table = pd.DataFrame(
        {
            "update": ["rescaled"] * 2 + ["literal"] * 2,
            "steps": [1, 8] * 2,
            "mean_abs": [0.0, 0.7, 0.01, 0.02],
        }
    )
    rescaled, literal, truth = draw.collapse_figure(table, 1.02).axes[0].lines
    np.testing.assert_array_equal(points(rescaled), [[1, 8], [0.0, 0.7]])
    np.testing.assert_array_equal(points(literal), [[1, 8], [0.01, 0.02]])
    assert rescaled.get_linestyle() != literal.get_linestyle()
    assert set(truth.get_ydata()) == {1.02}


def test_noticing_is_drawn_against_the_width_of_the_data():
    table = pd.DataFrame(
        {"width": [0.1, 1.0] * 2, "steps": [4] * 2 + [8] * 2, "apart": [0.01, 0.2, 0.02, 0.5]}
    )
    four, eight, as_wide = draw.noticing_figure(table).axes[0].lines
    np.testing.assert_array_equal(points(four), [[0.1, 1.0], [0.01, 0.2]])
    np.testing.assert_array_equal(points(eight), [[0.1, 1.0], [0.02, 0.5]])
    np.testing.assert_array_equal(*points(as_wide))


def test_errors_have_a_line_for_each_denoiser_and_ticks_where_it_was_trained():
    table = pd.DataFrame(
        {
            "denoiser": ["exact"] * 2 + ["VP"] * 2,
            "sigma": [0.1, 10.0] * 2,
            "x0_error": [0.05, 1.0, 0.4, 1.1],
        }
    )
    floor, network, ticks = draw.error_by_sigma(table, {"VP": [0.2, 5.0, 160.0]}).axes[0].lines
    np.testing.assert_array_equal(points(floor), [[0.1, 10.0], [0.05, 1.0]])
    np.testing.assert_array_equal(points(network), [[0.1, 10.0], [0.4, 1.1]])
    np.testing.assert_array_equal(ticks.get_xdata(), [0.2, 5.0, 160.0])
    assert ticks.get_color() == network.get_color() != floor.get_color()


def window_table():
    rows = [
        (model, update, steps, metric, scale * steps)
        for model, scale in (("F3AMD-FNO-96", 0.1), ("F3AMD-FNO-96-plus", 0.3))
        for update in ("rescaled", "literal")
        for steps in (8, 1)
        for metric in ("seed_spread", "joint_acceleration", "from_rescaled")
    ]
    rows += [
        (model, "real", 0, "joint_acceleration", 0.7)
        for model in ("F3AMD-FNO-96", "F3AMD-FNO-96-plus")
    ]
    return pd.DataFrame(rows, columns=["model", "update", "steps", "metric", "value"])


def test_both_updates_have_a_row_of_panels_for_each_model():
    figure = draw.updates_on_models(window_table())
    assert len(figure.axes) == 6
    spread, acceleration, apart = figure.axes[3:]
    rescaled, literal = spread.lines
    np.testing.assert_allclose(points(rescaled), [[8, 1], [2.4, 0.3]])
    assert rescaled.get_linestyle() != literal.get_linestyle()
    # Real motion has an acceleration, and the rescaled walk no distance from itself.
    assert set(acceleration.lines[2].get_ydata()) == {0.7}
    assert len(spread.lines) == 2 and len(apart.lines) == 1
    assert figure.axes[3].get_title(loc="left") == "F3AMD-FNO-96-plus"
    # The highest point does not lie on the edge.
    assert all(axis.get_ylim()[1] > 1.05 * axis.dataLim.y1 for axis in (spread, apart))


def test_halvings_mark_diversity_apart_and_bar_the_largest_of_the_others():
    table = pd.DataFrame(
        [
            (source, steps, metric, change)
            for source in ("paper, Table 5", "FNO-96,\nliteral")
            for steps in (8, 4)
            for metric, change in (("IRD", 0.04), ("FID", 0.0), ("diversity", 0.9))
        ],
        columns=["source", "steps", "metric", "change"],
    )
    paper, ours = draw.halving_figure(table).axes
    others, diversity, bar = paper.lines[:3]
    np.testing.assert_allclose(sorted(others.get_ydata()), [1e-5, 0.04])  # no change: on the edge
    assert list(diversity.get_ydata()) == [0.9] and diversity.get_marker() == "D"
    assert set(bar.get_ydata()) == {0.04}
    assert [text.get_text() for text in paper.get_xticklabels()] == ["8→4", "4→2"]
    assert paper.lines[0].get_color() != ours.lines[0].get_color()


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


def test_stored_results_are_those_of_the_data_set_then_bandais_and_say_so(tmp_path, monkeypatch):
    monkeypatch.setattr(plots_ablations, "repository_root", lambda: tmp_path)
    found, sentence = draw.stored_result("synthetic", "posterior", "posterior")
    assert found is None
    assert "Not measured yet: `posterior`" in sentence
    assert "`make measure MEASURE=posterior DATA=bandai`" in sentence
    for dataset, value in (("bandai", 1.0), ("synthetic", 2.0)):
        record = run_record(profile=load_profile("laptop", dataset), dataset=dataset, seed=0)
        path = tmp_path / "paper_figures" / dataset / "laptop" / "records" / "posterior.csv"
        write_table(path, pd.DataFrame({"value": [value]}), record)
        found, sentence = draw.stored_result("synthetic", "posterior", "posterior")
        assert found["value"].tolist() == [value]
        assert f"data {dataset}, profile laptop" in sentence
