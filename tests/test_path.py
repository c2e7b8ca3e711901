"""The notebook beside the paper: short, moving, with every equation; and the others, which say whether to read them."""

import base64
import io
import re

import nbformat
import numpy as np
import pytest
from f3amd_notebooks.path_pictures import moving_picture
from PIL import Image
from test_notebook_hygiene import COURSE, NOTEBOOKS, PATH, STANDALONE, prose
from test_player import Elements

from f3amd_lib.ground.papers import load_paper_file

MOST_WORDS, MOST_PICTURES = 3500, 12


def moving(html: str) -> tuple[Image.Image, dict]:
    """The animated WebP of a cell's output, and the attributes of its element."""
    ((_, attributes),) = Elements(html).tags
    return Image.open(io.BytesIO(base64.b64decode(attributes["src"].partition("base64,")[2]))), attributes


def test_the_path_is_short_begins_with_motion_and_has_every_equation_in_text_and_code():
    notebook = nbformat.v4.reads(PATH.read_text("utf-8"))
    outputs = [output.get("data", {}) for cell in notebook.cells for output in cell.get("outputs", ())]
    shown = [data for data in outputs if "image/png" in data or "<img " in data.get("text/html", "")]
    assert len(" ".join(prose(notebook)).split()) <= MOST_WORDS and len(shown) <= MOST_PICTURES
    picture, _ = moving(shown[0]["text/html"])
    assert picture.n_frames > 30
    numbered = {str(number) for number in range(1, 1 + load_paper_file("paper")["numbered_equations"])}
    code = "\n".join(cell.source for cell in notebook.cells if cell.cell_type == "code")
    said = " ".join(prose(notebook))
    assert numbered - {"11", "12", "13"} <= set(re.findall(r"\((\d+)\)", said))  # Appendix B's stand in a table
    assert numbered - {"13"} <= set(re.findall(r"# Eq\. (\d+)", code))


@pytest.mark.parametrize("path", [*NOTEBOOKS[1:], *COURSE, *STANDALONE], ids=lambda path: path.stem)
def test_every_other_notebook_says_whether_to_read_it_or_look_it_up_and_for_how_long(path):
    line = nbformat.v4.reads(path.read_text("utf-8")).cells[0].source.splitlines()[1]
    assert re.fullmatch(r"\*(Read, after|Look up).*: .+ \d+ minutes of text, .+ to run\.\*", line), line


def test_a_moving_picture_keeps_its_frames_its_times_and_its_words():
    frames = [Image.fromarray(np.full((30, 40, 3), level, np.uint8)) for level in (0, 90, 180, 255)]
    picture, attributes = moving(moving_picture(frames, fps=10, alt="'grey' < white").data)
    assert attributes["alt"] == "'grey' < white" and attributes["width"] == "40"
    assert picture.n_frames == 4 and picture.size == (40, 30)
    durations = []
    for place, level in enumerate((0, 90, 180, 255)):
        picture.seek(place)
        picture.load()
        durations.append(picture.info["duration"])
        assert abs(np.asarray(picture.convert("L"), float).mean() - level) < 4
    assert durations == [100, 100, 100, 1000]
