"""The judge's network and task: padding, order, the loss by hand, a rehearsal on toys it must and must not learn."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
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
    z = jax.random.normal(jax.random.key(1), (2, 8, 3))
    kernel = layer.taps.kernel[...].reshape(4, 3, 2)
    expected = jax.lax.conv_general_dilated(z, kernel, (2,), [(1, 1)], dimension_numbers=("NWC", "WIO", "NWC"))
    assert np.allclose(layer(z), expected + layer.taps.bias[...], atol=1e-5)


@pytest.mark.parametrize("length", [8, 10, 11])
def test_padding_changes_no_motion(network, length):
    motion = jax.random.normal(jax.random.key(0), (1, length, 5))
    lengths = jnp.array([length])
    answers = [network.embed_motion(jnp.pad(motion, ((0, 0), (0, to - length), (0, 0))), lengths) for to in (12, 40)]
    assert np.allclose(answers[0], answers[1], atol=1e-6)


def test_padding_changes_no_text_and_order_does(network):
    tokens = jax.random.normal(jax.random.key(0), (1, 4, 6))
    answer = network.embed_text(tokens, jnp.ones((1, 4), bool))
    longer = jnp.pad(tokens, ((0, 0), (0, 5), (0, 0)), constant_values=7.0)
    assert np.allclose(network.embed_text(longer, jnp.arange(9)[None] < 4), answer, atol=1e-6)
    assert not np.allclose(network.embed_text(tokens[:, ::-1], jnp.ones((1, 4), bool)), answer, atol=1e-3)


def test_time_has_a_direction(network):
    motion = jax.random.normal(jax.random.key(0), (1, 12, 5))
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
    (motion, captions), _ = task.draw(None, jax.random.key(3))
    again = draw_clips(jax.random.split(jax.random.key(3))[0], task.clips, 16, 48)
    assert np.array_equal(motion.caption, again.caption)
    assert np.array_equal(captions.pair, task.captions.pair[motion.caption])
    rate = np.abs(np.diff(np.unwrap(np.arctan2(motion.motion[:, :20, 0], motion.motion[:, :20, 1]), axis=1)))
    assert np.allclose(rate.mean(axis=1), 0.1 + 0.3 * np.asarray(captions.pair), atol=1e-4)


def test_a_training_of_nothing_is_refused():
    for settings, words in (({"num_steps": 0}, "num_steps must be"), ({"batch_size": 1}, "batches of 2 or more")):
        with pytest.raises(ValueError, match=words):
            EvaluatorTraining(**settings)
