"""Each term of the loss against numbers worked out by hand (Eqs 10-14)."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from builders import CHANNELS, SKELETON, random_frames, straight_motion

from f3amd_lib.data.features import world_frames
from f3amd_lib.training.losses import LOSS_TERMS, loss_terms, total_loss
from f3amd_lib.training.recipe import LossWeights

FRAMES = 5


def standing(step=(0.0, 0.0, 0.0), first=(0.0, 0.0, 0.0)) -> jnp.ndarray:
    """A stiff figure at `first`, moved by `step` a frame, [1, T, C]."""
    frames = world_frames(straight_motion(FRAMES, (0.0, 0.0, 0.0)))
    frames[:, :3] = np.array(first) + np.arange(FRAMES)[:, None] * np.array(step)
    return jnp.asarray(frames[None], jnp.float32)


@functools.partial(jax.jit, static_argnames="form")
def _terms(x0_hat, x0, future_hat, future, last_history, form):
    return loss_terms(SKELETON, x0_hat, x0, future_hat, future, last_history, form)


def terms_of(future_hat, future, last_history=None, form="literal", x0_hat=None, x0=None):
    last_history = future[:, 0] if last_history is None else last_history
    x0_hat, x0 = (future_hat if x0_hat is None else x0_hat), (future if x0 is None else x0)
    terms = _terms(x0_hat, x0, future_hat, future, last_history, form)
    assert terms.keys() == set(LOSS_TERMS)
    return {name: float(value) for name, value in terms.items()}


def test_eq11_sample_by_hand():
    x0 = jnp.asarray(random_frames((2, FRAMES)), jnp.float32)
    terms = terms_of(standing(), standing(), x0_hat=x0 + 0.5, x0=x0)
    assert terms["sample"] == pytest.approx(0.25, rel=1e-4)
    # A constant offset has no velocity.
    assert terms["feature_velocity"] == pytest.approx(0.0, abs=1e-10)


def test_eq12_position_of_a_shifted_root_by_hand():
    terms = terms_of(standing(first=(0.1, 0.2, 0.2)), standing())
    assert terms["position"] == pytest.approx((0.01 + 0.04 + 0.04) / 3, rel=1e-4)
    assert terms["joint_velocity"] == pytest.approx(0.0, abs=1e-10)


def test_eq13_feature_velocity_by_hand():
    ramp = 0.1 * jnp.arange(FRAMES, dtype=jnp.float32)[None, :, None]
    x0 = jnp.zeros((1, FRAMES, CHANNELS))
    terms = terms_of(standing(), standing(), x0_hat=x0 + ramp, x0=x0)
    assert terms["feature_velocity"] == pytest.approx(0.01, rel=1e-4)


def test_eq13_joint_velocity_by_hand():
    terms = terms_of(standing(step=(0.02, 0.0, 0.0)), standing(step=(0.0, 0.0, 0.01)))
    assert terms["joint_velocity"] == pytest.approx((4e-4 + 1e-4) / 3, rel=1e-3)


@pytest.mark.parametrize(("reference_step", "counts"), [(0.0, 1), (0.009, 1), (0.011, 0), (0.05, 0)])
def test_appendix_b_foot_counts_only_where_the_reference_is_planted(reference_step, counts):
    moving = standing(step=(0.03, 0.0, 0.0))
    terms = terms_of(moving, standing(step=(reference_step, 0.0, 0.0)))
    assert terms["foot"] == pytest.approx(counts * 9e-4 / 3, rel=1e-3, abs=1e-12)


def test_floor_counts_toes_below_the_lowest_real_one_and_no_others():
    """Ours: 2 cm below for all toes and frames is 4e-4 square metres; above, or moved sideways, costs nothing."""
    lowered = lambda y: standing().at[..., 1].add(y)
    assert terms_of(lowered(-0.02), standing())["floor"] == pytest.approx(4e-4, rel=1e-3)
    assert terms_of(lowered(0.02), standing())["floor"] == 0.0
    assert terms_of(standing().at[..., 0].add(0.5), standing())["floor"] == pytest.approx(0.0, abs=1e-12)


def test_eq10_seam_of_three_centimetres_reads_three_centimetres():
    seam = standing(first=(0.03, 0.0, 0.0))
    before = standing()[:, -1]
    assert terms_of(seam, seam, before)["ird"] == pytest.approx(0.03, rel=1e-4)
    # A mean of lengths, not of squares, over the batch: 3 and 5 cm give 4.
    pair = jnp.concatenate([seam, standing(first=(0.0, 0.03, 0.04))])
    both = jnp.concatenate([before, before])
    assert terms_of(pair, pair, both)["ird"] == pytest.approx(0.04, rel=1e-4)


def test_eq10_reads_only_the_first_frame():
    later = standing().at[:, 1:, 0].add(7.0)
    assert terms_of(later, later, standing()[:, -1])["ird"] == pytest.approx(0.0, abs=2e-6)


def test_eq10_literal_form_asks_real_motion_to_stand_still():
    real = standing(step=(0.04, 0.0, 0.0), first=(0.04, 0.0, 0.0))
    assert terms_of(real, real, standing()[:, -1])["ird"] == pytest.approx(0.04, rel=1e-4)


def test_ird_excess_is_zero_for_the_real_step_and_its_lack_otherwise():
    real = standing(step=(0.04, 0.0, 0.0), first=(0.04, 0.0, 0.0))
    before = standing()[:, -1]
    assert terms_of(real, real, before, "excess")["ird"] == pytest.approx(0.0, abs=2e-6)
    stuck = standing()
    assert terms_of(stuck, real, before, "excess")["ird"] == pytest.approx(0.04, rel=1e-4)
    assert terms_of(stuck, real, before, "literal")["ird"] == pytest.approx(0.0, abs=2e-6)


@pytest.mark.parametrize("form", ["literal", "excess"])
@pytest.mark.parametrize("case", ["perfect", "zero 6D", "parallel columns"])
def test_gradients_are_finite(form, case):
    future = jnp.asarray(random_frames((2, FRAMES)), jnp.float32)
    at = {"perfect": future, "zero 6D": jnp.zeros_like(future), "parallel columns": jnp.ones_like(future)}[case]
    # In a perfect literal seam the distance itself is zero too.
    last_history = future[:, 0]

    def loss(future_hat):
        terms = loss_terms(SKELETON, future_hat, future, future_hat, future, last_history, form)
        return total_loss(terms, LossWeights())

    value, gradient = jax.jit(jax.value_and_grad(loss))(at)
    assert np.isfinite(value) and bool(jnp.all(jnp.isfinite(gradient)))
    if case != "perfect":
        assert float(jnp.abs(gradient).max()) > 0


def test_eq14_total_is_the_weighted_sum():
    terms = {name: 10.0**k for k, name in enumerate(LOSS_TERMS)}
    assert total_loss(terms, LossWeights()) == 1011111.0  # our term against sinking weighs nothing
    weights = LossWeights(sample=2, position=0, feature_velocity=3, joint_velocity=4, foot=0, floor=6, ird=5)
    assert total_loss(terms, weights) == 5604302.0


def test_section_4_5_all_weights_are_one_and_the_seam_literal():
    weights = LossWeights()
    assert {name: getattr(weights, name) for name in LOSS_TERMS} == dict.fromkeys(LOSS_TERMS, 1.0) | {"floor": 0.0}
    assert weights.ird_form == "literal"


def test_weights_count_samples_and_equal_ones_change_nothing():
    """Twice the weight of a sample is that sample twice, in every term: a term is linear in the weights."""
    hat, real = (jnp.asarray(random_frames((2, FRAMES), seed), jnp.float32) for seed in (0, 1))
    weighed = jax.jit(lambda weights: loss_terms(SKELETON, hat, real, hat, real, real[:, 0], weights=weights))
    once = terms_of(hat, real, real[:, 0])
    first, second, both, mixed = (
        weighed(jnp.array(weights)) for weights in ([2.0, 0], [0, 2.0], [1.0, 1.0], [1.5, 0.5])
    )
    for name, value in both.items():
        np.testing.assert_allclose(value, once[name], rtol=1e-5)
        np.testing.assert_allclose(mixed[name], 0.75 * first[name] + 0.25 * second[name], rtol=1e-5)
        assert value == 0.0 or abs(mixed[name] / value - 1.0) > 1e-4, name


def test_eq12_position_of_a_bent_hip_by_hand():
    # The left leg (joint 2) swings a quarter about +X: the toe goes from (0, -0.8, 0.1) to
    # (0, -0.1, -0.8) below the hip, off by (0, 0.7, -0.9); no other joint moves.
    bent = standing().at[..., 3 + 12 : 3 + 18].set(jnp.array([1.0, 0, 0, 0, 0, 1.0]))
    terms = terms_of(bent, standing())
    assert terms["position"] == pytest.approx((0.49 + 0.81) / (SKELETON.num_joints * 3), rel=1e-4)


def test_appendix_b_foot_looks_at_toes_only():
    # Swinging the spine and its tip moves no toe.
    swung = standing().at[:, 2:, 3 + 6 : 3 + 12].set(jnp.array([1.0, 0, 0, 0, 0, 1.0]))
    assert terms_of(swung, standing())["foot"] == pytest.approx(0.0, abs=1e-12)
