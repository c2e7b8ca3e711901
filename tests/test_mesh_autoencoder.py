"""The mesh autoencoder: the paper's size by hand, each layer against a loop, and learning."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from builders import SKELETON, refused, wandering_motion
from compiled import Compiled
from flax import nnx

from f3amd_lib.networks import presets
from f3amd_lib.text.data.body_mesh import BodyMesh
from f3amd_lib.text.networks.autoencoders import MeshAutoencoder, MeshAutoencoderConfig, MeshConvolution, MeshPooling

SIZES = {"coarse_levels": (24, 8), "channels": (6, 8), "latent_channels": 5, "num_bases": 3,
         "around": (5, 4), "down": (16, 8), "up": (3, 2)}  # fmt: skip
CONFIG = MeshAutoencoderConfig(num_vertices=42 * 6, **SIZES)
MESH = BodyMesh.of(SKELETON, CONFIG.levels, **CONFIG.neighbours)
VERTICES = MESH.vertices(wandering_motion(8).positions).astype(np.float32)
GENERATOR = np.random.default_rng(0)


def test_the_papers_network_has_the_parameters_counted_by_hand():
    """Released sizes: vertices x neighbours x 9 coefficients, 9 matrices and a bias; pooling weights, linear maps."""
    wide, levels = (3, 64, 128, 256, 512), (6890, 1925, 400, 54)
    count = 12 * 512 * 2  # into the latent and out of it
    for level, around in enumerate((10, 21, 26, 19)):
        one, other = wide[level], wide[level + 1]
        count += 2 * (levels[level] * around * 9 + 9 * one * other) + one + other
    count += 1925 * 32 + 400 * 56 + 54 * 66 + 28 * 33 + 6890 * 11 + 1925 * 14 + 400 * 11 + 54 * 1
    assert presets.count_parameters(presets.build_config("ACMDM-mesh-AE")) == count
    for size in ("S", "B", "L", "XL"):
        config = presets.build_config(f"ACMDM-{size}-PS28", text_width=512)
        assert config.state_shape(2) == (2, 196, 28, 12) and config.num_patches == 1


def test_a_convolution_is_the_sum_over_edges():
    neighbours = GENERATOR.integers(0, 7, (4, 3))
    layer = MeshConvolution(4, 3, 2, 5, 6, rngs=nnx.Rngs(0))
    layer.bias[...] = jnp.arange(6.0)
    x = GENERATOR.normal(size=(7, 2, 5)).astype(np.float32)
    bases, own = np.asarray(layer.bases[...]).reshape(2, 5, 6), np.asarray(layer.coefficients[...])
    wanted = np.zeros((4, 2, 6)) + np.arange(6.0)
    for i in range(4):
        for j in range(3):
            wanted[i] += x[neighbours[i, j]] @ sum(own[i, k, j] * bases[k] for k in range(2))
    np.testing.assert_allclose(Compiled(layer)(x, neighbours), wanted, atol=1e-5)


def test_pooling_is_a_mean_by_the_sizes_of_its_weights():
    layer = MeshPooling(2, 2, 3, 3, rngs=nnx.Rngs(0))
    layer.weights[...] = jnp.array([[1.0, -3.0], [0.0, 2.0]])
    x = jnp.arange(12.0).reshape(4, 1, 3)
    pooled = layer(x, np.array([[0, 1], [2, 3]]))
    np.testing.assert_allclose(pooled[:, 0], [0.25 * x[0, 0] + 0.75 * x[1, 0], x[3, 0]])
    wide = MeshPooling(2, 2, 3, 7, rngs=nnx.Rngs(0))
    assert wide(x, np.array([[0, 1], [2, 3]])).shape == (2, 1, 7) and layer.linear is None


@pytest.mark.parametrize("linear", [True, False])
def test_elu_follows_convolutions_alone_and_not_the_decoders_last(linear):
    """Against numpy; in files of earlier versions it follows poolings, too, but the encoder's last."""
    network = MeshAutoencoder(dataclasses.replace(CONFIG, linear_pooling=linear), rngs=nnx.Rngs(0))
    encode, decode = (jax.jit(lambda x, way=way: way(x, MESH.lists)) for way in (network.encode, network.decode))
    elu = lambda x: np.where(x > 0, x, np.expm1(np.minimum(x, 0.0)))

    def convolved(layer, x, near):
        bases = np.asarray(layer.bases[...]).reshape(CONFIG.num_bases, x.shape[1], -1)
        coefficients, bias = np.asarray(layer.coefficients[...]), np.asarray(layer.bias[...])
        return np.einsum("vbk,vkc,bcd->vd", coefficients, x[near], bases) + bias

    def pooled(layer, x, near):
        weights = np.abs(np.asarray(layer.weights[...]))
        x = np.einsum("vk,vkc->vc", weights / weights.sum(axis=1, keepdims=True), x[near])
        return x if layer.linear is None else x @ np.asarray(layer.linear.kernel[...])

    mean = lambda x: x if linear else elu(x)
    lists, (c1, p1, c2, p2), (u2, d2, u1, d1) = MESH.lists, network.encoder, network.decoder
    (a1, a2), (down1, down2), (up1, up2) = (list(map(np.asarray, few)) for few in (lists.around, lists.down, lists.up))
    x = mean(pooled(p1, elu(convolved(c1, VERTICES[0], a1)), down1))
    latent = pooled(p2, elu(convolved(c2, x, a2)), down2)
    np.testing.assert_allclose(encode(VERTICES[:1])[0], latent, atol=1e-5)
    x = mean(pooled(u1, elu(convolved(d2, mean(pooled(u2, latent, up2)), a2)), up1))
    np.testing.assert_allclose(decode(latent[None])[0], convolved(d1, x, a1), atol=1e-5)


def test_what_makes_no_sense_is_refused():
    for changes, words in (
        ({"coarse_levels": (300, 8)}, "coarse_levels must be as many numbers .*, got .300, 8."),
        ({"channels": (6,)}, "channels must be as many numbers"),
        ({"around": (5, 0)}, "each of around must be above 0"),
    ):
        refused(words, MeshAutoencoderConfig, num_vertices=252, **SIZES | changes)
    network = MeshAutoencoder(CONFIG, rngs=nnx.Rngs(0))
    refused(r"vertices must be \[N, 252, 3\]", network.encode, VERTICES[:, 1:], MESH.lists)
    assert MeshAutoencoderConfig.from_dict(CONFIG.to_dict()) == CONFIG
