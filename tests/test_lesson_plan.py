"""The plan for teaching: expected answers that are numbers are right."""

import ast
import re
from pathlib import Path

import pytest
from f3amd_notebooks.exercises import hint

PLAN = (Path(__file__).resolve().parents[1] / "docs" / "teaching.md").read_text(encoding="utf-8")
NUMERIC = dict(re.findall(r"^\| (\S+) \| `([^`]+)` \|", PLAN.split("## Expected answers")[1], re.M))


@pytest.mark.parametrize("number", NUMERIC)
def test_expected_answers_that_are_numbers_are_right(number):
    assert hint(number, ast.literal_eval(NUMERIC[number])) is None
