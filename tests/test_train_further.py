"""`scripts/train_further.py`: clips at several speeds are what they say, and windows of several sets are one set."""

import jax.numpy as jnp
import numpy as np
import train_further
from builders import packed_from, straight_motion

from f3amd_lib.data.windows import build_windows, gather_windows


def windows_at(speed: float):
    packed = packed_from([(straight_motion(), 0, 0)])
    return build_windows(train_further.AtSpeed(packed, speed), "train", window=16, num_history=4)


def cut(windows, *index):
    count = len(index)
    return gather_windows(windows, jnp.array(index), jnp.zeros(count), jnp.zeros(count, jnp.int32))


def test_a_clip_at_half_its_speed_takes_steps_of_half_the_length():
    steps = [np.linalg.norm(np.diff(cut(windows_at(speed), 3).future[0, :, [0, 2]])) for speed in (1.0, 0.5)]
    np.testing.assert_allclose(steps[1], steps[0] / 2, rtol=1e-3)
    assert windows_at(0.5).num_windows > 2 * windows_at(1.0).num_windows


def test_windows_of_two_sets_are_those_of_each():
    one, other = windows_at(1.0), windows_at(0.5)
    both = train_further.together([one, other])
    assert both.num_windows == one.num_windows + other.num_windows
    for ours, alone, index in [(cut(both, 5), one, 5), (cut(both, one.num_windows + 7), other, 7)]:
        for whole, part in zip(ours, cut(alone, index), strict=True):
            np.testing.assert_array_equal(whole, part)
