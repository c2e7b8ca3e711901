"""Fills the tables of written pages."""

import re
from collections.abc import Mapping


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
