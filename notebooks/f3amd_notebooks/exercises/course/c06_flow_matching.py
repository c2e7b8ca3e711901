"""Exercises of the course's notebook 06: the velocity of the straight path, and how long its lines are."""

from __future__ import annotations

import numpy as np
from f3amd_lib.diffusion.oracles import GaussianMixture

from f3amd_notebooks.exercises.judging import (
    FLOAT32,
    OTHER_ORDER,
    NotAnswered,
    agree,
    normal_quantiles,
    numbers,
    reordered,
    too,
)


def _velocity(answer) -> str | None:
    mixture = GaussianMixture([[-1.0, 0.0], [1.5, 0.5]], width=0.4, weights=[0.3, 0.7])
    z = np.random.default_rng(0).standard_normal((40, 2))
    for t in (0.2, 0.5, 0.9):
        right = (mixture.denoise(z / t, (1 - t) / t) - z) / (1 - t)
        found = answer(mixture.denoise, z.copy(), t)
        if agree(found, right, **FLOAT32):
            continue
        if agree(found, -right, **FLOAT32):
            return "this leads back to the noise; time runs from noise to data, as x0 - eps does"
        if agree(found, (mixture.denoise(z, 1 - t) - z) / (1 - t), **FLOAT32):
            return "D is shown z at the level 1 - t; of x = z / t the level is another one"
        if agree(found, (mixture.denoise(z, (1 - t) / t) - z) / (1 - t), **FLOAT32):
            return "the level is right, but D is shown z itself, and not the state x0 + sigma eps"
        if agree(found, (1 - t) * right, **FLOAT32):
            return "this is the way that is left, D - z; the time that is left for it is 1 - t"
        return f"at t = {t:g} the velocity is another one; it leads from z to D within the time that is left"
    return None


def _lengths(answer) -> str | None:
    noise = normal_quantiles(4000)[:, None]
    far = 1e5
    for s in (0.3, 1.0, 2.5):
        ends = GaussianMixture([0.0], width=s).flow(np.hypot(far, s) * noise, far, 0.0)
        # By chance: every noise with every end.
        right = np.mean(ends**2) + np.mean(noise**2), np.mean((ends - noise) ** 2)
        found = numbers(answer(s))
        if found.shape != (2,):
            raise NotAnswered("return two numbers: by chance, and after one reflow")
        if reordered(found, right, rtol=0.01, atol=0.005):
            return f"{OTHER_ORDER}: by chance comes first, which makes longer lines"
        for name, value, expected in zip(("by chance", "after one reflow"), found, right, strict=True):
            if not agree(value, expected, rtol=0.01, atol=0.005):
                return (
                    f"at s = {s:g} the mean square length {name} is {too(value, expected)}; variances of independent "
                    "numbers add, and the flow multiplies every noise by one number"
                )
    return None


CHECKS = {"C6.a": _velocity, "C6.b": _lengths}
"""By number, a function of the answer that returns None if it is right, else a hint."""
