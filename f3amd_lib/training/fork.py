"""A toy with a fork: walks past a wall, on its left or on its right, and small networks for them.

A window of motion is here a path of a few points on the ground. Every path of the data passes the
wall on one side, so that the mean of all paths runs into it: a sampler whose one step returns a
mean must fail, unless the condition says which side is meant. The data are a Gaussian mixture over
whole paths, whose denoiser is known exactly (`diffusion.oracles`), and the networks are F3AMD's own
(`networks.zoo`), only smaller, so that what is trained can be laid beside what is exact.

Paths are [B, T, 2], sideways (positive to the walker's left, as +X is) and ahead, in metres from
the middle of the wall; their coordinates have a deviation of about 1, so that metres are network
units as well.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pandas as pd
from flax import nnx

from f3amd_lib.data.features import path_condition
from f3amd_lib.diffusion.oracles import GaussianMixture
from f3amd_lib.diffusion.samplers import add_noise, ddim_step, ddpm_step
from f3amd_lib.diffusion.schedules import NoiseSchedule
from f3amd_lib.networks.conditioning import Condition
from f3amd_lib.networks.config import NetworkConfig, scaled_input
from f3amd_lib.networks.spectral import cosine_basis
from f3amd_lib.networks.zoo import build_config, build_from_config
from f3amd_lib.training.denoising_task import draw_sigma
from f3amd_lib.training.recipe import TrainingConfig, learning_rate_schedule, short_recipe

TOLD = ("nothing", "left", "right")
"""What the condition says of the side, by the number that stands for it."""

_HISTORY = 2
"""History frames of the networks: two points of a straight approach, the same for all."""


@functools.partial(jax.tree_util.register_static)
@dataclass(frozen=True)
class Fork:
    """Paths that pass a wall on either side, equally often, and their exact denoiser.

    Ahead, a path runs from -reach to +reach at a steady pace; sideways it swings out along a
    squared cosine and back. On top lies a smooth wobble: round Gaussian noise on the first cosine
    modes of both coordinates.

    Attributes:
      side: how far the two mean paths swing to the side, metres.
      wall: half the wall's width, metres.
      reach: half the length of the walk, metres.
      wobble: deviation of a coordinate from its mean path, root mean square over frames, metres.
      num_frames: points of a path, T.
      num_modes: cosine modes that paths are made of, at most T.

    Raises:
      ValueError: for sizes that are not positive, too many modes, or a wall that the mean paths run
        into.
    """

    side: float = 1.4
    wall: float = 0.5
    reach: float = 2.0
    wobble: float = 0.1
    num_frames: int = 16
    num_modes: int = 6

    def __post_init__(self):
        for item in dataclasses.fields(self):
            if not 0 < getattr(self, item.name) < np.inf:
                raise ValueError(f"{item.name} must be positive, got {getattr(self, item.name)!r}")
        if not 2 <= self.num_modes <= self.num_frames:
            raise ValueError(f"num_modes must be between 2 and num_frames = {self.num_frames}, got {self.num_modes}")
        if self.wall >= self.side:
            raise ValueError(
                f"the wall must leave room on both sides: wall = {self.wall!r} must be below side = {self.side!r}"
            )

    @functools.cached_property
    def mixture(self) -> GaussianMixture:
        """The data as a mixture over cosine coefficients, D = 2 num_modes: left, then right."""
        time = np.linspace(-1.0, 1.0, self.num_frames)
        swing = self.side * np.cos(0.5 * np.pi * time) ** 2
        drawn = np.stack([np.stack([s * swing, self.reach * time], -1) for s in (1.0, -1.0)])
        # The basis is orthonormal: noise of one deviation on frames is that noise on coefficients.
        width = self.wobble * np.sqrt(self.num_frames / self.num_modes)
        return GaussianMixture(self._coefficients(drawn).reshape(2, -1), width)

    @property
    def basis(self) -> np.ndarray:
        """Orthonormal cosine modes over frames, [num_modes, T] float64."""
        return cosine_basis(self.num_frames)[: self.num_modes]

    @property
    def mean_paths(self) -> np.ndarray:
        """The mean path on the left and the one on the right, [2, T, 2], metres."""
        return self._paths(self.mixture.means)

    @property
    def half_distance(self) -> float:
        """Half the distance of the two mean paths as vectors of 2 T numbers, metres.

        A point of T frames counts T times: the longer the window, the farther apart the branches.
        """
        left, right = self.mixture.means
        return 0.5 * float(np.linalg.norm(left - right))

    def _coefficients(self, paths):
        xp = jnp if isinstance(paths, jax.Array) else np
        return xp.einsum("kt,...tc->...kc", xp.asarray(self.basis, paths.dtype), paths)

    def _paths(self, coefficients):
        """Turn flat coefficients [..., 2 K] into paths [..., T, 2]."""
        xp = jnp if isinstance(coefficients, jax.Array) else np
        basis = xp.asarray(self.basis, coefficients.dtype)
        apart = coefficients.reshape(*coefficients.shape[:-1], self.num_modes, 2)
        return xp.einsum("kt,...kc->...tc", basis, apart)

    def draw(self, key, count: int):
        """Draw real paths.

        Args:
          key: JAX random key.
          count: B.

        Returns:
          (paths [B, T, 2], side [B]: 1 left, 2 right, as in `TOLD`).
        """
        key_side, key_wobble = jax.random.split(key)
        side = jax.random.randint(key_side, (count,), 0, 2)
        means = jnp.asarray(self.mixture.means, jnp.float32)
        wobble = jax.random.normal(key_wobble, (count, means.shape[1]))
        return self._paths(means[side] + self.mixture.width * wobble), 1 + side

    def denoise(self, x_noisy, sigma, told):
        """Return the exact clean estimate E[x0 | x_noisy, sigma, what was told].

        Args:
          x_noisy: paths with noise, [B, T, 2].
          sigma: noise level, scalar or [B].
          told: what is known of each path's side, [B], numbers of `TOLD`.

        Returns:
          [B, T, 2].
        """
        flat = self._coefficients(jnp.asarray(x_noisy))
        flat = flat.reshape(*flat.shape[:-2], -1)
        sigma = jnp.broadcast_to(jnp.asarray(sigma, flat.dtype), flat.shape[:-1])[..., None]
        mixture = self.mixture
        alone = [GaussianMixture(mean[None], mixture.width) for mean in mixture.means]
        answers = jnp.stack([one.denoise(flat, sigma) for one in (mixture, *alone)], axis=-2)
        chosen = jnp.take_along_axis(answers, jnp.asarray(told)[..., None, None], axis=-2)
        # Noise outside of the modes says nothing of the path and is dropped.
        return self._paths(chosen[..., 0, :])

    def condition(self, told) -> Condition:
        """Return what a network is shown: a straight approach, and a path that may tell the side.

        Args:
          told: [B], numbers of `TOLD`. "nothing" shows a straight path, which leads through the
            wall; a side shows its mean path.

        Returns:
          Condition of B rows, with a single style.
        """
        ahead = np.linspace(-self.reach, self.reach, self.num_frames)
        straight = np.stack([0.0 * ahead, ahead], axis=-1)
        shown = np.concatenate([straight[None], self.mean_paths])
        shown = path_condition(shown, np.zeros(shown.shape[:2])).astype(np.float32)
        step = ahead[1] - ahead[0]
        before = ahead[0] + step * np.arange(-_HISTORY, 0)
        approach = np.stack([0.0 * before, before], axis=-1).astype(np.float32)
        batch = len(told)
        return Condition(
            history=jnp.broadcast_to(approach, (batch, *approach.shape)),
            path=jnp.asarray(shown)[told],
            style=jnp.ones((batch, 1), jnp.float32),
        )


# ------------------------------------------------------------------------------------- outcomes


def crossing(paths) -> np.ndarray:
    """Return where paths cross the line of the wall.

    Args:
      paths: [B, T, 2], metres.

    Returns:
      Sideways position of the first crossing from below 0 ahead to 0 or more, [B], metres; NaN for
      a path that never crosses.
    """
    sideways, ahead = np.moveaxis(np.asarray(paths, np.float64), -1, 0)
    passes = (ahead[:, :-1] < 0.0) & (ahead[:, 1:] >= 0.0)
    rows, frame = np.arange(len(ahead)), passes.argmax(axis=1)
    before, after = ahead[rows, frame], ahead[rows, frame + 1]
    with np.errstate(divide="ignore", invalid="ignore"):
        share = -before / (after - before)
        found = (1.0 - share) * sideways[rows, frame] + share * sideways[rows, frame + 1]
    return np.where(passes.any(axis=1), found, np.nan)


def outcome_shares(fork: Fork, paths) -> dict[str, float]:
    """Say how paths end: shares that run into the wall, pass it on a side, or never get there.

    Args:
      fork: whose wall.
      paths: [B, T, 2], metres.

    Returns:
      "wall", "left", "right" and "short", which add up to 1.
    """
    place = crossing(paths)
    return {
        "wall": float(np.mean(np.abs(place) < fork.wall)),
        "left": float(np.mean(place >= fork.wall)),
        "right": float(np.mean(place <= -fork.wall)),
        "short": float(np.mean(np.isnan(place))),
    }


# ------------------------------------------------------------------------------------- networks


@functools.partial(
    jax.tree_util.register_dataclass, data_fields=("params", "input_scaling"), meta_fields=("fork", "graph")
)
@dataclass(frozen=True, eq=False)
class ForkNetwork:
    """A small trained F3AMD for a fork.

    Attributes:
      params: weights (the moving average).
      input_scaling: whether the noisy input is multiplied by c_in (see `scaled_input`). It is a
        value and no part of the network, so that one compiled program serves with and without.
      fork: what it was trained on.
      graph: of the network, whose own config scales nothing.
    """

    params: Any
    input_scaling: Any
    fork: Fork
    graph: Any

    def denoise(self, x_noisy, sigma, told):
        """Return the network's clean estimate; arguments as for `Fork.denoise`."""
        network = nnx.merge(self.graph, self.params)
        sigma = jnp.broadcast_to(jnp.asarray(sigma, x_noisy.dtype), x_noisy.shape[:1])
        scaling = dataclasses.replace(network.config, input_scaling=True)
        scaled = scaled_input(scaling, x_noisy, sigma)
        shown = jnp.where(self.input_scaling, scaled, x_noisy)
        return network(shown, sigma, network.encode(self.fork.condition(told)))


def fork_recipe(diffusion: NoiseSchedule, num_steps: int = 1500, **settings) -> TrainingConfig:
    """Return how a fork's network is trained: `short_recipe`, with batches of 32.

    Args:
      diffusion: the noise that it is trained with.
      num_steps: optimiser steps.
      **settings: fields of `TrainingConfig` to change.
    """
    ours = {"batch_size": 32, "learning_rate": 4e-3, "ema_decay": 0.99, "diffusion": diffusion}
    return short_recipe("F3AMD-FNO-32", num_steps, **{**ours, **settings})


def train_fork(
    fork: Fork, recipe: TrainingConfig, *, input_scaling: bool = True, latent_width: int = 16, depth: int = 2
) -> tuple[ForkNetwork, np.ndarray]:
    """Train a small F3AMD on paths drawn afresh at every step, half of them with the side told.

    The loss is the square error of the clean estimate alone (Eq. 11). Networks that differ in
    noise or input scaling start from the same weights and see the same paths, noise and conditions.

    Args:
      fork: the data.
      recipe: noise, steps, batch, rate, moving average and seed, see `fork_recipe`.
      input_scaling: multiply the noisy input by c_in.
      latent_width, depth: of the network (D and N of sections 4.2 and 4.5).

    Returns:
      (network, loss at every step [num_steps]).

    Raises:
      ArithmeticError: if the loss stops being a number.
    """
    config = build_config(
        "F3AMD-FNO-32",
        channels=2,
        num_styles=1,
        window=fork.num_frames,
        num_history=_HISTORY,
        latent_width=latent_width,
        depth=depth,
        input_scaling=False,
    )
    key_init, key_sigma, key_batches = jax.random.split(jax.random.key(recipe.seed), 3)
    graph = nnx.graphdef(nnx.eval_shape(lambda: build_from_config(config, key_init)))
    params = _initial_weights(config, key_init)
    start = ForkNetwork(params, jnp.asarray(input_scaling), fork, graph)
    shape = (recipe.num_steps, recipe.batch_size)
    sigmas = draw_sigma(key_sigma, shape[0] * shape[1], recipe).reshape(shape)
    batches = _draw_batches(fork, sigmas, key_batches)
    # What the compiled loop does not need to know would only make it compile again.
    common = dataclasses.replace(recipe, diffusion=TrainingConfig(num_steps=1).diffusion, seed=0)
    network, losses = _train(start, common, batches)
    losses = np.asarray(losses)
    if not np.isfinite(losses).all():
        step = int(np.argmin(np.isfinite(losses))) + 1
        raise ArithmeticError(
            f"the loss stopped being a number at step {step}: lower the learning rate {recipe.learning_rate}"
        )
    return network, losses


@functools.partial(jax.jit, static_argnames="config")
def _initial_weights(config: NetworkConfig, key):
    return nnx.state(build_from_config(config, key))


@functools.partial(jax.jit, static_argnames="fork")
def _draw_batches(fork: Fork, sigmas, key):
    """Draw all that training sees, [num_steps, B, ...]: the toy fits into memory as a whole."""
    key_path, key_noise, key_told = jax.random.split(key, 3)
    x0, side = fork.draw(key_path, sigmas.size)
    x_noisy = add_noise(x0, sigmas.reshape(-1, 1, 1), jax.random.normal(key_noise, x0.shape))
    told = jnp.where(jax.random.bernoulli(key_told, 0.5, side.shape), side, 0)
    by_step = lambda array: array.reshape(*sigmas.shape, *array.shape[1:])
    return by_step(x0), by_step(x_noisy), sigmas, by_step(told)


@functools.partial(jax.jit, static_argnames="recipe")
def _train(network: ForkNetwork, recipe: TrainingConfig, batches):
    steps = [optax.adam(learning_rate_schedule(recipe))]
    if recipe.gradient_clip > 0:
        steps.insert(0, optax.clip_by_global_norm(recipe.gradient_clip))
    optimiser = optax.chain(*steps)

    def loss_of(params, x0, *inputs):
        x0_hat = dataclasses.replace(network, params=params).denoise(*inputs)
        return jnp.mean((x0_hat - x0) ** 2)

    def step(state, batch):
        params, ema, moments = state
        loss, gradient = jax.value_and_grad(loss_of)(params, *batch)
        updates, moments = optimiser.update(gradient, moments, params)
        params = optax.apply_updates(params, updates)
        ema = optax.incremental_update(params, ema, 1.0 - recipe.ema_decay)
        return (params, ema, moments), loss

    start = (network.params, network.params, optimiser.init(network.params))
    (_, ema, _), losses = jax.lax.scan(step, start, batches)
    return dataclasses.replace(network, params=ema), losses


# ------------------------------------------------------------------------------------- sampling


@jax.jit
def _estimate(model: Fork | ForkNetwork, x_noisy, sigma, told):
    return model.denoise(x_noisy, sigma, told)


def sample_paths(model: Fork | ForkNetwork, diffusion: NoiseSchedule, num_steps: int, told, key) -> np.ndarray:
    """Sample paths with the sampler that belongs to a noise schedule.

    The answer is that of `samplers.sample`, but only the denoiser is compiled, once for all numbers
    of steps: this toy waits for its compiler more than for its steps.

    Args:
      model: a trained network, or the fork itself, whose denoiser is exact.
      diffusion: the noise schedule; it says which levels are visited, and by DDIM or DDPM.
      num_steps: N.
      told: [B], numbers of `TOLD`.
      key: JAX random key; first states are the same for all models and numbers of steps.

    Returns:
      [B, T, 2], metres.
    """
    fork = model if isinstance(model, Fork) else model.fork
    key_init, key_steps = jax.random.split(key)
    told = jnp.asarray(told, jnp.int32)
    shape = (len(told), fork.num_frames, 2)
    sigmas = np.asarray(diffusion.grid(num_steps), np.float32)
    x = sigmas[0] * jax.random.normal(key_init, shape)
    keys = jax.random.split(key_steps, num_steps)
    for sigma, sigma_next, key_noise in zip(sigmas[:-1], sigmas[1:], keys, strict=True):
        x0_hat = _estimate(model, x, sigma, told)
        if diffusion.sampler == "ddpm":
            noise = jax.random.normal(key_noise, shape)
            x = ddpm_step(x, x0_hat, sigma, sigma_next, noise)
        else:
            x = ddim_step(x, x0_hat, sigma, sigma_next)
    return np.asarray(x)


def outcome_table(
    model: Fork | ForkNetwork,
    diffusion: NoiseSchedule,
    steps: Iterable[int] = (1, 2, 4, 8),
    *,
    num_samples: int = 400,
    seed: int = 0,
) -> pd.DataFrame:
    """Count how sampled paths end, with and without the side in the condition.

    Args:
      model, diffusion: as for `sample_paths`.
      steps: numbers of steps N.
      num_samples: paths without, and as many with the side told, half of them each side.
      seed: of the noise.

    Returns:
      Columns steps, told (bool), wall, left, right, short (shares; see `outcome_shares`), as_told
      (share that passed on the side that was told; NaN where none was).
    """
    fork = model if isinstance(model, Fork) else model.fork
    half = num_samples // 2
    told = np.repeat([0, 1, 2], [num_samples, half, num_samples - half])
    rows = []
    for num_steps in steps:
        paths = sample_paths(model, diffusion, num_steps, told, jax.random.key(seed))
        knew = outcome_shares(fork, paths[told > 0])
        right_way = outcome_shares(fork, paths[told == 1])["left"] * half
        right_way += outcome_shares(fork, paths[told == 2])["right"] * (num_samples - half)
        free = outcome_shares(fork, paths[told == 0])
        rows.append({"steps": num_steps, "told": False, **free, "as_told": float("nan")})
        rows.append({"steps": num_steps, "told": True, **knew, "as_told": right_way / num_samples})
    return pd.DataFrame(rows)


def error_table(
    model: Fork | ForkNetwork, sigmas: Iterable[float], *, num_samples: int = 800, seed: int = 0
) -> pd.DataFrame:
    """Measure the error of the clean estimate at each noise level, with no side told.

    Args:
      model: as for `sample_paths`.
      sigmas: noise levels.
      num_samples: real paths; they and their noise are the same for all models and levels.
      seed: of the paths and the noise.

    Returns:
      Columns sigma and x0_error, root mean square over frames and coordinates, metres. The exact
      denoiser's is the lowest there is: the spread that noise and condition leave.
    """
    fork = model if isinstance(model, Fork) else model.fork
    key_path, key_noise = jax.random.split(jax.random.key(seed))
    x0, _ = fork.draw(key_path, num_samples)
    noise, told = jax.random.normal(key_noise, x0.shape), jnp.zeros(num_samples, jnp.int32)
    rows = []
    for sigma in np.asarray(list(sigmas), np.float32):
        x0_hat = _estimate(model, add_noise(x0, sigma, noise), sigma, told)
        error = float(jnp.sqrt(jnp.mean((x0_hat - x0) ** 2)))
        rows.append({"sigma": float(sigma), "x0_error": error})
    return pd.DataFrame(rows)
