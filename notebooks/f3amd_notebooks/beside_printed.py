"""A paper's table with ours beside it, and what to know before comparing them."""

from collections.abc import Sequence

import pandas as pd
from f3amd_lib.ground.papers import has_paper_file, load_paper_file, paper_folders
from f3amd_lib.ground.profiles import runs_dir
from f3amd_lib.ground.records import read_table
from f3amd_lib.ground.stored import committed_table, measured_table
from f3amd_lib.ground.tables import ARROWS, markdown_table
from f3amd_lib.measures.registry import METRICS
from f3amd_lib.papers.printed import SCHEMAS, printed_tables


def beside_printed(paper: str, name: str, metrics: Sequence[str]) -> tuple[pd.DataFrame, str]:
    """Return a paper's table with ours of Bandai beside it, and a sentence that says where ours comes from.

    Args:
      paper: a folder of `papers/`.
      name: of the table of ours, such as "text_tableA5".
      metrics: which of its metrics, by our names.

    Returns:
      (a row for each row of either, sentence). Columns are those that tell rows apart, then "paper: FID" and so on,
      with 95 % intervals, then "ours: FID", and "our network". Without a record the paper's stand alone, and the
      sentence says how to measure ours.
    """
    keys = [key for key in SCHEMAS[name] if key != "metric"]
    stored, sentence = measured_table("bandai", name, name)
    parts, columns = {"paper": printed_tables(paper)[name]}, []
    if stored is not None:
        parts["ours"] = stored
        sentence = f"{sentence} {judge_note(name)}".strip()
    for whose, part in parts.items():
        for metric in metrics:
            rows = part[part["metric"] == metric].set_index(keys)
            heading = METRICS[metric].title + ARROWS.get(METRICS[metric].better, "")
            columns.append(rows.apply(_with_interval, axis=1).rename(f"{whose}: {heading}"))
    if stored is not None:
        columns.append(stored.drop_duplicates(keys).set_index(keys)["trained"].rename("our network"))
    return pd.concat(columns, axis=1).fillna("–").reset_index(), sentence


def _with_interval(row) -> str:
    figures = [f"{row[bound]:.3g}" for bound in ("value", "low", "high")]
    return figures[0] if pd.isna(row["low"]) else "{} ({} to {})".format(*figures)


def judge_note(name: str) -> str:
    """Say which other tables of text to motion were looked at by another judge than a committed one, "" if none was.

    Judges of one recipe differ from training to training, so that their figures are on scales of their own.
    """
    papers = [paper for paper in paper_folders() if has_paper_file("experiments", paper)]
    names = [other for paper in papers for other in load_paper_file("experiments", paper) if other != "settings"]
    tables = {other: committed_table("bandai", other) for other in ("text_judge", *names)}
    judges = {other: found[1]["judge_weights"] for other, found in tables.items() if found}
    others = [f"`{other}`" for other, judge in judges.items() if judge != judges[name]]
    if not others:
        return ""
    return (
        f"The judge of `{name}` (weights {judges[name]}) is another than that of {', '.join(others)}: it was "
        "trained anew. Compare FID, R-precision and their like within one judge's tables alone."
    )


WHOSE = {
    "paper": "the paper's, as printed",
    "ours": "ours, at our scale: small networks, minutes of training",
    "yours": "yours, measured by `f3amd reproduce`",
}
"""What the figures of a table of a text notebook may be."""


def whose_table(paper: str, number: str, *shown: str) -> str:
    """Return a table's caption: which of `WHOSE` its figures are; the reader's own table follows, if there is one.

    Args:
      paper: a folder of `papers/`.
      number: of the paper's table; "" for one that the paper has not.
      shown: keys of `WHOSE`, what the table above the caption has.
    """
    caption = f"\n\n*Figures: {'; beside them '.join(WHOSE[whose] for whose in shown)}.*"
    record = {entry["number"]: entry["record"] for entry in load_paper_file("paper", paper)["table"]}.get(number)
    path = runs_dir("folder", "gpu") / "reproduced" / paper / f"{record}_beside_paper.csv"
    if record is None or not path.is_file():
        return caption
    return f"{caption}\n\n{markdown_table(read_table(path)[0], digits=3)}\n\n*Figures: {WHOSE['yours']}.*"
