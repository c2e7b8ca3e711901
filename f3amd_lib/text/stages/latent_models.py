"""Trained models of MotionPCM as files, and the road to them from a preset's name.

    captioned clips -> autoencoder -> latents -> teacher -> student

Each stage leaves one file that is whole in itself, with the autoencoder that it stands on.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from f3amd_lib.ground.profiles import Profile
from f3amd_lib.networks import presets
from f3amd_lib.networks.presets import Preset
from f3amd_lib.text.data.text_encoders import TextEncoder, words_of
from f3amd_lib.text.data.text_motions import AxisNormaliser, ClipTable, TextMotions, clip_table, draw_clips
from f3amd_lib.text.networks.motionpcm import LatentAutoencoderConfig, LatentDenoiserConfig
from f3amd_lib.text.stages import motionpcm_training
from f3amd_lib.text.stages.captioned_models import (
    CaptionedModel,
    load_captioned_model,
    save_captioned_model,
    train_part,
)
from f3amd_lib.text.stages.text_models import newest_weights, of_this_training, pooled_captions, text_model_files
from f3amd_lib.training.checkpoints import errors_name, network_with, weights_digest
from f3amd_lib.training.settings import profile_part_recipe

KIND = "latent motion model"
"""What a file of this module says that it holds."""


@dataclass(frozen=True, eq=False, kw_only=True)
class LatentModel(CaptionedModel):
    """A trained model of MotionPCM: an autoencoder, with a teacher or a student or alone.

    Its weights are a teacher's moving average, or a student's own. For the text encoder zeros stand for no caption. The
    identity of its task, in the record, says M and k of a student.

    Attributes:
      autoencoder, autoencoder_params: config and weights.
      statistics: of its features.
    """

    autoencoder: LatentAutoencoderConfig
    autoencoder_params: Any
    statistics: AxisNormaliser

    @property
    def training(self) -> dict:
        """How it was trained: the settings of `LatentMotionTraining`."""
        return self.record["identity"]["training"]

    @property
    def most_frames(self) -> int:
        """Frames of the longest clip that it was trained on."""
        return self.training["num_frames"]


def save_latent_model(path: Path, trained: LatentModel, dtype=jnp.bfloat16) -> None:
    """Write a model; `load_latent_model` gives it back, weights in the precision of the file.

    Args:
      path: file to write.
      trained: the model.
      dtype: of the weights, as for `checkpoints.save_model`.
    """
    weights = {"autoencoder": trained.autoencoder_params}
    save_captioned_model(
        path, KIND, trained, autoencoder=trained.autoencoder, weights=weights, arrays=trained.statistics._asdict(),
        extra={}, dtype=dtype,
    )  # fmt: skip


def load_latent_model(path: Path) -> LatentModel:
    """Read a model written by `save_latent_model`.

    Raises:
      ValueError: naming the file, if it is missing, truncated, damaged or of another kind.
    """
    with errors_name(path):
        common, autoencoder, tree, _ = load_captioned_model(path, KIND, _shapes)
        statistics = AxisNormaliser(tree["mean"], tree["deviation"])
        return LatentModel(
            autoencoder=autoencoder, autoencoder_params=tree["autoencoder"], statistics=statistics, **common
        )


def _shapes(metadata: dict, config: LatentDenoiserConfig | None, autoencoder: LatentAutoencoderConfig):
    """Return the shapes of further weights, and of the statistics."""
    numbers = jax.ShapeDtypeStruct((autoencoder.features,), jnp.float32)
    return {}, {"mean": numbers, "deviation": numbers}


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


STUDENTS = {phases: f"MotionPCM-M{phases}-small" for phases in (1, 2, 4)}
"""The models that `f3amd text --model motionpcm` means, by --steps: a student is trained for one number of them."""


def named_model(name: str, num_steps: int | None = None) -> str:
    """Return the preset that a user means.

    Args:
      name: of a teacher's or a student's preset, or of the paper, "motionpcm".
      num_steps: asked for; of the paper's students it chooses one, by default that of one step.

    Raises:
      ValueError: for an unknown name, or a number of steps that no student takes.
    """
    if name.lower() != "motionpcm":
        return presets.find_preset(name).name
    if (steps := num_steps or 1) not in STUDENTS:
        *some, last = STUDENTS
        raise ValueError(
            f"students of MotionPCM are trained for {', '.join(map(str, some))} or {last} steps, none for {steps}; "
            "their teacher takes any number: --model MotionPCM-teacher-small"
        )
    return STUDENTS[steps]


def find_latent_model(dataset: str, name: str, num_steps: int | None = None) -> Path:
    """Return the weights file of a data set: the user's own gpu or laptop run, else shipped.

    Args:
      dataset: that it was trained on.
      name, num_steps: as of `named_model`.

    Raises:
      ValueError: as `named_model`, or if there is no file, saying how to train it.
    """
    name = named_model(name, num_steps)
    return newest_weights(dataset, [[name]], name)


def _clips(part: TextMotions, encoder: TextEncoder, before: LatentModel | None, statistics, config):
    """Return the clips of a split as a stage draws them: vectors for the autoencoder, else latents and captions."""
    if before is None:
        return clip_table(part, statistics.normalise(part.redundant_vectors()))[0]
    pooled = pooled_captions([caption for several in part.captions for caption in several], encoder)
    model, nothing = network_with(before.autoencoder, before.autoencoder_params), jnp.zeros_like(pooled[0])
    return motionpcm_training.latent_table(model, statistics, part, pooled, nothing, config.num_frames)


def held_out_clips(clips: ClipTable | motionpcm_training.LatentTable, config: motionpcm_training.LatentMotionTraining):
    """Return a batch of other clips for the losses on them: (features, mask), or (latents, captions)."""
    if isinstance(clips, motionpcm_training.LatentTable):
        return clips.draw(jax.random.key(0), config.batch_size)
    batch = draw_clips(jax.random.key(0), clips, config.batch_size, config.num_frames)
    return batch.motion, batch.mask


def _task(preset: Preset, config, data: TextMotions, encoder: TextEncoder, before: LatentModel | None):
    """Return the training of a preset's stage, still without clips; `before` is what it stands on, or None."""
    stage = stage_of(preset)
    if stage == "autoencoder":
        model = presets.build_config(preset.name, features=12 * data.skeleton.num_joints - 1)
        return motionpcm_training.LatentAutoencoderTask(model, config, None, None, dataset_fingerprint=data.fingerprint)
    fingerprint = f"{data.fingerprint} on "
    if stage == "teacher":
        width = pooled_captions(["a person walks"], encoder).shape[-1]
        model = presets.build_config(preset.name, text_width=width)
        fingerprint += weights_digest(before.autoencoder_params)
        return motionpcm_training.TeacherTask(model, config, None, preset.diffusion, dataset_fingerprint=fingerprint)
    fingerprint += weights_digest(before.params)
    return motionpcm_training.DistillationTask(
        before.config, config, None, before.schedule, before.params, dataset_fingerprint=fingerprint
    )


def _named_teacher(path, preset: Preset, data: TextMotions) -> LatentModel:
    """Read the teacher of a student; ValueError for what is no student, no teacher, or knows other clips."""
    if stage_of(preset) != "student":
        raise ValueError(f"{preset.name} is no student and has no teacher: leave --teacher out")
    before = load_latent_model(path)
    wanted = stands_on(preset)
    if before.name != wanted:
        raise ValueError(f"{path}: holds {before.name}, but {preset.name} is distilled from {wanted}")
    if not before.record["identity"]["dataset_fingerprint"].startswith(data.fingerprint):
        raise ValueError(f"{path}: was trained on other clips than these; leave --teacher out to train one")
    return before


def train_latent_model(
    data: TextMotions, encoder: TextEncoder, profile: Profile, name: str, *,
    batch_size: int | None = None, folder=None, teacher=None, **leg,
) -> LatentModel | None:  # fmt: skip
    """Train a preset, and first what it stands on, unless that is finished already.

    A killed training goes on where it was; a finished model is only read.

    Args:
      data: captioned clips.
      encoder: of the captions.
      profile: how long, each stage its recipe's share of it; "gpu" by the paper's recipe, else by the short ones.
      name: of a preset of MotionPCM.
      batch_size: instead of the recipe's.
      folder: where files go instead of `runs/`.
      teacher: file of the teacher that a student is distilled from, such as one that ships, instead of training one.
      **leg: stop_at and progress, as for `optimise`.

    Returns:
      The model as its file has it; None where `stop_at` came first.

    Raises:
      ValueError: if a model or a state of other settings lies there, or the teacher that was named is none of these
        clips, or is named for what is no student.
      TrainingDiverged: if the loss stops being a number.
    """
    preset, before = presets.find_preset(name), None
    stage, files = stage_of(preset), text_model_files(profile, preset.name, folder=folder)
    if teacher is not None:
        before = _named_teacher(teacher, preset, data)
    elif earlier := stands_on(preset):
        before = train_latent_model(data, encoder, profile, earlier, batch_size=batch_size, folder=folder, **leg)
        if before is None:
            return None
    config = profile_part_recipe(motionpcm_training.LatentMotionTraining, stage, profile, preset.name, batch_size)
    # A finished model is only read, and its clips need not be encoded for that.
    task = _task(preset, config, data, encoder, before)
    if files.model.exists():
        return of_this_training(load_latent_model(files.model), task, files)
    statistics = motionpcm_training.frame_statistics(data) if before is None else before.statistics
    clips, watched = (_clips(data.select(data.members(split)), encoder, before, statistics, config)
                      for split in ("train", "validation"))  # fmt: skip
    task = dataclasses.replace(task, clips=clips, **({"statistics": statistics} if before is None else {}))
    state, about = train_part(task, files, data, profile, preset.name, held_out_clips(watched, config), **leg)
    if state is None:
        return None
    if stage == "autoencoder":
        made = LatentModel(
            autoencoder=task.model_config, autoencoder_params=state.averaged, statistics=statistics, **about
        )
    else:
        # A student's moving average is its target; what is used is the student.
        student = stage == "student"
        said = [caption for clip in data.members("train") for caption in data.captions[clip]]
        made = dataclasses.replace(
            before, **about, schedule=task.schedule, text_encoder=encoder.identity, words=words_of(said),
            config=task.student_config if student else task.model_config,
            params=state.params["student"] if student else state.averaged,
        )  # fmt: skip
    save_latent_model(files.model, made)
    return load_latent_model(files.model)
