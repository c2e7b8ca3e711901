"""Run records: what a number was measured on, and tables that never travel without one.

A table is a CSV file with a JSON record of the same name beside it. The record says which profile,
data set, seed, code and machine made it, and holds a checksum of the CSV, so that a table edited
or swapped by hand is noticed. What draws figures reads tables only through `read_table`.
"""

import datetime
import hashlib
import importlib.metadata
import io
import json
import os
import platform
import re
import subprocess
import tempfile
from pathlib import Path

import numpy as np
import pandas as pd

import f3amd_lib
from f3amd_lib.ground import log
from f3amd_lib.ground.files import named_file, read_toml, set_aside, write_whole
from f3amd_lib.ground.names import asked_network
from f3amd_lib.ground.profiles import repository_root

_CHECKOUT = str(Path(__file__).resolve().parents[2])
_CODE = ("f3amd_lib", "f3amd_companion", "notebooks")
_PACKAGES = ("jax", "jaxlib", "flax", "optax", "numpy")
# Before 3.1 pandas reads floats exactly only when asked to, from 3.1 on always.
_EXACT_FLOATS = {} if tuple(map(int, pd.__version__.split(".")[:2])) >= (3, 1) else {"float_precision": "round_trip"}
# Digests and commits are text, also one that looks like a number: 9548690e74.
_DIGESTS = dict.fromkeys(("weights", "classifier", "commit"), str)
_TABLES = read_toml(Path(__file__).with_name("records.toml"))

ON_WEIGHTS = frozenset(_TABLES["on_weights"])
"""Tables that were measured on trained models: what they say goes with the weights."""

THROUGH_CLASSIFIER = frozenset(_TABLES["through_classifier"])
"""Tables with FID or EMD, seen through one style classifier; rows of `campaign` name theirs."""


def run_record(*, profile, dataset, seed: int, **extra) -> dict:
    """Describe a run: settings, data, code and machine.

    Args:
      profile: a profile's name, or an object with a `name`.
      dataset: a data set's name, or an object with `name` and, where it has them, `fingerprint`,
        `licence` and `credit`.
      seed: the run's seed.
      extra: anything else worth keeping, such as steps=8; numbers, strings, lists, dicts.

    Returns:
      A dict ready for JSON: profile, dataset, dataset_fingerprint, dataset_licence,
      dataset_credit, seed, git_commit and git_dirty (None where the library is not in a git
      checkout), library_version, versions, device_platform, device_kind, num_devices, cores,
      date_utc, and the extras. Paths in it are shortened, so that no home or temporary folder
      of the machine is told.

    Raises:
      ValueError: for a value that JSON cannot hold.
    """
    import jax  # here, so that reading a table does not wait for JAX

    device = jax.devices()[0]
    commit, dirty = _git_state()
    record = {which: getattr(thing, "name", thing) for which, thing in (("profile", profile), ("dataset", dataset))}
    record |= {f"dataset_{key}": getattr(dataset, key, None) for key in ("fingerprint", "licence", "credit")}
    record |= {"seed": seed, "git_commit": commit, "git_dirty": dirty, "library_version": f3amd_lib.__version__}
    versions = {package: importlib.metadata.version(package) for package in _PACKAGES}
    record["versions"] = {"python": platform.python_version(), **versions}
    record |= {"device_platform": device.platform, "device_kind": device.device_kind}
    record |= {"num_devices": len(jax.devices()), "cores": usable_cores()}
    record["date_utc"] = datetime.datetime.now(datetime.UTC).strftime("%Y-%m-%dT%H:%M:%SZ")
    return _plain(record | extra)


def record_hash(record: dict) -> str:
    """Hash the settings, leaving out machine, versions, code state and date.

    Args:
      record: from `run_record`.

    Returns:
      64 hex digits, equal for runs that should give the same numbers up to rounding.
    """
    asked = {key: value for key, value in record.items() if key not in _TABLES["circumstances"]}
    return hashlib.sha256(json.dumps(_plain(asked), sort_keys=True).encode()).hexdigest()


def write_table(path, frame: pd.DataFrame, record: dict) -> Path:
    """Write a table as CSV with its run record as JSON beside it.

    Args:
      path: where to, ending in .csv; folders are made.
      frame: the table; its index is not written.
      record: from `run_record`.

    Returns:
      The path of the CSV.

    Raises:
      ValueError: if the name does not end in .csv, the table is empty, or there is already a table (or a
        file without a record) that is not of the same data set and profile.
    """
    path = named_file(path, ".csv", "tables")
    record_path = path.with_suffix(".json")
    if frame.empty:
        raise ValueError(f"{path}: nothing to write: no rows")
    if path.exists() or record_path.exists():
        there = _read_record(path)
        for key in ("dataset", "profile"):
            if there.get(key) != record[key]:
                raise ValueError(
                    f"{path}: holds results of {key} {there.get(key)!r} and is not overwritten with "
                    f"those of {record[key]!r}; write to another folder"
                )
    text = frame.to_csv(index=False, lineterminator="\n")
    description = {"file": path.name, "rows": len(frame), "columns": [str(column) for column in frame.columns]}
    described = _plain(record) | {"table": description | {"sha256": _text_hash(text)}}
    # Each file appears whole. Should the run die between the two, the checksum tells.
    write_whole(path, text)
    write_whole(record_path, json.dumps(described, indent=2, ensure_ascii=False) + "\n")
    return path


def read_table(path) -> tuple[pd.DataFrame, dict]:
    """Read a table together with its run record.

    Args:
      path: the CSV file.

    Returns:
      (table, record). Columns of digests (weights, classifier, commit) are text, whatever they look like.

    Raises:
      FileNotFoundError: if there is no such table.
      ValueError: if the record is missing or broken, or the CSV is not the one it describes.
    """
    path = Path(path)
    if not path.exists():
        raise FileNotFoundError(f"{path}: no such table")
    record = _read_record(path)
    # Bytes that are no text cannot have the checksum of a text.
    text = path.read_text(encoding="utf-8", errors="replace")
    if _text_hash(text) != (record.get("table") or {}).get("sha256"):
        raise ValueError(
            f"{path}: not the table that {path.stem}.json describes (it was changed, or a run died while writing); "
            "measure it again"
        )
    return _rows(text), record


def _rows(text: str) -> pd.DataFrame:
    return pd.read_csv(io.StringIO(text), dtype=_DIGESTS, **_EXACT_FLOATS)


def _read_record(path: Path) -> dict:
    """Return the record beside a table; ValueError if it is missing or broken."""
    record_path = path.with_suffix(".json")
    try:
        record = json.loads(record_path.read_text(encoding="utf-8"))
        if not all(isinstance(record.get(part) or {}, dict) for part in ("table", "weights_digests")):
            raise ValueError("JSON objects are needed")
    # Broken JSON, bytes that are no text, thousands of brackets, or no object.
    except (OSError, ValueError, AttributeError, RecursionError) as error:
        raise ValueError(f"{path}: has no readable run record {record_path.name} beside it ({error})") from None
    return record


def _text_hash(text: str) -> str:
    # Line ends are not content: a checkout on another system may have changed them.
    return hashlib.sha256(text.replace("\r\n", "\n").encode("utf-8", "surrogatepass")).hexdigest()


def _plain(record: dict) -> dict:
    """Return what JSON holds of a record: no NaN, and the folders of this machine shortened."""
    text = json.dumps(record, default=_as_json, ensure_ascii=False)
    folders = {os.path.expanduser("~"): "~", tempfile.gettempdir(): "<tmp>"} | dict.fromkeys(
        (os.getcwd(), _CHECKOUT), "."
    )
    for folder, short in sorted(folders.items(), key=lambda pair: -len(pair[0])):
        if len(folder) > 1:
            text = re.sub(rf'{re.escape(folder)}(?=[/"])', short, text)
    return json.loads(text, parse_constant=lambda name: None)


def _as_json(value):
    if isinstance(value, (np.generic, np.ndarray)):
        return value.tolist()
    raise ValueError(f"a run record cannot hold {value!r} of type {type(value).__name__}")


def _git_state() -> tuple[str | None, bool | None]:
    """Return the commit of the library's checkout and whether its code differs from it."""

    def git(*arguments: str) -> str:
        asked = ["git", "-C", _CHECKOUT, *arguments]
        return subprocess.run(asked, capture_output=True, text=True, timeout=20, check=True).stdout.strip()

    try:
        # The library may be installed inside somebody else's checkout, whose commit says nothing.
        if not git("ls-files", "--", "f3amd_lib/ground/records.py"):
            return None, None
        # Only code counts: results written by the run itself do not make it dirty.
        return git("rev-parse", "HEAD"), bool(git("status", "--porcelain", "--", *_CODE))
    except (OSError, subprocess.SubprocessError):
        return None, None


def usable_cores() -> int:
    """Return how many cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


_OF_MEASURES = ("corruptions", "settling")
"""Tables that ask FID and EMD themselves: of a classifier's own, which they name, and compared with no model's."""


def stale_reason(name: str, record: dict, reference: dict) -> str:
    """Say why a table does not belong with the quality table of its folder.

    Args:
      name: of the table, without ending; times and short trainings have no weights to go by.
      record: of the table.
      reference: of the folder's `quality.csv`; where that names nothing, nothing can be said.

    Returns:
      The reason, such as "was measured with other weights of CAMDM (a1b2, now c3d4)"; "" if there is none.
    """
    now, there = ({}, {})
    for digests, of in ((now, reference), (there, record)):
        for model, used in (of.get("weights_digests") or {}).items():
            digests.setdefault(asked_network(model), set()).update(set(used) - {""})
    if name in ON_WEIGHTS and now and not there:
        return "does not say which weights it was measured with"
    for model in now.keys() & there.keys() if name in ON_WEIGHTS else ():
        if there[model] and there[model] != now[model]:
            earlier, later = (", ".join(sorted(of[model])) for of in (there, now))
            return f"was measured with other weights of {model} ({earlier}, now {later})"
    seen, by = (of.get("classifier_weights") for of in (record, reference))
    if name in _OF_MEASURES:
        return "" if seen else "does not say which style classifier it was seen through"
    if name in THROUGH_CLASSIFIER and by and seen != by:
        return f"was seen through another style classifier ({seen}, now {by})"
    return ""


def folder_reason(path, record: dict) -> str:
    """Return the `stale_reason` of a table beside the quality table that lies in its folder; "" without one."""
    reference = Path(path).with_name("quality.json")
    return stale_reason(Path(path).stem, record, _read_record(reference)) if reference.exists() else ""


def set_aside_table(path) -> Path:
    """Rename a table and its record to the first free number, so that it can still be read.

    Args:
      path: of the CSV.

    Returns:
      Where it lies now, such as `quality.old1.csv`.
    """
    path = Path(path)
    kept = set_aside((path, path.with_suffix(".json")), path.stem)
    return path.with_name(f"{kept}.csv") if kept else path


def whole_table(path) -> tuple[pd.DataFrame, dict] | None:
    """Read a table that a run wants to go on from; a broken one is renamed with a warning, so that the run can.

    Where a run died between a table and its record, the rows that the record describes count.

    Args:
      path: of the CSV.

    Returns:
      (table, record); None if there is no table, or a broken one.
    """
    path = Path(path)
    if not (path.exists() or path.with_suffix(".json").exists()):
        return None
    try:
        return read_table(path)
    except (ValueError, FileNotFoundError) as error:
        kept = set_aside_table(path)
        log.warning("%s; kept as %s", error, kept.name)
    try:
        record = _read_record(kept)
        text = "".join(kept.read_text(encoding="utf-8").splitlines(keepends=True)[: record["table"]["rows"] + 1])
        return (_rows(text), record) if _text_hash(text) == record["table"]["sha256"] else None
    except (OSError, ValueError, KeyError, TypeError):
        return None


def committed_table(dataset: str, name: str, *, profile="laptop", kind="records") -> tuple[pd.DataFrame, dict] | None:
    """Read a table that `make measure` left under `paper_figures/`.

    Args:
      dataset: a name of `profiles.DATASETS`.
      name: of the table, without ending.
      profile: whose results.
      kind: "records", or "tables" for those that `make figures` left.

    Returns:
      (table, record), or None if nothing is committed for this data set. `table.attrs["stale"]`
      says why it does not belong with the quality table beside it, "" if it does.

    Raises:
      ValueError: if the table is not the one that its record describes.
    """
    path = repository_root() / "paper_figures" / dataset / profile / kind / f"{name}.csv"
    if not path.exists():
        return None
    table, record = read_table(path)
    table.attrs["stale"] = folder_reason(path, record)
    return table, record
