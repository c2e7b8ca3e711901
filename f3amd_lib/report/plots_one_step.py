"""Figures of the notebook on one step; each function draws numbers and computes nothing new."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pandas as pd

from f3amd_lib.report.figures import PALETTE, model_style, new_figure
from f3amd_lib.report.plots import shades, styled
from f3amd_lib.training.fork import Fork, crossing

__all__ = [
    "distance_from_data",
    "spread_curves",
    "continuation_bars",
    "answers_against_sigma",
    "fork_plan",
    "outcome_grid",
    "wall_shares",
    "errors_beside_exact",
]

_MARKERS = "osD^vPX"


def _step_name(steps: int) -> str:
    return f"{steps} step" + "s" * (steps != 1)


@styled
def distance_from_data(table: pd.DataFrame, width: float):
    """Draw how far samples lie from the data while two modes move apart, a line for each N.

    Args:
      table: columns half_distance, steps, distance.
      width: deviation of a mode, marked on the axis.
    """
    figure, axis = new_figure(7.2, 3.7)
    groups = list(table.groupby("steps", sort=True))
    for (steps, rows), color, marker in zip(groups, shades(len(groups)), _MARKERS, strict=False):
        axis.plot(rows["half_distance"], rows["distance"], marker=marker, color=color,
                  markersize=4.5, label=_step_name(steps))  # fmt: skip
    ends = np.array([width, table["half_distance"].max()])
    axis.plot(ends, ends, color=PALETTE["grey"], linestyle=":", label="all in the middle", zorder=1)
    axis.axvline(width, color=PALETTE["black"], linewidth=0.9, linestyle="--", zorder=1)
    axis.annotate("width of a mode", (width, axis.get_ylim()[1]), (4, -2), fontsize=9,
                  textcoords="offset points", va="top")  # fmt: skip
    axis.set_xscale("log")
    axis.set_yscale("log")
    axis.set_xlabel("half the distance of the modes")
    axis.set_ylabel("Wasserstein-1 distance")
    axis.legend(loc="upper left", bbox_to_anchor=(1.01, 1.0))
    return figure


@styled
def spread_curves(table: pd.DataFrame, halves: Mapping[float, float]):
    """Draw what noise leaves open, and how far answers follow it, a line for each distance.

    Args:
      table: columns half_distance, sigma, posterior_spread, answer_spread.
      halves: half_distance -> noise level at which half of the data's spread is left, marked.
    """
    figure, (left, right) = new_figure(9.0, 3.6, 1, 2)
    groups = list(table.groupby("half_distance", sort=True))
    for (half, rows), color, marker in zip(groups, shades(len(groups)), _MARKERS, strict=False):
        sigma = rows["sigma"].to_numpy()
        left.plot(sigma, rows["posterior_spread"], color=color)
        right.plot(sigma, rows["answer_spread"], color=color, label=f"±{half:g}")
        there = np.interp(np.log(halves[half]), np.log(sigma), rows["posterior_spread"])
        left.plot(halves[half], there, marker, color=color, markersize=7)
        right.plot([], [], marker, color=color)
    for axis, title in ((left, "what is left open"), (right, "how far answers scatter")):
        axis.set_xscale("log")
        axis.set_yscale("log")
        axis.set_title(title)
        axis.set_xlabel("noise level σ")
    left.set_ylabel("deviation of x₀, given x and σ")
    right.set_ylabel("deviation of D over noise")
    low = table["posterior_spread"].min()
    for axis in (left, right):
        axis.set_ylim(0.5 * low, 2.5 * table["posterior_spread"].max())
    right.legend(title="modes at", loc="upper left", bbox_to_anchor=(1.01, 1.0))
    return figure


@styled
def continuation_bars(tables: Mapping[str, pd.DataFrame]):
    """Draw how far real motion goes apart, the more it had in common the less.

    Args:
      tables: title -> rows of `posterior.continuation_spread`.
    """
    rows = max(len(table) for table in tables.values())
    figure, axes = new_figure(9.0, 1.0 + 0.42 * rows, 1, len(tables), sharey=True, squeeze=False)
    tones = ("#CDB9E6", "#8159B0", PALETTE["purple"])
    for axis, (title, table) in zip(axes[0], tables.items(), strict=True):
        place = np.arange(len(table))
        reach = np.abs(table[["low", "high"]].to_numpy().T - table["value"].to_numpy())
        axis.barh(place, table["value"], color=tones[: len(table)], height=0.62)
        axis.errorbar(table["value"], place, xerr=reach, fmt="none", ecolor=PALETTE["black"],
                      elinewidth=1.1, capsize=3)  # fmt: skip
        for row, (value, high, apart) in enumerate(
            table[["value", "high", "history_apart"]].itertuples(index=False)
        ):
            end = value if np.isnan(high) else max(value, high)
            axis.annotate(f"{value:.1f}  (histories {apart:.0f} apart)", (end, row), (5, 0),
                          textcoords="offset points", va="center", fontsize=8.5)  # fmt: skip
        axis.set_yticks(place, table["given"])
        axis.set_xlim(0, 1.45 * table["high"].fillna(table["value"]).max())
        axis.set_xlabel("spread of continuations (cm)")
        axis.set_title(title)
        axis.grid(axis="y", visible=False)
    axes[0, 0].invert_yaxis()
    return figure


@styled
def answers_against_sigma(table: pd.DataFrame):
    """Draw error and spread of models' clean estimates against noise, beside real continuations.

    Args:
      table: from `posterior.posterior_table`, with at least one model; a panel for each.
    """
    models = [name for name in table["model"].unique() if name != "real"]
    across = min(3, len(models))
    down = -(-len(models) // across)
    figure, axes = new_figure(
        9.0, 0.6 + 2.8 * down, down, across, sharex=True, sharey=True, squeeze=False
    )
    real = table[table["model"] == "real"].iloc[-1]
    for axis in axes.flat[len(models) :]:
        axis.axis("off")
    for axis, model in zip(axes.flat, models, strict=False):
        color = model_style(model).color
        looks = {"error": ("o", "-", color), "answer spread": ("s", "--", PALETTE["vermilion"])}
        for quantity, (marker, line, tone) in looks.items():
            rows = table[(table["model"] == model) & (table["quantity"] == quantity)]
            axis.fill_between(rows["sigma"], rows["low"], rows["high"], color=tone, alpha=0.18,
                              linewidth=0)  # fmt: skip
            axis.plot(rows["sigma"], rows["value"], marker=marker, linestyle=line, color=tone,
                      markersize=4, label=quantity)  # fmt: skip
        axis.axhspan(real["low"], real["high"], color="#E6E6E6", linewidth=0, zorder=0)
        axis.axhline(real["value"], color=PALETTE["black"], linewidth=1.3, linestyle=":",
                     label="real continuations")  # fmt: skip
        axis.set_xscale("log")
        axis.set_ylim(bottom=0)
        axis.set_title(model)
    for axis in axes.flat[max(0, len(models) - across) : len(models)]:
        axis.set_xlabel("noise level σ")
        axis.tick_params(labelbottom=True)
    for axis in axes[:, 0]:
        axis.set_ylabel("joints relative\nto the root (cm)")
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside upper center", ncols=3)
    return figure


# ---------------------------------------------------------------------------------- the fork

_SIDES = {"left": PALETTE["purple"], "right": PALETTE["orange"], "wall": PALETTE["vermilion"]}


def _ground(axis, fork: Fork) -> None:
    """Make an axis a view from above on a fork, its wall drawn."""
    axis.plot([-fork.wall, fork.wall], [0, 0], color=PALETTE["black"], linewidth=5,
              solid_capstyle="butt", zorder=4)  # fmt: skip
    reach = 1.25 * fork.side
    axis.set_xlim(reach, -reach)  # +X is the walker's left
    axis.set_ylim(-1.12 * fork.reach, 1.12 * fork.reach)
    axis.set_aspect("equal")
    axis.grid(visible=False)


def _draw_paths(axis, fork: Fork, paths, **line) -> None:
    """Draw paths in the colour of what becomes of them; those that hit the wall lie on top."""
    place = crossing(paths)
    for path, at in zip(np.asarray(paths), place, strict=True):
        hit = not abs(at) >= fork.wall  # also one that never crosses
        color = _SIDES["wall"] if hit else _SIDES["left" if at > 0 else "right"]
        style = {"color": color, "linewidth": 1.0, "alpha": 0.75, "zorder": 3 if hit else 2}
        axis.plot(*path.T, **{**style, "linestyle": "--" if hit else "-", **line})


def _side_handles(axis) -> None:
    """Give an axis empty lines for a legend of outcomes."""
    for name, label in (("left", "passes left"), ("right", "passes right"), ("wall", "hits")):
        axis.plot([], [], color=_SIDES[name], linestyle="--" if name == "wall" else "-",
                  linewidth=1.6, label=label)  # fmt: skip


@styled
def fork_plan(fork: Fork, paths):
    """Draw real paths of a fork from above, its wall, and the mean of all.

    Args:
      fork: the data's plan.
      paths: [B, T, 2], metres.
    """
    figure, axis = new_figure(6.6, 3.6)
    _ground(axis, fork)
    _draw_paths(axis, fork, paths)
    middle = np.mean(fork.mean_paths, axis=0)
    axis.plot(*middle.T, color=PALETTE["black"], linewidth=2.0, linestyle=(0, (4, 2)), zorder=5)
    _side_handles(axis)
    axis.plot([], [], color=PALETTE["black"], linestyle=(0, (4, 2)), label="mean of all paths")
    axis.plot([], [], color=PALETTE["black"], linewidth=5, label="wall")
    axis.set_xlabel("sideways (m), left is left")
    axis.set_ylabel("ahead (m)")
    handles, labels = axis.get_legend_handles_labels()
    kept = [number for number, label in enumerate(labels) if label != "hits"]
    axis.legend([handles[k] for k in kept], [labels[k] for k in kept], loc="center left",
                bbox_to_anchor=(1.02, 0.5))  # fmt: skip
    return figure


@styled
def outcome_grid(fork: Fork, rows: Mapping[str, Mapping[str, np.ndarray]]):
    """Draw sampled paths, a row for each model and a column for each way to sample.

    Args:
      fork: the data's plan.
      rows: model -> {title of the column: paths [B, T, 2]}, the same titles in all rows.
    """
    titles = list(next(iter(rows.values())))
    figure, axes = new_figure(
        1.55 + 1.45 * len(titles), 0.7 + 1.55 * len(rows), len(rows), len(titles),
        sharex=True, sharey=True, squeeze=False,
    )  # fmt: skip
    for line, (model, columns) in zip(axes, rows.items(), strict=True):
        for axis, title in zip(line, titles, strict=True):
            _ground(axis, fork)
            _draw_paths(axis, fork, columns[title])
            axis.set_xticks([-1, 0, 1])
            axis.set_yticks([-2, 0, 2])
        line[0].set_ylabel(f"{model}\nahead (m)", fontsize=9)
    for axis, title in zip(axes[0], titles, strict=True):
        axis.set_title(title, fontsize=10)
    for axis in axes[-1]:
        axis.set_xlabel("sideways (m)", fontsize=9)
    _side_handles(axes[0, 0])
    handles = axes[0, 0].get_legend_handles_labels()
    figure.legend(*handles, loc="outside lower center", ncols=3)
    return figure


_INPUTS = {
    "exact": (PALETTE["black"], "o", "--"),
    "c_in": (PALETTE["purple"], "s", "-"),
    "raw": (PALETTE["orange"], "D", "-"),
}


@styled
def wall_shares(table: pd.DataFrame):
    """Draw the share of paths that hit the wall against the number of steps.

    Args:
      table: columns noise (a panel each), input ("exact", "c_in" or "raw"), steps, told, wall.
    """
    noises = list(dict.fromkeys(table["noise"]))
    figure, axes = new_figure(8.4, 3.4, 1, len(noises), sharey=True, squeeze=False)
    for axis, noise in zip(axes[0], noises, strict=True):
        mine = table[table["noise"] == noise]
        for name, rows in mine[~mine["told"]].groupby("input", sort=False):
            color, marker, line = _INPUTS[name]
            label = "exact denoiser" if name == "exact" else f"trained, {name}"
            axis.plot(rows["steps"], 100 * rows["wall"], marker=marker, linestyle=line, color=color,
                      label=label, zorder=4 if name == "exact" else 3)  # fmt: skip
        told = mine[mine["told"]].groupby("steps")["wall"].max()
        axis.plot(told.index, 100 * told, "x:", color=PALETTE["green"], markersize=7,
                  label="side told, worst of all", zorder=5, clip_on=False)  # fmt: skip
        axis.set_xscale("log", base=2)
        counts = sorted(mine["steps"].unique())
        axis.set_xticks(counts, counts)
        axis.set_ylim(-4, 106)
        axis.set_title(noise)
        axis.set_xlabel("steps N")
    axes[0, 0].set_ylabel("paths that hit the wall (%)")
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside upper center", ncols=4)
    return figure


@styled
def errors_beside_exact(table: pd.DataFrame, blind: float):
    """Draw the error of clean estimates against noise, trained ones beside the exact one.

    Args:
      table: columns noise (a panel each), input ("exact", "c_in" or "raw"), sigma, x0_error.
      blind: error of a network that ignores its noisy input, metres.
    """
    noises = list(dict.fromkeys(table["noise"]))
    figure, axes = new_figure(8.4, 3.4, 1, len(noises), sharey=True, squeeze=False)
    for axis, noise in zip(axes[0], noises, strict=True):
        for name, rows in table[table["noise"] == noise].groupby("input", sort=False):
            color, marker, line = _INPUTS[name]
            label = "exact denoiser" if name == "exact" else f"trained, {name}"
            axis.plot(rows["sigma"], rows["x0_error"], marker=marker, linestyle=line, color=color,
                      markersize=4.5, label=label, zorder=4 if name == "exact" else 3)  # fmt: skip
        axis.axhline(blind, color=PALETTE["grey"], linestyle=":", label="ignores its input",
                     zorder=1)  # fmt: skip
        axis.set_xscale("log")
        axis.set_ylim(0, 1.35 * blind)
        axis.set_title(noise)
        axis.set_xlabel("noise level σ")
    axes[0, 0].set_ylabel("error of the estimate (m)")
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside upper center", ncols=4)
    return figure
