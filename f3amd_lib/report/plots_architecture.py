"""Figures of the notebooks on networks; each function draws numbers and computes nothing new."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd

from f3amd_lib.report.figures import (
    PALETTE,
    new_figure,
)
from f3amd_lib.report.plots import shades, styled

__all__ = [
    "spectral_kernel",
    "kept_modes",
    "influence_maps",
    "film_gate",
    "attention_maps",
    "parameter_bars",
    "prediction_error",
]


@styled
def spectral_kernel(weights, kernel, signal, response):
    """Draw a spectral layer of one channel: weights on modes, kernel in time, what it does.

    Args:
      weights: complex, [m]; kernel: the same in time, [T]; signal, response: [T].
    """
    figure, axes = new_figure(8.8, 2.9, 1, 3)
    mode = np.arange(len(weights))
    axes[0].bar(mode, np.abs(weights), color=PALETTE["purple"])
    axes[0].set_title("weights |W| on modes")
    axes[0].set_xlabel("mode (turns a window)")
    frame = np.arange(len(kernel))
    axes[1].plot(frame, kernel, ".-", color=PALETTE["green"])
    axes[1].set_title("the same as a kernel")
    axes[1].set_xlabel("lag (frames, circular)")
    axes[2].plot(frame, signal, color=PALETTE["grey"], label="in")
    axes[2].plot(frame, response, color=PALETTE["purple"], label="out")
    axes[2].set_title("what it does to a signal")
    axes[2].set_xlabel("frame")
    axes[2].legend()
    return figure


@styled
def kept_modes(signal, cut: Mapping[int, np.ndarray], label: str):
    """Draw a signal [T] and what is left of it when only the first m modes are kept."""
    figure, axes = new_figure(8.8, 2.6, 1, len(cut), sharey=True, squeeze=False)
    for axis, (modes, values) in zip(axes[0], cut.items(), strict=True):
        axis.plot(signal, color=PALETTE["grey"], linewidth=3.0, label="in")
        axis.plot(values, color=PALETTE["purple"], linewidth=1.6, label="kept")
        axis.set_title(f"m = {modes}")
        axis.set_xlabel("frame")
    axes[0, 0].set_ylabel(label)
    axes[0, 0].legend(fontsize=8)
    return figure


def _map_row(maps: Mapping[str, np.ndarray], height: float, label: str, **image_options):
    """Draw maps side by side under one colour scale from 0; return the figure and its axes."""
    figure, axes = new_figure(8.8, height, 1, len(maps), sharey=True, squeeze=False)
    highest = max(values.max() for values in maps.values())
    for axis, (title, values) in zip(axes[0], maps.items(), strict=True):
        image = axis.imshow(values, cmap="viridis", vmin=0.0, vmax=highest, **image_options)
        axis.set_title(title)
        axis.grid(visible=False)
    figure.colorbar(image, ax=list(axes[0]), label=label, shrink=0.85)
    return figure, list(axes[0])


@styled
def influence_maps(maps: Mapping[str, np.ndarray]):
    """Draw how strongly each input frame reaches each output frame, a panel for each branch.

    Args:
      maps: title -> [T out, T in], not negative.
    """
    figure, axes = _map_row(maps, 3.2, "size of the derivative")
    for axis in axes:
        axis.set_xlabel("input frame")
    axes[0].set_ylabel("output frame")
    return figure


@styled
def film_gate(gamma, gate, z_base, z_tilde, gammas: Sequence[float]):
    """Draw the gate of Eq. 6 against gamma, and a signal under a few settings of it.

    Args:
      gamma, gate: [P]; z_base: [T]; z_tilde: one signal [T] for each of `gammas`.
    """
    figure, (left, right) = new_figure(8.2, 3.0, 1, 2)
    left.plot(gamma, gate, color=PALETTE["purple"], linewidth=2.4)
    left.axhline(1, color=PALETTE["grey"], linewidth=0.8)
    left.set_xlabel("γ")
    left.set_title("gate 1 + tanh γ")
    left.set_ylim(-0.1, 2.1)
    right.plot(z_base, color=PALETTE["black"], linewidth=3, alpha=0.35, label="z base")
    for value, signal, shade in zip(gammas, z_tilde, shades(len(gammas)), strict=True):
        right.plot(signal, color=shade, label=f"γ = {value:g}")
    right.set_title("a channel behind the gate (β = 0)")
    right.set_xlabel("frame")
    right.legend(fontsize=8, loc="upper right", ncols=2)
    right.set_ylim(top=1.75 * right.get_ylim()[1])
    return figure


@styled
def attention_maps(maps: Mapping[str, np.ndarray], num_history: int, window: int):
    """Draw attention of each future frame (row) to the context tokens, [T, H + T + 1] each."""
    figure, axes = _map_row(maps, 3.5, "attention weight", aspect="auto")
    for axis in axes:
        for edge in (num_history - 0.5, num_history + window - 0.5):
            axis.axvline(edge, color="white", linewidth=1.5)
        axis.set_xticks(
            [(num_history - 1) / 2, num_history + (window - 1) / 2, num_history + window],
            ["history", "path", "style"],
        )
        axis.set_xlabel("context token")
    axes[0].set_ylabel("future frame that asks")
    return figure


@styled
def parameter_bars(table: pd.DataFrame):
    """Draw learned numbers by part of the network, a bar for each model.

    Args:
      table: columns model, part, parameters.
    """
    figure, axis = new_figure(8.2, 3.2)
    wide = table.pivot(index="model", columns="part", values="parameters")
    wide = wide.loc[table["model"].unique()[::-1], table["part"].unique()] / 1e6
    left = np.zeros(len(wide))
    colors = ("purple", "sky", "green", "orange", "vermilion")
    for part, color in zip(wide.columns, colors, strict=False):
        axis.barh(wide.index, wide[part], left=left, color=PALETTE[color], label=part)
        left += wide[part].to_numpy()
    for row, total in enumerate(left):
        axis.text(total + 0.05, row, f"{total:.2f} M", va="center", fontsize=9)
    axis.set_xlabel("learned numbers (millions)")
    axis.set_xlim(0, 1.15 * left.max())
    axis.grid(axis="y", visible=False)
    axis.legend(loc="upper right")
    return figure


@styled
def prediction_error(sigmas, errors: Mapping[str, np.ndarray]):
    """Draw the error of the clean estimate against the noise level for kinds of prediction, [S]."""
    figure, axis = new_figure(6.6, 3.3)
    for (label, values), color, line in zip(
        errors.items(), ("purple", "vermilion", "orange"), ("-", "--", "-."), strict=False
    ):
        axis.plot(sigmas, values, color=PALETTE[color], linestyle=line, label=label)
    axis.set_xscale("log")
    axis.set_yscale("log")
    axis.set_xlabel("noise level σ")
    axis.set_ylabel("error of the clean estimate")
    axis.legend()
    return figure
