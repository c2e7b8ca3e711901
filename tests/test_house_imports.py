"""Who may know whom: a room those below it, the library its core and its wing on text, the companion all of it."""

from __future__ import annotations

import ast
import functools
import graphlib
import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
HOUSES = {"f3amd_lib": ROOT, "f3amd_companion": ROOT, "f3amd_notebooks": ROOT / "notebooks"}
"""Our packages -> the folder that each lies in."""

ROOMS = {
    "f3amd_lib": "ground motion data diffusion networks training rollout measures drawing papers",
    "f3amd_lib.text": "data networks phases stages judge sampling released",
    "f3amd_companion": "serving speed measuring ledger reproduce terminal __main__",
}
"""From the ground up: a room knows itself and those before it."""

FLOORS = [f"{house}.{room}" for house, rooms in ROOMS.items() for room in rooms.split()]
OF_THE_LIBRARY = ("01", "02", "03", "04", "11", "12", "13", "16", "17", "18", "19", "20", "21")
"""Notebooks that import the library alone, as all of the course do; the others may import the companion."""

FOREIGN = (
    "papermill nbconvert nbformat nbclient ipykernel jupyterlab selenium dask distributed tyro onnx "
    "onnxruntime jax2onnx iree torch transformers"
).split()
"""What runs notebooks, drives pages, serves or exports."""


def modules() -> dict[str, Path]:
    """Every module of ours by name."""
    files = [(path, root) for house, root in HOUSES.items() for path in sorted((root / house).rglob("*.py"))]
    named = {".".join(path.relative_to(root).with_suffix("").parts): path for path, root in files}
    return {name.removesuffix(".__init__"): path for name, path in named.items()}


parsed = functools.cache(ast.parse)


def imported(source: str) -> set[str]:
    """Names of modules that a source imports, anywhere in it; of `from a import b` both a and a.b."""
    found = set()
    for node in ast.walk(parsed(source)):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found |= {node.module} | {f"{node.module}.{alias.name}" for alias in node.names}
    return found


def import_graph() -> dict[str, set[str]]:
    """Each module of the packages -> those of ours that it imports."""
    files = {name: path for name, path in modules().items() if path.name != "__init__.py"}
    return {name: imported(path.read_text(encoding="utf-8")) & set(files) for name, path in files.items()}


def floor(name: str) -> int:
    """The number of a module's room; the checks and drawings of notebooks stand on the library alone."""
    if name.startswith("f3amd_notebooks."):
        return len(FLOORS) - len(ROOMS["f3amd_companion"].split()) - 1
    return next(number for number, room in enumerate(FLOORS) if f"{name}.".startswith(f"{room}."))


def arrows_up(graph) -> list[tuple[str, str]]:
    """Imports of a room further up; neither companion nor library knows the notebooks' modules."""
    up = lambda name, other: floor(other) > floor(name) or "f3amd_notebooks" in other and "f3amd_notebooks" not in name
    return [(name, other) for name, known in graph.items() for other in known if up(name, other)]


def circle(graph) -> list[str]:
    try:
        graphlib.TopologicalSorter(graph).prepare()
    except graphlib.CycleError as error:
        return error.args[1]
    return []


def test_every_room_stands_on_those_below_it_and_no_files_import_each_other_in_a_circle():
    graph = import_graph()
    assert len(graph) > 80 and arrows_up(graph) == [] and circle(graph) == []
    graph["f3amd_lib.motion.skeleton"] |= {"f3amd_lib.rollout.rollout"}
    assert arrows_up(graph) == [("f3amd_lib.motion.skeleton", "f3amd_lib.rollout.rollout")] and circle(graph)
    for wrong in ("f3amd_companion.ledger.claims", "f3amd_lib.text.phases", "f3amd_notebooks.exercises.judging"):
        assert arrows_up({"f3amd_lib.ground.files": {wrong}})
    assert arrows_up({"f3amd_notebooks.sliders": {"f3amd_companion.serving.player"}})


@pytest.mark.parametrize("room, may_know", [("diffusion", {"ground"}), ("networks", {"ground", "diffusion"})])
def test_networks_and_samplers_know_no_data(room, may_know):
    """Arrays in, arrays out."""
    for name, known in import_graph().items():
        if name.startswith(f"f3amd_lib.{room}."):
            assert {other.split(".")[1] for other in known} <= may_know | {room}, name


def code_of(path: Path) -> str:
    """The code of a notebook, without lines that are no Python."""
    cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
    code = "\n\n".join("".join(cell["source"]) for cell in cells if cell["cell_type"] == "code")
    return re.sub(r"^(\s*)[%!].*$", r"\1pass", code, flags=re.M)


def library_notebooks() -> list[Path]:
    """The notebooks that import the library alone."""
    numbered = [path for path in (ROOT / "notebooks").glob("*.ipynb") if path.name[:2] in OF_THE_LIBRARY]
    return sorted([*numbered, *(ROOT / "notebooks" / "course").glob("*.ipynb")])


@pytest.mark.parametrize("path", library_notebooks(), ids=lambda path: path.stem)
def test_these_notebooks_import_the_library_alone(path):
    assert not [name for name in imported(code_of(path)) if name.startswith("f3amd_companion")]


def test_all_that_is_imported_of_ours_is_there():
    """An import inside a function fails only where it is called."""
    texts = {name: path.read_text(encoding="utf-8") for name, path in modules().items()}
    sources = texts | {path.stem: code_of(path) for path in (ROOT / "notebooks").rglob("*.ipynb")}
    wrong = []
    for name, source in sources.items():
        for node in ast.walk(parsed(source)):
            if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] in HOUSES:
                there = lambda word, of=node.module: f"{of}.{word}" in texts or re.search(rf"\b{word}\b", texts[of])
                found = node.module in texts and all(there(alias.name) for alias in node.names)
                wrong += [] if found else [f"{name}: {ast.unparse(node)}"]
    assert wrong == []


def modules_after(script: str) -> list[str]:
    """What a script says in a fresh process, word by word."""
    return subprocess.check_output([sys.executable, "-c", f"import sys\n{script}"], text=True).split()


def test_the_core_runs_without_the_rest():
    """Every module of the core in a fresh process: no wing, no companion, nothing that serves, exports or prints."""
    wing = "f3amd_lib.text."
    names = [name for name in modules() if name.startswith("f3amd_lib") and not f"{name}.".startswith(wing)]
    refused = ("f3amd_companion", "f3amd_notebooks", *FOREIGN)
    loaded = "[name for name in sys.modules if name.split('.')[0] in {} or name.startswith('f3amd_lib.text')]"
    load = f"import importlib\nfor name in {names!r}:\n    importlib.import_module(name)\n"
    assert len(names) > 40 and modules_after(f"{load}print(*{loaded.format(refused)})") == []


@pytest.mark.parametrize("package", ["f3amd_lib", "f3amd_companion"])
def test_a_package_alone_imports_nothing(package):
    assert modules_after(f"bare = set(sys.modules)\nimport {package}\nprint(*set(sys.modules) - bare)") == [package]
