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

from __future__ import annotations

import json
import logging
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from f3amd_lib.ground.files import read_toml, whole_file
from f3amd_lib.ground.names import check_known
from f3amd_lib.networks.conditioning import Condition, ConditionedConfig
from f3amd_lib.training.checkpoints import EIGHT_BITS_FROM, TrainedModel, describe_skeleton

PROGRAM = "denoiser.onnx"
CARD = "card.json"
EXAMPLES = Path(__file__).parent / "onnx_example"
WEIGHTS = ("float32", "float16", "int8")
"""How weights are stored. All are computed with in float32: a runtime widens them once, when it loads the file."""

INPUTS = ("x_noisy", "sigma", "history", "path", "style")
INSTALL = 'pip install "f3amd_lib[onnx]", or in a clone: make onnx-tools'


def denoiser_program(network, *, batch: int | None = None, weights: str = "float32") -> bytes:
    """Return one evaluation of a denoiser as an ONNX program, weights inside.

    Args:
      network: a denoiser that history, path and style guide (F3AMD and CAMDM), with its weights.
      batch: B; by default the program takes any.
      weights: one of `WEIGHTS`.

    Returns:
      The file's content. Inputs are `INPUTS`, float32; sigma is [B]. The output is x0_hat, [B, T, C].

    Raises:
      ImportError: if jax2onnx is not installed, saying how to install it.
      ValueError: for another family, less than one character, or unknown `weights`.
    """

    def denoise(network, x_noisy, sigma, history, path, style):
        return network(x_noisy, sigma, network.encode(Condition(history, path, style)))

    return onnx_program(network, denoise, input_shapes(network.config, check_batch(batch)), "x0_hat", weights=weights)


def check_batch(batch: int | None) -> int | str:
    """Return the first number of an input's shape: `batch`, or the name "B" for any; ValueError below 1."""
    if batch is not None and batch < 1:
        raise ValueError(f"batch must be at least 1 character, got {batch}")
    return "B" if batch is None else batch


def onnx_program(network, evaluate, shapes: dict[str, tuple], output: str, *, weights: str = "float32") -> bytes:
    """Return one evaluation of a network as an ONNX program, weights inside.

    Args:
      network: with its weights.
      evaluate: `evaluate(network, *inputs)`, one array.
      shapes: input -> shape, in the order of a call; the first number may be "B", for any. All are float32.
      output: its name.
      weights: one of `WEIGHTS`.

    Raises:
      ImportError: if jax2onnx is not installed, saying how to install it.
      ValueError: for unknown `weights`.
    """
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
        input_names=list(shapes), output_names=[output],
    )  # fmt: skip
    if weights != "float32":
        _store_small(model.graph, weights)
    return model.SerializeToString()


def input_shapes(config: ConditionedConfig, batch) -> dict[str, tuple]:
    """Return the shapes of `INPUTS`, in the order of a call; `batch` may be a name. ValueError for another family."""
    if not isinstance(config, ConditionedConfig):
        raise ValueError(f"only networks of history, path and style are exported here, got {type(config).__name__}")
    frames = (batch, config.window, config.channels)
    history = (batch, config.num_history, config.channels)
    shapes = frames, (batch,), history, (batch, config.window, 8), (batch, config.num_styles)
    return dict(zip(INPUTS, shapes, strict=True))


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


class OnnxDenoiser(OnnxProgram):
    """A program of `denoiser_program`, callable as `denoise(x_noisy, sigma)` after `given`."""

    def __call__(self, x_noisy, sigma, history, path, style) -> np.ndarray:
        """Return x0_hat, [B, T, C]; sigma is [B] or one level for all."""
        sigma = np.broadcast_to(np.asarray(sigma, np.float32), (len(history),))
        return super().__call__(x_noisy=x_noisy, sigma=sigma, history=history, path=path, style=style)

    def given(self, condition: Condition):
        """Return the callable that samplers take, under one condition."""
        return lambda x_noisy, sigma: self(x_noisy, sigma, *condition)


def seeded_inputs(config: ConditionedConfig, batch: int, seed: int = 0) -> tuple[np.ndarray, Condition]:
    """Return standard normal noise [B, T, C] and a condition, to compare programs by."""
    draw = np.random.default_rng(seed)
    shapes = input_shapes(config, batch)
    noise, history, path = (
        draw.normal(size=shapes[name]).astype(np.float32) for name in ("x_noisy", "history", "path")
    )
    yaw = draw.uniform(-0.5, 0.5, path.shape[:2])
    zero, one = np.zeros_like(yaw), np.ones_like(yaw)
    path[..., 2:] = np.stack([np.cos(yaw), zero, -np.sin(yaw), zero, one, zero], axis=-1)
    path[..., :2] = 0.03 * np.arange(1, config.window + 1)[None, :, None] * path[:, :1, :2]
    style = np.eye(config.num_styles, dtype=np.float32)[np.arange(batch) % config.num_styles]
    return noise, Condition(history, path, style)


def largest_difference(program: bytes, network, sigmas, batch: int = 2) -> float:
    """Return how far a program is from JAX at every noise level, network units: the largest of all numbers.

    Args:
      program: from `denoiser_program`.
      network: that was exported.
      sigmas: levels above 0.
      batch: B, if the program takes any.
    """
    run = OnnxDenoiser(program)
    fixed = run.input_shapes["sigma"][0]
    noise, condition = seeded_inputs(network.config, fixed if isinstance(fixed, int) else batch)
    apply = jax.jit(lambda x_noisy, sigma: network(x_noisy, sigma, network.encode(condition)))
    differences = []
    for sigma in np.asarray(sigmas, np.float32):
        level = np.full(len(noise), sigma, np.float32)
        differences.append(np.abs(run(sigma * noise, level, *condition) - apply(sigma * noise, level)).max())
    return float(max(differences))


def model_card(trained: TrainedModel, num_steps: int) -> dict:
    """Return what whoever runs the program has to know, JSON-ready.

    Arrays are [batch, frames, ...], metres, radians, +Y up; a character with yaw 0 faces +Z.
    """
    config, skeleton = trained.config, trained.skeleton
    steps = {number: trained.diffusion.grid(number).tolist() for number in sorted({1, num_steps})}
    record = trained.record
    return {
        "format": "f3amd-onnx-1",
        "model": trained.name,
        "data": record.get("dataset"),
        "terms": record.get("dataset_licence"),
        "credit": record.get("dataset_credit"),
        "frames_per_second": 30,
        "inputs": {name: {"shape": list(shape)} for name, shape in input_shapes(config, "B").items()},
        "output": {"x0_hat": {"shape": ["B", config.window, config.channels]}},
        "about": read_toml(Path(__file__).with_name("onnx_card.toml")),
        "normaliser": {
            name: np.asarray(value, np.float32).tolist() for name, value in trained.normaliser._asdict().items()
        },
        "skeleton": describe_skeleton(skeleton) | {"offsets": np.asarray(skeleton.offsets).tolist()},
        "styles": list(trained.styles),
        "sampler": trained.diffusion.sampler,
        "sigmas": steps,
    }


def export_onnx(
    trained: TrainedModel,
    folder,
    *,
    num_steps: int = 8,
    batch: int | None = None,
    weights: str = "float32",
    overwrite: bool = False,
) -> Path:
    """Write a trained model as ONNX with its card and worked examples: `f3amd export --target onnx`.

    Args:
      trained: the model.
      folder: is made, if need be.
      num_steps: for which the card lists noise levels, beside 1.
      batch, weights: as for `denoiser_program`.
      overwrite: replace an earlier export.

    Returns:
      The folder. Its card says how far the program is from JAX at the noise levels of `num_steps` steps, network units
      (`largest_error`), measured before it is written.

    Raises:
      ImportError, ValueError: as `denoiser_program`; or if a file is there and `overwrite` is false.
    """
    network = trained.network()
    levels = trained.diffusion.grid(num_steps)[:-1]
    return write_export(
        folder,
        model_card(trained, num_steps),
        partial(denoiser_program, network),
        lambda program: largest_difference(program, network, levels),
        batch=batch,
        weights=weights,
        overwrite=overwrite,
        examples=True,
    )


def write_export(
    folder, card: dict, make, error_of, *, batch: int | None, weights: str, overwrite: bool, examples: bool = False
) -> Path:
    """Make a program, measure it, and write it with its card, each file whole or not at all.

    Args:
      folder: is made, if need be.
      card: what whoever runs the program has to know; batch, weights, size and error are added.
      make: `make(batch=, weights=)`, the program.
      error_of: `error_of(program)`, how far it is from JAX.
      batch, weights: as for `denoiser_program`.
      overwrite: replace an earlier export.
      examples: write the worked examples beside it.

    Returns:
      The folder.

    Raises:
      ValueError: if an export is there that may not be replaced; said before anything is made.
    """
    folder = Path(folder)
    if not overwrite and (folder / PROGRAM).exists():
        raise ValueError(f"{folder / PROGRAM}: exists already; pass --overwrite or another --out")
    program = make(batch=batch, weights=weights)
    card |= {"batch": batch or "any", "weights": weights, "bytes": len(program), "largest_error": error_of(program)}
    folder.mkdir(parents=True, exist_ok=True)
    files = {PROGRAM: program, CARD: (json.dumps(card, indent=1, ensure_ascii=False) + "\n").encode()}
    for path in EXAMPLES.glob("*.txt"):
        if examples:
            files[path.stem] = path.read_bytes()
        else:  # those of an export that is replaced would not fit the new card
            (folder / path.stem).unlink(missing_ok=True)
    for name, content in files.items():
        with whole_file(folder / name, overwrite=True) as temporary:
            Path(temporary).write_bytes(content)
    return folder
