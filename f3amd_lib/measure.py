"""Measure what takes too long for a notebook: `python -m f3amd_lib.measure learning`.

A measurement writes a tidy table with its run record under `<results>/records/`, after every model,
so that a run that was stopped goes on where it was. Notebooks only read these tables. Results go to
the ignored `runs/` unless `F3AMD_RESULTS_DIR` says otherwise (`make measure` sends them to
`paper_figures/`).
"""

from __future__ import annotations

import argparse
import logging
import sys
from collections.abc import Callable, Iterable
from pathlib import Path

import pandas as pd

from f3amd_lib.models import zoo
from f3amd_lib.names import nearest_hint
from f3amd_lib.profiles import DATASETS, PROFILES, Profile, load_profile, results_dir
from f3amd_lib.report.records import read_table, record_hash, run_record, write_table
from f3amd_lib.training.family import SHORT_RUN, learning_curves
from f3amd_lib.training.pipeline import PreparedData, prepare

__all__ = ["MEASUREMENTS", "measure_learning", "main"]

log = logging.getLogger("f3amd")


def _kept_rows(path: Path, record: dict) -> pd.DataFrame | None:
    """Return the rows of an earlier run that asked for the same; None if there are none."""
    if not path.exists():
        return None
    rows, earlier = read_table(path)
    return rows if record_hash(earlier) == record_hash(record) else None


def measure_learning(
    prepared: PreparedData, profile: Profile, models: Iterable[str] | None = None
) -> Path:
    """Train every preset for a short while and keep its learning curve (see `training.family`).

    Args:
      prepared: the data.
      profile: names the results' folder and the seed.
      models: presets; all by default. Models measured earlier, with the same settings on the same
        data, keep their rows; asking for one by name measures it again.

    Returns:
      The table, `records/learning.csv`.
    """
    path = results_dir(profile.dataset, profile.name) / "records" / "learning.csv"
    record = run_record(
        profile=profile, dataset=prepared.packed, seed=profile.seed, measurement="learning",
        **SHORT_RUN,
    )  # fmt: skip
    kept = _kept_rows(path, record)
    measured = set() if kept is None else set(kept["model"])
    todo = list(models) if models else [name for name in zoo.PRESETS if name not in measured]
    tables = [] if kept is None else [kept[~kept["model"].isin(todo)]]
    for curve in learning_curves(prepared, todo, seed=profile.seed):
        tables.append(curve)
        write_table(path, pd.concat(tables), record)
    return path


MEASUREMENTS: dict[str, Callable] = {"learning": measure_learning}
"""Name -> function of (prepared data, profile, models or None) that returns its table's path."""


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; see the module's first lines.

    Args:
      arguments: words after the program's name; those of the process by default.

    Returns:
      Exit status: 0 if all was measured, 2 for a name that does not exist.
    """
    parser = argparse.ArgumentParser(
        prog="python -m f3amd_lib.measure",
        description="Measure what notebooks only draw; tables go to <results>/records/.",
    )
    parser.add_argument(
        "names", nargs="*", metavar="MEASUREMENT", help=f"{', '.join(MEASUREMENTS)}; all if none"
    )
    parser.add_argument("--data", default="synthetic", help=", ".join(DATASETS))
    parser.add_argument("--profile", default="laptop", help=", ".join(PROFILES))
    parser.add_argument("--source", help="folder or archive of the data set, where it needs one")
    parser.add_argument(
        "--model", action="append", default=[], metavar="NAME", help="this preset; repeatable"
    )
    options = parser.parse_args(arguments)
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    try:
        profile = load_profile(options.profile, options.data)
        for name in options.names:
            if name not in MEASUREMENTS:
                raise ValueError(f"unknown measurement {name!r}{nearest_hint(name, MEASUREMENTS)}")
        models = [zoo.find_preset(name).name for name in options.model] or None
        prepared = prepare(profile, path=options.source)
        for name in options.names or MEASUREMENTS:
            path = MEASUREMENTS[name](prepared, profile, models)
            log.info("%-12s %s", name, path)
    except ValueError as error:
        log.error("Stopped: %s", error)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
