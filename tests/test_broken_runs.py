"""Runs that are killed, doubled, full or broken: nothing whole is lost, and the next call works."""

from __future__ import annotations

import logging
import subprocess
import sys

import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
from builders import HISTORY, WINDOW, refused, tiny_packed, tiny_task

from f3amd_companion import __main__ as command_line
from f3amd_companion.measuring.runner import kept_rows
from f3amd_lib.ground.files import locked
from f3amd_lib.ground.profiles import load_profile
from f3amd_lib.ground.records import read_table, write_table
from f3amd_lib.training import pipeline
from f3amd_lib.training.optimise import TrainingState, optimise
from f3amd_lib.training.pipeline import PreparedData

RECORD = {"dataset": "synthetic", "profile": "smoke", "seed": 0}


@pytest.fixture
def begun(tmp_path, monkeypatch):
    """A training state of step 20 and a history of two rows, (files, begin again)."""
    its = pipeline.model_files(load_profile("smoke", "synthetic"), folder=tmp_path)
    its.state.write_bytes(b"a state")
    write_table(its.history, pd.DataFrame({"step": [10, 20], "loss": [2.0, 1.0]}), RECORD)
    state = TrainingState({}, None, None, jnp.asarray(20))
    monkeypatch.setattr(pipeline, "restore_state", lambda *args: state)
    return its, lambda: pipeline._begun(its, None, None)


def test_a_history_goes_on_and_what_came_after_the_last_state_is_made_again(begun):
    its, begin = begun
    state, rows = begin()
    assert int(state.step) == 20 and [row["step"] for row in rows] == [10, 20]
    write_table(its.history, pd.DataFrame({"step": [10, 20, 30], "loss": [2.0, 1.0, 0.5]}), RECORD)
    assert [row["step"] for row in begin()[1]] == [10, 20]


def test_the_history_is_written_before_the_state(tmp_path, monkeypatch):
    order = []
    monkeypatch.setattr("f3amd_lib.training.optimise.save_state", lambda path, task, state: order.append("state"))
    monkeypatch.setattr(
        "f3amd_lib.training.optimise.advance",
        lambda task, state, length, mesh: (state._replace(step=state.step + length), {"loss": np.ones(length)}),
    )
    start = TrainingState({"a": jnp.ones(1)}, None, None, jnp.zeros((), jnp.int32))
    task = tiny_task(num_steps=4)
    optimise(task, start, checkpoint=tmp_path / "state", on_chunk=lambda row: order.append("history"), progress=False)
    assert order == ["history", "state"]


@pytest.mark.parametrize("suffix, content", [
    (".json", None), (".json", b'{"dataset": "synth'), (".json", b"[1, 2]"),
    (".csv", None), (".csv", b"step,loss\n10"), (".csv", b"\xff\xfe\x00step"),
])  # fmt: skip
def test_a_broken_history_is_set_aside_with_a_warning(begun, suffix, content, caplog):
    its, begin = begun
    broken = its.history.with_suffix(suffix)
    broken.unlink() if content is None else broken.write_bytes(content)
    with caplog.at_level(logging.WARNING, "f3amd"):
        state, rows = begin()
    assert int(state.step) == 20 and rows == []
    assert "first 20 steps" in caplog.text and "old1" in caplog.text
    write_table(its.history, pd.DataFrame({"step": [30], "loss": [0.5]}), RECORD)  # the run goes on
    assert len(read_table(its.history)[0]) == 1
    assert list(its.history.parent.glob("*.old1.*"))


def test_a_broken_record_of_a_measurement_is_set_aside_too(tmp_path, caplog):
    path = tmp_path / "quality.csv"
    write_table(path, pd.DataFrame({"model": ["a"], "value": [1.0]}), RECORD)
    assert len(kept_rows(path, RECORD)) == 1
    path.with_suffix(".json").unlink()
    with caplog.at_level(logging.WARNING, "f3amd"):
        assert kept_rows(path, RECORD) is None
    assert (tmp_path / "quality.old1.csv").exists() and "quality.old1.csv" in caplog.text
    write_table(path, pd.DataFrame({"model": ["b"], "value": [2.0]}), RECORD)


def test_a_run_killed_between_a_table_and_its_record_keeps_the_rows_that_the_record_describes(tmp_path, caplog):
    path, rows = tmp_path / "quality.csv", pd.DataFrame({"model": ["a", "b"], "value": [0.1, 2.0]})
    write_table(path, rows, RECORD)
    record = path.with_suffix(".json").read_bytes()
    more = pd.concat([rows, pd.DataFrame({"model": ["c"], "value": [3.0]})])
    write_table(path, more, RECORD)
    path.with_suffix(".json").write_bytes(record)  # killed before this file was put in its place
    with caplog.at_level(logging.WARNING, "f3amd"):
        pd.testing.assert_frame_equal(kept_rows(path, RECORD), rows)
    assert len((tmp_path / "quality.old1.csv").read_text().splitlines()) == 4  # a row that somebody added is not lost
    # A table of other rows is none of them.
    write_table(path, rows, RECORD)
    path.write_text(path.read_text().replace("0.1", "0.2") + "c,3.0\n")
    assert kept_rows(path, RECORD) is None


def test_a_second_training_in_one_folder_is_refused_while_the_first_runs(tmp_path, monkeypatch):
    profile = load_profile("smoke", "synthetic")
    prepared, task = PreparedData(tiny_packed(), WINDOW, HISTORY), tiny_task()
    monkeypatch.setattr(PreparedData, "task", lambda self, *args, **settings: task)
    lock = pipeline.model_files(profile, folder=tmp_path).model.with_suffix(".lock")
    with locked(lock, "training"):
        refused("another process", pipeline.train, prepared, profile, config=task.config, folder=tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_a_lock_is_free_once_its_process_is_killed(tmp_path):
    lock = tmp_path / "folder" / "run.lock"
    words = f"from f3amd_lib.ground.files import locked\nimport time\nwith locked({str(lock)!r}, 'work'):\n"
    script = words + "    print('held', flush=True)\n    time.sleep(60)"
    process = subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout.readline() == "held\n"
        with pytest.raises(ValueError, match="another process is work there"):
            with locked(lock, "work"):
                pass
    finally:
        process.kill()
        process.wait()
    with locked(lock, "work"):
        pass


@pytest.mark.parametrize(("command", "goes_on"), [("presets", False), ("train", True)])
def test_ctrl_c_ends_in_one_line(monkeypatch, capsys, command, goes_on):
    def stopped(*args, **settings):
        raise KeyboardInterrupt

    monkeypatch.setattr(command_line.tyro.extras, "subcommand_cli_from_dict", stopped)
    assert command_line.main([command]) == 130
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1 and lines[0].startswith(f"f3amd {command}: stopped")
    assert ("goes on" in lines[0]) == goes_on
