"""Plant each fault of `tests/faults.toml` in a copy of the tree, and see whether the tests named with it notice.

    python scripts/faults.py                 all that docs/faults.csv has no row of yet
    python scripts/faults.py --only NAME     one fault, or several
    python scripts/faults.py --again         all anew

A fault is a text of a file and what it is replaced by. A text that does not occur exactly once is refused: the code
has moved on, and the fault with it. Only what `make test` runs counts: slow and long tests are left out. Before a fault
is planted its tests must pass. Rows are written one by one, so that a run that was stopped goes on; `docs/faults.md`
is written from them, and from what `scripts/fuzz.py --keep` counted.
"""

from __future__ import annotations

import argparse
import csv
import hashlib
import importlib
import itertools
import os
import shutil
import sys
import tempfile
import time
import tomllib
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
LIST, RESULTS, PAGE = ROOT / "tests" / "faults.toml", ROOT / "docs" / "faults.csv", ROOT / "docs" / "faults.md"
FUZZ = ROOT / "docs" / "fuzz.csv"
COLUMNS = ("name", "area", "file", "caught", "by", "seconds", "fault")
BAR = 0.95
_OPTIONS = ("-x", "-q", "-p", "no:cacheprovider", "-m", "not slow and not long")


@dataclass(frozen=True)
class Fault:
    """A fault to plant.

    Attributes:
      name, area: what is wrong, and where it belongs.
      file: of the repository.
      old, new: what is replaced, and by what.
      tests: test files, or tests of them, as pytest takes them.
    """

    name: str
    area: str
    file: str
    old: str
    new: str
    tests: tuple[str, ...]

    @property
    def digest(self) -> str:
        """Eight digits that change with the fault."""
        return hashlib.sha256(repr((self.file, self.old, self.new)).encode()).hexdigest()[:8]

    def planted(self, text: str) -> str:
        """Return the file's text with the fault in it; ValueError unless its place occurs once."""
        if (count := text.count(self.old)) != 1:
            raise ValueError(f"fault {self.name!r}: its text occurs {count} times in {self.file}; write it anew")
        return text.replace(self.old, self.new)


def read_faults(path: Path = LIST) -> list[Fault]:
    """Read the list; ValueError for a name used twice."""
    rows = tomllib.loads(path.read_text(encoding="utf-8"))["fault"]
    faults = [Fault(**row | {"tests": tuple(row["tests"])}) for row in rows]
    if len({fault.name for fault in faults}) != len(faults):
        raise ValueError(f"{path}: two faults have one name")
    return faults


def read_results(path: Path = RESULTS) -> dict[str, dict[str, str]]:
    """Return the rows that are there, by name."""
    if not path.exists():
        return {}
    with path.open(encoding="utf-8", newline="") as file:
        return {row["name"]: row for row in csv.DictReader(file)}


def _run_tests(tree: Path, tests: tuple[str, ...]) -> tuple[int, str, float]:
    """Run tests of a tree in a child; return (status, first test that failed, seconds of a processor)."""
    told = tree / "failed.txt"
    told.unlink(missing_ok=True)
    child = os.fork()
    if child == 0:
        quiet = os.open(os.devnull, os.O_WRONLY)
        os.dup2(quiet, 1)
        os.dup2(quiet, 2)
        os.chdir(tree)
        import pytest

        class Told:
            def pytest_runtest_logreport(self, report):
                if report.failed and not told.exists():
                    told.write_text(report.nodeid, encoding="utf-8")

            def pytest_collectreport(self, report):
                if report.failed and not told.exists():
                    told.write_text(report.nodeid, encoding="utf-8")

        status = 9
        try:
            status = int(pytest.main([*_OPTIONS, *tests], plugins=[Told()]))
        finally:
            os._exit(status)
    _, ended, used = os.wait4(child, 0)
    status = os.waitstatus_to_exitcode(ended)
    by = told.read_text(encoding="utf-8") if told.exists() else ""
    return status, by, used.ru_utime + used.ru_stime


_clock = itertools.count(int(time.time()), 10)


def _put(place: Path, text: str) -> None:
    """Write a source file with a time of its own, by which Python tells its compiled form from an earlier one."""
    place.write_text(text, encoding="utf-8")
    os.utime(place, (next(_clock),) * 2)


def _copy(tree: Path) -> None:
    """Copy what faults are planted in, and link the rest."""
    tree.mkdir()
    for item in ROOT.iterdir():
        if item.name in ("f3amd_lib", "f3amd_companion", "tests", "notebooks"):
            shutil.copytree(item, tree / item.name, ignore=shutil.ignore_patterns("__pycache__", "pretrained"))
        elif item.name not in (".git", ".venv", "runs"):
            (tree / item.name).symlink_to(item)
    (tree / "f3amd_lib" / "pretrained").symlink_to(ROOT / "f3amd_lib" / "pretrained")


def _import_foreign(tree: Path) -> None:
    """Import, once for all children, what the library and the tests import of others; of ours nothing stays."""
    sys.path[:0] = [str(tree), str(tree / "tests"), str(tree / "notebooks")]
    for name in (
        "builders",
        "pytest",
        "f3amd_companion.__main__",
        "f3amd_companion.measuring.measure",
        "f3amd_companion.ledger.claims",
    ):
        importlib.import_module(name)
    packages = ("builders", "f3amd_lib", "f3amd_companion", "f3amd_notebooks")
    ours = [name for name in sys.modules if name.partition(".")[0] in packages]
    for name in ours:
        del sys.modules[name]


def plant(fault: Fault, tree: Path) -> dict:
    """Plant a fault in the copy, run its tests, take it out again; return the row."""
    place = tree / fault.file
    sound = place.read_text(encoding="utf-8")
    _put(place, fault.planted(sound))
    try:
        status, by, seconds = _run_tests(tree, fault.tests)
    finally:
        _put(place, sound)
    if status not in (0, 1, 2, 5):  # 5: all of them are slow
        raise RuntimeError(f"fault {fault.name!r}: pytest ended with status {status} on {' '.join(fault.tests)}")
    row = {"name": fault.name, "area": fault.area, "file": fault.file, "caught": "no" if status in (0, 5) else "yes"}
    return row | {"by": by, "seconds": f"{seconds:.1f}", "fault": fault.digest}


def page(faults: list[Fault], results: dict[str, dict[str, str]]) -> str:
    """Return the page of docs/ from the rows: how many of each area, with one of them, and all that slipped through."""
    rows = [(fault, results[fault.name]) for fault in faults if fault.name in results]
    missed = [fault for fault, row in rows if row["caught"] != "yes"]
    waiting = f"; {len(faults) - len(rows)} are not planted yet" if len(rows) < len(faults) else ""
    areas: dict[str, list[Fault]] = {}
    for fault, _ in sorted(rows, key=lambda pair: pair[0].area):
        areas.setdefault(fault.area, []).append(fault)
    lines = [
        "# Planted faults",
        "",
        f"`make test` catches {len(rows) - len(missed)} of {len(rows)} planted faults{waiting}.",
        "`tests/faults.toml` lists them, and `docs/faults.csv` the test that caught each.",
        "`python scripts/faults.py` plants new faults in a copy of the tree, runs their tests and writes this page.",
        "",
        "| area | faults | missed | one of them |",
        "|---|---:|---:|---|",
    ]
    for area, some in areas.items():
        lines.append(f"| {area} | {len(some)} | {len(set(missed) & set(some))} | {some[0].name} |")
    lines += ["", "Missed: " + "; ".join(f"{one.name} (`{one.file}`)" for one in missed)] if missed else []
    return "\n".join([*lines, *_fuzzed()]) + "\n"


def _fuzzed() -> list[str]:
    """Return the part of the page on damaged files, from what `scripts/fuzz.py --keep` counted."""
    with FUZZ.open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    files, others = (sum(int(row[column]) for row in rows) for column in ("files", "other_errors"))
    each = ", ".join(f"{row['reader']} {int(row['files']):,}" for row in rows)
    return [
        "",
        "## Damaged files",
        "",
        f"`python scripts/fuzz.py --keep` read {files:,} files damaged at random. {others} gave an error other than a",
        f"`ValueError` that names the file. Readers: {each}. What was found is mended, and each find is a test",
        "(`tests/test_bad_input.py`, `tests/test_published.py`).",
    ]


def _write(faults: list[Fault], results: dict[str, dict[str, str]]) -> None:
    with RESULTS.open("w", encoding="utf-8", newline="") as file:
        table = csv.DictWriter(file, COLUMNS, lineterminator="\n")
        table.writeheader()
        table.writerows(results[fault.name] for fault in faults if fault.name in results)
    PAGE.write_text(page(faults, results), encoding="utf-8")


def main() -> int:
    """Plant what is asked for; status 1 if fewer than 95 % are caught."""
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--only", action="append", default=[], help="name of a fault; repeatable")
    options.add_argument("--again", action="store_true", help="also those that have a row")
    options.add_argument("--trust", action="store_true", help="the suite has just passed: do not run it without faults")
    asked = options.parse_args()
    faults, results = read_faults(), read_results()
    for fault in faults:  # before anything is run
        fault.planted((ROOT / fault.file).read_text(encoding="utf-8"))
    results = {fault.name: results[fault.name] for fault in faults if fault.name in results}
    if unknown := set(asked.only) - {fault.name for fault in faults}:
        raise SystemExit(f"unknown fault {sorted(unknown)[0]!r}")
    # What slipped through is tried again: the tests may have changed since.
    done = lambda fault: (results.get(fault.name) or {}).get("fault") == fault.digest and results[fault.name]["by"]
    todo = [
        fault for fault in faults if fault.name in asked.only or (not asked.only and (asked.again or not done(fault)))
    ]
    os.environ |= {
        "JAX_PLATFORMS": "cpu",
        "JAX_DISABLE_MOST_OPTIMIZATIONS": "1",
        # What one child compiled, the next one reads.
        "JAX_COMPILATION_CACHE_DIR": str(ROOT / ".pytest_cache" / "jax"),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
        "MPLBACKEND": "Agg",
        "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1",
    }
    _write(faults, results)
    sound: set[tuple[str, ...]] = set()
    with tempfile.TemporaryDirectory(prefix="faults-") as folder:
        tree = Path(folder) / "tree"
        _copy(tree)
        _import_foreign(tree)
        for number, fault in enumerate(todo, 1):
            row = plant(fault, tree)
            # A fault is not caught by tests that fail without it, too.
            if row["caught"] == "yes" and fault.tests not in sound and not asked.trust:
                status, by, _ = _run_tests(tree, fault.tests)
                if status:
                    raise RuntimeError(f"{' '.join(fault.tests)}: fails without any fault, first in {by}")
                sound.add(fault.tests)
            results[fault.name] = row
            _write(faults, results)
            said = "caught" if row["caught"] == "yes" else "MISSED"
            print(f"{number} of {len(todo)}  {said}  {fault.name}  {row['seconds']} s")
            sys.stdout.flush()
    caught = sum(row["caught"] == "yes" for row in results.values())
    print(f"{caught} of {len(results)} caught")
    return 0 if caught >= BAR * len(results) else 1


if __name__ == "__main__":
    sys.exit(main())
