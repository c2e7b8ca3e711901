"""Profiles: how much is done. `smoke` in seconds, `laptop` in minutes, `gpu` in hours.

A profile says how much, a data set says on what; every notebook takes both as parameters and asks
`load_profile` for the numbers. Papermill accepts a misspelt parameter without a word, so that
unknown names and wrong types are refused here.
"""

from __future__ import annotations

import dataclasses
import math
import numbers
import os
from pathlib import Path

from f3amd_lib.ground.names import nearest_hint

PROFILES = ("smoke", "laptop", "gpu")
DATASETS = ("synthetic", "bandai", "100style", "folder")
RESULT_FOLDERS = ("records", "tables", "figures", "media")
SHOWN_STYLES = ("Neutral", "March", "Zombie", "Old", "LimpLeft", "ArmsWide", "Tiptoe", "Runner")
"""Styles of `synthetic` that differ in posture, arms, rhythm and symmetry: what figures show and
walking checks judge."""
RESULTS_DIR_VARIABLE = "F3AMD_RESULTS_DIR"
"""Environment variable: the folder that results go under, in place of the ignored `runs/`."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Profile:
    """How much is done on a data set.

    Attributes:
      name: "smoke", "laptop" or "gpu".
      dataset: "synthetic", "bandai", "100style" or "folder".
      preset: the network that is trained and shown, by the paper's name (section 4.5) or one of
        ours.
      compare_preset: a second network, trained alike and measured beside it; None for none.
      train_steps: optimiser steps of each.
      batch_size: windows a step (paper: 512).
      learning_rate: peak value (paper: 5e-4).
      window: future frames generated a round, at 30 fps (paper: 32 or 64).
      num_history: history frames in the condition (paper: 10).
      num_steps: network evaluations a round (paper: 8, 4, 2 or 1).
      num_styles: keep only so many styles of the data set; None keeps all.
      seconds_per_style: motion made per style, seconds; `synthetic` only.
      rollout_rounds: rounds of the long rollout (paper: 80 rounds of 32 frames, 2,560 frames).
      num_characters: most characters rolled out together, a style each.
      evaluation_styles: labels that are rolled out and measured; empty takes the data set's
        primary styles, up to num_characters.
      seed: of weights, batches and sampling noise.
    """

    name: str
    dataset: str
    preset: str
    compare_preset: str | None
    train_steps: int
    batch_size: int
    learning_rate: float
    window: int
    num_history: int
    num_steps: int
    num_styles: int | None
    seconds_per_style: float
    rollout_rounds: int
    num_characters: int
    evaluation_styles: tuple[str, ...]
    seed: int


# The paper's own numbers (section 4.5), where a profile says nothing else.
_COMMON = {
    "preset": "F3AMD-FNO-96",
    "compare_preset": None,
    "learning_rate": 5e-4,
    "window": 32,
    "num_history": 10,
    "num_steps": 8,
    "num_styles": None,
    "seconds_per_style": 60.0,
    "rollout_rounds": 80,
    "evaluation_styles": (),
    "seed": 0,
}

_PROFILE_DEFAULTS = {
    "smoke": {
        "preset": "F3AMD-FNO-32",
        "train_steps": 20,
        "batch_size": 16,
        "learning_rate": 2e-3,
        "num_steps": 2,
        "num_styles": 3,
        "seconds_per_style": 8.0,
        "rollout_rounds": 3,
        "num_characters": 2,
    },
    "laptop": {
        "preset": "F3AMD-FNO-64-steady",
        "compare_preset": "F3AMD-FNO-32",
        "train_steps": 1_500,
        "batch_size": 128,
        "learning_rate": 2e-3,
        "num_characters": 8,
    },
    "gpu": {"train_steps": 100_000, "batch_size": 512, "num_characters": 100},
}

# Where a data set asks for something else than its profile.
_DATASET_DEFAULTS = {
    ("laptop", "synthetic"): {"evaluation_styles": SHOWN_STYLES},
    ("laptop", "bandai"): {"preset": "F3AMD-FNO-96-plus", "compare_preset": "F3AMD-FNO-96", "train_steps": 4_000},
    ("laptop", "100style"): {"train_steps": 4_000},
}

_POSITIVE = (
    "train_steps",
    "batch_size",
    "learning_rate",
    "window",
    "num_history",
    "num_steps",
    "num_styles",
    "seconds_per_style",
    "rollout_rounds",
    "num_characters",
)
_NOT_NEGATIVE = ("seed",)


def load_profile(name: str, dataset: str, **overrides) -> Profile:
    """Return the numbers of a profile on a data set, with some of them replaced.

    Args:
      name: one of `PROFILES`.
      dataset: one of `DATASETS`.
      **overrides: fields of `Profile` to replace, such as num_steps=4; a list of strings serves as
        a tuple, a whole number as a float.

    Returns:
      The profile.

    Raises:
      ValueError: for an unknown profile, data set or field (with the nearest known one), a value
        of the wrong type (True is no number, 8.0 no count) or one out of range.
    """
    for what, value, known in (("profile", name, PROFILES), ("data set", dataset, DATASETS)):
        if value not in known:
            raise ValueError(f"unknown {what} {value!r}{nearest_hint(value, known)}")
    types = {item.name: item.type for item in dataclasses.fields(Profile) if item.name not in ("name", "dataset")}
    for key in overrides:
        if key not in types:
            raise ValueError(f"unknown profile field {key!r}{nearest_hint(key, types)}")
    values = _COMMON | _PROFILE_DEFAULTS[name] | _DATASET_DEFAULTS.get((name, dataset), {})
    values |= {key: _checked(key, value, types[key]) for key, value in overrides.items()}
    return Profile(name=name, dataset=dataset, **values)


def _checked(key: str, value, annotation: str):
    """Return an override as its field's type, or say why not."""
    # `from __future__ import annotations` leaves types as their source text.
    kind, *rest = annotation.split(" | ")
    if value is None and "None" in rest:
        return None
    is_number = isinstance(value, numbers.Real) and not isinstance(value, bool)
    if kind == "int" and is_number and isinstance(value, numbers.Integral):
        value = int(value)
    elif kind == "float" and is_number and math.isfinite(value):
        value = float(value)
    elif kind == "str" and isinstance(value, str) and value:
        return value
    elif kind.startswith("tuple") and isinstance(value, (list, tuple)) and all(isinstance(item, str) for item in value):
        return tuple(value)
    else:
        wanted = {
            "int": "a whole number",
            "float": "a finite number",
            "str": "a name",
            "tuple[str, ...]": "a list of names",
        }[kind] + (" or None" if "None" in rest else "")
        raise ValueError(f"{key} must be {wanted}, got {value!r} ({type(value).__name__})")
    if key in _POSITIVE and value <= 0:
        raise ValueError(f"{key} must be above 0, got {value!r}")
    if key in _NOT_NEGATIVE and value < 0:
        raise ValueError(f"{key} must be 0 or more, got {value!r}")
    return value


def repository_root() -> Path:
    """Return the checkout that the library runs from, or the working folder if it is installed."""
    checkout = Path(__file__).resolve().parents[2]
    return checkout if (checkout / "pyproject.toml").is_file() else Path.cwd()


def runs_dir(dataset: str, profile: str) -> Path:
    """Return the ignored folder `runs/<data set>/<profile>` of a user's own runs; nothing is made.

    Args:
      dataset: one of `DATASETS`.
      profile: one of `PROFILES`.
    """
    return _named_folder(repository_root() / "runs", dataset, profile)


def results_dir(dataset: str, profile: str, *, root=None) -> Path:
    """Return the folder that results of a data set and profile go to, and make it.

    Results go to the ignored `runs/` unless somebody asks otherwise: the committed `paper_figures/`
    is written only by `make figures` (`f3amd_lib.reproduce`), which sets `F3AMD_RESULTS_DIR`.

    Args:
      dataset: one of `DATASETS`.
      profile: one of `PROFILES`.
      root: folder above; wins over `F3AMD_RESULTS_DIR` and `runs/`.

    Returns:
      `<root>/<data set>/<profile>`, an existing folder with those of `RESULT_FOLDERS` in it.

    Raises:
      ValueError: for an unknown data set or profile.
    """
    if root is None:
        root = os.environ.get(RESULTS_DIR_VARIABLE) or repository_root() / "runs"
    folder = _named_folder(Path(root), dataset, profile)
    for name in RESULT_FOLDERS:
        (folder / name).mkdir(parents=True, exist_ok=True)
    return folder


def _named_folder(root: Path, dataset: str, profile: str) -> Path:
    if dataset not in DATASETS:
        raise ValueError(f"unknown data set {dataset!r}{nearest_hint(dataset, DATASETS)}")
    if profile not in PROFILES:
        raise ValueError(f"unknown profile {profile!r}{nearest_hint(profile, PROFILES)}")
    return root / dataset / profile
