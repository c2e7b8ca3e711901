"""What claims are judged by: figures with intervals, read from our records or the paper's tables.

Both come in one form, so that one rule judges both: tidy tables of `SCHEMAS`, models by their
presets' names. A figure that is not there is `NotMeasured`, with the reason; a table that says
nothing about its origin, or something else than the folder it lies in, is an error.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd

from f3amd_lib.ground.names import asked_network, check_known, counted_cores, nearest_hint
from f3amd_lib.ground.papers import load_paper_file, load_paper_table, paper_folders
from f3amd_lib.ground.profiles import DATASETS, PROFILES
from f3amd_lib.ground.records import folder_reason, read_table
from f3amd_lib.measures.distributions import intervals_over_repeats, mean_and_interval, of_seeds
from f3amd_lib.measures.walking import CHECKS
from f3amd_lib.networks import presets
from f3amd_lib.papers.printed import PUBLISHED_CAMDM, SCHEMAS, printed_tables

# --------------------------------------------------------------------------------- tables as claims want them

TIMES = ("synthesis_time", "training_time")
"""Tables that hang on the device."""

_VALUES = {"x0_by_sigma": "x0_error"}

NINE_METRICS = {
    row.metric: (row.unit, row.better)
    for row in load_paper_table(3).drop_duplicates("metric")[["metric", "unit", "better"]].itertuples(index=False)
}
"""The metrics of Table 3, in its order -> (unit, "up" or "down")."""

OF_TEXT = tuple(name for name in SCHEMAS if name.startswith("text_"))
"""Tables of text to motion. Each row also names `trained`, the model that was (a smaller one of ours may stand in for
the paper's), and `windows`, the motions that it was trained on."""

REFERENCE_ROWS = ("real", "frozen pose", "shuffled frames", "noisy motion", PUBLISHED_CAMDM, "CAMDM, leading")
"""Names in the model column that are no presets."""


def _with_interval_of_median(table: pd.DataFrame) -> pd.DataFrame:
    """Put the interval of the median of timed rounds in the place of their spread.

    Records have it as `median_low` and `median_high`. Older ones have the 5 and 95 % quantiles of the
    rounds and their number alone: as for a normal distribution, on either side of its own, the median
    reaches 1.96 sqrt(pi / 2) / sqrt(rounds) deviations, and those quantiles 1.645.
    """
    if "rounds" not in table:
        return table
    reach = 1.96 / 1.645 * np.sqrt(np.pi / 2.0 / table["rounds"])
    bounds = {bound: table["value"] + reach * (table[bound] - table["value"]) for bound in ("low", "high")}
    known = {bound: table.get(f"median_{bound}", about).fillna(about) for bound, about in bounds.items()}
    return table.assign(**known)


def checked_table(name: str, table: pd.DataFrame, where: str, others: Sequence[str] = ()) -> pd.DataFrame:
    """Return a table in the form of `SCHEMAS`, undefined figures left out; ValueError if broken.

    `others` are models that are no presets.
    """
    keys = SCHEMAS[name]
    table = table.rename(columns={_VALUES.get(name, "value"): "value"})
    if name == "walking" and set(keys) - set(table) == {"metric"}:  # a row per style and seed, its figures side by side
        means = table.groupby(keys[:-1])[[check for check in CHECKS if check in table]].mean()
        table = means.melt(var_name="metric", ignore_index=False).reset_index()
    if name in TIMES:
        table = _with_interval_of_median(table)
    for needed in (*keys, "value"):
        if needed not in table:
            raise ValueError(f"{where}: needs a column {needed!r}, it has {', '.join(map(str, table.columns))}")
    undefined = {bound: float("nan") for bound in ("low", "high") if bound not in table}  # nothing was repeated
    table = table[table["value"].notna()].assign(**undefined)
    astray = ~np.isfinite(table["value"]) | (table["low"] > table["value"]) | (table["high"] < table["value"])
    faults = {
        "a figure that is infinite or outside its interval": astray,
        "two rows": table.duplicated([*keys, *{"seed", "length"} & {*table}]),
    }
    if name == "quality" and "unit" in table:
        wanted = table["metric"].map({metric: unit for metric, (unit, _) in NINE_METRICS.items()})
        faults["another unit than the paper"] = wanted.notna() & (table["unit"].astype(object).fillna("") != wanted)
    for fault, rows in faults.items():
        if rows.any():
            raise ValueError(f"{where}: has {fault} of {', '.join(map(str, table.loc[rows, keys].iloc[0]))}")
    for model in table["model"].unique() if "model" in table else ():
        if model not in others:
            check_model(model, where)
    if "device" in table and not set(table["device"]) <= {"CPU", "GPU"}:
        raise ValueError(f"{where}: device must be CPU or GPU, got {table['device'].unique()}")
    return table


def check_model(model: str, where: str) -> None:
    """Raise ValueError for a name that is neither a preset's own nor one of `REFERENCE_ROWS`."""
    try:
        known = model in REFERENCE_ROWS or presets.find_preset(model).name == model
    except ValueError:
        known = False
    if not known:
        raise ValueError(f"{where}: unknown model {model!r}{nearest_hint(model, [*presets.PRESETS, *REFERENCE_ROWS])}")


# ----------------------------------------------------------------------------------------- what is missing


class NotMeasured(LookupError):
    """A figure that a claim needs is not among the records; the message says which."""

    known = 1


class NoTable(NotMeasured):
    """The whole table is not there: the least that can be said."""

    known = 0


def known(look: Callable, *arguments, **named):
    """Return what a look into the records finds, None where it was not measured."""
    try:
        return look(*arguments, **named)
    except NotMeasured:
        return None


# ---------------------------------------------------------------------------- figures and intervals


class Figure(NamedTuple):
    """A number, the mean over seeds or the median of times, with its 95 % interval; all three equal for one repeat.

    `trainings` has what each network of the mean shows, digest of its weights -> value, where that is on record.
    """

    value: float
    low: float
    high: float
    trainings: Mapping[str, float] | None = None

    @staticmethod
    def of(value, low=np.nan, high=np.nan, trainings=None) -> Figure:
        """Make a figure; bounds that are NaN (a single repeat) become the value itself."""
        return Figure(*(float(value if np.isnan(bound) else bound) for bound in (value, low, high)), trainings)

    def map(self, function: Callable[[float], float]) -> Figure:
        """Return the figure under a rising function."""
        return Figure(*map(function, self[:3]))


def _combine_logs(figures: Sequence[Figure], weights) -> Figure:
    """Return exp of the weighted sum of logarithms of positive figures, with its interval."""
    weights = np.asarray(weights, dtype=np.float64)
    with np.errstate(divide="ignore"):
        value, low, high = np.log(np.maximum(np.transpose([figure[:3] for figure in figures]), 0.0))
    sides = np.where(weights > 0, [value - low, high - value], [high - value, value - low])
    down, up = np.sqrt(np.sum((weights * sides) ** 2, axis=1))
    return Figure(*(float(np.exp(weights @ value + reach)) for reach in (0.0, -down, up)))


def ratio(numerator: Figure, denominator: Figure) -> Figure:
    """Return the quotient of two figures with its interval.

    Figures of the same networks are paired: the interval is Student's, of their logarithms. Others are independent,
    and the interval is recovered from those of the two logarithms: distances from value to bound add
    up in squares. The quotient is infinite for a denominator of 0, and 1 for 0 / 0.

    Raises:
      ValueError: for a negative figure.

    Source: Zou and Donner 2008, "Construction of confidence intervals about effect measures".
    """
    if min(numerator.value, denominator.value) < 0:
        raise ValueError(f"a ratio of {numerator.value} and {denominator.value} means nothing")
    if numerator.value > 0 and denominator.value > 0:
        above, below = (one.trainings or {} for one in (numerator, denominator))
        if len(above) > 1 and above.keys() == below.keys() and min(*above.values(), *below.values()) > 0:
            paired = mean_and_interval([np.log(above[one] / below[one]) for one in above])
            return Figure(*(float(np.exp(paired[bound])) for bound in ("value", "low", "high")))
        return _combine_logs([numerator, denominator], [1.0, -1.0])
    # Logarithms have no say about 0: take the widest quotients that the bounds allow.
    divide = lambda a, b: a / b if b > 0 else (float("inf") if a > 0 else 1.0)
    value = divide(numerator.value, denominator.value)
    low = divide(max(numerator.low, 0.0), denominator.high)
    high = divide(numerator.high, max(denominator.low, 0.0))
    return Figure(value, min(low, value), max(high, value))


def mean_figure(figures: Sequence[Figure]) -> Figure:
    """Return the geometric mean of positive figures with its interval."""
    return _combine_logs(figures, np.full(len(figures), 1.0 / len(figures)))


def power_law(x: Sequence[float], figures: Sequence[Figure]) -> Figure:
    """Fit figure = c x^p by least squares of logarithms and return p with its interval; all are positive."""
    spread = np.log(x) - np.mean(np.log(x))
    return _combine_logs(figures, spread / np.sum(spread**2)).map(lambda bound: float(np.log(bound)))


# ------------------------------------------------------------------------------------------- tables


OF_TRAINED_NETWORKS = (
    "quality", "quality_by_round", "foot_spectrum", "x0_by_sigma", "gradient_norm", "recipe_errors", "convergence",
)  # fmt: skip
"""Tables that say how well a network does: what is judged by them passes the gate (`ledger.gate`)."""

OF_TIME = ("sampling_seconds",)
"""Metrics of text to motion that hang on a network's size and not on its weights."""


class Source(NamedTuple):
    """Where figures come from: a table of `SCHEMAS`, its path with the first digits of its checksum, and the device."""

    name: str
    place: str
    hardware: str


class Network(NamedTuple):
    """A trained network that a rule looked up.

    Attributes:
      model, trained: its row, and the preset that stands in for that here.
      window: frames of a window.
      table, row: of text to motion, the table and the columns that name the row.
      seeds, windows, parameters: trainings, motions of each, and numbers of its weights; 0 where the table has none.
      timed: only its seconds were asked for.
    """

    model: str
    trained: str
    window: int = 0
    table: str = ""
    row: tuple = ()
    seeds: int = 0
    windows: int = 0
    parameters: int = 0
    timed: bool = False


class Evidence:
    """Figures of one data set and profile, or of a paper, looked up by what they are about.

    Attributes:
      framework: "jax", or "iree" for the paper, whose networks in JAX were compiled so.
      printed: whether these are a paper's tables.
      sources: the tables that were looked into since `forget`, in that order and as often.
      networks: the trained networks whose figures were looked up since then.
      at: what was seen of the same networks at another length, this share of theirs; None where nothing was.
    """

    def __init__(self, load: Callable, framework: str = "jax", at: Callable = lambda share: None):
        """Args: `load(name)` returns (table, record, path) or raises NotMeasured."""
        self.at = functools.cache(at)
        self.framework, self.printed = framework, framework != "jax"
        # A ledger asks for thousands of figures, of few tables and by few values of a column.
        self._load = functools.cache(load)
        self._holding = functools.cache(lambda name, column, value: (self._load(name)[0][column] == value).to_numpy())
        self.forget()

    def forget(self) -> None:
        """Forget what was looked up; whoever wants to know what a rule looks up calls this first."""
        self.sources: list[Source] = []
        self.networks: list[Network] = []

    def called(self, name: str) -> str:
        """Return how a sentence about a gap begins: "quality.csv has", or "the paper prints"."""
        return "the paper prints" if self.printed else f"{name}.csv has"

    def rows(self, name: str, **row) -> pd.DataFrame:
        """Return those rows of a table that have these values in these columns, maybe none; note its source.

        Args:
          name: a key of `SCHEMAS`.
          row: columns and what stands in them.

        Raises:
          NotMeasured: if there is no such table, or none with rows of the device that is asked for.
          ValueError: if the table is broken or not what its folder says.
        """
        table, record, path = self._load(name)
        device = row.get("device")
        if device and not self._holding(name, "device", device).any():
            raise NotMeasured(f"{self.called(name)} no rows of a {device}")
        digest = f" ({record['table']['sha256'][:12]})" if "table" in record else ""
        self.sources.append(Source(name, path + digest, _hardware(record, device)))
        # A claim names the paper's data set; a record of ours lies among those of one data set, its own.
        wanted = [self._holding(name, *each) for each in row.items() if each[0] != "dataset" or self.printed]
        if wanted:
            which = np.logical_and.reduce(wanted)
            table = table[which] if which.any() else table[:0]  # most of what is asked was not measured
        trained = not self.printed and len(table) > 0
        if trained and name in OF_TRAINED_NETWORKS and row.get("model", "real") not in REFERENCE_ROWS:
            model, seeds = asked_network(row["model"]), int(table["seeds"].min())
            self.networks.append(Network(model, model, row.get("window_frames", 32), seeds=seeds))
        if trained and name in OF_TEXT:
            keys, timed = [key for key in SCHEMAS[name] if key != "metric"], row.get("metric") in OF_TIME
            for one in table[table["windows"] > 0].to_dict("records"):  # real motion saw none
                about = {"seeds": one["seeds"], "windows": one["windows"], "parameters": one.get("parameters", 0)}
                named = tuple((key, one[key]) for key in keys)
                self.networks.append(Network(one["model"], one["trained"], 0, name, named, **about, timed=timed))
        return table

    def figure(self, name: str, value: str = "value", **row) -> Figure:
        """Return one figure of a table, of the first row that has one.

        Args:
          name: a key of `SCHEMAS`.
          value: the column; any but the usual one comes without interval.
          row: columns of the schema and what stands in them.

        Raises:
          NotMeasured: if there is no such row; the message says which.
        """
        found = self.rows(name, **row)
        if value in found and len(found := found[found[value].notna()]):
            wanted = ("value", "low", "high", "trainings") if value == "value" else (value,)
            return Figure.of(*(found[one].iat[0] for one in wanted if one in found))
        what = "" if value == "value" else f"{value} of "
        raise NotMeasured(f"{self.called(name)} no {what}{_row_text(row)}")


_TOLD = {
    "steps": "{} step{s}", "characters": "{:,} character{s}", "window_frames": "{} frames", "batch_size": "batch {}",
}  # fmt: skip


def _row_text(row: Mapping) -> str:
    return ", ".join(_TOLD.get(column, "{}").format(value, s="s" * (value != 1)) for column, value in row.items())


def _hardware(record: Mapping, device: str | None) -> str:
    if "paper_setting" in record:
        return record["paper_setting"]
    if (device or record.get("device_platform", "").upper()) == "CPU":
        return f"CPU, {counted_cores(record)}" if "cores" in record else "CPU"
    return "GPU" if record.get("device_kind") == "cpu" else str(record.get("device_kind"))


def recorded_evidence(root, dataset: str, profile: str) -> Evidence:
    """Return what was recorded on one data set in one profile.

    Args:
      root: folder of results, such as `paper_figures/`.
      dataset: of `profiles.DATASETS`.
      profile: "laptop" or "gpu"; a smoke run is a check and decides nothing.

    Returns:
      Evidence that reads `<root>/<data set>/<profile>/records/` when it is asked. A table of other
      weights, or of another classifier, than `quality.csv` beside it is not measured.

    Raises:
      ValueError: for an unknown data set or profile; later, for a table without a run record, one
        that its record does not describe, or a record of another data set or profile.
    """
    check_known(dataset, DATASETS, "data set")
    check_known(profile, [name for name in PROFILES if name != "smoke"], "profile")

    def load(name: str, length: float = 1.0):
        path = Path(root) / dataset / profile / "records" / f"{name}.csv"
        # A record alone is a table that got lost; `read_table` says so.
        if not path.exists() and not path.with_suffix(".json").exists():
            raise NoTable(f"no {name}.csv yet")
        table, record = read_table(path)
        if (of := (record.get("dataset"), record.get("profile"))) != (dataset, profile):
            raise ValueError(f"{path}: is a record of {' and '.join(map(str, of))}; move it to where those lie")
        if reason := folder_reason(path, record):
            raise NotMeasured(f"{name}.csv {reason}: measure it again")
        others = [one for paper in paper_folders() for one in load_paper_file("paper", paper).get("others", ())]
        table = checked_table(name, table, str(path), others if name in OF_TEXT else ())
        if name in (*OF_TRAINED_NETWORKS, *OF_TEXT):
            if not len(table := of_seeds(table, SCHEMAS[name], length)):
                raise NotMeasured(f"{name}.csv has nothing after {length:g} of the usual length")
        return table, record, path.relative_to(root).as_posix()

    return Evidence(load, at=lambda share: Evidence(functools.partial(load, length=share)))


def _evidence_of(tables: Mapping[str, pd.DataFrame], record: Mapping, where: str, gap: str, **framework) -> Evidence:
    """Return evidence of tables in memory; `gap` says that one is not there."""

    def load(name: str):
        if name not in tables:
            raise NoTable(gap.format(name=name))
        return tables[name], record, where

    return Evidence(load, **framework)


def snapshot_evidence(root, dataset: str, profile: str) -> list[Evidence]:
    """Return what the long queue recorded of the paper's networks, those that saw most windows first.

    Args:
      root, dataset, profile: as for `recorded_evidence`.

    Returns:
      Evidence for each number of windows, means over seeds: `quality` of networks by the paper's text alone, and
      `recipe_errors`, held-out joint errors of single windows by recipe. A queue that went on elsewhere
      has rows of several style classifiers; how little most of them differ is in `records/classifiers.csv`.
    """
    path = Path(root) / dataset / profile / "records" / "campaign.csv"
    if not path.exists():
        return []
    table, record = read_table(path)
    errors = table[(table["metric"] == "held_out_error") & (table["window_frames"] == 32)]
    table = table[table["recipe"] == "paper"].fillna({"unit": ""})
    place, gap = path.relative_to(root).as_posix(), "no {name}.csv of them"

    by_length: dict[int, Evidence] = {}
    for windows, rows in reversed([*table[table["steps"] > 0].groupby("windows")]):
        trainings = rows.groupby(["model", "window_frames"])["seed"].nunique().rename("value")
        most = f"1 to {trainings.max()} trainings" if trainings.max() > 1 else "one training"
        where = f"{place} at {windows:,} windows, {most} a network"
        seen = trainings.reset_index().assign(metric="windows", value=windows)
        tables = {"quality": intervals_over_repeats(rows, [*SCHEMAS["quality"], "unit"]), "trained": seen}
        of_recipes = errors[errors["windows"] == windows]
        tables["recipe_errors"] = intervals_over_repeats(of_recipes, SCHEMAS["recipe_errors"])
        tables = {name: one.rename(columns={"repeats": "seeds"}) for name, one in tables.items() if len(one)}
        tables = {name: checked_table(name, one, where) for name, one in tables.items()}
        at = lambda share, windows=windows: by_length.get(share * windows)
        by_length[windows] = _evidence_of(tables, record, where, gap, at=at)
    return [*by_length.values()]


@functools.cache
def paper_evidence(paper: str = "f3amd") -> Evidence:
    """Return a paper's own tables in the form of our records, with intervals where it prints some.

    Raises:
      ValueError: if two tables print different figures of one row, or one is of no known form.
    """
    about, where = load_paper_file("paper", paper), "the paper's tables"
    tables, others = printed_tables(paper), about.get("others", ())
    tables = {name: checked_table(name, table, f"the paper's {name}", others) for name, table in tables.items()}
    record = {"paper_setting": about["setting"]}
    return _evidence_of(tables, record, where, "the paper has no table of it", framework="iree")
