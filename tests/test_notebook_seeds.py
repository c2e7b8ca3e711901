"""Notebooks run with another seed too: what they say must not hang on the one that was committed.

Seed 0 is what nbval runs. A copy of the repository keeps the runs of this seed apart from the reader's own.
"""

import os
import shutil
from pathlib import Path

import papermill
import pytest

from f3amd_companion import reproduce
from f3amd_lib.ground import profiles

ROOT = Path(__file__).resolve().parents[1]
PICTURES = shutil.ignore_patterns("*.png", "*.gif", "__pycache__", ".ipynb_checkpoints")


@pytest.fixture(scope="module")
def copy(tmp_path_factory) -> Path:
    """A repository with library, notebooks and stored results, and no runs."""
    folder = tmp_path_factory.mktemp("repository")
    # 00 counts the tests of each equation.
    for name in ("f3amd_lib", "f3amd_companion", "notebooks", "paper_figures", "tests"):
        shutil.copytree(ROOT / name, folder / name, ignore=PICTURES)
    shutil.copy(ROOT / "pyproject.toml", folder)
    return folder


NOTEBOOKS = reproduce.find_notebooks(ROOT / "notebooks")


@pytest.mark.long
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebooks_run_with_another_seed(copy, path, tmp_path, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", f"{copy}{os.pathsep}{copy / 'notebooks'}")
    monkeypatch.setenv(profiles.RESULTS_DIR_VARIABLE, str(tmp_path / "results"))
    # As a reader runs them, not as the other tests do.
    monkeypatch.delenv("JAX_DISABLE_MOST_OPTIMIZATIONS", raising=False)
    papermill.execute_notebook(
        str(copy / "notebooks" / path.name), str(tmp_path / path.name), parameters={"profile": "smoke", "seed": 1},
        kernel_name=reproduce.KERNEL, cwd=str(copy / "notebooks"), progress_bar=False,
    )  # fmt: skip
