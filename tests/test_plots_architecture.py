"""Figures on networks: the diagram of Figure 2 says what the config says, and can be read."""

import numpy as np
import pytest

from f3amd_lib.drawing import plots_architecture as draw
from f3amd_lib.networks.presets import build_config

SIZES = {"channels": 129, "num_styles": 15}


def diagram_texts(name, **settings):
    figure = draw.architecture_diagram(build_config(name, **SIZES, **settings), name)
    return [text.get_text() for text in figure.axes[0].texts if text.get_text()]


def test_figure2_has_the_numbers_of_the_config():
    texts = diagram_texts("F3AMD-FNO-96")
    assert {"F3AMD-FNO-96", "6 ×", "m = 17 of 17", "129 → 96", "96 → 129"} <= set(texts)
    assert {"10 × 129", "32 × 8", "15", "17 × 96 × 96, complex", "96 → 2 × 96"} <= set(texts)
    other = diagram_texts("F3AMD-FNO-96", window=64, num_kept_modes=5, depth=2, kernel_size=5)
    assert {"2 ×", "m = 5 of 33", "64 × 129", "64 → 5", "conv 5"} <= set(other)


def test_figure2_shows_what_no_preset_sets():
    texts = set(diagram_texts("F3AMD-FNO-96", output_scaling=True, decoder_hidden_width=64))
    assert {"skip\n$c_{skip}$ x", "96 → 64 → 129"} <= texts


@pytest.mark.parametrize(
    ("name", "shown", "absent"),
    [
        ("F3AMD-Transformer-64", {"Transformer", "2 heads", "64 → 256 → 64"}, {"RFFT"}),
        ("F3AMD-FNO-96-linear", {"linear", "129 → 96"}, {"FNO, m = 17"}),
        ("F3AMD-FNO-96-m4", {"m = 4 of 17", "FNO, m = 4"}, {"m = 17 of 17"}),
        ("F3AMD-DCT-96", {"DCT", "32 × 96 × 96, real", "FNO, m = 17"}, {"RFFT"}),
        ("F3AMD-reduced-rank-FNO-96", {"weights U V, rank 8"}, {"weights W"}),
        ("F3AMD-weighted-FNO-96", {"gain · weights W"}, {"weights W"}),
        ("F3AMD-FNO-96-concatenation", {"64 frames", "m = 33 of 33", "last"}, {"FiLM"}),
        ("F3AMD-FNO-96-AdaLN-zero", {"AdaLN-zero", "96 → 3 × 96", "gate"}, {"FiLM"}),
        ("F3AMD-FNO-96-cross-attention", {"z asks c"}, {"FiLM"}),
        ("F3AMD-FNO-96-plus", {"4 heads", "gain on\nresidual"}, set()),
        (
            "F3AMD-FNO-96-steady",
            {"to face\nthe path", "42 × 138", "m = 22 of 22", "c   42 × 96", "turned\nback"},
            {"c   32 × 96", "m = 17 of 17"},
        ),
        ("F3AMD-FNO-96-raw", {"FNO block"}, {"$c_{in}$"}),
        ("CAMDM", {"76 tokens", "4 heads, 76 × 76", "1 of 8", "256 → 129"}, {"FiLM"}),
        ("CAMDM-code", {"108 tokens", "32 × 2", "32 × 6"}, {"32 × 8"}),
        ("CAMDM-VE", {"σ"}, {"1 of 8"}),
    ],
)
def test_figure2_shows_what_a_variant_changes(name, shown, absent):
    texts = set(diagram_texts(name))
    assert shown <= texts
    assert not absent & texts


def test_camdms_tokens_add_up():
    config = build_config("CAMDM-code", **SIZES)
    figure = draw.architecture_diagram(config)
    white = [t for t in figure.axes[0].texts if t.get_color() == "white"]
    counts = [int(text.get_text()) for text in white if text.get_text().isdigit()]
    assert counts == [1, 1, 32, 32, 10, 32] and sum(counts) == config.num_tokens


@pytest.mark.parametrize(
    "name",
    [
        "F3AMD-FNO-128",
        "F3AMD-Transformer-96",
        "F3AMD-reduced-rank-FNO-96",
        "F3AMD-FNO-96-concatenation",
        "F3AMD-FNO-96-AdaLN-zero",
        "F3AMD-FNO-96-cross-attention",
        "F3AMD-FNO-96-plus",
        "F3AMD-FNO-96-steady",
        "CAMDM-code",
    ],
)
def test_no_text_of_the_diagram_lies_on_another_or_outside(name):
    figure = draw.architecture_diagram(build_config(name, **SIZES), name)
    renderer = figure.canvas.get_renderer()
    boxes = [
        (text.get_text(), text.get_window_extent(renderer)) for text in figure.axes[0].texts if text.get_text().strip()
    ]
    sheet = figure.bbox
    for number, (text, box) in enumerate(boxes):
        inside = sheet.x0 <= box.x0 and box.x1 <= sheet.x1 and sheet.y0 <= box.y0
        assert inside and box.y1 <= sheet.y1, text
        for other, second in boxes[:number]:
            overlap = np.minimum(box.max, second.max) - np.maximum(box.min, second.min)
            assert (overlap < 3.0).any(), (text, other)  # lines of one box may touch


def test_influence_maps_share_a_scale():
    maps = {"weak": np.full((4, 4), 0.5), "strong": np.eye(4) * 3}
    for highest, end in ((None, 3.0), (2.0, 2.0)):
        figure = draw.influence_maps(maps, "here", "there", highest=highest)
        images = [axis.images[0] for axis in figure.axes[:2]]
        assert [image.get_clim() for image in images] == [(0.0, end)] * 2
        assert figure.axes[0].get_ylabel() == "there"
        # An arrow on the colour bar where something lies beyond it.
        assert figure.axes[-1]._colorbar.extend == ("max" if end < 3 else "neither")
