"""Distances of feature clouds, styles, diversity and intervals, against known answers."""

import numpy as np
import pytest
from builders import refused
from scipy.linalg import sqrtm
from scipy.optimize import linear_sum_assignment
from scipy.spatial.distance import cdist
from scipy.spatial.transform import Rotation

from f3amd_lib.measures import distributions as d


def cloud(count=50, dimensions=6, seed=0, shift=0.0):
    """Windows with correlated features, [count, dimensions]."""
    rng = np.random.default_rng(seed)
    mixing = np.random.default_rng(99).normal(size=(dimensions, dimensions))
    return rng.normal(size=(count, dimensions)) @ mixing + shift


def covariance_of(dimensions, seed, rank=None):
    rows = np.random.default_rng(seed).normal(size=(rank or dimensions + 3, dimensions))
    return rows.T @ rows


# -------------------------------------------------------------------------------------------- FID


def whitened(count, mean, covariance, seed=0):
    """A cloud with exactly this mean and covariance."""
    draws = np.random.default_rng(seed).normal(size=(count, len(mean)))
    draws -= draws.mean(axis=0)
    unit = draws @ np.linalg.inv(np.linalg.cholesky(np.cov(draws, rowvar=False)).T)
    return unit @ np.linalg.cholesky(covariance).T + mean


@pytest.mark.parametrize("dimensions", [2, 9, 24])
def test_fid_agrees_with_scipy_sqrtm(dimensions):
    mean, mean_ref = np.random.default_rng(1).normal(size=(2, dimensions))
    one, two = covariance_of(dimensions, 2), covariance_of(dimensions, 3)
    expected = np.sum((mean - mean_ref) ** 2) + np.trace(one + two - 2.0 * sqrtm(one @ two).real)
    answer = d.frechet_distance(whitened(60, mean, one), whitened(50, mean_ref, two, 1))
    assert answer == pytest.approx(expected, rel=1e-7)


def test_fid_of_flat_gaussians():
    """Covariances without full rank, as fewer windows than features have."""
    # Two thin clouds in 30 dimensions: scipy's root exists to about half of its digits.
    one, two = cloud(7, 30, 1), cloud(11, 30, 2)
    first, second = np.cov(one, rowvar=False), np.cov(two, rowvar=False)
    expected = np.sum((one.mean(0) - two.mean(0)) ** 2)
    expected += np.trace(first + second - 2.0 * sqrtm(first @ second + 1e-12 * np.eye(30)).real)
    assert d.frechet_distance(one, two) == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize("count", [3, 20, 200])
def test_fid_of_a_cloud_with_itself_is_zero(count):
    features = 100.0 * cloud(count, 20)
    again = features[np.random.default_rng(1).permutation(count)]
    assert 0.0 <= d.frechet_distance(features, features) < 1e-8
    assert 0.0 <= d.frechet_distance(features, again) < 1e-8


def test_fid_in_the_scale_of_camdm_has_a_name_of_its_own():
    one, two = cloud(30, 8, 1), cloud(30, 8, 2, shift=1.0)
    assert d.frechet_distance_per_dimension(one, two) == pytest.approx(d.frechet_distance(one, two) / 8)


# -------------------------------------------------------------------------------------------- EMD


@pytest.mark.parametrize("count", [60, 900])
def test_emd_agrees_with_scipy_linear_sum_assignment(count):
    one, two = cloud(count, 12, 1), cloud(count, 12, 2, shift=0.3)
    gaps = cdist(one, two)
    expected = gaps[linear_sum_assignment(gaps)].mean()
    assert d.earth_movers_distance(one, two) == pytest.approx(expected)


def test_emd_is_symmetric_and_follows_the_space():
    one, two = cloud(30, 3, 1), cloud(30, 3, 2)
    answer = d.earth_movers_distance(one, two)
    turn = Rotation.random(random_state=4).as_matrix()
    assert d.earth_movers_distance(two[::-1], one) == pytest.approx(answer)
    assert d.earth_movers_distance(one @ turn + 7.0, two @ turn + 7.0) == pytest.approx(answer)
    assert d.earth_movers_distance(3.0 * one, 3.0 * two) == pytest.approx(3.0 * answer)


def test_emd_sees_what_fid_cannot():
    """Equal mean and variance, unequal shape: -1, -1, 1, 1 against -sqrt 2, 0, 0, sqrt 2."""
    one = np.array([[-1.0], [-1.0], [1.0], [1.0]])
    two = np.sqrt(2.0) * np.array([[-1.0], [0.0], [0.0], [1.0]])
    assert d.frechet_distance(one, two) == pytest.approx(0.0, abs=1e-12)
    assert d.earth_movers_distance(one, two) == pytest.approx((np.sqrt(2.0) - 1.0 + 1.0) / 2.0)


def test_transport_that_was_not_solved_is_no_answer(monkeypatch):
    monkeypatch.setattr(d, "_MOST_PIVOTS", 3)
    with pytest.warns(UserWarning), pytest.raises(RuntimeError, match="not solved"):
        d.earth_movers_distance(cloud(50), cloud(50, seed=1))


def test_drawn_windows_are_windows_of_each_style_each_once():
    clouds = {"calm": np.arange(40.0).reshape(20, 2), "proud": 100.0 + np.arange(30.0).reshape(15, 2)}
    drawn = d.draw_per_style(clouds, 12, np.random.default_rng(3))
    assert drawn.shape == (24, 2) and len(np.unique(drawn, axis=0)) == 24
    assert {tuple(row) for row in drawn[:12]} <= {tuple(row) for row in clouds["calm"]}
    assert {tuple(row) for row in drawn[12:]} <= {tuple(row) for row in clouds["proud"]}
    np.testing.assert_array_equal(drawn, d.draw_per_style(clouds, 12, np.random.default_rng(3)))
    assert len(d.draw_per_style(clouds, 15, np.random.default_rng(3))) == 30
    refused("style 'proud' has 15 windows, 16 are needed", d.draw_per_style, clouds, 16, np.random.default_rng(3))


# ----------------------------------------------------------------------------------------- styles


def test_coverage_of_half_the_styles_is_half():
    target = np.full(4, 42)
    assert d.style_coverage([84, 84, 0, 0], target) == 50.0
    assert d.style_coverage(target, target) == 100.0
    assert d.style_coverage(np.zeros(4), target) == 0.0
    # By the formula: (10 + 20 + 5) / 60.
    assert d.style_coverage([10, 35, 5], [20, 20, 20]) == pytest.approx(100.0 * 35 / 60)


# -------------------------------------------------------------------------------------- diversity


def samples(seeds=6, frames=8, joints=5, seed=0):
    """Positions of several samples of one condition, [seeds, frames, joints, 3]."""
    return np.random.default_rng(seed).normal(size=(seeds, frames, joints, 3))


def test_diversity_of_one_joint_that_differs():
    """One of five joints is 3 cm to the left in one sample, to the right in the other."""
    positions = np.repeat(samples(1), 2, axis=0)
    positions[0, :, 4, 0] += 0.03
    positions[1, :, 4, 0] -= 0.03
    assert d.diversity_variance(positions) == pytest.approx(2 * 0.03**2 / 5)
    assert d.diversity(positions) == pytest.approx(100 * np.sqrt(2 * 0.03**2 / 5))


def test_diversity_of_noise_is_its_deviation():
    """Four joints with a deviation of 1 in three directions about a root of 0."""
    positions = samples(200, 20)
    positions[:, :, 0] = 0.0
    assert d.diversity(positions) == pytest.approx(100 * np.sqrt(3 * 4 / 5), rel=0.01)


def test_diversity_averages_variances_over_conditions():
    both = np.stack([samples(seed=1), 3.0 * samples(seed=2)])
    alone = [d.diversity_variance(each) for each in both]
    assert d.diversity_variance(both) == pytest.approx(np.mean(alone))
    # What differs between conditions is no diversity.
    same = np.repeat(samples(1), 4, axis=0)
    assert d.diversity(np.stack([same, 2.0 * same])) == pytest.approx(0.0, abs=1e-12)


# -------------------------------------------------------------------------------------- intervals


def test_interval_of_three_repeats():
    """Student's t for two degrees of freedom is 4.3027 at 95 %."""
    half = 4.30265 / np.sqrt(3)
    wanted = {"value": 2.0, "low": 2 - half, "high": 2 + half, "repeats": 3}
    assert d.mean_and_interval([1.0, 2.0, 3.0]) == pytest.approx(wanted, rel=1e-5)


# ----------------------------------------------------------------------------------------- errors

DISTANCES = [d.frechet_distance, d.frechet_distance_per_dimension, d.earth_movers_distance]


@pytest.mark.parametrize("distance", DISTANCES)
def test_clouds_that_are_none_are_refused(distance):
    good, broken = cloud(), cloud()
    broken[7, 3] = np.nan
    refused("features is not finite", distance, broken, good)
    refused("reference is not finite", distance, good, broken)
    refused("at least 2 windows each", distance, good[:1], good)
    refused(r"features must be \[window, feature\]", distance, good[0], good)
    refused("of the same classifier", distance, good, good[:, :5])
