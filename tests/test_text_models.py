"""Models of text to motion as files, their training by name, and the command that makes motion of a caption."""

import dataclasses
import functools
import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from builders import captioned_walks, refused, same_tree
from test_text_judge import OneVectorAWord

from f3amd_companion.__main__ import main
from f3amd_lib.diffusion.schedules import straight
from f3amd_lib.ground.profiles import load_profile
from f3amd_lib.ground.trees import describe
from f3amd_lib.motion import synthetic
from f3amd_lib.motion.bvh import read_bvh
from f3amd_lib.networks import presets
from f3amd_lib.networks.presets import Preset
from f3amd_lib.text.data import text_encoders
from f3amd_lib.text.sampling import captioned_motion
from f3amd_lib.text.stages import acmdm_training, train_stage
from f3amd_lib.text.stages.text_models import controlled_joints, load_text_model, save_text_model

STYLES = synthetic.STYLES[:2]
SIZES = {"latent_width": 16, "depth": 1, "num_heads": 2, "channels": 3, "window": 40}
LATENT = {**SIZES, "channels": 4, "window": 8}
MESH = {"coarse_levels": (40, 12), "channels": (4, 6), "latent_channels": 5, "num_bases": 2, "around": (5, 4),
        "down": (40, 8), "up": (3, 2)}  # fmt: skip


def preset(name, network, family="ACMDM", latent="", **training):
    return Preset(name, "acmdm", family, straight(), network, training, "ours", latent=latent)


TINY = {
    one.name: one
    for one in (
        preset("tiny", SIZES),
        preset("tiny-redundant", SIZES | {"channels": 13}),
        preset("tiny-AE", {"width": 8, "dilations": (1,)}, "motion autoencoder"),
        preset("tiny-mesh-AE", MESH, "mesh autoencoder"),
        preset("tiny-mesh", SIZES | {"num_joints": 12, "channels": 5}, latent="tiny-mesh-AE"),
        preset("tiny-prefix", LATENT, latent="tiny-AE", prefix_frames=3),
    )
}
QUIET = {"progress": False, "batch_size": 2}
PROFILE = load_profile("smoke", "bandai", train_steps=3)
ENCODER = OneVectorAWord()


@pytest.fixture(scope="module")
def data():
    return captioned_walks(STYLES, ("test", "validation", "train"), num_frames=64)


@pytest.fixture(scope="module")
def folder(data, tmp_path_factory):
    """A folder in which all of the tiny models were trained."""
    folder = tmp_path_factory.mktemp("text")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("F3AMD_CACHE_DIR", str(folder / "cache"))
        for name, preset in TINY.items():
            patch.setitem(presets.PRESETS, name, preset)
        for name in ("tiny+control", "tiny+control-pelvis", "tiny-redundant", "tiny-mesh", "tiny-prefix"):
            assert train_stage.train_stage(data, ENCODER, PROFILE, name, folder=folder / "models", **QUIET) is not None
        yield folder / "models"


def load(folder, name):
    return load_text_model(folder / f"{name}.safetensors")


# --------------------------------------------------------------------------------------------------------------- files


@pytest.mark.slow
def test_a_name_trains_what_it_stands_on_and_files_are_whole(folder, data):
    base, controlled, prefix, codec = (
        load(folder, name) for name in ("tiny", "tiny+control", "tiny-prefix", "tiny-AE")
    )
    assert (codec.config, base.branch, base.starts) == (None, None, {})
    assert same_tree(controlled.params, base.params) and controlled.branch is not None
    assert prefix.codec.autoencoder == codec.codec.autoencoder and same_tree(prefix.codec.params, codec.codec.params)
    assert prefix.skeleton == data.skeleton and prefix.fps == data.fps
    assert (prefix.config.window, prefix.config.text_width, prefix.config.num_joints) == (8, 8, 23)
    np.testing.assert_allclose(base.codec.axes.mean, data.normaliser().mean)
    assert set(base.words) == {"a", "person", "walks", *(style.lower() for style in STYLES)}
    assert prefix.text_encoder == ENCODER.identity and prefix.record["dataset_credit"] == "nobody"
    # The first 3 frames of the latent of the first training clip of each style.
    assert list(prefix.starts) == [f"a person walks {style}" for style in STYLES]
    clip = prefix.codec.axes.normalise(data.clip(2)[None, :12])
    np.testing.assert_allclose(
        prefix.starts[f"a person walks {STYLES[0]}"], prefix.codec.encode(clip, np.ones((1, 12), bool))[0], atol=0.05
    )


@pytest.mark.slow
def test_a_branch_of_the_pelvis_learns_the_pelvis_alone(folder):
    every, pelvis = load(folder, "tiny+control"), load(folder, "tiny+control-pelvis")
    joints = lambda trained: trained.record["identity"]["model"]["joints"]["of"]
    assert joints(pelvis) == [0] and joints(every) == list(every.controlled.values()) and len(joints(every)) == 6
    assert same_tree(every.params, pelvis.params) and not same_tree(every.branch, pelvis.branch)
    assert pelvis.controlled == {"pelvis": 0}
    assert captioned_motion.find_joint(pelvis, "pelvis") == 0
    assert captioned_motion.find_joint(every, "left_wrist") == every.controlled["left_wrist"]
    refused("unknown joint 'left_wrist'", captioned_motion.find_joint, pelvis, "left_wrist")


@pytest.mark.slow
def test_models_come_back_from_their_files(folder, tmp_path):
    for name in ("tiny+control", "tiny-prefix", "tiny-redundant", "tiny-AE"):
        trained = load(folder, name)
        save_text_model(tmp_path / "exact", trained, jnp.float32)
        again = load_text_model(tmp_path / "exact")
        for what in ("params", "branch", "starts"):
            assert same_tree(getattr(again, what), getattr(trained, what))
        assert same_tree(again.codec, trained.codec)
        for what in ("name", "config", "skeleton", "fps", "words", "text_encoder", "record", "schedule"):
            assert getattr(again, what) == getattr(trained, what)
        save_text_model(tmp_path / "small", trained, jnp.int8)
        small = load_text_model(tmp_path / "small")
        for one, other in zip(jax.tree.leaves(small.params), jax.tree.leaves(trained.params), strict=True):
            np.testing.assert_allclose(one, other, atol=0.01 * float(jnp.abs(other).max()) + 1e-6)
    assert describe(tmp_path / "small")["weights"] == "int8"


# ------------------------------------------------------------------------------------------------------------- training


def test_redundant_features_beside_positions_are_normalised_over_training_clips(data):
    states = acmdm_training.encoded_clips(train_stage._codec_of_positions(data, TINY["tiny-redundant"]), data)
    np.testing.assert_array_equal(states[..., :3], data.normaliser().normalise(data.positions))
    part = np.repeat([split == "train" for split in data.splits], data.lengths)
    np.testing.assert_allclose(states[part, :, 3:].mean(axis=(0, 1)), 0.0, atol=1e-4)
    np.testing.assert_allclose(states[part, :, 3:].std(axis=(0, 1)), 1.0, atol=1e-3)


def test_parts_see_training_clips_watch_others_and_ship_the_average(data, tmp_path, monkeypatch):
    """A loop that trains nothing: weights of ones, whose moving average is twos."""
    given = {}

    def loop(task, files, record, *, held_out, **leg):
        given[task.name] = task, held_out
        params = jax.tree.map(jnp.ones_like, jax.eval_shape(lambda: task.init(jax.random.key(0))[0]))
        average = jax.tree.map(lambda leaf: 2.0 * leaf, params)
        return types.SimpleNamespace(step=task.config.num_steps, params=params, averaged=average), []

    monkeypatch.setattr(train_stage, "train_in_legs", loop)
    for name in ("tiny", "tiny-AE"):
        monkeypatch.setitem(presets.PRESETS, name, TINY[name])
    codec = train_stage.train_stage(data, ENCODER, PROFILE, "tiny-AE", folder=tmp_path, **QUIET).codec
    given.clear()
    made = train_stage.train_stage(data, ENCODER, PROFILE, "tiny+control", folder=tmp_path, **QUIET)
    for weights in (made.params, made.branch, given["control branch"][0].base, codec.params):
        assert all((leaf == 2.0).all() for leaf in jax.tree.leaves(weights))
    axes, clips = data.normaliser(), {name: data.members(name) for name in ("train", "validation")}
    assert [len(of) for of in clips.values()] == [8, 2]
    for task, held_out in given.values():
        assert len(task.clips.length) == 8
        frames, condition = jax.tree.leaves(task.clips.frames)[0], held_out[-2] if len(held_out) == 4 else held_out[1]
        np.testing.assert_allclose(frames[:64], axes.normalise(data.clip(clips["train"][0])), atol=1e-5)
        known = [axes.normalise(data.clip(number)) for number in clips["validation"]]
        for motion, mask in zip(held_out[0], np.asarray(condition.mask), strict=True):
            motion = np.asarray(motion)[mask]
            starts = range(64 - len(motion) + 1)
            assert any(np.allclose(motion, clip[s : s + len(motion)], atol=1e-5) for clip in known for s in starts)


@pytest.mark.slow
def test_a_window_shorter_than_the_clips_takes_their_first_frames(data, tmp_path, monkeypatch):
    """Clips begin at the origin; pieces from the middle would not."""
    given = {}

    def loop(task, files, record, **_):
        given.update(task=task, record=record)
        return types.SimpleNamespace(step=0), []

    monkeypatch.setattr(train_stage, "train_in_legs", loop)
    monkeypatch.setattr(presets, "PRESETS", presets.PRESETS | TINY)
    train = functools.partial(train_stage.train_stage, data, ENCODER, PROFILE, folder=tmp_path, window=32, **QUIET)
    assert train("tiny") is None
    refused("no train clip has 64 frames, the longest .*32.*larger --window", train, "tiny-AE")
    cut, task = data.cut(32), given["task"]
    assert task.model_config.window == 32 and np.asarray(task.clips.length).tolist() == [32] * 8
    first = cut.normaliser().normalise(data.clip(data.members("train")[0])[:32])
    np.testing.assert_allclose(task.clips.frames[:32], first, atol=1e-5)
    assert given["record"]["dataset_fingerprint"] == cut.fingerprint != data.fingerprint


@pytest.mark.slow
def test_a_training_goes_on_where_it_was_killed_and_ends_as_one_that_was_not(folder, data, tmp_path):
    train = lambda **leg: train_stage.train_stage(data, ENCODER, PROFILE, "tiny", folder=tmp_path, **QUIET, **leg)
    assert train(stop_at=0.0) is None
    assert describe(tmp_path / "tiny.state.safetensors")["part"] == "text and motion"
    assert same_tree(train().params, load(folder, "tiny").params)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("wrong", "wrong models 12 numbers a joint; positions have 3"),
        ("tiny-mesh+control", "tiny-mesh has no control branch"),
        ("tiny+control-pelvs", r"unknown branch '\+control-pelvs'.*did you mean '\+control-pelvis'"),
        ("ACMDM-S-PS28", "coarse_levels must be as many numbers .*, got .1925"),
    ],
)
def test_what_cannot_be_trained_is_refused(folder, data, monkeypatch, name, message):
    wrong = dataclasses.replace(TINY["tiny"], name="wrong", network=SIZES | {"channels": 12})
    monkeypatch.setitem(presets.PRESETS, "wrong", wrong)
    refused(message, train_stage.train_stage, data, ENCODER, PROFILE, name, folder=folder, **QUIET)


def test_what_is_shown_trembles_less_and_who_stands_does_not_glide_and_who_walks_goes_as_far(data):
    walk, glide = data.clip(0) - data.clip(0)[0, 0] * (1, 0, 1), np.arange(40)[:, None, None] * (0.01, 0.0, 0.02)
    shown = lambda positions, skeleton=data.skeleton: captioned_motion.as_shown(skeleton, positions, 20.0)
    assert np.linalg.norm(shown(walk + (3.0, 0.0, 1.0)) - walk, axis=-1).mean() < 0.01  # begins at the origin
    trembling = walk + np.random.default_rng(0).normal(scale=0.02, size=walk.shape)
    assert np.abs(np.diff(shown(trembling), 2, axis=0)).mean() < np.abs(np.diff(trembling, 2, axis=0)).mean() / 2
    np.testing.assert_allclose(shown(walk[:1] + glide, types.SimpleNamespace(roles={})), walk[:1] + glide, atol=1e-6)
    np.testing.assert_allclose(shown(walk[:1] + glide), np.repeat(walk[:1], 40, axis=0), atol=1e-6)


@pytest.mark.slow
def test_redundant_features_stand_beside_positions_and_are_not_motion(folder, data):
    plain, trained = load(folder, "tiny"), load(folder, "tiny-redundant")
    states = acmdm_training.encoded_clips(trained.codec, data)
    np.testing.assert_array_equal(states[..., :3], acmdm_training.encoded_clips(plain.codec, data))
    # A step is that to the next frame's position.
    step = trained.codec.redundancy.restore(states[..., 3:])[..., :3]
    np.testing.assert_allclose(step[: data.start[1] - 1], np.diff(data.clip(0), axis=0), atol=1e-5)
    told = trained, np.zeros((2, 8), np.float32), [24, 40], jax.random.key(0)
    made = captioned_motion.draw_motions(*told, num_steps=2)
    assert made.shape == (2, 40, 23, 3) and np.isfinite(made).all() and not made[0, 24:].any()
    seen = np.arange(2 * 4 * 23 * 13, dtype=np.float32).reshape(2, 4, 23, 13)
    np.testing.assert_array_equal(trained.codec.decode(seen, np.ones((2, 4), bool)), seen[..., :3])


@pytest.mark.slow
def test_a_model_of_meshes_makes_vertices_and_the_joints_of_them(folder, data, tmp_path):
    trained = load(folder, "tiny-mesh")
    codec, mesh = trained.codec, trained.codec.mesh
    count = len(mesh.body.vertices)
    assert (trained.config.num_joints, trained.config.channels, codec.frames_per_state) == (12, 5, 1)
    assert codec.autoencoder.levels == (count, 40, 12) and trained.most_frames == 40
    # What the codec encodes is the body of the clip, at its places in metres.
    clip = codec.axes.normalise(data.clip(0)[None])
    vertices = codec.axes.restore(codec.vertices_of(clip[0]))
    np.testing.assert_allclose(mesh.joints(vertices), data.clip(0), atol=2e-3)
    states = acmdm_training.encoded_clips(codec, data)
    assert states.shape == (len(data.positions), 12, 5)
    one = np.asarray(codec.encode(clip, np.ones(clip.shape[:2], bool)))[0]
    np.testing.assert_allclose(one, states[: len(one)], atol=1e-4)
    # Joints are those of the vertices, by either door.
    made = codec.decode_vertices(one[None])
    assert made.shape == (1, 64, count, 3)
    np.testing.assert_allclose(codec.decode(one[None], np.ones((1, 64), bool)), mesh.joints(made), atol=1e-5)
    told = trained, np.zeros((2, 8), np.float32), [24, 40], jax.random.key(0)
    draw = lambda **how: captioned_motion.draw_motions(*told, num_steps=2, **how)
    joints, meshes = draw(), draw(mesh=True)
    assert meshes.shape == (2, 40, count, 3) and not meshes[0, 24:].any()
    np.testing.assert_allclose(mesh.joints(meshes), joints, atol=1e-4)
    with pytest.raises(ValueError, match="tiny makes joints, no mesh"):
        captioned_motion.draw_motions(load(folder, "tiny"), np.zeros((1, 8)), 24, jax.random.key(0), mesh=True)


# ---------------------------------------------------------------------------------------------------------- told motion


@pytest.mark.slow
def test_the_model_is_told_the_caption_and_the_control_in_its_own_units(folder, monkeypatch):
    trained, seen = load(folder, "tiny+control"), {}

    def sample(base, branch, schedule, condition, control, noise, **told):
        seen.update(condition=condition, control=control, told=told)
        return control.positions

    monkeypatch.setattr(captioned_motion.text_to_motion, "sample_control", sample)
    points = np.array([[0.1, 1.2, 0.3], [0.4, 0.9, 0.6]])
    wrist = controlled_joints(trained.skeleton)["left_wrist"]
    control = captioned_motion.control_of(trained, wrist, [3, 20], points, 24)
    pooled = np.arange(8, dtype=np.float32)[None]
    with jax.disable_jit():
        made = captioned_motion.draw_motions(
            trained, pooled, 24, jax.random.key(0), guidance=2.0, num_steps=5, control=control
        )
    np.testing.assert_allclose(made[0, [3, 20], wrist], points, atol=1e-5)  # metres in, metres out
    assert float(control.asked.sum()) == 2.0 and (seen["condition"].pooled == pooled).all()
    assert {"guidance": 2.0, "num_steps": 5, "sampler": "ddim"}.items() <= seen["told"].items()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["tiny-prefix", "raw"])
def test_a_stream_goes_straight_on_wherever_it_walks(folder, name, monkeypatch):
    """An oracle in the network's place walks on by the step that it sees: so must the stream, in a straight line."""
    trained = load(folder, "tiny-prefix")
    if name == "raw":
        line = trained.skeleton.offsets + np.linspace(0, 1.1, 12)[:, None, None] * [1.0, 0.0, 0.5] + [0.0, 1.0, 0.0]
        raw = load(folder, "tiny")
        start = raw.codec.axes.normalise(line).astype(np.float32)
        trained = dataclasses.replace(raw, starts={"a person walks": start})
    captions = []

    def go_on(network, schedule, prefix, told, key, **asked):
        captions.append(told[0])
        steps = 1.0 + jnp.arange(network.config.window - prefix.shape[1])[:, None, None]
        yield prefix[:, -1:] + steps * (prefix[:, -1:] - prefix[:, -2:-1])

    monkeypatch.setattr(captioned_motion.text_to_motion, "continue_prefix", go_on)
    pooled = np.eye(8, dtype=np.float32)[:2]
    positions = captioned_motion.stream_motions(trained, pooled, [1, 2], jax.random.key(0))
    first = 12
    assert len(positions) == first + 3 * captioned_motion.window_frames(trained)
    if name == "raw":
        step = np.diff(positions[:, 0], axis=0)
        np.testing.assert_allclose(step, np.tile(step[0], (len(step), 1)), atol=1e-4)
        np.testing.assert_allclose(positions[:first], line, atol=1e-5)


# --------------------------------------------------------------------------------------------------------- command line


@pytest.fixture
def f3amd(folder, tmp_path, monkeypatch, capsys):
    """Run `f3amd text` with the tiny models; return (status, last line of the errors)."""
    monkeypatch.setattr(text_encoders, "load_text_encoder", lambda *_: ENCODER)
    monkeypatch.setenv("F3AMD_CACHE_DIR", str(tmp_path / "cache"))

    def run(*words, model="tiny"):
        weights = str(folder / f"{model}.safetensors")
        status = main(["text", *words, "--weights", weights, "--steps", "2", "--out", str(tmp_path / "out")])
        return status, capsys.readouterr().err

    return run


@pytest.mark.slow
def test_text_writes_three_files_that_say_the_same_and_overwrites_none(f3amd, tmp_path, data, caplog):
    caplog.set_level("INFO")
    assert f3amd("a person walks ArmsCrossed", "--seconds", "1.2", "--guidance", "1") == (0, "")
    files = sorted((tmp_path / "out").iterdir())
    assert [file.name for file in files] == [
        f"a-person-walks-armscrossed_seed0.{end}" for end in ("bvh", "html", "png")
    ]
    motion = read_bvh(files[0])
    assert (motion.num_frames, motion.fps) == (24, pytest.approx(20.0))
    np.testing.assert_allclose(motion.skeleton.offsets[1:], data.skeleton.offsets[1:], atol=1e-4)
    assert "cm on average" in caplog.text and "nobody" in files[1].read_text(encoding="utf-8")
    before = [file.read_bytes() for file in files]
    status, error = f3amd("a person walks ArmsCrossed", "--seconds", "1.2")
    assert status == 2 and "exists already; pass --overwrite" in error
    for seed in ("-1", str(2**32)):  # the noise of another seed
        status, error = f3amd("a person walks ArmsCrossed", "--seconds", "1.2", "--seed", seed)
        assert status == 2 and "seed must be a whole number from 0" in error
    assert [file.read_bytes() for file in files] == before


@pytest.mark.slow
def test_text_takes_a_control(f3amd, tmp_path):
    path = tmp_path / "path.csv"
    path.write_text("frame,x,y,z\n0,0,1,0\n23,0,1,1\n")
    words = ("a person walks", "--seconds", "1.2", "--control", str(path), "--joint", "left_wrist")
    assert f3amd(*words, model="tiny+control") == (0, "")


@pytest.mark.slow
def test_text_streams_captions(f3amd, tmp_path):
    words = ("a person walks ArmsCrossed", "--then", "a person walks ArmsCrossed", "--seconds", "1")
    assert f3amd(*words, model="tiny-prefix") == (0, "")
    motion = read_bvh(next((tmp_path / "out").glob("*.bvh")))
    assert motion.num_frames == 12 + 2 * 20  # a window adds 5 frames of the latent


CONTROL = ("a person walks", "--seconds", "1.2", "--control", "CSV")


@pytest.mark.slow
@pytest.mark.parametrize(
    "words, model, csv, wanted",
    [
        (("a person wallks",), "tiny", None, "the model never saw 'wallks'; did you mean 'walks'?"),
        (("a person walks", "--seconds", "9"), "tiny", None, "--seconds must be between 1.2 and 2 for tiny, got 9"),
        (("a person walks", "--then", "a person walks", "--control", "x.csv"), "tiny", None, "leave out --then"),
        (CONTROL, "tiny+control", "frame,x,y,z\n", "needs at least one row"),
        (CONTROL, "tiny+control", "frame,x,y,z\n0,0,1,0\n24,0,1,0\n", "line 3: frame 24 is not one of the clip's"),
        (CONTROL, "tiny+control", "frame,x,y,z\n3,0,1,0\n3,0,1,0\n", "line 3: frame 3 occurs twice"),
        ((*CONTROL, "--joint", "left_wirst"), "tiny+control", "frame,x,y,z\n3,0,1,0\n", "did you mean 'left_wrist'?"),
    ],
)
def test_text_refuses_in_one_line_what_it_cannot_do(f3amd, tmp_path, words, model, csv, wanted):
    path = tmp_path / "path.csv"
    if csv is not None:
        path.write_text(csv)
    status, error = f3amd(*(str(path) if word == "CSV" else word for word in words), model=model)
    assert status == 2 and error.count("\n") == 1
    assert wanted.replace("CSV", str(path)) in error
    assert not (tmp_path / "out").exists()
