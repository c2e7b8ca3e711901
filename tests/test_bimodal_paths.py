"""The bimodal toy: its exact denoiser against brute force, its paths, and the ways past the wall in one step."""

import jax
import numpy as np
import pytest
from f3amd_notebooks import bimodal_paths as toy
from f3amd_notebooks.bimodal_paths import BimodalPaths

from f3amd_lib.diffusion.schedules import variance_exploding, variance_preserving_cosine

DATA = BimodalPaths()
SMALL = BimodalPaths(num_frames=8, num_modes=4)
EXPLODING, PRESERVING = variance_exploding(), variance_preserving_cosine(8)


def real_paths(data=DATA, count=4000, seed=0):
    paths, side = data.draw(jax.random.key(seed), count)
    return np.asarray(paths, np.float64), np.asarray(side)


def noisy(paths, sigma, seed=1):
    return paths + sigma * np.random.default_rng(seed).standard_normal(paths.shape)


# ----------------------------------------------------------------------------------------- data


def test_real_paths_pass_on_the_side_that_they_are_drawn_for():
    paths, side = real_paths()
    assert set(side) == {1, 2} and 0.45 < np.mean(side == 1) < 0.55
    assert toy.outcome_shares(DATA, paths[side == 1])["left"] == 1.0
    assert toy.outcome_shares(DATA, paths[side == 2])["right"] == 1.0


def test_the_mean_of_all_paths_runs_straight_into_the_wall():
    paths, _ = real_paths()
    middle = np.mean(DATA.mean_paths, axis=0)
    np.testing.assert_allclose(middle[:, 0], 0.0, atol=1e-12)
    np.testing.assert_allclose(paths.mean(axis=0), middle, atol=0.06)
    assert toy.outcome_shares(DATA, middle[None])["wall"] == 1.0


# ------------------------------------------------------------------------------- exact denoiser


@pytest.mark.slow
@pytest.mark.parametrize("sigma", [0.3, 2.0, 8.0])
def test_exact_denoiser_is_the_weighted_mean_over_many_real_paths(sigma):
    paths, side = real_paths(SMALL, 200_000)
    queries = noisy(paths[:3], sigma)
    answers = np.asarray(SMALL.denoise(queries, sigma, np.array([0, 0, side[2]])))
    for query, given, answer in zip(queries, (0, 0, side[2]), answers, strict=True):
        usable = paths if given == 0 else paths[side == given]
        log_weight = -0.5 * np.sum((usable - query) ** 2, axis=(1, 2)) / sigma**2
        weight = np.exp(log_weight - log_weight.max())
        expected = np.einsum("b,btc->tc", weight / weight.sum(), usable)
        np.testing.assert_allclose(answer, expected, atol=0.03)


# ------------------------------------------------------------------------------------- outcomes


def test_outcomes_are_counted_by_the_wall():
    at = np.array([0.0, 0.49, -0.49, 0.51, -0.51, -2.0])
    paths = np.stack([np.stack([at, at], -1), np.tile([-1.0, 1.0], (6, 1))], -1)
    paths = np.concatenate([paths, [[[0.0, -2.0], [0.0, -1.0]]]])
    shares = toy.outcome_shares(DATA, paths)
    expected = {"wall": 3 / 7, "left": 1 / 7, "right": 2 / 7, "short": 1 / 7}
    assert shares == pytest.approx(expected) and sum(shares.values()) == pytest.approx(1.0)


# ------------------------------------------------------------------------------------- sampling


def test_exact_one_step_hits_the_wall_eight_choose_and_a_given_side_needs_no_choice():
    for diffusion in (EXPLODING, PRESERVING):
        table = toy.outcome_table(DATA, diffusion, (1, 8), num_samples=400).set_index(["steps", "told"])
        assert table.loc[(1, False), "wall"] == 1.0
        assert table.loc[(8, False), "wall"] < 0.06
        assert 0.4 < table.loc[(8, False), "left"] < 0.6
        assert (table.xs(True, level="told")["as_told"] == 1.0).all()
        assert np.isnan(table.loc[(1, False), "as_told"])
