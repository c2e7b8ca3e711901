"""MotionPCM's folder: its tables are whole, and its own rows have presets."""

import pytest

from f3amd_lib.ground import papers
from f3amd_lib.networks.presets import find_preset

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
