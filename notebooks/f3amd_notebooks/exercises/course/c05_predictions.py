"""Exercises of the course's notebook 05: what a network is asked for, and what its loss weighs."""

from __future__ import annotations

import numpy as np
from f3amd_lib.diffusion import predictions, samplers

from f3amd_notebooks.exercises.judging import OTHER_ORDER, NotAnswered, agree, numbers, reordered, too

_CASES = ((0.5, 1.0), (3.0, 0.5), (0.05, 2.0), (20.0, 0.3))
"""Noise level and deviation of the data."""


def _preconditioning(answer) -> str | None:
    for sigma, s in _CASES:
        total = np.hypot(s, sigma)
        expected = s**2 / total**2, s * sigma / total, 1 / total
        found = numbers(answer(sigma, s))
        if found.shape != (3,):
            raise NotAnswered("return three numbers: c_skip, c_out, c_in")
        if reordered(found, expected, rtol=1e-4):
            return f"{OTHER_ORDER}: c_skip, c_out, c_in"
        if agree(found, (sigma**2 / total**2, *expected[1:]), rtol=1e-4):
            return "with little noise D is nearly x itself, and c_skip nearly 1; yours is the other share"
        if agree(-found[1], expected[1], rtol=1e-4):
            return "c_out is asked for with a positive sign"
        for name, value, right in zip(("c_skip", "c_out", "c_in"), found, expected, strict=True):
            if not agree(value, right, rtol=1e-4):
                return (
                    f"{name} is {too(value, right)} at sigma = {sigma:g}, s = {s:g}; variances add, x has "
                    "s^2 + sigma^2, and c_out^2 is the variance of x0 - c_skip x"
                )
    return None


def _weights(answer) -> str | None:
    x0, noise = np.random.default_rng(0).standard_normal((2, 200, 1))
    for sigma, s in _CASES:
        x = samplers.add_noise(x0, sigma, noise)
        # A network's answer that is off by 1: what this makes of D says what an error of D is worth.
        through = (predictions.from_noise, predictions.from_velocity)
        moved = [
            np.asarray(wrap(lambda x, sigma: 1.0 + 0.0 * x)(x, sigma) - wrap(lambda x, sigma: 0.0 * x)(x, sigma))
            for wrap in through
        ]
        expected = *(1.0 / np.mean(m**2) for m in moved), (s**2 + sigma**2) / (s * sigma) ** 2
        found = numbers(answer(sigma, s))
        if found.shape != (3,):
            raise NotAnswered("return three weights: for eps, for v, for Karras et al.")
        if reordered(found, expected, rtol=1e-3):
            return f"{OTHER_ORDER}: for eps, for v, for Karras et al."
        if agree(found, 1 / np.asarray(expected), rtol=1e-3):
            return "this is c_out^2; the loss of F is that of D divided by it"
        if agree(found**2, expected, rtol=1e-3):
            return "the loss is a square: square the factor, too"
        for name, value, right in zip(("eps", "v", "Karras et al."), found, expected, strict=True):
            if not agree(value, right, rtol=1e-3):
                return (
                    f"the weight for {name} is {too(value, right)} at sigma = {sigma:g}, s = {s:g}; what is its c_out?"
                )
    return None


CHECKS = {"C5.a": _preconditioning, "C5.b": _weights}
"""By number, a function of the answer that returns None if it is right, else a hint."""
