"""Trained models as files: weights and all that is needed to use them, in the form of `ground.trees`."""

import functools
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from f3amd_lib.data.features import Normaliser, frame_positions
from f3amd_lib.diffusion.schedules import NoiseSchedule, schedule_from_dict
from f3amd_lib.ground.names import check_known
from f3amd_lib.ground.trees import check_kind, errors_name, load_tree, save_tree
from f3amd_lib.motion.skeleton import Skeleton, describe_skeleton, described_skeleton
from f3amd_lib.networks.config import NetworkConfig
from f3amd_lib.networks.presets import blank_network, config_from_dict


def network_with(config: NetworkConfig, params) -> nnx.Module:
    """Return a network with the given weights."""
    # A fresh tree, so that editing the network leaves the given weights alone.
    return nnx.merge(blank_network(config)[0], jax.tree.map(lambda leaf: leaf, params))


@dataclass(frozen=True)
class TrainedModel:
    """A network ready to use: weights and all it needs to turn a path and a style into motion.

    Attributes:
      name: preset.
      config: of the network.
      params: weights (the moving average).
      normaliser: of its features.
      skeleton: of the data it was trained on.
      styles: names, in the order of the one-hot vector.
      diffusion: the noise schedule it was trained with.
      start_poses: per style name, histories to start from as world frames, [K, H, C], metres and 6D; K may differ.
      record: how it was trained, on what, under what terms.
    """

    name: str
    config: NetworkConfig
    params: Any
    normaliser: Normaliser
    skeleton: Skeleton
    styles: tuple[str, ...]
    diffusion: NoiseSchedule
    start_poses: dict
    record: dict

    @property
    def windows_seen(self) -> int:
        """Windows that the weights were trained on, over all legs of a training and up to its snapshot."""
        recipe = self.record["training"]
        return self.record.get("windows_seen", recipe["num_steps"] * recipe["batch_size"])

    def network(self):
        """Return the network with its weights."""
        return network_with(self.config, self.params)

    @functools.cached_property
    def _compiled(self):
        network = self.network()
        return jax.jit(network.encode), jax.jit(lambda context, x_noisy, sigma: network(x_noisy, sigma, context))

    def denoiser(self, condition):
        """Return `denoise(x_noisy, sigma) -> x0_hat` under a normalised condition of B rows; compiled once for each B.

        Both sides are [B, T, C] in network units; sigma is a scalar.
        """
        encode, denoise = self._compiled
        context = encode(condition)
        return lambda x_noisy, sigma: denoise(context, x_noisy, jnp.asarray(sigma, x_noisy.dtype))

    def joint_positions(self, x0_hat) -> np.ndarray:
        """Return the joints [..., J, 3], metres, of features [..., C] in network units; nothing is compiled."""
        return frame_positions(self.skeleton, np.asarray(self.normaliser.denormalise(x0_hat)))

    def style_index(self, style: str) -> int:
        """Return a style's place in the one-hot vector; ValueError lists the styles."""
        check_known(style, self.styles, "style")
        return self.styles.index(style)


EIGHT_BITS_FROM = 4096
"""Size from which an array of weights is written in 8 bits, where that is asked for."""


def _in_eight_bits(leaf) -> dict | jax.Array:
    """Return a large matrix, or several, in 8 bits with a scale for each column."""
    if leaf.size < EIGHT_BITS_FROM or leaf.ndim < 2:
        return leaf.astype(jnp.bfloat16)
    largest = jnp.max(jnp.abs(leaf), axis=-2, keepdims=True)
    scale = jnp.where(largest > 0, largest, 1.0).astype(jnp.float32) / 127.0
    scale = scale.astype(jnp.float16).astype(jnp.float32)  # used as it is kept
    eight_bits = jnp.clip(jnp.round(leaf / scale), -127, 127).astype(jnp.int8)
    return {"eight_bits": eight_bits, "scale": scale.astype(jnp.float16)}


def packed_weights(params: Any, dtype) -> Any:
    """Return weights as files keep them: in a type, or in 8 bits with scales (`jnp.int8`)."""
    eight = jnp.dtype(dtype) == jnp.int8
    return jax.tree.map(_in_eight_bits if eight else lambda leaf: leaf.astype(dtype), params)


def packed_shapes(shapes: Any, weights: str | None) -> Any:
    """Return the shapes that `packed_weights` leaves in a file, of a type's name."""
    if weights != "int8":
        return shapes
    packed = jax.eval_shape(lambda tree: jax.tree.map(_in_eight_bits, tree), shapes)
    # Scales of earlier files have single precision; both are read as what they are.
    return jax.tree.map(
        lambda leaf: jax.ShapeDtypeStruct(leaf.shape, jnp.float32) if leaf.dtype == jnp.float16 else leaf, packed
    )


def unpacked_weights(packed: Any) -> Any:
    """Return the weights that `packed_weights` packed."""
    in_eight_bits = lambda leaf: isinstance(leaf, dict) and "eight_bits" in leaf
    whole = lambda leaf: np.asarray(leaf["eight_bits"], np.float32) * np.asarray(leaf["scale"], np.float32)
    return jax.tree.map(
        lambda leaf: jax.device_put(whole(leaf)) if in_eight_bits(leaf) else leaf, packed, is_leaf=in_eight_bits
    )


def save_model(path: Path, trained: TrainedModel, dtype=jnp.bfloat16) -> None:
    """Write a trained model.

    Args:
      path: file to write.
      trained: the model.
      dtype: of the weights; all else is written exactly. `jnp.int8` halves the file once more:
        large matrices become whole numbers times a scale for each column, off by at most 1/254 of
        the column's largest weight.
    """
    # Half precision places a joint to half a millimetre: enough for a pose to start from.
    poses = jnp.float16 if jnp.dtype(dtype) == jnp.int8 else jnp.float32
    tree = {
        "params": packed_weights(trained.params, dtype),
        "normaliser": trained.normaliser._asdict(),
        "seeds": {name: jnp.asarray(frames, poses) for name, frames in trained.start_poses.items()},
        "offsets": jnp.asarray(trained.skeleton.offsets, jnp.float32),
    }
    metadata = {
        "kind": "trained model", "name": trained.name, "model": trained.config.to_dict(),
        "weights": jnp.dtype(dtype).name, "styles": list(trained.styles), "diffusion": trained.diffusion.to_dict(),
        **describe_skeleton(trained.skeleton),
        "seed_shapes": {name: list(np.shape(poses)) for name, poses in trained.start_poses.items()},
        "record": trained.record,
    }  # fmt: skip
    save_tree(path, tree, metadata)


def load_model(path: Path) -> TrainedModel:
    """Read a model written by `save_model`.

    Raises:
      ValueError: naming the file, if it is missing, truncated, damaged or of another kind.
    """

    def shapes(metadata: dict) -> dict:
        check_kind(metadata, "trained model")
        weights = blank_network(config_from_dict(metadata["model"]))[1]
        return {"params": packed_shapes(weights, metadata.get("weights"))}

    with errors_name(path):
        tree, metadata = load_tree(path, shapes, rest=True)
        return TrainedModel(
            name=metadata["name"], config=config_from_dict(metadata["model"]), params=unpacked_weights(tree["params"]),
            normaliser=Normaliser(**tree["normaliser"]), skeleton=described_skeleton(metadata, tree["offsets"]),
            styles=tuple(metadata["styles"]), diffusion=schedule_from_dict(metadata["diffusion"]),
            start_poses={name: np.asarray(poses, np.float32) for name, poses in tree.get("seeds", {}).items()},
            record=metadata["record"],
        )  # fmt: skip
