"""Real clips that stand beside rollouts: which ones, their pace, floor and paths."""

import numpy as np
import pytest
from builders import SKELETON, packed_from, refused, stiff_walk, walks_and_runs
from f3amd_notebooks import shown, walk_tables

from f3amd_lib.data.features import world_frames
from f3amd_lib.measures import real_clips
from f3amd_lib.measures.registry import SHOWN
from f3amd_lib.motion.root_paths import RootPath, path_from_motion
from f3amd_lib.rollout.generated import Rollout

TRAIN = 0
WINDOW = 8


@pytest.fixture
def packed():
    return walks_and_runs()


def test_pace_and_floor_come_from_training_clips(packed):
    assert real_clips.style_pace(packed, "calm") == pytest.approx(1.2, rel=1e-3)
    assert real_clips.style_pace(packed, "proud") == pytest.approx(0.9, rel=1e-3)
    assert real_clips.style_floor(packed, "calm") == pytest.approx(0.02)
    refused("unknown style of data set '.*': 'clam'", real_clips.style_pace, packed, "clam")


def test_reference_clips_are_held_out_and_walk_at_the_pace(packed):
    # Clip 5 runs, clip 8 is too short; of style 1 both are too fast, the nearer one stands in.
    assert real_clips.reference_clips(packed, ["calm"], window=WINDOW) == [4]
    assert real_clips.reference_clips(packed, ["proud", "calm"], window=WINDOW) == [6, 4]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(real_clips, "_SPEEDS", (0.4, 4.0))
        assert real_clips.reference_clips(packed, ["calm"], window=WINDOW) == [4, 5]
    assert real_clips.reference_clips(packed, ["calm"], window=4) == [4, 8]
    assert real_clips.reference_clips(packed, ["calm"], window=WINDOW, split="validation") == [9]


def test_own_path_keeps_a_line_and_loses_the_sway():
    motion = stiff_walk(0.04, 90)
    line = path_from_motion(motion).position
    np.testing.assert_allclose(real_clips.own_path(motion).position, line, atol=1e-9)
    swayed = motion.root_position.copy()
    swayed[:, 0] += 0.02 * np.sin(2 * np.pi * np.arange(90) / 20.5)
    smooth = real_clips.own_path(motion.replace(root_position=swayed)).position
    assert np.abs(smooth - line)[20:-20].max() < 0.004
    tiny = motion.slice(0, 3)
    np.testing.assert_array_equal(real_clips.own_path(tiny).position, line[:3])


def test_a_clip_is_followed_from_its_own_first_frames(packed):
    whole = packed.motion(4)
    history, path, real = shown.follow_clip(packed, 4, num_history=5, num_frames=20)
    np.testing.assert_allclose(history[0], world_frames(whole)[:5], atol=1e-6)
    assert path.num_frames == real.num_frames == 20
    np.testing.assert_array_equal(real.root_position, whole.root_position[5:25])
    np.testing.assert_array_equal(path.position, real_clips.own_path(whole).position[5:25])
    refused(f"{whole.num_frames} frames, 1005 are needed", shown.follow_clip, packed, 4, num_history=5, num_frames=1000)


def test_the_longest_held_out_clip_of_a_style_is_followed():
    held_out = [(stiff_walk(step, frames), 0, 2) for step, frames in ((0.041, 60), (0.039, 90), (0.04, 70))]
    packed = packed_from([(stiff_walk(0.04, 200), 0, TRAIN), (stiff_walk(0.04, 200), 1, TRAIN), *held_out])
    found = shown.follow_longest(packed, "calm", num_history=5, num_frames=20)
    wanted = shown.follow_clip(packed, 3, num_history=5, num_frames=20)
    np.testing.assert_array_equal(found[0], wanted[0])
    np.testing.assert_array_equal(found[2].positions, wanted[2].positions)


# ------------------------------------------------------------------- measured alike


def rollout_of(motions, paths=None, window=WINDOW):
    """A rollout that made these motions."""
    frames = np.stack([world_frames(motion) for motion in motions])
    paths = paths or [path_from_motion(motion) for motion in motions]
    styles = tuple(f"style {k}" for k in range(len(motions)))
    return Rollout(SKELETON, frames, frames[:, :4], tuple(paths), styles, window)


def test_real_clips_and_rollouts_are_measured_alike(packed):
    clips = [4, 9]
    real = walk_tables.measure_clips(packed, clips, window=WINDOW)
    motions = [packed.motion(clip) for clip in clips]
    floors = [real_clips.style_floor(packed, packed.styles[packed.clip_style[clip]]) for clip in clips]
    again = walk_tables.measure_rollout(rollout_of(motions, [*map(real_clips.own_path, motions)]), floors)
    assert set(real) == {metric.key for metric in SHOWN["first"]} | {"foot_alternation_hz", "bone_swing_deg"}
    for key, values in real.items():
        np.testing.assert_allclose(again[key], values, atol=1e-6, err_msg=key)
    np.testing.assert_allclose(real["ird_cm"], [4.2, 4.5], rtol=1e-3)


def test_rounds_show_where_the_path_is_lost():
    motion = stiff_walk(0.04, 30)
    path = path_from_motion(motion)
    ramp = np.where(np.arange(30) < 16, 0.0, 0.5)[:, None] * np.array([1.0, 0.0])
    off = RootPath(path.position + ramp, path.yaw)
    table = real_clips.by_round(rollout_of([motion, motion], [path, off]))
    assert table["round"].tolist() == [1, 2, 3]  # the fourth is not finished
    np.testing.assert_allclose(table["gap_m"], [0.0, 0.0, 0.25], atol=1e-6)
    np.testing.assert_allclose(table["worst_gap_m"], [0.0, 0.0, 0.5], atol=1e-6)
    np.testing.assert_allclose(table["acceleration_cm"], 0.0, atol=1e-4)
