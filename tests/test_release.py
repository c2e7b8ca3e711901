"""What is released: a wheel that holds the library with its values and weights, and a source archive that builds it."""

from __future__ import annotations

import shutil
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from pathlib import Path

import pytest

import f3amd_lib

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = (ROOT / "f3amd_lib", ROOT / "f3amd_companion")
NOTEBOOKS = ROOT / "notebooks" / "f3amd_notebooks"
"""Modules and their tables, beside the notebooks that import them."""
NAME = f"f3amd_lib-{f3amd_lib.__version__}"
AROUND = ("pyproject.toml", "MANIFEST.in", "README.md", "LICENSE", "NOTICE")
"""Files that building reads beside the library."""
BESIDE = {"CHANGELOG.md", "CITATION.cff", "CONTRIBUTING.md", "SECURITY.md", "requirements.lock"}
"""What MANIFEST.in adds to a source archive."""


def files_of(folder: Path) -> set[str]:
    """All files below a folder but compiled ones, as seen from the folder above it."""
    found = (path for path in folder.rglob("*") if path.is_file() and path.suffix != ".pyc")
    return {path.relative_to(folder.parent).as_posix() for path in found}


def left_out(folder: Path) -> set[str]:
    """Files of a package that are neither modules of it nor package data."""
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["setuptools"]
    taken = {path for pattern in settings["package-data"].get(folder.name, []) for path in folder.glob(pattern)}
    taken |= {path for path in folder.rglob("*.py") if (path.parent / "__init__.py").is_file()}
    return files_of(folder) - {path.relative_to(folder.parent).as_posix() for path in taken}


def test_every_file_of_the_packages_is_a_module_or_package_data(tmp_path):
    assert [left_out(package) for package in PACKAGES] == [set(), set()]
    assert not [name for name in left_out(NOTEBOOKS) if name.endswith((".py", ".csv", ".template"))]
    tmp_path = tmp_path / "f3amd_lib"
    for name in ("__init__.py", "room/module.py", "room/values.toml", "room/notes.txt", "pretrained/set/model.md"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    assert {Path(name).name for name in left_out(tmp_path)} == {"module.py", "notes.txt"}


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """(names in the wheel, names in the source archive, the wheel's metadata), built offline from a copy."""
    tree, out = tmp_path_factory.mktemp("tree"), tmp_path_factory.mktemp("dist")
    for package in (*PACKAGES, NOTEBOOKS):
        place = tree / package.relative_to(ROOT)
        shutil.copytree(package, place, ignore=shutil.ignore_patterns("__pycache__"))
    for name in (*AROUND, *BESIDE):
        shutil.copy(ROOT / name, tree / name)
    (tree / "tests").mkdir()
    (tree / "tests" / "test_something.py").write_text("")
    for folder in ("paper_figures", "runs", "data"):
        (tree / folder).mkdir()
        (tree / folder / "table.csv").write_text("a\n1\n")
    for kind in ("sdist", "wheel"):
        build = f"import sys, setuptools.build_meta as b; b.build_{kind}(sys.argv[1])"
        subprocess.run([sys.executable, "-c", build, str(out)], cwd=tree, check=True, capture_output=True)
    with zipfile.ZipFile(out / f"{NAME}-py3-none-any.whl") as wheel, tarfile.open(out / f"{NAME}.tar.gz") as source:
        metadata = wheel.read(f"{NAME}.dist-info/METADATA").decode()
        names = {member.name.removeprefix(f"{NAME}/") for member in source.getmembers() if member.isfile()}
        return set(wheel.namelist()), names, metadata


@pytest.mark.slow
def test_a_wheel_holds_the_library_its_weights_and_their_terms_and_nothing_else(built):
    wheel, _, metadata = built
    own = {name for name in wheel if not name.startswith(f"{NAME}.dist-info/")}
    assert own == set().union(*map(files_of, PACKAGES), files_of(NOTEBOOKS) - left_out(NOTEBOOKS))
    assert {"f3amd_lib/pretrained/bandai/CAMDM.safetensors", "f3amd_lib/pretrained/bandai/CAMDM.md"} <= own
    told = {name.removeprefix(f"{NAME}.dist-info/") for name in wheel - own}
    wanted = {"METADATA", "RECORD", "WHEEL", "entry_points.txt", "top_level.txt", "licenses/LICENSE", "licenses/NOTICE"}
    assert told == wanted
    assert f"\nVersion: {f3amd_lib.__version__}\n" in metadata and "\nRequires-Python: >=3.11\n" in metadata


@pytest.mark.slow
def test_a_source_archive_builds_the_same_and_has_no_tests_data_or_figures(built):
    _, source, _ = built
    own = {name for name in source if not name.startswith("f3amd_lib.egg-info/")}
    modules = {f"notebooks/{name}" for name in files_of(NOTEBOOKS) - left_out(NOTEBOOKS)}
    assert own == set().union(*map(files_of, PACKAGES), modules) | set(AROUND) | BESIDE | {"PKG-INFO", "setup.cfg"}
