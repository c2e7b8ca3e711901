"""Phased consistency: where phases end, the jump to an end, and what a perfect student would do."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from builders import refused

from f3amd_lib.diffusion.oracles import GaussianMixture
from f3amd_lib.diffusion.schedules import variance_preserving_betas
from f3amd_lib.text.phases import (
    consistency_answer,
    consistency_scales,
    cut_phases,
    ddim_times,
    guided_noise,
    hinge,
    jump,
    latent_consistency_end,
    noise_travel,
    pseudo_huber,
    shares,
    target_end,
)

SCHEDULE = variance_preserving_betas()


def normal(seed, *shape):
    return jax.random.normal(jax.random.key(seed), shape)


def test_shares_are_those_of_the_published_schedule():
    alpha, sigma = shares(SCHEDULE, np.array([0, 499, 999]), np)
    np.testing.assert_allclose(alpha, [0.99957, 0.52694, 0.06826], atol=6e-6)
    np.testing.assert_allclose(sigma, [0.02915, 0.84990, 0.99767], atol=6e-6)


# --------------------------------------------------------------------------------------------------------------- phases


@pytest.mark.parametrize(
    "skip, ends",
    [
        (100, {1: [0], 2: [0, 499], 4: [0, 199, 499, 699]}),
        (50, {1: [0], 2: [0, 499], 4: [0, 249, 499, 749]}),
        (20, {1: [0], 2: [0, 499], 4: [0, 239, 499, 739]}),
    ],
)
def test_phases_end_where_they_should(skip, ends):
    for num_phases, wanted in ends.items():
        phases = cut_phases(1000, skip, num_phases)
        assert phases.edges.tolist() == [*wanted, 999] and phases.visited.tolist() == [999, *wanted[::-1]]
        assert len(phases.times) == 1000 // skip and phases.times[-1] == 999 and phases.before[0] == 0
        # Every point lies in its phase, the solver never leaves it, and only a phase's first point reaches its end.
        low, high = phases.edges[phases.phase], phases.edges[phases.phase + 1]
        assert (low < phases.times).all() and (phases.times <= high).all() and (low <= phases.before).all()
        assert ((phases.before == low) == phases.first).all() and phases.first.sum() == num_phases


def test_a_cut_that_makes_no_sense_is_refused():
    for skip, num_phases in ((30, 1), (100, 11), (100, 0), (0, 1)):
        refused("phases need a skip that divides", cut_phases, 1000, skip, num_phases)


# ----------------------------------------------------------------------------------------------------------------- jump


def test_motionpcm_eq08_a_jump_is_ddims_step_and_the_identity_at_its_own_end():
    """MotionPCM Eq. 10 is this jump, to the end of a phase."""
    state, eps, time = normal(0, 3, 4, 2), normal(1, 3, 4, 2), jnp.asarray([999, 499, 1])
    np.testing.assert_allclose(jump(SCHEDULE, state, eps, time, time), state, atol=2e-6)
    # It lands where one x0 and one noise say, whatever the noise: every point of the line jumps to the same end.
    x0, edge = normal(2, 3, 4, 2), jnp.asarray([499, 199, 0])
    on_line = lambda t: perturbed(x0, eps, t)
    np.testing.assert_allclose(jump(SCHEDULE, on_line(time), eps, time, edge), on_line(edge), atol=3e-5)
    with pytest.raises(AssertionError):
        np.testing.assert_allclose(jump(SCHEDULE, on_line(time), -eps, time, edge), on_line(edge), atol=3e-5)


def test_motionpcm_eq15_to_eq19_the_integral_of_a_jump_leads_where_ddim_does():
    """Lemma 1, with the integral of MotionPCM Eq. 8 taken in 20,000 pieces over the log of alpha / sigma."""
    state, eps = np.array([1.7, -0.4]), np.array([0.3, 1.1])
    for time, edge in ((999, 499), (499, 199), (99, 0)):
        (alpha, sigma), (alpha_next, sigma_next) = (shares(SCHEDULE, t, np) for t in (time, edge))
        lam = np.linspace(np.log(alpha / sigma), np.log(alpha_next / sigma_next), 20_001)
        integral = np.trapezoid(np.exp(-lam), lam)
        printed = lambda sign: alpha_next / alpha * state + sign * alpha_next * eps * integral  # noqa: B023
        ddim = alpha_next * (state - sigma * eps) / alpha + sigma_next * eps
        np.testing.assert_allclose(printed(-1), ddim, atol=1e-6)
        np.testing.assert_allclose(jump(SCHEDULE, state, eps, time, edge), ddim, atol=1e-12)
        assert np.abs(printed(1) - ddim).min() > 0.1


def perturbed(x0, eps, time):
    alpha, sigma = (share.reshape(-1, 1, 1) for share in shares(SCHEDULE, time))
    return alpha * x0 + sigma * eps


def test_motionpcm_eq11_no_guidance_is_the_condition_alone_and_noise_and_estimate_agree():
    e_c, e_null, state, w = normal(0, 4, 3), normal(1, 4, 3), normal(2, 4, 3), jnp.asarray([0.0, 1.0, 5.0, 15.0])
    eps = guided_noise(e_c, e_null, w)
    np.testing.assert_array_equal(eps[0], e_c[0])
    np.testing.assert_allclose(eps[2], 6 * e_c[2] - 5 * e_null[2], rtol=1e-5)
    time, end = jnp.full(4, 799), jnp.full(4, 699)
    both = [jump(SCHEDULE, state, e, time, end) for e in (e_c, e_null)]
    # Guiding states and guiding noise are one thing, since a jump is linear (Algorithm 1, line 9).
    np.testing.assert_allclose(jump(SCHEDULE, state, eps, time, end), guided_noise(*both, w), atol=2e-4)


def test_a_target_at_its_phases_end_is_the_identity_and_jumps_elsewhere():
    phases = cut_phases(1000, 100, 4)
    before, edge = jnp.asarray(phases.before), jnp.asarray(phases.edges[phases.phase])
    state, eps = normal(0, 10, 3), 1e3 * normal(1, 10, 3)
    end = target_end(SCHEDULE, state, eps, before, edge)
    np.testing.assert_array_equal(end[phases.first], state[phases.first])
    assert (np.abs(end - state)[~phases.first] > 1).any(axis=1).all()


def test_noise_travel_keeps_the_marginal():
    alpha_bar = SCHEDULE.alpha_bars
    for start, end in ((0, 0), (0, 499), (199, 499), (699, 999)):
        # Of a state at `start`, what is left of the data and how much noise there is at `end`.
        signal = noise_travel(SCHEDULE, jnp.float32(np.sqrt(alpha_bar[start]))[None], start, end, jnp.zeros(1))[0]
        fresh = noise_travel(SCHEDULE, jnp.zeros(1), start, end, jnp.ones(1))[0]
        kept = noise_travel(SCHEDULE, jnp.ones(1), start, end, jnp.zeros(1))[0]
        assert signal**2 == pytest.approx(alpha_bar[end], abs=1e-5)
        assert kept**2 * (1 - alpha_bar[start]) + fresh**2 == pytest.approx(1 - alpha_bar[end], abs=1e-5)


# --------------------------------------------------------------------------------------------------------------- losses


def test_motionpcm_eq12_the_loss_is_square_near_zero_and_straight_far_away():
    assert pseudo_huber(jnp.asarray(0.0), 0.5) == 0.0
    assert pseudo_huber(jnp.asarray(1e-2), 0.5) == pytest.approx(1e-4, rel=1e-2)
    assert pseudo_huber(jnp.asarray(-100.0), 0.5) == pytest.approx(99.5, rel=1e-4)


def test_motionpcm_eq13_the_discriminators_loss_is_2_at_0_and_0_at_the_margins():
    scores = jnp.zeros(5)
    assert hinge(scores, scores) == 2.0
    assert hinge(scores + 1, scores - 1) == hinge(scores + 7, scores - 3) == 0.0
    assert hinge(scores - 1, scores + 1) == 4.0  # what Eq. 13 prints would be 0 here


def test_motionpcm_eq09_latent_consistency_is_the_identity_at_time_0_and_the_clean_estimate_elsewhere():
    assert [float(x) for x in consistency_scales(0)] == [1.0, 0.0]
    c_skip, c_out = consistency_scales(1)
    assert (float(c_skip), float(c_out)) == pytest.approx((0.25 / 100.25, 10 / np.sqrt(100.25)))
    x0, eps, time = normal(0, 2, 3, 1), normal(1, 2, 3, 1), jnp.asarray([299, 699])
    end = latent_consistency_end(SCHEDULE, perturbed(x0, eps, time), eps, time)
    np.testing.assert_allclose(end, x0, atol=2e-5)


# ------------------------------------------------------------------------------------------------------------- sampling


def test_a_teachers_times_by_both_spacings():
    assert ddim_times(1000, 10).tolist() == [*range(999, 0, -100), 0]
    assert ddim_times(1000, 1).tolist() == [999, 0] and ddim_times(1000, 4).tolist() == [999, 749, 499, 249, 0]
    fifty = ddim_times(1000, 50, "leading")
    assert fifty[:2].tolist() == [981, 961] and fifty[-2:].tolist() == [1, 0]
    assert ddim_times(1000, 1, "leading").tolist() == [1, 0] and ddim_times(1000, 2, "leading").tolist() == [501, 1, 0]
    refused("did you mean 'leading'", ddim_times, 1000, 5, "leadin")
    refused("1 to 1000 steps", ddim_times, 1000, 0)


MIXTURE = GaussianMixture([-1.0, 0.5], 0.2, [0.3, 0.7])


def exact_noise(state, time):
    """The mixture's exact noise estimate of a VP state, JAX."""
    alpha, sigma = shares(SCHEDULE, time)
    return (state - alpha * MIXTURE.denoise(state / alpha, sigma / alpha)) / sigma


def exact_flow(state, time, time_next):
    """Where the mixture's flow carries VP states, numpy."""
    alpha, sigma = shares(SCHEDULE, np.array([time, time_next]), np)
    return alpha[1] * MIXTURE.flow(np.asarray(state, np.float64) / alpha[0], *(sigma / alpha))


def perfect_student(phases):
    """The noise that a perfectly distilled student answers: the one whose jump lands on the flow's own end."""

    def predict(state, time):
        time = int(time)
        edge = int(phases.edges[np.searchsorted(phases.edges, time, side="left") - 1])
        alpha, sigma = shares(SCHEDULE, np.array([time, edge]), np)
        end, state = exact_flow(state, time, edge), np.asarray(state, np.float64)
        # alpha' (z - sigma e) / alpha + sigma' e = end, solved for e.
        ratio = alpha[1] / alpha[0]
        return (end - ratio * state) / (sigma[1] - ratio * sigma[0])

    return predict


@pytest.mark.parametrize("num_phases", [1, 2, 4])
def test_a_perfect_student_walks_the_oracles_flow_from_edge_to_edge(num_phases):
    """And from anywhere in a phase it says the same end: what "consistent" means (MotionPCM Eqs 4 and 5)."""
    phases, noise = cut_phases(1000, 100, num_phases), np.asarray(normal(3, 64, 1), np.float64)
    student, state = perfect_student(phases), noise
    for time, edge in zip(phases.visited[:-1], phases.visited[1:], strict=True):
        state = jump(SCHEDULE, state, student(state, time), time, edge)
        np.testing.assert_allclose(state, exact_flow(noise, 999, edge), atol=1e-9)
    for time, number in zip(phases.times, phases.phase, strict=True):
        here, edge = exact_flow(noise, 999, time), int(phases.edges[number])
        end = jump(SCHEDULE, here, student(here, time), int(time), edge)
        np.testing.assert_allclose(end, exact_flow(noise, 999, edge), atol=1e-9)
    # The teacher's own estimate, jumping as far, does not.
    naive = jump(SCHEDULE, jnp.asarray(noise, jnp.float32), exact_noise(jnp.asarray(noise, jnp.float32), 999), 999, 0)
    assert np.abs(naive - exact_flow(noise, 999, 0)).mean() > 0.3


def test_a_perfect_target_answers_with_the_end_of_the_path_and_a_mean_does_not():
    """Exploding state, exact teacher: neighbours on a path have its end, whatever the level; at 0 it is reached."""
    mixture = GaussianMixture([-1.0, 0.6], 0.15, [0.4, 0.6])
    denoise = lambda x, sigma: jnp.asarray(mixture.denoise(np.asarray(x), np.asarray(sigma)[:, None]))
    end = end_at(mixture, jnp.zeros(4))
    sigma = jnp.array([3.0, 1.0, 0.3, 0.2])
    x = jnp.array([[2.0], [-0.7], [0.5], [0.4]])
    near = 0.98 * sigma
    wanted = end(x, sigma)
    np.testing.assert_allclose(consistency_answer(denoise, end, x, sigma, near), wanted, atol=0.01)
    mean = consistency_answer(denoise, denoise, x, sigma, near)
    assert jnp.abs(mean - wanted)[0] > 0.2
    # The last step of the walk is the end itself, and the target is not heard.
    nonsense = lambda x, sigma: jnp.full_like(x, 99.0)
    last = consistency_answer(denoise, nonsense, x, sigma, jnp.zeros(4))
    np.testing.assert_allclose(last, denoise(x, sigma), atol=1e-6)
    assert (consistency_answer(denoise, nonsense, x, sigma, near) == 99.0).all()
    # Inside a phase the answer is that whose straight line leads to where the path crosses the phase's end.
    edge = jnp.array([1.0, 0.5, 0.2, 0.1])
    answer = consistency_answer(denoise, end_at(mixture, edge), x, sigma, near, edge)
    kept = (edge / sigma)[:, None]
    crossing = flowed(mixture, x, sigma, edge)
    np.testing.assert_allclose(answer + kept * (x - answer), crossing, atol=0.01)
    assert np.abs(answer - wanted).max() > 0.1  # and that is not where the whole path ends
    last = consistency_answer(denoise, nonsense, x, sigma, edge, edge)
    np.testing.assert_allclose(last, denoise(x, sigma), atol=1e-5)


def flowed(mixture: GaussianMixture, x, sigma, edge):
    """Where the exact path of each row crosses a lower level, [B, ...]."""
    rows = zip(*map(np.asarray, (x, sigma, edge)), strict=True)
    return np.stack([mixture.flow(one[None], float(level), float(to))[0] for one, level, to in rows])


def end_at(mixture: GaussianMixture, edge):
    """A denoiser whose jump from (x, sigma) leads to where the exact path crosses the level of each row's edge."""

    def answer(x, sigma):
        kept = np.asarray(edge / sigma)[:, None]
        return jnp.asarray((flowed(mixture, x, sigma, edge) - kept * np.asarray(x)) / (1.0 - kept))

    return answer


def gaussian_noise(state, time, mean=0.3, variance=0.6):
    """The exact noise estimate of one Gaussian, numpy."""
    alpha, sigma = shares(SCHEDULE, time, np)
    return sigma * (state - alpha * mean) / (alpha**2 * variance + sigma**2)


@pytest.mark.parametrize("skip, wanted", [(100, 1.4150), (20, 1.5600)])
def test_jumps_through_a_gaussian_end_where_the_sheet_says(skip, wanted):
    phases, state = cut_phases(1000, skip), np.asarray(1.7)
    for time, before in zip(phases.times[::-1], phases.before[::-1], strict=True):
        state = jump(SCHEDULE, state, gaussian_noise(state, time), time, before)
    assert state == pytest.approx(wanted, abs=6e-5)
    # The exact flow keeps the quantile: 1.6024.
    spread = lambda t: np.sqrt(SCHEDULE.alpha_bars[t] * 0.6 + 1 - SCHEDULE.alpha_bars[t])
    alpha = np.sqrt(SCHEDULE.alpha_bars)
    exact = alpha[0] * 0.3 + (1.7 - alpha[999] * 0.3) * spread(0) / spread(999)
    assert exact == pytest.approx(1.6024, abs=5e-5) and abs(state - exact) > 1e-3
