"""Tables of MotionPCM, rehearsed at the smallest size: trained, measured, and read by the ledger."""

import dataclasses

import numpy as np
import pytest
from builders import captioned_walks, load_commands
from test_latent_models import TINY
from test_text_judge import OneVectorAWord

from f3amd_companion.measuring import text_tables
from f3amd_companion.measuring.text_tables import TABLES, measure_text_table, reconstruction_rows
from f3amd_lib.ground.papers import load_paper_file
from f3amd_lib.ground.profiles import load_profile
from f3amd_lib.ground.records import read_table
from f3amd_lib.motion import synthetic
from f3amd_lib.networks import presets
from f3amd_lib.papers.printed import SCHEMAS
from f3amd_lib.text.sampling.motionpcm_sampling import TEACHER_GUIDANCE
from f3amd_lib.text.stages.text_models import is_latent_preset
from f3amd_lib.text.stages.train_stage import stage_of

PROFILE = load_profile("smoke", "bandai", train_steps=20)
TEACHER = {"model": "MotionPCM-teacher", "trained": "tiny-teacher"}
STUDENT = {"model": "MotionPCM-M2", "trained": "tiny-M2"}
REAL = {"dataset": "bandai", "model": "Real", "trained": "Real", "steps": 0}
ROWS = {
    "text_pcm1": [REAL, {"dataset": "bandai", **STUDENT, "steps": 2}],
    "text_pcm3": [{"model": "MotionPCM-VAE", "trained": "tiny-VAE"}],
    "text_pcm4": [{**TEACHER, "steps": 3}, {**TEACHER, "steps": 1}],
    "text_guidance": [{**TEACHER, "steps": 3, "guidance": w} for w in (1.0, TEACHER_GUIDANCE)],
}


@pytest.fixture(scope="module")
def data():
    return captioned_walks(synthetic.STYLES[:2], ("test", "test", "validation", "train"), num_frames=40)


@pytest.fixture(scope="module")
def tables(data, tmp_path_factory):
    root = tmp_path_factory.mktemp("tables")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("F3AMD_CACHE_DIR", str(root / "cache"))
        patch.setenv("F3AMD_RESULTS_DIR", str(root / "results"))
        for name, preset in TINY.items():
            training = {**preset.training, "num_frames": 40}
            patch.setitem(presets.PRESETS, name, dataclasses.replace(preset, training=training))
        about = {"folder": root / "models", "progress": False}
        made = lambda name: measure_text_table(name, data, OneVectorAWord(), PROFILE, rows=ROWS[name], **about)
        yield {name: read_table(made(name))[0] for name in ROWS}


@pytest.mark.long
def test_rows_have_the_ledgers_columns_steps_arrive_and_real_motion_is_real(tables):
    for name, table in tables.items():
        keys = SCHEMAS[name]
        assert {*keys, "trained", "windows", "weights"} <= set(table)
        assert not table.duplicated(keys).any() and np.isfinite(table["value"]).all()
    first = tables["text_pcm1"].set_index(["model", "metric"])["value"]
    assert first["Real", "text_FID"] == pytest.approx(0.0, abs=1e-6)
    assert first["MotionPCM-M2", "text_FID"] > 1e-3
    assert first["MotionPCM-M2", "sampling_seconds"] > 0.0 and ("Real", "sampling_seconds") not in first
    kept = tables["text_pcm4"]["metric"] == "kept_movement"
    assert tables["text_pcm4"][kept]["value"].between(0, 1).all() and kept.sum() == 2
    one, three = (tables["text_pcm4"][~kept].query(f"steps == {steps}")["value"].to_numpy() for steps in (1, 3))
    assert not np.array_equal(one, three)
    none, usual = (part["value"].to_numpy() for _, part in tables["text_guidance"].groupby("guidance"))
    assert np.array_equal(usual, three) and not np.array_equal(none, three)
    assert {"reconstruction_error", "feature_error", "text_FID"} <= set(tables["text_pcm3"]["metric"])


def test_reconstruction_is_judged_both_ways(data, monkeypatch):
    """An autoencoder that gives clips back has no error; one that gives the first clip for all has."""
    vectors = data.redundant_vectors()
    deviation = np.maximum(vectors.std(axis=0), 1e-3)
    statistics, coder = type("S", (), {"deviation": deviation}), type("A", (), {"released_facing": True})
    trained = type("Trained", (), {"statistics": statistics, "autoencoder": coder})
    bench = type("Bench", (), {"real": data, "quality": lambda self, make: text_tables.pd.DataFrame()})()

    def figures(positions_of, vectors_of):
        made = lambda trained, given, mask: (vectors_of(given), positions_of(given))
        monkeypatch.setattr(text_tables.motionpcm_sampling, "reconstruction", made)
        return reconstruction_rows(bench, trained, {}, {}, None).set_index("metric")["value"]

    true = np.stack([data.clip(number) for number in range(data.num_clips)])
    right = figures(lambda given: true[: len(given)], np.asarray)
    assert right["reconstruction_error"] == 0.0 and right["feature_error"] == 0.0
    assert right["kept_movement"] == pytest.approx(1.0)
    still = figures(lambda given: true[: len(given)], lambda given: np.asarray(given)[:, :1].repeat(given.shape[1], 1))
    assert still["kept_movement"] == pytest.approx(0.0, abs=1e-6)
    wrong = figures(lambda given: np.repeat(true[:1], len(given), 0), lambda given: np.asarray(given)[:1].repeat(12, 0))
    assert wrong["reconstruction_error"] > 10.0 and wrong["feature_error"] > 0.1


def test_the_files_rows_name_presets_columns_and_commands():
    about = load_paper_file("experiments", "motionpcm")
    assert set(about) <= set(TABLES)
    typed = " ".join(run for runs in load_commands("motionpcm").values() for run in runs)
    for name, table in about.items():
        assert f"f3amd measure {name} " in typed or name in ("text_pcm3", "text_guidance")  # of no claim
        for row in table["rows"]:
            assert {*row} - {"trained"} == set(SCHEMAS[name]) - {"metric"}
            if row["model"] == "Real":
                continue
            model, trained = presets.find_preset(row["model"]), presets.find_preset(row["trained"])
            assert model.name == row["model"] and is_latent_preset(trained.name)
            assert stage_of(model.name) == stage_of(trained.name) and model.training == trained.training
