"""Two forms of a Fourier block give the same numbers."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from builders import CHANNELS, WINDOW, draw, evaluate, make_condition, network_of, tiny_config

from f3amd_companion.speed.fft_reference import fft_reference, fourier_transform_convolution, framework_convolution
from f3amd_lib.networks.spectral import spectral_convolution


@pytest.mark.parametrize("num_frames", [32, 64, 33])
@pytest.mark.parametrize("cut", [False, True])
def test_eq02_matrix_products_equal_the_fft(num_frames, cut):
    rng = np.random.default_rng(0)
    modes = 5 if cut else num_frames // 2 + 1
    z = jnp.asarray(rng.standard_normal((3, num_frames, 6)), jnp.float32)
    real, imag = jnp.asarray(rng.standard_normal((2, modes, 6, 4)) / 4, jnp.float32)
    by_fft = fourier_transform_convolution(z, real, imag)
    np.testing.assert_allclose(spectral_convolution(z, real, imag), by_fft, atol=1e-5)


def test_eq03_framework_convolution_sees_the_neighbours():
    z = jnp.arange(5.0)[None, :, None]
    kernel = jnp.asarray([1.0, 10.0, 100.0])[:, None, None]
    found = framework_convolution(z, kernel, jnp.asarray([0.5]))[0, :, 0]
    by_hand = [0.5 + 10 * t + (t - 1 if t else 0) + (100 * (t + 1) if t < 4 else 0) for t in range(5)]
    np.testing.assert_allclose(found, by_hand)


@pytest.mark.parametrize("encoder_decoder", ["fno", "linear"])
def test_the_network_by_fft_gives_the_same_answers(encoder_decoder):
    network = network_of(tiny_config(encoder_decoder=encoder_decoder))
    reference = fft_reference(network)
    given, x_noisy = make_condition(), 5.0 * draw(2, WINDOW, CHANNELS)
    expected = evaluate(network, x_noisy, 5.0, given)
    np.testing.assert_allclose(evaluate(reference, x_noisy, 5.0, given), expected, atol=1e-5)
    program = lambda form: str(jax.make_jaxpr(lambda x: form(x, 5.0, form.encode(given)))(x_noisy))
    assert "fft" in program(reference) and "conv_general" in program(reference)
    assert "fft" not in program(network) and "conv_general" not in program(network)
