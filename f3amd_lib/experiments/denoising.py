"""What a network does with one window: error against noise level, use of its noise, motion quality.

A network that predicts clean motion can lower its loss by ignoring the noisy input and answering
with the mean of what history, path and style allow. Such a network gives the same answer at every
noise level and for every seed; these functions tell.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pandas as pd

from f3amd_lib.data.features import frame_positions
from f3amd_lib.data.windows import Batch, WindowSet, spread_windows
from f3amd_lib.diffusion.samplers import add_noise
from f3amd_lib.generation.rollout import MotionGenerator
from f3amd_lib.measures.distributions import diversity, mean_and_interval
from f3amd_lib.measures.metrics import joint_acceleration
from f3amd_lib.training.checkpoints import TrainedModel
from f3amd_lib.training.denoising_task import DenoisingTask, network_inputs

CM = 100.0


def held_out_batch(windows: WindowSet, trained: TrainedModel, num_samples: int = 512) -> Batch:
    """Return windows spread evenly over a held-out set, unturned, with the path as captured."""
    config = trained.config
    if (windows.window, windows.num_history) != (config.window, config.num_history):
        raise ValueError(
            f"{trained.name} takes {config.num_history} + {config.window} frames, but the windows "
            f"were built for {windows.num_history} + {windows.window}"
        )
    return spread_windows(windows, num_samples)


def _joint_error(trained: TrainedModel, x0_hat, batch: Batch):
    predicted = frame_positions(trained.skeleton, trained.normaliser.denormalise(x0_hat))
    real = frame_positions(trained.skeleton, batch.future)
    return CM * jnp.mean(jnp.linalg.norm(predicted - real, axis=-1))


def x0_error_by_sigma(
    trained: TrainedModel, windows: WindowSet, sigmas, *, num_samples: int = 512, seed: int = 0
) -> pd.DataFrame:
    """Measure the error of the clean estimate at each noise level, on one draw of noise.

    Args:
      trained: the model.
      windows: held-out windows.
      sigmas: noise levels, [N].
      num_samples: windows to use.
      seed: of the noise, the same at every level.

    Returns:
      Columns sigma, x0_error (root mean square, network units), joint_error_cm, and input_error:
      the error of the noisy input itself, which is sigma. Where x0_error does not fall below its
      value at high sigma although sigma does, the network does not use its input.
    """
    batch = held_out_batch(windows, trained, num_samples)
    x0, condition = network_inputs(batch, trained.normaliser)
    network = trained.network()
    noise = jax.random.normal(jax.random.key(seed), x0.shape)

    @jax.jit
    def measure(sigma):
        x0_hat = network(add_noise(x0, sigma, noise), sigma, network.encode(condition))
        error = jnp.sqrt(jnp.mean((x0_hat - x0) ** 2))
        return error, _joint_error(trained, x0_hat, batch)

    rows = [(float(sigma), *map(float, measure(jnp.float32(sigma))), float(sigma)) for sigma in sigmas]
    return pd.DataFrame(rows, columns=["sigma", "x0_error", "joint_error_cm", "input_error"])


def gradient_norm_by_sigma(
    task: DenoisingTask, params, windows: WindowSet, sigmas, *, num_samples: int = 64, seed: int = 0
) -> pd.DataFrame:
    """Measure how strongly a single window pulls at the weights at each noise level (claim T5).

    Args:
      task: whose loss is asked, the sum that it is trained on.
      params: weights at which the gradient is taken.
      windows: held-out windows.
      sigmas: noise levels, [N].
      num_samples: windows to use, one gradient each.
      seed: of the noise, the same at every level.

    Returns:
      Columns sigma, value (mean over windows of the gradient's Euclidean norm), low, high (95 %), repeats.

    Source: paper section 6 ("small-noise samples contribute little to the gradient").
    """
    batch = spread_windows(windows, num_samples)
    keys = jax.random.split(jax.random.key(seed), batch.future.shape[0])

    @jax.jit
    def norms(sigma):
        def of_one(given):
            window, key = given
            drawn = jax.tree.map(lambda leaf: leaf[None], window), sigma[None]
            return optax.global_norm(jax.grad(lambda weights: task.loss(weights, None, drawn, key)[0])(params))

        return jax.lax.map(of_one, (batch, keys))

    rows = [{"sigma": float(sigma), **mean_and_interval(np.asarray(norms(jnp.float32(sigma))))} for sigma in sigmas]
    return pd.DataFrame(rows)


def window_quality(generator: MotionGenerator, windows: WindowSet, *, num_samples: int = 512, seed: int = 0) -> dict:
    """Sample one window for each of many held-out conditions and compare with what was captured.

    Returns:
      joint_error_cm; joint_acceleration_cm (per frame squared) and its real value; seam_cm, the
      mean joint step from the last history frame to the first of the window, and its real value.
    """
    trained = generator.trained
    batch = held_out_batch(windows, trained, num_samples)
    _, condition = network_inputs(batch, trained.normaliser)
    x0_hat = jax.jit(generator.sample_window)(jax.random.key(seed), condition)
    predicted = frame_positions(trained.skeleton, trained.normaliser.denormalise(x0_hat))
    real = frame_positions(trained.skeleton, batch.future)
    before = frame_positions(trained.skeleton, batch.history[:, -1])

    def seam(positions):
        return float(CM * jnp.mean(jnp.linalg.norm(positions[:, 0] - before, axis=-1)))

    return {
        "joint_error_cm": float(_joint_error(trained, x0_hat, batch)),
        "joint_acceleration_cm": float(np.mean(joint_acceleration(np.asarray(predicted)))),
        "real_joint_acceleration_cm": float(np.mean(joint_acceleration(np.asarray(real)))),
        "seam_cm": seam(predicted),
        "real_seam_cm": seam(real),
    }


def seed_spread(
    generator: MotionGenerator, windows: WindowSet, *, num_conditions: int = 32, num_seeds: int = 10, seed: int = 0
) -> float:
    """Return how far samples of one condition differ, in cm: `diversity` of one round.

    Averaged over several held-out conditions, for a steadier figure.
    """
    trained = generator.trained
    batch = held_out_batch(windows, trained, num_conditions)
    _, condition = network_inputs(batch, trained.normaliser)

    @jax.jit
    def sample_positions(key):
        x0_hat = generator.sample_window(key, condition)
        return frame_positions(trained.skeleton, trained.normaliser.denormalise(x0_hat))

    keys = jax.random.split(jax.random.key(seed), num_seeds)
    return diversity(np.stack([np.asarray(sample_positions(key)) for key in keys], axis=1))


def noise_use(generator: MotionGenerator, windows: WindowSet, *, low_sigma: float = 0.1, seed: int = 0) -> dict:
    """Say whether a model uses its noisy input.

    Returns:
      x0_error_ratio: x0 error at `low_sigma` over that at sigma_max; near 1 the input is ignored. A
        network that takes the number of a step is asked at its lowest level, if that is higher;
        one with a single level has no such ratio, NaN.
      seed_spread_cm: see `seed_spread`; near 0 every seed gives the same motion.
    """
    top = float(generator.sigmas[0])
    lowest = max(low_sigma, min(getattr(generator.trained.config, "noise_levels", ()) or (0.0,)))
    low, high = float("nan"), 1.0
    if lowest < top:
        table = x0_error_by_sigma(generator.trained, windows, [lowest, top], seed=seed)
        low, high = table["x0_error"]
    return {"x0_error_ratio": float(low / high), "seed_spread_cm": seed_spread(generator, windows, seed=seed)}


def window_row(trained: TrainedModel, windows: WindowSet, *, steps=(8, 1), seed: int = 0) -> pd.DataFrame:
    """Measure what a model does with single held-out windows, and whether it uses its noise.

    Args:
      trained: the model.
      windows: held-out.
      steps: numbers of denoising steps.
      seed: of the noise.

    Returns:
      A row per number of steps: steps, then the figures of `noise_use` and `window_quality`.
    """
    rows = []
    for count in steps:
        generator = MotionGenerator(trained, count)
        figures = noise_use(generator, windows, seed=seed)
        rows.append({"steps": count, **figures, **window_quality(generator, windows, seed=seed)})
    return pd.DataFrame(rows)
