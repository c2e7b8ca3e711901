"""The machine that times are taken on: what it is, and how fast it multiplies matrices at best."""

import os
import platform
import re
import subprocess
import sys
from collections.abc import Callable, Hashable, Iterable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp

from f3amd_lib.ground.names import check_known
from f3amd_lib.ground.records import usable_cores

PRECISIONS = {
    "float32": ("float32", jnp.float32),
    "tf32": ("tensorfloat32", jnp.float32),
    "bfloat16": ("default", jnp.bfloat16),
}
"""Name -> (JAX's matmul precision, type of arrays). tf32: GPU only; float32 in memory, products of
10-bit mantissas."""


def matmul_precision(precision: str):
    """Return a context in which matrix products have a precision of `PRECISIONS`.

    Raises:
      ValueError: for an unknown precision.
    """
    check_known(precision, PRECISIONS, "precision")
    return jax.default_matmul_precision(PRECISIONS[precision][0])


def device_name() -> str:
    """Return "CPU", "GPU" or "TPU" for the device that JAX computes on."""
    return {"cuda": "GPU", "rocm": "GPU"}.get(jax.devices()[0].platform, jax.devices()[0].platform.upper())


def prepared_at_once(prepare: Callable[[Hashable], object], items: Iterable[Hashable]) -> dict:
    """Return item -> function that gives `prepare(item)`, or raises what it raised.

    On a GPU all are prepared at once, in threads: XLA compiles for it on one core each. On a CPU, where a compiler
    takes all cores, each is prepared when it is asked for.
    """
    if device_name() != "GPU":
        return {item: partial(prepare, item) for item in items}
    threads = ThreadPoolExecutor(usable_cores())
    under_way = {item: threads.submit(prepare, item).result for item in items}
    threads.shutdown(wait=False)
    return under_way


def _processor() -> str:
    """Return the processor's name, which `platform.processor` leaves out on Linux."""
    told = Path("/proc/cpuinfo")
    text = told.read_text(encoding="utf-8") if told.is_file() else ""
    name = re.search(r"^model name\s*:\s*(.+)$", text, flags=re.MULTILINE)
    return name[1].strip() if name else platform.processor() or platform.machine()


def describe_machine() -> dict:
    """Describe the machine as far as it decides how fast things run.

    Returns:
      A dict ready for a run record: processor, cores (that this process may use), load (mean of
      the last minute: what else was running; None where the system does not tell), system, xla_flags.
    """
    return {
        "processor": _processor(),
        "cores": usable_cores(),
        "load": round(os.getloadavg()[0], 2) if hasattr(os, "getloadavg") else None,
        "system": f"{platform.system()} {platform.machine()}",
        "xla_flags": os.environ.get("XLA_FLAGS", ""),
    }


def matmul_probe(precision: str = "float32", size: int | None = None) -> tuple[Callable[[], object], int]:
    """Return a product of two square matrices to time, the yardstick for what a machine can do.

    Args:
      precision: of `PRECISIONS`.
      size: rows of a matrix; by default 2048, and 8192 on a GPU.

    Returns:
      (function that multiplies and waits, its operations 2 size^3).

    Raises:
      ValueError: for an unknown precision.
    """
    size = size or (2048 if device_name() == "CPU" else 8192)
    with matmul_precision(precision):
        matrix = jax.random.normal(jax.random.key(0), (size, size), PRECISIONS[precision][1])
        multiply = jax.jit(jnp.matmul).lower(matrix, matrix).compile()
    return lambda: multiply(matrix, matrix).block_until_ready(), 2 * size**3


_FAST_FLAGS = ("--xla_cpu_experimental_ynn_fusion_type=", "--xla_gpu_experimental_enable_fusion_autotuner=false")
"""XLA's flags that helped. On a CPU: without fusion into YNNPACK's products a step of F3AMD-FNO-96 took 0.8 of the
time. For a GPU: XLA of jax 0.11 tries out each of a program's fusions, and compiled a training step for minutes."""


def fast_xla_flags(num_devices: int | None = None) -> str:
    """Return XLA_FLAGS for the fastest rounds: on a CPU one device a core, and what helped besides.

    They must be in the environment before JAX starts. A flag that this release of XLA does not know
    would end the process, so each is tried in a process of its own.

    Args:
      num_devices: CPU devices that JAX shall see; by default one for each core.
    """
    flags = f"--xla_force_host_platform_device_count={num_devices or usable_cores()}"
    for flag in _FAST_FLAGS:
        tried = subprocess.run(
            [sys.executable, "-c", "import jax; jax.devices()"],
            env=os.environ | {"XLA_FLAGS": flag, "JAX_PLATFORMS": "cpu"},
            capture_output=True, timeout=120, check=False,
        )  # fmt: skip
        if tried.returncode == 0:
            flags += f" {flag}"
    return flags
