"""Exercises of notebook 10: the printed update, mended, followed and found out."""

from __future__ import annotations

import functools

import jax.numpy as jnp
import numpy as np
from f3amd_lib.diffusion import samplers
from f3amd_lib.diffusion.oracles import GaussianMixture
from f3amd_lib.diffusion.samplers import ddim_step, ddim_step_literal
from f3amd_lib.diffusion.schedules import variance_exploding

from helpers.exercises.judging import NotAnswered, agree, is_missing, normal_quantiles, sample

_SCHEDULE = variance_exploding()


def _mended_step(answer) -> str | None:
    rng = np.random.default_rng(0)
    for sigma, sigma_next in ((128.0, 82.3), (6.1, 0.4), (0.7, 0.01), (0.01, 0.0)):
        x, x0_hat = rng.standard_normal((2, 5))
        expected = ddim_step(sigma * x, x0_hat, sigma, sigma_next)
        found = answer(sigma * x, x0_hat, sigma, sigma_next)
        if not agree(found, expected, rtol=1e-9, atol=1e-9):
            if agree(found, ddim_step_literal(sigma * x, x0_hat, sigma, sigma_next), rtol=1e-9):
                return "this is the printed line itself; which state does the network want to see?"
            return f"from sigma = {sigma:g} to {sigma_next:g} this is not DDIM's step; write x_VE in terms of x_VP"
    return None


def _spread_left(answer) -> str | None:
    shares = [np.prod(1 / np.hypot(1, _SCHEDULE.grid(n)[1:-1])) for n in (2, 4, 16)]
    if agree(answer, shares, rtol=0.05):
        return None
    if np.shape(answer) != (3,):
        return "three numbers are asked for, at 2, 4 and 16 steps"
    return (
        "each step on the way multiplies by its own factor; the first level is not on the way, and "
        "the step to 0 comes after the last evaluation"
    )


def _distance_of_updates(width: float) -> float:
    """Return how far apart the updates end on average, 8 steps, one Gaussian around 0.8."""
    sigmas, denoise = _SCHEDULE.grid(8), GaussianMixture([0.8], width=width).denoise
    x_init = sigmas[0] * normal_quantiles(4000)[:, None]
    ends = [sample(name, denoise, x_init, sigmas) for name in ("ddim", "ddim_literal")]
    return float(np.abs(ends[0] - ends[1]).mean())


def _telling_width(answer) -> str | None:
    width = float(answer)
    if not width > 0:
        return "a width is a positive number"
    # The distance grows with the width, so that 5 % on either side must hold 0.05 between them.
    if _distance_of_updates(width / 1.05) <= 0.05 <= _distance_of_updates(1.05 * width):
        return None
    return f"data of this width end {_distance_of_updates(width):.3f} apart"


def _sample_in_preserving_state(denoise, x_init, sigmas, forget: bool):
    """DDIM in z = x / sqrt(1 + sigma^2), whose network is shown z times sqrt(1 + sigma^2), or z."""
    size = np.sqrt(1.0 + np.asarray(sigmas) ** 2)
    z = jnp.asarray(x_init) / size[0]
    for number, (sigma, sigma_next) in enumerate(zip(sigmas[:-1], sigmas[1:], strict=True)):
        x = z if forget and number else z * size[number]
        z = ddim_step_literal(x, denoise(x, sigma), sigma, sigma_next)
    return z


_STRANGERS = (
    (functools.partial(samplers.sample, "ddim"), True),
    (functools.partial(samplers.sample, "ddim_literal"), False),
    (functools.partial(samplers.sample, "ddim_vp"), True),
    (lambda *given: _sample_in_preserving_state(*given, forget=False), True),
    (lambda *given: _sample_in_preserving_state(*given, forget=True), False),
)


def _test_of_a_sampler(answer) -> str | None:
    for sampler, rescales in _STRANGERS:
        verdict = answer(sampler)
        if is_missing(verdict):
            raise NotAnswered("your function returns nothing yet")
        if not isinstance(verdict, (bool, np.bool_)):
            return f"the function returned {verdict!r}; True or False is asked for"
        if bool(verdict) != rescales:
            what = "does not rescale, and passed" if verdict else "rescales, and was refused"
            return (
                f"a sampler of the five {what}; take an exact denoiser of wide data, some 8 steps "
                "or more, and look at the spread of the samples"
            )
    return None


def _blind_network(answer) -> str | None:
    sigmas = _SCHEDULE.grid(8)
    second = [step(sigmas[0], 0.3, *sigmas[:2]) for step in (ddim_step, ddim_step_literal)]
    if np.shape(answer) != (3,):
        return "three numbers are asked for"
    if not agree(answer[:2], second, rtol=0.01):
        return "what a network is shown second is what the first step returned; write it out"
    if not agree(answer[2], 0.0, atol=1e-6):
        return "what does the last step, to sigma = 0, return?"
    return None


CHECKS = {
    "10.a": _mended_step,
    "10.b": _spread_left,
    "10.c": _telling_width,
    "10.d": _test_of_a_sampler,
    "10.e": _blind_network,
}
"""Number -> function of the answer that returns None if it is right, else a hint."""
