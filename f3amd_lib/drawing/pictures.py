"""Motion as pictures: film strips for the page, small GIFs for the eye.

Both draw stick figures in the same colours (`stick_figures`), with a green dot under a toe that is
in contact. Of a skeleton whose toes are not known no contacts are shown; one whose hips are not
known is taken to face +Z, and no facing is drawn.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont
from scipy.ndimage import gaussian_filter1d

from f3amd_lib.drawing.stick_figures import (
    CONTACT_COLOR,
    LIMB_COLORS,
    TARGET_COLOR,
    TRAIL_COLOR,
    bones_of,
    drawn_points,
    head_center,
    path_on_ground,
)
from f3amd_lib.drawing.style import new_figure, plot_style, save_figure
from f3amd_lib.motion.skeleton import Motion

_GROUND = "#B8B8B8"


def _view(facing: float, around: float, elevation: float) -> np.ndarray:
    """Rows right, up and towards the viewer of a camera that stands around a facing direction.

    Args:
      facing: yaw that the character faces, radians.
      around: from straight ahead of it (0) to its right side (pi/2).
      elevation: how far above the horizon the camera stands.
    """
    yaw = facing - around  # a positive yaw turns left, the camera stands to the right
    towards = np.array([np.sin(yaw) * np.cos(elevation), np.sin(elevation), np.cos(yaw) * np.cos(elevation)])
    right = np.array([np.cos(yaw), 0.0, -np.sin(yaw)])
    return np.stack([right, np.cross(towards, right), towards])


def _as_list(motions) -> list[Motion]:
    motions = [motions] if isinstance(motions, Motion) else list(motions)
    if not motions or not all(isinstance(motion, Motion) for motion in motions):
        raise ValueError("a picture needs a Motion, or a list of at least one")
    return motions


def _per_motion(value, count: int, what: str) -> list:
    """One value a motion: repeat a single one, check a list's length."""
    if value is None or isinstance(value, str) or not isinstance(value, (list, tuple)):
        return [value] * count
    if len(value) != count:
        raise ValueError(f"{len(value)} {what} for {count} motions")
    return list(value)


def _facing(motion: Motion) -> np.ndarray | None:
    """Yaw per frame, [T], or None where the skeleton's hips are not known."""
    try:
        motion.skeleton.role("left_hip"), motion.skeleton.role("right_hip")
    except ValueError:
        return None
    return motion.yaw


def _toes(motion: Motion) -> tuple[int, ...]:
    """The left and the right toe joint, or none where they are not known."""
    try:
        return motion.skeleton.toes
    except ValueError:
        return ()


def _touching(motion: Motion, frames) -> list[list[int]]:
    """Toes in contact at each frame that is asked for."""
    toes = _toes(motion)
    if not toes:
        return [[] for _ in frames]
    return [[toes[foot] for foot in np.flatnonzero(row)] for row in motion.contacts[frames]]


def film_strip(
    motions,
    *,
    paths=None,
    titles=None,
    num_poses: int = 8,
    frames: Sequence[int] | None = None,
    around_deg: float = 60.0,
):
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
      around_deg: 0 looks at the character from the front, 90 from its right side.

    Returns:
      A matplotlib Figure; `figures.save_figure` writes it, `figures.show_figure` shows it.

    Raises:
      ValueError: for no motion, fewer than one pose, or frames that a motion does not have.
    """
    motions = _as_list(motions)
    paths = _per_motion(paths, len(motions), "paths")
    titles = _per_motion(titles, len(motions), "titles")
    if frames is None and (int(num_poses) != num_poses or num_poses < 1):
        raise ValueError(f"num_poses must be 1 or more, got {num_poses}")
    count = len(frames) if frames is not None else int(num_poses)
    if count < 1:
        raise ValueError("frames must name at least one frame")

    slot = 1.15  # metres of page a pose
    figure, axes = new_figure(
        0.96 * count + 2.9, 2.45 * len(motions), len(motions), 2, squeeze=False, width_ratios=[0.96 * count, 2.9]
    )
    with plot_style():
        contacts = any(_toes(motion) for motion in motions)
        for row, motion in enumerate(motions):
            if frames is None:
                chosen = np.linspace(0, motion.num_frames - 1, count).round().astype(int)
            else:
                chosen = np.asarray(frames, dtype=int)
                if chosen.min() < 0 or chosen.max() >= motion.num_frames:
                    raise ValueError(
                        f"motion {motion.name!r} has frames 0 to {motion.num_frames - 1}; asked "
                        f"for {chosen.min()} to {chosen.max()}"
                    )
            title = titles[row] if titles[row] is not None else motion.name
            _draw_poses(axes[row, 0], motion, chosen, np.deg2rad(around_deg), slot)
            if row == 0:
                _name_colors(axes[row, 0], contacts)
            axes[row, 0].set_title(title or " ")
            _draw_plan(axes[row, 1], motion, chosen, paths[row], row == 0)
    return figure


def write_film_strip(path, motions, **options) -> Path:
    """Write a film strip as a PNG file, in one call.

    Args:
      path: ends in .png; folders are made, a picture drawn before is replaced.
      motions, options: as for `film_strip`.

    Returns:
      The path.

    Raises:
      ValueError: for a wrong suffix, or as `film_strip` does.
    """
    return save_figure(film_strip(motions, **options), path)


def _draw_poses(axis, motion: Motion, chosen, around: float, slot: float) -> None:
    points = drawn_points(motion, chosen)
    heads = head_center(motion.skeleton, points)
    yaw = _facing(motion)
    facing = np.zeros(len(chosen))
    if yaw is not None:
        facing = gaussian_filter1d(np.unwrap(yaw), 0.3 * motion.fps, mode="nearest")[chosen]
    touching = _touching(motion, chosen)
    bones = bones_of(motion.skeleton)
    axis.axhline(0.0, color=_GROUND, linewidth=1.0, zorder=0)
    top = 1.7
    for place in range(len(chosen)):
        view = _view(facing[place], around, np.deg2rad(6.0))
        base = points[place, 0] * np.array([1.0, 0.0, 1.0])
        seen = (points[place] - base) @ view.T
        top = max(top, seen[:, 1].max() + 0.05)
        left = place * slot
        shadow = np.linspace(0, 2 * np.pi, 40)
        axis.fill(left + 0.26 * np.cos(shadow), 0.03 * np.sin(shadow), color="#E9E9E9", zorder=1)
        for parent, child, side in sorted(bones, key=lambda bone: seen[list(bone[:2]), 2].mean()):
            ends = seen[[parent, child]]
            depth = ends[:, 2].mean()
            axis.plot(
                left + ends[:, 0],
                ends[:, 1],
                color=LIMB_COLORS[side],
                linewidth=3.0,
                solid_capstyle="round",
                zorder=5 + depth,
            )
        if heads is not None:
            center = (heads[place] - base) @ view.T
            axis.plot(
                left + center[0], center[1], "o", color=LIMB_COLORS["middle"], markersize=10, zorder=5 + center[2]
            )
            top = max(top, center[1] + 0.15)
        for toe in touching[place]:
            axis.plot(
                left + seen[toe, 0],
                seen[toe, 1],
                "o",
                color=CONTACT_COLOR,
                markersize=5,
                markeredgecolor="white",
                markeredgewidth=0.6,
                zorder=9,
            )
        seconds = chosen[place] / motion.fps
        axis.text(left, -0.14, f"{place + 1}", ha="center", va="top", fontsize=8, fontweight="bold")
        axis.text(left, -0.32, f"{seconds:.1f} s", ha="center", va="top", fontsize=8, color="#666666")
    axis.set_xlim(-0.55 * slot, (len(chosen) - 0.45) * slot)
    axis.set_ylim(-0.5, top)
    axis.set_aspect("equal", adjustable="box", anchor="W")
    axis.axis("off")


def _name_colors(axis, contacts: bool) -> None:
    """Put a legend over the poses, with the dot of a contact if any skeleton has some."""
    keys = [
        axis.plot([], [], color=LIMB_COLORS["left"], linewidth=3, label="left")[0],
        axis.plot([], [], color=LIMB_COLORS["right"], linewidth=3, label="right")[0],
    ]
    if contacts:
        keys += axis.plot([], [], "o", color=CONTACT_COLOR, markersize=5, label="toe in contact")
    axis.legend(
        handles=keys,
        loc="lower right",
        bbox_to_anchor=(1.0, 1.0),
        ncols=3,
        borderaxespad=0.2,
        handlelength=1.2,
        columnspacing=1.2,
        fontsize=8,
    )


def _draw_plan(axis, motion: Motion, chosen, path, legend: bool) -> None:
    root = np.asarray(motion.root_position, dtype=np.float64)[:, [0, 2]]
    everything = [root]
    if path is not None:
        target = path_on_ground(path)
        everything.append(target)
        axis.plot(*target.T, color=TARGET_COLOR, linestyle="--", linewidth=1.6, label="target", zorder=3)
    axis.plot(*root.T, color=TRAIL_COLOR, linewidth=1.6, label="walked")
    extent = np.ptp(np.concatenate(everything), axis=0).max()
    reach = 0.09 * max(extent, 1.0)
    yaw = _facing(motion)
    facing = np.zeros(len(chosen)) if yaw is None else yaw[chosen]
    arrow = np.stack([np.sin(facing), np.cos(facing)], axis=-1)
    for place, frame in enumerate(chosen):
        start, end = root[frame], root[frame] + reach * arrow[place]
        if yaw is not None:
            axis.plot(*np.stack([start, end]).T, color="#1A1A1A", linewidth=1.4)
        axis.plot(*start, "o", color="#1A1A1A", markersize=3.5)
        beside = start - 0.8 * reach * np.array([arrow[place, 1], -arrow[place, 0]])
        axis.text(*beside, f"{place + 1}", fontsize=7, ha="center", va="center")
    # A square window with some air, never narrower than 2 m: a standing figure is no path.
    low, high = np.concatenate(everything).min(axis=0), np.concatenate(everything).max(axis=0)
    half = 0.5 * max(1.25 * extent, 2.0)
    middle = 0.5 * (low + high)
    # Seen from above with +Z up the page, +X points to the left: a left turn looks like one.
    axis.set_xlim(middle[0] + half, middle[0] - half)
    axis.set_ylim(middle[1] - half, middle[1] + half)
    axis.set_aspect("equal", adjustable="box")
    axis.locator_params(nbins=4)
    axis.set_xlabel("x (m)", fontsize=8, labelpad=1)
    axis.set_ylabel("z (m)", fontsize=8, labelpad=1)
    axis.tick_params(labelsize=7)
    if legend:
        axis.set_title("from above", fontsize=9, fontweight="normal")
    if path is not None and legend:
        axis.legend(fontsize=7, loc="best", handlelength=1.6)


class _Camera:
    """A perspective camera that keeps one direction and follows a point on the ground."""

    def __init__(self, facing: float, around: float, elevation: float, size: tuple[int, int]):
        self.view = _view(facing, around, elevation)
        self.width, self.height = size
        self.distance = 4.6
        # 2.3 m around the character fill the shorter side.
        self.focal = min(size[1] / 2.35, size[0] / 1.9) * self.distance
        self.target = np.zeros(3)

    def project(self, points: np.ndarray) -> np.ndarray:
        """Map [..., 3] metres to [..., 3]: pixel column, pixel row, depth from the eye."""
        seen = (points - self.target) @ self.view.T
        depth = self.distance - seen[..., 2]
        scale = self.focal / np.maximum(depth, 0.1)
        column = self.width / 2 + scale * seen[..., 0]
        row = self.height / 2 - scale * seen[..., 1]
        return np.stack([column, row, depth], axis=-1)


def write_gif(
    path,
    motions,
    *,
    target_paths=None,
    titles=None,
    every: int = 3,
    size: tuple[int, int] = (256, 256),
    around_deg: float = 50.0,
    max_seconds: float | None = None,
) -> Path:
    """Write a small looping GIF of one motion, or of several in panels side by side.

    The camera keeps its direction and follows each character over a 1 m grid, so the grid shows
    the travel. Walked and target path lie on the ground. Plays in real time.

    Args:
      path: ends in .gif; folders are made, a picture drawn before is replaced.
      motions: a `Motion`, or a list of them of one frame rate; shorter ones wait at their end.
      target_paths: a target path (`RootPath` or [T, 2]), or a list of one (or None) a motion.
      titles: a text, or a list of one a motion; by default the motion's name.
      every: keep every n-th frame; 3 keeps 8 s near 200 kB. At most 30 kept frames a second.
      size: pixels of one panel, width and height.
      around_deg: camera, 0 in front of the character's first facing, 90 at its right side.
      max_seconds: stop there; None shows everything.

    Returns:
      The path.

    Raises:
      ValueError: for a wrong suffix, no motion, unlike frame rates, or more than 30 frames a
        second.
    """
    path = Path(path)
    if path.suffix != ".gif":
        raise ValueError(f"{path}: moving pictures are written as .gif")
    motions = _as_list(motions)
    rates = {motion.fps for motion in motions}
    if len(rates) > 1:
        raise ValueError(f"motions of one picture need one frame rate, got {sorted(rates)}")
    fps = rates.pop()
    if int(every) != every or every < 1:
        raise ValueError(f"every must be a whole number, 1 or more, got {every}")
    if fps / every > 30.0 + 1e-6:
        raise ValueError(
            f"{fps / every:g} frames a second are too many for a GIF (30 at most); "
            f"raise every to {int(np.ceil(fps / 30.0))}"
        )
    last = max(motion.num_frames for motion in motions)
    if max_seconds is not None:
        last = min(last, max(1, round(max_seconds * fps)))
    frames = np.arange(0, last, int(every))
    targets = _per_motion(target_paths, len(motions), "target paths")
    titles = _per_motion(titles, len(motions), "titles")

    panels = []
    for motion, target, title in zip(motions, targets, titles, strict=True):
        text = title if title is not None else motion.name
        panels.append(_draw_panel(motion, frames, target, text, size, np.deg2rad(around_deg)))
    pictures = []
    for images in zip(*panels, strict=True):
        whole = Image.new("RGB", (size[0] * len(images), size[1]), "white")
        for place, image in enumerate(images):
            whole.paste(image, (place * size[0], 0))
            if place:
                edge = (place * size[0], 0, place * size[0], size[1])
                ImageDraw.Draw(whole).line(edge, fill="#B8B8B8")
        pictures.append(whole)

    # One palette for all frames, or unchanged areas would flicker and cost bytes.
    sample = Image.new("RGB", (pictures[0].width, pictures[0].height * 2))
    sample.paste(pictures[0], (0, 0))
    sample.paste(pictures[len(pictures) // 2], (0, pictures[0].height))
    palette = sample.quantize(colors=32, method=Image.Quantize.MAXCOVERAGE)
    indexed = [picture.quantize(palette=palette, dither=Image.Dither.NONE) for picture in pictures]
    # GIF counts in hundredths of a second: round the times, not the gaps, to stay in real time.
    ticks = np.round(np.arange(len(frames) + 1) * every / fps * 100).astype(int)
    durations = (np.diff(ticks) * 10).tolist()
    durations[-1] += 600  # a pause before it starts again
    path.parent.mkdir(parents=True, exist_ok=True)
    indexed[0].save(path, save_all=True, append_images=indexed[1:], duration=durations, loop=0, optimize=False)
    return path


def _draw_panel(motion: Motion, frames, target, title: str, size, around: float) -> list:
    """Draw one character at the given frames (held at its last), one image a frame."""
    scale = 2  # draw twice as large, then shrink: smooth edges
    frames = np.minimum(frames, motion.num_frames - 1)
    points = drawn_points(motion, frames)
    heads = head_center(motion.skeleton, points)
    touching = _touching(motion, frames)
    bones = bones_of(motion.skeleton)
    root = np.asarray(motion.root_position, dtype=np.float64)
    follow = gaussian_filter1d(root, 0.25 * motion.fps, axis=0, mode="nearest")[frames]
    yaw = _facing(motion)
    first = 0.0 if yaw is None else yaw[0]
    camera = _Camera(first, around, np.deg2rad(14.0), (size[0] * scale, size[1] * scale))
    ground_target = None if target is None else _on_ground(path_on_ground(target))
    trail = _on_ground(root[:, [0, 2]])
    font = ImageFont.load_default(size=12 * scale)
    images = []
    for place, frame in enumerate(frames):
        image = Image.new("RGB", (size[0] * scale, size[1] * scale), "white")
        draw = ImageDraw.Draw(image)
        camera.target = np.array([follow[place, 0], 0.88, follow[place, 2]])
        _draw_grid(draw, camera, scale)
        if ground_target is not None:
            _draw_line(draw, camera, ground_target, TARGET_COLOR, 3 * scale)
        _draw_line(draw, camera, trail[: frame + 1], TRAIL_COLOR, 2 * scale)
        _draw_figure(
            draw, camera, points[place], None if heads is None else heads[place], bones, touching[place], scale
        )
        draw.text((8 * scale, 6 * scale), title, fill="#1A1A1A", font=font)
        clock = f"{frame / motion.fps:.1f} s"
        draw.text(((size[0] - 8) * scale, (size[1] - 6) * scale), clock, fill="#666666", font=font, anchor="rs")
        images.append(image.resize(size, Image.Resampling.BOX))
    return images


def _on_ground(xz: np.ndarray) -> np.ndarray:
    return np.stack([xz[:, 0], np.zeros(len(xz)), xz[:, 1]], axis=-1)


def _draw_grid(draw, camera: _Camera, scale: int, radius: float = 3.0) -> None:
    """Draw grid lines a metre apart inside a circle around the character."""
    center = camera.target[[0, 2]]
    for axis in (0, 1):
        for value in np.arange(np.ceil(center[axis] - radius), center[axis] + radius):
            half = np.sqrt(max(radius**2 - (value - center[axis]) ** 2, 0.0))
            ends = np.zeros((2, 3))
            ends[:, 2 * axis] = value
            ends[:, 2 - 2 * axis] = center[1 - axis] + np.array([-half, half])
            seen = camera.project(ends)
            draw.line([tuple(point) for point in seen[:, :2]], fill="#D9D9D9", width=scale)


def _draw_line(draw, camera: _Camera, ground: np.ndarray, color: str, width: int) -> None:
    """Draw the part of a ground line near the character."""
    near = np.linalg.norm((ground - camera.target)[:, [0, 2]], axis=-1) < 3.0
    seen = camera.project(ground)
    for run in np.split(np.arange(len(ground)), np.flatnonzero(np.diff(near)) + 1):
        if len(run) > 1 and near[run[0]]:
            draw.line([tuple(p) for p in seen[run, :2]], fill=color, width=width, joint="curve")


def _draw_figure(draw, camera: _Camera, points, head, bones, touching, scale: int) -> None:
    base = points[0] * np.array([1.0, 0.0, 1.0])
    around = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    rim = base + 0.24 * np.stack([np.cos(around), 0 * around, np.sin(around)], axis=-1)
    draw.polygon([tuple(p) for p in camera.project(rim)[:, :2]], fill="#E2E2E2")
    seen = camera.project(points)
    pixel = camera.focal / camera.distance  # pixels a metre at the character
    width = max(2, round(0.05 * pixel))
    items = [(seen[[parent, child], 2].mean(), "bone", (parent, child, side)) for parent, child, side in bones]
    if head is not None:
        items.append((camera.project(head)[2], "head", None))
    for _, kind, what in sorted(items, key=lambda item: -item[0]):  # far things first
        if kind == "head":
            column, row, _ = camera.project(head)
            _disc(draw, column, row, 0.10 * pixel, LIMB_COLORS["middle"])
        else:
            parent, child, side = what
            color = LIMB_COLORS[side]
            draw.line([tuple(seen[parent, :2]), tuple(seen[child, :2])], fill=color, width=width)
            for joint in (parent, child):
                _disc(draw, *seen[joint, :2], (width - 1) / 2, color)
    for toe in touching:
        _disc(draw, *seen[toe, :2], 0.055 * pixel, "white")
        _disc(draw, *seen[toe, :2], 0.04 * pixel, CONTACT_COLOR)


def _disc(draw, column: float, row: float, radius: float, color: str) -> None:
    draw.ellipse([column - radius, row - radius, column + radius, row + radius], fill=color)
