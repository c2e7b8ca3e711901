"""Labs: the solutions of C14 pass under any seed, wrong answers fail for the reason that is theirs."""

import functools
import re
from pathlib import Path

import jax
import nbformat
import numpy as np
import pytest
from f3amd_notebooks.labs import LABS, judge
from f3amd_notebooks.labs.judging import counted, grid_of, hidden_data, known

from f3amd_lib.diffusion import samplers
from f3amd_lib.diffusion.predictions import guided

COURSE = Path(__file__).resolve().parents[1] / "notebooks" / "course"


def cells(name: str, tag: str) -> dict[str, str]:
    """By lab, the code of each cell with a tag."""
    whole = nbformat.v4.reads((COURSE / name).read_text("utf-8")).cells
    found = [cell.source for cell in whole if tag in cell.metadata.get("tags", [])]
    return {re.search(r'lab\("(L\d+)", answer', code)[1]: code for code in found}


STUBS, SOLVED = cells("13_labs.ipynb", "lab"), cells("14_lab_solutions.ipynb", "lab-solution")


@functools.cache
def of(number: str) -> dict:
    """What the cell of a solution defines."""
    space = {"__name__": "__main__"}
    exec(compile(re.sub(r"\nlab\(.*", "", SOLVED[number]), number, "exec"), space)
    return space


def solution(number: str, **changed):
    """The answer of a solution, with other settings."""
    return functools.partial(of(number)["answer"], **changed)


def test_every_lab_has_a_stub_a_solution_and_wrong_answers():
    assert list(STUBS) == list(SOLVED) == list(LABS) == list(WRONG)


@pytest.mark.parametrize("number", LABS)
def test_a_stub_is_not_yet_and_nobody_falls_over_nonsense(number, capsys):
    exec(compile(STUBS[number], number, "exec"), {"__name__": "__main__"})
    assert re.fullmatch(rf"{number}: not yet: your function returns nothing yet\n", capsys.readouterr().out)
    for nothing in (None, ..., "no", lambda *given: np.zeros(3), lambda *given: np.nan, lambda *given: given[99]):
        assert judge(number, nothing, 0).fault


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 20])
@pytest.mark.parametrize("number", LABS)
def test_a_solution_passes_whatever_is_drawn(number, seed):
    found = judge(number, of(number)["answer"], seed)
    assert found.fault is None and len(found.table)


WRONG: dict[str, list] = {}
"""By lab: wrong answers, and a word of the reason."""


def two_m(grid):
    """The solution of L1 on a grid of (top, bottom, evaluations)."""

    def walk(denoise, x, top, bottom, evaluations):
        levels, before = grid(top, bottom, evaluations), None
        for sigma, lower in zip(levels[:-1], levels[1:], strict=True):
            guess = denoise(x, sigma)
            lean = 0 if before is None else 0.5 * np.log(sigma / lower) / np.log(before[1] / sigma)
            mean = guess + lean * (guess - before[0]) if before else guess
            x, before = lower / sigma * x + (1 - lower / sigma) * mean, (guess, sigma)
        return x

    return walk


def on_log_grid(name):
    return lambda denoise, x, top, bottom, count: known(name, denoise, x, np.geomspace(top, bottom, count + 1))


WRONG["L1"] = [
    (on_log_grid("ddim"), "order"),
    (on_log_grid("heun"), "evaluations"),
    (lambda denoise, x, top, bottom, count: denoise(x, top), "spread"),
    (two_m(lambda top, bottom, count: np.geomspace(top, 40.0, count + 1)), "noise is left"),
    (two_m(lambda top, bottom, count: grid_of(3.0, count, top, bottom)), "lie badly"),
]


def by_angles(scale, top, count, power=1.0):
    return np.append(scale * np.tan(np.arctan(top / scale) * np.linspace(1, 0, count + 1) ** power)[:-1], 0.0)


WRONG["L2"] = [
    (lambda scale, top, count: np.append(np.geomspace(top, 0.01, count), 0.0), "whatever the scale"),
    (lambda scale, top, count: by_angles(scale, top, count)[::-1], "first level"),
    (lambda scale, top, count: np.append(np.geomspace(top, 1e-4 * scale, count), 0.0), "too low"),
    (lambda scale, top, count: np.append(np.linspace(top, scale, count), 0.0), "too high"),
    (lambda scale, top, count: by_angles(scale, top, count, 1.4), "equally hard"),
]


def a_gaussian_as_wide(denoise, x, grid, rng):
    x = of("L3")["answer"](denoise, x, grid, rng)
    return x.mean(0) + x.std() * rng.standard_normal(x.shape)


WRONG["L3"] = [
    (lambda *given: known("ddim", *given), "hardly fresh noise"),
    (lambda *given: known("ddpm", *given), "spread is lost"),
    (lambda *given: 1.345 * known("ddpm", *given), "too wide"),
    (a_gaussian_as_wide, "away from two modes"),
    (lambda denoise, x, grid, rng: of("L3")["answer"](denoise, x, grid[[0, -2, -1]], rng), "evaluations a step"),
]


def steps(count):
    return lambda denoise, x, top, bottom, tolerance: of("L4")["walked"](denoise, x, top, bottom, count(tolerance))


WRONG["L4"] = [
    (steps(lambda tolerance: 8), "8 evaluations whatever is asked"),
    (steps(lambda tolerance: 100), "100 evaluations whatever is asked"),
    (lambda *given: of("L4")["answer"](*given[:4], 10 * given[4]), "tolerance is missed"),
    (lambda *given: of("L4")["answer"](*given[:4], 0.02 * given[4]), "too many evaluations"),
    (lambda *given: of("L4")["answer"](*given[:4], 1e-9), "more than"),
]


def shift_alone(wrong, data, rng):
    def denoise(x, sigma):
        return wrong(x, sigma) + (data - wrong(data + sigma * rng.standard_normal(data.shape), sigma)).mean(0)

    return denoise


def at_one_level(level):
    """Repaired at one level, and used at all."""

    def answer(wrong, data, rng):
        seen = np.stack([wrong(data + level * rng.standard_normal(data.shape), level), data * 0 + 1], axis=-1)
        factors = np.linalg.lstsq(seen.reshape(-1, 2), data.ravel(), rcond=None)[0]
        return lambda x, sigma: np.stack([wrong(x, sigma), x * 0 + 1], axis=-1) @ factors

    return answer


def line(data, rng):
    return lambda x, sigma: data.mean(0) + data.var() / (data.var() + sigma**2) * (x - data.mean(0))


WRONG["L5"] = [
    (lambda wrong, data, rng: wrong, "as it was before"),
    (shift_alone, "a shift is mended"),
    (lambda wrong, data, rng: lambda x, sigma: data.mean(0) + 0 * x, "low levels"),
    (lambda wrong, data, rng: line(data, rng), "`wrong` is never asked"),
    (lambda wrong, data, rng: lambda x, sigma: x, "high levels"),
    (at_one_level(1.0), "harm is left"),
]


def kernel(level):
    """The exact denoiser of the samples themselves, told another level."""

    def answer(data, rng):
        def denoise(x, sigma):
            far = np.square(x[:, None] - data).sum(-1) / (2 * level(sigma) ** 2)
            share = np.exp(far.min(1, keepdims=True) - far)
            return share @ data / share.sum(1, keepdims=True)

        return denoise

    return answer


WRONG["L6"] = [
    (line, "no better than a line"),
    (lambda data, rng: lambda x, sigma: data.mean(0) + 0 * x, "low levels"),
    (lambda data, rng: lambda x, sigma: x, "high levels"),
    (kernel(lambda sigma: sigma), "the posterior mean over the points"),
    (kernel(lambda sigma: 0.2), "high levels"),
]


def prior_alone(denoise, x, sigma, rng):
    return -0.5 * np.sum(x**2, axis=-1) / 80**2 - x.shape[1] * np.log(np.sqrt(2 * np.pi) * 80)


def turned(denoise, x, sigma, rng):
    """The change on the way with the wrong sign."""
    prior = prior_alone(denoise, 80 / np.hypot(sigma, 0.5) * x, sigma, rng)
    return 2 * prior - of("L7")["answer"](denoise, x, sigma, rng)


class Silent:
    """A generator without noise, and without probes."""

    def standard_normal(self, shape):
        return np.zeros(shape)

    def choice(self, signs, shape):
        return np.zeros(shape)


def without_norm(denoise, x, sigma, rng):
    return of("L7")["answer"](denoise, x, sigma, rng) + x.shape[1] * np.log(np.sqrt(2 * np.pi) * 80)


WRONG["L7"] = [
    (turned, "wrong sign"),
    (prior_alone, "change on the way is missing"),
    (without_norm, "prior is not whole"),
    (lambda denoise, x, sigma, rng: of("L7")["answer"](denoise, x, sigma, Silent()), "its trace, is missing"),
    (lambda *given: np.full(len(given[1]), of("L7")["answer"](*given).mean()), "single answers are not right"),
    (solution("L7", steps=5), "steps are too long"),
    (solution("L7", steps=300, probes=1), "evaluations are used"),
]


def flown(*pair):
    """A guided walk of DDIM."""

    def walk(told, free, x, w, grid, rng):
        return known("ddim", guided(*[(told, free)[place] for place in pair], w), x, grid)

    return walk


WRONG["L8"] = [
    (flown(0, 1), "variety is lost"),
    (lambda told, free, x, w, grid, rng: of("L8")["answer"](told, free, x, 1.6, grid, rng), "too wide"),
    (flown(1, 0), "wrong side"),
    (lambda told, free, x, w, grid, rng: of("L8")["answer"](told, free, x, w, grid, Silent()), "variety is lost"),
    (solution("L8", staying=45), "evaluations"),
]


def put_in(denoise, x, observed, grid, rng, *, noisy=True):
    for here, lower in zip(grid[:-1], grid[1:], strict=True):
        x = known("ddim", denoise, x, np.array([here, lower]))
        x[:, 0] = observed + noisy * lower * rng.standard_normal(len(x))
    return x


def at_the_end(denoise, x, observed, grid, rng):
    x = known("ddim", denoise, x, grid)
    x[:, 0] = observed
    return x


def mean_of_the_right(denoise, x, observed, grid, rng):
    x = of("L9")["answer"](denoise, x, observed, grid, rng)
    x[:, 1] = x[:, 1].mean()
    return x


WRONG["L9"] = [
    (lambda denoise, x, observed, grid, rng: known("ddim", denoise, x, grid), "left toe"),
    (at_the_end, "does not listen"),
    (put_in, "does not listen"),
    (mean_of_the_right, "lost its spread"),
    (solution("L9", staying=45), "evaluations"),
]


def most(denoisers, image, rng):
    return np.argmax([np.mean((denoise(image[None], 1.0) - image) ** 2) for denoise in denoisers])


WRONG["L10"] = [
    (most, "fewer than by chance"),
    (lambda denoisers, image, rng: 3, "no denoiser was asked"),
    (solution("L10", levels=(40.0,)), "mean of its digit alone"),
    (lambda ten, image, rng: np.argmin([np.abs(one(image[None], 0.3) - image).sum() for one in ten]), "little noise"),
    (solution("L10", levels=tuple(np.geomspace(0.5, 4, 21)), copies=1), "evaluations"),
]


@pytest.mark.slow
@pytest.mark.parametrize(
    "number, answer, reason",
    [pytest.param(number, *case, id=f"{number}-{case[1]}") for number in WRONG for case in WRONG[number]],
)
def test_a_wrong_answer_fails_for_its_reason(number, answer, reason):
    assert reason in (judge(number, answer, 4).fault or "passed")


def test_evaluations_are_counted_in_rows_and_not_inside_a_compiled_walk():
    scan = lambda denoise, x, *_: samplers.sample("ddim", denoise, jax.numpy.asarray(x), np.geomspace(80.0, 0.01, 9))
    assert "cannot be counted" in judge("L1", scan, 0).fault
    threefold = lambda denoise: lambda y, s: denoise(np.tile(y, (3, 1)), s)[: len(y)]
    at_once = lambda denoise, *given: of("L1")["answer"](threefold(denoise), *given)
    assert "24 evaluations" in judge("L1", at_once, 0).fault
    asked, used = counted(hidden_data(np.random.default_rng(0))[0].whole.denoise, 10, size=4)
    slope = jax.vmap(jax.grad(lambda place: asked(place[None], 0.5)[0]))(np.ones(4))
    assert slope.shape == (4,) and used() == 1 and not vars(asked)
