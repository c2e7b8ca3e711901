"""BVH motion files: a strict reader and a writer.

A BVH file is text: a HIERARCHY of joints with bone offsets and named channels, then a MOTION block
with one row of numbers per frame. The reader takes any hierarchy and any channel order, and says
file, line and remedy when a file is broken. Files hold centimetres and degrees; a `Motion` holds
metres and rotation matrices.
"""

from __future__ import annotations

import io
import re
import warnings
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from f3amd_lib.ground.files import whole_file
from f3amd_lib.motion.rotations import euler_from_matrix, matrix_from_euler
from f3amd_lib.motion.skeleton import Motion, Skeleton

RIGID_TOLERANCE = 1e-3
"""Metres by which a joint's position channels may wander before its bone counts as not rigid."""

_MOTION_LINE = re.compile(rb"^[ \t]*MOTION[ \t]*\r?$", re.IGNORECASE | re.MULTILINE)
_FRAMES_LINE = re.compile(r"frames\s*:\s*(.*)", re.IGNORECASE)
_FRAME_TIME_LINE = re.compile(r"frame\s*time\s*:\s*(.*)", re.IGNORECASE)
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?")
_CHANNELS = {f"{axis}{kind}".lower(): (axis, kind) for axis in "XYZ" for kind in ("position", "rotation")}


def read_bvh(path_or_file=None, *, text=None, name=None, scale: float = 0.01) -> Motion:
    """Read a BVH file.

    Args:
      path_or_file: a path, or an open file in binary or text mode; not needed with `text`.
      text: the file's content (str or bytes), where it is at hand already.
      name: what messages and the motion call it; by default the file's name.
      scale: metres per unit of length in the file (centimetres: 0.01).

    Returns:
      A `Motion` at the file's own frame rate (see `parse_bvh`).

    Raises:
      ValueError: naming the file, the line and what to mend; also if the file cannot be read.
    """
    if text is not None:
        return parse_bvh(text, name or "BVH text", scale)
    if hasattr(path_or_file, "read"):
        label = name or str(getattr(path_or_file, "name", "BVH file"))
        return parse_bvh(path_or_file.read(), label, scale)
    if path_or_file is None:
        raise ValueError("read_bvh needs a path, an open file, or text=...")
    path = Path(path_or_file)
    try:
        content = path.read_bytes()
    except OSError as error:
        raise ValueError(f"{path}: cannot be read ({error.strerror}); check the path") from error
    return parse_bvh(content, name or str(path), scale)


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
    data = _clean(text, name)
    found = _MOTION_LINE.search(data)
    if found is None:
        _fail(
            name,
            data.count(b"\n") + 1,
            "the file ends without a MOTION line; it is cut off or not a BVH file: export or copy it again",
        )
    joints, end_sites = _parse_hierarchy(data[: found.start()], name)
    first_line = data.count(b"\n", 0, found.start()) + 1
    num_frames, frame_time, rows, rows_line = _parse_motion_head(data[found.end() :], name, first_line)
    values = _parse_rows(rows, name, rows_line, joints, num_frames)
    return _build_motion(joints, end_sites, values, frame_time, name, scale, rows, rows_line)


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
    path = Path(path)
    with whole_file(path, overwrite=overwrite) as temporary:
        text = format_bvh(motion, scale=scale, order=order)
        temporary.write_text(text, encoding="utf-8", newline="\n")
    return path


def format_bvh(motion: Motion, *, scale: float = 100.0, order: str = "ZXY") -> str:
    """Return a motion as BVH text: six channels at the root, three at the other joints.

    Args:
      motion: what to write; joints are written depth first, as BVH asks.
      scale: file units per metre (centimetres: 100).
      order: rotation order of all joints, such as "ZXY" for R = Rz Rx Ry.

    Returns:
      The text, LF line ends, six decimals; read again, joint positions agree to 1e-6 m.

    Raises:
      ValueError: if the order is not a permutation of XYZ.
    """
    if sorted(order) != ["X", "Y", "Z"]:
        raise ValueError(f"rotation order {order!r} must name X, Y and Z once each, such as 'ZXY'")
    skeleton = motion.skeleton
    rotation_channels = " ".join(f"{axis}rotation" for axis in order)
    children = [[] for _ in skeleton.names]
    for joint, parent in enumerate(skeleton.parents):
        if parent >= 0:
            children[parent].append(joint)
    tips = [[] for _ in skeleton.names]
    for joint, offset in skeleton.end_sites:
        tips[joint].append(offset)
    lines, depth_first = ["HIERARCHY"], []

    def offset_line(indent, offset):
        numbers = " ".join(f"{scale * float(value):.6f}" for value in offset)
        lines.append(f"{indent}OFFSET {numbers}")

    def joint_lines(joint, depth):
        depth_first.append(joint)
        outer, inner = "\t" * depth, "\t" * (depth + 1)
        lines.append(f"{outer}{'JOINT' if depth else 'ROOT'} {skeleton.names[joint]}")
        lines.append(f"{outer}{{")
        offset_line(inner, skeleton.offsets[joint])
        if depth:
            lines.append(f"{inner}CHANNELS 3 {rotation_channels}")
        else:
            lines.append(f"{inner}CHANNELS 6 Xposition Yposition Zposition {rotation_channels}")
        for child in children[joint]:
            joint_lines(child, depth + 1)
        # Many tools refuse a limb without an End Site, so a bare leaf gets one of length zero.
        for tip in tips[joint] or ([] if children[joint] else [(0.0, 0.0, 0.0)]):
            lines.extend([f"{inner}End Site", f"{inner}{{"])
            offset_line(inner + "\t", tip)
            lines.append(f"{inner}}}")
        lines.append(f"{outer}}}")

    joint_lines(0, 0)
    lines += ["MOTION", f"Frames: {motion.num_frames}", f"Frame Time: {1.0 / motion.fps:.10f}"]
    with warnings.catch_warnings():
        # At gimbal lock any of the equal answers will do: the matrix is the same.
        warnings.filterwarnings("ignore", message="Gimbal lock")
        degrees = euler_from_matrix(order, motion.rotations[:, depth_first])
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
    position: dict[str, int] = field(default_factory=dict)  # axis -> column of the MOTION block

    @property
    def rotation_order(self) -> str:
        return "".join(axis for axis, kind in self.channels if kind == "rotation")

    @property
    def rotation_columns(self) -> list[int]:
        return [self.first_column + k for k, (_, kind) in enumerate(self.channels) if kind == "rotation"]


def _fail(name: str, line: int, message: str):
    raise ValueError(f"{name}, line {line}: {message}")


def _clean(text: str | bytes, name: str) -> bytes:
    """Return the file as bytes with LF or CRLF line ends, or say why it is no text."""
    if isinstance(text, str):
        data = text.encode("utf-8")
    elif isinstance(text, bytes | bytearray | memoryview):
        data = bytes(text)
    else:
        raise ValueError(f"{name}: BVH content must be str or bytes, not {type(text).__name__}")
    if data.startswith((b"\xff\xfe", b"\xfe\xff")):
        _fail(name, 1, "the file is UTF-16 text; save it as UTF-8 or ASCII")
    data = data.removeprefix(b"\xef\xbb\xbf")
    if not data.strip():
        _fail(name, 1, "the file is empty; export or copy it again")
    if b"\x00" in data:
        line = data.count(b"\n", 0, data.index(b"\x00")) + 1
        _fail(name, line, "holds zero bytes, so it is not text; is it really a BVH file?")
    if b"\n" not in data:
        data = data.replace(b"\r", b"\n")
    return data


def _finite_number(token: str) -> float | None:
    """Return a token as a float, or None if it is no finite decimal number."""
    if _NUMBER.fullmatch(token) is None:
        return None
    value = float(token)
    return value if np.isfinite(value) else None


class _Tokens:
    """Words of the HIERARCHY with their line numbers; braces stand alone."""

    def __init__(self, data: bytes, name: str):
        self.name = name
        self.items: list[tuple[str, int]] = []
        lines = data.split(b"\n")
        self.last_line = len(lines)
        for line, raw in enumerate(lines, start=1):
            try:
                words = raw.decode("utf-8")
            except UnicodeDecodeError:
                _fail(name, line, "holds bytes that are not UTF-8 text; is it a BVH file?")
            for word in words.replace("{", " { ").replace("}", " } ").split():
                self.items.append((word, line))
        self.position = 0

    def peek(self) -> tuple[str, int]:
        if self.position < len(self.items):
            return self.items[self.position]
        return "", self.last_line

    def take(self, expected: str) -> tuple[str, int]:
        word, line = self.peek()
        if not word:
            _fail(self.name, line, f"expected {expected}, but MOTION starts here; {_BRACES}")
        self.position += 1
        return word, line

    def rest_of_line(self, line: int) -> str:
        """Take the words left on a line, up to a brace: a joint's name may hold blanks."""
        words = []
        while self.peek()[1] == line and self.peek()[0] not in ("{", "}", ""):
            words.append(self.take("a name")[0])
        return " ".join(words)

    def expect(self, wanted: str, where: str):
        word, line = self.take(f"{wanted!r} {where}")
        if word.upper() != wanted.upper():
            _fail(self.name, line, f"expected {wanted!r} {where}, found {word!r}")

    def numbers(self, count: int, what: str) -> tuple[float, ...]:
        values = []
        for _ in range(count):
            word, line = self.take(f"a number of {what}")
            value = _finite_number(word)
            if value is None:
                _fail(self.name, line, f"{what} needs {count} finite numbers, found {word!r} among them")
            values.append(value)
        return tuple(values)


_BRACES = "check that every '{' has its '}'"


def _parse_hierarchy(data: bytes, name: str):
    """Return the joints in file order and the End Sites as (joint, offset) in file units."""
    tokens = _Tokens(data, name)
    word, line = tokens.peek()
    if word.upper() != "HIERARCHY":
        _fail(name, line, f"a BVH file starts with HIERARCHY, this one with {word!r}")
    tokens.take("HIERARCHY")
    joints: list[_Joint] = []
    end_sites: list[tuple[int, tuple[float, ...]]] = []
    lines_of: dict[str, int] = {}
    open_blocks: list[int] = []  # joints whose braces are open, innermost last
    column = 0
    while tokens.peek()[0]:
        word, line = tokens.take("a keyword")
        keyword = word.upper()
        current = joints[open_blocks[-1]] if open_blocks else None
        if keyword == "ROOT" and joints:
            _fail(
                name,
                line,
                f"a second ROOT (the first is {joints[0].name!r} in line {joints[0].line}); "
                "a file holds one character: split it",
            )
        elif keyword in ("ROOT", "JOINT"):
            if keyword == "JOINT" and current is None:
                _fail(name, line, f"JOINT stands outside of the ROOT's braces; {_BRACES}")
            joint_name = tokens.rest_of_line(line)
            if not joint_name:
                _fail(name, line, f"{keyword} needs a name on the same line")
            if joint_name in lines_of:
                _fail(
                    name,
                    line,
                    f"joint name {joint_name!r} is taken (line {lines_of[joint_name]}); rename one of the two",
                )
            lines_of[joint_name] = line
            tokens.expect("{", f"after {keyword} {joint_name}")
            parent = open_blocks[-1] if open_blocks else -1
            open_blocks.append(len(joints))
            joints.append(_Joint(joint_name, line, parent))
        elif keyword == "}":
            if current is None:
                _fail(name, line, f"a '}}' too many; {_BRACES}")
            for what, value in (("OFFSET", current.offset), ("CHANNELS", current.channels)):
                if value is None:
                    _fail(name, line, f"joint {current.name!r} ends without {what}; add the line")
            open_blocks.pop()
        elif current is None:
            _fail(
                name,
                line,
                f"unexpected {word!r}: " + (f"the ROOT's braces are closed; {_BRACES}" if joints else "expected ROOT"),
            )
        elif keyword == "OFFSET":
            if current.offset is not None:
                _fail(name, line, f"joint {current.name!r} has a second OFFSET; remove one")
            current.offset = tokens.numbers(3, "OFFSET")
        elif keyword == "CHANNELS":
            if current.channels is not None:
                _fail(name, line, f"joint {current.name!r} has a second CHANNELS; remove one")
            current.channels = _parse_channels(tokens, line, current.name)
            current.first_column = column
            current.position = {
                axis: column + k for k, (axis, kind) in enumerate(current.channels) if kind == "position"
            }
            column += len(current.channels)
        elif keyword == "END":
            tokens.expect("Site", "after End")
            # A few exporters name their tips; the name carries nothing.
            tokens.rest_of_line(line)
            tokens.expect("{", "after End Site")
            tokens.expect("OFFSET", "inside End Site")
            end_sites.append((open_blocks[-1], tokens.numbers(3, "OFFSET")))
            tokens.expect("}", "after the OFFSET of End Site")
        else:
            _fail(name, line, f"unexpected {word!r}; known here are OFFSET, CHANNELS, JOINT, End Site and '}}'")
    if open_blocks:
        unclosed = joints[open_blocks[-1]]
        _fail(
            name,
            tokens.last_line,
            f"MOTION starts, but the '{{' of {unclosed.name!r} (line {unclosed.line}) is still open; {_BRACES}",
        )
    if not joints:
        _fail(name, tokens.last_line, "MOTION starts, but there is no ROOT")
    if column == 0:
        _fail(name, tokens.last_line, "no joint has a channel, so there is no motion to read")
    return joints, end_sites


def _parse_channels(tokens: _Tokens, line: int, joint: str) -> list[tuple[str, str]]:
    """Return (axis, kind) of a CHANNELS line, its keyword already taken."""
    name = tokens.name
    word, _ = tokens.take("the number of channels")
    if not word.isdecimal():
        _fail(name, line, f"CHANNELS needs a count first, found {word!r}")
    channels = []
    for _ in range(int(word)):
        label, label_line = tokens.take(f"channel names of {joint!r}")
        channel = _CHANNELS.get(label.lower())
        if channel is None:
            _fail(
                name,
                label_line,
                f"unknown channel {label!r} of joint {joint!r}, which says it has {word}; channels "
                "are X, Y or Z with position or rotation, such as Xposition or Zrotation",
            )
        if channel in channels:
            _fail(name, label_line, f"joint {joint!r} has the channel {label!r} twice; remove one")
        channels.append(channel)
    extra, extra_line = tokens.peek()
    if extra.lower() in _CHANNELS:
        _fail(name, extra_line, f"joint {joint!r} says it has {word} channels, but lists {extra!r} too: mend the count")
    return channels


def _parse_motion_head(data: bytes, name: str, line: int):
    """Read "Frames:" and "Frame Time:"; return both, the rows' bytes and their first line."""
    position = data.find(b"\n") + 1 or len(data)
    values = []
    for pattern, label, example in (
        (_FRAMES_LINE, "Frames:", "Frames: 120"),
        (_FRAME_TIME_LINE, "Frame Time:", "Frame Time: 0.0333333"),
    ):
        words = ""
        while position < len(data) and not words:
            stop = data.find(b"\n", position) + 1 or len(data)
            words = data[position:stop].decode("utf-8", errors="replace").strip()
            position, line = stop, line + 1
        match = pattern.fullmatch(words)
        if match is None:
            found = f"found {words[:40]!r}" if words else "the file ends"
            _fail(name, line, f"expected a line like {example!r} here, {found}")
        value = match.group(1).strip()
        if label == "Frames:":
            if not value.isdecimal() or int(value) == 0:
                _fail(name, line, f"Frames: must be a whole number above 0, found {value!r}")
            values.append((int(value), line))
        else:
            frame_time = _finite_number(value)
            if frame_time is None or frame_time <= 0:
                _fail(
                    name,
                    line,
                    f"Frame Time: must be a positive number of seconds, found {value!r}; "
                    "30 frames per second are 0.0333333",
                )
            values.append(frame_time)
    (num_frames, frames_line), frame_time = values
    return (num_frames, frames_line), frame_time, data[position:], line + 1


def _parse_rows(rows: bytes, name: str, rows_line: int, joints, num_frames) -> np.ndarray:
    """Return the MOTION block, [frames, channels], in one pass over all of it.

    numpy's text reader is fast but its messages know no BVH; so when anything is amiss, a second,
    slow pass finds out where and what.
    """
    count, frames_line = num_frames
    columns = sum(len(joint.channels) for joint in joints)
    values = None
    if rows.strip():
        try:
            values = np.loadtxt(io.BytesIO(rows), dtype=np.float64, comments=None, ndmin=2, encoding="ascii")
        except ValueError:  # UnicodeDecodeError is one, too
            values = None
    if values is not None and values.shape == (count, columns) and np.isfinite(values).all():
        return values
    _explain_rows(rows, name, rows_line, joints, columns)
    found = 0 if values is None else len(values)
    _fail(
        name,
        frames_line,
        f"Frames: says {count}, but {found} rows of numbers follow; the file is cut off or the "
        "count is wrong: export it again or mend the count",
    )


def _rows_with_lines(rows: bytes, rows_line: int):
    """Yield (line number, words) of the rows that are not blank."""
    for line, raw in enumerate(rows.split(b"\n"), start=rows_line):
        words = raw.decode("utf-8", errors="replace").split()
        if words:
            yield line, words


def _explain_rows(rows: bytes, name: str, rows_line: int, joints, columns: int):
    """Raise for the first row that is not `columns` finite numbers; return if there is none."""
    labels = [f"{axis}{kind} of {joint.name}" for joint in joints for axis, kind in joint.channels]
    for frame, (line, words) in enumerate(_rows_with_lines(rows, rows_line)):
        for column, word in enumerate(words):
            if _finite_number(word) is None:
                what = labels[column] if column < columns else "beyond the last channel"
                _fail(
                    name,
                    line,
                    f"{word[:40]!r} (number {column + 1} of frame {frame}, {what}) is not a finite "
                    "number; mend it or export the file again",
                )
        if len(words) != columns:
            how = "cut off" if len(words) < columns else "too long"
            _fail(
                name,
                line,
                f"frame {frame} has {len(words)} numbers where the HIERARCHY has {columns} "
                f"channels: the row is {how}; export the file again",
            )


def _build_motion(joints, end_sites, values, frame_time, name, scale, rows, rows_line) -> Motion:
    """Turn channel values into root positions, bones and matrices."""
    frames, count = len(values), len(joints)
    rotations = np.empty((frames, count, 3, 3))
    by_order: dict[str, list[int]] = {}
    for joint, item in enumerate(joints):
        by_order.setdefault(item.rotation_order, []).append(joint)
    for order, members in by_order.items():
        if order:
            columns = [joints[joint].rotation_columns for joint in members]
            rotations[:, members] = matrix_from_euler(order, values[:, columns])
        else:
            rotations[:, members] = np.eye(3)

    def channel_positions(joint):
        position = np.tile(scale * np.array(joints[joint].offset), (frames, 1))
        for axis, column in joints[joint].position.items():
            position[:, "XYZ".index(axis)] = scale * values[:, column]
        return position

    parents = [joint.parent for joint in joints]
    root, root_position = 0, channel_positions(0)
    if count > 1 and joints[0].position and joints[1].position and parents.count(0) == 1:
        root = 1
        root_position = root_position + np.einsum("tab,tb->ta", rotations[:, 0], channel_positions(1))
        rotations[:, 1] = rotations[:, 0] @ rotations[:, 1]

    offsets = np.zeros((count, 3))
    for joint in range(root + 1, count):
        offsets[joint] = scale * np.array(joints[joint].offset)
        if joints[joint].position:
            position = channel_positions(joint)
            offsets[joint] = position.mean(axis=0)
            error = np.abs(position - offsets[joint]).max(axis=1)
            if error.max() > RIGID_TOLERANCE:
                frame = int(error.argmax())
                line = [line for line, _ in _rows_with_lines(rows, rows_line)][frame]
                _fail(
                    name,
                    line,
                    f"the position channels of {joints[joint].name!r} move by "
                    f"{1000 * error.max():.1f} mm in frame {frame}; bones must be rigid: bake the "
                    "motion to rotations before exporting",
                )
    skeleton = Skeleton(
        names=tuple(joint.name for joint in joints[root:]),
        parents=tuple(max(parent - root, -1) for parent in parents[root:]),
        offsets=offsets[root:],
        end_sites=tuple(
            (joint - root, tuple(scale * value for value in offset)) for joint, offset in end_sites if joint >= root
        ),
    )
    return Motion(
        skeleton=skeleton, root_position=root_position, rotations=rotations[:, root:], fps=1.0 / frame_time, name=name
    )
