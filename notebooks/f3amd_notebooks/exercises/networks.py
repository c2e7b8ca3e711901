"""Exercises of notebook 12: what spectral layers and FiLM can express."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
from f3amd_lib.networks.spectral import spectral_convolution
from flax import nnx

from f3amd_notebooks import expressivity
from f3amd_notebooks.exercises.judging import FLOAT32, OTHER_ORDER, agree, numbers, read, reordered, too


def _layer_matrix(weights, num_frames: int):
    """Return the matrix of a spectral layer of one channel by sending it pulses, [T, T]."""
    weights = jnp.asarray(weights)[:, None, None]
    pulses = jnp.eye(num_frames)[:, :, None]
    return spectral_convolution(pulses, weights.real, weights.imag)[:, :, 0].T


def _random_weights(num_modes: int, seed: int = 0) -> np.ndarray:
    real, imag = np.random.default_rng(seed).standard_normal((2, num_modes))
    return real + 1j * imag


@functools.cache
def _random_layer(num_frames: int, num_modes: int):
    """Return random weights and the matrix of a layer that has them."""
    weights = _random_weights(num_modes, seed=num_frames + num_modes)
    return weights, np.asarray(_layer_matrix(weights, num_frames))


def _matrix(answer) -> str | None:
    for num_frames, num_modes in ((8, 5), (8, 2), (9, 5), (32, 4)):
        weights, expected = _random_layer(num_frames, num_modes)
        where = f"with T = {num_frames} and m = {num_modes}"
        found = numbers(answer(weights.copy(), num_frames))
        if found.shape != expected.shape:
            return f"{where} a matrix of shape {expected.shape} is asked for, not {found.shape}"
        if agree(found, expected, **FLOAT32):
            continue
        if agree(found.T, expected, **FLOAT32):
            return f"{where} it is the transpose: what goes in at frame s comes out in column s"
        return f"{where} it is another matrix; what does the layer make of a pulse at frame 0, and of one at frame 1?"
    return None


def _num_unheard(num_frames: int, num_modes: int) -> int:
    """Count the real numbers of a one-channel layer that its output does not depend on."""
    # The layer is linear in them: each one alone, the real parts first.
    units = jnp.eye(2 * num_modes)[:, :, None, None]
    pulses = jnp.eye(num_frames)[:, :, None]
    answers = jax.jit(jax.vmap(lambda unit: spectral_convolution(pulses, unit[:num_modes], unit[num_modes:])))(units)
    return int(np.sum(np.abs(answers).max(axis=(1, 2, 3)) < 1e-5))


def _rank(num_frames: int, num_modes: int) -> int:
    return np.linalg.matrix_rank(_random_layer(num_frames, num_modes)[1], tol=1e-4)


@functools.cache
def _known_ranks() -> tuple[int, ...]:
    return _rank(32, 4), _rank(32, 17), _num_unheard(32, 17), _num_unheard(31, 16)


def _ranks(answer) -> str | None:
    given = read(answer, (4,), "four whole numbers are asked for: two ranks, then two counts")
    if reordered(given, _known_ranks()):
        return f"{OTHER_ORDER}: two ranks, then two counts"
    hints = (
        "how many real numbers describe a sum of a mean and three sine waves?",
        "how many frames can a layer tell apart that cuts nothing?",
        "which modes of a real signal are real, and what does IRFFT do with their imaginary part?",
        "is there a wave that changes its sign in every frame of a window of odd length?",
    )
    for place, (number, known, hint) in enumerate(zip(given, _known_ranks(), hints, strict=True), start=1):
        if number != known:
            return f"number {place} is {too(number, known)}; {hint}"
    return None


def _beside_a_line(answer) -> str | None:
    rng = np.random.default_rng(0)
    walk = np.linspace(0.0, 1.3, 32)
    cases = (("a straight walk", walk, 1), ("a walk that sways", 0.4 + walk + 0.1 * np.sin(9 * walk), 3))
    cases += (("noise", rng.standard_normal(31), 5),)
    for what, x, modes in cases:
        expected = expressivity.keep_modes(x[:, None], modes, "fourier beside a line")[:, 0]
        found = numbers(answer(x.copy(), modes))
        if found.shape != x.shape:
            return f"a signal of {len(x)} frames is asked for, not shape {found.shape}"
        if agree(found, expected, **FLOAT32):
            continue
        where = f"for {what} with m = {modes}"
        if agree(found, expressivity.keep_modes(x[:, None], modes)[:, 0], **FLOAT32):
            return f"{where} these are the modes of the signal itself: take the line away first"
        if agree(found + np.linspace(x[0], x[-1], len(x)), expected, **FLOAT32):
            return f"{where} the line was taken away and not given back"
        return (
            f"{where} something else comes out; take the line away that runs from the first frame to the last, "
            "keep m modes of the rest, mode 0 among them, and give the line back"
        )
    return None


def _shared_kernels(answer) -> str | None:
    rng = np.random.default_rng(0)
    mixtures = rng.standard_normal((12, 3)) @ rng.standard_normal((3, 16))
    families = (
        ("8 delays", np.eye(8, 32), 0.1),
        ("8 delays", np.eye(8, 32), 0.3),
        ("12 mixtures of 3 kernels", mixtures, 1e-6),
        ("random filters", rng.standard_normal((10, 16)), 0.2),
    )
    for what, filters, allowed in families:
        expected = next(
            count for count in range(len(filters) + 1) if expressivity.film_share(filters, count) <= allowed
        )
        count = read(answer(filters.copy(), allowed), (), "your function is to return one whole number")
        if count != expected:
            return (
                f"{what}, {allowed:g} allowed: your number is {too(count, expected)}; how much of a matrix's energy, "
                "the sum of its squares, is left beside the best one of rank D?"
            )
    return None


def _delay_line(signal, num_blocks: int):
    """Return what a delay line makes of a signal [2^N], as a function of its condition [N]."""
    blocks = expressivity.film_delay_line(num_blocks, len(signal))

    def run(bits):
        c = jnp.tile(bits, (1, len(signal), 1))
        z = nnx.silu(jnp.asarray(np.stack([signal, -signal], axis=-1)[None], jnp.float32))
        for base, film in blocks:
            z = film(base, z, c)
        return z[0, :, 0] - z[0, :, 1]

    return run


def _advance(answer) -> str | None:
    for num_blocks, leads in ((2, (1, 2, 3)), (3, (0, 3))):
        num_frames = 2**num_blocks
        signal = np.random.default_rng(num_blocks).standard_normal(num_frames)
        run = jax.jit(_delay_line(signal, num_blocks))
        for lead in leads:
            bits = numbers(answer(lead, num_blocks))
            if bits.shape != (num_blocks,) or not np.all(np.abs(bits) == 1.0):
                return f"give {num_blocks} numbers, each -1 or 1, for {num_blocks} blocks"
            ended = np.asarray(run(jnp.asarray(bits, jnp.float32)))
            if not agree(ended, np.roll(signal, -lead), **FLOAT32):
                delay = next(frames for frames in range(num_frames) if agree(ended, np.roll(signal, frames), atol=1e-3))
                return (
                    f"{num_blocks} blocks, {lead} frames ahead: the signal comes {delay} frames late; on a "
                    "circle, which delay is the same as going ahead?"
                )
    return None


CHECKS = {"12.a": _matrix, "12.b": _ranks, "12.c": _beside_a_line, "12.d": _shared_kernels, "12.e": _advance}
"""By number, a function of the answer that returns None if it is right, else a hint."""
