"""The F3AMD network (paper section 3.4, Figure 2) and all variants of it that the paper ablates.

    x_noisy -> encoder -> N x (base block under the condition) -> decoder -> x0_hat

Every variant is a value of `F3AMDConfig`, and so is every filling where the paper is silent.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from typing import ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from f3amd_lib.networks.attention import TransformerBlock, check_num_heads, position_code
from f3amd_lib.networks.conditioning import (
    CONDITIONINGS,
    PATH_CHANNELS,
    Condition,
    ConditionedConfig,
    ConditionEncoder,
    Context,
    conditioning_layer,
)  # fmt: skip
from f3amd_lib.networks.config import DenoisingNetwork, scaled_input
from f3amd_lib.networks.spectral import SPECTRAL_VARIANTS, FNOBlock, FrameLayer, cosine_basis, count_modes, frames_first


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
      block_residual: add each block's input to its output, which begins at 0 (ours; the paper's Figure 2 has none).
      block_bypass: add each block's input to its output, and change nothing else (ours, a reading of Figure 2).
      coordinate_channel: let the encoder see where in the window a frame is (a reading of section 3.4.2:
        Li et al. 2021 give their operator the grid).
      small_spectral_weights: let spectral weights begin in [0, 1) over D0 D1, as Li et al. 2021 do (a reading of
        section 3.4.2), instead of at unit gain.
      history_anchor: add the last history frame, with a learned weight that starts as a decay over
        the window, so that the network predicts a change (ours).
      output_scaling: let the network estimate what is left of the clean features after a skip,
        x0_hat = c_skip x + c_out F(c_in x), as Karras et al. 2022 do (Table 1, with sigma_data);
        at low noise the noisy input passes through (ours).
      encoder_hidden_width: channels between two layers of the encoder; 0: one layer, as in the
        paper (ours).
      decoder_hidden_width: the same of the decoder.
      encoder_skip: add the encoder's output to what the decoder reads (ours; the idea of Ronneberger
        et al. 2015).
      film_from_identity: let FiLM begin with gamma = beta = 0, so that z_tilde = z_base in Eq. 6, as
        Zhang et al. 2023 begin what they add (ours).
      pre_norm: normalise the channels that each base block reads to mean 0 and variance 1 (ours; after
        Xiong et al. 2020, without their learned scale).
      residual_prior: combine the network's estimate with the noisy input as the posterior mean of a
        Gaussian residual whose variance per channel and cosine mode is learned (ours).
      facing_frame: turn history, path and noisy input so that the path's first frame faces +Z, and
        turn the answer back: the network is then the same for every heading instead of learning
        that from random turns (ours; needs a normaliser that treats x and z alike).
      history_input: let encoder, blocks and decoder see the history in front of the noisy window,
        and the path beside it, instead of through the condition alone. The seam then lies inside
        the period of the transform, not at its ends (ours).

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
    may_be_zero: ClassVar[tuple[str, ...]] = (
        "dropout", "num_kept_modes", "encoder_hidden_width", "decoder_hidden_width",
    )  # fmt: skip

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
    block_residual: bool = False
    block_bypass: bool = False
    coordinate_channel: bool = False
    small_spectral_weights: bool = False
    history_anchor: bool = False
    output_scaling: bool = False
    encoder_hidden_width: int = 0
    decoder_hidden_width: int = 0
    encoder_skip: bool = False
    film_from_identity: bool = False
    pre_norm: bool = False
    residual_prior: bool = False
    facing_frame: bool = False
    history_input: bool = False

    def __post_init__(self):
        super().__post_init__()
        if self.history_input and self.conditioning == "concatenation":
            raise ValueError("concatenation lays c before the features: leave history_input off")
        modes = count_modes(self.spectral_variant, self.block_frames)
        if self.num_kept_modes == 0:
            object.__setattr__(self, "num_kept_modes", modes)
        if self.num_kept_modes > modes:
            found = f"{self.block_frames} frames, got {self.num_kept_modes}"
            raise ValueError(f"num_kept_modes must be at most {modes} for blocks of {found}")
        check_num_heads(self.latent_width, self.num_heads)
        if self.block_bypass and self.block_residual:
            raise ValueError("block_residual has a bypass already: leave block_bypass off")
        residual = [("is residual", option) for option in ("block_residual", "block_bypass")]
        for has, option in (*residual, ("normalises what a block reads", "pre_norm")):
            if self.conditioning == "adaln_zero" and getattr(self, option):
                raise ValueError(f"adaln_zero {has} already: leave {option} off")
        if self.film_from_identity and self.conditioning != "film":
            raise ValueError(f"film_from_identity is of FiLM, and c enters by {self.conditioning}")

    @property
    def block_frames(self) -> int:
        """Frames that a backbone block sees: concatenation lays c before the features."""
        return self.window + (self.window if self.conditioning == "concatenation" else self.frames_before)

    @property
    def frames_before(self) -> int:
        """Frames that encoder, blocks and decoder see before the window."""
        return self.num_history if self.history_input else 0


def _turned(vectors, matrix):
    """Turn 3D vectors that lie one after the other in the channels [B, T, 3 n] by [B, 3, 3]."""
    apart = vectors.reshape(*vectors.shape[:-1], -1, 3)
    return jnp.einsum("bij,btnj->btni", matrix, apart).reshape(vectors.shape)


def _turned_frames(frames, matrix):
    """Turn features [B, T, C]: root position and the two columns of the root's rotation."""
    return jnp.concatenate([_turned(frames[..., :9], matrix), frames[..., 9:]], axis=-1)


def _facing_forward(condition: Condition) -> tuple[Condition, jax.Array]:
    """Return a condition whose path begins facing +Z, and the rotations that did it, [B, 3, 3]."""
    path = condition.path
    cosine, sine = path[:, 0, 2], -path[:, 0, 4]
    length = jnp.sqrt(cosine**2 + sine**2)
    # A path that was dropped in training is all zeros and faces nowhere.
    known = length > 1e-6
    scale = jnp.where(known, length, 1.0)
    cosine, sine = jnp.where(known, cosine, 1.0) / scale, jnp.where(known, sine, 0.0) / scale
    zero, one = jnp.zeros_like(cosine), jnp.ones_like(cosine)
    rows = [cosine, zero, -sine, zero, one, zero, sine, zero, cosine]
    matrix = jnp.stack(rows, axis=-1).reshape(-1, 3, 3)
    place = jnp.stack([path[..., 0], jnp.zeros_like(path[..., 0]), path[..., 1]], axis=-1)
    place = _turned(place, matrix)[..., jnp.array([0, 2])]
    path = jnp.concatenate([place, _turned(path[..., 2:], matrix)], axis=-1)
    history = _turned_frames(condition.history, matrix)
    return condition._replace(history=history, path=path), matrix


class EncodedCondition(NamedTuple):
    """What a round knows before it starts.

    Attributes:
      tokens: keys and values of the context tokens.
      history: normalised, [B, H, C]; turned like `path` if the config has a `facing_frame`.
      path: [B, T, 8].
      turn: rotations that faced them forward, [B, 3, 3]; None without a `facing_frame`.
    """

    tokens: Context
    history: jax.Array
    path: jax.Array
    turn: jax.Array | None


def _in_every_channel(values: np.ndarray, channels: int) -> nnx.Param:
    """Return weights [T, C] that start with the same value [T] in every channel."""
    return nnx.Param(jnp.asarray(np.repeat(values[:, None], channels, axis=1), jnp.float32))


def _applied(layer, turned: bool):
    """Return how a layer is called, on [T, B, D] if turned; a linear one cares for neither."""
    return layer.frames_first if turned and isinstance(layer, FrameLayer) else layer


def _after_norm(base):
    """Return a base block that reads its channels normalised."""
    return lambda z: base(jax.nn.standardize(z, axis=-1, epsilon=1e-6))


class F3AMD(DenoisingNetwork):
    """Denoiser G of Eq. 1: noisy features, noise level and context in, clean features out."""

    def __init__(self, config: F3AMDConfig, *, rngs: nnx.Rngs):
        self.config = config
        width = config.latent_width
        heads = config.num_condition_heads
        self.condition = ConditionEncoder(config, heads, config.frames_before, rngs=rngs)
        # Beside the features: the path, and whether a frame is given or noisy.
        beside = (PATH_CHANNELS + 1 if config.history_input else 0) + config.coordinate_channel
        if hidden := config.encoder_hidden_width:
            self.encoder_hidden = self._coder(config.channels + beside, hidden, rngs)
        self.encoder = self._coder(hidden or config.channels + beside, width, rngs)
        self.blocks = nnx.List([self._base_block(rngs) for _ in range(config.depth)])
        options = {"num_heads": heads, "identity": config.film_from_identity, "zero_output": config.block_residual}
        way_in = lambda: conditioning_layer(config.conditioning, width, width, **options, rngs=rngs)
        self.conditionings = nnx.List([way_in() for _ in range(config.depth)])
        if hidden := config.decoder_hidden_width:
            self.decoder_hidden = self._coder(width, hidden, rngs)
        self.decoder = self._coder(hidden or width, config.channels, rngs)
        if config.history_anchor:
            decay = np.exp(-np.arange(1, config.window + 1) / 10.0)
            self.anchor = _in_every_channel(decay, config.channels)
        if config.residual_prior:
            # Slow modes are free, fast ones nearly fixed; a tenth of the logarithm is stored, so
            # that it learns ten times as fast as a weight.
            log_deviation = np.log(0.1) - 1.5 * np.log1p(np.arange(config.window))
            self.residual_variance = _in_every_channel(0.1 * 2.0 * log_deviation, config.channels)

    def _coder(self, width_in: int, width_out: int, rngs: nnx.Rngs):
        config = self.config
        if config.encoder_decoder == "linear":
            return nnx.Linear(width_in, width_out, rngs=rngs)
        modes = min(config.num_kept_modes, count_modes("fourier", config.window + config.frames_before))
        return FNOBlock(
            width_in, width_out, modes, config.kernel_size, small_weights=config.small_spectral_weights, rngs=rngs
        )

    def _base_block(self, rngs: nnx.Rngs):
        config, width = self.config, self.config.latent_width
        if config.base_block == "transformer":
            hidden = config.feed_forward_factor * width
            return TransformerBlock(width, config.num_heads, hidden, config.dropout, rngs=rngs)
        return FNOBlock(
            width, width, config.num_kept_modes, config.kernel_size, variant=config.spectral_variant,
            rank=config.spectral_rank, initial_gain=config.initial_mode_gain,
            small_weights=config.small_spectral_weights, rngs=rngs,
        )  # fmt: skip

    def encode(self, condition: Condition) -> EncodedCondition:
        """Encode a condition once a round.

        Args:
          condition: history [B, H, C], path [B, T, 8], style [B, S], normalised units.

        Returns:
          What `__call__` takes as `context`.

        Raises:
          ValueError: if a shape does not fit the config.
        """
        self.config.check_condition(condition)
        turn = None
        if self.config.facing_frame:
            condition, turn = _facing_forward(condition)
        tokens = self.condition.encode(condition)
        return EncodedCondition(tokens, condition.history, condition.path, turn)

    def _with_history(self, z, context: EncodedCondition):
        """Lay the history before the scaled noisy window and the path beside it, [B, H + T, .]."""
        past, future = context.history, context.path
        unknown = jnp.zeros((*past.shape[:2], PATH_CHANNELS), z.dtype)
        given, noisy = jnp.ones((*past.shape[:2], 1), z.dtype), jnp.zeros((*z.shape[:2], 1), z.dtype)
        before, window = (jnp.concatenate(row, axis=-1) for row in ([past, unknown, given], [z, future, noisy]))
        return jnp.concatenate([before, window], axis=1)

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
        level = sigma.reshape(-1, 1, 1)
        c = self.condition(context.tokens, sigma)
        yield "c", c
        if config.facing_frame:
            x_noisy = _turned_frames(x_noisy, context.turn)
        z = scaled_input(config, x_noisy, sigma)
        if config.history_input:
            z = self._with_history(z, context)
        if config.coordinate_channel:
            place = jnp.linspace(0.0, 1.0, z.shape[1], dtype=z.dtype)[:, None]
            z = jnp.concatenate([z, jnp.broadcast_to(place, (*z.shape[:2], 1))], axis=-1)
        # Fourier blocks are faster with frames first, and so from encoder to decoder; attention
        # wants the batch first.
        attends = config.conditioning == "cross_attention"
        turned = not attends and all(isinstance(block, FrameLayer) for block in self.blocks)
        turn = frames_first if turned else lambda array: array
        z, c, frames = turn(z), turn(c), 0 if turned else 1
        if config.encoder_hidden_width:
            z = nnx.gelu(_applied(self.encoder_hidden, turned)(z))
        z = encoded = _applied(self.encoder, turned)(z)
        yield "encoder", turn(z)
        if config.conditioning == "concatenation":
            z = jnp.concatenate([c, z], axis=frames)
        if config.base_block == "transformer":
            # Attention has no sense of order of its own (section 3.4.1).
            z = z + jnp.asarray(position_code(0, config.block_frames, z.shape[-1]), z.dtype)
        for number, (block, conditioning) in enumerate(zip(self.blocks, self.conditionings, strict=True)):
            base = _applied(block, turned)
            if key is not None and not turned:
                base = partial(base, key=jax.random.fold_in(key, number))
            if config.pre_norm:
                base = _after_norm(base)
            update = conditioning(base, z, c)
            z = z + update if config.block_residual or config.block_bypass else update
            yield f"block {number + 1}", turn(z)
        # Frames of c go before the decoder; those of the history hold its period together.
        decoded = config.window + config.frames_before
        last = jax.lax.slice_in_dim(z, z.shape[frames] - decoded, z.shape[frames], axis=frames)
        if config.encoder_skip:
            last = last + encoded
        if config.decoder_hidden_width:
            last = nnx.gelu(_applied(self.decoder_hidden, turned)(last))
        x0_hat = turn(_applied(self.decoder, turned)(last))[:, config.frames_before :]
        yield "decoder", x0_hat
        if config.output_scaling:
            total = level**2 + config.sigma_data**2
            c_skip, c_out = config.sigma_data**2 / total, level * config.sigma_data / jnp.sqrt(total)
            x0_hat = c_skip * x_noisy + c_out * x0_hat
        if config.history_anchor:
            x0_hat = x0_hat + self.anchor[...] * context.history[:, -1:]
        if config.residual_prior:
            basis = jnp.asarray(cosine_basis(config.window), x_noisy.dtype)
            variance = jnp.exp(10.0 * self.residual_variance[...])
            gain = variance / (variance + level**2)
            residual = jnp.einsum("kt,btc->bkc", basis, x_noisy - x0_hat)
            x0_hat = x0_hat + jnp.einsum("kt,bkc->btc", basis, gain * residual)
        if config.facing_frame:
            x0_hat = _turned_frames(x0_hat, jnp.swapaxes(context.turn, -1, -2))
        yield "x0_hat", x0_hat
