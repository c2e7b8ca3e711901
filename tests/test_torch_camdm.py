"""CAMDM in PyTorch and in ONNX Runtime gives the numbers of CAMDM in JAX."""

import functools
import shutil

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from builders import CHANNELS, WINDOW, draw, evaluate, make_condition, network_of, refused, tiny_camdm, tiny_config
from flax import nnx

from f3amd_companion.speed import implementations
from f3amd_lib.diffusion.schedules import variance_preserving_cosine
from f3amd_lib.rollout.rounds import sample_round

torch = pytest.importorskip("torch", reason="torch is not installed: make bench-tools")
torch_camdm = pytest.importorskip("f3amd_companion.speed.torch_camdm")
pytestmark = pytest.mark.needs("torch", "onnxscript", "onnxruntime")

SIGMAS = variance_preserving_cosine(4).grid(4)
KEY = jax.random.key(3)
TOLERANCE = 1e-4
LAYOUTS = {
    "one path token a frame": {},
    "two path tokens a frame": {"split_path": True},
    "told sigma, not its number": {"noise_levels": ()},
    "raw input, one head": {"input_scaling": False, "num_heads": 1},
    "sigma_data of a half": {"sigma_data": 0.5},
}


@pytest.fixture(autouse=True)
def one_thread(monkeypatch):
    """Threads that wait for one another make small networks slow on a busy machine."""
    before = torch.get_num_threads()
    monkeypatch.setattr(torch_camdm, "usable_cores", lambda: 1)
    yield
    torch.set_num_threads(before)


@functools.cache
def lively(config):
    """A network without the zeros and ones that biases and norms start from."""
    network = network_of(config)
    graph, state = nnx.split(network)
    leaves, tree = jax.tree.flatten(state)
    rng = np.random.default_rng(0)
    stirred = [leaf + 0.1 * rng.standard_normal(leaf.shape).astype(np.float32) for leaf in leaves]
    return nnx.merge(graph, jax.tree.unflatten(tree, stirred))


def small(**changes):
    return tiny_camdm(**{"latent_width": 32, "depth": 2, "num_heads": 4, **changes})


def as_tensor(array):
    return torch.from_numpy(np.array(array))


def in_torch(module, x_noisy, sigma, condition):
    """Encode and denoise in PyTorch."""
    context = module.encode(torch_camdm.torch_condition(condition))
    levels = np.broadcast_to(np.asarray(sigma, np.float32), len(x_noisy))
    scales, features = map(as_tensor, torch_camdm.tell_levels(module.config, levels))
    with torch.inference_mode():
        return module(as_tensor(x_noisy) * scales[:, None, None], module.noise_tokens(features), context).numpy()


def given_noise(batch: int, num_steps: int, config):
    """The numbers that `sample_round` draws from KEY: at the start, and for each step."""
    key_init, key_steps = jax.random.split(KEY)
    shape = (batch, config.window, config.channels)
    steps = [jax.random.normal(key, shape) for key in jax.random.split(key_steps, num_steps)]
    return np.array(jax.random.normal(key_init, shape)), np.array(steps)


def jax_round(network, condition, sigmas, sampler):
    run = lambda condition: sample_round(network, condition, sigmas, KEY, sampler=sampler)
    return np.asarray(jax.jit(run)(condition))


@pytest.mark.parametrize("layout", LAYOUTS)
def test_denoiser_gives_the_numbers_of_jax(layout):
    network = lively(small(**LAYOUTS[layout]))
    module = torch_camdm.torch_camdm(network)
    condition, noise = make_condition(3), draw(3, WINDOW, CHANNELS)
    for sigma in (*SIGMAS[:-1], 0.3, np.array([0.2, 1.0, 9.0])):
        levels = jnp.broadcast_to(jnp.asarray(sigma, jnp.float32), 3)
        x_noisy = noise * levels[:, None, None]
        expected = evaluate(network, x_noisy, levels, condition)
        found = in_torch(module, x_noisy, sigma, condition)
        assert found.dtype == np.float32
        np.testing.assert_allclose(found, expected, atol=TOLERANCE)


@pytest.mark.parametrize("sampler", ["ddim", "ddpm"])
@pytest.mark.parametrize("layout", list(LAYOUTS)[:2])
def test_round_gives_the_numbers_of_jax(layout, sampler):
    network = lively(small(**LAYOUTS[layout]))
    condition = make_condition(3)
    noise, step_noise = given_noise(3, 4, network.config)
    expected = jax_round(network, condition, SIGMAS, sampler)
    for runtime in ("eager", "onnx"):
        module = torch_camdm.torch_camdm(network)
        found = torch_camdm.torch_round(module, SIGMAS, sampler, runtime=runtime)(
            torch_camdm.torch_condition(condition), noise=as_tensor(noise), step_noise=as_tensor(step_noise)
        )
        np.testing.assert_allclose(found.numpy(), expected, atol=TOLERANCE)


def test_compiler_that_fails_says_why(monkeypatch):
    def refuse(graph, inputs):
        raise OSError("there is no C++ compiler\nand much more")

    torch._dynamo.reset()
    monkeypatch.setattr(torch, "compile", functools.partial(torch.compile, backend=refuse))
    task = implementations.Workload("CAMDM", small(), 1, 2)
    with pytest.raises(implementations.NotPossible, match=r"there is no C\+\+ compiler") as caught:
        implementations.prepare_round("PyTorch, compiled", task)
    assert "debug" not in str(caught.value).lower()


@pytest.mark.slow
@pytest.mark.skipif(not any(map(shutil.which, ("g++", "clang++"))), reason="torch.compile needs a C++ compiler")
def test_compiled_code_gives_the_numbers_of_jax():
    network, condition = lively(small()), make_condition()
    noise, step_noise = given_noise(2, 4, network.config)
    run = torch_camdm.torch_round(torch_camdm.torch_camdm(network), SIGMAS, runtime="compiled")
    found = run(torch_camdm.torch_condition(condition), noise=as_tensor(noise), step_noise=as_tensor(step_noise))
    expected = jax_round(network, condition, SIGMAS, "ddpm")
    np.testing.assert_allclose(found.numpy(), expected, atol=TOLERANCE)


def test_probe_multiplies_and_counts():
    multiply, operations = torch_camdm.torch_matmul_probe(size=48)
    matrix = torch.randn(48, 48, generator=torch.Generator().manual_seed(0)).numpy()
    np.testing.assert_allclose(multiply().numpy(), matrix @ matrix, atol=1e-4)
    assert operations == 2 * 48**3


def test_bad_input_is_refused():
    refused("only CAMDM", torch_camdm.torch_camdm, network_of(tiny_config()))
    module = torch_camdm.torch_camdm(lively(small()))
    refused("unknown PyTorch sampler 'ddmp'.*'ddpm'", torch_camdm.torch_round, module, SIGMAS, "ddmp")
