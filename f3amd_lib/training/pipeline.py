"""From the name of a data set to a trained model: the road that notebooks and command line share.

    data set -> packed cache -> windows on the device -> training -> TrainedModel

Everything a run leaves lies in `runs/<data set>/<profile>/models/`: the model, its training state
(a killed run goes on from there) and its loss history with a record. A model that ships with the
project lies in `f3amd_lib/pretrained/<data set>/` in the same form.
"""

import functools
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, Self

import jax
import numpy as np
import pandas as pd
from jax.sharding import Mesh

from f3amd_lib.data.features import Normaliser, num_channels
from f3amd_lib.data.packed import PackedMotion, packed_dataset
from f3amd_lib.data.sources import SPLITS, open_dataset
from f3amd_lib.data.windows import WindowSet, build_windows, fit_normaliser, starting_poses
from f3amd_lib.ground import log
from f3amd_lib.ground.files import locked, set_aside
from f3amd_lib.ground.profiles import PRETRAINED_DIR, Profile, runs_dir
from f3amd_lib.ground.records import read_table, run_record, whole_table, write_table
from f3amd_lib.ground.trees import describe
from f3amd_lib.networks import presets
from f3amd_lib.training.checkpoints import TrainedModel, load_model, save_model
from f3amd_lib.training.denoising_task import DenoisingTask, denoising_task, weights_identity
from f3amd_lib.training.optimise import Task, TrainingState, differences, optimise, restore_state
from f3amd_lib.training.recipe import TrainingConfig, profile_recipe


@dataclass(frozen=True, eq=False)
class PreparedData:
    """A data set ready to train on.

    Attributes:
      packed: all clips.
      window, num_history: frames of the windows that are cut from it.
    """

    packed: PackedMotion
    window: int = 32
    num_history: int = 10

    @functools.lru_cache(maxsize=4)  # noqa: B019  (one data set lives as long as the process)
    def windows(self, split: str, styles: tuple[str, ...] = ()) -> WindowSet:
        """Return the windows of a split; held-out splits take every fourth start.

        Args:
          split: "train", "validation" or "test".
          styles: of the model that will see them, where it knows more than this data set has.
        """
        return build_windows(
            self.packed, split, window=self.window, num_history=self.num_history,
            stride=1 if split == "train" else 4, styles=styles,
        )  # fmt: skip

    @functools.cached_property
    def normaliser(self) -> Normaliser:
        """Mean and deviation of the training windows, from a fixed key."""
        return fit_normaliser(self.windows("train"), jax.random.key(0))

    @functools.cached_property
    def held_out_split(self) -> str:
        """The split that losses are watched on: "validation", or what a tiny data set has."""
        present = set(np.asarray(self.packed.clip_split).tolist())
        wanted = ("validation", "test", "train")
        return next(split for split in wanted if SPLITS.index(split) in present)

    def model_config(self, preset: str, *, window: int | None = None, **settings):
        """Return a preset's config for this data set's channels and styles, and its window."""
        return presets.build_config(
            preset, channels=num_channels(self.packed.skeleton), num_styles=len(self.packed.styles),
            window=window or self.window, num_history=self.num_history, **settings,
        )  # fmt: skip

    def task(
        self, preset: str, config: TrainingConfig, *, network: Mapping | None = None,
        normaliser: Normaliser | None = None,
    ) -> DenoisingTask:  # fmt: skip
        """Return what trains a preset on this data set's training windows.

        Args:
          preset, config: the model and its training.
          network: fields of the preset's network to change.
          normaliser: of weights that bring one of their own; by default that of the training windows.
        """
        return denoising_task(
            self.model_config(preset, **(network or {})), config, self.packed.skeleton, normaliser or self.normaliser,
            self.windows("train"), dataset_fingerprint=self.packed.fingerprint,
        )  # fmt: skip


def prepare(profile: Profile, *, path=None, **of_folder) -> PreparedData:
    """Open, pack and lay out the data set that a profile asks for.

    Args:
      profile: names the data set and how much of it.
      path: folder or archive, where the data set needs one.
      **of_folder: what `open_dataset` takes for a folder alone.
    """
    how_much = {"seconds_per_style": profile.seconds_per_style, "num_styles": profile.num_styles}
    dataset = open_dataset(profile.dataset, path=path, **how_much, **of_folder)
    return PreparedData(packed_dataset(dataset), profile.window, profile.num_history)


class ModelFiles(NamedTuple):
    """Where one model lies.

    Attributes:
      model: weights and all that is needed to use them.
      state: training state, to go on from.
      history: losses against steps, a CSV with a record.
    """

    model: Path
    state: Path
    history: Path

    @classmethod
    def of(cls, folder, name: str) -> Self:
        """Return the files of a model of this name in a folder."""
        return cls(*(Path(folder) / f"{name}.{what}" for what in ("safetensors", "state.safetensors", "history.csv")))


def model_files(profile: Profile, preset: str | None = None, *, folder=None) -> ModelFiles:
    """Return where a run on this profile keeps a preset's files.

    Args:
      profile: names data set and scale.
      preset: by default the profile's own.
      folder: instead of `runs/<data set>/<profile>/models`.
    """
    name = presets.find_preset(profile.preset if preset is None else preset).name
    if profile.window != 32:
        name += f"-{profile.window}frames"
    return ModelFiles.of(runs_dir(profile.dataset, profile.name) / "models" if folder is None else folder, name)


def train(
    prepared: PreparedData, profile: Profile, *, preset: str | None = None, config: TrainingConfig | None = None,
    network: Mapping | None = None, folder=None, mesh: Mesh | None = None, **leg,
) -> tuple[TrainedModel | None, pd.DataFrame]:  # fmt: skip
    """Train a preset to the end, going on from its training state if there is one.

    Args:
      prepared: the data.
      profile: says how long, and where files go.
      preset: by default the profile's own.
      config: by default `profile_recipe`.
      network: fields of the preset's network to change.
      folder: where files go instead of `runs/`.
      mesh: devices that share each batch (`optimise.all_devices`); by default one.
      **leg: stop_at and progress, as for `optimise`.

    Returns:
      (model, history): the history has a row per 50 steps or fewer, with held-out losses
      where they were measured. The model is None where `stop_at` came first; the state waits.

    Raises:
      ValueError: if a training state lies there that was made with other settings, another process
        trains the same there, or the devices cannot share a batch equally.
      TrainingDiverged: if the loss stops being a number.
    """
    preset = presets.find_preset(profile.preset if preset is None else preset).name
    files = model_files(profile, preset, folder=folder)
    config = config or profile_recipe(profile, preset)
    if mesh is not None and config.batch_size % mesh.size:
        raise ValueError(f"{mesh.size} devices cannot share a batch of {config.batch_size} equally: take another size")
    task = prepared.task(preset, config, network=network)
    if prepared.held_out_split == "train":
        log.warning("no clip is held out: 'held-out' losses are of clips that the model was trained on")
    devices = {} if mesh is None else {"training_devices": mesh.size}
    return train_and_keep(prepared, profile, preset, task, files, devices, mesh=mesh, **leg)


def train_and_keep(
    prepared: PreparedData, profile: Profile, preset: str, task: Task, files: ModelFiles, about: dict, **leg
) -> tuple[TrainedModel | None, pd.DataFrame]:
    """Train a task on windows of a data set to the end, and keep the model.

    Args:
      prepared, profile, preset: as for `train`.
      task: a denoiser's, or the distillation of one (`denoising`): the student's moving average is its target.
      files: of the run.
      about: what else its record says.
      **leg: mesh, stop_at and progress, as for `train`.

    Returns:
      (model, history), as for `train`.
    """
    denoising, config = getattr(task, "denoising", task), task.config
    record = run_record(
        profile=profile, dataset=prepared.packed, seed=config.seed, model=preset, training=config.to_dict(),
        held_out_split=prepared.held_out_split, num_train_windows=int(denoising.windows.num_windows), **about,
    )  # fmt: skip
    with alone_with(files):
        state, history = train_in_legs(task, files, record, held_out=prepared.windows(prepared.held_out_split), **leg)
        if int(state.step) < config.num_steps:
            return None, history
        weights = state.averaged if denoising is task else state.params
        save_model(files.model, as_trained(prepared, denoising, preset, weights, record))
    return load_model(files.model), history  # in the precision of the file


def alone_with(files: ModelFiles):
    """Hold the files of a run, so that no second run writes there; ValueError if another process trains there."""
    return locked(files.model.with_suffix(".lock"), f"training {files.model.stem}")


def train_in_legs(
    task: Task, files: ModelFiles, record: dict, *, held_out, every: int | None = None, mesh: Mesh | None = None, **leg
) -> tuple[TrainingState, pd.DataFrame]:
    """Train a task from where its files are, keeping its state and its history there.

    Args:
      task: what to train.
      files: of the run; what lies there without a state is kept under another name.
      record: goes beside the history.
      held_out: data to watch the losses on.
      every: steps between checkpoints and looks at the held-out losses; by default a twentieth of the run.
      mesh: devices that share each batch.
      **leg: stop_after, stop_at and progress, as for `optimise`.

    Returns:
      (state, history); the state is short of the task's steps where `stop_at` came first.
    """
    state, rows = _begun(files, task, mesh)
    if every is None:  # at least two chunks, so that the shortest run can be stopped on its way, too
        every = max(1, min(max(5, task.config.num_steps // 20), task.config.num_steps // 2))

    def keep(row: dict) -> None:
        rows.append(row)
        if "held_out_loss" in row:
            write_table(files.history, pd.DataFrame(rows), record)

    state, _ = optimise(
        task, state, checkpoint=files.state, checkpoint_every=every, held_out=held_out, chunk=min(50, every), mesh=mesh,
        on_chunk=keep, **leg,
    )  # fmt: skip
    return state, pd.DataFrame(rows)


def as_trained(prepared: PreparedData, task: DenoisingTask, preset: str, params, record: dict) -> TrainedModel:
    """Return weights of a task, finished or on their way, with all that is needed to use them."""
    return TrainedModel(
        name=preset, config=task.model_config, params=params, normaliser=task.normaliser, skeleton=task.skeleton,
        styles=prepared.packed.styles, diffusion=task.config.diffusion,
        start_poses=starting_poses(prepared.packed, num_history=prepared.num_history), record=record,
    )  # fmt: skip


def _begun(files: ModelFiles, task: Task, mesh: Mesh | None) -> tuple[TrainingState | None, list[dict]]:
    """Return the state and the rows to go on from."""
    if not files.state.exists():
        set_aside_run(files)  # a finished model without its state cannot be gone on with
        return None, []
    state = restore_state(files.state, task, mesh)
    if (found := whole_table(files.history)) is None:
        log.warning("%s is missing or broken: losses of the first %d steps are lost", files.history, state.step)
        return state, []
    # It is written before the state: a run that was killed between the two has a row too many.
    return state, found[0][found[0]["step"] <= int(state.step)].to_dict("records")


def obtain_model(
    prepared: PreparedData, profile: Profile, *, preset: str | None = None, progress: bool = True
) -> tuple[TrainedModel, pd.DataFrame, str]:
    """Return a trained model: shipped, finished earlier, or trained now.

    A model counts only if it was made for the same skeleton and styles; weights never cross over.
    One of an earlier run must also come from the same data and training settings; a shipped one
    keeps its own, which its record tells.

    Args:
      prepared: the data.
      profile: `laptop` may use shipped weights, the others never do.
      preset: by default the profile's own.
      progress: show a progress bar if training is needed.

    Returns:
      (model, history, origin), origin being "shipped", "earlier run" or "trained now".
    """
    preset = presets.find_preset(profile.preset if preset is None else preset).name
    wanted, data = prepared.model_config(preset), prepared.packed
    shipped = model_files(profile, preset, folder=PRETRAINED_DIR / profile.dataset)
    if profile.name == "laptop" and shipped.model.exists():
        trained = load_model(shipped.model)
        if (trained.config, trained.skeleton, trained.styles) == (wanted, data.skeleton, data.styles):
            return trained, read_table(shipped.history)[0], "shipped"
    files = model_files(profile, preset)
    identity = weights_identity(wanted, profile_recipe(profile, preset), data.fingerprint)
    if files.model.exists() and files.history.exists():
        trained = load_model(files.model)
        if not _unlike(trained, identity):
            return trained, read_table(files.history)[0], "earlier run"
    # A killed run goes on if nothing has changed since; else its files are kept under other names.
    other = lambda: files.state.exists() and differences(identity, describe(files.state))
    if files.model.exists() or not files.history.exists() or other():
        set_aside_run(files)
    return *train(prepared, profile, preset=preset, progress=progress), "trained now"


def finished_model(prepared: PreparedData, profile: Profile, preset: str, files: ModelFiles) -> TrainedModel | None:
    """Return the model that a run by the profile's recipe left, None if it left none yet.

    Args:
      prepared, profile, preset: as for `obtain_model`.
      files: where it would lie.

    Raises:
      ValueError: if a model lies there that is of other data, another network or another training.
    """
    if not files.model.exists():
        return None
    trained = load_model(files.model)
    recipe = profile_recipe(profile, preset)
    if unlike := _unlike(trained, weights_identity(prepared.model_config(preset), recipe, prepared.packed.fingerprint)):
        raise ValueError(
            f"{files.model}: a model with other {' and '.join(unlike)} is already there; move it away "
            "or name another folder (--out)"
        )
    return trained


def _unlike(trained: TrainedModel, identity: dict) -> list[str]:
    """List in what a finished model is unlike the one that a run would make."""
    return differences(identity, {**trained.record, "model": trained.config.to_dict()})


def available_models(profile: Profile) -> list[str]:
    """List the presets that have weights, of the user's or shipped ones, in the order of `presets.of_paper`.

    Args:
      profile: as for `obtain_model`.
    """
    folders = [runs_dir(profile.dataset, profile.name) / "models", PRETRAINED_DIR / profile.dataset]
    suffix = "" if profile.window == 32 else f"-{profile.window}frames"
    names = [name + end for end in ("", *presets.FORMS) for name in presets.of_paper()]
    asked = folders if profile.name == "laptop" else folders[:1]
    found = {path.name for folder in asked for path in folder.glob("*.safetensors")}
    return [name for name in dict.fromkeys(names) if f"{name}{suffix}.safetensors" in found]


def set_aside_run(files: ModelFiles) -> None:
    """Rename what lies there to the first free number, so that nothing a user made is lost."""
    name = files.model.name.removesuffix(".safetensors")
    if kept := set_aside((*files, files.history.with_suffix(".json")), name):
        log.warning("earlier files of %s are kept as %s", name, kept)
