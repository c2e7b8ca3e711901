"""A paper's table beside ours: every figure in its own column, and a note where another judge looked."""

import pandas as pd
import pytest
from f3amd_notebooks import beside_printed as beside
from f3amd_notebooks import stored_result
from f3amd_notebooks.beside_printed import beside_printed, judge_note

from f3amd_lib.ground import records


@pytest.fixture
def committed(monkeypatch):
    """Tables that are committed, by name: (table, record); a test puts in what it wants."""
    tables = {}
    for module in (records, stored_result, beside):
        monkeypatch.setattr(module, "committed_table", lambda dataset, name: tables.get(name))
    return tables


def of_judge(weights, rows=()):
    table = pd.DataFrame(rows)
    table.attrs["stale"] = ""
    return table, {"judge_weights": weights, "dataset": "bandai", "profile": "laptop", "device_platform": "cpu",
                   "date_utc": "2026-11-24T00:00:00Z", "dataset_credit": "", "cores": 1}  # fmt: skip


def masked(metric, value, **bounds):
    return {"model": "ACMDM-S-PS2-masked", "first_prefix": "generated", "metric": metric, "value": value,
            "low": float("nan"), "high": float("nan"), "trained": "small one", **bounds}  # fmt: skip


def test_figures_stand_in_columns_that_say_whose_they_are(committed):
    rows = [masked("text_FID", 144.0, low=136.2, high=151.8), masked("R_precision_3", 0.5)]
    committed["text_tableA5"] = of_judge("one", rows)
    table, sentence = beside_printed("acmdm", "text_tableA5", ["text_FID", "R_precision_3"])
    assert len(table) == 4 and "bandai" in sentence
    row = table.set_index("model").loc["ACMDM-S-PS2-masked"]
    assert row["paper: FID ↓"] == "0.111 (0.106 to 0.116)" and row["ours: FID ↓"] == "144 (136 to 152)"
    assert row["paper: R3 ↑"].startswith("0.799 (") and row["ours: R3 ↑"] == "0.5"
    assert row["our network"] == "small one"
    prefix = table[table["model"] == "ACMDM-S-PS2-prefix"].set_index("first_prefix")
    assert (prefix.filter(like="ours") == "–").all(axis=None) and set(prefix.index) == {"generated", "ground truth"}


def test_without_a_record_the_papers_figures_stand_alone(committed):
    table, sentence = beside_printed("acmdm", "text_table4", ["text_FID", "LSD"])
    assert list(table) == ["model", "paper: FID ↓", "paper: LSD (m) ↓"] and "Not measured yet" in sentence


def test_another_judge_is_told_and_the_same_one_is_not(committed):
    committed |= {"text_table1": of_judge("one"), "text_tableA5": of_judge("one")}
    assert judge_note("text_tableA5") == ""
    committed |= {"text_table4": of_judge("two"), "text_judge": of_judge("one")}
    assert "`text_judge`, `text_table1`, `text_tableA5`" in judge_note("text_table4")
    assert "`text_table4`" in judge_note("text_table1").split("at other times")[1]
