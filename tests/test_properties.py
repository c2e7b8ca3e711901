"""What holds for any input: readers read or refuse by name, and what was written is read again.

`scripts/fuzz.py` does the first for minutes; here are a few dozen files of each kind.
"""

from __future__ import annotations

import string
import warnings

import fuzz
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from scipy.spatial.transform import Rotation

from f3amd_lib.ground.records import read_table, write_table
from f3amd_lib.ground.trees import load_tree, save_tree
from f3amd_lib.motion.bvh import format_bvh, parse_bvh
from f3amd_lib.motion.root_paths import read_path_csv
from f3amd_lib.motion.skeleton import Motion, Skeleton
from f3amd_lib.text.data.captioned_folder import write_caption_line, write_humanml3d
from f3amd_lib.text.data.humanml3d import read_caption_line, read_humanml3d
from f3amd_lib.text.data.text_motions import text_motions

few = settings(max_examples=20, deadline=None, derandomize=True, database=None)
words = st.text(st.characters(codec="utf-8", categories=("L", "N")), min_size=1, max_size=12)
numbers = st.floats(-1e4, 1e4, width=32)


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", list(fuzz.READERS))
def test_damaged_files_are_read_or_refused_by_name(tmp_path, name):
    for number, error, path, data in fuzz.attack(name, tmp_path, cases=60):
        assert error is None, f"case {number}, {path.name}, {data[:200]!r}: {error!r}"


@st.composite
def motions(draw):
    """A tree of some joints that moves at random."""
    count, frames = draw(st.integers(1, 6)), draw(st.integers(1, 4))
    parents = [-1, *(draw(st.integers(0, joint)) for joint in range(count - 1))]
    names = draw(st.lists(words, min_size=count, max_size=count, unique=True))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    offsets = np.concatenate([np.zeros((1, 3)), rng.uniform(-1, 1, (count - 1, 3))])
    rotations = Rotation.from_quat(rng.normal(size=(frames * count, 4))).as_matrix().reshape(frames, count, 3, 3)
    return Motion(Skeleton(names, parents, offsets), rng.uniform(-50, 50, (frames, 3)), rotations)


@few
@given(motions())
def test_any_motion_goes_through_bvh(motion):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        again = parse_bvh(format_bvh(motion), "any")
    # Joints come depth first: compared by name.
    place = [again.skeleton.names.index(name) for name in motion.skeleton.names]
    np.testing.assert_allclose(again.positions[:, place], motion.positions, atol=1e-5)


@few
@given(st.lists(st.tuples(st.floats(-0.3, 0.3), st.floats(-0.3, 0.3), st.floats(-720, 720)), min_size=2, max_size=9))
def test_any_path_goes_through_csv(tmp_path_factory, steps):
    file = tmp_path_factory.mktemp("paths") / "path.csv"
    place = np.cumsum(np.array(steps)[:, :2], axis=0)
    rows = [f"{x!r},{z!r},{yaw!r}" for (x, z), (_, _, yaw) in zip(place.tolist(), steps, strict=True)]
    file.write_text("x,z,yaw_deg\n" + "\n".join(rows))
    path = read_path_csv(file)
    np.testing.assert_allclose(path.position, place, atol=1e-12)
    wanted = np.deg2rad([yaw for *_, yaw in steps])
    np.testing.assert_allclose(np.exp(1j * path.yaw), np.exp(1j * wanted), atol=1e-9)


@few
@given(
    st.dictionaries(
        st.text(string.ascii_letters, min_size=1, max_size=8),
        st.lists(st.floats(allow_nan=False, allow_infinity=False), min_size=3, max_size=3),
        min_size=1, max_size=4,
    ),
    st.dictionaries(words.filter(lambda word: word not in fuzz.RECORD), st.one_of(st.integers(), words, st.none())),
)  # fmt: skip
def test_any_table_goes_through_its_record(tmp_path_factory, columns, extra):
    path = tmp_path_factory.mktemp("tables") / "table.csv"
    write_table(path, pd.DataFrame(columns), {**extra, **fuzz.RECORD})
    table, record = read_table(path)
    pd.testing.assert_frame_equal(table.astype(float), pd.DataFrame(columns), check_exact=True)
    assert all(record[key] == value for key, value in extra.items() if key != "table" and "/" not in str(value))


@few
@given(
    st.dictionaries(
        words, arrays.arrays(np.float32, arrays.array_shapes(max_dims=3, max_side=4), elements=numbers), max_size=3
    ),
    st.dictionaries(words, st.one_of(st.integers(), words, st.lists(words))),
)
def test_any_tree_goes_through_a_file_of_weights(tmp_path_factory, tree, about):
    path = tmp_path_factory.mktemp("weights") / "tree.safetensors"
    tree = {"always": np.ones(1, np.float32), **tree}
    save_tree(path, tree, about)
    again, described = load_tree(path, {name: jnp.asarray(leaf) for name, leaf in tree.items()})
    assert described == about
    for name, leaf in tree.items():
        np.testing.assert_array_equal(again[name], leaf)


@few
@given(st.text(st.characters(codec="utf-8", exclude_characters="#", exclude_categories=("C", "Z")), min_size=1))
def test_any_caption_goes_through_its_line(caption):
    assert read_caption_line(write_caption_line(caption) + "\n", "here") == (caption, 0.0, 0.0)


@settings(few, max_examples=6)
@given(st.lists(st.integers(3, 30), min_size=1, max_size=4), st.integers(0, 1000))
def test_any_clips_go_through_a_folder_of_humanml3d(tmp_path_factory, lengths, seed):
    folder = tmp_path_factory.mktemp("humanml3d") / "set"
    rng = np.random.default_rng(seed)
    motions = [fuzz.walk(length) for length in lengths]
    moved = [m.replace(root_position=m.root_position + rng.normal(0, 0.01, m.root_position.shape)) for m in motions]
    splits = ["train", *rng.choice(["train", "validation", "test"], len(lengths) - 1)]
    clips = [(f"c{k}", motion, (f"number {k}",), splits[k], "a") for k, motion in enumerate(moved)]
    about = {"name": "tiny", "fps": 20.0, "licence": "none", "credit": "", "skipped": ()}
    data = text_motions(clips, skeleton=moved[0].skeleton, **about)
    again = read_humanml3d(write_humanml3d(folder, data))
    assert sorted(again.names) == sorted(data.names)
    for number, name in enumerate(data.names):
        other = again.names.index(name)
        assert again.captions[other] == data.captions[number] and again.splits[other] == data.splits[number]
        np.testing.assert_array_equal(again.clip(other), data.clip(number)[:-1])
