"""Figures of the ablation notebook; each function draws numbers and computes nothing new."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import matplotlib
import numpy as np
import pandas as pd

from f3amd_lib.profiles import repository_root
from f3amd_lib.report.figures import PALETTE, model_style, new_figure
from f3amd_lib.report.plots import styled
from f3amd_lib.report.records import read_table

__all__ = [
    "committed_table",
    "size_scatter",
    "parameter_bars",
    "spectral_variants",
    "mode_costs",
    "cost_ratios",
    "visited_levels",
    "learning_dots",
]


def committed_table(
    dataset: str, name: str, *, profile: str = "laptop"
) -> tuple[pd.DataFrame, dict] | None:
    """Read a table that `make measure` left under `paper_figures/`.

    Args:
      dataset: a name of `profiles.DATASETS`.
      name: of the table, without ending.
      profile: whose results.

    Returns:
      (table, record), or None if nothing is committed for this data set.

    Raises:
      ValueError: if the table is not the one that its record describes.
    """
    folder = repository_root() / "paper_figures" / dataset / profile / "records"
    path = folder / f"{name}.csv"
    return read_table(path) if path.exists() else None


_FAMILIES = {
    "F3AMD-FNO": PALETTE["purple"],
    "F3AMD-Transformer": PALETTE["orange"],
    "FNO-96 ablated": PALETTE["sky"],
    "CAMDM": PALETTE["green"],
}


def _family_color(name: str) -> str:
    if name.startswith("CAMDM"):
        return _FAMILIES["CAMDM"]
    if "Transformer" in name:
        return _FAMILIES["F3AMD-Transformer"]
    plain = name.removeprefix("F3AMD-FNO-").isdigit()
    return _FAMILIES["F3AMD-FNO" if plain else "FNO-96 ablated"]


def _family_handles() -> list:
    return [
        matplotlib.lines.Line2D([], [], marker="o", linestyle="", color=color, label=family)
        for family, color in _FAMILIES.items()
    ]


@styled
def size_scatter(table: pd.DataFrame, labels: Mapping[str, tuple[str, float, float]]):
    """Draw learned numbers against operations of one evaluation, a point for each model.

    Args:
      table: columns model, parameters, mflop_per_evaluation.
      labels: model -> (text, shift right, shift up), in points; others stay without a name.
    """
    figure, axis = new_figure(8.4, 4.3)
    for name, parameters, mflop in table[
        ["model", "parameters", "mflop_per_evaluation"]
    ].itertuples(index=False):
        color = _family_color(name)
        # Ablations that cost what FNO-96 costs lie below it.
        below = 2 if color == _FAMILIES["FNO-96 ablated"] else 3
        axis.plot(
            parameters / 1e6, mflop, "o", color=color, markersize=7, markeredgecolor="white",
            zorder=below,
        )  # fmt: skip
        if name in labels:
            text, right, up = labels[name]
            axis.annotate(
                text, (parameters / 1e6, mflop), (right, up), textcoords="offset points",
                fontsize=8.5, ha="left" if right > 0 else "right" if right < 0 else "center",
                va="center",
            )  # fmt: skip
    axis.set_xscale("log")
    axis.set_yscale("log")
    axis.set_xticks([0.5, 1, 2, 4], ["0.5", "1", "2", "4"])
    axis.set_yticks([15, 30, 60, 120, 250, 500], ["15", "30", "60", "120", "250", "500"])
    axis.minorticks_off()
    axis.set_xlabel("learned numbers (millions)")
    axis.set_ylabel("MFLOP an evaluation")
    axis.legend(handles=_family_handles(), loc="center left", bbox_to_anchor=(0.02, 0.72))
    return figure


@styled
def parameter_bars(table: pd.DataFrame):
    """Draw learned numbers by part of the network, a bar for each model.

    Args:
      table: columns model, part, parameters.
    """
    figure, axis = new_figure(8.4, 0.9 + 0.27 * table["model"].nunique())
    wide = table.pivot(index="model", columns="part", values="parameters")
    wide = wide.loc[table["model"].unique()[::-1], table["part"].unique()] / 1e6
    left = np.zeros(len(wide))
    colors = ("purple", "sky", "green", "orange", "vermilion")
    for part, color in zip(wide.columns, colors, strict=False):
        axis.barh(wide.index, wide[part], left=left, color=PALETTE[color], label=part)
        left += wide[part].fillna(0.0).to_numpy()
    for row, total in enumerate(left):
        axis.text(total + 0.05, row, f"{total:.2f}", va="center", fontsize=9)
    axis.set_xlabel("learned numbers (millions)")
    axis.set_xlim(0, 1.12 * left.max())
    axis.grid(axis="y", visible=False)
    figure.legend(loc="outside upper right", ncols=len(wide.columns), fontsize=8.5)
    return figure


@styled
def spectral_variants(
    pulse, responses: Mapping[str, np.ndarray], ranks: Mapping[str, np.ndarray], gains
):
    """Draw what tells the spectral layers of Table 8 apart.

    Args:
      pulse: a signal, [T].
      responses: label -> what a layer makes of it, [T].
      ranks: label -> singular values of one mode's weights, falling.
      gains: label -> size of the layer's output at each mode, [m].
    """
    figure, axes = new_figure(8.8, 3.1, 1, 3)
    frame = np.arange(len(pulse))
    axes[0].fill_between(frame, pulse, step="mid", color="#DDDDDD", label="in")
    for (label, values), color in zip(responses.items(), ("purple", "green"), strict=False):
        axes[0].plot(frame, values, color=PALETTE[color], label=label)
    axes[0].set_title("DCT: no circle")
    axes[0].set_xlabel("frame")
    for (label, values), color in zip(ranks.items(), ("purple", "vermilion"), strict=False):
        axes[1].plot(1 + np.arange(len(values)), values, ".-", color=PALETTE[color], label=label)
    axes[1].set_title("reduced rank")
    axes[1].set_xlabel("number, by size")
    axes[1].set_ylabel("singular value of one mode")
    for (label, values), color in zip(gains.items(), ("purple", "orange", "blue"), strict=False):
        axes[2].plot(values, ".-", color=PALETTE[color], label=label)
    axes[2].set_title("weighted")
    axes[2].set_xlabel("mode")
    axes[2].set_ylabel("size of the output")
    axes[2].set_ylim(bottom=0.0)
    for axis in axes:
        axis.legend(fontsize=8)
    return figure


@styled
def mode_costs(table: pd.DataFrame, reported: pd.DataFrame):
    """Draw what fewer kept modes save, as shares of all modes, beside what the paper reports.

    Args:
      table: columns modes, parameters, operations; shares of the row with most modes.
      reported: columns modes, label, time (as a share), from the paper's text.
    """
    figure, axis = new_figure(7.6, 3.5)
    axis.plot(table["modes"], table["operations"], "o-", color=PALETTE["purple"],
              label="operations (counted)")  # fmt: skip
    axis.plot(table["modes"], table["parameters"], "s-", color=PALETTE["sky"],
              label="learned numbers (counted)")  # fmt: skip
    shades = ("#F4B8A8", PALETTE["vermilion"], "#8A2D1D")
    for (modes, label, time), shade in zip(
        reported[["modes", "label", "time"]].itertuples(index=False), shades, strict=False
    ):
        axis.plot(modes, time, "D", color=shade, label=f"paper's time, {label}")
    axis.set_xticks(table["modes"])
    axis.set_xlabel("kept modes m")
    axis.set_ylabel("share of m = 17")
    axis.set_ylim(0, 1.08)
    axis.legend(loc="lower right", fontsize=8.5)
    return figure


@styled
def cost_ratios(table: pd.DataFrame):
    """Draw costs of variants as multiples of the first one, a row for each variant.

    Args:
      table: columns variant, kind ("operations", ... in the order of the legend), ratio.
    """
    figure, axis = new_figure(7.6, 2.7)
    variants = list(table["variant"].unique())[::-1]
    kinds = list(table["kind"].unique())
    markers = (("o", "purple"), ("s", "sky"), ("D", "vermilion"))
    for kind, (marker, color) in zip(kinds, markers, strict=False):
        rows = table[table["kind"] == kind]
        axis.plot(rows["ratio"], [variants.index(v) for v in rows["variant"]], marker,
                  color=PALETTE[color], markersize=8, label=kind)  # fmt: skip
    axis.axvline(1.0, color=PALETTE["grey"], linewidth=0.8)
    axis.set_yticks(range(len(variants)), variants)
    axis.set_ylim(-0.6, len(variants) - 0.4)
    axis.set_xlabel("times FiLM")
    axis.legend(loc="lower right", bbox_to_anchor=(1.0, 0.24), fontsize=8.5)
    return figure


@styled
def visited_levels(levels: Mapping[str, np.ndarray], trained: Mapping[str, np.ndarray]):
    """Draw which noise levels samplers visit, a row for each.

    Args:
      levels: title -> noise levels above 0.
      trained: title -> levels that the network was trained on, where these are few.
    """
    figure, axis = new_figure(8.4, 0.8 + 0.3 * len(levels))
    titles = list(levels)[::-1]
    for row, title in enumerate(titles):
        color = PALETTE["green" if title.startswith("CAMDM") else "purple"]
        if title in trained:
            axis.plot(trained[title], [row] * len(trained[title]), "|", color="#999999",
                      markersize=11)  # fmt: skip
        else:
            axis.plot([0.01, 128], [row, row], color="#CCCCCC", linewidth=1.2, zorder=0)
        axis.plot(levels[title], [row] * len(levels[title]), "o", color=color)
    axis.set_yticks(range(len(titles)), titles)
    axis.set_ylim(-0.7, len(titles) - 0.3)
    axis.set_xscale("log")
    axis.set_xlabel("noise level σ; bars and lines: trained on, dots: visited")
    axis.grid(axis="y", visible=False)
    return figure


@styled
def learning_dots(table: pd.DataFrame, groups: Mapping[str, Sequence[str]]):
    """Draw the held-out loss of each model before and after a short run, a panel for each group.

    Args:
      table: columns model, held_out_before, held_out_after.
      groups: title -> models; those without a row in the table are left out.

    Raises:
      ValueError: if no model of the groups is in the table.
    """
    rows = table.set_index("model")[["held_out_before", "held_out_after"]]
    shown = {
        title: [name for name in names if name in rows.index] for title, names in groups.items()
    }
    shown = {title: names for title, names in shown.items() if names}
    if not shown:
        raise ValueError("none of the models in groups is in the table")
    counts = [len(names) for names in shown.values()]
    figure, axes = new_figure(
        8.4, 0.6 + 0.22 * sum(counts) + 0.3 * len(shown), len(shown), 1, sharex=True,
        height_ratios=[count + 0.4 for count in counts], squeeze=False,
    )  # fmt: skip
    for axis, (title, names) in zip(axes[:, 0], shown.items(), strict=True):
        for place, name in enumerate(names[::-1]):
            color = model_style(name).color
            before, after = rows.loc[name]
            axis.plot([before, after], [place, place], color=color, linewidth=1.6)
            axis.plot(before, place, "o", color=color, markerfacecolor="white")
            axis.plot(after, place, "o", color=color)
        axis.set_yticks(range(len(names)), names[::-1], fontsize=8.5)
        axis.set_ylim(-0.6, len(names) - 0.4)
        axis.set_xscale("log")
        axis.set_title(title, fontsize=9.5)
        axis.grid(axis="y", visible=False)
    values = rows.loc[[name for names in shown.values() for name in names]].to_numpy()
    steps = (1, 2, 5) if values.max() > 30 * values.min() else (1, 1.5, 2, 3, 5, 7)
    ticks = [step * 10.0**power for power in range(-3, 5) for step in steps]
    ticks = [tick for tick in ticks if 0.8 * values.min() <= tick <= 1.25 * values.max()]
    axes[-1, 0].set_xticks(ticks, [f"{tick:g}" for tick in ticks])
    axes[-1, 0].minorticks_off()
    axes[-1, 0].set_xlabel("held-out loss: before (open) and after (filled)")
    return figure
