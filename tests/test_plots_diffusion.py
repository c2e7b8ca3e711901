"""Films open on their end and come out alike; stored results say where they come from."""

import numpy as np
import pandas as pd
import pytest
from PIL import Image

from f3amd_lib.drawing import plots_ablations
from f3amd_lib.drawing import plots_diffusion as draw
from f3amd_lib.drawing.style import new_figure
from f3amd_lib.ground.profiles import load_profile
from f3amd_lib.ground.records import run_record, write_table


def dots(places):
    """A small figure for each place, with one dot there."""
    figures = []
    for place in places:
        figure, axis = new_figure(2.0, 2.0)
        axis.plot(place, place, "o", color="#542788", markersize=12)
        axis.set(xlim=(0, 1), ylim=(0, 1))
        figures.append(figure)
    return figures


def test_film_is_an_animated_image_that_opens_on_its_end(tmp_path):
    frames = dots([0.2, 0.8, 0.5])
    shown = draw.keep_film(frames, tmp_path, "walk", milliseconds=80)
    path = tmp_path / "media" / "walk.png"
    assert path.read_bytes() == shown.data
    film = Image.open(path)
    pictures, durations = [], []
    for frame in range(film.n_frames):
        film.seek(frame)
        pictures.append(np.asarray(film.convert("RGB")).astype(int))
        durations.append(film.info["duration"])
    assert len(pictures) == 4 and durations[0] > 1000 and set(durations[1:]) == {80.0}
    np.testing.assert_array_equal(pictures[0], pictures[-1])
    assert np.abs(pictures[0] - pictures[1]).max() > 100
    again = draw.keep_film(dots([0.2, 0.8, 0.5]), tmp_path, "b", milliseconds=80)
    assert again.data == shown.data
    with pytest.raises(ValueError, match="at least 2 figures, got 1"):
        draw.keep_film(frames[:1], tmp_path, "short")


def test_stored_results_are_those_of_the_data_set_then_bandais_and_say_so(tmp_path, monkeypatch):
    monkeypatch.setattr(plots_ablations, "repository_root", lambda: tmp_path)
    found, sentence = draw.stored_result("synthetic", "posterior", "posterior")
    assert found is None
    assert "Not measured yet: `posterior`" in sentence
    assert "`make measure MEASURE=posterior DATA=bandai`" in sentence
    for dataset, value in (("bandai", 1.0), ("synthetic", 2.0)):
        record = run_record(profile=load_profile("laptop", dataset), dataset=dataset, seed=0)
        path = tmp_path / "paper_figures" / dataset / "laptop" / "records" / "posterior.csv"
        write_table(path, pd.DataFrame({"value": [value]}), record)
        found, sentence = draw.stored_result("synthetic", "posterior", "posterior")
        assert found["value"].tolist() == [value]
        assert found.attrs["dataset"] == dataset
        assert f"data {dataset}, profile laptop" in sentence
