"""Data sets by name: find or download, verify, and list clips with style and split.

| name | what | where from |
|---|---|---|
| `synthetic` | 100 styles of the procedural walker | made here, nothing to download |
| `bandai` | Bandai-Namco-Research-Motiondataset 1 and 2 | public archive, pinned commit |
| `100style` | 100STYLE, usable ranges only | Zenodo record 8127870 |
| `folder` | any folder (or zip) of BVH files | yours |

With the environment variable `F3AMD_DATA_DIR` set to a folder or a zip file, data is looked for
there and the network is never touched. Without it, archives are downloaded once into pooch's cache
folder. Archives are read in place. Every file is checked before it is parsed, so that a damaged one
is refused by name and none of its numbers get used.
"""

import contextlib
import functools
import hashlib
import io
import json
import os
import re
import unicodedata
import warnings
import zipfile
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath
from typing import NamedTuple

import numpy as np
import pandas as pd
from tqdm import tqdm

from f3amd_lib.ground import log
from f3amd_lib.ground.files import read_toml
from f3amd_lib.ground.left_out import leave_out
from f3amd_lib.ground.names import check_known
from f3amd_lib.ground.profiles import SHOWN_STYLES
from f3amd_lib.motion import synthetic
from f3amd_lib.motion.bvh import format_bvh, parse_bvh
from f3amd_lib.motion.plausible import as_person
from f3amd_lib.motion.retarget import retarget as put_on
from f3amd_lib.motion.skeleton import Motion, resample

_SETS = read_toml(Path(__file__).with_name("data_sets.toml"))
NAMES = tuple(_SETS)
SPLITS = ("train", "validation", "test")
FPS = 30.0
"""Frame rate of every clip, frames per second (paper section 4)."""

MINIMUM_FRAMES = 42
"""Shortest useful clip: 10 history and 32 future frames (paper section 3.2)."""

DATA_DIR_VARIABLE = "F3AMD_DATA_DIR"


@dataclass(frozen=True)
class Clip:
    """One take of one style.

    Attributes:
      name: unique within its data set.
      style: style label, one of the data set's `styles`.
      content: what is done in it, such as "walk" or "FW"; may be empty.
      split: "train", "validation" or "test".
      loader: callable without arguments that returns the motion.
      person: of a stranger's motion, what `as_person` takes; None for motion that we know.
    """

    name: str
    style: str
    content: str
    split: str
    loader: Callable[[], Motion] = field(repr=False)
    person: Mapping | None = None

    def load(self, fps: float = FPS) -> Motion:
        """Read, verify and return the motion at 30 fps in metres; ValueError names a bad file."""
        return self.load_noted(fps)[0]

    def load_noted(self, fps: float = FPS) -> tuple[Motion, list[str]]:
        """Return what `load` does, and notes on what had to be corrected."""
        motion, notes = self.loader(), []
        if self.person is not None:
            motion, notes = as_person(motion, **self.person)
        return resample(motion, fps, smooth=True).replace(name=self.name), notes


@dataclass(frozen=True, eq=False)
class DataCard:
    """What is known of a data set beside its motion, and the terms under which it may be used.

    Attributes:
      name: one of `NAMES`.
      licence, credit: terms of the motion data and the line that names its makers.
      fingerprint: SHA-256 (hex) of everything that decides what the clips hold.
      styles: labels in sorted order; the index is the one-hot position (paper section 3.3).
      primary_styles: classes that carry evaluation per style.
      mirror_styles: styles that stay themselves when left and right are swapped.
    """

    name: str
    licence: str
    credit: str
    fingerprint: str
    styles: tuple[str, ...]
    primary_styles: tuple[str, ...]
    mirror_styles: frozenset[str]


@dataclass(frozen=True)
class Dataset(DataCard):
    """Clips with their styles and splits.

    Attributes:
      clips: all takes, sorted by name.
      retarget: bring all clips to the skeleton of the first.
    """

    clips: tuple[Clip, ...]
    retarget: bool = False


def open_dataset(
    name: str, *, path=None, locomotion_only: bool = True, seconds_per_style: float = 60.0,
    num_styles: int | None = None, retarget: bool = False, scale: float | None = None, up: str | None = None,
    keep_first: bool = False, joint_map: Mapping[str, str] | None = None,
) -> Dataset:  # fmt: skip
    """Open a data set by name: find or download it, verify it and list its clips.

    Args:
      name: "synthetic", "bandai", "100style" or "folder".
      path: a folder or zip to read from; it wins over `F3AMD_DATA_DIR` and the network.
      locomotion_only: bandai only: leave out bows, waves, dances and the like.
      seconds_per_style: synthetic only: motion per style, shared out over several takes.
      num_styles: keep only so many styles (primary ones first, then by name); None keeps all.
      retarget: folder only: bring several people's motion to the skeleton of the first clip.
      scale, up, keep_first, joint_map: folder only, as in `as_person`.

    Returns:
      The data set. Numbers are read by `Clip.load`.

    Raises:
      ValueError: for an unknown name, or for data that is absent, broken, truncated or altered:
        naming the file and what to do.
    """
    check_known(name, NAMES, "data set")
    if num_styles is not None and num_styles < 1:
        raise ValueError(f"num_styles must be at least 1, got {num_styles}")
    person = {"scale": scale, "up": up, "keep_first": keep_first, "joint_map": joint_map or {}}
    if name != "folder" and (retarget or any(person.values())):
        raise ValueError(f"retarget, {', '.join(person)} are for a folder, not for data set {name!r}: leave them out")
    if name == "synthetic":
        dataset = _open_synthetic(seconds_per_style, num_styles)
    elif name == "bandai":
        dataset = _open_bandai(path, locomotion_only)
    else:
        dataset = _open_100style(path) if name == "100style" else _open_folder(path, retarget, person)
    dataset = dataset if num_styles is None else _keep_styles(dataset, num_styles)
    return replace(dataset, retarget=retarget)


def read_clips(
    dataset: Dataset, skipped: list[tuple[str, str]], *, fps: float = FPS, fewest: int = MINIMUM_FRAMES, progress=True
) -> Iterator[tuple[Clip, Motion]]:
    """Read the clips of a data set one after the other; at the end, say what was corrected or left out.

    A data set that we know stops at its first broken file: fetch it again. Of a folder, broken files are left out.

    Args:
      dataset: from `open_dataset`.
      skipped: takes (clip name, reason) of those left out.
      fps: wanted rate.
      fewest: frames of a clip; shorter ones are left out.
      progress: show a progress bar, where there is a terminal.

    Yields:
      (clip, motion), all of one skeleton.

    Raises:
      ValueError: naming a file that is broken, or of a folder a fifth of them; or skeletons that differ.
    """
    first, broken, notes = None, [], {}
    every = tqdm(dataset.clips, f"reading {dataset.name}", unit="clip", disable=None if progress else True)
    for clip in every:
        try:
            motion, noted = clip.load_noted(fps)
            if motion.num_frames < fewest:
                skipped.append((clip.name, f"{motion.num_frames} frames, shorter than {fewest}"))
                continue
            first = first or motion
            if motion.skeleton != first.skeleton and dataset.retarget:
                motion, _, off = put_on(motion, first)
                noted.append(f"retargeted: joints are off by {off.mean():.1f} cm on average")
        except ValueError as error:
            if clip.person is None:
                raise
            broken.append((clip.name, str(error)))
            continue
        if motion.skeleton != first.skeleton:
            what = f"its skeleton differs from that of {first.name} in names, parents or bone lengths"
            how = "pass --retarget (retarget=True) to bring all to one, or remove the file"
            raise ValueError(f"{clip.name}: {what}; a data set needs one: {how}")
        for note in noted:
            notes.setdefault(note.partition(":")[0], []).append(f"{note} ({clip.name})")
        yield clip, motion
    for noted in notes.values():
        log.warning("%s: %d of %d clips: %s", dataset.name, len(noted), len(dataset.clips), noted[0])
    skipped += broken
    leave_out(dataset.name, broken, len(dataset.clips))


def assign_splits(strata: Iterable[tuple[str, object]], percent: tuple[int, int] = (10, 10)) -> dict[str, str]:
    """Share clips out over train, validation and test: 80, 10 and 10 % of each stratum by default.

    A stratum's clips are ordered by the SHA-256 of their names, so that the answer depends on names
    alone and is the same on every machine. Three clips or more give at least one to each split.

    Args:
      strata: (clip name, stratum) pairs; a stratum is a style or anything else hashable.
      percent: shares of validation and test.

    Returns:
      Split by clip name.
    """
    members: dict[object, list[str]] = {}
    for name, stratum in strata:
        members.setdefault(stratum, []).append(name)
    splits = {}
    for names in members.values():
        ranked = sorted(names, key=lambda name: hashlib.sha256(name.encode("utf-8")).digest())
        shares = [max(1, (len(ranked) * share + 50) // 100) if len(ranked) >= 3 else 0 for share in percent]
        for rank, name in enumerate(ranked):
            splits[name] = SPLITS[1 if rank < shares[0] else 2 if rank < sum(shares) else 0]
    return splits


# --- archives -------------------------------------------------------------------------------------


_READ = (".bvh", ".csv")  # endings of the files that are read
_MOST_FILES, _MOST_BYTES, _MOST_IN_ALL, _MOST_RATIO = 100_000, 1 << 29, 1 << 35, 200
"""Limits on archives: files, bytes of one and of all, and how much one may grow. (100STYLE: 810 files, some 4 GB
in all, of 17 MB at most; text of numbers shrinks 3 to 5 times, of still frames up to 100 times.)"""


class _File(NamedTuple):
    """A file of a folder or of a zip, read alike.

    Attributes:
      label: where it lies, for messages.
      reader: returns its bytes.
      listed: what a zip's directory says of it.
    """

    label: str
    reader: Callable[[], bytes]
    listed: zipfile.ZipInfo | None = None

    def read(self) -> bytes:
        """Return the bytes; ValueError names the file if they cannot be had."""
        try:
            return self.reader()
        except Exception as error:  # whatever a damaged member of a zip, or a file that went away, raises
            raise ValueError(f"{self.label}: damaged and not used ({error}); fetch the file again") from error

    def size_and_crc(self) -> tuple[int, int]:
        """Return size and CRC-32: from a zip's directory, or by reading a plain file."""
        if self.listed:
            return self.listed.file_size, self.listed.CRC
        data = self.read()
        return len(data), zlib.crc32(data)


def _open_zip(path: Path) -> zipfile.ZipFile:
    """Open a zip, which stays open for as long as one of its files may be read."""
    try:
        try:  # names without a mark of their encoding are mostly UTF-8, else as the format has it (cp437)
            opened = zipfile.ZipFile(path, metadata_encoding="utf-8")
        except UnicodeDecodeError:
            opened = zipfile.ZipFile(path)
    # Also what a forged directory raises: ValueError, NotImplementedError, struct.error, ...
    except Exception as error:
        raise ValueError(f"{path}: broken or truncated zip archive ({error}); fetch it again") from error
    members = [info for info in opened.infolist() if info.filename.lower().endswith(_READ)]
    total = sum(info.file_size for info in members)
    swollen = any(info.file_size > min(_MOST_BYTES, _MOST_RATIO * max(info.compress_size, 5000)) for info in members)
    if swollen or total > _MOST_IN_ALL or len(members) > _MOST_FILES:
        what = f"{len(members)} files of {total / 1e9:.1f} GB, or one of them, grow more than motion does"
        raise ValueError(f"{path}: refused before anything was unpacked: {what}; unpack it yourself if you trust it")
    return opened


def _list_files(place: Path) -> dict[str, _File]:
    """Return the files that are read by their relative paths, sorted, without macOS's `._` forks and `__MACOSX`."""
    if place.is_file():
        opened = _open_zip(place)
        found = {info.filename: (functools.partial(opened.read, info), info) for info in opened.infolist()}
    else:
        found = {item.relative_to(place).as_posix(): (item.read_bytes,) for item in place.rglob("*") if item.is_file()}
    paths = {name: PurePosixPath(name) for name in sorted(found)}
    real = lambda path: not path.name.startswith("._") and "__MACOSX" not in path.parts
    read = (name for name, path in paths.items() if path.suffix.lower() in _READ and real(path))
    return {name: _File(f"{place}: {name}", *found[name]) for name in read}


def _find_files(name: str, path) -> tuple[Path, dict[str, _File]]:
    """Choose where a data set is read from: `path`, then F3AMD_DATA_DIR, then the download; list what is there.

    In a folder the zip with the data set's name in its own wins over unpacked files.
    """
    place = Path(path or os.environ.get(DATA_DIR_VARIABLE) or _download(name)).expanduser()
    if not place.exists():
        raise ValueError(f"{place}: there is no such file or folder; check the path")
    if place.is_file() and place.suffix.lower() in _READ:
        raise ValueError(f"{place}: is a single file; give its folder")
    if place.is_dir() and name != "folder":
        zips = [item for item in sorted(place.glob("[!.]*.[zZ][iI][pP]")) if name in item.name.lower()]
        if len(zips) > 1:
            what = f"several archives may be meant ({', '.join(item.name for item in zips)})"
            raise ValueError(f"{place}: {what}; point {DATA_DIR_VARIABLE} (or path=...) at one of them")
        place = (zips or [place])[0]
    return place, _list_files(place)


def _by_stem(files: Mapping[str, _File]) -> dict[str, _File]:
    """Return files by their names without folder and ending."""
    return {PurePosixPath(name).stem: file for name, file in files.items()}


def _download(name: str) -> str:
    """Fetch a data set's archive once into pooch's cache, with a progress bar; return where it lies."""
    import pooch  # asks notebooks for a widget when it is imported

    published, folder = _SETS[name], pooch.os_cache("f3amd")
    if "url" not in published:
        how = f"name its folder or zip by --source (path=...), or set {DATA_DIR_VARIABLE}"
        raise ValueError(f"data set {name!r} has no download: {how}")
    pooch.get_logger().setLevel("WARNING")
    url, digest, file = published["url"], published.get("hash"), published["file"]
    try:
        return pooch.retrieve(url, digest, fname=file, path=folder, progressbar=True)
    except (OSError, ValueError) as error:  # requests' errors are OSErrors
        what = f"{url}: data set {name!r} could not be downloaded ({type(error).__name__}: {error})"
        how = f"fetch it by other means and set the environment variable {DATA_DIR_VARIABLE} to the zip or its folder"
        raise ValueError(f"{what}; {how}") from error


# --- data sets ------------------------------------------------------------------------------------


def _dataset(name: str, clips: Iterable[Clip], content, *, primary=None, mirror) -> Dataset:
    """Put a data set together.

    Args:
      name: one of `NAMES`.
      clips: all takes, sorted by name.
      content: what identifies the contents of its files, JSON-ready.
      primary, mirror: tell of a style whether it is a primary one (None: all are), may be mirrored.
    """
    clips = tuple(clips)
    styles = tuple(sorted({clip.style for clip in clips}))
    labels = [(clip.name, clip.style, clip.content, clip.split) for clip in clips]
    decisive = json.dumps([name, labels, content], ensure_ascii=True)
    return Dataset(
        name=name, licence=_SETS[name]["licence"], credit=_SETS[name]["credit"],
        fingerprint=hashlib.sha256(decisive.encode("ascii")).hexdigest(), styles=styles, clips=clips,
        primary_styles=styles if primary is None else tuple(filter(primary, styles)),
        mirror_styles=frozenset(filter(mirror, styles)),
    )  # fmt: skip


def _keep_styles(dataset: Dataset, num_styles: int) -> Dataset:
    """Return the data set cut down to its first styles, primary ones before others."""
    others = [style for style in dataset.styles if style not in dataset.primary_styles]
    kept = [*dataset.primary_styles, *others][:num_styles]
    clips = (clip for clip in dataset.clips if clip.style in kept)
    primary, mirror = dataset.primary_styles.__contains__, dataset.mirror_styles.__contains__
    return _dataset(dataset.name, clips, dataset.fingerprint, primary=primary, mirror=mirror)


# --- loaders --------------------------------------------------------------------------------------


def _read_take(file: _File, expected: tuple[int, int], sha256_prefix="", cut=None) -> Motion:
    """Read one file, check its bytes, and cut a range of 30 fps frames out."""
    data, label = file.read(), file.label
    sound = (len(data), zlib.crc32(data)) == expected
    if not (sound and hashlib.sha256(data).hexdigest().startswith(sha256_prefix)):
        raise ValueError(f"{label}: is not the expected file and was not used; fetch the file again")
    motion = parse_bvh(data, label)
    if cut is None:
        return motion
    motion = resample(motion, FPS)
    if cut[1] > motion.num_frames:
        what = f"has {motion.num_frames} frames at 30 fps, but Frame_Cuts.csv cuts it at {cut[1]}"
        raise ValueError(f"{label}: {what}; the file or the table is not the original: fetch both again")
    return motion.slice(*cut)


def _synthetic_take(style: str, seconds: float, seed: int) -> Motion:
    """Make one take of the synthetic walker and send it through BVH text, as all data."""
    motion = synthetic.synthesize(style, seconds=seconds, seed=seed, fps=FPS)
    return parse_bvh(format_bvh(motion), f"synthetic {style}, seed {seed}")


# --- the four data sets ---------------------------------------------------------------------------


def _open_synthetic(seconds_per_style: float, num_styles: int | None) -> Dataset:
    """List takes of about ten seconds: one long take would leave nothing to split by clip."""
    shortest = 3 * MINIMUM_FRAMES / FPS
    if not shortest <= seconds_per_style < float("inf"):
        what = f"at least {shortest:.1f} (three takes of {MINIMUM_FRAMES} frames)"
        raise ValueError(f"seconds_per_style must be {what}, got {seconds_per_style}")
    num_takes = max(3, round(seconds_per_style / 10.0))
    seconds = seconds_per_style / num_takes
    # A few styles are those that pictures show; all of them are in alphabetical order either way.
    others = [style for style in synthetic.STYLES if style not in SHOWN_STYLES]
    styles = tuple(sorted([*SHOWN_STYLES, *others][:num_styles]))
    takes = [(f"{style}_{seed:03d}", style, seed) for style in styles for seed in range(num_takes)]
    splits = assign_splits((name, style) for name, style, _ in takes)
    clips = [
        Clip(name, style, "mixed", splits[name], functools.partial(_synthetic_take, style, seconds, seed))
        for name, style, seed in takes
    ]
    return _dataset("synthetic", clips, [seconds, _synthetic_probe(styles)], mirror=synthetic.is_symmetric)


@functools.cache
def _synthetic_probe(styles: tuple[str, ...]) -> str:
    """Return a digest of motion that the walker makes: a changed walker is another data set.

    A second of each style, seed and path of its own, to a tenth of a millimetre: what is hashed is
    what the walker does, not how its source reads, and rounding differs on no machine.
    """
    digest = hashlib.sha256()
    for style in styles:
        positions = synthetic.synthesize(style, seconds=1.0, seed=0, fps=FPS).positions
        digest.update(np.round(1e4 * positions).astype("<i4").tobytes())
    return digest.hexdigest()


_BANDAI_FILES = Path(__file__).with_name("bandai_files.csv")


@functools.cache
def _bandai_list(path: Path) -> pd.DataFrame:
    """Return the committed list of files, by name: sizes and checksums at the pinned commit, and what names tell."""
    listed = pd.read_csv(path, dtype={"crc32": str, "sha256_prefix": str}).set_index("name", drop=False)
    # Data set, content, style and number; none of them holds an underscore.
    parts = listed["name"].str.split("_", expand=True)
    listed["content"] = parts[1]
    listed["style"] = parts[0].str.removeprefix("dataset-") + "-" + parts[2]
    walks = _SETS["bandai"]["locomotion"]
    listed["is_locomotion"] = [content in walks[part] for part, content in zip(parts[0], parts[1], strict=True)]
    return listed


def _open_bandai(path, locomotion_only: bool) -> Dataset:
    """List the Bandai clips of an archive; each file must agree with the committed list when it is read."""
    place, files = _find_files("bandai", path)
    known = _bandai_list(_BANDAI_FILES)
    listed = known[known["is_locomotion"]] if locomotion_only else known
    members = _by_stem(files)
    if missing := sorted(set(listed.index) - set(members)):
        what = f"{len(missing)} of the {len(listed)} Bandai files needed are missing, the first is {missing[0]}.bvh"
        raise ValueError(f"{place}: {what}; fetch the whole archive again")
    # Locomotion and other clips are split apart, so that a clip's split does not depend on
    # `locomotion_only`. Clips too short for a window reach no split at all once packed, so they
    # must not take a place in validation or test.
    long = known[known["frames"] >= MINIMUM_FRAMES]
    strata = zip(long["name"], zip(long["style"], long["is_locomotion"], strict=True), strict=True)
    splits = dict.fromkeys(known["name"], "train") | assign_splits(strata)
    clips = []
    for item in listed.sort_index().itertuples():
        expected = (item.size, int(item.crc32, 16))
        loader = functools.partial(_read_take, members[item.name], expected, item.sha256_prefix)
        clips.append(Clip(item.name, item.style, item.content, splits[item.name], loader))
    content = list(zip(listed["name"], listed["sha256_prefix"], strict=True))
    of_part_2 = lambda style: style.startswith("2-")
    return _dataset("bandai", clips, content, primary=of_part_2, mirror=lambda style: True)


_100STYLE_CODES = ("BR", "BW", "FR", "FW", "ID", "SR", "SW", "TR1", "TR2", "TR3")


def _open_100style(path) -> Dataset:
    """List the takes of 100STYLE inside the ranges of its Frame_Cuts.csv."""
    place, files = _find_files("100style", path)
    members = _by_stem(files)
    cuts = _read_frame_cuts(place, files)
    _, rows = _read_table(place, files, "Dataset_List.csv", ["Style Name", "Symmetric"])
    symmetric = set(rows["Style Name"][rows["Symmetric"].str.strip() == "Yes"].str.strip())
    # A transition take may be called TR for TR1, as in the author's own exporter.
    for style, _ in cuts:
        if f"{style}_TR1" not in members and f"{style}_TR" in members:
            members[f"{style}_TR1"] = members.pop(f"{style}_TR")
    # Splits come from the table, not from what is there: a missing file moves no other clip.
    splits = assign_splits((f"{style}_{code}", style) for style, code in cuts)
    clips, content = [], []
    for (style, code), (start, stop) in cuts.items():
        name = f"{style}_{code}"
        if name in members:
            # START and STOP count 60 fps frames. Halving the file and cutting at START//2, STOP//2 is
            # the same as cutting at even frames of the original and then halving.
            there, cut = members[name].size_and_crc(), (start // 2, stop // 2)
            loader = functools.partial(_read_take, members[name], there, cut=cut)
            clips.append(Clip(name, style, code, splits[name], loader))
            content.append((name, *there, start, stop))
    missing = [name for name in splits if name not in members]
    if not clips:
        what = f"none of the {len(missing)} files that Frame_Cuts.csv names is there"
        raise ValueError(f"{place}: {what}; fetch the whole of 100STYLE ({_SETS['100style']['url']})")
    if missing:
        what = f"{len(missing)} of {len(cuts)} takes of 100STYLE are missing, such as {missing[0]}.bvh"
        warnings.warn(f"{place}: {what}; the data set goes without them", stacklevel=3)
    clips.sort(key=lambda clip: clip.name)
    return _dataset("100style", clips, sorted(content), mirror=symmetric.__contains__)


def _read_table(place: Path, files: Mapping[str, _File], table: str, columns: list[str]) -> tuple[str, pd.DataFrame]:
    """Return where a table of 100STYLE lies, for messages, and these columns of it, as text."""
    found = [file for name, file in files.items() if PurePosixPath(name).name == table]
    if len(found) != 1:
        how = f"is there {len(found)} times" if found else "is missing"
        what = "the folder or zip must hold one copy of the data set, with its tables"
        raise ValueError(f"{place}: {table} of 100STYLE {how}; {what} ({_SETS['100style']['url']})")
    label, content = found[0].label, io.BytesIO(found[0].read())
    try:
        return label, pd.read_csv(content, usecols=columns, dtype=str, encoding="utf-8-sig", skip_blank_lines=False)
    except ValueError as error:
        raise ValueError(f"{label}: is not the expected table ({error}); fetch the file again") from error


def _read_frame_cuts(place: Path, files: Mapping[str, _File]) -> dict[tuple[str, str], tuple[int, int]]:
    """Return (style, code) -> (START, STOP), in 60 fps frames; absent ranges (N/A) are left out."""
    columns = ["STYLE_NAME", *(f"{code}_{end}" for code in _100STYLE_CODES for end in ("START", "STOP"))]
    (label, rows), cuts = _read_table(place, files, "Frame_Cuts.csv", columns), {}
    for line, row in enumerate(rows.to_dict("records"), start=2):
        for code in _100STYLE_CODES:
            style, start, stop = (str(row[name]).strip() for name in ("STYLE_NAME", f"{code}_START", f"{code}_STOP"))
            if start == stop == "nan":
                continue
            if not all(re.fullmatch("[0-9]{1,9}", frame) for frame in (start, stop)) or int(start) >= int(stop):
                what = f"{code} of {style} has the range {start[:20]!r} to {stop[:20]!r}"
                raise ValueError(f"{label}, line {line}: {what}; it needs two rising whole numbers, or N/A twice")
            cuts[style, code] = (int(start), int(stop))
    return cuts


def _open_folder(path, retarget: bool, person: Mapping) -> Dataset:
    """List every BVH file of a folder; style is the sub-folder, or the name up to a "_"."""
    place, files = _find_files("folder", path)
    labelled = {}
    for member, file in files.items():
        if not member.lower().endswith(".bvh"):
            continue
        name = unicodedata.normalize("NFC", PurePosixPath(member).with_suffix("").as_posix())
        if name in labelled:
            raise ValueError(f"{file.label}: two files differ only in the case of their suffix; rename one")
        *_, style, content = ("", *name.split("/"))
        if not style:
            style, _, content = content.partition("_")
        labelled[name] = (file, style, content)
    if not labelled:
        raise ValueError(f"{place}: holds no .bvh file; choose a folder with motion files")
    splits = assign_splits((name, style) for name, (_, style, _) in labelled.items())
    clips, identities = [], []
    for name, (file, style, content) in sorted(labelled.items()):
        there = (0, 0)
        with contextlib.suppress(ValueError):  # said when it is read
            there = file.size_and_crc()
        loader = functools.partial(_read_take, file, there)
        clips.append(Clip(name, style, content, splits[name], loader, person))
        identities.append((name, *there))
    # As before, where nothing is asked for: trainings go on.
    asked = {key: value for key, value in (person | {"retarget": retarget}).items() if value}
    # Whether a style keeps its name when mirrored is not for us to guess.
    return _dataset("folder", clips, [identities, asked] if asked else identities, mirror=lambda style: False)
