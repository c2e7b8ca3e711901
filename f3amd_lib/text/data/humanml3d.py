"""Folders in the layout of HumanML3D and KIT-ML are read here; `f3amd dataset` writes them.

| path | content |
|---|---|
| `new_joints/<id>.npy` | positions, [L, J, 3] |
| `new_joint_vecs/<id>.npy` | redundant vectors of the same frames, [L, 12 J - 1] |
| `texts/<id>.txt` | a line a caption: `caption#word/TAG word/TAG#begin#end`, seconds; 0.0 twice is the whole clip |
| `train.txt`, `val.txt`, `test.txt` | ids, one a line; also `train_val.txt` and `all.txt` |
| `Mean.npy`, `Std.npy` | of the vectors; deviations averaged over each part |
| `skeleton.json` | ours: joints, rest pose, rate and terms, so that other skeletons can be read back |

The released set holds two clips that are not finite (007975 and its mirror image), empty captions, and captions whose
times do not rise or lie past the clip: such records are left out and counted, as its own readers leave them out.

Source: the released data set of Guo et al. 2022 and its README.
"""

import contextlib
import json
import math
from pathlib import Path

import numpy as np

from f3amd_lib.data.sources import SPLITS, assign_splits
from f3amd_lib.ground import log
from f3amd_lib.ground.files import read_toml
from f3amd_lib.ground.left_out import leave_out
from f3amd_lib.ground.tables import read_text
from f3amd_lib.motion.skeleton import Skeleton
from f3amd_lib.text.data.redundant import CONTACT_STEP, positions_from_redundant
from f3amd_lib.text.data.text_encoders import plain_caption
from f3amd_lib.text.data.text_motions import HELD_OUT_PERCENT, MOST_FRAMES, TextMotions

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


def tagged_captions(folder) -> dict[str, str]:
    """Return words with tags, "a/DET person/NOUN walk/VERB", of each caption of a folder's `texts/`, plain letters."""
    lines = [line for path in sorted(Path(folder).glob("texts/*.txt")) for line in read_text(path).splitlines()]
    split = [line.split("#") for line in lines]
    return {plain_caption(parts[0].strip()): parts[1] for parts in split if len(parts) == 4}


def read_humanml3d(folder) -> TextMotions:
    """Read a folder in HumanML3D's layout: its positions, vectors, captions and splits.

    A caption with times is a clip of its own, `<id>@begin-end`, frames int(begin fps) to int(end fps) of positions and
    vectors. Clips under the layout's fewest frames (40; KIT-ML 24), or of 200 and more, are left out, and so are
    broken records (`leave_out`); all of them are listed in `skipped`. Where `val.txt` or `test.txt` is missing, its
    clips are taken out of `train.txt`.

    Args:
      folder: with `new_joints` or `new_joint_vecs`, `texts` and `train.txt`; `skeleton.json` says whose joints they
        are, else their number does.

    Returns:
      The clips, float32.

    Raises:
      ValueError: naming what is missing or broken, if that is more than a fifth of the records.
    """
    folder = Path(folder).expanduser()
    splits, broken = _listed(folder)
    num_records = len(splits) + len(broken)
    skeleton, described = _skeleton_of(folder, splits)
    fewest, fps = described["fewest_frames"], described["fps"]
    clips, stored, lines, lengths = [], [], [], []
    for name, split in splits.items():
        try:
            positions, vectors = _motion(folder, name, skeleton.num_joints)
            captioned, unused = _captioned(folder, name, fps, len(positions))
        except ValueError as error:
            broken.append((name, str(error)))
            continue
        lines += unused
        for clip, captions, first, last in captioned:
            part = positions[first:last]
            if not fewest <= len(part) <= MOST_FRAMES:
                lengths.append((clip, f"{len(part)} frames, not {fewest} to {MOST_FRAMES}"))
                continue
            clips.append((clip, captions, split, described["pairs"].get(clip, clip), part))
            stored.append((vectors, first))
    leave_out(folder, broken, num_records, lines)
    if not clips:
        raise ValueError(f"{folder}: no clip of {fewest} to {MOST_FRAMES} frames; fetch or write the folder again")
    usual = {"name": folder.name, "licence": "as its owner says", "credit": ""}
    terms = {what: described.get(what, value) for what, value in usual.items()}
    return TextMotions.joined(
        clips, skeleton=skeleton, fps=fps, skipped=(*broken, *lines, *lengths), stored=tuple(stored),
        statistics=_statistics(folder, skeleton.num_joints), contact_step=described["contact_step"], **terms,
    )  # fmt: skip


def _listed(folder: Path) -> tuple[dict[str, str], list[tuple[str, str]]]:
    """Return the split of each id, and (place, reason) of lines that hold none."""
    splits, broken, missing = {}, [], []
    for split, file in SPLIT_FILES.items():
        if split != "train" and not (folder / file).is_file():
            missing.append(split)
            continue
        for number, name in enumerate(map(str.strip, read_text(folder / file).splitlines()), 1):
            if name in splits or Path(name).name != name or "\0" in name or len(name) > 200:
                broken.append((f"{file}, line {number}", f"{name!r} is listed before, or no plain id"))
            elif name:
                splits[name] = split
    if missing:
        # A clip and its mirror image, M and its name, belong together.
        bare = {n: own if (own := n.removeprefix("M")) in splits else n for n in splits if splits[n] == "train"}
        held = assign_splits(((name, "all") for name in set(bare.values())), percent=HELD_OUT_PERCENT)
        splits |= {name: held[own] for name, own in bare.items() if held[own] in missing}
        what = " and ".join(SPLIT_FILES[split] for split in missing)
        log.warning("%s: no %s, so clips of train.txt are held out instead, by their names", folder, what)
    return splits, broken


def _array(folder: Path, part: str, name: str) -> np.ndarray:
    """Return a file's real numbers; ValueError names one that holds none, or numbers that are not finite."""
    try:
        array = np.load(folder / part / f"{name}.npy", allow_pickle=False)
        if array.dtype.kind not in "fiu" or not array.size or not np.isfinite(array).all():
            raise ValueError("not finite" if array.dtype.kind == "f" and array.size else f"no numbers: {array.dtype}")
    # What numpy and Python's own tokenizer raise over damaged bytes is no closed list.
    except Exception as error:
        what = "is missing" if isinstance(error, FileNotFoundError) else f"cannot be used ({error})"
        raise ValueError(f"{part}/{name}.npy {what}") from error
    return array.reshape(-1, *array.shape[-2 if part == "new_joints" else -1 :])  # one frame may lack its axis


def _motion(folder: Path, name: str, joints: int | None = None) -> tuple[np.ndarray, Path | None]:
    """Return a clip's positions, [L, J, 3], float32, and the file of its vectors, where one fits.

    Positions that are not there come from the vectors.
    """
    file = folder / "new_joint_vecs" / f"{name}.npy"
    if file.is_file() and not (folder / "new_joints" / f"{name}.npy").exists():
        positions = positions_from_redundant(_array(folder, "new_joint_vecs", name).astype(np.float64))
    else:
        positions = _array(folder, "new_joints", name)
    if positions.shape[1:] != (joints or positions.shape[1], 3):
        raise ValueError(f"its positions have shape {positions.shape}, not [L, {joints or 'J'}, 3]")
    with contextlib.suppress(Exception):  # whatever damaged bytes raise: vectors are computed instead
        if np.load(file, mmap_mode="r").shape == (len(positions), 12 * positions.shape[1] - 1):
            return positions.astype(np.float32), file
    return positions.astype(np.float32), None


def _captioned(folder: Path, name: str, fps: float, frames: int) -> tuple[list[tuple], list[tuple[str, str]]]:
    """Return (clip, captions, first frame, end) of a motion and of its parts, and (line, reason) of unused lines."""
    parts, unused = {}, []
    for number, line in enumerate(read_text(folder / "texts" / f"{name}.txt").splitlines(), 1):
        if not line.strip():
            continue
        where = f"texts/{name}.txt, line {number}"
        try:
            caption, begin, end = read_caption_line(line, where)
            first, last = (int(begin * fps), int(end * fps)) if begin or end else (0, frames)
            if first >= frames:
                raise ValueError(f"begins at {begin} s, but the motion ends at {frames / fps:.2f} s")
        except ValueError as error:
            unused.append((where, str(error).removeprefix(f"{where}: ")))
            continue
        clip = f"{name}@{begin:g}-{end:g}" if begin or end else name
        parts.setdefault((clip, first, last), []).append(caption)
    if not parts:
        reason = f": {unused[0][1]}" if unused else ""
        raise ValueError(f"texts/{name}.txt holds no caption that can be used{reason}")
    whole_first = sorted(parts.items(), key=lambda part: part[0][0] != name)
    return [(clip, tuple(captions), first, last) for (clip, first, last), captions in whole_first], unused


def _statistics(folder: Path, joints: int) -> tuple[np.ndarray, np.ndarray] | None:
    """Return `Mean.npy` and `Std.npy`, where both are there; ValueError if they are no vectors' ones."""
    files = folder / "Mean.npy", folder / "Std.npy"
    if not all(file.is_file() for file in files):
        return None
    try:
        mean, deviation = (np.load(file, allow_pickle=False).astype(np.float32) for file in files)
        if not mean.shape == deviation.shape == (12 * joints - 1,) or not np.isfinite([mean, deviation]).all():
            raise ValueError(f"shapes {mean.shape} and {deviation.shape}, or not finite")
    except Exception as error:  # as above
        what = f"are not mean and deviation of {12 * joints - 1} numbers ({error})"
        raise ValueError(f"{files[0]} and Std.npy {what}; remove them, and they are computed again") from error
    return mean, deviation


def _skeleton_of(folder: Path, ids) -> tuple[Skeleton, dict]:
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
                raise ValueError("its frame rate is not valid, or its names and terms are not text")
        except (LookupError, TypeError, ValueError, AttributeError, RecursionError, OverflowError) as error:
            raise ValueError(f"{own}: is not a skeleton of ours ({error}); write the folder again") from error
        return skeleton, described | {"contact_step": CONTACT_STEP}  # its positions are in metres
    known, reasons = {len(layout["joints"]): name for name, layout in LAYOUTS.items()}, []
    for name in ids:
        try:
            joints = _motion(folder, name)[0].shape[1]
        except ValueError as error:
            reasons.append(str(error))
            continue
        if joints in known:
            return layout_skeleton(known[joints]), {"name": known[joints], "pairs": {}, **LAYOUTS[known[joints]]}
        reasons.append(f"{name} has {joints} joints")
    what = f"no clip of HumanML3D's 22 joints or KIT-ML's 21 ({reasons[0] if reasons else 'no id is listed'})"
    raise ValueError(f"{folder}: {what}; describe other skeletons in a skeleton.json")
