"""`measure feet`: what blending and locking do is measured on one and the same rollout, never mixed up."""

import dataclasses

import numpy as np
import pytest
from builders import packed_from, tiny_trained
from feet_oracle import lock_rollout_online

from f3amd_companion.measuring import measure
from f3amd_lib.data.features import world_frames
from f3amd_lib.ground.profiles import load_profile, repository_root
from f3amd_lib.ground.records import read_table
from f3amd_lib.motion.synthetic import synthesize
from f3amd_lib.rollout.generated import Rollout
from f3amd_lib.training.pipeline import PreparedData

WINDOW, HISTORY = 32, 10
PROFILE = load_profile("smoke", "synthetic", window=WINDOW)


def feet_rows(table) -> list[str]:
    """The rows of the table in docs/results.md, from a record."""
    rows, measures = [], ["slide_speed", "joint_acceleration", "seam_kick", "floor_penetration"]
    shown = table[table.treatment.isin(["as made", "blended, feet locked"])]
    for (model, steps, treatment), part in shown.groupby(["model", "steps", "treatment"], sort=False):
        seeds = part.groupby("seed")[measures].mean()
        cells = [
            f"{mean:.{digits}f}" + (f" ± {spread:.{digits}f}" if len(seeds) > 1 else "")
            for mean, spread, digits in zip(seeds.mean(), seeds.std(), (1, 2, 1, 1), strict=True)
        ]
        named = "real" if not steps else f"`{model}`, {steps} step{'s' * (steps > 1)}, {treatment}"
        rows.append(f"| {named} | {' | '.join(cells)} |")
    return rows


class Slider:
    """Generates walkers whose root goes 40 % too far, so that feet slide, and who jump at each seam."""

    def __init__(self, trained, num_steps):
        self.num_steps = num_steps

    def rollout(self, paths, styles, *, seed):
        frames = []
        for number in range(len(styles)):
            walk = synthesize("Neutral", (HISTORY + len(paths[0].yaw)) / 30, seed=10 * seed + number)
            root = walk.root_position * [1.4, 1.0, 1.4]
            root[:, 0] += 0.03 * (((np.arange(len(root)) - HISTORY) // WINDOW) % 2)
            frames.append(world_frames(walk.replace(root_position=root)))
        frames = np.array(frames)
        return Rollout(walk.skeleton, frames[:, HISTORY:], frames[:, :HISTORY], tuple(paths), tuple(styles), WINDOW)


@pytest.fixture(scope="module")
def table(tmp_path_factory):
    clips = [(synthesize("Neutral", 5.0, seed=seed), seed % 2, seed % 3) for seed in range(6)]
    prepared = PreparedData(packed_from(clips), WINDOW, HISTORY)
    profile = dataclasses.replace(PROFILE, evaluation_styles=("calm", "proud"))
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("F3AMD_RESULTS_DIR", str(tmp_path_factory.mktemp("results")))
        patch.setattr(measure, "obtain_model", lambda prepared, profile, *, preset: (tiny_trained(), None, ""))
        patch.setattr(measure, "available_models", lambda profile: ["F3AMD-FNO-32"])
        patch.setattr(measure, "MotionGenerator", Slider)
        patch.setattr(measure, "WALKING_SEEDS", 1)
        # The steer page's rule, which sees no frame ahead, is an oracle of tests in Python.
        patch.setitem(measure.TREATMENTS, "blended, feet locked online", (4, lock_rollout_online))
        return read_table(measure.measure_feet(prepared, profile))


@pytest.fixture
def mean(table):
    """What is measured of the model in 8 steps, by treatment."""
    rows, _ = table
    return rows[(rows.model == "F3AMD-FNO-32") & (rows.steps == 8)].groupby("treatment").mean(numeric_only=True)


def test_every_model_step_style_and_treatment_has_its_row(table):
    rows, record = table
    made = rows[rows.model == "F3AMD-FNO-32"]
    assert set(made.steps) == {8, 1} and set(made.treatment) == {*measure.TREATMENTS, "blended, feet locked online"}
    assert len(made) == 2 * 5 * 2 and set(rows[rows.model == "real"].treatment) == {"as made"}
    assert record["measurement"] == "feet" and set(record["weights_digests"]) == {"real", "F3AMD-FNO-32"}


def test_locked_feet_slide_less_and_blended_seams_kick_less(mean):
    assert mean.slide_speed["as made"] > 20  # the nonsense is seen
    assert mean.slide_speed["feet locked"] < 0.3 * mean.slide_speed["as made"]
    assert mean.slide_speed["blended"] > 0.7 * mean.slide_speed["as made"]  # blending holds no foot
    assert mean.seam_kick["blended"] < 0.7 * mean.seam_kick["as made"]
    assert mean.slide_speed["blended, feet locked"] < 0.3 * mean.slide_speed["as made"]


def test_feet_held_without_a_look_ahead_slide_less_and_pop_no_more_than_blended_ones(mean):
    online = mean.loc["blended, feet locked online"]
    assert online.slide_speed < 0.3 * mean.slide_speed["blended"]
    assert online.seam_kick < 0.7 * mean.seam_kick["as made"]
    assert online.joint_acceleration < 2 * mean.joint_acceleration["blended"]
    # It is another rule than the one that plans, and not that one under a second name.
    assert (online != mean.loc["blended, feet locked"]).sum() >= 3


def test_the_page_of_results_says_what_the_record_says():
    page = (repository_root() / "docs" / "results.md").read_text(encoding="utf-8")
    table, _ = read_table(repository_root() / "paper_figures/bandai/laptop/records/feet.csv")
    rows = feet_rows(table)
    assert len(rows) == 9 and all(row in page for row in rows)
    assert not any(row in page for row in feet_rows(table.assign(slide_speed=table.slide_speed + 1)))
