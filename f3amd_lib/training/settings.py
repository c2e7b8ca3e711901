"""What the settings of a training may be, and the recipes that choose them."""

from __future__ import annotations

import math
from pathlib import Path

from f3amd_lib.ground.files import read_toml
from f3amd_lib.ground.names import check_known, checked_seed, refuse_unknown
from f3amd_lib.ground.papers import load_paper_file
from f3amd_lib.ground.profiles import Profile
from f3amd_lib.networks.presets import find_preset

_SETTINGS = read_toml(Path(__file__).with_name("settings.toml"))

_RANGES = {
    "true or false": lambda x: type(x) is bool,
    "positive and whole": lambda x: type(x) is int and x >= 1,
    "0 or more and whole": lambda x: type(x) is int and x >= 0,
    "positive and finite": lambda x: 0 < x < math.inf,
    "0 or more and finite": lambda x: 0 <= x < math.inf,
    "in [0, 1]": lambda x: 0 <= x <= 1,
    "in [0, 1)": lambda x: 0 <= x < 1,
    "in [0, 1), or None": lambda x: x is None or 0 <= x < 1,
}


def _in_range(value, wanted: str) -> bool:
    try:
        return _RANGES[wanted](value)
    except TypeError:  # no number at all
        return False


def check_settings(settings, kind: str = "") -> None:
    """Raise ValueError for a field that is not what `settings.toml` says of its class, or a seed that is none.

    Args:
      settings: of a class that the file has.
      kind: what its numbers are, before their names in a message, such as "loss weight ".
    """
    for name, wanted in _SETTINGS[type(settings).__name__].items():
        value = getattr(settings, name)
        if isinstance(wanted, list):
            check_known(value, wanted, name)
        elif not _in_range(value, wanted):
            raise ValueError(f"{kind}{name} must be {wanted}, got {value!r}")
    if hasattr(settings, "seed"):
        checked_seed(settings.seed)


def part_recipe(training: type, part: str, num_steps: int, preset: str | None = None, **settings):
    """Return how a part of a paper's model is trained.

    Args:
      training: class of the settings; its `paper` names the folder of the recipes.
      part: a name of `papers/<paper>/recipes.toml`, "denoiser" or "short-denoiser" for instance.
      num_steps: optimiser steps.
      preset: adds what its own training says (`presets.find_preset`).
      **settings: fields to change.

    Raises:
      ValueError: for an unknown part, preset or field, with the nearest name.
    """
    recipes = load_paper_file("recipes", training.paper)
    check_known(part, recipes, "recipe")
    own = {} if preset is None else find_preset(preset).training
    values = {**recipes[part]["training"], **own, **settings}
    refuse_unknown(values, training, "training setting")
    return training(num_steps, **values)


def profile_part_recipe(training: type, part: str, profile: Profile, preset: str | None, batch_size=None, **settings):
    """Return how a profile trains a part: by the paper's recipe on `gpu`, by the short one and its share elsewhere."""
    if batch_size is not None:
        settings["batch_size"] = batch_size
    name = part if profile.name == "gpu" else f"short-{part}"
    share = load_paper_file("recipes", training.paper)[name].get("share", 1.0)
    num_steps = max(1, round(share * profile.train_steps))
    return part_recipe(training, name, num_steps, preset, seed=profile.seed, **settings)
