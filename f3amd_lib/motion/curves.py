"""Curves and directions that paths, walker and foot locking share."""

import numpy as np
from scipy.ndimage import gaussian_filter1d, maximum_filter1d


def smoothstep(u) -> np.ndarray:
    """Rise from 0 to 1 over [0, 1] with level ends (3 u^2 - 2 u^3)."""
    u = np.clip(u, 0.0, 1.0)
    return u * u * (3.0 - 2.0 * u)


def unit(vectors) -> np.ndarray:
    """Return vectors [..., 3] at length 1; those of length 0 stay 0."""
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12)


def smooth_above(need: np.ndarray, fps: float) -> np.ndarray:
    """Return a smooth curve, [T], that is nowhere below a need, [T]: what a leg lacks, for one.

    A running maximum, then an average over the same span.
    """
    radius = max(2, round(0.13 * fps))
    need = maximum_filter1d(need, 2 * radius + 1, mode="nearest")
    return gaussian_filter1d(need, radius / 2.2, radius=radius, mode="nearest")
