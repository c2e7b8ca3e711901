"""Exercises of notebooks 10 and 11: answers that one can easily come to, and that are wrong."""

import numpy as np
import pytest
from helpers.exercises import hint
from helpers.exercises.printed_update import _distance_of_updates

from f3amd_lib.diffusion import samplers

# Notebook 10


def test_the_mended_step_is_ddim_in_the_exploding_state():
    assert hint("10.a", samplers.ddim_step) is None
    assert "printed line itself" in hint("10.a", samplers.ddim_step_literal)
    wrong_way = lambda *given: samplers.ddim_step_literal(*given) / np.sqrt(1 + given[3] ** 2)
    by_sigma = lambda *given: samplers.ddim_step_literal(*given) * np.sqrt(1 + given[2] ** 2)
    for step in (wrong_way, by_sigma, lambda *given: 0.0 * given[0]):
        assert "not DDIM's step" in hint("10.a", step)


def test_the_first_level_takes_no_factor_from_the_spread():
    assert hint("10.b", [1.0, 4.03e-3, 1.59e-16]) is None
    assert hint("10.b", [1 / 128, 4.03e-3 / 128, 1.59e-16 / 128])
    assert hint("10.b", [1.0, 4.03e-3, 0.0])
    assert "three numbers" in hint("10.b", 4.03e-3)


def test_a_telling_width_is_accepted_within_five_percent():
    assert hint("10.c", 0.198) is None and hint("10.c", 0.205) is None
    assert hint("10.c", 0.22) and hint("10.c", 0.18)
    assert "positive" in hint("10.c", -0.2)
    assert f"{_distance_of_updates(0.5):.3f} apart" in hint("10.c", 0.5)


@pytest.mark.parametrize("verdict", [True, False])
def test_a_test_that_always_says_the_same_is_no_test(verdict):
    assert "of the five" in hint("10.d", lambda sampler: verdict)
    assert "True or False" in hint("10.d", lambda sampler: float(verdict))
    assert "returns nothing" in hint("10.d", lambda sampler: None)


def test_one_step_alone_cannot_tell_whether_a_sampler_rescales():
    def one_step(sampler):
        made = sampler(lambda x, sigma: x / (1.0 + sigma**2), np.full((1, 1), 128.0), [128.0, 0.0])
        return bool(abs(float(np.asarray(made).item())) > 1e-4)

    assert hint("10.d", one_step)


def test_a_blind_networks_samples_are_the_same_under_both_updates():
    assert hint("10.e", [82.45, 1.0013, 0.0]) is None
    assert "last step" in hint("10.e", [82.45, 1.0013, 81.4])
    assert "shown second" in hint("10.e", [82.34, 128.0, 0.0])


# Notebook 11


@pytest.mark.parametrize("answer", [1.0, 0.7, -1.0, 0.0, [0.4, 0.4]])
def test_one_step_does_not_vote(answer):
    assert hint("11.a", 0.4) is None
    assert hint("11.a", answer)


def test_variances_add_and_deviations_do_not():
    assert hint("11.b", [4.0, 5.0]) is None
    assert "variances add" in hint("11.b", [2.0, 5.0])
    assert "one answer" in hint("11.b", [4.0, 8.0])
    assert "two numbers" in hint("11.b", 4.0)


def test_ways_at_two_are_told_apart_at_twice_the_noise_of_ways_at_one():
    assert hint("11.c", 2 * 0.726) is None
    assert "left open" in hint("11.c", 0.73) and "left open" in hint("11.c", 2.9)


def test_levels_must_be_where_the_side_is_decided():
    assert hint("11.d", [128, 6, 3, 1]) is None
    papers = hint("11.d", [128, 40.41, 6.06, 0.01])
    assert "hit the wall" in papers
    for wrong in ([60, 6, 3, 1], [128, 3, 6, 1], [128, 6, 3, 0]):
        assert "128" in hint("11.d", wrong)
    assert "four" in hint("11.d", [128, 6, 1])


def test_a_hint_right_for_two_thirds_clears_the_wall():
    assert hint("11.e", 0.68) is None
    assert hint("11.e", 0.5) and hint("11.e", 0.9) and hint("11.e", 0.36)
