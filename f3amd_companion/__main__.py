"""The command `f3amd`, such as `f3amd rollout --style proud --path figure-eight --out out/`.

A function a command: its parameters are the options, its docstring is their help. What needs JAX is
imported inside, so that `f3amd --help` is quick.
"""

import contextlib
import importlib.util
import logging
import os
import re
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from tyro.conf import Positional, UseAppendAction

from f3amd_lib.ground.files import locked, whole_folder
from f3amd_lib.ground.names import check_known, checked_seed
from f3amd_lib.ground.profiles import load_profile, results_dir, runs_dir

log = logging.getLogger("f3amd")

UNFINISHED = 3
"""Exit status of `train`, `measure` and `campaign` where the minutes were over first; a later call goes on."""

Repeatable = UseAppendAction[tuple[str, ...]]
Required = Annotated[str, tyro.conf.arg(metavar="NAME")]


def _given(**options) -> dict:
    """Return those options that were given: not None."""
    return {name: value for name, value in options.items() if value is not None}


def _stop_at(minutes: float | None) -> float | None:
    """Return when so many minutes from now are over (`time.monotonic`)."""
    return None if minutes is None else time.monotonic() + 60.0 * minutes


def _use_fast_flags() -> None:
    """Set XLA's flags, unless the user has; JAX reads them when it first looks for devices: call this before."""
    from f3amd_companion.speed.machine import fast_xla_flags

    if "XLA_FLAGS" not in os.environ:
        os.environ["XLA_FLAGS"] = fast_xla_flags()


@dataclass(frozen=True)
class Data:
    """Motion, and how much is done with it.

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

    def numbers(self, **overrides):
        """Return the profile with those values replaced that are given."""
        return load_profile(self.profile, self.data, **_given(**overrides))

    def open(self, **overrides):
        """Return the data set, prepared, and the profile as `numbers` does, with this window."""
        from f3amd_lib.training.pipeline import prepare

        profile = self.numbers(**overrides, window=self.window)
        return prepare(profile, path=self.source), profile


@dataclass(frozen=True)
class Model:
    """A trained model, and how it is sampled.

    Attributes:
      steps: denoising steps a round.
      sampler: ddim, ddpm, euler or heun; by default the model's own.
      data: use the model of this data set.
      weights: a weights file, instead of the data set's own.
      overwrite: replace what lies there.
    """

    steps: int = 8
    sampler: str | None = None
    data: str = "synthetic"
    weights: Path | None = None
    overwrite: bool = False

    def load(self):
        """Load the model, and say what it is."""
        from f3amd_lib.training.checkpoints import load_model
        from f3amd_lib.training.pipeline import find_model

        trained = load_model(self.weights or find_model(self.data))
        log.info("model        %s, trained on %s", trained.name, trained.record.get("dataset"))
        log.info("terms        %s", trained.record.get("dataset_licence"))
        return trained

    def generator(self):
        """Return what animates characters with the model."""
        from f3amd_lib.rollout.rollout import MotionGenerator

        return MotionGenerator(self.load(), self.steps, sampler=self.sampler)

    def check_free(self, *targets: Path) -> None:
        """Raise ValueError if one of the files is there and may not be replaced."""
        taken = [str(target) for target in targets if target.exists()]
        if taken and not self.overwrite:
            raise ValueError(f"{', '.join(taken)}: exists already; pass --overwrite or another --out")


def data(motion: Data) -> None:
    """Open a data set, build its packed cache, say what is in it."""
    from f3amd_lib.data.sources import SPLITS

    packed = motion.open()[0].packed
    splits = packed.clip_split.tolist()
    facts = {
        "data set": packed.dataset,
        "terms": packed.licence,
        "credit": packed.credit,
        "clips": f"{packed.num_clips} ({len(packed.skipped)} left out)",
        "frames": f"{packed.num_frames} at 30 fps",
        "joints": packed.skeleton.num_joints,
        "styles": ", ".join(packed.styles),
        "split": ", ".join(f"{splits.count(number)} {split}" for number, split in enumerate(SPLITS)),
    }
    for name, fact in facts.items():
        log.info("%-12s %s", name, fact)


def dataset(
    captions: Path, source: str | None = None, data: str = "folder", fps: float = 20.0, out: Path = Path("out/dataset")
) -> None:
    """Write motions with captions as a data set in HumanML3D's layout, for text-to-motion code.

    Args:
      captions: CSV file with columns file and caption, one line a caption.
      source: folder or zip of BVH files of one skeleton.
      data: another data set instead of a folder: synthetic, bandai, 100style.
      fps: frames per second to write.
      out: folder to write to; must be empty or not there yet.
    """
    from f3amd_companion.serving import captioned_folder
    from f3amd_lib.data import sources

    opened = sources.open_dataset(data, path=source)
    written = captioned_folder.captioned_motions(opened, captioned_folder.read_caption_table(captions), fps=fps)
    folder = captioned_folder.write_humanml3d(out, written)
    for clip, reason in written.skipped:
        log.info("left out     %s: %s", clip, reason)
    joints, counts = written.skeleton.num_joints, [f"{written.splits.count(split)} {split}" for split in sources.SPLITS]
    log.info("split        %s", ", ".join(counts))
    log.info("joints       %d, so vectors of %d numbers", joints, 12 * joints - 1)
    log.info("terms        %s", written.licence)
    log.info("wrote        %s: %d clips", folder, written.num_clips)


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
    from f3amd_lib.ground.tables import markdown_table
    from f3amd_lib.networks import presets

    of_data = {"channels": channels, "num_styles": styles, "num_joints": joints} | _given(text_width=text_width)
    log.info("%s", markdown_table(presets.table(paper, **of_data)))


def train(
    motion: Data, preset: Repeatable = (), minutes: float | None = None, steps: int | None = None,
    batch_size: int | None = None, seed: int | None = None, out: Path | None = None, all_devices: bool = False,
    processes: int | None = None, process: int | None = None, coordinator: str | None = None, cluster: bool = False,
    teacher: Path | None = None,
) -> int:  # fmt: skip
    """Train a model; a killed run goes on where it stopped.

    Args:
      preset: such as F3AMD-FNO-96; by default the profile's; repeatable, trained in this order. Of text to motion
        (--data bandai) such as ACMDM-S-PS22-raw-n3; NAME+control its control branch, NAME+control-pelvis one that
        knows the pelvis alone; judge the judge;
        MotionPCM-M1-small and so on a student, with the autoencoder and the teacher before it.
      minutes: stop then, with a checkpoint that a later call goes on from, and exit status 3.
      steps: optimiser steps; by default the profile's.
      batch_size: windows a step.
      seed: of weights, batches and noise.
      out: folder for the model instead of runs/DATA/PROFILE/models.
      all_devices: share each batch among the devices JAX sees.
      processes: train in so many processes together.
      process: number of this one, from 0.
      coordinator: HOST:PORT of process 0.
      cluster: train in all processes of a job of Slurm, Open MPI or Kubernetes together.
      teacher: file of the teacher of a MotionPCM student, such as the one that ships, instead of training one.
    """
    from f3amd_companion.measuring.learning_curves import train_family
    from f3amd_lib.training import parallel, pipeline

    if teacher is not None and not (preset and all(name.startswith(("MotionPCM", "MotionLCM")) for name in preset)):
        raise ValueError("--teacher is for students of MotionPCM: leave it out")
    together = (coordinator, processes, process)
    named = any(value is not None for value in together)
    if any(name == "judge" or "ACMDM" in name or name.startswith(("MotionPCM", "MotionLCM")) for name in preset):
        if all_devices or cluster or named:
            what = "--all-devices, --processes, --process, --coordinator and --cluster"
            raise ValueError(f"models of captioned motion train on one device: leave {what} out")
        return _train_text(motion, preset, minutes, steps, batch_size, seed, out, teacher)
    if cluster and named:
        raise ValueError("--cluster finds the processes itself: leave the three others out")
    if cluster or named:
        parallel.join_processes(*together)
    prepared, profile = motion.open(train_steps=steps, batch_size=batch_size, seed=seed)
    budget = None if minutes is None else 60.0 * minutes
    mesh = parallel.all_devices() if cluster or named or all_devices else None
    runs = train_family(prepared, profile, list(preset) or [profile.preset], folder=out, budget_s=budget, mesh=mesh)
    status = 0
    for name, state in runs:
        files = pipeline.model_files(profile, name, folder=out)
        log.info("%-12s %s", name, files.state if state == "unfinished" else files.model)
        status = UNFINISHED if state == "unfinished" else status
    return status


def _train_text(motion: Data, names, minutes, steps, batch_size, seed, out, teacher) -> int:
    """Train models of text to motion, or their judge; what is finished is left as it is."""
    from f3amd_lib.text.data.text_encoders import load_text_encoder
    from f3amd_lib.text.judge import text_judge
    from f3amd_lib.text.stages import text_models, train_stage

    for name in names:
        if name != text_models.JUDGE:
            train_stage.stage_of(name)  # refuses those that need no captions
    profile = motion.numbers(train_steps=steps, batch_size=batch_size, seed=seed)
    data, encoder = text_models.open_text_motions(motion.data, motion.source), load_text_encoder()
    stop_at = _stop_at(minutes)
    how = {"window": motion.window, "batch_size": batch_size, "folder": out, "teacher": teacher, "stop_at": stop_at}
    for name in names:
        files = text_models.text_model_files(profile, name, folder=out)
        if name == text_models.JUDGE:
            training = text_judge.EvaluatorTraining(**_given(num_steps=steps, batch_size=batch_size, seed=seed))
            done = text_judge.train_judge(data, encoder, training, files=files, stop_at=stop_at)
        else:
            done = train_stage.train_stage(data, encoder, profile, name, **how)
        log.info("%-12s %s", name, files.state if done is None else files.model)
        if done is None:
            return UNFINISHED
    return 0


def rollout(
    style: Required, model: Model, path: str = "figure-eight", seed: int = 0, seconds: float = 20.0,
    speed: float = 1.2, blend: int = 4, slide: bool = False, raw: bool = False, format: str = "bvh",
    start: Path | None = None, out: Path = Path("out"),
) -> None:  # fmt: skip
    """Animate one character: motion, film strip, GIF (its first 12 s), player.

    Args:
      style: one that the model knows.
      path: a named path, or a CSV file.
      seed: of path and noise.
      seconds: length of a named path; a CSV has its own.
      speed: of a named path, m/s; a CSV has its own.
      blend: so many frames after each window boundary.
      slide: do not hold feet where they stand.
      raw: as the network made it: no blending, no held feet.
      format: of the motion: bvh, glb (glTF with a body) or csv; several with commas between.
      start: a BVH file to go on from: its last frames are the history; another humanoid's are retargeted.
      out: folder to write to.
    """
    from f3amd_companion.serving.player import rollout_scene
    from f3amd_lib.motion.root_paths import named_path, read_path_csv

    name = f"{style}_{Path(path).stem}_seed{seed}"
    formats = _motion_formats(format)
    targets = [out / f"{name}{ending}" for ending in (".png", ".gif", ".html", *formats)]
    model.check_free(*targets)
    drawn = path.lower().endswith(".csv")
    line = read_path_csv(path) if drawn else named_path(path, _num_frames(seconds), speed=speed, seed=seed)
    generator = model.generator()
    trained = generator.trained
    history = None
    if start is not None:
        from f3amd_lib.motion.bvh import read_bvh
        from f3amd_lib.rollout.start_poses import start_history

        history, note = start_history(trained, read_bvh(start), line)
        log.info("start        %s", note)
    blend, lock = (0, False) if raw else (blend, not slide and _has_legs(trained.skeleton))
    made = generator.rollout(line, style, seed=seed, history=history, blend_frames=blend)
    if lock:
        from f3amd_companion.serving.foot_locking import lock_rollout

        made = lock_rollout(made)
    log.info("afterwards   %s", made.changes or "nothing: as the network made it")
    title = f"{trained.name}, {model.steps} step{'s' * (model.steps != 1)}, {style}, {Path(path).stem}"
    _write_shown(targets, rollout_scene(made, title), trained, overwrite=model.overwrite)


def _write_shown(targets, scene, trained, *, overwrite: bool) -> None:
    """Write a scene of one character as GIF (its first 12 s), player page with film strip, and in each format asked."""
    from f3amd_companion.serving.motion_files import write_motion
    from f3amd_companion.serving.player import write_player
    from f3amd_lib.drawing.pictures import write_gif
    from f3amd_lib.rollout.generated import generated_credit

    _, gif, page, *files = targets
    (character,) = scene.characters
    motion = character.motion
    credit = generated_credit(trained.name, *map(trained.record.get, ("dataset_credit", "dataset_licence")))
    every = max(1, round(motion.fps / 10))
    write_gif(gif, motion, target_paths=character.path, titles=[scene.title], every=every, max_seconds=12.0)
    write_player(page, scene, credit=credit)  # the strip has its name
    for path in files:
        write_motion(path, motion, credit=credit, overwrite=overwrite)
    for target in targets:
        log.info("wrote        %s", target)


def text(
    caption: Positional[str], then: Repeatable = (), model: str | None = None, data: str = "bandai",
    weights: Path | None = None, seconds: float = 4.0, guidance: float | None = None, steps: int | None = None,
    seed: int = 0, control: Path | None = None, joint: str = "pelvis", any_words: bool = False,
    text_weights: Path | None = None, format: str = "bvh", overwrite: bool = False, out: Path = Path("out"),
) -> None:  # fmt: skip
    """Animate what a caption tells: motion, film strip, GIF (its first 12 s), player.

    Args:
      caption: such as "an elderly person raises the left hand".
      then: what the person does after that, without a stop; repeatable. Needs a model of the prefix form.
      model: a preset, such as ACMDM-S-PS22-raw-n3; by default the newest of ACMDM's that is trained.
        motionpcm stands for its small student of so many --steps, MotionPCM-M1-small by default.
      data: the data set that it was trained on.
      weights: a weights file instead.
      seconds: of each caption.
      guidance: how hard the caption pushes; by default the model's own, else the paper's 3 (control 2.5, a stream 4).
        MotionPCM counts from 0, not from 1: 14, of a student between 5 and 15; its teacher 6.5.
      steps: of Euler's method; by default the model's own sampler, which may choose its steps itself. A student of
        MotionPCM takes 1, 2 or 4, as it was trained for, its teacher (MotionPCM-teacher-small) any number.
      seed: of the noise.
      control: CSV with the header frame,x,y,z: where a joint should be, frames from 0, metres. Needs a control branch.
      joint: that is controlled: pelvis, left_foot, right_foot, head, left_wrist or right_wrist.
      any_words: take words, too, that no caption of the training had.
      text_weights: folder of CLIP or Sentence-T5, for a model that was trained with one of them.
      format: of the motion: bvh, glb (glTF with a body) or csv; several with commas between.
      overwrite: replace what lies there.
      out: folder to write to.
    """
    import jax
    import numpy as np

    from f3amd_companion.serving import player
    from f3amd_lib.ground.trees import file_kind
    from f3amd_lib.motion import inverse_kinematics, skeleton
    from f3amd_lib.text.data import text_encoders
    from f3amd_lib.text.sampling import captioned_motion
    from f3amd_lib.text.stages import text_models

    captions = [caption, *then]
    text_encoders.check_captions(captions)
    seed = checked_seed(seed)
    captioned_motion.check_solver(steps, guidance)
    if weights is None:
        latent = model is not None and (model.lower() == "motionpcm" or text_models.is_latent_preset(model))
    else:
        latent = file_kind(weights) == text_models.LatentModel.kind  # the file itself says whose it is
    if then and control:
        raise ValueError("--control is for one caption, not for a stream: leave out --then or --control")
    if latent and (then or control):
        raise ValueError(f"{model or weights} makes whole motions of one caption: leave out --then and --control")
    name = f"{re.sub('[^a-z0-9]+', '-', ' then '.join(captions).lower()).strip('-')[:80]}_seed{seed}"
    targets = [out / f"{name}{ending}" for ending in (".png", ".gif", ".html", *_motion_formats(format))]
    Model(overwrite=overwrite).check_free(*targets)
    preset = model or (captioned_motion.STREAM_PRESET if then else None)
    found = weights or text_models.find_text_model(data, preset, control=control is not None, num_steps=steps)
    trained = text_models.load_text_model(found)
    log.info("model        %s, trained on %s", trained.name, trained.record.get("dataset"))
    log.info("terms        %s", trained.record.get("dataset_licence"))
    encoder = text_encoders.load_text_encoder(trained.text_encoder.split("-")[0], text_weights)
    pooled = captioned_motion.told_captions(trained, encoder, captions, any_words=any_words)
    key, how, points, boundaries = jax.random.key(seed), {"guidance": guidance, "num_steps": steps}, None, ()
    if then or getattr(trained, "starts", ()):
        windows = captioned_motion.told_windows(trained, seconds)
        starts = text_encoders.embed_captions(list(trained.starts), encoder).pooled
        counts = [windows] * len(captions)
        positions = captioned_motion.stream_motions(trained, pooled, counts, key, starts=starts, **how)
        each = windows * captioned_motion.window_frames(trained)
        boundaries = range(len(positions) - each * len(captions), len(positions), each)
    else:
        num_frames = captioned_motion.told_frames(trained, seconds)
        if control is not None:
            which = captioned_motion.find_joint(trained, joint)
            frames, points = captioned_motion.read_control_csv(control, num_frames)
            how["control"] = captioned_motion.control_of(trained, which, frames, points, num_frames)
        positions = captioned_motion.draw_motions(trained, pooled, num_frames, key, **how)[0]
    title = ", then ".join(captions)
    made = skeleton.Motion.from_positions(trained.skeleton, positions, trained.fps, title)
    motion, residual = inverse_kinematics.fitted(made)
    log.info("bones        joints moved by %.1f cm on average, %.1f cm at most, so that bones keep their lengths",
             100 * residual.mean(), 100 * residual.max())  # fmt: skip
    if points is not None:
        missed = 100 * np.linalg.norm(motion.positions[frames, which] - points, axis=-1)
        log.info("control      %s is %.1f cm away on average, %.1f cm at most", joint, missed.mean(), missed.max())
    scene = player.Scene([player.Character(motion, name=name)], title=title, boundaries=boundaries)
    _write_shown(targets, scene, trained, overwrite=overwrite)


def _motion_formats(given: str) -> list[str]:
    """Return the file endings of `--format bvh,glb`; ValueError names one that is not known."""
    wanted = list(dict.fromkeys(f".{name.strip().lower()}" for name in given.split(",")))
    unknown = [name for name in wanted if name not in (".bvh", ".glb", ".csv")]
    if unknown:
        raise ValueError(f"--format {given}: give bvh, glb or csv, or several with commas between")
    return wanted


def _has_legs(skeleton) -> bool:
    """Say whether feet can be held: legs of hip, knee, ankle and toe."""
    from f3amd_companion.serving.foot_locking import leg_chains

    try:
        leg_chains(skeleton)
    except ValueError as error:
        log.info("feet         slide as they come: %s", error)
        return False
    return True


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
    """Animate any number of characters, streamed to a folder; goes on where it was stopped.

    Args:
      characters: how many.
      seconds: of each character.
      style: taken in turn; repeatable; by default all.
      seed: of paths and noise.
      chunk: characters at once.
      plan: paths that keep this far apart at every frame, 0.8 without a number.
      pictures: draw OUT.png and the player page OUT.html as well, with seams blended and feet held.
      format: write everybody to OUT_motions/, too, finished like the pictures: bvh, glb or csv; several with commas.
      raw: draw and write them as the network made them; the folder holds that in any case.
      out: folder to write to.
    """
    from f3amd_companion.serving.crowd import MIN_DISTANCE, generate_crowd
    from f3amd_lib.rollout.generated import generated_credit

    if plan is not None and len(plan) > 1:
        raise ValueError(f"--plan takes one number of metres, got {len(plan)}")
    drawn = [out.with_name(f"{out.name}{ending}") for ending in (".png", ".html")] if pictures else []
    formats = _motion_formats(format) if format else []
    motions = out.with_name(f"{out.name}_motions")
    num_frames = _num_frames(seconds)
    model.check_free(*drawn, *([motions] if formats else []))
    generator = model.generator()
    started = time.perf_counter()
    made = generate_crowd(
        generator, characters, num_frames, out, styles=list(style) or None,
        min_distance=None if plan is None else (*plan, MIN_DISTANCE)[0], seed=seed, chunk=chunk,
        overwrite=model.overwrite, progress=True,
    )  # fmt: skip
    log.info("wrote        %s: %d characters of %d frames", out, len(made), made.num_frames)
    log.info("took         %.0f s", time.perf_counter() - started)
    window = None if raw else generator.trained.config.window
    lock = bool(drawn or formats) and not raw and _has_legs(made.skeleton)
    shown = lambda character: _finished(made.motion(character), window, lock)
    credit = generated_credit(*map(made.settings["model"].get, ("name", "dataset_credit", "dataset_licence")))
    if formats:  # the longer part first: where it is stopped, nothing stands in the way of the same command
        _crowd_motions(made, shown, credit, motions, formats)
        log.info("wrote        %s: everybody as %s", motions, ", ".join(formats))
    if pictures:
        _crowd_pictures(made, shown, credit, *drawn)
    for file in drawn:
        log.info("wrote        %s", file)


def _finished(motion, window: int | None, lock: bool):
    """Blend a motion's seams over 4 frames, unless `window` is None, and hold its feet, as where people look."""
    from f3amd_companion.serving.foot_locking import lock_feet
    from f3amd_lib.data.features import motion_from_frames, world_frames
    from f3amd_lib.rollout.blending import blend_seams

    if window is None:
        return motion
    frames = blend_seams(world_frames(motion), window, min(4, window))
    motion = motion_from_frames(motion.skeleton, frames, motion.fps, motion.name)
    return lock_feet(motion) if lock else motion


def _crowd_motions(crowd, shown, credit: str, folder: Path, formats) -> None:
    """Write a file a character and format, one after the other, so that no crowd is too large: NUMBER_STYLE.bvh.

    Files of an earlier crowd are removed first; what else lies there stays. A new folder is there whole or not at all.
    """
    from f3amd_companion.serving import motion_files

    digits = len(str(len(crowd) - 1))
    for file in folder.glob("*"):
        if re.fullmatch(r"\d+_.*\.(bvh|glb|csv)", file.name):
            file.unlink()
    with contextlib.nullcontext(folder) if folder.exists() else whole_folder(folder) as place:
        for character in range(len(crowd)):
            motion, name = shown(character), f"{character:0{digits}d}_{crowd.style(character)}"
            for ending in formats:
                motion_files.write_motion(place / f"{name}{ending}", motion, credit=credit)


def _crowd_pictures(crowd, shown, credit: str, still: Path, page: Path) -> None:
    """Draw a crowd half way through, and write a page that plays up to 100 of it; `shown` gives a motion by number."""
    from f3amd_companion.serving.player import Character, Scene, write_player
    from f3amd_lib.drawing import pictures, style

    name = crowd.settings["model"]["name"]
    motions = [shown(k) for k in range(min(100, len(crowd)))]
    colors = pictures.crowd_colors([motion.name for motion in motions])
    characters = [Character(motion, path=crowd.target(k), color=colors[k]) for k, motion in enumerate(motions)]
    write_player(page, Scene(characters, title=name), strip=False, credit=credit)
    style.save_figure(pictures.crowd_figure({name: (motions, colors)}, crowd.num_frames // 2), still)


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
    if "onnx" in target:
        from f3amd_companion.serving import onnx_export

        if len(target) > 1 or model.sampler:
            raise ValueError("--target onnx goes alone, and without --sampler: what is exported is one evaluation")
        trained = (model.weights and onnx_export.load_text_or_latent(model.weights)) or model.load()
        folder = onnx_export.export_onnx(
            trained, out, num_steps=model.steps, batch=characters, weights=stored, overwrite=model.overwrite
        )
    else:
        from f3amd_companion.serving.export import export_model

        if not target and importlib.util.find_spec("iree"):
            target = ("llvm-cpu",)
        elif not target:
            log.info("not compiled for this processor, since IREE is missing: make bench-tools")
        folder = export_model(
            model.load(), out, num_steps=model.steps, batch=1 if characters is None else characters,
            sampler=model.sampler, targets=target, overwrite=model.overwrite,
        )  # fmt: skip
    for file in sorted(folder.iterdir()):
        log.info("wrote        %s (%.1f MB)", file, file.stat().st_size / 1e6)


def steer(model: Model, stored: str = "int8", runtime: str = "wasm", out: Path = Path("out/steer.html")) -> None:
    """Write a page on which one steers the model by keys, mouse, touch or gamepad; it needs no server.

    Args:
      stored: how weights are kept: int8, float16, float32.
      runtime: what runs the network: wasm; or webgpu, where the browser has it, in a larger page.
      out: page to write.
    """
    from f3amd_companion.serving.steer import write_steer

    model.check_free(out)
    page = write_steer(out, model.load(), num_steps=model.steps, weights=stored, runtime=runtime)
    log.info("wrote        %s (%.1f MB): open it in a browser", page, page.stat().st_size / 1e6)


def bench(
    motion: Data, suite: Repeatable = (), characters: UseAppendAction[tuple[int, ...]] = (), again: bool = False,
    training: bool = False, parts: bool = False,
) -> None:  # fmt: skip
    """Time synthesis and training, write records, compare with what is asked.

    Args:
      suite: smoke, bars, main, family, windows, curve or gpu; repeatable; by default the profile's.
      characters: these numbers only; repeatable.
      again: time anew what is in the table.
      training: time training steps (Table 2).
      parts: time a round without each part.
    """
    _use_fast_flags()
    from f3amd_companion.speed import measurements, speed_tables
    from f3amd_lib.ground.records import read_table
    from f3amd_lib.ground.tables import markdown_table

    suites = measurements.check_suites(suite)
    prepared, profile = motion.open()
    if suites or not (training or parts):
        path = measurements.measure_synthesis_time(
            prepared, profile, suites, characters=characters or None, again=again
        )
        every = path.with_name("synthesis_ways.csv")
        bars = speed_tables.speed_bars(read_table(every)[0], suite="bars" if suites == ["bars"] else "main")
        log.info("\n%s\n", markdown_table(bars, digits=3))
        log.info("all          %s\nfastest      %s", every, path)
    if parts:
        log.info("parts        %s", measurements.measure_round_parts(prepared, profile))
    if training:
        log.info("training     %s", measurements.measure_training_time(prepared, profile, again=again))


def measure(
    names: Positional[tuple[str, ...]] = (), *, motion: Data, model: Repeatable = (), published: Path | None = None,
    minutes: float | None = None,
) -> int:  # fmt: skip
    """Measure what notebooks only draw; tables go to <results>/records/.

    Args:
      names: learning, quality, walking and so on; all if none. Of text to motion (--data bandai) text_judge,
        hands, text_table1, text_tableA1, text_table3, text_table4, text_tableA5, text_pcm1 to text_pcm4,
        text_guidance, text_one_caption, by name alone.
      model: this preset; repeatable.
      published: CAMDM's published weights as safetensors, one more row of quality.
      minutes: of text to motion: stop then; a later call goes on, and the exit status is 3.
    """
    from f3amd_companion.measuring.measure import MEASUREMENTS
    from f3amd_companion.measuring.text_tables import TEXT_MEASUREMENTS
    from f3amd_lib.networks import presets

    for name in names:
        check_known(name, [*MEASUREMENTS, *TEXT_MEASUREMENTS], "measurement")
    if of_text := [name for name in names if name in TEXT_MEASUREMENTS]:
        if len(of_text) < len(names):
            raise ValueError(f"{', '.join(of_text)}: measure text to motion by a call of its own")
        return _measure_text(of_text, motion, model, minutes)
    models = [presets.find_preset(name).name for name in model] or None
    prepared, profile = motion.open()
    other_window = profile.window != motion.numbers().window
    of_windows = {"quality", "trained", "walking"} if not published else {"quality"}
    if (other_window or published) and not (names and set(names) <= of_windows):
        raise ValueError("--window is for quality, trained and walking, --published for quality: measure these by name")
    for name in names or MEASUREMENTS:
        with _measuring(name, profile):
            log.info("%-12s %s", name, MEASUREMENTS[name](prepared, profile, models, **_given(published=published)))
    return 0


def _measuring(name: str, profile):
    """Hold the lock of a measurement's table."""
    return locked(results_dir(profile.dataset, profile.name) / "records" / f".{name}.lock", f"measuring {name}")


def _measure_text(names, motion: Data, models, minutes) -> int:
    """Measure text to motion; what a table's rows need is trained on the way."""
    from f3amd_companion.measuring.text_tables import TEXT_MEASUREMENTS
    from f3amd_lib.text.data.text_encoders import load_text_encoder
    from f3amd_lib.text.stages.text_models import open_text_motions

    profile, encoder = motion.numbers(), load_text_encoder()
    data = open_text_motions(motion.data, motion.source)
    stop_at = _stop_at(minutes)
    for name in names:
        with _measuring(name, profile):
            table = TEXT_MEASUREMENTS[name](data, encoder, profile, models=models, stop_at=stop_at)
        if table is None:
            log.info("%-12s unfinished: call again to go on", name)
            return UNFINISHED
        log.info("%-12s %s", name, table)
    return 0


def campaign(
    motion: Data, minutes: float | None = None, batch_size: int = 128, only: Repeatable = (),
    packed: Path | None = None, times: bool = False, precision: str = "float32", out: Path | None = None,
    queue: str = "campaign", package: str | None = None, measure: bool = False,
) -> int:  # fmt: skip
    """Train and measure the long queue of real motion in legs; a killed leg goes on where it stopped.

    Args:
      minutes: stop then, with a checkpoint that a later call goes on from, and exit status 3; a measurement that is
        under way is finished.
      batch_size: windows a step; the paper's is 512.
      only: this preset, recipe or run of the queue; repeatable.
      packed: the data set as its packed cache file, instead of its source.
      times: first the times of Tables 1, 2 (32 frames), 4, 7 and 11 that are not on record, and then the longest
        trainings of the queue first; for a GPU.
      precision: of the matrix products of training; tf32 is quicker on a GPU.
      out: folder for states and weights instead of runs/DATA/PROFILE/campaign.
      queue: campaign, or readings: which reading of the paper behaves like the paper?
      package: train this package of papers/f3amd/gpu_plan.toml and keep its weights, unmeasured, for a GPU.
      measure: measure the weights of a package that lie in the folder, and train nothing.
    """
    stop_at, timed = _stop_at(minutes), ()
    if times:
        _use_fast_flags()
        from f3amd_companion.speed.measurements import measure_synthesis_time, measure_training_time

        timed = (measure_synthesis_time, measure_training_time)
    from f3amd_companion.measuring import campaign as long_queue
    from f3amd_companion.measuring.campaign import check_precision, chosen, longest_first
    from f3amd_companion.measuring.measure import protocol_of
    from f3amd_lib.data.packed import load_packed
    from f3amd_lib.training.pipeline import PreparedData

    check_known(queue, long_queue.QUEUES, "queue")
    if package is None:
        snapshots = long_queue.queue(long_queue.QUEUES[queue])
    else:
        snapshots, queue = long_queue.queue(long_queue.GPU_PLAN, package), "readings"
    snapshots = chosen(longest_first(snapshots) if times else snapshots, only)
    check_precision(precision)
    if packed is None:
        prepared, profile = motion.open()
    else:
        profile = motion.numbers()
        prepared = PreparedData(load_packed(packed), profile.window, profile.num_history)
    state, folder = "measured", out or runs_dir(profile.dataset, profile.name) / "campaign"
    how = {"snapshots": snapshots, "batch_size": batch_size, "precision": precision, "stop_at": stop_at}
    with locked(folder / ".campaign.lock", "running the campaign"):
        for measure_time in timed:
            if (table := measure_time(prepared, profile, stop_at=stop_at)) is None:
                log.info("%-12s times", "unfinished")
                return UNFINISHED
            log.info("%-12s %s", "times", table)
        if stop_at is not None and time.monotonic() >= stop_at:  # a style classifier may have to be trained
            return UNFINISHED
        if package is not None and not measure:
            legs = long_queue.train_snapshots(prepared, profile, folder=folder, **how)
        else:
            classifier, protocol, _ = protocol_of(prepared, profile, "campaign")
            how |= {"table": queue, "found_alone": measure}
            legs = long_queue.run_campaign(prepared, profile, classifier, protocol, folder=folder, **how)
        for name, windows, state in legs:
            log.info("%-12s %s, %s windows", state, name, f"{windows:,}")
    return UNFINISHED if state == "unfinished" else 0


def sweep(
    names: Positional[tuple[str, ...]] = (), *, motion: Data, preset: Repeatable = (), workers: int = 2,
    scheduler: str | None = None, queue: Path | None = None, batch_size: int = 128, out: Path | None = None,
) -> int:  # fmt: skip
    """Do the long queue, or measurements of presets, in several processes; a dead worker costs only its leg.

    Args:
      names: campaign, or measurements such as quality, walking; a leg each for every preset.
      preset: this one; repeatable. By default all of the queue, and all that have weights.
      workers: processes on this machine.
      scheduler: HOST:PORT of a Dask cluster instead; all its machines see one clone.
      queue: another file for campaign than papers/f3amd/campaign.toml.
      batch_size: windows a step of the queue's trainings; the paper's is 512.
      out: folder for legs, states and weights of the queue, instead of runs/DATA/PROFILE.
    """
    import pandas as pd

    from f3amd_companion.measuring import campaign as long_queue
    from f3amd_companion.measuring import measure, runner
    from f3amd_companion.measuring import sweep as engine
    from f3amd_lib.ground.records import THROUGH_CLASSIFIER, run_record

    profile = motion.numbers()
    if motion.window not in (None, profile.window):
        raise ValueError("--window is for f3amd measure alone")
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
        if engine.CAMPAIGN in names or not THROUGH_CLASSIFIER.isdisjoint(names):  # trained once, before the legs
            measure.protocol_of(prepared, profile, "sweep")
        record = run_record(profile=profile, dataset=prepared.packed, seed=profile.seed, measurement="sweep")
        costs, ended = runner.Records(results / "records", record, {"sweep": ["leg"]}), {}
        try:
            for leg, told in engine.run_sweep(work, legs, workers=workers, scheduler=scheduler):
                ended[leg.name] = told["state"]
                log.info("%s, %d of %d: %s", leg.name, len(ended), len(legs), told["state"])
                if told["state"] == "done":
                    cost = {key: told[key] for key in ("seconds", "state_bytes", "device")}
                    costs.put("sweep", {"leg": leg.name}, pd.DataFrame([cost | {"model": leg.preset}]))
        finally:
            finished = [leg for leg in legs if ended.get(leg.name, "").startswith("done")]
            for table in engine.gather(work, finished):
                log.info("wrote        %s", table)
    return 0 if len(finished) == len(legs) else 1


def figures(data: str = "synthetic", profile: str = "laptop", only: Repeatable = (), set: Repeatable = ()) -> int:
    """Run the numbered notebooks in order; results go under paper_figures/.

    Args:
      data: synthetic, bandai, 100style or folder.
      profile: smoke, laptop or gpu.
      only: number of a notebook; repeatable.
      set: NAME=VALUE, a parameter of every notebook that runs; repeatable.
    """
    from f3amd_companion import reproduce

    parameters = dict(map(reproduce.parse_assignment, set))
    logging.getLogger("papermill").setLevel(logging.WARNING)  # at INFO it names each notebook twice
    reproduce.set_folders(profile)
    try:
        summary = reproduce.reproduce(data, profile, only=only, parameters=parameters, say=log.info)
    except reproduce.NotebookFailed as error:
        print(f"Stopped: {error}", file=sys.stderr)
        return 1
    minutes = summary["seconds"].sum() / 60
    log.info(
        "%d notebooks finished in %.1f minutes (data %s, profile %s). To open first:",
        len(summary), minutes, data, profile,
    )  # fmt: skip
    for line in reproduce.what_to_open(results_dir(data, profile)):
        log.info("  %s", line)
    return 0


def course(only: Repeatable = ()) -> int:
    """Run the course on samplers, notebooks/course/; it needs no data, and copies go to runs/course/.

    Args:
      only: number of a notebook; repeatable.
    """
    from f3amd_companion import reproduce

    logging.getLogger("papermill").setLevel(logging.WARNING)
    try:
        reproduce.run_course(only, say=log.info)
    except reproduce.NotebookFailed as error:
        print(f"Stopped: {error}", file=sys.stderr)
        return 1
    return 0


def claims(accept: bool = False, paper: str | None = None) -> int:
    """Judge the papers' claims from records; writes paper_figures/claims.md and claims_<paper>.md.

    Args:
      accept: take changed verdicts for right and write them down.
      paper: whose claims, such as acmdm; each paper's if none.
    """
    from f3amd_companion.ledger import claims as ledger

    return ledger.main(accept, paper)


def cards() -> int:
    """Write the cards of shipped weights, their checksums and the table of docs/results.md."""
    from f3amd_companion.ledger import model_cards

    return model_cards.main()


RESUMED = ("train", "crowd", "bench", "measure", "campaign", "sweep", "figures")
"""Commands that leave whole what they have done, and go on from it."""

COMMANDS = (
    data, dataset, presets, train, rollout, text, crowd, export, steer, bench, measure, campaign, sweep, figures,
    course, claims, cards,
)  # fmt: skip


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command; what the user has to mend ends with one line and status 2."""
    logging.basicConfig(level=logging.INFO, format="%(message)s", stream=sys.stdout)
    for noisy in ("jax", "absl", "matplotlib", "PIL"):
        logging.getLogger(noisy).setLevel(logging.WARNING)
    os.environ.setdefault("MPLBACKEND", "Agg")
    # JAX multiplies in tf32 on a GPU, with 10 bits of mantissa, where nothing else is said.
    os.environ.setdefault("JAX_DEFAULT_MATMUL_PRECISION", "float32")
    words = sys.argv[1:] if argv is None else list(argv)
    try:
        status = tyro.extras.subcommand_cli_from_dict(
            {command.__name__: command for command in COMMANDS},
            prog="f3amd",
            description="Fast Fourier autoregressive motion diffusion: data, training, motion, measurements, figures.",
            args=words,
            config=(tyro.conf.OmitArgPrefixes, tyro.conf.FlagCreatePairsOff),
        )
    except (ValueError, OSError, ArithmeticError, ImportError) as error:
        print(f"f3amd {words[0]}: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        again = "; the same command goes on from what is written" if words[0] in RESUMED else ""
        print(f"\nf3amd {words[0]}: stopped by Ctrl-C{again}", file=sys.stderr)
        return 130
    return status or 0


if __name__ == "__main__":
    sys.exit(main())
