"""Steering: characters that are told where to go while they walk, many at once.

The paper rolls out a path that is known: window after window of T = 32 frames, each from the last H = 10 frames of the
one before (sections 3.1 and 4.4). Who steers changes their mind on the way, and so we ask for a new window every `hop`
frames, 8 unless told, and drop the rest of the old one. Its history is the last H frames that were shown; with a hop
below H they come from two windows, so they hold a seam, which the paper's history never does. The seam is inertialised
(`blending`) over the next `blend_frames`, and what was blended is what the network gets as history: a character goes on
from where everybody saw it.

A player's wish is a speed and a direction. What the network is asked to follow is a line on the ground that such wishes
bend: a target turns towards the direction like a damped spring, and takes up the speed within a fraction of a second.
The part of that line which lies ahead is the path condition. It starts where the character is, and is bent back to the
line over the window, as in every rollout. A page does the same in JavaScript (`serving/web/motion.js`), and a test
holds both together.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from f3amd_companion.serving.steer import usual_walk
from f3amd_lib.data.features import bend_path, center_window, orthonormalise, path_condition, turn_frames
from f3amd_lib.motion.rotations import wrap_angle
from f3amd_lib.networks.conditioning import Condition
from f3amd_lib.rollout.blending import blend_seams
from f3amd_lib.rollout.rollout import MotionGenerator, pose_speed
from f3amd_lib.training.checkpoints import TrainedModel

FPS = 30.0
HOP = 8
"""Frames after which a new window is made."""

BLEND_FRAMES = 4
STIFFNESS = 24.0
"""Of the spring that turns a target, 1/s^2; critically damped."""

MAX_TURN = 2.4
"""Radians a second."""

SPEED_SECONDS = 0.35
"""Time constant in which a target takes up a speed."""


class Target(NamedTuple):
    """What characters are to follow: a point that moves over the ground.

    Attributes:
      position: x, z, [B, 2], metres.
      heading: where it goes and faces, [B], radians.
      turning: its rate, [B], radians a second.
      speed: [B], metres a second.
    """

    position: np.ndarray
    heading: np.ndarray
    turning: np.ndarray
    speed: np.ndarray


def move_target(target: Target, speed, direction, num_frames: int) -> tuple[Target, np.ndarray, np.ndarray]:
    """Let targets go on for some frames under a wish that stays.

    Args:
      target: of B characters.
      speed: wished, [B], metres a second; 0 stops.
      direction: wished, [B], radians; that of a target which shall stop counts for nothing.
      num_frames: F.

    Returns:
      (target after F frames, its positions [B, F, 2], its headings [B, F]).
    """
    position, heading, turning, pace = (np.array(value, np.float64) for value in target)
    speed, direction, step = np.asarray(speed, np.float64), np.asarray(direction, np.float64), 1.0 / FPS
    share = 1.0 - np.exp(-step / SPEED_SECONDS)
    positions, headings = [], []
    for _ in range(num_frames):
        away = np.where(speed > 0, wrap_angle(direction - heading), 0.0)
        turning = turning + step * (STIFFNESS * away - 2.0 * np.sqrt(STIFFNESS) * turning)
        turning = np.clip(turning, -MAX_TURN, MAX_TURN)
        heading = heading + step * turning
        # Who has to turn round slows down for it.
        pace = pace + share * (speed * np.maximum(0.3, np.cos(away)) - pace)
        position = position + step * pace[:, None] * np.stack([np.sin(heading), np.cos(heading)], axis=-1)
        positions.append(position)
        headings.append(heading)
    return Target(position, heading, turning, pace), np.stack(positions, 1), np.stack(headings, 1)


class Steering:
    """Characters under way.

    Args:
      generator: of the model, with its number of steps.
      history: world frames that they start from, [B, H, C].
      heading: where they face, [B], radians.
      hop: frames of each window that are shown.
      blend_frames: frames after a seam that are inertialised, at most the window; 0 leaves the seam.

    Attributes:
      history: the last H frames that were shown, [B, H, C], float64.
      target: what they follow.
    """

    def __init__(
        self, generator: MotionGenerator, history, heading, *, hop: int = HOP, blend_frames: int = BLEND_FRAMES
    ):
        self.generator, self.hop, self.blend_frames = generator, hop, blend_frames
        self.history = np.asarray(history, np.float64)
        heading = np.asarray(heading, np.float64)
        pace = np.array([pose_speed(pose[None])[0] for pose in self.history]) * FPS
        self.target = Target(self.history[:, -1, [0, 2]], heading, np.zeros_like(heading), pace)
        self._sample = jax.jit(lambda condition, noise: generator.sample_window(None, condition, noise=noise))

    def advance(self, speed, direction, style, noise) -> np.ndarray:
        """Make the next frames.

        Args:
          speed, direction: wished, [B] (see `move_target`).
          style: weights of the styles, [B, S].
          noise: standard normal numbers of this window, [B, T, C].

        Returns:
          World frames [B, hop, C], float64.
        """
        window, normaliser = self.generator.trained.config.window, self.generator.trained.normaliser
        positions, headings = move_target(self.target, speed, direction, window)[1:]
        origin = self.history[:, -1, [0, 2]]
        line = bend_path(positions - self.target.position[:, None], self.target.position - origin)
        given = (center_window(self.history, origin), path_condition(line, headings), style)
        history, path, style = (jnp.asarray(array, jnp.float32) for array in given)
        condition = Condition(normaliser.normalise(history), normaliser.normalise_path(path), style)
        x0_hat = normaliser.denormalise(self._sample(condition, jnp.asarray(noise, jnp.float32)))
        future = center_window(orthonormalise(np.asarray(x0_hat, np.float64)), -origin)
        future = blend_seams(future, window, self.blend_frames, history=self.history)[:, : self.hop]
        kept = self.history.shape[1]
        self.history = np.concatenate([self.history, future], axis=1)[:, -kept:]
        self.target = move_target(self.target, speed, direction, self.hop)[0]
        return future


def first_pose(trained: TrainedModel, style: str, position, heading: float) -> np.ndarray:
    """Return the page's starting pose of a style, [H, C], at a place (x, z) and a heading."""
    pose = usual_walk(trained, style)[1]
    return center_window(turn_frames(pose, heading), -np.asarray(position, np.float64))
