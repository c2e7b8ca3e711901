"""What pictures of motion quality share: that colours tell rows apart, and that poses are drawn."""

import matplotlib.colors
import pytest
from builders import straight_motion, wandering_motion

from f3amd_lib.drawing import plots_quality as draw
from f3amd_lib.drawing.style import model_style, new_figure
from f3amd_lib.measures.corruptions import CORRUPTIONS


def same_color(first, second) -> bool:
    return matplotlib.colors.same_color(first, second)


def titles(figure):
    return [axis.get_title(loc="left") for axis in figure.axes]


def test_every_bad_generator_has_a_colour_that_no_network_has():
    assert set(draw.BAD_COLORS) == set(CORRUPTIONS)
    networks = (*("F3AMD-FNO-96", "F3AMD-FNO-96-plus", "F3AMD-FNO-96-steady", "F3AMD-Transformer-64"), "CAMDM")
    for name in CORRUPTIONS:
        for model in ("real", *networks):
            assert not same_color(draw.color_of(name), draw.color_of(model))


def test_networks_and_real_motion_have_their_colour_of_everywhere():
    for name in ("real", "F3AMD-FNO-96", "CAMDM", "F3AMD-FNO-96-plus, 8 steps"):
        assert draw.color_of(name) == model_style(name).color


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


@pytest.mark.parametrize(("low", "high"), [(0.02, 3.0), (7.0, 12.0), (0.1, 500.0), (87.0, 101.0)])
def test_logarithmic_axes_have_at_least_two_labels(low, high):
    _, axes = new_figure()
    axes.plot([low, high], [0, 1])
    axes.set_xscale("log")
    draw.few_log_ticks(axes.xaxis)
    left, right = axes.get_xlim()
    ticks = [tick for tick in axes.get_xticks() if left <= tick <= right]
    assert 2 <= len(ticks) <= 8
    assert [label.get_text() for label in axes.get_xticklabels()] == [f"{t:g}" for t in ticks]
