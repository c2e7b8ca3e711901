"""A figure with a slider: lines that move, computed beforehand, without a kernel and without a script from elsewhere.

JupyterLab and a static page show the same cell output. A notebook that is not trusted, or a reader without JavaScript,
sees the frame at which the slider starts.
"""

from __future__ import annotations

import base64
import hashlib
import html
import json

import numpy as np
from f3amd_lib.drawing.style import show_figure
from IPython.display import HTML
from matplotlib.colors import to_hex

_DPI = 76  # as other figures of a notebook
_FINE = 2  # parts of a pixel that lines are rounded to

_DASHES = {"--": " stroke-dasharray='{:.1f} {:.1f}'"}

# Everything that moves stands in the slider's own attribute, so that two figures on a page need no names.
_MOVE = (
    'const f=JSON.parse(this.dataset.frames)[this.value],b=this.closest("figure");'
    'b.querySelectorAll("path[data-line]").forEach((p,i)=>p.setAttribute("d",f[1][i]));'
    'b.querySelector("output").textContent=f[0];this.setAttribute("aria-valuetext",f[0])'
)


def slide(figure, lines, frames: dict, *, label: str, start: int = 0, alt: str, colors: int = 24) -> HTML:
    """Return a figure under a slider that moves some of its lines.

    Args:
      figure: from `new_figure`, drawn but for the lines that move. Legends and limits are final.
      lines: matplotlib lines of the figure that move; colour, width, dashes and round markers are kept.
      frames: what the slider shows at each of its places, in order: words ("σ = 1") to one array [n, 2] a line, in
        the units of the line's axes. A row of NaN lifts the pen.
      label: what the slider sets.
      start: the place where it begins, counted from 0.
      alt: one sentence for a reader who does not see the figure.
      colors: of what does not move.

    Returns:
      HTML without addresses, for a cell's last line.

    Raises:
      ValueError: if a frame has not one array [n, 2] for each line, or `start` is not one of its places.
    """
    if not 0 <= start < len(frames):
        raise ValueError(f"start: a place from 0 to {len(frames) - 1} was expected, got {start}")
    for name, arrays in frames.items():
        if [np.shape(array)[1:] for array in arrays] != [(2,)] * len(lines):
            found = [np.shape(array) for array in arrays]
            raise ValueError(f"frames[{name!r}]: {len(lines)} arrays [n, 2] were expected, one a line; got {found}")
    figure.set_dpi(_DPI)
    figure.draw_without_rendering()  # places are final only after a layout
    width, height = figure.get_size_inches() * _DPI
    for line in lines:
        line.set_visible(False)
    background = base64.b64encode(show_figure(figure, dpi=_DPI, colors=colors).data).decode()

    moved = [[name, [_path(line, array, height) for line, array in zip(lines, arrays, strict=True)]]
             for name, arrays in frames.items()]  # fmt: skip
    content = json.dumps(moved, ensure_ascii=False, separators=(",", ":"))
    mark = hashlib.sha256((content + background).encode()).hexdigest()[:8]
    shown, paths = moved[start]
    drawn = "".join(_drawn(line, path, f"{mark}-{i}") for i, (line, path) in enumerate(zip(lines, paths, strict=True)))
    areas = "".join(_area(line, height, f"{mark}-{i}") for i, line in enumerate(lines))
    text = html.escape  # quotes, too; attributes stand in single ones, which a notebook's file need not escape
    fill = "position:absolute;left:0;top:0;width:100%;height:100%"
    return HTML(
        f"<figure class='slider' style='margin:0;max-width:{width:.0f}px'>"
        f"<label style='display:flex;gap:.8em;align-items:center'>{text(label)} <input type='range' min='0' "
        f"max='{len(frames) - 1}' value='{start}' autocomplete='off' style='flex:1;min-width:6em' "
        f"aria-valuetext='{text(shown)}' data-frames='{_in_quotes(content)}' oninput='{_MOVE}'>"
        f"<output aria-live='off' style='min-width:5em'>{text(shown)}</output></label><div style='position:relative'>"
        f"<img src='data:image/png;base64,{background}' alt='{text(alt)}' style='display:block;width:100%'>"
        f"<svg viewBox='0 0 {width * _FINE:.0f} {height * _FINE:.0f}' aria-hidden='true' style='{fill}'>"
        f"<defs>{areas}</defs>{drawn}</svg></div></figure>"
    )


def _in_quotes(content: str) -> str:
    return content.replace("&", "&amp;").replace("'", "&#39;").replace("<", "&lt;")


def _path(line, array, height: float) -> str:
    """Return SVG's words for a line, in parts of a pixel from the upper left; all but first points are differences."""
    array = np.asarray(array, float)
    points = line.get_transform().transform(array)
    points = np.stack([points[:, 0], height - points[:, 1]], axis=-1) * _FINE
    words, last = [], None
    for x, y in points:
        if not np.isfinite(x + y):
            last = None
            continue
        place = round(x), round(y)
        words.append(f"M{place[0]} {place[1]}l0 0" if last is None else f" {place[0] - last[0]} {place[1] - last[1]}")
        last = place
    return "".join(words).replace(" -", "-")


def _area(line, height: float, mark: str) -> str:
    """Return the frame of a line's axes, outside of which nothing is drawn, and its marker."""
    box, radius = line.axes.bbox, _pixels(line.get_markersize()) / 2
    dot = (
        f"<marker id='dot-{mark}' viewBox='-1 -1 2 2' markerUnits='userSpaceOnUse' markerWidth='{2 * radius:.1f}' "
        f"markerHeight='{2 * radius:.1f}'><circle r='1' fill='{to_hex(line.get_color())}'/></marker>"
    )
    return (
        f"<clipPath id='axes-{mark}'><rect x='{box.x0 * _FINE:.0f}' y='{(height - box.y1) * _FINE:.0f}' "
        f"width='{box.width * _FINE:.0f}' height='{box.height * _FINE:.0f}'/></clipPath>"
    ) + (dot if line.get_marker() == "o" else "")


def _drawn(line, path: str, mark: str) -> str:
    """Return a line as it looks at the start."""
    width = _pixels(line.get_linewidth())
    look = f"stroke-width='{width:.1f}'" + _DASHES.get(line.get_linestyle(), "").format(4 * width, 2 * width)
    if line.get_marker() == "o":
        look += "".join(f" marker-{place}='url(#dot-{mark})'" for place in ("start", "mid", "end"))
    return (
        f"<path data-line='' d='{path}' fill='none' stroke='{to_hex(line.get_color())}' {look} "
        f"stroke-linejoin='round' clip-path='url(#axes-{mark})'/>"
    )


def _pixels(points: float) -> float:
    return points / 72 * _DPI * _FINE
