"""The command `f3amd`, such as `f3amd rollout --style proud --path figure-eight --out out/`.

A function a command: its parameters are the options, its docstring is their help. What needs JAX is
loaded where it is first used, so that `f3amd --help` and refusals are quick.
"""

import contextlib
import importlib.util
import json
import logging
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import textwrap
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from f3amd_companion import terminal

if __name__ == "__main__" or Path(sys.argv[0]).stem == "f3amd":
    terminal.leave_at_once("f3amd: stopped by Ctrl-C")  # while the following is loaded; `main` knows better

import tyro
from etils import epy
from tyro.conf import Positional, UseAppendAction

from f3amd_lib import __version__
from f3amd_lib.ground import log
from f3amd_lib.ground.files import check_own_folder, locked, write_whole
from f3amd_lib.ground.names import check_known, checked_seed, checked_value
from f3amd_lib.ground.profiles import load_profile, results_dir, runs_dir

with epy.lazy_imports():
    import numpy as np
    import optax
    import pandas as pd
    import safetensors

    from f3amd_companion import reproduce as notebook_runs
    from f3amd_companion.measuring import campaign as long_queue
    from f3amd_companion.measuring import measure as measuring
    from f3amd_companion.measuring import paper_tables, runner, text_tables
    from f3amd_companion.measuring import sweep as engine
    from f3amd_companion.measuring import times as measurements
    from f3amd_companion.serving import crowd as crowds
    from f3amd_companion.serving import export as exports
    from f3amd_companion.serving import finishing, foot_locking, motion_files, onnx_export, player
    from f3amd_companion.serving import steer as steering
    from f3amd_companion.speed import machine
    from f3amd_lib.data import packed as packed_data
    from f3amd_lib.data import sources
    from f3amd_lib.ground import papers, records, tables
    from f3amd_lib.motion import bvh, plausible, root_paths
    from f3amd_lib.networks import presets as network_presets
    from f3amd_lib.rollout import generated
    from f3amd_lib.rollout import rollout as rollouts
    from f3amd_lib.text import released
    from f3amd_lib.text.data import captioned_folder, text_encoders, text_motions
    from f3amd_lib.text.judge import text_judge
    from f3amd_lib.text.sampling import captioned_motion
    from f3amd_lib.text.stages import text_models, train_stage
    from f3amd_lib.training import checkpoints, optimise, pipeline

UNFINISHED = 3
"""Exit status of `train`, `measure` and `campaign` where the minutes were over first; a later call goes on."""

Repeatable = UseAppendAction[tuple[str, ...]]


def _given(**options) -> dict:
    """Return those options that were given: not None."""
    return {name: value for name, value in options.items() if value is not None}


def _only_with(needed: str, missing: bool, **options) -> None:
    """Raise ValueError for given options that would do nothing, as what they need is missing."""
    if missing and (idle := [f"--{name.replace('_', '-')}" for name, given in options.items() if given]):
        raise ValueError(f"{', '.join(idle)}: only with {needed}")


def _stop_at(minutes: float | None) -> float | None:
    """Return when so many minutes from now are over (`time.monotonic`)."""
    return None if minutes is None else time.monotonic() + 60.0 * minutes


def _use_fast_flags(num_devices: int | None = None) -> None:
    """Set XLA's flags, unless the user has; JAX reads them when it first looks for devices: call this before."""
    if "XLA_FLAGS" not in os.environ:
        os.environ["XLA_FLAGS"] = machine.fast_xla_flags(num_devices)


def _say_model(trained):
    """Say what a model is, and return it."""
    log.info("model        %s, trained on %s", trained.name, trained.record.get("dataset"))
    log.info("terms        %s", trained.record.get("dataset_licence"))
    return trained


def _say_written(*files: Path) -> None:
    """Name each file that was written."""
    for file in files:
        log.info("wrote        %s", file)


@dataclass(frozen=True)
class Person:
    """How BVH files of others are read.

    Attributes:
      scale: metres in a unit of the file, instead of a guess by its legs.
      up: axis that is up in the file, Y or Z, instead of a guess by legs and hips.
      joint_map: TOML file of lines such as left_knee = "calf_l": which joint plays a role, where it is not found.
    """

    scale: float | None = None
    up: Literal["Y", "Z"] | None = None
    joint_map: Path | None = None

    def mapped(self) -> dict[str, str]:
        """Return the joint map, role -> joint's name."""
        return motion_files.read_joint_map(self.joint_map) if self.joint_map else {}

    def read(self, path: Path):
        """Read a file, and say what was corrected."""
        motion, notes = plausible.as_person(bvh.read_bvh(path), joint_map=self.mapped(), scale=self.scale, up=self.up)
        if notes:
            log.info("corrected    %s: %s", path, "; ".join(notes))
        return motion


@dataclass(frozen=True)
class People(Person):
    """How a folder of BVH files is read.

    Attributes:
      retarget: bring several people to the skeleton of the first file.
      keep_first: keep a T-pose before the take.
    """

    retarget: bool = False
    keep_first: bool = False

    def asked(self) -> dict:
        """Return what `open_dataset` takes for a folder."""
        return vars(self) | {"joint_map": self.mapped()}


@dataclass(frozen=True)
class Data:
    """Motion, and how much is computed.

    Attributes:
      data: synthetic, bandai, 100style or folder.
      profile: smoke, laptop or gpu.
      source: folder or archive, for data sets that need one.
      window: future frames, 32 or 64; of text to motion the most frames of a clip.
    """

    data: str = "synthetic"
    profile: str = "laptop"
    source: str | None = None
    window: int | None = None
    people: People = People()

    def numbers(self, **overrides):
        """Return the profile with those values replaced that are given."""
        return load_profile(self.profile, self.data, **_given(**overrides))

    def open(self, **overrides):
        """Return the data set, prepared, and the profile as `numbers` does, with this window."""
        profile = self.numbers(**overrides, window=self.window)
        _only_with("--data bandai, 100style or folder", self.data == "synthetic", source=self.source)
        _only_with("--data folder", self.data != "folder", **vars(self.people))
        terminal.check_there(self.source)
        return pipeline.prepare(profile, path=self.source, **self.people.asked()), profile


@dataclass(frozen=True)
class Model:
    """A trained model, and how it is sampled.

    Attributes:
      steps: denoising steps a round.
      sampler: ddim, ddpm, euler or heun; by default the model's own.
      data: use the model of this data set.
      weights: a weights file, instead of the data set's own.
      overwrite: replace existing files.
    """

    steps: int = 8
    sampler: str | None = None
    data: str = "synthetic"
    weights: Path | None = None
    overwrite: bool = False

    @property
    def file(self) -> Path:
        """Return the weights file; ValueError if there is none, or no step to take."""
        checked_value("--steps", self.steps, "int")
        terminal.check_there(self.weights)
        return self.weights or terminal.find_model(self.data)

    @property
    def styles(self) -> list[str]:
        """Return the styles that the model knows, from the head of its file: JAX is not loaded."""
        try:
            with safetensors.safe_open(self.file, framework="numpy") as file:
                return list(json.loads(file.metadata()["description"])["styles"])
        except (safetensors.SafetensorError, OSError, LookupError, TypeError, ValueError):
            raise ValueError(f"{self.file}: not a complete model with styles; restore a whole copy") from None

    def style(self, asked: str) -> str:
        """Return a style as the model has it, whatever its case; ValueError names the nearest if there is none."""
        known = {style.casefold(): style for style in self.styles}
        style = asked if asked in known.values() else known.get(asked.casefold(), asked)
        check_known(style, known.values(), "style")
        return style

    def load(self):
        """Load the model, and say what it is."""
        return _say_model(checkpoints.load_model(self.file))

    def generator(self):
        """Return what animates characters with the model."""
        return rollouts.MotionGenerator(self.load(), self.steps, sampler=self.sampler)


@dataclass(frozen=True)
class Encoder:
    """What embeds captions.

    Attributes:
      text_encoder: wordllama (offline), clip or t5, of models of text to motion.
      text_weights: folder of CLIP's or Sentence-T5's weights, as `transformers` keeps them.
    """

    text_encoder: Literal["wordllama", "clip", "t5"] = "wordllama"
    text_weights: Path | None = None

    def load(self):
        """Read its weights, and return it."""
        terminal.check_there(self.text_weights)
        return text_encoders.load_text_encoder(self.text_encoder, self.text_weights)


def joints(file: Positional[Path], person: Person) -> None:
    """Show which joint of a BVH file plays which role, and what is corrected on reading.

    Args:
      file: BVH.
    """
    motion = person.read(file)
    names, roles, mapped = motion.skeleton.names, motion.skeleton.roles, person.mapped()
    for role, joint in sorted(roles.items(), key=lambda item: item[1]):
        log.info("%-14s %s", role, mapped.get(role, names[joint]))
    rest = ", ".join(name for joint, name in enumerate(names) if joint not in roles.values())
    log.info("%-14s %s", "without a role", rest or "no joint")
    log.info("%-14s %d at %.4g fps", "frames", motion.num_frames, motion.fps)


def data(motion: Data) -> None:
    """Open a data set, build its packed cache and describe it."""
    packed = motion.open()[0].packed
    splits = packed.clip_split.tolist()
    split = ", ".join(f"{splits.count(number)} {name}" for number, name in enumerate(sources.SPLITS))
    log.info("data set     %s, %s; %s", packed.name, packed.licence, packed.credit)
    log.info("clips        %d (%d left out): %s", packed.num_clips, len(packed.skipped), split)
    log.info("frames       %d at 30 fps, of %d joints", packed.num_frames, packed.skeleton.num_joints)
    log.info("styles       %s", ", ".join(packed.styles))


def dataset(
    captions: Path, people: People, source: str | None = None, data: str = "folder", fps: float = 20.0,
    out: Path = Path("out/dataset"),
) -> None:  # fmt: skip
    """Write motions with captions as a data set in HumanML3D's layout, for text-to-motion code.

    Args:
      captions: table (CSV) with columns file and caption, one line a caption.
      source: folder or zip of BVH files.
      data: another data set instead of a folder: synthetic, bandai, 100style.
      fps: frames per second to write.
      out: folder to write to; must be empty or new.
    """
    terminal.check_there(captions, source)
    if not 1.0 <= fps <= 1000.0:  # also catches NaN
        raise ValueError(f"--fps must be between 1 and 1000, got {fps}")
    check_own_folder(out)
    terminal.check_writable(out)
    opened = sources.open_dataset(data, path=source, **people.asked())
    written = captioned_folder.captioned_motions(opened, captioned_folder.read_caption_table(captions), fps=fps)
    _say_written(captioned_folder.write_humanml3d(out, written))
    for clip, reason in written.skipped:
        log.info("left out     %s: %s", clip, reason)
    split = ", ".join(f"{written.splits.count(split)} {split}" for split in sources.SPLITS)
    log.info("clips        %d of %d joints: %s", written.num_clips, written.skeleton.num_joints, split)
    log.info("terms        %s", written.licence)


def styles(data: str = "synthetic", weights: Path | None = None) -> None:
    """List the styles that a model knows.

    Args:
      data: the model of this data set.
      weights: a weights file, instead of the data set's own.
    """
    log.info("%s", textwrap.fill(", ".join(Model(data=data, weights=weights).styles), 100, break_on_hyphens=False))


def presets(
    paper: str = "f3amd", channels: int = 141, styles: int = 100, joints: int = 22, text_width: int | None = None
) -> None:
    """List the models of a paper with their sizes.

    Args:
      paper: its folder in `f3amd_lib/papers`.
      channels: features a frame, 6 J + 3, for networks of the families F3AMD and CAMDM.
      styles: how many, for the same.
      joints: J, for ACMDM's.
      text_width: for ACMDM's and MotionPCM's: numbers in a caption's embedding; by default the paper's encoder's.
    """
    table, asked = papers.load_sizes(paper), (channels, styles, joints, text_width)
    if table is None or asked != (141, 100, 22, None):
        of_data = {"channels": channels, "num_styles": styles, "num_joints": joints} | _given(text_width=text_width)
        table = network_presets.table(paper, **of_data)
    short = {"latent_width": "width", "mflop_per_evaluation": "MFLOP"}
    log.info("%s", tables.markdown_table(table.drop(columns=["depth", "diffusion", "sampler"]).rename(columns=short)))


def train(
    motion: Data, preset: Repeatable = (), minutes: float | None = None, steps: int | None = None,
    batch_size: int | None = None, seed: int | None = None, out: Path | None = None, all_devices: bool = False,
    teacher: Path | None = None, captions: Encoder = Encoder(),
) -> int:  # fmt: skip
    """Train a model; a killed run continues where it stopped.

    Args:
      preset: such as F3AMD-FNO-96; by default the profile's; repeatable, trained in this order. Of text to motion
        (--data bandai) such as ACMDM-S-PS22-raw-n3; NAME+control its control branch, NAME+control-pelvis one that
        knows the pelvis alone; judge the judge;
        MotionPCM-M1-small and so on a student, with the autoencoder and the teacher before it.
      minutes: stop after these with a checkpoint and exit status 3; the same command continues.
      steps: optimiser steps; by default the profile's.
      batch_size: windows a step.
      seed: of weights, batches and noise.
      out: folder for the model instead of runs/DATA/PROFILE/models.
      all_devices: share each batch among the devices JAX sees.
      teacher: file of the teacher of a MotionPCM student, such as the one that ships, instead of training one.
    """
    terminal.check_there(teacher)
    terminal.check_writable(*_given(out=out).values())
    of_latents = [name for name in preset if name.startswith(("MotionPCM", "MotionLCM"))]
    if teacher is not None and not (preset and set(of_latents) == set(preset)):
        raise ValueError("--teacher is for students of MotionPCM: leave it out")
    own, leg = {"batch_size": batch_size, "seed": seed}, {"folder": out, "stop_at": _stop_at(minutes)}
    if of_latents or any(name == "judge" or "ACMDM" in name for name in preset):
        if all_devices:
            raise ValueError("models of captioned motion train on one device: leave --all-devices out")
        files, train_one = _text_trainings(motion, captions, preset, steps, own, teacher, **leg)
    else:
        _use_fast_flags(1)
        prepared, profile = motion.open(train_steps=steps, **own)
        leg["mesh"] = optimise.all_devices() if all_devices else None
        files = {name: pipeline.model_files(profile, name, folder=out) for name in preset or [profile.preset]}
        finished = lambda name: pipeline.finished_model(prepared, profile, name, files[name])
        train_one = lambda name: finished(name) or pipeline.train(prepared, profile, preset=name, **leg)[0]
    for number, (name, its) in enumerate(files.items(), 1):
        done = train_one(name) is not None
        log.info("%-12s %s", name, its.model if done else f"unfinished; what is done: {its.state}")
        if not done:
            if waiting := [*files][number:]:
                log.info("not begun    %s", ", ".join(waiting))
            return UNFINISHED
    return 0


def _text_trainings(motion: Data, captions: Encoder, names, steps, own: dict, teacher, *, folder, stop_at):
    """Return the files of models of text to motion, or of their judge, by name, and what trains the one of a name."""
    for name in names:
        if name != text_models.JUDGE:
            train_stage.stage_of(name)  # refuses those that need no captions
    profile = motion.numbers(train_steps=steps, **own)
    given = text_models.open_text_motions(motion.data, motion.source), captions.load()
    files = {name: text_models.text_model_files(profile, name, folder=folder) for name in names}

    def train_one(name: str):
        if name == text_models.JUDGE:
            training = text_judge.EvaluatorTraining(**_given(num_steps=steps, **own))
            return text_judge.train_judge(*given, training, files=files[name], stop_at=stop_at)
        how = {"window": motion.window, "batch_size": own["batch_size"], "folder": folder, "teacher": teacher}
        return train_stage.train_stage(*given, profile, name, stop_at=stop_at, **how)

    return files, train_one


def rollout(
    style: str, model: Model, person: Person, path: str = "figure-eight", seed: int = 0, seconds: float = 20.0,
    speed: float = 1.2, raw: bool = False, format: str = "bvh", start: Path | None = None, out: Path = Path("out"),
) -> None:  # fmt: skip
    """Animate one character: motion, film strip, player.

    Args:
      style: one that the model knows.
      path: a named path, or a CSV file.
      seed: of path and noise.
      seconds: length of a named path; a CSV has its own.
      speed: of a named path, m/s; a CSV has its own.
      raw: as the network made it: seams are not blended (over 4 frames), supporting feet not held.
      format: of the motion: bvh, glb (glTF with a body), csv or gif (its first 12 s; with ffmpeg also as MP4); several
        with commas between.
      start: a BVH file to continue: its last frames are the history; another humanoid is retargeted.
      out: folder to write to.
    """
    style, seed, drawn, history = model.style(style), checked_seed(seed), path.lower().endswith(".csv"), None
    targets = _targets(out, f"{style}_{Path(path).stem}_seed{seed}", format, model.overwrite)
    terminal.check_there(start, path if drawn else None)
    _only_with("--start", start is None, **vars(person))
    _only_with("a named path", drawn, seconds=seconds != 20.0, speed=speed != 1.2)
    log.info("animating    %s along %s", style, path)
    how = {"speed": speed, "seed": seed}
    line = root_paths.read_path_csv(path) if drawn else root_paths.named_path(path, _num_frames(seconds), **how)
    generator = model.generator()
    trained = generator.trained
    if start is not None:
        history, note = motion_files.start_history(trained, person.read(start), line)
        log.info("start        %s", note)
    made = generator.rollout(line, style, seed=seed, history=history, blend_frames=0 if raw else 4)
    made = made if raw else finishing.held(foot_locking.lock_rollout, made)
    log.info("afterwards   %s", made.changes or "nothing: as the network made it")
    title = f"{trained.name}, {model.steps} step{'s' * (model.steps != 1)}, {style}, {Path(path).stem}"
    _write_shown(targets, player.rollout_scene(made, title), trained)


def _targets(folder: Path, name: str, format: str, overwrite: bool) -> list[Path]:
    """Return the files that `_write_shown` writes; ValueError where one is there already and may not be replaced."""
    endings = [".png", ".html", *_motion_formats(format, "gif")]
    endings += [".mp4"] if ".gif" in endings and shutil.which("ffmpeg") else []
    targets = [folder / f"{name}{ending}" for ending in endings]
    terminal.check_free(targets, overwrite)
    return targets


def _write_shown(targets, scene, trained) -> None:
    """Write a scene of one character as player page with film strip, and in each format asked."""
    _, page, *files = targets
    (character,) = scene.characters
    motion = character.motion
    credit = generated.generated_credit(trained.name, *map(trained.record.get, ("dataset_credit", "dataset_licence")))
    player.write_player(page, scene, credit=credit)  # the strip has its name
    for path in files:
        if path.suffix == ".gif":
            how = {"every": max(1, round(motion.fps / 10)), "max_seconds": 12.0}
            finishing.write_gif(path, motion, target_paths=character.path, titles=[scene.title], **how)
        elif path.suffix == ".mp4":
            gif = path.with_suffix(".gif")
            call = ["ffmpeg", "-loglevel", "error", "-y", "-i", gif, "-pix_fmt", "yuv420p", path]
            if subprocess.run(call, check=False).returncode:
                raise ValueError(f"{path}: ffmpeg could not make it; ask for --format gif")
        else:
            motion_files.write_motion(path, motion, credit=credit, overwrite=True)
    _say_written(*targets)


def text(
    caption: Positional[str], then: Repeatable = (), model: str | None = None, data: str = "bandai",
    weights: Path | None = None, seconds: float = 4.0, guidance: float | None = None, steps: int | None = None,
    seed: int = 0, control: Path | None = None, joint: str = "pelvis", any_words: bool = False,
    text_weights: Path | None = None, format: str = "bvh", overwrite: bool = False, out: Path = Path("out"),
) -> None:  # fmt: skip
    """Animate a caption: motion, film strip, player.

    Args:
      caption: such as "an elderly person raises the left hand".
      then: what the person does next, without a stop; repeatable. Needs a model of the prefix form.
      model: a preset, such as ACMDM-S-PS22-raw-n3; by default the newest of ACMDM's that is trained.
        motionpcm stands for its small student of so many --steps, MotionPCM-M1-small by default.
      data: the data set that it was trained on.
      weights: a weights file instead.
      seconds: of each caption.
      guidance: strength of the caption; by default the model's own, else the paper's 3 (control 2.5, a stream 4).
        MotionPCM counts from 0, not from 1: 14, of a student between 5 and 15; its teacher 6.5.
      steps: of Euler's method; by default the model's own sampler, which may choose its steps itself. A student of
        MotionPCM takes 1, 2 or 4, as it was trained for, its teacher (MotionPCM-teacher-small) any number.
      seed: of the noise.
      control: CSV with the header frame,x,y,z: where a joint should be, frames from 0, metres. Needs a control branch.
      joint: the controlled joint: pelvis, left_foot, right_foot, head, left_wrist or right_wrist.
      any_words: allow words that are in no training caption.
      text_weights: folder of CLIP or Sentence-T5, for a model that was trained with one of them.
      format: of the motion: bvh, glb (glTF with a body), csv or gif (its first 12 s; with ffmpeg also as MP4); several
        with commas between.
      overwrite: replace existing files.
      out: folder to write to.
    """
    captions, seed = [caption, *then], checked_seed(seed)
    _only_with("--control", control is None, joint=joint != "pelvis")
    if then and control:
        raise ValueError("--control is for one caption, not for a stream: leave out --then or --control")
    name = f"{re.sub('[^a-z0-9]+', '-', ' then '.join(captions).lower()).strip('-')[:80]}_seed{seed}"
    targets = _targets(out, name, format, overwrite)
    terminal.check_there(weights, control, text_weights)
    if weights is None:
        preset = model or (captioned_motion.STREAM_PRESET if then else None)
        latent = model and text_models.is_latent_preset(text_models.named_model(model, steps))
        weights = text_models.find_text_model(data, preset, control=bool(control and not latent), num_steps=steps)
    trained = _say_model(text_models.load_text_model(weights))
    encoder = trained.text_encoder.split("-")[0]
    _only_with("a model of CLIP or Sentence-T5", encoder == "wordllama", text_weights=text_weights)
    encoder = text_encoders.load_text_encoder(encoder, text_weights)
    how = {"seconds": seconds, "seed": seed, "guidance": guidance, "num_steps": steps, "any_words": any_words}
    made = captioned_motion.animate(trained, encoder, captions, control=control, joint=joint, **how)
    far = lambda metres: f"{100 * metres.mean():.1f} cm on average, {100 * metres.max():.1f} cm at most"
    log.info("bones        lengths corrected: joints moved by %s", far(made.moved))
    if control is not None:
        log.info("control      %s misses its path by %s", joint, far(made.missed))
    shown = player.Character(made.motion, name=name)
    _write_shown(targets, player.Scene([shown], title=made.motion.name, boundaries=made.boundaries), trained)


def _motion_formats(given: str, *more: str) -> list[str]:
    """Return the file endings of `--format bvh,glb`; ValueError for one that is not known."""
    names, known = [name.strip().lower() for name in given.split(",")], ("bvh", "glb", "csv", *more)
    if not {*names} <= {*known}:
        raise ValueError(f"--format {given}: give one of {', '.join(known)}, or several with commas between")
    return [f".{name}" for name in names]


def _num_frames(seconds: float) -> int:
    """Return the frames of a length that was asked for; ValueError if it is out of range."""
    if not 0.1 <= seconds <= 3600.0:  # also catches NaN
        raise ValueError(f"--seconds must be between 0.1 and 3600, got {seconds}")
    return max(2, round(seconds * 30))


def crowd(
    model: Model, characters: int = 1024, seconds: float = 32 / 30, style: Repeatable = (), seed: int = 0,
    chunk: int | None = None, plan: Annotated[tuple[float, ...] | None, tyro.conf.arg(metavar="[METRES]")] = None,
    pictures: bool = False, format: str | None = None, raw: bool = False, out: Path = Path("out/crowd"),
) -> None:  # fmt: skip
    """Animate any number of characters, streamed to a folder; a stopped run continues.

    Args:
      characters: how many.
      seconds: of each character.
      style: taken in turn; repeatable; by default all.
      seed: of paths and noise.
      chunk: characters at once.
      plan: paths that keep this far apart at every frame, 0.8 without a number.
      pictures: draw OUT.png and the player page OUT.html as well, with seams blended and feet held.
      format: write everybody to OUT_motions/, too, finished like the pictures: bvh, glb or csv; several with commas.
      raw: draw and write them as the network made them; the folder always holds this.
      out: folder to write to.
    """
    if plan is not None and len(plan) > 1:
        raise ValueError(f"--plan takes one number of metres, got {len(plan)}")
    out = out.resolve()
    drawn = [out.with_name(f"{out.name}{ending}") for ending in (".png", ".html")] if pictures else []
    formats, motions = _motion_formats(format) if format else [], out.with_name(f"{out.name}_motions")
    num_frames = _num_frames(seconds)
    terminal.check_free([*drawn, *([motions] if formats else [])], model.overwrite)
    check_own_folder(out, "crowd.json")
    terminal.check_writable(out)
    named = [model.style(one) for one in style] or None
    log.info("animating    %d characters, %.1f seconds each", characters, num_frames / 30)
    generator = model.generator()
    made = crowds.generate_crowd(
        generator, characters, num_frames, out, styles=named,
        min_distance=None if plan is None else (*plan, crowds.MIN_DISTANCE)[0], seed=seed, chunk=chunk,
        overwrite=model.overwrite, progress=True,
    )  # fmt: skip
    log.info("wrote        %s: %d characters of %d frames", out, len(made), made.num_frames)
    window = generator.trained.config.window
    shown = made.motion if raw else lambda character: finishing.finished(made.motion(character), window)
    credit = generated.generated_credit(*map(made.settings["model"].get, ("name", "dataset_credit", "dataset_licence")))
    if formats:  # the longer part first: where it is stopped, nothing stands in the way of the same command
        finishing.crowd_motions(made, shown, credit, motions, formats)
        _say_written(motions)
    if pictures:
        finishing.crowd_pictures(made, shown, credit, *drawn)
        _say_written(*drawn)


def export(
    model: Model, characters: int | None = None, target: Repeatable = (), stored: str = "float32",
    out: Path = Path("out/round"),
) -> None:  # fmt: skip
    """Make a round that runs without the model code: StableHLO, jax.export, IREE; or a denoiser for ONNX.

    Args:
      characters: of one call; by default 1, and with onnx any number.
      target: llvm-cpu, vmvx, vulkan-spirv, cuda-sm_80; repeatable; by default this processor. Or onnx, alone.
      stored: with onnx, how weights are kept: float32, float16, int8.
      out: folder to write to.
    """
    terminal.check_writable(out)
    _only_with("--target onnx", "onnx" not in target, stored=stored != "float32")
    how = {"num_steps": model.steps, "overwrite": model.overwrite}
    if "onnx" in target:
        if len(target) > 1 or model.sampler:
            raise ValueError("--target onnx exports one evaluation: leave out other targets and --sampler")
        trained = (model.weights and onnx_export.load_text_or_latent(model.weights)) or model.load()
        made = onnx_export.export_onnx(trained, out, batch=characters, weights=stored, **how)
    else:
        if not target and importlib.util.find_spec("iree"):
            target = ("llvm-cpu",)
        elif not target:
            log.info("not compiled for this processor, since IREE is missing: make bench-tools")
        batch = 1 if characters is None else characters
        made = exports.export_model(model.load(), out, batch=batch, sampler=model.sampler, targets=target, **how)
    _say_written(*sorted(made.iterdir()))


def steer(model: Model, stored: str = "int8", runtime: str = "wasm", out: Path = Path("out/steer.html")) -> None:
    """Write a page on which one steers the model by keys, mouse, touch or gamepad; it needs no server.

    Args:
      stored: how weights are kept: int8, float16, float32.
      runtime: what runs the network: wasm; or webgpu, where the browser has it, in a larger page.
      out: page to write.
    """
    terminal.check_free([out], model.overwrite)
    terminal.check_there(model.file)
    _say_written(steering.write_steer(out, model.load(), num_steps=model.steps, weights=stored, runtime=runtime))


def bench(
    motion: Data, suite: Repeatable = (), characters: UseAppendAction[tuple[int, ...]] = (), again: bool = False,
    training: bool = False, parts: bool = False,
) -> None:  # fmt: skip
    """Time synthesis and training; write records, which notebook 09 compares with our bars.

    Args:
      suite: smoke, bars, main, family, windows, curve or gpu; repeatable; by default the profile's.
      characters: these numbers only; repeatable.
      again: measure again what is in the table.
      training: time training steps (Table 2).
      parts: time a round without each part.
    """
    _use_fast_flags()
    for name in suite:
        measurements.plan(name)  # refuses an unknown one
    prepared, profile = motion.open()
    if suite or not (training or parts):
        how = {"characters": characters or None, "again": again}
        table = measurements.measure_synthesis_time(prepared, profile, suite, **how)
        _say_written(table.with_name("synthesis_ways.csv"), table)
    if parts:
        _say_written(measurements.measure_round_parts(prepared, profile))
    if training:
        _say_written(measurements.measure_training_time(prepared, profile, again=again))


def measure(
    names: Positional[tuple[str, ...]] = (), *, motion: Data, model: Repeatable = (), published: Path | None = None,
    minutes: float | None = None, captions: Encoder = Encoder(), plan: Literal["", "queue"] = "",
    packed: Path | None = None,
) -> int:  # fmt: skip
    """Measure what notebooks only draw; tables go to <results>/records/.

    Args:
      names: quality, walking, noise_use and so on; all if none. Of text to motion (--data bandai) text_judge,
        hands, text_table1, text_tableA1, text_table3, text_table4, text_tableA5, text_pcm1 to text_pcm4,
        text_guidance, by name alone.
      model: this preset; repeatable.
      published: CAMDM's published weights as safetensors, one more row of quality.
      minutes: of text to motion: stop after these with exit status 3; the same command continues.
      plan: of text to motion: queue trains each row to several lengths, and compared ones with several seeds (hours to
        days); all of its tables, in its order, if none is named.
      packed: of text to motion: all clips of bandai as their packed cache file, instead of their source.
    """
    names = names or (papers.load_paper_file("experiments", "acmdm")["settings"][plan]["order"] if plan else ())
    terminal.check_there(published, packed)
    for name in names:
        check_known(name, [*measuring.MEASUREMENTS, *text_tables.TEXT_MEASUREMENTS], "measurement")
    idle = {"text_encoder": captions != Encoder(), "minutes": minutes, "plan": plan, "packed": packed}
    _only_with("text to motion", not {*names} & {*text_tables.TEXT_MEASUREMENTS}, **idle)
    _only_with("no --minutes, since each call begins with it anew", minutes is not None, model=model)
    if of_text := [name for name in names if name in text_tables.TEXT_MEASUREMENTS]:
        if len(of_text) < len(names):
            raise ValueError(f"{', '.join(of_text)}: measure text to motion in a separate call")
        _only_with("quality", True, published=published)
        profile, how = motion.numbers(), {"models": model, "stop_at": _stop_at(minutes)}
        clips = text_motions.bandai_text_motions(packed_data.load_packed(packed)) if packed else None
        given = clips or text_models.open_text_motions(motion.data, motion.source), captions.load(), profile
        measurements, how = text_tables.TEXT_MEASUREMENTS, how | ({"plan": plan} if plan else {})
    else:
        models = [network_presets.find_preset(name).name for name in model] or None
        prepared, profile = motion.open()
        of_windows = {"quality", "trained", "walking"} if not published else {"quality"}
        if (profile.window != motion.numbers().window or published) and not (names and {*names} <= of_windows):
            what = "--window is for quality, trained and walking, --published for quality"
            raise ValueError(f"{what}: measure these by name")
        given, how, measurements = (prepared, profile, models), _given(published=published), measuring.MEASUREMENTS
    for name in names or measurements:
        lock = results_dir(profile.dataset, profile.name) / "records" / f".{name}.lock"
        with locked(lock, f"measuring {name}"):
            table = measurements[name](*given, **how)
        log.info("%-12s %s", name, table or "unfinished: call again to go on")
        if table is None:
            return UNFINISHED
    return 0


def campaign(
    motion: Data, minutes: float | None = None, batch_size: int = 128, only: Repeatable = (),
    packed: Path | None = None, times: bool = False, precision: str = "float32", out: Path | None = None,
    queue: str = "campaign", package: str | None = None, measure: bool = False,
) -> int:  # fmt: skip
    """Train and measure the queue of real motion; a stopped run continues.

    Args:
      minutes: stop after these with a checkpoint and exit status 3; the same command continues. A running measurement
        is finished.
      batch_size: windows a step; the paper's is 512.
      only: this preset, recipe or run of the queue; repeatable.
      packed: the data set as its packed cache file, instead of its source.
      times: first the times of Tables 1, 2 (32 frames), 4, 7 and 11 that are not on record, and then the longest
        trainings of the queue first; for a GPU.
      precision: of the matrix products of training; tf32 is quicker on a GPU.
      out: folder for states and weights instead of runs/DATA/PROFILE/campaign.
      queue: campaign, or readings: which reading of the paper behaves like the paper?
      package: train this package of papers/f3amd/gpu_plan.toml and keep its weights, unmeasured, for a GPU.
      measure: measure a package's weights in the folder, and train nothing.
    """
    stop_at = _stop_at(minutes)
    check_known(queue, long_queue.QUEUES, "queue")
    _only_with("no --package", package is not None, queue=queue != "campaign")
    checked_value("--batch-size", batch_size, "int")
    _use_fast_flags(None if times else 1)
    long_queue.check_precision(precision)
    place, table = (long_queue.QUEUES[queue], queue) if package is None else (long_queue.GPU_PLAN, "readings")
    snapshots = long_queue.queue(place, package)
    snapshots = long_queue.chosen(long_queue.longest_first(snapshots) if times else snapshots, only)
    if packed is None:
        prepared, profile = motion.open()
    else:
        profile = motion.numbers()
        prepared = pipeline.PreparedData(packed_data.load_packed(packed), profile.window, profile.num_history)
    state, folder = "measured", out or runs_dir(profile.dataset, profile.name) / "campaign"
    how = {"snapshots": snapshots, "batch_size": batch_size, "precision": precision, "stop_at": stop_at}
    with locked(folder / ".campaign.lock", "running the campaign"):
        for measure_time in (measurements.measure_synthesis_time, measurements.measure_training_time) if times else ():
            timed = measure_time(prepared, profile, stop_at=stop_at)
            log.info("%-12s %s", "times", timed or "unfinished")
            if timed is None:
                return UNFINISHED
        if stop_at is not None and time.monotonic() >= stop_at:  # a style classifier may have to be trained
            return UNFINISHED
        judges = () if package is not None and not measure else measuring.protocol_of(prepared, profile, "campaign")[:2]
        how |= {"folder": folder, "table": table, "found_alone": measure}
        for name, windows, state in long_queue.run_campaign(prepared, profile, *judges, **how):
            log.info("%-12s %s, %s windows", state, name, f"{windows:,}")
    return UNFINISHED if state == "unfinished" else 0


def sweep(
    names: Positional[tuple[str, ...]] = (), *, motion: Data, preset: Repeatable = (), workers: int = 2,
    scheduler: str | None = None, queue: Path | None = None, batch_size: int = 128, out: Path | None = None,
) -> int:  # fmt: skip
    """Run the queue, or measurements of presets, in several processes; a dead worker costs only its task.

    Args:
      names: campaign, or measurements such as quality, walking; a leg each for every preset.
      preset: this one; repeatable. By default all of the queue, and all that have weights.
      workers: processes on this machine.
      scheduler: HOST:PORT of a Dask cluster instead; all its machines see one clone.
      queue: another file for campaign than papers/f3amd/campaign.toml.
      batch_size: windows a step of the queue's trainings; the paper's is 512.
      out: folder for legs, states and weights of the queue, instead of runs/DATA/PROFILE.
    """
    checked_value("--workers", workers, "int")
    profile = motion.numbers()
    if motion.window not in (None, profile.window) or motion.people != People():
        raise ValueError("leave out --window and how a folder is read: several processes do not take them")
    folder = (out or runs_dir(profile.dataset, profile.name)).resolve()
    results = results_dir(profile.dataset, profile.name).resolve()
    work = engine.Work(profile, motion.source, results.parents[1], folder, batch_size)
    legs = engine.plan(names, preset, profile, long_queue.queue(*([queue] if queue else [])))
    with contextlib.ExitStack() as held:
        held.enter_context(locked(folder / "sweep" / ".sweep.lock", "sweeping"))
        for name in names:
            place = folder / "campaign" if name == engine.CAMPAIGN else results / "records"
            held.enter_context(locked(place / f".{name}.lock", f"doing {name}"))
        prepared, _ = motion.open()  # so that workers find the cache, and the classifier below
        if engine.CAMPAIGN in names or not records.THROUGH_CLASSIFIER.isdisjoint(names):  # trained before the legs
            measuring.protocol_of(prepared, profile, "sweep")
        record = runner.record_of(profile, prepared.packed, "sweep")
        costs, finished = runner.Records(results / "records", record, {"sweep": ["leg"]}), []
        try:
            for number, (leg, told) in enumerate(engine.run_sweep(work, legs, workers=workers, scheduler=scheduler), 1):
                log.info("%s, %d of %d: %s", leg.name, number, len(legs), told["state"])
                finished += [leg] if told["state"].startswith("done") else []
                if told["state"] == "done":
                    cost = {key: told[key] for key in ("seconds", "state_bytes", "device")}
                    costs.put("sweep", {"leg": leg.name}, pd.DataFrame([cost | {"model": leg.preset}]))
        finally:
            _say_written(*engine.gather(work, sorted(finished, key=legs.index)))
    return 0 if len(finished) == len(legs) else 1


def figures(data: str = "synthetic", profile: str = "laptop", only: Repeatable = (), set: Repeatable = ()) -> None:
    """Run the numbered notebooks in order; results go under paper_figures/.

    Args:
      data: synthetic, bandai, 100style or folder.
      profile: smoke, laptop or gpu.
      only: number of a notebook; repeatable.
      set: NAME=VALUE, a parameter of every notebook that runs; repeatable.
    """
    parameters = dict(map(notebook_runs.parse_assignment, set))
    notebook_runs.set_folders(profile)
    took = notebook_runs.reproduce(data, profile, only=only, parameters=parameters, say=log.info)["seconds"]
    log.info("%d notebooks in %.1f minutes (data %s, profile %s)", len(took), took.sum() / 60, data, profile)
    log.info("results      %s", results_dir(data, profile))


def course(only: Repeatable = ()) -> None:
    """Run the course on samplers, notebooks/course/; it needs no data, and copies go to runs/course/.

    Args:
      only: number of a notebook; repeatable.
    """
    notebook_runs.run_course(only, say=log.info)


def convert(
    weights: Positional[Path], family: str, to: str, preset: str = "", statistics: Path | None = None,
    autoencoder: Path | None = None, text_weights: Path | None = None, source: Path | None = None,
    layout: str = "humanml3d", overwrite: bool = False, out: Path = Path("out"),
) -> None:  # fmt: skip
    """Write weights that a paper's authors released as a model of ours, with a card of where they came from.

    Args:
      weights: arrays of their checkpoint, a .safetensors file (docs/reproduce.md).
      family: acmdm, acmdm-autoencoder, acmdm-control, acmdm-noisy-condition, motionlcm-vae, motionlcm-teacher,
        motionlcm-student, evaluator, acmdm-evaluator or acmdm-clip-evaluator.
      to: name of the file.
      preset: ours that says what the arrays do not, instead of the family's.
      statistics: folder in which or below which their means and deviations lie (.npy).
      autoencoder: arrays of ACMDM's autoencoder, for a model of its latent.
      text_weights: folder of what embeds captions: CLIP, Sentence-T5, an evaluator's GloVe files.
      source: folder in HumanML3D's layout, whose words have the tags that an evaluator reads.
      layout: of the skeleton: humanml3d or kit.
      overwrite: replace existing files.
      out: folder to write to.
    """
    target = out / f"{to}.safetensors"
    terminal.check_there(weights, statistics, autoencoder, text_weights, source)
    terminal.check_free([target, target.with_suffix(".md")], overwrite)
    if family == "camdm":
        raise ValueError("CAMDM's weights need no conversion: f3amd measure quality --published FILE")
    options = {"preset": preset, "statistics": statistics, "autoencoder": autoencoder, "layout": layout}
    encoder = released.released_encoder(family, text_weights, source)
    trained = _say_model(released.read_released(weights, family, encoder=encoder, **options))
    text_models.save_text_model(target, trained, np.dtype("float32"))
    card = Path(__file__).with_name("released_card.template").read_text(encoding="utf-8")
    parts = [part for part in (trained.params, *trained.parts()[0].values()) if part is not None]
    count, read_by = optax.tree.size(parts), trained.text_encoder or "reads no captions"
    told = {"trained": trained, "record": trained.record, "kind": trained.kind, "count": count, "encoder": read_by}
    _say_written(target, write_whole(target.with_suffix(".md"), card.format(**told)))


def reproduce(
    paper: Positional[Literal["acmdm", "motionpcm", "f3amd"]], *, data: Path, table: str = "1",
    evaluator: Path | None = None, weights: Path | None = None,
    text_encoder: Literal["wordllama", "clip", "t5"] | None = None, text_weights: Path | None = None,
    repeats: int | None = None, reading: str = "paper", windows: int | None = None, batch_size: int = 512,
    profile: str = "gpu", minutes: float | None = None, seed: int = 0, out: Path | None = None,
) -> int:  # fmt: skip
    """Print a paper's own table with yours beside it, from its data and weights (docs/reproduce.md).

    Args:
      data: HumanML3D's or KIT-ML's folder; for f3amd 100STYLE's archive or folder.
      table: its number; for f3amd both, 3 and 5.
      evaluator: folder of the published evaluator: arrays (.safetensors), means and deviations, words.
      weights: folder of models by their presets' names, converted, released (.safetensors) or your own; without it
        real motion alone is measured.
      text_encoder: what embeds the models' captions; by default the paper's.
      text_weights: folder of its weights.
      repeats: instead of 20; fewer are a look, no measurement.
      reading: for f3amd a row of recipes.toml, or several joined by +.
      windows: for f3amd how many are trained on, instead of 100 epochs.
      batch_size: of that training.
      profile: for f3amd gpu, laptop or smoke.
      minutes: stop after these with exit status 3; the same command continues.
      seed: of captions, crops and noise.
      out: folder of the records instead of runs/; for f3amd of states and weights.
    """
    terminal.check_there(data, evaluator, weights, text_weights)
    of_text = {"evaluator": evaluator, "weights": weights, "text_encoder": text_encoder, "text_weights": text_weights}
    _only_with("acmdm or motionpcm", paper == "f3amd", **of_text, repeats=repeats, table=table != "1")
    of_f3amd = {"reading": reading != "paper", "windows": windows, "batch_size": batch_size != 512}
    _only_with("f3amd", paper != "f3amd", **of_f3amd, profile=profile != "gpu")
    for name, count in (("repeats", repeats), ("windows", windows), ("batch-size", batch_size)):
        checked_value(f"--{name}", count, "int | None")
    if paper == "f3amd":
        motion = Data("100style", profile, str(data))
        long_queue.find_recipe(reading)
        prepared, numbers = motion.open()
        folder = out or runs_dir("100style", profile) / "reproduced"
        with locked(folder / ".f3amd.lock", "reproducing F3AMD"):
            given = prepared, numbers, *measuring.protocol_of(prepared, numbers, "reproduced")[:2]
            how = {"folder": folder, "reading": reading, "num_windows": windows, "batch_size": batch_size, "seed": seed}
            paths = long_queue.reproduce_own(*given, **how, stop_at=_stop_at(minutes))
        return _say_reproduced(paths)
    if evaluator is None:
        raise ValueError("--evaluator is needed: the folder of the published one, see docs/reproduce.md")
    folder = out or runs_dir("folder", "gpu") / "reproduced" / paper
    given = paper_tables.Sources(data, evaluator, weights, text_encoder, text_weights)
    with locked(folder / f".{Path(table).name}.lock", f"reproducing table {table}"):
        how = {"out": folder, "repeats": repeats, "seed": seed, "stop_at": _stop_at(minutes)}
        path = paper_tables.reproduce_table(paper, table, given, **how)
    return _say_reproduced(path and [path])


def _say_reproduced(paths: Sequence[Path] | None) -> int:
    """Show tables beside the paper's; return the exit status, of None the status of an unfinished run."""
    for path in paths or ():
        log.info("\n%s\n", tables.markdown_table(records.read_table(path)[0], digits=3))
        _say_written(path)
    return UNFINISHED if paths is None else 0


RESUMED = ("train", "crowd", "bench", "measure", "campaign", "sweep", "figures", "reproduce")
"""Commands that leave whole what they have done, and go on from it."""

COMMANDS = (
    data, joints, dataset, styles, presets, train, rollout, text, crowd, export, steer, bench, measure, campaign, sweep,
    figures, course, convert, reproduce,
)  # fmt: skip


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command; errors that the user can fix end with one line and status 2."""
    logging.basicConfig(format="%(message)s", stream=sys.stdout)  # of others' logs, warnings
    logging.Handler.handleError = terminal.raise_again
    terminal.set_environment()
    given = sys.argv[1:] if argv is None else list(argv)
    words = [word for word in given if word != "--quiet"]
    named = {command.__name__: command for command in COMMANDS}
    if words == ["--version"]:
        print(f"f3amd {__version__}")
        return 0
    terminal.show_plainly("--quiet" in given)
    name = words[0] if words else ""
    stopped = f"f3amd {name}: stopped by Ctrl-C" + "; the same command goes on from what is written" * (name in RESUMED)
    if argv is None and name in ("sweep", "figures", "course"):  # these have processes to end in Python
        signal.signal(signal.SIGINT, signal.default_int_handler)
    elif argv is None:
        terminal.leave_on_ctrl_c(stopped, at_once=name not in RESUMED)
    try:
        if name and not name.startswith("-"):
            check_known(name, named, "command")
        status = tyro.extras.subcommand_cli_from_dict(
            named,
            prog="f3amd",
            description="Fast Fourier autoregressive motion diffusion: data, training, motion, measurements, figures. "
            "f3amd --version names the version; --quiet with any command shows warnings and errors alone.",
            args=words,
            config=(tyro.conf.OmitArgPrefixes, tyro.conf.FlagCreatePairsOff),
        )
    except BrokenPipeError:  # `f3amd styles | head`: what is left has no reader
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 141
    except (ValueError, OSError, ArithmeticError, ImportError, MemoryError, RuntimeError) as error:
        print(f"f3amd {name}: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        if argv is None:
            terminal.leave(stopped)
        print(f"\n{stopped}", file=sys.stderr)
        return 130
    if status == UNFINISHED:
        log.info("unfinished   to continue: f3amd %s", shlex.join(given))
    return status or 0


if __name__ == "__main__":
    sys.exit(main())
