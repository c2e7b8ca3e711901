"""Sweeps: the plan, what a dead worker costs, and tables like those of one process, byte by byte."""

from __future__ import annotations

import json
import logging
import os
import signal
import subprocess
import sys
import textwrap
import threading
import time
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import pandas as pd
import pytest
from builders import HISTORY, WINDOW, refused, same_tree, tiny_packed

from f3amd_companion import __main__ as command_line
from f3amd_companion.measuring import campaign, sweep
from f3amd_companion.measuring.campaign import Run, run_campaign
from f3amd_companion.measuring.runner import Records
from f3amd_companion.measuring.sweep import Leg, Work, gather, plan, run_leg, run_sweep
from f3amd_lib.ground.files import locked
from f3amd_lib.ground.profiles import load_profile, results_dir
from f3amd_lib.ground.records import read_table, run_record
from f3amd_lib.measures.protocol import Protocol
from f3amd_lib.networks import presets
from f3amd_lib.training import pipeline
from f3amd_lib.training.checkpoints import load_model
from f3amd_lib.training.pipeline import PreparedData

PROFILE = load_profile("smoke", "synthetic")
A, B = "F3AMD-FNO-32", "F3AMD-FNO-48"
QUEUE = [(Run(A), 1000), (Run(B), 1000), (Run(A), 2000), (Run(A, seed=1), 1000)]


def where(work: Work, table: str = "walking") -> Path:
    return work.records(work.results) / f"{table}.csv"


def contents(path: Path) -> tuple[bytes, dict]:
    """A table's bytes, and its record but for the date."""
    record = json.loads(path.with_suffix(".json").read_text())
    assert record.pop("date_utc")
    return path.read_bytes(), record


def until(condition, seconds: float = 1200.0):
    """Wait for what workers do; the time is a bound on despair alone."""
    end = time.monotonic() + seconds
    while not (found := condition()):
        assert time.monotonic() < end, "nothing happened"
        time.sleep(0.1)
    return found


# ------------------------------------------------------------------------------------ the plan


def test_snapshots_of_one_run_follow_each_other_and_others_do_not():
    legs = plan(["campaign"], [], PROFILE, QUEUE)
    assert [leg.name for leg in legs] == [f"campaign-{run.name}-{windows}" for run, windows in QUEUE]
    assert [leg.after for leg in legs] == [None, None, f"campaign-{A}-seed0-1000", None]
    assert [leg.preset for leg in plan(["campaign"], [B], PROFILE, QUEUE)] == [B]


@pytest.mark.parametrize(
    ("names", "models", "told"),
    [
        (["wolking"], [A], "walking"),
        (["sensitivity"], [A], "unknown measurement by preset 'sensitivity'"),
        (["campaign"], ["CAMDM"], "unknown name in the queue 'CAMDM'"),
    ],
)
def test_what_cannot_be_swept_is_refused(names, models, told):
    refused(told, plan, names, models, PROFILE, QUEUE)


# ------------------------------------------------------------------------------------ legs, with a measurement made up


@pytest.fixture
def weights() -> dict[str, float]:
    return {A: 1.0, B: 2.0}


@pytest.fixture
def measured() -> list[str]:
    """Models that were measured, in turn."""
    return []


@pytest.fixture
def work(tmp_path, monkeypatch, weights, measured) -> Work:
    """Two models that have weights, and a measurement `walking` that is quick."""
    packed = tiny_packed()

    def trained(name):
        return SimpleNamespace(params={"a": jnp.asarray([weights[name]])})

    def measure(prepared, profile, models):
        measured.extend(models)
        record = run_record(profile=profile, dataset=prepared.packed, seed=0, measurement="walking")
        total = {"mean": ("walking", lambda rows: rows.groupby("model", sort=False, as_index=False)[["value"]].mean())}
        records = Records(
            results_dir(profile.dataset, profile.name) / "records", record, {"walking": ["model", "steps"]},
            again=models, summaries=total,
        )  # fmt: skip
        todo = [{"model": "real", "steps": 0, "weights": ""}]
        digest = lambda name: f"w{weights[name]:g}"
        todo += [{"model": name, "steps": steps, "weights": digest(name)} for name in models for steps in (8, 1)]
        value = lambda row: weights.get(row["model"], 0.1) / 3 + row["steps"]
        rows = lambda row: pd.DataFrame({"seed": [0, 1], "value": [value(row), -value(row)]})
        return records.measure(todo, lambda row: {"walking": rows(row)})

    monkeypatch.setattr(sweep, "_opened", lambda profile, path=None: SimpleNamespace(packed=packed))
    monkeypatch.setattr(sweep, "obtain_model", lambda *a, preset, **k: (trained(preset), None, "shipped"))
    monkeypatch.setitem(sweep.MEASUREMENTS, "walking", measure)
    monkeypatch.setenv("F3AMD_RESULTS_DIR", str(tmp_path / "one process"))
    return Work(PROFILE, None, tmp_path / "results", tmp_path / "folder")


def do(work: Work, models, names=("walking",)) -> list[str]:
    """All legs here, one after the other; answers with their states."""
    legs, told = plan(names, models, PROFILE, QUEUE), {}
    for leg in legs:
        told[leg.name] = run_leg(work, leg, told.get(leg.after))
    gather(work, legs)
    return [told[leg.name]["state"] for leg in legs if leg.measurement in names]


def test_legs_leave_the_tables_of_one_process(work):
    here = sweep.MEASUREMENTS["walking"](sweep._opened(PROFILE, None), PROFILE, [A, B])
    assert do(work, [A, B]) == ["done", "done"]
    assert contents(where(work)) == contents(here.with_name("walking.csv"))
    assert contents(where(work, "mean")) == contents(here.with_name("mean.csv"))
    # It can fail: the other order is another table.
    assert do(work, [B, A]) == ["done before", "done before"]
    assert contents(where(work))[0] != contents(here.with_name("walking.csv"))[0]
    assert os.environ["F3AMD_RESULTS_DIR"].endswith("one process")


def test_a_second_start_measures_nothing_again_but_what_has_other_weights(work, weights, measured):
    do(work, [A, B])
    first = contents(where(work))
    assert do(work, [A, B]) == ["done before", "done before"] and measured == [A, B]
    assert contents(where(work)) == first
    weights[B] = 5.0
    assert do(work, [A, B]) == ["done before", "done"] and measured == [A, B, B]
    table = read_table(where(work))[0]
    assert table.groupby("model", sort=False)["weights"].first()[[A, B]].tolist() == ["w1", "w5"] and len(table) == 10


def test_a_leg_that_was_killed_is_measured_from_its_beginning(work):
    do(work, [A])
    whole, leg = contents(where(work)), Leg("walking", A, after=f"train-{A}")
    left = work.records(work.place(leg)) / "walking.csv"
    left.write_text("half a ta")  # killed while it wrote; the mark that it had finished is gone
    (work.place(leg) / "finished.json").unlink()
    assert do(work, [A]) == ["done"]
    assert contents(where(work)) == whole and not list(left.parent.glob("*.old*"))


def test_legs_of_other_settings_are_not_mixed(work):
    do(work, [A, B])
    place = work.records(work.place(Leg("walking", B))) / "walking.json"
    place.write_text(place.read_text().replace('"seed": 0', '"seed": 1'))
    refused(f"walking-{B}: measured with other settings", gather, work, plan(["walking"], [A, B], PROFILE, QUEUE))


def test_a_leg_that_another_process_still_does_is_waited_for(work):
    """A worker that the scheduler has lost may well be alive."""
    leg, told = Leg("walking", A), []
    with locked(work.place(leg) / ".lock", "doing it"):
        second = threading.Thread(target=lambda: told.append(run_leg(work, leg)))
        second.start()
        second.join(0.5)
        assert second.is_alive() and not told
    second.join()
    assert told[0]["state"] == "done"


def test_what_the_campaign_has_measured_is_not_trained_anew(work, monkeypatch):
    """A state that is further on would be begun anew, were the snapshot not known."""
    record = run_record(profile=PROFILE, dataset=tiny_packed(), seed=0)
    table = {"campaign": ["run", "windows"]}
    known = Records(work.records(work.results), record, table)
    known.put("campaign", {"run": QUEUE[0][0].name, "windows": 1000}, pd.DataFrame({"value": [1.0], "weights": ["a"]}))

    def measured(*arguments, snapshots, known, **settings):
        run, windows = snapshots[0]
        records = Records(results_dir("synthetic", "smoke") / "records", record, table, known=known)
        if records.has("campaign", key := {"run": run.name, "windows": windows}):
            yield run.name, windows, "measured before"
            return
        records.put("campaign", key, pd.DataFrame({"value": [2.0], "weights": ["b"]}))
        yield run.name, windows, "measured"

    monkeypatch.setattr(sweep, "protocol_of", lambda *a: (None, None, None))
    monkeypatch.setattr(sweep, "run_campaign", measured)
    assert do(work, [], ["campaign"]) == ["done before", "done", "done", "done"]
    rows, record = read_table(where(work, "campaign"))
    assert list(zip(rows["run"], rows["windows"], strict=True)) == [(run.name, windows) for run, windows in QUEUE]
    assert rows["value"].tolist() == [1.0, 2.0, 2.0, 2.0]
    assert not list(work.place(plan(["campaign"], [], PROFILE, QUEUE)[0]).rglob("campaign.*"))
    assert record["weights_digests"][QUEUE[0][0].name] == ["a", "b"]


# ------------------------------------------------------------------------------------ the engine


@pytest.fixture
def threads():
    """Address of a scheduler in this process, with one worker that is a thread of it."""
    distributed = pytest.importorskip("distributed")
    cluster = distributed.LocalCluster(n_workers=1, threads_per_worker=1, processes=False, dashboard_address=None)
    with cluster:
        yield cluster.scheduler_address


@pytest.mark.needs("distributed")
def test_a_failed_leg_stops_only_what_stands_on_it(work, monkeypatch, threads):
    obtain = sweep.obtain_model

    def broken(*arguments, preset, **settings):
        if preset == A:
            raise ArithmeticError("the loss stopped being a number")
        return obtain(*arguments, preset=preset, **settings)

    monkeypatch.setattr(sweep, "obtain_model", broken)
    legs = plan(["walking"], [A, B], PROFILE, QUEUE)
    told = {leg.name: told["state"] for leg, told in run_sweep(work, legs, scheduler=threads)}
    assert told.pop(f"train-{A}") == "failed, the loss stopped being a number"
    assert told.pop(f"walking-{A}").startswith("failed, ")
    assert told == {f"train-{B}": "done before", f"walking-{B}": "done"}


@pytest.mark.needs("distributed")
def test_the_command_gathers_says_what_is_done_and_keeps_what_it_cost(work, monkeypatch, threads, capsys, caplog):
    monkeypatch.setattr(command_line.Data, "open", lambda self: (sweep._opened(PROFILE, None), PROFILE))
    words = ["sweep", "walking", "--profile", "smoke", "--preset", A, "--preset", B, "--scheduler", threads]
    words += ["--out", str(work.folder)]
    with caplog.at_level(logging.INFO, "f3amd"):
        assert command_line.main(words) == 0
    results = Path(os.environ["F3AMD_RESULTS_DIR"])
    assert len(read_table(work.records(results) / "walking.csv")[0]) == 10
    assert f"walking-{A}, 3 of 4: done" in caplog.text or f"walking-{A}, 4 of 4: done" in caplog.text
    costs = read_table(work.records(results) / "sweep.csv")[0]
    assert sorted(costs["leg"]) == [f"walking-{A}", f"walking-{B}"] and (costs["seconds"] >= 0).all()
    assert command_line.main(["sweep", "walking", "--preset", "F3AMD-FNO-33"]) == 2
    assert command_line.main([*words, "--window", "64"]) == 2
    assert [line.split(":")[0] for line in capsys.readouterr().err.splitlines()] == ["f3amd sweep"] * 2


# ------------------------------------------------------------------------------------ a worker that is killed

FIRST, SECOND = Run(A, window=WINDOW), Run(A, "mixed-noise", window=WINDOW, seed=1)
SNAPSHOTS = [(FIRST, 8), (FIRST, 16), (SECOND, 8)]


def make_small(folder: Path, waits: bool, setattr=setattr) -> None:
    """Narrow networks on few clips, here or in a worker; measurements, which wait there while a file says so."""
    build, prepared = presets.build_config, PreparedData(tiny_packed(), WINDOW, HISTORY)
    judges = SimpleNamespace(params={"a": jnp.ones(1)}), Protocol(("calm", "proud")), None

    def begin(what):
        if waits:
            (folder / f"at work {what} {os.getpid()}").touch()
        while waits and (folder / "wait").exists():
            time.sleep(0.05)

    def waiting(measure):
        return lambda *arguments: (begin("there"), measure(*arguments))[1]

    def measure_model(generator, *arguments):
        begin(generator.trained.record["training"]["seed"])
        value = sum(float(jnp.abs(leaf).sum()) for leaf in jax.tree.leaves(generator.trained.params))
        rows = [{"steps": generator.num_steps, "metric": "weights", "unit": "m", "value": value / 3}]
        return pd.DataFrame(rows), None

    setattr(presets, "build_config", lambda *a, **k: build(*a, **{**k, "depth": 1, "latent_width": 8}))
    setattr(campaign, "measure_model", measure_model)
    setattr(sweep, "_opened", lambda profile, path=None: prepared)
    setattr(sweep, "protocol_of", lambda *a: judges)
    setattr(sweep, "MEASUREMENTS", {name: waiting(measure) for name, measure in sweep.MEASUREMENTS.items()})
    setattr(pipeline, "runs_dir", lambda *names: folder.joinpath("runs", *names))


@pytest.fixture
def small(tmp_path, monkeypatch) -> Path:
    make_small(tmp_path / "alone", False, monkeypatch.setattr)
    return tmp_path


@pytest.fixture
def start_worker(small):
    """Start worker processes, which end with the test."""
    preload, started = small / "small.py", []
    preload.write_text(
        textwrap.dedent(f"""
            import pathlib, sys
            sys.path.insert(0, {str(Path(__file__).parent)!r})
            import test_sweep
            test_sweep.make_small(pathlib.Path({str(small / "swept")!r}), True)
        """)
    )

    def start(address: str) -> subprocess.Popen:
        words = ["worker", address, "--no-nanny", "--nthreads", "1", "--no-dashboard", "--preload", str(preload)]
        environment = os.environ | {"PYTHONPATH": str(Path(__file__).parents[1])}
        started.append(subprocess.Popen([sys.executable, "-m", "dask", *words], cwd=small, env=environment))
        return started[-1]

    yield start
    for process in started:
        process.kill()
        process.wait()


KILLS = {
    # What is swept, of which presets -> the tables, whose worker is killed, what is trained by then, all weights.
    "snapshots": (
        ["campaign"], [], ["campaign"], SECOND.seed, f"campaign/{SECOND.name}/*.state*",
        "campaign/*/*[0-9].safetensors",
    ),
    "presets by measurements": (
        ["noise_use", "gradient_norm"], [A, B], ["noise_use", "x0_by_sigma", "input_use", "gradient_norm"], "there",
        "runs/*/*/models/*", "runs/*/*/models/*[0-9].safetensors",
    ),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.needs("distributed")
@pytest.mark.parametrize(("names", "models", "tables", "victim", "trained", "weights"), KILLS.values(), ids=KILLS)
def test_a_worker_killed_in_the_middle_costs_its_leg_and_no_byte(
    small, start_worker, monkeypatch, names, models, tables, victim, trained, weights
):
    """One of two is killed between training and measuring; then the sweep is stopped, and started again."""
    from distributed import LocalCluster

    alone, swept = small / "alone", small / "swept"
    monkeypatch.setenv("F3AMD_RESULTS_DIR", str(alone))
    settings = {"folder": alone / "campaign", "batch_size": 4, "snapshots": SNAPSHOTS, "progress": False}
    for name in names:
        if name == "campaign":
            list(run_campaign(sweep._opened(PROFILE, None), PROFILE, *sweep.protocol_of()[:2], **settings))
        else:
            sweep.MEASUREMENTS[name](sweep._opened(PROFILE, None), PROFILE, models)
    expected = {table: contents(alone / f"synthetic/smoke/records/{table}.csv") for table in tables}

    work = Work(PROFILE, None, small / "results", swept, batch_size=4)
    legs = plan(names, models, PROFILE, SNAPSHOTS)
    swept.mkdir()
    (swept / "wait").touch()
    written = {}

    def kill_one():
        try:
            until(lambda: len(list(swept.glob("at work *"))) == 2)
            written.update({path: path.stat().st_mtime_ns for path in swept.glob(trained)})
            name, *_ = swept.glob(f"at work {victim} *")
            os.kill(int(name.name.split()[-1]), signal.SIGKILL)
        finally:
            (swept / "wait").unlink()

    with LocalCluster(n_workers=0, dashboard_address=None, silence_logs=logging.CRITICAL) as cluster:
        address = cluster.scheduler_address
        workers = [start_worker(address) for _ in range(2)]
        until(lambda: len(cluster.scheduler.workers) == 2 or any(worker.poll() is not None for worker in workers))
        assert [worker.poll() for worker in workers] == [None, None]
        killer = threading.Thread(target=kill_one)
        killer.start()
        states = run_sweep(work, legs, scheduler=address)
        first, told = next((leg, told) for leg, told in states if leg.measurement in names)
        killer.join()
        assert told["state"] == "done" and [worker.poll() for worker in workers].count(None) == 1
        states.close()
        for path in gather(work, [first]):
            assert 0 < len(contents(path)[0]) < len(expected[path.stem][0])
        again = {leg.name: told["state"] for leg, told in run_sweep(work, legs, scheduler=address)}
    gather(work, legs)
    assert again[first.name] == "done before" and set(again.values()) <= {"done", "done before"}
    assert {table: contents(where(work, table)) for table in tables} == expected
    for file in (files := list(alone.glob(weights))):  # which tells its date, too
        theirs, ours = (load_model(path).params for path in (file, swept / file.relative_to(alone)))
        assert same_tree(ours, theirs), file
    assert len(files) == len(SNAPSHOTS if not models else models)
    # Nothing that was trained by then was trained a second time.
    assert written and written == {path: path.stat().st_mtime_ns for path in written}
