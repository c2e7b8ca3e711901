"""Both readings of Appendix F on networks whose answers are known, and the measurement of them."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
from builders import HISTORY, WINDOW, tiny_camdm, tiny_packed, tiny_trained, tiny_windows

from f3amd_companion.measuring import measure
from f3amd_companion.measuring.literal_update import (
    UPDATES,
    WINDOW_METRICS,
    seed_condition,
    walk_seed_histories,
    walk_windows,
    window_figures,
)
from f3amd_lib.data.features import frame_positions
from f3amd_lib.data.windows import spread_windows
from f3amd_lib.diffusion.samplers import sample
from f3amd_lib.diffusion.schedules import variance_preserving_cosine
from f3amd_lib.ground.profiles import load_profile
from f3amd_lib.ground.records import read_table, run_record
from f3amd_lib.motion.rotations import rotation_6d_from_yaw
from f3amd_lib.training.denoising_task import network_inputs
from f3amd_lib.training.pipeline import PreparedData

FEW = {"num_windows": 3, "num_seeds": 2}


def one(table, update, steps, metric):
    chosen = table[(table["update"] == update) & (table["steps"] == steps)]
    (value,) = chosen.loc[chosen["metric"] == metric, "value"]
    return value


@pytest.mark.slow
@pytest.mark.parametrize("spacing", ["endpoints", "uniform"])
def test_a_network_that_ignores_its_input_hides_the_missing_factor(model_that, spacing):
    trained = model_that(lambda x_noisy, sigma: 0.0 * x_noisy + 0.2)
    walks = walk_windows(trained, tiny_windows(), (4, 2), spacing=spacing, **FEW)
    table = window_figures(*walks)
    for steps in (4, 2):
        for metric in ("from_rescaled", "seed_spread"):
            assert one(table, "literal", steps, metric) == pytest.approx(0.0, abs=1e-4)
    assert one(table, "literal", 4, "from_half_the_steps") == pytest.approx(0.0, abs=1e-4)


@pytest.mark.slow
def test_a_network_that_uses_its_input_shows_it(model_that):
    # The exact denoiser of features that are normal: it keeps the share 1 / (1 + sigma^2).
    trained = model_that(lambda x_noisy, sigma: x_noisy / (1.0 + sigma**2))
    # Around a root that faces ahead: features of 0 shall be a pose, not a rotation of no direction.
    normaliser = trained.normaliser
    mean = normaliser.mean.at[3:9].set(jnp.array([1.0, 0.0, 0.0, 0.0, 1.0, 0.0]))
    deviation = normaliser.deviation.at[3:9].set(0.2)
    normaliser = normaliser._replace(mean=mean, deviation=deviation)
    trained = dataclasses.replace(trained, normaliser=normaliser)
    table = window_figures(*walk_windows(trained, tiny_windows(), (8, 1), **FEW))
    assert one(table, "literal", 1, "from_rescaled") == 0.0
    assert one(table, "literal", 8, "from_rescaled") > 1.0
    assert one(table, "literal", 8, "seed_spread") < 0.2 * one(table, "rescaled", 8, "seed_spread")


@pytest.mark.slow
def test_the_walks_are_those_of_the_samplers_by_name():
    trained, windows = tiny_trained(), tiny_windows()
    walks, _ = walk_windows(trained, windows, (4,), seed=3, **FEW)
    x0, condition = network_inputs(spread_windows(windows, 3), trained.normaliser)
    network, grid = trained.network(), trained.diffusion.grid(4)
    noise = jax.random.normal(jax.random.split(jax.random.key(3), 2)[1], x0.shape)
    for update, name in UPDATES.items():
        walked = lambda noise, condition, name=name: sample(
            name, lambda x_noisy, sigma: network(x_noisy, sigma, network.encode(condition)), 128.0 * noise, grid
        )
        x = jax.jit(walked)(noise, condition)
        joints = frame_positions(trained.skeleton, trained.normaliser.denormalise(x))
        np.testing.assert_allclose(walks[update, 4][1], joints, atol=1e-4)
    assert np.abs(walks["literal", 4] - walks["rescaled", 4]).max() > 1e-3


def test_figures_by_hand():
    # One window, two joints; two seeds that differ in the second joint's place, 2 cm apart.
    real = np.zeros((1, 4, 2, 3))
    apart = np.zeros((2, 1, 4, 2, 3))
    apart[1, ..., 1, 0] = 0.02
    made = {("rescaled", 2): apart, ("rescaled", 1): 0.0 * apart, ("literal", 2): apart + 0.03}
    table = window_figures(made, real)
    found = lambda *row: one(table, *row)
    assert found("rescaled", 2, "joint_error") == pytest.approx(0.5)  # 2 cm, one of two joints
    assert found("rescaled", 1, "joint_error") == 0.0
    # The unbiased variance of 0 and 2 cm is 2 cm^2; the other joint, the root, has none.
    assert found("rescaled", 2, "seed_spread") == pytest.approx(1.0)
    assert found("literal", 2, "from_rescaled") == pytest.approx(3.0 * np.sqrt(3.0))
    assert found("rescaled", 2, "from_half_the_steps") == pytest.approx(0.5)
    assert found("real", 0, "joint_acceleration") == 0.0
    # One step has no half, and the literal walk of one step is not there.
    halves = table[table["metric"] == "from_half_the_steps"]
    assert list(zip(halves["update"], halves["steps"], strict=True)) == [("rescaled", 2)]
    assert dict(zip(table["metric"], table["unit"], strict=True)) == WINDOW_METRICS


@pytest.fixture
def measurement(tmp_path, monkeypatch):
    """`measure_literal_update` on tiny models, with rollouts of a made-up value."""
    prepared = PreparedData(tiny_packed(), WINDOW, HISTORY)
    schedule = variance_preserving_cosine(4)
    models = {"F3AMD-FNO-32": tiny_trained(), "CAMDM": tiny_trained(config=tiny_camdm(), diffusion=schedule)}
    calls = []

    def measure_model(generator, *arguments, name):
        calls.append((name, generator.sampler, generator.num_steps, float(generator.sigmas[-2])))
        row = {"model": name, "window_frames": WINDOW, "steps": generator.num_steps}
        row |= {"varies": "seed", "metric": "IRD", "unit": "cm", "better": "near real"}
        return pd.DataFrame([row | {"seed": seed, "value": 1.0 + seed} for seed in (0, 1)]), None

    def protocol(prepared, profile, measurement):
        return None, None, run_record(profile=profile, dataset="synthetic", seed=0, size="tiny")

    walk = lambda *arguments, **settings: walk_windows(*arguments, **settings, **FEW)
    monkeypatch.setenv("F3AMD_RESULTS_DIR", str(tmp_path))
    monkeypatch.setattr(measure, "protocol_of", protocol)
    monkeypatch.setattr(measure, "measure_model", measure_model)
    monkeypatch.setattr(measure, "obtain_model", lambda *a, preset: (models[preset], None, ""))
    monkeypatch.setattr(measure, "available_models", lambda profile: list(models))
    monkeypatch.setattr(measure, "STEPS", (2, 1))
    monkeypatch.setattr(measure, "SIGMAS", (0.1, 128.0))
    monkeypatch.setattr(measure, "walk_windows", walk)
    profile = load_profile("smoke", "synthetic")

    return lambda: (measure.measure_literal_update(prepared, profile), calls)


def test_the_measurement_walks_both_updates_on_both_grids(measurement):
    path, calls = measurement()
    table, _ = read_table(path)
    # One step is the same walk in all four ways; a model of DDPM has no printed update.
    middle = measure.MotionGenerator(tiny_trained(), 2, spacing="uniform").sigmas[-2]
    assert calls == [
        ("F3AMD-FNO-32", "ddim", 2, pytest.approx(0.01)),
        ("F3AMD-FNO-32", "ddim", 1, pytest.approx(128.0)),
        ("F3AMD-FNO-32", "ddim_literal", 2, pytest.approx(0.01)),
        ("F3AMD-FNO-32", "ddim", 2, pytest.approx(middle)),
        ("F3AMD-FNO-32", "ddim_literal", 2, pytest.approx(middle)),
    ]
    ways = set(zip(table["spacing"], table["update"], table["steps"], strict=True))
    assert len(table) == len(ways) == 5
    assert ("uniform", "literal", 2) in ways and ("uniform", "literal", 1) not in ways
    assert set(table["value"]) == {1.5} and (table["low"] < 1.5).all()
    windows, _ = read_table(path.with_name("literal_update_windows.csv"))
    assert set(windows["model"]) == {"F3AMD-FNO-32"}
    assert set(windows["spacing"]) == {"endpoints", "uniform"}


def test_seed_histories_go_straight_on_at_their_own_pace():
    trained = tiny_trained()
    condition = seed_condition(trained)
    normaliser = trained.normaliser
    assert condition.style.shape == (len(trained.styles),) * 2
    for row, style in enumerate(trained.styles):
        history = trained.start_poses[style][0]
        shown = normaliser.denormalise(condition.history[row])
        np.testing.assert_allclose(shown, history, atol=1e-5)
        assert int(np.argmax(condition.style[row])) == trained.style_index(style)
        # Displacements along +Z, by the mean step of the history, and no turn.
        path = np.asarray(condition.path[row])
        pace = np.linalg.norm((history[-1] - history[0])[[0, 2]]) / (len(history) - 1)
        ahead = path[:, 1] * float(normaliser.path_scale)
        np.testing.assert_allclose(ahead, pace * np.arange(1, WINDOW + 1), rtol=1e-4, atol=1e-6)
        np.testing.assert_allclose(path[:, 0], 0.0, atol=1e-7)
        np.testing.assert_allclose(path[:, 2:], rotation_6d_from_yaw(np.zeros(WINDOW)), atol=1e-7)


@pytest.mark.slow
def test_walks_from_seed_histories_need_no_data_and_have_no_error():
    trained = tiny_trained()
    walks = walk_seed_histories(trained, (8, 4), num_seeds=2, seed=1)
    assert walks["literal", 8].shape[:3] == (2, len(trained.styles), WINDOW)
    table = window_figures(walks)
    assert set(table["metric"]) == set(WINDOW_METRICS) - {"joint_error"}
    assert set(table["update"]) == set(UPDATES)
