"""The Fourier Neural Operator block (paper section 3.4.2, Eqs 2-4) and its variants (Table 8).

The paper writes channels first, z in R^{D x t}; arrays here are [batch, frames, channels]. Inside a
block they are [frames, batch, channels]: a transform over frames is then one matrix product for the
whole batch, and neighbouring frames are neighbouring blocks of memory. Every layer can be called in
both orders.

Windows are short (32 or 64 frames), so the real Fourier transform is a product with a small cosine
and sine matrix: the same numbers as an FFT, and faster on the hardware this was measured on. So is
the cosine transform.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from f3amd_lib.ground.names import check_known
from f3amd_lib.networks.config import scaled_normal, with_fast_gradient

SPECTRAL_VARIANTS = ("fourier", "cosine", "reduced_rank", "weighted")
"""Spectral layers of Table 8: Eq. 2; the discrete cosine transform; factorised weights; gains."""


def count_modes(variant: str, num_frames: int) -> int:
    """Return how many modes a variant's transform of `num_frames` frames has.

    Args:
      variant: one of `SPECTRAL_VARIANTS`.
      num_frames: window length T, odd or even.

    Returns:
      T cosine modes, or T // 2 + 1 Fourier modes for every other variant.

    Raises:
      ValueError: for an unknown variant.
    """
    check_known(variant, SPECTRAL_VARIANTS, "spectral variant")
    return num_frames if variant == "cosine" else num_frames // 2 + 1


def _check_num_kept_modes(variant: str, num_frames: int, num_kept_modes: int) -> None:
    modes = count_modes(variant, num_frames)
    if not 1 <= num_kept_modes <= modes:
        raise ValueError(f"num_kept_modes must be between 1 and {modes} for {num_frames} frames, got {num_kept_modes}")


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
    _check_num_kept_modes("fourier", num_frames, num_kept_modes)
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


@functools.lru_cache(maxsize=32)
def cosine_basis(num_frames: int, num_kept_modes: int | None = None) -> np.ndarray:
    """Return the first rows of the orthonormal cosine transform (DCT-II).

    Args:
      num_frames: window length T.
      num_kept_modes: m, the number of rows kept, 1 <= m <= T; all T by default.

    Returns:
      [m, T], float64, read-only (it is cached). Its transpose maps back.

    Raises:
      ValueError: if m is out of range.
    """
    modes = num_frames if num_kept_modes is None else num_kept_modes
    _check_num_kept_modes("cosine", num_frames, modes)
    frame = (np.arange(num_frames) + 0.5) / num_frames
    basis = np.cos(np.pi * np.arange(modes)[:, None] * frame[None, :])
    basis *= np.sqrt(2.0 / num_frames)
    basis[0] /= np.sqrt(2.0)
    basis.setflags(write=False)
    return basis


def frames_first(z):
    """Map [B, T, D] to [T, B, D], or back."""
    return jnp.swapaxes(z, 0, 1)


def _over_frames(matrix, z):
    """Multiply a constant matrix [F, T] with the frames of z [T, B, D]: [F, B, D]."""
    return (jnp.asarray(matrix, z.dtype) @ z.reshape(len(z), -1)).reshape(-1, *z.shape[1:])


def _complex_product(spectrum, weight_real, weight_imag):
    """Multiply [m, 2, B, D0] by complex weights [m, D0, D1], mode by mode: [m, 2, B, D1]."""
    modes, _, batch, width_in = spectrum.shape
    # One batched product gives all four real products of the complex one.
    products = spectrum.reshape(modes, 2 * batch, width_in) @ jnp.concatenate([weight_real, weight_imag], axis=-1)
    products = products.reshape(modes, 2, batch, 2, weight_real.shape[-1])
    real = products[:, 0, :, 0] - products[:, 1, :, 1]
    imag = products[:, 0, :, 1] + products[:, 1, :, 0]
    return jnp.stack([real, imag], axis=1)


def spectral_convolution(z, *weights, gain=None):
    """Return IRFFT(W . RFFT(z)[:m]) over the frame axis (Eq. 2).

    Args:
      z: [B, T, D0].
      *weights: the complex weights W as two real arrays, [m, D0, D1]; or those of its factors, two
        real arrays each, the first one first: W = U V as U [m, D0, r], then V [m, r, D1].
      gain: [m], one factor per mode on the spectrum of z; none by default.

    Returns:
      [B, T, D1].
    """
    return frames_first(_fourier_layer(frames_first(z), *weights, gain=gain))


def _fourier_layer(z, *weights, gain=None):
    """Do the work of `spectral_convolution` on z [T, B, D0]."""
    num_frames, modes = len(z), len(weights[0])
    analysis, synthesis = fourier_matrices(num_frames, modes)
    spectrum = _over_frames(analysis.reshape(2 * modes, num_frames), z).reshape(modes, 2, *z.shape[1:])
    if gain is not None:
        spectrum = spectrum * gain[:, None, None, None]
    for real, imag in zip(weights[::2], weights[1::2], strict=True):
        spectrum = _complex_product(spectrum, real, imag)
    return _over_frames(synthesis.reshape(num_frames, 2 * modes), spectrum.reshape(2 * modes, *spectrum.shape[2:]))


def cosine_convolution(z, weight):
    """Return the inverse cosine transform of weights times the first modes of z (Table 8, DCT).

    Unlike a Fourier layer it mirrors the window at its ends instead of joining them.

    Args:
      z: [B, T, D0].
      weight: real, [m, D0, D1].

    Returns:
      [B, T, D1].
    """
    return frames_first(_cosine_layer(frames_first(z), weight))


def _cosine_layer(z, weight):
    """Do the work of `cosine_convolution` on z [T, B, D0]."""
    basis = cosine_basis(len(z), len(weight))
    return _over_frames(basis.T, _over_frames(basis, z) @ weight)


class FrameLayer(nnx.Module):
    """A layer over frames that can be called in both orders of axes.

    A subclass has `frames_first`, which maps [T, B, D0] to [T, B, D1].
    """

    def __call__(self, z, key=None):
        """Map [B, T, D0] to [B, T, D1].

        Args:
          z: [B, T, D0].
          key: not used; every base block takes one, and only Transformers drop anything.
        """
        return frames_first(self.frames_first(frames_first(z)))


class SpectralConvolution(FrameLayer):
    """Learned weights on the first m modes (Eq. 2), in the variants of Table 8.

    Args:
      width_in, width_out: D0 and D1.
      num_kept_modes: m, at most `count_modes(variant, T)`.
      variant: "fourier", complex weights [m, D0, D1]; "cosine", real ones on the cosine transform;
        "reduced_rank", complex factors [m, D0, r] and [m, r, D1] (Chou and Chen 2025); "weighted",
        complex weights and one learned gain per mode (Liu and Tang 2025).
      rank: r of "reduced_rank" (Appendix E: 8).
      initial_gain: where the gains of "weighted" start (Appendix E: 0.7).
      small_weights: begin with weights in [0, 1) / (D0 D1), as Li et al. 2021 do, instead of at unit gain.

    Raises:
      ValueError: for an unknown variant, or a rank above min(D0, D1), which would save nothing.
    """

    def __init__(
        self, width_in: int, width_out: int, num_kept_modes: int, variant: str = "fourier", *,
        rank: int = 8, initial_gain: float = 0.7, small_weights: bool = False, rngs: nnx.Rngs,
    ):  # fmt: skip
        count_modes(variant, 1)  # refuses an unknown one
        self.variant = variant

        def draw(rows: int, columns: int, parts: int = 2):
            shape = (num_kept_modes, rows, columns)
            if small_weights:
                return nnx.Param(jax.random.uniform(rngs.params(), shape) / (rows * columns))
            # Unit gain: white input of variance 1 leaves with variance about 1 when no mode is cut.
            scale = float(1.0 / np.sqrt(parts * rows))
            return nnx.Param(scaled_normal(rngs.params(), scale, shape))

        if variant == "cosine":
            self.weight = draw(width_in, width_out, parts=1)
        elif variant == "reduced_rank":
            if not 1 <= rank <= min(width_in, width_out):
                highest = min(width_in, width_out)
                raise ValueError(f"rank must be between 1 and {highest} for {width_in} to {width_out}, got {rank}")
            self.first_real, self.first_imag = draw(width_in, rank), draw(width_in, rank)
            self.second_real, self.second_imag = draw(rank, width_out), draw(rank, width_out)
        else:
            self.weight_real, self.weight_imag = draw(width_in, width_out), draw(width_in, width_out)
        if variant == "weighted":
            self.gain = nnx.Param(jnp.full(num_kept_modes, initial_gain, jnp.float32))

    def frames_first(self, z):
        """Map [T, B, D0] to [T, B, D1]."""
        if self.variant == "cosine":
            return _cosine_layer(z, self.weight[...])
        if self.variant == "reduced_rank":
            weights = self.first_real, self.first_imag, self.second_real, self.second_imag
            return _fourier_layer(z, *(weight[...] for weight in weights))
        gain = self.gain[...] if self.variant == "weighted" else None
        return _fourier_layer(z, self.weight_real[...], self.weight_imag[...], gain=gain)


class TemporalConvolution(FrameLayer):
    """Convolution over frames, zeros beyond the window's ends (Conv_k of Eq. 3).

    Written as one matrix product for all taps, whose results are shifted and added: the numbers of
    `nnx.Conv`, whose gradient XLA runs some twenty times slower on a CPU once training steps are
    scanned.
    """

    def __init__(self, width_in: int, width_out: int, kernel_size: int, *, rngs: nnx.Rngs):
        initial = nnx.initializers.lecun_normal(in_axis=(0, 1), out_axis=2)
        self.kernel = nnx.Param(initial(rngs.params(), (kernel_size, width_in, width_out)))
        self.bias = nnx.Param(jnp.zeros(width_out))

    def frames_first(self, z):
        """Map [T, B, D0] to [T, B, D1]."""
        kernel = self.kernel[...]
        taps, width_in, width_out = kernel.shape
        side_by_side = jnp.moveaxis(kernel, 0, 1).reshape(width_in, taps * width_out)
        answers = jnp.split(z @ with_fast_gradient(side_by_side), taps, axis=-1)
        before = (taps - 1) // 2
        beyond = ((before, taps - 1 - before), (0, 0), (0, 0))
        shifted = [jnp.pad(a, beyond)[tap : tap + len(z)] for tap, a in enumerate(answers)]
        return sum(shifted) + self.bias[...]


class FNOBlock(FrameLayer):
    """Spectral branch plus local branch (Eqs 2-4); encoder or decoder if the widths differ.

    Args:
      width_in, width_out: D0 and D1.
      num_kept_modes: m.
      kernel_size: k of Eq. 3.
      **spectral: variant, rank, initial_gain and small_weights of `SpectralConvolution`.
    """

    def __init__(
        self, width_in: int, width_out: int, num_kept_modes: int, kernel_size: int = 3, *, rngs: nnx.Rngs, **spectral
    ):
        self.spectral = SpectralConvolution(width_in, width_out, num_kept_modes, rngs=rngs, **spectral)
        self.local_first = TemporalConvolution(width_in, width_in, kernel_size, rngs=rngs)
        self.local_second = TemporalConvolution(width_in, width_out, kernel_size, rngs=rngs)

    def local(self, z):
        """Return the local branch, SiLU(Conv(SiLU(Conv(SiLU(z))))), of z [B, T, D0] (Eq. 3)."""
        return frames_first(self.local_frames_first(frames_first(z)))

    def local_frames_first(self, z):
        """Do the work of `local` on z [T, B, D0]."""
        inner = nnx.silu(self.local_first.frames_first(nnx.silu(z)))
        return nnx.silu(self.local_second.frames_first(inner))

    def frames_first(self, z):
        """Map [T, B, D0] to [T, B, D1] (Eq. 4)."""
        return self.spectral.frames_first(z) + self.local_frames_first(z)
