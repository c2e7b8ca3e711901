"""Exercises of the course's notebook 07: guided guesses, and what a guided flow makes of a Gaussian."""

from __future__ import annotations

import numpy as np
from f3amd_lib.diffusion.oracles import GaussianMixture
from f3amd_lib.diffusion.predictions import guided

from f3amd_notebooks.exercises.judging import FLOAT32, OTHER_ORDER, NotAnswered, agree, numbers, reordered, too


def _guided_guess(answer) -> str | None:
    crowd = GaussianMixture([[-1.0, 0.0], [1.5, 0.5]], width=0.4)
    told = GaussianMixture([[1.5, 0.5]], width=0.4)
    x = np.random.default_rng(0).standard_normal((40, 2))
    for sigma, w in ((0.5, 3.0), (2.0, 7.5), (1.0, 1.0), (0.7, 0.0)):
        guesses = told.denoise(x, sigma), crowd.denoise(x, sigma)
        noises = [(x - guess) / sigma for guess in guesses]
        at = lambda scale, pair=guesses: pair[1] + scale * (pair[0] - pair[1])
        found = answer(x.copy(), sigma, *(noise.copy() for noise in noises), w)
        if agree(found, at(w), **FLOAT32):
            continue
        if agree(found, at(w + 1.0), **FLOAT32):
            return "this is MotionPCM's count, which obeys at 0; here w = 1 obeys, and w = 0 forgets the condition"
        if agree(found, at(1.0 - w), **FLOAT32):
            return "told and free are exchanged: w leads away from the condition"
        if agree(found, at(w, noises), **FLOAT32):
            return "this is the guided noise; the guess of the clean data is asked for"
        if agree(found, x - at(w, noises), **FLOAT32):
            return "the noise in x is sigma times as large as the guess of a network"
        if agree(found, x + sigma * at(w, noises), **FLOAT32):
            return "the noise is added once more; it is to be taken away"
        return f"at sigma = {sigma:g} and w = {w:g} the guess is another one; w = 1 is the told one, w = 0 the free one"
    return None


def _widths(answer) -> str | None:
    for s, wide, w in ((0.5, 1.0, 1.0), (0.5, 1.0, 3.0), (0.8, 2.0, 7.5)):
        found = numbers(answer(s, wide, w))
        if found.shape != (2,):
            raise NotAnswered("return two numbers: of the tilted density, and of the guided samples")
        told, crowd = GaussianMixture([0.7], width=s), GaussianMixture([0.0], width=wide)
        right = _tilted(told, crowd, w), _guided(told, crowd, w)
        if reordered(found, right, rtol=0.01):
            return f"{OTHER_ORDER}: of the tilted density, then of the guided samples"
        for name, value, expected in zip(("tilted density", "guided samples"), found, right, strict=True):
            if not agree(value, expected, rtol=0.01):
                return (
                    f"at s = {s:g}, S = {wide:g}, w = {w:g} the width of the {name} is {too(value, expected)}; "
                    "in a product of Gaussians precisions add, and in a linear flow every gap shrinks by the same rate"
                )
    return None


def _tilted(told: GaussianMixture, crowd: GaussianMixture, w: float) -> float:
    """Width of p(x)^(1 - w) p(x | c)^w, by adding it up over a grid."""
    x = np.linspace(-20.0, 20.0, 40_001)[:, None]
    log = (1.0 - w) * crowd.log_density(x) + w * told.log_density(x)
    share = np.exp(log - log.max())
    share /= share.sum()
    return float(np.sqrt(share @ x[:, 0] ** 2 - (share @ x[:, 0]) ** 2))


def _guided(told: GaussianMixture, crowd: GaussianMixture, w: float) -> float:
    """Width of the samples of the guided flow, which is linear: of two points one deviation apart, by Heun's method."""
    denoise = guided(told.denoise, crowd.denoise, w)
    grid = np.geomspace(1e4, 1e-3, 600)
    x = grid[0] * np.array([[0.0], [1.0]])
    for sigma, lower in zip(grid[:-1], grid[1:], strict=True):
        slope = (x - denoise(x, sigma)) / sigma
        there = x + (lower - sigma) * slope
        x = x + (lower - sigma) * 0.5 * (slope + (there - denoise(there, lower)) / lower)
    return float(x[1, 0] - x[0, 0])


CHECKS = {"C7.a": _guided_guess, "C7.b": _widths}
"""By number, a function of the answer that returns None if it is right, else a hint."""
