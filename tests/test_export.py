"""A round compiled ahead of time gives the numbers of jit, run after run, without the library.

Tests of IREE skip where it is not installed; those of `jax.export` never do.
"""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import builders
import jax
import numpy as np
import pytest
from builders import refused

from f3amd_companion.serving import artefact as artefact_module
from f3amd_companion.serving.artefact import load_artefact, manifest_digest
from f3amd_companion.serving.export import export_model, export_round, save_artefact
from f3amd_lib.diffusion.schedules import variance_exploding, variance_preserving_cosine
from f3amd_lib.networks.conditioning import Condition
from f3amd_lib.rollout.rounds import sample_round

BATCH = 2
SIGMAS = variance_exploding().grid(2)


needs_iree = pytest.mark.needs("iree.compiler", "iree.runtime")
RUNTIMES = (pytest.param("iree", marks=needs_iree), "jax")


@pytest.fixture(scope="module")
def trained():
    record = {"dataset": "tiny", "dataset_licence": "CC BY 4.0", "dataset_credit": "nobody"}
    return builders.tiny_trained(record=record, latent_width=16)


@pytest.fixture(scope="module")
def exported(trained):
    return export_round(trained.network(), SIGMAS, BATCH)


@pytest.fixture(scope="module")
def jit_round(trained):
    """The same round under jit, which is what every other way is compared with."""
    network = trained.network()

    @jax.jit
    def run(history, path, style, noise):
        return sample_round(network, Condition(history, path, style), SIGMAS, noise=noise)

    return run


@pytest.fixture(scope="module")
def jax_folder(trained, exported, tmp_path_factory) -> Path:
    """An artefact for JAX alone, made from a trained model."""
    folder = tmp_path_factory.mktemp("artefact") / "round"
    return save_artefact(folder, exported, name=trained.name, targets=(), trained=trained)


@pytest.fixture(scope="module")
def iree_folder(exported, tmp_path_factory) -> Path:
    """An artefact for IREE on this CPU, made from a bare network."""
    return save_artefact(tmp_path_factory.mktemp("artefact") / "round", exported, name="tiny")


def inputs_of(shapes, seed: int) -> list[np.ndarray]:
    rng = np.random.default_rng(seed)
    return [rng.standard_normal(shape, dtype=np.float32) for shape in shapes.values()]


def altered(folder: Path, copy: Path, change) -> Path:
    """Copy an artefact and change its manifest, checksum included."""
    shutil.copytree(folder, copy)
    manifest = json.loads((copy / "manifest.json").read_text(encoding="utf-8"))
    change(manifest)
    manifest["sha256"] = manifest_digest(manifest)
    (copy / "manifest.json").write_text(json.dumps(manifest), encoding="utf-8")
    return copy


def test_an_exported_round_equals_jit(jax_folder, jit_round):
    artefact = load_artefact(jax_folder, runtime="jax")
    for seed in range(5):
        given = inputs_of(artefact.input_shapes, seed)
        np.testing.assert_allclose(artefact(*given), jit_round(*given), atol=1e-5)


def test_a_ddpm_round_takes_the_noise_that_the_sampler_would_draw(tmp_path):
    network = builders.network_of(builders.tiny_camdm())
    sigmas = variance_preserving_cosine(4).grid(3)
    exported = export_round(network, sigmas, BATCH, "ddpm")
    folder = save_artefact(tmp_path / "round", exported, name="tiny", targets=())
    condition, key = builders.make_condition(BATCH), jax.random.key(3)
    key_init, key_steps = jax.random.split(key)
    artefact = load_artefact(folder, runtime="jax")
    shape = artefact.input_shapes["noise"]
    assert artefact.input_shapes["step_noise"] == (3, *shape)
    noise = jax.random.normal(key_init, shape)
    step_noise = np.stack([jax.random.normal(k, shape) for k in jax.random.split(key_steps, 3)])
    wanted = jax.jit(lambda: sample_round(network, condition, sigmas, key, sampler="ddpm"))()
    np.testing.assert_allclose(artefact(*condition, noise, step_noise), wanted, atol=1e-5)
    refused("takes history, path, style, noise, step_noise; it was given 4", artefact, *condition, noise)


@needs_iree
def test_iree_equals_jit_over_a_hundred_runs(iree_folder, jit_round):
    artefact = load_artefact(iree_folder)
    runs = [inputs_of(artefact.input_shapes, seed) for seed in range(100)]
    answers = [artefact(*given) for given in runs]
    # Compared only now: an answer must outlive the runs after it.
    for given, answer in zip(runs, answers, strict=True):
        assert np.isfinite(answer).all()
        np.testing.assert_allclose(answer, jit_round(*given), atol=1e-3)


_ALONE = """
import sys

class Refuse:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in {refused}:
            raise ImportError(f"{{name}} is not to be had here")

sys.meta_path.insert(0, Refuse())
try:
    import f3amd_lib
except ImportError:
    pass
else:
    sys.exit("f3amd_lib could be imported after all")
import numpy as np
from artefact import load_artefact

artefact = load_artefact({folder!r}, runtime={runtime!r})
rng = np.random.default_rng(11)
given = [rng.standard_normal(s, dtype=np.float32) for s in artefact.input_shapes.values()]
np.save("answer.npy", artefact(*given))
"""


@pytest.mark.parametrize("runtime", RUNTIMES)
def test_an_artefact_runs_without_the_library(runtime, request, tmp_path, jit_round):
    folder = request.getfixturevalue(f"{runtime}_folder")
    shutil.copy(artefact_module.__file__, tmp_path / "artefact.py")
    refused = ("f3amd_lib", "f3amd_companion", "flax") + (("jax",) if runtime == "iree" else ())
    script = _ALONE.format(refused=refused, folder=str(folder), runtime=runtime)
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    how = {"cwd": tmp_path, "env": environment, "capture_output": True, "text": True}
    done = subprocess.run([sys.executable, "-c", script], **how)
    assert done.returncode == 0, done.stderr
    shapes = {item: tuple(shape) for item, shape in load_shapes(folder).items()}
    np.testing.assert_allclose(np.load(tmp_path / "answer.npy"), jit_round(*inputs_of(shapes, 11)), atol=1e-3)


def load_shapes(folder: Path) -> dict:
    manifest = json.loads((folder / "manifest.json").read_text(encoding="utf-8"))
    return {item["name"]: item["shape"] for item in manifest["inputs"]}


def test_scales_and_styles_travel_with_a_trained_model(trained, jax_folder):
    artefact = load_artefact(jax_folder, runtime="jax")
    normaliser = trained.normaliser
    frames = builders.draw(3, trained.config.channels, seed=1)
    path = builders.draw(3, 8, seed=2)
    same = lambda one, two: np.testing.assert_allclose(one, two, rtol=1e-6, atol=1e-6)
    same(artefact.normalise(frames), normaliser.normalise(frames))
    same(artefact.denormalise(frames), normaliser.denormalise(frames))
    same(artefact.normalise_path(path), normaliser.normalise_path(path))
    assert artefact.styles == trained.styles
    np.testing.assert_array_equal(artefact.one_hot(["proud", "calm"]), [[0, 1], [1, 0]])
    refused("unknown style 'prowd'; this artefact knows calm, proud", artefact.one_hot, ["prowd"])
    record = artefact.manifest["record"]
    assert record["dataset"] == "tiny" and record["dataset_licence"] == "CC BY 4.0"


@pytest.mark.parametrize("runtime", RUNTIMES)
def test_a_wrong_input_is_named(runtime, request):
    artefact = load_artefact(request.getfixturevalue(f"{runtime}_folder"), runtime=runtime)
    given = inputs_of(artefact.input_shapes, 0)
    for number, name in enumerate(("history", "path", "style", "noise")):
        for wrong in (given[number][:1], artefact.put(given[number][:1])):
            bad = [*given[:number], wrong, *given[number + 1 :]]
            refused(rf"{name} must have shape \(2, .*got \(1, ", artefact, *bad)
    refused("it was given 5 inputs", artefact, *given, given[3][None])


def test_a_file_cut_short_or_altered_is_refused(jax_folder, tmp_path):
    file = "round.jax_export"
    copy = shutil.copytree(jax_folder, tmp_path / "copy")
    content = (copy / file).read_bytes()
    (copy / file).write_bytes(content[:-1])
    refused(f"{file}: content does not match its checksum", load_artefact, copy, runtime="jax")
    (copy / file).unlink()
    refused(f"{file}: is missing, although manifest.json lists this file", load_artefact, copy, runtime="jax")


def test_a_garbled_or_altered_manifest_is_refused(jax_folder, tmp_path):
    refused(r"manifest\.json: no such file, so this folder is no", load_artefact, tmp_path)
    copy = shutil.copytree(jax_folder, tmp_path / "copy")
    path = copy / "manifest.json"
    text = path.read_text(encoding="utf-8")
    for content, message in (
        (text[: len(text) // 2], "not readable as JSON"),
        ("[]", "not the manifest of an artefact"),
        (text.replace('"batch": 2', '"batch": 3'), "does not match its checksum"),
    ):
        assert content != text
        path.write_text(content, encoding="utf-8")
        refused(message, load_artefact, copy, runtime="jax")


@needs_iree
def test_an_artefact_of_another_machine_is_refused(iree_folder, tmp_path):
    def change(**values):
        return lambda manifest: manifest["targets"]["llvm-cpu"].update(values)

    def other_cpu(manifest):
        manifest["targets"]["llvm-cpu"]["cpu"]["features"].append("imaginary")

    other_iree = change(iree_version="2.0.0"), r"compiled by IREE 2\.0\.0, .*iree-base-runtime==2\.0"
    cases = other_iree, (other_cpu, "another CPU.* lacks imaginary: compile it here")
    for number, (alter, message) in enumerate(cases):
        refused(message, load_artefact, altered(iree_folder, tmp_path / str(number), alter))
    refused("no program for target 'vmvx' .*there are llvm-cpu", load_artefact, iree_folder, target="vmvx")


def test_nothing_of_a_user_is_overwritten(exported, tmp_path):
    folder = tmp_path / "round"
    save = lambda **settings: save_artefact(folder, exported, targets=(), **{"name": "tiny", **settings})
    save()
    refused("exists already; .*overwrite=True", save)
    (folder / "notes.txt").write_text("mine")
    save(name="other", overwrite=True)
    assert load_artefact(folder, runtime="jax").manifest["model"] == "other"
    (folder / "manifest.json").write_text("{}")
    refused("not the manifest of an artefact", save, overwrite=True)
    assert (folder / "notes.txt").read_text() == "mine"


def test_a_trained_model_is_exported_with_its_own_schedule(trained, tmp_path):
    folder = export_model(trained, tmp_path / "round", num_steps=1, batch=3, targets=())
    manifest = load_artefact(folder, runtime="jax").manifest
    assert manifest["sigmas"] == trained.diffusion.grid(1).tolist()
    assert (manifest["sampler"], manifest["batch"], manifest["num_steps"]) == ("ddim", 3, 1)
    message = "unknown target 'lvm-cpu'; did you mean 'llvm-cpu'"
    refused(message, export_model, trained, tmp_path / "new", targets=("lvm-cpu",))
    assert not (tmp_path / "new").exists()


@pytest.mark.slow
@pytest.mark.parametrize("target", ["cuda-sm_80", "vulkan-spirv", "vmvx"])
@needs_iree
def test_other_devices_are_compiled_for_without_being_there(exported, target, tmp_path, jit_round):
    folder = save_artefact(tmp_path / "round", exported, name="tiny", targets=(target,))
    described = load_shapes(folder)
    assert list(described) == ["history", "path", "style", "noise"]
    code = (folder / f"round.{target}.vmfb").read_bytes()
    if target == "vmvx":
        artefact = load_artefact(folder, target=target)
        given = inputs_of(artefact.input_shapes, 0)
        np.testing.assert_allclose(artefact(*given), jit_round(*given), atol=1e-3)
    else:
        mark = {"cuda-sm_80": b".target sm_80", "vulkan-spirv": b"\x03\x02\x23\x07"}[target]
        assert mark in code
