"""What a paper says, as data: a folder of `papers/` for each, with its tables, equations, claims and open points."""

import functools
from collections.abc import Iterable, Mapping
from pathlib import Path

import pandas as pd

from f3amd_lib.ground.files import read_toml
from f3amd_lib.ground.names import check_known, nearest_hint

_FOLDER = Path(__file__).parents[1] / "papers"


def paper_folders() -> list[str]:
    """Return the names of all papers, as their folders are called."""
    return sorted(path.parent.name for path in _FOLDER.glob("*/paper.toml"))


def has_paper_file(name: str, paper: str) -> bool:
    """Tell whether a paper's folder has a file, by its name without the ending."""
    return (_FOLDER / paper / f"{name}.toml").exists()


@functools.cache
def load_paper_file(name: str, paper: str = "f3amd") -> dict:
    """Return a file of a paper's folder; callers must not change it.

    Args:
      name: "paper", "claims", "commands" or "readings".
      paper: its folder, one of `paper_folders`.

    Raises:
      ValueError: for an unknown paper.
      FileNotFoundError: for a missing file.
    """
    check_known(paper, paper_folders(), "paper")
    return read_toml(_FOLDER / paper / f"{name}.toml")


def check_entry(entry: Mapping, where: str, required: Iterable[str], optional: Iterable[str] = ()) -> None:
    """Raise ValueError for a key that an entry of a paper's file lacks, or that is unknown there.

    Args:
      entry: the table as read.
      where: file and entry, for the message.
      required, optional: its keys.
    """
    if missing := [key for key in required if key not in entry]:
        raise ValueError(f"{where}: has no {missing[0]!r}; add it")
    for key in entry:
        find_entry(dict.fromkeys([*required, *optional]), key, "key", where)


def find_entry(known: Mapping, name, what: str, where: str):
    """Return a value by its name; ValueError with the nearest name if there is none."""
    if name not in known:
        raise ValueError(f"{where}: unknown {what} {name!r}{nearest_hint(name, known)}")
    return known[name]


def load_paper_table(number: int | str, paper: str = "f3amd") -> pd.DataFrame:
    """Return one table of a paper in tidy form.

    Args:
      number: the table's number in the paper, as its `paper.toml` has it.
      paper: its folder.

    Returns:
      A new DataFrame with the column model, the settings of a row (F3AMD: window_frames, steps and either
      device, characters, for times, or none), then metric, unit, better, printed (text as printed, "" for a
      dash), value (float, NaN for a dash) and what else the file has. `frame.attrs` has the table's number, title,
      note ("" if it needs none) and setting.

    Raises:
      ValueError: if there is no such table.
    """
    description = load_paper_file("paper", paper)
    entries = {entry["number"]: entry for entry in description.get("table", ())}
    if number not in entries:
        raise ValueError(f"the {description['name']} paper has tables {', '.join(map(str, entries))}, not {number!r}")
    entry = entries[number]
    frame = pd.read_csv(_FOLDER / paper / "numbers" / entry["file"], dtype=str, keep_default_na=False)
    counts = [column for column in ("window_frames", "steps", "characters") if column in frame]
    frame = frame.rename(columns={"value": "printed"}).astype(dict.fromkeys(counts, int))
    for column in ("metric", "unit", "better"):
        if column in entry:
            frame.insert(frame.columns.get_loc("printed"), column, entry[column])
    frame["value"] = pd.to_numeric(frame["printed"], errors="coerce")
    frame.attrs = {"table": number, "title": entry["title"], "note": entry.get("note", "")}
    frame.attrs["setting"] = description["setting"]
    return frame


def load_sizes(paper: str) -> pd.DataFrame | None:
    """Return the models of a paper with their sizes as `presets.table` counted them; None where none are kept."""
    path = _FOLDER / paper / "sizes.csv"
    return pd.read_csv(path) if path.exists() else None
