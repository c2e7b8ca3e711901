"""Verdicts, and the kinds of judgement that a paper's `claims.toml` names.

A claim is a list of statements: small sentences that are true or false of `Evidence` (our records,
or the paper's own tables). What the claim is worth follows from them (`combine`). Three things
decide a statement:

- **A stated figure or range** ("3 to 4 times", `within`). A figure whose whole interval lies inside
  supports it, one whose whole interval lies outside contradicts it; in between nothing can be told.
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

from __future__ import annotations

import functools
import inspect
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, pairwise, product

import numpy as np
import pandas as pd

from f3amd_companion.ledger.evidence import Evidence, Figure, NotMeasured, Setting, known, mean_figure, power_law, ratio
from f3amd_lib.measures.distributions import mean_and_interval
from f3amd_lib.measures.registry import METRICS
from f3amd_lib.papers.printed import NINE_METRICS

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

SAVING_SLACK = 2.0
"""Slack of a stated share of time saved, %. Medians of repeated runs differ by a percent or two."""

CONVERGED = 0.05
"""A metric has converged in the first epoch that comes this close to its best."""

STILL_BETTER = 0.9
"""If that epoch lies in the last tenth of a run, the run was too short to tell."""

GRADED = 0.05
"""Least lead of one metric over another in the share of pairs that it puts in the right order."""

LEAST_METRICS = 5
"""Of the nine of Table 3, so many must be there before "every metric" means something."""

EVERYTHING = (0.0, np.inf)


@dataclass(frozen=True)
class Family:
    """Models that are judged together, as far as they were measured.

    Attributes:
      models: all of them.
      required: those without which nothing is judged.
    """

    models: tuple[Setting, ...]
    required: tuple[Setting, ...]

    def measured(self, look: Callable[[Setting], object]) -> list[Setting]:
        """Return those for which `look` finds all it needs; NotMeasured if a required one lacks it."""
        found = lambda setting: look(setting) if setting in self.required else known(look, setting)
        return [setting for setting in self.models if found(setting) is not None]


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


def _ranged(figures: Sequence[Figure], bounds: tuple[float, float], unit: str, *, gain: bool = True) -> Finding:
    """Judge whether figures lie in a range, each of them a part of the whole; say how many do."""
    verdicts = [within(figure, bounds, gain=gain) for figure in figures]
    text, inside = range_text(figures, unit), verdicts.count(HOLDS)
    if len(figures) > 1 and inside < len(figures):
        text += f", {inside} of {len(figures)} in the range"
    return majority(verdicts), text


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
    "stated": lambda low, high: (low * (1.0 - TOLERANCE), high * (1.0 + TOLERANCE)),
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


def _values_text(figures: Iterable[Figure]) -> str:
    return ", ".join(number_text(figure.value) for figure in figures)


def _list_text(items: Iterable) -> str:
    return ", ".join(f"{item:,}" if isinstance(item, int) else str(item) for item in items)


def _change_text(figure: Figure) -> str:
    if figure.value >= 2.0:
        return f"{number_text(figure.value)}x"
    return f"{100.0 * (figure.value - 1.0):+.3g} %"


def _harm_text(harm: Figure) -> str:
    return f"{_change_text(harm).lstrip('+-')} {'worse' if harm.value >= 1.0 else 'better'}"


def _in_percent(figure: Figure) -> Figure:
    return figure.map(lambda bound: 100.0 * (bound - 1.0))


# ------------------------------------------------------- six kinds that most statements are judged by


def figure(evidence: Evidence, table: str, row: dict, bounds=None, ratio_to=None, unit="", text="{}") -> Finding:
    """Judge one figure of a table, or its ratio to the row that differs from it as `ratio_to` says."""
    found = evidence.figure(table, **row)
    if ratio_to is not None:
        found = ratio(found, evidence.figure(table, **(row | ratio_to)))
    return _compared(found, bounds), text.format(figure_text(found, unit))


def _times_worse(metric: str, figure: Figure, against: Figure) -> Figure:
    """Return how many times worse a figure of a metric is than another; above 1 where it is the worse one."""
    return ratio(against, figure) if METRICS[metric].better == "up" else ratio(figure, against)


def ranked(evidence: Evidence, table: str, metric: str, rows, among=None) -> Finding:
    """Judge whether rows stand in this order, best first: each against the next.

    Args:
      evidence: of one paper or data set.
      table: a table of `SCHEMAS`.
      metric: of `measures/metrics.toml`, which says what is better.
      rows: columns of each row.
      among: columns that all rows share.
    """
    figures = [evidence.figure(table, **(among or {}), **row, metric=metric) for row in rows]
    verdict = majority(ordered(_times_worse(metric, second, first)) for first, second in pairwise(figures))
    return verdict, _values_text(figures)


def leads(evidence: Evidence, table: str, metric: str, rows, among=None) -> Finding:
    """Judge whether the first row is better than every other; arguments as of `ranked`."""
    first, *others = (evidence.figure(table, **(among or {}), **row, metric=metric) for row in rows)
    verdict = every(ordered(_times_worse(metric, other, first)) for other in others)
    return verdict, f"{number_text(first.value)} against {_values_text(others)}"


def _saving(gain: Figure) -> Figure:
    return gain.map(lambda bound: 100.0 * (1.0 - 1.0 / bound))


def _timed(evidence: Evidence, fast: Setting | Family, device: str, characters) -> list[Setting]:
    if isinstance(fast, Setting):
        return [fast]
    return fast.measured(lambda setting: [evidence.time(setting, device, count) for count in characters])


def speedup(
    evidence: Evidence, slow, fast, device, characters, bounds=EVERYTHING, gain=True, unit="x", text="{}"
) -> Finding:
    """Judge how many times as fast one model, or each of a family, is at some numbers of characters.

    With the unit " %" it is the time saved.
    """
    models = _timed(evidence, fast, device, characters)
    figures = [evidence.speedup(slow, model, device, count) for model in models for count in characters]
    verdict, found = _ranged([_saving(one) for one in figures] if unit == " %" else figures, bounds, unit, gain=gain)
    return verdict, text.format(found)


def training_ratio(
    evidence: Evidence, over, under, bounds=None, column="value", text="{figure}x at batch {batch}"
) -> Finding:
    """Judge the training time (or another column) of one model over another's, at the largest shared batch."""
    rows = evidence.rows("training_time", window_frames=over.window, device="GPU")
    sizes = [set(rows.loc[rows["model"] == setting.model, "batch_size"]) for setting in (over, under)]
    if not (shared := set.intersection(*sizes)):
        gap = f"no batch size of both {over.model} and {under.model}, GPU"
        raise NotMeasured(f"{evidence.called('training_time')} {gap}")
    row = {"window_frames": over.window, "batch_size": int(max(shared)), "device": "GPU"}
    found = ratio(*(evidence.figure("training_time", column, model=one.model, **row) for one in (over, under)))
    return _compared(found, bounds, gain=True), text.format(figure=figure_text(found), batch=row["batch_size"])


def _harm(evidence: Evidence, model: Setting, against: Setting, metric: str) -> Figure:
    """Return how many times worse a metric is; above 1 where `model` is the worse one."""
    return _times_worse(metric, evidence.quality(model, metric), evidence.quality(against, metric))


def worse(evidence: Evidence, model, against, metric, bounds=None) -> Finding:
    """Judge whether a model is worse than another in one metric, or by a factor in a range."""
    figures = [evidence.quality(setting, metric) for setting in (model, against)]
    harm = _times_worse(metric, *figures)
    text = f"{' against '.join(map(figure_text, figures))} {METRICS[metric].unit}".rstrip()
    return _compared(harm, bounds), text + (f", {number_text(harm.value)} times worse" if bounds else "")


# ------------------------------------------------------------ functions for a question or two: of times


def speedup_on_some_device(evidence: Evidence, slow, fast, crowds: dict, bounds) -> Finding:
    """Judge the gain in a large crowd (device -> characters), on every device that was timed."""
    times = {f"{device}, {count:,}": (slow, fast, device, count) for device, count in crowds.items()}
    figures = {at: gain for at, timed in times.items() if (gain := known(evidence.speedup, *timed))}
    if not figures:
        evidence.speedup(slow, fast, *next(iter(crowds.items())))  # the reason is that of the first
    verdict = every(within(gain, bounds, gain=True) for gain in figures.values())
    return verdict, ", ".join(f"{figure_text(gain)}x ({at})" for at, gain in figures.items())


def speedup_growth(evidence: Evidence, slow, fast, device, characters) -> Finding:
    """Judge whether the gain of a family is larger with the second number of characters."""
    models = _timed(evidence, fast, device, characters)
    gains = [[evidence.speedup(slow, model, device, count) for count in characters] for model in models]
    growth = [ratio(many, few) for few, many in gains]
    return majority(map(ordered, growth)), f"{range_text(growth)} times the gain"


def speedup_at_each(evidence: Evidence, slow, fast, device, characters) -> Finding:
    """Write the gain at each number of characters (a remark)."""
    gains = {count: evidence.speedup(slow, fast, device, count) for count in characters}
    return REMARK, " and ".join(f"{figure_text(gain)}x at {count:,}" for count, gain in gains.items())


def speedup_above(evidence: Evidence, slow, fast, device, factor) -> Finding:
    """Write at which numbers of characters a gain is passed (a remark)."""
    shared = sorted(evidence.counts(slow, device) & evidence.counts(fast, device))
    counts = [count for count in shared if evidence.speedup(slow, fast, device, count).value > factor]
    return REMARK, f"above {factor:g} at {_list_text(counts)}" if counts else f"nowhere above {factor:g}"


def mean_saving(evidence: Evidence, slow, fast, device, characters, bounds) -> Finding:
    """Judge the time saved, %, on average over the numbers of characters that were timed."""
    shared = sorted(evidence.counts(slow, device) & evidence.counts(fast, device) & set(characters))
    # Without any, the reason is that of the first.
    found = _saving(mean_figure([evidence.speedup(slow, fast, device, count) for count in shared or characters[:1]]))
    return within(found, bounds, gain=True), f"{figure_text(found)} % at {_list_text(shared)}"


def _jax_over_torch(evidence: Evidence, model, released, device, characters, compiler=None) -> dict[int, Figure]:
    """Return time in JAX over time in PyTorch, which has the same network or the released one."""
    peer = model if evidence.counts(model, device, "torch") else released
    shared = evidence.counts(model, device, compiler) & evidence.counts(peer, device, "torch") & set(characters)
    return {
        count: ratio(evidence.time(model, device, count, compiler), evidence.time(peer, device, count, "torch"))
        for count in sorted(shared) or characters[:1]
    }


def jax_over_torch(
    evidence: Evidence, model, released, device, characters, bounds=EVERYTHING, gain=False, compiler=None
) -> Finding:
    """Judge the time in JAX, compiled by XLA ("jax") or "iree", over that in PyTorch at each number of characters."""
    found = _jax_over_torch(evidence, model, released, device, characters, compiler)
    verdict, text = _ranged(list(found.values()), bounds, "", gain=gain)
    by = {"iree": "IREE", "jax": "XLA"}[compiler or evidence.framework]
    at = "" if len(found) == len(characters) else f" at {_list_text(found)}"
    return verdict, f"JAX by {by} / PyTorch {text}{at}"


def speedup_over_torch(evidence: Evidence, slow, released, fast, device, characters) -> Finding:
    """Write how many times as fast a model in JAX is as another one in PyTorch (a remark)."""
    over_torch = _jax_over_torch(evidence, slow, released, device, characters)
    gains = {count: ratio(evidence.speedup(slow, fast, device, count), found) for count, found in over_torch.items()}
    slower = [count for count, gain in gains.items() if gain.value < 1.0]
    return REMARK, f"{range_text(list(gains.values()))}x" + (f", slower at {_list_text(slower)}" if slower else "")


def _exponent(evidence: Evidence, model: Setting, device: str, count: int) -> Figure:
    """Return p of time ~ steps^p."""
    steps = (8, 4, 2, 1)
    return power_law(steps, [evidence.time(Setting(model.model, n), device, count) for n in steps])


def step_exponent(evidence: Evidence, model, device, characters, bounds) -> Finding:
    """Judge the exponent of time against the number of steps."""
    found = _exponent(evidence, model, device, characters)
    return within(found, bounds), f"exponent {figure_text(found)}"


def step_exponent_growth(evidence: Evidence, model, device, characters) -> Finding:
    """Judge whether that exponent is larger with the second number of characters."""
    low, high = (_exponent(evidence, model, device, count) for count in characters)
    text = f"exponent {figure_text(low)} at {characters[0]}, {figure_text(high)} at {characters[1]:,}"
    return ordered(ratio(high.map(np.exp), low.map(np.exp))), text


def _converged_epoch(curve: pd.DataFrame, metric: str, model: str) -> float:
    """Return the first epoch that comes close to the best one; NotMeasured if it may yet fall."""
    curve = curve[curve["metric"] == metric].sort_values("epoch")
    values, up = curve["value"], NINE_METRICS.get(metric, ("", "down"))[1] == "up"
    close = values >= values.max() * (1.0 - CONVERGED) if up else values <= values.min() * (1.0 + CONVERGED)
    reached, last = float(curve.loc[close, "epoch"].iloc[0]), float(curve["epoch"].iloc[-1])
    if reached > STILL_BETTER * last:
        raise NotMeasured(f"{metric} of {model} was still getting better at the last epoch, {last:.3g}")
    return reached


def convergence(evidence: Evidence, model, against) -> Finding:
    """Judge, metric by metric, whether a model converges in no more epochs than another."""
    curves = {setting.model: evidence.rows("quality_by_epoch", model=setting.model) for setting in (model, against)}
    shared = functools.reduce(pd.Index.intersection, (pd.Index(curve["metric"].unique()) for curve in curves.values()))
    if shared.empty:
        gap = next((name for name, curve in curves.items() if curve.empty), "metric of both models")
        raise NotMeasured(f"quality_by_epoch.csv has no {gap}")
    epochs = {name: [_converged_epoch(curves[one], name, one) for one in curves] for name in shared}
    verdict = majority(HOLDS if own <= (1.0 + TOLERANCE) * other else FAILS for own, other in epochs.values())
    return verdict, ", ".join(f"{name} {own:g} against {other:g}" for name, (own, other) in epochs.items())


# ------------------------------------------------------------------------------------- of quality


def _shared_metrics(evidence: Evidence, settings: Sequence[Setting]) -> dict[str, list[Figure]]:
    """Return figures of all settings, by those of the nine metrics that all of them have."""
    figures = {metric: [known(evidence.quality, one, metric) for one in settings] for metric in NINE_METRICS}
    shared = {metric: found for metric, found in figures.items() if None not in found}
    if len(shared) < LEAST_METRICS:
        for asked in product(settings, NINE_METRICS):  # the reason is that of the first gap
            evidence.quality(*asked)
    return shared


def _by_metric(verdicts: Mapping[str, str], text: str, heading: str, notes: Sequence[str]) -> Finding:
    """Sum verdicts by metric up: how many hold, in the place of {} in `text`, and under a heading the notes, if any."""
    held = f"{list(verdicts.values()).count(HOLDS)} of {len(verdicts)}"
    return majority(verdicts.values()), text.format(held) + (heading + ", ".join(notes) if notes else "")


def _spread(settings: Sequence[Setting], figures: Sequence[Figure]) -> tuple[Figure, str, str]:
    """Return largest over least value of a metric, and whose they are."""
    value = lambda pair: pair[1].value
    (largest, most), (least, fewest) = (pick(zip(settings, figures, strict=True), key=value) for pick in (max, min))
    return ratio(most, fewest), largest.model, least.model


def worse_in(evidence: Evidence, model, against, metrics, bounds, quantifier) -> Finding:
    """Judge whether each, or any, of some metrics is worse by a factor in a range."""
    harms = {metric: _harm(evidence, model, against, metric) for metric in metrics}
    order = {"each": (FAILS, OPEN, HOLDS), "any": (HOLDS, OPEN, FAILS)}[quantifier]
    verdict = every((within(harm, bounds) for harm in harms.values()), order)
    texts = (f"{metric} {_harm_text(harm)}" for metric, harm in harms.items())
    return verdict, ", ".join(texts)


def worse_in_every_metric(evidence: Evidence, model, against) -> Finding:
    """Judge, metric by metric, whether a model is worse than another."""
    shared = _shared_metrics(evidence, [model, against])
    verdicts = {metric: ordered(_times_worse(metric, *figures)) for metric, figures in shared.items()}
    better = [metric for metric, verdict in verdicts.items() if verdict == FAILS]
    return _by_metric(verdicts, "worse in {}", ", better in ", better)


def worst_in(evidence: Evidence, model, models) -> Finding:
    """Write in which metrics a model is the last of several (a remark)."""
    shared = _shared_metrics(evidence, [model, *models])
    worst = lambda metric, own, *others: all(_times_worse(metric, own, other).value > 1.0 for other in others)
    return REMARK, _list_text(one for one, figures in shared.items() if worst(one, *figures)) or "in no metric"


def alike(evidence: Evidence, models, bounds) -> Finding:
    """Judge, metric by metric, whether the largest value of several models over the least lies in a range."""
    spreads = {metric: _spread(models, figures) for metric, figures in _shared_metrics(evidence, models).items()}
    verdicts = {metric: within(spread, bounds) for metric, (spread, *_) in spreads.items()}
    apart = [
        f"{metric} {number_text(spread.value)}x ({largest} over {least})"
        for metric, (spread, largest, least) in spreads.items()
        if verdicts[metric] != HOLDS
    ]
    return _by_metric(verdicts, "alike in {}", "; apart: ", apart)


def metric_spread(evidence: Evidence, models, metric, bounds) -> Finding:
    """Judge the largest value of one metric over the least, of a family."""
    models = models.measured(lambda setting: evidence.quality(setting, metric))
    spread, largest, least = _spread(models, [evidence.quality(setting, metric) for setting in models])
    return within(
        spread, bounds
    ), f"{figure_text(_in_percent(spread))} % over {len(models)} models ({least} to {largest})"


def best_of(evidence: Evidence, model, models, metric) -> Finding:
    """Judge whether a model has the best value of a metric in its family."""
    others = [other for other in models.measured(lambda setting: evidence.quality(setting, metric)) if other != model]
    harms = {other.model: _harm(evidence, other, model, metric) for other in others}
    nearest = min(harms, key=lambda name: harms[name].value)
    text = f"next is {nearest} with {figure_text(harms[nearest])} times its {metric}"
    return every(map(ordered, harms.values())), text


def better_at_each_width(evidence: Evidence, better, worse, widths, metric, window=32) -> Finding:
    """Judge, width by width (the one that must be there first), whether one kind of network beats another."""
    pair = lambda width, *kinds: [Setting(f"{kind}-{width}", window=window) for kind in kinds]
    harms = {width: known(_harm, evidence, *pair(width, worse, better), metric) for width in sorted(widths)}
    verdicts = {width: ordered(harm) for width, harm in harms.items() if harm}
    if not verdicts:
        _harm(evidence, *pair(widths[0], better, worse), metric)  # the reason is that of the first
    words = {HOLDS: "yes", FAILS: "no", OPEN: "open"}
    by_verdict = {word: [width for width in verdicts if verdicts[width] == verdict] for verdict, word in words.items()}
    texts = (f"{word} at D = {_list_text(widths)}" for word, widths in by_verdict.items() if widths)
    return majority(verdicts.values()), ", ".join(texts)


def _window_pairs(evidence: Evidence, models: Family, window: int) -> list[tuple[Setting, Setting]]:
    """Return (longer window, usual window) of every model that has both."""
    pair = lambda setting: (Setting(setting.model, window=window), setting)
    return [pair(one) for one in models.measured(lambda one: [evidence.quality(each, "FID") for each in pair(one)])]


def window_loss(evidence: Evidence, models, window, bounds) -> Finding:
    """Judge, metric by metric, whether no model of a family is much worse with longer windows."""
    pairs = _window_pairs(evidence, models, window)
    verdicts, worst = {}, []
    for metric, figures in _shared_metrics(evidence, [setting for pair in pairs for setting in pair]).items():
        harms = [_times_worse(metric, *both) for both in zip(figures[::2], figures[1::2], strict=True)]
        verdicts[metric] = every(within(harm, bounds) for harm in harms)
        if verdicts[metric] != HOLDS:
            harm, (longer, _) = max(zip(harms, pairs, strict=True), key=lambda each: each[0].value)
            worst.append(f"{metric} {_change_text(harm)} ({longer.model})")
    return _by_metric(verdicts, "{} metrics", "; worse: ", worst)


def window_gain(evidence: Evidence, models, window, metric) -> Finding:
    """Write how many models are better with longer windows (a remark)."""
    pairs = _window_pairs(evidence, models, window)
    better = sum(_harm(evidence, *pair, metric).value < 1.0 for pair in pairs)
    return REMARK, f"in {better} of {len(pairs)} models"


def steady_over_steps(evidence: Evidence, model, steps, bounds, least_diversity=0.0) -> Finding:
    """Judge, metric by metric, whether fewer steps give what the model's own number of steps gives.

    A network that gives one motion whatever its noise does so for a dull reason: where samples of
    one condition differ by less than `least_diversity` cm, nothing was kept.
    """
    settings = [model, *(Setting(model.model, count) for count in steps)]
    shared = _shared_metrics(evidence, settings)
    changes = {name: [ratio(figure, own) for figure in fewer] for name, (own, *fewer) in shared.items()}
    verdicts = {name: every(within(change, bounds) for change in some) for name, some in changes.items()}
    every_change = [(name, *each) for name, some in changes.items() for each in zip(steps, some, strict=True)]
    metric, count, change = max(every_change, key=lambda each: abs(np.log(each[2].value)))
    largest = f"{metric} {figure_text(_in_percent(change))} % at {count} step{'s' if count > 1 else ''}"
    verdict, text = _by_metric(verdicts, "{} metrics", "; largest change: ", [largest])
    spread = max((evidence.quality(one, "diversity") for one in settings), key=lambda figure: figure.value)
    if spread.high < least_diversity:
        return FAILS, f"{text}; noise changes nothing: samples differ by {figure_text(spread)} cm at most"
    return verdict, text


def change_between_steps(evidence: Evidence, model, steps) -> Finding:
    """Write the largest change of a metric from each number of steps to the next (a remark)."""
    shared = _shared_metrics(evidence, [Setting(model.model, count) for count in steps])
    values = np.array([[figure.value for figure in figures] for figures in shared.values()])
    changes = 100.0 * np.abs(values[:, 1:] / values[:, :-1] - 1.0).max(axis=0)
    texts = (f"{one} to {other} {change:.2g} %" for (one, other), change in zip(pairwise(steps), changes, strict=True))
    return REMARK, ", ".join(texts)


def moved_by_inputs(evidence: Evidence, model) -> Finding:
    """Write how far a model's estimates move with its noisy input and with the noise level alone (a remark).

    A model that moves with the level makes other motion with other numbers of steps, even if it ignores its input.
    """
    inputs = {"use_of_x": "the noisy input", "use_of_sigma": "the noise level alone"}
    moved = lambda metric: figure_text(evidence.figure("input_use", model=model.model, metric=metric), " cm")
    return REMARK, ", ".join(f"{moved(metric)} with {name}" for metric, name in inputs.items())


def drift(evidence: Evidence, model, metrics, bounds) -> Finding:
    """Judge, metric by metric, how much worse the last quarter of the rounds is than the first.

    Looked at are `metrics` and those of the nine that are better low. Rounds follow one another, so
    that these intervals are narrower than those of free repeats.
    """
    low_ones = {*metrics, *(metric for metric, (_, better) in NINE_METRICS.items() if better == "down")}
    growth = {}
    for metric, rows in evidence.rows("quality_by_round", **model.columns).groupby("metric", sort=False):
        values = rows.sort_values("round")["value"].to_numpy(np.float64)
        if (quarter := len(values) // 4) >= 2 and metric in low_ones:
            late, early = (mean_and_interval(some) for some in (values[-quarter:], values[:quarter]))
            growth[metric] = ratio(*(Figure(one["value"], one["low"], one["high"]) for one in (late, early)))
    if not growth:
        raise NotMeasured(f"{evidence.called('quality_by_round')} no {model} over 8 rounds or more")
    verdicts = {metric: within(found, bounds) for metric, found in growth.items()}
    return _by_metric(verdicts, "{}", ": ", [f"{metric} {_change_text(found)}" for metric, found in growth.items()])


def _order_score(rows: pd.DataFrame) -> float:
    """Return the share of pairs of strengths that a metric puts in order, less that reversed."""
    figures = [Figure.of(*row) for row in rows.sort_values("strength")[["value", "low", "high"]].to_numpy()]
    found = [ordered(ratio(stronger, weaker)) for weaker, stronger in combinations(figures, 2)]
    return (found.count(HOLDS) - found.count(FAILS)) / len(found)


def better_graded(evidence: Evidence, metric, than) -> Finding:
    """Judge whether one metric puts graded corruptions into their order more often than another."""
    table = evidence.rows("corruptions")
    found = [
        [_order_score(rows) for _, rows in table[table["metric"] == one].groupby("corruption") if len(rows) >= 3]
        for one in (metric, than)
    ]
    if min(map(len, found)) < table["corruption"].nunique():
        raise NotMeasured(f"corruptions.csv has not three strengths of each with {metric} and {than}")
    first, second = map(np.mean, found)
    verdict = HOLDS if first - second > GRADED else FAILS if second - first > GRADED else OPEN
    return verdict, f"ordered pairs: {metric} {100 * first:.0f} %, {than} {100 * second:.0f} %"


# ------------------------------------------------------------------------------- of levels of noise


def _over_noise(evidence: Evidence, table: str, model: Setting) -> pd.Series:
    """Return the figures of a model by noise level, low ones first; NotMeasured where there are not three."""
    figures = evidence.rows(table, model=model.model).set_index("sigma")["value"].astype(np.float64).sort_index()
    if len(figures) < 3:
        raise NotMeasured(f"{table}.csv has no three noise levels of {model.model}")
    return figures


def _excess_errors(evidence: Evidence, model: Setting) -> pd.Series:
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
    excess = _excess_errors(evidence, model)
    worst = Figure.of(excess.max())
    text = f"x0 error at most {number_text(worst.value)}x that of linear shrinkage, at sigma {excess.idxmax():.2g}"
    return within(worst, bounds), text


def steadier_over_noise(evidence: Evidence, model, against, bounds) -> Finding:
    """Judge how many times larger that figure is of another model, over the noise levels that both know."""
    curves = [_excess_errors(evidence, setting) for setting in (model, against)]
    low, high = max(curve.index.min() for curve in curves), min(curve.index.max() for curve in curves)
    shared = [curve.loc[low:high] for curve in curves]
    if min(map(len, shared)) < 3:
        raise NotMeasured(f"x0_by_sigma.csv has no three levels that {model.model} and {against.model} both know")
    worst = [curve.max() for curve in shared]
    return within(Figure.of(worst[1] / worst[0]), bounds), " against ".join(f"{number_text(one)}x" for one in worst)


def gradient_growth(evidence: Evidence, model, bounds) -> Finding:
    """Judge the mean gradient norm at the highest third of noise levels over that at the lowest.

    A network that hardly looks at its noise has one gradient for all levels: it has to pass the gate.
    """
    norms = np.log(_over_noise(evidence, "gradient_norm", model))
    third = len(norms) // 3
    gain = Figure.of(np.exp(norms.iloc[-third:].mean()) / np.exp(norms.iloc[:third].mean()))
    return within(gain, bounds), f"{number_text(gain.value)}x from the lowest to the highest third of sigma"


def kinds_of(module: str) -> dict[str, Callable[..., Finding]]:
    """Return the kinds of judgement that a module defines: its public functions that return a finding, by name."""
    functions = inspect.getmembers(sys.modules[module], inspect.isfunction)
    return {name: one for name, one in functions if one.__annotations__.get("return") == "Finding" and name[0] != "_"}


KINDS = kinds_of(__name__)
"""Kind of judgement, as `claims.toml` names it -> function of the evidence and the statement's parameters."""
