"""Speed as records: tidy tables of synthesis and training times, each with its run record."""

from __future__ import annotations

import logging
from collections.abc import Iterable
from pathlib import Path

import jax
import pandas as pd
from tqdm import tqdm

from f3amd_lib.benchmarking.machine import describe_machine, device_name
from f3amd_lib.benchmarking.parts import time_parts
from f3amd_lib.benchmarking.speed_tables import fastest_ways
from f3amd_lib.benchmarking.synthesis import Candidate, plan, time_group
from f3amd_lib.benchmarking.timing import take_turns
from f3amd_lib.benchmarking.ways import Task
from f3amd_lib.ground.profiles import Profile, results_dir
from f3amd_lib.ground.records import kept_rows, read_table, run_record, write_table
from f3amd_lib.networks import zoo
from f3amd_lib.training.denoising_task import DenoisingTask
from f3amd_lib.training.optimise import advance, initial_state, plan_memory
from f3amd_lib.training.pipeline import PreparedData
from f3amd_lib.training.recipe import short_recipe

log = logging.getLogger("f3amd")

DEFAULT_SUITES = {"smoke": ["smoke"], "laptop": ["main", "family", "windows", "curve"], "gpu": ["gpu"]}
"""What a profile times."""

_TURNS = {"smoke": {"min_rounds": 10, "min_seconds": 1.0, "fewest_rounds": 3}}
"""Settings of `take_turns` by profile; elsewhere its own: 100 rounds or 10 s."""

_FEWEST_ROUNDS = 3
"""For the slowest rounds, half a minute each."""

_TRAINED = ("F3AMD-FNO-96", "F3AMD-Transformer-64", "CAMDM", "F3AMD-FNO-32", "F3AMD-FNO-128")
_CANDIDATE = {
    "model": "model", "steps": "steps", "way": "way", "window_frames": "window",
    "characters": "characters", "precision": "precision",
}  # fmt: skip
"""Columns of a row -> attributes of the `Candidate` that it is about."""

_BATCH = {"smoke": 8, "laptop": 64, "gpu": 512}
_TRAINING_STEPS = {"smoke": (4, 2), "laptop": (200, 10), "gpu": (200, 20)}
"""Steps to time, and steps in one program."""


def _record(prepared: PreparedData, profile: Profile, measurement: str, **extra) -> dict:
    """Return a record that tells the machine; another machine's rows do not belong in its table."""
    told = describe_machine()
    lasting = ("processor", "cores", "system")
    return run_record(
        profile=profile, dataset=prepared.packed, seed=profile.seed, measurement=measurement,
        timed_on={name: told[name] for name in lasting} | {"device": jax.devices()[0].device_kind},
        **extra,
    )  # fmt: skip


def _circumstances() -> dict:
    """Return what of the machine may change from one group of rows to the next."""
    told = describe_machine()
    return {
        "load": told["load"],
        "clock_mhz": told["clock_mhz"],
        "devices": jax.local_device_count(),
        "xla_flags": told["xla_flags"],
        "clocks": told["graphics_clocks"],
    }


def measure_synthesis_time(
    prepared: PreparedData,
    profile: Profile,
    suites: Iterable[str] | None = None,
    *,
    characters: Iterable[int] | None = None,
    again: bool = False,
) -> Path:
    """Time rounds of the family in every way there is (see `benchmarking.synthesis`).

    Args:
      prepared: its channels and styles are the networks'.
      profile: names the results' folder and, without `suites`, what is timed.
      suites: keys of `synthesis.SUITES`.
      characters: time groups of these numbers of characters only.
      again: time groups anew that an earlier run with the same settings has timed.

    Returns:
      The table `records/synthesis_time.csv`, the fastest way of each framework. Beside it lies
      `synthesis_ways.csv` with every way; it is written after every group, so that a stopped run
      goes on where it was.

    Raises:
      ValueError: for an unknown suite.
    """
    suites = list(suites) if suites else DEFAULT_SUITES[profile.name]
    wanted = None if characters is None else set(characters)
    todo = [
        (suite, *group)
        for suite in suites
        for group in plan(suite).items()
        if wanted is None or group[1][0].characters in wanted
    ]
    folder = results_dir(profile.dataset, profile.name) / "records"
    turns = {"fewest_rounds": _FEWEST_ROUNDS, **_TURNS.get(profile.name, {})}
    path = folder / "synthesis_ways.csv"
    record = _record(prepared, profile, "synthesis_time", turns=turns)
    kept = kept_rows(path, record)
    failed = {} if kept is None else read_table(path)[1].get("not_possible", {})

    def is_known(suite: str, candidate: Candidate) -> bool:
        if again or kept is None:
            return False
        told = [suite, *(getattr(candidate, name) for name in _CANDIDATE.values())]
        here = (kept[["suite", *_CANDIDATE]] == told).all(axis=1)
        return str(candidate) in failed or bool(here.any())

    with tqdm(todo, unit="group") as bar:
        for suite, group, candidates in bar:
            bar.set_postfix_str("{}: {} frames, {} characters, {}".format(suite, *group))
            if all(is_known(suite, candidate) for candidate in candidates):
                continue
            circumstances = _circumstances()
            rows, not_possible = time_group(
                candidates, lambda model, window: prepared.model_config(model, window=window), progress=True, **turns
            )
            for label, reason in not_possible.items():
                log.warning("not possible here: %s: %s", label, reason)
            failed |= not_possible
            if rows.empty:
                continue
            rows = rows.assign(suite=suite, **circumstances)
            # New rows replace those of the same suite and candidates.
            kept = rows if kept is None else pd.concat([kept, rows])
            kept = kept.drop_duplicates(["suite", *_CANDIDATE], keep="last")
            record |= {"not_possible": failed}
            write_table(path, kept, record)
            write_table(folder / "synthesis_time.csv", fastest_ways(kept), record)
    return folder / "synthesis_time.csv"


def measure_round_parts(prepared: PreparedData, profile: Profile, counts: Iterable[int] = (1, 32)) -> Path:
    """Time F3AMD-FNO-96 with 1 step whole and without each of its parts (see `parts`).

    Args:
      prepared: its channels and styles are the network's.
      profile: names the results' folder.
      counts: numbers of characters.

    Returns:
      The table `records/round_parts.csv`.
    """
    model, turns = "F3AMD-FNO-96", _TURNS.get(profile.name, {})
    config = prepared.model_config(model)
    rows = [time_parts(Task(model, config, 1, characters), progress=True, **turns) for characters in counts]
    path = results_dir(profile.dataset, profile.name) / "records" / "round_parts.csv"
    record = _record(prepared, profile, "round_parts", **_circumstances())
    write_table(path, pd.concat(rows), record)
    return path


def measure_training_time(prepared: PreparedData, profile: Profile, models: Iterable[str] | None = None) -> Path:
    """Time training steps by turns, all models in one run (Table 2).

    Args:
      prepared: the data; an epoch is once over its training windows.
      profile: names the results' folder; says how large a batch is and how many steps are timed.
      models: presets; by default the recommended ones, the baseline, and two other widths.

    Returns:
      The table `records/training_time.csv`: value, low and high in seconds a step, epoch_minutes,
      and peak_memory_mib as the compiler plans it.
    """
    names = [zoo.find_preset(name).name for name in models or _TRAINED]
    steps, chunk = _TRAINING_STEPS[profile.name]
    batch_size = _BATCH[profile.name]
    calls, memory = {}, {}
    for name in tqdm(names, unit="compiled"):
        recipe = short_recipe(name, num_steps=steps, batch_size=batch_size, seed=profile.seed)
        task = prepared.task(name, recipe)
        memory[name] = plan_memory(task, chunk)
        calls[name] = _training_call(task, chunk)
    timings = take_turns(calls, min_rounds=-(-steps // chunk), min_seconds=float("inf"), warmup=2, progress=True)
    windows = prepared.windows("train").num_windows
    rows = [
        {
            "model": name,
            "window_frames": prepared.window,
            "device": device_name(),
            "batch_size": batch_size,
            "unit": "s/step",
            "value": timing.median / chunk,
            "low": timing.low / chunk,
            "high": timing.high / chunk,
            "steps_timed": timing.rounds * chunk,
            "compile_seconds": round(timing.first, 1),
            "epoch_windows": windows,
            "epoch_minutes": timing.median / chunk * windows / batch_size / 60.0,
            "peak_memory_mib": memory[name] / 2**20,
        }
        for name, timing in timings.items()
    ]
    path = results_dir(profile.dataset, profile.name) / "records" / "training_time.csv"
    record = _record(prepared, profile, "training_time", steps=steps, chunk=chunk, **_circumstances())
    write_table(path, pd.DataFrame(rows), record)
    return path


def _training_call(task: DenoisingTask, chunk: int):
    """Return a function that trains on for `chunk` steps and waits."""
    state = initial_state(task)

    def call():
        nonlocal state
        state, _ = advance(task, state, chunk)
        jax.block_until_ready(state)

    return call
