"""Committed tables that notebooks draw from are checked, and say where they come from."""

import pandas as pd
import pytest
from builders import refused
from f3amd_notebooks.stored_result import measured_table

from f3amd_lib.ground import records
from f3amd_lib.ground.profiles import load_profile, repository_root
from f3amd_lib.ground.trees import weights_digest
from f3amd_lib.training.checkpoints import load_model
from f3amd_lib.training.pipeline import PRETRAINED_DIR


def test_committed_tables_are_found_checked_or_absent(tmp_path, monkeypatch):
    monkeypatch.setattr(records, "repository_root", lambda: tmp_path)
    assert records.committed_table("synthetic", "learning") is None
    path = tmp_path / "paper_figures/synthetic/laptop/records/learning.csv"
    record = records.run_record(profile="laptop", dataset="synthetic", seed=3)
    records.write_table(path, pd.DataFrame({"model": ["m"], "loss": [0.5]}), record)
    table, read = records.committed_table("synthetic", "learning")
    assert table["loss"].tolist() == [0.5] and read["seed"] == 3
    assert records.committed_table("bandai", "learning") is None
    path.write_text(path.read_text().replace("0.5", "0.4"))
    refused("not the table", records.committed_table, "synthetic", "learning")


def test_measured_tables_are_those_of_the_data_set_then_bandais_and_say_so(tmp_path, monkeypatch):
    monkeypatch.setattr(records, "repository_root", lambda: tmp_path)
    found, sentence = measured_table("synthetic", "quality", "quality")
    assert found is None
    assert "`make measure MEASURE=quality DATA=bandai`" in sentence
    for dataset, value in (("bandai", 1.0), ("synthetic", 2.0)):
        record = records.run_record(profile=load_profile("laptop", dataset), dataset=dataset, seed=0)
        path = tmp_path / "paper_figures" / dataset / "laptop" / "records" / "quality.csv"
        records.write_table(path, pd.DataFrame({"value": [value]}), record)
        found, sentence = measured_table("synthetic", "quality", "quality")
        assert found["value"].tolist() == [value]
        assert found.attrs["dataset"] == dataset
        assert f"data {dataset}, profile laptop" in sentence


# -------------------------------------------------------------------------- what a record was measured with

OTHER_A = "was measured with other weights of A (ab, now aa)"
REFERENCE = {"weights_digests": {"A": ["aa"], "real": ["cc"]}, "classifier_weights": "cc"}


@pytest.mark.parametrize(
    ("name", "record", "reason"),
    [
        ("walking", {"weights_digests": {"A": ["aa"], "real": [""]}}, ""),
        ("walking", {"weights_digests": {"B": ["bb"]}}, ""),
        ("walking", {"weights_digests": {"A": ["ab"]}}, OTHER_A),
        ("walking", {"weights_digests": {"A": ["aa", "ab"]}}, "was measured with other weights of A (aa, ab, now aa)"),
        ("walking", {}, "does not say which weights it was measured with"),
        ("one_step", {"weights_digests": {"A, distilled": ["aa"]}, "classifier_weights": "cc"}, ""),
        ("one_step", {"weights_digests": {"A, distilled": ["ab"]}}, OTHER_A),
        ("quality_by_seed", {"weights_digests": {"A": ["aa"]}, "classifier_weights": "cc"}, ""),
        ("convergence", {"classifier_weights": "cd"}, "was seen through another style classifier (cd, now cc)"),
        ("convergence", {}, "was seen through another style classifier (None, now cc)"),
        ("corruptions", {"classifier_weights": "cd"}, ""),  # about the distances, whichever classifier
        ("corruptions", {}, "does not say which style classifier it was seen through"),
        ("training_time", {}, ""),
    ],
)
def test_a_record_of_other_weights_or_another_classifier_is_stale(name, record, reason):
    assert records.stale_reason(name, record, REFERENCE) == reason
    if "does not say which style" not in reason:  # that is wrong beside any quality table
        assert records.stale_reason(name, record, {}) == ""


def test_a_stale_table_is_marked_for_notebooks(tmp_path, monkeypatch):
    monkeypatch.setattr(records, "repository_root", lambda: tmp_path)
    folder = tmp_path / "paper_figures/bandai/laptop/records"
    record, table = records.run_record(profile="laptop", dataset="bandai", seed=0), pd.DataFrame({"value": [1.0]})
    measured_with = lambda digest: record | {"weights_digests": {"A": [digest]}}
    records.write_table(folder / "quality.csv", table, measured_with("aa"))
    for digest, stale in (("aa", False), ("ab", True)):
        records.write_table(folder / "walking.csv", table, measured_with(digest))
        assert measured_table("bandai", "walking", "walking")[1].startswith("**Stale: ") is stale


RECORDS = sorted((repository_root() / "paper_figures").glob("*/*/records/*.csv"))
COMMITTED = [path for path in RECORDS if path.stem in records.ON_WEIGHTS | records.THROUGH_CLASSIFIER]


@pytest.fixture(scope="module")
def shipped_digests():
    weights = sorted(PRETRAINED_DIR.glob("*/*.safetensors"))
    return {(path.parent.name, path.stem): weights_digest(load_model(path).params) for path in weights}


STALE: set[str] = set()
"""Committed records of earlier weights or another classifier; each is marked where it is read."""


@pytest.mark.parametrize("path", COMMITTED, ids=lambda path: path.stem)
def test_committed_records_are_of_the_weights_that_ship_or_are_marked(path, shipped_digests):
    """Of the weights that ship, and seen through the classifier of the quality table."""
    _, record = records.read_table(path)
    assert bool(records.folder_reason(path, record)) == (path.stem in STALE)
    for model, digests in (record.get("weights_digests") or {}).items():
        if (record["dataset"], model) in shipped_digests:
            assert digests == [shipped_digests[record["dataset"], model]], model


def test_every_record_that_names_models_that_ship_is_held_to_their_weights(shipped_digests):
    named = {
        path.stem
        for path in RECORDS
        for model in records.read_table(path)[1].get("weights_digests") or {}
        if (path.parts[-4], model) in shipped_digests
    }
    assert {"quality", "trained", "feet", "input_use"} <= named and named <= records.ON_WEIGHTS
