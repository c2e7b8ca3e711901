"""What the notebooks on diffusion share: results measured before, and films.

Pictures are drawn in the notebooks themselves.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path

import pandas as pd
from PIL import Image

from f3amd_lib.drawing.plots_ablations import committed_table
from f3amd_lib.drawing.style import show_figure


def stored_result(dataset: str, name: str, measurement: str) -> tuple[pd.DataFrame | None, str]:
    """Read a stored table of a data set, else that of Bandai, and say where it comes from.

    Args:
      dataset: a name of `profiles.DATASETS`.
      name: of the table, without ending.
      measurement: of `measure.MEASUREMENTS`, which writes it.

    Returns:
      (table or None, a sentence: data, profile, machine, date and credit, or how to measure it).
      `table.attrs["dataset"]` names the data set that was measured.
    """
    found = committed_table(dataset, name) or committed_table("bandai", name)
    if found is None:
        how = f"`make measure MEASURE={measurement} DATA=bandai`"
        return None, f"Not measured yet: `{name}`. {how} measures it."
    table, record = found
    table.attrs["dataset"] = record["dataset"]
    sentence = (
        f"Stored result `{name}`: data {record['dataset']}, profile {record['profile']}, "
        f"{record['cores']} cores ({record['device_platform']}), {record['date_utc'][:10]}. "
        f"{record['dataset_credit'] or ''}"
    )
    return table, sentence.strip()


def keep_film(figures: Sequence, results, name: str, *, milliseconds: int = 140):
    """Save figures as an animated PNG, `<results>/media/<name>.png`, and return it for a notebook.

    It is an image like any other: no player, no script. It opens and pauses on the last figure,
    which is also what a reader sees where moving pictures stand still.

    Args:
      figures: of one size, at least two.
      results: from `profiles.results_dir`.
      name: without folder and ending.
      milliseconds: a figure is shown.

    Returns:
      An image for a cell's last line.

    Raises:
      ValueError: for fewer than two figures.
    """
    if len(figures) < 2:
        raise ValueError(f"a film needs at least 2 figures, got {len(figures)}")
    shown = [show_figure(figure, dpi=76) for figure in figures]
    frames = [Image.open(io.BytesIO(image.data)).convert("RGB") for image in shown]
    frames.insert(0, frames[-1])
    # One palette for all, from a frame with all colours: the film does not flicker.
    palette = frames[0].quantize(12, method=Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)
    frames = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    durations = [1600, *[milliseconds] * len(figures)]
    buffer = io.BytesIO()
    frames[0].save(buffer, "png", save_all=True, append_images=frames[1:], duration=durations,
                   loop=0, optimize=True)  # fmt: skip
    path = Path(results) / "media" / f"{name}.png"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(buffer.getvalue())
    shown[0].data = buffer.getvalue()
    return shown[0]
