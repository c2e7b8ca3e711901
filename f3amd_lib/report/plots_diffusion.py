"""Figures of the sampler notebook; each function draws numbers and computes nothing new."""

from __future__ import annotations

import itertools
from collections.abc import Mapping

import numpy as np
import pandas as pd

from f3amd_lib.diffusion.schedules import sigma_from_alpha_bar, sigma_from_log_snr
from f3amd_lib.report.figures import PALETTE, new_figure
from f3amd_lib.report.plots import shades, styled

__all__ = [
    "densities",
    "denoiser_curves",
    "schedule_lines",
    "step_positions",
    "sample_paths",
    "flow_and_steps",
    "vector_fields",
    "convergence_figure",
    "fresh_noise_walks",
    "spread_left_figure",
    "collapse_figure",
    "sample_histograms",
    "input_scaling_figure",
]

_SAMPLER_LOOKS = {
    "DDIM": (PALETTE["purple"], "o"),
    "Euler": (PALETTE["purple"], "o"),
    "Heun": (PALETTE["vermilion"], "s"),
    "DDPM": (PALETTE["green"], "D"),
}
"""Colour and marker of each sampler; DDIM and Euler are one sampler."""


@styled
def densities(x, rows: Mapping[str, Mapping[float, np.ndarray]]):
    """Draw densities of noisy data, a panel for each data set, a curve for each noise level.

    Args:
      x: points, [P].
      rows: title -> {sigma: density [P]}.
    """
    figure, axes = new_figure(8.2, 3.1, 1, len(rows), sharex=True, squeeze=False)
    for axis, (title, curves) in zip(axes[0], rows.items(), strict=True):
        for (sigma, density), shade in zip(curves.items(), shades(len(curves)), strict=True):
            axis.plot(x, density, color=shade, label=f"σ = {sigma:g}")
        axis.set_title(title)
        axis.set_xlabel("x")
    axes[0, 0].set_ylabel("density")
    axes[0, -1].legend()
    return figure


@styled
def denoiser_curves(x, denoised: Mapping[float, np.ndarray], scores: Mapping[float, np.ndarray]):
    """Draw denoiser and score against x, a curve for each noise level; values [P]."""
    figure, (left, right) = new_figure(8.2, 3.3, 1, 2)
    for axis, curves in ((left, denoised), (right, scores)):
        for (sigma, values), shade in zip(curves.items(), shades(len(curves)), strict=True):
            axis.plot(x, values, color=shade, label=f"σ = {sigma:g}")
        axis.set_xlabel("noisy x")
    left.plot(x, x, color=PALETTE["grey"], linestyle=":", label="x itself")
    left.set_ylim(-1.9, 1.9)
    left.set_title("denoiser D(x, σ)")
    left.set_ylabel("clean estimate")
    left.legend(loc="lower right", fontsize=8)
    right.set_title("σ² × score = D − x")
    right.set_ylabel("push")
    right.axhline(0, color=PALETTE["grey"], linewidth=0.8)
    return figure


@styled
def schedule_lines(schedules: Mapping[str, tuple[np.ndarray, np.ndarray]]):
    """Draw noise level against schedule time, on one axis with three labels.

    Args:
      schedules: name -> (schedule time, sigma), [P] each. Few points are drawn as points, many as
        a line.
    """
    figure, axis = new_figure(8.2, 3.9)
    looks = itertools.cycle(zip(("purple", "green", "vermilion", "orange"), "osD^", strict=True))
    for (name, (time, sigmas)), (color, marker) in zip(schedules.items(), looks, strict=False):
        few = len(time) <= 32
        axis.plot(
            time, sigmas, color=PALETTE[color], label=name, linewidth=0.9 if few else 2.6,
            marker=marker if few else "", linestyle=":" if few else "-", zorder=3 if few else 2,
        )  # fmt: skip
    axis.set_yscale("log")
    axis.set_ylim(0.006, 400)
    axis.set_xlim(-0.03, 1.02)
    axis.set_xlabel("schedule time t, from noise alone (0) to clean (1)")
    axis.set_ylabel("noise level σ")
    axis.legend(loc="lower left")
    axis.axhline(1.0, color=PALETTE["grey"], linewidth=0.9, linestyle="--", zorder=1)
    axis.annotate("signal = noise", (0.01, 1.0), (0, -11), textcoords="offset points", fontsize=9)
    shares = np.array([1e-4, 0.01, 0.1, 0.5, 0.9, 0.99, 0.9999])
    ratios = np.array([-9, -6, -3, 0, 3, 6, 9])
    other_names = (
        ("signal share ᾱ", sigma_from_alpha_bar(shares), [f"{share:g}" for share in shares]),
        ("log SNR", sigma_from_log_snr(ratios), [f"{ratio}".replace("-", "−") for ratio in ratios]),
    )
    for place, (title, sigmas, labels) in enumerate(other_names):
        other = axis.twinx()
        other.set_yscale("log")
        other.set_ylim(axis.get_ylim())
        other.set_yticks(sigmas, labels)
        other.set_yticks([], minor=True)
        other.grid(visible=False)
        other.spines["right"].set_visible(True)
        other.spines["right"].set_position(("outward", 66 * place))
        other.set_ylabel(title)
    return figure


@styled
def step_positions(
    grids: Mapping[str, Mapping[int, np.ndarray]], levels: Mapping[str, np.ndarray] | None = None
):
    """Draw where N-step grids evaluate the network, a panel for each way to place them.

    Args:
      grids: title -> {N: noise levels [N], without the final 0}.
      levels: title -> the only noise levels that there are, [K], where a schedule has but few.
    """
    figure, axes = new_figure(9.0, 2.7, 1, len(grids), sharey=True, squeeze=False)
    for axis, (title, by_steps) in zip(axes[0], grids.items(), strict=True):
        for row, sigmas in enumerate(by_steps.values()):
            axis.plot(sigmas, np.full(len(sigmas), row), "o-", color=PALETTE["purple"],
                      linewidth=0.8)  # fmt: skip
        if levels and title in levels:
            axis.vlines(levels[title], -0.6, len(by_steps) - 0.4, color=PALETTE["grey"],
                        linewidth=0.8, linestyle=":", zorder=1)  # fmt: skip
        axis.set_yticks(range(len(by_steps)), [f"N = {steps}" for steps in by_steps])
        axis.set_xscale("log")
        axis.set_xlim(300, 0.005)
        axis.set_ylim(-0.6, len(by_steps) - 0.4)
        axis.set_title(title, fontsize=10)
        axis.set_xlabel("noise level σ")
    return figure


@styled
def sample_paths(sigmas, variance_exploding, variance_preserving):
    """Draw sampling paths in both coordinates, and laid over each other after rescaling.

    Args:
      sigmas: noise levels, [N], the last above 0.
      variance_exploding: states x, [N, P].
      variance_preserving: states z, [N, P].
    """
    figure, axes = new_figure(9.0, 3.3, 1, 3)
    level = np.asarray(sigmas)
    scale = np.sqrt(1.0 + level**2)[:, None]
    axes[0].plot(level, variance_exploding, color=PALETTE["purple"], linewidth=1.2)
    axes[0].set_yscale("symlog", linthresh=2)
    axes[0].set_title("VE state x")
    axes[1].plot(level, variance_preserving, color=PALETTE["orange"], linewidth=1.2)
    axes[1].set_title("VP state z")
    axes[2].plot(level, variance_exploding / scale, color=PALETTE["purple"], linewidth=3.4)
    axes[2].plot(level, variance_preserving, color=PALETTE["orange"], linewidth=1.2,
                 linestyle="--")  # fmt: skip
    axes[2].plot([], [], color=PALETTE["purple"], linewidth=3.4, label="x / √(1+σ²)")
    axes[2].plot([], [], "--", color=PALETTE["orange"], linewidth=1.2, label="z")
    axes[2].set_ylim(top=axes[2].get_ylim()[1] + 1.2)
    axes[2].legend(loc="upper right")
    axes[2].set_title("laid over each other")
    for axis in axes:
        axis.set_xscale("log")
        axis.set_xlim(level[0], level[-1])
        axis.set_xlabel("σ, sampling runs to the right")
    return figure


@styled
def flow_and_steps(sigmas, exact, grid, steps, title: str):
    """Draw exact flow lines and the chords of a coarse sampler, as x / sqrt(1 + sigma^2).

    Args:
      sigmas: fine noise levels, [F]; exact: states on them, [F, P].
      grid: coarse noise levels, [N]; steps: states on them, [N, P].
      title: of the panel.
    """
    figure, axis = new_figure(7.0, 3.5)
    axis.plot(sigmas, exact / np.sqrt(1 + sigmas**2)[:, None], color="#BDBDBD", linewidth=1.2)
    axis.plot(grid, steps / np.sqrt(1 + grid**2)[:, None], "o-", color=PALETTE["purple"],
              linewidth=1.3, markersize=4)  # fmt: skip
    axis.plot([], [], color="#BDBDBD", label="exact flow")
    axis.plot([], [], "o-", color=PALETTE["purple"], label=f"{len(grid)} points, DDIM")
    axis.set_xscale("log")
    axis.set_xlim(sigmas[0] * 1.15, sigmas[-1] / 1.15)
    axis.set_xlabel("σ, sampling runs to the right")
    axis.set_ylabel("x / √(1+σ²)")
    axis.set_title(title)
    axis.set_ylim(top=axis.get_ylim()[1] + 0.6)
    axis.legend(loc="upper left", ncols=2)
    return figure


@styled
def vector_fields(points, fields: Mapping[float, np.ndarray], modes, samples):
    """Draw where a denoiser pulls points of the plane, a panel for each noise level.

    Args:
      points: [P, 2]; fields: {sigma: D(x, sigma) - x, [P, 2]}; modes: [K, 2].
      samples: data points to show behind, [S, 2].
    """
    figure, axes = new_figure(8.8, 3.2, 1, len(fields), sharey=True, squeeze=False)
    for axis, (sigma, field) in zip(axes[0], fields.items(), strict=True):
        axis.plot(*samples.T, ".", color=PALETTE["sky"], markersize=2.0)
        axis.quiver(
            *points.T, *field.T, color=PALETTE["purple"], angles="xy", scale_units="xy",
            scale=4.5, width=0.006,
        )  # fmt: skip
        axis.plot(*modes.T, "*", color=PALETTE["vermilion"], markersize=14, zorder=5,
                  markeredgecolor="white")  # fmt: skip
        axis.set_title(f"σ = {sigma:g}")
        axis.set_aspect("equal")
        axis.grid(visible=False)
        axis.set_xlabel("x₁")
        axis.set_xticks([-2, 0, 2])
    axes[0, 0].set_ylabel("x₂")
    return figure


@styled
def collapse_figure(table: pd.DataFrame, truth: float):
    """Draw the mean size of samples against the number of steps for each form of the update.

    Args:
      table: columns form, steps, mean_abs.
      truth: mean |x| of the data.
    """
    figure, axis = new_figure(6.4, 3.4)
    looks = zip(table.groupby("form", sort=False), ("purple", "vermilion"), "os", strict=True)
    for (form, rows), color, marker in looks:
        axis.plot(rows["steps"], rows["mean_abs"], marker=marker, color=PALETTE[color], label=form)
    axis.axhline(truth, color=PALETTE["black"], linestyle="--", linewidth=1.2, label="data")
    axis.set_xscale("log", base=2)
    axis.set_xticks(sorted(table["steps"].unique()), sorted(table["steps"].unique()))
    axis.set_xlabel("steps N")
    axis.set_ylabel("mean |x| of the samples")
    axis.legend()
    return figure


@styled
def convergence_figure(table: pd.DataFrame, orders: Mapping[tuple[str, str], float]):
    """Draw the error against steps and against network evaluations, on log-log axes.

    Args:
      table: columns sampler, data, steps, evaluations, error.
      orders: (sampler, data) -> fitted order.
    """
    figure, axes = new_figure(8.8, 4.0, 1, 2, sharey=True)
    first_data = table["data"].iloc[0]
    for axis, column in zip(axes, ("steps", "evaluations"), strict=True):
        for (sampler, data), rows in table.groupby(["sampler", "data"], sort=False):
            color, marker = _SAMPLER_LOOKS[sampler]
            axis.plot(
                rows[column], rows["error"], marker=marker, color=color,
                linestyle="-" if data == first_data else ":",
                markerfacecolor=color if data == first_data else "white",
                label=f"{sampler}, {data}: order {orders[sampler, data]:.2f}",
            )  # fmt: skip
        axis.set_xscale("log", base=2)
        axis.set_yscale("log")
        powers = np.log2([table[column].min(), table[column].max()]).round().astype(int)
        ticks = 2 ** np.arange(powers[0], powers[1] + 1)
        axis.set_xticks(ticks, ticks)
        axis.axvline(8, color=PALETTE["black"], linewidth=0.9, linestyle="--", zorder=1)
        axis.annotate("the paper's 8", (8, table["error"].min()), (5, 0), fontsize=9,
                      textcoords="offset points")  # fmt: skip
    axes[0].set_xlabel("steps N")
    axes[1].set_xlabel("network evaluations (Heun: 2N − 1)")
    axes[0].set_ylabel("mean distance from the exact answer")
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside upper center", ncols=2)
    return figure


@styled
def fresh_noise_walks(sigmas, walks: Mapping[str, np.ndarray], modes, width: float):
    """Draw walks that share their first state, a panel for each sampler, as x / sqrt(1 + sigma^2).

    Args:
      sigmas: noise levels, [N + 1], the last may be 0.
      walks: title -> states x, [N + 1, W]; colours tell on which side of the modes' mean a walk
        ends.
      modes: centres of the data, [K].
      width: deviation of each mode.
    """
    figure, axes = new_figure(8.8, 3.4, 1, len(walks), sharey=True, squeeze=False)
    levels = np.asarray(sigmas)
    place = np.arange(len(levels))
    labels = [f"{level:.0f}" if level >= 10 else f"{level:.2g}" for level in levels]
    for axis, (title, states) in zip(axes[0], walks.items(), strict=True):
        for mode in modes:
            axis.axhspan(mode - width, mode + width, color="#E6E6E6", linewidth=0, zorder=0)
        scaled = states / np.sqrt(1.0 + levels**2)[:, None]
        for walk in scaled.T:
            color = PALETTE["purple" if walk[-1] > np.mean(modes) else "orange"]
            axis.plot(place, walk, color=color, linewidth=1.2)
            axis.plot(place[-1], walk[-1], "o", color=color, markersize=4)
        axis.plot(place[0], scaled[0, 0], "o", color=PALETTE["black"], markersize=6, zorder=5)
        axis.set_title(title)
        axis.set_xticks(place, labels)
        axis.set_xlabel("noise level σ")
        axis.grid(axis="x", visible=False)
    axes[0, 0].set_ylabel("x / √(1+σ²)")
    return figure


@styled
def spread_left_figure(shares: Mapping[str, pd.DataFrame]):
    """Draw how much of the data's variance the samples have, a panel for each choice of levels.

    Args:
      shares: title -> table with columns sampler, steps, exact (a line) and measured (marks).
    """
    figure, axes = new_figure(9.0, 3.3, 1, len(shares), sharey=True, squeeze=False)
    for axis, (title, table) in zip(axes[0], shares.items(), strict=True):
        for sampler, rows in table.groupby("sampler", sort=False):
            color, marker = _SAMPLER_LOOKS[sampler]
            axis.plot(rows["steps"], rows["exact"], color=color)
            axis.plot(rows["steps"], rows["measured"], marker, color=color, markersize=6)
            axis.plot([], [], color=color, marker=marker, markersize=6, label=sampler)
        axis.axhline(1.0, color=PALETTE["black"], linestyle="--", linewidth=1.2)
        axis.set_xscale("log", base=2)
        axis.set_xticks(sorted(table["steps"].unique()), sorted(table["steps"].unique()))
        axis.set_ylim(-0.04, 1.1)
        axis.set_title(title, fontsize=10)
        axis.set_xlabel("steps N")
    axes[0, 0].annotate("data", (1, 1.0), (0, 3), textcoords="offset points", fontsize=9)
    axes[0, 0].set_ylabel("share of the data's variance")
    axes[0, -1].legend(loc="lower right")
    return figure


@styled
def sample_histograms(data, samples: Mapping[str, np.ndarray]):
    """Draw histograms of samples over that of the data, a panel each; arrays [P]."""
    figure, axes = new_figure(8.8, 2.8, 1, len(samples), sharex=True, squeeze=False)
    bins = np.linspace(-1.6, 1.6, 65)
    for axis, (title, values) in zip(axes[0], samples.items(), strict=True):
        weights = np.full(len(values), 1 / len(values))
        axis.hist(data, bins, weights=np.full(len(data), 1 / len(data)), color="#CFCFCF",
                  label="data")  # fmt: skip
        axis.hist(np.clip(values, -1.6, 1.6), bins, weights=weights, histtype="step",
                  color=PALETTE["purple"], linewidth=1.6, label="samples")  # fmt: skip
        axis.set_title(title)
        axis.set_xlabel("x")
    axes[0, 0].set_ylabel("share per bin")
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside upper right", ncols=2)
    return figure


@styled
def input_scaling_figure(sigmas, deviations: Mapping[str, np.ndarray], inputs):
    """Draw the spread of a network's input against the noise level, and its histogram at the top.

    Args:
      sigmas: [S]; deviations: label -> deviation of the input, [S].
      inputs: label -> values of the input at the highest noise level, [P].
    """
    figure, axes = new_figure(8.8, 3.0, 1, 3, width_ratios=[1.4, 1.0, 1.0])
    for (label, values), color in zip(deviations.items(), ("vermilion", "purple"), strict=True):
        axes[0].plot(sigmas, values, color=PALETTE[color], label=label)
    axes[0].set_xscale("log")
    axes[0].set_yscale("log")
    axes[0].set_xlabel("noise level σ")
    axes[0].set_title("deviation of the input")
    axes[0].legend()
    for axis, (label, values), color in zip(
        axes[1:], inputs.items(), ("vermilion", "purple"), strict=True
    ):
        axis.hist(values, bins=60, density=True, color=PALETTE[color])
        axis.set_title(f"{label}, σ = {sigmas[-1]:g}", fontsize=10)
        axis.set_xlabel("input value")
    return figure
