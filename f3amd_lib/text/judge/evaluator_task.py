"""What the judge of text to motion is trained to do: lay a motion and its caption together, others apart."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax

from f3amd_lib.text.data.text_encoders import TextEmbeddings
from f3amd_lib.text.data.text_motions import MOST_FRAMES, UNIT, draw_clips
from f3amd_lib.training.checkpoints import network_with
from f3amd_lib.training.optimise import ClipsTask, TrainingState, frozen_tree
from f3amd_lib.training.settings import check_settings


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
        if self.num_steps < 1 or self.batch_size < 2:
            raise ValueError(f"a judge needs at least 1 step and batches of 2, got {self}")
        if self.num_frames < UNIT:
            raise ValueError(f"a judge needs at least {UNIT} frames, got {self}")
        check_settings(self)

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


def embedded_captions(embedded: TextEmbeddings, pairs) -> Captions:
    """Return captions on the device.

    Args:
      embedded: C captions.
      pairs: what each of them tells, [C] of str.
    """
    numbers = np.unique(np.asarray(pairs), return_inverse=True)[1]
    return Captions(jnp.asarray(embedded.tokens), jnp.asarray(embedded.mask), jnp.asarray(numbers, jnp.int32))
