"""Phased consistency: a diffusion's path cut into phases, and one jump from anywhere in a phase to its end.

Times are numbers of the levels of a variance-preserving schedule, 0 the least noisy, as MotionPCM counts them. Networks
predict the noise.

Source: MotionPCM section 3, section 4.2 and Appendix A.1 (Jiang et al. 2025), after PCM (Wang et al. 2024); MotionLCM's
consistency, its baseline (Dai et al. 2024).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from f3amd_lib.diffusion.predictions import clean_estimate, on_grid
from f3amd_lib.diffusion.samplers import ddim_step, sample
from f3amd_lib.diffusion.schedules import NoiseSchedule
from f3amd_lib.ground.arrays import array_module, jax, jnp
from f3amd_lib.ground.names import check_known


class Phases(NamedTuple):
    """Where a solver stops on the way from noise to data, and where the phases end.

    Attributes:
      times: t_i, the N points at which a student is asked, rising, [N].
      before: the point that the solver goes to from each of them, [N]; from the first it is time 0.
      phase: number of the phase of each point, [N].
      first: whether a point is the first of its phase, so that the solver goes from it to the phase's end, [N].
      edges: s_0 ... s_M, the end of each phase and the noisiest time, [M + 1].
    """

    times: np.ndarray
    before: np.ndarray
    phase: np.ndarray
    first: np.ndarray
    edges: np.ndarray

    @property
    def visited(self) -> np.ndarray:
        """Times of an M-step sampler, falling from the noisiest to 0, [M + 1]."""
        return self.edges[::-1]


def cut_phases(num_levels: int = 1000, skip: int = 100, num_phases: int = 1) -> Phases:
    """Cut a path of N = num_levels / skip solver points into phases, each a consistency model (MotionPCM Eqs 4 and 5).

    Phase j begins at point floor(j N / M): where M does not divide N, phases are not of one length.

    Args:
      num_levels: of the schedule, T.
      skip: levels that one step of the solver passes, k.
      num_phases: M.

    Raises:
      ValueError: unless k divides T, and there is a point for every phase.
    """
    if skip < 1 or num_levels % skip or not 1 <= num_phases <= num_levels // skip:
        wanted = f"a skip that divides {num_levels} levels, and 1 to {num_levels // max(1, skip)} phases"
        raise ValueError(f"phases need {wanted}; got skip={skip}, num_phases={num_phases}")
    times = np.arange(skip - 1, num_levels, skip)
    before = np.append(0, times[:-1])
    points = np.arange(num_phases) * len(times) // num_phases
    phase = np.searchsorted(points, np.arange(len(times)), side="right") - 1
    return Phases(times, before, phase, np.isin(np.arange(len(times)), points), np.append(before[points], times[-1]))


def shares(schedule: NoiseSchedule, time, xp=jnp):
    """Return (alpha, sigma) at level numbers, any shape: float32 of JAX, or with xp=numpy float64.

    Args:
      schedule: a variance-preserving one of K levels.
      time: level numbers, 0 to K - 1.
      xp: array module.
    """
    alpha_bar = schedule.alpha_bars[time] if xp is np else jnp.asarray(schedule.alpha_bars, jnp.float32)[time]
    return xp.sqrt(alpha_bar), xp.sqrt(1.0 - alpha_bar)


def beside(x, state):
    """Return x [B] or a scalar so that it broadcasts against a state [B, ...]."""
    return x if np.ndim(x) == 0 else x.reshape(-1, *[1] * (state.ndim - 1))


def noised(schedule: NoiseSchedule, x0, noise, time):
    """Return alpha x0 + sigma noise at level numbers `time`, [B] or a scalar; x0 and noise [B, ...]."""
    alpha, sigma = (beside(share, x0) for share in shares(schedule, time, array_module(x0, noise)))
    return alpha * x0 + sigma * noise


def jump(schedule: NoiseSchedule, state, eps, time, time_next):
    """Move a state along the straight line that one noise estimate says (MotionPCM Eqs 8, 10, 15, 16 and 19).

        x0 = (z - sigma eps) / alpha,   z' = alpha' x0 + sigma' eps

    To the end of a phase it is the consistency map f_m, to the solver's next point a step of DDIM (Lemma 1). From a
    time to itself it is the identity, for any eps.

    Args:
      schedule: of K levels.
      state, eps: state and estimate of its noise, [B, ...], both numpy or both JAX.
      time, time_next: level numbers, [B] or scalars.
    """
    xp = array_module(state, eps)
    (alpha, sigma), (alpha_next, sigma_next) = (
        (beside(x, state) for x in shares(schedule, t, xp)) for t in (time, time_next)
    )
    return alpha_next * clean_estimate("eps", eps, state, alpha, sigma) + sigma_next * eps


def guided_noise(conditional, unconditional, w):
    """Return (1 + w) e_c - w e_null (MotionPCM Eq. 11): w = 0 is the condition alone; w [B] or a scalar."""
    w = beside(w, conditional)
    return (1.0 + w) * conditional - w * unconditional


def target_end(schedule: NoiseSchedule, state, eps, time, edge):
    """Return what the target network says of a phase's end: the state itself where it is there (Algorithm 1).

    The online network always jumps; that `jump` is the identity at the edge anyway only holds up to rounding.

    Args:
      schedule, state, eps, time: as of `jump`.
      edge: time of the phase's end, like time.
    """
    return array_module(state, eps).where(beside(time <= edge, state), state, jump(schedule, state, eps, time, edge))


def consistency_answer(teacher: Callable, target: Callable, x_noisy, sigma, sigma_next, sigma_edge=0.0):
    """Return what a student's denoiser has to say at a point of its teacher's walk: MotionPCM's target.

    The teacher takes one DDIM step, and the target jumps from there to the end of the phase; at the end itself it is
    not heard. The answer is the clean estimate whose straight line leads from x_noisy to that same end. The state is
    the variance-exploding one: with one phase, whose end is level 0, that is the place where the target says the path
    ends.

    Args:
      teacher, target: denoisers, `(x_noisy, sigma [B]) -> x0_hat`.
      x_noisy: states, [B, ...].
      sigma, sigma_next: levels of the walk, [B], sigma > sigma_next >= sigma_edge.
      sigma_edge: level at which the phase ends, [B] or a scalar.

    Source: MotionPCM section 4.2 and Algorithm 1, lines 8 to 10.
    """
    # A denoiser is not asked at level 0; what it says in that place is not taken.
    xp = array_module(x_noisy, sigma, sigma_next, sigma_edge)
    asked = xp.where(sigma_next > sigma_edge, sigma_next, sigma)
    level, level_next, level_asked, edge = (beside(s, x_noisy) for s in (sigma, sigma_next, asked, sigma_edge))
    solved = ddim_step(x_noisy, teacher(x_noisy, sigma), level, level_next)
    jumped = ddim_step(solved, target(solved, asked), level_asked, edge)
    end = xp.where(level_next > edge, jumped, solved)
    kept = edge / level  # share of the state's noise that is left at the end
    return (end - kept * x_noisy) / (1.0 - kept)


def noise_travel(schedule: NoiseSchedule, state, time, time_next, noise):
    """Carry a state to a noisier time by fresh noise: sqrt(r) z + sqrt(1 - r) n, r = abar_next / abar.

    Args:
      schedule: of K levels.
      state, noise: [B, ...]; noise is standard normal.
      time, time_next: level numbers, time_next >= time, [B] or scalars.

    Source: PCM's noise travel; MotionPCM section 4.3 and Appendix A.4.
    """
    xp = array_module(state, noise)
    alpha, alpha_next = (beside(shares(schedule, t, xp)[0], state) for t in (time, time_next))
    r = (alpha_next / alpha) ** 2
    return xp.sqrt(r) * state + xp.sqrt(xp.maximum(1.0 - r, 0.0)) * noise


def pseudo_huber(difference, width):
    """Return sqrt(d^2 + h^2) - h of every number: d^2 / (2 h) near 0, |d| - h far away (MotionPCM Eq. 12)."""
    return array_module(difference).sqrt(difference**2 + width**2) - width


def consistency_scales(time, xp=jnp):
    """Return MotionLCM's (c_skip, c_out) at a level number: (1, 0) at time 0, and nearly (0, 1) from time 1 on.

    Its network answers c_skip z + c_out x0, all the way to the data: MotionPCM Eq. 9 with one phase.
    """
    square = 100.0 * xp.asarray(time, xp.float32) ** 2
    return 0.25 / (square + 0.25), xp.sqrt(square / (square + 0.25))


def latent_consistency_end(schedule: NoiseSchedule, state, eps, time):
    """Return what MotionLCM's network says of the data; arguments as of `jump`."""
    xp = array_module(state, eps)
    alpha, sigma = (beside(x, state) for x in shares(schedule, time, xp))
    c_skip, c_out = (beside(x, state) for x in consistency_scales(time, xp))
    return c_skip * state + c_out * clean_estimate("eps", eps, state, alpha, sigma)


def hinge(real, fake):
    """Return the discriminator's loss, mean ReLU(1 - real) + mean ReLU(1 + fake) (MotionPCM Algorithm 1, line 15).

    MotionPCM Eq. 13 prints both signs the other way round; the student's half is the same in both.
    """
    return jnp.mean(jax.nn.relu(1.0 - real)) + jnp.mean(jax.nn.relu(1.0 + fake))


# ------------------------------------------------------------------------------------------------------------- sampling


def ddim_times(num_levels: int, num_steps: int, spacing: str = "trailing") -> np.ndarray:
    """Return the times that an N-step teacher visits, falling, the last 0, [N + 1].

    Args:
      num_levels: of its schedule, T.
      num_steps: N.
      spacing: "trailing" begins at the noisiest level. "leading" counts its strides from level 1, as the code that
        MotionPCM builds on does by default: with one step it asks at level 1 what to make of pure noise.

    Raises:
      ValueError: for more steps than levels, or an unknown spacing.
    """
    check_known(spacing, ("trailing", "leading"), "spacing")
    if not 1 <= num_steps <= num_levels:
        raise ValueError(f"a teacher of {num_levels} levels takes 1 to {num_levels} steps, got {num_steps}")
    if spacing == "leading":
        times = np.minimum(np.arange(num_steps) * (num_levels // num_steps) + 1, num_levels - 1)[::-1]
    else:
        times = np.rint(num_levels - np.arange(num_steps) * num_levels / num_steps).astype(int) - 1
    # With as many steps as levels the last one asked is level 0 itself.
    return np.append(times, 0)


def follow(predict: Callable, schedule: NoiseSchedule, noise, times):
    """Jump from time to time: a student along `Phases.visited`, a teacher along `ddim_times` (MotionPCM section 4.4).

    No noise is added on the way, so that noise and condition decide the answer.

    Args:
      predict: `predict(state, time)`, the noise; time is a scalar level number.
      schedule: of K levels.
      noise: state at the first time, standard normal, [B, ...].
      times: level numbers, falling, [N + 1].

    Returns:
      State at the last time; at time 0 it still has a little noise, alpha_0 = 0.9996 in MotionPCM's schedule.
    """
    xp = array_module(noise)
    times = xp.asarray(times)
    alphas, sigmas = shares(schedule, times, xp)
    return sample("ddim", on_grid(predict, "eps", times, alphas, sigmas), noise, sigmas, alphas=alphas)


LATENT_CONSISTENCY_TIMES = {1: (799,), 2: (699, 299), 4: (699, 399, 299, 299)}
"""Times at which MotionLCM V2 asks its student, by number of steps (released configuration)."""


def sample_latent_consistency(predict: Callable, schedule: NoiseSchedule, noise, times, key) -> jax.Array:
    """Draw as MotionLCM does: to the data at once, fresh noise to the next time, and so on.

    Args:
      predict, schedule, noise: as for `follow`.
      times: level numbers to ask at, such as those of `LATENT_CONSISTENCY_TIMES`.
      key: of the fresh noise.
    """
    state, last = noise, len(times) - 1
    for number, time in enumerate(times):
        x0 = latent_consistency_end(schedule, state, predict(state, time), time)
        if number < last:
            fresh = jax.random.normal(jax.random.fold_in(key, number), x0.shape)
            state = noised(schedule, x0, fresh, times[number + 1])
    return x0
