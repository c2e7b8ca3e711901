"""What a network predicts: noise or velocity, told as the clean estimate that samplers ask for; and guidance.

Each function takes callables of (x_noisy, sigma), the variance-exploding state, and returns a denoiser. All of them
describe one and the same walk: with an exact network every kind of prediction gives the same samples.
"""

from __future__ import annotations

import jax.numpy as jnp

from f3amd_lib.diffusion.samplers import Denoiser
from f3amd_lib.diffusion.schedules import alpha_bar_from_sigma


def from_noise(predict) -> Denoiser:
    """Return the denoiser of a network that predicts the noise, eps = (x_noisy - x0) / sigma (Ho et al. 2020)."""
    return lambda x_noisy, sigma: x_noisy - sigma * predict(x_noisy, sigma)


def from_velocity(predict) -> Denoiser:
    """Return the denoiser of a network that predicts v = sqrt(ab) eps - sqrt(1 - ab) x0.

    Source: Salimans and Ho 2022, Appendix D, with ab = alpha_bar.
    """

    def denoise(x_noisy, sigma):
        alpha_bar = alpha_bar_from_sigma(sigma)
        return alpha_bar * x_noisy - jnp.sqrt(1.0 - alpha_bar) * predict(x_noisy, sigma)

    return denoise


def guided(denoise: Denoiser, unconditional: Denoiser, scale: float) -> Denoiser:
    """Return what lies `scale` times as far from the unconditional estimate as the conditional one.

    At scale 1 this is `denoise` and at 0 `unconditional`; above 1 the condition is obeyed more than it should be.

    Source: Ho and Salimans 2022.
    """

    def estimate(x_noisy, sigma):
        free = unconditional(x_noisy, sigma)
        return free + scale * (denoise(x_noisy, sigma) - free)

    return estimate
