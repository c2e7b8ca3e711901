"""A paper's table with ours beside it, and what to know before comparing them."""

from collections.abc import Callable, Sequence

import pandas as pd
from f3amd_lib.ground.papers import has_paper_file, load_paper_file, load_paper_table, paper_folders
from f3amd_lib.ground.profiles import runs_dir
from f3amd_lib.ground.records import committed_table, read_table
from f3amd_lib.ground.tables import markdown_table
from f3amd_lib.measures.registry import METRICS
from f3amd_lib.papers.printed import SCHEMAS, printed_tables

from f3amd_notebooks.quality_tables import ARROWS
from f3amd_notebooks.stored_result import measured_table


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
            columns.append(rows.apply(_with_interval, axis=1).rename(f"{whose}: {titled(metric)}"))
    if stored is not None:
        columns.append(stored.drop_duplicates(keys).set_index(keys)["trained"].rename("our network"))
    return pd.concat(columns, axis=1).fillna("–").reset_index(), sentence


def titled(metric: str) -> str:
    """Return a metric's title with the arrow that says which way is better."""
    return METRICS[metric].title + ARROWS.get(METRICS[metric].better, "")


def _with_interval(row) -> str:
    figures = [f"{row[bound]:.3g}" for bound in ("value", "low", "high")]
    return figures[0] if pd.isna(row["low"]) else "{} ({} to {})".format(*figures)


def judge_note(name: str) -> str:
    """Say which judges measured the committed tables of text to motion, "" if it was one.

    Judges of one recipe differ from training to training, so that their figures are on scales of their own.
    """
    papers = [paper for paper in paper_folders() if has_paper_file("experiments", paper)]
    names = [other for paper in papers for other in load_paper_file("experiments", paper) if other != "settings"]
    tables = {other: committed_table("bandai", other) for other in ("text_judge", *names)}
    judges = {other: found[1]["judge_weights"] for other, found in tables.items() if found}
    named: dict[str, list[str]] = {}
    for other, judge in judges.items():
        named.setdefault(judge, []).append(f"`{other}`")
    if len(named) < 2:
        return ""
    own = f"The judge of `{name}` has weights {judges[name]}. "
    others = "; ".join(f"{judge} of {', '.join(tables)}" for judge, tables in named.items() if judge != judges[name])
    compare = "Compare FID, R-precision and their like within one judge's tables alone."
    return f"{own}Others were trained at other times: {others}. {compare}"


WHOSE = {
    "paper": "the paper's, as printed",
    "ours": "ours, at our scale: small networks, minutes to hours of training",
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


def times_beside_paper(table: pd.DataFrame, number: int, device: str) -> pd.DataFrame:
    """Lay our synthesis times beside a table of the paper.

    Args:
      table: `synthesis_time`, the fastest implementation of each framework.
      number: of the paper's table: 1, 4 or 7.
      device: "CPU" or "GPU", for both sides. The paper's machines are others than ours.

    Returns:
      Columns model, window_frames, steps, characters, paper (ms), ours (ms), low, high, framework
      and way; a row for each cell of the paper's table, ours NaN where nothing was measured.

    Raises:
      ValueError: for another table.
    """
    if number not in (1, 4, 7):
        raise ValueError(f"table {number} holds no synthesis times by characters: use 1, 4 or 7")
    paper = load_paper_table(number)
    paper = paper[paper["device"] == device].rename(columns={"value": "paper"})
    asked = paper["model"].str.contains("PyTorch").map({True: "torch", False: "jax"})
    paper = paper.assign(asked=asked, preset=paper["model"].str.replace(r" \((JAX|PyTorch)\)", "", regex=True))
    ours = table[table["device"] == device].rename(columns={"model": "preset", "value": "ours"})
    ours, keys = ours.assign(asked=ours["framework"]), ["window_frames", "steps", "characters"]
    told = ["ours", "low", "high", "framework", "way"]
    matched = ["preset", "asked", *keys]
    joined = paper[["model", "paper", *matched]].merge(ours[[*matched, *told]], how="left", on=matched)
    return joined[["model", *keys, "paper", *told]]


def training_beside_paper(table: pd.DataFrame) -> pd.DataFrame:
    """Lay our training times beside the paper's Table 2.

    Epochs differ in length (other data), so that what can be compared is the quotient over CAMDM.

    Args:
      table: `training_time`.

    Returns:
      Columns model, window_frames, paper_minutes, paper_over_camdm, our_minutes, our_over_camdm,
      seconds_per_step, share_of_peak (that of a plain matrix product, where it was measured), batch_size, device.
    """
    paper = load_paper_table(2)[["model", "window_frames", "value"]]
    paper = paper.rename(columns={"value": "paper_minutes"})
    told = ["model", "window_frames", "epoch_minutes", "value", "share_of_peak", "batch_size", "device"]
    ours = table.reindex(columns=told)
    ours = ours.rename(columns={"epoch_minutes": "our_minutes", "value": "seconds_per_step"})
    joined = paper.merge(ours, how="left", on=["model", "window_frames"])
    for name in ("paper", "our"):
        minutes = f"{name}_minutes"
        camdm = joined[joined["model"] == "CAMDM"].set_index("window_frames")[minutes]
        quotient = joined[minutes] / joined["window_frames"].map(camdm)
        joined.insert(joined.columns.get_loc(minutes) + 1, f"{name}_over_camdm", quotient)
    return joined


def speedups_by_turns(times: pd.DataFrame, fastest: Callable) -> pd.DataFrame:
    """Return the speedups over CAMDM of our own rounds, both from the same turns.

    Args:
      times: `synthesis_ways`; JAX's rows count.
      fastest: keeps one implementation of each (`times.fastest_implementations`).

    Returns:
      As `speedups`; what two suites have timed counts once.
    """
    suites = sorted(set(times["suite"]), key=lambda name: (name == "bars", name != "main"))
    times = times[times["framework"] == "jax"]
    tables = [speedups(fastest(times[times["suite"] == suite])) for suite in suites]
    keys = ["model", "window_frames", "steps", "device", "characters"]
    return pd.concat(tables).drop_duplicates(keys).reset_index(drop=True)


def speedups(times: pd.DataFrame, *, window: int = 32) -> pd.DataFrame:
    """Return how many times faster than CAMDM with 8 steps each row is (Figures 3 and 4).

    Args:
      times: columns model, window_frames, steps, device, characters and value (ms), one framework;
        a table of the paper, or rows of `synthesis_time`.
      window: frames; both sides have it.

    Returns:
      The rows of that window but CAMDM's with 8 steps, with the column speedup; rows without a
      CAMDM at as many characters are left out.

    Raises:
      ValueError: if CAMDM is timed twice for one device and number of characters.
    """
    of_window = times[times["window_frames"] == window]
    is_camdm = (of_window["model"] == "CAMDM") & (of_window["steps"] == 8)
    camdm = of_window[is_camdm].set_index(["device", "characters"])["value"]
    if not camdm.index.is_unique:
        raise ValueError("CAMDM is timed twice for one number of characters: keep one framework")
    others = of_window[~is_camdm]
    slow = others.join(camdm.rename("slow"), on=["device", "characters"])["slow"]
    return others.assign(speedup=slow / others["value"]).dropna(subset=["speedup"])
