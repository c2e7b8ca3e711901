"""What holds for any input: readers read or refuse by name, and what was written is read again.

`scripts/fuzz.py` does the first for minutes; here are a few dozen files of each kind.
"""

from __future__ import annotations

import warnings

import fuzz
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from f3amd_lib.motion.bvh import format_bvh, parse_bvh
from f3amd_lib.motion.skeleton import Motion, Skeleton
from f3amd_lib.text.data.captioned_folder import write_caption_line
from f3amd_lib.text.data.humanml3d import read_caption_line

few = settings(max_examples=20, deadline=None, derandomize=True, database=None)
words = st.text(st.characters(codec="utf-8", categories=("L", "N")), min_size=1, max_size=12)


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
@given(st.text(st.characters(codec="utf-8", exclude_characters="#", exclude_categories=("C", "Z")), min_size=1))
def test_any_caption_goes_through_its_line(caption):
    assert read_caption_line(write_caption_line(caption) + "\n", "here") == (caption, 0.0, 0.0)
