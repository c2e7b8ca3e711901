"""Noise levels: the variance-exploding grid of Eq. 9 and its other two names.

`sigma` is the standard deviation of the noise added to an unscaled signal (Eq. 8), `alpha_bar` the
share of signal power in the variance-preserving form of the same state (Appendix F), and
`log_snr = -2 log sigma`. They are one line with three labels. Here `t` in [0, 1] is schedule time:
0 is pure noise, 1 is almost clean, as in Eq. 9. Grids are worked out in float64 with numpy.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from f3amd_lib.motion.rotations import array_module

__all__ = [
    "VarianceExploding",
    "alpha_bar_from_sigma",
    "sigma_from_alpha_bar",
    "log_snr_from_sigma",
    "sigma_from_log_snr",
]


@dataclass(frozen=True)
class VarianceExploding:
    """The rho schedule of Eq. 9 (paper section 3.5; Karras et al. 2022, Eq. 5).

    Attributes:
      sigma_max, sigma_min: first and last noise level, in units of the (normalised) features.
      rho: curvature; larger values put more steps at low noise.

    Raises:
      ValueError: unless 0 < sigma_min < sigma_max and rho > 0, all finite.
    """

    sigma_max: float = 128.0
    sigma_min: float = 0.01
    rho: float = 3.0

    def __post_init__(self):
        if not (0.0 < self.sigma_min < self.sigma_max < np.inf and 0.0 < self.rho < np.inf):
            raise ValueError(
                "variance-exploding schedule needs 0 < sigma_min < sigma_max and rho > 0, "
                f"all finite; got sigma_min={self.sigma_min}, sigma_max={self.sigma_max}, "
                f"rho={self.rho}"
            )

    def sigma(self, t):
        """Return sigma(t) of Eq. 9.

        Args:
          t: schedule time in [0, 1], any shape; 0 gives sigma_max, 1 gives sigma_min.

        Returns:
          Noise levels of the same shape.
        """
        high, low = self.sigma_max ** (1.0 / self.rho), self.sigma_min ** (1.0 / self.rho)
        return (high + t * (low - high)) ** self.rho

    def time(self, sigma):
        """Return the schedule time t at which Eq. 9 gives `sigma` (its inverse)."""
        high, low = self.sigma_max ** (1.0 / self.rho), self.sigma_min ** (1.0 / self.rho)
        return (sigma ** (1.0 / self.rho) - high) / (low - high)

    def grid(self, num_steps: int, spacing: str = "endpoints") -> np.ndarray:
        """Return the noise levels that an N-step sampler visits, ending at 0.

        Args:
          num_steps: network evaluations N.
          spacing: "endpoints" takes t = linspace(0, 1, N), so that the last evaluation is at
            sigma_min (our reading: the paper does not say); "uniform" takes t = i / N.

        Returns:
          [N + 1] float64, falling, first sigma_max, last 0.

        Raises:
          ValueError: for num_steps < 1 or an unknown spacing.
        """
        if num_steps < 1:
            raise ValueError(f"a sampler needs at least 1 step, got num_steps={num_steps}")
        if spacing == "endpoints":
            t = np.linspace(0.0, 1.0, num_steps)
        elif spacing == "uniform":
            t = np.arange(num_steps) / num_steps
        else:
            raise ValueError(f"unknown spacing {spacing!r}: use 'endpoints' or 'uniform'")
        return np.append(self.sigma(t), 0.0)


def alpha_bar_from_sigma(sigma):
    """Return alpha_bar = 1 / (1 + sigma^2), any shape (Appendix F)."""
    return 1.0 / (1.0 + sigma * sigma)


def sigma_from_alpha_bar(alpha_bar):
    """Return sigma = sqrt((1 - alpha_bar) / alpha_bar), any shape (Appendix F, inverted)."""
    xp = array_module(alpha_bar)
    return xp.sqrt((1.0 - alpha_bar) / alpha_bar)


def log_snr_from_sigma(sigma):
    """Return the log signal-to-noise ratio, -2 log sigma, any shape."""
    xp = array_module(sigma)
    return -2.0 * xp.log(sigma)


def sigma_from_log_snr(log_snr):
    """Return sigma = exp(-log_snr / 2), any shape."""
    xp = array_module(log_snr)
    return xp.exp(-0.5 * log_snr)
