"""Speed tables from records: ours beside the paper's, and our own bars."""

import operator
from pathlib import Path

import numpy as np
import pandas as pd

from f3amd_lib.ground.files import read_toml

_ASKED = read_toml(Path(__file__).with_name("speed_bars.toml"))


def _fastest(table: pd.DataFrame, characters: int, model: str, steps: int, implementations: str) -> pd.Series | None:
    """Return the fastest row of a system at 32 frames in float32; None if there is none."""
    row = {"model": model, "steps": steps, "characters": characters, "window_frames": 32, "precision": "float32"}
    wanted = (table[list(row)] == pd.Series(row)).all(axis=1)
    rows = table[wanted & table["way"].isin(_ASKED["implementations"][implementations])]
    return None if rows.empty else rows.loc[rows["value"].idxmin()]


def speed_bars(times: pd.DataFrame, *, suite: str = "main") -> pd.DataFrame:
    """Compare what was measured on a CPU with what the library asks of itself.

    Shares are of the machine's own matrix product, timed alternately with the rounds. Each system has
    its fastest implementation, in float32.

    Args:
      times: the table `synthesis_ways`.
      suite: "main" or "bars", one of both, so that all comes from the same turns.

    Returns:
      Columns what, characters, asked, measured, way, met ("yes", "no" or "not measured").
    """
    times = times[times["suite"] == suite]
    rows = []
    for bar in _ASKED["bar"]:
        sign, bound = bar["sign"], bar.get("bound")
        fastest = [_fastest(times, bar["characters"], *system) for system in bar["systems"]]
        measured, way, met = None, "", "not measured"
        if all(row is not None for row in fastest):
            one, *other = fastest
            way = " / ".join(row["way"] for row in fastest)
            measured = one["value"] / other[0]["value"] if other else one["share_of_peak"]
            holds = {">=": operator.ge, "<=": operator.le, "reported": lambda one, other: True}[sign]
            met = "yes" if holds(measured, bound) else "no"
        asked = sign if bound is None else f"{sign} {bound}"
        row = {"what": bar["what"], "characters": bar["characters"], "asked": asked}
        rows.append(row | {"measured": measured, "way": way, "met": met})
    return pd.DataFrame(rows)


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
    keys = ["model", "window_frames", "steps", "framework", "device", "characters"]
    turn = kept["suite"].map({"main": 0, "bars": 2}).fillna(1)
    kept = kept.assign(turn=turn).reset_index(drop=True)
    kept = kept[kept["turn"] == kept.groupby(keys)["turn"].transform("min")].drop(columns="turn")
    fastest = kept.loc[kept.groupby(keys)["value"].idxmin()]
    models = {model: place for place, model in enumerate(dict.fromkeys(table["model"]))}
    place = fastest["model"].map(models).to_numpy()
    sorting = np.lexsort((fastest["characters"], -fastest["steps"], fastest["window_frames"], place))
    return fastest.iloc[sorting].reset_index(drop=True)
