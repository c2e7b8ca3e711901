"""The motion autoencoder of ACMDM: convolutions over time alone, the same for every joint (ACMDM section 3.1, App. B).

    positions [B, L, J, 3] -> latent [B, L / 4, J, 4] -> positions

Joints are never mixed, so that one autoencoder serves every skeleton. Causal convolutions see the past alone: a latent
frame depends on the frames up to its own last one, and a decoded frame on latent frames up to its own.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from f3amd_lib.networks.attention import dropout
from f3amd_lib.networks.config import CheckedConfig

LOG_VARIANCE_RANGE = (-30.0, 20.0)
"""A variational encoder's log variance is cut off there (released code)."""


@dataclass(frozen=True, kw_only=True)
class AutoencoderConfig(CheckedConfig):
    """Everything that decides the shape of a motion autoencoder (ACMDM App. B).

    Attributes:
      channels: of a joint, 3.
      latent_channels: of a joint in the latent, 4.
      width: of all layers between.
      causal: pad convolutions on the left alone, or on both sides.
      variational: encode a mean and a log variance.
      num_halvings: the latent has 2 ** num_halvings times fewer frames.
      dilations: of the residual blocks at each rate.
      dropout: share dropped at the end of each residual block, in training.

    Raises:
      ValueError: for a size or share that makes no sense.
    """

    family: ClassVar[str] = "motion autoencoder"
    may_be_zero: ClassVar[tuple[str, ...]] = ("dropout", "num_halvings")

    channels: int = 3
    latent_channels: int = 4
    width: int = 512
    causal: bool = True
    variational: bool = False
    num_halvings: int = 2
    dilations: tuple[int, ...] = (9, 3, 1)
    dropout: float = 0.2

    @property
    def frames_per_latent(self) -> int:
        """Frames that one latent frame stands for."""
        return 2**self.num_halvings


class TimeConvolution(nnx.Module):
    """Convolution over the frames of [N, L, C] that keeps their number, or halves it with stride 2.

    Frames that a mask leaves out count as the zeros of the padding do. One product with all taps side by side, since
    XLA's gradient of a convolution is slow on a CPU.
    """

    def __init__(self, width_in: int, width_out: int, size: int, *, causal: bool, stride=1, dilation=1, rngs: nnx.Rngs):
        reach = (size - 1) * dilation + 1 - stride
        self.before = reach if causal else reach // 2
        self.after = reach - self.before
        self.stride, self.dilation = stride, dilation
        self.layer = nnx.Conv(
            width_in, width_out, (size,), strides=stride, kernel_dilation=dilation, padding="VALID", rngs=rngs
        )

    def __call__(self, x, mask=None):
        """Return [N, L / stride, width_out]; mask [N, L], True where x counts."""
        if mask is not None:
            x = x * mask[..., None]
        x = jnp.pad(x, ((0, 0), (self.before, self.after), (0, 0)))
        kernel = self.layer.kernel[...]
        end = x.shape[1] - (len(kernel) - 1) * self.dilation
        taps = [x[:, first : first + end : self.stride] for first in np.arange(len(kernel)) * self.dilation]
        return jnp.concatenate(taps, axis=-1) @ kernel.reshape(-1, kernel.shape[-1]) + self.layer.bias[...]


class ResidualBlock(nnx.Module):
    """x + dropout(1x1(SiLU(dilated 3(SiLU(x))))) (ACMDM App. B)."""

    def __init__(self, config: AutoencoderConfig, dilation: int, *, rngs: nnx.Rngs):
        self.dropout = config.dropout
        options = {"causal": config.causal, "rngs": rngs}
        self.wide = TimeConvolution(config.width, config.width, 3, dilation=dilation, **options)
        self.narrow = TimeConvolution(config.width, config.width, 1, **options)

    def __call__(self, x, mask=None, key=None):
        update = self.narrow(jax.nn.silu(self.wide(jax.nn.silu(x), mask)))
        return x + dropout(update, self.dropout, key)


class _Half(nnx.Module):
    """Layers of one half, and what both halves do: the joints of [B, L, J, C] stand in the batch."""

    def _rates(self, config: AutoencoderConfig, rngs: nnx.Rngs):
        blocks = lambda: nnx.List([ResidualBlock(config, dilation, rngs=rngs) for dilation in config.dilations])
        return nnx.List([blocks() for _ in range(config.num_halvings)])

    def _through(self, blocks, x, mask, key):
        for number, block in enumerate(blocks):
            x = block(x, mask, None if key is None else jax.random.fold_in(key, number))
        return x


class Encoder(_Half):
    """Positions to latent channels, half the frames at each rate."""

    def __init__(self, config: AutoencoderConfig, *, rngs: nnx.Rngs):
        width, options = config.width, {"causal": config.causal, "rngs": rngs}
        latent = config.latent_channels * (2 if config.variational else 1)
        self.first = TimeConvolution(config.channels, width, 3, **options)
        down = lambda: TimeConvolution(width, width, 4, stride=2, **options)
        self.down = nnx.List([down() for _ in range(config.num_halvings)])
        self.blocks = self._rates(config, rngs)
        self.last = TimeConvolution(width, latent, 3, **options)

    def __call__(self, x, mask, key):
        x = self.first(x, mask)
        for rate, (down, blocks) in enumerate(zip(self.down, self.blocks, strict=True)):
            x, mask = down(x, mask), None if mask is None else mask[:, ::2]
            x = self._through(blocks, x, mask, None if key is None else jax.random.fold_in(key, rate))
        return self.last(x, mask)


class Decoder(_Half):
    """Latent channels to positions, each frame twice at each rate."""

    def __init__(self, config: AutoencoderConfig, *, rngs: nnx.Rngs):
        width, options = config.width, {"causal": config.causal, "rngs": rngs}
        self.first = TimeConvolution(config.latent_channels, width, 3, **options)
        self.blocks = self._rates(config, rngs)
        self.up = nnx.List([TimeConvolution(width, width, 3, **options) for _ in range(config.num_halvings)])
        self.hidden = TimeConvolution(width, width, 3, **options)
        self.last = TimeConvolution(width, config.channels, 3, **options)

    def __call__(self, x, mask, key):
        x = self.first(x, mask)
        for rate, (blocks, up) in enumerate(zip(self.blocks, self.up, strict=True)):
            x = self._through(blocks, x, mask, None if key is None else jax.random.fold_in(key, rate))
            mask = None if mask is None else jnp.repeat(mask, 2, axis=1)
            x = up(jnp.repeat(x, 2, axis=1), mask)
        return self.last(jax.nn.silu(self.hidden(x, mask)), mask)


class MotionAutoencoder(nnx.Module):
    """Encoder and decoder of positions, normalised per axis; plain or variational."""

    def __init__(self, config: AutoencoderConfig, *, rngs: nnx.Rngs):
        self.config = config
        self.encoder = Encoder(config, rngs=rngs)
        self.decoder = Decoder(config, rngs=rngs)

    def encode(self, positions, mask=None, key=None):
        """Return the latent, or a variational encoder's mean and log variance in its channels.

        Args:
          positions: [B, L, J, 3], normalised; L a multiple of `frames_per_latent`.
          mask: True where a frame is motion, [B, L], whole latent frames of it; all are by default.
          key: random key for dropout, in training; without one nothing is dropped.

        Returns:
          [B, L / 4, J, 4], or 8 channels.

        Raises:
          ValueError: for another shape.
        """
        config, latent = self.config, self.config.frames_per_latent
        if positions.ndim != 4 or positions.shape[3] != config.channels or positions.shape[1] % latent:
            wanted = f"[B, a multiple of {latent}, J, {config.channels}]"
            raise ValueError(f"positions must be {wanted}, got {positions.shape}: cut or pad the clip")
        return _beside_each_other(self.encoder, positions, mask, key)

    def decode(self, latent, mask=None, key=None):
        """Return positions [B, L, J, 3], normalised, of a latent [B, L / 4, J, 4]; mask [B, L / 4], key as above."""
        if latent.ndim != 4 or latent.shape[3] != self.config.latent_channels:
            raise ValueError(f"latent must be [B, frames, J, {self.config.latent_channels}], got {latent.shape}")
        return _beside_each_other(self.decoder, latent, mask, key)

    def moments(self, encoded):
        """Return (mean, log variance) of what a variational encoder made."""
        mean, log_variance = jnp.split(encoded, 2, axis=-1)
        return mean, jnp.clip(log_variance, *LOG_VARIANCE_RANGE)

    def latent_of(self, positions, mask=None):
        """Return the latent to model: what the encoder made, or its mean, [B, L / 4, J, 4]."""
        encoded = self.encode(positions, mask)
        return self.moments(encoded)[0] if self.config.variational else encoded


def _beside_each_other(half, x, mask, key):
    """Send every joint through a half of its own: [B, L, J, C] with joints in the batch, and back."""
    batch, frames, joints, channels = x.shape
    lines = jnp.swapaxes(x, 1, 2).reshape(batch * joints, frames, channels)
    lines = half(lines, None if mask is None else jnp.repeat(mask, joints, axis=0), key)
    return jnp.swapaxes(lines.reshape(batch, joints, *lines.shape[1:]), 1, 2)


def smooth_l1(positions_hat, positions, mask=None):
    """Return the reconstruction loss: mean of d^2 / 2 below a distance of 1 and of |d| - 1/2 beyond (ACMDM App. B).

    Args:
      positions_hat, positions: [B, L, J, 3].
      mask: frames that count, [B, L].
    """
    distance = jnp.abs(positions_hat - positions)
    loss = jnp.where(distance < 1.0, 0.5 * distance**2, distance - 0.5).mean(axis=(2, 3))
    return loss.mean() if mask is None else jnp.sum(loss * mask) / jnp.sum(mask)


def variational_loss(positions_hat, positions, mean, log_variance, kl_weight: float = 0.01, floor: float = -6.0):
    """Return the loss of the variational form, mean over samples: a reconstruction with its own best width, and KL.

    With s the log of a sample's root mean square error, softly kept above `floor`, the reconstruction is
    sum(0.5 ((x - x') / e^s)^2 + s) over all numbers of the sample; KL is summed over its latent.

    Source: ACMDM's released code, after Rybkin et al. 2021 (sigma-VAE).
    """
    axes = tuple(range(1, positions.ndim))
    square = (positions_hat - positions) ** 2
    log_width = 0.5 * jnp.log(jnp.maximum(jnp.mean(square, axis=axes, keepdims=True), 1e-12))
    log_width = floor + jax.nn.softplus(log_width - floor)
    fit = jnp.sum(0.5 * square * jnp.exp(-2.0 * log_width) + log_width, axis=axes)
    divergence = 0.5 * jnp.sum(mean**2 + jnp.exp(log_variance) - 1.0 - log_variance, axis=axes)
    return jnp.mean(fit + kl_weight * divergence)
