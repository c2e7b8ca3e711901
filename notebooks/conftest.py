"""How nbval runs the notebooks: compiled quickly, but for those that train toys for thousands of steps."""

import os

import pytest

LONG_TRAININGS = ("10_printed_update", "11_one_step")
"""Notebooks that run longer than they compile."""


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item):
    """Choose in the environment, which the kernel of a notebook inherits when its first cell is set up."""
    os.environ["JAX_DISABLE_MOST_OPTIMIZATIONS"] = str(int(item.path.stem not in LONG_TRAININGS))
