"""Attention and the Transformer block against plain numpy loops (section 3.4.1, Appendix A)."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from builders import refused, stirred
from flax import nnx
from scipy.special import erf

from f3amd_lib.networks import conditioning
from f3amd_lib.networks.attention import (
    MultiHeadAttention,
    TransformerBlock,
    attention,
    attention_weights,
    dropout,
    position_code,
)

WIDTH, HEADS, HIDDEN = 8, 2, 12


def draw(*shape, seed=0):
    return np.random.default_rng(seed).standard_normal(shape).astype(np.float32)


def linear(layer, x):
    return x @ np.asarray(layer.kernel[...]) + np.asarray(layer.bias[...])


def plain_attention(query, key, value):
    """Attention on [B, T, heads, width per head], number by number."""
    batch, frames, heads, each = query.shape
    result = np.zeros((batch, frames, heads, each))
    for b in range(batch):
        for h in range(heads):
            for t in range(frames):
                scores = [float(query[b, t, h] @ key[b, s, h]) for s in range(key.shape[1])]
                shares = np.exp(np.array(scores) / np.sqrt(each))
                for s, share in enumerate(shares / shares.sum()):
                    result[b, t, h] += share * value[b, s, h]
    return result


def plain_multi_head(layer, asking, answering):
    heads = lambda part, x: linear(part, x).reshape(*x.shape[:2], layer.num_heads, -1)
    query, key, value = heads(layer.query, asking), heads(layer.key, answering), heads(layer.value, answering)
    return linear(layer.output, plain_attention(query, key, value).reshape(asking.shape))


def plain_norm(layer, x):
    x = x - x.mean(axis=-1, keepdims=True)
    x = x / np.sqrt((x**2).mean(axis=-1, keepdims=True) + 1e-5)
    return x * np.asarray(layer.scale[...]) + np.asarray(layer.bias[...])


def make_block(dropout=0.0):
    """A block whose every weight is random, biases and norms too."""
    return stirred(TransformerBlock(WIDTH, HEADS, HIDDEN, dropout, rngs=nnx.Rngs(params=0)), scale=0.4)


def test_position_code_by_hand():
    code = position_code(-2, 3, 4)
    assert code.shape == (5, 4)
    np.testing.assert_allclose(code[2], [0.0, 1.0, 0.0, 1.0], atol=1e-15)  # frame 0
    rate = 1000.0 ** (-2 / 4)
    np.testing.assert_allclose(code[3], [np.sin(1), np.cos(1), np.sin(rate), np.cos(rate)], atol=1e-15)
    # History frames are the negatives of future ones: sine odd, cosine even.
    np.testing.assert_allclose(code[1], code[3] * [-1, 1, -1, 1], atol=1e-15)
    assert position_code(0, 3, 5).shape == (3, 5)
    assert conditioning.position_code is position_code


def test_no_two_frames_of_a_long_window_have_one_code():
    code = position_code(-10, 64, 8)
    np.testing.assert_array_equal(code[:42], position_code(-10, 32, 8))
    np.testing.assert_allclose(code[10 + 63, :2], [np.sin(63), np.cos(63)], atol=1e-12)
    apart = np.linalg.norm(code[:, None] - code[None], axis=-1)
    assert apart[~np.eye(len(code), dtype=bool)].min() > 0.01


@pytest.mark.parametrize("rate", [0.2, 0.5])
def test_dropout_keeps_the_mean(rate):
    x = 1.0 + np.abs(draw(400, 500))
    dropped = np.asarray(dropout(jnp.asarray(x), rate, jax.random.key(0)))
    kept = dropped != 0.0
    assert kept.mean() == pytest.approx(1.0 - rate, abs=0.005)
    np.testing.assert_allclose(dropped[kept], x[kept] / (1.0 - rate), rtol=1e-6)
    assert dropped.mean() == pytest.approx(x.mean(), rel=0.01)
    other = dropout(jnp.asarray(x), rate, jax.random.key(1))
    assert (np.asarray(other != 0.0) != kept).mean() == pytest.approx(2.0 * rate * (1.0 - rate), abs=0.005)


@pytest.mark.parametrize("heads", [1, 3])
def test_attention_equals_a_plain_loop(heads):
    query, key, value = (2.0 * draw(2, frames, heads, 4, seed=seed) for seed, frames in enumerate((5, 7, 7)))
    expected = plain_attention(query, key, value)
    np.testing.assert_allclose(attention(query, key, value), expected, atol=1e-5)
    # The form that can drop weights, when it drops none.
    got = attention(query, key, value, dropout_rate=0.0, dropout_key=jax.random.key(0))
    np.testing.assert_allclose(got, expected, atol=1e-5)
    np.testing.assert_allclose(attention_weights(query, key).sum(axis=-1), 1.0, atol=1e-6)


@pytest.mark.parametrize("num_heads", [1, 2, 4])
def test_multi_head_attention_equals_a_plain_loop(num_heads):
    layer = MultiHeadAttention(WIDTH, num_heads, rngs=nnx.Rngs(params=0))
    for seed, part in enumerate((layer.query, layer.key, layer.value, layer.output)):
        part.bias[...] = jnp.asarray(draw(WIDTH, seed=seed))
    z, other = draw(2, 5, WIDTH), draw(2, 3, WIDTH, seed=1)
    np.testing.assert_allclose(layer(z), plain_multi_head(layer, z, z), atol=1e-5)
    np.testing.assert_allclose(layer(z, other), plain_multi_head(layer, z, other), atol=1e-5)


@pytest.mark.parametrize("num_heads", [0, 3])
def test_heads_must_divide_the_width(num_heads):
    message = f"divide the width {WIDTH}, got {num_heads}"
    refused(message, TransformerBlock, WIDTH, num_heads, HIDDEN, rngs=nnx.Rngs(params=0))


def test_section_3_4_1_block_has_the_weights_of_an_encoder_layer():
    block = nnx.eval_shape(lambda: TransformerBlock(256, 4, 1024, rngs=nnx.Rngs(params=0)))
    assert sum(leaf.size for leaf in jax.tree.leaves(nnx.state(block))) == 789_760


def test_section_3_4_1_block_equals_a_plain_loop():
    block, z = make_block(), draw(2, 5, WIDTH)
    gelu = lambda x: 0.5 * x * (1.0 + erf(x / np.sqrt(2.0)))
    middle = plain_norm(block.attention_norm, z + plain_multi_head(block.attention, z, z))
    hidden = gelu(linear(block.hidden, middle))
    expected = plain_norm(block.output_norm, middle + linear(block.output, hidden))
    np.testing.assert_allclose(block(z), expected, atol=1e-5)


def test_dropout_needs_a_key_and_is_a_function_of_it():
    block, z, key = make_block(dropout=0.3), draw(2, 5, WIDTH), jax.random.key(3)
    np.testing.assert_array_equal(block(z), make_block()(z))
    np.testing.assert_array_equal(block(z, key=key), block(z, key=key))
    assert float(jnp.abs(block(z, key=key) - block(z)).max()) > 0.01
    assert float(jnp.abs(block(z, key=key) - block(z, key=jax.random.key(4))).max()) > 0.01
    np.testing.assert_allclose(make_block()(z, key=key), make_block()(z), atol=1e-5)
