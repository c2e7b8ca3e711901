"""Noise that meets a target: the distance falls, the gradient is that of the whole sampler, noise stays noise."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_acmdm import BATCH, normal

from f3amd_lib.diffusion.flow import solve
from f3amd_lib.diffusion.schedules import straight
from f3amd_lib.text.data.text_motions import AxisNormaliser
from f3amd_lib.text.networks.acmdm import Control
from f3amd_lib.text.sampling.text_to_motion import control_distance, correlation, optimise_noise
from f3amd_lib.text.stages.text_models import MotionCodec

CODEC = MotionCodec(AxisNormaliser(np.array([0.5, 0.0, -1.0], np.float32), np.array([2.0, 1.0, 0.5], np.float32)))
SHAPE = (BATCH, 8, 5, 3)
MEAN, SPREAD = 0.7, 0.5


def exact_velocity(state, t):
    """The flow of independent normal numbers N(MEAN, SPREAD^2): v = E[x0 - eps | state]."""
    variance = t**2 * SPREAD**2 + (1 - t) ** 2
    return MEAN + (t * SPREAD**2 - (1 - t)) / variance * (state - t * MEAN)


def straight_walk(noise):
    return solve(exact_velocity, "v", straight(), noise, sampler="ddim", num_steps=10)


def target(frame, joint, place):
    asked = jnp.zeros(SHAPE[:3]).at[:, frame, joint].set(1.0)
    return Control.of(jnp.broadcast_to(jnp.asarray(place), SHAPE), asked)


def test_distance_is_in_metres_and_of_the_asked_joints_alone():
    control = target(3, 1, [0.0, 0.0, 0.0])
    state = jnp.zeros(SHAPE).at[:, 3, 1].set(jnp.array([1.0, 0.0, 0.0])).at[:, 3, 2].set(9.0)
    distance = control_distance(CODEC, jnp.ones(SHAPE[:2], bool), control)
    np.testing.assert_allclose(distance(state), 2.0, rtol=1e-5)


def test_the_gradient_goes_through_all_steps_of_the_sampler():
    """Against differences of the whole walk, along one direction."""
    noise, along = normal(1, *SHAPE), normal(2, *SHAPE)
    distance = control_distance(CODEC, jnp.ones(SHAPE[:2], bool), target(3, 1, [1.0, 0.0, 0.5]))
    total = lambda noise: distance(straight_walk(noise)).sum()
    slope = jnp.vdot(jax.grad(total)(noise), along)
    step = 1e-2
    difference = (total(noise + step * along) - total(noise - step * along)) / (2 * step)
    np.testing.assert_allclose(slope, difference, rtol=2e-2)


def test_a_target_is_met_and_only_its_noise_has_moved():
    """Joints are independent here, so that no other number has a reason to move."""
    noise = normal(1, *SHAPE)
    distance = control_distance(CODEC, jnp.ones(SHAPE[:2], bool), target(3, 1, [1.0, 0.2, 0.5]))
    found = optimise_noise(straight_walk, distance, noise, num_steps=200, learning_rate=0.1, decorrelation=0.0)
    assert np.all(found.distances[0] > 0.3) and np.all(distance(found.state) < 0.02)
    moved = np.abs(np.asarray(found.noise - noise))
    assert moved[:, 3, 1].max() > 0.1
    moved[:, 3, 1] = 0.0
    assert moved.max() == 0.0


@pytest.mark.slow
def test_noise_of_its_own_does_not_go_together_and_repeated_noise_does():
    noise = normal(1, 4, 64, 5, 3)
    assert np.all(correlation(noise) < 0.2)
    assert np.all(correlation(jnp.broadcast_to(noise[:, :1], noise.shape)) > 1.0)
