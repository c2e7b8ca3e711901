"""Metrics of text to motion: between embeddings of a judge, on joints that were to be controlled, and on meshes.

Embeddings are [N, D], texts and motions of one judge. What a figure means depends on that judge, so
that figures of different ones are never compared; orderings are. FID is `distributions.frechet_distance`.

Source: Guo et al. 2022 (HumanML3D) and its released code; ACMDM, section 4.1 and its released code.
"""

import numpy as np
from scipy.sparse import coo_array

from f3amd_lib.ground.arrays import finite_array
from f3amd_lib.motion.skeleton import Skeleton

GROUP = 32
"""Texts that are ranked together: 1 right motion and 31 others."""


def groups_of_unlike_pairs(pairs, generator: np.random.Generator, size: int = GROUP) -> np.ndarray:
    """Draw groups of clips in which no two show the same, as many as there are without using a clip twice.

    Args:
      pairs: what each clip shows, [N].
      generator: what draws.
      size: of a group.

    Returns:
      Clip numbers, [G, size].

    Raises:
      ValueError: if fewer pairs than `size` are there.
    """
    order = generator.permutation(len(pairs))
    left = {pair: [] for pair in np.unique(pairs)}
    for clip in order:
        left[pairs[clip]].append(clip)
    if len(left) < size:
        raise ValueError(f"groups of {size} need as many pairs of content and style, got {len(left)}")
    groups = []
    while len(left) >= size:
        # The fullest first, so that as many groups as possible are made.
        fullest = sorted(left, key=lambda pair: (-len(left[pair]), generator.random()))[:size]
        groups.append([left[pair].pop() for pair in fullest])
        left = {pair: clips for pair, clips in left.items() if clips}
    return np.array(groups)


def r_precision(text, motion) -> np.ndarray:
    """Share of texts whose own motion is among the k nearest of its group, for k = 1, 2 and 3.

    Args:
      text, motion: embeddings in groups, [G, size, D]; row i of a group belongs to row i.

    Returns:
      [3]; guessing gives k / size. A motion as near as the right one counts as nearer, so that
      a judge that sees nothing scores 0.
    """
    text = finite_array("text", text, ("group", "text", "feature"))
    motion = finite_array("motion", motion, text.shape)
    distance = np.linalg.norm(text[:, :, None] - motion[:, None], axis=-1)
    own = np.diagonal(distance, axis1=1, axis2=2)
    rank = np.sum(distance <= own[..., None], axis=-1) - 1
    return np.array([np.mean(rank < k) for k in (1, 2, 3)])


def matching_distance(text, motion) -> float:
    """Mean distance of a text to its own motion; embeddings as in `r_precision`, in groups or not."""
    return float(np.linalg.norm(np.asarray(text, np.float64) - motion, axis=-1).mean())


def clip_score(text, motion) -> float:
    """Mean cosine of a text and its own motion, [..., D] each."""
    text, motion = np.asarray(text, np.float64), np.asarray(motion, np.float64)
    lengths = np.linalg.norm(text, axis=-1) * np.linalg.norm(motion, axis=-1)
    return float(np.mean(np.sum(text * motion, axis=-1) / lengths))


def embedding_diversity(motion, generator: np.random.Generator) -> float:
    """Mean distance between two draws of motions [N, D] without replacement; near that of real motion is good.

    Of 300 pairs, or of half of N where that is less.
    """
    motion = np.asarray(motion, np.float64)
    count = min(300, len(motion) // 2)
    order = generator.permutation(len(motion))
    return float(np.linalg.norm(motion[order[:count]] - motion[order[count : 2 * count]], axis=-1).mean())


def multimodality(motion, generator: np.random.Generator) -> float:
    """Mean distance between motions of one caption, [captions, samples, D], in 10 pairs, or all samples where fewer.

    Pairs are two draws without replacement, the same for all captions; one in `samples` is a motion beside itself.

    Source: the released code of HumanML3D and ACMDM.
    """
    motion = np.asarray(motion, np.float64)
    first, second = (motion[:, generator.permutation(motion.shape[1])[:10]] for _ in range(2))
    return float(np.linalg.norm(first - second, axis=-1).mean())


# ------------------------------------------------------------------------------------------ joints

RAISED = -0.27
"""Height of a wrist over the head joint, metres, from which a hand is up: the middle of the gap in Bandai's training
clips, where hands that are raised or waved come above -0.18 and the other hand stays below -0.37."""


def raised_hands(skeleton: Skeleton, positions) -> np.ndarray:
    """Say which hands go up: [..., 2] of bool, left and right.

    Args:
      skeleton: whose head and wrists are known.
      positions: [..., L, J, 3], metres.

    Source: ours.
    """
    height = finite_array("positions", positions, (*np.shape(positions)[:-1], 3))[..., 1]
    wrists = height[..., [skeleton.role("left_wrist"), skeleton.role("right_wrist")]]
    return np.max(wrists - height[..., [skeleton.role("head")]], axis=-2) > RAISED


def foot_skating_ratio(skeleton: Skeleton, positions, fps: float = 20.0) -> float:
    """Share of steps from frame to frame in which a toe glides on the floor.

    A toe glides where it is under 5 cm in both frames, moves over the ground at more than 0.5 m/s, and
    so does its mean over 5 steps. Either toe counts.

    Args:
      skeleton: whose toes are known.
      positions: [L, J, 3], L >= 2, metres, the floor at 0.
      fps: frames per second.

    Source: ACMDM's released evaluation, on the clip's true length.
    """
    toes = finite_array("positions", positions, ("frame", "joint", 3))[:, list(skeleton.toes)]
    low = toes[..., 1] < 0.05
    speed = np.linalg.norm(np.diff(toes[..., ::2], axis=0), axis=-1) * fps
    window = min(5, len(speed))
    mean = np.stack([np.convolve(foot, np.ones(window) / window, mode="same") for foot in speed.T], axis=-1)
    glides = low[1:] & low[:-1] & (speed > 0.5) & (mean > 0.5)
    return float(glides.any(axis=-1).mean())


def control_errors(positions, wanted, given) -> dict[str, float]:
    """Compare joints with their targets: of each clip, then the mean over clips (OmniControl's code).

    Args:
      positions, wanted: [clips, L, J, 3], metres.
      given: true where a joint of a frame was told, [clips, L, J]; in every clip somewhere.

    Returns:
      control_trajectory_error: share of clips with any point missed by more than half a metre;
      control_location_error: share of points missed;
      control_average_error: mean distance at the points, metres.
    """
    given = np.asarray(given, bool)
    distance = finite_array("distance", np.linalg.norm(np.subtract(positions, wanted), axis=-1), given.shape)
    over_clips = lambda at_points: float(np.mean(at_points, axis=(1, 2), where=given).mean())
    return {
        "control_trajectory_error": float(((distance > 0.5) & given).any(axis=(1, 2)).mean()),
        "control_location_error": over_clips(distance > 0.5),
        "control_average_error": over_clips(distance),
    }


def laplacian_surface_distance(vertices, rest, faces) -> np.ndarray:
    """Return how far a mesh's surface is from that of its rest pose, metres: LSD.

    The Laplacian vector of a vertex leads to it from the mean of those that it shares an edge with. What is compared is
    its length, which no turn changes: a limb may go anywhere as long as it is not dented, swollen or crumpled.

    Args:
      vertices: [..., V, 3], metres.
      rest: the same mesh at rest, [V, 3].
      faces: triangles, [F, 3]; every vertex is in one.

    Returns:
      Mean over vertices, [...].

    Source: named in ACMDM section 4.1, Appendix B and Table 4, without a formula; this one is ours.
    """
    pairs = np.asarray(faces)[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    edges = coo_array((np.ones(2 * len(pairs)), np.concatenate([pairs, pairs[:, ::-1]]).T), [len(rest)] * 2).tocsr()
    edges.data[:] = 1.0
    mean = edges / edges.sum(axis=1)[:, None]

    def bumps(mesh):
        rows = np.moveaxis(np.asarray(mesh, np.float64), -2, 0)
        around = (mean @ rows.reshape(len(rows), -1)).reshape(rows.shape)
        return np.linalg.norm(rows - around, axis=-1)

    far = bumps(vertices) - bumps(rest).reshape(-1, *[1] * (np.ndim(vertices) - 2))
    return np.mean(np.abs(far), axis=0)
