"""Motion as pictures: film strips, rows of poses, crowds for the page; GIFs for the eye.

All draw the stick figures of `stick_figures`, with a green dot under a toe that is in contact. Of a
skeleton whose toes are not known no contacts are shown; one whose hips are not known is taken to
face +Z, and no facing is drawn.
"""

import itertools
import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.colors import to_hex, to_rgb
from matplotlib.figure import Figure
from PIL import Image
from scipy.ndimage import gaussian_filter1d

from f3amd_lib.drawing import stick_figures
from f3amd_lib.drawing.stick_figures import Camera
from f3amd_lib.drawing.style import PALETTE, new_figure, plot_style
from f3amd_lib.ground.files import named_file, whole_file
from f3amd_lib.motion.skeleton import Motion

# ------------------------------------------------------------------------------------ one body

_THIN = {"left": 0.05, "right": 0.05, "middle": 0.05, "head": 0.18}  # metres
_STOUT = {"left": 0.095, "right": 0.095, "middle": 0.147, "head": 0.22}  # as thick as people
_COLORS = stick_figures.LIMB_COLORS | {"head": stick_figures.LIMB_COLORS["middle"]}


def _draw_body(
    axis, skeleton, points, camera: Camera, scale: float, *, left=0.0, touching=(), thick=_THIN, colors=_COLORS, rim=0.0
) -> None:
    """Draw a body and its shadow as a camera sees them, far lines first.

    Args:
      points: [J + tips, 3], metres, a frame of `drawn_points`.
      scale: of thickness, in 1/72 inch a metre.
      left: metres to the right on the page.
      touching: joints that get the dot of a contact.
      thick, colors: of left and right limbs, trunk and head.
      rim: of white around every line, in 1/72 inch.
    """
    shift = np.array([left, 0.0])
    shadow = camera.project(_on_ground(_CIRCLE + points[0, [0, 2]]))
    axis.fill(*(shadow[:, :2] + shift).T, color="#DFDFDF", linewidth=0, zorder=1)
    lines, sides = stick_figures.body_lines(skeleton, points)
    seen = camera.project(lines)
    towards = seen[:, :, 2].mean(axis=1)
    order = np.argsort(towards)
    nearer = np.maximum(1.0 - towards / camera.distance, 0.05)
    widths = np.array([scale * thick[side] for side in sides]) / nearer
    ends, look = seen[order, :, :2] + shift, {"capstyle": "round", "zorder": 5, "snap": False}
    if rim:
        axis.add_collection(LineCollection(ends, colors="white", linewidths=widths[order] + rim, **look))
    line_colors = [colors[sides[k]] for k in order]
    axis.add_collection(LineCollection(ends, colors=line_colors, linewidths=widths[order], **look))
    if len(touching):
        dots = camera.project(points[touching])[:, :2] + shift
        look = {"markersize": 0.09 * scale, "markeredgecolor": "white", "markeredgewidth": 0.01 * scale}
        axis.plot(*dots.T, "o", color=stick_figures.CONTACT_COLOR, zorder=9, **look)


_TURN = np.linspace(0, 2 * np.pi, 24, endpoint=False)
_CIRCLE = 0.27 * np.stack([np.sin(_TURN), np.cos(_TURN)], axis=-1)


def _on_ground(xz: np.ndarray) -> np.ndarray:
    return np.stack([xz[..., 0], np.zeros(xz.shape[:-1]), xz[..., 1]], axis=-1)


def _toes_down(motion: Motion, frames) -> list:
    """Toes in contact at each frame that is asked for."""
    toes = np.array(stick_figures.toes_of(motion.skeleton))
    return [toes[np.asarray(row, bool)] for row in motion.contacts[frames]] if len(toes) else [()] * len(frames)


def _beside_each_other(motions, paths, titles) -> list[tuple]:
    """(motion, path or None, title) of each; one path or title stands for all."""
    motions = [motions] if isinstance(motions, Motion) else list(motions)
    if not motions:
        raise ValueError("a picture needs at least one motion")
    listed = lambda value: value if isinstance(value, (list, tuple)) else [value] * len(motions)
    named = [each.name if title is None else title for each, title in zip(motions, listed(titles), strict=True)]
    return list(zip(motions, listed(paths), named, strict=True))


# --------------------------------------------------------------------------- film strips and poses


@plot_style()
def film_strip(motions, *, paths=None, titles=None, num_poses: int = 8, frames: Sequence[int] | None = None):
    """Draw poses side by side and the root's path from above, one row a motion.

    Each pose is seen from the character's own front right (its smoothed facing), so that gaits
    can be compared however the path turns; where it goes is the plan's business. Numbers on the
    poses are the numbered dots of the plan, short strokes there show the facing.

    Args:
      motions: a `Motion` or a list of them.
      paths: target path (a `RootPath` or [T, 2]), or a list of one (or None) a motion.
      titles: a title, or a list of one a motion; by default the motion's name.
      num_poses: poses a row, evenly spaced in time from the first frame to the last.
      frames: frame numbers to draw instead, the same for every row.

    Returns:
      A matplotlib Figure; `style.save_figure` writes it, `style.show_figure` shows it.

    Raises:
      ValueError: for no motion.
      IndexError: for frames that a motion does not have.
    """
    rows = _beside_each_other(motions, paths, titles)
    count = num_poses if frames is None else len(frames)
    widths = [0.96 * count, 2.9]
    figure, axes = new_figure(sum(widths), 2.45 * len(rows), len(rows), 2, squeeze=False, width_ratios=widths)
    for (poses, plan), (motion, path, title) in zip(axes, rows, strict=True):
        last = motion.num_frames - 1
        chosen = np.linspace(0, last, count).round().astype(int) if frames is None else np.asarray(frames)
        draw_poses(poses, motion, chosen)
        poses.set_title(title or " ")
        _draw_plan(plan, motion, chosen, path)
    # One scale for all rows, wide enough for the arms of the last pose.
    ends = np.array([poses.get_xlim() for poses in axes[:, 0]])
    for poses in axes[:, 0]:
        poses.set_xlim(ends[:, 0].min(), ends[:, 1].max())
    for side in ("left", "right"):
        axes[0, 0].plot([], [], color=stick_figures.LIMB_COLORS[side], linewidth=3, label=side)
    if any(stick_figures.toes_of(motion.skeleton) for motion, *_ in rows):
        axes[0, 0].plot([], [], "o", color=stick_figures.CONTACT_COLOR, markersize=5, label="toe in contact")
    small = {"fontsize": 8, "handlelength": 1.2, "columnspacing": 1.2, "borderaxespad": 0.2}
    # Below everything: titles may be as long as the strip.
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower left", ncols=3, **small)
    axes[0, 1].set_title("from above", fontsize=9, fontweight="normal")
    if rows[0][1] is not None:
        axes[0, 1].legend(fontsize=7, loc="best", handlelength=1.6)
    return figure


SLOT = 1.15  # metres of page a pose


def draw_poses(axis, motion: Motion, chosen, *, scale: float = 60.0, numbered: bool = True) -> None:
    """Draw chosen frames side by side, `SLOT` apart, each from its own front right; scale: 1/72 inch a metre."""
    points = stick_figures.drawn_points(motion, chosen)
    yaw, touching = stick_figures.yaw_of(motion), _toes_down(motion, chosen)
    facing = np.zeros(len(chosen))
    if yaw is not None:
        facing = gaussian_filter1d(np.unwrap(yaw), 0.3 * motion.fps, mode="nearest")[chosen]
    axis.axhline(0.0, color="#B8B8B8", linewidth=1.0, zorder=0)
    for place, frame in enumerate(chosen):
        camera = Camera(facing[place] - np.pi / 3, np.deg2rad(6.0), points[place, 0] * [1.0, 0.0, 1.0])
        _draw_body(axis, motion.skeleton, points[place], camera, scale, left=place * SLOT, touching=touching[place])
        center = {"ha": "center", "va": "top", "fontsize": 8 if numbered else 7}
        if numbered:
            axis.text(place * SLOT, -0.14, f"{place + 1}", fontweight="bold", **center)
        axis.text(place * SLOT, -0.32 if numbered else -0.1, f"{frame / motion.fps:.1f} s", color="#666666", **center)
    drawn = axis.dataLim.intervalx  # bodies and dots; neither limbs nor shadows are cut off
    axis.set_xlim(min(-0.55 * SLOT, drawn[0] - 0.05), max((len(chosen) - 0.45) * SLOT, drawn[1] + 0.05))
    axis.set_ylim(-0.5, max(1.7, points[..., 1].max() + 0.2))
    axis.set_aspect("equal", adjustable="box", anchor="W")
    axis.axis("off")


def _draw_plan(axis, motion: Motion, chosen, path) -> None:
    root = np.asarray(motion.root_position, dtype=np.float64)[:, [0, 2]]
    target = root if path is None else stick_figures.path_on_ground(path)
    if path is not None:
        axis.plot(*target.T, color=stick_figures.TARGET_COLOR, linestyle="--", linewidth=1.6, label="target", zorder=3)
    axis.plot(*root.T, color=stick_figures.TRAIL_COLOR, linewidth=1.6, label="walked")
    everything = np.concatenate([root, target])
    extent = np.ptp(everything, axis=0).max()
    reach, side = 0.09 * max(extent, 1.0), max(1.25 * extent, 2.0)
    yaw, numbered = stick_figures.yaw_of(motion), np.full(2, np.inf)
    for place, frame in enumerate(chosen, start=1):
        angle = 0.0 if yaw is None else yaw[frame]
        ahead, beside = np.array([[np.sin(angle), np.cos(angle)], [np.cos(angle), -np.sin(angle)]])
        if yaw is not None:
            axis.plot(*np.stack([root[frame], root[frame] + reach * ahead]).T, color="#1A1A1A", linewidth=1.4)
        axis.plot(*root[frame], "o", color="#1A1A1A", markersize=3.5)
        # A figure is as high as 6 % of the side: dots that are nearer to each other share one.
        if np.linalg.norm(root[frame] - numbered) > 0.06 * side:
            numbered = root[frame]
            axis.text(*(numbered - 0.8 * reach * beside), f"{place}", fontsize=7, ha="center", va="center")
    # A square window with some air, never narrower than 2 m: a standing figure is no path.
    frame_from_above(axis, everything, half=0.5 * side)
    axis.locator_params(nbins=4)
    axis.set_xlabel("x (m)", fontsize=8, labelpad=1)
    axis.set_ylabel("z (m)", fontsize=8, labelpad=1)
    axis.tick_params(labelsize=7)


def frame_from_above(axis, points: np.ndarray, half: float) -> None:
    """Show a square around points [N, 2], with +Z up the page and +X to the left: a left turn looks like one.

    Args:
      half: half the side of the square, metres.
    """
    x, z = 0.5 * (points.min(axis=0) + points.max(axis=0))
    axis.set(xlim=(x + half, x - half), ylim=(z - half, z + half))
    axis.set_aspect("equal", adjustable="box")


# ------------------------------------------------------------------------------------------ crowds


def crowd_colors(labels: Sequence[str]) -> list[str]:
    """Give each label (a style) a colour: the project's six, then lighter and darker ones.

    Args:
      labels: of each character.

    Returns:
      A colour each, as "#rrggbb", dealt in the order in which labels first occur.
    """
    base = np.array([to_rgb(PALETTE[c]) for c in ("purple", "orange", "green", "vermilion", "blue", "sky")])
    turns = [base, base + 0.3 * (1 - base), 0.7 * base, base + 0.42 * (1 - base), 0.5 * base]
    dealt = dict(zip(dict.fromkeys(labels), itertools.cycle(np.concatenate(turns)), strict=False))
    return [to_hex(dealt[label]) for label in labels]


@plot_style()
def crowd_figure(crowds: Mapping[str, tuple], frame: int, *, width: float = 12.0):
    """Draw crowds in perspective, a panel each, all seen from where the whole of the first one fills its panel.

    Bodies have the thickness of a person's, far ones come first and paler. Nearer limbs cover those
    behind them by an outline in white, which keeps bodies apart in grey print too. On the ground lies
    where the lower toe was in the last second and a half: supporting feet leave dots, sliding feet strokes.

    Args:
      crowds: title (further lines stand smaller below it) -> (motions, a colour for each).
      frame: of the motions.
      width: of the figure, inches.

    Returns:
      A matplotlib Figure.

    Raises:
      ValueError: for no crowd, or an empty one.
    """
    if not crowds or not all(motions for motions, _ in crowds.values()):
        raise ValueError("a picture of crowds needs at least one crowd, and somebody in each")
    columns = min(2, len(crowds))
    rows, panel = -(-len(crowds) // columns), width / columns
    roots = np.array([motion.root_position[frame, [0, 2]] for motion in next(iter(crowds.values()))[0]], float)
    x, z = middle = 0.5 * (roots.min(axis=0) + roots.max(axis=0))
    reach = np.linalg.norm(roots - middle, axis=-1).max()
    camera = Camera(np.deg2rad(25.0), np.deg2rad(20.0), (x, 0.9, z), 6.0 + 2.0 * reach)
    # Room around everybody: an arm's length to the sides, from the ground to above the head.
    around = np.array(list(itertools.product((-0.8, 0.8), (0.0, 2.0), (-0.8, 0.8))))
    seen = camera.project(_on_ground(roots)[:, None] + around)[..., :2].reshape(-1, 2)
    (left, low), (right, high) = seen.min(axis=0), seen.max(axis=0)
    lines = max(len(title.splitlines()) for title in crowds)
    # As high as its panels are at equal scale, and room for titles and for what may stand below all.
    height = rows * (panel * (high - low) / (right - left) + (0.13 + 0.2 * lines) * (lines > 0)) + 0.2
    figure, axes = new_figure(width, height, rows, columns, squeeze=False)
    for axis in axes.flat:
        axis.axis("off")
    for axis, (title, (motions, colors)) in zip(axes.flat, crowds.items(), strict=False):
        axis.set(xlim=(left, right), ylim=(low, high), aspect="equal")
        draw_crowd(axis, motions, colors, frame, camera, 72.0 * 0.97 * panel / (right - left))
        heading, _, note = title.partition("\n")
        if heading:
            axis.set_title(heading, pad=6 + 12 * len(note.splitlines()))
        # A long note does not make its panel narrower.
        axis.text(0.0, 1.015, note, transform=axis.transAxes, fontsize=9, color="#444444", in_layout=False)
    return figure


def draw_crowd(axis, motions, colors, frame: int, camera: Camera, scale: float) -> None:
    """Draw a moment of a crowd as a camera sees it: ground, footprints of the last 1.5 s, bodies, far ones paler.

    Args:
      axis: one metre at the camera's target is one unit of it.
      motions: of everybody.
      colors: one each.
      frame: of the motions.
      camera: with a distance that is finite.
      scale: of a metre, in 1/72 inch.
    """
    bodies = [stick_figures.drawn_points(motion, np.array([frame]))[0] for motion in motions]
    depths = camera.distance - camera.project([points[0] for points in bodies])[:, 2]
    axis.add_collection(_ground_lines(camera, 2.0, 8.0 * camera.distance, "#E6E6E6"))
    for k in np.argsort(-depths):
        motion, color = motions[k], np.array(to_rgb(colors[k]))
        paler = 0.4 * (depths[k] - depths.min()) / max(np.ptp(depths), 3.0)  # who walk abreast look alike
        tints = {"left": color + 0.22 * (1 - color), "right": 0.82 * color, "middle": color, "head": color}
        tints = {side: tint + paler * (1 - tint) for side, tint in tints.items()}
        first = max(0, frame - round(1.5 * motion.fps))
        past = motion.positions[first : frame + 1, stick_figures.toes_of(motion.skeleton)]
        for foot in range(past.shape[1]):
            lower = past[:, foot, 1] <= past[..., 1].min(axis=1)
            prints = np.where(lower[:, None], past[:, foot][:, [0, 2]], np.nan)
            look = {"color": tints["middle"], "alpha": 0.6, "linewidth": 0.1 * scale * camera.distance / depths[k]}
            axis.plot(*camera.project(_on_ground(prints))[:, :2].T, solid_capstyle="round", zorder=2, **look)
        _draw_body(axis, motion.skeleton, bodies[k], camera, scale, thick=_STOUT, colors=tints, rim=1.2)


def _ground_lines(camera: Camera, step: float, radius: float, color: str) -> LineCollection:
    """Lines on the ground a step apart, inside a circle around the camera's target and before the eye."""
    lines = []
    for across, along in ((0, 2), (2, 0)):
        middle = camera.target[across]
        for value in np.arange(step * np.ceil((middle - radius) / step), middle + radius, step):
            half = np.sqrt(max(radius**2 - (value - middle) ** 2, 0.0))
            line = np.zeros((200, 3))
            line[:, across], line[:, along] = value, camera.target[along] + np.linspace(-half, half, 200)
            seen = camera.project(line)
            lines.append(seen[camera.distance - seen[:, 2] > 1.0, :2])
    return LineCollection(lines, colors=color, linewidths=0.7, zorder=0.5)


# ---------------------------------------------------------------------------------- moving pictures


def write_gif(
    path, motions, *, target_paths=None, titles=None, every: int = 3, size: tuple[int, int] = (256, 256),
    max_seconds: float = np.inf,
) -> Path:  # fmt: skip
    """Write a small looping GIF of one motion, or of several in panels side by side.

    The camera keeps its direction and follows each character over a 1 m grid, so the grid shows
    the travel. Walked and target path lie on the ground. Plays in real time.

    Args:
      path: ends in .gif; folders are made, a picture drawn before is replaced.
      motions: a `Motion`, or a list of them of one frame rate; shorter ones wait at their end.
      target_paths: a target path (`RootPath` or [T, 2]), or a list of one (or None) a motion.
      titles: a text, or a list of one a motion; by default the motion's name.
      every: keep every n-th frame; 3 keeps 8 s near 200 kB.
      size: pixels of one panel, width and height.
      max_seconds: stop there.

    Returns:
      The path.

    Raises:
      ValueError: for a wrong suffix, no motion, or unlike frame rates.
    """
    path = named_file(path, ".gif", "moving pictures")
    rows = _beside_each_other(motions, target_paths, titles)
    motions = [motion for motion, *_ in rows]
    rates = {motion.fps for motion in motions}
    if len(rates) > 1:
        raise ValueError(f"motions of one picture need one frame rate, got {sorted(rates)}")
    fps = rates.pop()
    longest = max(motion.num_frames for motion in motions)
    frames = np.arange(0, min(longest, max_seconds * fps), every, dtype=int)
    # Panels fill the picture: there is nothing for a layout to do, whatever style is in use.
    figure = Figure(figsize=(size[0] * len(rows) / 100, size[1] / 100), dpi=100, layout="none")
    canvas, pictures = FigureCanvasAgg(figure), []
    bare = {"left": 0.0, "right": 1.0, "bottom": 0.0, "top": 1.0, "wspace": 0.0}
    axes = figure.subplots(1, len(rows), squeeze=False, gridspec_kw=bare)[0]
    draws = [_gif_panel(axis, *row, frames, size) for axis, row in zip(axes, rows, strict=True)]
    for place in range(len(frames)):
        for draw in draws:
            draw(place)
        canvas.draw()
        pictures.append(Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB"))
    # GIF counts in hundredths of a second: round the times, not the gaps, to stay in real time.
    ticks = np.round(np.arange(len(frames) + 1) * every / fps * 100).astype(int)
    durations = (np.diff(ticks) * 10).tolist()
    durations[-1] += 600  # a pause before it starts again
    # One palette for all, of the first frame and one in the middle: unchanged areas do not flicker.
    sample = np.concatenate([np.asarray(pictures[0]), np.asarray(pictures[len(pictures) // 2])])
    palette = Image.fromarray(sample).quantize(32, Image.Quantize.MAXCOVERAGE, kmeans=1)
    pictures = [picture.quantize(palette=palette, dither=Image.Dither.NONE) for picture in pictures]
    first, *others = pictures
    with whole_file(path, overwrite=True) as temporary:
        first.save(temporary, "gif", save_all=True, append_images=others, duration=durations, loop=0, optimize=False)
    return path


_AROUND = np.deg2rad(50.0)
"""Where the camera of a GIF stands, from the character's first facing to its right."""


def _gif_panel(axis, motion: Motion, target, title: str, frames, size):
    """Prepare a panel of a GIF; return what draws it at a place in `frames`, held at the motion's last."""
    frames = np.minimum(frames, motion.num_frames - 1)
    points, yaw = stick_figures.drawn_points(motion, frames), stick_figures.yaw_of(motion)
    touching = _toes_down(motion, frames)
    root = np.asarray(motion.root_position, dtype=np.float64)
    follow = gaussian_filter1d(root, 0.25 * motion.fps, axis=0, mode="nearest")[frames]
    walked, target = root[:, [0, 2]], None if target is None else stick_figures.path_on_ground(target)
    pixels = min(size[1] / 2.35, size[0] / 1.9)  # a metre: 2.3 m around the character fill the shorter side
    width, height = 0.5 * np.array(size) / pixels
    axis.set(xlim=(-width, width), ylim=(-height, height), xticks=[], yticks=[])
    axis.spines[:].set_color("#B8B8B8")

    def draw(place: int) -> None:
        x, _, z = follow[place]
        camera = Camera((0.0 if yaw is None else yaw[0]) - _AROUND, np.deg2rad(14.0), (x, 0.88, z), distance=4.6)
        for old in [*axis.lines, *axis.collections, *axis.patches, *axis.texts]:
            old.remove()
        axis.add_collection(_ground_lines(camera, 1.0, 3.0, "#D9D9D9"))
        way = walked[: frames[place] + 1]
        for line, color, thick in ((target, stick_figures.TARGET_COLOR, 2.2), (way, stick_figures.TRAIL_COLOR, 1.5)):
            if line is not None:
                near = np.linalg.norm(line - [x, z], axis=-1, keepdims=True) < 3.0
                seen = np.where(near, camera.project(_on_ground(line))[:, :2], np.nan)
                axis.plot(*seen.T, color=color, linewidth=thick, zorder=2)
        _draw_body(axis, motion.skeleton, points[place], camera, 0.72 * pixels, touching=touching[place])
        corner = {"transform": axis.transAxes, "fontsize": 8.5}
        axis.text(0.03, 0.97, textwrap.fill(title, size[0] // 7), va="top", color="#1A1A1A", **corner)
        axis.text(0.97, 0.03, f"{frames[place] / motion.fps:.1f} s", ha="right", color="#666666", **corner)

    return draw
