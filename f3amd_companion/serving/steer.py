"""A page on which one steers a trained model: the network runs in the browser.

`steer_page` makes one HTML file with everything in it: the weights as ONNX, ONNX Runtime for WebAssembly, three.js, and
our own modules (`serving/web`). All of it is in the page, as `player.whole_page` says, so that it works from a disk,
without a network.

Runtime and three.js are npm packages of fixed versions, fetched once from the public registry, checked by sha512 and
kept in the cache; npm itself is not needed.
"""

import html
import re
import tarfile
from pathlib import Path

import numpy as np
import optax
import pooch

from f3amd_companion.serving.foot_locking import leg_chains
from f3amd_companion.serving.onnx_export import denoiser_program, model_card
from f3amd_companion.serving.player import describe_for_web, read_web, whole_page
from f3amd_lib.drawing.stick_figures import LIMB_COLORS, TARGET_COLOR, bones_of
from f3amd_lib.ground.files import named_file, read_toml, write_whole
from f3amd_lib.ground.names import check_known
from f3amd_lib.rollout.rollout import pose_speed
from f3amd_lib.training.checkpoints import TrainedModel

_PAGE, _PINNED = (read_toml(Path(__file__).with_name(name)) for name in ("steer.toml", "npm_packages.toml"))
RUNTIMES = _PAGE["runtimes"]
"""What runs the network -> the script of ONNX Runtime, and its program; the second one also runs without WebGPU."""

_MARKS = {"past": "#b5651d", "taken": "#1b7f4d", "dropped": "#4f7fbf", "target": TARGET_COLOR, "seam": "#d33f3f"}


def steer_page(
    trained: TrainedModel, *, num_steps: int = 8, weights: str = "int8", program: bytes | None = None,
    runtime: str = "wasm", home: str = "",
) -> str:  # fmt: skip
    """Return a page on which one steers characters of a model, HTML; it needs no other file and no network.

    Args:
      trained: a model of history, path and style that is sampled by DDIM.
      num_steps: of the sampler; the page also offers 1.
      weights: how they are stored, see `onnx_export.WEIGHTS`.
      program: from `onnx_export.denoiser_program`, for any number of characters, instead of exporting here.
      runtime: "wasm"; or "webgpu", which takes the graphics card where the browser lends it, and WebAssembly where it
        does not. That page is larger.
      home: address that a link at the top leads back to, such as that of a site.

    Raises:
      ImportError, ValueError: as `denoiser_program` and `package_file`; for another sampler, an unknown runtime, or a
        model that lacks a starting pose for one of its styles.
    """
    check_known(runtime, RUNTIMES, "runtime")
    if trained.diffusion.sampler != "ddim":
        raise ValueError(f"{trained.name} is sampled by {trained.diffusion.sampler!r}, the page supports only 'ddim'")
    card = model_card(trained, num_steps)
    if missing := [style for style in trained.styles if style not in trained.start_poses]:
        raise ValueError(f"{trained.name} stores no starting pose for {missing[0]!r}, from which the page could start")
    if program is None:
        program = denoiser_program(trained.network(), weights=weights)
    paces, poses = zip(*(usual_walk(trained, style) for style in trained.styles), strict=True)
    try:
        legs = leg_chains(trained.skeleton).tolist()
    except ValueError:  # legs of other joints: feet are not held
        legs = None
    first, *others = sorted(trained.styles, key=lambda style: style != "Neutral")
    others = sorted(others, key=lambda style: style != "Proud")
    data = {
        "card": {key: value for key, value in card.items() if key not in ("about", "inputs", "output", "format")}
        | {name: getattr(trained.config, name) for name in ("window", "num_history", "channels")}
        | {"legs": legs, "webgpu": runtime == "webgpu"},
        "bones": bones_of(trained.skeleton),
        "body": describe_for_web(trained.skeleton),
        "paces": paces,
        "colors": LIMB_COLORS,
        "marks": _MARKS,
        "first_styles": [first, *others, None][:2],  # that the slider blends at first
    }
    choice = '<label><input type="radio" name="steps" value="{0}"{1}>{0}</label>'
    offered = sorted(map(int, card["sigmas"]), reverse=True)
    steps = "".join(choice.format(number, " checked" * (number == num_steps)) for number in offered)
    credits = card["credit"], f"Terms: {card['terms']}", *map(package_credit, ("onnxruntime-web", "three"))
    count = optax.tree.size(trained.params)
    texts = {
        "title": html.escape(f"Steer {trained.name}"),
        "name": html.escape(trained.name),
        "home": f'<a href="{html.escape(home)}">Back</a>' if home else "",
        "about": html.escape(f"{trained.name}, trained on {card['data']}, a diffusion model of {count:,} weights."),
        "window": trained.config.window,
        "history": trained.config.num_history,
        "runtime": html.escape(package_credit("onnxruntime-web").split(":")[0]),
        "credit": html.escape(". ".join(filter(None, credits))),
        "licence": html.escape(package_file("three", "LICENSE").decode("utf-8", "replace")),
        "steps": steps,
        "feet": " checked" if legs else " disabled",
        "about_feet": _PAGE["feet_held" if legs else "feet_not_held"],
        "marks": "\n".join(f"b.{name} {{ color: {color}; }}" for name, color in _MARKS.items()),
    }
    core, three = (package_file("three", f"build/three.{part}.js").decode() for part in ("core", "module"))
    modules = {"core": core, "three": three.replace("./three.core.js", "core")}
    modules |= {name: read_web(f"{name}.js") for name in ("body", "motion", "network")}
    script, wasm = RUNTIMES[runtime]
    files = {"worker": _worker(script).encode(), "wasm": package_file("onnxruntime-web", wasm), "program": program}
    files["poses"] = np.asarray(poses, np.float32).tobytes()
    return whole_page("steer", texts, data, modules, files, policy=" 'wasm-unsafe-eval'; worker-src blob:")


def write_steer(path, trained: TrainedModel, *, overwrite: bool = True, **options) -> Path:
    """Write `steer_page` as a file.

    Raises:
      ImportError, ValueError: as `steer_page`; for a suffix other than .html, or a file that is there already.
    """
    path = named_file(path, ".html", "pages")
    return write_whole(path, steer_page(trained, **options), overwrite=overwrite)


def package_file(package: str, path: str) -> bytes:
    """Return a file of a pinned package.

    Args:
      package: a name of `npm_packages.toml`.
      path: inside the package, such as "build/three.module.js".

    Raises:
      ValueError: if it is not in the cache and cannot be fetched, or is not what was pinned.
    """
    pinned = _PINNED[package]
    name = f"{package}-{pinned['version']}.tgz"
    url, folder = f"https://registry.npmjs.org/{package}/-/{name}", Path(pooch.os_cache("f3amd"))
    pooch.get_logger().setLevel("WARNING")
    try:
        archive = pooch.retrieve(url, f"sha512:{pinned['sha512']}", fname=name, path=folder)
    except (OSError, ValueError) as error:
        raise ValueError(f"{url}: download failed ({error}); save this file as {folder / name} yourself") from None
    with tarfile.open(archive) as files:
        return files.extractfile(f"package/{path}").read()


def package_credit(package: str) -> str:
    """Return name, version, holder and licence of a pinned package, for the page that carries it."""
    pinned = _PINNED[package]
    return f"{package} {pinned['version']}: {pinned['about']}, {pinned['licence']} licence"


def usual_walk(trained: TrainedModel, style: str) -> tuple[float, np.ndarray]:
    """Return how fast a style walks, and the stored starting pose that moves most nearly as fast.

    Returns:
      (metres a second: the median of the starting poses that move; world frames [H, C]).
    """
    poses = np.asarray(trained.start_poses[style], np.float64)
    speeds = 30.0 * pose_speed(poses)
    moving = speeds[speeds > 0.3]
    pace = float(np.median(moving)) if len(moving) else 1.0
    return pace, poses[np.argmin(np.abs(speeds - pace))]


def _worker(script: str) -> str:
    """Return the worker, with a bundle of ONNX Runtime, as one classic script: a page on a disk may start no other."""
    body, _, names = package_file("onnxruntime-web", script).decode("utf-8").partition("export{")
    pairs = [name.split(" as ") for name in names.partition("};")[0].split(",")]
    # It asks for its address only to find files that the page hands it.
    body = body.replace("import.meta.url", '"https://page.invalid/"')
    exported = ",".join(f"{name}:{own}" for own, name in pairs)
    ours = re.sub(r"^export |^import .*\n", "", f"{read_web('motion.js')}\n{read_web('steer_worker.js')}", flags=re.M)
    return f"const ort=(()=>{{{body}return{{{exported}}}}})();\n{ours}"
