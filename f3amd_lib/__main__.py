"""Command line: `python -m f3amd_lib rollout --style ... --path figure-eight --out out/`.

data      open a data set, build its packed cache, say what is in it
presets   list the models
train     train a model (goes on where an earlier run stopped)
rollout   animate one character: BVH, film strip PNG, GIF and player page
crowd     animate any number of characters, streamed to a folder
export    make a round that runs without the model code: StableHLO, jax.export, IREE
bench     time synthesis and training, write records, compare with what is asked
"""

from __future__ import annotations

import argparse
import importlib.util
import logging
import os
import sys
import time
from pathlib import Path

log = logging.getLogger("f3amd")


def _profile(arguments, **overrides):
    from f3amd_lib.ground.profiles import load_profile

    given = {name: value for name, value in overrides.items() if value is not None}
    return load_profile(arguments.profile, arguments.data, **given)


def _data(arguments) -> None:
    import numpy as np

    from f3amd_lib.data.sources import SPLITS
    from f3amd_lib.training.pipeline import prepare

    prepared = prepare(_profile(arguments), path=arguments.source)
    packed = prepared.packed
    log.info("data set     %s", packed.dataset)
    log.info("terms        %s", packed.licence)
    log.info("credit       %s", packed.credit)
    log.info("clips        %d (%d left out)", packed.num_clips, len(packed.skipped))
    log.info("frames       %d at 30 fps", packed.num_frames)
    log.info("joints       %d", packed.skeleton.num_joints)
    log.info("styles       %s", ", ".join(packed.styles))
    counts = np.bincount(np.asarray(packed.clip_split), minlength=3)
    log.info("split        %s", ", ".join(f"{n} {s}" for n, s in zip(counts, SPLITS, strict=True)))


def _presets(arguments) -> None:
    from f3amd_lib.ground.tables import markdown_table
    from f3amd_lib.networks import zoo

    table = zoo.table(channels=arguments.channels, num_styles=arguments.styles)
    log.info("%s", markdown_table(table))


UNFINISHED = 3
"""Exit status of `train` where the minutes were over first; a later call goes on."""


def _train(arguments) -> int:
    from f3amd_lib.experiments.family import train_family
    from f3amd_lib.training import parallel
    from f3amd_lib.training.pipeline import model_files, prepare

    together = (arguments.coordinator, arguments.processes, arguments.process)
    several = arguments.cluster or any(value is not None for value in together)
    if arguments.cluster and any(value is not None for value in together):
        raise ValueError("--cluster finds the processes itself: leave the three others out")
    if several:
        parallel.join_processes(*together)
    profile = _profile(
        arguments,
        train_steps=arguments.steps,
        batch_size=arguments.batch_size,
        seed=arguments.seed,
        window=arguments.window,
    )
    runs = train_family(
        prepare(profile, path=arguments.source),
        profile,
        arguments.preset or [profile.preset],
        folder=arguments.out,
        budget_s=None if arguments.minutes is None else 60.0 * arguments.minutes,
        mesh=parallel.all_devices() if several or arguments.all_devices else None,
    )
    status = 0
    for preset, state in runs:
        files = model_files(profile, preset, folder=arguments.out)
        log.info("%-12s %s", state, files.state if state == "unfinished" else files.model)
        status = UNFINISHED if state == "unfinished" else status
    return status


def _path(text: str, num_frames: int, speed: float, seed: int):
    from f3amd_lib.motion.root_paths import named_path, read_path_csv

    if text.lower().endswith(".csv"):
        return read_path_csv(text)
    return named_path(text, num_frames, speed=speed, seed=seed)


def _trained(arguments):
    """Load the model that a command asks for, and say what it is."""
    from f3amd_lib.training.checkpoints import load_model
    from f3amd_lib.training.pipeline import find_model

    weights = Path(arguments.weights) if arguments.weights else find_model(arguments.data)
    trained = load_model(weights)
    log.info("model        %s, trained on %s", trained.name, trained.record.get("dataset"))
    log.info("terms        %s", trained.record.get("dataset_licence"))
    return trained


def _rollout(arguments) -> None:
    from f3amd_lib.drawing.pictures import film_strip, write_gif
    from f3amd_lib.drawing.style import save_figure
    from f3amd_lib.generation.rollout import MotionGenerator
    from f3amd_lib.motion.bvh import write_bvh
    from f3amd_lib.serving.player import rollout_scene, write_player

    trained = _trained(arguments)
    num_frames = _num_frames(arguments.seconds)
    path = _path(arguments.path, num_frames, arguments.speed, arguments.seed)
    out = Path(arguments.out)
    name = f"{arguments.style}_{Path(arguments.path).stem}_seed{arguments.seed}"
    targets = [out / f"{name}{ending}" for ending in (".bvh", ".png", ".gif", ".html")]
    taken = [str(target) for target in targets if target.exists()]
    if taken and not arguments.overwrite:
        raise ValueError(f"{', '.join(taken)}: exists already; pass --overwrite or another --out")
    generator = MotionGenerator(trained, arguments.steps, sampler=arguments.sampler)
    rollout = generator.rollout(
        path,
        arguments.style,
        seed=arguments.seed,
        blend_frames=0 if arguments.raw else arguments.blend,
        lock_feet=not (arguments.raw or arguments.slide) and _has_legs(trained.skeleton),
    )
    log.info("afterwards   %s", rollout.changes or "nothing: as the network made it")
    motion = rollout.motion()
    out.mkdir(parents=True, exist_ok=True)
    write_bvh(targets[0], motion, overwrite=arguments.overwrite)
    title = f"{trained.name}, {arguments.style}"
    save_figure(film_strip(motion, paths=path, titles=[title]), targets[1])
    write_gif(targets[2], motion, target_paths=path, titles=[title], max_seconds=12.0)
    write_player(
        targets[3],
        rollout_scene(rollout, title),
        credit=trained.record.get("dataset_credit") or "",
        strip=False,  # the film strip is written above
    )
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


def _crowd(arguments) -> None:
    from f3amd_lib.generation.crowd import generate_crowd
    from f3amd_lib.generation.rollout import MotionGenerator

    num_frames, out = _num_frames(arguments.seconds), Path(arguments.out)
    pictures = []
    if arguments.pictures:
        pictures = [out.with_name(f"{out.name}{ending}") for ending in (".png", ".html")]
    taken = [str(picture) for picture in pictures if picture.exists()]
    if taken and not arguments.overwrite:
        raise ValueError(f"{', '.join(taken)}: exists already; pass --overwrite or another --out")
    generator = MotionGenerator(_trained(arguments), arguments.steps, sampler=arguments.sampler)
    started = time.perf_counter()
    crowd = generate_crowd(
        generator,
        arguments.characters,
        num_frames,
        out,
        styles=arguments.style,
        min_distance=arguments.plan,
        seed=arguments.seed,
        chunk=arguments.chunk,
        overwrite=arguments.overwrite,
        progress=True,
    )
    seconds = time.perf_counter() - started
    log.info("wrote        %s: %d characters of %d frames", out, len(crowd), crowd.num_frames)
    log.info("took         %.0f s", seconds)
    if pictures:
        _crowd_pictures(crowd, *pictures)
        for path in pictures:
            log.info("wrote        %s", path)


def _crowd_pictures(crowd, still: Path, page: Path) -> None:
    """Draw a crowd half way through, and write a page that plays up to 100 of it."""
    from f3amd_lib.drawing.pictures import crowd_colors, crowd_figure
    from f3amd_lib.drawing.style import save_figure
    from f3amd_lib.serving.player import Character, Scene, write_player

    few, model = min(100, len(crowd)), crowd.settings["model"]
    motions = [crowd.motion(k) for k in range(few)]
    colors = crowd_colors([motion.name for motion in motions])
    figure = crowd_figure({model["name"]: (motions, colors)}, crowd.num_frames // 2)
    characters = [Character(motion, path=crowd.target(k), color=colors[k]) for k, motion in enumerate(motions)]
    credit = ", ".join(filter(None, (model["dataset_credit"], model["dataset_licence"])))
    scene = Scene(characters, title=model["name"])
    write_player(page, scene, strip=False, credit=credit)
    save_figure(figure, still)


def _export(arguments) -> None:
    from f3amd_lib.serving.export import export_model

    targets = arguments.target
    if targets is None:  # nobody asked for one: compile for this processor where that can be done
        targets = ("llvm-cpu",) if importlib.util.find_spec("iree") else ()
        if not targets:
            log.info("not compiled for this processor, since IREE is missing: make bench-tools")
    folder = export_model(
        _trained(arguments),
        arguments.out,
        num_steps=arguments.steps,
        batch=arguments.characters,
        sampler=arguments.sampler,
        targets=targets,
        overwrite=arguments.overwrite,
    )
    for file in sorted(Path(folder).iterdir()):
        log.info("wrote        %s (%.1f MB)", file, file.stat().st_size / 1e6)


def _bench(arguments) -> int:
    """Run the benchmarks in a process whose environment tells XLA how to be fast."""
    import subprocess

    from f3amd_lib.benchmarking.machine import fast_xla_flags

    environment = dict(os.environ)
    if "XLA_FLAGS" not in environment:
        environment["XLA_FLAGS"] = fast_xla_flags()
    command = [sys.executable, "-m", "f3amd_lib.benchmarking", *arguments.words[1:]]
    return subprocess.run(command, env=environment, check=False).returncode


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="f3amd", description=__doc__.split("\n")[0])
    commands = parser.add_subparsers(dest="command", required=True)

    def add(name, action, text):
        command = commands.add_parser(name, help=text, description=text)
        command.set_defaults(action=action)
        return command

    def with_data(command):
        from f3amd_lib.ground.profiles import DATASETS, PROFILES

        command.add_argument("--data", default="synthetic", choices=DATASETS)
        command.add_argument("--profile", default="laptop", choices=PROFILES)
        command.add_argument("--source", help="folder or archive, for data sets that need one")

    with_data(add("data", _data, "open a data set, build its cache, say what is in it"))

    presets = add("presets", _presets, "list the models with their sizes")
    presets.add_argument("--channels", type=int, default=141, help="features a frame, 6 J + 3")
    presets.add_argument("--styles", type=int, default=100)

    train = add("train", _train, "train a model; a killed run goes on where it stopped")
    with_data(train)
    train.add_argument(
        "--preset",
        action="append",
        help="such as F3AMD-FNO-96; by default the profile's; repeatable, trained in this order",
    )
    train.add_argument(
        "--minutes", type=float, help="stop then, with a checkpoint that a later call goes on from, and exit status 3"
    )
    train.add_argument("--all-devices", action="store_true", help="share each batch among the devices JAX sees")
    train.add_argument("--processes", type=int, help="train in so many processes together")
    train.add_argument("--process", type=int, help="number of this one, from 0")
    train.add_argument("--coordinator", metavar="HOST:PORT", help="of process 0")
    train.add_argument(
        "--cluster",
        action="store_true",
        help="train in all processes of a job of Slurm, Open MPI or Kubernetes together",
    )
    train.add_argument("--steps", type=int, help="optimiser steps; by default the profile's")
    train.add_argument("--batch-size", type=int, help="windows a step")
    train.add_argument("--window", type=int, help="future frames, 32 or 64")
    train.add_argument("--seed", type=int)
    train.add_argument("--out", help="folder for the model instead of runs/DATA/PROFILE/models")

    def with_model(command):
        command.add_argument("--steps", type=int, default=8, help="denoising steps a round")
        command.add_argument("--sampler", help="ddim, ddpm, euler, heun; by default the model's own")
        command.add_argument("--data", default="synthetic", help="use the model of this data set")
        command.add_argument("--weights", help="a weights file, instead of the data set's own")
        command.add_argument("--overwrite", action="store_true", help="replace what lies there")

    from f3amd_lib.generation.crowd_planning import MIN_DISTANCE

    crowd = add("crowd", _crowd, "animate any number of characters; goes on where it was stopped")
    with_model(crowd)
    crowd.add_argument("--characters", type=int, default=1024)
    crowd.add_argument("--seconds", type=float, default=32 / 30, help="of each character")
    crowd.add_argument("--style", action="append", help="taken in turn; repeatable; default: all")
    crowd.add_argument("--seed", type=int, default=0)
    crowd.add_argument("--chunk", type=int, help="characters at once")
    crowd.add_argument(
        "--plan",
        type=float,
        nargs="?",
        const=MIN_DISTANCE,
        metavar="METRES",
        help=f"paths that keep this far apart at every frame ({MIN_DISTANCE} without a number)",
    )
    crowd.add_argument("--pictures", action="store_true", help="draw OUT.png and the player page OUT.html as well")
    crowd.add_argument("--out", default="out/crowd", help="folder to write to")

    export = add("export", _export, "make a round that runs without the model code")
    with_model(export)
    export.add_argument("--characters", type=int, default=1, help="of one call")
    export.add_argument("--target", action="append", help="llvm-cpu, vmvx, vulkan-spirv, cuda-sm_80; repeatable")
    export.add_argument("--out", default="out/round", help="folder to write to")

    bench = add("bench", _bench, "time synthesis and training (bench --help tells more)")
    bench.add_argument("words", nargs=argparse.REMAINDER, help="options of the benchmarks")

    rollout = add("rollout", _rollout, "animate one character: BVH, film strip, GIF (its first 12 s), player")
    rollout.add_argument("--style", required=True)
    rollout.add_argument("--path", default="figure-eight", help="a named path, or a CSV file")
    rollout.add_argument("--seed", type=int, default=0)
    rollout.add_argument("--seconds", type=float, default=20.0, help="length of a named path; a CSV has its own")
    rollout.add_argument("--speed", type=float, default=1.2, help="of a named path, m/s; a CSV has its own")
    with_model(rollout)
    rollout.add_argument("--blend", type=int, default=4, metavar="N", help="blend N frames after each window boundary")
    rollout.add_argument("--slide", action="store_true", help="do not hold feet where they stand")
    rollout.add_argument("--raw", action="store_true", help="as the network made it: no blending, no held feet")
    rollout.add_argument("--out", default="out", help="folder to write to")
    return parser


def main(argv: list[str] | None = None) -> int:
    """Run a command; errors of the user's making end with one line and status 2."""
    logging.basicConfig(level=logging.INFO, format="%(message)s", stream=sys.stdout)
    for noisy in ("jax", "absl", "matplotlib", "PIL"):
        logging.getLogger(noisy).setLevel(logging.WARNING)
    os.environ.setdefault("MPLBACKEND", "Agg")
    words = sys.argv[1:] if argv is None else argv
    if words[:1] == ["bench"]:  # its options are those of another program
        words = ["bench", "--", *words[1:]]
    arguments = _parser().parse_args(words)
    try:
        return arguments.action(arguments) or 0
    except (ValueError, OSError, ArithmeticError, ImportError) as error:
        print(f"f3amd {arguments.command}: {error}", file=sys.stderr)
        return 2


if __name__ == "__main__":
    sys.exit(main())
