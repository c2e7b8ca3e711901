"""Files of weights: exact round trips, and a plain word about every broken file."""

import dataclasses
import json
import shutil

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from builders import (
    CHANNELS,
    SKELETON,
    WINDOW,
    draw,
    evaluate,
    make_condition,
    random_frames,
    refused,
    same_tree,
    tiny_trained,
)
from safetensors.numpy import save_file

from f3amd_lib.data.features import frame_positions
from f3amd_lib.ground import trees
from f3amd_lib.ground.trees import load_tree, save_tree
from f3amd_lib.training import checkpoints
from f3amd_lib.training.checkpoints import load_model, save_model

TREE = {
    "a": jnp.arange(6, dtype=jnp.float32).reshape(2, 3),
    "b": {"c": jnp.asarray(7, jnp.int32), "d": jnp.asarray([1.5, -2.0], jnp.bfloat16)},
    "an odd 'name' / ü": jnp.zeros(0),
}


@pytest.fixture(scope="module")
def trained():
    return tiny_trained()


@pytest.fixture(scope="module")
def saved(trained, tmp_path_factory):
    path = tmp_path_factory.mktemp("weights") / "model.safetensors"
    save_model(path, trained)
    return path


@pytest.fixture
def copied(saved, tmp_path):
    return shutil.copy(saved, tmp_path / "copy.safetensors")


def test_trees_come_back_exactly_with_their_description(tmp_path):
    path = tmp_path / "new folder" / "tree.safetensors"
    save_tree(path, TREE, {"kind": "test", "numbers": [1, 2.5, None]})
    tree, metadata = load_tree(path, TREE)
    assert same_tree(tree, TREE)
    assert jax.tree.map(lambda a: a.dtype, tree) == jax.tree.map(lambda a: a.dtype, TREE)
    assert metadata == {"kind": "test", "numbers": [1, 2.5, None]}
    assert [item.name for item in path.parent.iterdir()] == ["tree.safetensors"]


def test_trees_of_another_make_are_refused_by_name(tmp_path):
    path = tmp_path / "tree.safetensors"
    save_tree(path, TREE, {})
    refused(r"tree\.safetensors: .*\['a'\] has shape \(2, 3\)", load_tree, path, {**TREE, "a": jnp.zeros((3, 2))})
    refused(r"tree\.safetensors: .*first difference \['more'\]", load_tree, path, {**TREE, "more": jnp.zeros(1)})
    without = {name: leaf for name, leaf in TREE.items() if name != "b"}
    refused(r"tree\.safetensors: .*first difference \['b'\]", load_tree, path, without)


def test_model_comes_back_with_bfloat16_weights(trained, saved):
    loaded = load_model(saved)
    rounded = jax.tree.map(lambda a: a.astype(jnp.bfloat16).astype(jnp.float32), trained.params)
    assert same_tree(loaded.params, rounded)
    assert not same_tree(loaded.params, trained.params)
    assert all(leaf.dtype == jnp.float32 for leaf in jax.tree.leaves(loaded.params))


def test_everything_but_the_weights_comes_back_exactly(trained, saved):
    loaded = load_model(saved)
    for field in ("name", "config", "styles", "record"):
        assert getattr(loaded, field) == getattr(trained, field)
    assert same_tree(loaded.normaliser, trained.normaliser)
    assert loaded.start_poses.keys() == trained.start_poses.keys()
    assert same_tree(loaded.start_poses, trained.start_poses)
    assert loaded.skeleton == SKELETON and loaded.skeleton.end_sites == SKELETON.end_sites
    np.testing.assert_allclose(loaded.skeleton.offsets, SKELETON.offsets, atol=1e-7)


def test_a_models_denoiser_has_its_weights_its_condition_and_its_level(trained):
    x_noisy, condition = draw(2, WINDOW, CHANNELS), make_condition()
    network, denoise = trained.network(), trained.denoiser(condition)
    np.testing.assert_allclose(denoise(x_noisy, 3.0), evaluate(network, x_noisy, 3.0, condition), atol=1e-5)
    unlike = lambda other: float(jnp.abs(other - denoise(x_noisy, 3.0)).max())
    assert unlike(denoise(x_noisy, 0.3)) > 1e-3
    assert unlike(trained.denoiser(condition._replace(path=condition.path + 1.0))(x_noisy, 3.0)) > 1e-4
    doubled = dataclasses.replace(trained, params=jax.tree.map(lambda leaf: 2.0 * leaf, trained.params))
    assert unlike(doubled.denoiser(condition)(x_noisy, 3.0)) > 1e-3


def test_joints_of_network_units_are_in_metres(trained):
    frames = random_frames((2, WINDOW))
    units = trained.normaliser.normalise(frames)
    joints = trained.joint_positions(units)
    np.testing.assert_allclose(joints, frame_positions(SKELETON, frames), atol=1e-4)
    assert np.abs(joints - frame_positions(SKELETON, np.asarray(units))).max() > 0.1


@pytest.mark.parametrize("share", [0.0005, 0.3, 0.999])
def test_truncated_files_are_refused_by_name(copied, share):
    content = copied.read_bytes()
    copied.write_bytes(content[: int(share * len(content))])
    refused(r"copy\.safetensors: .*cut short or damaged", load_model, copied)


def test_other_kinds_and_missing_files_are_refused_by_name(tmp_path):
    path = tmp_path / "theirs.safetensors"
    save_file({"weight": np.zeros(3, np.float32)}, path)
    refused(r"theirs\.safetensors: not written by this project", load_model, path)
    path = tmp_path / "state.safetensors"
    save_tree(path, TREE, {"kind": "training state"})
    refused(r"state\.safetensors: holds a training state", load_model, path)
    refused(r"absent\.safetensors: no such", load_model, tmp_path / "absent.safetensors")
    refused("no such", load_model, tmp_path)


def rewritten(saved, path, change):
    """Copy a model file with its description changed."""
    arrays, metadata = trees._read(saved)
    change(metadata)
    description = json.dumps(metadata)
    header = {"format": trees.FORMAT, "description": description, "sha256": trees._checksum(arrays, description)}
    trees.save_file(arrays, path, header)
    return path


def test_weights_that_do_not_fit_their_config_are_refused_by_name(saved, tmp_path):
    for changes, message in (({"latent_width": 16}, "has shape"), ({"depth": 2}, "expected arrays")):
        odd = rewritten(saved, tmp_path / "odd.safetensors", lambda m, changes=changes: m["model"].update(changes))
        refused(rf"odd\.safetensors: .*{message}", load_model, odd)


@pytest.mark.parametrize(
    "change",
    [
        lambda m: m["model"].update(latent_widht=8),
        lambda m: m["model"].pop("channels"),
        lambda m: m["model"].pop("family"),
        lambda m: m.pop("diffusion"),
        lambda m: m.pop("styles"),
    ],
)
def test_odd_descriptions_are_refused_by_name(saved, tmp_path, change):
    odd = rewritten(saved, tmp_path / "odd.safetensors", change)
    refused(r"odd\.safetensors: .*(latent_widht|channels|family|diffusion|styles)", load_model, odd)


def test_flipped_bytes_among_the_weights_are_noticed(copied):
    content = bytearray(copied.read_bytes())
    content[-2000:-1990] = b"\x3f" * 10
    copied.write_bytes(bytes(content))
    refused(r"copy\.safetensors", load_model, copied)


def test_eight_bits_are_off_by_half_a_step_of_each_column(trained, tmp_path, monkeypatch):
    monkeypatch.setattr(checkpoints, "EIGHT_BITS_FROM", 64)
    path = tmp_path / "small.safetensors"
    save_model(path, trained, jnp.int8)
    again = load_model(path)
    assert trees.describe(path)["weights"] == "int8"
    kept = 0
    for ours, theirs in zip(jax.tree.leaves(trained.params), jax.tree.leaves(again.params), strict=True):
        before, after = np.asarray(ours, np.float32), np.asarray(theirs, np.float32)
        if before.ndim < 2 or before.size < 64:
            np.testing.assert_array_equal(after, before.astype(jnp.bfloat16).astype(np.float32))
            continue
        kept += 1
        step = np.abs(before).max(axis=-2, keepdims=True) / 127.0
        assert np.all(np.abs(after - before) <= 0.5 * step * (1 + 1e-3) + 1e-12)
        assert np.any(after != before) or not before.any()
    assert kept > 3
    # Written again, what was in 8 bits already loses no more than rounding.
    save_model(tmp_path / "again.safetensors", again, jnp.int8)
    twice = load_model(tmp_path / "again.safetensors").params
    for ours, theirs in zip(jax.tree.leaves(again.params), jax.tree.leaves(twice), strict=True):
        np.testing.assert_allclose(np.asarray(theirs), np.asarray(ours), rtol=1e-5)


@pytest.mark.parametrize("content", [b"", b"\x80\x04\x95pickle", bytes(1000)])
def test_foreign_files_are_refused_by_name(tmp_path, content):
    path = tmp_path / "foreign.safetensors"
    path.write_bytes(content)
    refused(r"foreign\.safetensors", load_model, path)
