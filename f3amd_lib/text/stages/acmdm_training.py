"""What ACMDM trains: the autoencoder, the denoiser of text and motion in all its forms, the control branch.

Each is a task of `training.optimise`; its data are arrays on the device. The paper's settings and ours stand in
`papers/acmdm/recipes.toml`.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import nnx

from f3amd_lib.diffusion.flow import network_time
from f3amd_lib.diffusion.predictions import clean_estimate, prediction_target
from f3amd_lib.diffusion.schedules import NoiseSchedule
from f3amd_lib.ground.arrays import in_batches
from f3amd_lib.ground.trees import weights_digest
from f3amd_lib.networks import presets
from f3amd_lib.text.data.body import make_body
from f3amd_lib.text.data.body_mesh import BodyMesh, standing
from f3amd_lib.text.data.text_motions import ClipTable, TextMotions, clip_table, draw_clips, pad_motions
from f3amd_lib.text.networks.acmdm import (
    Control,
    ControlBranch,
    MaskedACMDM,
    TextCondition,
    branch_with,
    control_branch,
    controlled,
    draw_hidden,
    spoil,
)
from f3amd_lib.text.networks.autoencoders import smooth_l1, variational_loss
from f3amd_lib.text.stages.text_models import PELVIS, Asked, ClipsTask, MotionCodec, TextModel, controlled_joints
from f3amd_lib.training.checkpoints import network_with
from f3amd_lib.training.optimise import TrainingState, frozen_tree
from f3amd_lib.training.recipe import check_settings

_ENCODED_AT_ONCE = 64


@dataclass(frozen=True)
class TextMotionTraining:
    """How a part of ACMDM is trained (ACMDM section 4.1, App. B; defaults of the released code for the denoiser).

    Attributes:
      num_steps: optimiser steps in all.
      batch_size: motions a step.
      learning_rate: after the warm-up.
      schedule: "steps" multiplies the rate by `drop_factor` at each of `drops`; "warmup_cosine" (ours) lets it fall to
        a hundredth at the end, for short runs.
      warmup_steps: of a linear rise from 0.
      drops, drop_factor: of "steps".
      weight_decay: of AdamW, whose betas are 0.9 and 0.99.
      gradient_clip: largest global gradient norm; 0 clips nothing (released code: 1 for the variational autoencoder).
      ema_decay: moving average of the weights; None keeps none.
      text_dropout: share of samples whose caption is the zero vector.
      control_dropout: share of samples whose control is dropped.
      control_weight: of the distance from the control points, m^2, in the control branch's loss.
      prefix_frames: frames of the state that are given clean (prefix autoregression); 0: none.
      unit: lengths are multiples of so many frames of the state: 1 of the latent, 4 of motion (released code).
      window: frames of a training window of the autoencoder; 1 for meshes.
      seed: of initial weights and batches.

    Raises:
      ValueError: for a number out of its range or an unknown schedule.
    """

    paper: ClassVar[str] = "acmdm"

    num_steps: int
    batch_size: int = 64
    learning_rate: float = 2e-4
    schedule: str = "steps"
    warmup_steps: int = 2000
    drops: tuple[int, ...] = (50_000,)
    drop_factor: float = 0.1
    weight_decay: float = 1e-5
    gradient_clip: float = 0.0
    ema_decay: float | None = 0.9999
    text_dropout: float = 0.1
    control_dropout: float = 0.1
    control_weight: float = 1.0
    prefix_frames: int = 0
    unit: int = 1
    window: int = 64
    seed: int = 3407

    def __post_init__(self):
        object.__setattr__(self, "drops", tuple(self.drops))  # files have lists
        check_settings(self)

    def rate(self, step):
        """Return the learning rate of a step."""
        warm = jnp.minimum(1.0, (step + 1) / self.warmup_steps)
        if self.schedule == "warmup_cosine":
            share = jnp.clip((step - self.warmup_steps) / max(1, self.num_steps - self.warmup_steps), 0.0, 1.0)
            return self.learning_rate * warm * (0.01 + 0.99 * 0.5 * (1.0 + jnp.cos(jnp.pi * share)))
        passed = sum(step >= drop for drop in self.drops)
        return self.learning_rate * warm * self.drop_factor**passed

    def optimiser(self) -> optax.GradientTransformation:
        """Return AdamW, after clipping where it asks for it."""
        adam = optax.adamw(self.rate, b1=0.9, b2=0.99, weight_decay=self.weight_decay)
        return optax.chain(optax.clip_by_global_norm(self.gradient_clip), adam) if self.gradient_clip else adam


# -------------------------------------------------------------------------------------------------------------- states


def _whole_states(codec: MotionCodec, data: TextMotions) -> list[np.ndarray]:
    """Return the normalised positions of each clip, as many as make whole frames of the state."""
    frames = codec.frames_per_state
    clips = (data.clip(number) for number in range(data.num_clips))
    return [codec.axes.normalise(clip[: len(clip) // frames * frames]) for clip in clips]


def encoded_clips(codec: MotionCodec, data: TextMotions) -> np.ndarray:
    """Return all clips as states, one after the other, [N / frames of a state, J, C]."""
    frames, clips = codec.frames_per_state, _whole_states(codec, data)
    if codec.redundancy is not None:
        return np.concatenate([np.concatenate(clips), codec.redundancy.normalise(data.joint_features())], axis=-1)
    if codec.autoencoder is None:
        return np.concatenate(clips)
    encode, longest = jax.jit(lambda codec, motion, _, mask, __: codec.encode(motion, mask)), max(map(len, clips))
    if codec.mesh is not None:  # frames do not see each other: nothing is padded
        whole = np.concatenate(clips)
        return np.asarray(encode(codec, *pad_motions([whole], len(whole))))[0]
    of_rows = lambda rows: encode(codec, *pad_motions([clips[row] for row in rows], longest))
    states = in_batches(of_rows, len(clips), _ENCODED_AT_ONCE)
    return np.concatenate([state[: len(clip) // frames] for state, clip in zip(states, clips, strict=True)])


def _captioned_states(asked: Asked, split: str | None):
    """Return (clips of a split as states, pooled embeddings of their captions)."""
    codec, part = asked.codec, asked.part(split)
    table, captions = clip_table(part, encoded_clips(codec, part), codec.frames_per_state)
    return table, asked.pooled(captions)


def first_frames(codec: MotionCodec, data: TextMotions, count: int) -> dict[str, np.ndarray]:
    """Return the first frames of one clip of each pair of content and style, by its first caption, as states.

    Args:
      codec: of the states.
      data: captioned clips.
      count: frames of the state, P; 0 returns nothing.

    Returns:
      [P, J, C] each.
    """
    if not count:
        return {}
    frames = count * codec.frames_per_state
    shown = {data.pairs[number]: number for number in reversed(np.flatnonzero(data.lengths >= frames))}.values()
    clips = jnp.asarray(np.stack([codec.axes.normalise(data.clip(number)[:frames]) for number in shown]))
    states = np.asarray(codec.encode(clips, jnp.ones(clips.shape[:2], bool)))
    return {data.captions[number][0]: state for number, state in zip(shown, states, strict=True)}


# --------------------------------------------------------------------------------------------------------- autoencoder


@frozen_tree("clips")
class AutoencoderTask(ClipsTask):
    """A motion autoencoder to train on windows of clips that are long enough; clips are normalised positions."""

    name = part = recipe = "autoencoder"
    settings = TextMotionTraining

    @classmethod
    def of(cls, asked: Asked, split: str | None) -> AutoencoderTask:
        """Return the training on the clips of a split; ValueError for clips that are too short."""
        longest, config = asked.part(split).lengths.max(), asked.config
        if longest < config.window:
            what = f"no {split or 'train'} clip has {config.window} frames, the longest {longest}; a larger --window?"
            raise ValueError(f"data set {asked.data.name!r}: {what}")
        return cls(presets.build_config(asked.preset.name), config, **cls._clips(asked, split))

    @staticmethod
    def _clips(asked: Asked, split: str | None) -> dict:
        part = asked.part(split)
        table, _ = clip_table(part, asked.codec.axes.normalise(part.positions))
        return {"clips": table, "dataset_fingerprint": asked.data.fingerprint}

    def kept(self, asked: Asked, state: TrainingState, about: dict) -> TextModel:
        """Return the trained autoencoder, its latent normalised over up to 512 training clips."""
        part = asked.data.members("train")
        part = part[np.linspace(0, len(part) - 1, min(512, len(part))).astype(int)]
        frames, codec = self.model_config.frames_per_latent, getattr(self, "codec", asked.codec)
        clips = [codec.axes.normalise(asked.data.clip(number)) for number in part]
        motion, _, mask, _ = pad_motions(clips, max(map(len, clips)) // frames * frames)
        return TextModel(codec=codec.with_latent(self.model_config, state.averaged, motion, mask), **about)

    def draw(self, state: TrainingState, key):
        """Draw windows [B, window, J, 3] from clips of at least that length."""
        key_clip, key_start, key_loss = jax.random.split(key, 3)
        size, window, clips = (self.config.batch_size,), self.config.window, self.clips
        clip = jax.random.categorical(key_clip, jnp.where(clips.length >= window, 0.0, -jnp.inf), shape=size)
        first = clips.start[clip] + jax.random.randint(key_start, size, 0, clips.length[clip] - window + 1)
        return clips.frames[first[:, None] + jnp.arange(window)], key_loss

    def held_out(self):
        """Return windows and their mask, to watch the losses on."""
        windows, _ = self.draw(None, jax.random.key(0))
        return windows, jnp.ones(windows.shape[:2], bool)

    def terms(self, params, batch, key, training=True) -> dict:
        """Return smooth L1, and as the loss it or the variational loss (ACMDM App. B).

        Args:
          params: weights.
          batch: what `draw` drew; out of training, without dropout, whole clips: (positions, mask).
          key: of dropout and latent.
          training: whether this is a step of training.
        """
        model = network_with(self.model_config, params)
        if not training:
            positions, mask = batch
            latent_mask = mask[:, :: self.model_config.frames_per_latent]
            loss = smooth_l1(model.decode(model.latent_of(positions, mask), latent_mask), positions, mask)
            return {"loss": loss, "smooth_l1": loss}
        encoded = model.encode(batch, key=jax.random.fold_in(key, 2))
        if not self.model_config.variational:
            error = smooth_l1(model.decode(encoded, key=jax.random.fold_in(key, 3)), batch)
            return {"loss": error, "smooth_l1": error}
        mean, log_variance = model.moments(encoded)
        latent = mean + jnp.exp(0.5 * log_variance) * jax.random.normal(jax.random.fold_in(key, 1), mean.shape)
        positions_hat = model.decode(latent, key=jax.random.fold_in(key, 3))
        loss = variational_loss(positions_hat, batch, mean, log_variance)
        return {"loss": loss, "smooth_l1": smooth_l1(positions_hat, batch)}


@frozen_tree("clips", "codec")
class MeshAutoencoderTask(AutoencoderTask):
    """A mesh autoencoder to train on frames, one of each clip that is drawn.

    Attributes:
      codec: of positions, with the mesh whose vertices they move.
    """

    name, recipe = "mesh autoencoder", "mesh-autoencoder"

    codec: MotionCodec

    @classmethod
    def of(cls, asked: Asked, split: str | None) -> MeshAutoencoderTask:
        """Return the training on the clips of a split."""
        # The body stands as people do when clips begin: those of training, whatever the split.
        data = asked.data
        rest = standing(data.skeleton, data.positions[data.start[data.members("train")]])
        network = {**asked.preset.network, "num_vertices": len(make_body(rest).vertices)}
        model = presets.build_config(asked.preset.name, **network)
        codec = dataclasses.replace(asked.codec, mesh=BodyMesh.of(rest, model.levels, **model.neighbours))
        return cls(model, asked.config, codec=codec, **cls._clips(asked, split))

    def terms(self, params, batch, key, training=True) -> dict:
        """Return L1, summed over a frame, mean over frames (ACMDM's released code); arguments as above."""
        clips = batch if training else batch[0]
        model, lists = network_with(self.model_config, params), self.codec.mesh.lists
        vertices = self.codec.vertices_of(clips[:, 0])
        distance = jnp.abs(model.decode(model.encode(vertices, lists), lists) - vertices)
        return {"loss": jnp.sum(distance) / len(clips)}


# ------------------------------------------------------------------------------------------------------------ denoiser


def frame_error(prediction, target, counted):
    """Return the squared error, mean over joints and channels, then over all frames of the batch that count.

    Args:
      prediction, target: [B, l, J, C].
      counted: [B, l].
    """
    error = jnp.mean((prediction - target) ** 2, axis=(2, 3))
    return jnp.sum(error * counted) / jnp.maximum(1, counted.sum())


def noisy_state(key, schedule: NoiseSchedule, x0, noise, block_frames: int = 0):
    """Return (alpha x0 + sigma noise, t, alpha, sigma) at random times (ACMDM Eqs 1 and 2).

    Args:
      key: JAX random key.
      schedule: what the times are of.
      x0, noise: [B, l, J, C].
      block_frames: frames of a block with a time of its own; 0: a sample has one time.

    Returns:
      The state; t [B], or [B, l] for blocks; alpha and sigma, which broadcast against the state.
    """
    batch, frames = x0.shape[:2]
    if block_frames:
        t = schedule.draw_times(key, (batch, -(-frames // block_frames)))
        t = jnp.repeat(t, block_frames, axis=1)[:, :frames]
    else:
        t = schedule.draw_times(key, (batch,))
    spread = t.reshape(*t.shape, *[1] * (x0.ndim - t.ndim))
    return schedule.perturb(x0, noise, spread), t, schedule.alpha(spread), schedule.sigma(spread)


def denoising_loss(network, schedule: NoiseSchedule, x0, condition: TextCondition, key, *, prefix_frames: int = 0):
    """Return the loss of a denoiser of any form (ACMDM section 3.1 and App. G).

    Args:
      network: its config says what it predicts. With `block_frames` every block has a time of its own; a masked
        network denoises the frames that are hidden from it.
      schedule: noise schedule.
      x0: clean states, [B, l, J, C].
      condition: captions and which frames are motion.
      key: of times, noise and masks.
      prefix_frames: frames that are given clean in front, and count for nothing.
    """
    config, mask = network.config, condition.mask
    key_time, key_noise, key_hidden, key_spoil = jax.random.split(key, 4)
    noise = jax.random.normal(key_noise, x0.shape)
    state, t, *_ = noisy_state(key_time, schedule, x0, noise, config.block_frames)
    context, counted = network.encode(condition), mask
    if prefix_frames:
        given = jnp.arange(x0.shape[1]) < prefix_frames
        state, counted = jnp.where(given[:, None, None], x0, state), mask & ~given
    if isinstance(network, MaskedACMDM):
        counted = draw_hidden(key_hidden, mask)
        context = network.look(*spoil(key_spoil, x0, counted), context)
    prediction = network(state, network_time(schedule, t), context)
    return frame_error(prediction, prediction_target(config.objective, x0, noise), counted)


def draw_captioned(key, clips: ClipTable, pooled, config: TextMotionTraining, window: int):
    """Draw (clips, condition): a caption is one of the clip's own, or none for a share of the samples.

    Args:
      key: JAX random key.
      clips: motions as states, with the rows of their captions.
      pooled: embeddings of all captions, [C, W].
      config: how many are drawn, and how often without a caption.
      window: most frames of a state.
    """
    key_clip, key_told = jax.random.split(key)
    batch = draw_clips(key_clip, clips, config.batch_size, window, config.unit)
    told = jax.random.bernoulli(key_told, 1.0 - config.text_dropout, batch.length.shape)
    return batch, TextCondition(jnp.where(told[:, None], pooled[batch.caption], 0.0), batch.mask)


@frozen_tree("clips", "pooled")
class TextMotionTask(ClipsTask):
    """A denoiser of text and motion to train, an `ACMDM` or a `MaskedACMDM`.

    Clips are positions or latents, [N, J, C] in network units.

    Attributes:
      schedule: the noise schedule of its preset.
      pooled: embeddings of the clips' captions, [C, W].
    """

    name, part, recipe = "text and motion", "denoiser", "denoiser"
    settings = TextMotionTraining

    schedule: NoiseSchedule
    pooled: Any

    @classmethod
    def of(cls, asked: Asked, split: str | None) -> TextMotionTask:
        """Return the training on the clips of a split; ValueError for states of other channels than the preset's."""
        (table, pooled), codec, preset = _captioned_states(asked, split), asked.codec, asked.preset
        sizes = {"num_joints": table.frames.shape[1], "text_width": pooled.shape[-1]}
        if asked.window:
            sizes["window"] = asked.window // codec.frames_per_state
        model = presets.build_config(preset.name, **sizes)
        if (channels := table.frames.shape[-1]) != model.channels:
            raise ValueError(f"{preset.name} models {model.channels} numbers a joint; positions have {channels}")
        fingerprint = asked.data.fingerprint
        if codec.autoencoder is not None:
            fingerprint += f" in the latent of {weights_digest(codec.params)}"
        return cls(model, asked.config, table, preset.diffusion, pooled, dataset_fingerprint=fingerprint)

    def kept(self, asked: Asked, state: TrainingState, about: dict) -> TextModel:
        """Return the trained denoiser: its moving average."""
        starts = first_frames(asked.codec, asked.part("train"), self.config.prefix_frames)
        made = {"config": self.model_config, "params": state.averaged, "schedule": self.schedule}
        return TextModel(codec=asked.codec, starts=starts, **made, **asked.told(), **about)

    def draw(self, state: TrainingState, key):
        """Draw (states, condition) and the key of the loss."""
        key_draw, key_loss = jax.random.split(key)
        batch, condition = draw_captioned(key_draw, self.clips, self.pooled, self.config, self.model_config.window)
        return (batch.motion, condition), key_loss

    def held_out(self):
        """Return a batch to watch the losses on."""
        return self.draw(None, jax.random.key(0))[0]

    def terms(self, params, batch, key, training=True) -> dict:
        """Return the loss on a batch as `draw` makes it."""
        network = network_with(self.model_config, params)
        return {"loss": denoising_loss(network, self.schedule, *batch, key, prefix_frames=self.config.prefix_frames)}


# ------------------------------------------------------------------------------------------------------ control branch


def draw_control(key, positions, mask, joints) -> Control:
    """Draw what is controlled in training: one joint a sample, in 1 to L - 1 of its L frames (ACMDM section 3.2).

    Args:
      key: JAX random key.
      positions, mask: normalised motion [B, L, J, 3] and its frames [B, L].
      joints: numbers of the joints that may be controlled.
    """
    key_joint, key_count, key_order = jax.random.split(key, 3)
    batch, _, num_joints, _ = positions.shape
    joint = jax.random.choice(key_joint, jnp.asarray(joints), (batch,))
    count = jax.random.randint(key_count, (batch,), 1, jnp.maximum(2, mask.sum(axis=1)))
    order = jnp.where(mask, jax.random.uniform(key_order, mask.shape), 2.0)
    chosen = mask & (jnp.argsort(jnp.argsort(order, axis=1), axis=1) < count[:, None])
    return Control.of(positions, chosen[..., None] & (jnp.arange(num_joints) == joint[:, None, None]))


def control_loss(
    base, branch: ControlBranch, schedule: NoiseSchedule, codec: MotionCodec, x0, positions, condition, control, key
):
    """Return {"denoising", "control"}: the base's own loss, and how far the answer is from the control points, m^2.

    The answer is decoded and compared in metres, mean over controlled coordinates. For a velocity it is noise +
    velocity, with the true noise (released code); for x0 and eps the clean estimate.

    Args:
      base, branch, schedule: networks and noise schedule.
      codec: between states and motion.
      x0, positions: clean states and normalised motion, whose mask is the condition's.
      condition, control: captions and frames; where joints should be.
      key: of time and noise.
    """
    key_time, key_noise = jax.random.split(key)
    noise, objective = jax.random.normal(key_noise, x0.shape), base.config.objective
    state, t, alpha, sigma = noisy_state(key_time, schedule, x0, noise)
    prediction = controlled(base, branch, condition, control)(state, network_time(schedule, t))
    denoising = frame_error(prediction, prediction_target(objective, x0, noise), condition.mask)
    x0_hat = noise + prediction if objective == "v" else clean_estimate(objective, prediction, state, alpha, sigma)
    motion_mask = jnp.repeat(condition.mask, codec.frames_per_state, axis=1)
    distance = codec.axes.restore(codec.decode(x0_hat, motion_mask)) - codec.axes.restore(positions)
    square = jnp.sum(distance**2 * control.asked[..., None])
    return {"denoising": denoising, "control": square / jnp.maximum(1.0, 3.0 * control.asked.sum())}


@frozen_tree("clips", "pooled", "base", "codec")
class ControlTask(TextMotionTask):
    """A control branch to train beside a frozen denoiser, whose config and schedule it has.

    Clips are states as the denoiser was trained on, [N, J, C], and the normalised positions that each row stands for,
    [N, frames of a state, J, 3].

    Attributes:
      base: the denoiser's weights; no gradient reaches them.
      codec: between states and motion, frozen as well.
      joints: numbers of the joints that may be controlled.
    """

    name, recipe = "control branch", "control"

    base: Any
    codec: MotionCodec
    joints: tuple[int, ...]

    @classmethod
    def of(cls, asked: Asked, split: str | None) -> ControlTask:
        """Return the training beside a finished denoiser, on the clips of a split."""
        base, codec, frames = asked.before, asked.codec, asked.codec.frames_per_state
        table, pooled = _captioned_states(asked, split)
        positions = jnp.asarray(np.concatenate(_whole_states(codec, asked.part(split))), jnp.float32)
        positions = positions.reshape(len(table.frames), frames, *positions.shape[1:])
        joints = (0,) if asked.branch == PELVIS else tuple(controlled_joints(asked.data.skeleton).values())
        return cls(
            base.config, asked.config, table._replace(frames=(table.frames, positions)), base.schedule, pooled,
            base.params, codec, joints,
            dataset_fingerprint=f"{asked.data.fingerprint} beside {weights_digest(base.params)}",
        )  # fmt: skip

    def kept(self, asked: Asked, state: TrainingState, about: dict) -> TextModel:
        """Return the denoiser with its trained branch, told the guidance that it was told before."""
        guidance = {key: value for key, value in asked.before.record.items() if key == "guidance"}
        about = {"name": about["name"], "record": about["record"] | guidance}
        return dataclasses.replace(asked.before, branch=state.averaged, **about)

    def identity(self) -> dict:
        """Return all that decides the weights, as JSON has it."""
        identity = super().identity()
        return identity | {"model": identity["model"] | {"joints": {"of": self.joints}}}

    def init(self, key):
        """Return a branch whose blocks are the base's."""
        base = network_with(self.model_config, self.base)
        return nnx.state(control_branch(base, self.codec.frames_per_state, key)), None

    def draw(self, state: TrainingState, key):
        """Draw (states, positions, condition, control) and the key of the loss."""
        key_draw, key_control, key_drop, key_loss = jax.random.split(key, 4)
        batch, condition = draw_captioned(key_draw, self.clips, self.pooled, self.config, self.model_config.window)
        states, positions = batch.motion
        mask = jnp.repeat(condition.mask, self.codec.frames_per_state, axis=1)
        positions = positions.reshape(*mask.shape, *positions.shape[-2:])
        control = draw_control(key_control, positions, mask, self.joints)
        kept = jax.random.bernoulli(key_drop, 1.0 - self.config.control_dropout, batch.length.shape)
        return (states, positions, condition, control._replace(kept=kept.astype(states.dtype))), key_loss

    def terms(self, params, batch, key, training=True) -> dict:
        """Return the loss terms on a batch as `draw` makes it."""
        branch = branch_with(self.model_config, self.codec.frames_per_state, params)
        base = network_with(self.model_config, self.base)
        terms = control_loss(base, branch, self.schedule, self.codec, *batch, key)
        return {"loss": terms["denoising"] + self.config.control_weight * terms["control"], **terms}
