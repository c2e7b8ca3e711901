"""Exercises of the course, notebooks/course/: a module a notebook, found by itself, `c01_score` first."""

from __future__ import annotations

import importlib
import pkgutil

CHECKS = {
    number: check
    for module in sorted(module.name for module in pkgutil.iter_modules(__path__))
    for number, check in importlib.import_module(f"{__name__}.{module}").CHECKS.items()
}
"""The checks of all exercises of the course by number, in the order of its notebooks."""
