"""Exercises of the course's notebook 04: grids of noise levels."""

from __future__ import annotations

import numpy as np
from f3amd_lib.diffusion.oracles import GaussianMixture
from f3amd_lib.diffusion.schedules import log_snr_from_sigma, variance_exploding

from f3amd_notebooks.exercises.judging import OTHER_ORDER, NotAnswered, agree, numbers, read, reordered, sample, too


def _log_snr_grid(answer) -> str | None:
    for top, bottom, count in ((100.0, 0.01, 3), (128.0, 0.01, 4), (80.0, 0.002, 18)):
        found = numbers(answer(top, bottom, count))
        if found.shape != (count + 1,):
            raise NotAnswered(f"for {count} levels give {count + 1} numbers: the last of them is 0")
        if found[-1] != 0.0:
            return "the last number is 0, where the sampler ends"
        levels = found[:-1]
        if not np.all(levels > 0) or not np.all(np.diff(levels) < 0):
            return "noise levels are positive and fall"
        if not agree(levels[[0, -1]], [top, bottom], rtol=1e-4):
            return f"the first level is {top:g}, and the last before 0 is {bottom:g}"
        if agree(found, variance_exploding(top, bottom, 1.0).grid(count), rtol=1e-4):
            return "this is even in sigma; the log-SNR is -2 log sigma"
        if np.ptp(np.diff(log_snr_from_sigma(levels))) > 1e-3:
            return "the log-SNR does not rise by the same amount from level to level"
    return None


def _two_levels(answer) -> str | None:
    found = read(answer, (2,), "two numbers are asked for: the level and the width of the samples")
    data, count = GaussianMixture([0.0], width=0.2), np.ones((1, 1))
    # The walk is linear: from the state sigma_max it ends at the samples' width. 1e6 stands for endless.
    width = lambda level: float(sample("ddim", data.denoise, 1e6 * count, np.array([1e6, level, 0.0]))[0, 0])
    tried = np.geomspace(0.01, 5.0, 2001)
    widths = [0.04 * level / (0.04 + level**2) for level in tried]  # to find the place; the walk itself judges
    level = tried[int(np.argmax(widths))]
    if reordered(found, (level, width(level)), rtol=0.02):
        return f"{OTHER_ORDER}: the level comes first, then the width"
    if not agree(found[0], level, rtol=0.02):
        kept = f" (its samples are {width(found[0]):.3f} wide)" if found[0] > 0 else ""
        return f"the level is {too(found[0], level)}{kept}; x = sigma_2 eps goes in, and a share of x comes out"
    if not agree(found[1], width(level), rtol=0.02):
        return f"the level is right, but the width is {too(found[1], width(level))}; put the level into D"
    return None


CHECKS = {"C4.a": _log_snr_grid, "C4.b": _two_levels}
"""By number, a function of the answer that returns None if it is right, else a hint."""
