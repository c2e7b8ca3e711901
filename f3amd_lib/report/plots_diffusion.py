"""Figures of the sampler notebooks; each function draws numbers and computes nothing new."""

from __future__ import annotations

import io
import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path

import matplotlib
import numpy as np
import pandas as pd
from PIL import Image

from f3amd_lib.diffusion.schedules import sigma_from_alpha_bar, sigma_from_log_snr
from f3amd_lib.report.figures import PALETTE, new_figure, show_figure
from f3amd_lib.report.plots import shades, styled
from f3amd_lib.report.plots_ablations import committed_table

__all__ = [
    "stored_result",
    "densities",
    "denoiser_curves",
    "schedule_lines",
    "step_positions",
    "sample_paths",
    "flow_and_steps",
    "film_frames",
    "keep_film",
    "vector_fields",
    "convergence_figure",
    "fresh_noise_walks",
    "spread_left_figure",
    "sample_histograms",
    "two_updates",
    "collapse_figure",
    "noticing_figure",
    "error_by_sigma",
    "updates_on_models",
    "halving_figure",
]

_SAMPLER_LOOKS = {
    "DDIM": (PALETTE["purple"], "o"),
    "Euler": (PALETTE["purple"], "o"),
    "Heun": (PALETTE["vermilion"], "s"),
    "DDPM": (PALETTE["green"], "D"),
}
"""Colour and marker of each sampler; DDIM and Euler are one sampler."""


def stored_result(dataset: str, name: str, measurement: str) -> tuple[pd.DataFrame | None, str]:
    """Read a stored table of a data set, else that of Bandai, and say where it comes from.

    Args:
      dataset: a name of `profiles.DATASETS`.
      name: of the table, without ending.
      measurement: of `measure.MEASUREMENTS`, which writes it.

    Returns:
      (table or None, a sentence: data, profile, machine, date and credit, or how to measure it).
    """
    found = committed_table(dataset, name) or committed_table("bandai", name)
    if found is None:
        how = f"`make measure MEASURE={measurement} DATA=bandai`"
        return None, f"Not measured yet: `{name}`. {how} measures it."
    table, record = found
    sentence = (
        f"Stored result `{name}`: data {record['dataset']}, profile {record['profile']}, "
        f"{record['cores']} cores ({record['device_platform']}), {record['date_utc'][:10]}. "
        f"{record['dataset_credit'] or ''}"
    )
    return table, sentence.strip()


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
def flow_and_steps(sigmas, exact, grid, steps, title: str, *, places=None, density=None):
    """Draw exact flow lines and the chords of a coarse sampler, as x / sqrt(1 + sigma^2).

    Args:
      sigmas: fine noise levels, [F]; exact: states on them, [F, P].
      grid: coarse noise levels, [N]; steps: states on them, [N, P].
      title: of the panel.
      places: points of the vertical axis, [Y].
      density: of the noisy data at those points, [F, Y], drawn behind, each level by its highest.
    """
    figure, axis = new_figure(7.4, 3.7)
    if density is not None:
        light = matplotlib.colors.LinearSegmentedColormap.from_list("light", ["white", "#B5B5B5"])
        shade = (density / density.max(axis=1, keepdims=True)).T
        axis.contourf(sigmas, places, shade, np.linspace(0.0, 1.0, 7), cmap=light)
        axis.grid(visible=False)
    axis.plot(sigmas, exact / np.sqrt(1 + sigmas**2)[:, None], color=PALETTE["black"],
              linewidth=0.9, linestyle="--")  # fmt: skip
    axis.plot(grid, steps / np.sqrt(1 + grid**2)[:, None], "o-", color=PALETTE["purple"],
              linewidth=1.3, markersize=4)  # fmt: skip
    axis.plot([], [], color=PALETTE["black"], linestyle="--", label="exact flow")
    axis.plot([], [], "o-", color=PALETTE["purple"], label=f"{len(grid)} points, DDIM")
    axis.set_xscale("log")
    axis.set_xlim(sigmas[0] * 1.15, sigmas[-1] / 1.15)
    axis.set_xlabel("noise level σ, sampling runs to the right")
    axis.set_ylabel("x / √(1+σ²)")
    axis.set_title(title)
    axis.set_ylim(-2.3, 2.9)
    axis.legend(loc="upper left", ncols=2)
    return figure


@styled
def film_frames(sigmas, states, modes) -> list:
    """Draw samples on their way through the plane, a small figure for each noise level.

    Args:
      sigmas: noise levels, [F], the last may be 0.
      states: x, [F, P, 2]; drawn as x / sqrt(1 + sigma^2), in the colour of the mode that a sample
        ends next to.
      modes: centres of the data, [K, 2], at most 4.

    Returns:
      [F] figures of one size.
    """
    far = np.linalg.norm(states[-1][:, None] - modes[None], axis=-1)
    colors = np.array([PALETTE[c] for c in ("purple", "orange", "green", "vermilion")])
    ends, reach = colors[far.argmin(axis=1)], 1.15 * np.abs(modes).max() + 0.9
    figures = []
    for sigma, points in zip(sigmas, states, strict=True):
        figure, axis = new_figure(3.0, 3.1)
        axis.scatter(*(points / np.sqrt(1 + sigma**2)).T, c=ends, s=9, linewidths=0)
        axis.plot(*modes.T, "+", color=PALETTE["black"], markersize=9, zorder=5)
        axis.set_xlim(-reach, reach)
        axis.set_ylim(-reach, reach)
        axis.set_aspect("equal")
        axis.grid(visible=False)
        axis.set_xticks([-2, 0, 2])
        axis.set_yticks([-2, 0, 2])
        axis.set_xlabel("x₁ / √(1+σ²)")
        axis.set_ylabel("x₂ / √(1+σ²)")
        axis.set_title(f"σ = {sigma:.0f}" if sigma >= 10 or sigma == 0 else f"σ = {sigma:.2g}")
        figures.append(figure)
    return figures


def keep_film(figures: Sequence, results, name: str, *, milliseconds: int = 140):
    """Save figures as an animated PNG, `<results>/media/<name>.png`, and return it for a notebook.

    It is an image like any other: no player, no script. It opens and pauses on the last figure,
    which is also what a reader sees where moving pictures stand still.

    Args:
      figures: of one size, at least two.
      results: from `profiles.results_dir`.
      name: without folder and ending.
      milliseconds: a figure is shown.

    Returns:
      An image for a cell's last line.

    Raises:
      ValueError: for fewer than two figures.
    """
    if len(figures) < 2:
        raise ValueError(f"a film needs at least 2 figures, got {len(figures)}")
    shown = [show_figure(figure, dpi=76) for figure in figures]
    frames = [Image.open(io.BytesIO(image.data)).convert("RGB") for image in shown]
    frames.insert(0, frames[-1])
    # One palette for all, from a frame with all colours: the film does not flicker.
    palette = frames[0].quantize(12, method=Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)
    frames = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    durations = [1600, *[milliseconds] * len(figures)]
    buffer = io.BytesIO()
    frames[0].save(buffer, "png", save_all=True, append_images=frames[1:], duration=durations,
                   loop=0, optimize=True)  # fmt: skip
    path = Path(results) / "media" / f"{name}.png"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(buffer.getvalue())
    shown[0].data = buffer.getvalue()
    return shown[0]


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


# ------------------------------------------------------------------------------ the printed update

_UPDATE_LOOKS = {
    "rescaled": {"color": PALETTE["purple"], "marker": "o", "linestyle": "-"},
    "literal": {"color": PALETTE["vermilion"], "marker": "s", "linestyle": "--"},
}


def _step_axis(axis, steps) -> None:
    """Make an axis one of numbers of steps."""
    ticks = sorted(set(steps))
    axis.set_xscale("log", base=2)
    axis.set_xticks(ticks, ticks)
    axis.minorticks_off()
    axis.set_xlabel("steps N")


@styled
def two_updates(sigmas, shown: Mapping[str, np.ndarray], noise_left: Mapping[int, np.ndarray]):
    """Draw what both updates show to the network, and how much noise the literal one keeps.

    Args:
      sigmas: noise levels of the evaluations, [N].
      shown: "rescaled" and "literal" -> states that the network is given, [N, P]; drawn as
        x / sqrt(1 + sigma^2).
      noise_left: N -> share of the right noise at each evaluation, [N].
    """
    figure, axes = new_figure(9.4, 3.3, 1, 3)
    for axis, (update, states) in zip(axes, shown.items(), strict=False):
        scaled = states / np.sqrt(1.0 + np.asarray(sigmas)[:, None] ** 2)
        look = _UPDATE_LOOKS[update] | {"linestyle": "-"}
        axis.plot(sigmas, scaled, **look, linewidth=1.2, markersize=3.5)
        axis.set_xscale("log")
        axis.set_xlim(sigmas[0] * 1.3, sigmas[-1] / 1.3)
        axis.set_ylim(-2.2, 2.2)
        axis.set_title(f"{update}, N = {len(sigmas)}")
        axis.set_xlabel("noise level σ that it is told")
    axes[0].set_ylabel("what it is shown, × 1/√(1+σ²)")
    looks = zip(("orange", "green", "black"), "^sD", strict=True)
    for (steps, left), (color, marker) in zip(noise_left.items(), looks, strict=False):
        axes[2].plot(np.arange(1, steps + 1), left, marker=marker, color=PALETTE[color],
                     label=f"N = {steps}")  # fmt: skip
    axes[2].axhline(1.0, color=PALETTE["purple"], linewidth=1.4)
    axes[2].annotate("rescaled", (0.98, 1.0), (0, 3), xycoords=("axes fraction", "data"),
                     textcoords="offset points", ha="right", fontsize=9)  # fmt: skip
    axes[2].set_yscale("log")
    axes[2].set_ylim(top=20)
    axes[2].set_xticks(range(1, max(noise_left) + 1))
    axes[2].set_title("noise left, literal")
    axes[2].set_xlabel("evaluation")
    axes[2].set_ylabel("share of the right noise")
    axes[2].legend(loc="center right")
    return figure


@styled
def collapse_figure(table: pd.DataFrame, truth: float):
    """Draw the mean size of samples against the number of steps for each form of the update.

    Args:
      table: columns update, steps, mean_abs.
      truth: mean |x| of the data.
    """
    figure, axis = new_figure(6.4, 3.2)
    for update, rows in table.groupby("update", sort=False):
        axis.plot(rows["steps"], rows["mean_abs"], label=update, **_UPDATE_LOOKS[update])
    axis.axhline(truth, color=PALETTE["black"], linestyle=":", linewidth=1.4, label="data")
    _step_axis(axis, table["steps"])
    axis.set_ylabel("mean |x| of the samples")
    axis.legend(loc="center right")
    return figure


@styled
def noticing_figure(table: pd.DataFrame):
    """Draw how far apart the two updates end against the width of the data.

    Args:
      table: columns width, steps, apart (mean distance of samples from the same noise).
    """
    figure, axis = new_figure(6.4, 3.4)
    looks = zip(("orange", "purple", "green"), "^os", strict=True)
    for (steps, rows), (color, marker) in zip(table.groupby("steps"), looks, strict=False):
        axis.plot(rows["width"], rows["apart"], marker=marker, color=PALETTE[color],
                  label=f"{steps} steps")  # fmt: skip
    ends = table["width"].min(), table["width"].max()
    axis.plot(ends, ends, color=PALETTE["black"], linestyle=":", linewidth=1.4,
              label="as wide as the data")  # fmt: skip
    axis.set_xscale("log")
    axis.set_yscale("log")
    axis.set_xlabel("width of the data, given the conditions (feature units)")
    axis.set_ylabel("distance, literal from rescaled")
    axis.legend(loc="upper left")
    return figure


@styled
def error_by_sigma(table: pd.DataFrame, levels: Mapping[str, np.ndarray] | None = None):
    """Draw errors of the clean estimate against the noise level, a line for each denoiser.

    Args:
      table: columns denoiser, sigma, x0_error; "exact" is drawn as the floor that it is.
      levels: denoiser -> the only noise levels that it was trained on, marked on its line's foot.
    """
    figure, axis = new_figure(7.4, 3.6)
    looks = itertools.cycle(zip(("purple", "green", "orange"), "osD", strict=True))
    for denoiser, rows in table.groupby("denoiser", sort=False):
        if denoiser == "exact":
            axis.plot(rows["sigma"], rows["x0_error"], color=PALETTE["black"], linestyle="--",
                      label="exact denoiser", zorder=4)  # fmt: skip
            continue
        color, marker = next(looks)
        axis.plot(rows["sigma"], rows["x0_error"], marker=marker, color=PALETTE[color],
                  label=denoiser)  # fmt: skip
        if levels and denoiser in levels:
            axis.plot(levels[denoiser], np.full(len(levels[denoiser]), 0.008), "|",
                      color=PALETTE[color], markersize=12, markeredgewidth=2)  # fmt: skip
    axis.set_xscale("log")
    axis.set_yscale("log")
    axis.set_xlabel("noise level σ")
    axis.set_ylabel("x0 error (root mean square)")
    axis.legend(loc="center right")
    return figure


_WINDOW_PANELS = {
    "seed_spread": "spread over seeds (cm)",
    "joint_acceleration": "acceleration (cm/frame²)",
    "from_rescaled": "literal from rescaled (cm)",
}


@styled
def updates_on_models(table: pd.DataFrame):
    """Draw both updates on trained models against the number of steps, a row for each model.

    Args:
      table: columns model, update ("real" for captured motion), steps, metric, value, of one grid.
    """
    models = list(table["model"].unique())
    figure, axes = new_figure(9.4, 0.6 + 2.3 * len(models), len(models), 3, squeeze=False)
    for row, model in zip(axes, models, strict=True):
        mine = table[table["model"] == model]
        for axis, (metric, title) in zip(row, _WINDOW_PANELS.items(), strict=True):
            for update, look in _UPDATE_LOOKS.items():
                rows = mine[(mine["update"] == update) & (mine["metric"] == metric)]
                if metric == "from_rescaled" and update == "rescaled":
                    continue
                axis.plot(rows["steps"], rows["value"], label=update, **look)
            real = mine[(mine["update"] == "real") & (mine["metric"] == metric)]["value"]
            if len(real):
                axis.axhline(real.iloc[0], color=PALETTE["black"], linestyle=":", linewidth=1.4,
                             label="real motion")  # fmt: skip
            _step_axis(axis, mine.loc[mine["steps"] > 0, "steps"])
            axis.set_ylim(0.0, 1.12 * axis.dataLim.y1)
            axis.set_ylabel(title, fontsize=9)
        row[0].set_title(model, fontsize=10)
    for axis in axes[:-1].flat:
        axis.set_xlabel("")
    handles, labels = axes[0, 1].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=3)
    return figure


@styled
def halving_figure(table: pd.DataFrame):
    """Draw how much each metric moves when the steps are halved, a panel for each source.

    Args:
      table: columns source, steps (before halving), metric, change (relative, >= 0); the metric
        "diversity" is marked apart, and the bar is the largest change of the others.
    """
    sources = list(table["source"].unique())
    width = min(9.4, 2.6 + 2.2 * len(sources))
    figure, axes = new_figure(width, 3.4, 1, len(sources), sharey=True, squeeze=False)
    halvings = sorted(table["steps"].unique(), reverse=True)
    floor = 1e-5
    for axis, source in zip(axes[0], sources, strict=True):
        mine = table[table["source"] == source]
        color = PALETTE["grey"] if source.startswith("paper") else None
        if color is None:
            update = "literal" if "literal" in source else "rescaled"
            color = _UPDATE_LOOKS[update]["color"]
        for place, steps in enumerate(halvings):
            rows = mine[mine["steps"] == steps]
            change, apart = rows["change"].clip(lower=floor), rows["metric"] == "diversity"
            aside = place + np.linspace(-0.2, 0.2, len(change))
            axis.plot(aside[~apart], change[~apart], "o", color=color, markersize=3.5)
            axis.plot(aside[apart], change[apart], "D", color=color, markersize=6,
                      markerfacecolor="white", markeredgewidth=1.6)  # fmt: skip
            most = change[~apart].max()
            axis.plot([place - 0.34, place + 0.34], [most, most], color=color, linewidth=2.4)
        axis.set_yscale("log")
        axis.set_ylim(0.6 * floor, 3.0)
        axis.set_xlim(-0.6, len(halvings) - 0.4)
        axis.set_xticks(range(len(halvings)), [f"{n}→{n // 2}" for n in halvings])
        axis.set_title(source, fontsize=9)
        axis.set_xlabel("steps")
        axis.grid(axis="x", visible=False)
    axes[0, 0].set_ylabel("relative change of a metric")
    percent = ["0.001 %\nor less", "0.01 %", "0.1 %", "1 %", "10 %", "100 %"]
    axes[0, 0].set_yticks([1e-5, 1e-4, 1e-3, 1e-2, 0.1, 1.0], percent)
    return figure
