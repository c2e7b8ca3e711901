"""The weights that CAMDM's authors published, as a model of ours (claim Q17).

Their release holds the network twice: as an ONNX graph, which we do not read, and as a PyTorch
checkpoint, which is a pickle and is opened by nobody here. `docs/training.md` shows how PyTorch
itself, told to read weights only, writes the arrays into a safetensors file; this module reads that.
Names, shapes and conventions are those of the released code (AIGAnimation/CAMDM, network/models.py).
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from safetensors.numpy import load_file

from f3amd_lib.data.features import num_channels, split_frames
from f3amd_lib.data.packed import PackedMotion
from f3amd_lib.data.windows import starting_poses
from f3amd_lib.ground.papers import load_paper_file
from f3amd_lib.motion.rotations import matrix_from_rotation_6d, rotation_6d_from_matrix
from f3amd_lib.networks import presets
from f3amd_lib.networks.camdm import CAMDM, CAMDMConfig
from f3amd_lib.training.checkpoints import TrainedModel

NAME = "CAMDM published"
"""Of the row in tables; no preset of ours."""

WINDOW, NUM_HISTORY = 45, 10
"""Future and past frames of the release; no array tells them."""

_UNUSED = re.compile(r"(.*\.)?(pe|style_feature_process\.(weight|bias))")
"""A table of sinusoids, which is computed here, and a layer that the released forward pass never calls."""

_NAMES = load_paper_file("camdm_release")
_ROLES = ("query", "key", "value")


class PublishedFeatures:
    """Our frames as the released network has them, and back; in the place of a `Normaliser`.

    A frame is six numbers a joint, the first two rows of its rotation, then the root's position and
    three zeros: 6 (J + 1) channels, in metres, not normalised.
    """

    def normalise(self, frames):
        """Map frames [..., 6 J + 3] to the released channels, [..., 6 (J + 1)]."""
        root, rotations = split_frames(frames)
        rows = matrix_from_rotation_6d(rotations)[..., :2, :].reshape(*frames.shape[:-1], -1)
        return jnp.concatenate([rows, root, jnp.zeros_like(root)], axis=-1)

    def denormalise(self, x):
        """Map released channels back to frames, [..., 6 J + 3]; the three padding numbers are dropped."""
        rows = x[..., :-6].reshape(*x.shape[:-1], -1, 6)
        rotations = rotation_6d_from_matrix(jnp.swapaxes(matrix_from_rotation_6d(rows), -1, -2))
        return jnp.concatenate([x[..., -6:-3], rotations.reshape(*x.shape[:-1], -1)], axis=-1)

    def normalise_path(self, path):
        """Map a path condition [..., 8] to displacement and the first two rows of the facing."""
        rows = matrix_from_rotation_6d(path[..., 2:])[..., :2, :].reshape(*path.shape[:-1], 6)
        return jnp.concatenate([path[..., :2], rows], axis=-1)


def published_arrays(path) -> dict[str, np.ndarray]:
    """Read the arrays of a checkpoint that was converted to safetensors.

    Raises:
      ValueError: naming the file, if it is missing, damaged or of another kind, such as the pickle itself.
    """
    path = Path(path)
    if path.suffix != ".safetensors":
        raise ValueError(
            f"{path}: a PyTorch checkpoint is a pickle, which may run code and is not opened here: "
            "write its arrays to a .safetensors file first, as docs/training.md shows"
        )
    try:
        return load_file(path)
    except Exception as error:  # what damaged bytes raise is no closed list
        raise ValueError(f"{path}: not a whole file of arrays ({error}); convert the checkpoint again") from error


def published_network(arrays: Mapping[str, np.ndarray], where: str = NAME) -> CAMDM:
    """Return the released network: 4 noise levels, window 45, 10 frames of history.

    Args:
      arrays: of its state dict, by name.
      where: the file, for messages.

    Raises:
      ValueError: for an array that is missing, unknown or of another shape.
    """
    left = {name: array for name, array in arrays.items() if not _UNUSED.fullmatch(name)}

    def take(name: str) -> np.ndarray:
        if name not in left:
            raise ValueError(f"{where}: has no array {name!r}; is it the released Transformer encoder?")
        return np.asarray(left.pop(name), np.float32)

    flat: dict[str, np.ndarray] = {"style.kernel": take("embed_style.action_embedding")}

    def layers(names: Mapping[str, str], mine: str = "", block: str = "", weight: str = "kernel") -> None:
        for ours, theirs in names.items():
            flat[f"{mine}{ours}.{weight}"] = take(f"{block}{theirs}.weight").T
            flat[f"{mine}{ours}.bias"] = take(f"{block}{theirs}.bias")

    layers(_NAMES["linear"])
    depth = max(1, len({name.split(".")[2] for name in left if name.startswith("seqEncoder.layers.")}))
    for number in range(depth):
        mine, block = f"blocks.{number}.", f"seqEncoder.layers.{number}."
        layers(_NAMES["in_block"], mine, block)
        layers(_NAMES["norms"], mine, block, "scale")
        # Query, key and value lie in one array, one below the other.
        for ours, theirs in (("kernel", "weight"), ("bias", "bias")):
            parts = np.split(take(f"{block}self_attn.in_proj_{theirs}"), 3)
            flat |= {f"{mine}attention.{role}.{ours}": part.T for role, part in zip(_ROLES, parts, strict=True)}
    if left:
        raise ValueError(f"{where}: has an array {min(left)!r} that the released network has not")
    num_styles, width = flat["style.kernel"].shape
    released = presets.find_preset("CAMDM-K4")
    sizes = {"num_styles": num_styles, "latent_width": width, "depth": depth, "window": WINDOW}
    config = CAMDMConfig.from_dict({
        **released.network, **presets.find_preset("CAMDM-code").network, **sizes, "num_history": NUM_HISTORY,
        "noise_levels": released.network["noise_levels"], "channels": flat["history.kernel"].shape[0],
        "feed_forward_factor": flat["blocks.0.hidden.kernel"].shape[1] // width,
    })  # fmt: skip
    network = nnx.eval_shape(lambda: presets.build_from_config(config, jax.random.key(0)))
    for keys, leaf in nnx.to_flat_state(nnx.state(network)):
        name = ".".join(map(str, keys))
        if flat[name].shape != leaf.shape:
            raise ValueError(f"{where}: {name} must have the shape {leaf.shape}, got {flat[name].shape}")
        leaf.set_value(jnp.asarray(flat[name]))
    return network


def published_model(path, packed: PackedMotion) -> TrainedModel:
    """Return the published network, ready to walk where a data set walks.

    Args:
      path: of the converted arrays.
      packed: 100STYLE on the skeleton of the release, all its styles.

    Raises:
      ValueError: for another skeleton or other styles, or as `published_network`.
    """
    network = published_network(published_arrays(path), str(path))
    config, joints = network.config, packed.skeleton.num_joints
    if (config.channels, config.num_styles) != (num_channels(packed.skeleton) + 3, len(packed.styles)) or (
        list(packed.styles) != sorted(packed.styles)
    ):
        raise ValueError(
            f"{path}: moves {config.channels // 6 - 1} joints in {config.num_styles} styles in the order of their "
            f"names, and the data set has {joints} joints and {len(packed.styles)} styles: it takes 100STYLE "
            "retargeted as the release does"
        )
    return TrainedModel(
        name=NAME, config=config, params=nnx.state(network), normaliser=PublishedFeatures(),
        skeleton=packed.skeleton, styles=packed.styles, diffusion=presets.find_preset("CAMDM-K4").diffusion,
        start_poses=starting_poses(packed, num_history=NUM_HISTORY),
        record={"dataset": packed.name, "dataset_licence": packed.licence, "dataset_credit": packed.credit},
    )  # fmt: skip
