"""Files that are forged, oversized or absurd: one sentence that names the file, and no harm."""

from __future__ import annotations

import json
import zipfile

import jax.numpy as jnp
import numpy as np
import pytest
from builders import refused, tiny_packed, tiny_trained, wandering_motion

from f3amd_companion.measuring.campaign import Run, queue
from f3amd_companion.serving.artefact import read_manifest
from f3amd_companion.serving.crowd import _open_rows
from f3amd_lib.data import sources
from f3amd_lib.data.packed import load_packed, save_packed
from f3amd_lib.data.sources import open_dataset
from f3amd_lib.ground.names import checked_seed
from f3amd_lib.ground.profiles import load_profile
from f3amd_lib.ground.trees import describe, load_tree, save_tree
from f3amd_lib.measures.metrics import camdm_metrics, camdm_orientation_error
from f3amd_lib.motion.bvh import format_bvh, parse_bvh
from f3amd_lib.motion.plausible import as_person
from f3amd_lib.motion.root_paths import named_path, read_path_csv
from f3amd_lib.motion.skeleton import Skeleton, facing_yaw
from f3amd_lib.rollout.rollout import MOST_STEPS, MotionGenerator
from f3amd_lib.text.sampling.captioned_motion import read_control_csv
from f3amd_lib.training.checkpoints import load_model
from f3amd_lib.training.recipe import TrainingConfig

TEXT = format_bvh(wandering_motion(3))


@pytest.mark.parametrize(
    ("old", "new", "line"),
    [
        ("Frames: 3", "Frames: " + "9" * 5000, r"line \d+: Frames"),
        ("CHANNELS 6", "CHANNELS " + "9" * 5000, r"line \d+: joint 'Hips' says it has 9"),
        ("Frame Time: 0.0333333333", "Frame Time: 1e-320", r"line \d+: Frame Time"),
        ("Frame Time: 0.0333333333", "Frame Time: 1e300", r"line \d+: Frame Time"),
        ("OFFSET 0.000000", "OFFSET 1e200", r"line \d+: OFFSET"),
    ],
)
def test_absurd_bvh_is_refused_with_its_line(old, new, line):
    assert old in TEXT
    refused(f"walk.bvh, {line}", parse_bvh, TEXT.replace(old, new, 1), "walk.bvh")


@pytest.mark.parametrize("scale", [0.0, -1.0, np.nan, np.inf])
def test_a_scale_that_makes_no_body_is_refused(scale):
    refused("scale must be", as_person, parse_bvh(TEXT, "walk.bvh"), scale=scale)


@pytest.mark.parametrize(
    ("rows", "match"),
    [
        ("0,0\n1e9,0\n", "line 3: x is '1e9'"),
        ("0,0\n0,1e9\n", "line 3: z is '1e9'"),
        ("0,0\n" + "1" * 200_000 + ",0\n", "line 3: not a row of a table"),
        ('0,0\n"' + "1" * 900 + "\n" + "1" * 900 + '",0\n', "line 3"),
        ("0,0\n" * 108_001, "line 108002: more than 108000 rows"),
    ],
)
def test_absurd_paths_are_refused_before_anything_is_made(tmp_path, rows, match):
    file = tmp_path / "path.csv"
    file.write_text(f"x,z\n{rows}")
    refused(f"path.csv: {match}", read_path_csv, file)


def test_seeds_that_would_give_others_noise_and_endless_steps_are_refused():
    assert checked_seed(np.int64(7)) == 7 and checked_seed(2**32 - 1) == 2**32 - 1
    for seed in (-1, 2**32, 2**63, 1.5, True, "1"):
        refused("seed must be", checked_seed, seed)
    refused("seed must be", named_path, "complex", 10, seed=2**32)
    refused("seed must be", load_profile, "smoke", "synthetic", seed=-1)
    refused("seed must be", TrainingConfig, num_steps=1, batch_size=1, seed=2**32)
    generator = MotionGenerator(tiny_trained(), num_steps=1)
    refused("seed must be", generator.rollout, named_path("straight", 8), "calm", seed=-1)
    refused("num_steps must be at most", MotionGenerator, tiny_trained(), MOST_STEPS + 1)


# ------------------------------------------------------------------------------------------ archives


def _zip(path, content: bytes, name="walk/a.bvh"):
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as file:
        file.writestr(name, content)
    return path


def test_a_zip_bomb_is_refused_before_it_is_unpacked(tmp_path, monkeypatch):
    path = _zip(tmp_path / "bomb.zip", b"0" * 30_000_000)
    monkeypatch.setattr(zipfile.ZipFile, "read", lambda *args: pytest.fail("unpacked"))
    refused("bomb.zip: refused before anything was unpacked", open_dataset, "folder", path=path)


@pytest.mark.parametrize("limit", ["_MOST_FILES", "_MOST_BYTES", "_MOST_IN_ALL"])
def test_too_many_too_large_and_too_much_are_refused(tmp_path, monkeypatch, limit):
    path = _zip(tmp_path / f"{limit}.zip", TEXT.encode())
    monkeypatch.setattr(sources, limit, 0)
    refused("refused before anything was unpacked", open_dataset, "folder", path=path)


@pytest.mark.parametrize("name", ["", ".", "./"])
def test_a_member_without_a_name_is_no_file(tmp_path, name):
    path = _zip(tmp_path / "forged.zip", TEXT.encode())
    known = [clip.name for clip in open_dataset("folder", path=path).clips]
    with zipfile.ZipFile(path, "a") as file:
        member = zipfile.ZipInfo("forged")
        member.filename = name
        file.writestr(member, b"nobody's")
    assert [clip.name for clip in open_dataset("folder", path=path).clips] == known


# -------------------------------------------------------------------------------- caches and weights


def test_a_cache_with_flipped_bytes_is_refused_by_name(tmp_path):
    path = save_packed(tmp_path / "cache.safetensors", tiny_packed())
    sound = path.read_bytes()
    rng = np.random.default_rng(0)
    for _ in range(150):
        data = bytearray(sound)
        for place in rng.integers(0, len(data), rng.integers(1, 9)):
            data[place] ^= rng.integers(1, 256)
        path.write_bytes(data)
        try:
            assert load_packed(path).num_clips == tiny_packed().num_clips
        except ValueError as error:
            assert str(path) in str(error)


@pytest.mark.parametrize(
    "forged",
    [[], 3, "text", {"kind": "trained model", "model": []}, {"kind": "trained model", "model": {"family": 4}}]
    + [{"kind": "trained model", "model": {"family": "f3amd"}, "diffusion": [1]}, {"kind": None}],
)
def test_forged_descriptions_are_refused_by_name(tmp_path, forged):
    path = tmp_path / "forged.safetensors"
    save_tree(path, {"a": jnp.ones(2)}, forged)
    refused("forged.safetensors", load_model, path)


def test_descriptions_nested_deeper_than_python_reads_are_refused_by_name(tmp_path, monkeypatch):
    path = tmp_path / "deep.safetensors"
    monkeypatch.setattr(json, "dumps", lambda value: "[" * 100_000)
    save_tree(path, {"a": jnp.ones(2)}, {})
    refused("deep.safetensors", describe, path)
    refused("deep.safetensors", load_tree, path, {"a": jnp.ones(2)})


# ------------------------------------------------------------------------- finds of the fuzz


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (b"[[run]]\nwindows = [", "Invalid value|Unclosed array"),
        (b"[[run]]\nwindows = [1] # \xbc", "'utf-8' codec"),
        (b"seeds = [" + b"[" * 3000, "recursion"),
        (b"[[run]]\nwindows = [" + b"9" * 5000 + b"]", "5000 digits"),
        (b"[[runs]]\nwindows = [1]", "has no 'run'"),
        (b"[[run]]\nseeds = [1]", "run 1: has no 'windows'"),
        (b"[[run]]\nwindow = 32\nwindowss = [1]\nwindows = [1]", "unknown key 'windowss'; did you mean 'windows'"),
        (b"[[run]]\nwindows = 2e2", "windows of run 1 must be a list, got 200.0"),
        (b"[[run]]\nwindows = [1]\nseeds = [-1]", "seeds of run 1 must be 0 or more, got -1"),
        (b"[[run]]\nwindows = [1]\nwindow = [32]", "window of run 1 must be a whole number or None"),
        (b'[[run]]\nwindows = [1]\npresets = ["F3AMD-FNO-33"]', "unknown model 'F3AMD-FNO-33'"),
        (b'run = 3', "garbles"),
    ],
)  # fmt: skip
def test_a_broken_queue_is_refused_by_file_and_run(tmp_path, text, message):
    path = tmp_path / "queue.toml"
    path.write_bytes(text)
    refused(rf"(?s)queue\.toml: .*({message})", queue, path)
    path.write_text('[[run]]\npresets = ["F3AMD-FNO-32"]\nseeds = [0, 3]\nwindow = 64\nwindows = [2]\n')
    assert queue(path) == [(Run("F3AMD-FNO-32", window=64, seed=seed), 2000) for seed in (0, 3)]


def test_a_control_that_is_no_text_or_one_endless_cell_is_refused_by_line(tmp_path):
    path = tmp_path / "control.csv"
    path.write_bytes(b"frame,x,y,z\n0,0,1,\xd3\n")
    refused(r"control\.csv: not a text file \(byte 18 is not UTF-8\)", read_control_csv, path, 40)
    path.write_text("frame,x,y,z\n0,0,1," + "9" * 200_000 + "\n")  # more than Python's reader of CSV takes
    refused(r"control\.csv: line 2: not a row of a table", read_control_csv, path, 40)
    path.write_text('"frame","x","y","z"\n\n3,"0.5",1,2\n')
    frames, points = read_control_csv(path, 40)
    assert frames.tolist() == [3] and points.tolist() == [[0.5, 1.0, 2.0]]


def test_a_manifest_nested_deeper_than_python_reads_is_refused_by_name(tmp_path):
    (tmp_path / "manifest.json").write_text("[" * 100_000)
    refused(r"manifest\.json: not readable as JSON", read_manifest, tmp_path)


def test_an_array_of_a_crowd_with_a_damaged_head_is_refused_by_name(tmp_path):
    """numpy hands the head to Python's tokenizer, whose errors are of a kind of their own."""
    path = tmp_path / "crowd.npy"
    np.save(path, np.zeros((3, 40, 3), "<f4"))
    path.write_bytes(path.read_bytes().replace(b"(3, 40, 3), }", b"(3, 40, 3)(  "))
    settings = {"num_characters": 3, "num_frames": 40, "joints": ["a"]}
    refused(r"crowd\.npy: is not a whole array", _open_rows, tmp_path, settings)


# ------------------------------------------------------------------------- CAMDM's own orientation


def _with_collars(turned: float):
    """A figure that stands with its hips along +X and its collar bones turned by some radians."""
    names = ("Hips", "LeftUpLeg", "RightUpLeg", "left_collar", "right_collar", "LeftToeBase", "RightToeBase")
    skeleton = Skeleton(names, (-1, 0, 0, 0, 0, 1, 2), np.zeros((7, 3)))
    across = np.array([np.cos(turned), 0.0, -np.sin(turned)])
    body = [[0, 1, 0], [0.1, 1, 0], [-0.1, 1, 0], 0.2 * across + [0, 1.5, 0], -0.2 * across + [0, 1.5, 0]]
    positions = np.tile(np.array([*body, [0.1, 0, 0], [-0.1, 0, 0]], float), (20, 1, 1))
    return skeleton, positions + np.arange(20)[:, None, None] * [0.0, 0.0, 0.04]


def test_camdms_orientation_error_sees_the_shoulders_as_its_code_does():
    skeleton, positions = _with_collars(0.8)
    path = named_path("straight", 20)
    assert facing_yaw(skeleton, positions) == pytest.approx(0.0)
    assert facing_yaw(skeleton, positions, shoulders=True) == pytest.approx(0.4)
    measured = camdm_metrics(positions, path, skeleton)["camdm_orientation_error_deg"]
    assert measured == pytest.approx(np.rad2deg(0.4))
    assert camdm_orientation_error(np.zeros(20), path) == pytest.approx(0.0)


def test_a_single_file_is_no_data_set(tmp_path, monkeypatch):
    file = tmp_path / "walk.bvh"
    file.write_text(TEXT)
    monkeypatch.setenv(sources.DATA_DIR_VARIABLE, str(file))
    for name in ("folder", "bandai"):
        refused("walk.bvh: is a single file; give its folder", open_dataset, name)
