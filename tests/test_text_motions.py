"""Captioned motions: what captions say and show, splits without leaks, batches with lengths and masks."""

import dataclasses
import re
import tomllib
from importlib import resources

import jax
import numpy as np
import pytest
from builders import packed_from, refused, stiff_walk

from f3amd_lib.data.packed import pack
from f3amd_lib.data.sources import open_dataset
from f3amd_lib.drawing.pictures import film_strip
from f3amd_lib.motion.rotations import matrix_from_yaw
from f3amd_lib.motion.skeleton import Motion, Skeleton, turn
from f3amd_lib.text.data import text_motions
from f3amd_lib.text.data.text_motions import AxisNormaliser, TextMotions, clip_table, draw_clips

WORDS = tomllib.loads((resources.files("f3amd_lib.text.data") / "captions.toml").read_text(encoding="utf-8"))
SKELETON = Skeleton(
    ("Hips", "LeftHip", "RightHip", "LeftWrist", "RightWrist", "Head"),
    (-1, 0, 0, 0, 0, 0),
    [[0, 0, 0], [0.1, 0, 0], [-0.1, 0, 0], [0.4, 0, 0], [-0.4, 0, 0], [0, 0.6, 0]],
)


def moving(speed=0.0, left=0.0, right=0.0, turned=0.0, frames=40) -> Motion:
    """A figure that moves ahead, with its wrists so far above the head joint, turning left by an angle."""
    pose = np.cumsum([[0, 1.0, 0]], axis=0) + SKELETON.offsets
    pose[[3, 4], 1] = 1.6 + np.array([left, right])
    yaw = np.linspace(0, turned, frames)
    rotated = np.stack([turn(Motion.from_positions(SKELETON, pose[None]), angle).positions[0] for angle in yaw])
    ahead = (speed / 20 * np.arange(frames))[:, None, None] * [0, 0, 1.0]
    return Motion.from_positions(SKELETON, rotated + ahead, 20.0)


# --------------------------------------------------------------------------------------- captions


@pytest.mark.parametrize(
    "kind, motion, words",
    [
        ("walk", moving(0.5), " slowly"),
        ("walk", moving(1.0), ""),
        ("walk", moving(1.6), " at a quick pace"),
        ("run", moving(1.6), " slowly"),
        ("run", moving(3.2), " fast"),
        ("left hand", moving(left=0.3, right=-0.8), " above the head"),
        ("right hand", moving(left=0.3, right=0.05), " as high as the head"),
        ("hands", moving(left=0.3, right=-0.15), " as high as the shoulders"),
    ],
)
def test_a_detail_is_what_the_clip_shows(kind, motion, words):
    assert text_motions.measured_detail(kind, motion) == words


def test_a_turn_is_told_by_the_motion_and_not_by_the_name():
    assert text_motions.shown_content("walk-turn-left", moving(1.0, turned=1.5)) == "walk-turn-left"
    assert text_motions.shown_content("walk-turn-left", moving(1.0, turned=-1.5)) == "walk-turn-right"
    assert text_motions.shown_content("walk-left", moving(1.0, turned=-1.5)) == "walk-left"


def test_captions_are_the_same_each_time_and_none_twice():
    first = text_motions.compose_captions("a", "raise-up-left-hand", "elderly", moving(left=0.3))
    assert first == text_motions.compose_captions("a", "raise-up-left-hand", "elderly", moving(left=0.3))
    assert len(set(first)) == 4 and all(re.search("left (hand|arm)", caption) for caption in first)
    assert all(re.search("elderly|old", caption) for caption in first)
    assert first != text_motions.compose_captions("b", "raise-up-left-hand", "elderly", moving(left=0.3))


@pytest.mark.parametrize("content", WORDS["content"])
def test_held_out_wordings_are_held_out(content):
    trained = text_motions.compose_captions("a", content, "chimpira", moving(1.0, left=0.3, right=0.3), count=99)
    assert list(text_motions.caption_wordings(content, held_out=True)) == WORDS["content"][content]["held_out"]
    assert all(any(text in caption for caption in trained) for text in WORDS["content"][content]["action"])
    assert not any(text in caption for caption in trained for text in WORDS["content"][content]["held_out"])


def test_every_style_and_content_has_words_for_both_sides():
    for style in WORDS["style"].values():
        for words in (style, style["held_out"]):
            assert len(words["subject"]) == len(words["manner"]) >= 1
    for content, words in WORDS["content"].items():
        assert text_motions.other_side(content) in WORDS["content"]
        sides = {side for side in ("left", "right") if re.search(rf"\b{side}\b", content)}
        for text in words["action"] + words["held_out"]:
            told = set(re.findall(r"\b(left|right)\b", text))
            assert told == sides or content in ("bye", "guide", "respond"), text


def test_left_and_right_change_places():
    assert text_motions.other_side("turns left, then right; leftover") == "turns right, then left; leftover"
    assert text_motions.plain_style("1-old") == text_motions.plain_style("2-elderly") == "elderly"


def test_what_has_no_words_is_refused():
    with pytest.raises(ValueError, match="no words for content 'wlak' in captions.toml; did you mean 'walk'"):
        text_motions.compose_captions("a", "wlak", "normal", moving())
    refused("no words for style '2-normal'", text_motions.compose_captions, "a", "walk", "2-normal", moving())


# ------------------------------------------------------------------------------------------ clips


def data(lengths=(24, 40, 60), splits=("train", "train", "test")) -> TextMotions:
    """Clips whose every number tells the clip and the frame."""
    motions = [np.arange(length)[:, None, None] * 0.01 + k + SKELETON.offsets[None] for k, length in enumerate(lengths)]
    told = {"captions": (("one",), ("two", "zwei"), ("three", "drei", "tre")), "pairs": ("p", "q", "q")}
    about = {"name": "toy", "skeleton": SKELETON, "fps": 20.0, "names": tuple("abc"), "splits": splits, **told}
    positions = np.concatenate(motions).astype(np.float32)
    return TextMotions(positions=positions, start=np.cumsum([0, *lengths]), **about)


def test_clips_are_chosen_with_all_that_is_theirs():
    toy = data()
    chosen = toy.select([2, 0])
    assert chosen.names == ("c", "a") and chosen.captions[0] == ("three", "drei", "tre")
    assert np.array_equal(chosen.clip(0), toy.clip(2)) and np.array_equal(chosen.clip(1), toy.clip(0))
    assert chosen.fingerprint != toy.fingerprint == data().fingerprint
    assert toy.members("test").tolist() == [2]
    refused("unknown split 'tets'; did you mean 'test'", toy.members, "tets")
    refused("no clip in its validation split", toy.members, "validation")


def test_cut_clips_keep_their_first_frames_and_all_that_is_theirs():
    toy = data()
    cut = toy.cut(40)
    assert cut.lengths.tolist() == [24, 40, 40] and cut.names == toy.names and cut.captions == toy.captions
    for number in range(3):
        assert np.array_equal(cut.clip(number), toy.clip(number)[:40])
    assert cut.fingerprint != toy.fingerprint == toy.cut(60).fingerprint
    for frames in (20, 42):
        refused(f"a multiple of 4 from 24 on, got {frames}", toy.cut, frames)


def test_normalisation_is_by_axis_and_of_training_clips():
    toy = data()
    train = np.concatenate([toy.clip(0), toy.clip(1)])
    normaliser = toy.normaliser()
    assert np.allclose(normaliser.mean, train.mean(axis=(0, 1)), atol=1e-5) and normaliser.mean.shape == (3,)
    assert np.allclose(normaliser.normalise(train).std(axis=(0, 1)), 1, atol=1e-4)
    assert np.allclose(normaliser.restore(normaliser.normalise(train)), train, atol=1e-5)
    # Shifting every joint by one vector shifts the normalised ones by that vector over the deviation.
    shift = np.array([1.0, 2.0, 3.0])
    moved = normaliser.normalise(train + shift) - normaliser.normalise(train)
    assert np.allclose(moved, shift / normaliser.deviation, atol=1e-4)
    assert np.all(np.isfinite(AxisNormaliser.of(np.ones((5, 3))).normalise(np.ones(3))))  # no zero divides


def test_drawn_clips_are_whole_pieces_of_clips_with_their_own_captions():
    toy = data()
    table, texts = clip_table(toy, toy.positions)
    assert texts == ["one", "two", "zwei", "three", "drei", "tre"]
    batch = jax.jit(draw_clips, static_argnums=(2, 3))(jax.random.key(0), table, 600, 48)
    motion, length, caption = (np.asarray(part) for part in (batch.motion, batch.length, batch.caption))
    clip = np.round(motion[:, 0, 0, 0] - 0.3).astype(int).clip(0, 2)
    assert set(clip) == {0, 1, 2} and set(caption) == set(range(6))
    owner = np.array([0, 1, 1, 2, 2, 2])
    assert np.array_equal(owner[caption], clip)
    for row in range(0, 600, 7):
        piece = motion[row, : length[row]]
        first = int(round((piece[0, 0, 0] - clip[row]) / 0.01))
        assert np.array_equal(piece, toy.clip(clip[row])[first : first + length[row]])
        assert np.all(motion[row, length[row] :] == 0) and np.all(batch.mask[row] == (np.arange(48) < length[row]))
    assert set(length[clip == 1]) == {36, 40} and set(length[clip == 2]) == {44, 48}
    assert np.mean(length[clip == 1] == 36) == pytest.approx(1 / 3, abs=0.1)
    starts = np.round((motion[clip == 2, 0, 0, 0] - 2) / 0.01).astype(int)
    assert starts.min() == 0 and starts.max() >= 12  # anywhere that it fits


@pytest.mark.parametrize("turned", [1.0, -1.0])  # named left; the second one turns right for all its name
def test_a_twins_captions_and_pair_are_of_the_other_side(turned):
    walk, yaw = stiff_walk(0.04), matrix_from_yaw(np.linspace(0.3, 0.3 + 2.0 * turned, 60))
    rotations = np.concatenate([yaw[:, None], walk.rotations[:, 1:]], axis=1)
    packed = packed_from([(walk.replace(rotations=rotations), 0, 0)], styles=("1-normal",))
    packed = dataclasses.replace(packed, name="bandai", clip_contents=("walk-turn-left",))
    made = text_motions.bandai_text_motions(packed)
    sides = ("left", "right") if turned > 0 else ("right", "left")
    for captions, pair, side, other in zip(made.captions, made.pairs, sides, sides[::-1], strict=True):
        assert pair == f"walk-turn-{side}, normal"
        assert any(side in told for told in captions) and not any(other in told for told in captions)
    # What is shown turns there, too.
    assert [np.sign(np.diff(np.unwrap(made.motion(clip).yaw)).mean()) for clip in range(2)] == [turned, -turned]


# ----------------------------------------------------------------------------------------- Bandai


@pytest.fixture(scope="module")
def some_bandai(bandai_archive):
    """Three dozen clips of the real set, every content among them."""
    whole = open_dataset("bandai", path=bandai_archive, locomotion_only=False)
    by_content = {}
    for clip in whole.clips:
        by_content.setdefault(clip.content, []).append(clip)
    wrong = [clip for clip in whole.clips if clip.name == "dataset-2_walk-turn-left_masculine_006"]
    chosen = wrong + [clip for clips in by_content.values() for clip in clips[:2] if clip.content != "dance-short"]
    return pack(dataclasses.replace(whole, clips=tuple(chosen)), progress=False)


@pytest.fixture(scope="module")
def made(some_bandai):
    return text_motions.bandai_text_motions(some_bandai)


def test_bandai_clips_say_what_they_show(some_bandai, made):
    assert made.fps == 20.0 and made.num_clips == 2 * some_bandai.num_clips
    assert made.lengths.max() <= 199 and np.all(made.lengths % 4 == 0)
    assert np.allclose(made.positions[made.start[:-1], 0, ::2], 0, atol=1e-6)
    assert film_strip(made.motion(0)) is not None  # positions alone can be drawn
    for number, several in enumerate(made.captions):
        motion = made.motion(number)
        yaw = np.degrees(np.unwrap(motion.yaw))
        side = {-1: "right", 1: "left"}[int(np.sign(yaw[-1] - yaw[0]))]
        hips = motion.positions[:, 0, 1]
        way = motion.positions[-1, 0] - motion.positions[0, 0]
        for caption in several:
            if "diagonally" in caption or "ahead and to" in caption:
                beside = way[0] if "left" in caption else -way[0]
                assert 0.2 * way[2] < beside < 2.0 * way[2], (made.names[number], caption)
            if "backwards" in caption:
                assert way[2] < -1.0
            if "turn" in caption:
                assert side in caption and abs(yaw[-1] - yaw[0]) > 45, (made.names[number], caption)
            for hand in ("left", "right"):
                if re.search(rf"(raises|lifts|waves|waves with) the {hand} (hand|arm)\b(?!.*answer)", caption):
                    wrists = [motion.positions[:, made.skeleton.role(f"{s}_wrist"), 1] for s in ("left", "right")]
                    own, other = wrists if hand == "left" else wrists[::-1]
                    assert own.max() > other.max() + 0.2 and own.max() > hips.max() + 0.3, caption
    # This clip's name says left, and it turns right.
    assert made.pairs[made.names.index("dataset-2_walk-turn-left_masculine_006")] == "walk-turn-right, masculine"


def test_bandai_twins_share_their_split_and_swap_their_sides(made):
    place = {name: number for number, name in enumerate(made.names)}
    for name, number in place.items():
        if not name.startswith("M"):
            twin = place[f"M{name}"]
            assert made.splits[twin] == made.splits[number] and made.lengths[twin] == made.lengths[number]
            assert made.captions[twin] == tuple(map(text_motions.other_side, made.captions[number]))
            assert np.allclose(made.clip(twin)[..., 0].mean(), -made.clip(number)[..., 0].mean(), atol=0.02)


def test_captions_are_for_bandai(some_bandai):
    with pytest.raises(ValueError, match="composed for data set 'bandai', not for 'folder'"):
        text_motions.bandai_text_motions(dataclasses.replace(some_bandai, name="folder"))
