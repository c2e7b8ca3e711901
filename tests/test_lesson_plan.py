"""The lesson plan: what it names is there, its minutes add up, and its answers are right."""

import ast
import re
from pathlib import Path

import pytest
from helpers.exercises import CHECKS, hint

from f3amd_lib.reports.equation_map import notebook_sections

PLAN = Path(__file__).resolve().parents[1] / "docs/lesson_plan.md"
TEXT = PLAN.read_text(encoding="utf-8")
NUMBER = re.compile(r"\b\d{1,2}\.[a-z]\b")


def rows(part: str) -> list[list[str]]:
    """Cells of the table rows of a part of the plan, without heading and rule."""
    lines = [line for line in part.splitlines() if line.startswith("|")]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines[2:]]


SESSIONS = re.split(r"^## ", TEXT, flags=re.M)[1:-1]
ANSWERS = {cells[0]: cells[1] for cells in rows(TEXT.split("## Expected answers")[1])}
NUMERIC = {number: text.strip("`") for number, text in ANSWERS.items() if text.startswith("`")}


def test_three_sessions_of_fifty_minutes_with_goals():
    assert len(SESSIONS) == 3
    for session in SESSIONS:
        assert sum(int(cells[0]) for cells in rows(session)) == 50
        assert session.count("\n- ") >= 3 and "Board question" in session


@pytest.mark.parametrize("session", SESSIONS, ids=lambda text: text.splitlines()[0])
def test_every_heading_that_is_named_exists(session):
    for cells in rows(session):
        heading, path = re.fullmatch(r"\[(.*)\]\((.*)\)", cells[2]).groups()
        headings = [section.heading for section in notebook_sections(PLAN.parent / path)]
        assert heading in headings


def test_every_link_leads_to_a_file():
    links = re.findall(r"\]\(([^)#]+\.(?:ipynb|md))", TEXT)
    assert len(links) > 20
    assert [link for link in links if not (PLAN.parent / link).is_file()] == []


def test_every_exercise_is_planned_once_beside_a_section_of_its_notebook():
    planned = []
    for cells in [cells for session in SESSIONS for cells in rows(session)]:
        for number in NUMBER.findall(cells[3]):
            assert cells[2].startswith(f"[{number.split('.')[0]}.")
            planned.append(number)
    assert sorted(planned) == sorted(CHECKS)
    assert set(NUMBER.findall(TEXT)) == set(CHECKS)


def test_every_exercise_has_an_expected_answer():
    assert list(ANSWERS) == list(CHECKS)
    assert all(ANSWERS.values())


@pytest.mark.parametrize("number", NUMERIC)
def test_expected_answers_that_are_numbers_are_right(number):
    assert hint(number, ast.literal_eval(NUMERIC[number])) is None


def test_many_answers_are_numbers_that_are_checked():
    assert len(NUMERIC) >= 10
