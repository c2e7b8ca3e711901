"""One code for numpy and JAX, and one check of the arrays that people hand in."""

from __future__ import annotations

import importlib
import sys

import numpy as np


class _Later:
    """A module that is imported when something of it is asked for: what does without it runs where it is missing."""

    def __init__(self, name: str):
        self._name = name

    def __getattr__(self, word: str):
        return getattr(importlib.import_module(self._name), word)


jax, jnp = _Later("jax"), _Later("jax.numpy")


def array_module(*arrays):
    """Return `jax.numpy` if any argument is a JAX array (or tracer), else `numpy`."""
    loaded = sys.modules.get("jax")
    return loaded.numpy if loaded and any(isinstance(array, loaded.Array) for array in arrays) else np


def exact_products():
    """Return a context for products of rotations and metres: float32 on a GPU too, where JAX rounds to 10 bits."""
    return jax.default_matmul_precision("float32")


def in_batches(function, count: int, size: int):
    """Return what a function makes of many rows, asked for a fixed number at a time.

    So there is one compilation, and a row depends on itself alone.

    Args:
      function: of row numbers [size], the last batch filled up with others; returns arrays [size, ...], or a tree.
      count: rows in all, at least one.
      size: rows at a time.

    Returns:
      Numpy arrays [count, ...], or a tree of them.
    """
    batches = (np.arange(first, first + size) % count for first in range(0, count, size))
    parts = [jax.tree.map(np.asarray, function(rows)) for rows in batches]
    return jax.tree.map(lambda *leaves: np.concatenate(leaves)[:count], *parts)


def finite_array(name: str, value, shape: tuple, dtype=np.float64) -> np.ndarray:
    """Return a value as an array of a shape, all of it finite.

    Args:
      name: what messages call it.
      value: anything that numpy takes for an array.
      shape: lengths; a word such as "frame" stands for any length above 0.
      dtype: wanted; None keeps the value's own.

    Raises:
      ValueError: for another shape, or naming the first place of a number that is not finite.
    """
    array = np.asarray(value, dtype)
    pairs = list(zip(shape, array.shape, strict=False))
    fits = all(length > 0 if isinstance(wanted, str) else length == wanted for wanted, length in pairs)
    if array.ndim != len(shape) or not fits:
        raise ValueError(f"{name} must be [{', '.join(map(str, shape))}] with no length 0, got {array.shape}")
    if not np.isfinite(array).all():
        place = np.argwhere(~np.isfinite(array))[0].tolist()
        words = [f"{wanted} {number}" for wanted, number in zip(shape, place, strict=True) if isinstance(wanted, str)]
        raise ValueError(f"{name} is not finite at {', '.join(words) or place}")
    return array
