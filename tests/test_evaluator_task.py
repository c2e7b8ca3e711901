"""The judge's network and task: padding, order, the loss by hand, a rehearsal on toys it must and must not learn."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from builders import draw
from compiled import Compiled
from flax import nnx

from f3amd_lib.text.data.text_motions import ClipTable, draw_clips
from f3amd_lib.text.judge import text_judge

SMALL = text_judge.TextMotionConfig(
    features=5, token_width=6, movement_width=16, motion_hidden=16, text_hidden=16, embedding_width=8
)


@pytest.fixture(scope="module")
def network():
    return Compiled(text_judge.TextMotionNetwork(SMALL, rngs=nnx.Rngs(0)))


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


def test_the_loss_by_hand():
    points = jnp.array([[0.0, 0, 0, 0], [2.0, 0, 0, 0]])
    loss, accuracy = text_judge.contrastive_loss(points, points, jnp.array([0, 1]))
    assert loss == pytest.approx(np.log1p(np.exp(-2.0))) and accuracy == 1
    swapped, wrong = text_judge.contrastive_loss(points, points[::-1], jnp.array([0, 1]))
    assert swapped == pytest.approx(np.log1p(np.exp(2.0))) and wrong == 0
    # Another clip of the same pair is no rival.
    assert text_judge.contrastive_loss(points, points[::-1], jnp.array([3, 3]))[0] == 0


def toy(honest: bool, pairs=4, clips=64, seed=0) -> text_judge.EvaluatorTask:
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
    captions = text_judge.Captions(*map(jnp.asarray, (tokens, np.ones((2 * clips, 3), bool), np.repeat(kind, 2))))
    training = text_judge.EvaluatorTraining(100, 16, 3e-3, seed, num_frames=48)
    return text_judge.EvaluatorTask(SMALL, training, table, captions, "toy")


def test_a_batch_carries_the_captions_of_its_clips():
    task = toy(True)
    (motion, captions), _ = jax.jit(task.draw)(None, jax.random.key(3))
    again = jax.jit(draw_clips, static_argnums=(2, 3))(jax.random.split(jax.random.key(3))[0], task.clips, 16, 48)
    assert np.array_equal(motion.caption, again.caption)
    assert np.array_equal(captions.pair, task.captions.pair[motion.caption])
    rate = np.abs(np.diff(np.unwrap(np.arctan2(motion.motion[:, :20, 0], motion.motion[:, :20, 1]), axis=1)))
    assert np.allclose(rate.mean(axis=1), 0.1 + 0.3 * np.asarray(captions.pair), atol=1e-4)
