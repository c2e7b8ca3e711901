"""Exercises of notebook 10: the printed update, mended, followed and found out."""

from __future__ import annotations

import functools

import numpy as np
from f3amd_lib.diffusion.oracles import GaussianMixture
from f3amd_lib.diffusion.samplers import SAMPLERS, ddim_step, ddim_step_literal
from f3amd_lib.diffusion.schedules import variance_exploding

from f3amd_notebooks.exercises.judging import (
    FLOAT32,
    OTHER_ORDER,
    NotAnswered,
    agree,
    is_missing,
    normal_quantiles,
    read,
    reordered,
    sample,
    too,
)

_SCHEDULE = variance_exploding()


def _mended_step(answer) -> str | None:
    x0_hat, noise = np.random.default_rng(0).standard_normal((2, 5))
    for sigma, sigma_next in ((128.0, 82.3), (6.1, 0.4), (0.7, 0.6), (0.01, 0.0)):
        x = x0_hat + sigma * noise
        literal = ddim_step_literal(x, x0_hat, sigma, sigma_next)
        found = answer(x.copy(), x0_hat.copy(), sigma, sigma_next)
        if agree(found, ddim_step(x, x0_hat, sigma, sigma_next), **FLOAT32):
            continue
        if agree(found, literal, **FLOAT32):
            return "this is the printed line itself; which state does the network want to see?"
        if agree(found, literal * np.hypot(1, sigma), **FLOAT32):
            return "the factor is that of the level left behind; the new state is at sigma_next"
        if agree(found, literal / np.hypot(1, sigma_next), **FLOAT32):
            return "the factor goes the wrong way: the printed state is too small as it is"
        return f"from sigma = {sigma:g} to {sigma_next:g} this is not DDIM's step; write x_VE in terms of x_VP"
    return None


_WALKS = {f"{count} steps": _SCHEDULE.grid(count) for count in (2, 4, 16)} | {
    "the levels 128, 3, 1": np.array([128.0, 3.0, 1.0, 0.0])
}


def _spread_left(answer) -> str | None:
    asked = "four numbers are asked for: at 2, 4 and 16 steps, and on the levels 128, 3, 1"
    for share, (where, levels) in zip(read(answer, (4,), asked), _WALKS.items(), strict=True):
        expected = np.prod(1 / np.hypot(1, levels[1:-1]))
        if not agree(share, expected, rtol=0.05):
            return (
                f"at {where} the share is {too(share, expected)}; a step divides by a factor of the level at "
                "which it arrives: at which levels has the walk arrived before its last evaluation?"
            )
    return None


@functools.cache
def _distance_of_updates(width: float) -> float:
    """Return how far apart the updates end on average, 8 steps, one Gaussian around 0.8."""
    sigmas, denoise = _SCHEDULE.grid(8), GaussianMixture([0.8], width=width).denoise
    x_init = sigmas[0] * normal_quantiles(4000)[:, None]
    ends = [sample(name, denoise, x_init, sigmas) for name in ("ddim", "ddim_literal")]
    return float(np.abs(ends[0] - ends[1]).mean())


def _telling_width(answer) -> str | None:
    width = float(read(answer, (), "one number is asked for, the width of the data"))
    if not width > 0:
        return "a width is a positive number"
    # The distance grows with the width, so that 5 % on either side must hold 0.05 between them.
    if _distance_of_updates(width / 1.05) <= 0.05 <= _distance_of_updates(1.05 * width):
        return None
    distance = _distance_of_updates(width)
    return f"for data of this width the updates end {distance:.3f} apart, which is {too(distance, 0.05)}"


def _stranger(name: str, rescales: bool = True):
    """Return a sampler of the library in plain Python; one that does not rescale shows the network VP states."""

    def sampler(denoise, x_init, sigmas):
        kind, x, rng = SAMPLERS[name], np.asarray(x_init), np.random.default_rng(0)
        look = denoise if rescales else lambda x, sigma: denoise(x / np.hypot(1, sigma), sigma)
        for sigma, sigma_next in zip(sigmas[:-1], sigmas[1:], strict=True):
            leg = x, denoise(x, sigma), sigma, sigma_next
            if kind.last and sigma_next == 0:
                x = kind.last(*leg)
            else:
                noise = [rng.standard_normal(x.shape)] if kind.draws_noise else []
                x = kind.step(*leg, *noise, *[look] * (kind.evaluations - 1))
            x = x if rescales else x / np.hypot(1, sigma_next)
        return x

    return sampler


def _in_preserving_state(denoise, x_init, sigmas):
    """DDIM that keeps z = x / sqrt(1 + sigma^2) and shows the network z times sqrt(1 + sigma^2)."""
    size = np.hypot(1, np.asarray(sigmas))
    z = np.asarray(x_init) / size[0]
    for number, (sigma, sigma_next) in enumerate(zip(sigmas[:-1], sigmas[1:], strict=True)):
        x = z * size[number]
        z = ddim_step_literal(x, denoise(x, sigma), sigma, sigma_next)
    return z


_STRANGERS = (
    (_stranger("ddim"), True),
    (_stranger("ddim", rescales=False), False),
    (_stranger("heun"), True),
    (_stranger("heun", rescales=False), False),
    (_stranger("ddpm"), True),
    (_stranger("ddim_vp"), True),
    (_in_preserving_state, True),
)
"""Samplers, and whether each rescales. They walk in plain Python: a denoiser may note what it is shown."""


def _test_of_a_sampler(answer) -> str | None:
    for sampler, rescales in _STRANGERS:
        verdict = answer(sampler)
        if is_missing(verdict):
            raise NotAnswered("your function returns nothing yet")
        said = np.asarray(verdict)
        if said.dtype != bool or said.size != 1:
            return f"the function returned {verdict!r}; True or False is asked for"
        if bool(said) != rescales:
            what = "does not rescale, and passed" if said else "rescales, and was refused"
            return (
                f"a sampler of the {len(_STRANGERS)} {what}; take an exact denoiser of wide data, some 8 steps "
                "or more, and look at the spread of the samples"
            )
    return None


def _blind_network(answer) -> str | None:
    shown = read(answer, (3,), "three numbers are asked for")
    start, sigma, sigma_next = 128.0, *_SCHEDULE.grid(8)[:2]
    steps = (ddim_step, ddim_step_literal)
    if reordered(shown, [*(step(start, 0.3, sigma, sigma_next) for step in steps), 0.0], rtol=6e-4, atol=1e-6):
        return f"{OTHER_ORDER}: rescaled, literal, and the distance at the end"
    for name, value, step in zip(("rescaled", "literal"), shown, steps, strict=False):
        right = step(start, 0.3, sigma, sigma_next)
        if not agree(value, right, rtol=6e-4):
            if agree(value, step(start, 0.0, sigma, sigma_next), rtol=6e-4):
                return f"{name}: the network's answer, 0.3, is not in it"
            return (
                f"{name}: this is {too(value, right)}; what a network is shown second is what the first step "
                "returned: write that step out, and give four digits"
            )
    if not agree(shown[2], 0.0, atol=1e-6):
        return "the distance at the end is another; what does the last step, to sigma = 0, return?"
    return None


CHECKS = {
    "10.a": _mended_step,
    "10.b": _spread_left,
    "10.c": _telling_width,
    "10.d": _test_of_a_sampler,
    "10.e": _blind_network,
}
"""By number, a function of the answer that returns None if it is right, else a hint."""
