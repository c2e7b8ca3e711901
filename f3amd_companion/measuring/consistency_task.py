"""Distil a trained denoiser of locomotion into few steps: phased consistency along its own walk (MotionPCM).

The student begins as its teacher. The walk is cut into as many phases as the student will take steps. At a level of
the teacher's grid the student is asked for the end of the phase, and its jump has to go where its moving average goes
from a step of the teacher's further on; from the last level of a phase that step is the end itself. How far two answers
are apart, the teacher's own training loss says, with the answer in the data's place.
"""

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd

from f3amd_lib.data.windows import spread_windows
from f3amd_lib.diffusion.samplers import add_noise
from f3amd_lib.ground.profiles import Profile
from f3amd_lib.ground.trees import describe, weights_digest
from f3amd_lib.text.phases import consistency_answer
from f3amd_lib.training.checkpoints import TrainedModel, network_with
from f3amd_lib.training.denoising_task import DenoisingTask, network_inputs
from f3amd_lib.training.optimise import Task, TrainingState, differences, frozen_tree
from f3amd_lib.training.pipeline import PreparedData, model_files, set_aside_run, train_and_keep
from f3amd_lib.training.recipe import paper_recipe

TEACHER_STEPS = 8
"""Levels of the teacher's walk: the steps that F3AMD's tables count as many."""

STUDENT_SPACING = "uniform"
"""Where a student's steps lie (see the schedule's `times`): one at the beginning of each phase."""

_HELD_OUT_WINDOWS = 128


@frozen_tree("denoising", "teacher")
class ConsistencyTask(Task):
    """A student of one step a phase, to distil from a frozen denoiser.

    Attributes:
      denoising: the teacher's own training: network, windows, disturbances, loss. Its moving average is the target.
      teacher: frozen weights, with which the student begins.
      num_teacher_steps: levels of the walk that is distilled, N.
      num_phases: M, the steps that the student will take.

    Raises:
      ValueError: unless M divides N, and the student's own grid of M steps visits the edges of the phases.

    Source: MotionPCM section 4.2 without a discriminator, in the variance-exploding state.
    """

    name = "student of few steps"

    denoising: DenoisingTask
    teacher: Any
    num_teacher_steps: int = TEACHER_STEPS
    num_phases: int = 1

    def __post_init__(self):
        steps, phases, diffusion = self.num_teacher_steps, self.num_phases, self.denoising.config.diffusion
        visited, edges = diffusion.grid(phases, STUDENT_SPACING), diffusion.grid(steps)[:: max(1, steps // phases)]
        if visited.shape != edges.shape or not np.allclose(visited, edges):
            raise ValueError(f"{steps} steps cannot be cut into {phases} equal phases: take 1")

    @property
    def config(self):
        """How it is trained; the loop reads steps, seed and moving average."""
        return self.denoising.config

    def identity(self) -> dict:
        """Return all that decides the weights."""
        walk = {"num_teacher_steps": self.num_teacher_steps, "num_phases": self.num_phases}
        return self.denoising.identity() | {"teacher": walk | {"weights": weights_digest(self.teacher)}}

    def init(self, key):
        """Return the teacher's weights."""
        return self.teacher, None

    def draw(self, state: TrainingState, key):
        """Draw windows as the teacher saw them, and the target's weights; return with the key of the loss."""
        (batch, _), key_loss = self.denoising.draw(state, key)
        return (batch, state.ema), key_loss

    def terms(self, params, drawn, key, training=True) -> dict:
        """Return the mean loss terms.

        Args:
          params: weights.
          drawn: what `draw` drew; out of training windows of another split, on which weights answer against themselves.
          key: of levels, noise and disturbances.
          training: whether this is a step of training.
        """
        batch, target = drawn if training else (spread_windows(drawn, _HELD_OUT_WINDOWS), params)
        task, config = self.denoising, self.denoising.config
        key_point, key_noise, key_history = jax.random.split(key, 3)
        x0, condition = network_inputs(batch, task.normaliser)
        if training:
            condition = task._disturbed(condition, key_history)

        def denoiser(weights):
            network = network_with(task.model_config, weights)
            context = network.encode(condition)
            return lambda x_noisy, sigma: network(x_noisy, sigma, context)

        student, answering, teacher = map(denoiser, (params, target, self.teacher))
        levels = jnp.asarray(config.diffusion.grid(self.num_teacher_steps), jnp.float32)
        point = jax.random.randint(key_point, (len(x0),), 0, self.num_teacher_steps)
        of_phase = self.num_teacher_steps // self.num_phases
        sigma, sigma_next, sigma_edge = (levels[n] for n in (point, point + 1, (point // of_phase + 1) * of_phase))
        x_noisy = add_noise(x0, sigma[:, None, None], jax.random.normal(key_noise, x0.shape))
        answer = consistency_answer(teacher, answering, x_noisy, sigma, sigma_next, sigma_edge)
        answer = jax.lax.stop_gradient(answer)
        return task.compared(student(x_noisy, sigma), answer, task.normaliser.denormalise(answer), batch)


def distil(
    prepared: PreparedData, profile: Profile, teacher: TrainedModel, folder, *, num_steps: int, num_phases: int = 1,
    batch_size: int = 64, learning_rate: float = 2e-4, ema_decay: float = 0.95, **leg,
) -> tuple[TrainedModel | None, pd.DataFrame]:  # fmt: skip
    """Distil a trained model into one step a phase, going on from a training state if there is one.

    Args:
      prepared: the data that it was trained on.
      profile: names the data set, and gives the seed.
      teacher: the model; its own training loss and disturbances are kept.
      folder: where files go.
      num_steps, num_phases, batch_size, learning_rate, ema_decay: of the distillation.
      **leg: stop_at and progress, as for `optimise`.

    Returns:
      (student, history); the student is None where `stop_at` came first.

    Raises:
      ValueError: for phases that the task refuses. A state of other settings or another teacher is set aside.
    """
    settings = {"batch_size": batch_size, "learning_rate": learning_rate, "ema_decay": ema_decay, "seed": profile.seed}
    config = paper_recipe(teacher.name, num_steps, schedule="warmup_cosine", warmup_steps=20, **settings)
    denoising = prepared.task(teacher.name, config, normaliser=teacher.normaliser)
    task = ConsistencyTask(denoising, teacher.params, num_phases=num_phases)
    files = model_files(profile, teacher.name, folder=Path(folder))
    if files.state.exists() and differences(task.identity(), describe(files.state)):
        set_aside_run(files)
    about = {"distilled_from": weights_digest(teacher.params), "num_phases": num_phases}
    return train_and_keep(prepared, profile, teacher.name, task, files, about, **leg)
