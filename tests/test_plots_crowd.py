"""Pictures of crowds: where the eye puts things, what covers what, and what is refused."""

import numpy as np
import pytest
from builders import wandering_motion
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import to_rgb

from f3amd_lib.drawing.plots_crowd import CrowdPicture, Eye, crowd_colors, crowd_figure, crowd_from_above, group_shades
from f3amd_lib.drawing.style import model_style


def standing_at(x, z, seed=0, num_frames=20):
    """A motion moved so that its root stands at (x, z) in frame 10."""
    motion = wandering_motion(num_frames, seed=seed)
    shift = np.array([x, 0.0, z]) - motion.root_position[10] * np.array([1.0, 0.0, 1.0])
    return motion.replace(root_position=motion.root_position + shift)


@pytest.fixture(scope="module")
def picture():
    motions = [standing_at(2.0 * (k % 3), 2.5 * (k // 3), seed=k) for k in range(6)]
    return CrowdPicture(motions, crowd_colors("abcabc"), "Six", "1.0 ms a round")


# --- the eye -----------------------------------------------------------------------------------


def test_the_eye_sees_its_target_in_the_middle():
    eye = Eye(target=(3.0, -2.0), distance=10.0, around_deg=40.0, elevation_deg=30.0)
    seen, depth = eye.project([3.0, 0.9, -2.0])
    np.testing.assert_allclose(seen, 0.0, atol=1e-12)
    assert depth == pytest.approx(10.0)


def test_perspective_by_hand():
    # From the side of +Z, level: right is +X, up is +Y, and size falls with the distance.
    eye = Eye(distance=10.0, around_deg=0.0, elevation_deg=0.0)
    seen, depth = eye.project([[1.0, 1.9, 0.0], [1.0, 1.9, -10.0], [0.0, 0.9, 4.0]])
    np.testing.assert_allclose(seen, [[0.1, 0.1], [0.05, 0.05], [0.0, 0.0]], atol=1e-12)
    np.testing.assert_allclose(depth, [10.0, 20.0, 6.0])


def test_from_the_right_an_eye_sees_plus_z_to_the_left():
    seen, _ = Eye(around_deg=90.0, elevation_deg=10.0).project([0.0, 0.9, 1.0])
    assert seen[0] < 0 and seen[1] == pytest.approx(0.0, abs=1e-12)


# --- colours -----------------------------------------------------------------------------------


def test_equal_labels_have_equal_colours_and_others_differ():
    labels = [f"style {k % 22}" for k in range(44)]
    colors = crowd_colors(labels)
    assert colors[:22] == colors[22:] and len(set(colors)) == 22


def test_shades_begin_with_the_model_and_neighbours_differ():
    shades = group_shades("CAMDM", 9)
    np.testing.assert_allclose(shades[0], to_rgb(model_style("CAMDM").color))
    gaps = np.abs(np.diff(shades, axis=0)).max(axis=1)
    assert gaps.min() > 0.08
    assert all(shade[1] > shade[0] for shade in shades)  # still the green of CAMDM


def test_a_crowd_of_a_narrow_network_is_not_pale():
    assert group_shades("F3AMD-FNO-32-plus", 5) == group_shades("F3AMD-FNO-96-plus", 5)
    assert group_shades("F3AMD-FNO-128", 1) != group_shades("F3AMD-FNO-96", 1)


# --- perspective -------------------------------------------------------------------------------


def test_near_bodies_cover_far_ones_and_are_drawn_larger(picture):
    eye = Eye(target=(2.0, 1.0), distance=12.0, around_deg=0.0)
    figure = crowd_figure([picture], 10, eye=eye, columns=1)
    heads_or_limbs = [
        item for item in figure.axes[0].collections
        if isinstance(item, LineCollection) and item.get_zorder() > 5
    ]  # fmt: skip
    outlines, fills = heads_or_limbs[::2], heads_or_limbs[1::2]
    assert len(fills) == len(picture.motions)
    z = np.array([motion.root_position[10, 2] for motion in picture.motions])
    order = np.argsort(z, kind="stable")  # the eye is on the side of +Z: small z is far
    zorders = [item.get_zorder() for item in fills]
    assert zorders == sorted(zorders)
    widest = np.array([np.max(item.get_linewidths()) for item in fills])
    assert widest[-3:].min() > 1.1 * widest[:3].max()
    assert len(order) == 6
    for outline, fill in zip(outlines, fills, strict=True):
        assert outline.get_zorder() < fill.get_zorder()
        assert (np.array(outline.get_linewidths()) > np.array(fill.get_linewidths())).all()


def test_limbs_lie_where_the_eye_projects_the_joints(picture):
    eye = Eye(target=(2.0, 1.0), distance=12.0, around_deg=30.0)
    alone = CrowdPicture(picture.motions[:1], picture.colors[:1])
    figure = crowd_figure([alone], 10, eye=eye, columns=1)
    lines = [
        item for item in figure.axes[0].collections
        if isinstance(item, LineCollection) and item.get_zorder() > 5
    ]  # fmt: skip
    drawn = np.concatenate([np.asarray(segment) for segment in lines[-1].get_segments()])
    joints, _ = eye.project(picture.motions[0].positions[10])
    for joint in joints:
        assert np.abs(drawn - joint).max(axis=-1).min() < 1e-9


def test_titles_notes_and_empty_panels(picture):
    figure = crowd_figure([picture] * 3, 10, columns=2)
    texts = [text.get_text() for axis in figure.axes for text in axis.texts]
    assert texts.count("1.0 ms a round") == 3
    assert [axis.get_title(loc="left") for axis in figure.axes[:3]] == ["Six"] * 3
    assert not figure.axes[3].axison


# --- from above --------------------------------------------------------------------------------


def test_discs_have_the_distance_as_their_diameter(picture):
    paths = [motion.root_position[:, [0, 2]] for motion in picture.motions]
    figure = crowd_from_above(picture, paths, 10, min_distance=0.8)
    axis = figure.axes[0]
    (discs,) = [item for item in axis.collections if isinstance(item, PolyCollection)]
    for disc, motion in zip(discs.get_paths(), picture.motions, strict=True):
        off = np.linalg.norm(disc.vertices - motion.root_position[10, [0, 2]], axis=-1)
        np.testing.assert_allclose(off, 0.4, atol=1e-9)
    low, high = axis.get_xlim()
    assert low > high  # +X to the left, as seen from above


@pytest.mark.parametrize(
    ("draw", "message"),
    [
        (lambda p: crowd_figure([], 0), "at least one picture"),
        (lambda p: crowd_figure([p], 20), "has frames 0 to 19; asked for 20"),
        (lambda p: crowd_figure([p], 10, eye=Eye(target=(-500.0, -500.0))), "sees nobody"),
        (lambda p: crowd_from_above(p, [], 0), "0 paths for 6 motions"),
        (lambda p: CrowdPicture([], []), "at least one motion"),
        (lambda p: CrowdPicture(p.motions, ["red"]), "1 colors for 6 motions"),
        (lambda p: CrowdPicture([p.motions[0].replace(fps=60.0), p.motions[1]], "kk"), "frame rate"),
    ],
)
def test_bad_input_is_refused(picture, draw, message):
    with pytest.raises(ValueError, match=message):
        draw(picture)
