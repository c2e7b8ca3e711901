"""The page reads a dropped BVH file as Python does, by the table of cases of strangers.py; its module runs in node."""

import json
import subprocess

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from strangers import NAMES, NAMINGS, REFUSED, bvh_cases, cmu_skeleton, larger, walker

from f3amd_companion.serving.player import FOLDER
from f3amd_lib.motion.bvh import format_bvh
from f3amd_lib.motion.rotations import matrix_from_euler
from f3amd_lib.motion.skeleton import Motion, Skeleton, resample

pytestmark = pytest.mark.wants("node")
SCRIPT = """
import { readBvh } from "./bvh.mjs";
import { readFileSync, readdirSync } from "node:fs";
const found = {};
for (const file of readdirSync(".").filter((name) => name.endsWith(".bvh"))) {
  try {
    const read = readBvh(new Uint8Array(readFileSync(file)), 30);
    found[file.slice(0, -4)] = { ...read, root: Array.from(read.root), turns: Array.from(read.turns) };
  } catch (error) { found[file.slice(0, -4)] = { refused: error.message }; }
}
process.stdout.write(JSON.stringify(found));
"""
TIPPED = np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])
ASSUMED = {
    "metres": "metres", "millimetres": "millimetres", "inches": "inches", "CMU's unit": "CMU's unit", "Z up": "Z up",
    "CMU": "CMU's unit", "six channels, stretched": "mm", "no legs": "no two legs",
}  # fmt: skip
"""Cases of which something had to be assumed -> a word of what the page says."""


def page_cases() -> dict[str, tuple[bytes, Motion | None]]:
    """Return name -> file and the motion in it, none where it is refused: the table, and what else a page meets."""
    plain, tree, skeleton = walker(), walker().skeleton, cmu_skeleton()
    table = {name: (content, None if name in REFUSED else plain) for name, content in bvh_cases().items()}
    lies = plain.rotations.copy()
    lies[:, 0] = TIPPED @ lies[:, 0]
    pole = Skeleton(("Root", "Mid", "Tip"), (-1, 0, 1), [[0, 0, 0], [0, 1, 0], [0, 1, 0]])
    # A skirt's bones come before the legs and are none.
    names = ("Hips", *(f"Skirt{side}{number}" for side in "LR" for number in range(3)), *NAMES[1:])
    parents = (-1, 0, 1, 2, 0, 4, 5, *(parent + 6 * (parent > 0) for parent in tree.parents[1:]))
    skirt = Skeleton(names, parents, np.insert(tree.offsets, [1] * 6, [0.0, -0.1, 0.0], axis=0))
    more = {f"{fps} fps": walker(frames=3 * fps, fps=float(fps)) for fps in (24, 25, 60, 100, 120)}
    more |= {"one frame": walker(frames=1), "somebody lies": plain.replace(rotations=lies)}
    more["no legs"] = Motion(pole, np.full((9, 3), 0.25), np.tile(np.eye(3), (9, 3, 1, 1)), 30.0)
    more["skirt"] = Motion(skirt, plain.root_position, np.insert(plain.rotations, [1] * 6, np.eye(3), axis=1), 30.0)
    table |= {name: (format_bvh(motion).encode(), motion) for name, motion in more.items()}
    turns = matrix_from_euler("ZXY", np.random.default_rng(0).normal(0, 10, (20, skeleton.num_joints, 3)))
    cmu = Motion(skeleton, np.tile([0.0, 0.17, 0.0], (20, 1)), turns, 120.0)
    table["CMU"] = (format_bvh(cmu).encode(), larger(cmu, 2.54 / 0.45))
    table["of no unit"] = (format_bvh(larger(plain, 0.05)).encode(), None)
    lines = table["six channels"][0].decode().splitlines()
    words = lines[-1].split()
    words[6] = "2.0"  # where the spine begins, in the last frame alone
    return table | {"not rigid": ("\n".join([*lines[:-1], " ".join(words)]).encode(), None)}


CASES = page_cases()


@pytest.fixture(scope="module")
def read_by_page(tmp_path_factory):
    """What the page makes of all cases, by name."""
    folder = tmp_path_factory.mktemp("page")
    text = (FOLDER / "bvh.js").read_text(encoding="utf-8")
    (folder / "bvh.mjs").write_text(text.replace('from "three"', 'from "./three.mjs"'), encoding="utf-8")
    (folder / "three.mjs").write_bytes((FOLDER / "three.min.js").read_bytes())
    (folder / "test.mjs").write_text(SCRIPT)
    for name, (content, _) in CASES.items():
        (folder / f"{name}.bvh").write_bytes(content)
    done = subprocess.run(["node", "test.mjs"], cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@pytest.mark.parametrize("name", [name for name, (_, motion) in CASES.items() if motion])
def test_the_page_shows_the_motion_of_a_file_and_says_what_it_assumed(read_by_page, name):
    read, expected = read_by_page[name], resample(CASES[name][1], 30.0)
    joints = len(read["names"])
    turns = Rotation.from_quat(np.reshape(read["turns"], (-1, 4))).as_matrix().reshape(-1, joints, 3, 3)
    skeleton = Skeleton(read["names"], read["parents"], read["offsets"])
    found = Motion(skeleton, np.reshape(read["root"], (-1, 3)), turns, 30.0)
    assert found.num_frames == expected.num_frames == read["frames"]
    np.testing.assert_allclose(found.positions, expected.positions, atol=5e-3 if "stretched" in name else 1e-3)
    said = " ".join(read["said"])
    assert ASSUMED[name] in said if name in ASSUMED else not said


@pytest.mark.parametrize("name", [name for name, (_, motion) in CASES.items() if not motion])
def test_a_file_that_cannot_be_read_is_refused_with_its_cause(read_by_page, name):
    causes = REFUSED | {"of no unit": "its legs are", "not rigid": "19.8 mm: bake"}
    assert causes[name] in read_by_page[name]["refused"]


def test_sides_of_bones_are_those_of_their_names(read_by_page):
    mark = lambda name: "left" if name.startswith("Left") else "right" if name.startswith("Right") else "middle"
    for tool in NAMINGS:
        expected = ["middle" if tool == "no names" else mark(name) for name in NAMES]
        assert read_by_page[f"names: {tool}"]["sides"] == expected, tool
