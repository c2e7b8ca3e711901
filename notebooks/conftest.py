"""How nbval runs notebooks: compiled quickly, but for those that train toys in many steps."""

import os
from pathlib import Path

import pytest

# What one notebook or run compiled, the next ones read.
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(Path(__file__).resolve().parents[1] / ".pytest_cache" / "jax"))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")

LONG_TRAININGS = ("10_printed_update", "11_one_step", "22_one_step_three_ways")
"""Notebooks that run longer than they compile."""


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item):
    """Choose in the environment, which a notebook's kernel inherits before its first cell."""
    os.environ["JAX_DISABLE_MOST_OPTIMIZATIONS"] = str(int(item.path.stem not in LONG_TRAININGS))
