"""From equation to code: a table that is read off the code itself, so that it cannot go stale.

Docstrings of the library say which equation of the paper a function implements ("Eq. 9",
"Eqs 2-4", "Appendix F"). This module collects them, together with the tests and the sections of
notebooks that mention the same equation, and the figures that these sections draw. Nothing is
imported for it: source files are parsed. How long a notebook runs is read off the records of
complete runs.
"""

from __future__ import annotations

import ast
import json
import re
from dataclasses import dataclass
from pathlib import Path

import pandas as pd

from f3amd_lib.ground.profiles import repository_root
from f3amd_lib.ground.records import read_table


@dataclass(frozen=True)
class Equation:
    """An equation of the paper.

    Attributes:
      label: "Eq. 9", "Appendix F" for the unnumbered update, "alpha_t" for what that appendix
        defines beside it.
      section: where the paper has it.
      what: what it says, in our words.
    """

    label: str
    section: str
    what: str


EQUATIONS = (
    Equation("Eq. 1", "3.1", "the network predicts clean motion from noisy motion"),
    Equation("Eq. 2", "3.4.2", "spectral branch: weights on Fourier modes"),
    Equation("Eq. 3", "3.4.2", "local branch: two convolutions over time"),
    Equation("Eq. 4", "3.4.2", "FNO block: the sum of both"),
    Equation("Eq. 5", "3.4.3", "FiLM: scale and shift from the condition"),
    Equation("Eq. 6", "3.4.3", "FiLM: the bounded gate"),
    Equation("Eq. 7", "3.4.3", "FiLM: output layer"),
    Equation("Eq. 8", "3.5", "variance-exploding noise"),
    Equation("Eq. 9", "3.5", "noise level against schedule time"),
    Equation("Eq. 10", "4.1, 4.4", "inter-round discontinuity, loss and metric"),
    Equation("Eq. 11", "App. B", "sample loss"),
    Equation("Eq. 12", "App. B", "joint position loss"),
    Equation("Eq. 13", "App. B", "velocity loss"),
    Equation("Eq. 14", "App. B", "weighted sum of the losses"),
    Equation("Appendix F", "App. F", "DDIM update through alpha_bar"),
    Equation("alpha_t", "App. F", "root of the signal kept by one step; the update never uses it"),
)
"""All equations of the paper that carry a number, and the two of Appendix F, which carry none."""

# In LaTeX the last one is \alpha_t, which \bar\alpha_t holds too and does not mean.
_MENTION = re.compile(
    r"\bEqs?\.?\s+((?:\d+(?:\s*(?:-|,|and|to)\s*)?)+)|\b(Appendix F)\b"
    r"|(?<!\\bar\\)(?<!\w)(alpha_t)(?!\w)"
)
_DISPLAYED = re.compile(r"\\qquad\s*\(([\d, .]+)\)\s*\$\$")
_TEST_NAME = re.compile(r"^test_(?:eq(\d\d)(?:_(?:to_eq)?(\d\d))?|(appendix_f))(?=_)")


def mentioned_equations(text: str) -> set[str]:
    """Return the labels of the paper's equations that a text mentions.

    "Eqs 2-4" stands for three. An equation of another paper is left out: it follows "et al." in
    the same clause ("Zhou et al. 2019, Eq. 15").
    """
    found = set()
    for clause in re.split(r"[;()]|\.\s*\n", text):
        for match in _MENTION.finditer(clause):
            if "et al." in clause[: match.start()]:
                continue
            if match.group(2) or match.group(3):
                found.add(match.group(2) or match.group(3))
            else:
                found |= {f"Eq. {number}" for number in _numbers(match.group(1))}
    return found & {equation.label for equation in EQUATIONS}


def _numbers(text: str) -> set[int]:
    """Read "2-4" or "10, 12 and 13"."""
    numbers = set()
    for part in re.split(r",|and", text):
        ends = [int(number) for number in re.findall(r"\d+", part)]
        if ends:
            numbers |= set(range(ends[0], ends[-1] + 1))
    return numbers


def equation_map(*, root=None) -> pd.DataFrame:
    """Collect where each equation of the paper lives.

    Args:
      root: a checkout with `f3amd_lib`, `tests` and `notebooks`; by default the one in use. A
        folder that is absent (an installed package has no tests) gives empty cells.

    Returns:
      One row per entry of `EQUATIONS`: equation, section (of the paper), what, functions, tests,
      notebooks, cells (numbers of the notebooks' sections that speak of it: "2.3" is in notebook
      02), figures (files that these sections draw). The last five hold names joined by ", ", ""
      where there are none.
    """
    root = Path(root) if root is not None else repository_root()
    kinds = ("functions", "tests", "notebooks", "cells", "figures")
    places = {equation.label: {kind: [] for kind in kinds} for equation in EQUATIONS}
    for path in sorted((root / "f3amd_lib").rglob("*.py")):
        module = path.relative_to(root / "f3amd_lib").with_suffix("").as_posix()
        if module.startswith("report/"):  # what draws and lists implements nothing
            continue
        for name, text in _documented(path):
            for label in mentioned_equations(text):
                places[label]["functions"].append(f"{module}: {name}")
    for path in sorted((root / "tests").glob("test_*.py")):
        for name, labels in _tests(path):
            for label in labels:
                places[label]["tests"].append(f"{path.stem}: {name}")
    for path in sorted((root / "notebooks").glob("[0-9][0-9]_*.ipynb")):
        # The reading guide shows this very map and explains none of it; solutions only repeat.
        if path.stem.startswith("00") or path.stem.endswith("_solutions"):
            continue
        text = _notebook_text(path)
        for label in mentioned_equations(text) | _displayed([text]):
            places[label]["notebooks"].append(path.stem)
        for section in notebook_sections(path):
            for label in section.equations if section.number else ():
                places[label]["cells"].append(section.number)
                places[label]["figures"] += section.figures
    return pd.DataFrame(
        [
            {"equation": item.label, "section": item.section, "what": item.what}
            | {kind: ", ".join(names) for kind, names in places[item.label].items()}
            for item in EQUATIONS
        ]
    )


def _documented(path: Path):
    """Yield (qualified name, docstring) of the classes, functions and methods of a file."""

    def visit(body, above: str):
        for node in body:
            if isinstance(node, (ast.ClassDef, ast.FunctionDef)):
                text = ast.get_docstring(node) or ""
                # Attributes of a config name equations that they belong to, but do not compute.
                yield above + node.name, re.sub(r"Attributes:.*?(\n\n|\Z)", "", text, flags=re.S)
                yield from visit(node.body, f"{above}{node.name}.")

    yield from visit(ast.parse(path.read_text(encoding="utf-8")).body, "")


def _tests(path: Path):
    """Yield (name, labels) of tests that carry an equation in their name or docstring."""
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.FunctionDef) and node.name.startswith("test_"):
            labels = mentioned_equations(ast.get_docstring(node) or "")
            named = _TEST_NAME.match(node.name)
            if named and named.group(3):
                labels |= {"Appendix F"}
            elif named:
                first, last = int(named.group(1)), int(named.group(2) or named.group(1))
                labels |= {f"Eq. {number}" for number in range(first, last + 1)}
            yield node.name, labels & {equation.label for equation in EQUATIONS}


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
        """The heading's own number, "2.3"; "" if it has none, as "What we learned" has."""
        found = re.match(r"\d+\.\d+(?= )", self.heading)
        return found[0] if found else ""


def notebook_sections(path) -> list[Section]:
    """Read the sections of a notebook in their order.

    Args:
      path: of the notebook. What stands before its first heading of the second level is its title
        page and in no section; deeper headings stay in the section they stand in.

    Returns:
      One entry per heading of the second level ("## ...").
    """
    texts: list[tuple[str, list[str], list[str]]] = []
    for cell in json.loads(Path(path).read_text(encoding="utf-8"))["cells"]:
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
        Section(heading, frozenset(mentioned_equations("\n\n".join(text)) | _displayed(text)),
                tuple(figures))
        for heading, text, figures in texts
    ]  # fmt: skip


def _displayed(texts: list[str]) -> set[str]:
    """Return the labels of displayed equations that carry the number, "\\qquad (11)$$"."""
    numbers = {match for text in texts for match in _DISPLAYED.findall(text)}
    found = {f"Eq. {part.strip()}" for number in numbers for part in number.split(",")}
    return found & {equation.label for equation in EQUATIONS}


def _kept_figures(source: str) -> list[str]:
    """Return the names under which a code cell keeps figures: `keep_figure(..., "02_paths")`."""
    names = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Call) and node.args and isinstance(node.args[-1], ast.Constant):
            called = ast.unparse(node.func).split(".")[-1]
            if called.startswith("keep_") and re.match(r"\d\d_", str(node.args[-1].value)):
                names.append((node.lineno, node.args[-1].value))
    return [name for _, name in sorted(names)]


def _notebook_text(path: Path) -> str:
    """Return the Markdown of a notebook, one cell a paragraph."""
    cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
    return "\n\n".join("".join(cell["source"]) for cell in cells if cell["cell_type"] == "markdown")


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
        where = record["device_kind"]
        if record["device_platform"] == "cpu":
            where = f"{record['cores']} CPU cores"
        finished = summary[summary["finished"]]
        seconds = finished["seconds"].round().astype("Int64")
        columns[f"{record['dataset']}, {record['profile']}, {where}"] = pd.Series(
            seconds.to_numpy(), index=finished["notebook"].str.removesuffix(".ipynb")
        ).astype("Int64")
    names = [path.stem for path in sorted((root / "notebooks").glob("[0-9][0-9]_*.ipynb"))]
    table = pd.DataFrame(columns, index=pd.Index(names, name="notebook"))
    return table.reset_index()
