"""Labs on denoisers: one that is wrong, one that is trained, and what one knows of a density."""

from __future__ import annotations

from time import process_time

import numpy as np
import pandas as pd
from f3amd_lib.diffusion.oracles import GaussianMixture

from f3amd_notebooks.labs.judging import Line, Verdict, counted, hidden_data, made, points


def _spoiled(line: Line, fault: str, rng: np.random.Generator):
    """Return a denoiser that is wrong at every level, in one way."""
    right, scale = line.whole.denoise, float(line.whole.sample(rng, 500).std())
    size = rng.uniform(0.25, 0.45)
    shift = size * scale * rng.choice([-1.0, 1.0], len(line.axis))
    middle = line.whole.weights @ line.whole.means
    return {
        "shifted": lambda x, sigma: right(x, sigma) + shift,
        "shrunk": lambda x, sigma: (1 - size) * right(x, sigma),
        "timid": lambda x, sigma: right(x, sigma) + size * scale / np.hypot(scale, sigma) * (x - right(x, sigma)),
        "bold": lambda x, sigma: middle + (1 + size) * (right(x, sigma) - middle) + 0.5 * shift,
    }[fault]


def repair(answer, rng: np.random.Generator) -> Verdict:
    """Judge `answer(wrong, data, rng)`, a denoiser: how much of the harm is left, at every level."""
    faults, rows, levels = rng.permutation(["shifted", "shrunk", "timid", "bold"]), [], (0.1, 0.3, 1.0, 3.0, 10.0)
    same, shifted, unasked = True, True, None
    for line, fault in zip(hidden_data(rng), faults, strict=True):
        data, tried = line.whole.sample(rng, 3000), line.whole.sample(rng, 300)
        wrong = _spoiled(line, fault, rng)
        ask, asked = counted(wrong, 2**62, data.size)
        mended = made(answer(ask, data.copy(), np.random.default_rng(rng.integers(2**31))))
        scale, row = data.std(), {"data": line.name, "fault": fault}
        for level in levels:
            x = tried + level * scale * rng.standard_normal(tried.shape)
            right = line.whole.denoise(x, level * scale)
            found = points(mended(x.copy(), level * scale), x.shape)
            moved = found - wrong(x, level * scale)
            same, shifted = same and np.allclose(moved, 0), shifted and np.ptp(moved, axis=0).max() < 1e-6 * scale
            harm = lambda guess, right=right: float(np.sqrt(np.mean((guess - right) ** 2)))
            row[f"left at {level:g}"] = harm(found) / max(harm(wrong(x, level * scale)), 0.1 * scale)
        rows.append(row)
        unasked = unasked or (None if asked() else line.name)
    table = pd.DataFrame(rows)
    left = table[[f"left at {level:g}" for level in levels]]
    worst, kinds, sentence = left.max(), left.max(axis=1), None
    if (left > 0.6).any(axis=None):
        low, middle, high = worst.iloc[:2].max(), worst.iloc[2], worst.iloc[3:].max()
        case = table.loc[kinds.idxmax()]
        name = f"the {case['fault']} denoiser of {case['data']} data"
        if same:
            sentence = "the denoiser is as wrong as it was before"
        elif shifted:
            sentence = f"a shift is mended and nothing else: {kinds.max():.0%} of the harm is left for {name}"
        elif low > max(middle, high):
            sentence = f"harm is left at low levels, {low:.0%} of it for {name}: there D has to follow x closely"
        elif high > max(middle, low):
            sentence = (
                f"harm is left at high levels, {high:.0%} of it for {name}: there D is nearly the mean of the data"
            )
        else:
            sentence = f"harm is left at all levels, up to {kinds.max():.0%} of it for {name}"
        if unasked:
            sentence += f"; `wrong` is never asked for {unasked} data"
    return Verdict(table, sentence)


def train_a_network(answer, rng: np.random.Generator) -> Verdict:
    """Judge `answer(data, rng)`, a trained denoiser of data in the plane: its error beyond the least, by level."""
    turn = rng.uniform(0, 2 * np.pi)
    angle = turn + np.arange(5) * 2 * np.pi / 5
    mixture = GaussianMixture(np.stack([np.cos(angle), np.sin(angle)], axis=1) + rng.uniform(-0.3, 0.3, 2), 0.15)
    data, tried, levels = mixture.sample(rng, 400), mixture.sample(rng, 1000), (0.1, 0.3, 1.0, 4.0)
    began = process_time()
    denoise = made(answer(data.copy(), np.random.default_rng(rng.integers(2**31))))
    points(denoise(tried.copy(), 1.0), tried.shape)
    took = process_time() - began
    middle, spread = data.mean(0), data.std()
    linear = lambda x, sigma: middle + spread**2 / (spread**2 + sigma**2) * (x - middle)

    guesses = {
        "mean of the data": lambda x, sigma: middle + 0 * x,
        "x itself": lambda x, sigma: x,
        "best line": linear,
        "mean over the points": GaussianMixture(data, 1e-6).denoise,  # as if they were all that there is
        "your network": denoise,
    }
    rows = {}
    for name, guess in guesses.items():
        noise = np.random.default_rng(0)
        states = [tried + level * noise.standard_normal(tried.shape) for level in levels]
        errors = [points(guess(x.copy(), level), x.shape) - mixture.denoise(x, level)
                  for x, level in zip(states, levels, strict=True)]  # fmt: skip
        rows[name] = np.sqrt(np.mean(np.square(errors), axis=(1, 2)))
    table = pd.DataFrame(rows, index=[f"error at {level:g}" for level in levels]).T.rename_axis("denoiser")
    mine, of_points = rows["your network"], rows["mean over the points"][0]
    share = mine / (rows["best line"] + 0.03)  # at the highest level even the line is right
    fault = None
    if took > 40:
        fault = f"training took {took:.1f} s of processor time, all threads added, and 40 are allowed"
    elif share[-1] > max(2.0, share[0]):
        fault = f"this is wrong at high levels, {share[-1]:.1f} of the line's error at 4: scale what goes in"
    elif share[0] > 1.0:
        fault = f"this is wrong at low levels, {share[0]:.1f} of the line's error at 0.1: give x back"
    elif max(share[1:3]) > 0.6:
        fault = f"this is no better than a line, {max(share[1:3]):.0%} of its error where modes are told apart"
    elif mine[0] > 0.8 * of_points:
        fault = (
            f"at 0.1 this errs by {mine[0]:.3f}, and the posterior mean over the points by {of_points:.3f}: "
            "give x back, so that the network has to learn the small rest alone"
        )
    return Verdict(table.reset_index(), fault)


def how_likely(answer, rng: np.random.Generator) -> Verdict:
    """Judge `answer(denoise, x, sigma, rng)`: the log-density of states at a level, in nats, [N]."""
    level, rows, faults = 0.05, [], []
    one, two = hidden_data(rng)[2:]
    plane = GaussianMixture(rng.standard_normal((3, 2)), rng.uniform(0.3, 0.5))
    for name, data in (("uneven", one.whole), ("plane", plane), ("64 dimensions", two.whole)):
        x = data.sample(rng, 12)
        x = x + level * rng.standard_normal(x.shape)
        size, right, (denoise, used) = x.shape[1], data.log_density(x, level), counted(data.denoise, 3000, x.size)
        found = points(answer(denoise, x.copy(), level, np.random.default_rng(rng.integers(2**31))), (len(x),))
        off = (found - right) / size
        mean, scatter, whole = off.mean(), off.std(), np.sqrt(np.mean(off**2))
        row = {"data": name, "exact (nats)": right.mean(), "yours": found.mean(), "off a dimension": mean}
        rows.append(row | {"scatter": scatter, "root of squares": whole, "evaluations": used()})
        where = f"{name}: {whole:.2f} nats a dimension off (mean {mean:.2f}, scatter {scatter:.2f})"
        # Without the trace all answers are too large by the entropy that data add to the noise.
        untraced = -0.5 - np.log(np.sqrt(2 * np.pi) * level) - right.mean() / size
        if used() > 1000:
            faults.append(f"{used()} evaluations are used, 1000 are allowed")
        elif whole < 0.08:
            continue
        elif mean < -8:
            faults.append(f"{where}: the change on the way is counted with the wrong sign")
        elif mean < -2.5:
            faults.append(f"{where}: the change on the way is missing; volume grows as noise does")
        elif abs(mean - untraced) < 0.4:
            faults.append(f"{where}: the denoiser's part of the divergence, its trace, is missing")
        elif mean > 0.7:
            faults.append(f"{where}: the prior is not whole: a Gaussian of deviation top has log(sqrt(2 pi) top) in it")
        elif scatter > abs(mean):
            faults.append(
                f"{where}: single answers are not right. Is the Gaussian at the top whole, the climb high enough, "
                "are there probes enough, does the trace depend on x?"
            )
        else:
            faults.append(f"{where}: the steps are too long")
    return Verdict(pd.DataFrame(rows), faults[0] if faults else None)
