"""The judge as a whole, on a small captioned data set of the walker: what it sees, refuses and keeps."""

import dataclasses
import functools
import zlib

import numpy as np
import pytest
from builders import refused

from f3amd_lib.measures.registry import SHOWN
from f3amd_lib.motion import synthetic
from f3amd_lib.motion.skeleton import resample, turn
from f3amd_lib.text.data.text_encoders import TextEmbeddings
from f3amd_lib.text.data.text_motions import text_motions
from f3amd_lib.text.judge import text_judge, text_metrics
from f3amd_lib.text.judge.text_judge import EvaluatorTraining
from f3amd_lib.text.stages import text_models
from f3amd_lib.training.pipeline import ModelFiles, alone_with

STYLES = synthetic.STYLES[:4]
SIZES = {"movement_width": 16, "motion_hidden": 16, "text_hidden": 16, "embedding_width": 8}


class OneVectorAWord:
    """Every word is a random vector of its own; no words are ones."""

    identity, width = "one vector a word", 8

    def __call__(self, captions) -> TextEmbeddings:
        words = [[zlib.crc32(word.encode()) for word in caption.split()] for caption in captions]
        if captions == [""]:
            return TextEmbeddings(np.ones((1, 1, 8), np.float32), np.ones((1, 1), bool), np.ones((1, 8), np.float32))
        tokens = np.zeros((len(captions), max(map(len, words)), 8), np.float32)
        mask = np.zeros(tokens.shape[:2], bool)
        for row, (told, kept) in enumerate(zip(words, mask, strict=True)):
            kept[: len(told)] = True
            tokens[row, kept] = [np.random.default_rng(seed).normal(size=8) for seed in told]
        return TextEmbeddings(tokens, mask, tokens.mean(axis=1))


@pytest.fixture(scope="module")
def data():
    clips = []
    for style in STYLES:
        for seed in range(6):
            motion = resample(synthetic.synthesize(style, seconds=2.0, seed=seed), 20.0).slice(0, 40)
            split = "test" if seed < 2 else "train"
            said = (f"a person walks {style}", f"someone goes {style}")
            clips.append((f"{style}_{seed}", turn(motion, float(seed)), said, split, style))
    return text_motions(clips, skeleton=motion.skeleton, name="walker", fps=20.0)


@pytest.fixture(scope="module")
def judge(data, tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("F3AMD_CACHE_DIR", str(tmp_path_factory.mktemp("cache")))
        training = EvaluatorTraining(num_steps=4, batch_size=8, num_frames=40)
        return text_judge.train_judge(data, OneVectorAWord(), training, progress=False, **SIZES)


def test_the_task_trains_on_training_clips_and_their_captions_alone(data, cache_dir):
    task, normaliser = text_judge.judge_task(data, OneVectorAWord(), EvaluatorTraining(num_steps=1), **SIZES)
    assert np.allclose(task.clips.frames.mean(axis=0), 0, atol=1e-3)
    assert np.ptp(normaliser.deviation[4:]) == 0 and task.clips.frames.shape[1] == 4 + 3 * 22
    assert len(task.clips.start) == len(data.members("train")) == 16
    assert len(task.captions.tokens) == 32 and len(np.unique(task.captions.pair)) == 4
    assert task.model_config.features == 70 and task.model_config.token_width == 8


def test_a_motion_is_embedded_alike_wherever_it_stands_and_in_any_batch(data, judge):
    clips = [data.clip(k).astype(np.float64) for k in (0, 7, 13)]
    together = judge.embed_motions(clips)
    moved = judge.embed_motions([turn(data.motion(7), 2.0).positions + [3.0, 0.2, -5.0]])
    assert np.allclose(moved, together[1], atol=1e-3)
    assert not np.allclose(together[0], together[1], atol=1e-2)


def test_a_judge_comes_back_from_its_file(judge, data, tmp_path):
    text_models.save_text_model(tmp_path / "judge.safetensors", judge, np.float32)
    again = text_judge.load_judge(tmp_path / "judge.safetensors")
    assert np.array_equal(again.embed_motions([data.clip(0)]), judge.embed_motions([data.clip(0)]))
    assert again.text_encoder == judge.text_encoder and again.skeleton == judge.skeleton
    assert again.record["dataset_fingerprint"] == data.fingerprint
    (tmp_path / "cut").write_bytes((tmp_path / "judge.safetensors").read_bytes()[:-50])
    refused("cut", text_judge.load_judge, tmp_path / "cut")


def test_two_processes_do_not_train_one_judge(data, tmp_path, cache_dir):
    files = ModelFiles.of(tmp_path, "judge")
    again = {"training": EvaluatorTraining(1), "files": files, "progress": False, **SIZES}
    with alone_with(files):
        refused("training judge", text_judge.train_judge, data, OneVectorAWord(), **again)
    assert text_judge.train_judge(data, OneVectorAWord(), **again) and files.model.exists()
    assert text_judge.train_judge(data, OneVectorAWord(), **again)  # read
    few = data.select(data.members("train"))
    refused("is a judge of other data", text_judge.train_judge, few, OneVectorAWord(), **again)


def test_a_table_has_real_motion_first_and_every_figure_with_its_interval(judge, data, cache_dir):
    real = text_judge.judged_clips(data)
    assert real.num_clips == 8 and set(real.splits) == {"test"}
    clips = [real.clip(k) for k in range(8)]
    told = [said[0] for said in real.captions]
    still = lambda repeat: ([np.repeat(clip[:1], 40, axis=0) for clip in clips], told)
    table = text_judge.judge_motions(judge, OneVectorAWord(), real, {"still": still}, repeats=3, group=4, bar=0.0)
    assert table["system"].unique().tolist() == ["real", "still"]
    assert set(table["metric"]) == {metric.name for metric in SHOWN["text"]} - {"multimodality"}
    assert (table["repeats"] == 3).all()
    value = table.set_index(["system", "metric"])["value"]
    assert value["real", "text_FID"] == pytest.approx(0, abs=1e-6) and value["still", "text_FID"] > 1e-3


def test_clips_that_share_no_pair_are_all_judged_in_random_groups(data):
    """HumanML3D says of no clip what it shows."""
    real = text_judge.judged_clips(dataclasses.replace(data, pairs=data.names))
    assert real.names == tuple(np.array(data.names)[data.members("test")])
    groups = [text_metrics.groups_of_unlike_pairs(real.pairs, np.random.default_rng(seed), 3) for seed in range(2)]
    assert all(one.shape == (2, 3) and len(np.unique(one)) == 6 for one in groups)
    assert not np.array_equal(*groups)
    twin = dataclasses.replace(data, pairs=("a clip and its mirror image",) * 2 + data.names[2:])
    assert text_judge.judged_clips(twin).names == real.names


def test_texts_are_ranked_among_those_of_other_pairs_alone(data):
    """Two captions of one pair tell the same: neither is wrong for the other's motion, and they are in no group."""
    real = text_judge.judged_clips(data)
    assert real.pairs == tuple(np.array(data.pairs)[data.members("test")]) and len(set(real.pairs)) == 4
    embedded = np.random.default_rng(0).normal(size=(len(real.pairs), 8))
    figures = lambda group: text_judge.text_figures(
        embedded, embedded, embedded, real.pairs, np.random.default_rng(0), group
    )
    assert figures(4)["R_precision_1"] == 1.0
    refused("groups of 5 need as many pairs of content and style, got 4", figures, 5)


def test_what_cannot_be_judged_is_refused(judge, data, cache_dir):
    real = text_judge.judged_clips(data)
    other = OneVectorAWord()
    other.identity = "another"
    judged = functools.partial(text_judge.judge_motions, judge, OneVectorAWord(), real, repeats=1, group=4)
    refused("under 1.1: this judge is too weak; train it longer", judged, {}, bar=1.1)
    refused("reads captions of one vector a word", text_judge.judge_motions, judge, other, real, {}, repeats=1, bar=0.0)
    short = {"short": lambda repeat: ([real.clip(0)], ["a walk"])}
    refused("short: 1 motions, 1 captions for 8 clips", judged, short, bar=0.0)
    refused("a motion has 3 frames; the judge needs 4", judge.embed_motions, [real.clip(0)[:3]])
    refused(r"positions must be \[frame, 23, 3\]", judge.embed_motions, [real.clip(0)[:, 1:]])
