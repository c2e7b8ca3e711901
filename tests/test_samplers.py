"""Samplers against denoisers that are known exactly."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from f3amd_lib.diffusion.samplers import (
    add_noise,
    ddim_step,
    ddim_step_vp,
    sample_ddim,
    sample_ddim_vp,
)
from f3amd_lib.diffusion.schedules import VarianceExploding, alpha_bar_from_sigma

SCHEDULE = VarianceExploding()


def two_modes(width=0.1):
    """Exact denoiser of an even mixture of N(-1, width^2) and N(1, width^2)."""

    def denoise(x_noisy, sigma):
        variance = width**2 + sigma**2
        share = width**2 / variance
        return share * x_noisy + (1.0 - share) * jnp.tanh(x_noisy / variance)

    return denoise


def one_mode(mean, width):
    """Exact denoiser of N(mean, width^2)."""

    def denoise(x_noisy, sigma):
        return mean + width**2 / (width**2 + sigma**2) * (x_noisy - mean)

    return denoise


def start(count=512, seed=3):
    return 128.0 * np.random.default_rng(seed).standard_normal((count, 1, 1))


def literal_appendix_f(denoise, x, sigmas):
    """The printed update without rescaling: the VP state goes to the network as it is."""
    for sigma, sigma_next in zip(sigmas[:-1], sigmas[1:], strict=True):
        x0_hat = denoise(x, sigma)
        eps_hat = (x - x0_hat) / sigma
        alpha_bar = alpha_bar_from_sigma(sigma_next)
        x = np.sqrt(alpha_bar) * x0_hat + np.sqrt(1.0 - alpha_bar) * eps_hat
    return np.asarray(x)


def test_eq08_noise_is_added_to_an_unscaled_signal():
    x0, noise = np.array([[1.0, 2.0]]), np.array([[3.0, -1.0]])
    np.testing.assert_array_equal(add_noise(x0, 2.0, noise), [[7.0, 0.0]])


def test_appendix_f_step_by_hand():
    # eps_hat = (5 - 1) / 4 = 1; x0_hat + 2 * 1.
    assert ddim_step(5.0, 1.0, 4.0, 2.0) == pytest.approx(3.0)
    # Same step in VP form from sigma 4 to 2: alpha_bar 1/17 to 1/5.
    z = ddim_step_vp(5.0 / np.sqrt(17.0), 1.0, 1.0 / 17.0, 0.2)
    assert z == pytest.approx(3.0 / np.sqrt(5.0))


def test_a_step_to_zero_returns_the_estimate_exactly():
    x0_hat = np.float32([0.1, -0.7])
    np.testing.assert_array_equal(ddim_step(np.float32([3e3, -4e3]), x0_hat, 0.01, 0.0), x0_hat)


@pytest.mark.parametrize("num_steps", [1, 2, 4, 8, 64])
def test_appendix_f_vp_equals_ve_in_float32(num_steps):
    sigmas, x_init = SCHEDULE.grid(num_steps), jnp.asarray(start(), jnp.float32)
    ve = sample_ddim(two_modes(), x_init, sigmas)
    vp = sample_ddim_vp(two_modes(), x_init, sigmas)
    assert ve.dtype == vp.dtype == jnp.float32
    np.testing.assert_allclose(vp, ve, atol=2e-4)
    assert float(jnp.std(ve)) > 1e-4  # not equal merely because all is zero


@pytest.mark.parametrize("num_steps", [1, 4, 8, 64])
def test_appendix_f_vp_equals_ve_in_float64(num_steps):
    sigmas = SCHEDULE.grid(num_steps)
    with jax.enable_x64(True):
        x_init = jnp.asarray(start(), jnp.float64)
        ve = np.asarray(sample_ddim(two_modes(), x_init, sigmas))
        vp = np.asarray(sample_ddim_vp(two_modes(), x_init, sigmas))
    assert ve.dtype == np.float64
    np.testing.assert_allclose(vp, ve, atol=1e-12)


@pytest.mark.parametrize("unroll", [False, True])
def test_scan_equals_a_python_loop(unroll):
    sigmas, x = SCHEDULE.grid(8), start(64)
    with jax.enable_x64(True):
        sampled = np.asarray(sample_ddim(two_modes(), jnp.asarray(x), sigmas, unroll=unroll))
    for sigma, sigma_next in zip(sigmas[:-1], sigmas[1:], strict=True):
        x0_hat = np.asarray(two_modes()(x, sigma))
        x = x0_hat + sigma_next * (x - x0_hat) / sigma
    np.testing.assert_allclose(sampled, x, atol=1e-6)


def test_unrolled_program_has_no_loop():
    sigmas, x_init = SCHEDULE.grid(4), jnp.zeros((1, 2, 3))

    def lowered(unroll):
        sample = lambda x: sample_ddim(two_modes(), x, sigmas, unroll=unroll)
        return jax.jit(sample).lower(x_init).as_text()

    assert "while" in lowered(False)
    assert "while" not in lowered(True)


@pytest.mark.parametrize("sample", [sample_ddim, sample_ddim_vp])
def test_one_step_returns_the_denoiser_at_sigma_max(sample):
    x_init = jnp.asarray(start(16), jnp.float32)
    seen = two_modes(width=100.0)(x_init, 128.0)
    np.testing.assert_allclose(
        sample(two_modes(width=100.0), x_init, SCHEDULE.grid(1)), seen, rtol=1e-5, atol=1e-5
    )


@pytest.mark.parametrize("sample", [sample_ddim, sample_ddim_vp])
def test_the_denoiser_always_sees_the_variance_exploding_state(sample):
    # A denoiser that knows x0 keeps the state on the line x0 + sigma * noise, which it can check.
    rng = np.random.default_rng(0)
    x0, noise = rng.standard_normal((2, 4, 3, 2))
    sigmas = SCHEDULE.grid(6)
    with jax.enable_x64(True):

        def denoise(x_noisy, sigma):
            off_line = jnp.max(jnp.abs(x_noisy - add_noise(x0, sigma, noise)))
            return jnp.where(off_line < 1e-9, x0, jnp.nan)

        x = sample(denoise, jnp.asarray(add_noise(x0, sigmas[0], noise)), sigmas)
    np.testing.assert_allclose(x, x0, atol=1e-12)


def test_grids_that_do_not_end_at_zero_leave_the_rest_of_the_noise():
    with jax.enable_x64(True):
        x = sample_ddim(lambda x, sigma: 0.0 * x, jnp.full((1, 1, 1), 8.0), [8.0, 4.0, 2.0])
        z = sample_ddim_vp(lambda x, sigma: 0.0 * x, jnp.full((1, 1, 1), 8.0), [8.0, 4.0, 2.0])
    assert float(x[0, 0, 0]) == pytest.approx(2.0) and float(z[0, 0, 0]) == pytest.approx(2.0)


def test_appendix_f_without_rescaling_collapses():
    spread = {}
    for num_steps in (8, 16, 256):
        sigmas = SCHEDULE.grid(num_steps)
        literal = literal_appendix_f(two_modes(), start(), sigmas)
        rescaled = sample_ddim_vp(two_modes(), jnp.asarray(start(), jnp.float32), sigmas)
        spread[num_steps] = np.abs(literal).mean(), float(jnp.abs(rescaled).mean())
    # Truth is 1: both modes lie there. Figures measured once with another implementation.
    assert all(literal < 0.01 for literal, _ in spread.values())
    assert spread[8][1] == pytest.approx(0.711, abs=0.04)
    assert spread[16][1] == pytest.approx(0.933, abs=0.03)
    assert spread[256][1] == pytest.approx(0.997, abs=0.02)


def test_both_modes_are_reached_and_keep_their_width():
    with jax.enable_x64(True):
        x = np.asarray(sample_ddim(two_modes(), jnp.asarray(start(2000)), SCHEDULE.grid(512)))
    right = x[x > 0]
    assert 0.45 < len(right) / x.size < 0.55
    assert right.mean() == pytest.approx(1.0, abs=0.01)
    assert right.std() == pytest.approx(0.1, rel=0.1)


def exact_end(mean, width, x_init):
    """Where dx/dsigma = (x - D(x, sigma)) / sigma ends for a single Gaussian."""
    return mean + (x_init - mean) * width / np.sqrt(width**2 + 128.0**2)


@pytest.mark.parametrize("sample", [sample_ddim, sample_ddim_vp])
def test_error_falls_at_first_order_on_the_gaussian_oracle(sample):
    mean, width, x_init = 0.7, 0.3, start(32)
    errors = []
    with jax.enable_x64(True):
        for num_steps in (64, 128, 256, 512):
            x = sample(one_mode(mean, width), jnp.asarray(x_init), SCHEDULE.grid(num_steps))
            errors.append(np.abs(np.asarray(x) - exact_end(mean, width, x_init)).mean())
    orders = np.log2(np.array(errors[:-1]) / np.array(errors[1:]))
    np.testing.assert_allclose(orders, 1.0, atol=0.15)


def test_gaussian_oracle_reaches_known_mean_and_deviation():
    x_init = jnp.asarray(start(4000), jnp.float32)
    x = np.asarray(sample_ddim(one_mode(0.7, 0.3), x_init, SCHEDULE.grid(1024)))
    assert x.mean() == pytest.approx(0.7, abs=0.02)
    assert x.std() == pytest.approx(0.3, rel=0.05)


@pytest.mark.parametrize("sample", [sample_ddim, sample_ddim_vp])
@pytest.mark.parametrize("sigmas", [[1.0], [], [[1.0, 0.0]]])
def test_grids_without_a_step_are_refused(sample, sigmas):
    with pytest.raises(ValueError, match="sigmas"):
        sample(two_modes(), jnp.zeros((1, 1, 1)), sigmas)
