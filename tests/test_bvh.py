"""The BVH reader and writer: hand-made files with known positions, broken files, round trips."""

import warnings

import numpy as np
import pytest
from builders import refused

from f3amd_lib.motion.bvh import format_bvh, parse_bvh, read_bvh, write_bvh
from f3amd_lib.motion.rotations import matrix_from_euler
from f3amd_lib.motion.skeleton import Motion, Skeleton

# A two-bone arm. Line numbers matter: MOTION is line 22, the two frames are lines 25 and 26.
ARM = """HIERARCHY
ROOT Base
{
  OFFSET 0 0 0
  CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation
  JOINT Elbow
  {
    OFFSET 0 10 0
    CHANNELS 3 Zrotation Xrotation Yrotation
    JOINT Wrist
    {
      OFFSET 0 20 0
      CHANNELS 3 Zrotation Xrotation Yrotation
      End Site
      {
        OFFSET 0 5 0
      }
    }
  }
}

MOTION
Frames: 2
Frame Time: 0.05
100 50 0 0 0 0 0 0 0 0 0 0
100 50 0 90 0 0 -90 0 0 0 0 0
"""

ARM_POSITIONS = np.array(
    [
        [[1.0, 0.5, 0.0], [1.0, 0.6, 0.0], [1.0, 0.8, 0.0]],
        # The base turns +Y to -X; the elbow turns it back.
        [[1.0, 0.5, 0.0], [0.9, 0.5, 0.0], [0.9, 0.7, 0.0]],
    ]
)


def body(*joints: str, rows: list[str]) -> str:
    """Return a BVH text: joint blocks inside one ROOT, then rows."""
    return "\n".join(["HIERARCHY", *joints, "MOTION", f"Frames: {len(rows)}", "Frame Time: 0.05", *rows, ""])


def test_two_bone_arm_by_hand():
    motion = parse_bvh(ARM, "arm.bvh")
    assert motion.skeleton.names == ("Base", "Elbow", "Wrist")
    assert motion.skeleton.parents == (-1, 0, 1)
    assert motion.skeleton.end_sites == ((2, (0.0, 0.05, 0.0)),)
    assert motion.fps == pytest.approx(20.0)
    assert motion.name == "arm.bvh"
    np.testing.assert_allclose(motion.positions, ARM_POSITIONS, atol=1e-12)


def test_each_joint_has_its_own_order_and_channels_may_be_mixed():
    text = body(
        "ROOT A { OFFSET 1 2 3 CHANNELS 4 Yrotation Zposition Xrotation Xposition",
        "JOINT B { OFFSET 0 100 0 CHANNELS 2 Xrotation Zrotation",
        "JOINT C { OFFSET 0 0 100 CHANNELS 1 Yrotation } }",
        "JOINT D { OFFSET 7 0 0 CHANNELS 0 } }",
        rows=["30 50 40 60 50 60 70"],
    )
    motion = parse_bvh(text, "mixed")
    # An axis without a position channel keeps the OFFSET.
    np.testing.assert_allclose(motion.root_position, [[0.6, 0.02, 0.5]], atol=1e-12)
    turns = [matrix_from_euler(axes, angles) for axes, angles in (("YX", [30, 40]), ("XZ", [50, 60]), ("Y", [70]))]
    np.testing.assert_allclose(motion.rotations[0], [*turns, np.eye(3)], atol=1e-12)


@pytest.mark.parametrize(
    "change",
    [
        pytest.param(lambda text: text.replace(" ", "\t"), id="tabs"),
        pytest.param(lambda text: text.replace("Frames: ", "Frames:\t"), id="tab after Frames:"),
        pytest.param(lambda text: text.replace("\n100", "\n\n 100").rstrip() + " \n\n", id="blanks"),
        pytest.param(lambda text: text.lower().replace("base", "Base"), id="lower case"),
        pytest.param(lambda text: text.upper(), id="upper case"),
        pytest.param(lambda text: text.replace("\n{", " {").replace("\n  {", "{"), id="braces"),
        pytest.param(lambda text: "\ufeff" + text, id="byte order mark"),
        pytest.param(lambda text: text.encode("ascii"), id="bytes"),
        pytest.param(lambda text: text.replace("End Site", "End Site wrist_tip"), id="named tip"),
    ],
)
def test_same_motion_however_it_is_typed(change):
    motion = parse_bvh(change(ARM), "arm")
    np.testing.assert_allclose(motion.positions, ARM_POSITIONS, atol=1e-12)
    assert motion.fps == pytest.approx(20.0)
    assert motion.skeleton.end_sites == ((2, (0.0, 0.05, 0.0)),)


SIX = "CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation"


def test_position_channels_replace_the_offset():
    text = body(
        f"ROOT Hips {{ OFFSET 900 900 900 {SIX}",
        f"JOINT Left {{ OFFSET 0 777 0 {SIX} }}",
        f"JOINT Right {{ OFFSET -10 0 0 {SIX} }} }}",
        rows=["1 90 2 0 0 0  10 0 0 0 0 0  -10 0 0 0 0 0", "3 91 4 0 0 90  10 0 0 5 6 7  -10 0 0 0 0 0"],
    )
    motion = parse_bvh(text, "six")
    assert motion.skeleton.names == ("Hips", "Left", "Right")
    np.testing.assert_allclose(motion.skeleton.offsets, [[0, 0, 0], [0.1, 0, 0], [-0.1, 0, 0]])
    expected = [
        [[0.01, 0.90, 0.02], [0.11, 0.90, 0.02], [-0.09, 0.90, 0.02]],
        [[0.03, 0.91, 0.04], [0.03, 0.91, -0.06], [0.03, 0.91, 0.14]],  # yaw 90: +X -> -Z
    ]
    np.testing.assert_allclose(motion.positions, expected, atol=1e-12)


def folded_text(root_row_0: str, root_row_1: str) -> str:
    return body(
        f"ROOT joint_Root {{ OFFSET 0 0 0 {SIX}",
        f"JOINT Hips {{ OFFSET 0 450 0 {SIX}",
        f"JOINT Left {{ OFFSET 10 0 0 {SIX} }}",
        f"JOINT Right {{ OFFSET -10 0 0 {SIX} }} }} }}",
        rows=[
            f"{root_row_0}  1 90 2 0 0 0  10 0 0 0 0 0  -10 0 0 0 0 0",
            f"{root_row_1}  3 91 4 0 0 90  10 0 0 0 0 0  -10 0 0 0 0 0",
        ],
    )


def test_a_root_that_only_carries_the_hips_is_folded():
    motion = parse_bvh(folded_text("0 0 0 0 0 0", "0 0 -50 0 0 0"), "bandai-like")
    assert motion.skeleton.names == ("Hips", "Left", "Right")
    assert motion.skeleton.parents == (-1, 0, 0)
    np.testing.assert_allclose(motion.root_position, [[0.01, 0.90, 0.02], [0.03, 0.91, -0.46]])
    np.testing.assert_allclose(motion.positions[1, 1], [0.03, 0.91, -0.56], atol=1e-12)


def stretching_bone(second: str) -> str:
    return body(
        f"ROOT Hips {{ OFFSET 0 0 0 {SIX}",
        "JOINT Left { OFFSET 10 0 0 CHANNELS 3 Xposition Yposition Zposition }",
        "JOINT Right { OFFSET -10 0 0 CHANNELS 0 } }",
        rows=["0 90 0 0 0 0 10 0 0", f"0 90 0 0 0 0 {second} 0 0"],
    )


def test_bones_must_be_rigid():
    assert parse_bvh(stretching_bone("10.1"), "jitter").skeleton.offsets[1, 0] == pytest.approx(0.1005)
    refused(r"rubber\.bvh, line 3: .*'Left' move.* 6\.0 mm .*rigid", parse_bvh, stretching_bone("11.2"), "rubber.bvh")


def swap(old: str, new: str, count: int = 1):
    def change(text: str) -> str:
        assert old in text
        return text.replace(old, new, count)

    return change


BROKEN = {
    "empty file": (lambda text: "", 1, "without a MOTION line"),
    "truncated last frame": (lambda text: text[:-9], 26, "frame 1 has 8 numbers .* 12 .* cut off"),
    "NaN": (swap("-90", "nan"), 26, "'nan' .number 7 of frame 1, Zrotation of Elbow"),
    "too few frames": (swap("Frames: 2", "Frames: 3"), 23, "says 3, but 2 rows"),
    "no Frames line": (swap("Frames: 2\n", ""), 22, "'Frames: 120' and .* must follow"),
    "two ROOTs": (swap("}\n\nMOTION", "}\nROOT Twin\n{\n}\nMOTION"), 21, "second ROOT .*'Base' in l"),
    "brace too many": (swap("}\n\nMOTION", "}\n}\nMOTION"), 21, "'}' is outside"),
    "joint without brace": (swap("Elbow\n  {", "Elbow\n"), 6, "JOINT needs a name .* '{', found 'Elbow"),
    "unknown channel": (swap("Xrotation", "Wrotation"), 5, "'Base' says it has 6 channels, but lists X.* Zrotation"),
    "channel twice": (swap("Yrotation\n  J", "Xrotation\n  J"), 5, "has 6 .* Xrotation, Xrotation; .* once"),
    "duplicate names": (swap("JOINT Wrist", "JOINT Elbow"), 10, "'Elbow' is taken .line 6"),
    "joint without name": (swap("JOINT Wrist", "JOINT"), 10, "needs a name"),
    "joint without OFFSET": (swap("    OFFSET 0 10 0\n", ""), 18, "'Elbow' ends without OFFSET"),
    "short OFFSET": (swap("OFFSET 0 10 0", "OFFSET 0 10"), 8, "OFFSET needs 3 .* CHANNELS'"),
    "cut inside the hierarchy": (lambda text: text[:120], 6, "without a MOTION line"),
    "no HIERARCHY": (swap("HIERARCHY", "HELLO"), 1, "unexpected 'HELLO'; known here are HIERARCHY"),
    "odd bytes in a row": (lambda text: text.encode().replace(b"-90", b"\xff\xfe"), 26, "number 7"),
    "UTF-16": (lambda text: text.encode("utf-16"), 1, "as UTF-8"),
}


@pytest.mark.parametrize("case", BROKEN)
def test_broken_files_are_refused_with_file_and_line(case):
    change, line, message = BROKEN[case]
    refused(rf"(?s)^clips/arm\.bvh, line {line}: .*{message}", parse_bvh, change(ARM), "clips/arm.bvh")


def test_read_from_path(tmp_path):
    path = tmp_path / "arm.bvh"
    path.write_text(ARM)
    for source in (path, str(path)):
        np.testing.assert_allclose(read_bvh(source).positions, ARM_POSITIONS, atol=1e-12)
        assert read_bvh(source).name == str(path)
    path.write_text(ARM.replace("-90", "x"))
    refused(r"arm\.bvh, line 26: 'x'", read_bvh, path)
    refused(r"absent\.bvh: cannot be read", read_bvh, tmp_path / "absent.bvh")


def random_motion(seed: int = 0, frames: int = 7) -> Motion:
    """A tree whose joints are not listed depth first, in any rotation at all."""
    random = np.random.default_rng(seed)
    skeleton = Skeleton(
        names=("Hips", "Left", "Right", "Left Foot", "RightFoot"),
        parents=(-1, 0, 0, 1, 2),
        offsets=np.concatenate([np.zeros((1, 3)), random.normal(size=(4, 3))]),
        end_sites=((3, (0.0, -0.1, 0.2)),),
    )
    angles = random.uniform(-180, 180, size=(frames, 5, 3))
    return Motion(skeleton, 20 * random.normal(size=(frames, 3)), matrix_from_euler("XYZ", angles), 30.0)


def assert_same_positions(after: Motion, before: Motion) -> None:
    order = [after.skeleton.names.index(name) for name in before.skeleton.names]
    np.testing.assert_allclose(after.positions[:, order], before.positions, atol=1e-6)


def test_write_and_read_again(tmp_path):
    motion = random_motion()
    again = read_bvh(write_bvh(tmp_path / "new" / "walk.bvh", motion))
    assert again.fps == pytest.approx(30.0, rel=1e-8)
    assert again.skeleton.names == ("Hips", "Left", "Left Foot", "Right", "RightFoot")
    assert (2, (0.0, -0.1, 0.2)) in again.skeleton.end_sites
    assert_same_positions(again, motion)
    assert sorted(item.name for item in (tmp_path / "new").iterdir()) == ["walk.bvh"]


def test_gimbal_lock_survives_the_round_trip_in_silence():
    motion = random_motion()
    locked = matrix_from_euler("ZXY", np.array([30.0, 90.0, -50.0]))
    motion = motion.replace(rotations=np.broadcast_to(locked, motion.rotations.shape))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        again = parse_bvh(format_bvh(motion), "locked")
    refused("frame 0, joint 0: not a rotation", format_bvh, motion.replace(rotations=-motion.rotations))
    assert_same_positions(again, motion)


def test_no_file_is_overwritten_unasked(tmp_path):
    path = tmp_path / "mine.bvh"
    path.write_text("precious")
    refused(r"mine\.bvh: exists already; .*overwrite=True", write_bvh, path, random_motion())
    assert path.read_text() == "precious"
    write_bvh(path, random_motion(), overwrite=True)
    assert read_bvh(path).num_frames == 7
    assert [item.name for item in tmp_path.iterdir()] == ["mine.bvh"]


def test_fifty_real_clips_survive_the_round_trip(bandai_dataset):
    clips = bandai_dataset.clips[:: len(bandai_dataset.clips) // 50][:50]
    assert len({clip.name for clip in clips}) == 50
    for clip in clips:
        motion = clip.load()
        again = parse_bvh(format_bvh(motion), "again")
        assert again.skeleton == motion.skeleton and np.abs(again.positions - motion.positions).max() < 1e-4
