"""The CAMDM baseline: tokens, step numbers and sizes (sections 4.5 and 6; CAMDM's code)."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from builders import CHANNELS, WINDOW, draw, evaluate, make_condition, network_of, refused, tiny_camdm

from f3amd_lib.networks import presets
from f3amd_lib.networks.attention import position_code

LEVELS = tiny_camdm().noise_levels


def run(network, x_noisy, sigma, condition=None):
    return evaluate(network, x_noisy, sigma, condition or make_condition(x_noisy.shape[0]))


def test_section_6_the_papers_baseline_reads_76_tokens():
    config = presets.build_config("CAMDM", channels=129, num_styles=22)
    # T' = 2 T + T_hist + T_style, and a token for the noise level.
    assert config.num_tokens == 2 * 32 + 10 + 1 + 1 == 76
    assert (config.latent_width, config.depth) == (256, 4)
    assert len(config.noise_levels) == 8


def tokens_of(network, x_noisy, sigma, condition):
    return dict(network.stages(x_noisy, sigma, network.encode(condition)))["tokens"]


def test_tokens_by_hand():
    network = network_of(tiny_camdm(split_path=True))
    condition, x_noisy, sigma = make_condition(), draw(2, WINDOW, CHANNELS), LEVELS[2]
    tokens = jax.jit(lambda x_noisy: tokens_of(network, x_noisy, sigma, condition))(x_noisy)
    code = position_code(0, network.config.num_tokens, 8, base=10_000.0)
    bare = np.asarray(tokens) - code
    weights = lambda layer: (np.asarray(layer.kernel[...]), np.asarray(layer.bias[...]))
    affine = lambda layer, x: np.asarray(x) @ weights(layer)[0] + weights(layer)[1]
    step = position_code(2, 3, 8, base=10_000.0)
    hidden = affine(network.noise_first, step)
    noise = affine(network.noise_second, hidden / (1.0 + np.exp(-hidden)))
    np.testing.assert_allclose(bare[:, 0], np.repeat(noise, 2, axis=0), atol=1e-5)
    np.testing.assert_allclose(bare[:, 1], network.style.kernel[...][:2], atol=1e-5)
    start = 2
    pieces = [
        affine(network.path[0], condition.path[..., :2]),
        affine(network.path[1], condition.path[..., 2:]),
        affine(network.history, condition.history),
        affine(network.future, x_noisy / np.sqrt(1.0 + sigma**2)),
    ]
    for piece in pieces:
        np.testing.assert_allclose(bare[:, start : start + piece.shape[1]], piece, atol=1e-5)
        start += piece.shape[1]
    assert start == tokens.shape[1]


def test_input_is_the_variance_preserving_state():
    network, x_noisy = network_of(tiny_camdm()), draw(2, WINDOW, CHANNELS)
    raw = network_of(tiny_camdm(input_scaling=False))
    sigma = jnp.array([LEVELS[0], LEVELS[3]])
    alpha_bar = 1.0 / (1.0 + sigma**2)
    z = jnp.sqrt(alpha_bar)[:, None, None] * x_noisy
    np.testing.assert_allclose(run(network, x_noisy, sigma), run(raw, z, sigma), atol=1e-5)


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
