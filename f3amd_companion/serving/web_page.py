"""Pages that hold all they need: scripts as ES modules inside one HTML file, which opens from a disk and in a notebook.

The modules of `serving/web` import each other by name. A page carries them compressed; a few lines unpack them, tell
the browser their names in an import map, and start one of them. Browsers of 2023 and later can do that (Chrome 89,
Firefox 113, Safari 16.4).
"""

import base64
import json
import zlib
from pathlib import Path

FOLDER = Path(__file__).parent / "web"

POLICY = (
    "default-src 'none'; script-src 'unsafe-inline' blob:; style-src 'unsafe-inline'; "
    "img-src data: blob:; connect-src blob:"
)
"""Content security policy of a page: what it carries, and no request to anybody."""


def read_web(name: str) -> str:
    """Read a file of `serving/web` without its indents and lines of comment, a sixth of its bytes."""
    lines = (FOLDER / name).read_text(encoding="utf-8").splitlines()
    stripped = (line.strip() for line in lines)
    return "\n".join(line for line in stripped if line and not line.startswith("//"))


def module_scripts(start: str) -> str:
    """Return the elements of a page that hold modules and start one.

    Args:
      start: name of the module that begins; `NAME.js` in `serving/web`. It may import three, scene and body.

    Returns:
      Two script elements. The page has to have an element "message" (hidden) and a policy that allows `blob:` scripts
      (`POLICY`).
    """
    texts = {"three": (FOLDER / "three.min.js").read_text(encoding="utf-8")}
    texts |= {name: read_web(f"{name}.js") for name in ("scene", "body", start)}
    packed = {name: base64.b64encode(zlib.compress(text.encode(), 9)).decode() for name, text in texts.items()}
    modules = json.dumps({"start": start, "modules": packed})
    begin = read_web("start.js")
    return f'<script type="application/json" id="modules">{modules}</script>\n<script>\n{begin}\n</script>'


def page_json(value) -> str:
    """Return a value as JSON that may stand in a script element: "</script>" in a name would end the element."""
    return json.dumps(value, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")
