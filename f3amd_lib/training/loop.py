"""Training: optimiser, moving average, steps under one scan, exact resume (section 4.5).

The state is a value; `Trainer.run` advances it in chunks of jitted steps that draw their batches on
the device. Every random number of step k comes from the seed and k alone, so that a run that was
killed and resumed gives the same weights as one that was not.
"""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import nnx
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from tqdm import tqdm

from f3amd_lib.data.features import Normaliser, center_window, orthonormalise
from f3amd_lib.data.windows import (
    Batch,
    WindowSet,
    draw_windows,
    gather_windows,
    mean_poses,
    restart_from,
    spread_windows,
)
from f3amd_lib.diffusion.samplers import add_noise
from f3amd_lib.diffusion.schedules import NoiseSchedule, VarianceExploding, schedule_from_dict
from f3amd_lib.ground.names import nearest_hint, refuse_unknown
from f3amd_lib.motion.skeleton import Skeleton
from f3amd_lib.networks.conditioning import Condition
from f3amd_lib.networks.config import NetworkConfig
from f3amd_lib.networks.presets import build_from_config, find_preset
from f3amd_lib.training import parallel
from f3amd_lib.training.checkpoints import load_tree, save_tree
from f3amd_lib.training.losses import LossWeights, loss_terms, total_loss


class TrainingDiverged(ArithmeticError):
    """The loss stopped being a number; the message names the step, the term and the checkpoint."""


@dataclass(frozen=True)
class TrainingConfig:
    """How a network is trained; with the model's config, all that decides its weights.

    Attributes:
      num_steps: optimiser steps in all.
      batch_size: windows a step (paper: 512).
      learning_rate: peak value (paper: 5e-4).
      schedule: "inverse_square" is the paper's text, lr (1 + step / decay_steps)^-2;
        "inverse_sqrt" the usual reading of such schedules; "warmup_cosine" ours, for short runs.
      decay_steps: the paper's decay constant, 1e5.
      warmup_steps: of "warmup_cosine".
      ema_decay: moving average of the weights (paper: 0.993); what is evaluated and shipped.
      gradient_clip: largest global gradient norm; 0 clips nothing (the paper names none).
      noise: "schedule" draws levels as the schedule says (Eq. 9: t uniform); "mixed" (ours) draws
        every second sigma log-uniform between sigma_min and 1, where the noisy input says something
        that the condition does not; "log_normal" (ours) draws the logarithm from
        `LOG_NORMAL_SIGMA`, cut off at the ends of the schedule.
      noise_weighting: "uniform" weighs all noise levels alike; "low_noise" (ours) by
        1 + min(1 / sigma^2, 5), the weight of Karras et al. 2022 for a clean estimate, capped, and
        divided by its mean over the batch.
      history_noise: deviation, in network units, of noise added to the history in training (ours;
        0 in paper presets): rounds are started from generated frames, which are never quite real.
      history_dropout: share of samples whose history is set to 0 (CAMDM's code: 0.15; F3AMD
        mentions none).
      condition_dropout: share of samples that see no condition at all, history, path and style 0
        (ours; 0 in paper presets), so that only the noisy input can tell them what to make.
      captured_path_share: share of samples whose path condition is the captured root, sway and all;
        the rest see a smoothed one, as users draw them (CAMDM: 0.5).
      own_history_share: share of samples that start from the network's own last frames of the
        window before, made in one step without gradient, instead of captured ones (ours; 0 in
        paper presets). Without it small losses of swing add up over rounds until nobody walks.
        It rises from 0 between 10 and 40 % of the run, when there is something to learn from.
      history_damping: share of samples whose history is pulled towards the mean pose of its style,
        by a random amount, while the target soon returns to what was captured (ours; 0 in paper
        presets): the same remedy, for histories that have lost the swing of more than one round.
      loss: weights of the loss terms.
      diffusion: the noise schedule (section 4.5).
      seed: of initial weights and batches.

    Raises:
      ValueError: for an unknown schedule or noise name, or sizes that are not positive.
    """

    num_steps: int
    batch_size: int = 512
    learning_rate: float = 5e-4
    schedule: str = "inverse_square"
    decay_steps: float = 1e5
    warmup_steps: int = 200
    ema_decay: float = 0.993
    gradient_clip: float = 0.0
    noise: str = "schedule"
    noise_weighting: str = "uniform"
    history_noise: float = 0.0
    history_dropout: float = 0.0
    condition_dropout: float = 0.0
    captured_path_share: float = 0.5
    own_history_share: float = 0.0
    history_damping: float = 0.0
    loss: LossWeights = field(default_factory=LossWeights)
    diffusion: NoiseSchedule = field(default_factory=VarianceExploding)
    seed: int = 0

    def __post_init__(self):
        if self.schedule not in ("inverse_square", "inverse_sqrt", "warmup_cosine"):
            raise ValueError(
                f"unknown learning-rate schedule {self.schedule!r}: use 'inverse_square', "
                "'inverse_sqrt' or 'warmup_cosine'"
            )
        for name, known in (
            ("noise", ("schedule", "mixed", "log_normal")),
            ("noise_weighting", ("uniform", "low_noise")),
        ):
            if getattr(self, name) not in known:
                value = getattr(self, name)
                raise ValueError(f"unknown {name} {value!r}{nearest_hint(value, known)}")
        for name in ("num_steps", "batch_size", "warmup_steps"):
            if type(getattr(self, name)) is not int or getattr(self, name) < 1:
                raise ValueError(f"{name} must be positive and whole: {getattr(self, name)!r}")
        for name in ("learning_rate", "decay_steps"):
            if not 0 < getattr(self, name) < math.inf:
                raise ValueError(f"{name} must be positive and finite, got {getattr(self, name)!r}")
        for name in ("gradient_clip", "history_noise"):
            if not 0 <= getattr(self, name) < math.inf:
                raise ValueError(f"{name} must be 0 or more, got {getattr(self, name)!r}")
        if self.noise != "schedule" and not (
            isinstance(self.diffusion, VarianceExploding) and self.diffusion.sigma_min < 1.0
        ):
            raise ValueError(
                f"{self.noise} noise needs a variance-exploding schedule with sigma_min below 1, got {self.diffusion!r}"
            )
        shares = ("history_dropout", "condition_dropout", "captured_path_share", "own_history_share", "history_damping")
        for name in shares:
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise ValueError(f"{name} must be in [0, 1], got {getattr(self, name)!r}")
        if not 0.0 <= self.ema_decay < 1.0:
            raise ValueError(f"ema_decay must be in [0, 1), got {self.ema_decay!r}")

    def to_dict(self) -> dict:
        """Return the fields as JSON-ready values."""
        return dataclasses.asdict(self)

    @classmethod
    def from_dict(cls, values: dict) -> TrainingConfig:
        """Build a config from `to_dict`; an unknown key is an error that names the nearest."""
        refuse_unknown(values, cls, "training setting")
        values = dict(values)
        if isinstance(values.get("loss"), dict):
            refuse_unknown(values["loss"], LossWeights, "loss setting")
            values["loss"] = LossWeights(**values["loss"])
        if isinstance(values.get("diffusion"), dict):
            values["diffusion"] = schedule_from_dict(values["diffusion"])
        return cls(**values)


def paper_recipe(preset: str, num_steps: int, **settings) -> TrainingConfig:
    """Return how the paper trains a preset (section 4.5), but for the number of steps.

    Args:
      preset: see `presets.find_preset`; its own noise, losses and remedies are in it.
      num_steps: optimiser steps.
      **settings: fields of `TrainingConfig` to change.
    """
    found = find_preset(preset)
    return TrainingConfig.from_dict(
        {"num_steps": num_steps, "diffusion": found.diffusion, **found.training, **settings}
    )


def short_recipe(preset: str, num_steps: int, **settings) -> TrainingConfig:
    """Return how a preset is trained in a run far shorter than the paper's 100 epochs.

    As `paper_recipe`, with a warm-up and a cosine from a higher rate, which short runs need (the
    paper's schedule is `TrainingConfig`'s default).

    Args:
      preset, num_steps, **settings: as for `paper_recipe`.
    """
    short = {
        "batch_size": 128,
        "learning_rate": 2e-3,
        "schedule": "warmup_cosine",
        "warmup_steps": max(1, min(200, num_steps // 10)),
        "gradient_clip": 1.0,
    }
    return paper_recipe(preset, num_steps, **{**short, **settings})


def learning_rate_schedule(config: TrainingConfig) -> optax.Schedule:
    """Return learning rate against step (section 4.5: "inverse-square")."""
    if config.schedule == "warmup_cosine":
        return optax.warmup_cosine_decay_schedule(
            0.0,
            config.learning_rate,
            min(config.warmup_steps, config.num_steps - 1),
            config.num_steps,
            0.01 * config.learning_rate,
        )
    power = {"inverse_square": -2.0, "inverse_sqrt": -0.5}[config.schedule]
    return lambda step: config.learning_rate * (1.0 + step / config.decay_steps) ** power


class TrainingState(NamedTuple):
    """All that changes in training.

    Attributes:
      params: weights.
      ema: their moving average.
      optimiser: optax state.
      step: steps done, int32 scalar.
    """

    params: Any
    ema: Any
    optimiser: Any
    step: jax.Array


def network_inputs(batch: Batch, normaliser: Normaliser) -> tuple[jax.Array, Condition]:
    """Return (x0, condition) of a batch in network units."""
    condition = Condition(
        history=normaliser.normalise(batch.history), path=normaliser.normalise_path(batch.path), style=batch.style
    )
    return normaliser.normalise(batch.future), condition


def draw_sigma(key, batch_size: int, config: TrainingConfig):
    """Draw the noise level of each sample, [B], as `config.noise` says (Eqs 8 and 9)."""
    key_time, key_low, key_choice = jax.random.split(key, 3)
    sigma = config.diffusion.draw(key_time, (batch_size,))
    if config.noise == "mixed":
        log_low = jax.random.uniform(key_low, (batch_size,), minval=np.log(config.diffusion.sigma_min), maxval=0.0)
        low = jax.random.bernoulli(key_choice, 0.5, (batch_size,))
        sigma = jnp.where(low, jnp.exp(log_low), sigma)
    if config.noise == "log_normal":
        mean, deviation = LOG_NORMAL_SIGMA
        log_sigma = mean + deviation * jax.random.normal(key_low, (batch_size,))
        sigma = jnp.clip(jnp.exp(log_sigma), config.diffusion.sigma_min, config.diffusion.sigma_max)
    return sigma


LOG_NORMAL_SIGMA = (-1.2 + math.log(2.0), 1.2)
"""Mean and deviation of ln sigma: Karras et al. 2022, Table 1, for features of deviation 1 where
theirs have 0.5."""


def noise_weights(sigma, config: TrainingConfig):
    """Return what each sample counts in the loss, [B], mean 1, or None where all count alike."""
    if config.noise_weighting == "uniform":
        return None
    weights = 1.0 + jnp.minimum(sigma**-2.0, 5.0)
    return weights / weights.mean()


class Trainer:
    """Trains one network on one window set.

    Args:
      model_config: the network.
      config: how to train it.
      skeleton: for the kinematic losses.
      normaliser: of the training windows (replaced by the identity if the model wants none).
      windows: training windows on the device.
      dataset_fingerprint: of the data they come from; a state of other data is not resumed.
      mesh: devices to spread each batch over (`parallel.all_devices`); by default one does it all.

    Raises:
      ValueError: if the devices cannot share a batch equally.
    """

    def __init__(
        self,
        model_config: NetworkConfig,
        config: TrainingConfig,
        skeleton: Skeleton,
        normaliser: Normaliser,
        windows: WindowSet,
        *,
        dataset_fingerprint: str = "",
        mesh: Mesh | None = None,
    ):
        parallel.check_batch(config.batch_size, mesh)
        self.dataset_fingerprint, self.mesh = dataset_fingerprint, mesh
        self.model_config, self.config, self.skeleton = model_config, config, skeleton
        if not model_config.normalise:
            normaliser = Normaliser.identity(model_config.channels)
        self.normaliser, self.windows = normaliser, parallel.replicate(windows, mesh)
        self.mean_poses = mean_poses(windows)
        model = nnx.eval_shape(lambda: build_from_config(model_config, jax.random.key(0)))
        self.graph = nnx.graphdef(model)
        steps = [optax.adam(learning_rate_schedule(config))]
        if config.gradient_clip > 0:
            steps.insert(0, optax.clip_by_global_norm(config.gradient_clip))
        self.optimiser = optax.chain(*steps)
        everywhere = None if mesh is None else NamedSharding(mesh, PartitionSpec())
        self._chunk = jax.jit(self._run_chunk, static_argnames="length", donate_argnums=0, out_shardings=everywhere)
        self._evaluate = jax.jit(self._held_out_terms, static_argnames="num_samples")

    def initial_state(self) -> TrainingState:
        """Return the state before the first step."""
        key = jax.random.fold_in(jax.random.key(self.config.seed), 0)

        @jax.jit
        def build(key):
            params = nnx.state(build_from_config(self.model_config, key))
            return params, self.optimiser.init(params)

        params, optimiser = build(key)
        ema = jax.tree.map(jnp.copy, params)
        state = TrainingState(params, ema, optimiser, jnp.zeros((), jnp.int32))
        return parallel.replicate(state, self.mesh)

    def model(self, params):
        """Return a network with the given weights (use the state's `ema`)."""
        # A fresh tree, so that editing the network leaves the given weights alone.
        return nnx.merge(self.graph, jax.tree.map(lambda leaf: leaf, params))

    def _loss(self, params, batch: Batch, sigma, key, training: bool = False):
        key_noise, key_history, key_dropout = jax.random.split(key, 3)
        x0, condition = network_inputs(batch, self.normaliser)
        if training:
            condition = self._disturbed(condition, key_history)
        noise = jax.random.normal(key_noise, x0.shape)
        model = self.model(params)
        x_noisy = add_noise(x0, sigma[:, None, None], noise)
        drops = training and self.model_config.dropout > 0
        x0_hat = model(x_noisy, sigma, model.encode(condition), key=key_dropout if drops else None)
        terms = loss_terms(
            self.skeleton,
            x0_hat,
            x0,
            self.normaliser.denormalise(x0_hat),
            batch.future,
            batch.history[:, -1],
            self.config.loss.ird_form,
            noise_weights(sigma, self.config) if training else None,
        )
        loss = total_loss(terms, self.config.loss)
        return loss, {"loss": loss, **terms}

    def _disturbed(self, condition: Condition, key) -> Condition:
        """Add noise to the history, or take it away, as the config says."""
        config, history = self.config, condition.history
        key_noise, key_dropout = jax.random.split(key)
        if config.history_noise > 0:
            history = history + config.history_noise * jax.random.normal(key_noise, history.shape)
        if config.history_dropout > 0:
            size = (history.shape[0], 1, 1)
            kept = jax.random.bernoulli(key_dropout, 1.0 - config.history_dropout, size)
            history = jnp.where(kept, history, 0.0)
        condition = condition._replace(history=history)
        if config.condition_dropout > 0:
            share = 1.0 - config.condition_dropout
            kept = jax.random.bernoulli(jax.random.fold_in(key, 1), share, history.shape[:1])
            condition = jax.tree.map(
                lambda part: jnp.where(kept.reshape(-1, *[1] * (part.ndim - 1)), part, 0.0), condition
            )
        return condition

    def _training_batch(self, windows: WindowSet, state: TrainingState, key) -> Batch:
        """Draw a batch; where the recipe asks, start it from histories as a rollout meets them."""
        config, model_config = self.config, self.model_config
        key_draw, key_own, key_damping = jax.random.split(key, 3)
        drawn = draw_windows(windows, key_draw, config.batch_size, config.captured_path_share)
        frames = {"window": model_config.window, "num_history": model_config.num_history}
        batch = gather_windows(windows, *drawn, **frames)
        history = batch.history
        if config.own_history_share > 0:
            before = gather_windows(windows, *drawn, **frames, earlier=model_config.window)
            room = windows.room[drawn[0]] >= model_config.window
            history = self._own_history(state, batch, before, room, key_own)
        if config.history_damping > 0:
            history = self._damped(history, batch.style, key_damping)
        return batch if history is batch.history else restart_from(batch, history)

    def _own_history(self, state: TrainingState, batch: Batch, before: Batch, room, key):
        """Replace a share of the histories by the last frames of the network's own window before.

        That window is made in one step from pure noise, and no gradient flows through it.
        """
        config = self.config
        key_noise, key_choice = jax.random.split(key)
        x0, condition = network_inputs(before, self.normaliser)
        model = self.model(state.params)
        sigma = config.diffusion.sigma_max
        x_noisy = sigma * jax.random.normal(key_noise, x0.shape)
        x0_hat = jax.lax.stop_gradient(model(x_noisy, sigma, model.encode(condition)))
        made = orthonormalise(self.normaliser.denormalise(x0_hat))
        # Short windows leave some captured frames at the front, as they would in a rollout.
        made = jnp.concatenate([before.history, made], axis=1)[:, -batch.history.shape[1] :]
        # From the coordinates of the window before to those of this one.
        made = center_window(made, before.future[:, -1, jnp.array([0, 2])])
        progress = state.step / config.num_steps
        share = config.own_history_share * jnp.clip((progress - 0.1) / 0.3, 0.0, 1.0)
        chosen = room & jax.random.bernoulli(key_choice, share, room.shape)
        return jnp.where(chosen[:, None, None], made, batch.history)

    def _damped(self, history, style, key):
        """Pull a share of the histories towards the mean pose of their style."""
        key_choice, key_amount = jax.random.split(key)
        size = (history.shape[0], 1, 1)
        chosen = jax.random.bernoulli(key_choice, self.config.history_damping, size)
        amount = jnp.where(chosen, jax.random.uniform(key_amount, size, maxval=0.8), 0.0)
        mean = (style @ self.mean_poses)[:, None, :]
        pose = history[..., 9:] + amount * (mean - history[..., 9:])
        return orthonormalise(jnp.concatenate([history[..., :9], pose], axis=-1))

    def _run_chunk(self, state: TrainingState, windows: WindowSet, length: int):
        config = self.config
        base = jax.random.fold_in(jax.random.key(config.seed), 1)

        def one_step(state, _):
            key_batch, key_sigma, key_loss = jax.random.split(jax.random.fold_in(base, state.step), 3)
            batch = self._training_batch(windows, state, key_batch)
            sigma = draw_sigma(key_sigma, config.batch_size, config)
            batch, sigma = parallel.spread((batch, sigma), self.mesh)
            gradient, terms = jax.grad(self._loss, has_aux=True)(state.params, batch, sigma, key_loss, training=True)
            updates, optimiser = self.optimiser.update(gradient, state.optimiser, state.params)
            params = optax.apply_updates(state.params, updates)
            ema = optax.incremental_update(params, state.ema, 1.0 - config.ema_decay)
            return TrainingState(params, ema, optimiser, state.step + 1), terms

        return jax.lax.scan(one_step, state, None, length=length)

    def advance(self, state: TrainingState, length: int) -> tuple[TrainingState, dict]:
        """Train some steps in one program, without checkpoints or checks (see `run`).

        Args:
          state: where to start; its arrays are given away.
          length: steps.

        Returns:
          (state, every loss term of every step, [length] each).
        """
        return self._chunk(state, self.windows, length=length)

    def plan_memory(self, length: int = 1) -> int:
        """Return the bytes that the compiler plans for some steps: state, windows, between values.

        Args:
          length: steps in one program.
        """
        state = jax.eval_shape(self.initial_state)
        plan = self._chunk.lower(state, self.windows, length=length).compile().memory_analysis()
        shared = plan.alias_size_in_bytes  # what goes in and comes out in the same place
        sizes = plan.argument_size_in_bytes + plan.output_size_in_bytes + plan.temp_size_in_bytes
        return int(sizes - shared)

    def _held_out_terms(self, params, windows: WindowSet, key, num_samples: int):
        batch = spread_windows(windows, num_samples)
        size = batch.future.shape[0]
        key_sigma, key_loss = jax.random.split(key)
        sigma = self.config.diffusion.draw(key_sigma, (size,))
        return self._loss(params, batch, sigma, key_loss)[1]

    def held_out_terms(self, params, windows: WindowSet, *, num_samples: int = 512) -> dict:
        """Return the mean loss terms on held-out windows, the same windows and noise every time.

        Args:
          params: weights, usually the state's `ema`.
          windows: of another split than the one trained on.
          num_samples: windows to take, spread evenly.
        """
        windows = parallel.replicate(windows, self.mesh)
        terms = self._evaluate(params, windows, jax.random.key(7), num_samples=num_samples)
        return {name: float(value) for name, value in terms.items()}

    def save(self, path: Path, state: TrainingState) -> None:
        """Write the whole training state; an interrupted write leaves the old file whole."""
        if parallel.is_first_process():
            save_tree(path, state, {"kind": "training state", **self._identity()})

    def _identity(self) -> dict:
        """All that decides the weights, so that a state is only resumed where it belongs."""
        return {
            "model": self.model_config.to_dict(),
            "training": self.config.to_dict(),
            "dataset_fingerprint": self.dataset_fingerprint,
        }

    def restore(self, path: Path) -> TrainingState:
        """Read a state written by `save`.

        Raises:
          ValueError: if the file is broken, or was made with other settings.
        """

        def template(metadata: dict):
            mine = self._identity()
            for part in ("model", "training"):
                theirs = metadata.get(part, {})
                changed = sorted(name for name, value in mine[part].items() if value != theirs.get(name))
                if changed:
                    raise ValueError(
                        f"{path}: checkpoint was made with other {part} settings "
                        f"({', '.join(changed)}); choose another file or the old settings"
                    )
            if metadata.get("dataset_fingerprint") != self.dataset_fingerprint:
                raise ValueError(f"{path}: checkpoint was made on other data; choose another file")
            return jax.eval_shape(self.initial_state)

        return parallel.replicate(load_tree(path, template)[0], self.mesh)

    def run(
        self,
        state: TrainingState | None = None,
        *,
        checkpoint: Path | None = None,
        checkpoint_every: int = 500,
        held_out: WindowSet | None = None,
        chunk: int = 50,
        stop_after: int | None = None,
        stop_at: float | None = None,
        on_chunk: Callable[[dict], None] | None = None,
        progress: bool = True,
    ) -> tuple[TrainingState, list[dict]]:
        """Train to the configured number of steps.

        Args:
          state: where to start; by default the checkpoint if it exists, else the beginning.
          checkpoint: file to write the state to, every `checkpoint_every` steps and at the end.
          checkpoint_every: steps between checkpoints and held-out evaluations.
          held_out: windows to evaluate on.
          chunk: steps per jitted scan.
          stop_after: stop once this many steps are done in all.
          stop_at: stop, with a checkpoint, at the end of the first chunk after this time
            (`time.monotonic`). Of processes that train together, the first one's clock counts.
          on_chunk: called with each history row as it is made.
          progress: show a progress bar.

        Returns:
          (state, history): one row per chunk with step, mean of every loss term, and the held-out
          loss where it was measured.

        Raises:
          TrainingDiverged: at the first loss or weight that is not finite; the checkpoint on disk
            is from before.
        """
        if state is None:
            found = checkpoint is not None and Path(checkpoint).exists()
            state = self.restore(checkpoint) if found else self.initial_state()
        else:
            # The chunk donates its input; what the caller holds must stay alive.
            state = jax.tree.map(jnp.copy, state)
        total = self.config.num_steps if stop_after is None else stop_after
        total = min(self.config.num_steps, total)
        if chunk < 1 or checkpoint_every < 1:
            raise ValueError("chunk and checkpoint_every must be at least 1")
        done = int(state.step)
        history = []
        hidden = not (progress and parallel.is_first_process())
        with tqdm(total=total, initial=done, unit="step", disable=hidden) as bar:
            while done < total:
                # Chunks end on multiples, so that a resumed run makes the same ones.
                length = min(chunk - done % chunk, total - done)
                state, terms = self.advance(state, length)
                terms = {name: np.asarray(value) for name, value in terms.items()}
                self._check_finite(done, terms, state, checkpoint)
                passed = (done + length) // checkpoint_every > done // checkpoint_every
                done += length
                row = {"step": done, **{name: float(v.mean()) for name, v in terms.items()}}
                late = stop_at is not None and parallel.first_says(time.monotonic() >= stop_at)
                due = passed or done == total or late
                if due and held_out is not None:
                    measured = self.held_out_terms(state.ema, held_out)
                    row.update({f"held_out_{name}": value for name, value in measured.items()})
                if due and checkpoint is not None:
                    self.save(Path(checkpoint), state)
                history.append(row)
                if on_chunk is not None:
                    on_chunk(row)
                bar.update(length)
                bar.set_postfix(loss=f"{row['loss']:.4f}")
                if late:
                    break
        return state, history

    def _check_finite(self, done: int, terms: dict, state: TrainingState, checkpoint) -> None:
        """Raise TrainingDiverged for a chunk of steps that broke the loss or the weights."""
        bad = ~np.isfinite(terms["loss"])
        if bad.any():
            first = int(np.argmax(bad))
            guilty = [n for n in terms if n != "loss" and not np.isfinite(terms[n][first])]
            names = ", ".join(guilty) or "sum"
            what = f"loss is not finite at step {done + first + 1} (terms: {names})"
        else:
            finite = [bool(jnp.all(jnp.isfinite(leaf))) for leaf in jax.tree.leaves(state.params)]
            if all(finite):
                return
            what = f"weights are not finite after step {done + len(bad)}"
        kept = checkpoint is not None and Path(checkpoint).exists()
        advice = f"; the last good state is in {checkpoint}" if kept else ""
        raise TrainingDiverged(f"{what}: lower the learning rate or check the data for broken frames{advice}")
