"""Noise, velocity and clean estimate are one walk; guidance against a density that is known."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from f3amd_lib.diffusion.oracles import GaussianMixture
from f3amd_lib.diffusion.predictions import from_noise, from_velocity, guided
from f3amd_lib.diffusion.samplers import sample
from f3amd_lib.diffusion.schedules import alpha_bar_from_sigma, variance_exploding, variance_preserving_linear

MIXTURE = GaussianMixture([-1.0, 1.0], 0.2)


def noise_of(x_noisy, sigma):
    return (x_noisy - MIXTURE.denoise(x_noisy, sigma)) / sigma


def velocity_of(x_noisy, sigma):
    alpha_bar = alpha_bar_from_sigma(sigma)
    x0_hat = MIXTURE.denoise(x_noisy, sigma)
    return jnp.sqrt(alpha_bar) * (x_noisy - x0_hat) / sigma - jnp.sqrt(1.0 - alpha_bar) * x0_hat


@pytest.mark.parametrize("schedule", [variance_exploding(), variance_preserving_linear(64)])
@pytest.mark.parametrize("wrapped", [from_noise(noise_of), from_velocity(velocity_of)])
def test_every_prediction_of_an_exact_network_gives_the_same_samples(schedule, wrapped):
    sigmas = schedule.grid(8)
    with jax.enable_x64(True):
        x_init = sigmas[0] * jnp.asarray(np.random.default_rng(0).standard_normal((64, 1)))
        x0 = sample("ddim", MIXTURE.denoise, x_init, sigmas)
        np.testing.assert_allclose(sample("ddim", wrapped, x_init, sigmas), x0, atol=1e-9)
    assert np.std(x0) > 0.5


def test_the_wrong_wrapper_is_noticed():
    x = jnp.full((1, 1), 0.7)
    assert abs(float((from_velocity(noise_of)(x, 0.5) - MIXTURE.denoise(x, 0.5))[0, 0])) > 0.05


def test_guidance_of_gaussians_moves_the_mean_by_its_scale():
    """p(x)^(1 - w) p(x | c)^w of two Gaussians of one width is a Gaussian whose mean lies w times as far."""
    one, other = GaussianMixture([2.0], 0.5), GaussianMixture([0.5], 0.5)
    x = jnp.linspace(-2.0, 4.0, 7)[:, None]
    for scale in (0.0, 1.0, 3.0):
        exact = GaussianMixture([0.5 + scale * 1.5], 0.5)
        estimate = guided(one.denoise, other.denoise, scale)(x, 0.8)
        np.testing.assert_allclose(estimate, exact.denoise(x, 0.8), atol=1e-5)
