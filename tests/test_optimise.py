"""The optimise loop on tasks of a few numbers: resume, average, stops, broken numbers, players."""

import dataclasses
import functools
from dataclasses import dataclass
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from builders import refused, same_tree

from f3amd_lib.training.optimise import (
    TrainingDiverged,
    differences,
    held_out_terms,
    initial_state,
    optimise,
    restore_state,
    save_state,
)

STEPS = 32
QUIET = {"progress": False, "chunk": 2}


@dataclass(frozen=True)
class LineConfig:
    """How a line is fitted; `breaks_after` steps the learning rate is infinite."""

    num_steps: int = STEPS
    ema_decay: float | None = 0.9
    seed: int = 0
    rate: float = 1e-2
    breaks_after: int = 10_000


@functools.partial(jax.tree_util.register_dataclass, data_fields=("points",), meta_fields=("config",))
@dataclass(frozen=True, eq=False)
class Line:
    """Fit y = slope x + height to noisy draws from a few points [N, 2]; counts its draws in the statistics."""

    name: ClassVar[str] = "line"

    points: jax.Array
    config: LineConfig = LineConfig()

    @property
    def optimiser(self):
        return optax.adam(lambda step: jnp.where(step < self.config.breaks_after, self.config.rate, jnp.inf))

    def identity(self):
        return {"training": dataclasses.asdict(self.config), "dataset_fingerprint": "line", "sizes": (1, 2)}

    def init(self, key):
        return {"slope": jax.random.normal(key), "height": jnp.zeros(())}, jnp.zeros((), jnp.int32)

    def draw(self, state, key):
        key_index, key_loss = jax.random.split(key)
        return self.points[jax.random.randint(key_index, (8,), 0, len(self.points))], key_loss

    def loss(self, params, statistics, batch, key):
        x, y = batch[:, 0], batch[:, 1] + 0.1 * jax.random.normal(key, batch[:, 1].shape)
        terms = {"far": jnp.mean((params["slope"] * x + params["height"] - y) ** 2), "wide": params["slope"] ** 2}
        terms = {"loss": terms["far"] + 0.01 * terms["wide"], **terms}
        return terms["loss"], (terms, statistics + len(batch))

    def held_out_terms(self, params, statistics, held_out, key):
        return self.loss(params, statistics, held_out, key)[1][0]


def line(**settings) -> Line:
    x = jnp.linspace(-1.0, 1.0, 20)
    return Line(jnp.stack([x, 2.0 * x + 1.0], axis=-1), LineConfig(**settings))


@pytest.fixture(scope="module")
def finished():
    """State and history after all steps, never interrupted."""
    return optimise(line(), **QUIET)


def largest_change(first, second) -> float:
    pairs = zip(jax.tree.leaves(first), jax.tree.leaves(second), strict=True)
    return max(float(np.abs(np.asarray(a) - b).max()) for a, b in pairs)


def test_history_has_a_row_per_chunk(finished):
    state, history = finished
    assert [row["step"] for row in history] == list(range(2, STEPS + 1, 2))
    assert int(state.step) == STEPS and int(state.statistics) == 8 * STEPS
    for row in history:
        assert row["loss"] == pytest.approx(row["far"] + 0.01 * row["wide"], rel=1e-5)


def test_first_step_is_adams_and_average_follows_by_formula():
    start = initial_state(line())
    one, _ = optimise(line(), stop_after=1, chunk=1, progress=False)
    two, _ = optimise(line(), one, stop_after=2, chunk=1, progress=False)
    # Adam's first step moves every weight by the learning rate, whatever its gradient's size.
    assert largest_change(one.params, start.params) == pytest.approx(1e-2, rel=1e-3)
    leaves = [jax.tree.leaves(t) for t in (start.params, one.params, two.params, one.ema, two.ema)]
    for first, second, third, ema_one, ema_two in zip(*leaves, strict=True):
        expected = 0.9 * first + 0.1 * second
        np.testing.assert_allclose(ema_one, expected, atol=1e-7)
        np.testing.assert_allclose(ema_two, 0.9 * expected + 0.1 * third, atol=1e-7)
    assert same_tree(start.ema, start.params) and one.averaged is one.ema


def test_without_an_average_the_weights_are_what_is_evaluated(finished):
    state, _ = optimise(line(ema_decay=None), **QUIET)
    assert state.ema is None and state.averaged is state.params
    assert same_tree(state.params, finished[0].params)


class Killed(Exception):
    pass


@pytest.mark.parametrize("killed_after", [4, 8])
def test_killed_and_resumed_equals_uninterrupted(finished, tmp_path, killed_after):
    checkpoint = tmp_path / "state.safetensors"

    def kill(row):
        # In the chunk after the checkpoint: a row is told before its state is written.
        if row["step"] == killed_after + 2:
            raise Killed

    with pytest.raises(Killed):
        optimise(line(), checkpoint=checkpoint, checkpoint_every=4, on_chunk=kill, **QUIET)
    assert int(restore_state(checkpoint, line()).step) == killed_after
    resumed, history = optimise(line(), checkpoint=checkpoint, checkpoint_every=4, **QUIET)
    assert [row["step"] for row in history] == list(range(killed_after + 2, STEPS + 1, 2))
    assert same_tree(resumed, finished[0])
    assert history[-1] == finished[1][-1]


def test_when_its_time_is_over_it_stops_with_a_checkpoint(tmp_path):
    checkpoint = tmp_path / "state.safetensors"
    state, history = optimise(line(), checkpoint=checkpoint, stop_at=0.0, **QUIET)
    assert int(state.step) == 2 == int(restore_state(checkpoint, line()).step) and len(history) == 1
    state, _ = optimise(line(), checkpoint=checkpoint, stop_at=float("inf"), **QUIET)
    assert int(state.step) == STEPS


def test_a_finished_run_does_nothing_more(finished, tmp_path):
    checkpoint = tmp_path / "state.safetensors"
    save_state(checkpoint, line(), finished[0])
    content = checkpoint.read_bytes()
    state, history = optimise(line(), checkpoint=checkpoint, **QUIET)
    assert history == [] and same_tree(state, finished[0]) and checkpoint.read_bytes() == content


def test_states_of_other_settings_or_data_are_refused(finished, tmp_path):
    path = tmp_path / "state.safetensors"
    save_state(path, line(), finished[0])
    refused(r"state\.safetensors.*other training settings \(rate, seed\)", restore_state, path, line(seed=1, rate=1.0))
    mine = line().identity()
    assert differences(mine, {**mine, "sizes": [1, 2], "kind": "training state"}) == []
    assert differences(mine, {**mine, "dataset_fingerprint": "other"}) == ["dataset fingerprint"]
    assert differences(mine, {}) == ["training", "dataset fingerprint", "sizes"]
    assert differences(mine, {**mine, "training": {**mine["training"], "more": 1}}) == ["training settings (more)"]
    # An option that is younger than the file, or that it alone knows, changes nothing while it is off.
    younger = lambda value: {**mine, "training": {**mine["training"], "option": value}}
    for off in (False, 0, 0.0, [], None):
        assert differences(younger(off), mine) == differences(mine, younger(off)) == []
    assert differences(younger(True), mine) == ["training settings (option)"]
    assert differences(younger(False), younger(True)) == ["training settings (option)"]


def test_broken_data_stop_training_and_keep_the_checkpoint(tmp_path):
    checkpoint = tmp_path / "state.safetensors"
    optimise(line(), checkpoint=checkpoint, stop_after=4, **QUIET)
    content = checkpoint.read_bytes()
    broken = dataclasses.replace(line(), points=jnp.full((20, 2), jnp.nan))
    with pytest.raises(TrainingDiverged, match=r"line: loss .* step 5 \(terms: far\).*state\.safetensors"):
        optimise(broken, checkpoint=checkpoint, checkpoint_every=4, **QUIET)
    assert checkpoint.read_bytes() == content


@pytest.mark.parametrize("breaks_after, message", [(3, "after step 4"), (2, "at step 4")])
def test_an_infinite_update_is_found_and_never_reaches_the_checkpoint(tmp_path, breaks_after, message):
    checkpoint = tmp_path / "state.safetensors"
    with pytest.raises(TrainingDiverged, match=f"not finite {message}"):
        optimise(line(breaks_after=breaks_after), checkpoint=checkpoint, checkpoint_every=2, **QUIET)
    state = restore_state(checkpoint, line(breaks_after=breaks_after))
    assert int(state.step) == 2 and all(bool(jnp.isfinite(leaf).all()) for leaf in jax.tree.leaves(state.params))


def test_held_out_loss_is_measured_on_the_same_noise_every_time(finished):
    held_out = line().points[::3]
    first = held_out_terms(line(), finished[0], held_out)
    assert first == held_out_terms(line(), finished[0], held_out)
    _, history = optimise(line(), held_out=held_out, checkpoint_every=STEPS // 2, **QUIET)
    assert [row["step"] for row in history if "held_out_loss" in row] == [STEPS // 2, STEPS]
    assert history[-1]["held_out_far"] == pytest.approx(first["far"], rel=1e-6)
