"""Three ways to one step on the toy of the wall: a mean, many steps, a student that was distilled from many steps."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pandas as pd
from f3amd_lib.diffusion import samplers
from f3amd_lib.diffusion.schedules import NoiseSchedule
from f3amd_lib.text.phases import consistency_answer
from f3amd_lib.training.optimise import TrainingState, advance, initial_state
from f3amd_lib.training.recipe import TrainingConfig

from f3amd_notebooks.bimodal_paths import (
    UNKNOWN,
    BimodalPaths,
    PathNetwork,
    crossing,
    optimiser_by_seed,
    outcome_shares,
    sample_paths,
)


@functools.partial(
    jax.tree_util.register_dataclass, data_fields=("networks",), meta_fields=("config", "diffusion", "levels", "seeds")
)
@dataclass(frozen=True, eq=False)
class PathStudentTask:
    """Students of one step, one a seed, side by side (a `training.optimise.Task`); the teacher is exact.

    Attributes:
      networks: with which the students begin; each leaf of their weights is [S, ...].
      config: the recipe; its moving average is the target.
      diffusion: the noise.
      levels: of the teacher's walk that is distilled.
      seeds: of what each student sees.
    """

    name: ClassVar[str] = "students past a wall"

    networks: PathNetwork
    config: TrainingConfig
    diffusion: NoiseSchedule
    levels: int
    seeds: tuple[int, ...]

    @property
    def optimiser(self) -> optax.GradientTransformation:
        """The recipe's, for each seed on its own."""
        return optimiser_by_seed(self.config)

    def identity(self) -> dict:
        """Return the recipe; no state of this toy is kept in a file."""
        return {"training": self.config.to_dict()}

    def init(self, key):
        """Return the weights that the task came with."""
        return self.networks.params, None

    def draw(self, state: TrainingState, key):
        """Draw paths, sides, points of the walk and noise of every seed, and the target's weights."""
        keys = jax.vmap(lambda seed: jax.random.fold_in(key, seed))(jnp.asarray(self.seeds))
        return (jax.vmap(self._questions)(keys), state.ema), key

    def _questions(self, key):
        key_path, key_known, key_point, key_noise = jax.random.split(key, 4)
        size = (self.config.batch_size,)
        x0, side = self.networks.data.draw(key_path, *size)
        side = jnp.where(jax.random.bernoulli(key_known, 0.5, size), side, UNKNOWN)
        point = jax.random.randint(key_point, size, 0, self.levels)
        grid = jnp.asarray(self.diffusion.grid(self.levels), jnp.float32)
        x_noisy = samplers.add_noise(x0, grid[point][:, None, None], jax.random.normal(key_noise, x0.shape))
        return x_noisy, grid[point], grid[point + 1], side

    def loss(self, params, statistics, drawn, key):
        """Return the sum over seeds of the square distance from the target's answer."""
        asked, target = drawn

        def of_one(params, target, x_noisy, sigma, sigma_next, side):
            denoiser = lambda model: lambda x_noisy, sigma: model.denoise(x_noisy, sigma, side)
            student, answering = (dataclasses.replace(self.networks, params=weights) for weights in (params, target))
            teacher = denoiser(self.networks.data)
            answer = consistency_answer(teacher, denoiser(answering), x_noisy, sigma, sigma_next)
            return jnp.mean((denoiser(student)(x_noisy, sigma) - jax.lax.stop_gradient(answer)) ** 2)

        by_seed = jax.vmap(of_one)(params, target, *asked)
        return by_seed.sum(), ({"loss": by_seed.sum(), "by_seed": by_seed}, statistics)


def distil_networks(
    networks: Sequence[PathNetwork], diffusion: NoiseSchedule, seeds: Sequence[int], *, levels: int = 16,
    num_steps: int = 1500, batch_size: int = 32, learning_rate: float = 4e-3, ema_decay: float = 0.95,
) -> tuple[list[PathNetwork], np.ndarray]:  # fmt: skip
    """Distil the exact denoiser's walk into one step of networks, which begin with the weights that they have.

    Args:
      networks: one a seed.
      diffusion: the noise.
      seeds: of what each sees.
      levels: of the walk.
      num_steps, batch_size, learning_rate, ema_decay: of the optimiser, and of the target.

    Returns:
      (a student a seed, loss at every step [S, num_steps]).
    """
    first = networks[0]
    params = jax.tree.map(lambda *leaves: jnp.stack(leaves), *[network.params for network in networks])
    recipe = TrainingConfig(
        num_steps, batch_size, learning_rate, schedule="warmup_cosine", warmup_steps=max(1, num_steps // 10),
        ema_decay=ema_decay, gradient_clip=1.0,
    )  # fmt: skip
    task = PathStudentTask(PathNetwork(params, first.data, first.graph), recipe, diffusion, levels, tuple(seeds))
    state, terms = advance(task, initial_state(task), num_steps)
    of_seed = lambda number: jax.tree.map(lambda leaf: leaf[number], state.averaged)
    students = [PathNetwork(of_seed(number), first.data, first.graph) for number in range(len(networks))]
    return students, np.asarray(terms["by_seed"]).T


def end_figures(data: BimodalPaths, paths) -> dict[str, float]:
    """Return how paths end: shares as `outcome_shares`, and the variety of those that pass on a side.

    `variety` is the deviation of where they cross, about the mean of their side, over that of real paths: 1 is all of
    it, 0 all the same; NaN where fewer than two pass on each side.
    """
    place, shares = crossing(paths), outcome_shares(data, paths)
    sides = [place[place >= data.wall], place[place <= -data.wall]]
    spread = float("nan")
    if min(map(len, sides)) >= 2:
        spread = float(np.sqrt(np.mean(np.concatenate([side - side.mean() for side in sides]) ** 2)))
    real, side = data.draw(jax.random.key(0), 4000)
    real, side = crossing(real), np.asarray(side)
    own = np.sqrt(np.mean(np.concatenate([real[side == s] - real[side == s].mean() for s in (1, 2)]) ** 2))
    return {**shares, "variety": spread / own}


def ways_table(
    ways: dict[str, tuple[Sequence, int]], diffusion: NoiseSchedule, *, num_samples: int = 400, seed: int = 0
) -> pd.DataFrame:
    """Say how paths end without a side given, for each way and seed.

    Args:
      ways: name -> (models, one a seed; steps).
      diffusion: the noise.
      num_samples: paths of each.
      seed: of the noise.

    Returns:
      Columns way, steps, seed, and those of `end_figures`.
    """
    side, rows = np.full(num_samples, UNKNOWN), []
    for way, (models, steps) in ways.items():
        for number, model in enumerate(models):
            paths = sample_paths(model, diffusion, steps, side, jax.random.key(seed + number))
            rows.append({"way": way, "steps": steps, "seed": seed + number, **end_figures(model.data, paths)})
    return pd.DataFrame(rows)
