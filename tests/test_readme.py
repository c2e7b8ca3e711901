"""What README states in figures is what stands on record, and its links lead somewhere."""

from __future__ import annotations

import json
import re

import numpy as np
import pandas as pd
import pytest
from PIL import Image

from f3amd_lib.ground.profiles import repository_root
from f3amd_lib.reports.model_cards import committed_quality
from f3amd_lib.training.checkpoints import load_model, weights_digest
from f3amd_lib.training.pipeline import PRETRAINED_DIR

ROOT = repository_root()
HERO = ROOT / "paper_figures/bandai/laptop/media/side_by_side.webp"
README = " ".join((ROOT / "README.md").read_text(encoding="utf-8").split())


def stated(sentence: str) -> tuple[float, ...]:
    """Figures of the one sentence of README that fits a pattern."""
    found = re.findall(sentence, README)
    assert len(found) == 1, sentence
    return tuple(float(figure) for figure in (found[0] if isinstance(found[0], tuple) else found))


@pytest.fixture(scope="module")
def milliseconds():
    times = pd.read_csv(ROOT / "paper_figures/synthetic/laptop/records/synthesis_time.csv")
    ours = times[(times["characters"] == 32) & (times["framework"] == "jax")]
    return ours.groupby(["model", "steps"])["value"].min()


def test_times(milliseconds):
    one, eight, baseline = stated(
        r"takes (\d+) ms for a window of 32 frames in 1 step, (\d+) ms in 8 steps; `CAMDM` takes (\d+) ms"
    )
    measured = milliseconds[[("F3AMD-FNO-96", 1), ("F3AMD-FNO-96", 8), ("CAMDM", 8)]]
    assert [one, eight, baseline] == [round(value) for value in measured]


@pytest.mark.parametrize(
    ("sentence", "model"),
    [
        (r"real people moves at (\d+) cm/s", ("real", 0)),
        (r"our recipe `-plus` moves at about (\d+),", ("F3AMD-FNO-96-plus", None)),
        (r"that of `CAMDM` at about (\d+),", ("CAMDM", None)),
        (r"trained this briefly, at about (\d+):", ("F3AMD-FNO-96", None)),
    ],
)
def test_slide_of_the_feet(sentence, model):
    """Both numbers of steps taken together, within what "about" may mean: a tenth."""
    quality = committed_quality("bandai").query("metric == 'slide_speed' and window_frames == 32")
    rows = quality[quality["model"] == model[0]]
    (figure,) = stated(sentence)
    assert len(rows) and figure == pytest.approx(rows["value"].mean(), rel=0.1)


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
