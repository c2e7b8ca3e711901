"""Motion that a reader can turn around: a player as one HTML page, for browsers and notebooks.

`player_page` makes the page, `write_player` writes it, `show_player` shows it in a notebook. The
page is whole: its script and style (`player.js`, `player.css`) and all motion stand in it, a
content security policy forbids it any request, and it works offline and inside an iframe.

Limbs are drawn as lines on a 2D canvas by code of our own. The alternative was three.js, which is
well kept and would bring depth, lights and meshes, none of which a stick figure needs. Its parts
for lines wider than a pixel and a camera to orbit (renderer, `LineSegments2`, `OrbitControls`)
bundle to 583 kB minified (0.187.0), in every page, where a notebook is held under 250 kB; ours
takes 29 kB. And each player would take a WebGL context, of which browsers allow about
16 at a time: fewer than the players of a long notebook, and none where there is no GPU.

How motion is stored (`"version": 1`). The page holds a JSON object with titles, skeletons, frame
rate and, under `tracks`, the numbers: base64 of one zlib stream. All are whole millimetres, so that
a point is off by at most half a millimetre a coordinate. Inflated, the stream holds for each
character of each scene, in the page's order:

| track | type | shape | what |
|---|---|---|---|
| root | int32 | [T, 3] | global position of the root joint |
| points | int16 | [T, P, 3] | joints and tips that are drawn, relative to the root |
| contacts | uint8 | [T, 1] | bit 0: left toe in contact, bit 1: right toe; if `contacts` is true |
| path | int32 | [T, 2] | target x and z; if `path` is true |

int16 reaches 32.767 m from the root, far beyond any limb, wherever the root walks. A track is
stored as its first frame followed by the differences from frame to frame, modulo the type's range;
then channel by channel, T numbers each; then all lowest bytes first, followed by all next ones, as
little endian has them. Differences of smooth motion are small, which lets zlib shorten them.
"""

from __future__ import annotations

import base64
import dataclasses
import html
import json
import re
import string
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from f3amd_lib.drawing.pictures import film_strip
from f3amd_lib.drawing.stick_figures import (
    CONTACT_COLOR,
    LIMB_COLORS,
    TARGET_COLOR,
    TRAIL_COLOR,
    bones_of,
    drawn_points,
    is_head,
    path_on_ground,
)
from f3amd_lib.drawing.style import save_figure, show_figure
from f3amd_lib.motion.skeleton import Motion, Skeleton

_FOLDER = Path(__file__).parent
_MILLIMETRES = 1000.0


@dataclass(frozen=True, eq=False)
class Character:
    """One skeleton in motion, and what is drawn with it.

    Attributes:
      motion: what it does, T frames.
      path: its target path: a `RootPath` of T frames, or [T, 2] (x, z) in metres.
      contacts: which toe is in contact, boolean [T, 2], left then right; by default
        `Motion.contacts`, where the skeleton's toes are known.
      name: for messages; by default the motion's.
      color: "#rrggbb" of trunk, head and trail, to tell characters apart; limbs keep the colours of
        left and right.
    """

    motion: Motion
    path: object = None
    contacts: np.ndarray | None = None
    name: str = ""
    color: str | None = None


@dataclass(frozen=True, eq=False)
class Scene:
    """One panel of the player: characters that share a ground.

    Attributes:
      characters: a `Character` or a `Motion`, or a list of them.
      title: stands over the panel.
      note: a line below the title, such as a measured time.
      boundaries: frames at which a new window begins, such as `range(32, 240, 32)`; ticks on the
        scrubber.
    """

    characters: Sequence[Character | Motion] | Character | Motion
    title: str = ""
    note: str = ""
    boundaries: Sequence[int] = field(default=())


def rollout_scene(rollout, title: str = "", *, note: str = "", colors=None) -> Scene:
    """Make a scene of all characters of a rollout, with target paths and window boundaries.

    Args:
      rollout: a `generation.generated.Rollout`.
      title, note: see `Scene`.
      colors: one "#rrggbb" a character, or None.

    Returns:
      The scene; ticks stand where a window of the rollout begins.

    Raises:
      ValueError: if there are not as many colours as characters.
    """
    count, num_frames = rollout.frames.shape[:2]
    colors = [None] * count if colors is None else list(colors)
    if len(colors) != count:
        raise ValueError(f"{len(colors)} colours for {count} characters")
    characters = [Character(rollout.motion(k), path=rollout.paths[k], color=colors[k]) for k in range(count)]
    boundaries = range(rollout.window, num_frames, rollout.window)
    return Scene(characters, title=title, note=note, boundaries=boundaries)


def player_page(scenes, *, title: str = "", credit: str = "", autoplay: bool = True, follow: bool | None = None) -> str:
    """Make the player as one HTML page.

    Several scenes play side by side, in step and under one camera. All motions of a page have the
    same frame rate and number of frames.

    Args:
      scenes: a `Scene`, `Character` or `Motion`, or a list of them; a character or motion alone
        becomes a scene under its name.
      title: of the page.
      credit: a line at its foot: whose motion this is, and under which terms.
      autoplay: start at once, unless the reader's system asks for reduced motion.
      follow: let the camera go along with the characters; by default it does where every scene
        has one.

    Returns:
      The page, HTML; it needs no file and no network.

    Raises:
      ValueError: for no scene or no character, unlike frame rates or lengths (of motions, paths or
        contacts), numbers not finite, points out of range (see the module's table), boundaries
        that are no frames of the motion, or a colour that is none.
    """
    scenes = _as_scenes(scenes)
    first = scenes[0].characters[0].motion
    drawn: list[_Drawn] = []
    tracks: list[bytes] = []
    described = []
    for scene in scenes:
        boundaries = _checked_boundaries(scene, first.num_frames)
        described.append({"title": scene.title, "boundaries": boundaries, "characters": []})
        for character in scene.characters:
            _check_in_step(character, first)
            how = _what_is_drawn(character.motion.skeleton)
            if how not in drawn:
                drawn.append(how)
            about, pieces = _encode_character(character, how)
            described[-1]["characters"].append({"skeleton": drawn.index(how), **about})
            tracks.extend(pieces)
    data = {
        "version": 1,
        "fps": float(first.fps),
        "frames": first.num_frames,
        "autoplay": bool(autoplay),
        "follow": all(len(scene.characters) == 1 for scene in scenes) if follow is None else follow,
        "around": _first_azimuth(first),
        "skeletons": [dataclasses.asdict(one) | {"points": len(one.points)} for one in drawn],
        "scenes": described,
        "tracks": base64.b64encode(zlib.compress(b"".join(tracks), 9)).decode("ascii"),
    }
    named = title or ", ".join(scene.title for scene in scenes if scene.title) or "Motion"
    return string.Template(_read("player.html")).substitute(
        title=html.escape(named),
        heading=_element("h1", title),
        colors=_color_rules(),
        style=_read("player.css"),
        panels="\n".join(_panel(scene, first) for scene in scenes),
        legend=_legend(described),
        credit=_element('p class="credit"', credit),
        # "</script>" in a title would end the block that holds it.
        data=json.dumps(data, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c"),
        script=_read("player.js"),
    )


def write_player(path, scenes, *, strip: bool = True, overwrite: bool = True, **options) -> Path:
    """Write the player as one HTML file, and beside it a film strip of the same name as PNG.

    Args:
      path: ends in .html; folders are made.
      scenes, options: as for `player_page`.
      strip: write the film strip, for readers without a browser (`scenes_strip`).
      overwrite: replace files that are there; else they are an error.

    Returns:
      The path of the page.

    Raises:
      ValueError: for a wrong suffix, a file that is there already, or as for `player_page`.
    """
    path = Path(path)
    if path.suffix != ".html":
        raise ValueError(f"{path}: players are written as .html")
    targets = [path, path.with_suffix(".png")] if strip else [path]
    taken = ", ".join(str(target) for target in targets if target.exists())
    if taken and not overwrite:
        raise ValueError(f"{taken}: exists already; pass overwrite=True or another path")
    page = player_page(scenes, **options)
    figure = scenes_strip(scenes) if strip else None  # before anything is written: it may refuse
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(page, encoding="utf-8")
    if strip:
        save_figure(figure, targets[1])
    return path


def scenes_strip(scenes, *, num_poses: int = 8, max_rows: int = 4):
    """Draw a film strip of the first character of each scene: what the player shows, on paper.

    Args:
      scenes: as for `player_page`.
      num_poses: poses a row.
      max_rows: scenes drawn at most.

    Returns:
      A matplotlib Figure (see `pictures.film_strip`).
    """
    scenes = _as_scenes(scenes)[:max_rows]
    firsts = [scene.characters[0] for scene in scenes]
    return film_strip(
        [character.motion for character in firsts],
        paths=[character.path for character in firsts],
        titles=[scene.title or None for scene in scenes],
        num_poses=num_poses,
    )


class Player:
    """A player that a notebook shows when it is a cell's last value, with its film strip below.

    The page runs in an iframe of its own that may run scripts and nothing else: it sees neither the
    notebook nor the network. The film strip is an image of its own, for viewers that show no iframe
    (a notebook on a code host, a printed one).
    """

    def __init__(self, page: str, height: int, strip):
        self.page = page
        self.height = height
        self.strip = strip

    @property
    def iframe(self) -> str:
        """The player as an HTML element to put into another page."""
        titled = re.search(r"<title>(.*?)</title>", self.page, re.S)[1]
        return (
            f'<iframe title="Motion player: {titled}" sandbox="allow-scripts" loading="lazy" '
            f'style="width:100%;height:{self.height}px;border:1px solid #8a8a8a;border-radius:6px" '
            f'srcdoc="{html.escape(self.page, quote=True)}"></iframe>'
        )

    def _ipython_display_(self) -> None:
        from IPython.display import display

        plain = "Motion player (shown by viewers that run HTML)"
        display({"text/html": self.iframe, "text/plain": plain}, raw=True)
        if self.strip is not None:
            display(self.strip)


def show_player(
    scenes, *, height: int = 480, strip: bool = True, strip_dpi: int = 70, autoplay: bool = False, **options
) -> Player:
    """Show the player in a notebook, with a film strip as an image below it.

    Args:
      scenes, options: as for `player_page`.
      height: of the player, CSS pixels.
      strip: show the film strip (`scenes_strip`).
      strip_dpi: its dots an inch.
      autoplay: start at once. A notebook with many players rests easier without.

    Returns:
      What Jupyter displays; as a cell's last value it shows itself.

    Raises:
      ValueError: as for `player_page`, or a height under 200.
    """
    if not height >= 200:
        raise ValueError(f"height must be 200 or more pixels, got {height}")
    page = player_page(scenes, autoplay=autoplay, **options)
    image = show_figure(scenes_strip(scenes), dpi=strip_dpi, colors=128) if strip else None
    return Player(page, int(height), image)


# ---------------------------------------------------------------------------------- what comes in


def _as_scenes(scenes) -> list[Scene]:
    """Bring whatever `player_page` takes into scenes of characters."""
    if isinstance(scenes, (Scene, Character, Motion)):
        scenes = [scenes]
    whole = [_as_scene(scene, f"scene {place}") for place, scene in enumerate(scenes)]
    if not whole:
        raise ValueError("a player needs at least one scene")
    return whole


def _as_scene(given, label: str) -> Scene:
    if not isinstance(given, Scene):
        character = _as_character(given, label)
        return Scene([character], title=character.name)
    label = f"{label} ({given.title})" if given.title else label
    characters = given.characters
    if isinstance(characters, (Character, Motion)):
        characters = [characters]
    if not characters:
        raise ValueError(f"{label} has no character")
    characters = [_as_character(one, f"{label}, character {k}") for k, one in enumerate(characters)]
    return dataclasses.replace(given, characters=characters)


def _as_character(given, label: str) -> Character:
    """Give a character the name that messages call it by."""
    if isinstance(given, Motion):
        given = Character(given)
    if not isinstance(given, Character) or not isinstance(given.motion, Motion):
        raise ValueError(f"{label} is a {type(given).__name__}; give a Scene, Character or Motion")
    if given.color is not None and not re.fullmatch(r"#[0-9a-fA-F]{6}", given.color):
        raise ValueError(f"{label}: color must be like '#1b4f8f', got {given.color!r}")
    return dataclasses.replace(given, name=given.name or given.motion.name or label)


def _check_in_step(character: Character, first: Motion) -> None:
    motion, there = character.motion, "where the player's first motion has"
    if abs(motion.fps - first.fps) > 1e-6:
        raise ValueError(f"{character.name}: {motion.fps:g} frames a second, {there} {first.fps:g}; resample it")
    if motion.num_frames != first.num_frames:
        raise ValueError(f"{character.name}: {motion.num_frames} frames, {there} {first.num_frames}; use Motion.slice")


def _checked_boundaries(scene: Scene, num_frames: int) -> list[int]:
    for frame in scene.boundaries:
        if frame not in range(1, num_frames):
            raise ValueError(
                f"boundary {frame} of scene {scene.title!r} is no frame between 1 and {num_frames - 1}, "
                "where a new window could begin"
            )
    return sorted({int(frame) for frame in scene.boundaries})


# ------------------------------------------------------------------------------ what is drawn of it


@dataclass(frozen=True)
class _Drawn:
    """Points of a skeleton that the player draws, and how; indices below are places in `points`."""

    points: tuple[int, ...]  # of joints, then end sites
    limbs: list[dict]  # side and bones, (parent, child) pairs
    head: tuple[int, int] | None  # head and neck
    toes: tuple[int, int] | None


def _what_is_drawn(skeleton: Skeleton) -> _Drawn:
    """Sort bones into limbs, which are drawn whole, far ones first.

    A limb is a chain of bones of one side: it begins where a bone's side differs from that of the
    bone above it. Sorting a handful of limbs does for the eye what sorting all bones would, in a
    fraction of the strokes.
    """
    limb_of: dict[int, int] = {}  # the limb whose bone ends in this point
    limbs: list[dict] = []
    middle = None  # the trunk is one limb, though hips and shoulders part it
    for parent, child, side in sorted(bones_of(skeleton), key=lambda bone: bone[1]):
        number = middle if side == "middle" else limb_of.get(parent)
        if number is None or limbs[number]["side"] != side:
            number = len(limbs)
            limbs.append({"side": side, "bones": []})
        if side == "middle":
            middle = number
        limbs[number]["bones"].append((parent, child))
        limb_of[child] = number
    heads = [k for k, name in enumerate(skeleton.names) if is_head(name)]
    head = (heads[0], skeleton.parents[heads[0]]) if heads and heads[0] > 0 else None
    try:
        toes = skeleton.toes
    except ValueError:  # a rig that we do not know has no contacts to show
        toes = None
    needed = {point for limb in limbs for bone in limb["bones"] for point in bone}
    points = tuple(sorted(needed | {0, *(head or ()), *(toes or ())}))
    places = lambda pair: None if pair is None else (points.index(pair[0]), points.index(pair[1]))
    limbs = [{"side": limb["side"], "bones": [places(bone) for bone in limb["bones"]]} for limb in limbs]
    return _Drawn(points, limbs, places(head), places(toes))


def _first_azimuth(motion: Motion) -> float:
    """Where the camera stands at first: 50 degrees to the right of where the first one faces."""
    try:
        facing = float(motion.yaw[0])
    except ValueError:  # hips unknown
        facing = 0.0
    return round(facing - np.deg2rad(50.0), 4)


# ----------------------------------------------------------------------------------- as numbers


def _encode_character(character: Character, drawn: _Drawn) -> tuple[dict, list[bytes]]:
    """Describe a character and turn its tracks into bytes."""
    motion, label = character.motion, character.name
    num_frames = motion.num_frames
    points = drawn_points(motion, np.arange(num_frames))[:, drawn.points]
    root = _whole_millimetres(points[:, 0], label, "root")
    joints = _whole_millimetres(points, label, "points") - root[:, None]
    reach = np.abs(joints).max(axis=(1, 2))
    if reach.max() > np.iinfo(np.int16).max:
        frame = int(reach.argmax())
        raise ValueError(
            f"{label}: a joint lies {reach[frame] / _MILLIMETRES:.1f} m from its root at frame "
            f"{frame}, the player reaches 32.767 m; are its units metres?"
        )
    pieces = [_track(root, "<i4"), _track(joints, "<i2")]

    contacts = character.contacts
    if contacts is None and drawn.toes is not None:
        contacts = motion.contacts
    if contacts is not None:
        contacts = np.asarray(contacts)
        if drawn.toes is None:
            raise ValueError(f"{label}: contacts are given, but this skeleton's toes are not known")
        if contacts.shape != (num_frames, 2):
            raise ValueError(f"{label}: contacts must be [{num_frames}, 2] (left, right), got {contacts.shape}")
        if not np.isin(contacts, (0, 1)).all():
            raise ValueError(f"{label}: contacts must be true or false, or 0 or 1")
        pieces.append(_track((contacts.astype(bool) @ np.array([1, 2]))[:, None], "u1"))

    if character.path is not None:
        try:
            path = path_on_ground(character.path)
        except ValueError as error:
            raise ValueError(f"{label}: {error}") from None
        fps = getattr(character.path, "fps", motion.fps)
        if len(path) != num_frames or abs(fps - motion.fps) > 1e-6:
            raise ValueError(
                f"{label}: the target path has {len(path)} frames at {fps:g} a second, the motion "
                f"{num_frames} at {motion.fps:g}"
            )
        pieces.append(_track(_whole_millimetres(path, label, "path"), "<i4"))
    about = {"color": character.color, "contacts": contacts is not None, "path": character.path is not None}
    return about, pieces


def _whole_millimetres(metres: np.ndarray, label: str, what: str) -> np.ndarray:
    """Round to millimetres, int64, and refuse what int32 cannot hold."""
    largest = np.abs(metres).max()
    if not largest * _MILLIMETRES < np.iinfo(np.int32).max:  # also catches NaN
        frame = int(np.argmax(~(np.abs(metres) < 2e6).reshape(len(metres), -1).all(axis=1)))
        raise ValueError(f"{label}: {what} at frame {frame} is not finite, or over 2000 km from the origin")
    return np.rint(metres * _MILLIMETRES).astype(np.int64)


def _track(values: np.ndarray, dtype: str) -> bytes:
    """Differences along time, channel by channel, lowest bytes first (see the module's text)."""
    values = values.reshape(len(values), -1)
    steps = np.concatenate([values[:1], np.diff(values, axis=0)])
    narrow = np.ascontiguousarray(steps.T).astype(dtype)  # wraps round, and back when added up
    return np.ascontiguousarray(narrow.reshape(-1, 1).view(np.uint8).T).tobytes()


# -------------------------------------------------------------------------------------- as HTML


def _read(name: str) -> str:
    """Read a part of the page without its indents and lines of comment, a sixth of its bytes."""
    lines = (_FOLDER / name).read_text(encoding="utf-8").splitlines()
    stripped = (line.strip() for line in lines)
    return "\n".join(line for line in stripped if line and not line.startswith("//"))


def _color_rules() -> str:
    """The pictures' colours, so that strips, GIFs and the player look alike; CSS has dark ones."""
    colors = {**LIMB_COLORS, "contact": CONTACT_COLOR, "target": TARGET_COLOR, "trail": TRAIL_COLOR}
    return ":root { " + " ".join(f"--{name}: {color};" for name, color in colors.items()) + " }"


def _panel(scene: Scene, first: Motion) -> str:
    count = len(scene.characters)
    shown = (
        f"{scene.title or 'Motion'}: {count} {'character' if count == 1 else 'characters'} of "
        f"{scene.characters[0].motion.skeleton.num_joints} joints, {first.num_frames / first.fps:.1f} seconds"
    )
    title = _element("strong", scene.title)
    return (
        f'<figure class="panel"><figcaption>{title}{_element("span", scene.note)}</figcaption>'
        f'<canvas role="img" aria-label="{html.escape(shown, quote=True)}"></canvas></figure>'
    )


def _element(opening: str, text: str) -> str:
    """Put text into an element, such as 'p class="credit"'; nothing if there is no text."""
    return f"<{opening}>{html.escape(text)}</{opening.split()[0]}>" if text else ""


def _legend(scenes: list[dict]) -> str:
    """Say what the colours mean, of those that are there."""
    characters = [character for scene in scenes for character in scene["characters"]]
    keys = [("line", "left", "left"), ("line", "right", "right")]
    if any(character["contacts"] for character in characters):
        keys.append(("dot", "contact", "toe in contact"))
    if not all(character["color"] for character in characters):
        keys.append(("line", "trail", "walked"))
    if any(character["path"] for character in characters):
        keys.append(("dash", "target", "target path"))
    if any(scene["boundaries"] for scene in scenes):
        keys.append(("tick", None, "a window begins"))
    items = []
    for kind, color, text in keys:
        rule = "border-color" if kind == "dash" else "background"
        style = f' style="{rule}:var(--{color})"' if color else ""
        items.append(f'<span><i class="{kind}"{style}></i>{text}</span>')
    return "".join(items) + '<span id="grid-key"></span>'
