"""Does the network use its noise? Recipes that differ from the paper's in one thing each (ours).

A network that predicts clean motion can lower its loss by answering with the mean of what history,
path and style allow, and never look at its noisy input; one step then does as well as eight. Every
row here is `F3AMD-FNO-96` with one change; the last is `F3AMD-FNO-96-plus`, the recipe that grew
out of such comparisons. All take the same number of steps from the same seed.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from f3amd_lib.ground.names import nearest_hint
from f3amd_lib.ground.profiles import Profile
from f3amd_lib.training.checkpoints import TrainedModel
from f3amd_lib.training.pipeline import PreparedData, model_files, set_aside_unlike, train
from f3amd_lib.training.recipe import TrainingConfig, paper_recipe

BASE = "F3AMD-FNO-96"

RECIPE_STEPS = {"smoke": 4, "laptop": 200, "gpu": 20_000}
"""Optimiser steps of every row, by profile."""


@dataclass(frozen=True)
class Recipe:
    """One way to train `F3AMD-FNO-96`.

    Attributes:
      name: of the row; fit for a folder.
      change: what differs from the paper, in words.
      source: where the idea comes from.
      preset: what it starts from.
      network: fields of the network's config that differ.
      training: fields of the training config that differ.
    """

    name: str
    change: str
    source: str
    preset: str = BASE
    network: Mapping = field(default_factory=dict)
    training: Mapping = field(default_factory=dict)

    def config(self, num_steps: int, batch_size: int, seed: int) -> TrainingConfig:
        """Return the training config: the paper's, but for the row's change.

        Args:
          num_steps, batch_size, seed: the same for all rows that are compared.
        """
        settings = {"num_steps": num_steps, "batch_size": batch_size, "seed": seed}
        schedule = dict(self.training)
        if schedule.get("schedule") == "warmup_cosine":
            schedule["warmup_steps"] = max(1, num_steps // 10)
        return paper_recipe(self.preset, **{**settings, **schedule})


_WARM = {"schedule": "warmup_cosine", "learning_rate": 2e-3, "gradient_clip": 1.0}

RECIPES: dict[str, Recipe] = {
    recipe.name: recipe
    for recipe in (
        Recipe("paper", "nothing: the paper's text", "section 4.5"),
        Recipe(
            "skip-and-output-scaling",
            "c_skip x + c_out F(c_in x)",
            "Karras et al. 2022, Table 1",
            network={"output_scaling": True},
        ),
        Recipe(
            "low-noise-weighting",
            "loss times 1 + min(1 / sigma^2, 5)",
            "Karras et al. 2022, Table 1; capped as Hang et al. 2023",
            training={"noise_weighting": "low_noise"},
        ),
        Recipe(
            "log-normal-noise",
            "ln sigma drawn from a normal distribution",
            "Karras et al. 2022, Table 1",
            training={"noise": "log_normal"},
        ),
        Recipe("mixed-noise", "every second sigma log-uniform below 1", "ours", training={"noise": "mixed"}),
        Recipe(
            "fitted-sigma-max",
            "sigma_max 16 instead of 128",
            "ours, after Song and Ermon 2020: noise no wider than the data's residual needs",
            training={"diffusion": {"kind": "variance_exploding", "sigma_max": 16.0, "sigma_min": 0.01}},
        ),
        Recipe(
            "wide-decoder",
            "a decoder of two layers with 192 channels between",
            "ours",
            network={"decoder_hidden_width": 192},
        ),
        Recipe(
            "IRD-excess",
            "the IRD loss asks for the data's step across the seam, not for none",
            "ours",
            training={"loss": {"ird_form": "excess"}},
        ),
        Recipe(
            "warm-up-and-cosine",
            "learning rate 2e-3, warm-up and cosine, gradients clipped at 1",
            "Loshchilov and Hutter 2017",
            training=_WARM,
        ),
        Recipe(
            "condition-dropout",
            "a tenth of the samples see no condition",
            "Ho and Salimans 2022",
            training={"condition_dropout": 0.1},
        ),
        Recipe(
            "residual-prior",
            "a learned Gaussian prior on the residual, per channel and cosine mode",
            "ours",
            network={"residual_prior": True},
        ),
        Recipe("plus", "all of F3AMD-FNO-96-plus", "ours", preset="F3AMD-FNO-96-plus", training=_WARM),
    )
}
"""Rows by name, the paper's first."""


def find_recipe(name: str) -> Recipe:
    """Return a recipe by name; ValueError for an unknown one, with the nearest."""
    if name not in RECIPES:
        raise ValueError(f"unknown recipe {name!r}{nearest_hint(name, RECIPES)}")
    return RECIPES[name]


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
    set_aside_unlike(prepared, files, network, config)
    trained, _ = train(
        prepared, profile, preset=recipe.preset, config=config, network=recipe.network, folder=folder, progress=progress
    )
    return trained
