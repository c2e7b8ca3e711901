"""What the library asks of its own speed, beside what was measured."""

import operator
from pathlib import Path

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
