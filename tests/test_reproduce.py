"""The main job runs notebooks in order, passes parameters, stops where one stops and says where."""

import json
import os
import runpy
import subprocess
import sys
from pathlib import Path

import nbformat
import pandas as pd
import pytest
from builders import refused

from f3amd_companion import reproduce
from f3amd_companion.__main__ import main
from f3amd_lib.ground import profiles
from f3amd_lib.ground.records import read_table

PARAMETERS = 'profile = "smoke"\ndata = "synthetic"\nnum_steps = 2'
WRITE_WHAT_I_SAW = """
import json, os, pathlib
from f3amd_lib.ground.profiles import results_dir
seen = dict(profile=profile, data=data, num_steps=num_steps, cwd=pathlib.Path.cwd().name)
(results_dir(data, profile) / "tables" / "seen.json").write_text(json.dumps(seen))
"""


def write_notebook(folder, name, *sources):
    """Write a notebook whose first cell is tagged as the parameters cell."""
    cells = [nbformat.v4.new_code_cell(source) for source in sources]
    cells[0].metadata["tags"] = ["parameters"]
    notebook = nbformat.v4.new_notebook(cells=cells)
    notebook.metadata["kernelspec"] = {"name": "python3", "display_name": "Python 3", "language": "python"}
    folder.mkdir(exist_ok=True)
    nbformat.write(notebook, folder / f"{name}.ipynb")
    return folder / f"{name}.ipynb"


@pytest.fixture
def checkout(tmp_path, monkeypatch):
    """An empty folder that stands for the repository, with notebooks/ to be filled."""
    monkeypatch.setattr(profiles, "repository_root", lambda: tmp_path)
    # The kernels import the library anew: tell them where it is, and where results go.
    monkeypatch.setenv("PYTHONPATH", str(Path(reproduce.__file__).parents[1]))
    monkeypatch.setenv(profiles.RESULTS_DIR_VARIABLE, str(tmp_path / "results"))
    return tmp_path


def test_notebooks_run_in_order_with_their_parameters(checkout):
    folder = checkout / "notebooks"
    # The second leans on what the first wrote, and was written to disk before it.
    write_notebook(folder, "01_second", PARAMETERS, "assert open('note.txt').read() == 'first'")
    write_notebook(folder, "00_first", PARAMETERS, "open('note.txt', 'w').write('first')", WRITE_WHAT_I_SAW)
    write_notebook(folder, "scratch", PARAMETERS, "raise SystemError('not numbered: must not run')")
    news = []

    summary = reproduce.reproduce("bandai", "smoke", parameters={"num_steps": 5}, say=news.append)

    assert list(summary["notebook"]) == ["00_first.ipynb", "01_second.ipynb"]
    assert list(summary["cells"]) == [3, 2]
    assert summary["finished"].all()
    results = checkout / "results" / "bandai" / "smoke"
    seen = json.loads((results / "tables" / "seen.json").read_text())
    assert seen == {"profile": "smoke", "data": "bandai", "num_steps": 5, "cwd": "notebooks"}
    table, record = read_table(results / "tables" / "run_summary.csv")
    pd.testing.assert_frame_equal(table, summary)
    assert (record["profile"], record["dataset"]) == ("smoke", "bandai")
    assert record["parameters"]["num_steps"] == 5
    copies = checkout / "runs" / "bandai" / "smoke" / "notebooks"
    assert sorted(path.name for path in copies.iterdir()) == ["00_first.ipynb", "01_second.ipynb"]
    # One line a notebook, with its time.
    assert [line.split()[0] for line in news] == ["00_first", "01_second"]


NOTEBOOKS = Path(reproduce.__file__).parents[1] / "notebooks"


@pytest.mark.slow
@pytest.mark.parametrize(
    "notebook, folder",
    [
        ("08_claims.ipynb", NOTEBOOKS.parent),
        ("08_claims.ipynb", None),
        ("course/02_sde.ipynb", None),
        ("standalone/sampler_theory_standalone.ipynb", None),
    ],
    ids=lambda given: given.name if isinstance(given, Path) else given or "elsewhere",
)
def test_plain_papermill_runs_each_kind_of_notebook_from_any_folder(notebook, folder, tmp_path):
    (tmp_path / "empty").mkdir()
    environment = os.environ | {profiles.RESULTS_DIR_VARIABLE: str(tmp_path / "results")}
    call = [sys.executable, "-m", "papermill", str(NOTEBOOKS / notebook), str(tmp_path / "copy.ipynb")]
    done = subprocess.run(call, cwd=folder or tmp_path / "empty", env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert not any((tmp_path / "empty").iterdir())
    assert any((tmp_path / "results").rglob("08_*")) == (notebook == "08_claims.ipynb")


@pytest.mark.slow
def test_plain_papermill_refuses_a_parameter_that_a_notebook_does_not_have(tmp_path):
    call = [sys.executable, "-m", "papermill", str(NOTEBOOKS / "08_claims.ipynb"), "copy.ipynb", "-p", "profle", "gpu"]
    done = subprocess.run(call, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 1
    assert "unknown parameter of this notebook 'profle'; did you mean 'profile'?" in done.stderr


def test_it_stops_at_the_first_failure_and_says_where(checkout, capsys):
    folder = checkout / "notebooks"
    write_notebook(folder, "00_fine", PARAMETERS, "1 + 1")
    broken = write_notebook(folder, "01_broken", PARAMETERS, "\nspeed = 3\nspeed / 0", "2 + 2")
    write_notebook(folder, "02_never", PARAMETERS, "open('never.txt', 'w')")
    before = broken.read_bytes()

    status = main(["figures", "--profile", "smoke"])

    assert status == 2
    message = capsys.readouterr().err
    # In [1] parameters, In [2] the injected ones, In [3] the culprit.
    assert "01_broken.ipynb stopped in cell In [3], 'speed = 3'" in message
    assert "ZeroDivisionError: division by zero" in message
    own_folder = checkout / "runs" / "synthetic" / "smoke"
    log = own_folder / "notebooks" / "01_broken.log"
    assert str(log.relative_to(checkout)) in message
    assert "ZeroDivisionError" in log.read_text()
    assert not (folder / "never.txt").exists()
    assert broken.read_bytes() == before
    summary, _ = read_table(own_folder / "run_summary.csv")
    assert list(summary["finished"]) == [True, False]
    # An incomplete run leaves no summary among the results.
    assert not list((checkout / "results").rglob("run_summary.csv"))


def test_a_killed_kernel_is_told_with_its_cell(checkout):
    write_notebook(checkout / "notebooks", "00_hungry", PARAMETERS, "import os\nos._exit(9)", "1 + 1")
    with pytest.raises(reproduce.NotebookFailed, match=r"cell In \[3\], 'import os'") as caught:
        reproduce.reproduce("synthetic", "smoke")
    assert "Kernel died" in str(caught.value)


def test_one_notebook_alone_leaves_the_whole_runs_summary(checkout):
    folder = checkout / "notebooks"
    write_notebook(folder, "00_first", PARAMETERS, "raise RuntimeError('not asked for')")
    write_notebook(folder, "01_second", PARAMETERS, "1 + 1")
    assert main(["figures", "--profile", "smoke", "--only", "1"]) == 0
    summary, record = read_table(checkout / "runs" / "synthetic" / "smoke" / "run_summary.csv")
    assert list(summary["notebook"]) == record["notebooks"] == ["01_second.ipynb"]
    assert not list((checkout / "results").rglob("run_summary.csv"))


@pytest.mark.parametrize(
    "arguments, complaint",
    [
        (["--set", "num_step=4"], "00_first.ipynb has no parameter 'num_step'; did you mean"),
        (["--profile", "labtop"], "unknown profile 'labtop'; did you mean 'laptop'"),
        (["--data", "bandia"], "unknown data set 'bandia'; did you mean 'bandai'"),
        (["--only", "7"], "no notebook '7' (one of 00_first, 01_second)"),
        (["--only", "01_secnd"], "no notebook '01_secnd'; did you mean '01_second'"),
    ],
)
def test_unknown_names_are_refused_before_anything_runs(checkout, capsys, arguments, complaint):
    folder = checkout / "notebooks"
    write_notebook(folder, "00_first", PARAMETERS, "open('ran.txt', 'w')")
    write_notebook(folder, "01_second", PARAMETERS)
    assert main(["figures", "--profile", "smoke", *arguments]) == 2
    assert complaint in capsys.readouterr().err
    assert not (folder / "ran.txt").exists()
    assert not (checkout / "runs").exists()


def test_a_folder_without_notebooks_is_refused(checkout):
    refused("no numbered notebooks", reproduce.reproduce, "synthetic", "smoke")


@pytest.mark.parametrize(
    "profile, already_set, expected",
    [("gpu", None, "paper_figures"), ("smoke", None, "runs"), ("laptop", "elsewhere", "elsewhere")],
)
def test_only_real_runs_write_into_the_committed_folder(checkout, monkeypatch, profile, already_set, expected):
    name = profiles.RESULTS_DIR_VARIABLE
    if already_set is None:
        monkeypatch.delenv(name)
    else:
        monkeypatch.setenv(name, str(checkout / already_set))
    reproduce.set_folders(profile)
    assert profiles.results_dir("synthetic", profile) == checkout / expected / "synthetic" / profile


@pytest.mark.parametrize("text", ["num_steps", "=4", "two words=4", "profile=gpu"])
def test_broken_assignments_are_refused(text, capsys):
    assert main(["figures", "--set", text]) == 2
    assert text.partition("=")[0] in capsys.readouterr().err


@pytest.mark.slow
def test_the_course_runs_without_parameters_into_copies_of_its_own(checkout):
    folder = checkout / "notebooks/course"
    folder.mkdir(parents=True)
    write_notebook(folder, "01_first", "import pathlib; assert pathlib.Path.cwd().name == 'course'")
    write_notebook(folder, "02_broken", "raise ValueError('stop here')")
    news = []
    (copy,) = reproduce.run_course(["1"], say=news.append)
    assert copy == checkout / "runs/course/01_first.ipynb" and copy.is_file()
    assert news[0].startswith("01_first")
    with pytest.raises(reproduce.NotebookFailed, match="02_broken"):
        reproduce.run_course()


def test_a_picture_of_one_name_and_bytes_stands_once(tmp_path):
    ours, theirs = tmp_path / "synthetic/laptop", tmp_path / "bandai/laptop"
    files = {
        ours / "figures/02_paths.png": b"theory", theirs / "figures/02_paths.png": b"theory",
        theirs / "figures/02_other.png": b"theory", ours / "figures/05_feet.png": b"a",
        theirs / "figures/05_feet.png": b"b", theirs / "media/05_feet.png": b"b",
        ours / "tables/02_paths.csv": b"theory",
    }  # fmt: skip
    for path, content in files.items():
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
    reproduce.keep_once([ours, theirs])
    gone = {theirs / "figures/02_paths.png", theirs / "media/05_feet.png"}
    assert {path for path in files if path.is_file()} == set(files) - gone


def test_without_the_packages_that_run_notebooks_their_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "papermill", None)
    with pytest.raises(ImportError, match=r"f3amd_lib\[notebooks\]"):
        runpy.run_path(reproduce.__file__)
