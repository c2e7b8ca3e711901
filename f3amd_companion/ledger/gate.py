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
    row = {"model": model, "window_frames": window}
    windows, fall = (known(evidence.figure, "trained", **row, metric=metric) for metric in ("windows", "held_out_fall"))
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
    rows = (row | {"steps": GATE_STEPS}, {"model": "real", "window_frames": window, "steps": 0})
    figures = {check: [known(evidence.figure, "walking", **one, metric=check) for one in rows] for check in CHECKS}
    if any(None in pair for pair in figures.values()):
        yield "no record of walking"
    elif not all(holds(*(one.value for one in figures[check])) for check, (_, holds) in CHECKS.items()):
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
    lacking: dict[str, list[str]] = {}
    networks = [] if evidence.printed else dict.fromkeys(evidence.trained)
    for model, window in networks:
        for fault in _faults(evidence, model, window, paper_windows.get(str(window)), (model, window) not in poor):
            lacking.setdefault(fault, []).append(model)
    for model, (trained, windows) in evidence.told.items():
        if trained != model:
            lacking.setdefault("a smaller network of ours in its place", []).append(trained)
        if windows < LEAST_SHARE * paper_windows.get("text", 0):
            share = f"trained {100.0 * windows / paper_windows['text']:.2g} % of the paper's motions"
            lacking.setdefault(share, []).append(trained)
    return lacking
