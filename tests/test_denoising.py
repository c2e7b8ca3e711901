"""Figures about one window, on denoisers whose answers are known."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
from builders import tiny_camdm, tiny_trained, tiny_windows
from scipy.stats import norm

from f3amd_lib.data.windows import spread_windows
from f3amd_lib.diffusion import samplers
from f3amd_lib.diffusion.oracles import GaussianMixture
from f3amd_lib.diffusion.schedules import variance_preserving_cosine
from f3amd_lib.measures import denoising
from f3amd_lib.rollout.rollout import MotionGenerator
from f3amd_lib.training.denoising_task import network_inputs

SIGMAS = (0.1, 1.0, 10.0)


def test_a_network_that_returns_its_input_errs_by_the_noise(model_that):
    trained = model_that(lambda x_noisy, sigma: x_noisy)
    table = denoising.x0_error_by_sigma(trained, tiny_windows(), SIGMAS)
    np.testing.assert_allclose(table["x0_error"], SIGMAS, rtol=0.1)
    np.testing.assert_allclose(table["input_error"], SIGMAS)
    # One draw of noise at every level: errors are exact multiples of each other.
    np.testing.assert_allclose(table["x0_error"] / table["x0_error"][0], np.divide(SIGMAS, 0.1))


def test_a_network_is_asked_no_level_that_it_was_never_told(monkeypatch):
    windows, asked = tiny_windows(), []

    def spy(trained, windows, sigmas, **settings):
        asked.append(tuple(sigmas))
        return pd.DataFrame({"x0_error": [1.0, 2.0]})

    monkeypatch.setattr(denoising, "x0_error_by_sigma", spy)
    monkeypatch.setattr(denoising, "seed_spread", lambda *a, **k: 0.0)
    four, one = variance_preserving_cosine(4), variance_preserving_cosine(1)
    for schedule in (four, one):
        config = tiny_camdm(noise_levels=tuple(schedule.levels.tolist()))
        generator = MotionGenerator(tiny_trained(config=config, diffusion=schedule), 1)
        ratio = denoising.noise_use(generator, windows)["x0_error_ratio"]
        assert ratio == 0.5 if schedule is four else math.isnan(ratio)
    # 0.425 is the lowest of the four levels; with a single one there is nothing to compare.
    ((lowest, highest),) = asked
    assert lowest == pytest.approx(four.levels[0]) and highest == pytest.approx(four.sigma_max)


def test_networks_are_compared_at_camdms_levels_or_at_those_that_they_were_told(model_that, monkeypatch):
    windows, asked = tiny_windows(), []

    def spy(trained, windows, sigmas, **settings):
        asked.append(tuple(sigmas))
        return pd.DataFrame({"joint_error_cm": [1.0, 2.0, 6.0]})

    monkeypatch.setattr(denoising, "x0_error_by_sigma", spy)
    four, camdms = variance_preserving_cosine(4), variance_preserving_cosine()
    told = tiny_trained(config=tiny_camdm(noise_levels=tuple(four.levels.tolist())), diffusion=four)
    assert denoising.held_out_error(told, windows) == pytest.approx(3.0)
    any_level = model_that(lambda x_noisy, sigma: x_noisy)
    denoising.held_out_error(any_level, windows)
    assert asked[0] == pytest.approx(four.levels.tolist())
    assert asked[1][:-1] == pytest.approx(camdms.levels[:-1].tolist())
    assert asked[1][-1] == any_level.diffusion.sigma_max < camdms.sigma_max


def test_the_truth_has_no_held_out_error_and_the_noise_itself_a_large_one(model_that):
    windows = tiny_windows()
    batch = spread_windows(windows, denoising.WINDOWS)
    x0 = network_inputs(batch, model_that(lambda x, s: x).normaliser)[0]
    answers = lambda x, s: x0, lambda x, s: 0.0 * x, lambda x, s: x  # the truth, the mean, the noise itself
    errors = [denoising.held_out_error(model_that(answer), windows) for answer in answers]
    assert errors[0] == pytest.approx(0.0, abs=1e-3) and 1.0 < errors[1] < errors[2]


@pytest.mark.slow
def test_seed_spread_is_the_spread_that_the_samples_have(model_that, monkeypatch):
    trained = model_that(lambda x_noisy, sigma: x_noisy)
    generator = MotionGenerator(trained, 1)
    batch = spread_windows(tiny_windows(), 4)
    x0, _ = network_inputs(batch, trained.normaliser)

    def shifted(key, condition):
        # Only the root moves from seed to seed: relative to it nothing does.
        return x0.at[..., :3].add(jax.random.normal(key))

    monkeypatch.setattr(generator, "sample", shifted)
    spread = denoising.seed_spread(generator, tiny_windows(), num_conditions=4)
    assert spread == pytest.approx(0.0, abs=1e-3)
    monkeypatch.setattr(generator, "sample", lambda key, c: x0 + 0.3 * jax.random.normal(key, x0.shape))
    assert denoising.seed_spread(generator, tiny_windows(), num_conditions=4) > 1.0


def test_the_truth_has_no_joint_error_and_the_real_seam(model_that, monkeypatch):
    windows = tiny_windows()
    trained = model_that(lambda x_noisy, sigma: x_noisy)
    generator = MotionGenerator(trained, 1)
    batch = spread_windows(windows, denoising.WINDOWS)
    x0, _ = network_inputs(batch, trained.normaliser)
    monkeypatch.setattr(generator, "sample", lambda key, condition: x0)
    quality = denoising.window_quality(generator, windows)
    assert quality["joint_error_cm"] == pytest.approx(0.0, abs=1e-3)
    for name in ("seam_cm", "joint_acceleration_cm"):
        assert quality[name] == pytest.approx(quality[f"real_{name}"], rel=1e-3)
    assert quality["real_seam_cm"] > 1.0


# ------------------------------------------------------------------------- use of x, use of sigma


def estimates_on_a_walk(denoise, *, num_seeds=400, num_steps=64, low=0.002):
    """Clean estimates [L, S, 1] of a denoiser on its own walk from noise."""
    sigmas = np.append(np.geomspace(128.0, low, num_steps), 0.0)
    start = sigmas[0] * norm.ppf((np.arange(num_seeds) + 0.5) / num_seeds)[:, None]
    with jax.enable_x64(True):
        visited = list(samplers.walk("ddim", denoise, start, sigmas))[:-1]
    return np.stack([np.asarray(one.x0_hat) for one in visited])


@pytest.mark.parametrize("means", [[0.8], [-1.0, 1.0], [-2.0, 0.5, 1.0]])
def test_an_exact_denoiser_uses_its_input_and_not_the_level_alone(means):
    mixture = GaussianMixture(means, width=0.3)
    over_noise, over_levels = denoising.estimate_variances(estimates_on_a_walk(mixture.denoise))
    assert over_noise > 0.01
    # The mean of posterior means is the mean of the data, at every level.
    assert abs(over_levels) < 0.02 * over_noise


@pytest.mark.parametrize(
    ("answer", "uses_x", "uses_sigma"),
    [
        (lambda x, sigma: 0.0 * x, False, False),
        (lambda x, sigma: 0.0 * x + jnp.log(sigma), False, True),
        (lambda x, sigma: x / jnp.hypot(1.0, sigma), True, False),
    ],
    ids=["constant", "level alone", "input"],
)
def test_use_of_inputs_is_told_on_held_out_windows(model_that, answer, uses_x, uses_sigma):
    trained = model_that(answer)
    condition = denoising.held_out_condition(tiny_windows(), trained, 4)
    table = denoising.input_use(trained, condition, num_seeds=4)
    value = table.set_index("metric")["value"]
    assert (value["use_of_x"] > 0.5) == uses_x
    assert (value["use_of_sigma"] > 0.5 * max(1.0, value["use_of_x"])) == uses_sigma
    if not uses_x:
        assert value["use_of_x"] < 1e-3


@pytest.mark.slow
def test_a_network_that_ignores_its_input_errs_alike_everywhere(model_that):
    trained = model_that(lambda x_noisy, sigma: 0.0 * x_noisy)
    windows = tiny_windows()
    table = denoising.x0_error_by_sigma(trained, windows, SIGMAS)
    batch = spread_windows(windows, denoising.WINDOWS)
    x0, _ = network_inputs(batch, trained.normaliser)
    np.testing.assert_allclose(table["x0_error"], float(np.sqrt(np.mean(x0**2))), rtol=1e-5)
    use = denoising.noise_use(MotionGenerator(trained, 1), windows)
    assert use["x0_error_ratio"] == pytest.approx(1.0)
    assert use["seed_spread_cm"] == pytest.approx(0.0, abs=1e-4)


def test_a_network_that_sees_sigma_alone_moves_with_it_though_it_ignores_its_input():
    # 0.5 below sigma 1 and 0.3 above: its samples are 0.5 from 2 steps on, and 0.3 at 1.
    answer = lambda x, sigma: 0.0 * x + jnp.where(sigma < 1.0, 0.5, 0.3)
    estimates = estimates_on_a_walk(answer)
    share = np.mean(np.unique(estimates, return_inverse=True)[1])
    over_noise, over_levels = denoising.estimate_variances(estimates)
    assert over_noise == pytest.approx(0.0, abs=1e-20)
    assert over_levels == pytest.approx(0.2**2 * share * (1 - share))
