"""Trained models of captioned motion as files, and where they are found.

A state of ACMDM is positions, with redundant features or without, or a latent of positions or of the body's vertices:
`MotionCodec`. All kinds have one form of file: weights of one network or several, arrays, and a description that says
the networks' configs. A preset's name with "+control" behind it stands for the branch beside the finished model of that
name, with "+control-pelvis" for one that knows the pelvis alone.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from f3amd_lib.data.packed import packed_dataset
from f3amd_lib.data.sources import open_dataset
from f3amd_lib.diffusion.schedules import NoiseSchedule, schedule_from_dict
from f3amd_lib.ground import trees
from f3amd_lib.ground.names import nearest_hint
from f3amd_lib.ground.profiles import Profile, runs_dir
from f3amd_lib.ground.trees import weights_digest
from f3amd_lib.motion.skeleton import Skeleton, describe_skeleton, described_skeleton
from f3amd_lib.networks import presets
from f3amd_lib.networks.config import CheckedConfig
from f3amd_lib.text.data.body_mesh import BodyMesh
from f3amd_lib.text.data.humanml3d import read_humanml3d
from f3amd_lib.text.data.text_encoders import TextEncoder, embed_captions, words_of
from f3amd_lib.text.data.text_motions import AxisNormaliser, TextMotions, bandai_text_motions
from f3amd_lib.text.networks.acmdm import ControlBranch, blank_branch, branch_with
from f3amd_lib.text.networks.autoencoders import AutoencoderConfig, MeshAutoencoderConfig
from f3amd_lib.training import checkpoints
from f3amd_lib.training.checkpoints import network_with
from f3amd_lib.training.optimise import Task, frozen_tree
from f3amd_lib.training.pipeline import PRETRAINED_DIR, ModelFiles


@frozen_tree("axes", "params", "latent", "redundancy")
class MotionCodec:
    """How a state stands for motion.

    Attributes:
      axes: of positions in metres (ACMDM App. I). A shift of every joint by one vector is then a shift of every
        joint's numbers by one vector.
      autoencoder: config of the autoencoder, None where the state is positions.
      params: its weights.
      latent: of its latent's channels.
      redundancy: of the features that a state has beside positions (`joint_features`), None where it has none.
      mesh: the body whose vertices a mesh autoencoder sees, None for all others.
    """

    axes: AxisNormaliser
    autoencoder: AutoencoderConfig | MeshAutoencoderConfig | None = None
    params: Any = None
    latent: AxisNormaliser | None = None
    redundancy: AxisNormaliser | None = None
    mesh: BodyMesh | None = None

    @property
    def frames_per_state(self) -> int:
        """Frames of motion that one frame of a state stands for."""
        return 1 if self.autoencoder is None else self.autoencoder.frames_per_latent

    def state_mask(self, mask):
        """Return which frames of the state are motion, [B, l], of a mask of motion frames [B, L]."""
        return mask[:, :: self.frames_per_state]

    def encode(self, normalised, mask):
        """Return the state of normalised positions, zero in padding.

        Args:
          normalised: [B, L, J, 3]; L a multiple of `frames_per_state`.
          mask: True where a frame is motion, [B, L], whole frames of the state.

        Returns:
          [B, l, J, C]; without redundant features, which are of a whole clip (`TextMotions.joint_features`).
        """
        state = normalised if self.autoencoder is None else self.latent.normalise(self.latent_of(normalised, mask))
        return state * self.state_mask(mask)[..., None, None]

    def decode(self, state, mask):
        """Return normalised positions [B, L, J, 3] of a state [B, l, J, C]; mask [B, L]."""
        if self.autoencoder is None:
            return state[..., : len(self.axes.mean)]
        if self.mesh is not None:
            return _frame_by_frame(lambda frames: self.mesh.joints(self._vertices(frames)), state)
        return network_with(self.autoencoder, self.params).decode(self.latent.restore(state), self.state_mask(mask))

    def decode_vertices(self, state):
        """Return normalised vertices [B, L, V, 3] of a mesh autoencoder's state [B, L, n, C]."""
        return _frame_by_frame(self._vertices, state)

    def _vertices(self, frames):
        network = network_with(self.autoencoder, self.params)
        return network.decode(self.latent.restore(frames), self.mesh.lists)

    def vertices_of(self, frames):
        """Return the body's normalised vertices [N, V, 3] of normalised positions [N, J, 3]."""
        return self.axes.normalise(self.mesh.vertices(self.axes.restore(frames)))

    def latent_of(self, normalised, mask):
        """Return the autoencoder's own latent [B, l, J, C] of normalised positions; arguments as of `encode`."""
        network = network_with(self.autoencoder, self.params)
        if self.mesh is None:
            return network.latent_of(normalised, mask)
        return _frame_by_frame(lambda frames: network.encode(self.vertices_of(frames), self.mesh.lists), normalised)

    def with_latent(self, config: AutoencoderConfig, params, normalised, mask) -> MotionCodec:
        """Return a codec whose state is an autoencoder's latent, normalised by the mean and deviation of each channel.

        Args:
          config, params: of the trained autoencoder.
          normalised, mask: motion to take the statistics from, [B, L, J, 3] and [B, L].
        """
        codec = dataclasses.replace(self, autoencoder=config, params=params)
        latent = codec.latent_of(normalised, mask)[codec.state_mask(mask)]
        return dataclasses.replace(codec, latent=AxisNormaliser.of(latent))


_FRAMES_AT_ONCE = 128
"""Of meshes: all vertices of many clips at once would not fit into memory."""


def _frame_by_frame(function, clips):
    """Apply a function of frames [N, ...] to clips [B, L, ...]."""
    count = clips.shape[0] * clips.shape[1]
    size = min(_FRAMES_AT_ONCE, count)
    frames = jnp.asarray(clips).reshape(count, *clips.shape[2:])
    frames = jnp.pad(frames, ((0, -count % size), *[(0, 0)] * (frames.ndim - 1)), mode="edge")
    made = jax.lax.map(function, frames.reshape(-1, size, *frames.shape[1:]))
    return made.reshape(-1, *made.shape[2:])[:count].reshape(*clips.shape[:2], *made.shape[2:])


CONTROL = "+control"
"""Behind a preset's name: the model with its control branch."""

PELVIS = f"{CONTROL}-pelvis"
"""The same with a branch that learns to control the pelvis alone (ACMDM Table 3, "trained on pelvis")."""

CONTROLLED = {"left_foot": "left_toe", "right_foot": "right_toe"} | {
    name: name for name in ("head", "left_wrist", "right_wrist")
}
"""Joints that a branch learns to control besides the pelvis (ACMDM section 3.2): their names on the command line, and
their roles in a skeleton."""

DEFAULT_PRESET = "ACMDM-S-PS22-raw-n3"
"""The preset that two cores can train, and that is named where none is."""

JUDGE = "judge"
"""Name on the command line, and of the file, of the judge of text to motion."""

STUDENTS = {phases: f"MotionPCM-M{phases}-small" for phases in (1, 2, 4)}
"""The models that `f3amd text --model motionpcm` means, by --steps: a student is trained for one number of them."""

DENOISERS = ("ACMDM", "masked ACMDM")
"""Families of ACMDM's networks that turn text into motion."""


@dataclass(frozen=True, eq=False, kw_only=True)
class CaptionedModel:
    """What all models of captioned motion have; autoencoders alone have no network of their own.

    A subclass says what else a file holds (`parts`) and makes a model of it (`of`).

    Attributes:
      name: preset, perhaps with what stands beside it.
      skeleton, fps: of the motion it was trained on.
      record: how it was trained, on what, under what terms.
      config, params: of the network that is told captions; None for an autoencoder alone.
      schedule: the noise schedule it was trained with, None without noise.
      text_encoder: identity of the encoder whose vectors it reads.
      words: of all captions that it was trained with.
    """

    kind: ClassVar[str]
    """What a file says that it holds."""

    name: str
    skeleton: Skeleton
    fps: float
    record: dict
    config: CheckedConfig | None = None
    params: Any = None
    schedule: NoiseSchedule | None = None
    text_encoder: str = ""
    words: tuple[str, ...] = ()

    def network(self):
        """Return the network with its weights."""
        return network_with(self.config, self.params)


@dataclass(frozen=True, eq=False, kw_only=True)
class TextModel(CaptionedModel):
    """A trained model of ACMDM, or its motion autoencoder alone.

    Its name has "+control" or "+control-pelvis" at its end where there is a branch; weights are the moving average.

    Attributes:
      codec: between motion and the network's states: normaliser and autoencoder.
      starts: of the prefix form alone: by caption, first frames of a clip to go on from, states [P, J, C].
      branch: weights of the control branch, None without one.
    """

    kind: ClassVar[str] = "text-to-motion model"

    codec: MotionCodec
    starts: dict = field(default_factory=dict)
    branch: Any = None

    def control_branch(self) -> ControlBranch:
        """Return the control branch with its weights; ValueError says how to train one if there is none."""
        if self.branch is None:
            raise ValueError(f"{self.name} has no control branch; train one: f3amd train --preset {self.name}{CONTROL}")
        return branch_with(self.config, self.codec.frames_per_state, self.branch)

    @property
    def controlled(self) -> dict[str, int]:
        """The joints that its control branch knows, by their names on the command line."""
        pelvis_alone = preset_and_branch(self.name)[1] == PELVIS
        return {"pelvis": 0} if pelvis_alone else controlled_joints(self.skeleton)

    @property
    def most_frames(self) -> int:
        """Frames of motion in the longest state."""
        return self.config.window * self.codec.frames_per_state

    def parts(self) -> tuple[dict, dict, CheckedConfig | None, dict]:
        """Return what its file has besides: (weights, arrays, config of the autoencoder, what the description says)."""
        codec, said = self.codec, {"controlled": self.branch is not None}
        normalisers = {"axes": codec.axes, "latent": codec.latent, "redundancy": codec.redundancy}
        arrays = {what: normaliser._asdict() for what, normaliser in normalisers.items() if normaliser is not None}
        arrays["starts"] = {caption: jnp.asarray(state, jnp.float32) for caption, state in self.starts.items()}
        if codec.mesh is not None:
            arrays["rest"] = jnp.asarray(codec.mesh.skeleton.offsets, jnp.float32)
            said["neighbours"] = weights_digest(codec.mesh.lists)
        return {"autoencoder": codec.params, "branch": self.branch}, arrays, codec.autoencoder, said

    @classmethod
    def of(cls, tree: dict, autoencoder: CheckedConfig | None, said: dict, about: dict) -> TextModel:
        """Return the model of a file's tree and description; `about` is what all kinds have."""
        parts = (tree.get(what) for what in ("axes", "latent", "redundancy"))
        axes, latent, redundancy = (part and AxisNormaliser(**jax.tree.map(np.asarray, part)) for part in parts)
        mesh = None
        if "rest" in tree:
            rest = dataclasses.replace(about["skeleton"], offsets=np.asarray(tree["rest"]))
            mesh = BodyMesh.of(rest, autoencoder.levels, **autoencoder.neighbours)
            if weights_digest(mesh.lists) != said["neighbours"]:
                raise ValueError("was trained on a body with other neighbours than this version's; train it again")
        codec = MotionCodec(axes, autoencoder, tree.get("autoencoder"), latent, redundancy, mesh)
        starts = {caption: np.asarray(state) for caption, state in tree.get("starts", {}).items()}
        return cls(codec=codec, starts=starts, branch=tree.get("branch"), **about)


@dataclass(frozen=True, eq=False, kw_only=True)
class LatentModel(CaptionedModel):
    """A trained model of MotionPCM: an autoencoder, with a teacher or a student or alone.

    Its weights are a teacher's moving average, or a student's own. The identity of its task, in the record, says M and
    k of a student.

    Attributes:
      autoencoder, autoencoder_params: config and weights.
      statistics: of its features.
      empty: what its text encoder makes of the empty caption, [W], or 0.
    """

    kind: ClassVar[str] = "latent motion model"

    autoencoder: CheckedConfig
    autoencoder_params: Any
    statistics: AxisNormaliser
    empty: Any = 0.0

    @property
    def training(self) -> dict:
        """How it was trained: the settings of `LatentMotionTraining`."""
        return self.record["identity"]["training"]

    @property
    def most_frames(self) -> int:
        """Frames of the longest clip that it was trained on."""
        return self.training["num_frames"]

    def parts(self) -> tuple[dict, dict, CheckedConfig, dict]:
        """Return what its file has besides, as `TextModel.parts`."""
        empty = {"empty": jnp.asarray(self.empty)} if np.any(self.empty) else {}
        return {"autoencoder": self.autoencoder_params}, self.statistics._asdict() | empty, self.autoencoder, {}

    @classmethod
    def of(cls, tree: dict, autoencoder: CheckedConfig, said: dict, about: dict) -> LatentModel:
        """Return the model of a file, as `TextModel.of`."""
        about |= {"statistics": AxisNormaliser(tree["mean"], tree["deviation"]), "empty": tree.get("empty", 0.0)}
        return cls(autoencoder=autoencoder, autoencoder_params=tree["autoencoder"], **about)


def controlled_joints(skeleton: Skeleton) -> dict[str, int]:
    """Return the joints that a branch learns to control, by their names on the command line; the pelvis is the root."""
    return {"pelvis": 0} | {name: skeleton.role(role) for name, role in CONTROLLED.items() if role in skeleton.roles}


def preset_and_branch(name: str) -> tuple[str, str]:
    """Return a preset's name and what follows it: nothing, `CONTROL` or `PELVIS`; ValueError for another branch."""
    preset, plus, which = name.partition(CONTROL)
    if (branch := plus + which) not in ("", CONTROL, PELVIS):
        raise ValueError(f"unknown branch {branch!r} in {name!r}{nearest_hint(branch, (CONTROL, PELVIS))}")
    return preset, branch


# --------------------------------------------------------------------------------------------------------------- files


def save_text_model(path: Path, trained: CaptionedModel, dtype=jnp.bfloat16) -> None:
    """Write a model of any kind; `load_text_model` gives it back, weights in the precision of the file.

    Args:
      path: file to write.
      trained: the model.
      dtype: of the weights, as for `checkpoints.save_model`.
    """
    weights, arrays, autoencoder, said = trained.parts()
    weights = {"params": trained.params} | weights
    tree = {name: checkpoints.packed_weights(params, dtype) for name, params in weights.items() if params is not None}
    described = {"model": trained.config, "autoencoder": autoencoder, "diffusion": trained.schedule}
    metadata = {
        "kind": trained.kind, "name": trained.name,
        **{name: None if value is None else value.to_dict() for name, value in described.items()},
        "weights": jnp.dtype(dtype).name, "fps": trained.fps, "text_encoder": trained.text_encoder,
        "words": list(trained.words), **said, **describe_skeleton(trained.skeleton),
        "record": trained.record,
    }  # fmt: skip
    offsets = jnp.asarray(trained.skeleton.offsets, jnp.float32)
    trees.save_tree(path, tree | arrays | {"offsets": offsets}, metadata)


def load_text_model(path: Path, *kinds: type[CaptionedModel]) -> TextModel | LatentModel:
    """Read a model written by `save_text_model`.

    Args:
      path: the file.
      *kinds: classes of models that it may hold; by default `TextModel` and `LatentModel`.

    Raises:
      ValueError: naming the file, if it is missing, truncated, damaged or of another kind.
    """
    known = {model.kind: model for model in kinds or (TextModel, LatentModel)}
    configs = {}

    def networks(said: dict) -> dict:
        if said.get("kind") not in known:
            raise ValueError(f"holds a {said.get('kind')}, not a {' or a '.join(known)}")
        stated = {"params": said["model"], "autoencoder": said.get("autoencoder")}
        configs.update((part, presets.config_from_dict(config)) for part, config in stated.items() if config)
        shapes = {part: presets.blank_network(config)[1] for part, config in configs.items()}
        if said.get("controlled"):
            frames = configs["autoencoder"].frames_per_latent if "autoencoder" in configs else 1
            shapes["branch"] = blank_branch(configs["params"], frames)[1]
        return {part: checkpoints.packed_shapes(shape, said["weights"]) for part, shape in shapes.items()}

    with trees.errors_name(path):
        tree, said = trees.load_tree(path, networks, rest=True)
        tree |= {part: checkpoints.unpacked_weights(tree[part]) for part in ("params", "autoencoder", "branch")
                 if part in tree}  # fmt: skip
        about = {name: said[name] for name in ("name", "fps", "text_encoder", "record")} | {
            "config": configs.get("params"), "params": tree.get("params"), "words": tuple(said.get("words", ())),
            "schedule": schedule_from_dict(said["diffusion"]) if said.get("diffusion") else None,
            "skeleton": described_skeleton(said, tree["offsets"]),
        }  # fmt: skip
        return known[said["kind"]].of(tree, configs.get("autoencoder"), said, about)


def open_text_motions(name: str, source=None) -> TextMotions:
    """Open captioned motions by name.

    Args:
      name: "bandai", whose captions are composed; or "folder", one in HumanML3D's layout.
      source: the folder, or bandai's archive.

    Raises:
      ValueError: for a data set without captions, or a folder that is not given or broken.
    """
    if name == "bandai":
        return bandai_text_motions(packed_dataset(open_dataset("bandai", path=source, locomotion_only=False)))
    if name != "folder":
        raise ValueError(f"data set {name!r} has no captions{nearest_hint(name, ('bandai', 'folder'))}")
    if source is None:
        raise ValueError("--data folder needs --source: a folder in HumanML3D's layout (f3amd dataset writes one)")
    return read_humanml3d(source)


# ------------------------------------------------------------------------------------------------------------- finding


def is_latent_preset(name: str) -> bool:
    """Say whether a preset is one of MotionPCM's."""
    return presets.find_preset(preset_and_branch(name)[0]).paper == "motionpcm"


def text_model_files(profile: Profile, name: str, *, folder=None) -> ModelFiles:
    """Return where a model of a data set and profile lies: `runs/<data set>/<profile>/text` or a folder of yours."""
    return ModelFiles.of(folder or runs_dir(profile.dataset, profile.name) / "text", name)


def shipped_for(name: str, data: TextMotions, encoder: TextEncoder, *kinds: type[CaptionedModel]):
    """Return the model of this name that ships, if it was trained on these very motions with this encoder."""
    path = PRETRAINED_DIR / data.name / "text" / f"{name}.safetensors"
    if path.exists():
        found = load_text_model(path, *kinds)
        known = found.record["dataset_fingerprint"], found.text_encoder
        return found if known == (data.fingerprint, encoder.identity) else None


def text_model_folders(dataset: str) -> list[Path]:
    """Return where models of a data set may lie, in the order of asking: gpu and laptop runs, then what is shipped."""
    return [*(runs_dir(dataset, profile) / "text" for profile in ("gpu", "laptop")), PRETRAINED_DIR / dataset / "text"]


def named_model(name: str, num_steps: int | None = None) -> str:
    """Return the name that a user means, with its branch.

    Args:
      name: of a preset, perhaps with a branch, or of the paper, "motionpcm".
      num_steps: asked for; of the paper's students it chooses one, by default that of one step.

    Raises:
      ValueError: for an unknown name, or a number of steps that no student takes.
    """
    if name.lower() != "motionpcm":
        base, branch = preset_and_branch(name)
        return presets.find_preset(base).name + branch
    if (steps := num_steps or 1) not in STUDENTS:
        others = "their teacher takes any number: --model MotionPCM-teacher-small"
        raise ValueError(f"students of MotionPCM are trained for 1, 2 or 4 steps, none for {steps}; {others}")
    return STUDENTS[steps]


def find_text_model(
    dataset: str, preset: str | None = None, *, control: bool = False, num_steps: int | None = None
) -> Path:
    """Return the weights file of a data set: the user's own gpu or laptop run, else shipped.

    Args:
      dataset: that it was trained on.
      preset: as for `named_model`; by default the newest of ACMDM's that turn text into motion.
      control: it must have a control branch.
      num_steps: as for `named_model`.

    Raises:
      ValueError: as `named_model`, or if there is none, saying how to train it.
    """
    wanted, branch = preset_and_branch(named_model(preset or DEFAULT_PRESET, num_steps))
    branches = (branch,) if branch else (CONTROL, PELVIS) if control else ("",)
    denoisers = [name for name, known in presets.PRESETS.items() if known.family in DENOISERS]
    names = [wanted] if preset else [name + form for name in denoisers for form in ("", *presets.FORMS)]
    for folder, branch in itertools.product(text_model_folders(dataset), branches):
        if found := [path for name in names if (path := folder / f"{name}{branch}.safetensors").is_file()]:
            return max(found, key=lambda path: path.stat().st_mtime)
    told = wanted + branches[0]
    if dataset not in ("bandai", "folder") or presets.find_preset(wanted).paper == "f3amd":
        raise ValueError(f"no model {wanted} of captions for data set {dataset!r}: f3amd text --help has both")
    raise ValueError(f"no trained {told} for data set {dataset!r}: f3amd train --preset {told} --data {dataset}")


# ------------------------------------------------------------------------------------------------------------ training


@dataclass(frozen=True)
class Asked:
    """What is to be trained, and on what: tasks are made of it, and finished models.

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
    preset: presets.Preset
    branch: str
    config: Any
    before: TextModel | LatentModel | None
    codec: MotionCodec | None
    window: int | None

    def part(self, split: str | None) -> TextMotions:
        """Return the clips of a split; None is for a task that is only compared, which takes those of training."""
        return self.data.select(self.data.members(split or "train"))

    def pooled(self, captions: Sequence[str]) -> jax.Array:
        """Return the pooled embedding of each caption, [N, W]; those that are said twice are embedded once."""
        unlike, place = np.unique(captions, return_inverse=True)
        return jnp.asarray(embed_captions(unlike.tolist(), self.encoder).pooled[place])

    def told(self) -> dict:
        """Return what a model that reads captions says of them."""
        said = [caption for several in self.part("train").captions for caption in several]
        return {"text_encoder": self.encoder.identity, "words": words_of(said)}


@dataclass(frozen=True, eq=False)
class ClipsTask(Task):
    """A training of one network on clips, whole or as states; a subclass adds what else it goes by.

    Attributes:
      part: what its identity calls its network.
      model_config: the network.
      config: how to train it.
      clips: of the training split, on the device.
      dataset_fingerprint: of the data they come from, and of the networks it stands on.
    """

    part: ClassVar[str]

    model_config: CheckedConfig
    config: Any
    clips: Any
    dataset_fingerprint: str = field(default="", kw_only=True)

    def identity(self) -> dict:
        """Return all that decides the weights, JSON-ready, so that a state is resumed only where it belongs."""
        models = {self.part: self.model_config.to_dict()}
        if hasattr(self, "schedule"):
            models["diffusion"] = self.schedule.to_dict()
        training, fingerprint = dataclasses.asdict(self.config), self.dataset_fingerprint
        return {"part": self.name, "model": models, "training": training, "dataset_fingerprint": fingerprint}
