"""Masked autoregression: frames are revealed in a random order, each drawn given those before it (ACMDM App. G).

The paper gives results and no network. This is our reading, after the recipe of MARDM (Meng et al. 2024): the blocks
of ACMDM look at the frames that are known, in both directions, and a small network beside them denoises the hidden
ones, each token for itself.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import jax
import jax.numpy as jnp
from flax import nnx

from f3amd_lib.networks.config import scaled_normal
from f3amd_lib.text.networks.acmdm import ACMDMConfig, TextContext, Trunk, linear, modulated, root_mean_square_norm


@dataclass(frozen=True, kw_only=True)
class MaskedACMDMConfig(ACMDMConfig):
    """An ACMDM config, and the head.

    Attributes:
      head_depth: layers of the network that denoises a token (ours).

    Raises:
      ValueError: as `ACMDMConfig`, and for concatenation or blocks of frames, which this form has no place for.
    """

    family: ClassVar[str] = "masked ACMDM"

    head_depth: int = 3

    def __post_init__(self):
        super().__post_init__()
        if self.conditioning != "adaln" or self.block_frames:
            raise ValueError("masked autoregression needs conditioning 'adaln' and block_frames 0")


class HeadLayer(nnx.Module):
    """Two layers on a token, gated, shifted and scaled by c; the identity at first."""

    def __init__(self, width: int, *, rngs: nnx.Rngs):
        self.norm = root_mean_square_norm(width, rngs)
        self.modulation = linear(width, 3 * width, rngs, zero=True)
        self.hidden, self.output = linear(width, width, rngs), linear(width, width, rngs)

    def __call__(self, x, c):
        shift, scale, gate = jnp.split(self.modulation(jax.nn.silu(c)), 3, axis=-1)
        return x + gate * self.output(jax.nn.silu(self.hidden(modulated(self.norm(x), shift, scale))))


class MaskedACMDM(Trunk):
    """A network that sees known frames (`look`) and denoises hidden ones (`__call__`)."""

    def __init__(self, config: MaskedACMDMConfig, *, rngs: nnx.Rngs):
        super().__init__(config, rngs=rngs)
        width, numbers = config.latent_width, config.patch_joints * config.channels
        self.hidden_token = nnx.Param(scaled_normal(rngs.params(), 0.02, (width,)))
        self.head_input = linear(numbers, width, rngs)
        self.head = nnx.List([HeadLayer(width, rngs=rngs) for _ in range(config.head_depth)])
        self.output_norm = root_mean_square_norm(width, rngs)
        self.output = linear(width, numbers, rngs, zero=True)

    def look(self, state, hidden, context: TextContext):
        """Return what the blocks make of the known frames, one vector a token, [B, tokens, d].

        Args:
          state: frames as they are known, [B, l, J, C].
          hidden: True for frames that are not, [B, l]; their values are not looked at.
          context: from `encode`.
        """
        x = self.patch(self.tokens(state))
        hidden = jnp.repeat(hidden, self.config.num_patches, axis=1)[..., None]
        x = jnp.where(hidden, self.hidden_token[...], x)
        # What it looks at is clean: time 1.
        *_, x = self.through(x, jnp.ones(len(state), x.dtype), context)
        return x

    def __call__(self, state, time, context):
        """Predict x0, eps or v of noisy frames, each from what was seen of the others.

        Args:
          state: [B, l, J, C].
          time: [B], or one for all.
          context: of `look`, or a condition as `encode` made it, with which all frames are hidden.
        """
        if isinstance(context, TextContext):
            context = self.look(jnp.zeros_like(state), jnp.ones(state.shape[:2], bool), context)
        x = self.head_input(self.tokens(state))
        time = jnp.broadcast_to(jnp.asarray(time, x.dtype), state.shape[:1])
        nothing = TextContext(jnp.zeros((len(state), 1), x.dtype), jnp.ones(state.shape[:2], bool))
        c = context + self.conditioned(time, nothing)[0]
        for layer in self.head:
            x = layer(x, c)
        return self.from_tokens(self.output(self.output_norm(x)))


def masked_share(uniform):
    """Return which share of the frames is hidden, cos(pi u / 2) of a uniform draw u, in training and sampling."""
    return jnp.cos(0.5 * jnp.pi * uniform)


def draw_hidden(key, mask):
    """Draw which frames are hidden in training, [B, l]: a random share of each sample's own, one at least.

    Args:
      key: JAX random key.
      mask: frames that are motion, [B, l].
    """
    key_share, key_order = jax.random.split(key)
    lengths = mask.sum(axis=1)
    share = masked_share(jax.random.uniform(key_share, lengths.shape))
    count = jnp.maximum(1, jnp.round(share * lengths))
    order = jnp.argsort(jnp.argsort(jnp.where(mask, jax.random.uniform(key_order, mask.shape), 2.0), axis=1), axis=1)
    return mask & (order < count[:, None])


def spoil(key, state, hidden):
    """Return (state, frames to hide) as the blocks get them in training.

    Of the hidden frames a tenth is replaced by noise, 88 % of the others by the learned vector, and the rest left as
    they are, so that the blocks cannot trust what they see.

    Args:
      key: JAX random key.
      state: clean, [B, l, J, C].
      hidden: from `draw_hidden`.

    Source: MARDM's released code.
    """
    key_noise, key_choice, key_vector = jax.random.split(key, 3)
    replaced = hidden & jax.random.bernoulli(key_choice, 0.1, hidden.shape)
    spoilt = jnp.where(replaced[..., None, None], jax.random.normal(key_noise, state.shape), state)
    return spoilt, hidden & ~replaced & jax.random.bernoulli(key_vector, 0.88, hidden.shape)


def frames_known(lengths, num_rounds: int):
    """Return how many frames of each motion are known after each round of sampling, [rounds, B], rising to all."""
    left = masked_share(jnp.arange(1, num_rounds + 1) / num_rounds)
    # Rounding may not keep the last frame hidden.
    return lengths - jnp.floor(left[:, None] * lengths + 1e-4).astype(lengths.dtype)
