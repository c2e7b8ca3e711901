"""The course where numpy and what stands on it is all there is, as in a browser tab: JAX and its like are hidden."""

import ast
import os
import subprocess
import sys
from pathlib import Path

import nbformat
import numpy as np
import pytest

from f3amd_lib.diffusion.oracles import GaussianMixture
from f3amd_lib.diffusion.samplers import SAMPLERS, sample
from f3amd_lib.diffusion.schedules import variance_exploding, variance_preserving_betas
from f3amd_lib.text import phases

ROOT = Path(__file__).resolve().parents[1]
COURSE = sorted((ROOT / "notebooks/course").glob("*.ipynb"))
LESSONS = [path for path in COURSE if path.name < "11"]
MARK = "# needs jax"
# A Python that starts with this on its path finds none of them. They are what the package needs and Pyodide lacks.
HIDE = """
from importlib.machinery import PathFinder
hidden = "jax jaxlib flax optax orbax diffrax ot safetensors flatbuffers pooch tqdm etils tyro seaborn".split()
find = PathFinder.find_spec
PathFinder.find_spec = lambda name, *more: None if name.partition(".")[0] in hidden else find(name, *more)
"""


@pytest.fixture
def bare(tmp_path) -> dict:
    """The environment of a process that has no JAX."""
    (tmp_path / "sitecustomize.py").write_text(HIDE)
    return os.environ | {"PYTHONPATH": os.pathsep.join(map(str, (tmp_path, ROOT, ROOT / "notebooks")))}


def code_of(path: Path) -> list[str]:
    """The code of a notebook's cells but that which installs."""
    cells = nbformat.read(path, as_version=4).cells
    return [c.source for c in cells if c.cell_type == "code" and "install" not in c.metadata.get("tags", [])]


@pytest.mark.slow
def test_what_the_course_imports_is_there_without_jax(bare):
    asked = {
        ast.unparse(node): None
        for path in COURSE
        for code in code_of(path)
        if not code.startswith(MARK)
        for node in ast.walk(ast.parse(code))
        if isinstance(node, (ast.Import, ast.ImportFrom))
    }
    assert len(asked) > 20
    for path in COURSE:  # the helpers skip, so that they come first
        before = "".join(code_of(path)).partition(MARK)
        assert not before[1] or "f3amd_notebooks" in before[0], path.name
    lines = [
        "from IPython.core.interactiveshell import InteractiveShell",
        "run = lambda code: InteractiveShell.instance().run_cell(code).success",
        f"assert run({chr(10).join(asked)!r})",
        f"assert run('{MARK}\\nimport jax') and not run('import jax')",
    ]
    found = subprocess.run([sys.executable, "-c", "\n".join(lines)], env=bare, capture_output=True, text=True)
    assert found.returncode == 0 and "Skipped: this cell" in found.stdout, found.stdout + found.stderr


@pytest.mark.slow
@pytest.mark.parametrize("path", LESSONS, ids=lambda path: path.stem)
def test_a_lesson_runs_without_jax_and_says_what_it_skips(path, bare):
    client = pytest.importorskip("nbclient").NotebookClient
    notebook = nbformat.read(path, as_version=4)
    client(notebook, timeout=600, resources={"metadata": {"path": str(path.parent)}}).execute(env=bare)
    for cell in (cell for cell in notebook.cells if cell.cell_type == "code"):
        printed = "".join(output.get("text", "") for output in cell.outputs)
        assert printed.startswith("Skipped:") == cell.source.startswith(MARK), cell.source


@pytest.mark.parametrize("name", SAMPLERS)
def test_numpy_comes_out_where_numpy_goes_in_and_jax_agrees(name):
    import jax

    pair, grid = GaussianMixture([-1.0, 1.0], width=0.3), variance_exploding().grid(8)
    start = grid[0] * np.random.default_rng(0).standard_normal((256, 1))
    rng = np.random.default_rng(1)
    found = sample(name, pair.denoise, start, grid, key=rng)
    assert type(found) is np.ndarray and found.dtype == np.float64
    with jax.enable_x64(True):
        same = np.asarray(sample(name, pair.denoise, jax.numpy.asarray(start), grid, key=jax.random.key(0)))
    if SAMPLERS[name].draws_noise:  # other noise, the same distribution
        np.testing.assert_allclose(found.std(), np.std(same), rtol=0.1)
        assert np.abs(found - sample(name, pair.denoise, start, grid, key=rng)).max() > 0.1
    else:
        np.testing.assert_allclose(found, same, atol=1e-9)


def test_phases_in_numpy_are_those_in_jax():
    import jax.numpy as jnp

    schedule = variance_preserving_betas()
    state, noise = np.random.default_rng(0).standard_normal((2, 5, 3))
    time, edge = np.array([999, 600, 300, 199, 1]), np.array([499, 499, 199, 199, 0])
    predict = lambda z, t: 0.5 * z
    for step in (
        lambda a, b: phases.noised(schedule, a, b, time),
        lambda a, b: phases.target_end(schedule, a, b, time, edge),
        lambda a, b: phases.noise_travel(schedule, a, edge, time, b),
        lambda a, b: phases.latent_consistency_end(schedule, a, b, time),
        lambda a, b: phases.follow(predict, schedule, a, phases.cut_phases(num_phases=4).visited),
        lambda a, b: phases.pseudo_huber(a - b, 0.1),
    ):
        found, same = step(state, noise), step(jnp.asarray(state, jnp.float32), jnp.asarray(noise, jnp.float32))
        assert type(found) is np.ndarray
        np.testing.assert_allclose(found, same, rtol=1e-4, atol=1e-4)
