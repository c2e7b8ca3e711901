"""Rollouts beside real clips: measures with known answers, and the tables made of them."""

import numpy as np
import pandas as pd
import pytest
from builders import SKELETON, packed_from, straight_motion, wandering_motion

from f3amd_lib.data.features import world_frames
from f3amd_lib.experiments import quality
from f3amd_lib.generation.rollout import Rollout
from f3amd_lib.measures import metrics
from f3amd_lib.motion.root_paths import RootPath, named_path, path_from_motion

TRAIN, VALIDATION, TEST = 0, 1, 2
WINDOW = 8


def walk(step, num_frames=60):
    """A stiff figure at `step` metres a frame along +Z."""
    return straight_motion(num_frames, (0.0, 0.0, step))


def rollout_of(motions, paths=None, window=WINDOW):
    """A rollout that made these motions."""
    frames = np.stack([world_frames(motion) for motion in motions])
    paths = paths or [path_from_motion(motion) for motion in motions]
    styles = tuple(f"style {k}" for k in range(len(motions)))
    return Rollout(SKELETON, frames, frames[:, :4], tuple(paths), styles, window)


def feet(sides, rest_on=1.0, stride=0.03):
    """Positions in which toes rest where `sides` says: -1 right, 1 left, 0 neither, 2 both."""
    sides = np.asarray(sides)
    positions = np.zeros((len(sides), SKELETON.num_joints, 3))
    for toe, own in zip(SKELETON.toes, (1, -1), strict=True):
        moving = ~np.isin(sides, (own, 2))
        positions[:, toe, 2] = np.concatenate([[0.0], np.cumsum(stride * moving)[:-1]])
    return positions


# ------------------------------------------------------------------------------ walking measures


def test_steps_are_counted_per_second():
    # Six phases of ten frames: weight passes five times in two seconds.
    assert quality.foot_alternation(feet(np.repeat([1, -1] * 3, 10)), SKELETON) == 2.5
    # At 60 fps the toes move half as far in a frame, and the same walk is twice as fast.
    fast = quality.foot_alternation(feet(np.repeat([1, -1] * 3, 10)), SKELETON, fps=60.0)
    assert fast == 5.0


@pytest.mark.parametrize(
    "sides",
    [np.full(60, 2), np.zeros(60), np.repeat([1, 0] * 3, 10), np.repeat([1, 2] * 3, 10)],
    ids=["stands", "slides", "hops on one leg", "taps with one foot"],
)
def test_what_is_no_walk_does_not_alternate(sides):
    assert quality.foot_alternation(feet(sides), SKELETON) == 0.0


def test_a_flicker_of_contact_is_no_step():
    sides = np.full(60, 1)
    sides[[10, 11, 30]] = -1
    assert quality.foot_alternation(feet(sides), SKELETON) == 0.0
    sides[[12]] = -1  # three frames in a row: there and back again
    assert quality.foot_alternation(feet(sides), SKELETON) == 2 * 30 / 60


def test_alternation_of_a_batch():
    both = np.stack([feet(np.repeat([1, -1] * 3, 10)), feet(np.full(60, 2))])
    np.testing.assert_array_equal(quality.foot_alternation(both, SKELETON), [2.5, 0.0])


def test_a_stiff_figure_swings_nothing_however_it_turns():
    motion = wandering_motion(40, 0)
    frozen = np.repeat(motion.positions[:1], 40, axis=0)
    assert quality.bone_swing(frozen, SKELETON) == pytest.approx(0.0, abs=1e-4)
    angle = np.linspace(0.0, 4.0, 40)
    turn = np.stack([[[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]] for a in angle])
    turning = np.einsum("tab,tjb->tja", turn, frozen)
    assert quality.bone_swing(turning, SKELETON) == pytest.approx(0.0, abs=1e-4)
    assert quality.bone_swing(motion.positions, SKELETON) > 5.0


def test_swing_of_one_bone_by_hand():
    positions = np.array(walk(0.04, 40).positions)
    hips, spine = positions[:, 0], SKELETON.names.index("Spine")
    angle = np.deg2rad(30.0) * np.where(np.arange(40) % 2, 1.0, -1.0)
    lean = np.stack([0 * angle, np.cos(angle), np.sin(angle)], axis=-1)
    positions[:, spine] = hips + 0.5 * lean
    # 30 degrees to each side: the mean vector has length cos 30, one bone of five moves.
    expected = np.rad2deg(np.sqrt(2.0 * (1.0 - np.cos(np.deg2rad(30.0))))) / 5.0
    assert quality.bone_swing(positions, SKELETON) == pytest.approx(expected, rel=1e-6)


def test_checks_pass_within_the_factor_and_not_beyond():
    real = {key: np.array([1.0, 3.0]) for key in quality.WALKING}
    near = {key: np.array([2.0]) * 0.99 * f for key, (_, _, f) in quality.WALKING.items()}
    far = {key: np.array([2.0]) * 1.01 * f for key, (_, _, f) in quality.WALKING.items()}
    low = {key: np.array([2.0]) / 1.01 / f for key, (_, _, f) in quality.WALKING.items()}
    table = quality.walking_checks(real, {("near", 8): near, ("far", 8): far, ("low", 1): low})
    passed = table.groupby("label")["within"].agg(["all", "any"])
    assert passed.loc["near, 8 steps"].tolist() == [True, True]
    assert passed.loc["far, 8 steps"].tolist() == [False, False]
    assert passed.loc["low, 1 step"].tolist() == [False, False]
    assert set(table["real"]) == {2.0}


# -------------------------------------------------------------------------------- styles and clips


@pytest.fixture
def packed():
    """Calm walks 1.2 m/s and has a run in the test split; of proud only fast test clips exist."""
    made = packed_from(
        [
            (walk(0.04), 0, TRAIN),
            (walk(0.04), 0, TRAIN),
            (walk(0.12), 0, TRAIN),
            (walk(0.03), 1, TRAIN),
            (walk(0.042), 0, TEST),
            (walk(0.12), 0, TEST),
            (walk(0.09), 1, TEST),
            (walk(0.15), 1, TEST),
            (walk(0.04, 9), 0, TEST),
            (walk(0.045), 0, VALIDATION),
        ]
    )
    made.floor_shift[:] = np.linspace(0.01, 0.10, 10)
    return made


def test_pace_and_floor_come_from_training_clips(packed):
    assert quality.style_pace(packed, "calm") == pytest.approx(1.2, rel=1e-3)
    assert quality.style_pace(packed, "proud") == pytest.approx(0.9, rel=1e-3)
    assert quality.style_floor(packed, "calm") == pytest.approx(0.02)
    with pytest.raises(ValueError, match="unknown style 'clam'"):
        quality.style_pace(packed, "clam")


def test_standing_frames_do_not_slow_the_pace():
    clips = [(walk(0.04), 0, TRAIN), (walk(0.0, 200), 0, TRAIN), (walk(0.0), 1, TRAIN)]
    packed = packed_from(clips)
    assert quality.style_pace(packed, "calm") == pytest.approx(1.2, rel=1e-3)
    assert quality.style_pace(packed, "proud") == 0.1


def test_sideways_and_backward_steps_are_counted():
    yaw = np.repeat([0.0, 0.5 * np.pi, np.pi, 0.25], 25)
    path = RootPath(np.arange(101)[:, None] * [0.0, 0.04], np.append(yaw, 0.25))
    assert quality.sideways_share(path) == 0.5
    assert quality.sideways_share(RootPath(np.zeros((9, 2)), np.zeros(9))) == 0.0


def test_a_path_can_be_walked_facing_ahead():
    path = named_path("complex", 900, seed=0)
    ahead = quality.facing_ahead(path)
    np.testing.assert_array_equal(ahead.position, path.position)
    assert quality.sideways_share(path) > 0.1
    assert quality.sideways_share(ahead) == 0.0
    assert np.abs(np.diff(ahead.yaw)).max() < np.deg2rad(10)  # nobody spins


def test_reference_clips_are_held_out_and_walk_at_the_pace(packed):
    # Clip 5 runs, clip 8 is too short; of style 1 both are too fast, the nearer one stands in.
    assert quality.reference_clips(packed, ["calm"], window=WINDOW) == [4]
    assert quality.reference_clips(packed, ["proud", "calm"], window=WINDOW) == [6, 4]
    assert quality.reference_clips(packed, ["calm"], window=WINDOW, fastest=4.0) == [4, 5]
    assert quality.reference_clips(packed, ["calm"], window=4) == [4, 8]
    assert quality.reference_clips(packed, ["calm"], window=WINDOW, split="validation") == [9]


def test_reference_clips_say_what_is_missing(packed):
    with pytest.raises(ValueError, match="no validation clip of proud"):
        quality.reference_clips(packed, ["proud"], window=WINDOW, split="validation")
    with pytest.raises(ValueError, match="unknown split 'tset'"):
        quality.reference_clips(packed, ["calm"], window=WINDOW, split="tset")


def test_own_path_keeps_a_line_and_loses_the_sway():
    motion = walk(0.04, 90)
    line = path_from_motion(motion).position
    np.testing.assert_allclose(quality.own_path(motion).position, line, atol=1e-9)
    swayed = motion.root_position.copy()
    swayed[:, 0] += 0.02 * np.sin(2 * np.pi * np.arange(90) / 20.5)
    smooth = quality.own_path(motion.replace(root_position=swayed)).position
    assert np.abs(smooth - line)[20:-20].max() < 0.004
    tiny = motion.slice(0, 3)
    np.testing.assert_array_equal(quality.own_path(tiny).position, line[:3])


def test_a_clip_is_followed_from_its_own_first_frames(packed):
    whole = packed.motion(4)
    history, path, real = quality.follow_clip(packed, 4, num_history=5, num_frames=20)
    np.testing.assert_allclose(history[0], world_frames(whole)[:5], atol=1e-6)
    assert path.num_frames == real.num_frames == 20
    np.testing.assert_array_equal(real.root_position, whole.root_position[5:25])
    np.testing.assert_array_equal(path.position, quality.own_path(whole).position[5:25])
    with pytest.raises(ValueError, match=f"{whole.num_frames} frames, 1005 are needed"):
        quality.follow_clip(packed, 4, num_history=5, num_frames=1000)


# --------------------------------------------------------------------------------- whole rollouts


def test_real_clips_and_rollouts_are_measured_alike(packed):
    clips = [4, 9]
    real = quality.measure_clips(packed, clips, window=WINDOW)
    motions = [packed.motion(clip) for clip in clips]
    paths = [quality.own_path(motion) for motion in motions]
    again = quality.measure_rollout(rollout_of(motions, paths), packed.floor_shift[clips])
    assert set(real) == set(metrics.METRICS) | set(quality.WALKING)
    for key, values in real.items():
        np.testing.assert_allclose(again[key], values, atol=1e-6, err_msg=key)
    np.testing.assert_allclose(real["ird_cm"], [4.2, 4.5], rtol=1e-3)


def test_place_zero_is_the_seam():
    motion = wandering_motion(40, 3)
    positions = np.array(motion.positions)
    positions[16:] += np.array([0.03, 0.0, 0.0])  # a jump of 3 cm into window 2
    both = np.stack([positions, np.array(motion.positions)])
    table = quality.by_place_in_window(both, WINDOW)
    assert table["place"].tolist() == list(range(WINDOW))
    assert table["step_cm"][0] == pytest.approx(metrics.ird(both, WINDOW).mean())
    excess = metrics.ird_excess(both, WINDOW).mean()
    assert table["acceleration_cm"][0] == pytest.approx(excess)
    level = quality.by_place_in_window(walk(0.04).positions, WINDOW)
    np.testing.assert_allclose(level["step_cm"], 4.0)
    np.testing.assert_allclose(level["acceleration_cm"], 0.0, atol=1e-9)


def test_places_need_enough_frames():
    positions = np.array(walk(0.04, WINDOW + 2).positions)
    assert np.isfinite(quality.by_place_in_window(positions, WINDOW)).all(axis=None)
    with pytest.raises(ValueError, match="at least 10"):
        quality.by_place_in_window(positions[:-1], WINDOW)


def test_rounds_show_where_the_path_is_lost():
    motion = walk(0.04, 30)
    path = path_from_motion(motion)
    ramp = np.where(np.arange(30) < 16, 0.0, 0.5)[:, None] * np.array([1.0, 0.0])
    off = RootPath(path.position + ramp, path.yaw)
    table = quality.by_round(rollout_of([motion, motion], [path, off]))
    assert table["round"].tolist() == [1, 2, 3]  # the fourth is not finished
    np.testing.assert_allclose(table["gap_m"], [0.0, 0.0, 0.25], atol=1e-6)
    np.testing.assert_allclose(table["worst_gap_m"], [0.0, 0.0, 0.5], atol=1e-6)
    np.testing.assert_allclose(table["acceleration_cm"], 0.0, atol=1e-4)


# ------------------------------------------------------------------------------------------ tables


def test_quality_table_starts_with_the_real_row(packed):
    real = quality.measure_clips(packed, [4, 9], window=WINDOW)
    table = quality.quality_table(real, {("F3AMD-FNO-96", 8): real, ("F3AMD-FNO-96", 1): real})
    assert list(dict.fromkeys(table["label"])) == ["real", "F3AMD-FNO-96, 8 steps", "F3AMD-FNO-96, 1 step"]
    assert list(dict.fromkeys(table["steps"])) == [0, 8, 1]
    rows = table[table["label"] == "real"].set_index("metric")
    assert rows.loc["IRD", "value"] == pytest.approx(real["ird_cm"].mean())
    assert len(rows) == len(metrics.METRICS)


def test_the_papers_numbers_stand_in_columns_of_their_own():
    ours = pd.DataFrame(
        [
            {"label": "real", "metric": "IRD", "unit": "cm", "better": "near real", "value": 4.1},
            {"label": "mine", "metric": "IRD", "unit": "cm", "better": "near real", "value": 4.0},
            {"label": "mine", "metric": "drift", "unit": "", "better": "down", "value": 0.1},
        ]
    )
    table = quality.side_by_side(ours, quality.paper_rows())
    paper = ["paper, F3AMD-FNO-96, 8 steps", "paper, CAMDM, 8 steps"]
    assert table.columns.tolist() == ["metric", "real", "mine", *paper]
    assert table["metric"].tolist() == ["IRD (cm)", "drift ↓"]
    assert table.loc[0, paper].tolist() == [1.795, 3.834]
    assert table.loc[1, ["real", *paper]].isna().all()


def test_paper_rows_that_are_not_there():
    with pytest.raises(ValueError, match="Table 3 has no row 'F3AMD-FNO-97'"):
        quality.paper_rows(["F3AMD-FNO-97", "CAMDM"])
