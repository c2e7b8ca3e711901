"""Skeletons and motions: kinematics, facing, contacts, mirroring and resampling."""

import numpy as np
import pytest
from builders import refused

from f3amd_companion.serving.foot_locking import lock_feet
from f3amd_lib.data.features import world_frames
from f3amd_lib.motion import rotations, skeleton
from f3amd_lib.motion.bvh import format_bvh
from f3amd_lib.motion.skeleton import Motion, Skeleton
from f3amd_lib.motion.synthetic import SYNTHETIC_SKELETON, synthesize

# Offsets in cm of the Bandai rig without joint_Root: bones along +X on the left, along -X on the
# right; the tiny numbers are the rig's own.
_BANDAI = [
    ("Hips", -1, (0, 0, 0)), ("Spine", 0, (15.7357, 0, 0)), ("Chest", 1, (8.98455, -0.406207, 0)),
    ("Neck", 2, (16.3773, 0, 0)), ("Head", 3, (6.45672, 0, 0)), ("Shoulder_L", 2, (12.9942, -0.242716, 4.98039)),
    ("UpperArm_L", 5, (5.34809, 0, 0)), ("LowerArm_L", 6, (24.3286, 0, 0)), ("Hand_L", 7, (22.2916, 0, 0)),
    ("Shoulder_R", 2, (12.9945, -0.242716, -4.98039)), ("UpperArm_R", 9, (-5.34813, 0, 0)),
    ("LowerArm_R", 10, (-24.3289, 0.000322, 0)), ("Hand_R", 11, (-22.2915, -0.000108, 0)),
    ("UpperLeg_L", 0, (-2.19248, -6.46944, 0)), ("LowerLeg_L", 13, (39.0811, 0, 0)),
    ("Foot_L", 14, (40.9854, 0, 0)), ("Toes_L", 15, (11.7543, 0, 0)), ("UpperLeg_R", 0, (-2.19251, 6.46944, 0)),
    ("LowerLeg_R", 17, (-39.0811, -0.002282, -0.040193)), ("Foot_R", 18, (-40.9854, 0, 0)),
    ("Toes_R", 19, (-11.7543, 0, 0)),
]  # fmt: skip
_NAMES, _PARENTS, _OFFSETS = zip(*_BANDAI, strict=True)
BANDAI = Skeleton(_NAMES, _PARENTS, np.array(_OFFSETS) / 100.0)


def random_motion(rig: Skeleton, frames: int = 12, seed: int = 0, fps: float = 30.0) -> Motion:
    """Rotations with no pattern: every joint is tested away from its rest pose."""
    rng = np.random.default_rng(seed)
    turned = rotations.matrix_from_rotation_6d(rng.standard_normal((frames, rig.num_joints, 6)))
    return Motion(rig, rng.standard_normal((frames, 3)), turned, fps=fps, name="random")


def legs(**changes) -> Skeleton:
    """The smallest skeleton that has hips and toes."""
    values = {
        "names": ("Hips", "LeftHip", "LeftToe", "RightHip", "RightToe"),
        "parents": (-1, 0, 1, 0, 3),
        "offsets": np.array([[0, 0, 0], [0.1, 0, 0], [0, -0.9, 0.1], [-0.1, 0, 0], [0, -0.9, 0.1]], dtype=float),
    }
    return Skeleton(**(values | changes))


def standing(rig: Skeleton, root: np.ndarray, fps: float = 30.0) -> Motion:
    """No rotation at all, on a given root path."""
    eye = np.broadcast_to(np.eye(3), (len(root), rig.num_joints, 3, 3))
    return Motion(rig, root, eye, fps=fps, name="standing")


# ------------------------------------------------------------------------------- kinematics


def joint_by_joint(motion: Motion):
    """Forward kinematics as a textbook would write it."""
    rig = motion.skeleton
    positions = np.zeros((motion.num_frames, rig.num_joints, 3))
    turned = np.zeros((motion.num_frames, rig.num_joints, 3, 3))
    for frame in range(motion.num_frames):
        for joint, parent in enumerate(rig.parents):
            local = motion.rotations[frame, joint]
            if parent < 0:
                positions[frame, joint] = motion.root_position[frame]
                turned[frame, joint] = local
            else:
                above = turned[frame, parent]
                positions[frame, joint] = positions[frame, parent] + above @ rig.offsets[joint]
                turned[frame, joint] = above @ local
    return positions, turned


@pytest.mark.parametrize("rig", [SYNTHETIC_SKELETON, BANDAI], ids=["100style-like", "bandai"])
def test_kinematics_by_level_equal_those_by_joint(rig):
    motion = random_motion(rig)
    positions, turned = joint_by_joint(motion)
    np.testing.assert_allclose(motion.positions, positions, atol=1e-12)
    np.testing.assert_allclose(skeleton.global_rotations(rig, motion.rotations), turned, atol=1e-12)


def test_turn_swings_the_whole_motion_about_the_vertical():
    motion = random_motion(SYNTHETIC_SKELETON)
    turned = skeleton.turn(motion, np.pi / 2)
    x, y, z = np.moveaxis(motion.positions, -1, 0)
    np.testing.assert_allclose(turned.positions, np.stack([z, y, -x], axis=-1), atol=1e-12)


# --------------------------------------------------------------------- facing and contacts


@pytest.mark.parametrize("yaw", [0.0, 0.4, -2.0, 3.0])
def test_facing_is_that_of_the_hips(yaw):
    motion = skeleton.turn(standing(legs(), np.zeros((2, 3))), yaw)
    np.testing.assert_allclose(motion.yaw, yaw, atol=1e-12)


def test_contacts_by_hand():
    # The whole body moves by these steps in metres; 1 cm a frame is no contact any more.
    steps = np.array([0.0, 0.0099, 0.0101, 0.05, 0.0])
    root = np.zeros((6, 3))
    root[1:, 2] = np.cumsum(steps)
    motion = standing(legs(), root)
    expected = np.array([True, True, False, False, True, True])
    np.testing.assert_array_equal(motion.contacts, np.stack([expected, expected], axis=-1))


def test_contacts_do_not_depend_on_the_frame_rate():
    # 0.24 m/s is 8 mm a frame at 30 fps; 0.36 m/s is 12 mm. At 60 fps both steps are halved.
    for fps in (30.0, 60.0):
        for speed, touching in ((0.24, True), (0.36, False)):
            root = np.zeros((4, 3))
            root[:, 0] = np.arange(4) * speed / fps
            assert np.all(standing(legs(), root, fps).contacts == touching)


# -------------------------------------------------------------------------------- mirroring


@pytest.mark.parametrize(
    ("rig", "tolerance"), [(SYNTHETIC_SKELETON, 1e-12), (BANDAI, 6e-4)], ids=["100style-like", "bandai"]
)
def test_mirror_shows_the_mirrored_positions(rig, tolerance):
    motion = random_motion(rig)
    twin = [rig.index(_twin(name)) for name in rig.names]
    expected = motion.positions[:, twin] * [-1.0, 1.0, 1.0]
    np.testing.assert_allclose(skeleton.mirror(motion).positions, expected, atol=tolerance)


def _twin(name: str) -> str:
    swap = {"Left": "Right", "Right": "Left", "_L": "_R", "_R": "_L"}
    for side, other in swap.items():
        if name.startswith(side) or name.endswith(side):
            return name.replace(side, other)
    return name


def test_mirror_refuses_a_joint_without_a_twin():
    rig = Skeleton(("Hips", "LeftHip"), (-1, 0), [[0, 0, 0], [0.1, 0, 0]])
    refused("'LeftHip' has no twin 'RightHip'", skeleton.mirror, standing(rig, np.zeros((1, 3))))


def test_mirror_refuses_an_uneven_skeleton():
    offsets = legs().offsets.copy()
    offsets[4, 1] = -0.8
    with pytest.raises(ValueError, match=r"bones below 'LeftHip'.*off by 100\.0 mm"):
        skeleton.mirror(standing(legs(offsets=offsets), np.zeros((1, 3))))


# ------------------------------------------------------------------------------- resampling


def test_a_rounded_frame_time_of_60_fps_still_halves():
    motion = random_motion(SYNTHETIC_SKELETON, frames=7, fps=1.0 / 0.016667)
    half = skeleton.resample(motion)
    assert (half.num_frames, half.fps) == (4, 30.0)
    np.testing.assert_array_equal(half.rotations, motion.rotations[::2])


@pytest.mark.parametrize("smooth", [False, True])
@pytest.mark.parametrize("fps", [50.0, 24.0])
def test_other_ratios_interpolate(fps, smooth):
    # A steady walk with a steady turn: the answer is known at every time.
    frames = int(2 * fps) + 1
    time = np.arange(frames) / fps
    root = np.stack([1.5 * time, np.ones(frames), -0.5 * time], axis=-1)
    local = np.broadcast_to(np.eye(3), (frames, 5, 3, 3)).copy()
    local[:, 0] = rotations.matrix_from_yaw(2.0 * time)
    out = skeleton.resample(Motion(legs(), root, local, fps=fps), 30.0, smooth=smooth)
    assert (out.num_frames, out.fps) == (61, 30.0)
    time = np.arange(61) / 30.0
    np.testing.assert_allclose(out.root_position[:, 0], 1.5 * time, atol=1e-9)
    np.testing.assert_allclose(out.root_position[:, 2], -0.5 * time, atol=1e-9)
    np.testing.assert_allclose(out.rotations[:, 0], rotations.matrix_from_yaw(2.0 * time), atol=1e-9)


def test_splines_bend_with_the_motion_where_lines_cut_its_corners():
    time = np.arange(25) / 24.0
    swing = lambda time: np.stack([np.zeros_like(time), np.sin(6 * time), time], axis=-1)
    turned = rotations.matrix_from_yaw(np.sin(6 * time))[:, None] * np.ones((1, 5, 1, 1))
    motion, asked = Motion(legs(), swing(time), turned, fps=24.0), np.arange(31) / 30.0
    off = {}
    for smooth in (False, True):
        out = skeleton.resample(motion, 30.0, smooth=smooth)
        off[smooth] = [
            np.abs(out.root_position - swing(asked)).max(),
            np.abs(out.rotations[:, 0] - rotations.matrix_from_yaw(np.sin(6 * asked))).max(),
        ]
    assert min(off[False]) > 3e-3 and max(off[True]) < 1e-3
    still = motion.slice(0, 1)
    np.testing.assert_allclose(skeleton.resample(still, 30.0, smooth=True).positions, still.positions, atol=1e-12)


# ------------------------------------------------------------------- what cannot be, is said


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"names": ("Hips", "LeftHip")}, r"offsets must be \[2, 3\]"),
        ({"names": ("Hips", "A", "A", "B", "C")}, "names must be unique"),
        ({"parents": (-1, 2, 0, 0, 3)}, "every parent before its children"),
        ({"parents": (0, 0, 1, 0, 3)}, "the root first"),
        ({"offsets": np.full((5, 3), np.nan)}, r"offsets is not finite at \[0, 0\]"),
    ],
)
def test_broken_skeletons_are_refused(changes, message):
    refused(message, legs, **changes)


def test_unknown_joints_and_roles_list_what_there_is():
    refused("no joint 'Tail'; it has Hips, LeftHip", legs().index, "Tail")
    rig = Skeleton(("Base",), (-1,), np.zeros((1, 3)))
    with pytest.raises(ValueError, match=r"no joint has the role left_toe; .*: Base"):
        _ = rig.toes


def test_broken_motions_are_refused_by_name_and_frame():
    root = np.zeros((4, 3))
    eye = np.broadcast_to(np.eye(3), (4, 5, 3, 3)).copy()
    refused(r"motion 'clip': rotations must be \[3, 5, 3, 3\]", Motion, legs(), root[:3], eye, name="clip")
    refused("no length 0", Motion, legs(), root[:0], eye[:0])
    refused("fps must be above 0, got 0", Motion, legs(), root, eye, fps=0)
    root[2, 1] = np.nan
    refused("motion 'clip': root_position is not finite at frame 2", Motion, legs(), root, eye, name="clip")
    eye[3, 1, 0, 0] = np.inf
    refused("rotations is not finite at .3, 1, 0, 0", Motion, legs(), np.zeros((4, 3)), eye)


@pytest.mark.parametrize(
    "change",
    [
        lambda motion: motion,
        lambda motion: motion.slice(2, 7),
        skeleton.mirror,
        lambda motion: skeleton.turn(motion, 0.7),
        lambda motion: skeleton.resample(motion, 15.0),
        lambda motion: skeleton.resample(motion.slice(0, 2), 60.0),
    ],
)
def test_motion_of_positions_alone_is_where_the_same_motion_with_rotations_is(change):
    # Two frames with one pose: in between, bones keep their lengths either way.
    whole = random_motion(SYNTHETIC_SKELETON, frames=9)
    rotations = whole.rotations.copy()
    rotations[1] = rotations[0]
    whole = whole.replace(rotations=rotations)
    alone = Motion.from_positions(whole.skeleton, whole.positions, whole.fps, whole.name)
    there, expected = change(alone), change(whole)
    assert there.rotations is None and (there.name, there.fps) == (expected.name, expected.fps)
    np.testing.assert_allclose(there.positions, expected.positions, atol=1e-12)
    np.testing.assert_allclose(there.root_position, expected.root_position, atol=1e-12)
    np.testing.assert_allclose(there.yaw, expected.yaw, atol=1e-12)
    np.testing.assert_array_equal(there.contacts, expected.contacts)


@pytest.mark.parametrize("act", [format_bvh, world_frames, lock_feet])
def test_what_needs_rotations_refuses_positions_alone_and_says_so(act):
    whole = synthesize("Neutral", 0.5)
    act(whole)
    with pytest.raises(ValueError, match="'bare' has only positions: .* needs rotations"):
        act(Motion.from_positions(whole.skeleton, whole.positions, name="bare"))


def test_motion_is_made_of_rotations_or_positions_not_of_both_or_neither():
    motion = standing(legs(), np.zeros((4, 3)))
    for turned, positions in ((motion.rotations, motion.positions), (None, None)):
        with pytest.raises(ValueError, match="either rotations or joint_positions"):
            Motion(motion.skeleton, motion.root_position, turned, joint_positions=positions)
    refused(r"joint_positions must be \[4, 5, 3\]", Motion.from_positions, motion.skeleton, motion.positions[:, 1:])
    broken = motion.positions.copy()
    broken[1, 4, 2] = np.nan
    refused(r"joint_positions is not finite at \[1, 4, 2\]", Motion.from_positions, motion.skeleton, broken)
