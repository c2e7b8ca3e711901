"""Where the paper is silent, and what this companion does there.

Each entry that is a setting names the field that holds it, and its value is read from the code, so
that the table in the notebooks shows what runs.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import pandas as pd

from f3amd_lib.diffusion.schedules import VarianceExploding
from f3amd_lib.models.f3amd import F3AMDConfig
from f3amd_lib.training.loop import TrainingConfig

__all__ = ["READINGS", "Reading", "readings_table"]

_CONFIGS = {config.__name__: config for config in (F3AMDConfig, TrainingConfig, VarianceExploding)}


@dataclass(frozen=True)
class Reading:
    """An open point of the paper and our filling.

    Attributes:
      topic: "data", "diffusion", "architecture" or "training".
      point: what is open.
      paper: what the paper says about it.
      ours: what is done here; "{}" is replaced by the default of `field`.
      field: "Class.field" of the setting, or "" where it is no setting.
    """

    topic: str
    point: str
    paper: str
    ours: str
    field: str = ""

    def filling(self) -> str:
        """Return `ours` with the code's own default in it."""
        if not self.field:
            return self.ours
        owner, name = self.field.split(".")
        defaults = {item.name: item.default for item in dataclasses.fields(_CONFIGS[owner])}
        return self.ours.format(defaults[name])


READINGS = (
    Reading(
        "data",
        "origin of the relative x, z",
        "“the first frame” (3.2)",
        "the last history frame, so that a seam is a step from zero",
    ),
    Reading(
        "data",
        "which columns make 6D",
        "cites Zhou et al. (3.2)",
        "the first two columns of the matrix, as cited",
    ),
    Reading(
        "data",
        "smoothness of the path condition",
        "not said; CAMDM smooths",
        "a share of {} as captured, the rest smoothed with 5 or 10 frames; `-plus` 0.25",
        "TrainingConfig.captured_path_share",
    ),
    Reading("data", "contact of a toe", "cites MDM (App. B)", "moves less than 1 cm in a frame"),
    Reading(
        "architecture",
        "residual around the cross-attention",
        "not said (3.3)",
        "c is the question (noise embedding and position code) plus the answer",
    ),
    Reading(
        "architecture",
        "edges of Conv_k",
        "not said (Eq. 3)",
        "zeros beyond the window's ends",
    ),
    Reading(
        "architecture",
        "noise embedding",
        "cites Karras et al. 2024 (3.3)",
        "their random Fourier features, then two layers with SiLU between",
    ),
    Reading(
        "training",
        "the two windows of Eq. 10",
        "two predictions, x0_hat of rounds k and k + 1 (4.1)",
        "the captured last history frame and the prediction: a training sample is one window",
    ),
    Reading(
        "training",
        "norms of Eqs 10 to 14",
        "squared norms, all weights 1",
        "means over batch, frames and entries, as in CAMDM's code",
    ),
    Reading(
        "diffusion",
        "noise levels of N steps",
        "“flexible step counts” (3.5)",
        "t = linspace(0, 1, N), then sigma = 0; t = i/N is an option",
    ),
    Reading(
        "diffusion",
        "noise levels in training",
        "t in [0, 1] (3.5), distribution not said",
        "“{}”: t uniform in Eq. 9",
        "TrainingConfig.noise",
    ),
    Reading(
        "diffusion",
        "state between DDIM steps",
        "takes a VE state, returns a VP one (App. F)",
        "rescaled, which makes it the Euler step of notebook 02",
    ),
    Reading(
        "diffusion",
        "alpha_t of Appendix F",
        "defined, with a root that DDPM's has not",
        "not needed by the update, left out",
    ),
    Reading(
        "architecture",
        "scale of the noisy input",
        "not said (x reaches 128)",
        "input_scaling = {}: times 1 / sqrt(sigma² + sigma_data²)",
        "F3AMDConfig.input_scaling",
    ),
    Reading(
        "architecture",
        "scale of the features",
        "not said",
        "normalise = {}: mean 0, deviation 1 per channel",
        "F3AMDConfig.normalise",
    ),
    Reading(
        "architecture",
        "position code on the query of c",
        "not said (3.3)",
        "sinusoids on queries and tokens; without it c is constant in time",
    ),
    Reading(
        "architecture",
        "heads of that cross-attention",
        "not said",
        "{}",
        "F3AMDConfig.num_condition_heads",
    ),
    Reading("architecture", "kernel size k of Eq. 3", "“Conv_k”", "{}", "F3AMDConfig.kernel_size"),
    Reading("architecture", "width of c", "C_cond, no number", "equal to D"),
    Reading(
        "architecture",
        "noise embedding",
        "cites Karras et al. 2024",
        "random Fourier features of log(sigma)/4, then two linear layers",
    ),
    Reading(
        "architecture",
        "residual connections",
        "none drawn (Figure 2)",
        "block_residual = {}; the -plus presets add them",
        "F3AMDConfig.block_residual",
    ),
    Reading("training", "optimiser", "not named", "Adam without weight decay"),
    Reading(
        "training",
        "“inverse-square” learning rate",
        "5e-4, decay constant 1e5 (4.5)",
        "“{}”: 5e-4 (1 + step/1e5)^-2; inverse root is an option",
        "TrainingConfig.schedule",
    ),
    Reading(
        "training",
        "IRD of real motion",
        "lower is better (4.4)",
        "a walker moves some 4 to 6 cm a frame; reported literally, beside the real step, and as "
        "an excess over it",
    ),
)
"""Open points, in the order in which the paper meets them."""


def readings_table(*topics: str) -> pd.DataFrame:
    """Return open points as a table: topic, open point, paper, ours.

    Args:
      *topics: keep only these; all by default.

    Raises:
      ValueError: for a topic without entries.
    """
    known = list(dict.fromkeys(reading.topic for reading in READINGS))
    for topic in topics:
        if topic not in known:
            raise ValueError(f"unknown topic {topic!r}: use one of {', '.join(known)}")
    return pd.DataFrame(
        [
            {
                "topic": reading.topic,
                "open point": reading.point,
                "the paper": reading.paper,
                "here": reading.filling(),
            }
            for reading in READINGS
            if not topics or reading.topic in topics
        ]
    )
