"""A model as ONNX: what engines and web pages load, for any number of characters.

What is exported is one evaluation of the denoiser, with its condition, and not a whole round:

    x0_hat = denoiser(x_noisy [B, T, C], sigma [B], history [B, H, C], path [B, T, 8], style [B, S])

One file then serves any number of steps, any sampler and any B; a page that offers 8 steps and 1 loads the weights
once. The walk around it is three lines in any language (DDIM, `diffusion.samplers.ddim_step`). The price is that the
condition is encoded anew at every step, 43 tokens through three linear layers. A whole round with the sampler inside
is what `serving.export` makes, for StableHLO and IREE.

Beside the program lies a card, JSON: shapes, scales of the features, skeleton, styles, noise levels, and how far the
program is from JAX; and a worked example in Python and one in C#.
"""

import json
import logging
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from f3amd_lib.ground.files import read_toml, write_whole
from f3amd_lib.ground.names import check_known
from f3amd_lib.motion.skeleton import Skeleton, describe_skeleton
from f3amd_lib.networks.conditioning import PATH_CHANNELS, Condition, ConditionedConfig
from f3amd_lib.text.networks.acmdm import ACMDM, ACMDMConfig, TextCondition
from f3amd_lib.text.networks.motionpcm import LatentDenoiserConfig
from f3amd_lib.training.checkpoints import EIGHT_BITS_FROM, TrainedModel

PROGRAM = "denoiser.onnx"
CARD = "card.json"
EXAMPLES = Path(__file__).parent / "onnx_example"
WEIGHTS = ("float32", "float16", "int8")
"""How weights are stored. All are computed with in float32: a runtime widens them once, when it loads the file."""

ABOUT = read_toml(Path(__file__).with_name("onnx_card.toml"))
"""What the numbers of a program mean, in the words of its card, by kind of model."""

INSTALL = 'pip install "f3amd_lib[onnx]", or in a clone: make onnx-tools'


def denoiser_program(network, *, batch: int | None = None, weights: str = "float32") -> bytes:
    """Return one evaluation of a network as an ONNX program, weights inside.

    Args:
      network: with its weights: of history, path and style (F3AMD and CAMDM), or of text to motion (`onnx_text`).
      batch: B; by default the program takes any.
      weights: one of `WEIGHTS`.

    Returns:
      The file's content. Inputs are those of `input_shapes`, float32, the output that of `output_name`.

    Raises:
      ImportError: if jax2onnx is not installed, saying how to install it.
      ValueError: for another network, less than one character, or unknown `weights`.
    """
    if batch is not None and batch < 1:
        raise ValueError(f"batch must be at least 1 character, got {batch}")
    shapes = input_shapes(network.config, batch or "B")
    check_known(weights, WEIGHTS, "weights")
    try:
        import jax2onnx
    except ImportError as error:
        raise ImportError(f"ONNX needs jax2onnx ({error}): {INSTALL}") from None

    # Some weights are kept in bfloat16, which few runtimes compute in; widening them changes nothing.
    graph, state = nnx.split(network)
    network = nnx.merge(graph, jax.tree.map(lambda leaf: leaf.astype(jnp.float32), state))
    logging.getLogger("onnx_ir").setLevel(logging.ERROR)  # it warns of every shape that it does not need to know
    model = jax2onnx.to_onnx(
        lambda *inputs: evaluate(network, *inputs), list(shapes.values()), model_name="denoiser",
        input_names=list(shapes), output_names=[output_name(network.config)],
    )  # fmt: skip
    if weights != "float32":
        _store_small(model.graph, weights)
    return model.SerializeToString()


def input_shapes(config, batch) -> dict[str, tuple]:
    """Return input -> shape in the order of a call; `batch` may be a name. ValueError for a network of another kind."""
    if isinstance(config, ConditionedConfig):
        frames, history = (batch, config.window, config.channels), (batch, config.num_history, config.channels)
        path, style = (batch, config.window, PATH_CHANNELS), (batch, config.num_styles)
        return {"x_noisy": frames, "sigma": (batch,), "history": history, "path": path, "style": style}
    if type(config) not in (ACMDMConfig, LatentDenoiserConfig):  # of masked ACMDM one evaluation is another thing
        known = "networks of history, path and style, ACMDM, and teacher or student of MotionPCM"
        raise ValueError(f"only {known} are exported, got {type(config).__name__}")
    state = config.state_shape(batch)
    inputs = {"state": state, "time": (batch,), "text": (batch, config.text_width)}
    if type(config) is ACMDMConfig:
        return inputs | {"mask": state[:2]}
    return inputs | ({"guidance": (batch,)} if config.guidance_features else {})


def output_name(config) -> str:
    """Return what a program's output is called; it has the shape of its first input."""
    return "x0_hat" if isinstance(config, ConditionedConfig) else "prediction"


def evaluate(network, state, level, *given):
    """Ask a network; the inputs are those of `input_shapes`, of which a mask is 1 or 0."""
    if isinstance(network.config, ConditionedConfig):
        return network(state, level, network.encode(Condition(*given)))
    if isinstance(network, ACMDM):
        text, mask = given
        return network(state, level, network.encode(TextCondition(text, mask > 0.5)))
    text, *guidance = given
    return network(state, level, network.encode(text), *guidance)


def _store_small(graph, weights: str) -> None:
    """Keep large float32 constants in fewer bits, and widen them by nodes that a runtime folds away.

    In 8 bits each column of the last axis has a scale of its own, as in `checkpoints.save_model`.
    """
    from onnx import TensorProto, helper, numpy_helper

    widening = []
    for place, constant in enumerate(graph.initializer):
        value = numpy_helper.to_array(constant)
        if value.dtype != np.float32 or value.ndim < 2 or value.size < EIGHT_BITS_FROM:
            continue
        name, small = constant.name, f"{constant.name}_small"
        if weights == "float16":
            graph.initializer[place].CopyFrom(numpy_helper.from_array(value.astype(np.float16), small))
            widening.append(helper.make_node("Cast", [small], [name], to=TensorProto.FLOAT))
            continue
        largest = np.abs(value).max(axis=-2, keepdims=True)
        scale = np.where(largest > 0, largest, 1.0).astype(np.float32) / np.float32(127)
        rounded = np.clip(np.round(value / scale), -127, 127).astype(np.int8)
        graph.initializer[place].CopyFrom(numpy_helper.from_array(rounded, small))
        graph.initializer.append(numpy_helper.from_array(scale, f"{name}_scale"))
        widening.append(helper.make_node("Cast", [small], [f"{name}_wide"], to=TensorProto.FLOAT))
        widening.append(helper.make_node("Mul", [f"{name}_wide", f"{name}_scale"], [name]))
    nodes = [*widening, *graph.node]
    del graph.node[:]
    graph.node.extend(nodes)


class OnnxProgram:
    """An ONNX program run by ONNX Runtime on this processor, callable as `program(name=array, ...)`."""

    def __init__(self, program: bytes):
        try:
            import onnxruntime
        except ImportError as error:
            raise ImportError(f"running ONNX needs ONNX Runtime ({error}): {INSTALL}") from None
        self._session = onnxruntime.InferenceSession(program, providers=["CPUExecutionProvider"])
        self.input_shapes = {item.name: tuple(item.shape) for item in self._session.get_inputs()}

    def __call__(self, **inputs) -> np.ndarray:
        """Return the one output; inputs are given to it as float32."""
        return self._session.run(None, {name: np.asarray(value, np.float32) for name, value in inputs.items()})[0]


def seeded_inputs(config, batch: int) -> dict[str, np.ndarray]:
    """Return inputs to compare programs by, float32; of a mask the last quarter of each second sample is padding."""
    draw, shapes = np.random.default_rng(0), input_shapes(config, batch)
    drawn = [name for name in shapes if name not in ("sigma", "style")]
    inputs = {name: np.ones(shape, np.float32) for name, shape in shapes.items()}
    inputs |= {name: draw.normal(size=shapes[name]).astype(np.float32) for name in drawn}
    if "path" in inputs:
        path = inputs["path"]
        yaw = draw.uniform(-0.5, 0.5, path.shape[:2])
        zero, one = np.zeros_like(yaw), np.ones_like(yaw)
        path[..., 2:] = np.stack([np.cos(yaw), zero, -np.sin(yaw), zero, one, zero], axis=-1)
        path[..., :2] = 0.03 * np.arange(1, config.window + 1)[None, :, None] * path[:, :1, :2]
        inputs["style"] = np.eye(config.num_styles, dtype=np.float32)[np.arange(batch) % config.num_styles]
    if "mask" in inputs:
        inputs["mask"][:] = 1
        inputs["mask"][1::2, -(shapes["mask"][1] // 4 or 1) :] = 0
    if "guidance" in inputs:
        inputs["guidance"] = np.linspace(5.0, 15.0, batch, dtype=np.float32)
    return inputs


def largest_difference(program: bytes, network, levels) -> float:
    """Return how far a program is from JAX at noise levels or times, network units: the largest of all numbers.

    What is said of padding means nothing, and is not compared.

    Args:
      program: from `denoiser_program`.
      network: that was exported.
      levels: sigmas above 0, by which the noise is scaled, or times.
    """
    run = OnnxProgram(program)
    state, level = list(run.input_shapes)[:2]
    fixed = run.input_shapes[level][0]
    inputs = seeded_inputs(network.config, fixed if isinstance(fixed, int) else 2)
    noise, _, *given = inputs.values()
    ask = lambda state, level: evaluate(network, state, level, *given)
    if level == "sigma":
        ask = jax.jit(ask)
    differences = []
    for value in np.asarray(levels, np.float32):
        asked = value * noise if level == "sigma" else noise, np.full(len(noise), value)
        gap = np.abs(run(**inputs | dict(zip((state, level), asked, strict=True))) - np.asarray(ask(*asked)))
        differences.append((gap[inputs["mask"] > 0.5] if "mask" in inputs else gap).max())
    return float(max(differences))


def card_head(trained, form: str, frames_per_second: float) -> dict:
    """Return how a card begins: what the model is, under which terms, and what goes in and out."""
    shapes = {name: {"shape": list(shape)} for name, shape in input_shapes(trained.config, "B").items()}
    return {
        "format": form,
        "model": trained.name,
        "data": trained.record.get("dataset"),
        "terms": trained.record.get("dataset_licence"),
        "credit": trained.record.get("dataset_credit"),
        "frames_per_second": frames_per_second,
        "inputs": shapes,
        "output": {output_name(trained.config): next(iter(shapes.values()))},
    }


def skeleton_card(skeleton: Skeleton) -> dict:
    """Return a skeleton with its offsets, JSON-ready."""
    return describe_skeleton(skeleton) | {"offsets": np.asarray(skeleton.offsets).tolist()}


def model_card(trained: TrainedModel, num_steps: int) -> dict:
    """Return what whoever runs the program has to know, JSON-ready.

    Arrays are [batch, frames, ...], metres, radians, +Y up; a character with yaw 0 faces +Z.
    """
    scales = trained.normaliser._asdict()
    return card_head(trained, "f3amd-onnx-1", 30) | {
        "about": ABOUT["walk"],
        "normaliser": {name: np.asarray(value, np.float32).tolist() for name, value in scales.items()},
        "skeleton": skeleton_card(trained.skeleton),
        "styles": list(trained.styles),
        "sampler": trained.diffusion.sampler,
        "sigmas": {number: trained.diffusion.grid(number).tolist() for number in sorted({1, num_steps})},
    }


def export_onnx(trained: TrainedModel, folder, *, num_steps: int = 8, **how) -> Path:
    """Write a trained model as ONNX with its card and worked examples: `f3amd export --target onnx`.

    Args:
      trained: the model.
      folder: is made, if need be.
      num_steps: for which the card lists noise levels, beside 1; the program is compared with JAX at them.
      **how: batch, weights and overwrite, of `write_export`.

    Raises:
      ImportError, ValueError: as `write_export`.
    """
    levels = trained.diffusion.grid(num_steps)[:-1]
    return write_export(folder, trained.network(), model_card(trained, num_steps), levels, examples=True, **how)


def write_export(
    folder, network, card: dict, levels, *, batch: int | None = None, weights: str = "float32", overwrite: bool = False,
    examples: bool = False,
) -> Path:  # fmt: skip
    """Make a program, measure it, and write it with its card, each file whole or not at all.

    Args:
      folder: is made, if need be.
      network: with its weights.
      card: what whoever runs the program has to know; added are batch, weights, size, and how far the program is from
        JAX, network units (`largest_error`).
      levels: at which it is compared, as of `largest_difference`.
      batch, weights: as for `denoiser_program`.
      overwrite: replace an earlier export.
      examples: write the worked examples beside it.

    Returns:
      The folder.

    Raises:
      ImportError, ValueError: as `denoiser_program`; if an export is there that may not be replaced, said before
        anything is made.
    """
    folder = Path(folder)
    if not overwrite and (folder / PROGRAM).exists():
        raise ValueError(f"{folder / PROGRAM}: exists already; pass --overwrite or another --out")
    program = denoiser_program(network, batch=batch, weights=weights)
    error = largest_difference(program, network, levels)
    card |= {"batch": batch or "any", "weights": weights, "bytes": len(program), "largest_error": error}
    folder.mkdir(parents=True, exist_ok=True)
    files = {PROGRAM: program, CARD: (json.dumps(card, indent=1, ensure_ascii=False) + "\n").encode()}
    for path in EXAMPLES.glob("*.txt"):
        if examples:
            files[path.stem] = path.read_bytes()
        else:  # those of an export that is replaced would not fit the new card
            (folder / path.stem).unlink(missing_ok=True)
    for name, content in files.items():
        write_whole(folder / name, content)
    return folder
