"""Pictures of the notebooks: each takes numbers and returns a Figure, and computes nothing new.

Plans (views from above) have +Z up the page and +X to the left, so that a left turn looks like one.
"""

from __future__ import annotations

import functools
import io
from collections.abc import Mapping, Sequence
from pathlib import Path

import matplotlib
import numpy as np
import pandas as pd
from matplotlib.ticker import MaxNLocator
from PIL import Image

from f3amd_lib.motion.skeleton import Motion
from f3amd_lib.report.figures import (
    PALETTE,
    model_style,
    new_figure,
    plot_style,
    save_figure,
    show_figure,
)
from f3amd_lib.report.stick_figures import LIMB_COLORS, limb_side

__all__ = [
    "ORDER",
    "styled",
    "shades",
    "keep_figure",
    "paper_tradeoff",
    "road_map",
    "skeleton_views",
    "contact_timeline",
    "facing_plan",
    "rotation_signals",
    "mirror_overlay",
    "window_plan",
    "turned_windows",
    "clip_statistics_figure",
    "channel_statistics",
]

ORDER = ("purple", "orange", "green", "vermilion", "blue", "sky")


def styled(draw):
    """Draw in the project's style, whatever style the caller uses."""

    @functools.wraps(draw)
    def inside(*arguments, **keywords):
        with plot_style():
            return draw(*arguments, **keywords)

    return inside


def keep_figure(figure, results, name: str):
    """Save a figure as `<results>/figures/<name>.png` and return a light copy for the notebook.

    Args:
      figure: any.
      results: from `profiles.results_dir`.
      name: without folder and ending.

    Returns:
      An image for a cell's last line: smaller, in 64 colours, so that committed notebooks stay
      small.
    """
    save_figure(figure, Path(results) / "figures" / f"{name}.png")
    shown = show_figure(figure, dpi=76)
    light, buffer = Image.open(io.BytesIO(shown.data)).convert("RGB"), io.BytesIO()
    light.quantize(64, method=Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE).save(
        buffer, "png", optimize=True
    )
    shown.data = buffer.getvalue()
    return shown


def shades(count: int) -> list[tuple]:
    """Return dark to light shades of one colour, for curves in an order."""
    return [matplotlib.colormaps["viridis"](value) for value in np.linspace(0.05, 0.85, count)]


# ----------------------------------------------------------------------------------- reading guide


@styled
def paper_tradeoff(times: pd.DataFrame, quality: pd.DataFrame):
    """Draw the paper's Tables 4 and 5 as one picture: time a round against FID.

    Args:
      times: `papers.load_paper_table(4)`.
      quality: `papers.load_paper_table(5)`.
    """
    figure, axes = new_figure(8.2, 3.6, 1, 2, sharey=True)
    fid = quality[quality["metric"] == "FID"].set_index(["model", "steps"])["value"]
    for axis, device, characters in zip(axes, ("GPU", "CPU"), (1024, 32), strict=True):
        chosen = times[(times["device"] == device) & (times["characters"] == characters)]
        for model, rows in chosen.groupby("model"):
            rows = rows.sort_values("steps")
            values = [fid[model, steps] for steps in rows["steps"]]
            axis.plot(rows["value"], values, label=model, **model_style(model).line)
            for steps, time, value in zip(rows["steps"], rows["value"], values, strict=True):
                axis.annotate(
                    f"{steps}", (time, value), (7, 3), textcoords="offset points", ha="left",
                    fontsize=9, color=model_style(model).color,
                )  # fmt: skip
        axis.set_xscale("log")
        axis.set_xlabel("time a round (ms)")
        axis.set_title(f"{characters:,} characters, {device}")
        axis.margins(x=0.15)
    axes[0].set_ylim(0.12, 0.22)
    axes[0].set_ylabel("FID (lower is better)")
    figure.suptitle("The paper's own numbers; labels: denoising steps", fontsize=10, x=0.5)
    axes[1].legend(loc="lower left")
    return figure


@styled
def road_map():
    """Draw the road from BVH text to a verdict, with the notebooks along it."""
    stations = (
        ("BVH text", "01", "motion/bvh"),
        ("features,\nwindows", "01", "data/"),
        ("noise,\nsampler", "02", "diffusion/"),
        ("networks,\nvariants", "03, 06", "models/"),
        ("losses,\ntraining", "04", "training/"),
        ("rollout", "05", "evaluation/"),
        ("metrics,\nprotocol", "07", "evaluation/"),
        ("claims,\nverdicts", "08", "report/"),
    )
    figure, axis = new_figure(9.6, 1.7)
    for place, (title, notebook, folder) in enumerate(stations):
        axis.text(
            place, 0.0, title, ha="center", va="center", fontsize=9.5, fontweight="bold",
            color="white", linespacing=1.25,
            bbox={"boxstyle": "round,pad=0.55", "facecolor": PALETTE["purple"], "linewidth": 0},
        )  # fmt: skip
        axis.text(place, 0.62, f"notebook {notebook}", ha="center", fontsize=9)
        axis.text(place, -0.78, folder, ha="center", fontsize=8.5, family="DejaVu Sans Mono")
        if place:
            axis.annotate(
                "", (place - 0.43, 0.0), (place - 0.57, 0.0),
                arrowprops={"arrowstyle": "-|>", "color": PALETTE["black"], "linewidth": 1.6},
            )  # fmt: skip
    axis.set_xlim(-0.55, len(stations) - 0.45)
    axis.set_ylim(-1.0, 0.95)
    axis.axis("off")
    return figure


# -------------------------------------------------------------------------------- data preparation


def _stick_figure(axis, positions, skeleton, across: int, sign: float = 1.0, **line) -> None:
    """Draw one pose [J, 3] with one horizontal coordinate across the page."""
    for joint, parent in enumerate(skeleton.parents):
        if parent >= 0:
            ends = positions[[parent, joint]]
            color = LIMB_COLORS[limb_side(skeleton.names[joint])]
            style = {"color": color, "linewidth": 3.0, "solid_capstyle": "round"} | line
            axis.plot(sign * ends[:, across], ends[:, 1], **style)


@styled
def skeleton_views(motion: Motion, frame: int = 0):
    """Draw a pose from the front and from its left, joints numbered, with their names beside.

    Args:
      motion: facing +Z at `frame`.
      frame: which pose.
    """
    skeleton, positions = motion.skeleton, motion.positions[frame]
    half = max(np.abs(positions[:, 0]).max() + 0.1, 0.45)
    figure, axes = new_figure(8.6, 4.2, 1, 3, width_ratios=[half, 0.45, 0.75])
    top = positions[:, 1].max() + 0.15
    # Seen from the front its left is on our right; seen from its left it faces left.
    for axis, across, sign, title in ((axes[0], 0, 1.0, "front"), (axes[1], 2, -1.0, "left side")):
        _stick_figure(axis, positions, skeleton, across, sign)
        axis.plot(sign * positions[:, across], positions[:, 1], "o", color="white",
                  markeredgecolor=PALETTE["black"], markersize=4.5, zorder=5)  # fmt: skip
        axis.set_ylim(-0.1, top)
        axis.set_aspect("equal")
        axis.set_title(title)
        axis.set_xlabel(("x" if across == 0 else "-z") + " (m)")
    for joint, (x, y, _) in enumerate(positions):
        axes[0].annotate(f"{joint}", (x, y), (4, 3), textcoords="offset points", fontsize=7)
    axes[0].set_ylabel("y (m)")
    axes[0].set_xlim(-half, half)
    axes[1].set_xlim(-0.45, 0.45)
    rows = (skeleton.num_joints + 1) // 2
    for column, first in enumerate((0, rows)):
        text = "\n".join(
            f"{joint:2d} {skeleton.names[joint]}"
            for joint in range(first, min(first + rows, skeleton.num_joints))
        )
        axes[2].text(0.6 * column - 0.1, 1.0, text, va="top", fontsize=8, linespacing=1.45,
                     transform=axes[2].transAxes)  # fmt: skip
    axes[2].axis("off")
    return figure


@styled
def contact_timeline(motion: Motion, threshold: float):
    """Draw height and speed of both toes against time, frames in contact shaded below.

    Args:
      motion: a clip.
      threshold: speed of the contact rule, metres a frame at 30 fps.
    """
    figure, (upper, lower) = new_figure(8.2, 4.0, 2, 1, sharex=True)
    time = np.arange(motion.num_frames) / motion.fps
    toes = motion.positions[:, list(motion.skeleton.toes)]
    speed = 100 * np.linalg.norm(np.diff(toes, axis=0), axis=-1) * motion.fps / 30.0
    for foot, side in enumerate(("left", "right")):
        color = LIMB_COLORS[side]
        upper.plot(time, 100 * toes[:, foot, 1], color=color, label=f"{side} toe")
        lower.plot(time[:-1], speed[:, foot], color=color)
        lower.fill_between(
            time, -2.6 - 1.6 * foot, -1.4 - 1.6 * foot, where=motion.contacts[:, foot],
            color=color, linewidth=0, step="post",
        )  # fmt: skip
    lower.axhline(100 * threshold, color=PALETTE["black"], linestyle=":", linewidth=1.2)
    upper.set_ylabel("height (cm)")
    lower.set_ylabel("speed (cm/frame)")
    lower.set_xlabel("time (s); bars: toe in contact, dotted line: the rule's threshold")
    upper.legend(ncols=2, loc="upper right")
    upper.set_ylim(top=1.25 * upper.get_ylim()[1])
    return figure


def _plan(axis, margin: float = 0.15) -> None:
    """Make an axis a view from above."""
    axis.set_aspect("equal", adjustable="datalim")
    axis.margins(margin)
    if not axis.xaxis_inverted():
        axis.invert_xaxis()
    axis.set_xlabel("x (m)")
    axis.set_ylabel("z (m)")


@styled
def facing_plan(motion: Motion):
    """Draw a clip's root path from above with its facing, and the yaw against time."""
    figure, (plan, angle) = new_figure(8.2, 3.4, 1, 2)
    root = motion.root_position[:, [0, 2]]
    plan.plot(*root.T, color=PALETTE["grey"])
    marks = np.linspace(0, motion.num_frames - 1, 14).astype(int)
    reach = 0.08 * max(np.ptp(root, axis=0).max(), 1.0)
    ends = root[marks] + reach * np.stack(
        [np.sin(motion.yaw[marks]), np.cos(motion.yaw[marks])], axis=-1
    )
    for start, end in zip(root[marks], ends, strict=True):
        plan.annotate("", end, start, arrowprops={"arrowstyle": "-|>", "linewidth": 1.2})
    plan.plot(*root[0], "o", color=PALETTE["purple"], label="start")
    plan.set_title("from above, arrows: facing")
    plan.legend()
    _plan(plan)
    time = np.arange(motion.num_frames) / motion.fps
    angle.plot(time, np.degrees(np.unwrap(motion.yaw)), color=PALETTE["purple"], label="unwrapped")
    angle.plot(time, np.degrees(motion.yaw), ".", color=PALETTE["orange"], markersize=3,
               label="as atan2 gives it")  # fmt: skip
    angle.set_title("yaw, positive to the left")
    angle.set_xlabel("time (s)")
    angle.set_ylabel("yaw (degrees)")
    angle.legend()
    return figure


@styled
def rotation_signals(turn_deg, euler_deg, rotation_6d):
    """Draw one steady turn as Euler angles and as 6D numbers.

    Args:
      turn_deg: angle turned so far, [T], degrees.
      euler_deg: the same rotation as Euler angles, [T, 3].
      rotation_6d: the same in 6D, [T, 6].
    """
    figure, (left, right) = new_figure(8.2, 3.2, 1, 2)
    for axis_name, angle, shade in zip("ZXY", euler_deg.T, shades(3), strict=True):
        left.plot(turn_deg, angle, color=shade, label=axis_name)
    left.set_title("Euler angles: torn")
    left.set_ylabel("angle (degrees)")
    left.legend(title="axis", ncols=3)
    left.set_ylim(-200, 290)
    names = ("R00", "R10", "R20", "R01", "R11", "R21")
    for name, value, shade in zip(names, rotation_6d.T, shades(6), strict=True):
        right.plot(turn_deg, value, color=shade, label=name)
    right.set_title("6D: smooth")
    right.set_ylabel("matrix entry")
    right.set_ylim(-1.2, 1.9)
    right.legend(ncols=3)
    for axis in (left, right):
        axis.set_xlabel("angle turned (degrees)")
    return figure


@styled
def mirror_overlay(motion: Motion, mirrored: Motion, frames: Sequence[int]):
    """Draw poses seen from the left, above the same frames of the mirrored clip."""
    figure, axes = new_figure(8.2, 4.4, 2, 1, sharex=True)
    for axis, clip, title in zip(
        axes, (motion, mirrored), ("as captured", "mirrored"), strict=True
    ):
        for place, frame in enumerate(frames):
            # Ahead is to the left of the page; only height and the way ahead are drawn.
            yaw = clip.yaw[frame]
            ahead = np.array([np.sin(yaw), 0.0, np.cos(yaw)])
            pose = clip.positions[frame] - clip.root_position[frame] * np.array([1.0, 0.0, 1.0])
            flat = np.stack([1.2 * place - pose @ ahead, pose[:, 1], 0 * pose[:, 1]], axis=-1)
            _stick_figure(axis, flat, clip.skeleton, 0, alpha=0.85)
        axis.set_title(title)
        axis.set_aspect("equal")
        axis.axis("off")
    for side in ("left", "right"):
        axes[0].plot([], [], color=LIMB_COLORS[side], linewidth=3, label=side)
    axes[0].legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=2, borderaxespad=0.1)
    return figure


@styled
def window_plan(history, future, paths: Mapping[str, np.ndarray], yaw):
    """Draw one window from above.

    Args:
      history, future: root x, z relative to the last history frame, [H, 2] and [T, 2].
      paths: label -> path condition x, z, [T, 2].
      yaw: facing of the path condition, [T], radians.
    """
    figure, (axis, side) = new_figure(8.2, 3.9, 1, 2, width_ratios=[1.0, 1.25])
    axis.plot(*history.T, ".-", color=PALETTE["black"], label="history")
    axis.plot(*future.T, color="#CDB9E6", linewidth=6.0, label="future (to be made)")
    lines = zip(paths.items(), ("orange", "green", "vermilion"), strict=False)
    for (label, path), color in lines:
        axis.plot(*path.T, color=PALETTE[color], label=label)
        side.plot(
            np.arange(1, len(path) + 1), 100 * _sideways(path, future), color=PALETTE[color],
            label=label,
        )  # fmt: skip
    marks = np.arange(3, len(yaw), 7)
    reach = 0.15 * max(np.ptp(future, axis=0).max(), 0.3)
    start = next(iter(paths.values()))[marks]
    ends = start + reach * np.stack([np.sin(yaw[marks]), np.cos(yaw[marks])], axis=-1)
    for tail, head in zip(start, ends, strict=True):
        axis.annotate("", head, tail, arrowprops={"arrowstyle": "-|>", "color": PALETTE["orange"]})
    axis.plot(0, 0, "o", color=PALETTE["vermilion"], label="last history frame = origin")
    _plan(axis, 0.1)
    axis.set_title("a window from above")
    axis.legend(loc="upper left", bbox_to_anchor=(0.0, -0.2), ncols=2, fontsize=8)
    side.set_title("the same paths, off their chord")
    side.set_xlabel("future frame")
    side.set_ylabel("sideways (cm)")
    side.legend()
    return figure


def _sideways(path, reference):
    """Distance of a path from the chord of a reference, positive to the left of the way."""
    chord = reference[-1] - reference[0]
    length = np.linalg.norm(chord)
    normal = np.array([chord[1], -chord[0]]) / max(length, 1e-9)
    return (path - path[0]) @ normal


@styled
def turned_windows(history, future):
    """Draw root paths of the same window under several random turns.

    Args:
      history, future: root x, z, [B, H, 2] and [B, T, 2].
    """
    figure, axis = new_figure(4.6, 3.9)
    for past, coming, shade in zip(history, future, shades(len(history)), strict=True):
        axis.plot(*past.T, color=shade, linestyle=":")
        axis.plot(*coming.T, color=shade)
    axis.plot(0, 0, "o", color=PALETTE["black"])
    axis.plot([], [], ":", color=PALETTE["grey"], label="history")
    axis.plot([], [], "-", color=PALETTE["grey"], label="future")
    axis.legend(loc="upper right")
    axis.set_title("one window, random facings")
    _plan(axis)
    return figure


_STYLES_BESIDE = 30  # As many boxes stand beside the histograms; more stand below them.


@styled
def clip_statistics_figure(clips: pd.DataFrame):
    """Draw speed, turning and contact share of a table of clips.

    Args:
      clips: one row a clip: style, mean_speed_m_s, turn_deg_s, toe_contact_fraction.
    """
    styles = clips.groupby("style")["mean_speed_m_s"].median().sort_values().index
    if len(styles) <= _STYLES_BESIDE:
        height = max(3.4, 0.24 * len(styles) + 1.3)
        figure, axes = new_figure(8.6, height, 1, 3, width_ratios=[1.0, 1.0, 1.35])
        boxes = axes[2:]
    else:  # The boxes below, in two columns: beside them the histograms would be towers.
        rows = -(-len(styles) // 2)
        heights = [2.4, 0.19 * rows + 0.8]
        figure, grid = new_figure(8.6, sum(heights), 2, 2, height_ratios=heights)
        axes, boxes = grid[0], grid[1]
    bins = int(np.clip(len(clips) // 3, 8, 30))
    axes[0].hist(clips["mean_speed_m_s"], bins=bins, color=PALETTE["purple"])
    axes[0].set_xlabel("mean speed (m/s)")
    axes[0].set_ylabel("clips")
    axes[0].set_title("how fast")
    axes[1].hist(clips["turn_deg_s"], bins=bins, color=PALETTE["green"])
    axes[1].set_xlabel("mean turn (degrees/s)")
    axes[1].set_title("how curved")
    for axis in axes[:2]:
        axis.yaxis.set_major_locator(MaxNLocator(integer=True))
    # The fastest stand on top, and in the left column.
    for axis, shown in zip(boxes, np.array_split(styles[::-1], len(boxes)), strict=True):
        groups = [clips.loc[clips["style"] == style, "toe_contact_fraction"] for style in shown]
        axis.boxplot(
            groups, orientation="horizontal", tick_labels=list(shown), widths=0.6,
            medianprops={"color": PALETTE["vermilion"]}, flierprops={"markersize": 3},
        )  # fmt: skip
        axis.invert_yaxis()
        axis.set_xlim(0, 1)
        axis.set_xlabel("share of toe steps in contact")
    boxes[0].set_title("how grounded")
    return figure


@styled
def channel_statistics(before, after, names: Sequence[str]):
    """Draw mean and deviation of every feature channel before and after normalising.

    Args:
      before, after: samples [..., C].
      names: joint names, for the root's three channels and six channels a joint.
    """
    figure, axes = new_figure(8.6, 4.4, 2, 1, sharex=True)
    for axis, values, title in zip(
        axes, (before, after), ("as built: metres and matrix entries", "normalised"), strict=True
    ):
        flat = np.asarray(values, np.float64).reshape(-1, np.shape(values)[-1])
        mean, deviation = flat.mean(axis=0), flat.std(axis=0)
        channel = np.arange(len(mean))
        axis.fill_between(
            channel, mean - deviation, mean + deviation, step="mid", color=PALETTE["sky"],
            linewidth=0, label="mean ± deviation",
        )  # fmt: skip
        axis.plot(channel, mean, ".", color=PALETTE["purple"], markersize=4, label="mean")
        axis.set_title(title)
        axis.set_ylabel("value")
    axes[0].legend(loc="lower right", ncols=2)
    places = 3 + 6 * np.arange(len(names))
    axes[1].set_xticks(np.append(0, places + 2.5), ["root", *names], rotation=90, fontsize=7)
    axes[1].set_xlim(-1, 3 + 6 * len(names))
    axes[1].grid(axis="x", visible=False)
    axes[0].grid(axis="x", visible=False)
    return figure
