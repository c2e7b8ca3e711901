"""What only moves numbers, done by NumPy: JAX compiles a program for each shape of it, a third of all in the tests."""

import functools

import jax
import numpy as np
from jax._src.core import stage_p
from jax.extend.core import primitives


def spread(x, shape, broadcast_dimensions):
    wide = [1] * len(shape)
    for place, length in zip(broadcast_dimensions, x.shape, strict=True):
        wide[place] = length
    return np.broadcast_to(x.reshape(wide), shape)


MOVES = {
    stage_p: lambda x: x,  # an array of one of NumPy's
    primitives.broadcast_in_dim_p: spread,
    primitives.convert_element_type_p: lambda x, new_dtype: x.astype(new_dtype),
    primitives.reshape_p: lambda x, new_sizes: x.reshape(new_sizes),
    primitives.squeeze_p: lambda x, dimensions: x.squeeze(dimensions),
    primitives.transpose_p: lambda x, permutation: x.transpose(permutation),
    primitives.concatenate_p: lambda *parts, dimension: np.concatenate(parts, dimension),
}


def is_plain(x, may_be_weak: bool) -> bool:
    """Whether an operand has numbers of a type of its own, or may have Python's, on one device; keys have not."""
    if isinstance(x, jax.Array) and not (isinstance(x.dtype, np.dtype) and len(x.devices()) == 1):
        return False
    return may_be_weak or isinstance(x, np.ndarray) or not getattr(x, "weak_type", True)


def moved(move, compiled, *operands, **settings):
    told = {name: value for name, value in settings.items() if value is not None and value is not False}
    into = told.get("new_dtype", np.dtype(float))
    # Into whole numbers XLA rounds by rules of its own.
    is_known = isinstance(into, np.dtype) and into.kind == "f" and not told.keys() & {"sharding", "weak_type"}
    if is_known and all(is_plain(x, "new_dtype" in told) for x in operands):
        return jax.device_put(np.array(move(*map(np.asarray, operands), **told)))
    return compiled(*operands, **settings)


def move_by_numpy():
    """Let NumPy do so wherever nothing is traced."""
    for primitive, move in MOVES.items():
        primitive.def_impl(functools.partial(moved, move, primitive.impl))
