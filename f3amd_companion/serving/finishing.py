"""Motion as people look at it: seams blended, feet held; walks as GIFs, crowds as files and pictures."""

import contextlib
import itertools
import re
import textwrap
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image
from scipy.ndimage import gaussian_filter1d
from tqdm import tqdm

from f3amd_companion.serving import motion_files
from f3amd_companion.serving.foot_locking import lock_feet
from f3amd_companion.serving.player import Character, Scene, write_player
from f3amd_lib.data.features import motion_from_frames, world_frames
from f3amd_lib.drawing import pictures, stick_figures
from f3amd_lib.drawing.stick_figures import Camera
from f3amd_lib.drawing.style import new_figure, plot_style, save_figure
from f3amd_lib.ground import log
from f3amd_lib.ground.files import named_file, whole_file, whole_folder
from f3amd_lib.motion.skeleton import Motion
from f3amd_lib.rollout.blending import blend_seams


def held(lock, made):
    """Return a motion or a rollout with supporting feet held in place, if its legs are hip, knee, ankle and toe."""
    try:
        return lock(made)
    except ValueError as error:
        log.info("feet         not held: %s", error)
        return made


def finished(motion, window: int):
    """Blend a motion's seams over 4 frames and hold its feet, as where people look."""
    frames = blend_seams(world_frames(motion), window, min(4, window))
    return held(lock_feet, motion_from_frames(motion.skeleton, frames, motion.fps, motion.name))


def crowd_motions(crowd, shown, credit: str, folder: Path, formats) -> None:
    """Write a file a character and format, one after the other, so that no crowd is too large: NUMBER_STYLE.bvh.

    Files of an earlier crowd are removed first; what else lies there stays. A new folder is there whole or not at all.
    """
    digits, styles = len(str(len(crowd) - 1)), "|".join(map(re.escape, crowd.settings["styles"]))
    for file in folder.glob("*"):
        if re.fullmatch(rf"\d+_({styles})\.(bvh|glb|csv)", file.name):
            file.unlink()
    with contextlib.nullcontext(folder) if folder.exists() else whole_folder(folder) as place:
        for character in tqdm(range(len(crowd)), "writing motions"):
            motion, name = shown(character), f"{character:0{digits}d}_{crowd.style(character)}"
            for ending in formats:
                motion_files.write_motion(place / f"{name}{ending}", motion, credit=credit)


def crowd_pictures(crowd, shown, credit: str, still: Path, page: Path) -> None:
    """Draw a crowd half way through, and write a page that plays up to 100 of it; `shown` gives a motion by number."""
    name = crowd.settings["model"]["name"]
    motions = [shown(k) for k in tqdm(range(min(100, len(crowd))), "finishing motions")]
    colors = pictures.crowd_colors([motion.name for motion in motions])
    characters = [Character(motion, path=crowd.target(k), color=colors[k]) for k, motion in enumerate(motions)]
    write_player(page, Scene(characters, title=name), strip=False, credit=credit)
    save_figure(crowd_figure({name: (motions, colors)}, crowd.num_frames // 2), still)


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
    seen = camera.project(pictures.on_ground(roots)[:, None] + around)[..., :2].reshape(-1, 2)
    (left, low), (right, high) = seen.min(axis=0), seen.max(axis=0)
    lines = max(len(title.splitlines()) for title in crowds)
    # As high as its panels are at equal scale, and room for titles and for what may stand below all.
    height = rows * (panel * (high - low) / (right - left) + (0.13 + 0.2 * lines) * (lines > 0)) + 0.2
    figure, axes = new_figure(width, height, rows, columns, squeeze=False)
    for axis in axes.flat:
        axis.axis("off")
    for axis, (title, (motions, colors)) in zip(axes.flat, crowds.items(), strict=False):
        axis.set(xlim=(left, right), ylim=(low, high), aspect="equal")
        pictures.draw_crowd(axis, motions, colors, frame, camera, 72.0 * 0.97 * panel / (right - left))
        heading, _, note = title.partition("\n")
        if heading:
            axis.set_title(heading, pad=6 + 12 * len(note.splitlines()))
        # A long note does not make its panel narrower.
        axis.text(0.0, 1.015, note, transform=axis.transAxes, fontsize=9, color="#444444", in_layout=False)
    return figure


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
    rows = pictures.beside_each_other(motions, target_paths, titles)
    motions = [motion for motion, *_ in rows]
    rates = {motion.fps for motion in motions}
    if len(rates) > 1:
        raise ValueError(f"motions of one picture need one frame rate, got {sorted(rates)}")
    fps = rates.pop()
    frames = np.arange(0, min(max(motion.num_frames for motion in motions), max_seconds * fps), every, dtype=int)
    # Panels fill the picture: there is nothing for a layout to do, whatever style is in use.
    figure = Figure(figsize=(size[0] * len(rows) / 100, size[1] / 100), dpi=100, layout="none")
    canvas, made = FigureCanvasAgg(figure), []
    bare = {"left": 0.0, "right": 1.0, "bottom": 0.0, "top": 1.0, "wspace": 0.0}
    axes = figure.subplots(1, len(rows), squeeze=False, gridspec_kw=bare)[0]
    draws = [_gif_panel(axis, *row, frames, size) for axis, row in zip(axes, rows, strict=True)]
    for place in range(len(frames)):
        for draw in draws:
            draw(place)
        canvas.draw()
        made.append(Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB"))
    # GIF counts in hundredths of a second: round the times, not the gaps, to stay in real time.
    durations = (np.diff(np.round(np.arange(len(frames) + 1) * every / fps * 100).astype(int)) * 10).tolist()
    durations[-1] += 600  # a pause before it starts again
    # One palette for all, of the first frame and one in the middle: unchanged areas do not flicker.
    sample = np.concatenate([np.asarray(made[0]), np.asarray(made[len(made) // 2])])
    palette = Image.fromarray(sample).quantize(32, Image.Quantize.MAXCOVERAGE, kmeans=1)
    first, *others = (picture.quantize(palette=palette, dither=Image.Dither.NONE) for picture in made)
    with whole_file(path, overwrite=True) as temporary:
        first.save(temporary, "gif", save_all=True, append_images=others, duration=durations, loop=0, optimize=False)
    return path


_AROUND = np.deg2rad(50.0)
"""Where the camera of a GIF stands, from the character's first facing to its right."""


def _gif_panel(axis, motion: Motion, target, title: str, frames, size):
    """Prepare a panel of a GIF; return what draws it at a place in `frames`, held at the motion's last."""
    frames = np.minimum(frames, motion.num_frames - 1)
    points, yaw = stick_figures.drawn_points(motion, frames), stick_figures.yaw_of(motion)
    touching = pictures.toes_down(motion, frames)
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
        axis.add_collection(pictures.ground_lines(camera, 1.0, 3.0, "#D9D9D9"))
        way = walked[: frames[place] + 1]
        for line, color, thick in ((target, stick_figures.TARGET_COLOR, 2.2), (way, stick_figures.TRAIL_COLOR, 1.5)):
            if line is not None:
                near = np.linalg.norm(line - [x, z], axis=-1, keepdims=True) < 3.0
                seen = np.where(near, camera.project(pictures.on_ground(line))[:, :2], np.nan)
                axis.plot(*seen.T, color=color, linewidth=thick, zorder=2)
        pictures.draw_body(axis, motion.skeleton, points[place], camera, 0.72 * pixels, touching=touching[place])
        corner = {"transform": axis.transAxes, "fontsize": 8.5}
        axis.text(0.03, 0.97, textwrap.fill(title, size[0] // 7), va="top", color="#1A1A1A", **corner)
        axis.text(0.97, 0.03, f"{frames[place] / motion.fps:.1f} s", ha="right", color="#666666", **corner)

    return draw
