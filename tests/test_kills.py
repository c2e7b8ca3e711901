"""Commands that are killed, find no room, may not write, or run twice: nothing whole is lost, and the next call works.

Each phase is its command with small networks and few clips, in a process of its own. The sweep's are in
`test_sweep.py`, those of a crowd in `test_crowd.py`.
"""

from __future__ import annotations

import ctypes
import dataclasses
import io
import json
import multiprocessing
import os
import resource
import signal
import sys
import traceback
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import jax.numpy as jnp
import pandas as pd
import pytest
import tqdm
from builders import HISTORY, WINDOW, captioned_walks, tiny_packed, tiny_trained
from safetensors.numpy import load_file
from test_text_judge import OneVectorAWord
from test_text_models import STYLES, TINY

from f3amd_companion import __main__ as command_line
from f3amd_companion.measuring import campaign, measure
from f3amd_companion.measuring.campaign import Run
from f3amd_lib.data import sources
from f3amd_lib.data.packed import packed_dataset
from f3amd_lib.ground import profiles
from f3amd_lib.ground.profiles import load_profile
from f3amd_lib.measures.protocol import Protocol
from f3amd_lib.motion.bvh import write_bvh
from f3amd_lib.motion.synthetic import synthesize
from f3amd_lib.networks import presets
from f3amd_lib.text.data import text_encoders
from f3amd_lib.text.stages import text_models
from f3amd_lib.training.pipeline import PreparedData

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not sys.platform.startswith("linux"), reason="kills, limits and rights as Linux has them"),
]

MODEL = "F3AMD-FNO-32"
SMOKE = ["--profile", "smoke"]

# ------------------------------------------------------------------------------------ phases, in a process of their own


def data(folder: Path) -> list[str]:
    """Pack a data set: the cache."""
    opened = sources.open_dataset
    sources.open_dataset = lambda name, **settings: opened(name, seconds_per_style=13.0, num_styles=1)
    packed = lambda name: packed_dataset(sources.open_dataset(name), progress=False)
    command_line.Data.open = lambda self: (SimpleNamespace(packed=packed(self.data)), None)
    return ["data"]


def dataset(folder: Path) -> list[str]:
    """Write captioned motions in HumanML3D's layout."""
    place = folder.with_name(f"{folder.name} source")
    place.mkdir(exist_ok=True)
    for seed in range(3):
        write_bvh(place / f"walk{seed}.bvh", synthesize("Neutral", 4.0, seed), overwrite=True)
    captions = place / "captions.csv"
    captions.write_text("file,caption\n" + "".join(f"walk{seed},a person walks\n" for seed in range(3)))
    return ["dataset", "--captions", str(captions), "--source", str(place), "--out", str(folder / "set")]


def _small_networks() -> None:
    """Narrow networks, few clips."""
    build, prepared = presets.build_config, PreparedData(tiny_packed(), WINDOW, HISTORY)
    presets.build_config = lambda *a, **k: build(*a, **{**k, "depth": 1, "latent_width": 8})
    profiles.load_profile = lambda *a, **k: dataclasses.replace(load_profile(*a, **k), window=WINDOW)

    def opened(self, **values):
        given = {name: value for name, value in values.items() if value is not None}
        return prepared, profiles.load_profile(self.profile, self.data, **given)

    command_line.Data.open = opened


def train(folder: Path) -> list[str]:
    """Train a model of locomotion."""
    _small_networks()
    return ["train", "--preset", MODEL, "--steps", "6", "--batch-size", "4", *SMOKE, "--out", str(folder)]


def train_text(folder: Path) -> list[str]:
    """Train a model of text to motion."""
    walks = captioned_walks(STYLES, ("test", "validation", "train"), num_frames=64)
    presets.PRESETS["ACMDM-tiny"] = dataclasses.replace(TINY["tiny"], name="ACMDM-tiny")
    text_models.open_text_motions = lambda *a: walks
    text_encoders.load_text_encoder = lambda *_: OneVectorAWord()
    words = ["train", "--preset", "ACMDM-tiny", "--steps", "6", "--batch-size", "2", "--data", "bandai"]
    return [*words, *SMOKE, "--out", str(folder)]


def measure_walking(folder: Path) -> list[str]:
    """Measure a model."""
    _small_networks()
    measure.available_models = lambda profile: [MODEL]
    measure.obtain_model = lambda *a, **k: (tiny_trained(), None, "shipped")
    return ["measure", "walking", *SMOKE]


def run_campaign(folder: Path) -> list[str]:
    """Train and measure two snapshots of the queue."""
    _small_networks()

    def figures(generator, *arguments):
        value = sum(float(jnp.abs(leaf).sum()) for leaf in generator.trained.params.flat_state().leaves)
        rows = [{"steps": generator.num_steps, "metric": "weights", "unit": "m", "value": value / 3}]
        return pd.DataFrame(rows), None

    judges = SimpleNamespace(params={"a": jnp.ones(1)}), Protocol(("calm", "proud")), None
    campaign.measure_model, measure.protocol_of = figures, lambda *a: judges
    run = Run(MODEL, window=WINDOW)
    campaign.queue = lambda *a: [(run, 8), (run, 16)]
    return ["campaign", *SMOKE, "--batch-size", "4", "--out", str(folder / "runs")]


PHASES = {phase.__name__: phase for phase in (data, dataset, train, train_text, measure_walking, run_campaign)}

# ------------------------------------------------------------------------------------ what goes wrong


def count(folder: Path, at: int, then: Callable[[], None]) -> None:
    """Do something before the file with this number is put in its place, its content written."""
    replace, put = os.replace, []

    def counted(source, target):
        put.extend([target] * Path(target).is_relative_to(folder))
        if len(put) == at:
            then()
        replace(source, target)

    os.replace = counted


def kill(folder: Path, at: int) -> None:
    count(folder, at, lambda: os.kill(os.getpid(), signal.SIGKILL))


def full_disk(folder: Path, at: int) -> None:
    """No file can have more bytes."""
    resource.setrlimit(resource.RLIMIT_FSIZE, (at, at))


def read_only(folder: Path, at: int) -> None:
    """The folder takes nothing, from the superuser either."""
    folder.chmod(0o555)
    libc, header = ctypes.CDLL(None, use_errno=True), (ctypes.c_uint32 * 2)(0x20080522, 0)
    rights = (ctypes.c_uint32 * 6)()
    assert libc.capget(header, rights) == 0
    rights[0] &= ~0b110  # CAP_DAC_OVERRIDE, CAP_DAC_READ_SEARCH
    assert libc.capset(header, rights) == 0


def command(phase: str, folder: Path, fault: str | None, at: int, answer) -> None:
    """Run a command that goes wrong; send its exit status and what it told the user."""
    sys.stdout, sys.stderr = io.StringIO(), io.StringIO()
    command_line.terminal.set_environment()  # a full disk leaves programs cut short, which are compiled anew
    tqdm.tqdm.status_printer = staticmethod(lambda file: lambda bar: None)
    os.environ |= {"F3AMD_RESULTS_DIR": str(folder / "results"), "F3AMD_CACHE_DIR": str(folder / "cache")}
    try:
        words = PHASES[phase](folder)
        if fault:
            globals()[fault](folder, at)
        answer.send((command_line.main(words), sys.stderr.getvalue().strip()))
    except BaseException:  # what no command may end with
        answer.send((1, traceback.format_exc()))


@pytest.fixture(scope="module")
def start(tmp_path_factory):
    """Start a command; for all of them modules are imported once, and programs compiled once."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([__name__])

    def start(phase: str, folder: Path, fault: str | None = None, at: int = 0):
        folder.mkdir(exist_ok=True)
        ours, theirs = context.Pipe(duplex=False)
        process = context.Process(target=command, args=(phase, folder, fault, at, theirs))
        process.start()
        theirs.close()
        return process, ours

    with pytest.MonkeyPatch.context() as patch:
        folders = Path(__file__).parent, Path(command_line.__file__).parents[1]
        patch.setenv("PYTHONPATH", os.pathsep.join(map(str, folders)))
        patch.setenv("JAX_COMPILATION_CACHE_DIR", str(tmp_path_factory.mktemp("programs")))
        patch.setenv("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
        yield start


def ended(started) -> tuple[int | None, str]:
    """Exit status and message of a command; None of one that was killed."""
    process, answer = started
    try:
        status = answer.recv()
    except EOFError:
        status = None, ""
    process.join()
    assert process.exitcode == (-signal.SIGKILL if status[0] is None else 0)
    return status


def left(folder: Path) -> dict[str, object]:
    """What lies in a folder, but for dates, commits, and what is unfinished or set aside."""
    found = {}
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder).as_posix()
        if not path.is_file() or ".part" in name or path.suffix == ".lock" or ".old" in name:
            continue
        if path.suffix == ".json":
            circumstances, record = ("date_utc", "git_commit", "git_dirty"), json.loads(path.read_text())
            found[name] = {key: value for key, value in record.items() if key not in circumstances}
        elif path.suffix == ".safetensors":
            found[name] = {key: array.tobytes() for key, array in load_file(path).items()}
        else:
            found[name] = path.read_bytes()
    return found


@pytest.fixture(scope="module")
def whole(start, tmp_path_factory):
    """What a phase leaves that nothing disturbs."""
    known = {}

    def whole(phase: str) -> dict:
        if phase not in known:
            folder = tmp_path_factory.mktemp("whole")
            assert ended(start(phase, folder)) == (0, "")
            known[phase] = left(folder)
            assert known[phase]
        return known[phase]

    return whole


@pytest.mark.parametrize("phase", PHASES)
def test_killed_at_each_file_it_ends_as_if_it_had_not_been(phase, start, whole, tmp_path):
    """Killed before its first file, then before its second, and so on, until no file is left to be killed at."""
    expected, kills = whole(phase), 0
    while (told := ended(start(phase, tmp_path / "run", "kill", kills + 1)))[0] is None:
        kills += 1
        assert kills < 20
    assert told == (0, "") and kills > 0
    assert left(tmp_path / "run") == expected


@pytest.mark.long
@pytest.mark.parametrize("fault", ["full_disk", "read_only"])
@pytest.mark.parametrize("phase", PHASES)
def test_without_room_or_right_it_says_so_in_one_line_and_the_next_call_works(phase, fault, start, whole, tmp_path):
    folder = tmp_path / "run"
    status, told = ended(start(phase, folder, fault, 100))
    folder.chmod(0o755)
    assert status == 2 and len(told.strip().splitlines()) == 1, told
    assert told.startswith(f"f3amd {phase.split('_')[-1 if phase == 'run_campaign' else 0]}: ") and str(folder) in told
    assert ended(start(phase, folder)) == (0, "")
    assert left(folder) == whole(phase)
