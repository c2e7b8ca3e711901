"""A skeleton's body as a mesh for networks: posed by positions, with its neighbours at several levels.

Capsules are components of their own, which no edge joins: near is what is near along the body, from a vertex to the
joint and on into the next limb. Such distances are those of every pose, so that a hand at the hip is no neighbour.

Source: ours; levels and lists are what the layers of Zhou et al. 2020 ask for.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.sparse.csgraph import shortest_path
from scipy.spatial.distance import cdist

from f3amd_lib.ground.arrays import array_module
from f3amd_lib.motion.inverse_kinematics import fit_rotations
from f3amd_lib.motion.skeleton import Skeleton
from f3amd_lib.text.data.body import Body, make_body, pose_body


class MeshLists(NamedTuple):
    """Neighbours of vertices, by level from fine to coarse: numbers of vertices.

    Attributes:
      around: of each vertex on its own level, [V_l, K] for all but the coarsest.
      down: of each vertex of the next, coarser level on this one, [V_l+1, K].
      up: of each vertex of this level on the next, coarser one, [V_l, K].
    """

    around: tuple[np.ndarray, ...]
    down: tuple[np.ndarray, ...]
    up: tuple[np.ndarray, ...]


def mesh_lists(distances, levels: Sequence[int], around: Sequence[int], down: Sequence[int], up: Sequence[int]):
    """Return the `MeshLists` of a mesh; each level has the first vertices of a farthest-point sampling.

    Args:
      distances: between vertices, [V, V], metres; told apart from a micrometre on.
      levels: vertices of each level, V first.
      around, down, up: neighbours in each list, for each step from one level to the next.

    Raises:
      ValueError: for another number of vertices.
    """
    distances = np.round(np.asarray(distances, np.float64), 6)
    if distances.shape != (levels[0], levels[0]):
        raise ValueError(f"levels begin with {levels[0]} vertices, the body has {len(distances)}")
    np.fill_diagonal(distances, -1.0)  # a vertex is its own nearest, even where another lies on it
    order, reach = [0], distances[0]
    while len(order) < levels[1]:
        order.append(int(np.argmax(reach)))
        reach = np.minimum(reach, distances[order[-1]])
    members = [np.arange(levels[0]), *(np.array(order[:count]) for count in levels[1:])]
    nearest = lambda of, among, count: np.argsort(distances[np.ix_(of, among)], axis=1, kind="stable")[:, :count]
    steps = list(zip(members[:-1], members[1:], strict=True))
    return MeshLists(
        tuple(nearest(fine, fine, count) for fine, count in zip(members[:-1], around, strict=True)),
        tuple(nearest(coarse, fine, count) for (fine, coarse), count in zip(steps, down, strict=True)),
        tuple(nearest(fine, coarse, count) for (fine, coarse), count in zip(steps, up, strict=True)),
    )


def standing(skeleton: Skeleton, poses) -> Skeleton:
    """Return a skeleton whose bones, as long as before, point at rest as they do in the mean of poses.

    Rest poses of capture files are what an exporter made of them. From a natural one the smallest turns to others are
    small, and limbs keep their twist.

    Args:
      skeleton: J joints.
      poses: positions, [N, J, 3], metres, all facing one way: first frames of clips.
    """
    mean = np.mean(poses, axis=0, dtype=np.float64)
    bones = mean - mean[[max(parent, 0) for parent in skeleton.parents]]
    length, own = (np.linalg.norm(vectors, axis=-1, keepdims=True) for vectors in (bones, skeleton.offsets))
    offsets = np.where(length > 1e-6, bones / np.maximum(length, 1e-6) * own, skeleton.offsets)
    return dataclasses.replace(skeleton, offsets=offsets.astype(np.float32), end_sites=())  # as files keep them


def body_distances(skeleton: Skeleton, body: Body) -> np.ndarray:
    """Return how far vertices are from each other along the body, [V, V], metres, whatever the pose.

    Straight within what one joint carries; from limb to limb by way of the joints between them.
    """
    carrier = body.joints[:, 0]
    points = np.concatenate([body.vertices, skeleton.rest_positions])
    graph = np.full((len(points), len(points)), np.inf)
    for joint in range(skeleton.num_joints):
        ends = len(carrier) + np.array([joint, *skeleton.children[joint]])
        rigid = np.concatenate([np.flatnonzero(carrier == joint), ends])
        # A distance of nothing would be no edge at all.
        graph[np.ix_(rigid, rigid)] = np.maximum(cdist(points[rigid], points[rigid]), 1e-9)
    joints = len(carrier) + np.arange(skeleton.num_joints)
    to_joint = shortest_path(graph[np.ix_(joints, joints)])
    near = graph[: len(carrier), joints]
    there = np.min(near[:, :, None] + to_joint, axis=1)
    through = np.min(there[:, None] + near, axis=-1)
    return np.minimum(graph[: len(carrier), : len(carrier)], through)


def joint_weights(skeleton: Skeleton, body: Body) -> np.ndarray:
    """Return weights [J, V] that make joints of vertices, exactly in every pose of the body; rows sum to 1.

    A joint is the mean of least weights of what it carries, or, where that is nothing, of what its parent carries.
    """
    weights = np.zeros((skeleton.num_joints, len(body.vertices)))
    for joint in range(skeleton.num_joints):
        carrier = joint
        while not np.any(own := body.joints[:, 0] == carrier):
            carrier = skeleton.parents[carrier]
        local = body.vertices[own] - skeleton.rest_positions[joint]
        sides = np.concatenate([local.T, np.ones((1, len(local)))])
        weights[joint, own] = np.linalg.lstsq(sides, [0.0, 0.0, 0.0, 1.0])[0]
    return weights


@dataclass(frozen=True, eq=False)
class BodyMesh:
    """The body of a skeleton, with what a network of meshes needs.

    Attributes:
      skeleton: at rest as its body is (`standing`).
      body: V vertices.
      lists: their neighbours.
      regressor: joints from vertices, [J, V].
    """

    skeleton: Skeleton
    body: Body
    lists: MeshLists
    regressor: np.ndarray

    @classmethod
    def of(cls, skeleton: Skeleton, levels: Sequence[int], **neighbours) -> BodyMesh:
        """Return that of a skeleton: levels and numbers of neighbours as for `mesh_lists`."""
        body = make_body(skeleton)
        lists = mesh_lists(body_distances(skeleton, body), levels, **neighbours)
        return cls(skeleton, body, lists, joint_weights(skeleton, body))

    def vertices(self, positions):
        """Return the vertices [T, V, 3] of positions [T, J, 3], metres; bones are turned as `fit_rotations` does."""
        return pose_body(self.body, self.skeleton, *fit_rotations(self.skeleton, positions))

    def joints(self, vertices):
        """Return the joints [..., J, 3] of vertices [..., V, 3], in whatever unit."""
        xp = array_module(vertices)
        return xp.einsum("jv,...vc->...jc", self.regressor.astype(vertices.dtype), vertices)
