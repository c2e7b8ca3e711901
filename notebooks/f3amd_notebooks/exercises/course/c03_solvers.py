"""Exercises of the course's notebook 03: a multistep method, and what Euler's steps make of a Gaussian."""

from __future__ import annotations

import numpy as np
from f3amd_lib.diffusion import samplers
from f3amd_lib.diffusion.oracles import GaussianMixture

from f3amd_notebooks.exercises.judging import FLOAT32, OTHER_ORDER, NotAnswered, agree, numbers, reordered, sample, too


def _multistep(answer) -> str | None:
    x, guess, before = np.random.default_rng(0).standard_normal((3, 40, 2))
    for levels in ((2.0, 1.0, 0.5), (10.0, 4.0, 0.3), (5.0, 4.5, 1.0)):
        first, sigma, lower = levels
        ratio = np.log(sigma / lower) / np.log(first / sigma)
        step = lambda weight, sigma=sigma, lower=lower: samplers.ddim_step(
            x, guess + weight * (guess - before), sigma, lower
        )
        found = answer(x.copy(), guess.copy(), before.copy(), *levels)
        if agree(found, step(0.5 * ratio), **FLOAT32):
            continue
        if agree(found, step(0.0), **FLOAT32):
            return "this is DDIM's step: the guess before is not used yet"
        if agree(found, step(-0.5 * ratio), **FLOAT32):
            return "this leans back to the guess before; the line is to be continued in the other direction"
        if agree(found, step(0.5 / ratio), **FLOAT32):
            return "the ratio stands on its head: a long step after a short one continues the line farther"
        if agree(found, step(0.5), **FLOAT32):
            return "this is right where both steps are as long in log sigma; the ratio of their lengths is missing"
        length = np.log(sigma / lower)
        if agree(found, step(ratio * (length - 1 + lower / sigma) / (length * (1 - lower / sigma))), **FLOAT32):
            return "this takes the exact mean of the line, another solver; 2M takes the value in the middle of the step"
        if agree(found, step(ratio), **FLOAT32):
            return "this continues the line to the end of the step; its middle lies half as far"
        return f"over {first:g}, {sigma:g}, {lower:g} the state ends elsewhere; lengths of steps are in log sigma"
    return None


def _factors(answer) -> str | None:
    for s, sigmas in (
        (1.0, np.array([8.0, 2.0, 0.5, 0.1])),
        (0.3, np.geomspace(80.0, 0.01, 9)),
        (2.0, np.array([3, 1.0])),
    ):
        euler = sample("euler", GaussianMixture([0.0], width=s).denoise, np.ones((1, 1)), sigmas)[0, 0]
        exact = np.hypot(s, sigmas[-1]) / np.hypot(s, sigmas[0])
        found = numbers(answer(s, sigmas.copy()))
        if found.shape != (2,):
            raise NotAnswered("return two numbers: Euler's factor and the exact one")
        if reordered(found, (euler, exact), rtol=1e-4):
            return f"{OTHER_ORDER}: Euler's factor comes first"
        for name, value, right in (("Euler's", found[0], euler), ("the exact", found[1], exact)):
            if not agree(value, right, rtol=1e-4):
                return (
                    f"{name} factor is {too(value, right)}, at s = {s:g} from {sigmas[0]:g} to {sigmas[-1]:g}; "
                    "a step multiplies by 1 + (sigma' - sigma) (1 - D/x) / sigma; the flow keeps x over its deviation"
                )
    return None


CHECKS = {"C3.a": _multistep, "C3.b": _factors}
"""By number, a function of the answer that returns None if it is right, else a hint."""
