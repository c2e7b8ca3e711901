"""MotionPCM's models as files, and their training by name, one stage after the other."""

import dataclasses
import types
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from builders import refused, same_tree
from test_text_judge import OneVectorAWord

from f3amd_companion import __main__ as command_line
from f3amd_lib.diffusion.schedules import variance_preserving_betas
from f3amd_lib.ground.profiles import load_profile
from f3amd_lib.ground.records import read_table
from f3amd_lib.motion import synthetic
from f3amd_lib.motion.skeleton import resample
from f3amd_lib.networks import presets
from f3amd_lib.networks.presets import Preset
from f3amd_lib.text.data.text_encoders import embed_captions, load_text_encoder
from f3amd_lib.text.data.text_motions import text_motions
from f3amd_lib.text.sampling import captioned_motion, motionpcm_sampling
from f3amd_lib.text.sampling.motionpcm_sampling import (
    guidance_of,
    latent_motions,
    sample_latent_student,
    sample_student,
    sample_teacher,
    steps_of,
)
from f3amd_lib.text.stages import text_models, train_stage
from f3amd_lib.text.stages.motionpcm_training import frame_statistics
from f3amd_lib.training import optimise
from f3amd_lib.training.checkpoints import network_with
from f3amd_lib.training.pipeline import PRETRAINED_DIR

SIZES = {"window": 2, "channels": 3, "latent_width": 16, "depth": 3, "num_heads": 2, "hidden_width": 16}
SMALL = {**SIZES, "time_features": 8}
VP = variance_preserving_betas()
TINY = {
    "tiny-VAE": Preset(
        "tiny-VAE", "motionpcm", "latent autoencoder", VP, {**SIZES, "released_facing": True}, {}, "ours"
    ),
    "tiny-teacher": Preset(
        "tiny-teacher", "motionpcm", "latent denoiser", VP, SMALL, {}, "ours", latent="tiny-VAE"
    ),
    "tiny-M2": Preset(
        "tiny-M2", "motionpcm", "latent denoiser", VP, {**SMALL, "guidance_features": 256},
        {"num_phases": 2, "num_frames": 40}, "ours", latent="tiny-VAE",
    ),
}  # fmt: skip
PROFILE = load_profile("smoke", "bandai", train_steps=20)
SPLITS = ("train", "test", "train", "validation")
QUIET = {"progress": False, "batch_size": 2}


def test_motionpcms_files_are_not_taken_for_acmdms(tmp_path, monkeypatch):
    monkeypatch.setattr(text_models, "runs_dir", lambda *_: tmp_path)
    (tmp_path / "text").mkdir()
    for name in ("ACMDM-S-PS22-raw-n3", "MotionPCM-M1-small", "MotionPCM-VAE-small"):  # the newest comes last
        (tmp_path / "text" / f"{name}.safetensors").touch()
    assert text_models.find_text_model("bandai").name == "ACMDM-S-PS22-raw-n3.safetensors"
    monkeypatch.setattr(text_models, "text_model_folders", lambda _: [tmp_path / "none", tmp_path / "text"])
    for asked in ("motionpcm", "MotionPCM-M1-small"):
        assert text_models.find_text_model("bandai", asked) == tmp_path / "text" / "MotionPCM-M1-small.safetensors"
    message = "no trained MotionPCM-M4-small .* f3amd train --preset MotionPCM-M4-small"
    refused(message, text_models.find_text_model, "bandai", "MotionPCM-M4-small")
    # A student is trained for one number of steps: the steps that are asked for choose it.
    for steps, wanted in ((None, "M1"), (1, "M1"), (2, "M2"), (4, "M4")):
        name = text_models.named_model("MotionPCM", steps)
        assert name == f"MotionPCM-{wanted}-small"
        assert presets.find_preset(name).training.get("num_phases", 1) == (steps or 1)
    assert text_models.named_model("MotionPCM-M1-small", 4) == "MotionPCM-M1-small"
    refused("no trained MotionPCM-M2-small", text_models.find_text_model, "bandai", "motionpcm", num_steps=2)
    for steps in (3, 50):
        message = f"for 1, 2 or 4 steps, none for {steps}; .* MotionPCM-teacher-small"
        refused(message, text_models.find_text_model, "bandai", "motionpcm", num_steps=steps)
    assert text_models.is_latent_preset("MotionPCM (1-step)") and not text_models.is_latent_preset("ACMDM-S-PS22")


SHIPPED = PRETRAINED_DIR / "bandai" / "text"


@pytest.mark.slow
def test_the_command_asks_the_shipped_student_once_with_its_own_weights_key_and_guidance(tmp_path, monkeypatch):
    """`f3amd text ... --model motionpcm --steps 1`: the caption alone to one jump from level 999 to 0."""
    monkeypatch.setattr(text_models, "text_model_folders", lambda _: [SHIPPED])
    made, asked = [], []

    def written(targets, scene, trained):
        made.append((trained.name, scene.characters[0].motion))

    def follow(predict, schedule, noise, times):
        asked.append((noise.shape, list(times)))
        return real(predict, schedule, noise, times)

    real = motionpcm_sampling.phases.follow
    monkeypatch.setattr(command_line, "_write_shown", written)
    monkeypatch.setattr(motionpcm_sampling.phases, "follow", follow)
    words = ["text", "a person raises the left hand", "--seconds", "1.2", "--seed", "3", "--out", str(tmp_path)]
    assert command_line.main([*words, "--model", "motionpcm", "--steps", "1"]) == 0
    ((name, motion),), ((shape, times),) = made, asked
    assert (name, shape, times) == ("MotionPCM-M1-small", (1, 16, 32), [999, 0])
    student = text_models.load_text_model(SHIPPED / "MotionPCM-M1-small.safetensors")
    pooled = embed_captions(["a person raises the left hand"], load_text_encoder()).pooled
    drawn = lambda guidance: latent_motions(student, pooled, 24, jax.random.key(3), guidance=guidance)[0]
    wanted, other = (captioned_motion.as_shown(student.skeleton, drawn(w), student.fps) for w in (14.0, 5.0))
    # Joints are moved a little, so that bones keep their lengths.
    away = np.abs(motion.positions - wanted).mean()
    assert away < 0.03 and np.abs(motion.positions - other).mean() > 1.5 * away
    # The file itself says whose it is.
    assert command_line.main([*words, "--weights", str(SHIPPED / "MotionPCM-M1-small.safetensors")]) == 0
    np.testing.assert_array_equal(made[1][1].positions, motion.positions)


def test_a_student_is_told_no_guidance_that_it_has_never_heard():
    files = (SHIPPED / f"MotionPCM-{name}-small.safetensors" for name in ("M1", "teacher"))
    student, teacher = map(text_models.load_text_model, files)
    assert [guidance_of(student, 1, w) for w in (None, 5.0, 15.0)] == [14.0, 5.0, 15.0]
    assert [guidance_of(teacher, 50, w) for w in (None, 0.0, 20.0)] == [6.5, 0.0, 20.0]
    told = {**student.record["identity"]["training"], "consistency": "latent"}
    latent = dataclasses.replace(student, record={"identity": {"training": told}})
    assert [guidance_of(latent, steps) for steps in (1, 2, 4)] == [7.0, 11.5, 12.5]
    for w in (0.0, 4.9, 15.1):
        message, text = "MotionPCM-M1-small was trained with a guidance of 5 to 15, got", np.zeros((1, 256), np.float32)
        refused(message, latent_motions, student, text, 24, jax.random.key(0), guidance=w)


@pytest.fixture
def data(tmp_path, monkeypatch):
    """Four clips of the walker, two of them to train on, and the tiny presets."""
    monkeypatch.setenv("F3AMD_CACHE_DIR", str(tmp_path / "cache"))
    for name, preset in TINY.items():
        monkeypatch.setitem(presets.PRESETS, name, preset)
    clips = []
    for seed in range(4):
        motion = resample(synthetic.synthesize(synthetic.STYLES[0], seconds=2.0, seed=seed), 20.0).slice(0, 40)
        clips.append((f"clip_{seed}", motion, (f"a person walks {seed}",), SPLITS[seed], str(seed)))
    return text_motions(clips, skeleton=motion.skeleton, name="bandai", fps=20.0, licence="ours", credit="nobody")


def test_each_stage_sees_training_clips_alone_and_keeps_the_weights_that_are_used(data, tmp_path, monkeypatch):
    """A loop that trains nothing: weights of ones, whose moving average is twos."""
    tasks = {}

    def loop(task, files, record, *, held_out, **leg):
        tasks[task.name] = task
        watched.append(held_out)
        params = jax.tree.map(jnp.ones_like, jax.eval_shape(lambda: task.init(jax.random.key(0))[0]))
        average = jax.tree.map(lambda leaf: 2.0 * leaf, params)
        return types.SimpleNamespace(step=task.config.num_steps, params=params, averaged=average), []

    monkeypatch.setattr(train_stage, "train_in_legs", loop)
    watched = []
    student = train_stage.train_stage(data, OneVectorAWord(), PROFILE, "tiny-M2", folder=tmp_path, **QUIET)
    teacher = text_models.load_text_model(text_models.text_model_files(PROFILE, "tiny-teacher", folder=tmp_path).model)
    ones, twos = (lambda tree, value=value: all((leaf == value).all() for leaf in jax.tree.leaves(tree))
                  for value in (1.0, 2.0))  # fmt: skip
    # The student's moving average is its target and no more; of the others the average is what is used.
    assert ones(student.params) and twos(teacher.params) and twos(student.autoencoder_params)
    assert twos(tasks["student"].teacher)
    assert tasks["latent autoencoder"].clips.length.tolist() == [40, 40]
    for name in ("latent teacher", "student"):
        assert tasks[name].clips.count.tolist() == [1, 1]
        wanted = OneVectorAWord()(["a person walks 0", "a person walks 2"]).pooled
        np.testing.assert_allclose(tasks[name].clips.pooled, wanted, atol=1e-6)
        np.testing.assert_array_equal(tasks[name].clips.empty, np.ones(8))
    # Losses are watched on the one validation clip; recipes' shares of the 20 steps arrive.
    statistics = frame_statistics(data)
    (frames, mask), *others = watched
    assert mask.sum() == 40 * len(mask)
    (validation,) = data.members("validation")
    clip = statistics.normalise(data.select([validation]).redundant_vectors())
    for motion in frames:
        np.testing.assert_allclose(motion[:40], clip, atol=1e-4)
    wanted = OneVectorAWord()(data.captions[validation]).pooled
    for _, captions in others:
        np.testing.assert_allclose(captions, np.broadcast_to(wanted, captions.shape), atol=1e-6)
    assert [tasks[name].config.num_steps for name in ("latent autoencoder", "latent teacher", "student")] == [5, 20, 3]
    assert student.words == ("a", "person", "walks")
    for kept in (student.statistics, teacher.statistics):
        np.testing.assert_allclose(kept.mean, statistics.mean, atol=1e-6)


@pytest.mark.slow
def test_a_teacher_is_guided_away_from_what_its_encoder_makes_of_no_words(data, tmp_path, monkeypatch):
    def loop(task, *rest, **leg):
        return types.SimpleNamespace(step=task.config.num_steps, averaged=optimise.initial_state(task).params), []

    monkeypatch.setattr(train_stage, "train_in_legs", loop)
    made = train_stage.train_stage(data, OneVectorAWord(), PROFILE, "tiny-teacher", folder=tmp_path, **QUIET)
    again = text_models.load_text_model(text_models.text_model_files(PROFILE, "tiny-teacher", folder=tmp_path).model)
    network, text, noise = made.network(), np.full((1, 8), 0.5), jax.random.normal(jax.random.key(0), (1, 2, 3))
    network.output.kernel[...] = jax.random.normal(jax.random.key(1), network.output.kernel.shape)
    walk = lambda empty: sample_teacher(network, made.schedule, text, empty, noise, num_steps=2)
    by_hand, zeros = walk(np.ones(8)), walk(np.zeros(8))
    for model in (made, again):
        walked = motionpcm_sampling.latent_walk(model, 2)(network, text, noise, None)
        np.testing.assert_array_equal(walked, by_hand)
    assert np.abs(by_hand - zeros).max() > 1e-3


@pytest.mark.slow
def test_a_student_is_trained_by_name_with_all_before_it(data, tmp_path, monkeypatch):
    made = train_stage.train_stage(data, OneVectorAWord(), PROFILE, "tiny-M2", folder=tmp_path, **QUIET)
    files = {name: text_models.text_model_files(PROFILE, name, folder=tmp_path).model for name in TINY}
    teacher, student = (text_models.load_text_model(files[name]) for name in ("tiny-teacher", "tiny-M2"))
    assert text_models.load_text_model(files["tiny-VAE"]).config is None
    assert made.text_encoder == OneVectorAWord.identity
    assert all(same_tree(model.autoencoder_params, made.autoencoder_params) for model in (teacher, student))
    assert (teacher.config.guidance_features, student.config.guidance_features) == (0, 256)
    assert student.record["identity"]["training"]["num_phases"] == 2
    # Held-out losses of each stage lie in its history, the discriminator's among the student's.
    for name, term in (("tiny-VAE", "joints"), ("tiny-teacher", "loss"), ("tiny-M2", "discriminator")):
        history, _ = read_table(text_models.text_model_files(PROFILE, name, folder=tmp_path).history)
        assert np.isfinite(history[f"held_out_{term}"].dropna()).all() and history[f"held_out_{term}"].notna().any()
    # The same student from the teacher's file alone, where nothing else lies; other files are refused.
    elsewhere = tmp_path / "elsewhere"
    from_file = partial(train_stage.train_stage, data, OneVectorAWord(), PROFILE, folder=elsewhere, **QUIET)
    alone = from_file("tiny-M2", teacher=files["tiny-teacher"])
    assert same_tree(alone.params, made.params)
    assert sorted(path.name.split(".")[0] for path in elsewhere.glob("*.safetensors")) == ["tiny-M2"] * 2
    beneath = from_file("tiny-teacher", teacher=files["tiny-teacher"])  # on the autoencoder that its file holds
    assert same_tree([beneath.autoencoder_params, beneath.params], [teacher.autoencoder_params, teacher.params])
    for name, file, reason in (
        ("tiny-VAE", "tiny-teacher", "tiny-VAE needs no earlier model"),
        ("tiny-VAE", "tiny-VAE", "tiny-VAE needs no earlier model"),
        ("tiny-M2", "tiny-VAE", "holds tiny-VAE, and tiny-M2 needs tiny-teacher"),
    ):
        refused(reason, from_file, name, teacher=files[file])
    others = data.select(np.arange(len(data.captions) - 1)), OneVectorAWord(), PROFILE, "tiny-M2"
    refused("trained on other clips", train_stage.train_stage, *others, teacher=files["tiny-teacher"])
    # Each model walks in its own steps.
    text, key = embed_captions(["a person walks forward"], OneVectorAWord()).pooled, jax.random.key(PROFILE.seed)
    start = jax.random.normal(key, (1, 2, 3))
    of_student = [network_with(student.config, student.params), student.schedule, text]
    of_teacher = [network_with(teacher.config, teacher.params), teacher.schedule, text, np.ones(text.shape[-1])]
    own = sample_student(*of_student, start, num_steps=2, skip=student.training["skip"])
    for model, latent in ((student, own), (teacher, sample_teacher(*of_teacher, start))):
        walk = motionpcm_sampling.latent_walk(model)(network_with(model.config, model.params), text, start, key)
        np.testing.assert_allclose(walk, latent, rtol=1e-4, atol=1e-6)
    lcm = sample_latent_student(*of_student, start, key, guidance=14.0)
    assert np.abs(lcm - own).max() > 1e-3  # MotionLCM's walk is another
    # Finished models are read, and other settings are refused by name.
    again = train_stage.train_stage(data, OneVectorAWord(), PROFILE, "tiny-M2", folder=tmp_path, **QUIET)
    assert same_tree(again.params, made.params)
    other = data, OneVectorAWord(), PROFILE, "tiny-VAE"
    message = r"other training settings \(batch_size\) lies there"
    refused(message, train_stage.train_stage, *other, folder=tmp_path, **QUIET | {"batch_size": 1})
    # The same by the one door: captions and lengths in, metres out, zero in padding; the steps that each may take.
    key, text = jax.random.key(1), np.zeros((2, 8), np.float32)
    draw = lambda model, **how: latent_motions(model, text, [12, 8], key, **how)
    first = draw(made)
    assert first.shape == (2, 12, data.skeleton.num_joints, 3) and not first[1, 8:].any() and first[0].any()
    np.testing.assert_array_equal(first, latent_motions(made, text, [12, 8], key, num_steps=2, guidance=14.0))
    assert steps_of(teacher) == 50 and steps_of(teacher, 3) == 3
    assert not np.array_equal(draw(teacher, num_steps=1), draw(teacher, num_steps=3))
    refused("tiny-M2 takes 2 steps, got 1", draw, made, num_steps=1)
    refused("is an autoencoder alone", draw, text_models.load_text_model(files["tiny-VAE"]))
    refused("makes up to 40 frames, got 44", latent_motions, made, text, 44, key)
