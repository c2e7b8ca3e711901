"""Pages that hold all they need: scripts as ES modules inside one HTML file, which opens from a disk and in a notebook.

The modules of `serving/web` import each other by name. A page carries them compressed; a few lines unpack them, tell
the browser their names in an import map, and start one of them. Browsers of 2023 and later can do that (Chrome 89,
Firefox 113, Safari 16.4).
"""

from __future__ import annotations

import base64
import json
import zlib
from collections.abc import Sequence
from pathlib import Path

FOLDER = Path(__file__).parent / "web"

POLICY = (
    "default-src 'none'; script-src 'unsafe-inline' blob:; style-src 'unsafe-inline'; "
    "img-src data: blob:; connect-src blob:"
)
"""Content security policy of a page: what it carries, and no request to anybody."""

_START = """(async () => {
const packed = JSON.parse(document.getElementById("modules").textContent);
const imports = {};
for (const [name, text] of Object.entries(packed.modules)) {
const bytes = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
const script = await new Response(stream).blob();
imports[name] = URL.createObjectURL(new Blob([script], { type: "text/javascript" }));
}
const map = document.createElement("script");
map.type = "importmap";
map.textContent = JSON.stringify({ imports });
document.head.append(map);
await import(packed.start);
})().catch((error) => {
const message = document.getElementById("message");
message.textContent = `This page cannot start; it needs a browser of 2023 or later (${error.message}).`;
message.hidden = false;
});"""


def read_web(name: str) -> str:
    """Read a file of `serving/web` without its indents and lines of comment, a sixth of its bytes."""
    lines = (FOLDER / name).read_text(encoding="utf-8").splitlines()
    stripped = (line.strip() for line in lines)
    return "\n".join(line for line in stripped if line and not line.startswith("//"))


def module_scripts(start: str, others: Sequence[str] = ("three", "scene", "body")) -> str:
    """Return the elements of a page that hold modules and start one.

    Args:
      start: name of the module that begins; `NAME.js` in `serving/web`.
      others: names of what it imports; "three" is `three.min.js`.

    Returns:
      Two script elements. The page has to have an element "message" (hidden) and a policy that allows `blob:` scripts
      (`POLICY`).
    """
    files = {name: "three.min.js" if name == "three" else f"{name}.js" for name in (*others, start)}
    texts = {
        name: (FOLDER / file).read_text(encoding="utf-8") if name == "three" else read_web(file)
        for name, file in files.items()
    }
    packed = {name: base64.b64encode(zlib.compress(text.encode(), 9)).decode() for name, text in texts.items()}
    modules = json.dumps({"start": start, "modules": packed})
    return f'<script type="application/json" id="modules">{modules}</script>\n<script>\n{_START}\n</script>'
