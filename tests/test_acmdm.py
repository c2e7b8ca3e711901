"""The ACMDM network, its control branch, and its masked form."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from builders import draw, refused, same_tree, stirred
from flax import nnx

from f3amd_lib.networks import presets
from f3amd_lib.text.networks import acmdm

SIZE = {"num_joints": 5, "channels": 4, "window": 8, "latent_width": 16, "depth": 1, "num_heads": 2, "text_width": 6}
BATCH = 2


def config_of(family=acmdm.ACMDMConfig, **settings):
    return family(**{**SIZE, **settings})


def fresh(config, seed=0):
    family = acmdm.MaskedACMDM if isinstance(config, acmdm.MaskedACMDMConfig) else acmdm.ACMDM
    return family(config, rngs=nnx.Rngs(seed))


def normal(seed, *shape):
    return draw(*shape, seed=seed)  # JAX's random numbers would be compiled for each shape


def moved(array, *place):
    """The array with one added at a place, as NumPy does it: nothing is compiled."""
    copy = np.array(array)
    copy[place] += 1.0
    return copy


def condition(lengths=(8, 8), frames=8):
    return acmdm.TextCondition(normal(9, BATCH, 6), jnp.asarray(np.arange(frames) < np.array(lengths)[:, None]))


STATE = normal(1, BATCH, 8, 5, 4)
TIME = jnp.asarray([0.3, 0.8])


def test_a_captions_vector_is_scaled_and_no_caption_stays_none():
    plain, scaled = (fresh(config_of(text_scale=scale)) for scale in (1.0, 32.0))
    told = condition()
    longer = told._replace(pooled=32.0 * told.pooled)
    np.testing.assert_allclose(scaled.encode(told).text, plain.encode(longer).text, rtol=1e-5, atol=1e-5)
    assert not np.allclose(scaled.encode(told).text, plain.encode(told).text, atol=0.1)
    nothing = told.without_text()
    np.testing.assert_array_equal(scaled.encode(nothing).text, plain.encode(nothing).text)


# ------------------------------------------------------------------------------------------------- against the facts


LARGE = [pytest.param(*one, marks=pytest.mark.slow) for one in (("L", 306.4), ("XL", 596.4))]


@pytest.mark.parametrize(("size", "million"), [("S", 39.1), ("B", 130.1), *LARGE])
def test_parameters_are_those_of_the_released_sizes(size, million):
    config = presets.build_config(f"ACMDM-{size}-PS22", num_joints=22)
    assert presets.count_parameters(config) / 1e6 == pytest.approx(million, abs=0.05)
    assert config.latent_width == 64 * config.depth and config.depth == config.num_heads


@pytest.mark.parametrize(("tokens", "base"), [(49, 200), (98, 300), (539, 1400), (196, 500), (15, 100), (50, 200)])
def test_rotary_bases_are_the_released_ones(tokens, base):
    assert acmdm.rotary_base(tokens) == base


@pytest.mark.parametrize("patch", ["whole", "half", "pair"])
def test_patches_put_together_again_are_the_state(patch):
    network = fresh(config_of(patch=patch))
    tokens = network.tokens(STATE)
    assert tokens.shape == (BATCH, 8 * network.config.num_patches, network.config.patch_joints * 4)
    np.testing.assert_array_equal(network.from_tokens(tokens), STATE)
    # Frame after frame, then patch; in a patch joint, then channel.
    joint = network.config.patch_joints - 1
    np.testing.assert_array_equal(tokens[:, network.config.num_patches, 4 * joint : 4 * joint + 4], STATE[:, 1, joint])


def test_rotary_code_depends_on_distance_alone():
    query, key = normal(2, 1, 1, 1, 8), normal(3, 1, 1, 1, 8)
    turned = lambda x, place: acmdm.rotated(x, acmdm.rotary_angles([place], 4, 100))
    product = lambda p, q: float(jnp.vdot(turned(query, p), turned(key, q)))
    assert product(3, 1) == pytest.approx(product(12, 10), abs=1e-5)
    assert abs(product(3, 1) - product(1, 3)) > 1e-2
    angles = acmdm.rotary_angles([1], 32, 200.0)
    np.testing.assert_allclose(angles[0, [0, -1]], [1.0, 1 / 200.0], rtol=1e-5)  # exponents 0 and 1, both


# ----------------------------------------------------------------------------------------------- what it may not see


FORMS = {
    "adaln": config_of(),
    "pairs": config_of(patch="pair"),
    "concatenation": config_of(conditioning="concatenation"),
    "blocks": config_of(block_frames=4, depth=2),
}


@pytest.fixture(scope="module", params=FORMS)
def network(request):
    return stirred(fresh(FORMS[request.param]))


def answer(network, state, time, condition):
    return np.asarray(_answer(network, state, time, condition))


@nnx.jit
def _answer(network, state, time, condition):
    return network(state, time, network.encode(condition))


def test_an_untrained_network_answers_zero():
    for config in FORMS.values():
        assert np.abs(answer(fresh(config), STATE, TIME, condition())).max() == 0.0


def test_padding_changes_nothing_and_frames_do(network):
    told = condition((5, 8))
    first = answer(network, STATE, TIME, told)
    assert first.shape == STATE.shape and bool(np.isfinite(first).all())
    noise = np.float32(5.0) * np.asarray(normal(4, *STATE.shape))
    padded = answer(network, np.where(told.mask[..., None, None], STATE, noise), TIME, told)
    np.testing.assert_allclose(padded[0, :5], first[0, :5], atol=2e-5)
    np.testing.assert_allclose(padded[1], first[1], atol=2e-5)
    if not network.config.block_frames:  # the same clip without its padding
        short = answer(network, np.asarray(STATE)[:, :5], TIME, condition((5, 5), 5))
        np.testing.assert_allclose(short[0], first[0, :5], atol=2e-5)
    touched = answer(network, moved(STATE, 0, 2), TIME, told)
    assert np.abs(touched[0, 3] - first[0, 3]).max() > 1e-3
    np.testing.assert_allclose(touched[1], first[1], atol=2e-5)


def test_text_and_time_reach_the_answer(network):
    told = condition()
    first = answer(network, STATE, TIME, told)
    for other in (
        answer(network, STATE, TIME, told.without_text()),
        answer(network, STATE, TIME + 0.1, told),
        answer(network, np.asarray(STATE)[:, ::-1], TIME, told)[:, ::-1],  # frames have an order
    ):
        assert np.abs(other - first).max() > 1e-3
    assert np.abs(told.without_text().pooled).max() == 0.0


# ---------------------------------------------------------------------------------------------------------- blocks


def test_one_block_is_full_attention():
    blocks = stirred(fresh(config_of(block_frames=8)))
    full = stirred(fresh(config_of()))
    np.testing.assert_allclose(*(answer(each, STATE, TIME, condition()) for each in (blocks, full)), atol=1e-6)
    assert acmdm.block_causal(8, 8, 8).all() and not acmdm.block_causal(8, 8, 4).all()
    np.testing.assert_array_equal(acmdm.block_causal(4, 8, 4), np.ones((4, 8)))
    np.testing.assert_array_equal(acmdm.block_causal(2, 2, 1), [[1, 0], [1, 1]])


def test_later_blocks_change_nothing_before_them():
    network, told = stirred(fresh(config_of(block_frames=4, patch="pair"))), condition()
    times = np.repeat(np.array([[0.2, 0.7], [0.5, 0.1]], np.float32), 4, axis=1)
    first = answer(network, STATE, times, told)
    later = answer(network, moved(STATE, slice(None), 5), times + np.float32(0.1) * (np.arange(8) >= 4), told)
    np.testing.assert_allclose(later[:, :4], first[:, :4], atol=2e-5)
    assert np.abs(later[:, 4] - first[:, 4]).max() > 1e-3
    earlier = answer(network, moved(STATE, slice(None), 1), times, told)
    assert np.abs(earlier[:, 0] - first[:, 0]).max() > 1e-3  # of its own block
    assert np.abs(earlier[:, 6] - first[:, 6]).max() > 1e-4


# ----------------------------------------------------------------------------------------------------- control branch


@pytest.fixture(scope="module", params=["whole", "pair"])
def control_pair(request):
    base = stirred(fresh(config_of(patch=request.param)))
    return base, acmdm.control_branch(base, 4, jax.random.key(5))


def some_control(joint=2):
    asked = np.zeros((BATCH, 32, 5), np.float32)
    asked[:, 9, joint] = 1.0
    return acmdm.Control.of(normal(6, BATCH, 32, 5, 3), jnp.asarray(asked))


def answer_with(*given):
    return np.asarray(_answer_with(*given))


@nnx.jit
def _answer_with(base, branch, condition, control):
    return acmdm.controlled(base, branch, condition, control)(STATE, TIME)


def test_a_fresh_branch_changes_nothing_and_copies_the_blocks(control_pair):
    base, branch = control_pair
    told = condition((8, 6))
    np.testing.assert_array_equal(answer_with(base, branch, told, some_control()), answer(base, STATE, TIME, told))
    assert same_tree(nnx.state(branch.blocks), nnx.state(base.blocks))
    assert np.abs(branch.text.kernel[...] - base.text.kernel[...]).max() > 0  # fresh


def test_a_trained_branch_hears_control_in_its_place_and_time(control_pair):
    base, branch = control_pair
    branch = stirred(branch, 3)
    told, control = condition(), some_control()
    first = answer_with(base, branch, told, control)
    assert np.abs(first - answer(base, STATE, TIME, told)).max() > 1e-3
    later = control._replace(positions=jnp.roll(control.positions, 4, 1))
    for other in (control.dropped(), some_control(joint=4), later):
        assert np.abs(answer_with(base, branch, told, other) - first).max() > 1e-4
    # Only positions are shown: what is not asked is zero, and a dropped control hides all of it.
    other = control._replace(positions=7.0 * control.positions)
    hidden, plain = (answer_with(base, branch, told, each.dropped()) for each in (other, control))
    np.testing.assert_array_equal(hidden, plain)
    tokens = branch.control_tokens(control) - branch.control_tokens(control._replace(positions=0.0 * control.positions))
    patches = base.config.num_patches
    there = np.flatnonzero(np.abs(tokens[0]).max(axis=-1) > 1e-6)
    # Frame 9 of motion is in frame 2 of the latent; joint 2 is in the second pair.
    assert there.tolist() == [2 * patches + (1 if patches > 1 else 0)]


# --------------------------------------------------------------------------------------------------------- masked form


def test_a_masked_network_does_not_look_at_hidden_frames():
    config = config_of(acmdm.MaskedACMDMConfig)
    network, told = stirred(fresh(config)), condition((8, 6))
    hidden = np.tile(np.isin(np.arange(8), (3, 4)), (BATCH, 1))

    @nnx.jit
    def looked(network, state, hidden, noisy):
        return network(noisy, TIME, network.look(state, hidden, network.encode(told)))

    run = lambda *given: np.asarray(looked(*given))

    noisy = normal(7, *STATE.shape)
    first = run(network, STATE, hidden, noisy)
    np.testing.assert_array_equal(run(network, moved(STATE, slice(None), 3), hidden, noisy), first)
    assert np.abs(run(network, moved(STATE, slice(None), 1), hidden, noisy)[:, 3] - first[:, 3]).max() > 1e-4
    # The head denoises each frame for itself.
    one = run(network, STATE, hidden, moved(noisy, slice(None), 4))
    np.testing.assert_array_equal(one[:, 3], first[:, 3])
    assert np.abs(one[:, 4] - first[:, 4]).max() > 1e-4
    # Padding: the second sample has six frames.
    np.testing.assert_allclose(run(network, moved(STATE, 1, 7), hidden, noisy)[1, :6], first[1, :6], atol=2e-5)
    assert np.abs(run(fresh(config), STATE, hidden, noisy)).max() == 0.0


def test_hidden_frames_follow_the_cosine_and_stay_within_the_clip():
    mask = jnp.arange(40) < jnp.repeat(jnp.asarray([40, 10]), 2000)[:, None]
    hidden = acmdm.draw_hidden(jax.random.key(0), mask)
    assert not bool((hidden & ~mask).any()) and int(hidden.sum(axis=1).min()) == 1
    share = np.asarray(hidden.sum(axis=1) / mask.sum(axis=1))[:2000]
    assert share.mean() == pytest.approx(2 / np.pi, abs=0.02) and share.max() == 1.0
    spoilt, vector = acmdm.spoil(jax.random.key(1), jnp.zeros((4000, 40, 1, 1)), hidden)
    replaced = spoilt[..., 0, 0] != 0.0
    assert not bool((replaced & ~hidden).any()) and not bool((vector & replaced).any())
    assert float(replaced.sum() / hidden.sum()) == pytest.approx(0.1, abs=0.01)
    assert float(vector.sum() / hidden.sum()) == pytest.approx(0.9 * 0.88, abs=0.01)


# --------------------------------------------------------------------------------------------------- presets, refusals


def test_every_preset_of_acmdm_survives_json_and_is_counted():
    for name, preset in presets.of_paper("acmdm").items():
        size = {} if "autoencoder" in preset.family else {"num_joints": 21, "text_width": 256}
        config = presets.build_config(name, **size)
        assert presets.config_from_dict(config.to_dict()) == config
    config = config_of(depth=1)
    tokens, width, hidden = 8, 16, 42
    block = 6 * width * width + tokens * (4 * width * width + 3 * width * hidden) + 2 * tokens * tokens * width
    ends = 2 * (tokens * 20 * width) + 256 * width + width * width + 2 * width * width
    text, evaluation = presets.count_model_flops(config)
    assert (text, evaluation) == (2 * 6 * width, 2 * (block + ends))


@pytest.mark.parametrize(
    ("family", "settings", "message"),
    [
        (acmdm.ACMDMConfig, {"patch": "pairs"}, "did you mean 'pair'"),
        (acmdm.ACMDMConfig, {"latent_width": 18, "num_heads": 2}, "pairs of channels"),
        (acmdm.ACMDMConfig, {"block_frames": 4, "conditioning": "concatenation"}, "adaln"),
        (acmdm.MaskedACMDMConfig, {"block_frames": 4}, "masked autoregression"),
    ],
)
def test_settings_that_make_no_sense_are_refused(family, settings, message):
    refused(message, config_of, family, **settings)
