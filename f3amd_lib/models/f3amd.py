"""The F3AMD network (paper section 3.4, Figure 2).

    x_noisy -> FNO encoder -> N x (FNO block -> FiLM) -> FNO decoder -> x0_hat

Where the paper is silent the filling is a field of `F3AMDConfig`: each reading is one value.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from f3amd_lib.models.conditioning import Condition, ConditionEncoder, Context, FiLM
from f3amd_lib.models.spectral import FNOBlock
from f3amd_lib.names import refuse_unknown

__all__ = ["F3AMDConfig", "F3AMD"]


@dataclass(frozen=True)
class F3AMDConfig:
    """Everything that decides an F3AMD network's shape and formulas.

    Attributes:
      channels: C, features a frame (6 J + 3).
      num_styles: S, width of the one-hot style.
      window: T, future frames a round makes (32 or 64).
      num_history: H, past frames seen (section 4.5: 10).
      latent_width: D (section 4.2).
      depth: N, backbone blocks (section 4.5).
      num_kept_modes: m, RFFT bins kept (section 4.5: 17 of 17, or 33 of 33 with 64 frames).
      kernel_size: k of Eq. 3; not in the paper, 3 here.
      num_condition_heads: heads of the cross-attention to c; not in the paper, 1 here.
      input_scaling: multiply the noisy input by c_in = 1 / sqrt(sigma^2 + sigma_data^2); the paper
        does not say. Without it the first layer meets numbers up to sigma_max = 128.
      normalise: features have mean 0 and deviation 1 per channel; the paper does not say.
      sigma_data: deviation of the clean features in network units.
      block_residual: add each block's input to its output (ours; the paper's Figure 2 has none).
      history_anchor: add the last history frame, with a learned weight that starts as a decay over
        the window, so that the network predicts a change (ours).
      residual_prior: combine the network's estimate with the noisy input as the posterior mean of a
        Gaussian residual whose variance per channel and cosine mode is learned (ours).

    Raises:
      ValueError: for sizes that are not positive or modes out of range.
    """

    channels: int
    num_styles: int
    window: int = 32
    num_history: int = 10
    latent_width: int = 96
    depth: int = 6
    num_kept_modes: int = 17
    kernel_size: int = 3
    num_condition_heads: int = 1
    input_scaling: bool = True
    normalise: bool = True
    sigma_data: float = 1.0
    block_residual: bool = False
    history_anchor: bool = False
    residual_prior: bool = False

    def __post_init__(self):
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            wanted = {"int": int, "float": float, "bool": bool}[str(field.type)]
            if wanted is float and type(value) is int:
                object.__setattr__(self, field.name, float(value))
            elif type(value) is not wanted:
                raise ValueError(f"{field.name} must be of type {field.type}, got {value!r}")
            if wanted is not bool and not 0 < value < float("inf"):
                raise ValueError(f"{field.name} must be positive and finite, got {value!r}")
        if self.window < 2:
            raise ValueError(f"window must be at least 2 frames, got {self.window}")
        if self.num_kept_modes > self.window // 2 + 1:
            raise ValueError(
                f"num_kept_modes must be at most {self.window // 2 + 1} for a window of "
                f"{self.window} frames, got {self.num_kept_modes}"
            )

    def to_dict(self) -> dict:
        """Return the fields as JSON-ready values."""
        return dataclasses.asdict(self)

    @classmethod
    def from_dict(cls, values: dict) -> F3AMDConfig:
        """Build a config from `to_dict`; an unknown key is an error that names the nearest."""
        refuse_unknown(values, cls, "model setting")
        missing = {"channels", "num_styles"} - values.keys()
        if missing:
            raise ValueError(f"model settings lack {', '.join(sorted(missing))}")
        return cls(**values)


def cosine_basis(num_frames: int) -> np.ndarray:
    """Return the orthonormal DCT-II matrix, [mode, frame]."""
    frame = (np.arange(num_frames) + 0.5) / num_frames
    basis = np.cos(np.pi * np.arange(num_frames)[:, None] * frame[None, :])
    basis *= np.sqrt(2.0 / num_frames)
    basis[0] /= np.sqrt(2.0)
    return basis


class F3AMD(nnx.Module):
    """Denoiser G of Eq. 1: noisy features, noise level and context in, clean features out."""

    def __init__(self, config: F3AMDConfig, *, rngs: nnx.Rngs):
        self.config = config
        width, modes = config.latent_width, config.num_kept_modes
        self.condition = ConditionEncoder(
            config.channels,
            config.num_styles,
            width,
            config.window,
            config.num_history,
            config.num_condition_heads,
            rngs=rngs,
        )
        kernel = config.kernel_size
        self.encoder = FNOBlock(config.channels, width, modes, kernel, rngs=rngs)
        self.blocks = nnx.List(
            [FNOBlock(width, width, modes, kernel, rngs=rngs) for _ in range(config.depth)]
        )
        self.films = nnx.List(
            [
                FiLM(width, width, zero_output=config.block_residual, rngs=rngs)
                for _ in range(config.depth)
            ]
        )
        self.decoder = FNOBlock(width, config.channels, modes, kernel, rngs=rngs)
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

    def encode(self, condition: Condition) -> Context | tuple:
        """Encode a condition once a round.

        Args:
          condition: history [B, H, C], path [B, T, 8], style [B, S], normalised units.

        Returns:
          What `__call__` takes as `context`.

        Raises:
          ValueError: if a shape does not fit the config.
        """
        config, batch = self.config, condition.history.shape[0]
        expected = Condition(
            (batch, config.num_history, config.channels),
            (batch, config.window, 8),
            (batch, config.num_styles),
        )
        for name, array, shape in zip(Condition._fields, condition, expected, strict=True):
            if array.shape != shape:
                raise ValueError(f"condition {name} must have shape {shape}, got {array.shape}")
        return self.condition.encode(condition), condition.history[:, -1]

    def __call__(self, x_noisy, sigma, context):
        """Estimate the clean features.

        Args:
          x_noisy: variance-exploding state, [B, T, C].
          sigma: noise level, [B] or scalar, > 0.
          context: from `encode`.

        Returns:
          x0_hat, [B, T, C].
        """
        config = self.config
        if x_noisy.shape[1:] != (config.window, config.channels):
            raise ValueError(
                f"x_noisy must be [B, {config.window}, {config.channels}], got {x_noisy.shape}"
            )
        tokens, last_frame = context
        sigma = jnp.broadcast_to(jnp.asarray(sigma, x_noisy.dtype), x_noisy.shape[:1])
        c = self.condition(tokens, sigma)
        level = sigma[:, None, None]
        scaled = x_noisy
        if config.input_scaling:
            scaled = x_noisy * jax.lax.rsqrt(level**2 + config.sigma_data**2)
        z = self.encoder(scaled)
        for block, film in zip(self.blocks, self.films, strict=True):
            update = film(block(z), c)
            z = z + update if config.block_residual else update
        x0_hat = self.decoder(z)
        if config.history_anchor:
            x0_hat = x0_hat + self.anchor[...] * last_frame[:, None, :]
        if config.residual_prior:
            basis = jnp.asarray(cosine_basis(config.window), x_noisy.dtype)
            variance = jnp.exp(10.0 * self.residual_variance[...])
            gain = variance / (variance + level**2)
            residual = jnp.einsum("kt,btc->bkc", basis, x_noisy - x0_hat)
            x0_hat = x0_hat + jnp.einsum("kt,bkc->btc", basis, gain * residual)
        return x0_hat
