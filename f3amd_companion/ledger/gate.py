"""What a network must have behind it before its quality says anything of a paper's claim.

A network that was stopped after minutes, or whose feet slide, says what brief training gives, and
nothing of the paper's. Its figures are shown, and no verdict is drawn from them. Asked are the
length of its training, as a share of the paper's windows, whether its held-out loss was flat at the
end, and whether it walks (`measures.walking.CHECKS`). A network that the claim itself calls poor
need not walk. A network of text to motion must be as large as the paper's and have seen as large a
share of its motions. All of this is ours.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping

from f3amd_companion.ledger.evidence import Evidence, known
from f3amd_lib.measures.walking import CHECKS

LEAST_SHARE = 0.05
"""Of the paper's windows. 100 passes over Bandai, the smallest data set here, are a tenth of them."""

FLAT = 0.05
"""A held-out loss that falls by less over the last quarter of training is flat."""

GATE_STEPS = 8
"""Denoising steps with which a network has to walk."""


def _faults(evidence: Evidence, model: str, window: int, paper_windows: int | None, walks: bool) -> Iterator[str]:
    """Yield what a network lacks, in words."""
    own = {"model": model, "window_frames": window}
    figure = lambda table, metric, **row: known(evidence.figure, table, **own | row, metric=metric)
    windows, fall = figure("trained", "windows"), figure("trained", "held_out_fall")
    if windows is None:
        yield "no record of training"
    elif paper_windows and windows.value < LEAST_SHARE * paper_windows:
        yield f"trained {100.0 * windows.value / paper_windows:.2g} % of the paper's windows"
    if windows and fall is None:
        yield "no record of its loss towards the end"
    elif windows and fall.value > FLAT:
        yield "held-out loss was still falling"
    if not walks:
        return
    pairs = {check: (figure("walking", check, steps=GATE_STEPS), figure("walking", check, model="real", steps=0))
             for check in CHECKS}  # fmt: skip
    if any(None in pair for pair in pairs.values()):
        yield "no record of walking"
    elif not all(CHECKS[check][1](own.value, real.value) for check, (own, real) in pairs.items()):
        yield "does not walk"


def why_not_judged(
    evidence: Evidence, paper_windows: Mapping[str, int], poor: Collection[tuple[str, int]] = ()
) -> dict[str, list[str]]:
    """Return why the networks that were looked up last decide nothing: reason -> models; none where they may.

    Args:
      evidence: records, after a rule has looked into them; a paper's own tables may always be judged.
      paper_windows: frames of a window, as text -> windows that the paper trained with.
      poor: (model, window) of networks that the claim calls poor.
    """
    faults = []
    for model, window in () if evidence.printed else dict.fromkeys(evidence.trained):
        of_paper, walks = paper_windows.get(str(window)), (model, window) not in poor
        faults += [(fault, model) for fault in _faults(evidence, model, window, of_paper, walks)]
    for model, (trained, motions) in evidence.told.items():
        if trained != model:
            faults.append(("a smaller network of ours in its place", trained))
        if motions < LEAST_SHARE * paper_windows.get("text", 0):
            faults.append((f"trained {100.0 * motions / paper_windows['text']:.2g} % of the paper's motions", trained))
    return {fault: [model for found, model in faults if found == fault] for fault, _ in faults}
