"""Samplers against denoisers that are known exactly."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from builders import refused

from f3amd_lib.diffusion.oracles import GaussianMixture
from f3amd_lib.diffusion.samplers import (
    SAMPLERS,
    add_noise,
    ddim_step,
    ddim_step_literal,
    ddim_step_vp,
    ddpm_posterior,
    ddpm_step,
    num_evaluations,
    probability_flow_slope,
    sample,
    walk,
)
from f3amd_lib.diffusion.schedules import (
    alpha_bar_from_sigma,
    variance_exploding,
    variance_preserving_cosine,
    variance_preserving_linear,
)

SCHEDULE = variance_exploding()


def two_modes(width=0.1):
    """Exact denoiser of an even mixture of N(-1, width^2) and N(1, width^2)."""

    def denoise(x_noisy, sigma):
        variance = width**2 + sigma**2
        share = width**2 / variance
        return share * x_noisy + (1.0 - share) * jnp.tanh(x_noisy / variance)

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


@pytest.mark.parametrize(("dtype", "tolerance"), [("float32", 2e-4), ("float64", 1e-12)])
@pytest.mark.parametrize("num_steps", [1, 8, "cosine"])
def test_appendix_f_vp_equals_ve(num_steps, dtype, tolerance):
    cosine = num_steps == "cosine"
    sigmas = variance_preserving_cosine().grid(4) if cosine else SCHEDULE.grid(num_steps)
    with jax.enable_x64(dtype == "float64"):
        x_init = jnp.asarray(start(), dtype)
        ve, vp = (sample(name, two_modes(), x_init, sigmas, unroll=cosine) for name in ("ddim", "ddim_vp"))
        assert ve.dtype == vp.dtype == dtype
        np.testing.assert_allclose(vp, ve, atol=tolerance)
        assert float(jnp.std(ve)) > 1e-4  # not equal merely because all is zero


@pytest.mark.parametrize("name", SAMPLERS)
def test_unrolled_program_has_no_loop(name):
    key = jax.random.key(0, impl="unsafe_rbg")  # the default random numbers loop by themselves

    def lowered(num_steps, unroll):
        sigmas = SCHEDULE.grid(num_steps)
        walked = lambda x, key: sample(name, two_modes(), x, sigmas, key=key, unroll=unroll)
        return jax.jit(walked).lower(jnp.zeros((1, 2, 3)), key).as_text()

    assert "while" in lowered(4, False)
    assert all("while" not in lowered(num_steps, True) for num_steps in (1, 2, 4))


def test_appendix_f_without_rescaling_collapses():
    spread = {}
    for num_steps in (8, 16, 256):
        sigmas = SCHEDULE.grid(num_steps)
        literal = literal_appendix_f(two_modes(), start(), sigmas)
        rescaled = sample("ddim_vp", two_modes(), jnp.asarray(start(), jnp.float32), sigmas)
        spread[num_steps] = np.abs(literal).mean(), float(jnp.abs(rescaled).mean())
    # Truth is 1: both modes lie there. Figures measured once with another implementation.
    assert all(literal < 0.01 for literal, _ in spread.values())
    assert spread[8][1] == pytest.approx(0.711, abs=0.04)
    assert spread[16][1] == pytest.approx(0.933, abs=0.03)
    assert spread[256][1] == pytest.approx(0.997, abs=0.02)


def test_appendix_f_literal_step_is_the_right_one_made_smaller():
    # ddim_step gives 1 + 2 * 1 = 3 at sigma 2, see above; 3 / sqrt(5) is the VP state of it.
    assert ddim_step_literal(5.0, 1.0, 4.0, 2.0) == pytest.approx(3.0 / np.sqrt(5.0))
    x_noisy, x0_hat = np.random.default_rng(4).standard_normal((2, 50))
    for sigma, sigma_next in ((128.0, 40.4), (6.0, 0.7), (0.7, 0.01)):
        literal = ddim_step_literal(x_noisy, x0_hat, sigma, sigma_next)
        right = ddim_step(x_noisy, x0_hat, sigma, sigma_next)
        np.testing.assert_allclose(literal * np.hypot(1.0, sigma_next), right, rtol=1e-12)
        z = ddim_step_vp(
            x_noisy / np.hypot(1.0, sigma), x0_hat, alpha_bar_from_sigma(sigma), alpha_bar_from_sigma(sigma_next)
        )
        np.testing.assert_allclose(literal, z, atol=1e-12)
    np.testing.assert_array_equal(ddim_step_literal(x_noisy, x0_hat, 0.01, 0.0), x0_hat)


@pytest.mark.parametrize("num_steps", [1, 2, 8])
def test_appendix_f_literal_walk_feeds_the_state_back_as_it_is(num_steps):
    sigmas = SCHEDULE.grid(num_steps)
    with jax.enable_x64(True):
        x = np.asarray(sample("ddim_literal", two_modes(), jnp.asarray(start(64)), sigmas))
        right = np.asarray(sample("ddim", two_modes(), jnp.asarray(start(64)), sigmas))
        by_hand = literal_appendix_f(two_modes(), start(64), sigmas)
    np.testing.assert_allclose(x, by_hand, atol=1e-10)
    # Nothing is fed back in a single step. Two end at sigma_min, where little is lost.
    apart = np.abs(x - right).max()
    assert apart == 0.0 if num_steps == 1 else apart < 1e-3 if num_steps == 2 else apart > 0.5


def test_ddpm_posterior_is_camdms():
    # K = 4 levels, least noisy first; the last step of a sampler goes to a clean signal.
    alpha_bars = variance_preserving_cosine(4).alpha_bars
    on_x0, on_z, variance = ddpm_posterior(alpha_bars, np.append(1.0, alpha_bars[:-1]))
    np.testing.assert_allclose(on_x0, [1.0, 0.758145, 0.581307, 0.379507], atol=1e-6)
    np.testing.assert_allclose(on_z, [0.0, 0.230793, 0.319702, 0.027064], atol=1e-6)
    # The released configuration repeats the second entry in place of log 0.
    assert variance[0] == 0.0
    np.testing.assert_allclose(np.log(variance[1:]), [-2.071257, -0.870617, -0.156659], atol=1e-6)


def test_ddpm_step_by_hand():
    # From sigma 2 to 1 a quarter of the seen noise stays: 1 + (5 - 1) / 4. Fresh: sqrt(1 - 1/4).
    assert ddpm_step(5.0, 1.0, 2.0, 1.0, 0.0) == pytest.approx(2.0)
    assert ddpm_step(5.0, 1.0, 2.0, 1.0, 2.0) == pytest.approx(2.0 + np.sqrt(3.0))


def test_ddpm_step_in_the_exploding_state_is_the_posterior():
    rng = np.random.default_rng(5)
    x_noisy, x0_hat, noise = rng.standard_normal((3, 6, 4))
    for sigma, sigma_next in ((83.0, 2.4), (2.4, 1.0), (1.0, 0.99), (0.4, 0.0)):
        alpha_bar, alpha_bar_next = alpha_bar_from_sigma(sigma), alpha_bar_from_sigma(sigma_next)
        on_x0, on_z, variance = ddpm_posterior(alpha_bar, alpha_bar_next)
        z_next = on_x0 * x0_hat + on_z * np.sqrt(alpha_bar) * x_noisy + np.sqrt(variance) * noise
        x_next = ddpm_step(x_noisy, x0_hat, sigma, sigma_next, noise)
        np.testing.assert_allclose(np.sqrt(alpha_bar_next) * x_next, z_next, rtol=0, atol=1e-13)


def test_ddpm_equals_camdms_loop_over_its_own_levels():
    # The released code walks the VP state with a table of coefficients, from z ~ N(0, 1).
    schedule, key = variance_preserving_cosine(4), jax.random.key(2)
    alpha_bars = schedule.alpha_bars
    before = np.append(1.0, alpha_bars[:-1])
    betas = 1.0 - alpha_bars / before
    with jax.enable_x64(True):
        z = start(32) / 128.0
        x_init = jnp.asarray(z / np.sqrt(alpha_bars[-1]))
        found = np.asarray(sample("ddpm", two_modes(), x_init, schedule.grid(4), key=key))
        for level, key_step in zip((3, 2, 1, 0), jax.random.split(key, 4), strict=True):
            noise = np.asarray(jax.random.normal(key_step, z.shape, z.dtype))
            x0_hat = np.asarray(two_modes()(z / np.sqrt(alpha_bars[level]), schedule.levels[level]))
            left = 1.0 - alpha_bars[level]
            mean = betas[level] * np.sqrt(before[level]) / left * x0_hat
            mean += np.sqrt(1.0 - betas[level]) * (1.0 - before[level]) / left * z
            z = mean + np.sqrt(betas[level] * (1.0 - before[level]) / left) * noise
    np.testing.assert_allclose(found, z, atol=1e-11)
    assert np.std(z) > 0.1


def ddpm_variance(width, sigmas, variance):
    """Variance that ancestral sampling ends with, under the exact denoiser of one Gaussian.

    That denoiser is linear, so that a Gaussian state stays one, with this recursion.
    """
    for sigma, sigma_next in zip(sigmas[:-1], sigmas[1:], strict=True):
        towards, share = width**2 / (width**2 + sigma**2), (sigma_next / sigma) ** 2
        kept = towards + share * (1.0 - towards)
        variance = kept**2 * variance + sigma_next**2 * (1.0 - share)
    return variance


DDPM_GRIDS = {
    "linear 1000": variance_preserving_linear(1000).grid(1000),
    "cosine 8": variance_preserving_cosine(8).grid(8),
    "cosine 8 in 4": variance_preserving_cosine(8).grid(4),
    "exploding 8": variance_exploding().grid(8),
}


@pytest.mark.parametrize("name", DDPM_GRIDS)
def test_ddpm_on_the_gaussian_oracle_has_the_variance_worked_out(name):
    mean, width, sigmas = 0.7, 0.3, DDPM_GRIDS[name]
    one = GaussianMixture([mean], width)
    key_init, key = jax.random.split(jax.random.key(11))
    x_init = np.float32(sigmas[0]) * jax.random.normal(key_init, (4000, 1))
    x = np.asarray(sample("ddpm", one.denoise, x_init, sigmas, key=key))
    assert x.mean() == pytest.approx(mean, abs=0.015)
    assert x.var() == pytest.approx(ddpm_variance(width, sigmas, sigmas[0] ** 2), rel=0.06)
    if len(sigmas) > 1000:  # then it is nearly that of the data, too
        assert x.var() == pytest.approx(width**2, rel=0.06)


@pytest.mark.parametrize(
    ("sampler", "order", "to_zero"),
    [("ddim", 1.0, True), ("ddim_vp", 1.0, True), ("euler", 1.0, True), ("heun", 2.0, True), ("heun", 2.0, False)],
)
def test_order_of_convergence_on_the_mixture_oracle(sampler, order, to_zero):
    # The grid t = linspace(0, 1, N) of Eq. 9. Its step from sigma_min to 0 answers with the
    # denoiser at sigma_min, in every sampler, so that the exact path is finished in this way too.
    # Without that step the grid ends at sigma_min, and Heun's last step is one of Euler's.
    mixture, x_init = GaussianMixture([-1.0, 1.0], 0.3), start(128)[:, 0]
    exact = mixture.flow(x_init, SCHEDULE.sigma_max, SCHEDULE.sigma_min)
    exact = mixture.denoise(exact, SCHEDULE.sigma_min) if to_zero else exact
    counts, errors = [64, 128, 256], []
    with jax.enable_x64(True):
        for num_steps in counts:
            sigmas = SCHEDULE.grid(num_steps)
            sigmas = sigmas if to_zero else sigmas[:-1]
            x = sample(sampler, two_modes(0.3), jnp.asarray(x_init), sigmas)
            errors.append(np.abs(np.asarray(x) - exact).mean())
    found = -np.polyfit(np.log(counts), np.log(errors), 1)[0]
    assert found == pytest.approx(order, abs=0.1)


@pytest.mark.parametrize(("num_steps", "unroll"), [(1, False), (3, True)])
@pytest.mark.parametrize("name", SAMPLERS)
def test_evaluations_are_as_many_as_promised(name, num_steps, unroll):
    levels = []

    def denoise(x_noisy, sigma):
        jax.debug.callback(lambda level: levels.append(float(level)), sigma)
        return 0.5 * x_noisy

    grid = SCHEDULE.grid(num_steps)
    walk = jax.jit(lambda x: sample(name, denoise, x, grid, key=jax.random.key(0), unroll=unroll))
    walk(jnp.ones((1, 2, 1))).block_until_ready()
    jax.effects_barrier()
    assert len(levels) == num_evaluations(name, num_steps)
    assert len(levels) == (2 * num_steps - 1 if name == "heun" else num_steps)
    np.testing.assert_allclose(sorted(set(levels)), grid[-2::-1], rtol=1e-6)  # and never at 0


def test_a_walk_in_the_scaled_state_is_the_walk_in_the_unscaled_one():
    """z = alpha x, and the denoiser of z looks at z / alpha at the level sigma / alpha."""
    schedule = variance_preserving_cosine(8)
    alphas, sigmas = schedule.scaled_grid(4)

    def scaled(z, sigma):
        alpha = jnp.sqrt(1.0 - sigma * sigma)
        return two_modes()(z / alpha, sigma / alpha)

    with jax.enable_x64(True):
        x_init = schedule.sigma_max * jnp.asarray(start() / 128.0)
        unscaled = np.asarray(sample("ddim", two_modes(), x_init, schedule.grid(4)))
        walked = np.asarray(sample("ddim", scaled, alphas[0] * x_init, sigmas, alphas=alphas))
        untold = np.asarray(sample("ddim", scaled, alphas[0] * x_init, sigmas))
    np.testing.assert_allclose(walked, unscaled, atol=1e-12)
    # Told of no scale, the same walk ends elsewhere.
    assert np.std(walked) > 0.5 and np.abs(untold - unscaled).max() > 0.03


@pytest.mark.parametrize(
    ("name", "sigmas", "settings", "message"),
    [
        ("hein", [1.0, 0.0], {}, "did you mean 'heun'"),
        ("ddpm", [1.0, 0.0], {}, "give it a key"),
        ("ddim", [1.0], {}, "sigmas"),
        ("ddim", [[1.0, 0.0]], {}, "sigmas"),
        ("heun", [1.0, 0.0], {"alphas": [0.5, 1.0]}, "alphas are for 'ddim' alone"),
        ("ddim", [1.0, 0.0], {"alphas": [0.5, 0.7, 1.0]}, "one for each of the 2"),
    ],
)
def test_what_cannot_be_sampled_is_refused(name, sigmas, settings, message):
    refused(message, sample, name, two_modes(), jnp.zeros((1, 1, 1)), sigmas, **settings)


@pytest.mark.parametrize("name", SAMPLERS)
@pytest.mark.parametrize("num_steps", [1, 3])
def test_the_walk_in_python_visits_what_the_scan_goes_through(name, num_steps):
    sigmas, x_init, key = SCHEDULE.grid(num_steps), jnp.asarray(start(16), jnp.float32), jax.random.key(4)
    visited = list(walk(name, two_modes(), x_init, sigmas, key=key))
    assert len(visited) == num_steps + 1 and visited[-1].x0_hat is None
    np.testing.assert_array_equal(visited[0].x_noisy, x_init)
    np.testing.assert_allclose([float(v.sigma) for v in visited], sigmas, rtol=1e-6)
    for here in visited[:-1]:
        np.testing.assert_array_equal(here.x0_hat, two_modes()(here.x_noisy, here.sigma))
    np.testing.assert_allclose(
        visited[-1].x_noisy, sample(name, two_modes(), x_init, sigmas, key=key), rtol=2e-5, atol=2e-5
    )


def test_probability_flow_follows_the_score():
    # dx/dsigma = -sigma * grad log p(x; sigma) (Karras et al. 2022, Eq. 3 with sigma(t) = t).
    mixture = GaussianMixture([-1.0, 1.0], 0.3)
    x, sigma = np.linspace(-4.0, 4.0, 17)[:, None], 0.6
    slope = probability_flow_slope(x, mixture.denoise(x, sigma), sigma)
    np.testing.assert_allclose(slope, -sigma * mixture.score(x, sigma), atol=1e-13)
    # And it is the slope of the path itself.
    step = 1e-4
    path = mixture.flow(x, sigma, sigma + step) - mixture.flow(x, sigma, sigma - step)
    np.testing.assert_allclose(slope, path / (2 * step), atol=1e-6)
