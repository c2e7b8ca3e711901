"""The F3AMD network as a whole, its variants and its config (section 3.4, Tables 8 to 11)."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from builders import (
    CHANNELS,
    HISTORY,
    WINDOW,
    draw,
    evaluate,
    make_condition,
    network_of,
    refused,
    same_tree,
    stirred,
    tiny_config,
)
from flax import nnx

from f3amd_lib.data.features import path_condition, turn_frames
from f3amd_lib.ground.trees import describe
from f3amd_lib.networks.attention import position_code
from f3amd_lib.networks.conditioning import Condition, Context
from f3amd_lib.networks.f3amd import F3AMD, F3AMDConfig
from f3amd_lib.networks.presets import build_from_config, config_from_dict
from f3amd_lib.networks.variants import Variant, VariantConfig
from f3amd_lib.training.checkpoints import load_model
from f3amd_lib.training.optimise import differences
from f3amd_lib.training.pipeline import PRETRAINED_DIR

SIGMA = jnp.array([0.3, 20.0])


def make_network(**changes):
    return network_of(tiny_config(**changes))


def run(network, x_noisy, sigma=SIGMA, condition=None):
    condition = make_condition(x_noisy.shape[0]) if condition is None else condition
    return evaluate(network, x_noisy, sigma, condition)


OWN = dataclasses.fields(VariantConfig)[len(dataclasses.fields(F3AMDConfig)) :]
OPTIONS = {field.name: field.default for field in OWN}


@pytest.mark.parametrize("option", OPTIONS)
def test_a_network_is_the_papers_until_an_option_is_on(option):
    paper = tiny_config()
    assert type(paper) is F3AMDConfig and type(network_of(paper)) is F3AMD and not OPTIONS.keys() & paper.to_dict()
    # Headers of files list options whether they are on or not; of older files some are missing.
    for listed in (OPTIONS, {option: OPTIONS[option]}):
        assert config_from_dict({**paper.to_dict(), **listed}) == paper
        assert differences({"model": paper.to_dict()}, {"model": {**paper.to_dict(), **listed}}) == []
    on = tiny_config(**{option: 24 if option.endswith("width") else True})
    assert type(on) is VariantConfig and type(network_of(on)) is Variant
    assert differences({"model": paper.to_dict()}, {"model": on.to_dict()}) == [f"model settings ({option})"]


@pytest.mark.parametrize("name", ["bandai/F3AMD-FNO-96", "bandai/F3AMD-Transformer-64", "bandai/F3AMD-FNO-96-steady"])
def test_shipped_files_make_the_network_that_their_name_says(name):
    trained = load_model(PRETRAINED_DIR / f"{name}.safetensors")
    assert type(trained.network()) is (Variant if name.endswith("steady") else F3AMD)
    recorded = describe(PRETRAINED_DIR / f"{name}.safetensors")["model"]
    assert differences({"model": trained.config.to_dict()}, {"model": recorded}) == []
    assert differences({"model": tiny_config().to_dict()}, {"model": recorded}) != []


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"depth": 0}, "depth must be above 0"),
        ({"normalise": 1}, "normalise must be true or false"),
        ({"num_kept_modes": 6}, "at most 5 for blocks of 8 frames"),
        ({"num_kept_modes": 10, "conditioning": "concatenation"}, "at most 9 for blocks of 16"),
        ({"num_heads": 3}, "num_heads must divide the width 8"),
        ({"base_block": "transfomer"}, "'transfomer'; did you mean 'transformer'"),
        ({"dropout": 1.0}, "dropout must be below 1"),
        ({"pre_norm": True, "conditioning": "adaln_zero"}, "pre_norm contradicts adaln_zero"),
        ({"history_input": True, "conditioning": "concatenation"}, "history_input contradicts concatenation"),
        ({"block_bypass": True, "block_residual": True}, "block_bypass contradicts"),
    ],
)
def test_impossible_configs_are_refused(changes, message):
    refused(message, make_network, **changes)


@pytest.mark.parametrize(
    ("changes", "modes"), [({}, 5), ({"spectral_variant": "cosine"}, 8), ({"conditioning": "concatenation"}, 9)]
)
def test_section_4_5_all_modes_there_are_unless_told(changes, modes):
    assert tiny_config(num_kept_modes=0, **changes).num_kept_modes == modes
    assert tiny_config(num_kept_modes=2, **changes).num_kept_modes == 2


def test_wrong_shapes_are_refused_by_name():
    network, condition = make_network(), make_condition()
    wrong = {"history": draw(2, HISTORY + 1, CHANNELS), "path": draw(2, WINDOW, 7), "style": draw(2, 3)}
    for name, part in wrong.items():
        refused(f"condition {name} must have shape", network.encode, condition._replace(**{name: part}))
    refused(rf"\[B, {WINDOW}, {CHANNELS}\]", run, network, draw(2, WINDOW + 1, CHANNELS), condition=condition)


def test_input_scaling_is_c_in():
    x_noisy = draw(2, WINDOW, CHANNELS)
    for sigma_data in (1.0, 0.5):
        scaled = make_network(sigma_data=sigma_data)
        raw = make_network(input_scaling=False)
        c_in = 1.0 / jnp.sqrt(SIGMA**2 + sigma_data**2)[:, None, None]
        np.testing.assert_allclose(run(scaled, x_noisy), run(raw, c_in * x_noisy), atol=2e-5)
        assert float(jnp.abs(run(scaled, x_noisy) - run(raw, x_noisy)).max()) > 1e-2


@pytest.mark.parametrize(
    ("conditioning", "residual"),
    [("film", True), ("concatenation", True), ("cross_attention", True), ("adaln_zero", False), ("film", False)],
)
def test_table_11_residual_and_adaln_zero_blocks_start_as_decoder_of_encoder(conditioning, residual):
    network = make_network(block_residual=residual, depth=3, conditioning=conditioning)
    x_noisy = draw(2, WINDOW, CHANNELS)
    bare = network.decoder(network.encoder(x_noisy / jnp.sqrt(SIGMA**2 + 1.0)[:, None, None]))
    apart = float(jnp.abs(run(network, x_noisy) - bare).max())
    assert apart < 1e-5 if residual or conditioning == "adaln_zero" else apart > 1e-2


def test_history_anchor_adds_the_last_history_frame():
    network, x_noisy = make_network(history_anchor=True), draw(2, WINDOW, CHANNELS)
    weight = draw(WINDOW, CHANNELS, seed=7)
    network.anchor[...] = weight
    anchored = run(network, x_noisy)
    network.anchor[...] = jnp.zeros_like(weight)
    expected = weight[None] * make_condition().history[:, -1:, :]
    np.testing.assert_allclose(anchored - run(network, x_noisy), expected, atol=2e-5)


def test_residual_prior_is_the_posterior_mean():
    x_noisy, sigma = draw(2, WINDOW, CHANNELS), 0.5
    network = make_network(residual_prior=True)

    def with_variance(variance):
        network.residual_variance[...] = jnp.full((WINDOW, CHANNELS), 0.1 * np.log(variance))
        return run(network, x_noisy, sigma)

    estimate = with_variance(1e-12)
    # Variance sigma^2: estimate and noisy input weigh the same; huge: the input is believed.
    np.testing.assert_allclose(with_variance(sigma**2), (estimate + x_noisy) / 2, atol=1e-5)
    np.testing.assert_allclose(with_variance(1e12), x_noisy, atol=1e-5)
    assert float(jnp.abs(estimate - x_noisy).max()) > 0.1


@pytest.mark.slow
def test_every_parameter_learns():
    network = make_network(history_anchor=True, residual_prior=True)
    x_noisy, wanted = draw(2, WINDOW, CHANNELS), draw(2, WINDOW, CHANNELS, seed=9)
    graph, state = nnx.split(network)
    loss = lambda state: jnp.mean((run(nnx.merge(graph, state), x_noisy) - wanted) ** 2)
    gradient = jax.jit(jax.grad(loss))(state)
    for path, leaf in jax.tree_util.tree_flatten_with_path(gradient)[0]:
        name = jax.tree_util.keystr(path)
        assert np.isfinite(leaf).all(), name
        # A key's bias shifts all scores of a query alike, which softmax does not see.
        if not ("'key'" in name and "'bias'" in name):
            assert np.abs(leaf).max() > 1e-9, name


VARIANTS = {
    "transformer": {"base_block": "transformer", "num_heads": 2},
    "linear coders": {"encoder_decoder": "linear"},
    "cosine": {"spectral_variant": "cosine", "num_kept_modes": WINDOW},
    "reduced rank": {"spectral_variant": "reduced_rank", "spectral_rank": 3},
    "weighted": {"spectral_variant": "weighted"},
    "concatenation": {"conditioning": "concatenation", "num_kept_modes": WINDOW + 1},
    "adaln_zero": {"conditioning": "adaln_zero"},
    "cross_attention": {"conditioning": "cross_attention"},
    "one mode": {"num_kept_modes": 1},
}


@pytest.mark.slow
@pytest.mark.parametrize("variant", VARIANTS)
def test_tables_8_to_11_every_variant_is_its_own_function(variant):
    network, x_noisy = make_network(**VARIANTS[variant]), draw(2, WINDOW, CHANNELS)
    x0_hat = run(network, x_noisy)
    assert x0_hat.shape == x_noisy.shape and bool(jnp.all(jnp.isfinite(x0_hat)))
    assert float(jnp.abs(x0_hat - run(make_network(), x_noisy)).max()) > 1e-3
    for name in Condition._fields:
        changed = make_condition()
        changed = changed._replace(**{name: getattr(changed, name) + 1.0})
        moved = float(jnp.abs(run(network, x_noisy, condition=changed) - x0_hat).max())
        # AdaLN-zero starts as the identity: before training no condition comes through.
        assert moved == 0.0 if variant == "adaln_zero" else moved > 1e-5, name


def test_table_11_concatenation_runs_its_blocks_on_twice_the_frames():
    network, condition = make_network(**VARIANTS["concatenation"]), make_condition()
    x_noisy = draw(2, WINDOW, CHANNELS)
    stages = dict(network.stages(x_noisy, SIGMA, network.encode(condition)))
    assert stages["c"].shape == stages["encoder"].shape == (2, WINDOW, 8)
    assert stages["block 1"].shape == (2, 2 * WINDOW, 8)
    sequence = jnp.concatenate([stages["c"], stages["encoder"]], axis=1)
    block = network.conditionings[0](network.blocks[0], sequence, None)
    np.testing.assert_allclose(stages["block 1"], block, atol=1e-5)
    np.testing.assert_allclose(stages["x0_hat"], network.decoder(block[:, -WINDOW:]), atol=1e-5)


def test_section_3_4_1_transformer_blocks_see_the_order_of_frames():
    network, condition = make_network(**VARIANTS["transformer"]), make_condition()
    stages = dict(network.stages(draw(2, WINDOW, CHANNELS), SIGMA, network.encode(condition)))
    placed = stages["encoder"] + position_code(0, WINDOW, 8)
    block = network.conditionings[0](network.blocks[0], placed, stages["c"])
    np.testing.assert_allclose(stages["block 1"], block, atol=1e-5)


def test_output_scaling_is_the_skip_of_karras():
    """Karras et al. 2022, Table 1: c_skip x + c_out F with sigma_data."""
    scaled, plain = make_network(output_scaling=True, sigma_data=0.5), make_network(sigma_data=0.5)
    x_noisy, sigma = draw(2, WINDOW, CHANNELS), np.array([0.3, 20.0])[:, None, None]
    total = sigma**2 + 0.25
    expected = 0.25 / total * x_noisy + sigma * 0.5 / np.sqrt(total) * run(plain, x_noisy)
    np.testing.assert_allclose(run(scaled, x_noisy), expected, atol=1e-5)


@pytest.mark.parametrize("side", ["encoder", "decoder"])
@pytest.mark.parametrize("coder", ["fno", "linear"])
def test_a_wider_coder_has_a_second_layer(coder, side):
    hidden = f"{side}_hidden"
    wide = make_network(**{f"{hidden}_width": 24}, encoder_decoder=coder)
    x_noisy = draw(2, WINDOW, CHANNELS)
    stations = dict(wide.stages(x_noisy, SIGMA, wide.encode(make_condition())))
    into = x_noisy / jnp.sqrt(SIGMA**2 + 1.0)[:, None, None] if side == "encoder" else stations["block 1"]
    expected = getattr(wide, side)(nnx.gelu(getattr(wide, hidden)(into)))
    np.testing.assert_allclose(stations[side], expected, atol=1e-5)


@pytest.mark.parametrize("changes", [{}, {"conditioning": "concatenation"}, {"history_input": True}])
@pytest.mark.parametrize("skip", [True, False])
def test_a_skip_brings_the_encoders_frames_to_the_decoder(changes, skip):
    network, x_noisy = make_network(encoder_skip=skip, **changes), draw(2, WINDOW, CHANNELS)
    stations = dict(network.stages(x_noisy, SIGMA, network.encode(make_condition())))
    encoded = stations["encoder"]
    read = stations["block 1"][:, -encoded.shape[1] :]
    with_skip, without = (np.asarray(network.decoder(each))[:, -WINDOW:] for each in (read + encoded, read))
    np.testing.assert_allclose(stations["decoder"], with_skip if skip else without, atol=1e-5)
    assert np.abs(with_skip - without).max() > 1e-2


def test_film_from_identity_begins_with_nothing_to_modulate():
    """z_tilde = z_base in Eq. 6, so that c is not seen at first."""
    x_noisy, condition, blocks = draw(2, WINDOW, CHANNELS), make_condition(), {}
    for identity in (True, False):
        network = make_network(film_from_identity=identity)
        stations = dict(network.stages(x_noisy, SIGMA, network.encode(condition)))
        block, film = network.blocks[0], network.conditionings[0]
        blocks[identity] = stations["block 1"], nnx.silu(film.output(block(stations["encoder"])))
        other = condition._replace(style=condition.style[::-1])
        moved = np.abs(run(network, x_noisy, condition=other) - run(network, x_noisy, condition=condition)).max()
        assert moved == 0.0 if identity else moved > 1e-4
    np.testing.assert_allclose(*blocks[True], atol=1e-5)
    assert float(jnp.abs(blocks[False][0] - blocks[False][1]).max()) > 1e-2


@pytest.mark.parametrize("base_block", ["fno", "transformer"])
def test_pre_norm_is_what_a_block_reads(base_block):
    x_noisy, condition = draw(2, WINDOW, CHANNELS), make_condition()
    for pre_norm in (True, False):
        network = make_network(pre_norm=pre_norm, base_block=base_block, depth=2)
        stations = dict(network.stages(x_noisy, SIGMA, network.encode(condition)))
        read = stations["block 1"]
        mean, deviation = (np.asarray(each(read, axis=-1, keepdims=True)) for each in (jnp.mean, jnp.std))
        normalised = (read - mean) / np.sqrt(deviation**2 + 1e-6)
        block, layer = network.blocks[1], network.conditionings[1]
        answers = [np.asarray(layer(block, each, stations["c"])) for each in (normalised, read)]
        np.testing.assert_allclose(stations["block 2"], answers[0 if pre_norm else 1], atol=1e-4)
        assert np.abs(answers[0] - answers[1]).max() > 1e-2


def lively_network(**changes):
    """A network whose every path is open: residual blocks start closed, with an output of zero."""
    return stirred(make_network(**changes), 5, scale=0.05)


def a_walk(yaw):
    """History, path and noisy state of one motion, all turned by `yaw`, [2]; path facing first."""
    rng = np.random.default_rng(1)
    frames = rng.standard_normal((2, HISTORY + WINDOW, CHANNELS)).astype(np.float32)
    frames = turn_frames(frames, yaw)
    place = rng.standard_normal((2, WINDOW, 2))
    facing = rng.standard_normal((2, WINDOW)) + yaw[:, None]
    cosine, sine = np.cos(yaw)[:, None], np.sin(yaw)[:, None]
    x, z = place[..., 0], place[..., 1]
    place = np.stack([x * cosine + z * sine, z * cosine - x * sine], axis=-1)
    path = path_condition(place, facing)
    style = jnp.eye(2)
    condition = Condition(jnp.asarray(frames[:, :HISTORY]), jnp.asarray(path, jnp.float32), style)
    return jnp.asarray(frames[:, HISTORY:]), condition


@pytest.mark.parametrize("facing_frame", [True, False])
def test_a_network_that_faces_its_path_is_the_same_for_every_heading(facing_frame):
    network = lively_network(facing_frame=facing_frame, history_anchor=True, residual_prior=True, normalise=False)
    answers = []
    for yaw in (np.zeros(2), np.array([0.7, -2.5])):
        x_noisy, condition = a_walk(yaw)
        x0_hat = np.asarray(run(network, x_noisy, condition=condition))
        answers.append(turn_frames(x0_hat, -yaw))
    apart = np.abs(answers[0] - answers[1]).max()
    assert apart < 1e-4 if facing_frame else apart > 1e-2


@pytest.mark.slow
def test_history_in_the_input_lies_before_the_window_and_is_not_answered():
    config = tiny_config(history_input=True, num_kept_modes=7)
    assert config.block_frames == HISTORY + WINDOW
    network = lively_network(history_input=True, num_kept_modes=7)
    x_noisy, condition = a_walk(np.zeros(2))
    stations = dict(network.stages(x_noisy, SIGMA, network.encode(condition)))
    assert stations["encoder"].shape[1] == stations["block 1"].shape[1] == HISTORY + WINDOW
    assert stations["x0_hat"].shape == x_noisy.shape
    # The oldest frame of the history reaches the blocks although the condition is held.
    context = network.encode(condition)
    older = context._replace(history=context.history.at[:, 0].add(1.0))
    moved = network(x_noisy, SIGMA, older) - network(x_noisy, SIGMA, context)
    assert float(jnp.abs(moved).max()) > 1e-3
    assert type(lively_network().encode(condition)) is Context  # the paper's network hears of it through c alone


def test_layers_get_the_keys_that_flax_would_deal():
    """Weights depend on the key alone, whoever counts the layers."""
    ours = build_from_config(tiny_config(), jax.random.key(3))
    theirs = F3AMD(tiny_config(), rngs=nnx.Rngs(params=jax.random.key(3)))
    assert same_tree(nnx.state(ours), nnx.state(theirs))
    assert not same_tree(nnx.state(ours), nnx.state(build_from_config(tiny_config(), jax.random.key(4))))
