"""A procedural styled walker: the data set that needs no download.

One hundred named styles are sets of parameters; a clip is a style, a length and a seed. A clip is
made in the order in which an animator would plan it:

1. a root path with turns, curves, stops, speed changes, sideways and backward stretches;
2. footfalls along that path, each placed where the body will be in the middle of the stance;
3. feet: a planted toe never moves, the heel rolls up around it, then the foot swings in an arc;
4. pelvis: sway, bounce and twist, lowered wherever a leg would otherwise be too short;
5. legs by two-bone inverse kinematics, knees bent forward;
6. spine, head and arms.

Only steps 1 and 2 depend on the order of events; everything else is one expression over all
frames. Units are metres, seconds and (where a name ends in `_deg`) degrees; +Y is up, yaw 0 faces
+Z and the character's left is +X.
"""

import hashlib
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import NamedTuple

import numpy as np
from scipy.interpolate import CubicSpline, PchipInterpolator
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from f3amd_lib.ground.files import read_toml
from f3amd_lib.ground.names import check_known, checked_value
from f3amd_lib.motion.curves import smooth_above, smoothstep, unit
from f3amd_lib.motion.root_paths import RootPath
from f3amd_lib.motion.rotations import matrix_from_euler, wrap_angle
from f3amd_lib.motion.skeleton import Motion, Skeleton

# ------------------------------------------------------------------------------------ skeleton


SYNTHETIC_SKELETON = Skeleton(**read_toml(Path(__file__).with_name("walker_skeleton.toml")))
"""23 joints with 100STYLE's names and axis-aligned T-pose (zero rotations), own proportions."""

_SPINE = ("Chest", "Chest2", "Chest3", "Chest4")
_HIP_OFFSET, _KNEE_OFFSET, _ANKLE_OFFSET, _TOE_OFFSET = (
    SYNTHETIC_SKELETON.offsets[SYNTHETIC_SKELETON.index(f"Left{joint}")] for joint in ("Hip", "Knee", "Ankle", "Toe")
)
_THIGH, _SHANK = -_KNEE_OFFSET[1], -_ANKLE_OFFSET[1]
_TOE_HEIGHT = 0.012
_FOOT_LENGTH = float(np.hypot(_TOE_OFFSET[1], _TOE_OFFSET[2])) + 0.05
"""From the back of the heel to the toe joint, metres: how far a toe rises on the heel."""


# ---------------------------------------------------------------------------------- parameters


_STYLE_TABLE = read_toml(Path(__file__).with_name("styles.toml"))
_NEUTRAL, _NEUTRAL_ARM = _STYLE_TABLE["Neutral"], _STYLE_TABLE["Neutral"].pop("arms")

# What a parameter means stands beside its number, in [Neutral] of styles.toml.


def _complete(values: dict) -> SimpleNamespace:
    """Return a style from what differs from Neutral."""
    both = values.get("arms", {})
    arms = {side: SimpleNamespace(**_NEUTRAL_ARM | values.get(side, both)) for side in ("left_arm", "right_arm")}
    # A slower walk takes shorter steps unless it says otherwise.
    step_length = float(0.62 * np.sqrt(min(values.get("speed", _NEUTRAL["speed"]) / 1.20, 1.3)))
    return SimpleNamespace(**_NEUTRAL | {"step_length": step_length} | values | arms)


_STYLES = {name: _complete(values) for name, values in _STYLE_TABLE.items()}
STYLES: tuple[str, ...] = tuple(sorted(_STYLES))
"""The hundred style names, sorted."""


def style_parameters(name: str) -> SimpleNamespace:
    """Return everything that tells a style, one of `STYLES`, from others; ValueError lists the nearest ones."""
    check_known(name, STYLES, "synthetic style")
    return _STYLES[name]


def is_symmetric(name: str) -> bool:
    """Return whether a mirrored clip of a style is again a clip of the same style."""
    style = style_parameters(name)
    one_sided = ("limp", "heading_deg", "spine_roll_deg", "spine_twist_deg", "head_roll_deg", "head_yaw_deg")
    alike = style.left_arm == style.right_arm and style.left_lift_scale == style.right_lift_scale
    return alike and style.rhythm == 0.5 and not any(getattr(style, name) for name in one_sided)


# ---------------------------------------------------------------------------------- small tools

_GRID_RATE = 60.0
"""Samples per second on which paths are planned, whatever the frame rate of the clip."""
_LEAD = 3.0
"""Seconds planned before the first and after the last frame, so that clips are cut from motion."""
_STANDING_SPEED = 0.12
"""Below this speed, m/s, the character stands instead of stepping."""


def _generator(style: str, seed: int) -> np.random.Generator:
    """Seed a generator from text, so that it draws the same on every machine."""
    digest = hashlib.sha256(f"f3amd synthetic walker|{style}|{int(seed)}".encode()).digest()
    return np.random.default_rng(np.frombuffer(digest, dtype="<u4").tolist())


def _smooth(signal: np.ndarray, sigma: float, rate: float) -> np.ndarray:
    """Blur along the first axis; sigma in seconds."""
    return gaussian_filter1d(signal, sigma * rate, axis=0, mode="nearest")


def _wander(rng: np.random.Generator, count: int, sigma: float, channels: int) -> np.ndarray:
    """Draw slow random signals of unit variance on the planning grid, [count, channels]."""
    width = sigma * _GRID_RATE
    noise = rng.standard_normal((count, channels))
    # A Gaussian blur of white noise has variance 1 / (2 sqrt(pi) width).
    return gaussian_filter1d(noise, width, axis=0, mode="reflect") * np.sqrt(2.0 * np.sqrt(np.pi) * width)


def _turned(axes: str, *degrees) -> np.ndarray:
    """Return rotations about axes, one after the other, [..., 3, 3]: yaw and pitch are a turn left and a bow."""
    return matrix_from_euler(axes, np.stack(np.broadcast_arrays(*degrees), axis=-1))


def _ahead(yaw) -> np.ndarray:
    """Return the direction (x, z) that a yaw faces, [..., 2]; its left is a quarter turn further."""
    return np.stack([np.sin(yaw), np.cos(yaw)], axis=-1)


# ------------------------------------------------------------------------------- 1. root path


class _Path(NamedTuple):
    """A root path on the planning grid: times [N], position [N, 2] (x, z), yaw, speed, turn."""

    time: np.ndarray
    position: np.ndarray
    yaw: np.ndarray
    speed: np.ndarray
    turn: np.ndarray
    heading: np.ndarray

    def at(self, time: float) -> int:
        """Return the grid index of a time, clipped to the plan."""
        index = int(round((time - self.time[0]) * _GRID_RATE))
        return min(max(index, 0), len(self.time) - 1)


_STRETCHES = read_toml(Path(__file__).with_name("stretches.toml"))
"""What a path is strung together from; the file says what its numbers mean."""


def _planned_times(seconds: float) -> np.ndarray:
    """Return the planning grid of a clip, from `_LEAD` before it to `_LEAD` after it, seconds."""
    return np.arange(int(np.ceil((seconds + 2 * _LEAD) * _GRID_RATE)) + 1) / _GRID_RATE - _LEAD


def _plan_path(style, seconds: float, rng: np.random.Generator) -> _Path:
    """String random stretches together and smooth speed, turning and heading."""
    time = _planned_times(seconds)
    count = len(time)
    kinds, weights = zip(*((name, of["weight"]) for name, of in _STRETCHES.items() if "weight" in of), strict=True)
    speed, turn, heading = np.zeros(count), np.zeros(count), np.zeros(count)
    start, forced, stood = 0, "straight", False
    # Runs bend their paths less per second of turning than walks.
    pace = min(1.0, 1.3 / style.speed) * style.turn_scale
    while start < count:
        kind = forced or str(rng.choice(kinds, p=weights))
        # Stops are dealt by count: a stop lasts about two thirds of an average stretch.
        if not stood and not forced and rng.random() < 1.5 * style.stop_share:
            kind = "stop"
        stretch = _STRETCHES[kind]

        def drawn(name: str, usual: float, stretch=stretch) -> float:
            value = stretch.get(name, usual)
            return rng.uniform(*value) if isinstance(value, list) else value

        length = rng.uniform(1.8, 4.2)
        factor, rate = rng.uniform(0.85, 1.12), rng.normal(0.0, 0.08)
        sign = rng.choice([-1.0, 1.0])
        if "turn" in stretch:
            rate = sign * drawn("turn", 0.0) * pace
        length, factor = drawn("seconds", length), drawn("speed", factor) * stretch.get("slowed", 1.0)
        offset = sign * drawn("heading", 0.0)
        if kind == "stop":
            rate = sign * rng.uniform(0.5, 0.9) if rng.random() < 0.25 else 0.0  # or turns on the spot
        stop = min(count, start + int(length * _GRID_RATE))
        span = slice(start, stop)
        speed[span], turn[span], heading[span] = style.speed * factor, rate, offset
        if kind == "slalom":
            beat = 2.0 * np.pi * (time[span] - time[start]) / 2.25
            turn[span] = sign * 0.9 * pace * np.sin(beat)
        # After a sideways or backward stretch walk straight on: headings never jump by 270 degrees.
        forced = "straight" if kind in ("side", "back") else ""
        stood = kind == "stop"
        start = stop
    heading = _smooth(heading, 0.30, _GRID_RATE)
    change = np.radians(np.abs(np.gradient(heading, 1.0 / _GRID_RATE)))
    brisk = 0.30 if style.speed < 1.6 else 0.45
    speed = _smooth(speed, brisk, _GRID_RATE) * np.exp(-np.square(change / 2.0))
    speed *= 1.0 + 0.03 * _wander(rng, count, 1.0, 1)[:, 0]
    speed = np.maximum(_smooth(speed, 0.15, _GRID_RATE), 0.0)
    turn = _smooth(turn, 0.28, _GRID_RATE)
    wobble = style.unsteadiness * _wander(rng, count, 0.6, 1)[:, 0]
    turn = turn + 0.25 * wobble * np.clip(speed, 0.0, 1.0)
    yaw = rng.uniform(-np.pi, np.pi) + np.cumsum(turn) / _GRID_RATE
    going = yaw + np.radians(heading + style.heading_deg)
    position = np.cumsum(speed[:, None] * _ahead(going), axis=0) / _GRID_RATE
    position -= position[int(_LEAD * _GRID_RATE)]
    return _Path(time, position, yaw, speed, turn, heading)


def _given_path(path: RootPath) -> _Path:
    """Resample a given path on the planning grid; it goes straight on at both ends."""
    frames, fps = path.num_frames, path.fps
    time = _planned_times(frames / fps)
    drawn = np.arange(frames) / fps
    columns = np.concatenate([path.position, path.yaw[:, None]], axis=1)
    inside = CubicSpline(drawn, columns)(np.clip(time, 0.0, drawn[-1]))
    # Before the first and after the last frame: as fast as there, and no further turn.
    early = np.minimum(time, 0.0)[:, None] * (columns[1] - columns[0]) * fps
    late = np.maximum(time - drawn[-1], 0.0)[:, None] * (columns[-1] - columns[-2]) * fps
    inside[:, :2] += (early + late)[:, :2]
    velocity = _smooth(np.gradient(inside, 1.0 / _GRID_RATE, axis=0), 0.08, _GRID_RATE)
    speed = np.linalg.norm(velocity[:, :2], axis=-1)
    heading = wrap_angle(np.arctan2(velocity[:, 0], velocity[:, 1]) - inside[:, 2])
    heading = np.degrees(_smooth(np.unwrap(np.where(speed > 0.05, heading, 0.0)), 0.15, _GRID_RATE))
    return _Path(time, inside[:, :2], inside[:, 2], speed, velocity[:, 2], heading)


# ------------------------------------------------------------------------------- 2. footfalls


def _home(style, path: _Path, time: float, side: float, width: float):
    """Return where a toe wants to stand (x, z) and its yaw, for the body's place at a time."""
    index = path.at(time)
    yaw = path.yaw[index]
    left, foot_yaw = _ahead(yaw + np.pi / 2), yaw + side * np.radians(style.toe_out_deg)
    # Bowing forwards moves the pelvis back over the feet.
    balance = 0.10 * np.sin(np.radians(style.pelvis_pitch_deg + 0.6 * style.spine_pitch_deg))
    place = path.position[index] + side * 0.5 * width * left + balance * _ahead(yaw) + _TOE_OFFSET[2] * _ahead(foot_yaw)
    return place, foot_yaw, left


def _plan_footfalls(style, path: _Path, rng: np.random.Generator):
    """Walk along the path, one footfall after the other.

    Returns:
      For each toe (left, right) where it stands, in order: landing and lifting times [K], (x, z) [K, 2], yaw [K];
      and the gait phase as knots: times [K] and strides [K], whole numbers at left footfalls and (in a walk) halves
      at right ones.
    """
    sides = (1.0, -1.0)
    step_time = style.step_length / style.speed
    rhythm = style.rhythm - 0.07 * style.limp
    # An uneven walk keeps its phase; a jump or gallop is a stride of its own.
    share = 0.5 if abs(style.rhythm - 0.5) < 0.15 else style.rhythm
    stretch = max(0.36, 1.12 * style.duty * style.step_length)
    begin, end = path.time[0], path.time[-1]
    homes = [_home(style, path, begin, side, style.step_width) for side in sides]
    stands = [[SimpleNamespace(land=begin - 1.0, lift=end + 10.0, place=place, yaw=yaw)] for place, yaw, _ in homes]
    knots, strides = [begin], [share]
    now, foot, standing = begin, int(rng.integers(2)), True
    while now < end:
        ahead = slice(path.at(now + 0.05), path.at(now + 0.40) + 1)
        rate = path.speed[ahead].max() + 0.25 * np.abs(path.turn[ahead]).max()
        middle = path.at(now + 0.7 * step_time)
        width = style.step_width
        if rate > _STANDING_SPEED:
            # Step length and step rate share a change of speed evenly, as people do.
            sideways = abs(np.sin(np.radians(path.heading[middle])))
            usual = style.speed * (1.0 - 0.5 * sideways)
            soon = slice(path.at(now), path.at(now + 1.1 * step_time) + 1)
            pace = 0.5 * (path.speed[soon].max() + path.speed[middle])
            pace = max(pace + 0.2 * abs(path.turn[middle]), 0.05)
            beat = step_time * np.clip(np.sqrt(usual / pace), 0.75, 1.45)
            beat = np.clip(beat * (1.0 + 0.015 * rng.standard_normal()), 0.22, 1.2)
            stride = 2.0 * beat
            swing = stride * (1.0 - style.duty)
            if standing:
                begun, landed = now, now + min(swing, max(0.3, beat))
            else:
                landed = now + stride * (rhythm if foot == 1 else 1.0 - rhythm)
                begun = landed - swing
            # A foot that the body outruns leaves early, but not before the other one stands.
            last = stands[foot][-1]
            earliest = max(now if standing else min(begun, now + 0.02), last.land + 0.10)
            while begun > earliest:
                rest, _, _ = _home(style, path, begun, sides[foot], width)
                if np.linalg.norm(rest - last.place) < stretch:
                    break
                begun, landed = begun - 0.02, landed - 0.02
            begun = max(begun, last.land + 0.10)
            landed = max(landed, begun + 0.20)
            width += 0.5 * sideways * path.speed[middle] * beat
            target = landed + style.duty * beat
        else:
            # Standing: bring a foot that was left behind back under the body.
            errors = []
            for side, (*_, last) in zip(sides, stands, strict=True):
                position, angle, _ = _home(style, path, now + 0.5, side, width)
                errors.append(np.linalg.norm(position - last.place) + 0.12 * abs(angle - last.yaw))
            foot = int(np.argmax(errors))
            if errors[foot] < 0.06:
                now, standing = now + 0.05, True
                continue
            begun = max(now + 0.03, stands[foot][-1].land + 0.12)
            landed = begun + 0.42
            target = landed + 0.3
        scatter = 0.004 + 0.025 * style.unsteadiness
        position, angle, left = _home(style, path, target, sides[foot], width)
        # Do not reach further ahead than the leg allows at the moment of landing.
        rest, _, _ = _home(style, path, landed, sides[foot], width)
        excess = np.linalg.norm(position - rest) / stretch
        if excess > 1.0:
            position = rest + (position - rest) / excess
        position = position + scatter * np.clip(rng.standard_normal(2), -2.0, 2.0)
        angle = angle + 0.5 * scatter * rng.standard_normal()
        # Feet keep clear of each other, unless the style walks on a line.
        apart = sides[foot] * float((position - stands[1 - foot][-1].place) @ left)
        clear = min(0.085, style.step_width)
        if apart < clear:
            position = position + sides[foot] * (clear - apart) * left
        stands[foot][-1].lift = begun
        stands[foot].append(SimpleNamespace(land=landed, lift=end + 10.0, place=position, yaw=angle))
        step = strides[-1] + 1e-3
        strides.append(np.ceil(step) if foot == 0 else np.ceil(step - share) + share)
        knots.append(landed)
        now, foot, standing = landed, 1 - foot, False
    column = lambda foot, name: np.array([getattr(stand, name) for stand in foot])
    plants = [tuple(column(foot, name) for name in ("land", "lift", "place", "yaw")) for foot in stands]
    return plants, np.array(knots), np.array(strides)


# ------------------------------------------------------------------------------------ 3. feet


def _move_foot(style, plants, time: np.ndarray, side: float, fps: float):
    """Turn where a toe stands, from `_plan_footfalls`, into a path of the foot.

    Returns:
      ankle [T, 3], foot yaw [T] (radians), global rotation of the foot and local one of its toe, [T, 3, 3] each,
      planted [T] of bool.
    """
    land, lift, place, plant_yaw = plants
    index = np.clip(np.searchsorted(land, time, side="right") - 1, 0, None)
    after = np.minimum(index + 1, len(land) - 1)
    planted = time <= lift[index]
    duration = np.maximum(land[after] - lift[index], 1e-6)
    progress = np.where(planted, 0.0, np.clip((time - lift[index]) / duration, 0.0, 1.0))
    travel = place[after] - place[index]
    # Between minimum jerk and a cubic: soft ends, and a foot that does not lag behind.
    quintic = progress**3 * (10.0 - 15.0 * progress + 6.0 * progress**2)
    share = 0.3 * quintic + 0.7 * smoothstep(progress)
    flat = place[index] + share[:, None] * travel
    yaw = plant_yaw[index] + share * (plant_yaw[after] - plant_yaw[index])
    # Short steps (settling, turning on the spot) lift and roll less.
    reach = np.linalg.norm(np.diff(place, axis=0), axis=-1)
    reach = np.append(reach, 0.0) / (2.0 * style.step_length)
    effort = np.clip(0.30 + 0.70 * reach, 0.30, 1.15)
    forward = np.append(np.sum(np.diff(place, axis=0) * _ahead(plant_yaw)[:-1], -1), 0.0)
    forward = np.clip(forward / (2.0 * style.step_length), -1.0, 1.15)
    scale = style.left_lift_scale if side > 0 else style.right_lift_scale
    arc = progress**2 * (1.0 - progress) ** 2.5 * 26.0
    height = style.foot_lift * scale * effort[index] * arc
    outwards = _ahead(yaw + side * np.pi / 2)
    flat = flat + (style.circumduction * 16.0 * (progress * (1.0 - progress)) ** 2)[:, None] * outwards

    keys, values = [], []
    raised = style.heel_raise_deg
    for k in range(len(land)):
        stance = lift[k] - land[k]
        roll = np.clip(forward[k], 0.12, 1.0) if forward[k] > 0 else 0.15
        peak = max(style.heel_off_deg * roll * (0.4 + 0.6 * min(scale, 1.0)), raised)
        keys += [land[k], lift[k] - min(0.48 * stance, 0.36), lift[k]]
        values += [raised, raised, raised + 0.78 * (peak - raised)]
        if k + 1 < len(land):
            swing = land[k + 1] - lift[k]
            keys += [lift[k] + 0.14 * swing, lift[k] + 0.80 * swing]
            values += [peak, raised - style.toe_up_deg * max(forward[k], 0.0)]
    pitch = PchipInterpolator(np.array(keys), np.array(values))(time)
    pitch = _smooth(pitch, 0.025, fps)
    # A foot that lands on its heel has its toe in the air by the foot's length.
    height = height + _FOOT_LENGTH * np.sin(np.radians(np.maximum(-pitch, 0.0))) * ~planted
    toe = np.stack([flat[:, 0], _TOE_HEIGHT + height, flat[:, 1]], axis=-1)
    # On the ground toes stay flat while the heel rises; in the air they follow the foot.
    flex = np.where(planted, 1.0, 1.0 - 0.85 * smoothstep(progress / 0.3) * smoothstep((1 - progress) / 0.2))
    frame = _turned("YX", np.degrees(yaw), pitch)
    return toe - frame @ _TOE_OFFSET, yaw, frame, _turned("X", -np.maximum(pitch, 0.0) * flex), planted


# ---------------------------------------------------------------------------- 4 and 5. the legs


def _lower_pelvis(height, root_flat, pelvis, ankles, reach, fps):
    """Lower the pelvis where a leg is too short, smoothly and never by less than needed."""
    room = np.full(len(height), np.inf)
    for side, ankle in zip((1.0, -1.0), ankles, strict=True):
        hip = pelvis @ (_HIP_OFFSET * [side, 1.0, 1.0])
        across = np.square(ankle[:, [0, 2]] - root_flat - hip[:, [0, 2]]).sum(-1)
        rise = np.sqrt(np.maximum(reach**2 - across, 0.30**2))
        room = np.minimum(room, ankle[:, 1] + rise - hip[:, 1])
    lack = np.maximum(height - room, 0.0)
    return height - smooth_above(lack, fps)


def _bend_leg(hip: np.ndarray, ankle: np.ndarray, pole: np.ndarray):
    """Solve one leg: global thigh and shank rotations, [T, 3, 3] each, knee towards the pole."""
    line = ankle - hip
    distance = np.linalg.norm(line, axis=-1)
    distance = np.clip(distance, abs(_THIGH - _SHANK) + 0.05, 0.9995 * (_THIGH + _SHANK))
    down = unit(line)
    hinge = unit(np.cross(-down, pole))
    front = np.cross(hinge, -down)
    cosine = (distance**2 + _THIGH**2 - _SHANK**2) / (2.0 * distance * _THIGH)
    angle = np.arccos(np.clip(cosine, -1.0, 1.0))[:, None]
    knee = hip + _THIGH * (np.cos(angle) * down + np.sin(angle) * front)
    frames = []
    for upper, lower in ((hip, knee), (knee, hip + distance[:, None] * down)):
        axis_y = unit(upper - lower)
        frames.append(np.stack([hinge, axis_y, np.cross(hinge, axis_y)], axis=-1))
    return frames


# --------------------------------------------------------------------------------- 6. the arms


def _arm(pose, side, swing, gesture, lean_deg, roll_deg, drift):
    """Return local shoulder, elbow and wrist rotations of one arm, [T, 3, 3] each."""
    forward = pose.forward_deg + pose.swing_deg * swing + pose.hang * lean_deg
    forward = forward + pose.wave_forward_deg * np.cos(gesture) + 1.5 * drift[:, 0]
    out = pose.side_deg + pose.wave_side_deg * np.sin(gesture) + 1.0 * drift[:, 1]
    # An arm under a sideways lean hangs free on one side and rests against the ribs on the other.
    ribs = min(pose.side_deg - 3.0, 5.0)
    out = ribs + 3.0 * np.logaddexp(0.0, (out + side * pose.hang * roll_deg - ribs) / 3.0)
    twist = pose.twist_deg + pose.wave_twist_deg * np.sin(gesture)
    elbow = pose.elbow_deg + pose.elbow_swing_deg * np.maximum(swing + 0.3, 0.0) ** 2
    elbow = np.maximum(elbow + pose.wave_elbow_deg * np.sin(gesture) + 1.5 * drift[:, 2], 2.0)
    shoulder = _turned("XZX", -forward, side * (out - 90.0), twist)
    wrist = _turned("ZY", -side * (4.0 + 2.0 * drift[:, 1]), -side * (6.0 + 3.0 * swing))
    return shoulder, _turned("Y", -side * elbow), wrist


# ------------------------------------------------------------------------------------ assembly


def walk_along(style: str, path: RootPath) -> Motion:
    """Let the walker follow a path that somebody drew: what a generated walk is held against.

    Args:
      style: one of `STYLES`.
      path: T >= 4 frames, the motion's frame rate; the direction of travel is the path's own.

    Raises:
      ValueError: for an unknown style, or a path that is too short.
    """
    if path.num_frames < 4:
        raise ValueError(f"a path needs 4 frames or more, got {path.num_frames}")
    return _walk(style, 0, path.fps, path.num_frames, path)[0]


def synthesize(style: str, seconds: float = 60.0, seed: int = 0, fps: float = 30.0) -> Motion:
    """Make a clip of styled locomotion.

    Args:
      style: one of `STYLES`.
      seconds: length of the clip, seconds.
      seed: any integer; equal arguments give equal clips on every machine.
      fps: frames per second.

    Returns:
      The motion: T = round(seconds * fps) frames of 23 joints, metres, floor at y = 0.

    Raises:
      ValueError: for an unknown style, or a length or rate that gives no frame.
    """
    checked_value("fps", fps, "float")
    if not np.isfinite(seconds) or round(seconds * fps) < 1:
        raise ValueError(f"seconds must give at least one frame at {fps} fps, got {seconds}")
    return _walk(style, seed, fps, int(round(seconds * fps)))[0]


def _walk(style: str, seed: int, fps: float, frames: int, drawn: RootPath | None = None) -> tuple[Motion, np.ndarray]:
    """Walk along a random path, or along a drawn one.

    Returns:
      Motion, and the planned toe contacts [T, 2] of bool, left then right: the toe stands still from this frame to the
      next.
    """
    parameters, rng = style_parameters(style), _generator(style, seed)
    path = _given_path(drawn) if drawn else _plan_path(parameters, frames / fps, rng)
    plants, knots, strides = _plan_footfalls(parameters, path, rng)
    drift = _wander(rng, len(path.time), 0.7, 12)
    gesture_start = rng.uniform(0.0, 2.0 * np.pi)

    # Everything below is evaluated on the clip's own frames, plus a margin for the filters.
    margin = int(np.ceil(1.0 * fps))
    time = np.arange(-margin, frames + margin) / fps
    columns = np.column_stack([path.position, path.yaw, path.speed, path.turn, path.heading, drift])
    sampled = CubicSpline(path.time, columns)(time)
    root_flat, (yaw, speed, turn, heading) = sampled[:, :2], sampled[:, 2:6].T
    drift = sampled[:, 6:] * (0.4 + 2.0 * parameters.unsteadiness)
    phase = _smooth(PchipInterpolator(knots, strides, extrapolate=True)(np.clip(time, knots[0], knots[-1])), 0.05, fps)
    cycle = 2.0 * np.pi * phase
    stepping = np.gradient(phase, time) * 2.0 * parameters.step_length / parameters.speed
    effort = _smooth(np.clip(1.3 * stepping, 0.0, 1.0) * np.clip(speed / parameters.speed, 0.25, 1.1), 0.16, fps)

    feet = [_move_foot(parameters, of_toe, time, side, fps) for of_toe, side in zip(plants, (1.0, -1.0), strict=True)]
    ankles, _, _, _, planted = zip(*feet, strict=True)

    # Pelvis: sway, twist, roll and bounce ride on the gait phase (left footfall at whole strides).
    accelerate = np.gradient(speed, time)
    bank = np.degrees(np.arctan(speed * turn / 9.81))
    spared = np.square(0.5 + 0.5 * np.sin(cycle) * np.sign(parameters.limp or 1.0)) * abs(parameters.limp) * effort
    pelvis_yaw = np.degrees(yaw) - effort * parameters.hip_twist_deg * np.cos(cycle)
    pelvis_roll = effort * parameters.hip_roll_deg * np.sin(cycle) * -1.0 + 0.5 * bank + 0.6 * drift[:, 0] * 0.5
    pelvis_pitch = parameters.pelvis_pitch_deg + 1.5 * np.clip(accelerate, -2, 2) + 0.3 * drift[:, 1]
    pelvis = _turned("YXZ", pelvis_yaw, pelvis_pitch, -pelvis_roll)
    # Weight is carried from foot to foot across the path, so hardly at all in a side step.
    across = np.abs(np.cos(np.radians(heading + parameters.heading_deg)))
    sway = effort * across * parameters.sway * np.sin(cycle) + 0.006 * drift[:, 2]
    surge = 0.012 * effort * np.sin(2.0 * cycle) + 0.005 * drift[:, 3]
    root_flat = root_flat + sway[:, None] * _ahead(yaw + np.pi / 2) + surge[:, None] * _ahead(yaw)

    leg = _THIGH + _SHANK
    stand = _TOE_HEIGHT - _TOE_OFFSET[1] + 0.988 * leg - _HIP_OFFSET[1]
    raised = np.radians(parameters.heel_raise_deg)
    tiptoe = _TOE_OFFSET[2] * np.sin(raised) - _TOE_OFFSET[1] * (np.cos(raised) - 1.0)
    height = stand + tiptoe - parameters.crouch - effort * parameters.bounce * np.cos(2.0 * cycle)
    flight = np.pi * (parameters.rhythm + parameters.duty + 1.0)
    height = height + effort * parameters.hop * np.cos(cycle - flight)
    height = height - 0.035 * spared + 0.002 * drift[:, 4]
    height = _lower_pelvis(height, root_flat, pelvis, ankles, 0.990 * leg, fps)
    root = np.stack([root_flat[:, 0], height, root_flat[:, 1]], axis=-1)

    local = np.tile(np.eye(3), (len(time), SYNTHETIC_SKELETON.num_joints, 1, 1))
    joint = SYNTHETIC_SKELETON.index
    local[:, 0] = pelvis
    for name, side, (ankle, foot_yaw, foot, toe, _) in zip(("Left", "Right"), (1.0, -1.0), feet, strict=True):
        hip = root + pelvis @ (_HIP_OFFSET * [side, 1.0, 1.0])
        bearing = 0.5 * (foot_yaw + np.radians(pelvis_yaw)) + side * np.radians(parameters.knee_out_deg)
        thigh, shank = _bend_leg(hip, ankle, np.insert(_ahead(bearing), 1, 0.0, axis=-1))
        for part, (above, below) in zip(("Hip", "Knee", "Ankle"), pairwise((pelvis, thigh, shank, foot)), strict=True):
            local[:, joint(f"{name}{part}")] = np.swapaxes(above, -1, -2) @ below
        local[:, joint(f"{name}Toe")] = toe

    # Spine: posture, shoulders against hips, and a trunk that stays upright over a rolling pelvis.
    twist = parameters.hip_twist_deg + parameters.chest_twist_deg
    spine_yaw = parameters.spine_twist_deg + effort * np.cos(cycle) * twist
    spine_pitch = parameters.spine_pitch_deg + 1.2 * np.clip(accelerate, -2, 2) + 0.8 * drift[:, 5]
    spine_pitch = spine_pitch + 6.0 * spared + 0.8 * effort * np.cos(2.0 * cycle)
    spine_roll = parameters.spine_roll_deg - 0.8 * pelvis_roll + 0.9 * bank + 0.8 * drift[:, 6]
    spine_roll = spine_roll + effort * parameters.chest_roll_deg * np.sin(cycle)
    spine_roll = spine_roll + 9.0 * spared * np.sign(parameters.limp)
    each = _turned("YXZ", spine_yaw / 4.0, spine_pitch / 4.0, -spine_roll / 4.0)
    chest = pelvis
    for name in _SPINE:
        local[:, joint(name)] = each
        chest = chest @ each

    # Head: looks where the path goes next, and stays steadier than the trunk that carries it.
    look = np.degrees(_smooth(np.interp(time + 0.25, path.time, path.yaw), 0.12, fps))
    look = look + 0.3 * parameters.spine_twist_deg + parameters.head_yaw_deg + 2.5 * drift[:, 7]
    nod = parameters.head_pitch_deg + 0.35 * (parameters.pelvis_pitch_deg + parameters.spine_pitch_deg)
    nod = nod + effort * parameters.head_bob_deg * np.cos(2.0 * cycle) + 1.2 * drift[:, 8]
    tilt = parameters.head_roll_deg + 0.4 * parameters.spine_roll_deg + 0.4 * bank
    head = np.swapaxes(chest, -1, -2) @ _turned("YXZ", look, nod, -tilt)
    half = (Rotation.from_matrix(head) ** 0.5).as_matrix()
    local[:, joint("Neck")] = local[:, joint("Head")] = half

    # Arms swing against the legs; the trunk's lean is given back to gravity.
    lean = pelvis_pitch + spine_pitch
    roll = pelvis_roll + spine_roll
    for name, side, pose in (("Left", 1.0, parameters.left_arm), ("Right", -1.0, parameters.right_arm)):
        swing = -side * effort * np.cos(cycle - 0.25)
        turns = 2.0 * np.pi * pose.wave_hz * time + gesture_start + 0.25 * drift[:, 9]
        if parameters.opposed_waves and side < 0:
            turns = turns + np.pi
        parts = _arm(pose, side, swing, turns, lean, roll, drift[:, 9:12])
        for part, rotation in zip(("Shoulder", "Elbow", "Wrist"), parts, strict=True):
            local[:, joint(f"{name}{part}")] = rotation
        lift = parameters.shrug_deg + 0.12 * max(pose.side_deg - 60.0, 0.0)
        local[:, joint(f"{name}Collar")] = _turned("Z", side * lift)

    keep = slice(margin, margin + frames)
    planted = np.stack(planted, axis=-1)
    contacts = (planted & np.roll(planted, -1, axis=0))[keep]
    return Motion(SYNTHETIC_SKELETON, root[keep], local[keep], float(fps), f"{style}_{int(seed)}"), contacts
