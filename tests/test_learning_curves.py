"""Short runs of the family, and the measurement that keeps them."""

import dataclasses
import itertools
import math

import jax
import numpy as np
import pandas as pd
import pytest
from builders import HISTORY, WINDOW, packed_from, wandering_motion

from f3amd_companion.__main__ import main
from f3amd_companion.measuring import learning_curves, measure
from f3amd_lib.ground import trees
from f3amd_lib.ground.profiles import load_profile
from f3amd_lib.ground.records import read_table
from f3amd_lib.networks import presets
from f3amd_lib.training import pipeline
from f3amd_lib.training.optimise import initial_state
from f3amd_lib.training.pipeline import PreparedData
from f3amd_lib.training.recipe import profile_recipe

SHORT = {"num_steps": 4, "batch_size": 2, "learning_rate": 1e-3}


@pytest.fixture(scope="module")
def prepared():
    clips = [(wandering_motion(60, seed), seed % 2, split) for seed, split in ((0, 0), (1, 1))]
    return PreparedData(packed_from(clips), WINDOW, HISTORY)


@pytest.fixture
def small(monkeypatch):
    """The measurement on networks of one narrow block."""
    build = presets.build_config
    monkeypatch.setattr(presets, "build_config", lambda *a, **k: build(*a, **k, **{"depth": 1}))
    monkeypatch.setattr(learning_curves, "SHORT_RUN", SHORT)
    monkeypatch.setattr(measure, "SHORT_RUN", SHORT)


@pytest.mark.slow
def test_a_learning_curve_starts_before_the_first_step(prepared):
    curve = learning_curves.learning_curve(prepared, "F3AMD-FNO-32", network={"depth": 1}, **SHORT)
    assert list(curve["step"]) == [0, 1, 2, 3, 4]
    assert math.isnan(curve["loss"][0]) and curve["loss"][1:].notna().all()
    assert curve["held_out_loss"].notna().all()
    assert curve["held_out_loss"][4] != curve["held_out_loss"][0]
    assert set(curve["model"]) == {"F3AMD-FNO-32"}


def test_the_table_says_what_fell():
    def curve(model, losses, held_out):
        return pd.DataFrame({"model": model, "step": [0, 1, 2], "loss": losses, "held_out_loss": held_out})

    nan = float("nan")
    curves = [
        curve("learns", [nan, 2.0, 1.0], [3.0, 2.0, 1.0]),
        curve("memorises", [nan, 2.0, 1.0], [3.0, 2.0, 4.0]),
        curve("grows", [nan, 1.0, 2.0], [3.0, 2.0, 1.0]),
    ]
    table = learning_curves.learning_table(pd.concat(curves)).set_index("model")
    assert table["falls"].to_dict() == {"learns": True, "memorises": False, "grows": False}
    row = table.loc["learns"]
    assert (row["steps"], row["first_loss"], row["last_loss"]) == (2, 2.0, 1.0)
    assert (row["held_out_before"], row["held_out_after"]) == (3.0, 1.0)


def test_a_power_law_is_found_and_followed():
    windows = np.array([2e5, 4e5, 8e5, 1.6e6])
    found = learning_curves.power_law(windows, 3.0 * windows**-0.25, [1e6, 2e8])
    assert found["exponent"].tolist() == pytest.approx([-0.25, -0.25])
    assert found["value"].tolist() == pytest.approx([3.0 * 1e6**-0.25, 3.0 * 2e8**-0.25])
    assert found["low"].tolist() == pytest.approx(found["high"].tolist())  # no scatter, no doubt


def test_the_interval_of_a_power_law_holds_the_truth_as_often_as_it_says():
    windows, reach = 2e5 * 2.0 ** np.arange(6), 2e8
    noise = np.random.default_rng(3).normal(scale=0.1, size=(400, 6))
    found = [learning_curves.power_law(windows, 3.0 * windows**-0.25 * np.exp(one), [reach]).iloc[0] for one in noise]
    held = np.mean([row["low"] < 3.0 * reach**-0.25 < row["high"] for row in found])
    assert 0.92 < held < 0.98
    near, far = learning_curves.power_law(windows, np.exp(noise[0]), [1e6, reach]).eval("high / low")
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
    with pytest.raises(ValueError, match=message):
        learning_curves.power_law(windows, values, reach)


@pytest.mark.slow
def test_measurement_goes_on_where_it_stopped(prepared, small, tmp_path, monkeypatch):
    monkeypatch.setenv("F3AMD_RESULTS_DIR", str(tmp_path))
    profile = load_profile("smoke", "synthetic")
    first, second = "F3AMD-FNO-32", "F3AMD-FNO-32-raw"
    path = measure.measure_learning(prepared, profile, [first])
    assert path == tmp_path / "synthetic" / "smoke" / "records" / "learning.csv"
    kept, record = read_table(path)
    assert record["measurement"] == "learning" and record["num_steps"] == 4
    two = {name: presets.find_preset(name) for name in (first, second)}
    monkeypatch.setattr(presets, "PRESETS", two)
    asked = []
    curves = measure.learning_curve

    def spy(data, preset, **settings):
        asked.append(preset)
        return curves(data, preset, **settings)

    monkeypatch.setattr(measure, "learning_curve", spy)
    measure.measure_learning(prepared, profile)
    both, _ = read_table(path)
    assert asked == [second] and list(dict.fromkeys(both["model"])) == [first, second]
    pd.testing.assert_frame_equal(both[both["model"] == first].reset_index(drop=True), kept)


def test_unknown_names_end_with_status_2(capsys):
    assert main(["measure", "lerning"]) == 2
    assert "unknown measurement 'lerning'; did you mean 'learning'" in capsys.readouterr().err
    assert main(["measure", "learning", "--model", "F3AMD-FNO-69"]) == 2
    assert "did you mean 'F3AMD-FNO-96'" in capsys.readouterr().err
    assert main(["measure", "--profile", "labtop"]) == 2


def leg(prepared, profile, folder, presets=("F3AMD-FNO-32",), **settings):
    return list(
        learning_curves.train_family(
            prepared, profile, presets, folder=folder, progress=False, **settings
        )
    )  # fmt: skip


@pytest.mark.slow
def test_a_family_is_trained_in_legs(prepared, small, tmp_path, caplog):
    profile = load_profile("smoke", "synthetic", train_steps=8, batch_size=2, window=WINDOW)
    # No time at all: nothing is begun.
    assert leg(prepared, profile, tmp_path, budget_s=0.0) == [("F3AMD-FNO-32", "unfinished")]
    assert not list(tmp_path.iterdir())
    # Time runs out in the first chunk of the first model, which leaves a state to go on from.
    readings = itertools.chain([0.0, 0.5], itertools.repeat(2.0))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(learning_curves.time, "monotonic", lambda: next(readings))
        assert leg(prepared, profile, tmp_path, budget_s=1.0) == [("F3AMD-FNO-32", "unfinished")]
    files = learning_curves.model_files(profile, "F3AMD-FNO-32", folder=tmp_path)
    assert files.state.exists() and not files.model.exists()
    done = int(trees.load_tree(files.state, state_of(prepared, profile))[0].step)
    assert done == 4
    # A kill between the writing of the state and that of the history costs the rows, not the run.
    files.history.unlink()
    assert leg(prepared, profile, tmp_path) == [("F3AMD-FNO-32", "finished")]
    assert f"losses of the first {done} steps are lost" in caplog.text
    assert list(read_table(files.history)[0]["step"]) == [8]
    before = files.model.read_bytes()
    assert leg(prepared, profile, tmp_path) == [("F3AMD-FNO-32", "finished before")]
    # Other data or other settings must not pass for the same model, nor cost the one that is there.
    packed = dataclasses.replace(prepared.packed, fingerprint="others")
    others = PreparedData(packed, WINDOW, HISTORY)
    with pytest.raises(ValueError, match=r"F3AMD-FNO-32.*\.safetensors: .* other .*fingerprint"):
        leg(others, profile, tmp_path)
    longer = load_profile("smoke", "synthetic", train_steps=9, batch_size=2, window=WINDOW)
    with pytest.raises(ValueError, match="other training settings .num_steps. lies there; move it away"):
        leg(prepared, longer, tmp_path)
    assert files.model.read_bytes() == before


def state_of(prepared, profile):
    """What `load_tree` asks for: the shapes of a training state."""
    task = prepared.task("F3AMD-FNO-32", profile_recipe(profile, "F3AMD-FNO-32"))
    return lambda metadata: jax.eval_shape(initial_state, task)


def test_an_unknown_preset_stops_before_anything_is_trained(prepared, tmp_path):
    profile = load_profile("smoke", "synthetic", train_steps=4, batch_size=2, window=WINDOW)
    with pytest.raises(ValueError, match="unknown model 'F3AMD-FNO-84'; did you mean"):
        leg(prepared, profile, tmp_path, ["F3AMD-FNO-32", "F3AMD-FNO-84"])
    assert not list(tmp_path.iterdir())


def test_the_command_tells_an_unfinished_leg_by_its_status(prepared, monkeypatch, caplog):
    def legs(*states):
        monkeypatch.setattr(learning_curves, "train_family", lambda *a, **k: iter(states))
        return main(["train", "--preset", "F3AMD-FNO-32"])

    caplog.set_level("INFO")
    monkeypatch.setattr(pipeline, "prepare", lambda *a, **k: prepared)
    assert legs(("F3AMD-FNO-32", "finished")) == 0
    assert legs(("F3AMD-FNO-32", "finished"), ("CAMDM", "unfinished")) == 3
    assert "CAMDM.state.safetensors" in caplog.text


def test_a_measurement_without_weights_says_what_to_do(monkeypatch):
    monkeypatch.setattr(measure, "available_models", lambda profile: [])
    with pytest.raises(ValueError, match="no trained model for 'synthetic' at profile 'smoke'"):
        measure.models_with_weights(load_profile("smoke", "synthetic"))
