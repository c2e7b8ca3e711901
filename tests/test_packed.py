"""The packed cache: what goes in comes out, and a damaged file is refused."""

import dataclasses

import numpy as np
import pytest
from builders import refused
from test_skeleton import legs

from f3amd_lib.data import packed as packed_module
from f3amd_lib.data.packed import PackedMotion, cache_path, load_packed, pack, packed_dataset, save_packed
from f3amd_lib.data.sources import SPLITS, Clip, Dataset
from f3amd_lib.ground.trees import describe
from f3amd_lib.motion.rotations import matrix_from_euler
from f3amd_lib.motion.skeleton import Motion, Skeleton

LEGS = legs(end_sites=((2, (0.0, 0.0, 0.1)),))


def legs_motion(frames: int, seed: int, skeleton: Skeleton = LEGS) -> Motion:
    random = np.random.default_rng(seed)
    angles = random.uniform(-30, 30, size=(frames, skeleton.num_joints, 3))
    angles[:, 0] = 0.0
    root = np.array([10.0, 0.95, -10.0]) + random.normal(size=(frames, 3)) * [1.0, 0.01, 1.0]
    return Motion(skeleton, root, matrix_from_euler("ZXY", angles), 30.0)


def make_dataset(motions: dict[str, Motion], fingerprint: str = "ab" * 32) -> Dataset:
    clips = tuple(
        Clip(name, name.split("_")[0], "walk", SPLITS[k % 3], lambda motion=motion: motion)
        for k, (name, motion) in enumerate(motions.items())
    )
    styles = tuple(sorted({clip.style for clip in clips}))
    about = {"licence": "CC0", "credit": "Motion data: nobody.", "fingerprint": fingerprint}
    told = {"primary_styles": styles[:1], "mirror_styles": frozenset(styles[-1:])}
    return Dataset(name="handmade", styles=styles, clips=clips, **about, **told)


@pytest.fixture
def motions() -> dict[str, Motion]:
    frames = {"sad_1": 42, "happy_1": 60, "sad_2": 41, "sad_é": 50}
    return {name: legs_motion(count, seed) for seed, (name, count) in enumerate(frames.items())}


@pytest.fixture
def packed(motions) -> PackedMotion:
    return pack(make_dataset(motions), progress=False)


def assert_same(first: PackedMotion, second: PackedMotion):
    for field in dataclasses.fields(PackedMotion):
        before, after = getattr(first, field.name), getattr(second, field.name)
        if isinstance(before, np.ndarray):
            assert before.dtype == after.dtype, field.name
            np.testing.assert_array_equal(before, after, err_msg=field.name)
        else:
            assert before == after, field.name
    np.testing.assert_array_equal(first.skeleton.offsets, second.skeleton.offsets)
    assert first.skeleton.end_sites == second.skeleton.end_sites


def test_pack_keeps_clips_labels_and_order(packed, motions):
    assert packed.clip_names == ("sad_1", "happy_1", "sad_é")
    assert packed.clip_contents == ("walk",) * 3
    assert packed.styles == ("happy", "sad")
    np.testing.assert_array_equal(packed.clip_start, [0, 42, 102, 152])
    np.testing.assert_array_equal(packed.clip_style, [1, 0, 1])
    np.testing.assert_array_equal(packed.clip_split, [0, 1, 0])
    assert packed.skipped == (("sad_2", "41 frames, shorter than 42"),)
    assert (packed.primary_styles, packed.mirror_styles) == (("happy",), {"sad"})
    assert (packed.num_clips, packed.num_frames) == (3, 152)
    assert packed.root_position.dtype == np.float32
    assert packed.rotation_6d.dtype == np.float16 and packed.rotation_6d.shape == (152, 5, 6)


def test_packed_motion_is_the_motion(packed, motions):
    for clip, name in enumerate(packed.clip_names):
        motion, original = packed.motion(clip), motions[name]
        assert (motion.name, motion.fps) == (name, 30.0)
        np.testing.assert_allclose(motion.root_position, original.root_position, atol=1e-6)
        # A float16 below 1 is good to 2.5e-4; bones are under 1 m long.
        np.testing.assert_allclose(motion.positions, original.positions, atol=2e-3)
        square = motion.rotations @ np.swapaxes(motion.rotations, -1, -2)
        np.testing.assert_allclose(square, np.broadcast_to(np.eye(3), square.shape), atol=1e-7)
        lowest = original.positions[:, [2, 4], 1].min()
        assert packed.floor_shift[clip] == pytest.approx(lowest, abs=1e-6)


def test_save_and_load(packed, tmp_path):
    path = save_packed(tmp_path / "deep" / "handmade.safetensors", packed)
    assert_same(packed, load_packed(path))
    assert [item.name for item in path.parent.iterdir()] == ["handmade.safetensors"]


@pytest.mark.parametrize("share", [0.0, 0.2, 0.9, 0.999])
def test_truncated_files_are_refused(packed, tmp_path, share):
    path = save_packed(tmp_path / "a.safetensors", packed)
    data = path.read_bytes()
    path.write_bytes(data[: int(share * len(data))])
    refused(r"a\.safetensors: not a whole safetensors file", load_packed, path)


def test_flipped_bits_and_altered_words_are_refused(packed, tmp_path):
    path = save_packed(tmp_path / "a.safetensors", packed)
    data = path.read_bytes()
    middle = len(data) // 2
    for altered in (data.replace(b"CC0", b"CC1"), data[:middle] + bytes([data[middle] ^ 0x55]) + data[middle + 1 :]):
        path.write_bytes(altered)
        refused(r"a\.safetensors: .*checksum", load_packed, path)


def test_one_skeleton_for_all(motions):
    longer = dataclasses.replace(LEGS, offsets=LEGS.offsets * 1.1)
    motions["sad_long"] = legs_motion(50, 4, longer)
    refused("sad_long: its skeleton differs from that of sad_1", pack, make_dataset(motions), progress=False)


def test_nothing_but_short_clips_is_an_error():
    with pytest.raises(ValueError, match="'handmade' has no clip of at least 42 frames; 1 are left out"):
        pack(make_dataset({"sad_1": legs_motion(41, 0)}), progress=False)


def test_the_cache_is_used_and_keyed_by_content(motions, cache_dir, monkeypatch):
    dataset = make_dataset(motions)
    first = packed_dataset(dataset, progress=False)
    assert [item.name for item in cache_dir.iterdir()] == [cache_path(dataset).name]
    with monkeypatch.context() as patch:
        patch.setattr(packed_module, "pack", lambda *a, **k: pytest.fail("packed again"))
        assert_same(first, packed_dataset(dataset, progress=False))
    packed_dataset(make_dataset(motions, fingerprint="cd" * 32), progress=False)
    assert len(list(cache_dir.iterdir())) == 2


def test_a_damaged_cache_is_packed_anew(motions, cache_dir):
    dataset = make_dataset(motions)
    first = packed_dataset(dataset, progress=False)
    path = cache_path(dataset)
    path.write_bytes(path.read_bytes()[:1000])
    with pytest.warns(UserWarning, match=r"cut short or damaged.* \(packing anew\)"):
        again = packed_dataset(dataset, progress=False)
    assert_same(first, again)
    assert_same(first, load_packed(path))


@pytest.mark.slow
def test_real_bandai_packs_small(bandai_dataset, tmp_path):
    packed = pack(bandai_dataset, progress=False)
    assert (packed.num_clips, packed.num_frames) == (1063, 167_423 - 20 - 24 - 31 - 31)
    skipped = ("dash_normal_001", "run_normal_001", "walk-back_normal_001", "walk_normal_002")
    assert [name for name, _ in packed.skipped] == [f"dataset-1_{name}" for name in skipped]
    path = save_packed(tmp_path / "bandai.safetensors", packed)
    assert path.stat().st_size < 50_000_000
    again = load_packed(path)
    assert_same(packed, again)
    assert "CC BY-NC 4.0" in describe(path)["licence"]
    for style in range(len(packed.styles)):
        found = {int(split) for split in packed.clip_split[packed.clip_style == style]}
        assert found == {0, 1, 2}, packed.styles[style]
    clips = {clip.name: clip for clip in bandai_dataset.clips}
    for number in range(0, again.num_clips, 100):
        original = clips[again.clip_names[number]].load()
        error = np.linalg.norm(again.motion(number).positions - original.positions, axis=-1)
        assert error.max() < 2e-3 and error.mean() < 5e-4
