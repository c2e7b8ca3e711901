"""Measure what takes too long for a notebook: `python -m f3amd_lib.experiments.measure learning`.

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

import numpy as np
import pandas as pd
from tqdm import tqdm

from f3amd_lib.experiments import literal_update, sensitivity
from f3amd_lib.experiments.denoising import window_row, x0_error_by_sigma
from f3amd_lib.experiments.learning_curves import SHORT_RUN, learning_curves
from f3amd_lib.experiments.posterior import measure_posterior
from f3amd_lib.experiments.precision import measure_precision
from f3amd_lib.experiments.protocol import (
    REFERENCE_MODELS,
    Protocol,
    evaluation_paths,
    measure_model,
    measure_real,
    summarise,
    windows_that_fit,
)
from f3amd_lib.experiments.quality import reference_clips, row_label, style_floor
from f3amd_lib.experiments.recipes import RECIPE_STEPS, RECIPES, train_recipe
from f3amd_lib.generation.rollout import MotionGenerator
from f3amd_lib.ground.names import nearest_hint
from f3amd_lib.ground.profiles import DATASETS, PROFILES, Profile, load_profile, results_dir, runs_dir
from f3amd_lib.ground.records import kept_rows, run_record, write_table
from f3amd_lib.measures.classifier import StyleClassifier, obtain_classifier
from f3amd_lib.measures.walking import walking_figures
from f3amd_lib.motion.synthetic import walk_along
from f3amd_lib.networks import presets
from f3amd_lib.training.checkpoints import weights_digest
from f3amd_lib.training.pipeline import PreparedData, available_models, obtain_model, prepare

log = logging.getLogger("f3amd")


def _with_rows(earlier: pd.DataFrame | None, rows: pd.DataFrame, keys: list[str]) -> pd.DataFrame:
    """Put rows in place of those that have the same keys, after all others."""
    if earlier is None:
        return rows
    now = set(map(tuple, rows[keys].to_numpy().tolist()))
    old = [tuple(row) not in now for row in earlier[keys].to_numpy().tolist()]
    return pd.concat([earlier[old], rows])


def _models_with_weights(profile: Profile) -> list[str]:
    """List the presets that have weights; ValueError, with what to do, if there are none."""
    names = available_models(profile)
    if not names:
        raise ValueError(
            f"no trained model for {profile.dataset!r} at profile {profile.name!r}: train one "
            f"(`python -m f3amd_lib train --data {profile.dataset} --profile {profile.name}`) or "
            "name one with --model"
        )
    return names


def measure_learning(prepared: PreparedData, profile: Profile, models: Iterable[str] | None = None) -> Path:
    """Train every preset for a short while and keep its learning curve (see `experiments.learning_curves`).

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
    kept = kept_rows(path, record)
    measured = set() if kept is None else set(kept["model"])
    todo = [presets.find_preset(name).name for name in models or ()]
    todo = todo or [name for name in presets.PRESETS if name not in measured]
    for curve in learning_curves(prepared, todo, seed=profile.seed):
        if kept is not None:
            curve = pd.concat([kept[kept["model"] != curve["model"].iloc[0]], curve])
        kept = curve
        write_table(path, kept, record)
    return path


def _protocol(prepared: PreparedData, profile: Profile, measurement: str) -> tuple[StyleClassifier, Protocol, dict]:
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


def measure_quality(prepared: PreparedData, profile: Profile, models: Iterable[str] | None = None) -> Path:
    """Run the evaluation protocol: real and broken motion, and models at 8, 4, 2 and 1 steps.

    See `experiments.protocol`. A row takes about a minute on 2 cores; its seconds are in the table.

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
    kept = {name: kept_rows(path, record) for name, path in paths.items()}
    held_out = prepared.windows(prepared.held_out_split)
    asked = [presets.find_preset(name).name for name in models or ()]
    chosen = asked or available_models(profile)
    if not chosen:
        log.warning(
            "no trained model of %s at %s: only real motion is measured; name models with --model",
            profile.dataset, profile.name,
        )  # fmt: skip

    def keep(name: str, rows: pd.DataFrame, weights: str) -> None:
        """Put rows in place of those of the same model, window and steps, and write the table."""
        keys = ["model", "window_frames", "steps"]
        kept[name] = _with_rows(kept[name], rows.assign(weights=weights), keys)
        write_table(paths[name], kept[name], record)

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
                rows = measure_real(packed, classifier, protocol, window=profile.window, model=model)
            rows = rows.assign(seconds=round(time.perf_counter() - started, 1))
            keep("quality_by_seed", rows, digests[model])
            write_table(folder / "quality.csv", summarise(kept["quality_by_seed"]), record)
    return folder / "quality.csv"


WALKING_SEEDS = 3
"""Seeds of path and noise in `measure_walking`."""


def measure_walking(prepared: PreparedData, profile: Profile, models: Iterable[str] | None = None) -> Path:
    """Measure feet, floor and seams of every model that has weights, at 8 steps and at 1.

    Three paths with noise of their own, a quarter of the profile's rounds each; see
    `measures.walking`. The row "real" is the walker itself on the same paths for `synthetic`,
    held-out clips for captured data.

    Args:
      prepared, profile, models: as for `measure_quality`.

    Returns:
      The table, `records/walking.csv`: a row per model, steps, seed and style, with the digest of
      the weights.
    """
    path = results_dir(profile.dataset, profile.name) / "records" / "walking.csv"
    packed, seeds = prepared.packed, range(WALKING_SEEDS)
    styles = list(profile.evaluation_styles or packed.primary_styles[: profile.num_characters])
    num_frames = max(2, profile.rollout_rounds // 4) * profile.window
    record = run_record(
        profile=profile, dataset=packed, seed=profile.seed, measurement="walking",
        num_frames=num_frames, num_seeds=WALKING_SEEDS, styles=styles,
    )  # fmt: skip
    kept = kept_rows(path, record)
    made = packed.dataset == "synthetic"  # its floor is at 0, and its source walks any path
    floors = {style: 0.0 if made else style_floor(packed, style) for style in styles}
    paths = {seed: evaluation_paths(packed, styles, num_frames, seed=seed) for seed in seeds}

    def rows(motions, seed: int, **what) -> pd.DataFrame:
        """Measure motions, in the order of (style, motion)."""
        table = [
            {**what, "seed": seed, "style": style} | walking_figures(motion, profile.window, floors[style])
            for style, motion in motions
        ]
        return pd.DataFrame(table)

    asked = [presets.find_preset(name).name for name in models or ()]
    todo = [(name, steps) for name in asked or available_models(profile) for steps in (8, 1)]
    tables = []
    if kept is None:
        for seed in seeds if made else seeds[:1]:
            if made:
                drawn = zip(styles, paths[seed], strict=True)
                motions = [(s, walk_along(s, line.position, line.yaw)) for s, line in drawn]
            else:
                clips = reference_clips(packed, styles, window=profile.window)
                motions = [(packed.styles[packed.clip_style[k]], packed.motion(k)) for k in clips]
            tables.append(rows(motions, seed, model="real", steps=0, weights=""))
        kept = pd.concat(tables)
    for name, steps in tqdm(todo, unit="row"):
        trained, _, _ = obtain_model(prepared, profile, preset=name)
        weights = weights_digest(trained.params)
        mine = kept[(kept["model"] == name) & (kept["steps"] == steps)]
        if name not in asked and len(mine) and set(mine["weights"]) == {weights}:
            continue
        generator, tables = MotionGenerator(trained, steps), []
        for seed in seeds:
            rollout = generator.rollout(paths[seed], styles, seed=seed)
            motions = [(style, rollout.motion(k)) for k, style in enumerate(styles)]
            tables.append(rows(motions, seed, model=name, steps=steps, weights=weights))
        kept = _with_rows(kept, pd.concat(tables), ["model", "steps"])
        write_table(path, kept, record)
    write_table(path, kept, record)
    return path


def measure_sensitivity(prepared: PreparedData, profile: Profile, models: Iterable[str] | None = None) -> Path:
    """Ask the metrics themselves (see `experiments.sensitivity`), some minutes in all.

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
    tables = {"corruptions": sensitivity.summarise_corruptions(graded), "settling": sensitivity.settling(classifier)}
    styles = list(protocol.styles)
    paths = evaluation_paths(packed, styles, protocol.num_frames, seed=protocol.path_seed)
    clips = reference_clips(packed, styles, window=profile.window)
    feet = {
        ("real", profile.window, 0): [(packed.styles[packed.clip_style[clip]], packed.motion(clip)) for clip in clips]
    }
    asked = [presets.find_preset(name).name for name in models or available_models(profile)]
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


def measure_literal_update(prepared: PreparedData, profile: Profile, models: Iterable[str] | None = None) -> Path:
    """Walk trained models with the printed update, rescaled and taken literally, side by side.

    See `experiments.literal_update` and Appendix F of the paper. Rollouts by the evaluation protocol
    with 8, 4, 2 and 1 steps on both readings of the grid, and single windows from the same noise.
    One step is the same in all four; it is walked once. A rollout takes about a minute on 2 cores,
    13 of them a model.

    Args:
      prepared, profile: as for `measure_quality`.
      models: presets; by default all that have weights, but for those whose own sampler is not
        DDIM. One that is asked for by name is measured again, and trained if it has none.

    Returns:
      The table of means and intervals, `records/literal_update.csv`; beside it
      `literal_update_by_seed.csv` and `literal_update_windows.csv`.
    """
    folder = results_dir(profile.dataset, profile.name) / "records"
    packed = prepared.packed
    classifier, protocol, record = _protocol(prepared, profile, "literal_update")
    names = ("literal_update_by_seed", "literal_update_windows")
    kept = {name: kept_rows(folder / f"{name}.csv", record) for name in names}
    held_out = prepared.windows(prepared.held_out_split)
    asked = [presets.find_preset(name).name for name in models or ()]

    def keep(name: str, rows: pd.DataFrame, *keys: str) -> None:
        """Put rows in place of those with the same model and keys, and write the table."""
        kept[name] = _with_rows(kept[name], rows, ["model", *keys])
        write_table(folder / f"{name}.csv", kept[name], record)

    def measured(name: str, weights: str, **row) -> bool:
        mine = kept[name]
        if mine is None or row["model"] in asked:
            return False
        for column, value in row.items():
            mine = mine[mine[column] == value]
        return len(mine) > 0 and set(mine["weights"]) == {weights}

    for model in asked or _models_with_weights(profile):
        trained, _, _ = obtain_model(prepared, profile, preset=model)
        weights = weights_digest(trained.params)
        if trained.diffusion.sampler != literal_update.UPDATES["rescaled"]:
            if asked:
                raise ValueError(
                    f"{model} samples by {trained.diffusion.sampler!r}, which has no printed "
                    "update: name models that sample by DDIM in the VE state"
                )
            continue
        for spacing in SPACINGS:
            if not measured("literal_update_windows", weights, model=model, spacing=spacing):
                walks = literal_update.walk_windows(trained, held_out, STEPS, spacing=spacing)
                figures = literal_update.window_figures(walks).assign(model=model, spacing=spacing, weights=weights)
                keep("literal_update_windows", figures, "spacing")
        todo = [
            {"model": model, "spacing": spacing, "update": update, "steps": steps}
            for spacing in SPACINGS
            for update in literal_update.UPDATES
            for steps in STEPS
            if steps > 1 or (spacing, update) == (SPACINGS[0], "rescaled")
        ]
        todo = [row for row in todo if not measured("literal_update_by_seed", weights, **row)]
        for row in tqdm(todo, unit="row", desc=model):
            generator = MotionGenerator(
                trained, row["steps"], spacing=row["spacing"], sampler=literal_update.UPDATES[row["update"]]
            )
            rows, _ = measure_model(generator, packed, classifier, protocol, held_out, name=model)
            rows = rows.assign(spacing=row["spacing"], update=row["update"], weights=weights)
            keep("literal_update_by_seed", rows, "spacing", "update", "steps")
        ways = kept["literal_update_by_seed"].groupby(["spacing", "update"], sort=False)
        summary = pd.concat(summarise(rows).assign(spacing=spacing, update=update) for (spacing, update), rows in ways)
        write_table(folder / "literal_update.csv", summary, record)
    return folder / "literal_update.csv"


def measure_noise_use(prepared: PreparedData, profile: Profile, models: Iterable[str] | None = None) -> Path:
    """Ask trained models whether they use their noisy input; single windows, seconds a model.

    Args:
      prepared: the data.
      profile: where models and results lie.
      models: presets; by default all that have weights. One that is asked for by name is measured
        again, and trained if it has none.

    Returns:
      The table `records/noise_use.csv`, a row per model and number of steps (see
      `denoising.window_row`); beside it `x0_by_sigma.csv`, the x0 error against the noise level, at
      the levels that a model was told where it was told some.
    """
    folder = results_dir(profile.dataset, profile.name) / "records"
    record = run_record(profile=profile, dataset=prepared.packed, seed=profile.seed, measurement="noise_use")
    paths = {name: folder / f"{name}.csv" for name in ("noise_use", "x0_by_sigma")}
    kept = {name: kept_rows(path, record) for name, path in paths.items()}
    held_out = prepared.windows(prepared.held_out_split)
    asked = [presets.find_preset(name).name for name in models or ()]
    for model in tqdm(asked or _models_with_weights(profile), unit="model"):
        trained, _, _ = obtain_model(prepared, profile, preset=model)
        weights = weights_digest(trained.params)
        rows = kept["x0_by_sigma"]
        if not asked and rows is not None and weights in set(rows["weights"]):
            continue
        levels = getattr(trained.config, "noise_levels", ()) or SIGMAS
        steps = [count for count in (8, 1) if count <= len(levels)]
        made = {
            "noise_use": window_row(trained, held_out, steps=steps, seed=profile.seed),
            "x0_by_sigma": x0_error_by_sigma(trained, held_out, levels),
        }
        for name, table in made.items():
            table = table.assign(model=model, noise=trained.diffusion.kind, weights=weights)
            kept[name] = _with_rows(kept[name], table, ["model"])
            write_table(paths[name], kept[name], record)
    return paths["noise_use"]


def measure_recipes(prepared: PreparedData, profile: Profile, models: Iterable[str] | None = None) -> Path:
    """Train `F3AMD-FNO-96` with one change each, for a short while (see `experiments.recipes`).

    Unfinished runs are gone on with; a row takes some minutes on 2 cores.

    Args:
      prepared: the data.
      profile: how many steps, of what batch; where results lie.
      models: no use here: rows are recipes, and all are measured.

    Returns:
      The table `records/recipes.csv`.

    Raises:
      ValueError: if models are named.
    """
    if models:
        raise ValueError("recipes are rows of their own: leave --model out")
    path = results_dir(profile.dataset, profile.name) / "records" / "recipes.csv"
    record = run_record(
        profile=profile, dataset=prepared.packed, seed=profile.seed, measurement="recipes",
        num_steps=RECIPE_STEPS[profile.name], batch_size=profile.batch_size,
    )  # fmt: skip
    held_out = prepared.windows(prepared.held_out_split)
    kept = kept_rows(path, record)
    folder = runs_dir(profile.dataset, profile.name) / "recipes"
    for name in tqdm(RECIPES, unit="recipe"):
        if kept is not None and name in set(kept["recipe"]):
            continue
        trained = train_recipe(prepared, profile, name, folder=folder)
        rows = window_row(trained, held_out, seed=profile.seed)
        rows = rows.assign(recipe=name, change=RECIPES[name].change, weights=weights_digest(trained.params))
        kept = rows if kept is None else pd.concat([kept, rows])
        write_table(path, kept, record)
    return path


STEPS = (8, 4, 2, 1)
"""Numbers of denoising steps that the paper compares (Table 5)."""

SPACINGS = ("endpoints", "uniform")
"""Both readings of where N steps lie, ours first (see `VarianceExploding.grid`)."""

SIGMAS = tuple(np.geomspace(0.01, 128.0, 17).tolist())
"""Noise levels at which an x0 error is measured, for networks that take any level."""

_PROTOCOL = {"smoke": {"num_seeds": 2, "num_diversity_seeds": 2}}

MEASUREMENTS: dict[str, Callable] = {
    "learning": measure_learning,
    "precision": measure_precision,
    "literal_update": measure_literal_update,
    "posterior": measure_posterior,
    "noise_use": measure_noise_use,
    "recipes": measure_recipes,
    "quality": measure_quality,
    "walking": measure_walking,
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
        prog="python -m f3amd_lib.experiments.measure",
        description="Measure what notebooks only draw; tables go to <results>/records/.",
    )
    parser.add_argument("names", nargs="*", metavar="MEASUREMENT", help=f"{', '.join(MEASUREMENTS)}; all if none")
    parser.add_argument("--data", default="synthetic", help=", ".join(DATASETS))
    parser.add_argument("--profile", default="laptop", help=", ".join(PROFILES))
    parser.add_argument("--source", help="folder or archive of the data set, where it needs one")
    parser.add_argument("--model", action="append", default=[], metavar="NAME", help="this preset; repeatable")
    options = parser.parse_args(arguments)
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    try:
        profile = load_profile(options.profile, options.data)
        for name in options.names:
            if name not in MEASUREMENTS:
                raise ValueError(f"unknown measurement {name!r}{nearest_hint(name, MEASUREMENTS)}")
        models = [presets.find_preset(name).name for name in options.model] or None
        prepared = prepare(profile, path=options.source)
        for name in options.names or MEASUREMENTS:
            path = MEASUREMENTS[name](prepared, profile, models)
            log.info("%-12s %s", name, path)
    except (ValueError, OSError, ArithmeticError, RuntimeError) as error:
        log.error("Stopped: %s", error)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
