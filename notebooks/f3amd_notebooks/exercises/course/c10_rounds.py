"""Exercises of the course's notebook 10: how errors add up over rounds, and what the prior does to a round."""

from __future__ import annotations

import numpy as np
from f3amd_lib.diffusion.oracles import GaussianMixture

from f3amd_notebooks.exercises.judging import NotAnswered, agree, numbers, too


def _sum_of_faults(answer) -> str | None:
    for a, beta, rounds in ((0.8, 0.5, 7), (1.3, -0.2, 5), (-0.5, 1.0, 3), (0.9, 2.0, 0), (1.0, 0.3, 6)):
        right = 0.0
        for _ in range(rounds):
            right = a * right + beta
        found = numbers(answer(a, beta, rounds))
        if found.size != 1:
            raise NotAnswered("return one number: the error after all rounds")
        found = float(found.reshape(()))
        if agree(found, right, rtol=1e-4, atol=1e-6):
            continue
        if a == 1.0:
            return "for a = 1 this is not right: there every round adds beta, and nothing else happens"
        if rounds == 0:
            return "before the first round there is no error yet"
        if agree(found, rounds * beta, rtol=1e-4):
            return "this is a sum of equal faults; the fault of the first round goes through all later ones"
        if agree(found, beta * a**rounds, rtol=1e-4):
            return "this is one fault that went through all rounds; every round adds another"
        if agree(found, beta / (1 - a), rtol=1e-4):
            return "this is where a stable rollout ends; how far is it after so few rounds?"
        if agree(found, a * right, rtol=1e-4) or agree(found, a * right + beta, rtol=1e-4):
            return "this is a round off: the last fault has not been multiplied yet, and the first one n - 1 times"
        return f"for a = {a:g} after {rounds} rounds the error is {too(found, right)}; write down the first three"
    return None


def _round_by_the_flow(answer) -> str | None:
    for a, q, sigma_max in ((0.9, 1.0, 2.0), (1.1, 0.3, 0.5), (-0.7, 2.0, 3.0)):

        def end(x, noise, a=a, q=q, sigma_max=sigma_max):
            """Where the exact flow leads from the noise, if the last number was x."""
            return float(GaussianMixture([a * x], width=q).flow(np.array([sigma_max * noise]), sigma_max, 0.0)[0])

        # A round is linear: its answer to 1 in the place of the last number, or of the noise, is the factor.
        gain, width = end(1.0, 0.0), end(0.0, 1.0)
        found = numbers(answer(a, q, sigma_max))
        if found.shape != (2,):
            raise NotAnswered("return two numbers: the gain, and the width of a round's noise")
        if agree(found, (width, gain), rtol=1e-4):
            return "these are the two, but in the other order"
        if agree(found[0], a, rtol=1e-4):
            return "this gain is the data's; but the walk begins around 0, and a share of that stays to the end"
        if agree(found[0], a - gain, rtol=1e-4):
            return "this is what is lost of the gain: the share of the beginning that stays"
        if not agree(found[0], gain, rtol=1e-4):
            return (
                f"at sigma_max = {sigma_max:g} the gain is {too(found[0], gain)}; "
                "the flow keeps (y - a x) over its width"
            )
        if agree(found[1], q, rtol=1e-4):
            return "the gain is right, but this width is the data's; how wide is the beginning, and which share stays?"
        if not agree(found[1], width, rtol=1e-4):
            return (
                f"the gain is right, but the noise is {too(found[1], width)}; it begins with the width sigma_max, "
                "and the same share of it is kept"
            )
    return None


CHECKS = {"C10.a": _sum_of_faults, "C10.b": _round_by_the_flow}
"""By number, a function of the answer that returns None if it is right, else a hint."""
