"""The exact denoiser, by values that are worked out another way."""

import jax.numpy as jnp
import numpy as np
import pytest
from builders import refused

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


def test_one_gaussian_has_the_known_posterior_mean_and_density():
    one = GaussianMixture([[1.0, -2.0]], width=0.5)
    x = np.array([2.0, 0.0])
    # variance 0.25 against noise variance 0.75: a quarter of the way back to x
    np.testing.assert_allclose(one.denoise(x, np.sqrt(0.75)), [1.25, -1.5], atol=1e-14)
    expected = -0.5 * (1.0 + 4.0) - np.log(2 * np.pi)
    np.testing.assert_allclose(one.log_density(x, np.sqrt(0.75)), expected, atol=1e-14)


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


def test_limits_without_noise_and_with_nothing_but_noise():
    x = np.array([[0.2], [-3.0]])
    np.testing.assert_array_equal(TWO.denoise(x, 0.0), x)
    np.testing.assert_allclose(TWO.denoise(x, 1e6), 0.5, atol=1e-5)  # mean: -0.25 + 0.75


@pytest.mark.parametrize("sigma", [0.1, 3.0])
def test_jax_answers_as_numpy_does(sigma):
    x = np.random.default_rng(1).normal(size=(4, 3, 2))
    for name in ("denoise", "score", "log_density"):
        found = getattr(PLANE, name)(jnp.asarray(x, jnp.float32), sigma)
        assert found.dtype == jnp.float32
        np.testing.assert_allclose(found, getattr(PLANE, name)(x, sigma), rtol=2e-4, atol=2e-5)


def test_samples_have_the_mixtures_mean_and_variance():
    samples = TWO.sample(np.random.default_rng(2), 40_000)
    assert samples.shape == (40_000, 1)
    np.testing.assert_allclose(samples.mean(), 0.5, atol=0.02)
    np.testing.assert_allclose(samples.var(), 0.09 + 0.75, atol=0.02)  # width^2 + 1 - 0.5^2


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


def test_flow_of_one_gaussian_is_a_scaling():
    one = GaussianMixture([1.0], width=0.5)
    x = np.array([[-7.0], [1.0], [4.0], [12.0]])
    for sigma, sigma_next in ((40.0, 0.0), (0.1, 3.0)):
        scale = np.hypot(0.5, sigma_next) / np.hypot(0.5, sigma)
        expected = 1.0 + (x - 1.0) * scale
        np.testing.assert_allclose(one.flow(x, sigma, sigma_next), expected, atol=1e-10)


def test_flow_is_where_fine_steps_lead_and_can_be_undone():
    x = np.array([[-100.0], [-3.0], [40.0]])
    sigmas = variance_exploding(sigma_max=64.0).grid(4000)[:-1]
    state = x
    for sigma, sigma_next in zip(sigmas[:-1], sigmas[1:], strict=True):
        state = ddim_step(state, TWO.denoise(state, sigma), sigma, sigma_next)
    exact = TWO.flow(x, 64.0, 0.01)
    np.testing.assert_allclose(state, exact, atol=5e-3)
    np.testing.assert_allclose(TWO.flow(exact, 0.01, 64.0), x, rtol=1e-9)


def test_bad_mixtures_are_refused():
    for bad in (
        {"means": [0.0], "width": 0.0},
        {"means": [0.0, 1.0], "width": 1.0, "weights": [1.0]},
        {"means": [0.0, 1.0], "width": 1.0, "weights": [1.0, -1.0]},
        {"means": [[np.nan]], "width": 1.0},
    ):
        with pytest.raises(ValueError):
            GaussianMixture(**bad)
    refused("D = 1", PLANE.flow, np.zeros((1, 2)), 1.0, 0.0)
