"""What a network does with one window: error against noise level, use of its inputs, motion quality.

A network that predicts clean motion can lower its loss by ignoring the noisy input and answering
with the mean of what history, path and style allow. Such a network gives the same motion for every
seed. It may still change its answer with the noise level that it is told, so that its motion differs
with the number of steps. These functions tell the two apart.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd

from f3amd_lib.data.features import frame_positions
from f3amd_lib.data.windows import Batch, WindowSet, spread_windows
from f3amd_lib.diffusion.samplers import add_noise, walk
from f3amd_lib.diffusion.schedules import variance_preserving_cosine
from f3amd_lib.measures.distributions import diversity, mean_and_interval
from f3amd_lib.measures.metrics import joint_acceleration
from f3amd_lib.rollout.rollout import MotionGenerator
from f3amd_lib.training.checkpoints import TrainedModel
from f3amd_lib.training.denoising_task import network_inputs

CM = 100.0

WINDOWS = 512
"""Held-out windows that are looked at, spread evenly."""


def held_out_batch(windows: WindowSet, trained: TrainedModel, num_samples: int = WINDOWS) -> Batch:
    """Return windows spread evenly over a held-out set; ValueError for windows of other sizes than the model's."""
    config = trained.config
    if (windows.window, windows.num_history) != (config.window, config.num_history):
        sizes = f"windows are of {windows.num_history} + {windows.window} frames"
        raise ValueError(f"{sizes}, but {trained.name} takes {config.num_history} + {config.window}")
    return spread_windows(windows, num_samples)


def held_out_condition(windows: WindowSet, trained: TrainedModel, num_conditions: int = 32):
    """Return the conditions of windows spread evenly over a held-out set, in network units."""
    return network_inputs(held_out_batch(windows, trained, num_conditions), trained.normaliser)[1]


def root_mean_square(squares) -> dict:
    """Return the root of a mean over windows, [W], of squares in square metres, in cm, with its 95 % interval."""
    interval, bounds = mean_and_interval(squares), ("value", "low", "high")
    # The interval of a mean of squares may reach below 0, that of its root may not.
    return interval | {bound: CM * float(np.sqrt(np.maximum(interval[bound], 0.0))) for bound in bounds}


def _apart(positions, others) -> float:
    """Return the mean distance of joints [..., J, 3] in metres from others, cm."""
    return CM * float(np.mean(np.linalg.norm(positions - others, axis=-1)))


def x0_error_by_sigma(trained: TrainedModel, windows: WindowSet, sigmas, *, seed: int = 0) -> pd.DataFrame:
    """Measure the error of the clean estimate at each noise level, on one draw of noise.

    Args:
      trained: the model.
      windows: held-out windows.
      sigmas: noise levels, [N].
      seed: of the noise, the same at every level.

    Returns:
      Columns sigma, x0_error (root mean square, network units), joint_error_cm, and input_error:
      the error of the noisy input itself, which is sigma. Where x0_error does not fall below its
      value at high sigma although sigma does, the network does not use its input.
    """
    batch = held_out_batch(windows, trained)
    x0, condition = network_inputs(batch, trained.normaliser)
    denoise = trained.denoiser(condition)
    noise, rows = jax.random.normal(jax.random.key(seed), x0.shape), []
    real = frame_positions(trained.skeleton, np.asarray(batch.future))
    for sigma in map(float, sigmas):
        x0_hat = denoise(add_noise(x0, sigma, noise), sigma)
        error = float(jnp.sqrt(jnp.mean((x0_hat - x0) ** 2)))
        rows.append((sigma, error, _apart(trained.joint_positions(x0_hat), real), sigma))
    return pd.DataFrame(rows, columns=["sigma", "x0_error", "joint_error_cm", "input_error"])


def held_out_error(trained: TrainedModel, windows: WindowSet, *, seed: int = 0) -> float:
    """Return how far joints of the clean estimates lie from held-out ones, cm; it compares where losses do not.

    The mean over CAMDM's eight noise levels; a network trained on its own levels is evaluated at those.
    """
    shared = np.minimum(variance_preserving_cosine().levels, trained.diffusion.sigma_max)
    levels = getattr(trained.config, "noise_levels", ()) or shared
    return float(x0_error_by_sigma(trained, windows, levels, seed=seed)["joint_error_cm"].mean())


def window_quality(generator: MotionGenerator, windows: WindowSet, *, seed: int = 0) -> dict:
    """Sample one window for each of many held-out conditions and compare with what was captured.

    Returns:
      joint_error_cm; joint_acceleration_cm (per frame squared) and its real value; seam_cm, the
      mean joint step from the last history frame to the first of the window, and its real value.
    """
    trained = generator.trained
    batch = held_out_batch(windows, trained)
    _, condition = network_inputs(batch, trained.normaliser)
    predicted = trained.joint_positions(generator.sample(jax.random.key(seed), condition))
    real = frame_positions(trained.skeleton, np.asarray(batch.future))
    before = frame_positions(trained.skeleton, np.asarray(batch.history[:, -1]))
    return {
        "joint_error_cm": _apart(predicted, real),
        "joint_acceleration_cm": float(np.mean(joint_acceleration(predicted))),
        "real_joint_acceleration_cm": float(np.mean(joint_acceleration(real))),
        "seam_cm": _apart(predicted[:, 0], before), "real_seam_cm": _apart(real[:, 0], before),
    }  # fmt: skip


def seed_spread(
    generator: MotionGenerator, windows: WindowSet, *, num_conditions: int = 32, num_seeds: int = 10, seed: int = 0
) -> float:
    """Return how far samples of one condition differ, in cm: `diversity` of one round.

    Averaged over several held-out conditions, for a steadier figure.
    """
    trained = generator.trained
    condition = held_out_condition(windows, trained, num_conditions)
    keys = jax.random.split(jax.random.key(seed), num_seeds)
    return diversity(np.stack([trained.joint_positions(generator.sample(key, condition)) for key in keys], axis=1))


def noise_use(generator: MotionGenerator, windows: WindowSet, *, seed: int = 0) -> dict:
    """Say whether a model uses its noisy input.

    Returns:
      x0_error_ratio: x0 error at sigma = 0.1 over that at sigma_max; near 1 the input is ignored. A
        network that takes the number of a step is asked at its lowest level, if that is higher;
        one with a single level has no such ratio, NaN.
      seed_spread_cm: see `seed_spread`; near 0 every seed gives the same motion.
    """
    top = float(generator.sigmas[0])
    lowest = max(0.1, min(getattr(generator.trained.config, "noise_levels", ()) or (0.0,)))
    low, high = float("nan"), 1.0
    if lowest < top:
        table = x0_error_by_sigma(generator.trained, windows, [lowest, top], seed=seed)
        low, high = table["x0_error"]
    return {"x0_error_ratio": float(low / high), "seed_spread_cm": seed_spread(generator, windows, seed=seed)}


def estimate_variances(estimates) -> tuple[float, float]:
    """Split the variance of clean estimates on a walk: over noise at one level, and over levels.

    With estimates x_ls at level l, from seed s, all under one condition, the total variance is

        Var x_ls = mean_l Var_s x_ls  +  Var_l mean_s x_ls.

    The first part is 0 for a network that ignores its noisy input, the second for one that ignores
    the level it is told. The second is 0 for an exact denoiser, too: its mean over seeds is
    E[x0 | condition] at every level.

    Args:
      estimates: [L, S, ..., D], levels, at least 2 seeds, then what is averaged (such as frames and
        joints) and the coordinates, which are summed.

    Returns:
      (over noise, over levels), in squared units of the estimates, both unbiased in the seeds.

    Source: ours; the law of total variance.
    """
    estimates = np.asarray(estimates, np.float64)
    num_seeds = estimates.shape[1]
    over_noise = estimates.var(axis=1, ddof=1)
    # What a seed does on top of its own mean. The mean over seeds has an error, whose square is taken off again.
    moved = estimates - estimates.mean(axis=0)
    over_levels = moved.mean(axis=1) ** 2 - moved.var(axis=1, ddof=1) / num_seeds
    return tuple(float(part.sum(axis=-1).mean()) for part in (over_noise, over_levels))


def input_use(
    trained: TrainedModel, condition, *, num_levels: int = 8, num_seeds: int = 10, seed: int = 0
) -> pd.DataFrame:
    """Measure how far a model's clean estimates move with its noisy input, and with the noise level.

    Args:
      trained: the model, walked by its own sampler.
      condition: B of them, in network units (`held_out_condition`).
      num_levels: levels of the walk, or as many as the model was told, if they are fewer.
      num_seeds: walks under each condition, at least 2.
      seed: of the noise.

    Returns:
      Rows metric "use_of_x" and "use_of_sigma": value, low, high (cm of joints relative to the root;
      roots of `estimate_variances`, root mean square over conditions with its 95 % interval), repeats.
    """
    denoise = trained.denoiser(condition)
    sigmas = trained.diffusion.grid(min(num_levels, len(getattr(trained.config, "noise_levels", ())) or num_levels))
    shape = (len(condition.style), trained.config.window, trained.config.channels)
    estimates = []
    for key in jax.random.split(jax.random.key(seed), num_seeds):
        key_init, key_steps = jax.random.split(key)
        x_init = float(sigmas[0]) * jax.random.normal(key_init, shape)
        visited = list(walk(trained.diffusion.sampler, denoise, x_init, sigmas, key=key_steps))[:-1]
        joints = trained.joint_positions(np.stack([one.x0_hat for one in visited]))
        estimates.append(joints - joints[..., :1, :])
    by_condition = np.moveaxis(np.array(estimates), 2, 0).swapaxes(1, 2)  # [B, L, S, T, J, 3]
    squares = np.array([estimate_variances(one) for one in by_condition])
    return pd.DataFrame(
        {"metric": metric, "unit": "cm", **root_mean_square(of_metric)}
        for metric, of_metric in zip(("use_of_x", "use_of_sigma"), squares.T, strict=True)
    )
