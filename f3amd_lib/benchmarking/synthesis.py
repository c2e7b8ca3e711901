"""Synthesis time of the family (Tables 1, 4, 7 and the times of Table 11; Figures 3 and 4).

What belongs together is timed by turns in one process: all models, steps and ways of one window
length and one number of characters, and beside them the machine's own matrix product, so that every
row can say which share of the machine's arithmetic it used.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import pandas as pd
from tqdm import tqdm

from f3amd_lib.benchmarking.machine import device_name, matmul_probe
from f3amd_lib.benchmarking.timing import Timing, take_turns
from f3amd_lib.benchmarking.ways import WAYS, NotPossible, Task, framework_probe, prepare_round, round_flops


@dataclass(frozen=True)
class Candidate:
    """A row of the table before it is timed: a model, how it is used, and in which way."""

    model: str
    steps: int
    characters: int
    way: str
    window: int = 32
    precision: str = "float32"

    def __str__(self) -> str:
        steps = f"{self.steps} step{'s' if self.steps > 1 else ''}"
        characters = f"{self.characters} character{'s' if self.characters > 1 else ''}"
        return f"{self.model}, {steps}, {characters}, {self.window} frames, {self.way}, {self.precision}"


_FEW = (1, 2, 4, 8, 16, 32)
_MANY = (64, 128, 256, 512, 1024)
_WIDTHS = (32, 48, 64, 96, 128)
_FAMILY = tuple(f"F3AMD-{kind}-{width}" for kind in ("FNO", "Transformer") for width in _WIDTHS)
_VARIANTS = (
    "F3AMD-FNO-96-concatenation", "F3AMD-FNO-96-AdaLN-zero", "F3AMD-FNO-96-cross-attention",
    "F3AMD-FNO-96-m14", "F3AMD-FNO-96-m12", "F3AMD-FNO-96-m8", "F3AMD-FNO-96-m4",
    "F3AMD-FNO-96-m1", "F3AMD-DCT-96", "F3AMD-reduced-rank-FNO-96", "F3AMD-weighted-FNO-96",
    "F3AMD-FNO-96-linear", "F3AMD-Transformer-64-linear", "CAMDM-96", "CAMDM-code",
)  # fmt: skip
_BASELINES = ("PyTorch", "PyTorch, oneDNN", "PyTorch, compiled", "ONNX Runtime")
_MAIN = (("F3AMD-FNO-96", (8, 4, 2, 1)), ("CAMDM", (8, 4)), ("F3AMD-Transformer-64", (8, 1)))


def _ways(characters: int) -> tuple[str, ...]:
    # Shares of less than four characters leave devices waiting for the start of their work.
    return ("jit", "jit, all devices") if characters >= 8 else ("jit",)


def _bars() -> Iterator[Candidate]:
    """Yield what the speed of the library itself is judged by."""
    for steps in (1, 8):
        for way in ("jit", "jit, all devices", "jit, FFT", "IREE"):
            yield Candidate("F3AMD-FNO-96", steps, 32, way)
    for way in ("jit", "jit, all devices", "IREE", *_BASELINES):
        yield Candidate("CAMDM", 8, 32, way)
    for way in ("jit", "jit, FFT", "IREE"):
        yield Candidate("F3AMD-FNO-96", 1, 1, way)
    for model, steps in (("F3AMD-FNO-96", 1), ("F3AMD-FNO-96", 8), ("CAMDM", 8)):
        yield Candidate(model, steps, 32, "jit, all devices", precision="bfloat16")


def _main() -> Iterator[Candidate]:
    """Yield the recommended models and the baseline at all numbers of steps, 1 to 32 characters."""
    for characters in (32, 1, 8, 16, 4, 2):
        for model, counts in _MAIN:
            for steps in counts:
                for way in _ways(characters):
                    yield Candidate(model, steps, characters, way)
        for way in _BASELINES:
            yield Candidate("CAMDM", 8, characters, way)
        for steps in (1, 8):
            yield Candidate("F3AMD-FNO-96", steps, characters, "jit, FFT")
            if characters in (1, 8, 32):
                yield Candidate("F3AMD-FNO-96", steps, characters, "IREE")


def _family() -> Iterator[Candidate]:
    """Yield every size and every variant at 8 steps."""
    for characters in (32, 1):
        for model in (*_FAMILY, "CAMDM", *_VARIANTS):
            yield Candidate(model, 8, characters, _ways(characters)[-1])


def _windows() -> Iterator[Candidate]:
    """Yield every size with windows of 64 frames at 8 steps."""
    for characters in (32, 1):
        for model in (*_FAMILY, "CAMDM"):
            yield Candidate(model, 8, characters, _ways(characters)[-1], 64)


def _curve() -> Iterator[Candidate]:
    """Yield the recommended models and the baseline from 64 to 1,024 characters."""
    for characters in _MANY:
        for model, steps in (
            ("F3AMD-FNO-96", 1), ("F3AMD-FNO-96", 8), ("F3AMD-Transformer-64", 8), ("CAMDM", 8),
        ):  # fmt: skip
            yield Candidate(model, steps, characters, "jit, all devices")


def _gpu() -> Iterator[Candidate]:
    """Yield Tables 1, 4 and the times of 11 on a GPU in JAX's own tf32, and the other precisions.

    Some ten minutes, most of them compiling: sizes off the recommended ones have three numbers of
    characters.
    """
    ends = (1024, 32, 1)
    for characters in (*ends, *(n for n in (*_FEW, *_MANY) if n not in ends)):
        for model, counts in _MAIN:
            for steps in counts:
                yield Candidate(model, steps, characters, "jit", 32, "tf32")
        if characters not in ends:
            continue
        for model in _FAMILY:
            yield Candidate(model, 8, characters, "jit", 32, "tf32")
        for precision in ("float32", "bfloat16"):
            for model, steps in (("F3AMD-FNO-96", 1), ("F3AMD-FNO-96", 8), ("CAMDM", 8)):
                yield Candidate(model, steps, characters, "jit", 32, precision)
    for model in _VARIANTS[:3]:
        yield Candidate(model, 8, 1024, "jit", 32, "tf32")
    for model in ("F3AMD-FNO-96", "F3AMD-Transformer-64", "CAMDM"):
        yield Candidate(model, 8, 1024, "jit", 64, "tf32")


def _smoke() -> Iterator[Candidate]:
    """Yield a handful, to see that everything runs."""
    for characters in (1, 8):
        for steps in (8, 1):
            yield Candidate("F3AMD-FNO-96", steps, characters, "jit")
        yield Candidate("F3AMD-FNO-96", 1, characters, "jit, FFT")
        yield Candidate("CAMDM", 8, characters, "jit")


SUITES = {
    "smoke": _smoke, "bars": _bars, "main": _main, "family": _family,
    "windows": _windows, "curve": _curve, "gpu": _gpu,
}  # fmt: skip
"""Name -> what it times; see the functions' first lines."""


def plan(suite: str) -> dict[tuple, list[Candidate]]:
    """Return what a suite times, by group, each candidate once.

    Args:
      suite: a key of `SUITES`.

    Raises:
      ValueError: for an unknown suite.
    """
    if suite not in SUITES:
        raise ValueError(f"unknown suite {suite!r}: use some of {', '.join(SUITES)}")
    groups: dict[tuple, list[Candidate]] = {}
    for candidate in dict.fromkeys(SUITES[suite]()):
        groups.setdefault(group_key(candidate), []).append(candidate)
    return groups


def group_key(candidate: Candidate) -> tuple:
    """Return what a candidate shares with those that it is timed by turns with."""
    return candidate.window, candidate.characters, candidate.precision


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

    Raises:
      ValueError: for candidates of several groups.
    """
    keys = {group_key(candidate) for candidate in candidates}
    if len(keys) != 1:
        raise ValueError(f"candidates of {len(keys)} groups cannot be timed by turns")
    window, characters, precision = keys.pop()
    ready, tasks, failed = {}, {}, {}
    with tqdm(candidates, unit="compiled", disable=not progress) as bar:
        for candidate in bar:
            bar.set_postfix_str(str(candidate))
            task = Task(
                candidate.model, build_config(candidate.model, window), candidate.steps,
                characters, precision,
            )  # fmt: skip
            try:
                ready[candidate] = prepare_round(candidate.way, task)
            except NotPossible as reason:
                failed[str(candidate)] = str(reason)
                continue
            tasks[candidate] = task
    if not ready:
        return pd.DataFrame(), failed
    probes, products = {}, {}
    for framework in dict.fromkeys(WAYS[candidate.way][0] for candidate in ready):
        probe = framework_probe(framework, precision)
        probes[framework] = "jax" if probe is None else framework
        products[probes[framework]] = matmul_probe(precision) if probe is None else probe
    calls = {candidate: done.call for candidate, done in ready.items()}
    calls |= {framework: multiply for framework, (multiply, _) in products.items()}
    timings = take_turns(calls, progress=progress, **turns)
    peaks = {framework: flops / timings[framework].median / 1e9 for framework, (_, flops) in products.items()}
    rows = [
        _row(candidate, ready[candidate], tasks[candidate], timings[candidate])
        | _shares(tasks[candidate], timings[candidate], peaks[probes[WAYS[candidate.way][0]]])
        for candidate in ready
    ]
    return pd.DataFrame(rows), failed


def _row(candidate: Candidate, done, task: Task, timing: Timing) -> dict:
    return {
        "model": candidate.model,
        "window_frames": candidate.window,
        "steps": candidate.steps,
        "sampler": task.sampler,
        "framework": WAYS[candidate.way][0],
        "way": candidate.way,
        "device": device_name(),
        "precision": candidate.precision,
        "characters": candidate.characters,
        "unit": "ms",
        "value": 1e3 * timing.median,
        "low": 1e3 * timing.low,
        "high": 1e3 * timing.high,
        "rounds": timing.rounds,
        "compile_seconds": round(done.compile_seconds, 2),
        "bytes_accessed": done.bytes_accessed,
    }


def _shares(task: Task, timing: Timing, peak: float) -> dict:
    flops = round_flops(task)
    reached = flops / timing.median / 1e9
    return {"flops": flops, "gflops": reached, "peak_gflops": peak, "share_of_peak": reached / peak}
