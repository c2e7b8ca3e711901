"""What earlier runs left, as a notebook shows it: tables, a picture, and how long each notebook ran."""

from collections.abc import Callable
from pathlib import Path

import pandas as pd
from f3amd_lib.ground.names import counted_cores
from f3amd_lib.ground.profiles import repository_root
from f3amd_lib.ground.records import committed_table, read_table
from f3amd_lib.ground.tables import markdown_table
from f3amd_lib.measures.distributions import of_seeds
from f3amd_lib.papers.printed import SCHEMAS
from IPython.display import Image


def stored_result(dataset: str, name: str, summary: Callable = lambda frame: frame) -> str:
    """Return a table that `make figures` left, or its summary, as Markdown with its origin; or that none is there."""
    if (found := committed_table(dataset, name, kind="tables")) is None:
        return f"No stored `{name}` of `laptop` on `{dataset}` yet: `make figures` makes it."
    frame, record = found
    where = f"profile {record['profile']}, data {record['dataset']}, {machine_of(record)}"
    return f"Stored result: `{name}`, {where}\n\n{markdown_table(summary(frame), digits=2)}"


def measured_table(dataset: str, name: str, measurement: str) -> tuple[pd.DataFrame | None, str]:
    """Read the committed table of a data set, else that of Bandai, and say where it comes from.

    Args:
      dataset: a name of `profiles.DATASETS`.
      name: of the table, without ending.
      measurement: of `measure.MEASUREMENTS`, which writes it.

    Returns:
      (table or None, a sentence: data, profile, machine, date and credit, or how to measure it). Of trainings of
      several lengths and seeds, means over the seeds of the whole length. `table.attrs["dataset"]` names the data set.
    """
    found = committed_table(dataset, name) or committed_table("bandai", name)
    if found is None:
        return None, f"Not measured yet: `{name}`. `make measure MEASURE={measurement} DATA=bandai` measures it."
    table, record = found
    if {"seed", "length"} <= {*table}:
        attrs, table = table.attrs, of_seeds(table, SCHEMAS[name])
        table.attrs = attrs
    table.attrs["dataset"] = record["dataset"]
    where = f"data {record['dataset']}, profile {record['profile']}, {machine_of(record)}"
    sentence = f"Stored result `{name}`: {where} {record['dataset_credit'] or ''}"
    if table.attrs["stale"]:
        sentence = f"**Stale: {table.attrs['stale']}; measure it again.** {sentence}"
    return table, sentence.strip()


_SEEN = {
    "joint_acceleration": "joint acceleration, cm/frame² at 30 fps", "bones_off": "bones off, %",
    "moved": "moved by the fit, cm", "slide": "slide, cm/s", "slide_held": "with feet held, cm/s",
}  # fmt: skip


def caption_strip() -> tuple[Image | str, str]:
    """Return the picture of twelve captions, real and made, and the means of what was measured there as Markdown.

    `scripts/caption_strip.py` leaves both; where they are missing, the first says so.
    """
    missing = "Not here: `python scripts/caption_strip.py` draws twelve captions."
    if (found := committed_table("bandai", "captions")) is None:
        return missing, ""
    table, record = found
    means = table.groupby("system", sort=False)[list(_SEEN)].mean().round(1).rename(columns=_SEEN).reset_index()
    picture = repository_root() / "paper_figures/bandai/laptop/media/captions.png"
    about = f"*Means of twelve captions; {machine_of(record)} {record['dataset_credit']}*"
    return Image(filename=picture) if picture.is_file() else missing, f"{markdown_table(means, digits=1)}\n\n{about}"


def running_times(*, root=None) -> pd.DataFrame:
    """Collect how long each notebook ran, from the records of complete runs.

    Args:
      root: a checkout, by default the one in use. Read are `run_summary.csv` and its record in
        `paper_figures/<data set>/<profile>/tables/`, which a run of all notebooks leaves there.

    Returns:
      notebook, and a column for each record, "synthetic, laptop, 2 CPU cores": seconds of wall
      time, to a whole second. A notebook that did not exist when a record was made is a missing
      value. Profiles and machines without a record have no column.

    Raises:
      ValueError: if a summary is not the one its record describes.
    """
    root = Path(root or repository_root())
    columns = {}
    for path in sorted((root / "paper_figures").glob("*/*/tables/run_summary.csv")):
        summary, record = read_table(path)
        where = f"{record['cores']} CPU cores" if record["device_platform"] == "cpu" else record["device_kind"]
        finished = summary[summary["finished"]].set_index("notebook")["seconds"]
        seconds = finished.rename(lambda name: name.removesuffix(".ipynb")).round().astype("Int64")
        columns[f"{record['dataset']}, {record['profile']}, {where}"] = seconds
    names = [path.stem for path in sorted((root / "notebooks").glob("[0-9][0-9]_*.ipynb"))]
    return pd.DataFrame(columns, index=pd.Index(names, name="notebook")).reset_index()


def machine_of(record: dict) -> str:
    """Return on what a record was made, and when: "2 cores (cpu), 2026-11-28."."""
    return f"{counted_cores(record)} ({record['device_platform']}), {record['date_utc'][:10]}."
