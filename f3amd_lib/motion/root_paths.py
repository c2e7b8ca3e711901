"""Root paths: where a character shall walk, and which way it shall face.

A path is one ground position and one facing angle a frame. It comes from a name (`named_path`), a
CSV file (`read_path_csv`) or a real motion (`path_from_motion`), and it is what the models are
conditioned on (paper section 3.3) and judged against (section 4.4).
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.special import jn_zeros

from f3amd_lib.ground.arrays import finite_array
from f3amd_lib.ground.names import check_known, checked_seed, checked_value
from f3amd_lib.ground.tables import read_text_table
from f3amd_lib.motion.bvh import finite_number
from f3amd_lib.motion.curves import smoothstep
from f3amd_lib.motion.skeleton import Motion

NAMES = ("straight", "circle", "figure-eight", "slalom", "square", "spiral", "complex")
"""The paths that `named_path` knows."""

MAX_STEP = 0.5
"""Longest step between two rows of a path file, metres (15 m/s at 30 fps: nobody runs so fast)."""

MAX_DISTANCE = 1e4
"""Largest number in a file of points: 10 km from the origin, where single precision still tells millimetres."""

MAX_ROWS = 30 * 3600

_SUBSTEPS = 8  # integration steps a frame; leaves about 1e-6 of a path's length in error


@dataclass(frozen=True, eq=False)
class RootPath:
    """A target for the root: one ground position and one facing angle a frame.

    Attributes:
      position: [T, 2], x and z in metres.
      yaw: [T], radians, unwrapped (no jumps of 2 pi); 0 faces +Z, positive turns left.
      fps: frames per second.

    Raises:
      ValueError: for shapes that do not agree, no frames, a bad fps, or numbers not finite.
    """

    position: np.ndarray
    yaw: np.ndarray
    fps: float = 30.0

    def __post_init__(self):
        position = finite_array("path position", self.position, ("frame", 2)).copy()
        yaw = np.unwrap(finite_array("path yaw", self.yaw, (len(position),)))
        checked_value("a path's fps", self.fps, "float")
        for name, array in (("position", position), ("yaw", yaw)):
            array.setflags(write=False)
            object.__setattr__(self, name, array)

    @property
    def num_frames(self) -> int:
        """Number of frames, T."""
        return len(self.position)

    @property
    def length(self) -> float:
        """Length of the walked line, metres."""
        return float(np.linalg.norm(np.diff(self.position, axis=0), axis=-1).sum())

    def slice(self, start: int, stop: int) -> RootPath:
        """Return frames start (included) to stop (excluded)."""
        return dataclasses.replace(self, position=self.position[start:stop], yaw=self.yaw[start:stop])


def named_path(name: str, num_frames: int, *, speed: float = 1.2, seed: int = 0, fps: float = 30.0) -> RootPath:
    """Build one of the named paths.

    Every path starts at the origin, moves and faces along +Z there, and has a continuous heading.
    All but "complex" keep a constant speed and face where they go. A longer path of the same name
    and seed begins with the shorter one.

    | name | shape |
    |---|---|
    | straight | along +Z |
    | circle | to the left, radius 2.5 m |
    | figure-eight | closed, 22.7 m a lap, starts in its crossing; tightest radius 1.5 m |
    | slalom | swings 50 degrees to each side of +Z, a period every 8 m |
    | square | to the left, 6 m sides with rounded corners, starts in the middle of a side |
    | spiral | to the left and outwards, from radius 1 m, arms 1 m apart |
    | complex | by seed: straights, turns, stops, speed changes, sideways and backward stretches |

    "complex" is made in the spirit of section 4.4's "varied speeds, turns, and directions".

    Args:
      name: one of `NAMES`.
      num_frames: number of frames, at least 2.
      speed: metres per second along the path; for "complex" the pace around which speeds vary
        (0.4 to 1.6 times this, and 0 in stops).
      seed: chooses the "complex" path; the others ignore it.
      fps: frames per second.

    Returns:
      The path, [T = num_frames].

    Raises:
      ValueError: for an unknown name (with the nearest ones), fewer than 2 frames, or a speed or fps
        out of range.

    Source: ours; the paper does not give its test trajectory.
    """
    check_known(name, NAMES, "path")
    if int(num_frames) != num_frames or num_frames < 2:
        raise ValueError(f"a path needs at least 2 whole frames, got num_frames={num_frames}")
    checked_value("fps", fps, "float")
    if not (np.isfinite(speed) and 0 < speed < MAX_STEP * 30.0):
        raise ValueError(f"speed must lie between 0 and {MAX_STEP * 30.0:g} m/s, got {speed}")
    num_frames, seed = int(num_frames), checked_seed(seed)

    fine_time = np.arange((num_frames - 1) * _SUBSTEPS + 1) / (_SUBSTEPS * fps)
    if name == "complex":
        profile = _complex_profile(fine_time[-1], speed, seed)
        fine_speed, turn_rate, facing_offset = (np.interp(fine_time, *signal) for signal in profile)
        distance, heading = _integrals(np.stack([fine_speed, turn_rate]), fine_time)
    else:
        distance = _integrals(np.full_like(fine_time, speed), fine_time)
        heading, facing_offset = _HEADINGS[name](distance), 0.0

    # Midpoint rule: each small step goes along the mean of the headings at its two ends.
    middle = 0.5 * (heading[1:] + heading[:-1])
    step = np.diff(distance)[:, None] * np.stack([np.sin(middle), np.cos(middle)], axis=-1)
    position = np.concatenate([np.zeros((1, 2)), np.cumsum(step, axis=0)])
    yaw = heading + facing_offset
    return RootPath(position[::_SUBSTEPS], yaw[::_SUBSTEPS], float(fps))


def _integrals(rate: np.ndarray, time: np.ndarray) -> np.ndarray:
    """Integrate by the trapezoid rule, from 0 on; `scipy.integrate` takes half a second to load."""
    steps = np.diff(time) * (rate[..., 1:] + rate[..., :-1]) / 2.0
    return np.concatenate([np.zeros_like(rate[..., :1]), np.cumsum(steps, axis=-1)], axis=-1)


def _heading_figure_eight(distance: np.ndarray) -> np.ndarray:
    # A heading of amplitude A that swings like a sine closes on itself where the Bessel function
    # J0(A) = 0; the first zero is the figure eight. Shifted by a quarter lap it starts in the
    # crossing, with no curvature there.
    amplitude = jn_zeros(0, 1)[0]
    lap = 2.0 * np.pi * amplitude * 1.5
    return amplitude * (1.0 - np.cos(2.0 * np.pi * distance / lap))


def _heading_square(distance: np.ndarray) -> np.ndarray:
    straight, corner = 3.0, 3.0  # a corner of 3 m of arc turns with a tightest radius of 1.3 m
    along = (distance + straight / 2.0) / (straight + corner)
    side = np.floor(along)
    within = (along - side) * (straight + corner) - straight
    return 0.5 * np.pi * (side + smoothstep(within / corner))


def _heading_spiral(distance: np.ndarray) -> np.ndarray:
    # Radius r grows with r dr = (c / 2) ds, so each turn adds pi c metres to it.
    start, growth = 1.0, 1.0 / np.pi
    return (2.0 / growth) * (np.sqrt(start**2 + growth * distance) - start)


_HEADINGS = {
    "straight": np.zeros_like,
    "circle": lambda distance: distance / 2.5,
    "figure-eight": _heading_figure_eight,
    "slalom": lambda distance: np.deg2rad(50.0) * np.sin(2.0 * np.pi * distance / 8.0),
    "square": _heading_square,
    "spiral": _heading_spiral,
}


def _complex_profile(seconds: float, speed: float, seed: int):
    """Draw speed, turn rate and facing offset as smooth functions of time.

    Segments of a few seconds each hold constant targets; Gaussians round them off. Segments are
    drawn one after the other, so that a longer path begins with the shorter one.

    Returns:
      Three (time, value) pairs for `numpy.interp`: m/s, rad/s, rad.
    """
    rng = np.random.default_rng(seed)
    rate = 30.0
    needed = int(np.ceil((seconds + 4.0) * rate)) + 1  # beyond the reach of the widest Gaussian
    kinds = ("walk", "turn", "stop", "sideways", "backwards")
    weights = (0.42, 0.30, 0.08, 0.12, 0.08)
    segments = [(2.5, 1.0, 0.0, 0.0)]  # long enough to start exactly along +Z
    while sum(int(segment[0] * rate) for segment in segments) < needed:
        kind = kinds[rng.choice(len(kinds), p=weights)]
        duration, side = rng.uniform(2.0, 4.5), rng.choice([-1.0, 1.0])
        pace, turning, offset = rng.uniform(0.0, 1.0), rng.uniform(0.0, 1.0), 0.0
        if kind == "walk":
            pace, turning = 0.6 + 1.0 * pace, 0.25 * turning
        elif kind == "turn":
            # 30 to 140 degrees in all, so that a turn is a turn and not a tight loop.
            duration *= 0.7
            pace, turning = 0.5 + 0.6 * pace, np.deg2rad(30.0 + 110.0 * turning) / duration
        elif kind == "stop":
            duration, pace, turning = rng.uniform(1.2, 2.0), 0.0, 0.0
        else:
            offset = np.pi if kind == "backwards" else 0.5 * np.pi
            pace, turning = 0.4 + 0.3 * pace, 0.15 * turning
        facing_side = rng.choice([-1.0, 1.0])
        segments.append((duration, pace, side * turning, facing_side * offset))
    frames = [int(segment[0] * rate) for segment in segments]
    time = np.arange(sum(frames)) / rate

    def smooth(column: int, sigma_seconds: float) -> np.ndarray:
        values = np.repeat([segment[column] for segment in segments], frames)
        return gaussian_filter1d(values, sigma_seconds * rate, mode="nearest", truncate=4.0)

    return ((time, speed * smooth(1, 0.4)), (time, smooth(2, 0.4)), (time, smooth(3, 0.5)))


def read_points_csv(path, *headers: str) -> list[tuple[str, dict[str, float]]]:
    """Read a table of points, all of whose cells are numbers, with a decimal point or a decimal comma.

    Args, returns:
      as `read_text_table`, with numbers for cells.

    Raises:
      ValueError: as `read_text_table`; naming file and line, for a cell that is not a finite number of at most 10,000,
        or more than an hour's rows.
    """
    rows = read_text_table(path, *headers)
    if len(rows) > MAX_ROWS:
        raise ValueError(f"{rows[MAX_ROWS][0]} more than {MAX_ROWS} rows, an hour at 30 fps; cut the file up")
    for where, row in rows:
        for name, cell in row.items():
            row[name] = finite_number(cell.replace(",", "."), MAX_DISTANCE)
            if row[name] is None:
                what = f"not a finite number of at most {MAX_DISTANCE:g} either way"
                raise ValueError(f"{where} {name} is {cell[:40]!r}, {what}")
    return rows


def read_path_csv(path) -> RootPath:
    """Read a path from a CSV file with one row a frame at 30 fps.

    The header names the columns `x` and `z` (metres) and, if wanted, `yaw_deg` (degrees, 0 faces
    +Z, positive turns left). Without `yaw_deg` the path faces where it goes; while it stands still
    it keeps the last direction.

    Args:
      path: the file.

    Returns:
      The path, one frame a row, neither moved nor resampled.

    Raises:
      ValueError: naming file and line, as `read_points_csv`, or for a step over 0.5 m or fewer than 2 rows.
    """
    rows = read_points_csv(path, "x,z", "x,z,yaw_deg")
    if len(rows) < 2:
        raise ValueError(f"{path}: a path needs at least 2 rows below its header, has {len(rows)}")
    position = np.array([[row["x"], row["z"]] for _, row in rows])
    for (where, _), jump in zip(rows[1:], np.hypot(*np.diff(position, axis=0).T), strict=True):
        if jump > MAX_STEP:
            limit = f"at most {MAX_STEP} m at 30 fps"
            raise ValueError(f"{where} jumps {jump:.2f} m in a frame ({limit}); units are metres, a row is a frame")
    given = [row["yaw_deg"] for _, row in rows if "yaw_deg" in row]
    return RootPath(position, np.deg2rad(given) if given else tangent_yaw(position))


def tangent_yaw(position: np.ndarray) -> np.ndarray:
    """Return the yaw of the direction of travel; frames that stand keep the last direction.

    Args:
      position: [T, 2], x and z in metres.

    Returns:
      [T], radians.
    """
    velocity = np.gradient(position, axis=0)
    moving = np.linalg.norm(velocity, axis=-1) > 1e-4  # 3 mm/s at 30 fps
    last = np.maximum.accumulate(np.where(moving, np.arange(len(moving)), moving.argmax()))
    return np.arctan2(*velocity.T)[last] if moving.any() else np.zeros(len(moving))


def path_from_motion(motion: Motion) -> RootPath:
    """Take a motion's own root path: ground position and facing of the hips.

    Args:
      motion: any motion.

    Returns:
      The path, [T], at the motion's frame rate, where the motion has it (not moved to the origin).
    """
    root = np.asarray(motion.root_position, dtype=np.float64)
    return RootPath(root[:, [0, 2]], np.asarray(motion.yaw, dtype=np.float64), float(motion.fps))
