"""From noise and a caption to a state: guidance, control, and three ways to go on."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from builders import refused, stirred
from compiled import Compiled
from test_acmdm import BATCH, condition, config_of, fresh, normal

from f3amd_lib.diffusion.schedules import straight
from f3amd_lib.text.networks.acmdm import Control, MaskedACMDMConfig, control_branch, controlled
from f3amd_lib.text.sampling import text_to_motion

SCHEDULE, NOISE = straight(), normal(1, BATCH, 8, 5, 4)
EULER = {"sampler": "ddim", "num_steps": 2}
TOLD = condition((8, 6))


@pytest.fixture(scope="module")
def network():
    return Compiled(stirred(fresh(config_of(depth=1))))


def test_guidance_of_one_is_the_condition_and_of_zero_none(network):
    text = lambda told: text_to_motion.text_prediction(network, told)
    time = jnp.asarray([0.2, 0.6])
    told, free = text(TOLD)(NOISE, time), text(TOLD.without_text())(NOISE, time)
    np.testing.assert_array_equal(text_to_motion.with_guidance(text, TOLD, 1.0)(NOISE, time), told)
    np.testing.assert_allclose(text_to_motion.with_guidance(text, TOLD, 0.0)(NOISE, time), free, atol=1e-6)
    np.testing.assert_allclose(
        text_to_motion.with_guidance(text, TOLD, 3.0)(NOISE, time), free + 3.0 * (told - free), atol=1e-4
    )
    assert float(jnp.abs(told - free).max()) > 1e-3


def test_control_guidance_of_one_and_one_is_the_controlled_network(network):
    network = network.network  # the branch calls its blocks one by one
    branch = stirred(control_branch(network, 4, jax.random.key(2)), 4)
    control = Control.of(normal(3, BATCH, 32, 5, 3), jnp.zeros((BATCH, 32, 5)).at[:, 3, 1].set(1.0))
    time = jnp.asarray([0.2, 0.6])
    full = controlled(network, branch, TOLD, control)(NOISE, time)
    once = text_to_motion.control_prediction(network, branch, TOLD, control, 1.0, 1.0)(NOISE, time)
    np.testing.assert_allclose(once, full, atol=1e-6)
    no_text = controlled(network, branch, TOLD.without_text(), control)(NOISE, time)
    no_control = controlled(network, branch, TOLD, control.dropped())(NOISE, time)
    wanted = full + 1.5 * (full - no_text) + 0.75 * (full - no_control)
    pushed = text_to_motion.control_prediction(network, branch, TOLD, control)(NOISE, time)
    np.testing.assert_allclose(pushed, wanted, atol=1e-3)
    state = text_to_motion.sample_control(network, branch, SCHEDULE, TOLD, control, NOISE, sampler="ddim", num_steps=1)
    # One Euler step from the noise along the velocity there.
    start = text_to_motion.control_prediction(network, branch, TOLD, control)(NOISE, jnp.zeros(BATCH))
    wanted = (NOISE + start) * TOLD.mask[..., None, None]
    np.testing.assert_allclose(state, wanted, atol=1e-3)


# ------------------------------------------------------------------------------------------------------- autoregression


@pytest.mark.slow
@pytest.mark.parametrize("guidance", [1.0, 2.5])
def test_cached_and_uncached_blocks_agree(guidance):
    network = Compiled(stirred(fresh(config_of(depth=2, block_frames=3))))  # the last block is short
    cached, uncached = (
        text_to_motion.sample_blocks(network, SCHEDULE, TOLD, NOISE, guidance=guidance, cached=cached, **EULER)
        for cached in (True, False)
    )
    scale = float(jnp.abs(cached).max())
    np.testing.assert_allclose(cached / scale, uncached / scale, atol=2e-5)
    assert not np.any(cached[1, 6:])


def test_a_stream_goes_on_from_its_last_frames_and_hears_new_captions(network):
    prefix, captions = normal(6, BATCH, 3, 5, 4), [normal(7, BATCH, 6), normal(8, BATCH, 6)]
    stream = lambda prefix, captions: list(
        text_to_motion.continue_prefix(network, SCHEDULE, prefix, captions, jax.random.key(1), guidance=1.0, **EULER)
    )
    first = stream(prefix, captions)
    assert [made.shape for made in first] == [(BATCH, 5, 5, 4)] * 2
    changed = stream(prefix, [captions[0], captions[0]])
    np.testing.assert_array_equal(changed[0], first[0])
    assert float(jnp.abs(changed[1] - first[1]).max()) > 1e-3
    assert float(jnp.abs(stream(prefix.at[:, 1].add(1.0), captions)[0] - first[0]).max()) > 1e-3
    refused("prefix must have 1 to 7", stream, normal(6, BATCH, 8, 5, 4), captions)


def test_the_prefix_is_shown_clean_in_every_evaluation():
    seen = []

    class Watched:
        config = config_of(depth=1)

        def encode(self, condition):
            return condition

        def __call__(self, state, time, context):
            seen.append(state)
            return jnp.zeros_like(state)

    prefix = normal(6, BATCH, 3, 5, 4)
    captions, asked = [normal(7, BATCH, 6), normal(8, BATCH, 6)], {"guidance": 1.0, "sampler": "ddim", "num_steps": 1}
    made = list(text_to_motion.continue_prefix(Watched(), SCHEDULE, prefix, captions, jax.random.key(1), **asked))
    np.testing.assert_array_equal(seen[0][:, :3], prefix)
    # The second window follows the last three frames of the first, and nothing before them.
    np.testing.assert_array_equal(seen[1][:, :3], made[0][:, -3:])
    for shown, window in zip(seen, made, strict=True):
        np.testing.assert_allclose(shown[:, 3:], window, atol=1e-6)  # a velocity of 0 leaves the noise


@pytest.mark.slow
def test_masked_sampling_reveals_every_frame_once():
    """The head of an untrained masked network answers v = 0: every frame is the noise of the round that revealed it."""
    network = fresh(config_of(MaskedACMDMConfig, depth=1))
    reveal = lambda network, told, **settings: text_to_motion.sample_masked(
        Compiled(network), SCHEDULE, told, jax.random.key(0), **settings, **EULER
    )
    state = np.asarray(reveal(network, TOLD, guidance=1.0, num_rounds=4))
    assert not np.any(state[1, 6:]) and np.isfinite(state).all()
    assert (np.abs(state[0]).max(axis=(1, 2)) > 0).all() and (np.abs(state[1, :6]).max(axis=(1, 2)) > 0).all()
    assert 0.8 < state[0].std() < 1.2
    trained = stirred(network)
    first, other = (
        reveal(trained, told, guidance=2.0, num_rounds=3) for told in (TOLD, TOLD._replace(pooled=-TOLD.pooled))
    )
    assert float(jnp.abs(first - other).max()) > 1e-3
