"""Steering goes where it is told, without jumps, and with one window at a time is a rollout."""

import builders
import jax
import numpy as np
import pytest
from steering_oracle import FPS, Steering, first_pose, move_target

from f3amd_companion.serving.steer import usual_walk
from f3amd_lib.rollout.rollout import MotionGenerator
from f3amd_lib.rollout.start_poses import pose_speed


@pytest.fixture(scope="module")
def generator():
    return MotionGenerator(builders.tiny_trained(), 2)


def start(generator, batch=2, **settings):
    poses = [first_pose(generator.trained, "calm", (k, 0.5), 0.3) for k in range(batch)]
    return Steering(generator, np.stack(poses), np.full(batch, 0.3), **settings)


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


def test_a_style_starts_about_as_fast_as_it_usually_walks(generator):
    starts = np.asarray(generator.trained.start_poses["calm"], np.float64)
    pace, pose = usual_walk(generator.trained, "calm")
    gap = np.abs(FPS * pose_speed(starts) - pace)
    assert 0.3 < pace < 3.0 and np.abs(FPS * pose_speed(pose[None])[0] - pace) == gap.min()
