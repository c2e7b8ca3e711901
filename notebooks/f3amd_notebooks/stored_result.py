"""What earlier runs left, as a notebook shows it: a table, and how long each notebook ran."""

from pathlib import Path

import pandas as pd
from f3amd_lib.ground.profiles import repository_root
from f3amd_lib.ground.records import read_table
from f3amd_lib.ground.stored import committed_table, machine_of
from f3amd_lib.ground.tables import markdown_table


def stored_result(dataset: str, name: str) -> str:
    """Return a table that `make figures` left as Markdown, and a line on its origin; or that there is none yet."""
    if (found := committed_table(dataset, name, kind="tables")) is None:
        return f"No stored `{name}` of `laptop` on `{dataset}` yet: `make figures` makes it."
    frame, record = found
    where = f"profile {record['profile']}, data {record['dataset']}, {machine_of(record)}"
    return f"Stored result: `{name}`, {where}\n\n{markdown_table(frame, digits=2)}"


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
