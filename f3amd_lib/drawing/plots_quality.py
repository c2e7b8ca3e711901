"""What pictures of motion quality share: colours, few labels on a logarithmic axis, rows of poses.

Real motion is black and dashed, the bad generators have a colour each, networks theirs of
`figures.model_style`. Nothing is measured here; the pictures themselves are drawn in notebooks.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.ticker import FixedLocator, MaxNLocator

from f3amd_lib.drawing.plots import styled
from f3amd_lib.drawing.stick_figures import LIMB_COLORS, limb_side
from f3amd_lib.drawing.style import PALETTE, model_style, new_figure
from f3amd_lib.motion.skeleton import Motion

BAD_COLORS = {"frozen pose": "#4FA3CC", "shuffled frames": "#8C6D46", "noisy motion": "#C2649A"}
"""Colour of each bad generator (see `measures.corruptions`); no network is drawn in these."""


def color_of(name: str) -> str:
    """Return the colour of real motion, of a bad generator or of a network, by its name."""
    return BAD_COLORS.get(name) or model_style(name).color


def few_log_ticks(axis) -> None:
    """Label a logarithmic axis with a few round numbers, whatever its span.

    Args:
      axis: `Axes.xaxis` or `Axes.yaxis`, after the data were drawn.
    """
    low, high = sorted(axis.get_view_interval())
    steps = (1, 2, 5) if high < 100 * low else (1,)
    exponents = range(int(np.floor(np.log10(low))) - 1, int(np.ceil(np.log10(high))) + 1)
    ticks = [step * 10.0**exponent for exponent in exponents for step in steps]
    if sum(low <= tick <= high for tick in ticks) < 2:
        ticks = MaxNLocator(4).tick_values(low, high)
    ticks = [tick for tick in ticks if low <= tick <= high]
    axis.set_ticks(ticks, labels=[f"{tick:g}" for tick in ticks])
    axis.set_minor_locator(FixedLocator([]))


@styled
def poses_beside(motions: Mapping[str, Motion], frames: Sequence[int], *, width: float = 7.2):
    """Draw the same frames of several motions, a panel each, poses side by side.

    Every pose is seen from the character's own front right, wherever it goes.

    Args:
      motions: title -> motion, or None where a panel is to stay empty.
      frames: which, in this order.
      width: of the figure, inches.
    """
    rows, across = -(-len(motions) // 2), 0.95 * len(frames)
    # As high as its panels are at equal scale, and a line for the title.
    height = 0.4 + (width / 2 - 0.15) * 1.93 / across
    figure, axes = new_figure(width, height * rows, rows, 2, squeeze=False)
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
        axis.set_title(title, color=color_of(title))
    return figure
