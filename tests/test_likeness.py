"""The fingerprint of the paper's network: the paper passes its own lines, unlike networks fail theirs."""

import numpy as np
import pandas as pd
import pytest

from f3amd_companion.measuring.fingerprint import LINES, likeness, likeness_of_readings, paper_figures

REAL = pd.Series(
    {"IRD": 4.1, "direction_error": 4.2, "trajectory_error": 0.029, "smoothness": 2.1, "foot_all_frames": 1.02}
)


def test_the_papers_own_network_is_like_itself():
    table = likeness(paper_figures(), REAL)
    assert list(table["line"]) == list(LINES) and (table["distance"] == 0.0).all()
    np.testing.assert_allclose(table["ours"], table["paper"])


@pytest.mark.parametrize(
    ("change", "fails"),
    [
        (lambda t: t.assign(IRD=0.0 * t["IRD"] + 1e-3), "IRD"),  # it sticks at the seams
        (lambda t: t.assign(IRD=4.1), "IRD"),  # so do not people
        (lambda t: t.assign(smoothness=1.2), "smoothness"),  # the root shakes as the joints do
        (lambda t: t.assign(direction_error=8.5), "direction_error"),
        (lambda t: t.assign(trajectory_error=0.057), "trajectory_error"),
        (lambda t: t.assign(foot_all_frames=1.0), "foot_all_frames"),
        (lambda t: t.assign(IRD=[1.8, 1.8, 1.7, 1.6]), "plateau_8_4"),  # steps 1, 2, 4, 8
        (lambda t: t.assign(IRD=[1.9, 1.8, 1.7, 1.7]), "plateau_2_1"),
        (lambda t: t.assign(**dict.fromkeys(t, 1.0)), "step_4_2"),  # steps change nothing
        (lambda t: t.assign(IRD=[1.8, 1.8, 3.0, 3.0]), "step_4_2"),  # or much
    ],
)
def test_a_network_that_is_not_fails_the_line_that_sees_it(change, fails):
    table = likeness(change(paper_figures()), REAL).set_index("line")
    assert table.loc[fails, "distance"] > 0.05


def test_a_distance_is_the_logarithm_of_the_factor_that_is_missing():
    table = likeness(paper_figures().assign(foot_all_frames=2.8), REAL, ["foot_all_frames"])
    assert table["distance"].item() == pytest.approx(np.log(2.0))
    assert likeness(paper_figures().assign(IRD=np.nan), REAL, ["IRD"])["distance"].item() == np.inf


def test_one_step_serves_every_grid_and_update_of_a_record():
    rows = [{"run": "real", "windows": 0, "walks": 9, "metric": m, "value": v} for m, v in REAL.items()]
    for (steps, metric), value in paper_figures().stack().items():
        for grid, update in [("endpoints", "rescaled"), ("uniform", "literal")][: 2 if steps > 1 else 1]:
            named = {"run": "a", "windows": 8, "grid": grid, "update": update, "steps": steps}
            rows.append({**named, "walks": 22, "diverged": 1, "metric": metric, "value": value})
    table = likeness_of_readings(pd.DataFrame(rows))
    assert len(table) == 2 * len(LINES) and (table["distance"] == 0.0).all() and (table["diverged"] == 1).all()
