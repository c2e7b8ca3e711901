"""Between motion and what a denoiser is trained on: positions, with redundant features or without, or a latent."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Any

import jax

from f3amd_lib.data.text_motions import AxisNormaliser
from f3amd_lib.networks.motion_autoencoder import AutoencoderConfig
from f3amd_lib.training.checkpoints import network_with


@functools.partial(
    jax.tree_util.register_dataclass,
    data_fields=("axes", "params", "latent", "redundancy"),
    meta_fields=("autoencoder",),
)
@dataclass(frozen=True, eq=False)
class MotionCodec:
    """How a state stands for motion.

    Attributes:
      axes: of positions in metres (ACMDM App. I). A shift of every joint by one vector is then a shift of every
        joint's numbers by one vector.
      autoencoder: config of the autoencoder, None where the state is positions.
      params: its weights.
      latent: of its latent's channels.
      redundancy: of the features that a state has beside positions (`joint_features`), None where it has none.
    """

    axes: AxisNormaliser
    autoencoder: AutoencoderConfig | None = None
    params: Any = None
    latent: AxisNormaliser | None = None
    redundancy: AxisNormaliser | None = None

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
            state = self.latent.normalise(network_with(self.autoencoder, self.params).latent_of(normalised, mask))
        return state * self.state_mask(mask)[..., None, None]

    def decode(self, state, mask):
        """Return normalised positions [B, L, J, 3] of a state [B, l, J, C]; mask [B, L]."""
        if self.autoencoder is None:
            return state[..., : len(self.axes.mean)]
        return network_with(self.autoencoder, self.params).decode(self.latent.restore(state), self.state_mask(mask))


def with_latent(codec: MotionCodec, config: AutoencoderConfig, params, normalised, mask) -> MotionCodec:
    """Return a codec whose state is an autoencoder's latent, normalised by the mean and deviation of each channel.

    Args:
      codec: of positions.
      config, params: of the trained autoencoder.
      normalised, mask: motion to take the statistics from, [B, L, J, 3] and [B, L].
    """
    latent = network_with(config, params).latent_of(normalised, mask)[mask[:, :: config.frames_per_latent]]
    return MotionCodec(codec.axes, config, params, AxisNormaliser.of(latent))
