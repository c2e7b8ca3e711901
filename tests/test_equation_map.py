"""The map from equations to code, and the list of open points."""

import json

import pytest

from f3amd_lib.models.camdm import CAMDMConfig
from f3amd_lib.models.f3amd import F3AMDConfig
from f3amd_lib.models.zoo import find_preset
from f3amd_lib.report.equation_map import EQUATIONS, equation_map, mentioned_equations
from f3amd_lib.report.readings import READINGS, Reading, readings_table


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("noise of Eq. 8", {"Eq. 8"}),
        ("the block (Eqs 2-4)", {"Eq. 2", "Eq. 3", "Eq. 4"}),
        ("Eqs 5 to 7, and Eq. 14", {"Eq. 5", "Eq. 6", "Eq. 7", "Eq. 14"}),
        ("FK of Eqs 10, 12 and 13", {"Eq. 10", "Eq. 12", "Eq. 13"}),
        ("Eq. 9 (section 3.5; Karras et al. 2022, Eq. 5)", {"Eq. 9"}),
        ("Source: section 3.2; Zhou et al. 2019, Eq. 15.", set()),
        ("paper Appendix F and Appendix B", {"Appendix F"}),
        ("Eq. 81 and a sequence of 3", set()),
    ],
)
def test_mentions_are_read(text, expected):
    assert mentioned_equations(text) == expected


def test_a_small_checkout_is_mapped(tmp_path):
    for folder in ("f3amd_lib/models", "tests", "notebooks"):
        (tmp_path / folder).mkdir(parents=True)
    (tmp_path / "f3amd_lib/models/block.py").write_text(
        'class Block:\n    """Sum (Eq. 4)."""\n\n    def local(self):\n        """Eq. 3."""\n\n\n'
        'class Config:\n    """Settings.\n\n    Attributes:\n      k: of Eq. 3.\n    """\n'
    )
    (tmp_path / "tests/test_block.py").write_text(
        "def test_eq03_to_eq04_sum():\n    pass\n\n\ndef test_appendix_f_step():\n    pass\n"
    )
    cells = [
        {"cell_type": "markdown", "source": ["# Blocks (Eqs 3, 4)"]},
        {"cell_type": "code", "source": ["x = 1  # Eq. 9"]},
    ]
    (tmp_path / "notebooks/03_blocks.ipynb").write_text(json.dumps({"cells": cells}))
    rows = equation_map(root=tmp_path).set_index("equation")
    assert rows.loc["Eq. 3", "functions"] == "models/block: Block.local"
    assert rows.loc["Eq. 4", "functions"] == "models/block: Block"
    assert rows.loc["Eq. 3", "tests"] == "test_block: test_eq03_to_eq04_sum"
    assert rows.loc["Appendix F", "tests"] == "test_block: test_appendix_f_step"
    assert rows.loc["Eq. 4", "notebooks"] == "03_blocks"
    assert (rows.loc["Eq. 9", ["functions", "tests", "notebooks"]] == "").all()


def test_every_equation_of_the_paper_has_code():
    rows = equation_map()
    assert len(rows) == len(EQUATIONS) == 15
    assert rows.loc[rows["functions"] == "", "equation"].tolist() == []
    by_label = rows.set_index("equation")["functions"]
    assert "diffusion/schedules: VarianceExploding.sigma" in by_label["Eq. 9"].split(", ")
    assert "training/losses: total_loss" in by_label["Eq. 14"].split(", ")


def test_open_points_show_the_codes_own_defaults():
    table = readings_table().set_index("open point")["here"]
    assert table["kernel size k of Eq. 3"] == str(F3AMDConfig(1, 1).kernel_size)
    assert table["scale of the noisy input"].startswith("input_scaling = True")
    assert table["attention heads"] == str(CAMDMConfig(1, 1).num_heads)
    assert f"D x {F3AMDConfig(1, 1).spectral_rank} times" in table["“rank = 8”"]
    assert not table.str.contains("{", regex=False).any()
    assert set(readings_table("data")["topic"]) == {"data"}
    with pytest.raises(ValueError, match="unknown topic"):
        readings_table("weather")


def test_open_points_show_what_a_preset_sets():
    table = readings_table("CAMDM").set_index("open point")["here"]
    code = find_preset("CAMDM-code")
    assert table["dropout in `CAMDM-code`"] == str(code.network["dropout"])
    share = table["history masked in training, `CAMDM-code`"]
    assert share == f"a share of {code.training['history_dropout']}"
    assert table["IRD in its loss"].startswith(f"weight {code.training['loss']['ird']};")


@pytest.mark.parametrize("field", ["F3AMDConfig.colour", "CAMDM-code.colour", "CAMDM-9.dropout"])
def test_an_open_point_cannot_name_a_setting_that_is_not_there(field):
    with pytest.raises(KeyError):
        Reading("data", "point", "text", "{}", "reason", field).filling()


def test_open_points_are_told_once_with_a_reason():
    assert len({reading.point for reading in READINGS}) == len(READINGS)
    for reading in READINGS:
        assert reading.paper and reading.why
        assert bool(reading.field) == ("{" in reading.ours), reading.point
