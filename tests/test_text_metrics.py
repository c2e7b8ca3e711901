"""Every metric of text to motion, by hand: what must be good is good, what must be bad is bad."""

import numpy as np
import pytest
from builders import refused

from f3amd_lib.measures import registry
from f3amd_lib.motion.skeleton import Skeleton
from f3amd_lib.text.judge import text_metrics

SKELETON = Skeleton(("Hips", "LeftToe", "RightToe"), (-1, 0, 0), [[0, 0, 0], [0.1, -0.9, 0], [-0.1, -0.9, 0]])


def embeddings(seed=0, groups=40, size=32, width=16):
    return np.random.default_rng(seed).normal(size=(groups, size, width))


# ---------------------------------------------------------------------------------- retrieval


def test_r_precision_of_an_oracle_and_of_guessing():
    text = embeddings()
    assert np.array_equal(text_metrics.r_precision(text, text), [1, 1, 1])
    guess = text_metrics.r_precision(text, embeddings(seed=1, groups=40))
    assert np.allclose(guess, np.arange(1, 4) / 32, atol=0.03)
    # Right motion under another caption, and a judge that sees nothing at all.
    assert text_metrics.r_precision(text, np.roll(text, 1, axis=1)).max() < 0.1
    assert np.array_equal(text_metrics.r_precision(0 * text, 0 * text), [0, 0, 0])
    refused("motion is not finite", text_metrics.r_precision, text, np.nan * text)


def test_r_precision_by_hand():
    text = np.array([[[0.0], [1.0], [10.0], [20.0]]])
    motion = np.array([[[0.0], [7.0], [9.5], [19.0]]])
    # The second text is nearer to the first motion (1) than to its own (6), and to no other.
    assert np.allclose(text_metrics.r_precision(text, motion), [3 / 4, 1, 1])


def test_groups_hold_no_pair_twice():
    pairs = np.repeat([f"pair {k}" for k in range(40)], np.random.default_rng(0).integers(1, 9, 40))
    groups = text_metrics.groups_of_unlike_pairs(pairs, np.random.default_rng(1))
    assert len(groups) >= 3 and len(np.unique(groups)) == groups.size
    assert all(len(set(pairs[group])) == 32 for group in groups)
    again = text_metrics.groups_of_unlike_pairs(pairs, np.random.default_rng(2))
    assert not np.array_equal(groups, again)
    with pytest.raises(ValueError, match="groups of 32 need as many pairs of content and style, got 5"):
        text_metrics.groups_of_unlike_pairs(["a", "b", "c", "d", "e"] * 9, np.random.default_rng(0))
    # Of a pair with several clips, any of them is taken.
    several = np.repeat(["a", "b", "c"], 6)
    taken = [set(text_metrics.groups_of_unlike_pairs(several[:14], np.random.default_rng(k), 3)[0]) for k in range(9)]
    assert len(set.union(*taken)) > 9


def test_matching_and_score():
    text = embeddings()
    assert text_metrics.matching_distance(text, text) == 0
    assert text_metrics.matching_distance(text, text + [3.0, 4.0, *[0.0] * 14]) == pytest.approx(5.0)
    assert text_metrics.clip_score(text, 7.0 * text) == pytest.approx(1.0)
    assert text_metrics.clip_score(text, -text) == pytest.approx(-1.0)
    assert abs(text_metrics.clip_score(text, embeddings(seed=1))) < 0.05


def test_diversity_of_a_cloud_and_of_a_point():
    generator = np.random.default_rng(0)
    cloud = generator.normal(size=(2000, 16))
    # Two draws of a normal distribution are sqrt(2) times a chi of 16 apart.
    assert text_metrics.embedding_diversity(cloud, generator) == pytest.approx(np.sqrt(2) * 3.937, rel=0.03)
    assert text_metrics.embedding_diversity(np.ones((50, 16)), generator) == 0
    assert text_metrics.embedding_diversity([[0.0], [3.0]], generator) == 3


def test_multimodality_looks_within_a_caption():
    generator = np.random.default_rng(0)
    far_apart = 100.0 * np.arange(5)[:, None, None] + np.zeros((5, 30, 4))
    assert text_metrics.multimodality(far_apart, generator) == 0  # many captions, one motion each
    # Of 30 samples at places 0 to 29, 10 pairs: mean |i - j| over all i and j, itself among them, is 899 / 90.
    line = np.arange(30.0)[None, :, None] + np.zeros((4, 30, 1))
    drawn = np.array([text_metrics.multimodality(line, generator) for _ in range(4000)])
    assert drawn.mean() == pytest.approx(899 / 90, abs=0.1)
    # All captions by one draw: the mean of four varies as that of one, not half as much.
    apart = np.abs(np.subtract(*generator.integers(0, 30, (2, 4000, 10)))).mean(axis=1)
    assert drawn.std() > 0.8 * apart.std()
    # Without replacement: both samples, each beside itself or the other.
    two = [text_metrics.multimodality([[[0.0], [3.0]]], generator) for _ in range(20)]
    assert set(two) == {0.0, 3.0}


# ------------------------------------------------------------------------------------- joints


def sliding(speed, height=0.02, frames=40, fps=20.0):
    """A rigid figure that moves over the ground, [L, 3, 3]."""
    pose = np.array([[0, 0.9, 0], [0.1, height, 0], [-0.1, height, 0]])
    return pose + (speed / fps * np.arange(frames))[:, None, None] * [0, 0, 1.0]


@pytest.mark.parametrize(
    "positions, ratio",
    [(sliding(1.0), 1.0), (sliding(0.4), 0.0), (sliding(1.0, height=0.06), 0.0), (sliding(0.0), 0.0)],
)
def test_skating_is_fast_and_low(positions, ratio):
    # The 5-step mean sees zeros beyond the ends, as in the released code: two steps at each end may drop out.
    assert text_metrics.foot_skating_ratio(SKELETON, positions) == pytest.approx(ratio, abs=0.06)


def test_control_errors_by_hand():
    wanted = np.zeros((2, 10, 3, 3))
    given = np.zeros((2, 10, 3), bool)
    given[0, [2, 5, 7, 9], 1] = True
    given[1, 5, 1] = True
    made = wanted + [0.0, 0.4, 0.0]  # everywhere, which is less than half a metre
    refused("not finite", text_metrics.control_errors, np.nan * wanted, wanted, given)
    refused("not finite", text_metrics.foot_skating_ratio, SKELETON, np.nan * wanted[0])
    exact = text_metrics.control_errors(wanted, wanted, given)
    assert set(exact.values()) == {0.0} and set(exact) <= set(registry.METRICS)
    near = text_metrics.control_errors(made, wanted, given)
    assert list(near.values()) == [0.0, 0.0, pytest.approx(0.4)]
    made[0, 5, 1] = [2.0, 0.0, 0.0]
    made[1, :, 0] = 99.0  # a joint that nobody asked for
    one_off = text_metrics.control_errors(made, wanted, given)
    # A clip counts once, whatever it was told: (1/4 + 0) / 2, not 1/5.
    assert one_off["control_trajectory_error"] == 0.5 and one_off["control_location_error"] == 1 / 8
    assert one_off["control_average_error"] == pytest.approx(((3 * 0.4 + 2.0) / 4 + 0.4) / 2)
