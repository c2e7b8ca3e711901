"""What trainings have in common: a task of one network, its settings and the recipe that says them."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import ClassVar

import jax
import optax
from flax import nnx

from f3amd_lib.ground.files import read_toml
from f3amd_lib.ground.names import check_known, refuse_unknown
from f3amd_lib.ground.papers import load_paper_file
from f3amd_lib.ground.profiles import Profile
from f3amd_lib.networks.presets import build_from_config, find_preset


def frozen_tree(*data: str):
    """Make a class a frozen dataclass and a JAX tree: the fields of these names are leaves, all else is static."""

    def as_tree(cls: type) -> type:
        cls = dataclasses.dataclass(frozen=True, eq=False)(cls)
        static = [field.name for field in dataclasses.fields(cls) if field.name not in data]
        return jax.tree_util.register_dataclass(cls, data_fields=data, meta_fields=static)

    return as_tree


class NetworkTask:
    """A training of one network (a `training.optimise.Task`): all but what is drawn and how an answer is judged.

    A subclass has `model_config`, `config` with an `optimiser()`, `dataset_fingerprint`, perhaps `schedule`, and
    `terms(params, batch, key, training=True)`: loss terms by name, "loss" among them, of what `draw` drew or, out of
    training, of held-out data.
    """

    name: ClassVar[str]
    part: ClassVar[str]
    """What the task's identity calls its network."""

    @property
    def optimiser(self) -> optax.GradientTransformation:
        """As the config says."""
        return self.config.optimiser()

    def identity(self) -> dict:
        """Return all that decides the weights, as JSON has it."""
        models = {self.part: self.model_config.to_dict()}
        if hasattr(self, "schedule"):
            models["diffusion"] = self.schedule.to_dict()
        training = dataclasses.asdict(self.config)
        fingerprint = self.dataset_fingerprint
        return {"part": self.name, "model": models, "training": training, "dataset_fingerprint": fingerprint}

    def init(self, key):
        """Return initial weights; no network here keeps statistics."""
        return nnx.state(build_from_config(self.model_config, key)), None

    def loss(self, params, statistics, batch, key):
        """Return (loss, (terms, statistics)) of what `draw` drew."""
        terms = self.terms(params, batch, key)
        return terms["loss"], (terms, statistics)

    def held_out_terms(self, params, statistics, held_out, key) -> dict:
        """Return the terms on held-out data, without what only training does."""
        return self.terms(params, held_out, key, training=False)


_SETTINGS = read_toml(Path(__file__).with_name("settings.toml"))

_RANGES = {
    "positive and whole": lambda x: type(x) is int and x >= 1,
    "0 or more and whole": lambda x: type(x) is int and x >= 0,
    "positive and finite": lambda x: 0 < x < math.inf,
    "0 or more and finite": lambda x: 0 <= x < math.inf,
    "in [0, 1]": lambda x: 0 <= x <= 1,
    "in [0, 1)": lambda x: 0 <= x < 1,
    "in [0, 1), or None": lambda x: x is None or 0 <= x < 1,
}


def check_settings(settings) -> None:
    """Raise ValueError for a field that is not what `settings.toml` says of its class: a variant, or in a range."""
    for name, wanted in _SETTINGS[type(settings).__name__].items():
        value = getattr(settings, name)
        if isinstance(wanted, list):
            check_known(value, wanted, name)
        elif not _RANGES[wanted](value):
            raise ValueError(f"{name} must be {wanted}, got {value!r}")


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
