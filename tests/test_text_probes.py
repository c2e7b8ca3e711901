"""What the judge is asked about, and hands that are counted: real motion passes, motion wrong on purpose does not."""

import dataclasses
import types

import numpy as np
import pytest
from builders import refused
from test_text_judge import OneVectorAWord

from f3amd_companion.measuring import text_tables
from f3amd_companion.measuring.text_tables import counted_hands, measure_hands, mirrored_positions, probes_of
from f3amd_lib.ground.profiles import load_profile
from f3amd_lib.ground.records import read_table
from f3amd_lib.motion import synthetic
from f3amd_lib.motion.skeleton import Motion, resample
from f3amd_lib.text.data.text_motions import text_motions
from f3amd_lib.text.judge.text_metrics import raised_hands

PROFILE = load_profile("smoke", "bandai")


def gesture(hands: tuple[str, ...], seed: int = 0, frames: int = 40) -> Motion:
    """A walk of the walker in which some wrists are held 10 cm over the head for half of the time."""
    motion = resample(synthetic.synthesize("Neutral", seconds=2.5, seed=seed), 20.0).slice(0, frames)
    positions, skeleton = np.array(motion.positions), dataclasses.replace(motion.skeleton, end_sites=())
    for hand in hands:
        over_the_head = positions[frames // 2 :, skeleton.role("head")] + [0, 0.1, 0]
        positions[frames // 2 :, skeleton.role(f"{hand}_wrist")] = over_the_head
    return Motion.from_positions(skeleton, positions, 20.0)


@pytest.fixture(scope="module")
def data():
    clips = []
    for content in ("raise-up-left-hand", "raise-up-right-hand", "wave-left-hand", "wave-right-hand", "walk"):
        hands = tuple(side for side in ("left", "right") if side in content)
        for seed in range(4):
            said = tuple(f"{content} {word}" for word in ("once", "twice", "again"))
            split = "test" if seed < 2 else "train"
            clips.append((f"{content}_{seed}", gesture(hands, seed), said, split, f"{content}, normal"))
    return text_motions(clips, skeleton=gesture(()).skeleton, name="bandai", fps=20.0)


@pytest.mark.parametrize("hands", [(), ("left",), ("right",), ("left", "right")])
def test_raised_hands_are_seen_and_others_are_not(hands):
    motion = gesture(hands)
    assert raised_hands(motion.skeleton, motion.positions).tolist() == ["left" in hands, "right" in hands]
    mirrored = mirrored_positions(motion.skeleton, motion.positions)
    assert raised_hands(motion.skeleton, mirrored).tolist() == ["right" in hands, "left" in hands]


def test_hands_are_counted_by_what_was_asked():
    motions = [gesture(hands).positions for hands in (("left",), ("left",), ("right",), ("left", "right"), ())]
    counted = counted_hands(gesture(()).skeleton, motions, "left")
    assert counted == {"motions": 5, "asked_hand": 2, "other_hand": 1, "both_hands": 1, "no_hand": 1}
    assert counted_hands(gesture(()).skeleton, motions, "right")["asked_hand"] == 1


def test_each_probe_is_wrong_in_the_way_it_says(data):
    real, others = (data.select(data.members(split)) for split in ("test", "train"))
    probes = probes_of(real, others, seed=0)
    clips = [real.clip(k) for k in range(real.num_clips)]
    for name, system in probes.items():
        motions, told = system(0)
        assert len(motions) == len(told) == real.num_clips
        if name != "captions of other clips":
            # The caption is one of the clip's pair, and the motion as long as its own.
            assert all(caption.split()[0] == pair.split(",")[0] for caption, pair in zip(told, real.pairs, strict=True))
            assert [motion.shape for motion in motions] == [clip.shape for clip in clips]
        again = system(0)
        assert told == again[1] and all(np.array_equal(*pair) for pair in zip(motions, again[0], strict=True))
        assert list(told) != list(system(1)[1])
    alone = dataclasses.replace(real, pairs=tuple(real.names))  # as HumanML3D's, which share none
    assert sorted({*probes} - {*probes_of(alone, others, seed=0)}) == ["other real clips"]
    refused("none of the contents of bandai", measure_hands, alone, OneVectorAWord(), PROFILE)
    shown = {name: system(0)[0] for name, system in probes.items()}
    trains = [others.clip(k) for k in range(others.num_clips)]
    assert all(any(np.array_equal(motion, clip) for clip in trains) for motion in shown["other real clips"])
    assert sorted(probes["captions of other clips"](0)[1]) == sorted(probes["frozen"](0)[1])
    assert probes["captions of other clips"](0)[1] != probes["frozen"](0)[1]
    up = lambda motions: raised_hands(real.skeleton, np.stack(motions))
    assert np.array_equal(up(shown["left and right exchanged"]), up(clips)[:, ::-1]) and up(clips).any()
    assert all(np.ptp(motion, axis=0).max() == 0 for motion in shown["frozen"])
    assert np.array_equal(shown["backwards in time"][3][::-1], clips[3])
    off = np.std(np.stack(shown["trembling"]) - np.stack(clips))
    assert off == pytest.approx(text_tables.TREMBLE, rel=0.05)


def test_hands_of_clips_and_of_models_are_kept_in_one_table(data, cache_dir, monkeypatch, tmp_path):
    """An oracle that raises what the caption says, and one that always raises the left hand."""
    monkeypatch.setenv("F3AMD_RESULTS_DIR", str(tmp_path))
    told = {}

    def captioned_motions(trained, pooled, num_frames, key, **how):
        hands = ("left",) if trained.name == "always left" else (told["side"],)
        return np.stack([gesture(hands, frames=40).positions] * len(pooled))

    def embedded(captions, encoder):
        told["side"] = "left" if " left " in captions[0] else "right"
        return OneVectorAWord()(captions)

    monkeypatch.setattr(text_tables, "draw_motions", captioned_motions)
    monkeypatch.setattr(text_tables, "embed_captions", embedded)
    monkeypatch.setattr(text_tables.text_models, "find_text_model", lambda data, name: name)
    about = {"skeleton": data.skeleton, "schedule": types.SimpleNamespace(kind="straight"), "params": [np.ones(2)]}
    model = lambda name: types.SimpleNamespace(name=name, **about)
    monkeypatch.setattr(text_tables.text_models, "load_text_model", model)
    table, record = read_table(measure_hands(data, OneVectorAWord(), PROFILE, models=["as told", "always left"]))
    counts = table.groupby("model")[["motions", "asked_hand", "other_hand"]].sum()
    assert counts.loc["real clips"].tolist() == [8, 8, 0] and counts.loc["mirrored clips"].tolist() == [8, 0, 8]
    assert counts.loc["as told"].tolist() == [24, 24, 0] and counts.loc["always left"].tolist() == [24, 12, 12]
    of_model = table[table["model"] == "as told"]
    assert of_model.groupby("wording")["caption"].nunique().to_dict() == {"held out": 4, "training": 8}
    assert record["measurement"] == "hands" and record["raised_from"] < 0
