"""The figures of rollouts and of real clips, measured alike."""

import numpy as np
import pytest
from builders import SKELETON, stiff_walk, walks_and_runs

from f3amd_companion.ledger import quality_tables
from f3amd_lib.data.features import world_frames
from f3amd_lib.measures import real_clips, rollout_measures
from f3amd_lib.measures.registry import SHOWN
from f3amd_lib.motion.root_paths import RootPath, path_from_motion
from f3amd_lib.rollout.generated import Rollout

WINDOW = 8


def rollout_of(motions, paths=None, window=WINDOW):
    """A rollout that made these motions."""
    frames = np.stack([world_frames(motion) for motion in motions])
    paths = paths or [path_from_motion(motion) for motion in motions]
    styles = tuple(f"style {k}" for k in range(len(motions)))
    return Rollout(SKELETON, frames, frames[:, :4], tuple(paths), styles, window)


@pytest.fixture
def packed():
    return walks_and_runs()


def test_real_clips_and_rollouts_are_measured_alike(packed):
    clips = [4, 9]
    real = rollout_measures.measure_clips(packed, clips, window=WINDOW)
    motions = [packed.motion(clip) for clip in clips]
    paths = [real_clips.own_path(motion) for motion in motions]
    again = rollout_measures.measure_rollout(rollout_of(motions, paths), packed.floor_shift[clips])
    assert set(real) == {metric.key for metric in SHOWN["first"]} | {"foot_alternation_hz", "bone_swing_deg"}
    for key, values in real.items():
        np.testing.assert_allclose(again[key], values, atol=1e-6, err_msg=key)
    np.testing.assert_allclose(real["ird_cm"], [4.2, 4.5], rtol=1e-3)


def test_rounds_show_where_the_path_is_lost():
    motion = stiff_walk(0.04, 30)
    path = path_from_motion(motion)
    ramp = np.where(np.arange(30) < 16, 0.0, 0.5)[:, None] * np.array([1.0, 0.0])
    off = RootPath(path.position + ramp, path.yaw)
    table = rollout_measures.by_round(rollout_of([motion, motion], [path, off]))
    assert table["round"].tolist() == [1, 2, 3]  # the fourth is not finished
    np.testing.assert_allclose(table["gap_m"], [0.0, 0.0, 0.25], atol=1e-6)
    np.testing.assert_allclose(table["worst_gap_m"], [0.0, 0.0, 0.5], atol=1e-6)
    np.testing.assert_allclose(table["acceleration_cm"], 0.0, atol=1e-4)


def test_quality_table_starts_with_the_real_row(packed):
    real = rollout_measures.measure_clips(packed, [4, 9], window=WINDOW)
    table = quality_tables.quality_table(real, {("F3AMD-FNO-96", 8): real, ("F3AMD-FNO-96", 1): real})
    assert list(dict.fromkeys(table["label"])) == ["real", "F3AMD-FNO-96, 8 steps", "F3AMD-FNO-96, 1 step"]
    assert list(dict.fromkeys(table["steps"])) == [0, 8, 1]
    rows = table[table["label"] == "real"].set_index("metric")
    assert rows.loc["IRD", "value"] == pytest.approx(real["ird_cm"].mean())
    assert len(rows) == len(SHOWN["first"])
