"""The training loop: what it learns, that it resumes exactly, and that it stops when it must."""

import copy
import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from builders import CHANNELS, HISTORY, WINDOW, same_tree, tiny_config, tiny_trainer, tiny_windows

from f3amd_lib.data.windows import gather_windows
from f3amd_lib.diffusion.schedules import VarianceExploding, VariancePreservingCosine
from f3amd_lib.networks.conditioning import Condition
from f3amd_lib.training import loop
from f3amd_lib.training.loop import (
    TrainingConfig,
    TrainingDiverged,
    learning_rate_schedule,
    network_inputs,
    paper_recipe,
    short_recipe,
)
from f3amd_lib.training.losses import LOSS_TERMS, LossWeights

STEPS = 32
QUIET = {"progress": False, "chunk": 2}


@pytest.fixture(scope="module")
def trainer():
    return tiny_trainer(num_steps=STEPS, learning_rate=1e-2, ema_decay=0.9)


@pytest.fixture(scope="module")
def finished(trainer):
    """State and history after all steps, never interrupted."""
    return trainer.run(**QUIET)


def finite(tree) -> bool:
    return all(bool(jnp.all(jnp.isfinite(leaf))) for leaf in jax.tree.leaves(tree))


def largest_change(first, second) -> float:
    pairs = zip(jax.tree.leaves(first), jax.tree.leaves(second), strict=True)
    return max(float(jnp.abs(a - b).max()) for a, b in pairs)


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


def test_section_4_5_defaults_are_the_papers():
    config = TrainingConfig(10)
    assert (config.batch_size, config.learning_rate, config.ema_decay) == (512, 5e-4, 0.993)
    assert config.diffusion == VarianceExploding(sigma_max=128.0, sigma_min=0.01, rho=3.0)
    assert config.history_noise == config.own_history_share == config.gradient_clip == 0.0
    assert paper_recipe("F3AMD-FNO-96", 10) == config
    assert config.loss == LossWeights()


def test_recipes_keep_the_papers_loss_except_for_plus():
    paper, plus = (short_recipe(f"F3AMD-FNO-96{end}", 1000) for end in ("", "-plus"))
    assert paper.loss == LossWeights() and paper.noise == "schedule"
    assert paper.history_noise == paper.own_history_share == 0.0
    assert plus.loss.ird_form == "excess" and plus.own_history_share > 0
    assert short_recipe("F3AMD-FNO-96", 1000, batch_size=7).batch_size == 7


@pytest.mark.parametrize("preset", ["F3AMD-FNO-96", "F3AMD-FNO-96-plus", "CAMDM-code"])
def test_config_survives_json(preset):
    config = short_recipe(preset, 1000, seed=3)
    assert TrainingConfig.from_dict(json.loads(json.dumps(config.to_dict()))) == config


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"schedule": "invers_square"}, "'invers_square'.*'inverse_square'"),
        ({"noise": "mixd"}, "'mixd'"),
        ({"num_steps": 0}, "num_steps must be positive"),
        ({"batch_size": -1}, "batch_size must be positive"),
        ({"learning_rate": float("nan")}, "learning_rate must be positive"),
        ({"ema_decay": 1.0}, "ema_decay"),
        ({"own_history_share": 1.5}, "own_history_share"),
        ({"captured_path_share": -0.1}, "captured_path_share"),
        ({"history_dropout": 2.0}, "history_dropout"),
        ({"noise": "mixed", "diffusion": VariancePreservingCosine(8)}, "mixed noise needs"),
    ],
)
def test_impossible_configs_are_refused(settings, message):
    with pytest.raises(ValueError, match=message):
        TrainingConfig(**{"num_steps": 10, **settings})


def test_config_names_unknown_keys():
    with pytest.raises(ValueError, match="'learning_rat'; did you mean 'learning_rate'"):
        TrainingConfig.from_dict({"num_steps": 10, "learning_rat": 1e-3})


def test_network_inputs_by_hand(trainer):
    windows, normaliser = trainer.windows, trainer.normaliser
    index = jnp.array([0, 5])
    batch = gather_windows(windows, index, jnp.zeros(2), jnp.zeros(2, jnp.int32), window=WINDOW, num_history=HISTORY)
    x0, condition = network_inputs(batch, normaliser)
    standard = lambda x: (np.asarray(x) - normaliser.mean) / normaliser.deviation
    np.testing.assert_allclose(x0, standard(batch.future), atol=1e-5)
    np.testing.assert_allclose(condition.history, standard(batch.history), atol=1e-5)
    np.testing.assert_allclose(condition.path[..., :2] * normaliser.path_scale, batch.path[..., :2])
    np.testing.assert_array_equal(condition.path[..., 2:], batch.path[..., 2:])
    np.testing.assert_array_equal(condition.style, batch.style)


def test_eq09_training_noise_is_uniform_in_schedule_time():
    config = TrainingConfig(10)
    sigma = np.asarray(loop.draw_sigma(jax.random.key(0), 4000, config))
    time = config.diffusion.time(sigma)
    counts = np.histogram(time, bins=8, range=(0, 1))[0]
    assert counts.sum() == 4000 and np.all(np.abs(counts - 500) < 100)


def test_mixed_noise_draws_half_of_the_levels_below_one():
    sigma = np.asarray(loop.draw_sigma(jax.random.key(0), 4000, TrainingConfig(10, noise="mixed")))
    # Half log-uniform on [0.01, 1], and of Eq. 9's half those with t > 0.837.
    expected = 0.5 + 0.5 * (1.0 - TrainingConfig(10).diffusion.time(1.0))
    assert np.mean(sigma <= 1.0) == pytest.approx(expected, abs=0.03)
    assert 0.0099 < sigma.min() < 0.011 and 100.0 < sigma.max() <= 128.01
    assert np.median(sigma[sigma < 1.0]) == pytest.approx(0.1, rel=0.35)


def test_history_has_a_row_per_chunk(finished):
    state, history = finished
    assert [row["step"] for row in history] == list(range(2, STEPS + 1, 2))
    assert int(state.step) == STEPS
    for row in history:
        assert row["loss"] == pytest.approx(sum(row[name] for name in LOSS_TERMS), rel=1e-4)


def test_loss_falls(trainer, finished):
    before = trainer.held_out_terms(trainer.initial_state().params, trainer.windows)
    after = trainer.held_out_terms(finished[0].params, trainer.windows)
    assert after["loss"] < 0.85 * before["loss"]
    assert after["sample"] < before["sample"]


def test_first_step_is_adams_and_average_follows_by_formula(trainer):
    start = trainer.initial_state()
    one, _ = trainer.run(stop_after=1, chunk=1, progress=False)
    two, _ = trainer.run(one, stop_after=2, chunk=1, progress=False)
    # Adam's first step moves every weight by the learning rate, whatever its gradient's size.
    assert largest_change(one.params, start.params) == pytest.approx(1e-2, rel=1e-3)
    leaves = [jax.tree.leaves(t) for t in (start.params, one.params, two.params, one.ema, two.ema)]
    for first, second, third, ema_one, ema_two in zip(*leaves, strict=True):
        expected = 0.9 * first + 0.1 * second
        np.testing.assert_allclose(ema_one, expected, atol=1e-7)
        np.testing.assert_allclose(ema_two, 0.9 * expected + 0.1 * third, atol=1e-7)
    assert same_tree(start.ema, start.params)


def test_a_given_state_stays_alive(trainer):
    state = trainer.initial_state()
    trainer.run(state, stop_after=4, **QUIET)
    assert same_tree(state, trainer.initial_state())


class Killed(Exception):
    pass


@pytest.mark.parametrize("killed_after", [4, 8])
def test_killed_and_resumed_equals_uninterrupted(trainer, finished, tmp_path, killed_after):
    checkpoint = tmp_path / "state.safetensors"

    def kill(row):
        # After the chunk, and after the checkpoint of the one before.
        if row["step"] == killed_after:
            raise Killed

    with pytest.raises(Killed):
        trainer.run(checkpoint=checkpoint, checkpoint_every=4, on_chunk=kill, **QUIET)
    assert int(trainer.restore(checkpoint).step) == killed_after
    resumed, history = trainer.run(checkpoint=checkpoint, checkpoint_every=4, **QUIET)
    assert [row["step"] for row in history] == list(range(killed_after + 2, STEPS + 1, 2))
    assert same_tree(resumed, finished[0])
    assert history[-1] == finished[1][-1]


def test_stopped_between_chunks_and_resumed_equals_uninterrupted(trainer, finished, tmp_path):
    checkpoint = tmp_path / "state.safetensors"
    state, _ = trainer.run(checkpoint=checkpoint, stop_after=3, **QUIET)
    assert int(state.step) == 3
    resumed, _ = trainer.run(checkpoint=checkpoint, **QUIET)
    assert same_tree(resumed, finished[0])


def test_a_finished_run_does_nothing_more(trainer, tmp_path):
    checkpoint = tmp_path / "state.safetensors"
    trainer.save(checkpoint, trainer.initial_state()._replace(step=jnp.asarray(STEPS, jnp.int32)))
    content = checkpoint.read_bytes()
    state, history = trainer.run(checkpoint=checkpoint, **QUIET)
    assert history == [] and int(state.step) == STEPS and checkpoint.read_bytes() == content


def test_saved_state_comes_back_exactly(trainer, finished, tmp_path):
    trainer.save(tmp_path / "state.safetensors", finished[0])
    assert same_tree(trainer.restore(tmp_path / "state.safetensors"), finished[0])


@pytest.mark.parametrize(
    ("settings", "name"),
    [({"learning_rate": 1e-3}, "learning_rate"), ({"seed": 1}, "seed"), ({"loss": LossWeights(ird=0.5)}, "loss")],
)
def test_checkpoints_of_other_settings_are_refused(trainer, tmp_path, settings, name):
    path = tmp_path / "state.safetensors"
    trainer.save(path, trainer.initial_state())
    other = tiny_trainer(**{"num_steps": STEPS, "learning_rate": 1e-2, "ema_decay": 0.9, **settings})
    with pytest.raises(ValueError, match=rf"state\.safetensors.*other training settings.*{name}"):
        other.restore(path)


@pytest.mark.parametrize("changes", [{"sigma_data": 0.5}, {"latent_width": 16}, {"depth": 2}])
def test_checkpoints_of_another_network_are_refused(trainer, tmp_path, changes):
    path = tmp_path / "state.safetensors"
    trainer.save(path, trainer.initial_state())
    other = tiny_trainer(tiny_config(**changes), num_steps=STEPS, learning_rate=1e-2, ema_decay=0.9)
    with pytest.raises(ValueError, match=r"state\.safetensors"):
        other.restore(path)


def test_broken_data_stop_training_and_keep_the_checkpoint(trainer, tmp_path):
    checkpoint = tmp_path / "state.safetensors"
    trainer.run(checkpoint=checkpoint, stop_after=4, **QUIET)
    content = checkpoint.read_bytes()
    broken = copy.copy(trainer)
    windows = trainer.windows
    broken.windows = dataclasses.replace(windows, frames=jnp.full_like(windows.frames, jnp.nan))
    with pytest.raises(TrainingDiverged, match=r"at step 5 \(terms: .*sample.*state\.safetensors"):
        broken.run(checkpoint=checkpoint, checkpoint_every=4, **QUIET)
    assert checkpoint.read_bytes() == content
    assert finite(trainer.restore(checkpoint))


@pytest.fixture(scope="module")
def exploding():
    """A trainer whose fourth update is infinite; the loss shows it only at the fifth step."""
    schedule = loop.learning_rate_schedule
    loop.learning_rate_schedule = lambda config: lambda step: jnp.where(step < 3, 1e-3, jnp.inf)
    try:
        return tiny_trainer()
    finally:
        loop.learning_rate_schedule = schedule


def test_divergence_names_the_step(exploding):
    with pytest.raises(TrainingDiverged, match="not finite (at step 5|after step 4)"):
        exploding.run(**QUIET)


def test_broken_weights_never_reach_the_checkpoint(exploding, tmp_path):
    checkpoint = tmp_path / "state.safetensors"
    with pytest.raises(TrainingDiverged):
        exploding.run(checkpoint=checkpoint, checkpoint_every=4, **QUIET)
    assert not checkpoint.exists() or finite(exploding.restore(checkpoint))


def test_stopping_after_no_steps_makes_none(trainer):
    state, history = trainer.run(stop_after=0, **QUIET)
    assert int(state.step) == 0 and history == []


def test_checkpoints_are_written_though_chunks_end_elsewhere(trainer, tmp_path):
    checkpoint, steps = tmp_path / "state.safetensors", []

    def look(row):
        steps.append(int(trainer.restore(checkpoint).step) if checkpoint.exists() else 0)

    trainer.run(checkpoint=checkpoint, checkpoint_every=3, stop_after=6, on_chunk=look, **QUIET)
    # Three steps are done for the first time when the second chunk ends.
    assert steps == [0, 4, 6]


def test_held_out_loss_is_measured_on_the_same_noise_every_time(trainer, finished):
    held_out = tiny_windows("validation")
    first = trainer.held_out_terms(finished[0].ema, held_out)
    assert first == trainer.held_out_terms(finished[0].ema, held_out)
    assert first["loss"] == pytest.approx(sum(first[name] for name in LOSS_TERMS), rel=1e-5)
    _, history = trainer.run(held_out=held_out, checkpoint_every=STEPS // 2, **QUIET)
    measured = [row["step"] for row in history if "held_out_loss" in row]
    assert measured == [STEPS // 2, STEPS]
    assert history[-1]["held_out_sample"] == pytest.approx(first["sample"], rel=1e-6)


def test_raw_networks_are_trained_without_normalisation():
    raw = tiny_trainer(tiny_config(normalise=False, input_scaling=False)).normaliser
    np.testing.assert_array_equal(raw.mean, np.zeros(CHANNELS))
    np.testing.assert_array_equal(raw.deviation, np.ones(CHANNELS))
    assert float(raw.path_scale) == 1.0


def test_section_6_camdm_trains_on_the_levels_of_its_schedule():
    levels = VariancePreservingCosine(4)
    config = TrainingConfig(10, diffusion=levels)
    sigma = np.asarray(loop.draw_sigma(jax.random.key(0), 4000, config))
    found, counts = np.unique(sigma, return_counts=True)
    np.testing.assert_allclose(found, levels.sigmas, rtol=1e-6)
    assert np.all(np.abs(counts - 1000) < 120)


def test_history_dropout_takes_whole_histories_away(trainer):
    dropping = tiny_trainer(history_dropout=0.25)
    history = 1.0 + jnp.zeros((400, HISTORY, CHANNELS))
    condition = Condition(history, jnp.zeros((400, WINDOW, 8)), jnp.zeros((400, 2)))
    disturbed = np.asarray(dropping._disturbed(condition, jax.random.key(1)).history)
    gone = (disturbed == 0.0).all(axis=(1, 2))
    assert 60 < gone.sum() < 140
    assert (disturbed[~gone] == 1.0).all()
    assert trainer._disturbed(condition, jax.random.key(1)).history is history


def test_dropout_is_drawn_in_training_alone():
    model = tiny_config(base_block="transformer", num_heads=2, dropout=0.5)
    trainer = tiny_trainer(model)
    params = trainer.initial_state().params
    held_out = [trainer.held_out_terms(params, tiny_windows()) for _ in range(2)]
    assert held_out[0] == held_out[1]
    quiet = tiny_trainer(dataclasses.replace(model, dropout=0.0))
    assert quiet.held_out_terms(params, tiny_windows()) == held_out[0]
    # Same weights, batch and noise: only dropout makes a training step differ.
    with_dropout, _ = trainer.run(stop_after=3, **QUIET)
    without, _ = quiet.run(stop_after=3, **QUIET)
    assert largest_change(with_dropout.params, without.params) > 1e-6


def test_our_recipe_trains_and_resumes_exactly(tmp_path):
    recipe = short_recipe("F3AMD-FNO-32-plus", 8, batch_size=8).to_dict()
    model = tiny_config(block_residual=True, history_anchor=True, residual_prior=True)
    trainer = tiny_trainer(model, **recipe)
    whole, _ = trainer.run(**QUIET)
    checkpoint = tmp_path / "state.safetensors"
    trainer.run(checkpoint=checkpoint, stop_after=4, **QUIET)
    resumed, _ = trainer.run(checkpoint=checkpoint, **QUIET)
    assert finite(whole) and same_tree(whole, resumed)
    assert largest_change(whole.params, trainer.initial_state().params) > 1e-4


def test_log_normal_noise_has_the_mean_and_deviation_it_names():
    config = TrainingConfig(10, noise="log_normal")
    log_sigma = np.log(loop.draw_sigma(jax.random.key(3), 20_000, config))
    mean, deviation = loop.LOG_NORMAL_SIGMA
    assert log_sigma.mean() == pytest.approx(mean, abs=0.03)
    assert log_sigma.std() == pytest.approx(deviation, abs=0.03)
    narrow = TrainingConfig(10, noise="log_normal", diffusion=VarianceExploding(sigma_max=1.0, sigma_min=0.5))
    sigma = np.asarray(loop.draw_sigma(jax.random.key(3), 1000, narrow))
    assert sigma.min() == pytest.approx(0.5) and sigma.max() == pytest.approx(1.0)


def test_weights_towards_low_noise_are_those_of_karras_up_to_the_cap():
    sigma = jnp.array([0.1, 1.0, 128.0])
    assert loop.noise_weights(sigma, TrainingConfig(10)) is None
    weights = np.asarray(loop.noise_weights(sigma, TrainingConfig(10, noise_weighting="low_noise")))
    expected = np.array([6.0, 2.0, 1.0 + 128.0**-2])
    np.testing.assert_allclose(weights, expected / expected.mean(), rtol=1e-6)


def test_condition_dropout_hides_history_path_and_style_together():
    trainer = tiny_trainer(condition_dropout=0.5)
    batch = gather_windows(
        tiny_windows(), jnp.zeros(64, int), jnp.zeros(64), jnp.zeros(64, int),
        window=WINDOW, num_history=HISTORY,
    )  # fmt: skip
    _, condition = network_inputs(batch, trainer.normaliser)
    hidden = trainer._disturbed(condition, jax.random.key(0))
    gone = np.array([not np.any(np.asarray(part)) for part in hidden.style])
    assert 16 < gone.sum() < 48
    for part, before in zip(hidden, condition, strict=True):
        assert not np.any(np.asarray(part)[gone])
        np.testing.assert_array_equal(np.asarray(part)[~gone], np.asarray(before)[~gone])


def test_weighted_noise_changes_training_but_not_the_held_out_loss():
    plain, weighted = tiny_trainer(), tiny_trainer(noise_weighting="low_noise")
    state = plain.initial_state()
    assert plain.held_out_terms(state.ema, tiny_windows()) == weighted.held_out_terms(state.ema, tiny_windows())
    one, _ = plain.advance(plain.initial_state(), 2)
    two, _ = weighted.advance(weighted.initial_state(), 2)
    assert largest_change(one.params, two.params) > 1e-5


@pytest.mark.parametrize(
    ("field", "value", "hint"), [("noise", "mixd", "'mixed'"), ("noise_weighting", "low_nose", "'low_noise'")]
)
def test_misspelt_noise_is_refused(field, value, hint):
    with pytest.raises(ValueError, match=f"unknown {field} '{value}'.*{hint}"):
        TrainingConfig(10, **{field: value})
