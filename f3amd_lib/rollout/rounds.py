"""One round of synthesis: what a user waits for, what is timed, and what is exported.

A round draws noise, encodes the condition once and walks down all noise levels. Kinematics and the
way back to metres come after it.
"""

import jax
import jax.numpy as jnp

from f3amd_lib.diffusion.samplers import sample


def sample_round(
    network, condition, sigmas, key=None, *, noise=None, start=None, sampler: str = "ddim", unroll: bool = False
) -> jax.Array:
    """Sample one window for every character.

    Args:
      network: has `config`, `encode(condition)` and is called as `network(x_noisy, sigma, context)`
        (`networks.config.DenoisingNetwork`).
      condition: in the network's normalised units, history [B, H, C] first.
      sigmas: [N + 1], falling, from a noise schedule's `grid`.
      key: JAX random key of the noise; not needed if `noise` is given and the sampler draws none.
      noise: standard normal numbers to start from, [B, T, C], instead of drawn ones.
      start: standard deviation of the state to start from; None is the first level's.
      sampler: a name of `samplers.SAMPLERS`.
      unroll: write the steps out one by one instead of a `lax.scan` (for exports).

    Returns:
      Clean features, [B, T, C], in network units.

    Raises:
      ValueError: for neither key nor noise, noise of a wrong shape, an unknown sampler, or one that
        draws noise at every step without a key.
    """
    shape = condition.history.shape[0], network.config.window, network.config.channels
    if noise is None and key is None:
        raise ValueError("a round starts from noise: give it a key, or the noise itself")
    key_init, key_steps = (None, None) if key is None else jax.random.split(key)
    if noise is None:
        # Drawn with all digits and then cut: one seed, one noise, whatever the precision.
        dtype = condition.history.dtype
        drawn = jax.random.normal(key_init, shape, jnp.promote_types(dtype, jnp.float32))
        noise = drawn.astype(dtype)
    elif noise.shape != shape:
        raise ValueError(f"noise must have shape {shape}, got {noise.shape}")
    context = network.encode(condition)
    denoise = lambda x_noisy, sigma: network(x_noisy, sigma, context)
    state = jnp.asarray(sigmas[0] if start is None else start, noise.dtype) * noise
    return sample(sampler, denoise, state, sigmas, key=key_steps, unroll=unroll)
