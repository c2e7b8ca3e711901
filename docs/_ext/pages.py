"""What the pages of the site are made of, apart from Sphinx (see `companion`, which hooks it in).

Pages may hold a line `<!-- insert: NAME ARGUMENT -->`, which the functions of `INSERTS` replace by Markdown while the
site is built, and with it what follows until `<!-- until here -->`: that is for whoever reads the file itself.

- `room f3amd_lib.motion`: the docstrings of all modules of one room of the library;
- `gallery bandai`: figures, animations and players under `paper_figures/bandai/`;
- `moving`: animations and players of all data sets;
- `notebooks`, `notebooks course` or `notebooks standalone`: the notebooks, each with its question;
- `readme`: the README from its quick start on.
"""

from __future__ import annotations

import base64
import functools
import hashlib
import json
import re
import textwrap
from pathlib import Path, PurePosixPath

import nbformat
from PIL import Image

ROOT = Path(__file__).resolve().parents[2]

INSERT = re.compile(r"^<!-- insert: (\w+) ?([\w.]*) -->$(?:\n(?:(?!<!--).)*\n<!-- until here -->$)?", re.M | re.S)

# Licences whose terms a caption must repeat in words.
TERMS = {"CC BY-NC 4.0": "for non-commercial use", "CC BY 4.0": "with credit", "Apache-2.0": "as the code"}


# Rooms of the library -----------------------------------------------------------------------------


def modules_of(room: str) -> list[str]:
    """Return the public modules of a package, subpackages included, or the module itself.

    Args:
      room: dotted name, such as "f3amd_lib.motion" or "f3amd_lib.ground.profiles".

    Raises:
      ValueError: if there is neither such a folder nor such a file.
    """
    path = ROOT / room.replace(".", "/")
    if path.with_suffix(".py").is_file():
        return [room]
    if not path.is_dir():
        raise ValueError(f"insert: room {room}: there is no such package or module of the house")
    names = []
    for file in sorted(path.rglob("*.py")):
        parts = file.relative_to(ROOT).with_suffix("").parts
        if parts[-1] == "__init__":
            # One with a docstring alone is the room's own sentence, which the page says itself.
            if len(file.read_text(encoding="utf-8").splitlines()) > 3:
                names.append(".".join(parts[:-1]))
        elif not parts[-1].startswith("_"):
            names.append(".".join(parts))
    return names


def room_markdown(room: str) -> str:
    """Return one section a module, each with its docstrings."""
    sections = []
    for name in modules_of(room):
        title = name.partition(".")[2]
        sections.append(f"## `{title}`\n\n```{{eval-rst}}\n.. automodule:: {name}\n```\n")
    return "\n".join(sections)


# Gallery ------------------------------------------------------------------------------------------


def notebook_sections(path: Path) -> tuple[str, dict[str, str]]:
    """Read a notebook's title, and under which heading each of its figures is drawn.

    Args:
      path: the notebook's file.

    Returns:
      The title, and figure name -> heading. A name belongs to the last cell that holds it, quoted.
    """
    title, heading, headings = path.stem, "", {}
    for cell in nbformat.read(path, as_version=4).cells:
        if cell.cell_type == "markdown":
            for mark, text in re.findall(r"^(#{1,2}) +(.+)$", cell.source, re.M):
                if mark == "#":
                    title = text.strip()
                heading = text.strip()
        else:
            for name in re.findall(r"[\"'](\d\d_\w+)[\"']", cell.source):
                headings[name] = heading
    return title, headings


def notebooks_by_number() -> dict[str, Path]:
    """Return the main notebooks by their number, "00" first."""
    return {path.name[:2]: path for path in sorted((ROOT / "notebooks").glob("[0-9]*.ipynb"))}


def credit_of(folder: Path) -> tuple[str, str]:
    """Read under which terms a folder of results stands, and whom to credit.

    Args:
      folder: paper_figures/<data set>/<profile>.

    Returns:
      Licence and credit line, from the first record that names them.

    Raises:
      ValueError: if no record does; a picture is not shown without its terms.
    """
    for path in sorted(folder.glob("*/*.json")):
        record = json.loads(path.read_text(encoding="utf-8"))
        if isinstance(record, dict) and record.get("dataset_licence"):
            return record["dataset_licence"], record.get("dataset_credit") or ""
    raise ValueError(f"{folder.relative_to(ROOT)}: no record names the data set's licence")


def credit_line(folder: Path) -> str:
    """Return one sentence on data set, profile and terms of a folder of results."""
    licence, credit = credit_of(folder)
    terms = TERMS.get(licence, "")
    if licence not in credit:
        credit = f"{credit} {licence}" + (f", {terms}." if terms else ".")
    elif terms:
        credit = f"{credit} Shown {terms}."
    return f"Data set `{folder.parent.name}`, profile `{folder.name}`. {credit}"


def result_folders(dataset: str = "*") -> list[Path]:
    """Return the folders paper_figures/<data set>/<profile>, real motion first."""
    folders = [path for path in (ROOT / "paper_figures").glob(f"{dataset}/*") if path.is_dir()]
    return sorted(folders, key=lambda path: (path.parent.name == "synthetic", path.as_posix()))


def words(name: str) -> str:
    """Return a figure's name as words: "05_film_strip" is "film strip"."""
    return re.sub(r"^\d\d_", "", name).replace("_", " ")


def picture(path: Path, alt: str, caption: str, *, classes: str = "", target: str = "") -> str:
    """Return Markdown of one figure in a grid, which leads to its target, if it has one."""
    leads = f":target: {target}\n" if target else ""
    return (
        f"::::{{grid-item}}\n:::{{figure}} /{relative(path)}\n:alt: {alt}\n:loading: lazy\n"
        f"{leads}:class: gallery {classes}\n\n{caption}\n:::\n::::\n"
    )


def grid(items: list[str]) -> str:
    """Return Markdown of figures side by side, two in a row where there is room."""
    return "\n".join([":::::{grid} 1 1 2 2\n:gutter: 3\n", *items, ":::::\n"])


def moving_markdown(dataset: str = "", *, with_credit: bool = True) -> str:
    """Return animations (GIF, WebP) and players (HTML, behind a picture of what they play), with their terms."""
    items = []
    for folder in result_folders(dataset or "*"):
        credit = credit_line(folder) if with_credit else label_of(folder)
        moving = [path for path in (folder / "media").glob("*") if path.suffix in (".gif", ".webp")]
        moving += [folder / "figures" / f"{name}.png" for where, name in players() if where == folder]
        for path in sorted(moving, key=lambda path: path.name):
            notebook = notebooks_by_number().get(path.name[:2])
            source = f" From [notebook {path.name[:2]}](/{relative(notebook)})." if notebook else ""
            title = f"{words(path.stem).capitalize()} ({folder.parent.name})"
            if path.suffix != ".png":
                caption = f"**{title}.**{source} {credit}"
                items.append(picture(path, f"Animation: {title}", caption, classes="moving"))
            else:
                target = f"../../{player_address(folder, path.stem)}"
                caption = f'<a class="player" href="{target}">▶ Play: {title}</a>.{source} {credit}'
                items.append(picture(path, f"Play: {title}", caption, target=target))
    return grid(items) if items else ""


def gallery_markdown(dataset: str) -> str:
    """Return every figure of a data set, by notebook, with the question that it answers."""
    notebooks = notebooks_by_number()
    parts = [moving_markdown(dataset, with_credit=False)]
    for folder in result_folders(dataset):
        parts.insert(0, f"{credit_line(folder)}\n")
        figures = sorted((folder / "figures").glob("*.png"))
        for number in sorted({path.name[:2] for path in figures}):
            notebook = notebooks.get(number)
            title, headings = notebook_sections(notebook) if notebook else (number, {})
            parts.append(f"## {title}\n")
            if notebook:
                parts.append(f"[Open the notebook](/{relative(notebook)})\n")
            items = []
            for path in figures:
                if path.name[:2] == number:
                    heading = headings.get(path.stem, title)
                    alt = f"{words(path.stem).capitalize()}: figure of “{heading}”"
                    caption = f"**{heading}** `{path.stem}` · {label_of(folder)}"
                    items.append(picture(path, alt, caption))
            parts.append(grid(items))
    return "\n".join(parts)


def label_of(folder: Path) -> str:
    """Return data set, profile and licence of a folder of results, in few words."""
    return f"{folder.parent.name}, {folder.name}, {credit_of(folder)[0]}"


def relative(path: Path) -> str:
    """Return a path as seen from the root of the repository."""
    return path.relative_to(ROOT).as_posix()


# Notebooks ----------------------------------------------------------------------------------------


def read_notebook(text: str):
    """Read a notebook for the site: parameters and imports folded, figures in full size where there are some.

    The copy of a figure in a notebook is light. It carries the SHA-256 of the file in full size; where exactly
    that file is committed among the results, it is shown instead, at the size of its inches.

    Args:
      text: of the .ipynb file.

    Returns:
      The notebook, version 4.
    """
    notebook = nbformat.reads(text, as_version=4)
    for cell in notebook.cells:
        if cell.cell_type != "code":
            continue
        tags = set(cell.metadata.get("tags", ()))
        if "parameters" in tags or re.search(r"^(import|from) ", cell.source, re.M):
            cell.metadata["tags"] = sorted(tags | {"hide-input"})
        for output in cell.outputs:
            about = output.get("metadata", {}).get("image/png", {})
            file = full_figures().get(about.get("full"))
            if file:
                content = file.read_bytes()
                output.data["image/png"] = base64.b64encode(content).decode()
                with Image.open(file) as figure:
                    about["width"] = round(96 * figure.width / figure.info["dpi"][0])
    return notebook


@functools.cache
def full_figures() -> dict[str, Path]:
    """Return the committed figures by their SHA-256.

    One that was packed tighter since, without loss, says in a chunk `drawn` which it had when it was drawn.
    """
    found = {}
    for path in sorted((ROOT / "paper_figures").glob("*/*/**/figures/*.png")):
        with Image.open(path) as figure:
            found[figure.info.get("drawn") or hashlib.sha256(path.read_bytes()).hexdigest()] = path
    return found


def notebooks_markdown(folder: str = "") -> str:
    """Return a list of the notebooks of a folder below notebooks/, each with its question."""
    lines = []
    for path in sorted((ROOT / "notebooks" / folder).glob("*.ipynb")):
        text = nbformat.read(path, as_version=4).cells[0].source
        title = re.search(r"^# +(.+)$", text, re.M)
        question = re.search(r"\*\*Question\.\*\* +(.+?)(?:\n\n|\Z)", text, re.S)
        lines.append(f"- [**{title[1] if title else path.stem}**](/{relative(path)})")
        if question:
            lines.append(f"  <br>{' '.join(question[1].split())}")
    return "\n".join(lines) + "\n"


def readme_markdown(argument: str = "") -> str:
    """Return the README without its first page; its links are made to start at the root."""
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    text = text[text.index("## Quick start") :]
    return re.sub(r"\]\((?!#|/|[a-z]+:)", "](/", text)


def launch_options(address: str) -> dict:
    """Return the theme's options for a link to the repository, and buttons that open a notebook on Binder and Colab.

    Args:
      address: where everybody reaches the repository; "" gives no options, and no button. Colab opens notebooks of
        GitHub alone, so that another address gives the button for Binder only.

    Raises:
      ValueError: for anything else than an address of a repository.
    """
    if not address:
        return {}
    if not re.fullmatch(r"https://[\w.-]+(/[\w.-]+){2,}", address):
        raise ValueError(f"F3AMD_REPOSITORY must be an address such as https://github.com/owner/name, got {address!r}")
    buttons = {"binderhub_url": "https://mybinder.org", "notebook_interface": "jupyterlab"}
    if address.startswith("https://github.com/"):
        buttons["colab_url"] = "https://colab.research.google.com"
    shown = {"use_repository_button": True, "launch_buttons": buttons}
    return {"repository_url": address, "repository_branch": "main", **shown}


# Players ------------------------------------------------------------------------------------------


PLAYERS = ("14_crowd", "14_walker")
"""Figures with a player page behind them, which `docs/players.py` writes."""


def players() -> list[tuple[Path, str]]:
    """Return (folder of results, name) of each player page of the site."""
    return [(folder, name) for folder in result_folders() for name in PLAYERS
            if (folder / "figures" / f"{name}.png").is_file()]  # fmt: skip


def player_address(folder: Path, name: str) -> PurePosixPath:
    """Return where a player lies in the built site, from its root."""
    return PurePosixPath("players", *folder.relative_to(ROOT / "paper_figures").parts, f"{name}.html")


# Docstrings ---------------------------------------------------------------------------------------


def plain_line(line: str) -> str:
    """Return a line in which marks of reStructuredText mean themselves, but for `code`.

    A star that begins a line is left alone: it begins an item, or is that of `*arguments`.
    """
    lead, rest = re.match(r"(\s*\*{0,2})(.*)", line, re.S).groups()
    pieces = re.split(r"(`[^`]*`)", rest)
    for index in range(0, len(pieces), 2):
        pieces[index] = re.sub(r"([*|\\])", r"\\\1", pieces[index])
        pieces[index] = re.sub(r"(?<=\w)_(?!\w)", r"\\_", pieces[index])
        pieces[index] = pieces[index].replace("`", r"\`")
        if index and re.match(r"\w", pieces[index]):  # as in `Array`s
            pieces[index] = rf"\ {pieces[index]}"
    return lead + "".join(pieces)


ITEM = re.compile(r"[\w`.]+(, [\w`.]+)*: ")


def bulleted(block: list[str]) -> list[str]:
    """Return the text of a Returns section with its lists marked as such.

    Our docstrings list what is in a dict or a table by indentation alone: either names with hanging
    text ("name: text" and deeper lines), or a sentence and deeper lines, one an entry.

    Args:
      block: lines without common indentation, none of them blank.
    """
    depths = [len(line) - len(line.lstrip()) for line in block]
    if not any(depths):
        return block
    hanging = any(ITEM.match(line) and deeper for line, deeper in zip(block, depths[1:], strict=False))
    entry = 0 if hanging else min(filter(None, depths))
    result, listing = [], False
    for line, depth in zip(block, depths, strict=True):
        if depth == entry and (not hanging or ITEM.match(line)):
            result += ([] if listing else [""]) + [f"- {line.strip()}"]
            listing = True
        elif listing and depth > entry:
            result.append(f"  {line.strip()}")
        else:
            result += ([""] if listing else []) + [line.strip()]
            listing = False
    return result


def plain_lines(lines: list[str]) -> list[str]:
    """Return a docstring as reStructuredText with napoleon's sections, meaning the same."""
    lines = [plain_line(line) for line in lines]
    headings = [k for k, line in enumerate(lines) if line.strip() in ("Returns:", "Yields:")]
    if not headings:
        return lines
    start = headings[0]
    end = start + 1
    while end < len(lines) and lines[end].strip():
        end += 1
    indent = len(lines[start]) - len(lines[start].lstrip())
    block = bulleted(textwrap.dedent("\n".join(lines[start + 1 : end])).split("\n"))
    # The first colon of a sentence does not end the name of a type: put an empty name before it.
    block[0] = f": {block[0]}"
    return lines[: start + 1] + [" " * (indent + 2) + line for line in block] + lines[end:]


def equations(docstring: str) -> list[str]:
    """Return, as reStructuredText, the equations that a docstring names: what each says, and its formula as printed."""
    from f3amd_notebooks.equation_map import mentioned_equations

    from f3amd_lib.ground.papers import load_paper_file  # here: most pages have none

    lines, mentioned = [], mentioned_equations(docstring)
    for folder in sorted({paper for paper, _ in mentioned}):
        paper = load_paper_file("paper", folder)
        for entry in paper.get("equation", ()):
            if (folder, entry["label"]) in mentioned:
                lines += ["", f"*{paper['name']} {entry['label']}*: {entry['what']}", ""]
                lines += [f".. math:: {entry['formula']}", ""] if "formula" in entry else []
    return lines


# Texts --------------------------------------------------------------------------------------------


def first_sentence(text: str, limit: int = 200) -> str:
    """Return a text's first sentence, cut at a word if it is long."""
    text = " ".join(text.split())
    sentence = re.split(r"(?<=[.!?])\s+(?=[A-Z“])", text, maxsplit=1)[0]
    if len(sentence) <= limit:
        return sentence
    return sentence[:limit].rsplit(" ", 1)[0] + " …"


INSERTS = {
    "room": room_markdown,
    "gallery": gallery_markdown,
    "moving": moving_markdown,
    "notebooks": notebooks_markdown,
    "readme": readme_markdown,
}


def insert(text: str) -> str:
    """Replace the lines `<!-- insert: NAME ARGUMENT -->` of a page.

    Raises:
      ValueError: for a name that is not in `INSERTS`.
    """

    def replacement(match: re.Match) -> str:
        name, argument = match.groups()
        if name not in INSERTS:
            raise ValueError(f"insert: {name}: unknown; there are {', '.join(INSERTS)}")
        return INSERTS[name](argument)

    return INSERT.sub(replacement, text)
