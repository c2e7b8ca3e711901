"""Fill README.md, docs/index.md and docs/results.md with their numbers, from the records.

    python scripts/fill_numbers.py          # writes the pages
    python scripts/fill_numbers.py --check  # says which would change, and ends with 1

A number has its name behind it, in a comment that no reader sees: `takes 12<!-- one_step_ms --> ms`.
"""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Callable
from pathlib import Path

import pandas as pd
from page_tables import fill_tables

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # this tree's library, whatever is installed

from f3amd_notebooks.quality_tables import committed_quality

from f3amd_companion.ledger.claims import load_claims
from f3amd_lib.ground.papers import load_paper_file
from f3amd_lib.ground.tables import markdown_table
from f3amd_lib.measures.distributions import of_seeds
from f3amd_lib.networks.presets import find_preset
from f3amd_lib.training.checkpoints import load_model
from f3amd_lib.training.pipeline import PRETRAINED_DIR

ROOT = Path(__file__).resolve().parents[1]
PAGES = (ROOT / "README.md", ROOT / "docs" / "index.md", ROOT / "docs" / "results.md")
RECORDS = ROOT / "paper_figures" / "bandai" / "laptop" / "records"
TIMES = ROOT / "paper_figures" / "synthetic" / "laptop" / "records" / "synthesis_time.csv"
FNO, STEADY = "F3AMD-FNO-96", "F3AMD-FNO-96-steady"
ROWS_OF_TIMES = (
    ("CAMDM", 8, "jax"), ("CAMDM", 8, "torch"), (FNO, 8, "jax"), ("F3AMD-Transformer-64", 8, "jax"), (FNO, 1, "jax"),
)  # fmt: skip
_NUMBER = re.compile(r"[\d.,]*\d<!-- (\w+) -->")


def fastest() -> pd.DataFrame:
    """Return the rows of the fastest way, by model, steps, framework and characters."""
    times, keys = pd.read_csv(TIMES), ["model", "steps", "framework", "characters"]
    return times.loc[times.groupby(keys)["value"].idxmin()].set_index(keys).sort_index()


def times_table() -> str:
    """Return the table of milliseconds a round of 32 frames: a row of ROWS_OF_TIMES, by number of characters."""
    value = fastest()["value"]
    rows = [
        {"characters": f"`{model}`, {steps} step{'s' * (steps > 1)}{', PyTorch' * (framework == 'torch')}"}
        | {str(count): f"{value[model, steps, framework, count]:.3g}" for count in (1, 8, 32)}
        for model, steps, framework in ROWS_OF_TIMES
    ]
    return markdown_table(pd.DataFrame(rows))


def _speed() -> dict[str, str]:
    times = fastest()
    value = times["value"]
    one, eight, camdm = ((FNO, 1, "jax", 32), (FNO, 8, "jax", 32), ("CAMDM", 8, "jax", 32))
    told = {f"{name}_ms": value[row] for name, row in (("one_step", one), ("eight_steps", eight), ("camdm", camdm))}
    told |= {f"{name}_share": 100 * times.loc[row, "share_of_peak"]
             for name, row in (("one_step", one), ("eight_steps", eight), ("camdm", camdm))}  # fmt: skip
    told |= {"one_step_gain": value[camdm] / value[one], "eight_steps_gain": value[camdm] / value[eight]}
    text = {name: f"{figure:.0f}" for name, figure in told.items()}
    for name, row in (("one_step", one), ("eight_steps", eight)):
        text[f"{name}_operations"] = f"{times.flops[camdm] / times.flops[row]:.2g}"
    faster = value["CAMDM", 8]["jax"] / value["CAMDM", 8]["torch"]
    text |= {"torch_least": f"{faster.loc[:4].min():.1f}", "torch_most": f"{faster.loc[:4].max():.1f}"}
    return text | {"iree_slower": f"{value['CAMDM', 8, 'iree', 32] / value['CAMDM', 8, 'torch', 32]:.1f}"}


def _quality() -> dict[str, str]:
    quality = committed_quality("bandai")
    slid = quality.query("metric == 'slide_speed' and window_frames == 32 and steps != 1")
    slides = slid.groupby("model")["value"].mean()
    names = {"real": "real", "steady": STEADY, "camdm": "CAMDM", "fno": FNO}
    told = {f"{name}_slide": f"{slides[model]:.0f}" for name, model in names.items()}
    fid = quality.query("metric == 'FID' and steps == 1").set_index("model")["value"]
    told |= {"camdm_one_step_fid": f"{fid['CAMDM']:.0f}", "camdm_leading_fid": f"{fid['CAMDM, leading']:.0f}"}
    rows = pd.concat([pd.read_csv(RECORDS / f"{name}.csv") for name in ("quality", "one_step")])
    value = rows.set_index(["model", "steps", "metric"])["value"]
    ways = {"camdm": ("CAMDM", 1), "camdm_walk": ("CAMDM, by DDIM", 8), "steady": (STEADY, 1)}
    ways |= {f"camdm_student{steps}": ("CAMDM, distilled", steps) for steps in (1, 2, 4)}
    ways |= {"steady_student": (f"{STEADY}, distilled", 1)}
    for metric, name, digits in (("diversity", "diversity", 2), ("foot_sliding", "foot", 2), ("FID", "fid", 0)):
        found = {f"{way}_{name}": value.get((*row, metric)) for way, row in ways.items()}
        told |= {key: f"{figure:.{digits}f}" for key, figure in found.items() if figure is not None}
    real = quality.query("model == 'real' and metric == 'contact_share'")["value"].iloc[0]
    for way in ("camdm", "camdm_student1", "steady", "steady_student"):
        told[f"{way}_contact"] = f"{100 * value[(*ways[way], 'contact_share')]:.0f}"
    return told | {"real_contact": f"{100 * real:.0f}"}


def _text() -> dict[str, str]:
    keys = (["model", "steps", "metric"], ["model", "metric"], ["model", "steps", "metric"])
    one, two, four = (of_seeds(pd.read_csv(RECORDS / f"text_pcm{n}.csv"), key).set_index(key)["value"]
                      for n, key in zip((1, 2, 4), keys, strict=True))  # fmt: skip
    told = {"caption_ms": f"{1000 * one['MotionPCM-M1', 1, 'sampling_seconds']:.0f}"}
    rows = (("MotionPCM-teacher", 50), ("MotionPCM-teacher", 1), ("MotionPCM-M1", 1))
    names = ("teacher_fid", "teacher_one_step_fid", "student_fid")
    told |= {name: f"{four[(*row, 'text_FID')]:.0f}" for name, row in zip(names, rows, strict=True)}
    for name, model in (("without", "-lambda0"), ("papers", ""), ("strong", "-lambda1")):
        told[f"{name}_discriminator_fid"] = f"{two[f'MotionPCM-M1{model}', 'text_FID']:.1f}"
    students = {"motionpcm_fid": "MotionPCM-M1", "motionlcm_fid": "MotionLCM-V2"}
    return told | {name: f"{one[model, 1, 'text_FID']:.1f}" for name, model in students.items()}


def _training() -> dict[str, str]:
    seen = pd.read_csv(RECORDS / "trained.csv").query("metric == 'windows'").set_index("model")["value"]
    of_paper = max(count for name, count in seen.items() if find_preset(name).source != "ours")
    whole = load_paper_file("paper")["training"]["windows"]["32"]
    record = load_model(PRETRAINED_DIR / "bandai" / f"{FNO}.safetensors").record
    return {
        "share_of_training": f"{100 * of_paper / whole:.1f}",
        "camdm_windows": f"{seen['CAMDM']:,.0f}",
        "steady_windows": f"{seen[STEADY]:,.0f}",
        "fno_million_windows": f"{seen[FNO] / 1e6:.1f}",
        "fno_passes": f"{seen[FNO] / record['num_train_windows']:.0f}",
        "claims": str(len(load_claims())),
    }


def numbers() -> dict[str, str]:
    """Return every number that a page can have, by name."""
    return _speed() | _quality() | _text() | _training()


def filled(page: str, known: dict[str, str], where: str) -> str:
    """Return a page with each named number, and the table of times if it has its place, from the records.

    Raises:
      ValueError: for a name that is not known.
    """

    def number(found: re.Match) -> str:
        if found[1] not in known:
            raise ValueError(f"{where}: no number is called {found[1]!r}; scripts/fill_numbers.py has the names")
        return f"{known[found[1]]}<!-- {found[1]} -->"

    page = _NUMBER.sub(number, page)
    return fill_tables(page, {"times": times_table()}, where) if "<!-- times: begin -->" in page else page


def main(words: list[str], say: Callable = print) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true")
    check = parser.parse_args(words).check
    known, changed = numbers(), []
    for path in PAGES:
        before = path.read_text(encoding="utf-8")
        after = filled(before, known, path.name)
        if after != before:
            changed.append(path.name)
            if not check:
                path.write_text(after, encoding="utf-8")
    say(f"changed: {', '.join(changed) or 'nothing'}")
    return int(bool(changed) and check)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
