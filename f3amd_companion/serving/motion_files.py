"""Motion in the files of others: BVH, glTF 2.0 (`.glb`), a table that any program reads; and a start from a file.

glTF has skeleton, skin and animation in one file, which engines and Blender open. A character has joints, a skin and a
mesh (`text.data.body`). Units are metres, +Y is up, and with yaw 0 it faces +Z: glTF's own conventions. Rotations are
quaternions (x, y, z, w) without jumps of sign.

Source: Khronos Group, glTF 2.0 specification, sections 3.6 (accessors), 3.7.3 (skins), 3.11 (animations), 4.4 (chunks).
"""

import json
import struct
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from f3amd_lib.data.features import center_window, frame_yaw, motion_from_frames, turn_frames, world_frames
from f3amd_lib.ground.files import named_file, read_toml, write_whole
from f3amd_lib.ground.names import check_known
from f3amd_lib.motion.anatomy import ROLES
from f3amd_lib.motion.bvh import write_bvh
from f3amd_lib.motion.retarget import retarget
from f3amd_lib.motion.root_paths import RootPath
from f3amd_lib.motion.skeleton import Motion, resample
from f3amd_lib.rollout.rollout import path_start
from f3amd_lib.text.data.body import make_body
from f3amd_lib.training.checkpoints import TrainedModel

_COMPONENTS = {"u1": 5121, "u2": 5123, "u4": 5125, "f4": 5126}
_KINDS = {(): "SCALAR", (3,): "VEC3", (4,): "VEC4", (4, 4): "MAT4"}
_CORNERS, _FACES = {"target": 34962}, {"target": 34963}  # what a view is for: numbers of vertices, numbers of faces
_GREY = [0.42, 0.47, 0.55, 1.0]


class _File:
    """Accessors of a glTF file, a view each, and the bytes that they point into."""

    def __init__(self):
        self.accessors, self.views, self.bytes = [], [], b""

    def put(self, values: np.ndarray, dtype: str, **use) -> int:
        """Store an array, [N, ...], and return its accessor."""
        values = np.ascontiguousarray(values, f"<{dtype}")
        self.views.append({"buffer": 0, "byteOffset": len(self.bytes), "byteLength": values.nbytes, **use})
        flat = values.reshape(len(values), -1)
        bounds = {name: getattr(flat, name)(axis=0).tolist() for name in ("min", "max")}
        if values.ndim == 3:  # of matrices nobody asks for bounds
            bounds, values = {}, np.swapaxes(values, 1, 2)  # column by column
        self.bytes += values.tobytes() + bytes(-values.nbytes % 4)
        number, kind = len(self.accessors), _KINDS[values.shape[1:]]
        about = {"bufferView": number, "componentType": _COMPONENTS[dtype], "count": len(values), "type": kind}
        self.accessors.append(about | bounds)
        return number


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
    file, skeleton, body = _File(), motion.skeleton, make_body(motion.skeleton)
    turns = _quaternions(np.asarray(motion.needed_rotations("a glTF animation"), np.float64))
    root = np.asarray(motion.root_position, np.float64)
    times = file.put(np.arange(motion.num_frames) / motion.fps, "f4")
    joints = list(range(skeleton.num_joints))
    places = [root[0], *skeleton.offsets[1:]]
    nodes = []
    for name, place, turn, children in zip(skeleton.names, places, turns[0], skeleton.children, strict=True):
        node = {"name": name, "translation": place.tolist(), "rotation": turn.tolist()}
        nodes.append(node | ({"children": children} if children else {}))  # the standard knows no empty list
    nodes.append({"name": motion.name or "character", "mesh": 0, "skin": 0})
    inverse = np.tile(np.eye(4), (skeleton.num_joints, 1, 1))
    inverse[:, :3, 3] = -skeleton.rest_positions
    skin = {"joints": joints, "skeleton": 0, "inverseBindMatrices": file.put(inverse, "f4")}
    padding = ((0, 0), (0, 4 - body.joints.shape[1]))
    corners = body.vertices[body.faces]
    normals = np.zeros_like(body.vertices)  # of a vertex: the sum of its faces' ones, which weighs them by area
    np.add.at(normals, body.faces, np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, None])
    attributes = {
        "POSITION": file.put(body.vertices, "f4", **_CORNERS),
        "NORMAL": file.put(normals / np.linalg.norm(normals, axis=1, keepdims=True), "f4", **_CORNERS),
        "JOINTS_0": file.put(np.pad(body.joints, padding), "u1" if skeleton.num_joints <= 256 else "u2", **_CORNERS),
        "WEIGHTS_0": file.put(np.pad(body.weights, padding), "f4", **_CORNERS),
    }
    mesh = {"attributes": attributes, "indices": file.put(body.faces.ravel(), "u4", **_FACES), "material": 0}
    surface = {"baseColorFactor": _GREY, "metallicFactor": 0.0, "roughnessFactor": 0.8}
    moving = [(0, "translation", root), *((joint, "rotation", turns[:, joint]) for joint in joints)]
    samplers = [{"input": times, "output": file.put(values, "f4")} for _, _, values in moving]
    channels = [{"sampler": k, "target": {"node": node, "path": path}} for k, (node, path, _) in enumerate(moving)]
    document = {
        "asset": {"version": "2.0", "generator": "f3amd_lib"} | ({"copyright": credit} if credit else {}),
        "scene": 0, "scenes": [{"nodes": [0, len(joints)]}], "nodes": nodes, "skins": [skin],
        "meshes": [{"primitives": [mesh]}], "materials": [{"name": "body", "pbrMetallicRoughness": surface}],
        "animations": [{"name": "motion", "samplers": samplers, "channels": channels}],
        "accessors": file.accessors, "bufferViews": file.views, "buffers": [{"byteLength": len(file.bytes)}],
    }  # fmt: skip
    text = json.dumps(document, ensure_ascii=False, separators=(",", ":")).encode()
    chunks = ((b"JSON", text + b" " * (-len(text) % 4)), (b"BIN\0", file.bytes))
    content = b"".join(struct.pack("<I4s", len(chunk), kind) + chunk for kind, chunk in chunks)
    return write_whole(path, struct.pack("<4sII", b"glTF", 2, 12 + len(content)) + content, overwrite=overwrite)


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
    import pandas as pd  # here: half a second that other formats do not need

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


def read_joint_map(path) -> dict[str, str]:
    """Return role -> joint's name, of a TOML file of lines such as left_knee = "calf_l"."""
    try:
        named = read_toml(path)
    except (OSError, ValueError) as error:
        raise ValueError(
            f'{path}: cannot be read as TOML ({error}); write lines such as left_knee = "calf_l"'
        ) from error
    for role, name in named.items():
        check_known(role, sorted(ROLES), f"role in {path}:")
        if not isinstance(name, str):
            raise ValueError(f"{path}: {role} must be a joint's name in quotes, got {name!r}")
    return named


def start_history(trained: TrainedModel, motion: Motion, path: RootPath) -> tuple[np.ndarray, str]:
    """Make a motion's last frames the history of a rollout along a path.

    A motion of the model's own skeleton is taken as it is; one of another humanoid is retargeted.

    Args:
      trained: the model.
      motion: at any frame rate.
      path: what is to be followed; the history is moved to its start and turned to face as it does.

    Returns:
      World frames, [1, H, C], for `MotionGenerator.rollout(history=...)`, and a sentence that says what was done.

    Raises:
      ValueError: for a motion shorter than the history, or a skeleton whose joints we cannot name.
    """
    motion, frames = resample(motion, 30.0, smooth=True), trained.config.num_history
    if motion.num_frames < frames:
        needed = f"{frames}, {frames / 30.0:.1f} s"
        raise ValueError(f"{motion.name}: {motion.num_frames} frames at 30 fps; a start needs {needed}")
    motion = motion.slice(motion.num_frames - frames, motion.num_frames)
    if motion.skeleton == trained.skeleton:
        note = f"{motion.name}: the model's own skeleton, taken as it is"
    else:
        pose = next(iter(trained.start_poses.values()))[0]
        made, scale, error = retarget(motion, motion_from_frames(trained.skeleton, pose))
        joints = f"{motion.skeleton.num_joints} joints, the model's has {trained.skeleton.num_joints}"
        off = f"legs scaled by {scale:.2f}, joints off by {error.mean():.1f} cm on average"
        note = f"{motion.name}: another skeleton ({joints}), retargeted by role; {off}"
        motion = made
    world = world_frames(motion)
    turned = turn_frames(center_window(world, world[-1, [0, 2]]), path.yaw[0] - frame_yaw(trained.skeleton, world)[-1])
    return center_window(turned, -path_start(path.position))[None].astype(np.float32), note
