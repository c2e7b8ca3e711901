"""Files appear whole or not at all."""

import os
import time

import pytest

from f3amd_lib.ground.files import whole_file, whole_folder


def test_a_file_appears_when_it_is_whole(tmp_path):
    path = tmp_path / "new" / "table.csv"
    with whole_file(path) as temporary:
        temporary.write_text("a,b")
        assert not path.exists()
    assert path.read_text() == "a,b"
    assert [item.name for item in path.parent.iterdir()] == ["table.csv"]


def test_a_failure_leaves_the_old_file(tmp_path):
    path = tmp_path / "table.csv"
    path.write_text("old")
    with pytest.raises(RuntimeError, match="power cut"):
        with whole_file(path, overwrite=True) as temporary:
            temporary.write_text("half a ta")
            raise RuntimeError("power cut")
    assert path.read_text() == "old"
    assert [item.name for item in tmp_path.iterdir()] == ["table.csv"]


def test_nothing_is_overwritten_unasked(tmp_path):
    path = tmp_path / "table.csv"
    path.write_text("old")
    with pytest.raises(ValueError, match=r"table\.csv: exists already; .*overwrite=True"):
        with whole_file(path) as temporary:
            temporary.write_text("new")
    assert path.read_text() == "old"
    with whole_file(path, overwrite=True) as temporary:
        temporary.write_text("new")
    assert path.read_text() == "new"


def test_a_folder_appears_when_it_is_whole_or_not_at_all(tmp_path):
    path = tmp_path / "new" / "set"
    with pytest.raises(RuntimeError, match="power cut"):
        with whole_folder(path) as temporary:
            (temporary / "half").touch()
            raise RuntimeError("power cut")
    assert not list(path.parent.iterdir())
    path.mkdir()  # an empty one is as good as none
    with whole_folder(path) as temporary:
        (temporary / "all").touch()
        assert not list(path.iterdir())
    assert [item.name for item in path.iterdir()] == ["all"]
    with pytest.raises(OSError), whole_folder(path) as temporary:  # somebody was faster
        (temporary / "other").touch()
    assert [item.name for item in path.rglob("*")] == ["all"]


def test_what_a_killed_process_left_unfinished_goes_after_an_hour(tmp_path):
    for name, age in ((".a.csv.1.part", 7200), (".a.csv.2.part", 60), (".b.csv.3.part", 7200)):
        (tmp_path / name).write_text("half")
        os.utime(tmp_path / name, (time.time() - age,) * 2)
    with whole_file(tmp_path / "a.csv") as temporary:
        temporary.touch()
    assert sorted(path.name for path in tmp_path.iterdir()) == [".a.csv.2.part", ".b.csv.3.part", "a.csv"]
