"""Steering goes where it is told, without jumps, and with one window at a time is a rollout."""

import builders
import jax
import numpy as np
import pytest
from steering_oracle import FPS, MAX_TURN, Steering, Target, first_pose, move_target

from f3amd_companion.serving.steer import usual_walk
from f3amd_lib.rollout.blending import blend_seams
from f3amd_lib.rollout.rollout import MotionGenerator
from f3amd_lib.rollout.start_poses import pose_speed

STILL = Target(np.zeros((1, 2)), np.zeros(1), np.zeros(1), np.zeros(1))


@pytest.fixture(scope="module")
def generator():
    return MotionGenerator(builders.tiny_trained(), 2)


def start(generator, batch=2, **settings):
    poses = [first_pose(generator.trained, "calm", (k, 0.5), 0.3) for k in range(batch)]
    return Steering(generator, np.stack(poses), np.full(batch, 0.3), **settings)


def noise_of(generator, batch=2, seed=0):
    config = generator.trained.config
    return np.random.default_rng(seed).standard_normal((batch, config.window, config.channels)).astype(np.float32)


@pytest.mark.parametrize("direction", (0.0, 1.5, -2.5, 3.1))
def test_a_target_takes_up_speed_and_direction(direction):
    target, positions, headings = move_target(STILL, [1.2], [direction], 150)
    np.testing.assert_allclose(target.speed, 1.2, atol=1e-3)
    velocity = FPS * (positions[0, -1] - positions[0, -2])
    np.testing.assert_allclose(velocity, 1.2 * np.array([np.sin(direction), np.cos(direction)]), atol=5e-3)
    assert np.abs(np.diff(headings[0])).max() <= MAX_TURN / FPS + 1e-9
    assert np.linalg.norm(np.diff(positions[0], n=2, axis=0), axis=-1).max() < 0.01  # nowhere a jerk


def test_a_target_that_shall_stop_stops_and_turns_no_more():
    moving, *_ = move_target(STILL, [1.2], [1.0], 60)
    stopped, positions, _ = move_target(moving, [0.0], [-2.0], 120)
    assert stopped.speed[0] < 1e-3 and abs(stopped.heading[0] - 1.0) < 0.1
    assert 0.1 < np.linalg.norm(positions[0, -1] - moving.position[0]) < 0.8


def test_whole_windows_without_blending_are_a_rollout(generator):
    """The same frame, normaliser, path and style reach the network as in `MotionGenerator.generate`."""
    window = generator.trained.config.window
    steering = start(generator, hop=window, blend_frames=0)
    speed, direction = np.full(2, 1.1), np.full(2, 0.3)
    steering.target = steering.target._replace(speed=speed)  # at full speed and straight from the first frame on
    history, (_, positions, headings) = steering.history, move_target(steering.target, speed, direction, window)
    key = jax.random.key(3)
    config = generator.trained.config
    noise = jax.random.normal(jax.random.split(jax.random.fold_in(key, 0))[0], (2, window, config.channels))
    made = steering.advance(speed, direction, np.eye(2), noise)
    wanted = generator.generate(positions, headings, np.array([0, 1]), history, key)
    np.testing.assert_allclose(made, wanted, atol=2e-5)
    other = start(generator, hop=window, blend_frames=0).advance(speed, direction, np.eye(2)[::-1], noise)
    assert np.abs(other - wanted).max() > 1e-3  # another style would be seen


def test_the_seam_is_inertialised_and_the_history_is_what_was_shown(generator):
    window, noise = generator.trained.config.window, noise_of(generator)
    wish = np.array([1.0, 1.0]), np.array([0.0, 1.0])
    raw = start(generator, hop=window, blend_frames=0).advance(*wish, np.eye(2), noise)
    steering = start(generator, hop=4, blend_frames=3)
    before = steering.history
    made = steering.advance(*wish, np.eye(2), noise)
    np.testing.assert_allclose(made, blend_seams(raw, window, 3, history=before)[:, :4], atol=1e-6)
    assert np.abs(made[:, 0] - raw[:, 0]).max() > 1e-3
    whole = np.concatenate([before, made], axis=1)
    np.testing.assert_array_equal(steering.history, whole[:, -before.shape[1] :])


def test_a_style_starts_about_as_fast_as_it_usually_walks(generator):
    starts = np.asarray(generator.trained.start_poses["calm"], np.float64)
    pace, pose = usual_walk(generator.trained, "calm")
    gap = np.abs(FPS * pose_speed(starts) - pace)
    assert 0.3 < pace < 3.0 and np.abs(FPS * pose_speed(pose[None])[0] - pace) == gap.min()
