"""Presets trained in legs by one command."""

import dataclasses

import jax
import pytest
from builders import HISTORY, WINDOW, packed_from, refused, wandering_motion

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
