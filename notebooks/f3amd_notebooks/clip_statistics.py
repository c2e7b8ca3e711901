"""Plain numbers that describe a clip, as the Bandai manifest has them."""

import numpy as np
from f3amd_lib.data.features import lowest_toe_height
from f3amd_lib.motion.skeleton import CONTACT_SPEED, Motion


def clip_statistics(motion: Motion) -> dict[str, float]:
    """Describe a clip by the numbers of the Bandai manifest.

    Args:
      motion: a clip of T frames.

    Returns:
      A dict of
        path_length_m: length of the hips' way on the ground plane, metres;
        net_distance_m: straight distance from its first to its last point, metres;
        mean_speed_m_s: path length over its duration, (T - 1) / fps; 0 for a single frame;
        start_yaw_deg: facing in the first frame, degrees in [-180, 180), positive to the left;
        net_yaw_change_deg: sum of the turns from frame to frame, each in [-180, 180), degrees;
        lowest_joint_y_cm, lowest_toe_y_cm: lowest height of any joint, of either toe, centimetres;
        toe_contact_fraction: share of the 2 (T - 1) steps of the toes that are shorter than
          `CONTACT_SPEED` metres in space; 1 for a single frame.
    """
    positions = motion.positions
    ground = np.asarray(motion.root_position, np.float64)[:, [0, 2]]
    path_length = float(np.linalg.norm(np.diff(ground, axis=0), axis=1).sum())
    duration = (motion.num_frames - 1) / motion.fps
    yaw = np.unwrap(motion.yaw)
    toes = positions[:, list(motion.skeleton.toes)]
    steps = np.linalg.norm(np.diff(toes, axis=0), axis=-1)
    return {
        "path_length_m": path_length,
        "net_distance_m": float(np.linalg.norm(ground[-1] - ground[0])),
        "mean_speed_m_s": path_length / duration if duration else 0.0,
        "start_yaw_deg": float(np.degrees(yaw[0])),
        "net_yaw_change_deg": float(np.degrees(yaw[-1] - yaw[0])),
        "lowest_joint_y_cm": 100.0 * float(positions[..., 1].min()),
        "lowest_toe_y_cm": 100.0 * lowest_toe_height(motion),
        "toe_contact_fraction": float(np.mean(steps < CONTACT_SPEED)) if len(steps) else 1.0,
    }
