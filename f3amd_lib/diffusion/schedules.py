"""Noise levels: the variance-exploding schedule of Eq. 9 and two variance-preserving ones.

`sigma` is the standard deviation of the noise added to an unscaled signal (Eq. 8), `alpha_bar` the
share of signal power in the variance-preserving form of the same state (Appendix F), and
`log_snr = -2 log sigma`. They are one line with three labels. Here `t` in [0, 1] is schedule time:
0 is pure noise, 1 is almost clean, as in Eq. 9. Grids are worked out in float64 with numpy.

A schedule says which noise levels are trained on and which a sampler visits. Each is a value with
the same few parts, and `sigma` is the language they all speak, so that networks and samplers need
not know which one they work under:

- `kind`: its name in a file;
- `sampler`: the name of the sampler that belongs to it;
- `sigma_max`: the largest noise level;
- `grid(num_steps, spacing)`: the levels that an N-step sampler visits;
- `draw(key, shape)`: random levels to train on.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from f3amd_lib.ground.arrays import array_module
from f3amd_lib.ground.names import nearest_hint, refuse_unknown


def _check_grid(num_steps: int, spacing: str) -> None:
    """Raise ValueError for a number of steps or a spacing that no schedule can serve."""
    if num_steps < 1:
        raise ValueError(f"a sampler needs at least 1 step, got num_steps={num_steps}")
    if spacing not in ("endpoints", "uniform"):
        raise ValueError(f"unknown spacing {spacing!r}: use 'endpoints' or 'uniform'")


@dataclass(frozen=True)
class VarianceExploding:
    """The rho schedule of Eq. 9 (paper section 3.5; Karras et al. 2022, Eq. 5).

    Attributes:
      kind: "variance_exploding".
      sigma_max, sigma_min: first and last noise level, in units of the (normalised) features.
      rho: curvature; larger values put more steps at low noise.

    Raises:
      ValueError: unless 0 < sigma_min < sigma_max and rho > 0, all finite.
    """

    sampler: ClassVar[str] = "ddim"
    """The paper pairs this schedule with DDIM, which adds no noise (sections 3.5 and 6)."""

    kind: str = field(default="variance_exploding", init=False, repr=False)
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
        _check_grid(num_steps, spacing)
        if spacing == "endpoints":
            t = np.linspace(0.0, 1.0, num_steps)
        else:
            t = np.arange(num_steps) / num_steps
        return np.append(self.sigma(t), 0.0)

    def draw(self, key, shape: tuple[int, ...]):
        """Draw noise levels to train on: t uniform in Eq. 9.

        Args:
          key: JAX random key.
          shape: of the answer, usually [B].

        Returns:
          sigma, float32.
        """
        return self.sigma(jax.random.uniform(key, shape, jnp.float32))


class _VariancePreserving:
    """What schedules of K discrete levels share: a subclass says only what `alpha_bars` is.

    Level k stands for diffusion time s = (k + 1) / K in (0, 1]; level 0 is the least noisy.
    Schedule time t runs the other way.
    """

    sampler: ClassVar[str] = "ddpm"
    """Ancestral DDPM: the paper names VP and DDPM together as what CAMDM uses (section 6)."""

    num_levels: int

    def _check(self, *rules: tuple[str, bool]) -> None:
        """Raise ValueError for the first (what is needed, whether it holds) that does not hold."""
        whole = type(self.num_levels) is int and self.num_levels >= 1
        for needed, holds in (("a whole num_levels of at least 1", whole), *rules):
            if not holds:
                raise ValueError(f"{self.kind} schedule needs {needed}, got {self}")
        # Training and sampling are float32, in which a level beyond 3e38 is infinite.
        sigmas = self.sigmas
        if not (0.0 < sigmas[0] and sigmas[-1] < np.finfo(np.float32).max):
            raise ValueError(
                f"{self} has noise levels from {sigmas[0]:g} to {sigmas[-1]:g}, but only positive "
                "ones that a float32 can hold are of use: make its betas less extreme"
            )

    @property
    def alpha_bars(self) -> np.ndarray:
        """Share of signal power at each level, falling, [K] float64."""
        raise NotImplementedError

    @property
    def betas(self) -> np.ndarray:
        """Share of signal power lost from one level to the next, [K] float64."""
        alpha_bars = self.alpha_bars
        return 1.0 - alpha_bars / np.append(1.0, alpha_bars[:-1])

    @property
    def sigmas(self) -> np.ndarray:
        """The levels as standard deviations of noise on an unscaled signal, rising, [K] float64."""
        with np.errstate(divide="ignore", over="ignore"):
            return sigma_from_alpha_bar(self.alpha_bars)

    @property
    def sigma_max(self) -> float:
        """The largest noise level."""
        return float(self.sigmas[-1])

    def grid(self, num_steps: int, spacing: str = "endpoints") -> np.ndarray:
        """Return the noise levels that an N-step sampler visits, ending at 0.

        With fewer steps than levels the schedule is respaced: the network sees only levels that it
        was trained on. The first is always the noisiest, also for N = 1, because a sampler starts
        from noise alone. Respacing rules in use for diffusion models count their strides from level
        0, and a single stride then ends where it starts: at the least noisy level, where the
        network would be told that pure noise is almost clean motion.

        Args:
          num_steps: network evaluations N, at most K; K of them visit every level.
          spacing: "endpoints" takes the levels linspace(K - 1, 0, N), so that the last evaluation
            is at the least noisy one; "uniform" takes those at s = 1 - i / N, whose last is higher.
            Both are rounded to whole levels.

        Returns:
          [N + 1] float64, falling, first sigma_max, last 0.

        Raises:
          ValueError: for num_steps outside 1 ... K or an unknown spacing.
        """
        _check_grid(num_steps, spacing)
        if num_steps > self.num_levels:
            raise ValueError(
                f"this schedule has {self.num_levels} noise levels and no more steps than that, "
                f"got num_steps={num_steps}: take fewer, or train with more levels"
            )
        last = 0.0 if spacing == "endpoints" else self.num_levels / num_steps - 1.0
        levels = np.rint(np.linspace(self.num_levels - 1.0, last, num_steps)).astype(int)
        return np.append(self.sigmas[levels], 0.0)

    def draw(self, key, shape: tuple[int, ...]):
        """Draw noise levels to train on: every level as likely as the next.

        Args:
          key: JAX random key.
          shape: of the answer, usually [B].

        Returns:
          sigma, float32.
        """
        levels = jax.random.randint(key, shape, 0, self.num_levels)
        return jnp.asarray(self.sigmas, jnp.float32)[levels]


@dataclass(frozen=True)
class VariancePreservingCosine(_VariancePreserving):
    """The cosine schedule of CAMDM, in K discrete levels (Nichol and Dhariwal 2021, Eq. 17).

    The signal power falls along cos^2((s + offset) / (1 + offset) pi / 2) with s = (k + 1) / K,
    but by no more than `max_beta` from one level to the next, so that some is left at the end.

    Attributes:
      kind: "variance_preserving_cosine".
      num_levels: K. The paper runs CAMDM with 8; the released configuration has 4.
      offset: keeps the first levels from being too small.
      max_beta: largest loss of signal power in one level.

    Raises:
      ValueError: unless num_levels >= 1 is whole, offset >= 0 and 0 < max_beta < 1.
    """

    kind: str = field(default="variance_preserving_cosine", init=False, repr=False)
    num_levels: int = 8
    offset: float = 0.008
    max_beta: float = 0.999

    def __post_init__(self):
        self._check(
            ("a finite offset of at least 0", 0.0 <= self.offset < np.inf),
            ("0 < max_beta < 1", 0.0 < self.max_beta < 1.0),
        )

    @property
    def alpha_bars(self) -> np.ndarray:
        """Share of signal power at each level, falling, [K] float64."""
        s = np.arange(self.num_levels + 1) / self.num_levels
        wanted = np.cos((s + self.offset) / (1.0 + self.offset) * np.pi / 2) ** 2
        return np.cumprod(np.maximum(wanted[1:] / wanted[:-1], 1.0 - self.max_beta))


@dataclass(frozen=True)
class VariancePreservingLinear(_VariancePreserving):
    """The VP diffusion with a linear beta, in K discrete levels (Song et al. 2021, Appendix C).

    A rate beta(s) = beta_min + s (beta_max - beta_min) leaves, at s = (k + 1) / K, the signal power
    alpha_bar(s) = exp(-beta_min s - (beta_max - beta_min) s^2 / 2).

    Attributes:
      kind: "variance_preserving_linear".
      num_levels: K.
      beta_min, beta_max: rate at s = 0 and at s = 1 (not a share of one level, which `betas` is).

    Raises:
      ValueError: unless num_levels >= 1 is whole, 0 < beta_min <= beta_max, and beta_max is small
        enough for a signal to be left at the last level.
    """

    kind: str = field(default="variance_preserving_linear", init=False, repr=False)
    num_levels: int = 1000
    beta_min: float = 0.1
    beta_max: float = 20.0

    def __post_init__(self):
        self._check(("0 < beta_min <= beta_max, finite", 0.0 < self.beta_min <= self.beta_max < np.inf))

    @property
    def alpha_bars(self) -> np.ndarray:
        """Share of signal power at each level, falling, [K] float64."""
        s = np.arange(1, self.num_levels + 1) / self.num_levels
        return np.exp(-self.beta_min * s - 0.5 * (self.beta_max - self.beta_min) * s**2)


NoiseSchedule = VarianceExploding | VariancePreservingCosine | VariancePreservingLinear
"""Any noise schedule, for annotations."""

SCHEDULES: dict[str, type] = {
    schedule.kind: schedule for schedule in (VarianceExploding, VariancePreservingCosine, VariancePreservingLinear)
}
"""Noise schedules by the name that they have in a file."""


def schedule_from_dict(values: Mapping) -> NoiseSchedule:
    """Build the noise schedule of which `dataclasses.asdict` made these values.

    Args:
      values: "kind", a name of `SCHEDULES`, and fields of that schedule; those that are missing
        take their defaults.

    Raises:
      ValueError: for a missing or unknown kind, an unknown field (with the nearest name), or values
        that the schedule refuses.
    """
    settings = dict(values)
    if "kind" not in settings:
        raise ValueError(f"a noise schedule needs a kind{nearest_hint('', SCHEDULES)}")
    kind = settings.pop("kind")
    if kind not in SCHEDULES:
        raise ValueError(f"unknown noise schedule {kind!r}{nearest_hint(kind, SCHEDULES)}")
    refuse_unknown(settings, SCHEDULES[kind], f"{kind} setting")
    for name, value in settings.items():
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            raise ValueError(f"{kind} setting {name!r} must be a number, got {value!r}")
    return SCHEDULES[kind](**settings)


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
