"""What a rollout made: a value that blending, foot locking, measures and pictures take."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from f3amd_lib.data.features import motion_from_frames
from f3amd_lib.motion.root_paths import RootPath
from f3amd_lib.motion.skeleton import Motion, Skeleton


@dataclass(frozen=True)
class Rollout:
    """What a rollout made.

    Attributes:
      skeleton: of the characters.
      frames: world frames, [B, F, C], F frames as in the path; metres and 6D, orthonormal.
      history: the frames before the first window, [B, H, C].
      paths: what each character was asked to follow.
      styles: what each character was asked to look like.
      window: T; window k starts at frame k * T.
      blend_frames: frames after each window boundary that were blended; 0 is as it was made.
      feet_locked: whether feet were held where they stand (`foot_locking`).
    """

    skeleton: Skeleton
    frames: np.ndarray
    history: np.ndarray
    paths: tuple[RootPath, ...]
    styles: tuple[str, ...]
    window: int
    blend_frames: int = 0
    feet_locked: bool = False

    @property
    def changes(self) -> str:
        """What was done to the motion after the network made it, as a phrase; "" for nothing."""
        done = [f"blended over {self.blend_frames} frames"] if self.blend_frames else []
        return ", ".join(done + ["feet locked"] * self.feet_locked)

    def motion(self, character: int = 0, *, with_history: bool = False) -> Motion:
        """Return one character's motion, from the first generated frame or from its history on."""
        frames = self.frames[character]
        if with_history:
            frames = np.concatenate([self.history[character], frames])
        return motion_from_frames(self.skeleton, frames, name=self.styles[character])
