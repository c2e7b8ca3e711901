"""How the house is laid out: no file knows itself by a detour, and a room knows those below it."""

import ast
import graphlib
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("f3amd_lib", "f3amd_companion")


def module_name(path: Path) -> str:
    return ".".join(path.relative_to(ROOT).with_suffix("").parts)


def imported(tree: ast.Module, modules: set[str]) -> set[str]:
    """Modules of the house that a file imports, also inside its functions."""
    found = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found |= {node.module} | {f"{node.module}.{alias.name}" for alias in node.names}
    return found & modules


def import_graph() -> dict[str, set[str]]:
    paths = [path for package in PACKAGES for path in (ROOT / package).rglob("*.py") if path.name != "__init__.py"]
    files = {module_name(path): path for path in paths}
    return {name: imported(ast.parse(path.read_text(encoding="utf-8")), set(files)) for name, path in files.items()}


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
    graph["f3amd_lib.motion.skeleton"] |= {"f3amd_lib.rollout.rollout"}
    assert "f3amd_lib.motion.skeleton" in circle(graph)


ROOMS = {
    "f3amd_lib": "ground motion data diffusion networks training rollout measures drawing papers",
    "f3amd_lib.text": "data networks phases stages judge sampling",
    "f3amd_companion": "serving speed measuring ledger reproduce terminal __main__",
}
"""From the ground up: a room knows itself and those before it."""

FLOORS = [f"{house}.{room}" for house, rooms in ROOMS.items() for room in rooms.split()]


def floor(name: str) -> int:
    (number,) = (number for number, room in enumerate(FLOORS) if name == room or name.startswith(f"{room}."))
    return number


def arrows_up(graph) -> list[tuple[str, str]]:
    return [(name, other) for name, known in graph.items() for other in known if floor(other) > floor(name)]


def test_every_room_stands_on_those_below_it():
    assert arrows_up(import_graph()) == []


def test_an_arrow_up_is_found():
    graph = import_graph()
    graph["f3amd_lib.ground.files"] |= {"f3amd_lib.training.optimise"}
    assert arrows_up(graph) == [("f3amd_lib.ground.files", "f3amd_lib.training.optimise")]


@pytest.mark.parametrize("room, may_know", [("diffusion", {"ground"}), ("networks", {"ground", "diffusion"})])
def test_networks_and_samplers_know_no_data(room, may_know):
    """Arrays in, arrays out."""
    for name, known in import_graph().items():
        if name.startswith(f"f3amd_lib.{room}."):
            assert {other.split(".")[1] for other in known} <= may_know | {room}, name


def roads(text: str) -> dict[str, list[str]]:
    """What each road of docs/house.md leads from, and the files on it."""
    lines = text.split("## Four roads\n")[1].split("\n## ")[0].split("\n- ")[1:]
    return {line.split(":**")[0]: re.findall(r"`([\w/]+\.\w+)`", line) for line in lines}


def test_the_four_roads_are_short_and_lead_through_files_that_exist():
    found = roads((ROOT / "docs" / "house.md").read_text(encoding="utf-8"))
    assert len(found) == 4 and all(2 <= len(files) <= 4 for files in found.values())
    there = lambda file: any((ROOT / package / file).is_file() for package in PACKAGES)
    assert [file for files in found.values() for file in files if not there(file)] == []
