"""Drawings of several notebooks: boxes and arrows, which frame reaches which, poses and toes of several models."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence

import numpy as np
from f3amd_lib.drawing.pictures import SLOT, draw_poses
from f3amd_lib.drawing.stick_figures import LIMB_COLORS
from f3amd_lib.drawing.style import PALETTE, model_style, new_figure, plot_style
from f3amd_lib.motion.skeleton import Motion
from matplotlib.ticker import LogLocator


def boxes(axis, y: float, parts: Sequence[tuple]) -> list:
    """Draw texts in boxes from left to right, with an arrow from each to the next.

    Args:
      axis: in inches or any other unit, without decoration.
      y: height of their middles.
      parts: (x of the middle, text, colour) each; "white" has an edge, "dashed" a broken one (what the
        paper does not draw), "none" no box. One sign (+, ×, ...) is put into a circle.

    Returns:
      The texts, for `arrow`.
    """
    drawn = []
    for x, text, color in parts:
        filled = color not in ("white", "dashed", "none")
        look = {"boxstyle": "circle,pad=0.2" if len(text) == 1 else "round,pad=0.45,rounding_size=0.3"}
        look |= {"facecolor": color, "edgecolor": "none"}
        if color in ("white", "dashed"):
            look |= {"facecolor": "white", "edgecolor": PALETTE["black"]}
            look["linestyle"] = (0, (3, 2)) if color == "dashed" else "-"
        if color == "none":
            look["boxstyle"] = "square,pad=0.2"
        font = {"color": "white", "weight": "bold"} if filled else {"color": PALETTE["black"]}
        drawn.append(axis.text(x, y, text, ha="center", va="center", fontsize=8, bbox=look, **font))
    for start, end in itertools.pairwise(drawn):
        arrow(axis, start, end)
    return drawn


def arrow(axis, start, end, *, bend: str = "arc3") -> None:
    """Draw an arrow from the edge of one box to the edge of another.

    Args:
      start, end: texts of `boxes`.
      bend: a connection style of matplotlib; "angle,angleA=0,angleB=90" goes right, then up or down.
    """
    look = {"arrowstyle": "-|>", "connectionstyle": bend, "facecolor": PALETTE["black"], "linewidth": 1.1}
    look |= {"mutation_scale": 9, "shrinkA": 0, "shrinkB": 0}
    look |= {"patchA": start.get_bbox_patch(), "patchB": end.get_bbox_patch()}
    axis.annotate("", end.get_position(), start.get_position(), arrowprops=look)


@plot_style()
def influence_maps(maps, across="input frame", down="output frame", highest=None, label="size of the derivative"):
    """Draw how strongly each input frame reaches each output frame, a panel for each layer.

    Args:
      maps: title -> array [T out, T in], not negative.
      across, down: what the columns and the rows are.
      highest: where the colour scale ends, all above in its last colour; by default at the largest
        value.
      label: of the colour scale.
    """
    height = 3.2 if len(maps) < 4 else 2.6
    figure, axes = new_figure(len(maps) * (height - 0.75) + 1.4, height, 1, len(maps), sharey=True, squeeze=False)
    largest = max(values.max() for values in maps.values())
    for axis, (title, values) in zip(axes[0], maps.items(), strict=True):
        image = axis.imshow(values, cmap="viridis", vmin=0.0, vmax=highest or largest)
        axis.set(title=title, xlabel=across)
        axis.grid(visible=False)
    axes[0, 0].set_ylabel(down)
    beyond = "max" if highest and largest > highest else "neither"
    figure.colorbar(image, ax=list(axes[0]), label=label, shrink=0.85, extend=beyond)
    return figure


@plot_style()
def poses_beside(
    motions: Mapping[str, Motion | None], frames: Sequence[int], *, width: float = 7.2, below: float = 0.4
):
    """Draw the same frames of several motions, a panel each, timed poses side by side.

    Every pose is seen from the character's own front right, wherever it goes.

    Args:
      motions: title -> motion, or None where a panel is to stay empty.
      frames: which, in this order.
      width: of the figure, inches.
      below: room under the ground of each panel, metres, where a notebook may draw on; poses stand `SLOT` apart.
    """
    rows, panel = -(-len(motions) // 2), width / 2 - 0.15
    # As high as its panels are at equal scale, and a line for the title.
    inches = panel / (SLOT * len(frames))  # a metre
    figure, axes = new_figure(width, (0.4 + inches * (1.85 + below)) * rows, rows, 2, squeeze=False)
    for axis in axes.flat:
        axis.axis("off")
    for axis, (title, motion) in zip(axes.flat, motions.items(), strict=False):
        if motion is not None:
            draw_poses(axis, motion, np.asarray(frames), scale=72 * inches, numbered=False)
            axis.set_ylim(-below, 1.85)
            axis.set_title(title, color=model_style(title).color)
    return figure


def draw_toes(figure, motions: Mapping[str, Motion | None], frames: range) -> None:
    """Draw below each panel of `poses_beside` how high the toes are, thick where a toe rests.

    Args:
      figure: of `poses_beside(motions, frames, below=1.1)`.
      motions, frames: the same; frames a range, and every one between its ends is drawn.
    """
    every = np.arange(frames[0], frames[-1] + 1)
    along = SLOT * (every - frames[0]) / frames.step  # a time stands below its pose
    for axis, motion in zip(figure.axes, motions.values(), strict=False):
        if motion is None:
            continue
        height = motion.positions[every][:, list(motion.skeleton.toes), 1]
        height = 4.0 * (height - height.min()) - 1.0  # four times as high, below the poses
        for foot, side in enumerate(("left", "right")):
            color = LIMB_COLORS[side]
            axis.plot(along, height[:, foot], color=color, linewidth=0.9, label=f"{side} toe")
            axis.plot(along, np.where(motion.contacts[every, foot], height[:, foot], np.nan), color=color, linewidth=3)
    figure.axes[0].plot([], [], color=PALETTE["black"], linewidth=3, label="a toe rests")
    figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside lower left", ncols=3)


def system_line(label: str) -> dict:
    """Return keyword arguments for `Axes.plot` of a model at some steps, "F3AMD-FNO-96, 8 steps".

    One step is dotted, with open markers.
    """
    name, _, steps = label.partition(", ")
    return model_style(name).line | ({"linestyle": ":", "markerfacecolor": "white"} if steps == "1 step" else {})


def label_log_axis(axis, places: Sequence[float] = (1, 3)) -> None:
    """Label a logarithmic axis (`axes.xaxis` or `axes.yaxis`) at these places of each decade, and nowhere else.

    An axis that shows fewer than two of them is labelled at even steps by matplotlib.
    """
    axis.set_major_locator(LogLocator(subs=places))
    axis.set_major_formatter("{x:g}")
    axis.set_minor_formatter("")
