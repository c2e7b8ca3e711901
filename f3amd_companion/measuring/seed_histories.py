"""Walks from the captured histories that weights carry with them, for which no motion data are needed."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from f3amd_companion.measuring.literal_update import Walks, walk_conditions
from f3amd_lib.data.features import path_condition
from f3amd_lib.networks.conditioning import Condition
from f3amd_lib.rollout.start_poses import pose_speed
from f3amd_lib.training.checkpoints import TrainedModel


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
      trained, steps, **settings: as for `literal_update.walk_conditions`.

    Returns:
      The walks; nothing real stands beside them.
    """
    return walk_conditions(trained, seed_condition(trained), steps, **settings)
