"""Foot locking: clean walks stay, artificial slides and sunken feet are cured, bones stay bones."""

import feet_oracle
import numpy as np
import pytest
from builders import SKELETON as SHORT_LEGS
from builders import refused, straight_motion, walk_with_contacts
from feet_oracle import lock_frames, start_feet

from f3amd_companion.serving import foot_locking
from f3amd_companion.serving.foot_locking import DEEPEST, FARTHEST, leg_chains, lock_feet, lock_rollout, plan_contacts
from f3amd_lib.data.features import motion_from_frames, world_frames
from f3amd_lib.measures.metrics import joint_acceleration
from f3amd_lib.measures.walking import floor_penetration, slide_speed, stepping_rate, toe_positions
from f3amd_lib.motion.root_paths import named_path
from f3amd_lib.motion.skeleton import Motion, Skeleton, global_rotations
from f3amd_lib.motion.synthetic import SYNTHETIC_SKELETON, synthesize
from f3amd_lib.rollout.rollout import Rollout

FLOOR = 0.012
"""Height of the walker's resting toes."""


@pytest.fixture(scope="module")
def walk() -> Motion:
    return synthesize("Neutral", 12)


@pytest.fixture(scope="module")
def locked_slide(walk):
    """A walk whose root drifts sideways by 20 cm/s, and the same with locked feet."""
    motion = sliding(walk, 0.2)
    return motion, lock_feet(motion)


def sliding(motion: Motion, speed: float) -> Motion:
    drift = np.arange(motion.num_frames)[:, None] * np.array([speed / motion.fps, 0.0, 0.0])
    return motion.replace(root_position=motion.root_position + drift)


def lifted(motion: Motion, height) -> Motion:
    height = np.broadcast_to(height, (motion.num_frames,))
    return motion.replace(root_position=motion.root_position + height[:, None] * np.array([0.0, 1.0, 0.0]))


def bone_lengths(motion: Motion) -> np.ndarray:
    parents = list(motion.skeleton.parents[1:])
    return np.linalg.norm(motion.positions[:, 1:] - motion.positions[:, parents], axis=-1)


def toe_steps(motion: Motion) -> np.ndarray:
    """How far each toe moves over the ground in a frame, [T - 1, 2], metres."""
    toes = toe_positions(motion.positions, motion.skeleton)
    return np.linalg.norm(np.diff(toes, axis=0)[..., [0, 2]], axis=-1)


@pytest.mark.parametrize("style", ["Neutral", "Crab", "Runner", "Tiptoe"])
def test_plan_finds_the_walkers_own_contacts(style):
    motion, true = walk_with_contacts(style, 12)
    plan = plan_contacts(motion.positions, motion.skeleton)
    assert (plan == true).mean() > 0.88 and not (true & ~plan).any()
    high = toe_positions(motion.positions, motion.skeleton)[..., 1] > 0.06
    assert high.any() and not plan[high].any()


def test_a_contact_no_two_frames_of_which_are_alike_is_none():
    """It stands 4 cm up and then moves along the floor at 2 m/s: each frame is too high or too fast for the rest."""
    path = np.concatenate([np.zeros(41), 4 / 30 + np.arange(39) * 2 / 30])
    height = np.repeat([0.043, 0.0], 40)
    positions = np.tile(SYNTHETIC_SKELETON.rest_positions, (80, 1, 1))
    positions[:, SYNTHETIC_SKELETON.toes] = np.stack([0 * path, height, path], axis=-1)[:, None]
    assert not plan_contacts(positions, SYNTHETIC_SKELETON).all(axis=-1).any()


def test_a_clean_walk_stays(walk):
    locked = lock_feet(walk)
    moved = np.linalg.norm(locked.positions - walk.positions, axis=-1)
    assert moved.mean() < 0.002 and moved.max() < 0.05
    before, after = joint_acceleration(walk.positions), joint_acceleration(locked.positions)
    assert after == pytest.approx(before, rel=0.02)
    assert stepping_rate(locked.positions, walk.skeleton) == stepping_rate(walk.positions, walk.skeleton)


def test_a_slide_is_cured(locked_slide):
    before, after = locked_slide
    skeleton = before.skeleton
    assert slide_speed(before.positions, skeleton) == pytest.approx(20.0, abs=1.0)
    assert slide_speed(after.positions, skeleton) < 0.1
    assert floor_penetration(after.positions, skeleton, FLOOR) < 0.05
    assert stepping_rate(after.positions, skeleton) == pytest.approx(stepping_rate(before.positions, skeleton), rel=0.1)
    old, new = joint_acceleration(before.positions), joint_acceleration(after.positions)
    assert new < 1.2 * old  # a foot that stands has to catch up


def test_a_locked_toe_stands_still(locked_slide):
    before, after = locked_slide
    plan = plan_contacts(before.positions, before.skeleton)
    both = plan[1:] & plan[:-1]
    assert toe_steps(before)[both].min() > 0.002
    assert toe_steps(after)[both].max() < 1e-3
    inner = both[2:-2] & both[:-4] & both[4:]  # toes may roll at the ends
    height = toe_positions(after.positions, after.skeleton)[3:-2, :, 1]
    np.testing.assert_allclose(height[inner], FLOOR, atol=1e-3)


def test_bones_keep_their_lengths_and_the_root_its_path(locked_slide):
    before, after = locked_slide
    np.testing.assert_allclose(bone_lengths(after), bone_lengths(before), atol=1e-9)
    lowered = before.root_position - after.root_position
    assert np.abs(lowered[:, [0, 2]]).max() == 0.0
    assert lowered[:, 1].min() >= 0.0 and lowered[:, 1].max() <= DEEPEST
    gram = after.rotations @ np.swapaxes(after.rotations, -1, -2)
    np.testing.assert_allclose(gram, np.broadcast_to(np.eye(3), gram.shape), atol=1e-9)


def assert_only_legs_turned(before: Motion, after: Motion, atol: float) -> None:
    """Nothing but legs, and feet keep their orientation."""
    legs = leg_chains(before.skeleton)[:, :3]
    others = np.setdiff1d(np.arange(before.skeleton.num_joints), legs)
    np.testing.assert_allclose(after.rotations[:, others], before.rotations[:, others], atol=1e-9)
    feet = [global_rotations(one.skeleton, one.rotations)[:, legs[:, 2]] for one in (before, after)]
    np.testing.assert_allclose(*feet, atol=atol)
    assert np.abs(after.rotations[:, legs] - before.rotations[:, legs]).max() > 0.05


def test_only_legs_turn_and_feet_keep_their_orientation(locked_slide):
    assert_only_legs_turned(*locked_slide, atol=1e-9)


def test_nothing_pops(locked_slide):
    before, after = locked_slide
    correction = after.positions - before.positions
    toes = list(before.skeleton.toes)
    velocity, bend = np.diff(correction, axis=0), np.diff(correction, n=2, axis=0)
    # 20 cm/s are 0.7 cm a frame while a foot stands; what was won is given back in the swing.
    assert np.linalg.norm(velocity[:, toes], axis=-1).max() < 0.03
    assert np.linalg.norm(velocity, axis=-1).max() < 0.05
    assert np.linalg.norm(bend[:, toes], axis=-1).max() < 0.016


def test_sunken_feet_come_up(walk):
    sunken = lifted(walk, -0.05)
    assert floor_penetration(sunken.positions, walk.skeleton, FLOOR) == pytest.approx(5.0, abs=0.01)
    locked = lock_feet(sunken, floor=FLOOR)
    assert floor_penetration(locked.positions, walk.skeleton, FLOOR) < 0.05
    assert slide_speed(locked.positions, walk.skeleton) < 0.1
    np.testing.assert_array_equal(locked.root_position, sunken.root_position)
    # Without a floor to go by, the feet themselves say where it is.
    assert np.abs(lock_feet(sunken).positions - sunken.positions).mean() < 0.002


@pytest.fixture
def no_contacts(monkeypatch):
    monkeypatch.setattr(foot_locking, "plan_contacts", lambda positions, *_: np.zeros((len(positions), 2), bool))


def test_a_swing_is_lifted_over_the_floor_without_any_contact(walk, no_contacts):
    dip = -0.04 * np.exp(-0.5 * ((np.arange(walk.num_frames) - 150) / 4.0) ** 2)
    locked = lock_feet(lifted(walk, dip), floor=FLOOR)
    assert floor_penetration(locked.positions, walk.skeleton, FLOOR) < 0.05
    correction = locked.positions - lifted(walk, dip).positions
    assert np.linalg.norm(np.diff(correction, n=2, axis=0), axis=-1).max() < 0.012
    far = np.abs(np.arange(walk.num_frames) - 150) > 90
    np.testing.assert_allclose(locked.positions[far], walk.positions[far], atol=1e-3)


def test_a_leg_that_cannot_reach_lets_go(walk, monkeypatch):
    assert 0.0 < DEEPEST < 0.1
    high, contacts = lifted(walk, 0.12), plan_contacts(walk.positions, walk.skeleton)
    with monkeypatch.context() as patch:
        patch.setattr(foot_locking, "plan_contacts", lambda *_: contacts)
        locked = lock_feet(high, floor=FLOOR)
    np.testing.assert_allclose(bone_lengths(locked), bone_lengths(high), atol=1e-9)
    assert (high.root_position - locked.root_position).max() <= DEEPEST
    height = toe_positions(locked.positions, walk.skeleton)[..., 1]
    assert np.median(height[contacts]) > 0.1
    # Just out of reach, the root gives way, and feet stand.
    locked = lock_feet(lifted(walk, 0.03), floor=FLOOR)
    lowered = lifted(walk, 0.03).root_position - locked.root_position
    assert 0.005 < lowered[:, 1].max() <= DEEPEST
    assert slide_speed(locked.positions, walk.skeleton) < 0.1


def test_a_long_slide_becomes_small_steps(walk):
    contacts = walk.contacts
    pose = int(np.flatnonzero(contacts.all(axis=1))[0])
    still = np.repeat(walk.rotations[pose : pose + 1], 150, axis=0)
    root = np.repeat(walk.root_position[pose : pose + 1], 150, axis=0)
    motion = sliding(walk.replace(root_position=root, rotations=still), 0.3)  # 1.5 m in all
    locked = lock_feet(motion, floor=FLOOR)
    stands = toe_steps(locked) < 1e-3
    assert stands.mean() > 0.6
    old, new = (toe_positions(one.positions, walk.skeleton) for one in (motion, locked))
    moved = np.linalg.norm((new - old)[..., [0, 2]], axis=-1)
    assert moved[1:][stands].max() <= FARTHEST + 1e-3
    assert (new[..., 1].max(axis=0) > FLOOR + 0.004).all()
    assert stepping_rate(locked.positions, walk.skeleton) == 0.0
    assert np.linalg.norm(np.diff(locked.positions, axis=0), axis=-1).max() < 0.12


def test_bad_input_is_refused(walk):
    positions = walk.positions.copy()
    positions[7, 3, 1] = np.nan
    refused("frame 7", plan_contacts, positions, walk.skeleton)
    refused(r"\[frame, 23, 3\]", plan_contacts, walk.positions[:, :-1], walk.skeleton)
    refused("hip, knee, ankle, toe", lock_feet, straight_motion(20))
    refused("left_toe", leg_chains, Skeleton(("Hips", "LeftHip", "RightHip"), (-1, 0, 0), np.ones((3, 3))))
    assert SHORT_LEGS.toes  # known, yet too near to the hips


def rollout_of(*motions: Motion, past: int = 30) -> Rollout:
    frames = np.stack([world_frames(motion) for motion in motions]).astype(np.float32)
    return Rollout(
        skeleton=SYNTHETIC_SKELETON,
        frames=frames[:, past:],
        history=frames[:, :past],
        paths=(named_path("straight", frames.shape[1] - past),) * len(motions),
        styles=("Neutral",) * len(motions),
        window=32,
    )


def test_all_characters_of_a_rollout_are_locked(walk):
    # The second one sinks by and by, after a history that stood on the floor.
    sinks = np.interp(np.arange(walk.num_frames), [40, 80], [0.0, -0.05])
    rollout = rollout_of(sliding(walk, 0.2), lifted(walk, sinks))
    locked = lock_rollout(rollout)
    assert locked.feet_locked and locked.frames.dtype == np.float32 and locked.frames.shape == rollout.frames.shape
    np.testing.assert_array_equal(locked.history, rollout.history)
    skeleton = rollout.skeleton
    assert slide_speed(rollout.motion(0).positions, skeleton) > 19.0
    assert slide_speed(locked.motion(0).positions, skeleton) < 0.5
    assert floor_penetration(rollout.motion(1).positions, skeleton, FLOOR) > 4.9
    for character in range(2):
        positions = locked.motion(character).positions
        assert floor_penetration(positions, skeleton, FLOOR) < 0.1
    # Told of a floor 5 cm lower, the second one stays as it was.
    told = lock_feet(rollout.motion(1, with_history=True), floor=FLOOR - 0.05)
    assert floor_penetration(told.positions, skeleton, FLOOR) > 4.9
    refused("already", lock_rollout, locked)


# --- frame by frame: nothing looks ahead --------------------------------------------------------

PAST = 10


def drifting(style: str, speed: float) -> np.ndarray:
    """World frames of a walker of 8 s whose feet slide sideways, metres a second."""
    return world_frames(sliding(synthesize(style, 8), speed))


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
def drifted(request):
    frames = drifting(request.param, 0.25)
    return frames[PAST:], held(frames)


def test_a_slide_is_cured_frame_by_frame(drifted):
    raw, locked = drifted
    assert slide(raw) > 18.0  # cm/s: the drift
    assert slide(locked) < 2.0


def test_a_clean_walk_hardly_changes():
    """A toe that lifts is let go a frame or two late, which who looks ahead would not do."""
    frames = drifting("Neutral", 0.0)
    apart = motion_of(held(frames)).positions - motion_of(frames[PAST:]).positions
    assert np.linalg.norm(apart, axis=-1).max() < 0.1
    assert np.linalg.norm(apart, axis=-1).mean() < 0.005


def test_nothing_pops_frame_by_frame(drifted, monkeypatch):
    """A toe is torn a little harder than in the walk itself, and far less than where it goes over at once."""
    raw, locked = drifted
    assert (toe_kicks(locked) < 3.0 * toe_kicks(raw)).all()
    monkeypatch.setattr(feet_oracle, "RUN_OUT", 1e3)
    monkeypatch.setattr(feet_oracle, "LET_GO", 1e3)
    at_once = held(np.concatenate([raw[:PAST], raw]))
    assert (toe_kicks(at_once) > 4.0 * toe_kicks(raw)).all()


def test_no_frame_hears_of_a_later_one():
    frames = drifting("Neutral", 0.25)
    other = frames.copy()
    other[120:, :3] += 0.3
    np.testing.assert_array_equal(held(frames)[: 120 - PAST], held(other)[: 120 - PAST])
    assert np.abs(held(frames) - held(other))[120 - PAST :].max() > 0.1


def test_lengths_are_metres_beside_a_leg(walk):
    leg = walk.positions[0, leg_chains(walk.skeleton)[0]]
    length = np.linalg.norm(np.diff(leg[:3], axis=0), axis=-1).sum()
    lengths = foot_locking.FARTHEST, foot_locking.DEEPEST, feet_oracle.SLACK, foot_locking._STEP_HEIGHT
    for metres, share in zip(lengths, (0.4, 0.08, 0.05, 0.05), strict=True):
        assert 0.1 * share < metres / length < share


def test_only_legs_turn_bones_and_root_stay_and_feet_keep_their_orientation(drifted):
    raw, locked = drifted
    np.testing.assert_array_equal(locked[:, :3], raw[:, :3])
    assert_only_legs_turned(motion_of(raw), motion_of(locked), atol=1e-6)
