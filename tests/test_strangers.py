"""Motion of others: units, axes, names and files with a habit are read as what they mean, or refused with the cause."""

import re

import numpy as np
import pytest
from builders import refused
from strangers import NAMES, NAMINGS, REFUSED, bvh_cases, cmu_skeleton, walker

from f3amd_companion.__main__ import main
from f3amd_companion.serving.motion_files import read_joint_map
from f3amd_lib.motion.anatomy import joint_roles, leg_length, side_of, twin_name
from f3amd_lib.motion.bvh import parse_bvh
from f3amd_lib.motion.plausible import as_person, call_by_roles
from f3amd_lib.motion.skeleton import Motion, Skeleton

CASES = bvh_cases()
CORRECTED = {"metres", "millimetres", "inches", "CMU's unit", "Z up"}


@pytest.mark.parametrize("name", [name for name in CASES if name not in REFUSED])
def test_all_files_of_one_walk_are_read_as_it(name):
    motion, notes = as_person(parse_bvh(CASES[name], name))
    tolerance = 5e-3 if "stretched" in name else 1e-3
    np.testing.assert_allclose(motion.positions, walker().positions, atol=tolerance)
    assert motion.fps == pytest.approx(30.0, rel=1e-4)
    assert bool(notes) == (name in CORRECTED)


RATES = {".033": 30, "0.017": 60, "0.04": 25, "0.0083": 120, "0.0333333": 1 / 0.0333333, "0.0331": 1 / 0.0331}


@pytest.mark.parametrize(("written", "rate"), RATES.items())
def test_a_frame_time_of_few_digits_is_the_usual_rate_that_is_written_so(written, rate):
    text = re.sub("Frame Time: .*", f"Frame Time: {written}", CASES["plain"].decode())
    assert parse_bvh(text, "walk").fps == rate


@pytest.mark.parametrize("name", REFUSED)
def test_what_has_no_plain_meaning_is_refused_with_its_cause(name):
    refused(f"(?i){name}, line.*{REFUSED[name]}", parse_bvh, CASES[name], name)


@pytest.mark.parametrize("tool", NAMINGS)
def test_roles_are_the_same_whatever_a_tool_calls_the_joints(tool):
    skeleton = walker(NAMINGS[tool]).skeleton
    assert skeleton.roles == walker().skeleton.roles
    assert skeleton.mirror_permutation == walker().skeleton.mirror_permutation


def test_a_wrong_name_does_not_mislead_the_tree():
    """Names break ties: a knee that is called a hand is a knee."""
    names = ["LeftHand2" if name == "LeftLeg" else name for name in NAMES]
    assert joint_roles(walker(names).skeleton) == joint_roles(walker().skeleton)


def test_cmus_person_has_arms_although_collar_bones_have_no_length():
    skeleton = cmu_skeleton()
    roles = joint_roles(skeleton)
    arm = [skeleton.names[roles[f"left_{part}"]] for part in ("shoulder", "elbow", "wrist")]
    assert arm == ["LeftArm", "LeftForeArm", "LeftHand"]
    assert leg_length(as_person(still(skeleton))[0].skeleton, roles) == pytest.approx(0.84, abs=0.01)


def still(skeleton: Skeleton, frames: int = 4) -> Motion:
    turns = np.tile(np.eye(3), (frames, skeleton.num_joints, 1, 1))
    return Motion(skeleton, np.tile([0.0, 0.9, 0.0], (frames, 1)), turns, 30.0, "somebody")


def test_a_person_of_no_known_unit_is_refused_and_an_option_overrules_it():
    odd = still(Skeleton(NAMES, walker().skeleton.parents, 3.0 * walker().skeleton.offsets))
    refused("somebody: its legs are .* --scale", as_person, odd)
    motion, notes = as_person(odd, scale=0.01 / 3.0)
    assert leg_length(motion.skeleton, joint_roles(motion.skeleton)) == pytest.approx(0.82) and notes
    refused("somebody: units of 1e-12 m are no scale of a walker: its legs are", as_person, odd, scale=1e-12)


def test_a_joint_map_overrules_what_the_tree_says(tmp_path, caplog):
    file, mapped = tmp_path / "walk.bvh", tmp_path / "map.toml"
    file.write_bytes(CASES["metres"])
    mapped.write_text('left_wrist = "LeftForeArm"\nhead = "Neck"\n')
    with caplog.at_level("INFO", logger="f3amd"):
        assert main(["joints", str(file), "--joint-map", str(mapped)]) == 0
    said = "\n".join(caplog.messages)
    assert re.search(r"corrected .*walk\.bvh: read in metres", said)
    wanted = {"left_shoulder": "LeftArm", "left_wrist": "LeftForeArm", "without a role": "Head, LeftHand"}
    for role, name in wanted.items():
        assert re.search(f"{role} +{name}\n", said)
    assert "left_elbow" not in said
    made = call_by_roles(walker(), read_joint_map(mapped)).skeleton
    assert [made.roles[role] for role in ("left_wrist", "head")] == [NAMES.index("LeftForeArm"), NAMES.index("Neck")]
    for text, message in (("lef_toe = 'a'", "did you mean 'left_toe'"), ("head = 3", "quotes"), ("head", "map.toml")):
        mapped.write_text(text)
        refused(message, read_joint_map, mapped)
    refused("no joint 'Tail'", call_by_roles, walker(), {"head": "Tail"})
    refused("one role", call_by_roles, walker(), {"head": "Head", "neck": "Head"})


def test_somebody_who_lies_is_not_taken_for_z_up():
    """Z up is what a skeleton at rest and its motion agree on."""
    lying = walker()
    tipped = np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])
    turns = lying.rotations.copy()
    turns[:, 0] = tipped @ turns[:, 0]
    lying = lying.replace(rotations=turns)
    motion, notes = as_person(lying)
    assert motion is lying and not notes
    assert as_person(lying, up="Z")[1] == ["read with Z up"]
    refused("did you mean 'Z'", as_person, lying, up="z")


def test_a_t_pose_before_the_take_is_cut_and_kept_on_request():
    motion = walker()
    turns, root = (np.concatenate([array[:1], array]) for array in (motion.rotations, motion.root_position))
    turns[0] = np.eye(3)
    begun = motion.replace(rotations=turns, root_position=root)
    cut, notes = as_person(begun)
    assert cut.num_frames == motion.num_frames and "first frame is left out" in notes[0]
    assert as_person(begun, keep_first=True)[0].num_frames == motion.num_frames + 1
    assert as_person(motion)[0] is motion


@pytest.mark.parametrize(
    ("name", "twin"),
    [("LeftUpLeg", "RightUpLeg"), ("thigh.L", "thigh.R"), ("Bip01 L Thigh", "Bip01 R Thigh"), ("lThigh", "rThigh"),
     ("L_Hip", "R_Hip"), ("Left_hip", "Right_hip"), ("J_Bip_L_Leg", "J_Bip_R_Leg"), ("LHipJoint", "RHipJoint"),
     ("leftupleg", "rightupleg"), ("hand_l", "hand_r"), ("LOWERLEG_L", "LOWERLEG_R"),
     ("mixamorigLeftLeg", "mixamorigRightLeg")],
)  # fmt: skip
def test_a_name_with_a_side_has_its_twin(name, twin):
    assert (twin_name(name), twin_name(twin)) == (twin, name)
    assert (side_of(name), side_of(twin)) == ("left", "right")


@pytest.mark.parametrize("name", ["Hips", "Neck", "Roll", "root", "ROOT", "LOWERBACK", "L5", "Head", "bone_07"])
def test_a_middle_joint_is_its_own_twin(name):
    assert twin_name(name) == name and side_of(name) == ""
