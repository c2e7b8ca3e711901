"""The exact denoiser, by values that are worked out another way."""

import jax.numpy as jnp
import numpy as np
import pytest

from f3amd_lib.diffusion.oracles import GaussianMixture
from f3amd_lib.diffusion.samplers import add_noise, ddim_step
from f3amd_lib.diffusion.schedules import variance_exploding

TWO = GaussianMixture([-1.0, 1.0], width=0.3, weights=[1.0, 3.0])
PLANE = GaussianMixture([[0.0, 0.0], [2.0, 1.0], [-1.0, 3.0]], width=0.5)


def test_denoise_equals_the_integral_over_the_posterior():
    x0 = np.linspace(-6, 6, 24001)
    data = 0.25 * np.exp(-0.5 * ((x0 + 1) / 0.3) ** 2) + 0.75 * np.exp(-0.5 * ((x0 - 1) / 0.3) ** 2)
    for x, sigma in ((0.4, 0.2), (-0.7, 1.0), (3.0, 8.0)):
        posterior = data * np.exp(-0.5 * ((x - x0) / sigma) ** 2)
        expected = np.sum(x0 * posterior) / np.sum(posterior)
        found = TWO.denoise(np.array([[x]]), sigma)
        np.testing.assert_allclose(found, [[expected]], atol=1e-9)


def test_score_is_the_slope_of_the_log_density():
    x = np.array([[0.3, 0.8], [-2.0, 1.0], [5.0, 5.0]])
    step = 1e-5
    for sigma in (0.1, 2.0):
        for axis in range(2):
            move = np.eye(2)[axis] * step
            slope = (PLANE.log_density(x + move, sigma) - PLANE.log_density(x - move, sigma)) / (2 * step)
            np.testing.assert_allclose(PLANE.score(x, sigma)[:, axis], slope, rtol=1e-6, atol=1e-6)


def test_tweedie_joins_score_and_denoiser():
    x = np.random.default_rng(0).normal(scale=3.0, size=(50, 2))
    sigma = np.linspace(0.05, 20.0, 50)[:, None]
    np.testing.assert_allclose(PLANE.denoise(x, sigma), x + sigma**2 * PLANE.score(x, sigma), atol=1e-9)


@pytest.mark.parametrize("sigma", [0.1, 3.0])
def test_jax_answers_as_numpy_does(sigma):
    x = np.random.default_rng(1).normal(size=(4, 3, 2))
    for name in ("denoise", "score", "log_density"):
        found = getattr(PLANE, name)(jnp.asarray(x, jnp.float32), sigma)
        assert found.dtype == jnp.float32
        np.testing.assert_allclose(found, getattr(PLANE, name)(x, sigma), rtol=2e-4, atol=2e-5)


def test_flow_is_where_fine_steps_lead_and_can_be_undone():
    x = np.array([[-100.0], [-3.0], [40.0]])
    sigmas = variance_exploding(sigma_max=64.0).grid(4000)[:-1]
    state = x
    for sigma, sigma_next in zip(sigmas[:-1], sigmas[1:], strict=True):
        state = ddim_step(state, TWO.denoise(state, sigma), sigma, sigma_next)
    exact = TWO.flow(x, 64.0, 0.01)
    np.testing.assert_allclose(state, exact, atol=5e-3)
    np.testing.assert_allclose(TWO.flow(exact, 0.01, 64.0), x, rtol=1e-9)


def test_eq08_noisy_samples_follow_the_noisy_density():
    rng = np.random.default_rng(3)
    clean = TWO.sample(rng, 40_000)
    noisy = add_noise(clean, 0.7, rng.standard_normal(clean.shape))
    edges = np.linspace(-3, 3, 13)
    count, _ = np.histogram(noisy, edges)
    inner = 0.5 * (edges[1:] + edges[:-1])
    # Simpson's rule over each bin
    density = sum(
        w * np.exp(TWO.log_density(x[:, None], 0.7)) for w, x in ((1, edges[:-1]), (4, inner), (1, edges[1:]))
    )
    np.testing.assert_allclose(count / len(noisy), density * 0.5 / 6, atol=0.008)
