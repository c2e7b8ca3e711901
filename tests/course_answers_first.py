"""Answers to the exercises of the course, 01 to 05: right forms and wrong answers."""

import jax.numpy as jnp
import numpy as np

from f3amd_lib.diffusion import samplers

RIGHT = {}
"""By number: the answer in different forms."""
WRONG = {}
"""By number: pairs of a wrong answer and a piece of the hint that it is to get."""

# C1 Score ---------------------------------------------------------------------------------------

RIGHT["C1.a"] = [
    lambda x, d, s: ((d - x) / s**2, (x - d) / s, (x - d) / s),
    lambda x, d, s: np.stack([(d - x) / s**2, x / s - d / s, -s * (d - x) / s**2]),
    lambda x, d, s: jnp.stack([(jnp.asarray(d) - x) / s**2, (jnp.asarray(x) - d) / s, (jnp.asarray(x) - d) / s]),
]
WRONG["C1.a"] = [
    (lambda x, d, s: ((x - d) / s**2, (x - d) / s, (x - d) / s), "not away from it"),
    (lambda x, d, s: ((d - x) / s, (x - d) / s, (x - d) / s), "score is not yet right"),
    (lambda x, d, s: (d - x, (x - d) / s, (x - d) / s), "score is not yet right"),
    (lambda x, d, s: ((d - x) / s**2, (x - d) / s**2, (x - d) / s), "noise is not yet right"),
    (lambda x, d, s: ((d - x) / s**2, x - d, (x - d) / s), "noise is not yet right"),
    (lambda x, d, s: ((d - x) / s**2, (x - d) / s, (d - x) / s), "velocity is not yet right"),
    (lambda x, d, s: ((d - x) / s**2, (x - d) / s, (x - d) / s**2), "velocity is not yet right"),
    (lambda x, d, s: (d - x) / s**2, "three things"),
]


def _wall(mixture, x, sigma, scale=1.0):
    place = np.array([x])
    return np.exp(mixture.log_density(place, sigma)) * (x - mixture.denoise(place, sigma)[0]) / sigma * scale


def _wall_by_score(mixture, x, sigma):
    place = np.array([x])
    return np.exp(mixture.log_density(place, sigma)) * -sigma * mixture.score(place, sigma)[0]


RIGHT["C1.b"] = [
    lambda m, a, b, s: _wall(m, a, s) - _wall(m, b, s),
    lambda m, a, b, s: jnp.asarray([_wall_by_score(m, a, s) - _wall_by_score(m, b, s)]),
    lambda m, a, b, s: float(-np.diff([_wall(m, a, s), _wall(m, b, s)])[0]),
]
WRONG["C1.b"] = [
    (lambda m, a, b, s: _wall(m, b, s) - _wall(m, a, s), "at b it goes out"),
    (lambda m, a, b, s: _wall(m, a, s) + _wall(m, b, s), "the rate is too"),
    (lambda m, a, b, s: s * (_wall(m, a, s) - _wall(m, b, s)), "the rate is too"),  # velocity x - D
    (lambda m, a, b, s: (_wall(m, a, s) - _wall(m, b, s)) / s, "the rate is too"),  # the score for the velocity
    (lambda m, a, b, s: _wall(m, a, s), "the rate is too"),  # one wall alone
    (lambda m, a, b, s: 0.0, "the rate is too"),
    (lambda m, a, b, s: None, "returns nothing"),
]

# C2 Stochastic samplers -------------------------------------------------------------------------


def _eta(x, d, s, t, eta, noise, *, up_too_much=False, linear=False):
    up = eta * t / s * np.sqrt(s**2 - t**2)
    down = t - up if linear else t if up_too_much else np.sqrt(t**2 - up**2)
    return d + down / s * (x - d) + up * noise


def _between(x, d, s, t, eta, noise):
    """DDIM on the way to the level below, written with the guessed noise."""
    eps = (x - d) / s
    return d + t * np.sqrt(1 - eta**2 * (1 - (t / s) ** 2)) * eps + eta * t * np.sqrt(1 - (t / s) ** 2) * noise


RIGHT["C2.a"] = [_eta, _between, lambda *given: jnp.asarray(_eta(*given))]
WRONG["C2.a"] = [
    (lambda *given: _eta(*given, up_too_much=True), "too much noise"),
    (lambda *given: _eta(*given, linear=True), "not DDPM's step"),  # deviations in place of variances
    (lambda x, d, s, t, eta, noise: samplers.ddim_step(x, d, s, t), "not DDPM's step"),
    (lambda x, d, s, t, eta, noise: samplers.ddpm_step(x, d, s, t, noise), "not DDIM's"),
    (
        lambda x, d, s, t, eta, noise: (
            (1 - eta) * samplers.ddim_step(x, d, s, t) + eta * samplers.ddpm_step(x, d, s, t, noise)
        ),
        "the state ends elsewhere",  # a mean of both ends
    ),
    (lambda x, d, s, t, eta, noise: _eta(x, d, s, t, eta**2, noise), "the state ends elsewhere"),
    (lambda x, d, s, t, eta, noise: x, "not DDIM's"),
]

RIGHT["C2.b"] = [
    (1.55, 3.8, 2.0),
    [0.4**2 * 5 + 0.75, 0.8 + 3, 1 + 1],
    jnp.asarray([1.55, 3.8, 2.0]),
    np.array([1.545, 3.82, 2.01]),
]
WRONG["C2.b"] = [
    ((0.75, 3.0, 2.0), "smaller variance x': this is too small"),  # fresh noise alone
    ((1.55, 2.0, 2.0), "larger variance x': this is too small"),
    ((1.55, 3.8, 1.2), "should have: this is too small"),  # the variance given x
    ((1.55, 3.8, 1.0), "should have: this is too small"),  # the data's
    ((1.245, 1.949, 1.414), "too small"),  # deviations
    ((2.0, 3.8, 2.0), "smaller variance x': this is too large"),
    ((1.55, 3.8), "three numbers"),
]

# C3 Solvers -------------------------------------------------------------------------------------


def _two_m(weigh):
    def step(x, guess, before, first, sigma, lower):
        ratio = np.log(sigma / lower) / np.log(first / sigma)
        return lower / sigma * x + (1 - lower / sigma) * (guess + weigh(ratio) * (guess - before))

    return step


RIGHT["C3.a"] = [
    _two_m(lambda ratio: 0.5 * ratio),
    lambda *given: jnp.asarray(_two_m(lambda ratio: 0.5 * ratio)(*given)),
    lambda x, g, b, f, s, t: samplers.ddim_step(x, g + (g - b) * np.log(t / s) / np.log(s / f) / 2, s, t),
]
WRONG["C3.a"] = [
    (_two_m(lambda ratio: 0.0), "not used yet"),
    (_two_m(lambda ratio: -0.5 * ratio), "leans back"),
    (_two_m(lambda ratio: 0.5 / ratio), "stands on its head"),
    (_two_m(lambda ratio: 0.5), "ratio of their lengths is missing"),
    (_two_m(lambda ratio: ratio), "half as far"),
    (lambda x, g, b, f, s, t: samplers.ddim_step(x, g + 0.5 * (s - t) / (f - s) * (g - b), s, t), "in log sigma"),
    (lambda x, g, b, f, s, t: g, "state ends elsewhere"),
]


def _one_by_one(s, sigmas):
    keep = [1 + (t - u) * u / (s**2 + u**2) for u, t in zip(sigmas, sigmas[1:], strict=False)]
    return np.prod(keep), np.sqrt((s**2 + sigmas[-1] ** 2) / (s**2 + sigmas[0] ** 2))


RIGHT["C3.b"] = [
    _one_by_one,
    lambda s, u: [np.prod((s**2 + u[:-1] * u[1:]) / (s**2 + u[:-1] ** 2)), np.hypot(s, u[-1]) / np.hypot(s, u[0])],
    lambda s, u: jnp.asarray(_one_by_one(s, u)),
]
WRONG["C3.b"] = [
    (lambda s, u: _one_by_one(s, u)[::-1], "Euler's factor is too"),
    (lambda s, u: (_one_by_one(s, u)[1],) * 2, "Euler's factor is too large"),
    (lambda s, u: (_one_by_one(s, u)[0],) * 2, "exact factor is too small"),
    (lambda s, u: (u[-1] / u[0], _one_by_one(s, u)[1]), "Euler's factor is too"),  # data of one point
    (lambda s, u: (_one_by_one(s, u)[0], u[-1] / u[0]), "exact factor is too"),
    (lambda s, u: (_one_by_one(s, u)[0], (s**2 + u[-1] ** 2) / (s**2 + u[0] ** 2)), "exact factor is too"),  # variances
    (lambda s, u: _one_by_one(s, u)[0], "two numbers"),
]

# C4 Schedules and grids -------------------------------------------------------------------------


def _even(spacing, back):
    return lambda top, bottom, n: np.append(back(np.linspace(spacing(top), spacing(bottom), n)), 0.0)


RIGHT["C4.a"] = [
    _even(np.log, np.exp),
    lambda top, bottom, n: [*np.geomspace(top, bottom, n), 0],
    lambda top, bottom, n: jnp.asarray([top * (bottom / top) ** (i / (n - 1)) for i in range(n)] + [0.0]),
]
WRONG["C4.a"] = [
    (_even(lambda s: s, lambda s: s), "even in sigma"),
    (_even(lambda s: s ** (1 / 3), lambda s: s**3), "by the same amount"),  # the paper's
    (_even(np.arctan, np.tan), "by the same amount"),  # the cosine's
    (lambda top, bottom, n: np.geomspace(top, bottom, n), "the last of them is 0"),
    (lambda top, bottom, n: np.geomspace(top, bottom, n + 1), "the last number is 0"),
    (lambda top, bottom, n: np.append(np.geomspace(bottom, top, n), 0.0), "positive and fall"),
    (lambda top, bottom, n: np.append(np.geomspace(top, bottom, n + 1)[:-1], 0.0), "the last before 0"),
    (lambda top, bottom, n: np.append(np.log(np.geomspace(top, bottom, n)), 0.0), "positive and fall"),
]

RIGHT["C4.b"] = [(0.2, 0.1), [0.198, 0.1], jnp.asarray([0.2, 0.1])]
WRONG["C4.b"] = [
    ((0.2, 0.2), "the width is too large"),  # the data's
    ((0.1, 0.08), "level is too small"),
    ((1.0, 0.04), "level is too large"),
    ((0.2, 0.14), "the width is too large"),  # half of the variance
    ((0.04, 0.04), "level is too small"),  # the variance for the deviation
    ((0.01, 0.01), "level is too small"),
    ((0.0, 0.0), "level is too small"),
    (0.2, "two numbers"),
]

# C5 What a network predicts ---------------------------------------------------------------------


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


RIGHT["C5.a"] = [
    _karras,
    lambda sigma, s: jnp.asarray(_karras(sigma, s)),
    lambda sigma, s: [1 / (1 + (sigma / s) ** 2), 1 / np.hypot(1 / s, 1 / sigma), 1 / np.hypot(s, sigma)],
]
WRONG["C5.a"] = [
    (_changed(skip=lambda sigma, s, value: 1 - value), "the other share"),
    (_changed(out=lambda sigma, s, value: -value), "positive sign"),
    (_changed(out=lambda sigma, s, value: sigma), "c_out is too large"),  # that of the noise
    (_changed(out=lambda sigma, s, value: value**2), "c_out is too"),
    (_changed(given=lambda sigma, s, value: 1 / (s + sigma)), "c_in is too small"),  # deviations added
    (_changed(given=lambda sigma, s, value: value**2), "c_in is too"),
    (lambda sigma, s: _karras(sigma, 1.0), "c_skip is too"),  # s forgotten
    (lambda sigma, s: _karras(sigma, s)[:2], "three numbers"),
]


def _loss_weights(sigma, s):
    return 1 / sigma**2, 1 + 1 / sigma**2, 1 / s**2 + 1 / sigma**2


RIGHT["C5.b"] = [
    _loss_weights,
    lambda sigma, s: jnp.asarray(_loss_weights(sigma, s)),
    lambda sigma, s: [sigma**-2, (1 + sigma**2) / sigma**2, 1 / _karras(sigma, s)[1] ** 2],
]
WRONG["C5.b"] = [
    (lambda sigma, s: 1 / np.asarray(_loss_weights(sigma, s)), "divided by it"),
    (lambda sigma, s: np.sqrt(_loss_weights(sigma, s)), "square the factor"),
    (lambda sigma, s: (1 / sigma, *_loss_weights(sigma, s)[1:]), "weight for eps is too"),
    (lambda sigma, s: (_loss_weights(sigma, s)[0],) * 3, "weight for v is too small"),
    (lambda sigma, s: (*_loss_weights(sigma, s)[:2], _loss_weights(sigma, 1.0)[1]), "weight for Karras"),
    (lambda sigma, s: (1.0, 1.0, 1.0), "weight for eps is too"),
    (lambda sigma, s: _loss_weights(sigma, s)[:2], "three weights"),
]
