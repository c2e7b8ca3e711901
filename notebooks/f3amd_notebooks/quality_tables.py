"""The paper's tables of motion quality with our figures under each row.

Our figures come from `records/quality.csv` (see `measures.protocol`): means over seeds with 95 %
intervals. Real motion and the deliberately bad generators, which the paper does not have, stand on
top, since no other row says what a figure is worth. Functions of tables only: nothing is read from
disk but the paper's numbers.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pandas as pd
from f3amd_lib.ground.names import row_label
from f3amd_lib.ground.papers import load_paper_table
from f3amd_lib.ground.records import committed_table
from f3amd_lib.ground.tables import figure_text, markdown_table
from f3amd_lib.measures.distributions import intervals_over_repeats
from f3amd_lib.measures.registry import SHOWN
from f3amd_lib.networks import presets

QUALITY_TABLES = (3, 5, 6, 8, 9, 10, 11, 12)
"""The paper's tables of motion quality, by number."""

ARROWS = {"down": " ↓", "up": " ↑"}

PAPER_SOURCE = "paper, 100STYLE"
NOT_MEASURED = "not measured"

FIGURES = {metric.name: metric.title for metric in SHOWN["paper"]}
"""The nine figures of the paper's quality tables in its order, with its headings."""

NOTE = (
    "FID and EMD: data, classifier and number of windows are not the paper's, so that absolute "
    "values do not compare. Arrows are the paper's; the real row says what can be had."
)
"""What a reader of every such table must know."""


_KEYS = ["model", "window_frames", "steps", "metric"]


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
      ValueError: for a figure that is there twice.

    Source: F3AMD paper, Tables 3, 5, 6, 8 to 12; what a paper's name means is `presets.find_preset`'s.
    """
    paper = load_paper_table(table)
    paper = paper[paper["metric"].isin(FIGURES)]
    about = paper.drop_duplicates("metric").set_index("metric")[["unit", "better"]]
    ours = quality[quality["metric"].isin(FIGURES)]
    lines = []
    for frames in paper["window_frames"].unique():
        unmade = ours[(ours["steps"] == 0) & (ours["window_frames"] == frames)]
        lines += [(model, frames, 0, dataset_label) for model in dict.fromkeys(["real", *unmade["model"]])]
    for model, *setting in paper[_KEYS[:3]].drop_duplicates().itertuples(index=False):
        lines += [(model, *setting, PAPER_SOURCE), (presets.find_preset(model).name, *setting, dataset_label)]
    rows = pd.DataFrame(lines, columns=[*_KEYS[:3], "source"]).rename_axis("line").reset_index()
    rows = rows.merge(about.loc[list(FIGURES)].reset_index(), how="cross")
    values = ["value", "low", "high"]
    ours = ours.assign(source=dataset_label, printed=[figure_text(*each) for each in ours[values].to_numpy(float)])
    known = pd.concat([paper.assign(source=PAPER_SOURCE), ours])[[*_KEYS, "source", "printed", *values]]
    rows = rows.merge(known, how="left", on=[*_KEYS, "source"], validate="many_to_one")
    systems = set(ours[_KEYS[:3]].itertuples(index=False, name=None))
    asked = rows[_KEYS[:3]].itertuples(index=False, name=None)
    gaps = pd.Series("" if system in systems else NOT_MEASURED for system in asked)
    undefined = rows["value"].isna() & (rows["source"] == dataset_label)
    return rows.assign(printed=rows["printed"].mask(undefined, gaps))


def of_queue(campaign: pd.DataFrame, windows: int) -> pd.DataFrame:
    """Return rows of the long queue as `beside_paper` takes them: each network after equally many windows.

    Args:
      campaign: `records/campaign.csv`.
      windows: seen by each network.

    Returns:
      As from `protocol.summarise`, repeats being trainings: a mean over seeds, with an interval where there are two or
      more. FID, EMD and style coverage of a queue that went on elsewhere are through several style classifiers;
      how little that changes on Bandai is in `records/classifiers.csv`.
    """
    kept = (campaign["recipe"] == "paper") & (campaign["windows"] == windows) & campaign["metric"].isin(FIGURES)
    return intervals_over_repeats(campaign[kept].fillna({"unit": ""}), [*_KEYS, "unit"])


def wide_rows(rows: pd.DataFrame) -> pd.DataFrame:
    """Spread `beside_paper` to a line a system, fit for the page.

    A row of the paper that we have not measured says so in its own line, in place of an empty one
    below. Frames and steps are columns only where they differ.

    Args:
      rows: from `beside_paper`.

    Returns:
      Columns model, frames and steps where needed, source, and the nine figures; all text.
    """
    headings = {"window_frames": "frames", "steps": "steps"}
    varied = [column for column in headings if rows.loc[rows["steps"] > 0, column].nunique() > 1]
    rows = rows.assign(figure=rows["metric"].map(FIGURES) + rows["better"].map(ARROWS))
    figures = list(rows["figure"].unique())
    wide = rows.pivot(index=["line", *_KEYS[:3], "source"], columns="figure", values="printed").reset_index()
    missing = (wide[figures] == NOT_MEASURED).all(axis=1)
    ours_missing = missing & (wide["steps"] > 0)
    wide.loc[missing, "source"] += f": {NOT_MEASURED}"
    wide.loc[missing, figures] = ""
    wide.loc[ours_missing.shift(-1, fill_value=False), "source"] += f"; ours {NOT_MEASURED}"
    wide[varied] = wide[varied].astype(str).replace("0", "")
    wide = wide.loc[~ours_missing, ["model", *varied, "source", *figures]]
    return wide.rename(columns=headings).rename_axis(columns=None).reset_index(drop=True)


def quality_markdown(table: int, quality: pd.DataFrame, dataset_label: str) -> str:
    """Render a quality table of the paper with ours under each row.

    Args:
      table, quality, dataset_label: as for `beside_paper`.

    Returns:
      Markdown: a title, the table, and the note without which it would mislead.
    """
    rows = beside_paper(table, quality, dataset_label)
    frames = rows.loc[rows["steps"] > 0, "window_frames"].unique()
    about = load_paper_table(table).attrs
    title = f"**Table {table}.** {about['title']}"
    title += f", windows of {frames[0]} frames." if len(frames) == 1 else "."
    note = f"{NOTE} {about['note']}".strip()
    return f"{title}\n\n{markdown_table(wide_rows(rows))}\n*{note}*\n"


# ------------------------------------------------------- rollouts beside real clips, a column a system


def quality_table(real: pd.DataFrame, measured: Mapping[tuple[str, int], pd.DataFrame]) -> pd.DataFrame:
    """Collect the figures of several systems, real motion first.

    Args:
      real: from `walk_tables.measure_clips`.
      measured: (model, steps) -> what `walk_tables.measure_rollout` returned.

    Returns:
      Tidy rows: label, model, steps (0 for real motion), metric, unit, better, value (mean over
      characters), spread (standard deviation over characters, NaN for one), characters (those with
      a number).
    """
    rows = []
    for (model, steps), figures in {("real", 0): real, **measured}.items():
        label = row_label(model, steps) if steps else "real"
        for metric in SHOWN["first"]:
            values = figures[metric.key].dropna()
            row = {"label": label, "model": model, "steps": steps, "metric": metric.name, "unit": metric.unit}
            row |= {"better": metric.better, "value": values.mean(), "spread": values.std()}
            rows.append(row | {"characters": len(values)})
    return pd.DataFrame(rows)


def paper_rows() -> pd.DataFrame:
    """Return the rows of Table 3 for F3AMD-FNO-96 and CAMDM, 32 frames, with the labels that `side_by_side` wants.

    Returns:
      Tidy rows of the paper's table, with `label` naming paper, model and steps.
    """
    printed = load_paper_table(3)
    kept = printed[printed["model"].isin(["F3AMD-FNO-96", "CAMDM"]) & (printed["window_frames"] == 32)]
    return kept.assign(label=[f"paper, {row_label(*one)}" for one in zip(kept["model"], kept["steps"], strict=True)])


def side_by_side(ours: pd.DataFrame, paper: pd.DataFrame | None = None) -> pd.DataFrame:
    """Spread a tidy table to one row a metric and one column a label, the paper's last.

    Args:
      ours: columns label, metric, unit, better, value.
      paper: from `paper_rows`; metrics that ours lacks are left out.

    Returns:
      A DataFrame: metric (with its unit), then the labels; a figure that is not there is NaN.
    """
    named = ours[["metric", "unit", "better"]].itertuples(index=False)
    headings = {metric: _heading(metric, unit, better) for metric, unit, better in named}
    both = pd.concat([ours, paper])  # which leaves out a paper that is None
    table = both.pivot(index="metric", columns="label", values="value")
    table = table.reindex(index=list(headings), columns=both["label"].unique()).rename(headings)
    return table.rename_axis(columns=None).reset_index()


# ------------------------------------------------------------------------------ what we ask of our own models' motion
#
# Bars are ours, not the paper's: real motion of the same protocol is the measure. They stand in `quality_bars.csv`,
# where `compared` is written in the figures of `made` motion, of `real` motion, how far the nearest bad
# generator is from real (`gap`) and the `accuracy` of the classifier.

BAR_MODELS = ("F3AMD-FNO-96", "F3AMD-FNO-96-steady")
"""Models that are asked; the bar on noise is the second's."""


def quality_bars(quality: pd.DataFrame, classifier_accuracy: float) -> pd.DataFrame:
    """Compare measured motion, one denoising step, with our bars.

    Args:
      quality: from `protocol.summarise`, with real motion and the bad generators.
      classifier_accuracy: held-out share of the style classifier, 0 to 1.

    Returns:
      Columns bar, unit, asked, a figure for each of `BAR_MODELS` (NaN where not measured), and
      met_by: "both", the name of one, "neither", or "not measured" where neither was.

    Raises:
      ValueError: if the table lacks real motion.
    """
    bars = pd.read_csv(Path(__file__).with_name("quality_bars.csv"), keep_default_na=False)
    value = quality.pivot_table(index=["steps", "model"], columns="metric", values="value")
    value = value.reindex(columns=bars["metric"])
    if (0, "real") not in value.index:
        raise ValueError("the quality table has no rows of real motion: nothing to compare with")
    fixed = {"accuracy": 100.0 * classifier_accuracy}
    rows = []
    for bar in bars.itertuples():
        column, found = value[bar.metric], {}
        real, broken = column[0, "real"], column[0].drop(index="real")
        for model in BAR_MODELS:
            made = column.get((1, model), np.nan)
            figures = fixed | {"made": made, "real": real, "gap": (broken - real).abs().min()}
            found[model] = pd.eval(bar.compared, local_dict=figures)
        met = [name for name, one in found.items() if pd.eval(f"one {bar.sign} {bar.limit}", local_dict={"one": one})]
        answer = "both" if len(met) == len(found) else ", ".join(met) or "neither"
        known = pd.notna(list(found.values())).any()
        asked = {"bar": bar.bar, "unit": bar.unit, "asked": f"{bar.sign} {bar.limit:g}"}
        rows.append(asked | found | {"met_by": answer if known else "not measured"})
    return pd.DataFrame(rows)


def _heading(metric: str, unit, better: str) -> str:
    """Return a column heading such as "trajectory error (m) ↓"; other ways than "down" and "up" have no arrow."""
    heading = str(metric).replace("_", " ")
    if isinstance(unit, str) and unit:
        heading += f" ({unit})"
    return heading + ARROWS.get(better, "")


def committed_quality(dataset: str) -> pd.DataFrame | None:
    """Return what is on record for the models of a data set, with the weights of each row.

    Means and intervals of the protocol, and of `measure walking` (its intervals are over seeds).
    """
    tables, keys = [], ["model", "window_frames", "steps"]
    if found := committed_table(dataset, "quality"):
        weights = committed_table(dataset, "quality_by_seed")[0][[*keys, "weights"]].drop_duplicates(keys)
        tables.append(found[0].merge(weights, on=keys, how="left"))
    if found := committed_table(dataset, "walking"):
        tables.append(_walking_rows(found[0]))
    return pd.concat(tables, ignore_index=True) if tables else None


def _walking_rows(walking: pd.DataFrame) -> pd.DataFrame:
    """Sum `records/walking.csv` up in the form of the protocol's table."""
    # The protocol has its own acceleration.
    figures = [one.name for one in SHOWN["card"] if one.name in walking and one.name != "joint_acceleration"]
    columns = ["model", "window_frames", "steps", "weights"]
    means = walking.fillna({"weights": ""}).groupby([*columns, "seed"], sort=False)[figures].mean().reset_index()
    return intervals_over_repeats(means.melt([*columns, "seed"], var_name="metric"), [*columns, "metric"])
