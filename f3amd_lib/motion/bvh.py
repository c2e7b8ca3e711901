"""BVH motion files: a strict reader and a writer.

A BVH file is text: a HIERARCHY of joints with bone offsets and named channels, then a MOTION block
with one row of numbers per frame. The reader takes any hierarchy and any channel order, and says
file, line and remedy when a file is broken. Files hold centimetres and degrees; a `Motion` holds
metres and rotation matrices.
"""

import contextlib
import io
import re
import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from f3amd_lib.ground import log
from f3amd_lib.ground.files import write_whole
from f3amd_lib.motion.rotations import euler_from_matrix, matrix_from_euler
from f3amd_lib.motion.skeleton import Motion, Skeleton

RIGID_TOLERANCE, TOLD_TOLERANCE = 5e-3, 1e-3
"""Metres by which a joint's position channels may wander before its bone is not rigid, and before that is told."""

USUAL_RATES = (24, 25, 30, 48, 50, 60, 72, 90, 100, 120, 144, 150, 200, 240)
"""Frames per second that a frame time of few digits stands for: .033 is 30."""

LARGEST_NUMBER = 1e8
"""Largest number of a file, either way: 1,000 km in centimetres, and as many degrees."""

_METRES = 0.01  # in a centimetre

FRAME_TIMES = (1e-5, 1.0)
"""Shortest and longest time between frames, seconds."""

_NUMBER = re.compile(r"[+-]?(\d++\.?\d*+|\.\d++)([eE][+-]?\d+)?", re.ASCII)
_BRACES = "check that every '{' has its '}'"

_NAMED = r"[ \t]+([^\s{}][^\n{}]*+)\s*+\{", "a name on the same line, then '{'"
_OFFSET = r"\s+([^\s{}]+)" * 3
_STATEMENTS = {
    "HIERARCHY": ("", ""),
    "ROOT": _NAMED,
    "JOINT": _NAMED,
    "OFFSET": (_OFFSET, "3 finite numbers"),
    "CHANNELS": (
        r"\s+([0-9]{1,9})((?:\s+[XYZ](?:position|rotation)\b)*)",
        "a count and names, such as 'CHANNELS 1 Xrotation'",
    ),
    # A few exporters name their tips; the name carries nothing.
    "END": (r"\s+Site[^\n{}]*+\s*+\{\s*OFFSET" + _OFFSET + r"\s*\}", "to be as in 'End Site { OFFSET 0 10 0 }'"),
    "}": ("", ""),
}
"""What may stand in the HIERARCHY: keyword -> pattern of what follows it, and how messages tell it."""

_WORD = re.compile(r"\s*([{}]|[^\s{}]+|$)")
_NOTE = re.compile(r"^[ \t]*(#|//|;).*$", re.MULTILINE)
_MOTION_LINE = re.compile(rb"^[ \t]*MOTION[ \t]*$", re.IGNORECASE | re.MULTILINE)
_MOTION_HEAD = re.compile(
    rb"\s*Frames[ \t]*:?[ \t]*(\S+)[ \t]*\n\s*Frame\s*Time[ \t]*:?[ \t]*(\S+)[ \t]*(?:\n|$)", re.IGNORECASE
)


class _Broken(Exception):
    """(line, what is wrong and what to do); `parse_bvh` adds the file's name."""


@dataclass
class _Joint:
    """What the HIERARCHY says of one joint; offset in metres, columns of the MOTION block by channel ("Xrotation")."""

    name: str
    line: int
    parent: int
    offset: list[float] | None = None
    channels: dict[str, int] | None = None

    def columns(self, kind: str) -> dict[str, int]:
        """Return axis -> column, for "position" or "rotation", in the order of the file."""
        return {channel[0]: column for channel, column in self.channels.items() if channel.endswith(kind)}


def read_bvh(path) -> Motion:
    """Read a BVH file in centimetres.

    Args:
      path: of the file; its text from elsewhere is for `parse_bvh`.

    Returns:
      A `Motion` at the file's own frame rate, called by its path (see `parse_bvh`).

    Raises:
      ValueError: naming the file, the line and what to mend; also if the file cannot be read.
    """
    try:
        content = Path(path).read_bytes()
    except OSError as error:
        raise ValueError(f"{path}: cannot be read ({error.strerror}); check the path") from error
    return parse_bvh(content, str(path))


def parse_bvh(text: str | bytes, name: str) -> Motion:
    """Turn the text of a BVH file in centimetres into a `Motion`.

    How channels are read:
      * Position channels replace OFFSET (they are not added to it). Below the root they must be
        constant to `RIGID_TOLERANCE`; their mean then is the bone. Where they are zero throughout, OFFSET is.
      * R is the product of the rotations in the order in which the channels are listed.
      * A first joint with position channels whose only child has position channels too (Bandai's
        `joint_Root` above `Hips`) only carries its child. It is folded into the child, which
        becomes the root; joint positions stay what they were.
      * Joints come in the order of the file, parents first.

    Args:
      text: content of the file; line ends may be LF, CRLF, CR CR LF or CR, blanks may be tabs, names in Latin-1. Rows
        may be wrapped, and notes may stand in lines of their own in the HIERARCHY (#, // or ;) and after the rows.
      name: what messages and the motion call it.

    Returns:
      A `Motion` in float64, metres, at the file's own frame rate.

    Raises:
      ValueError: "name, line n: what is wrong; what to do" for anything that is not a sound BVH.
    """
    data = text.encode("utf-8", "surrogatepass") if isinstance(text, str) else text
    data = re.sub(rb"\r*\n|\r", b"\n", data) if b"\r" in data else data
    try:
        motion = _MOTION_LINE.search(data)
        head = data[: motion.start()] if motion else data
        if b"\0" in head:
            raise _Broken(1, "is UTF-16 or no text at all; save it as UTF-8")
        try:
            hierarchy = head.decode("utf-8-sig")
        except UnicodeDecodeError:
            hierarchy = head.decode("latin-1")
        if motion is None:
            raise _Broken(1 + data.count(b"\n"), "the file ends without a MOTION line; export or copy it again")
        joints, end_sites = _parse_hierarchy(_NOTE.sub("", hierarchy))
        values, frame_time = _parse_motion(data, motion.end(), joints)
        return _build_motion(joints, end_sites, values, frame_time, name)
    except _Broken as error:
        raise ValueError("{}, line {}: {}".format(name, *error.args)) from None


def finite_number(word: str, largest: float = LARGEST_NUMBER) -> float | None:
    """Return a word as a float, or None if it is no decimal number of at most the largest, either way."""
    value = float(word) if _NUMBER.fullmatch(word) else np.nan
    return value if abs(value) <= largest else None


def _statements(text: str):
    """Yield (line, keyword, the words after it) of the HIERARCHY, one statement after the other."""
    place, line = 0, 1
    while (word := _WORD.match(text, place))[1]:
        line += text.count("\n", place, word.start(1))
        keyword = word[1].upper()
        if keyword not in _STATEMENTS:
            glued = re.match(r"[A-Z]+(?=[-+.\d])", keyword)
            fix = f"put a blank after {glued[0]}" if glued else f"known here are {', '.join(_STATEMENTS)}"
            raise _Broken(line, f"unexpected {word[1][:40]!r}; {fix}")
        pattern, needed = _STATEMENTS[keyword]
        found = re.compile(pattern, re.IGNORECASE).match(text, word.end())
        if found is None:
            there = " ".join(text[word.end() : word.end() + 80].split())
            raise _Broken(line, f"{keyword} needs {needed}, found {there[:40]!r}")
        yield line, keyword, found.groups()
        place = found.end()
        line += text.count("\n", word.start(1), place)


def _comma(word: str) -> str:
    """Return the end of a message on a word that is no number."""
    return "; write decimal points, not commas" if "," in word else ""


def _offset(words: tuple[str, ...], line: int) -> list[float]:
    values = [finite_number(word) for word in words]
    if None in values:
        raise _Broken(line, f"OFFSET needs 3 finite numbers, found {' '.join(words)[:40]!r}{_comma(words[0])}")
    return [_METRES * value for value in values]


def _parse_hierarchy(text: str) -> tuple[list[_Joint], list[tuple[int, list[float]]]]:
    """Return the joints in file order and the End Sites as (joint, offset)."""
    joints, taken, end_sites, column = [], {}, [], 0
    open_joints = []  # whose braces are open, innermost last
    for line, keyword, words in _statements(text):
        if keyword == "HIERARCHY":
            continue
        if keyword == "ROOT" and joints:
            first = f"the first is {joints[0].name!r} in line {joints[0].line}"
            raise _Broken(line, f"a second ROOT ({first}); a file holds one character: split it")
        if keyword != "ROOT" and not open_joints:
            raise _Broken(line, f"{keyword!r} is outside the ROOT's braces; {_BRACES}")
        if keyword in ("ROOT", "JOINT"):
            name = " ".join(words[0].split())
            if name in taken:
                raise _Broken(line, f"joint name {name!r} is taken (line {taken[name]}); rename one")
            taken[name] = line
            joints.append(_Joint(name, line, open_joints[-1] if open_joints else -1))
            open_joints.append(len(joints) - 1)
            continue
        joint = joints[open_joints[-1]]
        if keyword == "}":
            if joint.offset is None or joint.channels is None:
                what = "OFFSET" if joint.offset is None else "CHANNELS"
                raise _Broken(line, f"joint {joint.name!r} ends without {what}; add the line")
            open_joints.pop()
        elif keyword == "END":
            end_sites.append((open_joints[-1], _offset(words, line)))
        elif getattr(joint, keyword.lower()) is not None:
            raise _Broken(line, f"joint {joint.name!r} has a second {keyword}; remove one")
        elif keyword == "OFFSET":
            joint.offset = _offset(words, line)
        else:
            count, channels = words[0], [channel.capitalize() for channel in words[1].split()]
            joint.channels = {channel: column + k for k, channel in enumerate(channels)}
            column += len(channels)
            if not int(count) == len(channels) == len(joint.channels):
                listed = ", ".join(channels)[:80] or "none"
                what = f"joint {joint.name!r} says it has {count} channels, but lists {listed}"
                raise _Broken(line, f"{what}; each is X, Y or Z with position or rotation, such as Xposition, and once")
    end = 1 + text.count("\n")
    if open_joints:
        unclosed = joints[open_joints[-1]]
        what = f"the '{{' of {unclosed.name!r} (line {unclosed.line}) is still open where the HIERARCHY ends"
        raise _Broken(end, f"{what}; {_BRACES}")
    if column == 0:
        raise _Broken(end, "no joint has a channel, so there is no motion to read; a ROOT needs CHANNELS")
    return joints, end_sites


def _parse_motion(data: bytes, place: int, joints: list[_Joint]) -> tuple[np.ndarray, float]:
    """Return the numbers of the MOTION block, [frames, channels], and the seconds between frames."""
    line_at = lambda place: 1 + data.count(b"\n", 0, place)
    head = _MOTION_HEAD.match(data, place)
    if head is None:
        there = data[place:].lstrip()[:40].decode("utf-8", "replace") or "the end of the file"
        raise _Broken(line_at(place), f"'Frames: 120' and 'Frame Time: 0.0333333' must follow, found {there!r}")
    count, seconds = (word.decode("utf-8", "replace") for word in head.groups())
    if not (len(count) <= 9 and count.isdecimal() and int(count)):
        raise _Broken(line_at(head.start(1)), f"Frames: must be a whole number above 0, found {count[:40]!r}")
    frame_time = finite_number(seconds)
    if frame_time is None or not FRAME_TIMES[0] <= frame_time <= FRAME_TIMES[1]:
        what = f"Frame Time: must be a positive number of seconds, at most {FRAME_TIMES[1]:g}, found {seconds[:40]!r}"
        raise _Broken(line_at(head.start(2)), f"{what}{_comma(seconds)}; 30 frames per second are 0.0333333")
    digits = len(seconds.partition(".")[2])
    if "e" not in seconds.lower() and 0.5 * 10.0**-digits > 1e-3 * frame_time:
        usual = [1 / rate for rate in USUAL_RATES if round(1 / rate, digits) == round(frame_time, digits)]
        frame_time = min(usual, key=lambda time: abs(time - frame_time), default=frame_time)
    labels = {column: f"{channel} of {joint.name}" for joint in joints for channel, column in joint.channels.items()}
    rows, shape = data[head.end() :], (int(count), len(labels))
    with contextlib.suppress(ValueError):  # UnicodeDecodeError is one, too
        if rows.strip():
            values = np.loadtxt(io.BytesIO(rows), dtype=np.float64, comments=None, ndmin=2, encoding="ascii")
            if values.shape == shape and (np.abs(values) <= LARGEST_NUMBER).all():
                return values, frame_time
    # numpy's reader is fast, but wants a frame a line and no note after them, and its messages know no BVH.
    values, broken, frame = [], None, 0
    for line, row in enumerate(rows.split(b"\n"), start=line_at(head.end())):
        words = row.decode("utf-8", "replace").split()
        numbers = [finite_number(word) for word in words]
        if not words or (len(values) >= np.prod(shape) and numbers[0] is None):
            continue
        values += numbers
        if broken is None and None in numbers[: len(labels) + 1]:
            column = numbers.index(None)
            place = f"number {column + 1} of frame {frame}, {labels.get(column, 'beyond the last channel')}"
            how = f"is not a finite number of at most {LARGEST_NUMBER:g}{_comma(words[column])}"
            broken = line, f"{words[column][:40]!r} ({place}) {how}; mend it or export again"
        elif broken is None and len(words) != len(labels):
            how = "cut off" if len(words) < len(labels) else "too long"
            what = f"frame {frame} has {len(words)} numbers where the HIERARCHY has {len(labels)} channels"
            broken = line, f"{what}: the row is {how}; export the file again"
        frame += 1
    if len(values) == np.prod(shape) and None not in values:
        return np.reshape(np.array(values, np.float64), shape), frame_time
    what = f"Frames: says {count}, but {frame} rows of numbers follow"
    raise _Broken(*(broken or (line_at(head.start(1)), f"{what}; export the file again or correct the count")))


def _build_motion(joints, end_sites, values, frame_time, name) -> Motion:
    """Turn channel values into root positions, bones and matrices."""
    frames, count = len(values), len(joints)
    turns = [joint.columns("rotation") for joint in joints]
    rotations = np.broadcast_to(np.eye(3), (frames, count, 3, 3)).copy()
    # All joints of one rotation order at once.
    for order in {"".join(columns) for columns in turns} - {""}:
        members = [joint for joint, columns in enumerate(turns) if "".join(columns) == order]
        rotations[:, members] = matrix_from_euler(order, values[:, [list(turns[joint].values()) for joint in members]])

    offsets = np.array([joint.offset for joint in joints])
    moves, places = [joint.columns("position") for joint in joints], np.tile(offsets, (frames, 1, 1))
    for joint, columns in enumerate(moves):
        for axis, column in columns.items():
            places[:, joint, "XYZ".index(axis)] = _METRES * values[:, column]
    parents = [joint.parent for joint in joints]
    root, root_position = 0, places[:, 0]
    if count > 1 and moves[0] and moves[1] and parents.count(0) == 1:
        # The first joint only carries the second, which becomes the root.
        root = 1
        root_position = root_position + np.einsum("tab,tb->ta", rotations[:, 0], places[:, 1])
        rotations[:, 1] = rotations[:, 0] @ rotations[:, 1]

    offsets[root], wandered = 0.0, 0.0
    for joint in range(root + 1, count):
        if not values[:, list(moves[joint].values())].any():  # nothing is said beside OFFSET
            continue
        offsets[joint] = places[:, joint].mean(axis=0)
        error = np.abs(places[:, joint] - offsets[joint]).max(axis=1)
        wandered = max(wandered, error.max())
        if error.max() > RIGID_TOLERANCE:
            what = f"position channels of {joints[joint].name!r} move by {1000 * error.max():.1f} mm"
            where = f"in frame {error.argmax()}; bones must be rigid: bake the motion to rotations before exporting"
            raise _Broken(joints[joint].line, f"{what} {where}")
    if wandered > TOLD_TOLERANCE:
        log.warning("%s: bones change by up to %.1f mm; each is as long as on average", name, 1000 * wandered)
    tips = [(joint - root, offset) for joint, offset in end_sites if joint >= root]
    names, parents = [joint.name for joint in joints[root:]], [max(parent - root, -1) for parent in parents[root:]]
    skeleton = Skeleton(names, parents, offsets[root:], tips)
    return Motion(skeleton, root_position, rotations[:, root:], fps=1.0 / frame_time, name=name)


def write_bvh(path, motion: Motion, *, overwrite: bool = False) -> Path:
    """Write a motion as a BVH file (see `format_bvh`); return its path, whose missing folders are made.

    Raises:
      ValueError: if the file exists and `overwrite` is false.
    """
    return write_whole(path, format_bvh(motion), overwrite=overwrite)


def format_bvh(motion: Motion) -> str:
    """Return a motion as BVH text in centimetres: six channels at the root, R = Rz Rx Ry at every joint.

    Joints are written depth first, as BVH requires; line ends are LF, numbers have six decimals. Read again, joint
    positions agree to 1e-6 m. ValueError for rotations that stretch or mirror.
    """
    rotations, skeleton, depth_first = motion.needed_rotations("a BVH file"), motion.skeleton, []
    turned = np.abs(rotations @ np.swapaxes(rotations, -1, -2) - np.eye(3)).max(axis=(-2, -1)) < 1e-3
    if wrong := np.argwhere(~turned | (np.linalg.det(rotations) < 0.0)).tolist():
        raise ValueError(f"{motion.name}: frame {wrong[0][0]}, joint {wrong[0][1]}: not a rotation matrix")
    offset_line = lambda offset: "OFFSET " + " ".join(f"{100.0 * float(value):.6f}" for value in offset)

    def block(joint: int, kind: str) -> list[str]:
        depth_first.append(joint)
        channels = "Zrotation Xrotation Yrotation"
        channels = f"3 {channels}" if joint else f"6 Xposition Yposition Zposition {channels}"
        inner = [offset_line(skeleton.offsets[joint]), f"CHANNELS {channels}"]
        for child in skeleton.children[joint]:
            inner += block(child, "JOINT")
        tips = [offset for owner, offset in skeleton.end_sites if owner == joint]
        # Many tools refuse a limb without an End Site, so a bare leaf gets one of length zero.
        for tip in tips or ([] if skeleton.children[joint] else [(0.0, 0.0, 0.0)]):
            inner += ["End Site", "{", f"\t{offset_line(tip)}", "}"]
        return [f"{kind} {skeleton.names[joint]}", "{", *(f"\t{line}" for line in inner), "}"]

    lines = ["HIERARCHY", *block(0, "ROOT"), "MOTION"]
    lines += [f"Frames: {motion.num_frames}", f"Frame Time: {1.0 / motion.fps:.10f}"]
    with warnings.catch_warnings():
        # At gimbal lock any of the equal answers will do: the matrix is the same.
        warnings.filterwarnings("ignore", message="Gimbal lock")
        degrees = euler_from_matrix("ZXY", rotations[:, depth_first])
    root = 100.0 * np.asarray(motion.root_position, dtype=np.float64)
    rows = np.concatenate([root, degrees.reshape(motion.num_frames, -1)], axis=1)
    row_format = " ".join(["%.6f"] * rows.shape[1])
    return "\n".join([*lines, *(row_format % tuple(row) for row in rows.tolist())]) + "\n"
