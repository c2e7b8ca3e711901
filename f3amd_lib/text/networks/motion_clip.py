"""The evaluator of ACMDM's CLIP-score: a Transformer over frames, and one over the caption's word pieces."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import jax.numpy as jnp
from flax import nnx

from f3amd_lib.networks.attention import TransformerBlock, check_num_heads, position_code
from f3amd_lib.networks.config import CheckedConfig, scaled_normal


@dataclass(frozen=True, kw_only=True)
class MotionClipConfig(CheckedConfig):
    """Sizes of both encoders, those of ACMDM's released evaluation code.

    Attributes:
      features: of a frame of motion, 4 + 3 (J - 1).
      width: of both Transformers.
      depth, num_heads, hidden_width: of each.
      embedding_width: of the common space.
      vocabulary, text_length: word pieces of CLIP's tokeniser, and those of a caption with what fills it up.

    Raises:
      ValueError: for a size that makes no sense.
    """

    family: ClassVar[str] = "motion CLIP"
    released: ClassVar[bool] = True
    tag_width: ClassVar[int] = 0
    token_width: ClassVar[int] = 1

    features: int
    width: int = 512
    depth: int = 8
    num_heads: int = 8
    hidden_width: int = 1024
    embedding_width: int = 512
    vocabulary: int = 49408
    text_length: int = 77

    def __post_init__(self):
        super().__post_init__()
        check_num_heads(self.width, self.num_heads)


class MotionClip(nnx.Module):
    """Motion and caption as vectors of one space, compared by their angle (ACMDM's released evaluation code)."""

    def __init__(self, config: MotionClipConfig, *, rngs: nnx.Rngs):
        width, out = config.width, config.embedding_width
        blocks = lambda: nnx.List([
            TransformerBlock(width, config.num_heads, config.hidden_width, rngs=rngs) for _ in range(config.depth)
        ])  # fmt: skip
        self.frames = nnx.Linear(config.features, width, rngs=rngs)
        self.query = nnx.Param(scaled_normal(rngs.params(), 1.0, (width,)))
        self.words = nnx.Embed(config.vocabulary, width, rngs=rngs)
        self.positions = nnx.Param(scaled_normal(rngs.params(), 0.01, (config.text_length, width)))
        self.motion_blocks, self.text_blocks = blocks(), blocks()
        self.motion_norm, self.text_norm = (nnx.LayerNorm(width, epsilon=1e-5, rngs=rngs) for _ in range(2))
        self.motion_output, self.text_output = (nnx.Linear(width, out, rngs=rngs) for _ in range(2))

    def embed_motion(self, features, length):
        """Return motions as vectors, [B, embedding_width], of features [B, F, features] of which `length` [B] count."""
        query = jnp.broadcast_to(self.query[...], (len(features), 1, self.query.shape[-1]))
        z = jnp.concatenate([query, self.frames(features)], axis=1)
        z = z + position_code(0, z.shape[1], z.shape[2], 10000.0).astype(z.dtype)
        mask = jnp.arange(z.shape[1]) <= length[:, None]
        for block in self.motion_blocks:
            z = block(z, mask=mask)
        return self.motion_output(self.motion_norm(z[:, 0]))

    def embed_text(self, tokens, mask):
        """Return captions as vectors, [B, embedding_width].

        Args:
          tokens: numbers of word pieces, [B, T, 1]; 0 beyond the caption's end, where it is filled up and looked at.
          mask: true for the caption's own, of which the last one is read, [B, T].
        """
        missing = len(self.positions) - tokens.shape[1]
        numbers = jnp.pad(tokens[..., 0].astype(jnp.int32), ((0, 0), (0, missing)))
        z = self.words(numbers) + self.positions[...]
        for block in self.text_blocks:
            z = block(z)
        last = jnp.sum(mask, axis=1) - 1
        return self.text_output(self.text_norm(z[jnp.arange(len(z)), last]))
