"""Who may know whom: the library its core alone, its wing on text both, the companion all of it."""

from __future__ import annotations

import ast
import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
MAY_KNOW = {
    "core": {"core"},
    "text": {"core", "text"},
    "notebooks": {"core", "text", "notebooks"},
    "companion": {"core", "text", "companion"},
}
OF_THE_LIBRARY = ("01", "02", "03", "04", "11", "12", "13", "16", "17", "18", "19", "20", "21")
"""Notebooks that import the library alone, as all of the course do; the others may import the companion."""

ALLOWED: dict[str, str] = {}
"""Imports that break the rule, "module -> module", each with the reason why it must."""

FOREIGN = (
    "papermill nbconvert nbformat nbclient ipykernel jupyterlab selenium dask distributed tyro pygltflib onnx "
    "onnxruntime jax2onnx iree torch transformers"
).split()
"""What runs notebooks, drives pages, serves or exports."""


def house(name: str) -> str | None:
    """Which part a module belongs to, None if it is none of ours."""
    for part, prefix in (("text", "f3amd_lib.text"), ("core", "f3amd_lib"), ("companion", "f3amd_companion"),
                         ("notebooks", "f3amd_notebooks")):  # fmt: skip
        if name == prefix or name.startswith(f"{prefix}."):
            return part
    return None


def imported(source: str) -> set[str]:
    """Names of modules that a source imports, anywhere in it; of `from a import b` both a and a.b."""
    found = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found |= {node.module} | {f"{node.module}.{alias.name}" for alias in node.names}
    return found


def broken(name: str, source: str, part: str) -> list[str]:
    """Imports of a source that its part may not have."""
    known = {other for other in imported(source) if house(other) and house(other) not in MAY_KNOW[part]}
    return [f"{name} -> {other}" for other in sorted(known) if f"{name} -> {other}" not in ALLOWED]


def modules() -> dict[str, Path]:
    """Every module of ours by name."""
    folders = {ROOT / "f3amd_lib": ROOT, ROOT / "f3amd_companion": ROOT}
    folders |= {ROOT / "notebooks" / "f3amd_notebooks": ROOT / "notebooks"}
    files = [(path, root) for folder, root in folders.items() for path in sorted(folder.rglob("*.py"))]
    named = {".".join(path.relative_to(root).with_suffix("").parts): path for path, root in files}
    return {name.removesuffix(".__init__"): path for name, path in named.items()}


def code_of(path: Path) -> str:
    """The code of a notebook, without lines that are no Python."""
    cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
    code = "\n\n".join("".join(cell["source"]) for cell in cells if cell["cell_type"] == "code")
    return re.sub(r"^(\s*)[%!].*$", r"\1pass", code, flags=re.M)


def library_notebooks() -> list[Path]:
    """The notebooks that import the library alone."""
    numbered = [path for path in (ROOT / "notebooks").glob("*.ipynb") if path.name[:2] in OF_THE_LIBRARY]
    return sorted([*numbered, *(ROOT / "notebooks" / "course").glob("*.ipynb")])


def test_every_file_imports_what_its_part_may_know():
    named = modules()
    assert len(named) > 150
    wrong = [
        line for name, path in named.items() for line in broken(name, path.read_text(encoding="utf-8"), house(name))
    ]
    assert wrong == []


@pytest.mark.parametrize("path", library_notebooks(), ids=lambda path: path.stem)
def test_these_notebooks_import_the_library_alone(path):
    assert broken(path.stem, code_of(path), "notebooks") == []


def test_all_that_is_imported_of_ours_is_there():
    """An import inside a function fails only where it is called."""
    named = modules()
    packages = {name for name, path in named.items() if path.name == "__init__.py"}
    sources = {name: path.read_text(encoding="utf-8") for name, path in named.items()}
    sources |= {path.stem: code_of(path) for path in (ROOT / "notebooks").rglob("*.ipynb")}
    wrong = []
    for name, source in sources.items():
        for node in ast.walk(ast.parse(source)):
            if isinstance(node, ast.ImportFrom) and node.module and house(node.module):
                found = node.module in named and (
                    node.module not in packages
                    or all(
                        f"{node.module}.{alias.name}" in named
                        or re.search(rf"\b{alias.name}\b", named[node.module].read_text(encoding="utf-8"))
                        for alias in node.names
                    )
                )
                wrong += [] if found else [f"{name}: {ast.unparse(node)}"]
    assert wrong == []


def test_a_wrong_import_is_found():
    assert broken("f3amd_lib.a", "def f():\n    from f3amd_companion.ledger import claims\n", "core") == [
        "f3amd_lib.a -> f3amd_companion.ledger",
        "f3amd_lib.a -> f3amd_companion.ledger.claims",
    ]
    assert broken("f3amd_lib.a", "import f3amd_lib.text.phases", "core")
    assert not broken("f3amd_lib.text.a", "import f3amd_lib.networks.presets\nimport f3amd_library", "text")
    assert broken("03", "import f3amd_companion", "notebooks") and house("numpy") is None


def test_the_core_runs_without_the_rest():
    """Every module of the core in a fresh process: no wing, no companion, nothing that serves, exports or prints."""
    names = [name for name in modules() if house(name) == "core"]
    refused = ("f3amd_companion", "f3amd_notebooks", *FOREIGN)
    script = (
        "import importlib, sys\n"
        f"for name in {names!r}:\n    importlib.import_module(name)\n"
        f"print(*sorted(name for name in sys.modules if name.split('.')[0] in {refused!r}"
        " or name.startswith('f3amd_lib.text')))"
    )
    assert subprocess.check_output([sys.executable, "-c", script], text=True).split() == []


@pytest.mark.parametrize("package", ["f3amd_lib", "f3amd_companion"])
def test_a_package_alone_imports_nothing(package):
    script = f"import sys; bare = set(sys.modules); import {package}; print(*sorted(set(sys.modules) - bare))"
    assert subprocess.check_output([sys.executable, "-c", script], text=True).split() == [package]
