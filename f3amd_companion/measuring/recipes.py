"""Does the network use its noise? Recipes that differ from the paper's in one thing each (ours).

A network that predicts clean motion can lower its loss by answering with the mean of what history,
path and style allow, and never look at its noisy input; one step then does as well as eight. The
rows stand in `papers/f3amd/recipes.toml`; all see as many windows from the same seed.
"""

from __future__ import annotations

from collections import ChainMap
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

from f3amd_lib.ground.names import check_known
from f3amd_lib.ground.papers import load_paper_file
from f3amd_lib.ground.profiles import Profile
from f3amd_lib.training.checkpoints import TrainedModel
from f3amd_lib.training.pipeline import PreparedData, model_files, set_aside_other_state, train
from f3amd_lib.training.recipe import TrainingConfig, paper_recipe

RECIPE_STEPS = {"smoke": 4, "laptop": 200, "gpu": 20_000}
"""Optimiser steps of every row, by profile; of one with a batch of its own, as many windows."""


@dataclass(frozen=True)
class Recipe:
    """One way to train `F3AMD-FNO-96`, or another model.

    Attributes:
      name: of the row; fit for a folder.
      change: what differs from the paper, in words.
      source: where the idea comes from.
      preset: what it starts from, unless a row of the queue names another.
      network: fields of the network's config that differ.
      training: fields of the training config that differ.
    """

    name: str
    change: str
    source: str
    preset: str = "F3AMD-FNO-96"
    network: Mapping = field(default_factory=dict)
    training: Mapping = field(default_factory=dict)

    def config(self, num_steps: int, batch_size: int, seed: int) -> TrainingConfig:
        """Return the training config: the paper's, but for the row's change.

        Args:
          num_steps, batch_size, seed: the same for all rows that are compared; a row with a batch of its own sees as
            many windows, in other steps, of which it takes one at least.
        """
        settings = {"batch_size": batch_size, "seed": seed, **self.training}
        num_steps = max(1, num_steps * batch_size // settings["batch_size"])
        tenth = max(1, num_steps // 10)
        if settings.get("schedule") == "warmup_cosine":
            settings["warmup_steps"] = tenth
        if settings.get("schedule") == "warmup_inverse_square":
            settings["warmup_steps"] = min(200, tenth)
        return paper_recipe(self.preset, num_steps, **settings)

    def on(self, preset: str) -> Recipe:
        """Return the same change of another model, which keeps its own network, losses and noise.

        Raises:
          ValueError: if the row changes one of these.
        """
        if preset == self.preset:
            return self
        own = [*self.network, *(name for name in ("loss", "diffusion") if name in self.training)]
        if self.training.get("loss") == {"raw_features": True}:  # units are any model's
            own.remove("loss")
        if own or self.preset != Recipe.preset:
            what = f"its {', '.join(own)}" if own else "a recipe of its own"
            raise ValueError(f"{self.name} changes {what} of {self.preset}, so that it is no change of {preset}")
        return replace(self, preset=preset)


RECIPES: dict[str, Recipe] = {name: Recipe(name, **row) for name, row in load_paper_file("recipes").items()}
"""Rows by name, the paper's first."""


def find_recipe(name: str) -> Recipe:
    """Return a recipe by name, or several changes in one: "residual-prior+higher-learning-rate".

    Raises:
      ValueError: for an unknown name, with the nearest, or for changes of unlike networks or of the same thing.
    """
    parts = name.split("+")
    for part in parts:
        check_known(part, RECIPES, "recipe")
    if len(parts) == 1:
        return RECIPES[name]
    rows = [RECIPES[part] for part in parts]
    losses = [row.training.get("loss", {}) for row in rows]
    changed = [name for row, loss in zip(rows, losses, strict=True) for name in (*row.network, *row.training, *loss)]
    if len(set(changed) - {"loss"}) < len(changed) - changed.count("loss") or len({row.preset for row in rows}) > 1:
        raise ValueError(f"{name}: these recipes change the same thing, or start from unlike networks; ask for each")
    together = {field: dict(ChainMap(*(getattr(row, field) for row in rows))) for field in ("network", "training")}
    if "loss" in together["training"]:
        together["training"]["loss"] = dict(ChainMap(*losses))
    words = [", ".join(getattr(row, field) for row in rows) for field in ("change", "source")]
    return Recipe(name, *words, rows[0].preset, **together)


def train_recipe(prepared: PreparedData, profile: Profile, name: str, *, folder, progress: bool = True) -> TrainedModel:
    """Train one row, or go on with it.

    Args:
      prepared: the data.
      profile: says how long (`RECIPE_STEPS`), the batch and the seed.
      name: key of `RECIPES`.
      folder: where rows keep their files, one folder each; those of a run on other data are kept
        under other names.
      progress: show a progress bar.
    """
    recipe, folder = find_recipe(name), Path(folder) / name
    config = recipe.config(RECIPE_STEPS[profile.name], profile.batch_size, profile.seed)
    network = prepared.model_config(recipe.preset, **recipe.network)
    files = model_files(profile, recipe.preset, folder=folder)
    set_aside_other_state(prepared, files, network, config)
    trained, _ = train(
        prepared, profile, preset=recipe.preset, config=config, network=recipe.network, folder=folder, progress=progress
    )
    return trained
