"""How like the paper's FNO-96 is a network of ours? A distance for each line of `papers/f3amd/fingerprint.toml`.

The lines are what survives a change of data: ratios to real motion, changes between numbers of steps, and one figure of
CAMDM's code. Likeness is no quality: the paper's network may have faults of its own.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd

from f3amd_lib.ground.names import check_known
from f3amd_lib.ground.papers import load_paper_file, load_paper_table

LINES: dict[str, dict] = load_paper_file("fingerprint")["line"]
REFUSED: dict[str, str] = load_paper_file("fingerprint")["refused"]
"""Metric that is not compared -> why."""


def _figure(line: dict, by_steps: pd.DataFrame, real: pd.Series, steps: int) -> float:
    """Return what a line compares; metrics are columns of `by_steps`, numbers of steps its index."""
    if "change" in line:
        pairs = [by_steps.loc[list(pair), line["change"]].to_numpy(float) for pair in line["between"]]
        return float(np.max([np.abs(after / before - 1.0) for before, after in pairs]))
    return float(by_steps.loc[steps, line["metric"]] / (real[line["metric"]] if line.get("of_real") else 1.0))


def paper_figures() -> pd.DataFrame:
    """Return what Table 5 prints of FNO-96, metric -> column by our names, a row for each number of steps."""
    table = load_paper_table(5).query("model == 'F3AMD-FNO-96'")
    ours = {line["paper"]: line["metric"] for line in LINES.values() if "paper" in line}
    return table.replace({"metric": ours}).pivot(index="steps", columns="metric", values="value")


def likeness(by_steps: pd.DataFrame, real: pd.Series, lines: Sequence[str] = tuple(LINES), *, steps=8) -> pd.DataFrame:
    """Compare a network with the paper's, line by line.

    Args:
      by_steps: figures of the network, metrics as columns, an index of 8, 4, 2 and 1 steps.
      real: the same metrics of real motion, measured by the same protocol.
      lines: names of `LINES`.
      steps: of the lines that look at one number of steps.

    Returns:
      A row a line: paper (its figure, held against the same real motion), ours, low, high, distance: 0 within the
      bounds, else the logarithm of the factor that is missing; infinite where ours is not known.

    Raises:
      ValueError: for an unknown line, or a metric that cannot be compared, with the reason.
    """
    rows, paper = [], paper_figures()
    for name in lines:
        if name in REFUSED:
            raise ValueError(f"{name} cannot be compared with the paper's: {REFUSED[name]}")
        check_known(name, LINES, "line of the fingerprint")
        line = LINES[name]
        low, high = line.get("low", 0.0), line.get("high", np.inf)
        theirs, ours = (_figure(line, table, real, steps) for table in (paper, by_steps))
        with np.errstate(divide="ignore"):
            missing = [np.log(low / np.float64(ours)) if low else 0.0, np.log(ours / np.float64(high)) if ours else 0.0]
        distance = max(0.0, *missing) if ours == ours else np.inf
        rows.append({"line": name, "paper": theirs, "ours": ours, "low": low, "high": high, "distance": distance})
    return pd.DataFrame(rows)


def likeness_of_readings(readings: pd.DataFrame, lines: Sequence[str] = tuple(LINES)) -> pd.DataFrame:
    """Compare every network of `records/readings.csv` under each grid and update, by means over walks.

    Returns:
      The columns of `likeness`, and run, windows, grid, update, diverged (walks in 8 steps).
    """
    real = readings[readings["run"] == "real"].set_index("metric")["value"]
    walked = readings[readings["walks"].gt(0) & (readings["run"] != "real")]
    tables = []
    for (run, windows), rows in walked.groupby(["run", "windows"], sort=False):
        one = rows[rows["steps"] == 1]  # the same under every grid and update
        for (grid, update), several in rows[rows["steps"] > 1].groupby(["grid", "update"], sort=False):
            by_steps = pd.concat([several, one]).pivot_table(index="steps", columns="metric", values="value")
            by_steps = by_steps.reindex(index=[8, 4, 2, 1], columns=real.index)
            gone = int(several.loc[several["steps"] == 8, "diverged"].max())
            named = {"run": run, "windows": windows, "grid": grid, "update": update, "diverged": gone}
            tables.append(likeness(by_steps, real, lines).assign(**named))
    return pd.concat(tables, ignore_index=True)
