"""Speed tables: quotients by hand, and the paper's cells beside ours."""

import numpy as np
import pandas as pd
from builders import refused
from f3amd_notebooks.beside_printed import speedups_by_turns, times_beside_paper, training_beside_paper
from f3amd_notebooks.speed_bars import speed_bars

from f3amd_companion.measuring.times import fastest_implementations
from f3amd_lib.ground.papers import load_paper_table


def measured(*rows):
    columns = ["model", "steps", "way", "characters", "value", "share_of_peak"]
    table = pd.DataFrame(rows, columns=columns)
    return table.assign(
        window_frames=32, precision="float32", device="CPU", framework="jax", suite="main",
        low=0.9 * table["value"], high=1.2 * table["value"],
    )  # fmt: skip


GOOD = (
    ("F3AMD-FNO-96", 1, "jit", 32, 12.0, 0.5),
    ("F3AMD-FNO-96", 1, "jit, all devices", 32, 10.0, 0.7),
    ("F3AMD-FNO-96", 1, "jit, FFT", 32, 1.0, 9.0),
    ("F3AMD-FNO-96", 8, "jit", 32, 80.0, 0.6),
    ("CAMDM", 8, "jit", 32, 600.0, 0.8),
    ("CAMDM", 8, "PyTorch", 32, 500.0, 0.9),
    ("F3AMD-FNO-96", 1, "jit", 1, 2.0, 0.1),
    ("F3AMD-FNO-96", 1, "jit, FFT", 1, 4.0, 0.1),
)


def test_bars_take_the_fastest_way_and_say_what_is_met():
    bars = speed_bars(measured(*GOOD)).set_index("what")
    by_place = bars["measured"].tolist()
    np.testing.assert_allclose(by_place, [0.7, 0.6, 0.8, 0.9, 60.0, 7.5, 50.0, 0.5])
    assert bars["met"].tolist() == ["yes", "no", "yes", "yes", "yes", "yes", "yes", "no"]


def test_fastest_way_of_each_framework_in_float32():
    rows = (
        ("CAMDM", 8, "jax", "jit", 1, 3.0, "float32"),
        ("CAMDM", 8, "jax", "jit, all devices", 1, 2.0, "float32"),
        ("CAMDM", 8, "jax", "jit", 1, 1.0, "bfloat16"),
        ("CAMDM", 8, "torch", "PyTorch", 1, 4.0, "float32"),
        ("F3AMD-FNO-96", 1, "jax", "jit, FFT", 1, 0.5, "float32"),
        ("F3AMD-FNO-96", 1, "jax", "jit", 1, 0.7, "float32"),
    )
    columns = ["model", "steps", "framework", "way", "characters", "value", "precision"]
    table = pd.DataFrame(rows, [0] * len(rows), columns)  # an index as pieces of several runs have
    found = fastest_implementations(table.assign(window_frames=32, device="CPU", suite="main"))
    assert list(found["value"]) == [2.0, 4.0, 0.7]
    assert list(found["way"]) == ["jit, all devices", "PyTorch", "jit"]


def test_speedups_take_both_times_from_the_same_turns():
    main = measured(("CAMDM", 8, "jit", 32, 600.0, 0.8), ("F3AMD-FNO-96", 8, "jit", 32, 60.0, 0.6))
    bars = measured(("CAMDM", 8, "jit", 32, 900.0, 0.8), ("F3AMD-FNO-96", 8, "jit", 32, 30.0, 0.6))
    family = measured(("CAMDM", 8, "jit", 32, 500.0, 0.8), ("F3AMD-FNO-64", 8, "jit", 32, 50.0, 0))
    table = pd.concat([bars.assign(suite="bars"), family.assign(suite="family"), main])
    found = speedups_by_turns(table, fastest_implementations).set_index("model")["speedup"]
    assert found.to_dict() == {"F3AMD-FNO-96": 10.0, "F3AMD-FNO-64": 10.0}


def test_ours_stand_beside_the_papers_cells():
    table = measured(("CAMDM", 8, "jit", 32, 600.0, 0.8), ("F3AMD-FNO-96", 8, "jit", 32, 80.0, 0.6))
    beside = times_beside_paper(table, 1, "CPU")
    assert len(beside) == (load_paper_table(1)["device"] == "CPU").sum()
    ours = beside.dropna(subset=["ours"]).set_index("model")
    assert ours.loc["CAMDM", "ours"] == 600.0 and ours.loc["F3AMD-FNO-96", "ours"] == 80.0
    assert ours.loc["CAMDM", "paper"] == 1036.66
    refused("use 1, 4 or 7", times_beside_paper, table, 3, "CPU")


def test_training_is_compared_by_quotients():
    table = pd.DataFrame(
        {
            "model": ["F3AMD-FNO-96", "CAMDM"], "window_frames": 32, "epoch_minutes": [2.0, 8.0],
            "value": [0.1, 0.4], "batch_size": 64, "device": "CPU",
        }
    )  # fmt: skip
    beside = training_beside_paper(table)
    fno = beside[(beside["model"] == "F3AMD-FNO-96") & (beside["window_frames"] == 32)].iloc[0]
    assert fno["our_over_camdm"] == 0.25
    np.testing.assert_allclose(fno["paper_over_camdm"], 5.07 / 12.50)
