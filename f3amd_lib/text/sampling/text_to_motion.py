"""From noise and a caption to a state of motion: guidance, control, and the three autoregressive forms of ACMDM.

All of it is one call of `flow.solve` on a `predict(state, time)`; what differs is how that is put together. States are
positions or latents in network units; `text.stages.text_models` makes metres of them.
"""

from collections.abc import Callable, Iterable, Iterator
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax

from f3amd_lib.diffusion.flow import solve
from f3amd_lib.diffusion.predictions import guided, guided_twice
from f3amd_lib.diffusion.schedules import NoiseSchedule
from f3amd_lib.text.networks.acmdm import (
    ACMDM,
    Control,
    ControlBranch,
    MaskedACMDM,
    TextCondition,
    controlled,
    frames_known,
)
from f3amd_lib.text.stages.text_models import MotionCodec

Predict = Callable[[jax.Array, jax.Array], jax.Array]


def with_guidance(prediction: Callable[[TextCondition], Predict], condition: TextCondition, scale: float) -> Predict:
    """Return the prediction under a caption, pushed away from the one without (ACMDM section 4.1: 3).

    Args:
      prediction: `prediction(condition) -> predict`.
      condition: caption and frames.
      scale: 1 asks once an evaluation, any other twice.
    """
    told = prediction(condition)
    return told if scale == 1.0 else guided(told, prediction(condition.without_text()), scale)


def text_prediction(network: ACMDM, condition: TextCondition) -> Predict:
    """Return `predict(state, time)` of a network under a condition, which is encoded once."""
    context = network.encode(condition)
    return lambda state, time: network(state, time, context)


def control_prediction(
    base: ACMDM, branch: ControlBranch, condition: TextCondition, control: Control, text_scale=2.5, control_scale=1.75
) -> Predict:
    """Return the prediction under caption and control, guided in two directions (ACMDM section 3.2; released code)."""
    told = [(condition, control), (condition.without_text(), control), (condition, control.dropped())]
    return guided_twice(*(controlled(base, branch, *both) for both in told), text_scale, control_scale)


def without_padding(state, mask):
    """Return a state [B, l, J, C] that is zero where the mask [B, l] is False."""
    return state * mask[..., None, None]


def sample_text(
    network: ACMDM, schedule: NoiseSchedule, condition: TextCondition, noise, *, guidance: float = 3.0, **solver
):
    """Draw whole motions at once.

    Args:
      network, schedule: trained together.
      condition: captions and frames.
      noise: standard normal, [B, l, J, C].
      guidance: w of ACMDM section 4.1.
      **solver: sampler, num_steps and key, of `solve`.

    Returns:
      States, zero in padding, [B, l, J, C].
    """
    predict = with_guidance(lambda condition: text_prediction(network, condition), condition, guidance)
    return without_padding(solve(predict, network.config.objective, schedule, noise, **solver), condition.mask)


def sample_control(
    base: ACMDM, branch: ControlBranch, schedule: NoiseSchedule, condition: TextCondition, control: Control, noise, *,
    guidance: float = 2.5, **solver,
):  # fmt: skip
    """Draw motions whose joints go where a control asks; arguments as of `sample_text` and `control_prediction`."""
    predict = control_prediction(base, branch, condition, control, guidance)
    return without_padding(solve(predict, base.config.objective, schedule, noise, **solver), condition.mask)


# ------------------------------------------------------------------------------------------------------- autoregression


def continue_prefix(
    network: ACMDM, schedule: NoiseSchedule, prefix, captions: Iterable, key, *, guidance: float = 4.0, **solver
) -> Iterator[jax.Array]:
    """Go on from clean frames, window after window, under captions that may change on the way (prefix form, App. G).

    Args:
      network: trained with as many `prefix_frames`.
      schedule: its noise schedule.
      prefix: the frames before, [B, P, J, C]; later windows take the last P that were made.
      captions: embeddings [B, W], one for each window.
      key: JAX random key.
      guidance: 4 in the released code.
      **solver: as for `solve`.

    Yields:
      The next window - P frames, [B, ., J, C], for each caption.
    """
    given, window = prefix.shape[1], network.config.window
    if not 0 < given < window:
        raise ValueError(f"the prefix must have 1 to {window - 1} frames, got {given}")
    for number, pooled in enumerate(captions):
        predict = _after(network, prefix, TextCondition(pooled, jnp.ones((len(prefix), window), bool)), guidance)
        shape = (len(prefix), window - given, *prefix.shape[2:])
        key_noise, key_solver = jax.random.split(jax.random.fold_in(key, number))
        noise = jax.random.normal(key_noise, shape)
        made = solve(predict, network.config.objective, schedule, noise, **{"key": key_solver, **solver})
        prefix = jnp.concatenate([prefix, made], axis=1)[:, -given:]
        yield made


def _after(network: ACMDM, prefix, condition: TextCondition, guidance: float) -> Predict:
    """Return the prediction of the frames after clean ones, all told the same time."""

    def prediction(condition):
        whole = text_prediction(network, condition)
        return lambda state, time: whole(jnp.concatenate([prefix, state], axis=1), time)[:, prefix.shape[1] :]

    return with_guidance(prediction, condition, guidance)


def sample_blocks(
    network: ACMDM, schedule: NoiseSchedule, condition: TextCondition, noise, *, guidance: float = 2.5,
    cached: bool = True, **solver,
):  # fmt: skip
    """Draw motions block by block, each after the clean ones before it (noisy-condition form, ACMDM App. G).

    Args:
      network: with `block_frames`.
      schedule: its noise schedule.
      condition: captions and frames.
      noise: standard normal, [B, l, J, C].
      guidance: 2.5 in the released code.
      cached: keep keys and values of the blocks before, or work them out again in every evaluation, which gives
        the same answer.
      **solver: as for `solve`.

    Returns:
      States, zero in padding, [B, l, J, C].
    """
    size, frames = network.config.block_frames, noise.shape[1]
    if not size:
        raise ValueError("this network has no blocks: build it with block_frames")
    key = solver.pop("key", None)
    conditions = [condition] if guidance == 1.0 else [condition, condition.without_text()]
    contexts, made = [network.encode(one) for one in conditions], noise[:, :0]
    pasts = [None] * len(contexts)
    for number, first in enumerate(range(0, frames, size)):
        last = min(first + size, frames)
        told = [context._replace(mask=context.mask[:, :last]) for context in contexts]
        if cached:
            predicts = [partial(network, context=context, past=past) for context, past in zip(told, pasts, strict=True)]
        else:
            predicts = [_after_clean(network, context, made) for context in told]
        predict = predicts[0] if guidance == 1.0 else guided(*predicts, guidance)
        key_block = None if key is None else jax.random.fold_in(key, number)
        block = solve(predict, network.config.objective, schedule, noise[:, first:last], key=key_block, **solver)
        made = jnp.concatenate([made, block], axis=1)
        if cached and last < frames:
            pasts = [network.remember(block, *pair) for pair in zip(told, pasts, strict=True)]
    return without_padding(made, condition.mask)


def _after_clean(network: ACMDM, context, before) -> Predict:
    """Return the prediction of a block, with the clean blocks before it run again beside it at time 1."""

    def predict(state, time):
        times = jnp.broadcast_to(jnp.reshape(time, (-1, 1)), state.shape[:2])
        times = jnp.concatenate([jnp.ones(before.shape[:2]), times], axis=1)
        return network(jnp.concatenate([before, state], axis=1), times, context)[:, before.shape[1] :]

    return predict


def sample_masked(
    network: MaskedACMDM, schedule: NoiseSchedule, condition: TextCondition, key, *, guidance: float = 3.0,
    num_rounds: int = 18, **solver,
):  # fmt: skip
    """Draw motions whose frames are revealed in a random order (masked form, ACMDM App. G).

    Args:
      network: a masked one.
      schedule: its noise schedule.
      condition: captions and frames.
      key: JAX random key.
      guidance: as for `sample_text` (the paper does not say).
      num_rounds: in which the frames are revealed, few at first (MARDM: 18).
      **solver: sampler and num_steps, of `solve`.

    Returns:
      States, zero in padding, [B, l, J, C].
    """
    mask, config = condition.mask, network.config
    key_order, key_rounds = jax.random.split(key)
    order = jnp.where(mask, jax.random.uniform(key_order, mask.shape), 2.0)
    rank = jnp.argsort(jnp.argsort(order, axis=1), axis=1)
    state = jnp.zeros((*mask.shape, config.num_joints, config.channels))

    def reveal(state, told):
        hidden, now, key = told
        key_noise, key_solver = jax.random.split(key)

        def prediction(condition):
            context = network.look(state, hidden, network.encode(condition))
            return lambda noisy, time: network(noisy, time, context)

        predict = with_guidance(prediction, condition, guidance)
        noise = jax.random.normal(key_noise, state.shape)
        made = solve(predict, config.objective, schedule, noise, key=key_solver, **solver)
        return jnp.where(now[..., None, None], made, state), None

    counts = frames_known(mask.sum(axis=1), num_rounds)
    known = rank < counts[:, :, None]
    before = jnp.concatenate([jnp.zeros_like(known[:1]), known[:-1]])
    keys = jax.random.split(key_rounds, num_rounds)
    state, _ = jax.lax.scan(reveal, state, (~before, known & ~before, keys))
    return without_padding(state, mask)


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
    """Change noise by Adam until the motion made from it meets its targets: control without a branch (DNO).

    Each step draws the whole motion, asks how far it is from the targets, and follows the gradient back through all of
    the sampler's steps to the noise. That costs hundreds of samplings a motion.

    Args:
      sample: `sample(noise) -> state`, differentiable: of `flow.solve` any sampler but "dormand_prince".
      distance: `distance(state) -> [B]`, metres; see `control_distance`.
      noise: to begin with, standard normal, [B, l, J, C].
      num_steps: optimiser steps.
      learning_rate: after the warm-up; then it falls to 0 on a cosine.
      warmup_steps: of a linear rise from 0.
      decorrelation: weight of `correlation`, which keeps the noise like noise; 0 leaves it out.

    Source: Karunratanakul et al. 2024 (DNO); settings of its released code. ACMDM Appendix F uses it on Euler's 10
    steps.
    """
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
