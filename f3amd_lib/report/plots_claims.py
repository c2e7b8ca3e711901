"""Figures of the claims notebook; each function draws verdicts and judges nothing."""

from __future__ import annotations

import pandas as pd
from matplotlib.patches import Patch, Rectangle

from f3amd_lib.report.figures import PALETTE, new_figure
from f3amd_lib.report.ledger.verdicts import FAILS, HOLDS, IN_PART, OPEN, UNMEASURED
from f3amd_lib.report.plots import styled

__all__ = ["verdict_overview"]

_LOOKS = {
    HOLDS: (PALETTE["green"], "✓", "white"),
    IN_PART: (PALETTE["orange"], "±", "black"),
    FAILS: (PALETTE["vermilion"], "✗", "white"),
    OPEN: (PALETTE["sky"], "≈", "black"),
    UNMEASURED: ("#EDEDED", "", "black"),
}


@styled
def verdict_overview(ledger: pd.DataFrame):
    """Draw all verdicts: a column for each claim, a row each for the paper's tables and for ours.

    Args:
      ledger: from `claims.ledger`.
    """
    figure, axis = new_figure(8.8, 1.9)
    gap = 0.7  # between groups, in cells
    groups = list(dict.fromkeys(ledger["group"]))
    places = [place + gap * groups.index(group) for place, group in enumerate(ledger["group"])]
    for row, column in enumerate(("verdict", "paper_verdict")):
        for place, verdict in zip(places, ledger[column], strict=True):
            color, mark, ink = _LOOKS[verdict]
            corner = place - 0.45, row - 0.42
            axis.add_patch(Rectangle(corner, 0.9, 0.84, facecolor=color, linewidth=0))
            axis.text(place, row, mark, ha="center", va="center", color=ink, fontsize=10)
    for group in groups:
        mine = [x for x, other in zip(places, ledger["group"], strict=True) if other == group]
        axis.text(mine[0] - 0.45, 1.75, group, fontsize=9.5, fontweight="bold")
    axis.set_xlim(-0.7, places[-1] + 0.7)
    axis.set_ylim(-0.6, 2.15)
    axis.set_xticks(places, ledger["id"], rotation=90, fontsize=8)
    axis.set_yticks((0, 1), ("our measurements", "the paper's tables"))
    axis.tick_params(length=0)
    axis.grid(False)
    axis.spines[:].set_visible(False)
    handles = [
        Patch(facecolor=color, label=f"{mark} {verdict}".strip())
        for verdict, (color, mark, _) in _LOOKS.items()
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), fontsize=8.5)
    return figure
