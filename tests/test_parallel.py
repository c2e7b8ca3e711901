"""Data parallel training: two devices end with the weights of one device."""

import os
import re
import subprocess
import sys

import jax
import numpy as np
import pytest
from builders import tiny_config, tiny_task, tiny_windows

from f3amd_lib.training.optimise import all_devices, initial_state, optimise, replicate

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
import jax, numpy as np
from pathlib import Path
import test_parallel as here
from f3amd_lib.training.optimise import all_devices, optimise, restore_state
assert len(jax.devices()) == 2, jax.devices()
mesh, path, task = all_devices(), Path({out!r}) / "state.safetensors", here.task()
how = {{"checkpoint": path, "held_out": here.tiny_windows(), "chunk": 3, "mesh": mesh, "progress": False}}
state, history = optimise(task, **how)
assert int(restore_state(path, task, mesh).step) == here.STEPS
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


@pytest.mark.slow
def test_two_devices_end_with_the_weights_of_one(tmp_path, alone):
    program = PROGRAM.format(tests=os.path.dirname(__file__), out=str(tmp_path))
    flags = {"XLA_FLAGS": "--xla_force_host_platform_device_count=2", "JAX_PLATFORMS": "cpu"}
    done = subprocess.run([sys.executable, "-c", program], env=os.environ | flags, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]
    weights, held_out = alone
    with np.load(tmp_path / "weights.npz") as file:
        found = [file[name] for name in file.files]
    initial = weights_of(initial_state(task()).ema)
    moved = max(float(np.abs(a - b).max()) for a, b in zip(weights, initial, strict=True))
    assert moved > 1e-3, "nothing was learnt, so that nothing is compared"
    for ours, theirs in zip(weights, found, strict=True):
        np.testing.assert_allclose(theirs, ours, atol=1e-4)
    loss = float(re.search(r"held out (\S+)", done.stdout).group(1))
    assert loss == pytest.approx(held_out, abs=1e-4)


def test_what_lies_on_all_devices_is_a_copy_and_may_hold_what_is_no_number():
    mesh = all_devices()
    mine = jax.numpy.array([1.0, np.nan])
    spread = replicate({"a": mine}, mesh)
    jax.jit(lambda tree: jax.tree.map(lambda leaf: leaf + 1, tree), donate_argnums=0)(spread)
    np.testing.assert_array_equal(mine, [1.0, np.nan])  # the caller's own is alive
