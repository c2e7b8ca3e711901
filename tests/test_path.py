"""The moving picture of the notebook beside the paper."""

import base64
import io

import numpy as np
from f3amd_notebooks.path_pictures import moving_picture
from PIL import Image
from test_player import Elements


def test_a_moving_picture_keeps_its_frames_its_times_and_its_words():
    frames = [Image.fromarray(np.full((30, 40, 3), level, np.uint8)) for level in (0, 90, 180, 255)]
    ((_, attributes),) = Elements(moving_picture(frames, fps=10, alt="'grey' < white").data).tags
    picture = Image.open(io.BytesIO(base64.b64decode(attributes["src"].partition("base64,")[2])))
    assert attributes["alt"] == "'grey' < white" and attributes["width"] == "40"
    assert picture.n_frames == 4 and picture.size == (40, 30)
    durations = []
    for place, level in enumerate((0, 90, 180, 255)):
        picture.seek(place)
        picture.load()
        durations.append(picture.info["duration"])
        assert abs(np.asarray(picture.convert("L"), float).mean() - level) < 4
    assert durations == [100, 100, 100, 1000]
