"""Speed as records: tidy tables of synthesis and training times, each with its run record.

Synthesis (Tables 1, 4, 7 and the times of Table 11; Figures 3 and 4): what belongs together is timed alternately in
one process, all models, steps and implementations of one window length and one number of characters, and beside them
the machine's own matrix product, so that every row can say which share of the machine's arithmetic it used.
"""

import dataclasses
import itertools
import time
from collections.abc import Collection, Iterable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from unittest import mock

import jax
import jax.numpy as jnp
import pandas as pd
from tqdm import tqdm

from f3amd_companion.measuring.runner import Records, record_of, records_folder
from f3amd_companion.speed import implementations
from f3amd_companion.speed.implementations import Workload, jit_round
from f3amd_companion.speed.machine import describe_machine, device_name, matmul_precision, prepared_at_once
from f3amd_companion.speed.timing import Timing, take_turns
from f3amd_lib.ground import log
from f3amd_lib.ground.files import read_toml
from f3amd_lib.ground.names import check_known, row_label
from f3amd_lib.ground.profiles import Profile
from f3amd_lib.ground.records import read_table, write_table
from f3amd_lib.networks import presets
from f3amd_lib.networks.conditioning import ConditionEncoder, FiLM
from f3amd_lib.networks.counting import count_flops
from f3amd_lib.networks.spectral import FNOBlock
from f3amd_lib.rollout.rounds import sample_round
from f3amd_lib.training.denoising_task import DenoisingTask
from f3amd_lib.training.optimise import advance, initial_state
from f3amd_lib.training.pipeline import PreparedData
from f3amd_lib.training.recipe import short_recipe

SUITES: dict[str, list[dict]] = read_toml(Path(__file__).with_name("suites.toml"))
"""What each suite times."""

DEFAULT_SUITES = {"smoke": ["smoke"], "laptop": ["main", "family", "windows", "curve"], "gpu": ["gpu"]}
"""What a profile times."""

# The slowest rounds take half a minute each: three of them are enough.
_TURNS = {"smoke": {"min_rounds": 10, "min_seconds": 1.0}}
"""Settings of `take_turns` by profile; elsewhere its own: 100 rounds or 10 s."""

_TRAINED = ("F3AMD-FNO-96", "F3AMD-Transformer-64", "CAMDM", "F3AMD-FNO-32", "F3AMD-FNO-128")
_TRAINING = {"smoke": (4, 2, 8), "laptop": (200, 10, 64), "gpu": (200, 20, 512)}
"""Training steps to time, steps in one program, windows in a batch."""


def timed_record(prepared: PreparedData, profile: Profile, measurement: str, **extra) -> dict:
    """Return a record that tells the machine; another machine's rows do not belong in its table."""
    machine = describe_machine()
    lasting = {name: machine[name] for name in ("processor", "cores", "system")}
    timed_on = lasting | {"device": jax.devices()[0].device_kind}
    return record_of(profile, prepared.packed, measurement, timed_on=timed_on, **extra)


def _circumstances() -> dict:
    """Return what of the machine may change from one group of rows to the next."""
    machine = describe_machine()
    return {"load": machine["load"], "devices": jax.local_device_count(), "xla_flags": machine["xla_flags"]}


# ------------------------------------------------------------------------------------------------- synthesis


@dataclass(frozen=True)
class Candidate:
    """A row of the table before it is timed, by its columns: a model, how it is used, and in which implementation."""

    model: str
    steps: int
    characters: int
    way: str
    window_frames: int = 32
    precision: str = "float32"

    def __str__(self) -> str:
        characters = f"{self.characters} character{'s' if self.characters > 1 else ''}, {self.window_frames} frames"
        return f"{row_label(self.model, self.steps)}, {characters}, {self.way}, {self.precision}"

    @property
    def group(self) -> tuple[int, int, str]:
        """What candidates that are timed alternately share."""
        return self.window_frames, self.characters, self.precision


def plan(suite: str) -> dict[tuple, list[Candidate]]:
    """Return what a suite of `SUITES` times, by group, each candidate once; ValueError for an unknown one."""
    check_known(suite, SUITES, "suite")
    groups: dict[tuple, dict[Candidate, None]] = {}
    for block in SUITES[suite]:
        unusual = {key: block[key] for key in ("window_frames", "precision") if key in block}
        for implementation, counts in block["characters"].items():
            for characters, model, steps in itertools.product(counts, block["models"], block["steps"]):
                candidate = Candidate(model, steps, characters, implementation, **unusual)
                groups.setdefault(candidate.group, {})[candidate] = None
    return {group: list(candidates) for group, candidates in groups.items()}


def time_group(
    candidates: list[Candidate], build_config, *, progress: bool = False, **turns
) -> tuple[pd.DataFrame, dict[str, str]]:
    """Time the candidates of one group alternately, with the matrix products of their frameworks.

    Args:
      candidates: of one group.
      build_config: (model, window) -> `NetworkConfig`.
      progress: show bars.
      **turns: settings of `timing.take_turns`.

    Returns:
      (a row a candidate that worked: what it is, value, low and high in ms a round, rounds,
      compile_seconds, flops of a round, gflops reached, peak_gflops of the
      framework's own matrix product in the same turns, and their quotient share_of_peak;
      candidate in words -> why it did not work).
    """
    ((window, characters, precision),) = {candidate.group for candidate in candidates}

    def prepare(candidate: Candidate) -> tuple[Workload, implementations.Round]:
        config = build_config(candidate.model, window)
        workload = Workload(candidate.model, config, candidate.steps, characters, precision)
        return workload, implementations.prepare_round(candidate.way, workload)

    # PyTorch's compiler is not made for threads.
    prepared = prepared_at_once(prepare, [one for one in candidates if one.way.startswith("jit")])
    ready, failed = {}, {}
    with tqdm(candidates, unit="compiled", disable=not progress) as bar:
        for candidate in bar:
            bar.set_postfix_str(str(candidate))
            try:
                ready[candidate] = prepared[candidate]() if candidate in prepared else prepare(candidate)
            except implementations.NotPossible as reason:
                failed[str(candidate)] = str(reason)
    frameworks = {candidate: implementations.IMPLEMENTATIONS[candidate.way][0] for candidate in ready}
    yardsticks = {candidate: "torch" if framework == "torch" else "jax" for candidate, framework in frameworks.items()}
    probes = {name: implementations.framework_probe(name, precision) for name in dict.fromkeys(yardsticks.values())}
    calls = {candidate: done.call for candidate, (_, done) in ready.items()}
    timings = take_turns(calls | {name: call for name, (call, _) in probes.items()}, progress=progress, **turns)
    rows = []
    for candidate, (workload, done) in ready.items():
        timing, yardstick = timings[candidate], yardsticks[candidate]
        row = dataclasses.asdict(candidate) | {"sampler": workload.sampler, "framework": frameworks[candidate]}
        row |= {"device": device_name(), "compile_seconds": round(done.compile_seconds, 2)} | timing.columns("ms", 1e3)
        row |= _arithmetic(implementations.round_flops(workload), timing, probes[yardstick][1], timings[yardstick])
        rows.append(row)
    return pd.DataFrame(rows), failed


def _arithmetic(flops: int, timing: Timing, probe_flops: int, probe: Timing) -> dict:
    """Return what a row says of its arithmetic, beside that of a plain matrix product in the same turns."""
    reached, peak = flops / timing.median / 1e9, probe_flops / probe.median / 1e9
    return {"flops": flops, "gflops": reached, "peak_gflops": peak, "share_of_peak": reached / peak}


def measure_synthesis_time(
    prepared: PreparedData, profile: Profile, suites: Iterable[str] | None = None, *,
    characters: Collection[int] | None = None, again: bool = False, stop_at: float | None = None,
) -> Path | None:  # fmt: skip
    """Time rounds of the family in every implementation there is.

    Args:
      prepared: its channels and styles are the networks'.
      profile: names the results' folder and, without `suites`, what is timed.
      suites: keys of `SUITES`.
      characters: time groups of these numbers of characters only.
      again: time groups anew that an earlier run with the same settings has timed.
      stop_at: begin no group after this time (`time.monotonic`).

    Returns:
      The table `records/synthesis_time.csv`, the fastest implementation of each framework. Beside it
      lies `synthesis_ways.csv` with every one; it is written after every group, so that a stopped run
      goes on where it was. None where `stop_at` came first.

    Raises:
      ValueError: for an unknown suite, or a number of characters that none has.
    """
    suites = suites or DEFAULT_SUITES[profile.name]
    counts = {candidates[0].characters for suite in suites for candidates in plan(suite).values()}
    if never := {*(characters or counts)} - counts:
        raise ValueError(f"no group of {min(never)} characters in {', '.join(suites)}: there are {sorted(counts)}")
    turns = {"fewest_rounds": 3, **_TURNS.get(profile.name, {})}
    record = timed_record(prepared, profile, "synthesis_time", turns=turns)
    keys = ["suite", *(field.name for field in dataclasses.fields(Candidate))]
    summaries = {"synthesis_time": ("synthesis_ways", fastest_implementations)}
    records = Records(records_folder(profile), record, {"synthesis_ways": keys}, summaries=summaries)
    path, fastest = map(records.path, ("synthesis_ways", "synthesis_time"))
    failed = {} if records.tables["synthesis_ways"] is None else read_table(path)[1].get("not_possible", {})

    def is_done(suite: str, candidate: Candidate) -> bool:
        row = {"suite": suite} | dataclasses.asdict(candidate)
        return not again and (str(candidate) in failed or records.has("synthesis_ways", row))

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
            circumstances = {"suite": suite} | _circumstances()
            config = lambda model, window: prepared.model_config(model, window=window)
            rows, not_possible = time_group(candidates, config, progress=True, **turns)
            for label, reason in not_possible.items():
                log.warning("not possible here: %s: %s", label, reason)
            failed |= not_possible
            records.record["not_possible"] = failed
            if not rows.empty:
                records.put("synthesis_ways", circumstances, rows)
    return fastest


# -------------------------------------------------------------------------------------------------- training


def measure_training_time(
    prepared: PreparedData, profile: Profile, *, again: bool = False, stop_at: float | None = None
) -> Path | None:  # fmt: skip
    """Time training steps alternately: the recommended models, the baseline, and two other widths (Table 2).

    Args:
      prepared: the data; an epoch is once over its training windows.
      profile: names the results' folder; says how large a batch is and how many steps are timed.
      again: time them anew though an earlier run with the same settings has timed all of them.
      stop_at: do not begin after this time (`time.monotonic`).

    Returns:
      The table `records/training_time.csv`: value, low and high in seconds a step, its flops, gflops and share_of_peak
      as of `time_group`, epoch_minutes, and peak_memory_mib as the compiler plans it. None where `stop_at` came first.
    """
    steps, chunk, batch_size = _TRAINING[profile.name]
    record = timed_record(prepared, profile, "training_time", steps=steps, chunk=chunk)
    keys, again = ["model", "window_frames", "device", "batch_size"], _TRAINED if again else ()
    records = Records(records_folder(profile), record, {"training_time": keys}, again=again)
    named = [dict(zip(keys, (name, prepared.window, device_name(), batch_size), strict=True)) for name in _TRAINED]
    if all(records.has("training_time", row) for row in named):
        return records.path("training_time")
    if stop_at is not None and time.monotonic() >= stop_at:
        return None
    recipe = partial(short_recipe, num_steps=steps, batch_size=batch_size, seed=profile.seed)
    tasks = {name: prepared.task(name, recipe(name)) for name in _TRAINED}
    programs = prepared_at_once(lambda name: compiled_steps(tasks[name], chunk, "float32"), _TRAINED)
    compiled = {name: program() for name, program in tqdm(programs.items(), unit="compiled")}
    calls = {name: training_call(tasks[name], program) for name, (program, _) in compiled.items()}
    calls["probe"], probe_flops = implementations.framework_probe("jax", "float32")
    timings = take_turns(calls, min_rounds=-(-steps // chunk), min_seconds=float("inf"), warmup=2, progress=True)
    windows, circumstances, rows = prepared.windows("train").num_windows, _circumstances(), []
    probe = timings.pop("probe")
    for row, (name, timing) in zip(named, timings.items(), strict=True):
        flops = count_flops(partial(advance, length=chunk), tasks[name], jax.eval_shape(initial_state, tasks[name]))
        row |= {"precision": "float32"} | timing.columns("s/step", 1.0 / chunk)
        row |= _arithmetic(flops, timing, probe_flops, probe) | {"flops": flops // chunk}
        row |= {"steps_timed": timing.rounds * chunk, "compile_seconds": round(compiled[name][1], 1)}
        row |= {"epoch_windows": windows, "epoch_minutes": timing.median / chunk * windows / batch_size / 60.0}
        rows.append(row | {"peak_memory_mib": planned_memory(compiled[name][0]) / 2**20})
    records.put("training_time", circumstances, pd.DataFrame(rows))
    return records.path("training_time")


def compiled_steps(task: DenoisingTask, chunk: int, precision: str):
    """Return (program of `chunk` steps, seconds that compiling took)."""
    started = time.perf_counter()
    with matmul_precision(precision):  # here: what a caller sets does not reach other threads
        program = advance.lower(task, jax.eval_shape(initial_state, task), chunk).compile()
        return program, time.perf_counter() - started


def planned_memory(compiled) -> int:
    """Return the bytes that the compiler plans for a program: what goes in, what comes out, values between."""
    plan = compiled.memory_analysis()
    shared = plan.alias_size_in_bytes  # what goes in and comes out in the same place
    return int(plan.argument_size_in_bytes + plan.output_size_in_bytes + plan.temp_size_in_bytes - shared)


def training_call(task: DenoisingTask, program):
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


def _no_signal(encoder, context, sigma):
    """Stand for c; what encoded the condition is then asked by nobody, and not compiled."""
    return jnp.ones((len(context.keys), encoder.window, encoder.width), context.keys.dtype) * sigma


PARTS = {
    "spectral branches": (FNOBlock, "frames_first", FNOBlock.local_frames_first),
    "local branches": (FNOBlock, "frames_first", lambda block, z: block.spectral.frames_first(z)),
    "FiLM": (FiLM, "__call__", lambda film, base, z, c: base(z)),
    "conditioning signal": (ConditionEncoder, "__call__", _no_signal),
}
"""What can be left out of an F3AMD network of Fourier blocks with FiLM -> method, and what stands for it meanwhile."""


def time_breakdown(workload: Workload, **turns) -> pd.DataFrame:
    """Time a round whole, without each of `PARTS`, and without drawing noise, alternately.

    Args:
      workload: a model of Fourier blocks with FiLM, under jit on one device.
      **turns: settings of `take_turns`.

    Returns:
      A row each: model, steps, characters, device, without ("nothing" for the whole round), unit,
      value, low and high in ms, rounds, and saved: the share of the whole round's time.
    """
    network = presets.build_from_config(workload.config, jax.random.key(0))
    shape = workload.characters, workload.config.window, workload.config.channels
    given_noise = partial(sample_round, noise=jax.random.normal(jax.random.key(1), shape))
    ready = {"nothing": jit_round(workload, network)}
    for part, replaced in PARTS.items():
        with mock.patch.object(*replaced):  # while it is compiled
            ready[part] = jit_round(workload, network)
    ready["noise"] = jit_round(workload, network, given_noise)
    timings = take_turns({part: done.call for part, done in ready.items()}, **turns)
    named = {key: getattr(workload, key) for key in ("model", "steps", "characters")} | {"device": device_name()}
    table = pd.DataFrame([named | {"without": part} | timing.columns("ms", 1e3) for part, timing in timings.items()])
    return table.assign(saved=(1.0 - table["value"] / table["value"][0]).mask(table["without"] == "nothing"))


def measure_round_parts(prepared: PreparedData, profile: Profile) -> Path:
    """Time F3AMD-FNO-96 with 1 step, of 1 and 32 characters, whole and without each of its parts.

    Args:
      prepared: its channels and styles are the network's.
      profile: names the results' folder.

    Returns:
      The table `records/round_parts.csv` (see `time_breakdown`).
    """
    config, turns = prepared.model_config("F3AMD-FNO-96"), {"progress": True, **_TURNS.get(profile.name, {})}
    tables = [time_breakdown(Workload("F3AMD-FNO-96", config, 1, characters), **turns) for characters in (1, 32)]
    record = timed_record(prepared, profile, "round_parts", **_circumstances())
    return write_table(records_folder(profile) / "round_parts.csv", pd.concat(tables), record)


def fastest_implementations(table: pd.DataFrame) -> pd.DataFrame:
    """Keep the fastest implementation of each framework, for tables that have one number a cell.

    Rows are those in float32 on a CPU, and on a GPU in tf32, which JAX takes by itself. The FFT form
    is left out: it is there to be compared with, not to be used.

    Args:
      table: `synthesis_ways`. What several suites have timed counts as it is in the first of them,
        "main" before the others and "bars" last, so that neighbours in a table come from the same
        turns where that can be.

    Returns:
      The rows, one for each model, window, steps, framework, device and number of characters.
    """
    wanted = table["device"].map({"GPU": "tf32"}).fillna("float32")
    kept = table[(table["precision"] == wanted) & (table["way"] != "jit, FFT")]
    kept = kept.assign(turn=kept["suite"].map({"main": 0, "bars": 2}).fillna(1)).sort_values(["turn", "value"])
    keys = ["model", "window_frames", "steps", "characters", "framework", "device"]
    fastest = kept.drop_duplicates(keys).astype({"model": pd.CategoricalDtype(table["model"].unique())})
    fastest = fastest.sort_values(keys, ascending=[key != "steps" for key in keys]).drop(columns="turn")
    return fastest.astype({"model": table["model"].dtype}).reset_index(drop=True)
