"""From equation to code: a table that is read off the code itself, so that it cannot go stale.

Docstrings of the library say which equation of a paper a function implements: "F3AMD Eq. 9", "F3AMD
Eqs 2-4", or without a name, which means F3AMD ("Eq. 9", "Appendix F"). A paper's name and its
equations stand in its `paper.toml`. This module collects them, together with the tests and the sections of
notebooks that mention the same equation, and the figures that these sections draw. Nothing is
imported for it: source files are parsed. How long a notebook runs is read off the records of
complete runs.

`python -m f3amd_companion.ledger.equation_map` writes the maps of all papers to docs/equations.md.
"""

from __future__ import annotations

import ast
import functools
import json
import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import pandas as pd

from f3amd_lib.ground.papers import load_paper_file, paper_folders
from f3amd_lib.ground.profiles import repository_root
from f3amd_lib.ground.records import read_table
from f3amd_lib.ground.tables import compact_table

_DEFAULT = "f3amd"  # whose equations are meant where no paper is named
_KINDS = ("functions", "tests", "notebooks", "cells", "figures")

# A mark without a number may stand in LaTeX, where \bar\alpha_t holds alpha_t too and does not mean it.
_MENTION = r"(?:\b({papers})\s+)?(?:\bEqs?\.?\s+((?:\d+(?:\s*(?:-|,|and|to)\s*)?)+)|(?<!\\bar\\)(?<!\w)({marks})(?!\w))"
_TEST_NAME = r"test_(?:({papers})_)?(?:eq(\d\d)(?:_(?:to_eq)?(\d\d))?|({marks}))_"
_DISPLAYED = re.compile(r"\\qquad\s*\(([\d, .]+)\)\s*\$\$")
_OTHERS = re.compile(r"et al\.|\b(?:19|20)\d\d\b")  # a citation, whose equations are not ours to find


def equation_labels(paper: str = _DEFAULT) -> list[str]:
    """Return the labels of a paper's equations: "Eq. 9", or a mark of its own such as "Appendix F"."""
    return [entry["label"] for entry in load_paper_file("paper", paper).get("equation", ())]


@functools.cache
def _patterns(paper: str) -> tuple[re.Pattern, re.Pattern, dict[str, str], dict[str, str]]:
    """Return the patterns of mentions and test names, papers by name, and marks by how a test spells them."""
    names = {load_paper_file("paper", folder)["name"]: folder for folder in paper_folders()}
    marks = {label.lower().replace(" ", "_"): label for label in equation_labels(paper) if "Eq." not in label}
    either = lambda words: "|".join(map(re.escape, words)) or "(?!)"
    mention = re.compile(_MENTION.format(papers=either(names), marks=either(marks.values())))
    test_name = re.compile(_TEST_NAME.format(papers=either(names.values()), marks=either(marks)))
    return mention, test_name, names, marks


def mentioned_equations(text: str, paper: str = _DEFAULT) -> set[str]:
    """Return the labels of a paper's equations that a text mentions.

    "Eqs 2-4" stands for three, of the paper named before it ("F3AMD Eqs 2-4") or of F3AMD. An
    equation of a paper that has no folder here is left out: it follows "et al." or a year in the same
    clause ("Zhou et al. 2019, Eq. 15").
    """
    return _mentions(text, paper) & set(equation_labels(paper))


def _clauses(text: str) -> list[str]:
    return re.split(r"[;()]|\.\s*\n", text)


def _mentions(text: str, paper: str) -> set[str]:
    """Return labels as a text has them, whether or not the paper has such equations."""
    pattern, _, names, _ = _patterns(paper)
    found = set()
    for clause in _clauses(text):
        for match in pattern.finditer(clause):
            name, numbers, mark = match.groups()
            if _OTHERS.search(clause[: match.start()]) or names.get(name, _DEFAULT) != paper:
                continue
            found |= {mark} if mark else {f"Eq. {number}" for number in _numbers(numbers)}
    return found


def _numbers(text: str) -> set[int]:
    """Read "2-4" or "10, 12 and 13"."""
    parts = [[int(number) for number in re.findall(r"\d+", part)] for part in re.split(r",|and", text)]
    return {number for ends in parts if ends for number in range(ends[0], ends[-1] + 1)}


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
    root = Path(root) if root is not None else repository_root()
    places = _places(root, paper, course)
    rows = pd.DataFrame(load_paper_file("paper", paper).get("equation", ()), columns=["label", "section", "what"])
    joined = {kind: [", ".join(found[kind]) for found in places.values()] for kind in _KINDS}
    return rows.rename(columns={"label": "equation"}).assign(**joined)


def _places(root: Path, paper: str, course: bool) -> dict[str, dict[str, list[str]]]:
    """Return for each equation of a paper where it lives, by `_KINDS`."""
    places = {label: {kind: [] for kind in _KINDS} for label in equation_labels(paper)}
    packages = [root / "f3amd_lib", root / "f3amd_companion"]
    for path in (path for package in packages for path in sorted(package.rglob("*.py"))):
        module = path.relative_to(root).with_suffix("").as_posix().partition("/")[2]
        if module.startswith("ledger/"):  # what draws and lists implements nothing
            continue
        for name, text in _documented(path.read_text(encoding="utf-8")):
            for label in mentioned_equations(text, paper):
                places[label]["functions"].append(f"{module}: {name}")
    for path in sorted((root / "tests").glob("test_*.py")):
        for name, labels in _tests(path.read_text(encoding="utf-8"), paper):
            for label in labels:
                places[label]["tests"].append(f"{path.stem}: {name}")
    folders = [root / "notebooks", root / "notebooks/course"][: 1 + course]
    for path in (path for folder in folders for path in sorted(folder.glob("[0-9][0-9]_*.ipynb"))):
        # The reading guide shows this very map and explains none of it; solutions only repeat.
        if path.stem.startswith("00") or path.stem.endswith("_solutions"):
            continue
        markdown = ("".join(cell["source"]) for cell in _cells(path) if cell["cell_type"] == "markdown")
        for label in _told("\n\n".join(markdown), paper):
            places[label]["notebooks"].append(path.stem)
        for section in notebook_sections(path, paper):
            for label in section.equations if section.number else ():
                places[label]["cells"].append(section.number)
                places[label]["figures"] += section.figures
    return places


# Papers have sources in common: a file is parsed once for all of them.
@functools.cache
def _documented(source: str) -> list[tuple[str, str]]:
    """Return (qualified name, docstring) of the classes, functions and methods of a file."""

    def visit(body, above: str):
        for node in body:
            if isinstance(node, (ast.ClassDef, ast.FunctionDef)):
                text = ast.get_docstring(node) or ""
                # Attributes of a config name equations that they belong to, but do not compute.
                yield above + node.name, re.sub(r"Attributes:.*?(\n\n|\Z)", "", text, flags=re.S)
                yield from visit(node.body, f"{above}{node.name}.")

    return list(visit(ast.parse(source).body, ""))


def _tests(source: str, paper: str):
    """Yield (name, labels) of tests that carry an equation in their name or docstring."""
    _, pattern, _, marks = _patterns(paper)
    for name, text in _documented(source):
        if name.startswith("test_") and "." not in name:
            labels = mentioned_equations(text, paper)
            named = pattern.match(name)
            if named and (named[1] or _DEFAULT) == paper:
                first, last = named[2], named[3] or named[2]
                numbers = range(int(first), int(last) + 1) if first else ()
                labels |= {marks[named[4]]} if named[4] else {f"Eq. {number}" for number in numbers}
            yield name, labels & set(equation_labels(paper))


@dataclass(frozen=True)
class Section:
    """What stands under one heading of a notebook.

    Attributes:
      heading: its line, without the marks: "2.3 One line, three labels (Eq. 9)".
      equations: labels of the paper's equations that its text, or its code, mentions.
      figures: names of the figures that its code draws and keeps, "02_schedule".
    """

    heading: str
    equations: frozenset[str]
    figures: tuple[str, ...]

    @property
    def number(self) -> str:
        """The heading's own number, "2.3" or "C4.1"; "" if it has none, as "What we learned" has."""
        found = re.match(r"C?\d+\.\d+(?= )", self.heading)
        return found[0] if found else ""


def notebook_sections(path, paper: str = _DEFAULT) -> list[Section]:
    """Read the sections of a notebook in their order.

    Args:
      path: of the notebook. What stands before its first heading of the second level is its title
        page and in no section; deeper headings stay in the section they stand in.
      paper: whose equations are looked for.

    Returns:
      One entry per heading of the second level ("## ...").
    """
    texts: list[tuple[str, list[str], list[str]]] = []
    for cell in _cells(path):
        source = "".join(cell["source"])
        if cell["cell_type"] == "code":
            if texts:
                texts[-1][1].append(source)
                texts[-1][2].extend(_kept_figures(source))
            continue
        before, *parts = re.split(r"^## (.*)$", source, flags=re.M)
        if texts:
            texts[-1][1].append(before)
        for heading, text in zip(parts[::2], parts[1::2], strict=True):
            texts.append((heading.strip(), [heading, text], []))
    return [
        Section(heading, frozenset(_told("\n\n".join(text), paper)), tuple(figures)) for heading, text, figures in texts
    ]


def _told(text: str, paper: str) -> set[str]:
    """Return the labels that a notebook's text mentions or, F3AMD's, displays with the number: "\\qquad (11)$$"."""
    numbers = ",".join(_DISPLAYED.findall(text)).split(",") if paper == _DEFAULT else ()
    return mentioned_equations(text, paper) | {f"Eq. {one.strip()}" for one in numbers} & set(equation_labels(paper))


@functools.cache
def _kept_figures(source: str) -> list[str]:
    """Return the names under which a code cell keeps figures: `keep_figure(..., "02_paths")`."""
    names = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Call) and node.args and isinstance(node.args[-1], ast.Constant):
            called = ast.unparse(node.func).split(".")[-1]
            if called.startswith("keep_") and re.match(r"\d\d_", str(node.args[-1].value)):
                names.append((node.lineno, node.args[-1].value))
    return [name for _, name in sorted(names)]


def _cells(path) -> list[dict]:
    return json.loads(Path(path).read_text(encoding="utf-8"))["cells"]


# ------------------------------------------------------------------------------------------------------------- the page


def equations_markdown(*, root=None) -> str:
    """Return the page docs/equations.md: for each paper a table of its equations with functions, tests and sections.

    Args:
      root: as in `equation_map`.

    An equation that no function computes has the reason in its place, `cited_only` in `paper.toml`.
    """
    root = Path(root) if root is not None else repository_root()
    papers = [paper for paper in paper_folders() if load_paper_file("paper", paper).get("equation")]
    papers.sort(key=lambda paper: paper != _DEFAULT)
    preface = Path(__file__).with_suffix(".template").read_text(encoding="utf-8")
    return preface + "".join(f"\n{_paper_markdown(root, paper)}" for paper in papers)


def _paper_markdown(root: Path, paper: str) -> str:
    about, rows = load_paper_file("paper", paper), []
    for entry, found in zip(about["equation"], _places(root, paper, course=True).values(), strict=True):
        functions = ", ".join(f"`{name.replace(': ', '.')}`" for name in found["functions"])
        reason = f"*cited only:* {entry['cited_only']}" if "cited_only" in entry else ""
        row = {"equation": entry["label"], "section": entry["section"], "what it says": entry["what"]}
        row |= {"functions": functions or reason, "tests": _first_tests(found["tests"])}
        rows.append(row | {"notebooks": ", ".join(_section_link(root, cell) for cell in found["cells"])})
    return f"## {about['name']}\n\n{compact_table(pd.DataFrame(rows))}"


def _first_tests(names: Iterable[str]) -> str:
    """Return the first test of each file, and how many more it has."""
    files: dict[str, list[str]] = {}
    for name in names:
        file, test = name.split(": ")
        files.setdefault(f"`tests/{file}.py`", []).append(f"`{test}`")
    texts = (f"{file}: {first}" + (f" and {len(more)} more" if more else "") for file, (first, *more) in files.items())
    return "; ".join(texts)


def _section_link(root: Path, cell: str) -> str:
    """Return a section as a link to its notebook: "2.3" is in 02_*.ipynb, "C4.1" in course/04_*.ipynb."""
    folder = root / "notebooks" / ("course" if cell[0] == "C" else "")
    (path,) = folder.glob(f"{int(cell.lstrip('C').split('.')[0]):02d}_*.ipynb")
    return f"[{cell}](/{path.relative_to(root).as_posix()})"


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
    root = Path(root) if root is not None else repository_root()
    columns = {}
    for path in sorted((root / "paper_figures").glob("*/*/tables/run_summary.csv")):
        summary, record = read_table(path)
        where = f"{record['cores']} CPU cores" if record["device_platform"] == "cpu" else record["device_kind"]
        finished = summary[summary["finished"]].set_index("notebook")["seconds"]
        seconds = finished.rename(lambda name: name.removesuffix(".ipynb")).round().astype("Int64")
        columns[f"{record['dataset']}, {record['profile']}, {where}"] = seconds
    names = [path.stem for path in sorted((root / "notebooks").glob("[0-9][0-9]_*.ipynb"))]
    return pd.DataFrame(columns, index=pd.Index(names, name="notebook")).reset_index()


if __name__ == "__main__":
    (repository_root() / "docs/equations.md").write_text(equations_markdown(), encoding="utf-8")
