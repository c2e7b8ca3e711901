"""What a denoiser is trained to do: undo noise on windows of motion, from histories as they come.

One step of training: `DenoisingTask.draw` cuts a batch of windows and noise levels,
`DenoisingTask.loss` adds the noise, asks the network for the clean window and compares
(`training.losses`); `training.optimise` takes the step.
"""

import math
from dataclasses import dataclass, field

import jax
import jax.numpy as jnp
import numpy as np

from f3amd_lib.data import windows as window_sets
from f3amd_lib.data.features import Normaliser, center_window, orthonormalise
from f3amd_lib.data.windows import Batch, WindowSet
from f3amd_lib.diffusion.samplers import add_noise
from f3amd_lib.ground.arrays import exact_products
from f3amd_lib.motion.skeleton import Skeleton
from f3amd_lib.networks.conditioning import Condition
from f3amd_lib.networks.config import NetworkConfig
from f3amd_lib.training.checkpoints import network_with
from f3amd_lib.training.losses import loss_terms, total_loss
from f3amd_lib.training.optimise import Task, TrainingState, frozen_tree
from f3amd_lib.training.recipe import TrainingConfig

LOG_NORMAL_SIGMA = (-1.2 + math.log(2.0), 1.2)
"""Mean and deviation of ln sigma: Karras et al. 2022, Table 1, for features of deviation 1 where
theirs have 0.5."""

_HELD_OUT_WINDOWS = 512
"""Most windows that the held-out loss is measured on."""


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


def noise_weights(sigma, config: TrainingConfig):
    """Return what each sample counts in the loss, [B], mean 1, or None where all count alike."""
    if config.noise_weighting == "uniform":
        return None
    weights = 1.0 + jnp.minimum(sigma**-2.0, 5.0)
    return weights / weights.mean()


def weights_identity(model: NetworkConfig, config: TrainingConfig, dataset_fingerprint: str) -> dict:
    """Return all that decides a denoiser's weights, as its training state or its record tells it."""
    return {"model": model.to_dict(), "training": config.to_dict(), "dataset_fingerprint": dataset_fingerprint}


OWN_HISTORY_STEPS = 4_000
"""Of a longer run this many count when its share of own histories rises: the network walks by then, and a snapshot of
the long queue is what a run of its own length would be."""


def own_history_share(config: TrainingConfig, step):
    """Return the share of samples that start from the network's own history at a step.

    It rises from 0 to the config's between 10 and 40 % of the run, or of the first `OWN_HISTORY_STEPS` of a longer one:
    before that there is nothing to learn from.
    """
    progress = step / min(config.num_steps, OWN_HISTORY_STEPS)
    return config.own_history_share * jnp.clip((progress - 0.1) / 0.3, 0.0, 1.0)


@dataclass(frozen=True)
class Constants:
    """What is known of the training windows as a whole, compiled into the step.

    Equal numbers mean the same program. (As arguments of the step they would be rounded
    differently, and a run would not repeat an earlier one to the bit.)

    Attributes:
      normaliser: of the features.
      mean_poses: of each style, [S, C - 9].
      numbers: the bytes of both, by which constants are compared.
    """

    normaliser: Normaliser = field(compare=False)
    mean_poses: jax.Array = field(compare=False)
    numbers: bytes = field(init=False, repr=False)

    def __post_init__(self):
        arrays = map(np.asarray, (*self.normaliser, self.mean_poses))
        object.__setattr__(self, "numbers", b"".join(array.tobytes() for array in arrays))


@frozen_tree("windows")
class DenoisingTask(Task):
    """A denoiser to train on one window set; see `denoising_task`.

    Attributes:
      model_config: the network.
      config: how to train it.
      skeleton: for the kinematic losses.
      constants: of the training windows.
      windows: training windows on the device.
      dataset_fingerprint: of the data they come from; a state of other data is not resumed.
    """

    name = "denoiser"

    model_config: NetworkConfig
    config: TrainingConfig
    skeleton: Skeleton
    constants: Constants
    windows: WindowSet
    dataset_fingerprint: str

    @property
    def normaliser(self) -> Normaliser:
        """Of the training windows; the identity where the network wants none."""
        return self.constants.normaliser

    def identity(self) -> dict:
        """See `weights_identity`."""
        return weights_identity(self.model_config, self.config, self.dataset_fingerprint)

    def draw(self, state: TrainingState, key):
        """Draw windows and noise levels; return ((batch, sigma [B]), key of the loss).

        Where the config asks, windows start from histories as a rollout meets them.
        """
        config, window = self.config, self.model_config.window
        key_batch, key_sigma, key_loss = jax.random.split(key, 3)
        key_draw, key_own, key_damping = jax.random.split(key_batch, 3)
        drawn = window_sets.draw_windows(self.windows, key_draw, config.batch_size, config.captured_path_share)
        batch = window_sets.gather_windows(self.windows, *drawn)
        history = batch.history
        if config.own_history_share > 0:
            before = window_sets.gather_windows(self.windows, *drawn, earlier=window)
            room = self.windows.room[drawn[0]] >= window
            history = self._own_history(state, batch, before, room, key_own)
        if config.history_damping > 0:
            history = self._damped(history, batch.style, key_damping)
        if history is not batch.history:
            batch = window_sets.restart_from(batch, history)
        return (batch, draw_sigma(key_sigma, config.batch_size, config)), key_loss

    def _own_history(self, state: TrainingState, batch: Batch, before: Batch, room, key):
        """Replace a share of the histories by the last frames of the network's own window before.

        That window is made in one step from pure noise, and no gradient flows through it.
        """
        config = self.config
        key_noise, key_choice = jax.random.split(key)
        x0, condition = network_inputs(before, self.normaliser)
        model = network_with(self.model_config, state.params)
        sigma = config.diffusion.sigma_max
        x_noisy = sigma * jax.random.normal(key_noise, x0.shape)
        x0_hat = jax.lax.stop_gradient(model(x_noisy, sigma, model.encode(condition)))
        made = orthonormalise(self.normaliser.denormalise(x0_hat))
        # Short windows leave some captured frames at the front, as they would in a rollout.
        made = jnp.concatenate([before.history, made], axis=1)[:, -batch.history.shape[1] :]
        # From the coordinates of the window before to those of this one.
        made = center_window(made, before.future[:, -1, jnp.array([0, 2])])
        share = own_history_share(config, state.step)
        chosen = room & jax.random.bernoulli(key_choice, share, room.shape)
        return jnp.where(chosen[:, None, None], made, batch.history)

    def _damped(self, history, style, key):
        """Pull a share of the histories towards the mean pose of their style."""
        key_choice, key_amount = jax.random.split(key)
        size = (history.shape[0], 1, 1)
        chosen = jax.random.bernoulli(key_choice, self.config.history_damping, size)
        amount = jnp.where(chosen, jax.random.uniform(key_amount, size, maxval=0.8), 0.0)
        with exact_products():
            mean = (style @ self.constants.mean_poses)[:, None, :]
        # Where the root is and goes (9 numbers) stays; the pose alone loses its swing.
        pose = history[..., 9:] + amount * (mean - history[..., 9:])
        return orthonormalise(jnp.concatenate([history[..., :9], pose], axis=-1))

    def terms(self, params, drawn, key, training=True) -> dict:
        """Add noise, ask for the clean window and compare; "loss" is the weighted sum (Eq. 14).

        Args:
          params: weights.
          drawn: what `draw` drew; out of training the windows of another split, which nothing disturbs.
          key: of noise, disturbances and dropout.
          training: whether this is a step of training.
        """
        if training:
            batch, sigma = drawn
        else:
            batch = window_sets.spread_windows(drawn, _HELD_OUT_WINDOWS)
            key_sigma, key = jax.random.split(key)
            sigma = self.config.diffusion.draw(key_sigma, (batch.future.shape[0],))
        key_noise, key_history, key_dropout = jax.random.split(key, 3)
        x0, condition = network_inputs(batch, self.normaliser)
        if training:
            condition = self._disturbed(condition, key_history)
        noise = jax.random.normal(key_noise, x0.shape)
        model = network_with(self.model_config, params)
        x_noisy = add_noise(x0, sigma[:, None, None], noise)
        drops = training and self.model_config.dropout > 0
        x0_hat = model(x_noisy, sigma, model.encode(condition), key=key_dropout if drops else None)
        return self.compared(x0_hat, x0, batch.future, batch, noise_weights(sigma, self.config) if training else None)

    def compared(self, x0_hat, x0, future, batch: Batch, weights=None) -> dict:
        """Return the loss terms of an answer, "loss" among them.

        Args:
          x0_hat, x0, future, weights: as of `loss_terms`.
          batch: of the windows, which says what was before them.
        """
        future_hat, last_history = self.normaliser.denormalise(x0_hat), batch.history[:, -1]
        if self.config.loss.raw_features:
            x0_hat, x0 = future_hat, future
        terms = loss_terms(
            self.skeleton, x0_hat, x0, future_hat, future, last_history, self.config.loss.ird_form, weights
        )
        return {"loss": total_loss(terms, self.config.loss), **terms}

    def _disturbed(self, condition: Condition, key) -> Condition:
        """Add noise to the history, or take it or the whole condition away, as the config says."""
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


def denoising_task(
    model_config: NetworkConfig, config: TrainingConfig, skeleton: Skeleton, normaliser: Normaliser,
    windows: WindowSet, *, dataset_fingerprint: str = "",
) -> DenoisingTask:  # fmt: skip
    """Lay out what a denoiser is trained on.

    Args:
      normaliser: of the training windows; replaced by the identity where the network wants none
        (`-raw`).
      model_config, config, skeleton, windows, dataset_fingerprint: see `DenoisingTask`.
    """
    if not model_config.normalise:
        normaliser = Normaliser.identity(model_config.channels)
    constants = Constants(normaliser, window_sets.mean_poses(windows))
    return DenoisingTask(model_config, config, skeleton, constants, windows, dataset_fingerprint)
