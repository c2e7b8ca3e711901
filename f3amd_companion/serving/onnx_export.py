"""A model as ONNX: what engines and web pages load, for any number of characters or captions.

What is exported is one evaluation of the denoiser, with its condition, and not a whole round:

    F3AMD, CAMDM:  x0_hat = denoiser(x_noisy [B, T, C], sigma [B], history [B, H, C], path [B, T, 8], style [B, S])
    ACMDM:         prediction = denoiser(state [B, l, J, C], time [B], text [B, W], mask [B, l])
    MotionPCM:     prediction = denoiser(state [B, 16, 32], time [B], text [B, W], guidance [B])

One file then serves any number of steps, any sampler and any B; a page that offers 8 steps and 1 loads the weights
once. The walk around it is three lines in any language (DDIM, `diffusion.samplers.ddim_step`). The price is that the
condition is encoded anew at every step, 43 tokens through three linear layers. A whole round with the sampler inside
is what `serving.export` makes, for StableHLO and IREE.

A card (JSON) describes the program: shapes, scales of the features, skeleton, styles, noise levels, and how far the
program is from JAX; and, of F3AMD and CAMDM, a worked example in Python and one in C#.

`prediction` is what the network was trained to say: x0, the noise or the velocity. A teacher of MotionPCM has no input
`guidance`; whoever guides it, or ACMDM, calls twice (ACMDM section 4.1, MotionPCM Eq. 11), the second time with zeros
for the text, or for a teacher of Sentence-T5 with its vector of the empty caption. The card has the times to ask at,
and the shares of signal and noise there, so that the walk is three lines:

    x0, eps = from prediction, state, alpha, sigma;   state = alpha_next x0 + sigma_next eps

What an autoencoder makes of a latent is not exported, nor is the text encoder: the card says which one it was.
"""

import contextlib
import io
import json
import logging
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from f3amd_lib.diffusion.flow import network_time
from f3amd_lib.ground.files import read_toml, write_whole
from f3amd_lib.ground.names import check_known
from f3amd_lib.ground.trees import describe
from f3amd_lib.motion.skeleton import describe_skeleton
from f3amd_lib.networks.conditioning import PATH_CHANNELS, Condition, ConditionedConfig
from f3amd_lib.text.networks.acmdm import ACMDMConfig, TextCondition
from f3amd_lib.text.networks.motionpcm import LatentDenoiserConfig
from f3amd_lib.text.phases import cut_phases, ddim_times, shares
from f3amd_lib.text.stages.text_models import LatentModel, TextModel, load_text_model
from f3amd_lib.training.checkpoints import EIGHT_BITS_FROM, TrainedModel, network_with

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
      network: with its weights: F3AMD, CAMDM, ACMDM, or a teacher or student of MotionPCM.
      batch: B; by default the program takes any.
      weights: one of `WEIGHTS`.

    Returns:
      The file's content. Inputs, float32, and output are those of `signature`.

    Raises:
      ImportError: if jax2onnx is not installed, saying how to install it.
      ValueError: for another network, less than one character, or unknown `weights`.
    """
    if batch is not None and batch < 1:
        raise ValueError(f"batch must be at least 1 character, got {batch}")
    inputs, output, ask = signature(network.config, batch or "B")
    check_known(weights, WEIGHTS, "weights")
    try:
        import jax2onnx
    except ImportError as error:
        raise ImportError(f"ONNX needs jax2onnx ({error}): {INSTALL}") from None

    # Some weights are kept in bfloat16, which few runtimes compute in; widening them changes nothing.
    graph, state = nnx.split(network)
    network = nnx.merge(graph, jax.tree.map(lambda leaf: leaf.astype(jnp.float32), state))
    logging.getLogger("onnx_ir").setLevel(logging.ERROR)  # it warns of every shape that it does not need to know
    with contextlib.redirect_stdout(io.StringIO()):  # it tells of its own progress
        model = jax2onnx.to_onnx(
            lambda *given: ask(network, *given), list(inputs.values()), model_name="denoiser",
            input_names=list(inputs), output_names=[output],
        )  # fmt: skip
    if weights != "float32":
        _store_small(model.graph, weights)
    return model.SerializeToString()


class Signature(NamedTuple):
    """How a network is called as a program.

    Attributes:
      inputs: shapes by name, in the order of a call; the output has the shape of the first.
      output: its name.
      ask: `ask(network, *inputs)`; of a mask, 1 is motion and 0 padding.
    """

    inputs: dict[str, tuple]
    output: str
    ask: Callable


def signature(config, batch) -> Signature:
    """Return how a network is called; `batch` may be a name. ValueError for a network of another kind."""
    if isinstance(config, ConditionedConfig):
        frames, history = (batch, config.window, config.channels), (batch, config.num_history, config.channels)
        path, style = (batch, config.window, PATH_CHANNELS), (batch, config.num_styles)
        inputs = {"x_noisy": frames, "sigma": (batch,), "history": history, "path": path, "style": style}
        ask = lambda network, x_noisy, sigma, *given: network(x_noisy, sigma, network.encode(Condition(*given)))
        return Signature(inputs, "x0_hat", ask)
    if type(config) not in (ACMDMConfig, LatentDenoiserConfig):  # of masked ACMDM one evaluation is another thing
        known = "networks of history, path and style, ACMDM, and teacher or student of MotionPCM"
        raise ValueError(f"only {known} are exported, got {type(config).__name__}")
    state = config.state_shape(batch)
    inputs = {"state": state, "time": (batch,), "text": (batch, config.text_width)}
    if type(config) is ACMDMConfig:
        ask = lambda network, state, time, text, mask: network(
            state, time, network.encode(TextCondition(text, mask > 0.5))
        )
        return Signature(inputs | {"mask": state[:2]}, "prediction", ask)
    inputs |= {"guidance": (batch,)} if config.guidance_features else {}
    ask = lambda network, state, time, text, *guidance: network(state, time, network.encode(text), *guidance)
    return Signature(inputs, "prediction", ask)


def _store_small(graph, weights: str) -> None:
    """Keep large float32 constants in fewer bits, and widen them by nodes that a runtime folds away.

    In 8 bits each column of the last axis has a scale of its own, as in `checkpoints.save_model`.
    """
    from onnx import TensorProto, helper, numpy_helper

    widening = []
    for constant in list(graph.initializer):
        value = numpy_helper.to_array(constant)
        if value.dtype != np.float32 or value.ndim < 2 or value.size < EIGHT_BITS_FROM:
            continue
        name, small = constant.name, f"{constant.name}_small"
        if weights == "float16":
            constant.CopyFrom(numpy_helper.from_array(value.astype(np.float16), small))
            widening.append(helper.make_node("Cast", [small], [name], to=TensorProto.FLOAT))
            continue
        largest = np.abs(value).max(axis=-2, keepdims=True)
        scale = np.where(largest > 0, largest, 1.0).astype(np.float32) / np.float32(127)
        constant.CopyFrom(numpy_helper.from_array(np.rint(value / scale).astype(np.int8), small))
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
    draw, shapes = np.random.default_rng(0), signature(config, batch).inputs
    inputs = {name: draw.normal(size=shape).astype(np.float32) for name, shape in shapes.items()}
    kept = {"sigma": np.ones(batch), "time": np.ones(batch), "guidance": np.linspace(5.0, 15.0, batch)}
    if "style" in inputs:
        kept["style"] = np.eye(config.num_styles)[np.arange(batch) % config.num_styles]
    if "mask" in inputs:
        kept["mask"] = np.ones(shapes["mask"])
        kept["mask"][1::2, -(shapes["mask"][1] // 4 or 1) :] = 0
    return inputs | {name: kept[name].astype(np.float32) for name in inputs if name in kept}


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
    ask, differences = jax.jit(partial(signature(network.config, 2).ask, network)), []
    for value in np.asarray(levels, np.float32):
        scale = value if level == "sigma" else np.float32(1)
        asked = inputs | {state: scale * inputs[state], level: np.full_like(inputs[level], value)}
        gap = np.abs(run(**asked) - np.asarray(ask(*asked.values())))
        differences.append((gap[inputs["mask"] > 0.5] if "mask" in inputs else gap).max())
    return float(max(differences))


def load_text_or_latent(path) -> TextModel | LatentModel | None:
    """Read a model of text to motion; None for a weights file of another kind, ValueError for one that is damaged."""
    return load_text_model(path) if describe(path).get("kind") in (TextModel.kind, LatentModel.kind) else None


def asked_at(trained: TextModel | LatentModel, num_steps: int) -> dict[str, list[float]]:
    """Return what the walk visits, N + 1 numbers each: `time` that the network is told, `alpha` and `sigma` there.

    A student of MotionPCM jumps along the edges of N phases, with the skip of its training; a teacher takes the
    levels of `ddim_times`.
    """
    schedule = trained.schedule
    if isinstance(trained, TextModel):
        times = network_time(schedule, np.append(schedule.times(num_steps), 1.0))
        alpha, sigma = schedule.scaled_grid(num_steps)
    else:
        levels = len(schedule.levels)
        if trained.config.guidance_features:
            times = cut_phases(levels, trained.training.get("skip", 100), num_steps).visited
        else:
            times = ddim_times(levels, num_steps)
        alpha, sigma = shares(schedule, times, np)
    visited = {"time": times, "alpha": alpha, "sigma": sigma}
    return {name: np.asarray(values, float).tolist() for name, values in visited.items()}


def model_card(trained: TrainedModel | TextModel | LatentModel, num_steps: int) -> dict:
    """Return what whoever runs the program has to know, JSON-ready.

    Arrays are [batch, frames, ...], metres, radians, +Y up; a character with yaw 0 faces +Z. Noise levels or times are
    listed for 1 and for `num_steps`, but for a student of MotionPCM for the number that it was trained for.
    """
    inputs, output, _ = signature(trained.config, "B")
    shapes = {name: {"shape": list(shape)} for name, shape in inputs.items()}
    walks, latent = isinstance(trained, TrainedModel), isinstance(trained, LatentModel)
    record, counts = trained.record, sorted({1, num_steps})
    card = {
        "format": "f3amd-onnx-1" if walks else "f3amd-onnx-text-1",
        "model": trained.name,
        "data": record.get("dataset"),
        "terms": record.get("dataset_licence"),
        "credit": record.get("dataset_credit"),
        "frames_per_second": 30 if walks else trained.fps,
        "inputs": shapes,
        "output": {output: next(iter(shapes.values()))},
    }
    skeleton = describe_skeleton(trained.skeleton) | {"offsets": np.asarray(trained.skeleton.offsets).tolist()}
    numbers = lambda scales, kind: {name: np.asarray(value, kind).tolist() for name, value in scales._asdict().items()}
    if walks:
        return card | {
            "about": ABOUT["walk"],
            "normaliser": numbers(trained.normaliser, np.float32),
            "skeleton": skeleton,
            "styles": list(trained.styles),
            "sampler": trained.diffusion.sampler,
            "sigmas": {number: trained.diffusion.grid(number).tolist() for number in counts},
        }
    if latent and trained.config.guidance_features:
        counts = [trained.training.get("num_phases", 1)]
    told = {"decoder": None}
    if latent and np.any(trained.empty):
        told["no_text"] = np.asarray(trained.empty).tolist()
    if latent or trained.codec.autoencoder is not None:
        made = "motion is" if latent else "positions are"
        told["decoder"] = f"the state is a latent: {made} what the model's autoencoder makes of it, not exported"
    else:
        told["normaliser"] = numbers(trained.codec.axes, float)
    return card | {
        "predicts": trained.config.objective,
        "text_encoder": trained.text_encoder,
        "about": {name: text for name, text in ABOUT["text"].items() if name in inputs or name in told},
        "skeleton": skeleton,
        "steps": {str(number): asked_at(trained, number) for number in counts},
        **told,
    }


def export_onnx(
    trained: TrainedModel | TextModel | LatentModel, folder, *, num_steps: int = 8, batch: int | None = None,
    weights: str = "float32", overwrite: bool = False,
) -> Path:  # fmt: skip
    """Write a model as ONNX with its card, and of one that walks worked examples: `f3amd export --target onnx`.

    Args:
      trained: the model, with a denoiser.
      folder: is made, if need be; each file is written whole or not at all.
      num_steps: for which the card lists noise levels or times, beside 1 (`model_card`). The program is compared with
        JAX at them, and the card says how far apart they are, in network units (`largest_error`).
      batch, weights: as for `denoiser_program`.
      overwrite: replace an earlier export.

    Returns:
      The folder.

    Raises:
      ImportError, ValueError: as `denoiser_program`; if the file holds an autoencoder alone, or an export is there that
        may not be replaced, said before anything is made.
    """
    folder = Path(folder)
    if trained.config is None:
        raise ValueError(f"{trained.name} is only an autoencoder: export a model that denoises")
    if isinstance(trained, LatentModel) and trained.training.get("consistency") == "latent":
        raise ValueError(f"{trained.name} draws noise between its steps, which a card cannot tell; export another")
    for name in (PROGRAM, CARD, *(path.stem for path in EXAMPLES.glob("*.txt"))):
        if not overwrite and (folder / name).exists():
            raise ValueError(f"{folder / name}: exists already; pass --overwrite or another --out")
    card, network = model_card(trained, num_steps), network_with(trained.config, trained.params)
    walks = isinstance(trained, TrainedModel)
    levels = card["sigmas"][num_steps] if walks else list(card["steps"].values())[-1]["time"]
    program = denoiser_program(network, batch=batch, weights=weights)
    error = largest_difference(program, network, levels[:-1])
    card |= {"batch": batch or "any", "weights": weights, "bytes": len(program), "largest_error": error}
    files = {PROGRAM: program, CARD: (json.dumps(card, indent=1, ensure_ascii=False) + "\n").encode()}
    for path in EXAMPLES.glob("*.txt"):
        if walks:
            files[path.stem] = path.read_bytes()
        else:  # those of an export that is replaced would not fit the new card
            (folder / path.stem).unlink(missing_ok=True)
    for name, content in files.items():
        write_whole(folder / name, content)
    return folder
