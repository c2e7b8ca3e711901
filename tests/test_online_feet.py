"""Feet held frame by frame: slides are cured, clean walks and legs stay, nothing looks ahead, nothing pops."""

import dataclasses

import numpy as np
import pytest
from builders import SKELETON as SHORT_LEGS
from builders import refused

from f3amd_companion.serving import online_feet
from f3amd_companion.serving.foot_locking import FARTHEST, leg_chains
from f3amd_companion.serving.online_feet import lock_frame, lock_frames, lock_rollout_online, start_feet
from f3amd_lib.data.features import motion_from_frames, world_frames
from f3amd_lib.measures.walking import floor_penetration, slide_speed, toe_positions
from f3amd_lib.motion.skeleton import global_rotations
from f3amd_lib.motion.synthetic import SYNTHETIC_SKELETON, synthesize
from f3amd_lib.rollout.generated import Rollout

PAST = 10


def drifting(style: str, speed: float) -> np.ndarray:
    """World frames of a walker of 8 s whose feet slide sideways, metres a second."""
    motion = synthesize(style, 8)
    drift = np.arange(motion.num_frames)[:, None] * np.array([speed / motion.fps, 0.0, 0.0])
    return world_frames(motion.replace(root_position=motion.root_position + drift))


def held(frames, **options) -> np.ndarray:
    feet = start_feet(SYNTHETIC_SKELETON, frames[:PAST])
    return lock_frames(SYNTHETIC_SKELETON, feet, frames[PAST:], **options)[1]


def motion_of(frames):
    return motion_from_frames(SYNTHETIC_SKELETON, frames)


def slide(frames) -> float:
    return float(slide_speed(motion_of(frames).positions, SYNTHETIC_SKELETON))


def toe_kicks(frames) -> np.ndarray:
    """Largest acceleration of each toe, metres a frame squared."""
    toes = toe_positions(motion_of(frames).positions, SYNTHETIC_SKELETON)
    return np.linalg.norm(np.diff(toes, 2, axis=0), axis=-1).max(axis=0)


@pytest.fixture(scope="module", params=["Neutral", "Old"])
def walk(request):
    frames = drifting(request.param, 0.25)
    return frames[PAST:], held(frames)


def test_a_slide_is_cured(walk):
    raw, locked = walk
    assert slide(raw) > 18.0  # cm/s: the drift
    assert slide(locked) < 2.0


def test_a_clean_walk_hardly_changes():
    """A toe that lifts is let go a frame or two late, which who looks ahead would not do."""
    frames = drifting("Neutral", 0.0)
    apart = motion_of(held(frames)).positions - motion_of(frames[PAST:]).positions
    assert np.linalg.norm(apart, axis=-1).max() < 0.1
    assert np.linalg.norm(apart, axis=-1).mean() < 0.005


def test_without_locking_nothing_changes(walk):
    raw, _ = walk
    np.testing.assert_allclose(held(np.concatenate([raw[:PAST], raw]), locking=False), raw, atol=1e-6)


def test_nothing_pops(walk, monkeypatch):
    """A toe is torn a little harder than in the walk itself, and far less than where it goes over at once."""
    raw, locked = walk
    assert (toe_kicks(locked) < 3.0 * toe_kicks(raw)).all()
    monkeypatch.setattr(online_feet, "RUN_OUT", 1e3)
    monkeypatch.setattr(online_feet, "LET_GO", 1e3)
    at_once = held(np.concatenate([raw[:PAST], raw]))
    assert (toe_kicks(at_once) > 4.0 * toe_kicks(raw)).all()


def test_the_switch_goes_over_smoothly():
    frames = drifting("Neutral", 0.25)
    feet, first = lock_frames(SYNTHETIC_SKELETON, start_feet(SYNTHETIC_SKELETON, frames[:PAST]), frames[PAST:110])
    assert feet.carries.any()
    _, second = lock_frames(SYNTHETIC_SKELETON, feet, frames[110:], locking=False)
    both = np.concatenate([first, second])
    assert (toe_kicks(both[80:140]) < 3.0 * toe_kicks(frames[PAST:])).all()
    np.testing.assert_allclose(motion_of(second[60:]).positions, motion_of(frames[170:]).positions, atol=1e-3)


def test_no_frame_hears_of_a_later_one():
    frames = drifting("Neutral", 0.25)
    other = frames.copy()
    other[120:, :3] += 0.3
    np.testing.assert_array_equal(held(frames)[: 120 - PAST], held(other)[: 120 - PAST])
    assert np.abs(held(frames) - held(other))[120 - PAST :].max() > 0.1


def test_only_legs_turn_bones_and_root_stay_and_feet_keep_their_orientation(walk):
    raw, locked = walk
    legs = leg_chains(SYNTHETIC_SKELETON)[:, :3].ravel()
    others = [joint for joint in range(SYNTHETIC_SKELETON.num_joints) if joint not in legs]
    before, after = motion_of(raw), motion_of(locked)
    np.testing.assert_allclose(after.rotations[:, others], before.rotations[:, others], atol=1e-9)
    np.testing.assert_array_equal(locked[:, :3], raw[:, :3])
    turned = [global_rotations(SYNTHETIC_SKELETON, motion.rotations)[:, legs[2::3]] for motion in (before, after)]
    np.testing.assert_allclose(*turned, atol=1e-6)
    assert np.abs(after.rotations[:, legs] - before.rotations[:, legs]).max() > 0.05


def test_sunken_feet_come_up():
    frames = drifting("Neutral", 0.0)
    frames[PAST:, 1] -= 0.03
    feet = start_feet(SYNTHETIC_SKELETON, frames[:PAST])
    locked = lock_frames(SYNTHETIC_SKELETON, feet, frames[PAST:])[1]
    both = [motion_of(one).positions for one in (frames[PAST:], locked)]
    under = [floor_penetration(positions, SYNTHETIC_SKELETON, feet.floor) for positions in both]
    assert under[0] > 1.0 and under[1] < 0.1 * under[0]


def test_a_foot_lets_go_where_its_point_is_too_far():
    frames = drifting("Neutral", 2.5)  # nobody stands where the ground runs away
    locked = held(frames)
    toes = [toe_positions(motion_of(one).positions, SYNTHETIC_SKELETON) for one in (frames[PAST:], locked)]
    assert np.linalg.norm(toes[0] - toes[1], axis=-1).max() < FARTHEST + 0.2


def test_bad_input_is_refused():
    frames = drifting("Neutral", 0.0)
    refused("leg must be hip, knee, ankle, toe", start_feet, SHORT_LEGS, frames[:PAST])
    refused("history must be", start_feet, SYNTHETIC_SKELETON, frames[:PAST, :-1])
    frames[3, 0] = np.nan
    refused("not finite at frame 3", start_feet, SYNTHETIC_SKELETON, frames[:PAST])


def test_the_state_of_before_is_left_alone():
    frames = drifting("Neutral", 0.25)
    feet = start_feet(SYNTHETIC_SKELETON, frames[:PAST])
    copy = [np.copy(value) for value in feet]
    one = lock_frame(SYNTHETIC_SKELETON, feet, frames[PAST])[1]
    for value, before in zip(feet, copy, strict=True):
        np.testing.assert_array_equal(value, before)
    np.testing.assert_array_equal(lock_frame(SYNTHETIC_SKELETON, feet, frames[PAST])[1], one)


def test_a_rollout_is_settled_character_by_character_from_its_own_history():
    frames = np.stack([drifting(style, 0.25)[:60] for style in ("Neutral", "Old")])
    made = Rollout(SYNTHETIC_SKELETON, frames[:, PAST:], frames[:, :PAST], (None, None), ("Neutral", "Old"), 25)
    locked = lock_rollout_online(made)
    for one, wanted in zip(locked.frames, frames, strict=True):
        np.testing.assert_array_equal(one, held(wanted))
    assert locked.feet_locked and not np.array_equal(locked.frames, made.frames)
    swapped = dataclasses.replace(made, history=made.history[::-1])
    assert not np.array_equal(lock_rollout_online(swapped).frames, locked.frames)
    refused("locked already", lock_rollout_online, locked)
