"""What the documentation says of the pages' speed is what was measured."""

import page_speed
import pandas as pd
from page_tables import fill_tables

from f3amd_lib.ground.records import run_record, write_table


def test_the_page_has_the_tables_of_the_records():
    page = page_speed.PAGE.read_text(encoding="utf-8")
    assert fill_tables(page, page_speed.tables(), "commands.md") == page, "measure again: python scripts/page_speed.py"


def test_a_table_is_the_middle_of_the_runs(tmp_path, monkeypatch):
    monkeypatch.setattr(page_speed, "RECORD", tmp_path / "page_rounds.csv")
    runs = pd.DataFrame({"value": [10.0, 30.0, 12.0]}).assign(characters=1, steps=8)
    write_table(page_speed.RECORD, runs, run_record(profile="laptop", dataset="synthetic", seed=0))
    assert "12 (10 to 30)" in page_speed.tables()["page_rounds"]
