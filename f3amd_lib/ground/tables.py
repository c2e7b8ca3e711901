"""Tidy tables as Markdown, with units, and ours beside the paper's.

A tidy table has one number a row: columns that say what it is about (model, steps, ...), then
`metric`, `unit`, `better` and `value`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import pandas as pd

from f3amd_lib.ground.profiles import repository_root
from f3amd_lib.ground.records import read_table

_ARROWS = {"down": " ↓", "up": " ↑"}


def markdown_table(frame: pd.DataFrame, *, digits: int = 3) -> str:
    """Render a DataFrame as a GitHub Markdown table.

    Args:
      frame: any table; the index is left out. Text is kept as it is, so printed numbers keep
        their trailing zeros.
      digits: decimals of floats; larger figures get fewer, so that four digits are shown.

    Returns:
      Text that ends in a line break; numbers are right-aligned, an undefined value is a dash.

    Raises:
      ValueError: for a table without columns.
    """
    if len(frame.columns) == 0:
        raise ValueError("a table needs at least one column")
    header = [_escape(str(column)) for column in frame.columns]
    rows = [[_cell(value, digits) for value in row] for row in frame.itertuples(index=False, name=None)]
    right = [bool(rows) and all(_looks_numeric(row[column]) for row in rows) for column in range(len(header))]
    widths = [max([3, len(header[column]), *(len(row[column]) for row in rows)]) for column in range(len(header))]

    def line(cells: Sequence[str]) -> str:
        padded = [
            cell.rjust(width) if flush else cell.ljust(width)
            for cell, width, flush in zip(cells, widths, right, strict=True)
        ]
        return f"| {' | '.join(padded)} |"

    rule = ["-" * (width - 1) + ":" if flush else "-" * width for width, flush in zip(widths, right, strict=True)]
    return "\n".join([line(header), line(rule), *(line(row) for row in rows)]) + "\n"


def metric_heading(metric: str, unit: str = "", better: str = "") -> str:
    """Return a column heading such as "trajectory error (m) ↓".

    Args:
      metric: name, underscores for blanks.
      unit: "" for none.
      better: "down" or "up" give an arrow, anything else none.
    """
    heading = str(metric).replace("_", " ")
    if isinstance(unit, str) and unit:
        heading += f" ({unit})"
    return heading + _ARROWS.get(better, "")


def wide_table(tidy: pd.DataFrame, index: Sequence[str] = ("model",), *, value: str = "value") -> pd.DataFrame:
    """Spread a tidy table: one row for each combination of `index`, one column a metric.

    Args:
      tidy: columns `index`, metric, value and, if there, unit and better.
      index: the columns that name a row.
      value: the column to show ("printed" keeps the paper's own text).

    Returns:
      A DataFrame with the index as columns, then metrics under `metric_heading`; rows and metrics
      in the order in which they first appear.

    Raises:
      ValueError: for a missing column, or two values for one cell.
    """
    index = list(index)
    for column in [*index, "metric", value]:
        if column not in tidy:
            raise ValueError(f"the table has no column {column!r}; it has {', '.join(map(str, tidy.columns))}")
    units = tidy["unit"] if "unit" in tidy else pd.Series("", index=tidy.index)
    better = tidy["better"] if "better" in tidy else pd.Series("", index=tidy.index)
    rows: dict[tuple, dict] = {}
    for key, metric, unit, way, number in zip(
        tidy[index].itertuples(index=False, name=None), tidy["metric"], units, better, tidy[value], strict=True
    ):
        row = rows.setdefault(key, dict(zip(index, key, strict=True)))
        heading = metric_heading(metric, unit, way)
        if heading in row:
            raise ValueError(
                f"two values of {heading!r} for {dict(zip(index, key, strict=True))}; name more columns in index"
            )
        row[heading] = number
    return pd.DataFrame(list(rows.values()))


def beside_paper(
    ours: pd.DataFrame,
    paper: pd.DataFrame,
    index: Sequence[str] = ("model", "window_frames", "steps"),
    *,
    ours_label: str,
    paper_label: str | None = None,
    digits: int = 3,
) -> str:
    """Render our numbers beside the paper's, each line saying whose it is.

    Args:
      ours: tidy table of ours.
      paper: from `papers.load_paper_table`.
      index: the columns that name a row; both tables have them.
      ours_label: what ours were measured on, such as "ours (synthetic, laptop, 2 CPU cores)".
      paper_label: by default the paper's setting.
      digits: decimals of ours.

    Returns:
      Markdown: for each row of ours the paper's line (if it has one) and then ours. Metrics that
      only one side has are shown, with a dash on the other; rows only of the paper are left out.

    Raises:
      ValueError: for an empty label, a missing column, or units that do not agree.
    """
    paper_label = paper_label or paper.attrs.get("setting", "paper")
    if not ours_label or ours_label == paper_label:
        raise ValueError("ours_label must say what ours were measured on, unlike the paper's label")
    index = list(index)
    for column in index:
        if column not in ours or column not in paper:
            raise ValueError(f"column {column!r} must be in both tables")
    keys = list(dict.fromkeys(ours[index].itertuples(index=False, name=None)))
    wanted = set(keys)
    kept = paper[[key in wanted for key in paper[index].itertuples(index=False, name=None)]]
    ways = dict(zip(paper["metric"], paper["better"], strict=True))
    units = dict(zip(paper["metric"], paper["unit"], strict=True))
    ours = ours.copy()
    if "unit" in ours:
        for metric, unit in zip(ours["metric"], ours["unit"].fillna(""), strict=True):
            if units.get(metric, unit) != unit:
                raise ValueError(
                    f"{metric} is in {unit or 'no unit'} here and in {units[metric] or 'no unit'} in the paper"
                )
    else:
        ours["unit"] = [units.get(metric, "") for metric in ours["metric"]]
    # One heading a metric: where the paper has an arrow, its arrow stands for both.
    own = ours["better"] if "better" in ours else [""] * len(ours)
    ours["better"] = [ways.get(metric, way) for metric, way in zip(ours["metric"], own, strict=True)]
    printed = wide_table(kept, index, value="printed") if len(kept) else pd.DataFrame()
    measured = wide_table(ours, index)
    lines = []
    for key in keys:
        for label, table in ((paper_label, printed), (ours_label, measured)):
            for row in table.to_dict("records"):
                if tuple(row[column] for column in index) == key:
                    names = {column: row.pop(column) for column in index}
                    lines.append(names | {"source": label} | row)
    return markdown_table(pd.DataFrame(lines), digits=digits)


def _cell(value, digits: int) -> str:
    if value is None or (isinstance(value, float) and math.isnan(value)) or value == "":
        return "–"
    if isinstance(value, bool) or not isinstance(value, float):
        return _escape(str(value))
    if math.isinf(value):
        return str(value)
    if value and not 1e-3 <= abs(value) < 1e6:
        return f"{value:.{max(digits - 1, 0)}e}"
    whole = len(str(int(abs(value)))) if abs(value) >= 1 else 1
    return f"{value:.{max(0, min(digits, digits + 1 - whole))}f}"


def _looks_numeric(cell: str) -> bool:
    if cell == "–":
        return True
    try:
        float(cell)
    except ValueError:
        return False
    return True


def _escape(text: str) -> str:
    return text.replace("|", "\\|").replace("\n", " ")


def stored_result(dataset: str, name: str, *, profile: str = "laptop", digits: int = 2) -> str:
    """Render a table that `make figures` left, with what it was measured on.

    Args:
      dataset: a name of `profiles.DATASETS`.
      name: of the table, without ending.
      profile: whose results.
      digits: decimals.

    Returns:
      Markdown: the table and a line on its origin, or a sentence that there is none yet.
    """
    path = repository_root() / "paper_figures" / dataset / profile / "tables" / f"{name}.csv"
    if not path.exists():
        return f"No stored `{name}` of `{profile}` on `{dataset}` yet: `make figures` makes it."
    frame, record = read_table(path)
    origin = (
        f"Stored result: `{name}`, profile {record['profile']}, data {record['dataset']}, "
        f"{record['cores']} cores ({record['device_platform']}), {record['date_utc'][:10]}."
    )
    return f"{origin}\n\n{markdown_table(frame, digits=digits)}"
