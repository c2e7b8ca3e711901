"""Recipes of our own: one change each, and the measurements that ask networks about their noise."""

import dataclasses

import pytest
from builders import HISTORY, WINDOW, packed_from, tiny_trained, wandering_motion

from f3amd_companion.measuring import campaign, measure
from f3amd_lib.ground.profiles import load_profile
from f3amd_lib.ground.records import read_table
from f3amd_lib.networks import presets
from f3amd_lib.training.pipeline import PreparedData
from f3amd_lib.training.recipe import paper_recipe

PROFILE = load_profile("smoke", "synthetic", batch_size=2, window=WINDOW)


@pytest.fixture(scope="module")
def prepared():
    clips = [(wandering_motion(60, seed), seed % 2, split) for seed, split in ((0, 0), (1, 1))]
    return PreparedData(packed_from(clips), WINDOW, HISTORY)


def changed(first: dict, second: dict) -> set[str]:
    return {name for name in first if first[name] != second[name]}


def test_every_recipe_changes_one_thing(prepared):
    paper = campaign.RECIPES["paper"].config(100, 8, 0)
    assert paper == paper_recipe("F3AMD-FNO-96", 100, batch_size=8, seed=0)
    base = prepared.model_config("F3AMD-FNO-96", num_kept_modes=5).to_dict()
    for name, recipe in campaign.RECIPES.items():
        if name in ("paper", "plus"):
            continue
        network = prepared.model_config(recipe.preset, num_kept_modes=5, **recipe.network)
        training = recipe.config(100, 8, 0).to_dict()
        # The paper's config lacks our options, which a variant has switched off but for its own.
        plain = {field.name: field.default for field in dataclasses.fields(network)} | base
        ours = changed(plain, network.to_dict()) | changed(paper.to_dict(), training)
        follows = {"warm-up": {"warmup_steps"}, "batch-512": {"num_steps"}}.get(name, set())  # of the change itself
        assert len(ours - follows) == 1 or name in ("warm-up-and-cosine", "letter"), (name, ours)
    warm = campaign.RECIPES["warm-up-and-cosine"].config(100, 8, 0)
    assert (warm.schedule, warm.warmup_steps, warm.learning_rate) == ("warmup_cosine", 10, 2e-3)
    large = campaign.RECIPES["batch-512"].config(1000, 8, 0)
    assert large.batch_size == 512 and large.num_steps == 1000 * 8 // 512, "as many windows"
    plus = campaign.RECIPES["plus"].config(100, 8, 0)
    named = presets.find_preset("F3AMD-FNO-96-plus").training
    assert plus.own_history_share == named["own_history_share"]


def test_how_long_a_model_was_trained_is_written_down(prepared, tmp_path, monkeypatch):
    """Windows are steps times batch."""
    monkeypatch.setenv("F3AMD_RESULTS_DIR", str(tmp_path))
    tiny = tiny_trained()
    tiny = dataclasses.replace(tiny, record=tiny.record | {"training": {"num_steps": 100, "batch_size": 16}})
    monkeypatch.setattr(measure, "obtain_model", lambda prepared, profile, *, preset: (tiny, None, ""))
    monkeypatch.setattr(measure, "available_models", lambda profile: ["F3AMD-FNO-32", "F3AMD-FNO-48"])
    table, record = read_table(measure.measure_trained(prepared, PROFILE))
    assert table["metric"].eq("windows").all() and table["value"].eq(1600).all()
    assert list(record["weights_digests"]) == ["F3AMD-FNO-32", "F3AMD-FNO-48"]
    # Of a training that was gone on with, all legs count, as on its card.
    tiny = dataclasses.replace(tiny, record=tiny.record | {"windows_seen": 5000})
    table, _ = read_table(measure.measure_trained(prepared, PROFILE, ["F3AMD-FNO-32"]))
    assert table.set_index(["model", "metric"])["value"]["F3AMD-FNO-32", "windows"] == 5000
