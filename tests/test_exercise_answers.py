"""Answers to the exercises: right ones in several forms, and wrong ones that one can easily come to.

For every exercise at least three right forms pass, and at least five wrong answers get a hint that
says what is wrong.
"""

import re

import course_answers_first
import course_answers_second
import course_answers_third
import jax.numpy as jnp
import numpy as np
import pytest
from f3amd_notebooks import bimodal_paths
from f3amd_notebooks.exercises import CHECKS, hint
from f3amd_notebooks.exercises.printed_update import _distance_of_updates

from f3amd_lib.diffusion import samplers
from f3amd_lib.diffusion.oracles import GaussianMixture
from f3amd_lib.diffusion.schedules import variance_exploding

GRID = variance_exploding().grid
RIGHT = {}
"""By number: the answer in different forms."""
WRONG = {}
"""By number: pairs of a wrong answer and a piece of the hint that it is to get."""


def shares(levels, factors):
    """The product of 1 / sqrt(1 + sigma^2) over a slice of the levels."""
    return np.prod(1 / np.hypot(1, np.asarray(levels)[factors]))


# Notebook 02 ------------------------------------------------------------------------------------

RIGHT["2.a"] = [0.02 / 128, np.float32(0.000156), jnp.asarray([0.02 / 128]), 0.02 / (0.02 + 128**2) * 128, "0.000156"]
WRONG["2.a"] = [
    (0.14, "too large"),  # the data's own
    (0.01, "too large"),
    (0.1**2 / 128, "too small"),  # of one mode alone
    (0.02, "too large"),  # the variance
    (0.02 / 128**2, "too small"),  # sigma once too often
    (0.2**2 / 128, "too large"),  # modes taken for 0.2 from the middle
    ([0.000156, 0.000156], "one number"),
]

RIGHT["2.b"] = [
    samplers.ddim_step,
    lambda x, x0_hat, s, s_next: x + (s_next - s) * (x - x0_hat) / s,
    lambda x, x0_hat, s, s_next: (s_next / s) * x + (1 - s_next / s) * x0_hat,
    lambda x, x0_hat, s, s_next: jnp.asarray(x0_hat) + s_next * (jnp.asarray(x) - x0_hat) / s,
]
WRONG["2.b"] = [
    (samplers.ddim_step_literal, "as it is printed"),
    (lambda x, x0_hat, s, s_next: x0_hat + s_next * (x - x0_hat), "not yet the noise"),
    (lambda *given: samplers.ddpm_step(*given, 0.0), r"share \(sigma' / sigma\)\^2"),
    (lambda x, x0_hat, s, s_next: x0_hat + s_next * x / s, "sigma = 2 to 0.5"),  # forgot to take the estimate away
    (lambda x, x0_hat, s, s_next: x0_hat + (s / s_next if s_next else 0) * (x - x0_hat), "sigma = 2 to 0.5"),
    (lambda x, x0_hat, s, s_next: x0_hat, "sigma = 2 to 0.5"),  # all the way at once
    (lambda x, x0_hat, s, s_next: x * s_next / s, "sigma = 2 to 0.5"),
    (lambda x, x0_hat, s, s_next: x, "the state that was given"),
]

RIGHT["2.c"] = [10, 8.0, jnp.asarray(12), np.asarray([20])]
WRONG["2.c"] = [
    (2, "at rho = 3 it is 0.309, and 0.232 is wanted"),
    (1, "wanted"),
    (3, "the error is 0.309"),
    (5, "wanted"),
    (0, "positive"),
    (-10, "positive"),
    (float("inf"), "one number"),
]

RIGHT["2.d"] = [(2253, 114), [2252.8, 114.5], np.asarray([2250, 115]), jnp.asarray([2253, 114])]
WRONG["2.d"] = [
    ([2048, 114], "Euler has an error of 0.0011 after 2048 steps, which is too large"),
    ([2253, 58], "Heun .* too large"),
    ([2253, 2253], "Heun .* too small"),  # the same for both
    ([512 * 4.4**2, 256 / 5], "Euler .* too small"),  # the orders the other way round
    ([114, 2253], "Euler .* too large"),
    ([2253, 227], "Heun .* too small"),  # evaluations, not steps
    (2253, "two numbers"),
    ([2253, 0], "from 1 to 20000"),
]

_EARLY, _LATE = (0.0625, 0.4841, 0.25), (0.9025, 0.5933, 3.61)
RIGHT["2.e"] = [[_EARLY, _LATE], np.array([_EARLY, _LATE]), jnp.array([_EARLY, _LATE])]
WRONG["2.e"] = [
    ([(0.25, 0.4841, 0.4843), _LATE], "to 0.5 a is too large"),  # r for r^2
    ([(0.0625, 0.9682, 0.9531), _LATE], "to 0.5 b is too large"),  # forgot sigma'
    ([(0.0625, 0.4841, 0.5), _LATE], "to 0.5 the sum of variances is too large"),  # its root
    ([_EARLY, _EARLY], "to 1.9 a is too small"),
    ([_EARLY, (0.95, 0.5933, 3.61)], "to 1.9 a is too large"),
    ([_EARLY, (0.9025, 0.0, 3.61)], "to 1.9 b is too small"),  # DDIM's
    (_EARLY, "two rows"),
]

RIGHT["2.f"] = [
    lambda denoise: lambda z, ab: denoise(z / np.sqrt(ab), np.sqrt((1 - ab) / ab)),
    lambda denoise: lambda z, ab: denoise(z * np.sqrt(1 + (1 - ab) / ab), np.sqrt(1 / ab - 1)),
    lambda denoise: lambda z, ab: denoise(jnp.asarray(z) / jnp.sqrt(ab), jnp.sqrt((1 - ab) / ab)),
]
WRONG["2.f"] = [
    (lambda denoise: lambda z, ab: denoise(z, np.sqrt((1 - ab) / ab)), "shown z as it is"),
    (lambda denoise: lambda z, ab: denoise(z / np.sqrt(ab), np.sqrt(1 - ab)), "the level is not"),
    (lambda denoise: lambda z, ab: denoise(z / np.sqrt(ab), (1 - ab) / ab), "the level is not"),
    (lambda denoise: lambda z, ab: denoise(z * np.sqrt(ab), np.sqrt((1 - ab) / ab)), "which x belongs"),
    (lambda denoise: lambda z, ab: denoise(z / ab, np.sqrt((1 - ab) / ab)), "which x belongs"),
    (lambda denoise: lambda z, ab: denoise(z, ab), "which x belongs"),
    (lambda denoise: lambda z, ab: np.sqrt(ab) * denoise(z / np.sqrt(ab), np.sqrt((1 - ab) / ab)), "another one"),
]


def _on_z(root, ab, ab_next):
    return root * (1 - ab_next) / (1 - ab), np.sqrt((1 - ab_next) / (1 - ab))


RIGHT["2.g"] = [
    _on_z,
    lambda root, ab, ab_next: np.array([root * (1 - ab_next) / (1 - ab_next * root**2), _on_z(root, ab, ab_next)[1]]),
    lambda root, ab, ab_next: [root * (1 - ab_next) / (1 - ab), (1 - ab) ** -0.5 * (1 - ab_next) ** 0.5],
    lambda *given: jnp.stack([jnp.asarray(number) for number in _on_z(*given)]),
]
WRONG["2.g"] = [
    (lambda *given: _on_z(*given)[::-1], "the other way round"),
    (lambda root, ab, ab_next: _on_z(root**2, ab, ab_next), "DDPM's coefficient is too small"),
    (lambda root, ab, ab_next: _on_z(ab / ab_next, ab, ab_next), "DDPM's coefficient is too small"),
    (
        lambda root, ab, ab_next: (_on_z(root, ab, ab_next)[0], root * _on_z(root, ab, ab_next)[1]),
        "DDIM's .* too small",
    ),
    (lambda root, ab, ab_next: (_on_z(root, ab, ab_next)[0], np.sqrt(1 - ab_next)), "DDIM's .* too small"),
    # The values agree, but alpha_t stands where it does not belong, or is not seen where it does.
    (
        lambda root, ab, ab_next: (_on_z(root, ab, ab_next)[0], np.sqrt((1 - ab_next) / (1 - ab_next * root**2))),
        "no place in DDIM",
    ),
    (lambda root, ab, ab_next: _on_z(np.sqrt(ab / ab_next), ab, ab_next), "write DDPM's coefficient with alpha_t"),
    (lambda root, ab, ab_next: _on_z(root, ab, ab_next)[0], "two numbers"),
]

# Notebook 10 ------------------------------------------------------------------------------------


def _mended(x, x0_hat, s, s_next, xp=np):
    printed = x0_hat / xp.sqrt(1 + s_next**2) + s_next / xp.sqrt(1 + s_next**2) * (x - x0_hat) / s
    return printed * xp.sqrt(1 + s_next**2)


RIGHT["10.a"] = [
    _mended,
    samplers.ddim_step,
    lambda x, x0_hat, s, s_next: _mended(jnp.asarray(x), jnp.asarray(x0_hat), s, s_next, jnp),
    lambda *given: samplers.ddim_step_literal(*given) / np.sqrt(1 / (1 + given[3] ** 2)),
]
WRONG["10.a"] = [
    (samplers.ddim_step_literal, "printed line itself"),
    (lambda *given: samplers.ddim_step_literal(*given) / np.hypot(1, given[3]), "wrong way"),
    (lambda *given: samplers.ddim_step_literal(*given) * np.hypot(1, given[2]), "level left behind"),
    (lambda *given: samplers.ddim_step_literal(*given) * (1 + given[3] ** 2), "not DDIM's step"),
    (lambda *given: samplers.ddim_step_literal(*given) * given[3], "not DDIM's step"),
    (lambda x, x0_hat, s, s_next: _mended(x, np.hypot(1, s_next) * x0_hat, s, s_next), "not DDIM's step"),
    (lambda *given: 0.0 * given[0], "not DDIM's step"),
]

_LEVELS = (GRID(2), GRID(4), GRID(16), np.array([128.0, 3.0, 1.0, 0.0]))


def _share_list(factors):
    return [shares(levels, factors) for levels in _LEVELS]


RIGHT["10.b"] = [
    _share_list(slice(1, -1)),
    _share_list(slice(1, None)),  # the factor of sigma = 0 is 1
    jnp.asarray(_share_list(slice(1, -1))),
    (1.0, 4.03e-3, 1.59e-16, 0.224),
]
WRONG["10.b"] = [
    (_share_list(slice(0, -1)), "at 2 steps the share is too small"),  # the first level counted
    (_share_list(slice(1, -2)), "on|at the levels 128, 3, 1 the share is too large"),  # the last one forgotten
    (_share_list(slice(2, -1)), "at 4 steps the share is too large"),
    ([shares(GRID(n + 1), slice(1, -1)) for n in (2, 4, 16)] + [0.2236], "at 2 steps"),  # one step too many
    ([1.0, 4.03e-3, 0.0, 0.2236], "at 16 steps the share is too small"),
    ([1.0, 4.03e-3, 1.59e-16, 1 / 3], "at the levels"),  # 1 / sigma
    ([1.0, 4.03e-3, 1.59e-16], "four numbers"),
    (4.03e-3, "four numbers"),
]

RIGHT["10.c"] = [0.2, 0.198, np.float32(0.205), jnp.asarray([0.2])]
WRONG["10.c"] = [
    (0.22, "too large"),
    (0.18, "too small"),
    (0.5, f"updates end {_distance_of_updates(0.5):.3f} apart"),
    (0.05, "too small"),  # the distance itself
    (0.8, "too large"),  # the mean of the data
    (-0.2, "positive"),
    ([0.1, 0.2], "one number"),
]


def _ends(sampler, *, width=1.0, num_steps=16, num_samples=200):
    """Samples of one Gaussian around 0 from an exact denoiser."""
    sigmas = GRID(num_steps)
    x_init = sigmas[0] * np.random.default_rng(0).standard_normal((num_samples, 1))
    return np.asarray(sampler(GaussianMixture([0.0], width=width).denoise, x_init, sigmas))


def _shown_second(sampler):
    """The size of the state that a sampler shows the network at its second evaluation."""
    shown = []

    def denoise(x, sigma):
        shown.append(float(np.abs(x).mean()))
        return 0.0 * x

    sampler(denoise, np.full((50, 1), 128.0), GRID(8))
    return shown[1]


def _like_ddim(sampler):
    """Whether a sampler ends where DDIM does."""
    return np.allclose(_ends(sampler), _ends(lambda *given: samplers.sample("ddim", *given)), atol=1e-3)


RIGHT["10.d"] = [
    lambda sampler: bool(_ends(sampler).std() > 0.1),
    lambda sampler: jnp.asarray(_ends(sampler)).std() > 0.1,  # a boolean of JAX
    lambda sampler: _ends(sampler, num_steps=8).std() > 0.05,  # one of NumPy
    lambda sampler: np.array([_ends(sampler).std() > 0.1]),
    lambda sampler: _shown_second(sampler) > 5.0,
]
WRONG["10.d"] = [
    (lambda sampler: True, "does not rescale, and passed"),
    (lambda sampler: False, "rescales, and was refused"),
    (lambda sampler: bool(_ends(sampler, num_steps=1).std() > 1e-4), "does not rescale, and passed"),  # one step
    (lambda sampler: bool(_ends(sampler, num_steps=2).std() > 1e-3), "does not rescale, and passed"),
    (lambda sampler: bool(abs(_ends(sampler).mean()) < 0.2), "does not rescale, and passed"),  # means agree
    (_like_ddim, "rescales, and was refused"),  # it is not the only one that does
    (lambda sampler: bool(_ends(sampler).std() < 0.1), "refused"),  # the wrong way round
    (lambda sampler: float(_ends(sampler).std()), "True or False is asked for"),
    (lambda sampler: None, "returns nothing"),
]

_KEPT = GRID(8)[1] / 128.0  # of the way, in the first step
_SECOND = 0.3 + _KEPT * 127.7
RIGHT["10.e"] = [
    [82.45, 1.001, 0.0],
    (82.4, 1.0013, 0),
    jnp.asarray([_SECOND, _SECOND / np.hypot(1, GRID(8)[1]), 0.0]),
    np.array([82.446, 1.0012, 1e-9]),
]
WRONG["10.e"] = [
    ([_KEPT * 128, 1.0012, 0.0], "rescaled: the network's answer, 0.3, is not in it"),
    ([82.45, _KEPT * 128 / np.hypot(1, GRID(8)[1]), 0.0], "literal: the network's answer, 0.3, is not in it"),
    ([0.3 + _KEPT * 1.7, 1.0012, 0.0], "rescaled: this is too small"),  # from the state 2
    ([0.3 + GRID(8)[2] / 128 * 127.7, 1.0012, 0.0], "rescaled: this is too small"),  # a level too far
    ([82.45, 82.45, 0.0], "literal: this is too large"),
    ([82.45, 1.0012, 81.4], "last step"),
    ([82.34, 128.0, 0.0], "rescaled"),
    ([82.45, 1.0012], "three numbers"),
]

# Notebook 11 ------------------------------------------------------------------------------------

RIGHT["11.a"] = [
    0.4,
    np.array([0.4]),
    jnp.asarray(0.41),
    GaussianMixture([-1, 1], 0.1, weights=[0.3, 0.7]).means.T @ [0.3, 0.7],
]
WRONG["11.a"] = [
    (1.0, "too large; one step does not vote"),
    (0.7, "too large"),
    (-1.0, "too small"),
    (0.0, "too small"),
    (-0.4, "too small"),
    ([0.4, 0.4], "one number"),
]

RIGHT["11.b"] = [[4.0, 5.0], (4, 5), np.array([3.98, 5.01]), jnp.sqrt(jnp.asarray([16.0, 25.0]))]
WRONG["11.b"] = [
    ([2.0, 5.0], "exact denoiser's error is too small; variances add"),
    ([3.0, 5.0], "exact denoiser's error is too small"),
    ([np.sqrt(34), 5.0], "exact denoiser's error is too large"),
    ([16.0, 25.0], "exact denoiser's error is too large"),  # variances
    ([4.0, 8.0], "other network's error is too large"),
    ([4.0, 0.0], "other network's error is too small"),
    (4.0, "two numbers"),
]

RIGHT["11.c"] = [1.46, 2 * 0.726, np.float32(1.45), jnp.asarray([1.47])]
WRONG["11.c"] = [
    (0.73, "too small: the posterior deviation"),  # that of modes at 1
    (2.0, "too large"),
    (2.9, "too large"),
    (1.0, "too small"),
    (0.1, "too small"),
    (-1.46, "positive"),
    ([1.46, 1.46], "one number"),
]

RIGHT["11.d"] = [
    [128, 6, 3, 1],
    (128.0, 4.0, 2.0, 1.0),
    np.array([128, 5, 2.5, 1.2]),
    jnp.asarray([128.0, 3.0, 2.0, 1.0]),
]
WRONG["11.d"] = [
    ([128, 40.41, 6.06, 0.01], r"4\d\.\d% hit the wall"),  # the paper's
    ([128, 0.5, 0.25, 0.1], "others pass at 1.[01]. m, the data at 1.39 m"),  # all after the decision
    ([128, 10, 5, 2], "hit the wall"),
    ([128, 0.1, 0.05, 0.01], "100.0% hit the wall"),
    ([128, 6, 3, 1.5], r"5\.0% hit the wall, fewer than 5 % may"),  # just too many
    ([128, 1e-30, 1e-38, 1e-44], "so low"),
    ([60, 6, 3, 1], "first level is 128"),
    ([128, 3, 6, 1], "lower than the one before"),
    ([128, 6, 3, 0], "none is 0"),
    ([128, 6, 1], "four levels"),
]

_LEFT, _TO_THE_RIGHT = bimodal_paths.crossing(bimodal_paths.BimodalPaths().mean_paths)
RIGHT["11.e"] = [0.68, (0.5 - _TO_THE_RIGHT) / (_LEFT - _TO_THE_RIGHT), np.array([0.675]), jnp.asarray(0.68)]
WRONG["11.e"] = [
    (0.5, "too small"),
    (0.9, "too large"),
    (0.36, "too small"),  # wall over crossing
    (0.86, "too large"),  # both edges of the wall taken
    (0.32, "too small"),  # the share that is told wrongly
    (68, "between 0 and 1"),
    ([0.68, 0.32], "one number"),
]

# Notebook 12 ------------------------------------------------------------------------------------


def _circulant(weights, num_frames):
    kernel = np.fft.irfft(weights, n=num_frames)
    return np.stack([np.roll(kernel, frame) for frame in range(num_frames)], axis=1)


def _by_pulses(weights, num_frames):
    spectrum = np.fft.rfft(np.eye(num_frames), axis=0)
    spectrum[: len(weights)] *= weights[:, None]
    spectrum[len(weights) :] = 0
    return np.fft.irfft(spectrum, n=num_frames, axis=0)


def _banded(weights, num_frames):
    frame = np.arange(num_frames)
    return np.where(frame[:, None] >= frame, _circulant(weights, num_frames), 0.0)


RIGHT["12.a"] = [
    _circulant,
    _by_pulses,
    lambda weights, T: jnp.asarray(_circulant(weights, T)),
    lambda weights, T: _circulant(np.pad(weights, (0, T // 2 + 1 - len(weights))), T).tolist(),
]
WRONG["12.a"] = [
    (lambda weights, T: _circulant(weights, T).T, "the transpose"),
    (_banded, "another matrix"),  # ends with the window
    (lambda weights, T: np.diag(np.pad(weights.real, (0, T - len(weights)))), "another matrix"),
    (lambda weights, T: T * _circulant(weights, T), "another matrix"),  # no 1 / T
    (lambda weights, T: _circulant(weights.real, T), "another matrix"),  # delays forgotten
    (lambda weights, T: np.fft.irfft(weights, n=T), "shape"),  # the kernel alone
    (lambda weights, T: _circulant(weights, 2 * (T // 2)), r"shape \(9, 9\)"),  # odd windows forgotten
]

RIGHT["12.b"] = [(7, 32, 2, 1), [7.0, 32.0, 2.0, 1.0], np.array([7, 32, 2, 1]), jnp.asarray([7, 32, 2, 1])]
WRONG["12.b"] = [
    ((8, 32, 2, 1), "number 1 is too large"),  # 2 m
    ((4, 32, 2, 1), "number 1 is too small"),  # m
    ((7, 33, 2, 1), "number 2 is too large"),  # 2 m - 1
    ((7, 17, 2, 1), "number 2 is too small"),
    ((7, 32, 1, 1), "number 3 is too small"),
    ((7, 32, 2, 2), "number 4 is too large"),
    ((7, 32, 2, 0), "number 4 is too small"),
    ((7, 32), "four whole numbers"),
]


def _line(x):
    return np.linspace(x[0], x[-1], len(x))


def _cut(x, modes):
    spectrum = np.fft.rfft(x)
    spectrum[modes:] = 0
    return np.fft.irfft(spectrum, n=len(x))


RIGHT["12.c"] = [
    lambda x, m: _line(x) + _cut(x - _line(x), m),
    lambda x, m: jnp.asarray(_line(x) + _cut(x - _line(x), m)),
    lambda x, m: (x - (x - _line(x)) + _cut(x - _line(x), m)).tolist(),
]
WRONG["12.c"] = [
    (_cut, "modes of the signal itself"),
    (lambda x, m: _cut(x - _line(x), m), "not given back"),
    (lambda x, m: _line(x) + _cut(x - _line(x), m - 1), "keep m modes"),
    (lambda x, m: _line(x) + _cut(x - _line(x), m) - (x - _line(x)).mean(), "mode 0 among them"),
    (lambda x, m: (x[-1] - x[0]) * np.linspace(0, 1, len(x)) + _cut(x - _line(x), m), "something else"),  # from 0
    (lambda x, m: np.polyval(np.polyfit(range(len(x)), x, 1), range(len(x))), "something else"),  # the best line alone
    (lambda x, m: _line(x), "something else"),
    (lambda x, m: _cut(x, m)[:-1], "31|32 frames"),
]


def _singular(filters):
    return np.linalg.svd(filters, compute_uv=False)


def _needed(filters, allowed):
    energy = _singular(filters) ** 2
    return next(d for d in range(len(energy) + 1) if energy[d:].sum() <= allowed * energy.sum())


RIGHT["12.d"] = [
    _needed,
    lambda filters, allowed: float(_needed(filters, allowed)),
    lambda filters, allowed: jnp.asarray(_needed(filters, allowed)),
    lambda filters, allowed: np.array([_needed(filters.T, allowed)]),
]
WRONG["12.d"] = [
    (lambda filters, allowed: _needed(filters, allowed) - 1, "8 delays, 0.1 allowed: .* too small"),
    (lambda filters, allowed: _needed(filters, allowed) + 1, "8 delays, 0.1 allowed: .* too large"),
    (lambda filters, allowed: len(filters), "8 delays, 0.3 allowed: .* too large"),
    (lambda filters, allowed: int(np.linalg.matrix_rank(filters)), "0.3 allowed: .* too large"),
    (lambda filters, allowed: int(np.sum(_singular(filters) > allowed * _singular(filters)[0])), "too large"),
    (
        # Singular values where their squares belong.
        lambda filters, allowed: _needed(np.diag(np.sqrt(_singular(filters))), allowed),
        "too large",
    ),
    (lambda filters, allowed: _needed(filters - filters.mean(axis=0), allowed), "too small"),  # one for the mean
    (lambda filters, allowed: [1, 2], "one whole number"),
]


def _bits(delay, num_blocks):
    return [1 if (delay >> block) & 1 else -1 for block in range(num_blocks)]


RIGHT["12.e"] = [
    lambda lead, n: _bits(-lead % 2**n, n),
    lambda lead, n: np.array(_bits((2**n - lead) % 2**n, n), float),
    lambda lead, n: jnp.asarray(_bits(-lead % 2**n, n)),
    lambda lead, n: tuple(_bits(-lead, n)),  # Python's -lead has the right low bits
]
WRONG["12.e"] = [
    (lambda lead, n: _bits(lead, n), "1 frames ahead: the signal comes 1 frames late"),  # a delay
    (lambda lead, n: [-bit for bit in _bits(lead, n)], "2 frames late"),  # the signs turned
    (lambda lead, n: _bits(-lead % 2**n, n)[::-1], "frames late"),  # the longest first
    (lambda lead, n: _bits(2**n - 1 - lead, n), "2 frames late"),
    (lambda lead, n: [(bit + 1) / 2 for bit in _bits(-lead, n)], "each -1 or 1"),  # 0 and 1
    (lambda lead, n: -lead % 2**n, "give 2 numbers"),
    (lambda lead, n: _bits(0, n), "0 frames late"),
]

# The course, notebooks/course/ ------------------------------------------------------------------

RIGHT |= course_answers_first.RIGHT | course_answers_second.RIGHT | course_answers_third.RIGHT
WRONG |= course_answers_first.WRONG | course_answers_second.WRONG | course_answers_third.WRONG

# ------------------------------------------------------------------------------------------------


def cases(answers):
    return [(number, *each) for number in answers for each in enumerate(answers[number])]


@pytest.mark.parametrize("number, which, answer", cases(RIGHT), ids=lambda value: str(value)[:8])
def test_a_right_answer_passes_in_every_form(number, which, answer):
    assert hint(number, answer) is None


@pytest.mark.parametrize("number, which, answer_and_hint", cases(WRONG), ids=lambda value: str(value)[:8])
def test_a_wrong_answer_gets_a_hint_that_says_what_is_wrong(number, which, answer_and_hint):
    answer, expected = answer_and_hint
    assert hint(number, answer) is not None, "a wrong answer passed"
    assert re.search(expected, hint(number, answer)), hint(number, answer)


def test_every_exercise_is_tried_with_three_right_forms_and_five_wrong_answers():
    assert list(RIGHT) == list(WRONG) == list(CHECKS)
    assert all(len(RIGHT[number]) >= 3 and len(WRONG[number]) >= 5 for number in CHECKS)


def test_the_share_of_spread_that_is_asked_for_is_what_the_two_walks_leave():
    denoise = GaussianMixture([0.0], width=1.0).denoise
    for levels, share in zip(_LEVELS, RIGHT["10.b"][0], strict=True):
        literal, rescaled = (
            float([*samplers.walk(name, denoise, levels[:1], levels)][-2].x_noisy[0])
            for name in ("ddim_literal", "ddim")
        )
        np.testing.assert_allclose(literal / rescaled, share, rtol=1e-3)  # in float32


def test_appendix_f_defines_a_root_that_its_update_does_not_use():
    """alpha_t = sqrt(alpha_bar_t / alpha_bar_(t-1)) stands in DDPM's mean, not in DDIM's step."""
    levels = np.array([1e-4, 0.2, 0.8, 0.99, 1.0])
    for alpha_bar, alpha_bar_next in zip(levels, levels[1:], strict=False):
        on_ddpm, on_ddim = _on_z(np.sqrt(alpha_bar / alpha_bar_next), alpha_bar, alpha_bar_next)
        np.testing.assert_allclose(samplers.ddpm_posterior(alpha_bar, alpha_bar_next)[1], on_ddpm, rtol=1e-12)
        np.testing.assert_allclose(samplers.ddim_step_vp(1.0, 0.0, alpha_bar, alpha_bar_next), on_ddim, rtol=1e-12)
