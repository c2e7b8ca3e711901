"""Exercises of the theory notebooks: a stub in the notebook, and a check that knows what is right.

An exercise has a number, "2.a" for the first one of notebook 02, "C1.a" for that of the course's first
notebook. Its stub ends in `check("2.a", answer)`, which prints whether the answer is right and, where it
is not, a hint that does not give it away. What is right is worked out or measured by the check itself,
with the functions of the library.

Each module here holds the exercises of one notebook as `CHECKS`: by number, a function of the
answer that returns None if it is right, else the hint.
"""

from __future__ import annotations

from importlib import import_module
from importlib.util import find_spec

from f3amd_lib.ground.names import nearest_hint
from f3amd_lib.ground.profiles import refuse_unknown_parameters

from f3amd_notebooks.exercises.judging import NotAnswered, is_missing

_OF_NETWORKS = ["one_step", "networks"] if find_spec("flax") else []  # the course goes without them

CHECKS = {
    number: check
    for room in ("sampler_theory", "printed_update", *_OF_NETWORKS, "course")
    for number, check in import_module(f"{__name__}.{room}").CHECKS.items()
}
"""The checks of all exercises by number, in the order of the notebooks."""


def hint(number: str, answer) -> str | None:
    """Return what to think of next, or None if an answer is right.

    Args:
      number: of the exercise, "2.a".
      answer: what the exercise asks for: a number, several, a word or a function. One that is
        missing (None or `...`), of another kind, or that fails when it is tried gets a hint.

    Raises:
      ValueError: for a number that no exercise has.
    """
    if number not in CHECKS:
        raise ValueError(f"no exercise {number!r}{nearest_hint(number, CHECKS)}")
    if is_missing(answer):
        return "put your answer in the place of `...`"
    # An answer may be anything, a function that fails included: that is a wrong answer, no crash.
    try:
        return CHECKS[number](answer)
    except NotAnswered as error:
        return str(error)
    except Exception as error:
        return f"this cannot be tried ({type(error).__name__}: {error})"


def check(number: str, answer) -> None:
    """Print whether an answer is right: "2.a: right" or "2.a: not yet: <hint>"; see `hint`."""
    refuse_unknown_parameters()  # here for notebooks that load no profile
    found = hint(number, answer)
    print(f"{number}: {'right' if found is None else f'not yet: {found}'}")
