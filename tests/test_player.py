"""The motion player's page: its numbers, its text, what it refuses. tests/web opens it."""

import base64
import hashlib
import json
import re
import subprocess
import zlib
from html.parser import HTMLParser

import numpy as np
import pytest
from builders import SKELETON, refused, wandering_motion
from PIL import Image
from scipy.spatial.transform import Rotation

from f3amd_companion.serving import player
from f3amd_companion.serving.player import FOLDER, Character, Scene, player_page, rollout_scene, write_player
from f3amd_lib.drawing.stick_figures import limb_side
from f3amd_lib.motion.root_paths import RootPath, named_path, path_from_motion
from f3amd_lib.motion.skeleton import Motion, Skeleton
from f3amd_lib.motion.synthetic import SYNTHETIC_SKELETON
from f3amd_lib.rollout.rollout import Rollout
from f3amd_lib.text.data.body import body_capsules, make_body

FRAMES = 40


def page_data(page: str) -> dict:
    """The JSON block of a page."""
    return json.loads(re.search(r'id="player-data">(.*?)</script>', page, re.S)[1])


def read_tracks(data: dict) -> list[list[dict]]:
    """Every character's tracks, read as the module's text says, one number at a time.

    Plain Python integers, so that nothing is shared with the encoder's arithmetic.
    """
    stream = zlib.decompress(base64.b64decode(data["tracks"]))
    frames, offset = data["frames"], 0

    def take(channels: int, size: int, signed: bool):
        nonlocal offset
        count = channels * frames
        values = np.zeros((frames, channels), int)
        for channel in range(channels):
            total = 0
            for frame in range(frames):
                place = channel * frames + frame
                raw = bytes(stream[offset + plane * count + place] for plane in range(size))
                total = (total + int.from_bytes(raw, "little")) % 256**size
                wrapped = total - 256**size if signed and total >= 256**size // 2 else total
                values[frame, channel] = wrapped
        offset += size * count
        return values

    scenes = []
    for scene in data["scenes"]:
        characters = []
        for character in scene["characters"]:
            skeleton = data["skeletons"][character["skeleton"]]
            tracks = {"root": take(3, 4, True)}
            vector = take(3 * len(skeleton["names"]), 2, True).reshape(frames, -1, 3) / data["turns"]
            tracks["global"] = 1000 * joint_positions(skeleton, tracks["root"] / 1000, vector)
            tracks["contacts"] = take(1, 1, False)[:, 0] if character["contacts"] else None
            tracks["path"] = take(2, 4, True) if character["path"] else None
            characters.append(tracks)
        scenes.append(characters)
    assert offset == len(stream)
    return scenes


def joint_positions(skeleton: dict, root, vector) -> np.ndarray:
    """Kinematics as the page does them, from rotation vectors, [T, J, 3]."""
    turned, places = {}, np.zeros(vector.shape)
    for joint, parent in enumerate(skeleton["parents"]):
        own = Rotation.from_rotvec(vector[:, joint])
        turned[joint] = own if parent < 0 else turned[parent] * own
        above = root if parent < 0 else places[:, parent] + turned[parent].apply(skeleton["offsets"][joint])
        places[:, joint] = above
    return places


class Elements(HTMLParser):
    """All start tags of a page with their attributes, and its text."""

    def __init__(self, page: str):
        super().__init__()
        self.tags: list[tuple[str, dict]] = []
        self.text = ""
        self.feed(page)

    def handle_starttag(self, tag, attributes):
        self.tags.append((tag, dict(attributes)))

    def handle_data(self, data):
        self.text += data


# ----------------------------------------------------------------------------------------- numbers


def test_positions_come_back_to_a_millimetre():
    motions = [wandering_motion(FRAMES, seed).replace(fps=20.0) for seed in range(3)]
    # Far away and back again: beyond what int16 millimetres from the origin would hold.
    away = np.array([4000.0, 0.0, -90000.0])
    motions[1] = motions[1].replace(root_position=motions[1].root_position + away)
    data = page_data(player_page([Scene(motions[:2]), Scene(motions[2])]))
    assert [len(scene["characters"]) for scene in data["scenes"]] == [2, 1]
    assert (data["fps"], data["frames"], len(data["skeletons"])) == (20.0, FRAMES, 1)
    read = [tracks for scene in read_tracks(data) for tracks in scene]
    for motion, tracks in zip(motions, read, strict=True):
        joints = motion.skeleton.num_joints
        error = tracks["global"][:, :joints] - 1000 * motion.positions
        assert np.abs(error).max() <= 1.2
        assert np.abs(tracks["root"] - 1000 * motion.root_position).max() <= 0.5 + 1e-6


def test_contacts_and_path_come_back():
    motion = wandering_motion(FRAMES)
    path = path_from_motion(motion)
    tracks = read_tracks(page_data(player_page(Character(motion, path=path))))[0][0]
    np.testing.assert_array_equal(tracks["contacts"] & 1, motion.contacts[:, 0])
    np.testing.assert_array_equal(tracks["contacts"] >> 1, motion.contacts[:, 1])
    np.testing.assert_allclose(tracks["path"], 1000 * path.position, atol=0.5001)
    # A plain array of x and z does as well.
    other = read_tracks(page_data(player_page(Character(motion, path=path.position))))[0][0]
    np.testing.assert_array_equal(other["path"], tracks["path"])


def test_every_bone_is_described_once_with_its_side_and_the_body_is_pythons():
    described = player.describe_for_web(SYNTHETIC_SKELETON)
    ends = {}
    for joint, offset, side in described["bones"]:
        for child, parent in enumerate(SYNTHETIC_SKELETON.parents):
            if parent == joint and np.allclose(offset, SYNTHETIC_SKELETON.offsets[child], atol=1e-4):
                assert side == limb_side(SYNTHETIC_SKELETON.names[child])
                ends[child] = joint
    assert len(ends) == SYNTHETIC_SKELETON.num_joints - 1
    assert len(described["capsules"]) == len(body_capsules(SYNTHETIC_SKELETON)) == 27
    assert tuple(described["toes"]) == SYNTHETIC_SKELETON.toes
    head = SYNTHETIC_SKELETON.index("Head")
    assert described["head"] == [head, SYNTHETIC_SKELETON.parents[head]]


@pytest.mark.wants("node")
def test_the_pages_own_body_has_the_vertices_of_pythons(tmp_path):
    """body.js in Node, with the bundled three.js: the same mesh as text/data/body.py."""
    for name in ("body", "scene"):
        text = (FOLDER / f"{name}.js").read_text().replace('from "three"', 'from "./three.mjs"')
        (tmp_path / f"{name}.mjs").write_text(text)
    (tmp_path / "three.mjs").write_text((FOLDER / "three.min.js").read_text())
    described = player.describe_for_web(SYNTHETIC_SKELETON)
    (tmp_path / "skeleton.json").write_text(json.dumps(described))
    (tmp_path / "run.mjs").write_text(
        "import { readFileSync } from 'node:fs'; import { bodyGeometry } from './body.mjs';"
        "const made = bodyGeometry(JSON.parse(readFileSync('skeleton.json')));"
        "console.log(JSON.stringify([[...made.attributes.position.array], [...made.index.array],"
        " [...made.attributes.skinIndex.array].filter((_, k) => k % 4 === 0)]));"
    )
    said = subprocess.run(["node", "run.mjs"], cwd=tmp_path, check=True, capture_output=True, text=True).stdout
    vertices, faces, joints = json.loads(said)
    body = make_body(SYNTHETIC_SKELETON)
    np.testing.assert_allclose(np.reshape(vertices, (-1, 3)), body.vertices, atol=2e-5)
    np.testing.assert_array_equal(joints, body.joints[:, 0])
    ours = {tuple(np.roll(face, -np.argmin(face))) for face in body.faces}
    theirs = {tuple(np.roll(face, -np.argmin(face))) for face in np.reshape(faces, (-1, 3))}
    assert ours == theirs


def test_unlike_skeletons_share_a_page():
    # A rig of which nobody knows where its toes or hips are.
    chain = Skeleton(("Root", "Mid", "Tip"), (-1, 0, 1), [[0, 0, 0], [0, 1, 0], [0, 1, 0]])
    pole = Motion(chain, np.full((FRAMES, 3), 0.25), np.tile(np.eye(3), (FRAMES, 3, 1, 1)), name="pole")
    data = page_data(player_page([wandering_motion(FRAMES), pole, pole]))
    assert [scene["characters"][0]["skeleton"] for scene in data["scenes"]] == [0, 1, 1]
    tracks = read_tracks(data)[1][0]
    np.testing.assert_allclose(tracks["global"][7], [[250] * 3, [250, 1250, 250], [250, 2250, 250]], atol=1e-6)
    # No contacts, and a camera along +Z.
    assert tracks["contacts"] is None and data["skeletons"][1]["toes"] is None


# -------------------------------------------------------------------------------------------- text


def test_the_page_holds_everything_and_asks_for_nothing():
    page = player_page(wandering_motion(FRAMES), title="Walk")
    for tag, attributes in Elements(page).tags:
        assert "src" not in attributes and "srcset" not in attributes
        assert tag != "link" or attributes["href"] == "data:,"
    own = re.sub(r'id="packed">.*?</script>', "", page, flags=re.S)
    assert "://" not in own and "@import" not in own and "url(" not in own
    for script in sorted(FOLDER.glob("*.js")):  # three.js names addresses of standards and asks for none
        assert script.name == "three.min.js" or "://" not in script.read_text(), script
    policy = re.search(r'Content-Security-Policy" content="([^"]*)"', page)[1]
    assert policy.startswith("default-src 'none';") and "script-src 'unsafe" not in policy
    (nonce,) = (attributes["nonce"] for tag, attributes in Elements(page).tags if "nonce" in attributes)
    assert f"'nonce-{nonce}'" in policy and nonce not in player_page(wandering_motion(FRAMES), title="Run")
    bodies = [template.read_text() for template in FOLDER.glob("*.html") if template.name != "page.html"]
    assert bodies and not any(re.search(r"<(script|meta|head|body)\b|\son\w+=", body) for body in bodies)
    assert not re.search(r"\$[a-z]+\b", page.split('id="player-data"')[0])


def test_titles_are_text_and_never_markup():
    evil = '</script><script>alert("1")</script> & <b>'
    motion = wandering_motion(3)
    scene = Scene(Character(motion, color="#00aa33"), title=evil, note=evil)
    page = player_page(scene, title=evil, credit=evil)
    elements = Elements(page)
    assert [tag for tag, _ in elements.tags].count("script") == 3
    assert "b" not in [tag for tag, _ in elements.tags]
    assert page_data(page)["scenes"][0]["title"] == evil
    assert elements.text.count(evil) == 5  # title, heading, panel, note, credit
    label = next(attributes["aria-label"] for tag, attributes in elements.tags if attributes.get("class") == "labels")
    assert label.startswith(evil)


def test_a_rollout_becomes_a_scene():
    from f3amd_lib.data.features import world_frames

    motions = [wandering_motion(20, seed) for seed in range(2)]
    frames = np.stack([world_frames(motion) for motion in motions]).astype(np.float32)
    paths = tuple(named_path(name, 20) for name in ("circle", "straight"))
    rollout = Rollout(SKELETON, frames, frames[:, :4], paths, ("calm", "proud"), window=8)
    scene = rollout_scene(rollout, "Two")
    assert list(scene.boundaries) == [8, 16]
    assert [one.name or one.motion.name for one in scene.characters] == ["calm", "proud"]
    tracks = read_tracks(page_data(player_page(scene)))[0]
    for motion, path, read in zip(motions, paths, tracks, strict=True):
        error = np.abs(read["global"][:, :6] - 1000 * motion.positions).max()
        assert error < 1.2
        np.testing.assert_allclose(read["path"], 1000 * path.position, atol=0.5001)


# ----------------------------------------------------------------------------------------- refusal


def test_what_cannot_be_shown_is_refused_by_name():
    motion, short = wandering_motion(FRAMES), wandering_motion(FRAMES - 1, 1)
    refused("at least one scene", player_page, [])
    refused("cannot show 'walk'", player_page, [motion, "walk"])
    refused("wandering 1: .* 39 frames at 30 .* 40 frames", player_page, [motion, short])
    refused("the player needs rotations", player_page, Motion.from_positions(SKELETON, motion.positions))
    root = np.array(motion.root_position)
    root[2, 0] = 3e6
    refused("wandering 0: .* 2000 km", player_page, motion.replace(root_position=root))
    path = path_from_motion(motion)
    refused("40 frames at 60", player_page, Character(motion, path=RootPath(path.position, path.yaw, fps=60.0)))
    bad = np.array(path.position)
    bad[3, 1] = np.nan
    refused("target path is not finite at frame 3", player_page, Character(motion, path=bad))


# -------------------------------------------------------------------------------------------- files


def test_a_film_strip_stands_beside_the_page(tmp_path):
    scene = Scene(wandering_motion(FRAMES), title="Walk")
    path = write_player(tmp_path / "new" / "walk.html", scene, title="Walk")
    assert path.read_text(encoding="utf-8") == player_page(scene, title="Walk")
    assert Image.open(path.with_suffix(".png")).width > 500
    write_player(path, scene, title="Other")
    assert "<h1>Other</h1>" in path.read_text(encoding="utf-8")
    write_player(tmp_path / "alone.html", scene, strip=False)
    assert not (tmp_path / "alone.png").exists()
    refused(r"players are written as \.html", write_player, tmp_path / "walk.htm", scene)


def test_three_is_the_bundle_that_was_checked():
    wanted, name = (FOLDER / "three.sha256").read_text().split()
    assert hashlib.sha256((FOLDER / name).read_bytes()).hexdigest() == wanted


def test_a_ghost_is_a_character_that_can_be_seen_through():
    motion, real = wandering_motion(FRAMES), wandering_motion(FRAMES, 1)
    page = player_page(Scene(Character(motion, ghost=real), title="a"))
    one, ghost = page_data(page)["scenes"][0]["characters"]
    assert (one["ghost"], ghost["ghost"], ghost["contacts"]) == (False, True, False)
    tracks = read_tracks(page_data(page))[0]
    np.testing.assert_allclose(tracks[1]["global"], 1000 * real.positions, atol=1.2)
    assert "ghost" in Elements(page).text and "1 character of" in page
    refused("39 frames", player_page, Character(motion, ghost=wandering_motion(FRAMES - 1)))
