"""Models by the papers' names: `presets.build("F3AMD-FNO-96", channels=129, ...)`.

A preset is a row of a table in a paper (or one of ours, which says so): a network, the noise it is
trained with, and what its training does differently. All are in `papers/*/presets.toml`; another
paper brings a file of its own and, where its network is a new one, a line of `[families]` in it.
"""

import dataclasses
import functools
import pkgutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import jax
import jax.numpy as jnp
from flax import nnx

from f3amd_lib.diffusion.flow import default_sampler
from f3amd_lib.diffusion.schedules import NoiseSchedule, schedule_from_dict
from f3amd_lib.ground.files import read_toml
from f3amd_lib.ground.names import check_known, nearest_hint
from f3amd_lib.networks.config import CheckedConfig, LayerKeys
from f3amd_lib.networks.counting import count_flops

FAMILIES: dict[str, tuple[str, str]] = {}
"""Where config and network of each family are, "module:class", as `[families]` of `papers/*/presets.toml` says."""


@functools.cache
def find_family(name: str) -> tuple[type[CheckedConfig], Callable[..., nnx.Module]]:
    """Return config and network of a family; their module is imported when the family is first asked for."""
    config, network = map(pkgutil.resolve_name, FAMILIES[name])
    return config, network


@dataclass(frozen=True)
class Preset:
    """A named model.

    Attributes:
      name: ours, fit for file names and command lines; the paper's own where it is that.
      paper: folder of the paper in `papers`.
      family: a key of `FAMILIES`.
      diffusion: the noise it is trained with; names the sampler it is meant for. An autoencoder has no use for it.
      network: fields of the family's config that differ from its defaults.
      training: fields of the training config that differ, whatever the length of the run.
      source: where the paper has it, or "ours".
      paper_names: how the paper's tables call it, where that is not `name`.
      several_windows: window lengths that the paper trains it with, where they are several.
      latent: the preset of the autoencoder whose latent it makes, "" where it makes motion itself; of a form, what
        follows that preset's name.
    """

    name: str
    paper: str
    family: str
    diffusion: NoiseSchedule
    network: Mapping
    training: Mapping
    source: str
    paper_names: tuple[str, ...] = ()
    several_windows: tuple[int, ...] = ()
    latent: str = ""

    @property
    def windows(self) -> tuple[int, ...]:
        """Window lengths that the paper trains it with, frames (of the latent where there is one)."""
        if self.several_windows:
            return self.several_windows
        return (self.network.get("window", getattr(find_family(self.family)[0], "window", 0)),)


def laid_over(lower: Mapping, upper: Mapping) -> dict:
    """Return two mappings in one, the upper's values first, and so for the mappings inside them."""
    inside = {key: laid_over(lower[key], upper[key]) for key in lower.keys() & upper if isinstance(lower[key], dict)}
    return {**lower, **upper, **inside}


def _preset(name: str, paper: str, family: str, source, diffusion=None, network=None, training=None, **own) -> Preset:
    check_known(family, FAMILIES, "family")
    schedule = schedule_from_dict(diffusion or {"kind": "variance_exploding"})
    network = network or {}
    # CAMDM is told the number of a level, and so must know the levels of its schedule.
    if family == "CAMDM" and schedule.levels is not None:
        network = {"noise_levels": tuple(schedule.levels.tolist()), **network}
    names, windows = (tuple(own.pop(key, ())) for key in ("paper_names", "windows"))
    return Preset(name, paper, family, schedule, network, training or {}, source, names, windows, **own)


def read_presets(path: Path) -> tuple[dict[str, Preset], dict[str, Preset]]:
    """Return the presets of a paper's file by name, and its forms by what follows a name.

    Raises:
      ValueError: naming file and preset, for a key, family, schedule or preset to be like that is not known.
    """
    table = read_toml(path)
    rows, named = {}, {"forms": {}, "presets": {}}
    for kind, found in named.items():
        for name, row in table.get(kind, {}).items():
            own = {key: row.pop(key) for key in ("source", "paper_names", "windows") if key in row}
            try:
                for other in (likes := row.pop("like", ())):
                    check_known(other, rows, "preset above it in this file")
                rows[name] = functools.reduce(laid_over, [*(rows[other] for other in likes), row])
                found[name] = _preset(name, path.parent.name, **own, **rows[name])
            except (TypeError, ValueError) as error:
                raise ValueError(f"{path}: {kind}.{name}: {error}") from error
    return named["presets"], named["forms"]


PRESETS: dict[str, Preset] = {}
"""All presets by name."""

FORMS: dict[str, Preset] = {}
"""What may follow the name of a paper's preset, and what it changes (see `find_preset`)."""

for _path in sorted((Path(__file__).parents[1] / "papers").glob("*/presets.toml")):
    FAMILIES |= {name: tuple(places) for name, places in read_toml(_path).get("families", {}).items()}
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
            if (base.paper, base.family) != (form.paper, form.family) or base.source == "ours" or base.training:
                only = f"only the paper's {form.family} with the paper's losses have"
                raise ValueError(f"{base.name} has no {suffix!r} form: {only}")
            return dataclasses.replace(
                base, name=name, network=laid_over(base.network, form.network), training=form.training, paper_names=(),
                source=form.source, latent=base.latent and base.latent + form.latent,
            )  # fmt: skip
    raise ValueError(f"unknown model {name!r}{nearest_hint(name, [*PRESETS, *_PAPER_NAMES])}")


def of_paper(paper: str = "f3amd") -> dict[str, Preset]:
    """Return the presets of one paper's folder by name; ValueError names the nearest folder if there is none."""
    check_known(paper, {preset.paper: preset for preset in PRESETS.values()}, "paper")
    return {name: preset for name, preset in PRESETS.items() if preset.paper == paper}


def build_config(name: str, **settings) -> CheckedConfig:
    """Return the config of a preset.

    Args:
      name: see `find_preset`.
      **settings: fields of the family's config that the data decide, such as `channels` and `num_styles` of F3AMD
        and CAMDM or `num_joints` and `text_width` of ACMDM, and any others to change. F3AMD keeps all modes of a
        `window` unless the preset or `num_kept_modes` says otherwise (section 4.5).

    Raises:
      ValueError: for an unknown name (with the nearest ones) or field, or one that is needed and missing.
    """
    preset = find_preset(name)
    return find_family(preset.family)[0].from_dict({**preset.network, **settings})


def config_from_dict(values: Mapping) -> CheckedConfig:
    """Build a config of any family from its `to_dict`.

    Raises:
      ValueError: for a family that is missing or unknown, or an unknown field.
    """
    family = values.get("family")
    check_known(family, FAMILIES, "model family")
    return find_family(family)[0].from_dict(dict(values))


def build(name: str, *, key, **settings) -> nnx.Module:
    """Return a freshly initialised network of a preset.

    Args:
      name: see `find_preset`.
      key: JAX random key of the initial weights.
      **settings: as for `build_config`.
    """
    return build_from_config(build_config(name, **settings), key)


def build_from_config(config: CheckedConfig, key) -> nnx.Module:
    """Return a freshly initialised network of a config."""
    return find_family(config.family)[1](config, rngs=LayerKeys(key))


@functools.lru_cache(maxsize=32)
def blank_network(config: CheckedConfig) -> tuple:
    """Return a network's structure and the shapes of its weights, without building arrays."""
    return nnx.split(nnx.eval_shape(lambda: build_from_config(config, jax.random.key(0))))


def count_parameters(config: CheckedConfig) -> int:
    """Return the number of learned numbers, without building arrays."""
    return sum(leaf.size for leaf in jax.tree.leaves(blank_network(config)[1]))


def count_model_flops(config: CheckedConfig) -> tuple[int, int]:
    """Count the operations of one character's round.

    Args:
      config: of a denoiser.

    Returns:
      (operations of encoding the condition, once a round; operations of one evaluation of the
      denoiser, once a step). See `counting.count_flops` for what is counted.
    """
    (graph, state), condition = blank_network(config), config.condition_shapes(1)
    x_noisy, sigma = (jax.ShapeDtypeStruct(shape, jnp.float32) for shape in (config.state_shape(1), (1,)))
    encode = lambda state, condition: nnx.merge(graph, state).encode(condition)
    denoise = lambda state, *inputs: nnx.merge(graph, state)(*inputs)
    context = jax.eval_shape(encode, state, condition)
    return count_flops(encode, state, condition), count_flops(denoise, state, x_noisy, sigma, context)


def table(paper: str = "f3amd", **settings):
    """List a paper's denoisers, with a row for every window length that the paper trains them with.

    Args:
      paper: its folder.
      **settings: of the data, for whichever family asks for them (`CheckedConfig.from_data`).

    Returns:
      Columns model, window, latent_width, depth, parameters, mflop_per_evaluation (of one
      character; see `count_model_flops`), diffusion, sampler, source (the paper's tables, or "ours").

    Raises:
      ValueError: for an unknown paper, a setting of no family, or one that is needed and missing.
    """
    import pandas as pd  # here: half a second that no network needs

    known = {name for family in FAMILIES for name in find_family(family)[0].from_data}
    for name in settings:
        check_known(name, known, "setting of the data")
    rows = []
    for preset in of_paper(paper).values():
        family = find_family(preset.family)[0]
        if not hasattr(family, "state_shape"):  # an autoencoder denoises nothing
            continue
        # A latent of meshes has the vertices that it has, whatever the data.
        of_data = {name: settings[name] for name in family.from_data if name in settings.keys() - preset.network.keys()}
        for window in preset.windows:
            config = build_config(preset.name, **of_data, window=window)
            own_sampler = default_sampler(getattr(config, "objective", "x0"), preset.diffusion)
            rows.append({
                "model": preset.name, "window": window, "latent_width": config.latent_width, "depth": config.depth,
                "parameters": count_parameters(config),
                "mflop_per_evaluation": round(count_model_flops(config)[1] / 1e6, 2),
                "diffusion": preset.diffusion.kind,
                "sampler": getattr(config, "sampler", None) or own_sampler, "source": preset.source,
            })  # fmt: skip
    return pd.DataFrame(rows)
