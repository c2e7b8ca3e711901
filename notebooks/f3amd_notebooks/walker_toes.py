"""Toe heights of the procedural walker, and a Gaussian mixture through them: motion whose denoiser is known exactly."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from f3amd_lib.diffusion.oracles import GaussianMixture
from f3amd_lib.motion.synthetic import synthesize


@dataclass(frozen=True, eq=False)
class WalkerToes:
    """Heights of both toes, in centimetres, and as network units a mixture around some of the frames.

    Attributes:
      heights: left and right, [T, 2], centimetres above the lowest.
      middle, scale: of a height in network units, (height - middle) / scale.
      left: mixture of the left toe alone, D = 1.
      both: mixture of both toes, D = 2.
    """

    heights: np.ndarray
    middle: float
    scale: float
    left: GaussianMixture
    both: GaussianMixture

    def centimetres(self, x):
        """Return network units as heights, any shape."""
        return self.middle + self.scale * np.asarray(x)


def walker_toes(
    style: str = "Neutral", *, seconds: float = 30.0, num_modes: int = 48, width: float = 0.1
) -> WalkerToes:
    """Make the walker walk, and lay a narrow Gaussian around every so many of the toes' heights.

    Args:
      style: of the walker.
      seconds: of motion.
      num_modes: K, Gaussians in each mixture; on the left toe they stand at even quantiles, on both at even times.
      width: of each, in deviations of a toe's height.
    """
    walk = synthesize(style, seconds=seconds)
    heights = 100.0 * walk.positions[:, list(walk.skeleton.toes), 1]
    heights = heights - heights.min()
    middle, scale = float(heights.mean()), float(heights.std())
    units = (heights - middle) / scale
    places = np.quantile(units[:, 0], (np.arange(num_modes) + 0.5) / num_modes)
    frames = np.linspace(0, len(units) - 1, num_modes).round().astype(int)
    return WalkerToes(heights, middle, scale, GaussianMixture(places, width), GaussianMixture(units[frames], width))
