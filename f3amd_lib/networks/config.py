"""What all denoisers have in common: checked configs that survive JSON, and one way to be called."""

from __future__ import annotations

import dataclasses
import functools
from dataclasses import dataclass
from typing import ClassVar

import jax
from flax import nnx

from f3amd_lib.ground.names import checked_value, refuse_unknown


@dataclass(frozen=True, kw_only=True)
class CheckedConfig:
    """A config that refuses what makes no sense and survives JSON: fields, and what they may be.

    Raises:
      ValueError: for a value of the wrong type, a number that is not positive, an unknown choice, a dropout of all.
    """

    family: ClassVar[str] = ""
    choices: ClassVar[dict[str, tuple[str, ...]]] = {}
    """For each field that names a variant: the names there are."""

    may_be_zero: ClassVar[tuple[str, ...]] = ()
    from_data: ClassVar[tuple[str, ...]] = ()
    """Fields that the data decide, not the model."""

    def __post_init__(self):
        for field in dataclasses.fields(self):
            rule = self.choices.get(field.name, "0 or more" if field.name in self.may_be_zero else "above 0")
            object.__setattr__(self, field.name, checked_value(field.name, getattr(self, field.name), field.type, rule))
        if getattr(self, "dropout", 0.0) >= 1.0:
            raise ValueError(f"dropout must be below 1, got {self.dropout}")

    def to_dict(self) -> dict:
        """Return the family's name and the fields as JSON-ready values."""
        return {"family": self.family, **dataclasses.asdict(self)}

    @classmethod
    def from_dict(cls, values: dict) -> CheckedConfig:
        """Build a config from `to_dict`; an unknown key is an error that names the nearest."""
        values = dict(values)
        family = values.pop("family", cls.family)
        if family != cls.family:
            raise ValueError(f"settings of family {family!r} do not make a {cls.family} network")
        refuse_unknown(values, cls, "model setting")
        needed = {field.name for field in dataclasses.fields(cls) if field.default is dataclasses.MISSING}
        if missing := needed - values.keys():
            raise ValueError(f"model settings lack {', '.join(sorted(missing))}")
        return cls(**values)


@dataclass(frozen=True, kw_only=True)
class NetworkConfig(CheckedConfig):
    """What decides the shape of a denoiser of windows, of any family.

    A family adds its own fields and checks, and `condition_shapes(batch)`: what `encode` takes, any
    tree, with a `jax.ShapeDtypeStruct` for each array.

    Attributes:
      channels: C, features a frame (6 J + 3).
      window: T, future frames a round makes (32 or 64).
      latent_width: D (section 4.2).
      depth: N, blocks (section 4.5).
      input_scaling: multiply the noisy input by c_in = 1 / sqrt(sigma^2 + sigma_data^2); the paper
        does not say. Without it the first layer meets numbers up to sigma_max = 128. With
        sigma_data = 1 the scaled input is the variance-preserving state.
      normalise: features have mean 0 and deviation 1 per channel; the paper does not say.
      sigma_data: deviation of the clean features in network units.
      dropout: share of numbers that Transformer blocks drop in training; not in the paper, 0 here.

    Raises:
      ValueError: as `CheckedConfig`, and for a window of less than 2 frames.
    """

    may_be_zero: ClassVar[tuple[str, ...]] = ("dropout",)

    channels: int
    window: int = 32
    latent_width: int = 96
    depth: int = 6
    input_scaling: bool = True
    normalise: bool = True
    sigma_data: float = 1.0
    dropout: float = 0.0

    def __post_init__(self):
        super().__post_init__()
        if self.window < 2:
            raise ValueError(f"window must be at least 2 frames, got {self.window}")

    def state_shape(self, batch: int) -> tuple[int, ...]:
        """Return the shape of a noisy state, [B, T, C]."""
        return batch, self.window, self.channels

    def check_state(self, x_noisy) -> None:
        """Raise ValueError unless a noisy state is [B, T, C] of this config."""
        if x_noisy.ndim != 3 or x_noisy.shape[1:] != (self.window, self.channels):
            raise ValueError(f"x_noisy must be [B, {self.window}, {self.channels}], got {x_noisy.shape}")


def scaled_input(config: NetworkConfig, x_noisy, sigma):
    """Return what the first layer sees: the state, times c_in if the config scales its input.

    Args:
      config: says whether, and with which sigma_data.
      x_noisy: variance-exploding state, [B, T, C].
      sigma: noise levels, [B], or one for all.
    """
    if not config.input_scaling:
        return x_noisy
    scale = (sigma**2 + config.sigma_data**2) ** -0.5
    return x_noisy * scale.reshape(-1, 1, 1)


@jax.custom_vjp
def with_fast_gradient(weight):
    """Return a weight matrix [D0, D1] itself, in such a way that a CPU multiplies fast for its gradient.

    JAX writes the gradient of z W as (g^T z)^T. XLA's compiler for CPUs turns that into z^T g with a copy of g whose
    axes are swapped, for which it has only a slow product. A barrier between that transpose and another prevents this.
    """
    return weight


with_fast_gradient.defvjp(
    lambda weight: (weight, None), lambda _, gradient: (jax.lax.optimization_barrier(gradient.T).T,)
)


@functools.partial(jax.jit, static_argnames=("scale", "shape"))
def scaled_normal(key, scale: float, shape: tuple[int, ...]):
    """Return scale times standard normal numbers, in one program: the same bits in a jit and outside."""
    return scale * jax.random.normal(key, shape)


class LayerKeys:
    """Keys for the layers of one network: the numbers of `nnx.Rngs(params=key)`, counted in Python.

    Under a trace `nnx.Rngs` counts in the trace, and with every layer looks through all that was traced before it.
    """

    def __init__(self, key):
        self.key, self.dealt = key, 0

    def params(self):
        """Return the next key."""
        self.dealt += 1
        return jax.random.fold_in(self.key, self.dealt - 1)


class DenoisingNetwork(nnx.Module):
    """What samplers, training and rollout need of any network.

    A subclass has `config`, `encode(condition) -> context` (once a round) and `stages`, a generator
    of (name, value) on the way from the noisy state to x0_hat, which comes last. Condition and
    context are trees of arrays that the family alone looks into.
    """

    def __call__(self, x_noisy, sigma, context, key=None):
        """Estimate the clean features (Eq. 1).

        Args:
          x_noisy: variance-exploding state, [B, T, C].
          sigma: noise level, [B] or scalar, > 0.
          context: from `encode`.
          key: random key for dropout, in training; without one nothing is dropped.

        Returns:
          x0_hat, [B, T, C].

        Raises:
          ValueError: if x_noisy does not fit the config.
        """
        *_, (_, x0_hat) = self.stages(x_noisy, sigma, context, key)
        return x0_hat
