"""The long queue: what it holds, that each run is trained as its row says, and that a stopped leg loses nothing."""

import dataclasses
import functools
import time
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import pandas as pd
import pytest
from builders import refused, walks_of

from f3amd_companion.__main__ import UNFINISHED, main
from f3amd_companion.measuring import campaign, measure
from f3amd_companion.measuring import times as measurements
from f3amd_companion.measuring.campaign import Run, chosen, longest_first, queue, run_campaign
from f3amd_companion.measuring.times import Candidate
from f3amd_companion.speed.implementations import Workload, round_flops
from f3amd_lib.data.packed import save_packed
from f3amd_lib.ground.profiles import load_profile
from f3amd_lib.ground.records import read_table
from f3amd_lib.measures.classifier import train_classifier
from f3amd_lib.measures.denoising import held_out_condition, held_out_error, input_use
from f3amd_lib.measures.protocol import Protocol
from f3amd_lib.networks import presets
from f3amd_lib.training import checkpoints
from f3amd_lib.training.pipeline import PreparedData

STYLES = ("Neutral", "Old")
PROFILE = load_profile("smoke", "synthetic")


@pytest.fixture(scope="module")
def packed():
    return walks_of(STYLES)


@pytest.fixture(scope="module")
def judges(packed):
    sizes = {"window": 20, "widths": (8, 12), "hidden_width": 24, "feature_width": 16}
    classifier = train_classifier(packed, num_steps=60, batch_size=32, progress=False, **sizes)
    return classifier, Protocol(STYLES, num_frames=66, num_diversity_seeds=2, windows_per_style=1)


@pytest.fixture
def small(monkeypatch):
    """Networks of one narrow block."""
    build = presets.build_config
    monkeypatch.setattr(presets, "build_config", lambda *a, **k: build(*a, **{**k, "depth": 1, "latent_width": 8}))


def run(packed, judges, folder, snapshots, monkeypatch, **settings):
    monkeypatch.setenv("F3AMD_RESULTS_DIR", str(folder / "results"))
    states = list(
        run_campaign(
            PreparedData(packed, 32, 10), PROFILE, *judges, folder=folder / "runs", batch_size=4, snapshots=snapshots,
            progress=False, **settings,
        )
    )  # fmt: skip
    path = folder / "results" / "synthetic" / "smoke" / "records" / "campaign.csv"
    return states, read_table(path) if path.exists() else None


# ----------------------------------------------------------------------------------- the queue


def test_the_queue_names_each_snapshot_once_and_holds_what_the_tables_need():
    snapshots = queue()
    names = [(run.name, windows) for run, windows in snapshots]
    assert len(set(names)) == len(names) == len({campaign._weights("", *snapshot) for snapshot in snapshots})
    asked = {(run.preset, run.window) for run, _ in snapshots}
    for preset in ("F3AMD-DCT-96", "F3AMD-FNO-96-m4", "F3AMD-FNO-96-AdaLN-zero", "CAMDM-VE", "F3AMD-FNO-96-no-IRD"):
        assert (preset, 32) in asked, preset
    assert {("F3AMD-FNO-96", 64), ("CAMDM", 64)} <= asked
    assert names[0][0] == "F3AMD-FNO-96-seed0" and names[-1] == ("F3AMD-FNO-96-seed0", 19_400_000)


def test_nothing_is_done_after_what_is_unfinished(tmp_path, monkeypatch):
    made = iter((("weights",), None, ("weights",)))
    monkeypatch.setattr(campaign, "_trained", lambda *_, **__: next(made))
    monkeypatch.setattr(campaign, "run_record", lambda **_: {})
    monkeypatch.setattr(campaign, "compiled_steps", lambda *_: None)
    monkeypatch.setattr(campaign, "_laid_out", lambda *_: (None, None))
    legs = campaign.run_campaign(SimpleNamespace(packed=None), None, folder=tmp_path, snapshots=queue()[:3])
    assert [state for *_, state in legs] == ["kept", "unfinished"]


def test_a_recipe_with_a_batch_of_its_own_sees_as_many_windows_in_other_steps(packed, monkeypatch, tmp_path):
    run, seen = Run("F3AMD-FNO-96", "batch-512"), []
    assert (run.config(100_000, 128).batch_size, run.config(100_000, 128).num_steps) == (512, 100 * 100_000 // 512)
    assert Run("F3AMD-FNO-96").config(100_000, 128).batch_size == 128

    def look(task, files, record, *, stop_after, **_):
        seen.append((task.config, stop_after))
        return SimpleNamespace(step=0), None

    monkeypatch.setattr(campaign, "train_in_legs", look)
    monkeypatch.setattr(campaign, "compiled_steps", lambda *_: None)
    prepared = PreparedData(packed, 32, 10)
    how = {"batch_size": 128, "folder": tmp_path, "progress": False}
    for each in (run, Run("F3AMD-FNO-96")):
        legs = list(run_campaign(prepared, PROFILE, snapshots=[(each, 10_240)], **how))
        assert legs == [(each.name, 10_240, "unfinished")]
    assert [(config.batch_size, steps) for config, steps in seen] == [(512, 20), (128, 80)]


@pytest.mark.parametrize(("precision", "products"), [("float32", "float32"), ("tf32", "tensorfloat32")])
def test_training_multiplies_in_the_precision_asked_for(packed, monkeypatch, tmp_path, precision, products):
    seen = []

    def look(*_, **__):
        seen.append(jax.config.jax_default_matmul_precision)
        return SimpleNamespace(step=0), None

    monkeypatch.setattr(campaign, "train_in_legs", look)
    monkeypatch.setattr(campaign, "compiled_steps", lambda *_: None)
    monkeypatch.setattr(campaign, "check_precision", lambda precision: None)  # as on a GPU
    how = {"snapshots": [(SEEDED, 10_240)], "folder": tmp_path, "precision": precision}
    assert [state for *_, state in run_campaign(PreparedData(packed, 32, 10), PROFILE, **how)] == ["unfinished"]
    assert seen == [products] and jax.config.jax_default_matmul_precision != products


def test_an_unknown_precision_is_refused_before_anything_is_trained(packed, tmp_path):
    for precision, why in (("tf23", "tf23"), ("bfloat16", "bfloat16"), ("tf32", "for a GPU")):
        how = {"folder": tmp_path, "snapshots": [(SEEDED, 8)], "precision": precision}
        refused(why, next, run_campaign(PreparedData(packed, 32, 10), PROFILE, None, Protocol(STYLES), **how))
    assert not list(tmp_path.iterdir())


def test_a_queue_with_a_misspelt_row_is_refused(tmp_path):
    file = tmp_path / "campaign.toml"
    camdm_by = 'presets = ["CAMDM"]\nrecipes = ["{}"]'.format
    for line, told in (
        ('recipes = ["mixed-nose"]', "mixed-noise"), ("presets = []\nrecipes = []", "neither presets nor recipes"),
        (camdm_by("IRD-excess"), "its loss"), (camdm_by("mixed-noise"), "variance-exploding"),
    ):  # fmt: skip
        file.write_text(f"[[run]]\n{line}\nwindows = [1]\n")
        refused(told, queue, file)
    file.write_text('[[run]]\npresets = ["CAMDM"]\nrecipes = []\nwindows = [1]\n')
    assert queue(file) == [(Run("CAMDM"), 1000)]


# --------------------------------------------------------------------------------------- legs


@pytest.mark.slow
def test_a_leg_that_was_stopped_goes_on_to_the_same_weights_and_measures_nothing_twice(
    packed, judges, small, tmp_path, monkeypatch
):
    """What a measurement says of real networks is the next test's; here it is a number of their weights."""
    measured = []

    def weigh(generator, *_):
        value = sum(float(jnp.abs(leaf).sum()) for leaf in jax.tree.leaves(generator.trained.params))
        measured.append(value)
        return pd.DataFrame([{"steps": generator.num_steps, "metric": "size", "unit": "", "value": value}]), None

    monkeypatch.setattr(campaign, "measure_model", weigh)
    snapshots = [(Run("F3AMD-FNO-32"), 8), (Run("F3AMD-FNO-32"), 16), (Run("F3AMD-FNO-32", "mixed-noise", seed=1), 8)]
    whole, (table, record) = run(packed, judges, tmp_path / "whole", snapshots, monkeypatch)
    assert [state for *_, state in whole] == ["measured"] * 3
    assert record["batch_size"] == 4 and set(table["steps"]) == {0, 1, 8}
    weights = table.groupby(["run", "windows"])["weights"].unique()
    assert weights.map(len).eq(1).all() and len(set(weights.map(lambda values: values[0]))) == 3
    held_out = PreparedData(packed, 32, 10).windows("validation")
    for each, windows in snapshots:
        kept = checkpoints.load_model(tmp_path / "whole" / "runs" / each.name / f"{windows}.safetensors")
        assert kept.record["training"]["seed"] == each.seed
        # How far its answers move with its input is asked of these weights (kept with eight bits of precision).
        uses = input_use(kept, held_out_condition(held_out, kept)).set_index("metric")["value"]
        found = table.query("run == @each.name and windows == @windows and steps == 8").set_index("metric")["value"]
        assert found[uses.index].to_numpy() == pytest.approx(uses.to_numpy(), rel=0.02) and uses.min() > 0.0
        (error,) = table.query("run == @each.name and windows == @windows and metric == 'held_out_error'")["value"]
        assert error == pytest.approx(held_out_error(kept, held_out), rel=0.01) and error > 0.0
    once = measured.copy()
    assert len(once) == 2 * len(snapshots) and len(set(once)) == len(snapshots)
    # Stopped at once, then after the first snapshot, then to the end.
    legs = tmp_path / "legs"
    stopped, nothing = run(packed, judges, legs, snapshots, monkeypatch, stop_at=0.0)
    assert [state for *_, state in stopped] == ["unfinished"] and nothing is None
    run(packed, judges, legs, snapshots[:1], monkeypatch)
    rest, (again, _) = run(packed, judges, legs, snapshots, monkeypatch)
    assert [state for *_, state in rest] == ["measured before", "measured", "measured"]
    pd.testing.assert_frame_equal(table, again)
    assert measured == 2 * once
    # The losses on the way lie beside the weights, whole over both legs; the last held-out one is the table's.
    history, _ = read_table(legs / "runs" / "F3AMD-FNO-32-seed0" / "F3AMD-FNO-32.history.csv")
    losses = table.query("run == 'F3AMD-FNO-32-seed0' and metric == 'held_out_loss'")["value"]
    assert history["held_out_loss"].to_numpy() == pytest.approx(losses.to_numpy(), rel=1e-5)
    # A snapshot that was passed is trained from the beginning, and the state that was further is kept.
    folder, shorter = legs / "runs" / "F3AMD-FNO-32-seed0", [(Run("F3AMD-FNO-32"), 12)]
    further = (folder / "F3AMD-FNO-32.state.safetensors").read_bytes()
    run(packed, judges, legs, shorter, monkeypatch)
    assert (folder / "F3AMD-FNO-32.old1.state.safetensors").read_bytes() == further
    # A nonsense must show: another seed gives other weights.
    _, (other, _) = run(packed, judges, tmp_path / "other", [(Run("F3AMD-FNO-32", seed=5), 8)], monkeypatch)
    assert other["weights"][0] not in set(table["weights"])


MIXED, SEEDED = Run("F3AMD-FNO-32", "mixed-noise"), Run("F3AMD-FNO-32", seed=1)


@pytest.mark.parametrize(
    ("only", "wanted"),
    [
        (["F3AMD-FNO-32"], [MIXED, SEEDED]),  # a preset, whatever it is trained by
        ([SEEDED.name], [SEEDED]),  # a single run
        (["CAMDM", "mixed-noise"], [MIXED, Run("CAMDM")]),  # a recipe, too; in the order of the queue
        ([], [MIXED, SEEDED, Run("CAMDM")]),
    ],
)
def test_what_is_named_is_trained_and_nothing_else(only, wanted):
    snapshots = [(MIXED, 4), (SEEDED, 4), (Run("CAMDM"), 4)]
    assert chosen(snapshots, only) == [(run, 4) for run in wanted]


# ----------------------------------------------------------------------------- a GPU for minutes at a time


def test_the_longest_trainings_come_first_each_in_its_own_order():
    short, long, last = Run("F3AMD-FNO-32"), Run("F3AMD-FNO-48"), Run("CAMDM")
    snapshots = [(short, 1), (short, 2), (long, 4), (last, 2), (long, 8)]
    assert longest_first(snapshots) == [(long, 4), (long, 8), (short, 1), (short, 2), (last, 2)]
    usual = queue()
    whole = longest_first(usual)
    for each, _ in usual:
        assert chosen(whole, [each.name]) == chosen(usual, [each.name])


@pytest.fixture
def minutes(packed, monkeypatch, tmp_path):
    """Return a function that calls the command for so many minutes: (status, what was done). Each work takes one."""
    done, now = [], [0.0]

    def work(name):
        done.append(name)
        now[0] += 60.0

    def time_group(candidates, *_, **__):
        (one,) = candidates
        work(f"{one.characters} characters")
        return pd.DataFrame([dataclasses.asdict(one) | {"framework": "jax", "device": "CPU", "value": 1.0}]), {}

    def measured(prepared, classifier, protocol, run, windows, *_, **__):
        work(f"{run.name} {windows}")
        return pd.DataFrame({"value": [1.0]})

    groups = [Candidate("F3AMD-FNO-32", 1, count, "jit") for count in (1, 8)]
    judges = SimpleNamespace(params={"a": jnp.ones(1)}), Protocol(STYLES), None
    monkeypatch.setattr(measurements, "plan", lambda suite: {one.group: [one] for one in groups})
    monkeypatch.setattr(measurements, "time_group", time_group)
    monkeypatch.setattr(measurements, "compiled_steps", lambda *_: (None, 0.0))
    monkeypatch.setattr(measurements, "planned_memory", lambda *_: 0)
    monkeypatch.setattr(measurements, "_TRAINED", ("F3AMD-FNO-32",))
    monkeypatch.setattr(measurements, "training_call", lambda *_: work("training") or (lambda: None))
    trained = functools.cache(lambda: work("classifier"))  # kept, as the real one is
    monkeypatch.setattr(measure, "protocol_of", lambda *_: trained() or judges)
    monkeypatch.setattr(campaign, "_measured", measured)
    monkeypatch.setattr(campaign, "queue", lambda *_: [(SEEDED, 4), (Run("CAMDM"), 4), (Run("CAMDM"), 8)])
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    monkeypatch.setenv("XLA_FLAGS", "")
    monkeypatch.setenv("F3AMD_RESULTS_DIR", str(tmp_path / "results"))
    save_packed(tmp_path / "clips.safetensors", packed)

    def call(number: float, *words: str):
        done.clear()
        given = ["--packed", tmp_path / "clips.safetensors", "--out", tmp_path / "out", "--minutes", number]
        return main(["campaign", "--profile", "smoke", "--times", *map(str, given), *words]), done.copy()

    call.done = done
    return call


def test_times_come_first_and_the_next_call_goes_on_where_the_minutes_ended(minutes):
    """One budget for all of it; what is on record is neither timed nor trained again."""
    assert minutes(0.0) == (UNFINISHED, [])
    assert minutes(0.5) == (UNFINISHED, ["1 characters"])
    assert minutes(0.5) == (UNFINISHED, ["8 characters"])  # over before the training times
    assert minutes(0.5) == (UNFINISHED, ["training"])  # over before a style classifier is trained
    assert minutes(1.5) == (UNFINISHED, ["classifier", "CAMDM-seed0 4"])
    assert minutes(0.5) == (UNFINISHED, ["CAMDM-seed0 8"])
    assert minutes(9.0) == (0, [f"{SEEDED.name} 4"])
    assert minutes(9.0) == (0, [])


def test_training_times_on_record_are_taken_again_where_asked_or_where_one_is_missing(minutes, packed, monkeypatch):
    assert minutes(2.5) == (UNFINISHED, ["1 characters", "8 characters", "training"])
    prepared, profile = PreparedData(packed, 32, 10), PROFILE

    def timed(**how):
        minutes.done.clear()
        minutes.table = measurements.measure_training_time(prepared, profile, **how)
        return minutes.done.copy()

    assert timed() == [] and timed(again=True) == ["training"]
    row = read_table(minutes.table)[0].iloc[0]
    round_of_batch = Workload(row.model, prepared.model_config(row.model), 1, row.batch_size)
    assert 2.4 < row.flops / round_flops(round_of_batch) < 3.0  # forward, and back to weights and most values
    assert row.gflops == pytest.approx(row.flops / row.value / 1e9)
    assert row.share_of_peak == pytest.approx(row.gflops / row.peak_gflops)
    monkeypatch.setattr(measurements, "_TRAINED", ("F3AMD-FNO-32", "F3AMD-FNO-48"))
    assert timed() == ["training", "training"] and timed() == []


def test_a_misspelt_name_is_refused_before_anything_is_timed(minutes, capsys):
    assert minutes(9.0, "--only", "CAMDN") == (2, [])
    assert "did you mean 'CAMDM'" in capsys.readouterr().err
