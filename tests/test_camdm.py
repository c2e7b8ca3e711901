"""The CAMDM baseline: tokens, step numbers and sizes (sections 4.5 and 6; CAMDM's code)."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from builders import CHANNELS, WINDOW, draw, evaluate, make_condition, network_of, refused, tiny_camdm

from f3amd_lib.networks import presets

LEVELS = tiny_camdm().noise_levels


def run(network, x_noisy, sigma, condition=None):
    return evaluate(network, x_noisy, sigma, condition or make_condition(x_noisy.shape[0]))


def test_section_6_the_papers_baseline_reads_76_tokens():
    config = presets.build_config("CAMDM", channels=129, num_styles=22)
    # T' = 2 T + T_hist + T_style, and a token for the noise level.
    assert config.num_tokens == 2 * 32 + 10 + 1 + 1 == 76
    assert (config.latent_width, config.depth) == (256, 4)
    assert len(config.noise_levels) == 8


def test_without_levels_any_noise_level_is_told():
    network, x_noisy = network_of(tiny_camdm(noise_levels=())), draw(2, WINDOW, CHANNELS)
    known = network_of(tiny_camdm())
    raw = {"input_scaling": False}
    far, farther = 2.0 * LEVELS[-1], 4.0 * LEVELS[-1]
    # Beyond the last step there is no other number to tell.
    told = network_of(tiny_camdm(**raw))
    np.testing.assert_allclose(run(told, x_noisy, far), run(told, x_noisy, farther), atol=1e-6)
    free = network_of(tiny_camdm(noise_levels=(), **raw))
    moved = jnp.abs(run(free, x_noisy, far) - run(free, x_noisy, farther))
    assert float(moved.max()) > 1e-3
    assert float(jnp.abs(run(network, x_noisy, 1.0) - run(known, x_noisy, 1.0)).max()) > 1e-3


def test_dropout_acts_only_with_a_key():
    network = network_of(tiny_camdm(dropout=0.5))
    x_noisy, context = draw(2, WINDOW, CHANNELS), network.encode(make_condition())
    call = jax.jit(lambda key: network(x_noisy, 1.0, context, key=key))
    quiet = network(x_noisy, 1.0, context)
    first, again, other = (call(jax.random.key(k)) for k in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert float(jnp.abs(first - other).max()) > 1e-3
    assert float(jnp.abs(first - quiet).max()) > 1e-3


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"num_heads": 3}, "num_heads must divide the width 8"),
        ({"dropout": 1.0}, "dropout must be below 1"),
        ({"split_path": 1}, "split_path must be true or false"),
    ],
)
def test_impossible_configs_are_refused(changes, message):
    refused(message, tiny_camdm, **changes)
