"""What the judges of the labs share: denoisers drawn from a seed, which count their evaluations, and verdicts."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pandas as pd
from f3amd_lib.diffusion.oracles import GaussianMixture
from f3amd_lib.diffusion.samplers import SAMPLERS
from f3amd_lib.diffusion.schedules import variance_exploding

from f3amd_notebooks.exercises.judging import NotAnswered, numbers

TOP, BOTTOM = 80.0, 0.01
"""Noise levels between which hidden denoisers are walked."""


@dataclass(frozen=True)
class Verdict:
    """What a judge measured, a row a case or a sampler, and what is wrong with the answer, or None if it passes."""

    table: pd.DataFrame
    fault: str | None


def counted(denoise: Callable, most: int, size: int) -> tuple[Callable, Callable]:
    """Close over a denoiser and a count, so that an answer finds neither.

    Args:
      denoise: the exact one.
      most: asked more often, it refuses.
      size: numbers of one evaluation, points times dimensions; a call with twice as many counts twice.

    Returns:
      The denoiser to be asked, and a function that returns the evaluations until now.
    """
    used = 0

    def ask(x, sigma):
        nonlocal used
        _beneath(sigma)
        used += -(-np.size(_beneath(x)) // size)
        if used > most:
            raise NotAnswered(f"a denoiser was asked more than {most} times: more evaluations than anybody needs")
        return denoise(x, sigma)

    return ask, lambda: used


def _beneath(x):
    """Return what derivatives and maps of JAX wrap; NotAnswered while a program is being written down with x in it."""
    loaded = sys.modules.get("jax")
    while loaded and isinstance(x, loaded.core.Tracer):
        if not (hasattr(x, "primal") or hasattr(x, "batch_dim")):
            raise NotAnswered("inside jax.jit or lax.scan evaluations cannot be counted: walk in plain Python")
        x = x.primal if hasattr(x, "primal") else x.val
    return x


@dataclass(frozen=True, eq=False)
class Line:
    """A mixture whose modes lie on a line in D dimensions: along it the flow is known, across it a Gaussian's.

    Attributes:
      name: what the data are like.
      along: the mixture on the line, D = 1.
      axis: direction of the line, [D], of length 1.
    """

    name: str
    along: GaussianMixture
    axis: np.ndarray

    @property
    def whole(self) -> GaussianMixture:
        """The mixture in D dimensions."""
        return GaussianMixture(self.along.means * self.axis, self.along.width, self.along.weights)

    def flow(self, x, sigma: float, lower: float) -> np.ndarray:
        """Carry points [N, D] along the flow without error."""
        place = x @ self.axis
        across = (
            (x - place[:, None] * self.axis) * np.hypot(self.along.width, lower) / np.hypot(self.along.width, sigma)
        )
        return across + self.along.flow(place[:, None], sigma, lower) * self.axis


def hidden_data(rng: np.random.Generator) -> list[Line]:
    """Draw data of four kinds: narrow modes, wide ones, uneven ones, and two modes in 64 dimensions."""
    far, size = rng.uniform(0.8, 1.4), np.exp(rng.uniform(-0.2, 0.2, 4))
    axis = rng.standard_normal(64)
    one = np.ones(1)
    return [
        Line("narrow", GaussianMixture([-far, far], width=0.06 * size[0]), one),
        Line("wide", GaussianMixture(rng.uniform(-1, 1, 2), width=1.2 * size[1]), one),
        Line("uneven", GaussianMixture([-1.5 * far, 0.2, far], 0.2 * size[2], rng.uniform(0.5, 2.0, 3)), one),
        Line("64 dimensions", GaussianMixture([-4 * far, 4 * far], 0.5 * size[3]), axis / np.linalg.norm(axis)),
    ]


def known(name: str, denoise: Callable, x, grid, rng: np.random.Generator | None = None) -> np.ndarray:
    """Walk points down a grid with a sampler of the library, in numpy and float64."""
    sampler = SAMPLERS[name]
    for number, (sigma, lower) in enumerate(zip(grid[:-1], grid[1:], strict=True)):
        ends = sampler.last and number == len(grid) - 2
        more = [] if ends or sampler.evaluations == 1 else [denoise]
        if sampler.draws_noise:
            more = [rng.standard_normal(x.shape)]
        x = (sampler.last if ends else sampler.step)(x, denoise(x, sigma), sigma, lower, *more)
    return x


def grid_of(rho: float, count: int, top: float = TOP, bottom: float = BOTTOM) -> np.ndarray:
    """Return count + 1 levels that are even in sigma^(1 / rho); infinite rho is even in log sigma."""
    if np.isinf(rho):
        return np.geomspace(top, bottom, count + 1)
    return variance_exploding(top, bottom, rho).grid(count + 1)[:-1]


def made(denoise) -> Callable:
    """Return a denoiser that an answer made; NotAnswered if it made none."""
    if not callable(denoise):
        raise NotAnswered("your function returns nothing yet" if denoise in (None, ...) else "a function is asked for")
    return denoise


def points(found, shape: tuple[int, ...]) -> np.ndarray:
    """Read an answer that is made of finite numbers of this shape.

    Raises:
      NotAnswered: for anything else.
    """
    found = numbers(found)
    if found.shape != shape:
        raise NotAnswered(f"an array of shape {shape} is asked for, and this one has shape {found.shape}")
    if not np.isfinite(found).all():
        raise NotAnswered("not all numbers are finite")
    return found


def distance(samples, places, weights) -> float:
    """Return the Wasserstein distance of samples [N] to a density on a grid of places, [M] each."""
    rank = np.cumsum(weights)
    middle = (np.arange(len(samples)) + 0.5) / len(samples)
    return float(np.abs(np.sort(samples) - np.interp(middle, rank / rank[-1], places)).mean())


def geometric(values) -> float:
    """Return the geometric mean."""
    return float(np.exp(np.mean(np.log(np.maximum(values, 1e-300)))))
