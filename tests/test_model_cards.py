"""Cards of shipped models say what the weights file and the committed results say."""

import dataclasses
import hashlib
import json
import re
import shlex

import model_cards
import pandas as pd
import pytest
from builders import captioned_walks
from f3amd_notebooks.quality_tables import committed_quality
from model_cards import measured_table
from page_tables import fill_tables

from f3amd_companion.__main__ import main
from f3amd_lib.ground.profiles import repository_root
from f3amd_lib.ground.records import committed_table
from f3amd_lib.ground.trees import describe, weights_digest
from f3amd_lib.motion import synthetic
from f3amd_lib.networks import presets
from f3amd_lib.text.data import text_encoders
from f3amd_lib.text.stages import text_models, train_stage
from f3amd_lib.training.checkpoints import load_model
from f3amd_lib.training.pipeline import PRETRAINED_DIR

SHIPPED = sorted(PRETRAINED_DIR.rglob("*.safetensors"))
WALKERS = [path for path in SHIPPED if path.parent.name != "text"]
JUDGE = PRETRAINED_DIR / "bandai" / "text" / "judge.safetensors"
TEXT = [path for path in SHIPPED if path.parent.name == "text" and path != JUDGE]


@pytest.mark.parametrize("path", WALKERS + TEXT, ids=lambda path: path.stem)
def test_every_shipped_model_has_its_card(path):
    card, record = path.with_suffix(".md").read_text(encoding="utf-8"), describe(path)["record"]
    assert card == model_cards.card_of(path), "write the cards anew: python scripts/model_cards.py"
    assert record["dataset_licence"] in card and record["dataset_credit"] in card
    assert ("non-commercial" in card) == ("NC" in record["dataset_licence"])
    recipe = record.get("training") or record["identity"]["training"]  # of the last leg, where there were several
    seen = record.get("windows_seen", record.get("motions_seen", recipe["num_steps"] * recipe["batch_size"]))
    assert f"({seen:,} " in card and record.get("schedule_note", "") in card


def test_the_judge_has_its_card_with_figures_of_its_own_alone():
    card = JUDGE.with_suffix(".md").read_text(encoding="utf-8")
    assert card == model_cards.card_of(JUDGE), "write the cards anew: python scripts/model_cards.py"
    table, record = committed_table("bandai", "text_judge")
    assert record["judge_weights"] in card and "captions of other clips" in card and "non-commercial" in card
    other = model_cards.judge_card(JUDGE, (table, record | {"judge_weights": "another"}))
    assert "Not measured yet." in other and "captions of other clips" not in other


class Asked(Exception):
    """Raised where a training would begin."""


def test_the_command_on_a_text_card_asks_for_the_training_that_its_record_tells(monkeypatch):
    def begin(asked, split):
        raise Asked(asked.preset.name, asked.config, asked.window)

    monkeypatch.setattr(train_stage.STAGES["ACMDM"], "of", begin)
    walks = captioned_walks(synthetic.STYLES[:1], ("train",), num_frames=40)
    monkeypatch.setattr(text_models, "open_text_motions", lambda *asked: walks)
    monkeypatch.setattr(text_encoders, "load_text_encoder", lambda *_: None)
    path = PRETRAINED_DIR / "bandai" / "text" / "ACMDM-S-PS22-raw-n3.safetensors"
    command = re.search(r"^f3amd (train .*)$", path.with_suffix(".md").read_text(encoding="utf-8"), re.MULTILINE)[1]
    with pytest.raises(Asked) as asked:
        main(shlex.split(command))
    name, config, window = asked.value.args
    record = describe(path)["record"]
    told, network = record["identity"]["training"], record["identity"]["model"]["denoiser"]
    assert json.loads(json.dumps(dataclasses.asdict(config))) == told
    sizes = {"num_joints": network["num_joints"], "text_width": network["text_width"], "window": window}
    assert presets.build_config(name, **sizes).to_dict() == network


def test_page_of_results_shows_what_is_on_record():
    page = (repository_root() / "docs" / "results.md").read_text(encoding="utf-8")
    table = measured_table(committed_quality("bandai"))
    assert fill_tables(page, {"measured": table}, "results.md") == page, "run scripts/model_cards.py"


def test_checksums_are_those_of_the_files():
    lines = (PRETRAINED_DIR / "checksums.txt").read_text(encoding="utf-8").splitlines()
    listed = dict(reversed(line.split("  ")) for line in lines)
    assert listed.keys() == {path.relative_to(PRETRAINED_DIR).as_posix() for path in SHIPPED}
    for name, digest in listed.items():
        assert hashlib.sha256((PRETRAINED_DIR / name).read_bytes()).hexdigest() == digest


def quality(weights: str, **figures) -> pd.DataFrame:
    real = {"stepping_rate": 2.0, "slide_speed": 4.0, "joint_acceleration": 0.6, "FID": 10.0}
    rows = [("real", 0, "real", name, value) for name, value in real.items()]
    rows += [("F3AMD-FNO-96-steady", 8, weights, name, value) for name, value in figures.items()]
    columns = ["model", "steps", "weights", "metric", "value"]
    return pd.DataFrame(rows, columns=columns).assign(low=float("nan"), high=float("nan"))


@pytest.mark.parametrize(
    ("figure", "says"),
    [
        ({"x0_error_ratio": 0.85}, "hardly uses its noisy input"),
        ({"slide_speed": 84.0}, "skates: its lower toe moves over the ground at 84 cm/s"),
        ({"style_coverage": 92.2}, "its walks cover 92 % of them"),
    ],
)
def test_limits_follow_from_the_figures(figure, says):
    path = PRETRAINED_DIR / "bandai" / "F3AMD-FNO-96-steady.safetensors"
    weights = weights_digest(load_model(path).params)
    good = {"x0_error_ratio": 0.2, "stepping_rate": 1.9, "slide_speed": 6.0, "style_coverage": 97.6}
    assert says in model_cards.model_card(path, quality(weights, **good | figure))
    assert says.split(":")[0] not in model_cards.model_card(path, quality(weights, **good))
