"""Exact denoisers: a mixture of Gaussians, of which everything that a network learns is known.

A sampler is best tested on a denoiser that makes no mistakes. Under the noise of Eq. 8 a mixture
stays a mixture, so its density, score, posterior mean and, in one dimension, the path of every
sample have closed forms.
"""

from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr

from f3amd_lib.ground.arrays import array_module, finite_array


@dataclass(frozen=True, eq=False)
class GaussianMixture:
    """K round Gaussians of one width, as a data distribution with an exact denoiser.

    Attributes:
      means: centres, [K, D]; a plain list of K numbers stands for D = 1.
      width: standard deviation of each, > 0, in the units of the data.
      weights: share of each, [K], made to sum to 1; equal by default.

    Raises:
      ValueError: for shapes that do not agree, or a width or weight that is not positive.
    """

    means: np.ndarray
    width: float
    weights: np.ndarray | None = None

    def __post_init__(self):
        means = np.array(self.means, dtype=np.float64)
        means = means[:, None] if means.ndim == 1 else means
        finite_array("means", means, ("mode", "dimension"))
        weights = np.ones(len(means)) if self.weights is None else np.array(self.weights, float)
        if weights.shape != (len(means),) or not (self.width > 0 and np.all(weights > 0)):
            given = f"width {self.width} and weights {self.weights!r}"
            raise ValueError(f"a mixture needs a positive width and {len(means)} positive weights, got {given}")
        object.__setattr__(self, "means", means)
        object.__setattr__(self, "weights", weights / weights.sum())

    def _responsibilities(self, x, sigma):
        """Return differences m_k - x [..., K, D], log weights of each mode [..., K], variance."""
        xp = array_module(x, sigma)
        means = xp.asarray(self.means, dtype=x.dtype)
        log_weights = xp.asarray(np.log(self.weights), dtype=x.dtype)
        # sigma broadcasts against x with its last axis kept: a scalar, or [..., 1].
        variance = xp.asarray(sigma, dtype=x.dtype) ** 2 + self.width**2
        difference = means - x[..., None, :]
        square = xp.sum(difference**2, axis=-1)
        spread = variance if xp.ndim(variance) == 0 else variance[..., 0][..., None]
        log_normal = -0.5 * square / spread - 0.5 * x.shape[-1] * xp.log(2 * np.pi * spread)
        return difference, log_weights + log_normal, variance

    def log_density(self, x, sigma=0.0):
        """Return log p(x; sigma), the density of data plus noise.

        Args:
          x: points, [..., D].
          sigma: noise level, a scalar or [..., 1].

        Returns:
          [...].
        """
        xp = array_module(x, sigma)
        _, log_joint, _ = self._responsibilities(x, sigma)
        highest = xp.max(log_joint, axis=-1, keepdims=True)
        return highest[..., 0] + xp.log(xp.sum(xp.exp(log_joint - highest), axis=-1))

    def score(self, x, sigma):
        """Return the gradient of `log_density` by x, [..., D]; arguments as there."""
        pull, variance = self._pull(x, sigma)
        return pull / variance

    def denoise(self, x, sigma):
        """Return the exact clean estimate E[x0 | x, sigma], which a square loss teaches a network.

        Args:
          x: noisy points x0 + sigma * noise, [..., D], numpy or JAX.
          sigma: noise level >= 0, a scalar or [..., 1].

        Returns:
          [..., D]. By Tweedie's formula it equals x + sigma^2 score(x, sigma).
        """
        pull, variance = self._pull(x, sigma)
        # The posterior of one Gaussian lies between its mean and x, by the ratio of variances.
        return x + (variance - self.width**2) / variance * pull

    def _pull(self, x, sigma):
        """Return the mean of the modes' differences m_k - x, each by how likely it is, [..., D], and the variance."""
        xp = array_module(x, sigma)
        difference, log_joint, variance = self._responsibilities(x, sigma)
        share = xp.exp(log_joint - xp.max(log_joint, axis=-1, keepdims=True))
        share = share / xp.sum(share, axis=-1, keepdims=True)
        return xp.sum(share[..., None] * difference, axis=-2), variance

    def sample(self, rng: np.random.Generator, num_samples: int) -> np.ndarray:
        """Draw clean samples, [num_samples, D], float64."""
        mode = rng.choice(len(self.means), size=num_samples, p=self.weights)
        noise = rng.standard_normal((num_samples, self.means.shape[1]))
        return self.means[mode] + self.width * noise

    def flow(self, x, sigma: float, sigma_next: float) -> np.ndarray:
        """Carry points along the probability-flow ODE without error (one dimension, numpy).

        On a line the flow keeps the order of points, so that a point stays at its quantile:
        F(x_next; sigma_next) = F(x; sigma), solved by bisection.

        Args:
          x: points, [..., 1], as they lie at `sigma`, within some 35 deviations of a mode (beyond,
            a tail's probability is too small for a float).
          sigma, sigma_next: noise levels, >= 0, in either order.

        Returns:
          Where the points lie at `sigma_next`, [..., 1], float64, good to about 1e-12.

        Raises:
          ValueError: if the mixture is not one-dimensional.
        """
        if self.means.shape[1] != 1:
            raise ValueError(f"flow needs D = 1, this mixture has D = {self.means.shape[1]}")
        x = np.asarray(x, dtype=np.float64)
        # Of the two tails the smaller is compared: near 1 a float has no digits left.
        below, above = self._tails(x, sigma)
        reach = 40.0 * np.hypot(self.width, sigma_next)
        low = np.full(x.shape, self.means.min() - reach)
        high = np.full(x.shape, self.means.max() + reach)
        for _ in range(120):
            middle = 0.5 * (low + high)
            below_here, above_here = self._tails(middle, sigma_next)
            too_low = np.where(below < above, below_here < below, above_here > above)
            low, high = np.where(too_low, middle, low), np.where(too_low, high, middle)
        return 0.5 * (low + high)

    def _tails(self, x, sigma):
        """Return the probability below and above x, [..., 1] each."""
        z = (x - self.means[:, 0]) / np.hypot(self.width, sigma)
        return [np.sum(self.weights * ndtr(side), axis=-1, keepdims=True) for side in (z, -z)]
