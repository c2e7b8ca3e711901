"""Values that formulas cannot hold: printed numbers by their digests, others by records, papers' tables and a list."""

import functools
import hashlib
import json
import re
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest

from f3amd_companion.measuring import campaign
from f3amd_companion.measuring.times import plan
from f3amd_lib.ground.files import read_toml
from f3amd_lib.ground.papers import load_paper_file, load_paper_table, paper_folders
from f3amd_lib.ground.profiles import load_profile
from f3amd_lib.ground.records import read_table
from f3amd_lib.ground.trees import describe
from f3amd_lib.networks.presets import find_preset
from f3amd_lib.text.stages.acmdm_training import TextMotionTraining
from f3amd_lib.text.stages.motionpcm_training import LatentMotionTraining
from f3amd_lib.text.stages.train_stage import stage_recipe
from f3amd_lib.training.checkpoints import load_model
from f3amd_lib.training.pipeline import PRETRAINED_DIR
from f3amd_lib.training.recipe import TrainingConfig, paper_recipe, profile_recipe

PRINTED = dict(line.split()[::-1] for line in (Path(__file__).parent / "data" / "printed_numbers.sha256").open())
LENGTH = {"num_steps", "batch_size"}
# Shipped model -> what its training differs in from what its preset and the laptop profile give today.
OTHERWISE = {
    "F3AMD-FNO-96-steady": {"num_steps", "learning_rate", "warmup_steps"},  # of its last leg
    "F3AMD-FNO-64-steady": LENGTH | {"learning_rate", "seed", "warmup_steps"},
}
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


# Shipped model of text -> its settings, recipe, and what the queue set; length, seed and what its data say differ, too.
TEXT = {
    "ACMDM-S-PS22-raw-n3": (TextMotionTraining, "denoiser", {"batch_size"}),
    "MotionPCM-teacher-small": (LatentMotionTraining, "teacher", set()),
    "MotionPCM-M1-small": (LatentMotionTraining, "student", {"batch_size"}),
}


@pytest.mark.parametrize("name", TEXT)
def test_models_of_text_ship_as_presets_and_recipes_say_today(name):
    shipped, (settings, recipe, otherwise) = describe(PRETRAINED_DIR / f"bandai/text/{name}.safetensors"), TEXT[name]
    recorded = shipped["record"]["identity"]["training"]
    today = asdict(stage_recipe(settings, recipe, load_profile("laptop", "bandai"), name))
    differing = {key for key in today if recorded[key] != json.loads(json.dumps(today[key]))}
    assert differing <= {"num_steps", "seed", "unit"} | otherwise
    network = {key: value for key, value in find_preset(name).network.items() if key != "window"}
    assert {key: shipped["model"].get(key) for key in network} == network


ROOT = Path(__file__).resolve().parents[1]
HELD = {
    (file, place): value
    for file, values in read_toml(Path(__file__).parent / "data" / "held_values.toml").items()
    for place, value in values.items()
}
# Words alone, or what pages and bundles are made of, which tests of their own read.
WORDS = {"claims", "commands", "readings", "schemas", "records", "colors", "claims_page", "onnx_card", "npm_packages"}
ELSEWHERE = {"campaign", "targets", "steer", "released", "tags", "ruff"}
_read = functools.cache(read_toml)


def found(file, place):
    """The value at a place such as "run/0/windows"."""
    value = _read(ROOT / file)
    for key in place.split("/"):
        value = value[int(key) if isinstance(value, list) else key]
    return value


def test_values_are_those_that_were_meant():
    assert {where: found(*where) for where in HELD} == HELD
    assert all(type(found(*where)) is type(value) for where, value in HELD.items())
    with pytest.raises((KeyError, IndexError)):
        found("f3amd_lib/ground/profiles.toml", "common/none")


def test_each_file_of_values_is_held_by_something():
    folders = ("f3amd_lib", "f3amd_companion", "notebooks/f3amd_notebooks", "scripts")
    files = {path for folder in folders for path in (ROOT / folder).rglob("*.toml")}
    listed = {ROOT / file for file, _ in HELD}
    assert listed <= files
    assert {path.stem for path in files - listed} == WORDS | ELSEWHERE


def test_factors_of_claims_are_those_that_their_words_state():
    counted = 0
    for paper in paper_folders():
        for claim in load_paper_file("claims", paper)["claim"]:
            for statement in claim["statement"]:
                words = " ".join(str(of.get(key)) for of in (claim, statement) for key in ("says", "paper_says"))
                said = {float(number.replace(",", "")) for number in re.findall(r"\d(?:[\d,]*\d)?(?:\.\d+)?", words)}
                asked = [*statement.get("stated", ()), *statement.get("saving", ())]
                about = np.ravel(statement.get("about", ())).tolist()
                assert said >= {*asked} and (said >= {*about} or round(about[0] / about[1], 1) in said), claim["id"]
                counted += len(asked + about)
    assert counted > 30


# What the queue holds and no record has yet; what records have and no queue asks for (chosen by name, or cut short).
UNMEASURED = {
    "F3AMD-FNO-96-steady-seed0": {3200},
    "F3AMD-FNO-96-seed0": {9600, 12800, 19400},
    "CAMDM-batch-512-seed0": {6400},
    "F3AMD-FNO-96-batch-512-seed0": {9600, 12800, 19400},
    "F3AMD-FNO-96-residual-prior+higher-learning-rate+wide-decoder+history-input+batch-512-seed0": {6400},
}
BESIDE = 8


def test_the_campaign_is_what_its_record_measured_and_what_waits():
    table, _ = read_table(ROOT / "paper_figures/bandai/laptop/records/campaign.csv")
    measured = set(zip(table["run"], table["windows"], strict=True))
    asked = {(run.name, windows) for run, windows in campaign.queue()}
    assert asked - measured == {(run, 1000 * windows) for run, all in UNMEASURED.items() for windows in all}
    assert len(measured - asked) == BESIDE


@pytest.mark.parametrize("number", [1, 4, 7])
def test_the_suite_for_a_gpu_times_each_cell_of_the_papers_tables(number):
    timed = {
        ("PyTorch" in one.way, find_preset(one.model).name, one.window_frames, one.steps, one.characters)
        for group in plan("gpu").values()
        for one in group
        if one.precision == "tf32"
    }
    table = load_paper_table(number).query("device == 'GPU' and characters in (1, 32, 1024)")
    table = table[(table["window_frames"] == 32) | (table["characters"] == 1024)]
    assert len(table) >= 6
    for row in table.itertuples():
        torch = "PyTorch" in row.model
        model = "CAMDM" if torch else find_preset(row.model).name
        assert (torch, model, row.window_frames, row.steps, row.characters) in timed, row
