"""The road from a preset's name to a trained model of captioned motion, stage by stage.

    ACMDM      captioned clips -> positions -> (autoencoder -> latent) -> denoiser -> (control branch)
    MotionPCM  captioned clips -> autoencoder -> latents -> teacher -> student

Each stage leaves one file that is whole in itself, with the weights of the stages before it. `STAGES` has them all.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from f3amd_lib.ground.profiles import Profile
from f3amd_lib.ground.records import run_record
from f3amd_lib.motion.body import make_body
from f3amd_lib.networks import presets
from f3amd_lib.networks.presets import Preset
from f3amd_lib.text.data.body_mesh import BodyMesh, standing
from f3amd_lib.text.data.redundant import NUM_JOINT_FEATURES
from f3amd_lib.text.data.text_encoders import TextEncoder, embed_captions, words_of
from f3amd_lib.text.data.text_motions import UNIT, AxisNormaliser, TextMotions, clip_table, pad_motions
from f3amd_lib.text.networks.mesh_autoencoder import MeshAutoencoderConfig
from f3amd_lib.text.networks.motion_autoencoder import AutoencoderConfig
from f3amd_lib.text.networks.motionpcm import LatentAutoencoderConfig, LatentDenoiserConfig
from f3amd_lib.text.stages import acmdm_training, motionpcm_training
from f3amd_lib.text.stages.motion_codec import MotionCodec, with_latent
from f3amd_lib.text.stages.text_models import (
    DENOISERS,
    PELVIS,
    CaptionedModel,
    LatentModel,
    TextModel,
    controlled_joints,
    load_text_model,
    preset_and_branch,
    save_text_model,
    shipped_for,
    text_model_files,
)
from f3amd_lib.training.checkpoints import network_with, weights_digest
from f3amd_lib.training.optimise import Task, TrainingState, differences
from f3amd_lib.training.pipeline import alone_with, train_in_legs
from f3amd_lib.training.settings import profile_part_recipe

_ENCODED_AT_ONCE = 64


@dataclass(frozen=True)
class Asked:
    """What is to be trained, and on what.

    Attributes:
      data, encoder: captioned clips, and what embeds captions.
      preset, branch: the model, and what follows its name (`preset_and_branch`).
      config: how it is trained.
      before: the finished model that it stands on, None for none.
      codec: between motion and the states of ACMDM, as far as it is known before this stage; None for MotionPCM.
      window: most frames of motion in a state of ACMDM, instead of the preset's.
    """

    data: TextMotions
    encoder: TextEncoder
    preset: Preset
    branch: str
    config: Any
    before: TextModel | LatentModel | None
    codec: MotionCodec | None
    window: int | None

    def part(self, split: str | None) -> TextMotions:
        """Return the clips of a split; None is for a task that is only compared, which takes those of training."""
        return self.data.select(self.data.members(split or "train"))

    @functools.cached_property
    def statistics(self) -> AxisNormaliser:
        """Mean and deviation of redundant vectors, for MotionPCM."""
        return motionpcm_training.frame_statistics(self.data) if self.before is None else self.before.statistics

    def told(self) -> dict:
        """Return what a model that reads captions says of them."""
        said = [caption for several in self.part("train").captions for caption in several]
        return {"text_encoder": self.encoder.identity, "words": words_of(said)}


# ---------------------------------------------------------------------------------------------------------------- data


def _whole_states(codec: MotionCodec, data: TextMotions) -> list[np.ndarray]:
    """Return the normalised positions of each clip, as many as make whole frames of the state."""
    frames = codec.frames_per_state
    clips = (data.clip(number) for number in range(data.num_clips))
    return [codec.axes.normalise(clip[: len(clip) // frames * frames]) for clip in clips]


def encoded_clips(codec: MotionCodec, data: TextMotions) -> np.ndarray:
    """Return all clips as states, one after the other, [N / frames of a state, J, C]."""
    frames, clips = codec.frames_per_state, _whole_states(codec, data)
    if codec.redundancy is not None:
        return np.concatenate([np.concatenate(clips), codec.redundancy.normalise(data.joint_features())], axis=-1)
    if codec.autoencoder is None:
        return np.concatenate(clips)
    encode, longest, parts = jax.jit(lambda codec, *given: codec.encode(*given)), max(map(len, clips)), []
    if codec.mesh is not None:  # frames do not see each other: nothing is padded
        whole = np.concatenate(clips)[None]
        return np.asarray(encode(codec, whole, np.ones(whole.shape[:2], bool)))[0]
    for first in range(0, len(clips), _ENCODED_AT_ONCE):
        part = clips[first : first + _ENCODED_AT_ONCE]
        padded = pad_motions([*part, *[part[0]] * (_ENCODED_AT_ONCE - len(part))], longest)
        states = np.asarray(encode(codec, padded.motion, padded.mask))
        parts += [state[: len(clip) // frames] for state, clip in zip(states, part, strict=False)]
    return np.concatenate(parts)


def _captioned_states(asked: Asked, split: str | None):
    """Return (clips of a split as states, pooled embeddings of their captions)."""
    codec, part = asked.codec, asked.part(split)
    table, captions = clip_table(part, encoded_clips(codec, part), codec.frames_per_state)
    return table, pooled_captions(captions, asked.encoder)


def pooled_captions(captions: Sequence[str], encoder: TextEncoder) -> jax.Array:
    """Return the pooled embedding of each caption, [N, W]; those that are said twice are embedded once."""
    unlike, place = np.unique(captions, return_inverse=True)
    return jnp.asarray(embed_captions(unlike.tolist(), encoder).pooled[place])


# --------------------------------------------------------------------------------------------------------------- ACMDM


def autoencoder_task(asked: Asked, split: str | None) -> acmdm_training.AutoencoderTask:
    """Return the training of an autoencoder on the clips of a split."""
    data, part, name, config = asked.data, asked.part(split), asked.preset.name, asked.config
    table, _ = clip_table(part, asked.codec.axes.normalise(part.positions))
    if asked.preset.family != MeshAutoencoderConfig.family:
        if len(part.lengths) and part.lengths.max() < config.window:
            lengths = f"no {split or 'train'} clip has {config.window} frames, the longest has {part.lengths.max()}"
            raise ValueError(f"data set {data.name!r}: {lengths}; {name} needs longer ones, or a larger --window")
        model = presets.build_config(name)
        return acmdm_training.AutoencoderTask(model, config, table, dataset_fingerprint=data.fingerprint)
    # The body stands as people do when clips begin: those of training, whatever the split.
    rest = standing(data.skeleton, data.positions[data.start[data.members("train")]])
    model = presets.build_config(name, num_vertices=len(make_body(rest).vertices))
    codec = dataclasses.replace(asked.codec, mesh=BodyMesh.of(rest, model.levels, **model.neighbours))
    return acmdm_training.MeshAutoencoderTask(model, config, table, codec, dataset_fingerprint=data.fingerprint)


def autoencoder_model(asked: Asked, task: acmdm_training.AutoencoderTask, state: TrainingState, about) -> TextModel:
    """Return a trained autoencoder, its latent normalised over up to 512 training clips."""
    part = asked.data.members("train")
    part = part[np.linspace(0, len(part) - 1, min(512, len(part))).astype(int)]
    frames, codec = task.model_config.frames_per_latent, getattr(task, "codec", asked.codec)
    clips = [codec.axes.normalise(asked.data.clip(number)) for number in part]
    padded = pad_motions(clips, max(map(len, clips)) // frames * frames)
    codec = with_latent(codec, task.model_config, state.averaged, padded.motion, padded.mask)
    return TextModel(codec=codec, **about)


def denoiser_task(asked: Asked, split: str | None) -> acmdm_training.TextMotionTask:
    """Return the training of a denoiser on the clips of a split; ValueError for states of other channels than its."""
    (table, pooled), codec, preset = _captioned_states(asked, split), asked.codec, asked.preset
    sizes = {"num_joints": table.frames.shape[1], "text_width": pooled.shape[-1]}
    if asked.window:
        sizes["window"] = asked.window // codec.frames_per_state
    model = presets.build_config(preset.name, **sizes)
    if (channels := table.frames.shape[-1]) != model.channels:
        raise ValueError(f"{preset.name} models {model.channels} numbers a joint; positions have {channels}")
    fingerprint = asked.data.fingerprint
    if codec.autoencoder is not None:
        fingerprint += f" in the latent of {weights_digest(codec.params)}"
    return acmdm_training.TextMotionTask(
        model, asked.config, table, preset.diffusion, pooled, dataset_fingerprint=fingerprint
    )


def denoiser_model(asked: Asked, task: acmdm_training.TextMotionTask, state: TrainingState, about) -> TextModel:
    """Return a trained denoiser: its moving average."""
    starts = first_frames(asked.codec, asked.part("train"), asked.config.prefix_frames)
    return TextModel(
        codec=asked.codec, config=task.model_config, params=state.averaged, schedule=task.schedule, starts=starts,
        **asked.told(), **about,
    )  # fmt: skip


def first_frames(codec: MotionCodec, data: TextMotions, count: int) -> dict[str, np.ndarray]:
    """Return the first frames of one clip of each pair of content and style, by its first caption, as states.

    Args:
      codec: of the states.
      data: captioned clips.
      count: frames of the state, P; 0 returns nothing.

    Returns:
      [P, J, C] each.
    """
    if not count:
        return {}
    frames = count * codec.frames_per_state
    long_enough = [number for number in range(data.num_clips) if data.lengths[number] >= frames]
    shown = {data.pairs[number]: number for number in reversed(long_enough)}.values()
    clips = jnp.asarray(np.stack([codec.axes.normalise(data.clip(number)[:frames]) for number in shown]))
    states = np.asarray(codec.encode(clips, jnp.ones(clips.shape[:2], bool)))
    return {data.captions[number][0]: state for number, state in zip(shown, states, strict=True)}


def control_task(asked: Asked, split: str | None) -> acmdm_training.ControlTask:
    """Return the training of a branch beside a finished denoiser, on the clips of a split."""
    base, codec, frames = asked.before, asked.codec, asked.codec.frames_per_state
    table, pooled = _captioned_states(asked, split)
    positions = jnp.asarray(np.concatenate(_whole_states(codec, asked.part(split))), jnp.float32)
    positions = positions.reshape(len(table.frames), frames, *positions.shape[1:])
    joints = (0,) if asked.branch == PELVIS else tuple(controlled_joints(asked.data.skeleton).values())
    fingerprint = f"{asked.data.fingerprint} beside {weights_digest(base.params)}"
    return acmdm_training.ControlTask(
        base.config, asked.config, table._replace(frames=(table.frames, positions)), base.schedule, pooled, base.params,
        codec, joints, dataset_fingerprint=fingerprint,
    )  # fmt: skip


def control_model(asked: Asked, task: Task, state: TrainingState, about) -> TextModel:
    """Return a denoiser with its trained branch, told the guidance that it was told before."""
    kept = {key: asked.before.record[key] for key in ("guidance",) if key in asked.before.record}
    return dataclasses.replace(asked.before, branch=state.averaged, name=about["name"], record=about["record"] | kept)


# ----------------------------------------------------------------------------------------------------------- MotionPCM


def _latents(asked: Asked, split: str | None) -> motionpcm_training.LatentTable | None:
    """Return the latents and captions of a split's clips; None where nothing is trained, since that takes minutes."""
    if split is None:
        return None
    before, part = asked.before, asked.part(split)
    pooled = pooled_captions([caption for several in part.captions for caption in several], asked.encoder)
    model, nothing = network_with(before.autoencoder, before.autoencoder_params), jnp.zeros_like(pooled[0])
    return motionpcm_training.latent_table(model, asked.statistics, part, pooled, nothing, asked.config.num_frames)


def latent_autoencoder_task(asked: Asked, split: str | None) -> motionpcm_training.LatentAutoencoderTask:
    """Return the training of MotionPCM's autoencoder on the clips of a split."""
    part, clips, statistics = asked.part(split), None, None
    if split is not None:
        statistics = asked.statistics
        clips, _ = clip_table(part, statistics.normalise(part.redundant_vectors()))
    return motionpcm_training.LatentAutoencoderTask(
        presets.build_config(asked.preset.name, features=12 * part.skeleton.num_joints - 1), asked.config, clips,
        statistics, dataset_fingerprint=asked.data.fingerprint,
    )  # fmt: skip


def latent_autoencoder_model(asked: Asked, task: Task, state: TrainingState, about) -> LatentModel:
    """Return MotionPCM's autoencoder."""
    weights = {"autoencoder": task.model_config, "autoencoder_params": state.averaged}
    return LatentModel(statistics=asked.statistics, **weights, **about)


def teacher_task(asked: Asked, split: str | None) -> motionpcm_training.TeacherTask:
    """Return the training of a teacher on the latents of a split's clips."""
    width = pooled_captions(["a person walks"], asked.encoder).shape[-1]
    return motionpcm_training.TeacherTask(
        presets.build_config(asked.preset.name, text_width=width), asked.config, _latents(asked, split),
        asked.preset.diffusion,
        dataset_fingerprint=f"{asked.data.fingerprint} on {weights_digest(asked.before.autoencoder_params)}",
    )  # fmt: skip


def teacher_model(asked: Asked, task: motionpcm_training.TeacherTask, state: TrainingState, about) -> LatentModel:
    """Return a trained teacher: its moving average."""
    made = {"schedule": task.schedule, "config": task.model_config, "params": state.averaged}
    return dataclasses.replace(asked.before, **made, **asked.told(), **about)


def student_task(asked: Asked, split: str | None) -> motionpcm_training.DistillationTask:
    """Return the distillation of a student from its teacher, on the latents of a split's clips."""
    teacher = asked.before
    return motionpcm_training.DistillationTask(
        teacher.config, asked.config, _latents(asked, split), teacher.schedule, teacher.params,
        dataset_fingerprint=f"{asked.data.fingerprint} on {weights_digest(teacher.params)}",
    )  # fmt: skip


def student_model(asked: Asked, task: motionpcm_training.DistillationTask, state: TrainingState, about) -> LatentModel:
    """Return a trained student itself: its moving average was its target."""
    return dataclasses.replace(
        asked.before, config=task.student_config, params=state.params["student"], **asked.told(), **about
    )


# ------------------------------------------------------------------------------------------------------------ training


class Stage(NamedTuple):
    """How one kind of model is trained.

    Attributes:
      settings, recipe: class of the training's settings, and its recipe in `papers/<paper>/recipes.toml`.
      task: `task(asked, split)`, what trains it on the clips of a split.
      model: `model(asked, task, state, about)`, what is kept of a finished training.
    """

    settings: type
    recipe: str
    task: Callable[[Asked, str | None], Task]
    model: Callable[[Asked, Task, TrainingState, dict], CaptionedModel]


_ACMDM, _PCM = acmdm_training.TextMotionTraining, motionpcm_training.LatentMotionTraining
STAGES = {
    "autoencoder": Stage(_ACMDM, "autoencoder", autoencoder_task, autoencoder_model),
    "mesh autoencoder": Stage(_ACMDM, "mesh-autoencoder", autoencoder_task, autoencoder_model),
    "denoiser": Stage(_ACMDM, "denoiser", denoiser_task, denoiser_model),
    "control branch": Stage(_ACMDM, "control", control_task, control_model),
    "latent autoencoder": Stage(_PCM, "autoencoder", latent_autoencoder_task, latent_autoencoder_model),
    "teacher": Stage(_PCM, "teacher", teacher_task, teacher_model),
    "student": Stage(_PCM, "student", student_task, student_model),
}

_STAGE_OF = dict.fromkeys(DENOISERS, "denoiser") | {
    AutoencoderConfig.family: "autoencoder", MeshAutoencoderConfig.family: "mesh autoencoder",
    LatentAutoencoderConfig.family: "latent autoencoder", LatentDenoiserConfig.family: "teacher",
}  # fmt: skip


def stage_of(name: str) -> str:
    """Return the stage of `STAGES` that trains a preset, with or without a branch; ValueError for others' presets."""
    base, branch = preset_and_branch(name)
    preset = presets.find_preset(base)
    if preset.family not in _STAGE_OF:
        raise ValueError(f"{name} needs no captions: train it by a call of its own")
    if branch:
        return "control branch"
    return "student" if preset.network.get("guidance_features") else _STAGE_OF[preset.family]


def stands_on(name: str) -> str:
    """Return the preset that is trained before this one: its autoencoder, a student's teacher, a branch's denoiser."""
    base, branch = preset_and_branch(name)
    preset = presets.find_preset(base)
    if branch:
        return preset.name
    if stage_of(name) != "student":
        return preset.latent
    fits = lambda other: other.latent == preset.latent and stage_of(other.name) == "teacher"
    return next(name for name, other in presets.PRESETS.items() if fits(other))


def _named_teacher(path, preset: Preset, data: TextMotions) -> LatentModel:
    """Read the teacher of a student; ValueError for what is no student, no teacher, or knows other clips."""
    if stage_of(preset.name) != "student":
        raise ValueError(f"{preset.name} is no student and has no teacher: leave --teacher out")
    before, wanted = load_text_model(path), stands_on(preset.name)
    if before.name != wanted:
        raise ValueError(f"{path}: holds {before.name}, but {preset.name} is distilled from {wanted}")
    if not before.record["identity"]["dataset_fingerprint"].startswith(data.fingerprint):
        raise ValueError(f"{path}: was trained on other clips than these; leave --teacher out to train one")
    return before


def _codec_of_positions(data: TextMotions, preset: Preset) -> MotionCodec:
    """Return the codec of positions, and of redundant features beside them where a preset has channels for those."""
    redundancy = None
    if preset.network.get("channels") == 3 + NUM_JOINT_FEATURES:
        redundancy = AxisNormaliser.of(data.select(data.members("train")).joint_features())
    return MotionCodec(data.normaliser(), redundancy=redundancy)


def train_stage(
    data: TextMotions, encoder: TextEncoder, profile: Profile, name: str, *,
    window: int | None = None, batch_size: int | None = None, folder=None, teacher=None, **leg,
) -> TextModel | LatentModel | None:  # fmt: skip
    """Train a preset, and first what it stands on, unless that is finished already; of ACMDM with whatever settings.

    A branch may stand beside the network that ships, where that knows these motions. A killed training goes on where it
    was; a finished model is only read.

    Args:
      data: captioned clips.
      encoder: of the captions.
      profile: how long, each stage its recipe's share of it; "gpu" by the paper's recipe, else by the short ones.
      name: of a preset of ACMDM, perhaps with "+control" or "+control-pelvis" behind it, or of MotionPCM.
      window: of ACMDM, most frames of motion in a state, instead of the preset's; longer clips are cut to their first
        frames, so that all begin where a caption's motion will: at the origin.
      batch_size: instead of the recipe's.
      folder: where files go instead of `runs/`.
      teacher: file of the teacher that a student is distilled from, such as one that ships, instead of training one.
      **leg: stop_at and progress, as for `optimise`.

    Returns:
      The model as its file has it; None where `stop_at` came first.

    Raises:
      ValueError: if a model or a state of other settings lies there, or what it stands on knows other data, or a
        teacher is named for what is no student.
      TrainingDiverged: if the loss stops being a number.
    """
    base, branch = preset_and_branch(name)
    preset, stage, earlier = presets.find_preset(base), STAGES[stage_of(name)], stands_on(name)
    if branch and preset.latent and stage_of(preset.latent) == "mesh autoencoder":
        raise ValueError(f"{preset.name} has no control branch: its states are of vertices, not of joints")
    name, acmdm = preset.name + branch, stage.settings is _ACMDM
    data = data.cut(window) if acmdm and window and window < data.lengths.max() else data
    before = None
    if teacher is not None:
        before = _named_teacher(teacher, preset, data)
    elif earlier:
        lies = text_model_files(profile, earlier, folder=folder).model
        before = load_text_model(lies) if acmdm and lies.exists() else None
        if before is None and branch:
            before = shipped_for(earlier, data, encoder)
        how = {"window": window, "batch_size": batch_size, "folder": folder, **leg}
        before = before or train_stage(data, encoder, profile, earlier, **how)
        if before is None:
            return None
        if acmdm and before.record["dataset_fingerprint"] != data.fingerprint:
            raise ValueError(f"{lies}: was trained on other data; move it away or name another folder (--out)")
    settings, codec = {"batch_size": batch_size}, None
    if acmdm:
        codec = _codec_of_positions(data, preset) if before is None else before.codec
        settings["unit"] = max(1, UNIT // codec.frames_per_state)
    own = None if branch else preset.name
    config = profile_part_recipe(stage.settings, stage.recipe, profile, own, **settings)
    asked = Asked(data, encoder, preset, branch, config, before, codec, window)
    files = text_model_files(profile, name, folder=folder)
    if files.model.exists():
        found = load_text_model(files.model)
        if unlike := differences(stage.task(asked, None).identity(), found.record["identity"]):
            lies = f"a model with other {'; '.join(unlike)} lies there"
            raise ValueError(f"{files.model}: {lies}; move it away or name another folder (--out)")
        return found
    task, held_out = stage.task(asked, "train"), stage.task(asked, "validation").held_out()
    record = run_record(
        profile=profile, dataset=data, seed=config.seed, model=name, identity=task.identity(),
        num_train_clips=len(data.members("train")),
    )  # fmt: skip
    with alone_with(files):
        state, _ = train_in_legs(task, files, record, held_out=held_out, **leg)
    if int(state.step) < config.num_steps:
        return None
    about = {"name": name, "skeleton": data.skeleton, "fps": data.fps, "record": record}
    save_text_model(files.model, stage.model(asked, task, state, about))
    return load_text_model(files.model)
