"""Trained models of MotionPCM as files, and the road to them from a preset's name.

    captioned clips -> autoencoder -> latents -> teacher -> student

Each stage leaves one file that is whole in itself, with the autoencoder that it stands on.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from f3amd_lib.data.text_encoders import TextEncoder
from f3amd_lib.data.text_motions import TextMotions, clip_table
from f3amd_lib.diffusion.schedules import NoiseSchedule, schedule_from_dict
from f3amd_lib.ground.profiles import Profile
from f3amd_lib.ground.records import run_record
from f3amd_lib.motion.skeleton import Skeleton
from f3amd_lib.networks import presets
from f3amd_lib.networks.motionpcm import LatentAutoencoderConfig, LatentDenoiserConfig
from f3amd_lib.networks.presets import Preset, config_from_dict
from f3amd_lib.training.checkpoints import (
    describe_skeleton,
    described_skeleton,
    errors_name,
    load_tree,
    network_with,
    packed_shapes,
    packed_weights,
    save_tree,
    unpacked_weights,
    weights_digest,
    weights_shapes,
)
from f3amd_lib.training.latent_motion import (
    DistillationTask,
    FrameStatistics,
    LatentAutoencoderTask,
    LatentTable,
    TeacherTask,
    latent_motion_recipe,
    latent_table,
)
from f3amd_lib.training.pipeline import alone_with, train_in_legs
from f3amd_lib.training.text_models import of_this_training, pooled_captions, text_model_files

_KIND = "latent motion model"


@dataclass(frozen=True, eq=False)
class LatentModel:
    """A trained model of MotionPCM: an autoencoder, with a teacher or a student or alone.

    Attributes:
      name: preset.
      autoencoder, autoencoder_params: config and weights.
      statistics: of its features.
      skeleton, fps: of the motion it was trained on.
      record: how it was trained, on what, under what terms; the identity of its task says M and k of a student.
      config, params: of teacher (the moving average) or student; None for an autoencoder alone.
      schedule: the noise schedule it was trained with.
      text_encoder: identity of the encoder whose pooled vectors it reads; zeros stand for no caption.
    """

    name: str
    autoencoder: LatentAutoencoderConfig
    autoencoder_params: Any
    statistics: FrameStatistics
    skeleton: Skeleton
    fps: float
    record: dict
    config: LatentDenoiserConfig | None = None
    params: Any = None
    schedule: NoiseSchedule | None = None
    text_encoder: str = ""


def save_latent_model(path: Path, trained: LatentModel, dtype=jnp.bfloat16) -> None:
    """Write a model; `load_latent_model` gives it back, weights in the precision of the file.

    Args:
      path: file to write.
      trained: the model.
      dtype: of the weights, as for `checkpoints.save_model`.
    """
    tree = {"autoencoder": packed_weights(trained.autoencoder_params, dtype), **trained.statistics._asdict()}
    if trained.config is not None:
        tree["params"] = packed_weights(trained.params, dtype)
    tree["offsets"] = jnp.asarray(trained.skeleton.offsets, jnp.float32)
    metadata = {
        "kind": _KIND,
        "name": trained.name,
        "autoencoder": trained.autoencoder.to_dict(),
        "model": None if trained.config is None else trained.config.to_dict(),
        "diffusion": None if trained.schedule is None else trained.schedule.to_dict(),
        "weights": jnp.dtype(dtype).name,
        "fps": trained.fps,
        "text_encoder": trained.text_encoder,
        **describe_skeleton(trained.skeleton),
        "record": trained.record,
    }
    save_tree(path, tree, metadata)


def load_latent_model(path: Path) -> LatentModel:
    """Read a model written by `save_latent_model`.

    Raises:
      ValueError: naming the file, if it is missing, truncated, damaged or of another kind.
    """
    with errors_name(path):
        tree, metadata = load_tree(path, _template)
        return LatentModel(
            name=metadata["name"],
            autoencoder=config_from_dict(metadata["autoencoder"]),
            autoencoder_params=unpacked_weights(tree["autoencoder"]),
            statistics=FrameStatistics(tree["mean"], tree["deviation"]),
            skeleton=described_skeleton(metadata, tree["offsets"]),
            fps=metadata["fps"],
            record=metadata["record"],
            config=None if metadata["model"] is None else config_from_dict(metadata["model"]),
            params=unpacked_weights(tree["params"]) if "params" in tree else None,
            schedule=None if metadata["diffusion"] is None else schedule_from_dict(metadata["diffusion"]),
            text_encoder=metadata["text_encoder"],
        )


def _template(metadata: dict) -> dict:
    """Return the shapes that a model's description speaks of."""
    if metadata.get("kind") != _KIND:
        raise ValueError(f"holds a {metadata.get('kind')}, not a {_KIND}")
    autoencoder = config_from_dict(metadata["autoencoder"])
    shapes = {"autoencoder": weights_shapes(autoencoder)}
    if metadata["model"] is not None:
        shapes["params"] = weights_shapes(config_from_dict(metadata["model"]))
    numbers = jax.ShapeDtypeStruct((autoencoder.features,), jnp.float32)
    tree = {name: packed_shapes(shape, metadata["weights"]) for name, shape in shapes.items()}
    offsets = jax.ShapeDtypeStruct((len(metadata["joints"]), 3), jnp.float32)
    return tree | {"mean": numbers, "deviation": numbers, "offsets": offsets}


# ------------------------------------------------------------------------------------------------------------- training


def is_latent_preset(name: str) -> bool:
    """Say whether a preset is one that this file trains."""
    return presets.find_preset(name).family in (LatentAutoencoderConfig.family, LatentDenoiserConfig.family)


def stage_of(preset: Preset) -> str:
    """Return "autoencoder", "teacher" or "student"."""
    if preset.family == LatentAutoencoderConfig.family:
        return "autoencoder"
    return "student" if preset.network.get("guidance_features") else "teacher"


def stands_on(preset: Preset) -> str:
    """Return the preset that is trained before this one: a teacher's autoencoder, a student's teacher; "" for none."""
    if stage_of(preset) != "student":
        return preset.latent
    fits = lambda other: (
        other.latent == preset.latent and other.family == preset.family and stage_of(other) == "teacher"
    )
    return next(name for name, other in presets.PRESETS.items() if fits(other))


def captioned_latents(before: LatentModel, data: TextMotions, encoder: TextEncoder, num_frames: int) -> LatentTable:
    """Return the latents of clips with their captions' embeddings; the zero vector stands for no caption."""
    captions = [caption for several in data.captions for caption in several]
    pooled = pooled_captions(captions, encoder)
    model = network_with(before.autoencoder, before.autoencoder_params)
    return latent_table(model, before.statistics, data, pooled, jnp.zeros_like(pooled[0]), num_frames)


def train_latent_model(
    data: TextMotions, encoder: TextEncoder, profile: Profile, name: str, *,
    batch_size: int | None = None, folder=None, **leg,
) -> LatentModel | None:  # fmt: skip
    """Train a preset, and first what it stands on, unless that is finished already.

    A killed training goes on where it was; a finished model is only read.

    Args:
      data: captioned clips.
      encoder: of the captions.
      profile: how long; "gpu" by the paper's recipe, else by the short ones.
      name: of a preset of MotionPCM.
      batch_size: instead of the recipe's.
      folder: where files go instead of `runs/`.
      **leg: stop_at and progress, as for `optimise`.

    Returns:
      The model as its file has it; None where `stop_at` came first.

    Raises:
      ValueError: if a model or a state of other settings lies there, or what it stands on knows other data.
      TrainingDiverged: if the loss stops being a number.
    """
    preset, before = presets.find_preset(name), None
    stage, files = stage_of(preset), text_model_files(profile, preset.name, folder=folder)
    if earlier := stands_on(preset):
        before = train_latent_model(data, encoder, profile, earlier, batch_size=batch_size, folder=folder, **leg)
        if before is None:
            return None
    settings = {"seed": profile.seed} | ({} if batch_size is None else {"batch_size": batch_size})
    recipe = stage if profile.name == "gpu" else f"short-{stage}"
    config = latent_motion_recipe(recipe, profile.train_steps, preset.name, **settings)
    train = data.select(data.members("train"))
    if stage == "autoencoder":
        statistics = FrameStatistics.of(data)
        table, _ = clip_table(train, statistics.normalise(train.redundant_vectors()))
        model = presets.build_config(preset.name, features=table.frames.shape[-1])
        task = LatentAutoencoderTask(model, config, table, statistics, data.fingerprint)
    else:
        statistics, table = before.statistics, captioned_latents(before, train, encoder, config.num_frames)
        stood_on = before.autoencoder_params if stage == "teacher" else before.params
        fingerprint = f"{data.fingerprint} on {weights_digest(stood_on)}"
        if stage == "teacher":
            model = presets.build_config(preset.name, text_width=table.pooled.shape[-1])
            task = TeacherTask(model, config, preset.diffusion, table, fingerprint)
        else:
            task = DistillationTask(before.config, before.params, config, before.schedule, table, fingerprint)
    if files.model.exists():
        return of_this_training(load_latent_model(files.model), task, files)
    record = run_record(
        profile=profile, dataset=data, seed=config.seed, model=preset.name, identity=task.identity(),
        num_train_clips=train.num_clips,
    )  # fmt: skip
    with alone_with(files):
        state, _ = train_in_legs(task, files, record, held_out=None, **leg)
    if int(state.step) < config.num_steps:
        return None
    about = {"skeleton": data.skeleton, "fps": data.fps, "record": record, "statistics": statistics}
    if stage == "autoencoder":
        made = LatentModel(preset.name, model, state.averaged, **about)
    else:
        # A student's moving average is its target; what is used is the student.
        student = stage == "student"
        made = LatentModel(
            preset.name, before.autoencoder, before.autoencoder_params, **about, schedule=task.schedule,
            config=task.student_config if student else task.model_config, text_encoder=encoder.identity,
            params=state.params["student"] if student else state.averaged,
        )  # fmt: skip
    save_latent_model(files.model, made)
    return load_latent_model(files.model)
