"""Exercises of the theory notebooks: a stub in the notebook, and a check that knows what is right.

An exercise has a number, "2.a" for the first one of notebook 02. Its stub ends in
`check("2.a", answer)`, which says whether the answer is right and, where it is not, gives a hint
that does not give it away. What is right is worked out or measured by the check itself, with the
functions of the library.

Each module here holds the exercises of one notebook as `CHECKS`: by number, a function of the
answer that returns None if it is right, else the hint.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from f3amd_lib.exercises import networks, one_step, printed_update, sampler_theory
from f3amd_lib.exercises.judging import NotAnswered, is_missing
from f3amd_lib.ground.names import nearest_hint

CHECKS: dict[str, Callable[[Any], str | None]] = (
    sampler_theory.CHECKS | printed_update.CHECKS | one_step.CHECKS | networks.CHECKS
)
"""The checks of all exercises by number, in the order of the notebooks."""


@dataclass(frozen=True)
class Verdict:
    """What `check` says; it shows itself as "2.a: right" or "2.a: not yet: <hint>".

    Attributes:
      number: of the exercise.
      hint: what to think of next; None if the answer is right.
    """

    number: str
    hint: str | None = None

    @property
    def right(self) -> bool:
        """Whether the answer is right."""
        return self.hint is None

    def __bool__(self) -> bool:
        return self.right

    def __repr__(self) -> str:
        return f"{self.number}: " + ("right" if self.right else f"not yet: {self.hint}")


def check(number: str, answer) -> Verdict:
    """Say whether an answer to an exercise is right.

    Args:
      number: of the exercise, "2.a".
      answer: what the exercise asks for: a number, several, a word or a function. One that is
        missing (None or `...`), of another kind, or that fails when it is tried is "not yet".

    Returns:
      The verdict, with a hint if the answer is not right.

    Raises:
      ValueError: for a number that no exercise has.
    """
    if number not in CHECKS:
        raise ValueError(f"no exercise {number!r}{nearest_hint(number, CHECKS)}")
    if is_missing(answer):
        return Verdict(number, "put your answer in the place of `...`")
    # An answer may be anything, a function that fails included: that is a wrong answer, no crash.
    try:
        return Verdict(number, CHECKS[number](answer))
    except NotAnswered as error:
        return Verdict(number, str(error))
    except Exception as error:
        return Verdict(number, f"this cannot be tried ({type(error).__name__}: {error})")
