"""Rotations from positions: exact where the positions are the skeleton's own, honest about the rest where not."""

import numpy as np
import pytest
from builders import SKELETON, wandering_motion
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from f3amd_lib.motion import synthetic
from f3amd_lib.motion.bvh import format_bvh, parse_bvh
from f3amd_lib.motion.inverse_kinematics import fit_rotations, fitted
from f3amd_lib.motion.skeleton import Motion, Skeleton, forward_kinematics

WALKER = synthetic.synthesize("Neutral", seconds=1.0, seed=0).skeleton
CHAIN = Skeleton(("a", "b", "c", "d"), (-1, 0, 1, 2), [[0, 0, 0], [0, 1, 0], [0, 0, 0], [0.3, 0, 0]])
SKELETONS = {"six joints": SKELETON, "walker": WALKER, "a chain with a bone of no length": CHAIN}


@pytest.mark.parametrize("skeleton", SKELETONS.values(), ids=SKELETONS)
@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 2**31), bend=st.floats(0.0, 3.0))
def test_positions_of_the_skeleton_are_met_exactly(skeleton, seed, bend):
    generator = np.random.default_rng(seed)
    turns = generator.normal(size=(5, skeleton.num_joints, 3)) * bend
    rotations = Rotation.from_rotvec(turns.reshape(-1, 3)).as_matrix().reshape(5, skeleton.num_joints, 3, 3)
    positions = forward_kinematics(skeleton, generator.normal(size=(5, 3)), rotations)
    root_position, found = fit_rotations(skeleton, positions)
    np.testing.assert_allclose(forward_kinematics(skeleton, root_position, found), positions, atol=1e-5)
    np.testing.assert_allclose(found @ np.swapaxes(found, -1, -2), np.broadcast_to(np.eye(3), found.shape), atol=1e-9)
    np.testing.assert_allclose(np.linalg.det(found), 1.0)


def test_the_residual_tells_how_far_a_bone_was_stretched():
    own = wandering_motion(6)
    toe = SKELETON.names.index("LeftToeBase")
    bone = own.positions[:, toe] - own.positions[:, SKELETON.parents[toe]]
    stretched = own.positions.copy()
    stretched[:, toe] += 0.06 * bone / np.linalg.norm(bone, axis=-1, keepdims=True)
    made, residual = fitted(Motion.from_positions(SKELETON, stretched, 20.0, "long leg"))
    # A sixth of the 6 cm moves the whole body of six joints; the toe lacks the rest.
    np.testing.assert_allclose(residual[:, toe], 0.05, atol=1e-6)
    np.testing.assert_allclose(np.delete(residual, toe, axis=1), 0.01, atol=1e-6)
    assert (made.fps, made.name) == (20.0, "long leg")
    assert fitted(Motion.from_positions(SKELETON, own.positions))[1].max() < 1e-5


def test_single_bones_are_not_twisted_and_the_motion_survives_a_bvh_file():
    own = wandering_motion(6)
    made, _ = fitted(Motion.from_positions(SKELETON, own.positions, own.fps))
    for joint in (2, 4):  # one child each
        axis = Rotation.from_matrix(made.rotations[:, joint]).as_rotvec()
        assert np.abs(axis @ SKELETON.offsets[joint + 1]).max() < 1e-6
    again = parse_bvh(format_bvh(made), "again")
    np.testing.assert_allclose(again.positions, own.positions, atol=1e-4)
