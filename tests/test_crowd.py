"""Crowds in chunks: who is in them, what is on disk, what happens when a run is stopped."""

import functools
import json
import os
from types import SimpleNamespace

import jax
import numpy as np
import pytest
from builders import CHANNELS, HISTORY, SKELETON, WINDOW, refused, tiny_trained
from test_rollout import obedient

from f3amd_companion.serving import crowd as crowds
from f3amd_companion.serving.crowd import PATHS, crowd_paths, generate_crowd, read_crowd
from f3amd_lib.data.features import frame_yaw, motion_from_frames, turn_frames
from f3amd_lib.ground.trees import weights_digest
from f3amd_lib.motion.root_paths import named_path
from f3amd_lib.motion.rotations import wrap_angle
from f3amd_lib.rollout.rollout import MotionGenerator

FRAMES = WINDOW + 3
FILES = ("crowd.json", "crowd.npy")


@pytest.fixture(scope="module")
def trained():
    return tiny_trained({"dataset": "tiny", "dataset_licence": "none", "dataset_credit": "nobody"})


@pytest.fixture(scope="module")
def generator(trained):
    return MotionGenerator(trained, num_steps=2)


@pytest.fixture(scope="module")
def eleven(generator, tmp_path_factory):
    """A crowd of eleven in chunks of four: two whole ones and one that is cut."""
    return generate_crowd(generator, 11, FRAMES, tmp_path_factory.mktemp("crowd"), chunk=4)


@pytest.fixture
def still(trained):
    """A generator that takes no time: everybody stands where their history ends."""

    def generate(position, yaw, style_index, history, key):
        return np.repeat(history[:, -1:], yaw.shape[1], axis=1)

    return SimpleNamespace(
        trained=trained, dtype=np.dtype("float32"), sampler="ddim", sigmas=np.array([1.0, 0.0]), generate=generate
    )


def follower(trained):
    """A generator that goes exactly where the path says, from whatever noise."""
    generator = obedient(trained)
    go = generator.sample_window
    generator.sample_window = lambda key, condition, noise=None: go(key, condition)
    return generator


def content(folder):
    return {name: (folder / name).read_bytes() for name in FILES}


def close(first, second):
    """Whether two crowds hold the same characters, to the rounding of their arithmetic."""
    for name in ("root", "rotations", "path", "style"):
        one, two = (np.asarray(crowd.rows[name]) for crowd in (first, second))
        # A step of float16 below 1 is at most 5e-4; the rest is float32 arithmetic.
        atol = {"root": 1e-4, "rotations": 2e-3}.get(name, 0.0)
        np.testing.assert_allclose(one.astype(float), two.astype(float), rtol=0, atol=atol)


# --- who a character is ------------------------------------------------------------------------


@pytest.mark.slow
def test_characters_do_not_depend_on_the_chunk(generator, eleven, tmp_path):
    close(generate_crowd(generator, 11, FRAMES, tmp_path, chunk=7), eleven)


@pytest.mark.parametrize("sampler", ["ddim", "ddpm"])
def test_each_character_is_the_one_generated_alone_with_its_key(trained, generator, tmp_path, monkeypatch, sampler):
    # One character with one key goes through the plain batched code, of which others have tests.
    # DDIM draws where a round starts, DDPM fresh noise at every step.
    if sampler != generator.sampler:
        generator = MotionGenerator(trained, num_steps=2, sampler=sampler)
    asked, generate = [], generator.generate
    monkeypatch.setattr(generator, "generate", lambda *given: asked.append(given) or generate(*given))
    crowd = generate_crowd(generator, 5, FRAMES, tmp_path, chunk=4, seed=5)
    for character in (0, 3, 4):
        *arrays, _ = asked[character // 4]
        place = slice(character % 4, character % 4 + 1)
        alone = generate(*(array[place] for array in arrays), jax.random.fold_in(jax.random.key(5), character))[0]
        np.testing.assert_allclose(crowd.rows["root"][character], alone[:, :3], atol=1e-4)
        sixes = np.asarray(crowd.rows["rotations"][character], float).reshape(FRAMES, -1)
        np.testing.assert_allclose(sixes, alone[:, 3:], atol=2e-3)


def tiny_trained_with(poses):
    trained = tiny_trained()
    trained.start_poses.clear()
    trained.start_poses.update(poses)
    return trained


def test_styles_go_in_turn(still, tmp_path):
    def styles(name, **how):
        crowd = generate_crowd(still, 5, 2, tmp_path / name, chunk=2, **how)
        return [crowd.style(character) for character in range(5)]

    assert styles("default") == ["calm", "proud", "calm", "proud", "calm"]
    assert styles("one", styles=["proud"]) == ["proud"] * 5
    assert styles("three", styles=["proud", "proud", "calm"]) == ["proud", "proud", "calm", "proud", "proud"]
    still.trained = tiny_trained_with({"proud": still.trained.start_poses["proud"]})
    assert styles("with poses") == ["proud"] * 5


def test_characters_start_in_a_fitting_pose_on_their_path(still, tmp_path):
    # Of each pose there is a second one that moves three times as fast.
    fast = np.where(np.isin(np.arange(CHANNELS), [0, 2]), 3.0, 1.0)
    starts = still.trained.start_poses
    both = {style: np.concatenate([poses, poses * fast]).astype(np.float32) for style, poses in starts.items()}
    still.trained = tiny_trained_with(both)
    histories, generate = [], still.generate
    still.generate = lambda *given: histories.append(given) or generate(*given)
    generate_crowd(still, 60, 5, tmp_path, chunk=20)
    used = {style: set() for style in still.trained.styles}
    for position, yaw, style_index, history, _ in histories:
        for k in range(20):
            start = 2 * position[k, 0] - position[k, 1]
            np.testing.assert_allclose(history[k, -1, [0, 2]], start, atol=1e-5)
            facing = frame_yaw(SKELETON, history[k, -1].astype(float))
            np.testing.assert_allclose(wrap_angle(facing - yaw[k, 0]), 0.0, atol=1e-5)
            (back := history[k].astype(float))[:, [0, 2]] -= start
            back = turn_frames(back, -yaw[k, 0])
            style = still.trained.styles[style_index[k]]
            poses = still.trained.start_poses[style]
            gap = np.abs(poses - back).max(axis=(1, 2))
            assert gap.min() < 1e-4
            speeds = np.linalg.norm(np.diff(poses[:, [0, -1]][..., [0, 2]], axis=1), axis=-1)[:, 0]
            off = np.abs(speeds / (HISTORY - 1) - np.linalg.norm(position[k, 1] - position[k, 0]))
            assert off[gap.argmin()] <= off.min() + 0.1 / 30 + 1e-9
            used[style].add(int(gap.argmin()))
    assert used == {style: set(range(len(still.trained.start_poses[style]))) for style in used}


# --- paths -------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", PATHS)
def test_paths_are_walked_at_the_pace_with_the_turns_of_a_walk(name, monkeypatch):
    pace = np.array([0.5, 1.2, 4.0])
    monkeypatch.setattr(crowds, "PATHS", (name,))
    position, yaw = crowd_paths(range(7, 10), pace, 300, 0)
    step = np.diff(position, axis=1)
    ratio = np.linalg.norm(step, axis=-1) * 30 / pace[:, None]
    np.testing.assert_allclose(ratio, 1.0, rtol=2e-3)
    heading = np.arctan2(step[..., 0], step[..., 1])
    middle = 0.5 * (yaw[:, 1:] + yaw[:, :-1])
    assert np.abs(wrap_angle(heading - middle)).max() < np.deg2rad(0.5)
    fastest = np.abs(np.diff(named_path(name, 2100).yaw)).max()
    assert np.abs(np.diff(yaw, axis=1)).max() <= fastest + 1e-9


# --- memory ------------------------------------------------------------------------------------


def test_all_chunks_run_in_one_compilation(trained, tmp_path):
    generator = follower(trained)
    traced, rounds = [], generator._rounds
    generator._run = jax.jit(lambda *given: traced.append(given[0].shape) or rounds(*given))
    generate_crowd(generator, 11, FRAMES, tmp_path, chunk=4)
    assert traced == [(4, HISTORY, CHANNELS)]


# --- files -------------------------------------------------------------------------------------


def test_plain_numpy_and_json_are_enough_to_read_a_crowd(generator, tmp_path):
    crowd = generate_crowd(generator, 5, FRAMES, tmp_path / "new" / "crowd", chunk=4, seed=3)
    folder = tmp_path / "new" / "crowd"
    assert sorted(item.name for item in folder.iterdir()) == sorted(FILES)
    rows = np.load(folder / "crowd.npy")
    root, rotations, path, styles = (rows[name] for name in rows.dtype.names)
    said = json.loads((folder / "crowd.json").read_text(encoding="utf-8"))
    assert (said["num_finished"], said["fps"], said["seed"], said["styles"]) == (5, 30.0, 3, ["calm", "proud"])
    assert said["model"]["weights"] == weights_digest(generator.trained.params)
    assert len(crowd) == 5 and crowd.num_frames == FRAMES and crowd.skeleton == SKELETON
    motion = crowd.motion(3)
    assert motion.name == crowd.style(3) == said["styles"][styles[3]]
    expected = motion_from_frames(SKELETON, np.concatenate([root[3], rotations[3].reshape(FRAMES, -1)], axis=-1))
    np.testing.assert_array_equal(motion.root_position, expected.root_position)
    np.testing.assert_array_equal(motion.rotations, expected.rotations)
    np.testing.assert_array_equal(crowd.target(3).position, path[3, :, :2])


@pytest.mark.parametrize("writes", [0, 1, 2])
def test_a_stopped_run_goes_on_and_ends_with_the_same_bytes(generator, eleven, tmp_path, monkeypatch, writes):
    opened, left = crowds._open_rows, [writes]

    def stop(out, settings, mode="r"):
        rows = opened(out, settings, mode)
        left[0] -= mode == "r+"
        if left[0] < 0:  # half of a chunk is there already
            rows["root"][4 * writes : 4 * writes + 2] = 7.0
            rows.flush()
            raise KeyboardInterrupt
        return rows

    call = functools.partial(generate_crowd, generator, 11, FRAMES, tmp_path, chunk=4)
    with monkeypatch.context() as patched:
        patched.setattr(crowds, "_open_rows", stop)
        with pytest.raises(KeyboardInterrupt):
            call()
    refused(f"only {writes * 4} of 11 characters", read_crowd, tmp_path)
    made, make = [], crowds.crowd_paths
    monkeypatch.setattr(crowds, "crowd_paths", lambda *given, **how: made.append(given[0]) or make(*given, **how))
    resumed = call()
    assert [part.start for part in made] == list(range(writes * 4, 11, 4))  # what was finished is not made again
    close(resumed, eleven)
    folder = tmp_path.with_name(tmp_path.name + "-whole")
    generate_crowd(generator, 11, FRAMES, folder, chunk=4)
    assert content(tmp_path) == content(folder)


def test_a_finished_crowd_is_replaced_only_if_asked(still, tmp_path):
    call = lambda count, **how: generate_crowd(still, count, 5, tmp_path / "here", chunk=4, **how)
    call(9)
    before = content(tmp_path / "here")
    refused("made with another num_characters", call, 6)
    assert len(call(9)) == 9 and content(tmp_path / "here") == before
    call(6, overwrite=True)
    generate_crowd(still, 6, 5, tmp_path / "fresh", chunk=4)
    assert content(tmp_path / "here") == content(tmp_path / "fresh")


@pytest.mark.parametrize("changed", [{"seed": 1}, {"num_frames": 6}, {"chunk": 3}, {"styles_in_turn": ["calm"]}])
def test_a_stopped_run_does_not_go_on_with_other_settings(still, tmp_path, changed):
    settings = {"num_characters": 6, "num_frames": 5, "out": tmp_path, "chunk": 2}
    with pytest.raises(KeyboardInterrupt):
        generate_crowd(stop_after(still, 1), **settings)
    before, (named,) = content(tmp_path), changed
    changed = {named.removesuffix("_in_turn"): changed[named]}
    refused(f"{tmp_path}: holds a crowd made with another {named}", generate_crowd, still, **settings | changed)
    assert content(tmp_path) == before


def stop_after(still, chunks):
    """The same generator, which is stopped after some chunks."""
    left, generate = [chunks], still.generate

    def limited(*given):
        left[0] -= 1
        if left[0] < 0:
            raise KeyboardInterrupt
        return generate(*given)

    return SimpleNamespace(**vars(still) | {"generate": limited})


def test_folders_with_other_things_are_left_alone(still, tmp_path):
    (tmp_path / "thesis.txt").write_text("years of work")
    for why in ("holds other files", "crowd.json: not written by this"):
        for overwrite in (False, True):
            refused(why, generate_crowd, still, 2, 5, tmp_path, overwrite=overwrite)
        (tmp_path / "crowd.json").write_text('{"format": "ours", "num_finished": 0}')
    refused("thesis.txt: holds other files", generate_crowd, still, 2, 5, tmp_path / "thesis.txt")
    assert sorted(item.name for item in tmp_path.iterdir()) == ["crowd.json", "thesis.txt"]
    assert (tmp_path / "thesis.txt").read_text() == "years of work"


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda folder: (folder / "crowd.json").unlink(), "holds no crowd"),
        (lambda folder: edit(folder, drop="offsets"), "crowd.json: description lacks or garbles 'offsets'"),
        (lambda folder: edit(folder, num_frames=6), "crowd.npy: is not a whole array .*not what crowd.json says"),
        (lambda at: os.truncate(one := at / "crowd.npy", one.stat().st_size - 1), "crowd.npy: is not a whole array"),
    ],
)
def test_damaged_and_foreign_crowds_are_refused(still, tmp_path, damage, message):
    generate_crowd(still, 3, 5, tmp_path)
    assert len(read_crowd(tmp_path)) == 3
    damage(tmp_path)
    refused(message, read_crowd, tmp_path)


def edit(folder, drop=None, **changes):
    settings = json.loads((folder / "crowd.json").read_text()) | changes
    settings.pop(drop, None)
    (folder / "crowd.json").write_text(json.dumps(settings))


def test_all_room_is_taken_when_a_crowd_begins(still, tmp_path):
    # A disk that fills up halfway would kill a process that writes to mapped files.
    with pytest.raises(KeyboardInterrupt):
        generate_crowd(stop_after(still, 0), 400, 5, tmp_path, chunk=2)
    begun = (tmp_path / "crowd.npy").stat()
    assert 512 * begun.st_blocks >= begun.st_size
    generate_crowd(still, 400, 5, tmp_path, chunk=2)
    assert (tmp_path / "crowd.npy").stat().st_size == begun.st_size
    with pytest.raises(OSError, match="big/crowd.npy: takes .* GB, and .* GB are free"):
        generate_crowd(still, 10**11, 5, tmp_path / "big")
    assert not (tmp_path / "big").exists()


def test_numbers_that_are_not_finite_stop_the_run_and_name_the_character(still, tmp_path):
    generate = still.generate

    def breaks_down(*given):
        frames = generate(*given)
        broken.append(None)
        if len(broken) == 2:
            frames[1, 3, 7] = np.nan
        return frames

    broken = []
    still.generate = breaks_down
    with pytest.raises(ArithmeticError, match="not finite for character 4"):
        generate_crowd(still, 7, 5, tmp_path, chunk=3)
    assert json.loads((tmp_path / "crowd.json").read_text())["num_finished"] == 3


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"num_characters": 0}, "a crowd has whole numbers of characters .* got 0, 5 and"),
        ({"seed": -1}, "seed .* got -1"),
        ({"styles": ["prowd"]}, "unknown style 'prowd'.*calm, proud"),
        ({"styles": []}, "at least one style"),
    ],
)
def test_bad_input_is_refused(still, tmp_path, changed, message):
    call = {"num_characters": 3, "num_frames": 5, "out": tmp_path / "crowd"}
    refused(message, generate_crowd, still, **call | changed)
