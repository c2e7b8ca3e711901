"""Write the lecture kit into the site: slides, a student's and a teacher's edition, and the labs for nbgrader.

    python docs/kit.py docs/_build/html

All of it comes from the notebooks and from `docs/lectures.md`, whose tables name the sections that a deck is made of.
Figures of the notebooks in `DRAWN` are drawn anew as SVG, which takes a run of each; those of others are as stored.
`make site` runs this.
"""

from __future__ import annotations

import re
import sys
import zipfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import nbformat
from nbclient import NotebookClient
from nbconvert import SlidesExporter
from nbconvert.preprocessors import TagRemovePreprocessor
from nbformat.v4 import new_code_cell, new_markdown_cell, new_notebook

DOCS = Path(__file__).resolve().parent
NOTEBOOKS = DOCS.parent / "notebooks"
sys.path.insert(0, str(DOCS.parent))

from f3amd_companion.serving.steer import package_file  # noqa: E402 (the line above is what finds it)

DRAWN = ("02_", "course/")
"""Notebooks whose pictures are drawn anew as SVG: they take seconds."""
SOLUTIONS = (
    "13_exercise_solutions",
    "course/11_first_solutions",
    "course/12_second_solutions",
    "course/14_lab_solutions",
)
TAUGHT = ("02_*", "1[0-2]_*", "18_*", "course/*")
"""What an edition holds, besides solutions."""
REVEAL = ("dist/reveal.css", "dist/reveal.js", "dist/theme/white.css", "plugin/notes/notes.js", "LICENSE")
LONGEST_CODE, SHORT = 16, 250
"""Lines of a cell that fits on a slide; characters of text that needs none of its own."""
TERMS = "Text and figures: CC BY 4.0, the F3AMD companion authors. Code: Apache 2.0."
AS_SVG = """\
import io
from f3amd_lib.drawing import style

show = style.show_figure

def drawn(figure, *_, **__):
    text, image = io.StringIO(), show(figure)
    figure.savefig(text, format="svg")
    image._repr_svg_ = text.getvalue
    return image

style.show_figure = style.keep_figure = drawn
"""


def read(name: str):
    """Return the notebook of this name, without its ending."""
    return nbformat.read(NOTEBOOKS / f"{name}.ipynb", as_version=4)


def lectures() -> list[dict]:
    """Return the lectures of `docs/lectures.md`: title, goals, sections as (notebook, start of a heading), the rest."""
    found = []
    for part in re.split(r"^## ", (DOCS / "lectures.md").read_text(encoding="utf-8"), flags=re.M)[1:]:
        title, _, text = part.partition("\n")
        goals, rest = re.search(r"^(Afterwards .*?)\n\n.*?\n\n(\*\*Board.*)", text, re.M | re.S).groups()
        sections = re.findall(r"\[(\S+) [^\]]+\]\(\.\./notebooks/(\S+)\.ipynb\) \|$", text, re.M)
        found.append(
            {"title": title, "goals": goals, "sections": [(name, head) for head, name in sections], "rest": rest}
        )
    return found


def run(name: str, heads: set):
    """Return a notebook, run up to the last of these sections with figures as SVG; outside `DRAWN` as stored."""
    notebook = read(name)
    if name.startswith(DRAWN):
        cells, wanted = notebook.cells, [id(cell) for head in heads for cell in section(notebook, head)]
        last = max(k for k, cell in enumerate(cells) if id(cell) in wanted)
        texts = [cell for cell in cells[last + 1 :] if cell.cell_type == "markdown"]
        notebook.cells = [new_code_cell(AS_SVG), *cells[: last + 1], *texts]
        NotebookClient(notebook, timeout=600, resources={"metadata": {"path": str(NOTEBOOKS)}}).execute()
        del notebook.cells[0]
    return notebook


def section(notebook, head: str) -> list:
    """Return the cells from the heading `## <head> ...` to the next one; ValueError where there is none."""
    cells = []
    for cell in notebook.cells:  # a cell that ends a section may begin the next one
        parts = re.split(r"\n(?=## )", cell.source) if cell.cell_type == "markdown" else []
        cells += [new_markdown_cell(part.strip()) for part in parts] or [cell]
    starts = [k for k, cell in enumerate(cells) if cell.cell_type == "markdown" and cell.source.startswith("## ")]
    for start, end in zip(starts, [*starts[1:], len(cells)], strict=True):
        if cells[start].source.startswith(f"## {head} "):
            return cells[start:end]
    raise ValueError(f"docs/lectures.md: no section {head}")


def slide(cell, kind: str):
    cell.metadata["slideshow"] = {"slide_type": kind}
    return cell


def slides_of(cells: list) -> list:
    """Return the cells of a section as slides: text, code that fits, and each figure with what is said below it."""
    made, under = [], False
    for cell in cells:
        if cell.cell_type == "markdown":
            text = cell.source
            belongs = len(text) < SHORT or under and text.startswith("*")  # the caption of a figure, or a closing line
            made.append(slide(cell, "slide" if text.startswith("## ") else "-" if belongs else "subslide"))
            under = False
            continue
        pictures = [out for out in cell.outputs if any(key.startswith("image/") for key in out.get("data", {}))]
        hidden = {"hide-input", "nbval-check-output"} & set(cell.metadata.get("tags", []))
        teaches = "def " in cell.source and "figure" not in cell.source
        if teaches and not hidden and len(cell.source.splitlines()) <= LONGEST_CODE:
            made.append(slide(new_code_cell(cell.source), "subslide"))
        if pictures:
            for out in pictures:
                if "image/svg+xml" in out.data:
                    del out.data["image/png"]
            shown = new_code_cell("", outputs=pictures)
            shown.metadata["tags"] = ["remove_input"]
            made.append(slide(shown, "subslide"))
            under = True
    return made


def deck(lecture: dict, notebooks: dict):
    """Return a lecture's slides as a notebook: goals, sections, the board, questions with answers below."""
    ask, _, answers = lecture["rest"].partition("<details>")
    answers, _, after = re.sub(r"<summary>.*?</summary>", "", answers).partition("</details>")
    first = (
        f"# {lecture['title']}\n\n{lecture['goals']}\n\n[The sheet](../docs/lectures.html)\n\n<small>{TERMS}</small>"
    )
    cells = [slide(new_markdown_cell(first), "slide")]
    for name, head in lecture["sections"]:
        cells += slides_of(section(notebooks[name], head))
    for text, kind in ((ask, "slide"), (f"**Answers.** {answers.strip()}", "subslide"), (after.strip(), "slide")):
        cells.append(slide(new_markdown_cell(text), kind))
    cells = [cell for cell in cells if cell.source.strip() or cell.cell_type == "code"]
    made = new_notebook(cells=cells, metadata={"title": lecture["title"]})
    for cell in made.cells:  # what links to other pages is plain text on a slide
        cell.source = re.sub(r"\[([^\]]+)\]\((?:[^):#]+\.(?:ipynb|md)|#)[^)]*\)", r"\1", cell.source)
    return made


def write_decks(folder: Path) -> None:
    """Write a page of slides a lecture, and what they load."""
    given = lectures()
    wanted = {}
    for name, head in (each for lecture in given for each in lecture["sections"]):
        wanted.setdefault(name, set()).add(head)
    with ThreadPoolExecutor(2) as pool:  # each runs a kernel
        notebooks = dict(zip(wanted, pool.map(run, *zip(*wanted.items(), strict=True)), strict=True))
    exporter = SlidesExporter(template_name="slides", extra_template_basedirs=[str(DOCS)], reveal_url_prefix="reveal",
                              reveal_theme="white", exclude_anchor_links=True)  # fmt: skip
    hide = TagRemovePreprocessor(remove_input_tags={"remove_input"}, enabled=True)
    exporter.register_preprocessor(hide, enabled=True)
    for number, lecture in enumerate(given, 1):
        text, _ = exporter.from_notebook_node(deck(lecture, notebooks))
        (folder / f"lecture_{number}.html").write_text(text, encoding="utf-8")
    for name in REVEAL:
        (folder / "reveal" / name).parent.mkdir(parents=True, exist_ok=True)
        content = package_file("reveal.js", name)
        if name.startswith("dist/theme/"):  # it asks for a font that no slide needs
            content = re.sub(rb"@import url\([^)]*\);?", b"", content)
        (folder / "reveal" / name).write_bytes(content)


# Editions -----------------------------------------------------------------------------------------


def asked(cell) -> str | None:
    """Return the number of the exercise or lab that a cell asks for, as in `check("C3.a", answer)`."""
    found = re.search(r'^(?:check|lab)\("([^"]+)", answer', cell.source, re.M) if cell.cell_type == "code" else None
    return found and found[1]


def solutions() -> dict[str, list]:
    """Return by number the reason and the code of each solution."""
    found = {}
    for name in SOLUTIONS:
        cells = read(name).cells
        found |= {asked(cell): [cells[k - 1], cell] for k, cell in enumerate(cells) if asked(cell)}
    return found


def editions(answers: dict[str, list]) -> dict[str, dict[str, object]]:
    """Return notebooks by path for students, and for teachers with each solution under its question."""
    made = {"student": {}, "teacher": {}}
    paths = sorted(path for pattern in TAUGHT for path in NOTEBOOKS.glob(f"{pattern}.ipynb"))
    for path in paths:
        name = path.relative_to(NOTEBOOKS).with_suffix("").as_posix()
        if name in SOLUTIONS:
            continue
        made["student"][name] = read(name)
        made["teacher"][name] = teacher = read(name)
        teacher.cells = [each for cell in teacher.cells for each in (cell, *answers.get(asked(cell), []))]
        for number, cell in enumerate(teacher.cells):
            cell.id = f"{cell.id}-{number}"  # a cell of another notebook may have had its name
    return made


def nbgrader_labs(answers: dict[str, list], seeds=(11, 12)) -> dict[str, object]:
    """Return a notebook a lab with nbgrader's marks: stub, solution, and a point if the judge passes hidden seeds."""
    labs, made, call = read("course/13_labs"), {}, re.compile(r"^lab\(.*\n?", re.M)
    for text, cell in zip(labs.cells[:-1], labs.cells[1:], strict=True):
        if not (number := asked(cell)):
            continue
        stub, solved = call.sub("", cell.source).rstrip(), call.sub("", answers[number][1].source).rstrip()
        source = f"{stub}\n\n\n### BEGIN SOLUTION\n{solved}\n### END SOLUTION"
        tests = (
            f'lab("{number}", answer)\n### BEGIN HIDDEN TESTS\nfrom f3amd_notebooks.labs import judge\n\n'
            f'for seed in {seeds}:\n    fault = judge("{number}", answer, seed).fault\n'
            "    assert fault is None, fault\n### END HIDDEN TESTS"
        )
        mark = {"schema_version": 3, "locked": False, "task": False}
        made[number] = new_notebook(
            cells=[
                new_markdown_cell(text.source, metadata={"nbgrader": mark | {
                    "grade": False, "solution": False, "locked": True, "grade_id": f"{number}-text"}}),
                new_code_cell(source, metadata={"nbgrader": mark | {
                    "grade": False, "solution": True, "grade_id": f"{number}-answer"}}),
                new_code_cell(tests, metadata={"nbgrader": mark | {
                    "grade": True, "solution": False, "locked": True, "points": 1, "grade_id": f"{number}-judge"}}),
            ],
            metadata=labs.metadata,
        )  # fmt: skip
    return made


NBGRADER_CONFIG = """\
c = get_config()
c.CourseDirectory.course_id = "diffusion_samplers"
c.ClearSolutions.code_stub = {"python": "# Put your code in the place of `...`."}
c.ExecutePreprocessor.timeout = 600
"""


def write_editions(folder: Path) -> None:
    """Write the archives for students, for teachers, and for nbgrader."""
    answers = solutions()
    for edition, notebooks in editions(answers).items():
        write_archive(folder / f"{edition}.zip", {f"{edition}/{name}.ipynb": each for name, each in notebooks.items()})
    labs = {f"nbgrader/source/{number}/{number}.ipynb": each for number, each in nbgrader_labs(answers).items()}
    write_archive(folder / "nbgrader.zip", labs | {"nbgrader/nbgrader_config.py": NBGRADER_CONFIG})


def write_archive(path: Path, files: dict) -> None:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in files.items():
            archive.writestr(name, content if isinstance(content, str) else nbformat.writes(content))


def link_kit(page: Path) -> None:
    """Put links to the kit into the page of the sheets; ValueError where it has not a heading for each lecture."""
    slides = r'\g<0><p><a href="../kit/lecture_\1.html">Slides</a></p>'
    text, found = re.subn(r"<h2>Lecture (\d+).*?</h2>", slides, page.read_text(encoding="utf-8"))
    if found != len(lectures()):
        raise ValueError(f"{page}: {found} headings, {len(lectures())} lectures")
    archives = ", ".join(f'<a href="../kit/{name}.zip">{name}.zip</a>' for name in ("student", "teacher", "nbgrader"))
    page.write_text(text.replace("</h1>", f"</h1><p>Notebooks: {archives}.</p>", 1), encoding="utf-8")


def main(site: Path) -> None:
    folder = site / "kit"
    folder.mkdir(exist_ok=True)
    write_editions(folder)
    write_decks(folder)
    link_kit(site / "docs" / "lectures.html")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
