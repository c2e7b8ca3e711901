"""What `write_bvh` writes, read by another library: pybvh, which shares no code with ours."""

import numpy as np
import pybvh
import pytest
from builders import wandering_motion

from f3amd_lib.motion.bvh import write_bvh
from f3amd_lib.motion.skeleton import forward_kinematics, turn
from f3amd_lib.motion.synthetic import synthesize


def opened(tmp_path, motion):
    """The motion as pybvh sees it."""
    return pybvh.read_bvh_file(write_bvh(tmp_path / "written.bvh", motion, overwrite=True))


def metres_by_name(bvh) -> dict[str, np.ndarray]:
    """Joint name -> positions [T, 3] by pybvh's own kinematics; centimetres in the file."""
    positions = bvh.joint_positions()
    return {name: 0.01 * positions[:, joint] for joint, name in enumerate(bvh.joint_names)}


@pytest.fixture(scope="module")
def walk():
    return synthesize("LimpLeft", 1.5)


def test_joints_are_where_we_put_them_in_every_frame(tmp_path, walk):
    for motion in (walk, wandering_motion(25, seed=3)):
        seen = metres_by_name(opened(tmp_path, motion))
        assert sorted(seen) == sorted(motion.skeleton.names)
        for joint, name in enumerate(motion.skeleton.names):
            np.testing.assert_allclose(seen[name], motion.positions[:, joint], atol=1e-6, err_msg=name)


def test_the_rest_pose_is_the_skeleton(tmp_path, walk):
    skeleton = walk.skeleton
    bvh = opened(tmp_path, walk)
    eye = np.broadcast_to(np.eye(3), (skeleton.num_joints, 3, 3))
    ours = forward_kinematics(skeleton, np.zeros(3), np.array(eye))
    rest = 0.01 * bvh.rest_pose_positions()
    place = bvh.node_index
    for joint, name in enumerate(skeleton.names):
        np.testing.assert_allclose(rest[place[name]], ours[joint], atol=1e-6, err_msg=name)
    parents = {node.name: node.parent.name if node.parent else None for node in bvh.nodes if not node.is_end_site()}
    wanted = [None, *(skeleton.names[parent] for parent in skeleton.parents[1:])]
    assert parents == dict(zip(skeleton.names, wanted, strict=True))


def test_up_and_forward_are_the_axes_that_other_programs_find(tmp_path, walk):
    bvh = opened(tmp_path, walk)
    assert str(bvh.world_up) == bvh.rest_up == "+y"
    # Which way it faces, by geometry and names of the other library.
    for degrees, axis in ((0, "+z"), (90, "+x"), (180, "-z"), (-90, "-x")):
        facing = np.deg2rad(degrees) - walk.yaw[0]
        assert str(opened(tmp_path, turn(walk, facing)).forward_at(0)) == axis


def test_tips_come_along(tmp_path):
    motion = wandering_motion(5)
    bvh = opened(tmp_path, motion)
    ends = [node for node in bvh.nodes if node.is_end_site()]
    by_parent = {node.parent.name: 0.01 * np.asarray(node.offset) for node in ends}
    np.testing.assert_allclose(by_parent["Spine"], [0.0, 0.2, 0.0], atol=1e-8)
    # A limb without a tip of its own ends where its joint is.
    np.testing.assert_array_equal(by_parent["LeftToeBase"], 0.0)
