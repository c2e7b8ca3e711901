"""What joins the formulas: the right frame, style, weights, split, noise and units arrive where they are used.

Networks, losses and whole trainings are replaced by stand-ins that write down what they were given.
"""

from __future__ import annotations

import dataclasses
import types
from typing import ClassVar

import builders
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from builders import wandering_motion as wandering

from f3amd_companion.measuring import campaign
from f3amd_lib.data import windows as windows_module
from f3amd_lib.data.features import Normaliser, world_frames
from f3amd_lib.data.windows import gather_windows
from f3amd_lib.ground.profiles import load_profile
from f3amd_lib.motion.root_paths import named_path
from f3amd_lib.rollout.rollout import MotionGenerator, starting_poses
from f3amd_lib.training import denoising_task as task_module
from f3amd_lib.training import pipeline
from f3amd_lib.training.optimise import TrainingState, advance, held_out_terms, initial_state
from f3amd_lib.training.pipeline import PreparedData

SIGMA = jnp.array([0.01, 100.0, 0.05, 30.0])


@dataclasses.dataclass
class Seen:
    """What a stand-in network and a stand-in loss were given."""

    condition: object = None
    x_noisy: object = None
    sigma: object = None
    loss: tuple = ()


@pytest.fixture
def task():
    return builders.tiny_task()


@pytest.fixture
def batch(task):
    index = jnp.array([0, 40, 20, 50])
    return gather_windows(task.windows, index, jnp.array([0.3, -1.0, 2.0, 0.0]), jnp.array([0, 1, 2, 0]))


@pytest.fixture
def seen(monkeypatch):
    """A network that answers with half of what it sees, and a loss that only looks."""
    seen = Seen()

    class Network:
        def encode(self, condition):
            seen.condition = condition
            return condition

        def __call__(self, x_noisy, sigma, context, key=None):
            seen.x_noisy, seen.sigma = x_noisy, sigma
            return 0.5 * x_noisy

    def loss_terms(*given):
        seen.loss = given
        return dict.fromkeys(task_module.total_loss.__globals__["LOSS_TERMS"], jnp.zeros(()))

    monkeypatch.setattr(task_module, "network_with", lambda config, params: Network())
    monkeypatch.setattr(task_module, "loss_terms", loss_terms)
    return seen


def test_the_loss_is_given_network_units_metres_and_the_last_history_frame(task, batch, seen):
    task.loss({}, None, (batch, SIGMA), jax.random.key(0))
    skeleton, x0_hat, x0, future_hat, future, last, ird_form, weights = seen.loss
    normaliser = task.normaliser
    assert skeleton is task.skeleton and ird_form == task.config.loss.ird_form and weights is None
    np.testing.assert_allclose(x0_hat, 0.5 * seen.x_noisy)
    np.testing.assert_allclose(x0, normaliser.normalise(batch.future), atol=1e-6)
    np.testing.assert_allclose(future_hat, normaliser.denormalise(x0_hat), atol=1e-5)
    np.testing.assert_array_equal(future, batch.future)
    np.testing.assert_array_equal(last, batch.history[:, builders.HISTORY - 1])
    # The frames told apart here do differ, or the lines above would show nothing.
    assert np.abs(batch.history[:, -1] - batch.history[:, 0]).max() > 0.05
    assert np.abs(normaliser.denormalise(x0_hat) - x0_hat).max() > 0.05


def test_each_sample_has_the_noise_of_its_own_level_and_the_network_is_told_it(task, batch, seen):
    task.loss({}, None, (batch, SIGMA), jax.random.key(1))
    np.testing.assert_array_equal(seen.sigma, SIGMA)
    noise = (seen.x_noisy - task.normaliser.normalise(batch.future)) / SIGMA[:, None, None]
    spread = np.std(noise, axis=(1, 2))
    # The network would see nearly clean motion where it is told of drowning noise, or the other way round.
    assert (np.abs(spread - 1.0) < 0.15).all(), spread
    assert np.abs(np.mean(noise)) < 0.15


def test_the_network_sees_its_condition_in_network_units(task, batch, seen):
    task.loss({}, None, (batch, SIGMA), jax.random.key(2))
    np.testing.assert_allclose(seen.condition.history, task.normaliser.normalise(batch.history), atol=1e-6)
    np.testing.assert_allclose(seen.condition.path, task.normaliser.normalise_path(batch.path), atol=1e-6)
    np.testing.assert_array_equal(seen.condition.style, batch.style)
    assert np.ptp(np.argmax(batch.style, axis=1)) == 1


def test_a_step_draws_windows_levels_and_noise_of_its_own(task, batch, seen):
    state = TrainingState({}, None, None, jnp.zeros((), jnp.int32))
    drawn = [task.draw(state, jax.random.key(step)) for step in range(3)]
    for first, second in ((0, 1), (1, 2)):
        (one, sigma), key = drawn[first]
        (other, other_sigma), other_key = drawn[second]
        assert np.abs(one.future - other.future).max() > 0.01
        assert (np.asarray(sigma) != np.asarray(other_sigma)).all()
        assert (jax.random.key_data(key) != jax.random.key_data(other_key)).any()
        assert len(np.unique(np.asarray(sigma))) == len(sigma)
    noisy = []
    for key in (0, 1):
        task.loss({}, None, (batch, SIGMA), jax.random.key(key))
        noisy.append(seen.x_noisy)
    assert np.abs(noisy[0] - noisy[1]).max() > 1.0


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class Diary:
    """A task that learns nothing and writes down the random numbers it is given."""

    name: ClassVar[str] = "diary"
    config: types.SimpleNamespace = dataclasses.field(
        default_factory=lambda: types.SimpleNamespace(num_steps=4, ema_decay=0.9, seed=3), compare=False
    )
    optimiser = optax.sgd(0.1)

    def init(self, key):
        return {"weight": jnp.ones(2)}, None

    def draw(self, state, key):
        key_batch, key_loss = jax.random.split(key)
        return jax.random.uniform(key_batch, (2,)), key_loss

    def loss(self, params, statistics, batch, key):
        loss = jnp.sum(params["weight"] ** 2)
        return loss, ({"loss": loss, "drawn": batch[0], "noise": jax.random.normal(key)}, statistics)

    def held_out_terms(self, params, statistics, held_out, key):
        return {"loss": jnp.sum(params["weight"])}


def test_every_step_of_the_loop_has_random_numbers_of_its_own():
    task = Diary()
    state, terms = advance(task, initial_state(task), 4)
    assert len(set(np.asarray(terms["drawn"]).tolist())) == 4
    assert len(set(np.asarray(terms["noise"]).tolist())) == 4
    assert int(state.step) == 4
    # Weights shrink to 0.8 of themselves in every step, and the moving average follows: by hand.
    weight = average = 1.0
    for _ in range(4):
        weight *= 0.8
        average = 0.9 * average + 0.1 * weight
    weights, averaged = float(state.params["weight"].sum()), float(state.ema["weight"].sum())
    assert (weights, averaged) == pytest.approx((2 * weight, 2 * average)) and averaged > weights + 0.1
    # Held-out losses are of the moving average.
    assert held_out_terms(task, state, jnp.zeros(()))["loss"] == pytest.approx(averaged)


def _two_kinds(state_of):
    """Weights of ones, their moving average of twos."""
    params = jax.tree.map(jnp.ones_like, state_of.params)
    return TrainingState(params, jax.tree.map(lambda leaf: 2.0 * leaf, params), None, jnp.asarray(4))


@pytest.fixture
def prepared():
    return PreparedData(builders.tiny_packed(), builders.WINDOW, builders.HISTORY)


@pytest.fixture
def untrained(monkeypatch, prepared):
    """A loop that trains nothing and returns weights of ones with a moving average of twos."""
    task = builders.tiny_task(num_steps=4)
    monkeypatch.setattr(PreparedData, "task", lambda self, *args, **settings: task)
    done = _two_kinds(types.SimpleNamespace(params={"a": jnp.ones(3)}))
    monkeypatch.setattr(pipeline, "optimise", lambda *args, **settings: (done, []))
    return task


def test_the_moving_average_is_what_training_returns_and_ships(untrained, prepared, monkeypatch, tmp_path):
    written = {}
    monkeypatch.setattr(pipeline, "save_model", lambda path, trained: written.update(trained.params))
    monkeypatch.setattr(pipeline, "load_model", lambda path: types.SimpleNamespace(params=dict(written)))
    config = dataclasses.replace(untrained.config, num_steps=4)
    pipeline.train(prepared, load_profile("smoke", "synthetic"), config=config, folder=tmp_path, progress=False)
    np.testing.assert_array_equal(written["a"], 2.0 * np.ones(3))


def test_the_moving_average_is_what_a_snapshot_returns(untrained, prepared, monkeypatch, tmp_path):
    monkeypatch.setattr(campaign, "held_out_terms", lambda task, state, windows: {"loss": 0.0})
    written = {}
    monkeypatch.setattr(campaign, "save_model", lambda path, trained, dtype: written.update(trained.params))
    run, windows = campaign.Run("F3AMD-FNO-96", window=builders.WINDOW), 4 * untrained.config.batch_size
    how = {"precision": "float32", "stop_at": None, "progress": False}
    _, trained, *_ = campaign._trained(prepared, run, windows, batch_size=2, record={}, folder=tmp_path, **how)
    for params in (trained.params, written):
        np.testing.assert_array_equal(params["a"], 2.0 * np.ones(3))


def test_the_normaliser_and_the_training_know_training_windows_alone(prepared, monkeypatch):
    fitted = []
    monkeypatch.setattr(pipeline, "fit_normaliser", lambda windows, key: fitted.append(windows) or "normaliser")
    assert prepared.normaliser == "normaliser"
    assert fitted == [prepared.windows("train")]
    given = {}
    monkeypatch.setattr(pipeline, "denoising_task", lambda *args, **settings: given.update(args=args, **settings))
    monkeypatch.setattr(PreparedData, "model_config", lambda *args, **settings: "config")
    prepared.task("F3AMD-FNO-96", "recipe")
    assert given["args"][3:] == ("normaliser", prepared.windows("train"))
    assert given["dataset_fingerprint"] == prepared.packed.fingerprint


def test_windows_of_a_split_come_from_its_clips_alone():
    """Clips of a split lie in a place of their own; no window of another split reaches it."""
    far = {0: 0.0, 1: 500.0, 2: -500.0}
    clips = []
    for number, split in enumerate((0, 0, 1, 2)):
        motion = wandering(24, number)
        clips.append((motion.replace(root_position=motion.root_position + [far[split], 0.0, 0.0]), number % 2, split))
    prepared = PreparedData(builders.packed_from(clips), builders.WINDOW, builders.HISTORY)
    for number, split in enumerate(("train", "validation", "test")):
        x = np.asarray(prepared.windows(split).frames[:, 0])
        assert (np.abs(x - far[number]) < 50.0).all()
    assert prepared.held_out_split == "validation"


def test_held_out_windows_are_not_mirrored_and_training_windows_are():
    train, held_out = builders.tiny_windows("train"), builders.tiny_windows("validation")
    packed = builders.tiny_packed()
    lengths = np.diff(packed.clip_start)
    assert len(train.frames) == lengths[0] * 2 + lengths[1] + lengths[3]  # "calm" may be mirrored
    assert len(held_out.frames) == lengths[2]


class Told:
    """A network that writes its condition into the height: the style, where the path ends, the last pose's height."""

    config = types.SimpleNamespace(window=builders.WINDOW, channels=builders.CHANNELS)

    def encode(self, condition):
        return condition

    def __call__(self, x_noisy, sigma, condition):
        height = jnp.argmax(condition.style, axis=-1) + 1.0
        frames = jnp.zeros_like(x_noisy).at[..., 1].set(height[:, None])
        frames = frames.at[..., 0].set(condition.path[..., 0]).at[..., 2].set(condition.path[..., 1])
        pose = jnp.tile(jnp.array([1.0, 0, 0, 0, 1, 0]), builders.SKELETON.num_joints)
        return frames.at[..., 3:].set(pose)


def first(style, members, counts):
    """Of the starting poses that fit, the first for everybody."""
    return np.zeros(len(members), int)


@pytest.mark.parametrize("together", [True, False])
def test_everybody_in_a_rollout_has_their_own_style_and_path(monkeypatch, together):
    trained = dataclasses.replace(builders.tiny_trained(), normaliser=Normaliser.identity(builders.CHANNELS))
    monkeypatch.setattr(type(trained), "network", lambda self: Told())
    generator = MotionGenerator(trained, num_steps=1)
    styles = ["calm", "proud", "proud", "calm"]
    paths = [named_path(name, 2 * builders.WINDOW) for name in ("straight", "circle", "spiral", "slalom")]
    if together:
        frames = generator.rollout(paths, styles, seed=0).frames
    else:  # a key each, as in a crowd
        trained_index = [trained.style_index(style) for style in styles]
        position, yaw = (np.stack([getattr(path, name) for path in paths]) for name in ("position", "yaw"))
        history = starting_poses(trained, trained_index, np.zeros((4, 2)), yaw[:, 0], np.ones(4), first)
        keys = jax.random.split(jax.random.key(0), 4)
        frames = generator.generate(position, yaw, np.array(trained_index), history, keys)
    np.testing.assert_allclose(frames[..., 1], np.array([1, 2, 2, 1])[:, None] * np.ones(2 * builders.WINDOW))
    for frame, path in zip(frames, paths, strict=True):
        np.testing.assert_allclose(frame[-1, [0, 2]], path.position[-1], atol=1e-4)


def test_each_style_starts_from_a_pose_of_its_own():
    trained = builders.tiny_trained()
    poses = starting_poses(trained, [1, 0], np.zeros((2, 2)), np.zeros(2), np.full(2, 0.04), first)
    for pose, style in zip(poses, ("proud", "calm"), strict=True):
        heights = [start[:, 1] for start in trained.start_poses[style]]
        assert min(np.abs(pose[:, 1] - height).max() for height in heights) < 1e-5
        other = trained.start_poses["calm" if style == "proud" else "proud"]
        assert min(np.abs(pose[:, 1] - start[:, 1]).max() for start in other) > 1e-3


def test_a_facing_that_flips_and_comes_back_is_smoothed_the_short_way():
    """0, 170, 190 and 0 degrees: unwrapped angles end at 360, and their mean would turn through the back."""
    motion = wandering(60, 0)
    degrees = np.concatenate([np.zeros(30), np.full(3, 170.0), np.full(3, 190.0), np.zeros(24)])
    matrix = np.zeros((60, 3, 3))
    cosine, sine = np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees))
    matrix[:, 0, 0], matrix[:, 0, 2], matrix[:, 1, 1] = cosine, sine, 1.0
    matrix[:, 2, 0], matrix[:, 2, 2] = -sine, cosine
    rotations = np.broadcast_to(np.eye(3), (60, builders.SKELETON.num_joints, 3, 3)).copy()
    rotations[:, 0] = matrix
    world = world_frames(motion.replace(rotations=rotations))
    raw, *smoothed = windows_module._path_variants(builders.SKELETON, world)
    np.testing.assert_allclose(raw[:, 2:], np.stack([sine, cosine], axis=1), atol=1e-9)
    for variant in smoothed:
        np.testing.assert_allclose(np.hypot(variant[:, 2], variant[:, 3]), 1.0, atol=1e-9)
        # Six frames of a flip are outvoted by those around them.
        assert np.abs(np.rad2deg(np.arctan2(variant[:, 2], variant[:, 3]))).max() < 90.0
