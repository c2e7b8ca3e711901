"""The main job: run the numbered notebooks in order and leave their results where they belong.

    f3amd figures --data synthetic --profile laptop
    f3amd figures --data bandai --profile laptop --only 04 --set train_steps=4000

Executed copies and logs go to the ignored `runs/<data set>/<profile>/notebooks/`, where a new run
replaces the last one's. Results of `laptop` and `gpu` go to `paper_figures/`, those of `smoke` to
`runs/`; `F3AMD_RESULTS_DIR` overrules both.
"""

import ast
import contextlib
import os
import time
from collections.abc import Callable, Collection, Iterable, Mapping
from pathlib import Path

import pandas as pd
from tqdm import tqdm

from f3amd_companion.speed.machine import describe_machine
from f3amd_lib.data.packed import CACHE_DIR_VARIABLE
from f3amd_lib.data.sources import DATA_DIR_VARIABLE
from f3amd_lib.ground import profiles
from f3amd_lib.ground.files import locked
from f3amd_lib.ground.names import nearest_hint
from f3amd_lib.ground.profiles import load_profile, results_dir, runs_dir
from f3amd_lib.ground.records import run_record, write_table

try:
    import nbformat
    import papermill
    from nbclient.exceptions import DeadKernelError
    from papermill.exceptions import PapermillExecutionError
except ModuleNotFoundError as error:
    raise ImportError(f'notebooks need {error.name}: make install, or pip install "f3amd_lib[notebooks]"') from None

KERNEL = "python3"


class NotebookFailed(ValueError):
    """A notebook stopped; the message names the notebook, the cell, the error and the log."""


def find_notebooks(folder, only: Iterable[str] = ()) -> list[Path]:
    """Return the numbered notebooks of a folder in their order.

    Args:
      folder: where `00_....ipynb`, `01_....ipynb` and so on lie.
      only: numbers ("03", "3") or names ("03_architecture", with or without ending) of some; empty is all.

    Raises:
      ValueError: if there is none, or something asked for is not there, with the nearest name.
    """
    found = sorted(Path(folder).glob("[0-9][0-9]_*.ipynb"))
    if not found:
        raise ValueError(f"{folder}: no numbered notebooks here; run this in a checkout of the repository")
    chosen = set()
    for wanted in only:
        stem = wanted.removesuffix(".ipynb")
        hits = {path for path in found if path.stem == stem or path.stem[:2] == stem.zfill(2)}
        if not hits:
            raise ValueError(f"no notebook {wanted!r}{nearest_hint(stem, [path.stem for path in found])}")
        chosen |= hits
    return sorted(chosen) or found


def check_parameters(notebooks: Iterable[Path], names: Collection[str]) -> None:
    """Refuse a parameter that a notebook does not have, before any of them runs.

    Papermill itself injects an unknown name, logs a line and goes on with the default.

    Args:
      notebooks: which will run.
      names: of the parameters that will be passed to each of them.

    Raises:
      ValueError: naming notebook, parameter and the nearest one that the notebook has.
    """
    for path in notebooks:
        known = papermill.inspect_notebook(str(path))
        for name in names:
            if name not in known:
                raise ValueError(f"{path.name} has no parameter {name!r}{nearest_hint(name, known)}")


def keep_once(folders: Iterable[Path]) -> None:
    """Delete pictures that have the name and the bytes of one before.

    Pictures of theory come out alike with every data set, so that each run leaves them again.

    Args:
      folders: results, those whose pictures stay first.
    """
    seen: set[tuple[str, bytes]] = set()
    for path in (path for folder in folders for path in sorted(folder.rglob("*.png"))):
        known = path.name, path.read_bytes()
        if known in seen:
            path.unlink()
        seen.add(known)


def reproduce(
    dataset: str, profile: str, *, only: Iterable[str] = (), parameters: Mapping | None = None,
    say: Callable[[str], None] = lambda line: None,
) -> pd.DataFrame:  # fmt: skip
    """Run the numbered notebooks with a data set and a profile; stop at the first that fails.

    A run of all notebooks leaves `tables/run_summary.csv` among the results; a run of some, or one
    that failed, leaves it in `runs/<data set>/<profile>/`.

    Args:
      dataset: one of `profiles.DATASETS`, passed to the notebooks as `data`.
      profile: one of `profiles.PROFILES`, passed as `profile`.
      only: see `find_notebooks`.
      parameters: more of them, passed to every selected notebook.
      say: called with each line of news.

    Returns:
      One row per notebook: notebook, seconds (wall time), cells, finished.

    Raises:
      ValueError: for a name that does not exist (data set, profile, notebook, parameter), or a notebook that
        another process runs with this data set and profile.
      NotebookFailed: if a notebook stops.
    """
    defaults = load_profile(profile, dataset)  # refuses unknown names before anything starts
    parameters = {"profile": profile, "data": dataset, **(parameters or {})}
    selected = find_notebooks(profiles.repository_root() / "notebooks", only)
    check_parameters(selected, parameters)

    own_folder, results = runs_dir(dataset, profile), results_dir(dataset, profile)
    rows, failure = _run_each(selected, own_folder / "notebooks", parameters, say)
    summary = pd.DataFrame(rows)
    # Only now: the record asks JAX for its devices, and a process that holds a GPU would have kept
    # its memory from the notebooks.
    record = run_record(
        profile=profile, dataset=dataset, seed=parameters.get("seed", defaults.seed), parameters=parameters,
        notebooks=[path.name for path in selected], machine=describe_machine(),
    )  # fmt: skip
    write_table((own_folder if failure or only else results / "tables") / "run_summary.csv", summary, record)
    if failure:
        raise failure
    if profile != "smoke":  # a check leaves its results where nobody commits them, all of them
        others = sorted(results.parents[1].glob(f"*/{profile}"))
        keep_once(sorted(others, key=lambda folder: folder.parent.name != "synthetic"))
    return summary


def run_course(only: Iterable[str] = (), *, say: Callable[[str], None] = lambda line: None) -> list[Path]:
    """Run the notebooks of `notebooks/course/`, which take no parameters and write nothing; stop at one that fails.

    Args:
      only: see `find_notebooks`.
      say: called with each line of news.

    Returns:
      The executed copies, in `runs/course/`.

    Raises:
      ValueError: for a notebook that is not there.
      NotebookFailed: if a notebook stops.
    """
    root = profiles.repository_root()
    rows, failure = _run_each(find_notebooks(root / "notebooks/course", only), root / "runs/course", {}, say)
    if failure:
        raise failure
    return [root / "runs/course" / row["notebook"] for row in rows]


def _run_each(notebooks: list[Path], folder: Path, parameters: Mapping, say):
    """Run notebooks into copies until one fails; return a row of the summary each, and the failure or None."""
    folder.mkdir(parents=True, exist_ok=True)
    rows, failure = [], None
    with contextlib.ExitStack() as held:  # no other process runs one of them into the same folder
        for path in notebooks:
            held.enter_context(locked(folder / f".{path.stem}.lock", f"running {path.name}"))
        # Bars are for people: a log file gets the lines of `say` instead.
        for path in tqdm(notebooks, desc="notebooks", disable=None):
            began = time.time()
            failure = _execute(path, folder / path.name, parameters)
            seconds, finished = time.time() - began, failure is None
            cells = sum(cell.cell_type == "code" for cell in nbformat.read(path, as_version=4).cells)
            rows.append({"notebook": path.name, "seconds": round(seconds, 1), "cells": cells, "finished": finished})
            if failure:
                break
            took = f"{seconds:.0f} s" if seconds < 90 else f"{seconds / 60:.1f} min"
            say(f"{path.stem:24s} {took:>11s}")
    return rows, failure


def _execute(path: Path, copy: Path, parameters: Mapping) -> NotebookFailed | None:
    """Run one notebook into a copy; where it fails, write a log beside the copy and return what to say."""
    log = copy.with_suffix(".log")
    log.unlink(missing_ok=True)  # an old log beside a good copy would mislead
    try:
        papermill.execute_notebook(
            str(path),
            str(copy),
            parameters=dict(parameters),
            kernel_name=KERNEL,
            cwd=str(path.parent),  # as in JupyterLab and nbval
            # A kernel warns of its own connection to this process, and reports the interrupt that comes before its
            # shutdown as an error, if that finds it busy with papermill's last question. No reader can act on either.
            extra_arguments=["--log-level=CRITICAL"],
            progress_bar={"desc": path.stem, "position": 1, "leave": False, "disable": None},
        )
        return None
    except PapermillExecutionError as error:
        number, source, cause, trace = error.exec_count, error.source, f"{error.ename}: {error.evalue}", str(error)
    except DeadKernelError as error:
        # The kernel was killed (by the system, when memory runs out) and left no traceback: its last cell stopped.
        cells = [cell for cell in nbformat.read(copy, as_version=4).cells if cell.cell_type == "code" and cell.source]
        started = [cell.source for cell in cells if cell.metadata.papermill.start_time]
        number, source, cause = len(started), started[-1], f"{error} (was the machine out of memory?)"
        trace = f"{source}\n{cause}\n"
    log.write_text(trace, encoding="utf-8")
    first_line = source.strip().split("\n")[0]
    return NotebookFailed(
        f"{path.name} stopped in cell In [{number}], {first_line!r}\n  {cause}\n"
        f"  log: {_short(log)}\n  executed so far: {_short(copy)}"
    )


def _short(path: Path) -> str:
    """Return a path as it is typed at the repository's root."""
    root = profiles.repository_root()
    return str(path.relative_to(root) if path.is_relative_to(root) else path)


def parse_assignment(text: str) -> tuple[str, object]:
    """Split "name=value"; a value that is no Python literal is a string.

    Raises:
      ValueError: for another form, or a name that has an option of its own.
    """
    name, equals, value = text.partition("=")
    if not (equals and name.isidentifier()):
        raise ValueError(f"--set {text!r} is not NAME=VALUE")
    if name in ("profile", "data"):
        raise ValueError(f"use --{name} for {name!r}")
    try:
        return name, ast.literal_eval(value)
    except (ValueError, SyntaxError):
        return name, value


def set_folders(profile: str) -> None:
    """Tell the notebooks, which run in a folder of their own, where data lie and results go.

    Results go to the committed `paper_figures/`, but those of `smoke`, a check, stay in `runs/`.
    Where a variable is set already, it wins.
    """
    if profile != "smoke" and not os.environ.get(profiles.RESULTS_DIR_VARIABLE):
        os.environ[profiles.RESULTS_DIR_VARIABLE] = str(profiles.repository_root() / "paper_figures")
    for variable in (profiles.RESULTS_DIR_VARIABLE, DATA_DIR_VARIABLE, CACHE_DIR_VARIABLE):
        if os.environ.get(variable):
            os.environ[variable] = str(Path(os.environ[variable]).resolve())
