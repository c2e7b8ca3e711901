"""Trained models of text to motion as files, and the road to them from a preset's name.

    captioned clips -> normalised positions -> (autoencoder -> latent) -> denoiser -> (control branch)

Each stage leaves one file that is whole in itself, with the weights of the stages before it. A preset's name with
"+control" behind it stands for the branch beside the finished model of that name, with "+control-pelvis" for one that
knows the pelvis alone.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from f3amd_lib.data.packed import packed_dataset
from f3amd_lib.data.sources import open_dataset
from f3amd_lib.ground.names import nearest_hint
from f3amd_lib.ground.profiles import Profile, runs_dir
from f3amd_lib.motion.body import make_body
from f3amd_lib.motion.skeleton import Skeleton
from f3amd_lib.networks import presets
from f3amd_lib.text.data.body_mesh import BodyMesh, standing
from f3amd_lib.text.data.humanml3d import read_humanml3d
from f3amd_lib.text.data.redundant import NUM_JOINT_FEATURES
from f3amd_lib.text.data.text_encoders import TextEncoder, embed_captions, words_of
from f3amd_lib.text.data.text_motions import (
    UNIT,
    AxisNormaliser,
    TextMotions,
    bandai_text_motions,
    clip_table,
    pad_motions,
)
from f3amd_lib.text.networks.acmdm import ACMDM, ACMDMConfig
from f3amd_lib.text.networks.acmdm_control import ControlBranch
from f3amd_lib.text.networks.masked_acmdm import MaskedACMDM, MaskedACMDMConfig
from f3amd_lib.text.networks.mesh_autoencoder import MeshAutoencoderConfig
from f3amd_lib.text.networks.motion_autoencoder import AutoencoderConfig
from f3amd_lib.text.stages import acmdm_training
from f3amd_lib.text.stages.captioned_models import (
    CaptionedModel,
    load_captioned_model,
    save_captioned_model,
    train_part,
)
from f3amd_lib.text.stages.motion_codec import MotionCodec, with_latent
from f3amd_lib.training.checkpoints import errors_name, network_with, weights_digest
from f3amd_lib.training.optimise import Task, differences
from f3amd_lib.training.pipeline import PRETRAINED_DIR, ModelFiles
from f3amd_lib.training.settings import profile_part_recipe

CONTROL = "+control"
"""Behind a preset's name: the model with its control branch."""

PELVIS = f"{CONTROL}-pelvis"
"""The same with a branch that learns to control the pelvis alone (ACMDM Table 3, "trained on pelvis")."""

CONTROLLED = {"left_foot": "left_toe", "right_foot": "right_toe"} | {
    name: name for name in ("head", "left_wrist", "right_wrist")
}
"""Joints that a branch learns to control besides the pelvis (ACMDM section 3.2): their names on the command line, and
their roles in a skeleton."""

_KIND = "text-to-motion model"
_ENCODED_AT_ONCE = 64


@dataclass(frozen=True, eq=False, kw_only=True)
class TextModel(CaptionedModel):
    """A trained model of text to motion, or a motion autoencoder alone.

    Its name has "+control" or "+control-pelvis" at its end where there is a branch; weights are the moving average.

    Attributes:
      codec: between motion and the network's states: normaliser and autoencoder.
      starts: of the prefix form alone: by caption, first frames of a clip to go on from, states [P, J, C].
      branch: weights of the control branch, None without one.
    """

    codec: MotionCodec
    starts: dict = field(default_factory=dict)
    branch: Any = None

    def network(self) -> ACMDM | MaskedACMDM:
        """Return the denoiser with its weights."""
        return network_with(self.config, self.params)

    def control_branch(self) -> ControlBranch:
        """Return the control branch with its weights; ValueError says how to train one if there is none."""
        if self.branch is None:
            raise ValueError(f"{self.name} has no control branch; train one: f3amd train --preset {self.name}{CONTROL}")
        return acmdm_training.branch_with(self.config, self.codec, self.branch)

    @property
    def controlled(self) -> dict[str, int]:
        """The joints that its control branch knows, by their names on the command line."""
        pelvis_alone = preset_and_branch(self.name)[1] == PELVIS
        return {"pelvis": 0} if pelvis_alone else controlled_joints(self.skeleton)

    @property
    def most_frames(self) -> int:
        """Frames of motion in the longest state."""
        return self.config.window * self.codec.frames_per_state


def controlled_joints(skeleton: Skeleton) -> dict[str, int]:
    """Return the joints that a branch learns to control, by their names on the command line; the pelvis is the root."""
    return {"pelvis": 0} | {name: skeleton.role(role) for name, role in CONTROLLED.items() if skeleton.has_role(role)}


def preset_and_branch(name: str) -> tuple[str, str]:
    """Return a preset's name and what follows it: nothing, `CONTROL` or `PELVIS`; ValueError for another branch."""
    preset, plus, which = name.partition(CONTROL)
    if (branch := plus + which) not in ("", CONTROL, PELVIS):
        raise ValueError(f"unknown branch {branch!r} in {name!r}{nearest_hint(branch, (CONTROL, PELVIS))}")
    return preset, branch


# --------------------------------------------------------------------------------------------------------------- files


def save_text_model(path: Path, trained: TextModel, dtype=jnp.bfloat16) -> None:
    """Write a model; `load_text_model` gives it back, weights in the precision of the file.

    Args:
      path: file to write.
      trained: the model.
      dtype: of the weights, as for `checkpoints.save_model`.
    """
    codec = trained.codec
    normalisers = {"axes": codec.axes, "latent": codec.latent, "redundancy": codec.redundancy}
    arrays = {what: normaliser._asdict() for what, normaliser in normalisers.items() if normaliser is not None}
    if codec.mesh is not None:
        arrays["rest"] = jnp.asarray(codec.mesh.skeleton.offsets, jnp.float32)
    arrays["starts"] = {caption: jnp.asarray(state, jnp.float32) for caption, state in trained.starts.items()}
    extra = {
        "controlled": trained.branch is not None,
        "start_shapes": {caption: list(np.shape(state)) for caption, state in trained.starts.items()},
        "neighbours": None if codec.mesh is None else weights_digest(codec.mesh.lists),
    }
    weights = {"autoencoder": codec.params, "branch": trained.branch}
    save_captioned_model(
        path, _KIND, trained, autoencoder=codec.autoencoder, weights=weights, arrays=arrays, extra=extra, dtype=dtype
    )


def load_text_model(path: Path) -> TextModel:
    """Read a model written by `save_text_model`.

    Raises:
      ValueError: naming the file, if it is missing, truncated, damaged or of another kind.
    """
    with errors_name(path):
        common, autoencoder, tree, metadata = load_captioned_model(path, _KIND, _shapes)
        axes, latent, redundancy = (AxisNormaliser(**jax.tree.map(np.asarray, tree[what])) if what in tree else None
                                    for what in ("axes", "latent", "redundancy"))  # fmt: skip
        mesh = None
        if "rest" in tree:
            rest = dataclasses.replace(common["skeleton"], offsets=np.asarray(tree["rest"]))
            mesh = BodyMesh.of(rest, autoencoder.levels, **autoencoder.neighbours)
            if weights_digest(mesh.lists) != metadata["neighbours"]:
                raise ValueError("was trained on a body with other neighbours than this version's; train it anew")
        return TextModel(
            codec=MotionCodec(axes, autoencoder, tree.get("autoencoder"), latent, redundancy, mesh),
            starts={caption: np.asarray(state) for caption, state in tree["starts"].items()},
            branch=tree.get("branch"),
            **common,
        )


def _shapes(metadata: dict, config: ACMDMConfig | None, autoencoder: AutoencoderConfig | None) -> tuple[dict, dict]:
    """Return the shapes of the branch's weights, and of normalisers and first frames."""
    single = jax.ShapeDtypeStruct
    numbers = lambda width: {what: single((width,), jnp.float32) for what in AxisNormaliser._fields}
    weights, arrays = {}, {"axes": numbers(3)}
    if isinstance(autoencoder, MeshAutoencoderConfig):
        arrays["rest"] = single((len(metadata["joints"]), 3), jnp.float32)
    if autoencoder is not None:
        arrays["latent"] = numbers(autoencoder.latent_channels)
    elif config.channels > 3:
        arrays["redundancy"] = numbers(NUM_JOINT_FEATURES)
    if metadata["controlled"]:
        frames = 1 if autoencoder is None else autoencoder.frames_per_latent
        weights["branch"] = nnx.state(nnx.eval_shape(lambda: ControlBranch(config, frames, rngs=nnx.Rngs(0))))
    arrays["starts"] = {name: single(tuple(shape), jnp.float32) for name, shape in metadata["start_shapes"].items()}
    return weights, arrays


# ---------------------------------------------------------------------------------------------------------------- data


def open_text_motions(name: str, source=None, *, held_out_wording: bool = False) -> TextMotions:
    """Open captioned motions by name.

    Args:
      name: "bandai", whose captions are composed; or "folder", one in HumanML3D's layout.
      source: the folder, or bandai's archive.
      held_out_wording: of bandai: caption with the phrases that training never sees.

    Raises:
      ValueError: for a data set without captions, or a folder that is not given or broken.
    """
    if name == "bandai":
        packed = packed_dataset(open_dataset("bandai", path=source, locomotion_only=False))
        return bandai_text_motions(packed, held_out_wording=held_out_wording)
    if name != "folder":
        raise ValueError(f"data set {name!r} has no captions{nearest_hint(name, ('bandai', 'folder'))}")
    if source is None:
        raise ValueError("--data folder needs --source: a folder in HumanML3D's layout (f3amd dataset writes one)")
    return read_humanml3d(source)


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


def _captioned_states(codec: MotionCodec, data: TextMotions, encoder: TextEncoder):
    """Return (clips as states, pooled embeddings of their captions)."""
    table, captions = clip_table(data, encoded_clips(codec, data), codec.frames_per_state)
    return table, pooled_captions(captions, encoder)


def pooled_captions(captions: Sequence[str], encoder: TextEncoder) -> jax.Array:
    """Return the pooled embedding of each caption, [N, W]; those that are said twice are embedded once."""
    unlike, place = np.unique(captions, return_inverse=True)
    return jnp.asarray(embed_captions(unlike.tolist(), encoder).pooled[place])


# ---------------------------------------------------------------------------------------------------------------- tasks


def autoencoder_task(
    data: TextMotions, split: str, preset: str, config: acmdm_training.TextMotionTraining
) -> acmdm_training.AutoencoderTask | acmdm_training.MeshAutoencoderTask:
    """Return the training of a preset's autoencoder on the clips of a split."""
    axes, part = data.normaliser(), data.select(data.members(split))
    table, _ = clip_table(part, axes.normalise(part.positions))
    if presets.find_preset(preset).family != MeshAutoencoderConfig.family:
        if len(part.lengths) and part.lengths.max() < config.window:
            lengths = f"no {split} clip has {config.window} frames, the longest has {part.lengths.max()}"
            raise ValueError(f"data set {data.name!r}: {lengths}; {preset} needs longer ones, or a larger --window")
        model = presets.build_config(preset)
        return acmdm_training.AutoencoderTask(model, config, table, dataset_fingerprint=data.fingerprint)
    # The body stands as people do when clips begin: those of training, whatever the split.
    rest = standing(data.skeleton, data.positions[data.start[data.members("train")]])
    model = presets.build_config(preset, num_vertices=len(make_body(rest).vertices))
    codec = MotionCodec(axes, mesh=BodyMesh.of(rest, model.levels, **model.neighbours))
    return acmdm_training.MeshAutoencoderTask(model, config, table, codec, dataset_fingerprint=data.fingerprint)


def denoiser_task(
    data: TextMotions, split: str, encoder: TextEncoder, preset: str, config: acmdm_training.TextMotionTraining,
    codec: MotionCodec, window: int | None = None,
) -> acmdm_training.TextMotionTask:  # fmt: skip
    """Return the training of a preset's denoiser on the clips of a split.

    Args:
      data, split: captioned clips.
      encoder: of the captions.
      preset, config: the model and its training.
      codec: of its states, which must have the preset's channels.
      window: most frames of motion in a state, instead of the preset's.
    """
    table, pooled = _captioned_states(codec, data.select(data.members(split)), encoder)
    sizes = {"num_joints": table.frames.shape[1], "text_width": pooled.shape[-1]}
    if window:
        sizes["window"] = window // codec.frames_per_state
    model = presets.build_config(preset, **sizes)
    if model.channels != table.frames.shape[-1]:
        raise ValueError(f"{preset} models {model.channels} numbers a joint; positions have {table.frames.shape[-1]}")
    fingerprint = data.fingerprint
    if codec.autoencoder is not None:
        fingerprint += f" in the latent of {weights_digest(codec.params)}"
    schedule = presets.find_preset(preset).diffusion
    return acmdm_training.TextMotionTask(model, config, table, schedule, pooled, dataset_fingerprint=fingerprint)


def control_task(
    data: TextMotions, split: str, encoder: TextEncoder, base: TextModel, config: acmdm_training.TextMotionTraining,
    joints,
) -> acmdm_training.ControlTask:  # fmt: skip
    """Return the training of a branch that controls `joints` beside a finished model, on the clips of a split."""
    part, codec, frames = data.select(data.members(split)), base.codec, base.codec.frames_per_state
    table, pooled = _captioned_states(codec, part, encoder)
    positions = jnp.asarray(np.concatenate(_whole_states(codec, part)), jnp.float32)
    positions = positions.reshape(len(table.frames), frames, *positions.shape[1:])
    table = table._replace(frames=(table.frames, positions))
    fingerprint = f"{data.fingerprint} beside {weights_digest(base.params)}"
    return acmdm_training.ControlTask(
        base.config, config, table, base.schedule, pooled, base.params, codec, tuple(joints),
        dataset_fingerprint=fingerprint,
    )  # fmt: skip


# ------------------------------------------------------------------------------------------------------------- training


def text_model_files(profile: Profile, name: str, *, folder=None) -> ModelFiles:
    """Return where a model of a data set and profile lies: `runs/<data set>/<profile>/text` or a folder of yours."""
    return ModelFiles.of(folder or runs_dir(profile.dataset, profile.name) / "text", name)


def of_this_training(found, task: Task, files: ModelFiles):
    """Return a finished model that was read from `files`; ValueError if it came from another training than `task`."""
    if unlike := differences(task.identity(), found.record["identity"]):
        lies = f"a model with other {'; '.join(unlike)} lies there"
        raise ValueError(f"{files.model}: {lies}; move it away or name another folder (--out)")
    return found


_DENOISERS = (ACMDMConfig.family, MaskedACMDMConfig.family)
_AUTOENCODERS = {AutoencoderConfig.family: "autoencoder", MeshAutoencoderConfig.family: "mesh-autoencoder"}
"""Recipe of each family of autoencoders."""


def is_text_preset(name: str) -> bool:
    """Say whether a preset, with or without a branch, is one that this file trains."""
    return presets.find_preset(preset_and_branch(name)[0]).family in (*_DENOISERS, *_AUTOENCODERS)


def train_text_model(
    data: TextMotions, encoder: TextEncoder, profile: Profile, name: str, *,
    window: int | None = None, batch_size: int | None = None, folder=None, **leg,
) -> TextModel | None:  # fmt: skip
    """Train a preset, and first what it stands on, unless that is finished already, with whatever settings.

    A branch may stand beside the network that ships, where that knows these motions. A killed training goes on where it
    was; a finished model is only read.

    Args:
      data: captioned clips.
      encoder: of the captions.
      profile: how long; "gpu" by the paper's recipe, else by the short ones.
      name: of a preset of ACMDM, or with "+control" or "+control-pelvis" behind it.
      window: most frames of motion in a state, instead of the preset's; longer clips are cut to their first frames, so
        that all begin where a caption's motion will: at the origin.
      batch_size: instead of the recipe's.
      folder: where files go instead of `runs/`.
      **leg: stop_at and progress, as for `optimise`.

    Returns:
      The model as its file has it; None where `stop_at` came first.

    Raises:
      ValueError: if a model or a state of other settings lies there, or what it stands on knows other data.
      TrainingDiverged: if the loss stops being a number.
    """
    base, branch = preset_and_branch(name)
    preset = presets.find_preset(base)
    if branch and preset.latent and presets.find_preset(preset.latent).family == MeshAutoencoderConfig.family:
        raise ValueError(f"{preset.name} has no control branch: its states are of vertices, not of joints")
    name = preset.name + branch
    data = data.cut(window) if window and window < data.lengths.max() else data
    earlier = preset.name if branch else preset.latent
    before = None
    if earlier:
        lies = text_model_files(profile, earlier, folder=folder).model
        asked = {"window": window, "batch_size": batch_size, "folder": folder, **leg}
        before = load_text_model(lies) if lies.exists() else None
        if before is None and branch:
            before = shipped_for(earlier, data, encoder)
        before = before or train_text_model(data, encoder, profile, earlier, **asked)
        if before is None:
            return None
        if before.record["dataset_fingerprint"] != data.fingerprint:
            raise ValueError(f"{lies}: was trained on other data; move it away or name another folder (--out)")
    part = "control" if branch else _AUTOENCODERS.get(preset.family, "denoiser")
    codec = _codec_of_positions(data, preset) if before is None else before.codec
    settings = {"unit": max(1, UNIT // codec.frames_per_state), "batch_size": batch_size}
    own = None if branch else preset.name
    config = profile_part_recipe(acmdm_training.TextMotionTraining, part, profile, own, **settings)
    if part == "denoiser":
        task_of = lambda split: denoiser_task(data, split, encoder, preset.name, config, codec, window)
    elif part == "control":
        joints = [0] if branch == PELVIS else controlled_joints(data.skeleton).values()
        task_of = lambda split: control_task(data, split, encoder, before, config, joints)
    else:
        task_of = lambda split: autoencoder_task(data, split, preset.name, config)
    files, task = text_model_files(profile, name, folder=folder), task_of("train")
    if files.model.exists():
        return of_this_training(load_text_model(files.model), task, files)
    held_out = task_of("validation").draw(None, jax.random.key(0))[0]
    if preset.family in _AUTOENCODERS:
        held_out = (held_out, jnp.ones(held_out.shape[:2], bool))
    state, about = train_part(task, files, data, profile, name, held_out, **leg)
    if state is None:
        return None
    if preset.family in _AUTOENCODERS:
        made = TextModel(codec=_codec_of(task, codec, state.averaged, data), **about)
    elif part == "control":
        kept = {key: before.record[key] for key in ("guidance",) if key in before.record}
        made = dataclasses.replace(before, branch=state.averaged, name=name, record=about["record"] | kept)
    else:
        trained_on = data.select(data.members("train"))
        made = TextModel(
            codec=codec, config=task.model_config, params=state.averaged, schedule=task.schedule,
            text_encoder=encoder.identity, words=words_of([said for lines in trained_on.captions for said in lines]),
            starts=first_frames(codec, trained_on, config.prefix_frames), **about,
        )  # fmt: skip
    save_text_model(files.model, made)
    return load_text_model(files.model)


def shipped_for(name: str, data: TextMotions, encoder: TextEncoder, load=load_text_model):
    """Return the model of this name that ships, if it was trained on these very motions with this encoder."""
    path = PRETRAINED_DIR / data.name / "text" / f"{name}.safetensors"
    found = load(path) if path.exists() else None
    known = found and (found.record["dataset_fingerprint"], found.text_encoder) == (data.fingerprint, encoder.identity)
    return found if known else None


def _codec_of_positions(data: TextMotions, preset: presets.Preset) -> MotionCodec:
    """Return the codec of positions, and of redundant features beside them where a preset has channels for those."""
    redundancy = None
    if preset.network.get("channels") == 3 + NUM_JOINT_FEATURES:
        redundancy = AxisNormaliser.of(data.select(data.members("train")).joint_features())
    return MotionCodec(data.normaliser(), redundancy=redundancy)


def _codec_of(task: acmdm_training.AutoencoderTask, codec: MotionCodec, params, data: TextMotions) -> MotionCodec:
    """Return the codec of a trained autoencoder, its latent normalised over up to 512 training clips."""
    part = data.members("train")
    part = part[np.linspace(0, len(part) - 1, min(512, len(part))).astype(int)]
    frames = task.model_config.frames_per_latent
    codec = getattr(task, "codec", codec)
    clips = [codec.axes.normalise(data.clip(number)) for number in part]
    padded = pad_motions(clips, max(map(len, clips)) // frames * frames)
    return with_latent(codec, task.model_config, params, padded.motion, padded.mask)


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


def text_model_folders(dataset: str) -> list[Path]:
    """Return where models of a data set may lie, in the order of asking: gpu and laptop runs, then what is shipped."""
    own = [runs_dir(dataset, profile) / "text" for profile in ("gpu", "laptop")]
    return [*own, PRETRAINED_DIR / dataset / "text"]


def newest_weights(dataset: str, choices: list[list[str]], told: str) -> Path:
    """Return the weights file of a data set that comes first: by folder, then by choice, of one choice the newest.

    Args:
      dataset: that models were trained on.
      choices: names of models, each list as good as the one after it or better.
      told: the name to train, where there is none of them.

    Raises:
      ValueError: if there is none, saying how to train it.
    """
    for folder in text_model_folders(dataset):
        for names in choices:
            if found := [path for name in names if (path := folder / f"{name}.safetensors").is_file()]:
                return max(found, key=lambda path: path.stat().st_mtime)
    how = f"f3amd train --preset {told} --data {dataset}"
    raise ValueError(f"no trained {told} for data set {dataset!r}; train it: {how}")


def find_text_model(dataset: str, preset: str | None = None, *, control: bool = False) -> Path:
    """Return the weights file of a data set: the user's own gpu or laptop run, else shipped.

    Args:
      dataset: that it was trained on.
      preset: by default the newest that turns text into motion.
      control: it must have a control branch.

    Raises:
      ValueError: if there is none, saying how to train it.
    """
    wanted, branch = preset_and_branch(preset or DEFAULT_PRESET)
    wanted = presets.find_preset(wanted).name
    branches = (branch,) if branch else (CONTROL, PELVIS) if control else ("",)
    denoisers = [name for name, known in presets.PRESETS.items() if known.family in _DENOISERS]
    names = [wanted] if preset else [name + form for name in denoisers for form in ("", *presets.FORMS)]
    return newest_weights(dataset, [[name + branch for name in names] for branch in branches], wanted + branches[0])


DEFAULT_PRESET = "ACMDM-S-PS22-raw-n3"
"""The preset that two cores can train, and that is named where none is."""

JUDGE = "judge"
"""Name on the command line, and of the file, of the judge of text to motion."""
