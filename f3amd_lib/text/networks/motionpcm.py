"""The networks of MotionPCM: a Transformer autoencoder to 16 x 32 latents, teacher and student, and a discriminator.

    motion [B, L, C] -> latent [B, 16, 32] -> motion
    noisy latent, time, text and, for the student, guidance -> its noise

All have one body, a Transformer whose second half is handed what the first one made, as a U-net does.

Source: MotionPCM sections 4.1 and 4.3 and Appendix A.2 (Jiang et al. 2025), with the sizes of MotionLCM V2's released
code, whose autoencoder and teacher it uses.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar

import jax
import jax.numpy as jnp
from flax import nnx

from f3amd_lib.networks.attention import TransformerBlock, check_num_heads
from f3amd_lib.networks.config import CheckedConfig
from f3amd_lib.text.networks.acmdm import waves

GUIDANCE_SCALE = 1000.0
"""Guidance is multiplied by it before its waves (MotionLCM's released code)."""


@dataclass(frozen=True, kw_only=True)
class SkipTransformerConfig(CheckedConfig):
    """Sizes of the body, and of a latent.

    Attributes:
      window: tokens of the latent.
      channels: of a latent token.
      latent_width: D, inside.
      depth: blocks; odd, one of them is the middle.
      num_heads, hidden_width: of a block.
      dropout: in training.
      num_positions: entries of each learned table of positions; no sequence is longer.
      position_start: how these tables begin: "uniform", from 0 to 1 (MotionLCM V2), or "waves", sinusoids, from which a
        short training learns an order of frames that it does not find in noise (ours).

    Raises:
      ValueError: for a size that makes no sense, or an even depth.
    """

    may_be_zero: ClassVar[tuple[str, ...]] = ("dropout",)
    choices: ClassVar[dict[str, tuple[str, ...]]] = {"position_start": ("uniform", "waves")}

    window: int = 16
    channels: int = 32
    latent_width: int = 256
    depth: int = 9
    num_heads: int = 4
    hidden_width: int = 1024
    dropout: float = 0.1
    num_positions: int = 500
    position_start: str = "uniform"

    def __post_init__(self):
        super().__post_init__()
        check_num_heads(self.latent_width, self.num_heads)
        if self.depth % 2 == 0:
            raise ValueError(f"depth must be odd, got {self.depth}")


class SkipTransformer(nnx.Module):
    """Blocks in two halves about a middle one; what the first half made is joined to the second in reverse order."""

    def __init__(self, config: SkipTransformerConfig, *, crossing: bool = False, rngs: nnx.Rngs):
        width, self.half = config.latent_width, config.depth // 2
        sizes = width, config.num_heads, config.hidden_width, config.dropout
        self.blocks = nnx.List([TransformerBlock(*sizes, crossing=crossing, rngs=rngs) for _ in range(config.depth)])
        self.joins = nnx.List([nnx.Linear(2 * width, width, rngs=rngs) for _ in range(self.half)])
        self.norm = nnx.LayerNorm(width, epsilon=1e-5, rngs=rngs)

    def outputs(self, z, mask=None, memory=None, key=None) -> Iterator[jax.Array]:
        """Yield what each block makes of [B, T, D]; arguments as of `TransformerBlock`."""
        kept = []
        for number, block in enumerate(self.blocks):
            if number > self.half:
                z = self.joins[number - self.half - 1](jnp.concatenate([z, kept.pop()], axis=-1))
            z = block(z, None if key is None else jax.random.fold_in(key, number), mask, memory)
            if number < self.half:
                kept.append(z)
            yield z

    def __call__(self, z, mask=None, memory=None, key=None):
        """Map [B, T, D] to [B, T, D], normalised."""
        *_, z = self.outputs(z, mask, memory, key)
        return self.norm(z)


def position_table(config: SkipTransformerConfig, rngs: nnx.Rngs) -> nnx.Param:
    """Return learned positions [num_positions, D], which begin as the config says."""
    if config.position_start == "waves":
        return nnx.Param(waves(jnp.arange(config.num_positions), config.latent_width, config.latent_width / 2))
    return nnx.Param(jax.random.uniform(rngs.params(), (config.num_positions, config.latent_width)))


# --------------------------------------------------------------------------------------------------------- autoencoder


@dataclass(frozen=True, kw_only=True)
class LatentAutoencoderConfig(SkipTransformerConfig):
    """Everything that decides the shape of the autoencoder (MotionPCM section 4.1).

    Attributes:
      features: numbers of a frame of motion: 263 of HumanML3D, 251 of KIT-ML, 12 J - 1.
      path: how movement gets to a token: "attention" alone (MotionLCM V2), or "spans" (ours): a token begins with the
        mean of its span of the clip's frames, and a frame with its span's token. Blocks then begin as the identity,
        and latents with little noise, so that a short training meets movement in its first steps.
      released_facing: of the vectors that it knows (`redundant.smoothed_yaw`); presets have it, earlier files have not.
    """

    family: ClassVar[str] = "latent autoencoder"
    choices: ClassVar[dict[str, tuple[str, ...]]] = SkipTransformerConfig.choices | {"path": ("attention", "spans")}

    features: int = 263
    path: str = "attention"
    released_facing: bool = False


SPAN_LOG_VARIANCE = -5.0
"""What a fresh autoencoder of path "spans" adds to its latents' log variance (ours)."""


def span_shares(mask, window: int):
    """Return how much of each frame belongs to each of `window` even spans of its clip, [B, L, window].

    A frame between the middles of two spans belongs to both; a frame's shares sum to 1, to 0 in padding.

    Args:
      mask: frames that are motion, [B, L].
      window: spans.
    """
    length = jnp.sum(mask, axis=1, keepdims=True)
    place = jnp.clip((jnp.arange(mask.shape[1]) + 0.5) * window / length - 0.5, 0, window - 1)
    return jnp.maximum(0.0, 1.0 - jnp.abs(place[..., None] - jnp.arange(window))) * mask[..., None]


def _begin_as_identity(body: SkipTransformer) -> None:
    """Let each part of each block add nothing yet, and joins pass on what comes from the block before."""
    for block in body.blocks:
        parts = [block, block.attention] + ([block.crossing] if hasattr(block, "crossing") else [])
        for part in parts:
            part.output.kernel[...] = jnp.zeros_like(part.output.kernel[...])
    for join in body.joins:
        join.kernel[...] = jnp.eye(*join.kernel.shape)


class LatentAutoencoder(nnx.Module):
    """A clip of any length to a latent of one size, and back."""

    def __init__(self, config: LatentAutoencoderConfig, *, rngs: nnx.Rngs):
        self.config, width = config, config.latent_width
        self.frames = nnx.Linear(config.features, width, rngs=rngs)
        self.tokens = nnx.Param(jax.random.normal(rngs.params(), (2 * config.window, width)))
        self.encoder_positions = position_table(config, rngs)
        self.encoder = SkipTransformer(config, rngs=rngs)
        self.to_latent = nnx.Linear(width, config.channels, rngs=rngs)
        self.from_latent = nnx.Linear(config.channels, width, rngs=rngs)
        self.decoder_positions = position_table(config, rngs)
        self.decoder = SkipTransformer(config, crossing=True, rngs=rngs)
        self.output = nnx.Linear(width, config.features, rngs=rngs)
        if config.path == "spans":
            for body in (self.encoder, self.decoder):
                _begin_as_identity(body)

    def encode(self, features, mask, key=None):
        """Return (mean, log variance) of the latent, [B, window, channels] each.

        Args:
          features: normalised, [B, L, features]; what stands in the padding does not matter.
          mask: frames that are motion, [B, L].
          key: random key of the dropout, in training.

        Raises:
          ValueError: for another width, or more frames than there are positions.
        """
        config, length = self.config, features.shape[1]
        if features.shape[2:] != (config.features,) or length + 2 * config.window > config.num_positions:
            wanted = f"[B, at most {config.num_positions - 2 * config.window}, {config.features}]"
            raise ValueError(f"features must be {wanted}, got {features.shape}")
        tokens = jnp.broadcast_to(self.tokens[...], (len(features), *self.tokens.shape))
        frames = self.frames(features)
        if config.path == "spans":
            share = span_shares(mask, config.window)
            share = share / jnp.maximum(jnp.sum(share, axis=1, keepdims=True), 1e-6)
            # What stands in the padding may be infinite, and 0 times that is no number.
            mean = jnp.einsum("blw,bld->bwd", share, jnp.where(mask[..., None], frames, 0.0))
            tokens = tokens + jnp.tile(mean, (1, 2, 1))
        z = jnp.concatenate([tokens, frames], axis=1)
        seen = jnp.concatenate([jnp.ones(tokens.shape[:2], bool), mask], axis=1)
        z = self.encoder(z + self.encoder_positions[...][: z.shape[1]], seen, key=key)
        mean, log_variance = jnp.split(self.to_latent(z[:, : 2 * config.window]), 2, axis=1)
        return mean, log_variance + (SPAN_LOG_VARIANCE if config.path == "spans" else 0.0)

    def decode(self, latent, mask, key=None):
        """Return features [B, L, features], zero in padding, of a latent [B, window, channels]; arguments as above."""
        queries = jnp.broadcast_to(
            self.decoder_positions[...][: mask.shape[1]], (*mask.shape, self.config.latent_width)
        )
        memory = self.from_latent(latent)
        if self.config.path == "spans":
            queries = queries + span_shares(mask, self.config.window) @ memory
        z = self.decoder(queries, mask, memory, key)
        return self.output(z) * mask[..., None]


# -------------------------------------------------------------------------------------------------- teacher and student


@dataclass(frozen=True, kw_only=True)
class LatentDenoiserConfig(SkipTransformerConfig):
    """Everything that decides the shape of teacher and student (MotionPCM sections 4.1 and 4.2).

    Attributes:
      text_width: W of a caption's embedding: 768 of Sentence-T5.
      time_features: waves of the time.
      guidance_features: waves of the guidance; 0 for a teacher, which is not told it.
      text_scale: what embeddings are multiplied by; the offline encoder's are a third long, so that a short training
        would hardly hear them.
    """

    family: ClassVar[str] = "latent denoiser"
    objective: ClassVar[str] = "eps"
    sampler: ClassVar[str] = "ddim"
    may_be_zero: ClassVar[tuple[str, ...]] = ("dropout", "guidance_features")
    from_data: ClassVar[tuple[str, ...]] = ("text_width",)

    text_width: int = 768
    time_features: int = 768
    guidance_features: int = 0
    text_scale: float = 1.0

    def state_shape(self, batch: int) -> tuple[int, ...]:
        """Return the shape of a noisy latent, [B, window, channels]."""
        return batch, self.window, self.channels

    def condition_shapes(self, batch: int):
        """Return the shape of captions, [B, text_width]."""
        return jax.ShapeDtypeStruct((batch, self.text_width), jnp.float32)


class LatentDenoiser(nnx.Module):
    """The noise of a latent, from its tokens, one for the time and one for the text (MotionLCM V2's MLD)."""

    def __init__(self, config: LatentDenoiserConfig, *, rngs: nnx.Rngs):
        self.config, width = config, config.latent_width
        self.latent = nnx.Linear(config.channels, width, rngs=rngs)
        self.text = nnx.Linear(config.text_width, width, rngs=rngs)
        self.time_first = nnx.Linear(config.time_features, width, rngs=rngs)
        self.time_second = nnx.Linear(width, width, rngs=rngs)
        self.positions = position_table(config, rngs)
        self.body = SkipTransformer(config, rngs=rngs)
        self.output = nnx.Linear(width, config.channels, rngs=rngs)
        if config.guidance_features:
            # From zero on, a student answers what its teacher does, whatever the guidance.
            zero = nnx.initializers.zeros_init()
            sizes = config.guidance_features, config.time_features
            self.guidance = nnx.Linear(*sizes, use_bias=False, kernel_init=zero, rngs=rngs)

    def encode(self, text):
        """Return the token of captions [B, text_width]: [B, D]."""
        return self.text(self.config.text_scale * text)

    def _tokens(self, state, time, context, guidance):
        config = self.config
        if state.ndim != 3 or state.shape[1:] != (config.window, config.channels):
            raise ValueError(f"state must be [B, {config.window}, {config.channels}], got {state.shape}")
        time = waves(time, config.time_features, config.time_features / 2)
        if guidance is not None:
            width, scaled = config.guidance_features, GUIDANCE_SCALE * jnp.asarray(guidance)
            time = time + self.guidance(waves(scaled, width, width / 2 - 1, sine_first=True))
        time = jnp.broadcast_to(self.time_second(jax.nn.silu(self.time_first(time))), context.shape)
        z = jnp.concatenate([self.latent(state), time[:, None], context[:, None]], axis=1)
        return z + self.positions[...][: z.shape[1]]

    def __call__(self, state, time, context, guidance=None, key=None):
        """Predict the noise.

        Args:
          state: noisy latents, [B, window, channels].
          time: level numbers, [B] or one for all.
          context: from `encode`.
          guidance: w of MotionPCM Eq. 11, [B] or one for all, for a student; None adds nothing.
          key: random key of the dropout, in training.

        Returns:
          [B, window, channels].

        Raises:
          ValueError: if the state does not fit the config.
        """
        z = self.body(self._tokens(state, time, context, guidance), key=key)
        return self.output(z[:, : self.config.window])

    def features(self, state, time, context) -> list[jax.Array]:
        """Return what each block makes of the latent's tokens, [B, window, D] each: what a discriminator reads."""
        return [z[:, : self.config.window] for z in self.body.outputs(self._tokens(state, time, context, None))]


def student_config(teacher: LatentDenoiserConfig) -> LatentDenoiserConfig:
    """Return the config of a teacher's student, which is told the guidance."""
    return dataclasses.replace(teacher, guidance_features=256)


def student_of(teacher: LatentDenoiser, key) -> LatentDenoiser:
    """Return a student with its teacher's weights, and an answer that no guidance changes yet (MotionPCM section 4.2).

    Args:
      teacher: left as it is.
      key: of weights that are then replaced.
    """
    student = LatentDenoiser(student_config(teacher.config), rngs=nnx.Rngs(params=key))
    nnx.update(student, nnx.state(teacher))
    return student


# ------------------------------------------------------------------------------------------------------- discriminator


@dataclass(frozen=True, kw_only=True)
class DiscriminatorConfig(CheckedConfig):
    """Sizes of a discriminator's trained part; those of the network that it reads.

    Attributes:
      latent_width, depth: of the teacher.
      heads: that read each block, side by side.
    """

    family: ClassVar[str] = "latent discriminator"

    latent_width: int = 256
    depth: int = 9
    heads: int = 1


class DiscriminatorHead(nnx.Module):
    """A score for each token: h1 = act(LN(W1 x)), h2 = h1 + act(LN(W2 h1)), W3 h2 (our reading of MotionPCM Fig. 5)."""

    def __init__(self, width: int, *, rngs: nnx.Rngs):
        self.first, self.second = (nnx.Linear(width, width, rngs=rngs) for _ in range(2))
        self.first_norm, self.second_norm = (nnx.LayerNorm(width, epsilon=1e-5, rngs=rngs) for _ in range(2))
        self.score = nnx.Linear(width, 1, rngs=rngs)

    def __call__(self, x):
        """Map [B, T, D] to [B, T]."""
        x = nnx.leaky_relu(self.first_norm(self.first(x)), 0.2)
        x = x + nnx.leaky_relu(self.second_norm(self.second(x)), 0.2)
        return self.score(x)[..., 0]


class Discriminator(nnx.Module):
    """Heads on the blocks of a frozen teacher (MotionPCM section 4.3, Figure 5)."""

    def __init__(self, config: DiscriminatorConfig, *, rngs: nnx.Rngs):
        head = lambda: DiscriminatorHead(config.latent_width, rngs=rngs)
        self.heads = nnx.List([nnx.List([head() for _ in range(config.heads)]) for _ in range(config.depth)])

    def __call__(self, features):
        """Return scores [B, depth, heads, T] of `LatentDenoiser.features`; high for data."""
        rows = [jnp.stack([head(z) for head in heads], axis=1) for heads, z in zip(self.heads, features, strict=True)]
        return jnp.stack(rows, axis=1)
