"""Names and settings that people type: refuse an unknown one and say which is nearest; one check of their values."""

import dataclasses
import difflib
import math
import numbers
from collections.abc import Iterable, Mapping


def nearest_hint(name, known: Iterable[str]) -> str:
    """Return the end of an error message about an unknown name: "; did you mean 'laptop'? (one of smoke, laptop, gpu)".

    Case is ignored. The question is left out where nothing is near; of many names only the nearest are listed.
    """
    by_lower = {item.lower(): item for item in known}
    near = [by_lower[item] for item in difflib.get_close_matches(str(name).lower(), by_lower, n=3, cutoff=0.5)]
    question, names = f"; did you mean {near[0]!r}?" if near else "", list(known)
    if not names:
        return "; there is none to choose from"
    if len(names) <= 25:
        return f"{question} (one of {', '.join(names)})"
    return f"{question} ({len(names)} are known, such as {', '.join(near or names[:3])})"


def check_known(name, known: Iterable[str], what: str) -> None:
    """Raise ValueError, with the nearest name, for a name that is none of those known."""
    if name not in known:
        raise ValueError(f"unknown {what} {name!r}{nearest_hint(name, known)}")


def refuse_unknown(values: Mapping, config_class: type, what: str) -> None:
    """Raise ValueError, with the nearest name, for a key that is no field of a config class."""
    known = [field.name for field in dataclasses.fields(config_class) if field.init]
    for key in values:
        check_known(key, known, what)


def checked_seed(seed) -> int:
    """Return a seed; ValueError unless it is a whole number from 0 to 2^32 - 1, each of which gives other noise."""
    if isinstance(seed, bool) or not isinstance(seed, numbers.Integral) or not 0 <= seed < 2**32:
        raise ValueError(f"seed must be a whole number from 0 to {2**32 - 1}, got {str(seed)[:40]}")
    return int(seed)


_KINDS = {
    "int": (int, numbers.Integral, "a whole number"),
    "float": (float, numbers.Real, "a finite number"),
    "bool": (bool, bool, "true or false"),
    "str": (str, str, "a name"),
}
"""Type of a field -> what makes values of that type, what they are, and what they are called."""

_LIMITS = {
    "above 0": lambda value: value > 0,
    "0 or more": lambda value: value >= 0,
    "from 0 to 1": lambda value: 0 <= value <= 1,
    "from 0 to below 1": lambda value: 0 <= value < 1,
}


def checked_value(name: str, value, annotation: str, rule: str | Iterable[str] = "above 0"):
    """Return a setting's value as its field's type; one of a type that is not known here comes back as it is.

    Args:
      name: what messages call it; a "seed" is checked as such.
      value: what was given.
      annotation: type of its field, as source text has it (`from __future__ import annotations`).
      rule: of a number, a name of `_LIMITS`; of a name, those that are known.

    Raises:
      ValueError: for a value of another type (True is no number, 8.0 no count), out of range or unknown.
    """
    kind, *rest = annotation.split(" | ")
    if value is None and rest:
        return None
    if kind in ("tuple[int, ...]", "tuple[str, ...]"):
        if not isinstance(value, (list, tuple)):
            raise ValueError(f"{name} must be a list, got {value!r}")
        return tuple(checked_value(f"each of {name}", item, kind[6:9], rule) for item in value)
    if kind not in _KINDS:
        return value
    if name == "seed":
        return checked_seed(value)
    if not isinstance(rule, str):
        check_known(value, rule, name)
    convert, wanted, called = _KINDS[kind]
    fits = isinstance(value, wanted) and isinstance(value, bool) == (kind == "bool") and value != ""
    if not fits or (kind == "float" and not math.isfinite(value)):
        raise ValueError(f"{name} must be {called}{' or None' if rest else ''}, got {value!r} ({type(value).__name__})")
    if kind in ("int", "float") and not _LIMITS[rule](value):
        raise ValueError(f"{name} must be {rule}, got {value!r}")
    return convert(value)


def row_label(model: str, steps: int) -> str:
    """Return how a system is called in tables and legends: "F3AMD-FNO-96, 8 steps"."""
    return f"{model}, {steps} step{'s' if steps > 1 else ''}"


def counted_cores(record: Mapping) -> str:
    """Return on how many cores a record was made, as a text says it: "1 core", "2 cores"."""
    return f"{record['cores']} core{'s' * (record['cores'] != 1)}"


def asked_network(row: str) -> str:
    """Return the network that a row is about: "CAMDM, leading" and "CAMDM, distilled" are ways to ask CAMDM."""
    return row.split(",")[0]
