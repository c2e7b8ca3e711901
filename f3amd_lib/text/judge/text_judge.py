"""The judge of text to motion: a trained evaluator, its measures, and figures with intervals.

The published evaluators know the 22 joints of HumanML3D or KIT-ML's 21 alone, so one of their shape is trained here, on
the training split. It says what it sees before it judges: R-precision is refused where real held-out motion is not
found.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pandas as pd
from flax import nnx

from f3amd_lib.ground.arrays import in_batches
from f3amd_lib.ground.records import run_record
from f3amd_lib.measures.distributions import frechet_distance, intervals_over_repeats
from f3amd_lib.measures.registry import METRICS
from f3amd_lib.networks.attention import dropout
from f3amd_lib.networks.config import CheckedConfig, scaled_normal
from f3amd_lib.text.data import text_motions
from f3amd_lib.text.data.redundant import canonical_start, essential_features, redundant_from_positions
from f3amd_lib.text.data.text_encoders import TextEmbeddings, TextEncoder, embed_captions
from f3amd_lib.text.data.text_motions import MOST_FRAMES, UNIT, AxisNormaliser, TextMotions, draw_clips, pad_motions
from f3amd_lib.text.judge import text_metrics
from f3amd_lib.text.stages.text_models import JUDGE, CaptionedModel, ClipsTask, load_text_model, save_text_model
from f3amd_lib.training.checkpoints import network_with
from f3amd_lib.training.optimise import TrainingState, frozen_tree, optimise
from f3amd_lib.training.pipeline import ModelFiles, alone_with
from f3amd_lib.training.recipe import check_settings

# ------------------------------------------------------------------------------------------ network


@dataclass(frozen=True, kw_only=True)
class TextMotionConfig(CheckedConfig):
    """Sizes of both encoders; those of the published evaluator are 512, 1024, 512 and 512.

    Attributes:
      features: of a frame of motion, 4 + 3 (J - 1).
      token_width: of the caption's token vectors.
      movement_width: of the convolutions, each of which halves the frames.
      motion_hidden, text_hidden: of the recurrence, in each direction.
      embedding_width: of the common space.
      dropout: after each convolution, in training.
      released: layers and facing (`redundant.smoothed_yaw`) of the published evaluators; files of earlier versions have
        not: no bias on the state inside the recurrence's candidate, padding zeroed between convolutions, LayerNorm's
        epsilon 1e-6.
      tag_width: numbers of a token's part of speech, one of them 1; 0: captions are not tagged. Published: 15.
    """

    family: ClassVar[str] = "text-to-motion judge"
    may_be_zero: ClassVar[tuple[str, ...]] = ("dropout", "tag_width")

    features: int
    token_width: int
    movement_width: int = 128
    motion_hidden: int = 128
    text_hidden: int = 128
    embedding_width: int = 64
    dropout: float = 0.2
    released: bool = False
    tag_width: int = 0


class HalvingConvolution(nnx.Module):
    """Convolution of 4 frames at every second one, a frame of zeros at both ends: half as many frames.

    One matrix product, since XLA's gradient of a strided convolution is slow on a CPU.
    """

    def __init__(self, width_in: int, width_out: int, *, rngs: nnx.Rngs):
        self.taps = nnx.Linear(4 * width_in, width_out, rngs=rngs)

    def __call__(self, z):
        """Map [B, F, C], F even, to [B, F / 2, D]."""
        z = jnp.pad(z, ((0, 0), (1, 1), (0, 0)))
        pairs = z.reshape(z.shape[0], z.shape[1] // 2, -1)
        return self.taps(jnp.concatenate([pairs[:, :-1], pairs[:, 1:]], axis=-1))


class _BothWays(nnx.Module):
    """A gated recurrence forwards and backwards from a learned start; its last states become one vector."""

    def __init__(self, width_in: int, hidden: int, width_out: int, released: bool, *, rngs: nnx.Rngs):
        self.inside = nnx.Linear(width_in, hidden, rngs=rngs)
        self.start = nnx.Param(scaled_normal(rngs.params(), 0.1, (2, hidden)))
        options = {"return_carry": True, "rngs": False}  # its start is given: nothing is drawn
        self.forwards = nnx.RNN(nnx.GRUCell(hidden, hidden, rngs=rngs), **options)
        self.backwards = nnx.RNN(nnx.GRUCell(hidden, hidden, rngs=rngs), reverse=True, **options)
        if released:  # PyTorch's cell: r * (W h + b) in the candidate, where flax has r * W h
            for recurrence in (self.forwards, self.backwards):
                square = nnx.initializers.orthogonal()
                recurrence.cell.dense_h = nnx.Linear(hidden, 3 * hidden, kernel_init=square, rngs=rngs)
        self.middle = nnx.Linear(2 * hidden, hidden, rngs=rngs)
        self.norm = nnx.LayerNorm(hidden, epsilon=1e-5 if released else 1e-6, rngs=rngs)
        self.output = nnx.Linear(hidden, width_out, rngs=rngs)

    def __call__(self, z, length):
        """Map [B, T, width_in], of which `length` [B] count, to [B, width_out]."""
        z = self.inside(z)
        start = jnp.broadcast_to(self.start[...][:, None], (2, len(z), z.shape[-1]))
        last = [
            recurrence(z, initial_carry=first, seq_lengths=length)[0]
            for recurrence, first in zip((self.forwards, self.backwards), start, strict=True)
        ]
        return self.output(nnx.leaky_relu(self.norm(self.middle(jnp.concatenate(last, axis=-1))), 0.2))


class TextMotionNetwork(nnx.Module):
    """Two encoders that meet: a motion and its caption become vectors of one space.

    Movement convolutions and a bidirectional recurrence over motion features, the same recurrence over the caption's
    token vectors. As released, the convolutions see what biases make of the padding's zeros, so that a clip must be
    padded to one length always; numbers in a caption's padding change nothing.

    Source: Guo et al. 2022 (HumanML3D), the evaluator of its released code; sizes in ACMDM's evaluation code.
    """

    def __init__(self, config: TextMotionConfig, *, rngs: nnx.Rngs):
        width, out = config.movement_width, config.embedding_width
        self.dropout, self.released = config.dropout, config.released
        self.movement = nnx.List(
            [HalvingConvolution(config.features, width, rngs=rngs), HalvingConvolution(width, width, rngs=rngs)]
        )
        self.movement_output = nnx.Linear(width, width, rngs=rngs)
        self.motion = _BothWays(width, config.motion_hidden, out, config.released, rngs=rngs)
        self.text = _BothWays(config.token_width, config.text_hidden, out, config.released, rngs=rngs)
        if config.tag_width:
            self.tags = nnx.Linear(config.tag_width, config.token_width, rngs=rngs)

    def embed_motion(self, features, length, key=None):
        """Return motions as vectors, [B, embedding_width].

        Args:
          features: [B, F, features], F a multiple of 4; 0 in the padding.
          length: frames of each, [B]; at least 4.
          key: random key of the dropout, in training.
        """
        z = features
        for layer, convolution in enumerate(self.movement, 1):
            key_layer = None if key is None else jax.random.fold_in(key, layer)
            z = dropout(nnx.leaky_relu(convolution(z), 0.2), self.dropout, key_layer)
            if not self.released:
                left = -(-length // 2**layer)
                z = jnp.where((jnp.arange(z.shape[1]) < left[:, None])[..., None], z, 0.0)
        return self.motion(self.movement_output(z), length // 4)

    def embed_text(self, tokens, mask, tags=None):
        """Return captions as vectors, [B, embedding_width].

        Args:
          tokens: [B, T, token_width].
          mask: true for tokens, which come first, [B, T].
          tags: part of speech of each, [B, T, tag_width], where captions are tagged.
        """
        return self.text(tokens if tags is None else tokens + self.tags(tags), jnp.sum(mask, axis=1))


_BATCH = 64

CLASS_CLIPS = 5
"""A pair of content and style with fewer clips is no class to evaluate on."""


# ------------------------------------------------------------------------------------------ training


@dataclass(frozen=True)
class EvaluatorTraining:
    """How the judge is trained.

    Attributes:
      num_steps, batch_size: optimiser steps, and pairs in each.
      learning_rate: of Adam at first; it falls to 0 on a cosine.
      seed: of weights, batches and dropout.
      num_frames: that motions are padded to.
    """

    ema_decay: ClassVar[None] = None

    num_steps: int = 3000
    batch_size: int = 64
    learning_rate: float = 1e-3
    seed: int = 0
    num_frames: int = MOST_FRAMES // UNIT * UNIT

    def __post_init__(self):
        check_settings(self)
        if self.batch_size < 2 or self.num_frames < UNIT:
            raise ValueError(f"a judge needs batches of 2 or more and at least {UNIT} frames, got {self}")

    def optimiser(self) -> optax.GradientTransformation:
        """Return Adam with a warm-up, gradients clipped."""
        warm, steps = min(100, self.num_steps // 5 + 1), self.num_steps + 1
        rate = optax.warmup_cosine_decay_schedule(0.0, self.learning_rate, warm, steps)
        return optax.chain(optax.clip_by_global_norm(1.0), optax.adam(rate))


class Captions(NamedTuple):
    """Embedded captions, and what each of them tells.

    Attributes:
      tokens, mask: as in `TextEmbeddings`, [C, T, width] and [C, T].
      pair: number of the pair of content and style that each describes, [C].
    """

    tokens: jax.Array
    mask: jax.Array
    pair: jax.Array


def contrastive_loss(text, motion, pair):
    """Return how badly texts find their motions and motions their texts among the batch.

        mean over i of -log softmax_j(-|t_i - m_j|^2 / sqrt(D))_i, and the same for columns.

    Another sample of the same pair would be right too, and is no rival.

    Args:
      text, motion: [B, D].
      pair: numbers of the pairs, [B].

    Returns:
      (loss, share of texts whose own motion is the nearest), scalars.
    """
    distance = jnp.sum((text[:, None] - motion[None]) ** 2, axis=-1) / np.sqrt(text.shape[-1])
    rival = (pair[:, None] != pair[None]) | jnp.eye(len(pair), dtype=bool)
    score = jnp.where(rival, -distance, -jnp.inf)
    own = jnp.arange(len(pair))
    both = [optax.softmax_cross_entropy_with_integer_labels(s, own).mean() for s in (score, score.T)]
    return sum(both) / 2, jnp.mean(jnp.argmax(score, axis=1) == own)


@frozen_tree("clips", "captions")
class EvaluatorTask(ClipsTask):
    """A judge to train on clips of features in network units.

    Attributes:
      captions: of these clips.
      text_encoder: identity of the encoder that embedded them.
    """

    name = "text-to-motion judge"

    captions: Captions
    text_encoder: str

    def identity(self) -> dict:
        """Return all that decides the weights."""
        settings = {"evaluator": dataclasses.asdict(self.model_config), "training": dataclasses.asdict(self.config)}
        return {"dataset_fingerprint": self.dataset_fingerprint, "text_encoder": self.text_encoder, **settings}

    def draw(self, state: TrainingState | None, key):
        """Draw motions and a caption of each; return ((motions, captions), key of the dropout)."""
        key_draw, key_dropout = jax.random.split(key)
        motion = draw_clips(key_draw, self.clips, self.config.batch_size, self.config.num_frames)
        return (motion, jax.tree.map(lambda rows: rows[motion.caption], self.captions)), key_dropout

    def terms(self, params, batch, key, training=True) -> dict:
        """Return loss and in-batch accuracy; out of training without dropout."""
        motion, captions = batch
        network = network_with(self.model_config, params)
        text = network.embed_text(captions.tokens, captions.mask)
        seen = network.embed_motion(motion.motion, motion.length, key if training else None)
        loss, accuracy = contrastive_loss(text, seen, captions.pair)
        return {"loss": loss, "accuracy": accuracy}


# ------------------------------------------------------------------------------------------ the judge


@dataclass(frozen=True, eq=False, kw_only=True)
class TextJudge(CaptionedModel):
    """A trained judge; motions on another skeleton than its own are not accepted.

    Attributes:
      normaliser: of its motion features; deviations averaged over each part.
    """

    kind: ClassVar[str] = TextMotionConfig.family

    normaliser: AxisNormaliser

    def parts(self) -> tuple[dict, dict, None, dict]:
        """Return what its file has besides, as `TextModel.parts`."""
        return {}, {"normaliser": self.normaliser._asdict()}, None, {}

    @classmethod
    def of(cls, tree: dict, autoencoder, said: dict, about: dict) -> TextJudge:
        """Return the judge of a file, as `TextModel.of`."""
        return cls(normaliser=AxisNormaliser(**jax.tree.map(np.asarray, tree["normaliser"])), **about)

    def embed_motions(self, motions: Sequence[np.ndarray]) -> np.ndarray:
        """Return motions as vectors, [N, D].

        Args:
          motions: positions [L, J, 3] of each, metres, on the judge's skeleton; moved to the canonical
            start first, so that only the motion counts.

        Raises:
          ValueError: for another number of joints, fewer than 4 frames, or numbers not finite.
        """
        essential = self.config.features == 4 + 3 * (self.skeleton.num_joints - 1)
        of = essential_features if essential else redundant_from_positions
        if (least := min(map(len, motions))) < UNIT:
            raise ValueError(f"a motion has {least} frames; the judge needs {UNIT}")
        canonical = (text_motions.going_on(canonical_start(self.skeleton, motion)) for motion in motions)
        return self.embed_vectors([of(self.skeleton, motion, released=self.config.released) for motion in canonical])

    def embed_vectors(self, vectors: Sequence[np.ndarray]) -> np.ndarray:
        """Return motions as vectors, [N, D], of redundant vectors, [L, C] each: what it reads comes first."""
        features = [self.normaliser.normalise(rows[:, : self.config.features]) for rows in vectors]
        return self._embed("motion", lambda rows: pad_motions([features[row] for row in rows])[:2], len(features))

    def embed_texts(self, embedded: TextEmbeddings) -> np.ndarray:
        """Return embedded captions as vectors, [N, D]; a token's tag, where it has one, stands behind its numbers."""
        parts, mask = [self.config.token_width] * bool(self.config.tag_width), embedded.mask

        def given(rows):
            tokens, *tags = np.split(embedded.tokens[rows], parts, axis=-1)
            return tokens, mask[rows], *tags

        return self._embed("text", given, len(embedded.tokens))

    def _embed(self, what: str, given: Callable, count: int) -> np.ndarray:
        embed = lambda rows: _embed(what, self.config, self.params, *given(rows))
        return in_batches(embed, count, _BATCH).astype(np.float64)


@functools.partial(jax.jit, static_argnums=(0, 1))
def _embed(what: str, config: TextMotionConfig, params, *given):
    return getattr(network_with(config, params), f"embed_{what}")(*given)


def judged_features(data: TextMotions, released: bool = True) -> tuple[np.ndarray, AxisNormaliser]:
    """Return what a judge of either form sees of training clips in its network's units, [N, C], and the normaliser.

    Deviations are averaged over turn, velocity, height and positions.
    """
    features = data.essential_features(released=released)
    normaliser = AxisNormaliser.of(features)
    for part in (slice(0, 1), slice(1, 3), slice(3, 4), slice(4, None)):
        normaliser.deviation[part] = normaliser.deviation[part].mean()
    return normaliser.normalise(features), normaliser


def judge_task(
    data: TextMotions, encoder: TextEncoder, training: EvaluatorTraining, **sizes
) -> tuple[EvaluatorTask, AxisNormaliser]:
    """Return the training of a judge on a data set's training split, and its features' normaliser.

    Args:
      data: motions with captions.
      encoder: of the captions.
      training: how long, and from which seed.
      **sizes: fields of `TextMotionConfig` to change; `released` is true, or false to go on with an earlier state.
    """
    training_split, sizes = data.select(data.members("train")), {"released": True} | sizes
    features, normaliser = judged_features(training_split, sizes["released"])
    table, captions = text_motions.clip_table(training_split, features)
    pairs = [pair for pair, said in zip(training_split.pairs, training_split.captions, strict=True) for _ in said]
    network = TextMotionConfig(features=features.shape[-1], token_width=encoder.width, **sizes)
    tokens, mask, _ = embed_captions(captions, encoder)
    told = Captions(*map(jnp.asarray, (tokens, mask, np.unique(pairs, return_inverse=True)[1].astype(np.int32))))
    about = {"text_encoder": encoder.identity, "dataset_fingerprint": data.fingerprint}
    return EvaluatorTask(network, training, table, told, **about), normaliser


def train_judge(
    data: TextMotions, encoder: TextEncoder, training: EvaluatorTraining | None = None, *,
    files: ModelFiles | None = None, progress: bool = True, stop_at: float | None = None, **sizes,
) -> TextJudge | None:  # fmt: skip
    """Train a judge; with files a killed training goes on where it was, and a finished judge is only read.

    Args:
      data, encoder, training, **sizes: as in `judge_task`.
      files: where it is kept; by default nowhere.
      progress, stop_at: as for `optimise`; where that time comes first, the answer is None.

    Raises:
      ValueError: if another process trains it there.
    """
    if files and files.model.exists():
        found = load_judge(files.model)
        if (found.record["dataset_fingerprint"], found.text_encoder) != (data.fingerprint, encoder.identity):
            raise ValueError(f"{files.model}: is a judge of other data or another text encoder; move it away")
        return found
    training, checkpoint = training or EvaluatorTraining(), files and files.state
    task, normaliser = judge_task(data, encoder, training, **sizes)
    with alone_with(files) if files else contextlib.nullcontext():
        state, history = optimise(task, checkpoint=checkpoint, checkpoint_every=200, stop_at=stop_at, progress=progress)
    if int(state.step) < training.num_steps:
        return None
    identity = {name: value for name, value in task.identity().items() if name != "dataset_fingerprint"}
    record = run_record(profile="none", dataset=data, seed=training.seed, **identity, history=history)
    judge = TextJudge(
        name=JUDGE, config=task.model_config, params=state.params, normaliser=normaliser, skeleton=data.skeleton,
        fps=data.fps, text_encoder=encoder.identity, record=record,
    )  # fmt: skip
    if files:
        save_text_model(files.model, judge, jnp.float32)
    return judge


def load_judge(path: Path) -> TextJudge:
    """Read a judge from its file; ValueError names one that is missing, damaged or of another kind."""
    return load_text_model(path, TextJudge)


# ------------------------------------------------------------------------------------------ verdicts


def judged_clips(data: TextMotions) -> TextMotions:
    """Return the test clips that can be judged: those of pairs with enough clips, or all where no pair has."""
    pairs, counts = np.unique(data.pairs, return_counts=True)
    # HumanML3D's pairs are names of clips.
    known = {*pairs[counts >= (CLASS_CLIPS if counts.max() >= CLASS_CLIPS else 1)]}
    chosen = [clip for clip in data.members("test") if data.pairs[clip] in known]
    if not chosen:
        raise ValueError(f"data set {data.name!r} has no pair of content and style with enough clips to judge by")
    return data.select(chosen)


def text_figures(
    text, motion, reference, pairs, generator: np.random.Generator, group: int = text_metrics.GROUP
) -> dict[str, float]:
    """Return the figures of one repeat, by names of the registry.

    Args:
      text, motion: embeddings of captions and of their motions, [N, D].
      reference: of real motions, [M, D].
      pairs: what each caption tells, [N].
      generator: what draws groups and pairs.
      group: texts that are ranked together.
    """
    groups = text_metrics.groups_of_unlike_pairs(pairs, generator, group)
    precision = text_metrics.r_precision(text[groups], motion[groups])
    return {
        "text_FID": frechet_distance(motion, reference),
        **{f"R_precision_{k}": share for k, share in enumerate(precision, 1)},
        "matching_distance": text_metrics.matching_distance(text[groups], motion[groups]),
        "embedding_diversity": text_metrics.embedding_diversity(motion, generator),
        "CLIP_score": text_metrics.clip_score(text, motion),
    }


def judge_motions(
    judge: TextJudge, encoder: TextEncoder, real: TextMotions,
    systems: dict[str, Callable[[int], tuple[Sequence[np.ndarray], Sequence[str]]]],
    *, repeats: int, bar: float, seed: int = 0, group: int = text_metrics.GROUP,
) -> pd.DataFrame:  # fmt: skip
    """Measure systems beside real motion, with intervals over repeats.

    Args:
      judge, encoder: what looks, and what embeds captions.
      real: the clips to be compared with, from `judged_clips`.
      systems: name -> function of the repeat that gives (motions [L, J, 3], captions), one for each
        clip of `real`, in their order.
      repeats: how often; in each the captions, the groups and the motions are drawn anew.
      seed: of the draws.
      group: texts that are ranked together.
      bar: least R-precision at 3 of real motion.

    Returns:
      Columns system, metric, unit, better, value, low, high, repeats; "real" first.

    Raises:
      ValueError: if the judge reads another encoder's vectors, does not find real motion (`bar`), or
        a system gives another number of motions.
    """
    if encoder.identity != judge.text_encoder:
        raise ValueError(f"the judge reads captions of {judge.text_encoder}, got {encoder.identity}")
    clips = [real.clip(number) for number in range(real.num_clips)]
    embedded = judge.embed_motions(clips)
    rows = []
    for repeat in range(repeats):
        generator = np.random.default_rng([seed, repeat])
        captions = [said[generator.integers(len(said))] for said in real.captions]
        own = judge.embed_texts(embed_captions(captions, encoder))
        made = {"real": (embedded, own)}
        for name, system in systems.items():
            motions, told = system(repeat)
            if not len(motions) == len(told) == real.num_clips:
                raise ValueError(f"{name}: {len(motions)} motions, {len(told)} captions for {real.num_clips} clips")
            made[name] = (judge.embed_motions(motions), judge.embed_texts(embed_captions(list(told), encoder)))
        for name, (motion, text) in made.items():
            # The same draw for every system.
            drawing = np.random.default_rng([seed, repeat, 1])
            figures = text_figures(text, motion, embedded, real.pairs, drawing, group)
            rows += [{"system": name, "metric": metric, "value": value} for metric, value in figures.items()]
    table = intervals_over_repeats(pd.DataFrame(rows), ("system", "metric"))
    seen = table.loc[(table["system"] == "real") & (table["metric"] == "R_precision_3"), "value"].item()
    if seen < bar:
        raise ValueError(
            f"R-precision at 3 of real clips {seen:.2f}, under {bar}: this judge is too weak; train it longer"
        )
    for place, what in ((2, "unit"), (3, "better")):
        table.insert(place, what, [getattr(METRICS[name], what) for name in table["metric"]])
    return table
