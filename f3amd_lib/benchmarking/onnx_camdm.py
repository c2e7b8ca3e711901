"""CAMDM as ONNX, run by ONNX Runtime: a second baseline of the speed benchmarks.

The graph is written operator by operator from the weights (ONNX's own, of opset 23), so that no
exporter stands between the network and the runtime: attention, GELU and layer normalisation are one
operator each, which on a Xeon was faster than ONNX Runtime's own fused operators
(MultiHeadAttention, SkipLayerNormalization, BiasGelu). The packages are part of the extra "bench".
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from f3amd_lib.benchmarking.torch_camdm import prepare_steps, usable_cores, walk
from f3amd_lib.networks.attention import position_code
from f3amd_lib.networks.camdm import CAMDM, POSITION_BASE
from f3amd_lib.networks.conditioning import PATH_CHANNELS

try:
    import onnx
    import onnxruntime
    from onnx import helper, numpy_helper
except ImportError as error:
    raise ImportError(
        "the baseline in ONNX Runtime needs onnx and onnxruntime: make bench-tools, or "
        'pip install "f3amd_lib[bench]" '
        f"(importing them said: {error})"
    ) from error

_OPSET, _IR_VERSION = 23, 11  # the first with Attention, and the file version that goes with it
_BATCH = "characters"


class _Graph:
    """An ONNX graph that grows node by node."""

    def __init__(self, name: str, inputs: dict[str, tuple[int, ...]]):
        self.name, self.nodes, self.constants = name, [], []
        self.inputs = [self._value(key, shape) for key, shape in inputs.items()]

    @staticmethod
    def _value(name: str, shape: tuple[int, ...]):
        return helper.make_tensor_value_info(name, onnx.TensorProto.FLOAT, (_BATCH, *shape))

    def constant(self, array, dtype=np.float32) -> str:
        name = f"constant_{len(self.constants)}"
        self.constants.append(numpy_helper.from_array(np.array(array, dtype, order="C"), name))
        return name

    def node(self, operator: str, *inputs: str, **attributes) -> str:
        name = f"{operator}_{len(self.nodes)}"
        self.nodes.append(helper.make_node(operator, inputs, [name], **attributes))
        return name

    def reshape(self, value: str, *shape: int) -> str:
        return self.node("Reshape", value, self.constant(shape, np.int64))

    def last(self, value: str, axis: int, first: int, end: int) -> str:
        """Return a slice first : end of one axis."""
        bounds = (self.constant([number], np.int64) for number in (first, end, axis))
        return self.node("Slice", value, *bounds)

    def linear(self, layer, rows: str) -> str:
        """Return a linear layer of rows [M, K]."""
        kernel = self.constant(layer.kernel[...])
        return self.node("Gemm", rows, kernel, self.constant(layer.bias[...]))

    def layer_norm(self, layer, rows: str) -> str:
        scale, bias = self.constant(layer.scale[...]), self.constant(layer.bias[...])
        return self.node("LayerNormalization", rows, scale, bias, axis=-1, epsilon=1e-5)

    def model(self, output: str, shape: tuple[int, ...]) -> onnx.ModelProto:
        """Return the checked model with one output."""
        self.nodes.append(helper.make_node("Identity", [output], ["output"]))
        graph = helper.make_graph(self.nodes, self.name, self.inputs, [self._value("output", shape)], self.constants)
        opsets = [helper.make_opsetid("", _OPSET)]
        model = helper.make_model(graph, opset_imports=opsets, ir_version=_IR_VERSION)
        onnx.checker.check_model(model)
        return model


def _code(config) -> np.ndarray:
    return position_code(0, config.num_tokens, config.latent_width, base=POSITION_BASE)


def _checked(network) -> CAMDM:
    if not isinstance(network, CAMDM):
        raise ValueError(f"only CAMDM has an ONNX form, got a {type(network).__name__}")
    return network


def onnx_encoder(network: CAMDM) -> onnx.ModelProto:
    """Return `network.encode` as ONNX: history, path, style -> output, the condition's tokens.

    Args:
      network: CAMDM of any config; the weights are copied.

    Raises:
      ValueError: for another network.
    """
    config = _checked(network).config
    width = config.latent_width
    graph = _Graph(
        "encoder",
        {
            "history": (config.num_history, config.channels),
            "path": (config.window, PATH_CHANNELS),
            "style": (config.num_styles,),
        },
    )
    style = graph.node("MatMul", "style", graph.constant(network.style.kernel[...]))
    tokens = [graph.reshape(style, -1, 1, width)]

    def add(layer, value: str, frames: int, channels: int):
        rows = graph.linear(layer, graph.reshape(value, -1, channels))
        tokens.append(graph.reshape(rows, -1, frames, width))

    first = 0
    for layer in network.path:
        channels = layer.kernel[...].shape[0]
        part = graph.last("path", 2, first, first + channels)
        add(layer, part, config.window, channels)
        first += channels
    add(network.history, "history", config.num_history, config.channels)
    number = config.num_tokens - config.window - 1
    joined = graph.node("Concat", *tokens, axis=1)
    coded = graph.node("Add", joined, graph.constant(_code(config)[1 : 1 + number]))
    return graph.model(coded, (number, width))


def onnx_denoiser(network: CAMDM) -> onnx.ModelProto:
    """Return one evaluation as ONNX: x_scaled, features, context -> output, x0_hat.

    `x_scaled` [B, T, C] is the noisy state times c_in, `features` [B, D] is what
    `torch_camdm.prepare_steps` tells of the level, and `context` comes from the encoder.

    Args:
      network: CAMDM of any config; the weights are copied.

    Raises:
      ValueError: for another network.
    """
    config = _checked(network).config
    window, channels, width = config.window, config.channels, config.latent_width
    tokens, code = config.num_tokens, _code(config)
    graph = _Graph(
        "denoiser", {"x_scaled": (window, channels), "features": (width,), "context": (tokens - window - 1, width)}
    )
    hidden = graph.linear(network.noise_first, "features")
    hidden = graph.node("Mul", hidden, graph.node("Sigmoid", hidden))
    noise = graph.linear(network.noise_second, hidden)
    noise = graph.node("Add", graph.reshape(noise, -1, 1, width), graph.constant(code[:1]))
    future = graph.linear(network.future, graph.reshape("x_scaled", -1, channels))
    future = graph.reshape(future, -1, window, width)
    future = graph.node("Add", future, graph.constant(code[-window:]))
    z = graph.reshape(graph.node("Concat", noise, "context", future, axis=1), -1, width)
    for block in network.blocks:
        attention = block.attention
        asked = [
            graph.reshape(graph.linear(layer, z), -1, tokens, width)
            for layer in (attention.query, attention.key, attention.value)
        ]
        heads = attention.num_heads
        answer = graph.node("Attention", *asked, q_num_heads=heads, kv_num_heads=heads)
        answer = graph.linear(attention.output, graph.reshape(answer, -1, width))
        z = graph.layer_norm(block.attention_norm, graph.node("Add", z, answer))
        hidden = graph.node("Gelu", graph.linear(block.hidden, z))
        z = graph.node("Add", z, graph.linear(block.output, hidden))
        z = graph.layer_norm(block.output_norm, z)
    answered = graph.last(graph.reshape(z, -1, tokens, width), 1, tokens - window, tokens)
    x0_hat = graph.linear(network.output, graph.reshape(answered, -1, width))
    return graph.model(graph.reshape(x0_hat, -1, window, channels), (window, channels))


def _session(model: onnx.ModelProto, threads: int) -> onnxruntime.InferenceSession:
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads, options.inter_op_num_threads = threads, 1
    options.log_severity_level = 3
    return onnxruntime.InferenceSession(model.SerializeToString(), options, providers=["CPUExecutionProvider"])


def onnx_round(
    network: CAMDM, sigmas, sampler: str = "ddpm", *, threads: int | None = None
) -> Callable[..., np.ndarray]:
    """Make a round ready: noise, one encoding and the walk, as `generation.rounds.sample_round`.

    Args:
      network: CAMDM of any config.
      sigmas: [N + 1], falling, from a noise schedule's `grid`.
      sampler: of `torch_camdm.ROUND_SAMPLERS`.
      threads: of ONNX Runtime; by default as many as there are usable cores.

    Returns:
      `run(condition, generator=None, *, noise=None, step_noise=None) -> [B, T, C]`, all numpy and
      float32, for any number of characters. The generator is numpy's; without one numbers are drawn
      anew. In place of drawn numbers `noise` [B, T, C] starts the walk and `step_noise`
      [N, B, T, C] is added by DDPM's steps. It raises ValueError for shapes that do not fit.

    Raises:
      ValueError: for another network, an unknown sampler, sigmas that make no step, or less than
        one thread.
    """
    threads = usable_cores() if threads is None else threads
    if threads < 1:
        raise ValueError(f"ONNX Runtime needs at least 1 thread, got threads={threads}")
    config = _checked(network).config
    steps = prepare_steps(config, sigmas, sampler)
    # One thread will do for so little, and a second pool of threads would wait in the way.
    encoder = _session(onnx_encoder(network), 1)
    denoiser = _session(onnx_denoiser(network), threads)

    def run(condition, generator=None, *, noise=None, step_noise=None):
        config.check_condition(condition)
        shape = (len(condition.history), config.window, config.channels)
        generator = np.random.default_rng(generator)
        draw = lambda: generator.standard_normal(shape, np.float32)
        (context,) = encoder.run(None, condition._asdict())
        rows = np.repeat(steps.features[:, None], shape[0], axis=1)

        def denoise(x_scaled, number: int):
            fed = {"x_scaled": x_scaled, "features": rows[number], "context": context}
            return denoiser.run(None, fed)[0]

        return walk(steps, denoise, shape, draw, noise, step_noise)

    return run
