"""Timing in alternation: every candidate runs once, then every candidate again.

A machine that others use, or that grows warm, is slower for some seconds. Alternation (A B A B) such a
spell hits all candidates alike, so that ratios keep their meaning where single times do not.
"""

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from tqdm import tqdm


@dataclass(frozen=True)
class Timing:
    """How long one call takes, in seconds.

    Attributes:
      median: over the timed rounds.
      low, high: their 5 % and 95 % quantiles.
      median_low, median_high: 95 % interval of the median itself.
      rounds: how many were timed.
    """

    median: float
    low: float
    high: float
    median_low: float
    median_high: float
    rounds: int

    def columns(self, unit: str, scale: float) -> dict:
        """Return unit, value, both pairs of bounds and rounds as a table has them; `scale` units are a second."""
        bounds = {name: scale * getattr(self, name) for name in ("low", "high", "median_low", "median_high")}
        return {"unit": unit, "value": scale * self.median} | bounds | {"rounds": self.rounds}


def median_interval(rounds, draws: int = 2000) -> tuple[float, float]:
    """Return the 95 % interval of the median of some rounds, by a bootstrap with a fixed seed.

    Rounds count as independent; where the machine was busy for spells, the true interval is wider.

    Source: Efron and Tibshirani 1993, section 13.3 (percentile interval).
    """
    drawn = np.random.default_rng(0).choice(np.asarray(rounds, np.float64), (draws, len(rounds)))
    low, high = np.quantile(np.median(drawn, axis=1), (0.025, 0.975))
    return float(low), float(high)


def take_turns(
    candidates: Mapping[str, Callable[[], object]], *, min_rounds: int = 100, min_seconds: float = 10.0,
    fewest_rounds: int = 5, warmup: int = 3, clock: Callable[[], float] = time.perf_counter, progress: bool = False,
) -> dict[str, Timing]:  # fmt: skip
    """Time functions alternately until each has had enough rounds or seconds.

    Args:
      candidates: name -> function without arguments that comes back when its work is done (JAX
        calls must block until ready).
      min_rounds: a candidate is done after this many rounds,
      min_seconds: or once its own rounds have taken this long,
      fewest_rounds: but not before it has had this many.
      warmup: calls before the first timed round; the first one may compile.
      clock: seconds, rising.
      progress: show a bar.

    Returns:
      Name -> timing, in the order of `candidates`. Each has one round at least, whatever the counts.
    """
    for _ in range(warmup):
        for call in candidates.values():
            call()
    seconds: dict[str, list[float]] = {name: [] for name in candidates}
    with tqdm(total=len(candidates), unit="candidate", disable=not progress) as bar:
        waiting = dict(candidates)
        while waiting:
            for name, call in list(waiting.items()):
                rounds, started = seconds[name], clock()
                call()
                rounds.append(clock() - started)
                enough = len(rounds) >= min_rounds or sum(rounds) >= min_seconds
                if enough and len(rounds) >= min(fewest_rounds, min_rounds):
                    del waiting[name]
                    bar.update()
    timings = {}
    for name, rounds in seconds.items():
        quantiles = map(float, np.quantile(rounds, (0.5, 0.05, 0.95)))
        timings[name] = Timing(*quantiles, *median_interval(rounds), len(rounds))
    return timings
