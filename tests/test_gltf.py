"""glTF files, read again by the letter of the standard with a reader that shares nothing with the writer."""

import json
import struct

import numpy as np
import pytest
from builders import wandering_motion
from scipy.spatial.transform import Rotation
from test_skeleton import BANDAI, random_motion

from f3amd_companion.serving.motion_files import write_glb, write_motion_csv
from f3amd_lib.motion.skeleton import Motion
from f3amd_lib.motion.synthetic import SYNTHETIC_SKELETON
from f3amd_lib.text.data.body import make_body, pose_body

SIZES = {"SCALAR": (), "VEC3": (3,), "VEC4": (4,), "MAT4": (4, 4)}
TYPES = {5121: "<u1", 5123: "<u2", 5125: "<u4", 5126: "<f4"}


class Reader:
    """Chunks, accessors, nodes and skins of a .glb file (glTF 2.0, sections 3.6, 3.7 and 4.4)."""

    def __init__(self, path):
        data = path.read_bytes()
        magic, version, length = struct.unpack_from("<4sII", data)
        assert (magic, version, length) == (b"glTF", 2, len(data))
        size, kind = struct.unpack_from("<I4s", data, 12)
        assert kind == b"JSON" and size % 4 == 0
        self.json = json.loads(data[20 : 20 + size])
        assert struct.unpack_from("<I4s", data, 20 + size)[1] == b"BIN\0"
        self.binary = data[28 + size :]

    def values(self, number):
        accessor = self.json["accessors"][number]
        view = self.json["bufferViews"][accessor["bufferView"]]
        shape = (accessor["count"], *SIZES[accessor["type"]])
        start = view.get("byteOffset", 0)
        assert start % 4 == 0
        read = np.frombuffer(self.binary, TYPES[accessor["componentType"]], int(np.prod(shape)), start).reshape(shape)
        if "min" in accessor:
            np.testing.assert_array_equal(read.reshape(len(read), -1).min(axis=0), accessor["min"])
            np.testing.assert_array_equal(read.reshape(len(read), -1).max(axis=0), accessor["max"])
        return np.swapaxes(read, 1, 2) if accessor["type"] == "MAT4" else read  # columns come first

    def world(self, frame):
        """Matrices of all nodes at a frame of the animation, [N, 4, 4]."""
        nodes = [dict(node) for node in self.json["nodes"]]
        (animation,) = self.json["animations"]
        for channel in animation["channels"]:
            sampler = animation["samplers"][channel["sampler"]]
            target = channel["target"]
            nodes[target["node"]][target["path"]] = self.values(sampler["output"])[frame]
        matrices = np.tile(np.eye(4), (len(nodes), 1, 1))

        def walk(number, above):
            node = nodes[number]
            own = np.eye(4)
            own[:3, :3] = Rotation.from_quat(node.get("rotation", [0, 0, 0, 1])).as_matrix()
            own[:3, 3] = node.get("translation", [0, 0, 0])
            matrices[number] = above @ own
            for child in node.get("children", []):
                walk(child, matrices[number])

        for top in self.json["scenes"][self.json["scene"]]["nodes"]:
            walk(top, np.eye(4))
        return matrices

    def skinned(self, number, frame):
        """Vertices of a mesh node as its skin moves them, [V, 3]."""
        node = self.json["nodes"][number]
        skin = self.json["skins"][node["skin"]]
        matrices = self.world(frame)[skin["joints"]] @ self.values(skin["inverseBindMatrices"])
        (part,) = self.json["meshes"][node["mesh"]]["primitives"]
        names = ("POSITION", "JOINTS_0", "WEIGHTS_0")
        place, joints, weights = (self.values(part["attributes"][name]) for name in names)
        place = np.concatenate([place, np.ones((len(place), 1))], axis=1)
        return np.einsum("vk,vkab,vb->va", weights, matrices[joints], place)[:, :3]


@pytest.mark.parametrize("rig", [SYNTHETIC_SKELETON, BANDAI], ids=["100style-like", "bandai"])
def test_joints_and_skin_are_where_our_own_kinematics_put_them(tmp_path, rig):
    motion = random_motion(rig, frames=5).replace(fps=20.0)
    file = Reader(write_glb(tmp_path / "walk.glb", motion, credit="Nobody's"))
    assert file.json["asset"]["version"] == "2.0" and file.json["asset"]["copyright"] == "Nobody's"
    (skin,) = file.json["skins"]
    assert [file.json["nodes"][joint]["name"] for joint in skin["joints"]] == list(rig.names)
    mesh = next(k for k, node in enumerate(file.json["nodes"]) if "mesh" in node)
    body = make_body(rig)
    expected = pose_body(body, rig, motion.root_position, motion.rotations)
    for frame in (0, 3):
        seen = file.world(frame)[skin["joints"], :3, 3]
        np.testing.assert_allclose(seen, motion.positions[frame], atol=1e-5)
        np.testing.assert_allclose(file.skinned(mesh, frame), expected[frame], atol=1e-5)
    assert np.abs(seen - motion.positions[2]).max() > 0.1  # another frame is another pose
    times = file.values(file.json["animations"][0]["samplers"][0]["input"])
    np.testing.assert_allclose(times, np.arange(5) / 20, atol=1e-6)


def test_faces_look_outwards_and_normals_with_them(tmp_path):
    motion = random_motion(BANDAI, frames=2)
    file = Reader(write_glb(tmp_path / "walk.glb", motion))
    (part,) = file.json["meshes"][0]["primitives"]
    place, normals = (file.values(part["attributes"][name]) for name in ("POSITION", "NORMAL"))
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-5)
    faces = file.values(part["indices"]).reshape(-1, 3)
    across = np.cross(place[faces[:, 1]] - place[faces[:, 0]], place[faces[:, 2]] - place[faces[:, 0]])
    assert ((across[:, None] * normals[faces]).sum(axis=-1) > 0).all()


def test_quaternions_do_not_jump(tmp_path):
    angles = np.linspace(0, 4 * np.pi, 60)
    turns = np.broadcast_to(np.eye(3), (60, SYNTHETIC_SKELETON.num_joints, 3, 3)).copy()
    turns[:, 0] = Rotation.from_rotvec(angles[:, None] * [0, 1, 0]).as_matrix()
    file = Reader(write_glb(tmp_path / "spin.glb", Motion(SYNTHETIC_SKELETON, np.zeros((60, 3)), turns)))
    output = file.values(file.json["animations"][0]["samplers"][1]["output"])
    assert (np.sum(output[1:] * output[:-1], axis=1) > 0.9).all()


def test_a_table_has_every_joint_of_every_frame(tmp_path):
    import pandas as pd

    motion = wandering_motion(5).replace(fps=20.0)
    table = pd.read_csv(write_motion_csv(tmp_path / "walk.csv", motion))
    assert len(table) == 5 * 6
    row = table[(table.frame == 3) & (table.joint == "LeftToeBase")].iloc[0]
    np.testing.assert_allclose(row[["x", "y", "z"]].astype(float), motion.positions[3, 3], atol=1e-6)
    turn = Rotation.from_quat(row[["qw", "qx", "qy", "qz"]].astype(float), scalar_first=True).as_matrix()
    np.testing.assert_allclose(turn, motion.rotations[3, 3], atol=1e-5)
    alone = pd.read_csv(write_motion_csv(tmp_path / "b.csv", Motion.from_positions(motion.skeleton, motion.positions)))
    assert alone.qw.isna().all() and row.seconds == pytest.approx(0.15)
