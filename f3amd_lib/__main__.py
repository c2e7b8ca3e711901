"""The command `f3amd`, such as `f3amd rollout --style proud --path figure-eight --out out/`.

A function a command: its parameters are the options, its docstring is their help. What needs JAX is
imported inside, so that `f3amd --help` is quick.
"""

from __future__ import annotations

import importlib.util
import logging
import os
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from tyro.conf import Positional, UseAppendAction

log = logging.getLogger("f3amd")

UNFINISHED = 3
"""Exit status of `train` where the minutes were over first; a later call goes on."""

Repeatable = UseAppendAction[tuple[str, ...]]
Required = Annotated[str, tyro.conf.arg(metavar="NAME")]


@dataclass(frozen=True)
class Data:
    """Motion, and how much is done with it.

    Attributes:
      data: synthetic, bandai, 100style or folder.
      profile: smoke, laptop or gpu.
      source: folder or archive, for data sets that need one.
      window: future frames, 32 or 64.
    """

    data: str = "synthetic"
    profile: str = "laptop"
    source: str | None = None
    window: int | None = None

    def open(self, **overrides):
        """Return the data set, prepared, and the profile with those values replaced that are given."""
        from f3amd_lib.ground.profiles import load_profile
        from f3amd_lib.training.pipeline import prepare

        given = {name: value for name, value in (overrides | {"window": self.window}).items() if value is not None}
        profile = load_profile(self.profile, self.data, **given)
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
        from f3amd_lib.generation.rollout import MotionGenerator

        return MotionGenerator(self.load(), self.steps, sampler=self.sampler)

    def check_free(self, *targets: Path) -> None:
        """Raise ValueError if one of the files is there and may not be replaced."""
        taken = [str(target) for target in targets if target.exists()]
        if taken and not self.overwrite:
            raise ValueError(f"{', '.join(taken)}: exists already; pass --overwrite or another --out")


def data(motion: Data) -> None:
    """Open a data set, build its packed cache, say what is in it."""
    import numpy as np

    from f3amd_lib.data.sources import SPLITS

    packed = motion.open()[0].packed
    counts = np.bincount(np.asarray(packed.clip_split), minlength=3)
    facts = {
        "data set": packed.dataset,
        "terms": packed.licence,
        "credit": packed.credit,
        "clips": f"{packed.num_clips} ({len(packed.skipped)} left out)",
        "frames": f"{packed.num_frames} at 30 fps",
        "joints": packed.skeleton.num_joints,
        "styles": ", ".join(packed.styles),
        "split": ", ".join(f"{count} {split}" for count, split in zip(counts, SPLITS, strict=True)),
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
    from f3amd_lib.data.humanml3d import captioned_motions, read_caption_table, write_humanml3d
    from f3amd_lib.data.sources import SPLITS, open_dataset

    written = captioned_motions(open_dataset(data, path=source), read_caption_table(captions), fps=fps)
    folder = write_humanml3d(out, written)
    for clip, reason in written.skipped:
        log.info("left out     %s: %s", clip, reason)
    log.info("split        %s", ", ".join(f"{written.splits.count(split)} {split}" for split in SPLITS))
    log.info(
        "joints       %d, so vectors of %d numbers", written.skeleton.num_joints, 12 * written.skeleton.num_joints - 1
    )
    log.info("terms        %s", written.licence)
    log.info("wrote        %s: %d clips", folder, written.num_clips)


def presets(channels: int = 141, styles: int = 100) -> None:
    """List the models with their sizes.

    Args:
      channels: features a frame, 6 J + 3.
      styles: how many.
    """
    from f3amd_lib.ground.tables import markdown_table
    from f3amd_lib.networks import presets

    log.info("%s", markdown_table(presets.table(channels=channels, num_styles=styles)))


def train(
    motion: Data,
    preset: Repeatable = (),
    minutes: float | None = None,
    steps: int | None = None,
    batch_size: int | None = None,
    seed: int | None = None,
    out: Path | None = None,
    all_devices: bool = False,
    processes: int | None = None,
    process: int | None = None,
    coordinator: str | None = None,
    cluster: bool = False,
) -> int:
    """Train a model; a killed run goes on where it stopped.

    Args:
      preset: such as F3AMD-FNO-96; by default the profile's; repeatable, trained in this order.
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
    """
    from f3amd_lib.experiments.learning_curves import train_family
    from f3amd_lib.training import parallel
    from f3amd_lib.training.pipeline import model_files

    together = (coordinator, processes, process)
    named = any(value is not None for value in together)
    if cluster and named:
        raise ValueError("--cluster finds the processes itself: leave the three others out")
    if cluster or named:
        parallel.join_processes(*together)
    prepared, profile = motion.open(train_steps=steps, batch_size=batch_size, seed=seed)
    runs = train_family(
        prepared,
        profile,
        list(preset) or [profile.preset],
        folder=out,
        budget_s=None if minutes is None else 60.0 * minutes,
        mesh=parallel.all_devices() if cluster or named or all_devices else None,
    )
    status = 0
    for name, state in runs:
        files = model_files(profile, name, folder=out)
        log.info("%-12s %s", name, files.state if state == "unfinished" else files.model)
        status = UNFINISHED if state == "unfinished" else status
    return status


def rollout(
    style: Required,
    model: Model,
    path: str = "figure-eight",
    seed: int = 0,
    seconds: float = 20.0,
    speed: float = 1.2,
    blend: int = 4,
    slide: bool = False,
    raw: bool = False,
    out: Path = Path("out"),
) -> None:
    """Animate one character: BVH, film strip, GIF (its first 12 s), player.

    Args:
      style: one that the model knows.
      path: a named path, or a CSV file.
      seed: of path and noise.
      seconds: length of a named path; a CSV has its own.
      speed: of a named path, m/s; a CSV has its own.
      blend: so many frames after each window boundary.
      slide: do not hold feet where they stand.
      raw: as the network made it: no blending, no held feet.
      out: folder to write to.
    """
    from f3amd_lib.drawing.pictures import film_strip, write_gif
    from f3amd_lib.drawing.style import save_figure
    from f3amd_lib.motion.bvh import write_bvh
    from f3amd_lib.motion.root_paths import named_path, read_path_csv
    from f3amd_lib.serving.player import rollout_scene, write_player

    name = f"{style}_{Path(path).stem}_seed{seed}"
    targets = [out / f"{name}{ending}" for ending in (".bvh", ".png", ".gif", ".html")]
    model.check_free(*targets)
    if path.lower().endswith(".csv"):
        line = read_path_csv(path)
    else:
        line = named_path(path, _num_frames(seconds), speed=speed, seed=seed)
    generator = model.generator()
    trained = generator.trained
    made = generator.rollout(
        line,
        style,
        seed=seed,
        blend_frames=0 if raw else blend,
        lock_feet=not (raw or slide) and _has_legs(trained.skeleton),
    )
    log.info("afterwards   %s", made.changes or "nothing: as the network made it")
    motion, title = made.motion(), f"{trained.name}, {style}"
    out.mkdir(parents=True, exist_ok=True)
    write_bvh(targets[0], motion, overwrite=model.overwrite)
    save_figure(film_strip(motion, paths=line, titles=[title]), targets[1])
    write_gif(targets[2], motion, target_paths=line, titles=[title], max_seconds=12.0)
    credit = trained.record.get("dataset_credit") or ""
    write_player(targets[3], rollout_scene(made, title), credit=credit, strip=False)
    for target in targets:
        log.info("wrote        %s", target)


def _has_legs(skeleton) -> bool:
    """Say whether feet can be held: legs of hip, knee, ankle and toe."""
    from f3amd_lib.generation.foot_locking import leg_chains

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
    model: Model,
    characters: int = 1024,
    seconds: float = 32 / 30,
    style: Repeatable = (),
    seed: int = 0,
    chunk: int | None = None,
    plan: Annotated[tuple[float, ...] | None, tyro.conf.arg(metavar="[METRES]")] = None,
    pictures: bool = False,
    out: Path = Path("out/crowd"),
) -> None:
    """Animate any number of characters, streamed to a folder; goes on where it was stopped.

    Args:
      characters: how many.
      seconds: of each character.
      style: taken in turn; repeatable; by default all.
      seed: of paths and noise.
      chunk: characters at once.
      plan: paths that keep this far apart at every frame, 0.8 without a number.
      pictures: draw OUT.png and the player page OUT.html as well.
      out: folder to write to.
    """
    from f3amd_lib.generation.crowd import generate_crowd
    from f3amd_lib.generation.crowd_planning import MIN_DISTANCE

    if plan is not None and len(plan) > 1:
        raise ValueError(f"--plan takes one number of metres, got {len(plan)}")
    drawn = [out.with_name(f"{out.name}{ending}") for ending in (".png", ".html")] if pictures else []
    num_frames = _num_frames(seconds)
    model.check_free(*drawn)
    generator = model.generator()
    started = time.perf_counter()
    made = generate_crowd(
        generator,
        characters,
        num_frames,
        out,
        styles=list(style) or None,
        min_distance=None if plan is None else (*plan, MIN_DISTANCE)[0],
        seed=seed,
        chunk=chunk,
        overwrite=model.overwrite,
        progress=True,
    )
    log.info("wrote        %s: %d characters of %d frames", out, len(made), made.num_frames)
    log.info("took         %.0f s", time.perf_counter() - started)
    if pictures:
        _crowd_pictures(made, *drawn)
    for file in drawn:
        log.info("wrote        %s", file)


def _crowd_pictures(crowd, still: Path, page: Path) -> None:
    """Draw a crowd half way through, and write a page that plays up to 100 of it."""
    from f3amd_lib.drawing.pictures import crowd_colors, crowd_figure
    from f3amd_lib.drawing.style import save_figure
    from f3amd_lib.serving.player import Character, Scene, write_player

    made_by = crowd.settings["model"]
    motions = [crowd.motion(k) for k in range(min(100, len(crowd)))]
    colors = crowd_colors([motion.name for motion in motions])
    characters = [Character(motion, path=crowd.target(k), color=colors[k]) for k, motion in enumerate(motions)]
    credit = ", ".join(filter(None, (made_by["dataset_credit"], made_by["dataset_licence"])))
    write_player(page, Scene(characters, title=made_by["name"]), strip=False, credit=credit)
    save_figure(crowd_figure({made_by["name"]: (motions, colors)}, crowd.num_frames // 2), still)


def export(model: Model, characters: int = 1, target: Repeatable = (), out: Path = Path("out/round")) -> None:
    """Make a round that runs without the model code: StableHLO, jax.export, IREE.

    Args:
      characters: of one call.
      target: llvm-cpu, vmvx, vulkan-spirv, cuda-sm_80; repeatable; by default this processor.
      out: folder to write to.
    """
    from f3amd_lib.serving.export import export_model

    if not target and importlib.util.find_spec("iree"):
        target = ("llvm-cpu",)
    elif not target:
        log.info("not compiled for this processor, since IREE is missing: make bench-tools")
    folder = export_model(
        model.load(),
        out,
        num_steps=model.steps,
        batch=characters,
        sampler=model.sampler,
        targets=target,
        overwrite=model.overwrite,
    )
    for file in sorted(folder.iterdir()):
        log.info("wrote        %s (%.1f MB)", file, file.stat().st_size / 1e6)


def bench(
    motion: Data,
    suite: Repeatable = (),
    characters: UseAppendAction[tuple[int, ...]] = (),
    again: bool = False,
    training: bool = False,
    parts: bool = False,
) -> None:
    """Time synthesis and training, write records, compare with what is asked.

    Args:
      suite: smoke, bars, main, family, windows, curve or gpu; repeatable; by default the profile's.
      characters: these numbers only; repeatable.
      again: time anew what is in the table.
      training: time training steps (Table 2).
      parts: time a round without each part.
    """
    from f3amd_lib.benchmarking.machine import fast_xla_flags

    # JAX reads them when it first looks for devices, which is later than this.
    if "XLA_FLAGS" not in os.environ:
        os.environ["XLA_FLAGS"] = fast_xla_flags()
    from f3amd_lib.benchmarking import measurements, speed_tables, synthesis
    from f3amd_lib.ground.records import read_table
    from f3amd_lib.ground.tables import markdown_table

    suites = synthesis.check_suites(suite)
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
        log.info("training     %s", measurements.measure_training_time(prepared, profile))


def measure(
    names: Positional[tuple[str, ...]] = (), *, motion: Data, model: Repeatable = (), published: Path | None = None
) -> None:
    """Measure what notebooks only draw; tables go to <results>/records/.

    Args:
      names: learning, quality, walking and so on; all if none.
      model: this preset; repeatable.
      published: CAMDM's published weights as safetensors, one more row of quality.
    """
    from f3amd_lib.experiments.measure import MEASUREMENTS
    from f3amd_lib.ground.names import nearest_hint
    from f3amd_lib.ground.profiles import load_profile
    from f3amd_lib.networks import presets

    for name in names:
        if name not in MEASUREMENTS:
            raise ValueError(f"unknown measurement {name!r}{nearest_hint(name, MEASUREMENTS)}")
    models = [presets.find_preset(name).name for name in model] or None
    prepared, profile = motion.open()
    other_window = profile.window != load_profile(profile.name, profile.dataset).window
    if (other_window or published) and set(names) != {"quality"}:
        raise ValueError("--window and --published are for quality alone: measure it by name")
    extra = {"published": published} if published else {}
    for name in names or MEASUREMENTS:
        log.info("%-12s %s", name, MEASUREMENTS[name](prepared, profile, models, **extra))


def campaign(
    motion: Data,
    minutes: float | None = None,
    batch_size: int = 128,
    only: Repeatable = (),
    packed: Path | None = None,
    out: Path | None = None,
) -> int:
    """Train and measure the long queue of real motion in legs; a killed leg goes on where it stopped.

    Args:
      minutes: stop then, with a checkpoint that a later call goes on from, and exit status 3.
      batch_size: windows a step; the paper's is 512.
      only: this preset of the queue; repeatable.
      packed: the data set as its packed cache file, instead of its source.
      out: folder for states and weights instead of runs/DATA/PROFILE/campaign.
    """
    from f3amd_lib.data.packed import load_packed
    from f3amd_lib.experiments.campaign import run_campaign
    from f3amd_lib.experiments.measure import protocol_of
    from f3amd_lib.ground.profiles import load_profile, runs_dir
    from f3amd_lib.training.pipeline import PreparedData

    if packed is None:
        prepared, profile = motion.open()
    else:
        profile = load_profile(motion.profile, motion.data)
        prepared = PreparedData(load_packed(packed), profile.window, profile.num_history)
    classifier, protocol, _ = protocol_of(prepared, profile, "campaign")
    state = "measured"
    for name, windows, state in run_campaign(
        prepared,
        profile,
        classifier,
        protocol,
        folder=out or runs_dir(profile.dataset, profile.name) / "campaign",
        batch_size=batch_size,
        only=only,
        budget_s=None if minutes is None else 60.0 * minutes,
    ):
        log.info("%-12s %s, %s windows", state, name, f"{windows:,}")
    return UNFINISHED if state == "unfinished" else 0


def figures(data: str = "synthetic", profile: str = "laptop", only: Repeatable = (), set: Repeatable = ()) -> int:
    """Run the numbered notebooks in order; results go under paper_figures/.

    Args:
      data: synthetic, bandai, 100style or folder.
      profile: smoke, laptop or gpu.
      only: number of a notebook; repeatable.
      set: NAME=VALUE, a parameter of every notebook that runs; repeatable.
    """
    from f3amd_lib import reproduce
    from f3amd_lib.ground.profiles import results_dir

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


def claims(accept: bool = False) -> int:
    """Judge the paper's claims from records; writes paper_figures/claims.md.

    Args:
      accept: take changed verdicts for right and write them down.
    """
    from f3amd_lib.reports import claims as ledger

    return ledger.main(["--accept"] if accept else [])


def cards() -> int:
    """Write the cards of shipped weights, their checksums and the table of docs/results.md."""
    from f3amd_lib.reports import model_cards

    return model_cards.main()


COMMANDS = (data, dataset, presets, train, rollout, crowd, export, bench, measure, campaign, figures, claims, cards)


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command; what the user has to mend ends with one line and status 2."""
    logging.basicConfig(level=logging.INFO, format="%(message)s", stream=sys.stdout)
    for noisy in ("jax", "absl", "matplotlib", "PIL"):
        logging.getLogger(noisy).setLevel(logging.WARNING)
    os.environ.setdefault("MPLBACKEND", "Agg")
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
    return status or 0


if __name__ == "__main__":
    sys.exit(main())
