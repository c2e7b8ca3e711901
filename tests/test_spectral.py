"""The FNO block against numpy's FFT, scipy's DCT and flax's convolution (Eqs 2-4, Table 8)."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.fft
from builders import refused
from compiled import Compiled
from flax import nnx

from f3amd_lib.networks.spectral import (
    SPECTRAL_VARIANTS,
    FNOBlock,
    SpectralConvolution,
    TemporalConvolution,
    cosine_basis,
    count_modes,
    fourier_matrices,
    spectral_convolution,
)

# One program for each shape, where operation after operation is a dozen.
spectral_convolution = jax.jit(spectral_convolution)


def draw(*shape, seed=0):
    return np.random.default_rng(seed).standard_normal(shape).astype(np.float32)


def fft_convolution(z, weight_real, weight_imag):
    """Eq. 2 as it is printed, with numpy's transforms."""
    num_frames, modes = z.shape[1], weight_real.shape[0]
    weights = weight_real + 1j * weight_imag
    mixed = np.einsum("bmd,mde->bme", np.fft.rfft(z, axis=1)[:, :modes], weights)
    spectrum = np.zeros((z.shape[0], num_frames // 2 + 1, weights.shape[2]), complex)
    spectrum[:, :modes] = mixed
    return np.fft.irfft(spectrum, n=num_frames, axis=1)


@pytest.mark.parametrize(("num_frames", "modes"), [(32, 17), (32, 1), (31, 16), (7, 3), (1, 1)])
def test_eq02_equals_numpy_fft(num_frames, modes):
    z = draw(3, num_frames, 5)
    weight_real, weight_imag = draw(modes, 5, 4, seed=1), draw(modes, 5, 4, seed=2)
    expected = fft_convolution(z, weight_real, weight_imag)
    got = spectral_convolution(jnp.asarray(z), weight_real, weight_imag)
    assert got.dtype == jnp.float32
    np.testing.assert_allclose(got, expected, atol=1e-5 * np.abs(expected).max())


@pytest.mark.parametrize(("num_frames", "modes"), [(8, 0), (8, 6), (9, 6)])
def test_eq02_modes_out_of_range_are_refused(num_frames, modes):
    refused(f"between 1 and 5 for {num_frames} frames, got {modes}", fourier_matrices, num_frames, modes)


@pytest.mark.parametrize("num_frames", [31, 32])
@pytest.mark.parametrize("variant", SPECTRAL_VARIANTS)
def test_eq02_initial_weights_keep_the_variance(variant, num_frames):
    modes = count_modes(variant, num_frames)
    layer = SpectralConvolution(64, 64, modes, variant, rank=32, initial_gain=1.0, rngs=nnx.Rngs(params=0))
    # Of a complex weight, the real part alone acts on bins 0 and T / 2: half of their variance.
    halved = {"cosine": 0.0}.get(variant, (2 - num_frames % 2) / num_frames / 2)
    variance = Compiled(layer)(draw(256, num_frames, 64)).var()
    assert variance == pytest.approx(1.0 - halved, abs=0.03)


@pytest.mark.parametrize("num_frames", [1, 7, 32])
def test_table_8_cosine_basis_is_orthonormal(num_frames):
    basis = cosine_basis(num_frames)
    np.testing.assert_allclose(basis @ basis.T, np.eye(num_frames), atol=1e-12)
    np.testing.assert_array_equal(cosine_basis(num_frames, 1), basis[:1])
    with pytest.raises(ValueError, match="read-only"):
        basis[0] = 7.0


@pytest.mark.parametrize(("num_frames", "modes"), [(8, 8), (9, 4), (1, 1)])
def test_table_8_cosine_layer_equals_scipys_transform(num_frames, modes):
    layer = SpectralConvolution(3, 4, modes, "cosine", rngs=nnx.Rngs(params=0))
    z, weight = draw(2, num_frames, 3), np.asarray(layer.weight[...])
    mixed = np.zeros((2, num_frames, 4))
    spectrum = scipy.fft.dct(z.astype(np.float64), norm="ortho", axis=1)
    mixed[:, :modes] = np.einsum("bkc,kcd->bkd", spectrum[:, :modes], weight)
    expected = scipy.fft.idct(mixed, norm="ortho", axis=1)
    np.testing.assert_allclose(Compiled(layer)(z), expected, atol=1e-5)


def test_eq02_gains_start_at_seven_tenths_and_scale_one_mode_each():
    layer = SpectralConvolution(3, 4, 5, "weighted", rngs=nnx.Rngs(params=0))
    np.testing.assert_array_equal(layer.gain[...], np.full(5, 0.7, np.float32))
    z, gain = draw(2, 8, 3), np.array([1.0, 0.0, -2.0, 0.5, 3.0], np.float32)
    layer.gain[...] = jnp.asarray(gain)
    weights = np.asarray(layer.weight_real[...]), np.asarray(layer.weight_imag[...])
    expected = fft_convolution(z, *(w * gain[:, None, None] for w in weights))
    np.testing.assert_allclose(layer(z), expected, atol=1e-5)


@pytest.mark.parametrize(("num_frames", "modes"), [(8, 5), (9, 2)])
def test_eq02_factors_of_a_kernel_of_rank_eight_equal_the_dense_layer(num_frames, modes):
    rng = np.random.default_rng(0)
    complex_normal = lambda *shape: rng.standard_normal(shape) + 1j * rng.standard_normal(shape)
    dense = complex_normal(modes, 12, 8) @ complex_normal(modes, 8, 10)
    left, singular, right = np.linalg.svd(dense, full_matrices=False)
    assert singular[:, 8:].max() < 1e-12 < singular[:, 7].min()
    first, second = left[..., :8] * singular[:, None, :8], right[:, :8]
    layer = SpectralConvolution(12, 10, modes, "reduced_rank", rngs=nnx.Rngs(params=0))
    layer.first_real[...], layer.first_imag[...] = jnp.asarray(first.real), jnp.asarray(first.imag)
    layer.second_real[...] = jnp.asarray(second.real)
    layer.second_imag[...] = jnp.asarray(second.imag)
    z = draw(2, num_frames, 12)
    expected = fft_convolution(z, dense.real, dense.imag)
    np.testing.assert_allclose(Compiled(layer)(z), expected, atol=1e-5 * np.abs(expected).max())


@pytest.mark.parametrize("rank", [0, 4])
def test_eq02_rank_out_of_range_is_refused(rank):
    with pytest.raises(ValueError, match=f"between 1 and 3 for 3 to 4, got {rank}"):
        SpectralConvolution(3, 4, 5, "reduced_rank", rank=rank, rngs=nnx.Rngs(params=0))


def flax_convolution(layer):
    """An `nnx.Conv` with the same kernel and bias."""
    size, width_in, width_out = layer.kernel[...].shape
    conv = nnx.Conv(width_in, width_out, kernel_size=(size,), padding="SAME", rngs=nnx.Rngs(0))
    conv.kernel[...] = layer.kernel[...]
    conv.bias[...] = layer.bias[...]
    return conv


@pytest.mark.parametrize("kernel_size", [1, 2, 5])
@pytest.mark.parametrize("num_frames", [2, 9])
def test_eq03_convolution_equals_flax(kernel_size, num_frames):
    layer = TemporalConvolution(3, 4, kernel_size, rngs=nnx.Rngs(params=0))
    layer.bias[...] = jnp.asarray(draw(4, seed=3))
    z = draw(2, num_frames, 3)
    np.testing.assert_allclose(Compiled(layer)(z), Compiled(flax_convolution(layer))(z), atol=1e-5)


def test_eq03_local_branch_is_three_silus_and_two_convolutions():
    block = FNOBlock(3, 4, 5, rngs=nnx.Rngs(params=0))
    silu = lambda x: x / (1.0 + np.exp(-x))
    z = draw(2, 8, 3)
    first, second = flax_convolution(block.local_first), flax_convolution(block.local_second)
    hidden = np.asarray(first(jnp.asarray(silu(z))))
    assert hidden.shape == (2, 8, 3)  # section 3.4.2: d0 to d0, then d0 to d1
    expected = silu(np.asarray(second(jnp.asarray(silu(hidden)))))
    np.testing.assert_allclose(block.local(z), expected, atol=1e-5)


@pytest.mark.parametrize(("width_in", "width_out"), [(3, 4), (4, 4), (4, 3)])
def test_eq04_block_is_the_sum_of_both_branches(width_in, width_out):
    block = FNOBlock(width_in, width_out, 3, rngs=nnx.Rngs(params=0))
    z = draw(2, 8, width_in)
    weights = block.spectral.weight_real[...], block.spectral.weight_imag[...]
    block = Compiled(block)
    expected = fft_convolution(z, *(np.asarray(w) for w in weights)) + block.local(z)
    got = block(z)
    assert got.shape == (2, 8, width_out)
    np.testing.assert_allclose(got, expected, atol=1e-5)
