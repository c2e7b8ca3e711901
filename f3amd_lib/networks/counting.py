"""How many operations a function needs, counted from what JAX would run."""

import math

import jax
from jax.extend.core import jaxprs_in_params


def count_flops(function, *arguments) -> int:
    """Count the floating-point operations of all matrix products and convolutions in a function.

    A product of [M, K] and [K, N] counts 2 M N K: one multiplication and one addition for each
    term. Elementwise work (activations, norms, adding biases) is left out, as is usual; it moves
    memory rather than arithmetic units. What is constant while tracing costs nothing.

    Args:
      function: any function that JAX can trace.
      *arguments: arrays, or `jax.ShapeDtypeStruct`s, or trees of them.

    Returns:
      Operations of one call.

    Raises:
      ValueError: for a loop without a fixed number of rounds, which cannot be counted.
    """
    return _count(jax.make_jaxpr(function)(*arguments).jaxpr)


def _count(jaxpr) -> int:
    return sum(_count_equation(equation) for equation in jaxpr.eqns)


def _count_equation(equation) -> int:
    name, parameters = equation.primitive.name, equation.params
    if name == "dot_general":
        (contracted, _), _ = parameters["dimension_numbers"]
        shape = equation.invars[0].aval.shape
        terms = math.prod(shape[axis] for axis in contracted)
        return 2 * equation.outvars[0].aval.size * terms
    if name == "conv_general_dilated":
        # Weights that one output number meets: the kernel without its output channels.
        kernel = equation.invars[1].aval
        outputs = kernel.shape[parameters["dimension_numbers"].rhs_spec[0]]
        return 2 * equation.outvars[0].aval.size * (kernel.size // outputs)
    if name == "while":
        raise ValueError("a while loop has no fixed number of rounds: its operations are unknown")
    # What an equation calls: jit, scan, custom gradients, branches.
    inner = [_count(jaxpr) for jaxpr in jaxprs_in_params(parameters)]
    return max(inner) if name == "cond" else sum(inner) * (parameters["length"] if name == "scan" else 1)
