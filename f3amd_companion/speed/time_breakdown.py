"""Where does a round's time go? The round is timed again with one part left out at a time.

Compilers mix parts, so that a stopwatch around each would disturb what it measures. What a round
saves without a part is what the part costs, as far as costs add up.
"""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
from flax import nnx

from f3amd_companion.speed.implementations import Workload, jit_round
from f3amd_companion.speed.machine import device_name
from f3amd_companion.speed.timing import take_turns
from f3amd_lib.ground.names import check_known
from f3amd_lib.networks import presets
from f3amd_lib.networks.conditioning import Context
from f3amd_lib.networks.f3amd import F3AMD
from f3amd_lib.networks.spectral import FNOBlock, FrameLayer
from f3amd_lib.rollout.rounds import sample_round

PARTS = ("spectral branches", "local branches", "FiLM", "conditioning signal", "noise")
"""What can be left out of a round of an F3AMD network with Fourier blocks and FiLM."""


class _OneBranch(FrameLayer):
    """An `FNOBlock` that has lost one of its branches."""

    def __init__(self, block: FNOBlock, lost: str):
        self.spectral, self.lost = block.spectral, lost
        self.local_first, self.local_second = block.local_first, block.local_second

    def frames_first(self, z):
        if self.lost == "local branches":
            return self.spectral.frames_first(z)
        return FNOBlock.local_frames_first(self, z)


class _NoFiLM(nnx.Module):
    def __call__(self, base, z, c):
        return base(z)


class _NoSignal(nnx.Module):
    """Gives the code of frames for c, and encodes a condition to nothing."""

    def __init__(self, encoder):
        self.window, self.width = encoder.window, encoder.width

    def encode(self, condition):
        return Context(condition.path, condition.path)

    def __call__(self, context, sigma):
        return jnp.ones((context.keys.shape[0], self.window, self.width), context.keys.dtype) * sigma


def without(network: F3AMD, part: str) -> F3AMD:
    """Return a copy of a network that lacks a part; its answers mean nothing.

    Args:
      network: of Fourier blocks with FiLM.
      part: of `PARTS`, but "noise", which is no part of a network.

    Raises:
      ValueError: for another network or part.
    """
    config = network.config
    if not isinstance(network, F3AMD) or config.base_block != "fno" or config.conditioning != "film":
        raise ValueError("parts are known of F3AMD networks of Fourier blocks with FiLM only")
    check_known(part, PARTS[:-1], "part")
    left = nnx.clone(network)
    if part == "FiLM":
        left.conditionings = nnx.List([_NoFiLM() for _ in left.conditionings])
    elif part == "conditioning signal":
        left.condition = _NoSignal(left.condition)
    else:
        left.blocks = nnx.List([_OneBranch(block, part) for block in left.blocks])
        if config.encoder_decoder == "fno":
            left.encoder = _OneBranch(left.encoder, part)
            left.decoder = _OneBranch(left.decoder, part)
    return left


def time_breakdown(workload: Workload, *, progress: bool = False, **turns) -> pd.DataFrame:
    """Time a round whole and without each of its parts, by turns.

    Args:
      workload: a model of Fourier blocks with FiLM, under jit on one device.
      progress: show a bar.
      **turns: settings of `take_turns`.

    Returns:
      A row each: model, steps, characters, device, without ("nothing" for the whole round), unit,
      value, low and high in ms, rounds, and saved: the share of the whole round's time.
    """
    network = presets.build_from_config(workload.config, jax.random.key(0))
    shape = workload.characters, workload.config.window, workload.config.channels
    given_noise = partial(sample_round, noise=jax.random.normal(jax.random.key(1), shape))
    ready = {"nothing": jit_round(workload, network)}
    ready |= {part: jit_round(workload, without(network, part)) for part in PARTS[:-1]}
    ready["noise"] = jit_round(workload, network, given_noise)
    calls = {part: done.call for part, done in ready.items()}
    timings = take_turns(calls, progress=progress, **turns)
    whole = timings["nothing"].median
    rows = [
        {
            "model": workload.model,
            "steps": workload.steps,
            "characters": workload.characters,
            "device": device_name(),
            "without": part,
            **timing.columns("ms", 1e3),
            "rounds": timing.rounds,
            "saved": np.nan if part == "nothing" else 1.0 - timing.median / whole,
        }
        for part, timing in timings.items()
    ]
    return pd.DataFrame(rows)
