"""Verdicts, and the kinds of judgement that a paper's `claims.toml` names.

A claim is a list of statements: small sentences that are true or false of `Evidence` (our records,
or the paper's own tables). What the claim is worth follows from them (`combine`). Three things
decide a statement:

- **A stated figure or range** ("3 to 4 times", `within`). A figure whose whole interval lies inside
  supports it, one whose whole interval lies outside contradicts it; in between it is open.
  A gain beyond the range is another number than the paper's, and has a verdict of its own.
- **Better or worse** (`ordered`). The interval of the ratio must leave out 1. Otherwise the two
  cannot be told apart.
- **Alike.** A range around 1.

A statement on many figures (metrics, models, numbers of characters) goes by `majority`, and says how
many hold.

The thresholds, here and in `claims.toml`, are the same for all claims and for the paper's own tables.
Those of the first ledger have not changed since; it was written when a first quality table of ours
was known, and nothing else.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from itertools import combinations, product

import numpy as np
import pandas as pd

from f3amd_companion.ledger.evidence import (
    NINE_METRICS,
    Evidence,
    Figure,
    NotMeasured,
    known,
    mean_figure,
    power_law,
    ratio,
)
from f3amd_lib.measures.distributions import mean_and_interval
from f3amd_lib.measures.registry import METRICS
from f3amd_lib.papers.printed import PUBLISHED_CAMDM

HOLDS = "holds"
IN_PART = "holds in part"
LARGER = "larger than stated"
FAILS = "does not hold"
OPEN = "cannot be told apart"
UNJUDGED = "not judged"
UNMEASURED = "not measured"
VERDICTS = (HOLDS, IN_PART, LARGER, FAILS, OPEN, UNJUDGED, UNMEASURED)
"""What can be said of a claim, or of a statement."""

REMARK = ""
"""In place of a verdict: a figure that stands beside the others and decides nothing."""

Finding = tuple[str, str]
"""Verdict and text of what was found."""

TOLERANCE = 0.10
"""Slack of a stated factor. The paper gives its factors with one or two digits and a "~"."""

ROUNDING = 0.05
"""Slack of a stated range of factors, whose ends are rounded."""

SAVING_SLACK = 0.5
"""Slack of a stated share of time saved, %: the paper rounds to whole percents."""

GRADED = 0.05
"""Least lead of one metric over another in the share of pairs that it puts in the right order."""

LEAST_METRICS = 5
"""Of the nine of Table 3, so many must be there before "every metric" means something."""

# ------------------------------------------------------------------------------ verdicts and ranges


def combine(verdicts: Iterable[str]) -> str:
    """Return the verdict on a claim from those on its statements.

    All hold: it holds. Some do, and others do not or could not be judged: it holds in part. None
    does: it does not hold where one was contradicted; else it is larger than stated where one is, unless
    another could not be judged. Otherwise nothing can be told apart, judged or measured.
    """
    found = set(verdicts) - {REMARK}
    if found == {HOLDS}:
        return HOLDS
    if found & {HOLDS, IN_PART}:
        return IN_PART
    if UNJUDGED in found:
        found.discard(LARGER)
    return next((verdict for verdict in (FAILS, LARGER, OPEN, UNJUDGED) if verdict in found), UNMEASURED)


def majority(verdicts: Iterable[str]) -> str:
    """Return the verdict on a statement from those on its figures, at least one.

    All hold: it holds. At least half do: it holds in part. More than half lie beyond what was
    stated: it is larger; more than half lie outside on either side: it does not hold. Otherwise
    nothing can be told apart.
    """
    found = list(verdicts)
    share = lambda *wanted: sum(verdict in wanted for verdict in found) / len(found)
    if share(HOLDS) >= 0.5:
        return HOLDS if share(HOLDS) == 1.0 else IN_PART
    if share(LARGER) > 0.5:
        return LARGER
    return FAILS if share(FAILS, LARGER) > 0.5 else OPEN


def every(verdicts: Iterable[str], order: Sequence[str] = (FAILS, LARGER, OPEN, HOLDS)) -> str:
    """Return the verdict on "each of them", the first of an order that is among them: one that fails is enough."""
    found = set(verdicts)
    return next(verdict for verdict in order if verdict in found)


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
        return LARGER if gain else FAILS
    return HOLDS if low <= figure.low and figure.high <= high else OPEN


def ordered(harm: Figure) -> str:
    """Judge whether something is worse, from a ratio that is above 1 where it is."""
    if harm.low > 1.0:
        return HOLDS
    return FAILS if harm.high < 1.0 else OPEN


def _compared(figure: Figure, bounds: tuple[float, float] | None, *, gain: bool = False) -> str:
    return ordered(figure) if bounds is None else within(figure, bounds, gain=gain)


def stated_factor(figure: float, over: float = 1.0) -> tuple[float, float]:
    """Return the bounds of "about figure / over times", a factor above 1."""
    factor = figure / over
    # A gain of 9 % with a slack of 10 % would be no gain: half of it must be left.
    slack = min(TOLERANCE * factor, (factor - 1.0) / 2.0)
    return factor - slack, factor + slack


def equal_range(slack: float) -> tuple[float, float]:
    """Return the bounds of ratios that count as 1, as far below as above."""
    return 1.0 / (1.0 + slack), 1.0 + slack


RANGES = {
    "within": lambda low, high: (low, high),
    "stated": lambda low, high: (low * (1.0 - ROUNDING), high * (1.0 + ROUNDING)),
    "about": stated_factor,
    "alike": equal_range,
    "saving": lambda low, high: (low - SAVING_SLACK, high + SAVING_SLACK),
}
"""Range of a statement, as `claims.toml` names it -> function that makes bounds of its numbers, with slack."""


# -------------------------------------------------------------------------------------- words


def number_text(value: float) -> str:
    """Write a number with three digits, or all those before the point."""
    if not np.isfinite(value):
        return "∞"
    return f"{value:,.0f}" if abs(value) >= 100 else f"{value:.3g}"


def figure_text(figure: Figure, unit: str = "") -> str:
    """Write a figure, with its interval where it has one."""
    text = f"{number_text(figure.value)}{unit}"
    if figure.low == figure.high:
        return text
    return f"{text} ({number_text(figure.low)} to {number_text(figure.high)})"


def range_text(figures: Sequence[Figure], unit: str = "") -> str:
    """Write the least and the largest of some figures; a single one with its interval."""
    if len(figures) == 1:
        return figure_text(figures[0], unit)
    values = [figure.value for figure in figures]
    return f"{number_text(min(values))} to {number_text(max(values))}{unit}"


def _list_text(items: Iterable) -> str:
    return ", ".join(f"{item:,}" if isinstance(item, int) else str(item) for item in items)


def _change_text(figure: Figure, interval: bool = False) -> str:
    text = lambda one: f"{number_text(one)}x" if figure.value >= 2.0 else f"{100.0 * (one - 1.0):+.3g} %"
    around = f" [{text(figure.low)}, {text(figure.high)}]" if interval and figure.low < figure.high else ""
    return text(figure.value) + around


# ------------------------------------------------- six kinds that most statements are judged by
#
# A model is its row in a table of `SCHEMAS` (model, window_frames, steps, and framework where it is not the
# evidence's own); a family has `models`, of which the `required` ones must have been measured.


def figure(evidence: Evidence, table: str, row: dict, bounds=None, ratio_to=None, unit="", text="{}") -> Finding:
    """Judge one figure of a table, or its ratio to the row that differs from it as `ratio_to` says."""
    found = evidence.figure(table, **row)
    if ratio_to is not None:
        found = ratio(found, evidence.figure(table, **(row | ratio_to)))
    return _compared(found, bounds), text.format(figure_text(found, unit))


def _times_worse(metric: str, figure: Figure, against: Figure) -> Figure:
    """Return how many times worse a figure of a metric is than another; above 1 where it is the worse one."""
    return ratio(against, figure) if METRICS[metric].better == "up" else ratio(figure, against)


def ranked(evidence: Evidence, table: str, metric: str, rows, among=None, coordinates=1) -> Finding:
    """Judge whether rows (their columns, and `among` for all) stand in this order, best first.

    A paper may have divided the first row's figure by coordinates instead of points, so many of each: where that
    decides, nothing can be told.
    """

    def judge(figures: Sequence[Figure]) -> str:
        """Compare all pairs. The best must be right; one other pair that is contradicted leaves "in part" at most."""
        pairs = [ordered(_times_worse(metric, second, first)) for first, second in combinations(figures, 2)]
        return FAILS if FAILS in pairs[: len(figures) - 1] else majority(pairs)

    return _counted(evidence, judge, ", ", table, metric, rows, among, coordinates)


def leads(evidence: Evidence, table: str, metric: str, rows, among=None, coordinates=1) -> Finding:
    """Judge whether the first row is better than every other; arguments as of `ranked`."""
    judge = lambda figures: every(ordered(_times_worse(metric, other, figures[0])) for other in figures[1:])
    return _counted(evidence, judge, " against ", table, metric, rows, among, coordinates)


def _counted(evidence: Evidence, judge: Callable, between: str, table, metric, rows, among, coordinates) -> Finding:
    """Return what `judge` says of rows, or that nothing can be told where the count of coordinates decides."""
    first, *others = (evidence.figure(table, **(among or {}), **row, metric=metric) for row in rows)
    counts = {1, coordinates} if evidence.printed else {1}
    firsts = [first.map(lambda bound, count=count: count * bound) for count in sorted(counts)]
    verdicts = {judge([one, *others]) for one in firsts}
    by_points = "".join(f" ({number_text(one.value)} if by points)" for one in firsts[1:])
    values = ", ".join(number_text(other.value) for other in others)
    return verdicts.pop() if len(verdicts) == 1 else OPEN, f"{number_text(first.value)}{by_points}{between}{values}"


def _measured(models: Mapping | list, look: Callable[[Mapping], object]) -> list[Mapping]:
    """Return the models of a family for which `look` finds all it needs; NotMeasured if a required one lacks it.

    Of a plain list all are required.
    """
    models = models if isinstance(models, Mapping) else {"models": models, "required": models}
    found = lambda model: look(model) if model in models["required"] else known(look, model)
    return [model for model in models["models"] if found(model) is not None]


def _time(evidence: Evidence, model: Mapping, device: str, count: int) -> Figure:
    row = {**model, "framework": model.get("framework", evidence.framework), "characters": count, "device": device}
    return evidence.figure("synthesis_time", **row)


def _gain(evidence: Evidence, slow: Mapping, fast: Mapping, device: str, count: int) -> Figure:
    """Return how many times as fast `fast` is."""
    return ratio(_time(evidence, slow, device, count), _time(evidence, fast, device, count))


def _timed(evidence: Evidence, models: Mapping, device: str, characters) -> list[Mapping]:
    """Return the models of a family, or the one that is given, which were timed with all these characters."""
    look = lambda model: [_time(evidence, model, device, count) for count in characters]
    return _measured(models, look) if "required" in models else [models]


def speedup(
    evidence: Evidence, slow, fast, device, characters, bounds=(0.0, np.inf), gain=True, unit="x", text="{}",
    some=False, mean=False,
) -> Finding:  # fmt: skip
    """Judge how many times as fast one model, or each of a family, is at some numbers of characters.

    With the unit " %" it is the time saved. `some`: at those that were timed, at least half; `mean`: on average.
    """
    timed = lambda count: known(_gain, evidence, slow, fast, device, count)
    counts = list(filter(timed, characters)) if some or mean else characters
    if len(counts) < len(characters) * (0.5 if some else 1.0):
        counts = characters  # the reason is that of the first gap
    models = _timed(evidence, fast, device, counts)
    figures = [_gain(evidence, slow, model, device, count) for model in models for count in counts]
    figures = [mean_figure(figures)] if mean else figures
    if unit == " %":
        figures = [one.map(lambda bound: 100.0 * (1.0 - 1.0 / bound)) for one in figures]
    verdicts = [within(one, bounds, gain=gain) for one in figures]
    found, inside = range_text(figures, unit), verdicts.count(HOLDS)
    if len(figures) > 1 and inside < len(figures):
        found += f", {inside} of {len(figures)} in the range"
    at = f" at {_list_text(counts)}" if mean or len(counts) < len(characters) else ""
    return majority(verdicts), text.format(found) + at


def training_ratio(
    evidence: Evidence, over, under, bounds=None, column="value", text="{figure}x at batch {batch}"
) -> Finding:
    """Judge the training time (or another column) of one model over another's, at the largest shared batch."""
    row = {"window_frames": over["window_frames"], "device": "GPU"}
    names, rows = (over["model"], under["model"]), evidence.rows("training_time", **row)
    if not (shared := set.intersection(*(set(rows.loc[rows["model"] == name, "batch_size"]) for name in names))):
        raise NotMeasured(f"{evidence.called('training_time')} no batch size of both {' and '.join(names)}, GPU")
    row |= {"batch_size": int(max(shared))}
    found = ratio(*(evidence.figure("training_time", column, model=name, **row) for name in names))
    return _compared(found, bounds, gain=True), text.format(figure=figure_text(found), batch=row["batch_size"])


def _quality(evidence: Evidence, model: Mapping, metric: str) -> Figure:
    """Return a metric of a model; the published one has a window and a number of steps of its own."""
    if model["model"] == PUBLISHED_CAMDM:
        steps = evidence.rows("quality", model=PUBLISHED_CAMDM)["steps"]
        model = {"model": PUBLISHED_CAMDM, "steps": max(steps, default=8)}
    return evidence.figure("quality", **model, metric=metric)


def _harm(evidence: Evidence, model: Mapping, against: Mapping, metric: str) -> Figure:
    """Return how many times worse a metric is; above 1 where `model` is the worse one."""
    return _times_worse(metric, _quality(evidence, model, metric), _quality(evidence, against, metric))


def worse(evidence: Evidence, model, against, metric, bounds=None) -> Finding:
    """Judge whether a model is worse than another in one metric, or by a factor in a range."""
    figures = [_quality(evidence, one, metric) for one in (model, against)]
    harm = _times_worse(metric, *figures)
    text = f"{' against '.join(map(figure_text, figures))} {METRICS[metric].unit}".rstrip()
    return _compared(harm, bounds), text + (f", {number_text(harm.value)} times worse" if bounds else "")


# ------------------------------------------------------------ functions for a question or two: of times


def speedup_growth(evidence: Evidence, slow, fast, device, characters) -> Finding:
    """Judge whether the gain of a family is larger with the second number of characters."""
    models = _timed(evidence, fast, device, characters)
    gains = [[_gain(evidence, slow, model, device, count) for count in characters] for model in models]
    growth = [ratio(many, few) for few, many in gains]
    return majority(map(ordered, growth)), f"{range_text(growth)} times the gain"


def step_exponent(evidence: Evidence, model, device, characters, bounds=None) -> Finding:
    """Judge the exponent p of time ~ steps^p, or of two numbers of characters whether it is larger with the second."""
    steps = (8, 4, 2, 1)
    times = lambda count: [_time(evidence, model | {"steps": each}, device, count) for each in steps]
    found = [power_law(steps, times(count)) for count in characters]
    text = ", ".join(f"{figure_text(one)} at {count:,}" for one, count in zip(found, characters, strict=True))
    judged = found[0] if bounds else ratio(found[1].map(np.exp), found[0].map(np.exp))
    return _compared(judged, bounds), f"exponent {text}"


# ------------------------------------------------------------------------------------- of quality


def _shared_metrics(evidence: Evidence, models: Sequence[Mapping]) -> dict[str, list[Figure]]:
    """Return figures of all models, by those of the nine metrics that all of them have."""
    figures = {metric: [known(_quality, evidence, one, metric) for one in models] for metric in NINE_METRICS}
    shared = {metric: found for metric, found in figures.items() if None not in found}
    if len(shared) < LEAST_METRICS:
        for asked in product(models, NINE_METRICS):  # the reason is that of the first gap
            _quality(evidence, *asked)
    return shared


def _by_metric(changes: Mapping[str, Mapping[str, Figure]], bounds=None) -> Finding:
    """Judge, metric by metric, whether each of its changes lies in a range; without one, whether each is for the worse.

    Told is how many metrics hold, and the largest change of each of the others, or of all where all hold.
    """
    size = lambda named: abs(np.log(max(named[1].value, 1e-9)))
    verdicts, largest = {}, {}
    for metric, some in changes.items():
        verdicts[metric] = every(_compared(one, bounds) for one in some.values())
        apart = {name: one for name, one in some.items() if _compared(one, bounds) != HOLDS}
        largest[metric] = max((apart or some).items(), key=size)
    others = [metric for metric in verdicts if verdicts[metric] != HOLDS]
    told = others or [max(largest, key=lambda metric: size(largest[metric]))]
    notes = (f"{metric} {_change_text(largest[metric][1], interval=True)} ({largest[metric][0]})" for metric in told)
    text = f"{len(verdicts) - len(others)} of {len(verdicts)} metrics; {'not shown' if others else 'largest change'}: "
    return majority(verdicts.values()), text + ", ".join(notes)


def _spread(models: Sequence[Mapping], figures: Sequence[Figure]) -> tuple[Figure, str, str]:
    """Return largest over least value of a metric, and whose they are."""
    values = [figure.value for figure in figures]
    most, least = (int(pick(values)) for pick in (np.argmax, np.argmin))
    return ratio(figures[most], figures[least]), models[most]["model"], models[least]["model"]


def worse_in(evidence: Evidence, model, against, metrics, bounds, quantifier) -> Finding:
    """Judge whether each, or any, of some metrics is worse by a factor in a range."""
    harms = {metric: _harm(evidence, model, against, metric) for metric in metrics}
    order = {"each": (FAILS, OPEN, HOLDS), "any": (HOLDS, OPEN, FAILS)}[quantifier]
    amount = lambda harm: f"{_change_text(harm).lstrip('+-')} {'worse' if harm.value >= 1.0 else 'better'}"
    texts = (f"{metric} {amount(harm)}" for metric, harm in harms.items())
    return every((within(harm, bounds) for harm in harms.values()), order), ", ".join(texts)


def alike(evidence: Evidence, models, bounds) -> Finding:
    """Judge, metric by metric, whether the largest value of several models over the least lies in a range."""
    spreads = {metric: _spread(models, figures) for metric, figures in _shared_metrics(evidence, models).items()}
    return _by_metric({metric: {f"{most} over {least}": one} for metric, (one, most, least) in spreads.items()}, bounds)


def metric_spread(evidence: Evidence, models, metric, bounds) -> Finding:
    """Judge the largest value of one metric over the least, of a family."""
    models = _measured(models, lambda model: _quality(evidence, model, metric))
    spread, largest, least = _spread(models, [_quality(evidence, model, metric) for model in models])
    percent = figure_text(spread.map(lambda bound: 100.0 * (bound - 1.0)))
    return within(spread, bounds), f"{percent} % over {len(models)} models ({least} to {largest})"


def best_of(evidence: Evidence, model, models, metric) -> Finding:
    """Judge whether a model has the best value of a metric in its family."""
    others = [one for one in _measured(models, lambda one: _quality(evidence, one, metric)) if one != model]
    harms = {one["model"]: _harm(evidence, one, model, metric) for one in others}
    nearest = min(harms, key=lambda name: harms[name].value)
    text = f"next is {nearest} with {figure_text(harms[nearest])} times its {metric}"
    return every(map(ordered, harms.values())), text


def better_at_each_width(evidence: Evidence, better, worse, widths, metric, window=32) -> Finding:
    """Judge, width by width (the one that must be there first), whether one kind of network beats another."""
    model = lambda kind, width: {"model": f"{kind}-{width}", "window_frames": window, "steps": 8}
    harm = lambda *pair: ordered(_harm(evidence, *pair, metric))
    verdicts = {width: known(harm, model(worse, width), model(better, width)) for width in sorted(widths)}
    if not any(verdicts.values()):
        harm(model(better, widths[0]), model(worse, widths[0]))  # the reason is that of the first
    by_verdict = {one: [width for width in verdicts if verdicts[width] == one] for one in (HOLDS, FAILS, OPEN)}
    words = {HOLDS: "yes", FAILS: "no", OPEN: "open"}
    texts = (f"{words[one]} at D = {_list_text(widths)}" for one, widths in by_verdict.items() if widths)
    return majority(filter(None, verdicts.values())), ", ".join(texts)


def every_metric(evidence: Evidence, models, ratio_to, bounds=None, either_way=False, least_diversity=0.0) -> Finding:
    """Judge, metric by metric, models (of a family those that are measured) against rows that `ratio_to` says differ.

    Asked is whether each is worse, with `bounds` how many times worse, `either_way` how many times as large. A network
    that gives one motion whatever its noise is alike in any number of steps for a dull reason: where samples of one
    condition differ by less than `least_diversity` cm, nothing was kept.
    """
    pair = lambda model: (model, model | ratio_to)
    models = _measured(models, lambda model: [_quality(evidence, each, "FID") for each in pair(model)])
    shared = _shared_metrics(evidence, [each for model in models for each in pair(model)])
    steps = lambda count: f"{count} step{'s' * (count > 1)}"
    labels = [steps(model["steps"]) if "steps" in ratio_to else model["model"] for model in models]
    change = lambda metric, *figures: ratio(*figures) if either_way else _times_worse(metric, *figures)
    changes = {
        name: [change(name, *each) for each in zip(some[::2], some[1::2], strict=True)] for name, some in shared.items()
    }
    verdict, text = _by_metric({name: dict(zip(labels, some, strict=True)) for name, some in changes.items()}, bounds)
    if least_diversity:
        spread = max(_quality(evidence, one, "diversity") for model in models for one in pair(model))
        if spread.high < least_diversity:
            return FAILS, f"{text}; noise changes little: samples differ by {figure_text(spread)} cm at most"
    return verdict, text


def drift(evidence: Evidence, model, metrics, bounds) -> Finding:
    """Judge, metric by metric, how much worse the last quarter of the rounds is than the first.

    Looked at are `metrics` and those of the nine that are better low. Rounds follow one another, so
    that these intervals are narrower than those of free repeats.
    """
    growth, metrics = {}, {*metrics, *(metric for metric, (_, better) in NINE_METRICS.items() if better == "down")}
    for metric, rows in evidence.rows("quality_by_round", **model).groupby("metric", sort=False):
        values = rows.sort_values("round")["value"].to_numpy(np.float64)
        if (quarter := len(values) // 4) >= 2 and metric in metrics:
            late, early = (mean_and_interval(some) for some in (values[-quarter:], values[:quarter]))
            growth[metric] = ratio(*(Figure(one["value"], one["low"], one["high"]) for one in (late, early)))
    if not growth:
        raise NotMeasured(f"quality_by_round.csv has no {model['model']} over 8 rounds or more")
    return _by_metric({metric: {model["model"]: found} for metric, found in growth.items()}, bounds)


def _order_score(rows: pd.DataFrame) -> float:
    """Return the share of pairs of strengths that a metric puts in order, less that reversed."""
    figures = [Figure.of(*row) for row in rows.sort_values("strength")[["value", "low", "high"]].to_numpy()]
    found = [ordered(ratio(stronger, weaker)) for weaker, stronger in combinations(figures, 2)]
    return (found.count(HOLDS) - found.count(FAILS)) / len(found)


def better_graded(evidence: Evidence, metric, than) -> Finding:
    """Judge whether one metric puts graded corruptions into their order more often than another."""
    table = evidence.rows("corruptions")
    graded = table.groupby(["metric", "corruption"]).filter(lambda rows: len(rows) >= 3)
    found = {one: [*graded[graded["metric"] == one].groupby("corruption")] for one in (metric, than)}
    if min(map(len, found.values())) < table["corruption"].nunique():
        raise NotMeasured(f"corruptions.csv has not three strengths of each with {metric} and {than}")
    first, second = (np.mean([_order_score(rows) for _, rows in some]) for some in found.values())
    verdict = HOLDS if first - second > GRADED else FAILS if second - first > GRADED else OPEN
    return verdict, f"ordered pairs: {metric} {100 * first:.0f} %, {than} {100 * second:.0f} %"


# ------------------------------------------------------------------------------- of levels of noise


def _over_noise(evidence: Evidence, table: str, model: str) -> pd.Series:
    """Return the figures of a model by noise level, low ones first; NotMeasured where there are not three."""
    figures = evidence.rows(table, model=model).set_index("sigma")["value"].astype(np.float64).sort_index()
    if len(figures) < 3:
        raise NotMeasured(f"{table}.csv has no three noise levels of {model}")
    return figures


def _excess_errors(evidence: Evidence, model: str) -> pd.Series:
    """Return the x0 error of a model over that of linear shrinkage, by noise level.

    Where x0 has the deviation s, the estimate x s² / (s² + sigma²) is off by s sigma / sqrt(s² + sigma²):
    exact for independent normal numbers, and more than an exact denoiser's error for all others. s is the
    error at the highest level, where nothing is left to see, and at most 1, the deviation of all data.
    """
    error = _over_noise(evidence, "x0_by_sigma", model)
    spread = min(error.iloc[-1], 1.0)
    return error * np.hypot(spread, error.index) / (spread * error.index)


def steady_over_noise(evidence: Evidence, model, bounds) -> Finding:
    """Judge, of all noise levels, the largest x0 error over that of linear shrinkage.

    An exact denoiser of Gaussian data reads 1. One that ignores its input has one error for all
    levels, and at a low level many times what is due.
    """
    excess = _excess_errors(evidence, model["model"])
    text = f"x0 error at most {number_text(excess.max())}x that of linear shrinkage, at sigma {excess.idxmax():.2g}"
    return within(Figure.of(excess.max()), bounds), text


def steadier_over_noise(evidence: Evidence, model, against, bounds) -> Finding:
    """Judge how many times larger that figure is of another model, over the noise levels that both know."""
    curves = [_excess_errors(evidence, one["model"]) for one in (model, against)]
    low, high = max(curve.index.min() for curve in curves), min(curve.index.max() for curve in curves)
    own, other = (curve.loc[low:high].max() for curve in curves)
    return within(Figure.of(other / own), bounds), f"{number_text(own)}x against {number_text(other)}x"


def gradient_growth(evidence: Evidence, model, bounds) -> Finding:
    """Judge the mean gradient norm at the highest third of noise levels over that at the lowest.

    A network that hardly looks at its noise has one gradient for all levels: it has to pass the gate.
    """
    norms = np.log(_over_noise(evidence, "gradient_norm", model["model"]))
    third = len(norms) // 3
    gain = Figure.of(np.exp(norms.iloc[-third:].mean() - norms.iloc[:third].mean()))
    return within(gain, bounds), f"{number_text(gain.value)}x from the lowest to the highest third of sigma"
