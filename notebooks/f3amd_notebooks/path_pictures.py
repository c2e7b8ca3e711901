"""Pictures that move inside a notebook's page, and single poses of a body."""

from __future__ import annotations

import base64
import html
import io
from collections.abc import Sequence

import numpy as np
from f3amd_lib.drawing.pictures import crowd_colors, draw_crowd
from f3amd_lib.drawing.stick_figures import LIMB_COLORS, TARGET_COLOR, Camera, body_lines, drawn_points
from f3amd_lib.drawing.style import plot_style
from f3amd_lib.motion.skeleton import Motion
from IPython.display import HTML
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from PIL import Image, ImageSequence


def draw_pose(axis, motion: Motion, frame: int, *, at: float, facing: float, color: str = "", words: str = "") -> None:
    """Draw a body from its front right, its hips above a place on the page.

    Args:
      axis: of equal scale, in metres.
      motion, frame: whose pose.
      at: metres to the right on the page.
      facing: radians, from where the camera counts.
      color: of the whole body; left and right limbs have their own otherwise.
      words: below the feet.
    """
    points = drawn_points(motion, np.array([frame]))[0]
    points = points - points[0] + [0.0, 0.95, 0.0]
    lines, sides = body_lines(motion.skeleton, points)
    seen = Camera(facing - np.pi / 3, np.deg2rad(6.0)).project(lines)
    order = np.argsort(seen[:, :, 2].mean(axis=1))
    colors = [color or (LIMB_COLORS | {"head": LIMB_COLORS["middle"]})[sides[k]] for k in order]
    look = {"capstyle": "round", "snap": False, "zorder": 3}
    widths = [10.0 if sides[k] == "head" else 2.6 for k in order]
    axis.add_collection(LineCollection(seen[order, :, :2] + [at, 0.0], colors=colors, linewidths=widths, **look))
    axis.text(at, -0.12, words, ha="center", va="top", fontsize=8)


def moving_picture(pictures: Sequence[Image.Image], *, fps: float, alt: str, quality: int = 35) -> HTML:
    """Return pictures of one size as an animated WebP inside the page, which needs no script and no file beside it.

    Args:
      pictures: one a frame.
      fps: frames a second.
      alt: one sentence for a reader who does not see them.
      quality: of the WebP, 0 to 100.
    """
    buffer, durations = io.BytesIO(), [round(1000 / fps)] * (len(pictures) - 1) + [1000]  # a pause at the end
    first, *others = pictures
    look = {"save_all": True, "append_images": others, "duration": durations, "loop": 0, "quality": quality}
    first.save(buffer, "webp", method=4, **look)
    data = base64.b64encode(buffer.getvalue()).decode()
    return HTML(
        f"<img src='data:image/webp;base64,{data}' alt='{html.escape(alt)}' width='{first.width}' "
        "style='max-width:100%;height:auto'>"
    )


def inline(file, alt: str, seconds: float = 5.0) -> HTML:
    """Return the beginning of an animated GIF as such a picture."""
    with Image.open(file) as gif:
        fps, pictures = 1000 / gif.info["duration"], [frame.convert("RGB") for frame in ImageSequence.Iterator(gif)]
    return moving_picture(pictures[: round(fps * seconds)], fps=fps, alt=alt, quality=20)


@plot_style()
def walking(motions: Sequence[Motion], labels: Sequence[str], paths=(), *, width: int = 640, every: int = 2) -> HTML:
    """Return walkers on one floor as a moving picture; the floor stays where it is, so that feet can be judged.

    Args:
      motions: of one length and frame rate, near the origin.
      labels: above the heads.
      paths: target paths (`RootPath`), drawn on the floor.
      width: pixels.
      every: frames of the motion to a frame of the picture.
    """
    camera, half, height = Camera(np.deg2rad(20.0), np.deg2rad(20.0), (0.0, 0.75, 0.0), 10.0), 3.8, 0.53 * width
    figure = Figure(figsize=(width / 100, height / 100), dpi=100, layout="none")
    canvas, axis, pictures = FigureCanvasAgg(figure), figure.add_axes((0, 0, 1, 1)), []
    colors = crowd_colors(labels)
    for frame in range(0, motions[0].num_frames, every):
        axis.clear()
        axis.axis("off")
        axis.set(xlim=(-half, half), ylim=(-half * height / width, half * height / width))
        for path in paths:
            line = camera.project(np.insert(path.position, 1, 0.0, axis=1))
            axis.plot(*line[:, :2].T, color=TARGET_COLOR, linewidth=1.0, alpha=0.5, zorder=1.5)
        draw_crowd(axis, motions, colors, frame, camera, 0.36 * width / half)
        for motion, label, color in zip(motions, labels, colors, strict=True):
            x, y, _ = camera.project(motion.root_position[frame] * [1.0, 0.0, 1.0] + [0.0, 1.9, 0.0])
            axis.text(x, y, label, color=color, fontsize=8.5, fontweight="bold", ha="center", zorder=20)
        canvas.draw()
        pictures.append(Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB"))
    alt = f"{len(motions)} people walk along a circle on one floor, in the styles {', '.join(labels)}"
    return moving_picture(pictures, fps=motions[0].fps / every, alt=alt)
