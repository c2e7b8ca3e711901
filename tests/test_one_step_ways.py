"""The three ways past the wall: how ends are counted, and what a student is told."""

import dataclasses

import jax
import numpy as np
import pytest
from builders import rows_of_one_step
from f3amd_notebooks import bimodal_paths as toy
from f3amd_notebooks import one_step_ways as ways

from f3amd_lib.diffusion.schedules import variance_exploding

STEADY = (("F3AMD-FNO-96-steady", 1), ("F3AMD-FNO-96-steady, distilled", 1))
"""Model and steps: our own recipe in one step, as it ships and distilled."""

DATA, EXPLODING = toy.BimodalPaths(num_frames=8, num_modes=4), variance_exploding()


def test_real_paths_have_all_their_variety_and_a_mean_has_none():
    paths, _ = DATA.draw(jax.random.key(5), 2000)
    real = ways.end_figures(DATA, paths)
    assert real["wall"] == 0.0 and real["variety"] == pytest.approx(1.0, abs=0.1)
    means = np.repeat(DATA.mean_paths, 10, axis=0)
    assert ways.end_figures(DATA, means)["variety"] == pytest.approx(0.0, abs=1e-9)
    middle = np.repeat(DATA.mean_paths.mean(axis=0)[None], 10, axis=0)
    hit = ways.end_figures(DATA, middle)
    assert hit["wall"] == 1.0 and np.isnan(hit["variety"])


def test_the_exact_mean_hits_the_wall_and_the_exact_walk_does_not():
    compared = {"one": ([DATA], 1), "eight": ([DATA], 8)}
    table = ways.ways_table(compared, EXPLODING, num_samples=200).set_index("way")
    assert table.loc["one", "wall"] > 0.95 and table.loc["eight", "wall"] < 0.1


@pytest.mark.slow
def test_students_begin_as_the_networks_and_come_to_use_their_noise():
    networks, _ = toy.train_networks(DATA, EXPLODING, [0, 1], num_steps=150)
    students, losses = ways.distil_networks(networks, EXPLODING, [0, 1], num_steps=300, levels=8)
    assert losses.shape == (2, 300) and np.isfinite(losses).all()
    table = ways.ways_table({"network": (networks, 1), "student": (students, 1)}, EXPLODING)
    walls = table.groupby("way")["wall"].mean()
    assert walls["network"] > 0.8 and walls["student"] < 0.5
    # A target that is asked at its own level, one step on, and never at level 0.
    task = ways.PathStudentTask(networks[0], dataclasses.replace(_recipe(), batch_size=64), EXPLODING, 8, (0,))
    _, sigma, sigma_next, _ = task._questions(jax.random.key(0))
    grid = EXPLODING.grid(8).astype(np.float32)
    place = np.searchsorted(-grid, -np.asarray(sigma))
    np.testing.assert_allclose(np.asarray(sigma_next), grid[place + 1])
    assert (np.asarray(sigma) > 0).all() and (np.asarray(sigma_next) == 0).any()


def _recipe():
    return ways.TrainingConfig(10, 8, 1e-3)


@pytest.fixture(scope="module")
def of_record():
    """Value of (model, steps, metric), by the records that notebook 22 draws."""
    return rows_of_one_step()


def test_what_notebook_22_says_of_variety_follows_from_the_records(of_record):
    value = of_record["value"]
    for metric in ("diversity", "seed_spread"):
        student, walk = value["CAMDM, distilled", 1, metric], value["CAMDM, by DDIM", 8, metric]
        assert student > walk > value["CAMDM", 1, metric]
        steady = [value[name, steps, metric] for name, steps in (*STEADY, (STEADY[0][0], 8))]
        assert steady[0] < steady[1] < steady[2]  # "gains less": the student stays below the walk of eight steps
    figures = [round(value[name, steps, "diversity"], 2) for name, steps in (*STEADY, (STEADY[0][0], 8))]
    assert figures == [0.58, 0.83, 1.18]
    for name in ("CAMDM", STEADY[0][0]):  # one plain step loses variety, and no FID by the intervals
        assert value[name, 1, "diversity"] < value[name, 8, "diversity"]
        assert of_record.loc[(name, 1, "FID"), "low"] < of_record.loc[(name, 8, "FID"), "high"]
    one, eight = (value.xs(steps, level="steps").unstack() for steps in (1, 8))
    assert (round(one["joint_acceleration"]["CAMDM"], 1), round(eight["joint_acceleration"]["CAMDM"], 1)) == (1.9, 1.4)
    assert [round(way["foot_alternation"]["CAMDM"], 2) for way in (one, eight)] == [0.55, 0.97]
    assert [round(way["joint_acceleration"][STEADY[0][0]], 2) for way in (one, eight)] == [0.52, 0.60]
    assert [round(way["foot_alternation"][STEADY[0][0]], 2) for way in (one, eight)] == [1.77, 1.77]


def test_what_notebook_22_says_of_the_price_follows_from_the_records(of_record):
    value = of_record["value"]
    for metric in ("foot_sliding", "joint_acceleration"):
        one, two, four = (value["CAMDM, distilled", steps, metric] for steps in (1, 2, 4))
        assert one > two > four and one > 1.2 * value["CAMDM, by DDIM", 8, metric]
    assert [round(value[(*way, "foot_sliding")], 2) for way in STEADY] == [0.22, 0.42]  # "pays too"
    assert [round(100 * value[(*way, "contact_share")]) for way in STEADY] == [48, 4]
    assert value[(*STEADY[1], "joint_acceleration")] < 1.1 * value[(*STEADY[0], "joint_acceleration")]
