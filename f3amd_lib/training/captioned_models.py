"""What the files of all models of captioned motion say: a network on states of an autoencoder, told a caption."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from f3amd_lib.diffusion.schedules import schedule_from_dict
from f3amd_lib.networks.config import NetworkConfig
from f3amd_lib.networks.presets import config_from_dict
from f3amd_lib.training.checkpoints import (
    check_kind,
    describe_skeleton,
    described_skeleton,
    load_tree,
    packed_shapes,
    packed_weights,
    save_tree,
    unpacked_weights,
    weights_shapes,
)

_CONFIG_OF = {"params": "model", "autoencoder": "autoencoder"}
"""Weights that a description has the config of, with its name there."""

_WEIGHTS = (*_CONFIG_OF, "branch")


def save_captioned_model(
    path: Path, kind: str, trained: Any, *,
    autoencoder: NetworkConfig | None, weights: dict, arrays: dict, extra: dict, dtype,
) -> None:  # fmt: skip
    """Write a model; `load_captioned_model` gives its parts back, weights in the precision of the file.

    Args:
      path: file to write.
      kind: what the description calls such a model.
      trained: with name, config (or None), params, schedule (or None), skeleton, fps, text_encoder, words
        and record.
      autoencoder: config, or None.
      weights: of `autoencoder` and `branch`; None stands for one that the model lacks.
      arrays: what is written exactly, by name.
      extra: what else the description says, JSON-ready.
      dtype: of the weights, as for `checkpoints.save_model`.
    """
    weights = {"params": trained.params} | weights
    tree = {name: packed_weights(params, dtype) for name, params in weights.items() if params is not None}
    described = {"model": trained.config, "autoencoder": autoencoder, "diffusion": trained.schedule}
    metadata = {
        "kind": kind,
        "name": trained.name,
        **{name: None if value is None else value.to_dict() for name, value in described.items()},
        "weights": jnp.dtype(dtype).name,
        "fps": trained.fps,
        "text_encoder": trained.text_encoder,
        "words": list(trained.words),
        **extra,
        **describe_skeleton(trained.skeleton),
        "record": trained.record,
    }
    offsets = jnp.asarray(trained.skeleton.offsets, jnp.float32)
    save_tree(path, tree | arrays | {"offsets": offsets}, metadata)


def load_captioned_model(
    path: Path, kind: str, shapes: Callable[[dict, NetworkConfig | None, NetworkConfig | None], tuple[dict, dict]]
) -> tuple[dict, NetworkConfig | None, dict, dict]:
    """Read what `save_captioned_model` wrote.

    Args:
      path: the file.
      kind: as it was written.
      shapes: (description, config, config of the autoencoder) -> (shapes of weights besides `params` and
        `autoencoder`, shapes of arrays).

    Returns:
      (what a model of any kind has, as keyword arguments; config of its autoencoder; weights and arrays by name;
      description).

    Raises:
      ValueError: naming the file, if it is missing, truncated, damaged or of another kind.
    """

    def template(metadata: dict) -> dict:
        check_kind(metadata, kind)
        configs = {name: _config(metadata, what) for name, what in _CONFIG_OF.items()}
        weights, arrays = shapes(metadata, *configs.values())
        weights = {name: weights_shapes(config) for name, config in configs.items() if config is not None} | weights
        packed = {name: packed_shapes(shape, metadata["weights"]) for name, shape in weights.items()}
        return packed | arrays | {"offsets": jax.ShapeDtypeStruct((len(metadata["joints"]), 3), jnp.float32)}

    tree, metadata = load_tree(path, template)
    tree |= {name: unpacked_weights(tree[name]) for name in _WEIGHTS if name in tree}
    common = {
        "name": metadata["name"],
        "config": _config(metadata, "model"),
        "params": tree.get("params"),
        "schedule": None if metadata["diffusion"] is None else schedule_from_dict(metadata["diffusion"]),
        "skeleton": described_skeleton(metadata, tree["offsets"]),
        "fps": metadata["fps"],
        "text_encoder": metadata["text_encoder"],
        "words": tuple(metadata["words"]),
        "record": metadata["record"],
    }
    return common, _config(metadata, "autoencoder"), tree, metadata


def _config(metadata: dict, name: str) -> NetworkConfig | None:
    return None if metadata[name] is None else config_from_dict(metadata[name])
