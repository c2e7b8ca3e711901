"""The mesh autoencoder of ACMDM section 3.3: frames of vertices to a few latent vertices, and back.

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

from f3amd_lib.networks.config import CheckedConfig
from f3amd_lib.text.data.body_mesh import MeshLists


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

    def __post_init__(self):
        super().__post_init__()
        lists = {name: getattr(self, name) for name in ("coarse_levels", "channels", "around", "down", "up")}
        if len(set(map(len, lists.values()))) != 1:
            raise ValueError(f"{', '.join(lists)} must be as many whole numbers each, got {list(lists.values())}")
        fine, coarse = self.levels[:-1], self.levels[1:]
        if any(few >= many for many, few in zip(fine, coarse, strict=True)):
            raise ValueError(f"levels must have fewer and fewer vertices, got {self.levels}: this network is too large")
        for name, most in (("around", fine), ("down", fine), ("up", coarse)):
            if any(count > there for count, there in zip(getattr(self, name), most, strict=True)):
                raise ValueError(f"{name} asks for more neighbours than there are vertices: {getattr(self, name)}")

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
    """Encoder and decoder of vertices, normalised per axis: ELU after every layer but the last of each."""

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
        return _through(self.encoder, vertices, [one for pair in pairs for one in pair])

    def decode(self, latent, lists: MeshLists):
        """Return vertices [N, V, 3], normalised, of a latent; lists and errors as above."""
        wanted = (self.config.levels[-1], self.config.latent_channels)
        if latent.ndim != 3 or latent.shape[1:] != wanted:
            raise ValueError(f"latent must be [N, {wanted[0]}, {wanted[1]}], got {latent.shape}")
        pairs = list(zip(lists.up, lists.around, strict=True))[::-1]
        return _through(self.decoder, latent, [one for pair in pairs for one in pair])


def _through(layers, x, lists):
    """Send [N, V, C] through layers, vertices first: neighbours are then whole rows of memory."""
    x = jnp.swapaxes(x, 0, 1)
    for number, (layer, neighbours) in enumerate(zip(layers, lists, strict=True)):
        x = layer(x, np.asarray(neighbours))
        if number < len(layers) - 1:
            x = jax.nn.elu(x)
    return jnp.swapaxes(x, 0, 1)
