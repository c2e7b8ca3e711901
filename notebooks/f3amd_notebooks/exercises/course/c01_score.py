"""Exercises of the course's notebook 01: what a denoiser knows, and what a flow carries."""

from __future__ import annotations

import numpy as np
from f3amd_lib.diffusion import samplers
from f3amd_lib.diffusion.oracles import GaussianMixture
from scipy.special import ndtr

from f3amd_notebooks.exercises.judging import FLOAT32, OTHER_ORDER, NotAnswered, agree, numbers, too

_PAIR = GaussianMixture([-1.0, 1.0], width=0.3, weights=[0.4, 0.6])


def _three_readings(answer) -> str | None:
    for x, sigma in ((np.array([0.4, -2.0, 3.0]), 0.7), (np.array([5.0, 0.1, -1.0]), 4.0)):
        x0_hat = _PAIR.denoise(x[:, None], sigma)[:, 0]
        score = _PAIR.score(x[:, None], sigma)[:, 0]
        found = answer(x.copy(), x0_hat.copy(), sigma)
        if numbers(found).shape != (3, 3):
            raise NotAnswered("return three things of the shape of x: score, noise, velocity")
        found = numbers(found)
        noise = samplers.probability_flow_slope(x, x0_hat, sigma)
        if agree(found[0], noise, **FLOAT32) and any(agree(other, score, **FLOAT32) for other in found[1:]):
            return f"{OTHER_ORDER}: score, noise, velocity"
        if agree(found[0], -score, **FLOAT32):
            return "the score points to where data are more likely, which is towards the guess, not away from it"
        if not agree(found[0], score, **FLOAT32):
            return "the score is not yet right: Tweedie's formula is D = x + sigma^2 score; solve it"
        if not agree(found[1], noise, **FLOAT32):
            return "the noise is not yet right: solve x = x0 + sigma noise with the guess in the place of x0"
        if not agree(found[2], noise, **FLOAT32):
            return "the velocity is not yet right: it is -sigma times the score; put Tweedie's formula in"
    return None


def _box(answer) -> str | None:
    inside = lambda a, b, s: (
        _PAIR.weights
        @ (ndtr((b - _PAIR.means[:, 0]) / np.hypot(0.3, s)) - ndtr((a - _PAIR.means[:, 0]) / np.hypot(0.3, s)))
    )
    for a, b, sigma in ((0.7, 1.3, 0.5), (-0.4, 0.3, 0.5), (2.0, 6.0, 3.0)):
        right = (inside(a, b, sigma + 1e-5) - inside(a, b, sigma - 1e-5)) / 2e-5
        walls = np.array([[a], [b]])
        both = np.exp(_PAIR.log_density(walls, sigma)) @ (walls - _PAIR.denoise(walls, sigma))[:, 0] / sigma
        found = float(numbers(answer(_PAIR, a, b, sigma)).reshape(()))
        if agree(found, right, rtol=1e-3, atol=1e-6):
            continue
        if agree(found, -right, rtol=1e-3, atol=1e-6):
            return "the size is right, but what flows to the right at a comes in, and at b it goes out"
        if agree(abs(found), abs(both), rtol=1e-3, atol=1e-6):
            return "both walls have the same sign here: what flows to the right comes in at a, and goes out at b"
        return (
            f"for [{a:g}, {b:g}] at sigma = {sigma:g} the rate is {too(found, right)}; through a wall flows density "
            "times velocity, and the velocity is (x - D) / sigma"
        )
    return None


CHECKS = {"C1.a": _three_readings, "C1.b": _box}
"""By number, a function of the answer that returns None if it is right, else a hint."""
