"""Tables: those that people write are read here, ours become Markdown, with units.

A tidy table has one number a row: columns that say what it is about (model, steps, ...), then
`metric`, `unit`, `better` and `value`.
"""

import csv
import io
import re
import unicodedata
from pathlib import Path

import numpy as np


def read_text(path) -> str:
    """Read what somebody wrote: UTF-8, with a byte order mark or without, or UTF-16; letters are composed (NFC).

    Raises:
      ValueError: naming a file that is not there, or is no text.
    """
    try:
        content = Path(path).read_bytes()
        text = content.decode("utf-16" if content[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig")
    except OSError as error:
        raise ValueError(f"{path}: no such file, or it cannot be read ({error.strerror}); check the path") from error
    except UnicodeDecodeError as error:
        what = f"byte {error.start} is not {error.encoding.upper()}"
        raise ValueError(f"{path}: not a text file ({what}); save it as UTF-8") from error
    return unicodedata.normalize("NFC", text)


def read_text_table(path, *headers: str, others: bool = False) -> list[tuple[str, dict[str, str]]]:
    """Read a table that somebody wrote by hand or with a spreadsheet: CSV with commas, semicolons or tabs.

    Blank rows, empty cells at the end of a row, the case of headings and how letters are encoded make no difference.
    White space within a cell, a line break too, becomes a blank.

    Args:
      path: of the file.
      headers: those that it may have, such as "x,z"; columns may come in any order.
      others: let it have other columns beside these.

    Returns:
      (place, which begins what is said of a row: file and line; cell by heading) of each row.

    Raises:
      ValueError: naming file and line, for no text, a missing, repeated or unknown column, or a row with more or fewer
        cells than the header.
    """
    text = re.sub(r'\A"?sep=."?[ \t]*$', "", read_text(path), count=1, flags=re.IGNORECASE | re.MULTILINE)
    heading = next(filter(str.strip, text.splitlines()), "")
    delimiter = max(",;\t", key=heading.count)
    reader = csv.reader(io.StringIO(text, newline=""), delimiter=delimiter, skipinitialspace=True, strict=True)
    rows, line = [], 1
    try:
        for row in reader:
            cells = [" ".join(cell.split()) for cell in row]
            rows += [(f"{path}: line {line}:", cells)] if any(cells) else []
            line = reader.line_num + 1
    except csv.Error as error:
        raise ValueError(f"{path}: line {line}: not a row of a table ({error}); fix the line") from error
    where, names = rows[0] if rows else (f"{path}: line 1:", [])
    names = [name.casefold() for name in names]
    while names[-1:] == [""]:
        names.pop()
    known = [set(header.split(",")) for header in headers]
    if len(set(names)) < len(names) or not any(set(names) >= each if others else set(names) == each for each in known):
        what = f"the header must be {' or '.join(headers)}, it is {','.join(names)[:80] or 'empty'}"
        raise ValueError(f"{where} {what}")
    table = []
    for where, cells in rows[1:]:
        cells = cells[: len(names)] + list(filter(None, cells[len(names) :]))
        if len(cells) != len(names):
            hint = f"; put text that holds {delimiter!r} in quotes" if len(cells) > len(names) else ""
            raise ValueError(f"{where} {len(cells)} cells where the header has {len(names)}{hint}")
        table.append((where, dict(zip(names, cells, strict=True))))
    return table


def markdown_table(frame, *, digits: int = 3) -> str:
    """Render a DataFrame as a GitHub Markdown table.

    Args:
      frame: any DataFrame; the index is left out. Text is kept as it is, so printed numbers keep
        their trailing zeros.
      digits: decimals of floats; larger figures get fewer, so that four digits are shown.

    Returns:
      Text that ends in a line break; numbers are right-aligned, an undefined value is a dash.

    Raises:
      ValueError: for a table without columns.
    """
    import pandas as pd  # here: half a second that reading texts does not need

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


def compact_table(frame) -> str:
    """Render a table as `markdown_table` does, without columns of blanks, so that a changed cell is a changed line."""
    return re.sub(r" {2,}", " ", re.sub(r"-{4,}", "---", markdown_table(frame)))


def figure_text(value: float, low: float = np.nan, high: float = np.nan, decimals: int | None = None) -> str:
    """Write a mean with its interval: "7.386 ± 0.121", three decimals or four digits.

    Args:
      value: the mean; NaN gives a dash.
      low, high: 95 % interval, symmetric about the mean as Student's t gives it; NaN (a single
        repeat) leaves it out.
      decimals: so many in place of those.

    Raises:
      ValueError: for an interval that does not hold its mean in the middle.
    """
    if np.isnan(value):
        return "–"
    decimals = max(0, 3 - int(np.log10(max(abs(value), 1.0)))) if decimals is None else decimals
    text = f"{value:.{decimals}f}"
    if np.isnan(low) or np.isnan(high):
        return text
    half = 0.5 * (high - low)
    if half < 0 or not np.isclose(value - low, half, rtol=1e-3, atol=1e-9):
        raise ValueError(f"{value} is not in the middle of its interval, {low} to {high}")
    return f"{text} ± {half:.{decimals}f}"


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
