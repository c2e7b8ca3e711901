"""The plans for teaching: what they name is there, minutes add up, and expected answers are right."""

import ast
import re
from pathlib import Path

import pytest
from f3amd_notebooks.exercises import CHECKS, hint
from f3amd_notebooks.labs import LABS

DOCS = Path(__file__).resolve().parents[1] / "docs"
PLAN = (DOCS / "teaching.md").read_text(encoding="utf-8").split("## A semester")[0]
SEMESTER = (DOCS / "lectures.md").read_text(encoding="utf-8")
IN_SESSIONS = [number for number in CHECKS if not number.startswith("C")]
"""Exercises of the three sessions; those of the course have numbers that begin with C."""


def rows(part: str) -> list[list[str]]:
    """Cells of the table rows of a part of the plan, without heading and rule."""
    lines = [line for line in part.splitlines() if line.startswith("|")]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines[2:]]


SESSIONS = re.split(r"^## ", PLAN, flags=re.M)[1:-1]
ANSWERS = {cells[0]: cells[1] for cells in rows(PLAN.split("## Expected answers")[1])}
NUMERIC = {number: text.strip("`") for number, text in ANSWERS.items() if text.startswith("`")}


def test_every_exercise_is_planned_once_and_has_an_expected_answer():
    planned = [number for session in SESSIONS for cells in rows(session)
               for number in re.findall(r"\b\d{1,2}\.[a-z]\b", cells[3])]  # fmt: skip
    assert len(SESSIONS) == 3 and sorted(planned) == sorted(IN_SESSIONS)
    assert list(ANSWERS) == IN_SESSIONS and all(ANSWERS.values())
    named = re.findall(r"\bC\d+\.[a-z]\b", SEMESTER)
    assert sorted(named) == sorted(number for number in CHECKS if number.startswith("C"))
    assert sorted(re.findall(r"\bL\d+\b", SEMESTER)) == sorted(LABS)


@pytest.mark.parametrize("number", NUMERIC)
def test_expected_answers_that_are_numbers_are_right(number):
    assert hint(number, ast.literal_eval(NUMERIC[number])) is None
