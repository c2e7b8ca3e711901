"""Values that formulas cannot hold: printed numbers by their digests, recipes by the records of what ships."""

import hashlib
from pathlib import Path

import pytest

from f3amd_lib.ground.profiles import load_profile
from f3amd_lib.training.checkpoints import load_model
from f3amd_lib.training.pipeline import PRETRAINED_DIR
from f3amd_lib.training.recipe import TrainingConfig, paper_recipe, profile_recipe

PRINTED = dict(line.split()[::-1] for line in (Path(__file__).parent / "data" / "printed_numbers.sha256").open())
LENGTH = {"num_steps", "batch_size"}
# Shipped model -> what its training differs in from what its preset and the laptop profile give today.
OTHERWISE = {"F3AMD-FNO-96-steady": set(), "F3AMD-FNO-64-steady": LENGTH | {"learning_rate", "seed", "warmup_steps"}}
PAPERS = PRETRAINED_DIR.parent / "papers"
SHIPPED = sorted(PRETRAINED_DIR.glob("*/*.safetensors"))


def test_printed_numbers_are_those_that_were_checked_against_the_papers():
    """Digests of the papers' tables: whoever corrects a cell writes its file's digest anew, and says so."""
    files = sorted(PAPERS.glob("*/numbers/*.csv"))
    found = {str(path.relative_to(PAPERS)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}
    assert found == PRINTED


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_what_ships_was_trained_as_presets_and_profiles_say_today(path):
    recorded = TrainingConfig.from_dict(load_model(path).record["training"]).to_dict()
    profile = load_profile("laptop", path.parent.name)
    recipe = profile_recipe(profile, path.stem) if path.stem in OTHERWISE else paper_recipe(path.stem, 1, batch_size=1)
    today = recipe.to_dict()
    differing = {name for name in today if recorded[name] != today[name]}
    assert differing == OTHERWISE.get(path.stem, LENGTH)
