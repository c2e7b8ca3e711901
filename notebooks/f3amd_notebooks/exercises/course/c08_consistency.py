"""Exercises of the course's notebook 08: where a Gaussian's paths come to, and what a student is taught."""

from __future__ import annotations

import numpy as np
from f3amd_lib.diffusion.oracles import GaussianMixture
from f3amd_lib.diffusion.samplers import ddim_step

from f3amd_notebooks.exercises.judging import FLOAT32, agree


def _gaussian_map(answer) -> str | None:
    x = np.linspace(-2.0, 2.0, 9)
    for s, sigma, edge in ((0.5, 3.0, 0.2), (2.0, 1.0, 0.5), (0.7, 2.0, 0.0)):
        data = GaussianMixture([0.0], width=s)
        right = data.flow(x[:, None], sigma, edge)[:, 0]
        guess = data.denoise(x[:, None], sigma)[:, 0]
        found = answer(x.copy(), sigma, edge, s)
        if agree(found, right, **FLOAT32):
            continue
        if agree(found, guess + edge / sigma * (x - guess), **FLOAT32):
            return "this is one step of DDIM, which goes straight on; the path bends"
        if agree(found, guess, **FLOAT32):
            return "this is the best guess of the data, a mean; the path leads to one place at the edge"
        if agree(found, data.flow(x[:, None], sigma, 0.0)[:, 0], **FLOAT32):
            return "this is where the path ends without noise; asked is the edge, and some noise is left there"
        return f"from sigma = {sigma:g} to {edge:g} the path comes to another place; a point keeps its quantile"
    return None


def _target(answer) -> str | None:
    denoise = GaussianMixture([-1.0, 1.5], width=0.4).denoise
    student = lambda x, sigma, edge: np.tanh(x) + 0.3 * sigma + 0.1 * edge  # known to be wrong, everywhere
    x = np.linspace(-2.0, 2.0, 9)[:, None]
    for sigma, lower, edge in ((2.0, 1.5, 0.5), (0.8, 0.6, 0.1), (1.0, 0.7, 0.7)):
        neighbour = ddim_step(x, denoise(x, sigma), sigma, lower)
        right = neighbour if lower <= edge else student(neighbour, lower, edge)
        found = answer(denoise, student, x.copy(), sigma, lower, edge)
        if agree(found, right, **FLOAT32):
            continue
        if agree(found, student(neighbour, lower, edge), **FLOAT32):
            return "at the edge nothing is left to ask the student: the answer is the point itself"
        if agree(found, neighbour, **FLOAT32):
            return "this is the neighbour; before the edge the student is asked about it"
        if agree(found, student(neighbour, sigma, edge), **FLOAT32):
            return "the neighbour lies at the lower level, and the student has to be told so"
        if agree(found, student(x, lower, edge), **FLOAT32) or agree(found, student(x, sigma, edge), **FLOAT32):
            return "the student is asked about x itself; the target is its answer at the neighbour"
        guess = denoise(x, sigma)
        if agree(found, guess, **FLOAT32) or agree(found, student(guess, lower, edge), **FLOAT32):
            return "the best guess is no neighbour: the teacher steps to the lower level only"
        if any(agree(found, student(neighbour, *told), **FLOAT32) for told in ((edge, lower), (edge, edge))):
            return "the student is told the wrong levels: first that of the neighbour, then the edge"
        away = x - guess
        for wrong in (guess + sigma / lower * away, x + (lower - sigma) * away, x + lower / sigma * guess):
            if agree(found, wrong if lower <= edge else student(wrong, lower, edge), **FLOAT32):
                return "the neighbour is wrong: DDIM keeps the share lower / sigma of x - D, see C3.1"
        which = "the neighbour itself" if lower <= edge else "the student's answer at the neighbour"
        return f"from {sigma:g} to {lower:g} with the edge at {edge:g} the target is {which}, and this is another point"
    return None


CHECKS = {"C8.a": _gaussian_map, "C8.b": _target}
"""By number, a function of the answer that returns None if it is right, else a hint."""
