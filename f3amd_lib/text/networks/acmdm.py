"""The ACMDM network: a diffusion Transformer over patches of joints, with its control branch and its masked form.

    state [B, l, J, C] -> patches of joints -> n blocks under time and text -> [B, l, J, C]

Source: ACMDM sections 3.1 and 3.2, Figure 2, and Appendix G (Meng et al. 2025).

The joint axis stays an axis: raw positions have three channels a joint, the latent of a motion
autoencoder has four, and a redundant feature vector is one joint with many. What the answer means
(x0, eps or v) is the config's `objective`; `diffusion.predictions` turns it into a clean estimate.

The control branch is a copy of the network beside the frozen one. It reads the same noisy state and, on top of it,
where joints should be. What each of its blocks makes goes through a layer that starts at zero and is added to the
frozen network behind the same block; an untrained branch therefore changes nothing.

Of masked autoregression, where frames are revealed in a random order, each drawn given those before it, the paper
gives results and no network. Ours follows the recipe of MARDM (Meng et al. 2024): the blocks of ACMDM look at the
frames that are known, in both directions, and a small network beside them denoises the hidden ones, each token for
itself.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from f3amd_lib.diffusion.predictions import OBJECTIVES
from f3amd_lib.networks.attention import check_num_heads
from f3amd_lib.networks.config import CheckedConfig, LayerKeys, scaled_normal

TIME_FEATURES = 256


class TextCondition(NamedTuple):
    """What a motion is made from.

    Attributes:
      pooled: one embedding a caption, [B, W]; zeros stand for no text.
      mask: True where a frame of the state is motion and not padding, [B, l]; each sample needs one.
    """

    pooled: jax.Array
    mask: jax.Array

    def without_text(self) -> TextCondition:
        """Return the condition of the same frames and no caption: the zero vector before the text layer."""
        return self._replace(pooled=jnp.zeros_like(self.pooled))


class TextContext(NamedTuple):
    """A condition after `encode`: text in network width, [B, d], and the mask of frames, [B, l]."""

    text: jax.Array
    mask: jax.Array


def waves(x, width: int, last: float, *, sine_first: bool = False):
    """Return cosines and then sines of x, [...] -> [..., width], whose frequencies fall from 1 as 10000^(-i / last)."""
    angle = jnp.asarray(x, jnp.float32)[..., None] * 10000.0 ** (-jnp.arange(width // 2) / last)
    parts = jnp.cos(angle), jnp.sin(angle)
    return jnp.concatenate(parts[::-1] if sine_first else parts, axis=-1)


@dataclass(frozen=True, kw_only=True)
class ACMDMConfig(CheckedConfig):
    """Everything that decides the shape of an ACMDM network (ACMDM section 3.1).

    Attributes:
      num_joints: J of the state; 1 for a redundant feature vector.
      channels: C of a joint: 3 raw, 4 latent.
      window: l, most frames of a state: 49 latent ones of 196, or 196 raw.
      patch: joints a token: "whole" is J, "half" J / 2 and "pair" 2 (the paper's 22, 11, 2 of 22
        joints). A last patch that J does not fill is filled with zeros.
      latent_width: d; the paper has 64 a head.
      depth, num_heads: blocks and attention heads, which the paper keeps equal.
      text_width: W of the caption's embedding: 512 for CLIP ViT-B/32.
      text_scale: what an embedding is multiplied by first: more than 1 where an encoder's vectors are short, so that a
        short training hears them (ours).
      conditioning: "adaln", or "concatenation": time and text are two tokens before the frames (the
        paper says no more).
      objective: what the answer is: "v", "eps" or "x0".
      block_frames: frames of a block that sees itself and earlier blocks alone (noisy-condition
        autoregression); 0: all frames see each other.

    Raises:
      ValueError: for a size or choice that makes no sense, or blocks together with concatenation,
        whose tokens know no block.
    """

    family: ClassVar[str] = "ACMDM"
    choices: ClassVar[dict[str, tuple[str, ...]]] = {
        "patch": ("whole", "half", "pair"),
        "conditioning": ("adaln", "concatenation"),
        "objective": OBJECTIVES,
    }
    may_be_zero: ClassVar[tuple[str, ...]] = ("block_frames",)
    from_data: ClassVar[tuple[str, ...]] = ("num_joints", "text_width")

    num_joints: int
    channels: int = 4
    window: int = 49
    patch: str = "whole"
    latent_width: int = 512
    depth: int = 8
    num_heads: int = 8
    text_width: int = 512
    text_scale: float = 1.0
    conditioning: str = "adaln"
    objective: str = "v"
    block_frames: int = 0

    def __post_init__(self):
        super().__post_init__()
        check_num_heads(self.latent_width, self.num_heads)
        if self.latent_width // self.num_heads % 2:
            raise ValueError(f"a head turns pairs of channels, got {self.latent_width // self.num_heads} of them")
        if self.block_frames and self.conditioning == "concatenation":
            raise ValueError("block_frames needs conditioning 'adaln': tokens before the frames belong to no block")

    @property
    def patch_joints(self) -> int:
        """P, joints of a token."""
        return {"whole": self.num_joints, "half": -(-self.num_joints // 2), "pair": min(2, self.num_joints)}[self.patch]

    @property
    def num_patches(self) -> int:
        """Tokens a frame."""
        return math.ceil(self.num_joints / self.patch_joints)

    def state_shape(self, batch: int) -> tuple[int, ...]:
        """Return the shape of the largest state, [B, l, J, C]."""
        return batch, self.window, self.num_joints, self.channels

    def condition_shapes(self, batch: int) -> TextCondition:
        """Return what `encode` takes, as shapes."""
        single = jax.ShapeDtypeStruct
        return TextCondition(single((batch, self.text_width), jnp.float32), single((batch, self.window), jnp.bool_))

    def check_condition(self, condition: TextCondition) -> None:
        """Raise ValueError unless text and mask fit each other and the config."""
        pooled, mask = condition
        if pooled.shape != (mask.shape[0], self.text_width) or mask.ndim != 2 or not 0 < mask.shape[1] <= self.window:
            wanted = f"[B, {self.text_width}], and its mask [B, at most {self.window} frames]"
            raise ValueError(f"pooled text must be {wanted}, got {pooled.shape} and {mask.shape}")


def rotary_base(num_tokens: int) -> int:
    """Return the base of the rotary code for sequences of at most so many tokens: 100 (floor(8 N / pi) // 100 + 1)."""
    return 100 * (int(8 * num_tokens / math.pi) // 100 + 1)


def rotary_angles(positions, half_width: int, base: float):
    """Return by how much each pair of channels turns, [T, half_width], radians.

    Exponents run evenly from 0 to 1, both included, where Su et al. 2021 stop before 1 (the released code).
    """
    return jnp.asarray(positions)[:, None] * base ** -jnp.linspace(0.0, 1.0, half_width)


def rotated(x, angles):
    """Turn channel i with channel i + width / 2: rotary position embedding (Su et al. 2021).

    Args:
      x: [B, T, heads, width].
      angles: [T, width / 2].
    """
    first, second = jnp.split(x, 2, axis=-1)
    cosine, sine = jnp.cos(angles)[:, None], jnp.sin(angles)[:, None]
    return jnp.concatenate([first * cosine - second * sine, second * cosine + first * sine], axis=-1)


def block_causal(num_queries: int, num_keys: int, tokens_per_block: int) -> np.ndarray:
    """Return which keys the last queries may see: those of their own block and of earlier ones, [Q, K]."""
    block = np.arange(num_keys) // tokens_per_block
    return block[-num_queries:, None] >= block[None, :]


def _product_of_all_tokens(x, weight, *_, **how):
    return jnp.dot(x.reshape(-1, x.shape[-1]), weight, **how).reshape(*x.shape[:-1], -1)


def linear(width_in: int, width_out: int, rngs: nnx.Rngs, *, zero: bool = False) -> nnx.Linear:
    """Return a linear layer as the released code starts it: Xavier uniform, or all zeros; bias 0.

    Samples and tokens are one axis of its product: a CPU takes its gradient faster, a training step by a seventh.
    """
    start = nnx.initializers.zeros_init() if zero else nnx.initializers.xavier_uniform()
    return nnx.Linear(width_in, width_out, kernel_init=start, dot_general=_product_of_all_tokens, rngs=rngs)


def root_mean_square_norm(width: int, rngs: nnx.Rngs) -> nnx.RMSNorm:
    """Return an RMSNorm with a learned scale, as all norms of this network are."""
    return nnx.RMSNorm(width, epsilon=1e-6, rngs=rngs)


def modulated(x, shift, scale):
    """Return x (1 + scale) + shift: adaptive normalisation (Peebles and Xie 2023)."""
    return x * (1.0 + scale) + shift


class ACMDMBlock(nnx.Module):
    """Attention and a gated feed-forward layer, each added to its input (ACMDM section 3.1).

    Under "adaln" c shifts, scales and gates both, from zero on, so that a fresh block is the
    identity; under "concatenation" it has no way in but the tokens.
    """

    def __init__(self, config: ACMDMConfig, *, rngs: nnx.Rngs):
        width, self.num_heads = config.latent_width, config.num_heads
        hidden = int(2 * 4 * width / 3)
        self.attention_norm = root_mean_square_norm(width, rngs)
        self.query_key_value = linear(width, 3 * width, rngs)
        self.query_norm = root_mean_square_norm(width // self.num_heads, rngs)
        self.key_norm = root_mean_square_norm(width // self.num_heads, rngs)
        self.attention_output = linear(width, width, rngs)
        self.feed_forward_norm = root_mean_square_norm(width, rngs)
        self.feed_forward_input = linear(width, 2 * hidden, rngs)
        self.feed_forward_output = linear(hidden, width, rngs)
        if config.conditioning == "adaln":
            self.modulation = linear(width, 6 * width, rngs, zero=True)

    def __call__(self, x, c, angles, mask, past=None):
        """Map tokens to tokens.

        Args:
          x: [B, T, d].
          c: condition, [B, 1, d] or [B, T, d].
          angles: of the rotary code, [T, width of a head / 2].
          mask: which keys may be seen, broadcasting to [B, heads, T, keys].
          past: keys and values of earlier tokens, [B, S, heads, width of a head] each.

        Returns:
          (tokens [B, T, d], keys and values of earlier and these tokens).
        """
        parts = [0.0, 0.0, 1.0] * 2  # these change nothing
        if hasattr(self, "modulation"):
            parts = jnp.split(self.modulation(jax.nn.silu(c)), 6, axis=-1)
        shift, scale, gate, *feed_forward = parts
        update, past = self._attend(modulated(self.attention_norm(x), shift, scale), angles, mask, past)
        x = x + gate * update
        shift, scale, gate = feed_forward
        return x + gate * self._feed_forward(modulated(self.feed_forward_norm(x), shift, scale)), past

    def _attend(self, x, angles, mask, past):
        heads = self.query_key_value(x).reshape(*x.shape[:2], 3, self.num_heads, -1)
        query, key, value = (heads[:, :, part] for part in range(3))
        query, key = rotated(self.query_norm(query), angles), rotated(self.key_norm(key), angles)
        if past is not None:
            key, value = (jnp.concatenate([old, new], axis=1) for old, new in zip(past, (key, value), strict=True))
        answer = jax.nn.dot_product_attention(query, key, value, mask=mask)
        return self.attention_output(answer.reshape(x.shape)), (key, value)

    def _feed_forward(self, x):
        gate, value = jnp.split(self.feed_forward_input(x), 2, axis=-1)
        return self.feed_forward_output(jax.nn.silu(gate) * value)


class Trunk(nnx.Module):
    """What the network and its control branch share: patches, time, text and blocks."""

    def __init__(self, config: ACMDMConfig, *, rngs: nnx.Rngs):
        self.config, width = config, config.latent_width
        # As a convolution starts in PyTorch, but for its bias.
        start = nnx.initializers.variance_scaling(1 / 3, "fan_in", "uniform")
        self.patch = nnx.Linear(config.patch_joints * config.channels, width, kernel_init=start, rngs=rngs)
        narrow = lambda key, shape, dtype: scaled_normal(key, 0.02, shape)
        self.time_first = nnx.Linear(TIME_FEATURES, width, kernel_init=narrow, rngs=rngs)
        self.time_second = nnx.Linear(width, width, kernel_init=narrow, rngs=rngs)
        self.text = linear(config.text_width, width, rngs)
        self.blocks = nnx.List([ACMDMBlock(config, rngs=rngs) for _ in range(config.depth)])

    def encode(self, condition: TextCondition) -> TextContext:
        """Encode a condition once for all evaluations.

        Raises:
          ValueError: if its shapes do not fit the config.
        """
        self.config.check_condition(condition)
        return TextContext(self.text(self.config.text_scale * condition.pooled), condition.mask)

    def tokens(self, state):
        """Cut a state [B, l, J, C] into patches, frame after frame: [B, l * patches, P * C]."""
        config = self.config
        batch, frames, joints, channels = state.shape
        missing = config.num_patches * config.patch_joints - joints
        state = jnp.pad(state, ((0, 0), (0, 0), (0, missing), (0, 0)))
        return state.reshape(batch, frames * config.num_patches, config.patch_joints * channels)

    def from_tokens(self, tokens):
        """Lay patches together again: the inverse of `tokens`."""
        config = self.config
        joints = config.num_patches * config.patch_joints
        state = tokens.reshape(tokens.shape[0], -1, joints, tokens.shape[-1] // config.patch_joints)
        return state[:, :, : config.num_joints]

    def conditioned(self, time, context: TextContext):
        """Return (time, text) in network width: [B, 1, d] each, or [B, tokens, d] for a time of its own a frame."""
        time = self.time_second(jax.nn.silu(self.time_first(waves(time, TIME_FEATURES, TIME_FEATURES / 2))))
        time = time[:, None] if time.ndim == 2 else jnp.repeat(time, self.config.num_patches, axis=1)
        return time, context.text[:, None]

    def seen(self, context: TextContext, num_tokens: int):
        """Return which keys each token of the last frames may see, broadcasting to [B, heads, T, keys]."""
        config = self.config
        mask = jnp.repeat(context.mask, config.num_patches, axis=1)
        if config.conditioning == "concatenation":
            mask = jnp.pad(mask, ((0, 0), (2, 0)), constant_values=True)
        mask = mask[:, None, None, :]
        if config.block_frames:
            mask = mask & block_causal(num_tokens, mask.shape[-1], config.block_frames * config.num_patches)
        return mask

    def through(self, x, time, context: TextContext):
        """Yield what each block makes of tokens of all frames, [B, T, d]; time [B]."""
        time, text = self.conditioned(time, context)
        angles, mask = self.angles(0, x.shape[1]), self.seen(context, x.shape[1])
        for block in self.blocks:
            x, _ = block(x, time + text, angles, mask)
            yield x

    def angles(self, first: int, num_tokens: int):
        """Return the rotary angles of tokens first ... first + num_tokens - 1; frames begin at 0."""
        config = self.config
        half_width, base = config.latent_width // config.num_heads // 2, rotary_base(config.window * config.num_patches)
        return rotary_angles(np.arange(first, first + num_tokens), half_width, base)


class ACMDM(Trunk):
    """Network of Meng et al. 2025: a noisy state, a time and a caption in, the objective's prediction out."""

    def __init__(self, config: ACMDMConfig, *, rngs: nnx.Rngs):
        super().__init__(config, rngs=rngs)
        width = config.latent_width
        self.output_norm = root_mean_square_norm(width, rngs)
        self.output = linear(width, config.patch_joints * config.channels, rngs, zero=True)
        if config.conditioning == "adaln":
            self.output_modulation = linear(width, 2 * width, rngs, zero=True)

    def __call__(self, state, time, context: TextContext, *, residuals=None, past=None):
        """Predict x0, eps or v, as `config.objective` says.

        Args:
          state: noisy motion alpha x0 + sigma eps, [B, l, J, C], at most `window` frames.
          time: what `flow.network_time` tells, [B], or [B, l] for a time of its own a frame.
          context: from `encode`; its mask has the frames of `past`, too.
          residuals: what a control branch adds after each block, [B, tokens, d] each.
          past: what `remember` made of the frames before the state.

        Returns:
          [B, l, J, C]; what it says of padding means nothing.

        Raises:
          ValueError: if the state does not fit the config, or the mask does not fit the frames.
        """
        return self._run(state, time, context, residuals, past)[0]

    def remember(self, clean, context: TextContext, past=None):
        """Return keys and values of clean frames (time 1), for the blocks that come after them.

        Args:
          clean: whole blocks of frames, [B, l, J, C].
          context: from `encode`; its mask has the frames of `past` and of `clean`.
          past: of the frames before.
        """
        return self._run(clean, jnp.ones(len(clean)), context, None, past)[1]

    def _run(self, state, time, context, residuals, past):
        config = self.config
        before = 0 if past is None else past[0][0].shape[1]
        frames = state.shape[1] + before // config.num_patches
        fits = state.shape[2:] == (config.num_joints, config.channels) and frames <= config.window
        if not fits or context.mask.shape != (state.shape[0], frames):  # B may be a name, when a program is made
            wanted = f"[B, at most {config.window}, {config.num_joints}, {config.channels}] and the mask [B, {frames}]"
            raise ValueError(f"state must be {wanted}, got {state.shape} and {context.mask.shape}")
        x = self.patch(self.tokens(state))
        num_tokens = x.shape[1]
        time = jnp.asarray(time, x.dtype)
        if time.ndim == 2 and config.conditioning == "concatenation":
            raise ValueError("a time for each frame needs conditioning 'adaln': concatenation has one token for it")
        time, text = self.conditioned(jnp.broadcast_to(time, state.shape[: max(1, time.ndim)]), context)
        angles, c = self.angles(before, num_tokens), time + text
        if config.conditioning == "concatenation":
            x, angles = jnp.concatenate([time, text, x], axis=1), self.angles(-2, num_tokens + 2)
        mask, now = self.seen(context, num_tokens), []
        for number, block in enumerate(self.blocks):
            x, kept = block(x, c, angles, mask, None if past is None else past[number])
            now.append(kept)
            if residuals is not None:
                x = x + residuals[number]
        x = self.output_norm(x[:, -num_tokens:])
        if config.conditioning == "adaln":
            x = modulated(x, *jnp.split(self.output_modulation(jax.nn.silu(c)), 2, axis=-1))
        return self.from_tokens(self.output(x)), tuple(now)


# ------------------------------------------------------------------------------------------------------- control branch


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
            raise ValueError("a control branch needs a network with conditioning 'adaln' and block_frames 0")
        self.frames_per_state, width = frames_per_state, config.latent_width
        self.control_input = nnx.Linear(frames_per_state * config.patch_joints * 3, width, rngs=rngs)
        self.control_norm = root_mean_square_norm(width, rngs)
        self.control_output = linear(width, width, rngs, zero=True)
        self.added = nnx.List([linear(width, width, rngs, zero=True) for _ in range(config.depth)])

    def control_tokens(self, control: Control):
        """Return one token for the frames and joints of each token of the state, [B, tokens, d]."""
        config, frames = self.config, self.frames_per_state
        batch, length = control.positions.shape[:2]
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


# ---------------------------------------------------------------------------------------------------------- masked form


@dataclass(frozen=True, kw_only=True)
class MaskedACMDMConfig(ACMDMConfig):
    """An ACMDM config, and the head.

    Attributes:
      head_depth: layers of the network that denoises a token (ours).

    Raises:
      ValueError: as `ACMDMConfig`, and for concatenation or blocks of frames, which this form has no place for.
    """

    family: ClassVar[str] = "masked ACMDM"

    head_depth: int = 3

    def __post_init__(self):
        super().__post_init__()
        if self.conditioning != "adaln" or self.block_frames:
            raise ValueError("masked autoregression needs conditioning 'adaln' and block_frames 0")


class HeadLayer(nnx.Module):
    """Two layers on a token, gated, shifted and scaled by c; the identity at first."""

    def __init__(self, width: int, *, rngs: nnx.Rngs):
        self.norm = root_mean_square_norm(width, rngs)
        self.modulation = linear(width, 3 * width, rngs, zero=True)
        self.hidden, self.output = linear(width, width, rngs), linear(width, width, rngs)

    def __call__(self, x, c):
        shift, scale, gate = jnp.split(self.modulation(jax.nn.silu(c)), 3, axis=-1)
        return x + gate * self.output(jax.nn.silu(self.hidden(modulated(self.norm(x), shift, scale))))


class MaskedACMDM(Trunk):
    """A network that sees known frames (`look`) and denoises hidden ones (`__call__`)."""

    def __init__(self, config: MaskedACMDMConfig, *, rngs: nnx.Rngs):
        super().__init__(config, rngs=rngs)
        width, numbers = config.latent_width, config.patch_joints * config.channels
        self.hidden_token = nnx.Param(scaled_normal(rngs.params(), 0.02, (width,)))
        self.head_input = linear(numbers, width, rngs)
        self.head = nnx.List([HeadLayer(width, rngs=rngs) for _ in range(config.head_depth)])
        self.output_norm = root_mean_square_norm(width, rngs)
        self.output = linear(width, numbers, rngs, zero=True)

    def look(self, state, hidden, context: TextContext):
        """Return what the blocks make of the known frames, one vector a token, [B, tokens, d].

        Args:
          state: frames as they are known, [B, l, J, C].
          hidden: True for frames that are not, [B, l]; their values are not looked at.
          context: from `encode`.
        """
        x = self.patch(self.tokens(state))
        hidden = jnp.repeat(hidden, self.config.num_patches, axis=1)[..., None]
        x = jnp.where(hidden, self.hidden_token[...], x)
        # What it looks at is clean: time 1.
        *_, x = self.through(x, jnp.ones(len(state), x.dtype), context)
        return x

    def __call__(self, state, time, context):
        """Predict x0, eps or v of noisy frames, each from what was seen of the others.

        Args:
          state: [B, l, J, C].
          time: [B], or one for all.
          context: of `look`, or a condition as `encode` made it, with which all frames are hidden.
        """
        if isinstance(context, TextContext):
            context = self.look(jnp.zeros_like(state), jnp.ones(state.shape[:2], bool), context)
        x = self.head_input(self.tokens(state))
        time = jnp.broadcast_to(jnp.asarray(time, x.dtype), state.shape[:1])
        nothing = TextContext(jnp.zeros((len(state), 1), x.dtype), jnp.ones(state.shape[:2], bool))
        c = context + self.conditioned(time, nothing)[0]
        for layer in self.head:
            x = layer(x, c)
        return self.from_tokens(self.output(self.output_norm(x)))


def masked_share(uniform):
    """Return which share of the frames is hidden, cos(pi u / 2) of a uniform draw u, in training and sampling."""
    return jnp.cos(0.5 * jnp.pi * uniform)


def draw_hidden(key, mask):
    """Draw which frames are hidden in training, [B, l]: a random share of each sample's own, one at least.

    Args:
      key: JAX random key.
      mask: frames that are motion, [B, l].
    """
    key_share, key_order = jax.random.split(key)
    lengths = mask.sum(axis=1)
    share = masked_share(jax.random.uniform(key_share, lengths.shape))
    count = jnp.maximum(1, jnp.round(share * lengths))
    order = jnp.argsort(jnp.argsort(jnp.where(mask, jax.random.uniform(key_order, mask.shape), 2.0), axis=1), axis=1)
    return mask & (order < count[:, None])


def spoil(key, state, hidden):
    """Return (state, frames to hide) as the blocks get them in training.

    Of the hidden frames a tenth is replaced by noise, 88 % of the others by the learned vector, and the rest left as
    they are, so that the blocks cannot trust what they see.

    Args:
      key: JAX random key.
      state: clean, [B, l, J, C].
      hidden: from `draw_hidden`.

    Source: MARDM's released code.
    """
    key_noise, key_choice, key_vector = jax.random.split(key, 3)
    replaced = hidden & jax.random.bernoulli(key_choice, 0.1, hidden.shape)
    spoilt = jnp.where(replaced[..., None, None], jax.random.normal(key_noise, state.shape), state)
    return spoilt, hidden & ~replaced & jax.random.bernoulli(key_vector, 0.88, hidden.shape)


def frames_known(lengths, num_rounds: int):
    """Return how many frames of each motion are known after each round of sampling, [rounds, B], rising to all."""
    left = masked_share(jnp.arange(1, num_rounds + 1) / num_rounds)
    # Rounding may not keep the last frame hidden.
    return lengths - jnp.floor(left[:, None] * lengths + 1e-4).astype(lengths.dtype)
