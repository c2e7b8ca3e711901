"""How nbval runs notebooks: compiled quickly, but for those that train toys in many steps."""

import os
from importlib.metadata import version
from pathlib import Path

import pytest

# What one notebook or run compiled, the next ones read.
ROOT = Path(__file__).resolve().parents[1]
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(ROOT / ".pytest_cache" / "jax"))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")

XLA_FLAGS = os.environ.get("XLA_FLAGS", "")
QUICKLY = XLA_FLAGS  # see tests/conftest.py
if f"jaxlib=={version('jaxlib')} " in (ROOT / "requirements.lock").read_text():
    QUICKLY += " --xla_cpu_use_fusion_emitters=false --xla_cpu_parallel_codegen_split_count=1"

LONG_TRAININGS = ("10_printed_update", "10_rounds", "11_one_step")
"""Notebooks that run longer than they compile."""


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item):
    """Choose in the environment, which a notebook's kernel inherits before its first cell."""
    is_long = item.path.stem in LONG_TRAININGS
    os.environ["JAX_DISABLE_MOST_OPTIMIZATIONS"] = str(int(not is_long))
    os.environ["XLA_FLAGS"] = XLA_FLAGS if is_long else QUICKLY
