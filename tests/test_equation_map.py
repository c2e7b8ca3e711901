"""The map from equations to code, and the list of open points."""

import ast
import functools
import json

import pandas as pd
import pytest
from builders import refused
from f3amd_notebooks import equation_map as map_module
from f3amd_notebooks.equation_map import mentioned_equations
from f3amd_notebooks.readings import fill_reading, readings_table
from f3amd_notebooks.stored_result import running_times

from f3amd_lib.ground import papers
from f3amd_lib.ground.profiles import repository_root
from f3amd_lib.ground.records import run_record, write_table
from f3amd_lib.networks.f3amd import F3AMDConfig


@pytest.fixture(scope="module", autouse=True)
def files_are_read_once():
    """Each file is parsed, and each folder looked through, once for all tests."""
    documented = map_module._documented
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(map_module, "_documented", functools.cache(lambda path: tuple(documented(path))))
        patch.setattr(map_module, "_places", functools.cache(map_module._places))
        yield


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("noise of Eq. 8", {"Eq. 8"}),
        ("the block (Eqs 2-4)", {"Eq. 2", "Eq. 3", "Eq. 4"}),
        ("Eqs 5 to 7, and Eq. 14", {"Eq. 5", "Eq. 6", "Eq. 7", "Eq. 14"}),
        ("Eq. 9 (section 3.5; Karras et al. 2022, Eq. 5)", {"Eq. 9"}),
        ("Source: section 3.2; Zhou et al. 2019, Eq. 15.", set()),
        ("Eq. 81 and a sequence of 3", set()),
        ("alpha_t of Appendix F", {"Appendix F", "alpha_t"}),
        (r"with $\alpha_t = \sqrt{\alpha}$", {"alpha_t"}),
        (r"$\bar\alpha_t$, alpha_bar_t and my_alpha_t", set()),
        ("noise of F3AMD Eq. 8; ACMDM Eq. 2", {"Eq. 8"}),
    ],
)
def test_mentions_are_read(text, expected):
    mentioned = {label for folder, label in mentioned_equations(text) if folder == "f3amd"}
    assert mentioned & set(map_module.equation_labels("f3amd")) == expected


def write_notebook(path, *cells):
    """A notebook of (kind, source) cells, "text" or "code"."""
    kinds = {"text": "markdown", "code": "code"}
    cells = [{"cell_type": kinds[kind], "source": [source]} for kind, source in cells]
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps({"cells": cells}), encoding="utf-8")
    return path


LOSSES = (
    ("text", "# 04 · Losses (Eqs 2-4)\n\nA title page about Eq. 1."),
    ("code", 'keep_figure(before, results, "04_title_page")'),
    ("text", "## 4.1 Batches\n\nText.\n\n## 4.2 Losses\n\n$$a \\qquad (11)$$"),
    ("text", "$$b \\qquad (14, 4.1)$$"),
    ("text", "### Closer\n\nAs $f(10)$ says, $$x = g(9)$$"),
    ("code", 'keep_film(frames, results, "04_film")'),
    ("code", "assert ok  # Eqs 12 and 13"),
    ("code", 'plots.keep_figure(\n    figure(4),\n    results,\n    "04_terms",\n)'),
    ("text", "and Eq. 10.\n\n## What we learned\n\nEq. 8."),
    ("code", 'open("04_not_kept")'),
)  # fmt: skip


def test_sections_know_their_equations_and_figures(tmp_path):
    sections = map_module.notebook_sections(write_notebook(tmp_path / "04_losses.ipynb", *LOSSES))
    assert [section.heading for section in sections] == ["4.1 Batches", "4.2 Losses",
                                                         "What we learned"]  # fmt: skip
    assert [section.number for section in sections] == ["4.1", "4.2", ""]
    assert sections[0].equations == set() and sections[0].figures == []
    assert sections[1].equations == {("f3amd", f"Eq. {number}") for number in (10, 11, 12, 13, 14)}
    assert sections[1].figures == ["04_film", "04_terms"]
    assert sections[2].equations == {("f3amd", "Eq. 8")} and sections[2].figures == []


def test_the_map_points_to_sections_and_their_figures(tmp_path):
    write_notebook(tmp_path / "notebooks/04_losses.ipynb", *LOSSES)
    write_notebook(tmp_path / "notebooks/13_exercise_solutions.ipynb", ("text", "## 13.1\n\nEq. 11"))
    write_notebook(tmp_path / "notebooks/00_guide.ipynb", ("text", "## 0.1 Map\n\nEq. 11"))
    rows = map_module.equation_map(root=tmp_path).set_index("equation")
    assert rows.loc["Eq. 11", ["notebooks", "cells", "figures"]].tolist() == [
        "04_losses", "4.2", "04_film, 04_terms",
    ]  # fmt: skip
    assert rows.loc["Eq. 1", ["notebooks", "cells", "figures"]].tolist() == ["04_losses", "", ""]
    assert rows.loc["Eq. 8", "cells"] == ""  # a summary explains nothing
    assert rows.loc["alpha_t", "notebooks"] == ""


def test_every_equation_of_the_paper_has_an_entry_in_every_column():
    table = map_module.equation_map().set_index("equation")
    assert len(table) == 16 and (table[["functions", "tests", "notebooks", "cells", "figures"]] != "").all(axis=None)
    found = table.loc["Eq. 9"]
    assert "diffusion/schedules: variance_exploding" in found.functions
    assert "2.3" in found.cells and "02_schedule" in found.figures


# --------------------------------------------------------------------------------------------- the page, and all papers


@pytest.mark.parametrize("paper", papers.paper_folders())
def test_every_numbered_equation_of_a_paper_has_code_or_a_reason(paper):
    about = papers.load_paper_file("paper", paper)
    numbers = [int(label[4:]) for label in map_module.equation_labels(paper) if label.startswith("Eq. ")]
    assert numbers == [*range(1, about["numbered_equations"] + 1)]
    computed = dict(map_module.equation_map(paper=paper)[["equation", "functions"]].itertuples(index=False))
    for entry in about["equation"]:
        assert bool(computed[entry["label"]]) != bool(entry.get("cited_only")), entry["label"]


def test_the_committed_page_is_what_the_code_says():
    page = (repository_root() / "docs/equations.md").read_text(encoding="utf-8")
    assert page == map_module.equations_markdown(), "write it again: python -m f3amd_notebooks.equation_map"
    for paper in papers.paper_folders():
        table = page.split(f"## {papers.load_paper_file('paper', paper)['name']}\n")[1].split("\n## ")[0]
        assert [line.split(" | ")[0][2:] for line in table.splitlines()[3:]] == map_module.equation_labels(paper)


def unknown_equations(mentions) -> list[str]:
    """Return equations that are mentioned and no paper has."""
    return sorted(f"{paper} {label}" for paper, label in mentions if label not in map_module.equation_labels(paper))


def test_docstrings_and_tests_name_equations_that_are_printed():
    root, wrong = repository_root(), []
    files = [*root.glob("f3amd_*/**/*.py"), *(root / "tests").glob("test_*.py")]
    for path in files:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef)):
                mentions = map_module.mentioned_equations(ast.get_docstring(node) or "")
                unknown = unknown_equations(mentions | map_module.equations_in_name(getattr(node, "name", "")))
                wrong += [f"{path.name}: {name}" for name in unknown]
    assert len(files) > 100 and wrong == []


def test_running_times_are_those_of_the_records(tmp_path):
    for name in ("00_guide", "04_losses", "05_new"):
        write_notebook(tmp_path / f"notebooks/{name}.ipynb", ("text", "# Title"))
    cpu = {"device_platform": "cpu", "device_kind": "cpu", "cores": 2}
    record = run_record(profile="laptop", dataset="synthetic", seed=0) | cpu
    names, finished = ["00_guide.ipynb", "04_losses.ipynb"], (True, False)  # one stopped: that is no time
    summary = pd.DataFrame({"notebook": names, "seconds": [3.4, 2.0], "cells": 1, "finished": finished})
    write_table(tmp_path / "paper_figures/synthetic/laptop/tables/run_summary.csv", summary, record)
    table = running_times(root=tmp_path).set_index("notebook")["synthetic, laptop, 2 CPU cores"]
    assert table.iloc[0] == 3 and table.isna().tolist() == [False, True, True]


def test_open_points_show_the_codes_own_defaults():
    table = readings_table().set_index("open point")["here"]
    assert table["kernel size k of Eq. 3"] == str(F3AMDConfig(channels=1, num_styles=1).kernel_size)
    assert table["scale of the noisy input"].startswith("input_scaling = True")
    assert not table.str.contains("{", regex=False).any()
    assert set(readings_table("data")["topic"]) == {"data"}
    refused("unknown topic", readings_table, "weather")


CONFIGS = {"F3AMDConfig": "f3amd_lib.networks.f3amd:F3AMDConfig"}
READING = {"topic": "data", "point": "noise", "paper": "not said", "here": "{}", "why": "so"}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"field": "F3AMDConfig.colour"}, "unknown setting of F3AMDConfig 'colour'"),
        ({"field": "F3AMDConfig.dropout", "reason": "so"}, "unknown key 'reason'"),
    ],
)
def test_a_broken_open_point_is_refused(changes, message):
    refused(f"f.toml, 'noise': .*{message}", fill_reading, READING | changes, "f.toml", CONFIGS)
    known = fill_reading(READING | {"field": "F3AMDConfig.dropout"}, "f.toml", CONFIGS)
    assert known == str(F3AMDConfig(channels=1, num_styles=1).dropout)


@pytest.mark.parametrize(
    ("text", "unknown"),
    [
        ("Eq. 9, MotionPCM Eqs 15 to 19 and ACMDM Eq. 2", []),
        ("the step of Eq. 15; ACMDM Eqs 2 and 3; as in CAMDM Eq. 30", ["acmdm Eq. 3", "f3amd Eq. 15", "f3amd Eq. 30"]),
    ],
)
def test_equations_that_no_paper_has_are_found(text, unknown):
    assert unknown_equations(mentioned_equations(text)) == unknown
