"""The autoencoders of ACMDM.

That of motion: convolutions over time alone, the same for every joint (ACMDM section 3.1, App. B).

    positions [B, L, J, 3] -> latent [B, L / 4, J, 4] -> positions

Joints are never mixed, so that one autoencoder serves every skeleton. Causal convolutions see the past alone: a latent
frame depends on the frames up to its own last one, and a decoded frame on latent frames up to its own.

That of meshes (ACMDM section 3.3): frames of vertices to a few latent vertices, and back.

    vertices [N, V, 3] -> latent [N, 28, 12] -> vertices

At each level a convolution among a vertex's neighbours, then pooling onto the next, coarser level; back the same way.
Which vertex neighbours which is given with the vertices (`text.data.body_mesh.MeshLists`): any mesh will do.

Source: Zhou et al. 2020, "Fully convolutional mesh autoencoder using efficient spatially varying kernels"; ACMDM's
released code for sizes.
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
from f3amd_lib.text.data.body_mesh import MeshLists

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


# --------------------------------------------------------------------------------------------------------------- meshes


@dataclass(frozen=True, kw_only=True)
class MeshAutoencoderConfig(CheckedConfig):
    """Everything that decides the shape of a mesh autoencoder (ACMDM's released code).

    Attributes:
      num_vertices: V, of the mesh.
      coarse_levels: vertices of each coarser level; the last has the latent's.
      channels: after the convolution of each level but the last.
      latent_channels: of a latent vertex.
      num_bases: matrices that all edges of a convolution share.
      around, down, up: neighbours of a vertex in convolution, pooling and unpooling, by level.
      linear_pooling: no ELU follows pooling (released code); presets have it, in earlier files one does.

    Raises:
      ValueError: for lists of unlike length, levels that do not fall, or more neighbours than there are vertices.
    """

    family: ClassVar[str] = "mesh autoencoder"
    from_data: ClassVar[tuple[str, ...]] = ("num_vertices",)
    frames_per_latent: ClassVar[int] = 1

    num_vertices: int
    coarse_levels: tuple[int, ...] = (1925, 400, 54, 28)
    channels: tuple[int, ...] = (64, 128, 256, 512)
    latent_channels: int = 12
    num_bases: int = 9
    around: tuple[int, ...] = (10, 21, 26, 19)
    down: tuple[int, ...] = (32, 56, 66, 33)
    up: tuple[int, ...] = (11, 14, 11, 1)
    linear_pooling: bool = False

    def __post_init__(self):
        super().__post_init__()
        fine, coarse = np.array(self.levels[:-1]), np.array(self.levels[1:])
        most = {"coarse_levels": fine - 1, "channels": np.inf * fine, "around": fine, "down": fine, "up": coarse}
        for name, limits in most.items():
            counts = np.array(getattr(self, name))
            if len(counts) != len(limits) or np.any(counts > limits):
                what = f"as many numbers as coarse_levels, and no more than the level has vertices {self.levels}"
                raise ValueError(f"{name} must be {what}, got {counts.tolist()}")

    @property
    def levels(self) -> tuple[int, ...]:
        """Vertices of all levels, from fine to coarse."""
        return (self.num_vertices, *self.coarse_levels)

    @property
    def neighbours(self) -> dict[str, tuple[int, ...]]:
        """Numbers of neighbours, as `BodyMesh.of` takes them."""
        return {"around": self.around, "down": self.down, "up": self.up}


class MeshConvolution(nnx.Module):
    """out_i = sum_j W_ij x_n(i,j) + b with W_ij = sum_k v_ijk B_k: bases are shared, coefficients each edge's own."""

    def __init__(self, num_vertices: int, num_neighbours: int, num_bases: int, width_in: int, width_out: int, *, rngs):
        # All vertices begin alike, up to a noise: what is then pooled has not cancelled out.
        alike, own = (
            jax.random.normal(rngs.params(), shape)
            for shape in ((num_bases, 1), (num_vertices, num_bases, num_neighbours))
        )
        self.coefficients = nnx.Param((alike + own) / num_neighbours)
        shared = nnx.initializers.lecun_normal()
        self.bases = nnx.Param(shared(rngs.params(), (num_bases * width_in, width_out)))
        self.bias = nnx.Param(jnp.zeros(width_out))

    def __call__(self, x, neighbours):
        """Return [V, N, width_out] of [V, N, width_in]; neighbours [V, K]."""
        near = x[neighbours].reshape(*neighbours.shape, -1)
        mixed = (self.coefficients[...] @ near).reshape(len(neighbours), -1, *x.shape[1:])  # [V, bases, N, width_in]
        flat = jnp.moveaxis(mixed, 1, 2).reshape(len(neighbours), x.shape[1], -1)
        return flat @ self.bases[...] + self.bias[...]


class MeshPooling(nnx.Module):
    """A mean over neighbours on another level with learned weights |p|, and a linear map where the width changes."""

    def __init__(self, num_vertices: int, num_neighbours: int, width_in: int, width_out: int, *, rngs):
        self.weights = nnx.Param(jnp.ones((num_vertices, num_neighbours)))
        self.linear = None if width_in == width_out else nnx.Linear(width_in, width_out, use_bias=False, rngs=rngs)

    def __call__(self, x, neighbours):
        """Return [V, N, width_out] of [V', N, width_in]; neighbours [V, K] on the level of x."""
        weight = jnp.abs(self.weights[...])
        weight = weight / jnp.maximum(jnp.sum(weight, axis=1, keepdims=True), 1e-8)
        pooled = (weight[:, None] @ x[neighbours].reshape(*neighbours.shape, -1)).reshape(-1, *x.shape[1:])
        return pooled if self.linear is None else self.linear(pooled)


class MeshAutoencoder(nnx.Module):
    """Encoder and decoder of vertices, normalised per axis: ELU after every convolution but the decoder's last."""

    def __init__(self, config: MeshAutoencoderConfig, *, rngs: nnx.Rngs):
        self.config = config
        levels, bases = config.levels, config.num_bases
        encoder, decoder = [], []
        for level, width in enumerate(config.channels):
            before = config.channels[level - 1] if level else 3
            last = level == len(config.channels) - 1
            coarse = config.latent_channels if last else width
            fine, around = levels[level], config.around[level]
            encoder.append(MeshConvolution(fine, around, bases, before, width, rngs=rngs))
            encoder.append(MeshPooling(levels[level + 1], config.down[level], width, coarse, rngs=rngs))
            decoder.append(MeshConvolution(fine, around, bases, width, before, rngs=rngs))
            decoder.append(MeshPooling(fine, config.up[level], coarse, width, rngs=rngs))
        self.encoder, self.decoder = nnx.List(encoder), nnx.List(decoder[::-1])

    def encode(self, vertices, lists: MeshLists):
        """Return the latent, [N, latent vertices, latent channels].

        Args:
          vertices: [N, V, 3], normalised.
          lists: neighbours at the config's levels.

        Raises:
          ValueError: for another shape.
        """
        if vertices.ndim != 3 or vertices.shape[1:] != (self.config.num_vertices, 3):
            raise ValueError(f"vertices must be [N, {self.config.num_vertices}, 3], got {vertices.shape}")
        pairs = zip(lists.around, lists.down, strict=True)
        return self._through(self.encoder, vertices, [one for pair in pairs for one in pair])

    def decode(self, latent, lists: MeshLists):
        """Return vertices [N, V, 3], normalised, of a latent; lists and errors as above."""
        wanted = (self.config.levels[-1], self.config.latent_channels)
        if latent.ndim != 3 or latent.shape[1:] != wanted:
            raise ValueError(f"latent must be [N, {wanted[0]}, {wanted[1]}], got {latent.shape}")
        pairs = list(zip(lists.up, lists.around, strict=True))[::-1]
        return self._through(self.decoder, latent, [one for pair in pairs for one in pair])

    def _through(self, layers, x, lists):
        """Send [N, V, C] through layers, vertices first: neighbours are then whole rows of memory."""
        x = jnp.swapaxes(x, 0, 1)
        for number, (layer, neighbours) in enumerate(zip(layers, lists, strict=True), 1):
            x = layer(x, np.asarray(neighbours))
            if number < len(layers) and not (self.config.linear_pooling and isinstance(layer, MeshPooling)):
                x = jax.nn.elu(x)
        return jnp.swapaxes(x, 0, 1)
