"""Clip statistics: hand-made motion, and the Bandai manifest that another parser made."""

import numpy as np
import pytest
from f3amd_notebooks.clip_statistics import clip_statistics

from f3amd_lib.motion.rotations import matrix_from_yaw
from f3amd_lib.motion.skeleton import Motion, Skeleton

LEGS = Skeleton(
    names=("Hips", "LeftHip", "LeftToe", "RightHip", "RightToe"),
    parents=(-1, 0, 1, 0, 3),
    offsets=np.array([[0, 0, 0], [0.1, 0, 0], [0, -0.85, 0], [-0.1, 0, 0], [0, -0.8, 0]]),
)


def moving_legs(root_position, yaw_deg) -> Motion:
    root_position = np.asarray(root_position, dtype=float)
    rotations = np.tile(np.eye(3), (len(root_position), 5, 1, 1))
    rotations[:, 0] = matrix_from_yaw(np.radians(np.asarray(yaw_deg, dtype=float)))
    return Motion(LEGS, root_position, rotations, 30.0)


def test_a_right_angle_walked_by_hand():
    # 30 steps of 3 cm along +Z, then 30 of 4 cm along +X; the height must not count as way.
    steps = np.repeat([[0.0, 0.001, 0.03], [0.04, -0.001, 0.0]], 30, axis=0)
    root = np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)]) + [5.0, 0.9, 5.0]
    found = clip_statistics(moving_legs(root, np.full(61, 90.0)))
    wanted = {"path_length_m": 2.1, "net_distance_m": 1.5, "mean_speed_m_s": 1.05}
    wanted |= {"start_yaw_deg": 90.0, "net_yaw_change_deg": 0.0}
    wanted |= {"lowest_joint_y_cm": 5.0, "lowest_toe_y_cm": 5.0, "toe_contact_fraction": 0.0}
    assert found == pytest.approx(wanted, abs=1e-9)


def test_turning_is_counted_through_the_seam_at_180_degrees():
    found = clip_statistics(moving_legs(np.full((28, 3), 1.0), 170.0 + 10.0 * np.arange(28)))
    assert found["start_yaw_deg"] == pytest.approx(170.0)
    assert found["net_yaw_change_deg"] == pytest.approx(270.0)


@pytest.mark.slow
def test_all_locomotion_clips_agree_with_the_manifest(bandai_dataset, bandai_manifest):
    rows = {row["file"].removesuffix(".bvh"): row for row in bandai_manifest}
    assert {clip.name for clip in bandai_dataset.clips} == {
        name for name, row in rows.items() if row["locomotion"] == "1"
    }
    differing = []
    for clip in bandai_dataset.clips:
        motion = clip.load()
        row = rows[clip.name]
        assert motion.num_frames == int(row["frames"]), clip.name
        for name, value in clip_statistics(motion).items():
            digits = len(row[name].partition(".")[2])
            # Half a unit of the last printed digit, and a hair for numbers right between two.
            if abs(value - float(row[name])) > 0.501 * 10.0**-digits:
                differing.append(f"{clip.name} {name}: {value} here, {row[name]} there")
    assert not differing
