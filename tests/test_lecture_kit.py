"""The lecture kit: its sheets, editions of one source, labs as nbgrader wants them, and slides."""

import re
import runpy
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

from builders import refused
from f3amd_notebooks.exercises import CHECKS
from f3amd_notebooks.labs import LABS

ROOT = Path(__file__).resolve().parents[1]
KIT = SimpleNamespace(**runpy.run_path(str(ROOT / "docs" / "kit.py"), run_name="kit"))
LECTURES = KIT.lectures()


def test_lectures_name_sections_that_exist():
    assert all(KIT.section(KIT.read(name), head) for lecture in LECTURES for name, head in lecture["sections"])
    refused("no section C3.9", KIT.section, KIT.read("course/03_solvers"), "C3.9")


def test_both_editions_have_all_questions_and_one_of_them_the_solutions():
    made = KIT.editions(KIT.solutions())
    assert made["student"].keys() == made["teacher"].keys() and "course/13_labs" in made["student"]
    found = {}
    for edition, notebooks in made.items():
        cells = [cell for notebook in notebooks.values() for cell in notebook.cells]
        found[edition] = [number for cell in cells if (number := KIT.asked(cell))]
        for notebook in notebooks.values():
            assert len({cell.id for cell in notebook.cells}) == len(notebook.cells)
        solved = [cell for cell in cells if {"solution", "lab-solution"} & set(cell.metadata.get("tags", []))]
        assert len(solved) == (len(CHECKS) + len(LABS)) * (edition == "teacher")
    assert sorted(found["student"]) == sorted([*CHECKS, *LABS])
    assert sorted(found["teacher"]) == sorted(2 * found["student"])


def graded(source: str, test: str) -> bool:
    """Whether nbgrader would give the point: its cells run, as they stand, without an error."""
    names = {}
    exec(source, names)
    try:
        exec(test, names)
    except AssertionError:
        return False
    return True


def test_a_lab_gives_its_point_for_the_solution_and_none_for_the_stub(capsys):
    labs = KIT.nbgrader_labs(KIT.solutions())
    assert list(labs) == list(LABS)
    for notebook in labs.values():
        marks = [cell.metadata["nbgrader"] for cell in notebook.cells]
        assert [(mark["solution"], mark["grade"], mark["locked"]) for mark in marks] == [
            (False, False, True), (True, False, False), (False, True, True)]  # fmt: skip
    _, answer, test = (cell.source for cell in labs["L2"].cells)
    stub = re.sub(r"### BEGIN SOLUTION.*### END SOLUTION", "", answer, flags=re.S)
    assert "arctan" in answer and "arctan" not in stub
    assert graded(answer, test) and not graded(stub, test)


def test_a_deck_has_each_figure_with_its_caption_and_loads_nothing_from_outside(tmp_path, monkeypatch):
    monkeypatch.setitem(KIT.write_decks.__globals__, "DRAWN", ("none",))  # as stored
    monkeypatch.setitem(KIT.write_decks.__globals__, "lectures", lambda: LECTURES[3:4])
    monkeypatch.setitem(KIT.write_decks.__globals__, "package_file", lambda *_: b"")
    folder = tmp_path / "kit"
    folder.mkdir()
    KIT.write_decks(folder)
    for name in ("student", "teacher", "nbgrader"):
        (folder / f"{name}.zip").touch()
    sheets = tmp_path / "docs" / "lectures.html"
    sheets.parent.mkdir()
    sheets.write_text("<h1>Lectures</h1><h2>Lecture 1: one</h2><h2>Contents</h2>", encoding="utf-8")
    KIT.link_kit(sheets)
    (tmp_path / "_static" / "mathjax").mkdir(parents=True)
    (tmp_path / "_static" / "mathjax" / "tex-svg-full.js").touch()
    page = (folder / "lecture_1.html").read_text(encoding="utf-8")
    assert page.count("<img") == 6 and "Left: per step, Heun beats Euler" in page and "def answer" not in page
    check = [sys.executable, str(ROOT / "docs" / "check_links.py"), str(tmp_path)]
    found = subprocess.run(check, capture_output=True, text=True)
    assert found.returncode == 0, found.stdout
    assert sheets.read_text(encoding="utf-8").count(">Slides<") == 1
    sheets.write_text("<h1>Lectures</h1>", encoding="utf-8")
    refused("0 headings, 1 lectures", KIT.link_kit, sheets)
