"""Noise levels: Eq. 9, its inverse, and the three names of one line."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from f3amd_lib.diffusion.schedules import (
    VarianceExploding,
    alpha_bar_from_sigma,
    log_snr_from_sigma,
    sigma_from_alpha_bar,
    sigma_from_log_snr,
)

# Cube roots 2 and 1: every level of this schedule can be worked out by hand.
HAND = VarianceExploding(sigma_max=8.0, sigma_min=1.0, rho=3.0)


def test_eq09_end_points_are_the_papers():
    schedule = VarianceExploding()
    assert schedule.sigma(0.0) == pytest.approx(128.0, rel=1e-14)
    assert schedule.sigma(1.0) == pytest.approx(0.01, rel=1e-12)


def test_eq09_hand_values_of_a_three_step_grid():
    # t = 0, 1/2, 1: 2^3, 1.5^3, 1^3, then clean.
    np.testing.assert_allclose(HAND.grid(3), [8.0, 3.375, 1.0, 0.0], rtol=1e-14)
    # 128^(1/3) = 5.0396842, 0.01^(1/3) = 0.2154435; their mean cubed.
    np.testing.assert_allclose(
        VarianceExploding().grid(3), [128.0, 2.62756385**3, 0.01, 0.0], rtol=1e-7
    )


def test_eq09_uniform_spacing_by_hand():
    np.testing.assert_allclose(
        HAND.grid(4, "uniform"), [8.0, 1.75**3, 1.5**3, 1.25**3, 0.0], rtol=1e-14
    )


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
    np.testing.assert_allclose(
        jax.jit(schedule.sigma)(t), schedule.sigma(np.linspace(0.0, 1.0, 7)), rtol=1e-4
    )
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


def test_appendix_f_alpha_bar_by_hand():
    np.testing.assert_allclose(
        alpha_bar_from_sigma(np.array([0.0, 1.0, 2.0, 3.0])), [1.0, 0.5, 0.2, 0.1], rtol=1e-15
    )
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
    np.testing.assert_allclose(
        log_snr_from_sigma(sigma), np.log(alpha_bar / (1.0 - alpha_bar)), atol=1e-11
    )


def test_the_three_names_answer_in_kind():
    for function in (
        alpha_bar_from_sigma,
        sigma_from_alpha_bar,
        log_snr_from_sigma,
        sigma_from_log_snr,
    ):
        assert isinstance(function(np.array([0.5])), np.ndarray)
        assert isinstance(function(jnp.array([0.5])), jax.Array)
        assert float(jax.jit(function)(0.5)) == pytest.approx(float(function(0.5)), rel=1e-6)
