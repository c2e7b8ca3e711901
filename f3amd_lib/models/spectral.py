"""The Fourier Neural Operator block (paper section 3.4.2, Eqs 2-4).

The paper writes channels first, z in R^{D x t}; arrays here are [batch, frames, channels].
Windows are short (32 or 64 frames), so the real Fourier transform is a product with a small cosine
and sine matrix: the same numbers as an FFT, and faster on the hardware this was measured on.
"""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

__all__ = [
    "fourier_matrices",
    "spectral_convolution",
    "SpectralConvolution",
    "TemporalConvolution",
    "FNOBlock",
]


@functools.lru_cache(maxsize=32)
def fourier_matrices(num_frames: int, num_kept_modes: int) -> tuple[np.ndarray, np.ndarray]:
    """Return RFFT and IRFFT over `num_frames`, cut to the first m bins, as real matrices.

    Args:
      num_frames: window length T, odd or even.
      num_kept_modes: m, the number of RFFT bins kept, 1 <= m <= T // 2 + 1. (Some FNO libraries
        count modes differently; here m = T // 2 + 1 cuts nothing.)

    Returns:
      (analysis [m, 2, T], synthesis [T, m, 2]), float64, read-only (they are cached): real part,
      then imaginary part.

    Raises:
      ValueError: if m is out of range.
    """
    bins = num_frames // 2 + 1
    if not 1 <= num_kept_modes <= bins:
        raise ValueError(
            f"num_kept_modes must be between 1 and {bins} for {num_frames} frames, "
            f"got {num_kept_modes}"
        )
    mode = np.arange(num_kept_modes)[:, None]
    angle = 2.0 * np.pi * mode * np.arange(num_frames)[None, :] / num_frames
    analysis = np.stack([np.cos(angle), -np.sin(angle)], axis=1)
    # Each bin but the first (and the last of an even T) stands for itself and its conjugate.
    paired = np.where((mode == 0) | (2 * mode == num_frames), 1.0, 2.0) / num_frames
    synthesis = np.stack([paired * np.cos(angle), -paired * np.sin(angle)], axis=1)
    synthesis = np.ascontiguousarray(np.moveaxis(synthesis, -1, 0))
    for matrix in (analysis, synthesis):
        matrix.setflags(write=False)
    return analysis, synthesis


def spectral_convolution(z, weight_real, weight_imag):
    """Return IRFFT(W . RFFT(z)[:m]) over the frame axis (Eq. 2).

    Args:
      z: [B, T, D0].
      weight_real, weight_imag: the complex weights W as two real arrays, [m, D0, D1].

    Returns:
      [B, T, D1].
    """
    batch, num_frames, width_in = z.shape
    modes, _, width_out = weight_real.shape
    analysis, synthesis = fourier_matrices(num_frames, modes)
    analysis = jnp.asarray(analysis.reshape(2 * modes, num_frames), z.dtype)
    synthesis = jnp.asarray(synthesis.reshape(num_frames, 2 * modes), z.dtype)
    spectrum = jnp.einsum("ft,btc->fbc", analysis, z).reshape(modes, 2 * batch, width_in)
    # One batched product gives all four real products of the complex one.
    products = spectrum @ jnp.concatenate([weight_real, weight_imag], axis=-1)
    products = products.reshape(modes, 2, batch, 2, width_out)
    real = products[:, 0, :, 0] - products[:, 1, :, 1]
    imag = products[:, 0, :, 1] + products[:, 1, :, 0]
    mixed = jnp.stack([real, imag], axis=1).reshape(2 * modes, batch, width_out)
    return jnp.einsum("tf,fbd->btd", synthesis, mixed)


class SpectralConvolution(nnx.Module):
    """Learned complex weights on the first m Fourier modes (Eq. 2)."""

    def __init__(self, width_in: int, width_out: int, num_kept_modes: int, *, rngs: nnx.Rngs):
        # Unit gain: white input of variance 1 leaves with variance about 1 when no bin is cut.
        scale = 1.0 / np.sqrt(2.0 * width_in)
        shape = (num_kept_modes, width_in, width_out)
        self.weight_real = nnx.Param(scale * jax.random.normal(rngs.params(), shape))
        self.weight_imag = nnx.Param(scale * jax.random.normal(rngs.params(), shape))

    def __call__(self, z):
        """Map [B, T, D0] to [B, T, D1]."""
        return spectral_convolution(z, self.weight_real[...], self.weight_imag[...])


class TemporalConvolution(nnx.Module):
    """Convolution over frames, zeros beyond the window's ends (Conv_k of Eq. 3).

    Written as neighbouring frames side by side and one matrix product: the numbers of `nnx.Conv`,
    whose gradient XLA runs some twenty times slower on a CPU once training steps are scanned.
    """

    def __init__(self, width_in: int, width_out: int, kernel_size: int, *, rngs: nnx.Rngs):
        initial = nnx.initializers.lecun_normal(in_axis=(0, 1), out_axis=2)
        self.kernel = nnx.Param(initial(rngs.params(), (kernel_size, width_in, width_out)))
        self.bias = nnx.Param(jnp.zeros(width_out))

    def __call__(self, z):
        """Map [B, T, D0] to [B, T, D1]."""
        kernel = self.kernel[...]
        taps, width_in, width_out = kernel.shape
        frames = z.shape[1]
        before = (taps - 1) // 2
        padded = jnp.pad(z, ((0, 0), (before, taps - 1 - before), (0, 0)))
        beside = jnp.concatenate([padded[:, k : k + frames] for k in range(taps)], axis=-1)
        return beside @ kernel.reshape(taps * width_in, width_out) + self.bias[...]


class FNOBlock(nnx.Module):
    """Spectral branch plus local branch (Eqs 2-4); encoder or decoder if the widths differ."""

    def __init__(
        self,
        width_in: int,
        width_out: int,
        num_kept_modes: int,
        kernel_size: int = 3,
        *,
        rngs: nnx.Rngs,
    ):
        self.spectral = SpectralConvolution(width_in, width_out, num_kept_modes, rngs=rngs)
        self.local_first = TemporalConvolution(width_in, width_in, kernel_size, rngs=rngs)
        self.local_second = TemporalConvolution(width_in, width_out, kernel_size, rngs=rngs)

    def local(self, z):
        """Return the local branch, SiLU(Conv(SiLU(Conv(SiLU(z))))) (Eq. 3)."""
        return nnx.silu(self.local_second(nnx.silu(self.local_first(nnx.silu(z)))))

    def __call__(self, z):
        """Map [B, T, D0] to [B, T, D1] (Eq. 4)."""
        return self.spectral(z) + self.local(z)
