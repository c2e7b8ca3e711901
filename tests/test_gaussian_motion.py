"""Exact answers of Gaussian motion: against formulas by hand, and walked by the library's own samplers."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from f3amd_notebooks.gaussian_motion import ExactFrames, GaussianMotion

from f3amd_lib.diffusion.flow import solve
from f3amd_lib.diffusion.schedules import straight
from f3amd_lib.text.networks.acmdm import TextCondition
from f3amd_lib.text.sampling.text_to_motion import sample_blocks

LAG = np.arange(6)[:, None] - np.arange(6)
COVARIANCE = np.exp(-np.abs(LAG) / 4) + 0.2


def rows(seed=0, count=400):
    return np.random.default_rng(seed).normal(size=(count, 5)) * [3.0, 1.0, 0.1, 0.1, 0.1] + np.arange(5)


def test_a_gaussian_of_rows_tells_their_mean_and_spread():
    model = GaussianMotion.of(rows(), 2)
    assert np.allclose(model.mean, np.arange(5), atol=0.3)
    assert np.allclose(np.sqrt(model.variances), [3.0, 1.0], rtol=0.1)
    noise = jax.random.normal(jax.random.key(0), (2000, 5))
    made = np.asarray(solve(model.velocity, "v", straight(), noise, sampler="ddim", num_steps=40))
    assert np.allclose(made.mean(axis=0), model.mean, atol=0.25)
    assert np.allclose(made.std(axis=0)[:2], [3.0, 1.0], rtol=0.1)
    generator = np.random.default_rng(0)
    drawn = np.array([model.draw(generator) for _ in range(2000)])
    assert np.allclose(drawn.std(axis=0)[:2], [3.0, 1.0], rtol=0.1) and drawn.std(axis=0)[2:].max() < 0.2


def test_a_gaussian_that_is_told_a_number_keeps_it_and_moves_the_rest():
    model = GaussianMotion(np.zeros(2), np.eye(2), np.array([2.0, 1.0]), 1e-4)
    turned = GaussianMotion(np.zeros(2), np.array([[0.6, -0.8], [0.8, 0.6]]), np.array([2.0, 1.0]), 1e-4)
    assert np.allclose(model.given([0], [1.0], slack=1e-9).mean, [1.0, 0.0])  # independent numbers
    covariance = turned.directions * turned.variances @ turned.directions.T
    told = turned.given([0], [1.0], slack=1e-9)
    assert np.allclose(told.mean, [1.0, covariance[1, 0] / covariance[0, 0]])
    left = told.directions * told.variances @ told.directions.T
    assert left[1, 1] == pytest.approx(covariance[1, 1] - covariance[1, 0] ** 2 / covariance[0, 0], abs=1e-6)
    assert left[0, 0] == pytest.approx(0.0, abs=1e-6)


def test_exact_frames_answer_as_a_gaussian_does():
    network, t = ExactFrames(COVARIANCE), 0.4
    x = np.random.default_rng(1).normal(size=(3, 6))
    clean = t * COVARIANCE @ np.linalg.solve(t**2 * COVARIANCE + (1 - t) ** 2 * np.eye(6), x.T)
    found = network(jnp.asarray(x)[..., None, None], t, None)[..., 0, 0]
    np.testing.assert_allclose(found, (clean.T - x) / (1 - t), atol=1e-4)


def test_clean_frames_are_frames_at_time_one_and_may_be_remembered():
    network = ExactFrames(COVARIANCE, block_frames=2)
    x = jnp.asarray(np.random.default_rng(2).normal(size=(3, 6)))[..., None, None]
    times = jnp.broadcast_to(jnp.array([1.0, 1.0, 1.0, 1.0, 0.5, 0.5]), (3, 6))
    whole = network(x, times, None)[:, 4:]
    past = network.remember(x[:, 2:4], None, network.remember(x[:, :2], None))
    given = ExactFrames(COVARIANCE, prefix=4)(x, 0.5, None)[:, 4:]  # told one time for all frames
    for found in (network(x[:, 4:], 0.5, None, past=past), given):
        np.testing.assert_allclose(found, whole, atol=1e-4)
    assert not np.allclose(network(x[:, 4:], 0.5, None), whole, atol=1e-2)  # without them another answer


def test_blocks_draw_the_frames_that_they_should():
    condition = TextCondition(jnp.zeros((4000, 1)), jnp.ones((4000, 6), bool))
    noise = jax.random.normal(jax.random.key(3), (4000, 6, 1, 1))
    network, how = ExactFrames(COVARIANCE, block_frames=3), {"guidance": 1.0, "sampler": "ddim", "num_steps": 40}
    draws = jax.jit(lambda: sample_blocks(network, straight(), condition, noise, **how))()
    found = np.cov(np.asarray(draws)[..., 0, 0].T)
    np.testing.assert_allclose(found, COVARIANCE, atol=0.15)
    assert np.abs(np.cov(np.asarray(noise)[..., 0, 0].T) - COVARIANCE).max() > 0.5
