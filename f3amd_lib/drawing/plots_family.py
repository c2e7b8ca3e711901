"""Figures of the trained family: losses against windows seen, use of noise, 1 step beside 8."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
import pandas as pd
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from f3amd_lib.drawing.style import PALETTE, model_style, new_figure, plot_style

_HELD_OUT = {
    "held_out_position": "joint positions, Eq. 12 (m²)",
    "held_out_joint_velocity": "joint velocities, Eq. 13 (m²)",
}


def held_out_curves(histories: Mapping[str, pd.DataFrame]):
    """Draw held-out errors against windows seen, on log-log axes.

    Args:
      histories: by model, with columns windows and `held_out_position`, `held_out_joint_velocity`,
        NaN where they were not measured.

    Raises:
      ValueError: if a history lacks a column.
    """
    with plot_style():
        figure, axes = new_figure(8.0, 3.4, ncols=2)
        for axis, (column, title) in zip(axes, _HELD_OUT.items(), strict=True):
            for name, history in histories.items():
                missing = {"windows", column} - set(history.columns)
                if missing:
                    raise ValueError(f"the history of {name} has no column {missing.pop()!r}")
                rows = history.dropna(subset=column)
                axis.plot(rows["windows"], rows[column], markersize=3, label=name, **model_style(name).line)
            axis.set(xscale="log", yscale="log", xlabel="windows seen", ylabel="held-out error")
            axis.set_title(title)
            axis.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
            axis.xaxis.set_major_formatter(FuncFormatter(lambda windows, _: f"{windows:,.0f}"))
            axis.xaxis.set_minor_formatter(NullFormatter())
            axis.tick_params(axis="x", labelrotation=30)
        axes[0].legend(fontsize=8, handlelength=3.2)
    return figure


def error_by_noise(table: pd.DataFrame):
    """Draw the error of the clean estimate against the noise level, a line per model.

    Args:
      table: columns model, sigma, x0_error.
    """
    with plot_style():
        figure, axis = new_figure(7.0, 3.6)
        for name, rows in table.groupby("model", sort=False):
            rows = rows.sort_values("sigma")
            axis.plot(rows["sigma"], rows["x0_error"], markersize=4, label=name, **model_style(name).line)
        low, high = table["sigma"].min(), table["sigma"].max()
        top = 1.15 * table["x0_error"].max()
        own = np.geomspace(low, high, 200)
        axis.plot(own, own, color=PALETTE["grey"], linestyle=":", label="the input's own")
        axis.set(xscale="log", xlabel="noise level sigma", ylabel="x0 error (deviations)", ylim=(0, top))
        axis.legend(fontsize=8, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return figure


def steps_beside_real(quality: pd.DataFrame, figures: Mapping[str, str]):
    """Draw figures of motion quality with 8 steps and 1, models one above the other.

    Args:
      quality: from `protocol.summarise`, with real motion.
      figures: metric -> heading, one panel each.

    Raises:
      ValueError: if a metric is missing.
    """
    made = quality[quality["steps"].isin([8, 1])]
    names = list(dict.fromkeys(made["model"]))
    with plot_style():
        columns = 4
        lines = math.ceil(len(figures) / columns)
        figure, axes = new_figure(
            9.0, 0.7 + lines * (0.7 + 0.24 * len(names)), nrows=lines, ncols=columns, sharey=True,
            squeeze=False,
        )  # fmt: skip
        for axis in axes.flat[len(figures) :]:
            axis.set_visible(False)
        for axis, (metric, heading) in zip(axes.flat, figures.items(), strict=False):
            rows = made[made["metric"] == metric].set_index(["model", "steps"])
            if rows.empty:
                raise ValueError(f"the quality table has no metric {metric!r}")
            for place, name in enumerate(names):
                for steps, shift in ((8, -0.12), (1, 0.12)):
                    if (name, steps) not in rows.index:
                        continue
                    row = rows.loc[(name, steps)]
                    color = model_style(name).color
                    axis.errorbar(
                        row["value"], place + shift,
                        xerr=[[row["value"] - row["low"]], [row["high"] - row["value"]]],
                        fmt="o", color=color, markersize=5, elinewidth=1.2,
                        markerfacecolor=color if steps == 8 else "white",
                    )  # fmt: skip
            real = quality[(quality["model"] == "real") & (quality["metric"] == metric)]["value"]
            if len(real):
                axis.axvline(real.iloc[0], color=PALETTE["black"], linestyle="--", linewidth=1.2)
            axis.set_title(heading, fontsize=9)
            axis.set_yticks(range(len(names)), names, fontsize=8)
            axis.tick_params(axis="x", labelsize=8)
            axis.margins(x=0.12)
        axes[0, 0].invert_yaxis()
    return figure
