"""Crowds of any size: characters in chunks, written to disk as they are made.

A crowd is a folder. `crowd.json` says skeleton, styles, model and its terms, seed, frame rate, and how many are
finished. `crowd.npy` holds a row for each of B characters, which NumPy opens without this library, such as by
`np.load("crowd.npy", mmap_mode="r")["root"]`:

| field | what |
|---|---|
| `root` | float32 [F, 3]: root x, y, z in metres, +Y up |
| `rotations` | float16 [F, J, 6]: first two columns of each joint's local rotation matrix |
| `path` | float32 [F, 3]: what was asked for: root x and z in metres, facing in radians |
| `style` | int32: place in the list `styles` of `crowd.json` |

Rotations bear half precision, root positions do not: float16 steps 0.25 m at 300 m.

A character is made from the seed and its own number alone: neither the chunk it comes in, nor the
size of the crowd, nor a run that stopped and went on makes a difference beyond rounding. Characters
do not see each other; they may walk through one another, unless their paths are planned to keep
apart (`min_distance`). Then everybody's path depends on who else is there.
"""

import functools
import json
import math
import os
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import jax
import numpy as np
from tqdm import tqdm

from f3amd_companion.serving.crowd_planning import FPS, MIN_DISTANCE, keep_apart
from f3amd_lib.data.features import motion_from_frames, split_frames
from f3amd_lib.ground.files import check_own_folder, locked, write_whole
from f3amd_lib.ground.names import checked_seed, checked_value
from f3amd_lib.ground.trees import errors_name, weights_digest
from f3amd_lib.motion.root_paths import NAMES, RootPath, named_path
from f3amd_lib.motion.skeleton import Motion, Skeleton, describe_skeleton, described_skeleton
from f3amd_lib.rollout.rollout import MotionGenerator, path_start, pose_speed, starting_poses

PATHS = tuple(name for name in NAMES if name != "complex")
"""Names that the paths of a crowd are drawn from: those that face where they go."""

FORMAT = "f3amd-crowd-2"

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
    which, enter, side, facing = _draws(characters, 4, seed, purpose=1).T
    which = (which * len(positions)).astype(int)[:, None]
    frame = (enter * (positions.shape[1] - num_frames + 1)).astype(int)[:, None] + np.arange(num_frames)
    position, yaw = positions[which, frame], yaws[which, frame]

    side = np.where(side < 0.5, 1.0, -1.0)[:, None]
    scale = (np.asarray(pace) / _TEMPLATE_SPEED)[:, None]
    angle = 2.0 * np.pi * facing[:, None] - np.pi - side * yaw[:, :1]
    x = scale * side * (position[..., 0] - position[:, :1, 0])
    z = scale * (position[..., 1] - position[:, :1, 1])
    cosine, sine = np.cos(angle), np.sin(angle)
    moved = np.stack([cosine * x + sine * z, cosine * z - sine * x], axis=-1)
    # Places of equal density on a spiral around the origin (Vogel 1979).
    number = np.arange(characters.start, characters.stop)
    turn, radius = number * np.pi * (3.0 - math.sqrt(5.0)), _SPACING * np.sqrt(number + 0.5)
    return moved + (radius[:, None] * np.stack([np.sin(turn), np.cos(turn)], axis=-1))[:, None, :], side * yaw + angle


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
      ValueError: for counts out of range, or what `keep_apart` refuses.
    """
    _check_counts(num_characters, num_frames)
    seed = checked_seed(seed)
    paths = crowd_paths(range(num_characters), np.broadcast_to(pace, (num_characters,)), num_frames, seed)
    position, yaw = keep_apart(*paths, min_distance=min_distance)
    return tuple(RootPath(line, facing, FPS) for line, facing in zip(position, yaw, strict=True))


def _check_counts(num_characters, num_frames, chunk=1) -> None:
    counts = num_characters, num_frames, chunk
    if any(count != int(count) for count in counts) or min(num_characters, num_frames - 1, chunk) < 1:
        what = "whole numbers of characters (1 or more), frames (2 or more) and characters at once (1 or more)"
        raise ValueError(f"a crowd has {what}, got {num_characters}, {num_frames} and {chunk}")


@dataclass(frozen=True, eq=False)
class Crowd:
    """A finished crowd on disk; arrays are read as they are asked for.

    Attributes:
      settings: what `crowd.json` says.
      skeleton: of all characters.
      rows: of `crowd.npy`, [B].
    """

    settings: dict
    skeleton: Skeleton
    rows: np.ndarray

    def __len__(self) -> int:
        return len(self.rows)

    @property
    def num_frames(self) -> int:
        """Frames of every character, F."""
        return self.settings["num_frames"]

    def style(self, character: int) -> str:
        """Return a character's style."""
        return self.settings["styles"][self.rows["style"][character]]

    def target(self, character: int) -> RootPath:
        """Return a character's target path."""
        path = np.asarray(self.rows["path"][character], np.float64)
        return RootPath(path[:, :2], path[:, 2], self.settings["fps"])

    def motion(self, character: int) -> Motion:
        """Return a character's motion."""
        root = np.asarray(self.rows["root"][character], np.float64)
        rotations = np.asarray(self.rows["rotations"][character], np.float64)
        frames = np.concatenate([root, rotations.reshape(len(root), -1)], axis=-1)
        return motion_from_frames(self.skeleton, frames, self.settings["fps"], name=self.style(character))


def generate_crowd(
    generator: MotionGenerator, num_characters: int, num_frames: int, out, *,
    styles: str | Sequence[str] | None = None, min_distance: float | None = None, seed: int = 0,
    chunk: int | None = None, overwrite: bool = False, progress: bool = False,
) -> Crowd:  # fmt: skip
    """Animate any number of characters, and write them to a folder chunk by chunk.

    Memory depends on the chunk, not on the number of characters. A call that was stopped goes on
    where it was when it is made again; every finished chunk is on disk before it counts.

    Args:
      generator: of the motion; says model, steps and sampler.
      num_characters: B.
      num_frames: F, at 30 fps.
      out: folder to write to (see the module's text); new, empty, or of this call when stopped or finished.
      styles: a name, or several taken in turn; by default all that the model knows and has starting poses for.
      min_distance: metres that paths keep from each other at every frame, all planned before the
        first chunk is made (see `crowd_planning`); None lets characters walk through one another.
      seed: of paths, starting poses and noise, 0 or more.
      chunk: characters generated at once; by default 128, which was fastest on a CPU, or fewer where their frames would
        take over 256 MiB.
      overwrite: write over a crowd that lies there, finished or not.
      progress: show a progress bar.

    Returns:
      The crowd, as from `read_crowd`.

    Raises:
      ValueError: for counts below 1 (2 frames), an unknown style, or a folder with anything else in it (a
        crowd of another call, for one).
      OSError: for too little room on the disk.
      ArithmeticError: if the model generates a number that is not finite.
    """
    trained, skeleton = generator.trained, generator.trained.skeleton
    if chunk is None:
        chunk = max(1, min(_CHUNK, _CHUNK_BYTES // (4 * max(1, int(num_frames)) * trained.config.channels)))
    _check_counts(num_characters, num_frames, chunk)
    chunk = min(chunk, num_characters)
    if styles is None:
        styles = [style for style in trained.styles if style in trained.start_poses]
    styles = [styles] if isinstance(styles, str) else list(styles)
    in_turn = np.array([trained.style_index(style) for style in styles], np.int32)
    if without := [style for style in styles if style not in trained.start_poses]:
        raise ValueError(f"no starting pose is stored for style {without[0]!r}; leave it out")
    if not styles:
        raise ValueError("a crowd needs at least one style")
    settings = {
        "format": FORMAT, "num_characters": num_characters, "num_frames": num_frames, "fps": FPS,
        "seed": checked_seed(seed), "chunk": chunk, "paths": PATHS, "min_distance": min_distance,
        "styles": list(trained.styles), "styles_in_turn": styles,
        **describe_skeleton(skeleton), "offsets": np.asarray(skeleton.offsets).tolist(),
    }  # fmt: skip
    settings["model"] = {
        "name": trained.name, "weights": weights_digest(trained.params), "dtype": "float32",
        "sampler": generator.sampler, "sigmas": np.asarray(generator.sigmas, np.float64).tolist(),
        **{name: trained.record.get(name) for name in ("dataset", "dataset_licence", "dataset_credit")},
    }  # fmt: skip
    settings = json.loads(json.dumps(settings))
    if min_distance is not None:
        checked_value("min_distance", min_distance, "float")
    out = Path(out)
    _require_room(out.resolve() / _ROWS, _row_type(settings).itemsize * num_characters)
    with locked(out.resolve().with_name(f".{out.resolve().name}.lock"), f"animating the crowd {out.name}"):
        finished = _num_finished(out, settings, overwrite)
        if finished == 0:
            _write_settings(out, settings, 0)
            _lay_out(out, settings)
        _open_rows(out, settings)  # refuses a file that was cut meanwhile
        with tqdm(total=num_characters, initial=finished, unit=" characters", disable=not progress) as bar:
            for characters, made in _chunks(generator, settings, in_turn, finished):
                rows = _open_rows(out, settings, "r+")  # for one chunk: mapped pages count as this process's memory
                for name, values in made.items():
                    rows[name][characters.start : characters.stop] = values
                rows.flush()
                _write_settings(out, settings, characters.stop)
                bar.update(len(characters))
    return read_crowd(out)


def _chunks(generator, settings: dict, in_turn, finished: int) -> Iterator[tuple[range, dict[str, np.ndarray]]]:
    """Make what is still missing of a crowd: yield characters, and their fields of `crowd.npy`."""
    trained, seed, chunk = generator.trained, settings["seed"], settings["chunk"]
    num_characters, planned, noise = settings["num_characters"], None, jax.random.key(settings["seed"])

    def asked_of(part: range):
        style_index = in_turn[np.arange(part.start, part.stop) % len(in_turn)]
        pace, pose = _paces(generator, part, style_index, seed)
        if planned is None:
            return style_index, pose, *crowd_paths(part, pace, settings["num_frames"], seed)
        return style_index, pose, *(array[part.start : part.stop] for array in planned)

    if settings["min_distance"] is not None:
        _, _, *wanted = asked_of(range(num_characters))
        planned = keep_apart(*wanted, min_distance=settings["min_distance"])
    for first in range(finished, num_characters, chunk):
        characters = range(first, min(first + chunk, num_characters))
        style_index, pose, position, yaw = asked_of(characters)
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
        yield characters, {"root": root, "rotations": rotations, "path": path, "style": style_index}


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
    with errors_name(folder / _SETTINGS):
        total, finished = settings["num_characters"], settings["num_finished"]
        if finished != total:
            raise ValueError(f"only {finished} of {total} characters are finished; the same call goes on")
        skeleton = described_skeleton(settings, settings["offsets"])
    return Crowd(settings, skeleton, _open_rows(folder, settings))


def _paces(generator: MotionGenerator, characters: range, style_index, seed: int):
    """Draw each character's pace from the starting poses of its style.

    Returns:
      (pace [n] in m/s, a number in [0, 1) for the choice of the pose [n]).
    """
    trained = generator.trained
    which, pose = _draws(characters, 2, seed, purpose=0).T
    pace = np.empty(len(characters))
    for style in np.unique(style_index):
        members = style_index == style
        speeds = FPS * pose_speed(trained.start_poses[trained.styles[style]])
        pace[members] = speeds[(which[members] * len(speeds)).astype(int)]
    return np.maximum(pace, _SLOWEST), pose


_SETTINGS, _ROWS = "crowd.json", "crowd.npy"


def _read_settings(folder: Path) -> dict:
    """Return what `crowd.json` says; ValueError if it is missing or not ours."""
    path = folder / _SETTINGS
    if not path.is_file():
        raise ValueError(f"{folder}: holds no crowd ({_SETTINGS} is missing)")
    with errors_name(path):
        settings = json.loads(path.read_text(encoding="utf-8"))
        if not isinstance(settings, dict) or settings.get("format") != FORMAT:
            raise ValueError("not written by this version of this project; choose another folder")
        return settings


def _write_settings(folder: Path, settings: dict, finished: int) -> None:
    text = json.dumps(settings | {"num_finished": finished}, indent=1, ensure_ascii=False)
    write_whole(folder / _SETTINGS, text + "\n")


def _num_finished(out: Path, settings: dict, overwrite: bool) -> int:
    """Return how far this very crowd has come; ValueError for anything else."""
    if not (out / _SETTINGS).exists():
        check_own_folder(out)
        return 0
    there = _read_settings(out)  # also before overwriting: what is not ours stays
    unlike = [name for name, value in settings.items() if there.get(name) != value]
    if overwrite:
        return 0 if unlike or there["num_finished"] == settings["num_characters"] else there["num_finished"]
    if unlike:
        raise ValueError(f"{out}: holds a crowd made with another {unlike[0]}; pass --overwrite or another folder")
    return there["num_finished"]


def _row_type(settings: dict) -> np.dtype:
    """Return the type of a character's row, which has every field of its frames."""
    frames, joints = settings["num_frames"], len(settings["joints"])
    fields = [("root", "<f4", (frames, 3)), ("rotations", "<f2", (frames, joints, 6)), ("path", "<f4", (frames, 3))]
    return np.dtype([*fields, ("style", "<i4")])


def _require_room(path: Path, size: int) -> None:
    """Raise OSError where a file of this size, bytes, does not fit on the disk; what it replaces makes room."""
    free = shutil.disk_usage(next(folder for folder in path.parents if folder.exists())).free
    if size > free + (path.stat().st_size if path.exists() else 0):
        room = f"takes {size / 1e9:,.3g} GB, and {free / 1e9:,.3g} GB are free on the disk"
        raise OSError(f"{path}: {room}; ask for fewer characters or frames, or make room")


def _lay_out(out: Path, settings: dict) -> None:
    """Make the file of all rows at its full size.

    Its room is taken at once: a disk that is full halfway would kill a process that writes to a map.
    """
    rows = np.lib.format.open_memmap(out / _ROWS, "w+", _row_type(settings), (settings["num_characters"],))
    with (out / _ROWS).open("r+b") as file:
        if hasattr(os, "posix_fallocate"):  # macOS has none
            os.posix_fallocate(file.fileno(), 0, rows.offset + rows.nbytes)


def _open_rows(folder: Path, settings: dict, mode: str = "r") -> np.memmap:
    """Map the rows; ValueError names a file that is missing, cut short or another's."""
    path = folder / _ROWS
    try:
        rows, wanted = np.load(path, mmap_mode=mode), (_row_type(settings), (settings["num_characters"],))
        if (rows.dtype, rows.shape) != wanted:
            raise ValueError(f"it is not what {_SETTINGS} says")
        return rows
    # What numpy and Python's own tokenizer raise over damaged bytes is no closed list.
    except Exception as error:
        raise ValueError(f"{path}: is not a whole array ({error}); generate the crowd again") from error
