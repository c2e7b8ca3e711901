"""Messages about names that nobody knows."""

from dataclasses import dataclass, field

from builders import refused

from f3amd_lib.ground.names import nearest_hint, refuse_unknown


@dataclass(frozen=True)
class Settings:
    width: int = 1
    depth: int = 2
    kind: str = field(default="fixed", init=False)


def test_the_hint_names_the_nearest():
    assert "'laptop'" in nearest_hint("LABTOP", ["smoke", "laptop"])
    assert "'style 7'" in nearest_hint("stile 7", [f"style {number}" for number in range(40)])


def test_unknown_settings_are_refused_and_fixed_fields_are_no_settings():
    refuse_unknown({"width": 3}, Settings, "setting")
    refused("unknown setting 'widht'; did you mean 'width'", refuse_unknown, {"widht": 3}, Settings, "setting")
    refused("unknown setting 'kind'", refuse_unknown, {"kind": "other"}, Settings, "setting")
