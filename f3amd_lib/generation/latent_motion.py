"""From noise and a caption to motion by MotionPCM: a student in M jumps, its teacher by DDIM, MotionLCM's way.

All draw a latent; `decode_latent` makes redundant vectors of it, and `motion.redundant` positions.
"""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp

from f3amd_lib.diffusion.phases import (
    LATENT_CONSISTENCY_TIMES,
    cut_phases,
    ddim_times,
    follow,
    guided_noise,
    sample_latent_consistency,
)
from f3amd_lib.diffusion.schedules import NoiseSchedule
from f3amd_lib.networks.motionpcm import LatentAutoencoder, LatentDenoiser

Predict = Callable[[jax.Array, jax.Array], jax.Array]

STUDENT_GUIDANCE = 14.0
"""w that a student is told in the paper's tests (MotionPCM section 5)."""

TEACHER_GUIDANCE = 6.5
"""w of Eq. 11 that is MotionLCM V2's guidance of 7.5 for the teacher: that scale counts from the empty caption."""


def student_prediction(student: LatentDenoiser, text, guidance=STUDENT_GUIDANCE) -> Predict:
    """Return the noise that a student sees under captions [B, W]: one network call, guided as it is told."""
    context, told = student.encode(text), jnp.broadcast_to(jnp.asarray(guidance, jnp.float32), len(text))
    return lambda state, time: student(state, time, context, told)


def teacher_prediction(teacher: LatentDenoiser, text, empty, guidance=TEACHER_GUIDANCE) -> Predict:
    """Return the noise that a guided teacher sees (MotionPCM Eq. 11): two calls, or one with guidance 0.

    Args:
      teacher: the network.
      text: embeddings of captions, [B, W].
      empty: embedding of the empty caption, [W].
      guidance: w.
    """
    told, free = teacher.encode(text), teacher.encode(jnp.broadcast_to(empty, text.shape))
    if guidance == 0.0:
        return lambda state, time: teacher(state, time, told)
    return lambda state, time: guided_noise(teacher(state, time, told), teacher(state, time, free), guidance)


def sample_student(
    student: LatentDenoiser, schedule: NoiseSchedule, text, noise, *, num_steps: int = 1, skip: int = 100,
    guidance=STUDENT_GUIDANCE,
):  # fmt: skip
    """Draw latents in M jumps along the edges that a student was trained with (MotionPCM section 4.4).

    Args:
      student, schedule: trained together; the student with as many phases as there are steps.
      text: embeddings of captions, [B, W].
      noise: standard normal, [B, window, channels]; with the captions it decides the answer.
      num_steps: M.
      skip: k of the training: it says where phases end.
      guidance: w.
    """
    visited = cut_phases(len(schedule.levels), skip, num_steps).visited
    return follow(student_prediction(student, text, guidance), schedule, noise, visited)


def sample_teacher(
    teacher: LatentDenoiser, schedule: NoiseSchedule, text, empty, noise, *, num_steps: int = 50,
    guidance=TEACHER_GUIDANCE, spacing: str = "trailing",
):  # fmt: skip
    """Draw latents by DDIM with guidance; arguments as of `teacher_prediction` and `phases.ddim_times`."""
    times = ddim_times(len(schedule.levels), num_steps, spacing)
    return follow(teacher_prediction(teacher, text, empty, guidance), schedule, noise, times)


def sample_latent_student(student: LatentDenoiser, schedule: NoiseSchedule, text, noise, key, *, num_steps=1, guidance):
    """Draw latents as MotionLCM V2 does, with fresh noise between steps; its guidance minus 1 is our w.

    Args:
      student: distilled with consistency "latent".
      schedule, text, noise, guidance: as for `sample_student`.
      key: of the fresh noise.
      num_steps: 1, 2 or 4 (`phases.LATENT_CONSISTENCY_TIMES`).
    """
    predict = student_prediction(student, text, guidance)
    return sample_latent_consistency(predict, schedule, noise, LATENT_CONSISTENCY_TIMES[num_steps], key)


def decode_latent(autoencoder: LatentAutoencoder, statistics, latent, mask):
    """Return redundant vectors [B, L, 12 J - 1] of latents; frames beyond the mask [B, L] mean nothing.

    Args:
      autoencoder: whose latents they are.
      statistics: `training.latent_motion.FrameStatistics` of its features.
      latent: [B, window, channels].
      mask: frames to make, [B, L].
    """
    return statistics.restore(autoencoder.decode(latent, mask))
