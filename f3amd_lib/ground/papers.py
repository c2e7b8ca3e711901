"""The numbers that the paper prints, table by table, to stand beside ours."""

from __future__ import annotations

import functools
from pathlib import Path

import pandas as pd

_FOLDER = Path(__file__).parents[1] / "papers/f3amd/numbers"

PAPER_SETTING = "paper (100STYLE, RTX A6000 / Threadripper 3970X, IREE)"
"""Label of the paper's column: its data and, for times, its hardware and compiler."""

PAPER_TABLES = {
    1: ("f3amd_table01_synthesis_time_ms.csv", "Synthesis time a round, 8 steps, ms"),
    2: ("f3amd_table02_training_time_min.csv", "Training time an epoch, min"),
    3: ("f3amd_table03_quality.csv", "Motion quality, 8 steps"),
    4: ("f3amd_table04_synthesis_time_by_steps_ms.csv", "Synthesis time by steps, ms"),
    5: ("f3amd_table05_quality_by_steps.csv", "Motion quality by steps"),
    6: ("f3amd_table06_camdm_jax_vs_pytorch_quality.csv", "CAMDM in JAX and PyTorch: quality"),
    7: ("f3amd_table07_camdm_jax_vs_pytorch_time_ms.csv", "CAMDM in JAX and PyTorch: time, ms"),
    8: ("f3amd_table08_fno_variants.csv", "Variants of the FNO block"),
    9: ("f3amd_table09_encoder_decoder.csv", "FNO or linear encoder and decoder"),
    10: ("f3amd_table10_frequency_modes.csv", "Number of kept frequency bins"),
    11: ("f3amd_table11_conditioning.csv", "Kinds of conditioning"),
    12: ("f3amd_table12_camdm96.csv", "CAMDM at latent dimension 96"),
}
"""Table number -> (file, title in our words)."""

_TIME_TABLES = (1, 4, 7)


def load_paper_table(number: int) -> pd.DataFrame:
    """Return one table of the F3AMD paper in tidy form.

    Args:
      number: 1 to 12, the table's number in the paper.

    Returns:
      A new DataFrame with the columns model, window_frames, steps and either device, characters
      (times) or none, then metric, unit, better, printed (text as printed, "" for a dash) and
      value (float, NaN for a dash). `frame.attrs` has the table's number, title and setting.

    Raises:
      ValueError: if there is no such table.

    Source: F3AMD paper, Tables 1 to 12.
    """
    if number not in PAPER_TABLES:
        raise ValueError(f"the F3AMD paper has Tables 1 to 12, not {number!r}")
    frame = _read(number).copy()
    frame.attrs = {"table": number, "title": PAPER_TABLES[number][1], "setting": PAPER_SETTING}
    return frame


@functools.cache
def _read(number: int) -> pd.DataFrame:
    frame = pd.read_csv(_FOLDER / PAPER_TABLES[number][0], dtype=str, keep_default_na=False)
    frame = frame.rename(columns={"value": "printed"})
    for column in ("window_frames", "steps", "characters"):
        if column in frame:
            frame[column] = frame[column].astype(int)
    if number in _TIME_TABLES:
        position = frame.columns.get_loc("printed")
        for name, text in (("better", "down"), ("unit", "ms"), ("metric", "synthesis_time")):
            frame.insert(position, name, text)
    frame["value"] = pd.to_numeric(frame["printed"], errors="coerce")
    return frame
