"""The paper's model names, as configs: `zoo.build("F3AMD-FNO-96", channels=129, num_styles=22)`."""

from __future__ import annotations

import jax
import pandas as pd
from flax import nnx

from f3amd_lib.models.f3amd import F3AMD, F3AMDConfig
from f3amd_lib.names import nearest_hint

__all__ = ["PRESETS", "build_config", "build", "build_from_config", "count_parameters", "table"]

# Depth N by latent width D (section 4.5).
_DEPTHS = {32: 8, 48: 8, 64: 6, 96: 6, 128: 4}

_PAPER = {
    f"F3AMD-FNO-{width}": {"latent_width": width, "depth": depth}
    for width, depth in _DEPTHS.items()
}

PRESETS: dict[str, dict] = {
    **_PAPER,
    # The text to the letter: no input scaling, no normalisation.
    **{
        f"{name}-raw": {**values, "input_scaling": False, "normalise": False}
        for name, values in _PAPER.items()
    },
    # Ours: never in a row of the paper.
    **{
        f"{name}-plus": {
            **values,
            "num_condition_heads": 4,
            "block_residual": True,
            "history_anchor": True,
            "residual_prior": True,
        }
        for name, values in _PAPER.items()
    },
}
"""Settings of each preset that differ from `F3AMDConfig`'s defaults."""


def build_config(name: str, *, channels: int, num_styles: int, window: int = 32, **overrides):
    """Return the config of a preset.

    Args:
      name: the paper's name, such as "F3AMD-FNO-96", or one with "-raw" or "-plus".
      channels: C, features a frame.
      num_styles: S.
      window: T; all T // 2 + 1 modes are kept unless `num_kept_modes` says otherwise (section 4.5).
      **overrides: fields of `F3AMDConfig` to change.

    Raises:
      ValueError: for an unknown name (with the nearest ones) or field.
    """
    if name not in PRESETS:
        raise ValueError(f"unknown model {name!r}{nearest_hint(name, PRESETS)}")
    values = {
        "channels": channels,
        "num_styles": num_styles,
        "window": window,
        "num_kept_modes": window // 2 + 1,
        **PRESETS[name],
        **overrides,
    }
    return F3AMDConfig.from_dict(values)


def build(name: str, *, key, **settings) -> F3AMD:
    """Return a freshly initialised network of a preset.

    Args:
      name: see `build_config`.
      key: JAX random key of the initial weights.
      **settings: as for `build_config` (channels and num_styles are needed).
    """
    return build_from_config(build_config(name, **settings), key)


def build_from_config(config: F3AMDConfig, key) -> F3AMD:
    """Return a freshly initialised network of a config."""
    return F3AMD(config, rngs=nnx.Rngs(params=key))


def count_parameters(config: F3AMDConfig) -> int:
    """Return the number of learned numbers, without building arrays."""
    model = nnx.eval_shape(lambda: build_from_config(config, jax.random.key(0)))
    return sum(leaf.size for leaf in jax.tree.leaves(nnx.state(model, nnx.Param)))


def table(*, channels: int, num_styles: int, window: int = 32) -> pd.DataFrame:
    """Return one row per preset: name, latent width, depth, kept modes, parameters."""
    rows = []
    for name in PRESETS:
        config = build_config(name, channels=channels, num_styles=num_styles, window=window)
        rows.append(
            {
                "model": name,
                "latent_width": config.latent_width,
                "depth": config.depth,
                "num_kept_modes": config.num_kept_modes,
                "parameters": count_parameters(config),
            }
        )
    return pd.DataFrame(rows)
