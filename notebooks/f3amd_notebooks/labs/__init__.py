"""Labs of the course, notebook C13: an answer is tried on denoisers that nobody shows, and judged by what it does.

A stub ends in `lab("L1", answer)`, which prints what the judge measured, known samplers or guesses beside it, and one
sentence. What is tried is drawn from a seed when it is judged, so that nothing can be tuned to it.
"""

from __future__ import annotations

import numpy as np
import pandas as pd
from f3amd_lib.ground.names import nearest_hint
from f3amd_lib.ground.profiles import refuse_unknown_parameters

from f3amd_notebooks.exercises.judging import NotAnswered, is_missing
from f3amd_notebooks.labs import conditions, denoisers, sampling
from f3amd_notebooks.labs.judging import Verdict

LABS = {
    "L1": sampling.eight_evaluations,
    "L2": sampling.find_the_grid,
    "L3": sampling.fresh_noise,
    "L4": sampling.to_a_tolerance,
    "L5": denoisers.repair,
    "L6": denoisers.train_a_network,
    "L7": denoisers.how_likely,
    "L8": conditions.guide_without_overshoot,
    "L9": conditions.one_toe_is_measured,
    "L10": conditions.which_digit,
}
"""By number, a judge of (answer, random generator)."""


def judge(number: str, answer, seed: int) -> Verdict:
    """Return what a judge measured, and what is wrong with an answer, or None if it passes.

    Args:
      number: of the lab, "L1".
      answer: the function that the lab asks for. One that is missing or fails when it is tried gets a verdict, too.
      seed: of what is tried.

    Raises:
      ValueError: for a number that no lab has.
    """
    if number not in LABS:
        raise ValueError(f"no lab {number!r}{nearest_hint(number, LABS)}")
    if is_missing(answer):
        return Verdict(pd.DataFrame(), "put your answer in the place of `...`")
    # An answer may be anything, and may divide by 0 on its way to a verdict.
    try:
        with np.errstate(all="ignore"):
            return LABS[number](answer, np.random.default_rng(seed))
    except NotAnswered as error:
        return Verdict(pd.DataFrame(), str(error))
    except Exception as error:
        return Verdict(pd.DataFrame(), f"this cannot be tried ({type(error).__name__}: {error})")


def lab(number: str, answer, seed: int | None = None) -> None:
    """Print a judge's table and verdict; see `judge`. A seed that is not given is drawn, and printed with the table."""
    refuse_unknown_parameters()
    seed = int(np.random.default_rng().integers(10_000)) if seed is None else seed
    found = judge(number, answer, seed)
    if len(found.table):
        print(f"{number} under seed {seed}\n")
        print(found.table.to_string(index=False, float_format="{:.3g}".format), end="\n\n")
    print(f"{number}: {'passed' if found.fault is None else f'not yet: {found.fault}'}")
