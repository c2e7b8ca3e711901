"""What makes a comparison of trained networks sound, however small they are.

A verdict of ours is one at our scale, which heads its column. A statement is judged where its networks saw as much, and
each has three seeds (one is "seen once"), whose spread is in the intervals; where half the length gives the same
verdict; and, where nothing stands beside a figure, where twice the length changes little and the motion is plausible.
All of this is ours.
"""

from collections.abc import Callable, Collection, Iterator, Mapping

import numpy as np

from f3amd_companion.ledger.evidence import Evidence, Network, known
from f3amd_lib.measures.walking import CHECKS
from f3amd_lib.networks import presets
from f3amd_lib.text.stages.train_stage import stage_of

LEAST_SEEDS = 3

LEAST_CHANGE = 0.05
"""Figures that change by less over a training of twice the length have converged."""

ERRORS = ("held_out_loss", "text_FID")
"""Figures of a row of text to motion that must have; of other networks it is held-out error and FID."""

MOST_TREMBLING = 1.5
"""Times the acceleration of real clips, or as many times less, is plausible motion of text."""

GATE_STEPS = 8
"""Denoising steps with which a network has to walk."""


def converged(once: Mapping[str, float], twice: Mapping[str, float]) -> bool:
    """Tell whether a training has: figures after it and after twice its length differ by less than 5 %."""
    return bool(once) and all(
        abs(twice.get(name, np.inf) - was) < LEAST_CHANGE * abs(was) for name, was in once.items()
    )


def _errors(evidence: Evidence | None, network: Network) -> dict[str, float]:
    """Return the figures by which a network converges, those that are on record."""
    figure = lambda table, **row: evidence and known(evidence.figure, table, **row)
    if network.table:
        found = {name: figure(network.table, **dict(network.row), metric=name) for name in ERRORS}
    else:
        walks = {"model": network.model, "window_frames": network.window, "steps": GATE_STEPS}
        found = {"FID": figure("quality", **walks, metric="FID")}
        found["error"] = figure("recipe_errors", model=network.model, recipe="paper")
    return {name: one.value for name, one in found.items() if one}


def _plausible(evidence: Evidence, network: Network) -> bool:
    """Tell whether a network is on record as one whose motion could be real."""
    if network.table:
        trembling = known(evidence.figure, network.table, **dict(network.row), metric="acceleration_ratio")
        return trembling is not None and 1.0 / MOST_TREMBLING <= trembling.value <= MOST_TREMBLING
    figure = lambda check, **row: known(evidence.figure, "walking", metric=check, window_frames=network.window, **row)
    pairs = {check: (figure(check, model=network.model, steps=GATE_STEPS), figure(check, model="real", steps=0))
             for check in CHECKS}  # fmt: skip
    return all(None not in pair and CHECKS[check][1](*(one.value for one in pair)) for check, pair in pairs.items())


def _stage(network: Network) -> str:
    """Return what has terms of its own: a teacher sees more motions than its student."""
    return stage_of(network.trained) if network.table and network.trained in presets.PRESETS else network.table


def _faults(evidence: Evidence, rule: Callable, verdict: str, networks: Collection[Network]) -> Iterator:
    """Yield what a statement's networks lack, and of which of them that is true."""
    # One figure of one network is absolute: no other stands beside it.
    beside = {"ratio_to", "rows", "against"} & rule.keywords.keys()
    alone = networks if not beside and len({(one.model, one.window, one.row) for one in networks}) == 1 else ()
    if all(one.timed for one in networks):  # weights do not change times, sizes do
        yield from (("a smaller network of ours in its place", one) for one in alone if one.trained != one.model)
        yield from (("timed once", one) for one in networks if one.seeds == 1)
        return
    # How much a network saw stands in the row of a table of text to motion, and in a table of its own of others.
    row = lambda one: {"model": one.model, "window_frames": one.window, "metric": "windows"}
    seen = {one: one.windows or known(evidence.figure, "trained", **row(one)) for one in networks}
    for one in networks:
        if seen[one] is None:
            yield "no record of training", one
        elif one.seeds < LEAST_SEEDS:
            yield "seen once" if one.seeds == 1 else f"{one.seeds} seeds of {LEAST_SEEDS}", one
        elif any(seen[one] != seen[two] for two in networks if _stage(one) == _stage(two)):
            yield "trained longer or shorter than what it is compared with", one
    half, twice = evidence.at(0.5), evidence.at(2.0)
    if half is None or (again := known(rule, half)) is None:
        yield from (("not seen at half its length", one) for one in networks)
    elif again[0] != verdict:
        yield from ((f"not settled: {again[0]} at half its length", one) for one in networks)
    for one in alone:
        if not converged(*(_errors(length, one) for length in (evidence, twice))):
            yield "not converged: no training of twice the length agrees", one
        if not _plausible(evidence, one):
            yield "its motion is not plausible, or not on record", one


def why_not_judged(
    evidence: Evidence, rule: Callable, verdict: str, networks: Collection[Network]
) -> dict[str, list[str]]:
    """Return why a statement is not judged: reason -> networks; none where it may be, as of a paper's own tables.

    Args:
      evidence: records.
      rule: of the statement, from evidence to verdict and text, a partial function.
      verdict: what it says here.
      networks: the trained ones that it looked up.
    """
    reasons: dict[str, list[str]] = {}
    for fault, one in _faults(evidence, rule, verdict, networks) if networks and not evidence.printed else ():
        reasons.setdefault(fault, []).append(one.trained)
    return reasons
