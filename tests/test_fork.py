"""The toy with a fork: its exact denoiser against brute force, its paths, what training gives."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from builders import evaluate
from flax import nnx

from f3amd_lib.diffusion import samplers
from f3amd_lib.diffusion.schedules import VarianceExploding, VariancePreservingCosine
from f3amd_lib.training import fork as toy
from f3amd_lib.training.fork import Fork

FORK = Fork()
SMALL = Fork(num_frames=8, num_modes=4)
EXPLODING, PRESERVING = VarianceExploding(), VariancePreservingCosine(8)


def real_paths(fork=FORK, count=4000, seed=0):
    paths, side = fork.draw(jax.random.key(seed), count)
    return np.asarray(paths, np.float64), np.asarray(side)


def noisy(paths, sigma, seed=1):
    return paths + sigma * np.random.default_rng(seed).standard_normal(paths.shape)


# ----------------------------------------------------------------------------------------- data


def test_real_paths_pass_on_the_side_that_they_are_drawn_for():
    paths, side = real_paths()
    assert set(side) == {1, 2} and 0.45 < np.mean(side == 1) < 0.55
    assert toy.outcome_shares(FORK, paths[side == 1])["left"] == 1.0
    assert toy.outcome_shares(FORK, paths[side == 2])["right"] == 1.0


def test_the_mean_of_all_paths_runs_straight_into_the_wall():
    paths, _ = real_paths()
    middle = np.mean(FORK.mean_paths, axis=0)
    np.testing.assert_allclose(middle[:, 0], 0.0, atol=1e-12)
    np.testing.assert_allclose(paths.mean(axis=0), middle, atol=0.06)
    assert toy.outcome_shares(FORK, middle[None])["wall"] == 1.0


def test_paths_scatter_about_their_mean_by_the_wobble_and_have_unit_size():
    paths, side = real_paths()
    apart = paths - FORK.mean_paths[side - 1]
    assert np.sqrt(np.mean(apart**2)) == pytest.approx(FORK.wobble, rel=0.02)
    assert paths.std() == pytest.approx(1.0, abs=0.1)  # so that metres are network units


def test_every_path_is_made_of_the_first_cosine_modes():
    paths, _ = real_paths(SMALL, 5)
    time = (np.arange(8) + 0.5) / 8
    modes = np.cos(np.pi * np.outer(np.arange(4), time))  # not normalised, written out
    residual = paths[..., 0].T - modes.T @ np.linalg.lstsq(modes.T, paths[..., 0].T, rcond=None)[0]
    assert np.abs(residual).max() < 1e-5


def test_branches_lie_farther_apart_the_more_frames_a_path_has():
    wider = dataclasses.replace(FORK, num_frames=4 * FORK.num_frames)
    left, right = FORK.mean_paths
    assert FORK.half_distance == pytest.approx(0.5 * np.sqrt(np.sum((left - right) ** 2)))
    assert wider.half_distance == pytest.approx(2 * FORK.half_distance, rel=0.03)


@pytest.mark.parametrize(
    "wrong, message",
    [
        ({"wall": 1.4}, "room on both sides"),
        ({"num_modes": 17}, "num_modes must be between"),
        ({"wobble": 0.0}, "wobble must be positive"),
        ({"side": float("nan")}, "side must be positive"),
    ],
)
def test_a_fork_that_cannot_be_is_refused(wrong, message):
    with pytest.raises(ValueError, match=message):
        Fork(**wrong)


# ------------------------------------------------------------------------------- exact denoiser


@pytest.mark.parametrize("sigma", [0.3, 2.0, 8.0])
def test_exact_denoiser_is_the_weighted_mean_over_many_real_paths(sigma):
    paths, side = real_paths(SMALL, 200_000)
    queries = noisy(paths[:3], sigma)
    answers = np.asarray(SMALL.denoise(queries, sigma, np.array([0, 0, side[2]])))
    for query, told, answer in zip(queries, (0, 0, side[2]), answers, strict=True):
        usable = paths if told == 0 else paths[side == told]
        log_weight = -0.5 * np.sum((usable - query) ** 2, axis=(1, 2)) / sigma**2
        weight = np.exp(log_weight - log_weight.max())
        expected = np.einsum("b,btc->tc", weight / weight.sum(), usable)
        np.testing.assert_allclose(answer, expected, atol=0.03)


def test_exact_denoiser_has_the_lowest_error_of_all():
    paths, _ = real_paths(FORK, 2000)
    x_noisy, told = noisy(paths, 2.5), np.zeros(2000, int)
    answer = np.asarray(FORK.denoise(x_noisy, 2.5, told))
    error = np.mean((answer - paths) ** 2)
    # The mean error of a mean is orthogonal to whatever one may add that depends on the input.
    for other in (0.9 * answer, answer + 0.05 * np.sign(answer), answer + 0.02 * x_noisy):
        assert np.mean((other - paths) ** 2) > error


def test_noise_levels_may_differ_from_path_to_path():
    paths, _ = real_paths(FORK, 3)
    levels, told = np.array([0.1, 2.0, 30.0]), np.array([0, 1, 2])
    together = FORK.denoise(paths, levels, told)
    for row in range(3):
        alone = FORK.denoise(paths[row : row + 1], levels[row], told[row : row + 1])
        np.testing.assert_allclose(together[row], alone[0], atol=1e-6)


def test_conditions_show_a_straight_path_or_the_side():
    condition = FORK.condition(np.array([0, 1, 2]))
    sideways = np.asarray(condition.path[:, :, 0])
    assert np.all(sideways[0] == 0) and np.all(sideways[1:].max(axis=1) != 0)
    np.testing.assert_allclose(condition.path[1:, :, :2], FORK.mean_paths, atol=1e-6)
    # The approach ends one pace before the path begins, and tells nothing.
    pace = condition.path[0, 1, 1] - condition.path[0, 0, 1]
    np.testing.assert_allclose(condition.path[0, 0, 1] - condition.history[0, -1, 1], pace, 1e-5)
    assert np.ptp(np.asarray(condition.history), axis=0).max() == 0


# ------------------------------------------------------------------------------------- outcomes


def test_crossings_are_interpolated_and_absent_where_nobody_arrives():
    crosses = [[0.0, -2.0], [1.0, -1.0], [2.0, 3.0], [5.0, 4.0]]
    again = [[0.0, -1.0], [-1.0, 1.0], [0.0, -1.0], [7.0, 1.0]]  # the first time counts
    stops = [[0.0, -2.0], [0.1, -1.0], [0.2, -0.5], [0.3, -0.1]]
    found = toy.crossing(np.array([crosses, again, stops]))
    np.testing.assert_allclose(found, [1.25, -0.5, np.nan])


def test_outcomes_are_counted_by_the_wall():
    at = np.array([0.0, 0.49, -0.49, 0.51, -0.51, -2.0])
    paths = np.stack([np.stack([at, at], -1), np.tile([-1.0, 1.0], (6, 1))], -1)
    paths = np.concatenate([paths, [[[0.0, -2.0], [0.0, -1.0]]]])
    shares = toy.outcome_shares(FORK, paths)
    expected = {"wall": 3 / 7, "left": 1 / 7, "right": 2 / 7, "short": 1 / 7}
    assert shares == pytest.approx(expected) and sum(shares.values()) == pytest.approx(1.0)


# ------------------------------------------------------------------------------------- sampling


@pytest.mark.parametrize("diffusion", [EXPLODING, PRESERVING], ids=["DDIM", "DDPM"])
def test_paths_are_sampled_as_the_librarys_sampler_does(diffusion):
    told, key = np.array([0, 0, 1, 2]), jax.random.key(3)
    found = toy.sample_paths(SMALL, diffusion, 4, told, key)
    key_init, key_steps = jax.random.split(key)
    sigmas = diffusion.grid(4)
    start = sigmas[0] * jax.random.normal(key_init, (4, 8, 2))
    expected = samplers.sample(
        diffusion.sampler, lambda x, sigma: SMALL.denoise(x, sigma, told), start, sigmas, key=key_steps
    )
    np.testing.assert_allclose(found, expected, atol=1e-4)


def test_exact_one_step_hits_the_wall_eight_choose_and_told_ones_need_no_choice():
    for diffusion in (EXPLODING, PRESERVING):
        table = toy.outcome_table(FORK, diffusion, (1, 8), num_samples=400).set_index(["steps", "told"])
        assert table.loc[(1, False), "wall"] == 1.0
        assert table.loc[(8, False), "wall"] < 0.06
        assert 0.4 < table.loc[(8, False), "left"] < 0.6
        assert (table.xs(True, level="told")["as_told"] == 1.0).all()
        assert np.isnan(table.loc[(1, False), "as_told"])


def test_a_second_step_at_the_lowest_level_changes_nothing():
    # The grid of Eq. 9 for N = 2 is 128, 0.01, 0: the second look comes when all is decided.
    told = np.zeros(300, int)
    one, two = (toy.sample_paths(FORK, EXPLODING, n, told, jax.random.key(0)) for n in (1, 2))
    assert np.abs(one - two).max() < 0.1
    assert toy.outcome_shares(FORK, two)["wall"] == 1.0


def test_exact_errors_follow_from_the_widths_where_the_side_is_known_or_lost():
    low, high = toy.error_table(FORK, (0.5, 1e4), num_samples=3000)["x0_error"]
    # Once the side is known, each of the modes is one Gaussian of known width.
    width = FORK.mixture.width
    share = FORK.num_modes / FORK.num_frames
    one_mode = np.sqrt(share * (width**-2 + 0.5**-2) ** -1)
    assert low == pytest.approx(one_mode, rel=0.02)
    numbers = 2 * FORK.num_frames
    everything = np.sqrt(FORK.half_distance**2 / numbers + share * width**2)
    assert high == pytest.approx(everything, rel=0.02)


# ------------------------------------------------------------------------------------- networks


@pytest.fixture(scope="module")
def trained():
    recipe = toy.fork_recipe(PRESERVING, 400, batch_size=16, learning_rate=8e-3)
    return toy.train_fork(SMALL, recipe, latent_width=8, depth=1)


def test_a_short_training_learns_the_mean_and_the_sides(trained):
    network, losses = trained
    assert losses.shape == (400,) and losses[-50:].mean() < 0.2 * losses[:5].mean()
    table = toy.outcome_table(network, PRESERVING, (1,), num_samples=200).set_index("told")
    assert table.loc[False, "wall"] > 0.95
    assert table.loc[True, "as_told"] > 0.95


def test_a_trained_network_comes_near_the_exact_error_and_not_below(trained):
    sigmas = PRESERVING.sigmas[[3, 5, 7]]
    mine = toy.error_table(trained[0], sigmas, num_samples=1000)["x0_error"]
    exact = toy.error_table(SMALL, sigmas, num_samples=1000)["x0_error"]
    assert (mine > 0.995 * exact).all() and (mine < 1.3 * exact + 0.1).all()


def test_training_is_the_same_twice_and_differs_by_seed_and_scaling(trained):
    recipe = toy.fork_recipe(PRESERVING, 400, batch_size=16, learning_rate=8e-3)
    settings = {"latent_width": 8, "depth": 1}
    _, again = toy.train_fork(SMALL, recipe, **settings)
    np.testing.assert_array_equal(trained[1], again)
    _, raw = toy.train_fork(SMALL, recipe, input_scaling=False, **settings)
    assert raw[0] > 100 * again[0]  # inputs of 160 meet weights made for 1
    other = dataclasses.replace(recipe, seed=1)
    assert toy.train_fork(SMALL, other, **settings)[1][0] != again[0]


def test_a_scaled_network_is_the_zoos_own_with_input_scaling(trained):
    network = trained[0]
    merged = nnx.merge(network.graph, network.params)
    assert not merged.config.input_scaling
    merged.config = dataclasses.replace(merged.config, input_scaling=True)
    x_noisy = 3.0 * jax.random.normal(jax.random.key(2), (3, 8, 2))
    told = np.array([0, 1, 2])
    expected = evaluate(merged, x_noisy, 3.0, SMALL.condition(told))
    found = jax.jit(lambda model: model.denoise(x_noisy, 3.0, told))
    np.testing.assert_allclose(found(network), expected, atol=1e-5)
    raw = dataclasses.replace(network, input_scaling=jnp.asarray(False))
    assert np.abs(found(raw) - expected).max() > 0.01


def test_a_training_that_diverges_says_so(trained, monkeypatch):
    monkeypatch.setattr(toy, "_train", lambda *a: (trained[0], np.array([1.0, 2.0, np.inf, np.nan])))
    recipe = toy.fork_recipe(PRESERVING, 400, batch_size=16, learning_rate=8e-3)
    with pytest.raises(ArithmeticError, match="at step 3: lower the learning rate 0.008"):
        toy.train_fork(SMALL, recipe, latent_width=8, depth=1)
