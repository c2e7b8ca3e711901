"""The page of differences: each row says where it is shown, and that place is there."""

import re
from pathlib import Path

import pytest
from f3amd_notebooks.equation_map import notebook_sections

from f3amd_lib.ground.papers import load_paper_file

ROOT = Path(__file__).resolve().parents[1]
TEXT = (ROOT / "docs/differences.md").read_text(encoding="utf-8")
ROWS = [
    [cell.strip() for cell in line.strip("|").split(" | ")]
    for line in TEXT.splitlines()
    if line.startswith("| ") and not line.startswith("| in print")
]


def missing(see: str) -> list[str]:
    """Which references of a cell lead nowhere: links, functions, tests and open points."""
    wrong = []
    for text, path in re.findall(r"\[([^\]]+)\]\(([^)]+)\)", see):
        file = ROOT / path.lstrip("/") if path.startswith("/") else ROOT / "docs" / path
        there = file.is_file()
        if there and file.suffix == ".ipynb" and "." in text:
            there = text in [section.number for section in notebook_sections(file)]
        wrong += [] if there else [f"[{text}]({path})"]
    return wrong + [name for name in re.findall(r"`([^`]+)`", see) if not named(name)]


def named(name: str) -> bool:
    """Whether `room/module.function`, `tests/test_x.test_y`, `paper/readings: point` or a CSV file is there."""
    if name.endswith(".csv"):
        return (ROOT / "f3amd_lib" / name).is_file()
    paper, _, point = name.partition("/readings: ")
    if point:
        return point in [entry["point"] for entry in load_paper_file("readings", paper)["reading"]]
    module, *names = name.split(".")
    folders = [ROOT] if module.startswith("tests/") else [ROOT / "f3amd_lib", ROOT / "f3amd_companion"]
    texts = [path.read_text(encoding="utf-8") for folder in folders if (path := folder / f"{module}.py").is_file()]
    there = lambda word: re.search(rf"^ *(class|def) {word}\b", texts[0], re.M)
    return bool(texts) and all(map(there, names))


@pytest.mark.parametrize("row", ROWS, ids=[row[0][:40] for row in ROWS])
def test_a_row_says_where_it_is_shown_and_that_is_there(row):
    assert re.search(r"`|\]\(", row[3]) and missing(row[3]) == []


@pytest.mark.parametrize(
    "wrong",
    [
        "[2.9](/notebooks/02_sampler_theory.ipynb)",
        "`diffusion/samplers.ddim_stride`",
        "`tests/test_samplers.test_nothing`",
        "`papers/acmdm/numbers/acmdm_table44.csv`",
        "`acmdm/readings: direction of space`",
    ],
)
def test_a_reference_that_leads_nowhere_is_found(wrong):
    right = "[2.3](/notebooks/02_sampler_theory.ipynb), `diffusion/schedules.NoiseSchedule.times`"
    assert missing(f"{right}, {wrong}") == [wrong.strip("`")]
