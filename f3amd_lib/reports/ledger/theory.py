"""Rules of the claims on theory (T1 to T5); the first three are computed, not measured."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
from flax import nnx

from f3amd_lib.diffusion import samplers, schedules
from f3amd_lib.diffusion.oracles import GaussianMixture
from f3amd_lib.networks.attention import TransformerBlock
from f3amd_lib.networks.counting import count_flops
from f3amd_lib.networks.spectral import FNOBlock, SpectralConvolution, count_modes
from f3amd_lib.reports.ledger.evidence import Evidence, Figure, NotMeasured
from f3amd_lib.reports.ledger.verdicts import (
    BROKEN,
    CAMDM,
    FAILS,
    FNO_96,
    HOLDS,
    MINOR,
    ROUNDING,
    TOLERANCE,
    Finding,
    Statement,
    alike,
    number,
    state,
    within,
)


def _rounding_verdict(error: float) -> Finding:
    told = f"below {ROUNDING:g}" if error < ROUNDING else f"{error:.1e}"
    return HOLDS if error < ROUNDING else FAILS, f"largest difference {told}"


def _ve_is_vp(_) -> Finding:
    rng = np.random.default_rng(0)
    sigma = np.geomspace(1e-3, 1e3, 400)[:, None]
    x0, noise = rng.standard_normal((2, len(sigma), 16))
    alpha_bar = schedules.alpha_bar_from_sigma(sigma)
    carried = np.sqrt(alpha_bar) * samplers.add_noise(x0, sigma, noise)
    preserving = np.sqrt(alpha_bar) * x0 + np.sqrt(1.0 - alpha_bar) * noise
    return _rounding_verdict(float(np.abs(carried - preserving).max()))


def _rule_t1(evidence: Evidence) -> Iterator[Statement]:
    says = "sqrt(alpha_bar) times the VE state is the VP state, for sigma from 0.001 to 1,000"
    yield state(evidence, says, _ve_is_vp)


def _walk(step: Callable, x: np.ndarray, levels: np.ndarray) -> np.ndarray:
    for sigma, sigma_next in zip(levels, levels[1:], strict=False):
        x = step(x, sigma, sigma_next)
    return x


_MODES = GaussianMixture([-1.0, 1.0], width=0.1)


def _euler_step(x, sigma, sigma_next):
    slope = samplers.probability_flow_slope(x, _MODES.denoise(x, sigma), sigma)
    return x + (sigma_next - sigma) * slope


def _printed_step(x, sigma, sigma_next):
    """Take the update of Appendix F and hand its answer, a VP state, on as a VE state."""
    x0_hat = _MODES.denoise(x, sigma)
    eps_hat = (x - x0_hat) / sigma
    alpha_bar_next = schedules.alpha_bar_from_sigma(sigma_next)
    return np.sqrt(alpha_bar_next) * x0_hat + np.sqrt(1.0 - alpha_bar_next) * eps_hat


def _rescaled_step(x, sigma, sigma_next):
    """Take the same update between rescalings to and from the VP state."""
    alpha_bar, alpha_bar_next = map(schedules.alpha_bar_from_sigma, (sigma, sigma_next))
    z = samplers.ddim_step_vp(np.sqrt(alpha_bar) * x, _MODES.denoise(x, sigma), alpha_bar, alpha_bar_next)
    return z / np.sqrt(alpha_bar_next)


def _noise_and_grid(num_steps: int) -> tuple[np.ndarray, np.ndarray]:
    grid = schedules.VarianceExploding().grid(num_steps)
    return grid[0] * np.random.default_rng(0).standard_normal((512, 1)), grid


def _ddim_is_euler(_) -> Finding:
    errors = []
    for num_steps in (1, 2, 4, 8, 64):
        start, grid = _noise_and_grid(num_steps)
        apart = _walk(_rescaled_step, start, grid) - _walk(_euler_step, start, grid)
        errors.append(np.abs(apart).max())
    return _rounding_verdict(float(max(errors)))


def _reaches_data(_, step: Callable) -> Finding:
    """Judge whether samples end near the modes at -1 and +1 when steps are plenty."""
    size = Figure.of(float(np.abs(_walk(step, *_noise_and_grid(256))).mean()))
    return within(size, alike(TOLERANCE)), f"mean |x| {size.value:.3f} after 256 steps (data: 1)"


def _rule_t2(evidence: Evidence) -> Iterator[Statement]:
    says = "with the state rescaled, the update is the Euler step in sigma"
    yield state(evidence, says, _ddim_is_euler)
    says = "with the state rescaled, it reaches the data of an exact denoiser"
    yield state(evidence, says, _reaches_data, _rescaled_step)
    says = "as printed, without rescaling, it reaches the data of an exact denoiser"
    yield state(evidence, says, _reaches_data, _printed_step)


def _operations(build: Callable, frames: int, width: int) -> int:
    """Count the operations of a block on one window, without building its weights."""
    block = nnx.eval_shape(lambda: build(nnx.Rngs(params=jax.random.key(0))))
    graph, state = nnx.split(block)
    window = jax.ShapeDtypeStruct((1, frames, width), jnp.float32)
    return count_flops(lambda state, z: nnx.merge(graph, state)(z), state, window)


def _count_attention(frames: int, width: int) -> int:
    return _operations(lambda rngs: TransformerBlock(width, 2, 4 * width, rngs=rngs), frames, width)


def _count_spectral(frames: int, width: int, modes: int) -> int:
    return _operations(lambda rngs: SpectralConvolution(width, width, modes, rngs=rngs), frames, width)


def _count_fno(frames: int, width: int, modes: int) -> int:
    return _operations(lambda rngs: FNOBlock(width, width, modes, rngs=rngs), frames, width)


def _fit_terms(counts: Sequence[int], terms: Sequence[Sequence[float]]) -> tuple[np.ndarray, float]:
    """Fit counts by multiples of terms; return them and the largest relative error."""
    terms = np.asarray(terms, dtype=np.float64)
    counts = np.asarray(counts, dtype=np.float64)
    scaled = terms / counts[:, None]
    factors = np.linalg.lstsq(scaled, np.ones(len(counts)), rcond=None)[0]
    return factors, float(np.abs(scaled @ factors - 1.0).max())


_SIZES = [(frames, width) for frames in (16, 32, 64) for width in (32, 96)]


def _attention_cost(_) -> Finding:
    counts = [_count_attention(*size) for size in _SIZES]
    (linear, pairs), error = _fit_terms(counts, [(t * d * d, t * t * d) for t, d in _SIZES])
    told = f"{linear:.0f} T D² + {pairs:.0f} T² D operations"
    return HOLDS if error < 1e-9 else FAILS, told


def _spectral_cost(_) -> Finding:
    sizes = [(t, d, m) for t, d in _SIZES for m in (4, count_modes("fourier", t))]
    counts = [_count_spectral(*size) for size in sizes]
    terms = [(m * d * d, t * m * d) for t, d, m in sizes]
    (product, transform), error = _fit_terms(counts, terms)
    told = f"{product:.0f} m D², and {transform:.0f} T m D for transforms as matrices"
    return HOLDS if error < 1e-9 else FAILS, told


def _local_cost(_) -> Finding:
    frames, width = 32, 96
    modes = count_modes("fourier", frames)
    counted = _count_spectral(frames, width, modes)
    local = _count_fno(frames, width, modes) - counted
    # Without modes, nothing but the transforms would be left of the spectral branch.
    product = counted - 8 * frames * modes * width
    share = local / product
    told = f"two convolutions cost {share:.2f} times the spectral product (T = 32, m = 17, k = 3)"
    return HOLDS if share <= TOLERANCE else FAILS, told


def _rule_t3(evidence: Evidence) -> Iterator[Statement]:
    yield state(evidence, "attention costs a T D² + b T² D", _attention_cost)
    says = "the spectral branch costs m D² beside its transforms (T log T D with an FFT)"
    yield state(evidence, says, _spectral_cost)
    yield state(evidence, "the rest of an FNO block is small beside that", _local_cost)


def _x0_errors(evidence: Evidence, model: str) -> pd.DataFrame:
    table = evidence.table("x0_by_sigma")
    curve = table[table["model"] == model].sort_values("sigma")
    if len(curve) < 3:
        raise NotMeasured(f"x0_by_sigma.csv has no three noise levels of {model}")
    return curve


def _consistent(evidence: Evidence, model: str) -> Finding:
    error = _x0_errors(evidence, model)["value"]
    spread = Figure.of(error.max() / error.min())
    return within(spread, (0.0, BROKEN)), f"x0 error differs by {number(spread.value)}x"


def _more_consistent(evidence: Evidence, model: str, other: str) -> Finding:
    """Compare how x0 errors spread over the noise levels that both models know."""
    curves = [_x0_errors(evidence, name) for name in (model, other)]
    low = max(curve["sigma"].min() for curve in curves)
    high = min(curve["sigma"].max() for curve in curves)
    spreads = []
    for name, curve in zip((model, other), curves, strict=True):
        shared = curve.loc[curve["sigma"].between(low, high), "value"]
        if len(shared) < 3:
            raise NotMeasured(f"x0_by_sigma.csv has no three levels of {name} that both models know")
        spreads.append(shared.max() / shared.min())
    more = Figure.of(spreads[1] / spreads[0])
    told = f"{number(spreads[0])}x against {number(spreads[1])}x"
    return within(more, (1.0 + TOLERANCE, np.inf)), told


def _rule_t4(evidence: Evidence) -> Iterator[Statement]:
    says = "FNO-96 (VE): x0 error over all noise levels differs by less than 2 times"
    yield state(evidence, says, _consistent, FNO_96.model)
    says = "CAMDM trained with VE is more consistent than with VP, by 10 % or more"
    yield state(evidence, says, _more_consistent, "CAMDM-VE", CAMDM.model)


def _high_noise_bias(evidence: Evidence) -> Finding:
    table = evidence.table("gradient_norm").sort_values("sigma")
    third = len(table) // 3
    if third < 1:
        raise NotMeasured("gradient_norm.csv has no three noise levels")
    norms = table["value"].to_numpy(np.float64)
    low, high = (float(np.exp(np.log(x).mean())) for x in (norms[:third], norms[-third:]))
    gain = Figure.of(high / low)
    told = f"{number(gain.value)}x from the lowest to the highest third of sigma"
    return within(gain, (1.0 + MINOR, np.inf)), told


def _rule_t5(evidence: Evidence) -> Iterator[Statement]:
    says = "the gradient is at least 30 % larger at high noise than at low"
    yield state(evidence, says, _high_noise_bias)


RULES = {"T1": _rule_t1, "T2": _rule_t2, "T3": _rule_t3, "T4": _rule_t4, "T5": _rule_t5}
"""Claim -> its rule."""

COMPUTED = frozenset({"T1", "T2", "T3"})
"""Claims that the library decides by computing, without any record."""
