"""The training objective (paper section 4.1, Eq. 10; Appendix B, Eqs 11-14).

Every term is a mean over batch, frames and entries. Positions are in metres, features in network
units, or with `raw_features` in those of CAMDM's code. Weights are fields of `LossWeights`; the paper
sets them all to 1.
"""

import jax.numpy as jnp

from f3amd_lib.data.features import frame_positions
from f3amd_lib.motion.skeleton import CONTACT_SPEED, Skeleton
from f3amd_lib.training.recipe import LossWeights

LOSS_TERMS = ("sample", "position", "feature_velocity", "joint_velocity", "foot", "floor", "ird")


def _mean(values, weights):
    """Mean over everything, each sample (first axis) counted by its weight."""
    if weights is not None:
        values = values * weights.reshape(-1, *[1] * (values.ndim - 1))
    return jnp.mean(values)


def loss_terms(
    skeleton: Skeleton, x0_hat, x0, future_hat, future, last_history, ird_form: str = "literal", weights=None
) -> dict:
    """Return each term of the loss, unweighted.

    Args:
      skeleton: for forward kinematics.
      x0_hat, x0: prediction and target in the units that `sample` and `feature_velocity` compare, [B, T, C].
      future_hat, future: the same in metres and 6D numbers, [B, T, C].
      last_history: the frame before the window, metres and 6D numbers, [B, C].
      ird_form: see `LossWeights`.
      weights: what each sample counts, [B]; all alike by default.

    Returns:
      A dict of scalars, keyed by `LOSS_TERMS`:
        sample            E |x0_hat - x0|^2                             (Eq. 11)
        position          E |FK(x0_hat) - FK(x0)|^2                     (Eq. 12)
        feature_velocity  E |d x0_hat - d x0|^2                         (Eq. 13, first half)
        joint_velocity    E |d FK(x0_hat) - d FK(x0)|^2                 (Eq. 13, second half)
        foot              E |contact * d FK(x0_hat)_toes|^2             (Appendix B; contact where
                          the reference toe moves under 1 cm in a frame)
        floor             E max(lowest reference toe of the window - FK(x0_hat)_toes, 0)^2 along +Y
                          (ours)
        ird               E |FK(x0_hat)_first - FK(history)_last|       (Eq. 10), or another form

    Source: paper section 4.1 and Appendix B. CAMDM's released code, which the paper builds on, differs in
    three ways: it leaves the root's position out of the feature velocity, its contact mask looks at the
    toes' end joints where ours looks at the toe joints, which every skeleton here has, and it counts a step of exactly
    1 cm as contact. The F3AMD text says none of the three; ours is the plain reading of Eq. 13.
    """
    mean_square = lambda difference: _mean(difference * difference, weights)
    positions_hat = frame_positions(skeleton, future_hat)
    real = frame_positions(skeleton, jnp.concatenate([last_history[:, None], future], axis=1))
    before, positions = real[:, 0], real[:, 1:]
    step_hat = positions_hat[:, 1:] - positions_hat[:, :-1]
    step = positions[:, 1:] - positions[:, :-1]
    toes = jnp.array(skeleton.toes)
    contact = jnp.linalg.norm(step[:, :, toes], axis=-1) < CONTACT_SPEED
    floor = jnp.min(positions[:, :, toes, 1], axis=(1, 2), keepdims=True)
    below = jnp.maximum(floor - positions_hat[:, :, toes, 1], 0.0)
    seam = positions_hat[:, 0] - before
    if ird_form == "excess":
        seam = seam - (positions[:, 0] - before)
    jump = jnp.sum(seam * seam, axis=-1)  # under a root with a finite gradient at zero
    return {
        "sample": mean_square(x0_hat - x0),
        "position": mean_square(positions_hat - positions),
        "feature_velocity": mean_square((x0_hat[:, 1:] - x0_hat[:, :-1]) - (x0[:, 1:] - x0[:, :-1])),
        "joint_velocity": mean_square(step_hat - step),
        "foot": mean_square(step_hat[:, :, toes] * contact[..., None]),
        "floor": _mean(below * below, weights),
        "ird": _mean(jump if ird_form == "squared" else jnp.sqrt(jump + 1e-12), weights),
    }


def total_loss(terms: dict, weights: LossWeights):
    """Return the weighted sum of the terms (Eq. 14 plus lambda_IRD of section 4.1, and our floor)."""
    return sum(getattr(weights, name) * terms[name] for name in LOSS_TERMS)
