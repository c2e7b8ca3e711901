"""What notebook 09 says of times on a GPU, against their records."""

import pytest

from f3amd_companion.speed.speed_tables import times_beside_paper, training_beside_paper
from f3amd_lib.ground.stored import committed_table


@pytest.fixture(scope="module")
def times():
    return committed_table("bandai", "synthesis_time", profile="gpu")[0]


def test_all_was_timed_in_one_group_alone_on_the_gpu(times):
    ways = committed_table("bandai", "synthesis_ways", profile="gpu")[0]
    assert set(map(tuple, ways[["device", "characters", "precision", "window_frames"]].to_numpy())) == {
        ("GPU", 1024, "tf32", 32)
    }
    assert (ways["rounds"] >= 40).all() and ways["clocks"].str.contains("H200").all()
    spread = (ways["median_high"] - ways["median_low"]) / ways["value"]
    assert spread.max() < 0.03


def test_quotients_at_1024_characters(times):
    beside = [times_beside_paper(times, number, "GPU") for number in (1, 4, 7)]
    rows = {
        (row.model, row.steps): (row.paper, row.ours)
        for table in beside
        for row in table.query("characters == 1024 and window_frames == 32").itertuples()
    }
    slow = rows["CAMDM", 8]
    gain = {key: tuple(whole / part for whole, part in zip(slow, cell, strict=True)) for key, cell in rows.items()}
    printed = {("F3AMD-FNO-96", 8): (4.0, 3.8), ("F3AMD-FNO-96", 1): (26, 23), ("F3AMD-Transformer-64", 8): (3.5, 4.1)}
    for key, told in printed.items():
        digits = 0 if isinstance(told[0], int) else 1
        assert tuple(round(value, digits) for value in gain[key]) == told, key
    for width in (32, 48, 64, 96, 128):
        paper, ours = gain[f"F3AMD-FNO-{width}", 8]
        assert 0.9 * paper < ours < paper
    for width in (32, 48, 64, 96, 128):
        paper, ours = gain[f"F3AMD-Transformer-{width}", 8]
        assert ours > paper if width < 96 else abs(ours / paper - 1) < 0.02
    quicker = [paper / ours for paper, ours in rows.values() if ours > 0]
    assert (round(min(quicker)), round(max(quicker))) == (7, 11)
    ways = committed_table("bandai", "synthesis_ways", profile="gpu")[0]
    camdm = ways.query("model == 'CAMDM' and steps == 8").set_index("way")["value"].round(1).to_dict()
    assert camdm == {"jit": 46.3, "PyTorch": 70.5, "PyTorch, compiled": 46.9}


def test_a_step_of_training():
    table = committed_table("bandai", "training_time", profile="gpu")[0]
    step = table.set_index("model")["value"]
    assert (round(1e3 * step["F3AMD-FNO-96"], 1), round(1e3 * step["CAMDM"], 1)) == (5.7, 24.8)
    beside = training_beside_paper(table).query("window_frames == 32").set_index("model")
    gain = 1 / beside[["paper_over_camdm", "our_over_camdm"]]
    assert gain.loc["F3AMD-FNO-96"].round(1).tolist() == [2.5, 4.3]
    assert gain.loc["F3AMD-FNO-32"].round(1).tolist() == [2.5, 7.1]
    minutes = beside["paper_minutes"].drop("CAMDM")
    assert minutes.max() / minutes.min() < 1.25
    assert (table["batch_size"] == 512).all() and (table["precision"] == "float32").all()
