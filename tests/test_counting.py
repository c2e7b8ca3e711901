"""Counted operations, by hand and against XLA's own count."""

import jax
import jax.numpy as jnp
import pytest

from f3amd_lib.networks.counting import count_flops


def zeros(*shape):
    return jax.ShapeDtypeStruct(shape, jnp.float32)


def test_a_matrix_product_is_two_operations_a_term():
    assert count_flops(lambda a, b: a @ b, zeros(3, 5), zeros(5, 7)) == 2 * 3 * 5 * 7


def test_convolution():
    def convolve(x, kernel):
        return jax.lax.conv_general_dilated(x, kernel, (1,), "SAME", dimension_numbers=("NWC", "WIO", "NWC"))

    assert count_flops(convolve, zeros(2, 9, 3), zeros(5, 3, 4)) == 2 * 2 * 9 * 4 * 5 * 3


def test_functions_within_functions_and_loops():
    product = jax.jit(lambda a: a @ a)
    one = 2 * 4**3
    assert count_flops(lambda a: product(product(a)), zeros(4, 4)) == 2 * one
    loop = lambda a: jax.lax.scan(lambda carry, _: (product(carry), None), a, None, length=6)[0]
    assert count_flops(loop, zeros(4, 4)) == 6 * one
    branch = lambda a: jax.lax.cond(a[0, 0] > 0, lambda a: a @ a @ a, lambda a: a, a)
    assert count_flops(branch, zeros(4, 4)) == 2 * one
    assert count_flops(jax.remat(lambda a: product(a)), zeros(4, 4)) == one


def test_agrees_with_xla():
    def network(x, first, second):
        return jax.nn.silu(x @ first) @ second

    shapes = zeros(64, 128), zeros(128, 256), zeros(256, 128)
    analysis = jax.jit(network).lower(*shapes).cost_analysis()
    # XLA adds the elementwise operations, some percent here.
    assert count_flops(network, *shapes) == pytest.approx(analysis["flops"], rel=0.05)
