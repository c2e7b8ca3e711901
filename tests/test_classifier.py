"""The style classifier: what it sees, its network against numpy, training, files, refusals."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from builders import packed_from, refused, same_tree
from test_skeleton import BANDAI

from f3amd_lib.ground.profiles import load_profile
from f3amd_lib.measures import classifier as module
from f3amd_lib.motion.rotations import matrix_from_yaw
from f3amd_lib.motion.skeleton import Motion, Skeleton, mirror
from f3amd_lib.motion.synthetic import SYNTHETIC_SKELETON, synthesize

STYLES = ("ArmsOverhead", "Runner", "Zombie")
WINDOW = 20
SIZES = {"window": WINDOW, "widths": (8, 12), "hidden_width": 24, "feature_width": 16}
CONFIG = module.ClassifierConfig(num_styles=3, **SIZES)
TRAINING = {"num_steps": 80, "batch_size": 32, "progress": False, **SIZES}
BRIEF = {**TRAINING, "num_steps": 3}


def three_styles(seconds=(4.0, 4.0, 3.0, 3.0), splits=(0, 0, 1, 2)):
    """Four takes of each of three styles that nobody would mix up."""
    return packed_from(
        [
            (synthesize(style, length, seed), number, split)
            for number, style in enumerate(STYLES)
            for seed, (length, split) in enumerate(zip(seconds, splits, strict=True))
        ],
        styles=STYLES,
        mirror_styles=STYLES,
    )


@pytest.fixture(scope="module")
def packed():
    return three_styles()


@pytest.fixture(scope="module")
def trained(packed):
    return module.train_classifier(packed, **TRAINING)


@pytest.fixture(scope="module")
def saved(trained, tmp_path_factory):
    path = tmp_path_factory.mktemp("classifier") / "classifier.safetensors"
    module.save_classifier(path, trained)
    return path


def walk(seed=7, style="Zombie", seconds=3.0) -> Motion:
    return synthesize(style, seconds, seed)


# ---------------------------------------------------------------------------- what it looks at


def test_fifteen_joints_are_seen_of_whichever_rig_and_all_are_needed():
    assert len(module.CLASSIFIER_JOINTS) == 15 and module.NUM_CHANNELS == 45
    assert not [joint for joint in module.CLASSIFIER_JOINTS if "wrist" in joint or "toe" in joint]
    shown = [module.classifier_frames(rig.rest_positions[None], rig) for rig in (BANDAI, SYNTHETIC_SKELETON)]
    assert [frames.shape for frames in shown] == [(1, module.NUM_CHANNELS)] * 2
    less = Skeleton(["toy"] + [f"bone {n}" for n in range(20)], BANDAI.parents, np.zeros((21, 3)))
    refused("no joint has the role", module.classifier_frames, np.zeros((1, 21, 3)), less)


def figure(hips_yaw=0.0, collar_yaw=0.0) -> np.ndarray:
    """One frame of Bandai's joints: left side at +x, all else on the axis, [1, 21, 3]."""
    frame = np.zeros((1, BANDAI.num_joints, 3))
    for side, sign in (("L", 1.0), ("R", -1.0)):
        hip, collar = np.array([0.1, 0, 0]) * sign, np.array([0.05, 0.4, 0]) * [sign, 1, 1]
        frame[0, BANDAI.index(f"UpperLeg_{side}")] = matrix_from_yaw(hips_yaw) @ hip
        frame[0, BANDAI.index(f"Shoulder_{side}")] = matrix_from_yaw(collar_yaw) @ collar
    frame[0, BANDAI.index("Head")] = [0.0, 0.6, 0.2]
    return frame + [3.0, 0.9, -5.0]


def seen(frame: np.ndarray) -> dict:
    """What the classifier sees of one frame, [x, y, z] by joint."""
    numbers = module.classifier_frames(frame, BANDAI).reshape(-1, 3)
    return dict(zip(module.CLASSIFIER_JOINTS, numbers, strict=True))


def test_a_frame_is_moved_to_its_hips_and_turned_to_face_z():
    at = seen(figure())
    np.testing.assert_allclose(at["hips"], [0, 0, 0], atol=1e-12)
    np.testing.assert_allclose(at["head"], [0, 0.6, 0.2], atol=1e-12)
    np.testing.assert_allclose(at["left_hip"], [0.1, 0, 0], atol=1e-12)
    np.testing.assert_allclose(at["right_collar"], [-0.05, 0.4, 0], atol=1e-12)


def test_place_and_direction_of_each_frame_are_not_seen():
    motion = walk()
    rng = np.random.default_rng(0)
    turn = matrix_from_yaw(rng.uniform(-3, 3, motion.num_frames))
    moved = motion.positions @ np.swapaxes(turn, -1, -2) + rng.normal(size=(motion.num_frames, 1, 3))
    expected = module.classifier_frames(motion.positions, SYNTHETIC_SKELETON)
    np.testing.assert_allclose(module.classifier_frames(moved, SYNTHETIC_SKELETON), expected, atol=1e-12)
    assert expected.std(axis=0).max() > 0.02  # something is seen
    np.testing.assert_array_equal(expected[:, :3], 0.0)


def test_mirrored_channels_show_the_mirrored_motion():
    motion = walk(style="LimpLeft")
    channel, sign = module.mirror_channels()
    shown = sign * module.classifier_frames(motion.positions, SYNTHETIC_SKELETON)[:, channel]
    mirrored = module.classifier_frames(mirror(motion).positions, SYNTHETIC_SKELETON)
    np.testing.assert_allclose(shown, mirrored, atol=1e-6)
    assert np.abs(shown - module.classifier_frames(motion.positions, SYNTHETIC_SKELETON)).max() > 0.05


def test_motion_that_is_shorter_than_a_window_or_not_finite_gives_none():
    positions = np.array(walk(seconds=59 / 30).positions)
    frames = module.classifier_frames(positions, SYNTHETIC_SKELETON)
    assert module.side_by_side(frames, 60).shape == (0, 60, module.NUM_CHANNELS)
    positions[40, 3, 1] = np.nan
    refused("not finite at frame 40, joint 3$", module.classifier_frames, positions, SYNTHETIC_SKELETON)
    refused(r"positions must be \[\.\.\., 23, 3\]", module.classifier_frames, np.zeros((60, 24, 3)), SYNTHETIC_SKELETON)


# ------------------------------------------------------------------------------------- network


def test_default_network_has_the_published_number_of_weights():
    _, params, statistics = module._blank(module.ClassifierConfig(num_styles=100))
    assert sum(leaf.size for leaf in jax.tree.leaves(params)) == 8_489_572
    assert sum(leaf.size for leaf in jax.tree.leaves(statistics)) == 2 * (64 + 128 + 1024 + 512)


def numpy_forward(network: module.StyleNetwork, windows: np.ndarray):
    """The network written out in loops over frames, float64."""

    def number(param):
        return np.asarray(param[...], np.float64)

    def leaky(z):
        return np.where(z > 0, z, 0.01 * z)

    def normalise(norm, z):
        scale = number(norm.scale) / np.sqrt(number(norm.var) + 1e-5)
        return scale * (z - number(norm.mean)) + number(norm.bias)

    def linear(layer, z):
        return z @ number(layer.kernel) + number(layer.bias)

    z = windows.astype(np.float64)
    for block in network.blocks:
        kernel = number(block.convolution.kernel)
        padded = np.pad(z, ((0, 0), (1, 1), (0, 0)))
        convolved = np.stack(
            [sum(padded[:, frame + tap] @ kernel[tap] for tap in range(3)) for frame in range(z.shape[1])], axis=1
        ) + number(block.convolution.bias)
        z = leaky(normalise(block.norm, convolved)) + linear(block.shortcut, z)
    z = leaky(normalise(network.hidden_norm, linear(network.hidden, z.reshape(len(z), -1))))
    features = leaky(normalise(network.feature_norm, linear(network.feature, z)))
    return features, linear(network.classes, features)


def test_network_equals_its_layers_written_out(trained):
    """With batch statistics far from what they are at first, and features of both signs."""
    rng = np.random.default_rng(0)
    drawn = lambda leaf: jnp.asarray(rng.uniform(0.05, 0.5, leaf.shape), jnp.float32)
    statistics = jax.tree.map(drawn, trained.statistics)
    windows = rng.normal(size=(4, WINDOW, module.NUM_CHANNELS)).astype(np.float32)
    features, scores = module._answers(CONFIG, trained.params, statistics, windows)
    network = module._network(CONFIG, trained.params, statistics)
    expected_features, expected_scores = numpy_forward(network, windows)
    assert features.shape == (4, 16) and scores.shape == (4, 3)
    np.testing.assert_allclose(features, expected_features, rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(scores, expected_scores, rtol=1e-4, atol=1e-4)
    assert (expected_features < 0).any() and (expected_features > 0.1).any()


# ------------------------------------------------------------------------------------ training


def test_a_short_training_tells_three_styles_apart_on_unseen_clips(trained):
    assert trained.styles == STYLES
    assert trained.held_out_accuracy.keys() == set(STYLES)
    assert trained.accuracy > 0.9
    for number, style in enumerate(STYLES):
        windows = trained.windows_of(walk(9, style, 10.0).positions, SYNTHETIC_SKELETON)
        assert np.mean(trained.features_and_classes(windows)[1] == number) > 0.8
    module.require_telling_styles(trained)


def test_held_out_accuracy_is_the_share_of_right_answers_on_held_out_clips(packed):
    weak = module.train_classifier(packed, **BRIEF)
    shares = {}
    for number, style in enumerate(STYLES):
        right = []
        for clip in np.flatnonzero((packed.clip_style == number) & (packed.clip_split > 0)):
            windows = weak.windows_of(packed.motion(int(clip)).positions, packed.skeleton)
            right.extend(weak.features_and_classes(windows)[1] == number)
        shares[style] = np.mean(right)
    assert weak.held_out_accuracy == pytest.approx(shares)
    assert weak.accuracy == pytest.approx(np.mean(list(shares.values())))
    assert weak.accuracy < 0.9  # or the test would say nothing


def test_every_style_is_drawn_alike_and_mirrored_where_it_may_be():
    frames = np.zeros((40, module.NUM_CHANNELS), np.float32)
    frames[:, 3] = 1.0  # x of the neck
    frames[30:, 0] = 1.0  # tells the second style
    task = module.StyleTask(
        module.ClassifierConfig(2, window=10),
        module.ClassifierTraining(1, 2000, 0),
        frames=jnp.asarray(frames),
        starts=jnp.asarray([0, 5, 10, 15, 30]),
        first=jnp.asarray([0, 4]),
        count=jnp.asarray([4, 1]),
        mirrored=jnp.asarray([True, False]),
    )
    (windows, style), _ = task.draw(None, jax.random.key(0))
    second = np.asarray(style) == 1
    assert second.mean() == pytest.approx(0.5, abs=0.05)
    np.testing.assert_array_equal(np.asarray(windows[:, 0, 0]) == 1.0, second)
    assert np.mean(np.asarray(windows)[~second, 0, 3]) == pytest.approx(0.0, abs=0.1)
    np.testing.assert_array_equal(np.abs(windows[:, :, 3]), 1.0)
    np.testing.assert_array_equal(np.asarray(windows)[second, :, 3], 1.0)


# ------------------------------------------------------------------------------------ refusals


def test_a_classifier_that_guesses_is_refused_with_accuracy_and_bar(trained):
    shares = dict(zip(STYLES, (0.5, 1.0, 0.7), strict=True))
    weak = dataclasses.replace(trained, held_out_accuracy=shares)
    refused(r"73\.3 %.*bar of 80\.0 %.*worst: ArmsOverhead 50 %", module.require_telling_styles, weak)
    at_the_bar = dataclasses.replace(trained, held_out_accuracy={"one": module.ACCURACY_BAR})
    module.require_telling_styles(at_the_bar)
    unknown = dataclasses.replace(trained, held_out_accuracy={"one": float("nan")})
    refused("nan %", module.require_telling_styles, unknown)


def test_motion_of_another_body_is_refused(trained):
    longer = dataclasses.replace(SYNTHETIC_SKELETON, offsets=1.1 * SYNTHETIC_SKELETON.offsets)
    refused("skeleton of 'tiny'.*bone lengths", trained.windows_of, walk().positions, longer)
    positions = synthesize("Neutral", 1.0, 0).positions[: WINDOW - 1]
    refused("does not fill a window of 20 frames", trained.windows_of, positions, trained.skeleton)


# --------------------------------------------------------------------------------------- files


def test_classifier_comes_back_exactly(trained, saved):
    loaded = module.load_classifier(saved)
    windows = trained.windows_of(walk(seed=9).positions, SYNTHETIC_SKELETON)
    assert same_tree(loaded.features_and_classes(windows), trained.features_and_classes(windows))
    for field in ("config", "styles", "held_out_accuracy", "record", "skeleton"):
        assert getattr(loaded, field) == getattr(trained, field)
    assert same_tree(loaded.references, trained.references)


def test_classifier_is_trained_once_for_each_data_and_recipe(packed, tmp_path, monkeypatch):
    monkeypatch.setattr(module, "runs_dir", lambda dataset, profile: tmp_path / dataset / profile)
    profile = load_profile("smoke", "synthetic")
    first, origin = module.obtain_classifier(packed, profile, **BRIEF)
    assert origin == "trained now" and first.record["dataset_fingerprint"] == packed.fingerprint
    asked = []
    monkeypatch.setattr(module, "train_classifier", lambda packed, **settings: asked.append(settings) or first)
    again, origin = module.obtain_classifier(packed, profile, **BRIEF)
    assert origin == "earlier run" and not asked
    assert same_tree(again.params, first.params)
    others = (
        (dataclasses.replace(packed, fingerprint="1" * 64), BRIEF),
        (packed, {**BRIEF, "seed": 1}),
        (dataclasses.replace(packed, primary_styles=STYLES[:2]), BRIEF),
        (packed, {**BRIEF, "hidden_width": 25}),
    )
    for data, settings in others:
        assert module.obtain_classifier(data, profile, **settings)[1] == "trained now"
        assert settings.items() <= asked[-1].items()
    assert len(list(tmp_path.rglob("synthetic/smoke/classifier/*.safetensors"))) == 5
