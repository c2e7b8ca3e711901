"""What does arithmetic of fewer digits change in the motion? Metrics, not only errors."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pandas as pd
from tqdm import tqdm

from f3amd_lib.experiments.protocol import evaluation_paths
from f3amd_lib.experiments.quality import measure_rollout, style_floor
from f3amd_lib.generation.rollout import MotionGenerator
from f3amd_lib.ground.profiles import Profile, results_dir
from f3amd_lib.ground.records import run_record, write_table
from f3amd_lib.networks import presets
from f3amd_lib.training.pipeline import PreparedData, available_models, obtain_model


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
    generators = {
        name: MotionGenerator(trained, steps, dtype=dtype)
        for name, dtype in (("float32", jnp.float32), ("bfloat16", jnp.bfloat16))
    }
    means, apart = {name: [] for name in generators}, []
    for seed in seeds:
        paths = evaluation_paths(packed, styles, num_frames, seed=seed)
        made = {name: g.rollout(paths, styles, seed=seed) for name, g in generators.items()}
        for name, rollout in made.items():
            measures = measure_rollout(rollout, floors)
            means[name].append({key: np.nanmean(values) for key, values in measures.items()})
        positions = [
            np.stack([np.asarray(rollout.motion(k).positions) for k in range(len(styles))]) for rollout in made.values()
        ]
        first = slice(0, trained.config.window)
        gaps = np.linalg.norm(positions[0][:, first] - positions[1][:, first], axis=-1)
        apart.append(100.0 * gaps.mean())
    tables = {name: pd.DataFrame(rows) for name, rows in means.items()}
    rows = [
        {
            "metric": metric,
            "float32": tables["float32"][metric].mean(),
            "bfloat16": tables["bfloat16"][metric].mean(),
            "seed_deviation": tables["float32"][metric].std(),
        }
        for metric in tables["float32"]
    ]
    rows.append({"metric": "joint distance (cm)", "float32": 0.0, "bfloat16": np.mean(apart)})
    table = pd.DataFrame(rows)
    table.insert(3, "change", table["bfloat16"] - table["float32"])
    return table.assign(model=trained.name, steps=steps)[
        ["model", "steps", "metric", "float32", "bfloat16", "change", "seed_deviation"]
    ]


def measure_precision(prepared: PreparedData, profile: Profile, models: Iterable[str] | None = None) -> Path:
    """Compare float32 and bfloat16 on trained models, with 1 step and with 8.

    Args:
      prepared: the data.
      profile: says how long rollouts are, and where models and results lie.
      models: presets; by default all that have weights.

    Returns:
      The table `records/precision.csv`.

    Raises:
      ValueError: if no model has weights.
    """
    packed, seeds = prepared.packed, range(profile.seed, profile.seed + 5)
    styles = list(profile.evaluation_styles or packed.primary_styles[: profile.num_characters])
    chosen = [presets.find_preset(name).name for name in models or available_models(profile)]
    if not chosen:
        raise ValueError(f"no model of {profile.dataset} has weights: name one, it is then trained")
    tables = []
    for model in tqdm(chosen, unit="model"):
        trained, _, _ = obtain_model(prepared, profile, preset=model)
        frames = profile.rollout_rounds * profile.window
        tables += [
            compare_precisions(trained, packed, styles, steps=steps, num_frames=frames, seeds=seeds) for steps in (1, 8)
        ]
    record = run_record(
        profile=profile, dataset=packed, seed=profile.seed, measurement="precision",
        styles=styles, num_seeds=len(seeds),
    )  # fmt: skip
    path = results_dir(profile.dataset, profile.name) / "records" / "precision.csv"
    return write_table(path, pd.concat(tables), record)
