"""The family on one data set, one preset after the other: trained within a time budget, or only
asked, in short runs all alike, whether each of them learns.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Iterator, Mapping

import numpy as np
import pandas as pd
from jax.sharding import Mesh
from scipy import stats

from f3amd_lib.ground.profiles import Profile
from f3amd_lib.training.checkpoints import TrainedModel
from f3amd_lib.training.optimise import held_out_terms, initial_state, optimise, restore_state
from f3amd_lib.training.pipeline import (
    ModelFiles,
    PreparedData,
    as_trained,
    finished_model,
    model_files,
    set_aside_run,
    train,
    train_in_legs,
)
from f3amd_lib.training.recipe import TrainingConfig, short_recipe

SHORT_RUN = {"num_steps": 200, "batch_size": 32, "learning_rate": 1e-3}
"""What all runs have in common; enough to see a loss fall, far from enough to walk."""


def train_family(
    prepared: PreparedData, profile: Profile, presets: Iterable[str], *, folder=None, budget_s: float | None = None,
    mesh: Mesh | None = None, progress: bool = True,
) -> Iterator[tuple[str, str]]:  # fmt: skip
    """Train presets one after the other, all with the profile's steps and batch.

    Each leaves its model, state and history in one folder, and a later call goes on from them: a
    finished model is left as it is, an unfinished one resumed. So a long job can be done in legs.

    Args:
      prepared: the data.
      profile: how much.
      presets: names, in the order to train them.
      folder: where files go instead of `runs/`.
      budget_s: seconds for all together; the run under way stops with a checkpoint when they are
        over. By default as long as it takes.
      mesh: see `pipeline.train`.
      progress: show progress bars.

    Yields:
      (preset, state) as each is done with; the state is "finished before", "finished" or
      "unfinished", and the budget is over with the first "unfinished".

    Raises:
      ValueError: for an unknown preset, before anything is trained.
      TrainingDiverged: if a loss stops being a number.
    """
    stop_at = None if budget_s is None else time.monotonic() + budget_s
    files = {preset: model_files(profile, preset, folder=folder) for preset in presets}
    for preset, its in files.items():
        if finished_model(prepared, profile, preset, its) is not None:
            yield preset, "finished before"
            continue
        if stop_at is not None and time.monotonic() >= stop_at:
            yield preset, "unfinished"
            return
        how = {"folder": folder, "mesh": mesh, "stop_at": stop_at, "progress": progress}
        trained, _ = train(prepared, profile, preset=preset, **how)
        yield preset, "unfinished" if trained is None else "finished"
        if trained is None:
            return


def snapshot(
    prepared: PreparedData, preset: str, recipe: TrainingConfig, steps: int, record: dict, *, folder,
    network: Mapping | None = None, every: int = 400, stop_at: float | None = None, progress: bool = True,
) -> tuple[TrainedModel | None, float]:  # fmt: skip
    """Train up to a step, going on from an earlier snapshot of the folder.

    Args:
      prepared, preset, recipe: the data, the model, and how a whole run is trained.
      steps: at most those of the recipe.
      record: from `run_record`; what the model is told of its training.
      folder: where the training state and the history of the losses are kept; a state that is further than `steps` is
        kept under another name.
      network: fields of the preset's network to change.
      every: steps between checkpoints and held-out losses.
      stop_at: see `optimise`.
      progress: show a progress bar.

    Returns:
      (model with the moving average of the weights, held-out loss); the model is None where `stop_at` came first.

    Raises:
      ValueError: if the state that lies there is of other settings.
    """
    task, files = prepared.task(preset, recipe, network=network), ModelFiles.of(folder, preset)
    held_out = prepared.windows(prepared.held_out_split)
    record = {**record, "training": recipe.to_dict()}
    if files.state.exists() and int(restore_state(files.state, task).step) > steps:
        set_aside_run(files)
    leg = {"every": min(steps, every), "stop_after": steps, "stop_at": stop_at, "progress": progress}
    state, _ = train_in_legs(task, files, record, held_out=held_out, **leg)
    if int(state.step) < steps:
        return None, math.nan
    loss = held_out_terms(task, state, held_out)["loss"]
    seen = {"windows_seen": steps * recipe.batch_size}
    return as_trained(prepared, task, preset, state.averaged, record | seen), loss


def learning_curve(
    prepared: PreparedData, preset: str, *, network: Mapping | None = None, seed: int = 0, **settings
) -> pd.DataFrame:
    """Train a preset for a short while and watch its loss.

    Args:
      prepared: the data.
      preset: see `presets.find_preset`.
      network: fields of the preset's network to change.
      seed: of weights and batches.
      **settings: fields of `TrainingConfig` in place of `SHORT_RUN`'s.

    Returns:
      Columns model, step, loss (mean over a tenth of the run) and held_out_loss (moving average of
      the weights on held-out windows, every row from step 0 on; before the first step no training
      loss is known, NaN).

    Raises:
      TrainingDiverged: if the loss stops being a number.
    """
    recipe = short_recipe(preset, seed=seed, **{**SHORT_RUN, **settings})
    task = prepared.task(preset, recipe, network=network)
    held_out = prepared.windows(prepared.held_out_split)
    chunk = max(1, recipe.num_steps // 10)
    state = initial_state(task)
    before = held_out_terms(task, state, held_out)["loss"]
    rows = [{"model": preset, "step": 0, "loss": float("nan"), "held_out_loss": before}]
    _, history = optimise(task, state, held_out=held_out, chunk=chunk, checkpoint_every=chunk, progress=False)
    rows += [{"model": preset, **{name: row[name] for name in ("step", "loss", "held_out_loss")}} for row in history]
    return pd.DataFrame(rows)


def power_law(windows, values, reach) -> pd.DataFrame:
    """Fit c windows^exponent through a learning curve, and follow it.

    Args:
      windows, values: positive, at least 3 points [N].
      reach: numbers of windows to follow it to, [M].

    Returns:
      A row for each of `reach`: windows, value, low and high: the 95 % interval of the fitted line, which knows of
      scatter about a power law and not of a curve that is none; and exponent, the same in all rows.

    Raises:
      ValueError: for fewer points, or what has no logarithm.
    """
    windows, values, reach = (np.asarray(each, float) for each in (windows, values, reach))
    if len(windows) < 3 or windows.shape != values.shape:
        raise ValueError(f"a power law needs 3 points of windows and values, got {windows.shape} and {values.shape}")
    if not all((np.isfinite(each) & (each > 0)).all() for each in (windows, values, reach)):
        raise ValueError("a power law needs positive, finite windows and values")
    x, y, ahead = np.log(windows), np.log(values), np.log(reach)
    fit = stats.linregress(x, y)
    line, spare = fit.slope * ahead + fit.intercept, len(x) - 2
    scatter = np.sqrt(np.sum((y - fit.slope * x - fit.intercept) ** 2) / spare)
    leverage = 1 / len(x) + (ahead - x.mean()) ** 2 / np.sum((x - x.mean()) ** 2)
    half = stats.t.ppf(0.975, spare) * scatter * np.sqrt(leverage)
    rows = {"windows": reach, "value": np.exp(line), "low": np.exp(line - half), "high": np.exp(line + half)}
    return pd.DataFrame(rows | {"exponent": fit.slope})


def learning_table(curves: pd.DataFrame) -> pd.DataFrame:
    """Sum up learning curves, one row a model.

    Args:
      curves: from `learning_curve`, of one or many models.

    Returns:
      Columns model, steps, first_loss and last_loss (mean training loss of the first and the last
      tenth of the run), held_out_before, held_out_after, and falls: whether both fell.
    """
    # "first" and "last" leave out what is not known: no training loss is before the first step.
    table = curves.sort_values("step", kind="stable").groupby("model", sort=False).agg(
        steps=("step", "last"), first_loss=("loss", "first"), last_loss=("loss", "last"),
        held_out_before=("held_out_loss", "first"), held_out_after=("held_out_loss", "last"),
    ).reset_index()  # fmt: skip
    falls = (table["last_loss"] < table["first_loss"]) & (table["held_out_after"] < table["held_out_before"])
    return table.assign(falls=falls)
