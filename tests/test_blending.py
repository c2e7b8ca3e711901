"""Blending at window boundaries: closed forms of the quintic, seams that are known, rotations."""

import numpy as np
import pytest
from builders import CHANNELS, SKELETON, WINDOW, random_frames, refused, tiny_trained
from scipy.interpolate import BPoly
from scipy.spatial.transform import Rotation

from f3amd_lib.data.features import split_frames
from f3amd_lib.motion.root_paths import named_path
from f3amd_lib.motion.rotations import matrix_from_rotation_6d, rotation_6d_from_matrix
from f3amd_lib.rollout.blending import blend_rollout, blend_seams, dying_offset
from f3amd_lib.rollout.rollout import MotionGenerator

T = 16


def frames_of(root, turns=None):
    """World frames of root positions [F, 3] and one turn for all joints, [F, 3, 3]."""
    if turns is None:
        turns = np.broadcast_to(np.eye(3), (len(root), 3, 3))
    sixes = np.tile(rotation_6d_from_matrix(np.asarray(turns)), SKELETON.num_joints)
    return np.concatenate([root, sixes], axis=-1)


def about(axis, angles):
    """Rotations about one axis, [F, 3, 3]."""
    return Rotation.from_rotvec(np.asarray(angles)[:, None] * np.asarray(axis)).as_matrix()


def test_the_offset_is_the_quintic_that_ends_at_rest():
    offset, velocity, count = np.array([2.0, -1.0, 0.5]), np.array([0.3, 0.1, -0.2]), 7
    still = np.zeros(3)
    ends = [[offset, velocity, still], [still, still, still]]
    exact = BPoly.from_derivatives([0.0, count], ends)  # another library's Hermite polynomial
    got = dying_offset(offset, velocity, count)
    np.testing.assert_allclose(got, exact(np.arange(count) + 0.5), atol=1e-12)


@pytest.mark.parametrize("order", [0, 1, 2])
def test_without_a_seam_nothing_changes(order):
    # Motion of constant acceleration has no seam; both sides extend to the same point.
    time = np.arange(4 * T)[:, None]
    root = np.array([0.2, 0.9, -0.1]) + np.array([0.03, 0.001, 0.04]) * time**order / T**order
    turns = about([0.0, 1.0, 0.0], 0.4 * time[:, 0] ** order / T**order)
    frames = frames_of(root, turns)
    blended = blend_seams(frames, T, 10, history=frames[:3] - (frames[3] - frames[0]) * (order < 2))
    np.testing.assert_allclose(blended[10:], frames[10:], atol=1e-12)
    np.testing.assert_allclose(blend_seams(frames, T, 10), frames, atol=1e-12)


@pytest.mark.parametrize("count", [1, 5, T])
def test_a_step_dies_away_within_the_given_frames(count):
    step = np.array([0.3, -0.1, 0.2])
    root = np.where(np.arange(2 * T)[:, None] < T, 0.0, step)
    blended = blend_seams(frames_of(root), T, count)[:, :3]
    np.testing.assert_array_equal(blended[:T], 0.0)
    np.testing.assert_allclose(blended[T + count :], step + np.zeros((T - count, 3)), atol=1e-15)
    u = (np.arange(count) + 0.5) / count
    left = 1 - 10 * u**3 + 15 * u**4 - 6 * u**5
    np.testing.assert_allclose(blended[T : T + count], (1 - left)[:, None] * step, atol=1e-12)


def test_what_comes_out_are_rotations_whatever_goes_in():
    frames = random_frames((2, 5 * T), seed=3)
    blended = blend_seams(frames, T, T, history=random_frames((2, 4), seed=4))
    matrices = matrix_from_rotation_6d(split_frames(blended)[1])
    np.testing.assert_allclose(rotation_6d_from_matrix(matrices), split_frames(blended)[1], atol=1e-9)
    np.testing.assert_allclose(np.linalg.det(matrices), 1.0, atol=1e-9)
    # Half a turn at most: the frames far from a seam are the given ones.
    one = blend_seams(frames[0], T, 4)
    keep = [k for k in range(5 * T) if k < T or k % T >= 4]
    np.testing.assert_allclose(one[keep], frames[0, keep], atol=1e-12)


def test_history_makes_the_first_frame_a_seam():
    frames = frames_of(np.tile([1.0, 0.0, 0.0], (T, 1)))
    history = frames_of(np.zeros((4, 3)))
    np.testing.assert_array_equal(blend_seams(frames, T, 8), frames)
    first = blend_seams(frames, T, 8, history=history)
    assert first[0, 0] < 0.01 and first[7, 0] > 0.99
    np.testing.assert_array_equal(first[8:], frames[8:])


@pytest.fixture(scope="module")
def generator():
    return MotionGenerator(tiny_trained(), num_steps=1)


@pytest.fixture(scope="module")
def plain(generator):
    return generator.rollout(named_path("circle", 3 * WINDOW), ["calm", "proud"])


def test_a_rollout_is_blended_only_if_asked(generator, plain):
    path = plain.paths[0]
    assert plain.blend_frames == 0
    blended = generator.rollout(path, ["calm", "proud"], blend_frames=4)
    assert blended.blend_frames == 4 and blended.frames.dtype == plain.frames.dtype
    expected = blend_seams(plain.frames, WINDOW, 4, history=plain.history)
    np.testing.assert_allclose(blended.frames, expected, atol=1e-6)
    keep = np.arange(3 * WINDOW) % WINDOW >= 4
    np.testing.assert_allclose(blended.frames[:, keep], plain.frames[:, keep], atol=1e-6)
    assert np.abs(blended.frames - plain.frames).max() > 1e-3
    refused("already blended", blend_rollout, blended, 4)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"blend_frames": T + 1}, f"from 0 to {T}, the window, got {T + 1}"),
        ({"blend_frames": -1}, "got -1"),
        ({"blend_frames": 2.5}, "got 2.5"),
        ({"frames": np.full((4, CHANNELS), np.nan)}, "not finite at frame 0"),
        ({"history": np.zeros((3, CHANNELS - 6))}, r"history must be \[frame, .*\] .* got \(3, "),
    ],
)
def test_bad_input_is_refused(changed, message):
    call = {"frames": random_frames((2 * T,)), "window": T, "blend_frames": 4}
    refused(message, blend_seams, **call | changed)
