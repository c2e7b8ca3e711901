"""Speed as records: tidy tables of synthesis and training times, each with its run record."""

from __future__ import annotations

import dataclasses
import logging
import time
from collections.abc import Collection, Iterable
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
from flax import nnx
from tqdm import tqdm

from f3amd_companion.speed.implementations import Workload, jit_round
from f3amd_companion.speed.machine import describe_machine, device_name, matmul_precision, prepared_at_once
from f3amd_companion.speed.speed_tables import fastest_implementations
from f3amd_companion.speed.synthesis import CANDIDATE_COLUMNS, Candidate, check_suites, plan, time_group
from f3amd_companion.speed.timing import take_turns
from f3amd_lib.ground.names import check_known
from f3amd_lib.ground.profiles import Profile, results_dir
from f3amd_lib.ground.records import kept_rows, read_table, run_record, write_table
from f3amd_lib.networks import presets
from f3amd_lib.networks.conditioning import Context
from f3amd_lib.networks.f3amd import F3AMD
from f3amd_lib.networks.spectral import FNOBlock, FrameLayer
from f3amd_lib.rollout.rounds import sample_round
from f3amd_lib.training.denoising_task import DenoisingTask
from f3amd_lib.training.optimise import compile_steps, initial_state, planned_memory
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
_TRAINING = {"smoke": (4, 2, 8), "laptop": (200, 10, 64), "gpu": (200, 20, 512)}
"""Training steps to time, steps in one program, windows in a batch."""


def _record(prepared: PreparedData, profile: Profile, measurement: str, **extra) -> dict:
    """Return a record that tells the machine; another machine's rows do not belong in its table."""
    machine = describe_machine()
    lasting = ("processor", "cores", "system")
    return run_record(
        profile=profile, dataset=prepared.packed, seed=profile.seed, measurement=measurement,
        timed_on={name: machine[name] for name in lasting} | {"device": jax.devices()[0].device_kind},
        **extra,
    )  # fmt: skip


def _circumstances() -> dict:
    """Return what of the machine may change from one group of rows to the next."""
    machine = describe_machine()
    changing = {name: machine[name] for name in ("load", "clock_mhz")} | {"devices": jax.local_device_count()}
    return changing | {"xla_flags": machine["xla_flags"], "clocks": machine["graphics_clocks"]}


def measure_synthesis_time(
    prepared: PreparedData, profile: Profile, suites: Iterable[str] | None = None, *,
    characters: Collection[int] | None = None, again: bool = False, stop_at: float | None = None,
) -> Path | None:  # fmt: skip
    """Time rounds of the family in every implementation there is (see `speed.synthesis`).

    Args:
      prepared: its channels and styles are the networks'.
      profile: names the results' folder and, without `suites`, what is timed.
      suites: keys of `synthesis.SUITES`.
      characters: time groups of these numbers of characters only.
      again: time groups anew that an earlier run with the same settings has timed.
      stop_at: begin no group after this time (`time.monotonic`).

    Returns:
      The table `records/synthesis_time.csv`, the fastest implementation of each framework. Beside it
      lies `synthesis_ways.csv` with every one; it is written after every group, so that a stopped run
      goes on where it was. None where `stop_at` came first.

    Raises:
      ValueError: for an unknown suite.
    """
    suites = check_suites(suites or DEFAULT_SUITES[profile.name])
    folder = results_dir(profile.dataset, profile.name) / "records"
    turns = {"fewest_rounds": _FEWEST_ROUNDS, **_TURNS.get(profile.name, {})}
    path = folder / "synthesis_ways.csv"
    record = _record(prepared, profile, "synthesis_time", turns=turns)
    kept = kept_rows(path, record)
    failed = {} if kept is None else read_table(path)[1].get("not_possible", {})
    keys = ["suite", *CANDIDATE_COLUMNS]
    done = set() if again or kept is None else set(kept[keys].itertuples(index=False, name=None))

    def is_done(suite: str, candidate: Candidate) -> bool:
        return (suite, *dataclasses.astuple(candidate)) in done or (str(candidate) in failed and not again)

    todo = [
        (suite, candidates)
        for suite in suites
        for candidates in plan(suite).values()
        if characters is None or candidates[0].characters in characters
        if not all(is_done(suite, candidate) for candidate in candidates)
    ]
    with tqdm(todo, unit="group") as bar:
        for suite, candidates in bar:
            if stop_at is not None and time.monotonic() >= stop_at:
                return None
            bar.set_postfix_str("{}: {} frames, {} characters, {}".format(suite, *candidates[0].group))
            circumstances = _circumstances()
            rows, not_possible = time_group(
                candidates, lambda model, window: prepared.model_config(model, window=window), progress=True, **turns
            )
            for label, reason in not_possible.items():
                log.warning("not possible here: %s: %s", label, reason)
            failed |= not_possible
            if rows.empty:
                continue
            # New rows replace those of the same suite and candidates.
            kept = pd.concat([kept, rows.assign(suite=suite, **circumstances)]).drop_duplicates(keys, keep="last")
            record |= {"not_possible": failed}
            write_table(path, kept, record)
            write_table(folder / "synthesis_time.csv", fastest_implementations(kept), record)
    return folder / "synthesis_time.csv"


def measure_training_time(
    prepared: PreparedData, profile: Profile, models: Iterable[str] | None = None, *, precision: str = "float32",
    again: bool = False, stop_at: float | None = None,
) -> Path | None:  # fmt: skip
    """Time training steps by turns, all models in one run (Table 2).

    Args:
      prepared: the data; an epoch is once over its training windows.
      profile: names the results' folder; says how large a batch is and how many steps are timed.
      models: presets; by default the recommended ones, the baseline, and two other widths.
      precision: of matrix products, a key of `machine.PRECISIONS`.
      again: time them anew though an earlier run with the same settings has timed all of them.
      stop_at: do not begin after this time (`time.monotonic`).

    Returns:
      The table `records/training_time.csv`: value, low and high in seconds a step, epoch_minutes,
      and peak_memory_mib as the compiler plans it. None where `stop_at` came first.
    """
    names = [presets.find_preset(name).name for name in models or _TRAINED]
    steps, chunk, batch_size = _TRAINING[profile.name]
    path = results_dir(profile.dataset, profile.name) / "records" / "training_time.csv"
    record = _record(prepared, profile, "training_time", steps=steps, chunk=chunk)
    kept, keys = kept_rows(path, record), ["model", "window_frames", "device", "batch_size"]
    done = set() if again or kept is None else set(kept[keys].itertuples(index=False, name=None))
    if done.issuperset((name, prepared.window, device_name(), batch_size) for name in names):
        return path
    if stop_at is not None and time.monotonic() >= stop_at:
        return None
    recipe = partial(short_recipe, num_steps=steps, batch_size=batch_size, seed=profile.seed)
    tasks = {name: prepared.task(name, recipe(name)) for name in names}
    programs = prepared_at_once(lambda name: _compiled(tasks[name], chunk, precision), names)
    compiled = {name: program() for name, program in tqdm(programs.items(), unit="compiled")}
    calls = {name: _training_call(tasks[name], program) for name, (program, _) in compiled.items()}
    timings = take_turns(calls, min_rounds=-(-steps // chunk), min_seconds=float("inf"), warmup=2, progress=True)
    windows = prepared.windows("train").num_windows
    rows = [
        {
            "model": name,
            "window_frames": prepared.window,
            "device": device_name(),
            "batch_size": batch_size,
            "precision": precision,
            **timing.columns("s/step", 1.0 / chunk),
            "rounds": timing.rounds,
            "steps_timed": timing.rounds * chunk,
            "compile_seconds": round(compiled[name][1], 1),
            "epoch_windows": windows,
            "epoch_minutes": timing.median / chunk * windows / batch_size / 60.0,
            "peak_memory_mib": planned_memory(compiled[name][0]) / 2**20,
            **_circumstances(),
        }
        for name, timing in timings.items()
    ]
    # Rows of other windows and models stay.
    table = pd.concat([kept, pd.DataFrame(rows)]).drop_duplicates(keys, keep="last")
    return write_table(path, table, record)


def _compiled(task: DenoisingTask, chunk: int, precision: str):
    """Return (program of `chunk` steps, seconds that compiling took)."""
    started = time.perf_counter()
    with matmul_precision(precision):  # here: what a caller sets does not reach other threads
        return compile_steps(task, chunk), time.perf_counter() - started


def _training_call(task: DenoisingTask, program):
    """Return a function that trains on for the steps of a compiled program and waits."""
    state = initial_state(task)

    def call():
        nonlocal state
        state, _ = program(task, state)
        jax.block_until_ready(state)

    return call


# ------------------------------------------------------------------------------- where a round's time goes
#
# The round is timed again with one part left out at a time. Compilers mix parts, so that a stopwatch around each would
# disturb what it measures. What a round saves without a part is what the part costs, as far as costs add up.

PARTS = ("spectral branches", "local branches", "FiLM", "conditioning signal", "noise")
"""What can be left out of a round of an F3AMD network with Fourier blocks and FiLM."""


class _OneBranch(FrameLayer):
    """An `FNOBlock` that has lost one of its branches."""

    def __init__(self, block: FNOBlock, lost: str):
        self.spectral, self.lost = block.spectral, lost
        self.local_first, self.local_second = block.local_first, block.local_second

    def frames_first(self, z):
        if self.lost == "local branches":
            return self.spectral.frames_first(z)
        return FNOBlock.local_frames_first(self, z)


class _NoFiLM(nnx.Module):
    def __call__(self, base, z, c):
        return base(z)


class _NoSignal(nnx.Module):
    """Gives the code of frames for c, and encodes a condition to nothing."""

    def __init__(self, encoder):
        self.window, self.width = encoder.window, encoder.width

    def encode(self, condition):
        return Context(condition.path, condition.path)

    def __call__(self, context, sigma):
        return jnp.ones((context.keys.shape[0], self.window, self.width), context.keys.dtype) * sigma


def without(network: F3AMD, part: str) -> F3AMD:
    """Return a copy of a network that lacks a part; its answers mean nothing.

    Args:
      network: of Fourier blocks with FiLM.
      part: of `PARTS`, but "noise", which is no part of a network.

    Raises:
      ValueError: for another network or part.
    """
    config = network.config
    if not isinstance(network, F3AMD) or config.base_block != "fno" or config.conditioning != "film":
        raise ValueError("parts are known of F3AMD networks of Fourier blocks with FiLM only")
    check_known(part, PARTS[:-1], "part")
    left = nnx.clone(network)
    if part == "FiLM":
        left.conditionings = nnx.List([_NoFiLM() for _ in left.conditionings])
    elif part == "conditioning signal":
        left.condition = _NoSignal(left.condition)
    else:
        left.blocks = nnx.List([_OneBranch(block, part) for block in left.blocks])
        if config.encoder_decoder == "fno":
            left.encoder = _OneBranch(left.encoder, part)
            left.decoder = _OneBranch(left.decoder, part)
    return left


def time_breakdown(workload: Workload, *, progress: bool = False, **turns) -> pd.DataFrame:
    """Time a round whole and without each of its parts, by turns.

    Args:
      workload: a model of Fourier blocks with FiLM, under jit on one device.
      progress: show a bar.
      **turns: settings of `take_turns`.

    Returns:
      A row each: model, steps, characters, device, without ("nothing" for the whole round), unit,
      value, low and high in ms, rounds, and saved: the share of the whole round's time.
    """
    network = presets.build_from_config(workload.config, jax.random.key(0))
    shape = workload.characters, workload.config.window, workload.config.channels
    given_noise = partial(sample_round, noise=jax.random.normal(jax.random.key(1), shape))
    ready = {"nothing": jit_round(workload, network)}
    ready |= {part: jit_round(workload, without(network, part)) for part in PARTS[:-1]}
    ready["noise"] = jit_round(workload, network, given_noise)
    calls = {part: done.call for part, done in ready.items()}
    timings = take_turns(calls, progress=progress, **turns)
    whole = timings["nothing"].median
    rows = [
        {
            "model": workload.model,
            "steps": workload.steps,
            "characters": workload.characters,
            "device": device_name(),
            "without": part,
            **timing.columns("ms", 1e3),
            "rounds": timing.rounds,
            "saved": np.nan if part == "nothing" else 1.0 - timing.median / whole,
        }
        for part, timing in timings.items()
    ]
    return pd.DataFrame(rows)


def measure_round_parts(prepared: PreparedData, profile: Profile, counts: Iterable[int] = (1, 32)) -> Path:
    """Time F3AMD-FNO-96 with 1 step whole and without each of its parts (see `time_breakdown`).

    Args:
      prepared: its channels and styles are the network's.
      profile: names the results' folder.
      counts: numbers of characters.

    Returns:
      The table `records/round_parts.csv`.
    """
    model, turns = "F3AMD-FNO-96", _TURNS.get(profile.name, {})
    workloads = [Workload(model, prepared.model_config(model), 1, characters) for characters in counts]
    table = pd.concat(time_breakdown(workload, progress=True, **turns) for workload in workloads)
    path = results_dir(profile.dataset, profile.name) / "records" / "round_parts.csv"
    return write_table(path, table, _record(prepared, profile, "round_parts", **_circumstances()))
