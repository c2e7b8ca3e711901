"""Where a paper is silent, what this companion does there, and why: a table of its `readings.toml`.

Each entry that is a setting names the field that holds it, and its value is read from the code, so
that the table in the notebooks shows what runs.
"""

import dataclasses
import pkgutil
from collections.abc import Mapping

import pandas as pd
from f3amd_lib.ground.names import check_known
from f3amd_lib.ground.papers import check_entry, find_entry, load_paper_file
from f3amd_lib.networks.presets import PRESETS


def fill_reading(reading: dict, where: str, configs: Mapping[str, str]) -> str:
    """Return what an entry of `readings.toml` says of our filling, with the code's own value in it.

    Args:
      reading: the entry; its `field` is "Class.field" for a config's default, or "preset.field" (or
        a field inside that) for what a preset sets it to.
      where: the file, for messages.
      configs: classes of the file's `[configs]` -> where they are, "module:class".

    Raises:
      ValueError: for a key that is missing or unknown, or a field that is no setting.
    """
    where = f"{where}, {reading.get('point')!r}"
    check_entry(reading, where, ("topic", "point", "paper", "here", "why"), ("field",))
    if "field" not in reading:
        return reading["here"]
    owner, *names = reading["field"].split(".")
    value = {}
    if owner in configs:
        value = {field.name: field.default for field in dataclasses.fields(pkgutil.resolve_name(configs[owner]))}
    elif preset := PRESETS.get(owner):
        value = {**preset.network, **preset.training, "diffusion": preset.diffusion.to_dict()}
    for name in names:
        value = find_entry(value, name, f"setting of {owner}", where)
    return reading["here"].format(value)


def readings_table(*topics: str, paper: str = "f3amd") -> pd.DataFrame:
    """Return open points as a table: topic, open point, the paper, here, why.

    Args:
      *topics: keep only these; all by default.
      paper: its folder.

    Raises:
      ValueError: for a topic without entries, or a broken entry (see `fill_reading`).
    """
    about = load_paper_file("readings", paper)
    readings, configs = about["reading"], about.get("configs", {})
    known = list(dict.fromkeys(reading["topic"] for reading in readings))
    for topic in topics:
        check_known(topic, known, "topic")
    kept = [reading for reading in readings if not topics or reading["topic"] in topics]
    filled = [reading | {"here": fill_reading(reading, f"{paper}/readings.toml", configs)} for reading in kept]
    table = pd.DataFrame(filled, columns=["topic", "point", "paper", "here", "why"])
    return table.rename(columns={"point": "open point", "paper": "the paper"})
