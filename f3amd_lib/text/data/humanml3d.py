"""Folders in the layout of HumanML3D and KIT-ML are read here; `f3amd dataset` writes them.

| path | content |
|---|---|
| `new_joints/<id>.npy` | positions, [L, J, 3] |
| `new_joint_vecs/<id>.npy` | redundant vectors of the same frames, [L, 12 J - 1] |
| `texts/<id>.txt` | a line a caption: `caption#word/TAG word/TAG#begin#end`, seconds; 0.0 twice is the whole clip |
| `train.txt`, `val.txt`, `test.txt` | ids, one a line; also `train_val.txt` and `all.txt` |
| `Mean.npy`, `Std.npy` | of the vectors; deviations averaged over each part |
| `skeleton.json` | ours: joints, rest pose, rate and terms, so that other skeletons can be read back |

Source: the released data set of Guo et al. 2022 and its README.
"""

import json
import math
from pathlib import Path

import numpy as np

from f3amd_lib.data.sources import SPLITS
from f3amd_lib.ground.files import read_toml
from f3amd_lib.motion.skeleton import Skeleton
from f3amd_lib.text.data.redundant import CONTACT_STEP
from f3amd_lib.text.data.text_motions import MOST_FRAMES, TextMotions

LAYOUTS = read_toml(Path(__file__).with_name("layouts.toml"))
"""Published layouts: "humanml3d" and "kit"."""

SPLIT_FILES = dict(zip(SPLITS, ("train.txt", "val.txt", "test.txt"), strict=True))
"""File with the ids of each split."""


def layout_skeleton(layout: str) -> Skeleton:
    """Return the skeleton of a published layout, one of `LAYOUTS`, bones of length 1."""
    described = LAYOUTS[layout]
    rest = [[(axis == way[-1:]) * (-1.0 if way[:1] == "-" else 1.0) for axis in "xyz"] for way in described["rest"]]
    return Skeleton(described["joints"], described["parents"], rest)


def read_caption_line(line: str, where: str) -> tuple[str, float, float]:
    """Return (caption, begin, end) of a line of `texts/`; seconds, 0 and 0 for the whole clip.

    Raises:
      ValueError: naming the place, for a line of another form, an empty caption or times that do not rise.
    """
    try:
        caption, _, *times = line.rstrip("\n").split("#")
        begin, end = (0.0 if math.isnan(float(word)) else float(word) for word in times)
        if not caption.strip() or not (begin == end == 0.0 or 0.0 <= begin < end < math.inf):
            raise ValueError("the caption is empty, or times do not rise")
    except ValueError as error:
        form = "caption#words#begin#end, in seconds or 0.0 twice"
        raise ValueError(f"{where}: {line!r} is not {form} ({error}); mend the line") from error
    return caption.strip(), begin, end


def _positions(path: Path, fix: str, joints: int | None = None) -> np.ndarray:
    """Return a file's positions, [L, J, 3], float32; ValueError names one that holds none."""
    try:
        array = np.load(path, allow_pickle=False)
        if array.dtype.kind not in "fiu":
            raise ValueError("no real numbers")
        array = array.reshape(-1, *array.shape[-2:])  # a clip of one frame is stored without a frame axis
        if not array.size or array.shape[1:] != (joints or array.shape[1], 3) or not np.isfinite(array).all():
            raise ValueError(f"shape {array.shape}, or not finite")
    # What numpy and Python's own tokenizer raise over damaged bytes is no closed list.
    except Exception as error:
        raise ValueError(f"{path}: holds no positions [L, {joints or 'J'}, 3] ({error}); {fix}") from error
    return array.astype(np.float32)


def text_lines(path: Path, fix: str) -> list[str]:
    """Return the lines of a file; ValueError names one that is no text, and says how to mend that."""
    try:
        return path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise ValueError(f"{path}: cannot be read as text ({error}); {fix}") from error


def read_humanml3d(folder) -> TextMotions:
    """Read a folder in HumanML3D's layout: its positions, captions and splits.

    A caption with times is a clip of its own, `<id>@begin-end`, cut at int(begin fps) and int(end fps).
    Clips under the layout's fewest frames (40; KIT-ML 24), or of 200 and more, are left out and listed in `skipped`.

    Args:
      folder: with `new_joints`, `texts` and the split files; `skeleton.json` says whose joints they are, else their
        number does.

    Returns:
      The clips, float32.

    Raises:
      ValueError: naming the file, and the line where there is one, that is missing, broken, a pickle
        or not in step with the others.
    """
    folder = Path(folder).expanduser()
    fix = "fetch or write the folder again"
    skeleton, described = _skeleton_of(folder, fix)
    fewest, fps = described["fewest_frames"], described["fps"]
    clips, skipped, seen = [], [], set()
    for split, file in SPLIT_FILES.items():
        for number, name in enumerate(map(str.strip, text_lines(folder / file, fix)), 1):
            if not name:
                continue
            if name in seen or Path(name).name != name or "\0" in name or len(name) > 200:
                raise ValueError(f"{folder / file}, line {number}: {name!r} is listed before, or no plain id; mend it")
            seen.add(name)
            positions = _positions(folder / "new_joints" / f"{name}.npy", fix, skeleton.num_joints)
            for clip, captions, part in _captioned(folder / "texts" / f"{name}.txt", name, fps, len(positions), fix):
                length = len(positions[part])
                if not fewest <= length <= MOST_FRAMES:
                    skipped.append((clip, f"{length} frames, not {fewest} to {MOST_FRAMES}"))
                    continue
                pair = described["pairs"].get(clip, clip)
                clips.append((clip, captions, split, pair, positions[part]))
    if not clips:
        raise ValueError(f"{folder}: no clip of {fewest} to {MOST_FRAMES} frames; {fix}")
    usual = {"name": folder.name, "licence": "as its owner says", "credit": ""}
    terms = {what: described.get(what, value) for what, value in usual.items()}
    return TextMotions.joined(
        clips, skeleton=skeleton, fps=fps, skipped=tuple(skipped), contact_step=described["contact_step"], **terms
    )


def _captioned(path: Path, name: str, fps: float, frames: int, fix: str) -> list[tuple[str, tuple, slice]]:
    """Return (clip, captions, frames) of the whole of a motion and of each part that a line names."""
    whole, parts = [], {}
    lines = [(number, line) for number, line in enumerate(text_lines(path, fix), 1) if line.strip()]
    for number, line in lines:
        caption, begin, end = read_caption_line(line, f"{path}, line {number}")
        if not (begin or end):
            whole.append(caption)
            continue
        first, last = int(begin * fps), int(end * fps)
        if first >= frames:
            what = f"begins at {begin} s, but the motion ends at {frames / fps:.2f} s"
            raise ValueError(f"{path}, line {number}: {what}; mend the line")
        parts.setdefault((f"{name}@{begin:g}-{end:g}", first, last), []).append(caption)
    if not lines:
        raise ValueError(f"{path}: holds no caption; write one, or take the id out of the split files")
    clips = [(name, tuple(whole), slice(None))] if whole else []
    return clips + [(clip, tuple(captions), slice(first, last)) for (clip, first, last), captions in parts.items()]


def _skeleton_of(folder: Path, fix: str) -> tuple[Skeleton, dict]:
    """Return the skeleton of a folder, and its rate, terms and pairs."""
    own = folder / "skeleton.json"
    if own.is_file():
        try:
            described = {"fewest_frames": 1, "pairs": {}} | json.loads(own.read_text(encoding="utf-8"))
            skeleton = Skeleton(described["joints"], described["parents"], np.array(described["offsets"], np.float64))
            described["fps"] = float(described["fps"])
            terms = [described.get(key, "") for key in ("name", "licence", "credit")]
            texts = [*skeleton.names, *terms, *described["pairs"].values()]
            if not 0.0 < described["fps"] <= 1000.0 or not all(isinstance(text, str) for text in texts):
                raise ValueError("its rate is none, or its names and terms are no text")
        except (LookupError, TypeError, ValueError, AttributeError, RecursionError, OverflowError) as error:
            raise ValueError(f"{own}: is not a skeleton of ours ({error}); {fix}") from error
        return skeleton, described | {"contact_step": CONTACT_STEP}  # its positions are in metres
    ids = " ".join(text_lines(folder / "train.txt", fix)).split()
    first = folder / "new_joints" / f"{ids[0] if ids else 'none'}.npy"
    joints = _positions(first, fix).shape[1]
    known = {len(described["joints"]): name for name, described in LAYOUTS.items()}
    if joints not in known:
        raise ValueError(f"{first}: has {joints} joints, HumanML3D has 22 and KIT-ML 21; a skeleton.json tells others")
    return layout_skeleton(known[joints]), {"name": known[joints], "pairs": {}, **LAYOUTS[known[joints]]}
