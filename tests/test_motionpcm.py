"""MotionPCM's networks: sizes of the paper, what each input changes, and a student that begins as its teacher."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from builders import draw, refused
from compiled import Compiled
from flax import nnx

from f3amd_lib.networks import presets
from f3amd_lib.text.networks import motionpcm

SMALL = {"window": 4, "channels": 3, "latent_width": 16, "depth": 1, "num_heads": 2, "hidden_width": 32}


@pytest.fixture(scope="module")
def teacher():
    config = motionpcm.LatentDenoiserConfig(**SMALL, text_width=5, time_features=12)
    return Compiled(motionpcm.LatentDenoiser(config, rngs=nnx.Rngs(0)))


@pytest.fixture(scope="module")
def coders():
    """An autoencoder for each path between frames and tokens."""
    config, rngs = motionpcm.LatentAutoencoderConfig(**SMALL, features=7, num_positions=40), nnx.Rngs(0)
    return {
        path: Compiled(motionpcm.LatentAutoencoder(dataclasses.replace(config, path=path), rngs=rngs))
        for path in ("attention", "spans")
    }


def normal(seed, *shape):
    return draw(*shape, seed=seed)


def one_more(array, *place):
    copy = np.array(array)
    copy[place] += 1.0
    return copy


def numbers(module):
    return sum(leaf.size for leaf in jax.tree.leaves(nnx.state(module, nnx.Param)))


# --------------------------------------------------------------------------------------------------------------- sizes


def test_sizes_are_the_papers():
    config = motionpcm.SkipTransformerConfig()
    for crossing, millions in ((False, 7.63), (True, 10.01)):
        make = lambda crossing=crossing: motionpcm.SkipTransformer(config, crossing=crossing, rngs=nnx.Rngs(0))
        assert round(numbers(nnx.eval_shape(make)) / 1e6, 2) == millions
    count = lambda name: presets.count_parameters(presets.build_config(name))
    teacher, student = count("MotionPCM-teacher"), count("MotionPCM-M1")
    assert round(teacher / 1e6, 2) == 8.24 and student - teacher == 256 * 768  # 0.20 M
    config = presets.build_config("MotionPCM-VAE", features=263)
    assert (config.window, config.channels, config.depth) == (16, 32, 9)


def test_presets_name_every_row_of_the_paper_and_survive_json():
    found = presets.of_paper("motionpcm")
    for name in found:
        config = presets.build_config(name)
        assert presets.config_from_dict(config.to_dict()) == config
    assert {preset.latent for preset in found.values()} <= {"", *found}
    refused("depth must be odd", motionpcm.SkipTransformerConfig, depth=4)


# --------------------------------------------------------------------------------------------------------- autoencoder


@pytest.mark.parametrize("path", ["attention", "spans"])
def test_a_latent_has_one_size_and_padding_changes_nothing(coders, path):
    coder = coders[path]
    clip, mask = normal(0, 2, 12, 7), jnp.arange(12) < jnp.asarray([[12], [8]])
    mean, log_variance = coder.encode(clip, mask)
    assert mean.shape == log_variance.shape == (2, 4, 3)
    spoilt = jnp.where(mask[..., None], clip, 1e3)
    np.testing.assert_allclose(coder.encode(spoilt, mask)[0], mean, atol=1e-5)
    np.testing.assert_allclose(coder.encode(clip[1:, :8], mask[1:, :8])[0], mean[1:], atol=1e-5)
    assert np.abs(coder.encode(one_more(clip, 1, 7), mask)[0] - mean)[1].max() > 1e-4
    made = coder.decode(mean, mask)
    assert made.shape == clip.shape and not made[1, 8:].any() and made[1, :8].all()
    np.testing.assert_allclose(coder.decode(mean[1:], mask[1:, :8]), made[1:, :8], atol=1e-5)
    # Every frame hears the latent, and is a frame of its own.
    assert np.abs(coder.decode(mean + 1.0, mask) - made)[0].max(axis=-1).min() > 1e-3
    assert np.abs(np.diff(made[0], axis=0)).max(axis=-1).min() > 1e-3
    refused("at most 32, 7", coder.encode, normal(0, 1, 33, 7), jnp.ones((1, 33), bool))


def test_a_frame_belongs_to_the_spans_about_it():
    shares = np.asarray(motionpcm.span_shares(jnp.arange(6) < jnp.asarray([[6], [4]]), 2))
    # Middles of the spans are at frames 1 and 4 of six, at 0.5 and 2.5 of four.
    np.testing.assert_allclose(shares[0, :, 1], [0, 0, 1 / 3, 2 / 3, 1, 1], atol=1e-6)
    np.testing.assert_allclose(shares[1, :, 1], [0, 0.25, 0.75, 1, 0, 0], atol=1e-6)
    np.testing.assert_allclose(shares.sum(axis=-1), [[1] * 6, [1] * 4 + [0] * 2], atol=1e-6)


def test_with_spans_each_token_begins_with_its_own_frames(coders):
    clip, mask, began = normal(0, 1, 12, 7), jnp.ones((1, 12), bool), {}
    for path, coder in coders.items():
        mean, log_variance = coder.encode(clip, mask)
        heard = np.abs(coder.encode(one_more(clip, 0, 0), mask)[0] - mean)[0].max(axis=-1)
        made = coder.decode(mean, mask)
        moved = np.abs(coder.decode(one_more(mean, 0, 0), mask) - made)[0].max(axis=-1)
        began[path] = heard, moved, np.exp(0.5 * log_variance).mean()
    heard, moved, noise = began["spans"]
    assert heard[0] > 1e-2 and not heard[1:].any() and (moved[:4] > 1e-2).all() and not moved[5:].any() and noise < 0.2
    heard, moved, noise = began["attention"]  # all tokens and all frames hear of everything
    assert (heard[1:] > 1e-3).all() and (moved[5:] > 1e-3).all() and noise > 0.5


def test_the_second_half_is_handed_the_first_in_reverse():
    config = motionpcm.SkipTransformerConfig(**{**SMALL, "depth": 5})
    body = motionpcm.SkipTransformer(config, rngs=nnx.Rngs(1))
    outputs = nnx.jit(lambda body, z: list(body.outputs(z)))(body, normal(0, 1, 4, 16))
    assert len(outputs) == 5
    joined = lambda number, kept, z: body.blocks[number](body.joins[number - 3](jnp.concatenate([z, kept], -1)))
    np.testing.assert_allclose(joined(3, outputs[1], outputs[2]), outputs[3], atol=1e-5)
    np.testing.assert_allclose(joined(4, outputs[0], outputs[3]), outputs[4], atol=1e-5)
    assert np.abs(joined(4, outputs[1], outputs[3]) - outputs[4]).max() > 1e-3


# -------------------------------------------------------------------------------------------------- teacher and student


def test_waves_are_those_of_the_released_code():
    np.testing.assert_allclose(motionpcm.waves(3.0, 4, 2.0), [*np.cos([3.0, 0.03]), *np.sin([3.0, 0.03])], rtol=1e-5)
    told = motionpcm.waves(3.0, 4, 1.0, sine_first=True)
    np.testing.assert_allclose(told, [*np.sin([3.0, 3e-4]), *np.cos([3.0, 3e-4])], rtol=1e-5)


def test_a_student_is_its_teacher_at_first_whatever_it_is_told(teacher):
    state, context = normal(1, 3, 4, 3), teacher.encode(normal(2, 3, 5))
    time, told = jnp.asarray([999, 499, 99]), jnp.asarray([0.0, 5.0, 15.0])
    student, answer = Compiled(motionpcm.student_of(teacher.network, jax.random.key(9))), teacher(state, time, context)
    np.testing.assert_array_equal(student(state, time, context, told), answer)
    student.guidance.kernel[...] = 0.1 * normal(3, *student.guidance.kernel.shape)
    moved = student(state, time, context, told)
    assert np.abs(moved - answer).max(axis=(1, 2)).min() > 1e-4
    # It still is where nothing is told, and one guidance is not another.
    np.testing.assert_array_equal(student(state, time, context), answer)
    assert np.abs(student(state, time, context, told + 1.0) - moved).max() > 1e-4
    assert dataclasses.replace(student.config, guidance_features=0) == teacher.config


def test_guidance_joins_the_waves_of_the_time_before_their_layers(teacher):
    """Waves of 1,000 w, sines first, last frequency 1/10,000, by a layer without bias (MotionLCM's released code)."""
    student = motionpcm.student_of(teacher.network, jax.random.key(9))
    kernel = 0.1 * normal(3, 256, 12)
    student.guidance.kernel[...] = kernel
    w, time = 7.25, 499
    angle = 1000.0 * w * 10000.0 ** (-np.arange(128) / 127.0)
    told = np.r_[np.sin(angle), np.cos(angle)]
    of_time = np.asarray(motionpcm.waves(time, 12, 6.0)) + told @ np.asarray(kernel)
    wanted = student.time_second(jax.nn.silu(student.time_first(jnp.asarray(of_time, jnp.float32))))
    asked = normal(1, 1, 4, 3), jnp.asarray([time]), student.encode(normal(2, 1, 5)), jnp.asarray([w])
    found = student._tokens(*asked)[0, 4] - student.positions[...][4]  # after the four tokens of the latent
    np.testing.assert_allclose(found, wanted, atol=2e-3)
    away = student._tokens(*asked[:3], jnp.asarray([w + 0.01]))[0, 4] - student.positions[...][4]
    assert np.abs(away - wanted).max() > 2e-2


@pytest.mark.parametrize("change", ["state", "time", "text"])
def test_each_input_moves_the_answer(teacher, change):
    inputs = {"state": normal(1, 1, 4, 3), "time": jnp.asarray([499.0]), "text": normal(2, 1, 5)}
    answer = lambda state, time, text: teacher(state, time, teacher.encode(text))
    moved = {**inputs, change: inputs[change] + 1.0}
    assert np.abs(answer(**moved) - answer(**inputs)).max() > 1e-4
    refused(r"state must be \[B, 4, 3\]", answer, **{**inputs, "state": normal(1, 1, 5, 3)})


# ------------------------------------------------------------------------------------------------------- discriminator


def test_a_discriminator_reads_every_block_and_lets_the_gradient_through():
    config = motionpcm.LatentDenoiserConfig(**{**SMALL, "depth": 3}, text_width=5, time_features=12)
    teacher = Compiled(motionpcm.LatentDenoiser(config, rngs=nnx.Rngs(0)))
    of_critic = motionpcm.DiscriminatorConfig(latent_width=16, depth=3, heads=2)
    critic = Compiled(motionpcm.Discriminator(of_critic, rngs=nnx.Rngs(4)))
    context = teacher.encode(normal(2, 2, 5))
    scores = lambda state: critic(teacher.features(state, jnp.asarray([199, 499]), context))
    state = normal(1, 2, 4, 3)
    assert scores(state).shape == (2, 3, 2, 4)
    assert np.abs(jax.grad(lambda z: scores(z).mean())(state)).min() > 0
    features = teacher.features(state, jnp.asarray([199, 499]), context)
    spoilt = [features[0] + normal(5, 2, 4, 16), *features[1:]]
    changed = np.abs(critic(spoilt) - scores(state)).max(axis=(0, 2, 3))
    assert changed[0] > 1e-3 and not changed[1:].any()
