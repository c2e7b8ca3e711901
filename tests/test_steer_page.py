"""The page's sampling, kinematics and conditions are Python's, to 1e-4 for the same noise; and the page is whole.

Its modules run in node. tests/web/test_steer.py has the page in a browser, with the network itself.
"""

import base64
import json
import re
import subprocess
import zlib
from types import SimpleNamespace

import builders
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from builders import refused
from feet_oracle import lock_frame, start_feet
from steering_oracle import Steering, first_pose, move_target

from f3amd_companion.serving import steer
from f3amd_companion.serving.foot_locking import leg_chains
from f3amd_companion.serving.onnx_export import model_card
from f3amd_companion.serving.player import FOLDER
from f3amd_companion.serving.steer import package_file, steer_page, write_steer
from f3amd_lib.data.features import frame_positions, orthonormalise, world_frames
from f3amd_lib.diffusion.samplers import sample
from f3amd_lib.diffusion.schedules import variance_exploding
from f3amd_lib.motion.skeleton import describe_skeleton
from f3amd_lib.motion.synthetic import SYNTHETIC_SKELETON, synthesize
from f3amd_lib.rollout.blending import blend_seams
from f3amd_lib.rollout.rollout import MotionGenerator

SIGMAS = variance_exploding().grid(3)
BUNDLE = b"var a=1,b=import.meta.url;export{a as InferenceSession,b as default};\n//# sourceMappingURL=x"


def in_node(tmp_path, body: str, **given):
    """Run a script with motion.js as `m` and `given`; what it hands to `say` comes back."""
    (tmp_path / "motion.mjs").write_bytes((FOLDER / "motion.js").read_bytes())
    (tmp_path / "given.json").write_text(json.dumps(given, default=np.ndarray.tolist))
    (tmp_path / "test.mjs").write_text(
        'import * as m from "./motion.mjs"; import { readFileSync } from "node:fs";'
        'const given = JSON.parse(readFileSync("given.json"));'
        "const frames = (rows) => rows.map((row) => Float64Array.from(row));"
        "const lists = (x) => ArrayBuffer.isView(x) ? Array.from(x) : Array.isArray(x) ? x.map(lists) : x;"
        "const say = (x) => process.stdout.write(JSON.stringify(lists(x)));" + body
    )
    done = subprocess.run(["node", "test.mjs"], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def toy(x_noisy, sigma, condition):
    """A denoiser that reads all it is given; `TOY` is the same for the page."""
    past = condition.history[:, -1:].mean(axis=2, keepdims=True)
    way = condition.path @ jnp.arange(1.0, 9.0)[:, None]
    style = (condition.style @ jnp.arange(1.0, 3.0))[:, None, None]
    return 0.3 * x_noisy / (1.0 + sigma) + 0.1 * past + 0.002 * way + 0.05 * style


TOY = """
const toy = (x, sigma, { history, path, style }) => x.map((value, i) => {
  const C = given.card.normaliser.mean.length, T = given.card.window, H = given.kept;
  const k = Math.floor(i / C), b = Math.floor(k / T);
  let past = 0, way = 0;
  for (let c = 0; c < C; c++) past += history[(b * H + H - 1) * C + c] / C;
  for (let c = 0; c < 8; c++) way += path[8 * k + c] * (c + 1);
  return 0.3 * value / (1 + sigma) + 0.1 * past + 0.002 * way + 0.05 * (style[2 * b] + 2 * style[2 * b + 1]);
});
"""


@pytest.fixture(scope="module")
def trained():
    return builders.tiny_trained(record={"dataset": "tiny", "dataset_licence": "CC0", "dataset_credit": "<nobody>"})


@pytest.mark.wants("node")
def test_kinematics_blending_and_rotations_are_alike(tmp_path, trained):
    skeleton = trained.skeleton
    history, window = builders.random_frames((5,), 1), builders.random_frames((8,), 2)
    near = orthonormalise(history[-1:] + 0.1 * np.random.default_rng(0).normal(size=(8, builders.CHANNELS)))
    rough = 1.3 * window + 0.1
    script = (
        "const history = frames(given.history);"
        "say([frames(given.window).map((f) => m.jointPositions(given.skeleton, f)),"
        " frames(given.rough).map(m.orthonormalise),"
        " m.blendSeam(history, frames(given.window), 4), m.blendSeam(history, frames(given.near), 6),"
        " m.blendSeam(history, frames(given.window), 0)])"
    )
    given = {"history": history, "window": window, "near": near, "rough": rough}
    found = in_node(tmp_path, script, skeleton=model_card(trained, 1)["skeleton"], **given)
    joints = 3 * skeleton.num_joints
    positions = np.reshape(np.array(found[0])[:, :joints], (8, -1, 3))
    np.testing.assert_allclose(positions, frame_positions(skeleton, window), atol=1e-6)
    np.testing.assert_allclose(found[1], orthonormalise(rough), atol=1e-6)
    for blended, frames, count in ((found[2], window, 4), (found[3], near, 6), (found[4], window, 0)):
        np.testing.assert_allclose(blended, blend_seams(frames, 8, count, history=history), atol=1e-6)
    assert np.abs(np.array(found[2]) - window).max() > 0.1


@pytest.mark.wants("node")
def test_rounds_under_way_are_alike_for_the_same_noise(tmp_path, trained):
    """Three rounds of two characters: condition, sampler, scales, blending, history and target, all together."""

    def sample_window(key, condition, noise):
        start = jnp.float32(SIGMAS[0]) * noise
        return sample("ddim", lambda x, sigma: toy(x, sigma, condition), start, SIGMAS)

    generator = SimpleNamespace(trained=trained, sample_window=sample_window)
    headings, places = [0.4, -2.0], [(1.0, 0.5), (-1.0, 3.0)]
    poses = [first_pose(trained, "calm", (0.0, 0.0), 0.0) for _ in places]
    starts = [first_pose(trained, "calm", place, yaw) for place, yaw in zip(places, headings, strict=True)]
    steering = Steering(generator, np.stack(starts), headings, hop=3, blend_frames=2)
    noise = np.random.default_rng(1).standard_normal((3, 2, builders.WINDOW, builders.CHANNELS)).astype(np.float32)
    speed, direction, style = [1.2, 0.0], [2.0, 0.0], np.array([[0.25, 0.75], [1.0, 0.0]])
    wanted = [steering.advance(speed, direction, style, one) for one in noise]
    script = (
        "const characters = given.poses.map((pose, k) =>"
        "  m.startCharacter(frames(pose), ...given.places[k], given.headings[k]));"
        "const made = []; for (const noise of given.noise)"
        "  made.push((await m.advance(given.card, characters, given.wishes, given.style, async (...a) => toy(...a),"
        "    noise, given.sigmas, 3, 2)).map(({ frames }) => frames));"
        "say([made, characters.map(({ target }) => [target.x, target.z, target.heading, target.speed])])"
    )
    given = {"poses": poses, "places": places, "headings": headings, "style": style, "noise": noise.reshape(3, -1)}
    given |= {"kept": builders.HISTORY, "sigmas": SIGMAS, "card": model_card(trained, 1) | {"window": builders.WINDOW}}
    given["wishes"] = [{"speed": s, "direction": d} for s, d in zip(speed, direction, strict=True)]
    found = in_node(tmp_path, TOY + script, **given)
    np.testing.assert_allclose(found[0], wanted, atol=1e-4)
    target = steering.target
    ends = np.column_stack([target.position, target.heading, target.speed])
    np.testing.assert_allclose(found[1], ends, atol=1e-6)
    assert np.abs(wanted[0][0] - wanted[0][1]).max() > 0.1


@pytest.mark.wants("node")
def test_feet_are_held_alike(tmp_path):
    """A walk that slides, with the switch turned off and on again on the way."""
    motion = synthesize("Neutral", 6)
    drift = np.arange(motion.num_frames)[:, None] * np.array([0.3 / motion.fps, -2e-4, 0.0])
    frames = world_frames(motion.replace(root_position=motion.root_position + drift))
    asked = [not 70 <= k < 90 for k in range(10, len(frames))]
    feet, wanted = start_feet(SYNTHETIC_SKELETON, frames[:10]), []
    for frame, locking in zip(frames[10:], asked, strict=True):
        feet, settled = lock_frame(SYNTHETIC_SKELETON, feet, frame, locking=locking)
        wanted.append(settled)
    script = (
        "const walk = frames(given.frames), s = given.skeleton, settled = [];"
        "let feet = m.startFeet(s, given.legs, walk.slice(0, 10));"
        "walk.slice(10).forEach((frame, k) => {"
        "  const one = m.lockFrame(s, given.legs, feet, frame, given.asked[k]);"
        "  feet = one.feet; settled.push(one.frame); });"
        "say([settled, feet.shown, feet.carries])"
    )
    skeleton = describe_skeleton(SYNTHETIC_SKELETON) | {"offsets": SYNTHETIC_SKELETON.offsets}
    given = {"legs": leg_chains(SYNTHETIC_SKELETON), "frames": frames, "asked": asked}
    found = in_node(tmp_path, script, skeleton=skeleton, **given)
    np.testing.assert_allclose(found[0], wanted, atol=1e-4)
    np.testing.assert_allclose(found[1], feet.shown, atol=1e-6)
    assert found[2] == feet.carries.tolist()
    assert np.abs(np.array(wanted) - frames[10:]).max() > 0.05  # something was held


@pytest.mark.wants("node")
def test_the_page_draws_standard_normal_numbers(tmp_path):
    drawn = in_node(tmp_path, "const draw = m.normalNumbers(5); say([draw(20000), m.normalNumbers(6)(5)])")
    numbers = np.array(drawn[0])
    assert abs(numbers.mean()) < 0.03 and abs(numbers.std() - 1) < 0.02 and abs((numbers**4).mean() - 3) < 0.3
    assert abs(np.corrcoef(numbers[1:], numbers[:-1])[0, 1]) < 0.03
    assert drawn[1] != drawn[0][:5]


# ---------------------------------------------------------------------------- the oracle itself is a rollout


@pytest.fixture(scope="module")
def generator(trained):
    return MotionGenerator(trained, 2)


def start(generator, batch=2, **settings):
    poses = [first_pose(generator.trained, "calm", (k, 0.5), 0.3) for k in range(batch)]
    return Steering(generator, np.stack(poses), np.full(batch, 0.3), **settings)


def test_whole_windows_without_blending_are_a_rollout(generator):
    """The same frame, normaliser, path and style reach the network as in `MotionGenerator.generate`."""
    window = generator.trained.config.window
    steering = start(generator, hop=window, blend_frames=0)
    speed, direction = np.full(2, 1.1), np.full(2, 0.3)
    steering.target = steering.target._replace(speed=speed)  # at full speed and straight from the first frame on
    history, (_, positions, headings) = steering.history, move_target(steering.target, speed, direction, window)
    key = jax.random.key(3)
    config = generator.trained.config
    noise = jax.random.normal(jax.random.split(jax.random.fold_in(key, 0))[0], (2, window, config.channels))
    made = steering.advance(speed, direction, np.eye(2), noise)
    wanted = generator.generate(positions, headings, np.array([0, 1]), history, key)
    np.testing.assert_allclose(made, wanted, atol=2e-5)
    other = start(generator, hop=window, blend_frames=0).advance(speed, direction, np.eye(2)[::-1], noise)
    assert np.abs(other - wanted).max() > 1e-3  # another style would be seen


# --------------------------------------------------------------------------------------------------- the page as text


@pytest.fixture
def packages(monkeypatch):
    monkeypatch.setattr(steer, "package_file", lambda package, path: BUNDLE if "onnx" in package else b"// three")


def carried(page: str, name: str):
    return json.loads(re.search(rf'id="{name}">(.*?)</script>', page, re.S)[1])


def unpacked(page: str, kind: str) -> dict[str, bytes]:
    return {name: zlib.decompress(base64.b64decode(text)) for name, text in carried(page, "packed")[kind].items()}


def test_the_page_carries_everything_and_asks_for_nothing(trained, packages, tmp_path):
    path = write_steer(tmp_path / "steer.html", trained, program=b"weights")
    page = path.read_text(encoding="utf-8")
    files, modules = unpacked(page, "files"), unpacked(page, "modules")
    assert files["program"] == b"weights" and b"export function lockFrame" in modules["motion"]
    poses = np.frombuffer(files["poses"], np.float32).reshape(2, builders.HISTORY, builders.CHANNELS)
    np.testing.assert_allclose(poses[:, -1, [0, 2]], 0.0, atol=1e-6)
    data = carried(page, "steer-data")
    assert data["card"]["legs"] is None and 'id="feet" disabled' in page  # legs of these are no legs
    assert data["card"]["styles"] == ["calm", "proud"] and data["card"]["window"] == builders.WINDOW
    assert set(files) == {"worker", "wasm", "program", "poses"}
    assert set(modules) == {"body", "core", "three", "motion", "network", "steer"}
    head = page.split('<script type="application/json" id="steer-data">')[0]
    assert "http" not in head.replace("http-equiv", "") and "default-src 'none'" in head
    assert "&lt;nobody&gt;" in head and "CC0" in head and "inertialised" in head
    refused("exists already", write_steer, path, trained, program=b"", overwrite=False)
    refused("written as .html", write_steer, tmp_path / "steer.txt", trained)


def test_the_page_for_a_graphics_card_carries_the_runtime_for_both(trained, monkeypatch):
    monkeypatch.setattr(steer, "package_file", lambda package, path: BUNDLE + path.encode())
    for runtime, words in (("wasm", ("ort.wasm.", "threaded.wasm")), ("webgpu", ("ort.webgpu.", "asyncify.wasm"))):
        page = steer_page(trained, program=b"", runtime=runtime)
        found = unpacked(page, "files")["wasm"].decode()
        assert words[1] in found and carried(page, "steer-data")["card"]["webgpu"] is (runtime == "webgpu")
        assert steer.RUNTIMES[runtime][0].startswith(f"dist/{words[0]}")
    refused("unknown runtime 'webgl'", steer_page, trained, program=b"", runtime="webgl")


def test_a_package_that_is_not_as_pinned_is_refused_with_its_place(monkeypatch, tmp_path):
    monkeypatch.setattr(steer.pooch, "os_cache", lambda name: tmp_path)
    (tmp_path / "three-0.187.0.tgz").write_bytes(b"something else")

    def offline(*_, **__):
        raise OSError("no network")

    monkeypatch.setattr(steer.pooch.core, "stream_download", offline)
    refused("save this file as .*three-0.187.0.tgz", package_file, "three", "build/three.module.js")
