"""Measure what takes too long for a notebook: `f3amd measure quality`.

A measurement writes a tidy table with its run record under `<results>/records/`, after every row,
so that a run that was stopped goes on where it was (see `runner`). Notebooks only read these tables.
Results go to the ignored `runs/` unless `F3AMD_RESULTS_DIR` says otherwise (`make measure` sends
them to `paper_figures/`).

Every measurement is a function of the prepared data, a profile, which says how much is measured and
where models and results lie, and the presets that are asked for: by default all that have weights
for this data set and window, shipped or in `runs/`. One that is asked for by name is measured again,
and trained if it has no weights. Rows of weights that have changed since are measured again as well.
Each returns the path of its table.
"""

import dataclasses
import itertools
import time
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pandas as pd

from f3amd_companion.measuring import sensitivity
from f3amd_companion.measuring.consistency_task import STUDENT_SPACING, TEACHER_STEPS, distil
from f3amd_companion.measuring.runner import Records, record_of, records_folder
from f3amd_companion.measuring.times import Candidate, time_group, timed_record
from f3amd_companion.serving.foot_locking import lock_rollout
from f3amd_lib.data.packed import PackedMotion
from f3amd_lib.data.windows import WindowSet, spread_windows
from f3amd_lib.ground import log
from f3amd_lib.ground.names import asked_network
from f3amd_lib.ground.profiles import Profile, runs_dir
from f3amd_lib.ground.records import run_record, write_table
from f3amd_lib.ground.trees import weights_digest
from f3amd_lib.measures import denoising
from f3amd_lib.measures import protocol as protocols
from f3amd_lib.measures.classifier import StyleClassifier, obtain_classifier
from f3amd_lib.measures.distributions import mean_and_interval
from f3amd_lib.measures.real_clips import reference_clips, style_floor
from f3amd_lib.measures.walking import walking_figures
from f3amd_lib.motion.skeleton import Motion
from f3amd_lib.motion.synthetic import walk_along
from f3amd_lib.papers.printed import PUBLISHED_CAMDM
from f3amd_lib.rollout.blending import blend_rollout
from f3amd_lib.rollout.rollout import MotionGenerator
from f3amd_lib.text.released import read_released
from f3amd_lib.training.checkpoints import TrainedModel
from f3amd_lib.training.denoising_task import DenoisingTask
from f3amd_lib.training.pipeline import PreparedData, available_models, obtain_model
from f3amd_lib.training.recipe import profile_recipe

STEPS = (8, 4, 2, 1)
"""Numbers of denoising steps that the paper compares (Table 5)."""

LEADING = ", leading"
"""Added to the name of a network of K levels in rows whose fewer steps count from the least noisy one."""

SIGMAS = tuple(np.geomspace(0.01, 128.0, 17).tolist())
"""Noise levels at which an x0 error is measured, for networks that take any level."""

WALKING_SEEDS = 3
"""Seeds of path and noise in `measure_walking`."""

ONE_STEP_MODELS = {"CAMDM": (1, 2, 4), "F3AMD-FNO-96-steady": (1,)}
"""Models that `measure_one_step` distils -> the numbers of phases, each a student of its own. A continuous schedule's
grid of 2 steps does not visit the middle of its grid of 8, so that its student has one phase."""

STUDENT_STEPS, STUDENT_BATCH = {"smoke": 4, "laptop": 300, "gpu": 20_000}, 32
"""Optimiser steps of a student by profile, and windows of each."""

_TIMED_CHARACTERS = 32

_PROTOCOL = {"smoke": {"num_seeds": 2, "num_diversity_seeds": 2}}


def _styles(prepared: PreparedData, profile: Profile) -> list[str]:
    return list(profile.evaluation_styles or prepared.packed.primary_styles[: profile.num_characters])


def models_with_weights(profile: Profile, option: str = "--model") -> list[str]:
    """List the presets that have weights; ValueError, with what to do (name one with `option`), if there are none."""
    if names := available_models(profile):
        return names
    raise ValueError(
        f"no trained model for {profile.dataset!r} at profile {profile.name!r}: train one (`f3amd train --data "
        f"{profile.dataset} --profile {profile.name}`) or name one with {option}"
    )


def _models(
    prepared: PreparedData, profile: Profile, models: Iterable[str] | None, among: Iterable[str] = ()
) -> dict[str, TrainedModel]:
    """Return the named models, or all (of `among`) that have weights."""
    known = available_models(profile)
    names = models or ([name for name in among if name in known] if among else known)
    return {name: obtain_model(prepared, profile, preset=name)[0] for name in names}


def _rows_of(profile: Profile, asked: Iterable[tuple[str, int]]) -> list[dict]:
    """Return what names the rows of each (model, steps)."""
    return [{"model": model, "window_frames": profile.window, "steps": steps} for model, steps in asked]


def _digests(trained: Mapping[str, TrainedModel]) -> dict[str, str]:
    return {name: weights_digest(model.params) for name, model in trained.items()}


def _measure(
    profile: Profile, record: dict, tables: Iterable[str], todo: list[dict], measure: Callable, *,
    again: Iterable[str] | None, trained: Mapping[str, TrainedModel] | None = None, other: str = "",
    summary: Callable | None = None,
) -> Path:  # fmt: skip
    """Measure what has no rows yet (see `Records.measure`), or is of models that are asked for `again` by name.

    What is to do names its rows in all `tables`, of which the first says whether it was measured; the `summary` of a
    table `<name>_by_seed` is the table `<name>`. With `trained` models, rows hold the digest of their network's
    weights, `other` where they have no network.
    """
    first, *_ = tables
    keys = dict.fromkeys(tables, list(todo[0]) if todo else [])
    if trained is not None:
        digests = _digests(trained)
        todo = [row | {"weights": digests.get(asked_network(row["model"]), other)} for row in todo]
    summaries = {} if summary is None else {first.removesuffix("_by_seed"): (first, summary)}
    return Records(records_folder(profile), record, keys, again=again or (), summaries=summaries).measure(todo, measure)


def _real_walks(packed: PackedMotion, profile: Profile, styles: list[str]) -> list[tuple[str, Motion]]:
    """Return (style, motion) of the real clips to compare with rollouts."""
    clips = reference_clips(packed, styles, window=profile.window)
    return [(packed.styles[packed.clip_style[clip]], packed.motion(clip)) for clip in clips]


def protocol_of(
    prepared: PreparedData, profile: Profile, measurement: str
) -> tuple[StyleClassifier, protocols.Protocol, dict]:
    """Return the style classifier, the protocol of a profile and the record of a measurement."""
    packed = prepared.packed
    classifier, _ = obtain_classifier(packed, profile)
    protocol = protocols.Protocol(
        tuple(_styles(prepared, profile)), num_frames=profile.rollout_frames, **_PROTOCOL.get(profile.name, {})
    )
    fitting = protocols.windows_that_fit(packed, classifier, protocol, window=profile.window)
    protocol = dataclasses.replace(protocol, windows_per_style=fitting)
    record = run_record(
        profile=profile, dataset=packed, seed=protocol.path_seed, measurement=measurement,
        protocol=dataclasses.asdict(protocol), classifier=classifier.record["classifier_training"],
        classifier_weights=weights_digest(classifier.params),
        classifier_accuracy=classifier.accuracy,
    )  # fmt: skip
    return classifier, protocol, record


def measure_quality(
    prepared: PreparedData, profile: Profile, models: Iterable[str] | None = None, *, published=None
) -> Path:
    """Run the evaluation protocol: real and broken motion, and models at 8, 4, 2 and 1 steps.

    See `measures.protocol`. A row takes about a minute on 2 cores; its seconds are in the table.
    `published` is the file of CAMDM's published weights (`text.released`), measured beside them.

    Returns:
      The table of means and intervals, `records/quality.csv`; beside it `quality_by_seed.csv` and
      `quality_by_round.csv`.
    """
    packed = prepared.packed
    classifier, protocol, record = protocol_of(prepared, profile, "quality")
    held_out = prepared.windows(prepared.held_out_split)
    trained = _models(prepared, profile, models)
    if published is not None:
        trained[PUBLISHED_CAMDM] = read_released(published, "camdm", packed=packed)
    if not trained:
        where = profile.dataset, profile.name
        log.warning("no trained model of %s at %s: only real motion is measured; name models with --model", *where)
    todo = [(model, 0) for model in protocols.REFERENCE_MODELS]
    for name, model in trained.items():
        levels = len(getattr(model.config, "noise_levels", ()))
        counts = [steps for steps in STEPS if steps <= (levels or max(STEPS))]
        todo += [(name, steps) for steps in counts]
        if levels:  # respaced in the other way that is in use, see `NoiseSchedule.times`
            todo += [(name + LEADING, steps) for steps in counts if steps < levels]

    def score(row: Mapping) -> dict:
        started, tables = time.perf_counter(), {}
        if row["steps"]:
            name = row["model"].removesuffix(LEADING)
            spacing = "endpoints" if name == row["model"] else "leading"
            generator = MotionGenerator(trained[name], row["steps"], spacing=spacing)
            rows, tables["quality_by_round"] = protocols.measure_model(
                generator, packed, classifier, protocol, held_out
            )
        else:
            rows = protocols.measure_real(packed, classifier, protocol, window=profile.window, model=row["model"])
        return tables | {"quality_by_seed": rows.assign(seconds=round(time.perf_counter() - started, 1))}

    # Real motion has no weights, but it is seen through the classifier's.
    return _measure(
        profile, record, ["quality_by_seed", "quality_by_round"], _rows_of(profile, todo), score, again=models,
        trained=trained, other=record["classifier_weights"], summary=protocols.summarise,
    )  # fmt: skip


TREATMENTS: dict[str, tuple[int, Callable | None]] = {
    "as made": (0, None),
    "blended": (4, None),
    "feet locked": (0, lock_rollout),
    "blended, feet locked": (4, lock_rollout),
}
"""What is done to a rollout where people look at it -> frames blended after a seam, what holds the feet."""


def measure_walking(prepared: PreparedData, profile: Profile, models: Iterable[str] | None = None) -> Path:
    """Measure feet, floor and seams of every model that has weights, at 8 steps and at 1.

    Three paths with noise of their own, a quarter of the profile's rounds each; see
    `measures.walking`. The row "real" is the walker itself on the same paths for `synthetic`,
    held-out clips for captured data.

    Returns:
      The table, `records/walking.csv`: a row per model, window, steps, seed and style, with the digest
      of the weights.
    """
    return _measure_walks(prepared, profile, models, "walking", ["as made"])


def measure_feet(prepared: PreparedData, profile: Profile, models: Iterable[str] | None = None) -> Path:
    """Measure what blending and foot locking do to feet, floor and seams, on the rollouts of `measure_walking`.

    Never a row of the paper's: what is treated is not what the network made.

    Returns:
      The table, `records/feet.csv`: a row per model, steps, treatment, seed and style; the row "real" is of held-out
      clips.
    """
    return _measure_walks(prepared, profile, models, "feet", TREATMENTS)


def _measure_walks(
    prepared: PreparedData, profile: Profile, models: Iterable[str] | None, name: str, treatments: Iterable[str]
) -> Path:
    """Measure rollouts on three short paths by `walking_figures`, each of them as treated."""
    packed, styles, made = prepared.packed, _styles(prepared, profile), prepared.packed.name == "synthetic"
    num_frames = max(2, profile.rollout_frames // 4 // profile.window) * profile.window
    floors = {style: 0.0 if made else style_floor(packed, style) for style in styles}
    paths = {seed: protocols.evaluation_paths(packed, styles, num_frames, seed=seed) for seed in range(WALKING_SEEDS)}
    record = record_of(profile, prepared.packed, name, num_frames=num_frames, num_seeds=WALKING_SEEDS, styles=styles)
    trained = _models(prepared, profile, models)

    def walks(row: Mapping):
        """Yield (treatment, seed, style, motion)."""
        if row["steps"]:
            generator = MotionGenerator(trained[row["model"]], row["steps"])
            for seed, lines in paths.items():
                rollout = generator.rollout(lines, styles, seed=seed)
                for treatment in treatments:
                    blend_frames, lock = TREATMENTS[treatment]
                    treated = blend_rollout(rollout, blend_frames)
                    treated = lock(treated) if lock else treated
                    yield from ((treatment, seed, style, treated.motion(k)) for k, style in enumerate(styles))
        elif made and name == "walking":  # its source walks any path
            for seed, lines in paths.items():
                for style, line in zip(styles, lines, strict=True):
                    yield "as made", seed, style, walk_along(style, line)
        else:
            yield from (("as made", 0, style, motion) for style, motion in _real_walks(packed, profile, styles))

    def measured(row: Mapping) -> dict:
        rows = [
            (row if name == "walking" else {"treatment": treatment}) | {"seed": seed, "style": style}
            | walking_figures(motion, profile.window, floors[style])
            for treatment, seed, style, motion in walks(row)
        ]  # fmt: skip
        return {name: pd.DataFrame(rows)}

    todo = _rows_of(profile, [("real", 0), *itertools.product(trained, (8, 1))])
    if name == "feet":
        todo = [{"model": row["model"], "steps": row["steps"]} for row in todo]
    return _measure(profile, record, [name], todo, measured, again=models, trained=trained)


def measure_trained(prepared: PreparedData, profile: Profile, models: Iterable[str] | None = None) -> Path:
    """Write down how many windows every model that has weights was trained with: `records/trained.csv`."""
    trained = _models(prepared, profile, models)
    sum_up = lambda row: {"trained": pd.DataFrame([{"metric": "windows", "value": trained[row["model"]].windows_seen}])}
    todo = [{"model": name, "window_frames": profile.window} for name in trained]
    record = record_of(profile, prepared.packed, "trained")
    return _measure(profile, record, ["trained"], todo, sum_up, again=models, trained=trained)


def measure_sensitivity(prepared: PreparedData, profile: Profile, models: Iterable[str] | None = None) -> Path:
    """Test the metrics themselves (see `measuring.sensitivity`), some minutes in all.

    Whether FID and EMD order graded corruptions, and how many windows they need before they settle.

    Returns:
      The table `records/corruptions.csv`; beside it `settling.csv`, where every style has windows to halve. Both are
      measured anew.

    Raises:
      ValueError: if models are named.
    """
    if models:
        raise ValueError("this measures metrics on real motion: leave --model out")
    classifier, protocol, record = protocol_of(prepared, profile, "sensitivity")
    graded = sensitivity.graded_corruptions(prepared.packed, classifier, protocol, progress=True)
    folder = records_folder(profile)
    if sensitivity.most_windows(classifier):
        write_table(folder / "settling.csv", sensitivity.settling(classifier), record)
    else:
        log.warning("settling is not measured: a style has fewer than two windows on a side")
    return write_table(folder / "corruptions.csv", sensitivity.summarise_corruptions(graded), record)


def measure_foot_spectrum(prepared: PreparedData, profile: Profile, models: Iterable[str] | None = None) -> Path:
    """Measure how lively feet are in each band of frequency, real and generated with the profile's steps.

    Returns:
      The table `records/foot_spectrum.csv` (see `sensitivity.foot_spectrum`).
    """
    styles, num_frames, trained = _styles(prepared, profile), profile.rollout_frames, _models(prepared, profile, models)
    paths = protocols.evaluation_paths(prepared.packed, styles, num_frames, seed=profile.seed)
    real = _real_walks(prepared.packed, profile, styles)

    def listen(row: Mapping) -> dict:
        walks = {("real", profile.window, 0): real}
        if row["steps"]:
            rollout = MotionGenerator(trained[row["model"]], row["steps"]).rollout(paths, styles, seed=profile.seed)
            walks[tuple(row[key] for key in ("model", "window_frames", "steps"))] = [
                (style, rollout.motion(character)) for character, style in enumerate(styles)
            ]
        return {"foot_spectrum": sensitivity.foot_spectrum(walks).query("model == @row['model']")}

    settings = {"num_frames": num_frames, "styles": styles, "steps": profile.num_steps}
    record = record_of(profile, prepared.packed, "foot_spectrum", **settings)
    todo = _rows_of(profile, [("real", 0), *((name, profile.num_steps) for name in trained)])
    return _measure(profile, record, ["foot_spectrum"], todo, listen, again=models, trained=trained)


def measure_noise_use(prepared: PreparedData, profile: Profile, models: Iterable[str] | None = None) -> Path:
    """Measure whether trained models use their noisy input; single windows, seconds a model.

    Returns:
      The table `records/noise_use.csv`, a row per model and number of steps (see
      `window_row`); beside it `x0_by_sigma.csv`, the x0 error against the noise level, at
      the levels that a model was told where it was told some, and `input_use.csv`, how far the
      estimates move with noisy input and noise level (see `denoising.input_use`).
    """
    held_out = prepared.windows(prepared.held_out_split)
    trained = _models(prepared, profile, models or models_with_weights(profile))

    def ask(row: Mapping) -> dict:
        model = trained[row["model"]]
        levels = getattr(model.config, "noise_levels", ()) or SIGMAS
        steps = [count for count in (8, 1) if count <= len(levels)]
        condition = denoising.held_out_condition(held_out, model)
        return {
            "x0_by_sigma": denoising.x0_error_by_sigma(model, held_out, levels),
            "input_use": denoising.input_use(model, condition, seed=profile.seed),
            "noise_use": window_row(model, held_out, steps=steps, seed=profile.seed),
        }

    record, tables = record_of(profile, prepared.packed, "noise_use"), ["noise_use", "x0_by_sigma", "input_use"]
    rows = [{"model": name, "noise": model.diffusion.kind} for name, model in trained.items()]
    return _measure(profile, record, tables, rows, ask, again=models, trained=trained)


def measure_gradient_norm(prepared: PreparedData, profile: Profile, models: Iterable[str] | None = None) -> Path:
    """Measure the gradient of the loss that is not scaled against the noise level, at trained weights (claim T5).

    Returns:
      The table `records/gradient_norm.csv` (see `gradient_norm_by_sigma`), of `F3AMD-FNO-96` by default.
    """
    trained = _models(prepared, profile, models or ["F3AMD-FNO-96"])
    held_out = prepared.windows(prepared.held_out_split)

    def slope(row: Mapping) -> dict:
        model, recipe = trained[row["model"]], profile_recipe(profile, row["model"])
        task = prepared.task(model.name, recipe, normaliser=model.normaliser)
        return {"gradient_norm": gradient_norm_by_sigma(task, model.params, held_out, SIGMAS, seed=profile.seed)}

    record = record_of(profile, prepared.packed, "gradient_norm", sigmas=SIGMAS)
    todo = [{"model": name} for name in trained]
    return _measure(profile, record, ["gradient_norm"], todo, slope, again=models, trained=trained)


DISTILLED, BY_DDIM = ", distilled", ", by DDIM"
"""Added to the name of a network in rows of its students of few steps, and of the walk that they learned."""


def measure_one_step(prepared: PreparedData, profile: Profile, models: Iterable[str] | None = None) -> Path:
    """Distil trained models into few steps and run the evaluation protocol on the students; long.

    A student has as many phases as steps (`measuring.consistency_task`). Where a model's own sampler adds noise on the
    way, the walk without it, which the students learned, has a row, too.

    Returns:
      The table `records/one_step.csv`; beside it `one_step_by_seed.csv`, and `one_step_input_use.csv`, how far the
      students' estimates move with noisy input and noise level (see `denoising.input_use`).
    """
    packed, num_steps = prepared.packed, STUDENT_STEPS[profile.name]
    held_out = prepared.windows(prepared.held_out_split)
    classifier, protocol, record = protocol_of(prepared, profile, "one_step")
    trained = _models(prepared, profile, models, among=ONE_STEP_MODELS)
    folder = runs_dir(profile.dataset, profile.name) / "one_step"
    record |= {"distillation_steps": num_steps, "batch_size": STUDENT_BATCH}

    def score(row: Mapping) -> dict:
        walker, steps = trained[asked_network(row["model"])], row["steps"]
        made = {"sampler": "ddim"}
        if row["model"].endswith(DISTILLED):
            settings = {"num_steps": num_steps, "num_phases": steps, "batch_size": STUDENT_BATCH}
            walker, _ = distil(prepared, profile, walker, folder / f"M{steps}", **settings)
            made |= {"spacing": STUDENT_SPACING}
        generator = MotionGenerator(walker, steps, **made)
        rows, _ = protocols.measure_model(generator, packed, classifier, protocol, held_out, name=row["model"])
        use = denoising.input_use(walker, denoising.held_out_condition(held_out, walker), seed=profile.seed)
        return {"one_step_input_use": use, "one_step_by_seed": rows}

    todo = [(name + DISTILLED, phases) for name in trained for phases in ONE_STEP_MODELS.get(name, (1,))]
    walks = [(name + BY_DDIM, TEACHER_STEPS) for name, model in trained.items() if model.diffusion.sampler != "ddim"]
    tables, rows = ["one_step_by_seed", "one_step_input_use"], _rows_of(profile, walks + todo)
    return _measure(profile, record, tables, rows, score, again=models, trained=trained, summary=protocols.summarise)


def measure_round_times(prepared: PreparedData, profile: Profile, models: Iterable[str] | None = None) -> Path:
    """Time a window for 32 characters at 8, 4, 2 and 1 steps, alternately, to compare students of one step.

    A student is as large as its teacher and takes its teacher's time at one step.

    Returns:
      The table `records/round_times.csv`: model, steps, characters, milliseconds (the median) and their bounds.
    """
    trained = _models(prepared, profile, models, among=(*ONE_STEP_MODELS, "F3AMD-FNO-96"))
    asked = [Candidate(name, steps, _TIMED_CHARACTERS, "jit") for name in trained for steps in STEPS]
    times, _ = time_group(asked, lambda name, window: trained[name].config, min_rounds=30, min_seconds=5.0)
    called = {"value": "milliseconds", "median_low": "milliseconds_low", "median_high": "milliseconds_high"}
    keys = ["model", "steps", "characters"]
    table = times[[*keys, *called]].rename(columns=called).assign(weights=times["model"].map(_digests(trained)))
    record = timed_record(prepared, profile, "round_times", characters=_TIMED_CHARACTERS)
    return write_table(records_folder(profile) / "round_times.csv", table, record)


MEASUREMENTS: dict[str, Callable] = {
    measure.__name__.removeprefix("measure_"): measure
    for measure in (
        measure_noise_use,
        measure_gradient_norm, measure_quality, measure_walking,
        measure_feet, measure_trained, measure_foot_spectrum, measure_sensitivity, measure_one_step,
        measure_round_times,
    )
}  # fmt: skip
"""Name -> function of (prepared data, profile, models or None) that returns its table's path."""


def gradient_norm_by_sigma(task: DenoisingTask, params, windows: WindowSet, sigmas, *, seed: int = 0) -> pd.DataFrame:
    """Measure how strongly a single window pulls at the weights at each noise level (claim T5).

    Args:
      task: whose loss is asked, the sum that it is trained on.
      params: weights at which the gradient is taken.
      windows: held-out windows; 64 of them are taken, one gradient each.
      sigmas: noise levels, [N].
      seed: of the noise, the same at every level.

    Returns:
      Columns sigma, value (mean over windows of the gradient's Euclidean norm), low, high (95 %), repeats.

    Source: paper section 6 ("small-noise samples contribute little to the gradient").
    """
    batch = spread_windows(windows, 64)
    keys = jax.random.split(jax.random.key(seed), batch.future.shape[0])

    @jax.jit
    def norms(sigma):
        def of_one(given):
            window, key = given
            drawn = jax.tree.map(lambda leaf: leaf[None], window), sigma[None]
            return optax.global_norm(jax.grad(lambda weights: task.loss(weights, None, drawn, key)[0])(params))

        return jax.lax.map(of_one, (batch, keys))

    rows = [{"sigma": float(sigma), **mean_and_interval(np.asarray(norms(jnp.float32(sigma))))} for sigma in sigmas]
    return pd.DataFrame(rows)


def window_row(trained: TrainedModel, windows: WindowSet, *, steps=(8, 1), seed: int = 0) -> pd.DataFrame:
    """Measure what a model does with single held-out windows, and whether it uses its noise.

    Args:
      trained: the model.
      windows: held-out.
      steps: numbers of denoising steps.
      seed: of the noise.

    Returns:
      A row per number of steps: steps, then the figures of `noise_use` and `window_quality`.
    """
    rows = []
    for count in steps:
        generator = MotionGenerator(trained, count)
        figures = denoising.noise_use(generator, windows, seed=seed)
        rows.append({"steps": count, **figures, **denoising.window_quality(generator, windows, seed=seed)})
    return pd.DataFrame(rows)
