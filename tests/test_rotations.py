"""Rotations: conventions by hand, round trips, and numpy against JAX."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from f3amd_lib.motion import rotations


def elementary(axis: str, angle: float) -> np.ndarray:
    """A right-handed turn about one axis, written out."""
    c, s = np.cos(angle), np.sin(angle)
    turns = {
        "X": [[1, 0, 0], [0, c, -s], [0, s, c]],
        "Y": [[c, 0, s], [0, 1, 0], [-s, 0, c]],
        "Z": [[c, -s, 0], [s, c, 0], [0, 0, 1]],
    }
    return np.array(turns[axis])


def random_matrices(count: int, seed: int = 0) -> np.ndarray:
    return Rotation.random(count, random_state=seed).as_matrix()


def test_6d_is_the_first_two_columns():
    matrix = np.arange(9.0).reshape(3, 3)
    np.testing.assert_array_equal(rotations.rotation_6d_from_matrix(matrix), [0.0, 3.0, 6.0, 1.0, 4.0, 7.0])


def test_gram_schmidt_forgives_scale_and_shear():
    matrices = random_matrices(200, seed=1)
    rng = np.random.default_rng(2)
    first, second = matrices[..., 0], matrices[..., 1]
    scale = rng.uniform(0.2, 5.0, (200, 2))
    shear = rng.uniform(-2.0, 2.0, (200, 1))
    bent = np.concatenate([scale[:, :1] * first, scale[:, 1:] * second + shear * first], axis=-1)
    np.testing.assert_allclose(rotations.matrix_from_rotation_6d(bent), matrices, atol=1e-12)


@pytest.mark.parametrize(("yaw_deg", "facing"), [(0, (0, 0, 1)), (90, (1, 0, 0)), (180, (0, 0, -1)), (-90, (-1, 0, 0))])
def test_positive_yaw_turns_from_z_to_x(yaw_deg, facing):
    matrix = rotations.matrix_from_yaw(np.radians(float(yaw_deg)))
    np.testing.assert_allclose(matrix @ [0.0, 0.0, 1.0], facing, atol=1e-12)
    np.testing.assert_allclose(matrix @ [0.0, 1.0, 0.0], [0, 1, 0], atol=1e-12)


def test_wrap_angle_by_hand():
    angles = np.array([0.0, np.pi, -np.pi, 1.5 * np.pi, -1.5 * np.pi, 2 * np.pi, 7.0])
    wrapped = [0.0, -np.pi, -np.pi, -0.5 * np.pi, 0.5 * np.pi, 0.0, 7.0 - 2 * np.pi]
    np.testing.assert_allclose(rotations.wrap_angle(angles), wrapped, atol=1e-12)


@pytest.mark.parametrize("order", ["ZXY", "YXZ", "XYZ", "ZYX"])
def test_euler_order_is_that_of_the_file(order):
    degrees = np.array([[20.0, -35.0, 50.0], [-100.0, 10.0, 5.0]])
    expected = [
        np.linalg.multi_dot([elementary(a, np.radians(d)) for a, d in zip(order, row, strict=True)]) for row in degrees
    ]
    matrices = rotations.matrix_from_euler(order, degrees)
    np.testing.assert_allclose(matrices, expected, atol=1e-12)
    np.testing.assert_allclose(rotations.euler_from_matrix(order, matrices), degrees, atol=1e-9)


def test_slerp_goes_the_short_way():
    first, second = elementary("Y", np.radians(170.0)), elementary("Y", np.radians(-170.0))
    for weight, degrees in ((0.0, 170.0), (0.25, 175.0), (0.5, 180.0), (1.0, 190.0)):
        between = rotations.slerp_matrices(first, second, np.array(weight))
        np.testing.assert_allclose(between, elementary("Y", np.radians(degrees)), atol=1e-9)


@pytest.mark.parametrize(
    ("function", "shape"),
    [
        (rotations.matrix_from_rotation_6d, (7, 6)),
        (rotations.rotation_6d_from_matrix, (7, 3, 3)),
        (rotations.matrix_from_yaw, (7,)),
        (rotations.wrap_angle, (7,)),
    ],
)
def test_numpy_and_jax_agree_and_answer_in_kind(function, shape):
    values = np.random.default_rng(4).standard_normal(shape).astype(np.float32)
    in_numpy, in_jax = function(values), function(jnp.asarray(values))
    assert isinstance(in_numpy, np.ndarray)
    assert isinstance(in_jax, jax.Array)
    np.testing.assert_allclose(np.asarray(in_jax), in_numpy, atol=2e-6)
