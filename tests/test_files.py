"""Files appear whole or not at all."""

import pytest

from f3amd_lib.ground.files import whole_file


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


def test_two_writers_of_one_process_do_not_share_a_temporary_file(tmp_path):
    path = tmp_path / "table.csv"
    with whole_file(path) as one:
        one.write_text("one")
        with whole_file(path) as other:
            assert other != one
            other.write_text("other")
        assert path.read_text() == "other"
    assert path.read_text() == "one"


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
