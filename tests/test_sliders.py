"""A figure with a slider: every frame is in the output, at the right place, and nothing is asked of anybody."""

import json
import re

import nbformat
import numpy as np
import pytest
from f3amd_notebooks.sliders import slide
from test_player import Elements

from f3amd_lib.drawing.style import new_figure
from f3amd_lib.ground.profiles import repository_root

NOTEBOOKS = {"02_sampler_theory": (17, 10), "12_spectral_and_film": (17,)}
"""Notebooks with sliders -> how many places each slider has."""


def all_of(page: Elements, tag: str) -> list[dict]:
    """Attributes of all elements with this tag."""
    return [attributes for name, attributes in page.tags if name == tag]


def points(path: str) -> list[np.ndarray]:
    """Points of a path, one array a stroke, in the units of its picture."""
    strokes = []
    for part in path.split("M")[1:]:
        first, rest = part.split("l")
        places = [[int(number) for number in re.findall(r"-?\d+", text)] for text in (first, rest)]
        strokes.append(np.cumsum([places[0], *np.reshape(places[1], (-1, 2))], axis=0))
    return strokes


@pytest.fixture
def drawn():
    """A figure with one line that moves, and where its line is at each of three places."""
    figure, axis = new_figure(4, 3)
    axis.set(xlim=(0, 10), ylim=(-1, 1), xlabel="x")
    (line,) = axis.plot([], [], "o-")
    x = np.linspace(0, 10, 5)
    frames = {f"<{k}> & 'so'": [np.stack([x, np.sin(k * x)], -1)] for k in range(3)}
    return figure, line, frames


def test_every_frame_is_there_and_lies_where_matplotlib_would_draw_it(drawn):
    figure, line, frames = drawn
    page = Elements(slide(figure, [line], frames, label="k <3", start=1, alt="A 'sine'").data)
    (setter,), (picture,), (path,) = (all_of(page, tag) for tag in ("input", "svg", "path"))
    moved = json.loads(setter["data-frames"])
    assert [name for name, _ in moved] == list(frames)
    assert (setter["type"], setter["min"], setter["max"], setter["value"]) == ("range", "0", "2", "1")
    assert setter["aria-valuetext"] == "<1> & 'so'" and path["d"] == moved[1][1][0]
    assert "k <3 " in page.text and all_of(page, "img")[0]["alt"] == "A 'sine'"
    height = float(picture["viewbox"].split()[3])
    fine = height / figure.bbox.height
    for (_, paths), (expected,) in zip(moved, frames.values(), strict=True):
        (stroke,) = points(paths[0])
        places = line.axes.transData.transform(expected)
        places[:, 1] = figure.bbox.height - places[:, 1]
        np.testing.assert_allclose(stroke[1:], fine * places, atol=0.51)  # the first stands twice


def sliders(name: str) -> list[str]:
    """The sliders in the committed outputs of a notebook."""
    notebook = nbformat.v4.reads((repository_root() / "notebooks" / f"{name}.ipynb").read_text("utf-8"))
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    shown = ["".join(output.get("data", {}).get("text/html", "")) for output in outputs]
    return [text for text in shown if "class='slider'" in text]


@pytest.mark.parametrize("name", NOTEBOOKS)
def test_committed_sliders_have_all_their_frames_and_no_address(name):
    found = sliders(name)
    for text, places in zip(found, NOTEBOOKS[name], strict=True):
        page = Elements(text)
        (setter,) = all_of(page, "input")
        moved = json.loads(setter["data-frames"])
        assert len(moved) == places == int(setter["max"]) + 1
        assert len({json.dumps(paths) for _, paths in moved}) == places  # no two are alike
        assert all(len(paths) == len(all_of(page, "path")) and all(map(points, paths)) for _, paths in moved)
        assert addresses(text) == [] and all_of(page, "script") == []
        assert all_of(page, "img")[0]["alt"]


def addresses(text: str) -> list[str]:
    """What a page would fetch from elsewhere."""
    return re.findall(r"(?:https?:|//)[\w.]+\.\w+|(?:src|href)='(?!data:)[^']*'|url\((?!#)[^)]*\)", text)
