"""Data sets in HumanML3D's layout, written from any motion with captions: `f3amd dataset`.

`f3amd_lib.text.data.humanml3d` says what lies in such a folder, and reads it.
"""

import json
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from f3amd_lib.data.sources import SPLITS, Dataset, assign_splits, read_clips
from f3amd_lib.ground import log
from f3amd_lib.ground.files import check_own_folder, whole_folder
from f3amd_lib.ground.left_out import leave_out
from f3amd_lib.ground.names import nearest_hint
from f3amd_lib.ground.tables import read_text_table
from f3amd_lib.motion.skeleton import Motion, Skeleton, mirror
from f3amd_lib.text.data.humanml3d import SPLIT_FILES
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
    check_own_folder(folder)
    training = set(data.members("train"))
    if len(set(data.names)) != data.num_clips:
        raise ValueError(f"data set {data.name!r}: two clips have the same name; rename one")
    with whole_folder(folder) as temporary:
        for part in ("new_joints", "new_joint_vecs", "texts"):
            (temporary / part).mkdir()
        every = []
        for number, name in enumerate(data.names):
            clip = data.clip(number)
            vectors = redundant_from_positions(data.skeleton, clip, contact_step=data.contact_step).astype(np.float32)
            np.save(temporary / "new_joints" / f"{name}.npy", clip[:-1])
            np.save(temporary / "new_joint_vecs" / f"{name}.npy", vectors)
            _write(temporary / "texts" / f"{name}.txt", map(write_caption_line, data.captions[number]))
            every += [vectors] if number in training else []
        for file, numbers in zip(("Mean.npy", "Std.npy"), grouped_statistics(np.concatenate(every)), strict=True):
            np.save(temporary / file, numbers)
        members = {split: [data.names[k] for k in np.flatnonzero(np.equal(data.splits, split))] for split in SPLITS}
        lists = {file: members[split] for split, file in SPLIT_FILES.items()}
        lists |= {"train_val.txt": members["train"] + members["validation"], "all.txt": data.names}
        for file, names in lists.items():
            _write(temporary / file, names)
        skeleton = data.skeleton
        described = {"joints": skeleton.names, "parents": skeleton.parents, "offsets": skeleton.offsets.tolist()}
        described |= {name: getattr(data, name) for name in ("fps", "name", "licence", "credit")}
        described["pairs"] = dict(zip(data.names, data.pairs, strict=True))
        _write(temporary / "skeleton.json", [json.dumps(described, indent=1)])
    return folder


def _write(path: Path, lines) -> None:
    path.write_text("".join(f"{line}\n" for line in lines), encoding="utf-8")


def read_caption_table(path) -> dict[str, tuple[str, ...]]:
    """Read captions from a table with columns `file` and `caption`, several lines a file if you like.

    Returns:
      Name of a motion file, without folder and ending -> its captions. Rows that lack one, or have a # in the caption,
      are left out.

    Raises:
      ValueError: as `read_text_table`, or where a fifth of the rows or all are bad.
    """
    said, bad = {}, []
    rows = read_text_table(path, "file,caption", others=True)
    for where, row in rows:
        name = re.sub(r"(?i)\.bvh$", "", re.split(r"[\\/]", row["file"])[-1])
        if not name or not row["caption"] or "#" in row["caption"]:
            what = "needs a file and a caption; a # parts the fields of HumanML3D's texts"
            bad.append((where.rpartition(": ")[2][:-1], what))
            continue
        said.setdefault(name, {})[row["caption"]] = None
    leave_out(path, bad, len(rows))
    if not said:
        raise ValueError(f"{path}: holds no caption; write a file and a caption in each row")
    return {name: tuple(captions) for name, captions in said.items()}


_SIDED = re.compile(r"\b(left|right)|clockwise|\bc?cw\b")
"""Words that are wrong of a mirror image."""


def _has_twins(skeleton: Skeleton) -> bool:
    """Say whether every joint with a side has its twin on the other one."""
    try:
        return bool(skeleton.mirror_permutation)
    except ValueError:
        return False


def captioned_motions(dataset: Dataset, captions: Mapping[str, Sequence[str]], *, fps: float = FPS) -> TextMotions:
    """Put the motions of a data set, such as a folder of BVH files, together with captions.

    Each clip of 24 frames or more is brought to `fps`, moved to the canonical start, and cut to 199; its mirror image
    joins it where joints have twins and the captions name no side and no way round. Clips are split by their names, 80,
    5 and 15 %.

    Args:
      dataset: from `open_dataset`.
      captions: clip name, or the last part of one -> captions.
      fps: wanted rate.

    Raises:
      ValueError: if a fifth of the captions have no motion, or several; for no motion with a caption; or as
        `read_clips`.
    """
    shorts = [clip.name.rsplit("/", 1)[-1] for clip in dataset.clips]
    counts = Counter(shorts)
    lost = [(name, f"{counts[name]} motions{nearest_hint(name, counts)}") for name in captions if counts[name] != 1]
    leave_out(f"captions of {dataset.name!r}", lost, len(captions))
    captions = {name: tuple(said) for name, said in captions.items() if counts[name] == 1}
    splits = assign_splits(((name, "all") for name in captions), percent=HELD_OUT_PERCENT)
    every = list(zip(shorts, dataset.clips, strict=True))
    clips, skipped = [], [*lost, *((clip.name, "no caption") for short, clip in every if short not in captions)]
    captioned = replace(dataset, clips=tuple(clip for short, clip in every if short in captions))
    for clip, motion in read_clips(captioned, skipped, fps=fps, fewest=FEWEST_FRAMES):
        short = clip.name.rsplit("/", 1)[-1]
        skeleton, said = motion.skeleton, captions[short]
        motion = motion.slice(0, min(motion.num_frames, MOST_FRAMES + 1) // UNIT * UNIT)
        clips.append((short, motion, said, splits[short], short))
        if _has_twins(skeleton) and not _SIDED.search(" ".join(said).lower()):
            seen = Motion.from_positions(skeleton, motion.positions, fps)
            clips.append((f"M{short}", mirror(seen), said, splits[short], short))
    if not clips:
        raise ValueError(f"data set {dataset.name!r}: no captioned motion has {FEWEST_FRAMES} frames at {fps:g} fps")
    if empty := [split for split in SPLITS if split not in {clip[3] for clip in clips}]:
        what = "training and judging need one in each; caption three motions or more"
        log.warning("%s: no clip for %s: %s", dataset.name, " and ".join(empty), what)
    described = {name: getattr(dataset, name) for name in ("name", "licence", "credit")}
    return text_motions(clips, skeleton=skeleton, fps=fps, skipped=tuple(skipped), **described)
