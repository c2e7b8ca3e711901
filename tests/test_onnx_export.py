"""An ONNX program gives JAX's numbers, for any number of characters, and its card says all that is needed."""

import os
import subprocess
import sys
from pathlib import Path

import builders
import jax
import numpy as np
import pytest
from builders import refused

from f3amd_companion.serving import onnx_export
from f3amd_lib.diffusion.samplers import walk
from f3amd_lib.diffusion.schedules import variance_preserving_cosine
from f3amd_lib.networks.conditioning import Condition
from f3amd_lib.rollout.rounds import sample_round
from f3amd_lib.training.checkpoints import load_model

PRETRAINED = Path(__file__).resolve().parents[1] / "f3amd_lib" / "pretrained"
SHIPPED = sorted(path.relative_to(PRETRAINED).as_posix() for path in PRETRAINED.glob("*/*.safetensors"))
needs_onnx = pytest.mark.needs("jax2onnx", "onnxruntime")


@pytest.fixture(scope="module")
def trained():
    record = {"dataset": "tiny", "dataset_licence": "CC BY 4.0", "dataset_credit": "nobody"}
    return builders.tiny_trained(record=record, latent_width=64)


@pytest.fixture(scope="module")
def folder(trained, tmp_path_factory):
    return onnx_export.export_onnx(trained, tmp_path_factory.mktemp("onnx") / "tiny", num_steps=2)


def whole_walks(program, trained, num_steps, batch):
    """The same round by ONNX Runtime and by JAX, [B, T, C] each, of the same noise."""
    network, schedule = trained.network(), trained.diffusion
    noise, _, *given = onnx_export.seeded_inputs(trained.config, batch).values()
    run, condition = onnx_export.OnnxProgram(program), Condition(*given)
    sigmas, key = schedule.grid(num_steps), jax.random.key(7)
    # DDPM draws at each step: the same keys, and then the same start.
    key_steps = jax.random.split(key)[1] if schedule.sampler == "ddpm" else None

    def denoise(x_noisy, sigma):
        return run(x_noisy=x_noisy, sigma=np.full(batch, sigma), **condition._asdict())

    states = list(walk(schedule.sampler, denoise, np.float32(sigmas[0]) * noise, sigmas, key=key_steps))
    jitted = jax.jit(lambda noise: sample_round(network, condition, sigmas, key, noise=noise, sampler=schedule.sampler))
    return np.asarray(states[-1].x_noisy), np.asarray(jitted(noise))


@needs_onnx
@pytest.mark.parametrize("batch", (1, 3))
@pytest.mark.parametrize("num_steps", (1, 8))
def test_a_round_agrees_with_jax_for_any_number_of_characters(folder, trained, num_steps, batch):
    found, wanted = whole_walks((folder / onnx_export.PROGRAM).read_bytes(), trained, num_steps, batch)
    np.testing.assert_allclose(found, wanted, atol=1e-4)


@needs_onnx
def test_other_weights_or_another_condition_would_be_seen(folder, trained):
    run, network = onnx_export.OnnxProgram((folder / onnx_export.PROGRAM).read_bytes()), trained.network()
    level = np.array([1.0, 3.0], np.float32)  # one a character
    inputs = onnx_export.seeded_inputs(trained.config, 2) | {"sigma": level}
    found, condition = run(**inputs), Condition(*list(inputs.values())[2:])
    np.testing.assert_allclose(found, builders.evaluate(network, inputs["x_noisy"], level, condition), atol=1e-5)
    for name, least in {"sigma": 1e-3, "history": 1e-4, "path": 1e-4, "style": 1e-4}.items():
        assert np.abs(found - run(**inputs | {name: inputs[name][::-1]})).max() > least, name


@needs_onnx
def test_the_worked_example_runs_beside_the_files_alone(folder):
    bare = {"PATH": os.environ["PATH"]}
    words = [sys.executable, "-I", "example.py"]
    done = subprocess.run(words, cwd=folder, env=bare, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "2 characters, 8 frames" in done.stdout


@needs_onnx
def test_fewer_bits_are_smaller_and_cost_what_is_measured(folder, trained):
    network, sigmas = trained.network(), trained.diffusion.grid(4)[:-1]
    sizes, errors = [(folder / onnx_export.PROGRAM).stat().st_size], [0.0]
    for weights in ("float16", "int8"):
        program = onnx_export.denoiser_program(network, weights=weights)
        sizes.append(len(program))
        errors.append(onnx_export.largest_difference(program, network, sigmas))
    assert sizes[0] > sizes[1] > sizes[2]
    assert 1e-6 < errors[1] < errors[2] < 0.1


@needs_onnx
def test_what_cannot_be_exported_is_told(trained, folder, monkeypatch, tmp_path):
    network = trained.network()
    refused("unknown weights 'int4'", onnx_export.denoiser_program, network, weights="int4")
    refused("at least 1 character", onnx_export.denoiser_program, network, batch=0)
    refused("pass --overwrite", onnx_export.export_onnx, trained, folder)
    (tmp_path / "example.py").write_text("mine")
    refused("example.py: exists already", onnx_export.export_onnx, trained, tmp_path)
    monkeypatch.setitem(sys.modules, "jax2onnx", None)
    with pytest.raises(ImportError, match="make onnx-tools"):
        onnx_export.denoiser_program(network)


@needs_onnx
@pytest.mark.slow
@pytest.mark.parametrize("name", SHIPPED)
def test_every_shipped_model_agrees_with_jax(name):
    trained = load_model(PRETRAINED / name)
    program = onnx_export.denoiser_program(trained.network())
    for num_steps in (8, 1):
        found, wanted = whole_walks(program, trained, num_steps, 2)
        np.testing.assert_allclose(found, wanted, atol=1e-4, err_msg=f"{name}, {num_steps} steps")


@needs_onnx
def test_camdm_walks_with_fresh_noise():
    trained = builders.tiny_trained(config=builders.tiny_camdm(), diffusion=variance_preserving_cosine(4))
    found, wanted = whole_walks(onnx_export.denoiser_program(trained.network()), trained, 4, 2)
    np.testing.assert_allclose(found, wanted, atol=1e-4)
