"""Metrics against answers worked out by hand."""

import numpy as np
import pytest
from builders import placed, refused

from f3amd_lib.measures import metrics
from f3amd_lib.motion.root_paths import named_path
from f3amd_lib.motion.rotations import matrix_from_yaw
from f3amd_lib.motion.skeleton import Skeleton

WINDOW = 32
SKELETON = Skeleton(
    ("Hips", "LeftHip", "RightHip", "LeftToe", "RightToe"),
    (-1, 0, 0, 1, 2),
    np.array([[0, 0, 0], [0.1, 0, 0], [-0.1, 0, 0], [0, -0.9, 0.1], [0, -0.9, 0.1]]),
)
POSE = np.array([[0, 0.9, 0], [0.1, 0.9, 0], [-0.1, 0.9, 0], [0.1, 0.0, 0.1], [-0.1, 0.0, 0.1]], dtype=float)


def glide(num_frames=4 * WINDOW, step=0.04, direction=0.0):
    """A rigid figure that glides `step` metres a frame, [T, 5, 3]."""
    along = step * np.arange(num_frames)
    ground = np.stack([along * np.sin(direction), 0 * along, along * np.cos(direction)], axis=-1)
    return POSE + ground[:, None, :]


def wobble(num_frames=4 * WINDOW, seed=0):
    """A walker's worth of irregular motion, [T, 5, 3]."""
    noise = np.random.default_rng(seed).normal(size=(num_frames, 5, 3)) * 0.01
    return glide(num_frames) + noise


# ------------------------------------------------------------------------------------- seams


def test_seams_of_a_paper_rollout():
    seams = metrics.seam_frames(2560, 32)
    assert len(seams) == 79 and seams[0] == 32 and seams[-1] == 2528


def test_seam_of_three_centimetres_reads_three():
    """A figure that stands still but is moved 3 cm between windows."""
    positions = np.tile(POSE, (3 * WINDOW, 1, 1))
    positions[WINDOW:] += [0.03, 0.0, 0.0]
    positions[2 * WINDOW :] += [0.0, 0.0, 0.03]
    assert metrics.ird(positions, WINDOW) == pytest.approx(3.0)
    assert metrics.ird_excess(positions, WINDOW) == pytest.approx(3.0)
    # The same jumps lie inside windows of another length.
    assert metrics.ird(positions, WINDOW - 2) == pytest.approx(0.0)


def test_steady_walk_has_no_excess_and_its_step_as_ird():
    positions = glide(step=0.045)
    assert metrics.ird(positions, WINDOW) == pytest.approx(4.5)
    assert metrics.inter_frame_step(positions) == pytest.approx(4.5)
    assert metrics.ird_excess(positions, WINDOW) == pytest.approx(0.0, abs=1e-9)


def test_sticking_at_the_seam_has_low_ird_and_high_excess():
    """What the literal loss rewards: the first frame of a window repeats the last of the former."""
    positions = glide(2 * WINDOW, step=0.045)
    positions[WINDOW:] -= [0.0, 0.0, 0.045]
    assert metrics.ird(positions, WINDOW) == pytest.approx(0.0, abs=1e-9)
    assert metrics.ird_excess(positions, WINDOW) == pytest.approx(4.5)


# ------------------------------------------------------------------------------------- path


def test_walking_the_path_reads_zero():
    path = named_path("complex", 4 * WINDOW, seed=1)
    positions = np.tile(POSE, (4 * WINDOW, 1, 1))
    positions[:, :, [0, 2]] += path.position[:, None]
    assert metrics.trajectory_error(positions, path, WINDOW) == pytest.approx(0.0, abs=1e-12)
    assert metrics.direction_error(path.yaw, path, WINDOW) == pytest.approx(0.0, abs=1e-9)
    assert metrics.path_drift(positions, path) == pytest.approx(0.0, abs=1e-12)


def test_ten_degrees_off():
    """After i frames the two are 2 sin(5 deg) apart for each metre walked."""
    path = named_path("straight", 4 * WINDOW, speed=1.2)
    positions = glide(step=0.04, direction=np.deg2rad(10.0))
    apart = 2 * np.sin(np.deg2rad(5.0))
    assert metrics.trajectory_error(positions, path, WINDOW) == pytest.approx(apart * 0.04 * (WINDOW - 1) / 2)
    assert metrics.path_drift(positions, path) == pytest.approx(apart)


def test_turning_too_fast_by_a_tenth_of_a_degree_a_frame():
    wanted = np.deg2rad(3.0) * np.arange(4 * WINDOW)  # more than a whole turn in all
    yaw = np.deg2rad(3.1) * np.arange(4 * WINDOW)
    expected = 0.1 * (WINDOW - 1) / 2
    assert metrics.direction_error(yaw, wanted, WINDOW) == pytest.approx(expected)
    # Angles given in one turn or in many are the same angles.
    wrapped = (yaw + np.pi) % (2 * np.pi) - np.pi
    assert np.abs(np.diff(wrapped)).max() > np.pi
    assert metrics.direction_error(wrapped, wanted, WINDOW) == pytest.approx(expected)


def test_a_jump_between_windows_is_left_to_ird():
    path = named_path("straight", 4 * WINDOW, speed=1.2)
    positions = glide(step=0.04)
    positions[2 * WINDOW :] += [0.5, 0.0, 0.0]
    assert metrics.trajectory_error(positions, path, WINDOW) == pytest.approx(0.0, abs=1e-12)
    assert metrics.ird_excess(positions, WINDOW) == pytest.approx(50.0 / 3)
    assert metrics.path_drift(positions, path) == pytest.approx(0.5 / path.length)


# ------------------------------------------------------------------------------------- smoothness


def test_constant_acceleration():
    """All joints accelerate like the root: the ratio is 1, and the acceleration is known."""
    time = np.arange(60.0)
    positions = np.tile(POSE, (60, 1, 1))
    positions[:, :, 2] += 0.5 * 0.002 * time[:, None] ** 2  # 2 mm a frame squared
    assert metrics.smoothness(positions) == pytest.approx(1.0)
    assert metrics.joint_acceleration(positions) == pytest.approx(0.2)
    assert metrics.joint_acceleration(positions, fps=60.0) == pytest.approx(0.8)
    # One of five joints bobs up and down with a second difference of 4 cm.
    positions[1::2, 4, 1] += 0.01
    expected = (4 * 0.002 + np.hypot(0.002, 0.02)) / 5 / 0.002
    assert metrics.smoothness(positions) == pytest.approx(expected)


def test_coherence_of_a_glide_is_one():
    positions = glide()
    assert metrics.coherence(positions) == pytest.approx(1.0)
    positions[1::2, 4, 0] += 0.03  # one toe moves 5 cm where the others move 4
    assert metrics.coherence(positions) == pytest.approx((4 * 4 + 5) / 5 / 4)


def test_undefined_ratios_are_nan_not_errors():
    still = np.tile(POSE, (2 * WINDOW, 1, 1))
    assert np.isnan(metrics.smoothness(still))
    assert np.isnan(metrics.coherence(still))
    assert np.isnan(metrics.foot_sliding(still, SKELETON)[0])
    assert np.isnan(metrics.smoothness(glide()))  # steady: the root does not accelerate
    assert metrics.joint_acceleration(still) == 0.0


# ------------------------------------------------------------------------------------- feet


def slider(num_frames=90, slide=0.02, rest=0.0):
    """Root at 1 m/s; the left toe stays low and slides, the right one flies at 10 cm."""
    positions = glide(num_frames, step=1.0 / 30.0)
    positions[:, 3, 2] = slide * np.arange(num_frames)
    positions[:, 3, 1] = rest
    positions[:, 4, 1] = rest + 0.1
    return positions


def test_two_centimetres_a_frame_at_one_metre_a_second():
    value, share = metrics.foot_sliding(slider(), SKELETON)
    assert value == pytest.approx(0.6)
    assert share == pytest.approx(0.5)


def test_floor_is_the_lowest_toe_unless_given():
    resting_high = slider(rest=0.0425)  # Bandai's toe joint
    assert metrics.foot_sliding(resting_high, SKELETON) == pytest.approx((0.6, 0.5))
    assert metrics.foot_sliding(resting_high, SKELETON, floor_shift=0.0425) == pytest.approx((0.6, 0.5))
    assert metrics.foot_sliding(resting_high, SKELETON, floor_shift=0.0) == (0.0, 0.0)


# ------------------------------------------------------------------------------------- CAMDM


def zigzag(degrees, num_frames=4 * WINDOW + 1, step=0.04, towards=0.0):
    """Steps of 4 cm, by turns so many degrees to the left and to the right of a direction."""
    angle = towards + np.deg2rad(degrees) * (-1.0) ** np.arange(num_frames - 1)
    steps = step * np.stack([np.sin(angle), 0 * angle, np.cos(angle)], axis=-1)
    ground = np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
    return POSE + ground[:, None, :]


def test_camdm_path_walked_ten_degrees_off():
    path = named_path("straight", 4 * WINDOW, speed=1.2)
    for off in (10.0, -10.0):
        positions = glide(step=0.04, direction=np.deg2rad(off))
        assert metrics.camdm_trajectory_error(positions, path) == pytest.approx(10.0)
        # A direction has no speed: half as fast is no better and no worse.
        slow = glide(step=0.02, direction=np.deg2rad(off))
        assert metrics.camdm_trajectory_error(slow, path) == pytest.approx(10.0)


def test_camdm_errors_to_both_sides_cancel():
    path = named_path("straight", 4 * WINDOW + 1, speed=1.2)
    assert metrics.camdm_trajectory_error(zigzag(40.0), path) == pytest.approx(0.0, abs=1e-9)
    assert metrics.trajectory_error(zigzag(40.0), path, WINDOW) > 0.1
    yaw = np.deg2rad(25.0) * (-1.0) ** np.arange(4 * WINDOW)
    assert metrics.camdm_orientation_error(yaw, np.zeros(4 * WINDOW)) == pytest.approx(0.0)
    assert metrics.direction_error(yaw, np.zeros(4 * WINDOW), WINDOW) == pytest.approx(25.0)


def test_camdm_does_not_wrap_steps_across_the_cut():
    """Towards +X the angle is 180 degrees: a step to the left of it reads 175, to the right -175.

    Half of the steps are 5 degrees off and half, by the unwrapped difference, 355.
    """
    towards_x = np.pi / 2
    target = np.zeros((4 * WINDOW + 1, 2))
    target[:, 0] = 0.04 * np.arange(len(target))
    found = metrics.camdm_trajectory_error(zigzag(5.0, towards=towards_x), target)
    assert found == pytest.approx(180.0)
    # The same walk towards +Z reads 0: the figure depends on where the world's axes lie.
    ahead = metrics.camdm_trajectory_error(zigzag(5.0), target[:, ::-1])
    assert ahead == pytest.approx(0.0, abs=1e-9)
    # Facing has its cut at -X.
    yaw = -np.pi / 2 + np.deg2rad(5.0) * (-1.0) ** np.arange(10)
    found = metrics.camdm_orientation_error(yaw, np.full(10, -np.pi / 2 + 1e-9))
    assert found == pytest.approx(180.0)


# ------------------------------------------------------------------------------------- all together


def test_a_batch_is_measured_one_by_one():
    """One path for all of them, or one each."""
    batch = np.stack([wobble(seed=seed) for seed in range(3)])
    paths = [named_path("slalom", batch.shape[1], seed=seed) for seed in range(3)]
    targets = np.stack([path.position for path in paths])
    for metric in (
        lambda positions, path: metrics.trajectory_error(positions, path, WINDOW),
        metrics.path_drift,
        metrics.camdm_trajectory_error,
        lambda positions, path: metrics.foot_sliding(positions, SKELETON)[0],
        lambda positions, path: metrics.camdm_foot_sliding(positions, SKELETON),
        lambda positions, path: metrics.ird_excess(positions, WINDOW),
        lambda positions, path: metrics.smoothness(positions),
    ):
        np.testing.assert_allclose(metric(batch, targets), [metric(*each) for each in zip(batch, paths, strict=True)])
        np.testing.assert_allclose(metric(batch, targets[0]), [metric(each, paths[0]) for each in batch])


def test_turning_and_moving_the_world_changes_nothing():
    positions, angle, shift = wobble(), 1.1, np.array([5.0, 0.0, -3.0])
    path = named_path("slalom", len(positions))
    moved = positions @ matrix_from_yaw(np.float64(angle)).T + shift
    target = placed(path, shift[[0, 2]], angle)
    before = metrics.first_metrics(positions, path, WINDOW, SKELETON)
    after = metrics.first_metrics(moved, target, WINDOW, SKELETON)
    for key, value in before.items():
        assert after[key] == pytest.approx(value, rel=1e-9, abs=1e-9), key


# ------------------------------------------------------------------------------------- errors

POSITION_METRICS = [
    lambda positions: metrics.trajectory_error(positions, np.zeros((128, 2)), WINDOW),
    metrics.smoothness,
    lambda positions: metrics.ird_excess(positions, WINDOW),
]


@pytest.mark.parametrize("metric", POSITION_METRICS)
def test_nan_and_wrong_shape_are_refused(metric):
    broken = glide()
    broken[7, 2, 1] = np.nan
    refused("not finite at frame 7, joint 2", metric, broken)
    refused(r"\[frame, joint, 3\]", metric, np.zeros((128, 15)))


def test_paths_that_do_not_fit_are_refused():
    refused(r"\[128, 2\] .* got \(100, 2\)", metrics.trajectory_error, glide(), np.zeros((100, 2)), WINDOW)
    refused("do not fill a window", metrics.trajectory_error, glide(20), np.zeros((20, 2)), WINDOW)
    refused("finite", metrics.direction_error, np.full(64, np.nan), np.zeros(64), WINDOW)
    refused("window must be", metrics.ird_excess, glide(), 1)
    refused(r"\[128, 1\] .* got \(100, 1\)", metrics.camdm_orientation_error, np.zeros(128), np.zeros(100))


def test_planted_foot_does_not_slide():
    value, share = metrics.foot_sliding(slider(slide=0.0), SKELETON)
    assert value == 0.0 and share == pytest.approx(0.5)
