"""The paper's models by the paper's names: `zoo.build("F3AMD-FNO-96", channels=129, ...)`.

A preset is a row of a table in the paper (or one of ours, which says so): a network, the noise it
is trained with, and what its training does differently. Presets differ in values only; the code is
shared by all.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field

import jax
import jax.numpy as jnp
import pandas as pd
from flax import nnx

from f3amd_lib.diffusion.schedules import NoiseSchedule, VarianceExploding, VariancePreservingCosine
from f3amd_lib.ground.names import nearest_hint
from f3amd_lib.networks import counting
from f3amd_lib.networks.camdm import CAMDM, CAMDMConfig
from f3amd_lib.networks.conditioning import Condition
from f3amd_lib.networks.config import NetworkConfig
from f3amd_lib.networks.f3amd import F3AMD, F3AMDConfig
from f3amd_lib.networks.spectral import count_modes

FAMILIES = {"F3AMD": (F3AMDConfig, F3AMD), "CAMDM": (CAMDMConfig, CAMDM)}
"""Config and network of each family."""


@dataclass(frozen=True)
class Preset:
    """A named model.

    Attributes:
      name: ours, fit for file names and command lines; the paper's own where it is that.
      source: where the paper has it, or "ours".
      family: a key of `FAMILIES`.
      network: fields of the family's config that differ from its defaults.
      diffusion: the noise it is trained with; names the sampler it is meant for.
      training: fields of the training config that differ, whatever the length of the run.
      paper_names: how the paper's tables call it, where that is not `name`.
      windows: window lengths that the paper trains it with, frames.
    """

    name: str
    source: str
    family: str = "F3AMD"
    network: Mapping = field(default_factory=dict)
    diffusion: NoiseSchedule = field(default_factory=VarianceExploding)
    training: Mapping = field(default_factory=dict)
    paper_names: tuple[str, ...] = ()
    windows: tuple[int, ...] = (32,)


# Depth N (section 4.5) and attention heads (Appendix A) by latent width D.
_DEPTHS = {32: 8, 48: 8, 64: 6, 96: 6, 128: 4}
_HEADS = {32: 1, 48: 2, 64: 2, 96: 4, 128: 4}

_NO_IRD = {"loss": {"ird": 0.0}}  # section 4.1: CAMDM's own loss

_RAW = {"input_scaling": False, "normalise": False}

_PLUS_NETWORK = {"num_condition_heads": 4, "block_residual": True, "history_anchor": True, "residual_prior": True}
_PLUS_TRAINING = {
    "noise": "mixed",
    "history_noise": 0.02,
    "captured_path_share": 0.25,
    "own_history_share": 0.75,
    "history_damping": 0.5,
    "loss": {
        "sample": 1.0,
        "position": 20.0,
        "feature_velocity": 5.0,
        "joint_velocity": 300.0,
        "foot": 300.0,
        "ird": 1.0,
        "ird_form": "excess",
    },
}

# Ours again: what makes feet stand and seams quiet. The network faces where the path goes and sees
# its history in front of the window; feet weigh more; fewer histories are spoiled on purpose.
_STEADY_NETWORK = {**_PLUS_NETWORK, "facing_frame": True, "history_input": True}
_STEADY_TRAINING = {
    **_PLUS_TRAINING,
    "own_history_share": 0.5,
    "history_damping": 0.25,
    "loss": {**_PLUS_TRAINING["loss"], "position": 60.0, "joint_velocity": 600.0, "foot": 1500.0, "floor": 3000.0},
}

_SUFFIXES = {
    "-raw": (_RAW, {}),
    "-plus": (_PLUS_NETWORK, _PLUS_TRAINING),
    "-steady": (_STEADY_NETWORK, _STEADY_TRAINING),
}
"""What may follow an F3AMD preset's name -> (changes of its network, of its training)."""


def _fno(width: int, **changes) -> dict:
    return {"latent_width": width, "depth": _DEPTHS[width], **changes}


def _transformer(width: int, **changes) -> dict:
    return _fno(width, base_block="transformer", num_heads=_HEADS[width], **changes)


def _variant(name: str, source: str, **changes) -> Preset:
    """Return an ablation of FNO-96, the baseline of Tables 8 to 11."""
    return Preset(name, source, network=_fno(96, **changes))


def _camdm(name: str, source: str, num_levels: int = 8, **changes) -> Preset:
    """Return a CAMDM trained on K levels of the cosine schedule and told their number."""
    diffusion = VariancePreservingCosine(num_levels)
    network = {"noise_levels": tuple(float(level) for level in diffusion.sigmas)}
    return dataclasses.replace(
        Preset(name, source, "CAMDM", network, diffusion, _NO_IRD),
        **{key: value for key, value in changes.items() if key != "network"},
        network=network | changes.get("network", {}),
    )


def _list_presets() -> list[Preset]:
    sizes = []
    for kind, network in (("FNO", _fno), ("Transformer", _transformer)):
        for width in _DEPTHS:
            windows = (32, 64) if width >= 64 else (32,)
            name = f"F3AMD-{kind}-{width}"
            preset = Preset(name, "Tables 1-3", network=network(width), windows=windows)
            if name == "F3AMD-FNO-96":
                also = (" (FNO enc/dec)", " (FiLM)", ", m=17")
                names = tuple(name + ending for ending in also)
                preset = dataclasses.replace(preset, source="Tables 1-5, 8-12", paper_names=names)
            sizes.append(preset)
    baselines = [
        _camdm("CAMDM", "Tables 1-7, section 6", paper_names=("CAMDM (JAX)",), windows=(32, 64)),
        _camdm("CAMDM-96", "Table 12", network={"latent_width": 96}),
        # The network of the released code, trained as all others are. F3AMD measures it with 8
        # steps, so that it gets K = 8; the code's own default is 4.
        _camdm(
            "CAMDM-code",
            "Tables 6, 7",
            network={"split_path": True, "dropout": 0.2, "normalise": False},
            training={**_NO_IRD, "history_dropout": 0.15},
            paper_names=("CAMDM (PyTorch)",),
        ),
        Preset("CAMDM-VE", "section 6", "CAMDM", training=_NO_IRD),
    ]
    base = "F3AMD-FNO-96"
    ablations = [
        _variant("F3AMD-DCT-96", "Table 8", spectral_variant="cosine"),
        _variant("F3AMD-reduced-rank-FNO-96", "Table 8", spectral_variant="reduced_rank"),
        _variant("F3AMD-weighted-FNO-96", "Table 8", spectral_variant="weighted"),
        dataclasses.replace(
            _variant(f"{base}-linear", "Table 9", encoder_decoder="linear"), paper_names=(f"{base} (linear enc/dec)",)
        ),
        Preset(
            "F3AMD-Transformer-64-linear",
            "Table 9",
            network=_transformer(64, encoder_decoder="linear"),
            paper_names=("F3AMD-Transformer-64 (linear enc/dec)",),
        ),
    ]
    for modes in (14, 12, 8, 4, 1):
        preset = _variant(f"{base}-m{modes}", "Table 10", num_kept_modes=modes)
        ablations.append(dataclasses.replace(preset, paper_names=(f"{base}, m={modes}",)))
    for label in ("concatenation", "AdaLN-zero", "cross-attention"):
        kind = label.lower().replace("-", "_")
        preset = _variant(f"{base}-{label}", "Table 11", conditioning=kind)
        ablations.append(dataclasses.replace(preset, paper_names=(f"{base} ({label})",)))
    ablations.append(Preset(f"{base}-no-IRD", "section 4.1", network=_fno(96), training=_NO_IRD))
    ours = [
        *(_suffixed(Preset(base, "", network=_fno(96)), end) for end in ("-raw", "-plus")),
        _camdm("CAMDM-IRD", "ours", training={}),
        *(_camdm(f"CAMDM-K{levels}", "ours", levels) for levels in (4, 2, 1)),
    ]
    return [*sizes, *baselines, *ablations, *ours]


def _suffixed(preset: Preset, suffix: str) -> Preset:
    network, training = _SUFFIXES[suffix]
    return Preset(
        preset.name + suffix,
        "ours",
        network={**preset.network, **network},
        training={**preset.training, **training},
        windows=preset.windows,
    )


PRESETS: dict[str, Preset] = {preset.name: preset for preset in _list_presets()}
"""All presets by name. Any F3AMD preset also takes a suffix of ours (see `find_preset`)."""

_PAPER_NAMES = {alias: preset for preset in PRESETS.values() for alias in preset.paper_names}


def find_preset(name: str) -> Preset:
    """Return a preset by our name, by the paper's, or with a suffix.

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
    for suffix in _SUFFIXES:
        base = PRESETS.get(name.removesuffix(suffix))
        if name.endswith(suffix) and base is not None:
            if base.family != "F3AMD" or base.source == "ours" or base.training:
                raise ValueError(
                    f"{base.name} has no {suffix!r} form: only the paper's F3AMD with the paper's losses have"
                )
            return _suffixed(base, suffix)
    raise ValueError(f"unknown model {name!r}{nearest_hint(name, [*PRESETS, *_PAPER_NAMES])}")


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
    values |= {**preset.network, **overrides}
    config_class, _ = FAMILIES[preset.family]
    if config_class is not F3AMDConfig or "num_kept_modes" in values:
        return config_class.from_dict(values)
    # One mode is always there; how many more depends on the variant.
    config = config_class.from_dict({**values, "num_kept_modes": 1})
    return dataclasses.replace(config, num_kept_modes=count_modes(config.spectral_variant, config.block_frames))


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


def count_flops(config: NetworkConfig) -> tuple[int, int]:
    """Count the operations of one character's round.

    Args:
      config: of the network.

    Returns:
      (operations of encoding the condition, once a round; operations of one evaluation of the
      denoiser, once a step). See `counting.count_flops` for what is counted.
    """
    graph, state = nnx.split(_abstract(config))
    zeros = lambda *shape: jax.ShapeDtypeStruct((1, *shape), jnp.float32)
    condition = Condition(zeros(config.num_history, config.channels), zeros(config.window, 8), zeros(config.num_styles))
    encode = lambda state, condition: nnx.merge(graph, state).encode(condition)
    denoise = lambda state, *inputs: nnx.merge(graph, state)(*inputs)
    context = jax.eval_shape(encode, state, condition)
    state_shape = zeros(config.window, config.channels)
    return (
        counting.count_flops(encode, state, condition),
        counting.count_flops(denoise, state, state_shape, zeros(), context),
    )


def table(*, channels: int, num_styles: int) -> pd.DataFrame:
    """List all presets, with a row for every window length that the paper trains them with.

    Args:
      channels: C, features a frame.
      num_styles: S.

    Returns:
      Columns model, window, latent_width, depth, parameters, mflop_per_evaluation (of one
      character; see `count_flops`), diffusion, sampler, source (the paper's tables, or "ours").
    """
    rows = []
    for preset in PRESETS.values():
        for window in preset.windows:
            config = build_config(preset.name, channels=channels, num_styles=num_styles, window=window)
            rows.append(
                {
                    "model": preset.name,
                    "window": window,
                    "latent_width": config.latent_width,
                    "depth": config.depth,
                    "parameters": count_parameters(config),
                    "mflop_per_evaluation": round(count_flops(config)[1] / 1e6, 2),
                    "diffusion": preset.diffusion.kind,
                    "sampler": preset.diffusion.sampler,
                    "source": preset.source,
                }
            )
    return pd.DataFrame(rows)
