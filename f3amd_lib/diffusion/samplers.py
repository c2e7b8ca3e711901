"""Samplers: from noise to motion through any denoiser.

A denoiser is a callable `denoise(x_noisy, sigma) -> x0_hat` that takes the variance-exploding state
of Eq. 8. What it wraps (a network with an encoded condition, or an exact mixture of Gaussians) is
no concern of this module.

The paper prints the DDIM update in variance-preserving form (Appendix F). Its state is
`z = sqrt(alpha_bar) x`, and a network trained on `x` must be shown `z / sqrt(alpha_bar)`. Both
forms are here and walk the same path; taking `z` for `x`, in the network and in the estimate of the
noise, does not. That third walk is here as well, to be studied (`ddim_step_literal`).

The same rescaling lets one denoiser serve both kinds of schedule: DDPM, too, is written for the
variance-exploding state, in which its update has no alpha_bar at all. Every sampler takes any
falling list of noise levels, so that a schedule and a sampler are chosen apart.
"""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp

from f3amd_lib.diffusion.schedules import alpha_bar_from_sigma
from f3amd_lib.ground.arrays import array_module
from f3amd_lib.ground.names import nearest_hint

Denoiser = Callable[[jax.Array, jax.Array], jax.Array]


def add_noise(x0, sigma, noise):
    """Return x_noisy = x0 + sigma * noise (Eq. 8); sigma broadcasts against x0."""
    return x0 + sigma * noise


def ddim_step(x_noisy, x0_hat, sigma, sigma_next):
    """Move a variance-exploding state from `sigma` to `sigma_next` without fresh noise.

    With eps_hat = (x_noisy - x0_hat) / sigma the update is x0_hat + sigma_next * eps_hat: a
    straight line towards the prediction, one Euler step of dx/dsigma = (x - x0_hat) / sigma.

    Args:
      x_noisy, x0_hat: state and clean estimate, any equal shape.
      sigma: current noise level, > 0, broadcasting.
      sigma_next: next level, 0 <= sigma_next < sigma; at 0 the answer is exactly `x0_hat`.

    Returns:
      State at `sigma_next`.

    Source: paper Appendix F, carried back from the VP to the VE state.
    """
    return x0_hat + (sigma_next / sigma) * (x_noisy - x0_hat)


def ddim_step_vp(z, x0_hat, alpha_bar, alpha_bar_next):
    """Move a variance-preserving state z = sqrt(alpha_bar) x as Appendix F prints it.

    Args:
      z, x0_hat: VP state and clean estimate, any equal shape.
      alpha_bar: current signal power, in (0, 1), broadcasting.
      alpha_bar_next: next signal power, alpha_bar < alpha_bar_next <= 1.

    Returns:
      VP state at `alpha_bar_next`: sqrt(ab') x0_hat + sqrt(1 - ab') eps_hat.
    """
    xp = array_module(z, x0_hat, alpha_bar, alpha_bar_next)
    eps_hat = (z - xp.sqrt(alpha_bar) * x0_hat) / xp.sqrt(1.0 - alpha_bar)
    return xp.sqrt(alpha_bar_next) * x0_hat + xp.sqrt(1.0 - alpha_bar_next) * eps_hat


def ddim_step_literal(x_noisy, x0_hat, sigma, sigma_next):
    """Take the printed update as it stands: a variance-exploding state in, a preserving one out.

    The answer is that of `ddim_step` times 1 / sqrt(1 + sigma_next^2). Whoever hands it to the
    network as the state at `sigma_next` shows it a state that is too small by this factor.

    Args:
      x_noisy, x0_hat: state and clean estimate, any equal shape.
      sigma: current noise level, > 0, broadcasting.
      sigma_next: next level, 0 <= sigma_next < sigma; at 0 nothing is lost, the answer is `x0_hat`.

    Returns:
      sqrt(ab') x0_hat + sqrt(1 - ab') eps_hat, with ab' = 1 / (1 + sigma_next^2).

    Source: paper Appendix F, to the letter; the text does not say what happens to the state before
    the next step.
    """
    xp = array_module(x_noisy, x0_hat, sigma, sigma_next)
    alpha_bar_next = alpha_bar_from_sigma(sigma_next)
    eps_hat = (x_noisy - x0_hat) / sigma
    return xp.sqrt(alpha_bar_next) * x0_hat + xp.sqrt(1.0 - alpha_bar_next) * eps_hat


def ddpm_posterior(alpha_bar, alpha_bar_next):
    """Return what DDPM's ancestral step draws from: z at `alpha_bar_next`, given z and x0.

    Of the two variances that DDPM allows this is the smaller, which is exact once x0 is known.
    The root of alpha_bar / alpha_bar_next, the paper's alpha_t, stands in the coefficient on z.

    Args:
      alpha_bar: current signal power, in (0, 1), broadcasting. The two levels need not be
        neighbours in the schedule: a respaced one has the same formula.
      alpha_bar_next: next signal power, alpha_bar < alpha_bar_next <= 1.

    Returns:
      (coefficient on x0, coefficient on z, variance): the mean is the sum of the first two times
      x0 and z. At alpha_bar_next = 1 they are 1, 0 and 0.

    Source: Ho et al. 2020, Eqs 6 and 7, with beta = 1 - alpha_bar / alpha_bar_next.
    """
    xp = array_module(alpha_bar, alpha_bar_next)
    alpha = alpha_bar / alpha_bar_next
    noise_power, noise_power_next = 1.0 - alpha_bar, 1.0 - alpha_bar_next
    return (
        xp.sqrt(alpha_bar_next) * (1.0 - alpha) / noise_power,
        xp.sqrt(alpha) * noise_power_next / noise_power,
        (1.0 - alpha) * noise_power_next / noise_power,
    )


def ddpm_step(x_noisy, x0_hat, sigma, sigma_next, noise):
    """Move a variance-exploding state from `sigma` to `sigma_next` as DDPM does, with fresh noise.

    It is `ddpm_posterior` in the VE state. Where DDIM keeps the share sigma_next / sigma of the
    noise it sees, this keeps the square of that share, and fills up with `noise`.

    Args:
      x_noisy, x0_hat: state and clean estimate, any equal shape.
      sigma: current noise level, > 0, broadcasting.
      sigma_next: next level, 0 <= sigma_next < sigma; at 0 the answer is exactly `x0_hat`.
      noise: standard normal, of the shape of the state.

    Returns:
      State at `sigma_next`.

    Source: Ho et al. 2020, Eqs 6 and 7, carried from the VP to the VE state.
    """
    xp = array_module(x_noisy, x0_hat, sigma, sigma_next, noise)
    share = sigma_next / sigma
    # (sigma - sigma_next)(sigma + sigma_next): neighbours of a long grid leave 1 - share^2 few
    # digits.
    fresh = share * xp.sqrt((sigma - sigma_next) * (sigma + sigma_next))
    return x0_hat + share * share * (x_noisy - x0_hat) + fresh * noise


def probability_flow_slope(x_noisy, x0_hat, sigma):
    """Return dx/dsigma = (x - x0_hat) / sigma, which carries noise to data without randomness.

    Args:
      x_noisy, x0_hat: VE state and clean estimate, any equal shape.
      sigma: noise level, > 0, broadcasting.

    Source: Karras et al. 2022, Eqs 1 and 3, for sigma(t) = t.
    """
    return (x_noisy - x0_hat) / sigma


def _noise_levels(sigmas, x_init):
    """Return the levels in the state's type; ValueError if they make no step."""
    sigmas = jnp.asarray(sigmas, dtype=jnp.result_type(x_init))
    if sigmas.ndim != 1 or len(sigmas) < 2:
        raise ValueError(
            f"sigmas must be [N + 1] with at least one step, got shape {sigmas.shape}; "
            "take them from a noise schedule's grid"
        )
    return sigmas


def _walk(step, x, levels, unroll: bool, *more):
    """Fold `step(x, level, level_next, *more)` over neighbouring levels, in one scan.

    Args:
      step: returns the state at `level_next`.
      x: first state.
      levels: [N + 1]; with N = 0 the state stays as it is.
      unroll: write the steps out one by one.
      *more: arrays of which each step takes its own entry, [N, ...].
    """
    num_steps, x = len(levels) - 1, jnp.asarray(x)
    entries = (levels[:-1], levels[1:], *more)
    # A scan keeps its loop around a single step, unrolled or not, and also around none.
    if num_steps == 0:
        return x
    if num_steps == 1:
        return step(x, *(entry[0] for entry in entries))
    unroll = num_steps if unroll else 1
    return jax.lax.scan(lambda x, entry: (step(x, *entry), None), x, entries, unroll=unroll)[0]


def sample_ddim(denoise: Denoiser, x_init, sigmas, *, unroll: bool = False):
    """Walk a variance-exploding state down the noise levels with DDIM.

    Args:
      denoise: `denoise(x_noisy, sigma) -> x0_hat`; sigma comes as a scalar.
      x_init: state at sigmas[0], usually sigmas[0] * normal noise, [B, T, C].
      sigmas: [N + 1], falling, the last may be 0 (see `VarianceExploding.grid`).
      unroll: write the steps out one by one instead of a `lax.scan` (for exports).

    Returns:
      State at sigmas[-1], [B, T, C].

    Raises:
      ValueError: if `sigmas` is not a list of at least two levels.
    """

    def step(x_noisy, sigma, sigma_next):
        return ddim_step(x_noisy, denoise(x_noisy, sigma), sigma, sigma_next)

    return _walk(step, x_init, _noise_levels(sigmas, x_init), unroll)


def sample_ddim_vp(denoise: Denoiser, x_init, sigmas, *, unroll: bool = False):
    """Walk the same path as `sample_ddim` in the VP state, rescaling before every network call.

    Args:
      denoise: takes the VE state, as everywhere.
      x_init: VE state at sigmas[0], [B, T, C].
      sigmas: [N + 1], falling, the last may be 0.
      unroll: as in `sample_ddim`.

    Returns:
      VE state at sigmas[-1]; equal to `sample_ddim` to rounding.

    Raises:
      ValueError: if `sigmas` is not a list of at least two levels.

    Source: paper Appendix F, with the rescaling that it leaves unsaid.
    """
    sigmas = _noise_levels(sigmas, x_init)
    alpha_bars = alpha_bar_from_sigma(sigmas)

    def step(z, alpha_bar, alpha_bar_next, sigma):
        x0_hat = denoise(z / jnp.sqrt(alpha_bar), sigma)
        return ddim_step_vp(z, x0_hat, alpha_bar, alpha_bar_next)

    z = _walk(step, jnp.sqrt(alpha_bars[0]) * x_init, alpha_bars, unroll, sigmas[:-1])
    return z / jnp.sqrt(alpha_bars[-1])


def sample_ddim_literal(denoise: Denoiser, x_init, sigmas, *, unroll: bool = False):
    """Walk with the printed update and never rescale: what Appendix F says if taken to the letter.

    No sampler to use: an exact denoiser's samples collapse onto its mean. It is here to find out
    who would notice, see `experiments.literal_update`.

    Args:
      denoise, x_init, sigmas, unroll: as in `sample_ddim`.

    Returns:
      State after the last step, [B, T, C]; one step alone is `sample_ddim`'s.

    Raises:
      ValueError: if `sigmas` is not a list of at least two levels.
    """

    def step(x_noisy, sigma, sigma_next):
        return ddim_step_literal(x_noisy, denoise(x_noisy, sigma), sigma, sigma_next)

    return _walk(step, x_init, _noise_levels(sigmas, x_init), unroll)


def sample_ddpm(denoise: Denoiser, x_init, sigmas, key, *, unroll: bool = False):
    """Walk a variance-exploding state down the noise levels with DDPM's ancestral sampling.

    Args:
      denoise, x_init, sigmas, unroll: as in `sample_ddim`. Unrolled, the walk is free of loops, but
        JAX's default random numbers bring one of their own; those of
        `jax.random.key(seed, impl="unsafe_rbg")` do not.
      key: JAX random key of the noise added in between; the step to sigma = 0 adds none.

    Returns:
      State at sigmas[-1], [B, T, C].

    Raises:
      ValueError: if `sigmas` is not a list of at least two levels.

    Source: Ho et al. 2020, Algorithm 2; what CAMDM samples with (section 6).
    """
    sigmas = _noise_levels(sigmas, x_init)

    def step(x_noisy, sigma, sigma_next, key):
        noise = jax.random.normal(key, x_noisy.shape, x_noisy.dtype)
        return ddpm_step(x_noisy, denoise(x_noisy, sigma), sigma, sigma_next, noise)

    return _walk(step, x_init, sigmas, unroll, jax.random.split(key, len(sigmas) - 1))


def sample_euler(denoise: Denoiser, x_init, sigmas, *, unroll: bool = False):
    """Walk down the probability-flow ODE with Euler's method: DDIM, found in another way.

    Args:
      denoise, x_init, sigmas, unroll: as in `sample_ddim`.

    Returns:
      State at sigmas[-1], [B, T, C]; equal to `sample_ddim` to rounding.

    Raises:
      ValueError: if `sigmas` is not a list of at least two levels.
    """

    def step(x_noisy, sigma, sigma_next):
        slope = probability_flow_slope(x_noisy, denoise(x_noisy, sigma), sigma)
        return x_noisy + (sigma_next - sigma) * slope

    return _walk(step, x_init, _noise_levels(sigmas, x_init), unroll)


def sample_heun(denoise: Denoiser, x_init, sigmas, *, unroll: bool = False):
    """Walk down the probability-flow ODE with Heun's method: second order, 2N - 1 evaluations.

    Each step goes along the mean of the slopes at both of its ends. The last one is an Euler step,
    because at sigma = 0 the slope has no value; it is one on grids that end higher, too, so that
    the number of evaluations does not depend on the levels. One step of many is no loss of order.

    Args:
      denoise, x_init, sigmas, unroll: as in `sample_ddim`.

    Returns:
      State at sigmas[-1], [B, T, C].

    Raises:
      ValueError: if `sigmas` is not a list of at least two levels.

    Source: Karras et al. 2022, Algorithm 1.
    """
    sigmas = _noise_levels(sigmas, x_init)

    def step(x_noisy, sigma, sigma_next):
        slope = probability_flow_slope(x_noisy, denoise(x_noisy, sigma), sigma)
        guess = x_noisy + (sigma_next - sigma) * slope
        slope_next = probability_flow_slope(guess, denoise(guess, sigma_next), sigma_next)
        return x_noisy + (sigma_next - sigma) * 0.5 * (slope + slope_next)

    x_noisy = _walk(step, x_init, sigmas[:-1], unroll)
    # Outside the scan: masked inside, it would cost an evaluation that nobody uses.
    return sample_ddim(denoise, x_noisy, sigmas[-2:])


SAMPLERS: dict[str, Callable] = {
    "ddim": sample_ddim,
    "ddim_vp": sample_ddim_vp,
    "ddpm": sample_ddpm,
    "euler": sample_euler,
    "heun": sample_heun,
    "ddim_literal": sample_ddim_literal,
}
"""Samplers by name; a noise schedule's `sampler` is one of these. The last is there to be studied,
under a name because rollouts choose their sampler by name; no schedule asks for it."""

_STOCHASTIC = ("ddpm",)


def _known(name: str) -> str:
    """Return the name of a sampler; ValueError names the nearest one if there is none."""
    if name not in SAMPLERS:
        raise ValueError(f"unknown sampler {name!r}{nearest_hint(name, SAMPLERS)}")
    return name


def sample(name: str, denoise: Denoiser, x_init, sigmas, *, key=None, unroll: bool = False) -> jax.Array:
    """Walk a variance-exploding state down the noise levels with a sampler chosen by name.

    Args:
      name: of `SAMPLERS`.
      denoise: `denoise(x_noisy, sigma) -> x0_hat`; sigma comes as a scalar.
      x_init: state at sigmas[0], usually sigmas[0] * normal noise, [B, T, C].
      sigmas: [N + 1], falling, the last may be 0 (a schedule's `grid`).
      key: JAX random key, needed by "ddpm"; the others draw nothing and leave it alone.
      unroll: write the steps out one by one instead of a `lax.scan` (for exports).

    Returns:
      State at sigmas[-1], [B, T, C].

    Raises:
      ValueError: for an unknown name, a sampler that draws noise without a key, or `sigmas` that
        are not a list of at least two levels.
    """
    sampler = SAMPLERS[_known(name)]
    if name not in _STOCHASTIC:
        return sampler(denoise, x_init, sigmas, unroll=unroll)
    if key is None:
        raise ValueError(f"sampler {name!r} draws fresh noise at every step: give it a key")
    return sampler(denoise, x_init, sigmas, key, unroll=unroll)


def num_evaluations(name: str, num_steps: int) -> int:
    """Return how often a sampler calls the network on a grid of N steps.

    Args:
      name: of `SAMPLERS`.
      num_steps: N, at least 1.

    Raises:
      ValueError: for an unknown name or less than one step.
    """
    if num_steps < 1:
        raise ValueError(f"a sampler needs at least 1 step, got num_steps={num_steps}")
    return 2 * num_steps - 1 if _known(name) == "heun" else num_steps
