"""`f3amd reproduce`: verdicts, and a rehearsal from a folder in HumanML3D's layout to the papers' tables."""

import pickle

import numpy as np
import pandas as pd
import pytest
from builders import refused
from safetensors.numpy import save_file
from test_humanml3d import positions
from test_released import acmdm_shapes, autoencoder_shapes, evaluator_shapes, motionlcm_shapes, random_arrays
from test_sources import CODES, zip_folder

from f3amd_companion.__main__ import main
from f3amd_companion.measuring import paper_tables
from f3amd_companion.measuring.paper_tables import beside_paper, check_real, verdict
from f3amd_lib.ground.records import read_table
from f3amd_lib.motion import bvh, synthetic
from f3amd_lib.networks import presets
from f3amd_lib.text.data import humanml3d, redundant

NAN = float("nan")


@pytest.mark.parametrize(
    ("paper", "ours", "wanted"),
    [
        ((0.793, 0.795, 0.797), (0.796, 0.798, 0.8), "within"),
        ((0.793, 0.795, 0.797), (0.7971, 0.798, 0.8), "higher"),
        ((0.793, 0.795, 0.797), (0.1, 0.2, 0.3), "lower"),
        ((NAN, 0.795, NAN), (0.79, 0.8, 0.81), "within"),
        ((0.793, 0.795, 0.797), (NAN, 0.9, NAN), "higher"),
        ((NAN, 0.795, NAN), (NAN, 0.795, NAN), "no interval"),
        ((0.793, 0.795, 0.797), (NAN, NAN, NAN), "not measured"),
        ((NAN, NAN, NAN), (0.1, 0.2, 0.3), "not printed"),
    ],
)
def test_a_cell_is_within_where_both_intervals_meet(paper, ours, wanted):
    assert verdict(paper, ours) == wanted


def test_real_motion_tells_whether_data_and_evaluator_are_right(caplog):
    """The printed figures are right; another evaluator's are not, nor is a data set of which nothing is printed."""
    rows = [("R_precision_3", 0.795, 0.002), ("matching_distance", 3.244, 0.005)]
    printed = pd.DataFrame([{"metric": m, "low": v - c, "value": v, "high": v + c} for m, v, c in rows])
    caplog.set_level("WARNING", logger="f3amd")
    assert check_real("acmdm", printed, printed) and not caplog.text
    other = printed.assign(**{bound: printed[bound] - [0.0, 0.27] for bound in ("low", "value", "high")})
    assert not check_real("acmdm", printed, other) and "off by more than its interval" in caplog.text
    assert not check_real("acmdm", printed[:0], printed)
    table = beside_paper(printed, other[1:], ["metric"])
    assert table["verdict"].tolist() == ["not measured", "lower"]


# ------------------------------------------------------------------------------------------ the rehearsal

WORDS = dict(a="DET", person="NOUN", walks="VERB", turns="VERB", slowly="ADV", left="ADV", jumps="VERB")


@pytest.fixture(scope="module")
def reader(tmp_path_factory):
    """What a reader would have: a made-up HumanML3D of 60 clips, and random weights under the released names."""
    folder, rng = tmp_path_factory.mktemp("reader"), np.random.default_rng(3)
    data, weights, evaluator = folder / "HumanML3D", folder / "weights", folder / "evaluator"
    for place in (data / "new_joints", data / "new_joint_vecs", data / "texts", weights, evaluator):
        place.mkdir(parents=True)
    skeleton, splits = humanml3d.layout_skeleton("humanml3d"), {"train": [], "val": [], "test": []}
    for number in range(60):
        name, frames = f"{number:06d}", int(rng.integers(40, 200))
        clip = positions(skeleton, frames + 1, number)
        vectors = redundant.redundant_from_positions(skeleton, clip)
        if number == 17:
            clip[3] = np.nan
        np.save(data / "new_joints" / f"{name}.npy", clip[:-1].astype(np.float32))
        np.save(data / "new_joint_vecs" / f"{name}.npy", vectors.astype(np.float32))
        said = rng.choice([*WORDS], 60 if number % 20 == 0 else 5)  # some captions are too long to be read whole
        line = f"{' '.join(said)}#{' '.join(f'{word}/{WORDS[word]}' for word in said)}"
        timed = f"{line.replace('#', ' slowly#')} slowly/ADV#0.5#2.9\n" if frames > 100 else ""
        (data / "texts" / f"{name}.txt").write_text(f"{line}#0.0#0.0\n{timed}", encoding="utf-8")
        splits[("test", "train", "test", "val")[number % 4]].append(name)
    for split, names in splits.items():
        (data / f"{split}.txt").write_text("\n".join(names), encoding="utf-8")
    released = {
        weights / "ACMDM-causal-AE": autoencoder_shapes(4),
        weights / "ACMDM-S-PS22": acmdm_shapes(2, head=4, text=256),
        weights / "ACMDM-S-PS22+control": acmdm_shapes(2, head=4, text=256, control=True),
        weights / "ACMDM-S-PS2-noisy-condition": acmdm_shapes(2, 2, head=4, text=256, noisy=True),
        weights / "MotionPCM-VAE": motionlcm_shapes(8, 12, 263, 3, 4, part="vae"),
        weights / "MotionPCM-teacher": motionlcm_shapes(8, 12, 263, 3, 4, 256, part="teacher"),
        weights / "MotionLCM-V2": motionlcm_shapes(8, 12, 263, 3, 4, 256, 10),
        evaluator / "evaluator": evaluator_shapes(259, 6, 5, 7, 9, 15, 4),
        evaluator / "acmdm-evaluator": evaluator_shapes(67, 6, 5, 7, 9, 15, 4),
    }
    for file, shapes in released.items():
        save_file(random_arrays(shapes), f"{file}.safetensors")
    numbers = {"22x3": ("mean", "std", 3), "AE_2D_Causal_Post": ("Mean", "Std", 4), "eval": ("mean", "std", 67)}
    for name, (*both, count) in numbers.items():
        for what in both:
            np.save((evaluator if name == "eval" else weights) / f"{name}_{what}.npy", rng.uniform(0.5, 2.0, count))
    for place, names in ((weights, ("Mean", "Std")), (evaluator, ("mean", "std"))):
        for name in names:
            np.save(place / f"{name}.npy", rng.uniform(0.5, 2.0, 263))
    known = ["sos", "eos", "unk", *WORDS]
    np.save(evaluator / "our_vab_data.npy", rng.normal(size=(len(known), 9)).astype(np.float32))
    (evaluator / "our_vab_idx.pkl").write_bytes(pickle.dumps({word: row for row, word in enumerate(known)}))
    return folder


def reproduce(reader, paper, table, *more):
    places = {"data": "HumanML3D", "evaluator": "evaluator", "weights": "weights", "out": paper}
    options = [word for option, place in places.items() for word in (f"--{option}", str(reader / place))]
    options += ["--table", table, "--text-encoder", "wordllama", "--repeats", "2" if table == "2" else "1"]
    return main(["reproduce", paper, *options, *more])


@pytest.mark.slow
@pytest.mark.wants("wordllama", "tokenizers")
@pytest.mark.parametrize(
    ("paper", "table", "record", "measured"),
    [
        ("acmdm", "2", "text_table2", {"ACMDM-S-PS22"}),
        ("acmdm", "A1", "text_tableA1", {"ACMDM-S-PS22"}),
        ("acmdm", "A2", "text_table3", {"ACMDM-S-PS22"}),
        ("acmdm", "A5", "text_tableA5", {"ACMDM-S-PS2-noisy-condition"}),
        ("motionpcm", "1", "text_pcm1", {"MotionLCM-V2"}),
        ("motionpcm", "3", "text_pcm3", {"MotionPCM-VAE"}),
        ("motionpcm", "4", "text_pcm4", {"MotionPCM-teacher"}),
    ],
)
def test_from_a_folder_to_the_papers_table(reader, paper, table, record, measured, cache_dir, caplog, monkeypatch):
    short = paper_tables.load_paper_file("experiments", "acmdm")["settings"]
    few = {"optimise_steps": 2, "optimised_clips": 2, "control_clips": 3, "samples": 4, "num_steps": 3}
    monkeypatch.setitem(short, "paper", short["paper"] | few)
    assert reproduce(reader, paper, table) == 0
    assert "off by more than its interval" in caplog.text  # of random weights
    folder = reader / paper / "humanml3d"
    beside, _ = read_table(folder / f"{record}_beside_paper.csv")
    ours = beside[beside["yours: value"].notna()]
    assert set(ours["model"]) - {"Real", "GT"} == measured
    assert set(ours["verdict"]) <= {"within", "higher", "lower", "no interval", "of a device", "not printed"}
    rows, _ = read_table(folder / f"{record}.csv")
    # What is measured is not measured again.
    with pytest.MonkeyPatch.context() as inner:
        inner.setattr("f3amd_companion.measuring.text_tables.KINDS", {})
        inner.setattr(paper_tables, "real_figures", None)
        assert reproduce(reader, paper, table) == 0
    pd.testing.assert_frame_equal(rows, read_table(folder / f"{record}.csv")[0])


@pytest.mark.slow
@pytest.mark.wants("wordllama", "tokenizers")
def test_crops_are_as_released_and_what_is_missing_is_said(reader, cache_dir, caplog):
    data = humanml3d.read_humanml3d(reader / "HumanML3D")
    test = data.select(data.members("test"))
    family = paper_tables.EVALUATORS["motionpcm"]
    judge, heard = paper_tables.evaluator_in(reader / "evaluator", family, reader / "HumanML3D", test, "humanml3d")
    bench = paper_tables.PaperBench(judge, None, test, {"repeats": 9, "group": 32}, 0, heard)
    shorter = []
    for one in bench.repeated():
        assert sorted(one.real.names) == sorted(test.names)
        shown = dict(zip(one.real.names, one.shown(), strict=True))
        wholes = np.split(test.redundant_vectors(), test.start[1:-1])
        for name, whole in zip(test.names, wholes, strict=True):
            length = len(shown[name])
            assert length % 4 == 0 and np.isin(length, len(whole) // 4 * 4 - np.array([0, 4]))
            begins = [k for k in range(len(whole) - length + 1) if np.array_equal(whole[k : k + length], shown[name])]
            assert begins
            shorter.append(length < len(whole) // 4 * 4)
    assert 0.25 < np.mean(shorter) < 0.42
    assert {name.partition("@")[0] for name in test.names} < {*test.names}  # timed captions are clips of their own
    refused("Table 4 needs SMPL-H meshes", lambda: reproduce_or_raise(reader, "4"))
    assert reproduce(reader, "acmdm", "2") == 0 and "no weights   ACMDM-XL-PS2.safetensors" in caplog.text


def reproduce_or_raise(reader, table):
    given = paper_tables.Sources(reader / "HumanML3D", reader / "evaluator")
    return paper_tables.reproduce_table("acmdm", table, given, out=reader / "other")


# ------------------------------------------------------------------------------------------ F3AMD's own


@pytest.mark.long
def test_from_an_archive_to_f3amds_tables(tmp_path, cache_dir, monkeypatch, caplog):
    """A made-up 100STYLE of the walker, networks of one narrow block."""
    build, styles, takes = presets.build_config, ("Neutral", "Old", "March"), ("FW", "BW", "SW", "TR1")
    monkeypatch.setattr(presets, "build_config", lambda *a, **k: build(*a, **{**k, "depth": 1, "latent_width": 8}))
    monkeypatch.setenv("F3AMD_RESULTS_DIR", str(tmp_path / "results"))
    top = tmp_path / "tree" / "100STYLE"
    cuts = [",".join(["STYLE_NAME", *(f"{code}_{end}" for code in CODES for end in ("START", "STOP"))])]
    for style in styles:
        (top / style).mkdir(parents=True)
        for seed, code in enumerate(takes):
            walk = synthetic.synthesize(style, seconds=8.0, seed=seed, fps=60.0)
            bvh.write_bvh(top / style / f"{style}_{code}.bvh", walk)
        cuts.append(",".join([style, *("1,480" if code in takes else "N/A,N/A" for code in CODES)]))
    (top / "Frame_Cuts.csv").write_text("\n".join(cuts) + "\n")
    rows = ["Style Name,Description,Stochastic,Symmetric,Notes", *(f"{style},walks,No,Yes," for style in styles)]
    (top / "Dataset_List.csv").write_text("\n".join(rows) + "\n")
    archive = zip_folder(tmp_path / "tree", tmp_path / "100STYLE.zip")
    asked = ["reproduce", "f3amd", "--data", str(archive), "--reading", "CAMDM-units", "--profile", "smoke"]
    asked += ["--windows", "32", "--batch-size", "4", "--out", str(tmp_path / "own")]
    assert main([*asked, "--minutes", "0"]) == 3  # says how long it would take, and stops
    assert caplog.text.count("hours here") == 2
    assert main(asked) == 0
    place = next((tmp_path / "results").rglob("records"))
    beside, _ = read_table(place / "reproduced_beside_paper.csv")
    measured = beside[beside["yours: value"].notna()]
    assert set(measured["model"]) == {"F3AMD-FNO-96", "CAMDM"} and {8, 4} <= set(measured["steps"])
    likeness, _ = read_table(place / "reproduced_likeness.csv")
    assert set(likeness["windows"]) == {3, 10, 32} and (likeness["distance"] >= 0).all()
