"""Figures of the benchmark notebook; each function draws numbers and computes nothing new."""

from __future__ import annotations

from collections.abc import Mapping

import matplotlib
import numpy as np
import pandas as pd

from f3amd_lib.report.figures import PALETTE, model_style, new_figure
from f3amd_lib.report.plots import shades, styled

__all__ = ["speedup_panels", "time_curves", "way_bars", "part_bars"]


def _characters(axis, counts) -> None:
    """Label a logarithmic axis with the numbers of characters themselves."""
    axis.set_xscale("log", base=2)
    ticks = sorted(set(counts))
    axis.set_xticks(ticks[:: 2 if len(ticks) > 7 else 1])
    axis.xaxis.set_major_formatter(lambda value, _: f"{value:,.0f}")
    axis.xaxis.set_minor_locator(matplotlib.ticker.NullLocator())
    axis.set_xlabel("characters")


@styled
def speedup_panels(panels: Mapping[str, pd.DataFrame], *, by: str = "model"):
    """Draw the speedup over CAMDM with 8 steps against the number of characters.

    Args:
      panels: title -> rows of `speed_tables.speedups`, of one device.
      by: what tells the lines apart: "model" (Figure 3; presets such as F3AMD-FNO-96, a family
        and a width) or "steps" (Figure 4).
    """
    figure, axes = new_figure(8.4, 3.5, 1, len(panels), sharey=True, squeeze=False)
    for axis, (title, table) in zip(axes[0], panels.items(), strict=True):
        for label, rows, line in _lines(table, by):
            rows = rows.sort_values("characters")
            axis.plot(rows["characters"], rows["speedup"], label=label, **line)
        axis.axhline(1.0, color=PALETTE["grey"], linewidth=1.0)
        axis.set_yscale("log")
        axis.yaxis.set_major_formatter(lambda value, _: f"{value:g}x")
        axis.yaxis.set_minor_formatter(
            lambda value, _: f"{value:g}x" if value in (2, 5, 20, 50) else ""
        )
        _characters(axis, table["characters"])
        axis.set_title(title)
    axes[0, 0].set_ylabel("time of CAMDM, 8 steps,\nover time of the model")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside right center", fontsize=8.5)
    return figure


def _lines(table: pd.DataFrame, by: str):
    """Yield (label, rows, line style) of each line."""
    if by == "steps":
        counts = sorted(table["steps"].unique(), reverse=True)
        for steps, color in zip(counts, shades(len(counts)), strict=True):
            label = f"{steps} step{'s' if steps > 1 else ''}"
            yield label, table[table["steps"] == steps], {"color": color, "marker": "o"}
        return
    models = dict.fromkeys(table["model"])
    for model in sorted(models, key=lambda name: (name.split("-")[1], int(name.split("-")[2]))):
        rows = table[table["model"] == model]
        yield model.removeprefix("F3AMD-"), rows, model_style(model).line


@styled
def time_curves(table: pd.DataFrame):
    """Draw time a round against the number of characters, a line a system.

    Args:
      table: columns label, model, steps, characters, value, low and high in ms.
    """
    figure, axis = new_figure(7.2, 3.8)
    for label, rows in table.groupby("label", sort=False):
        rows = rows.sort_values("characters")
        line = dict(model_style(rows["model"].iloc[0]).line)
        if rows["steps"].iloc[0] == 1:
            line |= {"linestyle": ":", "markerfacecolor": "white"}
        axis.plot(rows["characters"], rows["value"], label=label, **line)
        axis.fill_between(
            rows["characters"], rows["low"], rows["high"], color=line["color"], alpha=0.15,
            linewidth=0,
        )  # fmt: skip
    axis.set_yscale("log")
    axis.yaxis.set_major_formatter(lambda value, _: f"{value:,g}")
    _characters(axis, table["characters"])
    axis.set_ylabel("time a round (ms)")
    frame = 1e3 * 32 / 30
    axis.axhline(frame, color=PALETTE["grey"], linewidth=1.0)
    axis.text(
        table["characters"].min(), frame * 1.12, "the motion lasts as long: 32 frames at 30 fps",
        fontsize=8.5, color=PALETTE["grey"],
    )  # fmt: skip
    figure.legend(loc="outside right center", fontsize=8.5)
    return figure


@styled
def way_bars(table: pd.DataFrame):
    """Draw each way's share of the machine's matrix product, a bar each, with its time.

    Args:
      table: rows of `synthesis_ways` of one number of characters.
    """
    rows = table.assign(
        system=table["model"] + table["steps"].map(lambda n: f", {n} step{'s' if n > 1 else ''}")
    )
    systems = list(dict.fromkeys(rows["system"]))
    figure, axes = new_figure(
        8.2, 0.55 + 0.24 * len(rows) + 0.3 * len(systems), len(systems), 1, sharex=True,
        squeeze=False, height_ratios=[(rows["system"] == system).sum() for system in systems],
    )  # fmt: skip
    for axis, system in zip(axes[:, 0], systems, strict=True):
        mine = rows[rows["system"] == system].sort_values("value", ascending=False)
        places = np.arange(len(mine))
        fastest = mine["value"].to_numpy() == mine["value"].min()
        colors = np.where(fastest, PALETTE["purple"], PALETTE["sky"])
        axis.barh(places, 100 * mine["share_of_peak"], color=colors, height=0.72)
        for place, (share, value) in enumerate(mine[["share_of_peak", "value"]].to_numpy()):
            axis.text(
                100 * share + 1,
                place,
                f"{value:,.0f} ms" if value >= 100 else f"{value:.3g} ms",
                va="center",
                fontsize=8.5,
            )
        axis.set_yticks(places, mine["way"], fontsize=9)
        axis.set_title(system, fontsize=10)
        axis.grid(False, axis="y")
        axis.set_xlim(0, 115)
    axes[-1, 0].set_xlabel("share of the matrix product's speed (%)")
    return figure


@styled
def part_bars(table: pd.DataFrame):
    """Draw which share of a round's time each part takes, a panel a number of characters.

    Args:
      table: of `parts.time_parts`, several numbers of characters below each other.
    """
    counts = list(dict.fromkeys(table["characters"]))
    figure, axes = new_figure(8.0, 2.6, 1, len(counts), sharex=True, sharey=True, squeeze=False)
    for axis, characters in zip(axes[0], counts, strict=True):
        mine = table[table["characters"] == characters]
        whole = mine.loc[mine["without"] == "nothing", "value"].iloc[0]
        parts = mine[mine["without"] != "nothing"].iloc[::-1]
        axis.barh(parts["without"], 100 * parts["saved"], color=PALETTE["purple"], height=0.7)
        for place, saved in enumerate(parts["saved"]):
            axis.text(
                100 * max(saved, 0) + 1, place, f"{100 * saved:.0f} %", va="center", fontsize=9
            )
        axis.set_title(f"{characters} character{'s' if characters > 1 else ''}: {whole:.3g} ms")
        axis.set_xlabel("time saved without it (%)")
        axis.grid(False, axis="y")
        axis.set_xlim(0, 70)
    return figure
