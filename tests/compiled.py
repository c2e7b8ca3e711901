"""Networks whose calls are compiled: in tests several times cheaper than operation after operation."""

import functools

import jax
import numpy as np
from flax import nnx


class Compiled:
    """A network of which each call of it, or of a method, is one compiled program for each shape of its arguments."""

    def __init__(self, network: nnx.Module):
        self.network = network

    def __call__(self, *args, **kwargs):
        return _call(self.network, "__call__", args, kwargs)

    def __getattr__(self, name):
        found = getattr(self.network, name)
        return functools.partial(self._method, name) if hasattr(found, "__func__") else found

    def _method(self, name, *args, **kwargs):
        return _call(self.network, name, args, kwargs)


def _call(network, name, args, kwargs):
    leaves, tree = jax.tree.flatten((args, kwargs))
    is_number = lambda leaf: isinstance(leaf, (jax.Array, np.ndarray, float, int)) and not isinstance(leaf, bool)
    is_traced = [is_number(leaf) for leaf in leaves]
    traced = [leaf for leaf, traced in zip(leaves, is_traced, strict=True) if traced]
    fixed = tuple(None if traced else leaf for leaf, traced in zip(leaves, is_traced, strict=True))
    graph, state = nnx.split(network)
    made = _compiled(state, traced, graph, name, tree, fixed, tuple(is_traced))
    # What tests then do with it costs a compilation each, unless NumPy does it.
    is_inside = any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(made))
    return made if is_inside else jax.tree.map(np.asarray, made)


@functools.partial(jax.jit, static_argnums=(2, 3, 4, 5, 6))
def _compiled(state, traced, graph, name, tree, fixed, is_traced):
    network, rest = nnx.merge(graph, state), iter(traced)
    leaves = [next(rest) if traced else leaf for leaf, traced in zip(fixed, is_traced, strict=True)]
    args, kwargs = jax.tree.unflatten(tree, leaves)
    return getattr(network, name)(*args, **kwargs)
