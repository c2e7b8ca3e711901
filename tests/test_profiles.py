"""Profiles give the right numbers, refuse what they do not know, and keep results apart."""

import dataclasses
import itertools
import types

import pytest
from builders import refused

from f3amd_lib.ground import profiles
from f3amd_lib.ground.profiles import load_profile, results_dir, runs_dir
from f3amd_lib.networks import presets


@pytest.mark.parametrize("name, dataset", list(itertools.product(profiles.PROFILES, profiles.DATASETS)))
def test_every_pair_gives_a_profile_of_a_known_network(name, dataset):
    profile = load_profile(name, dataset)
    assert (profile.name, profile.dataset) == (name, dataset)
    assert presets.find_preset(profile.preset).name == profile.preset
    # Defaults must pass what overrides must pass.
    values = dataclasses.asdict(profile)
    del values["name"], values["dataset"]
    assert load_profile(name, dataset, **values) == profile


@pytest.mark.parametrize(
    "key, value, complaint",
    [
        ("num_steps", True, "num_steps must be a whole number, got True"),
        ("num_steps", 0, "num_steps must be above 0"),
        ("num_styles", "all", "num_styles must be a whole number or None"),
        ("seconds_per_style", float("nan"), "seconds_per_style must be a finite number"),
        ("seed", -1, "seed must be a whole number from 0"),
        ("preset", 96, "preset must be a name"),
        ("evaluation_styles", "proud", "evaluation_styles must be a list"),
    ],
)
def test_wrong_values_are_refused(key, value, complaint):
    refused(complaint, load_profile, "smoke", "synthetic", **{key: value})


@pytest.mark.parametrize(
    "arguments, complaint",
    [
        ({"name": "labtop"}, "unknown profile 'labtop'; did you mean 'laptop'"),
        ({"dataset": "Bandei"}, "unknown data set 'Bandei'; did you mean 'bandai'"),
        ({"num_step": 4}, "unknown profile field 'num_step'; did you mean 'num_steps'"),
        ({"zzz": 4}, r"unknown profile field 'zzz' \(one of preset"),
    ],
)
def test_unknown_names_are_refused_with_the_nearest(arguments, complaint):
    refused(complaint, load_profile, **{"name": "smoke", "dataset": "synthetic", **arguments})


@pytest.mark.parametrize(
    "injected, complaint",
    [
        ("profile = 'laptop'\nseed = 3\n", None),
        ("profle = 'smoke'\n", "unknown parameter of this notebook 'profle'; did you mean 'profile'"),
    ],
)
def test_a_parameter_that_papermill_adds_is_one_of_the_notebook(monkeypatch, injected, complaint):
    cells = ["", 'profile = "smoke"  # or "laptop"\nseed: int = 0\n', f"# Parameters\n{injected}", "load_profile()"]
    monkeypatch.setattr("IPython.get_ipython", lambda: types.SimpleNamespace(user_ns={"In": cells}))
    if complaint:
        refused(complaint, load_profile, "smoke", "synthetic")
    else:
        load_profile("smoke", "synthetic")


def test_results_go_to_the_ignored_runs_folder(tmp_path, monkeypatch):
    monkeypatch.delenv(profiles.RESULTS_DIR_VARIABLE, raising=False)
    monkeypatch.setattr(profiles, "repository_root", lambda: tmp_path)
    folder = results_dir("synthetic", "laptop")
    assert folder == tmp_path / "runs" / "synthetic" / "laptop"
    assert folder == runs_dir("synthetic", "laptop")
    assert sorted(path.name for path in folder.iterdir()) == ["figures", "media", "records", "tables"]


def test_results_dir_follows_the_variable_and_refuses_unknown_names(tmp_path, monkeypatch):
    monkeypatch.setenv(profiles.RESULTS_DIR_VARIABLE, str(tmp_path / "asked"))
    for dataset, profile in (("../elsewhere", "smoke"), ("bandai", "smok")):
        refused("unknown", results_dir, dataset, profile)
    assert not any(tmp_path.iterdir())
    assert results_dir("bandai", "gpu") == tmp_path / "asked" / "bandai" / "gpu"
