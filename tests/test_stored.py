"""Committed tables that notebooks draw from are checked, and say where they come from."""

import pandas as pd
from builders import refused

from f3amd_lib.ground import stored
from f3amd_lib.ground.profiles import load_profile
from f3amd_lib.ground.records import run_record, write_table


def test_committed_tables_are_found_checked_or_absent(tmp_path, monkeypatch):
    monkeypatch.setattr(stored, "repository_root", lambda: tmp_path)
    assert stored.committed_table("synthetic", "learning") is None
    path = tmp_path / "paper_figures/synthetic/laptop/records/learning.csv"
    record = run_record(profile="laptop", dataset="synthetic", seed=3)
    write_table(path, pd.DataFrame({"model": ["m"], "loss": [0.5]}), record)
    table, read = stored.committed_table("synthetic", "learning")
    assert table["loss"].tolist() == [0.5] and read["seed"] == 3
    assert stored.committed_table("bandai", "learning") is None
    path.write_text(path.read_text().replace("0.5", "0.4"))
    refused("not the table", stored.committed_table, "synthetic", "learning")


def test_measured_tables_are_those_of_the_data_set_then_bandais_and_say_so(tmp_path, monkeypatch):
    monkeypatch.setattr(stored, "repository_root", lambda: tmp_path)
    found, sentence = stored.measured_table("synthetic", "posterior", "posterior")
    assert found is None
    assert "`make measure MEASURE=posterior DATA=bandai`" in sentence
    for dataset, value in (("bandai", 1.0), ("synthetic", 2.0)):
        record = run_record(profile=load_profile("laptop", dataset), dataset=dataset, seed=0)
        path = tmp_path / "paper_figures" / dataset / "laptop" / "records" / "posterior.csv"
        write_table(path, pd.DataFrame({"value": [value]}), record)
        found, sentence = stored.measured_table("synthetic", "posterior", "posterior")
        assert found["value"].tolist() == [value]
        assert found.attrs["dataset"] == dataset
        assert f"data {dataset}, profile laptop" in sentence
