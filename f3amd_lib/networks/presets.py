"""Models by the papers' names: `presets.build("F3AMD-FNO-96", channels=129, ...)`.

A preset is a row of a table in a paper (or one of ours, which says so): a network, the noise it is
trained with, and what its training does differently. All stand in `papers/*/presets.toml`; another
paper brings a file of its own and, where its network is a new one, a line of `FAMILIES`.
"""

from __future__ import annotations

import dataclasses
import functools
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import jax
import jax.numpy as jnp
import pandas as pd
from flax import nnx

from f3amd_lib.diffusion.schedules import NoiseSchedule, schedule_from_dict
from f3amd_lib.ground.names import nearest_hint
from f3amd_lib.networks.camdm import CAMDM, CAMDMConfig
from f3amd_lib.networks.config import NetworkConfig
from f3amd_lib.networks.counting import count_flops
from f3amd_lib.networks.f3amd import F3AMD, F3AMDConfig

FAMILIES = {"F3AMD": (F3AMDConfig, F3AMD), "CAMDM": (CAMDMConfig, CAMDM)}
"""Config and network of each family."""


@dataclass(frozen=True)
class Preset:
    """A named model.

    Attributes:
      name: ours, fit for file names and command lines; the paper's own where it is that.
      paper: folder of the paper in `papers`.
      family: a key of `FAMILIES`.
      diffusion: the noise it is trained with; names the sampler it is meant for.
      network: fields of the family's config that differ from its defaults.
      training: fields of the training config that differ, whatever the length of the run.
      source: where the paper has it, or "ours".
      paper_names: how the paper's tables call it, where that is not `name`.
      windows: window lengths that the paper trains it with, frames.
    """

    name: str
    paper: str
    family: str
    diffusion: NoiseSchedule
    network: Mapping
    training: Mapping
    source: str
    paper_names: tuple[str, ...] = ()
    windows: tuple[int, ...] = (32,)


def laid_over(lower: Mapping, upper: Mapping) -> dict:
    """Return two mappings in one, the upper's values first, and so for the mappings inside them."""
    inside = {key: laid_over(lower[key], upper[key]) for key in lower.keys() & upper if isinstance(lower[key], dict)}
    return {**lower, **upper, **inside}


def _preset(name: str, paper: str, family: str, diffusion=None, network=None, training=None, **own) -> Preset:
    schedule = schedule_from_dict(diffusion or {"kind": "variance_exploding"})
    network = network or {}
    # CAMDM is told the number of a level, and so must know the levels of its schedule.
    if family == "CAMDM" and schedule.levels is not None:
        network = {"noise_levels": tuple(schedule.levels.tolist()), **network}
    own = {key: tuple(value) if isinstance(value, list) else value for key, value in own.items()}
    return Preset(name, paper, family, schedule, network, training or {}, **own)


def read_presets(path: Path) -> tuple[dict[str, Preset], dict[str, Preset]]:
    """Return the presets of a paper's file by name, and its forms by what follows a name."""
    table = tomllib.loads(path.read_text(encoding="utf-8"))
    rows, named = {}, {"forms": {}, "presets": {}}
    for kind in named:
        for name, row in table.get(kind, {}).items():
            own = {key: row.pop(key) for key in ("source", "paper_names", "windows") if key in row}
            lower = [rows[other] for other in row.pop("like", ())]
            rows[name] = functools.reduce(laid_over, [*lower, row])
            named[kind][name] = _preset(name, path.parent.name, **own, **rows[name])
    return named["presets"], named["forms"]


PRESETS: dict[str, Preset] = {}
"""All presets by name."""

FORMS: dict[str, Preset] = {}
"""What may follow the name of a paper's preset, and what it changes (see `find_preset`)."""

for _path in sorted((Path(__file__).parents[1] / "papers").glob("*/presets.toml")):
    _presets, _forms = read_presets(_path)
    PRESETS |= _presets
    FORMS |= _forms

_PAPER_NAMES = {alias: preset for preset in PRESETS.values() for alias in preset.paper_names}


def find_preset(name: str) -> Preset:
    """Return a preset by our name, by the paper's, or with a form of ours behind it.

    Args:
      name: a key of `PRESETS`; or a label of the paper's tables, such as "F3AMD-FNO-96, m=14"; or
        the name of an F3AMD preset followed by "-raw" (the text to the letter: no input scaling,
        no normalisation), or by one of our own recipes, which are never in a row of the paper:
        "-plus" walks, "-steady" has quieter feet and seams.

    Raises:
      ValueError: for an unknown name, with the nearest ones.
    """
    for known in (PRESETS, _PAPER_NAMES):
        if name in known:
            return known[name]
    for suffix, form in FORMS.items():
        base = PRESETS.get(name.removesuffix(suffix))
        if name.endswith(suffix) and base is not None:
            return _formed(base, suffix, form)
    raise ValueError(f"unknown model {name!r}{nearest_hint(name, [*PRESETS, *_PAPER_NAMES])}")


def _formed(base: Preset, suffix: str, form: Preset) -> Preset:
    if (base.paper, base.family) != (form.paper, form.family) or base.source == "ours" or base.training:
        only = f"only the paper's {form.family} with the paper's losses have"
        raise ValueError(f"{base.name} has no {suffix!r} form: {only}")
    name, network = base.name + suffix, laid_over(base.network, form.network)
    return dataclasses.replace(
        base, name=name, network=network, training=form.training, source=form.source, paper_names=()
    )


def build_config(name: str, *, channels: int, num_styles: int, window: int = 32, **overrides) -> NetworkConfig:
    """Return the config of a preset.

    Args:
      name: see `find_preset`.
      channels: C, features a frame.
      num_styles: S.
      window: T; all modes are kept unless the preset or `num_kept_modes` says otherwise (section
        4.5).
      **overrides: fields of the family's config to change.

    Raises:
      ValueError: for an unknown name (with the nearest ones) or field.
    """
    preset = find_preset(name)
    values = {"channels": channels, "num_styles": num_styles, "window": window}
    return FAMILIES[preset.family][0].from_dict({**values, **preset.network, **overrides})


def config_from_dict(values: Mapping) -> NetworkConfig:
    """Build a config of any family from its `to_dict`.

    Raises:
      ValueError: for a family that is missing or unknown, or an unknown field.
    """
    family = values.get("family")
    if family not in FAMILIES:
        raise ValueError(f"unknown model family {family!r}{nearest_hint(family, FAMILIES)}")
    return FAMILIES[family][0].from_dict(dict(values))


def build(name: str, *, key, **settings) -> nnx.Module:
    """Return a freshly initialised network of a preset.

    Args:
      name: see `find_preset`.
      key: JAX random key of the initial weights.
      **settings: as for `build_config` (channels and num_styles are needed).
    """
    return build_from_config(build_config(name, **settings), key)


def build_from_config(config: NetworkConfig, key) -> nnx.Module:
    """Return a freshly initialised network of a config."""
    return FAMILIES[config.family][1](config, rngs=nnx.Rngs(params=key))


def _abstract(config: NetworkConfig):
    return nnx.eval_shape(lambda: build_from_config(config, jax.random.key(0)))


def count_parameters(config: NetworkConfig) -> int:
    """Return the number of learned numbers, without building arrays."""
    return sum(leaf.size for leaf in jax.tree.leaves(nnx.state(_abstract(config), nnx.Param)))


def count_model_flops(config: NetworkConfig) -> tuple[int, int]:
    """Count the operations of one character's round.

    Args:
      config: of the network.

    Returns:
      (operations of encoding the condition, once a round; operations of one evaluation of the
      denoiser, once a step). See `counting.count_flops` for what is counted.
    """
    graph, state = nnx.split(_abstract(config))
    condition = config.condition_shapes(1)
    x_noisy = jax.ShapeDtypeStruct((1, config.window, config.channels), jnp.float32)
    sigma = jax.ShapeDtypeStruct((1,), jnp.float32)
    encode = lambda state, condition: nnx.merge(graph, state).encode(condition)
    denoise = lambda state, *inputs: nnx.merge(graph, state)(*inputs)
    context = jax.eval_shape(encode, state, condition)
    once = count_flops(encode, state, condition)
    return once, count_flops(denoise, state, x_noisy, sigma, context)


def table(*, channels: int, num_styles: int) -> pd.DataFrame:
    """List all presets, with a row for every window length that the paper trains them with.

    Args:
      channels: C, features a frame.
      num_styles: S.

    Returns:
      Columns model, window, latent_width, depth, parameters, mflop_per_evaluation (of one
      character; see `count_model_flops`), diffusion, sampler, source (the paper's tables, or "ours").
    """
    columns = "model window latent_width depth parameters mflop_per_evaluation diffusion sampler source"
    rows = []
    for preset in PRESETS.values():
        for window in preset.windows:
            config = build_config(preset.name, channels=channels, num_styles=num_styles, window=window)
            mflop = round(count_model_flops(config)[1] / 1e6, 2)
            sizes = window, config.latent_width, config.depth, count_parameters(config), mflop
            rows.append((preset.name, *sizes, preset.diffusion.kind, preset.diffusion.sampler, preset.source))
    return pd.DataFrame(rows, columns=columns.split())
