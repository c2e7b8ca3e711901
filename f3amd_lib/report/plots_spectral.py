"""Figures of the notebook on spectra and conditions; each draws numbers and computes nothing."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pandas as pd

from f3amd_lib.report.figures import PALETTE, new_figure
from f3amd_lib.report.plots import ORDER, shades, styled

__all__ = [
    "layer_gallery",
    "spectrum_lines",
    "mode_errors",
    "seam_paths",
    "ramp_decay",
    "wrapped_filters",
    "filter_families",
    "channel_shares",
    "delayed_pulses",
]

_GROUPS = {
    "root": ("black", "o", "-"),
    "toes": ("vermilion", "s", "--"),
    "legs": ("purple", "D", "-"),
    "arms": ("green", "^", "-."),
    "trunk and head": ("orange", "v", ":"),
}
"""Body part -> colour, marker and line, in the order of the legend."""

_BAND_COLORS = {"fourier": "purple", "fourier beside a line": "orange", "cosine": "green"}
_BAND_TITLES = {
    "fourier": "Fourier",
    "fourier beside a line": "Fourier beside a line",
    "cosine": "cosine",
}


@styled
def layer_gallery(
    layers: Mapping[str, tuple[np.ndarray, np.ndarray, np.ndarray]], pulse, fps: float = 30.0
):
    """Draw spectral layers of one channel in three ways, a column for each layer.

    Args:
      layers: title -> (gain at each mode [m], circular kernel [T], answer to the pulse [T]).
      pulse: [T].
      fps: frames a second.
    """
    figure, axes = new_figure(9.2, 5.4, 3, len(layers), sharey="row", squeeze=False)
    num_frames = len(pulse)
    lag = np.arange(num_frames) - num_frames // 2
    for column, (title, (gain, kernel, answer)) in zip(axes.T, layers.items(), strict=True):
        column[0].plot(fps / num_frames * np.arange(len(gain)), gain, ".-", color=PALETTE["purple"])
        column[0].set_xlim(-0.02 * fps, 0.52 * fps)
        column[0].set_title(title, fontsize=10)
        column[0].set_xlabel("frequency (Hz)")
        column[1].plot(lag, np.roll(kernel, num_frames // 2), ".-", color=PALETTE["green"])
        column[1].set_xlabel("lag (frames)")
        column[2].plot(pulse, color=PALETTE["grey"], linewidth=4.0, alpha=0.6, label="in")
        column[2].plot(answer, color=PALETTE["vermilion"], label="out")
        column[2].set_xlabel("frame")
    for axis, label in zip(axes[:, 0], ("gain |W|", "kernel", "pulse"), strict=True):
        axis.set_ylabel(label)
    axes[2, 0].legend(fontsize=8, loc="upper left")
    return figure


def _group_lines(axis, rows: pd.DataFrame, x: str, y: str) -> None:
    """Draw a line for each body part that a table has."""
    for group, (color, marker, line) in _GROUPS.items():
        part = rows[rows["group"] == group]
        if len(part):
            axis.plot(part[x], part[y], marker=marker, linestyle=line, color=PALETTE[color],
                      markersize=3.5, linewidth=1.4, label=group)  # fmt: skip


@styled
def spectrum_lines(table: pd.DataFrame, lowest_cm: float = 0.003):
    """Draw how much each body part moves at each frequency, Fourier and cosine.

    Args:
      table: columns band, group, frequency_hz, amplitude_cm; what is constant is left out.
      lowest_cm: where the axis ends.
    """
    figure, axes = new_figure(9.0, 3.5, 1, 2, sharey=True)
    for axis, band in zip(axes, ("fourier", "cosine"), strict=True):
        moving = table[(table["band"] == band) & (table["frequency_hz"] > 0)]
        _group_lines(axis, moving, "frequency_hz", "amplitude_cm")
        axis.set_yscale("log")
        axis.set_title(_BAND_TITLES[band])
        axis.set_xlabel("frequency (Hz)")
    axes[0].set_ylabel("amplitude of a mode (cm)")
    axes[0].set_ylim(bottom=lowest_cm)
    axes[1].legend(loc="upper left", bbox_to_anchor=(1.01, 1.0))
    return figure


@styled
def mode_errors(table: pd.DataFrame, lowest_cm: float = 0.01):
    """Draw how far joints move when m modes are kept, a panel for each band.

    Args:
      table: columns band, num_kept_modes, group, error_cm; errors below the axis are left out.
      lowest_cm: where the axis ends.
    """
    bands = list(table["band"].unique())
    figure, axes = new_figure(9.2, 3.5, 1, len(bands), sharey=True, squeeze=False)
    for axis, band in zip(axes[0], bands, strict=True):
        rows = table[(table["band"] == band) & (table["error_cm"] >= lowest_cm)]
        _group_lines(axis, rows, "num_kept_modes", "error_cm")
        axis.set_yscale("log")
        axis.set_xlim(0, table["num_kept_modes"].max() + 1)
        axis.set_title(_BAND_TITLES[band])
        axis.set_xlabel("kept modes m")
    axes[0, 0].set_ylabel("mean error (cm)")
    axes[0, 0].set_ylim(lowest_cm, 2 * table["error_cm"].max())
    axes[0, -1].legend(loc="upper left", bbox_to_anchor=(1.01, 1.0))
    return figure


@styled
def seam_paths(path, cut: Mapping[str, Mapping[int, np.ndarray]], errors: Mapping[str, np.ndarray]):
    """Draw a walking root cut to a few modes, and where in the window that costs most.

    Args:
      path: distance walked, [T], metres.
      cut: band -> m -> the same with m modes kept, [T].
      errors: band -> mean error at each frame of many windows, [T], cm.
    """
    figure, axes = new_figure(9.2, 3.2, 1, len(cut) + 1)
    for axis in axes[1:-1]:
        axis.sharey(axes[0])
    for axis, (band, by_modes) in zip(axes, cut.items(), strict=False):
        axis.plot(path, color=PALETTE["grey"], linewidth=4.5, alpha=0.6, label="in")
        tones = (PALETTE["orange"], PALETTE["vermilion"], PALETTE["purple"])
        lines = (":", "--", "-")
        for (modes, values), tone, line in zip(by_modes.items(), tones, lines, strict=False):
            axis.plot(values, color=tone, linestyle=line, linewidth=1.5, label=f"m = {modes}")
        axis.set_title(_BAND_TITLES[band])
        axis.set_xlabel("frame")
    axes[0].set_ylabel("distance walked (m)")
    axes[0].legend(fontsize=8, loc="upper left")
    for (band, values), line in zip(errors.items(), ("-", ":", "--"), strict=False):
        axes[-1].plot(values, line, color=PALETTE[_BAND_COLORS[band]], label=_BAND_TITLES[band])
    axes[-1].set_yscale("log")
    axes[-1].set_title("root, all windows")
    axes[-1].set_xlabel("frame")
    axes[-1].set_ylabel("mean error (cm)")
    axes[-1].margins(y=0.35)
    axes[-1].legend(fontsize=8, loc="upper center")
    return figure


@styled
def ramp_decay(table: pd.DataFrame, slopes: Mapping[str, float]):
    """Draw what is left of a straight line against the share of modes kept, on logarithmic axes.

    Args:
      table: columns band, num_kept_modes, error (root mean square, of the line's whole rise).
      slopes: band -> fitted exponent.
    """
    figure, axis = new_figure(6.8, 3.3)
    for (band, rows), marker in zip(table.groupby("band", sort=False), "os", strict=False):
        axis.plot(rows["num_kept_modes"], rows["error"], marker=marker, markersize=4,
                  color=PALETTE[_BAND_COLORS[band]],
                  label=f"{_BAND_TITLES[band]}: exponent {slopes[band]:.2f}")  # fmt: skip
    kept = sorted(table["num_kept_modes"].unique())
    axis.set_xscale("log")
    axis.set_yscale("log")
    axis.set_xticks(kept, [f"{count:g}" for count in kept])
    axis.minorticks_off()
    axis.set_xlabel("kept modes m")
    axis.set_ylabel("error (share of the rise)")
    axis.legend()
    return figure


@styled
def wrapped_filters(maps: Mapping[str, np.ndarray], shares: pd.DataFrame):
    """Draw a filter that does not wrap around, the best that branches make of it, and what is left.

    Args:
      maps: title -> matrix from frames in to frames out, [T, T].
      shares: columns branches, taps, share.
    """
    figure, axes = new_figure(9.4, 3.0, 1, len(maps) + 1, width_ratios=[1] * len(maps) + [1.45])
    highest = max(np.abs(values).max() for values in maps.values())
    for axis, (title, values) in zip(axes, maps.items(), strict=False):
        axis.imshow(values, cmap="Purples", vmin=0.0, vmax=highest)
        axis.set_title(title, fontsize=10)
        axis.set_xlabel("frame in")
        axis.grid(visible=False)
    axes[0].set_ylabel("frame out")
    for (branches, rows), color, marker in zip(
        shares.groupby("branches", sort=False), ("purple", "vermilion"), "os", strict=False
    ):
        axes[-1].plot(rows["taps"], 100 * rows["share"], marker=marker, markersize=4,
                      color=PALETTE[color], label=branches)  # fmt: skip
    axes[-1].set_xlabel("length of the filter (frames)")
    axes[-1].set_ylabel("energy left (%)")
    axes[-1].set_ylim(bottom=0.0)
    axes[-1].legend(fontsize=8)
    return figure


@styled
def filter_families(families: Mapping[str, np.ndarray]):
    """Draw families of filters, a row of a panel for each condition.

    Args:
      families: title -> a circular filter for each condition, [S, T].
    """
    figure, axes = new_figure(9.2, 2.5, 1, len(families), squeeze=False)
    for axis, (title, filters) in zip(axes[0], families.items(), strict=True):
        # Zero is in the middle of the colours; each family has its own scale.
        highest = np.abs(filters).max()
        half = filters.shape[1] // 2
        axis.imshow(
            np.roll(filters, half, axis=1), cmap="PuOr", vmin=-highest, vmax=highest, aspect="auto",
            extent=(-half - 0.5, filters.shape[1] - half - 0.5, len(filters) + 0.5, 0.5),
            interpolation="nearest",
        )  # fmt: skip
        axis.set_title(title, fontsize=10)
        axis.set_xlabel("lag (frames)")
        axis.grid(visible=False)
    axes[0, 0].set_ylabel("condition")
    return figure


@styled
def channel_shares(shares: Mapping[str, np.ndarray], additive: Mapping[str, float]):
    """Draw what is left of families of filters against the channels under FiLM.

    Args:
      shares: family -> share left with 0, 1, ... channels.
      additive: family -> share left where the condition is only added, drawn beside the axis.
    """
    figure, axis = new_figure(7.6, 3.6)
    markers = "os^D"
    for place, ((family, values), color) in enumerate(zip(shares.items(), ORDER, strict=False)):
        axis.plot(np.arange(len(values)), 100 * np.asarray(values), color=PALETTE[color],
                  marker=markers[place % 4], markersize=4, label=family)  # fmt: skip
        axis.plot(-2.0, 100 * additive[family], marker=markers[place % 4], color=PALETTE[color],
                  markersize=7, markerfacecolor="white", markeredgewidth=1.6)  # fmt: skip
    axis.axvline(-1.0, color=PALETTE["grey"], linewidth=0.8)
    longest = max(len(values) for values in shares.values())
    ticks = np.arange(0, longest, 8)
    axis.set_xticks([-2.0, *ticks], ["only\nadded", *(f"{tick}" for tick in ticks)])
    axis.set_xlabel("shared kernels under FiLM")
    axis.set_ylabel("energy of the filters left (%)")
    axis.set_ylim(-3, 103)
    axis.legend()
    return figure


@styled
def delayed_pulses(pulse, answers: Mapping[str, np.ndarray]):
    """Draw what comes out of a delay line, a row for each condition.

    Args:
      pulse: what goes in, [T].
      answers: condition as text -> what comes out, [T].
    """
    figure, axis = new_figure(7.6, 0.9 + 0.42 * (len(answers) + 1))
    rows = {"in": np.asarray(pulse), **answers}
    height = max(np.abs(values).max() for values in rows.values()) / 0.8
    tones = [PALETTE["grey"], *shades(len(answers))]
    for place, (values, tone) in enumerate(zip(rows.values(), tones, strict=True)):
        axis.fill_between(np.arange(len(values)), -place, values / height - place, color=tone,
                          linewidth=1.2, alpha=0.9)  # fmt: skip
    axis.set_yticks(-np.arange(len(rows)), list(rows))
    axis.set_xlabel("frame")
    axis.set_xlim(0, len(pulse) - 1)
    axis.grid(axis="y", visible=False)
    return figure
