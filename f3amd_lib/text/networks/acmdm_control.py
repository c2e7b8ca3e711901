"""The control branch of ACMDM: a copy of the network beside the frozen one (ACMDM section 3.2, Figure 2b).

The branch reads the same noisy state and, on top of it, where joints should be. What each of its blocks makes goes
through a layer that starts at zero and is added to the frozen network behind the same block; an untrained branch
therefore changes nothing.
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from flax import nnx

from f3amd_lib.networks.config import LayerKeys
from f3amd_lib.text.networks.acmdm import ACMDM, ACMDMConfig, TextCondition, Trunk, linear, root_mean_square_norm


class Control(NamedTuple):
    """Where joints should be.

    Attributes:
      positions: normalised, zero where nothing is asked, [B, L, J, 3], in frames of motion (not of the latent).
      asked: 1 where a joint is controlled in a frame, else 0, [B, L, J]. The branch is not shown it.
      kept: 0 for samples whose control is dropped, else 1, [B].
    """

    positions: object
    asked: object
    kept: object

    @classmethod
    def of(cls, positions, asked) -> Control:
        """Return the control of whole normalised positions at the places that `asked` marks."""
        asked = jnp.asarray(asked, positions.dtype)
        return cls(positions * asked[..., None], asked, jnp.ones(len(positions), positions.dtype))

    def dropped(self) -> Control:
        """Return a control that asks nothing of anybody."""
        return self._replace(kept=jnp.zeros_like(self.kept))


class ControlBranch(Trunk):
    """The trained half of a controlled ACMDM.

    Args:
      config: of the network that it stands beside; it needs "adaln" and no blocks of frames.
      frames_per_state: frames of motion for each frame of the state: 4 for a latent, 1 raw.

    Raises:
      ValueError: for a config that it cannot stand beside.
    """

    def __init__(self, config: ACMDMConfig, frames_per_state: int, *, rngs: nnx.Rngs):
        super().__init__(config, rngs=rngs)
        if config.conditioning != "adaln" or config.block_frames:
            raise ValueError("a control branch stands beside a network with conditioning 'adaln' and block_frames 0")
        self.frames_per_state, width = frames_per_state, config.latent_width
        self.control_input = nnx.Linear(frames_per_state * config.patch_joints * 3, width, rngs=rngs)
        self.control_norm = root_mean_square_norm(width, rngs)
        self.control_output = linear(width, width, rngs, zero=True)
        self.added = nnx.List([linear(width, width, rngs, zero=True) for _ in range(config.depth)])

    def control_tokens(self, control: Control):
        """Return one token for the frames and joints of each token of the state, [B, tokens, d]."""
        config, frames = self.config, self.frames_per_state
        batch, length, joints, _ = control.positions.shape
        if length % frames or joints != config.num_joints:
            wanted = f"[B, a multiple of {frames}, {config.num_joints}, 3]"
            raise ValueError(f"control must be {wanted}, got {control.positions.shape}")
        # Patches of each frame, then those of the frames of one state beside each other.
        patches = self.tokens(control.positions).reshape(batch, length // frames, frames, config.num_patches, -1)
        patches = jnp.swapaxes(patches, 2, 3).reshape(batch, -1, frames * config.patch_joints * 3)
        tokens = self.control_output(self.control_norm(self.control_input(patches)))
        return tokens * control.kept[:, None, None]

    def __call__(self, state, time, condition: TextCondition, control: Control):
        """Return what is added behind each block of the frozen network, [B, tokens, d] each.

        Args:
          state, time: as the frozen network gets them.
          condition: text and mask; the branch has a text layer of its own.
          control: where joints should be.
        """
        x = self.patch(self.tokens(state)) + self.control_tokens(control)
        time = jnp.broadcast_to(jnp.asarray(time, x.dtype), state.shape[:1])
        made = self.through(x, time, self.encode(condition))
        return [layer(x) for x, layer in zip(made, self.added, strict=True)]


def control_branch(base: ACMDM, frames_per_state: int, key) -> ControlBranch:
    """Return a fresh branch whose blocks are copies of the base's; all else of it starts anew.

    Args:
      base: the trained network; left as it is.
      frames_per_state: see `ControlBranch`.
      key: JAX random key.
    """
    branch = ControlBranch(base.config, frames_per_state, rngs=LayerKeys(key))
    nnx.update(branch.blocks, nnx.state(base.blocks))
    return branch


@functools.lru_cache(maxsize=8)
def blank_branch(config: ACMDMConfig, frames_per_state: int) -> tuple:
    """Return a branch's structure and the shapes of its weights, without building arrays."""
    blank = lambda: ControlBranch(config, frames_per_state, rngs=LayerKeys(jax.random.key(0)))
    return nnx.split(nnx.eval_shape(blank))


def branch_with(config: ACMDMConfig, frames_per_state: int, params) -> ControlBranch:
    """Return a control branch with the given weights."""
    return nnx.merge(blank_branch(config, frames_per_state)[0], jax.tree.map(lambda leaf: leaf, params))


def controlled(base: ACMDM, branch: ControlBranch, condition: TextCondition, control: Control):
    """Return `predict(state, time)` of the network with its branch (ACMDM section 3.2)."""
    context = base.encode(condition)
    return lambda state, time: base(state, time, context, residuals=branch(state, time, condition, control))
