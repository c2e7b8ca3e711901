"""Train shipped weights further on clips at several speeds, as the shipped `F3AMD-FNO-96-steady` was.

    python scripts/train_further.py --steps 3125 --rate 1e-3 --speeds 0.6 0.8 --out runs/further

In the data every style has a pace of its own, so that a network may guess the style from the path: told to be active
on a slow path, it walks as another style. Clips that are played slower take the hint away.

A leg of its own: it starts from the moving average that ships, Adam begins anew, and the rate rises over 100 steps and
falls by a cosine. The folder gets the model, its state (a killed run goes on) and the leg's history; `--ship` puts the
model, packed as shipped ones are, and the history of all legs where the shipped ones lie.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import tyro

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # this tree's library, whatever is installed

from f3amd_lib.data.windows import WindowSet, build_windows
from f3amd_lib.ground.profiles import PRETRAINED_DIR, load_profile
from f3amd_lib.ground.records import read_table, write_table
from f3amd_lib.ground.trees import weights_digest
from f3amd_lib.motion.skeleton import Motion, resample
from f3amd_lib.training.checkpoints import load_model, save_model
from f3amd_lib.training.optimise import initial_state, save_state
from f3amd_lib.training.pipeline import ModelFiles, model_files, prepare, train_and_keep
from f3amd_lib.training.recipe import short_recipe


@dataclass(frozen=True)
class AtSpeed:
    """A packed data set whose clips are played at another speed."""

    packed: Any
    speed: float

    def motion(self, clip: int) -> Motion:
        """Return a clip; below 1 it is longer."""
        motion = self.packed.motion(clip)
        return resample(motion.replace(fps=motion.fps * self.speed), motion.fps, smooth=True)

    def __getattr__(self, name: str):
        return getattr(self.packed, name)


def together(sets: list[WindowSet]) -> WindowSet:
    """Return the windows of several sets as one."""
    shift = np.cumsum([0] + [len(one.frames) for one in sets])
    sets = [replace(one, starts=one.starts + int(first)) for one, first in zip(sets, shift, strict=False)]
    axes = {"frames": 0, "paths": 1, "starts": 0, "room": 0, "styles": 0}
    return replace(sets[0], **{key: jnp.concatenate([getattr(one, key) for one in sets], axis=axis)
                               for key, axis in axes.items()})  # fmt: skip


def train_further(
    steps: int,
    rate: float,
    speeds: list[float],
    out: Path,
    preset: str = "F3AMD-FNO-96-steady",
    data: str = "bandai",
    ship: bool = False,
) -> None:
    """Train weights that ship for some more steps of 128 windows.

    Args:
      steps: of this leg.
      rate: its highest learning rate.
      speeds: at which clips are played, beside their own; every second window of these is taken.
      out: folder of this leg.
      preset: whose weights.
      data: the data set that they were trained on.
      ship: put the result where the shipped weights lie.
    """
    profile = load_profile("laptop", data)
    prepared, shipped = prepare(profile), model_files(profile, preset, folder=PRETRAINED_DIR / data)
    task = prepared.task(preset, short_recipe(preset, steps, learning_rate=rate, warmup_steps=100))
    size = {"window": prepared.window, "num_history": prepared.num_history}
    played = [build_windows(AtSpeed(prepared.packed, speed), "train", stride=2, **size) for speed in speeds]
    task = replace(task, windows=together([task.windows, *played]))
    files, before, (rows, _) = ModelFiles.of(out, preset), load_model(shipped.model), read_table(shipped.history)
    if not files.state.exists():
        out.mkdir(parents=True, exist_ok=True)
        first = initial_state(task)
        start = lambda: jax.tree.map(lambda mine, kept: jnp.asarray(kept, mine.dtype), first.params, before.params)
        save_state(files.state, task, first._replace(params=start(), ema=start()))
        write_table(files.history, rows.tail(1).assign(step=0), before.record)
    said = " and ".join(f"{speed:g}" for speed in speeds)
    legs = f"{before.windows_seen:,} windows by its recipe, the rest with clips at {said} times their speed, too"
    about = {"windows_seen": before.windows_seen + steps * task.config.batch_size, "schedule_note": legs}
    about |= {"started_from": weights_digest(before.params), "speeds": speeds}
    trained, history = train_and_keep(prepared, profile, preset, task, files, about)
    if ship and trained is not None:
        # A slower copy of a window is no other window.
        told = {**trained.record, "num_train_windows": before.record["num_train_windows"]}
        later = history[1:].assign(step=history["step"] + before.windows_seen // task.config.batch_size)
        write_table(shipped.history, pd.concat([rows, later]), told)
        save_model(shipped.model, replace(trained, record=told), jnp.int8)


if __name__ == "__main__":
    tyro.cli(train_further)
