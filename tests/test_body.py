"""The procedural body: closed, as large as people are, moved by its bones, the same in a mirror."""

import jax.numpy as jnp
import numpy as np
import pytest
from builders import SKELETON
from scipy.spatial import cKDTree
from test_skeleton import BANDAI, legs, random_motion

from f3amd_lib.motion.anatomy import joint_roles
from f3amd_lib.motion.skeleton import Skeleton, global_rotations, mirror
from f3amd_lib.motion.synthetic import SYNTHETIC_SKELETON
from f3amd_lib.text.data.body import SIDES, body_capsules, capsule_mesh, make_body, pose_body

RIGS = pytest.mark.parametrize("rig", [SYNTHETIC_SKELETON, BANDAI], ids=["100style-like", "bandai"])


@RIGS
def test_roles_are_found_by_name_and_by_tree(rig):
    roles = joint_roles(rig)
    assert len(set(roles.values())) == len(roles) == rig.num_joints
    names = {role: rig.names[joint] for role, joint in roles.items()}
    if rig is BANDAI:
        wanted = {"left_elbow": "LowerArm_L", "right_knee": "LowerLeg_R", "neck": "Neck", "right_collar": "Shoulder_R"}
    else:
        wanted = {"left_elbow": "LeftElbow", "right_knee": "RightKnee", "neck": "Neck", "right_collar": "RightCollar"}
    assert wanted.items() <= names.items()
    by_names_alone = ("hips", "left_hip", "left_toe", "right_hip", "right_toe")
    assert joint_roles(legs()) == {role: joint for joint, role in enumerate(by_names_alone)}


@RIGS
def test_weights_sum_to_one_and_about_a_thousand_vertices_are_there(rig):
    body = make_body(rig)
    assert 1000 <= len(body.vertices) <= 1200
    np.testing.assert_allclose(body.weights.sum(axis=1), 1.0)
    assert set(body.faces.ravel()) == set(range(len(body.vertices)))
    assert body.joints.min() >= 0 and body.joints.max() < rig.num_joints
    assert body.joints.shape == body.weights.shape == (len(body.vertices), 1)


def test_a_capsule_is_closed_and_its_faces_look_outwards():
    for capsule in body_capsules(SYNTHETIC_SKELETON):
        vertices, faces = capsule_mesh(capsule)
        assert len(vertices) == 5 * SIDES + 2
        edges = {tuple(edge) for a, b, c in faces for edge in ((a, b), (b, c), (c, a))}
        assert len(edges) == 3 * len(faces)  # no edge runs twice in one direction
        assert {(b, a) for a, b in edges} == edges
        triangles = vertices[faces]
        normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
        outwards = triangles.mean(axis=1) - (np.array(capsule.start) + np.array(capsule.end)) / 2
        assert ((normals * outwards).sum(axis=-1) > 0).all()


@RIGS
def test_every_vertex_moves_rigidly_with_its_bone(rig):
    motion, body = random_motion(rig), make_body(rig)
    moved = pose_body(body, rig, motion.root_position, motion.rotations)
    joints = body.joints[:, 0]
    turned = global_rotations(rig, motion.rotations)
    local = np.einsum("tvba,tvb->tva", turned[:, joints], moved - motion.positions[:, joints])
    np.testing.assert_allclose(local, np.broadcast_to(local[:1], local.shape), atol=1e-9)
    # Another joint's frame sees it move: the test can fail.
    wrong = np.einsum("tvba,tvb->tva", turned[:, joints - 1], moved - motion.positions[:, joints - 1])
    assert np.ptp(wrong, axis=0).max() > 0.1
    in_jax = pose_body(body, rig, jnp.asarray(motion.root_position), jnp.asarray(motion.rotations))
    np.testing.assert_allclose(in_jax, moved, atol=1e-4)


@RIGS
def test_the_body_of_a_mirrored_motion_is_the_mirror_image(rig):
    motion, body = random_motion(rig, frames=3), make_body(rig)
    seen = pose_body(body, rig, motion.root_position, motion.rotations) * [-1.0, 1.0, 1.0]
    other = mirror(motion)
    again = pose_body(body, rig, other.root_position, other.rotations)
    twins = np.array(rig.mirror_permutation)[body.joints[:, 0]]
    for frame in range(3):
        for joint in range(rig.num_joints):
            own, image = again[frame, body.joints[:, 0] == joint], seen[frame, twins == joint]
            if len(own):
                assert cKDTree(own).query(image)[0].max() < 1e-3
    unlike = pose_body(body, rig, motion.root_position, motion.rotations)
    assert cKDTree(unlike[0]).query(seen[0])[0].max() > 0.1


def test_rigs_that_we_do_not_know_get_thin_limbs():
    pole = Skeleton(("Root", "Mid", "Tip"), (-1, 0, 1), [[0, 0, 0], [0, 1, 0], [0, 1, 0]])
    body = make_body(pole)
    assert len(body.vertices) == 2 * 42
    assert np.ptp(body.vertices[:, 0]) < 0.1
    assert make_body(SKELETON).vertices.shape[1] == 3
