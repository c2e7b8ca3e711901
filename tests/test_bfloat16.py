"""Fewer digits change the numbers a little."""

import jax.numpy as jnp
import numpy as np
import pytest
from builders import CHANNELS, WINDOW, draw, make_condition, network_of, tiny_config

from f3amd_companion.speed.implementations import cast_network


@pytest.mark.slow
def test_a_cast_network_computes_in_the_other_type_and_leaves_the_first_alone():
    network = network_of(tiny_config())
    half = cast_network(network, jnp.bfloat16)
    given = make_condition()
    x_noisy = draw(2, WINDOW, CHANNELS)
    lower = [leaf.astype(jnp.bfloat16) for leaf in (x_noisy, *given)]
    answer = half(lower[0], 1.0, half.encode(type(given)(*lower[1:])))
    expected = network(x_noisy, 1.0, network.encode(given))
    assert answer.dtype == jnp.bfloat16 and expected.dtype == jnp.float32
    gap = np.abs(np.asarray(answer, np.float32) - np.asarray(expected)).max()
    assert 1e-5 < gap < 0.1 * np.abs(expected).max()
