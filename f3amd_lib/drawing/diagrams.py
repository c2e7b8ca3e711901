"""What notebooks on networks share: boxes and arrows, and maps of which frame reaches which."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

from f3amd_lib.drawing.style import PALETTE, new_figure, plot_style


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
