"""Rules of the claims on speed, training time and memory (E1 to E17)."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pandas as pd

from f3amd_lib.reports.ledger.evidence import (
    NINE_METRICS,
    Evidence,
    Figure,
    NotMeasured,
    Setting,
    difference,
    mean_figure,
    power_law,
    ratio,
)
from f3amd_lib.reports.ledger.verdicts import (
    ALIKE_TIME,
    ALMOST_LINEAR,
    CAMDM,
    CONVERGED,
    CPU_COUNTS,
    FAILS,
    FAMILIES,
    FEW,
    FNO_96,
    HOLDS,
    LARGE_CROWD,
    MANY,
    OPEN,
    SAVING_SLACK,
    SOME,
    STILL_BETTER,
    TOLERANCE,
    TRANSFORMER_64,
    WIDTHS,
    Finding,
    Statement,
    about,
    alike,
    combine,
    family,
    listed,
    ordered,
    ranged,
    remark,
    shown,
    span,
    state,
    stated,
    within,
)


def _timed(evidence: Evidence, kind: str, window: int, device: str, counts) -> list[Setting]:
    """Return the sizes of a family that were timed at all counts; the recommended one must be."""
    kept = []
    for setting in family(kind, window):
        try:
            for count in counts:
                evidence.time(setting, device, count)
        except NotMeasured:
            if setting.model == FAMILIES[kind]:
                raise
            continue
        kept.append(setting)
    return kept


def _saving(gain: Figure) -> Figure:
    """Return the share of time saved, in %, of a gain in speed."""
    return Figure(*(100.0 * (1.0 - 1.0 / bound) for bound in (gain.value, gain.low, gain.high)))


def _gains(evidence: Evidence, kind: str, window: int, device: str, counts, bounds) -> Finding:
    """Compare a family with CAMDM at some counts."""
    slow = Setting(CAMDM.model, window=window)
    figures = [
        evidence.speedup(slow, fast, device, count)
        for fast in _timed(evidence, kind, window, device, counts)
        for count in counts
    ]
    return ranged(figures, bounds, "x", gain=True)


def _one_gain(evidence: Evidence, slow, fast, device: str, counts, bounds) -> Finding:
    figures = [evidence.speedup(slow, fast, device, count) for count in counts]
    return ranged(figures, bounds, "x", gain=True)


def _one_saving(evidence: Evidence, slow, fast, device: str, counts, bounds) -> Finding:
    """Compare the time saved, in %, at every count with a range."""
    figures = [_saving(evidence.speedup(slow, fast, device, count)) for count in counts]
    slack = 100.0 * SAVING_SLACK
    bounds = (bounds[0] - slack, bounds[1] + slack)
    return ranged(figures, bounds, " %", gain=True)


def _mean_saving(evidence: Evidence, slow, fast, device: str, counts, bounds) -> Finding:
    """Compare the time saved, in %, on average over the counts that were timed, with a range."""
    shared = set(evidence.counts(slow, device)) & set(evidence.counts(fast, device)) & set(counts)
    if not shared:  # the reason is that of the first
        evidence.speedup(slow, fast, device, counts[0])
    mean = mean_figure([evidence.speedup(slow, fast, device, count) for count in sorted(shared)])
    slack = 100.0 * SAVING_SLACK
    figure = _saving(mean)
    bounds = (bounds[0] - slack, bounds[1] + slack)
    return within(figure, bounds, gain=True), f"{shown(figure)} % at {listed(sorted(shared))}"


def _growing_gain(evidence: Evidence, kind: str, device: str, few: int, many: int) -> Finding:
    models = _timed(evidence, kind, 32, device, (few, many))
    growth = {
        model: ratio(evidence.speedup(CAMDM, model, device, many), evidence.speedup(CAMDM, model, device, few))
        for model in models
    }
    return combine(map(ordered, growth.values())), f"{span(growth.values())} times the gain"


def _where_gain_passes(evidence: Evidence, slow, fast, device: str, factor: float) -> str:
    counts = [
        count
        for count in sorted(set(evidence.counts(slow, device)) & set(evidence.counts(fast, device)))
        if evidence.speedup(slow, fast, device, count).value > factor
    ]
    return f"above {factor:g} at {listed(counts)}" if counts else f"nowhere above {factor:g}"


def _gain_of(evidence: Evidence, slow, fast, device: str, counts) -> str:
    return f"{span(evidence.speedup(slow, fast, device, count) for count in counts)}x"


def _gains_of(evidence: Evidence, kind: str, device: str, counts) -> str:
    return _gains(evidence, kind, 32, device, counts, (0.0, np.inf))[1]


def _rule_e1(evidence: Evidence) -> Iterator[Statement]:
    says = "GPU, 1,024 characters: FNO 4 to 8 times"
    yield state(evidence, says, _gains, "FNO", 32, "GPU", (1024,), stated(4, 8))
    says = "GPU: the gain grows from 16 to 1,024 characters"
    yield state(evidence, says, _growing_gain, "FNO", "GPU", 16, 1024)
    yield remark(evidence, "GPU, 16 characters", _gains_of, "FNO", "GPU", (16,))
    yield remark(evidence, "GPU, FNO-96 with 8 steps", _where_gain_passes, CAMDM, FNO_96, "GPU", 4.0)


def _rule_e2(evidence: Evidence) -> Iterator[Statement]:
    says = "GPU, 1,024 characters: Transformer 2.5 to 3.5 times"
    yield state(evidence, says, _gains, "Transformer", 32, "GPU", (1024,), stated(2.5, 3.5))


def _rule_e3(evidence: Evidence) -> Iterator[Statement]:
    for kind, low, high in (("FNO", 3, 5), ("Transformer", 2, 3)):
        says = f"GPU, 1,024 characters, 64 frames: {kind} {low} to {high} times"
        yield state(evidence, says, _gains, kind, 64, "GPU", (1024,), stated(low, high))


def _rule_e4(evidence: Evidence) -> Iterator[Statement]:
    for kind, counts, low, high in (("FNO", (4, 8), 5, 8), ("FNO", (16, 32), 3, 4), ("Transformer", CPU_COUNTS, 2, 3)):
        says = f"CPU, {counts[0]} to {counts[-1]} characters: {kind} {low} to {high} times"
        yield state(evidence, says, _gains, kind, 32, "CPU", counts, stated(low, high))
    for counts in ((4, 8), (16, 32)):
        says = f"CPU, FNO-96 at {counts[0]} to {counts[-1]}"
        yield remark(evidence, says, _gain_of, CAMDM, FNO_96, "CPU", counts)


def _rule_e5(evidence: Evidence) -> Iterator[Statement]:
    for device, counts in LARGE_CROWD.items():
        says = f"{device}, {counts[0]} to {counts[-1]:,} characters: 10 to 22 % less time"
        compared = TRANSFORMER_64, FNO_96, device, counts, (10.0, 22.0)
        yield state(evidence, says, _one_saving, *compared)


def _training_gain(evidence: Evidence, slow: str, fast: str, window: int, bounds) -> Finding:
    batch = evidence.shared_batch((slow, fast), window)
    figure = ratio(evidence.training(slow, batch, window), evidence.training(fast, batch, window))
    return within(figure, bounds, gain=True), f"{shown(figure)}x at batch {batch}"


def _rule_e6(evidence: Evidence) -> Iterator[Statement]:
    for window, camdm, fno in ((32, 12.5, 5.0), (64, 20.6, 6.0)):
        says = f"GPU, {window} frames: FNO-96 trains about {camdm / fno:.1f} times as fast as CAMDM"
        pair = CAMDM.model, FNO_96.model, window, about(camdm / fno)
        yield state(evidence, says, _training_gain, *pair)


def _rule_e7(evidence: Evidence) -> Iterator[Statement]:
    one = Setting(FNO_96.model, 1)
    for device, count, factor in (
        ("CPU", 1, 6.4), ("CPU", 32, 3.4), ("GPU", 1, 2.9), ("GPU", 1024, 6.5),
    ):  # fmt: skip
        says = f"{device}, {count:,} character{'s' if count > 1 else ''}: about {factor} times"
        yield state(evidence, says, _one_gain, FNO_96, one, device, (count,), about(factor))


def _rule_e8(evidence: Evidence) -> Iterator[Statement]:
    one = Setting(FNO_96.model, 1)
    for count, factor in ((16, 4), (1024, 25)):
        says = f"GPU, {count:,} characters: about {factor} times"
        yield state(evidence, says, _one_gain, CAMDM, one, "GPU", (count,), about(factor))
    says = "CPU, 1 to 32 characters: 10 to 20 times"
    yield state(evidence, says, _one_gain, CAMDM, one, "CPU", CPU_COUNTS, stated(10, 20))


_M4 = Setting("F3AMD-FNO-96-m4")


def _rule_e9(evidence: Evidence) -> Iterator[Statement]:
    for name, counts, low, high in (
        ("few", FEW, 3, 4), ("some", SOME, 8, 8), ("many", MANY, 15, 16),
    ):  # fmt: skip
        share = f"{low} to {high}" if high > low else f"about {low}"
        says = f"GPU, {name} characters ({counts[0]} to {counts[-1]:,}): saves {share} %"
        yield state(evidence, says, _mean_saving, FNO_96, _M4, "GPU", counts, (low, high))


def _rule_e10(evidence: Evidence) -> Iterator[Statement]:
    for name, factor in (("concatenation", 2.0), ("cross-attention", 1.32), ("AdaLN-zero", 1.09)):
        says = f"GPU, 1,024 characters: {factor:g} times as fast as {name}"
        slow = Setting(f"F3AMD-FNO-96-{name}")
        yield state(evidence, says, _one_gain, slow, FNO_96, "GPU", (1024,), about(factor))


def _jax_over_torch(evidence: Evidence, device: str, counts) -> dict[int, Figure]:
    """Return time in JAX over time in PyTorch, which has the same network or the released one."""
    same = evidence.counts(CAMDM, device, "torch")
    peer = CAMDM if same else Setting("CAMDM-code")
    known = set(evidence.counts(CAMDM, device)) & set(evidence.counts(peer, device, "torch"))
    chosen = sorted(known & set(counts))
    if not chosen:
        evidence.time(CAMDM, device, counts[0])
        evidence.time(peer, device, counts[0], "torch")
        raise NotMeasured(f"synthesis_time.csv has no counts of both frameworks, {device}")
    return {
        count: ratio(evidence.time(CAMDM, device, count), evidence.time(peer, device, count, "torch"))
        for count in chosen
    }


def _frameworks(evidence: Evidence, device: str, counts, bounds, gain: bool) -> Finding:
    figures = _jax_over_torch(evidence, device, counts).values()
    verdict, told = ranged(figures, bounds, "", gain=gain)
    return verdict, f"JAX / PyTorch {told}"


def _framework_at(evidence: Evidence, device: str, count: int) -> str:
    return f"JAX / PyTorch {shown(_jax_over_torch(evidence, device, (count,))[count])}"


def _rule_e11(evidence: Evidence) -> Iterator[Statement]:
    few, many = (1, 2, 4, 8, 16), (32, 64, 128, 256, 512, 1024)
    for counts in (few, many):
        says = f"GPU, {counts[0]} to {counts[-1]:,} characters: alike within a fifth"
        bounds = alike(ALIKE_TIME)
        yield state(evidence, says, _frameworks, "GPU", counts, bounds, False)
    says = "CPU, 1 to 32 characters: PyTorch 2 to 5 times as fast"
    yield state(evidence, says, _frameworks, "CPU", CPU_COUNTS, stated(2, 5), True)
    yield remark(evidence, "CPU, 32 characters", _framework_at, "CPU", 32)


def _torch_gain(evidence: Evidence, steps: int) -> str:
    """Tell how F3AMD-FNO-96 on a CPU stands against CAMDM in PyTorch."""
    over_torch = _jax_over_torch(evidence, "CPU", CPU_COUNTS)
    gains = {
        count: ratio(evidence.speedup(CAMDM, Setting(FNO_96.model, steps), "CPU", count), found)
        for count, found in over_torch.items()
    }
    slower = [count for count, figure in gains.items() if figure.value < 1.0]
    return f"{span(gains.values())}x" + (f", slower at {listed(slower)}" if slower else "")


def _rule_e12(evidence: Evidence) -> Iterator[Statement]:
    one = Setting(FNO_96.model, 1)
    for device, crowd in (("GPU", 1024), ("CPU", 32)):
        at = f"{device}, {crowd:,} characters"
        for says, slow, fast, bounds in (
            ("over 20 times", CAMDM, one, (20.0, np.inf)),
            ("about 4 times from the architecture", CAMDM, FNO_96, about(4)),
            ("about 5 times from the steps", FNO_96, one, about(5)),
        ):
            compared = slow, fast, device, (crowd,), bounds
            yield state(evidence, f"{at}: {says}", _one_gain, *compared)
    for device in ("GPU", "CPU"):
        yield remark(evidence, f"{device}, FNO-96 with 1 step", _where_gain_passes, CAMDM, one, device, 20.0)
    for steps in (1, 8):
        says = f"CPU, {Setting(FNO_96.model, steps)} against CAMDM in PyTorch"
        yield remark(evidence, says, _torch_gain, steps)


def _converged_epoch(curve: pd.DataFrame, better: str, what: str) -> float:
    """Return the first epoch that comes close to the best one; NotMeasured if it may yet fall."""
    curve = curve.sort_values("epoch")
    values = curve["value"].to_numpy(np.float64)
    if better == "up":
        close = values >= values.max() * (1.0 - CONVERGED)
    else:
        close = values <= values.min() * (1.0 + CONVERGED)
    reached = float(curve["epoch"].iloc[int(np.argmax(close))])
    last = float(curve["epoch"].iloc[-1])
    if reached > STILL_BETTER * last:
        raise NotMeasured(f"{what} was still getting better at the last epoch, {last:g}")
    return reached


def _convergence(evidence: Evidence) -> Finding:
    table = evidence.table("quality_by_epoch")
    curves = {model: table[table["model"] == model] for model in (FNO_96.model, CAMDM.model)}
    for model, curve in curves.items():
        if curve.empty:
            raise NotMeasured(f"quality_by_epoch.csv has no {model}")
    ours, theirs = curves.values()
    shared = [name for name in ours["metric"].unique() if name in set(theirs["metric"])]
    verdicts, told = [], []
    for metric in shared:
        better = NINE_METRICS.get(metric, ("", "down"))[1]
        fno, camdm = (
            _converged_epoch(curve[curve["metric"] == metric], better, f"{metric} of {model}")
            for model, curve in curves.items()
        )
        verdicts.append(HOLDS if fno <= (1.0 + TOLERANCE) * camdm else FAILS)
        told.append(f"{metric} {fno:g} against {camdm:g}")
    if not shared:
        raise NotMeasured("quality_by_epoch.csv has no metric of both models")
    return combine(verdicts), ", ".join(told)


def _rule_e13(evidence: Evidence) -> Iterator[Statement]:
    says = "FNO-96 needs no more epochs than CAMDM, metric by metric"
    yield state(evidence, says, _convergence)


def _same_latency(evidence: Evidence, width: int) -> Finding:
    pair = [Setting(f"F3AMD-{kind}-{width}") for kind in ("Transformer", "FNO")]
    figures = [evidence.speedup(*pair, "GPU", count) for count in FEW]
    verdict, told = ranged(figures, alike(ALIKE_TIME), "")
    return verdict, f"Transformer / FNO {told}"


def _rule_e14(evidence: Evidence) -> Iterator[Statement]:
    for width in WIDTHS:
        says = f"GPU, 1 to 8 characters, D = {width}: alike within a fifth"
        # Of the smaller and larger sizes, those count that were timed.
        yield state(evidence, says, _same_latency, width, optional=width not in (64, 96))


def _exponent(evidence: Evidence, device: str, count: int) -> Figure:
    """Return p of time ~ steps^p."""
    steps = (8, 4, 2, 1)
    times = [evidence.time(Setting(FNO_96.model, n), device, count) for n in steps]
    return power_law(steps, times)


def _linear_in_steps(evidence: Evidence, device: str, count: int) -> Finding:
    figure = _exponent(evidence, device, count)
    return within(figure, (ALMOST_LINEAR, np.inf)), f"exponent {shown(figure)}"


def _more_linear(evidence: Evidence, device: str, few: int, many: int) -> Finding:
    low, high = (_exponent(evidence, device, count) for count in (few, many))
    rise = difference(high, low)
    verdict = HOLDS if rise.low > 0 else FAILS if rise.high < 0 else OPEN
    return verdict, f"exponent {shown(low)} at {few}, {shown(high)} at {many:,}"


def _step_gain(evidence: Evidence, device: str, counts) -> str:
    gains = [evidence.speedup(FNO_96, Setting(FNO_96.model, 1), device, n) for n in counts]
    return " and ".join(f"{shown(gain)}x at {n:,}" for gain, n in zip(gains, counts, strict=True))


def _rule_e15(evidence: Evidence) -> Iterator[Statement]:
    for device, many in (("GPU", 1024), ("CPU", 32)):
        says = f"{device}, {many:,} characters: almost linear in the steps (exponent 0.8 or more)"
        yield state(evidence, says, _linear_in_steps, device, many)
        says = f"{device}: closer to linear with {many:,} characters than with 1"
        yield state(evidence, says, _more_linear, device, 1, many)
        yield remark(evidence, f"{device}, 8 -> 1 steps", _step_gain, device, (1, many))


def _memory(evidence: Evidence, small: str, large: str) -> Finding:
    batch = evidence.shared_batch((small, large))
    figure = ratio(
        evidence.training(large, batch, value="peak_memory_mib"),
        evidence.training(small, batch, value="peak_memory_mib"),
    )
    return ordered(figure), f"{shown(figure)} times the memory at D = 128, batch {batch}"


def _rule_e16(evidence: Evidence) -> Iterator[Statement]:
    small, large = (Setting(f"F3AMD-FNO-{width}") for width in (32, 128))
    for device, crowd in (("GPU", 1024), ("CPU", 32)):
        says = f"{device}, {crowd:,} characters: D = 32 is 2 to 3 times as fast as D = 128"
        compared = large, small, device, (crowd,), stated(2, 3)
        yield state(evidence, says, _one_gain, *compared)
    says = "GPU: D = 32 trains 2 to 3 times as fast as D = 128"
    pair = large.model, small.model, 32, stated(2, 3)
    yield state(evidence, says, _training_gain, *pair)
    says = "GPU: training takes less memory at D = 32"
    yield state(evidence, says, _memory, small.model, large.model)


def _rule_e17(evidence: Evidence) -> Iterator[Statement]:
    says = f"GPU, {MANY[0]} to {MANY[-1]:,} characters: m = 4 saves 10 to 15 %"
    yield state(evidence, says, _mean_saving, FNO_96, _M4, "GPU", MANY, (10, 15))


RULES = {
    "E1": _rule_e1,
    "E2": _rule_e2,
    "E3": _rule_e3,
    "E4": _rule_e4,
    "E5": _rule_e5,
    "E6": _rule_e6,
    "E7": _rule_e7,
    "E8": _rule_e8,
    "E9": _rule_e9,
    "E10": _rule_e10,
    "E11": _rule_e11,
    "E12": _rule_e12,
    "E13": _rule_e13,
    "E14": _rule_e14,
    "E15": _rule_e15,
    "E16": _rule_e16,
    "E17": _rule_e17,
}
"""Claim -> its rule."""
