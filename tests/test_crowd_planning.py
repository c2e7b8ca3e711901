"""Planned crowds: distances at every frame by brute force, bounds of speed, what is impossible."""

import numpy as np
import pytest
from builders import refused
from scipy.spatial.distance import pdist

from f3amd_companion.serving import crowd_planning
from f3amd_companion.serving.crowd import crowd_paths, plan_crowd
from f3amd_companion.serving.crowd_planning import MIN_DISTANCE, SPEED_BOUNDS, closest_approach, keep_apart
from f3amd_lib.motion.root_paths import tangent_yaw
from f3amd_lib.motion.rotations import wrap_angle

FRAMES = 150


def smallest_distances(position):
    """Every pair at every frame."""
    return np.array([pdist(position[:, frame]).min() for frame in range(position.shape[1])])


def two_who_meet(sideways=0.0):
    """Two who walk towards each other along z, 6 m apart, each 1.2 m/s."""
    z = 1.2 * np.arange(FRAMES) / 30.0
    position = np.stack([np.stack([0 * z, z], axis=-1), np.stack([0 * z + sideways, 6.0 - z], axis=-1)])
    return position, np.stack([0 * z, np.pi + 0 * z])


@pytest.fixture(scope="module")
def crowd():
    pace = np.random.default_rng(0).uniform(0.7, 1.6, 40)
    wanted = crowd_paths(range(40), pace, FRAMES, 3)
    return wanted, keep_apart(*wanted), pace


def test_closest_approach_is_the_smallest_of_all_distances():
    position = np.random.default_rng(1).normal(size=(9, 5, 2))
    np.testing.assert_allclose(closest_approach(position), smallest_distances(position))
    assert np.isinf(closest_approach(position[:1])).all()


def test_nobody_comes_too_close_at_any_frame(crowd):
    (wanted, _), (position, _), _ = crowd
    assert smallest_distances(wanted).min() < 0.3  # there is something to plan
    assert smallest_distances(position).min() >= MIN_DISTANCE


def test_speeds_stay_within_bounds(crowd):
    (wanted, _), (position, _), pace = crowd
    speed = 30 * np.linalg.norm(np.diff(position, axis=1), axis=-1)
    slowest, fastest = SPEED_BOUNDS
    own = 30 * np.linalg.norm(np.diff(wanted, axis=1), axis=-1)
    np.testing.assert_allclose(own.mean(axis=1), pace, rtol=0.02)
    assert (speed >= slowest * own - 1e-6).all()
    assert (speed <= fastest * own.max(axis=1, keepdims=True) + 1e-6).all()
    # Nobody jerks aside: a bump of some centimetres over seconds is far from a jump.
    assert np.abs(np.diff(position, n=2, axis=1)).max() * 900 < 12.0


def test_facing_turns_with_the_line(crowd):
    (wanted, facing), (position, yaw), _ = crowd
    bent = np.flatnonzero(np.ptp(position - wanted, axis=1).max(axis=-1) > 0.2)
    assert len(bent) > 3
    for character in bent:
        off = wrap_angle(yaw[character] - tangent_yaw(position[character]))
        assert np.abs(off).max() < 0.15
    # Who steps aside turns; who only hurries along the own line does not have to.
    turned = np.abs(wrap_angle(yaw - facing)).max(axis=1)
    assert turned[bent].max() > 0.05


def test_two_who_meet_pass_each_other():
    for sideways in (0.0, 0.1, -0.3):
        position, _ = keep_apart(*two_who_meet(sideways), min_distance=1.0)
        gap = np.linalg.norm(position[0] - position[1], axis=-1)
        assert 1.0 <= gap.min() < 1.25
        assert position[0, -1, 1] > position[1, -1, 1]  # they did pass


def test_paths_that_keep_apart_come_back_unchanged():
    position, yaw = two_who_meet(sideways=1.5)
    kept, facing = keep_apart(position, yaw)
    np.testing.assert_array_equal(kept, position)
    np.testing.assert_array_equal(facing, yaw)
    kept, _ = keep_apart(position[:1], yaw[:1])
    np.testing.assert_array_equal(kept, position[:1])
    assert not np.shares_memory(kept, position) and not np.shares_memory(facing, yaw)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: plan_crowd(4, 60, min_distance=0.0), "min_distance must be above 0 metres"),
        (lambda: plan_crowd(0, 60), "a crowd has whole numbers .* got 0"),
        (lambda: closest_approach(np.full((2, 3, 2), np.nan)), "character 0, frame 0"),
    ],
)
def test_impossible_asks_are_refused(call, message):
    refused(message, call)


def test_a_crowd_that_finds_no_paths_however_far_it_is_spread_is_refused(monkeypatch):
    position, yaw = two_who_meet()
    monkeypatch.setattr(crowd_planning, "_untangle", lambda wanted, min_distance: None)
    refused("2 characters found no paths .* however far they were spread", keep_apart, position, yaw)
