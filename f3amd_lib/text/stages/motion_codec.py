"""Between motion and what a denoiser is trained on: positions, with redundant features or without, or a latent.

A latent is of positions or, by a mesh autoencoder, of the body's vertices.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp

from f3amd_lib.text.data.body_mesh import BodyMesh
from f3amd_lib.text.data.text_motions import AxisNormaliser
from f3amd_lib.text.networks.mesh_autoencoder import MeshAutoencoderConfig
from f3amd_lib.text.networks.motion_autoencoder import AutoencoderConfig
from f3amd_lib.training.checkpoints import network_with
from f3amd_lib.training.optimise import frozen_tree


@frozen_tree("axes", "params", "latent", "redundancy")
class MotionCodec:
    """How a state stands for motion.

    Attributes:
      axes: of positions in metres (ACMDM App. I). A shift of every joint by one vector is then a shift of every
        joint's numbers by one vector.
      autoencoder: config of the autoencoder, None where the state is positions.
      params: its weights.
      latent: of its latent's channels.
      redundancy: of the features that a state has beside positions (`joint_features`), None where it has none.
      mesh: the body whose vertices a mesh autoencoder sees, None for all others.
    """

    axes: AxisNormaliser
    autoencoder: AutoencoderConfig | MeshAutoencoderConfig | None = None
    params: Any = None
    latent: AxisNormaliser | None = None
    redundancy: AxisNormaliser | None = None
    mesh: BodyMesh | None = None

    @property
    def frames_per_state(self) -> int:
        """Frames of motion that one frame of a state stands for."""
        return 1 if self.autoencoder is None else self.autoencoder.frames_per_latent

    def state_mask(self, mask):
        """Return which frames of the state are motion, [B, l], of a mask of motion frames [B, L]."""
        return mask[:, :: self.frames_per_state]

    def encode(self, normalised, mask):
        """Return the state of normalised positions, zero in padding.

        Args:
          normalised: [B, L, J, 3]; L a multiple of `frames_per_state`.
          mask: True where a frame is motion, [B, L], whole frames of the state.

        Returns:
          [B, l, J, C].

        Raises:
          ValueError: for a state with redundant features, which are of a whole clip (`TextMotions.joint_features`).
        """
        if self.redundancy is not None:
            raise ValueError("a state with redundant features cannot be made of positions alone")
        state = normalised
        if self.autoencoder is not None:
            state = self.latent.normalise(self.latent_of(normalised, mask))
        return state * self.state_mask(mask)[..., None, None]

    def decode(self, state, mask):
        """Return normalised positions [B, L, J, 3] of a state [B, l, J, C]; mask [B, L]."""
        if self.autoencoder is None:
            return state[..., : len(self.axes.mean)]
        if self.mesh is not None:
            return _frame_by_frame(lambda frames: self.mesh.joints(self._vertices(frames)), state)
        return network_with(self.autoencoder, self.params).decode(self.latent.restore(state), self.state_mask(mask))

    def decode_vertices(self, state):
        """Return normalised vertices [B, L, V, 3] of a mesh autoencoder's state [B, L, n, C]."""
        return _frame_by_frame(self._vertices, state)

    def _vertices(self, frames):
        network = network_with(self.autoencoder, self.params)
        return network.decode(self.latent.restore(frames), self.mesh.lists)

    def vertices_of(self, frames):
        """Return the body's normalised vertices [N, V, 3] of normalised positions [N, J, 3]."""
        return self.axes.normalise(self.mesh.vertices(self.axes.restore(frames)))

    def latent_of(self, normalised, mask):
        """Return the autoencoder's own latent [B, l, J, C] of normalised positions; arguments as of `encode`."""
        network = network_with(self.autoencoder, self.params)
        if self.mesh is None:
            return network.latent_of(normalised, mask)
        return _frame_by_frame(lambda frames: network.encode(self.vertices_of(frames), self.mesh.lists), normalised)


_FRAMES_AT_ONCE = 128
"""Of meshes: all vertices of many clips at once would not fit into memory."""


def _frame_by_frame(function, clips):
    """Apply a function of frames [N, ...] to clips [B, L, ...]."""
    count = clips.shape[0] * clips.shape[1]
    size = min(_FRAMES_AT_ONCE, count)
    frames = jnp.asarray(clips).reshape(count, *clips.shape[2:])
    frames = jnp.pad(frames, ((0, -count % size), *[(0, 0)] * (frames.ndim - 1)), mode="edge")
    made = jax.lax.map(function, frames.reshape(-1, size, *frames.shape[1:]))
    return made.reshape(-1, *made.shape[2:])[:count].reshape(*clips.shape[:2], *made.shape[2:])


def with_latent(codec: MotionCodec, config: AutoencoderConfig, params, normalised, mask) -> MotionCodec:
    """Return a codec whose state is an autoencoder's latent, normalised by the mean and deviation of each channel.

    Args:
      codec: of positions.
      config, params: of the trained autoencoder.
      normalised, mask: motion to take the statistics from, [B, L, J, 3] and [B, L].
    """
    codec = dataclasses.replace(codec, autoencoder=config, params=params)
    latent = codec.latent_of(normalised, mask)[codec.state_mask(mask)]
    return dataclasses.replace(codec, latent=AxisNormaliser.of(latent))
