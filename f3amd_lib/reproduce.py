"""The main job: run the numbered notebooks in order and leave their results where they belong.

    python -m f3amd_lib.reproduce --data synthetic --profile laptop
    python -m f3amd_lib.reproduce --data bandai --profile laptop --only 04 --set train_steps=4000

Executed copies and logs go to the ignored `runs/<data set>/<profile>/notebooks/`, where a new run
replaces the last one's. Results of `laptop` and `gpu` go to `paper_figures/`, those of `smoke` to
`runs/`; `F3AMD_RESULTS_DIR` overrules both.
"""

from __future__ import annotations

import argparse
import ast
import contextlib
import logging
import os
import sys
import time
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path

import nbformat
import pandas as pd
import papermill
from nbclient.exceptions import DeadKernelError
from papermill.exceptions import PapermillExecutionError
from tqdm import tqdm

from f3amd_lib.data.packed import CACHE_DIR_VARIABLE
from f3amd_lib.data.sources import DATA_DIR_VARIABLE
from f3amd_lib.ground import profiles
from f3amd_lib.ground.names import nearest_hint
from f3amd_lib.ground.profiles import load_profile, results_dir, runs_dir
from f3amd_lib.ground.records import run_record, write_table

KERNEL = "python3"
_SETTLED = 60.0
"""Seconds at the usual pace that are taken for granted before a run's own pace counts."""


class NotebookFailed(RuntimeError):
    """A notebook stopped; the message names the notebook, the cell, the error and the log."""


def find_notebooks(folder) -> list[Path]:
    """Return the numbered notebooks of a folder in their order.

    Args:
      folder: where `00_....ipynb`, `01_....ipynb` and so on lie.

    Raises:
      ValueError: if there is none.
    """
    found = sorted(Path(folder).glob("[0-9][0-9]_*.ipynb"))
    if not found:
        raise ValueError(f"{folder}: no numbered notebooks here; run this in a checkout of the repository")
    return found


def select_notebooks(notebooks: Iterable[Path], only: Iterable[str] = ()) -> list[Path]:
    """Keep the notebooks that are asked for, in their own order.

    Args:
      notebooks: from `find_notebooks`.
      only: numbers ("03", "3") or names ("03_architecture", with or without ending); empty keeps
        all.

    Raises:
      ValueError: if something asked for is not there, with the nearest name.
    """
    notebooks = list(notebooks)
    chosen = set()
    for wanted in only:
        stem = wanted.removesuffix(".ipynb")
        number = stem.zfill(2)
        hits = {path for path in notebooks if path.stem == stem or path.stem[:2] == number}
        if not hits:
            hint = nearest_hint(stem, [path.stem for path in notebooks])
            raise ValueError(f"no notebook {wanted!r}{hint}")
        chosen |= hits
    return [path for path in notebooks if path in chosen] if chosen else notebooks


def check_parameters(notebooks: Iterable[Path], names: Iterable[str]) -> None:
    """Refuse a parameter that a notebook does not have, before any of them runs.

    Papermill itself injects an unknown name, logs a line and goes on with the default.

    Args:
      notebooks: which will run.
      names: of the parameters that will be passed to each of them.

    Raises:
      ValueError: naming notebook, parameter and the nearest one that the notebook has.
    """
    names = list(names)
    for path in notebooks:
        known = papermill.inspect_notebook(str(path))
        for name in names:
            if name not in known:
                raise ValueError(f"{path.name} has no parameter {name!r}{nearest_hint(name, known)}")


def written_since(folder: Path, start: float) -> dict[str, int]:
    """Count the files under each folder of results that were written after a moment.

    Args:
      folder: results of one data set and profile.
      start: seconds since the epoch.

    Returns:
      "figures", "tables", ... -> number of files, only where there are some; records beside tables
      do not count.
    """
    counts = {}
    for path in Path(folder).rglob("*"):
        if path.suffix not in (".json", ".md") and path.is_file() and path.stat().st_mtime >= start:
            kind = path.relative_to(folder).parts[0]
            counts[kind] = counts.get(kind, 0) + 1
    return counts


def _news(path: Path, seconds: float, wrote: Mapping[str, int], left: float | None) -> str:
    """Put into one line what a notebook took and wrote, and how long the rest will take."""
    files = ", ".join(f"{count} {kind}" for kind, count in sorted(wrote.items())) or "no file"
    rest = "" if not left else f"; about {_duration(left)} left"
    return f"{path.stem:24s} {_duration(seconds):>11s}   wrote {files}{rest}"


def _duration(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 90 else f"{seconds / 60:.1f} min"


def _usual_seconds(results: Path) -> dict[str, float]:
    """Return how long each notebook took in the last whole run, if there was one."""
    summary = results / "tables" / "run_summary.csv"
    if not summary.is_file():
        return {}
    table = pd.read_csv(summary)
    return dict(zip(table["notebook"], table["seconds"], strict=True))


def what_to_open(results: Path) -> list[str]:
    """Return the files of a run that are worth opening first, as lines "what: path"."""
    worth = {
        "a walk to look at": "media/00_first_walk.gif",
        "and the longer one of notebook 05": "media/05_rollout.gif",
        "a crowd to turn around, in a browser": "media/14_crowd.html",
        "film strips": "figures/05_film_strip.png",
        "do they walk, in numbers": "tables/05_walks.csv",
    }
    found = {what: results / name for what, name in worth.items()}
    found["each claim of the paper with a verdict"] = profiles.repository_root() / "paper_figures" / "claims.md"
    return [f"{what}: {_short(path)}" for what, path in found.items() if path.is_file()]


def reproduce(
    dataset: str,
    profile: str,
    *,
    only: Iterable[str] = (),
    parameters: Mapping | None = None,
    notebooks_dir=None,
    say: Callable[[str], None] = lambda line: None,
) -> pd.DataFrame:
    """Run the numbered notebooks with a data set and a profile; stop at the first that fails.

    A run of all notebooks leaves `tables/run_summary.csv` among the results; a run of some, or one
    that failed, leaves it in `runs/<data set>/<profile>/`.

    Args:
      dataset: one of `profiles.DATASETS`, passed to the notebooks as `data`.
      profile: one of `profiles.PROFILES`, passed as `profile`.
      only: see `select_notebooks`.
      parameters: more of them, passed to every selected notebook.
      notebooks_dir: where the notebooks lie; the checkout's `notebooks/` by default.
      say: called with each line of news.

    Returns:
      One row per notebook: notebook, seconds (wall time), cells, finished.

    Raises:
      ValueError: for a name that does not exist: data set, profile, notebook or parameter.
      NotebookFailed: if a notebook stops.
    """
    defaults = load_profile(profile, dataset)  # refuses unknown names before anything starts
    parameters = {"profile": profile, "data": dataset, **(parameters or {})}
    folder = notebooks_dir or profiles.repository_root() / "notebooks"
    available = find_notebooks(folder)
    selected = select_notebooks(available, only)
    check_parameters(selected, parameters)

    own_folder = runs_dir(dataset, profile)
    executed_folder = own_folder / "notebooks"
    executed_folder.mkdir(parents=True, exist_ok=True)
    record_extras = {"parameters": parameters, "notebooks": [path.name for path in selected], **_machine()}
    rows = []
    failure = None
    with _results_root(profile):
        results = results_dir(dataset, profile)
        # Bars are for people: a log file gets the lines of `say` instead.
        usual, took, usually = _usual_seconds(results), _SETTLED, _SETTLED
        for number, path in enumerate(tqdm(selected, desc="notebooks", disable=None)):
            began, start = time.time(), time.monotonic()
            try:
                _execute(path, executed_folder / path.name, parameters)
            except NotebookFailed as error:
                failure = error
            seconds = time.monotonic() - start
            rows.append(
                {
                    "notebook": path.name,
                    "seconds": round(seconds, 1),
                    "cells": _count_code_cells(path),
                    "finished": failure is None,
                }
            )
            if failure:
                break
            if path.name in usual:
                took, usually = took + seconds, usually + usual[path.name]
            rest = sum(usual.get(later.name, 0.0) for later in selected[number + 1 :])
            left = rest * took / usually
            say(_news(path, seconds, written_since(results, began), left))

    summary = pd.DataFrame(rows)
    complete = failure is None and len(selected) == len(available)
    # Only now: the record asks JAX for its devices, and a process that holds a GPU would have kept
    # its memory from the notebooks.
    record = run_record(profile=profile, dataset=dataset, seed=parameters.get("seed", defaults.seed), **record_extras)
    write_table((results / "tables" if complete else own_folder) / "run_summary.csv", summary, record)
    if failure:
        raise failure
    return summary


def _execute(path: Path, copy: Path, parameters: Mapping) -> None:
    """Run one notebook into a copy; where it fails, write a log beside the copy and say so."""
    log = copy.with_suffix(".log")
    log.unlink(missing_ok=True)  # an old log beside a good copy would mislead
    try:
        papermill.execute_notebook(
            str(path),
            str(copy),
            parameters=dict(parameters),
            kernel_name=KERNEL,
            cwd=str(path.parent),  # as in JupyterLab and nbval
            # A kernel warns of its own connection to this process, which no reader can act on.
            extra_arguments=["--log-level=ERROR"],
            progress_bar={"desc": path.stem, "position": 1, "leave": False, "disable": None},
        )
    except PapermillExecutionError as error:
        cell = f"cell In [{error.exec_count}], {_first_line(error.source)!r}"
        cause = f"{error.ename}: {error.evalue}"
        log.write_text(str(error), encoding="utf-8")
        raise NotebookFailed(_failure(path, cell, cause, copy, log)) from None
    except DeadKernelError as error:
        # The kernel was killed (by the system, when memory runs out) and left no traceback.
        cell = _last_started_cell(copy)
        cause = f"{error} (was the machine out of memory?)"
        log.write_text(f"{cell}\n{cause}\n", encoding="utf-8")
        raise NotebookFailed(_failure(path, cell, cause, copy, log)) from None


def _failure(path: Path, cell: str, cause: str, copy: Path, log: Path) -> str:
    return f"{path.name} stopped in {cell}\n  {cause}\n  log: {_short(log)}\n  executed so far: {_short(copy)}"


def _last_started_cell(copy: Path) -> str:
    """Find where a notebook without a traceback stopped, from papermill's start times."""
    started = [
        cell
        for cell in nbformat.read(copy, as_version=4).cells
        if cell.cell_type == "code" and cell.source.strip() and cell.metadata.papermill.start_time
    ]
    return f"cell In [{len(started)}], {_first_line(started[-1].source)!r}"


def _first_line(source: str) -> str:
    return next((line for line in source.splitlines() if line.strip()), "")


def _short(path: Path) -> str:
    """Return a path as it is typed at the repository's root."""
    with contextlib.suppress(ValueError):
        path = path.relative_to(profiles.repository_root())
    return str(path)


def _count_code_cells(path: Path) -> int:
    return sum(cell.cell_type == "code" for cell in nbformat.read(path, as_version=4).cells)


@contextlib.contextmanager
def _results_root(profile: str):
    """Send the notebooks' results to the committed folder for as long as they run.

    `smoke` is a check, not a result, so it stays in `runs/`. A variable that is set already wins.
    """
    name = profiles.RESULTS_DIR_VARIABLE
    if profile == "smoke" or os.environ.get(name):
        yield
        return
    before = os.environ.get(name)
    os.environ[name] = str(profiles.repository_root() / "paper_figures")
    try:
        yield
    finally:
        if before is None:
            del os.environ[name]
        else:
            os.environ[name] = before


def _machine() -> dict:
    """Return what a wall time is read against; empty without the `bench` extra."""
    try:
        import psutil
    except ImportError:
        return {}
    return {
        "physical_cores": psutil.cpu_count(logical=False),
        "memory_gib": round(psutil.virtual_memory().total / 2**30, 1),
    }


def _assignment(text: str) -> tuple[str, object]:
    """Split "name=value"; a value that is no Python literal is a string."""
    name, equals, value = text.partition("=")
    if not (equals and name.isidentifier()):
        raise argparse.ArgumentTypeError(f"{text!r} is not NAME=VALUE")
    if name in ("profile", "data"):
        raise argparse.ArgumentTypeError(f"use --{name} for {name!r}")
    try:
        return name, ast.literal_eval(value)
    except (ValueError, SyntaxError):
        return name, value


def _say(line: str) -> None:
    """Write a line at once, also where nobody sits at a terminal."""
    tqdm.write(line)
    sys.stdout.flush()


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; see the module's first lines.

    Args:
      arguments: words after the program's name; those of the process by default.

    Returns:
      Exit status: 0 if every notebook finished, 1 if one failed, 2 for a name that does not exist.
    """
    parser = argparse.ArgumentParser(
        prog="python -m f3amd_lib.reproduce",
        description="Run the numbered notebooks in order; results go under paper_figures/.",
    )
    parser.add_argument("--data", default="synthetic", help=f"{', '.join(profiles.DATASETS)}")
    parser.add_argument("--profile", default="laptop", help=f"{', '.join(profiles.PROFILES)}")
    parser.add_argument("--only", action="append", default=[], metavar="NUMBER", help="this notebook; repeatable")
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        type=_assignment,
        metavar="NAME=VALUE",
        help="a parameter of every notebook that runs; repeatable",
    )
    options = parser.parse_args(arguments)
    # Notebooks run in their own folder, where a relative path would lead elsewhere.
    for variable in (profiles.RESULTS_DIR_VARIABLE, DATA_DIR_VARIABLE, CACHE_DIR_VARIABLE):
        if os.environ.get(variable):
            os.environ[variable] = str(Path(os.environ[variable]).resolve())
    # Papermill names each notebook twice at INFO; warnings are news.
    logging.getLogger("papermill").setLevel(logging.WARNING)
    try:
        summary = reproduce(options.data, options.profile, only=options.only, parameters=dict(options.set), say=_say)
    except ValueError as error:
        tqdm.write(f"Stopped: {error}", file=sys.stderr)
        return 2
    except NotebookFailed as error:
        tqdm.write(f"Stopped: {error}", file=sys.stderr)
        return 1
    _say(
        f"{len(summary)} notebooks finished in {summary['seconds'].sum() / 60:.1f} minutes "
        f"(data {options.data}, profile {options.profile}). To open first:"
    )
    with _results_root(options.profile):
        for line in what_to_open(results_dir(options.data, options.profile)):
            _say(f"  {line}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
