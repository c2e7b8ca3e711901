"""What MotionPCM trains: the autoencoder, the teacher on its latents, and a student that is distilled from the teacher.

Each is a task of `training.optimise`. Settings of the paper and ours stand in `papers/motionpcm/recipes.toml`.
"""

from __future__ import annotations

import dataclasses
import functools
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import optax
from flax import nnx

from f3amd_lib.diffusion.schedules import NoiseSchedule
from f3amd_lib.ground.arrays import in_batches
from f3amd_lib.ground.trees import weights_digest
from f3amd_lib.networks.presets import build_config, build_from_config
from f3amd_lib.text import phases
from f3amd_lib.text.data.redundant import grouped_statistics, positions_from_redundant
from f3amd_lib.text.data.text_motions import AxisNormaliser, TextMotions, clip_table, draw_clips, pad_motions
from f3amd_lib.text.networks import motionpcm
from f3amd_lib.text.stages.text_models import Asked, ClipsTask, LatentModel
from f3amd_lib.training.checkpoints import network_with
from f3amd_lib.training.optimise import TrainingState, frozen_tree
from f3amd_lib.training.recipe import check_settings


@dataclass(frozen=True)
class LatentMotionTraining:
    """How a part of MotionPCM is trained (MotionPCM section 5; MotionLCM V2's released code where it is silent).

    Attributes:
      num_steps: optimiser steps in all.
      batch_size: motions a step.
      learning_rate: of AdamW after the warm-up; it falls to 0 on a cosine.
      warmup_steps: of a linear rise from 0.
      gradient_clip: largest global gradient norm.
      ema_decay: moving average of the weights, None for none; of a student it is mu, and the average is the target.
      text_dropout: share of samples whose caption is replaced by the empty one (teacher).
      kl_weight: of the autoencoder's divergence.
      joints_weight: of the autoencoder's error of joints in the world, into which each frame's turn and step go for all
        frames after it: in small batches its gradient drowns that of the features.
      consistency: "phased", or "latent": MotionLCM's, all the way to the data.
      skip: levels that a step of the teacher's solver passes, k.
      num_phases: M.
      least_guidance, most_guidance: between which w is drawn.
      huber_width: h of the consistency loss; not in the paper.
      adversarial_weight: lambda; 0 trains without a discriminator.
      discriminator_rate: learning rate of its heads; not in the paper.
      alternate: student and discriminator learn by turns, as in PCM's code; else both in every step (Algorithm 1).
      num_frames: that clips are padded to (autoencoder).
      seed: of initial weights and batches.

    Raises:
      ValueError: for a number out of its range or an unknown consistency.
    """

    paper: ClassVar[str] = "motionpcm"

    num_steps: int
    batch_size: int = 64
    learning_rate: float = 2e-4
    warmup_steps: int = 1000
    gradient_clip: float = 1.0
    ema_decay: float | None = None
    text_dropout: float = 0.1
    kl_weight: float = 1e-4
    joints_weight: float = 1.0
    consistency: str = "phased"
    skip: int = 100
    num_phases: int = 1
    least_guidance: float = 5.0
    most_guidance: float = 15.0
    huber_width: float = 0.5
    adversarial_weight: float = 0.1
    discriminator_rate: float = 2e-4
    alternate: bool = False
    num_frames: int = 196
    seed: int = 1234

    def __post_init__(self):
        check_settings(self)
        if self.consistency == "latent" and (self.num_phases > 1 or self.adversarial_weight):
            raise ValueError("consistency 'latent' needs num_phases 1 and adversarial_weight 0")
        if self.least_guidance > self.most_guidance:
            raise ValueError("least_guidance must be no more than most_guidance")

    def optimiser(self, learning_rate: float | None = None, first_moment=0.9) -> optax.GradientTransformation:
        """Return AdamW without decay after clipping, with a warm-up and a cosine, at `learning_rate` or another."""
        learning_rate = learning_rate or self.learning_rate
        num_steps = -(-self.num_steps // 2) if self.alternate else self.num_steps  # of each part by turns
        warm = min(self.warmup_steps, num_steps - 1)
        rate = optax.warmup_cosine_decay_schedule(learning_rate / (warm + 1), learning_rate, warm, num_steps)
        adam = optax.adamw(rate, b1=first_moment, b2=0.999, weight_decay=0.0)
        return optax.chain(optax.clip_by_global_norm(self.gradient_clip), adam)


# --------------------------------------------------------------------------------------------------------- autoencoder


@functools.lru_cache(maxsize=1)
def frame_statistics(data: TextMotions, released: bool = True) -> AxisNormaliser:
    """Return mean and deviation of redundant vectors: the data's own, or the training clips', [features]."""
    vectors = lambda: data.select(data.members("train")).redundant_vectors(released=released)
    mean, deviation = data.statistics or grouped_statistics(vectors())
    return AxisNormaliser(jnp.asarray(mean), jnp.maximum(jnp.asarray(deviation), 1e-4))


def clip_error(numbers_hat, numbers, mask):
    """Return smooth L1, mean over a frame's numbers, then over a clip's frames, then over clips (MotionLCM V2).

    Args:
      numbers_hat, numbers: [B, L, ...].
      mask: frames that are motion, [B, L].
    """
    loss = optax.losses.huber_loss(numbers_hat, numbers).mean(axis=tuple(range(2, numbers.ndim)))
    return jnp.mean(jnp.sum(loss * mask, axis=1) / jnp.sum(mask, axis=1))


def reconstruction_terms(model, statistics: AxisNormaliser, features, mask, keys=(None, None, None)) -> dict:
    """Return {"features", "joints", "divergence"} of an autoencoder; without keys, of the mean and without dropout.

    Args:
      model: a `LatentAutoencoder`.
      statistics: of the features.
      features: normalised, zero in padding, [B, L, 12 J - 1].
      mask: frames that are motion, [B, L].
      keys: of the encoder's dropout, the latent's noise and the decoder's dropout.
    """
    mean, log_variance = model.encode(features, mask, keys[0])
    latent = mean if keys[1] is None else draw_latent(keys[1], mean, log_variance)
    features_hat = model.decode(latent, mask, keys[2])
    joints_hat, joints = (positions_from_redundant(statistics.restore(x)) for x in (features_hat, features))
    return {
        "features": clip_error(features_hat, features, mask),
        "joints": clip_error(joints_hat, joints, mask),
        "divergence": 0.5 * jnp.mean(mean**2 + jnp.exp(log_variance) - 1.0 - log_variance),
    }


def draw_latent(key, mean, log_variance):
    """Draw a latent of what the encoder made."""
    return mean + jnp.exp(0.5 * log_variance) * jax.random.normal(key, mean.shape)


@frozen_tree("clips", "statistics")
class LatentAutoencoderTask(ClipsTask):
    """An autoencoder to train on whole clips, normalised redundant vectors (MotionPCM section 4.1).

    Attributes:
      statistics: of these vectors.
    """

    name, part, recipe = "latent autoencoder", "autoencoder", "autoencoder"
    settings = LatentMotionTraining

    statistics: AxisNormaliser

    @classmethod
    def of(cls, asked: Asked, split: str | None) -> LatentAutoencoderTask:
        """Return the training on the clips of a split, without any where it is None."""
        data, part, clips, statistics = asked.data, asked.part(split), None, None
        network = {**asked.preset.network, "features": 12 * data.skeleton.num_joints - 1}
        model = build_config(asked.preset.name, **network)
        if split is not None:
            statistics = frame_statistics(data, model.released_facing)
            vectors = part.redundant_vectors(released=model.released_facing)
            clips, _ = clip_table(part, statistics.normalise(vectors))
        return cls(model, asked.config, clips, statistics, dataset_fingerprint=data.fingerprint)

    def kept(self, asked: Asked, state: TrainingState, about: dict) -> LatentModel:
        """Return the trained autoencoder."""
        weights = {"autoencoder": self.model_config, "autoencoder_params": state.averaged}
        return LatentModel(statistics=self.statistics, **weights, **about)

    def draw(self, state: TrainingState, key):
        """Draw (features, mask) and the key of the loss."""
        key_draw, key_loss = jax.random.split(key)
        batch = draw_clips(key_draw, self.clips, self.config.batch_size, self.config.num_frames)
        return (batch.motion, batch.mask), key_loss

    def held_out(self):
        """Return (features, mask) to watch the losses on."""
        batch = draw_clips(jax.random.key(0), self.clips, self.config.batch_size, self.config.num_frames)
        return batch.motion, batch.mask

    def terms(self, params, batch, key, training=True) -> dict:
        """Return smooth L1 of features and of joints, and the divergence; out of training of the latent's mean."""
        keys = jax.random.split(key, 3) if training else (None, None, None)
        terms = reconstruction_terms(network_with(self.model_config, params), self.statistics, *batch, keys)
        config = self.config
        loss = terms["features"] + config.joints_weight * terms["joints"] + config.kl_weight * terms["divergence"]
        return {"loss": loss, **terms}


# ------------------------------------------------------------------------------------------------------------- teacher


class LatentTable(NamedTuple):
    """Clips as an autoencoder sees them, on the device.

    Attributes:
      mean, log_variance: of each clip's latent, [K, window, channels]; a latent is drawn anew in every batch.
      caption: first row of each clip's captions in `pooled`, [K].
      count: captions of each clip, [K].
      pooled: embeddings of all captions, [C, W].
      empty: embedding of the empty caption, which stands for none, [W].
    """

    mean: jax.Array
    log_variance: jax.Array
    caption: jax.Array
    count: jax.Array
    pooled: jax.Array
    empty: jax.Array

    def draw(self, key, size: int):
        """Draw clips: latents [B, window, channels] and a caption of each, [B, W]."""
        key_clip, key_caption, key_latent = jax.random.split(key, 3)
        clip = jax.random.randint(key_clip, (size,), 0, len(self.mean))
        caption = self.caption[clip] + jax.random.randint(key_caption, (size,), 0, self.count[clip])
        return draw_latent(key_latent, self.mean[clip], self.log_variance[clip]), self.pooled[caption]


def latent_table(
    model, statistics: AxisNormaliser, data: TextMotions, pooled, empty, num_frames: int = 196, batch: int = 64
) -> LatentTable:
    """Return the latents of a data set's clips.

    Args:
      model: a trained `LatentAutoencoder`.
      statistics: of the features it was trained on.
      data: the clips; all of them are in the table.
      pooled: embeddings of their captions, clip after clip, [C, W].
      empty: embedding of the empty caption, [W].
      num_frames: that clips are cut or padded to.
      batch: clips encoded at a time.
    """
    vectors = statistics.normalise(data.redundant_vectors(released=model.config.released_facing))
    rows = [vectors[first:last] for first, last in zip(data.start[:-1], data.start[1:], strict=True)]
    graph, params = nnx.split(model)
    encode = jax.jit(lambda params, *clips: nnx.merge(graph, params).encode(*clips))
    given = lambda numbers: encode(params, *pad_motions([rows[k] for k in numbers], num_frames)[::2])
    mean, log_variance = map(jnp.asarray, in_batches(given, len(rows), batch))
    count = jnp.asarray([len(captions) for captions in data.captions], jnp.int32)
    first = jnp.cumsum(count) - count
    return LatentTable(mean, log_variance, first, count, jnp.asarray(pooled), jnp.asarray(empty))


def _latents(asked: Asked, split: str | None) -> LatentTable | None:
    """Return the latents and captions of a split's clips; None where nothing is trained, since that takes minutes."""
    if split is None:
        return None
    before, part = asked.before, asked.part(split)
    pooled = asked.pooled([caption for several in part.captions for caption in several])
    model, empty = network_with(before.autoencoder, before.autoencoder_params), asked.encoder([""]).pooled[0]
    return latent_table(model, before.statistics, part, pooled, empty, asked.config.num_frames)


@frozen_tree("clips")
class TeacherTask(ClipsTask):
    """A teacher to train: the noise of latents under a caption, or none. Clips are a `LatentTable`.

    Attributes:
      schedule: the noise schedule of its preset.
    """

    name, part, recipe = "latent teacher", "teacher", "teacher"
    settings = LatentMotionTraining

    schedule: NoiseSchedule

    @classmethod
    def of(cls, asked: Asked, split: str | None) -> TeacherTask:
        """Return the training on the latents of a split's clips, without any where it is None."""
        model = build_config(asked.preset.name, text_width=asked.pooled(["a person walks"]).shape[-1])
        fingerprint = f"{asked.data.fingerprint} on {weights_digest(asked.before.autoencoder_params)}"
        given = model, asked.config, _latents(asked, split), asked.preset.diffusion
        return cls(*given, dataset_fingerprint=fingerprint)

    def kept(self, asked: Asked, state: TrainingState, about: dict) -> LatentModel:
        """Return the trained teacher: its moving average."""
        made = {"schedule": self.schedule, "config": self.model_config, "params": state.averaged}
        made["empty"] = self.clips.empty
        return dataclasses.replace(asked.before, **made, **asked.told(), **about)

    def draw(self, state: TrainingState, key):
        """Draw (latents, captions) and the key of the loss; a share of the captions is the empty one."""
        key_draw, key_told, key_loss = jax.random.split(key, 3)
        latent, text = self.clips.draw(key_draw, self.config.batch_size)
        told = jax.random.bernoulli(key_told, 1.0 - self.config.text_dropout, (len(text), 1))
        return (latent, jnp.where(told, text, self.clips.empty)), key_loss

    def held_out(self):
        """Return (latents, captions) to watch the losses on."""
        return self.clips.draw(jax.random.key(0), self.config.batch_size)

    def terms(self, params, batch, key, training=True) -> dict:
        """Return the squared error of the noise; out of training without dropout."""
        key_time, key_noise, key_dropout = jax.random.split(key, 3) if training else (*jax.random.split(key), None)
        latent, text = batch
        network = network_with(self.model_config, params)
        time = jax.random.randint(key_time, (len(latent),), 0, len(self.schedule.levels))
        noise = jax.random.normal(key_noise, latent.shape)
        state = phases.noised(self.schedule, latent, noise, time)
        eps = network(state, time, network.encode(text), key=key_dropout)
        return {"loss": jnp.mean((eps - noise) ** 2)}


# -------------------------------------------------------------------------------------------------------- distillation


class DistillationBatch(NamedTuple):
    """What a student is asked, and what frozen networks say; samples first.

    Attributes:
      state: noisy latents z_t.
      time, edge: where they are, and where their phase ends.
      guidance: w.
      text: captions.
      target: what the target network says of the phase's end.
      critic_time: s, at which the discriminator looks.
      fresh: noise that carries the student's answer there.
      real: data at s, with noise of its own.
    """

    state: jax.Array
    time: jax.Array
    edge: jax.Array
    guidance: jax.Array
    text: jax.Array
    target: jax.Array
    critic_time: jax.Array
    fresh: jax.Array
    real: jax.Array


@frozen_tree("teacher", "clips")
class DistillationTask(TeacherTask):
    """A student to distil from a frozen teacher (MotionPCM section 4.2 and Algorithm 1).

    Weights have the branches "student" and, with a discriminator, "discriminator". The loop's moving average of the
    student is the target network. Both losses are taken at the weights before a step, as in Algorithm 1, whose line 15
    looks at what the student of line 10 said; one step for both is therefore that algorithm's three updates.

    Attributes:
      teacher: its frozen weights; the config of the network and the schedule are the teacher's as well.
    """

    name = recipe = "student"

    teacher: Any

    def __post_init__(self):
        if self.config.ema_decay is None:
            raise ValueError("a student's target is its moving average: set ema_decay, 0 for the student itself")

    @classmethod
    def of(cls, asked: Asked, split: str | None) -> DistillationTask:
        """Return the distillation from a finished teacher, on the latents of a split's clips."""
        teacher, fingerprint = asked.before, f"{asked.data.fingerprint} on {weights_digest(asked.before.params)}"
        given = teacher.config, asked.config, _latents(asked, split), teacher.schedule, teacher.params
        return cls(*given, dataset_fingerprint=fingerprint)

    def kept(self, asked: Asked, state: TrainingState, about: dict) -> LatentModel:
        """Return the trained student itself: its moving average was its target."""
        made = {"config": self.student_config, "params": state.params["student"]}
        return dataclasses.replace(asked.before, **made, **asked.told(), **about)

    @property
    def student_config(self) -> motionpcm.LatentDenoiserConfig:
        """The student's network: the teacher's, told the guidance."""
        return motionpcm.student_config(self.model_config)

    @property
    def critic_config(self) -> motionpcm.DiscriminatorConfig:
        """The discriminator's heads."""
        return motionpcm.DiscriminatorConfig(latent_width=self.model_config.latent_width, depth=self.model_config.depth)

    @property
    def phases(self) -> phases.Phases:
        """Solver points and phases."""
        return phases.cut_phases(len(self.schedule.levels), self.config.skip, self.config.num_phases)

    @property
    def optimiser(self) -> optax.GradientTransformation:
        """AdamW for the student and another one for the heads, in every step or by turns: even steps are the heads'."""
        config = self.config
        parts = {"student": config.optimiser()}
        if config.adversarial_weight:
            parts["discriminator"] = config.optimiser(config.discriminator_rate, first_moment=0.0)
        if config.alternate:
            turn = {"discriminator": lambda step: step % 2 == 0, "student": lambda step: step % 2 == 1}
            parts = {name: optax.conditionally_mask(part, turn[name]) for name, part in parts.items()}
        branch = lambda params: jax.tree_util.tree_map_with_path(lambda path, _: path[0].key, params)
        return optax.partition(parts, branch)

    def init(self, key):
        """Return the teacher's weights as the student's, and fresh heads."""
        key_student, key_critic = jax.random.split(key)
        teacher = network_with(self.model_config, self.teacher)
        params = {"student": nnx.state(motionpcm.student_of(teacher, key_student))}
        if self.config.adversarial_weight:
            params["discriminator"] = nnx.state(build_from_config(self.critic_config, key_critic))
        return params, None

    def draw(self, state: TrainingState, key):
        """Draw latents, captions, points, guidance and noises, and ask teacher and target; no gradient comes here."""
        key_clips, key_batch = jax.random.split(key)
        clips = self.clips.draw(key_clips, self.config.batch_size)
        return self.questions(state.ema["student"], *clips, key_batch), key_batch

    def questions(self, target_params, latent, text, key) -> DistillationBatch:
        """Return what a student is asked about clean latents, with the target's answers (Algorithm 1, lines 5-11)."""
        config, cut, schedule = self.config, jax.tree.map(jnp.asarray, self.phases), self.schedule
        key_point, key_noise, key_guidance, key_critic, key_real, key_fresh = jax.random.split(key, 6)
        size = len(latent)
        point = jax.random.randint(key_point, (size,), 0, len(cut.times))
        time, before, phase = cut.times[point], cut.before[point], cut.phase[point]
        edge = cut.edges[phase]
        noise = jax.random.normal(key_noise, latent.shape)
        state = phases.noised(schedule, latent, noise, time)
        limits = {"minval": config.least_guidance, "maxval": config.most_guidance}
        guidance = jax.random.uniform(key_guidance, (size,), **limits)

        teacher = network_with(self.model_config, self.teacher)
        empty = jnp.broadcast_to(self.clips.empty, text.shape)
        conditional, unconditional = (teacher(state, time, teacher.encode(told)) for told in (text, empty))
        solved = phases.jump(schedule, state, phases.guided_noise(conditional, unconditional, guidance), time, before)
        target = network_with(self.student_config, target_params)
        eps = target(solved, before, target.encode(text), guidance)
        end = self._end(phases.target_end, solved, eps, before, edge)
        critic_time = jax.random.randint(key_critic, (size,), edge, cut.edges[phase + 1] + 1)
        real = phases.noised(schedule, latent, jax.random.normal(key_real, latent.shape), critic_time)
        fresh = jax.random.normal(key_fresh, latent.shape)
        return DistillationBatch(state, time, edge, guidance, text, end, critic_time, fresh, real)

    def terms(self, params, batch, key, training=True) -> dict:
        """Return the student's loss (MotionPCM Eq. 14) and the heads', for a branch each.

        Args:
          params: weights by branch.
          batch: a `DistillationBatch`; out of training (latents, captions) of other clips, and the weights, which are
            the moving average, answer against themselves.
          key: of what such clips are asked.
          training: whether this is a step of training.
        """
        config, schedule = self.config, self.schedule
        if not training:
            batch = self.questions(params["student"], *batch, key)
        student = network_with(self.student_config, params["student"])
        eps = student(batch.state, batch.time, student.encode(batch.text), batch.guidance)
        end = self._end(phases.jump, batch.state, eps, batch.time, batch.edge)
        loss = jnp.mean(phases.pseudo_huber(end - jax.lax.stop_gradient(batch.target), config.huber_width))
        terms = {"consistency": loss}
        if config.adversarial_weight:
            fake = phases.noise_travel(schedule, end, batch.edge, batch.critic_time, batch.fresh)
            frozen = jax.lax.stop_gradient(params["discriminator"])
            adversarial = jnp.mean(jax.nn.relu(1.0 - self.scores(frozen, fake, batch)))
            real, made = (
                self.scores(params["discriminator"], jax.lax.stop_gradient(seen), batch) for seen in (batch.real, fake)
            )
            terms |= {"adversarial": adversarial, "discriminator": phases.hinge(real, made)}
            # The heads' own loss has no weight: each branch is moved by its own optimiser.
            loss = loss + config.adversarial_weight * adversarial + terms["discriminator"]
        return {"loss": loss, **terms}

    def _end(self, jump, state, eps, time, edge):
        """Return what a noise estimate says of the data, or by `jump` of the phase's end."""
        if self.config.consistency == "latent":
            return phases.latent_consistency_end(self.schedule, state, eps, time)
        return jump(self.schedule, state, eps, time, edge)

    def scores(self, heads, state, batch: DistillationBatch):
        """Return the discriminator's scores of states at `critic_time` under the captions, high for data."""
        teacher = network_with(self.model_config, self.teacher)
        critic = network_with(self.critic_config, heads)
        return critic(teacher.features(state, batch.critic_time, teacher.encode(batch.text)))
