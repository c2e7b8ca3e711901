"""A bimodal toy: walks past a wall, on its left or on its right, and small networks for them.

A window of motion is here a path of a few points on the ground. Every path of the data passes the
wall on one side, so that the mean of all paths runs into it: a sampler whose one step returns a
mean must fail, unless the condition gives the side. The data are a Gaussian mixture over whole
paths, whose denoiser is known exactly (`diffusion.oracles`), and the networks are F3AMD's own
(`networks.presets`), only smaller, so that what is trained can be laid beside what is exact.

Paths are [B, T, 2], sideways (positive to the walker's left, as +X is) and ahead, in metres from
the middle of the wall; their coordinates have a deviation of about 1, so that metres are network
units as well. A side is a number: 0 unknown, 1 left, 2 right.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pandas as pd
from f3amd_lib.data.features import path_condition
from f3amd_lib.diffusion import samplers
from f3amd_lib.diffusion.oracles import GaussianMixture
from f3amd_lib.diffusion.schedules import NoiseSchedule
from f3amd_lib.networks.conditioning import Condition
from f3amd_lib.networks.presets import build_config, build_from_config
from f3amd_lib.networks.spectral import cosine_basis
from f3amd_lib.training.optimise import TrainingState, advance, initial_state
from f3amd_lib.training.recipe import TrainingConfig
from flax import nnx

UNKNOWN, LEFT, RIGHT = range(3)

_HISTORY = 2
"""History frames of the networks: two points of a straight approach, the same for all."""


@functools.partial(jax.tree_util.register_static)
@dataclass(frozen=True)
class BimodalPaths:
    """Paths that pass a wall on either side, equally often, and their exact denoiser.

    Ahead, a path runs from -reach to +reach at a steady pace; sideways it swings out along a
    squared cosine and back. On top lies a smooth wobble: round Gaussian noise on the first cosine
    modes of both coordinates.

    Attributes:
      swing: how far the two mean paths swing to the side, metres, more than `wall`.
      wall: half the wall's width, metres.
      reach: half the length of the walk, metres.
      wobble: deviation of a coordinate from its mean path, root mean square over frames, metres.
      num_frames: points of a path, T.
      num_modes: cosine modes that paths are made of, K, from 2 to T.
    """

    swing: float = 1.4
    wall: float = 0.5
    reach: float = 2.0
    wobble: float = 0.1
    num_frames: int = 16
    num_modes: int = 6

    @property
    def data(self) -> BimodalPaths:
        """The paths themselves, under the name that `PathNetwork` has for its data."""
        return self

    @property
    def basis(self) -> np.ndarray:
        """Orthonormal cosine modes over frames, [K, T] float64."""
        return cosine_basis(self.num_frames)[: self.num_modes]

    @functools.cached_property
    def mixture(self) -> GaussianMixture:
        """The data as a mixture over cosine coefficients, D = 2 K: left, then right."""
        time = np.linspace(-1.0, 1.0, self.num_frames)
        swing = self.swing * np.cos(0.5 * np.pi * time) ** 2
        drawn = np.stack([np.stack([s * swing, self.reach * time], -1) for s in (1.0, -1.0)])
        # The basis is orthonormal: noise of one deviation on frames is that noise on coefficients.
        width = self.wobble * np.sqrt(self.num_frames / self.num_modes)
        return GaussianMixture(np.einsum("kt,stc->skc", self.basis, drawn).reshape(2, -1), width)

    @property
    def mean_paths(self) -> np.ndarray:
        """The mean path on the left and the one on the right, [2, T, 2], metres."""
        means = self.mixture.means.reshape(2, self.num_modes, 2)
        return np.einsum("kt,skc->stc", self.basis, means)

    def _paths(self, coefficients):
        """Turn coefficients [B, 2 K] into paths [B, T, 2]."""
        modes = coefficients.reshape(-1, self.num_modes, 2)
        return jnp.einsum("kt,bkc->btc", self.basis, modes)

    def draw(self, key, count: int):
        """Draw real paths.

        Args:
          key: JAX random key.
          count: B.

        Returns:
          (paths [B, T, 2], side [B], 1 or 2).
        """
        key_side, key_wobble = jax.random.split(key)
        side = jax.random.randint(key_side, (count,), LEFT, RIGHT + 1)
        means = jnp.asarray(self.mixture.means, jnp.float32)[side - LEFT]
        wobble = jax.random.normal(key_wobble, means.shape)
        return self._paths(means + self.mixture.width * wobble), side

    def denoise(self, x_noisy, sigma, side):
        """Return the exact clean estimate E[x0 | x_noisy, sigma, side].

        Args:
          x_noisy: paths with noise, [B, T, 2].
          sigma: noise level, scalar or [B].
          side: what the condition says of each path's side, [B].

        Returns:
          [B, T, 2].
        """
        flat = jnp.einsum("kt,btc->bkc", self.basis, jnp.asarray(x_noisy))
        flat = flat.reshape(len(flat), -1)
        sigma = jnp.broadcast_to(jnp.asarray(sigma, flat.dtype), flat.shape[:1])[:, None]
        both = self.mixture
        one_way = [GaussianMixture(mean[None], both.width) for mean in both.means]
        estimates = jnp.stack([mixture.denoise(flat, sigma) for mixture in (both, *one_way)])
        # Noise outside of the modes says nothing of the path and is dropped.
        return self._paths(estimates[jnp.asarray(side), jnp.arange(len(flat))])

    def condition(self, side) -> Condition:
        """Return what a network is shown: a straight approach, and a path that may give the side.

        Args:
          side: [B]. An unknown one shows a straight path, which leads through the wall; the others
            show their mean path.

        Returns:
          Condition of B rows, with a single style.
        """
        ahead = np.linspace(-self.reach, self.reach, self.num_frames)
        straight = np.stack([0.0 * ahead, ahead], axis=-1)
        paths = np.concatenate([straight[None], self.mean_paths])
        paths = path_condition(paths, np.zeros(paths.shape[:2])).astype(np.float32)
        before = ahead[0] + (ahead[1] - ahead[0]) * np.arange(-_HISTORY, 0)
        approach = np.stack([0.0 * before, before], axis=-1).astype(np.float32)
        return Condition(
            history=jnp.broadcast_to(approach, (len(side), *approach.shape)),
            path=jnp.asarray(paths)[side],
            style=jnp.ones((len(side), 1), jnp.float32),
        )


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


def outcome_shares(data: BimodalPaths, paths) -> dict[str, float]:
    """Return how paths end: shares that run into the wall, pass it on a side, or never get there.

    Args:
      data: whose wall.
      paths: [B, T, 2], metres.

    Returns:
      "wall", "left", "right" and "short", which add up to 1.
    """
    place = crossing(paths)
    return {
        "wall": float(np.mean(np.abs(place) < data.wall)),
        "left": float(np.mean(place >= data.wall)),
        "right": float(np.mean(place <= -data.wall)),
        "short": float(np.mean(np.isnan(place))),
    }


@functools.partial(jax.tree_util.register_dataclass, data_fields=("params",), meta_fields=("data", "graph"))
@dataclass(frozen=True, eq=False)
class PathNetwork:
    """A small trained F3AMD: its weights (the moving average), what it was trained on, its graph without weights."""

    params: Any
    data: BimodalPaths
    graph: Any

    def denoise(self, x_noisy, sigma, side):
        """Return the network's clean estimate; arguments as for `BimodalPaths.denoise`."""
        network = nnx.merge(self.graph, self.params)
        sigma = jnp.broadcast_to(jnp.asarray(sigma, x_noisy.dtype), x_noisy.shape[:1])
        return network(x_noisy, sigma, network.encode(self.data.condition(side)))


def train_networks(
    data: BimodalPaths,
    diffusion: NoiseSchedule,
    seeds: Sequence[int],
    *,
    num_steps: int = 1500,
    batch_size: int = 32,
    learning_rate: float = 4e-3,
    latent_width: int = 16,
    depth: int = 2,
) -> tuple[list[PathNetwork], np.ndarray]:
    """Train small F3AMDs, one a seed, on paths drawn afresh at every step, half of them with the side given.

    The loss is the square error of the clean estimate alone (Eq. 11), the rate a short warm-up and
    a cosine. All seeds train side by side, in the library's own loop. Networks of one seed that
    differ in noise start from the same weights and see the same paths and conditions.

    Args:
      data: the paths.
      diffusion: the noise.
      seeds: of weights and paths.
      num_steps, batch_size, learning_rate: of the optimiser.
      latent_width, depth: of the network (D and N of sections 4.2 and 4.5).

    Returns:
      (a network a seed, loss at every step [S, num_steps]).
    """
    config = build_config(
        "F3AMD-FNO-32", channels=2, num_styles=1, window=data.num_frames, num_history=_HISTORY,
        latent_width=latent_width, depth=depth,
    )  # fmt: skip
    keys = [jax.random.split(jax.random.key(seed), 3) for seed in seeds]
    graph = nnx.graphdef(nnx.eval_shape(lambda: build_from_config(config, keys[0][0])))
    params = _initial_weights(config, jnp.stack([key_init for key_init, _, _ in keys]))
    shape = (num_steps, batch_size)
    sigmas = [diffusion.draw(jax.random.split(key_sigma, 3)[0], (num_steps * batch_size,)) for _, key_sigma, _ in keys]
    sigmas = jnp.stack(sigmas).reshape(-1, *shape)
    batches = _draw_batches(data, sigmas, jnp.stack([key_batches for _, _, key_batches in keys]))
    # The noise is in the batches alone: trainings that differ in it are one program, compiled once.
    recipe = TrainingConfig(
        num_steps, batch_size, learning_rate, schedule="warmup_cosine", warmup_steps=max(1, num_steps // 10),
        ema_decay=0.99, gradient_clip=1.0,
    )  # fmt: skip
    task = PathTask(PathNetwork(params, data, graph), batches, recipe)
    state, terms = advance(task, initial_state(task), num_steps)
    of_seed = lambda number: jax.tree.map(lambda leaf: leaf[number], state.averaged)
    return [PathNetwork(of_seed(number), data, graph) for number in range(len(keys))], np.asarray(terms["by_seed"]).T


# It runs once, and a program of many random numbers compiles five times as long with all optimisations.
@functools.partial(jax.jit, static_argnames="config", compiler_options={"xla_backend_optimization_level": 0})
def _initial_weights(config, keys):
    """Return the weights of a network a key, each leaf [S, ...]."""
    return jax.vmap(lambda key: nnx.state(build_from_config(config, key)))(keys)


def optimiser_by_seed(config: TrainingConfig) -> optax.GradientTransformation:
    """Return a recipe's optimiser for each seed on its own: one seed's large gradient clips no other's."""
    one = config.optimiser()
    return optax.GradientTransformation(jax.vmap(one.init), jax.vmap(one.update))


@functools.partial(jax.jit, static_argnames="data")
@functools.partial(jax.vmap, in_axes=(None, 0, 0))
def _draw_batches(data: BimodalPaths, sigmas, key):
    """Draw all that training sees, [num_steps, B, ...]: the toy fits into memory as a whole."""
    key_path, key_noise, key_known = jax.random.split(key, 3)
    x0, side = data.draw(key_path, sigmas.size)
    noise = jax.random.normal(key_noise, x0.shape)
    x_noisy = samplers.add_noise(x0, sigmas.reshape(-1, 1, 1), noise)
    side = jnp.where(jax.random.bernoulli(key_known, 0.5, side.shape), side, UNKNOWN)
    by_step = lambda array: array.reshape(*sigmas.shape, *array.shape[1:])
    return by_step(x0), by_step(x_noisy), sigmas, by_step(side)


@functools.partial(jax.tree_util.register_dataclass, data_fields=("networks", "batches"), meta_fields=("config",))
@dataclass(frozen=True, eq=False)
class PathTask:
    """Networks to train side by side, one a seed (a `training.optimise.Task`).

    Attributes:
      networks: the networks before the first step; each leaf of their weights is [S, ...].
      batches: what each sees at every step, from `_draw_batches`, [S, num_steps, B, ...].
      config: the recipe; its seed decides nothing here, since weights and batches come with the task.
    """

    name: ClassVar[str] = "paths past a wall"

    networks: PathNetwork
    batches: tuple[jax.Array, ...]
    config: TrainingConfig

    @property
    def optimiser(self) -> optax.GradientTransformation:
        """The recipe's, for each seed on its own."""
        return optimiser_by_seed(self.config)

    def identity(self) -> dict:
        """Return the recipe; no state of this toy is kept in a file."""
        return {"training": self.config.to_dict()}

    def init(self, key):
        """Return the weights that the task came with; these networks keep no statistics."""
        return self.networks.params, None

    def draw(self, state: TrainingState, key):
        """Return the batch of this step, [S, B, ...] each."""
        return jax.tree.map(lambda array: array[:, state.step], self.batches), key

    def loss(self, params, statistics, batch, key):
        """Return the sum over seeds of Eq. 11, so that each seed gets the gradient of its own."""

        def of_one(params, x0, *inputs):
            x0_hat = dataclasses.replace(self.networks, params=params).denoise(*inputs)
            return jnp.mean((x0_hat - x0) ** 2)

        by_seed = jax.vmap(of_one)(params, *batch)
        return by_seed.sum(), ({"loss": by_seed.sum(), "by_seed": by_seed}, statistics)


@jax.jit
def _denoise(model, x_noisy, sigma, side):
    return model.denoise(x_noisy, sigma, side)


def sample_paths(model: BimodalPaths | PathNetwork, diffusion: NoiseSchedule, num_steps: int, side, key) -> np.ndarray:
    """Sample paths with the sampler that belongs to a noise schedule.

    Only the denoiser is compiled, once for all numbers of steps: this toy waits for its compiler
    more than for its steps.

    Args:
      model: a trained network, or the data themselves, whose denoiser is exact.
      diffusion: the noise schedule; it says which levels are visited, and by DDIM or DDPM.
      num_steps: N.
      side: what the condition says, [B].
      key: JAX random key; first states are the same for all models and numbers of steps.

    Returns:
      [B, T, 2], metres.
    """
    key_init, key_steps = jax.random.split(key)
    side = jnp.asarray(side, jnp.int32)
    sigmas = diffusion.grid(num_steps)
    x_init = sigmas[0] * jax.random.normal(key_init, (len(side), model.data.num_frames, 2))
    denoise = lambda x_noisy, sigma: _denoise(model, x_noisy, sigma, side)
    *_, end = samplers.walk(diffusion.sampler, denoise, x_init, sigmas, key=key_steps)
    return np.asarray(end.x_noisy)


def outcome_table(
    model: BimodalPaths | PathNetwork,
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
      num_samples: paths without, and as many with the side given, half of them each side.
      seed: of the noise.

    Returns:
      Columns steps, told (whether the side was given), wall, left, right, short (shares; see
      `outcome_shares`), as_told (share that passed on the given side; NaN where none was).
    """
    half = num_samples // 2
    side = np.repeat([UNKNOWN, LEFT, RIGHT], [num_samples, half, num_samples - half])
    rows = []
    for num_steps in steps:
        paths = sample_paths(model, diffusion, num_steps, side, jax.random.key(seed))
        place = crossing(paths)
        right_way = np.where(side == LEFT, place, -place)[side != UNKNOWN] >= model.data.wall
        for given, share in ((False, float("nan")), (True, float(np.mean(right_way)))):
            shares = outcome_shares(model.data, paths[(side != UNKNOWN) == given])
            rows.append({"steps": num_steps, "told": given, **shares, "as_told": share})
    return pd.DataFrame(rows)


def error_table(
    model: BimodalPaths | PathNetwork, sigmas: Iterable[float], *, num_samples: int = 800, seed: int = 0
) -> pd.DataFrame:
    """Measure the error of the clean estimate at each noise level, with no side given.

    Args:
      model: as for `sample_paths`.
      sigmas: noise levels.
      num_samples: real paths; they and their noise are the same for all models and levels.
      seed: of the paths and the noise.

    Returns:
      Columns sigma and x0_error, root mean square over frames and coordinates, metres. The exact
      denoiser's is the lowest there is: the spread that noise and condition leave.
    """
    key_path, key_noise = jax.random.split(jax.random.key(seed))
    x0, side = model.data.draw(key_path, num_samples)
    noise = jax.random.normal(key_noise, x0.shape)
    rows = []
    for sigma in np.asarray(list(sigmas), np.float32):
        x0_hat = _denoise(model, samplers.add_noise(x0, sigma, noise), sigma, UNKNOWN * side)
        error = float(jnp.sqrt(jnp.mean((x0_hat - x0) ** 2)))
        rows.append({"sigma": float(sigma), "x0_error": error})
    return pd.DataFrame(rows)
