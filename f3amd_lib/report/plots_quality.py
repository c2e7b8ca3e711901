"""Pictures of the notebook on motion quality: each takes numbers and returns a Figure.

Real motion is black and dashed, the bad generators have a colour each, networks theirs of
`figures.model_style`. Nothing is measured here.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import matplotlib
import numpy as np
import pandas as pd
from matplotlib.ticker import FixedLocator, MaxNLocator

from f3amd_lib.motion.skeleton import Motion
from f3amd_lib.report.figures import PALETTE, model_style, new_figure
from f3amd_lib.report.plots import styled
from f3amd_lib.report.stick_figures import LIMB_COLORS, TARGET_COLOR, limb_side

__all__ = [
    "BAD_COLORS",
    "poses_beside",
    "verdict_grid",
    "drift_picture",
    "smoothness_parts",
    "floating_feet",
    "foot_spectra",
    "seam_sweep",
    "four_samples",
    "feature_clouds",
    "graded_distances",
    "example_clouds",
    "settling_curves",
    "heading_trap",
    "protocol_path",
    "quality_overview",
]

BAD_COLORS = {
    "frozen pose": PALETTE["blue"],
    "shuffled frames": "#8C6D46",
    "noisy motion": "#C2649A",
}
"""Colour of each bad generator (see `evaluation.corruptions`); no network is drawn in these."""

_REAL = model_style("real").line | {"linewidth": 1.4}


def _color(name: str) -> str:
    if name == "real":
        return PALETTE["black"]
    if name.endswith("-plus"):
        return PALETTE["vermilion"]  # beside its own family a shade would not tell it apart
    return BAD_COLORS.get(name) or model_style(name).color


# ------------------------------------------------------------------- four motions, all metrics


@styled
def poses_beside(motions: Mapping[str, Motion], frames: Sequence[int]):
    """Draw the same frames of several motions, a panel each, poses side by side.

    Every pose is seen from the character's own front right, wherever it goes.

    Args:
      motions: title -> motion, or None where a panel is to stay empty.
      frames: which, in this order.
    """
    rows, across = -(-len(motions) // 2), 0.95 * len(frames)
    # As high as its panels are at equal scale, and a line for the title.
    figure, axes = new_figure(7.2, (0.4 + 3.45 * 1.93 / across) * rows, rows, 2, squeeze=False)
    for axis in axes.flat:
        axis.axis("off")
    for axis, (title, motion) in zip(axes.flat, motions.items(), strict=False):
        if motion is None:
            continue
        skeleton = motion.skeleton
        for place, frame in enumerate(frames):
            view = motion.yaw[frame] - np.pi / 3
            pose = motion.positions[frame]
            right = (pose[:, [0, 2]] - pose[0, [0, 2]]) @ [np.cos(view), -np.sin(view)]
            seen = np.stack([0.95 * place + right, pose[:, 1]])
            for joint, parent in enumerate(skeleton.parents):
                name = skeleton.names[joint]
                color = LIMB_COLORS[limb_side(name)]
                if parent >= 0:
                    axis.plot(*seen[:, [parent, joint]], color=color, linewidth=2.2,
                              solid_capstyle="round")  # fmt: skip
                if name.lower().endswith("head"):
                    axis.plot(*seen[:, joint], "o", color=color, markersize=7)
        axis.axhline(0.0, color=PALETTE["grey"], linewidth=0.8, zorder=0)
        axis.set_xlim(-0.5, across - 0.4)
        axis.set_ylim(-0.08, 1.85)
        axis.set_aspect("equal")
        axis.set_title(title, color=_color(title))
    return figure


_VERDICTS = {"sees it": "#BFE0DB", "does not notice": "#EDEDED", "calls it better": "#F3B7A8"}


@styled
def verdict_grid(table: pd.DataFrame):
    """Draw what each metric says of each bad generator, as a multiple of real motion's own figure.

    Args:
      table: columns metric (as to be shown), generator, ratio (to real; NaN where it has none) and
        verdict ("sees it", "does not notice", "calls it better").
    """
    metrics = list(dict.fromkeys(table["metric"]))
    generators = list(dict.fromkeys(table["generator"]))
    figure, axis = new_figure(6.2, 0.95 + 0.27 * len(metrics))
    for row, metric in enumerate(metrics):
        for column, generator in enumerate(generators):
            cell = table[(table["metric"] == metric) & (table["generator"] == generator)].iloc[0]
            axis.add_patch(
                matplotlib.patches.Rectangle(
                    (column, row),
                    1,
                    1,
                    facecolor=_VERDICTS[cell["verdict"]],
                    edgecolor="white",
                    linewidth=2.0,
                )  # fmt: skip
            )
            ratio = cell["ratio"]
            text = "–" if np.isnan(ratio) else f"× {ratio:.{0 if ratio >= 10 else 2}f}"
            axis.text(column + 0.5, row + 0.53, text, ha="center", va="center", fontsize=9)
    axis.set_xlim(0, len(generators))
    axis.set_ylim(len(metrics), 0)
    axis.set_xticks(np.arange(len(generators)) + 0.5, generators, fontweight="bold")
    axis.xaxis.tick_top()
    axis.set_yticks(np.arange(len(metrics)) + 0.5, metrics)
    axis.tick_params(length=0)
    axis.grid(False)
    for spine in axis.spines.values():
        spine.set_visible(False)
    handles = [
        matplotlib.patches.Patch(facecolor=color, label=verdict)
        for verdict, color in _VERDICTS.items()
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=3)
    return figure


# -------------------------------------------------------------------------- paths, smoothness, feet


@styled
def drift_picture(target, walks: Mapping[str, np.ndarray], table: pd.DataFrame):
    """Draw a long path, two walkers, and what two measures say of them round by round.

    Args:
      target: [T, 2], x and z in metres.
      walks: label -> [T, 2].
      table: columns label, round, error_cm (of each window), gap_m (from the target at its end).
    """
    figure, axes = new_figure(7.2, 2.9, 1, 3, width_ratios=[1.05, 1.0, 1.0])
    plan = axes[0]
    colors = dict(zip(walks, ("blue", "vermilion"), strict=False))
    for label, walked in walks.items():
        plan.plot(*walked.T, color=PALETTE[colors[label]], linewidth=1.5)
    plan.plot(*np.asarray(target).T, "--", color=TARGET_COLOR, linewidth=1.4, label="target")
    plan.plot(*target[0], "o", color=PALETTE["black"], markersize=4, label="start")
    plan.set_aspect("equal", adjustable="datalim")
    plan.margins(0.08)
    plan.invert_xaxis()
    plan.set_xlabel("x (m)")
    plan.set_ylabel("z (m)")
    plan.legend(fontsize=8, loc="best", handlelength=1.6)
    plan.set_title("from above")
    panels = (("error_cm", "Traj. of a window (cm)"), ("gap_m", "gap to the target (m)"))
    for axis, (column, title) in zip(axes[1:], panels, strict=True):
        for label, rows in table.groupby("label", sort=False):
            axis.plot(rows["round"], rows[column], color=PALETTE[colors[label]], label=label)
        axis.set_ylim(0, 1.25 * table[column].max())
        axis.set_title(title)
        axis.set_xlabel("round")
    figure.legend(*axes[1].get_legend_handles_labels(), loc="outside lower center", ncols=2)
    return figure


def _row_dots(axis, names: Sequence[str], values, *, low=None, high=None) -> None:
    """Draw one dot a name, the first name on top, with an interval where there is one."""
    for place, (name, value) in enumerate(zip(names, values, strict=True)):
        if low is not None and not np.isnan(low[place]):
            axis.plot([low[place], high[place]], [place] * 2, color=_color(name), linewidth=2.4,
                      alpha=0.45, solid_capstyle="butt")  # fmt: skip
        axis.plot(value, place, "D" if name == "real" else "o", color=_color(name))
    axis.set_yticks(np.arange(len(names)), names)
    axis.set_ylim(len(names) - 0.5, -0.5)


@styled
def smoothness_parts(table: pd.DataFrame):
    """Draw the two accelerations whose quotient is Smooth, and the quotient.

    Args:
      table: columns name ("real" first), joints and root (cm per frame squared), smoothness.
    """
    figure, (left, right) = new_figure(7.2, 2.5, 1, 2, sharey=True, width_ratios=[1.5, 1.0])
    names = table["name"].tolist()
    for place, row in enumerate(table.itertuples()):
        left.plot([row.root, row.joints], [place] * 2, color=_color(row.name), linewidth=1.2)
        left.plot(row.root, place, "o", color=_color(row.name), markerfacecolor="white")
    _row_dots(left, names, table["joints"])
    left.set_xscale("log")
    _few_log_ticks(left.xaxis)
    left.set_title("accelerations (cm/frame²)")
    left.plot([], [], "o", color=PALETTE["grey"], label="joints")
    left.plot([], [], "o", color=PALETTE["grey"], markerfacecolor="white", label="root, on ground")
    left.legend(loc="upper right", fontsize=8.5)
    _row_dots(right, names, table["smoothness"])
    right.axvline(table["smoothness"].iloc[0], **_REAL)
    right.set_xlim(0, 1.15 * table["smoothness"].max())
    right.set_title("Smooth = joints / root  ↓")
    return figure


@styled
def floating_feet(sweep: pd.DataFrame, points: pd.DataFrame):
    """Draw Foot and contact share of a lifted figure, and of real and broken motion.

    Args:
      sweep: columns lift_cm, foot_sliding, contact_share of one walker.
      points: columns name, foot_sliding, contact_share.
    """
    figure, (left, right) = new_figure(7.2, 2.9, 1, 2)
    left.plot(sweep["lift_cm"], sweep["foot_sliding"], ".-", color=PALETTE["purple"], label="Foot")
    left.plot(sweep["lift_cm"], sweep["contact_share"], ".-", color=PALETTE["green"],
              label="contact share")  # fmt: skip
    left.set_xlabel("real walker, lifted by (cm)")
    left.set_title("floating: no contact, no sliding")
    left.legend(loc="center right")
    for row in points.itertuples():
        right.plot(row.contact_share, row.foot_sliding, "D" if row.name == "real" else "o",
                   color=_color(row.name), label=row.name, markersize=7)  # fmt: skip
    right.set_xlabel("contact share")
    right.set_ylabel("Foot ↓")
    right.set_xlim(-0.03, 1.05 * max(points["contact_share"].max(), 0.5))
    right.set_ylim(-0.04 * points["foot_sliding"].max(), 1.12 * points["foot_sliding"].max())
    right.set_title("both numbers together")
    right.legend(fontsize=8.5)
    return figure


@styled
def foot_spectra(table: pd.DataFrame):
    """Draw the power of toe motion over that of real feet, band by band.

    Args:
      table: from `sensitivity.foot_spectrum`, with the column label.
    """
    ratios = table[(table["metric"] == "toe_power_over_real") & (table["model"] != "real")]
    bands = list(dict.fromkeys(ratios["band"]))
    labels = list(dict.fromkeys(ratios["label"]))
    figure, axes = new_figure(
        8.2, 1.0 + 0.27 * len(labels), 1, len(bands), sharey=True, sharex=True
    )
    for axis, band in zip(np.atleast_1d(axes), bands, strict=True):
        rows = ratios[ratios["band"] == band].set_index("label").loc[labels]
        for place, row in enumerate(rows.itertuples()):
            axis.plot([row.low, row.high], [place] * 2, color=_color(row.model), linewidth=2.4,
                      alpha=0.45, solid_capstyle="butt")  # fmt: skip
            axis.plot(row.value, place, "o", color=_color(row.model))
        axis.axvline(1.0, **_REAL)
        axis.set_xscale("log")
        axis.set_xlim(0.2 * min(1.0, ratios["value"].min()), 5.0 * max(1.0, ratios["value"].max()))
        axis.set_title(band)
        axis.set_yticks(np.arange(len(labels)), labels)
        axis.set_ylim(len(labels) - 0.5, -0.5)
        axis.grid(False, axis="y")
    figure.supxlabel("power of toe velocity, times real", fontsize=10)
    return figure


@styled
def seam_sweep(traces: Mapping[float, np.ndarray], table: pd.DataFrame):
    """Draw a character that sticks at its seams, goes on, or jumps; and what two measures say.

    Args:
      traces: factor on the seam's step -> way along the path, [2 K + 1], metres; the window begins
        in the middle, at K.
      table: columns factor, ird_cm, ird_excess_cm.
    """
    figure, (left, right) = new_figure(7.2, 2.9, 1, 2)
    words = {0.0: "sticks", 1.0: "goes on"}
    for (factor, way), color in zip(traces.items(), ("blue", "black", "vermilion"), strict=False):
        word = words.get(factor, "jumps")
        frames = np.arange(len(way)) - len(way) // 2
        left.plot(frames, 100 * way, color=PALETTE[color], label=f"× {factor:g}: {word}")
    left.axvline(-0.5, color=PALETTE["grey"], linewidth=0.9, linestyle=":")
    left.set_xlabel("frame of the window; dotted: the seam")
    left.set_ylabel("way of the root (cm)")
    left.set_title("the seam's step, times …")
    left.xaxis.set_major_locator(MaxNLocator(integer=True))
    left.legend(fontsize=8.5)
    right.plot(table["factor"], table["ird_cm"], color=PALETTE["purple"], label="IRD (paper: ↓)")
    right.plot(table["factor"], table["ird_excess_cm"], color=PALETTE["green"], label="IRD excess")
    right.axvline(1.0, **_REAL)
    right.annotate("real", (1.0, right.get_ylim()[1]), (4, -10), textcoords="offset points",
                   fontsize=9)  # fmt: skip
    right.set_ylim(bottom=0)
    right.set_xlabel("factor on the seam's step")
    right.set_ylabel("cm")
    right.set_title("what the measures say")
    right.legend(fontsize=8.5)
    return figure


@styled
def four_samples(samples: Mapping[str, np.ndarray], diversity_cm: Mapping[str, float]):
    """Draw samples of one condition, a panel a generator, with the Diversity of each.

    Args:
      samples: title -> height of a toe, [num_seeds, T], metres.
      diversity_cm: title -> Diversity.
    """
    figure, axes = new_figure(7.2, 2.0, 1, len(samples), sharey=True)
    for axis, (title, heights) in zip(axes, samples.items(), strict=True):
        shades = matplotlib.colormaps["viridis"](np.linspace(0.05, 0.9, len(heights)))
        for height, shade in zip(heights, shades, strict=True):
            axis.plot(100 * height, color=shade, linewidth=1.0)
        axis.set_title(f"{title}: {diversity_cm[title]:.1f} cm", fontsize=10)
        axis.set_xlabel("frame")
    axes[0].set_ylabel("height of a toe (cm)")
    return figure


# ------------------------------------------------------------------------------------ distributions


@styled
def feature_clouds(clouds: Mapping[str, np.ndarray], styles: Mapping[str, np.ndarray]):
    """Draw windows as the classifier sees them: the two main directions of its features.

    Args:
      clouds: name ("train", "real", then bad generators) -> [N, 2].
      styles: style -> its middle in the training cloud, [2]; crowded names are left out.
    """
    shown = [name for name in clouds if name != "train"]
    figure, axes = new_figure(7.2, 2.3, 1, len(shown), sharex=True, sharey=True)
    for axis, name in zip(axes, shown, strict=True):
        axis.plot(*clouds["train"].T, ".", color="#C4C4C4", markersize=4)
        axis.plot(*clouds[name].T, "o", color=_color(name), markersize=4, alpha=0.8,
                  markeredgewidth=0)  # fmt: skip
        axis.set_title("real, test clips" if name == "real" else name, fontsize=10)
        axis.tick_params(labelbottom=False, labelleft=False, length=0)
        axis.margins(0.14)
    extent = np.ptp(clouds["train"], axis=0)
    placed: list[np.ndarray] = []
    for style, middle in styles.items():
        # A name that would lie on another one is left out.
        if all(
            (np.abs(middle - other) > np.array([0.35, 0.08]) * extent).any() for other in placed
        ):
            axes[0].annotate(style, middle, (0, 9), textcoords="offset points", fontsize=7,
                             ha="center")  # fmt: skip
            placed.append(middle)
    return figure


@styled
def graded_distances(table: pd.DataFrame):
    """Draw FID, EMD and style accuracy against how much the motion is broken.

    Args:
      table: from `sensitivity.summarise_corruptions`.
    """
    panels = (("FID", "FID ↓"), ("EMD", "EMD ↓"), ("style_accuracy", "style recognised (%)"))
    figure, axes = new_figure(7.2, 2.7, 1, 3)
    for axis, (metric, title) in zip(axes, panels, strict=True):
        mine = table[table["metric"] == metric]
        for name, rows in mine.groupby("corruption", sort=False):
            rows = rows.sort_values("strength")
            axis.fill_between(rows["strength"], rows["low"], rows["high"], color=_color(name),
                              alpha=0.15, linewidth=0)  # fmt: skip
            axis.plot(rows["strength"], rows["value"], ".-", color=_color(name), label=name)
        axis.set_ylim(0, min(1.4 * mine["value"].max(), 1.05 * np.nanmax(mine["high"])))
        axis.set_title(title)
        axis.set_xlabel("strength of the recipe")
    axes[2].set_ylim(0, 105)
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=3)
    return figure


@styled
def example_clouds(examples: Mapping[str, tuple], reference):
    """Draw made-up clouds in a plane beside the reference, with both distances.

    Args:
      examples: title -> (cloud [N, 2], FID, EMD).
      reference: [N, 2].
    """
    figure, axes = new_figure(7.0, 2.5, 1, len(examples), sharex=True, sharey=True)
    for axis, (title, (cloud, fid, emd)) in zip(axes, examples.items(), strict=True):
        axis.plot(*np.asarray(reference).T, ".", color="#BBBBBB", markersize=3)
        axis.plot(*np.asarray(cloud).T, ".", color=PALETTE["purple"], markersize=3)
        axis.set_title(f"{title}\nFID {fid:.2f}, EMD {emd:.2f}", fontsize=10)
        axis.set_aspect("equal")
        axis.tick_params(labelsize=8)
    return figure


@styled
def settling_curves(table: pd.DataFrame):
    """Draw FID and EMD against the number of windows.

    Args:
      table: from `sensitivity.settling`, with the column label.
    """
    figure, axes = new_figure(7.2, 3.0, 1, 2)
    colors = ("purple", "orange", "green")
    for axis, metric in zip(axes, ("FID", "EMD"), strict=True):
        mine = table[table["metric"] == metric]
        for (label, rows), color in zip(mine.groupby("label", sort=False), colors, strict=False):
            bounds = [np.clip(rows[bound], 0.3 * rows["value"], None) for bound in ("low", "high")]
            axis.fill_between(
                rows["windows"], *bounds, color=PALETTE[color], alpha=0.2, linewidth=0
            )
            axis.plot(rows["windows"], rows["value"], ".-", color=PALETTE[color], label=label)
        axis.set_xscale("log")
        axis.set_yscale("log")
        axis.set_title(metric)
        axis.set_xlabel("windows on each side")
        ticks = sorted(set(mine["windows"]))[::-1][::2][::-1]
        axis.set_xticks(ticks, [f"{tick}" for tick in ticks])
        axis.xaxis.set_minor_locator(FixedLocator([]))
        _few_log_ticks(axis.yaxis)
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=2)
    return figure


# ------------------------------------------------------------------- definitions, protocol, results


@styled
def heading_trap(heading_deg, angle_error_deg):
    """Draw what an unwrapped angle says of one and the same walk, turned.

    Args:
      heading_deg: mean direction of travel, [K]; 0 along +Z, 90 along +X.
      angle_error_deg: trajectory error of the CAMDM code, [K].
    """
    figure, axis = new_figure(6.0, 2.1)
    axis.plot(heading_deg, angle_error_deg, color=PALETTE["vermilion"])
    axis.set_ylim(bottom=0)
    axis.set_xticks(np.arange(-180, 181, 45))
    axis.set_xlabel("the same walk, turned to head (degrees)")
    axis.set_ylabel("error (degrees)")
    axis.set_title("trajectory error of the CAMDM code")
    return figure


@styled
def protocol_path(path, *, seams: int):
    """Draw the protocol's path from above, and its speed and turning in time.

    Args:
      path: a `RootPath`.
      seams: frames a window; the plan is marked every tenth window.
    """
    figure, axes = new_figure(7.2, 2.8, 1, 2, width_ratios=[1.0, 1.2])
    plan, series = axes
    position = np.asarray(path.position)
    speed = path.fps * np.linalg.norm(np.diff(position, axis=0), axis=-1)
    plan.plot(*position.T, color=PALETTE["purple"], linewidth=1.5)
    marks = np.arange(0, len(position), 10 * seams)
    ahead = np.stack([np.sin(path.yaw[marks]), np.cos(path.yaw[marks])], axis=-1)
    reach = 0.05 * np.ptp(position, axis=0).max()
    for start, end in zip(position[marks], position[marks] + reach * ahead, strict=True):
        plan.annotate("", end, start, arrowprops={"arrowstyle": "-|>", "linewidth": 1.1})
    plan.plot(*position[0], "o", color=PALETTE["black"], markersize=5)
    plan.set_aspect("equal", adjustable="datalim")
    plan.margins(0.06)
    plan.invert_xaxis()
    plan.set_xlabel("x (m)")
    plan.set_ylabel("z (m)")
    plan.set_title("from above; arrows: facing")
    time = np.arange(len(position)) / path.fps
    series.plot(time[1:], speed, color=PALETTE["purple"], linewidth=1.2, label="speed (m/s)")
    turn = np.rad2deg(path.fps * np.gradient(path.yaw))
    series.plot(time, turn / 60.0, color=PALETTE["orange"], linewidth=1.0, alpha=0.9,
                label="turning (60 degrees/s)")  # fmt: skip
    series.set_xlabel("time (s)")
    series.set_title("speed and turning")
    low, high = series.get_ylim()
    series.set_ylim(low, high + 0.25 * (high - low))
    series.legend(ncols=2, loc="upper left", fontsize=8.5)
    return figure


@styled
def quality_overview(quality: pd.DataFrame, figures: Mapping[str, str], paper: pd.DataFrame):
    """Draw the paper's nine figures for everything that was measured, real motion on top.

    Args:
      quality: from `protocol.summarise`: model, steps, metric, value, low, high; real motion and
        the bad generators first.
      figures: metric -> heading (`quality_tables.FIGURES`).
      paper: columns model (our presets), steps, metric, value: what the paper prints for the same
        rows. FID and EMD are not drawn, since they do not compare.
    """
    rows = list(quality[["model", "steps"]].drop_duplicates().itertuples(index=False, name=None))
    labels = [f"{model}, {steps}" if steps else model for model, steps in rows]
    columns = 3
    lines = -(-len(figures) // columns)
    figure, axes = new_figure(
        7.6, 0.35 + lines * (0.5 + 0.14 * len(rows)), lines, columns, sharey=True
    )
    for axis, (metric, title) in zip(axes.flat, figures.items(), strict=False):
        mine = quality[quality["metric"] == metric].set_index(["model", "steps"])
        printed = paper[paper["metric"] == metric].set_index(["model", "steps"])["value"]
        for place, key in enumerate(rows):
            if key in mine.index and mine.loc[key, "value"] > 0:
                found = mine.loc[key]
                color, shade = _color(key[0]), {8: 1.0, 4: 0.75, 2: 0.55, 1: 0.4}.get(key[1], 1.0)
                if not np.isnan(found["low"]):
                    reach = [max(found["low"], 0.3 * found["value"]), found["high"]]
                    axis.plot(reach, [place] * 2, color=color, linewidth=3.0, alpha=0.3,
                              solid_capstyle="butt")  # fmt: skip
                marker = "D" if key[0] == "real" else "o"
                axis.plot(found["value"], place, marker, color=color, alpha=shade, markersize=4.5,
                          markeredgewidth=0)  # fmt: skip
            if metric not in ("FID", "EMD") and key in printed.index:
                axis.plot(printed[key], place, "x", color=PALETTE["grey"], markersize=4.5)
        if ("real", 0) in mine.index:
            axis.axvline(mine.loc[("real", 0), "value"], **_REAL | {"linewidth": 1.0})
        if metric != "style_coverage":
            axis.set_xscale("log")
            _few_log_ticks(axis.xaxis)
        axis.set_title(title, fontsize=10)
        axis.tick_params(labelsize=7.5)
        axis.grid(False, axis="y")
    axes.flat[0].set_yticks(np.arange(len(labels)), labels)
    axes.flat[0].set_ylim(len(labels) - 0.4, -0.6)
    handles = [
        matplotlib.lines.Line2D([], [], **_REAL, label="real"),
        matplotlib.lines.Line2D([], [], marker="o", linestyle="", color=PALETTE["grey"],
                                label="ours, with 95 % interval"),
        matplotlib.lines.Line2D([], [], marker="x", linestyle="", color=PALETTE["grey"],
                                label="the paper's row (other data)"),
    ]  # fmt: skip
    figure.legend(handles=handles, loc="outside lower center", ncols=3)
    return figure


def _few_log_ticks(axis) -> None:
    """Label a logarithmic x or y axis with a few round numbers, whatever its span."""
    low, high = sorted(axis.get_view_interval())
    steps = (1, 2, 5) if high < 100 * low else (1,)
    exponents = range(int(np.floor(np.log10(low))) - 1, int(np.ceil(np.log10(high))) + 1)
    ticks = [step * 10.0**exponent for exponent in exponents for step in steps]
    if sum(low <= tick <= high for tick in ticks) < 2:
        ticks = MaxNLocator(4).tick_values(low, high)
    ticks = [tick for tick in ticks if low <= tick <= high]
    axis.set_ticks(ticks, labels=[f"{tick:g}" for tick in ticks])
    axis.set_minor_locator(FixedLocator([]))
