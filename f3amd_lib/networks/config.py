"""What all networks have in common: checked configs that survive JSON, and one way to be called."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import ClassVar

import jax
from flax import nnx

from f3amd_lib.ground.names import nearest_hint, refuse_unknown

_TYPES = {"int": int, "float": float, "bool": bool, "str": str}
_TUPLE = "tuple[float, ...]"


@dataclass(frozen=True)
class NetworkConfig:
    """What decides the shape of any denoiser of the family.

    Attributes:
      channels: C, features a frame (6 J + 3).
      num_styles: S, width of the one-hot style.
      window: T, future frames a round makes (32 or 64).
      num_history: H, past frames seen (section 4.5: 10).
      latent_width: D (section 4.2).
      depth: N, blocks (section 4.5).
      input_scaling: multiply the noisy input by c_in = 1 / sqrt(sigma^2 + sigma_data^2); the paper
        does not say. Without it the first layer meets numbers up to sigma_max = 128. With
        sigma_data = 1 the scaled input is the variance-preserving state.
      normalise: features have mean 0 and deviation 1 per channel; the paper does not say.
      sigma_data: deviation of the clean features in network units.

    Raises:
      ValueError: for a value of the wrong type, a size that is not positive, an unknown choice.
    """

    family: ClassVar[str] = ""
    choices: ClassVar[dict[str, tuple[str, ...]]] = {}
    """For each field that names a variant: the names there are."""

    may_be_zero: ClassVar[tuple[str, ...]] = ()

    channels: int
    num_styles: int
    window: int = 32
    num_history: int = 10
    latent_width: int = 96
    depth: int = 6
    input_scaling: bool = True
    normalise: bool = True
    sigma_data: float = 1.0

    def __post_init__(self):
        for field in dataclasses.fields(self):
            self._check(field.name, str(field.type))
        if self.window < 2:
            raise ValueError(f"window must be at least 2 frames, got {self.window}")

    def _check(self, name: str, kind: str) -> None:
        value = getattr(self, name)
        if kind == _TUPLE:
            if not isinstance(value, (list, tuple)) or not all(
                type(item) in (int, float) and 0 < item < math.inf for item in value
            ):
                raise ValueError(f"{name} must be positive, finite numbers, got {value!r}")
            object.__setattr__(self, name, tuple(float(item) for item in value))
            return
        wanted = _TYPES[kind]
        if wanted is float and type(value) is int:
            value = float(value)
            object.__setattr__(self, name, value)
        if type(value) is not wanted:
            raise ValueError(f"{name} must be of type {kind}, got {value!r}")
        if name in self.choices and value not in self.choices[name]:
            raise ValueError(f"unknown {name} {value!r}{nearest_hint(value, self.choices[name])}")
        if wanted in (int, float):
            at_least_zero = name in self.may_be_zero and value == 0
            if not (0 < value < math.inf or at_least_zero):
                raise ValueError(f"{name} must be positive and finite, got {value!r}")

    def to_dict(self) -> dict:
        """Return the family's name and the fields as JSON-ready values."""
        return {"family": self.family, **dataclasses.asdict(self)}

    @classmethod
    def from_dict(cls, values: dict) -> NetworkConfig:
        """Build a config from `to_dict`; an unknown key is an error that names the nearest."""
        values = dict(values)
        family = values.pop("family", cls.family)
        if family != cls.family:
            raise ValueError(f"settings of family {family!r} do not make a {cls.family} network")
        refuse_unknown(values, cls, "model setting")
        missing = {"channels", "num_styles"} - values.keys()
        if missing:
            raise ValueError(f"model settings lack {', '.join(sorted(missing))}")
        return cls(**values)

    def check_condition(self, condition) -> None:
        """Raise ValueError unless history, path and style fit the config, with as many rows."""
        batch = condition.history.shape[0]
        expected = {
            "history": (batch, self.num_history, self.channels),
            "path": (batch, self.window, 8),
            "style": (batch, self.num_styles),
        }
        for name, shape in expected.items():
            found = getattr(condition, name).shape
            if found != shape:
                raise ValueError(f"condition {name} must have shape {shape}, got {found}")

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


class Denoiser(nnx.Module):
    """What samplers, training and rollout ask of any network of the family.

    A subclass has `config`, `encode(condition) -> context` (once a round) and `stages`, a generator
    of (name, value) on the way from the noisy state to x0_hat, which comes last.
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


def cast_network(network: nnx.Module, dtype) -> nnx.Module:
    """Return a network whose weights, and with them its arithmetic, are of another type.

    Args:
      network: any; left as it is.
      dtype: of floating-point numbers. Condition and state must be given in it, too.
    """
    graph, state = nnx.split(network)
    return nnx.merge(graph, jax.tree.map(lambda leaf: leaf.astype(dtype), state))
