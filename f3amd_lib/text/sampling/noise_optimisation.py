"""Control without a branch: look for the noise from which the sampler makes a motion that meets its targets (DNO).

The network stays as it is. Each step draws the whole motion, asks how far it is from the targets, and follows the
gradient back through all of the sampler's steps to the noise. That costs hundreds of samplings a motion.

Source: Karunratanakul et al. 2024 (DNO); settings of its released code. ACMDM Appendix F uses it on Euler's 10 steps.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax

from f3amd_lib.text.networks.acmdm_control import Control
from f3amd_lib.text.stages.motion_codec import MotionCodec


class OptimisedNoise(NamedTuple):
    """What came out.

    Attributes:
      noise: the noise that was found, [B, l, J, C].
      state: what the sampler makes of it, [B, l, J, C].
      distances: mean distance from the targets before each step, metres, [steps, B].
    """

    noise: jax.Array
    state: jax.Array
    distances: jax.Array


def correlation(noise):
    """Return how much neighbouring frames of noise go together, squared and summed over time scales, [B].

    Zero on average for white noise. Each scale is made of sums of two frames of the last, over sqrt(2).

    Args:
      noise: [B, l, J, C].
    """
    total = jnp.zeros(len(noise))
    while noise.shape[1] > 1:
        product = noise[:, 1:] * noise[:, :-1]
        total = total + product.reshape(len(noise), -1).mean(axis=1) ** 2
        pairs = noise.shape[1] // 2
        noise = (noise[:, 0 : 2 * pairs : 2] + noise[:, 1 : 2 * pairs : 2]) / jnp.sqrt(2.0)
    return total


def control_distance(codec: MotionCodec, mask, control: Control) -> Callable:
    """Return `distance(state)`, mean distance of a state's joints from where they are asked to be, metres, [B].

    Args:
      codec: between states and motion.
      mask: frames of motion, [B, L].
      control: where joints should be; each sample asks for one at least.
    """
    wanted = codec.axes.restore(control.positions)

    def distance(state):
        apart = codec.axes.restore(codec.decode(state, mask)) - wanted
        # The root of zero has no gradient.
        length = jnp.sqrt(jnp.sum(apart**2, axis=-1) + 1e-12)
        return jnp.sum(length * control.asked, axis=(1, 2)) / control.asked.sum(axis=(1, 2))

    return distance


def optimise_noise(
    sample: Callable, distance: Callable, noise, *,
    num_steps: int = 300, learning_rate: float = 0.05, warmup_steps: int = 50, decorrelation: float = 1000.0,
) -> OptimisedNoise:  # fmt: skip
    """Change noise by Adam until the motion made from it meets its targets.

    Args:
      sample: `sample(noise) -> state`, differentiable: of `flow.solve` any sampler but "dormand_prince".
      distance: `distance(state) -> [B]`, metres; see `control_distance`.
      noise: to begin with, standard normal, [B, l, J, C].
      num_steps: optimiser steps.
      learning_rate: after the warm-up; then it falls to 0 on a cosine.
      warmup_steps: of a linear rise from 0.
      decorrelation: weight of `correlation`, which keeps the noise like noise; 0 leaves it out.

    Raises:
      ValueError: for no steps.
    """
    if num_steps < 1:
        raise ValueError(f"num_steps must be positive, got {num_steps}")
    warmup = min(warmup_steps, num_steps // 2)
    adam = optax.adam(optax.warmup_cosine_decay_schedule(0.0, learning_rate, warmup, num_steps))

    def loss(noise):
        apart = distance(sample(noise))
        return jnp.sum(apart + decorrelation * correlation(noise)), apart

    def step(carry, _):
        noise, state = carry
        gradient, apart = jax.grad(loss, has_aux=True)(noise)
        # Each sample's gradient has length 1, so that near targets count as much as far ones.
        size = jnp.sqrt(jnp.sum(gradient**2, axis=(1, 2, 3), keepdims=True))
        update, state = adam.update(gradient / jnp.maximum(size, 1e-12), state)
        return (optax.apply_updates(noise, update), state), apart

    @jax.jit
    def run(noise):
        (noise, _), distances = jax.lax.scan(step, (noise, adam.init(noise)), length=num_steps)
        return OptimisedNoise(noise, sample(noise), distances)

    return run(noise)
