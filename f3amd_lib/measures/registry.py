"""The registry of metrics: names, units, which way is better, headings and definitions."""

from dataclasses import dataclass
from pathlib import Path

from f3amd_lib.ground.files import read_toml

_SHOWN_UNITS = {"deg": "°", "cm/frame^2": "cm/frame²"}


@dataclass(frozen=True)
class Metric:
    """One figure of `metrics.toml`, which says what each field means."""

    name: str
    better: str
    definition: str
    unit: str = ""
    heading: str = ""
    key: str = ""
    decimals: int = 3

    @property
    def shown_unit(self) -> str:
        """The unit as a reader knows it: "°" for "deg"."""
        return _SHOWN_UNITS.get(self.unit, self.unit)

    @property
    def title(self) -> str:
        """The heading of a column, with the unit: "Traj. (m)"."""
        return f"{self.heading} ({self.shown_unit})" if self.unit else self.heading


_REGISTRY = read_toml(Path(__file__).with_name("metrics.toml"))

METRICS = {
    name: Metric(name, **({"heading": name.replace("_", " "), "key": name} | fields))
    for name, fields in _REGISTRY["metric"].items()
}
"""Name in records -> metric."""

BY_KEY = {metric.key: metric for metric in METRICS.values()}
"""Key in dicts of figures -> metric."""

SHOWN = {table: [METRICS[name] for name in names] for table, names in _REGISTRY["shown"].items()}
"""Kind of table -> the metrics it shows, in its order."""
