"""Tables as Markdown, with units.

A tidy table has one number a row: columns that say what it is about (model, steps, ...), then
`metric`, `unit`, `better` and `value`.
"""

from __future__ import annotations

import re
from collections.abc import Mapping

import pandas as pd

ARROWS = {"down": " ↓", "up": " ↑"}


def fill_tables(page: str, tables: Mapping[str, str], where: str) -> str:
    """Return a page with tables made anew, each between `<!-- NAME: begin -->` and `<!-- NAME: end -->`.

    Args:
      page: its text.
      tables: name -> Markdown.
      where: the page's name, for messages.

    Raises:
      ValueError: if a table has no place in it, or two.
    """
    for name, table in tables.items():
        place = rf"(<!-- {name}: begin -->\n).*?(<!-- {name}: end -->)"
        page, count = re.subn(place, lambda found, table=table: f"{found[1]}\n{table}\n{found[2]}", page, flags=re.S)
        if count != 1:
            raise ValueError(f"{where}: no `<!-- {name}: begin -->` and `end` around a table, or two of them")
    return page


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
    columns = []
    for title, values in frame.items():
        cells, heading = [_cell(value, digits) for value in values], _escape(str(title))
        width = max(map(len, ["---", heading, *cells]))
        numbers = pd.to_numeric([cell for cell in cells if cell != "–"], errors="coerce")
        flush = bool(cells) and pd.notna(numbers).all()
        rule = "-" * (width - 1) + ":" if flush else "-" * width
        columns.append([cell.rjust(width) if flush else cell.ljust(width) for cell in (heading, rule, *cells)])
    return "".join(f"| {' | '.join(line)} |\n" for line in zip(*columns, strict=True))


def compact_table(frame: pd.DataFrame) -> str:
    """Render a table as `markdown_table` does, without columns of blanks, so that a changed cell is a changed line."""
    return re.sub(r" {2,}", " ", re.sub(r"-{4,}", "---", markdown_table(frame)))


def metric_heading(metric: str, unit: str = "", better: str = "") -> str:
    """Return a column heading such as "trajectory error (m) ↓"; other ways than "down" and "up" have no arrow."""
    heading = str(metric).replace("_", " ")
    if isinstance(unit, str) and unit:
        heading += f" ({unit})"
    return heading + ARROWS.get(better, "")


def _cell(value, digits: int) -> str:
    if value is None or value == "" or value != value:  # no number equals itself but NaN
        return "–"
    if not isinstance(value, float):
        return _escape(str(value))
    if value and not 1e-3 <= abs(value) < 1e6:
        return f"{value:.{max(digits - 1, 0)}e}"
    return f"{value:.{max(0, min(digits, digits + 1 - len(str(int(abs(value))))))}f}"


def _escape(text: str) -> str:
    return text.replace("|", "\\|").replace("\n", " ")
