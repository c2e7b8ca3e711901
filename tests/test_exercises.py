"""Exercises: a stub is "not yet", a solution is "right", and a check never falls over an answer.

Every cell tagged `exercise` or `solution` is run alone, as a reader would who jumped to it.
"""

import ast
import re
from pathlib import Path

import nbformat
import numpy as np
import pytest
from f3amd_notebooks.exercises import CHECKS, hint
from f3amd_notebooks.exercises.judging import NotAnswered, agree

NOTEBOOKS = Path(__file__).resolve().parents[1] / "notebooks"


def tagged_cells(tag: str) -> list[tuple[str, str, str, str]]:
    """(number, notebook, Markdown before it, source) of each code cell with a tag."""
    found = []
    for path in sorted(NOTEBOOKS.glob("[0-9][0-9]_*.ipynb")) + sorted(NOTEBOOKS.glob("course/[0-9][0-9]_*.ipynb")):
        cells = nbformat.read(path, as_version=4).cells
        for before, cell in zip(cells, cells[1:], strict=False):
            if tag in cell.metadata.get("tags", []):
                text = before.source if before.cell_type == "markdown" else ""
                found.append(
                    (
                        asked_number(cell.source),
                        path.relative_to(NOTEBOOKS).with_suffix("").as_posix(),
                        text,
                        cell.source,
                    )
                )
    return found


def asked_number(source: str) -> str:
    """The number in the last line of a cell, `check("2.a", answer)`."""
    call = ast.parse(source).body[-1].value
    assert isinstance(call, ast.Call) and call.func.id == "check", ast.unparse(call)
    return ast.literal_eval(call.args[0])


def run_alone(source: str, capsys) -> str:
    """Run a cell in a namespace of its own and return the last line that it prints."""
    exec(compile(source, "cell", "exec"), {"__name__": "__main__"})
    return capsys.readouterr().out.splitlines()[-1]


EXERCISES, SOLUTIONS = tagged_cells("exercise"), tagged_cells("solution")


def sources(cells):
    return [pytest.param(source, id=number) for number, _, _, source in cells]


@pytest.fixture
def in_notebooks(monkeypatch):
    """The folder in which notebooks run."""
    monkeypatch.chdir(NOTEBOOKS)


@pytest.mark.parametrize("source", sources(EXERCISES))
def test_a_stub_alone_is_not_yet_right_and_gets_a_hint(source, in_notebooks, capsys):
    verdict = run_alone(source, capsys)
    assert re.fullmatch(rf"{asked_number(source)}: not yet: .+", verdict)
    assert "cannot be tried" not in verdict  # a stub is unanswered, not broken


@pytest.mark.parametrize("source", sources(SOLUTIONS))
def test_a_solution_alone_is_right(source, in_notebooks, capsys):
    assert run_alone(source, capsys) == f"{asked_number(source)}: right"


def test_every_exercise_has_one_stub_one_solution_and_one_check():
    stubs, solved = ([cell[0] for cell in cells] for cells in (EXERCISES, SOLUTIONS))
    assert stubs == solved == list(CHECKS)
    assert len(set(stubs)) == len(stubs) >= 20


def test_exercises_stand_in_the_notebook_of_their_number_five_or_more_each_two_in_the_course():
    by_notebook = {}
    for number, notebook, text, _ in EXERCISES:
        assert number.split(".")[0] == re.sub(r"^(course/)?0?(\d+)_.*", lambda m: "C" * bool(m[1]) + m[2], notebook)
        assert f"**{number}" in text, f"{number} has no question before it"
        by_notebook.setdefault(notebook, []).append(number)
    assert [name[:2] for name in by_notebook if "/" not in name] == ["02", "10", "11", "12"]
    for notebook, numbers in by_notebook.items():
        chapter = numbers[0].split(".")[0]
        assert numbers == [f"{chapter}.{letter}" for letter in "abcdefgh"[: len(numbers)]]
        assert len(numbers) >= (2 if notebook.startswith("course/") else 5)


def test_solutions_lie_in_notebooks_of_their_own_each_with_its_reason():
    solved = {notebook for _, notebook, _, _ in SOLUTIONS}
    assert all(notebook.endswith("_solutions") for notebook in solved)
    assert solved.isdisjoint(notebook for _, notebook, _, _ in EXERCISES)
    for number, _, text, _ in SOLUTIONS:
        assert f"**{number}" in text and len(text) > 80, number


# The check itself.


@pytest.mark.parametrize("number", list(CHECKS))
@pytest.mark.parametrize("answer", [None, ..., (..., 1.0), [(1.0, None)]], ids=repr)
def test_a_missing_answer_is_not_yet(number, answer):
    assert hint(number, answer) == "put your answer in the place of `...`"


def broken(*args, **kwargs):
    raise KeyError("lost")


@pytest.mark.parametrize("number", list(CHECKS))
@pytest.mark.parametrize("answer", ["no", object(), -1e9, np.full((3, 4), np.nan), broken, {}], ids=lambda a: type(a))
def test_a_senseless_answer_is_not_yet_and_never_an_error(number, answer):
    assert hint(number, answer)


def test_agreement_asks_for_shape_and_value():
    assert agree([1.0, 2.0], (1.0, 2.0)) and agree(np.float32(0.5), 0.5)
    assert not agree([1.0, 2.0], 1.0) and not agree([[1.0]], [1.0])
    assert agree(1.09, 1.0, rtol=0.1) and not agree(1.11, 1.0, rtol=0.1)
    assert agree([0.0, 0.05], [0.0, 0.0], atol=0.1) and not agree(np.nan, 1.0, atol=10.0)
    for nothing in (None, ..., (1.0, ...)):
        with pytest.raises(NotAnswered, match="returns nothing"):
            agree(nothing, 1.0)
