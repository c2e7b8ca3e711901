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

from pathlib import Path

import numpy as np

from f3amd_companion.serving.onnx_export import ABOUT, card_head, skeleton_card, write_export
from f3amd_lib.diffusion.flow import network_time
from f3amd_lib.ground.trees import file_kind
from f3amd_lib.text.networks.acmdm import ACMDMConfig
from f3amd_lib.text.phases import cut_phases, ddim_times, shares
from f3amd_lib.text.stages.text_models import LatentModel, TextModel, load_text_model
from f3amd_lib.training.checkpoints import network_with


def load_text_or_latent(path) -> TextModel | LatentModel | None:
    """Read a model of text to motion; None for a weights file of another kind, ValueError for one that is damaged."""
    return load_text_model(path) if file_kind(path) in (TextModel.kind, LatentModel.kind) else None


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
            times = cut_phases(levels, trained.training.get("skip", 100), num_steps).visited
        else:
            times = ddim_times(levels, num_steps)
        alpha, sigma = shares(schedule, times, np)
    visited = {"time": times, "alpha": alpha, "sigma": sigma}
    return {name: np.asarray(values, float).tolist() for name, values in visited.items()}


def step_counts(trained: TextModel | LatentModel, num_steps: int) -> list[int]:
    """Return the numbers of steps that a card lists: 1 and `num_steps`, but of a student the one it was trained for."""
    student = isinstance(trained, LatentModel) and trained.config.guidance_features
    return [trained.training.get("num_phases", 1)] if student else sorted({1, num_steps})


def text_card(trained: TextModel | LatentModel, num_steps: int) -> dict:
    """Return what whoever runs the program has to know, JSON-ready."""
    card = card_head(trained, "f3amd-onnx-text-1", trained.fps)
    latent = isinstance(trained, LatentModel) or trained.codec.autoencoder is not None
    explained = [*card["inputs"], *([] if latent else ["normaliser"])]
    card |= {
        "predicts": trained.config.objective,
        "text_encoder": trained.text_encoder,
        "about": {name: text for name, text in ABOUT["text"].items() if name in explained},
        "skeleton": skeleton_card(trained.skeleton),
        "steps": {str(number): asked_at(trained, number) for number in step_counts(trained, num_steps)},
    }
    if not latent:
        axes = {name: np.asarray(value, float).tolist() for name, value in trained.codec.axes._asdict().items()}
        return card | {"decoder": None, "normaliser": axes}
    made = "motion is" if isinstance(trained, LatentModel) else "positions are"
    return card | {"decoder": f"the state is a latent: {made} what the model's autoencoder makes of it, not exported"}


def export_text_onnx(trained: TextModel | LatentModel, folder, *, num_steps: int = 8, **how) -> Path:
    """Write a model of text to motion as ONNX with its card: `f3amd export --target onnx --weights FILE`.

    Args:
      trained: the model, with a denoiser.
      folder: is made, if need be.
      num_steps: for which the card lists times, beside 1; a student of MotionPCM has its own number. The program is
        compared with JAX at them.
      **how: batch, weights and overwrite, of `onnx_export.write_export`.

    Raises:
      ImportError, ValueError: as `onnx_export.write_export`; if the file holds an autoencoder alone.
    """
    if trained.config is None:
        raise ValueError(f"{trained.name} is an autoencoder alone: export a model that denoises")
    card = text_card(trained, num_steps)
    times = list(card["steps"].values())[-1]["time"][:-1]
    return write_export(folder, network_with(trained.config, trained.params), card, times, **how)
