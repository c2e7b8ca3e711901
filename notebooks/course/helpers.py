"""The helpers of the folder above, found from this one by the same name."""

from pathlib import Path

__path__ = [str(Path(__file__).resolve().parents[1] / "helpers")]
