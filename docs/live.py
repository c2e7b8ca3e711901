"""Make three pictures of the path notebook's page live, and write the page on which one steers.

    python docs/live.py docs/_build/html

A figure stands at the cell with its tag, `live-noise`, `live-steps` or `live-ladder`, and shows the numbers of the
notebook's own cells, which run here. The page loads `live.js`, and `live_network.js` when the first two come near. Both
are classic scripts that carry what they need, because a page on a disk may load no modules.
"""

from __future__ import annotations

import base64
import json
import sys
import zlib
from pathlib import Path

import nbformat
import numpy as np

DOCS = Path(__file__).resolve().parent
sys.path[:0] = [str(DOCS.parent), str(DOCS.parent / "notebooks")]

from f3amd_notebooks.walker_toes import walker_toes  # noqa: E402

from f3amd_companion.serving import steer  # noqa: E402 (the line above is what finds it)
from f3amd_companion.serving.onnx_export import denoiser_program, model_card  # noqa: E402
from f3amd_companion.serving.player import describe_for_web, read_web  # noqa: E402
from f3amd_lib.data.features import frame_yaw  # noqa: E402
from f3amd_lib.ground.records import committed_table  # noqa: E402

NOTEBOOK, FIGURES = "00_beside_the_paper", ("noise", "steps", "ladder")
CELLS = ("path-01", "path-02", "path-03", "path-07", "path-08")  # up to a window, its condition and two draws of noise


def notebook_names(*cells: str) -> dict:
    """Run cells of the path notebook, given by their ids, and return what they define."""
    notebook = nbformat.read(DOCS.parent / "notebooks" / f"{NOTEBOOK}.ipynb", as_version=4)
    sources, names = {cell.id: cell.source for cell in notebook.cells}, {}
    for cell in cells:
        exec(sources[cell], names)
    return names


def figures_data(names: dict) -> tuple[dict, dict[str, np.ndarray]]:
    """Return what the figures show, as JSON and as arrays; `names` are those that `CELLS` leave."""
    model, condition, toes = names["model"], names["condition"], walker_toes()
    errors = committed_table("synthetic", "04_x0_error_by_sigma", kind="tables")[0].query("model == @model.name")
    card = model_card(model, 8) | {name: getattr(model.config, name) for name in ("window", "num_history", "channels")}
    data = {
        "card": {key: value for key, value in card.items() if key not in ("about", "inputs", "output", "format")},
        "skeleton": describe_for_web(model.skeleton),
        "facing": float(frame_yaw(model.skeleton, np.asarray(names["units"].denormalise(names["x0"])))[0, 16]),
        "sigmas": {count: model.diffusion.grid(count).tolist() for count in (8, 4, 2, 1)},
        "measured": errors[["sigma", "joint_error_cm"]].to_numpy().T.tolist(),
        "toes": {"means": toes.both.means.tolist(), "width": toes.both.width},
    }
    arrays = {"x0": names["x0"][0], "noise": names["noise"], **{k: v[0] for k, v in condition._asdict().items()}}
    return data, {name: np.asarray(array, np.float32) for name, array in arrays.items()}


def scripts(data: dict, arrays: dict[str, np.ndarray], program: bytes) -> dict[str, str]:
    """Return the two scripts by their names, with the licences of what they carry."""
    pack = lambda part: base64.b64encode(zlib.compress(part, 9)).decode()
    plots = steer.package_file("uplot", "dist/uPlot.iife.min.js").decode() + "\nexport default uPlot;"
    modules = {name: read_web(f"{name}.js") for name in ("scene", "body", "motion", "network")}
    modules |= {"three": read_web("three.min.js"), "uplot": plots, "live": (DOCS / "live.js").read_text("utf-8")}
    style = steer.package_file("uplot", "dist/uPlot.min.css").decode() + (DOCS / "live.css").read_text("utf-8")
    looks = {"style": style, "html": (DOCS / "live.html").read_text("utf-8")}
    files = {"data": json.dumps(data | looks).encode(), **{name: array.tobytes() for name, array in arrays.items()}}
    packed = {"start": "live", "modules": {name: pack(text.encode()) for name, text in modules.items()}}
    packed["files"] = {name: pack(part) for name, part in files.items()}
    script, wasm = steer.RUNTIMES["wasm"]
    network = {"worker": steer._worker(script).encode(), "program": program}
    network |= {"wasm": steer.package_file("onnxruntime-web", wasm)}
    credits = [f"{steer.package_credit(name)}\n" for name in ("three", "uplot", "onnxruntime-web")]
    head = f"/*! {''.join(credits)}\n{steer.package_file('three', 'LICENSE').decode()}*/\n"
    element = '{const s=document.createElement("script");s.id="packed";s.type="application/json";s.textContent='
    element += f"JSON.stringify({json.dumps(packed)});document.head.append(s)}}\n"
    return {
        "live.js": head + element + read_web("start.js"),
        "live_network.js": f"{head}globalThis.liveNetwork={json.dumps({k: pack(v) for k, v in network.items()})};\n",
    }


def make_live(page: Path, made: dict[str, str]) -> None:
    """Put the scripts beside a page, and let it call them; ValueError where it lacks the place of a figure."""
    text = page.read_text(encoding="utf-8")
    if missing := [name for name in FIGURES if f"tag_live-{name}" not in text]:
        raise ValueError(f"{page}: no cell has the tag live-{missing[0]}")
    for name, script in made.items():
        page.with_name(name).write_text(script, encoding="utf-8")
    message = '<p id="message" class="live" role="alert" hidden></p><script defer src="live.js"></script>'
    page.write_text(text.replace("</body>", f"{message}</body>"), encoding="utf-8")


def main(site: Path) -> None:
    names = notebook_names(*CELLS)
    program = denoiser_program(names["model"].network(), weights="int8")
    steer.write_steer(site / "steer.html", names["model"], program=program, home="docs/index.html")
    make_live(site / "notebooks" / f"{NOTEBOOK}.html", scripts(*figures_data(names), program))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
