"""Condition tokens, and the ways of c into a block, against plain numpy (3.3, 3.4.3, Table 11)."""

import jax.numpy as jnp
import numpy as np
import pytest
from builders import stirred
from compiled import Compiled
from flax import nnx
from test_attention import draw, linear

from f3amd_lib.networks import conditioning
from f3amd_lib.networks.attention import TransformerBlock, position_code
from f3amd_lib.networks.conditioning import Concatenation
from f3amd_lib.networks.spectral import FNOBlock

CHANNELS, STYLES, WIDTH, WINDOW, HISTORY = 9, 3, 8, 6, 4


def silu(x):
    return x / (1.0 + np.exp(-x))


def make_condition(batch=2, seed=0):
    return conditioning.Condition(
        history=draw(batch, HISTORY, CHANNELS, seed=seed),
        path=draw(batch, WINDOW, 8, seed=seed + 1),
        style=np.eye(STYLES, dtype=np.float32)[np.arange(batch) % STYLES],
    )


def make_encoder(num_heads=1, window=WINDOW):
    sizes = {"channels": CHANNELS, "num_styles": STYLES, "num_history": HISTORY, "latent_width": WIDTH}
    config = conditioning.ConditionedConfig(**sizes, window=window)
    return conditioning.ConditionEncoder(config, num_heads, rngs=nnx.Rngs(params=0))


def test_eq01_noise_features_by_hand():
    # log(1) = 0: only the fixed phases remain, whatever the frequencies.
    at_one = np.asarray(conditioning.noise_features(jnp.float32(1.0), 4096))
    assert at_one.shape == (4096,)
    assert at_one.mean() == pytest.approx(0.0, abs=0.1)
    assert at_one.var() == pytest.approx(1.0, abs=0.1)
    # phi(a) . phi(b) / width is a Gaussian in the distance of log(sigma) / 4, in turns.
    one, two = conditioning.noise_features(jnp.array([1.0, np.exp(4 * 0.2)]), 4096)
    assert float(one @ two) / 4096 == pytest.approx(np.exp(-2 * (np.pi * 0.2) ** 2), abs=0.06)


def test_section_3_3_tokens_are_history_path_and_style():
    encoder = make_encoder()
    condition = make_condition()
    context = encoder.encode(condition)
    assert context.keys.shape == context.values.shape == (2, HISTORY + WINDOW + 1, WIDTH)
    changes = {"history": slice(0, HISTORY), "path": slice(HISTORY, -1), "style": slice(-1, None)}
    for name, place in changes.items():
        other = condition._replace(**{name: getattr(condition, name) + 1.0})
        moved = jnp.abs(encoder.encode(other).keys - context.keys).max(axis=(0, 2)) > 1e-4
        expected = np.zeros(HISTORY + WINDOW + 1, bool)
        expected[place] = True
        np.testing.assert_array_equal(moved, expected)


@pytest.mark.parametrize("num_heads", [1, 2, 4])
def test_section_3_3_cross_attention_equals_a_plain_loop(num_heads):
    encoder = make_encoder(num_heads)
    condition, sigma = make_condition(), np.float32([0.5, 30.0])
    expected = np.zeros((2, WINDOW, WIDTH))
    each = WIDTH // num_heads
    for b in range(2):
        tokens = np.concatenate(
            [
                linear(encoder.history, condition.history[b]) + position_code(-HISTORY, 0, WIDTH),
                linear(encoder.path, condition.path[b]) + position_code(0, WINDOW, WIDTH),
                linear(encoder.style, condition.style[b : b + 1]),
            ]
        )
        keys, values = linear(encoder.key, tokens), linear(encoder.value, tokens)
        noise = np.asarray(conditioning.noise_features(jnp.asarray(sigma[b]), WIDTH))
        noise = linear(encoder.noise_second, silu(linear(encoder.noise_first, noise)))
        for t in range(WINDOW):
            asked = noise + position_code(0, WINDOW, WIDTH)[t]
            query = linear(encoder.query, asked)
            answer = np.zeros(WIDTH)
            for head in range(num_heads):
                part = slice(head * each, (head + 1) * each)
                weight = np.exp(keys[:, part] @ query[part] / np.sqrt(each))
                answer[part] = weight @ values[:, part] / weight.sum()
            expected[b, t] = asked + linear(encoder.output, answer)
    encoder = Compiled(encoder)
    got = encoder(encoder.encode(condition), np.asarray(sigma, np.float32))
    np.testing.assert_allclose(got, expected, atol=2e-5)


def test_a_path_row_counts_at_its_own_frame_of_a_window_of_64():
    """The paper's row of frame t moved to t + 32, with as many others between, is another question."""
    encoder, moved = make_encoder(window=64), {}
    for frame in (5, 37):
        path = np.zeros((1, 64, 8), np.float32)
        path[:, frame] = 3.0
        moved[frame] = encoder(encoder.encode(make_condition(1)._replace(path=path)), 1.0)
    assert np.abs(moved[5] - moved[37]).max() > 1e-3


def test_eq05_to_eq07_equal_plain_numpy():
    film = stirred(conditioning.FiLM(WIDTH, 5, rngs=nnx.Rngs(params=0)))
    z, c = draw(2, WINDOW, WIDTH), draw(2, WINDOW, 5, seed=1)
    mixed = linear(film.modulation, c)
    gamma, beta = mixed[..., :WIDTH], mixed[..., WIDTH:]
    expected = silu(linear(film.output, z * (1.0 + np.tanh(gamma)) + beta))
    np.testing.assert_allclose(Compiled(film).modulate(z, c), expected, atol=1e-5)
    # As a layer of a block it modulates what the base block returns.
    np.testing.assert_array_equal(film(lambda z: 2.0 * z, z / 2.0, c), Compiled(film).modulate(z, c))


def make_base(kind, num_frames=WINDOW):
    if kind == "transformer":
        return TransformerBlock(WIDTH, 2, 4 * WIDTH, rngs=nnx.Rngs(params=1))
    return FNOBlock(WIDTH, WIDTH, num_frames // 2 + 1, rngs=nnx.Rngs(params=1))


@pytest.mark.parametrize("kind", ["fno", "transformer"])
def test_table_11_adaln_zero_starts_as_the_identity(kind):
    base, layer = make_base(kind), conditioning.AdaLNZero(WIDTH, 5, rngs=nnx.Rngs(params=0))
    z, c = draw(2, WINDOW, WIDTH), 100.0 * draw(2, WINDOW, 5, seed=1)
    np.testing.assert_array_equal(Compiled(layer)(base, z, c), z)
    gradient = nnx.jit(nnx.grad(lambda layer: jnp.sum(layer(base, z, c) ** 2)))(layer)
    # Only the gate can move at first, and it does.
    parts = np.split(np.asarray(gradient["modulation"]["kernel"][...]), 3, axis=-1)
    reached = [bool(np.abs(part).max() > 0.1) for part in parts]
    assert reached == [False, False, True]


def test_table_11_adaln_zero_equals_plain_numpy():
    layer = stirred(conditioning.AdaLNZero(WIDTH, 5, rngs=nnx.Rngs(params=0)))
    z, c = 3.0 * draw(2, WINDOW, WIDTH) + 1.0, draw(2, WINDOW, 5, seed=1)
    shift, scale, gate = np.split(linear(layer.modulation, c), 3, axis=-1)
    centred = z - z.mean(axis=-1, keepdims=True)
    normalised = centred / np.sqrt((centred**2).mean(axis=-1, keepdims=True))
    expected = z + gate * np.sin(normalised * (1.0 + scale) + shift)
    np.testing.assert_allclose(Compiled(layer)(jnp.sin, z, c), expected, atol=1e-5)


@pytest.mark.parametrize("num_heads", [1, 2])
def test_table_11_cross_attention_is_added_to_the_base_block(num_heads):
    layer = stirred(conditioning.CrossAttention(WIDTH, 5, num_heads, rngs=nnx.Rngs(params=0)))
    z, c = draw(2, WINDOW, WIDTH), draw(2, WINDOW, 5, seed=1)
    z_base, code = np.sin(z), position_code(0, WINDOW, WIDTH).astype(np.float32)
    z_tilde = z_base + np.asarray(layer.attention(z_base + code, c))
    expected = silu(linear(layer.output, z_tilde))
    np.testing.assert_allclose(Compiled(layer)(jnp.sin, z, c), expected, atol=1e-5)


def test_table_11_concatenation_is_the_base_block_and_the_output_layer():
    layer = stirred(Concatenation(WIDTH, rngs=nnx.Rngs(params=0)))
    z, c = draw(2, 2 * WINDOW, WIDTH), draw(2, WINDOW, WIDTH, seed=1)
    expected = silu(linear(layer.output, np.sin(z)))
    np.testing.assert_allclose(Compiled(layer)(jnp.sin, z, c), expected, atol=1e-5)
    np.testing.assert_array_equal(Compiled(layer)(jnp.sin, z, c + 1.0), Compiled(layer)(jnp.sin, z, c))
