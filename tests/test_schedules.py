"""Noise levels: Eq. 9, the variance-preserving levels, and the three names of one line."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from builders import refused

from f3amd_lib.diffusion import schedules
from f3amd_lib.diffusion.schedules import variance_exploding

# Cube roots 2 and 1: every level of this schedule can be worked out by hand.
HAND = schedules.variance_exploding(sigma_max=8.0, sigma_min=1.0, rho=3.0)

EACH = [make() for make in schedules.SCHEDULES.values()]


def betas(schedule):
    """Share of signal power lost from one of K levels to the next, [K]."""
    return 1.0 - schedule.alpha_bars / np.append(1.0, schedule.alpha_bars[:-1])


def test_eq09_end_points_are_the_papers():
    schedule = schedules.variance_exploding()
    assert schedule.sigma(0.0) == pytest.approx(128.0, rel=1e-14)
    assert schedule.sigma(1.0) == pytest.approx(0.01, rel=1e-12)


def test_eq09_uniform_spacing_by_hand():
    np.testing.assert_allclose(HAND.grid(4, "uniform"), [8.0, 1.75**3, 1.5**3, 1.25**3, 0.0], rtol=1e-14)


def test_eq09_training_draws_t_uniformly():
    schedule, key = schedules.variance_exploding(), jax.random.key(4)
    drawn = schedule.draw(key, (5, 3))
    np.testing.assert_array_equal(drawn, schedule.sigma(jax.random.uniform(key, (5, 3))))
    drawn = np.sort(schedule.draw(key, (10_000,)))[::-1]
    np.testing.assert_allclose(np.cbrt(drawn), np.cbrt(schedule.sigma(np.linspace(0.0, 1.0, 10_000))), atol=0.1)


def test_cosine_levels_are_camdms():
    """As its released configuration holds them (K = 4), and as its formula gives (K = 8)."""
    four, eight = (schedules.variance_preserving_cosine(count) for count in (4, 8))
    assert four.alpha_bars.dtype == np.float64
    np.testing.assert_allclose(betas(four), [0.152988, 0.416958, 0.707859, 0.999], rtol=0, atol=1e-6)
    np.testing.assert_allclose(four.alpha_bars, [0.847012, 0.493844, 0.144272, 0.000144], rtol=0, atol=1e-6)
    between = [0.957805, 0.684227, 0.304395, 0.037472]
    np.testing.assert_allclose(eight.alpha_bars[::2], between, rtol=0, atol=1e-6)
    np.testing.assert_allclose(eight.alpha_bars[1:-1:2], four.alpha_bars[:-1], rtol=0, atol=1e-6)


def test_linear_levels_by_hand():
    schedule = schedules.variance_preserving_linear(num_levels=2, beta_min=1.0, beta_max=3.0)
    # The rate 1 + 2 s integrates to s + s^2: 3/4 at s = 1/2, 2 at s = 1.
    np.testing.assert_allclose(schedule.alpha_bars, np.exp([-0.75, -2.0]), rtol=1e-14)
    np.testing.assert_allclose(betas(schedule), 1.0 - np.exp([-0.75, -1.25]), rtol=1e-14)
    np.testing.assert_allclose(schedule.levels, np.sqrt(np.expm1([0.75, 2.0])), rtol=1e-14)
    # Song et al.'s rates integrate to 10.05.
    assert schedules.variance_preserving_linear().sigma_max == pytest.approx(np.sqrt(np.expm1(10.05)))


# Facts of MotionPCM's teacher: 1,000 scaled-linear betas from 0.00085 to 0.012, read at every hundredth level.
TEACHER = [0.999150, 0.895463, 0.755238, 0.592183, 0.426086, 0.277670, 0.161753, 0.083128, 0.037195, 0.014299, 0.004660]


def test_betas_of_motionpcms_teacher():
    schedule = schedules.variance_preserving_betas()
    np.testing.assert_allclose(schedule.alpha_bars[[0, *range(99, 1000, 100)]], TEACHER, rtol=0, atol=6e-7)
    assert betas(schedule)[[0, -1]] == pytest.approx([0.00085, 0.012], rel=1e-9)
    # The first level is at t = 0.999, the last at t = 0.
    assert schedule.alpha(1.0 - 200 / 1000) == pytest.approx(0.86904, abs=6e-6)
    assert schedule.sigma(1.0 - 200 / 1000) == pytest.approx(0.49473, abs=6e-6)
    # Betas that are themselves linear are another schedule: DDPM's, of which 4e-5 of the power is left.
    linear = schedules.variance_preserving_betas(first=1e-4, last=0.02, power=1.0)
    np.testing.assert_allclose(betas(linear), np.linspace(1e-4, 0.02, 1000), rtol=1e-9)
    assert linear.alpha_bars[-1] == pytest.approx(4.04e-5, rel=1e-2)
    assert np.abs(linear.alpha_bars[99::100] - TEACHER[1:]).max() > 0.1


def test_the_straight_path_goes_evenly_from_noise_to_data():
    schedule, t = schedules.straight(), np.float64([0.0, 0.25, 1.0])
    np.testing.assert_array_equal(schedule.perturb(np.float64([8.0] * 3), np.float64([4.0] * 3), t), [4.0, 5.0, 8.0])
    for spacing in ("endpoints", "uniform"):  # at t = 1 there is nothing to ask a network
        np.testing.assert_array_equal(schedule.times(4, spacing), [0.0, 0.25, 0.5, 0.75])
    np.testing.assert_array_equal(schedule.grid(2), [np.inf, 1.0, 0.0])
    np.testing.assert_array_equal(schedule.scaled_grid(2), [[0.0, 0.5, 1.0], [1.0, 0.5, 0.0]])


@pytest.mark.parametrize("schedule", EACH, ids=lambda schedule: schedule.kind)
def test_every_schedule_goes_from_noise_to_data_in_one_language(schedule):
    rng = np.random.default_rng(0)
    x0, noise = rng.standard_normal((2, 3, 5))
    t = schedule.times(3)
    assert t[0] == 0.0 and np.all(np.diff(t) > 0) and t[-1] <= 1.0
    levels, (alphas, sigmas) = schedule.grid(3), schedule.scaled_grid(3)
    assert levels[0] == pytest.approx(schedule.sigma_max) and levels[-1] == 0.0 and np.all(np.diff(levels) < 0)
    assert alphas[-1] == 1.0 and sigmas[-1] == 0.0
    np.testing.assert_allclose(sigmas, alphas * np.where(alphas > 0, levels, 1.0) + (alphas == 0), rtol=1e-9)
    # Noisy data by the shares, in numpy and in JAX; the variance-preserving ones keep the power.
    z = schedule.perturb(x0, noise, t[:, None])
    np.testing.assert_allclose(z, alphas[:3, None] * x0 + sigmas[:3, None] * noise, rtol=1e-12)
    np.testing.assert_allclose(jax.jit(schedule.perturb)(x0, noise, jnp.asarray(t)[:, None]), z, rtol=1e-4, atol=1e-5)
    if schedule.alpha_bars is not None:
        np.testing.assert_allclose(alphas**2 + sigmas**2, 1.0, rtol=1e-12)
        assert schedule.alpha(1.0) == 1.0 and schedule.sigma(1.0) == 0.0


@pytest.mark.parametrize(
    ("num_steps", "spacing", "levels"),
    [
        (1, "endpoints", [7]),
        (4, "endpoints", [7, 5, 2, 0]),  # 7, 4.67, 2.33, 0
        (3, "uniform", [7, 4, 2]),  # 7, 4.33, 1.67
        (1, "leading", [0]),
        (3, "leading", [4, 2, 0]),
        (8, "leading", [7, 6, 5, 4, 3, 2, 1, 0]),
    ],
)
def test_respaced_grids_visit_levels_that_were_trained(num_steps, spacing, levels):
    schedule = schedules.variance_preserving_cosine(8)
    grid = schedule.grid(num_steps, spacing)
    assert grid.dtype == np.float64
    np.testing.assert_array_equal(grid, [*schedule.levels[levels], 0.0])


@pytest.mark.parametrize("schedule", EACH, ids=lambda schedule: schedule.kind)
def test_impossible_grids_are_refused(schedule):
    if schedule.levels is not None:
        refused(f"{len(schedule.levels)} noise levels", schedule.grid, len(schedule.levels) + 1)
    else:
        refused("'leading' counts levels", schedule.grid, 4, "leading")
    refused("num_steps=0", schedule.grid, 0)
    refused("'endpoint'.*'endpoints'", schedule.grid, 4, "endpoint")


@pytest.mark.parametrize(
    ("kind", "settings"),
    [  # As versions 0.2 and later wrote them beside weights.
        ("variance_exploding", {"sigma_max": 64.0, "sigma_min": 0.02, "rho": 7.0}),
        ("variance_preserving_betas", {"num_levels": 50, "first": 0.01, "last": 0.2, "power": 1.0}),
        ("straight", {}),
    ],
)
def test_schedules_go_through_json_and_come_back(kind, settings):
    schedule, values = getattr(schedules, kind)(**settings), {"kind": kind, **settings}
    assert schedule.to_dict() == values
    back = schedules.schedule_from_dict(json.loads(json.dumps(values)))
    assert back == schedule and hash(back) == hash(schedule) and repr(back) == repr(schedule)
    np.testing.assert_array_equal(back.grid(3), schedule.grid(3))
    # What is not said takes its default, and another setting is another schedule.
    default = schedules.schedule_from_dict({"kind": kind})
    assert default == schedules.SCHEDULES[kind]() and (default == schedule) == (not settings)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"sigma_max": 64.0}, "unknown noise schedule None.*variance_exploding"),
        ({"kind": "variance_preserving_cosin"}, "did you mean 'variance_preserving_cosine'"),
        ({"kind": "variance_preserving_cosine", "sigma_max": 64.0}, "unknown.*'sigma_max'"),
        ({"kind": "variance_exploding", "rho": "3"}, "'rho' must be a number"),
    ],
)
def test_descriptions_that_make_no_schedule_are_refused(values, message):
    refused(message, schedules.schedule_from_dict, values)


IMPOSSIBLE = {
    schedules.variance_exploding: [
        ("sigma_min", 0.0, -1.0, 128.0),
        ("sigma_max", 0.001, float("nan"), float("inf")),
        ("rho", 0.0, float("inf")),
    ],
    schedules.variance_preserving_cosine: [
        ("num_levels", 0, 4.0, True),
        ("offset", -0.1, float("inf")),
        ("max_beta", 0.0, 1.0, float("nan")),
    ],
    schedules.variance_preserving_linear: [("num_levels", -3), ("beta_min", 0.0, 21.0), ("beta_max", float("inf"))],
    schedules.variance_preserving_betas: [("num_levels", 0), ("first", 0.0, 0.5), ("last", 1.0), ("power", 0.0)],
}


@pytest.mark.parametrize("make", IMPOSSIBLE)
def test_impossible_schedules_are_refused(make):
    for name, *values in IMPOSSIBLE[make]:
        for value in values:
            refused(f"{make.__name__.replace('_exploding', '.exploding')}.*{name}", make, **{name: value})


def test_appendix_f_alpha_bar_by_hand():
    np.testing.assert_allclose(
        schedules.alpha_bar_from_sigma(np.array([0.0, 1.0, 2.0, 3.0])), [1.0, 0.5, 0.2, 0.1], rtol=1e-15
    )
    np.testing.assert_allclose(schedules.sigma_from_alpha_bar(np.array([0.5, 0.2, 1.0])), [1.0, 2.0, 0.0])


def test_each_of_a_few_levels_is_drawn_as_often_as_the_next():
    schedule = schedules.variance_preserving_cosine(4)
    drawn = np.asarray(schedule.draw(jax.random.key(0), (4000,)))
    shares = [np.isclose(drawn, level, rtol=1e-5).mean() for level in schedule.levels]
    assert shares == pytest.approx([0.25] * 4, abs=0.03)


def test_eq09_hand_values_of_a_three_step_grid():
    # t = 0, 1/2, 1: 2^3, 1.5^3, 1^3, then clean.
    np.testing.assert_allclose(HAND.grid(3), [8.0, 3.375, 1.0, 0.0], rtol=1e-14)
    # 128^(1/3) = 5.0396842, 0.01^(1/3) = 0.2154435; their mean cubed.
    np.testing.assert_allclose(variance_exploding().grid(3), [128.0, 2.62756385**3, 0.01, 0.0], rtol=1e-7)
