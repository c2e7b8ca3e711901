"""The three ways past the wall: how ends are counted, and what a student is told."""

import dataclasses

import jax
import numpy as np
import pytest
from f3amd_notebooks import bimodal_paths as toy
from f3amd_notebooks import one_step_ways as ways

from f3amd_lib.diffusion.schedules import variance_exploding

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
