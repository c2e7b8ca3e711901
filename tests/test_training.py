"""How a denoiser is trained: the recipes, and the task of undoing noise."""

import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from builders import CHANNELS, HISTORY, WINDOW, refused, same_tree, tiny_camdm, tiny_config, tiny_task, tiny_windows
from safetensors import safe_open
from test_optimise import largest_change

from f3amd_lib.data.windows import gather_windows
from f3amd_lib.diffusion.schedules import variance_exploding, variance_preserving_cosine
from f3amd_lib.networks.conditioning import Condition
from f3amd_lib.training import denoising_task
from f3amd_lib.training.denoising_task import network_inputs
from f3amd_lib.training.losses import LOSS_TERMS
from f3amd_lib.training.optimise import held_out_terms, initial_state, optimise, restore_state, save_state
from f3amd_lib.training.recipe import TrainingConfig, learning_rate_schedule, paper_recipe, short_recipe

STEPS = 32
QUIET = {"progress": False, "chunk": 2}


@pytest.fixture(scope="module")
def task():
    return tiny_task(num_steps=STEPS, learning_rate=1e-2, ema_decay=0.9)


@pytest.fixture(scope="module")
def finished(task):
    """State and history after all steps, never interrupted."""
    return optimise(task, **QUIET)


def finite(tree) -> bool:
    return all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(tree))


def test_section_4_5_inverse_square_schedule():
    rate = learning_rate_schedule(TrainingConfig(10))
    assert rate(0) == pytest.approx(5e-4)
    assert rate(1e5) == pytest.approx(1.25e-4)
    assert rate(9e5) == pytest.approx(5e-6)


def test_other_schedules_by_hand():
    root = learning_rate_schedule(TrainingConfig(10, schedule="inverse_sqrt"))
    assert root(0) == pytest.approx(5e-4)
    assert root(3e5) == pytest.approx(2.5e-4)
    cosine = learning_rate_schedule(TrainingConfig(110, schedule="warmup_cosine", warmup_steps=10, learning_rate=1e-2))
    assert float(cosine(0)) == 0.0
    assert float(cosine(5)) == pytest.approx(5e-3)
    assert float(cosine(10)) == pytest.approx(1e-2)
    assert float(cosine(60)) == pytest.approx((1e-2 + 1e-4) / 2)
    assert float(cosine(110)) == pytest.approx(1e-4)
    warm = learning_rate_schedule(TrainingConfig(10, schedule="warmup_inverse_square", warmup_steps=100))
    printed = learning_rate_schedule(TrainingConfig(10))
    assert float(warm(0)) == 0.0 and float(warm(50)) == pytest.approx(printed(50) / 2)
    assert [float(warm(step)) for step in (100, 1e5)] == pytest.approx([printed(100), printed(1e5)])


def test_section_4_5_defaults_are_the_papers():
    config = TrainingConfig(10)
    assert (config.batch_size, config.learning_rate, config.ema_decay) == (512, 5e-4, 0.993)
    assert config.diffusion == variance_exploding(sigma_max=128.0, sigma_min=0.01, rho=3.0)
    assert paper_recipe("F3AMD-FNO-96", 10) == config


@pytest.mark.parametrize("preset", ["F3AMD-FNO-96-plus", "CAMDM-code"])
def test_config_survives_json(preset):
    config = short_recipe(preset, 1000, seed=3)
    assert TrainingConfig.from_dict(json.loads(json.dumps(config.to_dict()))) == config


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"schedule": "invers_square"}, "'invers_square'.*'inverse_square'"),
        ({"batch_size": -1}, "batch_size must be above 0"),
        ({"learning_rate": float("nan")}, "learning_rate must be a finite number"),
        ({"ema_decay": 1.0}, "ema_decay"),
        ({"own_history_share": 1.5}, "own_history_share"),
        ({"noise": "mixed", "diffusion": variance_preserving_cosine(8)}, "mixed noise needs"),
    ],
)
def test_impossible_configs_are_refused(settings, message):
    refused(message, TrainingConfig, **{"num_steps": 10, **settings})


def test_network_inputs_by_hand(task):
    windows, normaliser = task.windows, task.normaliser
    index = jnp.array([0, 5])
    batch = gather_windows(windows, index, jnp.zeros(2), jnp.zeros(2, jnp.int32))
    x0, condition = network_inputs(batch, normaliser)
    standard = lambda x: (np.asarray(x) - normaliser.mean) / normaliser.deviation
    np.testing.assert_allclose(x0, standard(batch.future), atol=1e-5)
    np.testing.assert_allclose(condition.history, standard(batch.history), atol=1e-5)
    np.testing.assert_allclose(condition.path[..., :2] * normaliser.path_scale, batch.path[..., :2])
    np.testing.assert_array_equal(condition.path[..., 2:], batch.path[..., 2:])
    np.testing.assert_array_equal(condition.style, batch.style)


def schedule_time(sigma):
    """Eq. 9 solved for t, with the paper's 128, 0.01 and rho = 3."""
    return (np.cbrt(128.0) - np.cbrt(sigma)) / (np.cbrt(128.0) - np.cbrt(0.01))


def test_mixed_noise_draws_half_of_the_levels_below_one():
    sigma = np.asarray(denoising_task.draw_sigma(jax.random.key(0), 4000, TrainingConfig(10, noise="mixed")))
    # Half log-uniform on [0.01, 1], and of Eq. 9's half those with t > 0.837.
    expected = 0.5 + 0.5 * (1.0 - schedule_time(1.0))
    assert np.mean(sigma <= 1.0) == pytest.approx(expected, abs=0.03)
    assert 0.0099 < sigma.min() < 0.011 and 100.0 < sigma.max() <= 128.01
    assert np.median(sigma[sigma < 1.0]) == pytest.approx(0.1, rel=0.35)


@pytest.mark.slow
def test_loss_falls(task, finished):
    before = held_out_terms(task, initial_state(task), task.windows)
    after = held_out_terms(task, finished[0], task.windows)
    assert after["loss"] < 0.85 * before["loss"]
    assert after["sample"] < before["sample"]
    assert after["loss"] == pytest.approx(sum(after[name] for name in LOSS_TERMS if name != "floor"), rel=1e-5)
    for row in finished[1]:
        assert row["loss"] == pytest.approx(sum(row[name] for name in LOSS_TERMS if name != "floor"), rel=1e-4)


def test_a_state_keeps_the_names_that_earlier_files_have(task, finished, tmp_path):
    path = tmp_path / "state.safetensors"
    save_state(path, task, finished[0])
    assert same_tree(restore_state(path, task), finished[0])
    with safe_open(path, framework="numpy") as file:
        names = set(file.keys())
    assert {f"{of}['encoder']['local_second']['kernel'].value" for of in (".params", ".ema")} <= names
    assert {name.split("[")[0] for name in names} == {".params", ".ema", ".optimiser", ".step"}


def test_tasks_of_equal_numbers_are_one_program_and_others_are_not(task):
    settings = {"num_steps": STEPS, "learning_rate": 1e-2, "ema_decay": 0.9}
    structure = jax.tree.structure
    assert structure(tiny_task(**settings)) == structure(task)
    assert structure(tiny_task(tiny_config(normalise=False), **settings)) != structure(task)
    shifted = task.normaliser._replace(mean=task.normaliser.mean + 1e-3)
    other = dataclasses.replace(task, constants=dataclasses.replace(task.constants, normaliser=shifted))
    assert structure(other) != structure(task)


def test_a_state_of_camdm_with_its_levels_is_taken_up_again(tmp_path):
    camdm, path = tiny_task(tiny_camdm()), tmp_path / "state.safetensors"
    save_state(path, camdm, initial_state(camdm))
    assert same_tree(restore_state(path, camdm), initial_state(camdm))


def test_raw_networks_are_trained_without_normalisation():
    raw = tiny_task(tiny_config(normalise=False, input_scaling=False)).normaliser
    np.testing.assert_array_equal(raw.mean, np.zeros(CHANNELS))
    np.testing.assert_array_equal(raw.deviation, np.ones(CHANNELS))
    assert float(raw.path_scale) == 1.0


def test_section_6_camdm_trains_on_the_levels_of_its_schedule():
    levels = variance_preserving_cosine(4)
    sigma = denoising_task.draw_sigma(jax.random.key(0), 4000, TrainingConfig(10, diffusion=levels))
    np.testing.assert_allclose(np.unique(sigma), levels.levels, rtol=1e-6)


def test_history_dropout_takes_whole_histories_away(task):
    dropping = tiny_task(history_dropout=0.25)
    history = 1.0 + jnp.zeros((400, HISTORY, CHANNELS))
    condition = Condition(history, jnp.zeros((400, WINDOW, 8)), jnp.zeros((400, 2)))
    disturbed = np.asarray(dropping._disturbed(condition, jax.random.key(1)).history)
    gone = (disturbed == 0.0).all(axis=(1, 2))
    assert 60 < gone.sum() < 140
    assert (disturbed[~gone] == 1.0).all()
    assert task._disturbed(condition, jax.random.key(1)).history is history


@pytest.mark.slow
def test_dropout_is_drawn_in_training_alone():
    model = tiny_config(base_block="transformer", num_heads=2, dropout=0.5)
    task = tiny_task(model)
    state = initial_state(task)
    held_out = [held_out_terms(task, state, tiny_windows()) for _ in range(2)]
    assert held_out[0] == held_out[1]
    quiet = tiny_task(dataclasses.replace(model, dropout=0.0))
    assert held_out_terms(quiet, state, tiny_windows()) == held_out[0]
    # Same weights, batch and noise: only dropout makes a training step differ.
    with_dropout, _ = optimise(task, stop_after=2, **QUIET)
    without, _ = optimise(quiet, stop_after=2, **QUIET)
    assert largest_change(with_dropout.params, without.params) > 1e-6


def test_batches_of_a_long_run_hold_own_histories_wherever_a_window_has_one_before():
    settings = {"num_steps": 151_533, "batch_size": 400}
    tasks = tiny_task(**settings, own_history_share=1.0), tiny_task(**settings)
    start, draws = initial_state(tasks[0]), [jax.jit(task.draw) for task in tasks]

    def own(step):
        state = start._replace(step=jnp.asarray(step, jnp.int32))
        (batch, _), (plain, _) = (draw(state, jax.random.key(3))[0] for draw in draws)
        return (np.abs(np.asarray(batch.history) - plain.history).max(axis=(1, 2)) > 1e-6).sum()

    everywhere = own(151_533)
    assert everywhere > 100
    assert own(400) == 0 and own(1_600) == everywhere
    assert 0.35 < own(1_000) / everywhere < 0.65


@pytest.mark.slow
def test_our_recipe_trains_and_resumes_exactly(tmp_path):
    recipe = short_recipe("F3AMD-FNO-32-plus", 8, batch_size=8).to_dict()
    model = tiny_config(block_residual=True, history_anchor=True, residual_prior=True)
    task = tiny_task(model, **recipe)
    whole, _ = optimise(task, **QUIET)
    checkpoint = tmp_path / "state.safetensors"
    optimise(task, checkpoint=checkpoint, stop_after=4, **QUIET)
    resumed, _ = optimise(task, checkpoint=checkpoint, **QUIET)
    assert finite(whole) and same_tree(whole, resumed)
    assert largest_change(whole.params, initial_state(task).params) > 1e-4


def test_log_normal_noise_has_the_mean_and_deviation_it_names():
    config = TrainingConfig(10, noise="log_normal")
    log_sigma = np.log(denoising_task.draw_sigma(jax.random.key(3), 20_000, config))
    mean, deviation = denoising_task.LOG_NORMAL_SIGMA
    assert log_sigma.mean() == pytest.approx(mean, abs=0.03)
    assert log_sigma.std() == pytest.approx(deviation, abs=0.03)
    narrow = TrainingConfig(10, noise="log_normal", diffusion=variance_exploding(sigma_max=1.0, sigma_min=0.5))
    sigma = np.asarray(denoising_task.draw_sigma(jax.random.key(3), 1000, narrow))
    assert sigma.min() == pytest.approx(0.5) and sigma.max() == pytest.approx(1.0)


def test_weights_towards_low_noise_are_those_of_karras_up_to_the_cap():
    sigma = jnp.array([0.1, 1.0, 128.0])
    assert denoising_task.noise_weights(sigma, TrainingConfig(10)) is None
    weights = np.asarray(denoising_task.noise_weights(sigma, TrainingConfig(10, noise_weighting="low_noise")))
    expected = np.array([6.0, 2.0, 1.0 + 128.0**-2])
    np.testing.assert_allclose(weights, expected / expected.mean(), rtol=1e-6)


def test_a_gradient_is_clipped_before_adam_sees_it():
    """A step of 1000 and then one of 1 are two steps of 1; without clipping the second one counts for little."""

    def second(clip, first):
        optimiser = TrainingConfig(num_steps=4, gradient_clip=clip).optimiser()
        _, state = optimiser.update(jnp.asarray(first), optimiser.init(jnp.asarray(0.0)))
        return float(optimiser.update(jnp.asarray(1.0), state)[0])

    assert second(1.0, 1000.0) == pytest.approx(second(1.0, 1.0))
    assert abs(second(0.0, 1000.0) / second(0.0, 1.0) - 1.0) > 0.1


def test_eq09_training_noise_is_uniform_in_schedule_time():
    config = TrainingConfig(10)
    sigma = np.asarray(denoising_task.draw_sigma(jax.random.key(0), 4000, config))
    time = schedule_time(sigma)
    counts = np.histogram(time, bins=8, range=(0, 1))[0]
    assert counts.sum() == 4000 and np.all(np.abs(counts - 500) < 100)
