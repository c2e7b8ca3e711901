"""Records, tables, the paper's numbers, figures and pictures."""

import json
import os
import subprocess
import tempfile
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from builders import refused
from f3amd_notebooks.stored_result import stored_result
from PIL import Image

from f3amd_lib.drawing import style as figures
from f3amd_lib.ground import papers, records, tables
from f3amd_lib.ground.names import counted_cores
from f3amd_lib.networks.presets import find_preset

# ------------------------------------------------------------------------------------- records


def record(**changes):
    return records.run_record(**({"profile": "smoke", "dataset": "synthetic", "seed": 3} | changes))


FRAME = pd.DataFrame({"model": ["a", "b"], "value": [0.1 + 0.2, float("nan")], "steps": [8, 1]})


def test_record_says_what_ran_where():
    data = SimpleNamespace(name="bandai", fingerprint="ab12", licence="CC BY-NC 4.0", credit="somebody")
    made = record(dataset=data, steps=np.int64(8), times=np.array([1.5, 2.5]))
    assert made["dataset"] == "bandai" and made["dataset_fingerprint"] == "ab12"
    assert made["steps"] == 8 and made["times"] == [1.5, 2.5]
    assert set(made["versions"]) >= {"python", "jax", "flax", "optax", "numpy"}
    assert made["versions"]["numpy"] == np.__version__
    assert made["cores"] >= 1 and made["device_kind"] and made["date_utc"].endswith("Z")
    assert {"git_commit", "git_dirty", "library_version"} <= set(made)
    json.dumps(made, allow_nan=False)


def test_record_tells_no_folder_of_the_machine(tmp_path):
    home = os.path.expanduser("~")
    made = record(
        note=f"read from {home}/data/walk.bvh and {tempfile.gettempdir()}/x",
        inside=records.__file__, deep={"list": [str(tmp_path), float("nan")]},
    )  # fmt: skip
    text = json.dumps(made)
    assert home + "/" not in text and tempfile.gettempdir() + "/" not in text
    assert made["note"] == "read from ~/data/walk.bvh and <tmp>/x"
    assert made["inside"] == "./f3amd_lib/ground/records.py" and made["deep"]["list"][1] is None


def test_git_state_of_a_checkout(tmp_path, monkeypatch):
    """Commit and dirty flag follow the library's code, not its results."""
    code = tmp_path / "f3amd_lib" / "ground" / "records.py"
    code.parent.mkdir(parents=True)
    code.write_text("one\n")

    def git(*arguments):
        identity = ["-c", "user.name=t", "-c", "user.email=t@example.org"]
        words = ["git", "-C", str(tmp_path), *identity, *arguments]
        done = subprocess.run(words, check=True, capture_output=True, text=True)
        return done.stdout.strip()

    monkeypatch.setattr(records, "_CHECKOUT", str(tmp_path))
    git("init", "-q")
    assert records._git_state() == (None, None)  # not tracked: somebody else's checkout
    git("add", ".")
    git("commit", "-q", "-m", "first")
    commit = git("rev-parse", "HEAD")
    assert records._git_state() == (commit, False)
    (tmp_path / "table.csv").write_text("result\n")
    assert records._git_state() == (commit, False)
    (tmp_path / "f3amd_companion").mkdir()
    (tmp_path / "f3amd_companion" / "measure.py").write_text("one\n")
    assert records._git_state() == (commit, True)
    (tmp_path / "f3amd_companion" / "measure.py").unlink()
    code.write_text("two\n")
    assert records._git_state() == (commit, True)


def test_same_question_same_hash():
    assert records.record_hash(record()) == records.record_hash(record())
    assert records.record_hash(record()) != records.record_hash(record(seed=4))
    assert records.record_hash(record(steps=8)) != records.record_hash(record(steps=1))
    elsewhere = record() | {"device_kind": "another", "date_utc": "2000-01-01T00:00:00Z"}
    assert records.record_hash(elsewhere) == records.record_hash(record())


def test_a_table_comes_back_with_other_line_ends_too(tmp_path):
    path = records.write_table(tmp_path / "deep" / "quality.csv", FRAME, record())
    frame, made = records.read_table(path)
    pd.testing.assert_frame_equal(frame, FRAME)
    assert made["table"]["rows"] == 2 and made["table"]["columns"] == ["model", "value", "steps"]
    assert sorted(file.name for file in path.parent.iterdir()) == ["quality.csv", "quality.json"]
    path.write_bytes(path.read_bytes().replace(b"\n", b"\r\n"))
    pd.testing.assert_frame_equal(records.read_table(path)[0], FRAME)


def test_digests_stay_text_where_they_look_like_numbers(tmp_path):
    digests = {"weights": ["912345678901"] * 2, "classifier": ["1e10", None], "commit": ["9548690e74", "00042"]}
    table = pd.DataFrame({"value": [0.1, 2.0], **digests})
    records.write_table(tmp_path / "rows.csv", table, record())
    back = records.read_table(tmp_path / "rows.csv")[0]
    assert back["weights"].tolist() == digests["weights"] and back["commit"].tolist() == digests["commit"]
    assert back["classifier"][0] == "1e10" and pd.isna(back["classifier"][1]) and back["value"].tolist() == [0.1, 2.0]


def test_table_without_its_record_is_refused(tmp_path):
    path = records.write_table(tmp_path / "quality.csv", FRAME, record())
    path.with_suffix(".json").unlink()
    refused(r"quality\.csv: has no readable run record quality\.json", records.read_table, path)
    refused("no readable run record", records.write_table, path, FRAME, record())
    with pytest.raises(FileNotFoundError, match="no such table"):
        records.read_table(tmp_path / "other.csv")


def test_edited_table_and_broken_record_are_refused(tmp_path):
    path = records.write_table(tmp_path / "quality.csv", FRAME, record())
    path.write_text(path.read_text().replace("a,", "better,"))
    refused("not the table that quality.json describes", records.read_table, path)
    path.with_suffix(".json").write_text("{")
    refused("no readable run record", records.read_table, path)


@pytest.mark.parametrize("key", ["dataset", "profile"])
def test_tables_of_other_runs_are_never_overwritten(tmp_path, key):
    path = records.write_table(tmp_path / "quality.csv", FRAME, record())
    before = path.read_bytes()
    refused(f"holds results of {key}", records.write_table, path, FRAME.head(1), record(**{key: "other"}))
    assert path.read_bytes() == before
    records.write_table(path, FRAME.head(1), record(seed=9))  # the same question, measured again
    assert len(records.read_table(path)[0]) == 1


# ------------------------------------------------------------------------------------- papers

TABLES = [
    (paper, table["number"])
    for paper in papers.paper_folders()
    for table in papers.load_paper_file("paper", paper).get("table", ())
]


@pytest.mark.parametrize(("paper", "number"), TABLES)
def test_tables_of_the_papers_are_whole_and_their_own_rows_have_presets(paper, number):
    frame, about = papers.load_paper_table(number, paper), papers.load_paper_file("paper", paper)
    assert {"model", "metric", "unit", "better", "printed", "value"} <= set(frame) and len(frame)
    assert set(frame["better"]) <= {"up", "down", "real"} and frame.attrs["setting"] == about["setting"]
    assert (frame["value"].isna() == (frame["printed"] == "")).all() and frame["value"].notna().any()
    own = {name for name in frame["model"] if name.startswith(about["name"])}
    assert {find_preset(name).paper for name in own} <= {paper}


# ------------------------------------------------------------------------------------- tables


def test_markdown_has_units_dashes_and_alignment():
    frame = pd.DataFrame({"model": ["a|b", "c"], "time (ms)": [1234.5678, float("nan")], "printed": ["0.250", ""]})
    lines = tables.markdown_table(frame).splitlines()
    assert len({len(line) for line in lines}) == 1
    cells = [[cell.strip() for cell in line.strip("|").split(" | ")] for line in lines]
    assert cells[0] == ["model", "time (ms)", "printed"]
    assert cells[2] == ["a\\|b", "1235", "0.250"]
    assert cells[3] == ["c", "–", "–"]
    assert lines[1].count(":") == 2  # both number columns flush right


def test_a_stored_result_is_shown_with_its_origin(tmp_path, monkeypatch):
    monkeypatch.setattr(records, "repository_root", lambda: tmp_path)
    assert "No stored `02_any` of `laptop` on `synthetic` yet" in stored_result("synthetic", "02_any")
    told, path = record(), tmp_path / "paper_figures/synthetic/laptop/tables/02_any.csv"
    records.write_table(path, pd.DataFrame({"model": ["a"], "value": [1.23456]}), told)
    shown = stored_result("synthetic", "02_any")
    assert f"data {told['dataset']}, {counted_cores(told)}" in shown and told["date_utc"][:10] in shown
    assert "| a     |  1.23 |" in shown


# ------------------------------------------------------------------------------------- figures


def test_saved_figures_depend_on_the_drawing_alone(tmp_path):
    def draw(path):
        figure, axis = figures.new_figure()
        axis.plot([0, 1], [0, 1], **figures.model_style("CAMDM").line)
        return figures.save_figure(figure, path)

    one, two = draw(tmp_path / "a" / "one.png"), draw(tmp_path / "two.png")
    assert one.read_bytes() == two.read_bytes()
    with Image.open(one) as image:
        assert image.size == (770, 396)
        assert not {"Software", "Creation Time", "date"} & set(image.info)
    refused(r"written as \.png", draw, tmp_path / "figure.pdf")
