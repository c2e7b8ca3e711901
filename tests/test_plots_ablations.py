"""Committed tables that notebooks draw from."""

import pandas as pd
import pytest

from f3amd_lib.drawing import plots_ablations as draw
from f3amd_lib.ground.records import run_record, write_table


def test_committed_tables_are_found_checked_or_absent(tmp_path, monkeypatch):
    monkeypatch.setattr(draw, "repository_root", lambda: tmp_path)
    assert draw.committed_table("synthetic", "learning") is None
    path = tmp_path / "paper_figures/synthetic/laptop/records/learning.csv"
    record = run_record(profile="laptop", dataset="synthetic", seed=3)
    write_table(path, pd.DataFrame({"model": ["m"], "loss": [0.5]}), record)
    table, read = draw.committed_table("synthetic", "learning")
    assert table["loss"].tolist() == [0.5] and read["seed"] == 3
    assert draw.committed_table("bandai", "learning") is None
    path.write_text(path.read_text().replace("0.5", "0.4"))
    with pytest.raises(ValueError, match="not the table"):
        draw.committed_table("synthetic", "learning")
