"""Motion broken on purpose: the recipes do what they say, and the metrics tell."""

import functools

import numpy as np
import pytest
from builders import refused, wandering_motion
from scipy.spatial.transform import Rotation

from f3amd_lib.measures import metrics
from f3amd_lib.measures.corruptions import CORRUPTIONS, corrupt, frozen_pose, noisy_motion, shuffled_frames
from f3amd_lib.measures.real_clips import own_path
from f3amd_lib.motion.rotations import matrix_from_yaw
from f3amd_lib.motion.skeleton import Motion
from f3amd_lib.motion.synthetic import synthesize

WINDOW = 32


@functools.cache
def walker(seed=0, seconds=10.0):
    """A synthetic walk along a path of its own."""
    return synthesize("Neutral", seconds, seed)


@functools.cache
def measured(name=None):
    """Metrics of the walk, broken or not, against the whole walk's own path without its sway."""
    motion = walker() if name is None else corrupt(name, walker())
    path, skeleton = own_path(walker()), motion.skeleton
    values = metrics.first_metrics(motion.positions, path, WINDOW, skeleton)
    return values | metrics.camdm_metrics(motion.positions, path, skeleton)


# ---------------------------------------------------------------------------------------- recipes


@pytest.mark.parametrize("name", CORRUPTIONS)
def test_every_recipe_gives_a_motion_of_the_same_body(name):
    motion = wandering_motion().replace(fps=60.0)
    broken = corrupt(name, motion, seed=3)
    assert broken.skeleton is motion.skeleton
    assert (broken.num_frames, broken.fps, broken.name) == (40, 60.0, motion.name)
    gram = broken.rotations @ np.swapaxes(broken.rotations, -1, -2)
    np.testing.assert_allclose(gram, np.broadcast_to(np.eye(3), gram.shape), atol=1e-9)
    assert np.all(np.linalg.det(broken.rotations) > 0)
    assert not np.allclose(broken.positions, motion.positions, atol=0.01)


@pytest.mark.parametrize("name", CORRUPTIONS)
def test_strength_zero_gives_the_motion_back(name):
    motion = wandering_motion()
    same = corrupt(name, motion, strength=0.0)
    np.testing.assert_allclose(same.root_position, motion.root_position, atol=1e-12)
    np.testing.assert_allclose(same.rotations, motion.rotations, atol=1e-7)


def test_frozen_pose_is_the_first_pose_carried_along_the_path():
    motion = wandering_motion()
    frozen = frozen_pose(motion)
    np.testing.assert_allclose(frozen.root_position[:, [0, 2]], motion.root_position[:, [0, 2]])
    np.testing.assert_allclose(frozen.root_position[:, 1], motion.root_position[0, 1])
    np.testing.assert_allclose(np.exp(1j * frozen.yaw), np.exp(1j * motion.yaw), atol=1e-9)
    # Seen from the hips, turned to its own facing, nothing moves.
    relative = frozen.positions - frozen.positions[:, :1]
    own = np.einsum("tab,tjb->tja", matrix_from_yaw(-frozen.yaw), relative)
    np.testing.assert_allclose(own, np.broadcast_to(own[:1], own.shape), atol=1e-9)
    np.testing.assert_allclose(frozen.positions[0], motion.positions[0], atol=1e-9)


def places(shuffled, motion):
    """Where each frame of the shuffled motion came from."""
    gaps = np.abs(shuffled.root_position[:, None] - motion.root_position[None]).sum(axis=-1)
    return np.argmin(gaps, axis=1)


def test_shuffled_frames_are_the_same_frames_elsewhere():
    motion = wandering_motion()
    shuffled = shuffled_frames(motion, seed=5)
    order = places(shuffled, motion)
    assert sorted(order) == list(range(40))
    assert np.all(order != np.arange(40))
    np.testing.assert_array_equal(shuffled.root_position, motion.root_position[order])
    np.testing.assert_array_equal(shuffled.rotations, motion.rotations[order])


def test_noise_has_the_stated_size():
    motion = walker()
    noisy = noisy_motion(motion, seed=1)
    moved = noisy.root_position - motion.root_position
    assert moved.std() == pytest.approx(0.02, rel=0.05)
    turned = np.swapaxes(motion.rotations, -1, -2) @ noisy.rotations
    angle = Rotation.from_matrix(turned.reshape(-1, 3, 3)).magnitude()
    # To first order each of the three axes turns by a Gaussian angle, 0.05 rad or a little less.
    assert np.sqrt(np.mean(angle**2)) == pytest.approx(np.sqrt(3.0) * 0.05, rel=0.15)
    # One draw for all strengths: half the noise is the same noise, halved.
    half = noisy_motion(motion, seed=1, strength=0.5)
    np.testing.assert_allclose(half.root_position - motion.root_position, 0.5 * moved, atol=1e-12)


# ----------------------------------------------------------------------------- what metrics see


@pytest.mark.parametrize(
    ("name", "key", "least", "most"),
    [
        # A figurine that is pushed: it slides, and neither its joints nor its seams show life.
        ("frozen pose", "foot_sliding", 5.0, np.inf),
        ("frozen pose", "joint_acceleration_cm", 0.0, 0.5),
        ("frozen pose", "ird_excess_cm", 0.0, 0.5),
        # Frames that jump metres.
        ("shuffled frames", "trajectory_error_m", 10.0, np.inf),
        ("shuffled frames", "joint_acceleration_cm", 100.0, np.inf),
        # Trembling.
        ("noisy motion", "trajectory_error_m", 1.5, np.inf),
        ("noisy motion", "ird_excess_cm", 5.0, np.inf),
        ("noisy motion", "joint_acceleration_cm", 5.0, np.inf),
    ],
)
def test_each_bad_generator_is_seen(name, key, least, most):
    """Between which factors of the whole walk's own figure the broken one lies."""
    assert least < measured(name)[key] / measured()[key] < most


@pytest.mark.parametrize("name", CORRUPTIONS)
def test_every_bad_generator_is_smoother_than_a_walk_by_the_paper(name):
    """A root that jumps or trembles divides the acceleration of the joints away; so does a pose
    that is held. Lower, which the paper calls better, is here worse."""
    assert measured(name)["smoothness"] < 0.8 * measured()["smoothness"]


# ----------------------------------------------------------------------------------------- errors


def test_motion_that_a_recipe_cannot_break_is_refused():
    whole = wandering_motion()
    alone = Motion.from_positions(whole.skeleton, whole.positions)
    for name in CORRUPTIONS:
        refused(f"the corruption '{name}' needs rotations", corrupt, name, alone)
        refused("strength must lie between 0 .* and 1", corrupt, name, whole, strength=np.nan)
    refused("a single frame cannot be shuffled", corrupt, "shuffled frames", whole.slice(0, 1))
    refused("unknown corruption 'frozen'; did you mean 'frozen pose'", corrupt, "frozen", whole)


@pytest.mark.parametrize("name", ["shuffled frames", "noisy motion"])
def test_the_seed_decides_what_is_random(name):
    one, again, other = (corrupt(name, wandering_motion(30), seed=seed).root_position for seed in (1, 1, 2))
    np.testing.assert_array_equal(one, again)
    assert np.abs(one - other).max() > 0.01
