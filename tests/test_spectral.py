"""The FNO block against numpy's FFT and flax's convolution (Eqs 2-4)."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from f3amd_lib.models.spectral import (
    FNOBlock,
    SpectralConvolution,
    TemporalConvolution,
    fourier_matrices,
    spectral_convolution,
)


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


@pytest.mark.parametrize(
    ("num_frames", "modes"),
    [(32, 17), (32, 12), (32, 1), (31, 16), (31, 5), (7, 4), (8, 5), (2, 2), (1, 1)],
)
def test_eq02_equals_numpy_fft(num_frames, modes):
    z = draw(3, num_frames, 5)
    weight_real, weight_imag = draw(modes, 5, 4, seed=1), draw(modes, 5, 4, seed=2)
    expected = fft_convolution(z, weight_real, weight_imag)
    got = spectral_convolution(jnp.asarray(z), weight_real, weight_imag)
    assert got.dtype == jnp.float32
    np.testing.assert_allclose(got, expected, atol=1e-5 * np.abs(expected).max())


def test_eq02_in_float64_equals_numpy_fft_to_rounding():
    z = draw(2, 32, 5).astype(np.float64)
    weight_real, weight_imag = draw(17, 5, 4, seed=1), draw(17, 5, 4, seed=2)
    with jax.enable_x64(True):
        got = spectral_convolution(
            jnp.asarray(z),
            jnp.asarray(weight_real, jnp.float64),
            jnp.asarray(weight_imag, jnp.float64),
        )
        np.testing.assert_allclose(got, fft_convolution(z, weight_real, weight_imag), atol=1e-12)


@pytest.mark.parametrize("num_frames", [8, 9])
def test_eq02_all_bins_are_a_circular_convolution(num_frames):
    z, kernel = draw(2, num_frames, 3), draw(num_frames, 3, 4, seed=1)
    weights = np.fft.rfft(kernel, axis=0)
    expected = np.zeros((2, num_frames, 4))
    for t in range(num_frames):
        for lag in range(num_frames):
            expected[:, t] += z[:, (t - lag) % num_frames] @ kernel[lag]
    got = spectral_convolution(jnp.asarray(z), weights.real, weights.imag)
    np.testing.assert_allclose(got, expected, atol=1e-4)


@pytest.mark.parametrize(("num_frames", "modes"), [(8, 5), (8, 3), (9, 2)])
def test_eq02_shifting_the_input_shifts_the_output(num_frames, modes):
    z, weight_real = draw(2, num_frames, 3), draw(modes, 3, 4, seed=1)
    weight_imag = draw(modes, 3, 4, seed=2)
    plain = spectral_convolution(jnp.asarray(z), weight_real, weight_imag)
    shifted = spectral_convolution(jnp.roll(z, 3, axis=1), weight_real, weight_imag)
    np.testing.assert_allclose(shifted, jnp.roll(plain, 3, axis=1), atol=1e-5)
    assert float(jnp.abs(shifted - plain).max()) > 0.01


def test_eq02_one_bin_is_the_time_mean():
    z, weight = draw(2, 9, 3), draw(1, 3, 4, seed=1)
    # The imaginary weight of bin 0 has nothing to act on in a real signal.
    got = spectral_convolution(jnp.asarray(z), weight, draw(1, 3, 4, seed=2))
    expected = np.repeat(z.mean(axis=1, keepdims=True) @ weight[0], 9, axis=1)
    np.testing.assert_allclose(got, expected, atol=1e-5)


@pytest.mark.parametrize("num_frames", [1, 2, 7, 8])
def test_eq02_all_bins_with_unit_weights_change_nothing(num_frames):
    analysis, synthesis = fourier_matrices(num_frames, num_frames // 2 + 1)
    round_trip = synthesis.reshape(num_frames, -1) @ analysis.reshape(-1, num_frames)
    np.testing.assert_allclose(round_trip, np.eye(num_frames), atol=1e-13)


def test_fourier_matrices_cannot_be_spoilt_by_a_caller():
    analysis, synthesis = fourier_matrices(8, 5)
    for matrix in (analysis, synthesis):
        with pytest.raises(ValueError, match="read-only"):
            matrix[0] = 7.0


@pytest.mark.parametrize(("num_frames", "modes"), [(8, 0), (8, 6), (9, 6)])
def test_eq02_modes_out_of_range_are_refused(num_frames, modes):
    with pytest.raises(ValueError, match=f"between 1 and 5 for {num_frames} frames, got {modes}"):
        fourier_matrices(num_frames, modes)


def test_eq02_initial_weights_keep_the_variance():
    layer = SpectralConvolution(64, 64, 17, rngs=nnx.Rngs(params=0))
    assert layer(draw(256, 32, 64)).var() == pytest.approx(1.0, abs=0.08)


def test_eq02_gradients_are_finite_and_reach_every_weight():
    layer = SpectralConvolution(3, 4, 5, rngs=nnx.Rngs(params=0))
    z, wanted = draw(6, 8, 3), draw(6, 8, 4, seed=1)
    gradient = nnx.grad(lambda m: jnp.mean((m(z) - wanted) ** 2))(layer)
    real, imag = np.asarray(gradient["weight_real"][...]), np.asarray(gradient["weight_imag"][...])
    assert np.all(np.isfinite(real)) and np.all(np.isfinite(imag))
    assert np.all(np.abs(real).max(axis=(1, 2)) > 1e-4)
    assert np.all(np.abs(imag[1:-1]).max(axis=(1, 2)) > 1e-4)
    # Bins 0 and T / 2 of a real signal have no imaginary part to learn.
    assert np.abs(imag[[0, -1]]).max() < 1e-6


def flax_convolution(layer):
    """An `nnx.Conv` with the same kernel and bias."""
    size, width_in, width_out = layer.kernel[...].shape
    conv = nnx.Conv(width_in, width_out, kernel_size=(size,), padding="SAME", rngs=nnx.Rngs(0))
    conv.kernel[...] = layer.kernel[...]
    conv.bias[...] = layer.bias[...]
    return conv


@pytest.mark.parametrize("kernel_size", [1, 2, 3, 4, 5])
@pytest.mark.parametrize("num_frames", [2, 9])
def test_eq03_convolution_equals_flax(kernel_size, num_frames):
    layer = TemporalConvolution(3, 4, kernel_size, rngs=nnx.Rngs(params=0))
    layer.bias[...] = jnp.asarray(draw(4, seed=3))
    z = draw(2, num_frames, 3)
    np.testing.assert_allclose(layer(z), flax_convolution(layer)(z), atol=1e-5)


def test_eq03_convolution_by_hand():
    layer = TemporalConvolution(1, 1, 3, rngs=nnx.Rngs(params=0))
    layer.kernel[...] = jnp.array([[[100.0]], [[10.0]], [[1.0]]])
    layer.bias[...] = jnp.array([0.5])
    got = layer(jnp.array([[[1.0], [2.0], [3.0]]]))
    # Tap 0 reads the frame before, tap 2 the frame after; zeros beyond the ends.
    np.testing.assert_allclose(got[0, :, 0], [12.5, 123.5, 230.5])


def test_eq03_initial_kernel_has_flaxs_spread():
    ours = TemporalConvolution(64, 32, 3, rngs=nnx.Rngs(params=0)).kernel[...]
    theirs = nnx.Conv(64, 32, kernel_size=(3,), rngs=nnx.Rngs(0)).kernel[...]
    assert float(ours.std()) == pytest.approx(float(theirs.std()), rel=0.05)


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
    expected = fft_convolution(z, *(np.asarray(w) for w in weights)) + block.local(z)
    got = block(z)
    assert got.shape == (2, 8, width_out)
    np.testing.assert_allclose(got, expected, atol=1e-5)


def test_characters_do_not_mix():
    block, z = FNOBlock(3, 4, 5, rngs=nnx.Rngs(params=0)), draw(4, 8, 3)
    alone = np.concatenate([block(z[k : k + 1]) for k in range(4)])
    np.testing.assert_allclose(block(z), alone, atol=1e-5)
