"""Sphinx's settings for the companion as a site: `make site` builds it into docs/_build/html.

The source folder is the root of the repository, so that a link between notebooks, pages and tables
means the same here, on a disk and on a forge. Only what `include_patterns` names becomes a page.
Nothing is executed: notebooks show their committed outputs. Nothing is loaded from outside:
equations are drawn by a copy of MathJax that lies in the site.
"""

import importlib.metadata
import importlib.util
import os
import sys
import tomllib
from pathlib import Path

DOCS = Path(__file__).resolve().parent
sys.path[:0] = [str(DOCS / "_ext"), str(DOCS.parent), str(DOCS.parent / "notebooks")]
os.environ.setdefault("JAX_PLATFORMS", "cpu")  # autodoc imports the library; it computes nothing

from pages import launch_options  # noqa: E402 (the lines above are what finds it)

project = "F3AMD companion"
author = copyright = "The F3AMD companion authors"
metadata = tomllib.loads((DOCS.parent / "pyproject.toml").read_text("utf-8"))["project"]
urls = {name.casefold(): address for name, address in metadata.get("urls", {}).items()}
release = version = importlib.metadata.version("f3amd_lib")

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.mathjax",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
    "sphinx_design",
    "companion",
]

# What becomes a page. New notebooks and pages are found by themselves.
root_doc = "docs/index"
include_patterns = ["docs/**.md", "notebooks/**.ipynb", "paper_figures/claims*.md"]
exclude_patterns = [
    ".*",  # .venv and other hidden folders, caches
    "**/.ipynb_checkpoints",
    "docs/_build",
    "build",
    "data",
    "dist",
    "f3amd_companion",
    "f3amd_lib",
    "notebooks/f3amd_notebooks",
    "runs",
    "scripts",
    "tests",
]

# A docstring is prose: where an indent of it means nothing to a parser, it is shown as it stands.
suppress_warnings = ["docutils"]

# Notebooks and Markdown.
nb_execution_mode = "off"
nb_render_markdown_format = "myst"  # tables and equations in outputs
nb_number_source_lines = False
nb_custom_formats = {".ipynb": ["pages.read_notebook", {}, False]}  # setup folded, figures in full size
nb_code_prompt_show = "Show the code"
nb_code_prompt_hide = "Hide the code"
myst_enable_extensions = ["amsmath", "attrs_block", "attrs_inline", "colon_fence", "dollarmath"]
myst_heading_anchors = 3
myst_links_external_new_tab = False

# Equations: MathJax's own single file, which draws with paths and so needs no fonts.
mathjax_path = "mathjax/tex-svg-full.js"
mathjax3_config = {"svg": {"fontCache": "global"}, "tex": {"tags": "none"}, "options": {"enableMenu": True}}

# The library's docstrings: Google's sections, code between single backticks.
default_role = "py:obj"
add_module_names = False
autodoc_default_options = {"members": True, "member-order": "bysource"}
autodoc_mock_imports = [  # optional: their absence does not empty a page
    name for name in ("iree", "onnxruntime", "torch") if not importlib.util.find_spec(name)
]
autodoc_preserve_defaults = True
autodoc_typehints_format = "short"
napoleon_numpy_docstring = False
napoleon_use_ivar = True
napoleon_use_rtype = False
python_maximum_signature_line_length = 90
toc_object_entries_show_parents = "hide"

# Looks. The theme's icons and styles are files of its own; no fonts are fetched.
html_theme = "sphinx_book_theme"
html_title = "F3AMD companion"
html_static_path = ["_static"]
html_css_files = ["companion.css"]
html_js_files = ["companion.js"]
html_extra_path = ["_extra"]
html_baseurl = f"{address.rstrip('/')}/" if (address := urls.get("documentation")) else ""
html_favicon = "_static/favicon.svg"
html_show_sphinx = True
html_copy_source = True
html_sourcelink_suffix = ""
html_last_updated_fmt = None
html_context = {"default_mode": "auto"}  # light or dark, as the reader's system is
html_theme_options = {
    "home_page_in_toc": False,
    "max_navbar_depth": 2,
    "show_navbar_depth": 1,
    "show_toc_level": 2,
    "search_bar_text": "Search the companion",
    "use_download_button": True,
    "use_fullscreen_button": False,
    "back_to_top_button": True,
    **launch_options(os.environ.get("F3AMD_REPOSITORY") or urls.get("repository", "")),
    # The ledger's tables need the width.
    "secondary_sidebar_items": {
        "**": ["page-toc.html"],
        **{f"paper_figures/{path.stem}": [] for path in Path(__file__).parents[1].glob("paper_figures/claims*.md")},
    },
    "pygments_light_style": "a11y-high-contrast-light",
    "pygments_dark_style": "a11y-high-contrast-dark",
}
