"""How every figure looks: style sheet, colours by model name, saving.

Colours keep apart for colour-blind readers and, by lightness and marker, in grey print too.
"""

import hashlib
import io
import re
from dataclasses import dataclass
from pathlib import Path

import matplotlib
import matplotlib.style
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from PIL import Image

from f3amd_lib.ground.files import named_file, read_toml, write_whole

_COLORS = read_toml(Path(__file__).with_name("colors.toml"))
PALETTE: dict[str, str] = _COLORS["palette"]
"""Colours from dark to light; neighbours in this order differ in lightness as well as in hue."""

STYLE_SHEET = Path(__file__).with_name("project.mplstyle")


@dataclass(frozen=True)
class ModelStyle:
    """How one model is drawn everywhere: colour, marker and line style."""

    color: str
    marker: str
    linestyle: str

    @property
    def line(self) -> dict:
        """Keyword arguments for `Axes.plot`."""
        return {"color": self.color, "marker": self.marker, "linestyle": self.linestyle}


def model_style(name: str) -> ModelStyle:
    """Return colour, marker and line style of a model by its name.

    Args:
      name: a preset's name ("F3AMD-FNO-96", "CAMDM", ...), "real" for real motion, "paper" for
        a printed number, or a kind of broken motion; suffixes such as "(FiLM)" keep the family's
        colour, our own recipes ("-plus", "-steady") have one of their own.

    Returns:
      The style. A name of no known family is drawn in grey.
    """
    lowered = name.lower()
    number = re.search(r"-(32|48|64|96|128)(?!\d)", lowered)
    width = number[1] if number else "96"
    look = next(look for look in _COLORS["model"] if re.match(look["name"], lowered))
    shades = _COLORS["shades"].get(look["color"])
    color = shades[width] if shades else PALETTE.get(look["color"], look["color"])
    return ModelStyle(color, look.get("marker", _COLORS["markers"][width]), look.get("line", "-"))


def shades(count: int) -> list[tuple]:
    """Return dark to light shades of one colour, for curves in an order."""
    return [matplotlib.colormaps["viridis"](value) for value in np.linspace(0.05, 0.85, count)]


def use_style() -> None:
    """Use the project's style sheet from here on: for a notebook's first cell.

    matplotlib looks titles, legends and labels up when they are made, so the style must be in
    force then, and not only when the figure is started. Library code uses `plot_style` instead.
    """
    matplotlib.style.use(STYLE_SHEET)


def plot_style():
    """Use the project's style sheet inside a `with` block, or a function that this decorates."""
    return matplotlib.style.context(STYLE_SHEET)


def new_figure(width: float = 7.0, height: float = 3.6, nrows: int = 1, ncols: int = 1, **grid):
    """Start a figure in the project's style, without touching pyplot's state.

    Args:
      width, height: inches.
      nrows, ncols: grid of axes.
      grid: passed to `Figure.subplots`.

    Returns:
      (figure, axes), axes as from `Figure.subplots`.
    """
    with plot_style():
        figure = Figure(figsize=(width, height))
        FigureCanvasAgg(figure)
        return figure, figure.subplots(nrows, ncols, **grid)


def save_figure(figure: Figure, path) -> Path:
    """Write a figure as PNG of at most 256 colours, whose bytes depend on the drawing alone.

    No date and no software version is written, so that an unchanged figure is an unchanged file.
    A figure drawn before is replaced.

    Args:
      figure: what to write.
      path: ends in .png; folders are made.

    Returns:
      The path.

    Raises:
      ValueError: if the name does not end in .png.
    """
    path = named_file(path, ".png", "figures")
    return write_whole(path, _few_colors(_png(figure, None), 256))


def show_figure(figure: Figure, *, dpi: int = 100, colors: int | None = None):
    """Return the figure as an image that Jupyter shows when it is a cell's last value.

    Args:
      figure: what to show.
      dpi: dots an inch.
      colors: keep this many; a third of the bytes, of which a notebook has few.
    """
    from IPython.display import Image as Shown

    return Shown(data=_png(figure, dpi) if colors is None else _few_colors(_png(figure, dpi), colors))


def keep_figure(figure: Figure, results, name: str, colors: int = 48, data: str = ""):
    """Save a figure as `<results>/figures/<name>.png` and return a light copy for the notebook.

    Args:
      figure: any.
      results: from `profiles.results_dir`.
      name: without folder and ending.
      colors: of the copy.
      data: the data set that is shown or measured, to be named in the lower right corner; none in theory.

    Returns:
      An image for a cell's last line: smaller, and in few colours. Its metadata have the SHA-256 of the file in full
      size, by which the site finds it.
    """
    from IPython.display import Image as Shown

    if data:
        figure.supxlabel(f"data: {data}", x=0.995, ha="right", fontsize=7, color=PALETTE["grey"])
    png = save_figure(figure, Path(results) / "figures" / f"{name}.png").read_bytes()
    # The same drawing, scaled: laid out again at fewer dots, labels would have other widths.
    return Shown(data=_few_colors(png, colors, dpi=76), metadata={"full": hashlib.sha256(png).hexdigest()})


def _few_colors(png: bytes, colors: int, dpi: int | None = None) -> bytes:
    whole, small = Image.open(io.BytesIO(png)), io.BytesIO()
    scale = dpi / whole.info["dpi"][0] if dpi else 1
    whole = whole.convert("RGB").resize([round(scale * side) for side in whole.size], Image.Resampling.BOX)
    few = whole.quantize(colors, Image.Quantize.MAXCOVERAGE, kmeans=1, dither=Image.Dither.NONE)
    few.save(small, "png", optimize=True, dpi=[scale * dots for dots in whole.info["dpi"]])
    return small.getvalue()


def _png(figure: Figure, dpi: int | None) -> bytes:
    buffer = io.BytesIO()
    with plot_style():
        # Axes of a fixed aspect have their final size only after a first layout, and titles and
        # labels are kept inside the picture only by a second one.
        laid_out = isinstance(figure.get_layout_engine(), ConstrainedLayoutEngine)
        if laid_out and any(axis.get_aspect() != "auto" for axis in figure.axes):
            figure.draw_without_rendering()
        figure.savefig(buffer, format="png", dpi=dpi, metadata={"Software": None})
    return buffer.getvalue()
