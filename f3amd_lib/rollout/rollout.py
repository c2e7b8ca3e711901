"""Autoregressive rollout of many characters at once (paper sections 3.1 and 4.4).

Each round makes one window of frames for every character: encode the condition once, start from
noise, denoise in a few steps, keep the last frames as the next history. All rounds run inside one
jitted scan.
"""

from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np

from f3amd_lib.data import features
from f3amd_lib.data.features import center_window, num_channels
from f3amd_lib.diffusion.samplers import SAMPLERS
from f3amd_lib.ground.arrays import finite_array
from f3amd_lib.ground.names import check_known, checked_seed
from f3amd_lib.motion.root_paths import RootPath
from f3amd_lib.networks.conditioning import Condition
from f3amd_lib.rollout.blending import blend_rollout
from f3amd_lib.rollout.generated import Rollout
from f3amd_lib.rollout.rounds import sample_round
from f3amd_lib.training.checkpoints import TrainedModel

MOST_STEPS = 1000
"""Most steps a round: as many levels as diffusion models are trained on; thousands would compile for minutes."""


def path_start(position):
    """Return where a path [..., F, 2] would have been one frame before its first, [..., 2]."""
    return 2.0 * position[..., 0, :] - position[..., 1, :]


def pose_speed(poses: np.ndarray) -> np.ndarray:
    """Return how fast starting poses [K, H, C] move over the ground, [K], metres a frame."""
    travelled = np.linalg.norm(poses[:, -1, [0, 2]] - poses[:, 0, [0, 2]], axis=-1)
    return travelled / max(1, poses.shape[1] - 1)


def starting_poses(trained: TrainedModel, style_index, start, yaw, speed, pick: Callable) -> np.ndarray:
    """Pick a stored starting pose for each character, and move it to where its path begins.

    Args:
      trained: the model; it has to have poses of all the styles.
      style_index: places in `trained.styles`, [B].
      start: x, z of the last frame, [B, 2], metres.
      yaw: facing there, [B], radians.
      speed: of the path, [B], metres a frame.
      pick: chooses among the poses about as fast as the paths: `pick(style, members, counts)` returns a number from 0
        for each of the characters `members` of a style, who have `counts` poses to choose from.

    Returns:
      World frames, [B, H, C], float64.
    """
    poses = np.empty((len(style_index), trained.config.num_history, num_channels(trained.skeleton)))
    for style in np.unique(style_index):
        members = np.flatnonzero(np.asarray(style_index) == style)
        choices = trained.start_poses[trained.styles[style]]
        gap = np.abs(pose_speed(choices) - speed[members, None])
        fitting = gap <= gap.min(axis=-1, keepdims=True) + 0.1 / 30.0
        number = pick(style, members, fitting.sum(axis=1))
        # The first place where more than `number` fitting poses have been passed.
        poses[members] = choices[np.argmax(fitting.cumsum(axis=1) > number[:, None], axis=1)]
    return center_window(features.turn_frames(poses, yaw), -start)


class MotionGenerator:
    """Style and path in, motion out.

    Args:
      trained: a trained model.
      num_steps: steps a round (the paper: 8, 4, 2 or 1); an evaluation each, but for "heun".
      spacing: where the steps lie, see the `grid` of the schedule that the model was trained with.
      sampler: a name of `samplers.SAMPLERS`; by default the one that belongs to the schedule (F3AMD
        DDIM, CAMDM ancestral DDPM).
    """

    def __init__(
        self, trained: TrainedModel, num_steps: int = 8, *, spacing: str = "endpoints", sampler: str | None = None
    ):
        self.trained = trained
        if num_steps > MOST_STEPS:
            raise ValueError(f"num_steps must be at most {MOST_STEPS}, got {num_steps}: more only take longer")
        self.num_steps = num_steps
        self.sampler = sampler or trained.diffusion.sampler
        check_known(self.sampler, SAMPLERS, "sampler")
        self.sigmas = trained.diffusion.grid(num_steps, spacing)
        # A walk that is told a low level from the first starts from noise alone all the same: of variance 1 in the
        # preserving state, and of 1 + sigma^2 in ours.
        self._start = float(np.hypot(1.0, self.sigmas[0])) if spacing == "leading" else None
        self._network = trained.network()
        self._run = jax.jit(self._rounds)
        self.sample = jax.jit(self.sample_window)  # compiled once for each number of rows

    def sample_window(self, key, condition: Condition, noise=None):
        """Sample one window, [B, T, C] in network units, for an already normalised condition.

        Args:
          key: of all random numbers; None if `noise` is given and the sampler draws none.
          condition: normalised.
          noise: standard normal numbers to start from, [B, T, C].
        """
        how = {"noise": noise, "start": self._start, "sampler": self.sampler}
        return sample_round(self._network, condition, self.sigmas, key, **how)

    def sample_window_each(self, keys, condition: Condition):
        """Sample one window for each character as if it were alone, [B, T, C]; keys [B]."""
        if self.sampler == "ddpm":
            alone = lambda key, given: self.sample_window(key, jax.tree.map(lambda leaf: leaf[None], given))[0]
            return jax.vmap(alone)(keys, condition)
        # Where only the start is drawn, all can walk together from noise of their own.
        shape = self.trained.config.state_shape(1)[1:]
        draw = lambda key: jax.random.normal(jax.random.split(key)[0], shape)
        return self.sample_window(None, condition, noise=jax.vmap(draw)(keys))

    def _rounds(self, history, positions, yaws, before, style, key):
        normaliser = self.trained.normaliser

        def one_round(history, inputs):
            target, yaw, target_before, number = inputs
            origin = history[:, -1, jnp.array([0, 2])]
            # Start where the character is and bend back to the line.
            position = features.bend_path(target - target_before[:, None, :], target_before - origin)
            path = normaliser.normalise_path(features.path_condition(position, yaw))
            condition = Condition(normaliser.normalise(center_window(history, origin)), path, style)
            if key.ndim:
                keys = jax.vmap(jax.random.fold_in, (0, None))(key, number)
                x0_hat = self.sample_window_each(keys, condition)
            else:
                x0_hat = self.sample_window(jax.random.fold_in(key, number), condition)
            future = features.orthonormalise(normaliser.denormalise(x0_hat))
            future = center_window(future, -origin)
            history = jnp.concatenate([history, future], axis=1)[:, -history.shape[1] :]
            return history, future

        numbers = jnp.arange(positions.shape[0])
        _, futures = jax.lax.scan(one_round, history, (positions, yaws, before, numbers))
        rounds, batch, frames, channels = futures.shape
        return jnp.moveaxis(futures, 0, 1).reshape(batch, rounds * frames, channels)

    def generate(self, position, yaw, style_index, history, key) -> np.ndarray:
        """Run all rounds on arrays; `rollout` and `serving.crowd` check and prepare them.

        Compiled once per number of characters and of rounds.

        Args:
          position: targets on the ground, [B, F, 2], metres, float64. The last round walks on as
            the last step went, and is cut to F frames.
          yaw: facing, [B, F], radians, float64.
          style_index: places in the one-hot vector, [B].
          history: world frames to start from, [B, H, C].
          key: JAX random key of the noise: one for the batch, or one a character, [B]. With the
            latter a character's noise does not depend on who else is there.

        Returns:
          World frames, [B, F, C], float32.
        """
        window, start, (batch, num_frames) = self.trained.config.window, path_start(position), yaw.shape
        rounds = -(-num_frames // window)
        ahead = np.arange(1, rounds * window - num_frames + 1)[None, :, None]
        pace = position[:, -1:] - position[:, -2:-1]
        position = np.concatenate([position, position[:, -1:] + ahead * pace], axis=1)
        yaw = np.concatenate([yaw, np.repeat(yaw[:, -1:], ahead.size, axis=1)], axis=1)
        shape = (batch, rounds, window)
        targets = np.moveaxis(position.reshape(*shape, 2), 1, 0)
        before = np.concatenate([start[None], targets[:-1, :, -1]])
        arrays = (history, targets, np.moveaxis(yaw.reshape(shape), 1, 0), before)
        style = jax.nn.one_hot(style_index, len(self.trained.styles))
        frames = self._run(*(jnp.asarray(array, jnp.float32) for array in arrays), style, key)
        return np.asarray(frames)[:, :num_frames]

    def rollout(
        self, paths: RootPath | Sequence[RootPath], styles: str | Sequence[str], *, seed: int = 0,
        history: np.ndarray | None = None, blend_frames: int = 0,
    ) -> Rollout:  # fmt: skip
        """Animate one or many characters along their paths.

        Args:
          paths: one path for all, or one each; frame k of a path is the target of generated frame
            k. The last round is cut to the path's length. All must have the same length.
          styles: one style name for all, or one each.
          seed: of the noise and of the choice among the starting poses.
          history: world frames to start from, [B, H, C]; by default a stored starting pose of the
            style, moved to the start of the path.
          blend_frames: blend so many frames after each window boundary (see `blending`); 0, as in
            all figures that do not say otherwise, leaves the frames as the network made them.

        Returns:
          The rollout, [B, frames of the path, C].

        Raises:
          ValueError: for an unknown style, unlike lengths or counts, a wrong history, or more
            blend_frames than a window has.
        """
        trained, config, seed = self.trained, self.trained.config, checked_seed(seed)
        paths = [paths] if isinstance(paths, RootPath) else list(paths)
        styles = [styles] if isinstance(styles, str) else list(styles)
        batch = max(1, len(paths), len(styles))
        if not {len(paths), len(styles)} <= {1, batch}:
            raise ValueError(f"got {len(paths)} paths and {len(styles)} styles; give one, or as many")
        paths, styles = (given * batch if len(given) == 1 else given for given in (paths, styles))
        lengths = sorted({len(path.yaw) for path in paths})
        if len(lengths) != 1 or lengths[0] < 2:
            raise ValueError(f"paths must have the same length, got {lengths} frames, and at least 2 frames")
        if any(abs(path.fps - 30.0) > 1e-3 for path in paths):
            raise ValueError("paths must be at 30 frames per second, as the models are")
        indices = np.array([trained.style_index(style) for style in styles])
        position, yaw = (np.stack([getattr(path, name) for path in paths]) for name in ("position", "yaw"))
        start = path_start(position)
        if history is None:
            speed = np.linalg.norm(position[:, 0] - start, axis=-1)
            if missing := [style for style in styles if style not in trained.start_poses]:
                raise ValueError(f"no starting pose is stored for style {missing[0]!r}: pass `history`")

            def in_turn(style, members, counts):  # those of one style take others, in an order of the seed's own
                orders = (np.random.default_rng([seed, style]).permutation(count) for count in counts)
                return np.array([order[k % len(order)] for k, order in enumerate(orders)])

            history = starting_poses(trained, indices, start, yaw[:, 0], speed, in_turn)
        shape = (batch, config.num_history, num_channels(trained.skeleton))
        history = finite_array("history", history, shape, np.float32)
        frames = self.generate(position, yaw, indices, history, jax.random.key(seed))
        rollout = Rollout(trained.skeleton, frames, history, tuple(paths), tuple(styles), config.window)
        return blend_rollout(rollout, blend_frames)
