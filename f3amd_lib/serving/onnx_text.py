"""A model of text to motion as ONNX: one evaluation of ACMDM's or MotionPCM's network, for any number of captions.

    ACMDM:      prediction = denoiser(state [B, l, J, C], time [B], text [B, W], mask [B, l])
    MotionPCM:  prediction = denoiser(state [B, 16, 32], time [B], text [B, W], guidance [B])

`prediction` is what the network was trained to say: x0, the noise or the velocity. A teacher of MotionPCM has no input
`guidance`; whoever guides it, or ACMDM, calls twice (ACMDM section 4.1, MotionPCM Eq. 11), the second time with zeros
for the text. The card has the times to ask at, and the shares of signal and noise there, so that the walk is three
lines:

    x0, eps = from prediction, state, alpha, sigma;   state = alpha_next x0 + sigma_next eps

What an autoencoder makes of a latent is not exported, nor is the text encoder: the card says which one it was.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np

from f3amd_lib.diffusion.flow import network_time
from f3amd_lib.diffusion.phases import cut_phases, ddim_times, shares
from f3amd_lib.networks.acmdm import ACMDM, ACMDMConfig, TextCondition
from f3amd_lib.networks.motionpcm import LatentDenoiser
from f3amd_lib.serving.onnx_export import OnnxProgram, check_batch, onnx_program, write_export
from f3amd_lib.training.checkpoints import describe_skeleton, file_kind, network_with
from f3amd_lib.training.latent_models import LatentModel, load_latent_model
from f3amd_lib.training.text_models import TextModel, load_text_model

OUTPUT = "prediction"

_LOADERS = {"text-to-motion model": load_text_model, "latent motion model": load_latent_model}


def load_text_or_latent(path) -> TextModel | LatentModel | None:
    """Read a model of text to motion; None for a weights file of another kind, ValueError for one that is damaged."""
    load = _LOADERS.get(file_kind(path))
    return load and load(path)


def text_program(network: ACMDM | LatentDenoiser, *, batch: int | None = None, weights: str = "float32") -> bytes:
    """Return one evaluation of a text-to-motion network as an ONNX program, weights inside.

    Args:
      network: with its weights; masked ACMDM has another evaluation and is refused, so is a control branch.
      batch: B; by default the program takes any.
      weights: one of `onnx_export.WEIGHTS`.

    Raises:
      ImportError, ValueError: as `onnx_program`; for another network.
    """
    return onnx_program(network, _evaluate, text_inputs(network, check_batch(batch)), OUTPUT, weights=weights)


def text_inputs(network, batch) -> dict[str, tuple]:
    """Return input -> shape in the order of a call; `batch` may be a name. ValueError for a network of another kind."""
    if isinstance(network, ACMDM):
        config = network.config
        state = config.state_shape(batch)
        return {"state": state, "time": (batch,), "text": (batch, config.text_width), "mask": state[:2]}
    if isinstance(network, LatentDenoiser):
        config = network.config
        inputs = {"state": config.state_shape(batch), "time": (batch,), "text": (batch, config.text_width)}
        return inputs | ({"guidance": (batch,)} if config.guidance_features else {})
    raise ValueError(f"only ACMDM and teacher or student of MotionPCM are exported, got {type(network).__name__}")


def _evaluate(network, state, time, text, last=None):
    """Ask a network; `last` is the mask (1 or 0) of ACMDM, or the guidance that a student is told."""
    if isinstance(network, ACMDM):
        return network(state, time, network.encode(TextCondition(text, last > 0.5)))
    return network(state, time, network.encode(text), last)


def seeded_text_inputs(network, batch: int, seed: int = 0) -> dict[str, np.ndarray]:
    """Return inputs to compare programs by, float32; the last quarter of each second sample is padding."""
    draw = np.random.default_rng(seed)
    inputs = {name: draw.normal(size=shape).astype(np.float32) for name, shape in text_inputs(network, batch).items()}
    if "mask" in inputs:
        inputs["mask"] = np.ones_like(inputs["mask"])
        inputs["mask"][1::2, -(inputs["mask"].shape[1] // 4 or 1) :] = 0
    if "guidance" in inputs:
        inputs["guidance"] = np.linspace(5.0, 15.0, batch, dtype=np.float32)
    return inputs


def text_difference(program: bytes, network, times, batch: int = 2) -> float:
    """Return how far a program is from JAX at each of the times, network units: the largest of all numbers.

    What is said of padding means nothing, and is not compared.
    """
    run = OnnxProgram(program)
    fixed = run.input_shapes["time"][0]
    inputs = seeded_text_inputs(network, fixed if isinstance(fixed, int) else batch)
    differences = []
    for time in times:
        inputs["time"] = np.full(len(inputs["state"]), time, np.float32)
        gap = np.abs(run(**inputs) - np.asarray(_evaluate(network, *inputs.values())))
        differences.append((gap[inputs["mask"] > 0.5] if "mask" in inputs else gap).max())
    return float(max(differences))


def asked_at(trained: TextModel | LatentModel, num_steps: int) -> dict[str, list[float]]:
    """Return what the walk visits, N + 1 numbers each: `time` that the network is told, `alpha` and `sigma` there.

    A student of MotionPCM jumps along the edges of N phases, with the skip of its training; a teacher takes the
    levels of `ddim_times`.
    """
    schedule = trained.schedule
    if isinstance(trained.config, ACMDMConfig):
        times = network_time(schedule, np.append(schedule.times(num_steps), 1.0))
        alpha, sigma = schedule.scaled_grid(num_steps)
    else:
        levels = len(schedule.levels)
        if trained.config.guidance_features:
            times = cut_phases(levels, _training(trained).get("skip", 100), num_steps).visited
        else:
            times = ddim_times(levels, num_steps)
        alpha, sigma = shares(schedule, times, np)
    return {
        name: np.asarray(values, float).tolist()
        for name, values in (("time", times), ("alpha", alpha), ("sigma", sigma))
    }


def _training(trained: LatentModel) -> dict:
    return trained.record.get("identity", {}).get("training", {})


def step_counts(trained: TextModel | LatentModel, num_steps: int) -> list[int]:
    """Return the numbers of steps that a card lists: 1 and `num_steps`, but of a student the one it was trained for."""
    student = isinstance(trained, LatentModel) and trained.config.guidance_features
    return [_training(trained).get("num_phases", 1)] if student else sorted({1, num_steps})


def text_card(trained: TextModel | LatentModel, network, num_steps: int) -> dict:
    """Return what whoever runs the program has to know, JSON-ready."""
    record = trained.record
    card = {
        "format": "f3amd-onnx-text-1",
        "model": trained.name,
        "data": record.get("dataset"),
        "terms": record.get("dataset_licence"),
        "credit": record.get("dataset_credit"),
        "frames_per_second": trained.fps,
        "inputs": {name: {"shape": list(shape)} for name, shape in text_inputs(network, "B").items()},
        "output": {OUTPUT: {"shape": list(trained.config.state_shape("B"))}},
        "predicts": network.config.objective,
        "text_encoder": trained.text_encoder,
        "about": {
            "state": "alpha x0 + sigma eps, network units; standard normal noise at the first time",
            "time": "of `steps`, one a caption",
            "text": "pooled vector of the text encoder; zeros stand for no text",
            "mask": "1 where a frame is motion, 0 in the padding after it",
            "guidance": "w of MotionPCM Eq. 11, 14 in its tests",
        },
        "skeleton": describe_skeleton(trained.skeleton) | {"offsets": np.asarray(trained.skeleton.offsets).tolist()},
        "steps": {str(number): asked_at(trained, number) for number in step_counts(trained, num_steps)},
    }
    card["about"] = {name: text for name, text in card["about"].items() if name in card["inputs"]}
    if isinstance(trained, LatentModel):
        card["decoder"] = "the state is a latent: motion is what the model's autoencoder makes of it, not exported"
    elif trained.codec.autoencoder is not None:
        card["decoder"] = "the state is a latent: positions are what the model's autoencoder makes of it, not exported"
    else:
        axes = {name: np.asarray(value, float).tolist() for name, value in trained.codec.axes._asdict().items()}
        card |= {"decoder": None, "normaliser": axes}
        card["about"]["normaliser"] = (
            "joint positions in metres: the state's first three numbers a joint * deviation + mean"
        )
    return card


def export_text_onnx(
    trained: TextModel | LatentModel,
    folder,
    *,
    num_steps: int = 8,
    batch: int | None = None,
    weights: str = "float32",
    overwrite: bool = False,
) -> Path:
    """Write a model of text to motion as ONNX with its card: `f3amd export --target onnx --weights FILE`.

    Args:
      trained: the model, with a denoiser.
      folder: is made, if need be.
      num_steps: for which the card lists times, beside 1; a student of MotionPCM has its own number.
      batch, weights: as for `text_program`.
      overwrite: replace an earlier export.

    Returns:
      The folder; its card says how far the program is from JAX at the times of `num_steps` steps (`largest_error`),
      network units.

    Raises:
      ImportError, ValueError: as `text_program`; if the file holds an autoencoder alone, or an export is there.
    """
    if trained.config is None:
        raise ValueError(f"{trained.name} is an autoencoder alone: export a model that denoises")
    network = network_with(trained.config, trained.params)
    card = text_card(trained, network, num_steps)
    times = list(card["steps"].values())[-1]["time"][:-1]
    return write_export(
        folder,
        card,
        partial(text_program, network),
        lambda program: text_difference(program, network, times),
        batch=batch,
        weights=weights,
        overwrite=overwrite,
    )
