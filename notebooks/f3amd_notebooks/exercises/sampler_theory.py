"""Exercises of notebook 02: what samplers do on a denoiser that makes no mistakes."""

from __future__ import annotations

import functools

import numpy as np
from f3amd_lib.diffusion import samplers, schedules
from f3amd_lib.diffusion.oracles import GaussianMixture

from f3amd_notebooks.exercises.judging import (
    FLOAT32,
    OTHER_ORDER,
    NotAnswered,
    agree,
    normal_quantiles,
    numbers,
    read,
    reordered,
    sample,
    too,
)

_WIDE = GaussianMixture([-1.0, 1.0], width=0.3)
_NARROW_PAIR = GaussianMixture([-0.1, 0.1], width=0.1)
_SIGMA_MAX = schedules.variance_exploding().sigma_max
_MOST_STEPS = 20_000


def _pure_noise() -> np.ndarray:
    """Return sigma_max epsilon without chance, [400, 1]."""
    return _SIGMA_MAX * normal_quantiles(400)[:, None]


@functools.cache
def _error(sampler: str, schedule: schedules.NoiseSchedule, num_steps: int) -> float:
    """Return the mean distance from the exact flow on the wide modes, as notebook 02 measures it.

    The last step of every sampler is the denoiser's answer at sigma_min, and so is the truth's.
    """
    flown = _WIDE.flow(_pure_noise(), schedule.sigma_max, schedule.sigma_min)
    truth = _WIDE.denoise(flown, schedule.sigma_min)
    return float(np.abs(sample(sampler, _WIDE.denoise, _pure_noise(), schedule.grid(num_steps)) - truth).mean())


def _one_step_spread(answer) -> str | None:
    spread = read(answer, (), "one number is asked for, the standard deviation of the samples")
    ends = sample("ddim", _NARROW_PAIR.denoise, _pure_noise(), schedules.variance_exploding().grid(1))
    if agree(spread, ends.std(), rtol=0.1):
        return None
    return (
        f"this is {too(spread, ends.std())}; at sigma = 128 the data look like one Gaussian of variance s^2, "
        "whose denoiser is linear, D = m + g (x - m): how small is g, and how large is x - m?"
    )


def _ve_step(answer) -> str | None:
    x0_hat, noise = np.random.default_rng(0).standard_normal((2, 50, 3))
    for sigma, sigma_next in ((2.0, 0.5), (128.0, 82.3), (0.7, 0.6), (0.01, 0.0)):
        x_noisy = x0_hat + sigma * noise
        given = x_noisy, x0_hat, sigma, sigma_next
        found = answer(x_noisy.copy(), x0_hat.copy(), sigma, sigma_next)
        if agree(found, samplers.ddim_step(*given), **FLOAT32):
            continue
        if agree(found, x_noisy, **FLOAT32):
            return "this is the state that was given; the amount of noise in it has to change"
        if agree(found, samplers.ddim_step_literal(*given), **FLOAT32):
            return "this is the step as it is printed: its answer is a VP state, and a VE state is asked for"
        if agree(found, samplers.ddpm_step(*given, 0.0), **FLOAT32):
            return "this keeps the share (sigma' / sigma)^2 of the noise; the amount is to go from sigma to sigma'"
        if agree(found, x0_hat + sigma_next * (x_noisy - x0_hat), **FLOAT32):
            return "x - x0_hat is the noise times sigma, and not yet the noise"
        return (
            f"from sigma = {sigma:g} to {sigma_next:g} the state ends elsewhere; solve Eq. 8 "
            "for the noise, and put that noise into Eq. 8 again"
        )
    return None


def _curvature(answer) -> str | None:
    rho = read(answer, (), "one number is asked for: rho")
    if not rho > 0:
        return "rho is a positive number"
    before = _error("ddim", schedules.variance_exploding(), 8)
    after = _error("ddim", schedules.variance_exploding(rho=float(rho)), 8)
    if after <= 0.75 * before:
        return None
    return (
        f"the error is {after:.3f}, at rho = 3 it is {before:.3f}, and {0.75 * before:.3f} is "
        "wanted; at which sigma does the flow bend, and how many levels lie there?"
    )


def _numbers_of_steps(answer) -> str | None:
    asked = f"two numbers of steps are asked for, each from 1 to {_MOST_STEPS}"
    steps = read(answer, (2,), asked)
    if not np.all((steps >= 1) & (steps <= _MOST_STEPS)):
        return asked
    right = lambda sampler, count: agree(_error(sampler, schedules.variance_exploding(), round(count)), 0.001, rtol=0.1)
    if right("heun", steps[0]) and right("euler", steps[1]):
        return f"{OTHER_ORDER}: Euler's comes first"
    for sampler, name, count in zip(("euler", "heun"), ("Euler", "Heun"), steps, strict=True):
        error = _error(sampler, schedules.variance_exploding(), round(count))
        if not right(sampler, count):
            return (
                f"{name} has an error of {error:.2g} after {round(count)} steps, which is {too(error, 0.001)}; "
                "by which factor must the error change, and what does the order make of it?"
            )
    return None


def _ancestral_shares(answer) -> str | None:
    shares = read(answer, (2, 3), "give two rows (2 to 0.5, 2 to 1.9) of three numbers: kept, fresh, sum of variances")
    steps, right_shares = ((2.0, 0.5), (2.0, 1.9)), []
    for sigma, sigma_next in steps:
        # The step is linear: what each of its inputs is multiplied by shows one at a time.
        kept = samplers.ddpm_step(1.0, 0.0, sigma, sigma_next, 0.0)
        fresh = samplers.ddpm_step(0.0, 0.0, sigma, sigma_next, 1.0)
        right_shares.append((kept, fresh, (kept * sigma) ** 2 + fresh**2))
    if reordered(shares, right_shares, rtol=0.02):
        return f"{OTHER_ORDER}: a row a step, 2 to 0.5 first, and in a row kept, fresh, sum of variances"
    for row, expected, (_, sigma_next) in zip(shares, right_shares, steps, strict=True):
        for name, value, right in zip(("a", "b", "the sum of variances"), row, expected, strict=True):
            if not agree(value, right, rtol=0.02):
                return (
                    f"from 2 to {sigma_next:g} {name} is {too(value, right)}; DDPM goes a DDIM step too far, "
                    "to r sigma', and comes back up to sigma' with fresh noise"
                )
    return None


def _vp_view(answer) -> str | None:
    denoise_vp = answer(_WIDE.denoise)
    z = np.linspace(-3.0, 3.0, 61)[:, None]
    for alpha_bar in (0.2, 0.999, 0.5, 0.01):
        x, sigma = z / np.sqrt(alpha_bar), schedules.sigma_from_alpha_bar(alpha_bar)
        found = denoise_vp(z, alpha_bar)
        if agree(found, _WIDE.denoise(x, sigma), **FLOAT32):
            continue
        if agree(found, _WIDE.denoise(z, sigma), **FLOAT32):
            return "the level is right, but the network is shown z as it is: which x belongs to this z?"
        wrong_levels = np.sqrt(1 - alpha_bar), 1 - alpha_bar, alpha_bar, 1 / sigma, sigma**2
        if any(agree(found, _WIDE.denoise(x, level), **FLOAT32) for level in wrong_levels):
            return "the state is right, but the level is not: which sigma belongs to this alpha_bar?"
        return (
            f"at alpha_bar = {alpha_bar:g} the guess is another one; which x belongs to this "
            "z, and which sigma to this alpha_bar?"
        )
    return None


def _coefficients_on_z(answer) -> str | None:
    """Judge where Appendix F's alpha_t = sqrt(alpha_bar_t / alpha_bar_(t-1)) has a place.

    It stands in DDPM's mean (Ho et al. 2020), and not in the DDIM update that is printed with it.
    """
    asked = "return two numbers: the coefficient in DDPM's step, and that in DDIM's"
    for alpha_bar, alpha_bar_next in ((1e-4, 0.2), (0.2, 0.8), (0.8, 0.99)):
        alpha_t = np.sqrt(alpha_bar / alpha_bar_next)
        expected = (
            samplers.ddpm_posterior(alpha_bar, alpha_bar_next)[1],
            samplers.ddim_step_vp(1.0, 0.0, alpha_bar, alpha_bar_next),
        )
        found = answer(alpha_t, alpha_bar, alpha_bar_next)
        if numbers(found).shape != (2,):
            raise NotAnswered(asked)
        if agree(found[::-1], expected, rtol=1e-4):
            return "both are right, but the other way round: DDPM's coefficient comes first"
        for name, value, right in zip(("DDPM", "DDIM"), numbers(found), expected, strict=True):
            if not agree(value, right, rtol=1e-4):
                return f"{name}'s coefficient is {too(value, right)}; put x0_hat = 0 into its step"
        # Where alpha_t occurs shows when it is changed alone.
        changed = numbers(answer(1.1 * alpha_t, alpha_bar, alpha_bar_next))
        if agree(changed[0], expected[0], rtol=1e-4):
            return "the values are right; now write DDPM's coefficient with alpha_t, which stands in it"
        if not agree(changed[1], expected[1], rtol=1e-4):
            return "the values are right, but alpha_t has no place in DDIM's coefficient: both alpha_bars are enough"
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
