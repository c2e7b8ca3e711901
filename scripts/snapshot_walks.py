"""Let snapshots of the long queue follow one held-out clip, for the film strips of notebook 15.

    python scripts/snapshot_walks.py runs/bandai/laptop/campaign/F3AMD-FNO-96-seed0/*.safetensors

Each weights file gives one motion, `paper_figures/bandai/laptop/media/RUN_WINDOWS.bvh`: eight steps, from the start,
on the path and in the style of the clip that notebook 15.5 follows.
"""

from __future__ import annotations

import sys
from pathlib import Path

import tyro

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # this tree's library, whatever is installed

from f3amd_lib.experiments.real_clips import follow_longest
from f3amd_lib.generation.rollout import MotionGenerator
from f3amd_lib.ground.profiles import load_profile, repository_root
from f3amd_lib.motion.bvh import write_bvh
from f3amd_lib.training.checkpoints import load_model
from f3amd_lib.training.pipeline import prepare


def snapshot_walks(weights: tyro.conf.Positional[list[Path]]) -> None:
    """Write the motion of each weights file."""
    media = repository_root() / "paper_figures" / "bandai" / "laptop" / "media"
    packed = prepare(load_profile("laptop", "bandai")).packed
    for path in weights:
        trained = load_model(path)
        style = next(style for style in trained.styles if style.endswith("normal"))
        history, line, _ = follow_longest(packed, style, num_history=10, num_frames=3 * 32)
        motion = MotionGenerator(trained, 8).rollout([line], [style], seed=0, history=history).motion(0)
        write_bvh(media / f"{path.parent.name}_{path.stem}.bvh", motion, overwrite=True)


if __name__ == "__main__":
    tyro.cli(snapshot_walks)
