"""The protocol: what is measured on what, with intervals, in tidy rows."""

import dataclasses
import functools
import types

import jax
import numpy as np
import pandas as pd
import pytest
from builders import refused, walks_of
from flax import nnx

from f3amd_companion.measuring import measure
from f3amd_lib.data.features import num_channels
from f3amd_lib.data.windows import starting_poses
from f3amd_lib.diffusion.schedules import variance_exploding
from f3amd_lib.ground.profiles import load_profile
from f3amd_lib.ground.records import read_table
from f3amd_lib.measures import protocol as module
from f3amd_lib.measures.classifier import train_classifier
from f3amd_lib.measures.distributions import diversity
from f3amd_lib.measures.protocol import REFERENCE_MODELS, measure_real
from f3amd_lib.measures.real_clips import sideways_share
from f3amd_lib.measures.registry import METRICS, SHOWN
from f3amd_lib.motion.root_paths import named_path
from f3amd_lib.motion.synthetic import synthesize
from f3amd_lib.networks import presets
from f3amd_lib.rollout.rollout import MotionGenerator
from f3amd_lib.training.checkpoints import TrainedModel
from f3amd_lib.training.pipeline import PreparedData

STYLES = ("ArmsOverhead", "Zombie")
SIZES = {"window": 20, "widths": (8, 12), "hidden_width": 24, "feature_width": 16}
SMALL = module.Protocol(STYLES, num_frames=96, num_seeds=2, num_diversity_seeds=2, windows_per_style=3)


@pytest.fixture(scope="module")
def packed():
    return walks_of(STYLES)


@pytest.fixture(scope="module")
def prepared(packed):
    return PreparedData(packed, 32, 10)


@pytest.fixture(scope="module")
def classifier(packed):
    return train_classifier(packed, num_steps=60, batch_size=32, progress=False, **SIZES)


@pytest.fixture(scope="module")
def generator(packed, prepared):
    config = presets.build_config(
        "F3AMD-FNO-32", channels=num_channels(packed.skeleton), num_styles=2, depth=1, latent_width=8
    )
    weights = jax.jit(lambda key: nnx.state(presets.build_from_config(config, key)))(jax.random.key(0))
    trained = TrainedModel(
        "F3AMD-FNO-8", config, weights, prepared.normaliser, packed.skeleton, packed.styles, variance_exploding(),
        starting_poses(packed, num_history=10), {},
    )  # fmt: skip
    return MotionGenerator(trained, 1)


@pytest.fixture(scope="module")
def measured(generator, packed, prepared, classifier):
    return module.measure_model(generator, packed, classifier, SMALL, prepared.windows("validation"))


TEXT_TABLES = ("text", "control", "reconstruction")
TEXT_METRICS = {metric.name for table in TEXT_TABLES for metric in SHOWN[table]} | {"sampling_seconds", "LSD"}
WALKING_METRICS = {"stepping_rate", "slide_speed", "sliding_share", "floor_penetration", "seam_kick"}
PROTOCOL_METRICS = set(METRICS) - TEXT_METRICS - WALKING_METRICS - {"foot_all_frames", "acceleration_ratio"}
"""All but what `measure walking` and the queues of readings and of text measure."""


def one(rows: pd.DataFrame, metric: str, seed: int = 0) -> float:
    (value,) = rows[(rows["metric"] == metric) & (rows["seed"] == seed)]["value"]
    return value


@pytest.mark.slow
def test_a_models_rows_are_tidy(measured):
    rows, rounds = measured
    assert list(rows) == [*("model", "window_frames", "steps", "varies", "seed", "metric", "unit", "better", "value")]
    assert not rows.duplicated(["model", "steps", "seed", "metric"]).any()
    assert set(rows["model"]) == {"F3AMD-FNO-8"} and set(rows["window_frames"]) == {32}
    assert np.isfinite(rows["value"]).all()
    assert set(rows["varies"]) == {"seed"} and set(rows["metric"]) == PROTOCOL_METRICS
    assert len(rows) == 2 * len(PROTOCOL_METRICS)
    # Seeds differ in path, noise and starting pose.
    assert one(rows, "diversity", 0) != one(rows, "diversity", 1)
    assert one(rows, "joint_acceleration", 0) != one(rows, "joint_acceleration", 1)
    assert list(rounds) == ["model", "window_frames", "steps", "metric", "round", "value"]
    assert set(rounds["round"]) == {1, 2, 3}


def test_everybody_is_measured_on_his_own_path_floor_and_style(packed, monkeypatch):
    """Of two styles and two seeds, with stand-ins that write down what they are given."""
    walked, judged, told = {}, [], []

    def rollout(paths, styles, *, seed):
        walked.update(paths=paths, styles=list(styles))
        motion = lambda number: types.SimpleNamespace(number=number)
        return types.SimpleNamespace(window=32, motion=motion, paths=paths)

    walker = types.SimpleNamespace(rollout=rollout)
    monkeypatch.setattr(module.real_clips, "style_floor", lambda packed, style: float(STYLES.index(style)))
    monkeypatch.setattr(module, "_figures_without_classifier", lambda *given: judged.append(given) or {"IRD": 0.0})
    monkeypatch.setattr(module, "classify_windows", lambda classifier, motions, styles: told.append((motions, styles)))
    monkeypatch.setattr(module, "distribution_figures", lambda *given: {})
    monkeypatch.setattr(module, "real_features", lambda *given: {})
    seeds = module.rollout_figures(module.walk_protocol(walker, packed, SMALL), packed, None, SMALL)
    assert seeds == [{"IRD": 0.0}] * 2
    assert walked["styles"] == [*STYLES, *STYLES]
    assert [motion.number for motion, *_ in judged] == [0, 1, 2, 3]
    for number, (_, path, window, floor) in enumerate(judged):
        assert path is walked["paths"][number] and window == 32
        assert floor == STYLES.index(walked["styles"][number])
    # Seeds walk paths of their own.
    assert np.abs(walked["paths"][0].position - walked["paths"][2].position).max() > 0.1
    assert [[motion.number for motion in motions] for motions, _ in told] == [[0, 1], [2, 3]]
    assert all(styles == list(STYLES) for _, styles in told)


def test_the_row_of_real_motion_is_made_of_both_held_out_splits(packed):
    clips, labels = module.held_out_clips(packed, STYLES, 32)
    assert set(np.asarray(packed.clip_split)[clips]) == {1, 2}
    assert [packed.styles[packed.clip_style[clip]] for clip in clips] == labels.tolist()


def test_fid_compares_with_training_windows_of_the_styles_asked_for(packed):
    """References of a classifier that saw one window of each clip, its features the clip's number."""
    number = np.arange(packed.num_clips)
    seen = types.SimpleNamespace(clips=number, features=number[:, None], styles=np.asarray(packed.clip_style))
    judge = types.SimpleNamespace(references={"train": seen}, style_index=STYLES.index)
    for styles in (STYLES, STYLES[1:]):
        real = module.real_features(packed, judge, styles, 32)
        assert list(real) == [STYLES.index(style) for style in styles]
        for style, features in real.items():
            assert features.size
            assert {(packed.clip_style[clip], packed.clip_split[clip]) for clip in features[:, 0]} == {(style, 0)}


def test_windows_go_by_the_motion_that_they_were_cut_from_and_scores_by_the_style_that_was_asked_for():
    """A classifier that sees the number in a motion's joints; styles lie far apart, and each motion in its own."""
    made = lambda number, frames: types.SimpleNamespace(
        positions=np.full((frames, 1, 2), number + 0.0), num_frames=frames, skeleton=None
    )
    judge = types.SimpleNamespace(
        config=types.SimpleNamespace(window=4),
        windows_of=lambda positions, _: positions[: len(positions) // 4 * 4].reshape(-1, 8),
        features_and_classes=lambda windows: (windows[:, :2], windows[:, 0].astype(int) % 2),
        style_index=STYLES.index,
    )
    seen = module.classify_windows(judge, [made(k, 400 + 40 * k) for k in range(4)], [*STYLES, *STYLES])
    np.testing.assert_array_equal(seen.features[:, 0], seen.source)
    np.testing.assert_array_equal(seen.style, seen.source % 2)
    spread = np.random.default_rng(0).normal(size=seen.features.shape)
    seen = seen._replace(features=100.0 * seen.style[:, None] + spread)
    real = {number: 100.0 * number + np.random.default_rng(1).normal(size=(200, 2)) for number in range(2)}
    figures = module.distribution_figures(seen, real, 100, np.random.default_rng(2))
    assert figures["style_accuracy"] == 100.0 and figures["FID"] < 10.0 and figures["CAMDM_FID"] < 1.0
    # A style of one motion counts as much as one of three.
    assert module._style_means([{"IRD": value} for value in (1.0, 1.0, 1.0, 5.0)], [*"aaab"]) == {"IRD": 3.0}


class Walker:
    """Walks its path in its style's gait; with `noise`, a joint that lies elsewhere in each sample."""

    def __init__(self, noise):
        self.noise = noise

    def rollout(self, paths, styles, *, seed, history=None):
        def motion(place):
            positions = np.zeros((len(paths[place].position), 2, 3))
            positions[..., [0, 2]] = paths[place].position[:, None]
            positions[:, 1, 1] = STYLES.index(styles[place]) + self.noise * place
            return types.SimpleNamespace(positions=positions)

        return types.SimpleNamespace(history=np.zeros((len(paths), 10, 9)), motion=motion, styles=styles)


def test_samples_of_one_start_share_their_path_and_style_and_differ_in_noise_alone():
    paths = [named_path("complex", 40, seed=seed) for seed in range(2)]
    samples = lambda noise: module._samples_of_one_start(Walker(noise), paths, list(STYLES), 3, (0, 1))
    still = samples(0.0)
    assert still.shape == (2, 3, 40, 2, 3) and diversity(still) == 0.0 < 1.0 < diversity(samples(0.1))
    for style, (rows, path) in enumerate(zip(still, paths, strict=True)):
        for row in rows:
            np.testing.assert_array_equal(row[:, 0, [0, 2]], path.position)
            assert (row[:, 1, 1] == style).all()


@pytest.mark.slow
def test_an_untrained_network_scores_worse_than_real_motion(measured, packed, classifier):
    rows, _ = measured
    real = module.measure_real(packed, classifier, SMALL, window=32)
    assert set(real["steps"]) == {0} and set(real["model"]) == {"real"}
    for metric in ("FID", "EMD", "joint_acceleration", "trajectory_error", "IRD_excess"):
        assert one(rows, metric) > 1.5 * one(real, metric), metric
    assert one(real, "style_accuracy") == 100.0
    assert not {"diversity", "x0_error_ratio", "path_drift"} & set(real["metric"])
    assert set(real["varies"]) == {"clips"} and set(real["seed"]) == set(range(20))


def test_the_same_paths_turn_alike_at_the_pace_of_each_style(packed):
    paths = module.evaluation_paths(packed, STYLES, 300, seed=3)
    assert [path.num_frames for path in paths] == [300, 300]
    # The walker never steps sideways, so nobody is asked to.
    assert max(sideways_share(path) for path in paths) == 0.0
    assert paths[0].length != pytest.approx(paths[1].length, rel=0.01)
    other = module.evaluation_paths(packed, STYLES, 300, seed=4)
    assert np.abs(other[0].position - paths[0].position).max() > 0.1


def test_seeds_become_means_with_intervals():
    rows = pd.DataFrame({"seed": [0, 1, 2], "value": [1.0, 2.0, 3.0]})
    rows = rows.assign(model="A", window_frames=32, steps=8, varies="seed", metric="FID", unit="", better="down")
    (row,) = module.summarise(rows).to_dict("records")
    assert (row["value"], row["repeats"]) == (2.0, 3)
    # Student's t with 2 degrees of freedom: 4.303 * 1 / sqrt(3).
    assert row["high"] - row["value"] == pytest.approx(4.303 / np.sqrt(3), rel=1e-3)
    assert row["low"] == pytest.approx(4.0 - row["high"])
    # Halves of the clips scatter as the figure does: averaging over them narrows nothing.
    (halves,) = module.summarise(rows.assign(varies="clips")).to_dict("records")
    assert halves["high"] - halves["value"] == pytest.approx(4.303, rel=1e-3)
    single = module.summarise(rows[:1])
    assert np.isnan(single["low"][0]) and single["value"][0] == 1.0


@pytest.mark.slow
def test_a_clip_shorter_than_the_classifiers_window_is_left_out(classifier):
    long, short = synthesize(STYLES[0], 2.0, 0), synthesize(STYLES[1], 2.0, 0).slice(0, classifier.config.window - 1)
    seen = module.classify_windows(classifier, [short, long, short], [STYLES[1], STYLES[0], STYLES[1]])
    alone = module.classify_windows(classifier, [long], STYLES[:1])
    assert set(seen.source) == {1} and len(seen.source) == long.num_frames // classifier.config.window
    np.testing.assert_array_equal(seen.features, alone.features)
    refused("no motion has the 20 frames", module.classify_windows, classifier, [short], STYLES[1:2])


@pytest.mark.slow
def test_too_few_windows_and_unknown_styles_are_refused(packed, classifier):
    many = dataclasses.replace(SMALL, windows_per_style=1000)
    refused("1000 are needed", module.measure_real, packed, classifier, many, window=32)
    # One rollout of 96 frames holds 4 windows of 20; half the held-out clips hold 6.
    fitting = functools.partial(module.windows_that_fit, packed, classifier, window=32)
    assert fitting(many) == 4 and fitting(dataclasses.replace(many, num_frames=960)) == 6
    short = dataclasses.replace(many, num_frames=19)
    refused("no window of 20 frames .* make longer rollouts", fitting, short)
    unknown = dataclasses.replace(SMALL, styles=("Zombi",))
    refused("'?Zombi'?", module.measure_real, packed, classifier, unknown, window=32)


@pytest.fixture
def name(classifier, generator, tmp_path, monkeypatch):
    """Name of the one model that there is to measure."""
    monkeypatch.setenv("F3AMD_RESULTS_DIR", str(tmp_path))
    trained = dataclasses.replace(generator.trained, name="F3AMD-FNO-32")
    monkeypatch.setattr(measure, "obtain_classifier", lambda *a, **k: (classifier, "earlier run"))
    monkeypatch.setattr(measure, "obtain_model", lambda *a, **k: (trained, None, "earlier run"))
    monkeypatch.setattr(measure, "available_models", lambda *a: [trained.name])
    monkeypatch.setattr(measure, "STEPS", (1,))
    return trained.name


@pytest.mark.slow
def test_the_measurement_keeps_its_rows_and_goes_on(name, prepared, monkeypatch):
    profile = load_profile("smoke", "synthetic", rollout_rounds=3)
    path = measure.measure_quality(prepared, profile)
    table, record = read_table(path)
    rows = set(zip(table["model"], table["steps"], strict=True))
    assert rows == {*((model, 0) for model in module.REFERENCE_MODELS), (name, 1)}
    assert record["measurement"] == "quality" and record["protocol"]["num_seeds"] == 2
    for other in ("quality_by_seed", "quality_by_round"):
        kept, _ = read_table(path.with_name(f"{other}.csv"))
        assert set(kept["model"]) <= {model for model, _ in rows}
    # What is on record is not measured again; tests of the runner say when it is.
    monkeypatch.setattr(measure.protocols, "measure_model", None)
    measure.measure_quality(prepared, profile)
    pd.testing.assert_frame_equal(read_table(path)[0], table)


@pytest.mark.slow
def test_bad_generators_are_told_apart(packed, classifier):
    tables = {model: measure_real(packed, classifier, SMALL, window=32, model=model) for model in REFERENCE_MODELS}
    real = tables["real"]
    assert one(tables["frozen pose"], "bone_swing") < 0.1 * one(real, "bone_swing")
    assert one(tables["frozen pose"], "foot_alternation") < 0.5 * one(real, "foot_alternation")
    for broken in ("shuffled frames", "noisy motion"):
        assert one(tables[broken], "IRD") > 1.5 * one(real, "IRD")
    for broken in REFERENCE_MODELS[2:]:  # of frozen poses so few windows say little
        assert one(tables[broken], "FID") > one(real, "FID")
    refused("unknown reference 'frozen'", measure_real, packed, classifier, SMALL, window=32, model="frozen")
