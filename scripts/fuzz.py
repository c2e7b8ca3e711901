"""Damage files at random and read them: each must be read, or refused with a ValueError that names it.

    python scripts/fuzz.py bvh --minutes 10
    python scripts/fuzz.py --minutes 2          each reader in turn
    python scripts/fuzz.py bvh --keep           counts go to docs/fuzz.csv; scripts/faults.py shows them on its page

What a reader lets through is written to --out with its traceback. Make a test of it.
"""

from __future__ import annotations

import argparse
import csv
import json
import logging
import random
import sys
import tempfile
import time
import traceback
import warnings
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # this tree's library, whatever is installed

from f3amd_companion.measuring.runner import kept_rows
from f3amd_lib.data.packed import load_packed, pack, save_packed
from f3amd_lib.data.sources import open_dataset
from f3amd_lib.ground.files import whole_file
from f3amd_lib.ground.records import read_table, write_table
from f3amd_lib.motion.bvh import format_bvh, read_bvh
from f3amd_lib.motion.root_paths import read_path_csv
from f3amd_lib.motion.skeleton import Motion, Skeleton
from f3amd_lib.text.data.captioned_folder import read_caption_table, write_humanml3d
from f3amd_lib.text.data.humanml3d import read_humanml3d
from f3amd_lib.text.data.text_motions import text_motions

COUNTS = Path(__file__).resolve().parents[1] / "docs" / "fuzz.csv"

WORDS = (
    "0 -1 1e308 1e-320 nan inf 99999999999999999999 \ud800 \x00 { } [ ] # , \" ' null true [[[[[[[[ Frames: CHANNELS "
    "OFFSET MOTION JOINT End \u0661 \ufeff ../../x"
).split(" ") + ["9" * 5000, "[" * 3000, "x" * 3000, "\n", "\r", "\t", " "]
"""What is put into a file beside random bytes."""


def damaged(data: bytes, rng: random.Random) -> bytes:
    """Return bytes with one to six damages: flipped, cut, doubled, swapped or foreign parts."""
    data = bytearray(data)
    for _ in range(rng.randint(1, 6)):
        at, length = rng.randrange(len(data) + 1), rng.choice((1, 1, 2, 8, 64, 512))
        kind = rng.randrange(6)
        if kind == 0 and data:
            data[at % len(data)] ^= rng.randrange(1, 256)
        elif kind == 1:
            del data[at : at + length]
        elif kind == 2:
            data[at:at] = data[at : at + length]
        elif kind == 3:
            data[at:at] = rng.choice(WORDS).encode("utf-8", "surrogatepass")
        elif kind == 4:
            data[at : at + length] = rng.randbytes(min(length, 8))
        else:
            words = bytes(data).split(b" ")
            place = rng.randrange(len(words))
            words[place] = rng.choice(WORDS).encode("utf-8", "surrogatepass")
            data = bytearray(b" ".join(words))
    return bytes(data)


@dataclass(frozen=True)
class Reader:
    """Something that reads files.

    Attributes:
      make: writes sound files to a folder.
      read: reads them.
      damage: which of the files are damaged, as a pattern.
    """

    make: Callable[[Path], None]
    read: Callable[[Path], object]
    damage: str


def walk(num_frames: int = 50) -> Motion:
    """A small figure that moves a little."""
    names = ("Hips", "LeftUpLeg", "LeftFoot", "left_toe", "RightUpLeg", "RightFoot", "right_toe")
    offsets = [[0, 0, 0], [0.1, 0, 0], [0, -0.4, 0], [0, -0.4, 0.1], [-0.1, 0, 0], [0, -0.4, 0], [0, -0.4, 0.1]]
    frame = np.arange(num_frames)
    root = np.stack([0.02 * frame, 0.9 + 0.01 * np.sin(frame), 0.03 * frame], axis=-1)
    rotations = np.broadcast_to(np.eye(3), (num_frames, 7, 3, 3))
    return Motion(Skeleton(names, (-1, 0, 1, 2, 0, 4, 5), np.array(offsets, float)), root, rotations)


RECORD = {"dataset": "synthetic", "profile": "smoke", "seed": 0, "weights_digests": {"a": ["b"]}}


def _make_zip(folder: Path) -> None:
    with zipfile.ZipFile(folder / "data.zip", "w", zipfile.ZIP_DEFLATED) as file:
        for name in ("calm/a.bvh", "proud/b.bvh"):
            file.writestr(name, format_bvh(walk(3)))


def _make_cache(folder: Path) -> None:
    source = folder / "source"
    source.mkdir()
    (source / "calm_a.bvh").write_text(format_bvh(walk()))
    save_packed(folder / "cache.safetensors", pack(open_dataset("folder", path=source), progress=False))


def _make_weights(folder: Path) -> None:
    import jax.numpy as jnp

    from f3amd_lib.ground.trees import save_tree

    save_tree(folder / "a.safetensors", {"a": jnp.ones((3, 4)), "b": [jnp.zeros(2)]}, {"kind": "x", "of": {"y": 1}})


def _read_weights(folder: Path) -> None:
    import jax.numpy as jnp

    from f3amd_lib.ground.trees import load_tree

    tree, _ = load_tree(folder / "a.safetensors", {"a": jnp.ones((3, 4)), "b": [jnp.zeros(2)]})
    if not (np.all(tree["a"] == 1) and np.all(tree["b"][0] == 0)):
        raise AssertionError("damaged weights were read")


def _make_humanml3d(folder: Path) -> None:
    clips = [(f"m{k}", walk(30 + k), ("a man walks",), ("train", "validation", "test")[k], "a") for k in range(3)]
    data = text_motions(clips, skeleton=walk().skeleton, name="tiny", fps=20.0, licence="none", credit="", skipped=())
    write_humanml3d(folder / "set", data)


def _make_crowd(folder: Path) -> None:
    from f3amd_companion.serving import crowd
    from f3amd_lib.motion.skeleton import describe_skeleton

    out, skeleton = folder / "crowd", walk().skeleton
    out.mkdir()
    settings = {"format": crowd.FORMAT, "num_characters": 3, "num_frames": 40, "fps": 30.0, "styles": ["calm", "proud"]}
    settings |= describe_skeleton(skeleton) | {"offsets": skeleton.offsets.tolist()}
    crowd._lay_out(out, settings)
    crowd._write_settings(out, settings, finished=3)


def _read_crowd(folder: Path) -> None:
    from f3amd_companion.serving.crowd import read_crowd

    crowd = read_crowd(folder / "crowd")
    if len(crowd) != 3 or crowd.num_frames != 40:
        raise AssertionError("a damaged crowd was read as another")


def _make_manifest(folder: Path) -> None:
    from f3amd_companion.serving import artefact

    manifest = {"format": artefact.FORMAT, "files": {"round.mlirbc": {"bytes": 3, "sha256": "00"}}}
    text = json.dumps(manifest | {"sha256": artefact.manifest_digest(manifest)}, indent=1)
    (folder / artefact.MANIFEST).write_text(text)


def _read_manifest(folder: Path) -> None:
    from f3amd_companion.serving.artefact import read_manifest

    read_manifest(folder)


def _read_control(folder: Path) -> None:
    from f3amd_lib.text.sampling.captioned_motion import read_control_csv

    read_control_csv(folder / "control.csv", 40)


def _read_queue(folder: Path) -> None:
    from f3amd_companion.measuring.campaign import queue

    queue(folder / "queue.toml")


def _make_published(folder: Path) -> None:
    from safetensors.numpy import save_file

    arrays = {"embed.weight": np.ones((3, 4), np.float32), "embed.bias": np.zeros(3)}
    save_file(arrays, folder / "a.safetensors")


def _read_published(folder: Path) -> None:
    from f3amd_lib.text.released import released_arrays

    released_arrays(folder / "a.safetensors")


READERS = {
    "bvh": Reader(lambda f: (f / "a.bvh").write_text(format_bvh(walk(4))), lambda f: read_bvh(f / "a.bvh"), "a.bvh"),
    "path": Reader(
        lambda f: (f / "path.csv").write_text("x,z,yaw_deg\n0,0,0\n0,0.1,5\n0.1,0.2,10\n"),
        lambda f: read_path_csv(f / "path.csv"),
        "path.csv",
    ),
    "record": Reader(
        lambda f: write_table(f / "t.csv", pd.DataFrame({"a": [1.5, 2.0], "b": ["x", "y"]}), RECORD),
        lambda f: (read_table(f / "t.csv"), kept_rows(f / "t.csv", RECORD)),
        "t.*",
    ),
    "weights": Reader(_make_weights, _read_weights, "*.safetensors"),
    "cache": Reader(_make_cache, lambda f: load_packed(f / "cache.safetensors"), "cache.safetensors"),
    "archive": Reader(
        _make_zip, lambda f: [clip.load() for clip in open_dataset("folder", path=f / "data.zip").clips], "data.zip"
    ),
    "captions": Reader(
        lambda f: (f / "captions.csv").write_text('file,caption\na,walks on\nb,"turns, then stops"\n'),
        lambda f: read_caption_table(f / "captions.csv"),
        "captions.csv",
    ),
    "humanml3d": Reader(_make_humanml3d, lambda f: read_humanml3d(f / "set"), "set/**/*"),
    "control": Reader(
        lambda f: (f / "control.csv").write_text("frame,x,y,z\n0,0,1,0\n9,0.5,1.5,0.25\n39,1e-1,2,3\n"),
        _read_control,
        "control.csv",
    ),
    "queue": Reader(
        lambda f: (f / "queue.toml").write_text(
            '[[run]]\npresets = ["F3AMD-FNO-32"]\nseeds = [0, 1]\nwindows = [200, 400]\n'
            '[[run]]\nrecipes = ["mixed-noise"]\nwindow = 64\nwindows = [400]\n'
        ),
        _read_queue,
        "queue.toml",
    ),
    "crowd": Reader(_make_crowd, _read_crowd, "crowd/*"),
    "manifest": Reader(_make_manifest, _read_manifest, "manifest.json"),
    "published": Reader(_make_published, _read_published, "a.*"),
}


def attack(name: str, folder: Path, *, seconds: float = float("inf"), cases: int | None = None, seed: int = 0):
    """Damage and read until the time or the cases are over; yield (number, error or None, damaged file, its bytes).

    An error is what should not have come: anything but a ValueError that names the folder.
    """
    reader, rng, started, number = READERS[name], random.Random(f"{name} {seed}"), time.monotonic(), 0
    reader.make(folder)
    sound = {path: path.read_bytes() for path in sorted(folder.glob(reader.damage)) if path.is_file()}
    while time.monotonic() - started < seconds and (cases is None or number < cases):
        path = rng.choice(list(sound))
        data, error = damaged(sound[path], rng), None
        path.write_bytes(data)
        try:
            reader.read(folder)
        except ValueError as refusal:
            error = None if str(folder) in str(refusal) else refusal
        except Exception as foreign:
            error = foreign
        for aside in folder.glob("*.old*"):
            aside.unlink()
        for place, content in sound.items():
            place.write_bytes(content)
        number += 1
        yield number, error, path, data


def keep(row: dict, path: Path = COUNTS) -> None:
    """Put a reader's counts in the place of its earlier ones; rows stand in the order of `READERS`."""
    rows = {}
    if path.exists():
        with path.open(encoding="utf-8", newline="") as file:
            rows = {earlier["reader"]: earlier for earlier in csv.DictReader(file)}
    rows[row["reader"]] = row
    with whole_file(path, overwrite=True) as part, part.open("w", encoding="utf-8", newline="") as file:
        table = csv.DictWriter(file, list(row), lineterminator="\n")
        table.writeheader()
        table.writerows(rows[name] for name in READERS if name in rows)


def main() -> int:
    """Attack the readers that are named; status 1 if one let something through."""
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("readers", nargs="*", choices=[[], *READERS], help="all by default")
    options.add_argument("--minutes", type=float, default=1.0, help="of each reader")
    options.add_argument("--seed", type=int, default=0)
    options.add_argument("--out", type=Path, default=Path("runs/fuzz"))
    options.add_argument("--keep", action="store_true", help="write the counts to docs/fuzz.csv")
    asked, found = options.parse_args(), 0
    logging.disable(logging.CRITICAL)  # broken tables are set aside with a warning
    warnings.simplefilter("ignore")
    for name in asked.readers or READERS:
        seen: dict[str, int] = {}
        number = 0
        with tempfile.TemporaryDirectory(prefix=f"fuzz-{name}-") as folder:
            cases = attack(name, Path(folder), seconds=60 * asked.minutes, seed=asked.seed)
            for number, error, path, data in cases:
                if error is None:
                    continue
                last = traceback.extract_tb(error.__traceback__)[-1]
                what = f"{type(error).__name__} at {Path(last.filename).name}:{last.lineno}"
                seen[what] = seen.get(what, 0) + 1
                if seen[what] == 1:
                    asked.out.mkdir(parents=True, exist_ok=True)
                    kept = asked.out / f"{name}-{number}{path.suffix}"
                    kept.write_bytes(data)
                    (asked.out / f"{name}-{number}.txt").write_text("".join(traceback.format_exception(error)))
                    print(f"{name}: {what}: {str(error)[:200]!r}, kept as {kept}", flush=True)
        found += len(seen)
        if asked.keep:
            counts = {"files": number, "other_errors": sum(seen.values())}
            keep({"reader": name, **counts, "minutes": f"{asked.minutes:g}", "seed": asked.seed})
        print(f"{name}: {number} files, {len(seen)} kinds of error let through {json.dumps(seen)}", flush=True)
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
