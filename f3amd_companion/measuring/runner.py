"""What was asked, what is measured already, and what is still to do: records that grow row by row.

A record is a table with its run record (`ground.records`). It is written after every row, so that a
run that was stopped goes on where it was.
"""

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from pathlib import Path

import pandas as pd

from f3amd_lib.ground import log
from f3amd_lib.ground.names import asked_network
from f3amd_lib.ground.profiles import Profile, results_dir
from f3amd_lib.ground.records import read_table, record_hash, run_record, set_aside_table, whole_table, write_table


def records_folder(profile: Profile) -> Path:
    """Return where the records of a data set and profile lie."""
    return results_dir(profile.dataset, profile.name) / "records"


def record_of(profile: Profile, data, measurement: str, **extra) -> dict:
    """Return the run record of a measurement on a data set with a profile's seed."""
    return run_record(profile=profile, dataset=data, seed=profile.seed, measurement=measurement, **extra)


def kept_rows(path, record: dict) -> pd.DataFrame | None:
    """Return the rows of an earlier run with the same settings, so that a stopped run continues.

    A table with other settings is kept under another name, and so is a broken one: a run may
    have been killed between the table and its record.

    Args:
      path: of the CSV.
      record: of the run that wants to go on.

    Returns:
      The rows; None if there are none.
    """
    if (found := whole_table(path)) is None:
        return None
    rows, earlier = found
    if record_hash(earlier) != record_hash(record):
        kept = set_aside_table(path)
        log.warning("%s was measured with other settings or data: kept as %s", path, kept.name)
        return None
    return _with_empty_texts(rows)


def others_rows(path, record: dict) -> pd.DataFrame | None:
    """Return the rows of another run with the same settings, or None; its table is only read."""
    try:
        rows, theirs = read_table(path)
    except (ValueError, FileNotFoundError):
        return None
    return _with_empty_texts(rows) if record_hash(theirs) == record_hash(record) else None


def _with_empty_texts(rows: pd.DataFrame) -> pd.DataFrame:
    """CSV knows no empty text."""
    return rows.assign(**{column: rows[column].fillna("") for column in ("unit", "weights") if column in rows})


class Records:
    """Tables of one measurement, with the rows that an earlier run of the same settings left.

    Args:
      folder: where the tables lie.
      record: from `run_record`, for all of them.
      keys: table -> columns that name a measurement: rows that agree in them are replaced together.
      again: models that are measured again though they have rows.
      known: folder of another run's tables; what they have counts as measured, and they are only read.
      summaries: further tables, written with the ones that they sum up: name -> (table, function of its rows).
    """

    def __init__(
        self, folder: Path, record: dict, keys: Mapping[str, Sequence[str]], *, again: Collection[str] = (),
        known: Path | None = None, summaries: Mapping[str, tuple[str, Callable[[pd.DataFrame], pd.DataFrame]]] = {},
    ):  # fmt: skip
        self.folder, self.record, self.keys = Path(folder), record, keys
        self.again, self.summaries = again, summaries
        self.tables = {name: kept_rows(self.path(name), record) for name in keys}
        self.known = {} if known is None else {name: others_rows(known / f"{name}.csv", record) for name in keys}

    def path(self, name: str) -> Path:
        """Return where a table lies."""
        return self.folder / f"{name}.csv"

    def has(self, name: str, row: Mapping) -> bool:
        """Tell whether a table has rows of this name that agree in all columns of `row`, weights among them."""
        tables = [rows for rows in (self.tables[name], self.known.get(name)) if rows is not None and {*row} <= {*rows}]
        return asked_network(str(row.get("model"))) not in self.again and any(
            (rows[list(row)] == list(row.values())).all(axis=1).any() for rows in tables
        )

    def put(self, name: str, row: Mapping, rows: pd.DataFrame) -> None:
        """Put rows, with what `row` says of all, in place of those of the same names, after all others; write them."""
        rows, earlier = rows.assign(**row), self.tables[name]
        if earlier is not None:
            old, new = (table.set_index(list(self.keys[name])).index for table in (earlier, rows))
            rows = pd.concat([earlier[~old.isin(new)], rows])
        self.tables[name] = rows
        for summary, (table, summarise) in self.summaries.items():  # first, lest a kill part them
            if table == name:
                self._write(summary, summarise(rows), name)
        self._write(name, rows, name)

    def _write(self, name: str, rows: pd.DataFrame, source: str) -> None:
        """Write a table; its record names the weights of the table that it was made from, itself or another."""
        digests = {}
        if "weights" in self.tables[source]:
            by = "model" if "model" in self.tables[source] and "run" not in self.keys[source] else self.keys[source][0]
            used = self.tables[source].groupby(by, sort=False)["weights"].unique()
            digests = used.map(list).to_dict()
        write_table(self.path(name), rows, self.record | {"weights_digests": digests})

    def measure(self, todo: Iterable[Mapping], measure: Callable[[Mapping], Mapping[str, pd.DataFrame]]) -> Path:
        """Measure what has no rows yet, keep each as soon as it is measured; return the table, or its summary.

        Args:
          todo: what names each measurement, column -> value, with the digest of its weights where
            it has some.
          measure: function of one of them; returns table -> rows, to which the columns are added.
        """
        into = next(iter(self.keys))  # says whether it was measured
        todo = [row for row in todo if not self.has(into, row)]
        for number, row in enumerate(todo, 1):
            named = ", ".join(str(row[key]) for key in self.keys[into])
            log.info("%s, %d of %d: %s", into, number, len(todo), named)
            made = measure(row)
            for name in sorted(made, key=lambda name: name == into):  # what says that it was measured comes last
                self.put(name, row, made[name])
        return self.path(next(iter(self.summaries), into))
