"""Measure what takes too long for a notebook: `python -m f3amd_lib.measure learning`.

A measurement writes a tidy table with its run record under `<results>/records/`, after every model,
so that a run that was stopped goes on where it was. Notebooks only read these tables. Results go to
the ignored `runs/` unless `F3AMD_RESULTS_DIR` says otherwise (`make measure` sends them to
`paper_figures/`).
"""

from __future__ import annotations

import argparse
import dataclasses
import logging
import sys
import time
from collections.abc import Callable, Iterable
from pathlib import Path

import pandas as pd
from tqdm import tqdm

from f3amd_lib.evaluation import sensitivity
from f3amd_lib.evaluation.classifier import StyleClassifier, obtain_classifier
from f3amd_lib.evaluation.protocol import (
    REFERENCE_MODELS,
    Protocol,
    evaluation_paths,
    measure_model,
    measure_real,
    summarise,
    windows_that_fit,
)
from f3amd_lib.evaluation.quality import reference_clips, row_label
from f3amd_lib.evaluation.rollout import MotionGenerator
from f3amd_lib.models import zoo
from f3amd_lib.names import nearest_hint
from f3amd_lib.profiles import DATASETS, PROFILES, Profile, load_profile, results_dir
from f3amd_lib.report.records import (
    read_table,
    record_hash,
    run_record,
    set_aside_table,
    write_table,
)
from f3amd_lib.training.checkpoints import weights_digest
from f3amd_lib.training.family import SHORT_RUN, learning_curves
from f3amd_lib.training.pipeline import (
    PreparedData,
    available_models,
    obtain_model,
    prepare,
)

__all__ = [
    "MEASUREMENTS",
    "STEPS",
    "measure_learning",
    "measure_quality",
    "measure_sensitivity",
    "main",
]

log = logging.getLogger("f3amd")


def _kept_rows(path: Path, record: dict) -> pd.DataFrame | None:
    """Return the rows of an earlier run that asked for the same; None if there are none.

    A table that asked for something else is kept under another name.
    """
    if not path.exists():
        return None
    rows, earlier = read_table(path)
    if record_hash(earlier) != record_hash(record):
        kept = set_aside_table(path)
        log.warning("%s was measured with other settings or data: kept as %s", path, kept.name)
        return None
    if "unit" in rows:
        rows["unit"] = rows["unit"].fillna("")  # CSV knows no empty text
    return rows


def measure_learning(
    prepared: PreparedData, profile: Profile, models: Iterable[str] | None = None
) -> Path:
    """Train every preset for a short while and keep its learning curve (see `training.family`).

    Args:
      prepared: the data.
      profile: names the results' folder and the seed.
      models: presets; all by default. Models measured earlier, with the same settings on the same
        data, keep their rows; asking for one by name measures it again.

    Returns:
      The table, `records/learning.csv`.
    """
    path = results_dir(profile.dataset, profile.name) / "records" / "learning.csv"
    record = run_record(
        profile=profile, dataset=prepared.packed, seed=profile.seed, measurement="learning",
        **SHORT_RUN,
    )  # fmt: skip
    kept = _kept_rows(path, record)
    measured = set() if kept is None else set(kept["model"])
    todo = list(models) if models else [name for name in zoo.PRESETS if name not in measured]
    for curve in learning_curves(prepared, todo, seed=profile.seed):
        if kept is not None:
            curve = pd.concat([kept[kept["model"] != curve["model"].iloc[0]], curve])
        kept = curve
        write_table(path, kept, record)
    return path


def _protocol(
    prepared: PreparedData, profile: Profile, measurement: str
) -> tuple[StyleClassifier, Protocol, dict]:
    """Return the style classifier, the protocol of a profile and the record of a measurement."""
    packed = prepared.packed
    classifier, _ = obtain_classifier(packed, profile)
    protocol = Protocol(
        tuple(profile.evaluation_styles or packed.primary_styles[: profile.num_characters]),
        num_frames=profile.rollout_rounds * profile.window,
        **_PROTOCOL.get(profile.name, {}),
    )
    fitting = windows_that_fit(packed, classifier, protocol, window=profile.window)
    protocol = dataclasses.replace(protocol, windows_per_style=fitting)
    record = run_record(
        profile=profile, dataset=packed, seed=protocol.path_seed, measurement=measurement,
        protocol=dataclasses.asdict(protocol), classifier=classifier.record["classifier_training"],
        classifier_weights=weights_digest(classifier.params),
        classifier_accuracy=classifier.accuracy,
    )  # fmt: skip
    return classifier, protocol, record


def measure_quality(
    prepared: PreparedData, profile: Profile, models: Iterable[str] | None = None
) -> Path:
    """Run the evaluation protocol: real and broken motion, and models at 8, 4, 2 and 1 steps.

    See `evaluation.protocol`. A row takes about a minute on 2 cores; its seconds are in the table.

    Args:
      prepared: the data.
      profile: says how long rollouts are, and where models and results lie.
      models: presets; by default all that have weights for this data set and window, shipped or in
        `runs/`. One that is asked for by name is measured again, and trained if it has none. Rows
        of weights that have changed since are measured again as well.

    Returns:
      The table of means and intervals, `records/quality.csv`; beside it `quality_by_seed.csv` and
      `quality_by_round.csv`.
    """
    folder = results_dir(profile.dataset, profile.name) / "records"
    packed = prepared.packed
    classifier, protocol, record = _protocol(prepared, profile, "quality")
    paths = {name: folder / f"{name}.csv" for name in ("quality_by_seed", "quality_by_round")}
    kept = {name: _kept_rows(path, record) for name, path in paths.items()}
    held_out = prepared.windows(prepared.held_out_split)
    asked = [zoo.find_preset(name).name for name in models or ()]
    chosen = asked or available_models(profile)
    if not chosen:
        log.warning(
            "no trained model of %s at %s: only real motion is measured; name models with --model",
            profile.dataset, profile.name,
        )  # fmt: skip

    def keep(name: str, rows: pd.DataFrame, weights: str) -> None:
        """Put rows in place of those of the same model, window and steps, and write the table."""
        rows, keys = rows.assign(weights=weights), ["model", "window_frames", "steps"]
        earlier = kept[name]
        if earlier is not None:
            now = set(map(tuple, rows[keys].to_numpy().tolist()))
            old = [tuple(row) not in now for row in earlier[keys].to_numpy().tolist()]
            rows = pd.concat([earlier[old], rows])
        kept[name] = rows
        write_table(paths[name], rows, record)

    def measured(model: str, steps: int, weights: str) -> bool:
        rows = kept["quality_by_seed"]
        if rows is None or model in asked:
            return False
        mine = rows[(rows["model"] == model) & (rows["window_frames"] == profile.window)]
        mine = mine[mine["steps"] == steps]
        return len(mine) > 0 and set(mine["weights"]) == {weights}

    trained = {model: obtain_model(prepared, profile, preset=model)[0] for model in chosen}
    digests = {model: weights_digest(trained[model].params) for model in chosen}
    # Real motion has no weights, but it is seen through the classifier's.
    digests |= dict.fromkeys(REFERENCE_MODELS, record["classifier_weights"])
    todo = [(model, 0) for model in REFERENCE_MODELS]
    for model in chosen:
        levels = len(getattr(trained[model].config, "noise_levels", ())) or max(STEPS)
        todo += [(model, steps) for steps in STEPS if steps <= levels]
    todo = [row for row in todo if not measured(*row, digests[row[0]])]
    with tqdm(todo, unit="row") as bar:
        for model, steps in bar:
            bar.set_postfix_str(row_label(model, steps) if steps else model)
            started = time.perf_counter()
            if steps:
                generator = MotionGenerator(trained[model], steps)
                rows, rounds = measure_model(generator, packed, classifier, protocol, held_out)
                keep("quality_by_round", rounds, digests[model])
            else:
                rows = measure_real(
                    packed, classifier, protocol, window=profile.window, model=model
                )
            rows = rows.assign(seconds=round(time.perf_counter() - started, 1))
            keep("quality_by_seed", rows, digests[model])
            write_table(folder / "quality.csv", summarise(kept["quality_by_seed"]), record)
    return folder / "quality.csv"


def measure_sensitivity(
    prepared: PreparedData, profile: Profile, models: Iterable[str] | None = None
) -> Path:
    """Ask the metrics themselves (see `evaluation.sensitivity`), some minutes in all.

    Whether FID and EMD order graded corruptions, how many windows they need before they settle, and
    how lively feet are in each band of frequency, real and generated with the profile's steps.

    Args:
      prepared, profile: as for `measure_quality`.
      models: presets whose feet are looked at; by default all that have weights.

    Returns:
      The table `records/corruptions.csv`; beside it `settling.csv` and `foot_spectrum.csv`. All
      three are measured anew.
    """
    folder = results_dir(profile.dataset, profile.name) / "records"
    packed = prepared.packed
    classifier, protocol, record = _protocol(prepared, profile, "sensitivity")
    graded = sensitivity.graded_corruptions(packed, classifier, protocol, progress=True)
    tables = {
        "corruptions": sensitivity.summarise_corruptions(graded),
        "settling": sensitivity.settling(classifier),
    }
    styles = list(protocol.styles)
    paths = evaluation_paths(packed, styles, protocol.num_frames, seed=protocol.path_seed)
    clips = reference_clips(packed, styles, window=profile.window)
    feet = {
        ("real", profile.window, 0): [
            (packed.styles[packed.clip_style[clip]], packed.motion(clip)) for clip in clips
        ]
    }
    asked = [zoo.find_preset(name).name for name in models or available_models(profile)]
    for model in tqdm(asked, unit="model"):
        trained, _, _ = obtain_model(prepared, profile, preset=model)
        generator = MotionGenerator(trained, profile.num_steps)
        rollout = generator.rollout(paths, styles, seed=protocol.path_seed)
        motions = [rollout.motion(character) for character in range(len(styles))]
        key = (model, profile.window, profile.num_steps)
        feet[key] = list(zip(styles, motions, strict=True))
    tables["foot_spectrum"] = sensitivity.foot_spectrum(feet)
    for name, table in tables.items():
        write_table(folder / f"{name}.csv", table, record)
    return folder / "corruptions.csv"


STEPS = (8, 4, 2, 1)
"""Numbers of denoising steps that the paper compares (Table 5)."""

_PROTOCOL = {"smoke": {"num_seeds": 2, "num_diversity_seeds": 2}}

MEASUREMENTS: dict[str, Callable] = {
    "learning": measure_learning,
    "quality": measure_quality,
    "sensitivity": measure_sensitivity,
}
"""Name -> function of (prepared data, profile, models or None) that returns its table's path."""


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; see the module's first lines.

    Args:
      arguments: words after the program's name; those of the process by default.

    Returns:
      Exit status: 0 if all was measured, 2 for a name that does not exist.
    """
    parser = argparse.ArgumentParser(
        prog="python -m f3amd_lib.measure",
        description="Measure what notebooks only draw; tables go to <results>/records/.",
    )
    parser.add_argument(
        "names", nargs="*", metavar="MEASUREMENT", help=f"{', '.join(MEASUREMENTS)}; all if none"
    )
    parser.add_argument("--data", default="synthetic", help=", ".join(DATASETS))
    parser.add_argument("--profile", default="laptop", help=", ".join(PROFILES))
    parser.add_argument("--source", help="folder or archive of the data set, where it needs one")
    parser.add_argument(
        "--model", action="append", default=[], metavar="NAME", help="this preset; repeatable"
    )
    options = parser.parse_args(arguments)
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    try:
        profile = load_profile(options.profile, options.data)
        for name in options.names:
            if name not in MEASUREMENTS:
                raise ValueError(f"unknown measurement {name!r}{nearest_hint(name, MEASUREMENTS)}")
        models = [zoo.find_preset(name).name for name in options.model] or None
        prepared = prepare(profile, path=options.source)
        for name in options.names or MEASUREMENTS:
            path = MEASUREMENTS[name](prepared, profile, models)
            log.info("%-12s %s", name, path)
    except (ValueError, ArithmeticError, RuntimeError) as error:
        log.error("Stopped: %s", error)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
