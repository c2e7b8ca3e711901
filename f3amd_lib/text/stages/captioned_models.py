"""What all models of captioned motion have, how their files say it, and how they are trained: one part at a time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from f3amd_lib.diffusion.schedules import NoiseSchedule, schedule_from_dict
from f3amd_lib.ground.profiles import Profile
from f3amd_lib.ground.records import run_record
from f3amd_lib.motion.skeleton import Skeleton
from f3amd_lib.networks.config import NetworkConfig
from f3amd_lib.networks.presets import config_from_dict
from f3amd_lib.text.data.text_motions import TextMotions
from f3amd_lib.training import checkpoints
from f3amd_lib.training.optimise import Task, TrainingState
from f3amd_lib.training.pipeline import ModelFiles, alone_with, train_in_legs

_CONFIG_OF = {"params": "model", "autoencoder": "autoencoder"}
"""Weights that a description has the config of, with its name there."""

_WEIGHTS = (*_CONFIG_OF, "branch")


@dataclass(frozen=True, eq=False, kw_only=True)
class CaptionedModel:
    """A network on states of motion or of a latent, told a caption; or an autoencoder alone.

    Attributes:
      name: preset, perhaps with what stands beside it.
      skeleton, fps: of the motion it was trained on.
      record: how it was trained, on what, under what terms.
      config, params: of the denoiser; None for an autoencoder alone.
      schedule: the noise schedule it was trained with.
      text_encoder: identity of the encoder whose pooled vectors it reads.
      words: of all captions that it was trained with.
    """

    name: str
    skeleton: Skeleton
    fps: float
    record: dict
    config: NetworkConfig | None = None
    params: Any = None
    schedule: NoiseSchedule | None = None
    text_encoder: str = ""
    words: tuple[str, ...] = ()


def train_part(
    task: Task, files: ModelFiles, data: TextMotions, profile: Profile, name: str, held_out, **leg
) -> tuple[TrainingState | None, dict]:
    """Train a part on captioned clips, going on from its training state if there is one.

    Args:
      task, files, held_out: as of `train_in_legs`.
      data: captioned clips, of which the task has the training split.
      profile: what the record says.
      name: of the model.
      **leg: stop_at and progress, as for `optimise`.

    Returns:
      (state, or None where `stop_at` came first; what a `CaptionedModel` says of itself, by attribute).
    """
    record = run_record(
        profile=profile, dataset=data, seed=task.config.seed, model=name, identity=task.identity(),
        num_train_clips=len(data.members("train")),
    )  # fmt: skip
    with alone_with(files):
        state, _ = train_in_legs(task, files, record, held_out=held_out, **leg)
    about = {"name": name, "skeleton": data.skeleton, "fps": data.fps, "record": record}
    return (state if int(state.step) == task.config.num_steps else None), about


def save_captioned_model(
    path: Path, kind: str, trained: CaptionedModel, *,
    autoencoder: NetworkConfig | None, weights: dict, arrays: dict, extra: dict, dtype,
) -> None:  # fmt: skip
    """Write a model; `load_captioned_model` gives its parts back, weights in the precision of the file.

    Args:
      path: file to write.
      kind: what the description calls such a model.
      trained: the model.
      autoencoder: config, or None.
      weights: of `autoencoder` and `branch`; None stands for one that the model lacks.
      arrays: what is written exactly, by name.
      extra: what else the description says, JSON-ready.
      dtype: of the weights, as for `checkpoints.save_model`.
    """
    weights = {"params": trained.params} | weights
    tree = {name: checkpoints.packed_weights(params, dtype) for name, params in weights.items() if params is not None}
    described = {"model": trained.config, "autoencoder": autoencoder, "diffusion": trained.schedule}
    metadata = {
        "kind": kind, "name": trained.name,
        **{name: None if value is None else value.to_dict() for name, value in described.items()},
        "weights": jnp.dtype(dtype).name, "fps": trained.fps, "text_encoder": trained.text_encoder,
        "words": list(trained.words), **extra, **checkpoints.describe_skeleton(trained.skeleton),
        "record": trained.record,
    }  # fmt: skip
    offsets = jnp.asarray(trained.skeleton.offsets, jnp.float32)
    checkpoints.save_tree(path, tree | arrays | {"offsets": offsets}, metadata)


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
        checkpoints.check_kind(metadata, kind)
        configs = {name: _config(metadata, what) for name, what in _CONFIG_OF.items()}
        weights, arrays = shapes(metadata, *configs.values())
        weights |= {name: checkpoints.weights_shapes(config) for name, config in configs.items() if config is not None}
        packed = {name: checkpoints.packed_shapes(shape, metadata["weights"]) for name, shape in weights.items()}
        return packed | arrays | {"offsets": jax.ShapeDtypeStruct((len(metadata["joints"]), 3), jnp.float32)}

    tree, metadata = checkpoints.load_tree(path, template)
    tree |= {name: checkpoints.unpacked_weights(tree[name]) for name in _WEIGHTS if name in tree}
    common = {name: metadata[name] for name in ("name", "fps", "text_encoder", "record")} | {
        "config": _config(metadata, "model"), "params": tree.get("params"), "words": tuple(metadata["words"]),
        "schedule": None if metadata["diffusion"] is None else schedule_from_dict(metadata["diffusion"]),
        "skeleton": checkpoints.described_skeleton(metadata, tree["offsets"]),
    }  # fmt: skip
    return common, _config(metadata, "autoencoder"), tree, metadata


def _config(metadata: dict, name: str) -> NetworkConfig | None:
    return None if metadata[name] is None else config_from_dict(metadata[name])
