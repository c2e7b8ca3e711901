"""Folders in the layout of HumanML3D and KIT-ML: read, and written from any motion with captions.

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

import csv
import json
import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from tqdm import tqdm

from f3amd_lib.data.sources import SPLITS, Dataset, assign_splits
from f3amd_lib.ground.files import read_toml, whole_folder
from f3amd_lib.ground.names import nearest_hint
from f3amd_lib.motion.skeleton import Motion, Skeleton, mirror, resample
from f3amd_lib.text.data.redundant import CONTACT_STEP, grouped_statistics, redundant_from_positions
from f3amd_lib.text.data.text_motions import (
    FEWEST_FRAMES,
    FPS,
    HELD_OUT_PERCENT,
    MOST_FRAMES,
    UNIT,
    TextMotions,
    text_motions,
)

LAYOUTS = read_toml(Path(__file__).with_name("layouts.toml"))
"""Published layouts: "humanml3d" and "kit"."""

_SPLIT_FILES = dict(zip(SPLITS, ("train.txt", "val.txt", "test.txt"), strict=True))


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
    parts = line.rstrip("\n").split("#")
    if len(parts) != 4:
        raise ValueError(f"{where}: has {len(parts)} parts where caption#words#begin#end has 4; mend the line")
    try:
        begin, end = (0.0 if math.isnan(float(word)) else float(word) for word in parts[2:])
    except ValueError:
        raise ValueError(f"{where}: begin {parts[2]!r} and end {parts[3]!r} must be seconds; mend the line") from None
    if not parts[0].strip():
        raise ValueError(f"{where}: the caption is empty; write one or delete the line")
    if (begin or end) and not 0.0 <= begin < end < math.inf:
        raise ValueError(f"{where}: begin {begin} and end {end} must rise, or both be 0.0; mend the line")
    return parts[0].strip(), begin, end


def write_caption_line(caption: str) -> str:
    """Return a caption of a whole clip as a line of `texts/`.

    Parts of speech are not told: every word gets the tag OTHER, which readers of such lines know.
    """
    words = re.findall(r"[^\W_]+(?:['-][^\W_]+)*", caption.lower())
    return f"{caption}#{' '.join(f'{word}/OTHER' for word in words)}#0.0#0.0"


def _load(path: Path, fix: str) -> np.ndarray:
    """Return a file's array of numbers; ValueError names one that holds none."""
    try:
        array = np.load(path, allow_pickle=False)
    # What numpy and Python's own tokenizer raise over damaged bytes is no closed list.
    except Exception as error:
        raise ValueError(f"{path}: cannot be read as an array without pickles ({error}); {fix}") from error
    if getattr(array, "dtype", np.dtype(object)).kind not in "fiu":
        raise ValueError(f"{path}: holds no array of real numbers; {fix}")
    return array


def _positions(path: Path, joints: int, fix: str) -> np.ndarray:
    """Return a file's positions, [L, J, 3], as float32."""
    array = _load(path, fix)
    if array.shape == (joints, 3):
        array = array[None]  # a clip of one frame is stored without a frame axis
    if array.shape != (len(array), joints, 3) or not array.size:
        raise ValueError(f"{path}: has shape {array.shape} instead of {('L', joints, 3)}; {fix}")
    if not np.isfinite(array).all():
        raise ValueError(f"{path}: is not finite in frame {int(np.argwhere(~np.isfinite(array))[0][0])}; {fix}")
    return array.astype(np.float32)


def _lines(path: Path, fix: str) -> list[str]:
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
    clips, skipped, seen = [], [], {}
    for split, file in _SPLIT_FILES.items():
        for number, name in enumerate(_lines(folder / file, fix), 1):
            name = name.strip()
            if not name:
                continue
            where = f"{folder / file}, line {number}"
            if name in seen:
                raise ValueError(f"{where}: {name!r} is listed before, in {seen[name]}; keep one")
            seen[name] = file
            if Path(name).name != name or "\0" in name or len(name) > 200:
                raise ValueError(f"{where}: {name!r} is no plain id; mend the line")
            positions = _positions(folder / "new_joints" / f"{name}.npy", skeleton.num_joints, fix)
            for clip, captions, part in _captioned(folder / "texts" / f"{name}.txt", name, fps, len(positions), fix):
                length = len(positions[part])
                if not fewest <= length <= MOST_FRAMES:
                    skipped.append((clip, f"{length} frames, not {fewest} to {MOST_FRAMES}"))
                    continue
                pair = described.get("pairs", {}).get(clip, clip)
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
    lines = [(number, line) for number, line in enumerate(_lines(path, fix), 1) if line.strip()]
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
            described = json.loads(own.read_text(encoding="utf-8"))
            skeleton = Skeleton(described["joints"], described["parents"], np.array(described["offsets"], np.float64))
            described = {"fewest_frames": 1} | described | {"fps": float(described["fps"])}
            if not (0.0 < described["fps"] <= 1000.0 and isinstance(described.get("pairs", {}), dict)):
                raise ValueError("its rate or its pairs are none")
            texts = [described.get(key, "") for key in ("name", "licence", "credit")]
            pairs = described.get("pairs", {}).values()
            if not all(isinstance(text, str) for text in [*skeleton.names, *texts, *pairs]):
                raise ValueError("its names and terms must be text")
        except (LookupError, TypeError, ValueError, AttributeError, RecursionError, OverflowError) as error:
            raise ValueError(f"{own}: is not a skeleton of ours ({error}); {fix}") from error
        return skeleton, described | {"contact_step": CONTACT_STEP}  # its positions are in metres
    ids = [line.strip() for line in _lines(folder / "train.txt", fix) if line.strip()]
    first = folder / "new_joints" / f"{ids[0] if ids else 'none'}.npy"
    joints = (0, *_load(first, fix).shape)[-2]
    known = {len(described["joints"]): name for name, described in LAYOUTS.items()}
    if joints not in known:
        raise ValueError(f"{first}: has {joints} joints, HumanML3D has 22 and KIT-ML 21; a skeleton.json tells others")
    return layout_skeleton(known[joints]), {"name": known[joints], **LAYOUTS[known[joints]]}


# ------------------------------------------------------------------------------------------ writing


def write_humanml3d(folder, data: TextMotions) -> Path:
    """Write motions with captions in HumanML3D's layout.

    Others' text-to-motion code reads it like HumanML3D; where that names joints by number, give it
    this skeleton's (`skeleton.json`). The last frame of each clip is dropped, as there.

    Args:
      folder: to write to; must be empty or not there yet.
      data: what to write.

    Returns:
      The folder.

    Raises:
      ValueError: if the folder holds something, two clips have one name, or no clip is for training.
    """
    folder = Path(folder)
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise ValueError(f"{folder}: exists already and is not empty; choose another folder")
    data.members("train")
    if len(set(data.names)) != data.num_clips:
        raise ValueError(f"data set {data.name!r}: two clips are called alike; rename one")
    with whole_folder(folder) as temporary:
        for part in ("new_joints", "new_joint_vecs", "texts"):
            (temporary / part).mkdir()
        training = []
        for number, name in enumerate(data.names):
            clip = data.clip(number)
            vectors = redundant_from_positions(data.skeleton, clip, contact_step=data.contact_step).astype(np.float32)
            np.save(temporary / "new_joints" / f"{name}.npy", clip[:-1])
            np.save(temporary / "new_joint_vecs" / f"{name}.npy", vectors)
            _write(temporary / "texts" / f"{name}.txt", map(write_caption_line, data.captions[number]))
            if data.splits[number] == "train":
                training.append(vectors)
        for file, numbers in zip(("Mean.npy", "Std.npy"), grouped_statistics(np.concatenate(training)), strict=True):
            np.save(temporary / file, numbers)
        members = {split: [data.names[k] for k in np.flatnonzero(np.equal(data.splits, split))] for split in SPLITS}
        for split, file in _SPLIT_FILES.items():
            _write(temporary / file, members[split])
        _write(temporary / "train_val.txt", members["train"] + members["validation"])
        _write(temporary / "all.txt", data.names)
        skeleton = data.skeleton
        described = {"joints": skeleton.names, "parents": skeleton.parents, "offsets": skeleton.offsets.tolist()}
        described |= {name: getattr(data, name) for name in ("fps", "name", "licence", "credit")}
        described["pairs"] = dict(zip(data.names, data.pairs, strict=True))
        _write(temporary / "skeleton.json", [json.dumps(described, indent=1)])
    return folder


def _write(path: Path, lines) -> None:
    path.write_text("".join(f"{line}\n" for line in lines), encoding="utf-8")


def read_caption_table(path) -> dict[str, tuple[str, ...]]:
    """Read captions from a CSV file with columns `file` and `caption`, several lines a file if you like.

    Returns:
      Name of a motion file, without folder and ending -> its captions.

    Raises:
      ValueError: naming the file and the line, for a missing column, an empty cell or a # in a caption.
    """
    path = Path(path)
    try:
        reader = csv.DictReader(_lines(path, "choose a CSV file in UTF-8"))
        rows = [(reader.line_num, row) for row in reader]
    except csv.Error as error:
        raise ValueError(f"{path}: is not a CSV file ({error}); write it anew") from error
    captions: dict[str, list[str]] = {}
    for line, row in rows:
        file, caption = ((row.get(column) or "").strip() for column in ("file", "caption"))
        if not file or not caption:
            raise ValueError(f"{path}, line {line}: needs a file and a caption, under headings of these names")
        if "#" in caption:
            raise ValueError(f"{path}, line {line}: # parts the fields of HumanML3D's texts; write it out")
        captions.setdefault(Path(file).stem if file.lower().endswith(".bvh") else Path(file).name, []).append(caption)
    if not captions:
        raise ValueError(f"{path}: holds no caption; it needs lines under the headings file,caption")
    return {name: tuple(dict.fromkeys(several)) for name, several in captions.items()}


def _has_twins(skeleton: Skeleton) -> bool:
    """Say whether every joint with a side has its twin on the other one."""
    try:
        return bool(skeleton.mirror_permutation)
    except ValueError:
        return False


def captioned_motions(
    dataset: Dataset, captions: Mapping[str, Sequence[str]], *, fps: float = FPS, progress: bool = True
) -> TextMotions:
    """Put the motions of a data set, such as a folder of BVH files, together with captions.

    Each clip of 24 frames or more is brought to `fps`, moved to the canonical start, and cut to 199; its mirror image
    joins it where joints have twins and the captions name no side. Clips are split by their names, 80, 5 and 15 %.

    Args:
      dataset: from `open_dataset`.
      captions: clip name, or the last part of one -> captions.
      fps: wanted rate.
      progress: show a progress bar.

    Raises:
      ValueError: for a caption without a motion, no motion with a caption, a name that two motions
        share, or skeletons that differ.
    """
    by_name: dict[str, str] = {}
    for clip in dataset.clips:
        short = clip.name.rsplit("/", 1)[-1]
        if short in by_name and short in captions:
            raise ValueError(f"captions of {short!r}: {by_name[short]} and {clip.name} are both called so; rename one")
        by_name[short] = clip.name
    if missing := [name for name in captions if name not in by_name]:
        hint = nearest_hint(missing[0], by_name)
        raise ValueError(f"{len(missing)} captions have no motion, such as those of {missing[0]!r}{hint}")
    splits = assign_splits(((name, "all") for name in captions), percent=HELD_OUT_PERCENT)
    skeleton, clips, skipped = None, [], []
    for clip in tqdm(dataset.clips, desc=f"reading {dataset.name}", unit="clip", disable=not progress):
        short = clip.name.rsplit("/", 1)[-1]
        if short not in captions:
            skipped.append((clip.name, "no caption"))
            continue
        motion = resample(clip.loader(), fps)
        if skeleton is None:
            skeleton, first = motion.skeleton, clip.name
        if motion.skeleton != skeleton:
            raise ValueError(f"{clip.name}: its skeleton differs from that of {first}; a data set needs one")
        if motion.num_frames < FEWEST_FRAMES:
            skipped.append((clip.name, f"{motion.num_frames} frames, fewer than {FEWEST_FRAMES}"))
            continue
        motion = motion.slice(0, min(motion.num_frames, MOST_FRAMES + 1) // UNIT * UNIT)
        said = tuple(captions[short])
        clips.append((short, motion, said, splits[short], short))
        if _has_twins(skeleton) and not re.search(r"\b(left|right)", " ".join(said).lower()):
            seen = Motion.from_positions(skeleton, motion.positions, fps)
            clips.append((f"M{short}", mirror(seen), said, splits[short], short))
    if not clips:
        raise ValueError(f"data set {dataset.name!r}: no captioned motion has {FEWEST_FRAMES} frames at {fps:g} fps")
    described = {name: getattr(dataset, name) for name in ("name", "licence", "credit")}
    return text_motions(clips, skeleton=skeleton, fps=fps, skipped=tuple(skipped), **described)
