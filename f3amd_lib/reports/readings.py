"""Where the paper is silent, what this companion does there, and why.

Each entry that is a setting names the field that holds it, and its value is read from the code, so
that the table in the notebooks shows what runs.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import pandas as pd

from f3amd_lib.diffusion.schedules import VarianceExploding, VariancePreservingCosine
from f3amd_lib.networks.camdm import CAMDMConfig
from f3amd_lib.networks.f3amd import F3AMDConfig
from f3amd_lib.networks.zoo import PRESETS
from f3amd_lib.training.recipe import TrainingConfig

_CONFIGS = {
    config.__name__: config
    for config in (F3AMDConfig, CAMDMConfig, TrainingConfig, VarianceExploding, VariancePreservingCosine)
}


@dataclass(frozen=True)
class Reading:
    """An open point of the paper and our filling.

    Attributes:
      topic: "data", "architecture", "variants" (Tables 8 to 11), "CAMDM", "training" or
        "diffusion".
      point: what is open.
      paper: what the paper says about it.
      ours: what is done here; "{}" is replaced by the value of `field`.
      why: the reason.
      field: "Class.field" of the setting, for its default; "preset.field" (or a field inside that)
        for what a preset sets it to; "" where it is no setting.
    """

    topic: str
    point: str
    paper: str
    ours: str
    why: str
    field: str = ""

    def filling(self) -> str:
        """Return `ours` with the code's own value in it."""
        return self.ours.format(_value(self.field)) if self.field else self.ours


def _value(field: str):
    """Look up a config's default or a preset's setting."""
    owner, *names = field.split(".")
    if owner in _CONFIGS:
        value = {item.name: item.default for item in dataclasses.fields(_CONFIGS[owner])}
    else:
        value = {**PRESETS[owner].network, **PRESETS[owner].training}
    for name in names:
        value = value[name]
    return value


READINGS = (
    # ------------------------------------------------------------------------------------- data
    Reading(
        "data",
        "origin of the relative x, z",
        "“the first frame” (3.2)",
        "the last history frame",
        "a seam is then a step from zero",
    ),
    Reading(
        "data", "which columns make 6D", "cites Zhou et al. (3.2)", "the first two columns of the matrix", "as cited"
    ),
    Reading(
        "data",
        "smoothness of the path condition",
        "not said",
        "a share of {} as captured, the rest smoothed with 5 or 10 frames; `-plus` 0.25",
        "paths that users draw do not sway; CAMDM's code smooths half of them",
        "TrainingConfig.captured_path_share",
    ),
    Reading(
        "data",
        "contact of a toe",
        "cites MDM (App. B)",
        "moves less than 1 cm in a frame",
        "the threshold of CAMDM's code",
    ),
    # ----------------------------------------------------------------------------- architecture
    Reading(
        "architecture",
        "scale of the noisy input",
        "not said (x reaches 128)",
        "input_scaling = {}: times 1 / sqrt(sigma² + sigma_data²); `-raw` has none",
        "the first layer would see numbers of 1 and of 128 alike",
        "F3AMDConfig.input_scaling",
    ),
    Reading(
        "architecture",
        "scale of the features",
        "not said",
        "normalise = {}: mean 0, deviation 1 per channel; `-raw` has none",
        "metres and matrix entries differ in size, and one noise level is added to both",
        "F3AMDConfig.normalise",
    ),
    Reading(
        "architecture",
        "noise embedding",
        "cites Karras et al. 2024 (3.3)",
        "random Fourier features of log(sigma) / 4, then two linear layers with SiLU between",
        "as cited",
    ),
    Reading(
        "architecture",
        "width of c",
        "C_cond, no number (3.3)",
        "equal to D",
        "tokens have “equal latent dimension”, so that no layer is needed between",
    ),
    Reading(
        "architecture",
        "position code on the query of c",
        "not said (3.3)",
        "sinusoids on queries and on history and path tokens",
        "without it c is constant in time",
    ),
    Reading(
        "architecture",
        "slowest sinusoid of position codes",
        "not said",
        "1,000 times slower than the fastest; 10,000 in CAMDM",
        "windows are shorter than sentences; CAMDM's sequences are longer, and its code has 10,000",
    ),
    Reading(
        "architecture",
        "heads of that cross-attention",
        "not said",
        "{}; `-plus` 4",
        "the least that fits the text",
        "F3AMDConfig.num_condition_heads",
    ),
    Reading(
        "architecture",
        "residual around that cross-attention",
        "not said (3.3)",
        "c is the question (noise embedding and position code) plus the answer",
        "the noise level reaches c without passing the attention weights",
    ),
    Reading(
        "architecture",
        "kernel size k of Eq. 3",
        "“Conv_k”",
        "{}",
        "the least that sees both neighbours",
        "F3AMDConfig.kernel_size",
    ),
    Reading(
        "architecture",
        "edges of Conv_k",
        "not said (Eq. 3)",
        "zeros beyond the window's ends",
        "the usual padding; the spectral branch already joins the ends",
    ),
    Reading(
        "architecture",
        "which blocks keep m modes",
        "“FNO blocks use 17 frequency modes” (4.5), “in FNO backbone” (App. E)",
        "encoder and decoder too, if they have so many",
        "they are FNO blocks, and m belongs to the block (Eq. 2); App. E can be read either way",
    ),
    Reading(
        "architecture",
        "residual connections",
        "none drawn (Figure 2)",
        "block_residual = {}; `-plus` has them",
        "as drawn",
        "F3AMDConfig.block_residual",
    ),
    Reading(
        "architecture",
        "norm and activation of the Transformer block",
        "“standard”, cites Vaswani et al. (3.4.1)",
        "layer normalisation after each sum; exact GELU",
        "post-norm as cited; GELU as in CAMDM's code, so that both families have one block",
    ),
    Reading(
        "architecture",
        "its feed-forward width",
        "not said",
        "{} D",
        "as in Vaswani et al.",
        "F3AMDConfig.feed_forward_factor",
    ),
    Reading(
        "architecture",
        "its dropout",
        "not said",
        "{}",
        "no other part of the family drops anything",
        "F3AMDConfig.dropout",
    ),
    Reading(
        "architecture",
        "where its position code enters",
        "“with positional encodings” (3.4.1)",
        "added once, between encoder and first block",
        "as in Vaswani et al.",
    ),
    # --------------------------------------------------------------------------------- variants
    Reading(
        "variants",
        "which blocks Table 8 changes",
        "“FNO backbone variants” (App. E)",
        "the backbone's; encoder and decoder stay as they are",
        "as worded",
    ),
    Reading(
        "variants",
        "modes and weights of DCT",
        "not said",
        "all T cosine modes (32), real weights",
        "the baseline cuts nothing either, and 32 real weights are nearly 17 complex ones",
    ),
    Reading(
        "variants",
        "“rank = 8”",
        "“low-rank factorization … of spectral kernels” (App. E)",
        "the D x D weights of every mode are a product D x {0} times {0} x D",
        "modes stay apart, as in Eq. 2",
        "F3AMDConfig.spectral_rank",
    ),
    Reading(
        "variants",
        "“weight = 0.7”",
        "“learnable per-mode gains” (App. E)",
        "a real gain for each mode that starts at {}",
        "what is learned can only start somewhere",
        "F3AMDConfig.initial_mode_gain",
    ),
    Reading(
        "variants",
        "concatenation: along which axis",
        "not said (Table 11)",
        "time: T frames of c, then T of z, joined once; the last T are kept",
        "CAMDM concatenates in time (2.1), and Table 11 has it take 2.05 times as long; a linear "
        "layer on joined channels would cost no more than FiLM",
    ),
    Reading(
        "variants",
        "its kept modes",
        "not said",
        "all 33 of 64 frames; encoder and decoder 17 of 32",
        "as for windows of 64 frames (4.5)",
    ),
    Reading(
        "variants",
        "what AdaLN-zero wraps",
        "not said (Table 11)",
        "the whole base block: shift and scale before, gate behind, input added; no layer of Eq. 7",
        "as DiT wraps its blocks; it starts as the identity",
    ),
    Reading(
        "variants",
        "who asks whom in cross-attention",
        "not said (Table 11)",
        "the frames behind the base block ask c; the answer is added, then the layer of Eq. 7",
        "only the way in differs from FiLM",
    ),
    # ------------------------------------------------------------------------------------ CAMDM
    Reading(
        "CAMDM",
        "tokens of the path",
        "T' = 2T + T_hist + T_style (6)",
        "one a frame, displacement and yaw together: 76 tokens; `CAMDM-code` two, 108",
        "2T leaves room for T path and T noisy frames",
    ),
    Reading(
        "CAMDM",
        "token of the noise level",
        "not in that sum",
        "one more",
        "CAMDM's code has one, and the network must be told",
    ),
    Reading("CAMDM", "attention heads", "not said", "{}", "CAMDM's code", "CAMDMConfig.num_heads"),
    Reading("CAMDM", "feed-forward width", "not said", "{} D", "CAMDM's code", "CAMDMConfig.feed_forward_factor"),
    Reading(
        "CAMDM",
        "dropout in `CAMDM`",
        "not said",
        "{}",
        "“all models are trained under the same parameter settings where possible” (4.2)",
        "CAMDMConfig.dropout",
    ),
    Reading("CAMDM", "dropout in `CAMDM-code`", "not said", "{}", "CAMDM's code", "CAMDM-code.dropout"),
    Reading(
        "CAMDM",
        "history masked in training, `CAMDM`",
        "not said",
        "a share of {}",
        "as for dropout",
        "TrainingConfig.history_dropout",
    ),
    Reading(
        "CAMDM",
        "history masked in training, `CAMDM-code`",
        "not said",
        "a share of {}",
        "CAMDM's code, which needs it for guidance at style changes",
        "CAMDM-code.history_dropout",
    ),
    Reading(
        "CAMDM",
        "scale of the features in `CAMDM`",
        "not said",
        "normalise = {}",
        "the same features for all models",
        "CAMDMConfig.normalise",
    ),
    Reading(
        "CAMDM",
        "training of `CAMDM-code`",
        "“CAMDM (PyTorch)” (Tables 6, 7): the published code",
        "the network, its dropout and its masking; features, losses, optimiser and average of the "
        "weights are this project's",
        "so it is no row of Table 6, which took the published weights",
    ),
    Reading(
        "CAMDM",
        "scale of the features in `CAMDM-code`",
        "not said",
        "normalise = {}",
        "CAMDM's code",
        "CAMDM-code.normalise",
    ),
    Reading(
        "CAMDM",
        "levels K of the schedule",
        "8 steps (Tables 1, 5)",
        "K = {}, `CAMDM-code` too (its own configuration has 4)",
        "8-step rows need 8 levels",
        "VariancePreservingCosine.num_levels",
    ),
    Reading(
        "CAMDM",
        "4, 2 and 1 steps",
        "not said whether trained anew",
        "the K = 8 network on some of its levels; `CAMDM-K4`, `-K2`, `-K1` are trained anew",
        "Table 5 speaks of one model",
    ),
    Reading(
        "CAMDM",
        "level of the single step",
        "not said",
        "the noisiest that was trained",
        "a sampler starts from noise alone",
    ),
    Reading(
        "CAMDM",
        "what its noise token holds",
        "not said",
        "sinusoids of the step's number, then two layers; `CAMDM-VE` is told sigma as F3AMD is",
        "CAMDM's code; a continuous schedule has no step numbers",
    ),
    Reading(
        "CAMDM",
        "IRD in its loss",
        "a term of “our” objective (4.1)",
        "weight {}; `CAMDM-IRD` has it",
        "the baseline keeps its own loss",
        "CAMDM.loss.ird",
    ),
    # --------------------------------------------------------------------------------- training
    Reading(
        "training",
        "the two windows of Eq. 10",
        "two predictions, x0_hat of rounds k and k + 1 (4.1)",
        "the captured last history frame and the prediction",
        "a training sample is one window",
    ),
    Reading(
        "training",
        "norms of Eqs 10 to 14",
        "squared norms, but for Eq. 10; all weights 1",
        "means over batch, frames and entries",
        "CAMDM's code",
    ),
    Reading("training", "optimiser", "not named", "Adam without weight decay", "CAMDM's code has AdamW with decay 0"),
    Reading(
        "training",
        "“inverse-square” learning rate",
        "5e-4, decay constant 1e5 (4.5)",
        "“{}”: 5e-4 (1 + step/1e5)^-2; inverse root is an option",
        "the text to the letter",
        "TrainingConfig.schedule",
    ),
    Reading(
        "training",
        "IRD of real motion",
        "lower is better (4.4)",
        "reported literally, beside the real step, and as an excess over it",
        "a walker moves some 4 to 6 cm a frame; less means that it sticks",
    ),
    # -------------------------------------------------------------------------------- diffusion
    Reading(
        "diffusion",
        "noise levels of N steps",
        "“flexible step counts” (3.5)",
        "t = linspace(0, 1, N), then sigma = 0; t = i/N is an option",
        "the last evaluation is then at sigma_min",
    ),
    Reading(
        "diffusion",
        "noise levels in training",
        "t in [0, 1] (3.5), distribution not said",
        "“{}”: t uniform in Eq. 9",
        "the plainest reading",
        "TrainingConfig.noise",
    ),
    Reading(
        "diffusion",
        "state between DDIM steps",
        "takes a VE state, returns a VP one (App. F)",
        "rescaled",
        "it is then the Euler step of notebook 02",
    ),
    Reading(
        "diffusion",
        "alpha_t of Appendix F",
        "defined, with a root that DDPM's has not",
        "left out",
        "the update does not need it",
    ),
)
"""Open points by topic."""


def readings_table(*topics: str) -> pd.DataFrame:
    """Return open points as a table: topic, open point, the paper, here, why.

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
                "why": reading.why,
            }
            for reading in READINGS
            if not topics or reading.topic in topics
        ]
    )
