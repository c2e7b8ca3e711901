"""Check the built site: every link inside it leads somewhere, and nothing is loaded from outside.

    python docs/check_links.py docs/_build/html

Prints what is wrong, a line each, and how many links lead outside (they are not followed), and
exits with 1 if anything is wrong. `make site` runs it after each build.
"""

from __future__ import annotations

import argparse
import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

LOADS = {  # attributes by which a page makes the browser ask for something while it opens
    ("audio", "src"),
    ("embed", "src"),
    ("iframe", "src"),
    ("img", "src"),
    ("link", "href"),
    ("script", "src"),
    ("source", "src"),
    ("video", "src"),
}
UNLOADED = {"canonical", "index", "search", "next", "prev", "author", "copyright"}  # of <link>


class Page(HTMLParser):
    """What a page names (`anchors`), leads to (`links`) and asks for (`loads`)."""

    def __init__(self, text: str):
        super().__init__()
        self.anchors: set[str] = {"", "top"}
        self.links: list[str] = []
        self.loads: list[str] = []
        self.nameless: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        values = dict(attributes)
        self.anchors |= {values[key] for key in ("id", "name") if values.get(key)}
        words = values.get("alt") or ""
        if tag == "img" and (not words or (" " not in words and Path(words).suffix)):
            self.nameless.append(values.get("src") or "")
        for key, value in attributes:
            relation = set((values.get("rel") or "").split())
            if (tag, key) in LOADS and value and not relation & UNLOADED:
                self.loads.append(value)
            elif key in ("href", "src") and value:
                self.links.append(value)


def is_outside(address: str) -> bool:
    """Return whether an address leads out of the site."""
    parts = urlsplit(address)
    return bool(parts.scheme or parts.netloc)


def check_site(folder: Path) -> tuple[list[str], int]:
    """Check every page below a folder.

    Args:
      folder: the built site.

    Returns:
      Faults, a sentence each; and the number of different addresses outside.

    Raises:
      ValueError: if there is no page in the folder.
    """
    folder = folder.resolve()
    pages = {
        path: Page(path.read_text(encoding="utf-8")) for path in sorted(folder.rglob("*.html"))
    }
    if not pages:
        raise ValueError(f"{folder}: no pages; build the site first (make site)")
    faults, outside = [], set()
    for path, page in pages.items():
        name = path.relative_to(folder).as_posix()
        faults += [f"{name}: asks {load} from outside" for load in page.loads if is_remote(load)]
        faults += [f"{name}: image {image} has no alternative text" for image in page.nameless]
        for address in [*page.links, *page.loads]:
            if is_outside(address):
                outside.add(address)
                continue
            parts = urlsplit(address)
            target = (path.parent / unquote(parts.path)).resolve() if parts.path else path
            if parts.path.startswith("/") or not target.is_relative_to(folder):
                faults.append(f"{name}: {address} leads out of the site's folder")
            elif not target.is_file():
                faults.append(f"{name}: {address} leads nowhere")
            elif target in pages and unquote(parts.fragment) not in pages[target].anchors:
                faults.append(f"{name}: {address}: no such place on that page")
    return sorted(set(faults)), len({a for a in outside if is_remote(a)})


def is_remote(address: str) -> bool:
    """Return whether an address needs a network: not data: and its like."""
    parts = urlsplit(address)
    return bool(parts.netloc) or parts.scheme in ("http", "https")


def main(arguments=None) -> int:
    """Check the folder named on the command line; return 1 if there is a fault."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    folder = parser.parse_args(arguments).folder
    try:
        faults, outside = check_site(folder)
    except ValueError as error:
        print(error, file=sys.stderr)
        return 1
    for fault in faults:
        print(fault, file=sys.stderr)
    files = [path for path in folder.rglob("*") if path.is_file()]
    megabytes = sum(path.stat().st_size for path in files) / 1e6
    print(
        f"{folder}: {sum(path.suffix == '.html' for path in files)} pages, {megabytes:.0f} MB, "
        f"{outside} addresses outside (not followed), {len(faults)} faults"
    )
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
