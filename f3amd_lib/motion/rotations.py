"""Rotations: 6D, matrices and Euler angles, facing and yaw.

Every function takes numpy or JAX arrays and answers in kind, so that the same few lines serve the
data pipeline (numpy) and the losses (JAX). Matrices act on column vectors. +Y is up; a character
with yaw 0 faces +Z, a positive yaw is a turn to its left (towards +X).
"""

import numpy as np
from scipy.spatial.transform import Rotation

from f3amd_lib.ground.arrays import array_module


def rotation_6d_from_matrix(matrix):
    """Keep the first two columns of a rotation matrix, one after the other.

    Args:
      matrix: rotation matrices, [..., 3, 3].

    Returns:
      6D rotations, [..., 6]: (R00 R10 R20 R01 R11 R21).

    Source: paper section 3.2; Zhou et al. 2019, section 4 (columns, not rows).
    """
    xp = array_module(matrix)
    return xp.concatenate([matrix[..., :, 0], matrix[..., :, 1]], axis=-1)


def matrix_from_rotation_6d(rotation_6d):
    """Turn any six numbers into a rotation matrix by Gram-Schmidt.

    Args:
      rotation_6d: [..., 6], first column then second column; need not be orthonormal.

    Returns:
      Rotation matrices, [..., 3, 3], determinant +1.

    Source: paper section 3.2; Zhou et al. 2019, Eq. 15.
    """
    xp = array_module(rotation_6d)
    first, second = rotation_6d[..., 0:3], rotation_6d[..., 3:6]

    def unit(vector):  # with a finite gradient at zero length
        return vector / xp.sqrt(xp.sum(vector * vector, axis=-1, keepdims=True) + 1e-8 * 1e-8)

    column_x = unit(first)
    column_y = unit(second - xp.sum(column_x * second, axis=-1, keepdims=True) * column_x)
    column_z = xp.cross(column_x, column_y)
    return xp.stack([column_x, column_y, column_z], axis=-1)


def matrix_from_yaw(yaw):
    """Return the rotation about +Y that turns +Z to (sin yaw, 0, cos yaw).

    Args:
      yaw: radians, [...].

    Returns:
      Rotation matrices, [..., 3, 3].
    """
    xp = array_module(yaw)
    cosine, sine = xp.cos(yaw), xp.sin(yaw)
    zero, one = xp.zeros_like(cosine), xp.ones_like(cosine)
    rows = [
        xp.stack([cosine, zero, sine], axis=-1),
        xp.stack([zero, one, zero], axis=-1),
        xp.stack([-sine, zero, cosine], axis=-1),
    ]
    return xp.stack(rows, axis=-2)


def wrap_angle(angle):
    """Map angles to [-pi, pi), radians, any shape."""
    xp = array_module(angle)
    return xp.mod(angle + xp.pi, 2.0 * xp.pi) - xp.pi


def matrix_from_euler(order: str, degrees: np.ndarray) -> np.ndarray:
    """Turn intrinsic Euler angles into matrices (numpy only).

    Args:
      order: axes in the order in which a BVH file lists them, such as "ZXY"; R = Rz Rx Ry.
      degrees: [..., len(order)].

    Returns:
      Rotation matrices, [..., 3, 3], float64.
    """
    degrees = np.asarray(degrees, dtype=np.float64)
    flat = degrees.reshape(-1, len(order))
    matrices = Rotation.from_euler(order, flat, degrees=True).as_matrix()
    return matrices.reshape(*degrees.shape[:-1], 3, 3)


def euler_from_matrix(order: str, matrix: np.ndarray) -> np.ndarray:
    """Turn matrices into intrinsic Euler angles in degrees (numpy only).

    Args:
      order: three axes, such as "ZXY" for R = Rz Rx Ry.
      matrix: [..., 3, 3].

    Returns:
      Degrees, [..., 3]. At gimbal lock one of the many equal answers is given.
    """
    matrix = np.asarray(matrix, dtype=np.float64)
    rotation = Rotation.from_matrix(matrix.reshape(-1, 3, 3))
    return rotation.as_euler(order, degrees=True).reshape(*matrix.shape[:-2], 3)


def shortest_turn(start, end):
    """Return the smallest rotation that carries one direction to another.

    Args:
      start, end: directions of any length but 0, [..., 3].

    Returns:
      Rotation matrices, [..., 3, 3]. Of opposite directions one of the many half turns.
    """
    xp = array_module(start, end)
    start, end = (vector / xp.linalg.norm(vector, axis=-1, keepdims=True) for vector in (start, end))
    start, end = xp.broadcast_arrays(start, end)
    # A half turn about the middle direction, after one about the start, is the turn from start to end.
    middle = start + end
    opposite = xp.linalg.norm(middle, axis=-1) < 1e-9
    across = xp.cross(start, xp.eye(3, dtype=start.dtype)[xp.argmin(xp.abs(start), axis=-1)])
    middle = xp.where(opposite[..., None], across, middle)
    middle = middle / xp.linalg.norm(middle, axis=-1, keepdims=True)
    # Two half turns H(m) H(s), H(a) = 2 a a' - 1, multiplied out.
    along = xp.sum(middle * start, axis=-1)[..., None, None]
    outer = lambda one, other: one[..., :, None] * other[..., None, :]
    turn = 4.0 * along * outer(middle, start) - 2.0 * outer(middle, middle) - 2.0 * outer(start, start)
    return turn + xp.eye(3, dtype=start.dtype)


def slerp_matrices(first: np.ndarray, second: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Interpolate rotations along the shortest arc (numpy only).

    Args:
      first, second: rotation matrices, [..., 3, 3].
      weight: 0 gives `first`, 1 gives `second`; broadcast against [...].

    Returns:
      Rotation matrices, [..., 3, 3].
    """
    first, second = np.broadcast_arrays(np.asarray(first, float), np.asarray(second, float))
    shape = first.shape[:-2]
    start = Rotation.from_matrix(first.reshape(-1, 3, 3))
    step = (start.inv() * Rotation.from_matrix(second.reshape(-1, 3, 3))).as_rotvec()
    amount = np.broadcast_to(np.asarray(weight, float), shape).reshape(-1, 1)
    return (start * Rotation.from_rotvec(amount * step)).as_matrix().reshape(*shape, 3, 3)
