"""The site's sources: notebooks, modules and data sets have their place, nothing is from outside.

Nothing is built here; `make site` does that, where Sphinx refuses a page that no table of contents names, and checks
its own links with what is tested below.
"""

import base64
import hashlib
import importlib.util
import json
import re
import runpy
import sys
import zipfile
from pathlib import Path

import nbformat
import pytest
from builders import refused

from f3amd_lib.motion.bvh import write_bvh
from f3amd_lib.motion.synthetic import synthesize

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
WORKFLOWS = sorted((ROOT / ".github" / "workflows").glob("*.yml"))


def load(path: Path):
    """A Python file of the site as a module; docs/ is no package."""
    spec = importlib.util.spec_from_file_location(f"site_{path.stem}", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


pages = load(DOCS / "_ext" / "pages.py")
links = load(DOCS / "check_links.py")


# Everything has its place


def test_every_public_module_is_on_one_page_of_the_library():
    rooms = [
        match[2]
        for path in sorted((DOCS / "api").glob("*.md"))
        for match in pages.INSERT.finditer(path.read_text(encoding="utf-8"))
        if match[1] == "room"
    ]
    shown = [name for room in rooms for name in pages.modules_of(room)]
    paths = [path for package in ("f3amd_lib", "f3amd_companion") for path in (ROOT / package).rglob("*.py")]
    files = [path.relative_to(ROOT).with_suffix("") for path in paths]
    public = {".".join(path.parts) for path in files if not path.name.startswith("_")}
    assert len(shown) == len(set(shown))
    assert public <= set(shown)


@pytest.mark.parametrize("dataset", ["bandai", "synthetic"])
def test_a_gallery_shows_every_figure_with_words_licence_and_notebook(dataset):
    text = pages.gallery_markdown(dataset)
    folder = ROOT / "paper_figures" / dataset / "laptop"
    figures = sorted(folder.glob("figures/*.png"))
    assert len(figures) > 40
    licence, credit = pages.credit_of(folder)
    for path in figures:
        place = text.index(f"/paper_figures/{dataset}/laptop/figures/{path.name}")
        alt, caption = re.match(r".*?:alt: (.+?)\n.*?\n\n(.+?)\n", text[place:], re.S).groups()
        assert pages.words(path.stem).lower() in alt.lower()
        assert path.stem in caption and licence in caption
    assert credit in text
    assert "/notebooks/05_rollout.ipynb" in text
    assert f"/paper_figures/{dataset}/laptop/media/05_rollout.gif" in text


def test_results_without_a_licence_are_not_shown(tmp_path, monkeypatch):
    folder = tmp_path / "paper_figures" / "new" / "laptop"
    (folder / "tables").mkdir(parents=True)
    (folder / "tables" / "00_x.json").write_text(json.dumps({"dataset_licence": None}))
    monkeypatch.setattr(pages, "ROOT", tmp_path)
    refused("paper_figures/new/laptop: no record names", pages.credit_of, folder)
    record = {"dataset_licence": "CC BY 4.0", "dataset_credit": "Somebody."}
    (folder / "tables" / "01_x.json").write_text(json.dumps(record))
    assert pages.credit_line(folder).endswith("Somebody. CC BY 4.0, with credit.")


def test_a_player_is_linked_where_it_is_written_to(tmp_path, monkeypatch):
    folder = tmp_path / "paper_figures" / "bandai" / "laptop"
    for name in ("figures/14_walker.png", "figures/05_film_strip.png", "media/14_walker.bvh"):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(b"")
    record = {"dataset_licence": "CC BY-NC 4.0", "dataset_credit": "Somebody."}
    (folder / "figures" / "14_walker.json").write_text(json.dumps(record))
    monkeypatch.setattr(pages, "ROOT", tmp_path)
    assert pages.players() == [(folder, "14_walker")]
    text = pages.moving_markdown("bandai")
    assert 'href="../../players/bandai/laptop/14_walker.html"' in text
    assert "/paper_figures/bandai/laptop/figures/14_walker.png" in text and "14_crowd" not in text
    monkeypatch.setattr(sys, "path", list(sys.path))
    players = load(DOCS / "players.py")
    monkeypatch.setattr(players, "pages", pages)
    write_bvh(folder / "media" / "14_walker.bvh", synthesize("Neutral", 1.0), overwrite=True)
    players.main(tmp_path / "site")
    page = (tmp_path / "site" / "players" / "bandai" / "laptop" / "14_walker.html").read_text(encoding="utf-8")
    assert "Somebody. CC BY-NC 4.0, for non-commercial use." in page
    assert set(players.WRITERS) == set(pages.PLAYERS)


def test_setup_is_folded_and_only_the_very_same_figure_is_shown_in_full_size():
    folder = ROOT / "paper_figures" / "synthetic" / "laptop" / "figures"
    full = (folder / "00_road_map.png").read_bytes()
    (drawn,) = (digest for digest, path in pages.full_figures().items() if path == folder / "00_road_map.png")
    data = {"image/png": base64.b64encode(b"light").decode()}
    outputs = [
        nbformat.v4.new_output("display_data", data, metadata={"image/png": {"full": digest}})
        for digest in (drawn, hashlib.sha256(b"another run").hexdigest())
    ]
    notebook = nbformat.v4.new_notebook(
        cells=[
            nbformat.v4.new_markdown_cell("# 00\n\n**Question.** Why?"),
            nbformat.v4.new_code_cell("seed = 0", metadata={"tags": ["parameters"]}),
            nbformat.v4.new_code_cell("import numpy as np\n\nx = np.ones(3)"),
            nbformat.v4.new_code_cell("print(x)  # no import here", outputs=outputs),
        ]
    )
    cells = pages.read_notebook(nbformat.writes(notebook)).cells
    assert ["hide-input" in cell.metadata.get("tags", ()) for cell in cells] == [False, True, True, False]
    same, other = cells[3].outputs
    assert base64.b64decode(same.data["image/png"]) == full
    assert other.data == data and "width" not in other.metadata["image/png"] and "width" in same.metadata["image/png"]


# Notebooks elsewhere


def test_every_notebook_fetches_the_library_from_the_address_of_the_project(tmp_path, monkeypatch):
    cells = load(ROOT / "scripts" / "install_cell.py")
    assert len(cells.NOTEBOOKS) > 35
    for path in cells.NOTEBOOKS:
        text = path.read_text(encoding="utf-8")
        assert cells.with_cell(text) == text, f"{path.name}: run scripts/install_cell.py"
    (tmp_path / "pyproject.toml").write_text('[project]\nurls.Repository = "https://github.com/owner/name"')
    monkeypatch.setattr(cells, "ROOT", tmp_path)
    assert 'repository = "https://github.com/owner/name"' in json.loads(cells.with_cell(text))["cells"][1]["source"][3]


def test_the_browser_gets_the_course_with_a_wheel_that_it_can_install(tmp_path):
    lite = load(DOCS / "lite.py")
    with zipfile.ZipFile(lite.write_wheel(tmp_path)) as wheel:
        names = wheel.namelist()
        (about,) = (name for name in names if name.endswith("METADATA"))
        needs = re.findall(r"^Requires-Dist: (\w+)$", wheel.read(about).decode(), re.M)
    assert {"numpy", "scipy", "pandas", "matplotlib", "pillow"} == set(needs)
    assert {"f3amd_lib/drawing/colors.toml", "f3amd_notebooks/labs/__init__.py"} <= set(names)
    assert not [name for name in names if name.endswith((".safetensors", ".pyc"))]
    notebook = lite.in_a_tab(json.loads((ROOT / "notebooks/course/01_score.ipynb").read_text(encoding="utf-8")))
    assert sum(cell["source"] == "%pip install -q f3amd_lib" for cell in notebook["cells"]) == 1


# Nothing from outside


def test_neither_settings_nor_styles_nor_scripts_name_an_address(monkeypatch):
    for path in [DOCS / "conf.py", *(DOCS / "_static").iterdir(), *(DOCS / "_extra").iterdir()]:
        text = path.read_text(encoding="utf-8").replace("http://www.w3.org/2000/svg", "")
        assert not re.search(r"https?://|//cdn|@import|url\(['\"]?//", text), path.name
    monkeypatch.setattr(sys, "path", list(sys.path))
    monkeypatch.setenv("JAX_PLATFORMS", "cpu")
    settings = runpy.run_path(str(DOCS / "conf.py"))
    assert settings["mathjax_path"] == "mathjax/tex-svg-full.js"
    assert "sphinx.ext.intersphinx" not in settings["extensions"]  # it would fetch
    assert settings["html_theme_options"].get("analytics") is None


# The link checker, on a site that is right and on ones that are wrong in one way


def write_site(folder: Path, body: str) -> Path:
    (folder / "sub").mkdir()
    (folder / "index.html").write_text(body, encoding="utf-8")
    (folder / "sub" / "other.html").write_text("<h1 id='here'>o</h1>", encoding="utf-8")
    (folder / "style.css").write_text("")
    return folder


def test_a_whole_site_has_no_faults(tmp_path):
    body = (
        "<link rel='stylesheet' href='style.css?v=1'><a href='sub/other.html#here'>a</a>"
        "<p id='p'><a href='#p'>b</a> <a href='https://example.org/x'>c</a>"
        "<img src='data:image/png;base64,' alt='a dot'> <a href='mailto:a@example.org'>d</a>"
    )
    assert links.check_site(write_site(tmp_path, body)) == ([], 1)


@pytest.mark.parametrize(
    "body, fault",
    [
        ("<a href='gone.html'>a</a>", "gone.html leads nowhere"),
        ("<img src='gone.png' alt='x'>", "gone.png leads nowhere"),
        ("<a href='sub/other.html#there'>a</a>", "sub/other.html#there: no such place"),
        ("<a href='/sub/other.html'>a</a>", "/sub/other.html leads out of"),
        ("<script src='https://example.org/a.js'></script>", "asks https://example.org/a.js"),
        ("<img srcset='sub/other.html 1x, gone.png 2x' alt='x'>", "gone.png leads nowhere"),
        ("<link rel='preload' imagesrcset='gone.png 2x'>", "gone.png leads nowhere"),
        ("<svg><use href='//example.org/a.svg#b'/></svg>", "asks //example.org/a.svg#b"),
        ("<style>@import 'https://example.org/a.css';</style>", "asks https://example.org/a.css"),
        ("<style>p { background: url(gone.png) }</style>", "gone.png leads nowhere"),
        ("<p id='p'><iframe srcdoc='<a href=#p>b</a>'></iframe>", "#p: no such place"),
        ("<iframe srcdoc='<iframe srcdoc=&quot;<style>p{src:url(//a.org/f)}</style>&quot;>'>", "asks //a.org/f"),
        ("<img src='style.css' alt='a_1.png'>", "image style.css has no alternative text"),
    ],
)
def test_each_fault_of_a_site_is_found(tmp_path, body, fault):
    (found,) = links.check_site(write_site(tmp_path, body))[0]
    assert found.startswith("index.html: ") and fault in found


# Building and publishing


def test_actions_are_pinned_to_commits():
    lines = [line for path in WORKFLOWS for line in re.findall(r"uses: (.+)", path.read_text(encoding="utf-8"))]
    assert len(lines) == 6
    for line in lines:
        assert re.fullmatch(r"actions/[\w-]+@[0-9a-f]{40} # v\d+(\.\d+)*", line), line


@pytest.mark.needs("sphinx")
def test_an_altered_mathjax_is_refused(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(str(DOCS / "_ext"))
    companion = load(DOCS / "_ext" / "companion.py")

    class App:
        outdir = tmp_path / "html"

    companion.copy_mathjax(App)
    copied = tmp_path / "html" / "_static" / "mathjax"
    assert "Apache License" in (copied / "LICENSE").read_text(encoding="utf-8")
    assert (copied / "tex-svg-full.js").stat().st_size > 2_000_000
    monkeypatch.setattr(companion, "MATHJAX_SHA256", "0" * 64)
    with pytest.raises(companion.ExtensionError, match="not MathJax 3.2.2 as published"):
        companion.copy_mathjax(App)
