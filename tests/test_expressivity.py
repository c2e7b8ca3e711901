"""What layers can express: closed forms against brute force, set weights against plain numpy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from builders import SKELETON
from f3amd_notebooks import expressivity as ex
from flax import nnx

from f3amd_lib.motion.rotations import matrix_from_yaw, rotation_6d_from_matrix

# -------------------------------------------------------------------------------------- modes


@pytest.mark.parametrize("num_frames", [7, 8])
def test_keeping_fourier_modes_is_cutting_an_fft(num_frames):
    x = np.random.default_rng(0).standard_normal((2, num_frames, 3))
    for modes in range(1, num_frames // 2 + 2):
        spectrum = np.fft.rfft(x, axis=1)
        spectrum[:, modes:] = 0
        expected = np.fft.irfft(spectrum, n=num_frames, axis=1)
        np.testing.assert_allclose(ex.keep_modes(x, modes), expected, atol=1e-12)


# ------------------------------------------------------------------------------------- motion


def walking_frames(num_frames=16, windows=2):
    """Windows that walk along z, turn a little, and swing the left leg twice a window."""
    time = np.arange(num_frames) / num_frames
    rotations = np.tile(np.eye(3), (windows, num_frames, SKELETON.num_joints, 1, 1))
    swing = 0.4 * np.sin(4 * np.pi * time)
    rotations[:, :, 2] = np.swapaxes(matrix_from_yaw(swing), -1, -2)[:, [1, 0, 2]][:, :, [1, 0, 2]]
    root = np.stack([0 * time, 0 * time + 1.0, 1.2 * time], axis=-1)
    flat = np.asarray(rotation_6d_from_matrix(rotations)).reshape(windows, num_frames, -1)
    return np.concatenate([np.tile(root, (windows, 1, 1)), flat], axis=-1)


def test_a_walk_costs_its_root_at_the_ends_and_a_line_mends_it():
    table = ex.band_limit_errors(SKELETON, walking_frames(), (1, 3, 9))
    error = table.groupby(["band", "group", "num_kept_modes"])["error_cm"].mean()
    # With one mode the root stands in the middle of 16 frames of 7.5 cm.
    np.testing.assert_allclose(error["fourier", "root", 1], 7.5 * 4.0)
    assert error["fourier", "root", 3] > 20 * error["fourier beside a line", "root", 3]
    assert error["fourier", "root", 3] > 4 * error["cosine", "root", 3]
    assert all(error[band, "root", 9] < 1e-9 for band in ex.BANDS)
    # The pose swings twice a window: three modes hold its features, one does not.
    assert error["fourier", "toes", 3] < 0.1 * error["fourier", "toes", 1]
    by_frame = table[(table["band"] == "fourier") & (table["group"] == "root")]
    by_frame = by_frame[by_frame["num_kept_modes"] == 3]["error_cm"].to_numpy()
    assert by_frame[0] > 3 * by_frame[4:12].mean()
    np.testing.assert_allclose(by_frame[0], by_frame[-1])


# -------------------------------------------------------------------------------------- seams


@pytest.mark.parametrize("num_frames", [15, 16])
def test_energy_of_a_line_is_that_of_its_transform(num_frames):
    line = np.arange(num_frames, dtype=float)
    spectrum = np.abs(np.fft.rfft(line)) ** 2 / num_frames
    spectrum[1 : (num_frames + 1) // 2] *= 2
    np.testing.assert_allclose(ex.ramp_energy(num_frames), spectrum, rtol=1e-10)
    from scipy.fft import dct

    expected = dct(line, norm="ortho") ** 2
    np.testing.assert_allclose(ex.ramp_energy(num_frames, "cosine"), expected, atol=1e-9)


def least_squares_share(target, parts):
    columns = np.stack([part.ravel() for part in parts], axis=1)
    fit = columns @ np.linalg.lstsq(columns, target.ravel(), rcond=None)[0]
    return np.sum((target.ravel() - fit) ** 2) / np.sum(target**2)


@pytest.mark.parametrize("reach", [None, 0, 2])
def test_the_share_that_wraps_is_what_least_squares_leave(reach):
    num_frames = 12
    parts = [np.roll(np.eye(num_frames), lag, axis=0) for lag in range(num_frames)]
    if reach is not None:
        parts += [np.eye(num_frames, k=lag) for lag in range(-reach, reach + 1)]
    rng = np.random.default_rng(0)
    for taps in (np.ones(1), np.array([1.0, -1.0]), np.ones(5), rng.standard_normal(12)):
        expected = least_squares_share(ex.causal_filter(taps, num_frames), parts)
        np.testing.assert_allclose(ex.wrapped_share(taps, num_frames, reach), expected, atol=1e-12)


# ----------------------------------------------------------------------- filters by condition


def circular(signal, kernel):
    return np.fft.irfft(np.fft.rfft(signal) * np.fft.rfft(kernel), n=len(signal))


def through(base, film, signal, conditions):
    """A signal [T] under each condition [S, C], after the pair of SiLUs."""
    shape = (len(conditions), len(signal), 1)
    z = jnp.broadcast_to(jnp.asarray(signal, jnp.float32)[None, :, None], shape)
    c = jnp.repeat(jnp.asarray(conditions, jnp.float32)[:, None], len(signal), axis=1)
    out = np.asarray(jax.jit(lambda z, c: film(base, z, c))(z, c))
    return out[..., 0] - out[..., 1]


def test_film_has_every_family_of_low_rank_exactly():
    rng = np.random.default_rng(0)
    filters = rng.standard_normal((5, 2)) @ rng.standard_normal((2, 12))
    base, film = ex.film_for_filters(filters)
    assert film.output.kernel[...].shape == (3, 3)  # two kernels and one more
    signal = rng.standard_normal(12)
    expected = [circular(signal, kernel) for kernel in filters]
    np.testing.assert_allclose(through(base, film, signal, np.eye(5)), expected, atol=1e-4)


def test_three_blocks_of_two_channels_have_all_eight_delays():
    signal = np.random.default_rng(4).standard_normal(8)
    blocks = ex.film_delay_line(3, 8)
    delays = np.arange(8)
    bits = 2.0 * ((delays[:, None] >> np.arange(3)) & 1) - 1.0

    @jax.jit
    def delayed(c):
        z = nnx.silu(jnp.asarray(np.stack([signal, -signal], -1)[None], jnp.float32))
        z = jnp.broadcast_to(z, (8, 8, 2))
        for base, film in blocks:
            z = film(base, z, c)
        return z[..., 0] - z[..., 1]

    out = delayed(jnp.repeat(jnp.asarray(bits, jnp.float32)[:, None], 8, axis=1))
    np.testing.assert_allclose(out, [np.roll(signal, delay) for delay in delays], atol=1e-5)
