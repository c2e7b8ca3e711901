"""Answers to the exercises: a right one in another form than the solution's passes, two wrong ones get a hint."""

import jax.numpy as jnp
import numpy as np
import pytest
from f3amd_notebooks.exercises import CHECKS, hint

from f3amd_lib.diffusion import samplers
from f3amd_lib.diffusion.oracles import GaussianMixture
from f3amd_lib.diffusion.schedules import variance_exploding

RIGHT, WRONG = {}, {}
"""By number: a right answer, and two wrong ones."""

GRID = variance_exploding().grid


def shares(levels, factors):
    """The product of 1 / sqrt(1 + sigma^2) over a slice of the levels."""
    return np.prod(1 / np.hypot(1, np.asarray(levels)[factors]))


RIGHT["2.a"] = np.float32(0.000156)
WRONG["2.a"] = [0.14, 0.01]
RIGHT["2.b"] = lambda x, x0_hat, s, s_next: x + (s_next - s) * (x - x0_hat) / s
WRONG["2.b"] = [samplers.ddim_step_literal, lambda x, x0_hat, s, s_next: x0_hat + s_next * (x - x0_hat)]
RIGHT["2.c"] = 8.0
WRONG["2.c"] = [2, 1]
RIGHT["2.d"] = [2252.8, 114.5]
WRONG["2.d"] = [[2048, 114], [2253, 58]]
_EARLY, _LATE = (0.0625, 0.4841, 0.25), (0.9025, 0.5933, 3.61)
RIGHT["2.e"] = np.array([_EARLY, _LATE])
WRONG["2.e"] = [[(0.25, 0.4841, 0.4843), _LATE], [(0.0625, 0.9682, 0.9531), _LATE]]
RIGHT["2.f"] = lambda denoise: lambda z, ab: denoise(z * np.sqrt(1 + (1 - ab) / ab), np.sqrt(1 / ab - 1))
WRONG["2.f"] = [
    lambda denoise: lambda z, ab: denoise(z, np.sqrt((1 - ab) / ab)),
    lambda denoise: lambda z, ab: denoise(z / np.sqrt(ab), np.sqrt(1 - ab)),
]


def _on_z(root, ab, ab_next):
    return root * (1 - ab_next) / (1 - ab), np.sqrt((1 - ab_next) / (1 - ab))


RIGHT["2.g"] = lambda root, ab, ab_next: [root * (1 - ab_next) / (1 - ab_next * root**2), _on_z(root, ab, ab_next)[1]]
WRONG["2.g"] = [lambda *given: _on_z(*given)[::-1], lambda root, ab, ab_next: _on_z(root**2, ab, ab_next)]
RIGHT["10.a"] = samplers.ddim_step
WRONG["10.a"] = [samplers.ddim_step_literal, lambda *given: samplers.ddim_step_literal(*given) / np.hypot(1, given[3])]
_LEVELS = (GRID(2), GRID(4), GRID(16), np.array([128.0, 3.0, 1.0, 0.0]))


def _share_list(factors):
    return [shares(levels, factors) for levels in _LEVELS]


RIGHT["10.b"] = _share_list(slice(1, None))
WRONG["10.b"] = [_share_list(slice(0, -1)), _share_list(slice(1, -2))]
RIGHT["10.c"] = 0.198
WRONG["10.c"] = [0.22, 0.18]


def _ends(sampler, *, width=1.0, num_steps=16, num_samples=200):
    """Samples of one Gaussian around 0 from an exact denoiser."""
    sigmas = GRID(num_steps)
    x_init = sigmas[0] * np.random.default_rng(0).standard_normal((num_samples, 1))
    return np.asarray(sampler(GaussianMixture([0.0], width=width).denoise, x_init, sigmas))


RIGHT["10.d"] = lambda sampler: jnp.asarray(_ends(sampler)).std() > 0.1
WRONG["10.d"] = [lambda sampler: True, lambda sampler: False]
_KEPT = GRID(8)[1] / 128.0  # of the way, in the first step
RIGHT["10.e"] = (82.4, 1.0013, 0)
WRONG["10.e"] = [[_KEPT * 128, 1.0012, 0.0], [82.45, _KEPT * 128 / np.hypot(1, GRID(8)[1]), 0.0]]
RIGHT["11.a"] = np.array([0.4])
WRONG["11.a"] = [1.0, 0.7]
RIGHT["11.b"] = (4, 5)
WRONG["11.b"] = [[2.0, 5.0], [3.0, 5.0]]
RIGHT["11.c"] = 2 * 0.726
WRONG["11.c"] = [0.73, 2.0]
RIGHT["11.d"] = (128.0, 4.0, 2.0, 1.0)
WRONG["11.d"] = [[128, 40.41, 6.06, 0.01], [128, 0.5, 0.25, 0.1]]
RIGHT["11.e"] = 0.68
WRONG["11.e"] = [0.5, 0.9]


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


RIGHT["12.a"] = _by_pulses
WRONG["12.a"] = [lambda weights, T: _circulant(weights, T).T, _banded]
RIGHT["12.b"] = [7.0, 32.0, 2.0, 1.0]
WRONG["12.b"] = [(8, 32, 2, 1), (4, 32, 2, 1)]


def _line(x):
    return np.linspace(x[0], x[-1], len(x))


def _cut(x, modes):
    spectrum = np.fft.rfft(x)
    spectrum[modes:] = 0
    return np.fft.irfft(spectrum, n=len(x))


RIGHT["12.c"] = lambda x, m: jnp.asarray(_line(x) + _cut(x - _line(x), m))
WRONG["12.c"] = [_cut, lambda x, m: _cut(x - _line(x), m)]


def _needed(filters, allowed):
    energy = np.linalg.svd(filters, compute_uv=False) ** 2
    return next(d for d in range(len(energy) + 1) if energy[d:].sum() <= allowed * energy.sum())


RIGHT["12.d"] = lambda filters, allowed: float(_needed(filters, allowed))
WRONG["12.d"] = [lambda *given: _needed(*given) - 1, lambda *given: _needed(*given) + 1]


def _bits(delay, num_blocks):
    return [1 if (delay >> block) & 1 else -1 for block in range(num_blocks)]


RIGHT["12.e"] = lambda lead, n: np.array(_bits((2**n - lead) % 2**n, n), float)
WRONG["12.e"] = [lambda lead, n: _bits(lead, n), lambda lead, n: [-bit for bit in _bits(lead, n)]]
RIGHT["C1.a"] = lambda x, d, s: np.stack([(d - x) / s**2, x / s - d / s, -s * (d - x) / s**2])
WRONG["C1.a"] = [
    lambda x, d, s: ((x - d) / s**2, (x - d) / s, (x - d) / s),
    lambda x, d, s: ((d - x) / s, (x - d) / s, (x - d) / s),
]


def _wall(mixture, x, sigma):
    """What flows through a place, by the score."""
    place = np.array([x])
    return np.exp(mixture.log_density(place, sigma)) * -sigma * mixture.score(place, sigma)[0]


RIGHT["C1.b"] = lambda m, a, b, s: jnp.asarray([_wall(m, a, s) - _wall(m, b, s)])
WRONG["C1.b"] = [lambda m, a, b, s: _wall(m, b, s) - _wall(m, a, s), lambda m, a, b, s: _wall(m, a, s) + _wall(m, b, s)]


def _eta(x, d, s, t, eta, noise, *, up_too_much=False, linear=False):
    up = eta * t / s * np.sqrt(s**2 - t**2)
    down = t - up if linear else t if up_too_much else np.sqrt(t**2 - up**2)
    return d + down / s * (x - d) + up * noise


def _between(x, d, s, t, eta, noise):
    """DDIM on the way to the level below, written with the guessed noise."""
    eps = (x - d) / s
    return d + t * np.sqrt(1 - eta**2 * (1 - (t / s) ** 2)) * eps + eta * t * np.sqrt(1 - (t / s) ** 2) * noise


RIGHT["C2.a"] = _between
WRONG["C2.a"] = [lambda *given: _eta(*given, up_too_much=True), lambda *given: _eta(*given, linear=True)]
RIGHT["C2.b"] = (1.55, 2.0, 2.0)
WRONG["C2.b"] = [(0.75, 1.2, 2.0), (1.55, 3.8, 2.0)]


def _two_m(weigh):
    def step(x, guess, before, first, sigma, lower):
        ratio = np.log(sigma / lower) / np.log(first / sigma)
        return lower / sigma * x + (1 - lower / sigma) * (guess + weigh(ratio) * (guess - before))

    return step


RIGHT["C3.a"] = lambda *given: jnp.asarray(_two_m(lambda ratio: 0.5 * ratio)(*given))
WRONG["C3.a"] = [_two_m(lambda ratio: 0.0), _two_m(lambda ratio: -0.5 * ratio)]


def _one_by_one(s, sigmas):
    keep = [1 + (t - u) * u / (s**2 + u**2) for u, t in zip(sigmas, sigmas[1:], strict=False)]
    return np.prod(keep), np.sqrt((s**2 + sigmas[-1] ** 2) / (s**2 + sigmas[0] ** 2))


RIGHT["C3.b"] = _one_by_one
WRONG["C3.b"] = [lambda s, u: _one_by_one(s, u)[::-1], lambda s, u: (_one_by_one(s, u)[1],) * 2]


def _even(spacing, back):
    return lambda top, bottom, n: np.append(back(np.linspace(spacing(top), spacing(bottom), n)), 0.0)


RIGHT["C4.a"] = _even(np.log, np.exp)
WRONG["C4.a"] = [_even(lambda s: s, lambda s: s), _even(lambda s: s ** (1 / 3), lambda s: s**3)]
RIGHT["C4.b"] = [0.198, 0.1]
WRONG["C4.b"] = [(0.2, 0.2), (0.1, 0.08)]


def _karras(sigma, s):
    total = s**2 + sigma**2
    return s**2 / total, s * sigma / np.sqrt(total), 1 / np.sqrt(total)


def _changed(**by):
    """Karras's numbers with one of them changed."""
    order = ("skip", "out", "given")

    def numbers_of(sigma, s):
        values = dict(zip(order, _karras(sigma, s), strict=True))
        return [by[name](sigma, s, values[name]) if name in by else values[name] for name in order]

    return numbers_of


RIGHT["C5.a"] = lambda sigma, s: jnp.asarray(_karras(sigma, s))
WRONG["C5.a"] = [_changed(skip=lambda sigma, s, value: 1 - value), _changed(out=lambda sigma, s, value: -value)]


def _loss_weights(sigma, s):
    return 1 / sigma**2, 1 + 1 / sigma**2, 1 / s**2 + 1 / sigma**2


RIGHT["C5.b"] = lambda sigma, s: jnp.asarray(_loss_weights(sigma, s))
WRONG["C5.b"] = [lambda *given: 1 / np.asarray(_loss_weights(*given)), lambda *given: np.sqrt(_loss_weights(*given))]


def _velocity(denoise, z, t):
    return (denoise(z / t, (1 - t) / t) - z) / (1 - t)


def _by_the_noise(denoise, z, t):
    guess = denoise(z / t, 1 / t - 1)
    return guess - (z - t * guess) / (1 - t)


RIGHT["C6.a"] = _by_the_noise
WRONG["C6.a"] = [
    lambda denoise, z, t: -_velocity(denoise, z, t),
    lambda denoise, z, t: (denoise(z, 1 - t) - z) / (1 - t),
]
RIGHT["C6.b"] = lambda s: jnp.asarray([1 + s * s, 1 - 2 * s + s * s])
WRONG["C6.b"] = [lambda s: ((1 - s) ** 2, 1 + s**2), lambda s: (1 + s**2, 1 + s**2)]


def _guided(x, sigma, told, free, w):
    return x - sigma * (free + w * (told - free))


RIGHT["C7.a"] = lambda x, sigma, told, free, w: (1 - w) * (x - sigma * free) + w * (x - sigma * told)
WRONG["C7.a"] = [
    lambda x, sigma, told, free, w: _guided(x, sigma, told, free, w + 1),
    lambda x, sigma, told, free, w: _guided(x, sigma, free, told, w),
]


def _tilted_and_guided(s, S, w):
    return (w / s**2 + (1 - w) / S**2) ** -0.5, s**w * S ** (1 - w)


RIGHT["C7.b"] = lambda s, S, w: [s * S / np.sqrt(w * S**2 - (w - 1) * s**2), _tilted_and_guided(s, S, w)[1]]
WRONG["C7.b"] = [lambda *given: _tilted_and_guided(*given)[::-1], lambda *given: (_tilted_and_guided(*given)[0],) * 2]
RIGHT["C8.a"] = lambda x, sigma, edge, s: jnp.asarray(x) * jnp.sqrt((s**2 + edge**2) / (s**2 + sigma**2))
WRONG["C8.a"] = [
    lambda x, sigma, edge, s: x * (s**2 + sigma * edge) / (s**2 + sigma**2),
    lambda x, sigma, edge, s: x * s**2 / (s**2 + sigma**2),
]


def _neighbour(denoise, x, sigma, lower):
    return x + (lower - sigma) * (x - denoise(x, sigma)) / sigma


def _consistency_target(denoise, student, x, sigma, lower, edge):
    neighbour = _neighbour(denoise, x, sigma, lower)
    return student(neighbour, lower, edge) if lower > edge else neighbour


RIGHT["C8.b"] = _consistency_target
WRONG["C8.b"] = [
    lambda d, f, x, s, lower, e: f(_neighbour(d, x, s, lower), lower, e),
    lambda d, f, x, s, lower, e: _neighbour(d, x, s, lower),
]


def _by_the_divergence(x, x0_hat, jacobian, sigma):
    slope = (np.eye(len(x)) - jacobian) / sigma
    return (x - x0_hat) / sigma, [-np.trace(slope)]


RIGHT["C9.a"] = _by_the_divergence
WRONG["C9.a"] = [
    lambda x, x0_hat, jacobian, sigma: ((x0_hat - x) / sigma, 0.0),
    lambda x, x0_hat, jacobian, sigma: (x - x0_hat, 0.0),
]


def _off_diagonal(matrix):
    return matrix - np.diag(np.diag(matrix))


RIGHT["C9.b"] = lambda matrix: np.sqrt(2.0) * np.array([np.linalg.norm(m) for m in (_off_diagonal(matrix), matrix)])
WRONG["C9.b"] = [lambda matrix: RIGHT["C9.b"](matrix)[::-1], lambda matrix: np.square(RIGHT["C9.b"](matrix))]
RIGHT["C10.a"] = lambda a, beta, rounds: beta * rounds if a == 1 else beta * (a**rounds - 1) / (a - 1)
WRONG["C10.a"] = [lambda a, beta, rounds: rounds * beta, lambda a, beta, rounds: beta * a**rounds]
RIGHT["C10.b"] = lambda a, q, top: jnp.array([a - a / jnp.hypot(1, top / q), 1 / jnp.hypot(1 / q, 1 / top)])
WRONG["C10.b"] = [lambda *given: RIGHT["C10.b"](*given)[::-1], lambda a, q, sigma_max: (a, q)]


@pytest.mark.slow
@pytest.mark.parametrize("number", RIGHT)
def test_a_right_answer_passes_in_another_form_than_the_solutions(number):
    assert hint(number, RIGHT[number]) is None


@pytest.mark.parametrize("place", [0, 1])
@pytest.mark.parametrize("number", WRONG)
def test_a_wrong_answer_gets_a_hint(number, place):
    assert hint(number, WRONG[number][place])


@pytest.mark.parametrize(
    "number, answer, named",
    [
        ("2.d", [114, 2253], "order"),
        ("C5.a", lambda *given: np.roll(_karras(*given), 1, axis=-1), "order"),
        ("C1.b", WRONG["C1.b"][1], "same sign"),
        ("C2.a", lambda *given: _eta(*given[:4], 0.0, given[5]), "fresh noise is missing"),
        ("C2.a", WRONG["C2.a"][1], "deviations do not add"),
        ("C2.a", lambda x, d, s, t, eta, noise: _eta(x, d, s, t, eta * s / t, noise), "factor"),
        ("C2.a", lambda x, d, s, *rest: _eta(s * x, s * d, s, *rest) + (1 - s) * d, "divide by sigma"),
        ("C8.b", lambda denoise, student, x, sigma, *_: denoise(x, sigma), "guess is no neighbour"),
        ("C8.b", lambda d, f, x, s, t, e: f(d(x, s) + s / t * (x - d(x, s)), t, e), "share lower / sigma"),
    ],
)
def test_a_hint_names_the_mistake(number, answer, named):
    assert named in hint(number, answer)


def test_every_exercise_is_tried_both_ways():
    assert list(RIGHT) == list(WRONG) == list(CHECKS)


def test_appendix_f_defines_a_root_that_its_update_does_not_use():
    """alpha_t = sqrt(alpha_bar_t / alpha_bar_(t-1)) stands in DDPM's mean, not in DDIM's step."""
    levels = np.array([1e-4, 0.2, 0.8, 0.99, 1.0])
    for alpha_bar, alpha_bar_next in zip(levels, levels[1:], strict=False):
        on_ddpm, on_ddim = _on_z(np.sqrt(alpha_bar / alpha_bar_next), alpha_bar, alpha_bar_next)
        np.testing.assert_allclose(samplers.ddpm_posterior(alpha_bar, alpha_bar_next)[1], on_ddpm, rtol=1e-12)
        np.testing.assert_allclose(samplers.ddim_step_vp(1.0, 0.0, alpha_bar, alpha_bar_next), on_ddim, rtol=1e-12)
