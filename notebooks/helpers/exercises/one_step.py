"""Exercises of notebook 11: what one step returns, and where a mean is not enough."""

from __future__ import annotations

import jax
import numpy as np
from f3amd_lib.diffusion.oracles import GaussianMixture
from f3amd_lib.diffusion.samplers import sample
from f3amd_lib.diffusion.schedules import variance_exploding
from scipy.optimize import brentq

from helpers.bimodal_paths import BimodalPaths, crossing, outcome_shares
from helpers.exercises.judging import agree, normal_quantiles


def _unequal_ways(answer) -> str | None:
    walkers = GaussianMixture([-1, 1], width=0.1, weights=[0.3, 0.7])
    sigma = variance_exploding().sigma_max
    x_noisy = sigma * normal_quantiles(2000)[:, None]
    if agree(answer, walkers.denoise(x_noisy, sigma).mean(), atol=0.02):
        return None
    return "one step does not vote: it returns a mean, in which every walker counts"


def _errors_of_two(answer) -> str | None:
    if np.shape(answer) != (2,):
        return "two numbers are asked for, in centimetres"
    if not agree(answer[0], np.sqrt(5.0**2 - 3.0**2), rtol=0.01):
        return "variances add, deviations do not: what is left open and what is answered make the data"
    if not agree(answer[1], 5.0, rtol=0.01):
        return "a network that ignores its input has one answer; which is best, and how far off is it?"
    return None


def _share_left_open(sigma: float, half: float, width: float) -> float:
    """Return the deviation left open at sigma over that of the data, ways at -half and half."""
    # By symmetry all clean values may lie in one of the ways.
    clean = half + width * normal_quantiles(100)
    noisy = clean[:, None] + sigma * normal_quantiles(1000)
    answers = GaussianMixture([-half, half], width=width).denoise(noisy[..., None], sigma)[..., 0]
    return float(np.sqrt(np.mean((answers - clean[:, None]) ** 2)) / np.hypot(half, width))


def _half_left_open(answer) -> str | None:
    sigma = float(answer)
    if not sigma > 0:
        return "a noise level is a positive number"
    level = brentq(lambda level: _share_left_open(level, 2.0, 0.1) - 0.5, 0.1, 50.0)
    if agree(sigma, level, rtol=0.05):
        return None
    return f"at this level {_share_left_open(sigma, 2.0, 0.1):.0%} of the deviation is left open"


def _four_levels(answer) -> str | None:
    levels = np.asarray(answer, np.float32)
    if levels.shape != (4,):
        return "four levels are asked for"
    if levels[0] != 128.0 or not (np.diff(levels) < 0).all() or not levels[-1] > 0:
        return "the first level is 128, each of the others is lower than the one before, none is 0"
    data = BimodalPaths()
    unknown = np.zeros(400, int)
    x_init = levels[0] * jax.random.normal(jax.random.key(0), (400, data.num_frames, 2))
    denoise = lambda x, sigma: data.denoise(x, sigma, unknown)
    ends = sample("ddim", denoise, x_init, np.append(levels, 0.0))
    share = outcome_shares(data, ends)["wall"]
    if share < 0.05:
        return None
    return f"with these levels {share:.0%} hit the wall; put them where the side is decided"


def _how_right(answer) -> str | None:
    data = BimodalPaths()
    left, _ = crossing(data.mean_paths)
    # The mean path crosses at q left + (1 - q) right, and right = -left.
    enough = 0.5 * (1.0 + data.wall / left)
    if agree(answer, enough, atol=0.01):
        return None
    return "the mean path crosses at q times one side plus 1 - q times the other; where ends the wall?"


CHECKS = {
    "11.a": _unequal_ways,
    "11.b": _errors_of_two,
    "11.c": _half_left_open,
    "11.d": _four_levels,
    "11.e": _how_right,
}
"""Number -> function of the answer that returns None if it is right, else a hint."""
