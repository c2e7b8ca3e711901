"""Ahead-of-time export: a whole round of synthesis as a program without Python.

    network -> jax.export -> StableHLO -> IREE -> CPU, CUDA or Vulkan

The paper measures its models this way (section 4.5). The program takes history, path, style and
noise and returns clean features; weights and noise levels are constants in it, so that compilers
may fold and repack them. Noise comes from outside: a program then gives the same numbers on every
device, and has no loop of random bits. The result is loaded by `artefact`, which needs
nothing of this library.
"""

import hashlib
import importlib.util
import json
import platform
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jax import export

from f3amd_companion.serving import artefact
from f3amd_lib.diffusion.samplers import ddpm_step
from f3amd_lib.ground.files import read_toml, write_whole
from f3amd_lib.ground.names import check_known
from f3amd_lib.ground.records import run_record
from f3amd_lib.ground.trees import weights_digest
from f3amd_lib.networks.conditioning import Condition
from f3amd_lib.rollout.rounds import sample_round
from f3amd_lib.training.checkpoints import TrainedModel

TARGETS = read_toml(Path(__file__).with_name("targets.toml"))
"""Targets by name. "cuda-sm_NN" is a generation of NVIDIA GPUs; 80, 86 and 89 are known to work."""


def _find_target(name: str) -> dict:
    """Return a target as `targets.toml` has it, with `backend`, IREE's name of the code generator."""
    if gpu := re.fullmatch(r"cuda-(sm_\d+a?)", name):
        return {"backend": "cuda", "driver": "cuda", "flags": [f"--iree-cuda-target={gpu[1]}", "--iree-opt-level=O3"]}
    check_known(name, [*TARGETS, "cuda-sm_80"], "target")
    return {"backend": name, **TARGETS[name]}


class ExportedRound(NamedTuple):
    """One round of synthesis as a program.

    Attributes:
      manifest: what the program is, as `artefact` tells it: config, steps, sampler, noise levels, batch, shapes, and a
        digest that tells one set of weights from another.
      exported: the program, for JAX; without the places of its operations in source files.
    """

    manifest: dict
    exported: export.Exported


def export_round(network, sigmas, batch: int, sampler: str = "ddim") -> ExportedRound:
    """Export a whole round of synthesis with the weights inside.

    The program is `rounds.sample_round` with history, path, style and noise as inputs. DDPM draws
    fresh noise at every step; its program takes that as a fifth input, `step_noise` [N, B, T, C],
    of which the step to sigma = 0 uses nothing. Steps are written out one by one: IREE's local-task driver was
    seen to return NaN or garbage now and then from programs with a loop, and never from unrolled ones.

    Args:
      network: a denoiser of `models`, with its weights.
      sigmas: [N + 1], falling, from a noise schedule's `grid`.
      batch: B, characters of one call.
      sampler: a name of `samplers.SAMPLERS`.

    Returns:
      The program, in float32, lowered for the CPU without anything that only a CPU has.

    Raises:
      ValueError: for less than one character, or an unknown sampler.
    """
    if type(batch) is not int or batch < 1:
        raise ValueError(f"batch must be a whole number of characters, at least 1, got {batch!r}")
    sigmas = np.asarray(sigmas, np.float64)
    config = network.config
    shape = (batch, config.window, config.channels)
    inputs = {name: part.shape for name, part in config.condition_shapes(batch)._asdict().items()} | {"noise": shape}
    if sampler == "ddpm":
        inputs["step_noise"] = (len(sigmas) - 1, *shape)
    # Split here and merged inside: the weights then are constants of the program.
    graph, state = nnx.split(network)

    def one_round(history, path, style, noise, step_noise=None):
        denoiser, condition = nnx.merge(graph, state), Condition(history, path, style)
        if step_noise is not None:
            return _sample_ddpm(denoiser, condition, sigmas, noise, step_noise)
        return sample_round(denoiser, condition, sigmas, noise=noise, sampler=sampler, unroll=True)

    places = jax.config.jax_traceback_in_locations_limit
    try:
        jax.config.update("jax_traceback_in_locations_limit", 0)  # a program says not which files made it
        program = export.export(
            jax.jit(one_round), platforms=["cpu"], disabled_checks=[export.DisabledSafetyCheck.platform()]
        )(*(jax.ShapeDtypeStruct(shape, jnp.float32) for shape in inputs.values()))
    finally:
        jax.config.update("jax_traceback_in_locations_limit", places)
    manifest = {
        "config": config.to_dict(),
        "num_steps": len(sigmas) - 1,
        "sampler": sampler,
        "sigmas": sigmas.tolist(),
        "batch": batch,
        "inputs": [{"name": name, "shape": list(shape), "dtype": "float32"} for name, shape in inputs.items()],
        "output": {"name": "x0_hat", "shape": list(shape), "dtype": "float32"},
        "weights": weights_digest(state),
    }
    return ExportedRound(manifest, program)


def _sample_ddpm(network, condition: Condition, sigmas, noise, step_noise):
    """Walk as the sampler "ddpm" does, with its noise [N, B, T, C] given."""
    context = network.encode(condition)
    levels = jnp.asarray(sigmas, noise.dtype)
    x_noisy = levels[0] * noise
    for sigma, sigma_next, fresh in zip(levels[:-1], levels[1:], step_noise, strict=True):
        x_noisy = ddpm_step(x_noisy, network(x_noisy, sigma, context), sigma, sigma_next, fresh)
    return x_noisy


def compile_iree(program: bytes, target: str = "llvm-cpu") -> tuple[bytes, list[str]]:
    """Compile a program with IREE.

    Args:
      program: a portable StableHLO artefact, such as `ExportedRound.exported.mlir_module_serialized`.
      target: a name of `TARGETS`, or "cuda-sm_NN" for a generation of NVIDIA GPUs, which this
        release of IREE may or may not know. None needs the device to be there, except that
        "llvm-cpu" compiles for the CPU that it runs on.

    Returns:
      (the compiled module, IREE's "vmfb"; the flags that it was compiled with).

    Raises:
      ImportError: if IREE's compiler is not installed, saying how to install it.
      ValueError: for an unknown target, or one that this release of IREE cannot compile for.
    """
    settings = _find_target(target)
    if importlib.util.find_spec("iree") is None or not importlib.util.find_spec("iree.compiler"):
        raise ImportError('compiling needs IREE: make bench-tools, or pip install "f3amd_lib[bench]"')
    # Tiles are faster, but some programs do not compile in them.
    ways = [[*settings["flags"], *settings.get("tiling", [])], settings["flags"]]
    with tempfile.TemporaryDirectory() as folder:
        source, compiled = Path(folder) / artefact.STABLEHLO, Path(folder) / "round.vmfb"
        source.write_bytes(program)
        for flags in ways:
            # In a process of its own: IREE's compiler and JAX each bring bindings of MLIR, and a
            # process that holds both dies when it ends.
            command = [sys.executable, "-m", "iree.compiler.tools.scripts.iree_compile", str(source), "-o"]
            command += [str(compiled), "--iree-input-type=stablehlo", "--iree-vm-bytecode-module-strip-source-map"]
            command += [f"--iree-hal-target-backends={settings['backend']}", *flags]
            done = subprocess.run(command, capture_output=True, text=True, check=False)
            if done.returncode == 0:
                return compiled.read_bytes(), flags
    found = re.findall(r"error: (.*)", done.stderr) or [done.stderr.strip()[-500:]]
    raise ValueError(f"IREE {artefact.iree_version()} cannot compile this program for {target}: {found[0]}")


def save_artefact(
    folder, exported: ExportedRound, *, name: str, targets: Iterable[str] = ("llvm-cpu",),
    trained: TrainedModel | None = None, overwrite: bool = False,
) -> Path:  # fmt: skip
    """Write a round as a folder that `artefact.load_artefact` runs.

    The folder holds the program as StableHLO and for JAX, a compiled module per target, and a manifest with checksums,
    which is written last.

    Args:
      folder: to make; missing ones above it are made, too.
      exported: from `export_round`.
      name: of the model.
      targets: to compile for, see `compile_iree`; none leaves the program to JAX.
      trained: the model whose network was exported, so that real motion can be fed in; without it
        the artefact takes and returns network units only.
      overwrite: replace an earlier artefact there. Other files of the folder stay.

    Returns:
      The folder.

    Raises:
      ImportError, ValueError: as `compile_iree`; if the folder holds an artefact and `overwrite` is false, or the
        manifest of something else.
    """
    folder, earlier = Path(folder), {}
    if (folder / artefact.MANIFEST).exists():
        earlier = artefact.read_manifest(folder)["files"]
        if not overwrite:
            raise ValueError(f"{folder}: exists already; choose another name or pass overwrite=True")
    program = exported.exported.mlir_module_serialized
    files = {artefact.STABLEHLO: program, artefact.JAX_EXPORT: bytes(exported.exported.serialize())}
    found, compiled = {target: _find_target(target) for target in targets}, {}
    for target, settings in found.items():
        file, started = f"round.{target}.vmfb", time.perf_counter()
        files[file], flags = compile_iree(program, target)
        host = {"machine": platform.machine(), "features": list(artefact.cpu_features())}
        compiled[target] = {
            "file": file,
            "entry": "main",  # what JAX calls the program's one public function
            "driver": settings["driver"],
            "iree_version": artefact.iree_version(),
            "flags": flags,
            "compile_seconds": round(time.perf_counter() - started, 1),
            "cpu": host if settings["backend"] == "llvm-cpu" else None,
        }
    scales, training = {"mean": 0.0, "deviation": 1.0, "path_scale": 1.0}, {}
    if trained is not None:
        scales, training = trained.normaliser._asdict(), trained.record
    record = run_record(
        profile="export", dataset=training.get("dataset", "none"), seed=training.get("seed", 0), training=training
    )
    record |= {key: training.get(key) for key in ("dataset_fingerprint", "dataset_licence", "dataset_credit")}
    sums = {name: {"bytes": len(file), "sha256": hashlib.sha256(file).hexdigest()} for name, file in files.items()}
    manifest = {"format": artefact.FORMAT, "model": name, **exported.manifest}
    manifest["normaliser"] = {name: np.asarray(values, np.float32).tolist() for name, values in scales.items()}
    manifest["styles"] = list(trained.styles) if trained else []
    manifest |= {"targets": compiled, "files": sums, "record": record}
    manifest["sha256"] = artefact.manifest_digest(manifest)
    files[artefact.MANIFEST] = (json.dumps(manifest, indent=2, ensure_ascii=False) + "\n").encode()
    for file in earlier.keys() - files.keys():
        (folder / file).unlink(missing_ok=True)
    for file, content in files.items():
        write_whole(folder / file, content)
    return folder


def export_model(
    trained: TrainedModel, folder, *, num_steps: int = 8, batch: int = 1, sampler: str | None = None,
    targets: Iterable[str] = ("llvm-cpu",), overwrite: bool = False,
) -> Path:  # fmt: skip
    """Export a trained model: what `f3amd export` does.

    Args:
      trained: the model.
      folder, targets, overwrite: as for `save_artefact`.
      num_steps: N, steps of the sampler.
      batch: B, characters of one call.
      sampler: a name of `samplers.SAMPLERS`; by default the one that belongs to the model's noise schedule.

    Returns:
      The folder.

    Raises:
      ImportError, ValueError: as `export_round`, `compile_iree` and `save_artefact`.
    """
    schedule = trained.diffusion
    exported = export_round(trained.network(), schedule.grid(num_steps), batch, sampler or schedule.sampler)
    return save_artefact(folder, exported, name=trained.name, targets=targets, trained=trained, overwrite=overwrite)
