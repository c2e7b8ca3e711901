"""x0, eps, v and flow are four names of one line; a network of any of them on any schedule."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from builders import refused

from f3amd_lib.diffusion.flow import default_sampler, integrate, network_time, solve
from f3amd_lib.diffusion.oracles import GaussianMixture
from f3amd_lib.diffusion.predictions import OBJECTIVES, clean_estimate, guided, guided_twice, prediction_target
from f3amd_lib.diffusion.samplers import sample
from f3amd_lib.diffusion.schedules import (
    straight,
    variance_exploding,
    variance_preserving_betas,
    variance_preserving_cosine,
)

BETAS = variance_preserving_betas(50, 0.002, 0.4, power=1)
SCHEDULES = [straight(), BETAS, variance_preserving_cosine(8), variance_exploding()]
GAUSSIAN = GaussianMixture([0.7], 0.3)


def exact(objective, schedule):
    """`predict(state, time)` of a network without error for data of one Gaussian."""

    def predict(state, time):
        t = time if schedule.levels is None else 1.0 - (time + 1.0) / len(schedule.levels)
        alpha, sigma = schedule.alpha(t), schedule.sigma(t)
        # Mean of x0 given alpha x0 + sigma eps; regular where no signal is left.
        share = (state - alpha * 0.7) / (alpha**2 * 0.3**2 + sigma**2)
        return prediction_target(objective, 0.7 + alpha * 0.3**2 * share, sigma * share)

    return predict


@pytest.mark.parametrize("schedule", SCHEDULES)
def test_acmdm_eq01_and_eq02_every_objective_walks_the_same_line(schedule):
    objectives = [one for one in OBJECTIVES if one != "eps" or schedule.kind != "straight"]
    with jax.enable_x64(True):
        noise = jnp.asarray(np.random.default_rng(0).standard_normal((16, 1)))
        walk = lambda told, given: solve(exact(given, schedule), told, schedule, noise, sampler="ddim", num_steps=8)
        if schedule.kind == "straight":  # Euler's steps of the flow, by hand
            plain = noise
            for t in np.arange(8) / 8:
                plain = plain + exact("v", schedule)(plain, t) / 8
        else:
            sigmas = schedule.grid(8)
            plain = sample("ddim", GAUSSIAN.denoise, sigmas[0] * noise, sigmas)
        for objective in objectives:
            np.testing.assert_allclose(walk(objective, objective), plain, atol=1e-6)
        assert float(jnp.abs(walk("v", "eps") - plain).max()) > 0.1  # told wrongly


def test_acmdm_eq02_ddim_takes_eulers_steps_of_the_flow():
    noise = jax.random.normal(jax.random.key(0), (64, 1))
    velocity, state, times = exact("v", straight()), noise, np.linspace(0.0, 1.0, 11)
    for t, t_next in zip(times[:-1], times[1:], strict=True):
        state = state + (t_next - t) * velocity(state, t)
    walked = solve(velocity, "v", straight(), noise, sampler="ddim", num_steps=10)
    np.testing.assert_allclose(walked, state, atol=2e-6)


def test_one_step_along_the_true_velocity_is_exact():
    key_data, key_noise = jax.random.split(jax.random.key(1))
    x0, noise = jax.random.normal(key_data, (4, 6, 3, 3)), jax.random.normal(key_noise, (4, 6, 3, 3))
    walked = solve(lambda state, time: x0 - noise, "v", straight(), noise, sampler="ddim", num_steps=1)
    np.testing.assert_allclose(walked, x0, atol=1e-6)


@pytest.mark.slow
def test_dormand_and_prince_end_where_the_flow_ends():
    """The flow from a standard normal to one Gaussian keeps every point at its quantile."""
    noise, velocity = jnp.linspace(-2.0, 2.0, 9)[:, None], exact("v", straight())
    np.testing.assert_allclose(solve(velocity, "v", straight(), noise), 0.7 + 0.3 * noise, atol=2e-3)
    closer = integrate(velocity, noise, relative=1e-6, absolute=1e-8)
    np.testing.assert_allclose(closer, 0.7 + 0.3 * noise, atol=1e-5)
    backwards = integrate(lambda state, t: -velocity(state, t), noise)
    assert float(jnp.abs(backwards - (0.7 + 0.3 * noise)).max()) > 0.5


@pytest.mark.parametrize("schedule", SCHEDULES)
@pytest.mark.parametrize("objective", OBJECTIVES)
def test_a_clean_estimate_undoes_a_target(schedule, objective):
    with jax.enable_x64(True):
        rng = np.random.default_rng(0)
        x0, noise = (jnp.asarray(rng.standard_normal((5, 2, 3, 3))) for _ in range(2))
        t = schedule.draw_times(jax.random.key(2), (5, 1, 1, 1)).astype(jnp.float64)
        target = prediction_target(objective, x0, noise)
        state = schedule.perturb(x0, noise, t)
        estimate = clean_estimate(objective, target, state, schedule.alpha(t), schedule.sigma(t))
        np.testing.assert_allclose(estimate, x0, atol=1e-6)


def test_a_network_is_told_the_time_or_the_number_of_a_level():
    t = straight().draw_times(jax.random.key(0), (4000,))
    np.testing.assert_array_equal(network_time(straight(), t), t)
    np.testing.assert_allclose(np.quantile(t, [0.1, 0.5, 0.9]), [0.1, 0.5, 0.9], atol=0.03)
    lost = 1.0 - np.array([BETAS.alpha_bars[0], BETAS.alpha_bars[-1] / BETAS.alpha_bars[-2]])
    np.testing.assert_allclose(lost, [0.002, 0.4])
    told = np.asarray(network_time(BETAS, BETAS.draw_times(jax.random.key(1), (4000,))))
    np.testing.assert_allclose(told, np.rint(told), atol=1e-4)
    number, count = np.unique(np.rint(told), return_counts=True)
    np.testing.assert_array_equal(number, np.arange(50))
    assert count.min() > 40
    # What is told and what is done belong together: the level of that number.
    level = BETAS.level(BETAS.draw_times(jax.random.key(1), (4000,)))
    np.testing.assert_allclose(level, BETAS.levels[np.rint(told).astype(int)], rtol=1e-6)


def test_solvers_that_do_not_fit_are_refused():
    noise, nothing = jnp.zeros((1, 1)), lambda state, time: state
    assert default_sampler("v", straight()) == "dormand_prince"
    assert default_sampler("x0", straight()) == "ddim" and default_sampler("v", BETAS) == "ddpm"
    for objective, schedule, sampler, message in (
        ("x0", straight(), "dormand_prince", "follows v on the straight path, not 'x0'"),
        ("v", BETAS, "dormand_prince", "not 'v' on 'variance_preserving_betas'"),
        ("v", straight(), "dormandprince", "did you mean 'dormand_prince'"),
        ("v", straight(), "heun", "'ddim' alone"),
        ("eps", straight(), None, "predict 'x0' or 'v' there, not 'eps'"),
        ("x0", BETAS, None, "give it a key"),
        ("x", straight(), "ddim", "unknown objective 'x'"),
    ):
        refused(message, solve, nothing, objective, schedule, noise, sampler=sampler, num_steps=4)


def test_guidance_in_two_directions():
    full, first, second = (lambda x, sigma, value=value: value * x for value in (5.0, 3.0, 2.0))
    x = jnp.ones(3)
    np.testing.assert_allclose(guided_twice(full, first, second, 1.0, 1.0)(x, 1.0), 5.0)
    np.testing.assert_allclose(guided_twice(full, first, second, 2.5, 1.0)(x, 1.0), guided(full, first, 2.5)(x, 1.0))
    np.testing.assert_allclose(guided_twice(full, first, second, 2.5, 1.75)(x, 1.0), 5.0 + 1.5 * 2.0 + 0.75 * 3.0)
