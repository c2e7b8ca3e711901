"""Check the built site: every link inside it leads somewhere, and nothing is loaded from outside.

    python docs/check_links.py docs/_build/html

Looks into pages, into the pages that their iframes carry (`srcdoc`), and into styles wherever they
stand. What scripts ask for while they run is not seen; tests/web listens for that.

Prints what is wrong, a line each, and how many links lead outside (they are not followed), and
exits with 1 if anything is wrong. `make site` runs it after each build.
"""

from __future__ import annotations

import argparse
import re
import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

LOADS = {  # attributes by which a page makes the browser ask for something while it opens
    ("audio", "src"),
    ("embed", "src"),
    ("iframe", "src"),
    ("image", "href"),  # of an SVG, as is <use>
    ("image", "xlink:href"),
    ("img", "src"),
    ("input", "src"),
    ("link", "href"),
    ("object", "data"),
    ("script", "src"),
    ("source", "src"),
    ("track", "src"),
    ("use", "href"),
    ("use", "xlink:href"),
    ("video", "poster"),
    ("video", "src"),
}
SEVERAL = {("img", "srcset"), ("link", "imagesrcset"), ("source", "srcset")}  # of which one is taken
UNLOADED = {"canonical", "index", "search", "next", "prev", "author", "copyright"}  # of <link>


CANDIDATE = re.compile(r"[\s,]*(\S*[^\s,])(?:\s[^,]*)?,?")
IMPORT = re.compile(r"""@import\s+(?:"([^"]*)"|'([^']*)')""", re.I)
URL = re.compile(r"""url\(\s*(?:"([^"]*)"|'([^']*)'|([^\s"')]*))\s*\)""", re.I)
UNASKED = re.compile(r"/\*.*?\*/|@namespace[^;]*;", re.S | re.I)  # in styles


def candidates(sizes: str) -> list[str]:
    """Return the addresses of a srcset; commas inside one, as in data:, belong to it."""
    return CANDIDATE.findall(sizes)


def style_loads(text: str) -> list[str]:
    """Return the addresses that a style asks for: of fonts, images and other styles."""
    text = UNASKED.sub(" ", text)
    found = [*IMPORT.findall(text), *URL.findall(text)]
    return [address for address in map("".join, found) if address]


class Page(HTMLParser):
    """What a page names (`anchors`), leads to (`links`), asks for (`loads`) and holds (`inner`)."""

    def __init__(self, text: str):
        super().__init__()
        self.anchors: set[str] = {"", "top"}
        self.links: list[str] = []
        self.loads: list[str] = []
        self.nameless: list[str] = []
        self.inner: list[Page] = []
        self._in_style = False
        self.feed(text)
        self.close()

    def handle_starttag(self, tag, attributes):
        values = dict(attributes)
        self.anchors |= {values[key] for key in ("id", "name") if values.get(key)}
        words = values.get("alt") or ""
        if tag == "img" and (not words or (" " not in words and Path(words).suffix)):
            self.nameless.append(values.get("src") or "")
        for key, value in attributes:
            relation = set((values.get("rel") or "").split())
            if not value:
                continue
            if (tag, key) in LOADS and not relation & UNLOADED:
                self.loads.append(value)
            elif (tag, key) in SEVERAL:
                self.loads += candidates(value)
            elif key == "style":
                self.loads += style_loads(value)
            elif (tag, key) == ("iframe", "srcdoc"):
                self.inner.append(Page(value))
            elif key in ("href", "src"):
                self.links.append(value)
        self._in_style = tag == "style"

    def handle_endtag(self, tag):
        self._in_style = False

    def handle_data(self, data):
        if self._in_style:
            self.loads += style_loads(data)

    def whole(self) -> list[Page]:
        """Return this page, and all that lie in it at any depth."""
        return [self, *(page for inner in self.inner for page in inner.whole())]


def is_outside(address: str) -> bool:
    """Return whether an address leads out of the site."""
    parts = urlsplit(address)
    return bool(parts.scheme or parts.netloc)


def check_site(folder: Path) -> tuple[list[str], int]:
    """Check every page and style sheet below a folder.

    Args:
      folder: the built site.

    Returns:
      Faults, a sentence each; and the number of different addresses outside.

    Raises:
      ValueError: if there is no page in the folder.
    """
    folder = folder.resolve()
    pages = {path: Page(path.read_text(encoding="utf-8")) for path in sorted(folder.rglob("*.html"))}
    if not pages:
        raise ValueError(f"{folder}: no pages; build the site first (make site)")
    faults, outside = [], set()

    def check(path: Path, addresses: list[str], own: Page | None = None) -> None:
        name = path.relative_to(folder).as_posix()
        for address in addresses:
            if is_outside(address):
                outside.add(address)
                continue
            parts = urlsplit(address)
            target = (path.parent / unquote(parts.path)).resolve() if parts.path else path
            page = pages.get(target) if parts.path else own
            if parts.path.startswith("/") or not target.is_relative_to(folder):
                faults.append(f"{name}: {address} leads out of the site's folder")
            elif not target.is_file():
                faults.append(f"{name}: {address} leads nowhere")
            elif page and unquote(parts.fragment) not in page.anchors:
                faults.append(f"{name}: {address}: no such place on that page")

    asked = {path: style_loads(path.read_text("utf-8")) for path in sorted(folder.rglob("*.css"))}
    for path, loads in asked.items():
        check(path, loads)
    for path, outermost in pages.items():
        asked[path] = [load for page in outermost.whole() for load in page.loads]
        for page in outermost.whole():
            name = path.relative_to(folder).as_posix()
            faults += [f"{name}: image {image} has no alternative text" for image in page.nameless]
            check(path, [*page.links, *page.loads], page)
    for path, loads in asked.items():
        name = path.relative_to(folder).as_posix()
        faults += [f"{name}: asks {load} from outside" for load in loads if is_remote(load)]
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
