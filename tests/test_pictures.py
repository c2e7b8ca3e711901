"""Where the camera puts things, what covers what, and that colours tell rows apart."""

import hashlib

import numpy as np
from builders import stiff_walk, wandering_motion
from matplotlib.collections import LineCollection
from matplotlib.colors import to_hex

from f3amd_companion.serving.finishing import crowd_figure
from f3amd_lib.drawing.pictures import film_strip
from f3amd_lib.drawing.stick_figures import LIMB_COLORS, Camera
from f3amd_lib.drawing.style import keep_figure, new_figure
from f3amd_lib.motion.skeleton import turn

# --- the camera --------------------------------------------------------------------------------


def test_perspective_by_hand():
    # From the side of +Z, level: right is +X, up is +Y, and size falls with the distance.
    points = [[1.0, 1.0, 0.0], [1.0, 1.0, -10.0], [0.0, 0.0, 4.0]]
    seen = Camera(distance=10.0).project(points)
    np.testing.assert_allclose(seen, [[1.0, 1.0, 0.0], [0.5, 0.5, -10.0], [0.0, 0.0, 4.0]], atol=1e-12)
    np.testing.assert_allclose(Camera().project(points), points, atol=1e-12)  # parallel rays: no size is lost


# --- poses -------------------------------------------------------------------------------------


def bodies(axis) -> list[LineCollection]:
    return [item for item in axis.collections if isinstance(item, LineCollection) and item.get_zorder() == 5]


def test_a_film_strip_shows_a_walk_from_its_own_front_right_wherever_it_goes():
    """Ahead is to the right of the page, and the right leg lies over the left one."""
    for yaw in (0.0, 2.0):
        (body,) = bodies(film_strip(turn(stiff_walk(0.04), yaw), num_poses=1).axes[0])
        colors = [to_hex(color).upper() for color in body.get_colors()]
        left, right = (colors.index(LIMB_COLORS[side]) for side in ("left", "right"))
        assert colors[::-1].index(LIMB_COLORS["right"]) < colors[::-1].index(LIMB_COLORS["left"])
        for limb in (left, right):  # from a hip to the toes before it
            ends = [line for line, color in zip(body.get_segments(), colors, strict=True) if color == colors[limb]]
            assert max(end[1, 0] - end[0, 0] for end in ends) > 0.03


# --- crowds ------------------------------------------------------------------------------------


def standing_at(x, z, seed=0, num_frames=20):
    """A motion moved so that its root stands at (x, z) in frame 10."""
    motion = wandering_motion(num_frames, seed=seed)
    shift = np.array([x, 0.0, z]) - motion.root_position[10] * np.array([1.0, 0.0, 1.0])
    return motion.replace(root_position=motion.root_position + shift)


def test_a_crowd_is_shown_whole():
    # The farthest and the nearest stand alone at the edges: neither heads nor feet are cut off.
    places = [(0.0, -9.0), (0.0, 9.0), (-9.0, 0.0), (9.0, 0.0), (1.0, 1.0)]
    figure = crowd_figure({"": ([standing_at(*place, seed=k) for k, place in enumerate(places)], ["#542788"] * 5)}, 10)
    (left, right), (low, high) = figure.axes[0].get_xlim(), figure.axes[0].get_ylim()
    drawn = np.concatenate([np.concatenate(body.get_segments()) for body in bodies(figure.axes[0])])
    assert left < drawn[:, 0].min() and drawn[:, 0].max() < right
    assert low < drawn[:, 1].min() and drawn[:, 1].max() < high
    assert drawn[:, 0].max() - drawn[:, 0].min() > 0.8 * (right - left)  # and no room is wasted


# --- diagrams ----------------------------------------------------------------------------------


def test_a_kept_figure_names_its_data_set_and_its_light_copy_the_file_in_full_size(tmp_path):
    figure, _ = new_figure(3.0, 2.0)
    shown = keep_figure(figure, tmp_path, "01_any", data="bandai")
    assert [text.get_text() for text in figure.texts] == ["data: bandai"]
    file = tmp_path / "figures" / "01_any.png"
    assert shown.metadata["full"] == hashlib.sha256(file.read_bytes()).hexdigest()
    assert len(shown.data) < file.stat().st_size
    theory, _ = new_figure(3.0, 2.0)
    keep_figure(theory, tmp_path, "02_any")
    assert not theory.texts
