"""From equation to code: a table that is read off the code itself, so that it cannot go stale.

Docstrings of the library say which equation of a paper a function implements: "F3AMD Eq. 9", "F3AMD
Eqs 2-4", or without a name, which means F3AMD ("Eq. 9", "Appendix F"). A paper's name and its
equations stand in its `paper.toml`. This module collects them, together with the tests and the sections of
notebooks that mention the same equation, and the figures that these sections draw. Nothing is
imported for it: source files are parsed.

`python -m f3amd_notebooks.equation_map` writes the maps of all papers to docs/equations.md.
"""

from __future__ import annotations

import ast
import functools
import json
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from textwrap import indent

import pandas as pd
from f3amd_lib.ground.papers import load_paper_file, paper_folders
from f3amd_lib.ground.profiles import repository_root
from f3amd_lib.ground.tables import compact_table

_DEFAULT = "f3amd"  # whose equations are meant where no paper is named
_KINDS = ["functions", "tests", "notebooks", "cells", "figures"]

# A mark without a number may stand in LaTeX, where \bar\alpha_t holds alpha_t too and does not mean it.
_MENTION = r"(?:\b({papers})\s+)?(?:\bEqs?\.?\s+((?:\d+(?:\s*(?:-|,|and|to)\s*)?)+)|(?<!\\bar\\)(?<!\w)({marks})(?!\w))"
_TEST_NAME = r"test_(?:({papers})_)?(?:eq(\d\d)(?:_(?:to_eq)?(\d\d))?|({marks}))_"
_DISPLAYED = re.compile(r"\\qquad\s*\(([\d, .]+)\)\s*\$\$")
_OTHERS = re.compile(r"et al\.|\b(?:19|20)\d\d\b")  # a citation, whose equations are not ours to find

Mentions = set[tuple[str, str]]
"""(paper, label) of equations; a label is "Eq. 9", or a mark of the paper's own such as "Appendix F"."""


def equation_labels(paper: str = _DEFAULT) -> list[str]:
    """Return the labels of a paper's equations."""
    return [entry["label"] for entry in load_paper_file("paper", paper).get("equation", ())]


@functools.cache
def _patterns() -> tuple[re.Pattern, re.Pattern, dict[str, str], dict[str, str]]:
    """Return the patterns of mentions and test names, papers by name, and marks by how a test spells them."""
    names = {load_paper_file("paper", folder)["name"]: folder for folder in paper_folders()}
    labels = [label for folder in names.values() for label in equation_labels(folder)]
    marks = {label.lower().replace(" ", "_"): label for label in labels if "Eq. " not in label}
    either = lambda words: "|".join(map(re.escape, words))
    mention = _MENTION.format(papers=either(names), marks=either(marks.values()))
    test = _TEST_NAME.format(papers=either(names.values()), marks=either(marks))
    return re.compile(mention), re.compile(test), names, marks


def mentioned_equations(text: str) -> Mentions:
    """Return the equations that a text mentions, whether or not the paper has such equations.

    "Eqs 2-4" stands for three, of the paper named before it ("F3AMD Eqs 2-4") or of F3AMD. An
    equation of a paper that has no folder here is left out: it follows "et al." or a year in the same
    clause ("Zhou et al. 2019, Eq. 15").
    """
    pattern, _, names, _ = _patterns()
    found = set()
    for clause in re.split(r"[;()]|\.\s*\n", text):  # where a citation ends to be about what follows
        for match in pattern.finditer(clause):
            name, numbers, mark = match.groups()
            if not _OTHERS.search(clause[: match.start()]):
                paper = names.get(name, _DEFAULT)
                # A mark means an equation in the paper that calls one so, and any text elsewhere.
                labels = {mark} & set(equation_labels(paper)) if mark else _numbered(numbers)
                found |= {(paper, label) for label in labels}
    return found


def _numbered(text: str) -> set[str]:
    """Read "2-4" or "10, 12 and 13"."""
    parts = [re.findall(r"\d+", part) for part in re.split(r",|and", text)]
    return {f"Eq. {one}" for ends in parts if ends for one in range(int(ends[0]), int(ends[-1]) + 1)}


def equations_in_name(name: str) -> Mentions:
    """Return the equations that the name of a test carries: "test_eq03_to_eq04_sum", "test_acmdm_eq01_path"."""
    _, pattern, _, marks = _patterns()
    if not (named := pattern.match(name)):
        return set()
    paper, first, last, mark = named.groups()
    labels = {marks[mark]} if mark else _numbered(f"{first}-{last or first}")
    return {(paper or _DEFAULT, label) for label in labels}


def equation_map(*, root=None, paper: str = _DEFAULT, course: bool = False) -> pd.DataFrame:
    """Collect where each equation of a paper lives.

    Args:
      root: a checkout with the packages, `tests` and `notebooks`; by default the one in use. A
        folder that is absent (an installed package has no tests) gives empty cells.
      paper: its folder in `f3amd_lib/papers`.
      course: look into the notebooks of the course, too.

    Returns:
      One row per equation of its `paper.toml`: equation, section (of the paper), what, functions, tests,
      notebooks, cells (numbers of the notebooks' sections that speak of it: "2.3" is in notebook
      02, "C4.1" in the course's 04), figures (files that these sections draw). The last five hold
      names joined by ", ", "" where there are none.
    """
    return _rows_of(paper, _places(Path(root or repository_root()), course))


def _rows_of(paper: str, places: pd.DataFrame) -> pd.DataFrame:
    rows = pd.DataFrame(load_paper_file("paper", paper).get("equation", ()), columns=["label", "section", "what"])
    own = places[places["paper"] == paper].pivot_table("place", "label", "kind", aggfunc=", ".join, fill_value="")
    own = own.reindex(index=rows["label"], columns=_KINDS, fill_value="")
    return rows.join(own, on="label").rename(columns={"label": "equation"})


def _places(root: Path, course: bool) -> pd.DataFrame:
    """Return where equations live: kind (of `_KINDS`), place, paper, label."""
    found: list[tuple] = []
    note = lambda kind, place, mentions: found.extend((kind, place, *each) for each in mentions)
    for path in (path for name in ("f3amd_lib", "f3amd_companion") for path in sorted((root / name).rglob("*.py"))):
        module = "/".join(path.relative_to(root).with_suffix("").parts[1:])
        for name, text in _documented(path):
            if not module.startswith("ledger/"):  # what draws and lists implements nothing
                note("functions", f"{module}: {name}", mentioned_equations(text))
    for path in sorted((root / "tests").glob("test_*.py")):
        for name, text in _documented(path):
            if name.startswith("test_") and "." not in name:
                note("tests", f"{path.stem}: {name}", mentioned_equations(text) | equations_in_name(name))
    folders = [root / "notebooks", root / "notebooks/course"][: 1 + course]
    for path in (path for folder in folders for path in sorted(folder.glob("[0-9][0-9]_*.ipynb"))):
        # The path has the paper's own section numbers, and the reading guide this very map; solutions only repeat.
        if path.stem.startswith("00") or path.stem.endswith("_solutions"):
            continue
        markdown = ("".join(cell["source"]) for cell in _cells(path) if cell["cell_type"] == "markdown")
        note("notebooks", path.stem, Section("", "\n\n".join(markdown)).equations)
        for section in filter(lambda section: section.number, notebook_sections(path)):
            for kind, places in {"cells": [section.number], "figures": section.figures}.items():
                for place in places:
                    note(kind, place, section.equations)
    return pd.DataFrame(found, columns=["kind", "place", "paper", "label"])


def _documented(path: Path) -> Iterator[tuple[str, str]]:
    """Yield (qualified name, docstring) of the classes, functions and methods of a file."""

    def visit(body, above: str):
        for node in body:
            if isinstance(node, (ast.ClassDef, ast.FunctionDef)):
                text = ast.get_docstring(node) or ""
                # Attributes of a config name equations that they belong to, but do not compute.
                yield above + node.name, re.sub(r"Attributes:.*?(\n\n|\Z)", "", text, flags=re.S)
                yield from visit(node.body, f"{above}{node.name}.")

    return visit(ast.parse(path.read_text(encoding="utf-8")).body, "")


@dataclass
class Section:
    """A section of a notebook.

    Attributes:
      heading: its line, without the marks: "2.3 One line, three labels (Eq. 9)".
      text: all of it, code and heading included.
    """

    heading: str
    text: str

    @property
    def number(self) -> str:
        """The heading's own number, "2.3" or "C4.1"; "" if it has none, as "What we learned" has."""
        return "".join(re.findall(r"^C?\d+\.\d+(?= )", self.heading))

    @property
    def equations(self) -> Mentions:
        """Equations that it mentions or, F3AMD's, displays with the number: "\\qquad (11)$$"."""
        numbers = [one.strip() for one in ",".join(_DISPLAYED.findall(self.text)).split(",")]
        return mentioned_equations(self.text) | {(_DEFAULT, f"Eq. {one}") for one in numbers if one.isdigit()}

    @property
    def figures(self) -> list[str]:
        """Names of the figures that its code draws and keeps: `keep_figure(..., "02_schedule")`."""
        return re.findall(r'keep_\w+\([^"]*"(\d\d_\w+)"', self.text)


def notebook_sections(path) -> list[Section]:
    """Read the sections of a notebook in their order, one for each heading of the second level ("## ...").

    What stands before the first of them is the title page and in no section; deeper headings stay in the section
    they stand in.
    """
    # Code is indented, so that no comment in it begins as a heading does.
    told = (indent("".join(cell["source"]), "    " * (cell["cell_type"] == "code")) for cell in _cells(path))
    _, *parts = re.split(r"^## (.*)$", "\n\n".join(told), flags=re.M)
    return [Section(one.strip(), f"{one}\n\n{text}") for one, text in zip(parts[::2], parts[1::2], strict=True)]


def _cells(path) -> list[dict]:
    return json.loads(Path(path).read_text(encoding="utf-8"))["cells"]


# ------------------------------------------------------------------------------------------------------------- the page


def equations_markdown(*, root=None) -> str:
    """Return the page docs/equations.md: for each paper a table of its equations with functions, tests and sections.

    Args:
      root: as in `equation_map`.

    An equation that no function computes has the reason in its place, `cited_only` in `paper.toml`.
    """
    root = Path(root or repository_root())
    places = _places(root, course=True)
    parts = [Path(__file__).with_suffix(".template").read_text(encoding="utf-8")]
    for paper in sorted(filter(equation_labels, paper_folders()), key=lambda paper: paper != _DEFAULT):
        about, rows = load_paper_file("paper", paper), _rows_of(paper, places)
        code = rows["functions"].str.replace(": ", ".").str.replace(r"([^, ]+)", r"`\1`", regex=True)
        reasons = [f"*cited only:* {one['cited_only']}" if "cited_only" in one else "" for one in about["equation"]]
        page = rows[["equation", "section"]].assign(**{"what it says": rows["what"]})
        page["functions"] = code.where(code != "", reasons)
        page["tests"] = rows["tests"].map(_first_tests)
        link = lambda cell: f"[{cell[0]}](/{_notebook_of(root, cell[0]).relative_to(root).as_posix()})"
        page["notebooks"] = rows["cells"].str.replace(r"[^, ]+", link, regex=True)
        parts.append(f"\n## {about['name']}\n\n{compact_table(page)}")
    return "".join(parts)


def _first_tests(names: str) -> str:
    """Return the first test of each file, and how many more it has."""
    tests = pd.DataFrame(re.findall(r"(\w+): (\w+)", names), columns=["file", "test"])
    by_file = tests.groupby("file", sort=False)["test"].agg(["first", "size"])
    more = lambda count: f" and {count - 1} more" if count > 1 else ""
    return "; ".join(f"`tests/{file}.py`: `{test}`{more(count)}" for file, test, count in by_file.itertuples())


def _notebook_of(root: Path, section: str) -> Path:
    """Return the notebook of a section by its number: "2.3" is in 02_*.ipynb, "C4.1" in course/04_*.ipynb."""
    number = int(section.lstrip("C").split(".")[0])
    return next((root / "notebooks" / ("course" if section[0] == "C" else "")).glob(f"{number:02d}_*.ipynb"))


if __name__ == "__main__":
    (repository_root() / "docs/equations.md").write_text(equations_markdown(), encoding="utf-8")
