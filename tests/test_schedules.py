"""Noise levels: Eq. 9, the variance-preserving levels, and the three names of one line."""

import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from f3amd_lib.diffusion.schedules import (
    SCHEDULES,
    VarianceExploding,
    VariancePreservingCosine,
    VariancePreservingLinear,
    alpha_bar_from_sigma,
    log_snr_from_sigma,
    schedule_from_dict,
    sigma_from_alpha_bar,
    sigma_from_log_snr,
)

# Cube roots 2 and 1: every level of this schedule can be worked out by hand.
HAND = VarianceExploding(sigma_max=8.0, sigma_min=1.0, rho=3.0)

EACH_VP = [VariancePreservingCosine(), VariancePreservingLinear()]


def test_eq09_end_points_are_the_papers():
    schedule = VarianceExploding()
    assert schedule.sigma(0.0) == pytest.approx(128.0, rel=1e-14)
    assert schedule.sigma(1.0) == pytest.approx(0.01, rel=1e-12)


def test_eq09_hand_values_of_a_three_step_grid():
    # t = 0, 1/2, 1: 2^3, 1.5^3, 1^3, then clean.
    np.testing.assert_allclose(HAND.grid(3), [8.0, 3.375, 1.0, 0.0], rtol=1e-14)
    # 128^(1/3) = 5.0396842, 0.01^(1/3) = 0.2154435; their mean cubed.
    np.testing.assert_allclose(VarianceExploding().grid(3), [128.0, 2.62756385**3, 0.01, 0.0], rtol=1e-7)


def test_eq09_uniform_spacing_by_hand():
    np.testing.assert_allclose(HAND.grid(4, "uniform"), [8.0, 1.75**3, 1.5**3, 1.25**3, 0.0], rtol=1e-14)


@pytest.mark.parametrize("spacing", ["endpoints", "uniform"])
def test_one_step_starts_at_sigma_max(spacing):
    np.testing.assert_allclose(VarianceExploding().grid(1, spacing), [128.0, 0.0], rtol=1e-14)


@pytest.mark.parametrize("spacing", ["endpoints", "uniform"])
@pytest.mark.parametrize("num_steps", [2, 4, 8, 100])
def test_grids_fall_strictly_to_zero(num_steps, spacing):
    grid = VarianceExploding().grid(num_steps, spacing)
    assert grid.dtype == np.float64 and grid.shape == (num_steps + 1,)
    assert grid[-1] == 0.0 and np.all(np.diff(grid) < 0)


@pytest.mark.parametrize("rho", [1.0, 3.0, 7.0])
def test_eq09_falls_in_t_and_time_inverts_it(rho):
    schedule = VarianceExploding(rho=rho)
    t = np.linspace(0.0, 1.0, 101)
    sigma = schedule.sigma(t)
    assert np.all(np.diff(sigma) < 0)
    np.testing.assert_allclose(schedule.time(sigma), t, atol=1e-13)
    np.testing.assert_allclose(schedule.sigma(schedule.time(sigma)), sigma, rtol=1e-11)


def test_eq09_larger_rho_puts_more_steps_at_low_noise():
    medians = [VarianceExploding(rho=rho).sigma(0.5) for rho in (1.0, 3.0, 7.0)]
    assert medians[0] > medians[1] > medians[2]
    assert medians[0] == pytest.approx((128.0 + 0.01) / 2)


def test_eq09_serves_jax_arrays_and_gradients():
    schedule = VarianceExploding()
    t = jnp.linspace(0.0, 1.0, 7)
    np.testing.assert_allclose(jax.jit(schedule.sigma)(t), schedule.sigma(np.linspace(0.0, 1.0, 7)), rtol=1e-4)
    # d sigma / dt = rho (low - high) (..)^(rho - 1); at t = 0 of HAND: 3 * (1 - 2) * 2^2.
    assert jax.grad(HAND.sigma)(0.0) == pytest.approx(-12.0, rel=1e-6)


@pytest.mark.parametrize(
    "settings",
    [
        {"sigma_min": 0.0},
        {"sigma_min": -1.0},
        {"sigma_min": 128.0},
        {"sigma_max": 0.001},
        {"rho": 0.0},
        {"sigma_max": float("nan")},
        {"sigma_max": float("inf")},
        {"rho": float("inf")},
    ],
)
def test_impossible_schedules_are_refused(settings):
    with pytest.raises(ValueError, match="sigma_min"):
        VarianceExploding(**settings)


def test_impossible_grids_are_refused():
    with pytest.raises(ValueError, match="num_steps=0"):
        VarianceExploding().grid(0)
    with pytest.raises(ValueError, match="'endpoint'.*'endpoints'"):
        VarianceExploding().grid(4, "endpoint")


def test_eq09_training_draws_t_uniformly():
    schedule, key = VarianceExploding(), jax.random.key(4)
    drawn = schedule.draw(key, (5, 3))
    np.testing.assert_array_equal(drawn, schedule.sigma(jax.random.uniform(key, (5, 3))))
    t = np.sort(schedule.time(schedule.draw(key, (10_000,))))
    np.testing.assert_allclose(t, np.linspace(0.0, 1.0, 10_000), atol=0.02)


# Cosine levels as CAMDM's released configuration holds them (K = 4), and as its formula gives.
@pytest.mark.parametrize(
    ("num_levels", "name", "expected"),
    [
        (4, "betas", [0.152988, 0.416958, 0.707859, 0.999]),
        (4, "alpha_bars", [0.847012, 0.493844, 0.144272, 0.000144]),
        (8, "alpha_bars", [0.957805, 0.847012, 0.684227, 0.493844, 0.304395, 0.144272, 0.037472, 0.000037]),
    ],
)
def test_cosine_levels_are_camdms(num_levels, name, expected):
    found = getattr(VariancePreservingCosine(num_levels), name)
    assert found.dtype == np.float64
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-6)


def test_cosine_levels_as_noise_on_an_unscaled_signal():
    # The noise levels that the released levels stand for, to their printed digits.
    four, eight = VariancePreservingCosine(4), VariancePreservingCosine(8)
    np.testing.assert_allclose(four.sigmas[:3], [0.425, 1.012, 2.435], atol=5e-4)
    assert four.sigma_max == pytest.approx(83.2, abs=0.05)
    assert eight.sigmas[0] == pytest.approx(0.210, abs=5e-4)
    assert eight.sigma_max == pytest.approx(163.4, abs=0.05)
    # To all digits: the cosine, of which the last level leaves a thousandth.
    for schedule in (four, eight):
        angle = np.radians((np.arange(schedule.num_levels) / schedule.num_levels + 0.008) / 1.008)
        left = np.cos(90 * angle) ** 2 / np.cos(90 * angle[0]) ** 2
        left = np.append(left[1:], 0.001 * left[-1])
        np.testing.assert_allclose(schedule.sigmas, np.sqrt((1.0 - left) / left), rtol=1e-11)


def test_cosine_levels_follow_the_cosine_until_the_last():
    schedule = VariancePreservingCosine(num_levels=6, offset=0.1, max_beta=0.99)
    s = np.arange(1, 7) / 6
    # cos^2((s + 0.1) / 1.1 * 90 degrees), relative to its value at s = 0.
    wanted = np.cos(np.radians((s + 0.1) / 1.1 * 90)) ** 2 / np.cos(np.radians(90 / 11)) ** 2
    np.testing.assert_allclose(schedule.alpha_bars[:5], wanted[:5], rtol=1e-12)
    # The cosine ends at 0; the limit leaves a hundredth of what was there.
    np.testing.assert_allclose(schedule.alpha_bars[5], 0.01 * wanted[4], rtol=1e-12)
    np.testing.assert_allclose(schedule.betas[5], 0.99, rtol=1e-12)
    # Twice as many levels visit these ones, and one more between each.
    np.testing.assert_allclose(
        VariancePreservingCosine(8).alpha_bars[1:-1:2], VariancePreservingCosine(4).alpha_bars[:3], rtol=1e-12
    )


def test_linear_levels_by_hand():
    schedule = VariancePreservingLinear(num_levels=2, beta_min=1.0, beta_max=3.0)
    # The rate 1 + 2 s integrates to s + s^2: 3/4 at s = 1/2, 2 at s = 1.
    np.testing.assert_allclose(schedule.alpha_bars, np.exp([-0.75, -2.0]), rtol=1e-14)
    np.testing.assert_allclose(schedule.betas, 1.0 - np.exp([-0.75, -1.25]), rtol=1e-14)
    np.testing.assert_allclose(schedule.sigmas, np.sqrt(np.expm1([0.75, 2.0])), rtol=1e-14)
    # Song et al.'s rates integrate to 10.05.
    assert VariancePreservingLinear().sigma_max == pytest.approx(np.sqrt(np.expm1(10.05)))


def test_linear_betas_of_many_levels_are_the_rate_over_their_number():
    schedule = VariancePreservingLinear(num_levels=4000)
    s = (np.arange(4000) + 0.5) / 4000
    np.testing.assert_allclose(schedule.betas, (0.1 + 19.9 * s) / 4000, rtol=3e-3)


@pytest.mark.parametrize("schedule", EACH_VP)
def test_variance_preserving_levels_rise_and_fit_together(schedule):
    assert schedule.alpha_bars.shape == (schedule.num_levels,)
    assert np.all(np.diff(schedule.sigmas) > 0) and schedule.sigmas[-1] == schedule.sigma_max
    np.testing.assert_allclose(np.cumprod(1.0 - schedule.betas), schedule.alpha_bars, rtol=1e-11)
    np.testing.assert_allclose(alpha_bar_from_sigma(schedule.sigmas), schedule.alpha_bars, rtol=1e-12)


@pytest.mark.parametrize(
    ("num_steps", "spacing", "levels"),
    [
        (1, "endpoints", [7]),
        (2, "endpoints", [7, 0]),
        (4, "endpoints", [7, 5, 2, 0]),  # 7, 4.67, 2.33, 0
        (8, "endpoints", [7, 6, 5, 4, 3, 2, 1, 0]),
        (1, "uniform", [7]),
        (2, "uniform", [7, 3]),
        (3, "uniform", [7, 4, 2]),  # 7, 4.33, 1.67
        (4, "uniform", [7, 5, 3, 1]),
        (8, "uniform", [7, 6, 5, 4, 3, 2, 1, 0]),
    ],
)
def test_respaced_grids_visit_levels_that_were_trained(num_steps, spacing, levels):
    schedule = VariancePreservingCosine(8)
    grid = schedule.grid(num_steps, spacing)
    assert grid.dtype == np.float64
    np.testing.assert_array_equal(grid, [*schedule.sigmas[levels], 0.0])


@pytest.mark.parametrize("spacing", ["endpoints", "uniform"])
def test_respaced_grids_start_at_the_noisiest_level_and_take_none_twice(spacing):
    for num_levels in (1, 5, 8, 23):
        schedule = VariancePreservingCosine(num_levels)
        for num_steps in range(1, num_levels + 1):
            grid = schedule.grid(num_steps, spacing)
            assert grid.shape == (num_steps + 1,)
            assert grid[0] == schedule.sigma_max and grid[-1] == 0.0
            assert np.all(np.diff(grid) < 0)


@pytest.mark.parametrize("schedule", EACH_VP)
def test_impossible_respaced_grids_are_refused(schedule):
    with pytest.raises(ValueError, match=f"{schedule.num_levels} noise levels"):
        schedule.grid(schedule.num_levels + 1)
    with pytest.raises(ValueError, match="num_steps=0"):
        schedule.grid(0)
    with pytest.raises(ValueError, match="'endpoint'.*'endpoints'"):
        schedule.grid(4, "endpoint")


def test_variance_preserving_training_draws_every_level_alike():
    schedule = VariancePreservingCosine(4)
    drawn = np.asarray(jax.jit(lambda key: schedule.draw(key, (4, 2000)))(jax.random.key(0)))
    levels, count = np.unique(drawn, return_counts=True)
    np.testing.assert_array_equal(levels, schedule.sigmas.astype(np.float32))
    np.testing.assert_allclose(count / drawn.size, 0.25, atol=0.02)


@pytest.mark.parametrize("schedule", [VarianceExploding(), VariancePreservingLinear()])
def test_drawn_levels_are_single_precision_everywhere(schedule):
    drawn = schedule.draw(jax.random.key(1), (3, 1))
    with jax.enable_x64(True):
        wide = schedule.draw(jax.random.key(1), (3, 1))
    assert drawn.dtype == wide.dtype == jnp.float32 and drawn.shape == wide.shape == (3, 1)
    assert float(drawn.min()) > 0.0 and float(drawn.max()) <= schedule.sigma_max * 1.0001


@pytest.mark.parametrize(
    ("schedule", "values"),
    [
        (
            VarianceExploding(64.0, 0.02, 7.0),
            {"kind": "variance_exploding", "sigma_max": 64.0, "sigma_min": 0.02, "rho": 7.0},
        ),
        (
            VariancePreservingCosine(4, 0.01, 0.99),
            {"kind": "variance_preserving_cosine", "num_levels": 4, "offset": 0.01, "max_beta": 0.99},
        ),
        (
            VariancePreservingLinear(50, 0.2, 12.0),
            {"kind": "variance_preserving_linear", "num_levels": 50, "beta_min": 0.2, "beta_max": 12.0},
        ),
    ],
)
def test_schedules_go_through_json_and_come_back(schedule, values):
    assert dataclasses.asdict(schedule) == values
    back = schedule_from_dict(json.loads(json.dumps(values)))
    assert type(back) is type(schedule) and back == schedule and hash(back) == hash(schedule)
    # What is not said takes its default.
    assert schedule_from_dict({"kind": schedule.kind}) == SCHEDULES[schedule.kind]()


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"sigma_max": 64.0}, "needs a kind.*variance_exploding"),
        ({"kind": "variance_preserving_cosin"}, "did you mean 'variance_preserving_cosine'"),
        ({"kind": "variance_exploding", "sigma_mx": 64.0}, "did you mean 'sigma_max'"),
        ({"kind": "variance_preserving_cosine", "sigma_max": 64.0}, "unknown.*'sigma_max'"),
        ({"kind": "variance_exploding", "sampler": "ddpm"}, "unknown.*'sampler'"),
        ({"kind": "variance_exploding", "rho": "3"}, "'rho' must be a number"),
        ({"kind": "variance_preserving_linear", "num_levels": 0}, "num_levels of at least 1"),
    ],
)
def test_descriptions_that_make_no_schedule_are_refused(values, message):
    with pytest.raises(ValueError, match=message):
        schedule_from_dict(values)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"num_levels": 0}, "num_levels"),
        ({"num_levels": 4.0}, "num_levels"),
        ({"num_levels": True}, "num_levels"),
        ({"offset": -0.1}, "offset"),
        ({"offset": float("inf")}, "offset"),
        ({"max_beta": 0.0}, "max_beta"),
        ({"max_beta": 1.0}, "max_beta"),
        ({"max_beta": float("nan")}, "max_beta"),
    ],
)
def test_impossible_cosine_schedules_are_refused(settings, message):
    with pytest.raises(ValueError, match=f"variance_preserving_cosine.*{message}"):
        VariancePreservingCosine(**settings)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"num_levels": -3}, "num_levels"),
        ({"beta_min": 0.0}, "beta_min"),
        ({"beta_min": 21.0}, "beta_min"),
        ({"beta_max": float("inf")}, "beta_max"),
        ({"beta_max": 1e4}, "noise levels from .* to inf"),
        ({"beta_min": 1e-30, "beta_max": 1e-30}, "noise levels from 0 to"),
    ],
)
def test_impossible_linear_schedules_are_refused(settings, message):
    with pytest.raises(ValueError, match=message):
        VariancePreservingLinear(**settings)


def test_appendix_f_alpha_bar_by_hand():
    np.testing.assert_allclose(alpha_bar_from_sigma(np.array([0.0, 1.0, 2.0, 3.0])), [1.0, 0.5, 0.2, 0.1], rtol=1e-15)
    np.testing.assert_allclose(sigma_from_alpha_bar(np.array([0.5, 0.2, 1.0])), [1.0, 2.0, 0.0])


def test_appendix_f_signal_and_noise_shares_fit():
    # sqrt(1 - alpha_bar) = sigma sqrt(alpha_bar): VP state = sqrt(alpha_bar) times VE state.
    sigma = VarianceExploding().grid(50)[:-1]
    alpha_bar = alpha_bar_from_sigma(sigma)
    np.testing.assert_allclose(np.sqrt(1.0 - alpha_bar), sigma * np.sqrt(alpha_bar), rtol=1e-11)


def test_round_trips_between_the_three_names():
    sigma = VarianceExploding().grid(50)[:-1]
    np.testing.assert_allclose(sigma_from_alpha_bar(alpha_bar_from_sigma(sigma)), sigma, rtol=1e-11)
    np.testing.assert_allclose(sigma_from_log_snr(log_snr_from_sigma(sigma)), sigma, rtol=1e-13)
    # The signal-to-noise ratio of the VP state is alpha_bar / (1 - alpha_bar).
    alpha_bar = alpha_bar_from_sigma(sigma)
    np.testing.assert_allclose(log_snr_from_sigma(sigma), np.log(alpha_bar / (1.0 - alpha_bar)), atol=1e-11)


def test_the_three_names_answer_in_kind():
    for function in (alpha_bar_from_sigma, sigma_from_alpha_bar, log_snr_from_sigma, sigma_from_log_snr):
        assert isinstance(function(np.array([0.5])), np.ndarray)
        assert isinstance(function(jnp.array([0.5])), jax.Array)
        assert float(jax.jit(function)(0.5)) == pytest.approx(float(function(0.5)), rel=1e-6)
