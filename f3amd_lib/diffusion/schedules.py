"""Noise schedules: one value with a constructor for each kind, that of Eq. 9 among them.

Noisy data is `z_t = alpha(t) x0 + sigma(t) noise`. `t` in [0, 1] is schedule time: 0 is noise, 1 is clean or almost
so, as in Eq. 9. What networks and samplers hear of is the noise level `sigma / alpha`, the standard deviation of the
noise on an unscaled signal (Eq. 8): with it they need not know which schedule they work under. `alpha_bar` is the share
of signal power in the variance-preserving form of the same state (Appendix F), and `log_snr = -2 log level`. They are
one line with three labels. Grids are worked out in float64 with numpy.
"""

import inspect
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np

from f3amd_lib.ground.arrays import array_module, jax, jnp
from f3amd_lib.ground.names import check_known


@dataclass(frozen=True, repr=False)
class NoiseSchedule:
    """How much of the data is left at each time, and how much noise there is; made by the constructors below.

    Attributes:
      kind: name of its constructor, as files have it.
      settings: what that constructor was given, (name, value) pairs. Two schedules are equal if kind and settings are.
      sampler: name of the sampler that belongs to it.
      alpha, sigma: functions of schedule time, any shape: the signal's share, and the noise's standard deviation.
      sigma_min, sigma_max: lowest and highest noise level that is trained on.
      levels: K noise levels, rising, [K] float64, where the schedule has only these; None if it is continuous.
      alpha_bars: the signal's share of power at each of them, falling, [K] float64, or None.
    """

    kind: str
    settings: tuple[tuple[str, float], ...]
    sampler: str = field(compare=False)
    alpha: Callable = field(compare=False)
    sigma: Callable = field(compare=False)
    sigma_min: float = field(compare=False)
    sigma_max: float = field(compare=False)
    levels: np.ndarray | None = field(default=None, compare=False)
    alpha_bars: np.ndarray | None = field(default=None, compare=False)

    def __repr__(self) -> str:
        return f"{self.kind}({', '.join(f'{name}={value}' for name, value in self.settings)})"

    def to_dict(self) -> dict:
        """Return kind and settings as JSON-ready values, for `schedule_from_dict`."""
        return {"kind": self.kind, **dict(self.settings)}

    def perturb(self, x0, noise, t):
        """Return z_t = alpha(t) x0 + sigma(t) noise; t broadcasts against x0."""
        return self.alpha(t) * x0 + self.sigma(t) * noise

    def times(self, num_steps: int, spacing: str = "endpoints") -> np.ndarray:
        """Return the times at which an N-step sampler evaluates the network.

        With fewer steps than levels a schedule of K levels is respaced: the network sees only levels that it
        was trained on. The first is the noisiest, also for N = 1, because a sampler starts from noise alone.
        "leading" is the exception: a respacing rule in use for diffusion models, whose strides count from level
        0. A single stride then ends where it starts: at the least noisy level, where the network sees pure
        noise labelled as almost clean motion.

        Args:
          num_steps: network evaluations N; at most K where there are K levels.
          spacing: "endpoints" takes t = linspace(0, 1, N), so that the last evaluation is at the lowest level (our
            reading: the paper does not say); "uniform" takes t = i / N, whose last is higher. K levels are
            counted alike, and rounded to whole ones. Where no noise is left at t = 1, both are "uniform".
            "leading" takes every (K // N)-th of K levels, counted from the least noisy one.

        Returns:
          [N] float64, rising from 0.

        Raises:
          ValueError: for num_steps outside 1 ... K, an unknown spacing, or "leading" without levels to count.
        """
        if num_steps < 1:
            raise ValueError(f"a sampler needs at least 1 step, got num_steps={num_steps}")
        check_known(spacing, ("endpoints", "uniform", "leading"), "spacing")
        if spacing == "leading" and self.levels is None:
            raise ValueError(f"spacing 'leading' counts levels, and {self.kind} is continuous: use 'endpoints'")
        if self.levels is None:
            to_the_end = spacing == "endpoints" and self.sigma_min > 0.0
            return np.linspace(0.0, 1.0, num_steps) if to_the_end else np.arange(num_steps) / num_steps
        num_levels = len(self.levels)
        if num_steps > num_levels:
            raise ValueError(
                f"this schedule has {num_levels} noise levels and no more steps than that, "
                f"got num_steps={num_steps}: take fewer, or train with more levels"
            )
        last = num_levels / num_steps - 1.0 if spacing == "uniform" else 0.0
        first = num_levels // num_steps * (num_steps - 1.0) if spacing == "leading" else num_levels - 1.0
        return 1.0 - (np.rint(np.linspace(first, last, num_steps)) + 1.0) / num_levels

    def grid(self, num_steps: int, spacing: str = "endpoints") -> np.ndarray:
        """Return the noise levels at `times`, then 0: what a sampler of the variance-exploding state visits.

        Returns:
          [N + 1] float64, falling, last 0; first sigma_max, but for "leading".

        Raises:
          ValueError: as `times`.
        """
        with np.errstate(divide="ignore"):  # the straight path begins at an infinite level
            return np.append(self.level(self.times(num_steps, spacing)), 0.0)

    def scaled_grid(self, num_steps: int) -> tuple[np.ndarray, np.ndarray]:
        """Return (alphas, sigmas) at `times`, then (1, 0), each [N + 1]: what a sampler of z_t itself visits."""
        t = self.times(num_steps)
        return np.append(self.alpha(t), 1.0), np.append(self.sigma(t), 0.0)

    def level(self, t):
        """Return the noise level sigma(t) / alpha(t), any shape; of K levels the one that t stands for."""
        if self.levels is None:
            return self.sigma(t) / self.alpha(t)
        return array_module(t).asarray(self.levels)[_rank(t, len(self.levels)) - 1]

    def draw_times(self, key, shape: tuple[int, ...]):
        """Draw times to train on, float32: t uniform in [0, 1), or every one of K levels as likely as the next."""
        if self.levels is None:
            return jax.random.uniform(key, shape, jnp.float32)
        num_levels = len(self.levels)
        return 1.0 - (jax.random.randint(key, shape, 0, num_levels) + jnp.float32(1)) / num_levels

    def draw(self, key, shape: tuple[int, ...]):
        """Draw noise levels to train on, float32, at times of `draw_times`."""
        return self.level(self.draw_times(key, shape)).astype(jnp.float32)


def variance_exploding(sigma_max: float = 128.0, sigma_min: float = 0.01, rho: float = 3.0) -> NoiseSchedule:
    """Return the rho schedule of Eq. 9 (section 3.5; Karras et al. 2022, Eq. 5): all signal, and noise to drown it.

    The paper pairs it with DDIM, which adds no noise (sections 3.5 and 6).

    Args:
      sigma_max, sigma_min: first and last noise level, in units of the (normalised) features.
      rho: curvature; larger values put more steps at low noise.

    Raises:
      ValueError: unless 0 < sigma_min < sigma_max and rho > 0, all finite.
    """
    if not (0.0 < sigma_min < sigma_max < np.inf and 0.0 < rho < np.inf):
        raise ValueError(
            "variance-exploding schedule needs 0 < sigma_min < sigma_max and rho > 0, "
            f"all finite; got sigma_min={sigma_min}, sigma_max={sigma_max}, rho={rho}"
        )
    high, low = sigma_max ** (1.0 / rho), sigma_min ** (1.0 / rho)
    return NoiseSchedule(
        "variance_exploding", (("sigma_max", sigma_max), ("sigma_min", sigma_min), ("rho", rho)), sampler="ddim",
        alpha=lambda t: array_module(t).ones_like(t), sigma=lambda t: (high + t * (low - high)) ** rho,
        sigma_min=sigma_min, sigma_max=sigma_max,
    )  # fmt: skip


def straight() -> NoiseSchedule:
    """Return the straight path of flow matching: alpha = t and sigma = 1 - t (Liu et al. 2023; Lipman et al. 2023).

    It is ACMDM Eq. 2, whose t is our 1 - t. At t = 0 nothing is left of the data, the level is infinite, and a sampler
    walks in z_t itself (`scaled_grid`).
    """
    return NoiseSchedule(
        "straight", (), sampler="ddim", alpha=lambda t: t, sigma=lambda t: 1.0 - t, sigma_min=0.0, sigma_max=np.inf
    )


def variance_preserving_cosine(num_levels: int = 8, offset: float = 0.008, max_beta: float = 0.999) -> NoiseSchedule:
    """Return the cosine schedule of CAMDM, in K discrete levels (Nichol and Dhariwal 2021, Eq. 17).

    The signal power falls along cos^2((s + offset) / (1 + offset) pi / 2) with s = (k + 1) / K,
    but by no more than `max_beta` from one level to the next, so that some is left at the end.

    Args:
      num_levels: K. The paper runs CAMDM with 8; the released configuration has 4.
      offset: keeps the first levels from being too small.
      max_beta: largest loss of signal power in one level.

    Raises:
      ValueError: unless num_levels >= 1 is whole, offset >= 0 and 0 < max_beta < 1.
    """

    def alpha_bars():
        s = np.arange(num_levels + 1) / num_levels
        wanted = np.cos((s + offset) / (1.0 + offset) * np.pi / 2) ** 2
        return np.cumprod(np.maximum(wanted[1:] / wanted[:-1], 1.0 - max_beta))

    return _variance_preserving(
        "variance_preserving_cosine", {"num_levels": num_levels, "offset": offset, "max_beta": max_beta}, alpha_bars,
        ("a finite offset of at least 0", 0.0 <= offset < np.inf), ("0 < max_beta < 1", 0.0 < max_beta < 1.0),
    )  # fmt: skip


def variance_preserving_linear(num_levels: int = 1000, beta_min: float = 0.1, beta_max: float = 20.0) -> NoiseSchedule:
    """Return the VP diffusion with a linear rate, in K discrete levels (Song et al. 2021, Appendix C).

    A rate beta(s) = beta_min + s (beta_max - beta_min) leaves, at s = (k + 1) / K, the signal power
    alpha_bar(s) = exp(-beta_min s - (beta_max - beta_min) s^2 / 2).

    Args:
      num_levels: K.
      beta_min, beta_max: rate at s = 0 and at s = 1 (not a share of one level).

    Raises:
      ValueError: unless num_levels >= 1 is whole and 0 < beta_min <= beta_max.
    """

    def alpha_bars():
        s = np.arange(1, num_levels + 1) / num_levels
        return np.exp(-beta_min * s - 0.5 * (beta_max - beta_min) * s**2)

    return _variance_preserving(
        "variance_preserving_linear", {"num_levels": num_levels, "beta_min": beta_min, "beta_max": beta_max},
        alpha_bars, ("0 < beta_min <= beta_max, finite", 0.0 < beta_min <= beta_max < np.inf),
    )  # fmt: skip


def variance_preserving_betas(
    num_levels: int = 1000, first: float = 0.00085, last: float = 0.012, power: float = 2.0
) -> NoiseSchedule:
    """Return the VP schedule whose betas, to the power of 1 / `power`, rise evenly from level to level.

    Power 2 is called scaled-linear (Rombach et al. 2022, whose numbers are the defaults and MotionPCM's teacher's);
    power 1 is the linear schedule of DDPM (Ho et al. 2020: 1e-4 to 0.02).

    Args:
      num_levels: K.
      first, last: share of signal power lost in the first and in the last level.
      power: see above.

    Raises:
      ValueError: unless num_levels >= 1 is whole, 0 < first <= last < 1 and power is positive.
    """

    def alpha_bars():
        return np.cumprod(1.0 - np.linspace(first ** (1.0 / power), last ** (1.0 / power), num_levels) ** power)

    return _variance_preserving(
        "variance_preserving_betas", {"num_levels": num_levels, "first": first, "last": last, "power": power},
        alpha_bars, ("0 < first <= last < 1", 0.0 < first <= last < 1.0),
        ("a positive finite power", 0.0 < power < np.inf),
    )  # fmt: skip


def _variance_preserving(
    kind: str, settings: dict, make_alpha_bars: Callable, *rules: tuple[str, bool]
) -> NoiseSchedule:
    """Return the schedule of K discrete levels with these shares of signal power.

    Level k stands for schedule time t = 1 - (k + 1) / K; level 0 is the least noisy, and t = 1 is clean. The sampler is
    ancestral DDPM: the paper names VP and DDPM together as what CAMDM uses (section 6).

    Raises:
      ValueError: for the first of `rules` (what is needed, whether that holds) that does not hold.
    """
    num_levels = settings["num_levels"]
    whole = type(num_levels) is int and num_levels >= 1
    for needed, holds in (("a whole num_levels of at least 1", whole), *rules):
        if not holds:
            raise ValueError(f"{kind} schedule needs {needed}, got {settings}")
    alpha_bars = make_alpha_bars()
    levels, shares = sigma_from_alpha_bar(alpha_bars), np.append(1.0, alpha_bars)

    def alpha_bar(t):
        return array_module(t).asarray(shares)[_rank(t, num_levels)]

    return NoiseSchedule(
        kind, tuple(settings.items()), sampler="ddpm", alpha=lambda t: alpha_bar(t) ** 0.5,
        sigma=lambda t: (1.0 - alpha_bar(t)) ** 0.5, sigma_min=float(levels[0]), sigma_max=float(levels[-1]),
        levels=levels, alpha_bars=alpha_bars,
    )  # fmt: skip


def _rank(t, num_levels: int):
    """Return the number, from 1, of the level that schedule time t stands for; 0 is clean data."""
    xp = array_module(t)
    return xp.rint(num_levels * (1.0 - xp.asarray(t))).astype(int)


SCHEDULES: dict[str, Callable[..., NoiseSchedule]] = {
    make.__name__: make
    for make in (
        variance_exploding, straight, variance_preserving_cosine, variance_preserving_linear, variance_preserving_betas,
    )
}  # fmt: skip
"""Constructors of noise schedules by the name that they have in a file."""


def schedule_from_dict(values: Mapping) -> NoiseSchedule:
    """Build the noise schedule of which `NoiseSchedule.to_dict` made these values.

    Args:
      values: "kind", a name of `SCHEDULES`, and arguments of that constructor; those that are missing
        take their defaults.

    Raises:
      ValueError: for a missing or unknown kind, an unknown setting (with the nearest name), or values
        that the schedule refuses.
    """
    settings = dict(values)
    kind = settings.pop("kind", None)
    check_known(kind, SCHEDULES, "noise schedule")
    known = inspect.signature(SCHEDULES[kind]).parameters
    for name, value in settings.items():
        check_known(name, known, f"{kind} setting")
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            raise ValueError(f"{kind} setting {name!r} must be a number, got {value!r}")
    return SCHEDULES[kind](**settings)


def alpha_bar_from_sigma(sigma):
    """Return alpha_bar = 1 / (1 + sigma^2), any shape (Appendix F)."""
    return 1.0 / (1.0 + sigma * sigma)


def sigma_from_alpha_bar(alpha_bar):
    """Return sigma = sqrt((1 - alpha_bar) / alpha_bar), any shape (Appendix F, inverted)."""
    return array_module(alpha_bar).sqrt((1.0 - alpha_bar) / alpha_bar)


def log_snr_from_sigma(sigma):
    """Return the log signal-to-noise ratio, -2 log sigma, any shape."""
    return -2.0 * array_module(sigma).log(sigma)
