"""Synthesis time of the family (Tables 1, 4, 7 and the times of Table 11; Figures 3 and 4).

What belongs together is timed by turns in one process: all models, steps and implementations of one
window length and one number of characters, and beside them the machine's own matrix product, so that
every row can say which share of the machine's arithmetic it used.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import pandas as pd
from tqdm import tqdm

from f3amd_companion.speed import implementations
from f3amd_companion.speed.machine import device_name, prepared_at_once
from f3amd_companion.speed.timing import take_turns
from f3amd_lib.ground.files import read_toml
from f3amd_lib.ground.names import check_known, row_label


@dataclass(frozen=True)
class Candidate:
    """A row of the table before it is timed: a model, how it is used, and in which implementation."""

    model: str
    steps: int
    characters: int
    implementation: str
    window: int = 32
    precision: str = "float32"

    def __str__(self) -> str:
        characters = f"{self.characters} character{'s' if self.characters > 1 else ''}, {self.window} frames"
        return f"{row_label(self.model, self.steps)}, {characters}, {self.implementation}, {self.precision}"

    @property
    def group(self) -> tuple[int, int, str]:
        """What a candidate shares with those that it is timed by turns with."""
        return self.window, self.characters, self.precision


CANDIDATE_COLUMNS = ["model", "steps", "characters", "way", "window_frames", "precision"]
"""Columns of a table that name the candidate of a row, in the order of its fields."""


SUITES: dict[str, list[dict]] = read_toml(Path(__file__).with_name("suites.toml"))
"""What each suite times."""


def check_suites(names: Iterable[str]) -> list[str]:
    """Return the names as a list; ValueError for an unknown one."""
    names = list(names)
    for name in names:
        check_known(name, SUITES, "suite")
    return names


def plan(suite: str) -> dict[tuple, list[Candidate]]:
    """Return what a suite times, by group, each candidate once; ValueError for an unknown suite."""
    check_suites([suite])
    groups: dict[tuple, dict[Candidate, None]] = {}
    for block in SUITES[suite]:
        unusual = {key: block[key] for key in ("window", "precision") if key in block}
        for implementation, counts in block["characters"].items():
            for characters, model, steps in itertools.product(counts, block["models"], block["steps"]):
                candidate = Candidate(model, steps, characters, implementation, **unusual)
                groups.setdefault(candidate.group, {})[candidate] = None
    return {group: list(candidates) for group, candidates in groups.items()}


def time_group(
    candidates: list[Candidate], build_config, *, progress: bool = False, **turns
) -> tuple[pd.DataFrame, dict[str, str]]:
    """Time the candidates of one group by turns, with the matrix products of their frameworks.

    Args:
      candidates: of one group.
      build_config: (model, window) -> `NetworkConfig`.
      progress: show bars.
      **turns: settings of `timing.take_turns`.

    Returns:
      (a row a candidate that worked: what it is, value, low and high in ms a round, rounds,
      compile_seconds, flops and bytes_accessed of a round, gflops reached, peak_gflops of the
      framework's own matrix product in the same turns, and their quotient share_of_peak;
      candidate in words -> why it did not work).
    """
    ((window, characters, precision),) = {candidate.group for candidate in candidates}

    def prepare(candidate: Candidate) -> tuple[implementations.Workload, implementations.Round]:
        config = build_config(candidate.model, window)
        workload = implementations.Workload(candidate.model, config, candidate.steps, characters, precision)
        return workload, implementations.prepare_round(candidate.implementation, workload)

    # PyTorch's compiler is not made for threads.
    prepared = prepared_at_once(prepare, [one for one in candidates if one.implementation.startswith("jit")])
    ready, failed = {}, {}
    with tqdm(candidates, unit="compiled", disable=not progress) as bar:
        for candidate in bar:
            bar.set_postfix_str(str(candidate))
            try:
                ready[candidate] = prepared[candidate]() if candidate in prepared else prepare(candidate)
            except implementations.NotPossible as reason:
                failed[str(candidate)] = str(reason)
    if not ready:
        return pd.DataFrame(), failed
    frameworks = {candidate: implementations.IMPLEMENTATIONS[candidate.implementation][0] for candidate in ready}
    yardsticks = {candidate: "torch" if framework == "torch" else "jax" for candidate, framework in frameworks.items()}
    probes = {name: implementations.framework_probe(name, precision) for name in dict.fromkeys(yardsticks.values())}
    calls = {candidate: done.call for candidate, (_, done) in ready.items()}
    calls |= {name: multiply for name, (multiply, _) in probes.items()}
    timings = take_turns(calls, progress=progress, **turns)
    rows = []
    for candidate, (workload, done) in ready.items():
        timing, yardstick, flops = timings[candidate], yardsticks[candidate], implementations.round_flops(workload)
        reached = flops / timing.median / 1e9
        peak = probes[yardstick][1] / timings[yardstick].median / 1e9
        rows.append(
            {
                "model": candidate.model,
                "window_frames": window,
                "steps": candidate.steps,
                "sampler": workload.sampler,
                "framework": frameworks[candidate],
                "way": candidate.implementation,
                "device": device_name(),
                "precision": precision,
                "characters": characters,
                **timing.columns("ms", 1e3),
                "rounds": timing.rounds,
                "compile_seconds": round(done.compile_seconds, 2),
                "bytes_accessed": done.bytes_accessed,
                "flops": flops,
                "gflops": reached,
                "peak_gflops": peak,
                "share_of_peak": reached / peak,
            }
        )
    return pd.DataFrame(rows), failed
