"""Judgements on theory that the library reaches by computing, without any record (claims T1 to T3)."""

from collections.abc import Sequence
from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from f3amd_companion.ledger.evidence import Figure
from f3amd_companion.ledger.judgements import FAILS, HOLDS, TOLERANCE, Finding, equal_range, within
from f3amd_lib.diffusion import samplers, schedules
from f3amd_lib.diffusion.oracles import GaussianMixture
from f3amd_lib.networks.attention import TransformerBlock
from f3amd_lib.networks.config import LayerKeys
from f3amd_lib.networks.counting import count_flops
from f3amd_lib.networks.spectral import FNOBlock, SpectralConvolution, count_modes

ROUNDING = 1e-12
"""Two float64 computations of one number agree to this; 16 digits less a few."""

_MODES = GaussianMixture([-1.0, 1.0], width=0.1)
_SIZES = [(frames, width) for frames in (16, 32, 64) for width in (32, 96)]


def _agreement(error: float) -> Finding:
    size = f"below {ROUNDING:g}" if error < ROUNDING else f"{error:.1e}"
    return HOLDS if error < ROUNDING else FAILS, f"largest difference {size}"


def ve_is_vp(_) -> Finding:
    """Judge whether sqrt(alpha_bar) times the VE state is the VP state."""
    rng = np.random.default_rng(0)
    sigma = np.geomspace(1e-3, 1e3, 400)[:, None]
    x0, noise = rng.standard_normal((2, len(sigma), 16))
    alpha_bar = schedules.alpha_bar_from_sigma(sigma)
    carried = np.sqrt(alpha_bar) * samplers.add_noise(x0, sigma, noise)
    return _agreement(float(np.abs(carried - (np.sqrt(alpha_bar) * x0 + np.sqrt(1.0 - alpha_bar) * noise)).max()))


def _rescaled(x, x0_hat, sigma, sigma_next):
    """Take the printed update between rescalings to and from the VP state."""
    alpha_bar, alpha_bar_next = map(schedules.alpha_bar_from_sigma, (sigma, sigma_next))
    return samplers.ddim_step_vp(np.sqrt(alpha_bar) * x, x0_hat, alpha_bar, alpha_bar_next) / np.sqrt(alpha_bar_next)


_STEPS = {"Euler": samplers.SAMPLERS["euler"].step, "rescaled": _rescaled, "printed": samplers.ddim_step_literal}


def _walk(update: str, num_steps: int) -> np.ndarray:
    """Return where steps lead noise with an exact denoiser of two modes, [512, 1]."""
    levels = schedules.variance_exploding().grid(num_steps)
    x = levels[0] * np.random.default_rng(0).standard_normal((512, 1))
    for sigma, sigma_next in pairwise(levels):
        x = _STEPS[update](x, _MODES.denoise(x, sigma), sigma, sigma_next)
    return x


def ddim_is_euler(_) -> Finding:
    """Judge whether the rescaled update is the Euler step in sigma."""
    return _agreement(max(np.abs(_walk("rescaled", n) - _walk("Euler", n)).max() for n in (1, 2, 4, 8, 64)))


def reaches_data(_, update) -> Finding:
    """Judge whether samples end near the modes at -1 and +1 when steps are plenty."""
    size = Figure.of(np.abs(_walk(update, 256)).mean())
    return within(size, equal_range(TOLERANCE)), f"mean |x| {size.value:.3f} after 256 steps (data: 1)"


def _operations(block: type, frames: int, width: int, *sizes) -> int:
    """Count the operations of a block on one window, without building its weights."""
    graph, state = nnx.split(nnx.eval_shape(lambda: block(*sizes, rngs=LayerKeys(jax.random.key(0)))))
    window = jax.ShapeDtypeStruct((1, frames, width), jnp.float32)
    return count_flops(lambda state, z: nnx.merge(graph, state)(z), state, window)


def _fit_terms(counts: Sequence[int], terms: Sequence[Sequence[float]]) -> tuple[np.ndarray, str]:
    """Fit counts by multiples of terms; return them, and whether they fit."""
    scaled = np.asarray(terms, dtype=np.float64) / np.asarray(counts, dtype=np.float64)[:, None]
    factors = np.linalg.lstsq(scaled, np.ones(len(counts)), rcond=None)[0]
    return factors, HOLDS if np.abs(scaled @ factors - 1.0).max() < 1e-9 else FAILS


def attention_cost(_) -> Finding:
    """Judge whether attention costs a T D² + b T² D."""
    counts = [_operations(TransformerBlock, t, d, d, 2, 4 * d) for t, d in _SIZES]
    (linear, pairs), verdict = _fit_terms(counts, [(t * d * d, t * t * d) for t, d in _SIZES])
    return verdict, f"{linear:.0f} T D² + {pairs:.0f} T² D operations"


def spectral_cost(_) -> Finding:
    """Judge whether the spectral branch costs a m D² + b T m D."""
    sizes = [(t, d, m) for t, d in _SIZES for m in (4, count_modes("fourier", t))]
    counts = [_operations(SpectralConvolution, t, d, d, d, m) for t, d, m in sizes]
    (product, transform), verdict = _fit_terms(counts, [(m * d * d, t * m * d) for t, d, m in sizes])
    return verdict, f"{product:.0f} m D², and {transform:.0f} T m D for transforms as matrices"


def local_cost(_) -> Finding:
    """Judge whether the two convolutions of an FNO block are small beside its spectral product."""
    frames, width = 32, 96
    modes = count_modes("fourier", frames)
    spectral = _operations(SpectralConvolution, frames, width, width, width, modes)
    local = _operations(FNOBlock, frames, width, width, width, modes) - spectral
    # Without modes, nothing but the transforms would be left of the spectral branch.
    share = local / (spectral - 8 * frames * modes * width)
    text = f"two convolutions cost {share:.2f} times the spectral product (T = 32, m = 17, k = 3)"
    return HOLDS if share <= TOLERANCE else FAILS, text
