"""Conditions (sections 3.3, 3.4.3, Table 11).

Context tokens and noise embedding become the conditioning signal c by cross-attention; then c
enters every backbone block, by FiLM or by one of the three ways that the paper compares with it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from f3amd_lib.ground.names import check_known
from f3amd_lib.networks.attention import MultiHeadAttention, attend, position_code
from f3amd_lib.networks.config import NetworkConfig

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


@dataclass(frozen=True, kw_only=True)
class ConditionedConfig(NetworkConfig):
    """Config of a network that history, path and style guide (F3AMD and CAMDM).

    Attributes:
      num_styles: S, width of the one-hot style.
      num_history: H, past frames seen (section 4.5: 10).
    """

    from_data: ClassVar[tuple[str, ...]] = ("channels", "num_styles")
    frames_before: ClassVar[int] = 0
    """Frames of history that a network's blocks see before the window; `variants` has some."""

    num_styles: int
    num_history: int = 10

    def condition_shapes(self, batch: int) -> Condition:
        """Return the shapes of the condition of some characters."""
        shapes = (self.num_history, self.channels), (self.window, PATH_CHANNELS), (self.num_styles,)
        return Condition(*(jax.ShapeDtypeStruct((batch, *shape), jnp.float32) for shape in shapes))

    def check_condition(self, condition: Condition) -> None:
        """Raise ValueError unless history, path and style fit the config, with as many rows."""
        expected = self.condition_shapes(condition.history.shape[0])
        for name, found, wanted in zip(Condition._fields, condition, expected, strict=True):
            if found.shape != wanted.shape:
                raise ValueError(f"condition {name} must have shape {wanted.shape}, got {found.shape}")


class Context(NamedTuple):
    """An encoded condition: keys and values of the context tokens, [B, H + T + 1, D] each.

    It does not depend on the noise level, so that a round encodes it once for all its steps.
    """

    keys: jax.Array
    values: jax.Array


def noise_features(sigma, width: int):
    """Embed noise levels as random Fourier features of log(sigma) / 4.

    Args:
      sigma: noise levels, [...], > 0.
      width: number of features.

    Returns:
      [..., width], variance about 1.

    Source: phi of Eq. 1; Karras et al. 2024 (EDM2), section B.3.
    """
    fixed = np.random.default_rng(2024)  # the same frequencies and phases for every network
    frequency, phase = fixed.standard_normal(width), fixed.uniform(size=width)
    position = 0.25 * jnp.log(sigma)[..., None]
    angle = 2.0 * jnp.pi * (position * jnp.asarray(frequency, position.dtype) + phase)
    return (jnp.sqrt(2.0) * jnp.cos(angle)).astype(position.dtype)


class ConditionEncoder(nnx.Module):
    """Condition -> context tokens -> cross-attention -> c (section 3.3).

    History, path and style go through one linear layer each into tokens of one width; noise
    embeddings, broadcast over the window, ask them by cross-attention (one head unless told). The
    paper does not mention a position code; without one every frame would have the same query,
    and c would be constant over the window.

    Args:
      config: sizes; its latent width is that of tokens and c.
      num_heads: must divide that width.
    """

    def __init__(self, config: ConditionedConfig, num_heads: int = 1, *, rngs: nnx.Rngs):
        width = config.latent_width
        self.width, self.window, self.num_history = width, config.window, config.num_history
        self.frames_before, self.num_heads = config.frames_before, num_heads
        self.history = nnx.Linear(config.channels, width, rngs=rngs)
        self.path = nnx.Linear(PATH_CHANNELS, width, rngs=rngs)
        self.style = nnx.Linear(config.num_styles, width, rngs=rngs)
        self.noise_first, self.noise_second, self.query, self.key, self.value, self.output = (
            nnx.Linear(width, width, rngs=rngs) for _ in range(6)
        )

    def encode(self, condition: Condition) -> Context:
        """Turn a condition into keys and values; once a round."""
        dtype = condition.history.dtype
        past = jnp.asarray(position_code(-self.num_history, 0, self.width), dtype)
        future = jnp.asarray(position_code(0, self.window, self.width), dtype)
        history, path = self.history(condition.history) + past, self.path(condition.path) + future
        tokens = jnp.concatenate([history, path, self.style(condition.style)[:, None, :]], axis=1)
        return Context(self.key(tokens), self.value(tokens))

    def __call__(self, context: Context, sigma):
        """Return the conditioning signal c, [B, T, D], or [B, frames_before + T, D].

        Args:
          context: from `encode`.
          sigma: noise levels, [B] or scalar.
        """
        dtype = context.keys.dtype
        noise = noise_features(jnp.asarray(sigma, dtype), self.width)
        noise = self.noise_second(nnx.silu(self.noise_first(noise)))
        code = jnp.asarray(position_code(-self.frames_before, self.window, self.width), dtype)
        # One noise level for all characters asks one question for all of them.
        asked = noise[..., None, :] + code
        shape = (context.keys.shape[0], self.frames_before + self.window, self.width)
        query = jnp.broadcast_to(self.query(asked), shape)
        return asked + self.output(attend(query, context.keys, context.values, self.num_heads))


class FiLM(nnx.Module):
    """Feature-wise linear modulation with a bounded gate (Eqs 5-7)."""

    def __init__(self, width: int, condition_width: int, *, rngs: nnx.Rngs):
        self.modulation = nnx.Linear(condition_width, 2 * width, rngs=rngs)
        # Conv_1x1 of Eq. 7, here and below: a linear layer per frame.
        self.output = nnx.Linear(width, width, rngs=rngs)

    def modulate(self, z_base, c):
        """Modulate [B, T, D] by c [B, T, C_cond] (Eqs 5-7)."""
        gamma, beta = jnp.split(self.modulation(c), 2, axis=-1)  # Eq. 5
        z_tilde = z_base * (1.0 + jnp.tanh(gamma)) + beta  # Eq. 6
        return nnx.silu(self.output(z_tilde))  # Eq. 7

    def __call__(self, base, z, c):
        """Run the base block on z [B, T, D] and modulate the result by c [B, T, C_cond]."""
        return self.modulate(base(z), c)


class Concatenation(nnx.Module):
    """Condition and features in one sequence, as CAMDM concatenates its conditions in time.

    The network lays c before the features once, ahead of the first block, and drops its frames
    after the last: blocks run on 2 T frames, which agrees with the 2.05 times as long of Table 11.
    The base block brings both together, so that only the output layer of Eq. 7 is left here.
    """

    def __init__(self, width: int, condition_width=None, *, rngs: nnx.Rngs):
        self.output = nnx.Linear(width, width, rngs=rngs)

    def __call__(self, base, z, c):
        """Run the base block on z [B, 2 T, D], whose first T frames came from c; c is not read."""
        return nnx.silu(self.output(base(z)))


class AdaLNZero(nnx.Module):
    """Adaptive layer normalisation, which starts as the identity (Peebles and Xie 2023, DiT).

    The condition scales and shifts what the base block reads, and gates what it adds to its input.
    One modulation goes around the whole base block. DiT's SiLU before the linear layer is left out,
    as c enters by a linear layer alone in FiLM too (Eq. 5).
    """

    def __init__(self, width: int, condition_width: int, *, rngs: nnx.Rngs):
        zero = nnx.initializers.zeros_init()
        self.modulation = nnx.Linear(condition_width, 3 * width, kernel_init=zero, rngs=rngs)

    def __call__(self, base, z, c):
        """Add to z [B, T, D] what the base block makes of it under c [B, T, C_cond]."""
        shift, scale, gate = jnp.split(self.modulation(c), 3, axis=-1)
        normalised = jax.nn.standardize(z, axis=-1, epsilon=1e-6)
        return z + gate * base(normalised * (1.0 + scale) + shift)


class CrossAttention(nnx.Module):
    """Every frame attends to the frames of c; the answer is added, and the output layer of Eq. 7 follows.

    Questions carry a position code, as those of `ConditionEncoder` do: without one, a frame could
    not prefer its own part of c.
    """

    def __init__(self, width: int, condition_width: int, num_heads: int = 1, *, rngs: nnx.Rngs):
        self.attention = MultiHeadAttention(width, num_heads, condition_width, rngs=rngs)
        self.output = nnx.Linear(width, width, rngs=rngs)

    def __call__(self, base, z, c):
        """Run the base block on z [B, T, D], and let the result ask c [B, T, C_cond]."""
        z_base = base(z)
        code = jnp.asarray(position_code(0, *z_base.shape[1:]), z_base.dtype)
        z_tilde = z_base + self.attention(z_base + code, c)
        return nnx.silu(self.output(z_tilde))


CONDITIONINGS = {
    "film": FiLM, "concatenation": Concatenation, "adaln_zero": AdaLNZero, "cross_attention": CrossAttention,
}  # fmt: skip
"""The ways of Table 11 for c to enter a backbone block."""


def conditioning_layer(name: str, width: int, condition_width: int, *, num_heads: int = 1, rngs: nnx.Rngs):
    """Return a layer that brings c into a backbone block, called as layer(base, z, c).

    There `base` is the base block (a callable z -> z_base), z is [B, T, D] and c [B, T, C_cond].
    Except for AdaLN-zero all end with the output layer of Eq. 7, so that only the way in differs.

    Args:
      name: one of `CONDITIONINGS`.
      width: D.
      condition_width: C_cond; for "concatenation", D as well.
      num_heads: of "cross_attention".

    Raises:
      ValueError: for an unknown name, with the nearest.
    """
    check_known(name, CONDITIONINGS, "conditioning")
    own = {"num_heads": num_heads} if name == "cross_attention" else {}
    return CONDITIONINGS[name](width, condition_width, **own, rngs=rngs)
