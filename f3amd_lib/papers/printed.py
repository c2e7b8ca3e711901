"""What the papers print, in the form of our records: tidy tables of `SCHEMAS`, models by their presets' names."""

from pathlib import Path

import numpy as np
import pandas as pd

from f3amd_lib.ground.files import read_toml
from f3amd_lib.ground.papers import load_paper_file, load_paper_table
from f3amd_lib.networks import presets

SCHEMAS: dict[str, list[str]] = read_toml(Path(__file__).with_name("schemas.toml"))
"""Tables that claims are judged by -> columns that name a row. Each also has `value` (in the last two
a column of another name) and, where it was repeated, `low` and `high`."""

PUBLISHED_CAMDM = "CAMDM published"
"""Row of the network with the weights that CAMDM's authors published: no preset of ours."""


def printed_tables(paper: str = "f3amd") -> dict[str, pd.DataFrame]:
    """Return a paper's own tables by the names of ours, with intervals where it prints some.

    Raises:
      KeyError: for a table of no known form, or one that lacks a column of its form.
    """
    about = load_paper_file("paper", paper)
    others = about.get("others", ())
    parts: dict[str, list[pd.DataFrame]] = {}
    for entry in about.get("table", ()):
        printed = load_paper_table(entry["number"], paper)
        labels, known = printed["model"], entry.get("models", {}) | {name: name for name in others}
        names = {label: known.get(label) or presets.find_preset(label).name for label in labels.unique()}
        framework = np.where(labels.str.contains("PyTorch"), "torch", "iree")
        half = pd.to_numeric(printed["ci95"], errors="coerce") if "ci95" in printed else np.nan
        bounds = {"low": printed["value"] - half, "high": printed["value"] + half}
        printed = printed.assign(model=labels.map(names), framework=framework, **bounds, **entry.get("columns", {}))
        name = printed["metric"].str.extract(r"^(synthesis_time|training_time)", expand=False).fillna("quality")
        printed["metric"] = printed["metric"].replace(about.get("metrics", {}))
        for which, rows in [(entry["record"], printed)] if "record" in entry else printed.groupby(name):
            parts.setdefault(which, []).append(rows)
    tables = {}
    for name, some in parts.items():
        # A row that several tables print is one row.
        rows = pd.concat(some)[[*SCHEMAS[name], "unit", "value", "low", "high"]]
        tables[name] = rows.dropna(subset="value").drop_duplicates([*SCHEMAS[name], "value"])
    return tables
