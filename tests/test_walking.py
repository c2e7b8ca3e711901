"""Walking measured from toes: each measure and each check passes an oracle and fails a nonsense."""

import numpy as np
import pytest
from builders import SKELETON, refused, wandering_motion
from f3amd_notebooks import walk_tables

from f3amd_lib.measures import walking
from f3amd_lib.motion.root_paths import named_path
from f3amd_lib.motion.synthetic import style_parameters, walk_along

WINDOW = 32


@pytest.fixture(scope="module")
def walk():
    path = named_path("circle", 8 * WINDOW, speed=1.2)
    return walk_along("Neutral", path)


def moved(motion, **changes):
    """The motion with its root moved: an array [T, 3] to add, metres."""
    return motion.replace(root_position=motion.root_position + changes["by"])


def drifting(motion, speed):
    """The motion carried sideways at `speed` cm/s: feet that skate."""
    time = np.arange(motion.num_frames) / motion.fps
    return moved(motion, by=np.stack([0.01 * speed * time, 0 * time, 0 * time], axis=-1))


def test_the_walker_follows_a_drawn_path(walk):
    path = named_path("circle", 8 * WINDOW, speed=1.2)
    apart = np.linalg.norm(walk.root_position[:, [0, 2]] - path.position, axis=-1)
    assert apart.max() < 0.12  # its sway
    turned = np.abs(np.unwrap(walk.yaw) - path.yaw)
    assert np.rad2deg(turned.mean()) < 10.0
    refused("4 frames or more", walk_along, "Neutral", path.slice(0, 3))


def test_steps_are_counted_by_toe_height(walk):
    parameters = style_parameters("Neutral")
    wanted = parameters.speed / parameters.step_length
    assert walking.stepping_rate(walk.positions, walk.skeleton) == pytest.approx(wanted, rel=0.12)
    # A skating foot whose leg swings still steps; a frozen or shaking one does not.
    skating = drifting(walk, 90.0)
    assert walking.stepping_rate(skating.positions, walk.skeleton) == pytest.approx(
        walking.stepping_rate(walk.positions, walk.skeleton)
    )
    frozen = np.repeat(walk.positions[:1], 90, axis=0)
    shaking = frozen + 0.004 * np.random.default_rng(0).standard_normal(frozen.shape)
    assert walking.stepping_rate(frozen, walk.skeleton) == 0.0
    assert walking.stepping_rate(shaking, walk.skeleton) < 0.3
    half = walking.stepping_rate(walk.positions, walk.skeleton, fps=15.0)
    assert half == pytest.approx(0.5 * wanted, rel=0.15)


def test_slide_is_the_speed_of_the_lower_toe(walk):
    assert walking.slide_speed(walk.positions, walk.skeleton) < 0.5
    assert walking.sliding_share(walk.positions, walk.skeleton) < 0.1
    skating = drifting(walk, 50.0).positions
    assert walking.slide_speed(skating, walk.skeleton) == pytest.approx(50.0, rel=0.02)
    assert walking.sliding_share(skating, walk.skeleton) > 0.9
    two = np.stack([walk.positions, skating])
    np.testing.assert_allclose(
        walking.slide_speed(two, walk.skeleton), [walking.slide_speed(one, walk.skeleton) for one in two]
    )


def test_floor_penetration_is_the_deepest_toe(walk):
    assert walking.floor_penetration(walk.positions, walk.skeleton) == 0.0
    lowest = walk.positions[:, list(walk.skeleton.toes), 1].min()
    sunk = walk.positions - np.array([0.0, 0.05, 0.0])
    found = walking.floor_penetration(sunk, walk.skeleton)
    assert found == pytest.approx(5.0 - 100 * lowest)
    assert walking.floor_penetration(sunk, walk.skeleton, floor=-0.05) == 0.0


def test_a_kick_at_the_seams_is_seen(walk):
    assert walking.seam_kick(walk.positions, WINDOW) == pytest.approx(1.0, abs=0.2)
    jumps = np.zeros((walk.num_frames, 3))
    jumps[:, 0] = 0.05 * (np.arange(walk.num_frames) // WINDOW)
    kicked = moved(walk, by=jumps)
    assert walking.seam_kick(kicked.positions, WINDOW) > 3.0
    assert walking.seam_kick(kicked.positions, WINDOW - 1) < 2.0
    refused("no seam", walking.seam_kick, walk.positions[: WINDOW + 4], WINDOW)


def failed(walk, sources, **floors):
    table = walk_tables.check_walks({"Neutral": walk}, sources, WINDOW, floors)
    assert len(table) == len(walking.CHECKS)
    return set(table.loc[~table["holds"], "check"])


def test_each_check_passes_the_source_and_fails_its_nonsense(walk):
    sources = {"Neutral": walk}
    assert failed(walk, sources) == set()
    shaking = 0.01 * np.random.default_rng(0).standard_normal((walk.num_frames, 3)) * [1, 0, 1]
    gliding = walk.root_position[:1] + np.arange(walk.num_frames)[:, None] / walk.fps * [0.0, 0.0, 1.2]
    stiff = np.repeat(walk.rotations[:1], walk.num_frames, axis=0)
    nonsense = {
        "slide of the lower toe": drifting(walk, 30.0),
        "deepest toe under the floor": moved(walk, by=np.array([0.0, -0.04, 0.0])),
        "joint acceleration": moved(walk, by=shaking),
        "steps by toe height": walk.replace(root_position=gliding, rotations=stiff),
    }
    for check, motion in nonsense.items():
        assert check in failed(motion, sources), check


# ------------------------------------------------------------- planted feet, bones, frames of a window


def test_a_stiff_figure_swings_nothing_however_it_turns():
    motion = wandering_motion(40, 0)
    frozen = np.repeat(motion.positions[:1], 40, axis=0)
    assert walking.bone_swing(frozen, SKELETON) == pytest.approx(0.0, abs=1e-4)
    angle = np.linspace(0.0, 4.0, 40)
    turn = np.stack([[[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]] for a in angle])
    turning = np.einsum("tab,tjb->tja", turn, frozen)
    assert walking.bone_swing(turning, SKELETON) == pytest.approx(0.0, abs=1e-4)
    assert walking.bone_swing(motion.positions, SKELETON) > 5.0
