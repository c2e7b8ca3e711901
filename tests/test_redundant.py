"""The redundant vector: forward and back, part by part, on skeletons of several sizes."""

import jax.numpy as jnp
import numpy as np
import pytest
from builders import refused
from scipy.ndimage import gaussian_filter1d

from f3amd_lib.motion import synthetic
from f3amd_lib.motion.rotations import matrix_from_rotation_6d, matrix_from_yaw, shortest_turn
from f3amd_lib.motion.skeleton import Motion, Skeleton, resample, turn
from f3amd_lib.text.data import redundant


def walk(style="neutral", seconds=4.0, seed=0) -> Motion:
    return resample(synthetic.synthesize(synthetic.STYLES[0], seconds=seconds, seed=seed), 20.0)


def without(motion: Motion, *names) -> Motion:
    """The motion without some joints at the ends of limbs."""
    old = motion.skeleton
    kept = [joint for joint, name in enumerate(old.names) if name not in names]
    skeleton = Skeleton(
        [old.names[joint] for joint in kept],
        [-1, *(kept.index(old.parents[joint]) for joint in kept[1:])],
        old.offsets[kept],
    )
    return Motion.from_positions(skeleton, motion.positions[:, kept], motion.fps)


MOTIONS = {23: walk(), 22: without(walk(seed=1), "Head"), 21: without(walk(seed=2), "LeftWrist", "RightWrist")}


@pytest.mark.parametrize("joints, width", [(22, 263), (21, 251), (23, 275)])
def test_the_numbers_of_the_published_layouts(joints, width):
    parts = redundant.vector_parts(joints)
    assert parts["contacts"].stop == width
    assert redundant.count_joints(width) == joints
    assert [part.start for part in parts.values()][1:] == [part.stop for part in parts.values()][:-1]


@pytest.mark.parametrize("joints", MOTIONS)
def test_back_to_a_hundredth_of_a_millimetre(joints):
    motion = turn(MOTIONS[joints], 1.1)
    positions = redundant.canonical_start(motion.skeleton, motion.positions)
    vectors = redundant.redundant_from_positions(motion.skeleton, positions)
    assert vectors.shape == (len(positions) - 1, 12 * joints - 1)
    back = redundant.positions_from_redundant(vectors.astype(np.float32).astype(np.float64))
    assert np.abs(back - positions[:-1]).max() < 1e-5
    assert np.allclose(redundant.essential_features(motion.skeleton, positions), vectors[:, : 3 * joints + 1])
    batched = redundant.positions_from_redundant(jnp.asarray(vectors, jnp.float32)[None, None])[0, 0]
    assert np.abs(np.asarray(batched) - positions[:-1]).max() < 1e-4


def test_the_start_is_canonical():
    motion = turn(MOTIONS[23], 2.0)
    positions = redundant.canonical_start(motion.skeleton, motion.positions + [3.0, 0.4, -1.0])
    assert np.allclose(positions[0, 0, ::2], 0.0) and positions[..., 1].min() == pytest.approx(0.0)
    assert redundant.smoothed_yaw(motion.skeleton, positions, 0.0)[0] == pytest.approx(0.0, abs=1e-9)
    assert np.allclose(positions, redundant.canonical_start(motion.skeleton, MOTIONS[23].positions), atol=1e-9)


def turning_figure(degrees_a_frame=3.0, frames=40) -> tuple[Skeleton, np.ndarray]:
    """A rigid figure that turns left on a circle: hips, toes, and one arm that points ahead."""
    skeleton = Skeleton(
        ("Hips", "LeftHip", "LeftAnkle", "left_toe", "RightHip", "RightAnkle", "right_toe", "Hand"),
        (-1, 0, 1, 2, 0, 4, 5, 0),
        [[0, 0, 0], [0.1, 0, 0], [0, -0.8, 0], [0, 0, 0.1], [-0.1, 0, 0], [0, -0.8, 0], [0, 0, 0.1], [0, 0, 0.5]],
    )
    pose = np.array([[0, 0.8, 0]] * 8)
    for joint, parent in enumerate(skeleton.parents[1:], 1):
        pose[joint] = pose[parent] + skeleton.offsets[joint]
    yaw = np.radians(degrees_a_frame) * np.arange(frames)
    ahead = np.stack([np.sin(yaw), 0 * yaw, np.cos(yaw)], axis=-1)
    place = 0.05 * np.concatenate([np.zeros((1, 3)), np.cumsum(ahead[1:], axis=0)])
    return skeleton, np.einsum("tij,kj->tki", matrix_from_yaw(yaw), pose) + place[:, None]


def test_each_part_of_a_turning_figure_by_hand(monkeypatch):
    monkeypatch.setattr(redundant, "FACING_SMOOTHING", 0.0)
    skeleton, positions = turning_figure()
    vectors = redundant.redundant_from_positions(skeleton, positions)
    parts = {name: vectors[:, part] for name, part in redundant.vector_parts(8).items()}
    # Half a turn of 3 degrees to the left: positive is to the right.
    assert np.allclose(parts["turn"], -np.radians(1.5))
    assert np.allclose(parts["velocity"], [0.0, 0.05])
    assert np.allclose(parts["height"], 0.8)
    assert np.allclose(parts["positions"][:, -3:], [0.0, 0.8, 0.5])
    assert np.allclose(parts["positions"], parts["positions"][0])
    yaw = np.radians(3.0)  # steps are seen from the root
    ahead = 0.05 * np.array([np.sin(yaw), 0.0, np.cos(yaw)])
    assert np.allclose(parts["steps"].reshape(-1, 8, 3)[:, 0], ahead)
    # An upright bone is not turned in the world; a chain begins against the facing turned backwards.
    shown = matrix_from_rotation_6d(parts["rotations"].reshape(-1, 7, 6))
    yaw = matrix_from_yaw(np.radians(3.0) * np.arange(len(shown)))
    back = np.swapaxes(yaw, -1, -2)
    for bone, expected in {0: yaw @ yaw, 1: back, 2: yaw, 6: yaw @ yaw}.items():  # hip, leg, foot; arm
        assert np.allclose(shown[:, bone], expected), bone
    # Feet that move 5 cm a frame move 0.0025 square metres, outer ones more.
    assert np.all(parts["contacts"] == 0)
    standing = redundant.redundant_from_positions(skeleton, np.repeat(positions[:1], 9, axis=0))
    assert np.all(standing[:, redundant.vector_parts(8)["contacts"]] == 1)
    assert np.allclose(standing[:, redundant.vector_parts(8)["steps"]], 0)


def test_joint_features_are_steps_in_the_world_and_the_vectors_own_rotations_and_contacts():
    skeleton, positions = turning_figure()
    for shown in (positions, np.repeat(positions[:1], 9, axis=0)):
        vectors = redundant.redundant_from_positions(skeleton, shown)
        features = redundant.joint_features(skeleton, shown, vectors)
        parts = {name: vectors[:, part] for name, part in redundant.vector_parts(8).items()}
        np.testing.assert_allclose(features[..., :3], np.diff(shown, axis=0))
        np.testing.assert_allclose(features[:, 1:, 3:9].reshape(len(features), -1), parts["rotations"])
        feet = [joint for toe in skeleton.toes for joint in (skeleton.parents[toe], toe)]
        np.testing.assert_array_equal(features[:, feet, 9], parts["contacts"])
        assert not features[:, 0, 3:9].any() and not np.delete(features[..., 9], feet, axis=1).any()


@pytest.mark.parametrize("released", [True, False])
def test_turn_and_velocity_by_the_formula_of_either_facing(released):
    skeleton = MOTIONS[22].skeleton
    positions = redundant.canonical_start(skeleton, MOTIONS[22].positions)
    left_hip, right_hip, left_shoulder, right_shoulder = (
        positions[:, skeleton.role(f"{side}_{joint}")] for joint in ("hip", "shoulder") for side in ("left", "right")
    )
    across = right_shoulder - left_shoulder + (left_hip - right_hip if released else right_hip - left_hip)
    across[:, 1] *= released
    forward = np.cross([0.0, 1.0, 0.0], across / np.linalg.norm(across, axis=-1, keepdims=True))
    forward = gaussian_filter1d(forward, 20.0, axis=0, mode="nearest")
    yaw = np.arctan2(forward[:, 0], forward[:, 2])
    yaw[0] = 0.0
    step, sine, cosine = np.diff(positions[:, 0], axis=0), np.sin(yaw[1:]), np.cos(yaw[1:])
    seen = [cosine * step[:, 0] - sine * step[:, 2], sine * step[:, 0] + cosine * step[:, 2]]
    turning = -0.5 * np.diff(yaw)
    for made in (redundant.redundant_from_positions, redundant.essential_features):
        vectors = made(skeleton, positions, released=released)
        np.testing.assert_allclose(vectors[:, 0], turning, atol=1e-9)
        np.testing.assert_allclose(vectors[:, 1:3].T, seen, atol=1e-9)
    other = redundant.redundant_from_positions(skeleton, positions, released=not released)
    assert np.abs(other[:, 0] - turning).max() > 1e-3
    # A figure without shoulders faces as its hips do, and clips begin by hips and shoulders together.
    rigid, still = turning_figure()
    assert np.allclose(*(redundant.smoothed_yaw(rigid, still, released=which) for which in (True, False)))


def test_deviations_are_averaged_over_each_part():
    vectors = np.random.default_rng(0).normal(size=(500, 263)) * np.arange(1, 264)
    mean, deviation = redundant.grouped_statistics(vectors)
    assert mean.shape == deviation.shape == (263,) and mean.dtype == np.float32
    for part in redundant.vector_parts(22).values():
        assert np.ptp(deviation[part]) == 0
        assert deviation[part][0] == pytest.approx(vectors.std(axis=0)[part].mean(), rel=1e-5)


def test_the_shortest_turn():
    generator = np.random.default_rng(0)
    start, end = generator.normal(size=(2, 50, 3))
    matrix = shortest_turn(start, end)
    assert np.allclose(np.einsum("nij,nj->ni", matrix, start) / np.linalg.norm(start, axis=1)[:, None],
                       end / np.linalg.norm(end, axis=1)[:, None])  # fmt: skip
    angle = np.arccos(np.sum(start * end, 1) / np.linalg.norm(start, axis=1) / np.linalg.norm(end, axis=1))
    assert np.allclose(np.arccos((np.trace(matrix, axis1=1, axis2=2) - 1) / 2), angle)
    opposite = shortest_turn(np.array([0.0, 1.0, 0.0]), np.array([0.0, -2.0, 0.0]))
    assert np.allclose(opposite @ [0, 1, 0], [0, -1, 0]) and np.linalg.det(opposite) == pytest.approx(1.0)
    assert np.allclose(shortest_turn(np.ones(3), 3 * np.ones(3)), np.eye(3))


@pytest.mark.parametrize(
    "call, words",
    [
        (lambda s, p: redundant.count_joints(260), "12 J - 1"),
        (lambda s, p: redundant.redundant_from_positions(s, p[:1]), "at least 2 frames"),
        (lambda s, p: redundant.redundant_from_positions(s, p[:, 1:]), r"positions must be"),
        (lambda s, p: redundant.canonical_start(s, p * np.nan), "not finite at frame 0"),
        (lambda s, p: redundant.positions_from_redundant(np.zeros((4, 100))), "got 100"),
    ],
)
def test_what_cannot_be_turned_is_refused(call, words):
    motion = MOTIONS[23]
    refused(words, call, motion.skeleton, motion.positions)
