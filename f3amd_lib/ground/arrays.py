"""One code for numpy and JAX."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np


def array_module(*arrays):
    """Return `jax.numpy` if any argument is a JAX array (or tracer), else `numpy`."""
    return jnp if any(isinstance(array, jax.Array) for array in arrays) else np
