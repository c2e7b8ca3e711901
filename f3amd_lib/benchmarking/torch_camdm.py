"""CAMDM in PyTorch, with the weights of ours: the baseline of the speed benchmarks.

The network is `networks.camdm` once more, in float32, as fast as we could make it on a CPU: one
product for query, key and value, kernels stored as the products want them, attention by
`scaled_dot_product_attention`, residuals and biases added in place, noise tokens of all steps made
at once. On a Xeon it was at least as fast as `nn.TransformerEncoderLayer` on its fast path, as
`functional.linear`, and as attention written in batched products. It computes all that the JAX form
computes. PyTorch is part of the extra "bench"; nothing else in the library needs it.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterator
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from f3amd_lib.benchmarking.timing import take_turns
from f3amd_lib.diffusion.samplers import ddim_step, ddpm_step
from f3amd_lib.ground.names import nearest_hint
from f3amd_lib.networks.attention import position_code
from f3amd_lib.networks.camdm import CAMDM, POSITION_BASE, CAMDMConfig, step_features
from f3amd_lib.networks.conditioning import Condition, noise_features
from f3amd_lib.networks.config import scaled_input

try:
    import torch
    from torch import nn
    from torch.nn import functional
except ImportError as error:
    raise ImportError(
        f'PyTorch is not installed: make bench-tools, or pip install "f3amd_lib[bench]" (importing torch said: {error})'
    ) from error

PRODUCTS = ("blas", "onednn")
"""Libraries within PyTorch that can do the large products. "blas" is what everybody gets, and on
x86 that is MKL, which need not be at its best on a processor of another make. "onednn" packs the
kernels once and does bias, residual and GELU within the product."""

ROUND_SAMPLERS = ("ddim", "ddpm")
"""Those of `diffusion.samplers` that a round outside of JAX can walk with."""

_LAYER_NORM_EPSILON = 1e-5
_MAX_COMPILED = 64


def usable_cores() -> int:
    """Return how many cores this process may use."""
    affinity = getattr(os, "sched_getaffinity", None)
    return len(affinity(0)) if affinity else os.cpu_count() or 1


@contextlib.contextmanager
def torch_threads(threads: int | None = None) -> Iterator[int]:
    """Let PyTorch compute with so many threads inside a `with` block, as before after it.

    Args:
      threads: by default as many as there are usable cores.

    Yields:
      The number of threads.

    Raises:
      ValueError: for less than one thread.
    """
    threads = usable_cores() if threads is None else threads
    if threads < 1:
        raise ValueError(f"PyTorch needs at least 1 thread, got threads={threads}")
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        yield threads
    finally:
        torch.set_num_threads(before)


def _tensor(parameter) -> torch.Tensor:
    """Copy a parameter of the JAX network."""
    return torch.from_numpy(np.array(parameter[...], np.float32))


class _Linear(nn.Module):
    """Linear layer on rows [M, K], by BLAS: the kernel is [K, N], so that nothing is transposed."""

    def __init__(self, kernel: torch.Tensor, bias: torch.Tensor):
        super().__init__()
        self.kernel = nn.Parameter(kernel.contiguous(), requires_grad=False)
        self.bias = nn.Parameter(bias, requires_grad=False)

    def forward(self, rows):
        return torch.mm(rows, self.kernel).add_(self.bias)

    def gelu(self, rows):
        """Return the exact GELU of the layer's answer."""
        return torch.ops.aten.gelu_(self(rows))

    def added_to(self, residual, rows):
        """Return residual + the layer's answer; `residual` [M, N] is overwritten."""
        return residual.addmm_(rows, self.kernel).add_(self.bias)


class _PackedLinear(nn.Module):
    """Linear layer on rows [M, K], by oneDNN, which packs the kernel and does what comes after."""

    def __init__(self, kernel: torch.Tensor, bias: torch.Tensor):
        super().__init__()
        # Not a parameter: the packed form is opaque, and a module could not save it.
        self.packed = torch.ops.mkldnn._reorder_linear_weight(kernel.T.contiguous(), None)
        self.bias = nn.Parameter(bias, requires_grad=False)

    def forward(self, rows):
        return torch.ops.mkldnn._linear_pointwise(rows, self.packed, self.bias, "none", [], "")

    def gelu(self, rows):
        return torch.ops.mkldnn._linear_pointwise(rows, self.packed, self.bias, "gelu", [], "none")

    def added_to(self, residual, rows):
        return torch.ops.mkldnn._linear_pointwise.binary(rows, residual, self.packed, self.bias, "add")


class _LayerNorm(nn.Module):
    def __init__(self, layer):
        super().__init__()
        self.scale = nn.Parameter(_tensor(layer.scale), requires_grad=False)
        self.bias = nn.Parameter(_tensor(layer.bias), requires_grad=False)

    def forward(self, rows):
        return functional.layer_norm(rows, self.scale.shape, self.scale, self.bias, _LAYER_NORM_EPSILON)


class _Block(nn.Module):
    """Encoder block (`networks.attention.TransformerBlock`) on the rows of all characters."""

    def __init__(self, block, linear):
        super().__init__()
        attention = block.attention
        self.num_heads = attention.num_heads
        asked = (attention.query, attention.key, attention.value)
        self.query_key_value = linear(
            torch.cat([_tensor(layer.kernel) for layer in asked], dim=1),
            torch.cat([_tensor(layer.bias) for layer in asked]),
        )
        self.attention_output = linear(_tensor(attention.output.kernel), _tensor(attention.output.bias))
        self.attention_norm = _LayerNorm(block.attention_norm)
        self.hidden = linear(_tensor(block.hidden.kernel), _tensor(block.hidden.bias))
        self.output = linear(_tensor(block.output.kernel), _tensor(block.output.bias))
        self.output_norm = _LayerNorm(block.output_norm)

    def forward(self, z, num_tokens: int):
        """Map z [B * num_tokens, D] to the same shape; `z` may be overwritten."""
        width = z.shape[1]
        asked = self.query_key_value(z)
        asked = asked.view(-1, num_tokens, 3, self.num_heads, width // self.num_heads)
        query, key, value = asked.permute(2, 0, 3, 1, 4)
        answer = functional.scaled_dot_product_attention(query, key, value)
        # The kernel leaves the heads of a token side by side: this reshape copies nothing.
        answer = answer.transpose(1, 2).reshape(-1, width)
        z = self.attention_norm(self.attention_output.added_to(z, answer))
        return self.output_norm(self.output.added_to(z, self.hidden.gelu(z)))


class TorchCAMDM(nn.Module):
    """CAMDM in PyTorch: `encode` once a round, then called as denoiser (see `torch_camdm`).

    Attributes:
      config: of the JAX network.
      products: of `PRODUCTS`.
    """

    def __init__(self, network: CAMDM, products: str = "blas"):
        super().__init__()
        config = network.config
        self.config, self.products = config, products
        packed = {"blas": _Linear, "onednn": _PackedLinear}[products]
        make = lambda kind, layer: kind(_tensor(layer.kernel), _tensor(layer.bias))
        # Packing pays in the large products only.
        self.noise_first = make(_Linear, network.noise_first)
        self.noise_second = make(_Linear, network.noise_second)
        self.style = nn.Parameter(_tensor(network.style.kernel), requires_grad=False)
        self.path = nn.ModuleList([make(_Linear, layer) for layer in network.path])
        self.history = make(_Linear, network.history)
        self.future = make(_Linear, network.future)
        self.blocks = nn.ModuleList([_Block(block, packed) for block in network.blocks])
        self.output = make(_Linear, network.output)
        code = position_code(0, config.num_tokens, config.latent_width, base=POSITION_BASE)
        self.register_buffer("code", torch.tensor(code, dtype=torch.float32))

    @torch.inference_mode()
    def encode(self, condition: Condition) -> torch.Tensor:
        """Encode a condition once a round.

        Args:
          condition: of `torch_condition`.

        Returns:
          The tokens between noise level and noisy frames, [B, num_tokens - T - 1, D].

        Raises:
          ValueError: if a shape does not fit the config.
        """
        config = self.config
        config.check_condition(condition)
        history, path, style = condition
        parts = (path[..., :2], path[..., 2:]) if config.split_path else (path,)
        tokens = [torch.mm(style, self.style)[:, None]]
        for layer, part in (*zip(self.path, parts, strict=True), (self.history, history)):
            rows = layer(part.reshape(-1, part.shape[-1]))
            tokens.append(rows.view(*part.shape[:2], -1))
        tokens = torch.cat(tokens, dim=1)
        return tokens.add_(self.code[1 : 1 + tokens.shape[1]])

    @torch.inference_mode()
    def noise_tokens(self, features: torch.Tensor) -> torch.Tensor:
        """Return the tokens of noise levels, [N, D], from what `prepare_steps` tells of them."""
        hidden = functional.silu(self.noise_first(features), inplace=True)
        return self.noise_second(hidden).add_(self.code[0])

    def denoise(self, x_scaled, noise_token, context):
        """Estimate the clean features from what is the same at every step and what is not.

        Args:
          x_scaled: noisy state, times c_in if the config scales its input, [B, T, C].
          noise_token: [1, D], or [B, D] for a level each.
          context: from `encode`.

        Returns:
          x0_hat, [B, T, C].
        """
        config = self.config
        window, channels, width = config.window, config.channels, config.latent_width
        num_tokens, batch = config.num_tokens, len(x_scaled)
        future = self.future(x_scaled.reshape(-1, channels)).view(batch, window, width)
        future = future.add_(self.code[-window:])
        noise = noise_token[:, None].expand(batch, 1, width)
        z = torch.cat([noise, context, future], dim=1).view(-1, width)
        for block in self.blocks:
            z = block(z, num_tokens)
        answered = z.view(batch, num_tokens, width)[:, -window:]
        return self.output(answered.reshape(-1, width)).view(batch, window, channels)

    @torch.inference_mode()
    def forward(self, x_noisy, sigma, context):
        """Estimate the clean features, as the JAX network is called.

        Args:
          x_noisy: variance-exploding state, [B, T, C].
          sigma: noise level, [B] or scalar, > 0.
          context: from `encode`.

        Returns:
          x0_hat, [B, T, C].

        Raises:
          ValueError: if x_noisy does not fit the config.
        """
        self.config.check_state(x_noisy)
        sigmas = np.broadcast_to(np.asarray(sigma, np.float32), len(x_noisy))
        scales, features = _told(self.config, sigmas)
        tokens = self.noise_tokens(torch.from_numpy(features))
        return self.denoise(x_noisy * torch.from_numpy(scales)[:, None, None], tokens, context)


def torch_camdm(network: CAMDM, *, products: str = "blas") -> TorchCAMDM:
    """Return CAMDM in PyTorch with a copy of a network's weights, float32, without dropout.

    Args:
      network: CAMDM of any config.
      products: of `PRODUCTS`.

    Raises:
      ValueError: for another network, unknown products, or a PyTorch without oneDNN's.
    """
    if not isinstance(network, CAMDM):
        raise ValueError(f"only CAMDM has a form in PyTorch, got a {type(network).__name__}")
    if products not in PRODUCTS:
        raise ValueError(f"unknown products {products!r}{nearest_hint(products, PRODUCTS)}")
    if products == "onednn" and not hasattr(torch.ops.mkldnn, "_linear_pointwise"):
        raise ValueError(f"PyTorch {torch.__version__} has no linear layers of oneDNN here: use products='blas'")
    return TorchCAMDM(network, products).eval()


def torch_condition(condition: Condition) -> Condition:
    """Return a condition as tensors of PyTorch, float32, contiguous."""
    copied = (np.array(part, np.float32, order="C") for part in condition)
    return Condition(*(torch.from_numpy(part) for part in copied))


def _told(config: CAMDMConfig, sigmas) -> tuple[np.ndarray, np.ndarray]:
    """Return c_in and the features of noise levels [N]: ([N], [N, D]), float32."""
    sigmas = np.asarray(sigmas, np.float32)
    scales = scaled_input(config, np.ones((len(sigmas), 1, 1), np.float32), sigmas)[:, 0, 0]
    if config.noise_levels:
        known = np.log(config.noise_levels)
        numbers = np.interp(np.log(sigmas), known, np.arange(len(known)))
        features = step_features(jnp.asarray(numbers, jnp.float32), config.latent_width)
    else:
        features = noise_features(jnp.asarray(sigmas), config.latent_width)
    return scales, np.array(features, np.float32)


class Steps(NamedTuple):
    """What a round of N steps needs to know of its noise levels, prepared once.

    Attributes:
      sampler: of `ROUND_SAMPLERS`.
      sigmas: [N + 1], float32.
      scales: c_in at each evaluation, [N], float32.
      features: what the network is told of each level, [N, D], float32.
    """

    sampler: str
    sigmas: np.ndarray
    scales: np.ndarray
    features: np.ndarray


def prepare_steps(config: CAMDMConfig, sigmas, sampler: str) -> Steps:
    """Work out what does not depend on condition, noise or weights.

    Args:
      config: of the network.
      sigmas: [N + 1], falling, from a noise schedule's `grid`.
      sampler: of `ROUND_SAMPLERS`.

    Raises:
      ValueError: for another sampler, or sigmas that make no step.
    """
    if sampler not in ROUND_SAMPLERS:
        raise ValueError(f"unknown sampler {sampler!r} outside of JAX{nearest_hint(sampler, ROUND_SAMPLERS)}")
    sigmas = np.array(sigmas, np.float32)
    if sigmas.ndim != 1 or len(sigmas) < 2:
        raise ValueError(
            f"sigmas must be [N + 1] with at least one step, got shape {sigmas.shape}; "
            "take them from a noise schedule's grid"
        )
    return Steps(sampler, sigmas, *_told(config, sigmas[:-1]))


def walk(steps: Steps, denoise: Callable, shape: tuple, draw: Callable, noise, step_noise):
    """Walk down the noise levels with arrays of any framework.

    Args:
      steps: from `prepare_steps`.
      denoise: `denoise(x_scaled, number of the step) -> x0_hat`.
      shape: of a state, [B, T, C].
      draw: `draw() -> standard normal numbers` of this shape. The step to sigma = 0 asks for none.
      noise: numbers to start from, of this shape, or None to draw them.
      step_noise: numbers for DDPM's steps, [N, B, T, C], or None to draw them.

    Returns:
      State at sigmas[-1].

    Raises:
      ValueError: for given noise of a wrong shape.
    """
    _check_shape("noise", noise, shape)
    _check_shape("step_noise", step_noise, (len(steps.scales), *shape))
    x_noisy = steps.sigmas[0] * (draw() if noise is None else noise)
    for number, scale in enumerate(steps.scales):
        sigma, sigma_next = steps.sigmas[number : number + 2]
        x0_hat = denoise(scale * x_noisy, number)
        if sigma_next == 0.0:
            x_noisy = x0_hat
        elif steps.sampler == "ddim":
            x_noisy = ddim_step(x_noisy, x0_hat, sigma, sigma_next)
        else:
            fresh = draw() if step_noise is None else step_noise[number]
            x_noisy = ddpm_step(x_noisy, x0_hat, sigma, sigma_next, fresh)
    return x_noisy


def _check_shape(name: str, given, shape: tuple) -> None:
    if given is not None and tuple(given.shape) != shape:
        raise ValueError(f"{name} must have shape {shape}, got {tuple(given.shape)}")


def _compiled(function):
    """Return a function compiled by `torch.compile`; its first call compiles or says why not."""
    fast = torch.compile(function, fullgraph=True, dynamic=False)
    known = set()

    def run(*arguments):
        shape = arguments[0].shape
        if shape in known:
            return fast(*arguments)
        try:
            # Every module and batch size is a variant of the same lines of code; eight are allowed.
            with torch._dynamo.config.patch(recompile_limit=_MAX_COMPILED):
                answer = fast(*arguments)
        except Exception as error:
            # The first line may only tell who spoke; advice on debugging comes after the second.
            told = [line for line in str(error).splitlines() if line.strip()][:2]
            raise RuntimeError(f"torch.compile does not work here: {type(error).__name__}: {' '.join(told)}") from error
        known.add(shape)
        return answer

    return run


def torch_round(
    module: TorchCAMDM, sigmas, sampler: str = "ddpm", *, compiled: bool = False, threads: int | None = None
) -> Callable[..., torch.Tensor]:
    """Make a round ready: noise, one encoding and the walk, as `generation.rounds.sample_round`.

    Args:
      module: from `torch_camdm`.
      sigmas: [N + 1], falling, from a noise schedule's `grid`.
      sampler: of `ROUND_SAMPLERS`.
      compiled: by `torch.compile`, which needs a C++ compiler. Each batch size compiles at its
        first call.
      threads: of PyTorch during a call; by default as many as there are usable cores. After a call
        PyTorch has as many as before.

    Returns:
      `run(condition, generator=None, *, noise=None, step_noise=None) -> [B, T, C]`. The condition
      is one of `torch_condition`; the generator is PyTorch's. In place of drawn numbers `noise`
      [B, T, C] starts the walk and `step_noise` [N, B, T, C] is added by DDPM's steps. It raises
      ValueError for shapes that do not fit, and RuntimeError where `torch.compile` does not work,
      with the reason.

    Raises:
      ValueError: for an unknown sampler, sigmas that make no step, less than one thread, or a
        module with products of oneDNN to be compiled: compiled code chooses its own.
    """
    if compiled and module.products != "blas":
        raise ValueError(
            f"torch.compile chooses its products itself, got a module with {module.products!r}: "
            "make one with products='blas'"
        )
    config, steps = module.config, prepare_steps(module.config, sigmas, sampler)
    features = torch.from_numpy(steps.features)
    with torch_threads(threads) as threads:
        denoise = _compiled(module.denoise) if compiled else module.denoise

    @torch.inference_mode()
    def run(condition, generator=None, *, noise=None, step_noise=None):
        shape = (len(condition.history), config.window, config.channels)
        draw = lambda: torch.randn(shape, generator=generator)
        with torch_threads(threads):
            context, tokens = module.encode(condition), module.noise_tokens(features)
            step = lambda x_scaled, number: denoise(x_scaled, tokens[number, None], context)
            return walk(steps, step, shape, draw, noise, step_noise)

    return run


def torch_matmul_probe(
    size: int = 2048, *, products: str = "blas", threads: int | None = None
) -> tuple[Callable[[], object], int]:
    """Return a product of two square matrices to time: what PyTorch can do here at best.

    Args:
      size: rows of a matrix.
      products: of `PRODUCTS`.
      threads: by default as many as there are usable cores.

    Returns:
      (function that multiplies, its operations 2 size^3).

    Raises:
      ValueError: for a size or threads below 1, or unknown products.
    """
    if size < 1:
        raise ValueError(f"size must be at least 1, got {size}")
    if products not in PRODUCTS:
        raise ValueError(f"unknown products {products!r}{nearest_hint(products, PRODUCTS)}")
    generator = torch.Generator().manual_seed(0)
    matrix = torch.randn(size, size, generator=generator)
    layer = _PackedLinear(matrix, torch.zeros(size)) if products == "onednn" else None
    with torch_threads(threads) as threads:
        pass

    @torch.inference_mode()
    def multiply():
        with torch_threads(threads):
            return torch.mm(matrix, matrix) if layer is None else layer(matrix)

    return multiply, 2 * size**3


def torch_matmul_peak(
    threads: int | None = None, size: int = 2048, *, products: str = "blas", rounds: int = 20
) -> float:
    """Measure PyTorch's own float32 matrix products, in GFLOP/s.

    Args:
      threads, size, products: as for `torch_matmul_probe`.
      rounds: how often to multiply; the median counts.

    Raises:
      ValueError: for a size, threads or rounds below 1, or unknown products.
    """
    multiply, operations = torch_matmul_probe(size, products=products, threads=threads)
    timing = take_turns({"product": multiply}, min_rounds=rounds)["product"]
    return operations / timing.median / 1e9
