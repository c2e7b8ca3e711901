"""The lesson plan: what it names is there, its minutes add up, and its answers are right."""

import ast
import re
from pathlib import Path

import nbformat
import pytest
from f3amd_notebooks.exercises import CHECKS, hint

from f3amd_companion.ledger.equation_map import notebook_sections

IN_SESSIONS = [number for number in CHECKS if not number.startswith("C")]
"""Exercises of the three sessions; those of the course have numbers that begin with C."""
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
    assert sorted(planned) == sorted(IN_SESSIONS)
    assert set(NUMBER.findall(TEXT)) == set(IN_SESSIONS)


def test_every_exercise_has_an_expected_answer():
    assert list(ANSWERS) == IN_SESSIONS
    assert all(ANSWERS.values())


@pytest.mark.parametrize("number", NUMERIC)
def test_expected_answers_that_are_numbers_are_right(number):
    assert hint(number, ast.literal_eval(NUMERIC[number])) is None


def test_many_answers_are_numbers_that_are_checked():
    assert len(NUMERIC) >= 10


# Reading times: what a notebook's head says is what the plan's rule gives.


def minutes_by_rule(cells) -> float:
    """180 words or 30 lines of code a minute, and 45 seconds for a displayed equation or a picture."""
    prose = " ".join(cell.source for cell in cells if cell.cell_type == "markdown")
    code = [cell for cell in cells if cell.cell_type == "code"]
    shown = prose.count("$$") // 2
    shown += sum("image/png" in output.get("data", {}) for cell in code for output in cell.outputs)
    words = len(re.findall(r"\w+", re.sub(r"\$\$.*?\$\$|\$[^$]*\$", " x ", prose, flags=re.S)))
    lines = sum(bool(line.strip()) for cell in code for line in cell.source.splitlines())
    return words / 180 + lines / 30 + 0.75 * shown


def stated_minutes(notebook) -> tuple[int, int]:
    """Minutes to read, and for the exercises, as the first cell says."""
    found = re.search(
        r"about (\d+) minutes to read(?: as a whole)?(?:, and (\d+) for the exercises)?;", notebook.cells[0].source
    )
    return int(found[1]), int(found[2] or 0)


NOTEBOOKS = PLAN.parents[1] / "notebooks"
BESIDE_THE_PAPER = [path.name for path in sorted(NOTEBOOKS.glob("[0-9]*.ipynb"))]
STANDALONE = ["standalone/sampler_theory_standalone.ipynb"]
COURSE = [f"course/{path.name}" for path in sorted((NOTEBOOKS / "course").glob("*.ipynb"))]


@pytest.mark.parametrize("name", COURSE)
def test_a_notebook_of_the_course_takes_less_than_half_an_hour(name):
    reading, exercises = stated_minutes(nbformat.read(NOTEBOOKS / name, as_version=4))
    assert name.endswith("_solutions.ipynb") or (8 <= reading <= 25 and reading + exercises <= 35)


@pytest.mark.parametrize("name", BESIDE_THE_PAPER + STANDALONE + COURSE)
def test_a_notebook_says_honestly_how_long_it_takes(name):
    notebook = nbformat.read(NOTEBOOKS / name, as_version=4)
    reading, exercises = stated_minutes(notebook)
    assert reading == pytest.approx(minutes_by_rule(notebook.cells), rel=0.2)
    count = sum("exercise" in cell.metadata.get("tags", []) for cell in notebook.cells)
    assert 3 * count <= exercises <= 5 * count


def test_the_plan_takes_as_long_over_a_notebook_as_its_head_says():
    planned = {}
    for cells in [cells for session in SESSIONS for cells in rows(session)]:
        name = Path(re.search(r"\((.*)\)", cells[2])[1]).name
        planned[name] = planned.get(name, 0) + int(cells[0])
    for name, minutes in planned.items():
        total = sum(stated_minutes(nbformat.read(NOTEBOOKS / name, as_version=4)))
        taught_whole = name.startswith("02")
        assert (0.9 * total if taught_whole else 0) <= minutes <= 1.1 * total, name


def cells_of_section(notebook, heading: str):
    """Yield the cells of a section; a cell that holds several sections is cut at their headings."""
    inside = False
    for cell in notebook.cells:
        parts = re.split(r"^(?=## )", cell.source, flags=re.M) if cell.cell_type == "markdown" else [None]
        for part in parts:
            if part is not None and part.startswith("## "):
                inside = part.splitlines()[0] == f"## {heading}"
            if inside:
                yield cell if part is None else nbformat.v4.new_markdown_cell(part)


@pytest.mark.parametrize("session", SESSIONS, ids=lambda text: text.splitlines()[0])
def test_no_row_is_shorter_than_reading_its_section_takes(session):
    for cells in rows(session):
        heading, path = re.fullmatch(r"\[(.*)\]\((.*)\)", cells[2]).groups()
        section = list(cells_of_section(nbformat.read(PLAN.parent / path, as_version=4), heading))
        assert len(section) >= 2  # prose and code, or the heading was not found
        assert int(cells[0]) >= 0.9 * minutes_by_rule(section), heading


def test_answers_are_folded_away_and_the_plan_is_linked():
    unfolded = re.sub(r"<details>.*?</details>", "", TEXT, flags=re.S)
    assert TEXT.count("<details>") == TEXT.count("Board question") + 1
    assert not any(f"| {answer} |" in unfolded for answer in ANSWERS.values())
    root = PLAN.parents[1]
    assert "docs/lesson_plan.md" in (root / "README.md").read_text(encoding="utf-8")
    assert "lesson_plan" in (root / "docs/index.md").read_text(encoding="utf-8")


SEMESTER = PLAN.with_name("semester.md").read_text(encoding="utf-8")


def test_the_semester_has_twelve_weeks_and_the_afternoon_three_hours():
    weeks, afternoon = (rows(part) for part in re.split(r"^## ", SEMESTER, flags=re.M)[1:])
    assert [cells[0] for cells in weeks] == [str(week) for week in range(1, 13)]
    assert sum(int(cells[0]) for cells in afternoon) == 180
    for cells in weeks:
        title, path = re.match(r"\[(.*?)\]\((.*?)\)", cells[2]).groups()
        first = nbformat.read(PLAN.parent / path, as_version=4).cells[0].source
        assert first.startswith(f"# {title.split(' · ')[0]} · ")
        chapter = title.split(" · ")[0].lstrip("0")
        exercises = re.findall(r"C?\d+\.[a-z]", cells[3])
        assert all(number in CHECKS and number.split(".")[0] == chapter for number in exercises)


def test_every_exercise_of_the_course_is_in_the_semester_once():
    named = re.findall(r"\bC\d+\.[a-z]\b", SEMESTER)
    assert sorted(named) == sorted(number for number in CHECKS if number.startswith("C"))
    links = re.findall(r"\]\(([^)#]+)\)", SEMESTER)
    assert [link for link in links if not (PLAN.parent / link).is_file()] == []
