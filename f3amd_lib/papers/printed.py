"""What the papers print, in the form of our records: tidy tables of `SCHEMAS`, models by their presets' names."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from f3amd_lib.ground.files import read_toml
from f3amd_lib.ground.names import nearest_hint
from f3amd_lib.ground.papers import find_entry, load_paper_file, load_paper_table
from f3amd_lib.measures.walking import CHECKS
from f3amd_lib.networks import presets

SCHEMAS: dict[str, list[str]] = read_toml(Path(__file__).with_name("schemas.toml"))
"""Tables that claims are judged by -> columns that name a row. Each also has `value` (in the last two
a column of another name) and, where it was repeated, `low` and `high`."""

TIMES = ("synthesis_time", "training_time")
"""Those of them that hang on the device."""

_VALUES = {"x0_by_sigma": "x0_error"}

NINE_METRICS = {
    row.metric: (row.unit, row.better)
    for row in load_paper_table(3).drop_duplicates("metric")[["metric", "unit", "better"]].itertuples(index=False)
}
"""The metrics of Table 3, in its order -> (unit, "up" or "down")."""

OF_TEXT = tuple(name for name in SCHEMAS if name.startswith("text_"))
"""Tables of text to motion. Each row also names `trained`, the model that was (a smaller one of ours may stand in for
the paper's), and `windows`, the motions that it was trained on."""

PUBLISHED_CAMDM = "CAMDM published"
"""Row of the network with the weights that CAMDM's authors published: no preset of ours."""

REFERENCE_ROWS = ("real", "frozen pose", "shuffled frames", "noisy motion", PUBLISHED_CAMDM, "CAMDM, leading")
"""Names in the model column that are no presets."""


def _with_interval_of_median(table: pd.DataFrame) -> pd.DataFrame:
    """Put the interval of the median of timed rounds in the place of their spread.

    Records have it as `median_low` and `median_high`. Older ones have the 5 and 95 % quantiles of the
    rounds and their number alone: as for a normal distribution, on either side of its own, the median
    reaches 1.96 sqrt(pi / 2) / sqrt(rounds) deviations, and those quantiles 1.645.
    """
    if "rounds" not in table:
        return table
    reach = 1.96 / 1.645 * np.sqrt(np.pi / 2.0 / table["rounds"])
    bounds = {bound: table["value"] + reach * (table[bound] - table["value"]) for bound in ("low", "high")}
    known = {bound: table.get(f"median_{bound}", about).fillna(about) for bound, about in bounds.items()}
    return table.assign(**known)


def checked_table(name: str, table: pd.DataFrame, where: str, others: Sequence[str] = ()) -> pd.DataFrame:
    """Return a table in the form of `SCHEMAS`, undefined figures left out; ValueError if broken.

    `others` are models that are no presets.
    """
    keys = SCHEMAS[name]
    table = table.rename(columns={_VALUES.get(name, "value"): "value"})
    if name == "walking" and set(keys) - set(table) == {"metric"}:  # a row per style and seed, its figures side by side
        means = table.groupby(keys[:-1])[[check for check in CHECKS if check in table]].mean()
        table = means.melt(var_name="metric", ignore_index=False).reset_index()
    if name in TIMES:
        table = _with_interval_of_median(table)
    for needed in (*keys, "value"):
        if needed not in table:
            raise ValueError(f"{where}: needs a column {needed!r}, it has {', '.join(map(str, table.columns))}")
    undefined = {bound: float("nan") for bound in ("low", "high") if bound not in table}  # nothing was repeated
    table = table[table["value"].notna()].assign(**undefined)
    astray = ~np.isfinite(table["value"]) | (table["low"] > table["value"]) | (table["high"] < table["value"])
    faults = {
        "a figure that is infinite or outside its interval": astray,
        "two rows": table.duplicated([*keys, *{"seed", "length"} & {*table}]),
    }
    if name == "quality" and "unit" in table:
        wanted = table["metric"].map({metric: unit for metric, (unit, _) in NINE_METRICS.items()})
        unlike = wanted.notna() & (table["unit"].astype(object).fillna("") != wanted)
        faults["another unit than the paper"] = unlike
    for fault, rows in faults.items():
        if rows.any():
            raise ValueError(f"{where}: has {fault} of {', '.join(map(str, table.loc[rows, keys].iloc[0]))}")
    for model in table["model"].unique() if "model" in table else ():
        if model not in others:
            check_model(model, where)
    if "device" in table and not set(table["device"]) <= {"CPU", "GPU"}:
        raise ValueError(f"{where}: device must be CPU or GPU, got {table['device'].unique()}")
    return table


def check_model(model: str, where: str) -> None:
    """Raise ValueError for a name that is neither a preset's own nor one of `REFERENCE_ROWS`."""
    try:
        known = model in REFERENCE_ROWS or presets.find_preset(model).name == model
    except ValueError:
        known = False
    if not known:
        raise ValueError(f"{where}: unknown model {model!r}{nearest_hint(model, [*presets.PRESETS, *REFERENCE_ROWS])}")


def printed_tables(paper: str = "f3amd") -> dict[str, pd.DataFrame]:
    """Return a paper's own tables by the names of ours, with intervals where it prints some.

    Raises:
      ValueError: if two tables print different figures of one row, or one is of no known form.
    """
    about = load_paper_file("paper", paper)
    others = about.get("others", ())
    parts: dict[str, list[pd.DataFrame]] = {}
    for entry in about.get("table", ()):
        printed = load_paper_table(entry["number"], paper)
        labels, known = printed["model"], entry.get("models", {}) | {name: name for name in others}
        names = {label: known.get(label) or presets.find_preset(label).name for label in labels.unique()}
        framework = np.where(labels.str.contains("PyTorch"), "torch", "iree")
        printed = printed.assign(model=labels.map(names), framework=framework, **entry.get("columns", {}))
        if "ci95" in printed:
            half = pd.to_numeric(printed["ci95"], errors="coerce")
            printed = printed.assign(low=printed["value"] - half, high=printed["value"] + half)
        name = printed["metric"].str.extract(r"^(synthesis_time|training_time)", expand=False).fillna("quality")
        printed["metric"] = printed["metric"].replace(about.get("metrics", {}))
        for which, rows in [(entry["record"], printed)] if "record" in entry else printed.groupby(name):
            where = f"{paper}/paper.toml: table {entry['number']}"
            columns = [*find_entry(SCHEMAS, which, "record", where), "unit"]
            if missing := [column for column in columns if column not in rows]:
                raise ValueError(f"{where}: {entry['file']} has no {', '.join(missing)}, as rows of {which!r} have")
            parts.setdefault(which, []).append(rows)
    tables = {}
    for name, some in parts.items():
        # A row that several tables print is one row.
        rows = pd.concat(some)
        rows = rows[[*SCHEMAS[name], "unit", "value", *(bound for bound in ("low", "high") if bound in rows)]]
        rows = rows.drop_duplicates([*SCHEMAS[name], "value"])
        tables[name] = checked_table(name, rows, f"the paper's {name}", others)
    return tables
