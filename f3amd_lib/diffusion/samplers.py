"""Samplers: from noise to motion through any denoiser.

A denoiser is a callable `denoise(x_noisy, sigma) -> x0_hat` that takes the variance-exploding state
of Eq. 8. What it wraps (a network with an encoded condition, or an exact mixture of Gaussians) is
no concern of this module.

There is one walk down a falling list of noise levels, and a sampler is how it takes a step. `sample`
walks a JAX array in one compiled scan; `walk` is the same in plain Python and yields every state on the
way, so that it can be printed, drawn and recorded. Numpy's arrays stay numpy's, in their own precision.

The paper prints the DDIM update in variance-preserving form (Appendix F). Its state is
`z = sqrt(alpha_bar) x`, and a network trained on `x` must be shown `z / sqrt(alpha_bar)`. Both
forms are here and walk the same path; taking `z` for `x`, in the network and in the estimate of the
noise, does not. That third walk is here as well, to be studied (`ddim_step_literal`). DDPM, too, is
written for the variance-exploding state, in which its update has no alpha_bar at all.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np

from f3amd_lib.diffusion.schedules import alpha_bar_from_sigma
from f3amd_lib.ground.arrays import array_module, jax
from f3amd_lib.ground.names import check_known

Denoiser = Callable  # of a state and its noise level


def add_noise(x0, sigma, noise):
    """Return x_noisy = x0 + sigma * noise (Eq. 8); sigma broadcasts against x0."""
    return x0 + sigma * noise


def ddim_step(x_noisy, x0_hat, sigma, sigma_next, alpha=1.0, alpha_next=1.0):
    """Move a state `alpha x0 + sigma noise` from one noise level to the next without fresh noise.

    With eps_hat = (x_noisy - alpha x0_hat) / sigma the update is alpha_next x0_hat + sigma_next eps_hat.
    In the variance-exploding state alpha is 1, and this is one Euler step of dx/dsigma = (x - x0_hat) / sigma:
    a straight line towards the prediction. With alpha = 1 - t and sigma = t it is the Euler step of
    rectified flow.

    Args:
      x_noisy, x0_hat: state and clean estimate, any equal shape.
      sigma: current noise level, > 0, broadcasting.
      sigma_next: next level, 0 <= sigma_next < sigma; at 0 the answer is exactly alpha_next x0_hat.
      alpha, alpha_next: how much of the signal is left at each.

    Returns:
      State at the next level.

    Source: paper Appendix F, which prints it for the VP state; here for any.
    """
    return alpha_next * x0_hat + (sigma_next / sigma) * (x_noisy - alpha * x0_hat)


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
    sigma, sigma_next = xp.sqrt(1.0 - alpha_bar), xp.sqrt(1.0 - alpha_bar_next)
    return ddim_step(z, x0_hat, sigma, sigma_next, xp.sqrt(alpha_bar), xp.sqrt(alpha_bar_next))


def ddim_step_literal(x_noisy, x0_hat, sigma, sigma_next):
    """Take the printed update literally: a variance-exploding state in, a preserving one out.

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

    DDPM allows two variances; this is the smaller, which is exact once x0 is known.
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


@dataclass(frozen=True)
class Sampler:
    """How to go from one noise level to the next.

    Attributes:
      step: `step(x_noisy, x0_hat, sigma, sigma_next)` returns the state at `sigma_next`; it is given standard normal
        noise behind these if it draws any, the denoiser if it asks it again, and alphas where they are told.
      last: instead of `step` in the last interval, which may end at 0; by default `step`.
      draws_noise: whether it needs a random key.
      evaluations: of the network in a step, but one in the last.
    """

    step: Callable
    last: Callable | None = None
    draws_noise: bool = False
    evaluations: int = 1


def _ddim_vp(x_noisy, x0_hat, sigma, sigma_next):
    """Step in the VP state, with the rescaling before the network that Appendix F leaves unsaid."""
    alpha_bar, alpha_bar_next = alpha_bar_from_sigma(sigma), alpha_bar_from_sigma(sigma_next)
    xp = array_module(x_noisy, sigma)
    z = xp.sqrt(alpha_bar) * x_noisy
    return ddim_step_vp(z, x0_hat, alpha_bar, alpha_bar_next) / xp.sqrt(alpha_bar_next)


def _euler(x_noisy, x0_hat, sigma, sigma_next):
    return x_noisy + (sigma_next - sigma) * probability_flow_slope(x_noisy, x0_hat, sigma)


def _heun(x_noisy, x0_hat, sigma, sigma_next, denoise):
    """Go along the mean of the slopes at both ends (Karras et al. 2022, Algorithm 1)."""
    slope = probability_flow_slope(x_noisy, x0_hat, sigma)
    guess = x_noisy + (sigma_next - sigma) * slope
    slope_next = probability_flow_slope(guess, denoise(guess, sigma_next), sigma_next)
    return x_noisy + (sigma_next - sigma) * 0.5 * (slope + slope_next)


SAMPLERS: dict[str, Sampler] = {
    "ddim": Sampler(ddim_step),
    "ddim_vp": Sampler(_ddim_vp),
    "ddpm": Sampler(ddpm_step, draws_noise=True),
    "euler": Sampler(_euler),
    # At sigma = 0 the slope has no value, so that the last step is DDIM's. It is on grids that end
    # higher, too: the number of evaluations then does not depend on the levels.
    "heun": Sampler(_heun, last=ddim_step, evaluations=2),
    "ddim_literal": Sampler(ddim_step_literal),
}
"""Samplers by name; a noise schedule's `sampler` is one of these. The last is there to be studied
(an exact denoiser's samples collapse onto its mean), under a name because rollouts choose their
sampler by name; no schedule asks for it."""


def _legs(name: str, x_init, sigmas, alphas, key) -> tuple[Sampler, tuple]:
    """Return the sampler and all intervals at once; ValueError as `sample` says.

    An interval has its two levels, the key of its noise (or None), and what is left of the signal at each end, if that
    is told.
    """
    check_known(name, SAMPLERS, "sampler")
    xp = array_module(x_init, sigmas, key)
    sampler, sigmas = SAMPLERS[name], xp.asarray(sigmas, dtype=xp.result_type(x_init, 1.0))
    if sigmas.ndim != 1 or len(sigmas) < 2 or (xp is np and (np.diff(sigmas) > 0.0).any()):
        raise ValueError(
            f"sigmas must be [N + 1], never rising, with at least one step, got shape {sigmas.shape}; "
            "take them from a noise schedule's grid"
        )
    if sampler.draws_noise and key is None:
        raise ValueError(f"sampler {name!r} draws fresh noise at every step: give it a key")
    keys = None
    if sampler.draws_noise:
        keys = [key] * (len(sigmas) - 1) if xp is np else jax.random.split(key, len(sigmas) - 1)
    if alphas is None:
        return sampler, (sigmas[:-1], sigmas[1:], keys)
    alphas = xp.asarray(alphas, dtype=sigmas.dtype)
    if name != "ddim" or alphas.shape != sigmas.shape:
        raise ValueError(
            f"alphas are for 'ddim' alone, one for each of the {len(sigmas)} sigmas; got {alphas.shape} for {name!r}"
        )
    return sampler, (sigmas[:-1], sigmas[1:], keys, alphas[:-1], alphas[1:])


def _take(sampler: Sampler, denoise: Denoiser, x_noisy, leg: tuple, *, last: bool = False):
    """Go over one interval; return the state at its end and the clean estimate at its start."""
    sigma, sigma_next, key, *more = leg
    x0_hat = denoise(x_noisy, sigma)
    if last and sampler.last:
        return sampler.last(x_noisy, x0_hat, sigma, sigma_next), x0_hat
    if sampler.draws_noise:
        draw = key.standard_normal if isinstance(key, np.random.Generator) else partial(jax.random.normal, key)
        more = [draw(x_noisy.shape, x_noisy.dtype)]
    if sampler.evaluations > 1:
        more = [denoise]
    return sampler.step(x_noisy, x0_hat, sigma, sigma_next, *more), x0_hat


def _pick(legs: tuple, which) -> tuple:
    return tuple(field if field is None else field[which] for field in legs)


def sample(name: str, denoise: Denoiser, x_init, sigmas, *, alphas=None, key=None, unroll: bool = False):
    """Walk a state down the noise levels, in one scan: the variance-exploding one unless `alphas` are given.

    With JAX a denoiser that prints or records what it is shown gets tracers here, not numbers: take `walk`.

    Args:
      name: of `SAMPLERS`.
      denoise: `denoise(x_noisy, sigma) -> x0_hat`; sigma comes as a scalar.
      x_init: state at sigmas[0], usually sigmas[0] * normal noise, [B, T, C].
      sigmas: [N + 1], falling, the last may be 0 (a schedule's `grid`).
      alphas: [N + 1], what is left of the signal at each of `sigmas` (a schedule's `scaled_grid`), for "ddim" alone:
        the state, which the denoiser sees, is then alpha x0 + sigma noise.
      key: JAX random key, or numpy's generator for a numpy state, needed by "ddpm"; the others draw nothing.
      unroll: write the steps out one by one instead of a `lax.scan` (for exports). The walk is then
        free of loops, but JAX's default random numbers bring one of their own; those of
        `jax.random.key(seed, impl="unsafe_rbg")` do not.

    Returns:
      State at sigmas[-1], [B, T, C].

    Raises:
      ValueError: for an unknown name, a sampler that draws noise without a key, `sigmas` that
        are not a list of at least two levels, or `alphas` that do not fit them or the sampler.
    """
    sampler, legs = _legs(name, x_init, sigmas, alphas, key)
    # What ends otherwise ends apart: masked inside the scan, it would cost an evaluation that nobody uses.
    alike = len(legs[0]) - (sampler.last is not None)
    # A scan keeps its loop around a single step, and also around none.
    if unroll or alike < 2 or array_module(legs[0]) is np:
        return [*walk(name, denoise, x_init, sigmas, alphas=alphas, key=key)][-1].x_noisy
    over = lambda x_noisy, leg: (_take(sampler, denoise, x_noisy, leg)[0], None)
    x_noisy, _ = jax.lax.scan(over, jax.numpy.asarray(x_init), _pick(legs, slice(alike)))
    return _take(sampler, denoise, x_noisy, _pick(legs, -1), last=True)[0] if sampler.last else x_noisy


class Visited(NamedTuple):
    """One state of a walk: the state, its noise level, and the clean estimate that was made there."""

    x_noisy: jax.Array | np.ndarray
    sigma: jax.Array | np.ndarray
    x0_hat: jax.Array | np.ndarray | None


def walk(name: str, denoise: Denoiser, x_init, sigmas, *, alphas=None, key=None) -> Iterator[Visited]:
    """Walk as `sample` does, step by step in plain Python, and yield every state.

    Args:
      name, denoise, x_init, sigmas, alphas, key: as for `sample`.

    Yields:
      N + 1 states, the first `x_init`; the last is the sample, where no estimate is made.

    Raises:
      ValueError: as `sample`.
    """
    sampler, legs = _legs(name, x_init, sigmas, alphas, key)
    x_noisy, last = array_module(legs[0]).asarray(x_init), len(legs[0]) - 1
    for number in range(last + 1):
        leg = _pick(legs, number)
        x_next, x0_hat = _take(sampler, denoise, x_noisy, leg, last=number == last)
        yield Visited(x_noisy, leg[0], x0_hat)
        x_noisy = x_next
    yield Visited(x_noisy, legs[1][-1], None)


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
    check_known(name, SAMPLERS, "sampler")
    return SAMPLERS[name].evaluations * (num_steps - 1) + 1
