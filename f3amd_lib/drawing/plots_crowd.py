"""Pictures of crowds, for the paper's Figure 1: from an eye above the ground, and from above.

Bodies are drawn as rounded limbs with the thickness of a person's, far ones first and paler. Nearer
limbs cover those behind them by an outline in white, which keeps bodies apart in grey print too.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import matplotlib
import numpy as np
from matplotlib.collections import LineCollection, PolyCollection
from scipy.ndimage import gaussian_filter1d

from f3amd_lib.drawing.plots import styled
from f3amd_lib.drawing.stick_figures import bones_of, drawn_points, head_center, path_on_ground
from f3amd_lib.drawing.style import PALETTE, model_style, new_figure
from f3amd_lib.motion.skeleton import Motion

_STYLE_COLORS = ("purple", "orange", "green", "vermilion", "blue", "sky")
_THICK = 0.095  # metres, a limb; the trunk is drawn wider
_TRUNK = 1.55
_HEAD_RADIUS = 0.11
_TRAIL_SECONDS = 1.5
_FADES = 0.4  # share of white in the colour of what is farthest
_SHADOW = "#DCDCDC"
_GROUND = "#E6E6E6"


@dataclass(frozen=True)
class CrowdPicture:
    """A crowd at one moment, and what to say of it.

    Attributes:
      motions: of one skeleton and frame rate, each with the frame that is drawn.
      colors: of each character.
      title: over the picture, such as "F3AMD-FNO-96, 1 step".
      note: under the title, such as "12.4 ms a round of 64 characters".
    """

    motions: Sequence[Motion]
    colors: Sequence
    title: str = ""
    note: str = ""

    def __post_init__(self):
        if not self.motions:
            raise ValueError("a picture of a crowd needs at least one motion")
        if len(self.colors) != len(self.motions):
            raise ValueError(f"{len(self.colors)} colors for {len(self.motions)} motions")
        if len({motion.fps for motion in self.motions}) > 1:
            raise ValueError("motions of one picture need one frame rate")


@dataclass(frozen=True)
class Eye:
    """A pinhole camera that looks down at the ground.

    Attributes:
      target: x, z of the point it looks at, metres.
      distance: from there, metres.
      around_deg: where it stands: 0 on the side of +Z, 90 on that of +X.
      elevation_deg: above the horizon.
    """

    target: tuple[float, float] = (0.0, 0.0)
    distance: float = 16.0
    around_deg: float = 25.0
    elevation_deg: float = 20.0

    def project(self, points) -> tuple[np.ndarray, np.ndarray]:
        """Map metres [..., 3] to the picture.

        Returns:
          (right and up [..., 2], in units of the distance to the eye: 1 is 45 degrees off the
          middle; depth [...], metres along the line of sight).
        """
        around, elevation = np.deg2rad(self.around_deg), np.deg2rad(self.elevation_deg)
        flat = np.array([np.sin(around), 0.0, np.cos(around)])
        towards = np.cos(elevation) * flat + np.array([0.0, np.sin(elevation), 0.0])
        right = np.array([np.cos(around), 0.0, -np.sin(around)])
        up = np.cross(towards, right)
        place = np.asarray(points, np.float64) - np.array([self.target[0], 0.9, self.target[1]])
        depth = self.distance - place @ towards
        seen = np.stack([place @ right, place @ up], axis=-1)
        return seen / np.maximum(depth, 1e-6)[..., None], depth


def crowd_colors(labels: Sequence[str]) -> list[str]:
    """Give each label (a style) a colour: the project's six, then lighter and darker ones.

    Args:
      labels: of each character.

    Returns:
      A colour each, as "#rrggbb", dealt in the order in which labels first occur.
    """
    places = {label: place for place, label in enumerate(dict.fromkeys(labels))}
    return [_shade(*divmod(places[label], len(_STYLE_COLORS))) for label in labels]


def _shade(turn: int, place: int) -> str:
    base = np.array(matplotlib.colors.to_rgb(PALETTE[_STYLE_COLORS[place]]))
    amount = (0.0, 0.3, -0.3, 0.42, -0.5)[turn % 5]
    return matplotlib.colors.to_hex(base + amount * (1.0 - base) if amount > 0 else base * (1.0 + amount))


def group_shades(name: str, count: int) -> list[tuple]:
    """Return shades of a model's colour, so that neighbours in a crowd can be told apart.

    Args:
      name: of the model, see `figures.model_style`.
      count: of characters.
    """
    # A family's full colour: the pale one of its narrow networks is lost among many characters.
    full = re.sub(r"-(32|48|64)(?!\d)", "-96", name)
    base = np.array(matplotlib.colors.to_rgb(model_style(full).color))
    light = np.linspace(0.0, 0.5, 5)[(2 * np.arange(count)) % 5]
    return [tuple(base + amount * (1.0 - base)) for amount in light]


@styled
def crowd_figure(
    pictures: Sequence[CrowdPicture],
    frame: int,
    *,
    eye: Eye | None = None,
    columns: int = 2,
    width: float = 9.0,
    aspect: float = 2.0,
):
    """Draw crowds in perspective, a panel each, all seen by the same eye.

    Args:
      pictures: of the panels.
      frame: of the motions.
      eye: by default one that sees the middle of the first crowd.
      columns: panels in a row.
      width: of the figure, inches.
      aspect: width over height of a panel.

    Returns:
      A matplotlib Figure.

    Raises:
      ValueError: for no picture, or a frame that a motion does not have.
    """
    pictures = list(pictures)
    if not pictures:
        raise ValueError("a crowd figure needs at least one picture")
    columns = min(columns, len(pictures))
    rows = -(-len(pictures) // columns)
    panel = width / columns
    titled = any(picture.title or picture.note for picture in pictures)
    height = rows * (panel / aspect + (0.42 if titled else 0.0))
    figure, axes = new_figure(width, height, rows, columns, squeeze=False)
    eye = eye or _eye_for(pictures[0], frame)
    half, low = _window(pictures[0], frame, eye)
    for axis, picture in zip(axes.flat, pictures, strict=False):
        _draw_crowd(axis, picture, frame, eye, (half, low), panel, aspect)
    for axis in axes.flat[len(pictures) :]:
        axis.axis("off")
    return figure


def _roots(picture: CrowdPicture, frame: int) -> np.ndarray:
    """Ground positions at a frame, [B, 2]."""
    for motion in picture.motions:
        if not 0 <= frame < motion.num_frames:
            raise ValueError(f"motion {motion.name!r} has frames 0 to {motion.num_frames - 1}; asked for {frame}")
    return np.array([motion.root_position[frame, [0, 2]] for motion in picture.motions], float)


def _eye_for(picture: CrowdPicture, frame: int) -> Eye:
    """Stand back so far that the crowd fills the picture."""
    roots = _roots(picture, frame)
    middle = np.median(roots, axis=0)
    reach = np.quantile(np.linalg.norm(roots - middle, axis=-1), 0.9)
    eye = Eye(target=tuple(middle))
    return dataclasses.replace(eye, distance=max(6.0, 1.7 * float(reach) + 3.0))


def _window(picture: CrowdPicture, frame: int, eye: Eye) -> tuple[float, float]:
    """Half the width of what is shown, and its lower edge, in the eye's units.

    The sides leave out the outermost tenth; nobody near the lower edge is cut off at the legs.
    """
    roots = _roots(picture, frame)
    feet, depth = eye.project(np.stack([roots[:, 0], 0.0 * roots[:, 0], roots[:, 1]], axis=-1))
    feet = feet[depth > 1.5]
    if not len(feet):
        raise ValueError("the eye sees nobody of the first crowd; move it back")
    half = float(max(np.quantile(np.abs(feet[:, 0]), 0.9), 0.1)) + 0.8 / eye.distance
    shown = feet[np.abs(feet[:, 0]) < half]
    return half, float(shown[:, 1].min()) - 0.5 / eye.distance


def _draw_crowd(axis, picture, frame: int, eye: Eye, window, inches: float, aspect) -> None:
    half, low = window
    axis.set_xlim(-half, half)
    axis.set_ylim(low, low + 2.0 * half / aspect)
    axis.set_aspect("equal", adjustable="box")
    axis.set_xticks([])
    axis.set_yticks([])
    axis.grid(False)
    for spine in axis.spines.values():
        spine.set_visible(False)
    points_a_unit = 72.0 * inches * 0.97 / (2.0 * half)
    roots = _roots(picture, frame)
    _draw_ground(axis, roots, eye)
    bodies = [_body(motion, frame, color, eye) for motion, color in zip(picture.motions, picture.colors, strict=True)]
    bodies = [body for body in bodies if body["depth"] > 1.5]
    depths = np.array([body["depth"] for body in bodies] or [1.0])
    near, far = depths.min(), max(depths.max(), depths.min() + 1e-6)
    shadows = PolyCollection([body["shadow"] for body in bodies], facecolors=_SHADOW, linewidths=0, zorder=2)
    axis.add_collection(shadows)
    for body in sorted(bodies, key=lambda body: -body["depth"]):
        paler = _FADES * (body["depth"] - near) / (far - near)
        mix = lambda color, paler=paler: np.asarray(color) * (1 - paler) + paler
        order = 10.0 + 1000.0 * (far - body["depth"])
        trail = LineCollection([body["trail"]], colors=[(*mix(body["color"]), 0.55)], linewidths=1.1, zorder=3)
        axis.add_collection(trail)
        points = points_a_unit / body["segment_depths"]
        widths = np.concatenate([body["thickness"] * points])
        rank = np.argsort(-body["segment_depths"])
        lines = body["segments"][rank]
        shade = np.array([mix(color) for color in body["segment_colors"]])[rank]
        widths = widths[rank]
        outline = LineCollection(lines, colors="white", linewidths=widths + 1.2, capstyle="round", zorder=order)
        fill = LineCollection(lines, colors=shade, linewidths=widths, capstyle="round", zorder=order + 0.1)
        axis.add_collection(outline)
        axis.add_collection(fill)
        if body["head"] is not None:
            size = 2.0 * _HEAD_RADIUS * points_a_unit / body["depth"]
            axis.plot(
                *body["head"],
                "o",
                color=mix(body["color"]),
                markersize=size,
                markeredgecolor="white",
                markeredgewidth=0.6,
                zorder=order + 0.2,
            )
    if picture.title or picture.note:
        axis.set_title(picture.title or " ", fontsize=11, pad=16 if picture.note else 6)
    if picture.note:
        axis.text(0.0, 1.015, picture.note, transform=axis.transAxes, fontsize=9, color="#444444")


def _draw_ground(axis, roots: np.ndarray, eye: Eye) -> None:
    """Draw lines two metres apart, under the crowd and far beyond."""
    low, high = roots.min(axis=0) - 40.0, roots.max(axis=0) + 40.0
    lines = []
    for along in (0, 1):
        across = 1 - along
        steps = np.linspace(low[along], high[along], 200)
        for value in np.arange(2.0 * np.floor(low[across] / 2.0), high[across] + 1.0, 2.0):
            ground = np.zeros((len(steps), 3))
            ground[:, 2 * along], ground[:, 2 * across] = steps, value
            seen, depth = eye.project(ground)
            lines.append(seen[(depth > 1.0) & (depth < 4.0 * eye.distance)])
    axis.add_collection(LineCollection(lines, colors=_GROUND, linewidths=0.7, zorder=1))


def _body(motion: Motion, frame: int, color, eye: Eye) -> dict:
    """Everything of one character as the eye sees it."""
    points = drawn_points(motion, np.array([frame]))
    head = head_center(motion.skeleton, points)
    bones = bones_of(motion.skeleton)
    seen, depth = eye.project(points[0])
    root = points[0, 0]
    rgb = np.array(matplotlib.colors.to_rgb(color))
    tints = {"left": rgb + 0.22 * (1 - rgb), "right": 0.82 * rgb, "middle": rgb}
    around = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    rim = np.stack([root[0] + 0.3 * np.sin(around), 0 * around, root[2] + 0.3 * np.cos(around)], axis=-1)
    first = max(0, frame - round(_TRAIL_SECONDS * motion.fps))
    walked = np.asarray(motion.root_position[first : frame + 1], np.float64)
    walked = gaussian_filter1d(walked, 0.15 * motion.fps, axis=0, mode="nearest")
    return {
        "color": rgb,
        "depth": float(eye.project(root)[1]),
        "segments": np.array([[seen[a], seen[b]] for a, b, _ in bones]),
        "segment_depths": np.maximum([0.5 * (depth[a] + depth[b]) for a, b, _ in bones], 0.5),
        "segment_colors": [tints[side] for _, _, side in bones],
        "thickness": np.array([_THICK * (_TRUNK if side == "middle" else 1.0) for _, _, side in bones]),
        "head": None if head is None else eye.project(head[0])[0],
        "shadow": eye.project(rim)[0],
        "trail": eye.project(walked * np.array([1.0, 0.0, 1.0]))[0],
    }


@styled
def crowd_from_above(picture: CrowdPicture, paths: Sequence, frame: int, *, min_distance: float | None = None):
    """Draw where everybody walks, seen from above.

    Args:
      picture: the crowd; its colours serve as those of the walked lines.
      paths: target path of each (`RootPath` or [T, 2]), dashed.
      frame: whose places are dots, with a stroke to where they face.
      min_distance: metres; draws a disc of this diameter around everybody, which must not overlap.

    Returns:
      A matplotlib Figure; +Z up the page, +X to the left.

    Raises:
      ValueError: for another number of paths, or a frame that a motion does not have.
    """
    if len(paths) != len(picture.motions):
        raise ValueError(f"{len(paths)} paths for {len(picture.motions)} motions")
    roots = _roots(picture, frame)
    figure, axis = new_figure(5.4, 5.6)
    lines = [path_on_ground(path) for path in paths]
    axis.add_collection(LineCollection(lines, colors="#9A9A9A", linewidths=0.8, linestyles=(0, (3, 2)), zorder=2))
    walked = [motion.root_position[:, [0, 2]] for motion in picture.motions]
    axis.add_collection(LineCollection(walked, colors=picture.colors, linewidths=1.2, zorder=3))
    if min_distance:
        turn = np.linspace(0, 2 * np.pi, 40)
        rim = 0.5 * min_distance * np.stack([np.sin(turn), np.cos(turn)], axis=-1)
        discs = PolyCollection(
            [root + rim for root in roots], facecolors="white", edgecolors="#3A3A3A",
            linewidths=0.8, zorder=4,
        )  # fmt: skip
        axis.add_collection(discs)
    axis.scatter(*roots.T, s=16, c=list(picture.colors), edgecolors="#1A1A1A", linewidths=0.5, zorder=6)
    yaw = np.array([motion.yaw[frame] for motion in picture.motions])
    ahead = roots + 0.6 * np.stack([np.sin(yaw), np.cos(yaw)], axis=-1)
    axis.add_collection(LineCollection(np.stack([roots, ahead], 1), colors="#1A1A1A", linewidths=1.1, zorder=5))
    everything = np.concatenate([*lines, *walked])
    low, high = everything.min(axis=0), everything.max(axis=0)
    half, middle = 0.53 * max(high - low) + 0.5, 0.5 * (low + high)
    axis.set_xlim(middle[0] + half, middle[0] - half)
    axis.set_ylim(middle[1] - half, middle[1] + half)
    axis.set_aspect("equal", adjustable="box")
    axis.set_xlabel("x (m)")
    axis.set_ylabel("z (m)")
    keys = [
        axis.plot([], [], color="#9A9A9A", linestyle=(0, (3, 2)), linewidth=1.0, label="asked for")[0],
        axis.plot([], [], color=PALETTE["purple"], linewidth=1.4, label="walked")[0],
        axis.plot([], [], "o", color="#1A1A1A", markersize=4, label="now, facing the stroke")[0],
    ]
    axis.legend(handles=keys, loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=3, fontsize=8.5)
    if picture.title:
        axis.set_title(picture.title, pad=24)
    return figure


def system_pictures(rollouts: Mapping, notes: Mapping | None = None) -> list[CrowdPicture]:
    """Turn rollouts of the same crowd into pictures in the colours of their models.

    Args:
      rollouts: (model, title) -> `Rollout`.
      notes: the same keys -> a line under the title.
    """
    notes = notes or {}
    return [
        CrowdPicture(
            [rollout.motion(k) for k in range(len(rollout.styles))],
            group_shades(model, len(rollout.styles)),
            title,
            notes.get((model, title), ""),
        )
        for (model, title), rollout in rollouts.items()
    ]
