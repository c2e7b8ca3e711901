"""Figures of motion quality: that they show what they are given, where a reader looks for it."""

import matplotlib.colors
import numpy as np
import pandas as pd
import pytest
from builders import straight_motion, wandering_motion

from f3amd_lib.evaluation.corruptions import CORRUPTIONS
from f3amd_lib.evaluation.paths import named_path
from f3amd_lib.report import plots_quality as draw
from f3amd_lib.report.figures import model_style
from f3amd_lib.report.quality_tables import FIGURES

GENERATORS = ("real", *CORRUPTIONS)


def same_color(first, second) -> bool:
    return matplotlib.colors.same_color(first, second)


def points(axis, marker="o"):
    """(x, y) of the single markers of an axis."""
    return [
        (line.get_xdata()[0], line.get_ydata()[0])
        for line in axis.lines
        if line.get_marker() == marker and len(line.get_xdata()) == 1
    ]


def titles(figure):
    return [axis.get_title(loc="left") for axis in figure.axes]


def test_every_bad_generator_has_a_colour_that_no_network_has():
    assert set(draw.BAD_COLORS) == set(CORRUPTIONS)
    for color in draw.BAD_COLORS.values():
        for model in ("F3AMD-FNO-96", "F3AMD-Transformer-64", "CAMDM"):
            assert not same_color(color, model_style(model).color)


def test_poses_stand_in_a_row_with_a_head_only_where_there_is_one():
    motions = {"real": wandering_motion(20), "frozen pose": straight_motion(20)}
    figure = draw.poses_beside(motions, [0, 5, 10])
    assert titles(figure) == list(motions)
    bones = motions["real"].skeleton.num_joints - 1
    for axis in figure.axes:
        assert len(axis.lines) == 3 * bones + 1  # and the ground
    # The hips of the stiff figure stand where the poses stand.
    hips = {round(float(line.get_xdata()[0]), 6) for line in figure.axes[1].lines[:-1:bones]}
    assert hips == {0.0, 0.95, 1.9}


def test_a_pose_panel_may_stay_empty():
    motions = {"real": wandering_motion(20), "": None, "frozen pose": straight_motion(20)}
    figure = draw.poses_beside(motions, [0, 5])
    assert titles(figure) == ["real", "", "frozen pose", ""]
    assert [bool(axis.lines) for axis in figure.axes] == [True, False, True, False]
    assert not any(axis.axison for axis in figure.axes)


def test_verdict_grid_colours_a_cell_by_its_verdict():
    table = pd.DataFrame(
        [
            {"metric": "FID", "generator": "frozen pose", "ratio": 3.2, "verdict": "sees it"},
            {"metric": "FID", "generator": "noisy motion", "ratio": 1.1,
             "verdict": "does not notice"},
            {"metric": "Smooth", "generator": "frozen pose", "ratio": np.nan,
             "verdict": "calls it better"},
            {"metric": "Smooth", "generator": "noisy motion", "ratio": 28.0, "verdict": "sees it"},
        ]
    )  # fmt: skip
    (axis,) = draw.verdict_grid(table).axes
    colors = [patch.get_facecolor() for patch in axis.patches]
    assert same_color(colors[0], colors[3]) and len(set(colors)) == 3
    assert [text.get_text() for text in axis.texts] == ["× 3.20", "× 1.10", "–", "× 28"]
    assert [label.get_text() for label in axis.get_yticklabels()] == ["FID", "Smooth"]


def test_drift_picture_shows_both_walkers_in_three_panels():
    target = named_path("complex", 128).position
    walks = {"near": target + 0.01, "far": target + 1.0}
    table = pd.DataFrame(
        [
            {"label": label, "round": number, "error_cm": 2.0, "gap_m": gap * number}
            for label, gap in (("near", 0.0), ("far", 0.5))
            for number in (1, 2, 3, 4)
        ]
    )
    plan, error, gap = draw.drift_picture(target, walks, table).axes
    assert len(plan.lines) == 4  # two walkers, target, start
    assert plan.xaxis_inverted()  # a left turn looks like one
    assert [line.get_ydata()[-1] for line in gap.lines] == [0.0, 2.0]
    assert all((line.get_ydata() == 2.0).all() for line in error.lines)


def test_smoothness_parts_are_a_quotient():
    table = pd.DataFrame(
        {"name": GENERATORS, "joints": [2.0, 1.0, 400.0, 12.0], "root": [1.0, 1.0, 400.0, 6.0]}
    )
    table["smoothness"] = table["joints"] / table["root"]
    left, right = draw.smoothness_parts(table).axes
    assert points(left, "D") == [(2.0, 0)] and points(right, "D") == [(2.0, 0)]
    assert points(right) == [(1.0, 1), (1.0, 2), (2.0, 3)]
    assert right.yaxis_inverted() or right.get_ylim()[0] > right.get_ylim()[1]


def test_floating_feet_label_every_generator():
    sweep = pd.DataFrame({"lift_cm": [0, 2], "foot_sliding": [0.1, 0], "contact_share": [0.4, 0]})
    shares = pd.DataFrame(
        {"name": GENERATORS, "foot_sliding": [0.1, 0.8, 1.0, 2.4], "contact_share": [0.4] * 4}
    )
    left, right = draw.floating_feet(sweep, shares).axes
    assert [line.get_ydata()[-1] for line in left.lines] == [0, 0]
    assert [text.get_text() for text in right.get_legend().get_texts()] == list(GENERATORS)


def test_foot_spectra_leave_real_motion_to_the_line_at_1():
    rows = [
        {"model": model, "label": model, "band": band, "metric": metric, "value": value,
         "low": 0.5 * value, "high": 2.0 * value}
        for band in ("0.5-2 Hz", "5-15 Hz")
        for model, value in (("real", 1.0), ("noisy motion", 800.0), ("F3AMD-FNO-96", 0.5))
        for metric in ("toe_power", "toe_power_over_real")
    ]  # fmt: skip
    figure = draw.foot_spectra(pd.DataFrame(rows))
    assert titles(figure) == ["0.5-2 Hz", "5-15 Hz"]
    for axis in figure.axes:
        assert points(axis) == [(800.0, 0), (0.5, 1)]
        low, high = axis.get_xlim()
        assert low < 0.5 and high > 800.0


def test_seam_sweep_has_the_seam_between_frames():
    traces = {0.0: np.arange(17.0), 1.0: np.arange(17.0), 3.0: np.arange(17.0)}
    table = pd.DataFrame({"factor": [0, 1, 2], "ird_cm": [0, 4, 8], "ird_excess_cm": [4, 0.7, 4]})
    left, right = draw.seam_sweep(traces, table).axes
    assert left.lines[0].get_xdata().tolist() == list(range(-8, 9))
    assert left.lines[3].get_xdata() == [-0.5, -0.5]
    assert [text.get_text() for text in left.get_legend().get_texts()] == [
        *("× 0: sticks", "× 1: goes on", "× 3: jumps")
    ]
    assert right.lines[0].get_ydata().tolist() == [0, 4, 8]


def test_samples_carry_their_diversity_in_the_title():
    samples = {"same": np.zeros((4, 8)), "trembling": np.ones((4, 8))}
    figure = draw.four_samples(samples, {"same": 0.0, "trembling": 4.71})
    assert titles(figure) == ["same: 0.0 cm", "trembling: 4.7 cm"]
    assert all((line.get_ydata() == 100).all() for line in figure.axes[1].lines)


def test_feature_clouds_leave_out_names_that_would_lie_on_each_other():
    rng = np.random.default_rng(0)
    clouds = {name: rng.normal(size=(30, 2)) for name in ("train", *GENERATORS)}
    middles = {"calm": np.zeros(2), "quiet": np.full(2, 1e-3), "wild": np.array([0.0, 1.5])}
    figure = draw.feature_clouds(clouds, middles)
    assert titles(figure) == ["real, test clips", *CORRUPTIONS]
    assert [text.get_text() for text in figure.axes[0].texts] == ["calm", "wild"]
    for axis, name in zip(figure.axes, GENERATORS, strict=True):
        np.testing.assert_array_equal(axis.lines[1].get_ydata(), clouds[name][:, 1])


def test_graded_distances_follow_the_strength():
    rows = [
        {"corruption": name, "strength": strength, "metric": metric, "value": 10.0 + strength,
         "low": 9.0, "high": 12.0}
        for name in CORRUPTIONS
        for strength in (1.0, 0.0, 0.5)
        for metric in ("FID", "EMD", "style_accuracy")
    ]  # fmt: skip
    figure = draw.graded_distances(pd.DataFrame(rows))
    assert len(figure.axes) == 3
    for axis in figure.axes:
        assert [line.get_xdata().tolist() for line in axis.lines] == [[0.0, 0.5, 1.0]] * 3
        assert axis.get_ylim()[0] == 0


def test_example_clouds_carry_both_distances():
    cloud = np.zeros((5, 2))
    figure = draw.example_clouds({"ring": (cloud, 0.012, 0.5), "far": (cloud, 3.0, 1.0)}, cloud)
    assert titles(figure) == ["ring\nFID 0.01, EMD 0.50", "far\nFID 3.00, EMD 1.00"]


def test_settling_curves_label_the_sizes_that_were_drawn():
    rows = [
        {"label": label, "metric": metric, "windows": size, "value": 100.0 / size,
         "low": -1.0, "high": 200.0 / size}
        for label in ("one", "two")
        for metric in ("FID", "EMD")
        for size in (7, 14, 35)
    ]  # fmt: skip
    for axis in draw.settling_curves(pd.DataFrame(rows)).axes:
        assert [label.get_text() for label in axis.get_xticklabels()] == ["7", "35"]
        assert len(axis.lines) == 2 and axis.get_ylim()[0] > 0


def test_heading_trap_and_path_show_what_they_are_given():
    (axis,) = draw.heading_trap(np.array([-90.0, 0.0, 90.0]), np.array([1.0, 20.0, 1.0])).axes
    assert axis.lines[0].get_ydata().tolist() == [1.0, 20.0, 1.0]
    path = named_path("circle", 640, speed=1.5)
    plan, series = draw.protocol_path(path, seams=32).axes
    assert len(plan.texts) == 2  # an arrow every tenth window
    np.testing.assert_allclose(series.lines[0].get_ydata(), 1.5, rtol=1e-3)
    # Radius 2.5 m: 34 degrees a second, in units of 60.
    np.testing.assert_allclose(series.lines[1].get_ydata(), np.rad2deg(0.6) / 60, rtol=1e-2)


def overview():
    rows = [
        {"model": model, "steps": steps, "metric": metric, "value": value, "low": low, "high": 9.0}
        for metric in FIGURES
        for model, steps, value, low in (
            ("real", 0, 5.0, 4.0), ("noisy motion", 0, 8.0, 7.0), ("F3AMD-FNO-96", 8, 6.0, -3.0),
        )
    ]  # fmt: skip
    quality = pd.DataFrame(rows)
    quality = quality[(quality["model"] != "real") | (quality["metric"] != "diversity")]
    paper = pd.DataFrame(
        [{"model": "F3AMD-FNO-96", "steps": 8, "metric": m, "value": 2.0} for m in FIGURES]
    )
    return draw.quality_overview(quality, FIGURES, paper)


def test_overview_has_nine_panels_and_no_paper_where_it_does_not_compare():
    figure = overview()
    assert titles(figure) == list(FIGURES.values())
    for axis, metric in zip(figure.axes, FIGURES, strict=True):
        assert points(axis, "x") == ([] if metric in ("FID", "EMD") else [(2.0, 2)])
        assert points(axis, "D") == ([] if metric == "diversity" else [(5.0, 0)])
        assert points(axis) == [(8.0, 1), (6.0, 2)]
        # An interval that reaches 0 stays on a logarithmic axis.
        assert axis.get_xlim()[0] > 0
    assert [label.get_text() for label in figure.axes[0].get_yticklabels()] == [
        *("real", "noisy motion", "F3AMD-FNO-96, 8")
    ]


@pytest.mark.parametrize(("low", "high"), [(0.02, 3.0), (7.0, 12.0), (0.1, 500.0), (87.0, 101.0)])
def test_logarithmic_axes_have_at_least_two_labels(low, high):
    table = pd.DataFrame({"name": ["real", "noisy motion"], "joints": [low, high]})
    table = table.assign(root=table["joints"], smoothness=1.0)
    axis = draw.smoothness_parts(table).axes[0]
    ticks = [tick for tick in axis.get_xticks() if axis.get_xlim()[0] <= tick <= axis.get_xlim()[1]]
    assert 2 <= len(ticks) <= 8
