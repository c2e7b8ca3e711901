"""The packed cache: a whole data set in one small file that loads in a moment.

Parsing text takes seconds to minutes, so it is done once. The packed file holds root positions in
float32 (float16 steps by 8 mm at 10 m) and rotations as 6D numbers in float16, which moves no joint of
Bandai's clips by more than 0.5 mm (`tests/test_packed.py`); it is a file of arrays as weights are, and small
enough to carry to another machine.
"""

import os
import warnings
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
import platformdirs

from f3amd_lib.data.features import lowest_toe_height
from f3amd_lib.data.sources import FPS, MINIMUM_FRAMES, SPLITS, DataCard, Dataset, read_clips
from f3amd_lib.ground.trees import check_kind, errors_name, load_tree, save_tree
from f3amd_lib.motion.rotations import matrix_from_rotation_6d, rotation_6d_from_matrix
from f3amd_lib.motion.skeleton import Motion, Skeleton, describe_skeleton, described_skeleton

CACHE_DIR_VARIABLE = "F3AMD_CACHE_DIR"

_FORMAT = 2
"""Raised whenever the file's layout or what is put into it changes, so that old caches retire."""

_KIND = f"packed data set of format {_FORMAT}"


@dataclass(frozen=True, eq=False)
class PackedMotion(DataCard):
    """All clips of a data set end to end: N frames, K clips, J joints, at 30 fps.

    Attributes:
      skeleton: the joints that all clips share.
      root_position: [N, 3] float32, metres.
      rotation_6d: [N, J, 6] float16, local rotations (the root's global).
      clip_start: [K + 1] int32; clip k is frames clip_start[k] to clip_start[k + 1] (excluded).
      clip_names, clip_contents: per clip, K strings.
      clip_style: [K] int32, index into `styles`.
      clip_split: [K] uint8; 0 train, 1 validation, 2 test.
      floor_shift: [K] float32, height of the lowest toe of each clip, metres. Nothing has been
        subtracted; contact rules that measure height subtract it.
      skipped: (clip name, reason) of clips that were left out.
    """

    skeleton: Skeleton
    root_position: np.ndarray
    rotation_6d: np.ndarray
    clip_start: np.ndarray
    clip_names: tuple[str, ...]
    clip_contents: tuple[str, ...]
    clip_style: np.ndarray
    clip_split: np.ndarray
    floor_shift: np.ndarray
    skipped: tuple[tuple[str, str], ...] = ()

    @property
    def num_clips(self) -> int:
        """Number of clips, K."""
        return len(self.clip_names)

    @property
    def num_frames(self) -> int:
        """Number of frames of all clips together, N."""
        return len(self.root_position)

    def motion(self, clip: int) -> Motion:
        """Return a clip by number, float64 with true rotation matrices."""
        frames = slice(*self.clip_start[clip : clip + 2])
        rotations = matrix_from_rotation_6d(self.rotation_6d[frames].astype(np.float64))
        root_position = self.root_position[frames].astype(np.float64)
        return Motion(self.skeleton, root_position, rotations, FPS, self.clip_names[clip])


def pack(dataset: Dataset, *, progress: bool = True) -> PackedMotion:
    """Read all clips of a data set into one packed set of arrays.

    Clips shorter than one window (`MINIMUM_FRAMES`) are left out and listed in `skipped`, and so are broken files of a
    folder (`read_clips`).

    Args:
      dataset: from `open_dataset`.
      progress: show a progress bar.

    Returns:
      The packed arrays.

    Raises:
      ValueError: as `read_clips`, or if no clip is left.
    """
    kept, skipped = [], []
    for clip, motion in read_clips(dataset, skipped, progress=progress):
        rotations = rotation_6d_from_matrix(motion.needed_rotations("a packed data set")).astype(np.float16)
        root = motion.root_position.astype(np.float32)
        kept.append((clip, motion.skeleton, root, rotations, lowest_toe_height(motion)))
    if not kept:
        what = f"has no clip of at least {MINIMUM_FRAMES} frames; {len(skipped)} are left out"
        raise ValueError(f"data set {dataset.name!r} {what}")
    clips, skeletons, root_positions, rotations, floors = zip(*kept, strict=True)
    return PackedMotion(
        **{field.name: getattr(dataset, field.name) for field in fields(DataCard)}, skeleton=skeletons[0],
        root_position=np.concatenate(root_positions), rotation_6d=np.concatenate(rotations),
        clip_start=np.cumsum([0, *map(len, root_positions)]).astype(np.int32),
        clip_names=tuple(clip.name for clip in clips), clip_contents=tuple(clip.content for clip in clips),
        clip_style=np.array([dataset.styles.index(clip.style) for clip in clips], np.int32),
        clip_split=np.array([SPLITS.index(clip.split) for clip in clips], np.uint8),
        floor_shift=np.array(floors, np.float32), skipped=tuple(skipped),
    )  # fmt: skip


def save_packed(path, packed: PackedMotion) -> Path:
    """Write a packed data set by `ground.trees`; return its path, which ends in ".safetensors" by custom."""
    parts = dict(vars(packed))
    skeleton = parts.pop("skeleton")
    arrays = {name: parts.pop(name) for name, part in vars(packed).items() if isinstance(part, np.ndarray)}
    # Bones are text, too: in float64, which JAX's arrays are not.
    texts = parts | {"offsets": skeleton.offsets.tolist(), "mirror_styles": sorted(packed.mirror_styles)}
    texts["dataset"] = texts.pop("name")  # as files of this format call it
    save_tree(path, arrays, {"kind": _KIND, **describe_skeleton(skeleton), **texts})
    return Path(path)


def load_packed(path) -> PackedMotion:
    """Read what `save_packed` wrote.

    Raises:
      ValueError: naming the file, if it is absent, truncated, altered or of another version.
    """
    with errors_name(path):
        arrays, about = load_tree(path, {}, rest=True)
        check_kind(about, _KIND)
        parts = {n: np.asarray(a) for n, a in arrays.items()} | {n: _tuples(v) for n, v in about.items()}
        parts |= {"name": about["dataset"], "mirror_styles": frozenset(about["mirror_styles"])}
        parts["skeleton"] = described_skeleton(about, about["offsets"])
        return PackedMotion(**{field.name: parts[field.name] for field in fields(PackedMotion)})


def _tuples(value):
    """Return JSON's lists as tuples, at every level."""
    return tuple(map(_tuples, value)) if isinstance(value, list) else value


def cache_folder() -> Path:
    """Return the folder of what was reckoned once (F3AMD_CACHE_DIR overrides)."""
    return Path(os.environ.get(CACHE_DIR_VARIABLE) or platformdirs.user_cache_path("f3amd") / "packed")


def cache_path(dataset: Dataset) -> Path:
    """Return where the packed form of a data set is cached."""
    # Earlier folders were packed without a look at units and axes.
    name = "people" if dataset.name == "folder" else dataset.name
    return cache_folder() / f"{name}-{dataset.fingerprint[:16]}-v{_FORMAT}.safetensors"


def packed_dataset(dataset: Dataset, *, progress: bool = True) -> PackedMotion:
    """Return the packed form of a data set: from the cache if it is there, else packed and kept.

    Args:
      dataset: from `open_dataset`; its fingerprint is the cache's key.
      progress: as in `pack`.

    Returns:
      The packed arrays.

    Raises:
      ValueError: naming a data file that is broken. A damaged cache file is packed anew, with a
        warning.
    """
    path = cache_path(dataset)
    if path.exists():
        try:
            return load_packed(path)
        except ValueError as error:
            warnings.warn(f"{error} (packing anew)", stacklevel=2)
    packed = pack(dataset, progress=progress)
    try:
        save_packed(path, packed)
    except OSError as error:
        warnings.warn(f"{path}: not kept ({error.strerror}); let F3AMD_CACHE_DIR name another folder", stacklevel=2)
    return packed
