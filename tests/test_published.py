"""Published weights: names and shapes of the releases, with random numbers in them."""

import types

import jax
import numpy as np
import pytest
from builders import evaluate, refused
from flax import nnx
from safetensors.numpy import save_file
from scipy.special import erf

from f3amd_lib.networks.conditioning import Condition
from f3amd_lib.text.released import read_released, released_arrays

HEADS = 4


def released(joints=25, styles=100, width=256, depth=4, hidden=1024, seed=0):
    """The arrays of a released state dict, random."""
    rng = np.random.default_rng(seed)
    arrays, channels = {}, 6 * (joints + 1)

    def add(name, *shape):
        arrays[name] = rng.normal(0.0, 0.1, shape).astype(np.float32)

    def layer(name, out, into):
        add(f"{name}.weight", out, into)
        add(f"{name}.bias", out)

    for name, into in (("future_motion", channels), ("past_motion", channels), ("traj_trans", 2), ("traj_pose", 6)):
        layer(f"{name}_process.poseEmbedding", width, into)
    layer("style_feature_process", width, 512)
    add("sequence_pos_encoder.pe", 5000, 1, width)
    add("embed_timestep.sequence_pos_encoder.pe", 5000, 1, width)
    add("embed_style.action_embedding", styles, width)
    for number in (0, 2):
        layer(f"embed_timestep.time_embed.{number}", width, width)
    for number in range(depth):
        block = f"seqEncoder.layers.{number}"
        add(f"{block}.self_attn.in_proj_weight", 3 * width, width)
        add(f"{block}.self_attn.in_proj_bias", 3 * width)
        layer(f"{block}.self_attn.out_proj", width, width)
        layer(f"{block}.linear1", hidden, width)
        layer(f"{block}.linear2", width, hidden)
        for norm in ("norm1", "norm2"):
            add(f"{block}.{norm}.weight", width)
            add(f"{block}.{norm}.bias", width)
    layer("output_process.poseFinal", channels, width)
    return arrays


def by_hand(arrays, x, step, past, trans, pose, style):
    """The released forward pass for one character, in plain numpy: x [T, C], past [P, C], trans [T, 2], pose [T, 6]."""
    arrays = {name: array.astype(np.float64) for name, array in arrays.items()}
    apply = lambda name, z: z @ arrays[f"{name}.weight"].T + arrays[f"{name}.bias"]
    width = arrays["embed_style.action_embedding"].shape[1]
    tokens = 2 + 2 * len(trans) + len(past) + len(x)
    angle = np.arange(tokens)[:, None] * np.exp(np.arange(0, width, 2) * (-np.log(10000.0) / width))
    table = np.stack([np.sin(angle), np.cos(angle)], axis=-1).reshape(tokens, width)
    hidden = apply("embed_timestep.time_embed.0", table[step])
    time = apply("embed_timestep.time_embed.2", hidden / (1.0 + np.exp(-hidden)))
    z = np.concatenate(
        [
            time[None],
            arrays["embed_style.action_embedding"][style][None],
            apply("traj_trans_process.poseEmbedding", trans),
            apply("traj_pose_process.poseEmbedding", pose),
            apply("past_motion_process.poseEmbedding", past),
            apply("future_motion_process.poseEmbedding", x),
        ]
    )
    z = z + table

    def norm(name, z):
        z = (z - z.mean(-1, keepdims=True)) / np.sqrt(z.var(-1, keepdims=True) + 1e-5)
        return z * arrays[f"{name}.weight"] + arrays[f"{name}.bias"]

    number = 0
    while f"seqEncoder.layers.{number}.linear1.weight" in arrays:
        block = f"seqEncoder.layers.{number}"
        asked = z @ arrays[f"{block}.self_attn.in_proj_weight"].T + arrays[f"{block}.self_attn.in_proj_bias"]
        query, key, value = (part.reshape(tokens, HEADS, -1).swapaxes(0, 1) for part in np.split(asked, 3, axis=-1))
        scores = query @ key.swapaxes(1, 2) / np.sqrt(width // HEADS)
        weights = np.exp(scores - scores.max(-1, keepdims=True))
        answer = (weights / weights.sum(-1, keepdims=True)) @ value
        z = norm(f"{block}.norm1", z + apply(f"{block}.self_attn.out_proj", answer.swapaxes(0, 1).reshape(tokens, -1)))
        hidden = apply(f"{block}.linear1", z)
        hidden = 0.5 * hidden * (1.0 + erf(hidden / np.sqrt(2.0)))
        z = norm(f"{block}.norm2", z + apply(f"{block}.linear2", hidden))
        number += 1
    return apply("output_process.poseFinal", z[-len(x) :])


def camdm(arrays, folder):
    """The network of arrays, on data of its joints and styles without a clip."""
    path = folder / "camdm.safetensors"
    save_file(arrays, path)
    joints, styles = len(arrays["output_process.poseFinal.bias"]) // 6 - 1, len(arrays["embed_style.action_embedding"])
    data = types.SimpleNamespace(
        skeleton=types.SimpleNamespace(num_joints=joints), styles=tuple(f"{number:03}" for number in range(styles)),
        clip_style=np.array([]), name="", licence="", credit="",
    )  # fmt: skip
    return read_released(path, "camdm", packed=data).network()


def test_the_released_shape_has_the_released_number_of_parameters(tmp_path):
    network = camdm(released(), tmp_path)
    assert sum(leaf.size for leaf in jax.tree.leaves(nnx.state(network, nnx.Param))) == 3_439_260
    config = network.config
    assert (config.channels, config.window, config.num_history, config.num_tokens) == (156, 45, 10, 147)
    # camdm_facts: the four levels as alpha_bar of the released configuration.
    alpha_bar = 1.0 / (1.0 + np.square(config.noise_levels))
    np.testing.assert_allclose(alpha_bar, [0.847012, 0.493844, 0.144272, 0.000144], atol=1e-6)


@pytest.mark.parametrize("step", [0, 2, 3])
def test_it_computes_what_the_released_forward_pass_computes(step, tmp_path):
    arrays = released(joints=3, styles=5, width=16, depth=2, hidden=32, seed=step)
    network = camdm(arrays, tmp_path)
    rng = np.random.default_rng(step)
    x, past = rng.normal(size=(45, 24)), rng.normal(size=(10, 24))
    trans, pose = rng.normal(size=(45, 2)), rng.normal(size=(45, 6))
    condition = Condition(
        history=past[None].astype(np.float32),
        path=np.concatenate([trans, pose], axis=-1)[None].astype(np.float32),
        style=np.eye(5, dtype=np.float32)[[3]],
    )
    sigma = network.config.noise_levels[step]
    # Theirs is the variance-preserving state: ours times 1 / sqrt(1 + sigma^2).
    x_noisy = (x * np.sqrt(1.0 + sigma**2))[None].astype(np.float32)
    found = evaluate(network, x_noisy, np.float32(sigma), condition)[0]
    np.testing.assert_allclose(found, by_hand(arrays, x, step, past, trans, pose, 3), atol=2e-4)


def test_a_file_that_is_damaged_or_missing_is_refused_by_name(tmp_path):
    path = tmp_path / "arrays.safetensors"
    refused("arrays.safetensors: not a whole file of arrays", released_arrays, path)
    save_file({"a": np.ones((3, 4), np.float32)}, path)
    np.testing.assert_array_equal(released_arrays(path)["a"], 1.0)
    whole = path.read_bytes()
    for damaged in (whole[:-7], b""):
        path.write_bytes(damaged)
        refused("arrays.safetensors: not a whole file of arrays", released_arrays, path)
    refused("pickle", released_arrays, tmp_path / "best.pt")


def test_what_is_no_release_is_refused(tmp_path):
    small = released(joints=3, styles=5, width=16, depth=1, hidden=32)
    lacking = {name: array for name, array in small.items() if not name.endswith("norm1.bias")}
    refused("has no array 'seqEncoder.layers.0.norm1.bias'", camdm, lacking, tmp_path)
