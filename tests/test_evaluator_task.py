"""The judge's network and task: padding, order, the loss by hand, a rehearsal on toys it must and must not learn."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from builders import draw
from compiled import Compiled
from flax import nnx

from f3amd_lib.text.data.text_motions import ClipTable, draw_clips
from f3amd_lib.text.judge.text_judge import (
    Captions,
    EvaluatorTask,
    EvaluatorTraining,
    HalvingConvolution,
    TextMotionConfig,
    TextMotionNetwork,
    contrastive_loss,
)
from f3amd_lib.training.optimise import optimise

SMALL = TextMotionConfig(
    features=5, token_width=6, movement_width=16, motion_hidden=16, text_hidden=16, embedding_width=8
)


@pytest.fixture(scope="module")
def network():
    return Compiled(TextMotionNetwork(SMALL, rngs=nnx.Rngs(0)))


def test_the_halving_convolution_is_one_of_four_taps():
    layer = HalvingConvolution(3, 2, rngs=nnx.Rngs(0))
    z = draw(2, 8, 3, seed=1)
    kernel = layer.taps.kernel[...].reshape(4, 3, 2)
    expected = jax.lax.conv_general_dilated(z, kernel, (2,), [(1, 1)], dimension_numbers=("NWC", "WIO", "NWC"))
    assert np.allclose(layer(z), expected + layer.taps.bias[...], atol=1e-5)


@pytest.mark.parametrize("length", [8, 10, 11])
def test_padding_changes_no_motion(network, length):
    motion = draw(1, length, 5, seed=0)
    lengths = jnp.array([length])
    answers = [network.embed_motion(jnp.pad(motion, ((0, 0), (0, to - length), (0, 0))), lengths) for to in (12, 40)]
    assert np.allclose(answers[0], answers[1], atol=1e-6)


def test_padding_changes_no_text_and_order_does(network):
    tokens = draw(1, 4, 6, seed=0)
    answer = network.embed_text(tokens, jnp.ones((1, 4), bool))
    longer = jnp.pad(tokens, ((0, 0), (0, 5), (0, 0)), constant_values=7.0)
    assert np.allclose(network.embed_text(longer, jnp.arange(9)[None] < 4), answer, atol=1e-6)
    assert not np.allclose(network.embed_text(tokens[:, ::-1], jnp.ones((1, 4), bool)), answer, atol=1e-3)


def leaky(x):
    return np.where(x < 0, 0.2 * x, x)


def linear(layer, x):
    return x @ np.asarray(layer.kernel[...]) + np.asarray(layer.bias[...])


def halved(layer, x):
    """PyTorch's Conv1d(width, width, 4, stride 2, padding 1) of [F, C]."""
    kernel = np.asarray(layer.taps.kernel[...]).reshape(4, x.shape[1], -1)
    x = np.pad(x, ((1, 1), (0, 0)))
    taps = [sum(x[at + k] @ kernel[k] for k in range(4)) for at in range(0, len(x) - 3, 2)]
    return np.array(taps) + np.asarray(layer.taps.bias[...])


def recurred(cell, x, h):
    """The last state of PyTorch's GRU over [T, C]: n = tanh(W x + b + r (U h + c)), h' = (1 - z) n + z h."""
    sigmoid = lambda x: 1.0 / (1.0 + np.exp(-x))
    for one in x:
        (r_x, z_x, n_x), (r_h, z_h, n_h) = (
            np.split(linear(layer, given), 3) for layer, given in ((cell.dense_i, one), (cell.dense_h, h))
        )
        r, z = sigmoid(r_x + r_h), sigmoid(z_x + z_h)
        h = (1.0 - z) * np.tanh(n_x + r * n_h) + z * h
    return h


def both_ways(part, x):
    """Guo et al.'s BiGRUCo over the tokens that count: linear, GRU, linear, LayerNorm, LeakyReLU(0.2), linear."""
    x, start = linear(part.inside, x), np.asarray(part.start[...])
    last = [recurred(part.forwards.cell, x, start[0]), recurred(part.backwards.cell, x[::-1], start[1])]
    x = linear(part.middle, np.concatenate(last))
    x = (x - x.mean()) / np.sqrt(x.var() + 1e-5) * np.asarray(part.norm.scale[...]) + np.asarray(part.norm.bias[...])
    return linear(part.output, leaky(x))


def test_each_layer_is_pytorchs_own():
    """Random weights, biases too; a norm's input of little deviation shows its epsilon."""
    config = dataclasses.replace(SMALL, released=True, tag_width=3)
    graph, params = nnx.split(TextMotionNetwork(config, rngs=nnx.Rngs(0)))
    rng = np.random.default_rng(1)
    params = jax.tree.map(lambda leaf: (0.3 * rng.standard_normal(leaf.shape)).astype(leaf.dtype), params)
    network = nnx.merge(graph, params)
    for part in (network.motion, network.text):
        part.middle.kernel[...], part.middle.bias[...] = 1e-3 * part.middle.kernel[...], 1e-3 * part.middle.bias[...]
    motion, lengths, network = np.array(draw(2, 24, 5, seed=2)), (12, 19), Compiled(network)
    motion[0, 12:], motion[1, 19:] = 0.0, 0.0
    made = network.embed_motion(motion, np.array(lengths))
    for seen, length, answer in zip(motion, lengths, made, strict=True):
        once = halved(network.movement[0], seen)
        np.testing.assert_allclose(network.movement[0](seen[None])[0], once, atol=1e-5)
        twice = halved(network.movement[1], leaky(once))
        tokens = linear(network.movement_output, leaky(twice))[: length // 4]
        told = network.motion(jnp.asarray(tokens)[None], jnp.array([len(tokens)]))[0]
        wanted = both_ways(network.motion, tokens)
        np.testing.assert_allclose(told, wanted, atol=1e-4)
        np.testing.assert_allclose(answer, wanted, atol=1e-4)
    words, tags = (np.array(draw(2, 6, width, seed=k)) for k, width in ((3, 6), (4, 3)))
    mask = np.arange(6) < np.array([[4], [6]])
    for given in ((words, mask), (words, mask, tags)):
        tagged = words + linear(network.tags, tags) if len(given) == 3 else words
        wanted = [both_ways(network.text, row[kept]) for row, kept in zip(tagged, mask, strict=True)]
        np.testing.assert_allclose(network.embed_text(*given), wanted, atol=1e-4)


def test_time_has_a_direction(network):
    motion = draw(1, 12, 5, seed=0)
    there, back = (network.embed_motion(m, jnp.array([12])) for m in (motion, motion[:, ::-1]))
    assert not np.allclose(there, back, atol=1e-3)


def test_the_loss_by_hand():
    points = jnp.array([[0.0, 0, 0, 0], [2.0, 0, 0, 0]])
    loss, accuracy = contrastive_loss(points, points, jnp.array([0, 1]))
    assert loss == pytest.approx(np.log1p(np.exp(-2.0))) and accuracy == 1
    swapped, wrong = contrastive_loss(points, points[::-1], jnp.array([0, 1]))
    assert swapped == pytest.approx(np.log1p(np.exp(2.0))) and wrong == 0
    # Another clip of the same pair is no rival.
    assert contrastive_loss(points, points[::-1], jnp.array([3, 3]))[0] == 0


def toy(honest: bool, pairs=4, clips=64, seed=0) -> EvaluatorTask:
    """Clips that oscillate at a rate which their caption tells, or, dishonestly, does not."""
    generator = np.random.default_rng(seed)
    kind = np.arange(clips) % pairs
    frames, start, count = [], [0], np.full(clips, 2)
    for number in range(clips):
        length = 4 * generator.integers(6, 12)
        angle = (0.1 + 0.3 * kind[number]) * np.arange(length) + generator.uniform(0, 6)
        channels = [np.sin(angle), np.cos(angle), 0 * angle, 0 * angle, generator.normal(size=length)]
        frames.append(np.stack(channels, axis=-1))
        start.append(start[-1] + length)
    table = ClipTable(
        jnp.asarray(np.concatenate(frames), jnp.float32),
        *(jnp.asarray(column, jnp.int32) for column in (start[:-1], np.diff(start), 2 * np.arange(clips), count)),
    )
    told = np.repeat(kind if honest else generator.permutation(kind), 2)
    words = generator.normal(size=(pairs, 3, 6))
    tokens = (words[told] + 0.1 * generator.normal(size=(2 * clips, 3, 6))).astype(np.float32)
    captions = Captions(*map(jnp.asarray, (tokens, np.ones((2 * clips, 3), bool), np.repeat(kind, 2))))
    return EvaluatorTask(SMALL, EvaluatorTraining(100, 16, 3e-3, seed, num_frames=48), table, captions, "toy")


def held_out_accuracy(honest: bool, seed: int) -> float:
    """Share of texts that find their motion among clips that were never trained on."""
    task, other = toy(honest, seed=seed), toy(honest, seed=seed + 100)
    # The same words for the same rates: only the clips are new.
    other = EvaluatorTask(SMALL, other.config, other.clips, task.captions, "toy")
    state, history = optimise(task, progress=False)
    batch, _ = other.draw(None, jax.random.key(5))
    assert history[-1]["loss"] < history[0]["loss"]
    return float(task.held_out_terms(state.params, None, batch, None)["accuracy"])


@pytest.mark.slow
def test_it_learns_what_captions_tell_and_not_what_they_do_not():
    honest = [held_out_accuracy(True, seed) for seed in (0, 1, 2)]
    lying = held_out_accuracy(False, 0)
    assert min(honest) > 0.7 > 0.5 > lying, (honest, lying)


def test_a_batch_carries_the_captions_of_its_clips():
    task = toy(True)
    (motion, captions), _ = jax.jit(task.draw)(None, jax.random.key(3))
    again = jax.jit(draw_clips, static_argnums=(2, 3))(jax.random.split(jax.random.key(3))[0], task.clips, 16, 48)
    assert np.array_equal(motion.caption, again.caption)
    assert np.array_equal(captions.pair, task.captions.pair[motion.caption])
    rate = np.abs(np.diff(np.unwrap(np.arctan2(motion.motion[:, :20, 0], motion.motion[:, :20, 1]), axis=1)))
    assert np.allclose(rate.mean(axis=1), 0.1 + 0.3 * np.asarray(captions.pair), atol=1e-4)
