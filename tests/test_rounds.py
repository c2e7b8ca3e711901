"""A round is noise, one encoding, and the walk; alike on one device and on several."""

import os
import subprocess
import sys
import textwrap

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


ON_TWO_DEVICES = """
    import sys
    import jax, numpy as np
    from jax.sharding import Mesh
    sys.path.insert(0, {tests!r})
    from test_rounds import *
    import jax.numpy as jnp
    from builders import *
    from f3amd_lib.rollout.rounds import sample_round, sample_round_on_devices
    network = network_of(tiny_config())
    mesh = Mesh(np.array(jax.devices()), ("characters",))
    assert mesh.size == 2
    given, key = make_condition(BATCH), jax.random.key(3)
    noise = jax.random.normal(key, (BATCH, WINDOW, CHANNELS))
    run = jax.jit(lambda g, n: sample_round_on_devices(network, g, SIGMAS, mesh=mesh, noise=n))
    spread = run(given, noise)
    assert len(spread.sharding.device_set) == 2
    alone = sample_round(network, given, SIGMAS, noise=noise)
    np.testing.assert_allclose(spread, alone, atol=1e-5)
    alike = jax.tree.map(lambda rows: jnp.repeat(rows[:1], BATCH, axis=0), given)
    drawn = np.asarray(sample_round_on_devices(network, alike, SIGMAS, key, mesh=mesh))
    assert np.abs(drawn[0] - drawn[2]).max() > 1e-3
"""


@pytest.mark.slow
def test_two_devices_give_the_numbers_of_one():
    program = textwrap.dedent(ON_TWO_DEVICES).format(tests=os.path.dirname(__file__))
    done = subprocess.run(
        [sys.executable, "-c", program],
        env=os.environ
        | {"XLA_FLAGS": "--xla_force_host_platform_device_count=2", "JAX_PLATFORMS": "cpu"},
        capture_output=True, text=True, timeout=300, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-2000:]
