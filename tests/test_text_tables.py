"""Tables of text to motion, rehearsed at the smallest size: trained, measured, kept, and read by the ledger."""

import dataclasses
import time
import types

import jax
import numpy as np
import pytest
from builders import captioned_walks, refused
from test_text_models import ENCODER, PROFILE, TINY

from f3amd_companion.measuring import text_tables
from f3amd_companion.measuring.text_tables import UNCONTROLLED, Bench, measure_text_table, obtain_judge, planned
from f3amd_lib.ground.papers import load_paper_file
from f3amd_lib.ground.records import read_table
from f3amd_lib.ground.trees import weights_digest
from f3amd_lib.motion import synthetic
from f3amd_lib.networks import presets
from f3amd_lib.papers.printed import SCHEMAS
from f3amd_lib.text.judge.text_judge import load_judge
from f3amd_lib.text.stages.text_models import load_text_model
from f3amd_lib.training.pipeline import PRETRAINED_DIR

QUIET = {"progress": False}
FORMS = TINY | {"tiny-AE": dataclasses.replace(TINY["tiny-AE"], training={"window": 32})}  # clips have 40 frames
QUEUE, TEACHER = load_paper_file("experiments", "acmdm")["settings"]["queue"], "MotionPCM-teacher-small"
SHIPPED_JUDGE = PRETRAINED_DIR / "bandai" / "text" / "judge.safetensors"
PLAIN, PREFIX = {"model": "ACMDM-S-PS22", "trained": "tiny"}, {"model": "ACMDM-S-PS2-prefix", "trained": "tiny-prefix"}
SECTIONS = ("trained on pelvis", "trained on all joints", "noise optimisation", "upper-body edit", "without control")
ROWS = {
    "text_table1": [{"model": "ACMDM-S-PS22-raw", "trained": "tiny"}],
    "text_tableA1": [PLAIN | {"cfg": "yes"}, PLAIN | {"cfg": "no"}],
    "text_table3": [PLAIN | {"section": section} for section in SECTIONS],
    "text_table4": [{"model": "ACMDM-S-PS28", "trained": "tiny-mesh"}],
    "text_tableA5": [
        PREFIX | {"first_prefix": "generated", "first": "tiny"},
        PREFIX | {"first_prefix": "ground truth"},
    ],
}  # fmt: skip


@pytest.fixture(scope="module")
def data():
    return captioned_walks(synthetic.STYLES[:2], ("test", "test", "validation", "train"), num_frames=40)


@pytest.fixture(scope="module")
def tables(data, tmp_path_factory):
    """All tables, of tiny models; (folder of results, table -> rows)."""
    root = tmp_path_factory.mktemp("tables")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("F3AMD_CACHE_DIR", str(root / "cache"))
        patch.setenv("F3AMD_RESULTS_DIR", str(root / "results"))
        for name, preset in FORMS.items():
            patch.setitem(presets.PRESETS, name, preset)
        made = {}
        for name, rows in ROWS.items():
            path = measure_text_table(name, data, ENCODER, PROFILE, folder=root / "models", rows=rows, **QUIET)
            made[name] = read_table(path)[0]
            for beside in load_paper_file("experiments", "acmdm")[name].get("beside", ()):
                made[beside] = read_table(path.with_name(f"{beside}.csv"))[0]
            if name == "text_table1":
                # What is measured is not measured again, and a leg without time stops before the next row.
                before = path.read_bytes()
                with pytest.MonkeyPatch.context() as inner:
                    inner.setattr(text_tables, "KINDS", {})
                    again = measure_text_table(name, data, ENCODER, PROFILE, folder=root / "models", rows=rows, **QUIET)
                assert again == path and path.read_bytes() == before
        over = {"stop_at": time.monotonic() - 1.0, **QUIET}
        assert measure_text_table("text_table1", data, ENCODER, PROFILE, folder=root / "other", **over) is None
        yield made


def test_many_motions_are_drawn_in_parts_each_with_noise_of_its_own(monkeypatch):
    monkeypatch.setattr(text_tables, "_AT_ONCE", 2)
    asked, key = [], jax.random.key(0)
    draw = lambda rows, key: asked.append(len(rows)) or rows + jax.random.uniform(key)
    made = text_tables._drawn_in_parts(draw, key, np.zeros(5))
    assert asked == [2, 2, 2] and len(set(made.round(5).tolist())) == 3 and made[0] == draw(np.zeros(2), key)[0]


@pytest.mark.long
def test_every_table_has_the_columns_that_the_ledger_reads(tables):
    for name, table in tables.items():
        keys = list(SCHEMAS[name])
        assert set(keys) <= set(table) and not table.duplicated(keys).any()
        assert {"trained", "windows", "weights"} <= set(table)
        # 3 steps of the recipe's batch.
        assert set(table["windows"]) == {3 * 32}
        assert np.isfinite(table["value"]).all()
    assert "multimodality" in set(tables["text_table1"]["metric"])


@pytest.mark.long
def test_control_is_measured_by_joint_for_branch_and_optimised_noise(tables):
    table = tables["text_table3"].set_index(["section", "joint", "metric"])["value"]
    for section in ("trained on all joints", "noise optimisation"):
        errors = table[section].xs("control_average_error", level="metric")
        assert len(errors) == 1 + 6 and errors["average"] == pytest.approx(errors.drop("average").mean())
        assert table[section, "average", "sampling_seconds"] > 0
    assert "text_FID" in table["upper-body edit", "pelvis and feet"].index
    # A branch that knows the pelvis alone is asked about the pelvis alone.
    assert set(table["trained on pelvis"].index.get_level_values("joint")) == {"pelvis"}
    # Without control it is the same motions, whatever joint is compared with its places.
    free = tables["text_control"].query("section == @UNCONTROLLED and metric == 'text_FID'")
    assert len(free) == 5 * 7 and (free.groupby("frames")["value"].agg(np.ptp) < 1e-6).all()
    weights = tables["text_table3"].groupby("section")["weights"].first()
    assert weights[UNCONTROLLED] == weights["noise optimisation"]
    assert weights["trained on pelvis"] != weights["trained on all joints"] == weights["upper-body edit"]


@pytest.mark.long
def test_table_3_is_the_mean_over_numbers_of_frames(tables):
    each = tables["text_control"]
    assert list(each["frames"].unique()) == ["1", "2", "5", "25%", "100%"]
    keys = ["section", "joint", "metric"]
    means, table = each.groupby(keys)["value"].mean(), tables["text_table3"].set_index(keys)["value"]
    assert len(means) > 0 and table[means.index].to_numpy() == pytest.approx(means.to_numpy())


@pytest.mark.long
def test_meshes_are_judged_by_their_joints_and_their_surface(tables):
    table = tables["text_table4"].set_index("metric")["value"]
    assert table["LSD"] > 0 and {"text_FID", "foot_skating"} <= set(table.index)


@pytest.mark.long
def test_guidance_and_first_frames_arrive(tables):
    one, other = (part["value"].to_numpy() for _, part in tables["text_tableA1"].groupby("cfg"))
    assert not np.array_equal(one, other)  # three steps of training: the text hardly matters yet
    one, other = (part["value"].to_numpy() for _, part in tables["text_tableA5"].groupby("first_prefix"))
    assert not np.array_equal(one, other)


@pytest.mark.parametrize(("preset", "window"), [
    ("ACMDM-S-PS22-raw-n2", 80), ("ACMDM-S-PS22-n2", 80), ("ACMDM-n4-PS22-prefix", None),
    ("ACMDM-n4-PS22-noisy-condition", None),
])  # fmt: skip
def test_a_tables_settings_arrive_where_networks_are_trained(preset, window, data, tmp_path, monkeypatch):
    """States are as long as the clips but for prefixes and blocks; an autoencoder has its own recipe's batch."""
    asked, settings = [], {"most_frames": 80, "train_steps": 7, "batch_size": 3, "autoencoder_steps": 5}
    bench = types.SimpleNamespace(settings=settings, record=lambda *arguments: {"settings": settings})

    def train(data, encoder, profile, name, *, window, batch_size=None, **how):
        asked.append((name, window, profile.train_steps, batch_size))
        return None if name == preset else name

    monkeypatch.setenv("F3AMD_RESULTS_DIR", str(tmp_path))
    monkeypatch.setattr(text_tables, "bench_of", lambda *arguments, **how: bench)
    monkeypatch.setattr(text_tables, "train_stage", train)
    rows = [{"model": "ACMDM-S-PS22-raw", "trained": preset}]
    measure = lambda **how: measure_text_table("text_table1", data, ENCODER, PROFILE, rows=rows, **how, **QUIET)
    assert measure() is None and asked[-1] == (preset, window, 7, 3)
    assert asked[:-1] == ([] if "raw" in preset else [("ACMDM-causal-AE-w64", window, 5, None)])
    refused("unknown model of text_table1 'acmdm'", measure, models=["acmdm"])


def test_the_judge_that_ships_looks_at_the_data_that_it_knows_and_at_no_other(data, tmp_path, monkeypatch):
    shipped, trained = load_judge(SHIPPED_JUDGE), []
    monkeypatch.setattr(text_tables, "train_judge", lambda *asked, **how: trained.append(asked))
    its = types.SimpleNamespace(name="bandai", fingerprint=shipped.record["dataset_fingerprint"])
    reader = types.SimpleNamespace(identity=shipped.text_encoder)
    found = obtain_judge(its, reader, PROFILE, folder=tmp_path)
    assert weights_digest(found.params) == weights_digest(shipped.params) and not trained
    for other in ((data, reader), (its, ENCODER)):
        assert obtain_judge(*other, PROFILE, folder=tmp_path) is None  # trained, and out of time
    assert len(trained) == 2


def test_variety_is_that_of_one_captions_motions(data):
    """Captions that differ must not count as variety, and another draw must."""
    real = data.select(data.members("test"))
    judge = types.SimpleNamespace(embed_motions=lambda motions: np.stack([one[0, :2].ravel() for one in motions]))
    bench = Bench(judge, ENCODER, real, {"group": 2, "repeats": 1}, 0)

    def make(spread):
        def draw(pooled, lengths, key):
            told = np.asarray(pooled).sum(axis=1)[:, None, None, None]
            noise = jax.random.normal(key, (len(lengths), 1, 1, 3))
            return told + spread * np.asarray(noise) + np.zeros((1, max(lengths), real.skeleton.num_joints, 1))

        return bench.variety(draw)["value"].item()

    assert make(0.0) == 0.0
    assert make(2.0) == pytest.approx(2 * make(1.0), rel=1e-5) and make(1.0) > 0.1


def test_a_queue_trains_every_row_before_another_seed_and_only_compared_rows_with_several():
    rows, settings = [{"trained": "tiny"}, {"trained": "Real"}], {"lengths": [0.25, 0.5, 1.0, 2.0], "seeds": 3}
    each = lambda *seeds: [("tiny", seed, length) for seed in seeds for length in (0.5, 1.0)]
    for compared, seeds in ((False, (4,)), (True, (4, 5, 6))):
        told = [tuple(row.values()) for row in planned(rows, 4, settings, compared)]
        assert told == [("Real", 4, 0.0), *each(*seeds), ("tiny", 4, 0.25), ("tiny", 4, 2.0)]


def test_a_queue_trains_each_length_for_its_share_of_motions_on_what_it_stands_on(data, tmp_path, monkeypatch):
    stages = QUEUE["stages"]
    settings = {"most_frames": 80, "lengths": [0.5], "seeds": 1, "compared": [], "stages": stages}
    bench, asked = types.SimpleNamespace(settings=settings, record=lambda *arguments: {"settings": settings}), []

    def train(data, encoder, profile, name, *, folder, teacher=None, **how):
        asked.append((name, profile.train_steps, folder.name, teacher, how["learning_rate"]))
        return None if name == "ACMDM-S-PS22-n2" else name

    monkeypatch.setenv("F3AMD_RESULTS_DIR", str(tmp_path))
    monkeypatch.setattr(text_tables, "bench_of", lambda *arguments, **how: bench)
    monkeypatch.setattr(text_tables, "train_stage", train)
    rows, seed = [{"model": "ACMDM-S-PS22", "trained": "ACMDM-S-PS22-n2"}], PROFILE.seed
    assert measure_text_table("text_table1", data, ENCODER, PROFILE, rows=rows, plan="queue", **QUIET) is None
    steps = [stages[stage]["motions"] / stages[stage]["batch_size"] for stage in ("motion autoencoder", "ACMDM")]
    assert asked == [
        ("ACMDM-causal-AE-w64", steps[0], f"seed{seed}-1", None, 1e-3),
        ("ACMDM-S-PS22-n2", round(0.5 * steps[1]), f"seed{seed}-0.5", "ACMDM-causal-AE-w64", 1e-3),
    ]


def test_a_queue_stands_on_what_ships_and_takes_it_for_its_own_recipe_alone(data, tmp_path, monkeypatch):
    shipped = {name: load_text_model(SHIPPED_JUDGE.with_stem(name)) for name in (TEACHER, "MotionPCM-M1-small")}
    bench, asked = types.SimpleNamespace(settings=QUEUE, record=lambda *arguments: {"settings": {}}), []

    def train(data, encoder, profile, name, *, teacher=None, **how):
        asked.append((name, profile.seed, profile.train_steps, teacher.name))

    monkeypatch.setenv("F3AMD_RESULTS_DIR", str(tmp_path))
    monkeypatch.setattr(text_tables, "bench_of", lambda *arguments, **how: bench)
    monkeypatch.setattr(text_tables, "train_stage", train)
    monkeypatch.setattr(text_tables.text_models, "shipped_for", lambda name, *_: shipped.get(name))
    found, seen = [], lambda *arguments: found.append(arguments[5])
    monkeypatch.setattr(text_tables, "measure_rows", seen)
    profile = dataclasses.replace(PROFILE, name="laptop", seed=0)
    measure_text_table("text_pcm4", data, ENCODER, profile, plan="queue", **QUIET)
    for name, model in shipped.items():
        assert found[0](name, 0, 1.0) is model and not asked
        assert found[0](name, 1, 1.0) is found[0](name, 0, 0.5) is None
        assert [(*one[:2], one[3]) for one in asked] == [(name, 1, TEACHER), (name, 0, TEACHER)]
        assert asked[0][2] == pytest.approx(2 * asked[1][2], abs=2)
        asked.clear()
