"""The network as a whole, its config and the paper's names (sections 3.4 and 4.5)."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from builders import CHANNELS, HISTORY, WINDOW, evaluate, network_of, tiny_config
from flax import nnx

from f3amd_lib.models import zoo
from f3amd_lib.models.conditioning import Condition
from f3amd_lib.models.f3amd import F3AMDConfig, cosine_basis

SIGMA = jnp.array([0.3, 20.0])


def draw(*shape, seed=0):
    values = np.random.default_rng(seed).standard_normal(shape)
    return jnp.asarray(values, jnp.float32)


def make_condition(batch=2):
    return Condition(
        history=draw(batch, HISTORY, CHANNELS, seed=1),
        path=draw(batch, WINDOW, 8, seed=2),
        style=jnp.eye(2)[jnp.arange(batch) % 2],
    )


def make_network(**changes):
    return network_of(tiny_config(**changes))


def run(network, x_noisy, sigma=SIGMA, condition=None):
    condition = make_condition(x_noisy.shape[0]) if condition is None else condition
    return evaluate(network, x_noisy, sigma, condition)


@pytest.mark.parametrize(
    ("width", "parameters"),
    [(32, 745505), (48, 1361889), (64, 1806113), (96, 3501921), (128, 4334241)],
)
def test_section_4_5_parameter_counts(width, parameters):
    config = zoo.build_config(f"F3AMD-FNO-{width}", channels=135, num_styles=100)
    assert zoo.count_parameters(config) == parameters


@pytest.mark.parametrize(("width", "depth"), [(32, 8), (48, 8), (64, 6), (96, 6), (128, 4)])
def test_section_4_5_depths_and_modes(width, depth):
    for window, modes in ((32, 17), (64, 33)):
        config = zoo.build_config(f"F3AMD-FNO-{width}", channels=129, num_styles=22, window=window)
        assert (config.latent_width, config.depth, config.num_kept_modes) == (width, depth, modes)
        assert (config.num_history, config.window, config.kernel_size) == (10, window, 3)
        # Nothing of ours in a row of the paper.
        assert not (config.block_residual or config.history_anchor or config.residual_prior)


def test_counted_parameters_are_those_of_the_built_network():
    config = tiny_config(block_residual=True, history_anchor=True, residual_prior=True)
    network = network_of(config)
    built = sum(leaf.size for leaf in jax.tree.leaves(nnx.state(network)))
    assert zoo.count_parameters(config) == built
    # The anchor and the prior each add one number per frame and channel.
    assert built - zoo.count_parameters(tiny_config(block_residual=True)) == 2 * WINDOW * CHANNELS


def test_zoo_table_has_a_row_per_preset():
    table = zoo.table(channels=135, num_styles=100)
    assert list(table["model"]) == list(zoo.PRESETS)
    row = table.set_index("model").loc["F3AMD-FNO-96"]
    assert list(row) == [96, 6, 17, 3501921]


def test_zoo_builds_the_same_network_from_the_same_key():
    settings = tiny_config().to_dict()
    first, again, other = (
        nnx.state(zoo.build("F3AMD-FNO-32", key=jax.random.key(k), **settings)) for k in (1, 1, 2)
    )
    same = jax.tree.map(lambda a, b: bool(jnp.all(a == b)), first, again)
    assert all(jax.tree.leaves(same))
    assert not all(jax.tree.leaves(jax.tree.map(lambda a, b: bool(jnp.all(a == b)), first, other)))


def test_unknown_names_are_refused_with_the_nearest():
    with pytest.raises(ValueError, match="'F3AMD-FNO-69'.*F3AMD-FNO-96"):
        zoo.build_config("F3AMD-FNO-69", channels=9, num_styles=2)
    with pytest.raises(ValueError, match="'latent_with'; did you mean 'latent_width'"):
        zoo.build_config("F3AMD-FNO-96", channels=9, num_styles=2, latent_with=8)


@pytest.mark.parametrize("changes", [{}, {"history_anchor": True, "sigma_data": 0.5}])
def test_config_survives_json(changes):
    config = tiny_config(**changes)
    again = F3AMDConfig.from_dict(json.loads(json.dumps(config.to_dict())))
    assert again == config


def test_config_names_unknown_keys():
    with pytest.raises(ValueError, match="'widnow'; did you mean 'window'"):
        F3AMDConfig.from_dict({**tiny_config().to_dict(), "widnow": 3})


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"depth": 0}, "depth must be positive"),
        ({"channels": -3}, "channels must be positive"),
        ({"latent_width": 8.0}, "latent_width must be of type int"),
        ({"depth": True}, "depth must be of type int"),
        ({"normalise": 1}, "normalise must be of type bool"),
        ({"sigma_data": "1"}, "sigma_data must be of type float"),
        ({"sigma_data": 0}, "sigma_data must be positive"),
        ({"num_kept_modes": 6}, "at most 5 for a window of 8"),
        ({"num_condition_heads": 3}, "num_(condition_)?heads"),
    ],
)
def test_impossible_configs_are_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        make_network(**changes)


def test_network_answers_in_the_shape_of_the_window():
    x0_hat = run(make_network(), draw(2, WINDOW, CHANNELS))
    assert x0_hat.shape == (2, WINDOW, CHANNELS) and x0_hat.dtype == jnp.float32
    assert bool(jnp.all(jnp.isfinite(x0_hat)))


def test_wrong_shapes_are_refused_by_name():
    network, condition = make_network(), make_condition()
    for name, wrong in (
        ("history", draw(2, HISTORY + 1, CHANNELS)),
        ("path", draw(2, WINDOW, 7)),
        ("style", draw(2, 3)),
    ):
        with pytest.raises(ValueError, match=f"condition {name} must have shape"):
            network.encode(condition._replace(**{name: wrong}))
    with pytest.raises(ValueError, match=rf"\[B, {WINDOW}, {CHANNELS}\]"):
        run(network, draw(2, WINDOW + 1, CHANNELS), condition=condition)


def test_characters_do_not_mix():
    network, x_noisy, condition = make_network(), draw(2, WINDOW, CHANNELS), make_condition()
    both = run(network, x_noisy, condition=condition)
    for k in range(2):
        part = slice(k, k + 1)
        alone = run(network, x_noisy[part], SIGMA[part], Condition(*(a[part] for a in condition)))
        np.testing.assert_allclose(both[part], alone, atol=2e-5)


def test_output_depends_on_noise_level_style_path_and_history():
    network, x_noisy = make_network(input_scaling=False), draw(2, WINDOW, CHANNELS)
    condition = make_condition()
    base = run(network, x_noisy, 1.0, condition)
    assert float(jnp.abs(run(network, x_noisy, 3.0, condition) - base).max()) > 1e-3
    for name in Condition._fields:
        other = condition._replace(**{name: getattr(condition, name) + 1.0})
        assert float(jnp.abs(run(network, x_noisy, 1.0, other) - base).max()) > 1e-4, name


def test_scalar_noise_level_equals_one_per_character():
    network, x_noisy = make_network(), draw(2, WINDOW, CHANNELS)
    np.testing.assert_allclose(
        run(network, x_noisy, 2.0), run(network, x_noisy, jnp.full(2, 2.0)), atol=1e-5
    )


def test_input_scaling_is_c_in():
    x_noisy = draw(2, WINDOW, CHANNELS)
    for sigma_data in (1.0, 0.5):
        scaled = make_network(sigma_data=sigma_data)
        raw = make_network(input_scaling=False)
        c_in = 1.0 / jnp.sqrt(SIGMA**2 + sigma_data**2)[:, None, None]
        np.testing.assert_allclose(run(scaled, x_noisy), run(raw, c_in * x_noisy), atol=2e-5)
        assert float(jnp.abs(run(scaled, x_noisy) - run(raw, x_noisy)).max()) > 1e-2


def test_raw_presets_have_neither_scaling_nor_normalisation():
    size = {"channels": CHANNELS, "num_styles": 2}
    for name in ("F3AMD-FNO-32", "F3AMD-FNO-96"):
        sane = zoo.build_config(name, **size).to_dict()
        raw = zoo.build_config(f"{name}-raw", **size).to_dict()
        assert {key for key in sane if sane[key] != raw[key]} == {"input_scaling", "normalise"}
        assert not raw["input_scaling"] and not raw["normalise"]


def test_block_residual_starts_as_decoder_of_encoder():
    network, x_noisy = make_network(block_residual=True, depth=3), draw(2, WINDOW, CHANNELS)
    scaled = x_noisy / jnp.sqrt(SIGMA**2 + 1.0)[:, None, None]
    expected = network.decoder(network.encoder(scaled))
    np.testing.assert_allclose(run(network, x_noisy), expected, atol=1e-5)
    plain = make_network(depth=3)
    bare = plain.decoder(plain.encoder(scaled))
    assert float(jnp.abs(run(plain, x_noisy) - bare).max()) > 1e-2


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


def test_residual_prior_weighs_each_cosine_mode_apart():
    x_noisy, sigma = draw(1, WINDOW, CHANNELS), 1.0
    network = make_network(residual_prior=True)
    network.residual_variance[...] = jnp.full((WINDOW, CHANNELS), -3.0)
    estimate = run(network, x_noisy, sigma)
    # Mode 0 free, all others pinned: only the mean over frames follows the noisy input.
    network.residual_variance[...] = network.residual_variance[...].at[0].set(3.0)
    mean = (x_noisy - estimate).mean(axis=1, keepdims=True)
    expected = estimate + jnp.broadcast_to(mean, estimate.shape)
    np.testing.assert_allclose(run(network, x_noisy, sigma), expected, atol=1e-5)


@pytest.mark.parametrize("num_frames", [1, 8, 9, 32])
def test_cosine_basis_is_orthonormal(num_frames):
    basis = cosine_basis(num_frames)
    np.testing.assert_allclose(basis @ basis.T, np.eye(num_frames), atol=1e-12)
    np.testing.assert_allclose(basis[0], np.full(num_frames, num_frames**-0.5), atol=1e-12)


def test_every_parameter_learns():
    network = make_network(history_anchor=True, residual_prior=True)
    x_noisy, wanted = draw(2, WINDOW, CHANNELS), draw(2, WINDOW, CHANNELS, seed=9)
    graph, state = nnx.split(network)
    loss = lambda state: jnp.mean((run(nnx.merge(graph, state), x_noisy) - wanted) ** 2)
    gradient = jax.jit(jax.grad(loss))(state)
    for path, leaf in jax.tree_util.tree_flatten_with_path(gradient)[0]:
        name = jax.tree_util.keystr(path)
        assert bool(jnp.all(jnp.isfinite(leaf))), name
        # A key's bias shifts all scores of a query alike, which softmax does not see.
        if not ("'key'" in name and "'bias'" in name):
            assert float(jnp.abs(leaf).max()) > 1e-9, name
