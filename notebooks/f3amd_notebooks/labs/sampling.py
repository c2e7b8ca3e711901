"""Labs on samplers: eight evaluations, a grid, fresh noise, and a tolerance."""

from __future__ import annotations

import numpy as np
import pandas as pd
from f3amd_lib.diffusion.oracles import GaussianMixture

from f3amd_notebooks.labs.judging import (
    BOTTOM,
    TOP,
    Line,
    Verdict,
    counted,
    distance,
    geometric,
    grid_of,
    hidden_data,
    known,
    points,
)

_KNOWN = {
    "DDIM, rho 3": lambda denoise, x, count: known("ddim", denoise, x, grid_of(3.0, count)),
    "DDIM, rho 7": lambda denoise, x, count: known("ddim", denoise, x, grid_of(7.0, count)),
    "DDIM, even in log": lambda denoise, x, count: known("ddim", denoise, x, grid_of(np.inf, count)),
    "Heun, rho 3": lambda denoise, x, count: known("heun", denoise, x, grid_of(3.0, (count + 1) // 2)),
    "Heun, rho 7": lambda denoise, x, count: known("heun", denoise, x, grid_of(7.0, (count + 1) // 2)),
}
"""Samplers of the library on a number of evaluations: Heun asks twice in every step but the last."""


def _starts(data: list[Line], rng, count: int = 60):
    """Each kind of data with noise at TOP and where the exact flow carries it."""
    for line in data:
        x = TOP * rng.standard_normal((count, len(line.axis)))
        yield line, x, line.flow(x, TOP, BOTTOM)


def eight_evaluations(answer, rng: np.random.Generator) -> Verdict:
    """Judge `answer(denoise, x, top, bottom, evaluations)`, which follows the flow: the state at `bottom`."""
    cases = list(_starts(hidden_data(rng), rng))
    rows = {name: [np.abs(walk(line.whole.denoise, x, 8) - end).mean() for line, x, end in cases]
            for name, walk in _KNOWN.items()}  # fmt: skip
    errors, over, spread = {}, [], []
    for budget in (8, 32, 64, 128):
        found = []
        for line, x, end in cases:
            denoise, used = counted(line.whole.denoise, 20 * budget, x.size)
            ends = points(answer(denoise, x.copy(), TOP, BOTTOM, budget), x.shape)
            found.append(np.abs(ends - end).mean())
            over += [(budget, used())] if used() > budget else []
            spread += [ends.std() / end.std()] if budget == 8 else []
        errors[budget] = found
    rows["your sampler"] = errors.pop(8)
    order = -np.polyfit(np.log([*errors]), [np.log(geometric(found)) for found in errors.values()], 1)[0]
    table = pd.DataFrame(rows, index=[line.name for line, *_ in cases]).T
    table = table / table.loc["DDIM, rho 3"].to_numpy()
    table["all"] = [geometric(row) for row in table.to_numpy()]
    table = table.rename_axis("error, DDIM = 1").sort_values("all").reset_index()
    mine, best = (table.loc[(table.iloc[:, 0] == "your sampler") == own, "all"].min() for own in (True, False))
    fault = None
    if over:
        fault = (
            f"{over[0][1]} evaluations were used and {over[0][0]} are allowed: a second look within a step counts, "
            "and so does every copy of the points"
        )
    elif mine < best and order >= 1.5:
        pass
    elif max(spread) > 2.0:
        fault = f"noise is left: the ends are up to {max(spread):.3g} times as wide as where the flow comes to"
    elif min(spread) < 0.3:
        fault = f"the spread is lost: {min(spread):.2g} of it is left; this is a mean, and no walk"
    elif order < 1.5:
        fault = f"the fitted order is {order:.1f}: a line through two guesses costs nothing, and makes it 2"
    else:
        fault = f"the order is {order:.1f}, but eight levels lie badly: the last steps are too long on narrow data"
    return Verdict(
        table.assign(order=["" if name != "your sampler" else f"{order:.1f}" for name in table.iloc[:, 0]]), fault
    )


def find_the_grid(answer, rng: np.random.Generator) -> Verdict:
    """Judge `answer(scale, top, count)`: the count + 1 levels on which DDIM keeps most of a Gaussian's spread."""
    rows, faults = [], []
    for number in range(4):
        scale = float(np.exp(rng.uniform(*np.log([(0.03, 0.3), (2.0, 6.0)][number % 2]))))
        top, count = rng.uniform(40.0, 150.0), 4 + number
        data = GaussianMixture([0.0], width=scale)
        lost = lambda grid, data=data, top=top: (
            1 - known("ddim", data.denoise, np.ones((1, 1)), grid)[0, 0] / (data.width / np.hypot(data.width, top))
        )
        grid = points(answer(scale, top, count), (count + 1,))
        if not np.isclose(grid[0], top) or grid[-1] != 0.0:
            return Verdict(pd.DataFrame(), f"the first level is top = {top:.1f}, and the last is 0")
        if not np.all(np.diff(grid) < 0):
            return Verdict(pd.DataFrame(), "the levels have to fall, from noise to data")
        least = 1 - np.cos(np.arctan2(top, scale) / count) ** count
        row = {"data": f"width {scale:.2g}, {count} steps", "least possible": least, "your grid": lost(grid)}
        for rho in (1.0, 3.0, 7.0, np.inf):
            name = f"rho {rho:g}" if np.isfinite(rho) else "even in log"
            row[name] = lost(np.append(grid_of(rho, count - 1, top), 0.0))
        rows.append(row)
        if row["your grid"] > 1.05 * least + 1e-3:
            high, low = int(np.sum(grid[:-1] > 10 * scale)) - 1, int(np.sum(grid[:-1] < 0.1 * scale))
            blind = np.allclose(answer(2 * scale, top, count), grid)
            if blind:
                faults.append("the grid is the same whatever the scale of the data is")
            elif low > high:
                faults.append(
                    f"{low} of {count} levels lie too low, under a tenth of the data's width: all is decided there"
                )
            elif high > low:
                faults.append(
                    f"{high} of {count} levels lie too high, over ten times the data's width: D hardly moves there"
                )
            else:
                angles = np.degrees(-np.diff(np.arctan2(grid, scale)))
                worst = int(angles.argmax())
                faults.append(
                    f"steps are not equally hard: from {grid[worst]:.2g} to {grid[worst + 1]:.2g} the angle "
                    f"arctan(sigma / width) turns by {angles[worst]:.0f} degrees, elsewhere by {angles.min():.0f}"
                )
    return Verdict(pd.DataFrame(rows), faults[0] if faults else None)


_STEPS = (12, 15, 19, 24)
"""Steps of the grids of `fresh_noise`, in an order that is drawn."""


def fresh_noise(answer, rng: np.random.Generator) -> Verdict:
    """Judge `answer(denoise, x, grid, rng)`: ancestral steps down to the grid's last level that lose no spread."""
    small, wide, apart, many = np.exp(rng.uniform(*np.log([(0.1, 1.0, 0.3, 0.3), (0.3, 3.0, 0.5, 0.8)])))
    cases = [
        ("narrow", GaussianMixture([0.0], small), 4000), ("wide", GaussianMixture([0.0], wide), 4000),
        ("two modes", GaussianMixture([-1.5, 1.5], apart), 4000),
        ("64 dimensions", GaussianMixture(np.zeros((1, 64)), many), 100),
    ]  # fmt: skip
    walks = {
        "DDIM": lambda *given: known("ddim", *given), "DDPM": lambda *given: known("ddpm", *given),
        "your sampler": answer,
    }  # fmt: skip
    grids = [grid_of(np.inf, steps, rng.uniform(15, 30), rng.uniform(0.01, 0.03)) for steps in rng.permutation(_STEPS)]
    columns = [case for case, *_ in cases] + ["two modes: away", "alike", "evaluations a step"]
    rows = {name: dict.fromkeys(columns, 0.0) | {"evaluations a step": 1.0} for name in walks}
    for (case, data, count), grid in zip(cases, grids, strict=True):
        places = np.linspace(-20, 20, 8001)
        density = np.exp(data.log_density(places[:, None], grid[-1])) if case == "two modes" else None
        expected = np.sqrt(data.means.var(0).mean() + data.width**2 + grid[-1] ** 2)
        for name, walk in walks.items():
            state = data.sample(rng, count)
            state = state + grid[0] * rng.standard_normal(state.shape)
            denoise, used = counted(data.denoise, 8 * len(grid), state.size)
            seeds = rng.integers(2**31, size=2)
            one, two = (points(walk(denoise, state.copy(), grid, np.random.default_rng(s)), state.shape) for s in seeds)
            row, asked = rows[name], used() / 2 / (len(grid) - 1)
            row[case] = one.std() / expected
            row["alike"] = max(row["alike"], float(np.corrcoef(one.ravel(), two.ravel())[0, 1]))
            row["evaluations a step"] = max(row["evaluations a step"], asked, key=lambda asked: abs(asked - 1))
            if density is not None:
                row["two modes: away"] = distance(one[:, 0], places, density) / expected
    table = pd.DataFrame(rows).T.rename_axis("width left").reset_index()
    mine = rows["your sampler"]
    asked, alike, away = (mine[name] for name in ("evaluations a step", "alike", "two modes: away"))
    left = {case: mine[case] for case in columns[:4]}
    case = max(left, key=lambda case: abs(np.log(left[case])))
    fault = None
    if asked != 1:
        fault = f"{asked:.2g} evaluations a step: every step asks once, and the fresh noise comes without asking again"
    elif alike > 0.2:
        fault = f"two walks from one state end alike (correlation {alike:.2f}): there is hardly fresh noise in it"
    elif left[case] < 0.95:
        fault = (
            f"spread is lost, {left[case]:.0%} of the width is left for {case} data: D's own doubt is missing, "
            "and E[D x] = E[x0 x0] tells how large it is"
        )
    elif left[case] > 1.05:
        fault = f"the samples are too wide, {left[case]:.0%} for {case} data: more noise is added than was taken away"
    elif away > 0.1:
        fault = f"the width is right and the samples are not: they lie {away:.2f} widths away from two modes"
    return Verdict(table, fault)


def to_a_tolerance(answer, rng: np.random.Generator) -> Verdict:
    """Judge `answer(denoise, x, top, bottom, tolerance)`: as close to the flow as is asked for, and no closer."""
    rows, faults = [], []
    for line, x, end in _starts(hidden_data(rng), rng, 40):
        for tolerance in (0.1, 0.0003):
            denoise, used = counted(line.whole.denoise, 12_000, x.size)
            ends = points(answer(denoise, x.copy(), TOP, BOTTOM, tolerance), x.shape)
            error = lambda ends, end=end: float(np.abs(ends - end).mean())
            row = {"data": line.name, "tolerance": tolerance, "error": error(ends), "evaluations": used()}
            for name in ("DDIM, even in log", "Heun, rho 7"):
                tried = (count for count in (8, 16, 32, 64, 128, 256, 512)
                         if error(_KNOWN[name](line.whole.denoise, x, count)) <= tolerance)  # fmt: skip
                row[name] = next(tried, np.inf)
            rows.append(row)
            where = f"for {line.name} data at {tolerance:g}"
            if row["error"] > tolerance:
                faults.append((0, f"the tolerance is missed: {where} the error is {row['error']:.2g}"))
            elif used() > 4 * row["Heun, rho 7"]:
                faults.append((1, f"too many evaluations, {used()} {where}: Heun needs {row['Heun, rho 7']} at most"))
    spent = [row["evaluations"] for row in rows]
    if faults and len(set(spent)) == 1:
        return Verdict(pd.DataFrame(rows), f"{spent[0]} evaluations whatever is asked: {min(faults)[1]}")
    return Verdict(pd.DataFrame(rows), min(faults)[1] if faults else None)
