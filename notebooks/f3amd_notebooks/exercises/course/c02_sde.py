"""Exercises of the course's notebook 02: steps with fresh noise."""

from __future__ import annotations

import numpy as np
from f3amd_lib.diffusion import samplers
from f3amd_lib.diffusion.oracles import GaussianMixture

from f3amd_notebooks.exercises.judging import FLOAT32, OTHER_ORDER, agree, read, reordered, too


def _eta_step(answer) -> str | None:
    rng = np.random.default_rng(0)
    x, x0_hat, noise = rng.standard_normal((3, 40, 2))
    for sigma, lower, eta in ((3.0, 2.5, 0.6), (2.0, 0.5, 1.0), (2.0, 0.5, 0.0), (0.5, 0.0, 0.6)):
        up = eta * lower / sigma * np.sqrt(sigma**2 - lower**2)
        down = np.sqrt(lower**2 - up**2)
        at = lambda down, up, sigma=sigma: x0_hat + down / sigma * (x - x0_hat) + up * noise
        expected = at(down, up)
        found = answer(x.copy(), x0_hat.copy(), sigma, lower, eta, noise.copy())
        if agree(found, expected, **FLOAT32):
            continue
        if agree(found, at(lower, up), **FLOAT32):
            return "there is too much noise at the end: go down below sigma_next first, so that variances add up to it"
        if agree(found, at(lower, 0.0), **FLOAT32):
            return "this is DDIM's step whatever eta is: the fresh noise is missing"
        if agree(found, at(lower - up, up), **FLOAT32):
            return "deviations do not add, variances do: sigma_down is no difference of levels"
        if agree(found, at(down, 0.0), **FLOAT32):
            return "the step goes down far enough, but the fresh noise is not added"
        if agree(found, at(down, 1.0), **FLOAT32):
            return "the fresh noise is of deviation 1; multiply it by sigma_up"
        if agree(found, at(down * sigma, up), **FLOAT32):
            return "x - x0_hat is the noise times sigma, and not yet the noise: divide by sigma"
        wide = eta * np.sqrt(sigma**2 - lower**2)
        if wide <= lower and agree(found, at(np.sqrt(lower**2 - wide**2), wide), **FLOAT32):
            return "sigma_up has a factor sigma' / sigma, which is missing"
        return (
            f"from {sigma:g} to {lower:g} at eta = {eta:g} the state ends elsewhere; sigma_down^2 + sigma_up^2 "
            "is sigma_next^2"
        )
    return None


def _two_variances(answer) -> str | None:
    asked = "three numbers are asked for: with the smaller variance, with the larger one, as it should be"
    found = read(answer, (3,), asked)
    data, sigma, lower = GaussianMixture([0.0], width=1.0), 2.0, 1.0
    # The step is linear in the state: what the state 1 becomes shows its factor.
    state = np.ones((1, 1))
    kept = float(samplers.ddpm_step(state, data.denoise(state, sigma), sigma, lower, 0.0)[0, 0])
    old = kept**2 * (sigma**2 + 1.0)
    gained = sigma**2 - lower**2
    small, large = (lower / sigma) ** 2 * gained, (1 + lower**2) / (1 + sigma**2) * gained
    if reordered(found, (old + small, old + large, 1.0 + lower**2), rtol=0.01):
        return f"{OTHER_ORDER}: smaller variance, larger variance, as it should be"
    if agree(found[1], old + gained, rtol=0.01):
        return "the larger is Ho et al.'s, in units of sigma (1 + sigma'^2) / (1 + sigma^2) of what the level loses"
    for name, value, right in zip(
        ("with the smaller variance x'", "with the larger variance x'", "what x' should have"),
        found,
        (old + small, old + large, 1.0 + lower**2),
        strict=True,
    ):
        if not agree(value, right, rtol=0.01):
            return (
                f"{name}: this is {too(value, right)}; the state is x = x0 + 2 noise, of variance 5, the step "
                "multiplies it by one factor, and fresh noise is added"
            )
    return None


CHECKS = {"C2.a": _eta_step, "C2.b": _two_variances}
"""By number, a function of the answer that returns None if it is right, else a hint."""
