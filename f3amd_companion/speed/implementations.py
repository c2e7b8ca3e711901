"""Implementations of a round: jit, jit over all devices, by FFT, IREE, PyTorch and ONNX Runtime.

In each of them a timed call does what `decisions` of the companion count as synthesis: it draws
noise, encodes the condition and walks all steps. Compilation, kinematics and transfers of the
condition are outside.
"""

import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path

import jax
import numpy as np
from flax import nnx
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from f3amd_companion.speed.fft_reference import fft_reference
from f3amd_companion.speed.machine import PRECISIONS, device_name, matmul_precision, matmul_probe
from f3amd_lib.diffusion.samplers import num_evaluations
from f3amd_lib.ground.names import check_known
from f3amd_lib.networks import presets
from f3amd_lib.networks.conditioning import PATH_CHANNELS, Condition
from f3amd_lib.networks.config import NetworkConfig
from f3amd_lib.rollout.rounds import sample_round


def cast_network(network: nnx.Module, dtype) -> nnx.Module:
    """Return a network whose weights, and with them its arithmetic, are of another type.

    Args:
      network: any; left as it is.
      dtype: of floating-point numbers. Condition and state must be given in it, too.
    """
    graph, state = nnx.split(network)
    return nnx.merge(graph, jax.tree.map(lambda leaf: leaf.astype(dtype), state))


class NotPossible(RuntimeError):
    """An implementation that does not work here; the message says why."""


@dataclass(frozen=True)
class Workload:
    """What is asked for, in whichever implementation.

    Attributes:
      model: a preset's name.
      config: its sizes.
      steps: N.
      characters: B.
      precision: of `machine.PRECISIONS`.

    Raises:
      ValueError: for an unknown precision.
    """

    model: str
    config: NetworkConfig
    steps: int
    characters: int
    precision: str = "float32"

    def __post_init__(self):
        matmul_precision(self.precision)

    @property
    def sampler(self) -> str:
        """The sampler that belongs to the model: DDIM for F3AMD, DDPM for CAMDM."""
        return presets.find_preset(self.model).diffusion.sampler

    @property
    def network(self):
        """The network with random weights, in the workload's precision."""
        return _network(self.config, self.precision)

    @property
    def sigmas(self) -> np.ndarray:
        """Noise levels of the steps, [N + 1]."""
        return np.asarray(presets.find_preset(self.model).diffusion.grid(self.steps), np.float32)


@dataclass(frozen=True)
class Round:
    """A round that is ready to run.

    Attributes:
      call: runs it and waits; returns the clean features, [B, T, C].
      compile_seconds: what making it ready took.
    """

    call: Callable[[], object]
    compile_seconds: float


def round_flops(workload: Workload) -> int:
    """Return the operations of one round for all characters (see `networks.counting`)."""
    encode, evaluate = presets.count_model_flops(workload.config)
    return workload.characters * (encode + evaluate * num_evaluations(workload.sampler, workload.steps))


def random_condition(config: NetworkConfig, characters: int, seed: int = 0) -> Condition:
    """Return a condition of random numbers; times do not depend on what it says."""
    rng = np.random.default_rng(seed)
    draw = lambda *shape: rng.standard_normal((characters, *shape), dtype=np.float32)
    style = np.eye(config.num_styles, dtype=np.float32)
    return Condition(
        history=draw(config.num_history, config.channels),
        path=draw(config.window, PATH_CHANNELS),
        style=style[rng.integers(0, config.num_styles, characters)],
    )


@lru_cache(maxsize=64)
def _network(config: NetworkConfig, precision: str):
    """Build a network once for all its numbers of steps and characters, on the CPU: a GPU compiles for each layer."""
    with jax.default_device(jax.local_devices(backend="cpu")[0]):
        return cast_network(presets.build_from_config(config, jax.random.key(0)), PRECISIONS[precision][1])


def jit_round(workload: Workload, network, sample: Callable = sample_round, sharding=None) -> Round:
    """Compile a network's round ahead of time in the workload's precision, for a random condition.

    Args:
      workload: what is asked for.
      network: a denoiser of its config.
      sample: as `rollout.rounds.sample_round`.
      sharding: of the condition; on one device by default.
    """
    run = lambda condition, key: sample(network, condition, workload.sigmas, key, sampler=workload.sampler)
    dtype = PRECISIONS[workload.precision][1]
    condition = jax.device_put(random_condition(workload.config, workload.characters), sharding)
    given = jax.tree.map(lambda leaf: leaf.astype(dtype), condition), jax.random.key(0)
    started = time.perf_counter()
    with matmul_precision(workload.precision):
        compiled = jax.jit(run).lower(*given).compile()
    seconds = time.perf_counter() - started
    return Round(lambda: compiled(*given).block_until_ready(), seconds)


def _all_devices(workload: Workload) -> Round:
    devices = jax.local_devices()
    if len(devices) < 2:
        raise NotPossible("JAX sees one device only: see machine.fast_xla_flags")
    mesh = Mesh(np.array(devices), ("characters",))
    share, whole = PartitionSpec("characters"), PartitionSpec()

    def sample(network, condition, sigmas, key, sampler):
        """Sample a round of as many characters on each device, from noise of its own; the network is copied to all."""

        def own(rows, key):
            key = jax.random.fold_in(key, jax.lax.axis_index("characters"))
            return sample_round(network, rows, sigmas, key, sampler=sampler)

        return jax.shard_map(own, mesh=mesh, in_specs=(share, whole), out_specs=share, check_vma=False)(condition, key)

    return jit_round(workload, workload.network, sample, NamedSharding(mesh, share))


def _check_outside_of_jax(workload: Workload, framework: str) -> None:
    if device_name() != "CPU" or workload.precision != "float32":
        raise NotPossible(f"{framework} is timed on a CPU in float32 only")


def _iree(workload: Workload) -> Round:
    """Compile ahead of time for this CPU; noise is drawn by numpy, inside the timed call."""
    _check_outside_of_jax(workload, "IREE")
    from f3amd_companion.serving.artefact import load_artefact
    from f3amd_companion.serving.export import export_round, save_artefact

    started = time.perf_counter()
    exported = export_round(workload.network, workload.sigmas, workload.characters, workload.sampler)
    with tempfile.TemporaryDirectory() as folder:
        artefact = load_artefact(save_artefact(Path(folder) / "artefact", exported, name=workload.model))
    seconds = time.perf_counter() - started
    given = [artefact.put(part) for part in random_condition(workload.config, workload.characters)]
    shapes = [shape for name, shape in artefact.input_shapes.items() if name.endswith("noise")]
    rng = np.random.default_rng(0)
    draw = lambda shape: artefact.put(rng.standard_normal(shape, dtype=np.float32))
    return Round(lambda: artefact(*given, *map(draw, shapes)), seconds)


def _torch(workload: Workload, *, runtime: str = "eager") -> Round:
    on_gpu = device_name() == "GPU" and workload.precision != "bfloat16" and runtime != "onnx"
    if not on_gpu:
        _check_outside_of_jax(workload, "PyTorch")
    from f3amd_companion.speed import torch_camdm

    started, device = time.perf_counter(), "cuda" if on_gpu else "cpu"
    module = torch_camdm.torch_camdm(workload.network, device=device, tf32=workload.precision == "tf32")
    condition = torch_camdm.torch_condition(random_condition(workload.config, workload.characters), device)
    call = partial(torch_camdm.torch_round(module, workload.sigmas, workload.sampler, runtime=runtime), condition)
    call()
    return Round(call, time.perf_counter() - started)


IMPLEMENTATIONS: dict[str, tuple[str, Callable[[Workload], Round]]] = {
    "jit": ("jax", lambda workload: jit_round(workload, workload.network)),
    "jit, all devices": ("jax", _all_devices),
    "jit, FFT": ("jax", lambda workload: jit_round(workload, fft_reference(workload.network))),
    "IREE": ("iree", _iree),
    "PyTorch": ("torch", _torch),
    "PyTorch, compiled": ("torch", partial(_torch, runtime="compiled")),
    "ONNX Runtime": ("onnx", partial(_torch, runtime="onnx")),
}
"""Implementation -> (framework, function that makes a workload's round ready)."""


def prepare_round(implementation: str, workload: Workload) -> Round:
    """Make a round ready to run.

    Args:
      implementation: of `IMPLEMENTATIONS`.
      workload: what is asked for.

    Raises:
      ValueError: for an unknown implementation.
      NotPossible: if it does not work for the workload or on this machine.
    """
    check_known(implementation, IMPLEMENTATIONS, "implementation")
    try:
        return IMPLEMENTATIONS[implementation][1](workload)
    except (ImportError, ValueError, RuntimeError) as error:
        # The first line may only tell who spoke; advice on debugging comes after the second.
        lines = [line for line in str(error).splitlines() if line.strip()]
        raise NotPossible(" ".join(lines[:2])) from error


def framework_probe(framework: str, precision: str):
    """Return a framework's own matrix product to time: (function that multiplies, its operations).

    Args:
      framework: "jax" or "torch"; the latter on a CPU in float32, on a GPU as `torch_camdm.torch_camdm` set it.
      precision: of `machine.PRECISIONS`.
    """
    if framework == "jax":
        return matmul_probe(precision)
    from f3amd_companion.speed.torch_camdm import torch_matmul_probe

    return torch_matmul_probe("cuda" if device_name() == "GPU" else "cpu")
