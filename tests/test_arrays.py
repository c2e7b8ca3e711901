"""The check of arrays that people hand in: what passes and what is refused."""

import numpy as np
import pytest
from builders import refused

from f3amd_lib.ground.arrays import finite_array


def test_what_fits_comes_back_as_an_array():
    array = finite_array("path", [[1, 2], [3, 4], [5, 6]], ("frame", 2))
    assert array.dtype == np.float64 and array.shape == (3, 2)
    single = np.zeros((2, 5), np.float32)
    assert finite_array("path", single, (2, "frame"), dtype=None) is single
    assert finite_array("floor", 0.5, ()) == 0.5


@pytest.mark.parametrize("value", [np.zeros(3), np.zeros((3, 3)), np.zeros((0, 2)), np.zeros((1, 3, 2))])
def test_another_shape_is_refused_and_named(value):
    refused(r"path must be \[frame, 2\]", finite_array, "path", value, ("frame", 2))


def test_the_first_number_that_is_not_finite_is_found():
    value = np.zeros((4, 3, 2))
    value[2, 1, 0], value[3, 0, 0] = np.inf, np.nan
    refused("path is not finite at character 2, frame 1$", finite_array, "path", value, ("character", "frame", 2))
    refused(r"path is not finite at \[2, 1, 0\]", finite_array, "path", value, (4, 3, 2))
