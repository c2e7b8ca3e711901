"""CAMDM, the baseline: a Transformer that reads conditions and noisy frames as one sequence.

    [noise level, style, path, history, noisy future] -> N x Transformer block -> last T -> x0_hat

F3AMD describes it in sections 2.1, 4.5 and 6 (after Chen et al. 2024); where it is silent the
values are those of CAMDM's released code. Like every denoiser here it takes the variance-exploding
state; times c_in with sigma_data = 1 that is the variance-preserving state it is trained on.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from f3amd_lib.networks.attention import TransformerBlock, check_num_heads, dropout, position_code, sinusoids
from f3amd_lib.networks.conditioning import Condition, ConditionedConfig, noise_features
from f3amd_lib.networks.config import DenoisingNetwork, scaled_input

POSITION_BASE = 10_000.0
"""Base of the sinusoids, as in Vaswani et al. 2017: sequences are long here."""


@dataclass(frozen=True, kw_only=True)
class CAMDMConfig(ConditionedConfig):
    """Everything that decides a CAMDM network's shape and formulas.

    Attributes:
      num_heads: attention heads; not in the paper, 4 as in CAMDM's code.
      feed_forward_factor: hidden width over D; not in the paper, 4 as in CAMDM's code.
      split_path: give displacement and facing of the path a token each, as CAMDM's code does
        (2 + 3T + H tokens); else one token a frame, as F3AMD's section 6 counts (2 + 2T + H).
      noise_levels: sigma of the diffusion steps 0 .. K - 1, rising; the network's input is the
        step's number. Empty: it is sigma, as in F3AMD (for training with a continuous schedule).

    Raises:
      ValueError: for sizes that are not positive, or heads that do not divide the width.
    """

    family: ClassVar[str] = "CAMDM"

    latent_width: int = 256
    depth: int = 4
    num_heads: int = 4
    feed_forward_factor: int = 4
    split_path: bool = False
    noise_levels: tuple[float, ...] = ()

    def __post_init__(self):
        super().__post_init__()
        check_num_heads(self.latent_width, self.num_heads)
        object.__setattr__(self, "noise_levels", tuple(map(float, self.noise_levels)))  # JSON has a list

    @property
    def num_tokens(self) -> int:
        """Length of the sequence that the Transformer reads."""
        path = 2 if self.split_path else 1
        return 2 + path * self.window + self.num_history + self.window


class CAMDM(DenoisingNetwork):
    """Denoiser of Chen et al. 2024: conditions are tokens before the noisy frames."""

    def __init__(self, config: CAMDMConfig, *, rngs: nnx.Rngs):
        self.config = config
        width = config.latent_width
        self.noise_first = nnx.Linear(width, width, rngs=rngs)
        self.noise_second = nnx.Linear(width, width, rngs=rngs)
        # A table of one row a style; rows of deviation 1, as torch's embedding starts.
        rows = nnx.initializers.normal(1.0)
        self.style = nnx.Linear(config.num_styles, width, use_bias=False, kernel_init=rows, rngs=rngs)
        # Displacement x, z, then yaw in 6D.
        widths = (2, 6) if config.split_path else (8,)
        self.path = nnx.List([nnx.Linear(part, width, rngs=rngs) for part in widths])
        self.history = nnx.Linear(config.channels, width, rngs=rngs)
        self.future = nnx.Linear(config.channels, width, rngs=rngs)
        hidden = config.feed_forward_factor * width
        block = lambda: TransformerBlock(width, config.num_heads, hidden, config.dropout, rngs=rngs)
        self.blocks = nnx.List([block() for _ in range(config.depth)])
        self.output = nnx.Linear(width, config.channels, rngs=rngs)

    def _position_code(self, dtype):
        code = position_code(0, self.config.num_tokens, self.config.latent_width, base=POSITION_BASE)
        return jnp.asarray(code, dtype)

    def encode(self, condition: Condition) -> jax.Array:
        """Encode a condition once a round.

        Args:
          condition: history [B, H, C], path [B, T, 8], style [B, S], normalised units.

        Returns:
          The tokens between noise level and noisy frames, [B, num_tokens - T - 1, D].

        Raises:
          ValueError: if a shape does not fit the config.
        """
        config = self.config
        config.check_condition(condition)
        path = condition.path
        parts = (path[..., :2], path[..., 2:]) if config.split_path else (path,)
        paths = [layer(part) for layer, part in zip(self.path, parts, strict=True)]
        style, history = self.style(condition.style)[:, None, :], self.history(condition.history)
        tokens = jnp.concatenate([style, *paths, history], axis=1)
        return tokens + self._position_code(tokens.dtype)[1 : 1 + tokens.shape[1]]

    def _noise_token(self, sigma, dtype):
        config, width = self.config, self.config.latent_width
        if config.noise_levels:
            # Levels passed count 1 each, the one under way its share: linear between the levels,
            # and without the search of `jnp.interp`, a loop that exports must not have.
            known = np.log(config.noise_levels)
            share = (jnp.log(sigma)[..., None] - known[:-1]) / np.diff(known)
            steps = jnp.clip(share, 0.0, 1.0).sum(axis=-1).astype(dtype)
            # A whole step has its row of `position_code`, a level between two steps lies between.
            features = sinusoids(steps, width, POSITION_BASE)
        else:
            features = noise_features(sigma, width)
        return self.noise_second(nnx.silu(self.noise_first(features)))

    def stages(self, x_noisy, sigma, context, key=None) -> Iterator[tuple[str, jax.Array]]:
        """Yield the name and value of every station from x_noisy to x0_hat.

        Args:
          x_noisy, sigma, context, key: as in `__call__`.

        Yields:
          "tokens" [B, num_tokens, D], "block 1" ..., and last "x0_hat" [B, T, C].
        """
        config = self.config
        config.check_state(x_noisy)
        sigma = jnp.broadcast_to(jnp.asarray(sigma, x_noisy.dtype), x_noisy.shape[:1])
        code = self._position_code(x_noisy.dtype)
        noise = self._noise_token(sigma, x_noisy.dtype)[:, None, :] + code[:1]
        future = self.future(scaled_input(config, x_noisy, sigma)) + code[-config.window :]
        z = jnp.concatenate([noise, context, future], axis=1)
        z = dropout(z, config.dropout, None if key is None else jax.random.fold_in(key, config.depth))
        yield "tokens", z
        for number, block in enumerate(self.blocks):
            z = block(z, key=None if key is None else jax.random.fold_in(key, number))
            yield f"block {number + 1}", z
        yield "x0_hat", self.output(z[:, -config.window :])
