"""What the checks of several exercises share: reading an answer and comparing it."""

from __future__ import annotations

import numpy as np


class NotAnswered(ValueError):
    """There is no answer to judge yet; the message is the hint."""


def is_missing(answer) -> bool:
    """Return whether an answer, or a part of it, is still that of a stub: None or `...`."""
    if isinstance(answer, (tuple, list)):
        return any(map(is_missing, answer))
    return answer is None or answer is ...


def numbers(answer) -> np.ndarray:
    """Return what a reader's function gave as an array of float64.

    Raises:
      NotAnswered: for None or `...`, which a stub's function returns.
      TypeError, ValueError: if the answer is made of something else than numbers.
    """
    if is_missing(answer):
        raise NotAnswered("your function returns nothing yet")
    return np.asarray(answer, dtype=np.float64)


def agree(answer, expected, *, rtol: float = 0.0, atol: float = 0.0) -> bool:
    """Return whether an answer has the shape and, within a tolerance, the values expected.

    Args:
      answer: a number, or a list or array of them.
      expected: likewise.
      rtol, atol: relative and absolute tolerance; an entry may differ by atol + rtol |expected|.

    Raises:
      NotAnswered: for None or `...`, which a stub's function returns.
      TypeError, ValueError: if the answer is made of something else than numbers.
    """
    answer, expected = numbers(answer), np.asarray(expected, dtype=np.float64)
    if answer.shape != expected.shape:
        return False
    return bool(np.all(np.abs(answer - expected) <= atol + rtol * np.abs(expected)))


def is_choice(answer, expected: str) -> bool:
    """Return whether an answer in words is the expected one; case and outer blanks do not count."""
    return isinstance(answer, str) and answer.strip().lower() == expected.lower()
