"""Motion in the files of others: BVH, glTF 2.0 (`.glb`), and a table that any program reads.

glTF has skeleton, skin and animation in one file, which engines and Blender open. A character has joints, a skin and a
mesh (`text.data.body`). Units are metres, +Y is up, and with yaw 0 it faces +Z: glTF's own conventions. Rotations are
quaternions (x, y, z, w) without jumps of sign.

Source: Khronos Group, glTF 2.0 specification, sections 3.6 (accessors), 3.7.3 (skins), 3.11 (animations).
"""

from pathlib import Path

import numpy as np
import pandas as pd
import pygltflib as gltf
from scipy.spatial.transform import Rotation

from f3amd_lib.ground.files import named_file, write_whole
from f3amd_lib.motion.bvh import write_bvh
from f3amd_lib.motion.skeleton import Motion
from f3amd_lib.text.data.body import make_body

_COMPONENTS = {"u1": gltf.UNSIGNED_BYTE, "u2": gltf.UNSIGNED_SHORT, "u4": gltf.UNSIGNED_INT, "f4": gltf.FLOAT}
_KINDS = {(): gltf.SCALAR, (3,): gltf.VEC3, (4,): gltf.VEC4, (4, 4): gltf.MAT4}
_GREY = [0.42, 0.47, 0.55, 1.0]


def _append(items: list, item) -> int:
    """Append an item, and return its place."""
    items.append(item)
    return len(items) - 1


class _File:
    """A glTF document and the bytes that its accessors point into."""

    def __init__(self, credit: str):
        self.document = gltf.GLTF2(asset=gltf.Asset(version="2.0", generator="f3amd_lib", copyright=credit or None))
        self.bytes = b""

    def put(self, values: np.ndarray, dtype: str, target: int | None = None) -> int:
        """Store an array, [N, ...], and return its accessor."""
        values = np.ascontiguousarray(values, f"<{dtype}")
        view = gltf.BufferView(buffer=0, byteOffset=len(self.bytes), byteLength=values.nbytes, target=target)
        flat = values.reshape(len(values), -1)
        bounds = {name: getattr(flat, name)(axis=0).tolist() for name in ("min", "max")}
        if values.ndim == 3:  # of matrices nobody asks for bounds
            bounds, values = {}, np.swapaxes(values, 1, 2)  # column by column
        self.bytes += values.tobytes() + bytes(-values.nbytes % 4)
        about = {"componentType": _COMPONENTS[dtype], "count": len(values), "type": _KINDS[values.shape[1:]]}
        accessor = gltf.Accessor(bufferView=_append(self.document.bufferViews, view), **about, **bounds)
        return _append(self.document.accessors, accessor)


def _quaternions(rotations) -> np.ndarray:
    """Turn [T, J, 3, 3] into (x, y, z, w), [T, J, 4], each near the one before it."""
    turns = Rotation.from_matrix(np.reshape(rotations, (-1, 3, 3))).as_quat().reshape(*rotations.shape[:2], 4)
    flips = np.where((turns[1:] * turns[:-1]).sum(axis=-1) < 0, -1.0, 1.0)
    turns[1:] *= np.cumprod(flips, axis=0)[..., None]
    return turns


def write_glb(path, motion: Motion, *, credit: str = "", overwrite: bool = False) -> Path:
    """Write a motion as a binary glTF file.

    Args:
      path: ends in .glb; folders are made.
      motion: of one character.
      credit: whose motion this is and under which terms; stands in the file as its copyright.
      overwrite: replace what is there.

    Returns:
      The path.

    Raises:
      ValueError: for a wrong suffix, a file that is there, or motion without rotations.
    """
    path = named_file(path, ".glb", "motions in binary glTF")
    file = _File(credit)
    document, skeleton, body = file.document, motion.skeleton, make_body(motion.skeleton)
    turns = _quaternions(np.asarray(motion.needed_rotations("a glTF animation"), np.float64))
    root = np.asarray(motion.root_position, np.float64)
    times = file.put(np.arange(motion.num_frames) / motion.fps, "f4")
    for joint, name in enumerate(skeleton.names):
        place = root[0] if joint == 0 else skeleton.offsets[joint]
        turn, children = turns[0, joint].tolist(), skeleton.children[joint]
        document.nodes.append(gltf.Node(name=name, translation=place.tolist(), rotation=turn, children=children))
    inverse = np.tile(np.eye(4), (skeleton.num_joints, 1, 1))
    inverse[:, :3, 3] = -skeleton.rest_positions
    joints = list(range(skeleton.num_joints))
    document.skins.append(gltf.Skin(joints=joints, skeleton=0, inverseBindMatrices=file.put(inverse, "f4")))
    padding = ((0, 0), (0, 4 - body.joints.shape[1]))
    corners = body.vertices[body.faces]
    normals = np.zeros_like(body.vertices)  # of a vertex: the sum of its faces' ones, which weighs them by area
    np.add.at(normals, body.faces, np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, None])
    attributes = gltf.Attributes(
        POSITION=file.put(body.vertices, "f4", gltf.ARRAY_BUFFER),
        NORMAL=file.put(normals / np.linalg.norm(normals, axis=1, keepdims=True), "f4", gltf.ARRAY_BUFFER),
        JOINTS_0=file.put(
            np.pad(body.joints, padding), "u1" if skeleton.num_joints <= 256 else "u2", gltf.ARRAY_BUFFER
        ),
        WEIGHTS_0=file.put(np.pad(body.weights, padding), "f4", gltf.ARRAY_BUFFER),
    )
    indices = file.put(body.faces.ravel(), "u4", gltf.ELEMENT_ARRAY_BUFFER)
    mesh = gltf.Mesh(primitives=[gltf.Primitive(attributes=attributes, indices=indices, material=0)])
    document.meshes.append(mesh)
    material = gltf.PbrMetallicRoughness(baseColorFactor=_GREY, metallicFactor=0.0, roughnessFactor=0.8)
    document.materials.append(gltf.Material(name="body", pbrMetallicRoughness=material))
    top = _append(document.nodes, gltf.Node(name=motion.name or "character", mesh=0, skin=0))
    animation = gltf.Animation(name="motion")
    turning = [(joint, "rotation", turns[:, joint]) for joint in joints]
    for node, channel, values in [(0, "translation", root), *turning]:
        sampler = _append(animation.samplers, gltf.AnimationSampler(input=times, output=file.put(values, "f4")))
        target = gltf.AnimationChannelTarget(node=node, path=channel)
        animation.channels.append(gltf.AnimationChannel(sampler=sampler, target=target))
    document.animations.append(animation)
    document.scenes.append(gltf.Scene(nodes=[0, top]))
    document.scene = 0
    document.buffers.append(gltf.Buffer(byteLength=len(file.bytes)))
    document.set_binary_blob(file.bytes)
    return write_whole(path, b"".join(document.save_to_bytes()), overwrite=overwrite)


def write_motion_csv(path, motion: Motion, *, overwrite: bool = False) -> Path:
    """Write a motion as CSV, a row for each frame and joint.

    Columns: frame, seconds, joint, x, y, z (global position, metres), qw, qx, qy, qz (local rotation; the root's is
    global; empty where motion has positions alone).

    Args:
      path: where to; folders are made.
      motion: any.
      overwrite: replace what is there.

    Returns:
      The path.

    Raises:
      ValueError: for a file that is there.
    """
    frames, joints = motion.positions.shape[:2]
    number = np.repeat(np.arange(frames), joints)
    columns = {"frame": number, "seconds": number / motion.fps, "joint": np.tile(motion.skeleton.names, frames)}
    columns |= dict(zip("xyz", motion.positions.reshape(-1, 3).T, strict=True))
    turns = np.full((frames * joints, 4), np.nan)
    if motion.rotations is not None:
        turns = Rotation.from_matrix(motion.rotations.reshape(-1, 3, 3)).as_quat(scalar_first=True)
    columns |= {f"q{axis}": turns[:, k] for k, axis in enumerate("wxyz")}
    return write_whole(path, pd.DataFrame(columns).to_csv(index=False, float_format="%.6f"), overwrite=overwrite)


def write_motion(path: Path, motion: Motion, *, credit: str = "", overwrite: bool = False) -> Path:
    """Write a motion in the format that the path ends in, .bvh, .glb or .csv; arguments are those of `write_glb`."""
    if path.suffix == ".glb":
        return write_glb(path, motion, credit=credit, overwrite=overwrite)
    return {".bvh": write_bvh, ".csv": write_motion_csv}[path.suffix](path, motion, overwrite=overwrite)
