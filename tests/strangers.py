"""Motion files with one habit each, made by code: what strangers' exporters write of one walk.

`bvh_cases()` gives name -> bytes. All describe the walk of `plain`, unless their name is in `REFUSED`.
"""

import re

import numpy as np

from f3amd_lib.motion.bvh import format_bvh
from f3amd_lib.motion.rotations import euler_from_matrix, matrix_from_euler
from f3amd_lib.motion.skeleton import Motion, Skeleton

# Name, parent, offset in centimetres.
_TREE = [
    ("Hips", -1, (0, 0, 0)), ("Spine", 0, (0, 10, 0)), ("Spine1", 1, (0, 25, 0)), ("Neck", 2, (0, 20, 0)),
    ("Head", 3, (0, 10, 0)), ("LeftShoulder", 2, (4, 15, 0)), ("LeftArm", 5, (14, 0, 0)),
    ("LeftForeArm", 6, (28, 0, 0)), ("LeftHand", 7, (25, 0, 0)), ("RightShoulder", 2, (-4, 15, 0)),
    ("RightArm", 9, (-14, 0, 0)),
    ("RightForeArm", 10, (-28, 0, 0)), ("RightHand", 11, (-25, 0, 0)), ("LeftUpLeg", 0, (9, -5, 0)),
    ("LeftLeg", 13, (0, -42, 0)), ("LeftFoot", 14, (0, -40, 0)), ("LeftToeBase", 15, (0, -4, 14)),
    ("RightUpLeg", 0, (-9, -5, 0)), ("RightLeg", 17, (0, -42, 0)), ("RightFoot", 18, (0, -40, 0)),
    ("RightToeBase", 19, (0, -4, 14)),
]  # fmt: skip
NAMES = [name for name, _, _ in _TREE]

_SMPL = """Pelvis Spine1 Spine2 Neck Head L_Collar L_Shoulder L_Elbow L_Wrist R_Collar R_Shoulder R_Elbow R_Wrist
L_Hip L_Knee L_Ankle L_Foot R_Hip R_Knee R_Ankle R_Foot""".split()
_BIPED = """Bip01|Bip01 Spine|Bip01 Spine1|Bip01 Neck|Bip01 Head|Bip01 L Clavicle|Bip01 L UpperArm|
Bip01 L Forearm|Bip01 L Hand|Bip01 R Clavicle|Bip01 R UpperArm|Bip01 R Forearm|Bip01 R Hand|
Bip01 L Thigh|Bip01 L Calf|Bip01 L Foot|Bip01 L Toe0|Bip01 R Thigh|Bip01 R Calf|Bip01 R Foot|
Bip01 R Toe0""".replace("\n", "").split("|")
_RIGIFY = """spine spine.001 spine.003 spine.004 spine.006 shoulder.L upper_arm.L forearm.L hand.L shoulder.R
upper_arm.R forearm.R hand.R thigh.L shin.L foot.L toe.L thigh.R shin.R foot.R toe.R""".split()
_DAZ = """hip abdomen chest neck head lCollar lShldr lForeArm lHand rCollar rShldr rForeArm rHand lThigh lShin
lFoot lToe rThigh rShin rFoot rToe""".split()
_VRM = """J_Bip_C_Hips J_Bip_C_Spine J_Bip_C_Chest J_Bip_C_Neck J_Bip_C_Head J_Bip_L_Shoulder J_Bip_L_UpperArm
J_Bip_L_LowerArm J_Bip_L_Hand J_Bip_R_Shoulder J_Bip_R_UpperArm J_Bip_R_LowerArm J_Bip_R_Hand
J_Bip_L_UpperLeg J_Bip_L_LowerLeg J_Bip_L_Foot J_Bip_L_ToeBase J_Bip_R_UpperLeg J_Bip_R_LowerLeg
J_Bip_R_Foot J_Bip_R_ToeBase""".split()
_UNREAL = """pelvis spine_01 spine_02 neck_01 head clavicle_l upperarm_l lowerarm_l hand_l clavicle_r upperarm_r
lowerarm_r hand_r thigh_l calf_l foot_l ball_l thigh_r calf_r foot_r ball_r""".split()
NAMINGS = {
    "Unreal": _UNREAL,
    "capitals": [name.upper() for name in NAMES],
    "a namespace with a side": [f"Wright:{name}" for name in NAMES],
    "mixamorig": [f"mixamorig:{name}" for name in NAMES],
    "mixamorig1": [f"mixamorig1:{name}" for name in NAMES],
    "no colon": [f"mixamorig{name}" for name in NAMES],
    "Character1": [f"Character1_{name}" for name in NAMES],
    "namespace": [f"Actor:{name}" for name in NAMES],
    "lower case": [name.lower() for name in NAMES],
    "snake": [re.sub("(?<=[a-z])(?=[A-Z])", "_", name).lower() for name in NAMES],
    "Rokoko": [re.sub("UpLeg$", "Thigh", re.sub("(?<!Up)Leg$", "Shin", name)) for name in NAMES],
    "SMPL": _SMPL, "Biped": _BIPED, "Biped, underscores": [name.replace(" ", "_") for name in _BIPED],
    "Rigify": _RIGIFY, "DAZ": _DAZ, "VRM": _VRM, "no names": [f"bone_{number:02d}" for number in range(len(NAMES))],
}  # fmt: skip
"""Names of the 21 joints, in the order of `NAMES`, as tools give them."""


def walker(names=NAMES, *, frames: int = 90, fps: float = 30.0) -> Motion:
    """Return the walk that all files describe: 1.1 m/s along +Z, arms down."""
    skeleton = Skeleton(
        names, [parent for _, parent, _ in _TREE], 0.01 * np.array([offset for *_, offset in _TREE], float)
    )
    time = np.arange(frames) / fps
    swing = 25.0 * np.sin(2 * np.pi * time)
    turns = np.zeros((frames, len(names), 3))  # degrees about Z, X and Y
    turns[:, [NAMES.index("LeftArm"), NAMES.index("RightArm")], 0] = -70.0, 70.0
    for name, sign in (("LeftUpLeg", 1), ("RightUpLeg", -1), ("RightArm", 0.6), ("LeftArm", -0.6)):
        turns[:, NAMES.index(name), 1] = sign * swing
    for name, phase in (("LeftLeg", 0.5), ("RightLeg", 0.0)):
        turns[:, NAMES.index(name), 1] = 15.0 + 15.0 * np.sin(2 * np.pi * (time + phase))
    root = np.stack([0 * time, 0.92 + 0.015 * np.cos(4 * np.pi * time), 1.1 * time], axis=-1)
    return Motion(skeleton, root, matrix_from_euler("ZXY", turns), fps, "walker")


def larger(motion: Motion, times: float) -> Motion:
    """Return the motion of somebody so many times as large."""
    old = motion.skeleton
    skeleton = Skeleton(old.names, old.parents, times * old.offsets, old.end_sites)
    return motion.replace(skeleton=skeleton, root_position=times * motion.root_position)


def reordered(plain: str, motion: Motion, order: str) -> str:
    """Return a BVH text whose rotations are about other axes in turn."""
    head, names = plain[: plain.index("MOTION")], re.findall(r"(?:ROOT|JOINT) (\S+)", plain)
    degrees = euler_from_matrix(order, motion.rotations[:, [motion.skeleton.index(name) for name in names]])
    rows = np.concatenate([100.0 * motion.root_position, degrees.reshape(motion.num_frames, -1)], axis=1)
    lines = plain[len(head) :].splitlines()[:3] + [" ".join(f"{value:.6f}" for value in row) for row in rows]
    channels = " ".join(f"{axis}rotation" for axis in order)
    return head.replace("Zrotation Xrotation Yrotation", channels) + "\n".join(lines) + "\n"


def bvh_cases() -> dict[str, bytes]:
    """Return files by the name of their habit."""
    motion = walker()
    plain = format_bvh(motion)
    rows = plain.index("MOTION")
    head, body = plain[:rows], plain[rows:]
    lines = body.splitlines()
    numbers = lines[3:]
    cases = {"plain": plain}
    cases |= {f"names: {tool}": format_bvh(walker(names)) for tool, names in NAMINGS.items()}
    cases |= {f"order {order}": reordered(plain, motion, order) for order in ("XYZ", "XZY", "YXZ", "YZX", "ZYX")}
    ends = {"CR LF": "\r\n", "CR CR LF": "\r\r\n", "CR": "\r"}
    cases |= {name: plain.replace("\n", end) for name, end in ends.items()}
    exponents = [" ".join(f"{float(x):.7e}" for x in row.split()) for row in numbers]
    wrapped = [" ".join(part) for row in map(str.split, numbers) for part in (row[:30], row[30:])]
    cases["exponents"] = head + "\n".join(lines[:3] + exponents)
    cases["wrapped rows"] = head + "\n".join(lines[:3] + wrapped)
    cases["no End Site"] = re.sub(r"End Site\s*\{[^}]*\}", "", plain)
    cases["offset at the root"] = re.sub(r"(?<=ROOT Hips\n\{\n\tOFFSET )[^\n]*", "0.0 92.0 0.0", plain)
    cases["comment first"] = "# made by X\n" + plain
    cases["note last"] = plain + "# exported by hand\n"
    cases["no colon after Frames"] = plain.replace("Frames:", "Frames").replace("Frame Time:", "Frame Time")
    cases["a rate of two digits"] = re.sub("Frame Time: .*", "Frame Time: .033", plain)
    units = {"metres": 0.01, "millimetres": 10.0, "inches": 0.01 / 0.0254, "CMU's unit": 0.0045 / 0.0254}
    cases |= {name: format_bvh(larger(motion, times)) for name, times in units.items()}
    axes = np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])
    tipped = Skeleton(NAMES, motion.skeleton.parents, motion.skeleton.offsets @ axes.T)
    cases["Z up"] = format_bvh(Motion(tipped, motion.root_position @ axes.T, axes @ motion.rotations @ axes.T, 30.0))
    # Six channels at every joint: what OFFSET says once more, or in its place.
    six = re.sub(r"CHANNELS 3 ", "CHANNELS 6 Xposition Yposition Zposition ", head)
    bones = 100 * motion.skeleton.offsets
    order = [NAMES.index(name) for name in re.findall(r"(?:ROOT|JOINT) (\S+)", head)]
    noise = np.random.default_rng(0).normal(0, 0.05, (len(numbers), len(order), 3))

    def with_positions(stretch, share=1.0):
        made = []
        for frame, row in enumerate(numbers):
            values = row.split()
            parts = [" ".join(values[:6])]
            for place, joint in enumerate(order[1:], start=1):
                bone = share * bones[joint] + stretch * noise[frame, place]
                parts.append(" ".join(f"{x:.6f}" for x in bone) + " " + " ".join(values[3 + 3 * place : 6 + 3 * place]))
            made.append(" ".join(parts))
        return "\n".join(lines[:3] + made) + "\n"

    cases["six channels"] = six + with_positions(0.0)
    cases["six channels of zero"] = six + with_positions(0.0, share=0.0)
    no_offset = re.sub(r"(JOINT \S+\s*\{\s*OFFSET )[^\n]*", r"\g<1>0 0 0", six)
    cases["six channels, no OFFSET"] = no_offset + with_positions(0.0)
    cases["six channels, stretched"] = six + with_positions(1.0)
    # What is no walk of this skeleton any more, or no file at all.
    cases["decimal commas"] = plain.replace(".", ",")
    cases["two joints of one name"] = plain.replace("RightToeBase", "LeftToeBase")
    cases["a frame too few"] = plain.replace("Frames: 90", "Frames: 91")
    cases["a frame too many"] = plain.replace("Frames: 90", "Frames: 89")
    cases["no frame"] = head + "MOTION\nFrames: 0\nFrame Time: 0.0333333\n"
    cases["not finite"] = head + "\n".join([*lines[:-1], "nan " + lines[-1].split(" ", 1)[1]]) + "\n"
    cases["two people"] = head + head.partition("\n")[2] + body
    cases["glued"] = plain.replace("OFFSET -", "OFFSET-")
    made = {name: text.encode() for name, text in cases.items()}
    made["Latin-1"] = plain.replace("Hips", "Hüfte").encode("latin-1")
    made["UTF-16"] = plain.encode("utf-16")
    return made


REFUSED = {
    "decimal commas": "comma", "two joints of one name": "LeftToeBase", "a frame too few": "91",
    "a frame too many": "89", "no frame": "Frames", "not finite": "nan", "two people": "second ROOT",
    "glued": "OFFSET-", "UTF-16": "UTF-",
}  # fmt: skip
"""Cases that cannot be read -> what their message names."""


def cmu_skeleton() -> Skeleton:
    """Return a person as in CMU's clips: hip joints, neck and collar bones without length, legs of 14.9 units."""
    tree = [
        ("Hips", -1, (0, 0, 0)), ("LHipJoint", 0, (0, 0, 0)), ("LeftUpLeg", 1, (1.7, -1.8, 0.6)),
        ("LeftLeg", 2, (2.6, -7.1, 0)), ("LeftFoot", 3, (2.5, -6.8, 0)), ("LeftToeBase", 4, (0.2, -0.5, 2.1)),
        ("RHipJoint", 0, (0, 0, 0)), ("RightUpLeg", 6, (-1.6, -1.8, 0.6)), ("RightLeg", 7, (-2.6, -7.1, 0)),
        ("RightFoot", 8, (-2.5, -6.8, 0)), ("RightToeBase", 9, (-0.2, -0.6, 2.1)), ("LowerBack", 0, (0, 0, 0)),
        ("Spine", 11, (0, 2.1, -0.1)), ("Spine1", 12, (0, 2.1, -0.1)), ("Neck", 13, (0, 0, 0)),
        ("Neck1", 14, (0, 1.6, 0.1)), ("Head", 15, (0, 1.6, -0.1)), ("LeftShoulder", 13, (0, 0, 0)),
        ("LeftArm", 17, (3.5, 0.9, -0.2)), ("LeftForeArm", 18, (4.9, 0, 0)), ("LeftHand", 19, (3.4, 0, 0)),
        ("LeftFingerBase", 20, (0, 0, 0)), ("LeftHandIndex1", 21, (0.7, 0, 0)), ("LThumb", 20, (0, 0, 0)),
        ("RightShoulder", 13, (0, 0, 0)), ("RightArm", 24, (-3.5, 0.8, -0.3)), ("RightForeArm", 25, (-5.0, 0, 0)),
        ("RightHand", 26, (-3.4, 0, 0)), ("RightFingerBase", 27, (0, 0, 0)), ("RightHandIndex1", 28, (-0.7, 0, 0)),
        ("RThumb", 27, (0, 0, 0)),
    ]  # fmt: skip
    names, parents, offsets = zip(*tree, strict=True)
    return Skeleton(names, parents, 0.01 * np.array(offsets, float))  # as a reader of centimetres sees it
