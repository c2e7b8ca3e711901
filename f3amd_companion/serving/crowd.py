"""Crowds of any size: characters in chunks, written to disk as they are made.

A crowd is a folder. Its arrays are plain `.npy` files, which NumPy opens without this library:

| file | what |
|---|---|
| `root.npy` | float32 [B, F, 3]: root x, y, z in metres, +Y up |
| `rotations.npy` | float16 [B, F, J, 6]: first two columns of each joint's local rotation matrix |
| `path.npy` | float32 [B, F, 3]: what was asked for: root x and z in metres, facing in radians |
| `styles.npy` | int32 [B]: place in the list `styles` of `crowd.json` |
| `crowd.json` | skeleton, styles, model and its terms, seed, frame rate, how many are finished |

Rotations bear half precision, root positions do not: float16 steps 0.25 m at 300 m.

A character is made from the seed and its own number alone: neither the chunk it comes in, nor the
size of the crowd, nor a run that stopped and went on makes a difference beyond rounding. Characters
do not see each other; they may walk through one another, unless their paths are planned to keep
apart (`min_distance`). Then everybody's path depends on who else is there.
"""

import functools
import hashlib
import json
import math
import os
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import jax
import numpy as np
from tqdm import tqdm

from f3amd_companion.serving.crowd_planning import FPS, MIN_DISTANCE, keep_apart
from f3amd_lib.data.features import motion_from_frames, split_frames
from f3amd_lib.ground.files import locked, write_whole
from f3amd_lib.ground.names import checked_seed
from f3amd_lib.ground.trees import errors_name, weights_digest
from f3amd_lib.motion.root_paths import NAMES, RootPath, named_path
from f3amd_lib.motion.skeleton import Motion, Skeleton, describe_skeleton, described_skeleton
from f3amd_lib.rollout.rollout import MotionGenerator
from f3amd_lib.rollout.start_poses import path_start, pose_speed, starting_poses

PATHS = tuple(name for name in NAMES if name != "complex")
"""Names that the paths of a crowd are drawn from: those that face where they go."""

FORMAT = "f3amd-crowd-1"

# CPU time a character on two cores with 2 MiB of L2 (F3AMD-FNO-96, one step, 32 frames): least at
# 128; 64 costs 8 % more, 512 15 %, 4096 38 %.
_CHUNK = 128
_CHUNK_BYTES = 1 << 28  # of generated frames; a rollout holds a few copies of them
_SLOWEST = 0.3  # m/s; a path has to be walked, even by one who stood in the starting pose
_TEMPLATE_SPEED = 1.2  # m/s, the speed that the sizes of the named paths are made for
_TEMPLATE_SECONDS = 60.0  # within which a character may enter a path: three laps of the longest
_SPACING = 1.0  # metres; neighbours start about 1.7 times as far apart


def _draws(characters: range, count: int, seed: int, purpose: int) -> np.ndarray:
    """Draw numbers in [0, 1), [n, count], that depend on seed, purpose and character alone.

    Philox counts: every character owns a stretch of the counter, to which we jump.
    """
    bits = np.random.Philox(np.random.SeedSequence([seed, purpose]))
    counters = -(-count // 4)  # each gives four doubles
    bits.advance(characters.start * counters)
    return np.random.Generator(bits).random((len(characters), 4 * counters))[:, :count]


_POSES, _WAYS = range(2)  # purposes of draws


@functools.lru_cache(maxsize=4)
def _templates(names: tuple[str, ...], num_frames: int, seed: int):
    """Return named paths long enough to enter late: positions [N, L, 2] and yaw [N, L]."""
    length = num_frames + round(_TEMPLATE_SECONDS * FPS)
    made = [named_path(name, length, speed=_TEMPLATE_SPEED, seed=seed, fps=FPS) for name in names]
    return np.stack([path.position for path in made]), np.stack([path.yaw for path in made])


def crowd_paths(characters: range, pace: np.ndarray, num_frames: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Give each character a path of its own, for many characters at once.

    Each walks a stretch of a path of `PATHS`, entered at a random time of its first minute, to the left
    or mirrored to the right, turned to a random side. The path is scaled so that it is walked at
    the character's pace with the turns of a walk: a runner's circle is wider. Starting places lie
    on a sunflower's spiral, about 1.7 m apart, however many there are.

    Args:
      characters: their numbers.
      pace: of each, [n], m/s.
      num_frames: F.
      seed: of all choices.

    Returns:
      (position [n, F, 2] in metres, yaw [n, F] in radians), both float64.

    Source: ours.
    """
    positions, yaws = _templates(PATHS, num_frames, seed)
    which, enter, side, facing = _draws(characters, 4, seed, _WAYS).T
    which = (which * len(positions)).astype(int)[:, None]
    late = (enter * (positions.shape[1] - num_frames + 1)).astype(int)
    frame = late[:, None] + np.arange(num_frames)
    position, yaw = positions[which, frame], yaws[which, frame]

    side = np.where(side < 0.5, 1.0, -1.0)[:, None]
    scale = (np.asarray(pace) / _TEMPLATE_SPEED)[:, None]
    angle = 2.0 * np.pi * facing[:, None] - np.pi - side * yaw[:, :1]
    x = scale * side * (position[..., 0] - position[:, :1, 0])
    z = scale * (position[..., 1] - position[:, :1, 1])
    cosine, sine = np.cos(angle), np.sin(angle)
    moved = np.stack([cosine * x + sine * z, cosine * z - sine * x], axis=-1)
    return moved + _sunflower(characters)[:, None, :], side * yaw + angle


def _sunflower(characters: range) -> np.ndarray:
    """Return places of equal density around the origin, [n, 2], metres (Vogel 1979)."""
    number = np.arange(characters.start, characters.stop)
    angle = number * np.pi * (3.0 - math.sqrt(5.0))
    radius = _SPACING * np.sqrt(number + 0.5)
    return radius[:, None] * np.stack([np.sin(angle), np.cos(angle)], axis=-1)


def plan_crowd(
    num_characters: int, num_frames: int, *, pace=_TEMPLATE_SPEED, seed: int = 0, min_distance: float = MIN_DISTANCE
) -> tuple[RootPath, ...]:
    """Plan paths for a crowd that keeps apart, ready for `MotionGenerator.rollout`.

    Args:
      num_characters: B.
      num_frames: F, at 30 fps.
      pace: of all, or of each, [B], m/s.
      seed: of all choices.
      min_distance: metres between any two characters at every frame.

    Returns:
      A path each; the same for the same arguments.

    Raises:
      ValueError: for counts or paces out of range, or what `keep_apart` refuses.
    """
    num_characters = _whole("num_characters", num_characters, 1)
    num_frames, seed = _whole("num_frames", num_frames, 2), checked_seed(seed)
    pace = np.asarray(pace, np.float64)
    if pace.shape not in ((), (num_characters,)) or not (np.isfinite(pace) & (pace > 0)).all():
        raise ValueError(f"pace must be one number above 0 m/s, or one for each of {num_characters} characters")
    paths = crowd_paths(range(num_characters), np.broadcast_to(pace, (num_characters,)), num_frames, seed)
    position, yaw = keep_apart(*paths, min_distance=min_distance)
    return tuple(RootPath(line, facing, FPS) for line, facing in zip(position, yaw, strict=True))


def default_chunk(num_frames: int, channels: int) -> int:
    """Return how many characters to generate at once.

    At most 128, which was fastest on a CPU; fewer where their frames would take over 256 MiB.

    Args:
      num_frames: F.
      channels: C.
    """
    return max(1, min(_CHUNK, _CHUNK_BYTES // (4 * num_frames * channels)))


@dataclass(frozen=True, eq=False)
class Crowd:
    """A finished crowd on disk; arrays are read as they are asked for.

    Attributes:
      settings: what `crowd.json` says.
      skeleton: of all characters.
      root: [B, F, 3], metres.
      rotations: [B, F, J, 6], float16.
      path: [B, F, 3], x, z in metres and facing in radians that were asked for.
      style_index: [B], into `settings["styles"]`.
    """

    settings: dict
    skeleton: Skeleton
    root: np.ndarray
    rotations: np.ndarray
    path: np.ndarray
    style_index: np.ndarray

    def __len__(self) -> int:
        return len(self.root)

    @property
    def num_frames(self) -> int:
        """Frames of every character, F."""
        return self.root.shape[1]

    def style(self, character: int) -> str:
        """Return a character's style."""
        return self.settings["styles"][self.style_index[character]]

    def target(self, character: int) -> RootPath:
        """Return the path that a character was asked to follow."""
        path = np.asarray(self.path[character], np.float64)
        return RootPath(path[:, :2], path[:, 2], self.settings["fps"])

    def motion(self, character: int) -> Motion:
        """Return a character's motion."""
        root = np.asarray(self.root[character], np.float64)
        rotations = np.asarray(self.rotations[character], np.float64)
        frames = np.concatenate([root, rotations.reshape(len(root), -1)], axis=-1)
        return motion_from_frames(self.skeleton, frames, self.settings["fps"], name=self.style(character))


def generate_crowd(
    generator: MotionGenerator, num_characters: int, num_frames: int, out, *,
    styles: str | Sequence[str] | None = None, min_distance: float | None = None, seed: int = 0,
    chunk: int | None = None, overwrite: bool = False, finished_too: bool = False, progress: bool = False,
) -> Crowd:  # fmt: skip
    """Animate any number of characters, and write them to a folder chunk by chunk.

    Memory depends on the chunk, not on the number of characters. A call that was stopped goes on
    where it was when it is made again; every finished chunk is on disk before it counts.

    Args:
      generator: of the motion; says model, steps and sampler.
      num_characters: B.
      num_frames: F, at 30 fps.
      out: folder to write to (see the module's table); new, empty, or of this call when stopped.
      styles: a name, or several taken in turn; by default all that the model knows and has starting poses for.
      min_distance: metres that paths keep from each other at every frame, all planned before the
        first chunk is made (see `crowd_planning`); None lets characters walk through one another.
      seed: of paths, starting poses and noise, 0 or more.
      chunk: characters generated at once; by default `default_chunk`.
      overwrite: write over a crowd that lies there, finished or not.
      finished_too: take this very crowd, where it lies there finished, in place of refusing it.
      progress: show a progress bar.

    Returns:
      The crowd, as from `read_crowd`.

    Raises:
      ValueError: for counts below 1 (2 frames), an unknown style, a folder with anything else in it (a
        crowd of another call, for one), or too little room on the disk.
      ArithmeticError: if the model generates a number that is not finite.
    """
    trained, skeleton = generator.trained, generator.trained.skeleton
    num_characters = _whole("num_characters", num_characters, 1)
    num_frames, seed = _whole("num_frames", num_frames, 2), checked_seed(seed)
    if chunk is None:
        chunk = default_chunk(num_frames, trained.config.channels)
    chunk = min(_whole("chunk", chunk, 1), num_characters)
    if styles is None:
        styles = [style for style in trained.styles if style in trained.start_poses]
    styles = [styles] if isinstance(styles, str) else styles
    in_turn = np.array([trained.style_index(style) for style in styles], np.int32)
    if not len(in_turn):
        raise ValueError("a crowd needs at least one style")
    if without := [style for style in styles if style not in trained.start_poses]:
        raise ValueError(f"no starting pose is stored for style {without[0]!r}; leave it out")
    settings = {
        "format": FORMAT,
        "num_characters": num_characters,
        "num_frames": num_frames,
        "fps": FPS,
        "seed": seed,
        "chunk": chunk,
        "paths": PATHS,
        "min_distance": min_distance,
        "styles": list(trained.styles),
        "styles_in_turn": hashlib.sha256(in_turn.tobytes()).hexdigest()[:12],
        **describe_skeleton(skeleton),
        "offsets": np.asarray(skeleton.offsets).tolist(),
        "model": {
            "name": trained.name,
            "weights": weights_digest(trained.params),
            "dtype": generator.dtype.name,
            "sampler": generator.sampler,
            "sigmas": np.asarray(generator.sigmas, np.float64).tolist(),
            **{name: trained.record.get(name) for name in ("dataset", "dataset_licence", "dataset_credit")},
        },
    }
    settings = json.loads(json.dumps(settings))
    out = Path(out)
    with locked(out.resolve().with_name(f".{out.resolve().name}.lock"), f"animating the crowd {out.name}"):
        return _generate(generator, settings, in_turn, out, overwrite, finished_too, progress)


def _generate(generator, settings, in_turn, out: Path, overwrite, finished_too, progress) -> Crowd:
    """Make what is still missing of a crowd; the folder is ours alone."""
    trained = generator.trained
    num_characters, num_frames, seed, chunk = (settings[of] for of in ("num_characters", "num_frames", "seed", "chunk"))
    finished, first_path = _look_into(out, settings, overwrite, finished_too)
    _check_room(out, settings)
    planned = None

    def asked_of(part: range):
        style_index = in_turn[np.arange(part.start, part.stop) % len(in_turn)]
        pace, pose = _paces(generator, part, style_index, seed)
        if planned is None:
            return style_index, pose, *crowd_paths(part, pace, num_frames, seed)
        return style_index, pose, *(array[part.start : part.stop] for array in planned)

    if settings["min_distance"] is not None:
        _, _, *wanted = asked_of(range(num_characters))
        planned = keep_apart(*wanted, min_distance=settings["min_distance"])
    beginning = asked_of(range(chunk))
    # In tenths of a millimetre and milliradian: last bits of the same path may differ between machines.
    tenths = np.rint(1e4 * np.column_stack([array[0] for array in beginning[2:]])).astype("<i8")
    settings[_FIRST_PATH] = hashlib.sha256(tenths.tobytes()).hexdigest()[:12]
    if first_path not in (None, settings[_FIRST_PATH]):
        what = "holds a crowd whose first character walks another path than this call's"
        raise ValueError(f"{out}: {what}; go on with the version that began it, {_WAY_OUT}")
    if finished == 0:
        _write_settings(out, settings, 0)
        _lay_out(out, settings)
    for name in _layout(settings):
        _open_array(out, name, settings)
    noise = jax.random.key(seed)
    with tqdm(total=num_characters, initial=finished, unit=" characters", disable=not progress) as bar:
        for first in range(finished, num_characters, chunk):
            characters = range(first, min(first + chunk, num_characters))
            style_index, pose, position, yaw = asked_of(characters) if first else beginning
            start = path_start(position)
            speed = np.linalg.norm(position[:, 0] - start, axis=-1)
            pick = lambda style, members, counts, draw=pose: (draw[members] * counts).astype(int)
            history = starting_poses(trained, style_index, start, yaw[:, 0], speed, pick).astype(np.float32)
            # The last chunk is filled up with its last character, so that nothing compiles twice.
            number = np.minimum(np.arange(first, first + chunk), characters.stop - 1)
            row, keys = number - first, jax.vmap(jax.random.fold_in, (None, 0))(noise, number)
            frames = generator.generate(position[row], yaw[row], style_index[row], history[row], keys)
            frames = frames[: len(characters)]
            if not np.isfinite(frames).all():
                worst = first + int(np.argwhere(~np.isfinite(frames))[0][0])
                what = f"{trained.name} generated a number that is not finite for character {worst}"
                raise ArithmeticError(f"{what}; its weights or its noise levels are broken")
            root, rotations = split_frames(frames)
            path = np.concatenate([position, yaw[..., None]], axis=-1)
            for name, values in zip(_layout(settings), (root, rotations, path, style_index), strict=True):
                _write_rows(out, name, settings, first, values)
            _write_settings(out, settings, characters.stop)
            bar.update(len(characters))
    return read_crowd(out)


def read_crowd(folder) -> Crowd:
    """Open a crowd that `generate_crowd` finished.

    Args:
      folder: where it lies.

    Returns:
      The crowd; its arrays stay on disk until they are indexed.

    Raises:
      ValueError: naming the file, if it is missing, cut short, of another kind, or the crowd is not
        finished.
    """
    folder = Path(folder)
    settings = _read_settings(folder)
    total, finished = settings["num_characters"], settings["num_finished"]
    if finished != total:
        what = f"only {finished} of {total} characters are finished"
        raise ValueError(f"{folder}: {what}; make the same call again and it goes on")
    with errors_name(folder / _SETTINGS):
        skeleton = described_skeleton(settings, settings["offsets"])
    return Crowd(settings, skeleton, *(_open_array(folder, name, settings) for name in _layout(settings)))


def _whole(name: str, value, least: int) -> int:
    """Return a whole number; ValueError if it is none, or below the least."""
    if int(value) != value or value < least:
        raise ValueError(f"{name} must be a whole number of {least} or more, got {value}")
    return int(value)


def _paces(generator: MotionGenerator, characters: range, style_index, seed: int):
    """Draw each character's pace from the starting poses of its style.

    Returns:
      (pace [n] in m/s, a number in [0, 1) for the choice of the pose [n]).
    """
    trained = generator.trained
    which, pose = _draws(characters, 2, seed, _POSES).T
    pace = np.empty(len(characters))
    for style in np.unique(style_index):
        members = style_index == style
        speeds = FPS * pose_speed(trained.start_poses[trained.styles[style]])
        pace[members] = speeds[(which[members] * len(speeds)).astype(int)]
    return np.maximum(pace, _SLOWEST), pose


_SETTINGS = "crowd.json"
_WAY_OUT = "pass overwrite=True or choose another folder"
_FIRST_PATH = "first_path"  # digest; crowds of earlier versions lack it
_NEEDED = ("num_characters", "num_frames", "num_finished", "fps", "styles", "joints", "offsets")


def _read_settings(folder: Path) -> dict:
    """Return what `crowd.json` says; ValueError if it is missing or not ours."""
    path = folder / _SETTINGS
    if not path.is_file():
        raise ValueError(f"{folder}: holds no crowd ({_SETTINGS} is missing)")
    with errors_name(path):
        settings = json.loads(path.read_text(encoding="utf-8"))
        if not isinstance(settings, dict) or settings.get("format") != FORMAT:
            raise ValueError("not written by this project; choose another folder")
        if missing := [name for name in _NEEDED if name not in settings]:
            raise ValueError(f"{missing[0]} is missing; restore a whole copy")
        finished, total = settings["num_finished"], settings["num_characters"]
        if not 0 <= finished <= total:
            raise ValueError(f"says that {finished} of {total} characters are finished")
        return settings


def _write_settings(folder: Path, settings: dict, finished: int) -> None:
    text = json.dumps(settings | {"num_finished": finished}, indent=1, ensure_ascii=False)
    write_whole(folder / _SETTINGS, text + "\n")


def _look_into(out: Path, settings: dict, overwrite: bool, finished_too: bool) -> tuple[int, str | None]:
    """Return how far this very crowd has come; ValueError for anything else.

    Returns:
      (number of finished characters, digest of the first one's path if it is known).
    """
    if out.exists() and not out.is_dir():
        raise ValueError(f"{out}: not a folder; a crowd needs one to itself")
    if not (out / _SETTINGS).exists():
        other = sorted(item.name for item in out.glob("*") if not item.name.startswith("."))
        if other:
            raise ValueError(f"{out}: holds other files ({other[0]}); choose a folder of its own")
        return 0, None
    there = _read_settings(out)  # also before overwriting: what is not ours stays
    if overwrite:
        return 0, None
    for name, value in settings.items():
        if there.get(name) != value:
            old, new = (json.dumps(value)[:60] for value in (there.get(name), value))
            raise ValueError(f"{out}: holds a crowd made with {name} {old}, not {new}; {_WAY_OUT}")
    if there["num_finished"] == settings["num_characters"] and not finished_too:
        raise ValueError(f"{out}: holds this crowd already, finished; read it with read_crowd, {_WAY_OUT}")
    return there["num_finished"], there.get(_FIRST_PATH)


def _layout(settings: dict) -> dict[str, tuple[str, tuple[int, ...]]]:
    """Return file stem -> type and shape of its numbers."""
    count, frames = settings["num_characters"], settings["num_frames"]
    return {
        "root": ("<f4", (count, frames, 3)),
        "rotations": ("<f2", (count, frames, len(settings["joints"]), 6)),
        "path": ("<f4", (count, frames, 3)),
        "styles": ("<i4", (count,)),
    }


def _check_room(out: Path, settings: dict) -> None:
    """Raise ValueError if the disk lacks room for what is not there yet."""
    layout = _layout(settings)
    needed = sum(np.dtype(dtype).itemsize * math.prod(shape) for dtype, shape in layout.values())
    needed -= sum(path.stat().st_size for path in (out / f"{name}.npy" for name in layout) if path.exists())
    place = next(folder for folder in (out, *out.absolute().parents) if folder.exists())
    free = shutil.disk_usage(place).free
    if needed > free:
        what = f"this crowd takes {needed / 1e9:.3g} GB more, and the disk has {free / 1e9:.3g} GB free"
        raise ValueError(f"{out}: {what}; make fewer characters or frames, or choose another disk")


def _lay_out(out: Path, settings: dict) -> None:
    """Make the arrays' files at their full size.

    Their room is taken at once: a disk that is full halfway would kill a process that writes to a map.
    """
    for name, (dtype, shape) in _layout(settings).items():
        path = out / f"{name}.npy"
        np.lib.format.open_memmap(path, "w+", dtype, shape)
        with path.open("r+b") as file:
            os.posix_fallocate(file.fileno(), 0, path.stat().st_size)


def _open_array(folder: Path, name: str, settings: dict, mode: str = "r") -> np.memmap:
    """Map an array's file; ValueError names one that is missing, cut short or another's."""
    path = folder / f"{name}.npy"
    if not path.is_file():
        raise ValueError(f"{path}: missing; the crowd has to be made anew")
    with errors_name(path):
        try:
            array = np.lib.format.open_memmap(path, mode)
        # What numpy and Python's own tokenizer raise over damaged bytes is no closed list.
        except Exception as error:
            raise ValueError(f"is not a whole array ({error}); the crowd has to be made anew") from error
        if (array.dtype, array.shape) != _layout(settings)[name]:
            raise ValueError(f"holds {array.dtype} {array.shape}, which is not what {_SETTINGS} says")
        return array


def _write_rows(out: Path, name: str, settings: dict, first: int, values: np.ndarray) -> None:
    """Write a chunk's rows down to the disk.

    The file is mapped for one chunk only, as mapped pages count as this process's memory.
    """
    rows = _open_array(out, name, settings, "r+")
    rows[first : first + len(values)] = values
    rows.flush()
