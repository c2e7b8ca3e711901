"""CAMDM in PyTorch, with the weights of ours: the baseline of the speed benchmarks.

The network is `networks.camdm` once more, in float32, as fast as we could make it on a CPU: one
product for query, key and value, kernels stored as the products want them, attention by
`scaled_dot_product_attention`, residuals and biases added in place, noise tokens of all steps made
at once. On a Xeon it was at least as fast as `nn.TransformerEncoderLayer` on its fast path, as
`functional.linear`, and as attention written in batched products. It computes all that the JAX form
computes. PyTorch is part of the extra "bench"; nothing else in the library needs it.
"""

from collections.abc import Callable

import jax.numpy as jnp
import numpy as np

from f3amd_companion.speed.machine import usable_cores
from f3amd_lib.diffusion.samplers import ddim_step, ddpm_step
from f3amd_lib.ground.names import check_known
from f3amd_lib.networks.attention import position_code, sinusoids
from f3amd_lib.networks.camdm import CAMDM, POSITION_BASE, CAMDMConfig
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

_LAYER_NORM_EPSILON = 1e-5
_MAX_COMPILED = 64
_OPSET = 23  # the first with attention as one operator


def _tensor(parameter) -> torch.Tensor:
    """Copy a parameter of the JAX network."""
    return torch.from_numpy(np.array(parameter[...], np.float32))


class _Linear(nn.Module):
    """Linear layer on rows [M, K]: the kernel is [K, N], so that nothing is transposed."""

    def __init__(self, kernel: torch.Tensor, bias: torch.Tensor):
        super().__init__()
        self.kernel, self.bias = nn.Parameter(kernel.contiguous()), nn.Parameter(bias)

    def forward(self, rows):
        return torch.mm(rows, self.kernel).add_(self.bias)

    def gelu(self, rows):
        """Return the exact GELU of the layer's answer."""
        return torch.ops.aten.gelu_(self(rows))

    def added_to(self, residual, rows):
        """Return residual + the layer's answer; `residual` [M, N] is overwritten."""
        return residual.addmm_(rows, self.kernel).add_(self.bias)


def _rows_layer(*layers) -> _Linear:
    """Return JAX's linear layers side by side as one in PyTorch."""
    kernels, biases = zip(*((_tensor(layer.kernel), _tensor(layer.bias)) for layer in layers), strict=True)
    return _Linear(torch.cat(kernels, dim=1), torch.cat(biases))


def _layer_norm(layer) -> nn.LayerNorm:
    norm = nn.LayerNorm(layer.scale.shape, eps=_LAYER_NORM_EPSILON)
    norm.load_state_dict({"weight": _tensor(layer.scale), "bias": _tensor(layer.bias)})
    return norm


class _Block(nn.Module):
    """Encoder block (`networks.attention.TransformerBlock`) on the rows of all characters."""

    def __init__(self, block):
        super().__init__()
        attention = block.attention
        self.num_heads = attention.num_heads
        self.query_key_value = _rows_layer(attention.query, attention.key, attention.value)
        self.attention_output = _rows_layer(attention.output)
        self.attention_norm = _layer_norm(block.attention_norm)
        self.hidden, self.output = _rows_layer(block.hidden), _rows_layer(block.output)
        self.output_norm = _layer_norm(block.output_norm)

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
    """CAMDM in PyTorch: `encode` once a round, then a call at each step (see `torch_camdm`).

    Attributes:
      config: of the JAX network.
    """

    def __init__(self, network: CAMDM):
        super().__init__()
        self.config = config = network.config
        for name in ("noise_first", "noise_second", "history", "future", "output"):
            setattr(self, name, _rows_layer(getattr(network, name)))
        self.style = nn.Parameter(_tensor(network.style.kernel))
        self.path = nn.ModuleList(map(_rows_layer, network.path))
        self.blocks = nn.ModuleList(map(_Block, network.blocks))
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
            tokens.append(layer(part.reshape(-1, part.shape[-1])).view(*part.shape[:2], -1))
        tokens = torch.cat(tokens, dim=1)
        return tokens.add_(self.code[1 : 1 + tokens.shape[1]])

    @torch.inference_mode()
    def noise_tokens(self, features: torch.Tensor) -> torch.Tensor:
        """Return the tokens of noise levels, [N, D], from their features."""
        return self.noise_second(functional.silu(self.noise_first(features), inplace=True)).add_(self.code[0])

    def forward(self, x_scaled, noise_token, context):
        """Estimate the clean features from what is the same at every step and what is not.

        Args:
          x_scaled: noisy state, times c_in if the config scales its input, [B, T, C].
          noise_token: [1, D], or [B, D] for a level each.
          context: from `encode`.

        Returns:
          x0_hat, [B, T, C].
        """
        batch, window, channels = x_scaled.shape
        num_tokens, width = self.code.shape
        future = self.future(x_scaled.reshape(-1, channels)).view(batch, window, width)
        future = future.add_(self.code[-window:])
        z = torch.cat([noise_token[:, None].expand(batch, 1, width), context, future], dim=1).view(-1, width)
        for block in self.blocks:
            z = block(z, num_tokens)
        answered = z.view(batch, num_tokens, width)[:, -window:]
        return self.output(answered.reshape(-1, width)).view(batch, window, channels)


def torch_camdm(network: CAMDM, *, device: str = "cpu", tf32: bool = False) -> TorchCAMDM:
    """Return CAMDM in PyTorch with a copy of a network's weights, float32, without dropout.

    PyTorch gets as many threads as there are usable cores.

    Args:
      network: CAMDM of any config.
      device: "cpu" or "cuda".
      tf32: whether matrix products on a GPU may have mantissas of 10 bits, as JAX has them there.

    Raises:
      RuntimeError: where PyTorch sees no GPU.
      ValueError: for another network.
    """
    if not isinstance(network, CAMDM):
        raise ValueError(f"only CAMDM has a form in PyTorch, got a {type(network).__name__}")
    torch.set_num_threads(usable_cores())
    torch.set_float32_matmul_precision("high" if tf32 else "highest")
    return TorchCAMDM(network).eval().requires_grad_(False).to(device)


def torch_condition(condition: Condition, device: str = "cpu") -> Condition:
    """Return a condition as tensors of PyTorch, float32, contiguous."""
    return Condition(*(torch.from_numpy(np.array(part, np.float32, order="C")).to(device) for part in condition))


def tell_levels(config: CAMDMConfig, sigmas) -> tuple[np.ndarray, np.ndarray]:
    """Return c_in and the features of noise levels [N]: ([N], [N, D]), float32."""
    sigmas = np.asarray(sigmas, np.float32)
    scales = scaled_input(config, np.ones((len(sigmas), 1, 1), np.float32), sigmas)[:, 0, 0]
    if config.noise_levels:
        known = np.log(config.noise_levels)
        numbers = np.interp(np.log(sigmas), known, np.arange(len(known)))
        features = sinusoids(jnp.asarray(numbers, jnp.float32), config.latent_width, POSITION_BASE)
    else:
        features = noise_features(jnp.asarray(sigmas), config.latent_width)
    return scales, np.array(features, np.float32)


def _compiled(module: TorchCAMDM) -> Callable:
    # Every module and batch size is a variant of the same lines of code; eight are allowed.
    torch._dynamo.config.recompile_limit = _MAX_COMPILED
    return torch.compile(module.forward, fullgraph=True, dynamic=False)


def _in_onnx(module: TorchCAMDM) -> Callable:
    """Return the denoiser run by ONNX Runtime; PyTorch exports it at the first call of each batch size."""
    import onnxruntime

    class Denoiser(nn.Module):  # which has no parameters of its own: the program holds the weights as constants
        def forward(self, x_scaled, noise_token, context):
            return module(x_scaled, noise_token, context)

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads, options.log_severity_level = usable_cores(), 3
    names, sessions = ["x_scaled", "noise_token", "context"], {}

    def denoise(*given):
        shapes = tuple(array.shape for array in given)
        if shapes not in sessions:
            with torch.inference_mode(False):
                like = tuple(torch.zeros(shape) for shape in shapes)
                program = torch.onnx.export(
                    Denoiser().eval(), like, input_names=names, opset_version=_OPSET, verbose=False
                )
            model = program.model_proto.SerializeToString()
            sessions[shapes] = onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])
        fed = {name: array.numpy() for name, array in zip(names, given, strict=True)}
        return torch.from_numpy(sessions[shapes].run(None, fed)[0])

    return denoise


RUNTIMES = {"eager": lambda module: module.forward, "compiled": _compiled, "onnx": _in_onnx}
"""Name -> function that makes a module's denoiser ready."""


def torch_round(
    module: TorchCAMDM, sigmas, sampler: str = "ddpm", *, runtime: str = "eager"
) -> Callable[..., torch.Tensor]:
    """Make a round ready: noise, one encoding and the walk, as `rollout.rounds.sample_round`.

    Args:
      module: from `torch_camdm`.
      sigmas: [N + 1], falling, from a noise schedule's `grid`.
      sampler: "ddim" or "ddpm".
      runtime: of the denoiser: "eager"; "compiled" by `torch.compile`, which needs a C++ compiler
        and compiles at the first call of each batch size; "onnx", exported to ONNX and run by ONNX
        Runtime, while the condition is encoded by PyTorch.

    Returns:
      `run(condition, generator=None, *, noise=None, step_noise=None) -> [B, T, C]`. The condition
      is one of `torch_condition`; the generator is PyTorch's. In place of drawn numbers `noise`
      [B, T, C] starts the walk and `step_noise` [N, B, T, C] is added by DDPM's steps. It waits for a GPU. It raises
      ValueError for a condition that does not fit, and RuntimeError where `torch.compile` does not work.

    Raises:
      ImportError: if ONNX Runtime is asked for and not installed.
      ValueError: for an unknown sampler or runtime.
    """
    for given, known, what in ((sampler, ("ddim", "ddpm"), "sampler"), (runtime, RUNTIMES, "runtime")):
        check_known(given, known, f"PyTorch {what}")
    config, device, sigmas = module.config, module.code.device, np.array(sigmas, np.float32)
    scales, features = tell_levels(config, sigmas[:-1])
    denoise = RUNTIMES[runtime](module)

    @torch.inference_mode()
    def run(condition, generator=None, *, noise=None, step_noise=None):
        shape = (len(condition.history), config.window, config.channels)
        draw = lambda: torch.randn(shape, generator=generator, device=device)
        context, tokens = module.encode(condition), module.noise_tokens(torch.from_numpy(features).to(device))
        x_noisy = sigmas[0] * (draw() if noise is None else noise)
        for number, scale in enumerate(scales):
            sigma, sigma_next = sigmas[number : number + 2]
            x0_hat = denoise(scale * x_noisy, tokens[number, None], context)
            if sigma_next == 0.0:
                x_noisy = x0_hat
            elif sampler == "ddim":
                x_noisy = ddim_step(x_noisy, x0_hat, sigma, sigma_next)
            else:
                fresh = draw() if step_noise is None else step_noise[number]
                x_noisy = ddpm_step(x_noisy, x0_hat, sigma, sigma_next, fresh)
        if device.type == "cuda":
            torch.cuda.synchronize()
        return x_noisy

    return run


def torch_matmul_probe(device: str = "cpu", size: int | None = None) -> tuple[Callable[[], object], int]:
    """Return a product of two square matrices to time, by BLAS: what PyTorch can do here at best.

    Args:
      device: "cpu" or "cuda".
      size: rows of a matrix; by default what fills the device.

    Returns:
      (function that multiplies and waits, its operations 2 size^3).
    """
    torch.set_num_threads(usable_cores())
    size = size or (2048 if device == "cpu" else 8192)
    matrix = torch.randn(size, size, generator=torch.Generator().manual_seed(0)).to(device)

    def multiply():
        product = torch.mm(matrix, matrix)
        if device == "cuda":
            torch.cuda.synchronize()
        return product

    return multiply, 2 * size**3
