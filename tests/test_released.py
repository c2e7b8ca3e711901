"""Weights of ACMDM, MotionLCM and the evaluators: released names and shapes, and PyTorch's definitions in numpy."""

import pickle

import jax
import numpy as np
import pytest
from builders import refused, same_tree
from compiled import Compiled
from flax import nnx
from safetensors.numpy import save_file
from scipy.special import erf, expit

from f3amd_companion.__main__ import main
from f3amd_lib.networks.presets import blank_network, count_parameters
from f3amd_lib.text.data import text_encoders
from f3amd_lib.text.data.humanml3d import tagged_captions
from f3amd_lib.text.data.redundant import canonical_start, redundant_from_positions
from f3amd_lib.text.data.text_encoders import TextEmbeddings, TextEncoder, embed_captions, load_glove
from f3amd_lib.text.data.text_motions import going_on
from f3amd_lib.text.networks import acmdm
from f3amd_lib.text.released import FAMILIES, read_released, released_parts
from f3amd_lib.text.sampling import captioned_motion
from f3amd_lib.text.stages.text_models import load_text_model, save_text_model
from f3amd_lib.training.checkpoints import network_with

# ------------------------------------------------------------------------------------------ names and shapes


def layer(name, *shape):
    return {f"{name}.weight": shape, f"{name}.bias": shape[:1]}


def layers(prefix, **shapes):
    return {key: value for name, shape in shapes.items() for key, value in layer(f"{prefix}.{name}", *shape).items()}


def transformer_block(name, d, f, crossing=False):
    found = layers(name, linear1=(f, d), linear2=(d, f), norm1=(d,), norm2=(d,))
    for which in ["self_attn", *(["multihead_attn"] if crossing else [])]:
        found |= {f"{name}.{which}.in_proj_weight": (3 * d, d), f"{name}.{which}.in_proj_bias": (3 * d,)}
        found |= layer(f"{name}.{which}.out_proj", d, d)
    return found | (layer(f"{name}.norm3", d) if crossing else {})


def skip_transformer(name, d, f, crossing=False):
    blocks = [f"{name}.{which}.{number}" for which in ("input_blocks", "output_blocks") for number in range(4)]
    found = [transformer_block(block, d, f, crossing) for block in [*blocks, f"{name}.middle_block"]]
    found += [layer(f"{name}.linear_blocks.{number}", d, 2 * d) for number in range(4)]
    return {key: shape for one in found for key, shape in one.items()} | layer(f"{name}.norm", d)


def acmdm_blocks(name, depth, d, head):
    found = {}
    for block in (f"{name}.{number}" for number in range(depth)):
        hidden = int(2 / 3 * 4 * d)
        found |= {f"{block}.{norm}.weight": (d,) for norm in ("norm1", "norm2")}
        found |= {f"{block}.attn.{norm}.weight": (head,) for norm in ("q_norm", "k_norm")}
        found |= layer(f"{block}.attn.qkv", 3 * d, d) | layer(f"{block}.attn.proj", d, d)
        found |= layer(f"{block}.mlp.w12", 2 * hidden, d) | layer(f"{block}.mlp.w3", d, hidden)
        found |= layer(f"{block}.adaLN_modulation.1", 6 * d, d)
    return found


def acmdm_shapes(depth=8, patch=22, head=64, text=512, *, control=False, noisy=False):
    d = depth * head
    found = acmdm_blocks("ACMDMTransformer", depth, d, head) | {"final_layer.norm_final.weight": (d,)}
    found |= layer("x_embedder", *((d, 4 * patch) if noisy else (d, 4, 1, patch)))
    found |= layer("t_embedder.mlp.0", d, 256) | layer("t_embedder.mlp.2", d, d) | layer("y_embedder", d, text)
    found |= layers("final_layer", linear=(4 * patch, d)) | layer("final_layer.adaLN_modulation.1", 2 * d, d)
    if control:
        found |= acmdm_blocks("ControlNet", depth, d, head) | {"c_control_embedder.norm.weight": (d,)}
        found |= layer("c_t_embedder.mlp.0", d, 256) | layer("c_t_embedder.mlp.2", d, d)
        found |= layer("c_x_embedder", d, 4, 1, patch) | layer("c_y_embedder", d, text)
        found |= layers("c_control_embedder", patch_embed=(d, 3, 4, patch), zero_linear=(d, d))
        for number in range(depth):
            found |= layer(f"zero_Linear.{number}", d, d)
    return found | ({"attention_mask": (1, 1, 50, 50)} if noisy else {})


def autoencoder_shapes(d=512, encoded=4):
    found = layers("encoder", conv_in=(d, 3, 3, 1), conv_out=(encoded, d, 3, 1))
    found |= layers("decoder", conv_in=(d, 4, 3, 1), conv_out1=(d, d, 3, 1), conv_out2=(3, d, 3, 1))
    for half, numbers in (("encoder", (2, 3, 4, 7, 8, 9)), ("decoder", (0, 1, 2, 4, 5, 6))):
        for number in numbers:
            found |= layers(f"{half}.model.{number}", conv1=(d, d, 3, 1), conv2=(d, d, 1, 1))
    found |= layer("encoder.model.1", d, d, 4, 1) | layer("encoder.model.6", d, d, 4, 1)
    return found | layer("decoder.model.3.conv", d, d, 3, 1) | layer("decoder.model.7.conv", d, d, 3, 1)


def motionlcm_shapes(d=256, f=1024, features=263, tokens=16, channels=32, text=768, guidance=256, part="student"):
    found = layer("vae.skel_embedding", d, features) | layer("vae.final_layer", features, d)
    found |= {"vae.global_motion_token": (2 * tokens, d)} | layer("vae.latent_pre", channels, d)
    found |= {f"vae.query_pos_{half}.pe": (500, 1, d) for half in ("encoder", "decoder")}
    found |= layer("vae.latent_post", d, channels)
    found |= skip_transformer("vae.encoder", d, f) | skip_transformer("vae.decoder", d, f, crossing=True)
    found |= {"t2m_textencoder.pos_emb.weight": (300, 15)}  # theirs has the evaluator in every file
    if part == "vae":
        return found
    found |= layer("denoiser.latent_pre", d, channels) | layer("denoiser.latent_post", channels, d)
    found |= layers("denoiser.time_embedding", linear_1=(d, text), linear_2=(d, d))
    found |= layer("denoiser.emb_proj.1", d, text) | {"denoiser.query_pos.pe": (500, 1, d)}
    found |= {"denoiser.time_embedding.cond_proj.weight": (text, guidance)} if part == "student" else {}
    return found | skip_transformer("denoiser.encoder", d, f)


def recurrence(name, into, h, out):
    found = layer(f"{name}.input_emb", h, into) | {f"{name}.hidden": (2, 1, h)}
    for way in ("", "_reverse"):
        found |= {f"{name}.gru.weight_{part}h_l0{way}": (3 * h, h) for part in "ih"}
        found |= {f"{name}.gru.bias_{part}h_l0{way}": (3 * h,) for part in "ih"}
    return found | layer(f"{name}.output_net.0", h, 2 * h) | layer(f"{name}.output_net.1", h) | layer(
        f"{name}.output_net.3", out, h
    )  # fmt: skip


def evaluator_shapes(features=263 - 4, m=512, motion=1024, text=512, word=300, tags=15, out=512):
    found = layer("movement_encoder.main.0", m, features, 4) | layer("movement_encoder.main.3", m, m, 4)
    found |= layer("movement_encoder.out_net", m, m) | layer("text_encoder.pos_emb", word, tags)
    return found | recurrence("motion_encoder", m, motion, out) | recurrence("text_encoder", word, text, out)


def clip_shapes(d=512, f=1024, features=67, depth=8, words=49408, out=512):
    found = {"logit_scale": (), "motion_encoder.sequence_pos_encoder.pe": (2000, d), "positional_embedding": (77, d)}
    found |= {"motion_encoder.query_token": (1, d), "token_embedding.weight": (words, d)}
    found |= layers("motion_encoder", embed_motion=(d, features), out_ln=(d,), out=(out, d))
    for number in range(depth):
        found |= transformer_block(f"motion_encoder.transformer.layers.{number}", d, f)
        found |= transformer_block(f"textTransEncoder.layers.{number}", d, f)
    return found | layer("text_ln", d) | layer("out", out, d)


SMALL = {
    "acmdm-autoencoder": autoencoder_shapes(4),
    "acmdm": acmdm_shapes(2, head=4, text=6),
    "acmdm-control": acmdm_shapes(2, head=4, text=6, control=True),
    "acmdm-noisy-condition": acmdm_shapes(2, 2, head=4, text=6, noisy=True),
    "motionlcm-vae": motionlcm_shapes(8, 12, 263, 3, 4, part="vae"),
    "motionlcm-teacher": motionlcm_shapes(8, 12, 263, 3, 4, 6, part="teacher"),
    "motionlcm-student": motionlcm_shapes(8, 12, 263, 3, 4, 6, 10),
    "evaluator": evaluator_shapes(259, 6, 5, 7, 9, 3, 4),
    "acmdm-evaluator": evaluator_shapes(67, 6, 5, 7, 9, 3, 4),
    "acmdm-clip-evaluator": clip_shapes(16, 12, 67, 2, 11, 5),
}
"""Each family but CAMDM's (`test_published.py`) at a small size."""


def random_arrays(shapes, seed=0):
    """A norm's input of little deviation, behind `output_net.0`, shows the epsilon."""
    rng = np.random.default_rng(seed)
    width = lambda name: 3e-4 if "output_net.0" in name else 0.3
    return {name: rng.normal(0.0, width(name), shape).astype(np.float32) for name, shape in shapes.items()}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Files of every family, and means and deviations as their releases name them."""
    folder, rng = tmp_path_factory.mktemp("released"), np.random.default_rng(1)
    for family, shapes in SMALL.items():
        save_file(random_arrays(shapes), folder / f"{family}.safetensors")
    numbers = {"22x3": 3, "AE_2D_Causal_Post": 4, "eval": 67}
    names = [(f"{name}_{what}", count) for name, count in numbers.items() for what in ("mean", "std")]
    names = [(name.replace("Post_m", "Post_M").replace("Post_s", "Post_S"), count) for name, count in names]
    (folder / "meta").mkdir()
    for name, count in [*names, ("Mean", 263), ("Std", 263), ("meta/mean", 263), ("meta/std", 263)]:
        np.save(folder / f"{name}.npy", rng.uniform(0.5, 2.0, count))
    return folder


def read(folder, family, **options):
    options = {"statistics": folder, "autoencoder": folder / "acmdm-autoencoder.safetensors"} | options
    return read_released(folder / f"{family}.safetensors", family, **options)


# ------------------------------------------------------------------------------------------ full sizes

MILLIONS = {
    "acmdm-autoencoder": (autoencoder_shapes(), 17.08),
    "acmdm": (acmdm_shapes(), 39.1),
    "acmdm XL": (acmdm_shapes(20), 596.4),
    "motionlcm-teacher": (motionlcm_shapes(part="teacher"), 8.24),
    "motionlcm-student": (motionlcm_shapes(), 8.44),
    "acmdm-clip-evaluator": (clip_shapes(), 59.5),
}
"""Parameters of the network that makes motion, as the fact sheets count them; of the CLIP evaluator by hand."""


@pytest.mark.slow
@pytest.mark.parametrize("which", MILLIONS)
def test_released_shapes_are_those_of_our_networks_at_full_size(which):
    shapes, millions = MILLIONS[which]
    arrays = {name: np.broadcast_to(np.float32(0), shape) for name, shape in shapes.items()}
    _, configs, made = released_parts(arrays, which.split()[0])
    for part, config in configs.items():
        sizes = [array.size for name, array in made.items() if name.startswith(f"{part}.")]
        assert sum(sizes) == count_parameters(config)
        assert len(sizes) == len(jax.tree.leaves(blank_network(config)[1]))
    assert count_parameters(configs.get("params") or configs["autoencoder"]) / 1e6 == pytest.approx(millions, rel=2e-3)


@pytest.mark.slow
def test_a_release_says_which_preset_it_is(folder, tmp_path):
    name = lambda model: (model.name, type(model).__name__)
    assert name(read(folder, "acmdm-control")) == ("ACMDM-S-PS22+control", "TextModel")
    assert name(read(folder, "motionlcm-student")) == ("MotionLCM-V2", "LatentModel")
    assert read(folder, "acmdm-noisy-condition").config.patch == "pair"
    assert read(folder, "acmdm-evaluator").config.tag_width == 3
    assert read(folder, "motionlcm-student").training["consistency"] == "latent"


# ------------------------------------------------------------------------------------------ what is refused


@pytest.mark.parametrize("family", SMALL)
def test_a_name_too_few_or_too_many_and_a_wrong_shape_are_refused_by_name(family, folder, tmp_path):
    arrays = random_arrays(SMALL[family])
    name = [one for one in arrays if not one.startswith(("attention_mask", "t2m_"))][-1]
    wrong = {
        f"has no array '{name}'": {key: array for key, array in arrays.items() if key != name},
        "has an array 'another.weight'": arrays | {"another.weight": np.ones(3, np.float32)},
        f"{name} must have the shape": arrays | {name: arrays[name][..., None]},
    }
    for message, given in wrong.items():
        save_file(given, tmp_path / "wrong.safetensors")
        refused(message, read_released, tmp_path / "wrong.safetensors", family, statistics=folder)


def test_pickles_unknown_families_and_what_is_not_given_are_refused(folder, tmp_path):
    for ending in ("pt", "pth", "tar", "ckpt"):
        refused("weights_only=True", read_released, folder / f"latest.{ending}", "acmdm")
    refused("acmdm-controll.*acmdm-control", read_released, folder / "a.safetensors", "acmdm-controll")
    refused("22x3_mean.npy is needed", read, folder, "acmdm-autoencoder", statistics=None)
    refused("has 0 files 22x3_mean.npy", read, folder, "acmdm-autoencoder", statistics=tmp_path)
    refused("F3AMD-FNO-96 is no ACMDM", read, folder, "acmdm", preset="F3AMD-FNO-96")
    refused("name the arrays of that autoencoder", read, folder, "acmdm", autoencoder=None)
    np.save(tmp_path / "22x3_mean.npy", np.ones(2))
    refused("must have 3 finite numbers", read, folder, "acmdm-autoencoder", statistics=tmp_path)


def test_a_released_model_is_kept_as_a_file_of_ours(folder, tmp_path):
    model = read(folder, "acmdm-control")
    save_text_model(tmp_path / "model.safetensors", model, np.float32)
    again = load_text_model(tmp_path / "model.safetensors")
    assert same_tree(again.params, model.params) and same_tree(again.branch, model.branch)
    assert again.record["dataset_licence"] == FAMILIES["acmdm-control"]["licence"]


# ------------------------------------------------------------------------------------------ forward passes in numpy


class Torch:
    """Layers of a state dict, by PyTorch's definitions, in double precision."""

    def __init__(self, arrays):
        self.arrays = {name: array.astype(np.float64) for name, array in arrays.items()}

    def linear(self, name, x, joined=""):
        weight, bias = (f"{name}.{kind}" if not joined else f"{name}.{joined}_{kind}" for kind in ("weight", "bias"))
        return x @ self.arrays[weight].T + self.arrays[bias]

    def layer_norm(self, name, x):
        x = (x - x.mean(-1, keepdims=True)) / np.sqrt(x.var(-1, keepdims=True) + 1e-5)
        return x * self.arrays[f"{name}.weight"] + self.arrays[f"{name}.bias"]

    def rms_norm(self, name, x):
        return x / np.sqrt((x**2).mean(-1, keepdims=True) + 1e-6) * self.arrays[f"{name}.weight"]

    def attention(self, name, asking, answering, heads):
        parts = zip(*(np.split(self.arrays[f"{name}.in_proj_{kind}"], 3) for kind in ("weight", "bias")), strict=True)
        asked = [x @ weight.T + bias for x, (weight, bias) in zip((asking, answering, answering), parts, strict=True)]
        return self.linear(f"{name}.out_proj", attended(*asked, heads))

    def block(self, name, x, heads, memory=None):
        x = self.layer_norm(f"{name}.norm1", x + self.attention(f"{name}.self_attn", x, x, heads))
        if memory is not None:
            answer = self.attention(f"{name}.multihead_attn", x, memory, heads)
            x = self.layer_norm(f"{name}.norm2", x + answer)
        hidden = self.linear(f"{name}.linear1", x)
        hidden = self.linear(f"{name}.linear2", 0.5 * hidden * (1 + erf(hidden / np.sqrt(2))))
        return self.layer_norm(f"{name}.{'norm2' if memory is None else 'norm3'}", x + hidden)

    def skip(self, name, x, memory=None, heads=4):
        kept = []
        for number in range(4):
            x = self.block(f"{name}.input_blocks.{number}", x, heads, memory)
            kept.append(x)
        x = self.block(f"{name}.middle_block", x, heads, memory)
        for number in range(4):
            x = self.linear(f"{name}.linear_blocks.{number}", np.concatenate([x, kept.pop()], -1))
            x = self.block(f"{name}.output_blocks.{number}", x, heads, memory)
        return self.layer_norm(f"{name}.norm", x)

    def convolution(self, name, x, stride=1, dilation=1):
        """Of [L, J, C] along L, zeros in front alone."""
        weight = self.arrays[f"{name}.weight"][..., 0]
        x = np.pad(x, (((weight.shape[2] - 1) * dilation + 1 - stride, 0), (0, 0), (0, 0)))
        frames = (len(x) - (weight.shape[2] - 1) * dilation - 1) // stride + 1
        taps = (x[tap * dilation :][: frames * stride : stride] @ weight[..., tap].T for tap in range(weight.shape[2]))
        return sum(taps) + self.arrays[f"{name}.bias"]

    def recurrence(self, name, x):
        x, ends = self.linear(f"{name}.input_emb", x), []
        for way, start, steps in zip(("", "_reverse"), self.arrays[f"{name}.hidden"][:, 0], (x, x[::-1]), strict=True):
            gates = [
                [np.split(self.arrays[f"{name}.gru.{kind}_{of}h_l0{way}"], 3) for kind in ("weight", "bias")]
                for of in "ih"
            ]
            for step in steps:
                (ir, iz, i_n), (hr, hz, hn) = (
                    [weight @ z + bias for weight, bias in zip(*gate, strict=True)]
                    for gate, z in zip(gates, (step, start), strict=True)
                )
                update = expit(iz + hz)
                start = (1 - update) * np.tanh(i_n + expit(ir + hr) * hn) + update * start
            ends.append(start)
        x = self.layer_norm(f"{name}.output_net.1", self.linear(f"{name}.output_net.0", np.concatenate(ends)))
        return self.linear(f"{name}.output_net.3", np.where(x > 0, x, 0.2 * x))

    def acmdm_block(self, name, x, c, heads, base):
        modulation = np.split(self.linear(f"{name}.adaLN_modulation.1", silu(c)), 6)
        shift, scale, gate = modulation[:3]
        asked = self.linear(f"{name}.attn.qkv", self.rms_norm(f"{name}.norm1", x) * (1 + scale) + shift)
        query, key, value = (part.reshape(len(x), heads, -1) for part in np.split(asked, 3, -1))
        angle = np.arange(len(x))[:, None] / base ** np.linspace(0, 1, query.shape[-1] // 2)
        cosine, sine = (np.concatenate([wave, wave], -1)[:, None] for wave in (np.cos(angle), np.sin(angle)))
        turned = lambda z: z * cosine + np.concatenate([-np.split(z, 2, -1)[1], np.split(z, 2, -1)[0]], -1) * sine
        query, key = (turned(self.rms_norm(f"{name}.attn.{kind}_norm", z)) for kind, z in (("q", query), ("k", key)))
        flat = (part.reshape(len(x), -1) for part in (query, key, value))
        x = x + gate * self.linear(f"{name}.attn.proj", attended(*flat, heads))
        shift, scale, gate = modulation[3:]
        hidden = self.linear(f"{name}.mlp.w12", self.rms_norm(f"{name}.norm2", x) * (1 + scale) + shift)
        first, second = np.split(hidden, 2, -1)
        return x + gate * self.linear(f"{name}.mlp.w3", silu(first) * second)

    def time_and_text(self, prefix, time, text):
        time = self.linear(f"{prefix}t_embedder.mlp.0", waves(time, 256, 128))
        return self.linear(f"{prefix}t_embedder.mlp.2", silu(time)) + self.linear(f"{prefix}y_embedder", text)

    def patches(self, name, x):
        """Of [L, J, C], by a convolution whose stride is its kernel (frames, joints): tokens frame by frame."""
        weight = self.arrays[f"{name}.weight"]
        frames, joints = weight.shape[2:]
        tokens = [
            np.einsum("dcfj,fjc->d", weight, x[frame : frame + frames, joint : joint + joints])
            for frame in range(0, len(x), frames)
            for joint in range(0, x.shape[1], joints)
        ]
        return np.array(tokens) + self.arrays[f"{name}.bias"]


def silu(x):
    return x * expit(x)


def waves(x, width, last, order=1):
    angle = x * 10000.0 ** (-np.arange(width // 2) / last)
    return np.concatenate([np.cos(angle), np.sin(angle)][::order])


def attended(query, key, value, heads):
    query, key, value = (z.reshape(len(z), heads, -1).swapaxes(0, 1) for z in (query, key, value))
    score = query @ key.swapaxes(1, 2) / np.sqrt(query.shape[-1])
    score = np.exp(score - score.max(-1, keepdims=True))
    answer = score / score.sum(-1, keepdims=True) @ value
    return answer.swapaxes(0, 1).reshape(answer.shape[1], -1)


def single(x):
    return np.asarray(x, np.float32)[None]


def close(found, wanted):
    np.testing.assert_allclose(found, wanted, atol=2e-4, rtol=2e-4)


@pytest.mark.parametrize("family", ["acmdm", "acmdm-noisy-condition", "acmdm-control"])
def test_acmdm_computes_what_the_released_network_does(family, folder):
    model, torch = read(folder, family), Torch(random_arrays(SMALL[family]))
    rng, frames, heads = np.random.default_rng(2), 3, 2
    state, text, time = rng.normal(size=(frames, 22, 4)), rng.normal(size=6), 0.3
    if family == "acmdm-noisy-condition":  # a linear layer over the numbers of a patch, channels first
        flat = state.reshape(frames, 11, 2, 4).swapaxes(2, 3).reshape(frames * 11, 8)
        x, base = torch.linear("x_embedder", flat), acmdm.rotary_base(50 * 11)
    else:
        x, base = torch.patches("x_embedder", state), 200
    control = rng.normal(size=(4 * frames, 22, 3)) * rng.integers(2, size=(4 * frames, 22, 1))
    added, c = [0.0, 0.0], torch.time_and_text("", time, text)
    if family == "acmdm-control":
        beside = torch.rms_norm("c_control_embedder.norm", torch.patches("c_control_embedder.patch_embed", control))
        z = torch.patches("c_x_embedder", state) + torch.linear("c_control_embedder.zero_linear", beside)
        for number in range(2):
            z = torch.acmdm_block(f"ControlNet.{number}", z, torch.time_and_text("c_", time, text), heads, base)
            added[number] = torch.linear(f"zero_Linear.{number}", z)
    for number in range(2):
        x = torch.acmdm_block(f"ACMDMTransformer.{number}", x, c, heads, base) + added[number]
    shift, scale = np.split(torch.linear("final_layer.adaLN_modulation.1", silu(c)), 2)
    x = torch.linear("final_layer.linear", torch.rms_norm("final_layer.norm_final", x) * (1 + scale) + shift)
    if family == "acmdm-noisy-condition":
        wanted = x.reshape(frames, 11, 4, 2).swapaxes(2, 3).reshape(frames, 22, 4)
    else:
        wanted = x.reshape(frames, 22, 4)
    network, mask = Compiled(model.network()), np.ones((1, frames), bool)
    condition = acmdm.TextCondition(single(text), mask)
    state, time = single(state), np.array([time], np.float32)
    if family == "acmdm-control":
        asked = acmdm.Control(single(control), None, np.ones(1, np.float32))
        answer = nnx.jit(lambda network, branch, *given: acmdm.controlled(network, branch, condition, asked)(*given))
        found = answer(network.network, model.control_branch(), state, time)
    else:
        found = network(state, time, network.encode(condition))
    close(found[0], wanted)


@pytest.mark.parametrize(("preset", "encoded"), [("ACMDM-causal-AE", 4), ("ACMDM-causal-VAE", 8)])
def test_the_autoencoder_computes_what_the_released_one_does(preset, encoded, folder, tmp_path):
    arrays = random_arrays(autoencoder_shapes(4, encoded))
    save_file(arrays, tmp_path / "ae.safetensors")
    model = read_released(tmp_path / "ae.safetensors", "acmdm-autoencoder", preset=preset, statistics=folder)
    codec, torch = model.codec, Torch(arrays)
    assert model.name == preset
    rng = np.random.default_rng(3)
    positions, latent = rng.normal(size=(8, 5, 3)), rng.normal(size=(2, 5, 4))

    def residual(name, x, dilation):
        update = torch.convolution(f"{name}.conv1", silu(x), dilation=dilation)
        return x + torch.convolution(f"{name}.conv2", silu(update))

    x = torch.convolution("encoder.conv_in", positions)
    for first in (1, 6):
        x = torch.convolution(f"encoder.model.{first}", x, stride=2)
        for number, dilation in enumerate((9, 3, 1), first + 1):
            x = residual(f"encoder.model.{number}", x, dilation)
    network = Compiled(network_with(codec.autoencoder, codec.params))
    close(network.encode(single(positions))[0], torch.convolution("encoder.conv_out", x))
    x = torch.convolution("decoder.conv_in", latent)
    for first in (0, 4):
        for number, dilation in enumerate((9, 3, 1), first):
            x = residual(f"decoder.model.{number}", x, dilation)
        x = torch.convolution(f"decoder.model.{first + 3}.conv", np.repeat(x, 2, axis=0))
    wanted = torch.convolution("decoder.conv_out2", silu(torch.convolution("decoder.conv_out1", x)))
    close(network.decode(single(latent))[0], wanted)


@pytest.mark.parametrize("family", ["motionlcm-teacher", "motionlcm-student"])
def test_motionlcm_computes_what_the_released_networks_do(family, folder):
    model, torch = read(folder, family), Torch(random_arrays(SMALL[family]))
    rng, time, guidance = np.random.default_rng(4), 499, 7.0
    frames, latent, text = rng.normal(size=(6, 263)), rng.normal(size=(3, 4)), rng.normal(size=6)
    place = lambda name, count: torch.arrays[f"{name}.pe"][:count, 0]
    wave = waves(time, 6, 3)
    if family == "motionlcm-student":
        wave = wave + torch.arrays["denoiser.time_embedding.cond_proj.weight"] @ waves(1000 * guidance, 10, 4, -1)
    told = torch.linear(
        "denoiser.time_embedding.linear_2", silu(torch.linear("denoiser.time_embedding.linear_1", wave))
    )
    x = np.stack([*torch.linear("denoiser.latent_pre", latent), told, torch.linear("denoiser.emb_proj.1", text)])
    x = torch.skip("denoiser.encoder", x + place("denoiser.query_pos", 5))
    network = model.network()  # nine blocks alike: one by one they are compiled once
    options = {"guidance": guidance} if family == "motionlcm-student" else {}
    found = network(single(latent), np.array([time]), network.encode(single(text)), **options)
    close(found[0], torch.linear("denoiser.latent_post", x[:3]))
    coder = network_with(model.autoencoder, model.autoencoder_params)
    mask = np.ones((1, 6), bool)
    x = np.concatenate([torch.arrays["vae.global_motion_token"], torch.linear("vae.skel_embedding", frames)])
    x = torch.skip("vae.encoder", x + place("vae.query_pos_encoder", 12))
    close(np.concatenate(coder.encode(single(frames), mask), axis=1)[0], torch.linear("vae.latent_pre", x[:6]))
    x = torch.skip("vae.decoder", place("vae.query_pos_decoder", 6), torch.linear("vae.latent_post", latent))
    close(coder.decode(single(latent), mask)[0], torch.linear("vae.final_layer", x))


def test_the_evaluator_computes_what_the_released_one_does(folder):
    network, torch = Compiled(read(folder, "evaluator").network()), Torch(random_arrays(SMALL["evaluator"]))
    rng = np.random.default_rng(5)
    motion, words, tags = rng.normal(size=(12, 259)), rng.normal(size=(5, 9)), np.eye(3)[[0, 1, 2, 0, 1]]
    x = motion
    for number in (0, 3):
        weight = torch.arrays[f"movement_encoder.main.{number}.weight"]
        padded = np.pad(x, ((1, 1), (0, 0)))
        x = np.array([np.einsum("oit,ti->o", weight, padded[first : first + 4]) for first in range(0, len(x), 2)])
        x = x + torch.arrays[f"movement_encoder.main.{number}.bias"]
        x = np.where(x > 0, x, 0.2 * x)
    wanted = torch.recurrence("motion_encoder", torch.linear("movement_encoder.out_net", x))
    close(network.embed_motion(single(motion), np.array([12]))[0], wanted)
    found = network.embed_text(single(words), np.ones((1, 5), bool), single(tags))
    close(found[0], torch.recurrence("text_encoder", words + torch.linear("text_encoder.pos_emb", tags)))


def test_the_evaluator_of_the_clip_score_computes_what_the_released_one_does(folder):
    judge, torch = read(folder, "acmdm-clip-evaluator"), Torch(random_arrays(SMALL["acmdm-clip-evaluator"]))
    rng = np.random.default_rng(6)
    motion = rng.normal(size=(8, 67))
    x = np.concatenate(
        [torch.arrays["motion_encoder.query_token"], torch.linear("motion_encoder.embed_motion", motion)]
    )
    angle = np.arange(9)[:, None] * 10000.0 ** (-np.arange(0, 16, 2) / 16)
    x = x + np.stack([np.sin(angle), np.cos(angle)], axis=-1).reshape(9, 16)
    for number in range(2):
        x = torch.block(f"motion_encoder.transformer.layers.{number}", x, 8)
    wanted = torch.linear("motion_encoder.out", torch.layer_norm("motion_encoder.out_ln", x[0]))
    close(judge.embed_vectors([motion * judge.normaliser.deviation + judge.normaliser.mean])[0], wanted)
    pieces = [9, 3, 4, 10]
    x = torch.arrays["token_embedding.weight"][[*pieces, *[0] * 73]] + torch.arrays["positional_embedding"]
    for number in range(2):
        x = torch.block(f"textTransEncoder.layers.{number}", x, 8)
    told = TextEmbeddings(np.array(pieces, np.float32)[None, :, None], np.ones((1, 4), bool), None)
    close(judge.embed_texts(told)[0], torch.linear("out", torch.layer_norm("text_ln", x[3])))


# ------------------------------------------------------------------------------------------ words with tags


def test_words_are_glove_vectors_with_their_part_of_speech(folder, tmp_path, cache_dir):
    words = ["sos", "eos", "unk", "a", "person", "walk"]
    vectors = np.random.default_rng(7).normal(size=(6, 9)).astype(np.float32)
    np.save(tmp_path / "our_vab_data.npy", vectors)
    (tmp_path / "our_vab_idx.pkl").write_bytes(pickle.dumps({word: row for row, word in enumerate(words)}))
    (tmp_path / "texts").mkdir()
    lines = "A person’s walk#a/DET person/NOUN walk/NOUN zigzag/ADV#0.0#0.0\nbroken\n"
    (tmp_path / "texts" / "1.txt").write_text(lines, encoding="utf-8")
    encoder = load_glove(tmp_path, tagged_captions(tmp_path))
    embedded = embed_captions(["A person’s walk"], encoder)
    np.testing.assert_array_equal(embedded.tokens[0, :, :9], vectors[[0, 3, 4, 5, 2, 1]])
    # A walk is an act, whatever it is called, and what is not known is another word.
    assert embedded.tokens[0, :, 9:].argmax(axis=-1).tolist() == [14, 2, 1, 12, 14, 14]
    refused("'a walk' has no tags", embed_captions, ["a walk"], encoder)
    (tmp_path / "our_vab_idx.pkl").write_bytes(pickle.dumps(np.ones(2)))
    refused("not the GloVe files", load_glove, tmp_path, {})


def test_a_judge_reads_tags_behind_the_numbers_of_a_word(folder):
    judge, rng = read(folder, "evaluator"), np.random.default_rng(8)
    tokens, mask = rng.normal(size=(2, 5, 12)).astype(np.float32), np.arange(5) < np.array([[5], [3]])
    wanted = Compiled(judge.network()).embed_text(tokens[..., :9], mask, tokens[..., 9:])
    close(judge.embed_texts(TextEmbeddings(tokens, mask, None)), wanted)


@pytest.mark.parametrize(("family", "width"), [("evaluator", 259), ("acmdm-evaluator", 67)])
def test_a_judge_looks_at_as_many_numbers_of_a_frame_as_it_was_trained_on(folder, family, width):
    judge, positions = read(folder, family), np.random.default_rng(9).normal(size=(9, 22, 3))
    seen = going_on(canonical_start(judge.skeleton, positions))
    vectors = redundant_from_positions(judge.skeleton, seen)
    assert judge.config.features == width
    close(judge.embed_motions([positions]), judge.embed_vectors([vectors]))


# ------------------------------------------------------------------------------------------ the command


def test_released_weights_become_a_file_of_ours_with_a_card(folder, tmp_path, monkeypatch, capsys):
    embed = lambda captions: ([np.ones((1, 6))] * len(captions), np.ones((len(captions), 6)))
    encoder = TextEncoder("t5-012345", 6, embed)
    monkeypatch.setattr(text_encoders, "load_text_encoder", lambda kind, weights: {"t5": encoder}[kind])
    words = ["convert", str(folder / "motionlcm-teacher.safetensors"), "--family", "motionlcm-teacher"]
    words += ["--to", "teacher", "--statistics", str(folder), "--out", str(tmp_path)]
    assert main(words) == 2 and "--text-weights" in capsys.readouterr().err
    assert main([*words, "--text-weights", str(tmp_path)]) == 0
    model = load_text_model(tmp_path / "teacher.safetensors")
    assert (model.text_encoder, model.empty.tolist()) == ("t5-012345", [1.0] * 6)
    card = (tmp_path / "teacher.md").read_text(encoding="utf-8")
    assert all(FAMILIES["motionlcm-teacher"][what] in card for what in ("source", "licence"))
    assert main([*words, "--text-weights", str(tmp_path)]) == 2 and "--overwrite" in capsys.readouterr().err
    # What nobody knows the words of takes any; and its own encoder alone.
    assert captioned_motion.told_captions(model, encoder, ["somersault"]).shape == (1, 6)


@pytest.mark.slow
@pytest.mark.parametrize("family", ["acmdm-control", "acmdm-noisy-condition", "motionlcm-teacher", "motionlcm-student"])
def test_a_released_model_makes_motion_at_once(family, folder):
    model, how = read(folder, family), {} if family == "motionlcm-student" else {"num_steps": 2}
    if family == "acmdm-control":
        wrist = captioned_motion.find_joint(model, "left_wrist")
        how["control"] = captioned_motion.control_of(model, wrist, np.array([0, 20]), np.ones((2, 3)), 40)
    made = captioned_motion.draw_motions(model, np.ones((1, 6), np.float32), 40, jax.random.key(0), **how)
    assert made.shape == (1, 40, 22, 3) and np.isfinite(made).all() and np.ptp(made) > 0
