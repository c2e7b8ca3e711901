"""How much history, path and style leave open: the spread of real continuations, and of answers.

One step of a sampler returns the mean of what a condition allows, so that it is enough where the
condition allows little. Three figures say how much that is, all in centimetres of joints relative
to the root, after forward kinematics, by the formula of Diversity (Appendix C):

- the spread of real continuations that began alike (`continuation_spread`), which needs no model;
- the error of a model's clean estimate (`answer_spread`): none can be below the spread that is
  left once the noisy input is known, and the best of all denoisers has exactly that one;
- the spread of its estimates over draws of noise on one clean window (`answer_spread`): 0 for a
  network that ignores its noisy input.

Neighbours never began quite alike and networks are never the best ones, so that the first two
bound what is left open at the highest noise level from above.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
from scipy.spatial.distance import cdist

from f3amd_lib.data.features import frame_positions, frame_yaw
from f3amd_lib.data.windows import WindowSet, gather_windows, spread_windows
from f3amd_lib.diffusion.samplers import add_noise
from f3amd_lib.ground.arrays import in_batches
from f3amd_lib.measures.denoising import CM, root_mean_square
from f3amd_lib.measures.distributions import diversity_variance
from f3amd_lib.motion.skeleton import Skeleton
from f3amd_lib.training.checkpoints import TrainedModel
from f3amd_lib.training.denoising_task import network_inputs

GIVEN = {"style": (), "style, path": ("path",), "style, path, history": ("path", "history")}
"""What continuations have in common -> what is compared to find them, beside the style."""

POSTERIOR = {
    "smoke": {"num_windows": 24, "num_draws": 4, "num_levels": 8, "num_neighbours": 4},
    "laptop": {"num_windows": 128, "num_draws": 8, "num_levels": 15, "num_neighbours": 8},
}
"""How much is measured, by profile; others take what `laptop` takes."""

_CHUNK = 2048


# -------------------------------------------------------------------------------- real motion


def _facing_windows(skeleton: Skeleton, windows: WindowSet, index):
    """Cut windows with the last history frame at the origin, facing +Z.

    Returns:
      Joints of the history [B, H, J, 3], path condition as captured [B, T, 8], joints of the
      continuation relative to its root [B, T, J, 3].
    """
    last = windows.frames[windows.starts[index] + windows.num_history - 1]
    batch = gather_windows(windows, index, -frame_yaw(skeleton, last), jnp.zeros(index.shape, jnp.int32))
    future = frame_positions(skeleton, batch.future)
    return frame_positions(skeleton, batch.history), batch.path, future - future[..., :1, :]


def _conditions(skeleton: Skeleton, windows: WindowSet, index) -> dict[str, np.ndarray]:
    """Return what is compared, [B, D] each: distances are root mean squares over frames, in m."""

    @jax.jit
    def cut(windows, index):
        history, path, _ = _facing_windows(skeleton, windows, index)
        joints = history.shape[1] * history.shape[2]
        return {
            "history": history.reshape(len(index), -1) / jnp.sqrt(joints),
            "path": path.reshape(len(index), -1) / jnp.sqrt(path.shape[1]),
        }

    return in_batches(lambda rows: cut(windows, index[rows]), len(index), min(_CHUNK, len(index)))


def _apart(order: np.ndarray, starts: np.ndarray, gap: int, most: int) -> list[int]:
    """Return the first entries of an order whose windows do not overlap, at most so many."""
    chosen: list[int] = []
    for place in order:
        if all(abs(starts[place] - starts[other]) >= gap for other in chosen):
            chosen.append(int(place))
            if len(chosen) == most:
                break
    return chosen


def continuation_spread(
    skeleton: Skeleton, windows: WindowSet, pool: WindowSet, *, num_windows: int = 128, num_neighbours: int = 8,
    seed: int = 0,
) -> pd.DataFrame:  # fmt: skip
    """Measure how far real motion goes apart that had style, path and history in common.

    For each of some windows, the windows of `pool` that are nearest to it are looked up: of its
    style, turned so that the last history frame stands at the origin and faces +Z, and compared by

        d^2 = mean_{frames, joints} |p - p'|^2 (history) + mean_frames |y - y'|^2 (path)

    with joints p in metres and the eight numbers y of the path condition (section 3.3), in which a
    radian of facing counts as a metre. No two of them overlap, lest one walk be counted twice.
    Their continuations' spread is the unbiased deviation over neighbours of joints relative to the
    root, the formula of Diversity.

    Args:
      skeleton: of the data.
      windows: the windows that neighbours are looked up for, usually held out; some of them are
        taken, spread evenly.
      pool: where neighbours are looked up, usually the training windows. If it is `windows` itself,
        a window is not its own neighbour, nor are those that overlap it.
      num_windows: how many windows to take.
      num_neighbours: K, at least 2. Where a style has fewer, those there are; one with less than 2
        is left out.
      seed: of the random draws.

    Returns:
      Columns given (a key of `GIVEN`; with "style" alone neighbours are drawn at random), value, low, high (cm;
      root mean square over windows with its 95 % interval), repeats (windows), neighbours (mean number),
      history_apart and path_apart (root mean squares of the distances to the neighbours, in cm).

    Raises:
      ValueError: if no window has two neighbours in the pool.

    Source: ours. Neighbours differ a little in their conditions, which makes the value larger than
    the spread under one condition, the less so the smaller the distances are; neighbours from one
    clip share a walker's habits, which makes it smaller.
    """
    rng = np.random.default_rng(seed)
    count = min(num_windows, windows.num_windows)
    chosen = np.linspace(0, windows.num_windows - 1, count).astype(np.int32)
    asked = _conditions(skeleton, windows, chosen)
    styles, pool_styles = np.asarray(windows.styles)[chosen], np.asarray(pool.styles)
    gap = pool.window + pool.num_history
    continuations = jax.jit(lambda pool, index: _facing_windows(skeleton, pool, index)[2])
    found = []
    for style in np.unique(styles):
        candidates = np.flatnonzero(pool_styles == style).astype(np.int32)
        if not len(candidates):
            continue
        there = _conditions(skeleton, pool, candidates)
        starts = np.asarray(pool.starts)[candidates]
        of_style = np.flatnonzero(styles == style)
        squares = {k: cdist(asked[k][of_style], there[k], "sqeuclidean") for k in there}
        for row, query in enumerate(of_style):
            usable = np.arange(len(candidates))
            if pool is windows:
                own = int(np.asarray(windows.starts)[chosen[query]])
                usable = usable[np.abs(starts - own) >= gap]
            for name, compared in GIVEN.items():
                parts = [squares[part][row, usable] for part in compared]
                order = np.argsort(sum(parts)) if parts else rng.permutation(len(usable))
                near = _apart(usable[order], starts, gap, num_neighbours)
                if len(near) > 1:
                    # Of the same length for all, so that there is one compilation; copies are cut off again.
                    joints = continuations(pool, np.resize(candidates[near], num_neighbours))[: len(near)]
                    neighbours = {"neighbours": len(near)} | {part: squares[part][row, near].mean() for part in squares}
                    found.append({"given": name, "variance": diversity_variance(np.asarray(joints))} | neighbours)
    if not found:
        raise ValueError(f"no style has two windows of {gap} frames in the pool that do not overlap: take more data")
    rows = []
    for name, of_windows in pd.DataFrame(found).groupby("given", sort=False):
        mean = {column: np.mean(of_windows[column].to_numpy()) for column in ("neighbours", "history", "path")}
        apart = {f"{part}_apart": CM * np.sqrt(mean[part]) for part in ("history", "path")}
        rows.append(
            {"given": name, **root_mean_square(of_windows["variance"]), "neighbours": mean["neighbours"], **apart}
        )
    return pd.DataFrame(rows)


# -------------------------------------------------------------------------------- trained models


def answer_spread(
    trained: TrainedModel, windows: WindowSet, sigmas, *, num_windows: int = 128, num_draws: int = 8, seed: int = 0
) -> pd.DataFrame:
    """Measure how a model's clean estimates spread and err, at each noise level.

    A clean held-out window x0 and its condition are kept, noise is drawn several times, and the
    estimates x0_hat(x0 + sigma noise) are turned into joints relative to the root.

    Args:
      trained: the model.
      windows: held-out windows; some of them are taken, spread evenly.
      sigmas: noise levels, [N]. A network that takes the number of a step is asked at those of
        its own levels that lie between the lowest and the highest of them.
      num_windows: how many windows to take.
      num_draws: noise draws for each window and level, at least 2; the same at every level.
      seed: of the noise.

    Returns:
      Columns quantity, unit, sigma, value, low, high (root mean square over windows with its 95 %
      interval), repeats (windows). "answer spread" (cm) is the unbiased deviation over draws (the
      formula of Diversity), "error" (cm) the distance of the estimates from x0, both of joints
      relative to the root; "x0 error" is that of the features in network units.

    Raises:
      ValueError: for fewer than 2 draws.

    Source: ours.
    """
    batch = spread_windows(windows, num_windows)
    x0, condition = network_inputs(batch, trained.normaliser)
    network = trained.network()

    def poses(frames):
        positions = frame_positions(trained.skeleton, frames)
        return positions - positions[..., :1, :]

    real = poses(batch.future)

    @jax.jit
    def measure(sigma, keys):
        context = network.encode(condition)

        def answer(key):
            x_noisy = add_noise(x0, sigma, jax.random.normal(key, x0.shape))
            x0_hat = network(x_noisy, sigma, context)
            x0_error = jnp.mean((x0_hat - x0) ** 2, axis=(1, 2))
            return poses(trained.normaliser.denormalise(x0_hat)), x0_error

        # One draw after the other: all at once would need as many times the memory.
        made, x0_error = jax.lax.map(answer, keys)
        error = jnp.sum((made - real) ** 2, axis=-1).mean(axis=(0, 2, 3))
        return made, error, x0_error.mean(axis=0)

    keys = jax.random.split(jax.random.key(seed), num_draws)
    rows = []
    for sigma in _levels_of(trained, sigmas):
        made, error, x0_error = measure(jnp.float32(sigma), keys)
        spread = [diversity_variance(draws) for draws in np.moveaxis(np.asarray(made), 0, 1)]
        for quantity, squares in (("answer spread", spread), ("error", error), ("x0 error", x0_error)):
            unit, scale = ("network units", 1.0) if quantity == "x0 error" else ("cm", CM)
            interval = root_mean_square(squares, scale)
            rows.append({"quantity": quantity, "unit": unit, "sigma": sigma, **interval})
    return pd.DataFrame(rows).sort_values(["quantity", "sigma"], ignore_index=True)


def _levels_of(trained: TrainedModel, sigmas) -> list[float]:
    """Return the noise levels that a network can be asked at."""
    sigmas = [float(sigma) for sigma in sigmas]
    known = getattr(trained.config, "noise_levels", ())
    return [level for level in known if min(sigmas) <= level <= max(sigmas)] or [max(known)] if known else sigmas
