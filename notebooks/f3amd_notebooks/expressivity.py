"""What layers can express, worked out without training: band limits, seams, filters by condition.

Three questions about the F3AMD block, each with an exact answer:

- what the first m modes keep of motion, in centimetres, and what a window that does not end where
  it began costs (`keep_modes`, `band_limit_errors`, `ramp_energy`);
- what a spectral and a local branch together leave of a filter that does not wrap around
  (`wrapped_share`);
- which families of filters, one for each condition, a block can have (`film_share`,
  `additive_share`), and by which weights (`film_for_filters`, `film_delay_line`).

Shares are of a filter's energy: the part of the output's variance, for white input, that the best
weights leave.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
from f3amd_lib.data.features import frame_positions
from f3amd_lib.motion.skeleton import Skeleton
from f3amd_lib.networks.conditioning import FiLM
from f3amd_lib.networks.spectral import SpectralConvolution, cosine_basis, fourier_matrices
from flax import nnx
from scipy.linalg import toeplitz

BANDS = ("fourier", "fourier beside a line", "cosine")
"""What is cut to its first modes: the Fourier series of a window; the same of what is left beside
the line from its first to its last frame; its cosine series, with as many numbers."""

CM = 100.0


def kept_projection(num_frames: int, num_kept_modes: int, band: str = "fourier") -> np.ndarray:
    """Return the matrix that keeps the first m modes of a window, [T, T].

    Args:
      num_frames: window length T.
      num_kept_modes: m. Fourier keeps m bins, which are 2 m - 1 real numbers (T at most); cosine
        keeps as many rows, and thereby the same highest frequency.
      band: one of `BANDS`.

    Raises:
      ValueError: for an unknown band, or m out of range.
    """
    if band not in BANDS:
        raise ValueError(f"unknown band {band!r}: use one of {BANDS}")
    if band == "cosine":
        basis = cosine_basis(num_frames, min(2 * num_kept_modes - 1, num_frames))
        return basis.T @ basis
    analysis, synthesis = fourier_matrices(num_frames, num_kept_modes)
    rows = 2 * num_kept_modes
    kept = synthesis.reshape(num_frames, rows) @ analysis.reshape(rows, num_frames)
    if band == "fourier":
        return kept
    line = np.zeros((num_frames, num_frames))
    line[:, -1] = np.linspace(0.0, 1.0, num_frames)
    line[:, 0] = 1.0 - line[:, -1]
    return line + kept @ (np.eye(num_frames) - line)


def keep_modes(x, num_kept_modes: int, band: str = "fourier") -> np.ndarray:
    """Return windows with nothing left but their first modes (Eq. 2 with unit weights).

    Args:
      x: [..., T, C].
      num_kept_modes, band: of `kept_projection`.
    """
    x = np.asarray(x, np.float64)
    return kept_projection(x.shape[-2], num_kept_modes, band) @ x


def joint_groups(skeleton: Skeleton) -> dict[str, tuple[int, ...]]:
    """Return the joints of a body part by its name: root, trunk and head, arms, legs, toes.

    A part without joints is left out.
    """
    hips = {skeleton.role("left_hip"), skeleton.role("right_hip")}
    twins = skeleton.mirror_permutation
    groups = {name: [] for name in ("root", "trunk and head", "arms", "legs", "toes")}
    below_hips = set()
    for joint, parent in enumerate(skeleton.parents):
        if joint in hips or parent in below_hips:  # parents come first
            below_hips.add(joint)
        if parent < 0:
            name = "root"
        elif joint in skeleton.toes:
            name = "toes"
        elif joint in below_hips:
            name = "legs"
        else:
            name = "trunk and head" if twins[joint] == joint else "arms"
        groups[name].append(joint)
    return {name: tuple(joints) for name, joints in groups.items() if joints}


def group_positions(skeleton: Skeleton, frames) -> dict[str, np.ndarray]:
    """Return joint positions by body part, the root's in the world and all others beside it.

    Args:
      skeleton: the joints.
      frames: [B, T, C], metres and 6D numbers.

    Returns:
      Part -> [B, T, joints of the part, 3], centimetres.
    """
    positions = CM * np.asarray(frame_positions(skeleton, np.asarray(frames, np.float64)))
    beside = positions - positions[:, :, :1]
    return {
        name: (positions if name == "root" else beside)[:, :, list(joints)]
        for name, joints in joint_groups(skeleton).items()
    }


def motion_spectrum(skeleton: Skeleton, frames, fps: float = 30.0) -> pd.DataFrame:
    """Measure how much joints move at each frequency of a window.

    Args:
      skeleton: the joints.
      frames: windows, [B, T, C], metres and 6D numbers.
      fps: frames a second.

    Returns:
      Columns band ("fourier" or "cosine"), group, frequency_hz, amplitude_cm: root mean square over
      windows and joints of what one mode adds to a position. Cosine rows 2 k - 1 and 2 k, which
      turn k - 1/2 and k times a window, count as one mode k, so that both bands have as many. The
      squares of all but the first mode add up to the mean square distance from the window's mean.
    """
    num_frames = frames.shape[-2]
    num_modes = num_frames // 2 + 1
    frequency = fps / num_frames * np.arange(num_modes)
    cosine = cosine_basis(num_frames)
    mode_of_row = (np.arange(num_frames) + 1) // 2
    tables = []
    for group, positions in group_positions(skeleton, frames).items():
        over_frames = np.moveaxis(positions, 1, 0).reshape(num_frames, -1)
        fourier = np.abs(np.fft.rfft(over_frames, axis=0)) ** 2 / num_frames
        fourier[1 : (num_frames + 1) // 2] *= 2.0  # these bins stand for their conjugates, too
        pairs = np.zeros((num_modes, over_frames.shape[1]))
        np.add.at(pairs, mode_of_row, (cosine @ over_frames) ** 2)
        for band, energy in (("fourier", fourier), ("cosine", pairs)):
            # Three coordinates make one distance.
            amplitude = np.sqrt(3.0 * energy.mean(axis=1) / num_frames)
            columns = {"band": band, "group": group, "frequency_hz": frequency, "amplitude_cm": amplitude}
            tables.append(pd.DataFrame(columns))
    return pd.concat(tables, ignore_index=True)


def band_limit_errors(skeleton: Skeleton, frames, kept: Sequence[int], bands: Sequence[str] = BANDS) -> pd.DataFrame:
    """Measure how far joints move when all features are cut to their first modes.

    Args:
      skeleton: the joints.
      frames: windows, [B, T, C], metres and 6D numbers; forward kinematics follows the cut.
      kept: numbers of modes m.
      bands: of `BANDS`.

    Returns:
      Columns band, num_kept_modes, group, frame, error_cm: mean distance over windows and joints,
      the root's in the world, the others' beside the root.
    """
    real = group_positions(skeleton, frames)
    tables = []
    for band, modes in itertools.product(bands, kept):
        cut = group_positions(skeleton, keep_modes(frames, modes, band))
        for group, positions in real.items():
            error = np.linalg.norm(cut[group] - positions, axis=-1).mean(axis=(0, 2))
            columns = {"band": band, "num_kept_modes": modes, "group": group, "frame": range(len(error))}
            tables.append(pd.DataFrame(columns | {"error_cm": error}))
    return pd.concat(tables, ignore_index=True)


def ramp_energy(num_frames: int, band: str = "fourier") -> np.ndarray:
    """Return the energy of the straight line x_t = t at each mode, in closed form.

    With w = pi k / T, Fourier mode k >= 1 has T / (2 sin^2 w), halved at k = T / 2: about 1 / k^2.
    Cosine row k has cos^2(w / 2) / (2 T sin^4(w / 2)) if k is odd, else none: about 1 / k^4.

    Args:
      num_frames: window length T.
      band: "fourier" or "cosine".

    Returns:
      [T // 2 + 1] or [T]; the sum is that of t^2 over the window.
    """
    if band not in ("fourier", "cosine"):
        raise ValueError(f"the energy of a line is known by 'fourier' or 'cosine' modes, not {band!r}")
    mean_energy = num_frames * ((num_frames - 1) / 2.0) ** 2
    if band == "fourier":
        mode = np.arange(1, num_frames // 2 + 1)
        energy = num_frames / (2.0 * np.sin(np.pi * mode / num_frames) ** 2)
        energy = np.where(2 * mode == num_frames, energy / 2.0, energy)
    else:
        mode = np.arange(1, num_frames)
        half = np.pi * mode / (2.0 * num_frames)
        energy = np.cos(half) ** 2 / (2.0 * num_frames * np.sin(half) ** 4)
        energy = np.where(mode % 2 == 1, energy, 0.0)
    return np.concatenate([[mean_energy], energy])


def causal_filter(taps, num_frames: int) -> np.ndarray:
    """Return the matrix of a filter that sees zeros before the window, [T, T].

    Args:
      taps: weights of the frame itself, the one before it, ..., [L], L <= T.
      num_frames: window length T.
    """
    column = np.pad(np.asarray(taps, np.float64), (0, num_frames - len(taps)))
    return toeplitz(column, np.zeros(num_frames))


def wrapped_share(taps, num_frames: int, local_reach: int | None = None) -> float:
    """Return the least share of a causal filter that a block with all modes leaves.

    A spectral layer gives lag d and lag d - T one weight, because its window is a circle; a filter
    that sees zeros before the window has weight h_d on T - d entries of its matrix and 0 on the d
    entries that wrap. The best common weight is h_d (T - d) / T and leaves h_d^2 d (T - d) / T. A
    local branch has weights of its own up to its reach, and leaves nothing there.

    Args:
      taps: the filter, [L], L <= T, as in `causal_filter`.
      num_frames: window length T.
      local_reach: frames that a local branch sees to each side; None without one.

    Returns:
      The share, of the energy of the filter's matrix.

    Source: Eqs 2-4; T. Chan 1988 (the best circulant approximation).
    """
    energy = np.sum(causal_filter(taps, num_frames) ** 2)
    lag = np.arange(len(taps))
    left = np.asarray(taps, np.float64) ** 2 * lag * (num_frames - lag) / num_frames
    if local_reach is not None:
        left = np.where(np.minimum(lag, num_frames - lag) <= local_reach, 0.0, left)
    return float(left.sum() / energy)


def film_share(filters, num_channels: int) -> float:
    """Return the least share of a family of filters that one block under FiLM leaves.

    FiLM turns channels up and down, so that every filter of the family is a mixture of the same
    kernels, one a channel: a matrix of rank D, and the best one is the cut singular value
    decomposition (Eckart and Young 1936).

    Args:
      filters: a circular filter for each condition, [S, T].
      num_channels: D, kernels with gains of either sign; `film_for_filters` needs one channel more.

    Returns:
      The share, from 0 (the family can be had) to 1.
    """
    energy = np.linalg.svd(np.asarray(filters, np.float64), compute_uv=False) ** 2
    return float(energy[num_channels:].sum() / energy.sum())


def additive_share(filters) -> float:
    """Return the least share that a block leaves in which the condition is only added.

    Then the signal goes through one filter whatever the condition, at best through the mean.

    Args:
      filters: a circular filter for each condition, [S, T].
    """
    filters = np.asarray(filters, np.float64)
    return float(1.0 - np.sum(filters.mean(axis=0) ** 2) / np.mean(np.sum(filters**2, axis=1)))


def spectral_layer(kernels) -> SpectralConvolution:
    """Return a spectral layer with given kernels.

    Args:
      kernels: circular kernel from each channel in to each channel out, [D0, D1, T].

    Returns:
      The layer, with all T // 2 + 1 modes.
    """
    kernels = np.asarray(kernels, np.float64)
    width_in, width_out, num_frames = kernels.shape
    weights = np.moveaxis(np.fft.rfft(kernels, axis=-1), -1, 0)
    layer = SpectralConvolution(width_in, width_out, len(weights), rngs=nnx.Rngs(0))
    layer.weight_real[...] = jnp.asarray(weights.real, jnp.float32)
    layer.weight_imag[...] = jnp.asarray(weights.imag, jnp.float32)
    return layer


def film_for_filters(filters, num_channels: int | None = None) -> tuple[SpectralConvolution, FiLM]:
    """Return a spectral layer and a FiLM layer that are a family of filters, by set weights.

    The gate of Eq. 6 lies between 0 and 2, so that a gain of either sign is written as a gate less
    1; the last channel takes the ones away again. The first two channels that leave Eq. 7 are
    SiLU(y) and SiLU(-y), whose difference is y, since SiLU(y) - SiLU(-y) = y for every y.

    Args:
      filters: a circular filter for each of S conditions, [S, T].
      num_channels: kernels to use, at most min(S, T); by default as many as the family needs. With
        fewer, the filters are the best that `film_share` tells of.

    Returns:
      (base [1 channel to D], FiLM for one-hot conditions [S]), D = num_channels + 1.

    Raises:
      ValueError: for a number of kernels out of range.
    """
    filters = np.asarray(filters, np.float64)
    left, size, right = np.linalg.svd(filters, full_matrices=False)
    used = int(np.sum(size > 1e-9 * size[0])) if num_channels is None else num_channels
    if not 1 <= used <= len(size):
        raise ValueError(f"num_channels must be between 1 and {len(size)}, got {used}")
    gains = left[:, :used] * size[:used]
    largest = 1.25 * np.abs(gains).max()
    kernels = np.concatenate([largest * right[:used], largest * right[:used].sum(0)[None]])
    width = used + 1
    film = FiLM(width, len(filters), rngs=nnx.Rngs(0))
    gamma = np.pad(np.arctanh(gains / largest), ((0, 0), (0, 1)))
    film.modulation.kernel[...] = jnp.asarray(np.pad(gamma, ((0, 0), (0, width))), jnp.float32)
    signs = np.append(np.ones(used), -1.0)
    output = np.zeros((width, width))
    output[:, 0], output[:, 1] = signs, -signs
    film.output.kernel[...] = jnp.asarray(output, jnp.float32)
    return spectral_layer(kernels[None]), film


def film_delay_line(num_blocks: int, num_frames: int) -> list[tuple[SpectralConvolution, FiLM]]:
    """Return blocks of two channels that delay a signal by any number below 2^N, by set weights.

    Block n holds the signal and the signal 2^n frames later; FiLM shuts one of the two. So the
    condition, N bits written as -1 and 1, lowest first, is the delay.

    Args:
      num_blocks: N.
      num_frames: window length T; delays wrap around.

    Returns:
      For each block (base [2 to 2], FiLM for conditions [N]). Blocks read and write SiLU(y) and
      SiLU(-y), whose difference is y.
    """
    blocks = []
    for number in range(num_blocks):
        delays = np.zeros((2, num_frames))
        delays[0, 0] = 1.0
        delays[1, 2**number % num_frames] = 1.0
        film = FiLM(2, num_blocks, rngs=nnx.Rngs(0))
        modulation = np.zeros((num_blocks, 4))
        # tanh(20) is 1 to rounding: gates of exactly 0 and 2.
        modulation[number, :2] = -20.0, 20.0
        film.modulation.kernel[...] = jnp.asarray(modulation, jnp.float32)
        film.output.kernel[...] = jnp.asarray([[0.5, -0.5], [0.5, -0.5]], jnp.float32)
        blocks.append((spectral_layer(np.stack([delays, -delays])), film))
    return blocks


def without_activation(layer, base, z, c):
    """Return what a conditioning layer makes before the SiLU of Eq. 7.

    The layer is asked twice, the second time with a negative output layer: SiLU(y) - SiLU(-y) = y.
    A layer without an output layer (AdaLN-zero) has no SiLU either, and is asked once.

    Args:
      layer: from `conditioning.conditioning_layer`.
      base, z, c: what it is called with.
    """
    if not hasattr(layer, "output"):
        return layer(base, z, c)
    negative = nnx.clone(layer)
    negative.output.kernel[...] = -layer.output.kernel[...]
    negative.output.bias[...] = -layer.output.bias[...]
    return layer(base, z, c) - negative(base, z, c)


def interaction_map(way, z, c, frame: int) -> np.ndarray:
    """Return how strongly frames of a condition change what frames of a signal do.

    Where the mixed derivative is 0, condition and signal are only added.

    Args:
      way: (z [1, T, D], c [1, T, C_cond]) -> [1, T', D].
      z, c: where the derivative is taken, [T, D] and [T, C_cond].
      frame: of the output.

    Returns:
      Norms of d^2 out[frame] / d c[s] d z[u], [T of c, T of z].
    """
    out = lambda c, z: way(z[None], c[None])[0, frame]
    mixed = jax.jit(jax.jacfwd(jax.jacrev(out, argnums=0), argnums=1))(c, z)
    return np.sqrt(np.asarray((mixed**2).sum(axis=(0, 2, 4))))
