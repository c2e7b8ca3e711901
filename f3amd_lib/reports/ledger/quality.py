"""Rules of the claims on motion quality (Q1 to Q18)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import pandas as pd
from scipy.stats import t as student_t

from f3amd_lib.reports.ledger.evidence import (
    NINE_METRICS,
    PUBLISHED_CAMDM,
    Evidence,
    Figure,
    NotMeasured,
    Setting,
    ratio,
)
from f3amd_lib.reports.ledger.verdicts import (
    BROKEN,
    CAMDM,
    DRIFT_METRICS,
    FAILS,
    FAMILIES,
    FINE_BAND,
    FNO_96,
    FOOT_METRIC,
    GRADED,
    HOLDS,
    KEPT_DIVERSITY,
    LEAST_METRICS,
    MINOR,
    OPEN,
    SEEN_SPREAD_CM,
    TOLERANCE,
    TRANSFORMER_64,
    WIDTHS,
    Finding,
    Statement,
    about,
    alike,
    any_of,
    combine,
    every,
    family,
    listed,
    number,
    ordered,
    remark,
    shown,
    state,
    within,
)

_CLOSENESS = ("FID", "EMD", "style_coverage")
"""What tells a sound model from a degraded one, among the nine metrics."""


def _harm(evidence: Evidence, changed: Setting, base: Setting, metric: str) -> Figure:
    """Return how many times worse a metric is; above 1 where `changed` is the worse one."""
    found, before = evidence.quality(changed, metric), evidence.quality(base, metric)
    return ratio(before, found) if NINE_METRICS[metric][1] == "up" else ratio(found, before)


def _shared_metrics(evidence: Evidence, settings: Sequence[Setting]) -> list[str]:
    """Return those of the nine metrics that all settings have."""
    kept = []
    for metric in NINE_METRICS:
        try:
            for setting in settings:
                evidence.quality(setting, metric)
        except NotMeasured:
            continue
        kept.append(metric)
    if len(kept) < LEAST_METRICS:
        for setting in settings:  # the reason is that of the first gap
            for metric in NINE_METRICS:
                evidence.quality(setting, metric)
    return kept


def _known(evidence: Evidence, settings: Sequence[Setting], metric: str) -> list[Setting]:
    known = []
    for setting in settings:
        try:
            evidence.quality(setting, metric)
        except NotMeasured:
            continue
        known.append(setting)
    return known


def _table_3(evidence: Evidence, metric: str) -> list[Setting]:
    """Return the 32-frame models of Table 3 that have a metric; three of them must."""
    for setting in (FNO_96, TRANSFORMER_64, CAMDM):
        evidence.quality(setting, metric)
    return _known(evidence, [*family("FNO"), *family("Transformer"), CAMDM], metric)


def _spread(evidence: Evidence, settings: Sequence[Setting], metric: str) -> tuple[Figure, Setting, Setting]:
    """Return largest over least value of a metric, and whose they are."""
    value = lambda setting: evidence.quality(setting, metric).value
    largest, least = max(settings, key=value), min(settings, key=value)
    spread = ratio(evidence.quality(largest, metric), evidence.quality(least, metric))
    return spread, largest, least


def _similar_emd(evidence: Evidence) -> Finding:
    models = _table_3(evidence, "EMD")
    spread, largest, least = _spread(evidence, models, "EMD")
    percent = Figure(*(100.0 * (x - 1.0) for x in (spread.value, spread.low, spread.high)))
    verdict = within(spread, (0.0, 1.0 + 0.05 * (1.0 + TOLERANCE)))
    told = f"{shown(percent)} % over {len(models)} models ({least.model} to {largest.model})"
    return verdict, told


def _rule_q1(evidence: Evidence) -> Iterator[Statement]:
    says = "EMD of the 32-frame models differs by about 5 %"
    yield state(evidence, says, _similar_emd)


def _better_family(evidence: Evidence, better: str, worse: str, metric: str, window) -> Finding:
    """Compare two families width by width."""
    pairs = {}
    for width in WIDTHS:
        pair = [Setting(f"F3AMD-{kind}-{width}", window=window) for kind in (worse, better)]
        if len(_known(evidence, pair, metric)) == 2:
            pairs[width] = ordered(_harm(evidence, *pair, metric))
    if not pairs:
        evidence.quality(Setting(f"F3AMD-{better}-96", window=window), metric)
        evidence.quality(Setting(f"F3AMD-{worse}-96", window=window), metric)
        raise NotMeasured(f"{evidence.called('quality')} no width of both families with {metric}")
    words = {HOLDS: "yes at", FAILS: "no at", OPEN: "open at"}
    told = [
        f"{word} D = {listed(w for w, v in pairs.items() if v == verdict)}"
        for verdict, word in words.items()
        if verdict in pairs.values()
    ]
    return combine(pairs.values()), ", ".join(told)


def _real(evidence: Evidence, metric: str) -> str:
    figure = evidence.real(metric)
    if figure is None:
        raise NotMeasured(f"{evidence.called('quality')} no {metric} of real motion")
    return shown(figure, f" {NINE_METRICS[metric][0]}")


def _rule_q2(evidence: Evidence) -> Iterator[Statement]:
    for window in (32, 64):
        for better, worse, metric in (
            ("FNO", "Transformer", "IRD"),
            ("Transformer", "FNO", "FID"),
            ("Transformer", "FNO", "style_coverage"),
        ):
            says = f"{window} frames: {better} has the better {metric}"
            pair = better, worse, metric, window
            # Section 5.2 says it of 32 frames; Table 3 has both.
            yield state(evidence, says, _better_family, *pair, optional=window == 64)
    yield remark(evidence, "IRD of real motion", _real, "IRD")


def _best_fid(evidence: Evidence) -> Finding:
    others = [setting for setting in _table_3(evidence, "FID") if setting != CAMDM]
    harms = {other.model: _harm(evidence, other, CAMDM, "FID") for other in others}
    nearest = min(harms, key=lambda model: harms[model].value)
    told = f"next is {nearest} with {shown(harms[nearest])} times its FID"
    return every(map(ordered, harms.values())), told


def _worse(evidence: Evidence, changed: Setting, base: Setting, metric: str) -> Finding:
    values = [shown(evidence.quality(setting, metric)) for setting in (changed, base)]
    unit = f" {NINE_METRICS[metric][0]}".rstrip()
    return ordered(_harm(evidence, changed, base, metric)), f"{' against '.join(values)}{unit}"


def _rule_q3(evidence: Evidence) -> Iterator[Statement]:
    yield state(evidence, "CAMDM has the lowest FID of the 32-frame models", _best_fid)
    yield state(evidence, "CAMDM has the higher IRD, FNO-96 the lower", _worse, CAMDM, FNO_96, "IRD")
    yield remark(evidence, "IRD of real motion", _real, "IRD")


def _times_or_percent(figure: Figure) -> str:
    if figure.value >= 2.0:
        return f"{number(figure.value)}x"
    return f"{100.0 * (figure.value - 1.0):+.3g} %"


def _small_loss(evidence: Evidence, pairs: Sequence[tuple[Setting, Setting]]) -> Finding:
    """Judge, metric by metric, whether no pair's first setting is much worse than its second."""
    metrics = _shared_metrics(evidence, [setting for pair in pairs for setting in pair])
    verdicts, told = [], []
    for metric in metrics:
        harms = {changed.model: _harm(evidence, changed, base, metric) for changed, base in pairs}
        verdict = every(within(harm, (0.0, 1.0 + MINOR)) for harm in harms.values())
        worst = max(harms, key=lambda model: harms[model].value)
        verdicts.append(verdict)
        if verdict != HOLDS:
            told.append(f"{metric} {_times_or_percent(harms[worst])} ({worst})")
    return combine(verdicts), f"worse: {', '.join(told)}" if told else f"{len(metrics)} metrics"


def _window_pairs(evidence: Evidence) -> list[tuple[Setting, Setting]]:
    """Return (64 frames, 32 frames) of every F3AMD that has both; FNO-96 must."""
    pairs = []
    for kind in FAMILIES:
        for width in (64, 96, 128):  # the widths that the paper trains with 64 frames
            name = f"F3AMD-{kind}-{width}"
            pair = Setting(name, window=64), Setting(name)
            if len(_known(evidence, pair, "FID")) == 2:
                pairs.append(pair)
            elif name == FNO_96.model:
                for setting in pair:
                    evidence.quality(setting, "FID")
    return pairs


def _window_loss(evidence: Evidence) -> Finding:
    return _small_loss(evidence, _window_pairs(evidence))


def _broken(evidence: Evidence, changed: Setting, base: Setting) -> Finding:
    harms = {name: _harm(evidence, changed, base, name) for name in ("FID", "style_coverage")}
    told = ", ".join(f"{name} {_times_or_percent(harm)} worse" for name, harm in harms.items())
    return any_of(within(harm, (BROKEN, np.inf)) for harm in harms.values()), told


def _window_gains(evidence: Evidence) -> str:
    pairs = _window_pairs(evidence)
    better = sum(_harm(evidence, *pair, "IRD").value < 1.0 for pair in pairs)
    return f"in {better} of {len(pairs)} models"


def _rule_q4(evidence: Evidence) -> Iterator[Statement]:
    says = "F3AMD with 64 frames: no metric more than 30 % worse than with 32"
    yield state(evidence, says, _window_loss)
    says = "CAMDM with 64 frames is broken (FID twice, or style coverage half, that with 32)"
    yield state(evidence, says, _broken, Setting(CAMDM.model, window=64), CAMDM)
    yield remark(evidence, "IRD is lower with 64 frames", _window_gains)


def _close_over_steps(evidence: Evidence) -> Finding:
    fewer = [Setting(FNO_96.model, steps) for steps in (4, 2, 1)]
    metrics = _shared_metrics(evidence, [FNO_96, *fewer])
    changes = {
        (metric, setting): ratio(evidence.quality(setting, metric), evidence.quality(FNO_96, metric))
        for metric in metrics
        for setting in fewer
    }
    by_metric = [every(within(changes[metric, setting], alike(TOLERANCE)) for setting in fewer) for metric in metrics]
    metric, setting = max(changes, key=lambda key: abs(np.log(changes[key].value)))
    percent = Figure(*(100 * (x - 1) for x in vars(changes[metric, setting]).values()))
    at = f"{setting.steps} step{'s' if setting.steps > 1 else ''}"
    close = f"{by_metric.count(HOLDS)} of {len(metrics)} metrics"
    return combine(by_metric), f"{close}; largest change: {metric} {shown(percent)} % at {at}"


def _plateaus(evidence: Evidence) -> str:
    """Tell how far apart neighbouring numbers of steps are, by the largest change of a metric."""
    settings = [Setting(FNO_96.model, steps) for steps in (8, 4, 2, 1)]
    metrics = _shared_metrics(evidence, settings)
    told = []
    for first, second in zip(settings, settings[1:], strict=False):
        largest = max(
            abs(evidence.quality(second, metric).value / evidence.quality(first, metric).value - 1.0)
            for metric in metrics
        )
        told.append(f"{first.steps} to {second.steps} {100.0 * largest:.2g} %")
    return ", ".join(told)


def _rule_q5(evidence: Evidence) -> Iterator[Statement]:
    says = "FNO-96 at 4, 2 and 1 steps: every metric within 10 % of 8 steps"
    yield state(evidence, says, _close_over_steps)
    yield remark(evidence, "largest change from one number of steps to the next", _plateaus)


def _acceptable(evidence: Evidence, changed: Setting, base: Setting) -> Finding:
    harms = {name: _harm(evidence, changed, base, name) for name in _CLOSENESS}
    verdict = every(within(harm, (0.0, 1.0 + MINOR)) for harm in harms.values())
    return verdict, ", ".join(f"{name} {_times_or_percent(f)} worse" for name, f in harms.items())


def _degraded(evidence: Evidence, changed: Setting, base: Setting) -> Finding:
    harms = {name: _harm(evidence, changed, base, name) for name in _CLOSENESS}
    verdict = any_of(within(harm, (1.0 + MINOR, np.inf)) for harm in harms.values())
    return verdict, ", ".join(f"{name} {_times_or_percent(f)} worse" for name, f in harms.items())


def _rule_q6(evidence: Evidence) -> Iterator[Statement]:
    for steps, says, judge in (
        (4, "CAMDM with 4 steps: FID, EMD and coverage at most 30 % worse than with 8", _acceptable),
        (2, "CAMDM with 2 steps: one of them more than 30 % worse", _degraded),
        (1, "CAMDM with 1 step is broken (FID twice, or style coverage half)", _broken),
    ):
        yield state(evidence, says, judge, Setting(CAMDM.model, steps), CAMDM)


_CAMDM_VE_1 = Setting("CAMDM-VE", 1)


def _on_some_device(evidence: Evidence, slow: Setting, fast: Setting, bounds) -> Finding:
    """Compare times at the largest crowd, on every device that was timed."""
    figures, gap = {}, None
    for device, crowd in (("GPU", 1024), ("CPU", 32)):
        try:
            figures[f"{device}, {crowd:,}"] = evidence.speedup(slow, fast, device, crowd)
        except NotMeasured as error:
            gap = gap or error
    if not figures:
        raise gap
    verdict = every(within(figure, bounds, gain=True) for figure in figures.values())
    return verdict, ", ".join(f"{shown(figure)}x ({at})" for at, figure in figures.items())


def _rule_q7(evidence: Evidence) -> Iterator[Statement]:
    says = "CAMDM-VE with 1 step: FID, EMD and coverage at most 30 % worse than CAMDM with 8"
    yield state(evidence, says, _acceptable, _CAMDM_VE_1, CAMDM)
    says = "CAMDM-VE with 1 step takes about a fifth of the time of CAMDM with 8"
    yield state(evidence, says, _on_some_device, CAMDM, _CAMDM_VE_1, about(5))


def _rule_q8(evidence: Evidence) -> Iterator[Statement]:
    linear = Setting("F3AMD-FNO-96-linear")
    for metric in ("style_coverage", "diversity"):
        says = f"FNO-96 with a linear encoder and decoder has the lower {metric}"
        yield state(evidence, says, _worse, linear, FNO_96, metric)


def _worse_in_metrics(evidence: Evidence, changed: Setting, base: Setting) -> Finding:
    verdicts = {
        metric: ordered(_harm(evidence, changed, base, metric)) for metric in _shared_metrics(evidence, [changed, base])
    }
    worse = sum(verdict == HOLDS for verdict in verdicts.values())
    better = [metric for metric, verdict in verdicts.items() if verdict == FAILS]
    told = f"worse in {worse} of {len(verdicts)}"
    return combine(verdicts.values()), told + (f", better in {listed(better)}" if better else "")


def _alike_in_metrics(evidence: Evidence, models: Sequence[str]) -> Finding:
    settings = [Setting(model) for model in models]
    verdicts, told = {}, []
    for metric in _shared_metrics(evidence, settings):
        spread, largest, least = _spread(evidence, settings, metric)
        verdicts[metric] = within(spread, (0.0, 1.0 + MINOR))
        if verdicts[metric] != HOLDS:
            told.append(f"{metric} {number(spread.value)}x ({largest.model} over {least.model})")
    count = sum(verdict == HOLDS for verdict in verdicts.values())
    figure = f"alike in {count} of {len(verdicts)}"
    return combine(verdicts.values()), figure + (f"; apart: {', '.join(told)}" if told else "")


def _rule_q9(evidence: Evidence) -> Iterator[Statement]:
    says = "m = 1 is worse than m = 17, metric by metric"
    yield state(evidence, says, _worse_in_metrics, Setting("F3AMD-FNO-96-m1"), FNO_96)
    says = "m = 4, 8, 12, 14 and 17 are alike within 30 %, metric by metric"
    models = [FNO_96.model, *(f"F3AMD-FNO-96-m{modes}" for modes in (14, 12, 8, 4))]
    yield state(evidence, says, _alike_in_metrics, models)


def _rule_q10(evidence: Evidence) -> Iterator[Statement]:
    says = "FNO, DCT, weighted and reduced-rank FNO are alike within 30 %, metric by metric"
    others = ("F3AMD-DCT-96", "F3AMD-weighted-FNO-96", "F3AMD-reduced-rank-FNO-96")
    yield state(evidence, says, _alike_in_metrics, [FNO_96.model, *others])


_CONDITIONINGS = tuple(f"F3AMD-FNO-96-{kind}" for kind in ("concatenation", "AdaLN-zero", "cross-attention"))


def _last_of(evidence: Evidence, model: Setting, others: Sequence[str]) -> str:
    settings = [Setting(name) for name in others]
    last = [
        metric
        for metric in _shared_metrics(evidence, [model, *settings])
        if all(_harm(evidence, model, other, metric).value > 1.0 for other in settings)
    ]
    return listed(last) if last else "in no metric"


def _rule_q11(evidence: Evidence) -> Iterator[Statement]:
    says = "four kinds of conditioning are alike within 30 %, metric by metric"
    yield state(evidence, says, _alike_in_metrics, [FNO_96.model, *_CONDITIONINGS])
    yield remark(evidence, "FiLM is last of the four in", _last_of, FNO_96, _CONDITIONINGS)


def _compared(evidence: Evidence, changed, base, metric: str, bounds) -> Finding:
    figure = _harm(evidence, changed, base, metric)
    values = " against ".join(shown(evidence.quality(s, metric)) for s in (changed, base))
    unit = f" {NINE_METRICS[metric][0]}".rstrip()
    return within(figure, bounds), f"{values}{unit}, {number(figure.value)} times worse"


def _rule_q12(evidence: Evidence) -> Iterator[Statement]:
    changed = Setting("CAMDM-96")
    says = "CAMDM-96 has at most half the style coverage of FNO-96"
    compared = changed, FNO_96, "style_coverage", (BROKEN, np.inf)
    yield state(evidence, says, _compared, *compared)
    says = "CAMDM-96 has about twice the EMD, or more"
    yield state(evidence, says, _compared, changed, FNO_96, "EMD", (about(2)[0], np.inf))


def _rule_q13(evidence: Evidence) -> Iterator[Statement]:
    without = Setting("F3AMD-FNO-96-no-IRD")
    says = "FNO-96 trained without the IRD loss has the higher IRD"
    yield state(evidence, says, _worse, without, FNO_96, "IRD")
    yield remark(evidence, "IRD of real motion", _real, "IRD")


def _kept_diversity(evidence: Evidence) -> Finding:
    one = Setting(FNO_96.model, 1)
    kept = ratio(evidence.quality(one, "diversity"), evidence.quality(FNO_96, "diversity"))
    return within(kept, (KEPT_DIVERSITY, np.inf)), f"{shown(kept)} times that of 8 steps"


def _seen_diversity(evidence: Evidence) -> Finding:
    figure = evidence.quality(Setting(FNO_96.model, 1), "diversity")
    return within(figure, (SEEN_SPREAD_CM, np.inf)), shown(figure, " cm")


def _rule_q14(evidence: Evidence) -> Iterator[Statement]:
    says = "FNO-96 with 1 step keeps at least half of the diversity of 8 steps"
    yield state(evidence, says, _kept_diversity)
    says = "FNO-96 with 1 step: samples of one condition differ by 1 cm or more"
    yield state(evidence, says, _seen_diversity)


def _foot_power(evidence: Evidence, setting: Setting) -> Figure:
    return evidence.figure(
        "foot_spectrum",
        model=setting.model,
        window_frames=setting.window,
        steps=setting.steps,
        band=FINE_BAND,
        metric=FOOT_METRIC,
    )


def _less_than_real(evidence: Evidence) -> Finding:
    share = _foot_power(evidence, FNO_96)
    return within(share, (0.0, 1.0 / (1.0 + MINOR))), f"{shown(share)} of real"


def _less_than_transformer(evidence: Evidence) -> Finding:
    loss = ratio(_foot_power(evidence, TRANSFORMER_64), _foot_power(evidence, FNO_96))
    return ordered(loss), f"Transformer-64 has {shown(loss)} times the power"


def _rule_q15(evidence: Evidence) -> Iterator[Statement]:
    says = "FNO-96 lacks power in fine foot motion (5 to 15 Hz): a quarter of real or more is missing"
    yield state(evidence, says, _less_than_real)
    says = "FNO-96 has less of it than Transformer-64"
    yield state(evidence, says, _less_than_transformer)


def _mean_with_interval(values) -> Figure:
    """Return the mean of several values with its 95 % interval (Student's t)."""
    values = np.asarray(values, dtype=np.float64)
    mean = float(values.mean())
    if len(values) < 2:
        return Figure.of(mean)
    half = float(student_t.ppf(0.975, len(values) - 1) * values.std(ddof=1) / np.sqrt(len(values)))
    return Figure(mean, mean - half, mean + half)


def _drift(evidence: Evidence, setting: Setting) -> Finding:
    """Compare the last quarter of the rounds with the first, metric by metric.

    Rounds follow one another, so that these intervals are narrower than those of free repeats.
    """
    table = evidence.table("quality_by_round")
    chosen = table[
        (table["model"] == setting.model)
        & (table["window_frames"] == setting.window)
        & (table["steps"] == setting.steps)
    ]
    verdicts, told = [], []
    for metric, rows in chosen.groupby("metric", sort=False):
        values = rows.sort_values("round")["value"].to_numpy()
        quarter = len(values) // 4
        better_low = NINE_METRICS.get(metric, ("", ""))[1] == "down" or metric in DRIFT_METRICS
        if quarter < 2 or not better_low:
            continue
        late = _mean_with_interval(values[-quarter:])
        growth = ratio(late, _mean_with_interval(values[:quarter]))
        grown = within(growth, (1.0 + TOLERANCE, np.inf))
        verdicts.append(OPEN if grown == HOLDS and growth.low <= 1.0 else grown)
        told.append(f"{metric} {_times_or_percent(growth)}")
    if not verdicts:
        raise NotMeasured(f"{evidence.called('quality_by_round')} no {setting} over 8 rounds or more")
    return combine(verdicts), ", ".join(told)


def _rule_q16(evidence: Evidence) -> Iterator[Statement]:
    for setting in (FNO_96, TRANSFORMER_64, CAMDM):
        says = f"{setting.model}: metrics are 10 % worse in the last quarter of the rounds"
        yield state(evidence, says, _drift, setting, optional=setting != FNO_96)


def _rule_q17(evidence: Evidence) -> Iterator[Statement]:
    published = Setting(PUBLISHED_CAMDM)
    for metric, changed, base in (
        ("trajectory_error", published, CAMDM),
        ("direction_error", published, CAMDM),
        ("smoothness", CAMDM, published),
        ("IRD", published, CAMDM),
    ):
        whose = "PyTorch" if changed == published else "JAX"
        says = f"CAMDM in {whose} has the higher {metric}"
        yield state(evidence, says, _worse, changed, base, metric)


def _in_order(rows: pd.DataFrame) -> float:
    """Return the share of pairs of strengths that a metric puts in order, less that reversed."""
    rows = rows.sort_values("strength")
    figures = [Figure.of(*row) for row in rows[["value", "low", "high"]].to_numpy()]
    signs = [
        {HOLDS: 1, FAILS: -1, OPEN: 0}[ordered(ratio(stronger, weaker))]
        for place, weaker in enumerate(figures)
        for stronger in figures[place + 1 :]
    ]
    return float(np.mean(signs))


def _graded(evidence: Evidence) -> Finding:
    table = evidence.table("corruptions")
    scores: dict[str, list[float]] = {"EMD": [], "FID": []}
    for name, rows in table.groupby("corruption", sort=False):
        for metric, found in scores.items():
            chosen = rows[rows["metric"] == metric]
            if len(chosen) < 3:
                raise NotMeasured(f"corruptions.csv has no three strengths of {name} with {metric}")
            found.append(_in_order(chosen))
    emd, fid = (float(np.mean(scores[metric])) for metric in ("EMD", "FID"))
    verdict = HOLDS if emd - fid > GRADED else FAILS if fid - emd > GRADED else OPEN
    return verdict, f"ordered pairs: EMD {100 * emd:.0f} %, FID {100 * fid:.0f} %"


def _rule_q18(evidence: Evidence) -> Iterator[Statement]:
    says = "EMD puts graded corruptions into their order more often than FID"
    yield state(evidence, says, _graded)


RULES = {
    "Q1": _rule_q1,
    "Q2": _rule_q2,
    "Q3": _rule_q3,
    "Q4": _rule_q4,
    "Q5": _rule_q5,
    "Q6": _rule_q6,
    "Q7": _rule_q7,
    "Q8": _rule_q8,
    "Q9": _rule_q9,
    "Q10": _rule_q10,
    "Q11": _rule_q11,
    "Q12": _rule_q12,
    "Q13": _rule_q13,
    "Q14": _rule_q14,
    "Q15": _rule_q15,
    "Q16": _rule_q16,
    "Q17": _rule_q17,
    "Q18": _rule_q18,
}
"""Claim -> its rule."""
