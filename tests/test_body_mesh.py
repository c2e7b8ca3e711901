"""The body as a mesh: lists that reach every vertex, distances along the body, joints from vertices, LSD both ways."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from builders import SKELETON, refused, wandering_motion
from scipy.spatial.transform import Rotation

from f3amd_lib.motion import synthetic
from f3amd_lib.motion.skeleton import Skeleton
from f3amd_lib.text.data.body import make_body, pose_body
from f3amd_lib.text.data.body_mesh import BodyMesh, body_distances, joint_weights, mesh_lists, standing
from f3amd_lib.text.judge.text_metrics import laplacian_surface_distance

MOTION = wandering_motion(12)
NEIGHBOURS = {"around": (5, 4), "down": (16, 12), "up": (3, 2)}
BODY = make_body(SKELETON)
MESH = BodyMesh.of(SKELETON, (len(BODY.vertices), 40, 12), **NEIGHBOURS)


def test_lists_have_their_sizes_begin_with_the_vertex_itself_and_reach_all():
    levels = (len(BODY.vertices), 40, 12)
    sizes = [(levels[0], 5), (40, 4), (40, 16), (12, 12), (levels[0], 3), (40, 2)]
    assert [one.shape for part in MESH.lists for one in part] == sizes
    for fine, around in zip(levels, MESH.lists.around, strict=False):
        np.testing.assert_array_equal(around[:, 0], np.arange(fine))
        assert all(len(set(row)) == len(row) for row in around)
    for fine, coarse, down, up in zip(levels, levels[1:], MESH.lists.down, MESH.lists.up, strict=False):
        assert set(down.ravel()) == set(range(fine)) and set(up.ravel()) == set(range(coarse))
        np.testing.assert_array_equal(up[down[:, 0], 0], np.arange(coarse))  # a coarse vertex is a fine one, too
    # A line of points by hand: the farthest from 0 is 4, and then 2.
    line = np.abs(np.subtract.outer(np.arange(5.0), np.arange(5.0)))
    lists = mesh_lists(line, (5, 3), (2,), (2,), (1,))
    assert lists.down[0].tolist() == [[0, 1], [4, 3], [2, 1]] and lists.up[0].ravel().tolist() == [0, 0, 2, 1, 1]
    refused("levels begin with 6 vertices, the body has 5", mesh_lists, line, (6, 3), (2,), (2,), (1,))


def test_distances_go_along_the_body():
    far, carrier = body_distances(SKELETON, BODY), BODY.joints[:, 0]
    np.testing.assert_allclose(far, far.T, atol=1e-9)
    straight = np.linalg.norm(BODY.vertices[:, None] - BODY.vertices[None], axis=-1)
    assert (far >= straight - 1e-9).all()
    same = carrier[:, None] == carrier[None]
    np.testing.assert_allclose(far[same], straight[same], atol=1e-8)
    left, right = (np.flatnonzero(carrier == SKELETON.index(f"{side}UpLeg")) for side in ("Left", "Right"))
    pair = np.unravel_index(np.argmin(straight[np.ix_(left, right)]), (len(left), len(right)))
    one, other = left[pair[0]], right[pair[1]]
    hips = SKELETON.offsets[[2, 4]]  # the joints where the thighs begin; the way leads through both
    way = np.linalg.norm(BODY.vertices[one] - hips[0]) + 0.2 + np.linalg.norm(BODY.vertices[other] - hips[1])
    assert far[one, other] == pytest.approx(way) and way > 1.2 * straight[one, other]


def test_joints_come_of_vertices_in_every_pose_and_in_jax():
    vertices = MESH.vertices(MOTION.positions)
    np.testing.assert_allclose(MESH.joints(vertices), MOTION.positions, atol=1e-8)
    made = jax.jit(MESH.vertices)(jnp.asarray(MOTION.positions, jnp.float32))
    np.testing.assert_allclose(made, vertices, atol=1e-4)
    weights = joint_weights(SKELETON, BODY)
    np.testing.assert_allclose(weights.sum(axis=1), 1.0)
    np.testing.assert_allclose(weights @ (vertices[0] + [0.3, -2.0, 1.0]), MOTION.positions[0] + [0.3, -2.0, 1.0])
    assert np.abs(weights).max() < 0.2  # no joint hangs on a few vertices


def test_a_body_stands_as_people_do_on_average_with_its_own_bones():
    walk = synthetic.synthesize("Neutral", seconds=1.0, seed=0)
    rest = standing(walk.skeleton, walk.positions)
    assert rest.names == walk.skeleton.names and rest.end_sites == ()
    lengths = lambda skeleton: np.linalg.norm(skeleton.offsets, axis=-1)
    np.testing.assert_allclose(lengths(rest), lengths(walk.skeleton), atol=1e-6)
    # An exporter's rest pose in which one leg points up: from there its turns would be near half ones.
    odd = Skeleton(SKELETON.names, SKELETON.parents, SKELETON.offsets * np.where(np.arange(6) == 3, -1.0, 1.0)[:, None])
    upright = standing(odd, MOTION.positions)
    assert upright.offsets[3, 1] < -0.5 < 0.5 < odd.offsets[3, 1]


def test_lsd_is_nothing_for_posed_and_turned_bodies_and_large_for_crumpled_ones():
    generator = np.random.default_rng(0)
    turns = Rotation.from_rotvec(generator.normal(size=(6 * 4, 3))).as_matrix().reshape(4, 6, 3, 3)
    posed = pose_body(BODY, SKELETON, generator.normal(size=(4, 3)), turns)
    distance = lambda vertices: laplacian_surface_distance(vertices, BODY.vertices, BODY.faces)
    np.testing.assert_allclose(distance(posed), 0.0, atol=1e-12)
    assert distance(BODY.vertices) == 0.0 and distance(posed[None]).shape == (1, 4)
    crumpled = posed + 0.02 * generator.normal(size=posed.shape)
    assert (distance(crumpled) > 0.01).all()
    bumps = distance(np.zeros_like(BODY.vertices))  # all in one point: nothing is left of any bump
    np.testing.assert_allclose(distance(3.0 * BODY.vertices), 2.0 * bumps)


def test_lsd_by_hand():
    """A tetrahedron of four corners: each bump is 4/3 of the way from the middle."""
    corners = np.array([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
    faces = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 1], [1, 3, 2]])
    assert laplacian_surface_distance(2.0 * corners, corners, faces) == pytest.approx(4 / 3 * 3**0.5)
