"""Presets trained in legs by one command, and the power law through a learning curve."""

import dataclasses

import jax
import numpy as np
import pytest
from builders import HISTORY, WINDOW, packed_from, refused, wandering_motion
from f3amd_notebooks.power_law import power_law

from f3amd_companion.__main__ import main
from f3amd_companion.measuring import measure
from f3amd_lib.ground import trees
from f3amd_lib.ground.profiles import load_profile
from f3amd_lib.ground.records import read_table
from f3amd_lib.networks import presets
from f3amd_lib.training import pipeline
from f3amd_lib.training.optimise import initial_state
from f3amd_lib.training.pipeline import ModelFiles, PreparedData
from f3amd_lib.training.recipe import profile_recipe


@pytest.fixture(scope="module")
def prepared():
    clips = [(wandering_motion(60, seed), seed % 2, split) for seed, split in ((0, 0), (1, 1))]
    return PreparedData(packed_from(clips), WINDOW, HISTORY)


def test_a_power_law_is_found_and_followed():
    windows = np.array([2e5, 4e5, 8e5, 1.6e6])
    found = power_law(windows, 3.0 * windows**-0.25, [1e6, 2e8])
    assert found["exponent"].tolist() == pytest.approx([-0.25, -0.25])
    assert found["value"].tolist() == pytest.approx([3.0 * 1e6**-0.25, 3.0 * 2e8**-0.25])
    assert found["low"].tolist() == pytest.approx(found["high"].tolist())  # no scatter, no doubt


def test_the_interval_of_a_power_law_holds_the_truth_as_often_as_it_says():
    windows, reach = 2e5 * 2.0 ** np.arange(6), 2e8
    noise = np.random.default_rng(3).normal(scale=0.1, size=(400, 6))
    found = [power_law(windows, 3.0 * windows**-0.25 * np.exp(one), [reach]).iloc[0] for one in noise]
    held = np.mean([row["low"] < 3.0 * reach**-0.25 < row["high"] for row in found])
    assert 0.92 < held < 0.98
    near, far = power_law(windows, np.exp(noise[0]), [1e6, reach]).eval("high / low")
    assert far > 1.5 * near  # doubt grows with the way


@pytest.mark.parametrize(
    "windows, values, reach, message",
    [
        ([1, 2], [1, 2], [3], "needs 3 points"),
        ([1, 2, 3], [1, 0, 2], [3], "positive, finite"),
        ([1, 2, 3], [1, 2, 3], [-1], "positive, finite"),
    ],
)
def test_what_has_no_power_law_is_refused(windows, values, reach, message):
    refused(message, power_law, windows, values, reach)


def test_unknown_names_end_with_status_2(capsys):
    assert main(["measure", "qualitty"]) == 2
    assert "unknown measurement 'qualitty'; did you mean 'quality'" in capsys.readouterr().err
    assert main(["measure", "quality", "--model", "F3AMD-FNO-69"]) == 2
    assert "did you mean 'F3AMD-FNO-96'" in capsys.readouterr().err
    assert main(["measure", "--profile", "labtop"]) == 2


@pytest.fixture
def leg(prepared, tmp_path, monkeypatch):
    """`f3amd train` on tiny data, networks of one narrow block; returns its exit status."""
    build = presets.build_config
    monkeypatch.setattr(presets, "build_config", lambda *a, **k: build(*a, **k, **{"depth": 1}))

    def run(*options, data=prepared, preset="F3AMD-FNO-32"):
        monkeypatch.setattr(pipeline, "prepare", lambda *a, **k: data)
        given = ["--preset", preset, "--out", str(tmp_path), "--batch-size", "2", *options]
        return main(["train", *given])

    return run


@pytest.mark.slow
def test_a_model_is_trained_in_legs(leg, prepared, tmp_path, caplog, capsys):
    eight = ("--steps", "8")
    files = ModelFiles.of(tmp_path, "F3AMD-FNO-32")
    # Time runs out in the first chunk, which leaves a state to go on from.
    assert leg(*eight, "--minutes", "1e-9") == 3
    assert files.state.exists() and not files.model.exists()
    task = prepared.task("F3AMD-FNO-32", profile_recipe(load_profile("smoke", "synthetic"), "F3AMD-FNO-32"))
    shapes = lambda metadata: jax.eval_shape(initial_state, task)
    done = int(trees.load_tree(files.state, shapes)[0].step)
    assert done == 4
    # A kill between the writing of the state and that of the history costs the rows, not the run.
    files.history.unlink()
    assert leg(*eight) == 0
    assert f"losses of the first {done} steps are lost" in caplog.text
    assert list(read_table(files.history)[0]["step"]) == [8]
    before = files.model.read_bytes()
    assert leg(*eight) == 0  # finished before
    # Other data or other settings must not pass for the same model, nor cost the one that is there.
    others = PreparedData(dataclasses.replace(prepared.packed, fingerprint="others"), WINDOW, HISTORY)
    for settings in ({"data": others}, {}):
        assert leg("--steps", "8" if settings else "9", **settings) == 2
        assert f"{files.model}: a model with other" in capsys.readouterr().err
    assert files.model.read_bytes() == before


def test_the_command_tells_an_unfinished_leg_by_its_status(prepared, monkeypatch, caplog):
    def legs(finished):
        monkeypatch.setattr(pipeline, "finished_model", lambda prepared, profile, name, files: name in finished or None)
        return main(["train", "--preset", "F3AMD-FNO-32", "--preset", "CAMDM", "--preset", "CAMDM-96"])

    caplog.set_level("INFO")
    monkeypatch.setattr(pipeline, "prepare", lambda *a, **k: prepared)
    monkeypatch.setattr(pipeline, "train", lambda *a, **k: (None, None))
    assert legs({"F3AMD-FNO-32", "CAMDM", "CAMDM-96"}) == 0
    assert legs({"F3AMD-FNO-32"}) == 3
    assert "unfinished; what is done" in caplog.text and "CAMDM.state.safetensors" in caplog.text
    assert "not begun    CAMDM-96\n" in caplog.text and "f3amd train --preset F3AMD-FNO-32 --preset" in caplog.text


def test_a_measurement_without_weights_says_what_to_do(monkeypatch):
    monkeypatch.setattr(measure, "available_models", lambda profile: [])
    message, profile = "no trained model for 'synthetic' at profile 'smoke'", load_profile("smoke", "synthetic")
    refused(message, measure.models_with_weights, profile)
