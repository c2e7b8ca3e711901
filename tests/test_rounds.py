"""A round is noise, one encoding, and the walk."""

import jax
import numpy as np
import pytest
from builders import CHANNELS, WINDOW, make_condition, network_of, tiny_config

from f3amd_lib.diffusion.samplers import sample
from f3amd_lib.diffusion.schedules import variance_exploding
from f3amd_lib.rollout.rounds import sample_round

BATCH = 4
SIGMAS = np.asarray(variance_exploding().grid(3), np.float32)


@pytest.fixture(scope="module")
def network():
    return network_of(tiny_config())


def test_round_is_encoding_noise_and_walk(network):
    given, key = make_condition(BATCH), jax.random.key(3)
    context = network.encode(given)
    denoise = lambda x_noisy, sigma: network(x_noisy, sigma, context)
    key_init, key_steps = jax.random.split(key)
    noise = jax.random.normal(key_init, (BATCH, WINDOW, CHANNELS))
    by_hand = sample("ddim", denoise, SIGMAS[0] * noise, SIGMAS)
    np.testing.assert_allclose(sample_round(network, given, SIGMAS, key), by_hand, atol=1e-5)
    by_hand = sample("ddpm", denoise, SIGMAS[0] * noise, SIGMAS, key=key_steps)
    drawn = sample_round(network, given, SIGMAS, key, sampler="ddpm")
    np.testing.assert_allclose(drawn, by_hand, atol=1e-5)


def test_noise_may_be_given(network):
    given, key = make_condition(BATCH), jax.random.key(3)
    noise = jax.random.normal(jax.random.split(key)[0], (BATCH, WINDOW, CHANNELS))
    found = sample_round(network, given, SIGMAS, noise=noise)
    np.testing.assert_array_equal(found, sample_round(network, given, SIGMAS, key))
