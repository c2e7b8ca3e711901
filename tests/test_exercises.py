"""Exercises: a stub is "not yet", a solution is "right", and a check never falls over an answer.

Every cell tagged `exercise` or `solution` is run alone, as a reader would who jumped to it.
"""

import ast
import re
from pathlib import Path

import nbformat
import numpy as np
import pytest
from helpers.exercises import CHECKS, check, hint
from helpers.exercises.judging import NotAnswered, agree

from f3amd_lib.diffusion import samplers

NOTEBOOKS = Path(__file__).resolve().parents[1] / "notebooks"
NUMBER = re.compile(r"\d{1,2}\.[a-z]")


def tagged_cells(tag: str) -> list[tuple[str, str, str, str]]:
    """(number, notebook, Markdown before it, source) of each code cell with a tag."""
    found = []
    for path in sorted(NOTEBOOKS.glob("[0-9][0-9]_*.ipynb")):
        cells = nbformat.read(path, as_version=4).cells
        for before, cell in zip(cells, cells[1:], strict=False):
            if tag in cell.metadata.get("tags", []):
                text = before.source if before.cell_type == "markdown" else ""
                found.append((asked_number(cell.source), path.stem, text, cell.source))
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


def test_exercises_stand_in_the_notebook_of_their_number_five_or_more_each():
    by_notebook = {}
    for number, notebook, text, _ in EXERCISES:
        assert int(number.split(".")[0]) == int(notebook[:2])
        assert f"**{number}" in text, f"{number} has no question before it"
        by_notebook.setdefault(notebook, []).append(number)
    assert [name[:2] for name in by_notebook] == ["02", "10", "11", "12"]
    for numbers in by_notebook.values():
        chapter = numbers[0].split(".")[0]
        assert numbers == [f"{chapter}.{letter}" for letter in "abcdefgh"[: len(numbers)]]
        assert len(numbers) >= 5


def test_solutions_lie_in_one_notebook_each_with_its_reason():
    assert len({notebook for _, notebook, _, _ in SOLUTIONS}) == 1
    for number, _, text, _ in SOLUTIONS:
        assert f"**{number}" in text and len(text) > 80, number


# The check itself.


def test_a_check_prints_a_sentence_and_returns_nothing(capsys):
    assert check("11.b", [4.0, 5.0]) is None and check("11.b", 4.0) is None
    assert capsys.readouterr().out == "11.b: right\n11.b: not yet: two numbers are asked for, in centimetres\n"


@pytest.mark.parametrize("number", ["2.z", "2a", "", 2])
def test_an_unknown_number_is_refused_with_the_nearest(number):
    with pytest.raises(ValueError, match=r"no exercise .*2\.a"):
        hint(number, 1.0)


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


# Notebook 02: answers that one can easily come to, and that are wrong.


@pytest.mark.parametrize("answer", [0.14, 0.01, 0.1**2 / 128, 0.02])
def test_one_steps_spread_is_neither_the_datas_nor_that_of_one_mode(answer):
    assert hint("2.a", answer)


@pytest.mark.parametrize(
    "step",
    [
        samplers.ddim_step_literal,
        lambda x, x0_hat, sigma, sigma_next: x0_hat + sigma_next * (x - x0_hat),
        lambda x, x0_hat, sigma, sigma_next: samplers.ddpm_step(x, x0_hat, sigma, sigma_next, 0.0),
    ],
    ids=["printed", "not divided by sigma", "ancestral"],
)
def test_another_step_is_not_ddim(step):
    assert "sigma = 2 to 0.5" in hint("2.b", step)


def test_hints_on_the_curvature_say_what_was_measured():
    assert "at rho = 3 it is 0.309, and 0.232 is wanted" in hint("2.c", 2)
    assert hint("2.c", 5) and hint("2.c", 20) is None


def test_numbers_of_steps_are_judged_one_by_one():
    assert hint("2.d", [2048, 114]).startswith("Euler has an error of 0.0011 after 2048")
    assert hint("2.d", [2253, 58]).startswith("Heun")
    assert hint("2.d", 2253) and "two numbers" in hint("2.d", [1, 2, 3])


def test_ddims_shares_are_not_ddpms():
    right, wrong = (0.0625, 0.4841, 0.25), (0.25, 0.4841, 0.484)
    late = (0.9025, 0.5933, 3.61)
    assert hint("2.e", np.array([right, late])) is None
    assert "first row" in hint("2.e", [wrong, late])
    assert "second row" in hint("2.e", [right, right])


def test_the_vp_state_itself_is_not_what_a_ve_network_wants():
    assert hint("2.f", lambda denoise: lambda z, ab: denoise(z, np.sqrt((1 - ab) / ab)))
    assert hint("2.f", lambda denoise: lambda z, ab: denoise(z / np.sqrt(ab), np.sqrt(1 - ab)))


def test_appendix_f_defines_a_root_that_its_update_does_not_use():
    """alpha_t = sqrt(alpha_bar_t / alpha_bar_(t-1)) stands in DDPM's mean, not in DDIM's step."""
    levels = np.array([1e-4, 0.2, 0.8, 0.99, 1.0])
    for alpha_bar, alpha_bar_next in zip(levels, levels[1:], strict=False):
        alpha_t = np.sqrt(alpha_bar / alpha_bar_next)
        noise_left = (1 - alpha_bar_next) / (1 - alpha_bar)
        on_z = samplers.ddpm_posterior(alpha_bar, alpha_bar_next)[1]
        np.testing.assert_allclose(on_z, alpha_t * noise_left, rtol=1e-12)
        # The DDIM step is told by both alpha_bars alone.
        ddim = samplers.ddim_step_vp(1.0, 0.0, alpha_bar, alpha_bar_next)
        np.testing.assert_allclose(ddim, np.sqrt(noise_left), rtol=1e-12)
    right = lambda root, ab, ab_next: (root * (1 - ab_next) / (1 - ab), np.sqrt((1 - ab_next) / (1 - ab)))
    assert hint("2.g", right) is None
    assert "DDPM" in hint("2.g", lambda *given: right(*given)[::-1])
