"""Motions with captions: positions of any number of joints, lengths, masks, what is drawn for a batch.

All that trains or judges a text-to-motion model takes its pairs from a `TextMotions`: Bandai's clips
with composed captions (`bandai_text_motions`), or a folder in HumanML3D's layout (`text.data.humanml3d`).
Motions start at the origin, facing +Z, and are as long as they are; a batch is padded.
"""

from __future__ import annotations

import dataclasses
import hashlib
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from f3amd_lib.data.packed import PackedMotion
from f3amd_lib.data.sources import SPLITS, assign_splits
from f3amd_lib.ground.files import read_toml
from f3amd_lib.ground.names import check_known, nearest_hint
from f3amd_lib.motion.skeleton import Motion, Skeleton, mirror, resample
from f3amd_lib.text.data import redundant

FPS = 20.0
"""Frames per second of text-to-motion data (HumanML3D)."""

FEWEST_FRAMES, MOST_FRAMES = 24, 199
"""Shortest and longest motion: KIT-ML's lower limit, since many clips are short; HumanML3D's upper one."""

UNIT = 4
"""Lengths are multiples of so many frames: what one latent frame of ACMDM and one step of the judge sees."""

HELD_OUT_PERCENT = (5, 15)
"""Of each pair's clips: validation and test."""


class AxisNormaliser(NamedTuple):
    """Mean and deviation of each number along the last axis: of x, y and z for positions.

    Three numbers for all joints, so that the same normalised number means the same place for each.

    Source: ACMDM, Appendix I.
    """

    mean: np.ndarray
    deviation: np.ndarray

    @classmethod
    def of(cls, numbers) -> AxisNormaliser:
        """Return that of numbers [..., C]."""
        flat = np.asarray(numbers).reshape(-1, np.shape(numbers)[-1])
        mean, deviation = flat.mean(axis=0, dtype=np.float64), flat.std(axis=0, dtype=np.float64)
        return cls(mean.astype(np.float32), np.maximum(deviation, 1e-6).astype(np.float32))

    def normalise(self, numbers):
        """Map metres to network units, [..., C]."""
        return (numbers - self.mean) / self.deviation

    def restore(self, numbers):
        """Map network units to metres, [..., C]."""
        return numbers * self.deviation + self.mean


@dataclass(frozen=True, eq=False)
class TextMotions:
    """Motions of one skeleton, each with its captions.

    Attributes:
      name: of the data set.
      skeleton: J joints.
      fps: frames per second.
      positions: of all clips, one after the other, [N, J, 3], float32, metres.
      start: first frame of each clip and the end of the last, [K + 1].
      names: of the clips, [K].
      captions: of each clip, one or more.
      splits: "train", "validation" or "test", [K].
      pairs: what each clip shows, such as "walk, elderly": captions of one fit any other clip of
        the same pair; unique names where nothing is known.
      licence, credit: terms of the motion.
      skipped: (clip, reason) of those left out.
      contact_step: squared step below which a foot is in contact, in the positions' unit.
      stored: (file, first frame there) of each clip's redundant vectors, [K], None for a file where they are computed;
        empty where all are.
      statistics: mean and deviation of redundant vectors, [12 J - 1] each, that came with the data.
    """

    name: str
    skeleton: Skeleton
    fps: float
    positions: np.ndarray
    start: np.ndarray
    names: tuple[str, ...]
    captions: tuple[tuple[str, ...], ...]
    splits: tuple[str, ...]
    pairs: tuple[str, ...]
    licence: str = ""
    credit: str = ""
    skipped: tuple[tuple[str, str], ...] = ()
    contact_step: float = redundant.CONTACT_STEP
    stored: tuple[tuple[Path | None, int], ...] = ()
    statistics: tuple[np.ndarray, np.ndarray] | None = None

    @classmethod
    def joined(cls, clips, **attributes) -> TextMotions:
        """Return a data set of (name, captions, split, pair, positions) of each clip and its other attributes."""
        columns = dict(zip((*_LISTS, "positions"), zip(*clips, strict=True), strict=True))
        start = np.cumsum([0, *map(len, columns["positions"])])
        columns["positions"] = np.concatenate(columns["positions"])
        return cls(start=start, **columns, **attributes)

    @property
    def num_clips(self) -> int:
        """Number of clips, K."""
        return len(self.names)

    @property
    def lengths(self) -> np.ndarray:
        """Frames of each clip, [K]."""
        return np.diff(self.start)

    @property
    def fingerprint(self) -> str:
        """SHA-256 (hex) of positions, clips, captions and splits."""
        digest = hashlib.sha256(np.ascontiguousarray(self.positions, np.float32).tobytes())
        digest.update(repr((self.start.tolist(), self.names, self.captions, self.splits, self.pairs)).encode())
        return digest.hexdigest()

    def clip(self, number: int) -> np.ndarray:
        """Return the positions of a clip, [L, J, 3], metres."""
        return self.positions[self.start[number] : self.start[number + 1]]

    def motion(self, number: int) -> Motion:
        """Return a clip as a motion of positions alone, called by its first caption."""
        return Motion.from_positions(self.skeleton, self.clip(number), self.fps, self.captions[number][0])

    def members(self, split: str) -> np.ndarray:
        """Return the numbers of a split's clips; ValueError for an unknown split or an empty one."""
        check_known(split, SPLITS, "split")
        members = np.flatnonzero(np.equal(self.splits, split))
        if not len(members):
            raise ValueError(f"data set {self.name!r} has no clip in its {split} split")
        return members

    def select(self, clips, most_frames: int | None = None) -> TextMotions:
        """Return a data set of some of the clips, in the order given; of each no more than its first frames."""
        kept = self.lengths[list(clips)] if most_frames is None else np.minimum(self.lengths[list(clips)], most_frames)
        rows = np.concatenate([self.start[k] + np.arange(count) for k, count in zip(clips, kept, strict=True)])
        lists = (*_LISTS, "stored") if self.stored else _LISTS
        chosen = {what: tuple(getattr(self, what)[k] for k in clips) for what in lists}
        return dataclasses.replace(self, positions=self.positions[rows], start=np.cumsum([0, *kept]), **chosen)

    def cut(self, most_frames: int) -> TextMotions:
        """Return the same clips, of each no more than its first frames, so that all begin at the origin.

        Raises:
          ValueError: for fewer than 24 frames, or a number that is no multiple of 4.
        """
        if most_frames < FEWEST_FRAMES or most_frames % UNIT:
            raise ValueError(f"clips can be cut to a multiple of {UNIT} from {FEWEST_FRAMES} on, got {most_frames}")
        return self.select(range(self.num_clips), most_frames)

    def normaliser(self) -> AxisNormaliser:
        """Return mean and deviation of x, y and z over the training clips."""
        return AxisNormaliser.of(self.select(self.members("train")).positions)

    def redundant_vectors(self, *, released: bool = True) -> np.ndarray:
        """Return redundant vectors of all frames, [N, 12 J - 1], float32, by the released facing or the earlier one.

        Those stored with the data have the released facing and are taken as they are, so that a part faces as it does
        in the whole. Of those computed, a clip's last frame has no next one to step to: it is taken to go on.
        """
        return _stacked(self._vectors(released))

    def essential_features(self, *, released: bool = True) -> np.ndarray:
        """Return what a judge sees of all frames, [N, 4 + 3 (J - 1)], float32; last frames as above."""
        each = lambda clip: redundant.essential_features(self.skeleton, clip, released=released)
        return _stacked(map(each, self._going_on()))

    def joint_features(self) -> np.ndarray:
        """Return what InterGen's representation adds to positions, of all frames, [N, J, 10]; last frames as above."""
        every = zip(self._going_on(), self._vectors(released=False), strict=True)
        return _stacked(redundant.joint_features(self.skeleton, clip, vectors) for clip, vectors in every)

    def _going_on(self) -> Iterator[np.ndarray]:
        """Yield the positions of each clip, and one frame more."""
        return (going_on(self.clip(number)) for number in range(self.num_clips))

    def _vectors(self, released: bool) -> Iterator[np.ndarray]:
        """Yield the redundant vectors of each clip."""
        stored = (self.stored if released else None) or [(None, 0)] * self.num_clips
        for (file, first), clip in zip(stored, self._going_on(), strict=True):
            vectors = [np.nan] if file is None else np.load(file, mmap_mode="r")[first : first + len(clip) - 1]
            if not np.isfinite(vectors).all():
                vectors = redundant.redundant_from_positions(
                    self.skeleton, clip, contact_step=self.contact_step, released=released
                )
            yield vectors


def _stacked(clips: Iterable[np.ndarray]) -> np.ndarray:
    """Return what clips have of each frame, one clip after the other, float32."""
    return np.concatenate([np.asarray(clip, np.float32) for clip in clips])


def going_on(positions) -> np.ndarray:
    """Return positions [L, J, 3] with one more frame, a step as the last: [L + 1, J, 3], float64."""
    positions = np.asarray(positions, np.float64)
    return np.concatenate([positions, 2 * positions[-1:] - positions[-2:-1]])


_LISTS = ("names", "captions", "splits", "pairs")


def text_motions(clips, *, skeleton: Skeleton, **attributes) -> TextMotions:
    """Put a data set together from motions, each moved to its canonical start.

    Args:
      clips: (name, motion, captions, split, pair) of each.
      skeleton: of all of them.
      **attributes: other attributes of `TextMotions`.
    """
    canonical = (
        (name, captions, split, pair, redundant.canonical_start(skeleton, motion.positions).astype(np.float32))
        for name, motion, captions, split, pair in clips
    )
    # The tips of limbs would need rotations.
    return TextMotions.joined(canonical, skeleton=dataclasses.replace(skeleton, end_sites=()), **attributes)


def bandai_text_motions(packed: PackedMotion) -> TextMotions:
    """Return the Bandai clips at 20 fps with composed captions.

    A clip's split follows from its name, within its content and style; its mirrored twin, in which
    left and right change places in the captions too, is in the same split. Seven clips turn to the
    other side than their names say: captions and pairs go by what is seen.

    Args:
      packed: the whole Bandai set (`open_dataset("bandai", locomotion_only=False)`).

    Raises:
      ValueError: for another data set.
    """
    if packed.name != "bandai":
        raise ValueError(f"captions are composed for data set 'bandai', not for {packed.name!r}")
    styles = [plain_style(packed.styles[style]) for style in packed.clip_style]
    labels = {
        clip: (content, styles[clip]) for clip, content in enumerate(packed.clip_contents) if content in CAPTIONED
    }
    strata = [(packed.clip_names[clip], pair) for clip, pair in labels.items()]
    splits = assign_splits(strata, percent=HELD_OUT_PERCENT)
    skipped = [(name, "too short") for name, _ in packed.skipped]
    clips = []
    for clip, name in enumerate(packed.clip_names):
        if clip not in labels:
            skipped.append((name, f"no words for content {packed.clip_contents[clip]!r}"))
            continue
        motion = resample(packed.motion(clip), FPS, smooth=True)
        motion = motion.slice(0, min(motion.num_frames, MOST_FRAMES) // UNIT * UNIT)
        content, style = shown_content(labels[clip][0], motion), labels[clip][1]
        captions = compose_captions(name, content, style, motion)
        clips.append((name, motion, captions, splits[name], f"{content}, {style}"))
        swapped, seen = tuple(map(other_side, captions)), Motion.from_positions(motion.skeleton, motion.positions)
        clips.append((f"M{name}", mirror(seen), swapped, splits[name], f"{other_side(content)}, {style}"))
    attributes = {name: getattr(packed, name) for name in ("skeleton", "licence", "credit")}
    return text_motions(clips, name="bandai", fps=FPS, skipped=tuple(skipped), **attributes)


# ------------------------------------------------------------------------------------------ batches


class MotionBatch(NamedTuple):
    """Padded clips.

    Attributes:
      motion: [B, F, ...], float32, or a tree of such; 0 in the padding.
      length: frames of each, [B], int32.
      mask: true for frames, false for padding, [B, F].
      caption: row of each clip's caption in the table of embeddings, [B], int32; -1 where none was drawn.
    """

    motion: jax.Array
    length: jax.Array
    mask: jax.Array
    caption: jax.Array


def frame_mask(length, num_frames: int):
    """Return [B, num_frames] of bool: true before each clip's end."""
    return jnp.arange(num_frames) < jnp.asarray(length)[:, None]


def pad_motions(motions: Sequence[np.ndarray], num_frames: int = MOST_FRAMES // UNIT * UNIT) -> MotionBatch:
    """Pad arrays [L, ...] with zeros to one length; longer ones are cut."""
    padded = np.zeros((len(motions), num_frames, *np.shape(motions[0])[1:]), np.float32)
    for row, motion in zip(padded, motions, strict=True):
        row[: len(motion)] = motion[:num_frames]
    length = jnp.array([min(len(motion), num_frames) for motion in motions], jnp.int32)
    missing = jnp.full(len(motions), -1, jnp.int32)
    return MotionBatch(jnp.asarray(padded), length, frame_mask(length, num_frames), missing)


class ClipTable(NamedTuple):
    """Clips on the device, to draw batches from.

    Attributes:
      frames: of all clips, [N, ...], in network units; or a tree of such.
      start, length: of each clip, [K].
      caption: first row of each clip's captions in the table of embeddings, [K].
      count: captions of each clip, [K].
    """

    frames: jax.Array
    start: jax.Array
    length: jax.Array
    caption: jax.Array
    count: jax.Array


def clip_table(data: TextMotions, frames, frames_per_row: int = 1) -> tuple[ClipTable, list[str]]:
    """Return the clips of a data set as a table, and the captions that its numbers stand for.

    Args:
      data: the clips; all of them are in the table.
      frames: what is drawn of each frame, [N, ...], in network units; or a tree of such.
      frames_per_row: frames of motion that a row of `frames` stands for: 4 of ACMDM's latent. A clip has whole rows.
    """
    length = data.lengths // frames_per_row
    count = np.array([len(captions) for captions in data.captions], np.int32)
    captions = [caption for several in data.captions for caption in several]
    columns = (np.cumsum(length) - length, length, np.cumsum(count) - count, count)
    columns = (jnp.asarray(column, jnp.int32) for column in columns)
    return ClipTable(jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), frames), *columns), captions


def draw_clips(key, table: ClipTable, size: int, num_frames: int, unit: int = UNIT) -> MotionBatch:
    """Draw clips, a caption of each, and where each begins.

    A length is a multiple of the unit, one time in three a unit shorter, and no more than fits.

    Args:
      key: random key.
      table: the clips.
      size: how many, B.
      num_frames: that a batch is padded to, F.
      unit: of lengths.

    Source: the released code of HumanML3D and ACMDM (their data sets).
    """
    keys = jax.random.split(key, 4)
    clip = jax.random.randint(keys[0], (size,), 0, len(table.start))
    caption = table.caption[clip] + jax.random.randint(keys[1], (size,), 0, table.count[clip])
    units = jnp.minimum(table.length[clip], num_frames) // unit
    shorter = jax.random.bernoulli(keys[2], 1 / 3, (size,)) & (units > 1)
    length = unit * (units - shorter)
    first = table.start[clip] + jax.random.randint(keys[3], (size,), 0, table.length[clip] - length + 1)
    mask = frame_mask(length, num_frames)
    rows = jnp.where(mask, first[:, None] + jnp.arange(num_frames), 0)
    spread = lambda frames: mask.reshape(*mask.shape, *[1] * (frames.ndim - 1))
    motion = jax.tree.map(lambda frames: jnp.where(spread(frames), frames[rows], 0.0), table.frames)
    return MotionBatch(motion, length, mask, caption)


# ----------------------------------------------------------------------------------------- captions
#
# A caption of a Bandai clip joins a subject or a manner (style), an action (content) and a detail that is measured on
# the clip (how fast, how high the hands go). All words stand in `captions.toml`; which of them a clip gets follows from
# its name alone. Some phrases are held out: no training caption has them.


_WORDS = read_toml(Path(__file__).with_name("captions.toml"))

CAPTIONED = tuple(_WORDS["content"])
"""Contents that have words."""

_SIDES = {"left": "right", "right": "left"}


def other_side(text: str) -> str:
    """Return a caption or a content's name with left and right exchanged, for a mirrored clip."""
    return re.sub(r"\b(left|right)\b", lambda found: _SIDES[found[0]], text)


def caption_wordings(content: str, *, held_out: bool = False) -> tuple[str, ...]:
    """Return the actions that captions of a content name, such as "raises the left hand".

    Args:
      content: one of `CAPTIONED`.
      held_out: those that training never sees, instead of the others.
    """
    return tuple(_WORDS["content"][content]["held_out" if held_out else "action"])


def plain_style(style: str) -> str:
    """Return a style of either part of the set without its number, by one name: "1-old" is "elderly"."""
    style = style.partition("-")[2]
    return _WORDS["same_style"].get(style, style)


def shown_content(content: str, motion: Motion) -> str:
    """Return a content with the side that the motion turns to, where its name tells another."""
    if "-turn-" not in content:
        return content
    yaw = np.unwrap(motion.yaw)
    turned = "left" if yaw[-1] > yaw[0] else "right"
    return content if turned in content else other_side(content)


def measured_detail(kind: str, motion: Motion) -> str:
    """Say how fast somebody walks or runs, or how high hands go, in the words of `captions.toml`.

    Args:
      kind: "walk", "run", "hands", "left hand" or "right hand".
      motion: a clip whose head and wrists are known.

    Returns:
      A phrase with a space in front, or nothing where the clip is neither fast nor slow.
    """
    positions, skeleton = motion.positions, motion.skeleton
    if kind in ("walk", "run"):
        steps = np.linalg.norm(np.diff(positions[:, 0, ::2], axis=0), axis=-1)
        number = steps.mean() * motion.fps
    else:
        sides = ("left", "right") if kind == "hands" else (kind.partition(" ")[0],)
        wrists = positions[:, [skeleton.role(f"{side}_wrist") for side in sides], 1].min(axis=1)
        number = np.max(wrists - positions[:, skeleton.role("head"), 1])
    words = _WORDS["detail"][kind]
    return next(phrase for limit, phrase in zip(words["limits"], words["phrases"], strict=True) if number < limit)


def compose_captions(name: str, content: str, style: str, motion: Motion, *, count: int = 4) -> tuple[str, ...]:
    """Compose different captions of a clip.

    Args:
      name: of the clip, which decides the choice.
      content: such as "walk-turn-left", one of `CAPTIONED`.
      style: a style of `captions.toml`, from `plain_style`.
      motion: the clip, for the details.
      count: captions; fewer where words run out.

    Returns:
      Captions, a tuple of str, none twice; the same for the same clip, always.

    Raises:
      ValueError: for a content or a style without words.
    """
    for kind, known in (("content", content), ("style", style)):
        if known not in _WORDS[kind]:
            raise ValueError(f"no words for {kind} {known!r} in captions.toml{nearest_hint(known, _WORDS[kind])}")
    content_words, style_words = _WORDS["content"][content], _WORDS["style"][style]
    detail = measured_detail(content_words["detail"], motion) if "detail" in content_words else ""
    every = [
        pattern.format(subject=subject, action=action, detail=known_detail, manner=manner)
        for pattern in _WORDS["patterns"]
        for subject, manner in zip(style_words["subject"], style_words["manner"], strict=True)
        for action in caption_wordings(content)
        for known_detail in dict.fromkeys(("", detail))
    ]
    rank = lambda text: hashlib.sha256(f"{name}: {text}".encode()).digest()
    return tuple(sorted(dict.fromkeys(every), key=rank)[:count])
