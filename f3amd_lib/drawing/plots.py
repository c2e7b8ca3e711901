"""What drawing shares: the project's style for functions of the library, shades, keeping a figure.

A picture itself is drawn in the cell of the notebook that shows it.
"""

from __future__ import annotations

import functools
import io
from pathlib import Path

import matplotlib
import numpy as np
from PIL import Image

from f3amd_lib.drawing.style import plot_style, save_figure, show_figure


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
    light.quantize(64, method=Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE).save(buffer, "png", optimize=True)
    shown.data = buffer.getvalue()
    return shown


def shades(count: int) -> list[tuple]:
    """Return dark to light shades of one colour, for curves in an order."""
    return [matplotlib.colormaps["viridis"](value) for value in np.linspace(0.05, 0.85, count)]
