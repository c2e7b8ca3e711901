"""The standalone notebook: beside Python it needs numpy and matplotlib alone, and says what the library says.

It holds copies of the library's formulas, so that a teacher can drop one file into any course.
Here the copies are held against the originals, by value.
"""

import ast
import builtins
from pathlib import Path

import jax
import jax.numpy as jnp
import nbformat
import numpy as np
import pytest

from f3amd_lib.diffusion import oracles, samplers, schedules

PATH = Path(__file__).resolve().parents[1] / "notebooks/standalone/sampler_theory_standalone.ipynb"
ALLOWED = {"numpy", "matplotlib", "math"}
LEVELS = [(128.0, 82.3), (2.0, 0.5), (2.0, 1.9), (0.3, 0.01), (0.01, 0.0)]


def code_cells(tag=None) -> list[str]:
    """Sources of the notebook's code cells, all or those with a tag."""
    notebook = nbformat.v4.reads(PATH.read_text("utf-8"))
    cells = [cell for cell in notebook.cells if cell.cell_type == "code"]
    return [cell.source for cell in cells if tag is None or tag in cell.metadata.get("tags", [])]


def imported_packages(source: str) -> set[str]:
    """Top names of what a piece of code imports, by import statement or by calling for it."""
    names = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            names.add("." * node.level + (node.module or "").split(".")[0])
        elif isinstance(node, ast.Name) and node.id in ("__import__", "exec", "eval", "open"):
            names.add(node.id)
    return names


def run_cells(sources) -> dict:
    """Run cells in one namespace, where what they may not import cannot be had; return their names."""

    def only_allowed(name, *args, **kwargs):
        if name.split(".")[0] not in ALLOWED:
            raise ImportError(f"{name} is not to be had here")
        return builtins.__import__(name, *args, **kwargs)

    namespace = {"__builtins__": vars(builtins) | {"__import__": only_allowed}}
    for source in sources:
        exec(compile(source, PATH.name, "exec"), namespace)
    return namespace


@pytest.fixture(scope="module")
def standalone() -> dict:
    """Names that the cells with imports and those tagged `functions` define."""
    return run_cells(code_cells()[:1] + code_cells("functions"))


@pytest.fixture
def states() -> dict:
    """A state, a guess and fresh noise, [50, 2] each."""
    draws = np.random.default_rng(0).standard_normal((3, 50, 2))
    return dict(zip(("x", "x0_hat", "noise"), draws, strict=True))


MIXTURES = [([-1.0, 1.0], 0.3), ([[-1.2, -0.8], [1.3, -0.6], [0.0, 1.3]], 0.15)]


def test_the_notebook_imports_numpy_and_matplotlib_and_nothing_else():
    assert set().union(*map(imported_packages, code_cells())) == ALLOWED
    with pytest.raises(ImportError, match="f3amd_lib.diffusion is not to be had"):
        run_cells(["from f3amd_lib.diffusion import samplers"])


@pytest.mark.parametrize(("means", "width"), MIXTURES)
@pytest.mark.parametrize("sigma", [0.0, 0.2, 1.0, 128.0])
def test_eq01_mixture_is_the_librarys(standalone, means, width, sigma):
    here = standalone["GaussianMixture"](means, width)
    library = oracles.GaussianMixture(means, width)
    x = 3.0 * np.random.default_rng(1).standard_normal((40, library.means.shape[1]))
    for name in ("log_density", "score", "denoise"):
        ours, theirs = getattr(here, name)(x, sigma), getattr(library, name)(x, sigma)
        np.testing.assert_allclose(ours, theirs, rtol=1e-11, atol=1e-11, err_msg=name)
    draws = [m.sample(np.random.default_rng(2), 100) for m in (here, library)]
    np.testing.assert_array_equal(*draws)


@pytest.mark.parametrize(("sigma", "sigma_next"), [(100.0, 0.01), (0.5, 2.0)])
def test_the_exact_flow_is_the_librarys(standalone, sigma, sigma_next):
    mixture = oracles.GaussianMixture([-1.0, 1.0], 0.3)
    share = np.array([[0.001], [0.3], [0.5], [0.99]])
    x = standalone["at_quantile"](mixture, share, sigma)
    np.testing.assert_allclose(standalone["below"](mixture, x, sigma), share, atol=1e-12)
    np.testing.assert_allclose(mixture._tails(x, sigma)[0], share, atol=1e-12)
    there = standalone["exact_flow"](mixture, x, sigma, sigma_next)
    np.testing.assert_allclose(there, mixture.flow(x, sigma, sigma_next), atol=1e-9)
    assert np.abs(there - x).max() > 0.1


@pytest.mark.parametrize("rho", [3.0, 7.0])
def test_eq09_levels_are_the_librarys(standalone, rho):
    library = schedules.variance_exploding(rho=rho)
    t = np.linspace(0.0, 1.0, 33)
    np.testing.assert_allclose(standalone["sigma_at"](t, rho=rho), library.sigma(t), rtol=1e-14)
    for num_steps in (1, 2, 4, 8, 64):
        ours = standalone["rho_grid"](num_steps, rho=rho)
        np.testing.assert_allclose(ours, library.grid(num_steps), rtol=1e-14)
        assert ours[-1] == 0.0
    assert standalone["rho_grid"](2)[0] == pytest.approx(schedules.variance_exploding().sigma_max)


def test_eq08_noise_and_labels_are_the_librarys(standalone, states):
    x, noise = states["x"], states["noise"]
    np.testing.assert_array_equal(standalone["add_noise"](x, 2.0, noise), samplers.add_noise(x, 2.0, noise))
    for name in ("alpha_bar_from_sigma", "log_snr_from_sigma", "sigma_from_alpha_bar"):
        values = np.array([0.999, 0.5, 0.01])
        np.testing.assert_allclose(standalone[name](values), getattr(schedules, name)(values), rtol=1e-13)


@pytest.mark.parametrize(("sigma", "sigma_next"), LEVELS)
def test_appendix_f_steps_are_the_librarys(standalone, states, sigma, sigma_next):
    x, x0_hat, noise = states["x"], states["x0_hat"], states["noise"]
    powers = [1.0 / (1.0 + level**2) for level in (sigma, sigma_next)]
    exact = {"rtol": 1e-11, "atol": 1e-11}
    for name, given in {
        "ddim_step": (x, x0_hat, sigma, sigma_next),
        "ddpm_step": (x, x0_hat, sigma, sigma_next, noise),
        "probability_flow_slope": (x, x0_hat, sigma),
        "ddim_step_vp": (x, x0_hat, *powers),
        "ddpm_posterior": powers,
    }.items():
        np.testing.assert_allclose(standalone[name](*given), getattr(samplers, name)(*given), **exact, err_msg=name)
    for eta, step in ((0.0, samplers.ddim_step), (1.0, samplers.ddpm_step)):
        fresh = (noise,) if eta else ()
        here = standalone["eta_step"](x, x0_hat, sigma, sigma_next, eta, noise)
        np.testing.assert_allclose(here, step(x, x0_hat, sigma, sigma_next, *fresh), **exact)
    half = standalone["eta_step"](0.0, 0.0, sigma, sigma_next, 0.5, noise)  # the fresh part of it
    np.testing.assert_allclose(2 * half, samplers.ddpm_step(0.0, 0.0, sigma, sigma_next, noise), **exact)


@pytest.mark.parametrize(
    ("step", "sampler"), [("euler_step", "euler"), ("ve_step", "ddim"), ("vp_step", "ddim_vp"), ("heun_step", "heun")]
)
@pytest.mark.parametrize("num_steps", [1, 8])
def test_walks_end_where_the_librarys_samplers_end(standalone, step, sampler, num_steps):
    library = oracles.GaussianMixture([-1.0, 1.0], 0.3)
    grid = schedules.variance_exploding().grid(num_steps)
    start = grid[0] * np.random.default_rng(3).standard_normal((60, 1))
    # The VP state starts and ends as z; at sigma = 0 both states are one.
    first = start / np.sqrt(1.0 + grid[0] ** 2) if step == "vp_step" else start
    states = standalone["walk"](standalone[step], library.denoise, first, grid)
    assert states.shape == (num_steps + 1, 60, 1)
    with jax.enable_x64(True):
        expected = samplers.sample(sampler, library.denoise, jnp.asarray(start), grid)
    np.testing.assert_allclose(states[-1], expected, rtol=1e-9, atol=1e-9)
