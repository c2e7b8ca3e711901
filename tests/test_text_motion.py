"""Training of ACMDM's parts: what is drawn, what is asked, and a rehearsal of each task."""

import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiled import Compiled
from flax import nnx

from f3amd_lib.diffusion.schedules import straight, variance_preserving_betas
from f3amd_lib.ground.profiles import load_profile
from f3amd_lib.networks import presets
from f3amd_lib.text.data.text_motions import AxisNormaliser, ClipTable
from f3amd_lib.text.networks import acmdm
from f3amd_lib.text.networks.autoencoders import AutoencoderConfig
from f3amd_lib.text.stages.acmdm_training import (
    ControlTask,
    TextMotionTask,
    TextMotionTraining,
    control_loss,
    denoising_loss,
    draw_captioned,
    draw_control,
    frame_error,
    noisy_state,
)
from f3amd_lib.text.stages.motionpcm_training import LatentMotionTraining
from f3amd_lib.text.stages.text_models import MotionCodec
from f3amd_lib.text.stages.train_stage import stage_recipe
from f3amd_lib.training.checkpoints import network_with
from f3amd_lib.training.optimise import initial_state, optimise

BETAS = variance_preserving_betas(50, 0.002, 0.4, power=1)
CLIPS, FRAMES, JOINTS = 6, 40, 3
SIZE = {"num_joints": JOINTS, "latent_width": 16, "depth": 1, "num_heads": 2, "text_width": 4}
AUTOENCODER = AutoencoderConfig(width=8, dilations=(1,), dropout=0.0)
LENGTHS = jnp.asarray([40, 40, 40, 24, 24, 12])


def clips():
    """Swinging joints in metres, zero-padded: [6, 40, 3, 3]; and their frames."""
    frame, joint = np.arange(FRAMES)[:, None], np.arange(JOINTS)
    height, ahead = 1.0 + 0.1 * joint + 0 * frame, 0.05 * frame + 0 * joint
    motion = [np.stack([np.sin(0.2 * frame + joint + seed), height, ahead], -1) for seed in range(CLIPS)]
    mask = np.arange(FRAMES) < np.asarray(LENGTHS)[:, None]
    return jnp.asarray(motion, jnp.float32), jnp.asarray(mask)


POSITIONS, MASK = clips()
CODEC = MotionCodec(AxisNormaliser(jnp.asarray([0.0, 1.0, 1.0]), jnp.asarray([0.7, 0.5, 0.6])))
NORMALISED = CODEC.axes.normalise(POSITIONS) * MASK[..., None, None]
POOLED = jax.random.normal(jax.random.key(1), (12, 4))
COUNTS = jnp.asarray([3, 1, 2, 3, 1, 2])
OWNER = np.repeat(np.arange(CLIPS), COUNTS)


def table(frames, mask):
    """Padded frames [6, L, ...] as clips."""
    length = mask.sum(axis=1)
    rows = jax.tree.map(lambda padded: padded[np.asarray(mask)], frames)
    return ClipTable(rows, jnp.cumsum(length) - length, length, jnp.cumsum(COUNTS) - COUNTS, COUNTS)


RAW = table(NORMALISED, MASK)


def latent_codec():
    params = nnx.state(presets.build_from_config(AUTOENCODER, jax.random.key(2)))
    return CODEC.with_latent(AUTOENCODER, params, NORMALISED, MASK)


def recipe(**settings):
    small = {"num_steps": 3, "batch_size": 4, "warmup_steps": 1, "learning_rate": 1e-2, "seed": 0, "ema_decay": 0.9}
    return TextMotionTraining(**{**small, **settings})


# -------------------------------------------------------------------------------------------------------------- recipes


@pytest.mark.parametrize(
    "training, part, preset, steps",
    [
        (TextMotionTraining, "denoiser", "ACMDM-S-PS22", 23_384 // 64 * 500),
        (TextMotionTraining, "control", "ACMDM-S-PS22", 23_384 // 64 * 500),
        (LatentMotionTraining, "autoencoder", "MotionPCM-VAE", 6000 * 192),
        (LatentMotionTraining, "teacher", "MotionPCM-teacher", 3000 * 384),
        (LatentMotionTraining, "student", "MotionPCM-M1", 384_000),
    ],
)
def test_the_gpu_trains_as_long_as_the_paper_and_others_as_long_as_they_are_asked(training, part, preset, steps):
    made = lambda profile, **asked: stage_recipe(training, part, load_profile(profile, "bandai", **asked), preset)
    assert made("gpu").num_steps == steps and made("gpu", train_steps=70).num_steps == 70
    few, many = (made("laptop", train_steps=count).num_steps for count in (1000, 12_000))
    assert many == 12 * few < steps


def test_the_rate_warms_up_and_drops_as_told():
    gpu = load_profile("gpu", "bandai", train_steps=100_000)
    paper = dataclasses.replace(stage_recipe(TextMotionTraining, "denoiser", gpu), drops=(50_000, 70_000))
    steps = (0, 999, 1999, 49_999, 50_000, 70_000)
    rates = [float(paper.rate(jnp.asarray(step))) for step in steps]
    np.testing.assert_allclose(rates, 2e-4 * np.array([1 / 2000, 0.5, 1, 1, 0.1, 0.01]), rtol=1e-5)
    short = recipe(schedule="warmup_cosine", num_steps=101, warmup_steps=1)
    np.testing.assert_allclose([short.rate(step) for step in (0, 1, 51, 101)], [0.01, 0.01, 0.00505, 1e-4], rtol=1e-5)


# ----------------------------------------------------------------------------------------------------------------- data


def test_what_is_drawn_belongs_together():
    batch, told = draw_captioned(jax.random.key(0), RAW, POOLED, recipe(batch_size=256, text_dropout=0.25, unit=4), 16)
    caption, length = np.asarray(batch.caption), np.asarray(batch.length)
    assert set(caption) == set(range(12)) and set(length) == {12, 16, 8}
    np.testing.assert_array_equal(told.mask, batch.mask)
    for n in range(256):
        clip = np.asarray(NORMALISED[OWNER[caption[n]]])
        frames = np.asarray(batch.motion[n, : length[n]])
        assert any(np.array_equal(frames, clip[s : s + length[n]]) for s in range(FRAMES - length[n] + 1))
    said = np.asarray((told.pooled == POOLED[caption]).all(axis=1))
    np.testing.assert_array_equal(np.asarray(told.pooled)[~said], 0.0)
    assert 166 < said.sum() < 218


def test_control_is_one_joint_in_some_but_not_all_frames():
    control = draw_control(jax.random.key(3), jnp.repeat(NORMALISED, 50, axis=0), jnp.repeat(MASK, 50, axis=0), (0, 2))
    asked, lengths = np.asarray(control.asked), np.repeat(np.asarray(LENGTHS), 50)
    frames = asked.max(axis=2).sum(axis=1)
    assert ((asked.max(axis=1) > 0).sum(axis=1) == 1).all() and not asked[:, :, 1].any() and asked[:, :, 2].any()
    assert (frames >= 1).all() and (frames <= lengths - 1).all() and frames[:150].max() > 30
    assert not np.any(np.asarray(control.positions)[asked == 0])
    there = asked[..., None] * np.repeat(np.asarray(NORMALISED), 50, axis=0)
    np.testing.assert_array_equal(control.positions, there)


def test_a_codec_goes_to_standard_states_and_back():
    np.testing.assert_array_equal(CODEC.encode(NORMALISED, MASK), NORMALISED)
    codec = latent_codec()
    state = jax.jit(codec.encode)(NORMALISED, MASK)
    assert state.shape == (CLIPS, 10, JOINTS, 4) and codec.frames_per_state == 4
    inside = np.asarray(state)[np.asarray(MASK[:, ::4])]
    np.testing.assert_allclose(inside.mean(axis=(0, 1)), 0.0, atol=1e-4)
    np.testing.assert_allclose(inside.std(axis=(0, 1)), 1.0, atol=1e-3)
    assert not np.any(np.asarray(state)[~np.asarray(MASK[:, ::4])])
    model = Compiled(network_with(AUTOENCODER, codec.params))
    np.testing.assert_allclose(
        jax.jit(codec.decode)(state, MASK)[0], model.decode(model.encode(NORMALISED[:1]))[0], atol=1e-4
    )


def test_times_are_one_a_sample_or_one_a_block():
    x0, noise = jnp.full((64, 10, 2, 3), 2.0), jnp.ones((64, 10, 2, 3))
    state, t, alpha, sigma = noisy_state(jax.random.key(0), straight(), x0, noise)
    assert t.shape == (64,) and alpha.shape == sigma.shape == (64, 1, 1, 1)
    np.testing.assert_allclose(state[:, 3, 1, 2], 2.0 * t + (1.0 - t), rtol=1e-6)
    state, t, *_ = noisy_state(jax.random.key(0), straight(), x0, noise, 4)
    t = np.asarray(t)
    assert t.shape == (64, 10)
    assert (t[:, :4] == t[:, :1]).all() and (t[:, 8] == t[:, 9]).all()
    assert (t[:, 0] != t[:, 4]).all()
    np.testing.assert_allclose(state[:, :, 1, 2], 1.0 + t, rtol=1e-6)


def test_only_frames_that_count_make_the_error():
    target = jnp.zeros((2, 4, 1, 2))
    prediction = target.at[0, 1].set(3.0).at[1, 3].set(5.0)
    counted = jnp.asarray([[True, True, False, False], [True, False, False, False]])
    assert float(frame_error(prediction, target, counted)) == pytest.approx(9.0 / 3)
    assert float(frame_error(prediction, target, jnp.zeros((2, 4), bool))) == 0.0


class Known:
    """A network that knows the answer: it says `give(state, time)`."""

    def __init__(self, config, give):
        self.config, self.give = config, give

    def encode(self, condition):
        return condition

    def __call__(self, state, time, context):
        return self.give(state, time)


def test_the_loss_asks_for_what_the_objective_says():
    """Data that are all one value: x0, eps and v follow from the state and the time, and the loss is 0."""
    told = acmdm.TextCondition(POOLED[:CLIPS], MASK)
    x0 = jnp.full((CLIPS, FRAMES, JOINTS, 3), 0.4)
    t = lambda time: time[:, None, None, None]
    noise = lambda state, time: (state - t(time) * 0.4) / (1.0 - t(time))
    gives = {
        "x0": lambda state, time: jnp.full_like(state, 0.4), "eps": noise,
        "v": lambda state, time: 0.4 - noise(state, time),
    }  # fmt: skip
    for objective in gives:
        config = acmdm.ACMDMConfig(**SIZE, channels=3, window=FRAMES, objective=objective)
        loss = lambda give, config=config: denoising_loss(Known(config, give), straight(), x0, told, jax.random.key(4))
        losses = {name: float(loss(give)) for name, give in gives.items()}
        assert losses[objective] < 1e-6 and all(loss > 0.1 for name, loss in losses.items() if name != objective)


def test_a_prefix_is_clean_and_counts_for_nothing():
    told = acmdm.TextCondition(POOLED[:CLIPS], jnp.ones_like(MASK))
    config = acmdm.ACMDMConfig(**SIZE, channels=3, window=FRAMES, objective="x0")
    seen = []

    def give(state, time):
        seen.append(state)
        return NORMALISED.at[:, :5].add(100.0)  # wrong in the prefix alone

    def loss(prefix_frames):
        known, key = Known(config, give), jax.random.key(5)
        return float(denoising_loss(known, straight(), NORMALISED, told, key, prefix_frames=prefix_frames))

    assert loss(5) == 0.0
    np.testing.assert_array_equal(seen[0][:, :5], NORMALISED[:, :5])
    assert float(jnp.abs(seen[0][:, 5] - NORMALISED[:, 5]).max()) > 0.1
    assert loss(4) > 10.0


# ----------------------------------------------------------------------------------------------------------- rehearsals


def rehearse(task, held_out, steps=3):
    """Take a few steps; return (state before, state after)."""
    before = initial_state(task)
    after, history = optimise(task, before, chunk=steps, held_out=held_out, progress=False)
    assert int(after.step) == steps and np.isfinite(history[-1]["held_out_loss"])
    return before, after


def changed(before, after):
    """Names of the weights that training moved."""
    pairs = zip(jax.tree_util.tree_leaves_with_path(before.params), jax.tree.leaves(after.params), strict=True)
    return {
        jax.tree_util.keystr(path).removesuffix(".value")
        for (path, old), new in pairs
        if float(jnp.abs(new - old).max()) > 0
    }


@pytest.mark.slow
def test_a_text_decides_what_is_learnt():
    """Two clips that are one value each, and two captions: after some steps each caption brings its own value."""
    states = jnp.stack([jnp.full((8, JOINTS, 3), value) for value in (-1.0, 1.0)])
    columns = ([0, 8], [8, 8], [0, 1], [1, 1])
    clips = ClipTable(states.reshape(16, JOINTS, 3), *(jnp.asarray(column) for column in columns))
    config = acmdm.ACMDMConfig(**SIZE, channels=3, window=8, objective="x0")
    task = TextMotionTask(
        config, recipe(num_steps=60, batch_size=16, text_dropout=0.0), clips, straight(), jnp.eye(4)[:2]
    )
    _, state = rehearse(task, task.draw(None, jax.random.key(1))[0], 60)
    network = network_with(config, state.params)
    told = acmdm.TextCondition(jnp.eye(4)[:2], jnp.ones((2, 8), bool))
    answer = network(jax.random.normal(jax.random.key(6), (2, 8, JOINTS, 3)), 0.0, network.encode(told))
    np.testing.assert_allclose(answer.mean(axis=(1, 2, 3)), [-1.0, 1.0], atol=0.4)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("family", "network", "training", "schedule"),
    [
        (acmdm.ACMDMConfig, {}, {}, straight()),
        (acmdm.ACMDMConfig, {"objective": "eps", "patch": "pair"}, {}, BETAS),
        (acmdm.ACMDMConfig, {"window": 6}, {"prefix_frames": 2}, straight()),
        (acmdm.ACMDMConfig, {"block_frames": 4}, {}, straight()),
        (acmdm.MaskedACMDMConfig, {}, {}, straight()),
    ],
)
def test_every_form_takes_training_steps(family, network, training, schedule):
    clips = table(latent_codec().encode(NORMALISED, MASK), MASK[:, ::4])
    task = TextMotionTask(family(**{**SIZE, "window": 10, **network}), recipe(**training), clips, schedule, POOLED)
    before, after = rehearse(task, task.draw(None, jax.random.key(1))[0])
    # From zero gates on, the last layer moves first and the others after it.
    assert {"['output']['kernel']", "['blocks'][0]['query_key_value']['kernel']", "['text']['kernel']"} <= changed(
        before, after
    )
    json.dumps(task.identity())


@pytest.mark.slow
def test_a_control_branch_trains_beside_a_frozen_base():
    codec = latent_codec()
    positions = NORMALISED.reshape(CLIPS, 10, 4, JOINTS, 3)
    clips = table((codec.encode(NORMALISED, MASK), positions), MASK[:, ::4])
    config = acmdm.ACMDMConfig(**SIZE, window=10)
    base = nnx.state(presets.build_from_config(config, jax.random.key(7)))
    base = jax.tree.map(lambda leaf: leaf + 0.1, base)
    task = ControlTask(config, recipe(control_dropout=0.0), clips, straight(), POOLED, base, codec, (0, 2))
    batch, key = task.draw(None, jax.random.key(8))
    states, positions, told, control = batch
    assert states.shape == (4, 10, JOINTS, 4) and positions.shape == control.positions.shape == (4, FRAMES, JOINTS, 3)
    np.testing.assert_array_equal(control.positions, positions * control.asked[..., None])
    # A state's frames of motion come with it: what the rows of latents are rows of.
    for state, shown, mask in zip(states, positions, told.mask, strict=True):
        frames = 4 * int(mask.sum())
        (row,) = np.flatnonzero((np.asarray(clips.frames[0]) == np.asarray(state[0])).all(axis=(1, 2)))
        pieces = clips.frames[1][row : row + frames // 4].reshape(frames, JOINTS, 3)
        np.testing.assert_array_equal(shown[:frames], pieces)
        assert not np.any(shown[frames:])
    before, after = rehearse(task, batch)
    moved = changed(before, after)
    assert "['added'][0]['kernel']" in moved and "['control_output']['kernel']" in moved
    assert not any("output_modulation" in name for name in moved)  # the base's last layer is not the branch's
    dropped = dataclasses.replace(task, config=recipe(control_dropout=1.0)).draw(None, jax.random.key(8))[0][3]
    assert not np.any(dropped.kept) and control.kept.all()


def test_the_control_loss_is_in_metres_at_the_asked_points():
    """Positions as states, and a base whose answer is off by a known distance along z."""
    config = acmdm.ACMDMConfig(**SIZE, channels=3, window=FRAMES, objective="x0")
    told = acmdm.TextCondition(POOLED[:CLIPS], MASK)
    asked = jnp.zeros((CLIPS, FRAMES, JOINTS)).at[:, 7, 1].set(1.0)
    control = acmdm.Control.of(NORMALISED, asked)

    class Base(Known):
        def __call__(self, state, time, context, residuals=None):
            return NORMALISED.at[..., 2].add(0.5)

    branch = acmdm.branch_with(config, CODEC.frames_per_state, nnx.state(control_branch_of(config)))
    loss = jax.jit(
        lambda key: control_loss(
            Base(config, None), branch, straight(), CODEC, NORMALISED, NORMALISED, told, control, key
        )
    )
    terms = loss(jax.random.key(9))
    # 0.5 in network units are 0.3 m; one of three coordinates is off.
    assert float(terms["control"]) == pytest.approx(0.3**2 / 3, rel=1e-4)
    assert float(terms["denoising"]) == pytest.approx(0.25 / 3, rel=1e-4)


def control_branch_of(config):
    return acmdm.ControlBranch(config, CODEC.frames_per_state, rngs=nnx.Rngs(0))
