"""What is committed is fit to be read: notebooks are whole, and no file tells of a machine.

nbval checks that the notebooks still compute what they show; here is what it cannot see.
"""

import ast
import base64
import io
import json
import re
import subprocess
from pathlib import Path

import nbformat
import numpy as np
import pytest
from builders import cut_off
from PIL import Image

ROOT = Path(__file__).resolve().parents[1]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
COURSE = sorted((ROOT / "notebooks/course").glob("*.ipynb"))
STANDALONE = sorted((ROOT / "notebooks/standalone").glob("*.ipynb"))
PATH = ROOT / "notebooks/00_beside_the_paper.ipynb"  # has the number of the reading guide, and writes nothing
LARGEST_NOTEBOOK, LARGEST_PATH, MOVING = 250_000, 1_500_000, 160_000  # bytes; one moving picture comes on top
LARGEST_FILE = 5_000_000  # bytes
ALL_WEIGHTS = 28_000_000  # bytes of f3amd_lib/pretrained/ together

# Folders that stand for somebody's computer; a slash before, so that web addresses do not match.
# The names are put together here, so that this file does not hold what it looks for.
_FOLDERS = "|".join(("root", "work", "tmp", r"home/[\w.-]+", r"Users/[\w.-]+", "opt", "mnt"))
MACHINE_PATH = re.compile(rf"(?<![\w.\-/:<>])/(?:{_FOLDERS})/|\b[A-Z]:\\\\?(?:Users|Temp)\b")

BINARY = {".png", ".gif", ".webp", ".npz", ".safetensors", ".jpg", ".pdf"}


def prose(notebook) -> list[str]:
    """What a notebook's cells of text say."""
    return [cell.source for cell in notebook.cells if cell.cell_type == "markdown"]


def notebook_faults(path: Path, *, numbered: bool = True) -> list[str]:
    """Everything about a notebook file that should not be committed, one sentence each.

    One that is not numbered stands alone, or in the course: no data set and no profile is chosen for it,
    so that it needs no parameters.
    """
    faults = []
    text = path.read_text(encoding="utf-8")
    largest = LARGEST_PATH if path == PATH else LARGEST_NOTEBOOK + MOVING * ("data:image/webp" in text)
    if len(text.encode()) >= largest:
        faults.append(f"{len(text.encode())} bytes, limit {largest}")
    if numbered and not re.fullmatch(r"\d\d_[a-z0-9_]+\.ipynb", path.name):
        faults.append("name is not NN_words.ipynb")
    if MACHINE_PATH.search(text):
        faults.append(f"absolute path {MACHINE_PATH.search(text)[0]!r}")
    notebook = nbformat.reads(text, as_version=4)
    if notebook.metadata.get("kernelspec", {}).get("name") != "python3":
        faults.append("kernel is not python3")
    if "papermill" in notebook.metadata or any("papermill" in c.metadata for c in notebook.cells):
        faults.append("papermill metadata")
    if "widgets" in notebook.metadata or "application/vnd.jupyter.widget" in text:
        faults.append("widget state")

    formulas = " ".join(re.findall(r"\$[^$\n]+\$", " ".join(prose(notebook))))
    if doubled := re.search(r"\\\\[A-Za-z]+", formulas):
        faults.append(f"{doubled[0]} ends a line where a sign is meant")

    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    if any(not cell.source.strip() for cell in code):
        faults.append("empty code cell")
    counts = [cell.execution_count for cell in code]
    if counts != list(range(1, len(code) + 1)):
        faults.append(f"execution counts {counts} are not those of one run from top to bottom")
    if any(output.output_type == "error" for cell in code for output in cell.outputs):
        faults.append("error output")
    # Drawn and only saved: the picture was not the cell's last value. A semicolon says that a slider shows it.
    for cell in code:
        kept = re.search(r"\bkeep_figure\(.*", cell.source, flags=re.S)
        shown = any("image/png" in output.get("data", {}) for output in cell.outputs)
        if kept and not shown and not kept[0].rstrip().endswith(";"):
            faults.append(f"a picture is drawn and not shown: {kept[0].splitlines()[0]}")
    hidden = lambda cell: cell.metadata.get("jupyter", {}).get("source_hidden", False)
    if any(("hide-input" in tags_of(cell)) != hidden(cell) for cell in code):
        faults.append("a cell is folded on the site or in JupyterLab, and not in both")
    if not any("nbval-check-output" in tags_of(cell) for cell in code):
        faults.append("no cell is tagged nbval-check-output")
    if not all(cell.outputs for cell in code if "nbval-check-output" in tags_of(cell)):
        faults.append("a cell tagged nbval-check-output has no output to check")
    return faults + (parameter_faults(code) if numbered else [])


def parameter_faults(code_cells) -> list[str]:
    """What is wrong with the cell that papermill reads parameters from."""
    tagged = [cell for cell in code_cells if "parameters" in tags_of(cell)]
    if len(tagged) != 1:
        return [f"{len(tagged)} cells are tagged parameters"]
    values = {}
    faults = []
    for statement in ast.parse(tagged[0].source).body:
        try:
            (target,) = statement.targets
            values[target.id] = ast.literal_eval(statement.value)
        except (AttributeError, ValueError):
            # Papermill puts new values after this cell: what is derived in it would be stale.
            faults.append(f"parameters cell holds more than literals: {ast.unparse(statement)!r}")
    if values.get("profile") != "smoke":
        faults.append("profile is not 'smoke' by default")
    if values.get("data") != "synthetic":
        faults.append("data is not 'synthetic' by default")
    return faults


def tags_of(cell) -> list[str]:
    return cell.metadata.get("tags", [])


def tracked_files() -> list[Path]:
    """Files that git tracks, or would if everything were added."""
    words = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    listing = subprocess.run(words, cwd=ROOT, capture_output=True, text=True)
    if listing.returncode:
        pytest.skip("not a git checkout: nothing says which files belong to it")
    paths = [ROOT / name for name in listing.stdout.split("\0") if name]
    return [path for path in paths if path.is_file()]  # one may be deleted, not yet committed


def repository_faults(paths, root: Path) -> list[str]:
    """Files that should not be committed, one sentence each."""
    faults = []
    weights = [path for path in paths if path.suffix == ".safetensors"]
    size = sum(path.stat().st_size for path in weights)
    if size > ALL_WEIGHTS:
        faults.append(f"weights: {size} bytes together, limit {ALL_WEIGHTS}")
    for path in paths:
        name = path.relative_to(root).as_posix()
        shipped = re.fullmatch(r"f3amd_lib/pretrained/[^/]+/[^/]+\.safetensors", name)
        if path.stat().st_size > LARGEST_FILE and not shipped:
            faults.append(f"{name}: {path.stat().st_size} bytes, limit {LARGEST_FILE}")
        if path.suffix in (".bvh", ".zip") and not re.fullmatch(r"paper_figures/[^/]+/[^/]+/media/[^/]+\.bvh", name):
            faults.append(f"{name}: motion data does not belong in the repository")
        if path.suffix == ".ipynb" and not re.fullmatch(r"notebooks/((course|standalone)/)?[^/]+", name):
            faults.append(f"{name}: notebooks lie in notebooks/, its course/ or its standalone/")
        if path.suffix not in BINARY:
            found = MACHINE_PATH.search(path.read_text(encoding="utf-8", errors="replace"))
            if found:
                faults.append(f"{name}: path of a machine, {found[0]!r}")
    return faults


@pytest.mark.parametrize("path", NOTEBOOKS + COURSE + STANDALONE, ids=lambda path: path.stem)
def test_notebook_is_fit_to_be_read(path):
    assert notebook_faults(path, numbered=path in NOTEBOOKS) == []
    if path in COURSE:
        assert re.fullmatch(r"\d\d_[a-z0-9_]+\.ipynb", path.name)
        assert not re.search(r"keep_figure|write_table", path.read_text(encoding="utf-8")), "the course stores nothing"


def written_names(path: Path) -> list[re.Pattern]:
    """Names of results that a notebook writes, "12_svd"; a part in braces may be anything."""
    code = "\n".join(
        cell.source for cell in nbformat.v4.reads(path.read_text("utf-8")).cells if cell.cell_type == "code"
    )
    names = re.findall(rf"[\"'/]({path.name[:2]}_[\w{{}}:]+)", code)
    return [re.compile(re.sub(r"\{[^}]*\}", r"\\w+", name)) for name in names]


def orphans(results, notebooks) -> list[str]:
    """Numbered figures, tables and pictures that no notebook of their number writes."""
    written = {path.name[:2]: written_names(path) for path in notebooks}
    numbered = [path for path in results if re.match(r"\d\d_", path.name)]
    return [
        path.as_posix()
        for path in numbered
        if not any(name.fullmatch(path.name.split(".")[0]) for name in written.get(path.name[:2], []))
    ]


def test_every_committed_result_is_one_that_a_notebook_writes():
    results = [path for path in tracked_files() if "paper_figures" in path.parts]
    assert orphans(results, NOTEBOOKS) == []


def test_a_result_that_nothing_writes_is_found(tmp_path):
    source = 'keep_figure(figure, results, "03_one")\nwrite_table(results / f"03_table_{number:02d}.csv")'
    notebook = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(source)])
    nbformat.write(notebook, tmp_path / "03_words.ipynb")
    names = ("03_one.png", "03_table_07.csv", "03_two.png", "03_one_more.json", "04_one.png", "records.csv")
    found = orphans(map(Path, names), [tmp_path / "03_words.ipynb"])
    assert found == ["03_two.png", "03_one_more.json", "04_one.png"]


def test_no_committed_figure_is_cut_off():
    figures = [path for path in tracked_files() if path.suffix == ".png" and "figures" in path.parts]
    assert figures
    assert [path.relative_to(ROOT).as_posix() for path in figures if cut_off(path)] == []


def test_no_picture_of_a_notebook_is_cut_off():
    pictures = [
        (f"{path.name}, cell {cell.id}", base64.b64decode("".join(output.data["image/png"])))
        for path in NOTEBOOKS + COURSE + STANDALONE
        for cell in nbformat.v4.reads(path.read_text("utf-8")).cells
        for output in cell.get("outputs", [])
        if "image/png" in output.get("data", {})
    ]
    assert pictures
    assert [where for where, png in pictures if cut_off(io.BytesIO(png))] == []


@pytest.mark.parametrize("margin, expected", [(3, False), (-3, True)])
def test_a_cut_off_picture_is_found(tmp_path, margin, expected):
    grey = np.full((40, 60), 255, np.uint8)
    grey[max(margin, 0) : 12 + margin, 10:30] = 0
    Image.fromarray(grey).save(tmp_path / "picture.png")
    assert cut_off(tmp_path / "picture.png") is expected


def test_repository_holds_nothing_it_should_not():
    assert repository_faults(tracked_files(), ROOT) == []


# The checks themselves, on a notebook that is right and on ones that are wrong in one way.


def good_notebook() -> dict:
    """A notebook that passes, as the JSON of its file."""
    parameters = nbformat.v4.new_code_cell('profile = "smoke"\ndata = "synthetic"\nseed = 0')
    parameters.metadata["tags"] = ["parameters"]
    parameters.execution_count = 1
    verdict = nbformat.v4.new_code_cell("print('agrees')")
    verdict.metadata["tags"] = ["nbval-check-output"]
    verdict.execution_count = 2
    verdict.outputs = [nbformat.v4.new_output("stream", text="agrees\n")]
    notebook = nbformat.v4.new_notebook(cells=[parameters, verdict])
    notebook.metadata["kernelspec"] = {"name": "python3", "display_name": "Python 3"}
    return json.loads(nbformat.writes(notebook))


def save(folder: Path, notebook: dict, name: str = "00_good.ipynb") -> Path:
    path = folder / name
    path.write_text(json.dumps(notebook), encoding="utf-8")
    return path


def test_a_good_notebook_has_no_faults(tmp_path):
    notebook = good_notebook()
    notebook["cells"].append(said(r"Divided by $\alpha_t$: two lines, $$a \\ b$$."))
    assert notebook_faults(save(tmp_path, notebook)) == []
    notebook["cells"][1]["source"] = "print('agrees')\nkeep_figure(figure, results, 'name');"
    assert notebook_faults(save(tmp_path, notebook)) == []


def set_parameters(source):
    return lambda notebook: notebook["cells"][0].update(source=source)


def set_verdict(**changes):
    return lambda notebook: notebook["cells"][1].update(changes)


def said(source):
    """A cell of text."""
    return {"cell_type": "markdown", "metadata": {}, "source": source, "id": "said"}


ERROR_OUTPUT = {"output_type": "error", "ename": "E", "evalue": "", "traceback": []}
ELSEWHERE = "/" + "home/somebody/motion.bvh"


@pytest.mark.parametrize(
    "spoil, fault",
    [
        (set_verdict(execution_count=None), "execution counts"),
        (set_verdict(outputs=[ERROR_OUTPUT]), "error output"),
        (set_verdict(outputs=[]), "has no output to check"),
        (set_verdict(metadata={}), "no cell is tagged nbval-check-output"),
        (set_verdict(source=f"open('{ELSEWHERE}')"), "absolute path"),
        (set_verdict(source="x" * LARGEST_NOTEBOOK), "limit 250000"),
        (set_verdict(metadata={"tags": ["hide-input", "nbval-check-output"]}), "folded on the site or in JupyterLab"),
        (set_verdict(source="  "), "empty code cell"),
        (set_verdict(source="keep_figure(figure, results, 'name')\ntable"), "drawn and not shown: keep_figure(figure"),
        (lambda notebook: notebook["cells"].append(said(r"Divided by $\\alpha_t$.")), r"\\alpha ends a line"),
        (set_verdict(metadata={"papermill": {}}), "papermill metadata"),
        (lambda notebook: notebook["metadata"].update(papermill={}), "papermill metadata"),
        (lambda notebook: notebook["metadata"].update(widgets={}), "widget state"),
        (lambda notebook: notebook["metadata"]["kernelspec"].update(name="my-env"), "kernel is not python3"),
        (set_parameters('profile = "laptop"\ndata = "synthetic"'), "profile is not 'smoke'"),
        (set_parameters('profile = "smoke"\ndata = "bandai"'), "data is not 'synthetic'"),
        (set_parameters("rounds = 2 * 40"), "more than literals: 'rounds = 2 * 40'"),
        (set_parameters("import os"), "more than literals: 'import os'"),
        (lambda notebook: notebook["cells"][0]["metadata"].update(tags=[]), "0 cells are tagged parameters"),
    ],
)
def test_each_fault_of_a_notebook_is_found(tmp_path, spoil, fault):
    notebook = good_notebook()
    spoil(notebook)
    assert any(fault in found for found in notebook_faults(save(tmp_path, notebook)))


@pytest.mark.parametrize(
    "name, content, fault",
    [
        ("walk.bvh", "HIERARCHY", "motion data"),
        ("paper_figures/bandai/laptop/tables/walk.bvh", "HIERARCHY", "motion data"),
        ("paper_figures/bandai/laptop/media/walk.zip", "", "motion data"),
        ("paper_figures/copy.ipynb", "{}", "notebooks lie in"),
        ("notebooks/drafts/copy.ipynb", "{}", "notebooks lie in"),
        ("notes.md", f"see {ELSEWHERE}", "path of a machine"),
        ("large.npz", "x" * (LARGEST_FILE + 1), "limit 5000000"),
        ("f3amd_lib/pretrained/large.npz", "x" * (LARGEST_FILE + 1), "limit 5000000"),
    ],
)
def test_each_fault_of_the_repository_is_found(tmp_path, name, content, fault):
    path = tmp_path / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(content)
    (found,) = repository_faults([path], tmp_path)
    assert found.startswith(name) and fault in found
