"""Motion whose every answer is known: a Gaussian over windows of positions, and one over frames of a number.

For Gaussian data the velocity of the flow is known exactly, under any control and after any frames. What is left is the
sampler: what it makes of exact answers is its own doing.
"""

from __future__ import annotations

import types
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np


@dataclass(frozen=True, eq=False)
class GaussianMotion:
    """A Gaussian with a mean, directions in which rows differ most, and a little of everything else.

    Attributes:
      mean: [N].
      directions, variances: [N, K], orthonormal, and [K].
      rest: variance in all other directions.
    """

    mean: np.ndarray
    directions: np.ndarray
    variances: np.ndarray
    rest: float

    @classmethod
    def of(cls, rows, kept: int) -> GaussianMotion:
        """Return the Gaussian of rows [M, N] with so many directions."""
        mean = rows.mean(axis=0)
        _, sizes, directions = np.linalg.svd(rows - mean, full_matrices=False)
        rest = (sizes[kept:] ** 2).sum() / (len(rows) * (rows.shape[1] - kept))
        return cls(mean, directions[:kept].T, sizes[:kept] ** 2 / len(rows), float(rest))

    def given(self, where, values, slack: float) -> GaussianMotion:
        """Return the Gaussian of rows whose numbers `where` have these values, but for a variance of `slack`."""
        seen = self.directions[where]
        spread = seen * self.variances
        gain = spread.T @ np.linalg.inv(spread @ seen.T + slack * np.eye(len(seen)))
        mean = self.mean + self.directions @ (gain @ (values - self.mean[where]))
        variances, turned = np.linalg.eigh(np.diag(self.variances) - gain @ spread)
        return GaussianMotion(mean, self.directions @ turned, np.maximum(variances, 1e-9), self.rest)

    def draw(self, generator: np.random.Generator) -> np.ndarray:
        """Return one row [N], without the little of everything else."""
        return self.mean + self.directions @ (np.sqrt(self.variances) * generator.normal(size=len(self.variances)))

    def velocity(self, state, t):
        """Return the exact velocity x0 - eps of states [B, ...] of N numbers each at time t (ACMDM Eq. 2)."""
        share = lambda variance: (t * variance - (1 - t)) / (t**2 * variance + (1 - t) ** 2)
        directions, variances = (jnp.asarray(one, jnp.float32) for one in (self.directions, self.variances))
        flat = state.reshape(len(state), -1) - t * jnp.asarray(self.mean, jnp.float32)
        along = flat @ directions
        moved = (along * (share(variances) - share(self.rest))) @ directions.T + flat * share(self.rest)
        return (jnp.asarray(self.mean, jnp.float32) + moved).reshape(state.shape)


class ExactFrames:
    """A Gaussian over L frames of one number, in the place of a network of ACMDM of any form (App. G).

    One formula serves all: a frame at time t is a measurement of that frame with variance ((1 - t) / t)^2, and a clean
    frame is one at time 1.

    Args:
      covariance: of the frames, [L, L]; their mean is 0.
      window, block_frames: of the form; the samplers ask for these.
      prefix: first frames that are clean, whatever time is told; the prefix form has one time for all frames.
    """

    def __init__(self, covariance, *, window: int | None = None, block_frames: int = 0, prefix: int = 0):
        self.covariance, self.prefix = jnp.asarray(covariance, jnp.float32), prefix
        window = window or len(covariance)
        self.config = types.SimpleNamespace(
            objective="v", window=window, block_frames=block_frames, num_joints=1, channels=1
        )

    def encode(self, condition):
        """Return the condition: there is no text."""
        return condition

    def remember(self, clean, context, past=None):
        """Return the clean frames so far, which is all that this network could keep of them."""
        return clean if past is None else jnp.concatenate([past, clean], axis=1)

    def __call__(self, state, time, context, *, past=None):
        """Return the exact velocity, [B, L, 1, 1]; time () or [B, L], alike for all samples; `past`: clean frames."""
        x = state[..., 0, 0]
        t = jnp.broadcast_to(time, x.shape)[0].at[: self.prefix].set(1.0)
        if past is not None:
            x, t = jnp.concatenate([past[..., 0, 0], x], axis=1), jnp.pad(t, (len(past[0]), 0), constant_values=1.0)
        t = jnp.clip(t, 1e-3, 1.0)
        mean, _ = measured(self.covariance[: len(t), : len(t)], x / t, jnp.maximum(((1 - t) / t) ** 2, 1e-5))
        velocity = (mean - x) / jnp.maximum(1 - t, 1e-3)
        return velocity[:, -state.shape[1] :, None, None]


def measured(covariance, values, noise):
    """Return mean [..., L] and covariance [L, L] of frames whose values were measured with variances `noise` [L]."""
    gain = jnp.linalg.solve(covariance + jnp.diag(noise), covariance).T
    return values @ gain.T, covariance - gain @ covariance


class ExactHidden(ExactFrames):
    """The masked form: frames that are hidden are denoised each by itself, given those that are known."""

    def look(self, state, hidden, context):
        """Return mean and variance of each frame, given the frames that are not hidden, [B, L] each."""
        noise, values = jnp.where(hidden, 1e6, 1e-5), jnp.where(hidden, 0.0, state[..., 0, 0])
        mean, covariance = jax.vmap(measured, in_axes=(None, 0, 0))(self.covariance, values, noise)
        return mean, jnp.diagonal(covariance, axis1=1, axis2=2)

    def __call__(self, state, time, context, *, past=None):
        """Return each frame's own exact velocity under what `look` saw."""
        mean, variance = context
        x, t = state[..., 0, 0], jnp.clip(time, 1e-3, 1.0)
        share = (t * variance - (1 - t)) / (t**2 * variance + (1 - t) ** 2)
        return (mean + share * (x - t * mean))[..., None, None]
