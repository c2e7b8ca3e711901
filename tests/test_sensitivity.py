"""Measuring the measures: orders, settling, foot spectra; on motion and features made by hand."""

from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from builders import packed_from, refused, straight_motion, wandering_motion
from f3amd_notebooks.rank_agreement import rank_agreement

from f3amd_companion.measuring import sensitivity
from f3amd_lib.measures.protocol import Protocol

SPAN = 20


class PlainClassifier:
    """Stands for a trained one: its features say how fast and how jerkily joints move."""

    config = SimpleNamespace(window=SPAN)
    accuracy, held_out_accuracy = 1.0, {"calm": 1.0, "proud": 1.0}
    styles = ("calm", "proud")

    def __init__(self, **clouds):
        """Each cloud is (features, clip of each window); the first half is "calm"."""
        self.references = {
            split: SimpleNamespace(features=features, clips=clips, styles=np.arange(len(features)) * 2 // len(features))
            for split, (features, clips) in clouds.items()
        }

    def style_index(self, style):
        return ("calm", "proud").index(style)

    def windows_of(self, positions, skeleton):
        relative = positions - positions[:, :1]
        count = len(relative) // SPAN
        return relative[: count * SPAN].reshape(count, SPAN, -1)

    def features(self, windows):
        changes = [np.abs(np.diff(windows, order, axis=1)).mean(axis=1) for order in (1, 2)]
        return 50.0 * np.concatenate(changes, axis=-1)

    def predict(self, windows):
        # "proud" clips are those whose joints move faster.
        return (self.features(windows)[:, :18].mean(axis=1) > 3.0).astype(int)

    def features_and_classes(self, windows):
        return self.features(windows), self.predict(windows)

    def reference(self, split, style):
        known = self.references[split]
        return known.features[known.styles == self.style_index(style)]


@pytest.fixture(scope="module")
def packed():
    """A slow and a fast mover, the first half of each for training and the second to test."""
    slow, fast = wandering_motion(480, 0), wandering_motion(960, 1)
    fast = fast.replace(root_position=fast.root_position[::2], rotations=fast.rotations[::2])
    halves = lambda motion, style: [(motion.slice(0, 240), style, 0), (motion.slice(240, 480), style, 2)]
    return packed_from(halves(slow, 0) + halves(fast, 1))


@pytest.fixture(scope="module")
def classifier(packed):
    plain = PlainClassifier()
    windows = [plain.windows_of(packed.motion(clip).positions, None) for clip in (0, 2)]
    clips = np.repeat([0, 2], [len(part) for part in windows])
    return PlainClassifier(train=(plain.features(np.concatenate(windows)), clips))


PROTOCOL = Protocol(("calm", "proud"), num_seeds=2, windows_per_style=11)


@pytest.fixture(scope="module")
def graded(packed, classifier):
    return sensitivity.graded_corruptions(packed, classifier, PROTOCOL, (0.0, 0.5, 1.0), splits=("test",))


def test_strength_0_is_real_motion_whatever_the_recipe(graded):
    real = graded[graded["strength"] == 0.0].pivot(index=["seed", "metric"], columns="corruption", values="value")
    np.testing.assert_allclose(real, real[["frozen pose"]].to_numpy().repeat(3, axis=1))
    assert (real.xs("style_accuracy", level="metric") == 100.0).all(axis=None)
    # Draws of two seeds differ.
    assert not np.isclose(*real.xs("FID", level="metric")["frozen pose"])


def test_more_noise_is_farther_away(graded):
    means = sensitivity.summarise_corruptions(graded)
    assert list(means) == ["corruption", "strength", "metric", "value", "low", "high", "repeats"]
    assert (means["repeats"] == 2).all()
    noisy = means[(means["corruption"] == "noisy motion") & (means["metric"] == "EMD")]
    assert (np.diff(noisy["value"]) > 0).all()
    agreement = rank_agreement(graded).set_index(["corruption", "metric"])["value"]
    assert agreement["noisy motion", "EMD"] == agreement["noisy motion", "FID"] == 1.0


def made_up(orders):
    """Rows in which the distances rank the strengths 0, 1/3, 2/3, 1 as told, a seed each."""
    rows = []
    for metric, seeds in orders.items():
        for seed, ranks in enumerate(seeds):
            rows += [
                {"corruption": "noisy motion", "strength": strength / 3, "seed": seed,
                 "metric": metric, "value": float(rank)}
                for strength, rank in enumerate(ranks)
            ]  # fmt: skip
    return pd.DataFrame(rows)


def test_claim_q18_rank_agreement_in_closed_form():
    rows = made_up({"EMD": [(1, 2, 3, 4), (1, 2, 4, 9)], "FID": [(4, 3, 2, 1), (1, 3, 2, 4)]})
    table = rank_agreement(rows).set_index("metric")
    assert table.loc["EMD", ["value", "low", "high"]].tolist() == [1.0, 1.0, 1.0]
    # Spearman: -1 for the reversed order, 1 - 6 * 2 / (4 * 15) = 0.8 for one swapped pair.
    assert table.loc["FID", "value"] == pytest.approx(-0.1)
    assert table.loc["EMD minus FID", "value"] == pytest.approx(1.1)
    # The interval of two seeds is wide, but no correlation lies beyond 1.
    assert table.loc["FID", ["low", "high"]].tolist() == [-1.0, 1.0]
    assert table.loc["EMD minus FID", ["low", "high"]].tolist() == [-2.0, 2.0]
    refused("one strength has no order", rank_agreement, rows[rows["strength"] == 0])


def gaussian_clouds(train, held_out):
    rng = np.random.default_rng(0)
    return PlainClassifier(train=(rng.normal(size=(train, 6)), None), held_out=(rng.normal(size=(held_out, 6)), None))


def test_settling_of_two_clouds_of_one_distribution_falls_towards_0():
    curve = sensitivity.settling(gaussian_clouds(400, 180))
    # 90 windows of a style: halvings of 45, times two styles.
    assert curve[curve["metric"] == "FID"]["windows"].tolist() == [2, 4, 10, 22, 44, 90]
    for metric in ("FID", "EMD"):
        values = curve[curve["metric"] == metric]["value"].to_numpy()
        assert 0 < values[-1] < 0.7 * values[0] and (np.diff(values) < 0).all()
    pd.testing.assert_frame_equal(curve, sensitivity.settling(gaussian_clouds(400, 180)))


FREQUENCY = 3 * 30 / 64
"""In the middle of a bin, 1.41 Hz."""


def swaying(amplitude, num_frames=257, frequency=FREQUENCY):
    """A stiff figure that sways along x."""
    sway = amplitude * np.sin(2 * np.pi * frequency * np.arange(num_frames) / 30)
    still = straight_motion(num_frames, step=(0.0, 0.0, 0.0))
    return still.replace(root_position=still.root_position + sway[:, None] * np.eye(3)[0])


def test_claim_q15_power_of_a_swaying_foot():
    systems = {
        ("real", 32, 0): [("calm", swaying(0.1)), ("proud", swaying(0.2)), ("proud", swaying(0.2))],
        ("F3AMD-FNO-96", 32, 8): [("calm", swaying(0.2)), ("proud", swaying(0.1, frequency=8.0))],
    }
    table = sensitivity.foot_spectrum(systems).set_index(["model", "steps", "band", "metric"])
    assert list(table) == ["window_frames", "value", "low", "high", "repeats"]
    # A step from frame to frame has the amplitude 2 sin(pi f / 30) of the sway; half its square.
    power = lambda amplitude: 0.5 * (30 * amplitude * 2 * np.sin(np.pi * FREQUENCY / 30)) ** 2
    real = table.xs(("real", "0.5-2 Hz"), level=("model", "band")).droplevel("steps")
    assert real.loc["toe_power", "value"] == pytest.approx((power(0.1) + power(0.2)) / 2, rel=1e-3)
    assert real.loc["toe_power", "repeats"] == 2
    assert table.loc[("real", 0, "5-15 Hz", "toe_power"), "value"] < 1e-6
    assert table.xs("toe_power_over_real", level="metric").loc["real"]["value"].tolist() == [1.0] * 3

    only = {key: [pair for pair in pairs if pair[0] == "calm"] for key, pairs in systems.items()}
    table = sensitivity.foot_spectrum(only).set_index(["model", "band", "metric"])["value"]
    assert table["F3AMD-FNO-96", "0.5-2 Hz", "toe_power_over_real"] == pytest.approx(4.0, rel=1e-6)
