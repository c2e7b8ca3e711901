"""Samplers: from noise to motion through any denoiser.

A denoiser is a callable `denoise(x_noisy, sigma) -> x0_hat` that takes the variance-exploding state
of Eq. 8. What it wraps (a network with an encoded condition, or an exact mixture of Gaussians) is
no concern of this module.

The paper prints the DDIM update in variance-preserving form (Appendix F). Its state is
`z = sqrt(alpha_bar) x`, and a network trained on `x` must be shown `z / sqrt(alpha_bar)`. Both
forms are here and walk the same path; feeding `z` to the network unrescaled does not.
"""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp

from f3amd_lib.diffusion.schedules import alpha_bar_from_sigma
from f3amd_lib.motion.rotations import array_module

__all__ = ["add_noise", "ddim_step", "ddim_step_vp", "sample_ddim", "sample_ddim_vp"]

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


def _noise_levels(sigmas, x_init):
    """Return the levels in the state's type; ValueError if they make no step."""
    sigmas = jnp.asarray(sigmas, dtype=jnp.result_type(x_init))
    if sigmas.ndim != 1 or len(sigmas) < 2:
        raise ValueError(
            f"sigmas must be [N + 1] with at least one step, got shape {sigmas.shape}; "
            "see VarianceExploding.grid"
        )
    return sigmas


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
    sigmas = _noise_levels(sigmas, x_init)

    def step(x_noisy, pair):
        sigma, sigma_next = pair
        return ddim_step(x_noisy, denoise(x_noisy, sigma), sigma, sigma_next), None

    pairs = (sigmas[:-1], sigmas[1:])
    return jax.lax.scan(step, x_init, pairs, unroll=len(sigmas) - 1 if unroll else 1)[0]


def sample_ddim_vp(denoise: Denoiser, x_init, sigmas):
    """Walk the same path as `sample_ddim` in the VP state, rescaling before every network call.

    Args:
      denoise: takes the VE state, as everywhere.
      x_init: VE state at sigmas[0], [B, T, C].
      sigmas: [N + 1], falling, the last may be 0.

    Returns:
      VE state at sigmas[-1]; equal to `sample_ddim` to rounding.

    Raises:
      ValueError: if `sigmas` is not a list of at least two levels.

    Source: paper Appendix F, with the rescaling that it leaves unsaid.
    """
    sigmas = _noise_levels(sigmas, x_init)
    alpha_bars = alpha_bar_from_sigma(sigmas)

    def step(z, pair):
        sigma, alpha_bar, alpha_bar_next = pair
        x0_hat = denoise(z / jnp.sqrt(alpha_bar), sigma)
        return ddim_step_vp(z, x0_hat, alpha_bar, alpha_bar_next), None

    z = jnp.sqrt(alpha_bars[0]) * x_init
    z, _ = jax.lax.scan(step, z, (sigmas[:-1], alpha_bars[:-1], alpha_bars[1:]))
    return z / jnp.sqrt(alpha_bars[-1])
