"""What README states in figures is what stands on record, and its links lead somewhere."""

from __future__ import annotations

import re

import pandas as pd
import pytest

from f3amd_lib.ground.profiles import repository_root
from f3amd_lib.reports.model_cards import committed_quality

ROOT = repository_root()
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
