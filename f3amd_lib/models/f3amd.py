"""The F3AMD network (paper section 3.4, Figure 2) and all variants of it that the paper ablates.

    x_noisy -> encoder -> N x (base block under the condition) -> decoder -> x0_hat

Every variant is a value of `F3AMDConfig`, and so is every filling where the paper is silent.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from f3amd_lib.models.attention import TransformerBlock, position_code
from f3amd_lib.models.conditioning import (
    CONDITIONINGS,
    Condition,
    ConditionEncoder,
    Context,
    conditioning_layer,
)
from f3amd_lib.models.config import Denoiser, NetworkConfig, scaled_input
from f3amd_lib.models.spectral import (
    SPECTRAL_VARIANTS,
    FNOBlock,
    FrameLayer,
    cosine_basis,
    count_modes,
    frames_first,
)

__all__ = ["F3AMDConfig", "F3AMD"]


@dataclass(frozen=True)
class F3AMDConfig(NetworkConfig):
    """Everything that decides an F3AMD network's shape and formulas.

    Attributes:
      base_block: "fno" or "transformer" (section 3.4.1).
      num_kept_modes: m, modes kept by the FNO blocks (section 4.5: 17 of 17 RFFT bins, or 33 of 33
        with 64 frames). Encoder and decoder keep as many of theirs, if they have so many.
      spectral_variant: transform and weights of the base blocks (Table 8); encoder and decoder stay
        Fourier, since the table speaks of the backbone.
      spectral_rank: rank of "reduced_rank" (Appendix E: 8).
      initial_mode_gain: where the gains of "weighted" start (Appendix E: 0.7).
      encoder_decoder: "fno" or "linear" (Table 9).
      conditioning: how c enters a block (Table 11).
      kernel_size: k of Eq. 3; not in the paper, 3 here.
      num_condition_heads: heads of the cross-attention to c; not in the paper, 1 here.
      num_heads: attention heads of a Transformer base block (Appendix A).
      feed_forward_factor: its hidden width over D; not in the paper, 4 as in Vaswani et al. 2017.
      dropout: of Transformer blocks in training; not in the paper, 0 here.
      block_residual: add each block's input to its output (ours; the paper's Figure 2 has none).
      history_anchor: add the last history frame, with a learned weight that starts as a decay over
        the window, so that the network predicts a change (ours).
      output_scaling: let the network estimate what is left of the clean features after a skip,
        x0_hat = c_skip x + c_out F(c_in x), as Karras et al. 2022 do (Table 1, with sigma_data);
        at low noise the noisy input passes through (ours).
      decoder_hidden_width: channels between two layers of the decoder; 0: one layer, as in the
        paper (ours).
      residual_prior: combine the network's estimate with the noisy input as the posterior mean of a
        Gaussian residual whose variance per channel and cosine mode is learned (ours).

    Raises:
      ValueError: for sizes that are not positive, unknown variants, modes out of range, or heads
        that do not divide the width.
    """

    family: ClassVar[str] = "F3AMD"
    choices: ClassVar[dict[str, tuple[str, ...]]] = {
        "base_block": ("fno", "transformer"),
        "spectral_variant": SPECTRAL_VARIANTS,
        "encoder_decoder": ("fno", "linear"),
        "conditioning": CONDITIONINGS,
    }
    may_be_zero: ClassVar[tuple[str, ...]] = ("dropout", "decoder_hidden_width")

    base_block: str = "fno"
    num_kept_modes: int = 17
    spectral_variant: str = "fourier"
    spectral_rank: int = 8
    initial_mode_gain: float = 0.7
    encoder_decoder: str = "fno"
    conditioning: str = "film"
    kernel_size: int = 3
    num_condition_heads: int = 1
    num_heads: int = 1
    feed_forward_factor: int = 4
    dropout: float = 0.0
    block_residual: bool = False
    history_anchor: bool = False
    output_scaling: bool = False
    decoder_hidden_width: int = 0
    residual_prior: bool = False

    def __post_init__(self):
        super().__post_init__()
        modes = self.count_block_modes()
        if self.num_kept_modes > modes:
            raise ValueError(
                f"num_kept_modes must be at most {modes} for blocks of {self.block_frames} "
                f"frames and spectral_variant {self.spectral_variant!r}, got {self.num_kept_modes}"
            )
        if self.latent_width % self.num_heads:
            raise ValueError(
                f"num_heads must divide the latent width {self.latent_width}, got {self.num_heads}"
            )
        if self.dropout >= 1.0:
            raise ValueError(f"dropout must be below 1, got {self.dropout}")
        if self.block_residual and self.conditioning == "adaln_zero":
            raise ValueError("adaln_zero is residual already: leave block_residual off")

    @property
    def block_frames(self) -> int:
        """Frames that a backbone block sees: concatenation lays c before the features."""
        return 2 * self.window if self.conditioning == "concatenation" else self.window

    def count_block_modes(self) -> int:
        """Return how many modes the backbone's transform has; as many can be kept."""
        return count_modes(self.spectral_variant, self.block_frames)


def _applied(layer, turned: bool):
    """Return how a layer is called, on [T, B, D] if turned; a linear one cares for neither."""
    return layer.frames_first if turned and isinstance(layer, FrameLayer) else layer


class F3AMD(Denoiser):
    """Denoiser G of Eq. 1: noisy features, noise level and context in, clean features out."""

    def __init__(self, config: F3AMDConfig, *, rngs: nnx.Rngs):
        self.config = config
        width = config.latent_width
        self.condition = ConditionEncoder(
            config.channels,
            config.num_styles,
            width,
            config.window,
            config.num_history,
            config.num_condition_heads,
            rngs=rngs,
        )
        depth = range(config.depth)
        self.encoder = self._coder(config.channels, width, rngs)
        self.blocks = nnx.List([self._base_block(rngs) for _ in depth])
        self.conditionings = nnx.List([self._conditioning_layer(rngs) for _ in depth])
        if hidden := config.decoder_hidden_width:
            self.decoder_hidden = self._coder(width, hidden, rngs)
        self.decoder = self._coder(hidden or width, config.channels, rngs)
        if config.history_anchor:
            decay = np.exp(-np.arange(1, config.window + 1) / 10.0)
            anchor = np.repeat(decay[:, None], config.channels, axis=1)
            self.anchor = nnx.Param(jnp.asarray(anchor, jnp.float32))
        if config.residual_prior:
            # Slow modes are free, fast ones nearly fixed; a tenth of the logarithm is stored, so
            # that it learns ten times as fast as a weight.
            log_deviation = np.log(0.1) - 1.5 * np.log1p(np.arange(config.window))
            start = np.repeat(0.1 * 2.0 * log_deviation[:, None], config.channels, axis=1)
            self.residual_variance = nnx.Param(jnp.asarray(start, jnp.float32))

    def _coder(self, width_in: int, width_out: int, rngs: nnx.Rngs):
        config = self.config
        if config.encoder_decoder == "linear":
            return nnx.Linear(width_in, width_out, rngs=rngs)
        modes = min(config.num_kept_modes, count_modes("fourier", config.window))
        return FNOBlock(width_in, width_out, modes, config.kernel_size, rngs=rngs)

    def _base_block(self, rngs: nnx.Rngs):
        config, width = self.config, self.config.latent_width
        if config.base_block == "transformer":
            hidden = config.feed_forward_factor * width
            return TransformerBlock(width, config.num_heads, hidden, config.dropout, rngs=rngs)
        return FNOBlock(
            width,
            width,
            config.num_kept_modes,
            config.kernel_size,
            config.spectral_variant,
            config.spectral_rank,
            config.initial_mode_gain,
            rngs=rngs,
        )

    def _conditioning_layer(self, rngs: nnx.Rngs):
        config = self.config
        return conditioning_layer(
            config.conditioning,
            config.latent_width,
            config.latent_width,
            num_heads=config.num_condition_heads,
            zero_output=config.block_residual,
            rngs=rngs,
        )

    def encode(self, condition: Condition) -> tuple[Context, jax.Array]:
        """Encode a condition once a round.

        Args:
          condition: history [B, H, C], path [B, T, 8], style [B, S], normalised units.

        Returns:
          What `__call__` takes as `context`.

        Raises:
          ValueError: if a shape does not fit the config.
        """
        self.config.check_condition(condition)
        return self.condition.encode(condition), condition.history[:, -1]

    def stages(self, x_noisy, sigma, context, key=None) -> Iterator[tuple[str, jax.Array]]:
        """Yield the name and value of every station from x_noisy to x0_hat (Figure 2).

        Args:
          x_noisy, sigma, context, key: as in `__call__`.

        Yields:
          "c" [B, T, D], "encoder" [B, T, D], "block 1" ... (2 T frames under concatenation),
          "decoder", and last "x0_hat" [B, T, C].
        """
        config = self.config
        config.check_state(x_noisy)
        tokens, last_frame = context
        sigma = jnp.asarray(sigma, x_noisy.dtype)
        c = self.condition(tokens, sigma)
        yield "c", c
        z = scaled_input(config, x_noisy, sigma)
        # Fourier blocks are faster with frames first, and so from encoder to decoder; attention
        # wants the batch first.
        attends = config.conditioning == "cross_attention"
        turned = not attends and all(isinstance(block, FrameLayer) for block in self.blocks)
        turn = frames_first if turned else lambda array: array
        z, c, frames = turn(z), turn(c), 0 if turned else 1
        z = _applied(self.encoder, turned)(z)
        yield "encoder", turn(z)
        if config.conditioning == "concatenation":
            z = jnp.concatenate([c, z], axis=frames)
        if config.base_block == "transformer":
            # Attention has no sense of order of its own (section 3.4.1).
            z = z + jnp.asarray(position_code(0, config.block_frames, z.shape[-1]), z.dtype)
        layers = zip(self.blocks, self.conditionings, strict=True)
        for number, (block, conditioning) in enumerate(layers):
            base = _applied(block, turned)
            if key is not None and not turned:
                base = partial(base, key=jax.random.fold_in(key, number))
            update = conditioning(base, z, c)
            z = z + update if config.block_residual else update
            yield f"block {number + 1}", turn(z)
        last = jax.lax.slice_in_dim(
            z, z.shape[frames] - config.window, z.shape[frames], axis=frames
        )
        if config.decoder_hidden_width:
            last = nnx.gelu(_applied(self.decoder_hidden, turned)(last))
        x0_hat = turn(_applied(self.decoder, turned)(last))
        yield "decoder", x0_hat
        if config.output_scaling:
            total = sigma.reshape(-1, 1, 1) ** 2 + config.sigma_data**2
            c_skip = config.sigma_data**2 / total
            c_out = sigma.reshape(-1, 1, 1) * config.sigma_data / jnp.sqrt(total)
            x0_hat = c_skip * x_noisy + c_out * x0_hat
        if config.history_anchor:
            x0_hat = x0_hat + self.anchor[...] * last_frame[:, None, :]
        if config.residual_prior:
            basis = jnp.asarray(cosine_basis(config.window), x_noisy.dtype)
            variance = jnp.exp(10.0 * self.residual_variance[...])
            gain = variance / (variance + sigma.reshape(-1, 1, 1) ** 2)
            residual = jnp.einsum("kt,btc->bkc", basis, x_noisy - x0_hat)
            x0_hat = x0_hat + jnp.einsum("kt,bkc->btc", basis, gain * residual)
        yield "x0_hat", x0_hat
