"""Load and run exported rounds of synthesis without the code that made them.

An artefact is a folder that `f3amd_companion.serving.export` writes: one round of diffusion (noise
in, clean features out) as a compiled program with the weights inside, and a manifest that says
which. This file needs the standard library, numpy, and either IREE's runtime or JAX. It imports
nothing else of f3amd_lib, so that it can be copied out alone and shipped beside the artefact:

    from artefact import load_artefact

    artefact = load_artefact("walker")
    x0_hat = artefact(history, path, style, noise)

An artefact is a program: load only those that you trust, as with any other.
"""

import functools
import hashlib
import importlib.metadata
import json
import platform
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

FORMAT = "f3amd-artefact-2"
MANIFEST = "manifest.json"
STABLEHLO = "round.mlirbc"
JAX_EXPORT = "round.jax_export"

# IREE gives its worker threads 128 KiB of stack. Code that was compiled with data tiling needs more
# and overruns it: the process dies, or the numbers are wrong. Address space is all that more costs.
WORKER_STACK_BYTES = 4 * 2**20


class OnDevice(NamedTuple):
    """An array that lies where a runtime wants it (see `Artefact.put`)."""

    shape: tuple[int, ...]
    value: Any


class Artefact:
    """One round of synthesis for a fixed number of characters, from `load_artefact`.

    Attributes:
      manifest: what the artefact is: model, config, steps, sampler, noise levels, batch, shapes, scales of features,
        style names, compilers, checksums and provenance.
      styles: style names in the order of the one-hot vector; empty if it was not exported from a
        trained model. Without one, scales are 1 as well.
      input_shapes: shape of every input by name, in the order of a call.
    """

    def __init__(self, manifest: dict, put: Callable[[np.ndarray], Any], run: Callable[..., np.ndarray]):
        self.manifest, self._put, self._run = manifest, put, run
        self.styles: tuple[str, ...] = tuple(manifest["styles"])
        self.input_shapes = {item["name"]: tuple(item["shape"]) for item in manifest["inputs"]}
        self._scales = {name: np.asarray(value, np.float32) for name, value in manifest["normaliser"].items()}

    def put(self, array) -> OnDevice:
        """Move an array of any shape to the runtime's device as float32, so that calls need not copy it."""
        array = np.ascontiguousarray(array, np.float32)
        return OnDevice(array.shape, self._put(array))

    def __call__(self, *inputs) -> np.ndarray:
        """Run the round for B characters, B being the artefact's own.

        Args:
          inputs: arrays, or what `put` made of them, in this order:
            history: past motion features in network units, [B, H, C].
            path: condition of the future root path, [B, T, 8]: displacement x, z from the last
              history frame in network units, then the yaw as the first two columns of its rotation
              matrix.
            style: one-hot or a blend, [B, S].
            noise: standard normal numbers to start from, [B, T, C].
            step_noise: fresh standard normal numbers for every step, [N, B, T, C]; for artefacts that
              sample with DDPM, and no others.

        Returns:
          Clean features in network units, [B, T, C]. Do not write to it: it may be the runtime's
          own memory.

        Raises:
          ValueError: for a wrong number of inputs, or a wrong shape.
        """
        if len(inputs) != len(self.input_shapes):
            raise ValueError(f"this artefact takes {', '.join(self.input_shapes)}; it was given {len(inputs)} inputs")
        placed = [item if isinstance(item, OnDevice) else self.put(item) for item in inputs]
        for (name, shape), item in zip(self.input_shapes.items(), placed, strict=True):
            if item.shape != shape:
                raise ValueError(f"{name} must have shape {shape}, got {item.shape}")
        return self._run(*(item.value for item in placed))

    def normalise(self, features) -> np.ndarray:
        """Map features [..., C] (metres and 6D rotations) to network units."""
        return (np.asarray(features, np.float32) - self._scales["mean"]) / self._scales["deviation"]

    def denormalise(self, x) -> np.ndarray:
        """Map network units [..., C] back to metres and 6D rotations."""
        return np.asarray(x, np.float32) * self._scales["deviation"] + self._scales["mean"]

    def normalise_path(self, path) -> np.ndarray:
        """Map a path condition [..., 8] from metres to network units; its yaw stays."""
        path = np.array(path, np.float32)
        path[..., :2] /= self._scales["path_scale"]
        return path

    def one_hot(self, styles) -> np.ndarray:
        """Return the style input for a list of style names, [len(styles), S]; ValueError for one that is unknown."""
        if unknown := [style for style in styles if style not in self.styles]:
            raise ValueError(f"unknown style {unknown[0]!r}; this artefact knows {', '.join(self.styles) or 'none'}")
        return np.eye(len(self.styles), dtype=np.float32)[[self.styles.index(style) for style in styles]]


def load_artefact(folder, *, runtime: str = "iree", target: str = "llvm-cpu") -> Artefact:
    """Load an artefact and make its program ready to run.

    Args:
      folder: what `f3amd_companion.serving.export.save_artefact` wrote.
      runtime: "iree" runs a compiled program of the folder; "jax" runs the exported one, compiled
        here and now by XLA for whatever device JAX finds.
      target: which compiled program; only with "iree".

    Raises:
      ImportError: if the runtime is not installed, saying how to install it.
      ValueError: naming the folder or file, if it is no artefact, truncated or altered, lacks the
        target, or was compiled by another version of IREE or for another CPU.
    """
    folder = Path(folder)
    if runtime not in ("iree", "jax"):
        raise ValueError(f"unknown runtime {runtime!r} (one of iree, jax)")
    manifest = read_manifest(folder)
    program = _load_jax(folder, manifest) if runtime == "jax" else _load_iree(folder, manifest, target)
    return Artefact(manifest, *program)


def read_manifest(folder) -> dict:
    """Return the manifest of an artefact.

    Raises:
      ValueError: naming the file, if it is missing, garbled, altered or of another format.
    """
    path = Path(folder) / MANIFEST
    if not path.is_file():
        raise ValueError(f"{path}: no such file, so this folder is no artefact")
    try:
        manifest = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path}: not readable as JSON ({error}); restore a whole copy") from None
    found = manifest.get("format") if isinstance(manifest, dict) else None
    if found != FORMAT:
        raise ValueError(f"{path}: not the manifest of an artefact (format {found!r})")
    if manifest.get("sha256") != manifest_digest(manifest):
        raise ValueError(f"{path}: content does not match its checksum; restore a whole copy")
    return manifest


def manifest_digest(manifest: dict) -> str:
    """Return the sha256 of a manifest's content, without the digest that it holds itself."""
    content = {key: value for key, value in manifest.items() if key != "sha256"}
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def _read(folder: Path, name: str, manifest: dict) -> bytes:
    """Return a file of an artefact; ValueError unless it is the one that was written."""
    path = folder / name
    if not path.is_file():
        raise ValueError(f"{path}: is missing, although {MANIFEST} lists this file; restore a whole copy")
    content = path.read_bytes()
    if hashlib.sha256(content).hexdigest() != manifest["files"][name]["sha256"]:
        raise ValueError(f"{path}: content does not match its checksum; restore a whole copy")
    return content


def _load_jax(folder: Path, manifest: dict) -> tuple[Callable, Callable]:
    """Return what moves an array to the device, and what runs the program on such arrays."""
    try:
        import jax
        from jax import export
    except ImportError as error:
        raise ImportError(f"runtime 'jax' needs JAX: pip install jax ({error})") from None
    blob = _read(folder, JAX_EXPORT, manifest)
    try:
        exported = export.deserialize(blob)
    except Exception as error:  # JAX promises no type
        what = f"JAX {jax.__version__} cannot read what JAX {manifest['record']['versions']['jax']} exported ({error})"
        raise ValueError(f"{folder / JAX_EXPORT}: {what}; install that version, or export again") from None
    # Compiled ahead of the first call, so that a call does nothing but run.
    compiled = jax.jit(exported.call).lower(*exported.in_avals).compile()
    return jax.device_put, lambda *values: np.asarray(compiled(*values))


def _load_iree(folder: Path, manifest: dict, target: str) -> tuple[Callable, Callable]:
    """Return what moves an array to the device, and what runs the program on such arrays."""
    targets = manifest["targets"]
    if target not in targets:
        known = ", ".join(targets) or "none: compile some, or pass runtime='jax'"
        raise ValueError(f"{folder}: holds no program for target {target!r} (there are {known})")
    compiled = targets[target]
    made_by = compiled["iree_version"]
    try:
        from iree import runtime
    except ImportError as error:
        how = f'make bench-tools, or pip install "f3amd_lib[bench]", or iree-base-runtime=={made_by} alone'
        raise ImportError(f"runtime 'iree' needs IREE's runtime ({error}): {how}") from None
    if made_by != iree_version():
        what = f"target {target} was compiled by IREE {made_by}, and this is IREE {iree_version()}"
        how = f"install iree-base-runtime=={made_by}, compile it again, or pass runtime='jax'"
        raise ValueError(f"{folder}: {what}: {how}")
    # Instructions that this CPU lacks would kill the process.
    if cpu := compiled["cpu"]:
        lacks = set(cpu["features"]) - set(cpu_features()) | {cpu["machine"]} - {platform.machine()}
        if lacks:
            what = f"was compiled for another CPU, and this one lacks {', '.join(sorted(lacks))}"
            raise ValueError(f"{folder}: target {target} {what}: compile it here, or pass runtime='jax'")
    config = runtime.Config(device=_iree_device(compiled["driver"]))
    module = runtime.VmModule.copy_buffer(config.vm_instance, _read(folder, compiled["file"], manifest))
    invoke = runtime.load_vm_module(module, config)[compiled["entry"]]
    return functools.partial(runtime.asdevicearray, config.device), lambda *values: invoke(*values).to_host()


def iree_version() -> str:
    """Return the version of the IREE runtime that is installed."""
    return importlib.metadata.version("iree-base-runtime")


@functools.cache
def _iree_device(driver: str):
    """Return one device per driver: artefacts share its worker threads."""
    from iree.runtime import _binding, flags

    # A driver reads this flag when it is made, and IREE's public call hands out one that may have
    # been made before.
    flags.parse_flags(f"--task_worker_stack_size={WORKER_STACK_BYTES}")
    try:
        return _binding.create_hal_driver(driver).create_default_device()
    except Exception as error:  # IREE raises RuntimeError, ValueError and others
        raise ValueError(f"IREE's driver {driver!r} finds no device here: {error}") from None


@functools.cache
def cpu_features() -> tuple[str, ...]:
    """Return the instruction sets of this CPU beyond its base, by IREE's names and in its order."""
    from iree import _runtime_libs

    tool = Path(_runtime_libs.__path__[0]) / "iree-cpuinfo"
    listed = subprocess.run([tool], capture_output=True, text=True, check=True).stdout
    pairs = [line.split() for line in listed.splitlines()]
    return tuple(pair[0] for pair in pairs if len(pair) == 2 and pair[1] == "1")
