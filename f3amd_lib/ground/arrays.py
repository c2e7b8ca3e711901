"""One code for numpy and JAX, and one check of the arrays that people hand in."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np


def array_module(*arrays):
    """Return `jax.numpy` if any argument is a JAX array (or tracer), else `numpy`."""
    return jnp if any(isinstance(array, jax.Array) for array in arrays) else np


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
