"""Measure the pages in headless Chromium: milliseconds a round of the steer page, pictures a second of a crowd.

    python scripts/page_speed.py --beside "nothing"    # writes records and docs/commands.md; make web-tools onnx-tools

Rounds are timed in the page's worker, by turns, with game and picture stopped. Pictures are those of a player page
whose people walk, with sticks and with bodies by turns. Each run opens the pages anew.
"""

from __future__ import annotations

import argparse
import shutil
import sys
import tempfile
import time
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd
from tqdm import tqdm

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # this tree's library, whatever is installed

from f3amd_lib.benchmarking.machine import describe_machine
from f3amd_lib.benchmarking.timing import take_turns
from f3amd_lib.ground.records import read_table, run_record, write_table
from f3amd_lib.ground.tables import fill_tables, markdown_table
from f3amd_lib.motion.synthetic import synthesize
from f3amd_lib.serving.player import Scene, write_player
from f3amd_lib.serving.steer import write_steer
from f3amd_lib.training.checkpoints import load_model
from f3amd_lib.training.pipeline import find_model

ROOT = Path(__file__).resolve().parents[1]
RECORDS, PAGE = ROOT / "paper_figures/synthetic/laptop/records", ROOT / "docs/commands.md"
ROUNDS, CROWDS = [(steps, count) for steps in (8, 1) for count in (1, 8, 32)], (1, 32, 100)
READY = "return !!(window.steer || window.player) && document.documentElement.dataset.ready === 'yes'"
TIME = "const done = arguments[2]; steer.time(arguments[0], arguments[1]).then(done, (error) => done(String(error)))"
DRAWN = "player.setBody(arguments[0]); player.setPlaying(true); return [player.state().draws, performance.now()]"


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


def count_pictures(driver, page: Path, count: int, turns: int = 2) -> list[dict]:
    """Count the pictures a second of a player page, sticks and bodies by turns, two seconds each."""
    open_page(driver, page)
    rates = {"sticks": [], "bodies": []}
    for drawn in list(rates) * turns:
        first, began = driver.execute_script(DRAWN, drawn == "bodies")
        time.sleep(2.0)
        last, ended = driver.execute_script(DRAWN, drawn == "bodies")
        rates[drawn].append(1000 * (last - first) / (ended - began))
    return [
        {
            "drawn": drawn,
            "characters": count,
            "unit": "1/s",
            "value": np.median(seen),
            "low": min(seen),
            "high": max(seen),
        }
        for drawn, seen in rates.items()
    ]


def measure(runs: int, beside: str) -> None:
    """Measure everything so many times, and write both tables with their records."""
    from selenium import webdriver

    trained = load_model(find_model("synthetic"))
    options = webdriver.ChromeOptions()
    options.binary_location = shutil.which("chromium") or ""
    for option in ("--headless=new", "--no-sandbox", "--disable-dev-shm-usage", "--window-size=1280,800"):
        options.add_argument(option)
    driver = webdriver.Chrome(options=options, service=webdriver.ChromeService(shutil.which("chromedriver")))
    record = run_record(
        profile="laptop", dataset="synthetic", seed=0, model=trained.name, runs=runs, beside=beside,
        browser=f"Chromium {driver.capabilities['browserVersion']}, headless", machine=describe_machine(),
    )  # fmt: skip
    walks = [synthesize("Neutral", 8.0, seed=seed) for seed in range(4)]
    with tempfile.TemporaryDirectory() as folder:
        calls = {"page_rounds": [partial(time_rounds, driver, write_steer(Path(folder) / "steer.html", trained))]}
        calls["page_pictures"] = []
        for count in CROWDS:
            places = [np.array([1.5 * (k % 10), 0.0, 1.5 * (k // 10)]) for k in range(count)]
            moved = [walks[k % 4].replace(root_position=walks[k % 4].root_position + at) for k, at in enumerate(places)]
            page = write_player(Path(folder) / f"{count}.html", Scene(moved), strip=False)
            calls["page_pictures"].append(partial(count_pictures, driver, page, count))
        for name, made in calls.items():
            rows = []
            for run in tqdm(range(runs), unit="run", desc=name):
                load = describe_machine()["load"]
                rows += [{"run": run, "load": load} | row for call in made for row in call()]
            write_table(RECORDS / f"{name}.csv", pd.DataFrame(rows), record | {"measurement": name})
    driver.quit()


def tables() -> dict[str, str]:
    """Return the page's tables, name -> Markdown: the middle of the runs' medians, with the lowest and the highest."""
    made = {}
    for name, down in (("page_rounds", "steps"), ("page_pictures", "drawn")):
        rows, _ = read_table(RECORDS / f"{name}.csv")
        cells = rows.groupby([down, "characters"], sort=False)["value"].agg(["median", "min", "max"])
        text = cells.apply(lambda row: "{:.3g} ({:.3g} to {:.3g})".format(*row), axis=1).unstack("characters")
        made[name] = markdown_table(text.loc[rows[down].unique()].rename_axis(None, axis=1).reset_index())
    return made


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=3, help="how often all is measured")
    parser.add_argument("--beside", required=True, help="what else the machine did meanwhile, for the record")
    measure(**vars(parser.parse_args()))
    PAGE.write_text(fill_tables(PAGE.read_text(encoding="utf-8"), tables(), PAGE.name), encoding="utf-8")
