"""Both readings of Appendix F on networks whose answers are known."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from builders import tiny_trained, tiny_windows

from f3amd_companion.measuring.fingerprint import UPDATES, walk_updates, window_figures
from f3amd_lib.data.features import frame_positions
from f3amd_lib.data.windows import spread_windows
from f3amd_lib.diffusion.samplers import sample
from f3amd_lib.training.denoising_task import network_inputs


def walked(trained, **settings):
    x0, condition = network_inputs(spread_windows(tiny_windows(), 3), trained.normaliser)
    return walk_updates(trained, condition, num_seeds=2, **settings), x0, condition


def one(table, update, steps, metric):
    chosen = table[(table["update"] == update) & (table["steps"] == steps)]
    (value,) = chosen.loc[chosen["metric"] == metric, "value"]
    return value


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
    table = window_figures(walked(trained)[0])
    assert one(table, "literal", 1, "from_rescaled") == 0.0
    assert one(table, "literal", 8, "from_rescaled") > 1.0
    assert one(table, "literal", 8, "seed_spread") < 0.2 * one(table, "rescaled", 8, "seed_spread")


@pytest.mark.slow
def test_the_walks_are_those_of_the_samplers_by_name():
    trained = tiny_trained()
    walks, x0, condition = walked(trained, seed=3)
    network, grid = trained.network(), trained.diffusion.grid(4)
    noise = jax.random.normal(jax.random.split(jax.random.key(3), 2)[1], x0.shape)
    for update, name in UPDATES.items():
        by_name = lambda noise, condition, name=name: sample(
            name, lambda x_noisy, sigma: network(x_noisy, sigma, network.encode(condition)), 128.0 * noise, grid
        )
        x = jax.jit(by_name)(noise, condition)
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
    assert found("rescaled", 1, "joint_acceleration") == 0.0
    # One step has no half, and the literal walk of one step is not there.
    halves = table[table["metric"] == "from_half_the_steps"]
    assert list(zip(halves["update"], halves["steps"], strict=True)) == [("rescaled", 2)]
    assert set(table.loc[table["metric"] == "joint_acceleration", "unit"]) == {"cm/frame^2"}


@pytest.mark.slow
@pytest.mark.parametrize("spacing", ["endpoints", "uniform"])
def test_a_network_that_ignores_its_input_hides_the_missing_factor(model_that, spacing):
    trained = model_that(lambda x_noisy, sigma: 0.0 * x_noisy + 0.2)
    table = window_figures(walked(trained, spacing=spacing)[0])
    for steps in (4, 2):
        for metric in ("from_rescaled", "seed_spread"):
            assert one(table, "literal", steps, metric) == pytest.approx(0.0, abs=1e-4)
    assert one(table, "literal", 4, "from_half_the_steps") == pytest.approx(0.0, abs=1e-4)
