"""Distilling a denoiser of locomotion into one step: where a student begins, what it is asked, what it learns."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from builders import tiny_task

from f3amd_lib.training.consistency_task import ConsistencyTask
from f3amd_lib.training.optimise import advance, initial_state


@pytest.fixture(scope="module")
def task():
    denoising = tiny_task(num_steps=8, learning_rate=1e-3, ema_decay=0.9)
    teacher, _ = denoising.init(jax.random.key(3))
    return ConsistencyTask(denoising, teacher, 4)


def test_a_student_begins_as_its_teacher_which_stays(task):
    state = initial_state(task)
    for mine, theirs in zip(jax.tree.leaves(state.params), jax.tree.leaves(task.teacher), strict=True):
        np.testing.assert_array_equal(mine, theirs)
    kept = jax.tree.map(np.asarray, task.teacher)
    state, terms = advance(task, state, 3)
    changed = [bool((a != b).any()) for a, b in zip(*map(jax.tree.leaves, (state.params, kept)), strict=True)]
    assert any(changed) and np.isfinite(terms["loss"]).all()
    for before, after in zip(jax.tree.leaves(kept), jax.tree.leaves(task.teacher), strict=True):
        np.testing.assert_array_equal(before, after)


def test_one_that_agrees_with_itself_everywhere_has_no_loss_and_another_has(task):
    """A network of zeros says one thing at all levels: teacher, target and student agree on every path."""
    blank = jax.tree.map(jnp.zeros_like, task.teacher)
    silent = dataclasses.replace(task, teacher=blank)
    batch, key = jax.jit(task.denoising.draw)(initial_state(task), jax.random.key(0))
    sample = jax.jit(lambda student: silent._terms(student, blank, batch[0], key, training=False)["sample"])
    assert float(sample(blank)) == pytest.approx(0.0, abs=1e-9)
    assert float(sample(task.teacher)) > 1e-3


def test_identity_names_the_teacher(task):
    other = dataclasses.replace(task, teacher=jax.tree.map(jnp.zeros_like, task.teacher))
    assert task.identity()["teacher"] != other.identity()["teacher"]
    assert task.identity()["training"] == other.identity()["training"]
