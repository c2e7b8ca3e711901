"""What a network predicts: noise or velocity, turned into the clean estimate that samplers need; and guidance.

Wrappers take callables of (x_noisy, sigma), the variance-exploding state, and return a denoiser. All of them
describe one and the same walk: with an exact network every kind of prediction gives the same samples.
"""

from f3amd_lib.diffusion.samplers import Denoiser
from f3amd_lib.diffusion.schedules import alpha_bar_from_sigma
from f3amd_lib.ground.arrays import array_module

OBJECTIVES = ("x0", "eps", "v")
"""What a network may be trained to predict from a state alpha x0 + sigma eps: the motion, the noise, or v = x0 - eps,
the velocity of flow matching towards the data."""


def prediction_target(objective: str, x0, noise):
    """Return what a network of an objective should answer (ACMDM Eqs 1 and 2, and the text after them)."""
    return {"x0": x0, "eps": noise, "v": x0 - noise}[objective]


def clean_estimate(objective: str, prediction, state, alpha, sigma):
    """Return the clean motion of a prediction; the inverse of `prediction_target`.

    Args:
      objective: of `OBJECTIVES`.
      prediction: the network's answer, of the state's shape.
      state: alpha x0 + sigma eps, on the path's own scale.
      alpha, sigma: shares of signal and noise, broadcasting; alpha > 0 for "eps".
    """
    if objective == "x0":
        return prediction
    if objective == "eps":
        return (state - sigma * prediction) / alpha
    return (state + sigma * prediction) / (alpha + sigma)


def on_grid(predict, objective: str, times, alphas, sigmas, levels=None) -> Denoiser:
    """Wrap a time-conditioned network as a denoiser, valid only at the grid's noise levels.

    Args:
      predict: `predict(state, time)`, the state alpha x0 + sigma eps.
      objective: what it answers, of `OBJECTIVES`.
      times, alphas, sigmas: what it is told, and shares of signal and noise, at each place, [N + 1].
      levels: noise levels of the places where the walk is in the variance-exploding state; by default it is in the
        state itself.
    """
    visited = sigmas if levels is None else levels

    def denoise(x_noisy, level):
        place = abs(visited - level).argmin()
        alpha, sigma = alphas[place], sigmas[place]
        state = x_noisy if levels is None else alpha * x_noisy
        return clean_estimate(objective, predict(state, times[place]), state, alpha, sigma)

    return denoise


def from_noise(predict) -> Denoiser:
    """Return the denoiser of a network that predicts the noise, eps = (x_noisy - x0) / sigma (Ho et al. 2020)."""
    return lambda x_noisy, sigma: x_noisy - sigma * predict(x_noisy, sigma)


def from_velocity(predict) -> Denoiser:
    """Return the denoiser of a network that predicts v = sqrt(ab) eps - sqrt(1 - ab) x0, not the v of a flow.

    Source: Salimans and Ho 2022, Appendix D, with ab = alpha_bar.
    """

    def denoise(x_noisy, sigma):
        alpha_bar = alpha_bar_from_sigma(sigma)
        return alpha_bar * x_noisy - array_module(alpha_bar).sqrt(1.0 - alpha_bar) * predict(x_noisy, sigma)

    return denoise


def guided(denoise: Denoiser, unconditional: Denoiser, scale: float) -> Denoiser:
    """Return what lies `scale` times as far from the unconditional estimate as the conditional one.

    At scale 1 this is `denoise` and at 0 `unconditional`; above 1 the condition is obeyed more than it should be.

    Source: Ho and Salimans 2022.
    """

    def estimate(x_noisy, sigma):
        free = unconditional(x_noisy, sigma)
        return free + scale * (denoise(x_noisy, sigma) - free)

    return estimate


def guided_twice(full, without_first, without_second, first_scale: float, second_scale: float) -> Denoiser:
    """Return an estimate pushed in two directions: away from what each of two conditions alone would miss.

    At scales 1 and 1 this is `full`; at a second scale of 1 it is `guided(full, without_first, first_scale)`. Denoisers
    or velocities, as long as all three are of a kind.

    Source: ACMDM's released code, with the caption first and the control second.
    """

    def estimate(x_noisy, sigma):
        best = full(x_noisy, sigma)
        first = (first_scale - 1.0) * (best - without_first(x_noisy, sigma))
        return best + first + (second_scale - 1.0) * (best - without_second(x_noisy, sigma))

    return estimate
