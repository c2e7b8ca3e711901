"""Figures of the sampler notebook; each function draws numbers and computes nothing new."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pandas as pd

from f3amd_lib.report.figures import (
    PALETTE,
    new_figure,
)
from f3amd_lib.report.plots import shades, styled

__all__ = [
    "densities",
    "denoiser_curves",
    "schedule_figure",
    "step_positions",
    "sample_paths",
    "flow_and_steps",
    "vector_fields",
    "collapse_figure",
    "convergence_figure",
    "sample_histograms",
    "input_scaling_figure",
]


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
def schedule_figure(t, sigma, alpha_bar, log_snr):
    """Draw noise level, signal share and log signal-to-noise against schedule time, [P] each."""
    figure, axes = new_figure(8.6, 2.9, 1, 3)
    for axis, values, name, color in zip(
        axes,
        (sigma, alpha_bar, log_snr),
        ("noise level σ", "signal share ᾱ = 1/(1+σ²)", "log SNR = −2 log σ"),
        ("purple", "green", "orange"),
        strict=True,
    ):
        axis.plot(t, values, color=PALETTE[color], linewidth=2.4)
        axis.set_title(name)
        axis.set_xlabel("schedule time t")
    axes[0].set_yscale("log")
    axes[1].set_yscale("log")
    return figure


@styled
def step_positions(grids: Mapping[str, Mapping[int, np.ndarray]]):
    """Draw where N-step grids evaluate the network, a panel for each reading of Eq. 9.

    Args:
      grids: reading -> {N: noise levels [N], without the final 0}.
    """
    figure, axes = new_figure(8.6, 2.7, 1, len(grids), sharey=True, squeeze=False)
    for axis, (title, by_steps) in zip(axes[0], grids.items(), strict=True):
        for row, (_, sigmas) in enumerate(by_steps.items()):
            axis.plot(sigmas, np.full(len(sigmas), row), "o-", color=PALETTE["purple"],
                      linewidth=0.8)  # fmt: skip
        axis.set_yticks(range(len(by_steps)), [f"N = {steps}" for steps in by_steps])
        axis.set_xscale("log")
        axis.set_xlim(300, 0.005)
        axis.set_ylim(-0.6, len(by_steps) - 0.4)
        axis.set_title(title)
        axis.set_xlabel("noise level σ, sampling runs to the right")
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
            scale=3.5, width=0.006,
        )  # fmt: skip
        axis.plot(*modes.T, "*", color=PALETTE["vermilion"], markersize=14, zorder=5,
                  markeredgecolor="white")  # fmt: skip
        axis.set_title(f"σ = {sigma:g}")
        axis.set_aspect("equal")
        axis.grid(visible=False)
        axis.set_xlabel("x₁")
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
def convergence_figure(table: pd.DataFrame, orders: Mapping[str, float]):
    """Draw the error against the number of steps on log-log axes with the fitted slope.

    Args:
      table: columns data, steps, error.
      orders: data -> fitted order.
    """
    figure, axis = new_figure(6.4, 3.6)
    looks = zip(table.groupby("data", sort=False), ("purple", "orange"), "os", strict=False)
    for (name, rows), color, marker in looks:
        axis.plot(rows["steps"], rows["error"], marker=marker, color=PALETTE[color],
                  label=f"{name}: order {orders[name]:.2f}")  # fmt: skip
    steps = np.array([rows["steps"].min(), rows["steps"].max()])
    axis.plot(steps, 0.4 * rows["error"].iloc[0] * steps[0] / steps, color=PALETTE["grey"],
              linestyle=":", label="slope −1")  # fmt: skip
    axis.set_xscale("log", base=2)
    axis.set_yscale("log")
    axis.set_xlabel("steps N")
    axis.set_ylabel("mean distance from the exact flow")
    axis.legend()
    return figure


@styled
def sample_histograms(data, samples: Mapping[str, np.ndarray]):
    """Draw histograms of samples over that of the data, a panel each; arrays [P]."""
    figure, axes = new_figure(8.8, 2.6, 1, len(samples), sharex=True, squeeze=False)
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
    axes[0, -1].legend()
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
