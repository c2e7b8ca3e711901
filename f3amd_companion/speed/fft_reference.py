"""F3AMD as one would first write it down: complex FFTs and the framework's own convolution.

The library computes the same numbers by real matrix products (see `networks.spectral`). This form is
what that is compared with, in speed and in value.
"""

import jax
import jax.numpy as jnp
from flax import nnx

from f3amd_lib.networks.f3amd import F3AMD
from f3amd_lib.networks.spectral import FNOBlock


def fourier_transform_convolution(z, weight_real, weight_imag):
    """Return IRFFT(W . RFFT(z)[:m]) by fast Fourier transforms (Eq. 2).

    Args:
      z: [B, T, D0].
      weight_real, weight_imag: complex weights as two real arrays, [m, D0, D1].

    Returns:
      [B, T, D1].
    """
    spectrum = jnp.fft.rfft(z, axis=1)[:, : len(weight_real)]
    weight = jax.lax.complex(weight_real, weight_imag)
    return jnp.fft.irfft(jnp.einsum("bmc,mcd->bmd", spectrum, weight), n=z.shape[1], axis=1)


def framework_convolution(z, kernel, bias):
    """Convolve over frames with XLA's own convolution (Conv_k of Eq. 3).

    Args:
      z: [B, T, D0].
      kernel: [k, D0, D1].
      bias: [D1].

    Returns:
      [B, T, D1], zeros beyond the ends of the window.
    """
    return bias + jax.lax.conv_general_dilated(z, kernel, (1,), "SAME", dimension_numbers=("NWC", "WIO", "NWC"))


class _FFTBlock(nnx.Module):
    """An `FNOBlock` by fast Fourier transforms, with the weights of another."""

    def __init__(self, block: FNOBlock):
        self.spectral, self.local_first, self.local_second = block.spectral, block.local_first, block.local_second

    def __call__(self, z, key=None):
        weights = self.spectral.weight_real[...], self.spectral.weight_imag[...]
        local = nnx.silu(z)
        for layer in (self.local_first, self.local_second):
            local = nnx.silu(framework_convolution(local, layer.kernel[...], layer.bias[...]))
        return fourier_transform_convolution(z, *weights) + local


def fft_reference(network: F3AMD) -> F3AMD:
    """Return a copy of a network whose Fourier blocks are computed by fast Fourier transforms.

    Args:
      network: with FNO blocks of the variant "fourier".

    Returns:
      A network with the same weights and the same answers, to rounding.

    Raises:
      ValueError: if the network has no FNO block, or blocks of another variant.
    """
    config = network.config
    if getattr(config, "base_block", None) != "fno" or config.spectral_variant != "fourier":
        raise ValueError("only networks of Fourier blocks have this form")
    reference = nnx.clone(network)
    reference.blocks = nnx.List([_FFTBlock(block) for block in reference.blocks])
    if config.encoder_decoder == "fno":
        reference.encoder, reference.decoder = _FFTBlock(reference.encoder), _FFTBlock(reference.decoder)
    return reference
