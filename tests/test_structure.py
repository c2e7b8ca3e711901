"""How the library is laid out: no file knows itself by a detour."""

import ast
import graphlib
from pathlib import Path

import pytest

LIBRARY = Path(__file__).resolve().parents[1] / "f3amd_lib"


def module_name(path: Path) -> str:
    return ".".join(path.relative_to(LIBRARY.parent).with_suffix("").parts)


def imported(tree: ast.Module, modules: set[str]) -> set[str]:
    """Modules of the library that a file imports, also inside its functions."""
    found = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found |= {node.module} | {f"{node.module}.{alias.name}" for alias in node.names}
    return found & modules


def import_graph(root: Path = LIBRARY) -> dict[str, set[str]]:
    files = {module_name(path): path for path in root.rglob("*.py") if path.name != "__init__.py"}
    return {
        name: imported(ast.parse(path.read_text(encoding="utf-8")), set(files))
        for name, path in files.items()
    }


def circle(graph) -> list[str]:
    try:
        graphlib.TopologicalSorter(graph).prepare()
    except graphlib.CycleError as error:
        return error.args[1]
    return []


def test_no_files_import_each_other_in_a_circle():
    graph = import_graph()
    assert len(graph) > 80
    assert circle(graph) == []


def test_a_circle_is_found():
    graph = import_graph()
    graph["f3amd_lib.motion.skeleton"] |= {"f3amd_lib.evaluation.rollout"}
    assert "f3amd_lib.motion.skeleton" in circle(graph)


@pytest.mark.parametrize("room", ["models", "diffusion"])
def test_networks_and_samplers_know_no_data(room):
    """Arrays in, arrays out: what they know of motion is at most a rotation."""
    for name, known in import_graph().items():
        if name.startswith(f"f3amd_lib.{room}."):
            outside = {other.split(".")[1] for other in known} - {"models", "diffusion", "names"}
            assert outside <= {"motion"}, (name, outside)
            assert all(k.endswith("rotations") for k in known if k.startswith("f3amd_lib.motion"))
