"""The motion autoencoder: sizes, causality, joints apart, padding."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from f3amd_lib.networks import presets
from f3amd_lib.text.networks import autoencoders

POSITIONS = jax.random.normal(jax.random.key(0), (2, 32, 3, 3))


@functools.cache
def tiny(**settings):
    return autoencoders.MotionAutoencoder(
        autoencoders.AutoencoderConfig(width=8, dilations=(3, 1), **settings), rngs=nnx.Rngs(0)
    )


@nnx.jit
def there_and_back(model, positions, mask=None):
    return model.decode(model.latent_of(positions, mask), None if mask is None else mask[:, ::4])


@nnx.jit
def latent(model, positions, mask=None):
    return model.latent_of(positions, mask)


@nnx.jit
def encode(model, positions):
    return model.encode(positions)


def test_sizes_are_those_of_the_released_file():
    config = presets.build_config("ACMDM-causal-AE")
    model = nnx.eval_shape(lambda: autoencoders.MotionAutoencoder(config, rngs=nnx.Rngs(0)))
    count = lambda part: sum(leaf.size for leaf in jax.tree.leaves(nnx.state(part))) / 1e6
    assert count(model) == pytest.approx(17.08, abs=0.005)
    assert (count(model.encoder), count(model.decoder)) == pytest.approx((8.41, 8.67), abs=0.005)
    assert (config.frames_per_latent, config.latent_channels, config.dropout) == (4, 4, 0.2)


@pytest.mark.parametrize("size, stride, dilation", [(3, 1, 9), (4, 2, 1), (1, 1, 1)])
@pytest.mark.parametrize("causal", [True, False])
def test_a_matrix_product_of_taps_is_the_convolution(size, stride, dilation, causal):
    options = {"causal": causal, "stride": stride, "dilation": dilation}
    ours = autoencoders.TimeConvolution(5, 7, size, **options, rngs=nnx.Rngs(0))
    x = jax.random.normal(jax.random.key(1), (2, 16, 5))
    padded = jnp.pad(x, ((0, 0), (ours.before, ours.after), (0, 0)))
    np.testing.assert_allclose(ours(x), ours.layer(padded), atol=1e-5)


def test_a_causal_autoencoder_sees_no_later_latent_frame():
    """Frame k of the answer depends on frames up to 4 floor(k / 4) + 3 alone."""
    for causal in (True, False):
        model = tiny(causal=causal)
        first = there_and_back(model, POSITIONS)
        # A causal latent frame ends with its own four frames: frame 16 is not in latent frame 3.
        for frame, unchanged in ((15, 12), (16, 16)):
            other = there_and_back(model, POSITIONS.at[:, frame].add(5.0))
            before = float(jnp.abs(other[:, :unchanged] - first[:, :unchanged]).max())
            assert (before == 0.0) == causal, (causal, frame)
            after = np.abs(other - first)[:, unchanged : unchanged + 4].max()
            assert after > 1e-4


def test_joints_are_never_mixed_and_share_their_weights():
    model = tiny()
    first = there_and_back(model, POSITIONS)
    other = there_and_back(model, POSITIONS.at[:, :, 1].add(1.0))
    np.testing.assert_array_equal(other[:, :, [0, 2]], first[:, :, [0, 2]])
    assert float(jnp.abs(other[:, :, 1] - first[:, :, 1]).max()) > 1e-3
    swapped = there_and_back(model, POSITIONS[:, :, ::-1])
    np.testing.assert_allclose(swapped[:, :, ::-1], first, atol=1e-6)


@pytest.mark.parametrize("causal", [True, False])
def test_padding_changes_nothing(causal):
    model = tiny(causal=causal)
    mask = jnp.arange(32) < jnp.asarray([20, 32])[:, None]
    padded = jnp.where(mask[..., None, None], POSITIONS, 9.0)
    answer = there_and_back(model, padded, mask)
    np.testing.assert_allclose(answer[0, :20], there_and_back(model, POSITIONS[:1, :20])[0], atol=1e-5)
    np.testing.assert_allclose(answer[1], there_and_back(model, POSITIONS[1:])[0], atol=1e-5)
    if not causal:  # it would, without the mask
        assert float(jnp.abs(there_and_back(model, padded)[0, :20] - answer[0, :20]).max()) > 1e-3


def test_a_variational_latent_is_the_mean_and_its_variance_is_bounded():
    model = tiny(variational=True)
    encoded = encode(model, POSITIONS)
    mean, log_variance = model.moments(1000.0 * encoded)
    assert mean.shape == (2, 8, 3, 4) and (log_variance.min(), log_variance.max()) == autoencoders.LOG_VARIANCE_RANGE
    np.testing.assert_array_equal(latent(model, POSITIONS), model.moments(encoded)[0])


def test_dropout_falls_in_training_alone():
    model, key = tiny(dropout=0.5), jax.random.key(1)
    assert float(jnp.abs(model.encode(POSITIONS, key=key) - model.encode(POSITIONS)).max()) > 1e-3
    np.testing.assert_array_equal(model.encode(POSITIONS), model.encode(POSITIONS))


def test_losses_are_their_formulas():
    x = jnp.zeros((2, 4, 1, 1))
    far = x.at[0].set(0.5).at[1].set(3.0)
    assert float(autoencoders.smooth_l1(far, x)) == pytest.approx((0.125 + 2.5) / 2)
    mask = jnp.asarray([[True] * 4, [False] * 4])
    assert float(autoencoders.smooth_l1(far, x, mask)) == pytest.approx(0.125)
    # One sample at a distance of 2 everywhere: s = ln 2 (the soft floor is far away), fit = n (1/2 + ln 2).
    loss = autoencoders.variational_loss(
        jnp.full((1, 4, 1, 1), 2.0), jnp.zeros((1, 4, 1, 1)), jnp.ones((1, 1, 1, 2)), jnp.zeros((1, 1, 1, 2))
    )
    assert float(loss) == pytest.approx(4 * (0.5 + np.log(2.0)) + 0.01 * 0.5 * 2, abs=1e-2)
    exact = autoencoders.variational_loss(x, x, jnp.zeros((2, 1, 1, 2)), jnp.zeros((2, 1, 1, 2)))
    # Without any error the root is kept at 1e-6, and s softly above -6.
    assert float(exact) == pytest.approx(4 * (-6.0 + np.log1p(1e-6 * np.exp(6.0))), abs=1e-5)
