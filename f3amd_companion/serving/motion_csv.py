"""Motion as a table that any program reads: a row for each frame and joint."""

from pathlib import Path

import numpy as np
import pandas as pd
from scipy.spatial.transform import Rotation

from f3amd_lib.ground.files import write_whole
from f3amd_lib.motion.skeleton import Motion


def write_motion_csv(path, motion: Motion, *, overwrite: bool = False) -> Path:
    """Write a motion as CSV.

    Columns: frame, seconds, joint, x, y, z (global position, metres), qw, qx, qy, qz (local rotation; the root's is
    global; empty where motion has positions alone).

    Args:
      path: where to; folders are made.
      motion: any.
      overwrite: replace what is there.

    Returns:
      The path.

    Raises:
      ValueError: for a file that is there.
    """
    frames, joints = motion.positions.shape[:2]
    number = np.repeat(np.arange(frames), joints)
    columns = {"frame": number, "seconds": number / motion.fps, "joint": np.tile(motion.skeleton.names, frames)}
    columns |= dict(zip("xyz", motion.positions.reshape(-1, 3).T, strict=True))
    turns = np.full((frames * joints, 4), np.nan)
    if motion.rotations is not None:
        turns = Rotation.from_matrix(motion.rotations.reshape(-1, 3, 3)).as_quat(scalar_first=True)
    columns |= {f"q{axis}": turns[:, k] for k, axis in enumerate("wxyz")}
    return write_whole(path, pd.DataFrame(columns).to_csv(index=False, float_format="%.6f"), overwrite=overwrite)
