"""Messages about names that nobody knows."""

from dataclasses import dataclass, field

from builders import refused

from f3amd_lib.ground.names import nearest_hint, refuse_unknown


@dataclass(frozen=True)
class Settings:
    width: int = 1
    depth: int = 2
    kind: str = field(default="fixed", init=False)


def test_the_hint_asks_and_lists():
    hint = nearest_hint("LABTOP", ["smoke", "laptop"])
    assert hint == "; did you mean 'laptop'? (one of smoke, laptop)"
    assert nearest_hint("zzz", ["smoke", "laptop"]) == " (one of smoke, laptop)"


def test_a_long_list_is_cut_to_the_nearest():
    names = [f"style {number}" for number in range(40)]
    hint = nearest_hint("stile 7", names)
    assert hint.startswith("; did you mean 'style 7'? (40 are known, such as style 7, ")
    assert nearest_hint("zzz", names) == " (40 are known, such as style 0, style 1, style 2)"


def test_unknown_settings_are_refused_and_fixed_fields_are_no_settings():
    refuse_unknown({"width": 3}, Settings, "setting")
    refused("unknown setting 'widht'; did you mean 'width'", refuse_unknown, {"widht": 3}, Settings, "setting")
    refused("unknown setting 'kind'", refuse_unknown, {"kind": "other"}, Settings, "setting")
