"""BVH motion files: a strict reader and a writer.

A BVH file is text: a HIERARCHY of joints with bone offsets and named channels, then a MOTION block
with one row of numbers per frame. The reader takes any hierarchy and any channel order, and says
file, line and remedy when a file is broken. Files hold centimetres and degrees; a `Motion` holds
metres and rotation matrices.
"""

import collections
import io
import re
import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from f3amd_lib.ground.arrays import check_positive
from f3amd_lib.ground.files import write_whole
from f3amd_lib.motion.rotations import euler_from_matrix, matrix_from_euler
from f3amd_lib.motion.skeleton import Motion, Skeleton

RIGID_TOLERANCE = 1e-3
"""Metres by which a joint's position channels may wander before its bone counts as not rigid."""

_MOTION_LINE = re.compile(rb"^[ \t]*MOTION[ \t]*\r?$", re.IGNORECASE | re.MULTILINE)
_FRAMES_LINE = re.compile(r"frames\s*:\s*(.*)", re.IGNORECASE)
_FRAME_TIME_LINE = re.compile(r"frame\s*time\s*:\s*(.*)", re.IGNORECASE)
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?")
_CHANNELS = {f"{axis}{kind}".lower(): (axis, kind) for axis in "XYZ" for kind in ("position", "rotation")}
LARGEST_NUMBER = 1e8
"""Largest number of a file, either way: 1,000 km in centimetres, and as many degrees."""

FRAME_TIMES = (1e-5, 1.0)
"""Shortest and longest time between frames, seconds."""

_LONGEST_WORD = 200

_BRACES = "check that every '{' has its '}'"


class _Broken(Exception):
    """(line, what is wrong and what to do); `parse_bvh` adds the file's name."""


def read_bvh(path) -> Motion:
    """Read a BVH file in centimetres.

    Args:
      path: of the file; its text from elsewhere, or in other units, is for `parse_bvh`.

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


def parse_bvh(text: str | bytes, name: str, scale: float = 0.01) -> Motion:
    """Turn the text of a BVH file into a `Motion`.

    How channels are read:
      * Position channels replace OFFSET (they are not added to it). Below the root they must be
        constant to `RIGID_TOLERANCE`; their mean then is the bone.
      * R is the product of the rotations in the order in which the channels are listed.
      * A first joint with position channels whose only child has position channels too (Bandai's
        `joint_Root` above `Hips`) only carries its child. It is folded into the child, which
        becomes the root; joint positions stay what they were.
      * Joints come in the order of the file, parents first.

    Args:
      text: content of the file; line ends may be LF, CRLF or CR, blanks may be tabs.
      name: what messages and the motion call it.
      scale: metres per unit of length in the file.

    Returns:
      A `Motion` in float64, metres, at the file's own frame rate.

    Raises:
      ValueError: "name, line n: what is wrong; what to do" for anything that is not a sound BVH.
    """
    check_positive("scale", scale)
    try:
        data = _clean(text, name)
        motion = _MOTION_LINE.search(data)
        if motion is None:
            raise _Broken(data.count(b"\n") + 1, "the file ends without a MOTION line; export or copy it again")
        joints, end_sites = _parse_hierarchy(data[: motion.start()])
        line = data.count(b"\n", 0, motion.start()) + 1
        num_frames, frame_time, rows, line = _parse_motion_head(data[motion.end() :], line)
        values = _parse_rows(rows, line, joints, num_frames)
        return _build_motion(joints, end_sites, values, frame_time, name, scale, rows, line)
    except _Broken as error:
        line, message = error.args
        raise ValueError(f"{name}, line {line}: {message}") from None


def write_bvh(path, motion: Motion, *, scale: float = 100.0, order: str = "ZXY", overwrite: bool = False) -> Path:
    """Write a motion as a BVH file; see `format_bvh` for what is in it.

    Args:
      path: where to; missing folders are made.
      motion: what to write.
      scale: file units per metre (centimetres: 100).
      order: rotation order of all joints, such as "ZXY".
      overwrite: an existing file is replaced only if this is true.

    Returns:
      The path.

    Raises:
      ValueError: if the file exists and `overwrite` is false, or for a bad order.
    """
    return write_whole(path, format_bvh(motion, scale=scale, order=order), overwrite=overwrite)


def format_bvh(motion: Motion, *, scale: float = 100.0, order: str = "ZXY") -> str:
    """Return a motion as BVH text: six channels at the root, three at the other joints.

    Args:
      motion: what to write; joints are written depth first, as BVH asks.
      scale: file units per metre (centimetres: 100).
      order: rotation order of all joints, such as "ZXY" for R = Rz Rx Ry.

    Returns:
      The text, LF line ends, six decimals; read again, joint positions agree to 1e-6 m.

    Raises:
      ValueError: if the order is not a permutation of XYZ, or the scale is not above 0.
    """
    check_positive("scale", scale)
    if sorted(order) != ["X", "Y", "Z"]:
        raise ValueError(f"rotation order {order!r} must name X, Y and Z once each, such as 'ZXY'")
    rotations = motion.needed_rotations("a BVH file")
    skeleton, lines, depth_first = motion.skeleton, ["HIERARCHY"], []
    children = skeleton.children
    offset_line = lambda offset: "OFFSET " + " ".join(f"{scale * float(value):.6f}" for value in offset)
    steps = [(0, 0, False)]  # a stack, not a recursion: chains of thousands of joints can be written
    while steps:
        joint, depth, closes = steps.pop()
        outer, inner = "\t" * depth, "\t" * (depth + 1)
        if closes:
            tips = [offset for owner, offset in skeleton.end_sites if owner == joint]
            # Many tools refuse a limb without an End Site, so a bare leaf gets one of length zero.
            for tip in tips or ([] if children[joint] else [(0.0, 0.0, 0.0)]):
                lines += [f"{inner}End Site", f"{inner}{{", f"{inner}\t{offset_line(tip)}", f"{inner}}}"]
            lines.append(f"{outer}}}")
            continue
        depth_first.append(joint)
        channels = [f"{axis}position" for axis in "XYZ" if depth == 0] + [f"{axis}rotation" for axis in order]
        lines += [f"{outer}{'JOINT' if depth else 'ROOT'} {skeleton.names[joint]}", f"{outer}{{"]
        lines += [inner + offset_line(skeleton.offsets[joint]), f"{inner}CHANNELS {len(channels)} {' '.join(channels)}"]
        steps += [(joint, depth, True), *((child, depth + 1, False) for child in reversed(children[joint]))]
    lines += ["MOTION", f"Frames: {motion.num_frames}", f"Frame Time: {1.0 / motion.fps:.10f}"]
    with warnings.catch_warnings():
        # At gimbal lock any of the equal answers will do: the matrix is the same.
        warnings.filterwarnings("ignore", message="Gimbal lock")
        degrees = euler_from_matrix(order, rotations[:, depth_first])
    root = scale * np.asarray(motion.root_position, dtype=np.float64)
    rows = np.concatenate([root, degrees.reshape(motion.num_frames, -1)], axis=1)
    row_format = " ".join(["%.6f"] * rows.shape[1])
    lines += [row_format % tuple(row) for row in rows.tolist()]
    return "\n".join(lines) + "\n"


@dataclass
class _Joint:
    """What the HIERARCHY says of one joint."""

    name: str
    line: int
    parent: int
    offset: tuple[float, ...] | None = None
    channels: list[tuple[str, str]] | None = None
    first_column: int = 0

    def columns(self, wanted: str) -> dict[str, int]:
        """Return axis -> column of the MOTION block, for "position" or "rotation", as listed."""
        return {axis: self.first_column + k for k, (axis, kind) in enumerate(self.channels) if kind == wanted}


def _clean(text: str | bytes, name: str) -> bytes:
    """Return the file as bytes with LF or CRLF line ends, or say why it is no text."""
    if isinstance(text, str):
        data = text.encode("utf-8", "surrogatepass")  # half a character is found, with its line, by the reader
    elif isinstance(text, bytes | bytearray | memoryview):
        data = bytes(text)
    else:
        raise ValueError(f"{name}: BVH content must be str or bytes, not {type(text).__name__}")
    if data.startswith((b"\xff\xfe", b"\xfe\xff")):
        raise _Broken(1, "the file is UTF-16 text; save it as UTF-8 or ASCII")
    data = data.removeprefix(b"\xef\xbb\xbf")
    if not data.strip():
        raise _Broken(1, "the file is empty; export or copy it again")
    if b"\x00" in data:
        line = data.count(b"\n", 0, data.index(b"\x00")) + 1
        raise _Broken(line, "holds zero bytes, so it is not text; is it really a BVH file?")
    return data if b"\n" in data else data.replace(b"\r", b"\n")


def finite_number(word: str, largest: float = LARGEST_NUMBER) -> float | None:
    """Return a word as a float, or None if it is no decimal number of at most the largest, either way."""
    value = float(word) if len(word) <= _LONGEST_WORD and _NUMBER.fullmatch(word) else np.nan
    return value if abs(value) <= largest else None


def _count(word: str) -> int | None:
    """Return a word as a whole number of nine digits at most, or None."""
    return int(word) if len(word) <= 9 and word.isdecimal() else None


class _Tokens(collections.deque):
    """(word, line) of the HIERARCHY; braces stand alone, and the word after the last one is ""."""

    def __init__(self, data: bytes):
        super().__init__()
        for line, raw in enumerate(data.split(b"\n"), start=1):
            try:
                words = raw.decode("utf-8")
            except UnicodeDecodeError:
                raise _Broken(line, "holds bytes that are not UTF-8 text; is it a BVH file?") from None
            words = words.replace("{", " { ").replace("}", " } ").split()
            if max(map(len, words), default=0) > _LONGEST_WORD:
                what = f"holds a word of {max(map(len, words))} characters"
                raise _Broken(line, f"{what}, longer than {_LONGEST_WORD}; is it a BVH file?")
            self.extend((word, line) for word in words)
        self.append(("", line))

    def take(self, expected: str) -> tuple[str, int]:
        word, line = self[0]
        if not word:
            raise _Broken(line, f"expected {expected}, but MOTION starts here; {_BRACES}")
        return self.popleft()

    def rest_of_line(self, line: int) -> str:
        """Take the words left on a line, up to a brace: a joint's name may hold blanks."""
        words = []
        while self[0][1] == line and self[0][0] not in ("{", "}", ""):
            words.append(self.take("a name")[0])
        return " ".join(words)

    def expect(self, wanted: str, where: str):
        word, line = self.take(f"{wanted!r} {where}")
        if word.upper() != wanted.upper():
            raise _Broken(line, f"expected {wanted!r} {where}, found {word!r}")

    def offset(self) -> tuple[float, ...]:
        """Take the three numbers after an OFFSET."""
        values = []
        for _ in range(3):
            word, line = self.take("a number of OFFSET")
            values.append(finite_number(word))
            if values[-1] is None:
                raise _Broken(line, f"OFFSET needs 3 finite numbers, found {word!r} among them")
        return tuple(values)


def _parse_hierarchy(data: bytes):
    """Return the joints in file order and the End Sites as (joint, offset) in file units."""
    tokens = _Tokens(data)
    word, line = tokens[0]
    if word.upper() != "HIERARCHY":
        raise _Broken(line, f"a BVH file starts with HIERARCHY, this one with {word!r}")
    tokens.take("HIERARCHY")
    joints: list[_Joint] = []
    end_sites: list[tuple[int, tuple[float, ...]]] = []
    open_blocks: list[int] = []  # joints whose braces are open, innermost last
    column = 0
    while tokens[0][0]:
        word, line = tokens.take("a keyword")
        keyword = word.upper()
        current = joints[open_blocks[-1]] if open_blocks else None
        if keyword in ("ROOT", "JOINT"):
            if keyword == "ROOT" and joints:
                first = f"the first is {joints[0].name!r} in line {joints[0].line}"
                raise _Broken(line, f"a second ROOT ({first}); a file holds one character: split it")
            if keyword == "JOINT" and current is None:
                raise _Broken(line, f"JOINT stands outside of the ROOT's braces; {_BRACES}")
            joint = _Joint(tokens.rest_of_line(line), line, open_blocks[-1] if open_blocks else -1)
            if not joint.name:
                raise _Broken(line, f"{keyword} needs a name on the same line")
            for other in joints:
                if other.name == joint.name:
                    raise _Broken(line, f"joint name {joint.name!r} is taken (line {other.line}); rename one")
            tokens.expect("{", f"after {keyword} {joint.name}")
            open_blocks.append(len(joints))
            joints.append(joint)
        elif current is None:
            why = f"the ROOT's braces are closed; {_BRACES}" if joints else "expected ROOT"
            raise _Broken(line, f"unexpected {word!r}: {why}" if keyword != "}" else f"a '}}' too many; {_BRACES}")
        elif keyword == "}":
            for what, value in (("OFFSET", current.offset), ("CHANNELS", current.channels)):
                if value is None:
                    raise _Broken(line, f"joint {current.name!r} ends without {what}; add the line")
            open_blocks.pop()
        elif keyword in ("OFFSET", "CHANNELS"):
            if getattr(current, keyword.lower()) is not None:
                raise _Broken(line, f"joint {current.name!r} has a second {keyword}; remove one")
            if keyword == "OFFSET":
                current.offset = tokens.offset()
            else:
                current.channels, current.first_column = _parse_channels(tokens, line, current.name), column
                column += len(current.channels)
        elif keyword == "END":
            tokens.expect("Site", "after End")
            # A few exporters name their tips; the name carries nothing.
            tokens.rest_of_line(line)
            tokens.expect("{", "after End Site")
            tokens.expect("OFFSET", "inside End Site")
            end_sites.append((open_blocks[-1], tokens.offset()))
            tokens.expect("}", "after the OFFSET of End Site")
        else:
            raise _Broken(line, f"unexpected {word!r}; known here are OFFSET, CHANNELS, JOINT, End Site and '}}'")
    if open_blocks:
        unclosed = joints[open_blocks[-1]]
        what = f"MOTION starts, but the '{{' of {unclosed.name!r} (line {unclosed.line}) is still open; {_BRACES}"
        raise _Broken(tokens[0][1], what)
    if not joints:
        raise _Broken(tokens[0][1], "MOTION starts, but there is no ROOT")
    if column == 0:
        raise _Broken(tokens[0][1], "no joint has a channel, so there is no motion to read")
    return joints, end_sites


def _parse_channels(tokens: _Tokens, line: int, joint: str) -> list[tuple[str, str]]:
    """Return (axis, kind) of a CHANNELS line, its keyword already taken."""
    count, _ = tokens.take("the number of channels")
    if _count(count) is None:
        raise _Broken(line, f"CHANNELS needs a count first, found {count!r}")
    channels = []
    for _ in range(_count(count)):
        label, label_line = tokens.take(f"channel names of {joint!r}")
        channel = _CHANNELS.get(label.lower())
        if channel is None:
            what = f"unknown channel {label!r} of joint {joint!r}, which says it has {count}"
            raise _Broken(label_line, f"{what}; channels are X, Y or Z with position or rotation, such as Xposition")
        if channel in channels:
            raise _Broken(label_line, f"joint {joint!r} has the channel {label!r} twice; remove one")
        channels.append(channel)
    extra, extra_line = tokens[0]
    if extra.lower() in _CHANNELS:
        raise _Broken(extra_line, f"joint {joint!r} says it has {count} channels, but lists {extra!r} too")
    return channels


def _parse_motion_head(data: bytes, line: int):
    """Read "Frames:" (with its line) and "Frame Time:"; return both, the rows' bytes and their first line."""
    rest = data.partition(b"\n")[2]
    answers = []
    for pattern, example in ((_FRAMES_LINE, "Frames: 120"), (_FRAME_TIME_LINE, "Frame Time: 0.0333333")):
        words = ""
        while rest and not words:
            head, _, rest = rest.partition(b"\n")
            words, line = head.decode("utf-8", errors="replace").strip(), line + 1
        match = pattern.fullmatch(words)
        if match is None:
            there = f"found {words[:40]!r}" if words else "the file ends"
            raise _Broken(line, f"expected a line like {example!r} here, {there}")
        answers.append((match.group(1).strip(), line))
    (count, count_line), (seconds, _) = answers
    if not _count(count):
        raise _Broken(count_line, f"Frames: must be a whole number above 0, found {count[:40]!r}")
    frame_time = finite_number(seconds)
    if frame_time is None or not FRAME_TIMES[0] <= frame_time <= FRAME_TIMES[1]:
        what = f"Frame Time: must be a positive number of seconds, at most {FRAME_TIMES[1]:g}, found {seconds[:40]!r}"
        raise _Broken(line, f"{what}; 30 frames per second are 0.0333333")
    return (_count(count), count_line), frame_time, rest, line + 1


def _parse_rows(rows: bytes, first_line: int, joints, num_frames) -> np.ndarray:
    """Return the MOTION block, [frames, channels], in one pass over all of it.

    numpy's text reader is fast but its messages know no BVH; so when anything is amiss, a second,
    slow pass finds out where and what.
    """
    count, count_line = num_frames
    columns = sum(len(joint.channels) for joint in joints)
    values = np.empty((0, columns))
    first = rows.lstrip().partition(b"\n")[0].split(None, columns)
    if len(first) == columns:  # else there is no need to read the rest
        try:
            values = np.loadtxt(io.BytesIO(rows), dtype=np.float64, comments=None, ndmin=2, encoding="ascii")
        except ValueError:  # UnicodeDecodeError is one, too
            pass
    if values.shape == (count, columns) and (np.abs(values) <= LARGEST_NUMBER).all():
        return values
    _explain_rows(rows, first_line, joints, columns)
    what = f"Frames: says {count}, but {len(values)} rows of numbers follow"
    raise _Broken(count_line, f"{what}; export the file again or mend the count")


def _rows_with_lines(rows: bytes, first_line: int):
    """Yield (line number, words) of the rows that are not blank."""
    for line, raw in enumerate(rows.split(b"\n"), start=first_line):
        words = raw.decode("utf-8", errors="replace").split()
        if words:
            yield line, words


def _explain_rows(rows: bytes, first_line: int, joints, columns: int):
    """Raise for the first row that is not `columns` finite numbers; return if there is none."""
    labels = [f"{axis}{kind} of {joint.name}" for joint in joints for axis, kind in joint.channels]
    for frame, (line, words) in enumerate(_rows_with_lines(rows, first_line)):
        for column, word in enumerate(words[: columns + 1]):
            if finite_number(word) is None:
                what = labels[column] if column < columns else "beyond the last channel"
                place = f"number {column + 1} of frame {frame}, {what}"
                how = f"is not a finite number of at most {LARGEST_NUMBER:g}"
                raise _Broken(line, f"{word[:40]!r} ({place}) {how}; mend it or export again")
        if len(words) != columns:
            how = "cut off" if len(words) < columns else "too long"
            what = f"frame {frame} has {len(words)} numbers where the HIERARCHY has {columns} channels"
            raise _Broken(line, f"{what}: the row is {how}; export the file again")


def _build_motion(joints, end_sites, values, frame_time, name, scale, rows, first_line) -> Motion:
    """Turn channel values into root positions, bones and matrices."""
    frames, count = len(values), len(joints)
    turns = [joint.columns("rotation") for joint in joints]
    rotations = np.broadcast_to(np.eye(3), (frames, count, 3, 3)).copy()
    # All joints of one rotation order at once.
    for order in {"".join(columns) for columns in turns} - {""}:
        members = [joint for joint, columns in enumerate(turns) if "".join(columns) == order]
        rotations[:, members] = matrix_from_euler(order, values[:, [list(turns[joint].values()) for joint in members]])

    def channel_positions(joint):
        position = np.tile(scale * np.array(joints[joint].offset), (frames, 1))
        for axis, column in moves[joint].items():
            position[:, "XYZ".index(axis)] = scale * values[:, column]
        return position

    moves = [joint.columns("position") for joint in joints]
    parents = [joint.parent for joint in joints]
    root, root_position = 0, channel_positions(0)
    if count > 1 and moves[0] and moves[1] and parents.count(0) == 1:
        # The first joint only carries the second, which becomes the root.
        root = 1
        root_position = root_position + np.einsum("tab,tb->ta", rotations[:, 0], channel_positions(1))
        rotations[:, 1] = rotations[:, 0] @ rotations[:, 1]

    offsets = np.zeros((count, 3))
    for joint in range(root + 1, count):
        if not moves[joint]:
            offsets[joint] = scale * np.array(joints[joint].offset)
            continue
        position = channel_positions(joint)
        offsets[joint] = position.mean(axis=0)
        error = np.abs(position - offsets[joint]).max(axis=1)
        if error.max() > RIGID_TOLERANCE:
            frame = int(error.argmax())
            line = [line for line, _ in _rows_with_lines(rows, first_line)][frame]
            what = f"position channels of {joints[joint].name!r} move by {1000 * error.max():.1f} mm in frame {frame}"
            raise _Broken(line, f"{what}; bones must be rigid: bake the motion to rotations before exporting")
    tips = [(joint - root, [scale * value for value in offset]) for joint, offset in end_sites if joint >= root]
    names, parents = [joint.name for joint in joints[root:]], [max(parent - root, -1) for parent in parents[root:]]
    skeleton = Skeleton(names, parents, offsets[root:], tips)
    return Motion(skeleton, root_position, rotations[:, root:], fps=1.0 / frame_time, name=name)
