"""Exercises of notebook 11: what one step returns, and where a mean is not enough."""

from __future__ import annotations

import functools

import jax
import numpy as np
from f3amd_lib.diffusion.oracles import GaussianMixture
from f3amd_lib.diffusion.samplers import walk
from f3amd_lib.diffusion.schedules import variance_exploding
from scipy.optimize import brentq

from f3amd_notebooks.bimodal_paths import UNKNOWN, BimodalPaths, crossing, outcome_shares
from f3amd_notebooks.exercises.judging import OTHER_ORDER, agree, normal_quantiles, read, reordered, too


def _unequal_ways(answer) -> str | None:
    place = read(answer, (), "one number is asked for, the mean of the samples")
    walkers = GaussianMixture([-1, 1], width=0.1, weights=[0.3, 0.7])
    sigma = variance_exploding().sigma_max
    mean = walkers.denoise(sigma * normal_quantiles(2000)[:, None], sigma).mean()
    if agree(place, mean, atol=0.02):
        return None
    return f"this is {too(place, mean)}; one step does not vote: it returns a mean, in which every walker counts"


def _errors_of_two(answer) -> str | None:
    exact, blind = read(answer, (2,), "two numbers are asked for, in centimetres")
    right = np.sqrt(5.0**2 - 3.0**2)
    if reordered((exact, blind), (right, 5.0), rtol=0.01):
        return f"{OTHER_ORDER}: the exact denoiser's comes first"
    if not agree(exact, right, rtol=0.01):
        return (
            f"the exact denoiser's error is {too(exact, right)}; variances add, deviations do not: the answers' "
            "variance and that of the error make the data's"
        )
    if not agree(blind, 5.0, rtol=0.01):
        return (
            f"the other network's error is {too(blind, 5.0)}; a network that ignores its input has one answer; "
            "which is best, and how far off is it?"
        )
    return None


def _posterior_share(sigma: float, half: float, width: float) -> float:
    """Return the posterior deviation at sigma over the data's deviation, modes at -half and half."""
    # By symmetry all clean values may lie in one of the modes.
    clean = half + width * normal_quantiles(100)
    noisy = clean[:, None] + sigma * normal_quantiles(1000)
    answers = GaussianMixture([-half, half], width=width).denoise(noisy[..., None], sigma)[..., 0]
    return float(np.sqrt(np.mean((answers - clean[:, None]) ** 2)) / np.hypot(half, width))


@functools.cache
def _level_of_half() -> float:
    """Return the noise level at which the posterior deviation is half of the data's, modes at -2 and 2."""
    return brentq(lambda sigma: _posterior_share(sigma, 2.0, 0.1) - 0.5, 0.1, 50.0)


def _half_of_the_deviation(answer) -> str | None:
    sigma = read(answer, (), "one number is asked for, a noise level")
    if not sigma > 0:
        return "a noise level is a positive number"
    level = _level_of_half()
    if agree(sigma, level, rtol=0.05):
        return None
    share = _posterior_share(sigma, 2.0, 0.1)
    return f"this level is {too(sigma, level)}: the posterior deviation there is {share:.0%} of the data's"


@jax.jit
def _denoise_unknown(x_noisy, sigma):
    """The exact clean estimate of paths whose side nobody tells."""
    return BimodalPaths().denoise(x_noisy, sigma, np.full(len(x_noisy), UNKNOWN))


def _four_levels(answer) -> str | None:
    levels = read(answer, (4,), "four levels are asked for").astype(np.float32)
    if levels[0] != 128.0 or not (np.diff(levels) < 0).all() or not levels[-1] > 0:
        return "the first level is 128, each of the others is lower than the one before, none is 0"
    data = BimodalPaths()
    x_init = levels[0] * jax.random.normal(jax.random.key(0), (2000, data.num_frames, 2))
    *_, end = walk("ddim", _denoise_unknown, x_init, np.append(levels, 0.0))
    ends = np.asarray(end.x_noisy)
    if not np.isfinite(ends).all():
        return "a level is so low that float32 has no room for it"
    share = outcome_shares(data, ends)["wall"]
    if share >= 0.05:
        return f"with these levels {share:.1%} hit the wall, fewer than 5 % may; put them where the side is decided"
    place = np.abs(crossing(ends))
    passed = place[place >= data.wall].mean()
    wanted = crossing(data.mean_paths)[0]
    if abs(passed - wanted) > 0.15:
        return (
            f"{share:.1%} hit the wall, but the others pass at {passed:.2f} m, the data at {wanted:.2f} m; "
            "at levels below those where the side is decided the denoiser hardly moves a walker any more"
        )
    return None


def _how_right(answer) -> str | None:
    share = read(answer, (), "one number is asked for, a probability between 0 and 1")
    if not 0 <= share <= 1:
        return "a probability lies between 0 and 1"
    data = BimodalPaths()
    left, _ = crossing(data.mean_paths)
    # The mean path crosses at q left + (1 - q) right, and right = -left.
    enough = 0.5 * (1.0 + data.wall / left)
    if agree(share, enough, atol=0.01):
        return None
    return (
        f"this is {too(share, enough)}; the mean path crosses at q times one side plus 1 - q times the other; "
        "where does the wall end?"
    )


CHECKS = {
    "11.a": _unequal_ways,
    "11.b": _errors_of_two,
    "11.c": _half_of_the_deviation,
    "11.d": _four_levels,
    "11.e": _how_right,
}
"""By number, a function of the answer that returns None if it is right, else a hint."""
