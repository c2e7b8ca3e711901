"""Data sets by name: finding, verifying, refusing, splitting."""

import collections
import dataclasses
import hashlib
import shutil
import zipfile
import zlib
from pathlib import Path

import numpy as np
import pooch
import pytest
from builders import refused

from f3amd_lib.data import sources
from f3amd_lib.data.packed import pack
from f3amd_lib.data.sources import DATA_DIR_VARIABLE, assign_splits, open_dataset
from f3amd_lib.motion import synthetic
from f3amd_lib.motion.bvh import write_bvh


def line_bvh(frames: int, *, step_cm: float = 1.0, frame_time: str = "0.016667") -> str:
    """A pelvis with two legs that glides along +X by `step_cm` a frame, from 0."""
    rows = "\n".join(f"{step_cm * frame:g} 90 0 0 0 0" for frame in range(frames))
    return (
        "HIERARCHY\nROOT Hips\n{\nOFFSET 0 0 0\n"
        "CHANNELS 6 Xposition Yposition Zposition Yrotation Xrotation Zrotation\n"
        "JOINT LeftHip { OFFSET 10 0 0 CHANNELS 0 JOINT LeftToe { OFFSET 0 -88 0 CHANNELS 0 } }\n"
        "JOINT RightHip { OFFSET -10 0 0 CHANNELS 0\nJOINT RightToe { OFFSET 0 -88 0 CHANNELS 0 }"
        "}\n"
        f"}}\nMOTION\nFrames: {frames}\nFrame Time: {frame_time}\n{rows}\n"
    )


def zip_folder(folder: Path, target: Path, prefix: str = "") -> Path:
    with zipfile.ZipFile(target, "w", zipfile.ZIP_DEFLATED) as archive:
        for item in sorted(folder.rglob("*")):
            if item.is_file():
                archive.write(item, prefix + item.relative_to(folder).as_posix())
    return target


def packed_as(packing: str, folder: Path, target: Path, prefix: str = "") -> Path:
    """The folder itself, a zip of it, or the folder that such a zip lies in."""
    if packing == "folder":
        return folder
    target.parent.mkdir()
    zipped = zip_folder(folder, target, prefix)
    return zipped if packing == "zip itself" else zipped.parent


# --- names and splits -----------------------------------------------------------------------------


def test_unknown_names_are_refused():
    refused("unknown data set 'bandia'; did you mean 'bandai'", open_dataset, "bandia")
    refused("num_styles must be at least 1", open_dataset, "synthetic", num_styles=0)


def test_splits_are_the_same_everywhere():
    names = [f"walk_{number:03d}" for number in range(20)]
    splits = assign_splits((name, "walk") for name in names)
    # Fixed by SHA-256 of the names; written down so that no later change moves a clip unnoticed.
    assert [n for n in names if splits[n] == "validation"] == ["walk_011", "walk_014"]
    assert [n for n in names if splits[n] == "test"] == ["walk_015", "walk_019"]
    assert assign_splits((name, "walk") for name in reversed(names)) == splits


@pytest.mark.parametrize("count, held_out", [(1, 0), (2, 0), (3, 1), (7, 1), (14, 1), (15, 2), (25, 3), (100, 10)])
def test_splits_are_stratified(count, held_out):
    pairs = [(f"{style}_{number}", style) for style in "ab" for number in range(count)]
    splits = assign_splits(pairs)
    for style in "ab":
        found = collections.Counter(splits[name] for name, label in pairs if label == style)
        assert found["validation"] == found["test"] == held_out
        assert found["train"] == count - 2 * held_out


# --- synthetic ------------------------------------------------------------------------------------


def test_synthetic_takes(no_network):
    from f3amd_lib.motion.synthetic import STYLES, synthesize

    dataset = open_dataset("synthetic")
    assert dataset.styles == tuple(sorted(STYLES)) and len(dataset.styles) == 100
    assert dataset.primary_styles == dataset.styles
    assert len(dataset.clips) == 600
    by_style = collections.defaultdict(list)
    for clip in dataset.clips:
        by_style[clip.style].append(clip.split)
    for splits in by_style.values():
        assert sorted(splits) == ["test", "train", "train", "train", "train", "validation"]
    assert "Neutral" in dataset.mirror_styles and "LimpLeft" not in dataset.mirror_styles
    clip = next(clip for clip in dataset.clips if clip.name == "LongStrides_003")
    motion = clip.load()
    assert (motion.name, motion.fps, motion.num_frames) == ("LongStrides_003", 30.0, 300)
    direct = synthesize("LongStrides", seconds=10.0, seed=3)
    assert np.abs(motion.positions - direct.positions).max() < 1e-4


# --- folder ---------------------------------------------------------------------------------------


def test_folder_of_bvh(tmp_path, monkeypatch, no_network):
    for name, frames in [("happy/a.bvh", 50), ("happy/b.BVH", 51), ("sad_walk_01.bvh", 52)]:
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(line_bvh(frames, frame_time="0.0333333"))
    (tmp_path / "happy" / "._a.bvh").write_bytes(b"\x00\x05\x16\x07")
    (tmp_path / "notes.txt").write_text("not motion")
    dataset = open_dataset("folder", path=tmp_path)
    found = [(clip.name, clip.style, clip.content) for clip in dataset.clips]
    assert found == [("happy/a", "happy", "a"), ("happy/b", "happy", "b"), ("sad_walk_01", "sad", "walk_01")]
    assert dataset.styles == ("happy", "sad")
    assert dataset.mirror_styles == frozenset()
    assert [clip.load().num_frames for clip in dataset.clips] == [50, 51, 52]

    zipped = zip_folder(tmp_path / "happy", tmp_path / "mine.zip", prefix="happy/")
    from_zip = open_dataset("folder", path=zipped)
    assert [clip.name for clip in from_zip.clips] == ["happy/a", "happy/b"]

    monkeypatch.setenv(DATA_DIR_VARIABLE, str(tmp_path))
    again = open_dataset("folder")
    assert again.fingerprint == dataset.fingerprint
    (tmp_path / "happy" / "a.bvh").write_text(line_bvh(50, step_cm=2.0, frame_time="0.0333333"))
    assert open_dataset("folder").fingerprint != dataset.fingerprint
    # The data set opened before knows that its file is no longer the same.
    refused(r"a\.bvh: is not the expected file", again.clips[0].load)


def test_folder_needs_a_place_and_files(tmp_path, monkeypatch):
    monkeypatch.delenv(DATA_DIR_VARIABLE, raising=False)
    refused(f"set {DATA_DIR_VARIABLE}", open_dataset, "folder")
    refused("holds no .bvh file", open_dataset, "folder", path=tmp_path)
    refused("absent: there is no such file or folder", open_dataset, "folder", path=tmp_path / "absent")


def test_a_broken_file_is_named_on_loading(tmp_path):
    (tmp_path / "x_1.bvh").write_text(line_bvh(50).replace("\n7 90", "\nseven 90"))
    (clip,) = open_dataset("folder", path=tmp_path).clips
    refused(r"x_1\.bvh, line 20: 'seven'", clip.load)


def write_people(folder: Path, sizes, scale: float = 1.0) -> Path:
    """The same walk of 2 s by people of these sizes, in centimetres times a scale."""
    folder.mkdir(exist_ok=True)
    for number, size in enumerate(sizes):
        motion = synthetic.synthesize("Neutral", seconds=2.0, seed=0)
        size = size * scale
        offsets, root = size * np.asarray(motion.skeleton.offsets), size * np.asarray(motion.root_position)
        skeleton = dataclasses.replace(motion.skeleton, offsets=offsets, end_sites=())
        write_bvh(folder / f"walk_{number}.bvh", motion.replace(skeleton=skeleton, root_position=root))
    return folder


@pytest.mark.parametrize("broken, message", [(1, "1 of 6 records are broken"), (2, "2 of 6 records are broken, more")])
def test_one_broken_file_of_a_folder_is_left_out_and_many_are_refused(tmp_path, caplog, broken, message):
    write_people(tmp_path, [1.0] * 6)
    for number in range(broken):
        (tmp_path / f"walk_{number}.bvh").write_text("HIERARCHY\nRUBBISH\n")
    dataset = open_dataset("folder", path=tmp_path)
    if broken > 1:
        return refused(f"{message}.*walk_1", pack, dataset, progress=False)
    packed = pack(dataset, progress=False)
    assert packed.clip_names == tuple(f"walk_{number}" for number in range(1, 6))
    assert "MOTION" in dict(packed.skipped)["walk_0"] and message in caplog.text and "walk_0: " in caplog.text


def test_metres_are_recognised_in_a_folder_and_said_once(tmp_path, caplog):
    packed = pack(open_dataset("folder", path=write_people(tmp_path, [1.0] * 6, 0.01)), progress=False)
    assert 0.7 < packed.root_position[:, 1].mean() < 1.2
    assert caplog.text.count("read in metres") == 1 and "6 of 6 clips" in caplog.text
    told = open_dataset("folder", path=tmp_path, scale=0.5)
    assert told.fingerprint != open_dataset("folder", path=tmp_path).fingerprint
    assert told.clips[0].load().root_position[0, 1] == pytest.approx(packed.root_position[0, 1] / 2, rel=1e-3)
    refused("are for a folder", open_dataset, "synthetic", scale=0.5)


def test_several_people_are_brought_to_one_skeleton_if_asked(tmp_path):
    write_people(tmp_path, [1.0, 1.1, 0.9])
    refused("walk_1: its skeleton differs from that of walk_0.*--retarget", pack, open_dataset("folder", path=tmp_path))
    packed = pack(open_dataset("folder", path=tmp_path, retarget=True), progress=False)
    own = pack(open_dataset("folder", path=write_people(tmp_path / "one", [1.0])), progress=False)
    assert packed.num_clips == 3 and packed.skeleton == own.skeleton
    for clip in (1, 2):
        np.testing.assert_allclose(packed.motion(clip).positions, packed.motion(0).positions, atol=0.02)


@pytest.mark.parametrize("raw", [b"l\xc3\xa4ufer", b"l\x84ufer"])
def test_names_in_a_zip_without_the_mark_of_utf8(tmp_path, raw):
    (tmp_path / "a.bvh").write_text(line_bvh(50))
    path, stand_in = tmp_path / "a.zip", b"X" * len(raw)
    with zipfile.ZipFile(path, "w") as archive:
        archive.write(tmp_path / "a.bvh", f"{stand_in.decode()}/a.bvh")
    path.write_bytes(path.read_bytes().replace(stand_in, raw))
    dataset = open_dataset("folder", path=path)
    assert dataset.styles == ("läufer",) and dataset.clips[0].load().num_frames > 1


# --- 100STYLE, on a tiny tree ---------------------------------------------------------------------

CODES = ("BR", "BW", "FR", "FW", "ID", "SR", "SW", "TR1", "TR2", "TR3")


def write_100style(top: Path, *, dash: str = "–") -> Path:
    """Two styles with three takes each, as the release lays them out, macOS's debris included.

    Frame f of a file stands at x = f cm, so that a clip shows which frames were cut out.
    """
    folder = top / "100STYLE"
    ranges = {"FW": (21, 181), "ID": (20, 120), "TR1": (0, 200)}
    header = ",".join(["STYLE_NAME", *(f"{code}_{end}" for code in CODES for end in ("START", "STOP"))])
    rows = [header]
    for style in ("Aeroplane", "LimpLeft"):
        cells = [str(value) for code in CODES for value in ranges.get(code, ("N/A", "N/A"))]
        rows.append(",".join([style, *cells]))
        (folder / style).mkdir(parents=True)
        for code in ranges:
            (folder / style / f"{style}_{code}.bvh").write_text(line_bvh(200))
            (folder / style / f"._{style}_{code}.bvh").write_bytes(b"\x00\x05\x16\x07\x00")
    (folder / "Frame_Cuts.csv").write_text("\n".join(rows) + "\n")
    (folder / "Dataset_List.csv").write_text(
        "Style Name,Description,Stochastic,Symmetric,Notes\n"
        f"Aeroplane,Both arms raised as wings {dash} tilting,No,Yes,\n"
        "LimpLeft,Limping on the left leg,No,No,Shorter script\n",
        encoding="utf-8",
    )
    debris = top / "__MACOSX" / "100STYLE"
    debris.mkdir(parents=True)
    shutil.copy(folder / "Frame_Cuts.csv", debris / "Frame_Cuts.csv")
    (debris / "LimpLeft_FW.bvh").write_bytes(b"\x00\x05\x16\x07")
    return folder


@pytest.mark.parametrize("packing", ["folder", "zip in a folder", "zip itself"])
def test_100style_tree(tmp_path, monkeypatch, no_network, packing):
    write_100style(tmp_path / "tree")
    place = packed_as(packing, tmp_path / "tree", tmp_path / "zips" / "100STYLE.zip")
    monkeypatch.setenv(DATA_DIR_VARIABLE, str(place))
    dataset = open_dataset("100style")
    assert dataset.styles == ("Aeroplane", "LimpLeft")
    assert dataset.mirror_styles == {"Aeroplane"}
    assert dataset.licence == "CC BY 4.0"
    assert [(clip.name, clip.style, clip.content) for clip in dataset.clips] == [
        (f"{style}_{code}", style, code) for style in ("Aeroplane", "LimpLeft") for code in ("FW", "ID", "TR1")
    ]
    for style in dataset.styles:
        splits = sorted(clip.split for clip in dataset.clips if clip.style == style)
        assert splits == ["test", "train", "validation"]
    walk, idle, transition = (clip.load() for clip in dataset.clips[:3])
    assert (walk.fps, walk.name) == (30.0, "Aeroplane_FW")
    # 60 fps frames 20, 22, ... 178: START//2 to STOP//2 of every second frame.
    np.testing.assert_allclose(walk.root_position[:, 0], np.arange(20, 180, 2) / 100)
    np.testing.assert_allclose(idle.root_position[:, 0], np.arange(20, 120, 2) / 100)
    assert transition.num_frames == 100
    assert dataset.fingerprint == open_dataset("100style", path=tmp_path / "tree").fingerprint


def test_100style_missing_files_are_reported(tmp_path):
    folder = write_100style(tmp_path)
    before = {clip.name: clip.split for clip in open_dataset("100style", path=tmp_path).clips}
    (folder / "LimpLeft" / "LimpLeft_ID.bvh").unlink()
    with pytest.warns(UserWarning, match=r"1 of 6 takes .* such as LimpLeft_ID\.bvh"):
        dataset = open_dataset("100style", path=tmp_path)
    assert len(dataset.clips) == 5
    assert all(before[clip.name] == clip.split for clip in dataset.clips)
    shutil.rmtree(folder / "LimpLeft")
    shutil.rmtree(folder / "Aeroplane")
    refused("none of the 6 files", open_dataset, "100style", path=tmp_path)


@pytest.mark.parametrize(
    "old, new, message",
    [
        ("21,181", "181,21", r"line 2: FW of Aeroplane has the range '181' to '21'"),
        ("21,181", "21,N/A", r"line 2: FW of Aeroplane has the range '21' to 'nan'"),
        ("STYLE_NAME", "STYLE", "is not the expected table .*STYLE_NAME"),
    ],
)
def test_100style_broken_tables(tmp_path, old, new, message):
    path = write_100style(tmp_path) / "Frame_Cuts.csv"
    text = path.read_text(encoding="utf-8")
    assert old in text
    path.write_text(text.replace(old, new, 1), encoding="utf-8")
    refused(f"Frame_Cuts.csv.*{message}", open_dataset, "100style", path=tmp_path)


# --- Bandai: a small stand-in archive, so that damage can be done to it ---------------------------


@pytest.fixture
def small_bandai(tmp_path, monkeypatch) -> Path:
    """A folder laid out like the archive, with a list of files to match."""
    top = tmp_path / "bandai"
    listed = []
    for part, style in ((1, "angry"), (2, "normal")):
        folder = top / f"dataset/Bandai-Namco-Research-Motiondataset-{part}/data"
        folder.mkdir(parents=True)
        for number in range(1, 5):
            content = "bow" if number == 4 and part == 1 else "walk"
            name = f"dataset-{part}_{content}_{style}_{number:03d}"
            text = line_bvh(40 + 5 * number, step_cm=part, frame_time="0.0333333")
            (folder / f"{name}.bvh").write_text(text)
            data = text.encode()
            sums = f"{zlib.crc32(data):x},{hashlib.sha256(data).hexdigest()[:16]}"
            listed.append(f"{name},{40 + 5 * number},{len(data)},{sums}")
    files = tmp_path / "bandai_files.csv"
    files.write_text("\n".join(["name,frames,size,crc32,sha256_prefix", *listed]))
    monkeypatch.setattr(sources, "_BANDAI_FILES", files)
    return top


@pytest.mark.parametrize("packing", ["folder", "zip in a folder", "zip itself", "code host's zip"])
def test_bandai_from_folder_and_zip(small_bandai, tmp_path, monkeypatch, no_network, packing):
    prefix = "Bandai-Namco-Research-Motiondataset-74ead3b/" if "host" in packing else ""
    name = "Bandai-archive.zip" if prefix else "bandai_namco.zip"
    place = packed_as(packing, small_bandai, tmp_path / "zips" / name, prefix)
    monkeypatch.setenv(DATA_DIR_VARIABLE, str(place))
    dataset = open_dataset("bandai")
    assert dataset.styles == ("1-angry", "2-normal")
    assert dataset.primary_styles == ("2-normal",)
    assert dataset.mirror_styles == {"1-angry", "2-normal"}
    assert dataset.licence == "CC BY-NC 4.0" and "Bandai Namco Research" in dataset.credit
    angry, normal = (f"dataset-1_walk_angry_00{k}" for k in "123"), (f"dataset-2_walk_normal_00{k}" for k in "1234")
    assert [clip.name for clip in dataset.clips] == [*angry, *normal]
    clip = dataset.clips[1]
    assert (clip.style, clip.content) == ("1-angry", "walk")
    motion = clip.load()
    assert (motion.fps, motion.num_frames) == (30.0, 50)
    np.testing.assert_allclose(motion.root_position[-1], [0.49, 0.9, 0.0])

    whole = open_dataset("bandai", locomotion_only=False)
    assert len(whole.clips) == 8 and whole.fingerprint != dataset.fingerprint
    splits = {clip.name: clip.split for clip in whole.clips}
    assert all(splits[clip.name] == clip.split for clip in dataset.clips)
    assert dataset.fingerprint == open_dataset("bandai", path=small_bandai).fingerprint

    primary = open_dataset("bandai", num_styles=1)
    assert primary.styles == ("2-normal",) and len(primary.clips) == 4


def test_bandai_refuses_missing_files(small_bandai):
    next(small_bandai.rglob("dataset-1_walk_angry_001.bvh")).unlink()
    refused(r"1 of the 7 .* missing, the first is dataset-1_walk_angry", open_dataset, "bandai", path=small_bandai)


def test_bandai_refuses_a_tampered_file_by_name(small_bandai, tmp_path):
    walk = next(small_bandai.rglob("dataset-2_walk_normal_002.bvh"))
    text = walk.read_text()
    walk.write_text(text.replace("\n20 90", "\n21 90"))  # the same size, another number
    zipped = zip_folder(small_bandai, tmp_path / "bandai_namco.zip")
    for place in (small_bandai, zipped):
        clip = next(clip for clip in open_dataset("bandai", path=place).clips if clip.name.endswith("normal_002"))
        refused(r"normal_002\.bvh: is not the expected file", clip.load)


@pytest.mark.parametrize("share", [0.0, 0.3, 0.7, 0.999])
def test_bandai_refuses_a_truncated_zip_by_name(small_bandai, tmp_path, share):
    zipped = zip_folder(small_bandai, tmp_path / "bandai_namco.zip")
    data = zipped.read_bytes()
    zipped.write_bytes(data[: int(share * len(data))])
    refused(r"bandai_namco\.zip: broken or truncated zip archive", open_dataset, "bandai", path=tmp_path)


def test_several_archives_are_not_guessed_between(small_bandai, tmp_path):
    zip_folder(small_bandai, tmp_path / "bandai-a.zip")
    zip_folder(small_bandai, tmp_path / "bandai-b.zip")
    refused(r"several archives may be meant \(bandai-a\.zip, bandai-b", open_dataset, "bandai", path=tmp_path)


# --- the network ----------------------------------------------------------------------------------


def test_data_dir_without_the_data_is_an_error_and_no_download(tmp_path, monkeypatch, no_network):
    monkeypatch.setenv(DATA_DIR_VARIABLE, str(tmp_path))
    refused(r"1067 of the 1067 Bandai files needed are missing", open_dataset, "bandai")
    refused(r"Frame_Cuts\.csv of 100STYLE is missing", open_dataset, "100style")
    monkeypatch.setenv(DATA_DIR_VARIABLE, str(tmp_path / "absent"))
    refused("absent: there is no such file or folder", open_dataset, "bandai")


def test_downloads_are_pinned(small_bandai, tmp_path, monkeypatch):
    monkeypatch.delenv(DATA_DIR_VARIABLE, raising=False)
    write_100style(tmp_path / "tree")
    archives = {
        "bandai": zip_folder(small_bandai, tmp_path / "b.zip"),
        "100style": zip_folder(tmp_path / "tree", tmp_path / "s.zip"),
    }
    calls = []

    def retrieve(url, known_hash, *, fname, path, progressbar):
        calls.append((url, known_hash))
        return str(archives["100style" if "100STYLE" in fname else "bandai"])

    monkeypatch.setattr(pooch, "retrieve", retrieve)
    assert (len(open_dataset("bandai").clips), len(open_dataset("100style").clips)) == (7, 6)
    repository = "https://github.com/BandaiNamcoResearchInc/Bandai-Namco-Research-Motiondataset"
    assert calls == [
        (f"{repository}/archive/74ead3ba1ae4696404e6086233779f60de8bf9ef.zip", None),
        ("doi:10.5281/zenodo.8127870/100STYLE.zip", "md5:3cf627852fd8192024c04a8d0ef49583"),
    ]


@pytest.mark.parametrize("name", ["bandai", "100style"])
@pytest.mark.parametrize("error", [ConnectionError("no route"), ValueError("hash does not match")])
def test_a_failed_download_says_what_to_set(monkeypatch, name, error):
    monkeypatch.delenv(DATA_DIR_VARIABLE, raising=False)

    def fail(*args, **kwargs):
        raise error

    monkeypatch.setattr(pooch, "retrieve", fail)
    refused(f"(?s){error}.* environment variable {DATA_DIR_VARIABLE}", open_dataset, name)


# --- the real archive -----------------------------------------------------------------------------


def test_real_bandai_archive(bandai_dataset):
    assert len(bandai_dataset.clips) == 1067
    assert len(bandai_dataset.styles) == 22
    moods = "active elderly exhausted feminine masculine normal youthful".split()
    assert bandai_dataset.primary_styles == tuple(f"2-{mood}" for mood in moods)
    by_style = collections.defaultdict(collections.Counter)
    for clip in bandai_dataset.clips:
        by_style[clip.style][clip.split] += 1
    for style, count in by_style.items():
        assert count["validation"] == count["test"] >= 1, style
        assert abs(count["test"] - count.total() / 10) <= 0.5, style
    motion = bandai_dataset.clips[0].load()
    assert motion.skeleton.num_joints == 21 and motion.skeleton.names[0] == "Hips"


def test_bandai_refuses_flipped_bits_inside_a_zip(small_bandai, tmp_path):
    zipped = zip_folder(small_bandai, tmp_path / "bandai_namco.zip")
    with zipfile.ZipFile(zipped) as archive:
        (info,) = [item for item in archive.infolist() if "angry_002" in item.filename]
    data = bytearray(zipped.read_bytes())
    data[info.header_offset + 200] ^= 0xFF  # inside the compressed text
    zipped.write_bytes(bytes(data))
    dataset = open_dataset("bandai", path=zipped)
    (clip,) = [clip for clip in dataset.clips if "angry_002" in clip.name]
    refused(r"bandai_namco\.zip: .*angry_002\.bvh: damaged", clip.load)
