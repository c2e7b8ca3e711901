"""Exercises of the course's notebook 09: how a density changes along the flow, and how much one probe errs."""

from __future__ import annotations

from itertools import product

import numpy as np
from f3amd_lib.diffusion.oracles import GaussianMixture

from f3amd_notebooks.exercises.judging import FLOAT32, NotAnswered, agree, numbers, reordered, too

_MIXTURE = GaussianMixture([[-1.0, 0.0], [1.5, 0.5], [0.3, -1.2]], width=0.4, weights=[0.3, 0.5, 0.2])


def _two_rates(answer) -> str | None:
    for place, sigma in (([0.2, 0.3], 0.6), ([2.0, -1.0], 1.5), ([-8.0, 3.0], 9.0)):
        x = np.array(place)
        x0_hat, step = _MIXTURE.denoise(x, sigma), 1e-5
        ahead, behind = (_MIXTURE.denoise(x + move * np.eye(2), sigma) for move in (step, -step))
        velocity, jacobian = (x - x0_hat) / sigma, (ahead - behind).T / (2 * step)
        ahead, behind = (_MIXTURE.log_density(x + move * velocity, sigma + move) for move in (step, -step))
        rate = (ahead - behind) / (2 * step)
        found = answer(x.copy(), x0_hat.copy(), jacobian.copy(), sigma)
        if not isinstance(found, (tuple, list)) or len(found) != 2:
            raise NotAnswered("return two things: dx/dsigma, and the rate of the log-density")
        slope, change = numbers(found[0]), numbers(found[1])
        if change.size != 1:
            raise NotAnswered("the second rate is one number")
        change = change.reshape(())
        if agree(slope, -velocity, **FLOAT32):
            return "this velocity leads down to the data; sigma grows, so the point moves away from the guess"
        if not agree(slope, velocity, **FLOAT32):
            return "the velocity is not yet right: it is the guessed noise, see C1.a"
        if agree(change, rate, **FLOAT32):
            continue
        if agree(change, -rate, **FLOAT32):
            return "this is the divergence, the rate at which volume grows; what happens to the density meanwhile?"
        if agree(change / sigma, rate, **FLOAT32):
            return "this is the rate for each unit of log sigma"
        if agree(change, np.trace(jacobian) / sigma, **FLOAT32):
            return "x itself has a divergence too: one for each dimension"
        if agree(change, -(1 - np.trace(jacobian)) / sigma, **FLOAT32):
            return "the divergence of x is its number of dimensions, not 1"
        return (
            f"at sigma = {sigma:g} the log-density changes at another rate, yours is {too(change, rate)}; "
            "take the divergence of the velocity, and only of the velocity"
        )
    return None


_MATRICES = (
    np.array([[2.0, 0.5], [0.5, -1.0]]),
    np.array([[1.0, 0.3, 0.0], [0.3, 0.4, -2.0], [0.0, -2.0, 3.0]]),
    np.diag([3.0, 1.0, 2.0]),
)
# Three nodes of Gauss and Hermite: moments of a normal number up to the fifth are exact, and a square of ξ J ξ
# asks for the fourth.
_NODES, _WEIGHTS = np.array([-np.sqrt(3), 0.0, np.sqrt(3)]), np.array([1, 4, 1]) / 6


def _deviation(matrix: np.ndarray, nodes, weights) -> float:
    """Standard deviation of ξ J ξ for independent entries of ξ with these values and weights, by all combinations."""
    size = len(matrix)
    xi = np.array(list(product(nodes, repeat=size)))
    weight = np.prod(list(product(weights, repeat=size)), axis=1)
    values = np.einsum("ni,ij,nj->n", xi, matrix, xi)
    return float(np.sqrt(weight @ values**2 - (weight @ values) ** 2))


def _one_probe(answer) -> str | None:
    for matrix in _MATRICES:
        signs = _deviation(matrix, [-1.0, 1.0], [0.5, 0.5])
        normal = _deviation(matrix, _NODES, _WEIGHTS)
        found = numbers(answer(matrix.copy()))
        if found.shape != (2,):
            raise NotAnswered("return two numbers: with random signs, and with a normal probe")
        right = np.array([signs, normal])
        if reordered(found, right, rtol=1e-3, atol=1e-6):
            return "these are the two, but in the other order: for a diagonal matrix random signs make no error"
        if agree(found, right**2, rtol=1e-3, atol=1e-6):
            return "these are the variances; the standard deviation is asked for"
        if agree(found, right / np.sqrt(2), rtol=1e-3, atol=1e-6):
            return (
                "a factor is missing: J_ij and J_ji come with the same product of entries, and add before "
                "they are squared"
            )
        for name, value, expected in zip(("random signs", "a normal probe"), found, right, strict=True):
            if not agree(value, expected, rtol=1e-3, atol=1e-6):
                return (
                    f"with {name} the spread is {too(value, expected)}, for the matrix {matrix.tolist()}; multiply "
                    "ξ J ξ out, and ask of each product of entries how much it varies: the square of a sign is always 1"
                )
    return None


CHECKS = {"C9.a": _two_rates, "C9.b": _one_probe}
"""By number, a function of the answer that returns None if it is right, else a hint."""
