"""Motion of one humanoid on another's bones: directions theirs, lengths ours; and rollouts that begin with it."""

import dataclasses

import numpy as np
import pytest
from builders import CHANNELS, HISTORY, refused, tiny_trained, wandering_motion
from strangers import cmu_skeleton
from test_skeleton import BANDAI

from f3amd_companion.serving.motion_files import start_history
from f3amd_companion.terminal import find_model
from f3amd_lib.data.features import frame_positions, frame_yaw, motion_from_frames
from f3amd_lib.motion.anatomy import joint_roles
from f3amd_lib.motion.plausible import as_person
from f3amd_lib.motion.retarget import DOUBTFUL, retarget
from f3amd_lib.motion.root_paths import named_path
from f3amd_lib.motion.skeleton import Motion, resample
from f3amd_lib.motion.synthetic import synthesize
from f3amd_lib.training.checkpoints import load_model


@pytest.fixture(scope="module")
def bandai() -> Motion:
    """A stored pose of real motion on Bandai's rig, whose frames are turned as no other's are."""
    trained = load_model(find_model("bandai"))
    pose = next(iter(trained.start_poses.values()))[0]
    return motion_from_frames(trained.skeleton, pose, name="bandai")


@pytest.fixture(scope="module")
def walk() -> Motion:
    return synthesize("Neutral", 2.0)


def longer(motion: Motion, share: float) -> Motion:
    """The same motion of a larger person."""
    skeleton = dataclasses.replace(motion.skeleton, offsets=share * motion.skeleton.offsets)
    return motion.replace(skeleton=skeleton, root_position=share * motion.root_position)


def test_a_walk_on_another_rig_keeps_its_directions_and_the_rigs_bones(walk, bandai):
    made, scale, error = retarget(walk, bandai)
    ours, theirs = joint_roles(bandai.skeleton), joint_roles(walk.skeleton)
    assert made.skeleton is bandai.skeleton
    for side in ("left", "right"):
        for upper, lower in (("hip", "knee"), ("knee", "ankle"), ("shoulder", "elbow"), ("elbow", "wrist")):
            bones = []
            for motion, roles in ((made, ours), (walk, theirs)):
                one, other = roles[f"{side}_{upper}"], roles[f"{side}_{lower}"]
                bones.append(motion.positions[:, other] - motion.positions[:, one])
            lengths = [np.linalg.norm(bone, axis=-1) for bone in bones]
            cosine = (bones[0] * bones[1]).sum(axis=-1) / (lengths[0] * lengths[1])
            assert cosine.min() > 1 - 1e-6, (side, upper)
            own = np.linalg.norm(bandai.skeleton.offsets[ours[f"{side}_{lower}"]])
            np.testing.assert_allclose(lengths[0], own, rtol=1e-6)
    assert error.mean() < 8.0  # of shoulders, hips and head, which are where our bones put them
    np.testing.assert_allclose(np.linalg.det(made.rotations), 1.0, atol=1e-6)
    apart = np.angle(np.exp(1j * (made.yaw - walk.yaw)))
    assert np.abs(apart).max() < np.deg2rad(10)
    toes = list(bandai.skeleton.toes)
    assert made.positions[:, toes, 1].min() == pytest.approx(bandai.positions[:, toes, 1].min())


def test_the_same_person_in_another_size_comes_back_to_the_millimetre(walk):
    made, scale, error = retarget(longer(walk, 1.25), walk)
    assert scale == pytest.approx(0.8)
    assert error.max() < 0.1  # cm
    shift = made.positions - walk.positions
    assert np.abs(shift - shift[:1, :1]).max() < 1e-3  # the path, too


def test_an_error_is_seen_where_there_is_one_and_a_large_one_refused(walk, caplog):
    bent = dataclasses.replace(walk.skeleton, offsets=walk.skeleton.offsets * np.array([2.5, 1, 1]))
    reference = walk.replace(skeleton=bent)
    with caplog.at_level("WARNING"):
        assert retarget(walk, reference)[2].mean() > DOUBTFUL
    assert "24 cm off" in caplog.text
    wide = dataclasses.replace(bent, offsets=bent.offsets * np.array([2, 1, 1]))
    refused("'Neutral_0': joints would be .* cm off", retarget, walk, walk.replace(skeleton=wide))


def test_collar_bones_without_length_leave_shoulders_as_wide_as_they_are_and_the_back_upright(walk, bandai):
    """CMU's person, whose collar bones and hip joints have no length: put on, and taken off again."""
    still = Motion(cmu_skeleton(), [[0.0, 0.17, 0.0]], np.tile(np.eye(3), (1, 31, 1, 1)))
    cmu = retarget(walk, as_person(still)[0])[0]
    for reference in (bandai, walk):
        made = retarget(cmu, reference)[0]
        width, tall = zip(*map(shoulders_and_height, (made, reference)), strict=True)
        assert width[0] == pytest.approx(width[1], rel=0.1)
        assert tall[0] == pytest.approx(tall[1], abs=0.1)
    assert shoulders_and_height(cmu)[1] > 1.2


def shoulders_and_height(motion: Motion) -> tuple[float, float]:
    """How far shoulders are apart, and how high the head is over the lower toe, on average, metres."""
    roles, at = motion.skeleton.roles, motion.positions
    width = np.linalg.norm(at[:, roles["left_shoulder"]] - at[:, roles["right_shoulder"]], axis=-1).mean()
    return width, (at[:, roles["head"], 1] - at[:, list(motion.skeleton.toes), 1].min(axis=-1)).mean()


def test_a_rig_that_says_nothing_of_up_at_rest_is_put_upright_by_its_motion(bandai):
    """All bones of Bandai's lie along X at rest."""
    tip = np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])
    turns = bandai.rotations.copy()
    turns[:, 0] = tip @ turns[:, 0]
    made, notes = as_person(bandai.replace(root_position=bandai.root_position @ tip.T, rotations=turns))
    assert notes == ["read with Z up"]
    np.testing.assert_allclose(made.positions, bandai.positions, atol=1e-6)
    assert as_person(bandai)[0] is bandai


def test_who_lacks_joints_is_told_which(walk):
    refused("no joint has the role neck, head.*left_knee", retarget, wandering_motion(5), walk)
    refused("'wandering 0': no joint has the role", retarget, walk, wandering_motion(5))
    assert BANDAI.num_joints == len(joint_roles(BANDAI))


def test_a_rollout_begins_where_a_file_of_the_models_skeleton_ends():
    trained = tiny_trained()
    motion = wandering_motion(40, 5)
    path = named_path("circle", 16)
    history, note = start_history(trained, motion, path)
    assert history.shape == (1, HISTORY, CHANNELS) and "own skeleton" in note
    last = motion.positions[-HISTORY:]
    seen = frame_positions(trained.skeleton, history[0])
    inner = lambda one: np.linalg.norm(one[:, :, None] - one[:, None], axis=-1)  # shape of a pose, wherever it stands
    np.testing.assert_allclose(inner(seen), inner(last), atol=1e-4)
    assert frame_yaw(trained.skeleton, history[0])[-1] == pytest.approx(path.yaw[0], abs=1e-4)
    np.testing.assert_allclose(history[0, -1, [0, 2]], 2 * path.position[0] - path.position[1], atol=1e-5)
    faster = resample(motion, 60.0)
    again, _ = start_history(trained, faster, path)
    assert np.abs(frame_positions(trained.skeleton, again[0]) - seen).max() < 0.1
    refused("2 frames at 30 fps; a start needs 4", start_history, trained, motion.slice(0, 2), path)


def test_a_file_of_another_skeleton_is_retargeted_and_the_user_told(walk):
    trained = load_model(find_model("bandai"))
    history, note = start_history(trained, walk, named_path("straight", 30))
    assert history.shape == (1, trained.config.num_history, 3 + 6 * 21)
    assert "another skeleton (23 joints, the model's has 21)" in note and "cm on average" in note
    assert np.isfinite(history).all()
    assert 0.7 < history[0, :, 1].mean() < 1.1  # hips as high as people's
