"""Root paths: geometry, speed, and strict reading of files."""

import numpy as np
import pytest
from builders import refused

from f3amd_lib.motion.root_paths import NAMES, named_path, path_from_motion, read_path_csv
from f3amd_lib.motion.skeleton import Motion, Skeleton


def tangent_gap(path):
    """Largest angle between the facing and the direction of travel, degrees."""
    step = np.diff(path.position, axis=0)
    heading = np.arctan2(step[:, 0], step[:, 1])
    middle = 0.5 * (path.yaw[1:] + path.yaw[:-1])
    return np.rad2deg(np.abs((heading - middle + np.pi) % (2 * np.pi) - np.pi)).max()


@pytest.mark.parametrize("name", NAMES)
def test_starts_at_the_origin_facing_z(name):
    path = named_path(name, 300, seed=5)
    assert path.position.shape == (300, 2) and path.yaw.shape == (300,)
    np.testing.assert_array_equal(path.position[0], 0.0)
    assert path.yaw[0] == 0.0
    # Curvature moves the first step aside by a small angle, at most half of what it turns.
    assert abs(np.arctan2(*path.position[1])) < np.deg2rad(1.5)


@pytest.mark.parametrize("name", [name for name in NAMES if name != "complex"])
@pytest.mark.parametrize("speed", [0.6, 2.0])
def test_constant_speed_along_the_tangent(name, speed):
    path = named_path(name, 900, speed=speed)
    step = np.linalg.norm(np.diff(path.position, axis=0), axis=-1)
    # A chord is a little shorter than its arc: 0.2 % at the tightest curve.
    np.testing.assert_allclose(step * 30.0, speed, rtol=2e-3)
    assert tangent_gap(path) < 0.2


def test_complex_has_speeds_turns_stops_and_directions():
    for seed in range(4):
        path = named_path("complex", 2560, seed=seed)
        step = np.diff(path.position, axis=0)
        speed = 30.0 * np.linalg.norm(step, axis=-1)
        assert speed.max() > 1.5 and speed.max() < 1.2 * 1.6 + 1e-6
        assert (speed < 0.1).any()
        assert np.ptp(path.yaw) > np.pi
        moving = speed > 0.3
        heading = np.arctan2(step[:, 0], step[:, 1])
        apart = np.abs((path.yaw[1:] - heading + np.pi) % (2 * np.pi) - np.pi)[moving]
        assert (apart > np.deg2rad(60)).mean() > 0.03  # sideways or backwards at times
        assert (apart < np.deg2rad(5)).mean() > 0.5  # and straight on for the most part


def test_unknown_name_names_the_nearest():
    refused("did you mean 'spiral'", named_path, "spirale", 10)
    refused("one of straight, circle", named_path, "zzz", 10)


@pytest.mark.parametrize("bad", [{"num_frames": 1}, {"speed": 0.0}, {"speed": np.nan}, {"fps": 0}])
def test_bad_numbers_are_refused(bad):
    refused(next(iter(bad)).split("_")[0], named_path, "circle", **{"num_frames": 10} | bad)


# ------------------------------------------------------------------------------------- CSV files


def write(tmp_path, text):
    file = tmp_path / "walk.csv"
    file.write_text(text, encoding="utf-8")
    return file


def test_csv_with_yaw(tmp_path):
    file = write(tmp_path, "x,z,yaw_deg\r\n0,0,350\r\n0.1,0.2,5\r\n\r\n0.2,0.4,20\r\n")
    path = read_path_csv(file)
    np.testing.assert_allclose(path.position, [[0, 0], [0.1, 0.2], [0.2, 0.4]])
    np.testing.assert_allclose(np.rad2deg(np.diff(path.yaw)), [15.0, 15.0])


def test_csv_columns_in_any_order_and_yaw_from_the_tangent(tmp_path):
    rows = "\n".join(f"0,{0.1 * frame}" for frame in range(4))
    path = read_path_csv(write(tmp_path, f"z, x\n{rows}\n"))
    np.testing.assert_allclose(path.yaw, np.pi / 2)  # along +X


def test_csv_keeps_its_facing_while_standing(tmp_path):
    rows = ["0,0", "0.1,0", "0.2,0", "0.2,0", "0.2,0", "0.2,0"]
    path = read_path_csv(write(tmp_path, "x,z\n" + "\n".join(rows) + "\n"))
    np.testing.assert_allclose(path.yaw, np.pi / 2)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "line 1: the header must be x,z or x,z,yaw_deg, it is empty"),
        ("x,z,yaw\n0,0,0\n", "line 1: the header must be"),
        ("x,z,x\n0,0,0\n", "it is x,z,x"),
        ("x,z\n0,0\n\n0,far\n", "line 4: z is 'far', not a finite number"),
        ("x,z\n0,0\n0,0.1\n0,0.7\n", "line 4: jumps 0.60 m"),
        ("x,z\n0,0\n0\n", "line 3: 1 cells where the header has 2"),
        ("x,z\n0,0\n", "at least 2 rows"),
    ],
)
def test_csv_errors_name_file_and_line(tmp_path, text, message):
    file = write(tmp_path, text)
    with pytest.raises(ValueError, match="walk.csv") as error:
        read_path_csv(file)
    assert message in str(error.value)


def test_path_from_motion():
    skeleton = Skeleton(("Hips", "LeftHip", "RightHip"), (-1, 0, 0), np.array([[0, 0, 0], [0.1, 0, 0], [-0.1, 0, 0]]))
    root = np.array([[1.0, 0.9, 2.0], [1.0, 0.9, 2.1]])
    motion = Motion(skeleton, root, np.tile(np.eye(3), (2, 3, 1, 1)), fps=60.0)
    path = path_from_motion(motion)
    np.testing.assert_allclose(path.position, [[1.0, 2.0], [1.0, 2.1]])
    np.testing.assert_allclose(path.yaw, 0.0, atol=1e-12)
    assert path.fps == 60.0
