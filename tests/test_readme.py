"""README and docs/results.md: numbers are those on record, links lead somewhere, the moving picture is whole."""

from __future__ import annotations

import json
import re

import fill_numbers as fill
import pytest
from builders import refused
from PIL import Image

from f3amd_lib.ground.profiles import repository_root
from f3amd_lib.ground.trees import weights_digest
from f3amd_lib.training.checkpoints import load_model
from f3amd_lib.training.pipeline import PRETRAINED_DIR

ROOT = repository_root()
HERO = ROOT / "paper_figures/bandai/laptop/media/side_by_side.webp"
README = (ROOT / "README.md").read_text(encoding="utf-8")


def test_numbers_of_the_pages_are_those_on_record():
    known = fill.numbers()
    for path in fill.PAGES:
        page = path.read_text(encoding="utf-8")
        assert fill.filled(page, known, path.name) == page, "fill them again: python scripts/fill_numbers.py"
        assert page.count("<!-- ") > 6
    wrong = README.replace(f"{known['camdm_ms']}<!-- camdm_ms -->", "1,234.5<!-- camdm_ms -->")
    assert wrong != README and fill.filled(wrong, known, "README.md") == README
    refused("README.md: no number is called 'speed'", fill.filled, "takes 3<!-- speed --> ms", known, "README.md")


@pytest.mark.parametrize("page", [*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md")], ids=lambda path: path.stem)
def test_links_lead_somewhere(page):
    links = re.findall(r"\]\(([^)#:\s]+)(?:#[^)]*)?\)", page.read_text(encoding="utf-8"))
    place = lambda link: ROOT / link[1:] if link.startswith("/") else page.parent / link
    assert [link for link in links if not place(link).exists()] == []


def test_the_moving_picture_is_wide_long_and_of_the_weights_that_ship():
    record = json.loads(HERO.with_suffix(".json").read_text(encoding="utf-8"))
    with Image.open(HERO) as picture:
        assert picture.width >= 800 and picture.n_frames > 5 * record["fps"]
    shipped = {name: PRETRAINED_DIR / "bandai" / f"{name}.safetensors" for name in record["weights_digests"]}
    digests = {name: weights_digest(load_model(path).params) for name, path in shipped.items()}
    assert record["weights_digests"] == digests, "other weights ship now: draw it anew, scripts/side_by_side.py"
    credit = record["dataset_credit"].partition(";")[0]
    assert credit.endswith(record["dataset_licence"]) and credit in " ".join(README.split()) and HERO.name in README
