"""From equation to code: a table that is read off the code itself, so that it cannot go stale.

Docstrings of the library say which equation of the paper a function implements ("Eq. 9",
"Eqs 2-4", "Appendix F"). This module collects them, together with the tests and the notebooks that
mention the same equation. Nothing is imported for it: source files are parsed.
"""

from __future__ import annotations

import ast
import json
import re
from dataclasses import dataclass
from pathlib import Path

import pandas as pd

from f3amd_lib.profiles import repository_root

__all__ = ["EQUATIONS", "Equation", "equation_map", "mentioned_equations"]


@dataclass(frozen=True)
class Equation:
    """An equation of the paper.

    Attributes:
      label: "Eq. 9", or "Appendix F" for the unnumbered update.
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
)
"""All equations of the paper that carry a number, and the update of Appendix F."""

_MENTION = re.compile(r"\bEqs?\.?\s+((?:\d+(?:\s*(?:-|,|and|to)\s*)?)+)|\b(Appendix F)\b")
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
            if match.group(2):
                found.add("Appendix F")
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
      One row per entry of `EQUATIONS`: equation, section, what, functions, tests, notebooks; the
      last three hold names joined by ", ", "" where there are none.
    """
    root = Path(root) if root is not None else repository_root()
    places = {equation.label: {"functions": [], "tests": [], "notebooks": []}
              for equation in EQUATIONS}  # fmt: skip
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
        # The reading guide shows this very map and explains none of it.
        if not path.stem.startswith("00"):
            for label in mentioned_equations(_notebook_text(path)):
                places[label]["notebooks"].append(path.stem)
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


def _notebook_text(path: Path) -> str:
    """Return the Markdown of a notebook, one cell a paragraph."""
    cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
    return "\n\n".join("".join(cell["source"]) for cell in cells if cell["cell_type"] == "markdown")
