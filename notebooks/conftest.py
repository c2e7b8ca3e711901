"""How nbval runs notebooks: compiled quickly, but for those that train toys in many steps."""

import os
from pathlib import Path

import pytest

# What one notebook or run compiled, the next ones read.
CACHE = Path(__file__).resolve().parents[1] / ".pytest_cache" / "jax"
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(CACHE))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")

XLA_FLAGS = os.environ.get("XLA_FLAGS", "")
QUICKLY = f"{XLA_FLAGS} --xla_cpu_use_fusion_emitters=false".strip()  # see tests/conftest.py

LONG_TRAININGS = ("10_printed_update", "10_rounds", "11_one_step")
"""Notebooks that run longer than they compile."""


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item):
    """Choose in the environment, which a notebook's kernel inherits before its first cell."""
    is_long = item.path.stem in LONG_TRAININGS
    os.environ["JAX_DISABLE_MOST_OPTIMIZATIONS"] = str(int(not is_long))
    os.environ["XLA_FLAGS"] = XLA_FLAGS if is_long else QUICKLY
