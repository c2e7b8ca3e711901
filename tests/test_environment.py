"""pyproject.toml, environment.yml and requirements.lock name the same direct dependencies.

pyproject.toml is the original. environment.yml repeats its ranges under conda's names;
requirements.lock pins one version inside each range for every supported Python and processor.
"""

import ast
import re
import sys
import tomllib
from pathlib import Path

import pytest
import yaml
from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet
from packaging.utils import canonicalize_name
from packaging.version import Version

import f3amd_lib

ROOT = Path(__file__).resolve().parents[1]
PYTHONS = ("3.11.2", "3.12.3", "3.13.5", "3.14.0")
MACHINES = ("x86_64", "aarch64")

APART = ("bench", "onnx")
"""Extras with a requirements file of their own, without hashes."""

HASHED = ("sweep", "web")
"""Extras with a requirements file of their own, hashed and in step with the lock."""

CONDA_NAMES = {"flatbuffers": "python-flatbuffers", "matplotlib": "matplotlib-base"}
"""What conda-forge calls a package that PyPI calls otherwise."""

IMPORT_NAMES = {
    "iree-base-compiler": "iree",
    "iree-base-runtime": "iree",
    "ipython": "IPython",
    "pillow": "PIL",
    "pot": "ot",
    "pyyaml": "yaml",
}
"""What Python imports where it is not the package's name."""


def read_apart() -> dict[str, set[str]]:
    """Packages of requirements-bench.txt and -onnx.txt -> their pinned versions, which may differ by system."""
    pinned: dict[str, set[str]] = {}
    texts = [(ROOT / f"requirements-{extra}.txt").read_text(encoding="utf-8") for extra in APART]
    for line in "".join(texts).splitlines():
        if line and not line.startswith(("#", "-")):
            item = Requirement(line)
            (pin,) = item.specifier
            pinned.setdefault(canonicalize_name(item.name), set()).add(pin.version)
    return pinned


def read_hashed(extra: str) -> list[tuple[Requirement, list[str], str]]:
    """Entries of an extra's requirements file that, like the lock, names every hash."""
    text = (ROOT / f"requirements-{extra}.txt").read_text(encoding="utf-8")
    return read_lock("".join(re.findall(r"^[^#].*\n", text, re.M)))


def extra_names(pyproject: dict, extra: str) -> set[str]:
    """Packages of an extra."""
    lines = pyproject["project"]["optional-dependencies"].get(extra, [])
    return {canonicalize_name(Requirement(line).name) for line in lines}


def read_pyproject() -> dict:
    return tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))


def direct_requirements(pyproject: dict) -> dict[str, SpecifierSet]:
    """Every direct dependency that the lock holds, of whatever part, with its range."""
    apart = set(read_apart()) | set().union(*(extra_names(pyproject, name) for name in HASHED))
    ranges = all_requirements(pyproject)
    return {name: found for name, found in ranges.items() if name not in apart}


def all_requirements(pyproject: dict) -> dict[str, SpecifierSet]:
    """Every direct dependency, of whatever part, with its range."""
    lines = [
        *pyproject["project"]["dependencies"],
        *pyproject["build-system"]["requires"],
        *(line for extra in pyproject["project"]["optional-dependencies"].values() for line in extra),
    ]
    requirements = [Requirement(line) for line in lines]
    return {canonicalize_name(item.name): item.specifier for item in requirements}


def read_environment(text: str) -> dict[str, SpecifierSet]:
    """The packages of an environment file with their ranges; conda's, then those left to pip."""
    listed = yaml.safe_load(text)["dependencies"]
    from_pip = [line for entry in listed if isinstance(entry, dict) for line in entry["pip"]]
    ranges = {}
    for entry in [item for item in listed if item != "pip" and isinstance(item, str)] + from_pip:
        name, _, specifier = entry.partition(" ")
        ranges[name] = SpecifierSet(specifier)
    return ranges


def read_lock(text: str) -> list[tuple[Requirement, list[str], str]]:
    """The lock's entries: pinned requirement, hashes, and who asked for it."""
    entries = []
    for block in re.split(r"\n(?=[a-z0-9])", text.strip()):
        head, comment = (block.split("    # via", 1) + [""])[:2]
        words = head.replace("\\\n", "\n").split("\n")
        hashes = [word.strip().removeprefix("--hash=") for word in words[1:] if word.strip()]
        entries.append((Requirement(words[0].strip()), hashes, comment))
    return entries


PYPROJECT = read_pyproject()
DIRECT = direct_requirements(PYPROJECT)
ENVIRONMENT_TEXT = (ROOT / "environment.yml").read_text(encoding="utf-8")
LOCK_TEXT = (ROOT / "requirements.lock").read_text(encoding="utf-8")
LOCK = read_lock(LOCK_TEXT)


def test_every_range_has_both_ends():
    open_ended = [
        name for name, specifier in DIRECT.items() if sorted(item.operator for item in specifier) != ["<", ">="]
    ]
    assert open_ended == []


def test_no_dependency_is_listed_twice():
    parts = [
        PYPROJECT["project"]["dependencies"],
        PYPROJECT["build-system"]["requires"],
        *PYPROJECT["project"]["optional-dependencies"].values(),
    ]
    assert sum(map(len, parts)) == len(all_requirements(PYPROJECT))


def test_the_lock_sees_what_builds_the_package():
    assert PYPROJECT["dependency-groups"]["build"] == PYPROJECT["build-system"]["requires"]


def test_environment_yml_has_the_same_names_and_ranges():
    environment = read_environment(ENVIRONMENT_TEXT)
    del environment["python"]
    assert environment == {CONDA_NAMES.get(name, name): item for name, item in DIRECT.items()}


def test_environment_yml_comments_every_package():
    uncommented = [
        line
        for line in ENVIRONMENT_TEXT.split("\ndependencies:\n")[1].splitlines()
        if line.startswith("  - ") and not re.search(r" # \S.{5,}", line)
    ]
    assert uncommented == []


def test_environment_yml_asks_for_a_python_that_the_package_takes():
    in_conda = read_environment(ENVIRONMENT_TEXT)["python"]
    in_pyproject = SpecifierSet(PYPROJECT["project"]["requires-python"])
    minors = [f"3.{minor}" for minor in range(6, 20)]
    taken = [minor for minor in minors if minor in in_conda]
    assert taken == [".".join(version.split(".")[:2]) for version in PYTHONS]
    assert all(minor in in_pyproject for minor in taken)


def test_bootstrap_takes_the_same_pythons():
    script = (ROOT / "scripts" / "bootstrap.sh").read_text(encoding="utf-8")
    oldest, newest = (re.search(rf"^{word}=(\d+)", script, re.M)[1] for word in ("oldest", "newest"))
    taken = read_environment(ENVIRONMENT_TEXT)["python"]
    assert f"3.{oldest}" in taken and f"3.{int(oldest) - 1}" not in taken
    assert f"3.{newest}" in taken and f"3.{int(newest) + 1}" not in taken


def test_the_lock_was_asked_for_exactly_the_direct_dependencies():
    asked_for = {canonicalize_name(entry.name) for entry, _, comment in LOCK if "(pyproject.toml" in comment}
    assert asked_for == set(DIRECT)


@pytest.mark.parametrize("machine", MACHINES)
@pytest.mark.parametrize("python", PYTHONS)
def test_the_lock_pins_one_version_inside_each_range(python, machine):
    system = {
        "python_version": ".".join(python.split(".")[:2]),
        "python_full_version": python,
        "platform_machine": machine,
        "sys_platform": "linux",
        "platform_system": "Linux",
        "os_name": "posix",
        "implementation_name": "cpython",
        "platform_python_implementation": "CPython",
    }
    pins = {}
    for entry, _, _ in LOCK:
        if entry.marker is None or entry.marker.evaluate(system):
            name = canonicalize_name(entry.name)
            assert name not in pins, f"{name} is pinned twice for Python {python}"
            (pin,) = entry.specifier
            assert pin.operator == "=="
            pins[name] = Version(pin.version)
    outside = {name: str(pins.get(name)) for name in DIRECT if pins.get(name) not in DIRECT[name]}
    assert outside == {}


def test_every_lock_entry_is_hashed():
    assert len(LOCK) > len(DIRECT)
    bad = [
        entry.name
        for entry, hashes, _ in LOCK
        if not hashes or not all(re.fullmatch(r"sha256:[0-9a-f]{64}", item) for item in hashes)
    ]
    assert bad == []


@pytest.mark.parametrize("path", sorted(ROOT.glob("requirements-*.txt")), ids=lambda path: path.name)
def test_no_list_beside_the_lock_says_where_packages_come_from(path):
    text = path.read_text(encoding="utf-8")
    assert "://" not in text and "index-url" not in text


def test_the_lock_says_nothing_of_where_packages_came_from():
    assert "://" not in LOCK_TEXT
    assert "--find" not in LOCK_TEXT
    assert "index" not in LOCK_TEXT.replace("--hash", "")


def test_readers_notice_differences():
    """The readers above must not lose what they compare."""
    environment = ENVIRONMENT_TEXT.replace("jax >=0.10,<0.12", "jax >=0.9,<0.12")
    assert read_environment(environment)["jax"] != DIRECT["jax"]
    first, second = read_lock(
        "jax==0.10.2 ; python_full_version < '3.12' \\\n    --hash=sha256:aa \\\n"
        "    --hash=sha256:bb\n    # via\n    #   x (pyproject.toml)\nzipp==4.1.2 \\\n"
        "    --hash=sha256:cc\n    # via etils\n"
    )
    assert (str(first[0].specifier), first[1]) == ("==0.10.2", ["sha256:aa", "sha256:bb"])
    assert "(pyproject.toml" in first[2]
    assert (second[0].name, second[1], "(pyproject.toml" in second[2]) == ("zipp", ["sha256:cc"], False)


def imported_packages(paths) -> set[str]:
    """Top-level names that Python files import, anywhere in them."""
    names = set()
    for path in paths:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                names |= {alias.name for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.level == 0:
                names.add(node.module)
    return {name.split(".")[0] for name in names}


def test_what_is_imported_is_declared():
    own = {"f3amd_lib", "f3amd_companion", "f3amd_notebooks", "tests", "conftest"}
    own |= {path.stem for path in (ROOT / "tests").glob("*.py")}
    declared = {IMPORT_NAMES.get(name, name) for name in all_requirements(PYPROJECT)}
    folders = ("f3amd_lib", "f3amd_companion", "notebooks/f3amd_notebooks", "tests")
    files = [path for folder in folders for path in (ROOT / folder).rglob("*.py")]
    undeclared = imported_packages(files) - own - declared - set(sys.stdlib_module_names)
    assert undeclared == set()


def test_the_version_is_the_same_everywhere():
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert str(citation["version"]) == f3amd_lib.__version__
    changelog = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    assert re.search(rf"^## \[{re.escape(f3amd_lib.__version__)}\]", changelog, re.M)


def test_what_is_installed_apart_is_pinned_within_its_range():
    ranges = all_requirements(read_pyproject())
    apart = read_apart()
    assert set(apart) == set().union(*(extra_names(PYPROJECT, extra) for extra in APART)) - {"psutil"}
    for name, versions in apart.items():
        for version in versions:
            assert ranges[name].contains(version.split("+")[0]), f"{name} {version}"


@pytest.mark.parametrize("extra", HASHED)
def test_an_extra_of_its_own_is_hashed_within_its_range_and_agrees_with_the_lock(extra):
    ranges = all_requirements(PYPROJECT)
    entries = read_hashed(extra)
    unhashed = [entry.name for entry, hashes, _ in entries if not hashes]
    assert len(entries) > 1 and unhashed == []
    pins = {canonicalize_name(entry.name): next(iter(entry.specifier)) for entry, _, _ in entries}
    for name in extra_names(PYPROJECT, extra):
        assert pins[name].operator == "==" and pins[name].version in ranges[name]
    locked = {canonicalize_name(entry.name): str(entry.specifier) for entry, _, _ in LOCK}
    assert {name: str(pin) for name, pin in pins.items() if name in locked} == {
        name: locked[name] for name in pins if name in locked
    }
