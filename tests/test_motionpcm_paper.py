"""MotionPCM's folder: its tables are whole, and its own rows have presets."""

import pytest

from f3amd_companion.ledger.equation_map import equation_map
from f3amd_lib.ground import papers
from f3amd_lib.networks.presets import find_preset
from f3amd_lib.papers.readings import readings_table

ROWS = {"1": 224, "2": 30, "3": 3, "4": 36}
OF_OTHERS = ("Real", "TM2T", "MotionDiffuse", "MDM", "MLD", "T2M-GPT", "ReMoDiffuse", "StableMoFusion", "B2A-HDM")


@pytest.mark.parametrize("number", ROWS)
def test_tables_are_whole_and_its_own_rows_have_presets(number):
    frame = papers.load_paper_table(number, "motionpcm")
    assert len(frame) == ROWS[number] and set(frame["better"]) <= {"up", "down", "real"}
    assert (frame["value"].isna() == (frame["printed"] == "")).all()
    own = [name for name in frame["model"].unique() if name not in (*OF_OTHERS, "MotionLCM (4-step)")]
    assert own and {find_preset(name).paper for name in own} == {"motionpcm"}


def test_the_one_step_row_is_the_same_in_three_tables():
    for number, model in (("1", "MotionPCM (1-step)"), ("2", "MotionPCM k=100"), ("4", "MotionPCM (1 step)")):
        frame = papers.load_paper_table(number, "motionpcm")
        rows = frame[(frame["model"] == model) & (frame.get("dataset", "HumanML3D") == "HumanML3D")]
        printed = rows.set_index("metric")["printed"]
        assert (printed["FID"], printed["R_precision_top1"], printed["MM_dist"]) == ("0.044", "0.560", "2.711")


def test_its_equations_are_found_in_code_and_tests_and_its_open_points_are_settings():
    rows = equation_map(paper="motionpcm").set_index("equation")
    assert "text/phases: jump" in rows.loc["Eq. 10", "functions"]
    assert "test_phases: test_motionpcm_eq11" in rows.loc["Eq. 11", "tests"]
    for label in ("Eq. 8", "Eq. 10", "Eq. 11", "Eq. 12", "Eq. 13"):
        assert rows.loc[label, "functions"] and rows.loc[label, "tests"], label
    here = readings_table(paper="motionpcm").set_index("open point")["here"]
    assert here["width of the Huber loss"] == "0.5, pseudo-Huber"
