"""Files of weights and training states: safetensors with a JSON header, never a pickle.

A file holds named arrays plus a JSON description. Writing goes to a temporary file that then takes
the name, so that a crash leaves the old file whole. Reading checks names, shapes and types.
"""

from __future__ import annotations

import ast
import contextlib
import functools
import hashlib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from safetensors import SafetensorError, safe_open
from safetensors.flax import save_file

from f3amd_lib.data.features import Normaliser, frame_positions
from f3amd_lib.diffusion.schedules import NoiseSchedule, schedule_from_dict
from f3amd_lib.ground.files import whole_file
from f3amd_lib.ground.names import check_known
from f3amd_lib.motion.skeleton import Skeleton
from f3amd_lib.networks.config import NetworkConfig
from f3amd_lib.networks.presets import blank_network, config_from_dict

FORMAT = "f3amd-1"


def _named_leaves(tree) -> dict:
    leaves = jax.tree_util.tree_flatten_with_path(tree)[0]
    return {jax.tree_util.keystr(path): leaf for path, leaf in leaves}


def save_tree(path: Path, tree: Any, metadata: dict) -> None:
    """Write a tree of arrays with a JSON description, atomically.

    Args:
      path: file to write; replaced as a whole if it exists.
      tree: any JAX tree of arrays.
      metadata: JSON-ready values.

    Raises:
      OSError: naming the file, if it cannot be written.
    """
    arrays = {name: jnp.asarray(leaf) for name, leaf in _named_leaves(tree).items()}
    description = json.dumps(metadata)
    checksum = _checksum(arrays, description)
    header = {"format": FORMAT, "description": description, "sha256": checksum}
    with whole_file(path, overwrite=True) as temporary:
        try:
            save_file(arrays, temporary, header)
        except SafetensorError as error:
            raise OSError(f"{path}: cannot be written ({error}); make room on the disk, then go on") from None


def _checksum(arrays: dict, description: str) -> str:
    """Return the sha256 of a description and of all arrays in the order of their names."""
    digest = hashlib.sha256(description.encode())
    for name in sorted(arrays):
        digest.update(name.encode())
        digest.update(np.asarray(arrays[name]).tobytes())
    return digest.hexdigest()


def _read(path: Path) -> tuple[dict, dict]:
    """Return (arrays, description) of a file; ValueError names a broken one."""
    path = Path(path)
    if not path.is_file():
        raise ValueError(f"{path}: no such weights file")
    try:
        # In NumPy, here and below: JAX compiles a program for every shape that it is to convert.
        with safe_open(path, framework="numpy") as file:
            header = file.metadata() or {}
            # Others' files may hold types that NumPy does not know, and need not be read at all.
            names = file.keys() if header.get("format") == FORMAT else ()
            arrays = {name: file.get_tensor(name) for name in names}
    except (SafetensorError, OSError, ValueError, TypeError, AttributeError, MemoryError) as error:
        raise ValueError(
            f"{path}: not a whole safetensors file ({error}); it was cut short or damaged, delete it or restore a copy"
        ) from None
    if header.get("format") != FORMAT:
        raise ValueError(f"{path}: not written by this project (format {repr(header.get('format'))[:60]})")
    if header.get("sha256") != _checksum(arrays, header.get("description", "")):
        raise ValueError(f"{path}: content does not match its checksum; restore a whole copy")
    with errors_name(path):
        description = json.loads(header["description"])
        if not isinstance(description, dict):
            raise ValueError("its description is not a JSON object; restore a whole copy")
    return arrays, description


def describe(path: Path) -> dict:
    """Return the description of a file written by this project; ValueError names a broken one."""
    return _read(path)[1]


def load_tree(path: Path, template: Any, *, rest: bool = False) -> tuple[Any, dict]:
    """Read a tree written by `save_tree`; the file is read and its checksum taken once.

    Args:
      path: the file.
      template: tree of arrays or shapes that says what must be there, or a function that makes one
        from the file's description, which it may refuse with a ValueError.
      rest: the tree is a dict, and the template has some of its parts; the others come as the file has them, as dicts
        of arrays in dicts.

    Returns:
      (tree, metadata).

    Raises:
      ValueError: naming the file and what is missing, misshapen or too much.
    """
    arrays, metadata = _read(path)
    if callable(template):
        with errors_name(path):
            template = template(metadata)
    if rest:
        template = _by_names(arrays) | template
    wanted = _named_leaves(template)
    if wanted.keys() != arrays.keys():
        odd = sorted(wanted.keys() ^ arrays.keys())
        raise ValueError(f"{path}: does not hold the expected arrays; first difference {odd[0]}")
    for name, leaf in wanted.items():
        if arrays[name].shape != leaf.shape:
            raise ValueError(f"{path}: {name} has shape {arrays[name].shape}, expected {leaf.shape}")
    leaves = [jax.device_put(arrays[name].astype(leaf.dtype)) for name, leaf in wanted.items()]
    return jax.tree.unflatten(jax.tree.structure(template), leaves), metadata


def _by_names(arrays: dict) -> dict:
    """Return arrays as dicts in dicts, of names such as "['axes']['mean']"."""
    tree = {}
    for name, array in arrays.items():
        place, keys, node = tree, [], ast.parse(f"_{name}", mode="eval").body
        while not isinstance(node, ast.Name):
            keys.append(node.attr if isinstance(node, ast.Attribute) else node.slice.value)
            node = node.value
        for key in keys[:0:-1]:
            place = place.setdefault(key, {})
        place[keys[0]] = array
    return tree


def file_kind(path) -> str | None:
    """Return what a weights file says that it holds, such as "trained model"; ValueError if it cannot be read."""
    return _read(Path(path))[1].get("kind")


def weights_digest(params: Any) -> str:
    """Return 12 hex digits that tell one set of weights from another."""
    return _checksum(_named_leaves(params), "")[:12]


@contextlib.contextmanager
def errors_name(path: Path):
    """Let whatever goes wrong inside, reading a file's description, be an error that names it."""
    try:
        yield
    except (LookupError, TypeError, AttributeError, RecursionError, ArithmeticError, MemoryError) as error:
        raise ValueError(f"{path}: description lacks or garbles {error}; restore a whole copy") from None
    except ValueError as error:
        text = str(error)
        raise ValueError(text if text.startswith(str(path)) else f"{path}: {text}") from None


def check_kind(metadata: dict, kind: str) -> None:
    """Raise a ValueError where a file's description is of another kind."""
    if metadata.get("kind") != kind:
        raise ValueError(f"holds a {metadata.get('kind')}, not a {kind}")


def describe_skeleton(skeleton: Skeleton) -> dict:
    """Return a skeleton's names and tree as JSON-ready values; offsets go with the arrays."""
    return {
        "joints": list(skeleton.names),
        "parents": list(skeleton.parents),
        "end_sites": [[joint, list(offset)] for joint, offset in skeleton.end_sites],
    }


def described_skeleton(metadata: dict, offsets) -> Skeleton:
    """Return the skeleton that `describe_skeleton` described, with its offsets [J, 3]."""
    end_sites = tuple((joint, tuple(offset)) for joint, offset in metadata["end_sites"])
    return Skeleton(tuple(metadata["joints"]), tuple(metadata["parents"]), np.asarray(offsets, np.float64), end_sites)


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


def weights_shapes(config: NetworkConfig) -> Any:
    """Return the shapes of a network's weights."""
    return blank_network(config)[1]


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
    with errors_name(path):
        tree, metadata = load_tree(path, _model_template)
        return TrainedModel(
            name=metadata["name"], config=config_from_dict(metadata["model"]), params=unpacked_weights(tree["params"]),
            normaliser=Normaliser(**tree["normaliser"]), skeleton=described_skeleton(metadata, tree["offsets"]),
            styles=tuple(metadata["styles"]), diffusion=schedule_from_dict(metadata["diffusion"]),
            start_poses={name: np.asarray(poses) for name, poses in tree["seeds"].items()}, record=metadata["record"],
        )  # fmt: skip


def _model_template(metadata: dict) -> dict:
    """Return the shapes that a trained model's description speaks of."""
    check_kind(metadata, "trained model")
    single = jax.ShapeDtypeStruct
    config = config_from_dict(metadata["model"])
    return {
        "params": packed_shapes(weights_shapes(config), metadata.get("weights")),
        "normaliser": dict.fromkeys(("mean", "deviation"), single((config.channels,), jnp.float32))
        | {"path_scale": single((), jnp.float32)},
        "seeds": {name: single(tuple(shape), jnp.float32) for name, shape in metadata["seed_shapes"].items()},
        "offsets": single((len(metadata["joints"]), 3), jnp.float32),
    }
