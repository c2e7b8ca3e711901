"""Figures in README and docs/results.md are those on record; links, and what CONTRIBUTING names, lead somewhere."""

from __future__ import annotations

import json
import re

import numpy as np
import pandas as pd
import pytest
from builders import rows_of_one_step
from PIL import Image

from f3amd_companion.ledger.claims import load_claims
from f3amd_companion.ledger.model_cards import committed_quality
from f3amd_lib.ground.papers import load_paper_file
from f3amd_lib.ground.profiles import repository_root
from f3amd_lib.networks.presets import find_preset
from f3amd_lib.training.checkpoints import load_model, weights_digest
from f3amd_lib.training.pipeline import PRETRAINED_DIR

ROOT = repository_root()
HERO = ROOT / "paper_figures/bandai/laptop/media/side_by_side.webp"
README = " ".join((ROOT / "README.md").read_text(encoding="utf-8").split())
LINES = (ROOT / "docs/results.md").read_text(encoding="utf-8")
RESULTS = " ".join(LINES.split())
CHARACTERS = (1, 8, 32)
FNO = "F3AMD-FNO-96"


def stated(sentence: str, page: str = README) -> tuple[float, ...]:
    """Figures of the one sentence of a page that fits a pattern."""
    found = re.findall(sentence, page)
    assert len(found) == 1, sentence
    return tuple(float(figure.replace(",", "")) for figure in (found[0] if isinstance(found[0], tuple) else found))


@pytest.fixture(scope="module")
def fastest():
    """Rows of the fastest way, by model, steps, framework and characters."""
    times = pd.read_csv(ROOT / "paper_figures/synthetic/laptop/records/synthesis_time.csv")
    keys = ["model", "steps", "framework", "characters"]
    return times.loc[times.groupby(keys)["value"].idxmin()].set_index(keys).sort_index()


@pytest.fixture(scope="module")
def milliseconds(fastest):
    return fastest["value"]


def test_times(milliseconds):
    one, eight, baseline = stated(
        r"takes (\d+) ms for a window of 32 frames in 1 step, (\d+) ms in 8 steps; `CAMDM` takes (\d+) ms"
    )
    measured = milliseconds[[(FNO, 1, "jax", 32), (FNO, 8, "jax", 32), ("CAMDM", 8, "jax", 32)]]
    assert [one, eight, baseline] == [round(value) for value in measured]


def test_the_table_of_times(milliseconds):
    table = re.findall(r"^\| `([\w-]+)`, (\d) steps?(, PyTorch)? \|((?: [\d.]+ \|){3})$", LINES, re.M)
    assert len(table) == 5
    for model, steps, torch, cells in table:
        row = (model, int(steps), "torch" if torch else "jax")
        measured = [f"{milliseconds[(*row, count)]:.3g}" for count in CHARACTERS]
        assert cells.split(" |")[:3] == [f" {figure}" for figure in measured], row


def test_what_is_said_of_times(fastest, milliseconds):
    ours = {steps: (FNO, steps, "jax", 32) for steps in (1, 8)}
    camdm = ("CAMDM", 8, "jax", 32)
    shares = stated(r"at (\d+) % \(8 steps\) and (\d+) % \(1 step\) of the speed .* CAMDM at (\d+) %", RESULTS)
    assert list(shares) == [round(100 * fastest.loc[row, "share_of_peak"]) for row in (ours[8], ours[1], camdm)]
    gains = stated(r"the gains, (\d+)-fold and (\d+)-fold", RESULTS)
    assert list(gains) == [round(milliseconds[camdm] / milliseconds[ours[steps]]) for steps in (1, 8)]
    operations = stated(r"quotients of operations, (\d+) and ([\d.]+)\.", RESULTS)
    assert list(operations) == [float(f"{fastest.flops[camdm] / fastest.flops[ours[steps]]:.2g}") for steps in (1, 8)]


def test_what_is_said_of_frameworks(milliseconds):
    """Which compiler is meant decides whether the paper's figure is met."""
    camdm = milliseconds["CAMDM", 8]
    faster = camdm["jax"] / camdm["torch"]
    low, high, few = stated(r"is ([\d.]+) to ([\d.]+) times as fast as ours in JAX by XLA for up to (\d) ", RESULTS)
    assert [low, high] == [round(value, 1) for value in (faster.loc[:few].min(), faster.loc[:few].max())]
    assert (faster.loc[few + 1 :] < 1.05).all() and len(faster) == 6
    slower, count = stated(r"ours by IREE takes ([\d.]+) times as long as PyTorch's with (\d+) characters", RESULTS)
    assert slower == round(camdm["iree", count] / camdm["torch", count], 1)


def test_what_steady_pays_for_its_feet():
    assert README.count("(its FID is higher)") == 1
    fid = committed_quality("bandai").query("metric == 'FID' and window_frames == 32").set_index(["model", "steps"])
    fid = fid["value"]
    assert all(fid[f"{FNO}-steady", steps] > fid[name, steps] for name in ("CAMDM", FNO) for steps in (1, 2, 4, 8))


@pytest.mark.parametrize("page", [README, RESULTS], ids=["README", "results"])
@pytest.mark.parametrize(
    ("sentence", "model"),
    [
        (r"real people moves at (\d+) cm/s", "real"),
        (r"`-steady`(?: moves)? at about (\d+)(?: \(its FID is higher\))?,", "F3AMD-FNO-96-steady"),
        (r"that of `CAMDM` at about (\d+)[,.]", "CAMDM"),
        (r"after 33 passes, (?:skates )?at about (\d+)[:,]", FNO),
    ],
)
def test_slide_of_the_feet(page, sentence, model):
    """Both numbers of steps taken together, within what "about" may mean: a twentieth, of real people's a tenth."""
    quality = committed_quality("bandai").query("metric == 'slide_speed' and window_frames == 32")
    rows = quality[quality["model"] == model]
    (figure,) = stated(sentence, page)
    assert len(rows) and figure == pytest.approx(rows["value"].mean(), rel=0.1 if model == "real" else 0.05)


def test_what_is_said_of_the_level_of_one_step():
    quality = committed_quality("bandai").query("metric == 'FID' and steps == 1").set_index("model")["value"]
    said = stated(r"at its noisiest level, `CAMDM` has an FID of (\d+)\. .* the least noisy one: (\d+)\.")
    assert said == (round(quality["CAMDM"]), round(quality["CAMDM, leading"]))


def test_what_is_said_of_students_of_locomotion():
    rows, steady = rows_of_one_step(), "F3AMD-FNO-96-steady"
    value, camdm = rows["value"], "CAMDM, distilled"

    def same(said, *asked):
        return [float(figure) for figure in said] == [round(value[key], 2) for key in asked]

    variety = stated(
        r"a diversity of ([\d.]+) cm; .* `CAMDM` has ([\d.]+), and the walk that the\s+student was taught ([\d.]+)\.",
        RESULTS,
    )
    assert same(variety, *[(*key, "diversity") for key in ((camdm, 1), ("CAMDM", 1), ("CAMDM, by DDIM", 8))])
    assert README.count("Distilled, `CAMDM` triples its variety in one step, and slides more") == 1
    for metric, low, high in (("diversity", 2.7, 3.3), ("foot_sliding", 1.1, 2.0)):
        assert low < value[camdm, 1, metric] / value["CAMDM", 1, metric] < high
    feet = stated(
        r"Foot is ([\d.]+) after distilling, ([\d.]+) before\. Students of 2 and 4 steps have (0\.\d+) and (0\.\d+)",
        RESULTS,
    )
    assert same(feet, *[(*key, "foot_sliding") for key in ((camdm, 1), ("CAMDM", 1), (camdm, 2), (camdm, 4))])
    *variety, before, after = stated(
        r"from ([\d.]+) cm to ([\d.]+) by distilling\. Its FID goes from (\d+) to (\d+)", RESULTS
    )
    *touching, first, second = stated(
        r"off: (\d+) % of them are lower than 1 cm, before (\d+) %, in real motion (\d+) %\. "
        r"Foot, .*, goes from (0\.\d+) to (0\.\d+)\.",
        RESULTS,
    )
    ways = ((steady, 1), (steady + ", distilled", 1))
    assert same([*variety, first, second], *[(*key, name) for name in ("diversity", "foot_sliding") for key in ways])
    assert [before, after] == [round(value[(*key, "FID")]) for key in ways]
    shares = [rows.loc[(*key, "contact_share"), "value"] for key in (ways[1], ways[0])]
    real = committed_quality("bandai").query("model == 'real' and metric == 'contact_share'")["value"]
    assert touching == [round(100 * share) for share in (*shares, real.iloc[0])]
    assert rows.loc[(*ways[0], "FID"), "low"] < rows.loc[(*ways[1], "FID"), "high"]


def test_what_is_said_of_one_step():
    assert README.count("samples of one condition are millimetres apart, in 8 steps as in 1.") == 1
    rows = committed_quality("bandai").query(f"model == '{FNO}' and window_frames == 32 and metric == 'diversity'")
    centimetres = rows.set_index("steps")["value"]
    assert all(0.1 < centimetres[steps] < 1.0 for steps in (8, 1))


def test_times_are_said_to_be_of_the_data_that_were_timed():
    """`fastest` reads the record of `synthetic`; motion is that of `bandai`."""
    assert README.count("Motion is `bandai`, real motion capture; times are of `synthetic`, on two CPU cores") == 1
    assert "paper_figures/synthetic/laptop/records/synthesis_time.csv" in RESULTS


def test_what_is_said_of_text_to_motion():
    """A whole sentence and its FID, by the records of MotionPCM's tables."""
    folder = ROOT / "paper_figures/bandai/laptop/records"
    quality, times = (pd.read_csv(folder / f"text_pcm{number}.csv").set_index(["model", "steps", "metric"])["value"]
                      for number in (4, 1))  # fmt: skip
    (milliseconds,) = stated(r"makes 4\.8 seconds of motion of a caption in (\d+) ms")
    assert milliseconds == round(1000 * times["MotionPCM-M1", 1, "sampling_seconds"])
    many, one, student = stated(r"FID of (\d+) in 50 steps, and of (\d+) in 1, .* distilled from it has (\d+) in 1,")
    rows = (("MotionPCM-teacher", 50), ("MotionPCM-teacher", 1), ("MotionPCM-M1", 1))
    assert [many, one, student] == [round(quality[(*row, "text_FID")]) for row in rows]


def test_what_is_said_of_the_discriminator():
    folder = ROOT / "paper_figures/bandai/laptop/records"
    students = pd.read_csv(folder / "text_pcm2.csv").set_index(["model", "metric"])["value"]
    others = pd.read_csv(folder / "text_pcm1.csv").set_index(["model", "steps", "metric"])["value"]
    pattern = (
        r"FID is ([\d.]+) without it, ([\d.]+) with the paper's 0.1, and ([\d.]+) with 1, .* student has ([\d.]+)\."
    )
    *ours, latent = stated(pattern, RESULTS)
    names = ("MotionPCM-M1-lambda0", "MotionPCM-M1", "MotionPCM-M1-lambda1")
    assert ours == [round(students[name, "text_FID"], 1) for name in names]
    assert latent == round(others["MotionLCM-V2", 1, "text_FID"], 1)
    assert students["MotionPCM-M1-lambda1", "R_precision_1"] >= students["MotionPCM-M1", "R_precision_1"]


def test_number_of_claims():
    assert stated(r"judges each of its (\d+) claims") == (len(load_claims()),)


def test_how_much_of_the_papers_training_models_of_its_recipe_saw():
    trained = pd.read_csv(ROOT / "paper_figures/bandai/laptop/records/trained.csv").query("metric == 'windows'")
    seen = trained.set_index("model")["value"]
    of_paper = seen[[find_preset(name).source != "ours" for name in seen.index]]
    whole = load_paper_file("paper")["training"]["windows"]["32"]
    (share,) = stated(r"models of the paper's recipe saw at most ([\d.]+) % of its training")
    assert len(of_paper) >= 3 and share == round(100 * of_paper.max() / whole, 1)
    # What the table of results shows, and in passes over the clips.
    camdm, steady, millions, passes, share = stated(
        r"`CAMDM` saw ([\d,]+) windows, our own recipe `F3AMD-FNO-96-steady` ([\d,]+), and `F3AMD-FNO-96`, "
        r"by the paper's text, ([\d.]+) million: (\d+) passes over Bandai, ([\d.]+) % of the paper's windows",
        RESULTS,
    )
    assert [camdm, steady, 1e6 * millions] == [seen[name] for name in ("CAMDM", f"{FNO}-steady", FNO)]
    record = load_model(PRETRAINED_DIR / "bandai" / f"{FNO}.safetensors").record
    assert passes == round(seen[FNO] / record["num_train_windows"]) == 33
    assert share == round(100 * seen[FNO] / whole, 1)


def test_links_lead_somewhere():
    links = re.findall(r"\]\(([^)#:]+)\)", README)
    assert len(links) > 5
    assert [link for link in links if not (ROOT / link).exists()] == []


def test_the_moving_picture_is_smooth_wide_light_and_of_the_weights_that_ship():
    record = json.loads(HERO.with_suffix(".json").read_text(encoding="utf-8"))
    with Image.open(HERO) as picture:
        assert picture.width >= 800 and picture.n_frames > 5 * record["fps"]
        first = np.asarray(picture.convert("RGB"), np.float64)
        durations = []
        for frame in range(picture.n_frames - 1):  # the last one is a pause
            picture.seek(frame)
            picture.load()
            durations.append(picture.info["duration"])
        assert np.abs(np.asarray(picture.convert("RGB"), np.float64) - first).mean() > 1.0
    assert set(durations) == {1000 // record["fps"]} and record["fps"] >= 25
    assert HERO.stat().st_size < 1.5e6
    shipped = {name: PRETRAINED_DIR / "bandai" / f"{name}.safetensors" for name in record["weights_digests"]}
    digests = {name: weights_digest(load_model(path).params) for name, path in shipped.items()}
    assert record["weights_digests"] == digests, "other weights ship now: draw it anew, scripts/side_by_side.py"
    assert record["shown"][0] == "real clip" and len(record["shown"]) == 4
    assert not record["feet_locked"] and record["blend_frames"] == 0
    credit = record["dataset_credit"].partition(";")[0]
    assert credit.endswith(record["dataset_licence"]) and credit in README and HERO.name in README


def test_the_first_page_stays_short():
    """Two to three screens: what is longer belongs on the site."""
    assert len(README.split()) < 900 and README.count("|") == 0


def test_the_reading_map_has_every_notebook():
    listed = re.findall(r"^\|[^|]*\| `(\d\d_\w+)` \|", (ROOT / "docs/map.md").read_text(encoding="utf-8"), re.M)
    assert listed == sorted(path.stem for path in (ROOT / "notebooks").glob("[0-9]*.ipynb"))
