"""Committed tables, for pictures of what a notebook does not measure itself."""

from __future__ import annotations

import pandas as pd

from f3amd_lib.ground.profiles import repository_root
from f3amd_lib.ground.records import read_table


def committed_table(dataset: str, name: str, *, profile: str = "laptop") -> tuple[pd.DataFrame, dict] | None:
    """Read a table that `make measure` left under `paper_figures/`.

    Args:
      dataset: a name of `profiles.DATASETS`.
      name: of the table, without ending.
      profile: whose results.

    Returns:
      (table, record), or None if nothing is committed for this data set.

    Raises:
      ValueError: if the table is not the one that its record describes.
    """
    folder = repository_root() / "paper_figures" / dataset / profile / "records"
    path = folder / f"{name}.csv"
    return read_table(path) if path.exists() else None
