"""Conditions: context tokens, noise embedding, cross-attention to c, FiLM (sections 3.3, 3.4.3)."""

from __future__ import annotations

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

__all__ = [
    "Condition",
    "Context",
    "noise_features",
    "position_code",
    "ConditionEncoder",
    "FiLM",
]

PATH_CHANNELS = 8
"""2D displacement (x, z) and yaw in 6D, per future frame (section 3.3)."""


class Condition(NamedTuple):
    """What guides one window (section 3.3), all in normalised units.

    Attributes:
      history: past motion features, [B, H, C].
      path: future root path, [B, T, 8]: displacement x, z and yaw in 6D.
      style: one-hot (or a blend), [B, S].
    """

    history: jax.Array
    path: jax.Array
    style: jax.Array


class Context(NamedTuple):
    """An encoded condition: keys and values of the context tokens, [B, H + T + 1, D] each.

    It does not depend on the noise level, so that a round encodes it once for all its steps.
    """

    keys: jax.Array
    values: jax.Array


@functools.lru_cache(maxsize=32)
def _noise_frequencies(width: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the fixed random frequencies and phases of Karras et al. 2024, from a fixed seed."""
    generator = np.random.default_rng(2024)
    return generator.standard_normal(width), generator.uniform(size=width)


def noise_features(sigma, width: int):
    """Embed noise levels as random Fourier features of log(sigma) / 4.

    Args:
      sigma: noise levels, [...], > 0.
      width: number of features.

    Returns:
      [..., width], variance about 1.

    Source: phi of Eq. 1; Karras et al. 2024 (EDM2), section B.3.
    """
    frequency, phase = _noise_frequencies(width)
    position = 0.25 * jnp.log(sigma)[..., None]
    angle = 2.0 * jnp.pi * (position * jnp.asarray(frequency, position.dtype) + phase)
    return (jnp.sqrt(2.0) * jnp.cos(angle)).astype(position.dtype)


@functools.lru_cache(maxsize=64)
def position_code(first: int, last: int, width: int) -> np.ndarray:
    """Return sinusoidal codes of frames first .. last - 1, [last - first, width].

    After Vaswani et al. 2017, with a base of 1,000 for their 10,000: windows are short.
    Future frames count from 0, history frames are negative, so that a query of frame t and the path
    token of frame t carry the same code.
    """
    frame = np.arange(first, last)[:, None]
    rate = np.exp(-np.log(1000.0) * np.arange(0, width, 2) / width)[None, :]
    code = np.zeros((last - first, width))
    code[:, 0::2] = np.sin(frame * rate)
    code[:, 1::2] = np.cos(frame * rate)[:, : width // 2]
    code.setflags(write=False)  # cached, and so shared by all callers
    return code


class ConditionEncoder(nnx.Module):
    """Condition -> context tokens -> cross-attention -> c (section 3.3).

    History, path and style go through one linear layer each into tokens of one width; noise
    embeddings, broadcast over the window, ask them by cross-attention (one head unless told). The
    paper does not mention a position code; without one every frame would ask the same question,
    and c would be constant over the window.
    """

    def __init__(
        self,
        channels: int,
        num_styles: int,
        width: int,
        window: int,
        num_history: int,
        num_heads: int = 1,
        *,
        rngs: nnx.Rngs,
    ):
        if num_heads < 1 or width % num_heads:
            raise ValueError(f"num_heads must divide the width {width}, got {num_heads}")
        self.width, self.window, self.num_history = width, window, num_history
        self.num_heads = num_heads
        self.history = nnx.Linear(channels, width, rngs=rngs)
        self.path = nnx.Linear(PATH_CHANNELS, width, rngs=rngs)
        self.style = nnx.Linear(num_styles, width, rngs=rngs)
        self.noise_first = nnx.Linear(width, width, rngs=rngs)
        self.noise_second = nnx.Linear(width, width, rngs=rngs)
        self.query = nnx.Linear(width, width, rngs=rngs)
        self.key = nnx.Linear(width, width, rngs=rngs)
        self.value = nnx.Linear(width, width, rngs=rngs)
        self.output = nnx.Linear(width, width, rngs=rngs)

    def encode(self, condition: Condition) -> Context:
        """Turn a condition into keys and values; once a round."""
        dtype = condition.history.dtype
        past = jnp.asarray(position_code(-self.num_history, 0, self.width), dtype)
        future = jnp.asarray(position_code(0, self.window, self.width), dtype)
        tokens = jnp.concatenate(
            [
                self.history(condition.history) + past,
                self.path(condition.path) + future,
                self.style(condition.style)[:, None, :],
            ],
            axis=1,
        )
        return Context(self.key(tokens), self.value(tokens))

    def __call__(self, context: Context, sigma):
        """Return the conditioning signal c, [B, T, D].

        Args:
          context: from `encode`.
          sigma: noise levels, [B] or scalar.
        """
        dtype = context.keys.dtype
        noise = noise_features(jnp.asarray(sigma, dtype), self.width)
        noise = self.noise_second(nnx.silu(self.noise_first(noise)))
        code = jnp.asarray(position_code(0, self.window, self.width), dtype)
        asked = noise[..., None, :] + code
        asked = jnp.broadcast_to(asked, (context.keys.shape[0], self.window, self.width))

        def heads(array):
            return array.reshape(*array.shape[:2], self.num_heads, self.width // self.num_heads)

        answer = jax.nn.dot_product_attention(
            heads(self.query(asked)), heads(context.keys), heads(context.values)
        )
        return asked + self.output(answer.reshape(asked.shape))


class FiLM(nnx.Module):
    """Feature-wise linear modulation with a bounded gate (Eqs 5-7)."""

    def __init__(
        self, width: int, condition_width: int, *, zero_output: bool = False, rngs: nnx.Rngs
    ):
        # A convolution of kernel 1 is a linear layer per frame.
        self.modulation = nnx.Linear(condition_width, 2 * width, rngs=rngs)
        # Zero at the start makes a residual block the identity, so that depth costs nothing.
        initial = {"kernel_init": nnx.initializers.zeros_init()} if zero_output else {}
        self.output = nnx.Linear(width, width, rngs=rngs, **initial)

    def __call__(self, z_base, c):
        """Modulate [B, T, D] by c [B, T, C_cond]."""
        gamma, beta = jnp.split(self.modulation(c), 2, axis=-1)  # Eq. 5
        z_tilde = z_base * (1.0 + jnp.tanh(gamma)) + beta  # Eq. 6
        return nnx.silu(self.output(z_tilde))  # Eq. 7
