"""Measure in headless Chromium how many milliseconds a round of the steer page takes, at 1, 8 and 32 characters.

    python scripts/page_speed.py --beside "nothing"    # record, table of docs/commands.md; make web-tools onnx-tools

Rounds are timed in the page's worker, by turns, with game and picture stopped. Each run opens the page anew.
"""

from __future__ import annotations

import argparse
import shutil
import sys
import tempfile
import time
from functools import partial
from pathlib import Path

import pandas as pd
from page_tables import fill_tables
from tqdm import tqdm

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # this tree's library, whatever is installed

from f3amd_companion.serving.steer import write_steer
from f3amd_companion.speed.machine import describe_machine
from f3amd_companion.speed.timing import take_turns
from f3amd_companion.terminal import find_model
from f3amd_lib.ground.records import read_table, run_record, write_table
from f3amd_lib.ground.tables import markdown_table
from f3amd_lib.training.checkpoints import load_model

ROOT = Path(__file__).resolve().parents[1]
RECORD = ROOT / "paper_figures/synthetic/laptop/records/page_rounds.csv"
PAGE = ROOT / "docs/commands.md"
ROUNDS = [(steps, count) for steps in (8, 1) for count in (1, 8, 32)]
READY = "return !!window.steer && document.documentElement.dataset.ready === 'yes'"
TIME = "const done = arguments[2]; steer.time(arguments[0], arguments[1]).then(done, (error) => done(String(error)))"


def open_page(driver, page: Path) -> None:
    """Open a page and wait until it is ready."""
    driver.get(page.as_uri())
    while not driver.execute_script(READY):
        time.sleep(0.1)


def time_rounds(driver, page: Path) -> list[dict]:
    """Time rounds of a steer page by turns: a row a number of steps and of characters."""
    open_page(driver, page)
    seconds = [0.0]  # as the worker counts them

    def one(steps: int, count: int) -> None:
        seconds[0] += float(driver.execute_async_script(TIME, count, str(steps))) / 1000  # or the page's words

    calls = {key: partial(one, *key) for key in ROUNDS}
    timings = take_turns(calls, min_rounds=20, min_seconds=4.0, warmup=2, clock=lambda: seconds[0])
    return [
        {"steps": steps, "characters": count, **timing.columns("ms", 1e3), "rounds": timing.rounds}
        for (steps, count), timing in timings.items()
    ]


def measure(runs: int, beside: str) -> None:
    """Time everything so many times, and write the table with its record."""
    from selenium import webdriver

    trained = load_model(find_model("synthetic"))
    options = webdriver.ChromeOptions()
    options.binary_location = shutil.which("chromium") or ""
    for option in ("--headless=new", "--no-sandbox", "--disable-dev-shm-usage", "--window-size=1280,800"):
        options.add_argument(option)
    driver = webdriver.Chrome(options=options, service=webdriver.ChromeService(shutil.which("chromedriver")))
    record = run_record(
        profile="laptop", dataset="synthetic", seed=0, model=trained.name, runs=runs, beside=beside,
        measurement=RECORD.stem,
        browser=f"Chromium {driver.capabilities['browserVersion']}, headless", machine=describe_machine(),
    )  # fmt: skip
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        page = write_steer(Path(folder) / "steer.html", trained)
        for run in tqdm(range(runs), unit="run"):
            load = describe_machine()["load"]
            rows += [{"run": run, "load": load} | row for row in time_rounds(driver, page)]
    driver.quit()
    write_table(RECORD, pd.DataFrame(rows), record)


def tables() -> dict[str, str]:
    """Return the page's table by its name, Markdown: middle, lowest and highest of the runs' medians."""
    rows, _ = read_table(RECORD)
    cells = rows.groupby(["steps", "characters"], sort=False)["value"].agg(["median", "min", "max"])
    cells = cells.map(lambda value: f"{value:.3g}" if value < 1000 else f"{value:.0f}")
    text = cells.apply(lambda row: "{} ({} to {})".format(*row), axis=1).unstack("characters")
    return {RECORD.stem: markdown_table(text.loc[rows["steps"].unique()].rename_axis(None, axis=1).reset_index())}


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=3, help="how often all is measured")
    parser.add_argument("--beside", required=True, help="what else the machine did meanwhile, for the record")
    measure(**vars(parser.parse_args()))
    PAGE.write_text(fill_tables(PAGE.read_text(encoding="utf-8"), tables(), PAGE.name), encoding="utf-8")
