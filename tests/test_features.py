"""Motion to frames and back; turning, centring and facing of frames (sections 3.2, 3.3)."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from builders import CHANNELS, SKELETON, random_frames, refused, wandering_motion

from f3amd_lib.data import features
from f3amd_lib.motion.rotations import matrix_from_rotation_6d, wrap_angle
from f3amd_lib.motion.skeleton import facing_yaw, turn


def test_section_3_2_layout_is_root_then_two_columns_a_joint():
    motion = wandering_motion(5)
    frames = features.world_frames(motion)
    assert frames.shape == (5, CHANNELS) and frames.dtype == np.float64
    np.testing.assert_array_equal(frames[:, :3], motion.root_position)
    for joint in range(SKELETON.num_joints):
        block = frames[:, 3 + 6 * joint : 9 + 6 * joint]
        np.testing.assert_array_equal(block[:, :3], motion.rotations[:, joint, :, 0])
        np.testing.assert_array_equal(block[:, 3:], motion.rotations[:, joint, :, 1])


def test_motion_to_frames_and_back_is_exact():
    motion = wandering_motion(30)
    again = features.motion_from_frames(SKELETON, features.world_frames(motion), name="again")
    np.testing.assert_array_equal(again.root_position, motion.root_position)
    np.testing.assert_allclose(again.rotations, motion.rotations, atol=1e-14)
    assert (again.fps, again.name) == (30.0, "again")
    np.testing.assert_allclose(features.world_frames(again), features.world_frames(motion), atol=1e-14)


def test_broken_frames_are_refused_by_number():
    frames = random_frames((6,))
    frames[4, 20] = np.nan
    refused("frame 4", features.motion_from_frames, SKELETON, frames)


def test_frame_positions_are_the_motions():
    motion = wandering_motion(12)
    frames = features.world_frames(motion)
    np.testing.assert_allclose(features.frame_positions(SKELETON, frames), motion.positions, atol=1e-12)
    on_device = features.frame_positions(SKELETON, jnp.asarray(frames, jnp.float32)[None])
    np.testing.assert_allclose(on_device[0], motion.positions, atol=1e-5)


@pytest.mark.parametrize("seed", range(3))
def test_frame_yaw_equals_facing_of_the_full_kinematics(seed):
    frames = random_frames((40,), seed)
    expected = facing_yaw(SKELETON, features.frame_positions(SKELETON, frames))
    np.testing.assert_allclose(wrap_angle(features.frame_yaw(SKELETON, frames) - expected), 0, atol=1e-12)
    on_device = features.frame_yaw(SKELETON, jnp.asarray(frames, jnp.float32))
    np.testing.assert_allclose(wrap_angle(on_device - expected), 0, atol=1e-3)


def test_centring_by_hand():
    frames = random_frames((2, 5))
    origin = np.array([[1.0, -2.0], [0.5, 3.0]])
    moved = features.center_window(frames, origin)
    np.testing.assert_allclose(moved[0, :, 0], frames[0, :, 0] - 1.0)
    np.testing.assert_allclose(moved[1, :, 2], frames[1, :, 2] - 3.0)
    # Height stays absolute, and rotations do not care.
    np.testing.assert_array_equal(moved[..., 1], frames[..., 1])
    np.testing.assert_array_equal(moved[..., 3:], frames[..., 3:])
    np.testing.assert_allclose(features.center_window(moved, -origin), frames, atol=1e-14)


def test_turning_frames_is_turning_the_motion():
    motion = wandering_motion(10)
    turned = features.turn_frames(features.world_frames(motion), 0.8)
    np.testing.assert_allclose(turned, features.world_frames(turn(motion, 0.8)), atol=1e-12)


def test_orthonormalise_leaves_rotations_and_mends_the_rest():
    frames = random_frames((6,))
    np.testing.assert_allclose(features.orthonormalise(frames), frames, atol=1e-14)
    noisy = frames + 0.2 * np.random.default_rng(0).standard_normal(frames.shape)
    mended = features.orthonormalise(noisy)
    np.testing.assert_array_equal(mended[:, :3], noisy[:, :3])
    first, second = np.split(features.split_frames(mended)[1], 2, axis=-1)
    for vector in (first, second):
        np.testing.assert_allclose(np.linalg.norm(vector, axis=-1), 1.0, atol=1e-12)
    np.testing.assert_allclose((first * second).sum(-1), 0.0, atol=1e-12)
    # The pose that kinematics sees does not change.
    np.testing.assert_allclose(*(features.frame_positions(SKELETON, each) for each in (mended, noisy)), atol=1e-12)
    np.testing.assert_allclose(features.orthonormalise(mended), mended, atol=1e-12)


def test_section_3_3_path_condition_by_hand():
    position = np.array([[0.5, -1.0], [2.0, 3.0]])
    got = features.path_condition(position, np.array([0.0, np.pi / 2]))
    expected = [[0.5, -1, 1, 0, 0, 0, 1, 0], [2, 3, 0, 0, -1, 0, 1, 0]]
    np.testing.assert_allclose(got, expected, atol=1e-15)
    assert np.linalg.det(matrix_from_rotation_6d(got[1, 2:])) == pytest.approx(1.0)
    assert isinstance(features.path_condition(jnp.zeros((1, 2)), jnp.zeros(1)), jax.Array)


def test_normaliser_by_hand():
    normaliser = features.Normaliser(jnp.array([1.0, 0.0]), jnp.array([2.0, 0.5]), jnp.asarray(4.0))
    x = jnp.array([[3.0, 1.0]])
    np.testing.assert_allclose(normaliser.normalise(x), [[1.0, 2.0]])
    np.testing.assert_allclose(normaliser.denormalise(normaliser.normalise(x)), x)
    path = features.path_condition(jnp.array([[2.0, -4.0]]), jnp.array([0.6]))
    scaled = normaliser.normalise_path(path)
    np.testing.assert_allclose(scaled[0, :2], [0.5, -1.0])
    np.testing.assert_array_equal(scaled[0, 2:], path[0, 2:])


def test_turns_are_exact_where_a_gpu_would_round_products():
    frames, yaw = jnp.asarray(random_frames((2, 4)), jnp.float32), jnp.zeros(2)
    with jax.default_matmul_precision("tensorfloat32"):
        for function in (features.turn_frames, lambda frames, _: features.frame_yaw(SKELETON, frames)):
            text = str(jax.make_jaxpr(function)(frames, yaw))
            assert "dot_general" in text and "HIGHEST" in text
        assert "HIGHEST" not in str(jax.make_jaxpr(jnp.matmul)(frames, frames.swapaxes(-1, -2)))
