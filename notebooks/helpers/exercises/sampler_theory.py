"""Exercises of notebook 02: what samplers do on a denoiser that makes no mistakes."""

from __future__ import annotations

import numpy as np
from f3amd_lib.diffusion import samplers, schedules
from f3amd_lib.diffusion.oracles import GaussianMixture

from helpers.exercises.judging import agree, normal_quantiles, sample

_WIDE = GaussianMixture([-1.0, 1.0], width=0.3)
_NARROW_PAIR = GaussianMixture([-0.1, 0.1], width=0.1)
_SIGMA_MAX = schedules.variance_exploding().sigma_max
_MOST_STEPS = 20_000


def _pure_noise() -> np.ndarray:
    """Return sigma_max epsilon without chance, [400, 1]."""
    return _SIGMA_MAX * normal_quantiles(400)[:, None]


def _error(sampler: str, schedule: schedules.variance_exploding, num_steps: int) -> float:
    """Return the mean distance from the exact flow on the wide modes, as notebook 02 measures it.

    The last step of every sampler is the denoiser's answer at sigma_min, and so is the truth's.
    """
    flown = _WIDE.flow(_pure_noise(), schedule.sigma_max, schedule.sigma_min)
    truth = _WIDE.denoise(flown, schedule.sigma_min)
    return float(np.abs(sample(sampler, _WIDE.denoise, _pure_noise(), schedule.grid(num_steps)) - truth).mean())


def _one_step_spread(answer) -> str | None:
    ends = sample("ddim", _NARROW_PAIR.denoise, _pure_noise(), schedules.variance_exploding().grid(1))
    if agree(answer, ends.std(), rtol=0.1):
        return None
    return (
        "at sigma = 128 the data look like one Gaussian of variance v, whose denoiser is linear, "
        "D = m + c (x - m): how small is c, and how large is x - m?"
    )


def _ve_step(answer) -> str | None:
    x_noisy, x0_hat = np.random.default_rng(0).standard_normal((2, 50, 3))
    for sigma, sigma_next in ((2.0, 0.5), (128.0, 82.3), (0.01, 0.0)):
        expected = samplers.ddim_step(x_noisy, x0_hat, sigma, sigma_next)
        if not agree(answer(x_noisy, x0_hat, sigma, sigma_next), expected, atol=1e-9):
            return (
                f"from sigma = {sigma:g} to {sigma_next:g} the state ends elsewhere; solve Eq. 8 "
                "for the noise, and put that noise into Eq. 8 again"
            )
    return None


def _curvature(answer) -> str | None:
    before = _error("ddim", schedules.variance_exploding(), 8)
    after = _error("ddim", schedules.variance_exploding(rho=float(answer)), 8)
    if after <= 0.75 * before:
        return None
    return (
        f"the error is {after:.3f}, at rho = 3 it is {before:.3f}, and {0.75 * before:.3f} is "
        "wanted; at which sigma does the flow bend, and how many levels lie there?"
    )


def _numbers_of_steps(answer) -> str | None:
    steps = [float(count) for count in answer]
    if len(steps) != 2 or not all(1 <= count <= _MOST_STEPS for count in steps):
        return f"two numbers of steps are asked for, each from 1 to {_MOST_STEPS}"
    for sampler, name, count in zip(("euler", "heun"), ("Euler", "Heun"), steps, strict=True):
        error = _error(sampler, schedules.variance_exploding(), round(count))
        if not agree(error, 0.001, rtol=0.1):
            return (
                f"{name} has an error of {error:.2g} after {round(count)} steps; by which factor "
                "must the error change, and what does the order make of it?"
            )
    return None


def _ancestral_shares(answer) -> str | None:
    # The step is linear: what each of its inputs is multiplied by shows one at a time.
    expected = []
    for sigma, sigma_next in ((2.0, 0.5), (2.0, 1.9)):
        kept = samplers.ddpm_step(1.0, 0.0, sigma, sigma_next, 0.0)
        fresh = samplers.ddpm_step(0.0, 0.0, sigma, sigma_next, 1.0)
        expected.append((kept, fresh, (kept * sigma) ** 2 + fresh**2))
    if agree(answer, expected, rtol=0.02):
        return None
    if np.shape(answer) != (2, 3):
        return "give two rows (2 to 0.5, 2 to 1.9) of three numbers: kept, fresh, sum of variances"
    first = agree(answer[0], expected[0], rtol=0.02)
    return (
        f"the {'second' if first else 'first'} row is not right; DDPM goes a DDIM step too far, to "
        "r sigma', and comes back up to sigma' with fresh noise"
    )


def _vp_view(answer) -> str | None:
    denoise_vp = answer(_WIDE.denoise)
    z = np.linspace(-3.0, 3.0, 61)[:, None]
    for alpha_bar in (0.999, 0.5, 0.01):
        sigma = schedules.sigma_from_alpha_bar(alpha_bar)
        expected = _WIDE.denoise(z / np.sqrt(alpha_bar), sigma)
        if not agree(denoise_vp(z, alpha_bar), expected, atol=1e-9):
            return (
                f"at alpha_bar = {alpha_bar:g} the guess is another one; which x belongs to this "
                "z, and which sigma to this alpha_bar?"
            )
    return None


def _coefficients_on_z(answer) -> str | None:
    """Judge where Appendix F's alpha_t = sqrt(alpha_bar_t / alpha_bar_(t-1)) has a place.

    It stands in DDPM's mean (Ho et al. 2020), and not in the DDIM update that is printed with it.
    """
    for alpha_bar, alpha_bar_next in ((1e-4, 0.2), (0.2, 0.8), (0.8, 0.99)):
        alpha_t = np.sqrt(alpha_bar / alpha_bar_next)
        ancestral = samplers.ddpm_posterior(alpha_bar, alpha_bar_next)[1]
        ddim = samplers.ddim_step_vp(1.0, 0.0, alpha_bar, alpha_bar_next)
        found = answer(alpha_t, alpha_bar, alpha_bar_next)
        if not agree(found, (ancestral, ddim), rtol=1e-9):
            if np.shape(found) != (2,):
                return "return two numbers: the coefficient in DDPM's step, and that in DDIM's"
            wrong = "DDIM" if agree(found[0], ancestral, rtol=1e-9) else "DDPM"
            return f"{wrong}'s coefficient is another one; put x0_hat = 0 into its step"
    return None


CHECKS = {
    "2.a": _one_step_spread,
    "2.b": _ve_step,
    "2.c": _curvature,
    "2.d": _numbers_of_steps,
    "2.e": _ancestral_shares,
    "2.f": _vp_view,
    "2.g": _coefficients_on_z,
}
"""By number, a function of the answer that returns None if it is right, else a hint."""
