"""Write the cell that fetches the library into each notebook that needs it: python scripts/install_cell.py

On Colab a notebook comes alone. The cell stands behind the first text and does nothing where the library is. The
address in it is `Repository` of [project.urls] in pyproject.toml; without one the cell says so. Run this again where
that changes.
"""

from __future__ import annotations

import json
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
NOTEBOOKS = sorted([*ROOT.glob("notebooks/[0-9]*.ipynb"), *ROOT.glob("notebooks/course/[0-9]*.ipynb")])
CODE = """\
import importlib.util

if not importlib.util.find_spec("f3amd_lib"):  # a notebook that came alone, as on Colab
    repository = "ADDRESS"
    assert repository, "this copy names no repository: put its address into the line above"
    !git clone -q --depth 1 {repository} f3amd && pip install -q ./f3amd
    %cd f3amd/notebooks"""


def address() -> str:
    """Return where everybody reaches the repository, or "" where pyproject.toml does not say."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    return project.get("urls", {}).get("Repository", "")


def with_cell(text: str) -> str:
    """Return a notebook's file with the cell, counted as one run from top to bottom counts."""
    notebook = json.loads(text)
    is_ours = lambda cell: "install" in cell["metadata"].get("tags", [])
    cells = [cell for cell in notebook["cells"] if not is_ours(cell)]
    metadata = {"jupyter": {"source_hidden": True}, "tags": ["hide-input", "install", "remove-cell"]}
    source = CODE.replace("ADDRESS", address()).splitlines(keepends=True)
    ours = {"cell_type": "code", "execution_count": 1, "id": "install", "metadata": metadata, "outputs": []}
    cells.insert(1, ours | {"source": source})
    for count, cell in enumerate((cell for cell in cells if cell["cell_type"] == "code"), 1):
        for numbered in (cell, *(output for output in cell["outputs"] if "execution_count" in output)):
            numbered["execution_count"] = count
    return json.dumps(notebook | {"cells": cells}, indent=1, ensure_ascii=False) + "\n"


if __name__ == "__main__":
    for path in NOTEBOOKS:
        path.write_text(with_cell(path.read_text(encoding="utf-8")), encoding="utf-8")
