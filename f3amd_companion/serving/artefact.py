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

FORMAT = "f3amd-artefact-1"
MANIFEST = "manifest.json"
STABLEHLO = "round.mlirbc"
JAX_EXPORT = "round.jax_export"
FEATURES = "features.json"
RUNTIMES = ("iree", "jax")

# IREE gives its worker threads 128 KiB of stack. Code that was compiled with data tiling needs more
# and overruns it: the process dies, or the numbers are wrong. Address space is all that more costs.
WORKER_STACK_BYTES = 4 * 2**20


class OnDevice(NamedTuple):
    """An array that lies where a runtime wants it (see `Artefact.put`)."""

    shape: tuple[int, ...]
    value: Any


class _Program(NamedTuple):
    """A loaded program: how an array goes in, and how the program is run on such arrays."""

    put: Callable[[np.ndarray], Any]
    run: Callable[..., np.ndarray]


class Artefact:
    """One round of synthesis for a fixed number of characters, from `load_artefact`.

    Attributes:
      manifest: what the artefact is: model, config, steps, sampler, noise levels, batch, shapes,
        compilers, checksums and provenance.
      runtime: "iree" or "jax".
      styles: style names in the order of the one-hot vector; empty if it was not exported from a
        trained model.
      input_shapes: shape of every input by name, in the order of a call.
    """

    def __init__(self, manifest: dict, runtime: str, program: _Program, features: dict | None):
        self.manifest = manifest
        self.runtime = runtime
        self.styles: tuple[str, ...] = tuple(features["styles"]) if features else ()
        self._features = features
        self._program = program
        self.input_shapes = {item["name"]: tuple(item["shape"]) for item in manifest["inputs"]}

    def put(self, array) -> OnDevice:
        """Move an array to the runtime's device as float32, so that calls need not copy it.

        Args:
          array: any shape that the program takes.

        Returns:
          What a call takes in place of the array, as often as wanted.
        """
        array = np.ascontiguousarray(array, np.float32)
        return OnDevice(array.shape, self._program.put(array))

    def __call__(self, history, path, style, noise, step_noise=None) -> np.ndarray:
        """Run the round for B characters, B being the artefact's own.

        Args:
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
          ValueError: for a wrong shape, or step noise where none is wanted or the other way round.
        """
        given = [history, path, style, noise] + ([] if step_noise is None else [step_noise])
        if len(given) != len(self.input_shapes):
            wanted = "needs" if step_noise is None else "takes no"
            raise ValueError(f"this artefact samples with {self.manifest['sampler']!r} and {wanted} step_noise")
        values = []
        for (name, shape), item in zip(self.input_shapes.items(), given, strict=True):
            placed = item if isinstance(item, OnDevice) else self.put(item)
            if placed.shape != shape:
                raise ValueError(f"{name} must have shape {shape}, got {placed.shape}")
            values.append(placed.value)
        return self._program.run(*values)

    def normalise(self, features) -> np.ndarray:
        """Map features [..., C] (metres and 6D rotations) to network units."""
        scale = self._scales()
        return (np.asarray(features, np.float32) - scale["mean"]) / scale["deviation"]

    def denormalise(self, x) -> np.ndarray:
        """Map network units [..., C] back to metres and 6D rotations."""
        scale = self._scales()
        return np.asarray(x, np.float32) * scale["deviation"] + scale["mean"]

    def normalise_path(self, path) -> np.ndarray:
        """Map a path condition [..., 8] from metres to network units; its yaw stays."""
        path = np.array(path, np.float32)
        path[..., :2] /= self._scales()["path_scale"]
        return path

    def one_hot(self, styles) -> np.ndarray:
        """Return the style input for a list of style names, [len(styles), S].

        Raises:
          ValueError: for an unknown style, or an artefact that knows no names.
        """
        self._scales()
        for style in styles:
            if style not in self.styles:
                raise ValueError(f"unknown style {style!r}; this artefact knows {', '.join(self.styles)}")
        rows = [self.styles.index(style) for style in styles]
        return np.eye(len(self.styles), dtype=np.float32)[rows]

    def _scales(self) -> dict[str, np.ndarray]:
        if self._features is None:
            raise ValueError("no scales of features nor style names here: exported from a bare network")
        return {name: np.asarray(value, np.float32) for name, value in self._features["normaliser"].items()}


def load_artefact(folder, *, runtime: str = "iree", target: str = "llvm-cpu", driver: str | None = None) -> Artefact:
    """Load an artefact and make its program ready to run.

    Args:
      folder: what `f3amd_companion.serving.export.save_artefact` wrote.
      runtime: "iree" runs a compiled program of the folder; "jax" runs the exported one, compiled
        here and now by XLA for whatever device JAX finds.
      target: which compiled program; only with "iree".
      driver: of IREE, instead of the one that belongs to the target: "local-sync" runs a CPU
        program on the calling thread alone.

    Raises:
      ImportError: if the runtime is not installed, saying how to install it.
      ValueError: naming the folder or file, if it is no artefact, truncated or altered, lacks the
        target, or was compiled by another version of IREE or for another CPU.
    """
    folder = Path(folder)
    if runtime not in RUNTIMES:
        raise ValueError(f"unknown runtime {runtime!r} (one of {', '.join(RUNTIMES)})")
    manifest = read_manifest(folder)
    features = json.loads(_read(folder, FEATURES, manifest)) if FEATURES in manifest["files"] else None
    program = _load_jax(folder, manifest) if runtime == "jax" else _load_iree(folder, manifest, target, driver)
    return Artefact(manifest, runtime, program, features)


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
        raise ValueError(f"{path}: no such file, but {MANIFEST} speaks of it; restore a whole copy")
    content = path.read_bytes()
    if hashlib.sha256(content).hexdigest() != manifest["files"][name]["sha256"]:
        raise ValueError(f"{path}: content does not match its checksum; restore a whole copy")
    return content


def _load_jax(folder: Path, manifest: dict) -> _Program:
    try:
        import jax
        from jax import export
    except ImportError as error:
        raise ImportError(f"runtime 'jax' needs JAX: pip install jax ({error})") from None
    blob = _read(folder, JAX_EXPORT, manifest)
    try:
        exported = export.deserialize(blob)
    except Exception as error:  # JAX promises no type
        made_by = manifest["record"]["versions"]["jax"]
        what = f"JAX {jax.__version__} cannot read what JAX {made_by} exported ({error})"
        raise ValueError(f"{folder / JAX_EXPORT}: {what}; install that version, or export again") from None
    inputs = [jax.ShapeDtypeStruct(tuple(item["shape"]), np.float32) for item in manifest["inputs"]]
    # Compiled ahead of the first call, so that a call does nothing but run.
    compiled = jax.jit(exported.call).lower(*inputs).compile()
    return _Program(jax.device_put, lambda *values: np.asarray(compiled(*values)))


def _load_iree(folder: Path, manifest: dict, target: str, driver: str | None) -> _Program:
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
    _check_cpu(folder, target, compiled.get("cpu"))
    content = _read(folder, compiled["file"], manifest)
    config = runtime.Config(device=_iree_device(driver or compiled["driver"]))
    module = runtime.VmModule.copy_buffer(config.vm_instance, content)
    invoke = runtime.load_vm_module(module, config)[compiled["entry"]]
    put = functools.partial(runtime.asdevicearray, config.device)
    return _Program(put, lambda *values: invoke(*values).to_host())


def iree_version() -> str:
    """Return the version of the IREE runtime that is installed."""
    return importlib.metadata.version("iree-base-runtime")


@functools.cache
def _iree_device(driver: str):
    """Return one device per driver: artefacts share its worker threads."""
    import iree.runtime
    from iree.runtime import _binding, flags

    available = iree.runtime.query_available_drivers()
    if driver not in available:
        raise ValueError(f"IREE has no driver {driver!r} here (one of {', '.join(available)})")
    # A driver reads this flag when it is made, and IREE's public call hands out one that may have
    # been made before.
    flags.parse_flags(f"--task_worker_stack_size={WORKER_STACK_BYTES}")
    try:
        return _binding.create_hal_driver(driver).create_default_device()
    except Exception as error:  # IREE raises RuntimeError, ValueError and others
        raise ValueError(f"IREE's driver {driver!r} finds no device here: {error}") from None


def _check_cpu(folder: Path, target: str, wanted: dict | None) -> None:
    """Raise ValueError if a program uses instructions that this CPU lacks, which would kill it."""
    if wanted is None:
        return
    machine, missing = platform.machine(), sorted(set(wanted["features"]) - set(cpu_features()))
    if machine != wanted["machine"] or missing:
        lacks = f"lacks {', '.join(missing)}" if missing else f"is {machine}"
        what = f"target {target} was compiled for another CPU ({wanted['machine']}), and this one {lacks}"
        raise ValueError(f"{folder}: {what}: compile it here, or pass runtime='jax'")


@functools.cache
def cpu_features() -> tuple[str, ...]:
    """Return the instruction sets of this CPU beyond its base, by IREE's names and in its order."""
    from iree import _runtime_libs

    tool = Path(_runtime_libs.__path__[0]) / "iree-cpuinfo"
    listed = subprocess.run([tool], capture_output=True, text=True, check=True).stdout
    pairs = [line.split() for line in listed.splitlines()]
    return tuple(pair[0] for pair in pairs if len(pair) == 2 and pair[1] == "1")
