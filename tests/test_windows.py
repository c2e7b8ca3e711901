"""Windows cut on the device against plain numpy slices (sections 3.2, 3.3, 4.5)."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from builders import (
    CHANNELS,
    HISTORY,
    SKELETON,
    WINDOW,
    packed_from,
    random_frames,
    refused,
    straight_motion,
    tiny_packed,
)

from f3amd_lib.data import features
from f3amd_lib.data.windows import (
    Batch,
    build_windows,
    draw_windows,
    fit_normaliser,
    gather_windows,
    mean_poses,
    restart_from,
    sample_windows,
    spread_windows,
    starting_poses,
)
from f3amd_lib.motion.rotations import matrix_from_yaw, wrap_angle
from f3amd_lib.motion.skeleton import mirror

SPAN = WINDOW + HISTORY
SIZES = {"window": WINDOW, "num_history": HISTORY}

# Every batch here is handed on as numpy arrays, which saves compiling each test's own arithmetic.
_sample = jax.jit(sample_windows, static_argnums=2)
_fit = jax.jit(fit_normaliser)


def sample(windows, seed, size) -> Batch:
    return jax.tree.map(np.asarray, _sample(windows, jax.random.key(seed), size))


@pytest.fixture(scope="module")
def packed():
    return tiny_packed()


@pytest.fixture(scope="module")
def train(packed):
    return build_windows(packed, "train", **SIZES)


def all_windows(windows, yaw=0.0, smoothing=0) -> Batch:
    count = windows.num_windows
    batch = gather_windows(windows, jnp.arange(count), jnp.full(count, yaw), jnp.full(count, smoothing, jnp.int32))
    return jax.tree.map(np.asarray, batch)


def slices(packed, clips) -> np.ndarray:
    """Every window of some clips by plain slicing, x and z from the last history frame."""
    cut = []
    for motion in clips:
        world = features.world_frames(motion)
        for start in range(len(world) - SPAN + 1):
            window = world[start : start + SPAN].copy()
            window[:, [0, 2]] -= window[HISTORY - 1, [0, 2]]
            cut.append(window)
    return np.array(cut)


def test_section_3_2_windows_equal_numpy_slices(packed):
    windows = build_windows(packed, "train", mirrored=False, **SIZES)
    batch, expected = all_windows(windows), slices(packed, map(packed.motion, (0, 1, 3)))
    assert windows.num_windows == len(expected) == (30 + 21 + 17) - 3 * (SPAN - 1)
    np.testing.assert_allclose(batch.history, expected[:, :HISTORY], atol=1e-6)
    np.testing.assert_allclose(batch.future, expected[:, HISTORY:], atol=1e-6)
    np.testing.assert_array_equal(batch.history[:, -1, [0, 2]], 0.0)


def test_mirror_images_follow_their_clip_in_training_only(packed, train):
    # "calm" (clip 0) may be mirrored, "proud" (clips 1 and 3) may not.
    motion = packed.motion(0)
    expected = slices(packed, (motion, mirror(motion), packed.motion(1), packed.motion(3)))
    batch = all_windows(train)
    np.testing.assert_allclose(np.concatenate([batch.history, batch.future], axis=1), expected, atol=1e-6)
    held_out = build_windows(packed, "validation", **SIZES)
    np.testing.assert_allclose(all_windows(held_out).future, slices(packed, [packed.motion(2)])[:, HISTORY:], atol=1e-6)
    asked = build_windows(packed, "validation", mirrored=True, **SIZES)
    assert asked.num_windows == 2 * held_out.num_windows


def test_windows_never_straddle_two_clips(packed, train):
    lengths = [30, 30, 21, 17]
    assert train.frames.shape == (sum(lengths), CHANNELS)
    assert train.paths.shape == (3, sum(lengths), 4)
    owner = np.repeat(np.arange(4), lengths)
    first = np.asarray(train.starts)
    np.testing.assert_array_equal(owner[first], owner[first + SPAN - 1])
    assert len(set(first.tolist())) == len(first)
    np.testing.assert_array_equal(np.bincount(owner[first]), np.array(lengths) - SPAN + 1)


def test_earlier_windows_end_where_the_later_begin(packed, train):
    index = jnp.flatnonzero(train.room >= WINDOW)
    settings = index, jnp.full(len(index), 0.7), jnp.zeros(len(index), jnp.int32)
    later = gather_windows(train, *settings)
    before = gather_windows(train, *settings, earlier=WINDOW)
    # The last H frames before are the later one's history, seen from another origin.
    shared = before.future[:, -HISTORY:]
    np.testing.assert_allclose(later.history[..., 3:], shared[..., 3:], atol=1e-6)
    np.testing.assert_allclose(
        later.history[..., :3] - later.history[:, :1, :3], shared[..., :3] - shared[:, :1, :3], atol=1e-5
    )


def test_stride_takes_every_third_start(packed):
    windows = build_windows(packed, "train", mirrored=False, stride=3, **SIZES)
    np.testing.assert_array_equal(windows.starts, [0, 3, 6, 9, 12, 15, 18, 30, 33, 36, 39, 51, 54])


def test_unknown_splits_and_short_clips_are_refused(packed):
    refused("unknown split 'training'; did you mean 'train'", build_windows, packed, "training", **SIZES)
    refused("'tiny' has no test clip of at least 36 frames", build_windows, packed, "test", window=32, num_history=4)


@pytest.mark.parametrize("yaw", [-2.5, 0.9, 3.0])
def test_section_3_2_random_facing_turns_everything_alike(train, yaw):
    plain, turned = all_windows(train), all_windows(train, yaw)
    for name in ("history", "future"):
        before, after = getattr(plain, name), getattr(turned, name)
        expected = features.frame_positions(SKELETON, before) @ matrix_from_yaw(yaw).T
        np.testing.assert_allclose(features.frame_positions(SKELETON, after), expected, atol=2e-5)
        # Local rotations do not turn.
        np.testing.assert_array_equal(after[..., 9:], before[..., 9:])
    np.testing.assert_array_equal(plain.style, turned.style)


@pytest.mark.parametrize("yaw", [0.0, -2.5, 3.0])
def test_section_3_3_captured_path_is_the_future_root(train, yaw):
    batch = all_windows(train, yaw)
    expected = features.path_condition(batch.future[..., [0, 2]], features.frame_yaw(SKELETON, batch.future))
    np.testing.assert_allclose(batch.path, expected, atol=2e-5)


def test_smoothing_takes_out_the_sway_of_each_step():
    motion = straight_motion(200)
    root = motion.root_position.copy()
    root[:, 0] += 0.05 * np.sin(2 * np.pi * np.arange(200) / 30)
    windows = build_windows(packed_from([(motion.replace(root_position=root), 0, 0)]), "train", **SIZES)
    line = np.array([0.3, -0.2]) + np.arange(200)[:, None] * [0.03, 0.04]
    sway = np.abs(np.asarray(windows.paths)[:, 60:140, :2] - line[60:140]).max(axis=(1, 2))
    # A Gaussian of width w frames leaves exp(-(2 pi w / 30)^2 / 2) of a period of 30 frames.
    expected = 0.05 * np.exp(-((2 * np.pi * np.array([0, 5, 10]) / 30) ** 2) / 2)
    np.testing.assert_allclose(sway, expected, atol=5e-4)


@pytest.fixture(scope="module")
def sampled(train):
    return sample(train, 0, 512)


def test_section_3_2_facing_of_samples_is_uniform(sampled):
    yaw = np.asarray(features.frame_yaw(SKELETON, sampled.history[:, -1]))
    counts = np.histogram(yaw, bins=4, range=(-np.pi, np.pi))[0]
    assert counts.sum() == 512 and np.all((counts > 90) & (counts < 170))


def test_half_of_the_samples_show_the_captured_path(sampled):
    captured = features.path_condition(sampled.future[..., [0, 2]], features.frame_yaw(SKELETON, sampled.future))
    same = np.abs(np.asarray(sampled.path - captured)).max(axis=(1, 2)) < 1e-4
    assert 0.4 < same.mean() < 0.6


def test_what_is_drawn_of_a_window_is_drawn_by_itself(train):
    index, yaw, smoothing = (np.asarray(drawn) for drawn in draw_windows(train, jax.random.key(3), 4000, 0.2))
    assert [(smoothing == width).mean() for width in range(3)] == pytest.approx([0.2, 0.4, 0.4], abs=0.03)
    assert np.abs(np.corrcoef([index, yaw, smoothing == 0])[np.triu_indices(3, 1)]).max() < 0.05


def test_spread_windows_go_from_the_first_to_the_last(train):
    every, few = all_windows(train), spread_windows(train, 3)
    for place, index in enumerate((0, (train.num_windows - 1) // 2, train.num_windows - 1)):
        for found, wanted in zip(few, every, strict=True):
            np.testing.assert_array_equal(found[place], wanted[index])


def test_styles_stand_where_the_model_knows_them(packed):
    names = ("limping", *packed.styles[::-1])
    known, own = (build_windows(packed, "train", window=WINDOW, num_history=HISTORY, styles=of) for of in (names, ()))
    for windows, of in ((known, names), (own, packed.styles)):
        assert windows.one_hot.shape == (len(packed.styles), len(of))
        assert [of[int(place)] for place in windows.one_hot.argmax(axis=1)] == list(packed.styles)


def test_normaliser_makes_training_features_standard(train):
    normaliser = _fit(train, jax.random.key(0))
    mean, deviation = np.asarray(normaliser.mean), np.asarray(normaliser.deviation)
    assert np.all(mean[[0, 2]] == 0.0)
    assert deviation[0] == deviation[2] == pytest.approx(float(normaliser.path_scale))
    assert deviation.min() >= 0.02
    fresh = sample(train, 9, 2048)
    flat = np.asarray(normaliser.normalise(fresh.future)).reshape(-1, CHANNELS)
    # Channels that hardly move stay below 1.
    lively = deviation > 0.02
    assert np.abs(flat.mean(axis=0)).max() < 0.25
    np.testing.assert_allclose(flat.std(axis=0)[lively], 1.0, atol=0.15)


def test_bent_path_by_hand():
    path = np.array([[[1.0, 0.0], [2.0, 0.0], [3.0, 0.0], [4.0, 0.0]]])
    bent = features.bend_path(path, np.array([[0.0, 0.8]]))
    np.testing.assert_allclose(bent, [[[1.0, 0.2], [2.0, 0.4], [3.0, 0.6], [4.0, 0.8]]])


def restarted(offset):
    """Captured windows, and what they become if the whole history is off by `offset`."""
    frames = jnp.asarray(random_frames((2, SPAN)), jnp.float32)
    frames = features.center_window(frames, frames[:, HISTORY - 1, jnp.array([0, 2])])
    path = np.random.default_rng(0).standard_normal((2, WINDOW, 8)).astype(np.float32)
    batch = Batch(frames[:, :HISTORY], frames[:, HISTORY:], jnp.asarray(path), jnp.eye(2))
    history = batch.history + jnp.asarray(offset, jnp.float32)
    return batch, history, restart_from(batch, history)


def test_restarting_bends_target_and_path_back_to_the_captured_line():
    offset = np.zeros(CHANNELS)
    offset[:3] = [0.4, 0.0, -0.8]
    batch, _, after = restarted(offset)
    # Measured from where the character is, the line lies one drift back; all of it at the end.
    bend = -np.arange(1, WINDOW + 1)[:, None] / WINDOW * [0.4, -0.8]
    moved = np.asarray(after.future - batch.future)
    np.testing.assert_allclose(moved[..., [0, 2]], np.stack([bend, bend]), atol=1e-5)
    np.testing.assert_allclose(moved[..., 3:], 0.0, atol=1e-5)
    path_moved = np.asarray(after.path - batch.path)
    np.testing.assert_allclose(path_moved[..., :2], np.stack([bend, bend]), atol=1e-5)
    np.testing.assert_array_equal(path_moved[..., 2:], 0.0)
    np.testing.assert_array_equal(after.style, batch.style)


def test_mean_poses_by_hand(packed, train):
    motions = [packed.motion(0), mirror(packed.motion(0)), packed.motion(1), packed.motion(3)]
    firsts = [features.world_frames(m)[: m.num_frames - SPAN + 1, 9:] for m in motions]
    expected = [np.concatenate(firsts[:2]).mean(axis=0), np.concatenate(firsts[2:]).mean(axis=0)]
    np.testing.assert_allclose(mean_poses(train), expected, atol=1e-5)


def test_starting_poses_stand_at_the_origin_and_face_forward(packed):
    starts = starting_poses(packed, num_history=HISTORY, num_poses=4)
    assert {name: len(cuts) for name, cuts in starts.items()} == {"calm": 1, "proud": 2}
    for cuts in starts.values():
        assert cuts.shape[1:] == (HISTORY, CHANNELS) and cuts.dtype == np.float32
        np.testing.assert_allclose(cuts[:, -1, [0, 2]], 0.0, atol=1e-7)
        np.testing.assert_allclose(wrap_angle(features.frame_yaw(SKELETON, cuts[:, -1])), 0.0, atol=1e-6)
    # From the middle of clip 0 (30 frames): frames 11 to 14, turned and moved.
    world = features.world_frames(packed.motion(0))[11:15]
    back = features.turn_frames(starts["calm"][0].astype(float), features.frame_yaw(SKELETON, world[-1]))
    back[:, [0, 2]] += world[-1, [0, 2]]
    np.testing.assert_allclose(back, world, atol=1e-5)
