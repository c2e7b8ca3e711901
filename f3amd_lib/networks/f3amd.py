"""The F3AMD network (paper section 3.4, Figure 2), from top to bottom.

    x_noisy -> encoder -> N x (base block under the condition) -> decoder -> x0_hat

Every row of Tables 8 to 11 is a value of `F3AMDConfig`, and so is every filling where the paper is silent. Our
additions are in `networks.variants`, which changes single steps of this network.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from typing import ClassVar

import jax
import jax.numpy as jnp
from flax import nnx

from f3amd_lib.networks.attention import TransformerBlock, check_num_heads, position_code
from f3amd_lib.networks.conditioning import CONDITIONINGS, ConditionedConfig, ConditionEncoder, conditioning_layer
from f3amd_lib.networks.config import DenoisingNetwork, scaled_input
from f3amd_lib.networks.spectral import SPECTRAL_VARIANTS, FNOBlock, FrameLayer, count_modes, frames_first


@dataclass(frozen=True, kw_only=True)
class F3AMDConfig(ConditionedConfig):
    """Everything that decides an F3AMD network's shape and formulas.

    Attributes:
      base_block: "fno" or "transformer" (section 3.4.1).
      num_kept_modes: m, modes kept by the FNO blocks (section 4.5: 17 of 17 RFFT bins, or 33 of 33
        with 64 frames); 0 stands for all there are. Encoder and decoder keep as many of theirs, if
        they have so many.
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

    Raises:
      ValueError: for sizes that are not positive, unknown variants, modes out of range, or heads
        that do not divide the width.
    """

    family: ClassVar[str] = "F3AMD"
    choices: ClassVar[dict[str, tuple[str, ...]]] = {
        "base_block": ("fno", "transformer"),
        "spectral_variant": SPECTRAL_VARIANTS,
        "encoder_decoder": ("fno", "linear"),
        "conditioning": tuple(CONDITIONINGS),
    }
    may_be_zero: ClassVar[tuple[str, ...]] = ("dropout", "num_kept_modes")

    base_block: str = "fno"
    num_kept_modes: int = 0
    spectral_variant: str = "fourier"
    spectral_rank: int = 8
    initial_mode_gain: float = 0.7
    encoder_decoder: str = "fno"
    conditioning: str = "film"
    kernel_size: int = 3
    num_condition_heads: int = 1
    num_heads: int = 1
    feed_forward_factor: int = 4

    def __post_init__(self):
        super().__post_init__()
        frames, modes = self.block_frames, count_modes(self.spectral_variant, self.block_frames)
        kept = self.num_kept_modes or modes
        object.__setattr__(self, "num_kept_modes", kept)
        if kept > modes:
            raise ValueError(f"num_kept_modes must be at most {modes} for blocks of {frames} frames, got {kept}")
        for heads in (self.num_heads, self.num_condition_heads):
            check_num_heads(self.latent_width, heads)

    @property
    def block_frames(self) -> int:
        """Frames that a backbone block sees: concatenation lays c before the features."""
        return self.frames_before + self.window * (2 if self.conditioning == "concatenation" else 1)


class F3AMD(DenoisingNetwork):
    """Denoiser G of Eq. 1: noisy features, noise level and context in, clean features out."""

    def __init__(self, config: F3AMDConfig, *, rngs: nnx.Rngs):
        self.config = config
        width = config.latent_width
        self.condition = ConditionEncoder(config, config.num_condition_heads, rngs=rngs)
        self.encoder = self._coder("encoder", config.channels, width, rngs)
        self.blocks = nnx.List([self._base_block(rngs) for _ in range(config.depth)])
        way_in = partial(conditioning_layer, config.conditioning, width, width, num_heads=config.num_condition_heads)
        self.conditionings = nnx.List([way_in(rngs=rngs) for _ in range(config.depth)])
        self.decoder = self._coder("decoder", width, config.channels, rngs)

    def _coder(self, side: str, width_in: int, width_out: int, rngs: nnx.Rngs):
        """Build the encoder or the decoder (Table 9)."""
        config = self.config
        if config.encoder_decoder == "linear":
            return nnx.Linear(width_in, width_out, rngs=rngs)
        modes = min(config.num_kept_modes, count_modes("fourier", config.frames_before + config.window))
        return self._fno_block(width_in, width_out, modes, rngs=rngs)

    def _base_block(self, rngs: nnx.Rngs):
        config, width = self.config, self.config.latent_width
        if config.base_block == "transformer":
            hidden = config.feed_forward_factor * width
            return TransformerBlock(width, config.num_heads, hidden, config.dropout, rngs=rngs)
        spectral = {"rank": config.spectral_rank, "initial_gain": config.initial_mode_gain}
        return self._fno_block(width, width, config.num_kept_modes, config.spectral_variant, rngs=rngs, **spectral)

    def _fno_block(self, width_in: int, width_out: int, modes: int, variant: str = "fourier", **spectral):
        return FNOBlock(width_in, width_out, modes, self.config.kernel_size, variant=variant, **spectral)

    def encode(self, condition):
        """Encode a condition once a round.

        Args:
          condition: history [B, H, C], path [B, T, 8], style [B, S], normalised units.

        Returns:
          What `__call__` takes as `context`.

        Raises:
          ValueError: if a shape does not fit the config.
        """
        self.config.check_condition(condition)
        return self.condition.encode(condition)

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
        sigma = jnp.asarray(sigma, x_noisy.dtype)
        # The noise level asks history, path and style: one answer for each frame (section 3.3).
        c = self.condition(context, sigma)
        yield "c", c
        z, c = self._turned(self._seen(x_noisy, sigma, context)), self._turned(c)
        z = encoded = self._encoded(z)
        yield "encoder", self._turned(z)
        if config.conditioning == "concatenation":
            # Once, ahead of the first block; the decoder drops these frames again.
            z = jnp.concatenate([c, z], axis=self._frames_axis)
        if config.base_block == "transformer":
            # Attention has no sense of order of its own (section 3.4.1).
            z = z + jnp.asarray(position_code(0, config.block_frames, z.shape[-1]), z.dtype)
        for number, (block, conditioning) in enumerate(zip(self.blocks, self.conditionings, strict=True)):
            base = partial(self._run, block, key=None if key is None else jax.random.fold_in(key, number))
            z = self._updated(conditioning, base, z, c)
            yield f"block {number + 1}", self._turned(z)
        x0_hat = self._turned(self._decoded(self._last(z, encoded)))[:, config.frames_before :]
        yield "decoder", x0_hat
        yield "x0_hat", x0_hat

    # The steps that `networks.variants` changes.

    def _seen(self, x_noisy, sigma, context):
        """Return what the encoder sees."""
        return scaled_input(self.config, x_noisy, sigma)

    def _encoded(self, z):
        return self._run(self.encoder, z)

    def _updated(self, conditioning, base, z, c):
        """Return z after a base block under the condition (Table 11)."""
        return conditioning(base, z, c)

    def _last(self, z, encoded):
        """Return the frames that the decoder reads: those of the encoder, not those of a c laid before them."""
        axis = self._frames_axis
        return jax.lax.slice_in_dim(z, -encoded.shape[axis], None, axis=axis)

    def _decoded(self, z):
        return self._run(self.decoder, z)

    # Fourier blocks are faster on [T, B, D], and so from encoder to decoder; attention wants [B, T, D].

    @property
    def _frames_axis(self) -> int:
        fourier = all(isinstance(block, FrameLayer) for block in self.blocks)
        return 0 if fourier and self.config.conditioning != "cross_attention" else 1

    def _turned(self, z):
        """Map [B, T, D] to the order of the blocks, or back."""
        return z if self._frames_axis else frames_first(z)

    def _run(self, layer, z, **key):
        """Call a layer in the order of the blocks; a linear one cares for neither."""
        in_order = self._frames_axis == 0 and isinstance(layer, FrameLayer)
        return layer.frames_first(z) if in_order else layer(z, **key)
