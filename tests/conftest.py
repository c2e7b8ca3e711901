"""Shared fixtures. Tests run on the CPU and never touch the network or the user's own cache."""

import csv
import gc
import importlib.util
import os
import shutil
import sys
from importlib.metadata import version
from pathlib import Path

# Before anything imports JAX or matplotlib.
os.environ["JAX_PLATFORMS"] = "cpu"
# Tests compile much and run little.
os.environ.setdefault("JAX_DISABLE_MOST_OPTIMIZATIONS", "1")
# Fusions by way of MLIR are half of the time that XLA needs for such programs, cutting them up for more threads a
# tenth. XLA ends a process that names a flag it does not know: only versions of the lock are known to have these.
if f"jaxlib=={version('jaxlib')} " in (Path(__file__).resolve().parents[1] / "requirements.lock").read_text():
    os.environ["XLA_FLAGS"] = os.environ.get("XLA_FLAGS", "") + " --xla_cpu_use_fusion_emitters=false"
    os.environ["XLA_FLAGS"] += " --xla_cpu_parallel_codegen_split_count=1"
# What one test, worker or run compiled, the next ones read: few networks are compiled again and again.
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(Path(__file__).resolve().parents[1] / ".pytest_cache" / "jax"))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
os.environ["MPLBACKEND"] = "Agg"
sys.path.append(str(Path(__file__).resolve().parents[1] / "scripts"))  # which tests import by name

import eager
import pytest

from f3amd_lib.data import sources
from f3amd_lib.data.packed import CACHE_DIR_VARIABLE

# Tracing makes many small objects, nearly all of which are kept: looking through them for garbage as often as Python
# does by itself took a seventh of the time.
gc.set_threshold(100_000, 20, 50)

if "fusion_emitters" in os.environ.get("XLA_FLAGS", ""):  # the version of the lock, whose insides are known
    eager.move_by_numpy()

REMEDY = {
    "selenium": "make web-tools",
    "distributed": "make sweep-tools",
    "jax2onnx": "make onnx-tools",
    "node": "your system's package manager",
    "wordllama": "make install",
    "tokenizers": "make install",
}
"""What brings an optional part of the tests, where it is not `make bench-tools`."""


def pytest_runtest_setup(item):
    """Skip a test that asks for a package or program which is not there, by its name."""
    for marker in (*item.iter_markers("needs"), *item.iter_markers("wants")):
        for name in marker.args:
            if shutil.which(name) is None and not _importable(name):
                pytest.skip(f"{name} is not installed: {REMEDY.get(name, 'make bench-tools')}")


def _importable(name: str) -> bool:
    try:
        return importlib.util.find_spec(name) is not None
    except ModuleNotFoundError:  # of the package above it
        return False


@pytest.fixture(scope="module", autouse=True)
def few_compiled_programs():
    """Forget compiled programs between files once there are some 800.

    Each keeps the MLIR context that it was lowered in, and the more contexts live, the slower the next one is built:
    from 8 ms for the first programs to 45 ms after 5,000. Each holds memory maps, too, of which Linux gives a process
    65,530: a worker that asks for one more dies of it.
    """
    yield
    maps = Path("/proc/self/maps")
    if "jax" in sys.modules and maps.exists() and maps.read_text().count("\n") > 3_000:
        sys.modules["jax"].clear_caches()


@pytest.fixture
def cache_dir(tmp_path, monkeypatch) -> Path:
    """An empty folder that stands for the user's cache of packed data sets."""
    folder = tmp_path / "cache"
    monkeypatch.setenv(CACHE_DIR_VARIABLE, str(folder))
    return folder


@pytest.fixture
def model_that(monkeypatch):
    """Make a tiny model whose network answers by a rule: `model_that(lambda x_noisy, sigma: ..., **changes)`."""
    from builders import AnsweringNetwork, tiny_trained

    from f3amd_lib.training.checkpoints import TrainedModel

    def make(answer, **changes):
        monkeypatch.setattr(TrainedModel, "network", lambda self: AnsweringNetwork(answer))
        return tiny_trained(**changes)

    return make


@pytest.fixture
def no_network(monkeypatch):
    """Make any download a failure of the test."""
    import pooch

    def refuse(*args, **kwargs):
        pytest.fail("the network was touched")

    monkeypatch.setattr(pooch, "retrieve", refuse)


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """The folder or zip of F3AMD_DATA_DIR; skips where the variable is not set."""
    place = os.environ.get(sources.DATA_DIR_VARIABLE)
    if not place:
        pytest.skip(f"{sources.DATA_DIR_VARIABLE} is not set: no real data to test on")
    return Path(place)


@pytest.fixture(scope="session")
def bandai_archive(data_dir) -> Path:
    """Where the Bandai archive lies; skips if F3AMD_DATA_DIR does not hold it.

    Only its absence skips. An archive that is there but broken fails the tests that use it.
    """
    zipped = [item for item in data_dir.glob("*.zip") if "bandai" in item.name.lower()]
    if data_dir.is_file() or zipped or next(data_dir.rglob("dataset-1_*.bvh"), None):
        return data_dir
    pytest.skip(f"{sources.DATA_DIR_VARIABLE}={data_dir} holds no Bandai Namco clips")


@pytest.fixture(scope="session")
def bandai_dataset(bandai_archive) -> sources.Dataset:
    """The locomotion part of the Bandai archive."""
    return sources.open_dataset("bandai", path=bandai_archive)


@pytest.fixture(scope="session")
def bandai_manifest(data_dir, bandai_archive) -> list[dict[str, str]]:
    """Rows of the manifest that another parser made of the same files; skips if it is absent."""
    folder = data_dir if data_dir.is_dir() else data_dir.parent
    path = folder / "bandai_namco_manifest.csv"
    if not path.is_file():
        pytest.skip(f"no {path.name} beside the Bandai archive")
    with path.open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))
