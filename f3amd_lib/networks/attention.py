"""Attention and the Transformer encoder block (paper section 3.4.1; Vaswani et al. 2017)."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from f3amd_lib.ground.arrays import array_module


def sinusoids(place, width: int, base: float):
    """Return alternating sines and cosines of a place, [...] -> [..., width], at rates from 1 down to near 1 / base."""
    xp = array_module(place)
    rate = xp.exp(-xp.log(base) * xp.arange(0, width, 2) / width)
    angle = xp.asarray(place)[..., None] * rate
    paired = xp.stack([xp.sin(angle), xp.cos(angle)], axis=-1)
    return paired.reshape(*angle.shape[:-1], -1)[..., :width]


@functools.lru_cache(maxsize=64)
def position_code(first: int, last: int, width: int, base: float = 1000.0) -> np.ndarray:
    """Return sinusoidal codes of frames first .. last - 1.

    Future frames count from 0, history frames are negative, so that a query of frame t and the path
    token of frame t carry the same code.

    Args:
      first, last: range of frames, last excluded.
      width: length of a code.
      base: the slowest sinusoid turns about `base` times slower than the fastest. Vaswani et al.
        2017 have 10,000; windows are short.

    Returns:
      [last - first, width], float64, read-only (it is cached).
    """
    code = sinusoids(np.arange(first, last), width, base)
    code.setflags(write=False)
    return code


def dropout(x, rate: float, key):
    """Set a random share of numbers to zero and enlarge the others, so that the mean stays.

    Args:
      x: any shape.
      rate: the share, 0 <= rate < 1.
      key: random key, in training; without one nothing is dropped.

    Returns:
      Like x.
    """
    if key is None or rate == 0.0:
        return x
    kept = jax.random.bernoulli(key, 1.0 - rate, x.shape)
    return jnp.where(kept, x / (1.0 - rate), 0.0)


def check_num_heads(width: int, num_heads: int) -> None:
    """Raise ValueError unless the number of heads divides the width."""
    if num_heads < 1 or width % num_heads:
        raise ValueError(f"num_heads must divide the width {width}, got {num_heads}")


def attention_weights(query, key, mask=None):
    """Return how much each query takes from each key, softmax(Q K^T / sqrt(width per head)).

    Args:
      query: [B, T, heads, width per head].
      key: [B, S, heads, width per head].
      mask: keys that may be seen, [B, S]; all by default.

    Returns:
      [B, heads, T, S]; the last axis sums to 1.
    """
    scores = jnp.einsum("bthd,bshd->bhts", query, key) / np.sqrt(query.shape[-1])
    if mask is not None:
        scores = jnp.where(mask[:, None, None, :], scores, -jnp.inf)
    return jax.nn.softmax(scores, axis=-1)


def attention(query, key, value, *, mask=None, dropout_rate: float = 0.0, dropout_key=None):
    """Return the values, averaged by the attention weights of each query.

    Args:
      query: [B, T, heads, width per head].
      key, value: [B, S, heads, width per head].
      mask: keys that may be seen, [B, S], one at least; all by default.
      dropout_rate: share of the weights that is dropped, if there is a `dropout_key`.
      dropout_key: random key, in training; without one nothing is dropped.

    Returns:
      [B, T, heads, width per head].

    Source: Vaswani et al. 2017, section 3.2.1.
    """
    if dropout_key is None:
        return jax.nn.dot_product_attention(query, key, value, mask=None if mask is None else mask[:, None, None, :])
    weights = dropout(attention_weights(query, key, mask), dropout_rate, dropout_key)
    return jnp.einsum("bhts,bshd->bthd", weights, value)


def attend(query, key, value, num_heads: int, **options):
    """Let several heads attend side by side, each to its own neighbouring channels.

    Args:
      query: [B, T, D].
      key, value: [B, S, D].
      num_heads: must divide D.
      **options: mask, dropout_rate and dropout_key, of `attention`.

    Returns:
      [B, T, D].
    """
    heads = (z.reshape(*z.shape[:-1], num_heads, -1) for z in (query, key, value))
    return attention(*heads, **options).reshape(query.shape)


class MultiHeadAttention(nnx.Module):
    """Attention between linear layers, several heads side by side (Vaswani et al. 2017, 3.2.2).

    Args:
      width: D, of the asking sequence and the result.
      num_heads: must divide D.
      answering_width: of the answering sequence; D by default.

    Raises:
      ValueError: if the number of heads does not divide D.
    """

    def __init__(self, width: int, num_heads: int, answering_width: int | None = None, *, rngs: nnx.Rngs):
        check_num_heads(width, num_heads)
        answering_width = answering_width or width
        self.num_heads = num_heads
        self.query = nnx.Linear(width, width, rngs=rngs)
        self.key = nnx.Linear(answering_width, width, rngs=rngs)
        self.value = nnx.Linear(answering_width, width, rngs=rngs)
        self.output = nnx.Linear(width, width, rngs=rngs)

    def __call__(self, asking, answering=None, **options):
        """Let every frame of one sequence attend to all frames of another, or of its own.

        Args:
          asking: [B, T, D].
          answering: [B, S, answering_width]; `asking` itself by default.
          **options: mask, dropout_rate and dropout_key, of `attention`.

        Returns:
          [B, T, D].
        """
        answering = asking if answering is None else answering
        key, value = self.key(answering), self.value(answering)
        return self.output(attend(self.query(asking), key, value, self.num_heads, **options))


class TransformerBlock(nnx.Module):
    """Encoder block: self-attention, then two layers, each added to its input and normalised.

    Layer normalisation comes last (post-norm), and its epsilon is PyTorch's. Attention has no sense
    of order of its own: add a `position_code` before the first block.

    Args:
      width: D.
      num_heads: must divide D (Appendix A).
      hidden_width: between the two layers.
      dropout: rate after attention, inside and after the two layers, and of the attention weights.
      crossing: after its own sequence the block asks another one, `memory` (a decoder's block).

    Raises:
      ValueError: if the number of heads does not divide D.

    Source: section 3.4.1; Vaswani et al. 2017, section 3.
    """

    def __init__(
        self, width: int, num_heads: int, hidden_width: int, dropout: float = 0.0, *, crossing: bool = False, rngs
    ):
        self.dropout = dropout
        self.attention = MultiHeadAttention(width, num_heads, rngs=rngs)
        self.attention_norm = nnx.LayerNorm(width, epsilon=1e-5, rngs=rngs)
        if crossing:
            self.crossing = MultiHeadAttention(width, num_heads, rngs=rngs)
            self.crossing_norm = nnx.LayerNorm(width, epsilon=1e-5, rngs=rngs)
        self.hidden = nnx.Linear(width, hidden_width, rngs=rngs)
        self.output = nnx.Linear(hidden_width, width, rngs=rngs)
        self.output_norm = nnx.LayerNorm(width, epsilon=1e-5, rngs=rngs)

    def __call__(self, z, key=None, mask=None, memory=None):
        """Map [B, T, D] to [B, T, D].

        Args:
          z: [B, T, D].
          key: random key for dropout, in training; without one nothing is dropped.
          mask: frames that may be seen, [B, T], one at least; all by default.
          memory: the sequence that a crossing block attends to, [B, S, D].
        """
        keys = [None] * 4 if key is None else jax.random.split(key, 4)
        answer = self.attention(z, mask=mask, dropout_rate=self.dropout, dropout_key=keys[0])
        z = self.attention_norm(z + dropout(answer, self.dropout, keys[1]))
        if memory is not None:
            inside, after = [None] * 2 if key is None else jax.random.split(jax.random.fold_in(key, 4))
            answer = self.crossing(z, memory, dropout_rate=self.dropout, dropout_key=inside)
            z = self.crossing_norm(z + dropout(answer, self.dropout, after))
        # PyTorch's GELU is the exact one; JAX's default is an approximation by tanh.
        hidden = dropout(jax.nn.gelu(self.hidden(z), approximate=False), self.dropout, keys[2])
        return self.output_norm(z + dropout(self.output(hidden), self.dropout, keys[3]))
