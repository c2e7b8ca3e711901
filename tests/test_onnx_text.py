"""ACMDM and MotionPCM as ONNX: the card's times and a few lines of NumPy give the motion that JAX gives."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from builders import stirred
from flax import nnx

from f3amd_companion.__main__ import main
from f3amd_companion.serving.onnx_export import CARD, PROGRAM, OnnxProgram, seeded_inputs
from f3amd_lib.diffusion.flow import solve
from f3amd_lib.diffusion.schedules import straight, variance_preserving_betas
from f3amd_lib.motion.synthetic import SYNTHETIC_SKELETON
from f3amd_lib.networks.presets import blank_network
from f3amd_lib.text.data.text_motions import AxisNormaliser
from f3amd_lib.text.networks.acmdm import ACMDM, ACMDMConfig, TextCondition
from f3amd_lib.text.networks.motionpcm import LatentAutoencoderConfig, LatentDenoiser, LatentDenoiserConfig
from f3amd_lib.text.sampling.motionpcm_sampling import sample_student, sample_teacher
from f3amd_lib.text.sampling.text_to_motion import text_prediction
from f3amd_lib.text.stages.text_models import LatentModel, MotionCodec, TextModel, save_text_model
from f3amd_lib.training.checkpoints import network_with

needs_onnx = pytest.mark.needs("jax2onnx", "onnxruntime")
ABOUT = {"skeleton": SYNTHETIC_SKELETON, "fps": 20.0, "text_encoder": "tiny-8"}
RECORD = {"dataset": "tiny", "dataset_licence": "CC BY 4.0", "dataset_credit": "nobody"}
SIZES = {"window": 4, "channels": 3, "latent_width": 16, "depth": 3, "num_heads": 2, "hidden_width": 16}


def weights_of(network):
    """Weights of a network, away from the zeros that some begin with."""
    return nnx.state(stirred(network, scale=0.1))


def acmdm(**changes) -> TextModel:
    sizes = {"num_joints": 5, "channels": 3, "window": 8, "latent_width": 16, "depth": 2, "num_heads": 2}
    config = ACMDMConfig(**sizes | {"text_width": 8} | changes)
    axes = AxisNormaliser(np.arange(3, dtype=np.float32), np.full(3, 2.0, np.float32))
    params = weights_of(ACMDM(config, rngs=nnx.Rngs(0)))
    model = {"name": "tiny-ACMDM", "codec": MotionCodec(axes), "record": RECORD, "schedule": straight()}
    return TextModel(config=config, params=params, **model, **ABOUT)


def motionpcm(guidance_features: int) -> LatentModel:
    config = LatentDenoiserConfig(**SIZES, text_width=8, time_features=8, guidance_features=guidance_features)
    autoencoder = LatentAutoencoderConfig(**SIZES, features=7)
    zeros = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), blank_network(autoencoder)[1])
    record = RECORD | {"identity": {"training": {"num_phases": 2, "skip": 50}}}
    return LatentModel(
        name="tiny-PCM", autoencoder=autoencoder, autoencoder_params=zeros, record=record, config=config,
        statistics=AxisNormaliser(jnp.zeros(7), jnp.ones(7)),
        params=weights_of(LatentDenoiser(config, rngs=nnx.Rngs(0))), schedule=variance_preserving_betas(), **ABOUT,
    )  # fmt: skip


MODELS = {
    "ACMDM": acmdm,
    "ACMDM-concatenation-x0": lambda: acmdm(conditioning="concatenation", objective="x0", patch="pair"),
    "ACMDM-blocks": lambda: acmdm(block_frames=2),
    "teacher": lambda: motionpcm(0),
    "student": lambda: motionpcm(8),
}


@pytest.fixture(scope="module", params=MODELS)
def exported(request, tmp_path_factory):
    """A model, and the folder that its file was exported to by the command."""
    trained, folder = MODELS[request.param](), tmp_path_factory.mktemp("told")
    save_text_model(folder / "tiny.safetensors", trained, jnp.float32)
    words = ["export", "--target", "onnx", "--weights", str(folder / "tiny.safetensors"), "--steps", "4"]
    assert main([*words, "--out", str(folder / "out")]) == 0
    assert main([*words, "--out", str(folder / "out")]) == 2  # nothing is replaced unasked
    return trained, folder / "out"


def by_the_card(folder, inputs, count: str) -> np.ndarray:
    """Walk as the card says, with NumPy and ONNX Runtime alone."""
    card, run = json.loads((folder / CARD).read_text(encoding="utf-8")), OnnxProgram((folder / PROGRAM).read_bytes())
    steps, state = card["steps"][count], inputs["state"]
    for k in range(len(steps["time"]) - 1):
        (alpha, sigma), (alpha_next, sigma_next) = ((steps["alpha"][i], steps["sigma"][i]) for i in (k, k + 1))
        told = inputs | {"state": state, "time": np.full(len(state), steps["time"][k])}
        answer = run(**told)
        if card["predicts"] == "eps":
            x0, eps = (state - sigma * answer) / alpha, answer
        elif card["predicts"] == "x0":
            x0, eps = answer, (state - alpha * answer) / sigma
        else:  # v = x0 - eps on the straight path
            x0, eps = state + sigma * answer, state - alpha * answer
        state = alpha_next * x0 + sigma_next * eps
    return state


def by_jax(trained, inputs, count: int) -> np.ndarray:
    """The same by the library's own samplers."""
    network, text = network_with(trained.config, trained.params), inputs["text"]
    if isinstance(trained, TextModel):
        predict, how = text_prediction(network, TextCondition(text, inputs["mask"] > 0.5)), {"sampler": "ddim"}
        return solve(predict, trained.config.objective, trained.schedule, inputs["state"], num_steps=count, **how)
    asked, how = (network, trained.schedule, text), {"num_steps": count}
    if trained.config.guidance_features:
        return sample_student(*asked, inputs["state"], skip=50, guidance=inputs["guidance"], **how)
    return sample_teacher(*asked, np.zeros(8), inputs["state"], guidance=0.0, **how)


@needs_onnx
@pytest.mark.parametrize("batch", [1, 3])
def test_a_walk_by_the_card_ends_where_jax_ends(exported, batch):
    trained, folder = exported
    inputs = seeded_inputs(trained.config, batch)
    counts = json.loads((folder / CARD).read_text(encoding="utf-8"))["steps"]
    assert list(counts) == (["2"] if "guidance" in inputs else ["1", "4"])
    motion = inputs["mask"] > 0.5 if "mask" in inputs else np.s_[:]
    for count in counts:
        found, wanted = by_the_card(folder, inputs, count), np.asarray(by_jax(trained, inputs, int(count)))
        np.testing.assert_allclose(found[motion], wanted[motion], atol=1e-4 * max(1, np.abs(wanted).max()))


@needs_onnx
def test_every_input_is_heard(exported):
    trained, folder = exported
    run = OnnxProgram((folder / PROGRAM).read_bytes())
    inputs = seeded_inputs(trained.config, 2)
    inputs["time"] = np.array([0.2, 0.9]) if "mask" in inputs else np.array([100.0, 900.0])
    said = run(**inputs)
    # Frames of early blocks see no later ones, and only those are masked here.
    heard = set(inputs) - ({"mask"} if getattr(trained.config, "block_frames", 0) else set())
    for name in sorted(heard):
        value = inputs[name]
        assert np.abs(run(**inputs | {name: value[::-1]})[:, :4] - said[:, :4]).max() > 1e-4, name
