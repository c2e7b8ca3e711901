"""Verdicts on statements, the thresholds they need, and how a claim's verdict follows from them.

A rule takes `Evidence` (our records, or the paper's own tables) and yields statements: small
sentences that are true or false of it. What a claim is worth follows from them (`combine`). Three
things decide a statement:

- **A stated figure or range** ("3 to 4 times", `within`). The figure itself supports it; only a
  figure whose whole interval lies outside contradicts it; in between nothing can be told. A gain
  that is larger than stated is there, but was stated wrongly: the statement holds in part.
- **Better or worse** (`ordered`). The interval of the ratio must leave out 1. Otherwise the two
  cannot be told apart.
- **Alike.** A range around 1.

The thresholds below were chosen before our numbers were known, and are the same for all claims and
for the paper's own tables.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

from f3amd_lib.reports.ledger.evidence import Evidence, Figure, NoTable, NotMeasured, Setting, Source

HOLDS = "holds"
IN_PART = "holds in part"
FAILS = "does not hold"
OPEN = "cannot be told apart"
UNMEASURED = "not measured"
VERDICTS = (HOLDS, IN_PART, FAILS, OPEN, UNMEASURED)
"""What can be said of a claim, or of a statement."""

REMARK = ""
"""In place of a verdict: a figure that stands beside the others and decides nothing."""

# --------------------------------------------------------------------------------------- thresholds

TOLERANCE = 0.10
"""Slack of a stated factor. The paper gives its factors with one or two digits and a "~"."""

SAVING_SLACK = 0.02
"""Slack of a stated share of time saved. Medians of repeated runs differ by a percent or two."""

ALIKE_TIME = 0.20
"""Times within a fifth are alike: in the paper's own Table 1 one network scatters by 15 % where the
work is the same and launching it decides (FNO-96 at 1 to 8 characters)."""

MINOR = 0.30
"""A metric less than this much worse is a small loss. Section 5.2 calls differences "visually
negligible" of which the FID of its two recommended models, 0.147 and 0.189, is one: 29 %."""

BROKEN = 2.0
"""A network is broken where FID is at least twice, or style coverage at most half, that of the
sound one. CAMDM-96, which the paper calls collapsed, stands at 10 times and a fiftieth."""

KEPT_DIVERSITY = 0.5
"""Diversity is kept if at least half of it is left: section 6 allows that one step lowers it."""

SEEN_SPREAD_CM = 1.0
"""Samples that differ by less are one motion to the eye: joints of real walkers shake that much
from frame to frame (0.7 to 1.4 cm)."""

ALMOST_LINEAR = 0.8
"""Exponent of time against steps from which halving the steps nearly (57 %) halves the time."""

CONVERGED = 0.05
"""A metric has converged in the first epoch that comes this close to its best."""

STILL_BETTER = 0.9
"""If that epoch lies in the last tenth of a run, the run was too short to tell."""

GRADED = 0.05
"""Least lead of one metric over the other in the share of pairs that it puts in the right order."""

ROUNDING = 1e-12
"""Two float64 computations of one number agree to this; 16 digits less a few."""

LEAST_METRICS = 5
"""Of the nine of Table 3, so many must be there before "every metric" means something."""

WIDTHS = (32, 48, 64, 96, 128)
CPU_COUNTS = (1, 2, 4, 8, 16, 32)
LARGE_CROWD = {"GPU": (128, 256, 512, 1024), "CPU": (16, 32)}
"""Characters of a large crowd, as far as the paper measures (Table 1)."""

FEW, SOME, MANY = (1, 2, 4, 8), (16, 32, 64, 128), (256, 512, 1024)
"""Low, moderate and high numbers of characters on a GPU (Appendix E gives none)."""

FINE_BAND, FOOT_METRIC = "5-15 Hz", "toe_power_over_real"
"""Row of `foot_spectrum.csv` that fine foot motion is read from: what lies above strides, lift and
strike, as a share of real motion in the same styles."""

DRIFT_METRICS = ("path_drift", "gap_m", "acceleration_cm")
"""Measures of a round, beside those of the nine that are better low, that grow as a rollout drifts:
distance from the path, and shaking."""

FNO_96 = Setting("F3AMD-FNO-96")
TRANSFORMER_64 = Setting("F3AMD-Transformer-64")
CAMDM = Setting("CAMDM")

FAMILIES = {"FNO": FNO_96.model, "Transformer": TRANSFORMER_64.model}
"""Kinds of F3AMD and the one of each that the paper recommends: without it nothing is judged."""

# -------------------------------------------------------------------------- statements and verdicts


@dataclass(frozen=True)
class Statement:
    """A part of a claim, judged.

    Attributes:
      says: the sentence, in our words.
      verdict: of `VERDICTS`; "" for a remark that decides nothing.
      figure: what was found, or why nothing was.
      sources: tables that it rests on.
      optional: where it was not measured, nobody misses it.
      no_table: it was not measured because a whole table is missing.
    """

    says: str
    verdict: str
    figure: str
    sources: tuple[Source, ...] = ()
    optional: bool = False
    no_table: bool = False


Finding = tuple[str, str]
"""Verdict and figure."""


def combine(verdicts: Iterable[str]) -> str:
    """Return the verdict on a whole from those on its parts.

    All parts hold: it holds. Some do, and others do not or were not measured: it holds in part.
    None does, and one was contradicted: it does not hold. Otherwise nothing can be told apart, or
    nothing was measured.
    """
    found = set(verdicts) - {REMARK}
    if not found - {UNMEASURED}:
        return UNMEASURED
    if found == {HOLDS}:
        return HOLDS
    if found & {HOLDS, IN_PART}:
        return IN_PART
    return FAILS if FAILS in found else OPEN


def every(verdicts: Iterable[str]) -> str:
    """Return the verdict on "each of them": one that fails is enough."""
    found = set(verdicts)
    return next(verdict for verdict in (FAILS, OPEN, IN_PART, HOLDS) if verdict in found)


def any_of(verdicts: Iterable[str]) -> str:
    """Return the verdict on "one of them": one that holds is enough."""
    found = set(verdicts)
    return next(verdict for verdict in (HOLDS, OPEN, FAILS) if verdict in found)


def within(figure: Figure, bounds: tuple[float, float], *, gain: bool = False) -> str:
    """Judge whether a figure lies in a range.

    Args:
      figure: what was found.
      bounds: least and largest value.
      gain: beyond the largest value lies more of a good thing.

    Returns:
      A verdict.
    """
    low, high = bounds
    if figure.high < low:
        return FAILS
    if figure.low > high:
        return IN_PART if gain else FAILS
    return HOLDS if low <= figure.value <= high else OPEN


def ordered(harm: Figure) -> str:
    """Judge whether something is worse, from a ratio that is above 1 where it is."""
    if harm.low > 1.0:
        return HOLDS
    return FAILS if harm.high < 1.0 else OPEN


def ranged(figures: Iterable[Figure], bounds: tuple[float, float], unit: str, **gain) -> Finding:
    """Judge whether figures lie in a range, each of them a part of the whole.

    Args:
      figures: at least one.
      bounds, gain: as for `within`.
      unit: written behind the figures.

    Returns:
      The combined verdict, and the span of the figures; where not all hold, how many do.
    """
    figures = list(figures)
    verdicts = [within(figure, bounds, **gain) for figure in figures]
    told, inside = span(figures, unit), verdicts.count(HOLDS)
    if len(figures) > 1 and inside < len(figures):
        told += f", {inside} of {len(figures)} in the range"
    return combine(verdicts), told


def stated(low: float, high: float) -> tuple[float, float]:
    """Return the bounds of a range of factors as the paper states it, with some slack."""
    return low * (1.0 - TOLERANCE), high * (1.0 + TOLERANCE)


def about(factor: float) -> tuple[float, float]:
    """Return the bounds of "about so many times", a factor above 1."""
    # A gain of 9 % with a slack of 10 % would be no gain: half of it must be left.
    slack = min(TOLERANCE * factor, (factor - 1.0) / 2.0)
    return factor - slack, factor + slack


def alike(slack: float) -> tuple[float, float]:
    """Return the bounds of ratios that count as 1, as far below as above."""
    return 1.0 / (1.0 + slack), 1.0 + slack


def state(evidence: Evidence, says: str, judge: Callable, *arguments, optional: bool = False) -> Statement:
    """Return the statement that `judge(evidence, *arguments)` decides.

    Args:
      evidence: what is looked into.
      says: the sentence.
      judge: returns a `Finding`; where it raises NotMeasured, its message is the reason.
      arguments: of `judge`, after the evidence.
      optional: see `Statement`.
    """
    evidence.forget_sources()
    try:
        verdict, figure = judge(evidence, *arguments)
    except NotMeasured as gap:
        return Statement(says, UNMEASURED, str(gap), (), optional, isinstance(gap, NoTable))
    return Statement(says, verdict, figure, tuple(evidence.sources), optional)


def remark(evidence: Evidence, says: str, tell: Callable, *arguments) -> Statement:
    """Return a figure that decides nothing; `tell` returns its text."""
    return state(evidence, says, lambda e: (REMARK, tell(e, *arguments)), optional=True)


def number(value: float) -> str:
    """Write a number with three digits, or all those before the point."""
    if not np.isfinite(value):
        return "∞"
    return f"{value:,.0f}" if abs(value) >= 100 else f"{value:.3g}"


def shown(figure: Figure, unit: str = "") -> str:
    """Write a figure, with its interval where it has one."""
    text = f"{number(figure.value)}{unit}"
    if figure.low == figure.high:
        return text
    return f"{text} ({number(figure.low)} to {number(figure.high)})"


def span(figures: Iterable[Figure], unit: str = "") -> str:
    """Write the least and the largest of some figures; a single one with its interval."""
    figures = list(figures)
    if len(figures) == 1:
        return shown(figures[0], unit)
    values = [figure.value for figure in figures]
    return f"{number(min(values))} to {number(max(values))}{unit}"


def listed(items: Iterable) -> str:
    """Write items one after the other, separated by commas."""
    return ", ".join(f"{item:,}" if isinstance(item, int) else str(item) for item in items)


def family(kind: str, window: int = 32) -> list[Setting]:
    """Return F3AMD of a kind ("FNO" or "Transformer") in all widths of the paper."""
    return [Setting(f"F3AMD-{kind}-{width}", window=window) for width in WIDTHS]
