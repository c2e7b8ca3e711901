"""Answers to the exercises of the course, 06 to 10: right forms and wrong answers."""

import jax.numpy as jnp
import numpy as np

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
