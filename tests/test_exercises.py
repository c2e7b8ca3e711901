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


def tagged_cells(tag: str) -> list[tuple[str, str]]:
    """(number, source) of each cell with a tag."""
    paths = sorted(NOTEBOOKS.glob("[0-9][0-9]_*.ipynb")) + sorted(NOTEBOOKS.glob("course/[0-9][0-9]_*.ipynb"))
    cells = [cell for path in paths for cell in nbformat.v4.reads(path.read_text("utf-8")).cells]
    return [(asked_number(cell.source), cell.source) for cell in cells if tag in cell.metadata.get("tags", [])]


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
    return [pytest.param(source, id=number) for number, source in cells]


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
