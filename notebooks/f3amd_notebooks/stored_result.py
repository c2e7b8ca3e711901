"""A table that an earlier run left, as a notebook shows it."""

from f3amd_lib.ground.stored import committed_table, machine_of
from f3amd_lib.ground.tables import markdown_table


def stored_result(dataset: str, name: str) -> str:
    """Return a table that `make figures` left as Markdown, and a line on its origin; or that there is none yet."""
    if (found := committed_table(dataset, name, kind="tables")) is None:
        return f"No stored `{name}` of `laptop` on `{dataset}` yet: `make figures` makes it."
    frame, record = found
    where = f"profile {record['profile']}, data {record['dataset']}, {machine_of(record)}"
    return f"Stored result: `{name}`, {where}\n\n{markdown_table(frame, digits=2)}"
