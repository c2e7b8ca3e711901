"""HumanML3D's layout: a tree that the test writes by hand, broken in many ways, and BVH files on their way there."""

import csv
import shutil

import numpy as np
import pytest
from builders import refused

from f3amd_companion.__main__ import main
from f3amd_lib.data.sources import open_dataset
from f3amd_lib.motion import synthetic
from f3amd_lib.motion.bvh import write_bvh
from f3amd_lib.motion.rotations import matrix_from_euler
from f3amd_lib.motion.skeleton import forward_kinematics, resample, turn
from f3amd_lib.text.data import captioned_folder, humanml3d, redundant
from f3amd_lib.text.data.text_motions import TextMotions
from f3amd_lib.text.stages import motionpcm_training

LENGTHS = {"000001": 60, "M000001": 60, "000002": 120, "000003": 30, "000004": 250}
TEXTS = {
    "000001": "a man walks.#a/DET man/NOUN walk/VERB#0.0#0.0\nsomeone strolls#someone/PRON stroll/VERB#0.0#nan\n",
    "M000001": "a man walks back.#a/DET man/NOUN walk/VERB back/ADV#0.0#0.0\n",
    "000002": "he turns#he/PRON turn/VERB#0.0#0.0\nhe stands#he/PRON#2.0#5.0\nhe waits#he/PRON#2.0#5.0\n",
    "000003": "too short#too/ADV short/ADJ#0.0#0.0\n",
    "000004": "too long#too/ADV long/ADJ#0.0#0.0\n",
}
SPLITS = {"train": ["000001", "M000001"], "val": ["000003", "000004"], "test": ["000002"]}


def positions(skeleton, frames, seed=0):
    """Anything that moves on a skeleton, [L, J, 3]."""
    generator = np.random.default_rng(seed)
    angle = 0.3 * np.cumsum(generator.normal(size=(frames, skeleton.num_joints, 3)), axis=0) / 10
    rotations = matrix_from_euler("ZXY", np.degrees(angle))
    root = np.cumsum(generator.normal(size=(frames, 3)), axis=0) / 50 + [0, 1, 0]
    return redundant.canonical_start(skeleton, forward_kinematics(skeleton, root, rotations))


def write_tree(folder, layout="humanml3d"):
    """A tiny data set, as its authors' code would leave it."""
    skeleton = humanml3d.layout_skeleton(layout)
    for part in ("new_joints", "new_joint_vecs", "texts"):
        (folder / part).mkdir(parents=True)
    for seed, (name, frames) in enumerate(LENGTHS.items()):
        clip = positions(skeleton, frames + 1, seed)
        np.save(folder / "new_joints" / f"{name}.npy", clip[:-1].astype(np.float32))
        vectors = redundant.redundant_from_positions(skeleton, clip)
        np.save(folder / "new_joint_vecs" / f"{name}.npy", vectors.astype(np.float32))
        (folder / "texts" / f"{name}.txt").write_text(TEXTS[name], encoding="utf-8")
    for split, names in SPLITS.items():
        (folder / f"{split}.txt").write_text("".join(f"{name}\n" for name in names), encoding="utf-8")
    return folder


@pytest.mark.parametrize("layout, joints, fps, clips", [("humanml3d", 22, 20.0, 4), ("kit", 21, 12.5, 5)])
def test_both_published_layouts_are_read(tmp_path, layout, joints, fps, clips):
    data = humanml3d.read_humanml3d(write_tree(tmp_path, layout))
    assert (data.name, data.fps, data.skeleton.num_joints, data.num_clips) == (layout, fps, joints, clips)
    first = data.names.index("000001")
    assert data.captions[first] == ("a man walks.", "someone strolls") and data.splits[first] == "train"
    # A caption with times is a clip of its own, cut at int(begin fps) and int(end fps).
    part = data.names.index("000002@2-5")
    assert data.captions[part] == ("he stands", "he waits") and data.splits[part] == "test"
    whole = np.load(tmp_path / "new_joints" / "000002.npy")
    assert np.array_equal(data.clip(part), whole[int(2 * fps) : int(5 * fps)])
    assert data.captions[data.names.index("000002")] == ("he turns",)
    assert ("000004", "250 frames, not") in [(name, why[:15]) for name, why in data.skipped]
    assert ("000003" in data.names) is (layout == "kit")  # 30 frames: KIT-ML begins at 24, HumanML3D at 40


@pytest.mark.parametrize("layout, contact_step", [("humanml3d", 0.002), ("kit", 0.05)])
def test_contacts_are_judged_by_the_step_of_the_folders_own_unit(tmp_path, layout, contact_step):
    shutil.rmtree(write_tree(tmp_path, layout) / "new_joint_vecs")
    data = humanml3d.read_humanml3d(tmp_path).select([0])
    clip = data.clip(0)
    feet = redundant.redundant_from_positions(data.skeleton, clip, contact_step=contact_step)[:, -4:]
    other = redundant.redundant_from_positions(data.skeleton, clip, contact_step=0.052 - contact_step)[:, -4:]
    assert np.array_equal(data.redundant_vectors()[:-1, -4:], feet) and not np.array_equal(feet, other)


def put(name, array):
    """Writes a clip anew."""
    return lambda folder: np.save(folder / "new_joints" / f"{name}.npy", array, allow_pickle=True)


def add(file, text):
    """Adds a line to a file."""
    return lambda folder: (folder / file).open("a", encoding="utf-8").write(text)


BROKEN = {
    "a pickle": (put("000002", np.array([{}], dtype=object)), "000002", "000002.npy cannot be used"),
    "cut short": (lambda f: (f / "new_joints/000002.npy").write_bytes(b"\x93NUMPY"), "000002", "cannot be used"),
    "a joint less": (put("000002", np.zeros((50, 21, 3))), "000002", "shape (50, 21, 3)"),
    "not finite": (put("000002", np.full((50, 22, 3), np.nan)), "000002", "not finite"),
    "thirty joints first": (put("000001", np.zeros((50, 30, 3))), "000001", "shape (50, 30, 3)"),
    "no text": (lambda f: (f / "texts/000001.txt").unlink(), "000001", "000001.txt: no such file"),
    "empty text": (lambda f: (f / "texts/000001.txt").write_text(""), "000001", "holds no caption"),
    "few parts": (add("texts/000001.txt", "a man#0.0\n"), "texts/000001.txt, line 3", "is not caption#words"),
    "no caption": (add("texts/000001.txt", "#x#0.0#0.0\n"), "texts/000001.txt, line 3", "the caption is empty"),
    "words for times": (add("texts/000001.txt", "a#b#now#0.0\n"), "texts/000001.txt, line 3", "now"),
    "falling times": (add("texts/000001.txt", "a#b#2.0#1.0\n"), "texts/000001.txt, line 3", "times do not rise"),
    "after the end": (add("texts/000001.txt", "a#b#7.0#9.0\n"), "texts/000001.txt, line 3", "begins at 7.0 s"),
    "twice": (add("test.txt", "000001\n"), "test.txt, line 2", "'000001' is listed before"),
    "no id": (add("test.txt", "../000001\n"), "test.txt, line 2", "no plain id"),
}  # fmt: skip


@pytest.mark.parametrize("what", BROKEN)
def test_what_is_broken_is_left_out_and_named(tmp_path, caplog, what):
    whole = humanml3d.read_humanml3d(write_tree(tmp_path))
    breaking, place, reason = BROKEN[what]
    breaking(tmp_path)
    data = humanml3d.read_humanml3d(tmp_path)
    assert reason in dict(data.skipped)[place] and f"{place}: " in caplog.text
    kept = [name for name in whole.names if name.partition("@")[0] != place]
    assert list(data.names) == kept and data.captions == tuple(whole.captions[whole.names.index(name)] for name in kept)


@pytest.mark.parametrize(
    "breaking, words",
    [
        (BROKEN["a pickle"][0], "2 of 5 records are broken, more than 20%.*000004: new_joints/000004.npy is missing"),
        (lambda f: (f / "train.txt").unlink(), r"train\.txt: no such file"),
        (
            lambda f: [(f / f"{split}.txt").write_text("000003\n" * (split == "train")) for split in SPLITS],
            "no clip of 40 to 199 frames",
        ),
        (lambda f: [put(name, np.zeros((50, 30, 3)))(f) for name in LENGTHS], "000001 has 30 joints"),
        (lambda f: np.save(f / "Mean.npy", np.zeros(262)), r"Mean\.npy and Std\.npy are not mean and deviation of 263"),
    ],
)
def test_more_than_a_fifth_broken_or_nothing_left_is_refused(tmp_path, breaking, words):
    write_tree(tmp_path)
    np.save(tmp_path / "Std.npy", np.ones(263))
    (tmp_path / "new_joints/000004.npy").unlink()
    (tmp_path / "new_joint_vecs/000004.npy").unlink()
    breaking(tmp_path)
    refused(words, humanml3d.read_humanml3d, tmp_path)


def test_a_folder_of_windows_with_vectors_alone_gives_the_same_positions(tmp_path):
    whole = humanml3d.read_humanml3d(write_tree(tmp_path))
    shutil.rmtree(tmp_path / "new_joints")
    for file in tmp_path.glob("**/*.txt"):
        file.write_bytes(file.read_text("utf-8").replace("\n", "\r\n").encode("utf-8-sig"))
    data = humanml3d.read_humanml3d(tmp_path)
    assert (data.names, data.captions, data.splits) == (whole.names, whole.captions, whole.splits)
    np.testing.assert_allclose(data.positions, whole.positions, atol=2e-6)


def test_clips_are_held_out_of_training_where_other_lists_are_missing(tmp_path):
    write_tree(tmp_path)
    names = [f"{mirrored}{k:06d}" for k in range(10, 30) for mirrored in ("", "M")]
    for name in names:
        shutil.copy(tmp_path / "new_joints/000001.npy", tmp_path / "new_joints" / f"{name}.npy")
        shutil.copy(tmp_path / "texts/000001.txt", tmp_path / "texts" / f"{name}.txt")
    (tmp_path / "train.txt").write_text("\n".join(names))
    (tmp_path / "val.txt").unlink()
    data = humanml3d.read_humanml3d(tmp_path)
    split = dict(zip(data.names, data.splits, strict=True))
    assert set(split[name] for name in names) == {"train", "validation"} and split["000002"] == "test"
    assert all(split[name] == split[f"M{name}"] for name in names[::2])


def test_parts_of_a_motion_have_the_vectors_and_the_folder_the_statistics_that_are_stored(tmp_path):
    vectors = np.load(write_tree(tmp_path) / "new_joint_vecs" / "000002.npy")
    statistics = np.linspace(-1, 1, 263, dtype=np.float32), np.linspace(1, 2, 263, dtype=np.float32)
    for file, numbers in zip(("Mean.npy", "Std.npy"), statistics, strict=True):
        np.save(tmp_path / file, numbers)
    data = humanml3d.read_humanml3d(tmp_path)
    part = data.names.index("000002@2-5")
    np.testing.assert_array_equal(data.select([part]).redundant_vectors(), vectors[40:100])
    np.testing.assert_array_equal(data.select([part], 24).redundant_vectors(), vectors[40:64])
    np.testing.assert_array_equal(motionpcm_training.frame_statistics(data).mean, statistics[0])
    (tmp_path / "new_joint_vecs" / "000002.npy").unlink()
    computed = humanml3d.read_humanml3d(tmp_path).redundant_vectors()[data.start[part] : data.start[part + 1]]
    assert np.isfinite(computed).all() and np.abs(computed - vectors[40:100]).max() > 0.01  # faces otherwise


# ------------------------------------------------------------------------ from BVH files with a table


@pytest.fixture(scope="module")
def bvh_folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("bvh")
    rows = [("file", "caption")]
    for seed in range(7):
        motion = synthetic.synthesize(synthetic.STYLES[seed], seconds=4.0, seed=seed)
        write_bvh(folder / f"take{seed}.bvh", turn(motion, 0.5 * seed))
        rows += [(f"take{seed}.bvh", f"a person walks in way {seed}"), (f"take{seed}", "someone walks")]
    rows += [("take6.bvh", "someone turns left")]
    write_bvh(folder / "without.bvh", motion)
    with (folder / "captions.csv").open("w", encoding="utf-8", newline="") as file:
        csv.writer(file).writerows(rows)
    return folder


def test_bvh_files_with_a_table_become_a_data_set(bvh_folder, tmp_path, caplog):
    out = tmp_path / "made"
    words = ["dataset", "--source", bvh_folder, "--captions", bvh_folder / "captions.csv", "--out", out]
    assert main(list(map(str, words))) == 0
    data = humanml3d.read_humanml3d(out)
    assert data.skeleton == synthetic.synthesize(synthetic.STYLES[0], seconds=2.0, seed=0).skeleton and data.fps == 20.0
    # The one whose caption names a side has no mirrored twin.
    assert sorted(data.names) == sorted([f"take{k}" for k in range(7)] + [f"Mtake{k}" for k in range(6)])
    split = dict(zip(data.names, data.splits, strict=True))
    assert all(split[f"M{name}"] == split[name] for name in split if f"M{name}" in split)
    assert set(split.values()) == {"train", "validation", "test"}
    number = data.names.index("take3")
    assert data.captions[number] == ("a person walks in way 3", "someone walks")
    source = resample(open_dataset("folder", path=bvh_folder).clips[3].loader(), 20.0, smooth=True)
    expected = redundant.canonical_start(data.skeleton, source.positions[:80])[:-1]
    assert np.abs(data.clip(number) - expected).max() < 1e-5
    twin = data.clip(data.names.index("Mtake3"))[:, list(data.skeleton.mirror_permutation)] * [-1, 1, 1]
    assert np.abs(redundant.canonical_start(data.skeleton, twin)[:20] - data.clip(number)[:20]).max() < 0.02
    mean, deviation = np.load(out / "Mean.npy"), np.load(out / "Std.npy")
    training = data.select(data.members("train"))
    assert mean.shape == deviation.shape == (275,)
    vectors = [np.load(out / "new_joint_vecs" / f"{name}.npy") for name in training.names]
    assert np.allclose(mean, np.concatenate(vectors).mean(axis=0), atol=1e-5)
    lines = (out / "all.txt").read_text().split()
    both = (out / "train_val.txt").read_text().split() + (out / "test.txt").read_text().split()
    assert sorted(lines) == sorted(both) == sorted(data.names)
    assert data.licence == "as its owner says"


def captioned(folder, captions) -> TextMotions:
    """The motions of a folder with these captions by name."""
    return captioned_folder.captioned_motions(open_dataset("folder", path=folder), captions)


@pytest.mark.parametrize(
    "table, words",
    [
        ("file,caption\ntake0,walks #1\n", "line 2: .* # parts the fields"),
        ("file,caption\n", "holds no caption"),
        ("file,caption\ntaek0,walks\n", "taek0: 0 motions; did you mean 'take0'"),
    ],
)
def test_a_bad_table_is_refused(bvh_folder, tmp_path, table, words):
    path = tmp_path / "bad.csv"
    path.write_text(table, encoding="utf-8")
    refused(words, lambda: captioned(bvh_folder, captioned_folder.read_caption_table(path)))


def test_what_a_mirror_shows_otherwise_is_not_mirrored_and_empty_splits_are_said(bvh_folder, caplog):
    said = ("a circle clockwise", "turns Left", "spins counter-clockwise", "a leftover")
    captions = {f"take{number}": (caption,) for number, caption in enumerate(said)}
    assert sorted(captioned(bvh_folder, captions).names) == sorted(captions) and "no clip for" not in caplog.text
    few = captioned(bvh_folder, {"take0": ("a walk",)})
    assert few.names == ("take0", "Mtake0") and "no clip for validation and test" in caplog.text


def test_nothing_is_written_over(bvh_folder, tmp_path):
    data = captioned(bvh_folder, {"take0": ("a walk",), "take1": ("a walk",)})
    (tmp_path / "mine.txt").write_text("mine")
    refused("holds other files; choose an empty", captioned_folder.write_humanml3d, tmp_path, data)
    (tmp_path / "mine.txt").rename(tmp_path / ".DS_Store")  # what a desktop leaves in an empty folder
    captioned_folder.write_humanml3d(tmp_path, data)
    assert (tmp_path / ".DS_Store").read_text() == "mine" and (tmp_path / "skeleton.json").exists()


@pytest.mark.slow
def test_a_folder_with_ten_broken_records_of_sixty_trains(tmp_path, caplog):
    folder = write_tree(tmp_path / "set")
    names = {split: [f"{split}{k}" for k in range(count)] for split, count in (("train", 50), ("val", 7), ("test", 3))}
    for split, every in names.items():
        (folder / f"{split}.txt").write_text("\n".join(every))
        for name in every:
            for part, known in (
                ("new_joints", "000001.npy"),
                ("new_joint_vecs", "000001.npy"),
                ("texts", "000001.txt"),
            ):
                shutil.copy(folder / part / known, folder / part / known.replace("000001", name))
    for k in range(5):
        (folder / "texts" / f"train{k}.txt").write_text("#x#0.0#0.0\n")
        put(f"train{k + 5}", np.full((60, 22, 3), np.inf))(folder)
    words = "train --data folder --profile smoke --preset ACMDM-S-PS22-raw-n2 --steps 2 --batch-size 4 --window 40"
    assert main([*words.split(), "--source", str(folder), "--out", str(tmp_path / "models")]) == 0
    assert "10 of 60 records are broken and left out: train0: " in caplog.text
    assert list((tmp_path / "models").glob("*.safetensors"))


def test_caption_lines_are_read_as_they_were_written():
    said = "A man's self-assured walk, twice."
    line = captioned_folder.write_caption_line(said)
    assert line == f"{said}#a/OTHER man's/OTHER self-assured/OTHER walk/OTHER twice/OTHER#0.0#0.0"
    assert humanml3d.read_caption_line(line, "here") == (said, 0.0, 0.0)
