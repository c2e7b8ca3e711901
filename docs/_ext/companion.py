"""What the site needs beyond Sphinx and its extensions.

Texts that are made while it is built (`pages`), equations without a network (`copy_mathjax`),
figures that say in words what they show (`describe_figures`) and open in full size
(`enlarge_figures`), what others show of a page (`describe_page`), and docstrings that are not meant as
reStructuredText (`plain_docstring`).
"""

from __future__ import annotations

import hashlib
import html
import importlib
import importlib.metadata
import shutil
from pathlib import Path

from docutils import nodes
from pages import INSERT, ROOT, equations, first_sentence, insert, plain_lines
from PIL import Image
from sphinx.errors import ExtensionError
from sphinx.util.osutil import relative_uri

# The file as MathJax 3.2.2 published it; a package carries it, and any other content is refused.
MATHJAX_PACKAGE = "sphinx-mathjax-offline"
MATHJAX_SHA256 = "a4354ff94fd868aea0cc6eaaa79a57fda0588646fc46ee3700a349ee0a11cbe6"


# Equations ----------------------------------------------------------------------------------------


def copy_mathjax(app) -> None:
    """Put MathJax and its licence into the site, after a look at its checksum.

    Raises:
      ExtensionError: if the installed file is not the one that MathJax published.
    """
    files = importlib.metadata.files(MATHJAX_PACKAGE) or []
    (source,) = (file for file in files if file.name == "tex-svg-full.js")
    content = Path(source.locate()).read_bytes()
    if hashlib.sha256(content).hexdigest() != MATHJAX_SHA256:
        raise ExtensionError(f"{source}: not MathJax 3.2.2 as published; install it again")
    target = Path(app.outdir) / "_static" / "mathjax"
    target.mkdir(parents=True, exist_ok=True)
    (target / source.name).write_bytes(content)
    shutil.copyfile(ROOT / "LICENSE", target / "LICENSE")  # MathJax is under the same licence
    (target / "NOTICE").write_text(
        "MathJax 3.2.2, https://www.mathjax.org, Copyright (c) 2009-2022 The MathJax Consortium,\n"
        "Apache License, Version 2.0 (file LICENSE).\n",
        encoding="utf-8",
    )


# Leftovers ----------------------------------------------------------------------------------------


def forget_sourceless(app, env) -> None:
    """Take modules without Python source off the list of sources; they would lead nowhere."""
    modules = getattr(env, "_viewcode_modules", {})
    for name in [name for name, entry in modules.items() if not entry]:
        del modules[name]


def remove_templates(app, exception) -> None:
    """Remove the theme's own templates, which it copies beside its styles and no page uses."""
    if exception is None and app.builder.format == "html":
        for path in (Path(app.outdir) / "_static").rglob("*-macros.html"):
            path.unlink()


# A browser's own Python --------------------------------------------------------------------------


def open_in_a_tab(app, pagename, templatename, context, doctree) -> None:
    """Give each notebook of the course a button that opens it in JupyterLite, which `docs/lite.py` puts beside it."""
    if pagename.startswith("notebooks/course/") and "header_buttons" in context:
        address = f"lite/notebooks/index.html?path={pagename.rpartition('/')[2]}.ipynb"
        context["header_buttons"].append(
            {"type": "link", "text": "Run in the browser", "tooltip": "Run this notebook in your browser",
             "icon": "fas fa-play", "label": "run-in-the-browser", "url": context["pathto"](address, resource=True)}
        )  # fmt: skip


# Alternative texts --------------------------------------------------------------------------------


def describe_figures(app, doctree, docname) -> None:
    """Give figures that a notebook drew an alternative text: the sentence that follows them.

    In our notebooks a sentence under each figure says what it shows; a reader who cannot see the
    picture hears the same sentence. Without one, it is the heading above.
    """
    if not docname.startswith("notebooks/"):
        return
    heading, waiting = "", []
    for node in doctree.findall():
        if isinstance(node, nodes.title):
            heading = node.astext()
        elif isinstance(node, nodes.image):
            if not node.get("alt"):
                waiting.append(node)
                node["alt"] = f"Figure of “{heading}”"
        elif isinstance(node, nodes.paragraph) and waiting and not in_output(node):
            for image in waiting:
                image["alt"] = first_sentence(node.astext())
            waiting = []


def enlarge_figures(app, doctree, docname) -> None:
    """Let every figure open in full size, which on a phone is the only way to read its labels."""
    if app.builder.format != "html":
        return
    for image in list(doctree.findall(nodes.image)):
        linked = isinstance(image.parent, nodes.reference)
        if not linked and image["uri"] in app.env.images:
            stored = f"{app.builder.imagedir}/{app.env.images[image['uri']][1]}"
            address = relative_uri(app.builder.get_target_uri(docname), stored)
            link = nodes.reference("", "", refuri=address, internal=True, classes=["enlarge"])
            image.replace_self(link)
            link += image


def describe_page(app, name, template, context, doctree) -> None:
    """Give a page the sentence and the picture by which search engines and messengers show it."""
    if doctree is None:
        return
    said = [node.astext() for node in doctree.findall(nodes.paragraph)] or [app.config.project]
    about = first_sentence(next((text for text in said if text.startswith("Question.")), said[0]))
    base, picture = app.config.html_baseurl, "_static/preview.jpg"
    told = {
        "description": about, "og:description": about, "og:type": "article", "og:site_name": app.config.project,
        "og:title": next((node.astext() for node in doctree.findall(nodes.title)), app.config.project),
        "og:image": base + picture if base else context["pathto"](picture, resource=True),
    }  # fmt: skip
    for key, value in told.items():
        kind = "property" if ":" in key else "name"
        context["metatags"] += f'<meta {kind}="{key}" content="{html.escape(value)}" />\n'


def draw_preview(app, exception) -> None:
    """Write that picture: one of the README's moving picture."""
    if exception is None and app.builder.format == "html":
        with Image.open(ROOT / "paper_figures/bandai/laptop/media/side_by_side.webp") as moving:
            moving.seek(moving.n_frames // 2)
            moving.convert("RGB").save(Path(app.outdir) / "_static" / "preview.jpg", quality=85)


def in_output(node) -> bool:
    """Return whether a node is part of what a cell put out."""
    while node is not None:
        if "cell_output" in node.get("classes", ()):
            return True
        node = node.parent
    return False


# Docstrings ---------------------------------------------------------------------------------------


def plain_docstring(app, what, name, obj, options, lines) -> None:
    """Read docstrings as what they are, before napoleon makes lists of their sections; equations stand below."""
    named = equations("\n".join(lines)) if what in ("function", "class", "method") else []
    lines[:] = plain_lines(lines) + named


def import_library() -> None:
    """Import every module before autodoc does: some packages stumble over its stand-ins."""
    for path in sorted(path for name in ("f3amd_lib", "f3amd_companion") for path in (ROOT / name).rglob("*.py")):
        name = ".".join(path.relative_to(ROOT).with_suffix("").parts)
        if "__" not in name:
            try:
                importlib.import_module(name)
            except ImportError:  # PyTorch and its like are optional
                pass


# Sphinx -------------------------------------------------------------------------------------------


def fill_in(app, docname, content) -> None:
    """Replace insert lines before a page is parsed."""
    if INSERT.search(content[0]):
        app.env.note_reread()  # what is inserted changes without the page
        content[0] = insert(content[0])


def setup(app):
    """Connect everything above to Sphinx."""
    import_library()
    app.connect("builder-inited", copy_mathjax)
    app.connect("source-read", fill_in)
    # Before napoleon, which makes lists of the sections.
    app.connect("autodoc-process-docstring", plain_docstring, priority=100)
    app.connect("doctree-resolved", describe_figures)
    app.connect("doctree-resolved", enlarge_figures)
    app.connect("html-page-context", describe_page)
    app.connect("build-finished", draw_preview)
    app.connect("env-updated", forget_sourceless)
    app.connect("html-page-context", open_in_a_tab, priority=900)  # after the theme's own buttons
    app.connect("build-finished", remove_templates)
    return {"version": "1", "parallel_read_safe": True, "parallel_write_safe": True}
