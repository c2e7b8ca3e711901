"""Data sets in HumanML3D's layout, written from any motion with captions: `f3amd dataset`.

`f3amd_lib.text.data.humanml3d` says what lies in such a folder, and reads it.
"""

import csv
import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from tqdm import tqdm

from f3amd_lib.data.sources import SPLITS, Dataset, assign_splits
from f3amd_lib.ground.files import whole_folder
from f3amd_lib.ground.names import nearest_hint
from f3amd_lib.motion.skeleton import Motion, Skeleton, mirror, resample
from f3amd_lib.text.data.humanml3d import SPLIT_FILES, text_lines
from f3amd_lib.text.data.redundant import grouped_statistics, redundant_from_positions
from f3amd_lib.text.data.text_motions import (
    FEWEST_FRAMES,
    FPS,
    HELD_OUT_PERCENT,
    MOST_FRAMES,
    UNIT,
    TextMotions,
    text_motions,
)


def write_caption_line(caption: str) -> str:
    """Return a caption of a whole clip as a line of `texts/`.

    Parts of speech are not told: every word gets the tag OTHER, which readers of such lines know.
    """
    words = re.findall(r"[^\W_]+(?:['-][^\W_]+)*", caption.lower())
    return f"{caption}#{' '.join(f'{word}/OTHER' for word in words)}#0.0#0.0"


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
        for split, file in SPLIT_FILES.items():
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
        reader = csv.DictReader(text_lines(path, "choose a CSV file in UTF-8"))
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
