"""Two readings of the printed update, walked side by side by trained networks.

Appendix F prints a DDIM step that takes a variance-exploding state and returns a preserving one. To
rescale it before the next step gives plain DDIM ("rescaled"); to leave it as it is gives another
walk ("literal", see `samplers.ddim_step_literal`). Which of the two a table was measured with can
only show where a network uses its noise. These functions look at single windows, all from the same
noise: after held-out motion (`walk_windows`), under any conditions (`walk_conditions`), or after the captured
histories that weights carry with them, for which no motion data are needed (`walk_seed_histories`). Long
rollouts choose the update by the name of its sampler, `UPDATES[...]`.
"""

from __future__ import annotations

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd

from f3amd_lib.data.features import frame_positions, path_condition
from f3amd_lib.data.windows import WindowSet, spread_windows
from f3amd_lib.diffusion.samplers import walk
from f3amd_lib.measures.denoising import CM
from f3amd_lib.measures.distributions import diversity
from f3amd_lib.measures.metrics import joint_acceleration
from f3amd_lib.networks.conditioning import Condition
from f3amd_lib.rollout.start_poses import pose_speed
from f3amd_lib.training.checkpoints import TrainedModel
from f3amd_lib.training.denoising_task import network_inputs

UPDATES = {"rescaled": "ddim", "literal": "ddim_literal"}
"""Reading of Appendix F -> name of its sampler in `samplers.SAMPLERS`."""

WINDOW_METRICS = dict.fromkeys(("joint_error", "seed_spread", "from_rescaled", "from_half_the_steps"), "cm")
WINDOW_METRICS["joint_acceleration"] = "cm/frame^2"
"""Metric of `window_figures` -> unit."""

Walks = dict[tuple[str, int], np.ndarray]
"""(update, steps) -> joints that one network made, [S, B, T, J, 3], metres; seed s has one noise in all of them."""


def walk_windows(
    trained: TrainedModel, windows: WindowSet, steps: Sequence[int] = (8, 4, 2, 1), *, spacing: str = "endpoints",
    num_windows: int = 64, num_seeds: int = 8, seed: int = 0,
) -> tuple[Walks, np.ndarray]:  # fmt: skip
    """Sample held-out windows with both updates and several numbers of steps.

    Args:
      trained: the model; its own schedule gives the noise levels.
      windows: held-out windows.
      steps: numbers of steps.
      spacing: where the steps lie, see the schedule's `grid`.
      num_windows: conditions, spread evenly over the windows.
      num_seeds: draws of noise for each.
      seed: of the noise.

    Returns:
      (the walks, joints as captured [B, T, J, 3], metres).
    """
    batch = spread_windows(windows, num_windows)
    _, condition = network_inputs(batch, trained.normaliser)
    real = frame_positions(trained.skeleton, np.asarray(batch.future))
    return walk_conditions(trained, condition, steps, spacing=spacing, num_seeds=num_seeds, seed=seed), real


def walk_conditions(
    trained: TrainedModel, condition: Condition, steps: Sequence[int] = (8, 4, 2, 1), *, spacing: str = "endpoints",
    num_seeds: int = 8, seed: int = 0,
) -> Walks:  # fmt: skip
    """Sample windows under given conditions with both updates, as `walk_windows` does.

    Args:
      trained, steps, spacing, num_seeds, seed: as for `walk_windows`.
      condition: B rows, in network units.

    Returns:
      The walks.
    """
    # One compiled evaluation serves every update and number of steps.
    denoise = trained.denoiser(condition)
    grids = {number: trained.diffusion.grid(number, spacing).astype(np.float32) for number in steps}
    made = {(update, number): [] for number in steps for update in UPDATES}
    shape = (len(condition.style), trained.config.window, trained.config.channels)
    for key in jax.random.split(jax.random.key(seed), num_seeds):
        noise = jax.random.normal(key, shape)
        for (update, number), draws in made.items():
            *_, end = walk(UPDATES[update], denoise, grids[number][0] * noise, grids[number])
            draws.append(trained.joint_positions(end.x_noisy))
    return {way: np.stack(draws) for way, draws in made.items()}


def seed_condition(trained: TrainedModel) -> Condition:
    """Return one condition for each style: its first stored history, and straight on at its pace.

    Args:
      trained: the model.

    Returns:
      Condition of as many rows as there are styles, in the order of `trained.styles`, in network
      units.
    """
    history = np.stack([trained.start_poses[style][0] for style in trained.styles])
    # Stored histories end at the origin and face +Z.
    ahead = pose_speed(history)[:, None] * np.arange(1, trained.config.window + 1)
    position = np.stack([0.0 * ahead, ahead], axis=-1)
    path = path_condition(position, 0.0 * ahead).astype(np.float32)
    return Condition(
        history=trained.normaliser.normalise(jnp.asarray(history)),
        path=trained.normaliser.normalise_path(jnp.asarray(path)),
        style=jnp.eye(len(trained.styles), dtype=jnp.float32),
    )


def walk_seed_histories(trained: TrainedModel, steps=(8, 4, 2, 1), **settings) -> Walks:
    """Sample the window after a stored history of each style with both updates.

    Args:
      trained, steps, **settings: as for `walk_conditions`.

    Returns:
      The walks; nothing real stands beside them.
    """
    return walk_conditions(trained, seed_condition(trained), steps, **settings)


def _distance(first: np.ndarray, second: np.ndarray) -> float:
    """Return the mean distance of joints, cm."""
    return float(CM * np.mean(np.linalg.norm(first - second, axis=-1)))


def window_figures(made: Walks, real: np.ndarray | None = None) -> pd.DataFrame:
    """Measure what walks from the same noise made.

    Args:
      made: walks, of `walk_windows` or `walk_conditions`.
      real: joints as captured, [B, T, J, 3], metres; None where nothing was.

    Returns:
      Columns update, steps, metric, unit, value, means over windows and seeds; update "real" with
      0 steps is what was captured, where something was. Metrics:
        joint_error: distance of joints from what was captured;
        joint_acceleration: see `metrics.joint_acceleration`;
        seed_spread: `diversity` over the seeds of one condition;
        from_rescaled: distance of joints from the rescaled walk of as many steps;
        from_half_the_steps: distance of joints from the same update with half the steps, where
          that was walked.
    """
    rows = []
    if real is not None:
        rows.append(("real", 0, "joint_acceleration", float(np.mean(joint_acceleration(real)))))
    for (update, number), joints in made.items():
        figures = {} if real is None else {"joint_error": _distance(joints, real)}
        figures |= {
            "joint_acceleration": float(np.mean(joint_acceleration(joints))),
            "seed_spread": diversity(np.swapaxes(joints, 0, 1)),
            "from_rescaled": _distance(joints, made["rescaled", number]),
        }
        if number % 2 == 0 and (update, number // 2) in made:
            figures["from_half_the_steps"] = _distance(joints, made[update, number // 2])
        rows += [(update, number, name, value) for name, value in figures.items()]
    table = pd.DataFrame(rows, columns=["update", "steps", "metric", "value"])
    table.insert(3, "unit", table["metric"].map(WINDOW_METRICS))
    return table
