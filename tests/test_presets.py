"""The paper's names: every row of every table has a preset, and every preset trains."""

import dataclasses
import functools
import json
from pathlib import Path

import jax
import numpy as np
import pandas as pd
import pytest
from builders import CHANNELS, SKELETON, packed_from, refused, wandering_motion

from f3amd_lib.data.windows import build_windows, fit_normaliser
from f3amd_lib.diffusion.schedules import variance_preserving_linear
from f3amd_lib.ground.papers import load_paper_table
from f3amd_lib.networks import presets
from f3amd_lib.training.denoising_task import denoising_task
from f3amd_lib.training.optimise import initial_state, optimise
from f3amd_lib.training.recipe import TrainingConfig, short_recipe

COMMITTED_TABLE = Path(presets.__file__).parents[1] / "papers/f3amd/sizes.csv"
SIZE = {"channels": CHANNELS, "num_styles": 2}


@pytest.mark.parametrize("number", range(1, 13))
def test_every_row_of_every_table_has_a_preset(number):
    table = load_paper_table(number)
    # A row without numbers was trained and found wanting; it needs no 64-frame preset of ours.
    printed = table.dropna(subset=["value"])
    for name, window in {(row.model, row.window_frames) for row in printed.itertuples()}:
        preset = presets.find_preset(name)
        assert window in preset.windows, (name, window)
        assert preset.source != "ours"
    assert {presets.find_preset(name).name for name in table["model"]} <= set(presets.of_paper())


@pytest.mark.slow
def test_table_is_the_committed_one():
    """A change of sizes or operations must be meant: then write the table anew.

    presets.table(channels=141, num_styles=100).to_csv("f3amd_lib/papers/f3amd/sizes.csv", index=False)
    """
    table = presets.table(channels=141, num_styles=100)
    committed = pd.read_csv(COMMITTED_TABLE)
    pd.testing.assert_frame_equal(table, committed, check_dtype=False)
    assert len(presets.of_paper()) >= 30 and set(table["model"]) == set(presets.of_paper())


@pytest.mark.parametrize(
    ("name", "differs"),
    [
        ("F3AMD-DCT-96", {"spectral_variant": "cosine", "num_kept_modes": 32}),
        ("F3AMD-reduced-rank-FNO-96", {"spectral_variant": "reduced_rank"}),
        ("F3AMD-weighted-FNO-96", {"spectral_variant": "weighted"}),
        ("F3AMD-FNO-96 (linear enc/dec)", {"encoder_decoder": "linear"}),
        ("F3AMD-FNO-96, m=1", {"num_kept_modes": 1}),
        ("F3AMD-FNO-96 (concatenation)", {"conditioning": "concatenation", "num_kept_modes": 33}),
        ("F3AMD-FNO-96 (AdaLN-zero)", {"conditioning": "adaln_zero"}),
        ("F3AMD-FNO-96 (cross-attention)", {"conditioning": "cross_attention"}),
        ("F3AMD-FNO-96-no-IRD", {}),
        ("F3AMD-FNO-96-raw", {"input_scaling": False, "normalise": False}),
    ],
)
def test_an_ablation_differs_from_the_baseline_in_this_alone(name, differs):
    baseline = presets.build_config("F3AMD-FNO-96", **SIZE).to_dict()
    variant = presets.build_config(name, **SIZE).to_dict()
    assert {key: variant[key] for key in variant if variant[key] != baseline[key]} == differs
    assert (variant["spectral_rank"], variant["initial_mode_gain"]) == (8, 0.7)


ANOTHER_PAPER = """
[forms."-slow"]
source = "ours"
family = "F3AMD"
training = { learning_rate = 1e-5 }

[presets.Wide]
source = "Table 1"
family = "F3AMD"
network = { latent_width = 200, num_heads = 2 }
diffusion = { kind = "variance_preserving_linear", num_levels = 100 }
training = { noise = "mixed", loss = { ird = 0.0, foot = 2.0 } }
paper_names = ["W"]
windows = [32, 64]

[presets.Narrow]
source = "Table 2"
like = ["Wide", "-slow"]
network = { latent_width = 8 }
training = { loss = { foot = 3.0 } }
"""


def test_another_paper_brings_a_file_of_its_own(tmp_path):
    path = tmp_path / "another" / "presets.toml"
    path.parent.mkdir()
    path.write_text(ANOTHER_PAPER)
    found, forms = presets.read_presets(path)
    assert list(found) == ["Wide", "Narrow"] and list(forms) == ["-slow"]
    wide, narrow = found.values()
    assert wide.paper == narrow.paper == "another"
    assert wide.diffusion == narrow.diffusion == variance_preserving_linear(100)
    # What a row does not say is that of the rows it is like, but for its names and windows.
    assert narrow.network == {"latent_width": 8, "num_heads": 2}
    assert narrow.training == {"noise": "mixed", "loss": {"ird": 0.0, "foot": 3.0}, "learning_rate": 1e-5}
    assert (wide.paper_names, wide.windows) == (("W",), (32, 64))
    assert (narrow.paper_names, narrow.windows) == ((), (32,))


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ('family = "F3AMD"\nnetwrok = {}', "'netwrok'"),
        ('like = ["Wdie"]', "unknown preset above it in this file 'Wdie'; did you mean 'Wide'"),
        ('like = ["CAMDM"]', "unknown preset above it in this file 'CAMDM'"),  # of another paper
        ('family = "F3MAD"', "unknown family 'F3MAD'; did you mean 'F3AMD'"),
        ("network = {}", "'family'"),
    ],
)
def test_a_preset_that_makes_no_sense_is_refused_by_file_and_name(tmp_path, wrong, message):
    path = tmp_path / "presets.toml"
    path.write_text(ANOTHER_PAPER + f'[presets.Wrong]\nsource = "ours"\n{wrong}\n')
    refused(f"presets.toml: presets.Wrong: .*{message}", presets.read_presets, path)


def test_configs_of_every_family_survive_json():
    for name in presets.of_paper():
        config = presets.build_config(name, **SIZE)
        assert presets.config_from_dict(json.loads(json.dumps(config.to_dict()))) == config
    values = presets.build_config("CAMDM", **SIZE).to_dict()
    refused("unknown model family 'CAMD'; did you mean 'CAMDM'", presets.config_from_dict, {**values, "family": "CAMD"})


@functools.cache
def long_windows():
    """Windows of the paper's length and their normaliser."""
    packed = packed_from([(wandering_motion(60, 0), 0, 0), (wandering_motion(50, 1), 1, 0)])
    windows = build_windows(packed, "train", window=32, num_history=10)
    return windows, fit_normaliser(windows, jax.random.key(0))


@functools.cache
def two_training_steps(config, recipe_json: str):
    """Train a network for two steps; return (largest change of each weight, history row)."""
    recipe = TrainingConfig.from_dict(json.loads(recipe_json))
    windows, normaliser = long_windows()
    task = denoising_task(config, recipe, SKELETON, normaliser, windows)
    before = initial_state(task)
    # The first step has a learning rate of 0.
    after, history = optimise(task, before, chunk=2, progress=False)
    assert int(after.step) == 2
    leaves = jax.tree_util.tree_flatten_with_path(after.params)[0]
    changes = {
        jax.tree_util.keystr(path): float(np.abs(np.asarray(new) - old).max())
        for (path, new), old in zip(leaves, jax.tree.leaves(before.params), strict=True)
    }
    return changes, history[-1]


@pytest.mark.slow
@pytest.mark.parametrize("name", presets.of_paper())
def test_every_preset_answers_and_takes_a_training_step(name):
    # Compiling is what takes time here, and depth, width, how many heads (if not one) and how many
    # modes there are (if not one) change nothing in kind: presets that differ in size alone share
    # a run. At full size all are traced for the table above.
    config = presets.build_config(name, **SIZE, depth=1, latent_width=16)
    if getattr(config, "num_heads", 1) > 1:
        config = dataclasses.replace(config, num_heads=2)
    if getattr(config, "num_kept_modes", 1) > 1:
        config = dataclasses.replace(config, num_kept_modes=4)
    recipe = short_recipe(name, 2, batch_size=2, warmup_steps=1)
    changes, row = two_training_steps(config, json.dumps(recipe.to_dict()))
    assert all(np.isfinite(value) for value in row.values())
    assert all(np.isfinite(value) for value in changes.values())
    # Zero-initialised gates keep some gradients at zero, but not those behind them.
    last = "['output']" if name.startswith("CAMDM") else "['decoder']"
    assert max(change for key, change in changes.items() if key.startswith(last)) > 0
    assert max(changes.values()) < 10 * recipe.learning_rate
