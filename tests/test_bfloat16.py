"""Fewer digits change the numbers a little."""

import jax.numpy as jnp
import numpy as np
import pytest
from builders import CHANNELS, WINDOW, draw, make_condition, network_of, tiny_config, tiny_trained

from f3amd_lib.motion.root_paths import named_path
from f3amd_lib.networks.config import cast_network
from f3amd_lib.rollout.rollout import MotionGenerator


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


@pytest.mark.slow
def test_rollouts_in_bfloat16_stay_near_and_come_as_float32():
    path = named_path("straight", 2 * WINDOW, speed=1.0)
    run = lambda dtype, seed=0: MotionGenerator(tiny_trained(), 2, dtype=dtype).rollout(path, "calm", seed=seed).frames
    full, half, other = run(jnp.float32), run(jnp.bfloat16), run(jnp.float32, seed=1)
    assert half.dtype == np.float32
    assert 0.0 < np.abs(full - half).mean() < 0.3 * np.abs(full - other).mean()
