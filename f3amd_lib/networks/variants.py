"""What we add to the F3AMD network, or read otherwise: options, all off in a row of the paper's tables.

`Variant` is the network of `networks.f3amd` with some of its steps changed. A preset or a file's header makes it only
where an option is on (`VariantConfig.from_dict`); all else is the paper's network.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from f3amd_lib.networks.conditioning import PATH_CHANNELS, Condition
from f3amd_lib.networks.f3amd import F3AMD, F3AMDConfig
from f3amd_lib.networks.spectral import cosine_basis


@dataclass(frozen=True, kw_only=True)
class VariantConfig(F3AMDConfig):
    """An F3AMD network with our options; off by default.

    Attributes:
      block_residual: add each block's input to its output, which begins at 0 (the paper's Figure 2 has none).
      block_bypass: add each block's input to its output, and change nothing else (a reading of Figure 2).
      coordinate_channel: let the encoder see where in the window a frame is (a reading of section 3.4.2:
        Li et al. 2021 give their operator the grid).
      small_spectral_weights: let spectral weights begin in [0, 1) over D0 D1, as Li et al. 2021 do (a reading of
        section 3.4.2), instead of at unit gain.
      history_anchor: add the last history frame, with a learned weight that starts as a decay over
        the window, so that the network predicts a change.
      output_scaling: let the network estimate what is left of the clean features after a skip,
        x0_hat = c_skip x + c_out F(c_in x), as Karras et al. 2022 do (Table 1, with sigma_data);
        at low noise the noisy input passes through.
      encoder_hidden_width: channels between two layers of the encoder; 0: one layer, as in the paper.
      decoder_hidden_width: the same of the decoder.
      encoder_skip: add the encoder's output to what the decoder reads (the idea of Ronneberger et al. 2015).
      film_from_identity: let FiLM begin with gamma = beta = 0, so that z_tilde = z_base in Eq. 6, as
        Zhang et al. 2023 begin what they add.
      pre_norm: normalise the channels that each base block reads to mean 0 and variance 1 (after
        Xiong et al. 2020, without their learned scale).
      residual_prior: combine the network's estimate with the noisy input as the posterior mean of a
        Gaussian residual whose variance per channel and cosine mode is learned.
      facing_frame: turn history, path and noisy input so that the path's first frame faces +Z, and
        turn the answer back: the network is then the same for every heading instead of learning
        that from random turns (needs a normaliser that treats x and z alike).
      history_input: let encoder, blocks and decoder see the history in front of the noisy window,
        and the path beside it, instead of through the condition alone. The seam then lies inside
        the period of the transform, not at its ends.

    Raises:
      ValueError: as `F3AMDConfig`, and for options that contradict each other or the way c enters.
    """

    may_be_zero: ClassVar[tuple[str, ...]] = (*F3AMDConfig.may_be_zero, "encoder_hidden_width", "decoder_hidden_width")

    block_residual: bool = False
    block_bypass: bool = False
    coordinate_channel: bool = False
    small_spectral_weights: bool = False
    history_anchor: bool = False
    output_scaling: bool = False
    encoder_hidden_width: int = 0
    decoder_hidden_width: int = 0
    encoder_skip: bool = False
    film_from_identity: bool = False
    pre_norm: bool = False
    residual_prior: bool = False
    facing_frame: bool = False
    history_input: bool = False

    def __post_init__(self):
        super().__post_init__()
        contradicting = {  # AdaLN-zero normalises what a block reads and is residual already
            "adaln_zero": ("block_residual", "block_bypass", "pre_norm", "film_from_identity"),
            "concatenation": ("history_input", "film_from_identity"), "cross_attention": ("film_from_identity",),
        }.get(self.conditioning, ())  # fmt: skip
        contradicting += ("block_bypass",) if self.block_residual else ()
        for option in contradicting:
            if getattr(self, option):
                raise ValueError(f"{option} contradicts {self.conditioning} or block_residual: leave it off")

    @classmethod
    def from_dict(cls, values: dict) -> F3AMDConfig:
        """Build a config from `to_dict`, whether it lists the options or not: the paper's where none is on."""
        config, own = super().from_dict(values), dataclasses.fields(F3AMDConfig)
        if any(getattr(config, option.name) for option in dataclasses.fields(cls)[len(own) :]):
            return config
        return F3AMDConfig(**{field.name: getattr(config, field.name) for field in own})

    @property
    def frames_before(self) -> int:
        """Frames of history that encoder, blocks and decoder see before the window."""
        return self.num_history if self.history_input else 0


def build_network(config: F3AMDConfig, *, rngs: nnx.Rngs) -> F3AMD:
    """Return the network of a config: the paper's, or one with options of ours."""
    return (Variant if isinstance(config, VariantConfig) else F3AMD)(config, rngs=rngs)


def _turned(vectors, matrix):
    """Turn 3D vectors that lie one after the other in the channels [B, T, 3 n] by [B, 3, 3]."""
    apart = vectors.reshape(*vectors.shape[:-1], -1, 3)
    return jnp.einsum("bij,btnj->btni", matrix, apart).reshape(vectors.shape)


def _turned_frames(frames, matrix):
    """Turn features [B, T, C]: root position and the two columns of the root's rotation."""
    return jnp.concatenate([_turned(frames[..., :9], matrix), frames[..., 9:]], axis=-1)


def _facing_forward(condition: Condition) -> tuple[Condition, jax.Array]:
    """Return a condition whose path begins facing +Z, and the rotations that did it, [B, 3, 3]."""
    path = condition.path
    cosine, sine = path[:, 0, 2], -path[:, 0, 4]
    length = jnp.sqrt(cosine**2 + sine**2)
    # A path that was dropped in training is all zeros and faces nowhere.
    known = length > 1e-6
    scale = jnp.where(known, length, 1.0)
    cosine, sine = jnp.where(known, cosine, 1.0) / scale, jnp.where(known, sine, 0.0) / scale
    zero, one = jnp.zeros_like(cosine), jnp.ones_like(cosine)
    rows = [cosine, zero, -sine, zero, one, zero, sine, zero, cosine]
    matrix = jnp.stack(rows, axis=-1).reshape(-1, 3, 3)
    place = jnp.stack([path[..., 0], jnp.zeros_like(path[..., 0]), path[..., 1]], axis=-1)
    place = _turned(place, matrix)[..., jnp.array([0, 2])]
    path = jnp.concatenate([place, _turned(path[..., 2:], matrix)], axis=-1)
    history = _turned_frames(condition.history, matrix)
    return condition._replace(history=history, path=path), matrix


class VariantContext(NamedTuple):
    """What a round knows before it starts.

    Attributes:
      keys, values: of the context tokens, as of `conditioning.Context`.
      history: normalised, [B, H, C]; turned like `path` if the config has a `facing_frame`.
      path: [B, T, 8].
      turn: rotations that faced them forward, [B, 3, 3]; None without a `facing_frame`.
    """

    keys: jax.Array
    values: jax.Array
    history: jax.Array
    path: jax.Array
    turn: jax.Array | None


def _in_every_channel(values: np.ndarray, channels: int) -> nnx.Param:
    """Return weights [T, C] that start with the same value [T] in every channel."""
    return nnx.Param(jnp.asarray(np.repeat(values[:, None], channels, axis=1), jnp.float32))


class Variant(F3AMD):
    """The F3AMD network with options of ours: what it sees, how blocks add up, what becomes of the answer."""

    def __init__(self, config: VariantConfig, *, rngs: nnx.Rngs):
        super().__init__(config, rngs=rngs)
        for layer in self.conditionings:
            if config.block_residual:
                # A block that adds nothing at the start is the identity, so that depth costs nothing.
                layer.output.kernel[...] = jnp.zeros_like(layer.output.kernel[...])
            if config.film_from_identity:
                layer.modulation.kernel[...] = jnp.zeros_like(layer.modulation.kernel[...])
        if config.history_anchor:
            decay = np.exp(-np.arange(1, config.window + 1) / 10.0)
            self.anchor = _in_every_channel(decay, config.channels)
        if config.residual_prior:
            # Slow modes are free, fast ones nearly fixed; a tenth of the logarithm is stored, so
            # that it learns ten times as fast as a weight.
            log_deviation = np.log(0.1) - 1.5 * np.log1p(np.arange(config.window))
            self.residual_variance = _in_every_channel(0.1 * 2.0 * log_deviation, config.channels)

    def _coder(self, side: str, width_in: int, width_out: int, rngs: nnx.Rngs):
        config = self.config
        if side == "encoder":
            # Beside the features: the path, whether a frame is given or noisy, and its place.
            width_in += (PATH_CHANNELS + 1 if config.history_input else 0) + config.coordinate_channel
        if hidden := getattr(config, f"{side}_hidden_width"):
            setattr(self, f"{side}_hidden", super()._coder(side, width_in, hidden, rngs))
        return super()._coder(side, hidden or width_in, width_out, rngs)

    def _fno_block(self, *sizes, **spectral):
        return super()._fno_block(*sizes, small_weights=self.config.small_spectral_weights, **spectral)

    def encode(self, condition: Condition) -> VariantContext:
        """Encode a condition once a round, as `F3AMD.encode` does, and keep what the options need of it."""
        self.config.check_condition(condition)
        turn = None
        if self.config.facing_frame:
            condition, turn = _facing_forward(condition)
        return VariantContext(*self.condition.encode(condition), condition.history, condition.path, turn)

    def stages(self, x_noisy, sigma, context, key=None) -> Iterator[tuple[str, jax.Array]]:
        """Yield the name and value of every station, as `F3AMD.stages` does."""
        if self.config.facing_frame:
            x_noisy = _turned_frames(x_noisy, context.turn)
        for name, value in super().stages(x_noisy, sigma, context, key):
            yield name, self._answer(value, x_noisy, sigma, context) if name == "x0_hat" else value

    def _answer(self, x0_hat, x_noisy, sigma, context):
        """Return the clean estimate [B, T, C] that the options make of the decoder's."""
        config, level = self.config, jnp.asarray(sigma, x_noisy.dtype).reshape(-1, 1, 1)
        if config.output_scaling:
            total = level**2 + config.sigma_data**2
            c_skip, c_out = config.sigma_data**2 / total, level * config.sigma_data / jnp.sqrt(total)
            x0_hat = c_skip * x_noisy + c_out * x0_hat
        if config.history_anchor:
            x0_hat = x0_hat + self.anchor[...] * context.history[:, -1:]
        if config.residual_prior:
            basis = jnp.asarray(cosine_basis(config.window), x_noisy.dtype)
            variance = jnp.exp(10.0 * self.residual_variance[...])
            gain = variance / (variance + level**2)
            residual = jnp.einsum("kt,btc->bkc", basis, x_noisy - x0_hat)
            x0_hat = x0_hat + jnp.einsum("kt,bkc->btc", basis, gain * residual)
        if config.facing_frame:
            x0_hat = _turned_frames(x0_hat, jnp.swapaxes(context.turn, -1, -2))
        return x0_hat

    def _seen(self, x_noisy, sigma, context):
        z = super()._seen(x_noisy, sigma, context)
        if self.config.history_input:
            # The history before the noisy window, the path beside it, and which of both a frame is: [B, H + T, .].
            past, future = context.history, context.path
            unknown = jnp.zeros((*past.shape[:2], PATH_CHANNELS), z.dtype)
            given, noisy = jnp.ones((*past.shape[:2], 1), z.dtype), jnp.zeros((*z.shape[:2], 1), z.dtype)
            before, window = (jnp.concatenate(row, axis=-1) for row in ([past, unknown, given], [z, future, noisy]))
            z = jnp.concatenate([before, window], axis=1)
        if self.config.coordinate_channel:
            place = jnp.linspace(0.0, 1.0, z.shape[1], dtype=z.dtype)[:, None]
            z = jnp.concatenate([z, jnp.broadcast_to(place, (*z.shape[:2], 1))], axis=-1)
        return z

    def _encoded(self, z):
        if self.config.encoder_hidden_width:
            z = nnx.gelu(self._run(self.encoder_hidden, z))
        return super()._encoded(z)

    def _updated(self, conditioning, base, z, c):
        if self.config.pre_norm:
            update = conditioning(lambda z: base(jax.nn.standardize(z, axis=-1, epsilon=1e-6)), z, c)
        else:
            update = conditioning(base, z, c)
        return z + update if self.config.block_residual or self.config.block_bypass else update

    def _last(self, z, encoded):
        last = super()._last(z, encoded)
        return last + encoded if self.config.encoder_skip else last

    def _decoded(self, z):
        if self.config.decoder_hidden_width:
            z = nnx.gelu(self._run(self.decoder_hidden, z))
        return super()._decoded(z)
