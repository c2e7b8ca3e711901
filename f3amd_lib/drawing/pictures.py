"""Motion as pictures: film strips, rows of poses, bodies of a crowd.

All draw the stick figures of `stick_figures`, with a green dot under a toe that is in contact. Of a
skeleton whose toes are not known no contacts are shown; one whose hips are not known is taken to
face +Z, and no facing is drawn.
"""

import itertools
from collections.abc import Sequence

import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.colors import to_hex, to_rgb
from scipy.ndimage import gaussian_filter1d

from f3amd_lib.drawing import stick_figures
from f3amd_lib.drawing.stick_figures import Camera
from f3amd_lib.drawing.style import PALETTE, new_figure, plot_style
from f3amd_lib.motion.skeleton import Motion

# ------------------------------------------------------------------------------------ one body

_THIN = {"left": 0.05, "right": 0.05, "middle": 0.05, "head": 0.18}  # metres
_STOUT = {"left": 0.095, "right": 0.095, "middle": 0.147, "head": 0.22}  # as thick as people
_COLORS = stick_figures.LIMB_COLORS | {"head": stick_figures.LIMB_COLORS["middle"]}


def draw_body(
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
    shadow = camera.project(on_ground(_CIRCLE + points[0, [0, 2]]))
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


def on_ground(xz: np.ndarray) -> np.ndarray:
    """Return points [..., 3] at height 0, of x and z [..., 2]."""
    return np.stack([xz[..., 0], np.zeros(xz.shape[:-1]), xz[..., 1]], axis=-1)


def toes_down(motion: Motion, frames) -> list:
    """Return the toes in contact at each frame that is asked for."""
    toes = np.array(stick_figures.toes_of(motion.skeleton))
    return [toes[np.asarray(row, bool)] for row in motion.contacts[frames]] if len(toes) else [()] * len(frames)


def beside_each_other(motions, paths, titles) -> list[tuple]:
    """Return (motion, path or None, title) of each; one path or title stands for all."""
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
    rows = beside_each_other(motions, paths, titles)
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
    yaw, touching = stick_figures.yaw_of(motion), toes_down(motion, chosen)
    facing = np.zeros(len(chosen))
    if yaw is not None:
        facing = gaussian_filter1d(np.unwrap(yaw), 0.3 * motion.fps, mode="nearest")[chosen]
    axis.axhline(0.0, color="#B8B8B8", linewidth=1.0, zorder=0)
    for place, frame in enumerate(chosen):
        camera = Camera(facing[place] - np.pi / 3, np.deg2rad(6.0), points[place, 0] * [1.0, 0.0, 1.0])
        draw_body(axis, motion.skeleton, points[place], camera, scale, left=place * SLOT, touching=touching[place])
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
    axis.add_collection(ground_lines(camera, 2.0, 8.0 * camera.distance, "#E6E6E6"))
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
            axis.plot(*camera.project(on_ground(prints))[:, :2].T, solid_capstyle="round", zorder=2, **look)
        draw_body(axis, motion.skeleton, bodies[k], camera, scale, thick=_STOUT, colors=tints, rim=1.2)


def ground_lines(camera: Camera, step: float, radius: float, color: str) -> LineCollection:
    """Return lines on the ground a step apart, inside a circle around the camera's target and before the eye."""
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
