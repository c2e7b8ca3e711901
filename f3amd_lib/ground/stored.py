"""Committed tables, for notebooks that draw what they do not measure themselves."""

import pandas as pd

from f3amd_lib.ground.names import counted_cores
from f3amd_lib.ground.profiles import repository_root
from f3amd_lib.ground.records import folder_reason, read_table


def machine_of(record: dict) -> str:
    """Return on what a record was made, and when: "2 cores (cpu), 2026-11-28."."""
    return f"{counted_cores(record)} ({record['device_platform']}), {record['date_utc'][:10]}."


def committed_table(dataset: str, name: str, *, profile="laptop", kind="records") -> tuple[pd.DataFrame, dict] | None:
    """Read a table that `make measure` left under `paper_figures/`.

    Args:
      dataset: a name of `profiles.DATASETS`.
      name: of the table, without ending.
      profile: whose results.
      kind: "records", or "tables" for those that `make figures` left.

    Returns:
      (table, record), or None if nothing is committed for this data set. `table.attrs["stale"]`
      says why it does not belong with the quality table beside it, "" if it does.

    Raises:
      ValueError: if the table is not the one that its record describes.
    """
    path = repository_root() / "paper_figures" / dataset / profile / kind / f"{name}.csv"
    if not path.exists():
        return None
    table, record = read_table(path)
    table.attrs["stale"] = folder_reason(path, record)
    return table, record
