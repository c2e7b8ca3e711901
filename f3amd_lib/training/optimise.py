"""The one optimise loop: steps under a scan, moving average, exact resume (section 4.5).

What is trained is a task, a small value that draws batches and knows its loss. The loop adds what
all trainings share: the optimiser's step, the moving average, checkpoints, progress, a stop at a
time or at the first number that is none, and several devices. The state is a value; `optimise`
advances it in chunks of jitted steps that draw their batches on the device. Every random number of
step k comes from the seed and k alone, so that a run that was killed and resumed gives the same
weights as one that was not.
"""

import dataclasses
import functools
import json
import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import nnx
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from tqdm import tqdm

from f3amd_lib.ground.trees import load_tree, save_tree
from f3amd_lib.networks.config import with_fast_gradient
from f3amd_lib.networks.presets import build_from_config

SPREAD, EVERYWHERE = PartitionSpec("batch"), PartitionSpec()
"""How arrays lie: over the devices along their first axis, or as a whole on each of them."""


class TrainingDiverged(ArithmeticError):
    """The loss stopped being a number; the message names the step, the term and the checkpoint."""


class TrainingState(NamedTuple):
    """All that changes in training.

    Attributes:
      params: weights.
      ema: their moving average; None where the task has none.
      optimiser: optax state.
      step: steps done, int32 scalar.
      statistics: what else a network keeps, such as batch statistics; None where it keeps nothing.
    """

    params: Any
    ema: Any
    optimiser: Any
    step: jax.Array
    statistics: Any = None

    @property
    def averaged(self):
        """The weights to evaluate and to ship: the moving average, where there is one."""
        return self.params if self.ema is None else self.ema


class Task:
    """One training, as a JAX tree: its data are leaves, all else is static and compared by value.

    Weights are any tree, and so are several players: one branch each, with a loss that stops the
    gradient where it should not flow, and an optimiser that treats branches differently
    (`optax.partition`; `optax.set_to_zero` freezes one).

    Here is what trainings of one network share. Such a one has a `model_config`, and says what it is, what is drawn and
    how that is judged:
      identity(): all that decides the weights, JSON-ready, so that a state is resumed only where it belongs.
      draw(state, key): (batch, key of the loss); arrays of a batch have the samples first.
      terms(params, batch, key, training=True): loss terms by name, "loss" among them, of what `draw` drew or, out of
        training, of held-out data.
    Any other class that has a name, a config and these methods is a task as well.

    Attributes:
      name: of what is trained, for progress bars and errors.
      config: settings: `num_steps` in all, `ema_decay` of the moving average of the weights (None keeps none), `seed`
        of initial weights and batches, and `optimiser()`.
    """

    name: ClassVar[str]

    @property
    def optimiser(self) -> optax.GradientTransformation:
        """What turns gradients into updates, as the config says."""
        return self.config.optimiser()

    def init(self, key) -> tuple[Any, Any]:
        """Return (weights, statistics) before the first step; no network here keeps statistics."""
        return nnx.state(build_from_config(self.model_config, key)), None

    def loss(self, params, statistics, batch, key) -> tuple[jax.Array, tuple[dict, Any]]:
        """Return (loss, (terms by name with "loss" among them, statistics after the step)) of what `draw` drew."""
        terms = self.terms(params, batch, key)
        return terms["loss"], (terms, statistics)

    def held_out_terms(self, params, statistics, held_out, key) -> dict:
        """Return terms by name on held-out data, without what only training does; asked where such data are given."""
        return self.terms(params, held_out, key, training=False)


def frozen_tree(*data: str):
    """Make a class a frozen dataclass and a JAX tree: the fields of these names are leaves, all else is static."""

    def as_tree(cls: type) -> type:
        cls = dataclasses.dataclass(frozen=True, eq=False)(cls)
        static = [field.name for field in dataclasses.fields(cls) if field.name not in data]
        return jax.tree_util.register_dataclass(cls, data_fields=data, meta_fields=static)

    return as_tree


@jax.jit
def _copied(tree):
    """Return a tree of arrays of its own, copied by one program instead of one for each shape."""
    return jax.tree.map(jnp.copy, tree)


def all_devices() -> Mesh:
    """Return a mesh of every device, one axis long, over which batches are spread.

    Weights and windows lie on each device, and XLA adds up the gradients. Every random number belongs to a step and a
    sample, not to a device, so that the weights are those of one device up to the order of sums.
    """
    return Mesh(np.array(jax.devices()), tuple(SPREAD))


def replicate(tree, mesh: Mesh | None):
    """Return copies of arrays on every device of a mesh; without one they stay as they are."""
    return tree if mesh is None else jax.device_put(_copied(tree), NamedSharding(mesh, EVERYWHERE))


def _laid(tree, mesh: Mesh | None, places: PartitionSpec):
    """Ask, inside jit, that arrays lie on the devices of a mesh as `SPREAD` or `EVERYWHERE` says."""
    return tree if mesh is None else jax.lax.with_sharding_constraint(tree, NamedSharding(mesh, places))


def initial_state(task: Task, mesh: Mesh | None = None) -> TrainingState:
    """Return the state before the first step, on every device of the mesh."""
    # Not compiled as a whole: that takes seconds for each network, and the programs of its layers are few.
    params, statistics = task.init(jax.random.fold_in(jax.random.key(task.config.seed), 0))
    params = _copied(params)  # a student begins with weights that stay its teacher's
    ema = None if task.config.ema_decay is None else _copied(params)
    state = TrainingState(params, ema, task.optimiser.init(params), jnp.zeros((), jnp.int32), statistics)
    return replicate(state, mesh)


@functools.partial(jax.jit, static_argnames=("length", "mesh"), donate_argnames="state")
def advance(task: Task, state: TrainingState, length: int, mesh: Mesh | None = None) -> tuple[TrainingState, dict]:
    """Train some steps in one program, without checkpoints or checks (see `optimise`).

    Args:
      task: what to train; its data lie on every device of the mesh.
      state: where to start; its arrays are given away.
      length: steps.
      mesh: devices that share each batch.

    Returns:
      (state, every loss term of every step, [length] each).
    """
    decay, base = task.config.ema_decay, jax.random.fold_in(jax.random.key(task.config.seed), 1)
    fast = lambda weight: with_fast_gradient(weight) if jnp.ndim(weight) == 2 else weight

    def one_step(state: TrainingState, _):
        batch, key = task.draw(state, jax.random.fold_in(base, state.step))
        batch = _laid(batch, mesh, SPREAD)
        loss = lambda params, *rest: task.loss(jax.tree.map(fast, params), *rest)
        gradient, (terms, statistics) = jax.grad(loss, has_aux=True)(state.params, state.statistics, batch, key)
        updates, optimiser = task.optimiser.update(gradient, state.optimiser, state.params)
        params = optax.apply_updates(state.params, updates)
        ema = None if decay is None else optax.incremental_update(params, state.ema, 1.0 - decay)
        return TrainingState(params, ema, optimiser, state.step + 1, statistics), terms

    return _laid(jax.lax.scan(one_step, state, None, length=length), mesh, EVERYWHERE)


@jax.jit
def _held_out_terms(task: Task, params, statistics, held_out, key) -> dict:
    return task.held_out_terms(params, statistics, held_out, key)


def held_out_terms(task: Task, state: TrainingState, held_out, mesh: Mesh | None = None) -> dict[str, float]:
    """Return the mean loss terms on held-out data, with the same noise every time.

    Args:
      task: what is trained.
      state: whose moving average is measured (the weights where there is none).
      held_out: data of another split than the one trained on.
      mesh: devices that the state lies on.
    """
    terms = _held_out_terms(task, state.averaged, state.statistics, replicate(held_out, mesh), jax.random.key(7))
    return {name: float(value) for name, value in terms.items()}


def save_state(path: Path, task: Task, state: TrainingState) -> None:
    """Write the whole training state; an interrupted write leaves the old file whole."""
    save_tree(path, state, {"kind": "training state", **task.identity()})


def restore_state(path: Path, task: Task, mesh: Mesh | None = None) -> TrainingState:
    """Read a state written by `save_state`.

    Raises:
      ValueError: if the file is broken, or was made with other settings or on other data.
    """

    def template(metadata: dict):
        if unlike := differences(task.identity(), metadata):
            raise ValueError(
                f"{path}: checkpoint was made with other {'; '.join(unlike)}; choose another file or the old settings"
            )
        return jax.eval_shape(initial_state, task)

    return replicate(load_tree(path, template)[0], mesh)


def differences(identity: dict, description: dict) -> list[str]:
    """Say in what a file is unlike a task, such as "training settings (batch_size, seed)".

    Args:
      identity: of the task.
      description: of the file; what it tells beside the task's identity does not matter, nor does a setting that one
        of the two does not know, as one younger than the file, if that is off (false, 0 or empty).
    """
    unlike = []
    for part in identity:
        # Files have lists where settings have tuples.
        ours, theirs = (json.loads(json.dumps(of.get(part))) for of in (identity, description))
        if isinstance(ours, dict) and isinstance(theirs, dict):
            names = sorted(ours.keys() | theirs.keys())
            if changed := [name for name in names if _known(ours.get(name)) != _known(theirs.get(name))]:
                unlike.append(f"{part} settings ({', '.join(changed)})")
        elif ours != theirs:
            unlike.append(part.replace("_", " "))
    return unlike


def _known(setting):
    """Return a setting without what is off in it; None where it is off itself."""
    inside = isinstance(setting, dict)
    return ({name: _known(value) for name, value in setting.items() if value} if inside else setting) or None


def optimise(
    task: Task, state: TrainingState | None = None, *, checkpoint: Path | None = None, checkpoint_every: int = 500,
    held_out=None, chunk: int = 50, stop_after: int | None = None, stop_at: float | None = None,
    mesh: Mesh | None = None, on_chunk: Callable[[dict], None] | None = None, progress: bool = True,
) -> tuple[TrainingState, list[dict]]:  # fmt: skip
    """Train to the number of steps that the task's config says.

    Args:
      task: what to train.
      state: where to start; by default the checkpoint if it exists, else the beginning.
      checkpoint: file to write the state to, every `checkpoint_every` steps and at the end.
      checkpoint_every: steps between checkpoints and held-out evaluations.
      held_out: data to evaluate on, of the kind that the task knows.
      chunk: steps per jitted scan.
      stop_after: stop once this many steps are done in all.
      stop_at: stop, with a checkpoint, at the end of the first chunk after this time
        (`time.monotonic`).
      mesh: devices to spread each batch over (`all_devices`); by default one does it all.
      on_chunk: called with each history row as it is made, before the state of its step is written.
      progress: show a progress bar.

    Returns:
      (state, history): one row per chunk with step, mean of every loss term, and the held-out
      loss where it was measured.

    Raises:
      TrainingDiverged: at the first loss or weight that is not finite; the checkpoint on disk
        is from before.
    """
    if chunk < 1 or checkpoint_every < 1:
        raise ValueError(f"chunk and checkpoint_every must be at least 1, got {chunk} and {checkpoint_every}")
    task = replicate(task, mesh)
    if state is not None:
        # The chunk donates its input; what the caller holds must stay alive.
        state = _copied(state)
    elif checkpoint is not None and Path(checkpoint).exists():
        state = restore_state(checkpoint, task, mesh)
    else:
        state = initial_state(task, mesh)
    total = min(task.config.num_steps, math.inf if stop_after is None else stop_after)
    done, history, late = int(state.step), [], False
    with tqdm(total=total, initial=done, unit="step", desc=task.name, disable=not progress) as bar:
        while done < total and not late:
            # Chunks end on multiples, so that a resumed run makes the same ones.
            length = min(chunk - done % chunk, total - done)
            state, terms = advance(task, state, length, mesh)
            terms = {name: np.asarray(value) for name, value in terms.items()}
            if broken := _what_is_broken(done, terms, state):
                kept = checkpoint is not None and Path(checkpoint).exists()
                kept = f"; the last good state is in {checkpoint}" if kept else ""
                advice = "lower the learning rate or check the data for broken frames"
                raise TrainingDiverged(f"{task.name}: {broken}: {advice}{kept}")
            passed = (done + length) // checkpoint_every > done // checkpoint_every
            done += length
            row = {"step": done, **{name: float(value.mean()) for name, value in terms.items()}}
            late = stop_at is not None and time.monotonic() >= stop_at
            due = passed or done == total or late
            if due and held_out is not None:
                measured = held_out_terms(task, state, held_out, mesh)
                row.update({f"held_out_{name}": value for name, value in measured.items()})
            history.append(row)
            # Before the state: a run killed between the two finds a row too many, never one too few.
            if on_chunk is not None:
                on_chunk(row)
            if due and checkpoint is not None:
                save_state(checkpoint, task, state)
            bar.update(length)
            bar.set_postfix(loss=f"{row['loss']:.4f}")
    return state, history


def _what_is_broken(done: int, terms: dict, state: TrainingState) -> str | None:
    """Say which step of a chunk made the loss or the weights something else than numbers, if one did."""
    bad = ~np.isfinite(terms["loss"])
    if bad.any():
        first = int(np.argmax(bad))
        guilty = [name for name in terms if name != "loss" and not np.isfinite(terms[name][first])]
        terms = f" (terms: {', '.join(guilty)})" if guilty else ""
        return f"loss is not finite at step {done + first + 1}{terms}"
    # The loss of the last step is from before its update.
    if not all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(state.params)):
        return f"weights are not finite after step {done + len(bad)}"
    return None
