"""From noise to data through a network of any objective on any schedule; and a flow's solver that chooses its steps.

A denoiser of `diffusion.samplers` gives a clean estimate; a network gives x0, eps or v, from the state
alpha x0 + sigma eps itself and a time. On the straight path a DDIM step is Euler's step of the flow.
"""

from collections.abc import Callable

import numpy as np

from f3amd_lib.diffusion.predictions import OBJECTIVES, on_grid
from f3amd_lib.diffusion.samplers import SAMPLERS, sample
from f3amd_lib.diffusion.schedules import NoiseSchedule
from f3amd_lib.ground.arrays import jnp
from f3amd_lib.ground.names import check_known

DORMAND_PRINCE = "dormand_prince"
"""Name of the solver that is no walk of `diffusion.samplers`: see `integrate`."""


def default_sampler(objective: str, schedule: NoiseSchedule) -> str:
    """Return what a network is meant for: Dormand and Prince for velocities (released code), else the schedule's."""
    return DORMAND_PRINCE if objective == "v" and schedule.kind == "straight" else schedule.sampler


def network_time(schedule: NoiseSchedule, t):
    """Return a network's input for schedule time, any shape: t, or of K levels the number, 0 the least noisy."""
    return t if schedule.levels is None else len(schedule.levels) * (1.0 - t) - 1.0


def solve(
    predict: Callable, objective: str, schedule: NoiseSchedule, noise, *, sampler=None, num_steps: int = 50, key=None
):
    """Walk from noise to a clean state (ACMDM Eqs 1 and 2, backwards).

    Args:
      predict: `predict(state, time)`, the state alpha x0 + sigma eps and what `network_time` tells, a scalar.
      objective: what it answers, of `predictions.OBJECTIVES`.
      schedule: that it was trained on.
      noise: standard normal, [B, ...].
      sampler: "dormand_prince", for velocities on the straight path, or a name of `samplers.SAMPLERS`; on the straight
        path that is "ddim". `default_sampler` by default.
      num_steps: of all but Dormand and Prince.
      key: JAX random key, for samplers that draw noise.

    Raises:
      ValueError: for an unknown objective or sampler, or one that does not fit objective and schedule, or for noise
        predicted where nothing is left of the signal, which says nothing of the signal.
    """
    check_known(objective, OBJECTIVES, "objective")
    sampler = sampler or default_sampler(objective, schedule)
    if sampler == DORMAND_PRINCE:
        if default_sampler(objective, schedule) != sampler:
            raise ValueError(f"{sampler!r} follows v on the straight path, not {objective!r} on {schedule.kind!r}")
        return integrate(predict, noise)
    check_known(sampler, [DORMAND_PRINCE, *SAMPLERS], "sampler")
    (alphas, sigmas), levels = schedule.scaled_grid(num_steps), schedule.grid(num_steps)
    endless = bool(np.isinf(levels[0]))
    if endless and objective == "eps":
        raise ValueError(f"the first step of {schedule.kind!r} sees noise alone: predict 'x0' or 'v' there, not 'eps'")
    times = jnp.asarray(network_time(schedule, np.append(schedule.times(num_steps), 1.0)))
    alphas, sigmas = jnp.asarray(alphas), jnp.asarray(sigmas)
    denoise = on_grid(predict, objective, times, alphas, sigmas, None if endless else levels)
    if endless:
        return sample(sampler, denoise, sigmas[0] * noise, sigmas, alphas=alphas, key=key)
    return sample(sampler, denoise, levels[0] * noise, levels, key=key)


def integrate(velocity: Callable, noise, *, relative: float = 1e-3, absolute: float = 1e-6):
    """Follow a flow from noise to data by Dormand and Prince's method of order 5, which chooses its steps.

    Args:
      velocity: `velocity(state, t)`, x0 - eps on the straight path; t comes as a scalar.
      noise: state at t = 0, standard normal, any shape.
      relative, absolute: tolerances (the defaults are the released code's).

    Returns:
      State at t = 1.

    Raises:
      RuntimeError: if a thousand steps do not reach the end.
    """
    # It takes most of a second to import, and no other sampler needs it.
    from diffrax import Dopri5, ODETerm, PIDController, SaveAt, diffeqsolve

    return diffeqsolve(
        ODETerm(lambda t, state, _: velocity(state, t)), Dopri5(), 0.0, 1.0, None, noise,
        stepsize_controller=PIDController(rtol=relative, atol=absolute), saveat=SaveAt(t1=True), max_steps=1000,
    ).ys[0]  # fmt: skip
