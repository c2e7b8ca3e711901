"""Same seed, same machine, same bytes, for all three papers; on another number of threads the same up to rounding.

Each paper's small training, samples and table are made here, in a second process, and in a third of a single core.
"""

from __future__ import annotations

import dataclasses
import hashlib
import os
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
from builders import SKELETON, WINDOW, tiny_task, tiny_trained

from f3amd_lib.diffusion.schedules import straight
from f3amd_lib.ground.records import write_table
from f3amd_lib.measures.distributions import earth_movers_distance, frechet_distance
from f3amd_lib.measures.metrics import first_metrics
from f3amd_lib.motion.root_paths import named_path
from f3amd_lib.rollout.rollout import MotionGenerator
from f3amd_lib.text.networks.acmdm import ACMDMConfig, TextCondition
from f3amd_lib.text.sampling.motionpcm_sampling import sample_student
from f3amd_lib.text.sampling.text_to_motion import sample_text
from f3amd_lib.text.stages.acmdm_training import TextMotionTask
from f3amd_lib.training.checkpoints import network_with
from f3amd_lib.training.optimise import optimise

PARTS = ("windows", "weights", "samples")
STEPS, RATE = 4, 1e-3
BOUND = 1e-4
"""How far one thread may be from many, of the largest number of an array or of 1: the documented tolerance."""

pytestmark = pytest.mark.slow


def f3amd(seed: int):
    """Batch, weights after steps, rollout, and its figures."""
    task = tiny_task(num_steps=STEPS, learning_rate=RATE, seed=seed)
    state, _ = optimise(task, chunk=2, progress=False)
    path = named_path("circle", 4 * WINDOW, seed=seed)
    trained = dataclasses.replace(tiny_trained(), params=state.averaged)
    made = MotionGenerator(trained, 2).rollout(path, "proud", seed=seed)
    figures = first_metrics(made.motion().positions, path, WINDOW, SKELETON)
    return task.draw(state, jax.random.key(seed))[0], state, made.frames, figures


def acmdm(seed: int):
    """The same of captioned clips of swinging joints, sampled with a caption."""
    from test_text_motion import JOINTS, POOLED, RAW, SIZE, recipe

    config = ACMDMConfig(**SIZE, channels=3, window=16)
    task = TextMotionTask(config, recipe(seed=seed), RAW, straight(), POOLED)
    state, _ = optimise(task, chunk=3, progress=False)
    told = TextCondition(POOLED[:6], jnp.ones((6, 16), bool))
    noise = jax.random.normal(jax.random.key(seed), (6, 16, JOINTS, 3))
    made = sample_text(network_with(config, state.averaged), straight(), told, noise, sampler="ddim", num_steps=2)
    return task.draw(state, jax.random.key(seed))[0], state, made, {}


def motionpcm(seed: int):
    """The same of latents, by a student in two jumps."""
    from test_latent_motion import SCHEDULE, distillation

    task = distillation(seed=seed)
    state, _ = optimise(task, chunk=2, progress=False)
    text, noise = (jax.random.normal(jax.random.key(seed), shape) for shape in ((6, 4), (6, 2, 3)))
    student = network_with(task.student_config, state.params["student"])
    made = sample_student(student, SCHEDULE, text, noise, num_steps=2)
    return task.draw(state, jax.random.key(seed))[0], state, made, {}


PAPERS = {"f3amd": f3amd, "acmdm": acmdm, "motionpcm": motionpcm}


def make(folder: Path, seed: int = 0) -> None:
    """Write what each paper's parts come to, as arrays, and a table with its figures."""
    rows = []
    for name, paper in PAPERS.items():
        batch, state, made, figures = paper(seed)
        for part, tree in zip(PARTS, (batch, state, made), strict=True):
            leaves = [np.asarray(leaf) for leaf in jax.tree.leaves(tree) if jnp.issubdtype(leaf.dtype, jnp.number)]
            np.savez(folder / f"{name} {part}.npz", *leaves)
        cloud = np.asarray(made, np.float64).reshape(-1, np.shape(made)[-1])
        reference = np.random.default_rng(0).normal(size=cloud.shape)
        figures |= {"fid": frechet_distance(cloud, reference), "emd": earth_movers_distance(cloud, reference)}
        rows += [{"paper": name, "metric": metric, "value": value} for metric, value in figures.items()]
    write_table(folder / "table.csv", pd.DataFrame(rows), {"dataset": "tiny", "profile": "smoke", "seed": seed})


def hashes(folder: Path) -> dict[str, str]:
    return {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in sorted(folder.iterdir())}


def elsewhere(folder: Path, cores: int | None = None) -> Path:
    """Make all in another process, of so many cores; its programs are compiled anew."""
    folder.mkdir()
    pin = "" if cores is None else f"import os; os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:{cores}]); "
    script = f"{pin}import sys, pathlib; sys.path.insert(0, {str(Path(__file__).parent)!r}); "
    script += f"import test_determinism; test_determinism.make(pathlib.Path({str(folder)!r}))"
    environment = os.environ | {"JAX_ENABLE_COMPILATION_CACHE": "false"}
    subprocess.run([sys.executable, "-c", script], check=True, env=environment)
    return folder


@pytest.fixture(scope="module")
def here(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("here")
    make(folder)
    return folder


def test_another_process_makes_the_same_bytes(here, tmp_path):
    assert hashes(elsewhere(tmp_path / "there")) == hashes(here)
    assert len(hashes(here)) == 3 * len(PARTS) + 2


def test_another_seed_makes_others(here, tmp_path):
    """So that equal bytes say something."""
    make(tmp_path, seed=1)
    same = {name for name, digest in hashes(tmp_path).items() if digest == hashes(here)[name]}
    assert same == set()


def apart(one: Path, other: Path) -> dict[str, float]:
    """How far the numbers of two folders are from each other, in shares of the largest of each array, or of 1.

    Moments of a gradient that is 0 but for rounding are of no size of their own.
    """
    far = {}
    for path in one.glob("*.npz"):
        with np.load(path) as ours, np.load(other / path.name) as theirs:
            shares = [np.abs(theirs[name] - ours[name]).max() / max(np.abs(ours[name]).max(), 1.0) for name in ours]
        far[path.stem] = float(max(shares))
    tables = [pd.read_csv(folder / "table.csv")["value"].to_numpy() for folder in (one, other)]
    return far | {"table": float(np.max(np.abs(tables[1] - tables[0]) / np.maximum(np.abs(tables[0]), 1.0)))}


@pytest.mark.long
@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="this system does not pin a process to a core")
def test_one_core_gives_the_same_up_to_rounding(here, tmp_path):
    far = apart(here, elsewhere(tmp_path / "there", cores=1))
    # A weight whose gradient is 0 but for rounding goes where rounding sends it, by Adam's whole steps.
    adrift = far.pop("f3amd weights")
    assert adrift <= 2 * STEPS * RATE and max(far.values()) <= BOUND, (adrift, far)
    for paper in PAPERS:  # what is drawn is drawn by bits, whatever the threads
        assert far[f"{paper} windows"] == 0.0, far


def test_a_shift_of_the_last_digits_is_noticed(here, tmp_path):
    for path in here.iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    with np.load(here / "f3amd samples.npz") as arrays:
        np.savez(tmp_path / "f3amd samples.npz", *(arrays[name] * np.float32(1 + 4 * BOUND) for name in arrays))
    assert hashes(tmp_path) != hashes(here)
    assert apart(here, tmp_path)["f3amd samples"] > BOUND >= apart(here, tmp_path)["acmdm samples"]
