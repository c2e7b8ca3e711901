"""The synthetic walker: its skeleton, its styles, and whether a person could move like that."""

import numpy as np
import pytest
from builders import walk_with_contacts

from f3amd_lib.motion import synthetic
from f3amd_lib.motion.rotations import matrix_from_yaw
from f3amd_lib.motion.synthetic import STYLES, SYNTHETIC_SKELETON, synthesize

SAMPLE = "Neutral Shuffling Runner HighKnees TwoFootJump Crab LimpLeft Drunk Tightrope DeepKnees".split()


@pytest.fixture(scope="module")
def all_styles():
    """Twenty seconds of every style: {name: (motion, contacts)}."""
    return {style: walk_with_contacts(style, 20.0, seed=1) for style in STYLES}


def toe_steps(motion) -> np.ndarray:
    """How far each toe moves from a frame to the next, [T - 1, 2], metres."""
    toes = motion.positions[:, list(motion.skeleton.toes)]
    return np.linalg.norm(np.diff(toes, axis=0), axis=-1)


# ----------------------------------------------------------------------------------- styles


def features(motion, window: int = 150) -> np.ndarray:
    """Mean and spread of the pose in windows of five seconds, [K, F]."""
    steady = matrix_from_yaw(-motion.yaw)
    relative = motion.positions - motion.positions[:, :1] * [1.0, 0.0, 1.0]
    relative = np.einsum("tab,tjb->tja", steady, relative).reshape(motion.num_frames, -1)
    local = 0.4 * motion.rotations[:, 1:, :, :2].reshape(motion.num_frames, -1)
    poses = np.concatenate([relative, local], axis=-1)
    poses = poses[: len(poses) // window * window].reshape(-1, window, poses.shape[-1])
    return np.concatenate([poses.mean(1), poses.std(1)], axis=-1)


@pytest.mark.slow
def test_styles_can_be_told_apart(all_styles):
    # The nearest of a hundred class means, from clips of another seed; chance is 1 %.
    known = np.stack([features(motion) for motion, _ in all_styles.values()])
    scale = known.reshape(-1, known.shape[-1]).std(0) + 1e-3
    centres = known.mean(1) / scale
    right = []
    for index, style in enumerate(STYLES):
        for vector in features(synthesize(style, 10.0, seed=2)) / scale:
            right.append(np.linalg.norm(centres - vector, axis=-1).argmin() == index)
    assert np.mean(right) > 0.8


# -------------------------------------------------------------------------------- promises


def test_random_numbers_are_pinned_for_all_machines():
    draws = synthetic._generator("Neutral", 0).integers(0, 1000, 6)
    assert draws.tolist() == [549, 15, 65, 709, 262, 609]


# ------------------------------------------------------------------------------------- feet


@pytest.mark.parametrize("style", SAMPLE)
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_planted_toes_do_not_slide(style, seed):
    motion, contacts = walk_with_contacts(style, 30.0, seed=seed)
    steps = toe_steps(motion)
    planned = contacts[:-1]
    assert 0.15 < planned.mean() < 0.9
    # By plan a planted toe does not move at all: what is left is rounding.
    assert steps[planned].max() < 1e-6
    # By speed (under 1 cm a frame) the first and last moments of a swing count as contact too.
    assert steps[motion.contacts[:-1]].mean() < 1e-3
    # The plan misses no contact, and speed finds few that are not planned.
    assert np.all(motion.contacts[:-1][planned])
    assert np.mean(motion.contacts[:-1] & ~planned) < 0.22


def test_planted_toes_touch_the_floor_and_nothing_is_below_it(all_styles):
    for style, (motion, contacts) in all_styles.items():
        toes = motion.positions[:, list(motion.skeleton.toes), 1]
        assert 0.0 <= toes[contacts].min() and toes[contacts].max() < 0.02, style
        assert motion.positions[..., 1].min() > 0.0, style


def test_walks_always_have_a_foot_on_the_ground_and_runs_do_not(all_styles):
    in_the_air = {style: np.mean(~c.any(axis=1)) for style, (_, c) in all_styles.items()}
    assert in_the_air["Neutral"] < 0.03
    assert in_the_air["Runner"] > 0.15


# ------------------------------------------------------------------------------------- body


def test_knees_bend_forwards_only(all_styles):
    for style, (motion, _) in all_styles.items():
        for side in ("Left", "Right"):
            knee = motion.rotations[:, SYNTHETIC_SKELETON.index(f"{side}Knee")]
            # A hinge about the thigh's own X axis.
            np.testing.assert_allclose(knee[:, 0, 0], 1.0, atol=1e-9)
            bend = np.degrees(np.arctan2(knee[:, 2, 1], knee[:, 1, 1]))
            assert bend.min() > 5.0, style
            assert bend.max() < 150.0, style


def test_accelerations_are_human(all_styles):
    medians = []
    for style, (motion, _) in all_styles.items():
        change = 100.0 * np.linalg.norm(np.diff(motion.positions, 2, axis=0), axis=-1)
        medians.append(np.median(change))
        assert 0.03 < medians[-1] < 1.5, style
        # Real runs peak at about 12 cm per frame squared, at the knees and feet; ours hurry up to 1.6 times their pace.
        assert change.max() < 18.0, style
        head = change[:, SYNTHETIC_SKELETON.index("Head")]
        assert head.max() < 4.0, style
    # Of real clips elderly walks have 0.2, ordinary ones 0.4, runs 1.8.
    assert 0.15 < np.median(medians) < 0.6
