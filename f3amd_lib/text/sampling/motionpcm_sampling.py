"""From noise and a caption to motion by MotionPCM: a student in M jumps, its teacher by DDIM, MotionLCM's way.

All draw a latent; `decode_latent` makes redundant vectors of it, and `text.data.redundant` positions. `latent_motions`
does all of it for a model as its file has it.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from f3amd_lib.diffusion.schedules import NoiseSchedule
from f3amd_lib.text import phases
from f3amd_lib.text.data.redundant import positions_from_redundant
from f3amd_lib.text.data.text_motions import frame_mask
from f3amd_lib.text.networks.motionpcm import LatentAutoencoder, LatentDenoiser
from f3amd_lib.text.stages.text_models import LatentModel
from f3amd_lib.training.checkpoints import network_with

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
      empty: embedding of the empty caption, [W], or 0.
      guidance: w.
    """
    told, free = teacher.encode(text), teacher.encode(jnp.broadcast_to(empty, text.shape))
    if guidance == 0.0:
        return lambda state, time: teacher(state, time, told)
    return lambda state, time: phases.guided_noise(teacher(state, time, told), teacher(state, time, free), guidance)


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
    visited = phases.cut_phases(len(schedule.levels), skip, num_steps).visited
    return phases.follow(student_prediction(student, text, guidance), schedule, noise, visited)


def sample_teacher(
    teacher: LatentDenoiser, schedule: NoiseSchedule, text, empty, noise, *, num_steps: int = 50,
    guidance=TEACHER_GUIDANCE, spacing: str = "trailing",
):  # fmt: skip
    """Draw latents by DDIM with guidance; arguments as of `teacher_prediction` and `phases.ddim_times`."""
    times = phases.ddim_times(len(schedule.levels), num_steps, spacing)
    return phases.follow(teacher_prediction(teacher, text, empty, guidance), schedule, noise, times)


def sample_latent_student(student: LatentDenoiser, schedule: NoiseSchedule, text, noise, key, *, num_steps=1, guidance):
    """Draw latents as MotionLCM V2 does, with fresh noise between steps; its guidance minus 1 is our w.

    Args:
      student: distilled with consistency "latent".
      schedule, text, noise, guidance: as for `sample_student`.
      key: of the fresh noise.
      num_steps: 1, 2 or 4 (`phases.LATENT_CONSISTENCY_TIMES`).
    """
    predict = student_prediction(student, text, guidance)
    return phases.sample_latent_consistency(predict, schedule, noise, phases.LATENT_CONSISTENCY_TIMES[num_steps], key)


def decode_latent(autoencoder: LatentAutoencoder, statistics, latent, mask):
    """Return redundant vectors [B, L, 12 J - 1] of latents; frames beyond the mask [B, L] mean nothing.

    Args:
      autoencoder: whose latents they are.
      statistics: `text.stages.motionpcm_training.frame_statistics` of its features.
      latent: [B, window, channels].
      mask: frames to make, [B, L].
    """
    return statistics.restore(autoencoder.decode(latent, mask))


TEACHER_STEPS = 50
"""Of DDIM, where nothing else is asked (MotionPCM section 4.1)."""

LATENT_CONSISTENCY_GUIDANCE = {1: 7.0, 2: 11.5, 4: 12.5}
"""w by number of steps that is MotionLCM V2's guidance of 8, 12.5 and 13.5 (released configuration)."""


def steps_of(trained: LatentModel, num_steps: int | None = None) -> int:
    """Return the steps that a model takes: a student its M, MotionLCM's 1, 2 or 4, a teacher as many as are asked for.

    Args:
      trained: a teacher or a student.
      num_steps: asked for; by default the model's own: M, 1 or 50.

    Raises:
      ValueError: for an autoencoder alone, or a number of steps that a student was not trained for.
    """
    if trained.config is None:
        raise ValueError(f"{trained.name} is an autoencoder alone: it needs a teacher or a student to make motion")
    levels, told = len(trained.schedule.levels), trained.training
    if not trained.config.guidance_features:
        fits, own = range(1, levels + 1), min(TEACHER_STEPS, levels)
    elif told["consistency"] == "latent":
        fits, own = tuple(phases.LATENT_CONSISTENCY_TIMES), 1
    else:
        fits, own = (told["num_phases"],), told["num_phases"]
    if (num_steps or own) not in fits:
        known = " or ".join(map(str, fits)) if len(fits) < 4 else f"1 to {levels}"
        raise ValueError(f"{trained.name} takes {known} steps, got {num_steps}; see f3amd presets --paper motionpcm")
    return num_steps or own


def guidance_of(trained: LatentModel, num_steps: int, guidance: float | None = None) -> float:
    """Return w of MotionPCM Eq. 11 that a model is told.

    Args:
      trained: a teacher or a student.
      num_steps: as `steps_of` has it.
      guidance: asked for; by default the paper's 14 of a student, 6.5 of a teacher, MotionLCM's own.

    Raises:
      ValueError: for a guidance that a student was never told in its training; a teacher is guided by any.
    """
    told = trained.training
    if not trained.config.guidance_features:
        return TEACHER_GUIDANCE if guidance is None else guidance
    if guidance is None:
        return LATENT_CONSISTENCY_GUIDANCE[num_steps] if told["consistency"] == "latent" else STUDENT_GUIDANCE
    least, most = told["least_guidance"], told["most_guidance"]
    if not least <= guidance <= most:
        raise ValueError(f"{trained.name} was trained with a guidance of {least:g} to {most:g}, got {guidance:g}")
    return guidance


def latent_walk(trained: LatentModel, num_steps: int | None = None, guidance: float | None = None) -> Callable:
    """Return `walk(network, text, noise, key)`: from noise to latents [B, window, channels], as the model was trained.

    Args:
      trained: a teacher or a student; a teacher goes by DDIM, MotionLCM's student with fresh noise from the key.
      num_steps: as `steps_of` has it.
      guidance: as `guidance_of` has it.

    Raises:
      ValueError: as `steps_of` and `guidance_of`.
    """
    steps, schedule = steps_of(trained, num_steps), trained.schedule
    how = {"num_steps": steps, "guidance": guidance_of(trained, steps, guidance)}
    if not trained.config.guidance_features:
        return lambda network, text, noise, key: sample_teacher(network, schedule, text, trained.empty, noise, **how)
    if trained.training["consistency"] == "latent":
        return lambda network, text, noise, key: sample_latent_student(network, schedule, text, noise, key, **how)
    skip = trained.training["skip"]
    return lambda network, text, noise, key: sample_student(network, schedule, text, noise, skip=skip, **how)


def latent_sampler(trained: LatentModel, num_steps: int | None = None, guidance: float | None = None) -> Callable:
    """Return `draw(text, mask, key)`, compiled once for a shape: redundant vectors [B, L, 12 J - 1].

    Arguments and errors are those of `latent_walk`.
    """
    config, walk = trained.config, latent_walk(trained, num_steps, guidance)

    @jax.jit
    def draw(params, autoencoder, text, mask, key):
        key_noise, key_fresh = jax.random.split(key)
        noise = jax.random.normal(key_noise, config.state_shape(len(text)))
        latent = walk(network_with(config, params), text, noise, key_fresh)
        return decode_latent(network_with(trained.autoencoder, autoencoder), trained.statistics, latent, mask)

    return lambda text, mask, key: draw(trained.params, trained.autoencoder_params, jnp.asarray(text), mask, key)


def latent_motions(trained: LatentModel, pooled, num_frames, key, *, draw: Callable | None = None, **how) -> np.ndarray:
    """Draw a motion for each caption.

    Args:
      trained: a teacher or a student.
      pooled: captions, [B, W].
      num_frames: of each motion, [B] or one for all.
      key: JAX random key.
      draw: a `latent_sampler` of the model that is compiled already.
      **how: num_steps and guidance of a new one.

    Returns:
      Positions, [B, L, J, 3], metres, starting over the origin facing +Z; L the longest; 0 in the padding.

    Raises:
      ValueError: as `latent_sampler`, or for more frames than the model was trained on.
    """
    lengths = np.broadcast_to(num_frames, len(pooled))
    if lengths.max() > trained.most_frames:
        raise ValueError(f"{trained.name} makes up to {trained.most_frames} frames, got {lengths.max()}")
    mask = frame_mask(lengths, int(lengths.max()))
    vectors = (draw or latent_sampler(trained, **how))(pooled, mask, key)
    return positions_from_redundant(np.asarray(vectors)) * np.asarray(mask)[..., None, None]


def reconstruction(trained: LatentModel, vectors, mask) -> tuple[np.ndarray, np.ndarray]:
    """Return what an autoencoder makes of motions, by the mean of its latent.

    Args:
      trained: any model of the paper; its autoencoder is asked.
      vectors: redundant vectors, [B, L, 12 J - 1].
      mask: frames that are motion, [B, L].

    Returns:
      (redundant vectors; positions [B, L, J, 3], metres), which mean nothing in the padding.
    """

    @jax.jit
    def draw(params, vectors):
        autoencoder, features = network_with(trained.autoencoder, params), trained.statistics.normalise(vectors)
        mean, _ = autoencoder.encode(features * mask[..., None], mask)
        made = decode_latent(autoencoder, trained.statistics, mean, mask)
        return made, positions_from_redundant(made)

    return tuple(map(np.asarray, draw(trained.autoencoder_params, jnp.asarray(vectors))))
