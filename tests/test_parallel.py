"""Data parallel training: two devices, or two processes, end with the weights of one device."""

import os
import re
import socket
import subprocess
import sys
import textwrap
from pathlib import Path

import jax
import numpy as np
import pytest
from builders import refused, tiny_config, tiny_task, tiny_windows

from f3amd_lib.training import parallel
from f3amd_lib.training.optimise import initial_state, optimise

STEPS = 6
# Every remedy that draws random numbers or runs the network a second time.
SETTINGS = {
    "num_steps": STEPS, "batch_size": 8, "learning_rate": 1e-3, "ema_decay": 0.5, "noise": "mixed",
    "noise_weighting": "low_noise", "own_history_share": 0.75, "history_damping": 0.5,
    "history_noise": 0.02, "condition_dropout": 0.25,
}  # fmt: skip

PROGRAM = """
import sys
sys.path.insert(0, {tests!r})
number = int(sys.argv[1])
from f3amd_lib.training import parallel
if number >= 0:
    parallel.join_processes("localhost:" + sys.argv[2], 2, number)
import jax, numpy as np
assert len(jax.devices()) == 2, jax.devices()
import test_parallel as here
from f3amd_lib.training.optimise import optimise, restore_state
mesh = parallel.all_devices()
path, task = here.Path({out!r}) / "state.safetensors", here.task()
state, history = optimise(
    task, checkpoint=path, held_out=here.tiny_windows(), chunk=3, mesh=mesh, progress=False
)
parallel.wait_for_all("trained")
again = restore_state(path, task, mesh)
assert int(again.step) == here.STEPS
# The first process decides, and a difference is seen by both.
if number >= 0:
    assert parallel.first_says(number == 0) and not parallel.first_says(number == 1)
    assert parallel.same_everywhere(5) and not parallel.same_everywhere(number)
if parallel.is_first_process():
    np.savez({out!r} + "/weights.npz", *here.weights_of(state.ema))
    print("held out", history[-1]["held_out_loss"])
"""


def weights_of(tree) -> list[np.ndarray]:
    """All weights but the biases of attention keys.

    Softmax does not see what all scores share, so that their gradient is 0 but for rounding, and
    Adam makes steps of full length out of rounding.
    """
    named = jax.tree_util.tree_leaves_with_path(tree)
    kept = [leaf for path, leaf in named if "'key'" not in (name := str(path)) or "bias" not in name]
    assert len(kept) == len(named) - 1
    return [np.asarray(leaf) for leaf in kept]


def task():
    """The same small run wherever it takes place."""
    return tiny_task(tiny_config(), **SETTINGS)


@pytest.fixture(scope="module")
def alone():
    """Weights and held-out loss of one device."""
    state, history = optimise(task(), held_out=tiny_windows(), chunk=3, progress=False)
    return weights_of(state.ema), history[-1]["held_out_loss"]


def start(out: Path, number: int, port: int = 0, devices: int = 2) -> subprocess.Popen:
    program = textwrap.dedent(PROGRAM).format(tests=os.path.dirname(__file__), out=str(out))
    flags = f"--xla_force_host_platform_device_count={devices}"
    return subprocess.Popen(
        [sys.executable, "-c", program, str(number), str(port)],
        env=os.environ | {"XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu"},
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip


def assert_same(out: Path, printed: str, alone) -> None:
    weights, held_out = alone
    with np.load(out / "weights.npz") as file:
        found = [file[name] for name in file.files]
    initial = weights_of(initial_state(task()).ema)
    moved = max(float(np.abs(a - b).max()) for a, b in zip(weights, initial, strict=True))
    assert moved > 1e-3, "nothing was learnt, so that nothing is compared"
    assert len(found) == len(weights)
    for ours, theirs in zip(weights, found, strict=True):
        np.testing.assert_allclose(theirs, ours, atol=1e-4)
    loss = float(re.search(r"held out (\S+)", printed).group(1))
    assert loss == pytest.approx(held_out, abs=1e-4)


@pytest.mark.slow
def test_two_devices_end_with_the_weights_of_one(tmp_path, alone):
    process = start(tmp_path, -1)
    printed, errors = process.communicate(timeout=300)
    assert process.returncode == 0, errors[-2000:]
    assert_same(tmp_path, printed, alone)


@pytest.mark.slow
def test_two_processes_end_with_the_weights_of_one(tmp_path, alone):
    with socket.socket() as free:
        free.bind(("localhost", 0))
        port = free.getsockname()[1]
    pair = [start(tmp_path, number, port, devices=1) for number in (0, 1)]
    done = [process.communicate(timeout=300) for process in pair]
    for process, (_, errors) in zip(pair, done, strict=True):
        assert process.returncode == 0, errors[-2000:]
    assert_same(tmp_path, done[0][0], alone)
    assert "held out" not in done[1][0]


@pytest.mark.slow
def test_a_mesh_of_one_device_changes_no_number(alone):
    mesh = jax.sharding.Mesh(np.array(jax.devices()[:1]), (parallel.AXIS,))
    state, _ = optimise(task(), chunk=3, mesh=mesh, progress=False)
    for ours, theirs in zip(alone[0], weights_of(state.ema), strict=True):
        np.testing.assert_allclose(theirs, ours, atol=1e-6)


def test_what_lies_on_all_devices_is_a_copy_and_may_hold_what_is_no_number():
    mesh = jax.sharding.Mesh(np.array(jax.devices()[:1]), (parallel.AXIS,))
    mine = jax.numpy.array([1.0, np.nan])
    spread = parallel.replicate({"a": mine}, mesh)
    jax.jit(lambda tree: jax.tree.map(lambda leaf: leaf + 1, tree), donate_argnums=0)(spread)
    np.testing.assert_array_equal(mine, [1.0, np.nan])  # the caller's own is alive


def test_a_batch_that_devices_cannot_share_is_refused():
    class Two:
        size = 2

    parallel.check_batch(8, Two())
    parallel.check_batch(7, None)
    refused("batch of 7 .* equally by 2 devices: take 6", parallel.check_batch, 7, Two())


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (("localhost:1", 2, None), "come together or not at all"),
        ((None, 2, 0), "come together or not at all"),
        (("localhost:1", 2, 2), "process 2 of 2: numbers run from 0 to 1"),
    ],
)
def test_half_told_processes_are_refused(given, message):
    refused(message, parallel.join_processes, *given)


def test_alone_there_is_nobody_to_agree_with():
    assert parallel.first_says(True) and not parallel.first_says(False)
    assert parallel.same_everywhere(3)


def test_processes_that_cannot_join_are_a_clear_error(monkeypatch):
    def late(*arguments):
        raise RuntimeError("deadline exceeded")

    monkeypatch.setattr(jax.distributed, "initialize", late)
    refused("could not join the others at host:1 .deadline exceeded", parallel.join_processes, "host:1", 2, 1)
