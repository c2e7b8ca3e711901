"""Distilling a denoiser of locomotion into few steps: where a student begins, what it is asked, what it learns."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from builders import HISTORY, WINDOW, refused, same_tree, tiny_packed, tiny_task, tiny_trained

from f3amd_companion.measuring import consistency_task
from f3amd_companion.measuring.consistency_task import ConsistencyTask
from f3amd_lib.diffusion.schedules import variance_preserving_cosine
from f3amd_lib.ground.profiles import load_profile
from f3amd_lib.training.optimise import advance, initial_state, save_state
from f3amd_lib.training.pipeline import PreparedData


@pytest.fixture(scope="module")
def task():
    denoising = tiny_task(num_steps=8, learning_rate=1e-3, ema_decay=0.9)
    teacher, _ = denoising.init(jax.random.key(3))
    return ConsistencyTask(denoising, teacher, 4)


def test_a_student_begins_as_its_teacher_which_stays(task):
    state = initial_state(task)
    assert same_tree(state.params, task.teacher)
    kept = jax.tree.map(np.asarray, task.teacher)
    state, terms = advance(task, state, 3)
    assert not same_tree(state.params, kept) and same_tree(task.teacher, kept)
    assert np.isfinite(terms["loss"]).all()


def test_one_that_agrees_with_itself_everywhere_has_no_loss_and_another_has(task):
    """A network of zeros says one thing at all levels: teacher, target and student agree on every path."""
    blank = jax.tree.map(jnp.zeros_like, task.teacher)
    silent = dataclasses.replace(task, teacher=blank)
    batch, key = jax.jit(task.denoising.draw)(initial_state(task), jax.random.key(0))
    sample = jax.jit(lambda student: silent.terms(student, (batch[0], blank), key)["sample"])
    assert float(sample(blank)) == pytest.approx(0.0, abs=1e-9)
    assert float(sample(task.teacher)) > 1e-3


@pytest.mark.parametrize(("num_phases", "after"), [(1, [8] * 8), (2, [4] * 4 + [8] * 4), (4, [2, 2, 4, 4, 6, 6, 8, 8])])
def test_a_question_ends_where_its_phase_does_and_the_sampler_asks_there(task, num_phases, after, monkeypatch):
    levels = variance_preserving_cosine(8)
    student = ConsistencyTask(tiny_task(num_steps=8, diffusion=levels), task.teacher, num_phases=num_phases)
    asked = []

    def answer(teacher, target, x_noisy, sigma, sigma_next, sigma_edge):
        asked.append(jnp.stack([sigma, sigma_next, sigma_edge]))
        return jnp.zeros_like(x_noisy)

    @jax.jit
    def question(drawn, key):
        student.terms(student.teacher, drawn, key)
        return asked.pop()

    monkeypatch.setattr(consistency_task, "consistency_answer", answer)
    drawn, key = jax.jit(student.draw)(initial_state(student), jax.random.key(0))
    answers = [question(drawn, jax.random.fold_in(key, number)) for number in range(6)]
    sigma, sigma_next, sigma_edge = np.concatenate(answers, axis=1)
    grid = levels.grid(8).astype(np.float32)
    place = np.searchsorted(-grid, -sigma)
    assert set(place) == set(range(8))
    np.testing.assert_array_equal(sigma_next, grid[place + 1])
    np.testing.assert_array_equal(sigma_edge, grid[np.array(after)[place]])
    # A rollout of M steps asks at the beginning of each phase.
    visited = levels.grid(num_phases, consistency_task.STUDENT_SPACING)
    np.testing.assert_allclose(visited, levels.grid(8)[[0, *sorted(set(after))]])


def test_a_student_is_asked_in_the_units_of_its_teacher(tmp_path, monkeypatch):
    """Weights that ship bring a normaliser of their own, which is not that of the data as packed here."""
    prepared = PreparedData(tiny_packed(), WINDOW, HISTORY)
    teacher = tiny_trained()
    own = jax.tree.map(lambda leaf: leaf + 0.25, teacher.normaliser)
    teacher = dataclasses.replace(teacher, normaliser=own)
    asked = []
    monkeypatch.setattr(PreparedData, "model_config", lambda *given, **fields: teacher.config)
    monkeypatch.setattr(consistency_task, "train_and_keep", lambda *given, **leg: asked.append(given[3]))
    profile = load_profile("smoke", "synthetic")
    teacher = dataclasses.replace(teacher, name="F3AMD-FNO-96")
    consistency_task.distil(prepared, profile, teacher, tmp_path, num_steps=2, num_phases=1, batch_size=2)
    assert same_tree(asked[0].denoising.normaliser, own)
    state = consistency_task.model_files(profile, teacher.name, folder=tmp_path).state
    save_state(state, asked[0], initial_state(asked[0]))
    for size, there in ((2, True), (4, False)):  # a state of other settings is set aside
        consistency_task.distil(prepared, profile, teacher, tmp_path, num_steps=2, num_phases=1, batch_size=size)
        assert state.exists() is there


def test_phases_that_no_sampler_visits_are_refused(task):
    for number in (3, 2):
        refused(f"into {number} equal phases", dataclasses.replace, task, num_phases=number)
