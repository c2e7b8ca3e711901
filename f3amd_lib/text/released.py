"""Weights that authors of papers released, as models of ours: one loader, one table of names (`released.toml`).

A release is a PyTorch checkpoint, so a pickle, which may run code and is opened by nobody here. `docs/reproduce.md`
shows how PyTorch itself, told to read weights only, writes the arrays into a safetensors file; this module reads that.
"""

import dataclasses
import hashlib
import math
import re
import types
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from safetensors.numpy import load_file

from f3amd_lib.data.features import num_channels, split_frames
from f3amd_lib.data.packed import PackedMotion
from f3amd_lib.data.windows import starting_poses
from f3amd_lib.ground.files import read_toml
from f3amd_lib.ground.names import check_known
from f3amd_lib.ground.records import run_record
from f3amd_lib.motion.rotations import matrix_from_rotation_6d, rotation_6d_from_matrix
from f3amd_lib.networks import presets
from f3amd_lib.networks.config import CheckedConfig
from f3amd_lib.papers.printed import PUBLISHED_CAMDM
from f3amd_lib.text.data import text_encoders
from f3amd_lib.text.data.humanml3d import LAYOUTS, layout_skeleton, tagged_captions
from f3amd_lib.text.data.text_encoders import TextEncoder
from f3amd_lib.text.data.text_motions import AxisNormaliser
from f3amd_lib.text.judge.text_judge import TextJudge
from f3amd_lib.text.networks.acmdm import blank_branch
from f3amd_lib.text.stages.motionpcm_training import LatentMotionTraining
from f3amd_lib.text.stages.text_models import CONTROL, JUDGE, LatentModel, MotionCodec, TextModel
from f3amd_lib.training.checkpoints import TrainedModel

_TABLE = read_toml(Path(__file__).with_name("released.toml"))


def _family(name: str) -> dict:
    """Return a family's table, laid over that of the family which it is like."""
    own = _TABLE["families"][name]
    return presets.laid_over(_family(own["like"]), own) if "like" in own else own


FAMILIES = {name: _family(name) for name in _TABLE["families"]}
"""Families of released weights, and what is known of each."""


class ReleasedFeatures:
    """Our frames as CAMDM's released network has them, and back; in the place of a `Normaliser`.

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


# -------------------------------------------------------------------------------------------------------------- arrays


def released_arrays(path) -> dict[str, np.ndarray]:
    """Read the arrays of a checkpoint that was converted to safetensors.

    Raises:
      ValueError: naming the file, if it is missing, damaged or of another kind, such as the pickle itself.
    """
    path = Path(path)
    if path.suffix != ".safetensors":
        raise ValueError(
            f"{path}: a PyTorch checkpoint is a pickle, which may run code and is not opened here; write its arrays to "
            f"a .safetensors file first:\n{PICKLE_LINES.format(path=path.name, stem=path.stem)}"
        )
    try:
        return load_file(path)
    except Exception as error:  # what damaged bytes raise is no closed list
        raise ValueError(f"{path}: not a whole file of arrays ({error}); convert the checkpoint again") from error


PICKLE_LINES = """\
  import torch
  from safetensors.torch import save_file
  loaded = torch.load("{path}", map_location="cpu", weights_only=True)
  parts = ["ema_acmdm"]  # ACMDM's autoencoder: ae; CAMDM and MotionLCM: state_dict; more of them: docs/reproduce.md
  save_file({{f"{{part}}.{{name}}": array.contiguous() for part in parts for name, array in loaded[part].items()}},
            "{stem}.safetensors")"""
"""What a user runs where PyTorch is."""


def _entries(table: Mapping, names, sizes: dict[str, int], theirs="", ours="") -> Iterator[tuple[str, str, list[str]]]:
    """Yield (released name, ours, axes) of each array; `sizes["#"]` is how many blocks of the first kind there are."""
    for name, value in table.items():
        where, _, shape = value.partition(":")
        matcher = re.compile(re.escape((theirs + name).partition("#")[0]) + r"(\d+)\.")
        if "#" in name and "#" not in sizes:  # one where there is none, so that it is missed by its name
            sizes["#"] = 1 + max((int(found[1]) for one in names if (found := matcher.match(one))), default=0)
        for number in range(sizes["#"] if "#" in name else 1):
            name_here = theirs + name.replace("#", str(number))
            place = re.sub(r"#(?:\+(\d+))?", lambda plus, number=number: str(number + int(plus[1] or 0)), where)
            if "@" in place:
                place, block = place.split(" @")
                yield from _entries(_TABLE["blocks"][block], names, sizes, f"{name_here}.", f"{ours}{place}.")
                continue
            axes = shape.split()
            if "*" not in name:
                yield name_here, ours + place, axes
                continue
            for kind, leaf in (("weight", "kernel" if len(axes) > 1 else "scale"), ("bias", "bias")):
                yield name_here.replace("*", kind), f"{ours}{place}.{leaf}", axes if kind == "weight" else axes[:1]


def _axes(wanted: list[str], shape: tuple[int, ...], sizes: dict[str, int]) -> list[int] | None:
    """Return an array's axes, those of a product with a dot apart, and fill `sizes`; None where they do not fit."""
    axes = []
    for token, length in zip(wanted, shape, strict=False):
        factors = re.split(r"[*.]", token)
        known = math.prod(int(sizes.get(factor, factor if factor.isdigit() else 1)) for factor in factors)
        if unknown := [factor for factor in factors if not factor.isdigit() and factor not in sizes]:
            sizes[unknown[0]], rest = divmod(length, known)
            if rest or not length:
                return None
        elif known != length:
            return None
        axes += [sizes[factor] for factor in factors] if "." in token else [length]
    return axes if len(wanted) == len(shape) else None


def taken_arrays(arrays: Mapping[str, np.ndarray], family: str, sizes: dict[str, int], where) -> dict[str, np.ndarray]:
    """Return a release's arrays by our names, turned as ours lie.

    PyTorch has [out, in, *taps] where we have [*taps, in, out], and joins query, key and value.

    Args:
      arrays: of the checkpoint's part, by name.
      family: of `FAMILIES`.
      sizes: those that are known; the others of its shapes are added.
      where: the file, for messages.

    Raises:
      ValueError: naming the array that is missing, too much or of another shape.
    """
    told, made = FAMILIES[family], {}
    prefix = f"{told.get('part', '')}."
    left = {name.removeprefix(prefix): array for name, array in arrays.items()}
    left = {name: array for name, array in left.items() if not re.fullmatch(told.get("unused", ""), name)}
    for name, ours, wanted in list(_entries(told["arrays"], left, sizes)):
        if name not in left:
            raise ValueError(f"{where}: has no array {name!r}: these are no weights of the family {family}")
        array = left.pop(name)
        if (axes := _axes(wanted, array.shape, sizes)) is None:
            known = ", ".join(f"{size} = {number}" for size, number in sizes.items())
            raise ValueError(f"{where}: {name} must have the shape [{', '.join(wanted)}] ({known}), got {array.shape}")
        array = np.asarray(array, np.float32).reshape(axes)
        if re.search("weight|bias", name.rpartition(".")[2]) and array.ndim > 1 and not ours.endswith("embedding"):
            array = np.moveaxis(array, (1, 0), (-2, -1))
        joined = re.search(r"[^.]*\|[^.]*|$", ours)[0]
        for role, part in zip(joined.split("|"), np.split(array, joined.count("|") + 1, axis=-1), strict=True):
            made[ours.replace(joined, role) if joined else ours] = part
    if left:
        raise ValueError(f"{where}: has an array {min(left)!r} that the family {family} has not")
    return made


# -------------------------------------------------------------------------------------------------------------- models


def _params(shapes, made: Mapping[str, np.ndarray], part: str, where) -> Any:
    """Return weights in the shapes of one network, of arrays by our names."""
    leaves, tree = jax.tree_util.tree_flatten_with_path(shapes)
    filled = []
    for keys, leaf in leaves:
        name = ".".join([part, *(str(key.key) for key in keys if hasattr(key, "key"))])
        if made[name].size != leaf.size:
            raise ValueError(f"{where}: {name} must have the shape {leaf.shape}, got {made[name].shape}")
        filled.append(jnp.asarray(made[name].reshape(leaf.shape)))
    return jax.tree.unflatten(tree, filled)


def _statistics(folder, names: tuple[str, str], width: int) -> AxisNormaliser:
    """Return mean and deviation, the first `width` numbers of files that lie in a folder or below it."""
    found = []
    for name in names:
        paths = sorted(Path(folder or ".").rglob(name)) if folder else []
        if len(paths) != 1:
            several = f"has {len(paths)} files {name}" if folder else f"{name} is needed"
            raise ValueError(f"{folder or 'statistics'}: {several}; name the one folder of the release that has it")
        try:
            numbers = np.load(paths[0], allow_pickle=False).astype(np.float32).ravel()[:width]
        except (OSError, ValueError, EOFError):
            numbers = np.empty(0)
        if len(numbers) < width or not np.isfinite(numbers).all():
            raise ValueError(f"{paths[0]}: must have {width} finite numbers, has {numbers.size}; fetch it again")
        found.append(numbers)
    return AxisNormaliser(found[0], np.maximum(found[1], 1e-8))


def released_parts(arrays: Mapping[str, np.ndarray], family: str, preset: str = "", *, layout="humanml3d", where=""):
    """Return (preset, config of each network by part, arrays by our names) of a release, as `read_released` says."""
    told = FAMILIES[family]
    base = preset.partition(CONTROL)[0] or told.get("preset")
    found = presets.find_preset(base) if base else None
    if found and found.family != (usual := presets.find_preset(told["preset"]).family):
        raise ValueError(f"{base} is no {usual}, as {family} is; name another preset")
    sizes = {size: found.network.get(field, usual) for size, (field, usual) in told.get("known", {}).items()}
    made, joints, settings = taken_arrays(arrays, family, sizes, where), layout_skeleton(layout).num_joints, {}
    if "P" in sizes:
        patches = {joints: "whole", -(-joints // 2): "half", 2: "pair"}
        if sizes["P"] not in patches:
            raise ValueError(f"{where}: has patches of {sizes['P']} joints; of {layout}'s it may be {[*patches]}")
        settings = {"num_joints": joints, "patch": patches[sizes["P"]]}
    configs = {}
    for part, fields in told["sizes"].items():
        for field, size in fields.items():
            numerator, _, denominator = size.partition("/")
            settings[field] = sizes[numerator] // sizes.get(denominator, 1)
        own = presets.find_preset(found.latent) if part == "autoencoder" and found.latent else found
        usual = {"family": own.family, **own.network} if own else {"family": told["network"]}
        configs[part] = presets.config_from_dict({**usual, **told.get("settings", {}), **settings})
        settings = {}
    return found, configs, made


def released_encoder(family: str, folder=None, source=None) -> TextEncoder | None:
    """Return what embeds captions as a family's models read them, None where they read none.

    Args:
      family: of `FAMILIES`.
      folder: of its weights: CLIP ViT-B/32, Sentence-T5, GloVe files of the evaluators, CLIP's tokeniser.
      source: of GloVe: the data set's folder, whose words have tags.

    Raises:
      ValueError: for a folder that is needed and not given, or as the encoders' loaders.
    """
    check_known(family, FAMILIES, "family of released weights")
    kind = FAMILIES[family].get("encoder")
    if kind is None:
        return None
    if folder is None or (kind == "glove" and source is None):
        needed = "--text-weights and --source" if kind == "glove" else "--text-weights"
        raise ValueError(f"{family} reads captions of {kind}: name the folder ({needed})")
    if kind == "glove":
        return text_encoders.load_glove(folder, tagged_captions(source))
    return text_encoders.load_clip_pieces(folder) if kind == "pieces" else text_encoders.load_text_encoder(kind, folder)


def read_released(
    path, family: str, *, preset: str = "", statistics=None, autoencoder=None, encoder: TextEncoder | None = None,
    packed: PackedMotion | None = None, layout: str = "humanml3d",
) -> TrainedModel | TextModel | LatentModel | TextJudge:  # fmt: skip
    """Return what authors released as a model of ours, of the kind that our own files give.

    Args:
      path: arrays of the checkpoint, a .safetensors file.
      family: of `FAMILIES`.
      preset: ours that says what arrays do not, instead of the family's; of a model of one's own training, too.
      statistics: folder in which, or below which, the release's files of means and deviations lie.
      autoencoder: of ACMDM's latent: the file of its arrays.
      encoder: of captions: CLIP ViT-B/32 for ACMDM, Sentence-T5 for MotionLCM, words with tags for an evaluator.
      packed: of CAMDM: 100STYLE on the release's skeleton, all its styles.
      layout: of the skeleton, "humanml3d" or "kit".

    Returns:
      A `TrainedModel` of CAMDM, a `TextModel` of ACMDM, a `LatentModel` of MotionLCM, a `TextJudge` of an evaluator.

    Raises:
      ValueError: naming the file and the array that is missing, too much or of another shape; for a pickle; or for a
        file of statistics, an autoencoder or data that are needed and not given.
    """
    check_known(family, FAMILIES, "family of released weights")
    check_known(layout, LAYOUTS, "layout")
    told, branch = FAMILIES[family], preset.partition(CONTROL)[1:]
    found, configs, made = released_parts(released_arrays(path), family, preset, layout=layout, where=path)
    config, coder = configs.get("params"), configs.get("autoencoder")
    params = {part: _params(presets.blank_network(one)[1], made, part, path) for part, one in configs.items()}
    about = {"config": config, "params": params.get("params"), "record": _record(told, family, path, layout, found)}
    if family == "camdm":
        return _camdm(path, packed, **about)
    about |= {"skeleton": layout_skeleton(layout), "fps": LAYOUTS[layout]["fps"]}
    about |= {"text_encoder": encoder.identity if encoder else "", "name": _name_of(found, config or coder)}
    about |= {"schedule": found.diffusion} if found and config else {}
    normaliser = lambda what, width: _statistics(statistics, told["statistics"][what], width)
    if found is None:
        return TextJudge(normaliser=normaliser("frames", config.features), **about)
    if "frames" in told["statistics"]:
        empty = encoder([""]).pooled[0] if encoder and config else 0.0
        return LatentModel(
            autoencoder=coder, autoencoder_params=params["autoencoder"], empty=empty,
            statistics=normaliser("frames", coder.features), **about,
        )  # fmt: skip
    codec = MotionCodec(normaliser("axes", 3), coder, params.get("autoencoder"))
    if config and found.latent:
        if autoencoder is None:
            raise ValueError(f"{path}: makes the latent of {found.latent}: name the arrays of that autoencoder, too")
        options = {"preset": found.latent, "statistics": statistics, "layout": layout}
        codec = read_released(autoencoder, "acmdm-autoencoder", **options).codec
        codec = dataclasses.replace(codec, latent=normaliser("latent", config.channels))
    if "c_x_embedder.*" in told["arrays"]:
        about["name"] += "".join(branch) or CONTROL
        about["branch"] = _params(blank_branch(config, codec.frames_per_state)[1], made, "branch", path)
    return TextModel(codec=codec, **about)


def _name_of(preset: presets.Preset | None, config: CheckedConfig) -> str:
    """Return the name of the preset that has a config, of the same family and latent; else the given one's."""
    if preset is None:
        return JUDGE
    given = {field: getattr(config, field) for field in config.from_data}
    alike = [one for one in presets.PRESETS.values() if (one.family, one.latent) == (preset.family, preset.latent)]
    same = [one.name for one in alike if presets.build_config(one.name, **given) == config]
    return preset.name if preset.name in same or not same else same[0]


def _record(told: dict, family: str, path, layout: str, preset: presets.Preset | None) -> dict:
    """Return where a model came from and on what terms, in the place of how it was trained."""
    data = types.SimpleNamespace(name=layout, fingerprint=None, licence=told["licence"], credit=told["source"])
    training = {field.name: field.default for field in dataclasses.fields(LatentMotionTraining)[1:]}
    training |= preset.training if preset and preset.paper == "motionpcm" else {}
    return run_record(
        profile="released", dataset=data, seed=0, family=family, identity={"training": training}, file=Path(path).name,
        sha256=hashlib.sha256(Path(path).read_bytes()).hexdigest(),
    )  # fmt: skip


def _camdm(path, packed: PackedMotion, config, params, record) -> TrainedModel:
    """Return CAMDM's network, ready to walk where a data set walks; ValueError for another skeleton or other styles."""
    if packed is None:
        raise ValueError(
            f"{path}: CAMDM starts from poses of its data: give them, 100STYLE retargeted as the release does"
        )
    joints = packed.skeleton.num_joints
    if (config.channels, config.num_styles) != (num_channels(packed.skeleton) + 3, len(packed.styles)) or (
        list(packed.styles) != sorted(packed.styles)
    ):
        raise ValueError(
            f"{path}: moves {config.channels // 6 - 1} joints in {config.num_styles} styles in the order of their "
            f"names, and the data set has {joints} joints and {len(packed.styles)} styles: it takes 100STYLE "
            "retargeted as the release does"
        )
    terms = {"dataset": packed.name, "dataset_licence": packed.licence, "dataset_credit": packed.credit}
    return TrainedModel(
        name=PUBLISHED_CAMDM, config=config, params=params, normaliser=ReleasedFeatures(), skeleton=packed.skeleton,
        styles=packed.styles, diffusion=presets.find_preset("CAMDM-K4").diffusion, record=record | terms,
        start_poses=starting_poses(packed, num_history=config.num_history),
    )  # fmt: skip
