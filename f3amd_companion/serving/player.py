"""Motion that a reader can turn around: a player as one HTML page.

`player_page` makes the page, `write_player` writes it. The page is whole: scripts, style and all motion stand in it, a
content security policy forbids it any request, and it works offline and inside an iframe. It is drawn with three.js
(MIT, `web/three.min.js`), of which each page carries 220 kB; the scripts beside it are ours.

How motion is stored (`"version": 2`). The page holds a JSON object with titles, skeletons, frame rate and, under
`tracks`, the numbers: base64 of one zlib stream. Inflated, the stream holds for each character of each scene, in the
page's order:

| track | type | shape | what |
|---|---|---|---|
| root | int32 | [T, 3] | global position of the root joint, millimetres |
| turns | int16 | [T, J, 3] | rotation vector of each joint (the root's is global), `turns` steps a radian |
| contacts | uint8 | [T, 1] | bit 0: left toe in contact, bit 1: right toe; if `contacts` is true |
| path | int32 | [T, 2] | target x and z, millimetres; if `path` is true |

A track is stored as its first frame followed by the differences from frame to frame, modulo the type's range; then
channel by channel, T numbers each; then all lowest bytes first, followed by all next ones, as little endian has them.
Differences of smooth motion are small, which lets zlib shorten them. Joints come back to about a millimetre,
those of a crowd to a few.
"""

import base64
import hashlib
import html
import json
import string
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType

import numpy as np
from scipy.spatial.transform import Rotation

from f3amd_lib.drawing import stick_figures
from f3amd_lib.drawing.pictures import film_strip
from f3amd_lib.drawing.style import save_figure
from f3amd_lib.ground.files import named_file, write_whole
from f3amd_lib.motion.skeleton import Motion, Skeleton
from f3amd_lib.text.data.body import body_capsules

FOLDER = Path(__file__).parent / "web"
"""Scripts, styles and templates of pages. The modules import each other by name."""

POLICY = (
    "default-src 'none'; base-uri 'none'; form-action 'none'; style-src 'unsafe-inline'; img-src data:; "
    "script-src blob: 'nonce-{}'"
)
"""Content security policy of every page: what it carries, no request to anybody, no script that stands in markup."""

_MILLIMETRES = 1000.0
_FINE, _COARSE = 4096, 1024  # steps a radian, of a few characters and of more than `_FEW`
_FEW = 12


@dataclass(frozen=True, eq=False)
class Character:
    """One skeleton in motion, and what is drawn with it.

    Attributes:
      motion: what it does, T frames.
      path: its target path: a `RootPath` of T frames, or [T, 2] (x, z) in metres.
      name: that the page calls it by; by default the motion's.
      color: "#rrggbb" of body and trail, to tell characters apart; of sticks, limbs keep the colours of left and right.
      ghost: another motion that is drawn with this one and can be seen through, such as the real clip.
    """

    motion: Motion
    path: object = None
    name: str = ""
    color: str | None = None
    ghost: Motion | None = None


@dataclass(frozen=True, eq=False)
class Scene:
    """One panel of the player: characters that share a ground.

    Attributes:
      characters: a `Character` or a `Motion`, or a list of them.
      title: above the panel.
      note: a line below the title, such as a measured time.
      boundaries: frames at which a new window begins, such as `range(32, 240, 32)`; ticks on the
        scrubber.
    """

    characters: Sequence[Character | Motion] | Character | Motion
    title: str = ""
    note: str = ""
    boundaries: Sequence[int] = field(default=())


def rollout_scene(rollout, title: str = "") -> Scene:
    """Make a scene of all characters of a `rollout.generated.Rollout`, with target paths and window boundaries."""
    characters = [Character(rollout.motion(k), path=path) for k, path in enumerate(rollout.paths)]
    return Scene(characters, title=title, boundaries=range(rollout.window, rollout.frames.shape[1], rollout.window))


def player_page(scenes, *, title: str = "", credit: str = "", autoplay: bool = True) -> str:
    """Make the player as one HTML page.

    Several scenes play side by side, in step and under one camera. All motions of a page have the
    same frame rate and number of frames.

    Args:
      scenes: a `Scene`, `Character` or `Motion`, or a list of them; a character or motion alone
        becomes a scene under its name.
      title: of the page.
      credit: a line at its foot: whose motion this is, and under which terms.
      autoplay: start at once, unless the reader's system asks for reduced motion.

    Returns:
      The page, HTML; it needs no file and no network.

    Raises:
      ValueError: for no scene or no character, unlike frame rates or lengths (of motions or paths), motion
        without rotations, or numbers not finite or too far out.
    """
    scenes = _as_scenes(scenes)
    first = scenes[0].characters[0].motion
    skeletons: list[Skeleton] = []
    tracks: list[bytes] = []
    described = []
    steps = _FINE if sum(len(scene.characters) for scene in scenes) <= _FEW else _COARSE
    for scene in scenes:
        boundaries = sorted({int(frame) for frame in scene.boundaries})
        described.append({"title": scene.title, "boundaries": boundaries, "characters": []})
        for character in scene.characters:
            for one in (character, *([Character(character.ghost, name="ghost")] if character.ghost else [])):
                about, pieces = _encode_character(one, first, steps, ghost=one is not character)
                if one.motion.skeleton not in skeletons:
                    skeletons.append(one.motion.skeleton)
                about["skeleton"] = skeletons.index(one.motion.skeleton)
                described[-1]["characters"].append(about)
                tracks.extend(pieces)
    data = {
        "version": 2,
        "fps": float(first.fps),
        "frames": first.num_frames,
        "turns": steps,
        "autoplay": bool(autoplay),
        "follow": all(len(scene.characters) == 1 for scene in scenes),
        "around": _first_azimuth(first),
        "skeletons": [describe_for_web(skeleton) for skeleton in skeletons],
        "scenes": described,
        "tracks": base64.b64encode(zlib.compress(b"".join(tracks), 9)).decode("ascii"),
    }
    named = title or ", ".join(scene.title for scene in scenes if scene.title) or "Motion"
    texts = {
        "title": html.escape(named),
        "heading": _element("h1", title),
        "colors": _color_rules(),
        "panels": "\n".join(_panel(scene, first) for scene in scenes),
        "credit": _element('p class="credit"', credit),
    }
    modules = {"three": (FOLDER / "three.min.js").read_text(encoding="utf-8")}
    return whole_page(
        "player", texts, data, modules | {name: read_web(f"{name}.js") for name in ("scene", "body", "bvh")}
    )


def write_player(path, scenes, *, strip: bool = True, **options) -> Path:
    """Write the player as one HTML file, and beside it a film strip of the same name as PNG.

    Args:
      path: ends in .html; folders are made, files that are there are replaced.
      scenes, options: as for `player_page`.
      strip: write the film strip, for readers without a browser (`scenes_strip`).

    Returns:
      The path of the page.

    Raises:
      ValueError: for a wrong suffix, or as for `player_page`.
    """
    path = named_file(path, ".html", "players")
    page = player_page(scenes, **options)
    figure = scenes_strip(scenes) if strip else None  # before anything is written: it may refuse
    write_whole(path, page)
    if strip:
        save_figure(figure, path.with_suffix(".png"))
    return path


def scenes_strip(scenes):
    """Draw a film strip of the first character of up to four scenes: what the player shows, on paper.

    Args:
      scenes: as for `player_page`.

    Returns:
      A matplotlib Figure (see `pictures.film_strip`).
    """
    scenes = _as_scenes(scenes)[:4]
    firsts = [scene.characters[0] for scene in scenes]
    titles = [scene.title or None for scene in scenes]
    return film_strip([one.motion for one in firsts], paths=[one.path for one in firsts], titles=titles)


# ---------------------------------------------------------------------------------- what comes in


def _as_scenes(scenes) -> list[Scene]:
    """Bring whatever `player_page` takes into scenes of characters."""
    if not (scenes := list(scenes) if isinstance(scenes, (list, tuple)) else [scenes]):
        raise ValueError("a player needs at least one scene")
    return [_as_scene(scene) for scene in scenes]


def _as_scene(given) -> Scene:
    if isinstance(given, Motion):
        given = Character(given)
    if isinstance(given, Character):
        given = Scene(given, title=given.name or given.motion.name)
    whole = getattr(given, "characters", None)
    whole = whole if isinstance(whole, (list, tuple)) else [whole]
    if not whole or not all(isinstance(one, (Character, Motion)) for one in whole):
        raise ValueError(f"cannot show {given!r:.60}; give a Motion, a Character or a Scene that has characters")
    whole = [Character(one) if isinstance(one, Motion) else one for one in whole]
    return Scene(whole, given.title, given.note, given.boundaries)


# ------------------------------------------------------------------------------ what is drawn of it


def describe_for_web(skeleton: Skeleton) -> dict:
    """Describe a skeleton with its body and sticks as `web/body.js` wants it, metres, ready for JSON."""

    def numbers(values):
        return [round(float(value), 5) for value in values]

    offsets = [*skeleton.offsets, *(offset for _, offset in skeleton.end_sites)]
    capsules = [
        [one.joint, numbers(one.start), numbers(one.end), numbers(one.radii), numbers(one.wide)]
        for one in body_capsules(skeleton)
    ]
    return {
        "names": list(skeleton.names),
        "parents": list(skeleton.parents),
        "offsets": [numbers(offset) for offset in skeleton.offsets],
        "sides": [stick_figures.limb_side(name) for name in skeleton.names],
        "capsules": capsules,
        "bones": [[parent, numbers(offsets[child]), side] for parent, child, side in stick_figures.bones_of(skeleton)],
        "head": stick_figures.head_and_parent(skeleton),
        "toes": stick_figures.toes_of(skeleton) or None,
    }


def _first_azimuth(motion: Motion) -> float:
    """The camera's first position: 50 degrees to the right of where the first one faces."""
    yaw = stick_figures.yaw_of(motion)
    return round((0.0 if yaw is None else float(yaw[0])) - np.deg2rad(50.0), 4)


# ----------------------------------------------------------------------------------- as numbers


def _encode_character(character: Character, first: Motion, steps: int, ghost: bool) -> tuple[dict, list[bytes]]:
    """Describe a character and turn its tracks into bytes; ValueError where it does not go with the first motion."""
    motion, label = character.motion, character.name or character.motion.name
    frames, has_contacts = motion.num_frames, bool(stick_figures.toes_of(motion.skeleton)) and not ghost
    path = None if character.path is None else stick_figures.path_on_ground(character.path)
    lengths = {(frames, motion.fps), (first.num_frames, first.fps)}
    if path is not None:
        lengths.add((len(path), getattr(character.path, "fps", motion.fps)))
    if len(lengths) > 1:
        told = ", ".join(f"{count} frames at {fps:g} a second" for count, fps in sorted(lengths))
        raise ValueError(f"{label}: the motions and paths of a page must have the same frames, got {told}")
    turns = Rotation.from_matrix(motion.needed_rotations("the player").reshape(-1, 3, 3)).as_rotvec()
    turns = np.rint(steps * turns).reshape(frames, -1)
    pieces = [_track(_whole_millimetres(motion.root_position, label), "<i4"), _track(turns, "<i2")]
    if has_contacts:
        pieces.append(_track((motion.contacts.astype(bool) @ np.array([1, 2]))[:, None], "u1"))
    if path is not None:
        pieces.append(_track(_whole_millimetres(path, label), "<i4"))
    about = {"name": label, "color": character.color, "ghost": ghost}
    return about | {"contacts": has_contacts, "path": path is not None}, pieces


def _whole_millimetres(metres: np.ndarray, label: str) -> np.ndarray:
    """Round to millimetres, int64, and refuse what int32 cannot hold."""
    if not np.abs(metres).max() * _MILLIMETRES < np.iinfo(np.int32).max:  # also catches NaN
        raise ValueError(f"{label}: a position is not finite, or over 2000 km from the origin")
    return np.rint(metres * _MILLIMETRES).astype(np.int64)


def _track(values: np.ndarray, dtype: str) -> bytes:
    """Differences along time, channel by channel, lowest bytes first (see the module's text)."""
    values = values.reshape(len(values), -1)
    steps = np.concatenate([values[:1], np.diff(values, axis=0)])
    narrow = np.ascontiguousarray(steps.T).astype(np.int64).astype(dtype)  # wraps round, and back when added up
    return np.ascontiguousarray(narrow.reshape(-1, 1).view(np.uint8).T).tobytes()


# -------------------------------------------------------------------------------------- as HTML


def read_web(name: str) -> str:
    """Read a file of `serving/web` without its indents and lines of comment, a sixth of its bytes."""
    lines = (FOLDER / name).read_text(encoding="utf-8").splitlines()
    stripped = (line.strip() for line in lines)
    return "\n".join(line for line in stripped if line and not line.startswith("//"))


def whole_page(
    name: str, texts: dict, data, modules: dict, files: Mapping[str, bytes] = MappingProxyType({}), policy: str = ""
) -> str:
    """Make a page of `web/page.html`, with its style, modules and files inside and a content security policy.

    They are carried compressed; `web/start.js` unpacks them, tells the browser the modules' names in an import map, and
    calls `start(files)` of the one that is called as the page. Browsers of 2023 and later can do that (Chrome 89,
    Firefox 113, Safari 16.4).

    Args:
      name: of the body (.html), style (.css) and module (.js), all in `serving/web`.
      texts: the page's title and what body and style ask for, ready for HTML.
      data: what stands as JSON in the page's element "NAME-data".
      modules: other JavaScript, by the name by which it is imported.
      files: what `start` is given.
      policy: what scripts may do besides, added to the end of `POLICY`.
    """
    pack = lambda part: base64.b64encode(zlib.compress(part, 9)).decode()
    scripts = {key: pack(text.encode()) for key, text in {**modules, name: read_web(f"{name}.js")}.items()}
    packed = {"start": name, "modules": scripts, "files": {key: pack(part) for key, part in files.items()}}
    carried = {"start": read_web("start.js"), "data": _page_json(data), "packed": _page_json(packed)}
    fill = lambda file, **more: string.Template(read_web(file)).substitute(texts, **more)
    carried |= {"page": name, "body": fill(f"{name}.html"), "style": fill(f"{name}.css")}
    nonce = hashlib.sha256(repr((texts, carried)).encode()).hexdigest()  # no name that the page shows can hold it
    return fill("page.html", nonce=nonce, policy=POLICY.format(nonce) + policy, **carried)


def _page_json(value) -> str:
    """Return a value as JSON that may stand in a script element: "</script>" in a name would end the element."""
    return json.dumps(value, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")


def _color_rules() -> str:
    """The pictures' colours, so that strips, GIFs and the player look alike; CSS has dark ones."""
    others = {name: getattr(stick_figures, f"{name.upper()}_COLOR") for name in ("contact", "target", "trail")}
    colors = stick_figures.LIMB_COLORS | others
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
        f'<div class="labels" role="img" aria-label="{html.escape(shown, quote=True)}"></div></figure>'
    )


def _element(opening: str, text: str) -> str:
    """Put text into an element, such as 'p class="credit"'; nothing if there is no text."""
    return f"<{opening}>{html.escape(text)}</{opening.split()[0]}>" if text else ""
