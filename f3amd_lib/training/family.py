"""Does every preset learn? Short runs of the whole family on one data set, all alike."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import pandas as pd
from tqdm import tqdm

from f3amd_lib.training.loop import short_recipe
from f3amd_lib.training.pipeline import PreparedData

__all__ = ["SHORT_RUN", "learning_curve", "learning_curves", "learning_table"]

SHORT_RUN = {"num_steps": 200, "batch_size": 32, "learning_rate": 1e-3}
"""What all runs have in common; enough to see a loss fall, far from enough to walk."""


def learning_curve(
    prepared: PreparedData, preset: str, *, seed: int = 0, progress: bool = False, **settings
) -> pd.DataFrame:
    """Train a preset for a short while and watch its loss.

    Args:
      prepared: the data.
      preset: see `zoo.find_preset`.
      seed: of weights and batches.
      progress: show a bar of the steps.
      **settings: fields of `TrainingConfig` in place of `SHORT_RUN`'s.

    Returns:
      Columns model, step, loss (mean over a tenth of the run) and held_out_loss (moving average of
      the weights on held-out windows, every row from step 0 on; before the first step no training
      loss is known, NaN).

    Raises:
      TrainingDiverged: if the loss stops being a number.
    """
    recipe = short_recipe(preset, seed=seed, **{**SHORT_RUN, **settings})
    trainer = prepared.trainer(preset, recipe)
    held_out = prepared.windows(prepared.held_out_split)
    chunk = max(1, recipe.num_steps // 10)
    state = trainer.initial_state()
    before = trainer.held_out_terms(state.params, held_out)["loss"]
    rows = [{"model": preset, "step": 0, "loss": float("nan"), "held_out_loss": before}]
    _, history = trainer.run(
        state, held_out=held_out, chunk=chunk, checkpoint_every=chunk, progress=progress
    )
    rows += [
        {"model": preset, **{name: row[name] for name in ("step", "loss", "held_out_loss")}}
        for row in history
    ]
    return pd.DataFrame(rows)


def learning_curves(
    prepared: PreparedData, presets: Iterable[str], *, seed: int = 0, progress: bool = True
) -> Iterator[pd.DataFrame]:
    """Yield the learning curve of one preset after the other, so that each can be kept at once."""
    presets = list(presets)
    with tqdm(presets, unit="model", disable=not progress) as bar:
        for preset in bar:
            bar.set_postfix_str(preset)
            yield learning_curve(prepared, preset, seed=seed)


def learning_table(curves: pd.DataFrame) -> pd.DataFrame:
    """Sum up learning curves, one row a model.

    Args:
      curves: from `learning_curve`, of one or many models.

    Returns:
      Columns model, steps, first_loss and last_loss (mean training loss of the first and the last
      tenth of the run), held_out_before, held_out_after, and falls: whether both fell.
    """
    rows = []
    for model, curve in curves.groupby("model", sort=False):
        curve = curve.sort_values("step")
        losses, held_out = curve["loss"].dropna(), curve["held_out_loss"]
        row = {
            "model": model,
            "steps": int(curve["step"].iloc[-1]),
            "first_loss": losses.iloc[0],
            "last_loss": losses.iloc[-1],
            "held_out_before": held_out.iloc[0],
            "held_out_after": held_out.iloc[-1],
        }
        fell = row["last_loss"] < row["first_loss"]
        rows.append({**row, "falls": bool(fell and row["held_out_after"] < held_out.iloc[0])})
    return pd.DataFrame(rows)
