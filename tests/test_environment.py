"""pyproject.toml, environment.yml and requirements.lock name the same direct dependencies.

pyproject.toml is the original. environment.yml repeats its ranges under conda's names; requirements.lock pins one
version inside each range for every supported Python and processor, and behind the plain install what an extra adds.
"""

import re
import subprocess
import tomllib
from pathlib import Path

import lock_extras
import pytest
import yaml
from packaging.markers import Marker
from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet
from packaging.utils import canonicalize_name

import f3amd_lib

ROOT = Path(__file__).resolve().parents[1]
PYTHONS = ("3.11.2", "3.12.3", "3.13.5", "3.14.0")
MACHINES = ("x86_64", "aarch64")
EXTRAS = ("bench", "onnx", "site", "sweep", "web")
UNHASHED = ("bench", "onnx")
CONDA_NAMES = {"flatbuffers": "python-flatbuffers", "matplotlib": "matplotlib-base"}
"""What conda-forge calls a package that PyPI calls otherwise."""

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
LOCK_TEXT = (ROOT / "requirements.lock").read_text(encoding="utf-8")
ENVIRONMENT = (ROOT / "environment.yml").read_text(encoding="utf-8")


PLAIN = lock_extras.without_extras(LOCK_TEXT)


def ranges(lines) -> dict[str, SpecifierSet]:
    """Name -> range, of lines of requirements."""
    requirements = [Requirement(line) for line in lines]
    return {canonicalize_name(item.name): item.specifier for item in requirements}


OF_EXTRA = {name: ranges(lines) for name, lines in PROJECT["project"]["optional-dependencies"].items()}
BASE = ranges([*PROJECT["project"]["dependencies"], *PROJECT["build-system"]["requires"]])
DIRECT = BASE | {name: item for part in ("notebooks", "tests", "text") for name, item in OF_EXTRA[part].items()}
"""Every direct dependency of a plain install, with its range."""

ALL = DIRECT | {name: item for extra in EXTRAS for name, item in OF_EXTRA[extra].items()}


def pins(text: str, python: str = PYTHONS[0], machine: str = MACHINES[0], extra: str = "") -> dict[str, str]:
    """Name -> pinned version, of what pip would take of a lock; an extra is taken beside the plain install."""
    system = {
        "python_version": ".".join(python.split(".")[:2]), "python_full_version": python, "platform_machine": machine,
        "sys_platform": "linux", "platform_system": "Linux", "os_name": "posix", "implementation_name": "cpython",
        "platform_python_implementation": "CPython", "extra": extra,
    }  # fmt: skip
    found: dict[str, str] = {}
    for pin, marker, _ in lock_extras.entries(text):
        if not marker or Marker(marker).evaluate(system):
            name, version = pin.split("==")
            assert name not in found, f"{name} is pinned twice for Python {python}"
            found[name] = version
    return found


def read_environment(text: str) -> dict[str, SpecifierSet]:
    """The packages of an environment file with their ranges; conda's, then those left to pip."""
    listed = yaml.safe_load(text)["dependencies"]
    from_pip = [line for entry in listed if isinstance(entry, dict) for line in entry["pip"]]
    lines = [item for item in listed if item != "pip" and isinstance(item, str)] + from_pip
    return {name: SpecifierSet(specifier) for name, _, specifier in (line.partition(" ") for line in lines)}


def test_every_range_has_both_ends():
    ends = {name: sorted(item.operator for item in specifier) for name, specifier in ALL.items()}
    assert {name for name, found in ends.items() if found != ["<", ">="]} == {"sphinx-mathjax-offline"}
    assert PROJECT["dependency-groups"]["build"] == PROJECT["build-system"]["requires"]  # where the lock can see it


def test_environment_yml_has_the_same_names_and_ranges_and_the_same_pythons():
    environment = read_environment(ENVIRONMENT)
    taken = environment.pop("python")
    assert environment == {CONDA_NAMES.get(name, name): item for name, item in DIRECT.items()}
    minors = [f"3.{minor}" for minor in range(6, 20) if f"3.{minor}" in taken]
    assert minors == [version.rpartition(".")[0] for version in PYTHONS]
    assert all(minor in SpecifierSet(PROJECT["project"]["requires-python"]) for minor in minors)
    script = (ROOT / "scripts" / "bootstrap.sh").read_text(encoding="utf-8")
    assert [f"3.{re.search(rf'^{word}=([0-9]+)', script, re.M)[1]}" for word in ("oldest", "newest")] == [
        minors[0], minors[-1],
    ]  # fmt: skip
    changed = ENVIRONMENT.replace("jax >=0.10,<0.12", "jax >=0.9,<0.12")  # the reader must not lose what is compared
    assert read_environment(changed)["jax"] != DIRECT["jax"]


def test_the_lock_was_asked_for_exactly_the_direct_dependencies():
    blocks = re.split(r"\n(?=[a-z0-9])", PLAIN)
    assert {block.split("==")[0] for block in blocks if "(pyproject.toml" in block} == set(DIRECT)


@pytest.mark.parametrize("machine", MACHINES)
@pytest.mark.parametrize("python", PYTHONS)
def test_the_lock_pins_one_version_inside_each_range(python, machine):
    plain = pins(LOCK_TEXT, python, machine)
    assert [name for name, allowed in DIRECT.items() if plain.get(name) not in allowed] == []
    assert plain == pins(PLAIN, python, machine)  # no extra is in a plain install
    for extra in EXTRAS:
        whole = pins(LOCK_TEXT, python, machine, extra)
        assert [name for name, allowed in OF_EXTRA[extra].items() if whole.get(name) not in allowed] == [], extra
        assert whole.items() > plain.items()


def test_every_lock_entry_is_hashed_but_those_of_two_extras_and_none_says_where_it_came_from():
    entries = lock_extras.entries(LOCK_TEXT)
    unhashed = {pin.partition("==")[0] for pin, _, hashes in entries if not hashes}
    assert unhashed == {name for extra in UNHASHED for name in OF_EXTRA[extra]}
    assert all(re.fullmatch(r"--hash=sha256:[0-9a-f]{64}", item) for _, _, hashes in entries for item in hashes)
    assert not re.search(r"://|--find|index", LOCK_TEXT)


@pytest.mark.parametrize("extra", [*EXTRAS, "nonsense"])
def test_an_extra_is_handed_to_pip_with_its_hashes(extra, tmp_path):
    """A stand-in for the environment's Python repeats what it was told."""
    python = tmp_path / "bin" / "python"
    python.parent.mkdir()
    python.write_text('#!/bin/sh\necho "$@"\nfor last; do :; done\ncat "$last"\n')
    python.chmod(0o755)
    command = ["bash", str(ROOT / "scripts" / "extra.sh"), extra, "--dry-run"]
    ran = subprocess.run(
        command, env={"PATH": "/usr/bin:/bin", "F3AMD_VENV": str(tmp_path)}, capture_output=True, text=True
    )
    if extra == "nonsense":
        assert ran.returncode == 2 and "has no extra nonsense" in ran.stderr
        return
    told, _, wanted = ran.stdout.partition("\n")
    assert "--dry-run" in told and ("--require-hashes --no-deps" in told) == (extra not in UNHASHED)
    asked = {entry[0] for entry in lock_extras.entries(LOCK_TEXT) if f"extra == '{extra}'" in entry[1]}
    assert {entry[0] for entry in lock_extras.entries(wanted)} == asked
    added = pins(LOCK_TEXT, extra=extra).items() - pins(PLAIN).items()
    assert pins(wanted).items() == added


def test_the_version_is_the_same_everywhere():
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert str(citation["version"]) == f3amd_lib.__version__
    changelog = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    assert re.search(rf"^## \[{re.escape(f3amd_lib.__version__)}\]", changelog, re.M)
