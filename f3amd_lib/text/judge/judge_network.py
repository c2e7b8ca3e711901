"""Two encoders that meet: a motion and its caption become vectors of one space (the judge's network).

Movement convolutions and a bidirectional recurrence over motion features, the same recurrence over the
caption's token vectors. Numbers in the padding change nothing.

Source: Guo et al. 2022 (HumanML3D), the evaluator of its released code; sizes in ACMDM's evaluation code.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import jax
import jax.numpy as jnp
from flax import nnx

from f3amd_lib.networks.attention import dropout
from f3amd_lib.networks.config import CheckedConfig, scaled_normal


@dataclass(frozen=True, kw_only=True)
class TextMotionConfig(CheckedConfig):
    """Sizes of both encoders; those of the published evaluator are 512, 1024, 512 and 512.

    Attributes:
      features: of a frame of motion, 4 + 3 (J - 1).
      token_width: of the caption's token vectors.
      movement_width: of the convolutions, each of which halves the frames.
      motion_hidden, text_hidden: of the recurrence, in each direction.
      embedding_width: of the common space.
      dropout: after each convolution, in training.
    """

    family: ClassVar[str] = "text-to-motion judge"
    may_be_zero: ClassVar[tuple[str, ...]] = ("dropout",)

    features: int
    token_width: int
    movement_width: int = 128
    motion_hidden: int = 128
    text_hidden: int = 128
    embedding_width: int = 64
    dropout: float = 0.2


class HalvingConvolution(nnx.Module):
    """Convolution of 4 frames at every second one, a frame of zeros at both ends: half as many frames.

    One matrix product, since XLA's gradient of a strided convolution is slow on a CPU.
    """

    def __init__(self, width_in: int, width_out: int, *, rngs: nnx.Rngs):
        self.taps = nnx.Linear(4 * width_in, width_out, rngs=rngs)

    def __call__(self, z):
        """Map [B, F, C], F even, to [B, F / 2, D]."""
        z = jnp.pad(z, ((0, 0), (1, 1), (0, 0)))
        pairs = z.reshape(z.shape[0], z.shape[1] // 2, -1)
        return self.taps(jnp.concatenate([pairs[:, :-1], pairs[:, 1:]], axis=-1))


class _BothWays(nnx.Module):
    """A gated recurrence forwards and backwards from a learned start; its last states become one vector."""

    def __init__(self, width_in: int, hidden: int, width_out: int, *, rngs: nnx.Rngs):
        self.inside = nnx.Linear(width_in, hidden, rngs=rngs)
        self.start = nnx.Param(scaled_normal(rngs.params(), 0.1, (2, hidden)))
        options = {"return_carry": True, "rngs": False}  # its start is given: nothing is drawn
        self.forwards = nnx.RNN(nnx.GRUCell(hidden, hidden, rngs=rngs), **options)
        self.backwards = nnx.RNN(nnx.GRUCell(hidden, hidden, rngs=rngs), reverse=True, **options)
        self.middle = nnx.Linear(2 * hidden, hidden, rngs=rngs)
        self.norm = nnx.LayerNorm(hidden, rngs=rngs)
        self.output = nnx.Linear(hidden, width_out, rngs=rngs)

    def __call__(self, z, length):
        """Map [B, T, width_in], of which `length` [B] count, to [B, width_out]."""
        z = self.inside(z)
        start = jnp.broadcast_to(self.start[...][:, None], (2, len(z), z.shape[-1]))
        last = [
            recurrence(z, initial_carry=first, seq_lengths=length)[0]
            for recurrence, first in zip((self.forwards, self.backwards), start, strict=True)
        ]
        return self.output(nnx.leaky_relu(self.norm(self.middle(jnp.concatenate(last, axis=-1))), 0.2))


class TextMotionNetwork(nnx.Module):
    """The motion encoder and the text encoder."""

    def __init__(self, config: TextMotionConfig, *, rngs: nnx.Rngs):
        width, out = config.movement_width, config.embedding_width
        self.dropout = config.dropout
        self.movement = nnx.List(
            [HalvingConvolution(config.features, width, rngs=rngs), HalvingConvolution(width, width, rngs=rngs)]
        )
        self.movement_output = nnx.Linear(width, width, rngs=rngs)
        self.motion = _BothWays(width, config.motion_hidden, out, rngs=rngs)
        self.text = _BothWays(config.token_width, config.text_hidden, out, rngs=rngs)

    def embed_motion(self, features, length, key=None):
        """Return motions as vectors, [B, embedding_width].

        Args:
          features: [B, F, features], F a multiple of 4; 0 in the padding.
          length: frames of each, [B]; at least 4.
          key: random key of the dropout, in training.
        """
        z = features
        for layer, convolution in enumerate(self.movement, 1):
            key_layer = None if key is None else jax.random.fold_in(key, layer)
            z = dropout(nnx.leaky_relu(convolution(z), 0.2), self.dropout, key_layer)
            left = -(-length // 2**layer)
            z = jnp.where((jnp.arange(z.shape[1]) < left[:, None])[..., None], z, 0.0)
        return self.motion(self.movement_output(z), length // 4)

    def embed_text(self, tokens, mask):
        """Return captions as vectors, [B, embedding_width].

        Args:
          tokens: [B, T, token_width].
          mask: true for tokens, which come first, [B, T].
        """
        return self.text(tokens, jnp.sum(mask, axis=1))
