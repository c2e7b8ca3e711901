"""Profiles: how much is done. `smoke` in seconds, `laptop` in minutes, `gpu` in hours.

A profile says how much, a data set says on what; every notebook takes both as parameters and reads
the numbers by `load_profile`. Papermill accepts a misspelt parameter with a mere warning, so that
unknown names and wrong types are refused here.
"""

from __future__ import annotations

import dataclasses
import os
import re
import sys
from pathlib import Path

from f3amd_lib.ground.files import read_toml
from f3amd_lib.ground.names import check_known, checked_value

PROFILES = ("smoke", "laptop", "gpu")
DATASETS = ("synthetic", "bandai", "100style", "folder")
PRETRAINED_DIR = Path(__file__).resolve().parents[1] / "pretrained"
_NUMBERS = read_toml(Path(__file__).with_name("profiles.toml"))
SHOWN_STYLES = tuple(_NUMBERS["on"]["synthetic"]["laptop"]["evaluation_styles"])
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
      rollout_rounds: rounds of 32 frames of the long rollout (paper: 80, 2,560 frames).
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

    @property
    def rollout_frames(self) -> int:
        """Length of the long rollout, frames; windows of 64 make half as many rounds of it (section 4.4)."""
        return 32 * self.rollout_rounds


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
        of the wrong type (True is no number, 8.0 no count) or one out of range; see `refuse_unknown_parameters`.
    """
    refuse_unknown_parameters()
    _check_names(dataset, name)
    types = {item.name: item.type for item in dataclasses.fields(Profile) if item.name not in ("name", "dataset")}
    for key in overrides:
        check_known(key, types, "profile field")
    values = _NUMBERS["common"] | _NUMBERS[name] | _NUMBERS["on"].get(dataset, {}).get(name, {}) | overrides
    checked = {key: checked_value(key, values.get(key), annotation) for key, annotation in types.items()}
    return Profile(name=name, dataset=dataset, **checked)


def refuse_unknown_parameters() -> None:
    """In a notebook that papermill runs, raise ValueError for a parameter that the notebook does not have.

    Papermill puts a cell that begins with "# Parameters" after the notebook's own cell of them.
    """
    shell = getattr(sys.modules.get("IPython"), "get_ipython", lambda: None)()
    cells = [cell for cell in getattr(shell, "user_ns", {}).get("In", ()) if cell]
    assigned = lambda cell: re.findall(r"^(\w+)\s*(?::[^=\n]*)?=(?!=)", cell, flags=re.M)
    for before, cell in zip(["", *cells], cells, strict=False):
        for name in assigned(cell) if cell.startswith("# Parameters\n") else ():
            check_known(name, assigned(before), "parameter of this notebook")


def _check_names(dataset: str, profile: str) -> None:
    check_known(profile, PROFILES, "profile")
    check_known(dataset, DATASETS, "data set")


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
    _check_names(dataset, profile)
    return repository_root() / "runs" / dataset / profile


def results_dir(dataset: str, profile: str) -> Path:
    """Return the folder that results of a data set and profile go to, and make it.

    Results go to the ignored `runs/` unless somebody asks otherwise: the committed `paper_figures/`
    is written only by `make figures` (`f3amd_companion.reproduce`), which sets `F3AMD_RESULTS_DIR`.

    Args:
      dataset: one of `DATASETS`.
      profile: one of `PROFILES`.

    Returns:
      `<root>/<data set>/<profile>`, with folders for records, tables, figures and media in it.

    Raises:
      ValueError: for an unknown data set or profile.
    """
    _check_names(dataset, profile)
    folder = Path(os.environ.get(RESULTS_DIR_VARIABLE) or repository_root() / "runs", dataset, profile)
    for name in ("records", "tables", "figures", "media"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    return folder
