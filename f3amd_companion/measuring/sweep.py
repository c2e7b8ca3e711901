"""Presets x measurements on several processes or machines, by Dask distributed: `f3amd sweep`.

A leg is the most that a dead worker costs: one snapshot of the campaign's queue, the training of a
preset, one measurement of a preset. A leg calls what one process would call, with results in a folder
of its own, so that no two write one table. What finished legs left is gathered into the tables that
one process would have written, row by row in the order of the plan. All machines see one folder and
run one checkout.
"""

import contextlib
import dataclasses
import functools
import json
import logging
import os
import shutil
import threading
import time
import uuid
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from unittest import mock

import jax
import pandas as pd

from f3amd_companion.measuring.campaign import Run, chosen, run_campaign
from f3amd_companion.measuring.measure import MEASUREMENTS, models_with_weights, protocol_of
from f3amd_companion.measuring.runner import kept_rows
from f3amd_lib.ground import log
from f3amd_lib.ground.files import locked, write_whole
from f3amd_lib.ground.names import check_known, checked_value
from f3amd_lib.ground.profiles import RESULTS_DIR_VARIABLE, Profile
from f3amd_lib.ground.records import read_table, record_hash, write_table
from f3amd_lib.ground.trees import weights_digest
from f3amd_lib.networks import presets
from f3amd_lib.training.pipeline import PreparedData, model_files, obtain_model, prepare

CAMPAIGN, TRAIN = "campaign", "train"
"""Legs that are no measurement of `measure`: a snapshot of the queue, and the training of a preset."""

NOT_BY_PRESET = ("sensitivity", "round_times")
"""Measurements whose table is not one of trained presets side by side."""

CONNECT_S = 10
"""Seconds after which a scheduler counts as not reached."""

_ALONE = threading.Lock()  # a process has one results folder: its legs run one after the other


@dataclass(frozen=True)
class Leg:
    """What one worker does in one go.

    Attributes:
      measurement: of `MEASUREMENTS`, or `CAMPAIGN`, or `TRAIN`.
      preset: the model.
      run, windows: of the campaign's snapshot.
      after: name of the leg that has to be over before.
    """

    measurement: str
    preset: str
    run: Run | None = None
    windows: int = 0
    after: str | None = None

    @property
    def name(self) -> str:
        """A name for a folder and for people."""
        return f"{self.measurement}-{self.preset if self.run is None else f'{self.run.name}-{self.windows}'}"

    def own(self, table: pd.DataFrame) -> pd.Series:
        """Tell which rows of a table are the leg's: not those of real motion, or of other snapshots."""
        if self.run is not None:
            return (table["run"] == self.run.name) & (table["windows"] == self.windows)
        return table["model"].str.partition(", ")[0] == self.preset


@dataclass(frozen=True)
class Work:
    """What the legs of a sweep share.

    Attributes:
      profile: how much, on which data.
      source: folder or archive, where the data set needs one.
      results: folder of the results, for all data sets and profiles.
      folder: where legs lie, and states and weights of the queue; all workers see it.
      batch_size: windows a step of the queue's trainings.
    """

    profile: Profile
    source: str | None
    results: Path
    folder: Path
    batch_size: int = 128

    def records(self, root: Path) -> Path:
        """Return the folder of the records under a folder of results."""
        return root / self.profile.dataset / self.profile.name / "records"

    def place(self, leg: Leg) -> Path:
        """Return the folder of a leg's results."""
        return self.folder / "sweep" / leg.name


def plan(
    names: Sequence[str], models: Iterable[str], profile: Profile, snapshots: Sequence[tuple[Run, int]]
) -> list[Leg]:
    """Return the legs of a sweep, in the order in which one process would take them.

    Args:
      names: of `MEASUREMENTS`, or `CAMPAIGN`.
      models: presets; by default all of the queue, and for measurements those that have weights.
      profile: whose weights.
      snapshots: the queue.

    Raises:
      ValueError: for an unknown name or preset, a measurement that is not by preset, or nothing to do.
    """
    swept = [CAMPAIGN, *(name for name in MEASUREMENTS if name not in NOT_BY_PRESET)]
    if not names:
        raise ValueError(f"name what to sweep: {', '.join(swept)}")
    for name in names:
        check_known(name, swept, "measurement by preset")
    asked = list(dict.fromkeys(presets.find_preset(model).name for model in models))
    legs, last = [], {}
    for name in dict.fromkeys(names):
        # Each snapshot goes on from the one before of its run.
        for run, windows in chosen(snapshots, asked) if name == CAMPAIGN else ():
            legs.append(Leg(CAMPAIGN, run.preset, run, windows, last.get(run)))
            last[run] = legs[-1].name
        for model in (asked or models_with_weights(profile, "--preset")) if name != CAMPAIGN else ():
            training = Leg(TRAIN, model)
            legs += [training, Leg(name, model, after=training.name)]
    return list(dict.fromkeys(legs))  # of two measurements of a preset the training is one leg


_opened = functools.lru_cache(maxsize=1)(prepare)
"""Opens the data once a process."""


def run_leg(work: Work, leg: Leg, before: dict | None = None) -> dict:
    """Do one leg, or find it done; a worker calls this.

    Args:
      work, leg: what.
      before: what the leg returned that had to be over first; only waited for.

    Returns:
      state ("done" or "done before"), seconds, device and state_bytes (of the training state, 0 without one).
    """
    place, kept = work.place(leg), Path()
    log.setLevel(logging.INFO)  # what it says is forwarded to whoever started the sweep
    # A worker that the scheduler has lost, or a stopped sweep's, may still do the leg: it is waited for.
    alone = locked(place / ".lock", f"doing {leg.name}", wait=True)
    with _ALONE, alone, mock.patch.dict(os.environ, {RESULTS_DIR_VARIABLE: str(place)}):
        log.info("begun: %s", leg.name)
        prepared, started = _opened(work.profile, path=work.source), time.perf_counter()
        if leg.measurement == TRAIN:
            *_, origin = obtain_model(prepared, work.profile, preset=leg.preset, progress=False)
            state, kept = origin.replace("trained now", "done"), model_files(work.profile, leg.preset).state
        elif leg.run is not None:
            classifier, protocol, _ = protocol_of(prepared, work.profile, CAMPAIGN)
            folder, snapshots = work.folder / CAMPAIGN, [(leg.run, leg.windows)]
            # What `f3amd campaign` has measured counts: a training that is further on is not begun anew.
            ((*_, state),) = run_campaign(
                prepared, work.profile, classifier, protocol, folder=folder, batch_size=work.batch_size,
                snapshots=snapshots, known=work.records(work.results), progress=False,
            )  # fmt: skip
            kept = folder / leg.run.name / f"{leg.preset}.state.safetensors"
        else:
            state = _measured(work, leg, prepared)
        return {
            "state": "done" if state in ("done", "measured") else "done before",
            "seconds": round(time.perf_counter() - started, 1), "device": jax.devices()[0].device_kind,
            "state_bytes": kept.stat().st_size if kept.is_file() else 0,
        }  # fmt: skip


def _measured(work: Work, leg: Leg, prepared: PreparedData) -> str:
    """Measure a preset, unless it was with the same weights, data and profile."""
    finished = work.place(leg) / "finished.json"
    weights = weights_digest(obtain_model(prepared, work.profile, preset=leg.preset)[0].params)
    asked = {"profile": dataclasses.asdict(work.profile), "data": prepared.packed.fingerprint, "weights": weights}
    asked = json.dumps(asked, indent=1) + "\n"
    if finished.exists() and finished.read_text(encoding="utf-8") == asked:
        return "done before"
    finished.unlink(missing_ok=True)
    shutil.rmtree(work.records(work.place(leg)), ignore_errors=True)  # of a leg that was killed, or of other weights
    MEASUREMENTS[leg.measurement](prepared, work.profile, [leg.preset])
    write_whole(finished, asked)
    return "done"


def gather(work: Work, legs: Iterable[Leg]) -> list[Path]:
    """Put what finished legs left into the tables of the results, rows in the order of the legs.

    Rows of other models and snapshots that were measured before with the same settings stay, first.

    Returns:
      The tables.

    Raises:
      ValueError: if a leg was measured with other settings than the first.
    """
    left = [(leg, path) for leg in legs for path in sorted(work.records(work.place(leg)).glob("*.csv"))]
    written = []
    # What was set aside has a number in its name.
    for name in dict.fromkeys(path.name for _, path in left if "." not in path.stem):
        parts = [(leg, *read_table(path)) for leg, path in left if path.name == name]
        record, target, tables, digests = parts[0][2], work.records(work.results) / name, [], {}
        for leg, _, its in parts:
            if record_hash(its) != record_hash(record):
                raise ValueError(f"{work.place(leg)}: measured with other settings; remove it and sweep again")
        if (earlier := kept_rows(target, record)) is not None:
            tables = [earlier[~pd.concat([leg.own(earlier) for leg, *_ in parts], axis=1).any(axis=1)]]
            digests = read_table(target)[1].get("weights_digests") or {}
        for leg, table, its in parts:
            mine = leg.own(table)
            if leg.run is None:  # every leg measures real motion, alike: the first one's rows are kept
                mine |= ~table["model"].isin({model for each in tables for model in each["model"]})
            tables.append(table[mine])
            for key, found in (its.get("weights_digests") or {}).items():
                digests[key] = list(dict.fromkeys([*(digests.get(key, ()) if leg.run else ()), *found]))
        told = {"weights_digests": digests} if "weights_digests" in record else {}
        written.append(write_table(target, pd.concat([each for each in tables if len(each)]), record | told))
    return written


def run_sweep(
    work: Work, legs: Sequence[Leg], *, workers: int = 2, scheduler: str | None = None
) -> Iterator[tuple[Leg, dict]]:
    """Do all legs, each as soon as a worker is free and what it stands on is over.

    A leg whose worker died is done again by another, from what it left.

    Args:
      work, legs: see `plan`.
      workers: processes on this machine.
      scheduler: address of a cluster that is there already, such as tcp://host:8786, instead.

    Yields:
      (leg, what `run_leg` returned) as legs are over; of one that failed, or stands on one that did, state is "failed"
      and why.

    Raises:
      ImportError: without Dask distributed.
      ValueError: for fewer workers than one, or a scheduler that does not answer.
    """
    checked_value("--workers", workers, "int")
    try:
        import dask
        from distributed import Client, LocalCluster, as_completed
    except ImportError:
        raise ImportError(
            'f3amd sweep needs Dask distributed: make sweep-tools, or pip install "f3amd_lib[sweep]"'
        ) from None
    # What concerns the user comes back as a leg's state.
    logging.getLogger("distributed").setLevel(logging.CRITICAL)
    cluster = contextlib.nullcontext(scheduler)
    if scheduler is None:
        # Dask would give each worker one thread of linear algebra: sums would end in other last digits.
        dask.config.set({"distributed.nanny.pre-spawn-environ": {}})
        cluster = LocalCluster(
            n_workers=workers, threads_per_worker=1, memory_limit=None, dashboard_address=None,
            silence_logs=logging.CRITICAL, env={"TQDM_DISABLE": "1"},
        )  # fmt: skip
    with cluster as address:
        try:
            client = Client(address, timeout=CONNECT_S)
        except (OSError, ValueError) as error:
            raise ValueError(f"--scheduler {scheduler}: not reached ({error}); `dask scheduler` starts one") from None
        with client:
            client.forward_logging(log.name)
            log.info("workers      %d now; legs wait for a free one", len(client.nthreads()))
            futures, of_key = {}, {}
            for leg in legs:
                key = f"{leg.name}-{uuid.uuid4().hex}"  # a cluster may still hold an earlier sweep's
                futures[leg.name] = client.submit(run_leg, work, leg, futures.get(leg.after), key=key, pure=False)
                of_key[key] = leg
            for future in as_completed(futures.values()):
                try:
                    told = future.result()
                except Exception as error:  # a failed leg is no reason to stop the others
                    told = {"state": f"failed, {error or type(error).__name__}"}
                yield of_key[future.key], told
