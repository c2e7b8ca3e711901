"""How nbval runs notebooks: compiled quickly, but for those that train toys in many steps."""

import os

import pytest

LONG_TRAININGS = ("10_printed_update", "11_one_step")
"""Notebooks that run longer than they compile."""


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item):
    """Choose in the environment, which a notebook's kernel inherits before its first cell."""
    os.environ["JAX_DISABLE_MOST_OPTIMIZATIONS"] = str(int(item.path.stem not in LONG_TRAININGS))
