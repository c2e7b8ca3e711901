"""What claims are judged by: figures with intervals, read from our records or the paper's tables.

Both come in one form, so that one rule judges both: tidy tables of `SCHEMAS`, models by their
presets' names. A figure that is not there is `NotMeasured`, with the reason; a table that says
nothing about its origin, or something else than the folder it lies in, is an error.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from f3amd_lib.ground.names import nearest_hint
from f3amd_lib.ground.papers import PAPER_SETTING, load_paper_table
from f3amd_lib.ground.profiles import DATASETS, PROFILES
from f3amd_lib.ground.records import read_table
from f3amd_lib.networks import presets


class NotMeasured(LookupError):
    """A figure that a claim needs is not among the records; the message says which."""


class NoTable(NotMeasured):
    """The whole table is not there: the least that can be said."""


# ---------------------------------------------------------------------------- figures and intervals


@dataclass(frozen=True)
class Figure:
    """A number with the interval it lies in.

    Attributes:
      value: mean over seeds, or median time.
      low, high: 95 % interval of the mean, or 5 and 95 % of the times; both equal to `value` where
        there was a single repeat, so that nothing is known about its spread.
    """

    value: float
    low: float
    high: float

    @staticmethod
    def of(value, low=float("nan"), high=float("nan")) -> Figure:
        """Make a figure; bounds that are NaN (a single repeat) become the value itself.

        Raises:
          ValueError: for a value that is no finite number or lies outside its interval.
        """
        value = float(value)
        low, high = (value if np.isnan(bound) else float(bound) for bound in (low, high))
        if not (np.isfinite(value) and low <= value <= high):
            raise ValueError(f"a figure needs low <= value <= high, got {low}, {value}, {high}")
        return Figure(value, low, high)


def _combine_logs(figures: Sequence[Figure], weights) -> Figure:
    """Return exp of the weighted sum of logarithms of positive figures, with its interval."""
    weights = np.asarray(weights, dtype=np.float64)
    value = np.log([figure.value for figure in figures])
    with np.errstate(divide="ignore"):
        below = value - np.log([max(figure.low, 0.0) for figure in figures])
        above = np.log([figure.high for figure in figures]) - value
    down = np.where(weights > 0, below, above)
    up = np.where(weights > 0, above, below)
    middle = weights @ value
    reach = [np.sqrt(np.sum((weights * side)[weights != 0] ** 2)) for side in (down, up)]
    return Figure(*(float(np.exp(x)) for x in (middle, middle - reach[0], middle + reach[1])))


def ratio(numerator: Figure, denominator: Figure) -> Figure:
    """Return the quotient of two figures with its interval, both being independent.

    The interval is recovered from those of the two logarithms: distances from value to bound add
    up in squares.

    Args:
      numerator, denominator: not negative.

    Returns:
      The quotient; infinite for a denominator of 0, and 1 for 0 / 0.

    Raises:
      ValueError: for a negative figure.

    Source: Zou and Donner 2008, "Construction of confidence intervals about effect measures".
    """
    if min(numerator.value, denominator.value) < 0:
        raise ValueError(f"a ratio of {numerator.value} and {denominator.value} means nothing")
    if numerator.value > 0 and denominator.value > 0:
        return _combine_logs([numerator, denominator], [1.0, -1.0])
    # Logarithms have no say about 0: take the widest quotients that the bounds allow.
    divide = lambda a, b: a / b if b > 0 else (float("inf") if a > 0 else 1.0)
    value = divide(numerator.value, denominator.value)
    low = divide(max(numerator.low, 0.0), denominator.high)
    high = divide(numerator.high, max(denominator.low, 0.0))
    return Figure(value, min(low, value), max(high, value))


def difference(first: Figure, second: Figure) -> Figure:
    """Return first - second with its interval, both being independent (as `ratio`)."""
    value = first.value - second.value
    down = np.hypot(first.value - first.low, second.high - second.value)
    up = np.hypot(first.high - first.value, second.value - second.low)
    return Figure(value, float(value - down), float(value + up))


def mean_figure(figures: Sequence[Figure]) -> Figure:
    """Return the geometric mean of positive figures with its interval."""
    return _combine_logs(figures, np.full(len(figures), 1.0 / len(figures)))


def power_law(x: Sequence[float], figures: Sequence[Figure]) -> Figure:
    """Fit figure = c x^p by least squares of logarithms and return p with its interval.

    Args:
      x: positive, at least two different ones.
      figures: positive, one for each x.
    """
    spread = np.log(x) - np.mean(np.log(x))
    fitted = _combine_logs(figures, spread / np.sum(spread**2))
    return Figure(*(float(np.log(bound)) for bound in (fitted.value, fitted.low, fitted.high)))


# ------------------------------------------------------------------------------------------- tables

SCHEMAS: dict[str, tuple[str, ...]] = {
    "quality": ("model", "window_frames", "steps", "metric"),
    "quality_by_round": ("model", "window_frames", "steps", "metric", "round"),
    "quality_by_epoch": ("model", "epoch", "metric"),
    "corruptions": ("corruption", "strength", "metric"),
    "foot_spectrum": ("model", "window_frames", "steps", "band", "metric"),
    "synthesis_time": ("model", "window_frames", "steps", "framework", "device", "characters"),
    "training_time": ("model", "window_frames", "device", "batch_size"),
    "gradient_norm": ("sigma",),
    "x0_by_sigma": ("model", "sigma"),
}
"""Tables that claims are judged by -> columns that name a row. Each also has `value` (the last one
`x0_error`) and, where it was repeated, `low` and `high`."""

_VALUE_COLUMN = {"x0_by_sigma": "x0_error"}

NINE_METRICS = {
    row.metric: (row.unit, row.better)
    for row in load_paper_table(3).drop_duplicates("metric")[["metric", "unit", "better"]].itertuples(index=False)
}
"""The metrics of Table 3, in its order -> (unit, "up" or "down")."""

PUBLISHED_CAMDM = "CAMDM published"
"""Row of the network with the weights that CAMDM's authors published: no preset of ours."""

REFERENCE_ROWS = ("real", "frozen pose", "shuffled frames", "noisy motion", PUBLISHED_CAMDM)
"""Names in the model column that are no presets."""


@dataclass(frozen=True)
class Setting:
    """A model as it is used: preset, denoising steps, window."""

    model: str
    steps: int = 8
    window: int = 32

    def __str__(self) -> str:
        steps = f"{self.steps} step{'s' if self.steps > 1 else ''}"
        window = f", {self.window} frames" if self.window != 32 else ""
        return f"{self.model} ({steps}{window})"


@dataclass(frozen=True)
class Source:
    """Where figures come from.

    Attributes:
      table: path of the CSV below the results' root, or a table of the paper.
      sha256: first digits of its checksum; "" for a table of the paper.
      hardware: what it was measured on.
    """

    table: str
    sha256: str
    hardware: str

    def __str__(self) -> str:
        return f"{self.table} ({self.sha256})" if self.sha256 else self.table


class Evidence:
    """Figures of one data set and profile, or of the paper, looked up by what they are about.

    Attributes:
      dataset: what the figures were measured on.
      framework: "jax", or "iree" for the paper, whose networks in JAX were compiled so.
      sources: the tables that were looked into since `forget_sources`, in that order.
    """

    def __init__(self, dataset: str, framework: str, load):
        """Args: `load(name)` returns (table, record, path) or raises NotMeasured."""
        self.dataset = dataset
        self.framework = framework
        self.sources: list[Source] = []
        self._load = functools.cache(load)

    def called(self, name: str) -> str:
        """Return how a sentence about a gap begins: "quality.csv has", or "the paper prints"."""
        return f"{name}.csv has" if self.framework == "jax" else "the paper prints"

    def forget_sources(self) -> None:
        """Start the list of sources anew."""
        self.sources = []

    def table(self, name: str, device: str | None = None) -> pd.DataFrame:
        """Return a table of `SCHEMAS`, checked, and note it among the sources.

        Args:
          name: a key of `SCHEMAS`.
          device: keep the rows of "CPU" or "GPU".

        Raises:
          NotMeasured: if there is no such table, or none with rows of that device.
          ValueError: if the table is broken or not what its folder says.
        """
        table, record, path = self._load(name)
        if device is not None:
            table = table[table["device"] == device]
            if table.empty:
                raise NotMeasured(f"{self.called(name)} no rows of a {device}")
        sha256 = record.get("table", {}).get("sha256", "")[:12]
        source = Source(path, sha256, _hardware(record, device))
        if source not in self.sources:
            self.sources.append(source)
        return table

    def figure(self, name: str, device: str | None = None, value: str = "value", **row) -> Figure:
        """Return one figure of a table.

        Args:
          name: a key of `SCHEMAS`.
          device: "CPU" or "GPU", for times.
          value: the column; any but the usual one comes without interval.
          row: columns of the schema and what stands in them.

        Raises:
          NotMeasured: if there is no such row; the message says which.
        """
        table = self.table(name, device)
        chosen = table
        for column, wanted in row.items():
            chosen = chosen[chosen[column] == wanted]
        if len(chosen) and value in chosen and pd.notna(chosen.iloc[0][value]):
            found = chosen.iloc[0]
            if value != "value":
                return Figure.of(found[value])
            return Figure.of(found["value"], found["low"], found["high"])
        where = ", ".join([*map(_spoken, row.items()), *([device] if device else [])])
        what = "" if value == "value" else f"{value} of "
        raise NotMeasured(f"{self.called(name)} no {what}{where}")

    def quality(self, setting: Setting, metric: str) -> Figure:
        """Return a metric of a model."""
        return self.figure(
            "quality", model=setting.model, window_frames=setting.window, steps=setting.steps, metric=metric
        )

    def real(self, metric: str) -> Figure | None:
        """Return a metric of real motion, where the records have it; windows as in the paper."""
        table = self.table("quality")
        chosen = table[(table["model"] == "real") & (table["metric"] == metric)]
        chosen = chosen.sort_values("window_frames")
        if chosen.empty:
            return None
        return Figure.of(*chosen.iloc[0][["value", "low", "high"]])

    def time(self, setting: Setting, device: str, characters: int, framework: str | None = None) -> Figure:
        """Return the time of a round in ms; by default in the framework of this evidence."""
        return self.figure(
            "synthesis_time",
            device,
            model=setting.model,
            window_frames=setting.window,
            steps=setting.steps,
            framework=framework or self.framework,
            characters=characters,
        )

    def counts(self, setting: Setting, device: str, framework: str | None = None) -> list[int]:
        """Return the numbers of characters that a model was timed with, rising; may be empty."""
        table = self.table("synthesis_time", device)
        wanted = {
            "model": setting.model,
            "window_frames": setting.window,
            "steps": setting.steps,
            "framework": framework or self.framework,
        }
        for column, value in wanted.items():
            table = table[table[column] == value]
        return sorted(int(count) for count in table["characters"])

    def speedup(self, slow: Setting, fast: Setting, device: str, characters: int) -> Figure:
        """Return how many times as fast `fast` is."""
        return ratio(self.time(slow, device, characters), self.time(fast, device, characters))

    def training(self, model: str, batch_size: int, window: int = 32, value: str = "value"):
        """Return seconds a training step on a GPU, or another column of that row."""
        return self.figure("training_time", "GPU", value, model=model, window_frames=window, batch_size=batch_size)

    def shared_batch(self, models: Sequence[str], window: int = 32) -> int:
        """Return the largest batch that all models were trained with on a GPU."""
        table = self.table("training_time", "GPU")
        table = table[table["window_frames"] == window]
        sizes = [set(table.loc[table["model"] == model, "batch_size"]) for model in models]
        shared = set.intersection(*sizes)
        if not shared:
            named = " and ".join(models)
            raise NotMeasured(f"{self.called('training_time')} no batch size of both {named}, GPU")
        return int(max(shared))


def _spoken(item: tuple[str, object]) -> str:
    column, value = item
    if column in ("model", "metric", "framework", "band"):
        return str(value)
    if column == "steps":
        return f"{value} step{'s' if value > 1 else ''}"
    if column == "characters":
        return f"{value:,} character{'s' if value > 1 else ''}"
    if column == "window_frames":
        return f"{value} frames"
    return f"batch {value}" if column == "batch_size" else f"{column} {value}"


def _hardware(record: Mapping, device: str | None) -> str:
    if "paper_setting" in record:
        return record["paper_setting"]
    kind = str(record.get("device_kind"))
    on_cpu = device == "CPU" or (device is None and record.get("device_platform") == "cpu")
    if on_cpu:
        return f"CPU, {record.get('cores')} cores"
    return kind if kind != "cpu" else "GPU"


def _checked(name: str, table: pd.DataFrame, where: str) -> pd.DataFrame:
    """Return a table in the form of `SCHEMAS`, undefined figures left out; ValueError if broken."""
    keys, column = SCHEMAS[name], _VALUE_COLUMN.get(name, "value")
    for needed in (*keys, column):
        if needed not in table:
            has = ", ".join(map(str, table.columns))
            raise ValueError(f"{where}: needs a column {needed!r}, it has {has}")
    table = table.rename(columns={column: "value"})
    table = table[table["value"].notna()].copy()
    for bound in ("low", "high"):
        if bound not in table:
            table[bound] = float("nan")
    # Where nothing was repeated the bounds are undefined, which is no fault.
    astray = ~np.isfinite(table["value"]) | (table["low"] > table["value"])
    astray |= table["high"] < table["value"]
    if astray.any():
        row = ", ".join(str(table.loc[astray, key].iloc[0]) for key in keys)
        raise ValueError(f"{where}: the figure of {row} is infinite or outside its interval")
    twice = table.duplicated(list(keys))
    if twice.any():
        row = ", ".join(str(table.loc[twice, key].iloc[0]) for key in keys)
        raise ValueError(f"{where}: has two rows of {row}")
    if "model" in table:
        for model in table["model"].unique():
            if model not in REFERENCE_ROWS and not _is_preset(model):
                hint = nearest_hint(model, [*presets.PRESETS, *REFERENCE_ROWS])
                raise ValueError(f"{where}: unknown model {model!r}{hint}")
    if name == "quality" and "unit" in table:
        for metric, unit in zip(table["metric"], table["unit"].fillna(""), strict=True):
            wanted = NINE_METRICS.get(metric, (unit,))[0]
            if unit != wanted:
                raise ValueError(f"{where}: {metric} is in {unit or 'no unit'}, not in {wanted}")
    if "device" in table and not set(table["device"]) <= {"CPU", "GPU"}:
        raise ValueError(f"{where}: device must be CPU or GPU, got {table['device'].unique()}")
    return table


def _is_preset(model: str) -> bool:
    try:
        return presets.find_preset(model).name == model
    except ValueError:
        return False


def recorded_evidence(root, dataset: str, profile: str) -> Evidence:
    """Return what was recorded on one data set in one profile.

    Args:
      root: folder of results, such as `paper_figures/`.
      dataset: of `profiles.DATASETS`.
      profile: "laptop" or "gpu"; a smoke run is a check and decides nothing.

    Returns:
      Evidence that reads `<root>/<data set>/<profile>/records/` when it is asked.

    Raises:
      ValueError: for an unknown data set or profile; later, for a table without a run record, one
        that its record does not describe, or a record of another data set, profile or device.
    """
    known = tuple(name for name in PROFILES if name != "smoke")
    for what, value, names in (("data set", dataset, DATASETS), ("profile", profile, known)):
        if value not in names:
            raise ValueError(f"unknown {what} {value!r}{nearest_hint(value, names)}")

    def load(name: str):
        path = Path(root) / dataset / profile / "records" / f"{name}.csv"
        # A record alone is a table that got lost; `read_table` says so.
        if not path.exists() and not path.with_suffix(".json").exists():
            raise NoTable(f"no {name}.csv yet")
        table, record = read_table(path)
        for key, here in (("dataset", dataset), ("profile", profile)):
            if record.get(key) != here:
                raise ValueError(f"{path}: is a record of {key} {record.get(key)!r}, yet lies among those of {here!r}")
        table = _checked(name, table, str(path))
        if "device" in table and record.get("device_platform") == "cpu":
            # PyTorch finds its own device; the record tells that of JAX.
            own = table.get("framework", pd.Series("jax", index=table.index)) != "torch"
            if (own & (table["device"] == "GPU")).any():
                raise ValueError(f"{path}: has rows of a GPU, but its record knows only a CPU")
        return table, record, path.relative_to(root).as_posix()

    return Evidence(dataset, "jax", load)


@functools.cache
def paper_evidence() -> Evidence:
    """Return the paper's own tables in the form of our records, without intervals."""
    parts: dict[str, list[pd.DataFrame]] = {"quality": [], "synthesis_time": []}
    for number in (3, 5, 6, 8, 9, 10, 11, 12, 1, 4, 7):
        table = load_paper_table(number)
        timed = table["metric"].str.startswith("synthesis_time")
        parts["quality"].append(_by_preset(table[~timed], PUBLISHED_CAMDM))
        times = _by_preset(table[timed], "CAMDM-code")
        if number == 11:  # the one column of times there: 1,024 characters on the GPU
            times = times.assign(device="GPU", characters=1024)
        in_torch = table.loc[timed, "model"].str.contains("PyTorch")
        parts["synthesis_time"].append(times.assign(framework=np.where(in_torch, "torch", "iree")))
    minutes = _by_preset(load_paper_table(2), "")
    # Only ratios are taken of it, at equal batch and data: an epoch serves as well as a step.
    parts["training_time"] = [minutes.assign(device="GPU", batch_size=512)]
    tables = {name: _without_copies(name, pd.concat(some)) for name, some in parts.items()}

    def load(name: str):
        if name not in tables:
            raise NoTable("the paper has no table of it")
        return tables[name], {"paper_setting": PAPER_SETTING}, "the paper's tables"

    return Evidence("100STYLE", "iree", load)


def _by_preset(table: pd.DataFrame, pytorch: str) -> pd.DataFrame:
    names = {
        label: pytorch if "PyTorch" in label else presets.find_preset(label).name for label in table["model"].unique()
    }
    return table.assign(model=table["model"].map(names))


def _without_copies(name: str, table: pd.DataFrame) -> pd.DataFrame:
    """Drop rows that the paper prints in several tables; ValueError if they disagree."""
    keys = list(SCHEMAS[name])
    columns = [column for column in (*keys, "unit", "value") if column in table]
    table = table[columns].drop_duplicates([*keys, "value"])
    return _checked(name, table, f"the paper's {name}")
