"""What the checks of several exercises share: reading an answer, comparing it, exact samples."""

from __future__ import annotations

import numpy as np
from f3amd_lib.diffusion import samplers
from scipy.stats import norm

FLOAT32 = {"rtol": 1e-4, "atol": 1e-4}
"""Tolerance for what a reader's function computes: JAX works in float32, and is right to."""


class NotAnswered(ValueError):
    """There is no answer to judge yet; the message is the hint."""


def is_missing(answer) -> bool:
    """Return whether an answer, or a part of it, is still that of a stub: None or `...`."""
    if isinstance(answer, (tuple, list)):
        return any(map(is_missing, answer))
    return answer is None or answer is ...


def numbers(answer) -> np.ndarray:
    """Return what a reader's function gave as an array of float64.

    Raises:
      NotAnswered: for None or `...`, which a stub's function returns.
      TypeError, ValueError: if the answer is made of something else than numbers.
    """
    if is_missing(answer):
        raise NotAnswered("your function returns nothing yet")
    return np.asarray(answer, dtype=np.float64)


def read(answer, shape: tuple[int, ...], asked: str) -> np.ndarray:
    """Return an answer that is made of numbers, as float64 of the shape asked for.

    A single number may come alone, from NumPy or JAX, or in an array of one.

    Args:
      answer: the reader's.
      shape: of what is asked for, () for a single number.
      asked: what is asked for, as a hint.

    Raises:
      NotAnswered: for another shape, for what is no number, or for numbers that are not finite.
    """
    try:
        found = np.asarray(answer, dtype=np.float64)
    except (TypeError, ValueError):
        raise NotAnswered(asked) from None
    if shape == () and found.size == 1:
        found = found.reshape(())
    if found.shape != shape or not np.isfinite(found).all():
        raise NotAnswered(asked)
    return found


def too(found, expected) -> str:
    """Say on which side of the right number a wrong one lies."""
    return "too large" if found > expected else "too small"


def agree(answer, expected, *, rtol: float = 0.0, atol: float = 0.0) -> bool:
    """Return whether an answer has the shape and, within a tolerance, the values expected.

    Args:
      answer: a number, or a list or array of them; refused as by `numbers`.
      expected: likewise.
      rtol, atol: relative and absolute tolerance; an entry may differ by atol + rtol |expected|.
    """
    answer = numbers(answer)
    return answer.shape == np.shape(expected) and np.allclose(answer, expected, rtol, atol)


OTHER_ORDER = "these are the right numbers, but not in the order that is asked for"


def reordered(found, expected, **tolerance) -> bool:
    """Return whether an answer has the numbers expected, and has them in another order; tolerance as for `agree`."""
    in_order = agree(found, expected, **tolerance)
    return not in_order and agree(np.sort(found, axis=None), np.sort(expected, axis=None), **tolerance)


def normal_quantiles(count: int) -> np.ndarray:
    """Return evenly spaced quantiles of the normal distribution, [count]: noise without chance."""
    return norm.ppf((np.arange(count) + 0.5) / count)


def sample(sampler: str, denoise, x_init, sigmas) -> np.ndarray:
    """Return where a sampler of the library ends, in float64."""
    return np.asarray(samplers.sample(sampler, denoise, x_init, sigmas))
