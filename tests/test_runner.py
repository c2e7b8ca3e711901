"""Records that grow row by row: what is there is kept, what has changed is measured again."""

import contextlib
import logging
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

from f3amd_companion.measuring import measure, runner
from f3amd_companion.measuring.runner import Records
from f3amd_lib.ground.records import read_table, run_record
from f3amd_lib.ground.trees import weights_digest

KEYS = ["model", "steps"]


def row(model, steps, weights="aa"):
    return {"model": model, "steps": steps, "weights": weights}


@pytest.fixture
def run(tmp_path):
    """Measure rows into a folder; answers with the rows that were measured now."""

    def measure(todo, *, again=(), seed=0, fails=(), folder=tmp_path, known=None):
        measured = []

        def one(wanted):
            if wanted["model"] in fails:
                raise RuntimeError("stopped")
            measured.append((wanted["model"], wanted["steps"]))
            rows = pd.DataFrame({"seed": [0, 1], "value": [1.0, 2.0]})
            return {"figures": rows} | ({"rounds": rows} if wanted["steps"] else {})

        record = run_record(profile="smoke", dataset="synthetic", seed=seed)
        total = {"summary": ("figures", lambda rows: rows.groupby(KEYS, sort=False, as_index=False)[["value"]].sum())}
        records = Records(folder, record, {"figures": KEYS, "rounds": KEYS}, again=again, known=known, summaries=total)
        records.measure(todo, one)
        return measured, records

    return measure


def test_rows_are_measured_once_and_kept(run, caplog):
    todo = [row("real", 0, ""), row("a", 8), row("a", 1)]
    with caplog.at_level(logging.INFO, "f3amd"):
        measured, records = run(todo)
    assert measured == [("real", 0), ("a", 8), ("a", 1)]
    assert "figures, 2 of 3: a, 8" in caplog.messages
    table, record = read_table(records.path("figures"))
    assert list(table) == ["seed", "value", "model", "steps", "weights"] and len(table) == 6
    assert record["weights_digests"] == {"real": [""], "a": ["aa"]}
    assert len(read_table(records.path("rounds"))[0]) == 4
    assert read_table(records.path("summary"))[0]["value"].tolist() == [3.0, 3.0, 3.0]
    before = records.path("figures").read_bytes()
    assert run(todo)[0] == [] and records.path("figures").read_bytes() == before


def test_what_changed_or_is_asked_for_is_measured_again_in_its_place(run):
    todo = [row("a", 8), row("b", 8)]
    run(todo)
    measured, records = run([row("a", 8, "cc"), row("b", 8)])
    assert measured == [("a", 8)]
    table, record = read_table(records.path("figures"))
    assert list(dict.fromkeys(zip(table["model"], table["weights"], strict=True))) == [("b", "aa"), ("a", "cc")]
    assert record["weights_digests"] == {"b": ["aa"], "a": ["cc"]}
    assert run([row("a", 8, "cc"), row("b", 8)], again=["b"])[0] == [("b", 8)]
    assert len(read_table(records.path("figures"))[0]) == 4
    run([row("b, leading", 8)])
    assert run([row("b, leading", 8)], again=["b"])[0] == [("b, leading", 8)]  # a way to ask b


def test_a_stopped_run_goes_on_and_other_settings_start_anew(run, tmp_path):
    todo = [row("a", 8), row("b", 8)]
    with pytest.raises(RuntimeError, match="stopped"):
        run(todo, fails=["b"])
    assert run(todo)[0] == [("b", 8)]
    assert run(todo, seed=1)[0] == [("a", 8), ("b", 8)]
    assert (tmp_path / "figures.old1.csv").exists()


@pytest.mark.parametrize("writes", [0, 1, 2, 3])
def test_a_run_killed_between_two_files_leaves_none_without_its_rows(run, monkeypatch, writes):
    left, write = iter(range(writes)), runner.write_table
    with monkeypatch.context() as patch, pytest.raises(ZeroDivisionError) if writes < 3 else contextlib.nullcontext():
        patch.setattr(runner, "write_table", lambda *given: write(*given) if next(left, None) is not None else 1 / 0)
        run([row("a", 8)])
    measured, records = run([row("a", 8)])
    assert measured == ([("a", 8)] if writes < 3 else [])
    assert [len(read_table(records.path(name))[0]) for name in ("figures", "rounds", "summary")] == [2, 2, 1]


def test_what_another_run_has_measured_alike_counts_and_stays_as_it_is(run, tmp_path):
    run([row("a", 8), row("b", 8)])
    theirs = {path: path.read_bytes() for path in tmp_path.iterdir()}
    here = {"folder": tmp_path / "here", "known": tmp_path}
    measured, records = run([row("a", 8), row("a", 1), row("b", 8, "cc")], **here)
    assert measured == [("a", 1), ("b", 8)]
    assert set(read_table(records.path("figures"))[0]["model"]) == {"a", "b"}
    assert run([row("b", 8)], **here)[0] == []  # theirs, beside one of our own with other weights
    assert run([row("a", 8)], seed=1, **here)[0] == [("a", 8)]  # it asks for something else
    (tmp_path / "figures.csv").write_text("half a ta")
    assert run([row("a", 8)], folder=tmp_path / "there", known=tmp_path)[0] == [("a", 8)]
    assert {path: path.read_bytes() for path in theirs} == theirs | {tmp_path / "figures.csv": b"half a ta"}
    assert not list(tmp_path.glob("*.old*"))


def test_rows_and_records_name_the_weights_of_their_own_model(tmp_path, monkeypatch):
    monkeypatch.setattr(measure, "records_folder", lambda profile: tmp_path)
    record = run_record(profile="smoke", dataset="synthetic", seed=0)
    trained = {name: SimpleNamespace(params={"w": np.full(3, number)}) for number, name in enumerate("AB")}
    own = {name: weights_digest(model.params) for name, model in trained.items()}
    assert own["A"] != own["B"]
    todo, rows = [{"model": name, "steps": 8} for name in ("A", "B", "real")], pd.DataFrame({"value": [1.0]})
    path = measure._measure(
        None, record, ["walks"], todo, lambda _: {"walks": rows}, again=(), trained=trained, other="-"
    )
    table, record = read_table(path)
    assert dict(zip(table["model"], table["weights"], strict=True)) == own | {"real": "-"}
    assert record["weights_digests"] == {name: [digest] for name, digest in (own | {"real": "-"}).items()}
