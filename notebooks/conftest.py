"""How nbval runs notebooks: compiled quickly, and not as quickly where toys train in many steps."""

import os
from importlib.metadata import version
from pathlib import Path

import pytest
from jupyter_client.provisioning import local_provisioner

from forked_kernels import Kernel

# What one notebook or run compiled, the next ones read.
ROOT = Path(__file__).resolve().parents[1]
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(ROOT / ".pytest_cache" / "jax"))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")

local_provisioner.launch_kernel = Kernel

XLA_FLAGS = os.environ.get("XLA_FLAGS", "")
QUICKLY = RUNNING = XLA_FLAGS  # see tests/conftest.py
if f"jaxlib=={version('jaxlib')} " in (ROOT / "requirements.lock").read_text():
    QUICKLY += " --xla_cpu_use_fusion_emitters=false --xla_cpu_parallel_codegen_split_count=1"
    # Half of the time that all optimisations take, and programs that run as fast.
    RUNNING += " --xla_backend_optimization_level=1 --xla_llvm_disable_expensive_passes=true"

LONG_RUNS = (
    "07_motion_quality", "10_printed_update", "10_rounds", "11_one_step", "14_crowd",
    "22_one_step_three_ways",
)  # fmt: skip
"""Notebooks that run longer than they compile."""

FIRST = (
    "22_one_step_three_ways", "04_training", "21_latents_and_teacher", "11_one_step",
    "10_printed_update", "06_ablations", "17_control_and_editing", "14_crowd",
    "20_autoregression", "07_motion_quality", "16_absolute_coordinates", "06_flow_matching",
)  # fmt: skip
"""Notebooks that take longest: begun first, so that no core waits for them at the end."""


def pytest_collection_modifyitems(items):
    """Begin with the longest, cells in order; `--no-loadscope-reorder` lets workers keep to it."""
    place = {name: number for number, name in enumerate(FIRST)}
    items.sort(key=lambda item: place.get(item.path.stem, len(place)))


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item):
    """Choose in the environment, which a notebook's kernel inherits before its first cell."""
    is_long = item.path.stem in LONG_RUNS
    os.environ["JAX_DISABLE_MOST_OPTIMIZATIONS"] = str(int(not is_long))
    os.environ["XLA_FLAGS"] = RUNNING if is_long else QUICKLY
