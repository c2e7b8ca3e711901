"""What does arithmetic of fewer digits change in the motion? Metrics, not only errors."""

from __future__ import annotations

from collections.abc import Iterable

import jax.numpy as jnp
import numpy as np
import pandas as pd

from f3amd_lib.measures.protocol import evaluation_paths
from f3amd_lib.measures.real_clips import style_floor
from f3amd_lib.measures.rollout_measures import measure_rollout
from f3amd_lib.rollout.rollout import MotionGenerator


def compare_precisions(
    trained, packed, styles: Iterable[str], *, steps: int, num_frames: int, seeds: Iterable[int]
) -> pd.DataFrame:
    """Generate the same characters in float32 and in bfloat16 and measure both.

    Args:
      trained: a trained model.
      packed: its data, for paths and floors.
      styles: of the characters.
      steps: a round.
      num_frames: of each character.
      seeds: each draws paths, starting poses and noise anew.

    Returns:
      A row a metric: model, steps, metric, float32 and bfloat16 (means over seeds and characters),
      change (their difference), and seed_deviation: how much the float32 mean moves from seed to
      seed, the yardstick for the change. One more row, "joint distance (cm)": how far joints of the
      two motions are apart in the first window.
    """
    styles, seeds = list(styles), list(seeds)
    floors = [style_floor(packed, style) for style in styles]
    precisions = {"float32": jnp.float32, "bfloat16": jnp.bfloat16}
    generators = {name: MotionGenerator(trained, steps, dtype=dtype) for name, dtype in precisions.items()}
    means, distances = {name: [] for name in generators}, []
    for seed in seeds:
        paths = evaluation_paths(packed, styles, num_frames, seed=seed)
        first_windows = []
        for name, generator in generators.items():
            rollout = generator.rollout(paths, styles, seed=seed)
            measures = measure_rollout(rollout, floors)
            means[name].append({key: np.nanmean(values) for key, values in measures.items()})
            motions = [rollout.motion(character) for character in range(len(styles))]
            first_windows.append(np.stack([motion.positions[: trained.config.window] for motion in motions]))
        distances.append(100.0 * np.linalg.norm(first_windows[0] - first_windows[1], axis=-1).mean())
    float32, bfloat16 = (pd.DataFrame(rows) for rows in means.values())
    table = pd.DataFrame({"float32": float32.mean(), "bfloat16": bfloat16.mean(), "seed_deviation": float32.std()})
    table.loc["joint distance (cm)"] = {"float32": 0.0, "bfloat16": np.mean(distances), "seed_deviation": np.nan}
    table = table.rename_axis("metric").reset_index()
    table = table.assign(model=trained.name, steps=steps, change=table["bfloat16"] - table["float32"])
    return table[["model", "steps", "metric", "float32", "bfloat16", "change", "seed_deviation"]]
