"""Answers to the exercises of the course, 09: right forms and wrong answers."""

import jax.numpy as jnp
import numpy as np

RIGHT = {}
"""By number: the answer in different forms."""
WRONG = {}
"""By number: pairs of a wrong answer and a piece of the hint that it is to get."""

# C9 Likelihood ----------------------------------------------------------------------------------


def _rates(x, x0_hat, jacobian, sigma):
    return (x - x0_hat) / sigma, -(len(x) - np.trace(jacobian)) / sigma


def _by_the_divergence(x, x0_hat, jacobian, sigma):
    slope = (np.eye(len(x)) - jacobian) / sigma
    return (x - x0_hat) / sigma, [-np.trace(slope)]


def _second(change):
    """An answer with the right velocity and another rate of the log-density."""
    return lambda x, x0_hat, jacobian, sigma: ((x - x0_hat) / sigma, change(len(x), np.trace(jacobian), sigma))


RIGHT["C9.a"] = [
    _rates,
    _by_the_divergence,
    lambda x, x0_hat, jacobian, sigma: [jnp.asarray(x - x0_hat) / sigma, (jnp.trace(jacobian) - x.size) / sigma],
    # By eigenvalues: each direction gains volume on its own.
    lambda x, x0_hat, jacobian, sigma: ((x - x0_hat) / sigma, np.sum(np.linalg.eigvalsh(jacobian) - 1) / sigma),
]
WRONG["C9.a"] = [
    (lambda x, x0_hat, jacobian, sigma: ((x0_hat - x) / sigma, 0.0), "leads down to the data"),
    (lambda x, x0_hat, jacobian, sigma: (x - x0_hat, 0.0), "velocity is not yet right"),
    (_second(lambda d, trace, sigma: (d - trace) / sigma), "this is the divergence"),
    (_second(lambda d, trace, sigma: trace - d), "unit of log sigma"),
    (_second(lambda d, trace, sigma: trace / sigma), "one for each dimension"),
    (_second(lambda d, trace, sigma: (trace - 1) / sigma), "not 1"),
    (_second(lambda d, trace, sigma: -(d - trace) / sigma**2), "another rate"),
    # The chance of the path itself: score times velocity forgets that the density changes where nothing moves.
    (lambda x, x0_hat, jacobian, sigma: ((x - x0_hat) / sigma, -np.sum((x - x0_hat) ** 2) / sigma**3), "another rate"),
    (lambda x, x0_hat, jacobian, sigma: (x - x0_hat) / sigma, "two things"),
]


def _off_diagonal(matrix):
    return matrix - np.diag(np.diag(matrix))


RIGHT["C9.b"] = [
    lambda matrix: (np.sqrt(2 * np.sum(_off_diagonal(matrix) ** 2)), np.sqrt(2 * np.sum(matrix**2))),
    lambda matrix: np.sqrt(2.0) * np.array([np.linalg.norm(_off_diagonal(matrix)), np.linalg.norm(matrix)]),
    lambda matrix: jnp.sqrt(
        jnp.array([4 * jnp.sum(jnp.triu(matrix, 1) ** 2), 2 * jnp.sum(jnp.linalg.eigvalsh(jnp.asarray(matrix)) ** 2)])
    ),
]
WRONG["C9.b"] = [
    (lambda matrix: RIGHT["C9.b"][0](matrix)[::-1], "other order"),
    (lambda matrix: np.square(RIGHT["C9.b"][0](matrix)), "these are the variances"),
    (lambda matrix: (np.linalg.norm(_off_diagonal(matrix)), np.linalg.norm(matrix)), "a factor is missing"),
    (lambda matrix: [np.sqrt(2) * np.linalg.norm(matrix)] * 2, "random signs the spread is too large"),
    (lambda matrix: [np.sqrt(2) * np.linalg.norm(_off_diagonal(matrix))] * 2, "normal probe the spread is too small"),
    (
        lambda matrix: (2 * np.linalg.norm(np.triu(matrix, 1)), np.linalg.norm(matrix)),
        "normal probe the spread is too small",
    ),
    (lambda matrix: (0.0, np.sqrt(2) * abs(np.trace(matrix))), "random signs the spread is too small"),
    (lambda matrix: np.trace(matrix), "two numbers"),
]

# C10 Rounds -------------------------------------------------------------------------------------


def _one_by_one(a, beta, rounds):
    error = 0.0
    for _ in range(rounds):
        error = a * error + beta
    return error


RIGHT["C10.a"] = [
    _one_by_one,
    lambda a, beta, rounds: beta * rounds if a == 1 else beta * (a**rounds - 1) / (a - 1),
    lambda a, beta, rounds: jnp.asarray([beta * sum(a**k for k in range(rounds))]),
    # The power of a matrix that carries the error and a 1.
    lambda a, beta, rounds: np.linalg.matrix_power(np.array([[a, beta], [0.0, 1.0]]), rounds)[0, 1],
]
WRONG["C10.a"] = [
    (lambda a, beta, rounds: rounds * beta, "sum of equal faults"),
    (lambda a, beta, rounds: beta * a**rounds, "one fault that went through"),
    (lambda a, beta, rounds: beta / (1 - a), "where a stable rollout ends"),
    (lambda a, beta, rounds: a * _one_by_one(a, beta, rounds), "a round off"),
    (lambda a, beta, rounds: _one_by_one(a, beta, rounds + 1), "a round off"),
    (lambda a, beta, rounds: beta * (np.float64(a) ** rounds - 1) / (np.float64(a) - 1 + 1e-300), "for a = 1"),
    (lambda a, beta, rounds: _one_by_one(a, beta, rounds) if rounds else beta, "no error yet"),
    (lambda a, beta, rounds: beta * a ** (rounds - 1), "write down the first three"),
    (
        lambda a, beta, rounds: rounds * beta if a == 1 else beta * (abs(a) ** rounds - 1) / (a - 1),
        "a = -0.5",
    ),  # its sign
]


def _share(q, sigma_max):
    return q / np.hypot(q, sigma_max)


RIGHT["C10.b"] = [
    lambda a, q, sigma_max: (a * (1 - _share(q, sigma_max)), _share(q, sigma_max) * sigma_max),
    lambda a, q, sigma_max: jnp.array([a - a / jnp.hypot(1, sigma_max / q), 1 / jnp.hypot(1 / q, 1 / sigma_max)]),
    lambda a, q, sigma_max: np.array([a, sigma_max]) * [1 - _share(q, sigma_max), _share(q, sigma_max)],
]
WRONG["C10.b"] = [
    (lambda a, q, sigma_max: RIGHT["C10.b"][0](a, q, sigma_max)[::-1], "other order"),
    (lambda a, q, sigma_max: (a, q), "this gain is the data's"),
    (lambda a, q, sigma_max: (a * _share(q, sigma_max), q), "what is lost of the gain"),
    (lambda a, q, sigma_max: (a * (1 - _share(q, sigma_max) ** 2), q), "flow keeps"),  # shares of variances
    (lambda a, q, sigma_max: (a * sigma_max / np.hypot(q, sigma_max), q), "flow keeps"),
    (lambda a, q, sigma_max: (a * (1 - _share(q, sigma_max)), q), "this width is the data's"),
    (lambda a, q, sigma_max: (a * (1 - _share(q, sigma_max)), sigma_max), "the noise is too large"),
    (lambda a, q, sigma_max: a * (1 - _share(q, sigma_max)), "two numbers"),
]
