"""What 1, 8 and 100 machines bring to the long queue, by arithmetic from measured costs.

    python scripts/scaling.py        # writes tables of docs/training.md

Costs come from records: seconds a training step (`training_time.csv`) and seconds a measurement
(`quality_by_seed.csv`). Machines take legs as `f3amd sweep` does: the first of the plan that may
begin. Nothing is trained here.
"""

from __future__ import annotations

import functools
import heapq
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

import pandas as pd
from page_tables import fill_tables

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # this tree's library, whatever is installed

from f3amd_companion.measuring.campaign import STEPS_MEASURED, queue
from f3amd_companion.measuring.sweep import CAMPAIGN, Leg, plan
from f3amd_lib.ground.profiles import load_profile
from f3amd_lib.ground.records import read_table
from f3amd_lib.ground.tables import markdown_table
from f3amd_lib.networks import presets

ROOT = Path(__file__).resolve().parents[1]
RECORDS = ROOT / "paper_figures"
PAGE = ROOT / "docs" / "training.md"
MACHINES = (1, 2, 4, 8, 100)
BYTES_OF_STATE = 16
"""Of a parameter in a training state: itself, its moving average, Adam's two; float32."""

SNAPSHOT_EVERY = 400
"""Steps between two states that are written (`campaign`)."""


def finished_after(legs: Sequence[Leg], seconds: Mapping[str, float], machines: int) -> dict[str, float]:
    """Return when each leg is over, if a free machine takes the first leg that may begin.

    Args:
      legs: in the order of the plan.
      seconds: name -> what it takes.
      machines: how many.
    """
    ends: dict[str, float] = {}
    waiting, running, now = list(legs), [], 0.0
    while waiting or running:
        ready = [leg for leg in waiting if leg.after is None or ends.get(leg.after, float("inf")) <= now]
        for leg in ready[: machines - len(running)]:
            waiting.remove(leg)
            heapq.heappush(running, (now + seconds[leg.name], leg.name))
        now, name = heapq.heappop(running)
        ends[name] = now
    return ends


def timed_as(preset: str, timed: Sequence[str]) -> str:
    """Return the preset whose times stand for another's: itself, or the widest known of its kind."""
    if preset in timed:
        return preset
    return next(
        (name for kind, name in (("CAMDM", "CAMDM"), ("Transformer", "F3AMD-Transformer-64")) if kind in preset),
        "F3AMD-FNO-96",
    )


def _config(preset: str):
    """Return a preset's config on `bandai`, with windows of 32 frames."""
    return presets.build_config(preset, channels=129, num_styles=22, window=32)


def costs() -> pd.DataFrame:
    """Return the measured costs: model, s_per_window, s_per_snapshot (its measurement with one seed), parameters."""
    steps, _ = read_table(RECORDS / "synthetic/laptop/records/training_time.csv")
    rows, record = read_table(RECORDS / "bandai/laptop/records/quality_by_seed.csv")
    seconds = rows[rows["steps"].isin(STEPS_MEASURED)].groupby(["model", "steps"])["seconds"].first()
    measured = seconds.groupby("model").sum() / record["protocol"]["num_seeds"]
    table = pd.DataFrame(
        {
            "model": steps["model"],
            "s_per_window": steps["value"] / steps["batch_size"],
            "s_per_step": steps["value"],
            "s_per_snapshot": [measured[timed_as(model, measured.index)] for model in steps["model"]],
            "parameters": [presets.count_parameters(_config(model)) for model in steps["model"]],
        }
    )
    return table.set_index("model")


def queue_legs(measured: pd.DataFrame) -> tuple[list[Leg], dict[str, float]]:
    """Return the legs of the queue and what each takes: the windows since the snapshot before, and a measurement."""
    legs = plan([CAMPAIGN], [], load_profile("laptop", "bandai"), queue())
    before = {leg.name: leg.windows for leg in legs}
    operations = functools.cache(lambda preset: presets.count_model_flops(_config(preset))[1])
    seconds = {}
    for leg in legs:
        stands = timed_as(leg.preset, measured.index)
        share = operations(leg.preset) / operations(stands) * leg.run.window / 32
        windows = leg.windows - before.get(leg.after, 0)
        seconds[leg.name] = share * windows * measured["s_per_window"][stands] + measured["s_per_snapshot"][stands]
    return legs, seconds


@functools.cache
def tables() -> dict[str, str]:
    """Return the page's tables, name -> Markdown."""
    measured = costs()
    legs, seconds = queue_legs(measured)
    alone, rows = sum(seconds.values()), []
    for machines in MACHINES:
        hours = max(finished_after(legs, seconds, machines).values()) / 3600
        gain = alone / 3600 / hours
        rows.append({"machines": machines, "hours": f"{hours:.1f}", "times as fast": f"{gain:.1f}",
                     "busy": f"{100 * gain / machines:.0f} %"})  # fmt: skip
    last = finished_after(legs, seconds, len(legs))
    longest = max(legs, key=lambda leg: last[leg.name])
    state = measured["parameters"] * BYTES_OF_STATE
    shown = pd.DataFrame(
        {
            "model": measured.index,
            "ms a window": (1000 * measured["s_per_window"]).map("{:.2f}".format),
            "s a measurement": measured["s_per_snapshot"].map("{:.0f}".format),
            "MB of a state": (state / 1e6).map("{:.1f}".format),
            "MB/s of states": (state / 1e6 / (SNAPSHOT_EVERY * measured["s_per_step"])).map("{:.2f}".format),
            "MB/s of gradients": (4 * measured["parameters"] / 1e6 / measured["s_per_step"]).map("{:.0f}".format),
        }
    )
    facts = {
        "legs of the queue": str(len(legs)),
        "hours of all legs, one after the other": f"{alone / 3600:.1f}",
        "hours of the longest run, whose snapshots follow each other": f"{last[longest.name] / 3600:.1f}",
        "which run that is": f"`{longest.run.name}`",
        "machines beyond which nothing is gained": str(enough(legs, seconds)),
    }
    frames = {
        "costs": shown,
        "machines": pd.DataFrame(rows),
        "facts": pd.DataFrame(facts.items(), columns=["what", "figure"]),
    }
    return {name: markdown_table(frame) for name, frame in frames.items()}


def enough(legs: Sequence[Leg], seconds: Mapping[str, float]) -> int:
    """Return the fewest machines that are as fast as one for every leg."""
    best = max(finished_after(legs, seconds, len(legs)).values())
    return next(
        number for number in range(1, len(legs) + 1) if max(finished_after(legs, seconds, number).values()) <= best
    )


def written(page: str) -> str:
    """Return a page with its tables made anew.

    Raises:
      ValueError: if a table has no place in it.
    """
    return fill_tables(page, tables(), PAGE.name)


if __name__ == "__main__":
    PAGE.write_text(written(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
    sys.stdout.write(f"wrote {PAGE.relative_to(ROOT)}\n")
