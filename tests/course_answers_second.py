"""Answers to the exercises of the course, 06 to 08: right forms and wrong answers."""

import jax.numpy as jnp
import numpy as np

from f3amd_lib.text.phases import guided_noise

RIGHT = {}
"""By number: the answer in different forms."""
WRONG = {}
"""By number: pairs of a wrong answer and a piece of the hint that it is to get."""

# C6 Flow matching -------------------------------------------------------------------------------


def _velocity(denoise, z, t):
    return (denoise(z / t, (1 - t) / t) - z) / (1 - t)


def _by_the_noise(denoise, z, t):
    guess = denoise(z / t, 1 / t - 1)
    return guess - (z - t * guess) / (1 - t)


RIGHT["C6.a"] = [
    _velocity,
    _by_the_noise,
    lambda denoise, z, t: jnp.asarray(denoise(z / t, 1 / t - 1)) / (1 - t) - z / (1 - t),
]
WRONG["C6.a"] = [
    (lambda denoise, z, t: -_velocity(denoise, z, t), "back to the noise"),
    (lambda denoise, z, t: (denoise(z, 1 - t) - z) / (1 - t), "the level 1 - t"),
    (lambda denoise, z, t: (denoise(z, (1 - t) / t) - z) / (1 - t), "shown z itself"),
    (lambda denoise, z, t: denoise(z / t, (1 - t) / t) - z, "way that is left"),
    (lambda denoise, z, t: (denoise(z / t, (1 - t) / t) - z) / t, "another one"),
    (lambda denoise, z, t: denoise(z / t, (1 - t) / t), "another one"),  # the guess for the velocity
    (lambda denoise, z, t: (z / t - denoise(z / t, (1 - t) / t)) * t / (1 - t), "another one"),  # dx / dsigma
]

RIGHT["C6.b"] = [
    lambda s: (1 + s**2, (1 - s) ** 2),
    lambda s: jnp.asarray([1 + s * s, 1 - 2 * s + s * s]),
    lambda s: np.array([np.hypot(1, s) ** 2, abs(s - 1) ** 2]),
]
WRONG["C6.b"] = [
    (lambda s: ((1 - s) ** 2, 1 + s**2), "by chance is too small"),
    (lambda s: (1 + s**2, 1 + s**2), "after one reflow is too large"),
    (lambda s: ((1 + s) ** 2, (1 - s) ** 2), "by chance is too large"),  # deviations added
    (lambda s: (1 + s**2, abs(1 - s)), "after one reflow is too large"),  # the length itself
    (lambda s: (1 + s**2, abs(1 - s**2)), "after one reflow is too large"),
    (lambda s: (1 + s**2, 0.0), "after one reflow is too small"),
    (lambda s: 1 + s**2, "two numbers"),
]

# C7 Guidance ------------------------------------------------------------------------------------


def _guided(x, sigma, told, free, w):
    return x - sigma * (free + w * (told - free))


RIGHT["C7.a"] = [
    _guided,
    lambda x, sigma, told, free, w: (1 - w) * (x - sigma * free) + w * (x - sigma * told),
    lambda x, sigma, told, free, w: jnp.asarray(x) - sigma * (w * jnp.asarray(told) - (w - 1) * free),
    lambda x, sigma, told, free, w: x - sigma * guided_noise(told, free, w - 1.0),
]
WRONG["C7.a"] = [
    (lambda x, sigma, told, free, w: _guided(x, sigma, told, free, w + 1), "MotionPCM's count"),
    (lambda x, sigma, told, free, w: _guided(x, sigma, free, told, w), "exchanged"),
    (lambda x, sigma, told, free, w: free + w * (told - free), "guided noise"),
    (lambda x, sigma, told, free, w: x - (free + w * (told - free)), "sigma times as large"),
    (lambda x, sigma, told, free, w: x + sigma * (free + w * (told - free)), "added once more"),
    (lambda x, sigma, told, free, w: x - sigma * told, "another one"),  # no guidance at all
    (lambda x, sigma, told, free, w: w * (x - sigma * told), "another one"),
]


def _tilted_and_guided(s, S, w):
    return (w / s**2 + (1 - w) / S**2) ** -0.5, s**w * S ** (1 - w)


RIGHT["C7.b"] = [
    _tilted_and_guided,
    lambda s, S, w: np.array([s * S / np.sqrt(w * S**2 - (w - 1) * s**2), s * (s / S) ** (w - 1)]),
    lambda s, S, w: jnp.asarray([1 / jnp.sqrt(w / s**2 + (1 - w) / S**2), S * (s / S) ** w]),
]
WRONG["C7.b"] = [
    (lambda s, S, w: _tilted_and_guided(s, S, w)[::-1], "w = 3 the width of the tilted density is too small"),
    (lambda s, S, w: (_tilted_and_guided(s, S, w)[0],) * 2, "guided samples is too large"),  # taken for the same
    (lambda s, S, w: (s / np.sqrt(w), s * (s / S) ** (w - 1)), "tilted density is too small"),  # the crowd forgotten
    (lambda s, S, w: _tilted_and_guided(s, S, w + 1), "w = 1 the width of the tilted density is too small"),
    (lambda s, S, w: (s, s), "w = 3 the width of the tilted density is too large"),  # no guidance
    (lambda s, S, w: (w * s + (1 - w) * S, s * (s / S) ** (w - 1)), "tilted density is too small"),  # widths added
    (lambda s, S, w: (_tilted_and_guided(s, S, w)[0], s / w), "guided samples is too large"),
    (lambda s, S, w: s / w, "two numbers"),
]

# C8 Consistency ---------------------------------------------------------------------------------

RIGHT["C8.a"] = [
    lambda x, sigma, edge, s: x * np.hypot(s, edge) / np.hypot(s, sigma),
    lambda x, sigma, edge, s: jnp.asarray(x) * jnp.sqrt((s**2 + edge**2) / (s**2 + sigma**2)),
    lambda x, sigma, edge, s: np.exp(0.5 * np.log((s**2 + edge**2) / (s**2 + sigma**2))) * x,
]
WRONG["C8.a"] = [
    (lambda x, sigma, edge, s: x * (s**2 + sigma * edge) / (s**2 + sigma**2), "one step of DDIM"),
    (lambda x, sigma, edge, s: x * s**2 / (s**2 + sigma**2), "best guess"),
    (lambda x, sigma, edge, s: x * s / np.hypot(s, sigma), "without noise"),
    (lambda x, sigma, edge, s: x * edge / sigma, "another place"),  # the noise alone
    (lambda x, sigma, edge, s: x * np.hypot(s, sigma) / np.hypot(s, edge), "another place"),  # upwards
    (lambda x, sigma, edge, s: x * (s**2 + edge**2) / (s**2 + sigma**2), "another place"),  # variances
]


def _consistency_target(denoise, student, x, sigma, lower, edge):
    guess = denoise(x, sigma)
    neighbour = guess + lower / sigma * (x - guess)
    return neighbour if lower <= edge else student(neighbour, lower, edge)


def _neighbour(denoise, x, sigma, lower):
    return x + (lower - sigma) * (x - denoise(x, sigma)) / sigma


RIGHT["C8.b"] = [
    _consistency_target,
    lambda d, f, x, s, lower, e: f(_neighbour(d, x, s, lower), lower, e) if lower > e else _neighbour(d, x, s, lower),
    lambda d, f, x, s, lower, e: jnp.where(
        lower > e, f(_neighbour(d, x, s, lower), lower, e), _neighbour(d, x, s, lower)
    ),
]
WRONG["C8.b"] = [
    (lambda d, f, x, s, lower, e: f(_neighbour(d, x, s, lower), lower, e), "nothing is left to ask"),
    (lambda d, f, x, s, lower, e: _neighbour(d, x, s, lower), "this is the neighbour"),
    (lambda d, f, x, s, lower, e: f(_neighbour(d, x, s, lower), s, e), "told so"),
    (lambda d, f, x, s, lower, e: f(x, lower, e), "about x itself"),
    (lambda d, f, x, s, lower, e: f(d(x, s), lower, e), "no neighbour"),
    (lambda d, f, x, s, lower, e: d(x, s), "another one"),
]
