"""What the documentation says of the pages' speed is what was measured."""

import page_speed
import pandas as pd
from pages import fill_tables

from f3amd_lib.ground.records import read_table, run_record, write_table


def test_the_page_has_the_tables_of_the_records():
    page = page_speed.PAGE.read_text(encoding="utf-8")
    assert fill_tables(page, page_speed.tables(), "commands.md") == page, "measure again: python scripts/page_speed.py"


def test_records_have_every_row_in_every_run_and_say_what_ran_beside():
    rounds, record = read_table(page_speed.RECORD)
    wanted = pd.MultiIndex.from_product([range(record["runs"]), (8, 1), (1, 8, 32)])
    assert set(rounds.set_index(["run", "steps", "characters"]).index) == set(wanted) and len(rounds) == len(wanted)
    assert (rounds["low"] <= rounds["value"]).all() and (rounds["value"] <= rounds["high"]).all()
    assert record["beside"] and record["browser"].startswith("Chromium") and record["runs"] >= 3
    # More work takes longer: a table with its columns changed over would say otherwise.
    middle = rounds.groupby(["steps", "characters"])["value"].median()
    assert (middle[8] > middle[1]).all() and middle[8].is_monotonic_increasing and middle[1].is_monotonic_increasing


def test_a_table_is_the_middle_of_the_runs(tmp_path, monkeypatch):
    monkeypatch.setattr(page_speed, "RECORD", tmp_path / "page_rounds.csv")
    runs = pd.DataFrame({"value": [10.0, 30.0, 12.0]}).assign(characters=1, steps=8)
    write_table(page_speed.RECORD, runs, run_record(profile="laptop", dataset="synthetic", seed=0))
    assert "12 (10 to 30)" in page_speed.tables()["page_rounds"]
