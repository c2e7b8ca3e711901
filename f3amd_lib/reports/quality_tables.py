"""The paper's tables of motion quality with our figures under each row.

Our figures come from `records/quality.csv` (see `experiments.protocol`): means over seeds with 95 %
intervals. Real motion and the deliberately bad generators, which the paper does not have, stand on
top, since no other row says what a figure is worth. Functions of tables only: nothing is read from
disk but the paper's numbers.
"""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np
import pandas as pd

from f3amd_lib.ground.papers import PAPER_TABLES, load_paper_table
from f3amd_lib.ground.tables import markdown_table
from f3amd_lib.networks import presets

QUALITY_TABLES = (3, 5, 6, 8, 9, 10, 11, 12)
"""The paper's tables of motion quality, by number."""

PAPER_SOURCE = "paper, 100STYLE"
NOT_MEASURED = "not measured"

FIGURES = {
    "FID": "FID",
    "EMD": "EMD",
    "style_coverage": "Style (%)",
    "trajectory_error": "Traj. (m)",
    "direction_error": "Dir. (°)",
    "smoothness": "Smooth",
    "foot_sliding": "Foot",
    "diversity": "Diversity (cm)",
    "IRD": "IRD (cm)",
}
"""The nine figures of the paper's quality tables in its order, with its headings."""

NOTE = (
    "FID and EMD: data, classifier and number of windows are not the paper's, so that absolute "
    "values do not compare. Arrows are the paper's; the real row says what can be had."
)
"""What a reader of every such table must know."""

_EXTRA_NOTES = {
    6: "CAMDM-code is the network of the released code, trained here; the weights that its authors "
    "published were not run.",
    11: "The paper's column of times is left out.",
}

_ARROWS = {"down": " ↓", "up": " ↑"}
_KEYS = ["model", "window_frames", "steps", "metric"]


def figure_text(value: float, low: float = np.nan, high: float = np.nan) -> str:
    """Write a mean with its interval: "7.386 ± 0.121", three decimals or four digits.

    Args:
      value: the mean; NaN gives a dash.
      low, high: 95 % interval, symmetric about the mean as Student's t gives it; NaN (a single
        repeat) leaves it out.

    Raises:
      ValueError: for an interval that does not hold its mean in the middle.
    """
    if np.isnan(value):
        return "–"
    decimals = max(0, 3 - int(np.log10(max(abs(value), 1.0))))
    text = f"{value:.{decimals}f}"
    if np.isnan(low) or np.isnan(high):
        return text
    half = 0.5 * (high - low)
    if half < 0 or not np.isclose(value - low, half, rtol=1e-3, atol=1e-9):
        raise ValueError(f"{value} is not in the middle of its interval, {low} to {high}")
    return f"{text} ± {half:.{decimals}f}"


def _checked(quality: pd.DataFrame, dataset_label: str) -> pd.DataFrame:
    """Return our figures of the nine metrics, or say what is wrong with them."""
    if not dataset_label or dataset_label == PAPER_SOURCE:
        raise ValueError(
            f"dataset_label must say what ours were measured on, unlike the paper's label {PAPER_SOURCE!r}"
        )
    for column in (*_KEYS, "unit", "value", "low", "high"):
        if column not in quality:
            raise ValueError(f"the quality table has no column {column!r}; `protocol.summarise` makes it")
    ours = quality[quality["metric"].isin(FIGURES)]
    twice = ours[ours.duplicated(_KEYS)]
    if len(twice):
        named = ", ".join(str(twice.iloc[0][key]) for key in _KEYS)
        raise ValueError(f"the quality table has two rows of {named}")
    return ours


def beside_paper(table: int, quality: pd.DataFrame, dataset_label: str) -> pd.DataFrame:
    """Set our figures under each row of a quality table of the paper.

    Args:
      table: its number, one of `QUALITY_TABLES`.
      quality: from `protocol.summarise`: model (presets, "real", bad generators with steps 0),
        window_frames, steps, metric, unit, value, low, high.
      dataset_label: what ours were measured on, such as "bandai, laptop".

    Returns:
      Tidy rows: line (0, 1, ... down the page), model (the paper's name in its rows, our preset's
      in ours), window_frames, steps (0 for motion that no network made), source, metric, unit,
      better (the paper's), printed (text: the paper's own, or ours as `figure_text`; "not
      measured" where our table has no such row, "" where the paper prints a dash or ours has no
      such metric), value, low, high. Nine rows a line.

    Raises:
      ValueError: for a table that has no quality, an empty label or the paper's, a missing column,
        a figure that is there twice, or a unit that is not the paper's.

    Source: F3AMD paper, Tables 3, 5, 6, 8 to 12; what a paper's name means is `presets.find_preset`'s.
    """
    if table not in QUALITY_TABLES:
        known = ", ".join(map(str, QUALITY_TABLES))
        raise ValueError(f"the paper's quality tables are {known}, not {table!r}")
    ours = _checked(quality, dataset_label)
    paper = load_paper_table(table)
    paper = paper[paper["metric"].isin(FIGURES)]
    units = {row.metric: (row.unit, row.better) for row in paper.itertuples()}
    for metric, unit in zip(ours["metric"], ours["unit"].fillna(""), strict=True):
        if unit != units[metric][0]:
            raise ValueError(
                f"{metric} is in {unit or 'no unit'} here and in {units[metric][0] or 'no unit'} in the paper"
            )
    found = {tuple(row[:4]): row[4:] for row in ours[[*_KEYS, "value", "low", "high"]].to_numpy()}
    measured = {key[:3] for key in found}
    lines: list[list[dict]] = []

    def line(model: str, frames: int, steps: int, source: str, cells: Iterable[tuple]) -> None:
        named = {"line": len(lines), "model": model, "window_frames": frames, "steps": steps}
        rows = []
        for metric, (printed, value, low, high) in zip(FIGURES, cells, strict=True):
            unit, better = units[metric]
            figure = {"printed": printed, "value": value, "low": low, "high": high}
            rows.append({**named, "source": source, "metric": metric, "unit": unit, "better": better} | figure)
        lines.append(rows)

    def our_line(model: str, frames: int, steps: int) -> None:
        cells = []
        for metric in FIGURES:
            if (model, frames, steps) not in measured:
                cells.append((NOT_MEASURED, np.nan, np.nan, np.nan))
                continue
            value, low, high = found.get((model, frames, steps, metric), [np.nan] * 3)
            text = "" if np.isnan(value) else figure_text(value, low, high)
            cells.append((text, value, low, high))
        line(model, frames, steps, dataset_label, cells)

    for frames in paper["window_frames"].unique():
        unmade = ours[(ours["steps"] == 0) & (ours["window_frames"] == frames)]
        for model in dict.fromkeys(["real", *unmade["model"]]):
            our_line(model, int(frames), 0)
    for (model, frames, steps), rows in paper.groupby(_KEYS[:3], sort=False):
        rows = rows.set_index("metric").loc[list(FIGURES)]
        cells = [(row.printed, row.value, np.nan, np.nan) for row in rows.itertuples()]
        line(model, int(frames), int(steps), PAPER_SOURCE, cells)
        our_line(presets.find_preset(model).name, int(frames), int(steps))
    return pd.DataFrame([row for rows in lines for row in rows])


def wide_rows(rows: pd.DataFrame) -> pd.DataFrame:
    """Spread `beside_paper` to a line a system, fit for the page.

    A row of the paper that we have not measured says so in its own line, in place of an empty one
    below. Frames and steps are columns only where they differ.

    Args:
      rows: from `beside_paper`.

    Returns:
      Columns model, frames and steps where needed, source, and the nine figures; all text.
    """
    made = rows[rows["steps"] > 0]
    varied = [
        (column, heading)
        for column, heading in (("window_frames", "frames"), ("steps", "steps"))
        if made[column].nunique() > 1
    ]
    arrows = dict(zip(rows["metric"], rows["better"].map(_ARROWS), strict=True))
    lines: list[dict] = []
    for _, cells in rows.groupby("line", sort=False):
        first = cells.iloc[0]
        missing = (cells["printed"] == NOT_MEASURED).all()
        if missing and first["steps"] > 0:
            lines[-1]["source"] += f"; ours {NOT_MEASURED}"
            continue
        shown = {"model": first["model"]}
        for column, heading in varied:
            shown[heading] = str(first[column]) if first[column] else ""
        shown["source"] = first["source"] + (f": {NOT_MEASURED}" if missing else "")
        for metric, text in zip(cells["metric"], cells["printed"], strict=True):
            shown[FIGURES[metric] + arrows[metric]] = "" if missing else text
        lines.append(shown)
    return pd.DataFrame(lines)


def quality_markdown(table: int, quality: pd.DataFrame, dataset_label: str) -> str:
    """Render a quality table of the paper with ours under each row.

    Args:
      table, quality, dataset_label: as for `beside_paper`.

    Returns:
      Markdown: a title, the table, and the note without which it would mislead.

    Raises:
      ValueError: as `beside_paper`.
    """
    rows = beside_paper(table, quality, dataset_label)
    frames = rows.loc[rows["steps"] > 0, "window_frames"].unique()
    title = f"**Table {table}.** {PAPER_TABLES[table][1]}"
    title += f", windows of {frames[0]} frames." if len(frames) == 1 else "."
    note = " ".join([NOTE, *([_EXTRA_NOTES[table]] if table in _EXTRA_NOTES else [])])
    return f"{title}\n\n{markdown_table(wide_rows(rows))}\n*{note}*\n"


README_ROWS = {
    "FID": ("FID", 1),
    "EMD": ("EMD", 1),
    "style_coverage": ("style coverage (%)", 0),
    "trajectory_error": ("Traj. (m)", 3),
    "direction_error": ("Dir. (°)", 1),
    "smoothness": ("Smooth", 2),
    "foot_sliding": ("Foot", 2),
    "contact_share": ("contact share", 2),
    "diversity": ("Diversity (cm)", 2),
    "IRD": ("IRD (cm)", 1),
    "IRD_excess": ("IRD excess (cm)", 1),
    "joint_acceleration": ("joint acceleration (cm/frame²)", 2),
    "foot_alternation": ("changes of the resting foot (1/s)", 2),
    "stepping_rate": ("steps by toe height (1/s)", 2),
    "slide_speed": ("slide of the lower toe (cm/s)", 0),
    "sliding_share": ("share of frames that slide over 30 cm/s", 2),
    "seam_kick": ("kick at the seams", 1),
    "x0_error_ratio": ("x0 error, low over high noise", 2),
}
"""Metrics of README's table, with their headings and decimals."""

README_COLUMNS = {
    ("real", 0): "real",
    ("frozen pose", 0): "frozen pose",
    ("CAMDM", 8): "`CAMDM`, 8 steps",
    ("F3AMD-FNO-96", 8): "`F3AMD-FNO-96`, 8 steps",
    ("F3AMD-FNO-96", 1): "1 step",
    ("F3AMD-FNO-96-plus", 8): "`-plus`, 8 steps",
    ("F3AMD-FNO-96-plus", 1): "1 step ",
}
"""Model and steps of README's columns, with their headings."""


def readme_table(quality: pd.DataFrame, window: int = 32) -> str:
    """Render README's table of what was measured on real motion, our own figures alone.

    Args:
      quality: from `protocol.summarise`.
      window: of the models, frames.

    Returns:
      Markdown: means with 95 % intervals; a figure that a column does not have is a dash.
    """
    own = quality[quality["window_frames"] == window].set_index(["model", "steps", "metric"])
    rows = []
    for metric, (heading, decimals) in README_ROWS.items():
        row = {"": heading}
        for (model, steps), title in README_COLUMNS.items():
            row[title] = "–"
            if (model, steps, metric) in own.index:
                value, low, high = own.loc[(model, steps, metric), ["value", "low", "high"]]
                row[title] = f"{value:.{decimals}f}"
                if not math.isnan(high - low):  # one clip, or one seed, has no interval
                    row[title] += f" ± {0.5 * (high - low):.{decimals}f}"
        rows.append(row)
    return markdown_table(pd.DataFrame(rows))
