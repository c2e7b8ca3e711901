"""What the settings of a training may be, and the recipes that choose them."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from f3amd_lib.ground.files import read_toml
from f3amd_lib.ground.names import check_known, checked_value, refuse_unknown
from f3amd_lib.ground.papers import load_paper_file
from f3amd_lib.ground.profiles import Profile
from f3amd_lib.networks.presets import find_preset

_SETTINGS = read_toml(Path(__file__).with_name("settings.toml"))


def check_settings(settings, kind: str = "") -> None:
    """Raise ValueError for a field that is not of its type, or not what `settings.toml` says of it.

    Args:
      settings: of any dataclass; its numbers are above 0 where the file says nothing else.
      kind: what its fields are, before their names in a message, such as "loss weight ".
    """
    rules = _SETTINGS.get(type(settings).__name__, {})
    for field in dataclasses.fields(settings):
        checked_value(kind + field.name, getattr(settings, field.name), field.type, rules.get(field.name, "above 0"))


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
