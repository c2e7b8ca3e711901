"""Rollouts with networks whose answers are known: seams, paths, histories, errors (section 3.1)."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from builders import CHANNELS, HISTORY, SKELETON, WINDOW, make_condition, placed, refused, tiny_camdm, tiny_trained

from f3amd_lib.data.features import frame_yaw, split_frames, turn_frames
from f3amd_lib.diffusion.schedules import variance_exploding, variance_preserving_cosine
from f3amd_lib.motion.root_paths import RootPath, named_path
from f3amd_lib.motion.rotations import wrap_angle
from f3amd_lib.rollout.rollout import MotionGenerator

POSE = np.tile(np.float32([1, 0, 0, 0, 1, 0]), SKELETON.num_joints)


@pytest.fixture(scope="module")
def trained():
    return tiny_trained()


@pytest.fixture(scope="module")
def network_generator(trained):
    """The real thing, with the initial weights."""
    return MotionGenerator(trained, num_steps=2)


def obedient(trained, window=WINDOW):
    """A generator whose network goes exactly where the path says, and counts frames in the height.

    The height of each frame is that of the last history frame plus 1, 2, .. T metres, so that the
    height says which history a round was given.
    """
    generator = MotionGenerator(trained, num_steps=1)
    normaliser = trained.normaliser

    def sample_window(key, condition):
        displacement = condition.path[..., :2] * normaliser.path_scale
        history = normaliser.denormalise(condition.history)
        count = jnp.arange(1, window + 1)[None, :, None]
        height = history[:, -1:, 1:2] + count
        pose = jnp.broadcast_to(jnp.asarray(POSE[6:]), (*height.shape[:2], len(POSE) - 6))
        frames = [displacement[..., :1], height, displacement[..., 1:], condition.path[..., 2:], pose]
        return normaliser.normalise(jnp.concatenate(frames, axis=-1))

    generator.sample_window = sample_window
    return generator


@pytest.mark.parametrize("place", [((0.0, 0.0), 0.0), ((30.0, -20.0), 2.0)])
@pytest.mark.parametrize("name", ["straight", "circle", "slalom"])
def test_paths_anywhere_facing_anywhere_are_followed(trained, name, place):
    path = placed(named_path(name, 3 * WINDOW), *place)
    frames = obedient(trained).rollout(path, "calm").frames[0]
    assert frames.shape == (3 * WINDOW, CHANNELS)
    np.testing.assert_allclose(frames[:, [0, 2]], path.position, atol=5e-5 if place[1] else 1e-5)
    np.testing.assert_allclose(wrap_angle(frame_yaw(SKELETON, frames.astype(float)) - path.yaw), 0.0, atol=1e-4)


def test_seams_of_a_perfect_network_are_steps_like_any_other(trained):
    path = named_path("straight", 4 * WINDOW)
    rollout = obedient(trained).rollout(path, "calm")
    track = np.concatenate([rollout.history[0, -1:], rollout.frames[0]])[:, [0, 2]]
    steps = np.linalg.norm(np.diff(track, axis=0), axis=-1)
    np.testing.assert_allclose(steps, 1.2 / 30, atol=1e-5)


def test_each_round_starts_from_the_frames_made_before_and_histories_may_be_longer_than_windows():
    window, history = 3, 5
    trained = tiny_trained(window=window, num_history=history, num_kept_modes=2)
    start = np.tile(np.concatenate([[0.0, 0.9, 0.0], POSE]), (1, history, 1))
    rollout = obedient(trained, window=window).rollout(named_path("straight", 4 * window), "calm", history=start)
    np.testing.assert_allclose(rollout.frames[0, :, 1], 0.9 + np.arange(1, 13), rtol=1e-5)


def test_rollouts_start_one_step_before_the_path_and_face_along_it(trained):
    path = placed(named_path("circle", 2 * WINDOW), (3.0, 4.0), -2.0)
    history = obedient(trained).rollout(path, "proud").history[0]
    start = 2 * path.position[0] - path.position[1]
    np.testing.assert_allclose(history[-1, [0, 2]], start, atol=1e-5)
    facing = frame_yaw(SKELETON, history[-1].astype(float))
    np.testing.assert_allclose(wrap_angle(facing - path.yaw[0]), 0.0, atol=1e-5)
    # It is one of the style's stored poses, turned and moved.
    back = turn_frames(history.astype(float), -path.yaw[0])
    back[:, [0, 2]] -= back[-1, [0, 2]]
    assert min(np.abs(back - seed).max() for seed in trained.start_poses["proud"]) < 1e-5


def test_a_history_off_the_path_is_led_back_within_one_window(trained):
    path = named_path("straight", 2 * WINDOW)
    history = np.tile(np.concatenate([[0.0, 0.9, 0.0], POSE]), (1, HISTORY, 1))
    history[..., 0], history[..., 2] = 0.8, -0.04
    rollout = obedient(trained).rollout(path, "calm", history=history)
    off = rollout.frames[0][:, [0, 2]] - path.position
    remains = np.maximum(1.0 - np.arange(1, 2 * WINDOW + 1) / WINDOW, 0.0)
    np.testing.assert_allclose(off[:, 0], 0.8 * remains, atol=1e-5)
    np.testing.assert_allclose(off[:, 1], 0.0, atol=1e-5)
    np.testing.assert_allclose(rollout.history, history, atol=1e-6)


@pytest.mark.parametrize("num_frames", [2, WINDOW + 1])
def test_paths_that_are_no_multiple_of_the_window_are_cut(trained, num_frames):
    path = named_path("slalom", 40).slice(0, num_frames)
    rollout = obedient(trained).rollout(path, "calm")
    assert rollout.frames.shape == (1, num_frames, CHANNELS)
    np.testing.assert_allclose(rollout.frames[0][:, [0, 2]], path.position, atol=1e-5)
    assert rollout.motion().num_frames == num_frames


def test_each_round_has_noise_of_its_own(trained):
    """Of a network that answers with its noise, the rounds' heights."""
    generator = MotionGenerator(trained, num_steps=1)
    generator.sample_window = lambda key, condition: jax.random.normal(key, (1, WINDOW, CHANNELS))
    height = generator.rollout(named_path("straight", 3 * WINDOW), "calm").frames[0, :, 1].reshape(3, WINDOW)
    assert all(np.abs(height[one] - height[other]).max() > 0.01 for one, other in ((0, 1), (0, 2), (1, 2)))


def test_frames_are_true_rotations_and_make_a_motion(network_generator):
    rollout = network_generator.rollout(named_path("circle", 20), "calm")
    first, second = np.split(split_frames(rollout.frames)[1], 2, axis=-1)
    np.testing.assert_allclose(np.linalg.norm(first, axis=-1), 1.0, atol=1e-5)
    np.testing.assert_allclose(np.linalg.norm(second, axis=-1), 1.0, atol=1e-5)
    np.testing.assert_allclose((first * second).sum(-1), 0.0, atol=1e-5)
    motion, longer = rollout.motion(), rollout.motion(with_history=True)
    assert (motion.num_frames, longer.num_frames) == (20, 20 + HISTORY)
    assert motion.fps == 30.0 and motion.name == "calm"
    np.testing.assert_array_equal(longer.root_position[HISTORY:], motion.root_position)
    np.testing.assert_allclose(longer.root_position[:HISTORY], rollout.history[0, :, :3])


def test_noise_levels_are_those_of_training_unless_told(trained):
    levels = variance_exploding(80.0, 0.1, 7.0)
    generator = MotionGenerator(tiny_trained(diffusion=levels), num_steps=3)
    np.testing.assert_array_equal(generator.sigmas, levels.grid(3))
    np.testing.assert_array_equal(MotionGenerator(trained, 4).sigmas, variance_exploding().grid(4))
    chosen = MotionGenerator(trained, 4, spacing="uniform")
    np.testing.assert_array_equal(chosen.sigmas, variance_exploding().grid(4, "uniform"))
    refused("num_steps=0", MotionGenerator, trained, 0)


class Repeats:
    """A network that answers with the state that it is asked about, or with the level that it is told."""

    def __init__(self, network, what):
        self.config, self.encode, self.what = network.config, network.encode, what

    def __call__(self, x_noisy, sigma, context):
        level = jnp.broadcast_to(sigma, x_noisy.shape[:1])[:, None, None]
        return x_noisy if self.what == "state" else level + 0.0 * x_noisy


def test_leading_steps_start_from_noise_alone_whatever_level_they_are_told():
    levels = variance_preserving_cosine(4)
    generator = MotionGenerator(tiny_trained(config=tiny_camdm(), diffusion=levels), 1, spacing="leading")
    network, condition = generator._network, make_condition(4)
    generator._network = Repeats(network, "level")
    told = generator.sample_window(jax.random.key(0), condition)
    np.testing.assert_allclose(told, levels.levels[0], rtol=1e-6)
    generator._network = Repeats(network, "state")
    state = np.asarray(generator.sample_window(jax.random.key(0), condition), float)
    # Unit noise in the preserving state; the level alone would leave almost none.
    assert abs((state / np.hypot(1.0, levels.levels[0])).std() - 1.0) < 0.1


def test_the_sampler_belongs_to_the_noise_that_the_model_was_trained_with(model_that):
    levels = variance_preserving_cosine(4)
    camdm = model_that(lambda x_noisy, sigma: jnp.tanh(x_noisy), config=tiny_camdm(), diffusion=levels)
    assert MotionGenerator(camdm, 2).sampler == "ddpm"
    assert MotionGenerator(tiny_trained(), 2).sampler == "ddim"
    np.testing.assert_array_equal(MotionGenerator(camdm, 4).sigmas[:-1], levels.levels[::-1])
    path = named_path("straight", 2 * WINDOW)
    generators = {name: MotionGenerator(camdm, 4, sampler=name) for name in ("ddpm", "ddim", "euler", "heun")}
    made = {name: generator.rollout(path, "calm", seed=1).frames for name, generator in generators.items()}
    again = MotionGenerator(camdm, 4).rollout(path, "calm", seed=1).frames
    np.testing.assert_array_equal(made["ddpm"], again)
    np.testing.assert_allclose(made["ddim"], made["euler"], atol=1e-4)
    for name in ("ddpm", "heun"):
        assert np.isfinite(made[name]).all()
        assert np.abs(made[name] - made["ddim"]).max() > 1e-3, name
    # With one step nothing is drawn anew, and all samplers answer alike.
    one = [MotionGenerator(camdm, 1, sampler=name) for name in ("ddpm", "heun")]
    first, second = (generator.rollout(path, "calm", seed=1).frames for generator in one)
    np.testing.assert_allclose(first, second, atol=1e-4)
    refused("unknown sampler 'ddmp'; did you mean 'dd", MotionGenerator, camdm, 4, sampler="ddmp")
    refused("4", MotionGenerator, camdm, 5)


TEN = named_path("straight", 10)


@pytest.mark.parametrize(
    ("paths", "styles", "history", "message"),
    [
        (TEN, "prowd", None, "'prowd'.*calm, proud"),
        ([TEN, TEN], ["calm"] * 3, None, "2 paths and 3 styles"),
        ([TEN, named_path("straight", 12)], "calm", None, r"same length, got \[10, 12\]"),
        (TEN.slice(0, 1), "calm", None, "at least 2 frames"),
        ([], "calm", None, ""),
        (RootPath(TEN.position, TEN.yaw, fps=60.0), "calm", None, "30"),
        (TEN, "calm", np.zeros((1, 3, CHANNELS)), rf"\[1, {HISTORY}, {CHANNELS}\] .*got \(1, 3, "),
        (TEN, "calm", np.full((1, HISTORY, CHANNELS), np.nan), "finite"),
    ],
)
def test_what_cannot_be_walked_is_refused(network_generator, paths, styles, history, message):
    refused(message, network_generator.rollout, paths, styles, history=history)


def test_styles_without_a_starting_pose_need_a_history():
    generator = obedient(tiny_trained())
    generator.trained.start_poses.pop("proud")
    path = named_path("straight", 10)
    refused("'proud': pass `history`", generator.rollout, path, "proud")
    history = np.tile(np.concatenate([[0.0, 0.9, 0.0], POSE]), (1, HISTORY, 1))
    assert generator.rollout(path, "proud", history=history).frames.shape == (1, 10, CHANNELS)


def test_the_path_of_one_character_is_nothing_to_another(network_generator):
    straight, circle = named_path("straight", 20), named_path("circle", 20)
    first = network_generator.rollout([straight, straight], ["calm", "proud"]).frames
    second = network_generator.rollout([straight, circle], ["calm", "proud"]).frames
    np.testing.assert_allclose(first[0], second[0], atol=1e-5)
    assert np.abs(first[1] - second[1]).max() > 1e-3
